//! Runs the camera service: frames of a program, a V4L2, GenICam or RTSP camera, or of image files at a constant rate, stamped
//! and published raw, rectified and for the air link.

use std::convert::Infallible;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use airlink::AirSender;
use anyhow::{Context, bail, ensure};
use geometry::CameraModel;
use imaging::{GrayImage, GrayView, SampleFormat};
use media::{DecodedImage, ImageError, frame_bytes, images_in, is_video, samples_to_grey};
use messages::{BayerPattern, CameraControl, CameraInfo, FrameHeader, PixelFormat, topic};
use node::{
    BoxFuture, FramePublisher, HealthCounters, Loan, Node, Publisher, Shutdown, clock_name, now_ns,
};

use crate::config::{
    Config, DeviceConfig, FrameFormat, FrameSize, GenicamConfig, ProgramConfig, RtspConfig,
};
use crate::control::ControlPublisher;
use crate::exposure::Exposure;
#[cfg(feature = "genicam")]
use crate::genicam;
use crate::marker::MarkerExposure;
use crate::no_frame::{NoFrame, other_size};
use crate::program::Program;
use crate::rect::RectPublisher;
use crate::repeated::{Picture, Pictures};
#[cfg(feature = "rtsp")]
use crate::rtsp::{self, feed::Image};
use crate::thread::on_own_thread;
use crate::v4l2::capture::{Lost, Taken};
use crate::v4l2::kernel::DevicePath;
use crate::v4l2::pixels::Pixels;
use crate::v4l2::video::{Next, Port, Video};

/// Maximum number of images whose size is read at the start, to size the shared memory. Larger frames are
/// published by a copy.
const MAX_MEASURED_IMAGES: usize = 1000;
/// Maximum number of lost frames that are counted at once.
const MAX_COUNTED: u64 = 1000;
/// Time without a frame that can be read after which a device is opened again, in nanoseconds, in addition to three periods: to
/// open it costs half a second.
const UNREADABLE_NS: i64 = 1_000_000_000;
/// Interval at which a service that waits for a subscriber looks for one.
const SUBSCRIBER_POLL: Duration = Duration::from_millis(20);

/// Publishes frames until the images end, a shutdown is requested, no image can be read, or the camera's
/// program exits or stops writing. A device that is lost is opened again.
///
/// # Errors
/// When there is no image to publish, the program cannot be started or exits, the device does not support the configuration, or
/// another camera has this name.
pub fn run(
    node: Node,
    config: Config,
    shutdown: Shutdown,
) -> BoxFuture<'static, anyhow::Result<()>> {
    Box::pin(run_service(node, config, shutdown))
}

async fn run_service(node: Node, config: Config, shutdown: Shutdown) -> anyhow::Result<()> {
    node.claim_unique_name(config.instance()).await?;
    let found = {
        let config = config.clone();
        tokio::task::spawn_blocking(move || find(&config)).await??
    };
    let info = camera_info(&config, found.size)?;
    let infos = node.publisher(topic::CAMERA_INFO, &[config.instance()]).await?;
    infos.publish(&info).await;
    let mut stream = Stream::new(&node, &config, &found).await?;
    // Images were found and can be read. A camera may be away yet, or not have begun.
    match found.source {
        Source::Images(_) => node.announce().await?,
        _ => node.announce_as("Present, waiting for the first frame").await?,
    }
    let publish = async move || stream.run(found.source).await;
    tokio::select! {
        result = on_own_thread(publish, shutdown) => result,
        never = republish(&infos, &info) => match never {},
    }
}

async fn republish(infos: &Publisher<CameraInfo>, info: &CameraInfo) -> Infallible {
    let mut second = tokio::time::interval(Duration::from_secs(1));
    loop {
        second.tick().await;
        infos.publish(info).await;
    }
}

/// Where frames come from.
enum Source {
    /// Image files.
    Images(Vec<PathBuf>),
    /// A camera's program.
    Program(ProgramConfig),
    /// A camera of Video4Linux.
    Device(DeviceConfig),
    /// A camera of GenICam.
    Genicam(GenicamConfig),
    /// A camera that streams over RTSP.
    Rtsp(RtspConfig),
}

/// The images that can be published.
struct Found {
    source: Source,
    /// The size in the camera info.
    size: FrameSize,
    /// Bytes of the largest known frame.
    max_frame_bytes: usize,
}

fn find(config: &Config) -> anyhow::Result<Found> {
    let binning = config.source.binning();
    if let Some(device) = config.device()? {
        let (size, max_frame_bytes) = (device.size, device.size.pixels());
        return Ok(Found { source: Source::Device(device), size, max_frame_bytes });
    }
    if let Some(camera) = config.source.genicam()? {
        let (size, max_frame_bytes) = (camera.size.binned(binning), camera.size.pixels());
        return Ok(Found { source: Source::Genicam(camera), size, max_frame_bytes });
    }
    if let Some(camera) = config.source.rtsp()? {
        let (size, max_frame_bytes) = (camera.size, camera.size.pixels());
        return Ok(Found { source: Source::Rtsp(camera), size, max_frame_bytes });
    }
    match config.source.program()? {
        Some(program) => {
            let size = program.size.binned(binning);
            let max_frame_bytes = program.format.frame_bytes().max(size.pixels());
            Ok(Found { source: Source::Program(program), size, max_frame_bytes })
        }
        None => find_images(config),
    }
}

