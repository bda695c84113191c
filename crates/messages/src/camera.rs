//! Messages of a camera: the header of a frame with its parts, the acknowledgement of one, camera information (lens, mount), and how the
//! exposure is set.

use libm::fmax;
use serde::{Deserialize, Serialize};

use crate::codec::wire;

wire! {
    FrameHeader = 1 v 3;
    CameraInfo = 2 v 1;
    FrameAck = 16 v 1;
    CameraControl = 23 v 1;
}

/// Layout of a frame's pixels in its payload, row by row without gaps.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum PixelFormat {
    /// One byte per pixel, grey.
    Mono8,
    /// A JPEG file.
    Jpeg,
    /// Two bytes per pixel, little-endian, 10 significant bits; grey.
    Mono10,
    /// As `Mono10`, with 12 bits.
    Mono12,
    /// As `Mono10`, with 16 bits.
    Mono16,
    /// One byte per pixel, behind a Bayer filter.
    Bayer8(BayerPattern),
    /// Two bytes per pixel, little-endian, 10 significant bits, behind a Bayer filter.
    Bayer10(BayerPattern),
    /// As `Bayer10`, with 12 bits.
    Bayer12(BayerPattern),
    /// As `Bayer10`, with 16 bits.
    Bayer16(BayerPattern),
}

/// The Bayer pattern: colours of the first two pixels of the first two rows.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum BayerPattern {
    /// Red, green; green, blue.
    Rggb,
    /// Green, red; blue, green.
    Grbg,
    /// Green, blue; red, green.
    Gbrg,
    /// Blue, green; green, red.
    Bggr,
}

impl PixelFormat {
    /// Bytes per pixel; `None` for compressed formats.
    pub fn bytes_per_pixel(self) -> Option<usize> {
        match self {
            Self::Jpeg => None,
            Self::Mono8 | Self::Bayer8(_) => Some(1),
            Self::Mono10
            | Self::Mono12
            | Self::Mono16
            | Self::Bayer10(_)
            | Self::Bayer12(_)
            | Self::Bayer16(_) => Some(2),
        }
    }
}

/// The metadata of a frame; it goes unchanged with everything that is derived from the frame.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FrameHeader {
    /// The camera's name.
    pub camera: String,
    /// Frame counter of this camera since its start.
    pub sequence: u64,
    /// Mid-exposure, in nanoseconds of `clock`.
    pub stamp_ns: i64,
    /// Name of the stamp's clock; processes that share a clock use the same name.
    pub clock: String,
    /// Exposure time in nanoseconds; 0 when unknown.
    pub exposure_ns: u32,
    /// Width of the whole frame in pixels, also when the payload has only parts of it.
    pub width: u32,
    /// Height of the whole frame in pixels.
    pub height: u32,
    /// Format of the payload.
    pub format: PixelFormat,
    /// Parts of the frame in the payload, one file after the other, finest first; empty for the whole frame.
    pub parts: Vec<FramePart>,
}

/// A rectangle of a frame as a separate file, at full or reduced resolution.
///
/// The part's pixel (u, v) is the mean of `scale` x `scale` pixels of the frame, the first of which is (`x` +
/// `scale` u, `y` + `scale` v); so its centre is at `x` + `scale` u + (`scale` - 1) / 2 in the frame, and
/// likewise downwards.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FramePart {
    /// Its left edge in the frame, in pixels of the frame.
    pub x: u32,
    /// Its upper edge in the frame, in pixels of the frame.
    pub y: u32,
    /// Its width in its own pixels.
    pub width: u32,
    /// Its height in its own pixels.
    pub height: u32,
    /// Pixels of the frame along the edge of one of the part's pixels; from 1.
    pub scale: u32,
    /// Bytes of its file.
    pub bytes: u32,
}

/// Acknowledges a frame of the air link; sent when the frame has arrived, before it is searched.
///
/// It carries the frame's stamp back to the clock it was taken from, so the round trip is one subtraction and
/// needs no synchronised clocks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FrameAck {
    /// The frame's camera.
    pub camera: String,
    /// The frame's number.
    pub sequence: u64,
    /// The frame's stamp.
    pub stamp_ns: i64,
    /// The frame's clock.
    pub clock: String,
    /// Bytes of its payload.
    pub bytes: u32,
}

/// A rigid transform on the wire, `to_from_from` as in its field's name.
#[derive(Copy, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Transform3 {
    /// Origin of `from` as seen in `to`, in metres.
    pub translation_m: [f64; 3],
    /// The rotation as a unit quaternion w, x, y, z.
    pub rotation_wxyz: [f64; 4],
}

