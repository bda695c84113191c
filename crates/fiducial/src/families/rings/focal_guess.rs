//! Estimates the focal length of an unknown camera from a tilted marker.

use geometry::CameraModel;
use imaging::GrayView;

use super::circle_pose::{CirclePose, EdgePoint};

/// A typical camera for an image whose own is unknown; the marker's centre hardly depends on it.
pub(super) fn nominal_camera(view: GrayView<'_>) -> CameraModel {
    let (width, height) = (view.width() as u32, view.height() as u32);
    CameraModel::pinhole(width, height, 1.2 * f64::from(width.max(height)))
}

/// The focal length at which the circles fit a tilted marker's edges best. Without it the centre of a large
/// marker would be a pixel off. `None` when none fits better than the `nominal` one.
pub(super) fn guess_focal_length(
    pose: &CirclePose,
    nominal: &CameraModel,
    edges: &mut [EdgePoint],
) -> Option<(CirclePose, CameraModel)> {
    const STEPS: i32 = 9;
    const RATIO: f64 = 1.18;
    let mut best = None;
    let mut min_rms = pose.rms_px(edges, nominal)?;
    let mut previous = 1.0;
    for step in -STEPS..=STEPS {
        let factor = RATIO.powi(step);
        let mut camera = *nominal;
        (camera.fx, camera.fy) = (nominal.fx * factor, nominal.fy * factor);
        for edge in edges.iter_mut() {
            edge.ray.x *= previous / factor;
            edge.ray.y *= previous / factor;
        }
        previous = factor;
        let mut start = *pose;
        start.centre.z *= factor;
        if let Some((found, rms)) = start.refined(edges, &camera)
            && rms < min_rms
        {
            (best, min_rms) = (Some((found, camera)), rms);
        }
    }
    best
}
