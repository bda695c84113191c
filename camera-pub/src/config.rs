//! Defines the camera service's configuration, `camera-pub.toml`: source (files, program, device, GenICam, RTSP), stamps,
//! exposure, calibration and mount; checked, and the size and format of frames.

use std::path::{Path, PathBuf};
use std::time::Duration;

use airlink::AirConfig;
use anyhow::{Context, bail, ensure};
use geometry::{Body, Camera, CameraModel, Distortion, Point, Rotation, Transform};
use imaging::{BayerPattern, GrayView};
use media::{CalibrationFile, SensorRegion, WantedMode};
use node::{Check, Settings, without_credentials};
use serde::Deserialize;

use crate::exposure::{Shutter, StampedAt};
use crate::side_channel::PLACEHOLDER;
use crate::v4l2::capture::{ControlValue, Wanted};
use crate::v4l2::exposer::ForMarker;
use crate::v4l2::pixels::Pixels;

/// The keys of `camera-pub.toml`, which explains them.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    id: String,
    pub(crate) source: SourceConfig,
    exposure: ExposureConfig,
    pub(crate) air: AirConfig,
    calibration: CalibrationConfig,
    mount: MountConfig,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SourceConfig {
    pub(crate) paths: Vec<PathBuf>,
    pub(crate) rate_hz: f64,
    pub(crate) repeat: bool,
    pub(crate) wait_for_subscriber: bool,
    bayer: String,
    max_megapixels: f64,
    command: Vec<String>,
    device: PathBuf,
    genicam: String,
    rtsp: String,
    rtsp_credentials: PathBuf,
    rtsp_stamps: RtspStamps,
    fourcc: String,
    controls: Vec<String>,
    pixels: String,
    bits: u32,
    size_px: [u32; 2],
    binning: u32,
    row_bytes: usize,
    delay_ms: f64,
    stamp_at: String,
    readout_ms: f64,
    timeout_s: f64,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct ExposureConfig {
    control: ExposureControl,
    max_ms: f64,
    gain: String,
    max_gain: f64,
    settle_frames: u32,
}

/// The process that sets the exposure.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum ExposureControl {
    /// The camera, as its controls are set.
    Camera,
    /// This service, for the marker.
    Marker,
}

/// A program that writes frames.
#[derive(Clone, Debug)]
pub(crate) struct ProgramConfig {
    /// The program and its arguments.
    pub(crate) command: Vec<String>,
    /// Size of its frames.
    pub(crate) size: FrameSize,
    /// Bytes of a frame.
    pub(crate) format: FrameFormat,
    /// Bits of a sample.
    pub(crate) bits: u32,
    /// Nominal frame rate.
    pub(crate) rate_hz: f64,
    /// Time from the middle of the exposure to a frame's first byte.
    pub(crate) delay_ns: i64,
    /// The instant of the stamps in its metadata.
    pub(crate) shutter: Shutter,
    /// Maximum time without a frame.
    pub(crate) timeout: Duration,
}

impl ProgramConfig {
    /// True when the program writes metadata to a pipe.
    pub(crate) fn has_metadata(&self) -> bool {
        self.command.iter().any(|argument| argument.contains(PLACEHOLDER))
    }
}

/// A camera of Video4Linux.
#[derive(Clone, Debug)]
pub(crate) struct DeviceConfig {
    /// Its device.
    pub(crate) path: PathBuf,
    /// Size of its frames.
    pub(crate) size: FrameSize,
    /// The format, rate and controls that are requested.
    pub(crate) wanted: Wanted,
}

/// A camera of GenICam.
#[derive(Clone, Debug)]
#[cfg_attr(not(feature = "genicam"), expect(dead_code, reason = "read with the feature only"))]
pub(crate) struct GenicamConfig {
    /// Its name or address; `any` for the first that answers.
    pub(crate) name: String,
    /// Size of its frames.
    pub(crate) size: FrameSize,
    /// Its frame rate.
    pub(crate) rate_hz: f64,
    /// Features that are set, as `Name=value`.
    pub(crate) features: Vec<String>,
    /// The colours of its pixels; `None` for a grey camera.
    pub(crate) bayer: Option<BayerPattern>,
    /// The instant of its stamps.
    pub(crate) shutter: Shutter,
    /// Time for which a frame is held back before it is sent.
    pub(crate) delay_ns: i64,
}

/// A camera that streams over RTSP.
#[derive(Clone, Debug)]
#[cfg_attr(not(feature = "rtsp"), expect(dead_code, reason = "read with the feature only"))]
pub(crate) struct RtspConfig {
    /// The address of its stream.
    pub(crate) url: String,
    /// The file with `user:password`, if it wants them.
    pub(crate) credentials: Option<PathBuf>,
    /// Size of its pictures.
    pub(crate) size: FrameSize,
    /// Nominal rate of them.
    pub(crate) rate_hz: f64,
    /// Whose clock stamps them.
    pub(crate) stamps: RtspStamps,
    /// Time from the middle of the exposure to the instant that is stamped.
    pub(crate) delay_ns: i64,
    /// Maximum pixels of a picture.
    pub(crate) max_pixels: u64,
}

