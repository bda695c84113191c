//! The service: newest frame in, detections out.
//!
//! The image work runs on one thread of its own, named `detect`, so that no message ever waits for it. The thread
//! takes a frame only when it is free, and its mailbox keeps only the newest.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Context;
use fiducial::debug::{self, RgbImageBuf};
use fiducial::{Detector, Settings, Stages};
use geometry::CameraModel;
use imaging::GrayView;
use messages::{CameraInfo, Detections, FrameHeader, PixelFormat, StageTime, topic};
use node::{Frame, FramePublisher, FrameSubscriber, Loan, Node, Publisher, Shutdown, now_ns};
use tokio::runtime::Handle;
use tokio::sync::oneshot;

use crate::config::Config;
use crate::wire;

/// The thesis' three debug images, as the topics name them.
const DEBUG_IMAGES: [&str; 3] = ["ellipses", "rings", "target"];

/// Runs the service until it is asked to stop.
///
/// # Errors
/// When another detector has the same name, or the network fails.
pub async fn run(node: Node, config: Config, shutdown: Shutdown) -> anyhow::Result<()> {
    node.ensure_alone(&config.id).await?;
    let camera = Arc::new(Mutex::new(None));
    let infos = node.subscriber(topic::CAMERA_INFO, &[&config.camera]).await?;
    let work = Work::new(&node, &config, Arc::clone(&camera)).await?;
    let (stopped, thread) = work.start()?;
    node.announce().await?;
    let follow_camera = async {
        while let Some(info) = infos.next().await {
            *camera.lock().unwrap_or_else(PoisonError::into_inner) = Some(info);
        }
    };
    tokio::select! {
        () = shutdown.requested() => {}
        () = follow_camera => {}
        _ = stopped => anyhow::bail!("the detection thread ended"),
    }
    drop(thread);
    Ok(())
}

/// Everything the image thread needs.
struct Work {
    node: Node,
    frames: FrameSubscriber,
    detections: Publisher<Detections>,
    debug: Vec<(&'static str, FramePublisher)>,
    camera: Arc<Mutex<Option<CameraInfo>>>,
    detector: Detector,
    id: String,
    debug_jpeg_quality: u8,
    overlay: RgbImageBuf,
}

impl Work {
    async fn new(
        node: &Node,
        config: &Config,
        camera: Arc<Mutex<Option<CameraInfo>>>,
    ) -> anyhow::Result<Self> {
        let markers = config.parsed_markers().map_err(anyhow::Error::msg)?;
        let settings = Settings { thesis_threshold: config.thesis_threshold };
        let detector = Detector::new(&markers, settings).context("setting the markers up")?;
        let mut debug = Vec::new();
        for image in DEBUG_IMAGES {
            debug.push((
                image,
                node.frame_publisher(topic::DEBUG_IMAGE, &[&config.id, image], 0).await?,
            ));
        }
        Ok(Self {
            node: node.clone(),
            frames: node.frame_subscriber(topic::FRAME, &[&config.camera]).await?,
            detections: node.publisher(topic::DETECTIONS, &[&config.id]).await?,
            debug,
            camera,
            detector,
            id: config.id.clone(),
            debug_jpeg_quality: config.debug_jpeg_quality,
            overlay: RgbImageBuf::default(),
        })
    }

    /// Starts the image thread. The receiver hears when it ends.
    fn start(mut self) -> anyhow::Result<(oneshot::Receiver<()>, std::thread::JoinHandle<()>)> {
        let runtime = Handle::current();
        let (running, stopped) = oneshot::channel();
        let thread = std::thread::Builder::new()
            .name("detect".to_owned())
            .spawn(move || {
                while let Some(frame) = runtime.block_on(self.frames.next()) {
                    runtime.block_on(self.search(&frame));
                }
                drop(running);
            })
            .context("starting the detection thread")?;
        Ok((stopped, thread))
    }

