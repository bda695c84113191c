//! Publishes rectified frames, `camera/{camera}/rect`, while there is a subscriber. A separate thread makes them, so that
//! other subscribers do not wait.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context;
use geometry::CameraModel;
use imaging::GrayView;
use media::Rectifier;
use messages::{FrameHeader, PixelFormat, topic};
use node::{FramePublisher, HealthCounters, Loan, Node};
use tokio::runtime::Handle;
use tokio::sync::watch;

/// Interval of the checks for subscribers.
const TICK: Duration = Duration::from_millis(100);

/// Publishes rectified frames; dropping it ends its thread.
pub(crate) struct RectPublisher {
    is_wanted: Arc<AtomicBool>,
    newest: watch::Sender<Option<Arc<Offer>>>,
}

/// A frame as the camera took it, in grey.
struct Offer {
    header: FrameHeader,
    pixels: Vec<u8>,
}

impl RectPublisher {
    /// For the frames of a camera; `None` is one without a calibration, which is not rectified.
    ///
    /// # Errors
    /// When the session is closed or the thread cannot be started.
    pub(crate) async fn start(
        node: &Node,
        name: &str,
        camera: Option<CameraModel>,
    ) -> anyhow::Result<Self> {
        let (newest, offers) = watch::channel(None);
        let is_wanted = Arc::<AtomicBool>::default();
        let work = Work {
            // Without shared memory: subscribers may be on any machine, and there may be none for the whole flight.
            frames: node.frame_publisher(topic::RECT, &[name], 0).await?,
            camera,
            rectifier: None,
            offers,
            is_wanted: Arc::clone(&is_wanted),
            health: node.shared_health(),
        };
        let runtime = Handle::current();
        std::thread::Builder::new()
            .name("rect".to_owned())
            .spawn(move || work.run(&runtime))
            .context("starting the thread that rectifies frames")?;
        Ok(Self { is_wanted, newest })
    }

    /// True while there is a subscriber.
    pub(crate) fn is_wanted(&self) -> bool {
        self.is_wanted.load(Ordering::Relaxed)
    }

    /// Offers a frame with its 8-bit grey pixels; it takes the place of one that waits. An unwanted frame costs nothing.
    pub(crate) fn offer(&self, header: &FrameHeader, pixels: &[u8]) {
        if self.is_wanted() {
            let offer = Offer { header: header.clone(), pixels: pixels.to_vec() };
            self.newest.send_replace(Some(Arc::new(offer)));
        }
    }
}

/// The state of the thread.
struct Work {
    frames: FramePublisher,
    camera: Option<CameraModel>,
    /// Made when the first frame is wanted.
    rectifier: Option<Rectifier>,
    offers: watch::Receiver<Option<Arc<Offer>>>,
    is_wanted: Arc<AtomicBool>,
    health: Arc<HealthCounters>,
}

impl Work {
    /// Runs until the publisher is dropped, which may be after the runtime's end.
    fn run(mut self, runtime: &Handle) {
        let mut checked = Instant::now();
        loop {
            let left = TICK.saturating_sub(checked.elapsed());
            match node::block_on_for(runtime, left, self.offers.changed()) {
                Some(Err(_dropped)) => return,
                Some(Ok(())) => {
                    let offer = self.offers.borrow_and_update().clone();
                    if let Some(offer) = offer {
                        node::block_on(runtime, self.publish(&offer));
                    }
                    // Frames may come faster than they are rectified.
                    if checked.elapsed() < TICK {
                        continue;
                    }
                }
                None => {}
            }
            let is_wanted = node::block_on(runtime, self.frames.has_subscribers());
            self.is_wanted.store(is_wanted, Ordering::Relaxed);
            checked = Instant::now();
        }
    }

    async fn publish(&mut self, offer: &Offer) {
        let Some(camera) = &self.camera else {
            if self.health.failed("rectified frame wanted without a calibration") {
                tracing::warn!(
                    "A client subscribes to rectified frames, and this camera has no calibration: set `calibration.file`"
                );
            }
            return;
        };
        let began = Instant::now();
        let rectifier = self.rectifier.get_or_insert_with(|| Rectifier::new(camera));
        let [width, height] = [offer.header.width, offer.header.height].map(|edge| edge as usize);
        let mut pixels = Loan::Private(vec![0; offer.pixels.len()]);
        let is_rectified = GrayView::packed(&offer.pixels, width, height)
            .is_ok_and(|view| rectifier.rectify(view, &mut pixels));
        if !is_rectified {
            if self.health.failed("rectified frame of another size than the calibration's") {
                tracing::warn!(
                    width,
                    height,
                    "A frame is not rectified: `calibration.file` is for another size, or its pixels are incomplete (further ones are only counted)"
                );
            }
            return;
        }
        self.health.latency("rectify", began.elapsed());
        let header = FrameHeader { format: PixelFormat::Mono8, ..offer.header.clone() };
        self.frames.publish(&header, pixels).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use node::{Identity, ZenohSource};

    const TIME_LIMIT: Duration = Duration::from_secs(20);

    #[tokio::test(flavor = "multi_thread")]
    async fn the_thread_that_rectifies_frames_outlives_its_runtime_without_a_panic() {
        let text = include_str!("../../zenoh-config/local.json5");
        let ([port], _, _) = testing::ports::free().unwrap();
        let local = ZenohSource::Text(text.replace(":7447", &format!(":{port}")));
        let identity = Identity { service: "camera-pub", instance: "down".into() };
        let node = Node::open(identity, &local).await.unwrap();
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
        let start = RectPublisher::start(&node, "down", None);
        let rect = node::block_on(runtime.handle(), start).unwrap();
        runtime.shutdown_background();
        tokio::time::sleep(3 * TICK).await;
        // A thread that has panicked would not see a subscriber.
        let subscriber = node.frame_subscriber(topic::RECT, &["down"]).await.unwrap();
        let is_wanted = async || rect.is_wanted();
        testing::until("the subscriber is seen", TIME_LIMIT, is_wanted).await.unwrap();
        drop((rect, subscriber));
        node.close().await;
    }
}