/// The source of the stamps of a stream's pictures.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum RtspStamps {
    /// Their arrival.
    Arrival,
    /// The camera's clock, which is set to this host's by NTP.
    Camera,
}

/// The size of a frame, in pixels.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) struct FrameSize {
    pub(crate) width: usize,
    pub(crate) height: usize,
}

impl FrameSize {
    /// The size after blocks of so many samples, across and down, have become a pixel each.
    pub(crate) fn binned(self, by: usize) -> Self {
        Self { width: self.width / by.max(1), height: self.height / by.max(1) }
    }

    pub(crate) fn pixels(self) -> usize {
        self.width.saturating_mul(self.height)
    }
}

/// The bytes in which a program writes a frame.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) enum FrameFormat {
    /// Rows of samples of one or two bytes, then chroma planes, which are skipped.
    Samples {
        /// Bytes of a row's samples.
        row_bytes: usize,
        /// Bytes from row to row.
        stride_bytes: usize,
        rows: usize,
        /// Bytes of the chroma planes.
        chroma_bytes: usize,
    },
    /// A JPEG file.
    Jpeg { max_bytes: usize },
}

impl FrameFormat {
    /// Bytes of a frame's samples.
    pub(crate) fn frame_bytes(self) -> usize {
        match self {
            Self::Samples { row_bytes, rows, .. } => row_bytes * rows,
            Self::Jpeg { .. } => 0,
        }
    }
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct CalibrationConfig {
    file: PathBuf,
    binning: u32,
    region_px: Vec<u32>,
    focal_px: [f64; 2],
    principal_px: Vec<f64>,
    lens: String,
    distortion: Vec<f64>,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct MountConfig {
    translation_m: [f64; 3],
    orientation: String,
    roll_pitch_yaw_deg: [f64; 3],
    rotation_wxyz: [f64; 4],
}

/// Maximum distance of a camera from the vehicle's origin along each axis, in metres.
const MAX_MOUNT_M: f64 = 5.0;
/// The values of `mount.roll_pitch_yaw_deg` and `mount.rotation_wxyz` in `camera-pub.toml`, which mean that neither is set.
const UNUSED_DEG: [f64; 3] = [0.0, 0.0, 90.0];
const UNUSED_WXYZ: [f64; 4] = [1.0, 0.0, 0.0, 0.0];
/// By how much of an eighth of a turn an angle in radians may be rounded: 1.57 is.
const MAX_RADIANS_OFF: f64 = 3e-3;

/// Frame rates that a source may have, in Hz.
pub(crate) const RATES_HZ: std::ops::RangeInclusive<f64> = 0.01..=1000.0;

impl Settings for Config {
    const DEFAULTS: &'static str = include_str!("../camera-pub.toml");

    fn from_table(table: node::config::Table) -> Result<Self, node::config::TableError> {
        table.try_into()
    }

    fn check(&self, check: &mut Check<'_>) {
        check.name("id", &self.id);
        check.range("source.rate_hz", self.source.rate_hz, RATES_HZ);
        check.parses("source.bayer", self.source.bayer_pattern());
        check.parses("source.binning", self.source.checked_binning());
        check.range("source.max_megapixels", self.source.max_megapixels, 0.001..=4294.0);
        check.one_of("source.pixels", &self.source.pixels, PIXEL_FORMATS);
        check.range("source.bits", self.source.bits, 9..=16);
        check.parses("source.bits", self.source.needs_gray16());
        check.range("source.delay_ms", self.source.delay_ms, 0.0..=10_000.0);
        check.one_of("source.stamp_at", &self.source.stamp_at, STAMP_INSTANTS);
        check.range("source.readout_ms", self.source.readout_ms, 0.0..=1000.0);
        check.range("source.timeout_s", self.source.timeout_s, 0.1..=3600.0);
        let fourccs = Pixels::ALL.map(|(fourcc, _)| fourcc);
        check.one_of("source.fourcc", &self.source.fourcc, &fourccs);
        if self.source.genicam.is_empty() {
            check.parses("source.controls", self.source.control_values());
        }
        check.parses("source.command", self.source.program());
        check.parses("source.device", self.device());
        check.parses("source.genicam", self.source.genicam());
        check.parses("source.rtsp", self.source.rtsp());
        check.parses("exposure.control", self.exposure.needs_device(&self.source));
        check.range("exposure.max_ms", self.exposure.max_ms, 0.1..=100.0);
        check.range("exposure.max_gain", self.exposure.max_gain, 1.0..=1000.0);
        check.range("exposure.settle_frames", self.exposure.settle_frames, 0..=30);
        for (key, value, range) in self.air.ranges() {
            check.range(key, value, range);
        }
        self.calibration.check(check);
        self.mount.check(check);
    }
}

impl Config {
    /// The camera's name, which is the service's instance.
    pub fn instance(&self) -> &str {
        &self.id
    }

    /// Maximum pixels of an image.
    pub(crate) fn max_pixels(&self) -> u64 {
        (self.source.max_megapixels * 1e6) as u64
    }

    /// The intrinsics for images of this size; `None` for an uncalibrated camera.
    pub(crate) fn intrinsics(&self, size: FrameSize) -> anyhow::Result<Option<CameraModel>> {
        let [width, height] = [size.width, size.height].map(|edge| edge as u32);
        let calibration = &self.calibration;
        if calibration.file != Path::new("") {
            let file = CalibrationFile::read(&calibration.file)?;
            let camera = file.camera_in([width, height], calibration.wanted_mode())?;
            return Ok(Some(camera));
        }
        let [fx, fy] = calibration.focal_px;
        if fx == 0.0 || fy == 0.0 {
            return Ok(None);
        }
        let Ok(distortion) = calibration.lens() else {
            bail!("`calibration.distortion` is invalid");
        };
        let middle = CameraModel::pinhole(width, height, fx);
        let (cx, cy) = match *calibration.principal_px.as_slice() {
            [cx, cy] => (cx, cy),
            _ => (middle.cx, middle.cy),
        };
        Ok(Some(CameraModel { fy, cx, cy, distortion, ..middle }))
    }

    /// True when the exposure follows the marker.
    pub(crate) fn exposes_for_marker(&self) -> bool {
        self.exposure.control == ExposureControl::Marker
    }

    /// The camera of Video4Linux; `None` where frames come from elsewhere.
    pub(crate) fn device(&self) -> anyhow::Result<Option<DeviceConfig>> {
        let source = &self.source;
        if source.device == Path::new("") {
            return Ok(None);
        }
        ensure!(
            source.paths.is_empty() && source.command.is_empty() && source.bayer.is_empty(),
            "with a device, `source.paths`, `source.command` and `source.bayer` must be empty"
        );
        let size = source.size("the camera's frames; `alight cameras` lists them")?;
        let [width, height] = source.size_px;
        let wanted = Wanted {
            fourcc: source.fourcc.clone(),
            width,
            height,
            rate_hz: source.rate_hz,
            controls: source.control_values()?,
            for_marker: self.exposure.for_marker(),
            stamped_at: source.stamped_at(),
            readout_ns: source.readout_ns(),
            delay_ns: source.delay_ns(),
        };
        Ok(Some(DeviceConfig { path: source.device.clone(), size, wanted }))
    }

    /// The camera's mount on the vehicle.
    pub(crate) fn body_from_camera(&self) -> Transform<Body, Camera> {
        let [x, y, z] = self.mount.translation_m;
        // The check refuses a quaternion of length zero.
        let rotation = self.mount.rotation().unwrap_or_else(Rotation::identity);
        Transform::new(rotation, Point::new(x, y, z))
    }
}

/// The instants that a camera's stamps may be of.
const STAMP_INSTANTS: &[&str] = &["auto", "exposure-start", "readout-start", "frame-end"];

/// Pixel formats that a program may write.
const PIXEL_FORMATS: &[&str] = &["gray8", "gray16", "yuv420", "mjpeg"];

impl SourceConfig {
    /// The program that writes the frames; `None` where they come from files.
    pub(crate) fn program(&self) -> anyhow::Result<Option<ProgramConfig>> {
        if self.command.is_empty() {
            return Ok(None);
        }
        ensure!(self.paths.is_empty(), "with a program, `source.paths` must be empty");
        let size = self.size("the program's frames")?;
        let FrameSize { width, height } = size;
        let pixels = size.pixels();
        let bits = if self.pixels == "gray16" { self.bits } else { 8 };
        let row_bytes = width * bits.div_ceil(8) as usize;
        let stride_bytes = if self.row_bytes == 0 { row_bytes } else { self.row_bytes };
        ensure!(
            (row_bytes..=16 * row_bytes + 4096).contains(&stride_bytes),
            "`source.row_bytes` is {stride_bytes}, but a row has {row_bytes} bytes; write 0 for rows without padding"
        );
        let chroma_bytes = match self.pixels.as_str() {
            "yuv420" => 2 * stride_bytes.div_ceil(2) * height.div_ceil(2),
            _ => 0,
        };
        let is_raw = self.pixels.starts_with("gray");
        ensure!(
            is_raw || self.bayer.is_empty(),
            "`source.bayer` needs `source.pixels` gray8 or gray16"
        );
        let format = match self.pixels.as_str() {
            // A generous bound: a JPEG is smaller than its pixels in all but pathological cases.
            "mjpeg" => FrameFormat::Jpeg { max_bytes: 4 * pixels + (1 << 16) },
            _ => FrameFormat::Samples { row_bytes, stride_bytes, rows: height, chroma_bytes },
        };
        Ok(Some(ProgramConfig {
            command: self.command.clone(),
            size,
            format,
            bits,
            rate_hz: self.rate_hz,
            delay_ns: self.delay_ns(),
            shutter: Shutter {
                // That of libcamera on a Raspberry Pi is when the first pixel arrives (raspberrypi/picamera2, issue 821).
                stamped_at: self.stamped_at().unwrap_or(StampedAt::ReadoutStart),
                readout_ns: self.readout_ns(),
            },
            timeout: Duration::try_from_secs_f64(self.timeout_s)
                .context("`source.timeout_s` is not a time")?,
        }))
    }

    /// The camera of GenICam; `None` where frames come from elsewhere.
    pub(crate) fn genicam(&self) -> anyhow::Result<Option<GenicamConfig>> {
        if self.genicam.is_empty() {
            return Ok(None);
        }
        ensure!(
            cfg!(feature = "genicam"),
            "this program reads no cameras of GenICam: build it with `--features genicam`, which needs the Aravis library (docs/camera.md)"
        );
        ensure!(
            self.paths.is_empty() && self.command.is_empty() && self.device == Path::new(""),
            "with a camera of GenICam, `source.paths`, `source.command` and `source.device` must be empty"
        );
        let wrong = self.controls.iter().find(|control| !control.contains('='));
        ensure!(
            wrong.is_none(),
            "`{}` of `source.controls` is not of the form `Name=value`",
            wrong.map_or("", String::as_str)
        );
        Ok(Some(GenicamConfig {
            name: self.genicam.clone(),
            size: self.size("the camera's frames")?,
            rate_hz: self.rate_hz,
            features: self.controls.clone(),
            bayer: self.bayer_pattern()?,
            shutter: Shutter {
                stamped_at: self.stamped_at().unwrap_or(StampedAt::ExposureStart),
                readout_ns: self.readout_ns(),
            },
            delay_ns: self.delay_ns(),
        }))
    }

    /// The camera that streams over RTSP; `None` where frames come from elsewhere.
    pub(crate) fn rtsp(&self) -> anyhow::Result<Option<RtspConfig>> {
        if self.rtsp.is_empty() {
            return Ok(None);
        }
        ensure!(
            cfg!(feature = "rtsp"),
            "this program reads no streams of RTSP: build it with `--features rtsp`, or read the camera by `source.command` with \
             ffmpeg (docs/camera.md)"
        );
        ensure!(
            self.paths.is_empty()
                && self.command.is_empty()
                && self.genicam.is_empty()
                && self.device == Path::new(""),
            "with a stream of RTSP, `source.paths`, `source.command`, `source.device` and `source.genicam` must be empty"
        );
        ensure!(
            without_credentials(&self.rtsp) == self.rtsp,
            "it has a name or password in it: write user:password into a file that only you can read, and name that in \
             `source.rtsp_credentials`"
        );
        let host = self.rtsp.strip_prefix("rtsp://").and_then(|rest| rest.split('/').next());
        ensure!(
            host.is_some_and(|host| !host.is_empty()),
            "it is not an address of the form rtsp://HOST:PORT/STREAM"
        );
        let credentials = &self.rtsp_credentials;
        Ok(Some(RtspConfig {
            url: self.rtsp.clone(),
            credentials: (credentials != Path::new("")).then(|| credentials.clone()),
            size: self.size("the stream's pictures")?,
            rate_hz: self.rate_hz,
            stamps: self.rtsp_stamps,
            delay_ns: self.delay_ns(),
            max_pixels: (self.max_megapixels * 1e6) as u64,
        }))
    }

    /// How many samples, across and down, are averaged to a pixel of a frame.
    pub(crate) fn binning(&self) -> usize {
        self.binning.max(1) as usize
    }

    fn needs_gray16(&self) -> Result<(), &'static str> {
        let fits = self.bits == 16 || self.pixels == "gray16";
        holds(fits, "it is not 16, which needs `source.pixels` gray16")
    }

    fn checked_binning(&self) -> anyhow::Result<()> {
        let is_raw = !self.genicam.is_empty()
            || (!self.command.is_empty() && self.pixels.starts_with("gray"));
        ensure!(
            (1..=16).contains(&self.binning),
            "it is {}; it must be from 1 to 16",
            self.binning
        );
        if self.binning == 1 {
            return Ok(());
        }
        ensure!(
            is_raw,
            "raw frames are binned, of a program with `source.pixels` gray8 or gray16, or of a camera of GenICam"
        );
        ensure!(
            self.bayer.is_empty() || self.binning.is_multiple_of(2),
            "it is {}, and behind a Bayer pattern it must be even: else a pixel has more of one colour than its neighbour",
            self.binning
        );
        ensure!(
            self.size_px.iter().all(|edge| edge.is_multiple_of(self.binning)),
            "`source.size_px` is {:?}; both must be multiples of the binning",
            self.size_px
        );
        Ok(())
    }

    /// The size of a camera's frames.
    fn size(&self, whose: &str) -> anyhow::Result<FrameSize> {
        let [width, height] = self.size_px.map(|edge| edge as usize);
        let size = FrameSize { width, height };
        let (pixels, edge) = (size.pixels(), GrayView::MAX_EDGE_PX);
        ensure!(
            pixels > 0 && width.max(height) <= edge && pixels as f64 <= self.max_megapixels * 1e6,
            "`source.size_px` is [{width}, {height}]; it must be the width and height of {whose}, within \
             `source.max_megapixels` ({}) and {edge} pixels per edge",
            self.max_megapixels
        );
        Ok(size)
    }

    /// Names and values of the controls.
    fn control_values(&self) -> anyhow::Result<Vec<ControlValue>> {
        let values = self.controls.iter().map(|control| {
            let (name, value) = control.split_once('=').with_context(|| {
                format!("`{control}` is not of the form `name=value`, as `gain=10`")
            })?;
            let value = value.trim().parse();
            let value =
                value.with_context(|| format!("the value of `{control}` is not a number"))?;
            Ok(ControlValue { name: name.trim().to_owned(), value })
        });
        values.collect()
    }

    /// The instant of the camera's stamps, if it is configured.
    fn stamped_at(&self) -> Option<StampedAt> {
        match self.stamp_at.as_str() {
            "exposure-start" => Some(StampedAt::ExposureStart),
            "readout-start" => Some(StampedAt::ReadoutStart),
            "frame-end" => Some(StampedAt::FrameEnd),
            _ => None,
        }
    }

    fn readout_ns(&self) -> i64 {
        (self.readout_ms * 1e6) as i64
    }

    fn delay_ns(&self) -> i64 {
        (self.delay_ms * 1e6) as i64
    }

    /// The sensor's Bayer pattern.
    pub(crate) fn bayer_pattern(&self) -> anyhow::Result<Option<BayerPattern>> {
        Ok(match self.bayer.as_str() {
            "" => None,
            name => Some(name.parse()?),
        })
    }
}

impl ExposureConfig {
    fn for_marker(&self) -> Option<ForMarker> {
        (self.control == ExposureControl::Marker).then(|| ForMarker {
            max_exposure_s: self.max_ms * 1e-3,
            gain: self.gain.clone(),
            max_gain: self.max_gain,
            settle_frames: self.settle_frames,
        })
    }