/// Lens distortion.
#[derive(Copy, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum LensModel {
    /// None.
    Pinhole,
    /// Brown-Conrady: k1, k2, p1, p2, k3, k4, k5, k6.
    BrownConrady([f64; 8]),
    /// Kannala-Brandt fisheye: k1 to k4.
    KannalaBrandt([f64; 4]),
}

/// A camera's calibration and mount.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CameraInfo {
    /// The camera's name.
    pub camera: String,
    /// Width of its frames in pixels.
    pub width: u32,
    /// Height of its frames in pixels.
    pub height: u32,
    /// Focal lengths fx, fy in pixels; `None` for a camera that is not calibrated.
    pub focal_px: Option<[f64; 2]>,
    /// Principal point cx, cy in pixels, the centre of the top-left pixel being (0, 0).
    pub principal_px: [f64; 2],
    /// The lens.
    pub lens: LensModel,
    /// The mount: the camera frame in the vehicle's body frame (FRD).
    pub body_from_camera: Transform3,
}

/// Minimum and maximum focal length relative to the image's width.
const FOCAL_PER_WIDTH: std::ops::RangeInclusive<f64> = 0.05..=50.0;
/// Maximum width and height of a frame, in pixels.
const MAX_PIXELS: u32 = 65_535;
/// Maximum distance of a camera from the body's origin, in metres.
const MAX_MOUNT_M: f64 = 100.0;
/// Maximum difference of two numbers of one calibration, relative to their size: they may have been rounded.
const MAX_DIFFERENCE: f64 = 1e-6;

impl CameraInfo {
    /// The first value that no camera can have, as text; `None` for a plausible calibration and mount.
    pub fn problem(&self) -> Option<String> {
        let (width, height) = (self.width, self.height);
        if !(1..=MAX_PIXELS).contains(&width) || !(1..=MAX_PIXELS).contains(&height) {
            return Some(format!("{width} x {height} pixels"));
        }
        if let Some([fx, fy]) = self.focal_px {
            let is_possible = |f: f64| FOCAL_PER_WIDTH.contains(&(f / f64::from(width)));
            if !is_possible(fx) || !is_possible(fy) {
                return Some(format!("focal lengths of {fx} and {fy} pixels"));
            }
        }
        if !self.principal_px.iter().all(|c| c.is_finite()) {
            return Some(format!("a principal point of {:?}", self.principal_px));
        }
        if !self.lens_numbers().iter().all(|k| k.is_finite()) {
            return Some(format!("a distortion of {:?}", self.lens));
        }
        let Transform3 { translation_m, rotation_wxyz } = self.body_from_camera;
        if !translation_m.iter().all(|m| m.abs() <= MAX_MOUNT_M) {
            return Some(format!("a mount at {translation_m:?} m"));
        }
        let norm = rotation_wxyz.iter().map(|q| q * q).sum::<f64>().sqrt();
        (!(0.99..=1.01).contains(&norm)).then(|| {
            format!("a mount of the rotation {rotation_wxyz:?}, which is no unit quaternion")
        })
    }

    /// How another calibration of the same camera differs, as text; `None` when it does not.
    pub fn difference(&self, other: &Self) -> Option<String> {
        if (self.width, self.height) != (other.width, other.height) {
            let size = |info: &Self| format!("{} x {}", info.width, info.height);
            return Some(format!("{} and {} pixels", size(self), size(other)));
        }
        let focal = |info: &Self| info.focal_px.unwrap_or_default();
        if self.focal_px.is_some() != other.focal_px.is_some()
            || differ(&focal(self), &focal(other))
        {
            let text = |info: &Self| match info.focal_px {
                Some([fx, fy]) => format!("{fx:.1} x {fy:.1}"),
                None => "none".to_owned(),
            };
            return Some(format!("focal lengths {} and {} pixels", text(self), text(other)));
        }
        if differ(&self.principal_px, &other.principal_px) {
            let [ours, theirs] = [self.principal_px, other.principal_px];
            return Some(format!("principal points {ours:?} and {theirs:?}"));
        }
        let is_kind = std::mem::discriminant(&self.lens) == std::mem::discriminant(&other.lens);
        if !is_kind || differ(&self.lens_numbers(), &other.lens_numbers()) {
            return Some(format!("distortions {:?} and {:?}", self.lens, other.lens));
        }
        let mount = |info: &Self| {
            let Transform3 { translation_m: [x, y, z], rotation_wxyz: [qw, qx, qy, qz] } =
                info.body_from_camera;
            // A rotation has two quaternions.
            let sign = if qw < 0.0 { -1.0 } else { 1.0 };
            [x, y, z, sign * qw, sign * qx, sign * qy, sign * qz]
        };
        let [ours, theirs] = [mount(self), mount(other)];
        differ(&ours, &theirs).then(|| format!("mounts {ours:?} and {theirs:?}"))
    }

