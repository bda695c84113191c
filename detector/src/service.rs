//! The detector's service: receives the newest frame and publishes detections, refused candidates and debug images. Camera
//! information and changed parameters take effect between two frames.
//!
//! The image work runs on a separate thread, named `detect`, so no message ever waits for it. The thread
//! takes a frame only when it is free, and its inbox stores only the newest.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use airlink::Unpacker;
use airlink::picture::jpeg_of_rgb;
use anyhow::Context;
use fiducial::overlay::canvas::RgbImageBuf;
use fiducial::overlay::debug;
use fiducial::{ResponseEstimate, ResponseSetting, StageObserver};
use geometry::CameraModel;
use imaging::{Converter, GrayView};
use messages::{
    CameraInfo, CameraResponse, CommandReply, Detection, Detections, DetectorCommand, DetectorInfo,
    FrameHeader, PixelFormat, Refusals, topic,
};
use node::{BoxFuture, Frame, FramePublisher, Loan, Node, Publisher, Shutdown, clock_name, now_ns};
use tokio::runtime::Handle;
use tokio::sync::oneshot;

use crate::config::{Config, Input};
use crate::inbox::{AirInbox, Inbox, lock};
use crate::order::Order;
use crate::search::{Search, StageClock};
use crate::wire;

/// The debug images, as the topics name them: the thesis' three, and the squares.
const DEBUG_IMAGES: [&str; 4] = ["ellipses", "rings", "squares", "target"];

/// Period at which a detector publishes its information, for subscribers whose link was cut.
const INFO_PERIOD: Duration = Duration::from_secs(1);
/// Silence after which a camera's calibration may be replaced: cameras repeat it every second.
const CAMERA_SILENT: Duration = Duration::from_millis(3500);
/// Time for the answer to a last command to be sent.
const FAREWELL: Duration = Duration::from_millis(100);

/// Runs the service until it is asked to stop, by the system or by a command.
///
/// # Errors
/// When another detector has the same name, or the network fails.
pub fn run(
    node: Node,
    config: Config,
    shutdown: Shutdown,
) -> BoxFuture<'static, anyhow::Result<()>> {
    Box::pin(run_service(node, config, shutdown))
}

async fn run_service(node: Node, config: Config, shutdown: Shutdown) -> anyhow::Result<()> {
    node.claim_unique_name(&config.id).await?;
    let camera = Arc::new(Mutex::new(None));
    let infos = node.subscriber(topic::CAMERA_INFO, &[&config.camera]).await?;
    let camera_name = config.camera.clone();
    let commands = node.commands(topic::DETECTOR_COMMAND, &[&config.id]).await?;
    let change = Arc::default();
    let response = Arc::new(Mutex::new(configured_response(&config)));
    let shared = Shared {
        camera: Arc::clone(&camera),
        change: Arc::clone(&change),
        response: Arc::clone(&response),
    };
    let work = Work::new(&node, &config, shared).await?;
    let responses = node.publisher(topic::CAMERA_RESPONSE, &[&config.id]).await?;
    let infos_of_ours = node.publisher(topic::DETECTOR_INFO, &[&config.id]).await?;
    let mut live = Live {
        info: info(&config).map_err(anyhow::Error::msg)?,
        config,
        change,
        response: Arc::clone(&response),
    };
    infos_of_ours.publish(&live.info).await;
    let cautions = live.config.cautions().map_err(anyhow::Error::msg)?;
    cautions.iter().for_each(|caution| tracing::warn!("{caution}"));
    let (stopped, thread) = work.start()?;
    node.announce().await?;
    let follow_camera = async {
        let mut received = Instant::now();
        while let Some(info) = infos.next().await {
            let is_named = is_named(&node, "camera info", &camera_name, &info.camera);
            if is_named && accept(&node, lock(&camera).as_ref(), &info, received.elapsed()) {
                received = Instant::now();
                *lock(&camera) = Some(info);
            }
        }
    };
    let obey = async {
        let mut introduction = tokio::time::interval(INFO_PERIOD);
        let mut published = None;
        loop {
            tokio::select! {
                _ = introduction.tick() => {
                    infos_of_ours.publish(&live.info).await;
                    let now = lock(&response).clone();
                    // An outdated response would stay the last value for late subscribers.
                    let unknown = now.is_none().then(|| unknown_response(&live.config));
                    if now != published && let Some(response) = now.as_ref().or(unknown.as_ref()) {
                        responses.publish(response).await;
                    }
                    published = now;
                }
                request = commands.next() => {
                    let Some(request) = request else { return };
                    let is_last = request.message == DetectorCommand::Stop;
                    let reply = live.command(&request.message);
                    if reply.accepted && !is_last {
                        node.configuration_changed(node::to_toml(&live.config));
                    }
                    request.answer(&reply).await;
                    if is_last {
                        tokio::time::sleep(FAREWELL).await;
                        return;
                    }
                }
            }
        }
    };
    tokio::select! {
        () = shutdown.requested() => {}
        () = follow_camera => {}
        () = obey => {}
        _ = stopped => anyhow::bail!("the detection thread ended"),
    }
    drop(thread);
    Ok(())
}

