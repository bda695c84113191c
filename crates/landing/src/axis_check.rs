//! Checks before the descent whether the axes of camera and autopilot match, by the scatter of the pad's
//! position under the configured mount and under turned and mirrored ones.
//!
//! A pad that does not move has one position whatever the vehicle does, if attitude, position and camera mount
//! are as configured. If the camera is turned about the vertical, its image is mirrored, or roll or pitch has
//! the wrong sign, the pad appears to move with every motion of the vehicle, unless the error is undone. So
//! the position of the pad is computed under each of a few dozen alternatives, and the one with the smallest
//! scatter is compared with the configured one: a likelihood ratio that needs no special motion, only
//! enough of any kind.

use geometry::{Body, Odometry, Point, Rotation, Vector};
use libm::{exp, fmin, sincos};

use crate::history::Motion;
use crate::time::Timestamp;

/// Number of camera yaw angles that are tested.
const YAWS: usize = 16;
/// Each yaw plain and mirrored, and two wrong signs.
const ALTERNATIVES: usize = 2 * YAWS + 2;
/// Time constant with which past detections are forgotten, in seconds.
const MEMORY_S: f64 = 3.0;
/// Expected scatter of a pad's position, in metres, and per metre of range.
const NOISE_M: f64 = 0.015;
const NOISE_PER_M: f64 = 0.003;
/// Minimum number of detections for a verdict.
const MIN_DETECTIONS: u32 = 8;
/// One alternative explains the detections much better than another when its sum of squares is smaller by
/// this factor, and by this difference: to confirm the configured mount, and to reject it.
const MIN_RATIO: f64 = 4.0;
const CONSISTENT_BY: f64 = 20.0;
const MISMATCH_BY: f64 = 400.0;
/// Minimum apparent motion of the pad that rejects the configured mount, as a standard deviation in metres
/// and per metre of range: the autopilot's drift makes it move a little as well.
const MIN_MOTION_M: f64 = 0.15;
const MIN_MOTION_PER_M: f64 = 0.02;

/// The result so far.
#[derive(Copy, Clone, Debug, PartialEq)]
pub enum Verdict {
    /// Too little motion to decide.
    Undecided,
    /// The configured mount explains the detections.
    Consistent,
    /// Another one explains them, and the configured one does not.
    Mismatch(AxisError),
}

/// The error that would explain the detections.
#[derive(Copy, Clone, Debug, PartialEq)]
pub enum AxisError {
    /// The camera is turned about the vertical by this much more than configured, in radians, clockwise seen
    /// from above.
    Turned(f64),
    /// The image is mirrored, and turned by this much.
    Mirrored(f64),
    /// Roll has the wrong sign.
    RollSign,
    /// Pitch has the wrong sign.
    PitchSign,
}

/// Compares the alternatives with each detection; nothing is allocated.
#[derive(Clone, Debug)]
pub struct AxisConsistencyCheck {
    sums: [Sum; ALTERNATIVES],
    weight: f64,
    detections: u32,
    newest: Option<Timestamp>,
    range_m: f64,
    verdict: Verdict,
}

/// A weighted mean of horizontal positions and the sum of squares around it.
#[derive(Copy, Clone, Debug, Default)]
struct Sum {
    north: f64,
    east: f64,
    squares: f64,
}

impl Default for AxisConsistencyCheck {
    fn default() -> Self {
        Self {
            sums: [Sum::default(); ALTERNATIVES],
            weight: 0.0,
            detections: 0,
            newest: None,
            range_m: 0.0,
            verdict: Verdict::Undecided,
        }
    }
}