    fn lens_numbers(&self) -> Vec<f64> {
        match self.lens {
            LensModel::Pinhole => Vec::new(),
            LensModel::BrownConrady(k) => k.to_vec(),
            LensModel::KannalaBrandt(k) => k.to_vec(),
        }
    }
}

/// The exposure of a camera: the setting of a frame, the requested one for later frames, and why. It follows a frame: at once
/// when `set_by`, `in_use`, `wanted`, `why` or `refused` changes, else once a second, or five times a second while a camera that
/// is exposed for the marker sees one.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CameraControl {
    /// The camera's name.
    pub camera: String,
    /// Number of the frame that it follows; none where that frame was not published, as it repeats the picture before.
    pub sequence: Option<u64>,
    /// Mid-exposure of that frame, in nanoseconds of `clock`.
    pub stamp_ns: i64,
    /// Name of the stamp's clock.
    pub clock: String,
    /// The setter of exposure and gain from now on.
    pub set_by: ExposureSetter,
    /// The setting with which the frame was taken; none while that is not known: a camera with automatic metering does not report it, and while
    /// a change is under way a frame may be from before it.
    pub in_use: Option<ExposureSetting>,
    /// The setting requested for the marker in later frames; none where the marker does not set it.
    pub wanted: Option<ExposureSetting>,
    /// Why that is requested, or why no setting is.
    pub why: ExposureReason,
    /// The device's answer when it refused the setting; none where it did not. The setting is sent again after a second.
    pub refused: Option<String>,
    /// The marker's levels in the frame; none where they were not measured.
    pub levels: Option<MarkerLevels>,
    /// How fast the marker moved lately in the image, in pixels per second; none without a marker.
    pub motion_px_s: Option<f64>,
    /// The limits of `wanted`; none where the exposure does not follow the marker.
    pub limits: Option<ExposureLimits>,
}

/// The setter of a camera's exposure and gain.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ExposureSetter {
    /// No setter: they stay as the configuration, or the last request for the marker, has set them.
    #[default]
    Fixed,
    /// The camera's own metering.
    Camera,
    /// The service, for the marker.
    Marker,
}

/// Why an exposure is requested for the marker, or why none is.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ExposureReason {
    /// By its configuration the camera's exposure does not follow the marker.
    #[default]
    Configured,
    /// No marker was seen for a while: the camera meters automatically.
    NoMarker,
    /// A marker is seen, but was lost soon after the exposure followed it: for a while the camera continues to meter automatically.
    LostSoon,
    /// A marker is seen: exposure and gain are taken over as the camera's metering has chosen them.
    TakenOver,
    /// A change may be under way: frames do not show its effect yet.
    Settling,
    /// The frame shows too little of the marker, or the marker may be elsewhere by now: no change.
    NotInFrame,
    /// Where the marker should be there is no white next to black: no change.
    NoContrast,
    /// The marker's white is right, or as near to it as the steps allow: no change.
    Good,
    /// White is clipped: less light.
    Clipped,
    /// White is too bright: less light.
    TooBright,
    /// White is too dark: more light.
    TooDark,
    /// A longer exposure would blur the marker by more than a pixel: it is made shorter, with more gain, or, at the largest gain,
    /// white stays too dark.
    MotionBlur,
    /// A longer exposure would not blur it: with less gain there is less noise.
    LessNoise,
    /// White is too dark or too bright, and the limits of device or configuration are reached.
    AtLimits,
}

/// An exposure time and a gain.
#[derive(Copy, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ExposureSetting {
    /// Exposure time in nanoseconds.
    pub exposure_ns: u32,
    /// How many times brighter frames are than at the smallest gain: a factor from 1, not decibels. None where the camera's own
    /// unit is not known as one.
    pub gain: Option<f64>,
}

/// Grey levels of a marker in a frame, from 0 to 1 for full scale.
#[derive(Copy, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MarkerLevels {
    /// That of its white, where the light falls on it.
    pub white: f64,
    /// That of its black.
    pub black: f64,
}

/// The limits of a camera's exposure and gain.
#[derive(Copy, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ExposureLimits {
    /// Minimum exposure time in nanoseconds, that of the device.
    pub min_exposure_ns: u32,
    /// Maximum exposure time in nanoseconds: that of the device, of the configuration, or the one in which the marker's motion blurs it by a
    /// pixel.
    pub max_exposure_ns: u32,
    /// Maximum gain, a factor; the minimum is 1.
    pub max_gain: f64,
}

fn differ(ours: &[f64], theirs: &[f64]) -> bool {
    let apart =
        |(a, b): (&f64, &f64)| (a - b).abs() > MAX_DIFFERENCE * fmax(fmax(a.abs(), b.abs()), 1.0);
    ours.len() != theirs.len() || ours.iter().zip(theirs).any(apart)
}