    fn needs_device(&self, source: &SourceConfig) -> Result<(), &'static str> {
        let has_device = source.device != Path::new("");
        holds(
            has_device || self.control == ExposureControl::Camera,
            "`marker` needs `source.device`: the exposure of a program or of files is set elsewhere",
        )
    }
}

impl CalibrationConfig {
    fn check(&self, check: &mut Check<'_>) {
        let [fx, fy] = self.focal_px;
        let focal_holds =
            [fx, fy].iter().all(|f| (0.0..=1e6).contains(f)) && (fx == 0.0) == (fy == 0.0);
        check.parses(
            "calibration.focal_px",
            holds(focal_holds, "both must be above 0 and at most 1e6, or both 0"),
        );
        let principal_holds = match *self.principal_px.as_slice() {
            [] => true,
            [cx, cy] => [cx, cy].iter().all(|c| (-1e6..=1e6).contains(c)),
            _ => false,
        };
        check.parses(
            "calibration.principal_px",
            holds(principal_holds, "it must be [cx, cy], each from -1e6 to 1e6, or empty"),
        );
        check.one_of(
            "calibration.lens",
            &self.lens,
            &["pinhole", "brown-conrady", "kannala-brandt"],
        );
        check.parses("calibration.distortion", self.lens());
        check.range("calibration.binning", self.binning, 0..=64);
        check.parses(
            "calibration.region_px",
            holds(
                matches!(self.region_px.len(), 0 | 4),
                "it must be [left, top, width, height] in pixels of the sensor, or empty",
            ),
        );
        let has_file = self.file != Path::new("");
        let otherwise = "it needs `calibration.file`: `calibration.focal_px` and all keys below are of the published frames";
        check.parses("calibration.binning", holds(has_file || self.binning == 0, otherwise));
        let is_whole = self.region_px.is_empty();
        check.parses("calibration.region_px", holds(has_file || is_whole, otherwise));
    }

