//! A camera that repeats its last picture with new stamps, as a frame grabber, a player at a constant rate or a video decoder does
//! when nothing comes any more.
//!
//! The marker then stays where it is relative to the vehicle, however that moves: the pad seems to move along, and to sink before a
//! vehicle that goes down. No two pictures of a camera are alike, as its noise differs, and no vehicle holds its place over a marker
//! to a fraction of a millimetre. So a marker that stays, while the autopilot's position and attitude change, is an old one.

use geometry::{Body, Point};
use nalgebra::Vector3;

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

/// The newest frames with a marker.
#[derive(Clone, Debug, Default)]
pub(crate) struct RepeatedPicture {
    newest: Option<(Timestamp, Point<Body>)>,
    /// Where the marker was over the ground in the first of those that are alike, in the odometry frame, in metres.
    first: Vector3<f64>,
    alike: u32,
}

impl RepeatedPicture {
    /// Adds a marker, and tells whether its picture is an old one.
    pub(crate) fn is_repeated(
        &mut self,
        stamp: Timestamp,
        motion: &Motion,
        in_body: Point<Body>,
    ) -> bool {
        let from_vehicle = in_body - Point::origin();
        let range_m = from_vehicle.norm();
        let place = motion.odometry.coords.coords + (motion.ned_from_body * from_vehicle).coords;
        let newest = self.newest.filter(|(newest, _)| *newest < stamp);
        let is_alike =
            newest.is_some_and(|(_, before)| (in_body - before).norm() <= MAX_CHANGE * range_m);
        self.newest = Some((stamp, in_body));
        if !is_alike {
            (self.first, self.alike) = (place, 0);
            return false;
        }
        self.alike = self.alike.saturating_add(1);
        let moved_m = (place - self.first).norm();
        self.alike >= MIN_ALIKE && moved_m > MIN_MOVED_M + MIN_MOVED_SHARE * range_m
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::{Odometry, Rotation, Vector};

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

    /// In which of the frames of a descent by 0.1 m each from 5 m the picture is an old one; the marker is seen so deep, in m.
    fn repeated(seen_m: impl Fn(usize) -> f64) -> Vec<usize> {
        let mut check = RepeatedPicture::default();
        let frames = 0..20_usize;
        frames
            .filter(|&number| {
                let stamp = Timestamp::from_seconds(number as f64 / 15.0);
                let seen = Point::new(0.3, -0.2, seen_m(number));
                check.is_repeated(stamp, &motion(5.0 - 0.1 * number as f64), seen)
            })
            .collect()
    }

    #[test]
    fn a_picture_that_stays_while_the_vehicle_moves_is_an_old_one() {
        let true_m = |number: usize| 5.0 - 0.1 * number as f64;
        assert_eq!(repeated(true_m), Vec::<usize>::new());
        // From the fifth on, found again to within a few millionths.
        let stays = |number: usize| true_m(number.min(5)) * (1.0 + 5e-6 * (number % 2) as f64);
        assert_eq!(repeated(stays), (7..20).collect::<Vec<_>>());
        // It goes on.
        let goes_on = |number: usize| if number < 12 { stays(number) } else { true_m(number) };
        assert_eq!(repeated(goes_on), (7..12).collect::<Vec<_>>());
        // As a camera's noise has it, the vehicle may stay over a pad while the autopilot's height drifts.
        let noise = |number: usize| 5.0 * (1.0 + 3e-5 * (number % 2) as f64);
        assert_eq!(repeated(noise), Vec::<usize>::new());
    }

    #[test]
    fn a_picture_that_stays_while_the_vehicle_does_is_none() {
        let mut check = RepeatedPicture::default();
        for number in 0..100 {
            let stamp = Timestamp::from_seconds(f64::from(number) / 15.0);
            let drift_m = 0.0005 * f64::from(number);
            assert!(!check.is_repeated(stamp, &motion(5.0 + drift_m), Point::new(0.0, 0.0, 5.0)));
        }
    }
}
