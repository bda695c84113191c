//! Images whose camera is not known.

use geometry::CameraModel;
use imaging::GrayView;

use crate::families::rings::circle_pose::{CirclePose, EdgePoint};

/// A camera for images whose own is not known; the marker's centre hardly depends on it.
pub(crate) fn nominal_camera(view: GrayView<'_>) -> CameraModel {
    let (width, height) = (view.width() as u32, view.height() as u32);
    CameraModel::pinhole(width, height, 1.2 * f64::from(width.max(height)))
}

/// The focal length at which the circles fit a tilted marker's edges best: without it the true centre of a large one
/// would be a pixel off. `None` when none fits better than the `nominal` one.
pub(crate) fn guess_lens(
    circles: &CirclePose,
    nominal: &CameraModel,
    edges: &mut [EdgePoint],
) -> Option<(CirclePose, CameraModel)> {
    const STEPS: i32 = 9;
    const RATIO: f64 = 1.18;
    let mut best = None;
    let mut least = circles.rms_px(edges, nominal)?;
    let mut previous = 1.0;
    for step in -STEPS..=STEPS {
        let factor = RATIO.powi(step);
        let mut lens = *nominal;
        (lens.fx, lens.fy) = (nominal.fx * factor, nominal.fy * factor);
        for edge in edges.iter_mut() {
            edge.ray.x *= previous / factor;
            edge.ray.y *= previous / factor;
        }
        previous = factor;
        let mut start = *circles;
        start.centre.z *= factor;
        if let Some((found, rms)) = start.refined(edges, &lens)
            && rms < least
        {
            (best, least) = (Some((found, lens)), rms);
        }
    }
    best
}