    /// The mode that the frames are taken in, as far as it is configured.
    fn wanted_mode(&self) -> WantedMode {
        let region = match *self.region_px.as_slice() {
            [left, top, width, height] => Some(SensorRegion { left, top, width, height }),
            _ => None,
        };
        WantedMode { region, binning: (self.binning > 0).then_some(self.binning) }
    }

    fn lens(&self) -> Result<Distortion, &'static str> {
        let k = &self.distortion;
        if k.iter().any(|k| !(-1e6..=1e6).contains(k)) {
            return Err("each must be from -1e6 to 1e6");
        }
        match self.lens.as_str() {
            "brown-conrady" if k.len() <= 8 => {
                let mut all = [0.0; 8];
                for (slot, k) in all.iter_mut().zip(k) {
                    *slot = *k;
                }
                Ok(Distortion::BrownConrady(all))
            }
            "brown-conrady" => Err("a brown-conrady lens has at most 8 coefficients"),
            "kannala-brandt" => k
                .as_slice()
                .try_into()
                .map(Distortion::KannalaBrandt)
                .map_err(|_cause| "a kannala-brandt lens has 4 coefficients"),
            _ if k.is_empty() => Ok(Distortion::None),
            _ => Err("a pinhole lens has no coefficients; set `calibration.lens`"),
        }
    }
}

