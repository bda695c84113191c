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
            .spawn(move || node::block_on(&runtime, work.run()))
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
    async fn run(mut self) {
        let mut ticks = tokio::time::interval(TICK);
        ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        let mut checked = Instant::now();
        loop {
            tokio::select! {
                // The end of the service first: the runtime's clock ends after it, and must not be used after that.
                biased;
                changed = self.offers.changed() => {
                    if changed.is_err() {
                        return;
                    }
                    let offer = self.offers.borrow_and_update().clone();
                    if let Some(offer) = offer {
                        self.publish(&offer).await;
                    }
                    // Frames may come faster than they are rectified.
                    if checked.elapsed() < TICK {
                        continue;
                    }
                }
                _ = ticks.tick() => {}
            }
            let is_wanted = self.frames.has_subscribers().await;
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
            self.health.failed("rectified frame of another size than the calibration's");
            return;
        }
        self.health.latency("rectify", began.elapsed());
        let header = FrameHeader { format: PixelFormat::Mono8, ..offer.header.clone() };
        self.frames.publish(&header, pixels).await;
    }
}
