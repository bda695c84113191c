//! Defines a marker as the detector reports it: name, centre with covariance, corners, size in pixels, wrong bits, confidence,
//! pose and its alternative, the camera's response.

use geometry::{Camera, Marker as MarkerFrame, Pixel, Roi, Transform};
use markers::Family;
use nalgebra::{Matrix2, Matrix6};

use crate::response::ResponseEstimate;

/// A marker found in an image.
#[derive(Clone, Debug, PartialEq)]
pub struct Observation {
    /// Its family.
    pub family: Family,
    /// Its id, where the family has ids.
    pub id: Option<u32>,
    /// The projection of the marker's centre, which is not the centre of its ellipse.
    pub centre: Pixel,
    /// Covariance of `centre`, in square pixels.
    pub centre_covariance_px2: Matrix2<f64>,
    /// The corners of a square marker: its own top-left first, then clockwise as seen in the image.
    pub corners: Option<[Pixel; 4]>,
    /// Hamming distance of the bits that were read from the codeword; 0 where there is no code.
    pub wrong_bits: u8,
    /// Its largest extent in the image, in pixels.
    pub size_px: f64,
    /// From 0 (a guess) to 1 (certain).
    pub confidence: f64,
    /// Its pose, when its size and the camera are known.
    pub pose: Option<MarkerPose>,
    /// The camera's response to light, where the marker gave it.
    pub response: Option<ResponseEstimate>,
}

impl Observation {
    /// Converts an observation in a region of interest to pixels of the complete frame. The response estimated from binned
    /// pixels, such as the sharpening, is dropped: the frame's pixels have another one.
    pub fn mapped(&self, roi: &Roi) -> Self {
        let mut seen = self.clone();
        seen.centre = roi.to_frame(seen.centre);
        seen.corners = seen.corners.map(|corners| corners.map(|corner| roi.to_frame(corner)));
        seen.centre_covariance_px2 *= roi.scale * roi.scale;
        seen.size_px *= roi.scale;
        seen.response = seen.response.filter(|_| roi.scale <= 1.0);
        if let Some(pose) = &mut seen.pose {
            pose.reprojection_rms_px *= roi.scale;
            if let Some(other) = &mut pose.alternative {
                other.reprojection_rms_px *= roi.scale;
            }
        }
        seen
    }
}

/// Pose of a marker.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct MarkerPose {
    /// The marker in the camera frame.
    pub camera_from_marker: Transform<Camera, MarkerFrame>,
    /// Root mean square distance between the edges in the image and those of the pose, in pixels.
    pub reprojection_rms_px: f64,
    /// Covariance of the pose: translation (m), then rotation vector (rad), both in the camera frame. A rotation
    /// vector `w` moves the rotation `R` to `exp(w) R`.
    pub covariance: Matrix6<f64>,
    /// The second solution of the planar pose ambiguity, when it fits the image nearly as well: in a small image two tilts
    /// look alike.
    pub alternative: Option<PoseSolution>,
}

/// A pose and its residual.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct PoseSolution {
    /// The marker in the camera frame.
    pub camera_from_marker: Transform<Camera, MarkerFrame>,
    /// Root mean square distance between the edges in the image and those of the pose, in pixels.
    pub reprojection_rms_px: f64,
}

/// Observes the stages of a detection, for timing by a caller that has a clock.
pub trait StageObserver {
    /// Called when `stage` has ended.
    fn ended(&mut self, stage: &'static str);
}

/// Ignores the stages.
impl StageObserver for () {
    fn ended(&mut self, _stage: &'static str) {}
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::response::Measured;

    #[test]
    fn binned_pixels_do_not_give_the_cameras_response() {
        let measured = Measured { value: 0.5, deviation: 0.1 };
        let seen = Observation {
            family: Family::Rings,
            id: None,
            centre: Pixel::new(10.0, 20.0),
            centre_covariance_px2: Matrix2::identity(),
            corners: None,
            wrong_bits: 0,
            size_px: 30.0,
            confidence: 1.0,
            pose: None,
            response: Some(ResponseEstimate { curve: measured, sharpening: measured }),
        };
        let cropped = seen.mapped(&Roi::cropped(5.0, 5.0, 40, 40));
        assert!(cropped.response.is_some());
        let binned = seen.mapped(&Roi::binned(0.0, 0.0, 40, 40, 2.0));
        assert_eq!((binned.response, binned.size_px), (None, 60.0));
    }
}
