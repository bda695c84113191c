//! Messages of a detector: detections with poses and stage times, refused candidates, its information, the camera's response;
//! and the commands to it.

use serde::{Deserialize, Serialize};

use crate::camera::{FrameHeader, Transform3};
use crate::codec::wire;

wire! {
    Detections = 3 v 3;
    DetectorCommand = 13 v 2;
    DetectorInfo = 15 v 1;
    CameraResponse = 20 v 1;
    Refusals = 21 v 1;
}

/// The markers that a detector found in one frame; also sent when there are none.
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

/// Splits a marker's name, `FAMILY` or `FAMILY:ID`.
///
/// # Errors
/// States the form of a name.
pub fn marker_name(name: &str) -> Result<(&str, Option<u32>), String> {
    let (family, id) = match name.split_once(':') {
        Some((family, id)) => (family, Some(id)),
        None => (name, None),
    };
    let id = id.map(str::parse).transpose();
    id.ok()
        .filter(|_| !family.is_empty())
        .map(|id| (family, id))
        .ok_or_else(|| "it must be FAMILY or FAMILY:ID, with an integer as ID".to_owned())
}

/// The family of pads of several markers.
const PAD_FAMILY: &str = "pad";

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
    /// Corrected bits of its codeword (Hamming distance); 0 for families without a code.
    pub wrong_bits: u8,
    /// From 0 (a guess) to 1 (certain).
    pub confidence: f64,
    /// Its pose, when its size and the camera are known.
    pub pose: Option<MarkerPose>,
}

/// A marker's pose.
#[derive(Copy, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MarkerPose {
    /// The marker frame in the camera frame.
    pub camera_from_marker: Transform3,
    /// Root mean square distance, in pixels, between the image's edges and the pose's.
    pub reprojection_rms_px: f64,
    /// Covariance of translation (x, y, z in metres) and rotation (a rotation vector in radians, applied
    /// after the pose), both in the camera frame: the upper triangle of the 6 x 6 matrix, row by row.
    pub covariance: [f32; 21],
    /// The second solution of the pose of a flat marker, if there is one.
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

/// The duration of a stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StageTime {
    /// The stage's name.
    pub stage: String,
    /// Its duration in microseconds.
    pub micros: u32,
}

/// Candidates for markers that a detector refused in one frame; published only while there is a subscriber.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Refusals {
    /// The detector's name.
    pub detector: String,
    /// The header of the frame, unchanged.
    pub header: FrameHeader,
    /// How many it refused: of very many only some are listed.
    pub total: u32,
    /// The largest of them, largest first.
    pub refusals: Vec<Refusal>,
}

/// A candidate that was refused.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Refusal {
    /// The first check that it failed, in one word.
    pub reason: String,
    /// Where it is.
    pub shape: RefusedShape,
}

/// The outline of a candidate, in pixels.
#[derive(Copy, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum RefusedShape {
    /// The corners of a square, clockwise as seen in the image.
    Quad([[f32; 2]; 4]),
    /// The two edges of a ring.
    Ring([EllipsePx; 2]),
}

/// An ellipse in an image.
#[derive(Copy, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EllipsePx {
    /// Its centre.
    pub centre_px: [f32; 2],
    /// The full lengths of its minor and its major axis.
    pub axes_px: [f32; 2],
    /// From the image's x axis to the minor axis, turning from x to y.
    pub angle_rad: f32,
}

/// A command to a detector; answered with a [`crate::CommandReply`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum DetectorCommand {
    /// Change a parameter from the next frame on.
    SetParameter {
        /// Its key in the detector's configuration.
        key: String,
        /// Its new value, in TOML.
        value: String,
    },
    /// Exit with status 0: another detector has taken over.
    Stop,
}

/// A detector's identity and settings.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DetectorInfo {
    /// The detector's name.
    pub detector: String,
    /// Name of its host.
    pub host: String,
    /// Where it runs.
    pub place: Place,
    /// The camera whose frames it searches.
    pub camera: String,
    /// The markers it looks for, as `FAMILY:ID:SIZE_M`, and its pads as `pad:ID`.
    pub markers: Vec<String>,
    /// Its program and version.
    pub version: String,
    /// Process id on its host.
    pub pid: u32,
}

/// The response of a camera to light, as a detector estimates it from the markers that it sees, or as it is configured.
///
/// Light from 0 (black ink) to 1 (white paper) has the level `(1 + curve) w / (1 + curve w)` between theirs; then
/// `sharpening` times its difference from a copy blurred by a Gaussian of one pixel is added. Where it is neither configured nor
/// estimated from a marker, the response is unknown, and the other numbers are 0.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CameraResponse {
    /// The detector's name.
    pub detector: String,
    /// The camera whose frames it searches.
    pub camera: String,
    /// Whether it is configured; else it is estimated.
    pub configured: bool,
    /// Number of markers from which it is estimated.
    pub markers: u32,
    /// The tone curve: 0 is linear, 1.1 nearly sRGB.
    pub curve: f64,
    /// Standard deviation of the curve from marker to marker.
    pub curve_deviation: f64,
    /// The amount of the unsharp mask.
    pub sharpening: f64,
    /// Standard deviation of the amount from marker to marker.
    pub sharpening_deviation: f64,
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

