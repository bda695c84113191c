//! Runs the camera's side: takes offered frames and sends those that the link has room for.
//!
//! Its thread, named `air`, does all the work, so that a slow link never blocks the camera or the frames in
//! shared memory. A frame is copied only when it will be sent. This is the only module with a thread, a clock
//! and the network.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Context;
use imaging::GrayView;
use messages::{ControllerStatus, Detections, FrameAck, FrameHeader, topic};
use node::{FramePublisher, HealthCounters, Loan, Node, Subscriber, now_ns};
use tokio::runtime::Handle;
use tokio::sync::Notify;

use crate::config::{AirConfig, Mode};
use crate::payload::Packer;
use crate::plan::{FrameSize, Planner};
use crate::prediction::RoiPredictor;
use crate::window::Window;

/// Interval of the checks for subscribers and overdue frames.
const TICK: Duration = Duration::from_millis(10);

/// Sends frames over the air link; dropping it ends its thread.
pub struct AirSender {
    offers: Arc<Offers>,
}

/// Hands at most one frame from the camera's thread to this one.
#[derive(Default)]
struct Offers {
    is_wanted: AtomicBool,
    is_over: AtomicBool,
    newest: Mutex<Option<Offer>>,
    arrived: Notify,
}

struct Offer {
    header: FrameHeader,
    pixels: Vec<u8>,
}

impl AirSender {
    /// Starts to send on `jpegs`, a camera's publisher for `camera/{camera}/jpeg`.
    ///
    /// # Errors
    /// When the session is closed or the thread cannot be started.
    pub async fn start(
        node: &Node,
        camera: &str,
        jpegs: FramePublisher,
        config: &AirConfig,
    ) -> anyhow::Result<Self> {
        let detections = match config.mode {
            Mode::Roi => Some(node.subscriber(topic::DETECTIONS, &[]).await?),
            Mode::Full => None,
        };
        let offers = Arc::<Offers>::default();
        let mut work = Work {
            camera: camera.to_owned(),
            offers: Arc::clone(&offers),
            second_lane: jpegs.second_publisher(node).await?,
            jpegs,
            acks: node.subscriber(topic::FRAME_ACK, &[]).await?,
            detections,
            status: node.subscriber(topic::STATUS, &[]).await?,
            health: node.shared_health(),
            window: Window::new(config),
            planner: Planner::new(config),
            predictor: RoiPredictor::default(),
            packer: Packer::default(),
            has_subscribers: false,
        };
        let runtime = Handle::current();
        std::thread::Builder::new()
            .name("air".to_owned())
            .spawn(move || work.run(&runtime))
            .context("starting the air link's thread")?;
        Ok(Self { offers })
    }

    /// True when the next frame will be sent.
    pub fn is_wanted(&self) -> bool {
        self.offers.is_wanted.load(Ordering::Relaxed)
    }

    /// Offers a frame with its 8-bit grey pixels. An unwanted frame costs nothing.
    pub fn offer(&self, header: &FrameHeader, pixels: &[u8]) {
        if !self.is_wanted() {
            return;
        }
        let mut newest = lock(&self.offers.newest);
        let mut buffer = newest.take().map(|offer| offer.pixels).unwrap_or_default();
        buffer.clear();
        buffer.extend_from_slice(pixels);
        *newest = Some(Offer { header: header.clone(), pixels: buffer });
        drop(newest);
        self.offers.arrived.notify_one();
    }
}

impl Drop for AirSender {
    fn drop(&mut self) {
        self.offers.is_over.store(true, Ordering::Relaxed);
        self.offers.arrived.notify_one();
    }
}

// The frame stays valid when another thread panicked.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The state of the thread.
struct Work {
    camera: String,
    offers: Arc<Offers>,
    jpegs: FramePublisher,
    second_lane: FramePublisher,
    acks: Subscriber<FrameAck>,
    detections: Option<Subscriber<Detections>>,
    /// Names the detector in use, and the marker of the landing.
    status: Subscriber<ControllerStatus>,
    health: Arc<HealthCounters>,
    window: Window,
    planner: Planner,
    predictor: RoiPredictor,
    packer: Packer,
    has_subscribers: bool,
}

/// An event for the thread.
enum Event {
    /// The key, which names the detector, and the acknowledgement.
    Ack(String, FrameAck),
    Detections(Box<Detections>),
    Status(Box<ControllerStatus>),
    Frame,
    Tick,
    Closed,
}

