//! Formats the output of `alight detect`: one line per image, as text or JSON.

use std::fmt::Write;

use fiducial::{MarkerPose, Observation, PadObservation, PoseSolution};
use geometry::Pixel;
use markers::Pad;
use serde::Serialize;

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
        }
        text.push('\n');
    }
}
