//! Publishes a camera's frames in shared memory without a copy (loaned buffers, header attached), and
//! receives them, always the latest, with header and length checked.
//!
//! On one host a frame is never copied between camera and detector: the camera borrows a buffer
//! ([`FramePublisher::loan`]), writes into it and publishes it; a subscriber reads the same memory. Without
//! shared memory the buffer is ordinary memory, which Zenoh copies; this is counted.

use std::borrow::Cow;
use std::ops::{Deref, DerefMut};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::anyhow;
use messages::{Delivery, FrameHeader, PixelFormat, Topic, decode, encode, topic};
use rustix::process::{Resource, getrlimit};
use zenoh::Wait;
use zenoh::bytes::ZBytes;
use zenoh::handlers::RingChannel;
use zenoh::key_expr::KeyExpr;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::sample::Sample;
use zenoh::shm::{
    GarbageCollect, PosixShmProviderBackend, ShmProvider, ShmProviderBuilder, ZShmMut,
};

use crate::boxed::BoxFuture;
use crate::health::HealthCounters;
use crate::session::Node;
use crate::topics::{SampleMailbox, is_closed, report_refused};

/// Capacity of the shared memory pool, in frames: one being written, one in flight, and one each for two slow
/// readers. Small, because every subscriber keeps the complete pool mapped and locked.
const FRAMES_IN_POOL: usize = 4;

/// A pool that is exhausted for this time is replaced: a reader that was killed never returns its frames.
/// Longer than any reader keeps a frame.
const POOL_EXHAUSTED_TIMEOUT: Duration = Duration::from_secs(1);
/// Minimum failed allocations, in addition, before a pool is replaced: at a low frame rate the time alone proves
/// little.
const MIN_FAILED_ALLOCATIONS: u32 = 4;
/// Maximum number of replacement pools of a publisher, as readers keep the old ones mapped.
const MAX_NEW_POOLS: u32 = 3;

/// The error of frames whose length is not that of their header.
pub const WRONG_LENGTH: &str = "frame of the wrong length";

/// On the air link each priority has a separate connection (`zenoh-config/README.md`); frames use these
/// two.
const FIRST_PRIORITY: Priority = Priority::DataLow;
const SECOND_PRIORITY: Priority = Priority::Background;
const FRAME_CONNECTIONS: usize = 2;

/// Publishes frames on one key.
pub struct FramePublisher {
    publisher: zenoh::pubsub::Publisher<'static>,
    pool: Option<Mutex<Pool>>,
    /// The name under which its frames are counted, except JPEG.
    counted: &'static str,
    health: Arc<HealthCounters>,
}

/// Shared memory for a few frames.
struct Pool {
    provider: ShmProvider<PosixShmProviderBackend>,
    bytes: usize,
    /// Since when allocations fail, and how many have failed.
    exhausted_since: Option<Instant>,
    failed_allocations: u32,
    /// Number of pools that were replaced before.
    replaced_pools: u32,
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
    key: KeyExpr<'static>,
    payload: ZBytes,
}

/// Receives frames, always the latest.
pub struct FrameSubscriber {
    subscriber: SampleMailbox,
    health: Arc<HealthCounters>,
}

impl Node {
    /// A publisher of frames of at most `max_frame_bytes`; with 0 it has no shared memory.
    ///
    /// # Errors
    /// When the session is closed or a name makes no key.
    pub fn frame_publisher<'a>(
        &'a self,
        topic: Topic<FrameHeader>,
        names: &'a [&'a str],
        max_frame_bytes: usize,
    ) -> BoxFuture<'a, anyhow::Result<FramePublisher>> {
        Box::pin(async move {
            let key = topic.key(names);
            debug_assert_eq!(topic.delivery(), Delivery::Latest);
            let is_rectified = key == topic::RECT.key(names);
            let counted = if is_rectified { "rectified frames" } else { "frames" };
            let publisher = self.declare_frames(key, FIRST_PRIORITY).await?;
            let health = self.shared_health();
            if max_frame_bytes == 0 || !self.has_shared_memory {
                return Ok(FramePublisher { publisher, pool: None, counted, health });
            }
            let pool_bytes = FRAMES_IN_POOL * max_frame_bytes.next_multiple_of(4096) + 4096;
            let pool = Pool::new(pool_bytes).map(Mutex::new);
            Ok(FramePublisher { publisher, pool, counted, health })
        })
    }

    async fn declare_frames(
        &self,
        key: String,
        priority: Priority,
    ) -> anyhow::Result<zenoh::pubsub::Publisher<'static>> {
        self.session
            .declare_publisher(key.clone())
            .priority(priority)
            // `Drop` would lose almost all large frames on a lossy link; this drops complete frames.
            .congestion_control(CongestionControl::BlockFirst)
            .await
            .map_err(|cause| anyhow!("declaring a publisher on {key}: {cause}"))
    }

    /// A subscriber to the frames of the keys that match.
    ///
    /// # Errors
    /// When the session is closed.
    pub fn frame_subscriber<'a>(
        &'a self,
        topic: Topic<FrameHeader>,
        names: &'a [&'a str],
    ) -> BoxFuture<'a, anyhow::Result<FrameSubscriber>> {
        Box::pin(async move {
            let key = topic.key(names);
            // On the air link an older frame can arrive after a newer one and must not displace it.
            let capacity = if key == topic::JPEG.key(names) { FRAME_CONNECTIONS } else { 1 };
            let subscriber = self
                .session
                .declare_subscriber(key.clone())
                .with(RingChannel::new(capacity))
                .await
                .map_err(|cause| anyhow!("subscribing to {key}: {cause}"))?;
            Ok(FrameSubscriber { subscriber, health: self.shared_health() })
        })
    }
}

