//! Receives frames for the search: those of this machine as they come, those of the air link with an acknowledgement at once.
//!
//! A camera sends its next frame over the air link when the last one is acknowledged, and measures the link by that. So a
//! separate task receives the frames, independently of the search, and the newest one waits.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use messages::{FrameAck, FrameHeader};
use node::{Frame, FrameSubscriber, HealthCounters, Publisher};
use tokio::sync::Notify;
use tokio::task::JoinHandle;

/// Time without a newer frame after which one with an older stamp is searched: its camera was restarted, or one stamp was wrong.
const MAX_SILENCE: Duration = Duration::from_secs(1);

/// Where frames come from.
pub(crate) enum Inbox {
    /// This machine.
    Raw(FrameSubscriber),
    /// The air link.
    Air(AirInbox),
}

impl Inbox {
    /// The newest frame; `None` once the session is closed.
    pub(crate) async fn next(&self) -> Option<Frame> {
        match self {
            Self::Raw(frames) => frames.next().await,
            Self::Air(inbox) => inbox.next().await,
        }
    }
}

/// Frames of the air link. Dropping it ends its task.
pub(crate) struct AirInbox {
    slot: Arc<Slot>,
    task: JoinHandle<()>,
}

/// The newest frame that was not searched.
#[derive(Default)]
struct Slot {
    newest: Mutex<Option<Frame>>,
    arrived: Notify,
    is_over: AtomicBool,
}

impl AirInbox {
    /// Receives and acknowledges frames from now on.
    pub(crate) fn start(
        frames: FrameSubscriber,
        acks: Publisher<FrameAck>,
        health: Arc<HealthCounters>,
    ) -> Self {
        let slot = Arc::<Slot>::default();
        let task = tokio::spawn(receive(frames, acks, health, Arc::clone(&slot)));
        Self { slot, task }
    }

    async fn next(&self) -> Option<Frame> {
        loop {
            if let Some(frame) = lock(&self.slot.newest).take() {
                return Some(frame);
            }
            if self.slot.is_over.load(Ordering::Acquire) {
                return None;
            }
            self.slot.arrived.notified().await;
        }
    }
}

impl Drop for AirInbox {
    fn drop(&mut self) {
        self.task.abort();
    }
}

async fn receive(
    frames: FrameSubscriber,
    acks: Publisher<FrameAck>,
    health: Arc<HealthCounters>,
    slot: Arc<Slot>,
) {
    let mut order = Order::default();
    while let Some(frame) = frames.next().await {
        acks.publish(&ack(&frame)).await;
        let is_overtaken = order.is_overtaken(&frame.header, Instant::now());
        if is_overtaken || lock(&slot.newest).replace(frame).is_some() {
            health.dropped("frames that a newer one has overtaken");
        }
        slot.arrived.notify_one();
    }
    slot.is_over.store(true, Ordering::Release);
    slot.arrived.notify_one();
}

fn ack(frame: &Frame) -> FrameAck {
    let FrameHeader { camera, sequence, stamp_ns, clock, .. } = &frame.header;
    FrameAck {
        camera: camera.clone(),
        sequence: *sequence,
        stamp_ns: *stamp_ns,
        clock: clock.clone(),
        bytes: u32::try_from(frame.bytes().len()).unwrap_or(u32::MAX),
    }
}

/// The order of frames, which come over two connections.
#[derive(Debug, Default)]
struct Order {
    /// Clock and stamp of the newest one, and when it came.
    newest: Option<(String, i64, Instant)>,
}

impl Order {
    /// True for a frame that was held up on its way while a newer one came.
    fn is_overtaken(&mut self, header: &FrameHeader, now: Instant) -> bool {
        let is_overtaken = self.newest.as_ref().is_some_and(|(clock, stamp_ns, came)| {
            *clock == header.clock
                && header.stamp_ns < *stamp_ns
                && now.saturating_duration_since(*came) < MAX_SILENCE
        });
        if !is_overtaken {
            self.newest = Some((header.clock.clone(), header.stamp_ns, now));
        }
        is_overtaken
    }
}

// The value that a thread left when it panicked is still complete.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_overtaken_while_newer_ones_come() {
        let start = Instant::now();
        let mut order = Order::default();
        let mut is_overtaken = |stamp_ms: i64, clock: &str, at_ms: u64| {
            let header = FrameHeader {
                stamp_ns: stamp_ms * 1_000_000,
                clock: clock.to_owned(),
                ..FrameHeader::sample()
            };
            order.is_overtaken(&header, start + Duration::from_millis(at_ms))
        };
        assert!(!is_overtaken(1000, "a", 1100) && !is_overtaken(1066, "a", 1166));
        // Held up by a lost packet, also for seconds.
        assert!(is_overtaken(1033, "a", 1200) && !is_overtaken(5000, "a", 5100));
        assert!(is_overtaken(1100, "a", 5130) && !is_overtaken(5066, "a", 5166));
        // The camera's machine was started again.
        assert!(!is_overtaken(200, "b", 5300));
        // A stamp from the future is forgotten.
        assert!(!is_overtaken(1_000_000, "b", 5400) && is_overtaken(500, "b", 5600));
        assert!(!is_overtaken(1500, "b", 6500) && !is_overtaken(1566, "b", 6566));
    }
}
