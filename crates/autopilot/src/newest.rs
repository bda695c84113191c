//! Holds the setpoint that waits for a slow line: a newer one replaces it.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use tokio::sync::Notify;

/// The newest packet of a kind where each packet makes earlier ones useless.
#[derive(Debug, Default)]
pub(crate) struct Newest {
    packet: Mutex<Option<Vec<u8>>>,
    waits: Notify,
    replaced: AtomicU64,
}

impl Newest {
    /// Stores a packet, and drops one that still waits.
    pub(crate) fn put(&self, packet: Vec<u8>) {
        if self.slot().replace(packet).is_some() {
            self.replaced.fetch_add(1, Ordering::Relaxed);
        }
        self.waits.notify_one();
    }

    /// Waits for a packet and takes it; may be cancelled without losing one.
    pub(crate) async fn take(&self) -> Vec<u8> {
        loop {
            if let Some(packet) = self.slot().take() {
                return packet;
            }
            self.waits.notified().await;
        }
    }

    /// Forgets the one that waits.
    pub(crate) fn forget(&self) {
        drop(self.slot().take());
    }

    /// Number of packets that were replaced while they waited.
    pub(crate) fn replaced(&self) -> u64 {
        self.replaced.load(Ordering::Relaxed)
    }

    fn slot(&self) -> MutexGuard<'_, Option<Vec<u8>>> {
        self.packet.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