fn find_images(config: &Config) -> anyhow::Result<Found> {
    let mut images = Vec::new();
    ensure!(
        !config.source.paths.is_empty(),
        "the camera `{}` has nothing to publish; set image files or folders in `source.paths`, a camera program in \
         `source.command`, a camera in `source.device` or `source.genicam` (`alight cameras` lists them), or a stream in `source.rtsp`",
        config.instance()
    );
    for path in &config.source.paths {
        ensure!(path.exists(), "{path:?} of `source.paths` does not exist");
        ensure!(
            !(path.is_file() && is_video(path)),
            "{path:?} of `source.paths` is a video; to publish its frames, remove `source.paths` and set `source.command` to \
             [\"ffmpeg\", \"-v\", \"error\", \"-re\", \"-noautorotate\", \"-i\", {path:?}, \"-an\", \"-pix_fmt\", \"gray\", \"-f\", \"rawvideo\", \"-\"], \
             and `source.size_px` and `source.rate_hz` to those of the video"
        );
        images.extend(images_in(path)?);
    }
    let max_pixels = config.max_pixels();
    let mut first_problem = None;
    let first_size = images.iter().find_map(|path| match DecodedImage::read(path, max_pixels) {
        Ok(image) => Some(FrameSize { width: image.width(), height: image.height() }),
        Err(problem) => {
            first_problem.get_or_insert(problem);
            None
        }
    });
    let Some(size) = first_size else {
        let problem = first_problem.as_ref().map_or_else(String::new, image_error_text);
        bail!("none of the {} images can be read; the first one: {problem}", images.len());
    };
    let sizes = images
        .iter()
        .take(MAX_MEASURED_IMAGES)
        .filter_map(|path| frame_bytes(path, max_pixels).ok());
    let max_frame_bytes = sizes.max().unwrap_or(size.pixels());
    Ok(Found { source: Source::Images(images), size, max_frame_bytes })
}

/// The error of an image, and the key that allows it where it is too large.
fn image_error_text(problem: &ImageError) -> String {
    match problem {
        ImageError::TooLarge { .. } => format!("{problem}, or raise `source.max_megapixels`"),
        _ => problem.to_string(),
    }
}

fn camera_info(config: &Config, size: FrameSize) -> anyhow::Result<CameraInfo> {
    let intrinsics = config.intrinsics(size)?;
    let [width, height] = [size.width, size.height].map(|edge| edge as u32);
    let model = intrinsics.unwrap_or_else(|| CameraModel::pinhole(width, height, 1.0));
    let info = CameraInfo::new(config.instance(), &model, &config.body_from_camera());
    let focal_px = info.focal_px.filter(|_| intrinsics.is_some());
    Ok(CameraInfo { width, height, focal_px, ..info })
}

/// Reads frames and publishes them.
struct Stream {
    config: Config,
    size: FrameSize,
    frames: FramePublisher,
    air: AirSender,
    rect: RectPublisher,
    health: Arc<HealthCounters>,
    marker: MarkerExposure,
    control: ControlPublisher,
    pictures: Pictures,
    /// Samples of a frame before they are binned.
    raw: Vec<u8>,
    sequence: u64,
}

/// Keeps a constant rate. Time lost to slow work is not made up for.
struct Pace {
    due: Instant,
    period: Duration,
}

impl Pace {
    async fn wait(&mut self) {
        tokio::time::sleep_until(self.due.into()).await;
        self.due = (self.due + self.period).max(Instant::now());
    }
}

/// The result of reading a device.
struct Read {
    frame: Result<Prepared, NoFrame>,
    /// The message about the exposure after it.
    control: Option<CameraControl>,
}

/// A frame ready to be published.
struct Prepared {
    width: usize,
    height: usize,
    format: PixelFormat,
    pixels: Loan,
    /// Grey pixels for the air link and for rectified frames, when one wants them and `pixels` are in another format.
    grey: Option<GrayImage>,
}

impl Stream {
    async fn new(node: &Node, config: &Config, found: &Found) -> anyhow::Result<Self> {
        let names = [config.instance()];
        let jpegs = node.frame_publisher(topic::JPEG, &names, 0).await?;
        let mut marker = MarkerExposure::new(config.instance());
        if config.exposes_for_marker() {
            marker.subscribe(node).await?;
        }
        Ok(Self {
            config: config.clone(),
            size: found.size,
            frames: node.frame_publisher(topic::FRAME, &names, found.max_frame_bytes).await?,
            air: AirSender::start(node, config.instance(), jpegs, &config.air).await?,
            rect: RectPublisher::start(node, config.instance(), config.intrinsics(found.size)?)
                .await?,
            health: node.shared_health(),
            marker,
            control: ControlPublisher::new(node, config.instance()).await?,
            pictures: Pictures::default(),
            raw: Vec::new(),
            sequence: 0,
        })
    }

    async fn run(&mut self, source: Source) -> anyhow::Result<()> {
        match source {
            Source::Images(images) => self.publish_images(&images).await,
            Source::Program(program) => self.publish_program(&program).await,
            Source::Device(device) => {
                let port = DevicePath(device.path.clone());
                let cause = || format!("reading the camera {:?} of `source.device`", device.path);
                self.publish_device(port, &device).await.with_context(cause)
            }
            #[cfg(feature = "genicam")]
            Source::Genicam(camera) => {
                let cause = || format!("reading the camera `{}` of `source.genicam`", camera.name);
                self.publish_genicam(&camera).await.with_context(cause)
            }
            #[cfg(not(feature = "genicam"))]
            Source::Genicam(camera) => bail!("no camera of GenICam can be read: {camera:?}"),
            #[cfg(feature = "rtsp")]
            Source::Rtsp(camera) => {
                let cause = || format!("reading the camera `{}` of `source.rtsp`", camera.url);
                self.publish_rtsp(&camera).await.with_context(cause)
            }
            #[cfg(not(feature = "rtsp"))]
            Source::Rtsp(camera) => bail!("no stream of RTSP can be read: {camera:?}"),
        }
    }