impl MountConfig {
    fn check(&self, check: &mut Check<'_>) {
        let within = |values: &[f64], max: f64| values.iter().all(|v| (-max..=max).contains(v));
        check.parses(
            "mount.translation_m",
            holds(
                within(&self.translation_m, MAX_MOUNT_M),
                "each must be from -5 to 5: it is in metres, from the autopilot to the camera",
            ),
        );
        check.one_of(
            "mount.orientation",
            &self.orientation,
            &["down", "forward", "angles", "quaternion"],
        );
        check.parses(
            "mount.roll_pitch_yaw_deg",
            holds(within(&self.roll_pitch_yaw_deg, 360.0), "each must be from -360 to 360"),
        );
        check.parses(
            "mount.roll_pitch_yaw_deg",
            holds(
                !self.roll_pitch_yaw_deg.iter().any(|&angle| is_radians(angle)),
                "these look like radians: write degrees, 90 for a quarter turn",
            ),
        );
        check.parses(
            "mount.roll_pitch_yaw_deg",
            holds(
                self.orientation == "angles" || self.roll_pitch_yaw_deg == UNUSED_DEG,
                "it has no effect with this `mount.orientation`: set that to angles, or leave this out",
            ),
        );
        check.parses(
            "mount.rotation_wxyz",
            holds(
                self.orientation == "quaternion" || self.rotation_wxyz == UNUSED_WXYZ,
                "it has no effect with this `mount.orientation`: set that to quaternion, or leave this out",
            ),
        );
        check.parses(
            "mount.rotation_wxyz",
            self.rotation().ok_or("it must be a quaternion w, x, y, z of a length above 0"),
        );
    }