impl AxisConsistencyCheck {
    /// Adds a marker's position in the body, by the configured mount, with the vehicle's motion at the exposure.
    pub fn add(&mut self, stamp: Timestamp, motion: &Motion, in_body: Point<Body>) {
        let after_s = self.newest.map_or(0.0, |newest| stamp.seconds_since(newest));
        if after_s < 0.0 {
            return;
        }
        self.newest = Some(stamp);
        let keep = exp(-after_s / MEMORY_S);
        let seen = in_body - Point::origin();
        self.range_m = seen.norm();
        let noise_m = NOISE_M + NOISE_PER_M * self.range_m;
        let weight = 1.0 / (noise_m * noise_m);
        self.weight = self.weight * keep + weight;
        let fraction = weight / self.weight;
        let (roll, pitch, yaw) = motion.ned_from_body.euler();
        for (index, sum) in self.sums.iter_mut().enumerate() {
            let from_vehicle = match Alternative::from_index(index) {
                Alternative::Mount { turn, mirrored } => {
                    motion.odometry_from_body() * undone(seen, turn, mirrored)
                }
                Alternative::Roll => Rotation::from_euler(-roll, pitch, yaw) * seen,
                Alternative::Pitch => Rotation::from_euler(roll, -pitch, yaw) * seen,
            };
            sum.add(motion.odometry + from_vehicle, keep, weight, fraction);
        }
        self.detections = self.detections.saturating_add(1);
        self.decide();
    }

    /// The result so far. A consistent one changes only with strong evidence.
    pub fn verdict(&self) -> Verdict {
        self.verdict
    }

    fn decide(&mut self) {
        let configured = self.sums.first().map_or(0.0, |sum| sum.squares);
        let others = || self.sums.iter().enumerate().filter(|(index, _)| !is_near(*index));
        let Some((index, best)) = others().min_by(|a, b| a.1.squares.total_cmp(&b.1.squares))
        else {
            return;
        };
        // A wrong sign is unlikely and shows in tilt only: it need not be ruled out.
        let mounts = others().take_while(|(index, _)| *index < 2 * YAWS);
        let nearest = mounts.map(|(_, sum)| sum.squares).fold(f64::INFINITY, fmin);
        if self.detections < MIN_DETECTIONS || !best.squares.is_finite() || !configured.is_finite()
        {
            return;
        }
        let min_motion_m = MIN_MOTION_M + MIN_MOTION_PER_M * self.range_m;
        let is_moving = configured > min_motion_m * min_motion_m * self.weight;
        if nearest > MIN_RATIO * configured + CONSISTENT_BY {
            self.verdict = Verdict::Consistent;
        } else if configured > MIN_RATIO * best.squares + MISMATCH_BY && is_moving {
            self.verdict = Verdict::Mismatch(Alternative::from_index(index).mismatch());
        }
    }
}

impl Sum {
    /// West's algorithm for a weighted variance, with forgetting.
    fn add(&mut self, position: Point<Odometry>, keep: f64, weight: f64, fraction: f64) {
        let (north, east) = (position.x() - self.north, position.y() - self.east);
        self.north += fraction * north;
        self.east += fraction * east;
        let apart = north * north + east * east;
        self.squares = keep * self.squares + weight * (1.0 - fraction) * apart;
    }
}

/// One alternative to test.
enum Alternative {
    Mount { turn: f64, mirrored: bool },
    Roll,
    Pitch,
}

impl Alternative {
    /// The first is the configured mount.
    fn from_index(index: usize) -> Self {
        if index >= 2 * YAWS {
            return if index == 2 * YAWS { Self::Roll } else { Self::Pitch };
        }
        let turn = std::f64::consts::TAU * (index % YAWS) as f64 / YAWS as f64;
        Self::Mount { turn, mirrored: index >= YAWS }
    }

    fn mismatch(&self) -> AxisError {
        let wrapped = |turn: f64| {
            if turn > std::f64::consts::PI { turn - std::f64::consts::TAU } else { turn }
        };
        match *self {
            Self::Mount { turn, mirrored: false } => AxisError::Turned(wrapped(turn)),
            Self::Mount { turn, mirrored: true } => AxisError::Mirrored(wrapped(turn)),
            Self::Roll => AxisError::RollSign,
            Self::Pitch => AxisError::PitchSign,
        }
    }
}

/// The true position of the marker in the body if the camera is turned by `turn` more than configured.
fn undone(seen: Vector<Body>, turn: f64, mirrored: bool) -> Vector<Body> {
    let (sin, cos) = sincos(turn);
    let y = if mirrored { -seen.y() } else { seen.y() };
    Vector::new(cos * seen.x() - sin * y, sin * seen.x() + cos * y, seen.z())
}