    /// Publishes the frames of a camera's program.
    async fn publish_program(&mut self, config: &ProgramConfig) -> anyhow::Result<()> {
        let bayer = self.config.source.bayer_pattern()?;
        let mut program = Program::start(config)?;
        let mut last_published = Instant::now();
        let mut last_of_size = Instant::now();
        loop {
            let arrival = program.wait().await?;
            let began = Instant::now();
            let mut pixels = match config.format {
                FrameFormat::Samples { .. } if self.config.source.binning() > 1 => {
                    self.raw.resize(config.format.frame_bytes(), 0);
                    Loan::Private(std::mem::take(&mut self.raw))
                }
                FrameFormat::Samples { .. } => self.frames.loan(config.format.frame_bytes()),
                FrameFormat::Jpeg { .. } => Loan::Private(Vec::new()),
            };
            let jpeg = program.read(&mut pixels).await?;
            if let Some(measured_hz) = program.excessive_rate_hz()
                && self.health.failed("frames far faster than configured")
            {
                let FrameSize { width, height } = config.size;
                let pieces = match config.format {
                    FrameFormat::Samples { .. } => {
                        ". Where its frames are larger, or in another format, the pictures are pieces of frames: correct `source.size_px` and \
                         `source.pixels`"
                    }
                    FrameFormat::Jpeg { .. } => "",
                };
                tracing::warn!(
                    "The program writes {measured_hz:.0} frames of {width} x {height} pixels a second, and `source.rate_hz` is {}. Set that \
                     to its rate{pieces} (further seconds are counted)",
                    config.rate_hz
                );
            }
            let Some(exposure) = program.exposure(arrival).await? else {
                self.health.dropped("frames that were queued");
                ensure!(
                    last_published.elapsed() < config.timeout,
                    "frames from `source.command` arrive in bursts, faster than 4x `source.rate_hz` ({}), or later than they \
                     are due by it, so that their age is unknown; set `source.rate_hz` to the program's frame rate",
                    config.rate_hz
                );
                continue;
            };
            if program.has_metadata()
                && !exposure.is_exact()
                && self.health.failed("frame without metadata of its own")
            {
                tracing::warn!(
                    "A frame has no metadata of its own: its stamp is an estimate (further ones are only counted)"
                );
            }
            last_published = Instant::now();
            let frame = match config.format {
                FrameFormat::Samples { .. } if self.config.source.binning() > 1 => {
                    let frame = self.prepare_binned(&pixels, config.size, config.bits);
                    if let Loan::Private(raw) = pixels {
                        self.raw = raw;
                    }
                    frame
                }
                FrameFormat::Samples { .. } => {
                    Some(self.prepare_samples(pixels, config.size, config.bits, bayer))
                }
                FrameFormat::Jpeg { .. } => {
                    let frame = self.prepare_jpeg(&jpeg);
                    match frame {
                        Err(NoFrame::OtherSize(size)) => {
                            let waited = last_of_size.elapsed();
                            ensure!(
                                waited < config.timeout,
                                "the camera program of `source.command`: {}",
                                other_size(size, self.size)
                            );
                        }
                        Ok(_) | Err(NoFrame::Damaged) => last_of_size = Instant::now(),
                    }
                    frame.ok()
                }
            };
            self.health.latency("read", began.elapsed());
            if let Some(frame) = frame {
                self.publish_live(frame, exposure).await;
            }
        }
    }

    /// Publishes the frames of a device, whenever it is there.
    async fn publish_device<P: Port>(
        &mut self,
        port: P,
        config: &DeviceConfig,
    ) -> anyhow::Result<()> {
        let mut video = Video::start(port, config.wanted.clone())?;
        let patience_ns = UNREADABLE_NS.max((3e9 / config.wanted.rate_hz) as i64);
        let mut unreadable_since_ns = None;
        loop {
            match video.next()? {
                Next::Frame(taken) => {
                    let exposure = taken.exposure;
                    let began = Instant::now();
                    let read = self.prepare_taken(&mut video, taken, config);
                    self.health.latency("read", began.elapsed());
                    match read.frame {
                        Ok(frame) => {
                            unreadable_since_ns = None;
                            self.publish_exposed(frame, exposure, read.control).await;
                        }
                        Err(why) => {
                            let now_ns = video.now_ns();
                            let unreadable_ns = now_ns - *unreadable_since_ns.get_or_insert(now_ns);
                            if unreadable_ns >= patience_ns {
                                let lost = why.as_loss(config.size, unreadable_ns);
                                video.lose(&lost);
                                self.health.failed(lost.reason());
                            }
                        }
                    }
                }
                Next::Nothing => {}
                Next::Wait(time) => tokio::time::sleep(time).await,
                Next::Lost(reason) => drop(self.health.failed(reason)),
            }
            // An outage does not count as a period of damaged frames.
            if video.capture().is_none() {
                unreadable_since_ns = None;
            }
            // Waiting for a frame blocks this thread, briefly: a shutdown is noticed between.
            tokio::task::yield_now().await;
        }
    }

    /// Publishes the frames of a camera of GenICam, whenever it is there.
    #[cfg(feature = "genicam")]
    async fn publish_genicam(&mut self, config: &GenicamConfig) -> anyhow::Result<()> {
        let mut feed = genicam::feed::Feed::start(config)?;
        loop {
            match feed.next() {
                genicam::feed::Next::Frame(taken) => {
                    let began = Instant::now();
                    let exposure = taken.exposure;
                    let frame = if self.config.source.binning() > 1 {
                        let frame = self.prepare_binned(taken.pixels(), config.size, 8);
                        feed.give_back(taken);
                        frame
                    } else {
                        let mut pixels = self.frames.loan(config.size.pixels());
                        for (to, from) in pixels.iter_mut().zip(taken.pixels()) {
                            *to = *from;
                        }
                        feed.give_back(taken);
                        Some(self.prepare_samples(pixels, config.size, 8, config.bayer))
                    };
                    self.health.latency("read", began.elapsed());
                    if let Some(frame) = frame {
                        let control = feed.configured().map(CameraControl::from);
                        self.publish_exposed(frame, exposure, control).await;
                    }
                }
                genicam::feed::Next::Nothing => {}
                genicam::feed::Next::Wait(time) => tokio::time::sleep(time).await,
                genicam::feed::Next::Lost(reason) => drop(self.health.failed(reason)),
            }
            let counts = feed.take_counts();
            for (reason, count) in [
                ("frames that were queued", counts.queued),
                ("frames of which packets were lost", counts.torn),
                ("frames of another size", counts.other),
            ] {
                (0..count.min(MAX_COUNTED)).for_each(|_| self.health.dropped(reason));
            }
            // Waiting for a frame blocks this thread, briefly: a shutdown is noticed between.
            tokio::task::yield_now().await;
        }
    }