    fn rotation(&self) -> Option<Rotation<Body, Camera>> {
        match self.orientation.as_str() {
            "quaternion" => Rotation::from_wxyz(self.rotation_wxyz),
            // Image right is vehicle right, image down is down, depth is forward.
            "forward" => Rotation::from_wxyz([0.5; 4]),
            "angles" => {
                let [roll, pitch, yaw] = self.roll_pitch_yaw_deg.map(f64::to_radians);
                Some(Rotation::from_euler(roll, pitch, yaw))
            }
            _ => Some(Rotation::from_euler(0.0, 0.0, std::f64::consts::FRAC_PI_2)),
        }
    }
}

/// Whether an angle of a mount is an eighth, a quarter, three eighths, a half, three quarters or the whole of a turn in radians: in degrees
/// no mount is made to such digits. Five eighths of a turn would be 5.5 degrees as well.
fn is_radians(angle: f64) -> bool {
    let eighths = angle / std::f64::consts::FRAC_PI_4;
    let nearest = eighths.round();
    let is_usual = [1.0, 2.0, 3.0, 4.0, 6.0, 8.0].contains(&nearest.abs());
    is_usual && (eighths - nearest).abs() < MAX_RADIANS_OFF
}

fn holds(holds: bool, otherwise: &'static str) -> Result<(), &'static str> {
    if holds { Ok(()) } else { Err(otherwise) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::Vector;
    use node::Layers;

    #[test]
    fn angles_in_radians_are_distinguished_from_those_in_degrees() {
        for eighths in [1.0, -2.0, 3.0, 4.0, -6.0, 8.0] {
            let angle = (eighths * std::f64::consts::FRAC_PI_4 * 1000.0_f64).round() / 1000.0;
            assert!(is_radians(angle), "{angle}");
        }
        for tenths in (-3600..=3600).map(f64::from) {
            assert!(!is_radians(tenths / 10.0), "{tenths} tenths of a degree");
        }
    }

    fn load(set: &[&str]) -> Result<Config, String> {
        let set = set.iter().map(|s| (*s).to_owned()).collect();
        let layers = Layers { file: None, set };
        layers.load().map(|c| c.settings).map_err(|e| e.to_string())
    }

    #[test]
    fn the_defaults_are_an_uncalibrated_camera_that_looks_down() {
        let config = load(&[]).unwrap();
        assert_eq!(config.instance(), "down");
        assert!(config.intrinsics(FrameSize { width: 640, height: 480 }).unwrap().is_none());
        let ahead = config.body_from_camera() * Vector::new(0.0, 0.0, 1.0);
        let top = config.body_from_camera() * Vector::new(0.0, -1.0, 0.0);
        assert!((ahead - Vector::new(0.0, 0.0, 1.0)).norm() < 1e-12);
        assert!((top - Vector::new(1.0, 0.0, 0.0)).norm() < 1e-12);
    }

    #[test]
    fn the_image_of_a_forward_camera_has_the_sky_at_its_top() {
        let mount = load(&["mount.orientation=forward"]).unwrap().body_from_camera();
        let right = mount * Vector::new(1.0, 0.0, 0.0);
        let top = mount * Vector::new(0.0, -1.0, 0.0);
        assert!((right - Vector::new(0.0, 1.0, 0.0)).norm() < 1e-12);
        assert!((top - Vector::new(0.0, 0.0, -1.0)).norm() < 1e-12);
    }

    #[test]
    fn angles_and_quaternions_agree() {
        let down = load(&[]).unwrap().body_from_camera();
        let straight = ["mount.orientation=angles", "mount.roll_pitch_yaw_deg=[0, 1.5, -90]"];
        assert!(load(&straight).is_ok());
        let angles = load(&["mount.orientation=angles"]).unwrap().body_from_camera();
        let quaternion =
            load(&["mount.orientation=quaternion", "mount.rotation_wxyz=[1, 0, 0, 1]"]).unwrap();
        for other in [angles, quaternion.body_from_camera()] {
            assert!((down.rotation().inverse() * other.rotation()).angle() < 1e-7);
        }
    }

    #[test]
    fn intrinsics_come_from_keys() {
        let config = load(&["calibration.focal_px=[900, 901]"]).unwrap();
        let camera = config.intrinsics(FrameSize { width: 640, height: 480 }).unwrap().unwrap();
        assert_eq!([camera.fx, camera.fy, camera.cx, camera.cy], [900.0, 901.0, 319.5, 239.5]);
        let config = load(&[
            "calibration.focal_px=[900, 900]",
            "calibration.principal_px=[300, 200]",
            "calibration.lens=brown-conrady",
            "calibration.distortion=[-0.3, 0.1]",
        ]);
        let camera =
            config.unwrap().intrinsics(FrameSize { width: 640, height: 480 }).unwrap().unwrap();
        let k = [-0.3, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        assert_eq!((camera.cx, camera.distortion), (300.0, Distortion::BrownConrady(k)));
    }

    #[test]
    fn a_calibration_for_another_size_is_refused() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let text = "cam0: {camera_model: pinhole, intrinsics: [500, 500, 320, 240], resolution: [640, 480]}";
        std::fs::write(file.path(), text).unwrap();
        let config = load(&[&format!("calibration.file={}", file.path().display())]).unwrap();
        assert_eq!(
            config.intrinsics(FrameSize { width: 640, height: 480 }).unwrap().unwrap().fx,
            500.0
        );
        let problem =
            config.intrinsics(FrameSize { width: 320, height: 240 }).unwrap_err().to_string();
        assert!(problem.contains("for images of 640 x 480") && problem.contains("have 320 x 240"));
    }

    #[test]
    fn the_format_of_a_programs_frames_follows_from_the_keys() {
        let format = |set: &[&str]| {
            let all = [&["source.command=['cat']", "source.size_px=[5, 3]"], set].concat();
            load(&all).unwrap().source.program().unwrap().unwrap().format
        };
        let samples = |row_bytes, stride_bytes, chroma_bytes| FrameFormat::Samples {
            row_bytes,
            stride_bytes,
            rows: 3,
            chroma_bytes,
        };
        assert_eq!(format(&[]), samples(5, 5, 0));
        assert_eq!(format(&["source.pixels=gray16"]), samples(10, 10, 0));
        assert_eq!(format(&["source.pixels=gray16", "source.bits=9"]), samples(10, 10, 0));
        // Two chroma planes of half the width and height, both rounded up.
        assert_eq!(format(&["source.pixels=yuv420"]), samples(5, 5, 12));
        assert_eq!(format(&["source.pixels=yuv420", "source.row_bytes=8"]), samples(5, 8, 16));
        assert!(matches!(format(&["source.pixels=mjpeg"]), FrameFormat::Jpeg { .. }));
        assert!(load(&[]).unwrap().source.program().unwrap().is_none());
    }

    #[test]
    fn impossible_values_are_refused() {
        let check = |set: &[&str], part: &str| {
            let problem = load(set).unwrap_err();
            assert!(problem.contains(part), "`{part}` is not in: {problem}");
        };
        check(&["id=a/b"], "letters, digits");
        check(&["source.rate_hz=0"], "from 0.01 to 1000");
        check(&["source.rate_hz=inf"], "from 0.01 to 1000");
        check(&["source.max_megapixels=nan"], "from 0.001 to 4294");
        check(&["air.quality=0"], "from 1 to 100");
        check(&["calibration.focal_px=[900, 0]"], "or both 0");
        check(&["calibration.focal_px=[nan, 900]"], "above 0");
        check(&["calibration.principal_px=[1]"], "[cx, cy]");
        check(
            &["calibration.focal_px=[900, 900]", "calibration.binning=2"],
            "needs `calibration.file`",
        );
        check(&["calibration.region_px=[0, 0, 640, 480]"], "needs `calibration.file`");
        check(&["calibration.lens=fish"], "kannala-brandt");
        check(&["calibration.distortion=[1]"], "`calibration.lens`");
        check(&["calibration.lens=kannala-brandt"], "4 coefficients");
        check(&["mount.orientation=up"], "down, forward");
        check(&["mount.translation_m=[0, 0, 12]"], "-5 to 5: it is in metres");
        let angles =
            |deg: &'static str, part: &str| check(&["mount.orientation=angles", deg], part);
        angles("mount.roll_pitch_yaw_deg=[0, 0, 1.5708]", "look like radians");
        angles("mount.roll_pitch_yaw_deg=[0.02, -0.78539816, 1.57]", "look like radians");
        angles("mount.roll_pitch_yaw_deg=[3.14, 0, 4.712]", "look like radians");
        check(&["mount.roll_pitch_yaw_deg=[0, 0, 180]"], "set that to angles");
        check(&["mount.rotation_wxyz=[0, 0, 0, 1]"], "set that to quaternion");
        check(&["mount.roll_pitch_yaw_rad=[0, 0, 1.5]"], "did you mean `mount.roll_pitch_yaw_deg`");
        check(&["mount.orientation=quaternion", "mount.rotation_wxyz=[0,0,0,0]"], "a quaternion");
        check(&["source.path='x'"], "did you mean `source.paths`");
        check(&["source.command=['cat']"], "`source.size_px` is [0, 0]");
        let camera = |more: &[&'static str], part: &str| {
            check(&[&["source.command=['cat']", "source.size_px=[64, 48]"], more].concat(), part);
        };
        camera(&["source.paths=['x']"], "`source.paths` must be empty");
        camera(&["source.pixels=rgb"], "gray8, gray16");
        camera(&["source.pixels=gray16", "source.bits=8"], "from 9 to 16");
        camera(&["source.bits=10"], "needs `source.pixels` gray16");
        camera(&["source.row_bytes=63"], "a row has 64 bytes");
        camera(&["source.pixels=yuv420", "source.bayer=RGGB"], "gray8 or gray16");
        camera(&["source.delay_ms=-1"], "from 0 to 10000");
        camera(&["source.binning=0"], "from 1 to 16");
        camera(&["source.binning=3", "source.bayer=RGGB"], "must be even");
        camera(&["source.binning=5"], "multiples of the binning");
        camera(&["source.binning=2", "source.pixels=yuv420"], "raw frames are binned");
        camera(&["source.timeout_s=0"], "from 0.1 to 3600");
        camera(&["source.timeout_s=-1"], "from 0.1 to 3600");
        camera(&["source.timeout_s=nan"], "from 0.1 to 3600");
        camera(&["source.timeout_s=1e30"], "from 0.1 to 3600");
        camera(&["source.stamp_at=middle"], "auto, exposure-start");
        camera(&["source.readout_ms=-1"], "from 0 to 1000");
        camera(&["source.device=/dev/video0"], "`source.command`");
        check(&["source.device=/dev/video0"], "`alight cameras` lists them");
        check(&["source.fourcc=H264"], "GREY, NV12");
        check(&["source.rtsp_stamps=ntp"], "unknown variant");
        for url in ["rtsp://admin:s3cret@host/x", "rtsp://admin:s3/cret@host/x"] {
            let problem = load(&[&format!("source.rtsp={url}")]).unwrap_err();
            assert!(!problem.contains("s3"), "{problem}");
            assert!(
                !cfg!(feature = "rtsp") || problem.contains("`source.rtsp_credentials`"),
                "{problem}"
            );
        }
        check(&["source.controls=['gain']"], "`name=value`");
        check(&["source.controls=['gain=much']"], "not a number");
    }
}
