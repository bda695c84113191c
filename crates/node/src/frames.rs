//! Pixels: written in place into shared memory, read where they lie.
//!
//! On one host a frame is never copied between the camera and the detector: the camera borrows a buffer
//! ([`FramePublisher::loan`]), writes into it and publishes it; a subscriber reads the same memory. When shared
//! memory cannot be had, the buffer is ordinary memory and Zenoh copies it: slower, never silent.

use std::borrow::Cow;
use std::ops::{Deref, DerefMut};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::anyhow;
use messages::{Delivery, FrameHeader, PixelFormat, Topic, decode, encode, topic};
use rustix::process::{Resource, getrlimit};
use zenoh::Wait;
use zenoh::bytes::ZBytes;
use zenoh::handlers::{RingChannel, RingChannelHandler};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::sample::Sample;
use zenoh::shm::{
    GarbageCollect, PosixShmProviderBackend, ShmProvider, ShmProviderBuilder, ZShmMut,
};

use crate::health::HealthCounters;
use crate::session::Node;
use crate::topics::report_refused;

/// Frames the shared memory holds: one being written, one in flight, and one each for two slow readers. Few,
/// because every subscriber keeps the whole pool mapped and locked.
const FRAMES_IN_POOL: usize = 4;

/// A pool in which there was no room for so long is given up for a new one: a reader that was killed never returns the
/// frames it had. Longer than any reader keeps a frame.
const POOL_GIVEN_UP: Duration = Duration::from_secs(1);
/// So many frames must have been refused as well, as few are asked for at a low rate.
const REFUSALS_BEFORE_GIVEN_UP: u32 = 4;
/// New pools a publisher makes at most, for the readers that never return anything: readers keep the old ones mapped.
const MOST_NEW_POOLS: u32 = 3;

/// Over the air a priority is a connection (`zenoh-config/README.md`): frames have two.
const FIRST_LANE: Priority = Priority::DataLow;
const SECOND_LANE: Priority = Priority::Background;
const LANES: usize = 2;

/// Publishes frames on one key.
pub struct FramePublisher {
    publisher: zenoh::pubsub::Publisher<'static>,
    pool: Option<Mutex<Pool>>,
    health: Arc<HealthCounters>,
}

/// Shared memory for a few frames.
struct Pool {
    provider: ShmProvider<PosixShmProviderBackend>,
    bytes: usize,
    /// Since when there was no room, and how often it was asked for.
    full_since: Option<Instant>,
    refusals: u32,
    /// How many were given up before it.
    predecessors: u32,
}

/// A buffer for one frame.
pub enum Loan {
    /// In shared memory.
    Shared(ZShmMut),
    /// In this process.
    Private(Vec<u8>),
}

/// A frame that was received.
pub struct Frame {
    /// Its header.
    pub header: FrameHeader,
    payload: ZBytes,
}

/// Receives frames; always the newest.
pub struct FrameSubscriber {
    subscriber: zenoh::pubsub::Subscriber<RingChannelHandler<Sample>>,
    health: Arc<HealthCounters>,
}

impl Node {
    /// A publisher of frames of at most `largest_frame_bytes`; with 0 it has no shared memory of its own.
    ///
    /// # Errors
    /// When the session is closed or a name makes no key.
    pub async fn frame_publisher(
        &self,
        topic: Topic<FrameHeader>,
        names: &[&str],
        largest_frame_bytes: usize,
    ) -> anyhow::Result<FramePublisher> {
        let key = topic.key(names);
        debug_assert_eq!(topic.delivery(), Delivery::Newest);
        let publisher = self.declare_frames(key, FIRST_LANE).await?;
        if largest_frame_bytes == 0 {
            return Ok(FramePublisher { publisher, pool: None, health: self.shared_health() });
        }
        let pool_bytes = FRAMES_IN_POOL * largest_frame_bytes.next_multiple_of(4096) + 4096;
        let pool = Pool::new(pool_bytes).map(Mutex::new);
        Ok(FramePublisher { publisher, pool, health: self.shared_health() })
    }

    async fn declare_frames(
        &self,
        key: String,
        lane: Priority,
    ) -> anyhow::Result<zenoh::pubsub::Publisher<'static>> {
        self.session
            .declare_publisher(key.clone())
            .priority(lane)
            // Drop would lose large frames almost entirely on a lossy link; this sheds whole frames.
            .congestion_control(CongestionControl::BlockFirst)
            .await
            .map_err(|cause| anyhow!("declaring a publisher on {key}: {cause}"))
    }

    /// A subscriber to the frames of the keys that match.
    ///
    /// # Errors
    /// When the session is closed.
    pub async fn frame_subscriber(
        &self,
        topic: Topic<FrameHeader>,
        names: &[&str],
    ) -> anyhow::Result<FrameSubscriber> {
        let key = topic.key(names);
        // Over the air frames come by two lanes, and an older one may be the later: it must not push out the newer one.
        let waiting = if key == topic::JPEG.key(names) { LANES } else { 1 };
        let subscriber = self
            .session
            .declare_subscriber(key.clone())
            .with(RingChannel::new(waiting))
            .await
            .map_err(|cause| anyhow!("subscribing to {key}: {cause}"))?;
        Ok(FrameSubscriber { subscriber, health: self.shared_health() })
    }
}

impl Pool {
    fn new(bytes: usize) -> Option<Self> {
        match ShmProviderBuilder::default_backend(bytes).wait() {
            Ok(provider) => {
                Some(Self { provider, bytes, full_since: None, refusals: 0, predecessors: 0 })
            }
            Err(cause) => {
                tracing::warn!(bytes, %cause, "No shared memory: frames are copied instead");
                None
            }
        }
    }