    /// Publishes the pictures of a stream of RTSP, whenever it is there.
    #[cfg(feature = "rtsp")]
    async fn publish_rtsp(&mut self, config: &RtspConfig) -> anyhow::Result<()> {
        let mut feed = rtsp::feed::Feed::start(config).await?;
        loop {
            match feed.next().await? {
                rtsp::feed::Next::Frame(image, exposure) => {
                    let began = Instant::now();
                    let decoding = feed.decoding();
                    let frame = match image {
                        Image::Jpeg(jpeg) => self.prepare_jpeg(&jpeg).ok(),
                        Image::Grey(image) => self.prepare_grey(&image).ok(),
                    };
                    self.health.latency("read", decoding + began.elapsed());
                    if let Some(frame) = frame {
                        self.publish_live(frame, exposure).await;
                    }
                }
                rtsp::feed::Next::Dropped(reason) => self.health.dropped(reason),
                rtsp::feed::Next::Lost(reason) => drop(self.health.failed(reason)),
                rtsp::feed::Next::Nothing => {}
            }
            let missed = feed.take_missed().min(MAX_COUNTED);
            (0..missed)
                .for_each(|_| self.health.dropped("pictures that came faster than they are read"));
        }
    }

    /// A frame from a picture that was decoded.
    #[cfg(feature = "rtsp")]
    fn prepare_grey(&self, image: &GrayImage) -> Result<Prepared, NoFrame> {
        let (width, height) = (image.width(), image.height());
        self.expect(width, height)?;
        let mut pixels = self.frames.loan(width * height);
        pixels.copy_from_slice(image.pixels());
        Ok(Prepared { width, height, format: PixelFormat::Mono8, pixels, grey: None })
    }

    /// Refuses a frame whose size is not the configured one, with a warning.
    fn expect(&self, width: usize, height: usize) -> Result<(), NoFrame> {
        let size = FrameSize { width, height };
        if size == self.size {
            return Ok(());
        }
        if self.health.failed("image of another size") {
            let error = other_size(size, self.size);
            tracing::warn!(%error, "Dropped a frame whose size is not `source.size_px`");
        }
        Err(NoFrame::OtherSize(size))
    }

    /// Takes a frame out of the driver's buffer, gives that back, and sets the exposure of later frames.
    fn prepare_taken<P: Port>(
        &mut self,
        video: &mut Video<P>,
        taken: Taken,
        config: &DeviceConfig,
    ) -> Read {
        let FrameSize { width, height } = config.size;
        let Some(capture) = video.capture() else {
            return Read { frame: Err(NoFrame::Damaged), control: None };
        };
        let frame = if Pixels::of(&config.wanted.fourcc) == Some(Pixels::Mjpeg) {
            capture.read(&taken, |jpeg| self.prepare_jpeg(jpeg))
        } else {
            let mut pixels = self.frames.loan(width * height);
            let copied = capture.copy_grey(&taken, &mut pixels);
            let format = PixelFormat::Mono8;
            match copied == width * height {
                true => Ok(Prepared { width, height, format, pixels, grey: None }),
                false => Err(NoFrame::Damaged),
            }
        };
        let counts = capture.take_counts();
        let stamp_ns = taken.exposure.mid_ns;
        let mut lost = capture.give_back(taken).err();
        let view = frame
            .as_ref()
            .ok()
            .and_then(|frame| GrayView::packed(&frame.pixels, frame.width, frame.height).ok());
        let configured = capture.configured().filter(|_| !self.config.exposes_for_marker());
        let mut control = configured.map(CameraControl::from);
        if let Some((exposed, view)) = capture.exposed().zip(view).filter(|_| lost.is_none()) {
            let decision = self.marker.after(stamp_ns, view, &exposed);
            match capture.expose(decision.order) {
                Ok(()) => {}
                Err(Lost::Unplugged) => lost = Some(Lost::Unplugged),
                // Frames continue after a refused control.
                Err(refused) => {
                    if self.health.failed("camera's exposure could not be set") {
                        tracing::warn!(%refused, "The exposure cannot be set; it is tried again each second");
                    }
                }
            }
            control = capture.exposed().map(|after| decision.message(&after, capture.refusal()));
        }
        for (reason, count) in [
            ("frames that were queued", counts.queued),
            ("frames that the driver could not store", counts.missed),
            ("frames that the driver marked as damaged", counts.damaged),
            ("frames of another length", counts.cut),
        ] {
            (0..count.min(MAX_COUNTED)).for_each(|_| self.health.dropped(reason));
        }
        let early = "frames sooner after their stamp than `source.readout_ms` allows";
        if counts.early > 0 && self.health.failed_times(early, counts.early) {
            tracing::warn!(
                "{early}: they are stamped by their arrival; correct it, or `source.stamp_at`"
            );
        }
        if let Some(lost) = lost {
            video.lose(&lost);
            self.health.failed(lost.reason());
        }
        Read { frame, control }
    }

    fn prepare_samples(
        &self,
        mut pixels: Loan,
        size: FrameSize,
        bits: u32,
        bayer: Option<imaging::BayerPattern>,
    ) -> Prepared {
        let FrameSize { width, height } = size;
        let bits = with_bits_of_a_format(&mut pixels, bits);
        let format = pixel_format(Some(bits), bayer);
        let sample = SampleFormat { bits, bayer };
        let is_wanted = self.needs_grey(format);
        let grey = is_wanted.then(|| samples_to_grey(&pixels, width, height, sample)).flatten();
        Prepared { width, height, format, pixels, grey }
    }

    /// A grey frame whose pixels are means of blocks of samples; `None` when there are too few samples.
    fn prepare_binned(&self, samples: &[u8], size: FrameSize, bits: u32) -> Option<Prepared> {
        let by = self.config.source.binning();
        let FrameSize { width, height } = size.binned(by);
        let mut pixels = self.frames.loan(width * height);
        imaging::bin(samples, [size.width, size.height], bits, by, &mut pixels).ok()?;
        Some(Prepared { width, height, format: PixelFormat::Mono8, pixels, grey: None })
    }

