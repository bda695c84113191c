//! Formats the output of `alight detect`: one line per image, as text or JSON.

use std::fmt::Write;

use fiducial::{MarkerPose, Observation, PadObservation, PoseSolution};
use geometry::Pixel;
use markers::Pad;
use serde::Serialize;

/// A pose does not fit where its residual is larger than both of these: in pixels, and as a fraction of the marker's largest extent.
/// Corners are uncertain by less than a pixel, and those of a covered marker by 1.5 % of its extent, of which the pose takes up the
/// larger part. The detector refuses squares from 2 % on.
const MIN_MISFIT_PX: f64 = 2.0;
const MIN_MISFIT_RATIO: f64 = 0.01;

/// The output for an image.
#[derive(Debug, Serialize)]
#[serde(untagged)]
pub(super) enum Line {
    Image {
        image: String,
        #[serde(skip_serializing_if = "Option::is_none")]
        time_s: Option<f64>,
        #[serde(flatten)]
        found: Found,
    },
    Error {
        image: String,
        error: String,
    },
}

#[derive(Debug, Serialize)]
pub(super) struct Found {
    pub(super) width: usize,
    pub(super) height: usize,
    /// The rotation for viewing by its Exif data, which is not applied.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) exif_orientation: Option<u8>,
    pub(super) detect_ms: f64,
    /// Why no detection has a pose although the camera is known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) no_poses: Option<String>,
    pub(super) detections: Vec<Detection>,
}

#[derive(Debug, Serialize)]
pub(super) struct Detection {
    family: &'static str,
    id: Option<u32>,
    centre_px: [f64; 2],
    /// The elements xx, xy, yy.
    centre_covariance_px2: [f64; 3],
    corners_px: Option<[[f64; 2]; 4]>,
    size_px: f64,
    wrong_bits: u8,
    confidence: f64,
    pose: Option<Pose>,
}

#[derive(Debug, Serialize)]
pub(super) struct Pose {
    translation_m: [f64; 3],
    rotation_wxyz: [f64; 4],
    reprojection_rms_px: f64,
    /// The upper triangle row by row: translation, then rotation vector, in the camera frame.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    covariance: Vec<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    alternative: Option<Box<Pose>>,
}

impl From<&PoseSolution> for Pose {
    fn from(solution: &PoseSolution) -> Self {
        let origin = solution.camera_from_marker.origin();
        Self {
            translation_m: [origin.x(), origin.y(), origin.z()],
            rotation_wxyz: solution.camera_from_marker.rotation().wxyz(),
            reprojection_rms_px: solution.reprojection_rms_px,
            covariance: Vec::new(),
            alternative: None,
        }
    }
}

impl From<&MarkerPose> for Pose {
    fn from(pose: &MarkerPose) -> Self {
        let best = PoseSolution {
            camera_from_marker: pose.camera_from_marker,
            reprojection_rms_px: pose.reprojection_rms_px,
        };
        let cells = (0..6).flat_map(|row| (row..6).map(move |column| (row, column)));
        Self {
            covariance: cells.map(|at| pose.covariance[at]).collect(),
            alternative: pose.alternative.as_ref().map(|other| Box::new(Self::from(other))),
            ..Self::from(&best)
        }
    }
}

impl From<&Observation> for Detection {
    fn from(found: &Observation) -> Self {
        let pixel = |p: Pixel| [p.x, p.y];
        let spread = &found.centre_covariance_px2;
        Self {
            family: found.family.name(),
            id: found.id,
            centre_px: pixel(found.centre),
            centre_covariance_px2: [spread.m11, spread.m12, spread.m22],
            corners_px: found.corners.map(|corners| corners.map(pixel)),
            size_px: found.size_px,
            wrong_bits: found.wrong_bits,
            confidence: found.confidence,
            pose: found.pose.as_ref().map(Pose::from),
        }
    }
}

impl Line {
    pub(super) fn as_text(&self) -> String {
        match self {
            Self::Error { image, error } => format!("{image}  error: {error}\n"),
            Self::Image { image, found, .. } => {
                let Found { width, height, detect_ms, detections, .. } = found;
                let count = detections.len();
                let markers = if count == 1 { "marker" } else { "markers" };
                let mut text = format!(
                    "{image}  {width} x {height} px  {detect_ms:.1} ms  {count} {markers}\n"
                );
                for detection in detections {
                    detection.append_text(&mut text);
                }
                text
            }
        }
    }

    pub(super) fn as_json(&self) -> String {
        // Fails only for maps with keys that are not strings; there are none.
        let mut json = serde_json::to_string(self).unwrap_or_default();
        json.push('\n');
        json
    }
}

impl Detection {
    pub(super) fn from_pad(pad: &Pad, seen: &PadObservation) -> Self {
        let spread = &seen.centre_covariance_px2;
        Self {
            family: Pad::FAMILY,
            id: Some(pad.id()),
            centre_px: [seen.centre.x, seen.centre.y],
            centre_covariance_px2: [spread.m11, spread.m12, spread.m22],
            corners_px: None,
            size_px: seen.size_px,
            wrong_bits: 0,
            confidence: seen.confidence,
            pose: Some(Pose::from(&seen.pose)),
        }
    }

    fn append_text(&self, text: &mut String) {
        let id = self.id.map_or_else(String::new, |id| format!(":{id}"));
        let [x, y] = self.centre_px;
        // Writing to a string cannot fail.
        let _ = write!(
            text,
            "  {}{id}  centre ({x:.2}, {y:.2}) px  largest extent {:.1} px  confidence {:.2}",
            self.family, self.size_px, self.confidence
        );
        if let Some(pose) = &self.pose {
            let [x, y, z] = pose.translation_m;
            let _ = write!(
                text,
                "  at ({x:.3}, {y:.3}, {z:.3}) m in the camera frame, rms {:.2} px",
                pose.reprojection_rms_px
            );
            let min_misfit_px = MIN_MISFIT_PX.max(MIN_MISFIT_RATIO * self.size_px);
            if pose.reprojection_rms_px > min_misfit_px {
                text.push_str(
                    "\n    note: this pose does not fit the image: the marker is bent or the calibration is wrong",
                );
            }
        }
        text.push('\n');
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pose_that_does_not_fit_has_a_note() {
        let text = |size_px: f64, reprojection_rms_px: f64| {
            let pose = Pose {
                translation_m: [0.1, 0.2, 0.3],
                rotation_wxyz: [1.0, 0.0, 0.0, 0.0],
                reprojection_rms_px,
                covariance: Vec::new(),
                alternative: None,
            };
            let detection = Detection {
                family: "apriltag-36h11",
                id: Some(7),
                centre_px: [631.64, 349.48],
                centre_covariance_px2: [0.01, 0.0, 0.01],
                corners_px: None,
                size_px,
                wrong_bits: 0,
                confidence: 0.9,
                pose: Some(pose),
            };
            let mut text = String::new();
            detection.append_text(&mut text);
            text
        };
        let has_note = |size_px, rms_px| text(size_px, rms_px).contains("does not fit the image");
        assert!(has_note(303.0, 4.35) && has_note(180.0, 2.2));
        // Noise of a small marker, and a lens that is a little off where the marker fills the image.
        assert!(!has_note(303.0, 0.8) && !has_note(60.0, 1.1) && !has_note(900.0, 4.35));
        assert_eq!(
            text(303.0, 4.35).lines().nth(1),
            Some(
                "    note: this pose does not fit the image: the marker is bent or the calibration is wrong"
            )
        );
    }
}
