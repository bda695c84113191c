//! Decides whether a marker at a position on the ground is in the field of view of a frame's camera, by the vehicle's
//! pose.

use geometry::{Body, Camera, Odometry, Point, Rotation, Vector};
use libm::{atan, atan2};

use crate::event::FrameObservation;
use crate::history::Motion;

/// Margin at the image's edge that does not count as view: an angle in radians, and room for the marker in
/// metres.
const MARGIN_RAD: f64 = 0.01;
const MARGIN_M: f64 = 0.1;

/// The camera's field of view.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct View {
    body_from_camera: Rotation<Body, Camera>,
    /// Half the angle of view to the right, and to the bottom, in radians.
    half_rad: [f64; 2],
}

impl View {
    /// The view of a frame's camera, when it is calibrated. With an unknown mount the camera is assumed to
    /// look down, and only the area that is shown at every yaw counts.
    pub(crate) fn from_frame(frame: &FrameObservation) -> Option<Self> {
        let focal_px = frame.focal_px.filter(|focal_px| *focal_px > 1.0)?;
        let (width, height) = frame.image_size;
        let half = |px: u32| atan(0.5 * f64::from(px) / focal_px);
        let short = half(width.min(height));
        Some(frame.body_from_camera.map_or(
            Self { body_from_camera: Rotation::identity(), half_rad: [short; 2] },
            |body_from_camera| Self { body_from_camera, half_rad: [half(width), half(height)] },
        ))
    }

    /// True when a marker at this position is in view as a whole.
    pub(crate) fn shows(&self, position: Point<Odometry>, motion: &Motion) -> bool {
        let in_body: Vector<Body> =
            motion.odometry_from_body().inverse() * (position - motion.odometry);
        let in_camera = self.body_from_camera.inverse() * in_body;
        let is_inside = |offset_m: f64, half_rad: f64| {
            atan2(offset_m.abs() + MARGIN_M, in_camera.z()) < half_rad - MARGIN_RAD
        };
        let [right_rad, bottom_rad] = self.half_rad;
        in_camera.z() > 0.0
            && is_inside(in_camera.x(), right_rad)
            && is_inside(in_camera.y(), bottom_rad)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::Timestamp;

    #[test]
    fn only_points_below_are_in_view() {
        let motion = Motion {
            ned_from_body: Rotation::identity(),
            position: Point::origin(),
            velocity: Vector::zero(),
            odometry: Point::origin(),
            rate: Vector::zero(),
        };
        let frame = FrameObservation {
            stamp: Timestamp::default(),
            image_size: (1296, 972),
            focal_px: Some(1818.0),
            body_from_camera: None,
            marker: None,
        };
        let view = View::from_frame(&frame).unwrap();
        assert!(view.shows(Point::new(0.5, 0.0, 3.0), &motion));
        assert!(!view.shows(Point::new(1.0, 0.0, 3.0), &motion));
        assert!(!view.shows(Point::new(0.0, 0.0, -3.0), &motion));
        let tilted = Motion { ned_from_body: Rotation::from_euler(0.0, 0.3, 0.0), ..motion };
        assert!(!view.shows(Point::new(-0.5, 0.0, 3.0), &tilted));
        // The image's longer side is along the body's y axis, then along its x axis.
        for (turn, [north, east]) in [(std::f64::consts::FRAC_PI_2, [0.0, 0.9]), (0.0, [0.9, 0.0])]
        {
            let mount = Rotation::from_euler(0.0, 0.0, turn);
            let frame = FrameObservation { body_from_camera: Some(mount), ..frame };
            let view = View::from_frame(&frame).unwrap();
            assert!(view.shows(Point::new(north, east, 3.0), &motion));
            assert!(!view.shows(Point::new(east, north, 3.0), &motion));
        }
    }
}
