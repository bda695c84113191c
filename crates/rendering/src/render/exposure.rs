//! Interpolates the camera's pose while the shutter is open.

use geometry::{Body, Camera, CameraModel, Ned, Pixel, Point, Transform};

use crate::error::RenderError;

/// The camera's poses during one exposure.
#[derive(Debug)]
pub(super) struct Exposure {
    /// Half-way through the exposure.
    pub(super) middle: Transform<Ned, Camera>,
    /// At the opening and the closing of the shutter.
    pub(super) ends: [Transform<Ned, Camera>; 2],
    /// Evenly spaced instants over which the image of the markers is averaged.
    pub(super) instants: Vec<Transform<Ned, Camera>>,
    /// Maximum motion of any point in the image, in pixels.
    pub(super) motion_px: f64,
}

/// Number of instants in a group, whose middle one can represent it.
pub(super) const GROUP: usize = 5;

/// Maximum motion within a group, in pixels, while there are fewer than [`MAX_GROUPS`]: the blur of pixel and
/// lens hides steps of a fifth of it.
const GROUP_PX: f64 = 5.0;

/// Maximum number of groups.
const MAX_GROUPS: usize = 4;

/// Maximum number of instants.
pub(super) const MAX_INSTANTS: usize = GROUP * MAX_GROUPS;

/// Motion below which one instant suffices, in pixels.
const MIN_MOTION_PX: f64 = 0.3;

/// Maximum distance of the vehicle from the origin, in metres.
const MAX_DISTANCE_M: f64 = 1e5;

impl Exposure {
    pub(super) fn new() -> Self {
        let still = Transform::identity();
        let instants = Vec::with_capacity(MAX_INSTANTS);
        Self { middle: still, ends: [still; 2], instants, motion_px: 0.0 }
    }

    /// Sets the exposure to that of a vehicle with these poses, evenly spaced in time.
    pub(super) fn follow(
        &mut self,
        poses: &[Transform<Ned, Body>],
        body_from_camera: &Transform<Body, Camera>,
        model: &CameraModel,
    ) -> Result<(), RenderError> {
        let (Some(first), Some(last)) = (poses.first(), poses.last()) else {
            return Err(RenderError::NoPose);
        };
        if let Some(index) = poses.iter().position(|pose| !is_sound(pose)) {
            return Err(RenderError::Pose { index });
        }
        let camera_at = |fraction: &f64| between(poses, *fraction) * *body_from_camera;
        self.middle = camera_at(&0.5);
        self.ends = [*first * *body_from_camera, *last * *body_from_camera];
        self.motion_px = motion_px(poses, &self.middle, body_from_camera, model);
        let groups = (self.motion_px / GROUP_PX).ceil().clamp(1.0, MAX_GROUPS as f64) as usize;
        let count = if self.motion_px < MIN_MOTION_PX { 1 } else { GROUP * groups };
        self.instants.clear();
        let fraction = |k| (k as f64 + 0.5) / count as f64;
        self.instants.extend((0..count).map(|k| camera_at(&fraction(k))));
        Ok(())
    }
}

/// The vehicle's pose at a fraction of the exposure from 0 to 1.
pub(super) fn between(poses: &[Transform<Ned, Body>], fraction: f64) -> Transform<Ned, Body> {
    let place = fraction.clamp(0.0, 1.0) * poses.len().saturating_sub(1) as f64;
    let index = (place.floor() as usize).min(poses.len().saturating_sub(2));
    match (poses.get(index), poses.get(index + 1)) {
        (Some(a), Some(b)) => {
            let part = place - index as f64;
            let origin = a.origin() + (b.origin() - a.origin()) * part;
            Transform::new(a.rotation().interpolate(&b.rotation(), part), origin)
        }
        (Some(only), None) => *only,
        _ => Transform::identity(),
    }
}

fn is_sound(pose: &Transform<Ned, Body>) -> bool {
    let place = pose.origin();
    let norm = pose.isometry.rotation.norm();
    place.is_finite() && place.coords.coords.norm() < MAX_DISTANCE_M && (norm - 1.0).abs() < 1e-3
}

/// Maximum motion, in pixels, of the points that nine pixels across the image see in the middle of the
/// exposure.
fn motion_px(
    poses: &[Transform<Ned, Body>],
    middle: &Transform<Ned, Camera>,
    body_from_camera: &Transform<Body, Camera>,
    model: &CameraModel,
) -> f64 {
    let mut max_px = 0.0f64;
    for (i, j) in (0..9).map(|k| (f64::from(k % 3) / 2.0, f64::from(k / 3) / 2.0)) {
        let edge = |size: u32| f64::from(size.saturating_sub(1));
        let pixel = Pixel::new(edge(model.width) * i, edge(model.height) * j);
        let seen = seen_by(model, middle, pixel);
        let mut before = None;
        let mut path_px = 0.0;
        for pose in poses {
            let camera_from_ned = (*pose * *body_from_camera).inverse();
            let now = model.project(camera_from_ned * seen);
            path_px += match (before, now) {
                (None, _) => 0.0,
                (Some(Some(a)), Some(b)) => Pixel::distance(&a, &b),
                // Visible and invisible in one exposure: the vehicle tumbles.
                _ => f64::from(model.width),
            };
            before = Some(now);
        }
        max_px = max_px.max(path_px);
    }
    max_px
}

/// The point on the ground that a pixel sees, or one far away.
fn seen_by(
    model: &CameraModel,
    ned_from_camera: &Transform<Ned, Camera>,
    pixel: Pixel,
) -> Point<Ned> {
    let origin = ned_from_camera.origin();
    let direction = *ned_from_camera * model.unproject_clamped(pixel);
    let reach = -origin.z() / direction.z();
    let reach = if reach > 0.0 && reach < 1e3 { reach } else { 1e3 };
    origin + direction * reach
}