/// The configured mount and its two neighbours, which are not distinguished from it.
fn is_near(index: usize) -> bool {
    index == 0 || index == 1 || index == YAWS - 1
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::Ned;
    use std::f64::consts::{FRAC_PI_2, PI};

    /// Hovers and sways over a pad whose marker is seen through a distortion; returns the last verdict and
    /// its time.
    fn sway(
        distort: impl Fn(Vector<Body>, Rotation<Ned, Body>) -> Vector<Body>,
        sway_m: f64,
        tilt_rad: f64,
        seconds: f64,
    ) -> (Verdict, f64) {
        let mut check = AxisConsistencyCheck::default();
        let pad = Point::new(1.5, -1.5, 0.0);
        for i in 0..(seconds * 15.0) as u32 {
            let t = f64::from(i) / 15.0;
            let position = Point::new(sway_m * (1.3 * t).sin(), sway_m * (0.9 * t).cos(), -8.0);
            let attitude = Rotation::<Ned, Body>::from_euler(
                tilt_rad * (2.1 * t).sin(),
                tilt_rad * (1.7 * t + 1.0).sin(),
                0.6,
            );
            let noise = Vector::new((37.0 * t).sin(), (53.0 * t).cos(), 0.0) * 0.01;
            let in_body = attitude.inverse() * (pad - position) + noise;
            let seen = distort(in_body, attitude);
            let motion = Motion::still(attitude, position);
            check.add(
                Timestamp::from_seconds(t),
                &motion,
                Point::new(seen.x(), seen.y(), seen.z()),
            );
            if check.verdict() != Verdict::Undecided {
                return (check.verdict(), t);
            }
        }
        (Verdict::Undecided, seconds)
    }

    #[test]
    fn a_right_mount_is_consistent_by_sway_or_by_tilt_alone() {
        assert_eq!(sway(|p, _| p, 0.2, 0.0, 8.0).0, Verdict::Consistent);
        assert_eq!(sway(|p, _| p, 0.0, 0.02, 8.0).0, Verdict::Consistent);
        assert_eq!(sway(|p, _| p, 0.0, 0.0005, 8.0).0, Verdict::Undecided, "nothing moves");
    }

    #[test]
    fn a_turned_or_mirrored_camera_is_named() {
        let turned = |turn: f64| move |p: Vector<Body>, _| undone(p, -turn, false);
        for turn in [FRAC_PI_2, -FRAC_PI_2, PI] {
            let (verdict, _) = sway(turned(turn), 1.5, 0.03, 8.0);
            let Verdict::Mismatch(AxisError::Turned(found)) = verdict else {
                unreachable!("{turn}: {verdict:?}")
            };
            assert!((found - turn).abs() < 1e-9, "{found} instead of {turn}");
        }
        let mirrored = |p: Vector<Body>, _| Vector::new(p.x(), -p.y(), p.z());
        assert_eq!(sway(mirrored, 1.5, 0.03, 8.0).0, Verdict::Mismatch(AxisError::Mirrored(0.0)));
    }

    #[test]
    fn a_wrong_sign_of_roll_is_named() {
        // The image moves as if the vehicle rolled the other way.
        let wrong = |p: Vector<Body>, attitude: Rotation<Ned, Body>| {
            let (roll, pitch, yaw) = attitude.euler();
            let other = Rotation::<Ned, Body>::from_euler(-roll, pitch, yaw);
            other.inverse() * (attitude * p)
        };
        assert_eq!(sway(wrong, 1.5, 0.1, 8.0).0, Verdict::Mismatch(AxisError::RollSign));
    }

    #[test]
    fn a_small_mount_error_is_consistent() {
        let turned = |p: Vector<Body>, _| undone(p, 0.15, false);
        assert_eq!(sway(turned, 1.0, 0.03, 8.0).0, Verdict::Consistent);
    }

    #[test]
    fn huge_numbers_change_nothing() {
        let mut check = AxisConsistencyCheck::default();
        let motion = Motion::still(Rotation::identity(), Point::origin());
        for i in 0..50 {
            check.add(Timestamp::from_seconds(f64::from(i)), &motion, Point::new(1e200, 0.0, 1.0));
        }
        assert_eq!(check.verdict(), Verdict::Undecided);
    }
}