/// Whether a message names the camera of its key. Others are refused: the controller would take them for another camera's.
fn is_named(node: &Node, kind: &str, key: &str, camera: &str) -> bool {
    if key != camera
        && node.health().failed(&format!("{kind} that names another camera than its key"))
    {
        tracing::warn!(
            "A {kind} is refused: `{key}` gives it the name of `{camera}`; the camera that publishes it must give the name in its key as \
             `camera` (docs/wire-format.md; further ones are counted)"
        );
    }
    key == camera
}

/// Whether a camera's information is used. Implausible values are refused, and so is another calibration while the
/// present one, received `silence` ago, is still repeated. The publisher is not known here.
fn accept(node: &Node, known: Option<&CameraInfo>, info: &CameraInfo, silence: Duration) -> bool {
    let camera = &info.camera;
    if let Some(error) = info.problem() {
        if node.health().failed("camera info with values that no camera can have") {
            tracing::warn!(camera, error, "Camera information refused (further ones are counted)");
        }
        return false;
    }
    let Some(difference) = known.and_then(|known| known.difference(info)) else { return true };
    if silence >= CAMERA_SILENT {
        tracing::warn!(camera, difference, "Camera started again with another calibration");
        return true;
    }
    if node.health().failed("another camera info") {
        tracing::warn!(
            camera,
            difference,
            "Two programs give this camera different calibrations; the first is used (further ones are counted)"
        );
    }
    false
}

/// The information of this detector.
fn info(config: &Config) -> Result<DetectorInfo, String> {
    Ok(DetectorInfo {
        detector: config.id.clone(),
        host: node::host_name(),
        place: config.place,
        camera: config.camera.clone(),
        markers: config.looked_for()?,
        version: format!("alight {}", node::version()),
        pid: std::process::id(),
    })
}

/// The response that a configuration gives a camera; `None` where it is to be estimated.
fn configured_response(config: &Config) -> Option<CameraResponse> {
    match config.response() {
        Ok(ResponseSetting::Known(known)) => Some(camera_response(config, true, 0, &known)),
        _ => None,
    }
}

/// The message that the camera's response is unknown.
fn unknown_response(config: &Config) -> CameraResponse {
    CameraResponse {
        detector: config.id.clone(),
        camera: config.camera.clone(),
        ..CameraResponse::default()
    }
}

fn camera_response(
    config: &Config,
    configured: bool,
    markers: u32,
    known: &ResponseEstimate,
) -> CameraResponse {
    CameraResponse {
        detector: config.id.clone(),
        camera: config.camera.clone(),
        configured,
        markers,
        curve: known.curve.value,
        curve_deviation: known.curve.deviation,
        sharpening: known.sharpening.value,
        sharpening_deviation: known.sharpening.deviation,
    }
}

/// The state that the image thread shares with the service's task.
struct Shared {
    camera: Arc<Mutex<Option<CameraInfo>>>,
    /// Locked before `response` where both are locked.
    change: Arc<Mutex<Option<Change>>>,
    /// The camera's response to light, to be published.
    response: Arc<Mutex<Option<CameraResponse>>>,
}

/// The changes that the image thread makes before its next frame.
struct Change {
    config: Config,
    search: Search,
}

/// The parameters, as they are changed.
struct Live {
    config: Config,
    info: DetectorInfo,
    change: Arc<Mutex<Option<Change>>>,
    response: Arc<Mutex<Option<CameraResponse>>>,
}

