//! Computes the true position of a marker in a simulated frame.

use geometry::{Body, Camera, CameraModel, Ned, Point, Rotation, Transform};
use messages::{CameraInfo, Truth};

/// Maximum time between two samples of the truth between which it is interpolated, in nanoseconds.
const MAX_GAP_NS: i64 = 200_000_000;

/// The truth of a flight, by time.
#[derive(Clone, Debug, Default)]
pub struct Truths {
    samples: Vec<Truth>,
}

impl Truths {
    /// Of samples in any order.
    pub fn new(mut samples: Vec<Truth>) -> Self {
        samples.sort_by_key(|it| it.stamp_ns);
        Self { samples }
    }

    /// True when none was recorded.
    pub fn is_empty(&self) -> bool {
        self.samples.is_empty()
    }

    /// Whether the vehicle stood on the ground at the first sample from a time on.
    pub fn is_on_ground(&self, stamp_ns: i64) -> bool {
        let next = self.samples.partition_point(|it| it.stamp_ns < stamp_ns);
        self.samples.get(next).is_some_and(|it| it.on_ground)
    }

    /// The pad's landing point in a camera at a time; `None` where the truth is not known.
    pub fn pad_in_camera(&self, stamp_ns: i64, camera: &CameraInfo) -> Option<Point<Camera>> {
        let after = self.samples.partition_point(|it| it.stamp_ns < stamp_ns);
        let next = self.samples.get(after)?;
        let last = self.samples.get(after.saturating_sub(1))?;
        let gap_ns = next.stamp_ns.saturating_sub(last.stamp_ns);
        if gap_ns > MAX_GAP_NS || last.stamp_ns > stamp_ns.max(next.stamp_ns) {
            return None;
        }
        let part = match gap_ns {
            0 if next.stamp_ns != stamp_ns => return None,
            0 => 0.0,
            gap_ns => (stamp_ns - last.stamp_ns) as f64 / gap_ns as f64,
        };
        let between = |one: [f64; 3], other: [f64; 3]| {
            let [x, y, z] = one;
            let [next_x, next_y, next_z] = other;
            Point::<Ned>::new(
                x + part * (next_x - x),
                y + part * (next_y - y),
                z + part * (next_z - z),
            )
        };
        let attitude = |it: &Truth| Rotation::<Ned, Body>::from_wxyz(it.ned_from_body_wxyz);
        let ned_from_body = attitude(last)?.interpolate(&attitude(next)?, part);
        let position = between(last.position_ned_m, next.position_ned_m);
        let pad = between(last.pad_ned_m, next.pad_ned_m);
        let body_from_camera: Transform<Body, Camera> = camera.body_from_camera.transform()?;
        let ned_from_camera = Transform::new(ned_from_body, position) * body_from_camera;
        Some(ned_from_camera.inverse() * pad)
    }
}

/// Whether a point is in a camera's picture.
pub fn is_in_picture(point: Point<Camera>, camera: &CameraModel) -> bool {
    point.z() > 0.0 && camera.project(point).is_some_and(|pixel| camera.contains(pixel))
}
