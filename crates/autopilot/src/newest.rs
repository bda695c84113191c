//! The place of a setpoint that waits for a slow line: a newer one takes it.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use tokio::sync::Notify;

/// The newest packet of a kind of which each makes those before it useless.
#[derive(Debug, Default)]
pub(crate) struct Newest {
    packet: Mutex<Option<Vec<u8>>>,
    waits: Notify,
    replaced: AtomicU64,
}

impl Newest {
    /// Puts a packet in the place of one that still waits.
    pub(crate) fn put(&self, packet: Vec<u8>) {
        if self.place().replace(packet).is_some() {
            self.replaced.fetch_add(1, Ordering::Relaxed);
        }
        self.waits.notify_one();
    }

    /// Waits for a packet and takes it; may be cancelled without losing one.
    pub(crate) async fn take(&self) -> Vec<u8> {
        loop {
            if let Some(packet) = self.place().take() {
                return packet;
            }
            self.waits.notified().await;
        }
    }

    /// Forgets the one that waits.
    pub(crate) fn forget(&self) {
        drop(self.place().take());
    }

    /// Number of packets that were replaced while they waited.
    pub(crate) fn replaced(&self) -> u64 {
        self.replaced.load(Ordering::Relaxed)
    }

    fn place(&self) -> MutexGuard<'_, Option<Vec<u8>>> {
        self.packet.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
