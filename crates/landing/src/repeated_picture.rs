//! A camera that repeats its last picture with new stamps, as a frame grabber, a player at a constant rate or a video decoder does
//! when nothing comes any more.
//!
//! The marker then stays where it is relative to the vehicle, however that moves: the pad seems to move along, and to sink before a
//! vehicle that goes down. No two pictures of a camera are alike, as its noise differs, and no vehicle holds its place over a marker
//! to a fraction of a millimetre. So a marker that stays, while the autopilot's position and attitude change, is an old one.

use geometry::{Body, Camera, Pixel, Point, Rotation, Vector};
use nalgebra::Vector3;

use crate::event::{FrameObservation, MarkerInFrame};
use crate::history::Motion;
use crate::time::Timestamp;

/// Largest change of the marker's place relative to the vehicle from one frame to the next, as a share of its distance: a detector
/// that remembers more of the camera with each frame finds the same marker again to within a third of it (measured: 6e-6).
const MAX_CHANGE: f64 = 2e-5;

/// Number of such changes in a row, and how far the marker must seem to have moved over the ground meanwhile, in metres and as a
/// share of its distance.
const MIN_ALIKE: u32 = 2;
const MIN_MOVED_M: f64 = 0.05;
const MIN_MOVED_SHARE: f64 = 0.01;

/// How far the direction to a marker whose distance is not known must seem to have turned over the ground meanwhile, in radians.
const MIN_TURNED_RAD: f64 = 0.02;

/// The newest frames with a marker.
#[derive(Clone, Debug, Default)]
pub(crate) struct RepeatedPicture {
    newest: Option<Sight>,
    /// Where the marker was over the ground in the first of those that are alike, in the odometry frame, in metres; of one whose
    /// distance is not known the direction.
    first: Vector3<f64>,
    alike: u32,
    /// The newest one is an old picture, and so are all that are like it.
    is_old: bool,
}

/// A marker in a frame.
#[derive(Copy, Clone, Debug)]
struct Sight {
    stamp: Timestamp,
    /// Where it was relative to the vehicle, in metres; of one whose distance is not known the direction.
    in_body: Vector<Body>,
    has_distance: bool,
}

impl RepeatedPicture {
    /// Adds a marker, and tells whether its picture is an old one. Where its distance is not known the direction decides: then a
    /// vehicle that moves and does not tilt may see it where it was.
    pub(crate) fn is_repeated(
        &mut self,
        frame: &FrameObservation,
        marker: &MarkerInFrame,
        motion: &Motion,
    ) -> bool {
        let stamp = frame.stamp;
        let Some(pose) = marker.body_from_marker else {
            let in_body = direction(frame, marker.centre);
            let sight = Sight { stamp, in_body, has_distance: false };
            return self.add(sight, (motion.ned_from_body * in_body).coords, MIN_TURNED_RAD);
        };
        let in_body = pose.origin() - Point::origin();
        let sight = Sight { stamp, in_body, has_distance: true };
        let place = motion.odometry.coords.coords + (motion.ned_from_body * in_body).coords;
        self.add(sight, place, MIN_MOVED_M + MIN_MOVED_SHARE * in_body.norm())
    }

    fn add(&mut self, sight: Sight, place: Vector3<f64>, min_moved: f64) -> bool {
        let is_alike = self.newest.is_some_and(|newest| newest.is_like(&sight));
        // A frame that comes late says nothing of what has come since.
        if self.newest.is_some_and(|newest| sight.stamp <= newest.stamp) {
            return is_alike && self.is_old;
        }
        self.newest = Some(sight);
        if !is_alike {
            (self.first, self.alike, self.is_old) = (place, 0, false);
            return false;
        }
        self.alike = self.alike.saturating_add(1);
        self.is_old |= self.alike >= MIN_ALIKE && (place - self.first).norm() > min_moved;
        self.is_old
    }
}

/// The direction in which a pixel lies, a vector of length one. The focal length of a camera that is not calibrated is taken for the
/// image's width, and a mount that is not known for one that looks down.
fn direction(frame: &FrameObservation, pixel: Pixel) -> Vector<Body> {
    let (width, height) = (f64::from(frame.image_size.0), f64::from(frame.image_size.1));
    let focal_px = frame.focal_px.filter(|focal_px| *focal_px > 1.0).unwrap_or(width);
    let in_camera = Vector::<Camera>::new(pixel.x - 0.5 * width, pixel.y - 0.5 * height, focal_px);
    let body_from_camera = frame.body_from_camera.unwrap_or(Rotation::identity());
    body_from_camera * (in_camera * (1.0 / in_camera.norm()))
}