impl Live {
    fn command(&mut self, command: &DetectorCommand) -> CommandReply {
        let (key, value) = match command {
            DetectorCommand::SetParameter { key, value } => (key, value),
            DetectorCommand::Stop => {
                tracing::info!("Asked to stop");
                let reason = format!("detector `{}` stops", self.config.id);
                return CommandReply { accepted: true, reason };
            }
        };
        match self.set(key, value) {
            Ok(()) => {
                tracing::info!(key, value, "Parameter changed");
                let reason = format!("`{key}` is {value} from the next frame on");
                CommandReply { accepted: true, reason }
            }
            Err(reason) => CommandReply { accepted: false, reason },
        }
    }

    fn set(&mut self, key: &str, value: &str) -> Result<(), String> {
        let config = self.config.with(key, value)?;
        let search = Search::new(&config)?;
        self.info = info(&config)?;
        let known = self.config.cautions()?;
        let cautions = config.cautions()?;
        let new = cautions.iter().filter(|caution| !known.contains(caution));
        new.for_each(|caution| tracing::warn!("{caution}"));
        let mut change = lock(&self.change);
        *change = Some(Change { config: config.clone(), search });
        // The estimate of the earlier search is dropped at once: a camera that is gone sends no next frame.
        *lock(&self.response) = configured_response(&config);
        self.config = config;
        Ok(())
    }
}

/// Everything the image thread needs.
struct Work {
    node: Node,
    frames: Inbox,
    detections: Publisher<Detections>,
    refusals: Publisher<Refusals>,
    debug: Vec<(&'static str, FramePublisher)>,
    shared: Shared,
    config: Config,
    converter: Converter,
    unpacker: Unpacker,
    search: Search,
    order: Order,
    overlay: RgbImageBuf,
}

impl Work {
    async fn new(node: &Node, config: &Config, shared: Shared) -> anyhow::Result<Self> {
        let search = Search::new(config).map_err(anyhow::Error::msg)?;
        let frames = match config.input {
            Input::Raw => Inbox::Raw(node.frame_subscriber(topic::FRAME, &[&config.camera]).await?),
            Input::Jpeg => Inbox::Air(AirInbox::start(
                node.frame_subscriber(topic::JPEG, &[&config.camera]).await?,
                node.publisher(topic::FRAME_ACK, &[&config.id]).await?,
                node.shared_health(),
            )),
        };
        let mut debug = Vec::new();
        for image in DEBUG_IMAGES {
            debug.push((
                image,
                node.frame_publisher(topic::DEBUG_IMAGE, &[&config.id, image], 0).await?,
            ));
        }
        Ok(Self {
            node: node.clone(),
            frames,
            detections: node.publisher(topic::DETECTIONS, &[&config.id]).await?,
            refusals: node.publisher(topic::REFUSALS, &[&config.id]).await?,
            debug,
            shared,
            config: config.clone(),
            converter: Converter::default(),
            unpacker: Unpacker::default(),
            search,
            order: Order::default(),
            overlay: RgbImageBuf::default(),
        })
    }

    /// Starts the image thread. The receiver is notified when it ends.
    fn start(mut self) -> anyhow::Result<(oneshot::Receiver<()>, std::thread::JoinHandle<()>)> {
        let runtime = Handle::current();
        let (running, stopped) = oneshot::channel();
        let thread = std::thread::Builder::new()
            .name("detect".to_owned())
            .spawn(move || {
                while let Some(frame) = node::block_on(&runtime, self.frames.next()) {
                    node::block_on(&runtime, self.search(&frame));
                }
                drop(running);
            })
            .context("starting the detection thread")?;
        Ok((stopped, thread))
    }

    async fn search(&mut self, frame: &Frame) {
        self.take_change();
        let health = self.node.shared_health();
        let is_jpeg = frame.header.format == PixelFormat::Jpeg;
        if !is_named(&self.node, "frame", &self.config.camera, &frame.header.camera) {
            return;
        }
        self.order.check(&health, &frame.header);
        health.count("frames");
        if frame.header.clock == clock_name() {
            health.latency("stamp to frame", age(&frame.header));
        }
        if is_jpeg {
            return self.search_parts(frame).await;
        }
        let bytes = frame.bytes();
        let FrameHeader { width, height, format, .. } = frame.header;
        let Some(format) = format.sample_format() else {
            health.dropped("frames in a pixel format that is not searched");
            return;
        };
        let mut clock = StageClock::start();
        // Taken out while its image is processed.
        let mut converter = std::mem::take(&mut self.converter);
        match converter.convert(&bytes, width as usize, height as usize, format) {
            Ok(view) => {
                if !std::ptr::eq(view.row(0).as_ptr(), bytes.as_ptr()) {
                    clock.ended("convert");
                }
                let camera = self.camera_model(&frame.header);
                let detections =
                    self.search.whole(view, &frame.header, camera.as_ref(), &mut clock);
                self.publish(&frame.header, detections, clock).await;
                self.keep_response();
                self.publish_refusals(&frame.header).await;
                self.publish_debug_images(view, &frame.header).await;
            }
            Err(_) => health.dropped("frames of an impossible size"),
        }
        self.converter = converter;
    }

