//! Do the camera and the autopilot mean the same directions? Told from natural motion, before the descent.
//!
//! A pad that lies still has one place, whatever the vehicle does, if attitude, position and camera mount are what they
//! are said to be. If the camera is turned about the vertical, or its image is mirrored, or roll or pitch has the wrong
//! sign, the pad seems to move with every motion of the vehicle, and lies still only if the error is undone. So the
//! place of the pad is computed under each of a few dozen hypotheses, and the one under which it lies stillest is
//! compared with the configured one: a likelihood ratio that needs no motion of its own, only enough of any.

use geometry::{Body, Odometry, Point, Rotation, Vector};

use crate::history::Motion;
use crate::time::Timestamp;

/// Directions in which the camera may really be mounted.
const YAWS: usize = 16;
/// Each of them plain and mirrored, and two wrong signs.
const HYPOTHESES: usize = 2 * YAWS + 2;
/// Past detections count less with this time constant, in seconds.
const MEMORY_S: f64 = 3.0;
/// What is expected to make a pad seem to move, in metres, and per metre of range.
const NOISE_M: f64 = 0.015;
const NOISE_PER_M: f64 = 0.003;
/// Fewer detections than this tell nothing.
const FEWEST: u32 = 8;
/// One hypothesis explains the detections much better than another when its sum of squares is so many times smaller, and
/// smaller by so much at least.
const BETTER: f64 = 4.0;
const AGREES_BY: f64 = 20.0;
const DISAGREES_BY: f64 = 400.0;
/// Only a pad that seems to move by so much, as a deviation in metres and per metre of range, shows a wrong mount: the
/// autopilot's drift makes it move a little as well.
const MOVES_M: f64 = 0.15;
const MOVES_PER_M: f64 = 0.02;

/// What is known of the agreement.
#[derive(Copy, Clone, Debug, PartialEq)]
pub enum Verdict {
    /// Too little motion to tell.
    Open,
    /// The configured mount explains the detections.
    Agrees,
    /// Another one explains them, and the configured one does not.
    Disagrees(Wrong),
}

/// What would explain the detections.
#[derive(Copy, Clone, Debug, PartialEq)]
pub enum Wrong {
    /// The camera is turned about the vertical by so much more than is configured, in radians, clockwise seen from above.
    Turned(f64),
    /// The image is mirrored, and turned by so much.
    Mirrored(f64),
    /// Roll has the wrong sign.
    RollSign,
    /// Pitch has the wrong sign.
    PitchSign,
}

/// Weighs the hypotheses with each detection; nothing is allocated.
#[derive(Clone, Debug)]
pub struct Agreement {
    sums: [Sum; HYPOTHESES],
    weight: f64,
    detections: u32,
    newest: Option<Timestamp>,
    range_m: f64,
    verdict: Verdict,
}

/// A weighted mean of horizontal places and the sum of squares around it.
#[derive(Copy, Clone, Debug, Default)]
struct Sum {
    north: f64,
    east: f64,
    squares: f64,
}

impl Default for Agreement {
    fn default() -> Self {
        Self {
            sums: [Sum::default(); HYPOTHESES],
            weight: 0.0,
            detections: 0,
            newest: None,
            range_m: 0.0,
            verdict: Verdict::Open,
        }
    }
}