    fn alloc(&mut self, len: usize) -> Option<ZShmMut> {
        let buffer = self.provider.alloc(len).with_policy::<GarbageCollect>().wait().ok();
        if buffer.is_some() || len > self.bytes {
            (self.full_since, self.refusals) = (None, 0);
            return buffer;
        }
        let since = *self.full_since.get_or_insert_with(Instant::now);
        self.refusals = self.refusals.saturating_add(1);
        let is_given_up =
            since.elapsed() >= POOL_GIVEN_UP && self.refusals > REFUSALS_BEFORE_GIVEN_UP;
        if !is_given_up || self.predecessors == MOST_NEW_POOLS || !self.may_have_successor() {
            return None;
        }
        tracing::info!(
            "Readers that are gone keep all frames in shared memory: there is new memory"
        );
        let predecessors = self.predecessors + 1;
        // Tried no more often than it is needed, also when it cannot be had.
        (self.full_since, self.refusals, self.predecessors) = (None, 0, predecessors);
        *self = Self { predecessors, ..Self::new(self.bytes)? };
        self.provider.alloc(len).with_policy::<GarbageCollect>().wait().ok()
    }

    /// Whether readers may lock one more pool beside those they keep, and as much again for what else they lock. One that
    /// may not would get no frames at all; without a new pool they are copied. Readers are taken to have this process' limit.
    fn may_have_successor(&self) -> bool {
        let pools = u64::from(self.predecessors) + 2;
        let needed = (pools + 1).saturating_mul(self.bytes as u64);
        getrlimit(Resource::Memlock).current.is_none_or(|limit| limit >= needed)
    }
}

impl FramePublisher {
    /// A buffer of `len` bytes to write a frame into.
    pub fn loan(&self, len: usize) -> Loan {
        let shared = self
            .pool
            .as_ref()
            .and_then(|pool| pool.lock().unwrap_or_else(PoisonError::into_inner).alloc(len));
        match shared {
            Some(buffer) => Loan::Shared(buffer),
            None => {
                self.health.dropped("shared memory full, frame copied");
                Loan::Private(vec![0; len])
            }
        }
    }

    /// Publishes a frame that was written into its loan.
    pub async fn publish(&self, header: &FrameHeader, frame: Loan) {
        let payload: ZBytes = match frame {
            Loan::Shared(buffer) => buffer.into(),
            Loan::Private(buffer) => buffer.into(),
        };
        match self.publisher.put(payload).attachment(encode(header)).await {
            Ok(()) => self.health.count(match header.format {
                PixelFormat::Jpeg => "JPEG images",
                _ => "frames",
            }),
            Err(cause) => {
                if self.health.failed("publish frame") {
                    tracing::warn!(%cause, "A frame could not be published");
                }
            }
        }
    }

    /// The same key on the second connection that frames have over the air: what is published there does not wait
    /// behind a frame that the first one has not delivered yet. It has no shared memory.
    ///
    /// # Errors
    /// When the session is closed.
    pub async fn second_lane(&self, node: &Node) -> anyhow::Result<Self> {
        let key = self.publisher.key_expr().as_str().to_owned();
        let publisher = node.declare_frames(key, SECOND_LANE).await?;
        Ok(Self { publisher, pool: None, health: Arc::clone(&self.health) })
    }

    /// True while somebody subscribes: what is costly to make is made only then.
    pub async fn has_subscribers(&self) -> bool {
        self.publisher.matching_status().await.is_ok_and(|status| status.matching())
    }
}

impl Deref for Loan {
    type Target = [u8];
    fn deref(&self) -> &[u8] {
        match self {
            Self::Shared(buffer) => buffer,
            Self::Private(buffer) => buffer,
        }
    }
}

impl DerefMut for Loan {
    fn deref_mut(&mut self) -> &mut [u8] {
        match self {
            Self::Shared(buffer) => buffer,
            Self::Private(buffer) => buffer,
        }
    }
}

impl Frame {
    /// The payload's bytes, where they lie.
    pub fn bytes(&self) -> Cow<'_, [u8]> {
        self.payload.to_bytes()
    }
}

impl FrameSubscriber {
    /// The newest frame, of frames over the air one of the newest two; `None` once the session is closed. A frame whose header cannot be read, or whose bytes do
    /// not fit its header, is counted and logged once.
    pub async fn next(&self) -> Option<Frame> {
        loop {
            let sample = self.subscriber.recv_async().await.ok()?;
            if let Some(frame) = self.frame(&sample) {
                return Some(frame);
            }
        }
    }

    /// A frame that has come already; `None` when none waits.
    pub fn waiting(&self) -> Option<Frame> {
        let sample = self.subscriber.try_recv().ok().flatten()?;
        self.frame(&sample)
    }

    fn frame(&self, sample: &Sample) -> Option<Frame> {
        let attachment = sample.attachment().map(|a| a.to_bytes()).unwrap_or_default();
        match decode::<FrameHeader>(&attachment) {
            Err(problem) => {
                report_refused(&self.health, sample.key_expr().as_str(), &problem);
                None
            }
            Ok(header) if !fits(&header, sample.payload().len()) => {
                if self.health.failed("frame of the wrong length") {
                    tracing::warn!(
                        ?header,
                        len = sample.payload().len(),
                        "A frame was refused: its bytes do not fit its header"
                    );
                }
                None
            }
            Ok(header) => Some(Frame { header, payload: sample.payload().clone() }),
        }
    }
}

fn fits(header: &FrameHeader, len: usize) -> bool {
    let pixels = u64::from(header.width) * u64::from(header.height);
    match header.format.bytes_per_pixel() {
        Some(bytes) => pixels > 0 && pixels.checked_mul(bytes as u64) == Some(len as u64),
        None => len > 0,
    }
}