    /// Searches a frame for the air link, part by part.
    async fn search_parts(&mut self, frame: &Frame) {
        let mut clock = StageClock::start();
        let mut unpacker = std::mem::take(&mut self.unpacker);
        match unpacker.unpack(&frame.header, &frame.bytes()) {
            Ok(parts) => {
                clock.ended("decode");
                let camera = self.camera_model(&frame.header);
                let found = self.search.parts(&parts, &frame.header, camera.as_ref(), &mut clock);
                self.publish(&frame.header, found, clock).await;
                self.keep_response();
                self.publish_refusals(&frame.header).await;
                if let Some(view) = parts.first().and_then(|(_, image)| image.view()) {
                    self.publish_debug_images(view, &frame.header).await;
                }
            }
            Err(error) => {
                if self.node.health().failed("frame that cannot be decoded") {
                    tracing::warn!(%error, "A frame cannot be decoded; further ones are counted only");
                }
            }
        }
        self.unpacker = unpacker;
    }

    fn take_change(&mut self) {
        if let Some(Change { config, search }) = lock(&self.shared.change).take() {
            self.search = search;
            self.config = config;
        }
    }

    /// Stores the estimated response of the camera for publication, unless a change is about to replace it.
    fn keep_response(&self) {
        let change = lock(&self.shared.change);
        if change.is_some() {
            return;
        }
        let memory = self.search.response();
        if let (Ok(ResponseSetting::Auto), Some(known)) = (self.config.response(), memory.known()) {
            let response = camera_response(&self.config, false, memory.markers(), &known);
            *lock(&self.shared.response) = Some(response);
        }
    }

    async fn publish(&self, header: &FrameHeader, found: Vec<Detection>, clock: StageClock) {
        let health = self.node.health();
        health.latency("detect", clock.elapsed());
        if !found.is_empty() {
            health.count("frames with a marker");
        }
        let message = Detections {
            detector: self.config.id.clone(),
            header: header.clone(),
            detections: found,
            stages: clock.into_stages(),
        };
        self.detections.publish(&message).await;
        if header.clock == clock_name() {
            health.latency("stamp to detections", age(header));
        }
    }

    /// The camera's model, when it is calibrated for frames of this size.
    fn camera_model(&self, header: &FrameHeader) -> Option<CameraModel> {
        let info = lock(&self.shared.camera);
        let model = info.as_ref()?.model()?;
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

    /// Publishes the refused candidates of the last frame, for subscribers.
    async fn publish_refusals(&self, header: &FrameHeader) {
        if self.refusals.has_subscribers().await {
            let refusals = wire::refusals(&self.config.id, header, self.search.trace());
            self.refusals.publish(&refusals).await;
        }
    }

    async fn publish_debug_images(&mut self, view: GrayView<'_>, header: &FrameHeader) {
        for (image, publisher) in &self.debug {
            if !publisher.has_subscribers().await {
                continue;
            }
            let trace = self.search.trace_of_image();
            match *image {
                "ellipses" => debug::draw_ellipses(view, trace, &mut self.overlay),
                "rings" => debug::draw_rings(view, trace, &mut self.overlay),
                "squares" => debug::draw_squares(view, trace, &mut self.overlay),
                _ => debug::draw_target(view, trace, debug::ALIGNMENT_RADIUS_PX, &mut self.overlay),
            }
            let RgbImageBuf { data, width, height, .. } = &self.overlay;
            match jpeg_of_rgb(data, *width, *height, self.config.debug_jpeg_quality) {
                Some(bytes) => {
                    let format = PixelFormat::Jpeg;
                    let header = FrameHeader { format, parts: Vec::new(), ..header.clone() };
                    publisher.publish(&header, Loan::Private(bytes)).await;
                }
                None => self.node.health().dropped("debug images too large for a JPEG"),
            }
        }
    }
}

/// How old a frame of this host's clock is.
fn age(header: &FrameHeader) -> Duration {
    Duration::from_nanos(now_ns().saturating_sub(header.stamp_ns).max(0).unsigned_abs())
}