impl Agreement {
    /// Takes a marker's place in the body, by the configured mount, and the vehicle's motion at the exposure.
    pub fn add(&mut self, stamp: Timestamp, motion: &Motion, in_body: Point<Body>) {
        let after_s = self.newest.map_or(0.0, |newest| stamp.seconds_since(newest));
        if after_s < 0.0 {
            return;
        }
        self.newest = Some(stamp);
        let keep = (-after_s / MEMORY_S).exp();
        let seen = in_body - Point::origin();
        self.range_m = seen.norm();
        let noise_m = NOISE_M + NOISE_PER_M * self.range_m;
        let weight = 1.0 / (noise_m * noise_m);
        self.weight = self.weight * keep + weight;
        let share = weight / self.weight;
        let (roll, pitch, yaw) = motion.ned_from_body.euler();
        for (index, sum) in self.sums.iter_mut().enumerate() {
            let from_vehicle = match Hypothesis::of(index) {
                Hypothesis::Mount { turn, mirrored } => {
                    motion.odometry_from_body() * undone(seen, turn, mirrored)
                }
                Hypothesis::Roll => Rotation::from_euler(-roll, pitch, yaw) * seen,
                Hypothesis::Pitch => Rotation::from_euler(roll, -pitch, yaw) * seen,
            };
            sum.add(motion.odometry + from_vehicle, keep, weight, share);
        }
        self.detections = self.detections.saturating_add(1);
        self.judge();
    }

    /// What is known by now. Once it agrees, it stays so until much speaks against it.
    pub fn verdict(&self) -> Verdict {
        self.verdict
    }

    fn judge(&mut self) {
        let configured = self.sums.first().map_or(0.0, |sum| sum.squares);
        let others = || self.sums.iter().enumerate().filter(|(index, _)| !is_near(*index));
        let Some((index, best)) = others().min_by(|a, b| a.1.squares.total_cmp(&b.1.squares))
        else {
            return;
        };
        // A wrong sign shows only in tilt, and is not what is to be expected: it need not be ruled out.
        let mounts = others().take_while(|(index, _)| *index < 2 * YAWS);
        let nearest = mounts.map(|(_, sum)| sum.squares).fold(f64::INFINITY, f64::min);
        if self.detections < FEWEST || !best.squares.is_finite() || !configured.is_finite() {
            return;
        }
        let moves_m = MOVES_M + MOVES_PER_M * self.range_m;
        let moves = configured > moves_m * moves_m * self.weight;
        if nearest > BETTER * configured + AGREES_BY {
            self.verdict = Verdict::Agrees;
        } else if configured > BETTER * best.squares + DISAGREES_BY && moves {
            self.verdict = Verdict::Disagrees(Hypothesis::of(index).wrong());
        }
    }
}

impl Sum {
    /// West's algorithm for a weighted variance, with forgetting.
    fn add(&mut self, place: Point<Odometry>, keep: f64, weight: f64, share: f64) {
        let (north, east) = (place.x() - self.north, place.y() - self.east);
        self.north += share * north;
        self.east += share * east;
        let apart = north * north + east * east;
        self.squares = keep * self.squares + weight * (1.0 - share) * apart;
    }
}

/// What may be wrong.
enum Hypothesis {
    Mount { turn: f64, mirrored: bool },
    Roll,
    Pitch,
}

impl Hypothesis {
    /// The first is what is configured.
    fn of(index: usize) -> Self {
        if index >= 2 * YAWS {
            return if index == 2 * YAWS { Self::Roll } else { Self::Pitch };
        }
        let turn = std::f64::consts::TAU * (index % YAWS) as f64 / YAWS as f64;
        Self::Mount { turn, mirrored: index >= YAWS }
    }

    fn wrong(&self) -> Wrong {
        let wrapped = |turn: f64| {
            if turn > std::f64::consts::PI { turn - std::f64::consts::TAU } else { turn }
        };
        match *self {
            Self::Mount { turn, mirrored: false } => Wrong::Turned(wrapped(turn)),
            Self::Mount { turn, mirrored: true } => Wrong::Mirrored(wrapped(turn)),
            Self::Roll => Wrong::RollSign,
            Self::Pitch => Wrong::PitchSign,
        }
    }
}

/// Where the marker really is in the body if the camera is turned by `turn` more than is configured.
fn undone(seen: Vector<Body>, turn: f64, mirrored: bool) -> Vector<Body> {
    let (sin, cos) = turn.sin_cos();
    let y = if mirrored { -seen.y() } else { seen.y() };
    Vector::new(cos * seen.x() - sin * y, sin * seen.x() + cos * y, seen.z())
}