impl Detection {
    /// Whether it is of the marker of this name, `FAMILY` or `FAMILY:ID`; of none for an invalid one.
    pub fn is_of(&self, marker: &str) -> bool {
        marker_name(marker)
            .is_ok_and(|(family, id)| self.family == family && (id.is_none() || self.id == id))
    }

    /// The same, and every marker may be of a pad of several.
    pub fn may_be_of(&self, marker: &str) -> bool {
        self.is_of(marker) || marker_name(marker).is_ok_and(|(family, _)| family == PAD_FAMILY)
    }
}

impl Detection {
    /// The name of its marker, `FAMILY` or `FAMILY:ID`.
    pub fn name(&self) -> String {
        match self.id {
            Some(id) => format!("{}:{id}", self.family),
            None => self.family.clone(),
        }
    }

    /// Whether it is surely of another marker than that of this name, nor of one that may stand on a pad of that name.
    pub fn is_other_than(&self, marker: &str) -> bool {
        !self.is_of(marker) && (self.family == PAD_FAMILY || !self.may_be_of(marker))
    }
}

/// Whether a detector that looks for these markers (`FAMILY:ID:SIZE_M`, `FAMILY:SIZE_M`, `pad:ID`) surely never reports the requested
/// one, `FAMILY` or `FAMILY:ID`. Other forms of names are ignored.
pub fn looks_for_others(markers: &[String], requested: &str) -> bool {
    let Ok((family, id)) = marker_name(requested) else { return false };
    let is_other = |text: &String| {
        let parts: Vec<&str> = text.split(':').collect();
        let (of, number) = match parts[..] {
            [PAD_FAMILY, number] if family == PAD_FAMILY => {
                return id.is_some_and(|id| number != id.to_string());
            }
            // The marker may stand on the pad.
            [PAD_FAMILY, _] => return false,
            [of, number, size] if size.parse::<f64>().is_ok() => (of, number),
            [of, number] if number.parse::<f64>().is_ok() => (of, number),
            _ => return false,
        };
        let number = number.parse::<u32>().ok();
        of != family || number.zip(id).is_some_and(|(one, other)| one != other)
    };
    !markers.is_empty() && markers.iter().all(is_other)
}

impl Detections {
    /// The first detection of the marker of this name, `FAMILY` or `FAMILY:ID`; none for an invalid one.
    pub fn first_of(&self, marker: &str) -> Option<&Detection> {
        self.detections.iter().find(|detection| detection.is_of(marker))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_requested_marker_is_found_by_family_and_id() {
        let detection =
            |family: &str, id| Detection { family: family.into(), id, ..Detection::sample() };
        let detections = vec![
            detection("aruco-4x4-50", Some(3)),
            detection("aruco-4x4-50", Some(7)),
            detection("rings", None),
        ];
        let message = Detections { detections, ..Detections::sample() };
        let id = |marker: &str| message.first_of(marker).map(|d| d.id);
        assert_eq!(id("rings"), Some(None));
        assert_eq!(id("aruco-4x4-50:7"), Some(Some(7)));
        assert_eq!(id("aruco-4x4-50"), Some(Some(3)));
        assert_eq!(id("stag-hd23:0"), None);
        assert_eq!(id("aruco-4x4-50:x7"), None, "an id that is not a number is refused");
    }

    #[test]
    fn a_marker_is_another_one_unless_it_may_stand_on_the_pad() {
        let detection =
            |family: &str, id| Detection { family: family.into(), id, ..Detection::sample() };
        let (tag, rings) = (detection("aruco-4x4-50", Some(3)), detection("rings", None));
        assert_eq!((tag.name().as_str(), rings.name().as_str()), ("aruco-4x4-50:3", "rings"));
        for (requested, is_other) in
            [("aruco-4x4-50:3", false), ("aruco-4x4-50", false), ("aruco-4x4-50:7", true)]
        {
            assert_eq!(tag.is_other_than(requested), is_other, "{requested}");
        }
        assert!(rings.is_other_than("aruco-4x4-50:3") && !rings.is_other_than("pad:1"));
        assert!(detection("pad", Some(2)).is_other_than("pad:1"));
    }

    #[test]
    fn another_marker_is_one_that_the_landing_never_takes() {
        for (markers, requested, is_other) in [
            (&["rings:0.15"][..], "rings", false),
            (&["rings:0.15"], "aruco-4x4-50:7", true),
            (&["aruco-4x4-50:7:0.1"], "aruco-4x4-50", false),
            (&["aruco-4x4-50:7:0.1"], "aruco-4x4-50:8", true),
            (&["aruco-4x4-50:7"], "aruco-4x4-50:8", true),
            (&["aruco-4x4-50:*:0.1"], "aruco-4x4-50:8", false),
            (&["aruco-4x4-50:7:0.1", "rings:0.2"], "rings", false),
            (&["pad:1"], "pad:1", false),
            (&["pad:1"], "pad:2", true),
            (&["rings:0.15"], "pad:1", true),
            // The markers on a pad, and the names that a detector of another program uses, are not known.
            (&["pad:1"], "rings", false),
            (&["my marker"], "rings", false),
            (&["mine:big"], "rings", false),
            (&[], "rings", false),
        ] {
            let markers: Vec<String> = markers.iter().map(|it| (*it).to_owned()).collect();
            assert_eq!(
                looks_for_others(&markers, requested),
                is_other,
                "{markers:?} for {requested}"
            );
        }
    }
}