impl Pool {
    fn new(bytes: usize) -> Option<Self> {
        match ShmProviderBuilder::default_backend(bytes).wait() {
            Ok(provider) => Some(Self {
                provider,
                bytes,
                exhausted_since: None,
                failed_allocations: 0,
                replaced_pools: 0,
            }),
            Err(cause) => {
                tracing::warn!(bytes, %cause, "No shared memory; frames are copied instead");
                None
            }
        }
    }

    fn alloc(&mut self, len: usize) -> Option<ZShmMut> {
        let buffer = self.provider.alloc(len).with_policy::<GarbageCollect>().wait().ok();
        if buffer.is_some() || len > self.bytes {
            (self.exhausted_since, self.failed_allocations) = (None, 0);
            return buffer;
        }
        let since = *self.exhausted_since.get_or_insert_with(Instant::now);
        self.failed_allocations = self.failed_allocations.saturating_add(1);
        let is_abandoned = since.elapsed() >= POOL_EXHAUSTED_TIMEOUT
            && self.failed_allocations > MIN_FAILED_ALLOCATIONS;
        if !is_abandoned || self.replaced_pools == MAX_NEW_POOLS || !self.is_replaceable() {
            return None;
        }
        tracing::info!("Shared-memory pool exhausted by dead readers; allocated a new pool");
        let replaced_pools = self.replaced_pools + 1;
        // Counted also when there is no memory for a new pool, so that it is not tried again at once.
        (self.exhausted_since, self.failed_allocations) = (None, 0);
        self.replaced_pools = replaced_pools;
        *self = Self { replaced_pools, ..Self::new(self.bytes)? };
        self.provider.alloc(len).with_policy::<GarbageCollect>().wait().ok()
    }

    /// Whether readers may lock one more pool in addition to those they keep, and as much again for other locked
    /// memory: a reader beyond its limit would get no frames, while without a new pool they are copied.
    /// Readers are assumed to have the limit of this process.
    fn is_replaceable(&self) -> bool {
        let pools = u64::from(self.replaced_pools) + 2;
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
    pub fn publish<'a>(&'a self, header: &'a FrameHeader, frame: Loan) -> BoxFuture<'a, ()> {
        Box::pin(async move {
            let payload: ZBytes = match frame {
                Loan::Shared(buffer) => buffer.into(),
                Loan::Private(buffer) => buffer.into(),
            };
            match self.publisher.put(payload).attachment(encode(header)).await {
                Ok(()) => self.health.count(match header.format {
                    PixelFormat::Jpeg => "JPEG images",
                    _ => self.counted,
                }),
                Err(cause) => {
                    if !is_closed(&cause) && self.health.failed("publish frame") {
                        tracing::warn!(%cause, "Frame not published");
                    }
                }
            }
        })
    }

    /// A publisher on the same key that uses the second connection for frames on the air link: its frames do
    /// not wait behind one that the first connection has not delivered yet. It has no shared memory.
    ///
    /// # Errors
    /// When the session is closed.
    pub fn second_publisher<'a>(&'a self, node: &'a Node) -> BoxFuture<'a, anyhow::Result<Self>> {
        Box::pin(async move {
            let key = self.publisher.key_expr().as_str().to_owned();
            let publisher = node.declare_frames(key, SECOND_PRIORITY).await?;
            let (counted, health) = (self.counted, Arc::clone(&self.health));
            Ok(Self { publisher, pool: None, counted, health })
        })
    }

    /// Whether there is a subscriber; images that are expensive to make are made only then.
    pub fn has_subscribers(&self) -> BoxFuture<'_, bool> {
        Box::pin(async move {
            self.publisher.matching_status().await.is_ok_and(|status| status.matching())
        })
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
    /// The key on which it was published.
    pub fn key(&self) -> &str {
        self.key.as_str()
    }

    /// The payload's bytes, without a copy.
    pub fn bytes(&self) -> Cow<'_, [u8]> {
        self.payload.to_bytes()
    }
}