impl Sight {
    fn is_like(&self, other: &Self) -> bool {
        let change = (other.in_body - self.in_body).norm();
        self.has_distance == other.has_distance && change <= MAX_CHANGE * other.in_body.norm()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::{Odometry, Transform};

    /// A vehicle at this height that does not turn.
    fn motion(height_m: f64) -> Motion {
        Motion {
            ned_from_body: Rotation::identity(),
            position: Point::new(0.0, 0.0, -height_m),
            odometry: Point::<Odometry>::new(0.0, 0.0, -height_m),
            velocity: Vector::zero(),
            rate: Vector::zero(),
        }
    }

    /// A marker in one of 15 frames in a second, `late_s` earlier: at this place relative to the vehicle, or where only the pixel is
    /// known.
    fn is_repeated(
        check: &mut RepeatedPicture,
        (number, late_s): (u32, f64),
        motion: &Motion,
        place: Option<Point<Body>>,
        centre: Pixel,
    ) -> bool {
        let marker = MarkerInFrame {
            centre,
            body_from_marker: place.map(|place| Transform::new(Rotation::identity(), place)),
            alternative: None,
            covariance_m2: None,
            size_px: None,
            confidence: 1.0,
        };
        let frame = FrameObservation {
            stamp: Timestamp::from_seconds(f64::from(number) / 15.0 - late_s),
            image_size: (1296, 972),
            focal_px: Some(1818.0),
            body_from_camera: None,
            marker: Some(marker),
        };
        check.is_repeated(&frame, &marker, motion)
    }

    /// In which of the frames the picture is an old one, of a vehicle at these heights over a marker that is seen so deep, in metres.
    fn repeated(
        frames: u32,
        height_m: impl Fn(u32) -> f64,
        seen_m: impl Fn(u32) -> f64,
    ) -> Vec<u32> {
        let mut check = RepeatedPicture::default();
        (0..frames)
            .filter(|&number| {
                let seen = Point::new(0.3, -0.2, seen_m(number));
                let motion = motion(height_m(number));
                is_repeated(&mut check, (number, 0.0), &motion, Some(seen), Pixel::new(0.0, 0.0))
            })
            .collect()
    }

    #[test]
    fn a_picture_that_stays_while_the_vehicle_moves_is_an_old_one() {
        let true_m = |number: u32| 5.0 - 0.1 * f64::from(number);
        assert_eq!(repeated(20, true_m, true_m), Vec::<u32>::new());
        // From the fifth on, found again to within a few millionths.
        let stays = |number: u32| true_m(number.min(5)) * (1.0 + 5e-6 * f64::from(number % 2));
        assert_eq!(repeated(20, true_m, stays), (7..20).collect::<Vec<_>>());
        // It goes on.
        let goes_on = |number: u32| if number < 12 { stays(number) } else { true_m(number) };
        assert_eq!(repeated(20, true_m, goes_on), (7..12).collect::<Vec<_>>());
        // The vehicle comes back to where it was, and above.
        let height_m = |number: u32| true_m(number.min(24 - number.min(24)));
        assert_eq!(repeated(24, height_m, stays), (7..24).collect::<Vec<_>>());
        // As a camera's noise has it, the vehicle may stay over a pad while the autopilot's height drifts.
        let noise = |number: u32| 5.0 * (1.0 + 3e-5 * f64::from(number % 2));
        assert_eq!(repeated(20, true_m, noise), Vec::<u32>::new());
    }

    #[test]
    fn a_picture_that_stays_while_the_vehicle_does_is_none() {
        let drifts_m = |number: u32| 5.0 + 0.0005 * f64::from(number);
        assert_eq!(repeated(100, drifts_m, |_| 5.0), Vec::<u32>::new());
    }

    #[test]
    fn frames_that_come_late_do_not_hide_it() {
        let mut check = RepeatedPicture::default();
        let mut old = Vec::new();
        for number in 0..20 {
            for late_s in [0.0, 0.2] {
                let height_m = 5.0 - 0.1 * f64::from(number);
                let (seen, centre) = (Some(Point::new(0.3, -0.2, 5.0)), Pixel::new(0.0, 0.0));
                let frame = (number, late_s);
                old.push(is_repeated(&mut check, frame, &motion(height_m), seen, centre));
            }
        }
        let first = old.iter().position(|is_old| *is_old);
        assert_eq!(first, Some(4), "{old:?}");
        assert!(old.iter().skip(4).all(|is_old| *is_old), "{old:?}");
    }

    #[test]
    fn without_a_distance_a_direction_that_stays_while_the_vehicle_tilts_tells_it() {
        let old = |follows: bool| {
            let mut check = RepeatedPicture::default();
            (0..20)
                .filter(|&number| {
                    let tilt_rad = 0.005 * f64::from(number);
                    let motion = Motion {
                        ned_from_body: Rotation::from_euler(tilt_rad, 0.0, 0.0),
                        ..motion(5.0)
                    };
                    let moved_px = if follows { 1818.0 * libm::tan(tilt_rad) } else { 0.0 };
                    let centre = Pixel::new(700.0, 400.0 + moved_px);
                    is_repeated(&mut check, (number, 0.0), &motion, None, centre)
                })
                .collect::<Vec<u32>>()
        };
        assert_eq!(old(true), Vec::<u32>::new());
        assert_eq!(old(false), (5..20).collect::<Vec<_>>());
    }
}