    /// A frame from a camera's JPEG file.
    fn prepare_jpeg(&self, jpeg: &[u8]) -> Result<Prepared, NoFrame> {
        let max_pixels = self.config.max_pixels();
        let image = match DecodedImage::decode(Path::new("a JPEG frame"), jpeg, max_pixels) {
            Ok(image) => image,
            Err(problem) => {
                if self.health.failed("unreadable image") {
                    let problem = image_error_text(&problem);
                    tracing::warn!(%problem, "Dropped a frame that is not a complete JPEG file");
                }
                return Err(NoFrame::Damaged);
            }
        };
        let (width, height) = (image.width(), image.height());
        self.expect(width, height)?;
        let mut pixels = self.frames.loan(width * height);
        image.write_grey(&mut pixels);
        Ok(Prepared { width, height, format: PixelFormat::Mono8, pixels, grey: None })
    }

    /// Publishes image files at the configured rate.
    async fn publish_images(&mut self, images: &[PathBuf]) -> anyhow::Result<()> {
        while self.config.source.wait_for_subscriber && !self.frames.has_subscribers().await {
            tokio::time::sleep(SUBSCRIBER_POLL).await;
        }
        let period = Duration::from_secs_f64(1.0 / self.config.source.rate_hz);
        let mut pace = Pace { due: Instant::now(), period };
        self.pass(images, &mut pace, true).await?;
        while self.config.source.repeat {
            self.pass(images, &mut pace, false).await?;
        }
        Ok(())
    }

    /// Publishes every image once.
    async fn pass(
        &mut self,
        images: &[PathBuf],
        pace: &mut Pace,
        is_first: bool,
    ) -> anyhow::Result<()> {
        let before = self.sequence;
        for path in images {
            match self.prepare(path) {
                Ok(frame) => {
                    pace.wait().await;
                    // An image file is stamped with its time of publication.
                    self.publish(frame, Exposure::estimated(now_ns())).await;
                }
                Err(problem) => {
                    self.health.failed("unreadable image");
                    if is_first {
                        tracing::warn!(%problem, "Skipped an image");
                    }
                }
            }
        }
        // An emptied folder would make this a busy loop.
        ensure!(self.sequence > before, "none of the {} images can be read any more", images.len());
        Ok(())
    }

    /// Decodes an image into the buffer from which it is published.
    fn prepare(&self, path: &Path) -> anyhow::Result<Prepared> {
        let began = Instant::now();
        let image = DecodedImage::read(path, self.config.max_pixels())
            .map_err(|problem| anyhow::Error::msg(image_error_text(&problem)))?;
        let (width, height) = (image.width(), image.height());
        if (FrameSize { width, height }) != self.size && self.health.failed("image of another size")
        {
            tracing::warn!(
                ?path,
                width,
                height,
                "The size of an image differs from that in the camera info"
            );
        }
        let bayer = self.config.source.bayer_pattern()?;
        let format = pixel_format(image.raw_bits(), bayer);
        let bytes = format.bytes_per_pixel().unwrap_or(1);
        let mut pixels = self.frames.loan(width * height * bytes);
        image.write_samples(&mut pixels);
        self.health.latency("read", began.elapsed());
        let grey = self.needs_grey(format).then(|| image.grey(bayer));
        Ok(Prepared { width, height, format, pixels, grey })
    }

    /// True when a frame of this format must be converted to grey, for the air link or to be rectified.
    fn needs_grey(&self, format: PixelFormat) -> bool {
        format != PixelFormat::Mono8 && (self.air.is_wanted() || self.rect.is_wanted())
    }

    /// Publishes the frame of a camera, and the message about its exposure.
    async fn publish_exposed(
        &mut self,
        frame: Prepared,
        exposure: Exposure,
        control: Option<CameraControl>,
    ) {
        let sequence = self.publish_live(frame, exposure).await;
        if let Some(control) = control {
            self.control.publish(sequence, exposure.mid_ns, control).await;
        }
    }

    /// Publishes the frame of a camera and returns its number, but no picture a second time: it would not be of the time of
    /// its stamp.
    async fn publish_live(&mut self, frame: Prepared, exposure: Exposure) -> Option<u64> {
        let picture = self.pictures.add(&frame.pixels, Instant::now());
        if picture == Picture::New {
            let sequence = self.sequence;
            self.publish(frame, exposure).await;
            if sequence == 0 {
                let instance = self.config.instance();
                tracing::info!(instance, "Ready, the first frame is published");
            }
            return Some(sequence);
        }
        self.health.dropped("frames that repeat the picture before");
        if picture == Picture::Stuck && self.health.failed("camera repeats one picture") {
            tracing::warn!(
                "The camera gives the same picture, to the last bit, since a second; it is not published again until another \
                 comes. Its signal is gone, or its player hangs; a coded video of a scene that does not move may do so as well. \
                 Still pictures are published from `source.paths`"
            );
        }
        None
    }

    async fn publish(&mut self, frame: Prepared, exposure: Exposure) {
        if exposure.is_exact() {
            self.health.count("exact stamps");
        }
        let header = FrameHeader {
            camera: self.config.instance().to_owned(),
            sequence: self.sequence,
            stamp_ns: exposure.mid_ns,
            clock: clock_name().to_owned(),
            exposure_ns: exposure.exposure_ns,
            width: frame.width as u32,
            height: frame.height as u32,
            format: frame.format,
            parts: Vec::new(),
        };
        let grey = match &frame.grey {
            Some(grey) => Some(grey.pixels()),
            None => (frame.format == PixelFormat::Mono8).then_some(&*frame.pixels),
        };
        if let Some(grey) = grey {
            self.air.offer(&header, grey);
            self.rect.offer(&header, grey);
        }
        self.frames.publish(&header, frame.pixels).await;
        self.sequence += 1;
    }
}