/// The configured mount and its two neighbours, which are no other ones.
fn is_near(index: usize) -> bool {
    index == 0 || index == 1 || index == YAWS - 1
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::Ned;
    use std::f64::consts::{FRAC_PI_2, PI};

    /// Hovers and sways over a pad, whose marker is seen through a distortion; the last verdict, and when it came.
    fn sway(
        distort: impl Fn(Vector<Body>, Rotation<Ned, Body>) -> Vector<Body>,
        sway_m: f64,
        tilt_rad: f64,
        seconds: f64,
    ) -> (Verdict, f64) {
        let mut agreement = Agreement::default();
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
            let motion = Motion {
                ned_from_body: attitude,
                position,
                velocity: Vector::zero(),
                odometry: Point::from_coords(position.coords),
                rate: Vector::zero(),
            };
            agreement.add(
                Timestamp::from_seconds(t),
                &motion,
                Point::new(seen.x(), seen.y(), seen.z()),
            );
            if agreement.verdict() != Verdict::Open {
                return (agreement.verdict(), t);
            }
        }
        (Verdict::Open, seconds)
    }

    #[test]
    fn a_right_mount_agrees_by_sway_or_by_tilt_alone() {
        assert_eq!(sway(|p, _| p, 0.2, 0.0, 8.0).0, Verdict::Agrees);
        assert_eq!(sway(|p, _| p, 0.0, 0.02, 8.0).0, Verdict::Agrees);
        assert_eq!(sway(|p, _| p, 0.0, 0.0005, 8.0).0, Verdict::Open, "nothing moves");
    }

    #[test]
    fn a_turned_or_mirrored_camera_is_named() {
        let turned = |turn: f64| move |p: Vector<Body>, _| undone(p, -turn, false);
        for turn in [FRAC_PI_2, -FRAC_PI_2, PI] {
            let (verdict, _) = sway(turned(turn), 1.5, 0.03, 8.0);
            let Verdict::Disagrees(Wrong::Turned(found)) = verdict else {
                unreachable!("{turn}: {verdict:?}")
            };
            assert!((found - turn).abs() < 1e-9, "{found} instead of {turn}");
        }
        let mirrored = |p: Vector<Body>, _| Vector::new(p.x(), -p.y(), p.z());
        assert_eq!(sway(mirrored, 1.5, 0.03, 8.0).0, Verdict::Disagrees(Wrong::Mirrored(0.0)));
    }

    #[test]
    fn a_wrong_sign_of_roll_is_named() {
        // The image moves as if the vehicle rolled the other way.
        let wrong = |p: Vector<Body>, attitude: Rotation<Ned, Body>| {
            let (roll, pitch, yaw) = attitude.euler();
            let other = Rotation::<Ned, Body>::from_euler(-roll, pitch, yaw);
            other.inverse() * (attitude * p)
        };
        assert_eq!(sway(wrong, 1.5, 0.1, 8.0).0, Verdict::Disagrees(Wrong::RollSign));
    }

    #[test]
    fn a_small_error_of_the_mount_is_no_wrong_mount() {
        let turned = |p: Vector<Body>, _| undone(p, 0.15, false);
        assert_eq!(sway(turned, 1.0, 0.03, 8.0).0, Verdict::Agrees);
    }

    #[test]
    fn numbers_without_sense_change_nothing() {
        let mut agreement = Agreement::default();
        let motion = Motion {
            ned_from_body: Rotation::identity(),
            position: Point::origin(),
            velocity: Vector::zero(),
            odometry: Point::origin(),
            rate: Vector::zero(),
        };
        for i in 0..50 {
            agreement.add(
                Timestamp::from_seconds(f64::from(i)),
                &motion,
                Point::new(1e200, 0.0, 1.0),
            );
        }
        assert_eq!(agreement.verdict(), Verdict::Open);
    }
}
