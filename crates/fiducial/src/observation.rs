//! What was found in an image.

use geometry::{Camera, Marker as MarkerFrame, Pixel, Transform};
use markers::Family;
use nalgebra::{Matrix2, Matrix6};

/// A marker found in an image.
#[derive(Clone, Debug, PartialEq)]
pub struct Observation {
    /// Its family.
    pub family: Family,
    /// Its id, where the family has ids.
    pub id: Option<u32>,
    /// The projection of the marker's centre (not the centre of its ellipse).
    pub centre: Pixel,
    /// Covariance of `centre`, in square pixels.
    pub centre_covariance_px2: Matrix2<f64>,
    /// The corners of a square marker: its own top-left first, then clockwise as seen in the image.
    pub corners: Option<[Pixel; 4]>,
    /// Cells of the code that were read wrong and mended; 0 where there is no code.
    pub wrong_bits: u8,
    /// Its largest extent in the image, in pixels.
    pub size_px: f64,
    /// From 0 (a guess) to 1 (certain).
    pub confidence: f64,
    /// Where it is, when its size and the camera are known.
    pub pose: Option<MarkerPose>,
}

/// Where a marker is.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct MarkerPose {
    /// The marker in the camera frame.
    pub camera_from_marker: Transform<Camera, MarkerFrame>,
    /// Root mean square distance, in pixels, between the image's edges and the pose's.
    pub reprojection_rms_px: f64,
    /// Covariance of the pose: translation (m), then rotation vector (rad), both in the camera frame. A rotation
    /// vector `w` moves the rotation `R` to `exp(w) R`.
    pub covariance: Matrix6<f64>,
    /// The other pose of the same plane that explains the image nearly as well, when there is one: from afar a marker
    /// tilted one way looks like one tilted the other way.
    pub alternative: Option<PoseSolution>,
}

/// A pose and how well it explains the image.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct PoseSolution {
    /// The marker in the camera frame.
    pub camera_from_marker: Transform<Camera, MarkerFrame>,
    /// Root mean square distance, in pixels, between the image's edges and the pose's.
    pub reprojection_rms_px: f64,
}

/// Told when a stage of a detection ends, so that whoever has a clock can time it.
pub trait Stages {
    /// `stage` has just ended.
    fn ended(&mut self, stage: &'static str);
}

/// Nobody listens.
impl Stages for () {
    fn ended(&mut self, _stage: &'static str) {}
}