/// Moves samples of so many bits up to 16 where no format has as many; returns how many they have then.
fn with_bits_of_a_format(samples: &mut [u8], bits: u32) -> u32 {
    if matches!(bits, 0..=8 | 10 | 12 | 16..) {
        return bits;
    }
    for pair in samples.as_chunks_mut::<2>().0 {
        // Bits above the significant ones are not light.
        *pair = (u16::from_le_bytes(*pair) << (16 - bits)).to_le_bytes();
    }
    16
}

/// The format of a frame by the bits of its raw samples; images that are not raw are published in grey.
fn pixel_format(raw_bits: Option<u32>, bayer: Option<imaging::BayerPattern>) -> PixelFormat {
    let pattern = bayer.map(BayerPattern::from);
    match (raw_bits, pattern) {
        (Some(10), Some(pattern)) => PixelFormat::Bayer10(pattern),
        (Some(12), Some(pattern)) => PixelFormat::Bayer12(pattern),
        (Some(9..), Some(pattern)) => PixelFormat::Bayer16(pattern),
        (Some(10), None) => PixelFormat::Mono10,
        (Some(12), None) => PixelFormat::Mono12,
        (Some(9..), None) => PixelFormat::Mono16,
        (Some(_), Some(pattern)) => PixelFormat::Bayer8(pattern),
        _ => PixelFormat::Mono8,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::v4l2::abi::CID_EXPOSURE_ABSOLUTE;
    use crate::v4l2::fake::{Fake, Happening, MS, Stamps, grey_level};
    use messages::{Detection, Detections, ExposureReason, ExposureSetter, ExposureSetting};
    use node::{Frame, FrameSubscriber, Identity, Layers, Subscriber, ZenohSource};
    use std::rc::Rc;

    /// Time after which a frame does not come any more.
    const FRAME_PATIENCE: Duration = Duration::from_millis(100);

    async fn open(service: &'static str, port: u16) -> Node {
        let text = include_str!("../../zenoh-config/local.json5");
        let local = ZenohSource::Text(text.replace(":7447", &format!(":{port}")));
        Node::open(Identity { service, instance: "down".into() }, &local).await.unwrap()
    }

    /// Publishes the frames of a played device with this fault until `see` has seen enough of them; returns the counts.
    async fn publish(
        fourcc: &'static str,
        script: &[(u32, Happening)],
        mut see: impl FnMut(&Fake, &Frame) -> bool,
    ) -> Arc<HealthCounters> {
        let fake = Fake::of(fourcc, Stamps::ExposureStart, 0);
        script.iter().for_each(|(frame, happening)| fake.script(*frame, *happening));
        let set = ["source.device=/dev/video0", "source.size_px=[640, 480]", "source.rate_hz=100"];
        let mut set: Vec<_> = set.map(str::to_owned).into();
        set.push(format!("source.fourcc={fourcc}"));
        let config = Layers { file: None, set }.load::<Config>().unwrap().settings;
        let found = find(&config).unwrap();
        let ([port], _, _) = testing::ports::free().unwrap();
        let (camera, viewer) = (open("camera-pub", port).await, open("gcs-bridge", port).await);
        let frames = viewer.frame_subscriber(topic::FRAME, &["down"]).await.unwrap();
        let mut stream = Stream::new(&camera, &config, &found).await.unwrap();
        while !stream.frames.has_subscribers().await {
            tokio::time::sleep(SUBSCRIBER_POLL).await;
        }
        let Source::Device(device) = found.source else { panic!("no device") };
        let seeing = async {
            loop {
                let frame = tokio::time::timeout(Duration::from_secs(10), frames.next()).await;
                if see(&fake, &frame.expect("a frame in time").expect("an open session")) {
                    break;
                }
            }
        };
        tokio::select! {
            result = stream.publish_device(Rc::clone(&fake), &device) => result.unwrap(),
            () = seeing => {}
        }
        assert_eq!((fake.open_devices(), fake.mappings()), (0, 0), "it is closed");
        let health = camera.shared_health();
        // A session that is dropped instead of closed may wait ten seconds for the others of its process.
        drop((stream, frames));
        camera.close().await;
        viewer.close().await;
        health
    }

    /// A played device whose exposure is published, and its subscriber.
    struct Exposing {
        fake: Rc<Fake>,
        device: DeviceConfig,
        camera: Node,
        viewer: Node,
        stream: Stream,
    }

    impl Exposing {
        async fn new(control: &str) -> Self {
            let fake = Fake::of("GREY", Stamps::ExposureStart, 0);
            fake.light(0.05);
            let device = ["source.device=/dev/video0", "source.fourcc=GREY"];
            let mode = ["source.size_px=[640, 480]", "source.rate_hz=100"];
            let mut set: Vec<_> = device.into_iter().chain(mode).map(str::to_owned).collect();
            set.push(format!("exposure.control={control}"));
            let config = Layers { file: None, set }.load::<Config>().unwrap().settings;
            let found = find(&config).unwrap();
            let ([port], _, _) = testing::ports::free().unwrap();
            let (camera, viewer) = (open("camera-pub", port).await, open("detector", port).await);
            let stream = Stream::new(&camera, &config, &found).await.unwrap();
            let Source::Device(device) = found.source else { panic!("no device") };
            Self { fake, device, camera, viewer, stream }
        }

        /// Publishes the device's frames until `seeing` has seen enough.
        async fn while_seeing(mut self, seeing: impl Future<Output = ()>) {
            let seeing = tokio::time::timeout(Duration::from_secs(60), seeing);
            tokio::select! {
                result = self.stream.publish_device(Rc::clone(&self.fake), &self.device) => result.unwrap(),
                seen = seeing => seen.expect("all is seen in time"),
            }
            drop(self.stream);
            self.camera.close().await;
            self.viewer.close().await;
        }
    }

    /// A subscriber that can report the pad in the centre of each frame.
    struct Viewer {
        fake: Rc<Fake>,
        frames: FrameSubscriber,
        controls: Subscriber<CameraControl>,
        detections: Publisher<Detections>,
    }

    impl Viewer {
        /// The device is held from now on: a subscriber keeps only the newest messages, and would otherwise miss some while the
        /// simulated time passes.
        async fn of(fake: Rc<Fake>, node: &Node) -> Self {
            fake.hold();
            Self {
                fake,
                controls: node.subscriber(topic::CAMERA_CONTROL, &["down"]).await.unwrap(),
                detections: node.publisher(topic::DETECTIONS, &["main"]).await.unwrap(),
                frames: node.frame_subscriber(topic::FRAME, &["down"]).await.unwrap(),
            }
        }

        /// The next message about the exposure; the device gives one frame after the other until then.
        async fn next(&self, is_found: bool) -> CameraControl {
            loop {
                if let Some(control) = self.controls.waiting() {
                    return control;
                }
                self.fake.let_through();
                // The first ones do not arrive before the nodes have discovered each other.
                let frame = tokio::time::timeout(FRAME_PATIENCE, self.frames.next());
                let Ok(frame) = frame.await else { continue };
                let centre_px = [320.0, 240.0];
                let pad = Detection { centre_px, size_px: 80.0, ..Detection::sample() };
                let detections = if is_found { vec![pad] } else { Vec::new() };
                let header = frame.unwrap().header.clone();
                let message = Detections { header, detections, ..Detections::sample() };
                self.detections.publish(&message).await;
            }
        }
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_subscriber_receives_the_exposure_for_the_marker_and_its_reason() {
        let exposing = Exposing::new("marker").await;
        let (fake, viewer) = (Rc::clone(&exposing.fake), exposing.viewer.clone());
        let seeing = async {
            let viewer = Viewer::of(Rc::clone(&fake), &viewer).await;
            let mut last: Option<CameraControl> = None;
            let light = |setting: Option<ExposureSetting>| {
                let setting = setting.unwrap();
                f64::from(setting.exposure_ns) * setting.gain.unwrap()
            };
            // The reason that is expected first, whether the pad is found until then, and the event then.
            for (why, is_found, then) in [
                (ExposureReason::NoMarker, false, None),
                (ExposureReason::TakenOver, true, None),
                (ExposureReason::TooDark, true, None),
                (ExposureReason::Good, true, Some(Then::Light(4.0))),
                (ExposureReason::Clipped, true, None),
                (ExposureReason::Good, true, Some(Then::Refuse)),
                (ExposureReason::TooDark, true, Some(Then::Take)),
                (ExposureReason::Good, true, None),
                (ExposureReason::NoMarker, false, None),
            ] {
                let control = loop {
                    let control = viewer.next(is_found).await;
                    let is_later = last.as_ref().is_none_or(|last| {
                        control.stamp_ns > last.stamp_ns && control.sequence > last.sequence
                    });
                    assert!(is_later, "{control:?} after {last:?}");
                    last = Some(control.clone());
                    // The first message without a marker follows a frame that was still exposed for it.
                    let is_awaited = match why {
                        ExposureReason::NoMarker => control.in_use.is_none(),
                        _ => then != Some(Then::Take) || control.refused.is_some(),
                    };
                    if control.why == why && is_awaited {
                        break control;
                    }
                };
                assert_eq!((control.camera.as_str(), &*control.clock), ("down", clock_name()));
                match why {
                    ExposureReason::NoMarker => {
                        assert_eq!(control.set_by, ExposureSetter::Camera);
                        assert_eq!((control.in_use, control.wanted), (None, None));
                    }
                    _ => assert_eq!(control.set_by, ExposureSetter::Marker, "{control:?}"),
                }
                match why {
                    ExposureReason::TooDark => {
                        assert!(control.levels.unwrap().white < 0.63, "{control:?}");
                        assert!(light(control.wanted) > light(control.in_use), "{control:?}");
                    }
                    ExposureReason::Clipped => {
                        assert!(control.levels.unwrap().white >= 0.98, "{control:?}");
                        assert!(light(control.wanted) < light(control.in_use), "{control:?}");
                    }
                    ExposureReason::Good => assert_eq!(control.wanted, control.in_use),
                    _ => {}
                }
                match then {
                    Some(Then::Light(light)) => fake.light(light),
                    Some(Then::Refuse) => {
                        fake.refuse(Some(CID_EXPOSURE_ABSOLUTE));
                        fake.light(0.2);
                    }
                    Some(Then::Take) => {
                        let answer = control.refused.unwrap();
                        assert!(answer.starts_with("VIDIOC_S_EXT_CTRLS: "), "{answer}");
                        fake.refuse(None);
                    }
                    None => {}
                }
            }
        };
        exposing.while_seeing(seeing).await;
    }

    /// The event of a played device once a message was received.
    #[derive(Copy, Clone, Debug, PartialEq)]
    enum Then {
        Light(f64),
        /// It refuses to be set, in less light.
        Refuse,
        Take,
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_subscriber_receives_the_configured_exposure() {
        let exposing = Exposing::new("camera").await;
        let (fake, viewer) = (Rc::clone(&exposing.fake), exposing.viewer.clone());
        let seeing = async {
            let viewer = Viewer::of(Rc::clone(&fake), &viewer).await;
            let first = viewer.next(false).await;
            assert_eq!(
                (first.set_by, first.why),
                (ExposureSetter::Fixed, ExposureReason::Configured)
            );
            let fixed = ExposureSetting { exposure_ns: 5_000_000, gain: None };
            assert_eq!((first.in_use, first.wanted, first.limits), (Some(fixed), None, None));
            // Once a second.
            let second = viewer.next(false).await;
            let since_ns = second.stamp_ns - first.stamp_ns;
            assert!((1000 * MS..1100 * MS).contains(&since_ns), "{since_ns}");
            // Another program may change that.
            fake.meter();
            while viewer.next(false).await.set_by != ExposureSetter::Camera {}
        };
        exposing.while_seeing(seeing).await;
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_devices_frames_carry_their_own_stamps_before_and_after_it_was_unplugged() {
        for fourcc in ["YUYV", "MJPG"] {
            let (mut before, mut after) = (0, 0);
            let script = [(20, Happening::Unplugged(300 * MS))];
            let health = publish(fourcc, &script, |fake, frame| {
                let (header, bytes) = (&frame.header, frame.bytes());
                assert_eq!((header.width, header.height, bytes.len()), (640, 480, 640 * 480));
                assert_eq!((header.exposure_ns, header.format), (5_000_000, PixelFormat::Mono8));
                let number = fake.number_at(header.stamp_ns + 1000);
                let error_ns = header.stamp_ns - fake.mid_exposure_ns(number);
                assert!(error_ns.abs() <= 1000, "{error_ns} ns");
                match fourcc {
                    "MJPG" => assert!(bytes[5000].abs_diff(grey_level(number)) < 3),
                    _ => assert_eq!(u32::from_le_bytes(bytes[..4].try_into().unwrap()), number),
                }
                (before, after) =
                    if number < 20 { (before + 1, after) } else { (before, after + 1) };
                before > 0 && after > 4
            })
            .await;
            assert_eq!(health.failures("camera unplugged"), 1);
        }
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_camera_is_given_up_for_a_second_of_damaged_frames_and_for_no_short_disturbance() {
        for (damaged, losses) in [(12, 0), (150, 1)] {
            let script: Vec<_> = (20..20 + damaged).map(|at| (at, Happening::Cut)).collect();
            let (mut opened, mut after) = (0, 0);
            let health = publish("MJPG", &script, |fake, frame| {
                opened = fake.opened();
                after += u32::from(fake.number_at(frame.header.stamp_ns + 1000) >= 20);
                after > 4
            })
            .await;
            assert_eq!(u64::from(opened), 1 + losses, "{damaged} damaged");
            assert_eq!(health.failures("camera's frames unreadable"), losses);
            assert_eq!(health.failures("camera's format changed"), 0);
            assert!(health.failures("unreadable image") >= u64::from(damaged));
        }
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn damaged_frames_before_and_after_an_outage_are_not_one_period_of_damage() {
        let away = Happening::Unplugged(900 * MS);
        let script = [(20, Happening::Cut), (21, away), (22, Happening::Cut)];
        let mut opened = 0;
        let health = publish("MJPG", &script, |fake, frame| {
            opened = fake.opened();
            fake.number_at(frame.header.stamp_ns + 1000) > 100
        })
        .await;
        assert_eq!((opened, health.failures("unreadable image")), (2, 2));
        assert_eq!(health.failures("camera unplugged"), 1);
        assert_eq!(health.failures("camera's frames unreadable"), 0);
    }

    #[test]
    fn a_video_among_the_image_files_is_refused_with_the_command_that_plays_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("flight.mp4");
        std::fs::write(&path, "a video").unwrap();
        let set = vec![format!("source.paths=[{path:?}]")];
        let config = Layers { file: None, set }.load::<Config>().unwrap().settings;
        let error = find(&config).err().unwrap().to_string();
        assert!(
            error.contains("is a video") && error.contains("\"-noautorotate\", \"-i\""),
            "{error}"
        );
    }

    /// Grey levels that differ everywhere, so that no two places of a frame can be taken for each other.
    fn picture(width: u32, height: u32) -> image::GrayImage {
        image::GrayImage::from_fn(width, height, |x, y| {
            image::Luma([((x * 3 + y * 5) % 251) as u8])
        })
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn rectified_frames_are_made_only_while_there_is_a_subscriber() {
        let folder = tempfile::tempdir().unwrap();
        let picture = picture(320, 240);
        picture.save(folder.path().join("1.png")).unwrap();
        let mut set = vec![format!("source.paths=[{:?}]", folder.path())];
        let lens = ["calibration.lens=brown-conrady", "calibration.distortion=[-0.3, 0.1]"];
        let stream = ["source.repeat=true", "source.rate_hz=50", "calibration.focal_px=[250, 251]"];
        set.extend(lens.iter().chain(&stream).map(|&key| key.to_owned()));
        let config = Layers { file: None, set }.load::<Config>().unwrap().settings;
        let found = find(&config).unwrap();
        let camera_model = config.intrinsics(found.size).unwrap().unwrap();
        let mut straight = vec![0; 320 * 240];
        let view = GrayView::packed(picture.as_raw(), 320, 240).unwrap();
        assert!(media::Rectifier::new(&camera_model).rectify(view, &mut straight));
        assert_ne!(&straight, picture.as_raw());

        let ([port], _, _) = testing::ports::free().unwrap();
        let (camera, viewer) = (open("camera-pub", port).await, open("gcs-bridge", port).await);
        let mut stream = Stream::new(&camera, &config, &found).await.unwrap();
        let Source::Images(images) = found.source else { panic!("no images") };
        let seeing = async {
            let frames = viewer.frame_subscriber(topic::FRAME, &["down"]).await.unwrap();
            for _ in 0..10 {
                frames.next().await.unwrap();
            }
            assert_eq!(camera.health().percentiles("rectify"), None);
            let rectified = viewer.frame_subscriber(topic::RECT, &["down"]).await.unwrap();
            for _ in 0..3 {
                let frame = rectified.next().await.unwrap();
                let header = &frame.header;
                assert_eq!((header.width, header.height), (320, 240));
                assert_eq!((header.format, header.camera.as_str()), (PixelFormat::Mono8, "down"));
                assert!(frame.bytes()[..] == straight[..]);
            }
            let identity = Identity { service: "camera-pub", instance: "down".into() };
            let rates = camera.health().report(&identity, now_ns()).rates;
            let count = |name: &str| rates.iter().find(|rate| rate.name == name).map(|it| it.count);
            (count("frames").unwrap(), count("rectified frames").unwrap())
        };
        let seen = tokio::time::timeout(Duration::from_secs(20), seeing);
        let (frames, rectified) = tokio::select! {
            result = stream.publish_images(&images) => panic!("it ended: {result:?}"),
            seen = seen => seen.expect("rectified frames in time"),
        };
        // Of each kind one may be under way: counted and not numbered, or there and not counted.
        assert!(frames <= stream.sequence + 1 && rectified >= 2, "{frames}, {rectified}");
        drop(stream);
        camera.close().await;
        viewer.close().await;
    }
}
