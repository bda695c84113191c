//! What a detector publishes, and what it can be told.

use serde::{Deserialize, Serialize};

use crate::camera::FrameHeader;
pub use crate::camera::Transform3;
use crate::codec::wire;

wire! {
    Detections = 3 v 3;
    DetectorCommand = 13 v 2;
    DetectorInfo = 15 v 1;
}

/// What a detector found in one frame; also sent when it found nothing.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Detections {
    /// The detector's name.
    pub detector: String,
    /// The header of the frame, unchanged.
    pub header: FrameHeader,
    /// The markers that were found, best first.
    pub detections: Vec<Detection>,
    /// How long each stage took, in the order in which they ran.
    pub stages: Vec<StageTime>,
}

/// A marker found in a frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Detection {
    /// The marker's family.
    pub family: String,
    /// Its id, where the family has ids.
    pub id: Option<u32>,
    /// The projection of its centre, in pixels.
    pub centre_px: [f64; 2],
    /// Covariance of the centre in square pixels: xx, xy, yy.
    pub centre_covariance_px2: [f32; 3],
    /// Its corners in pixels, its own top-left first, then clockwise as seen in the image.
    pub corners_px: Option<[[f64; 2]; 4]>,
    /// Its largest extent in the image, in pixels.
    pub size_px: f64,
    /// Bits of its code that were read wrongly and corrected; 0 for families without a code.
    pub wrong_bits: u8,
    /// From 0 (a guess) to 1 (certain).
    pub confidence: f64,
    /// Where it is, when its size and the camera are known.
    pub pose: Option<MarkerPose>,
}

/// Where a marker is.
#[derive(Copy, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MarkerPose {
    /// The marker frame in the camera frame.
    pub camera_from_marker: Transform3,
    /// Root mean square distance, in pixels, between the image's edges and the pose's.
    pub reprojection_rms_px: f64,
    /// Covariance of translation (x, y, z in metres) and rotation (a rotation vector in radians, applied after the
    /// pose), both in the camera frame: the upper triangle of the 6 x 6 matrix, row by row.
    pub covariance: [f32; 21],
    /// The other place from which a flat marker looks much the same, if there is one.
    pub alternative: Option<AlternativePose>,
}

/// The second of the two poses that a flat marker's image allows.
#[derive(Copy, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AlternativePose {
    /// The marker frame in the camera frame.
    pub camera_from_marker: Transform3,
    /// Root mean square distance, in pixels, between the image's edges and this pose's.
    pub reprojection_rms_px: f64,
}

/// How long a stage took.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StageTime {
    /// The stage's name.
    pub stage: String,
    /// Its duration in microseconds.
    pub micros: u32,
}

/// What a detector can be told; answered with a [`crate::CommandReply`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum DetectorCommand {
    /// Change a parameter from the next frame on.
    SetParameter {
        /// Its key in the detector's configuration.
        key: String,
        /// Its new value, in TOML.
        value: String,
    },
    /// End, with exit status 0: another detector has taken over.
    Stop,
}

/// What a detector says about itself.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DetectorInfo {
    /// The detector's name.
    pub detector: String,
    /// The host it runs on.
    pub host: String,
    /// Where that host is.
    pub place: Place,
    /// The camera whose frames it searches.
    pub camera: String,
    /// The markers it looks for, as `FAMILY:ID:SIZE_M`.
    pub markers: Vec<String>,
    /// Its program and version.
    pub version: String,
    /// Process id on its host.
    pub pid: u32,
}

/// Where a detector runs.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Place {
    /// On the vehicle.
    Onboard,
    /// On the ground.
    Ground,
}

impl Place {
    /// Its name in configurations and commands.
    pub fn name(self) -> &'static str {
        match self {
            Self::Onboard => "onboard",
            Self::Ground => "ground",
        }
    }
}