impl FrameSubscriber {
    /// The latest frame, or one of the latest two on the air link; `None` once the session is closed. A frame
    /// with an invalid header, or with a length that does not match its header, is counted, and logged once.
    pub fn next(&self) -> BoxFuture<'_, Option<Frame>> {
        Box::pin(async move {
            loop {
                let sample = self.subscriber.recv_async().await.ok()?;
                if let Some(frame) = self.frame(&sample) {
                    return Some(frame);
                }
            }
        })
    }

    /// A frame that has arrived already, without waiting.
    pub fn waiting(&self) -> Option<Frame> {
        let sample = self.subscriber.try_recv().ok().flatten()?;
        self.frame(&sample)
    }

    fn frame(&self, sample: &Sample) -> Option<Frame> {
        let attachment = sample.attachment().map(|a| a.to_bytes()).unwrap_or_default();
        match decode::<FrameHeader>(&attachment) {
            Err(problem) => {
                let key = sample.key_expr().as_str();
                report_refused(&self.health, key, attachment.len(), &problem);
                None
            }
            Ok(header) if !has_length(&header, sample.payload().len()) => {
                let text = wrong_length(&header, sample.payload().len());
                if self.health.failed_by(WRONG_LENGTH, text.clone()) {
                    let camera = &header.camera;
                    tracing::warn!(
                        "A frame of camera `{camera}` is rejected: {text} (further ones are counted)"
                    );
                }
                None
            }
            Ok(header) => {
                let (key, payload) = (sample.key_expr().clone(), sample.payload().clone());
                Some(Frame { header, key, payload })
            }
        }
    }
}

/// How the length of a frame differs from that of its header, with the remedy where the numbers suggest one.
fn wrong_length(header: &FrameHeader, len: usize) -> String {
    let FrameHeader { width, height, format, .. } = *header;
    let (pixels, len) = (u64::from(width) * u64::from(height), len as u64);
    let Some(bytes) = format.bytes_per_pixel().filter(|_| pixels > 0) else {
        return format!("{len} bytes for {width} x {height} pixels of {format:?}");
    };
    let expected = pixels.saturating_mul(bytes as u64);
    let remedy = match (len, len % u64::from(height)) {
        _ if len == pixels.saturating_mul(3) || len == pixels.saturating_mul(4) => {
            "; three or four bytes per pixel are a colour image: convert it to grey"
        }
        _ if len.saturating_mul(2) == pixels.saturating_mul(3) => {
            "; one and a half bytes per pixel are I420 or NV12: send the first width x height bytes only, which are its grey image"
        }
        _ if len == pixels.saturating_mul(2) => {
            "; two bytes per pixel are more than 8 bits, for which `format` is set (`Mono16`), or colour (YUYV): of that send every other byte,              the grey ones"
        }
        (_, 0) if len > expected => "; rows have padding: copy them without it",
        _ => "",
    };
    format!("{len} bytes, expected {expected} ({width} x {height} pixels of {format:?}){remedy}")
}

fn has_length(header: &FrameHeader, len: usize) -> bool {
    let pixels = u64::from(header.width) * u64::from(header.height);
    match header.format.bytes_per_pixel() {
        Some(bytes) => pixels > 0 && pixels.checked_mul(bytes as u64) == Some(len as u64),
        None => len > 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wrong_length_is_reported_with_numbers_and_the_remedy_that_they_suggest() {
        let header = FrameHeader { width: 1000, height: 760, ..FrameHeader::sample() };
        let text = |len| wrong_length(&header, len);
        assert_eq!(
            text(2_280_000),
            "2280000 bytes, expected 760000 (1000 x 760 pixels of Mono8); three or four bytes per pixel are a colour image: convert it to grey"
        );
        assert!(text(1_520_000).contains("`format` is set (`Mono16`), or"), "{}", text(1_520_000));
        assert!(text(1_140_000).contains("I420 or NV12"), "{}", text(1_140_000));
        let huge = FrameHeader { width: u32::MAX, height: u32::MAX, ..FrameHeader::sample() };
        assert!(wrong_length(&huge, 5).starts_with("5 bytes, expected"));
        assert!(text(1024 * 760).ends_with("rows have padding: copy them without it"));
        assert!(text(759_000).ends_with("(1000 x 760 pixels of Mono8)"), "{}", text(759_000));
        assert!(
            wrong_length(&FrameHeader { width: 0, ..header }, 5).starts_with("5 bytes for 0 x")
        );
    }
}