    async fn search(&mut self, frame: &Frame) {
        let health = self.node.shared_health();
        health.count("frames");
        let bytes = frame.bytes();
        let FrameHeader { width, height, format, .. } = frame.header;
        if format != PixelFormat::Mono8 {
            health.dropped("frames in a pixel format that is not searched");
            return;
        }
        let Ok(view) = GrayView::packed(&bytes, width as usize, height as usize) else {
            health.dropped("frames of an impossible size");
            return;
        };
        let camera = self.camera_model(&frame.header);
        let mut clock = StageClock::start();
        let found = self.detector.detect(view, camera.as_ref(), &mut clock);
        let message = Detections {
            detector: self.id.clone(),
            header: frame.header.clone(),
            detections: found.iter().map(wire::detection).collect(),
            stages: clock.stages,
        };
        health.latency("detect", clock.started.elapsed());
        if !message.detections.is_empty() {
            health.count("frames with a marker");
        }
        self.detections.publish(&message).await;
        let age_ns = now_ns().saturating_sub(frame.header.stamp_ns);
        health.latency("stamp to detections", Duration::from_nanos(age_ns.max(0).unsigned_abs()));
        self.publish_debug_images(view, &frame.header).await;
    }

    /// The camera's model, when it is calibrated for frames of this size.
    fn camera_model(&self, header: &FrameHeader) -> Option<CameraModel> {
        let info = self.camera.lock().unwrap_or_else(PoisonError::into_inner);
        let model = wire::camera_model(info.as_ref()?)?;
        if (model.width, model.height) == (header.width, header.height) {
            return Some(model);
        }
        if self.node.health().failed("calibration is for another image size") {
            tracing::warn!(
                calibrated = %format!("{} x {}", model.width, model.height),
                frame = %format!("{} x {}", header.width, header.height),
                "The camera's calibration is for another image size: detections have no pose"
            );
        }
        None
    }

    async fn publish_debug_images(&mut self, view: GrayView<'_>, header: &FrameHeader) {
        for (image, publisher) in &self.debug {
            if !publisher.has_subscribers().await {
                continue;
            }
            let trace = self.detector.trace();
            match *image {
                "ellipses" => debug::draw_ellipses(view, trace, &mut self.overlay),
                "rings" => debug::draw_rings(view, trace, &mut self.overlay),
                _ => debug::draw_target(view, trace, debug::ALIGNMENT_RADIUS_PX, &mut self.overlay),
            }
            match jpeg(&self.overlay, self.debug_jpeg_quality) {
                Ok(bytes) => {
                    let header = FrameHeader { format: PixelFormat::Jpeg, ..header.clone() };
                    publisher.publish(&header, Loan::Private(bytes)).await;
                }
                Err(_) => self.node.health().dropped("debug images too large for a JPEG"),
            }
        }
    }
}

fn jpeg(image: &RgbImageBuf, quality: u8) -> anyhow::Result<Vec<u8>> {
    let (width, height) = (u16::try_from(image.width)?, u16::try_from(image.height)?);
    let mut bytes = Vec::new();
    let encoder = jpeg_encoder::Encoder::new(&mut bytes, quality);
    encoder.encode(&image.data, width, height, jpeg_encoder::ColorType::Rgb)?;
    Ok(bytes)
}

/// Times the stages of a detection.
struct StageClock {
    started: Instant,
    last: Instant,
    stages: Vec<StageTime>,
}

impl StageClock {
    fn start() -> Self {
        let now = Instant::now();
        Self { started: now, last: now, stages: Vec::with_capacity(8) }
    }
}

impl Stages for StageClock {
    fn ended(&mut self, stage: &'static str) {
        let now = Instant::now();
        let micros = u32::try_from(now.duration_since(self.last).as_micros()).unwrap_or(u32::MAX);
        self.stages.push(StageTime { stage: stage.to_owned(), micros });
        self.last = now;
    }
}