impl Work {
    /// Runs until the sender is dropped, which may be after the runtime's end.
    fn run(&mut self, runtime: &Handle) {
        let mut ticked = Instant::now();
        while !self.offers.is_over.load(Ordering::Relaxed) {
            let left = TICK.saturating_sub(ticked.elapsed());
            let event = node::block_on_for(runtime, left, self.next_event());
            match event.unwrap_or(Event::Tick) {
                Event::Ack(key, ack) => self.ack(&key, &ack),
                Event::Detections(message) if message.header.camera == self.camera => {
                    self.predictor.update(&message);
                }
                Event::Detections(_) => {}
                Event::Status(status) => {
                    let key = |detector: &String| topic::FRAME_ACK.key(&[detector]);
                    self.window.use_receiver(status.active_detector.as_ref().map(key));
                    self.predictor.follow(&status);
                }
                Event::Frame => node::block_on(runtime, self.send()),
                Event::Tick => {
                    self.has_subscribers = node::block_on(runtime, self.jpegs.has_subscribers());
                    ticked = Instant::now();
                }
                Event::Closed => return,
            }
            let is_wanted = self.is_open() && self.has_subscribers;
            self.offers.is_wanted.store(is_wanted, Ordering::Relaxed);
        }
    }

    /// The next message or frame.
    async fn next_event(&self) -> Event {
        tokio::select! {
            biased;
            ack = self.acks.next_with_key() => {
                ack.map_or(Event::Closed, |(key, ack)| Event::Ack(key, ack))
            }
            message = next_of(self.detections.as_ref()) => {
                message.map_or(Event::Closed, |message| Event::Detections(Box::new(message)))
            }
            message = self.status.next() => {
                message.map_or(Event::Closed, |message| Event::Status(Box::new(message)))
            }
            () = self.offers.arrived.notified() => Event::Frame,
        }
    }

    /// Whether the link has room for a frame.
    fn is_open(&mut self) -> bool {
        let (is_open, lost) = self.window.is_open(now_ns());
        if lost > 0 {
            let reason = "air link frames without an acknowledgement in time";
            self.health.dropped_times(reason, lost as u64);
        }
        is_open
    }

    fn ack(&mut self, detector: &str, ack: &FrameAck) {
        if ack.camera != self.camera {
            return;
        }
        let took_ms = self.window.received(now_ns(), detector, ack.sequence);
        match took_ms {
            Some(ms) => {
                self.health
                    .latency("frame sent to ack", Duration::from_secs_f64(ms.max(0.0) * 1e-3));
            }
            None => self.health.dropped("acknowledgements of unknown frames"),
        }
    }

    async fn send(&mut self) {
        let Some(Offer { header, pixels }) = lock(&self.offers.newest).take() else { return };
        // One that was offered while the last one was compressed would queue behind it.
        if !self.is_open() {
            return;
        }
        let started = Instant::now();
        let Ok(view) = GrayView::packed(&pixels, header.width as usize, header.height as usize)
        else {
            self.health.dropped("frames of an invalid size");
            return;
        };
        let roi = self.predictor.roi(header.stamp_ns);
        let size = FrameSize { width: header.width, height: header.height };
        let plan = self.planner.plan(size, roi, self.window.size_bytes());
        match self.packer.pack(view, &header, &plan) {
            Ok((header, bytes)) => {
                self.health.latency("jpeg", started.elapsed());
                self.planner.learn(&plan, &header, bytes.len());
                self.window.sent(now_ns(), header.sequence, bytes.len());
                tracing::trace!(bytes = bytes.len(), ?plan, "Sending a frame over the air link");
                let lane = if self.window.lane() == 0 { &self.jpegs } else { &self.second_lane };
                lane.publish(&header, Loan::Private(bytes)).await;
            }
            Err(problem) => {
                if self.health.failed("jpeg") {
                    tracing::warn!(%problem, "Failed to encode a frame for the air link");
                }
            }
        }
    }
}

async fn next_of(detections: Option<&Subscriber<Detections>>) -> Option<Detections> {
    match detections {
        Some(detections) => detections.next().await,
        None => std::future::pending().await,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use node::{Identity, ZenohSource};

    const TIME_LIMIT: Duration = Duration::from_secs(20);

    #[tokio::test(flavor = "multi_thread")]
    async fn the_thread_of_the_air_link_outlives_its_runtime_without_a_panic() {
        let text = include_str!("../../../zenoh-config/local.json5");
        let ([port], _, _) = testing::ports::free().unwrap();
        let local = ZenohSource::Text(text.replace(":7447", &format!(":{port}")));
        let identity = Identity { service: "camera-pub", instance: "down".into() };
        let node = Node::open(identity, &local).await.unwrap();
        let jpegs = node.frame_publisher(topic::JPEG, &["down"], 0).await.unwrap();
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
        let config = AirConfig {
            mode: Mode::Full,
            quality: 95,
            min_quality: 65,
            max_kb: 150.0,
            min_kb: 5.0,
            round_trip_ms: 80.0,
            window: 2,
            timeout_ms: 300.0,
        };
        let start = AirSender::start(&node, "down", jpegs, &config);
        let air = node::block_on(runtime.handle(), start).unwrap();
        runtime.shutdown_background();
        tokio::time::sleep(10 * TICK).await;
        // A thread that has panicked would not see a subscriber.
        let subscriber = node.frame_subscriber(topic::JPEG, &["down"]).await.unwrap();
        let is_wanted = async || air.is_wanted();
        testing::until("the subscriber is seen", TIME_LIMIT, is_wanted).await.unwrap();
        drop((air, subscriber));
        node.close().await;
    }
}
