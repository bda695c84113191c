//! Computes the vehicle's pose, velocity and turn rate at any time of a flight, interpolated by cubics between the autopilot's
//! samples, without jumps of the position.

use geometry::{Body, Ned, Point, Rotation, Vector, squared};
use nalgebra::Vector3;

use super::sample::VehicleSample;

/// Longest interval between two samples over which motion is interpolated, in seconds.
const MAX_GAP_S: f64 = 0.5;
/// Time to both sides over which turn rates are taken, in seconds. The rate between two samples 25 ms apart is as much the
/// attitude's error as its change: a derivative with it makes the time offset's deviation too small by 30 %.
const RATE_S: f64 = 0.1;
/// A position further than this from where the velocity leads is a jump of the autopilot's estimate: in metres, plus metres
/// per second between two samples.
const JUMP_M: f64 = 0.1;
const JUMP_M_S: f64 = 0.5;

/// A flight's samples in order, without the jumps of the position.
#[derive(Clone, Debug)]
pub(super) struct Motion {
    samples: Vec<VehicleSample>,
}

/// The vehicle's pose and how it changes.
#[derive(Copy, Clone, Debug)]
pub(super) struct Pose {
    pub(super) ned_from_body: Rotation<Ned, Body>,
    pub(super) position: Point<Ned>,
    /// In m/s.
    velocity: Vector<Ned>,
    /// In rad/s.
    rate: Vector<Body>,
}

impl Pose {
    /// The pose a little later, with this velocity and turn rate.
    pub(super) fn after(&self, seconds: f64) -> Self {
        let turned = Rotation::<Body, Body>::from_rotation_vector(self.rate * seconds);
        Self {
            ned_from_body: self.ned_from_body * turned,
            position: self.position + self.velocity * seconds,
            ..*self
        }
    }
}

impl Motion {
    pub(super) fn new(samples: &[VehicleSample]) -> Self {
        let mut samples: Vec<VehicleSample> =
            samples.iter().filter(|sample| is_finite(sample)).copied().collect();
        samples.sort_by(|a, b| a.stamp_s.total_cmp(&b.stamp_s));
        samples.dedup_by(|next, before| next.stamp_s <= before.stamp_s);
        let mut moved = Vector::<Ned>::zero();
        let mut before: Option<VehicleSample> = None;
        for sample in &mut samples {
            if let Some(before) = before {
                moved = moved - jump(&before, sample);
            }
            before = Some(*sample);
            sample.position = sample.position + moved;
        }
        Self { samples }
    }

    /// The pose at a time, along the cubics that have both samples' positions and velocities, attitudes and turn rates; `None`
    /// outside of the flight and in gaps. A straight turn between samples 50 ms apart would make an oscillation of 3 rad/s
    /// smaller by 0.2 %, and the focal length with it.
    pub(super) fn at(&self, time_s: f64) -> Option<Pose> {
        let after = self.samples.partition_point(|sample| sample.stamp_s <= time_s);
        let (from, to) = (self.samples.get(after.checked_sub(1)?)?, self.samples.get(after)?);
        let gap_s = to.stamp_s - from.stamp_s;
        if gap_s > MAX_GAP_S {
            return None;
        }
        let share = (time_s - from.stamp_s) / gap_s;
        let along = to.position - from.position;
        let way = Cubic {
            straight: along.coords,
            begin: from.velocity.coords * gap_s,
            end: to.velocity.coords * gap_s,
        };
        let turn = Cubic {
            straight: turn_between(from, to),
            begin: self.rate(after - 1)? * gap_s,
            end: self.rate(after)? * gap_s,
        };
        Some(Pose {
            ned_from_body: from.ned_from_body
                * Rotation::from_rotation_vector(Vector::from_coords(turn.at(share))),
            position: from.position + Vector::from_coords(way.at(share)),
            velocity: from.velocity * (1.0 - share) + to.velocity * share,
            rate: self.smooth_rate(time_s, after),
        })
    }

    /// The turn rate around a time between two samples, of which `after` is the later one.
    fn smooth_rate(&self, time_s: f64, after: usize) -> Vector<Body> {
        let is_near = |sample: &&VehicleSample| (sample.stamp_s - time_s).abs() <= RATE_S;
        let (earlier, later) = self.samples.split_at(after);
        let first = earlier.iter().rev().take_while(is_near).last().or(earlier.last());
        let last = later.iter().take_while(is_near).last().or(later.first());
        first.zip(last).map_or(Vector::zero(), |(first, last)| {
            Vector::from_coords(turn_between(first, last) / (last.stamp_s - first.stamp_s))
        })
    }

    /// The turn rate at a sample, from its neighbours; across a gap it is the nearer side's.
    fn rate(&self, index: usize) -> Option<Vector3<f64>> {
        let between = |from: usize, to: usize| {
            let (from, to) = (self.samples.get(from)?, self.samples.get(to)?);
            let gap_s = to.stamp_s - from.stamp_s;
            (gap_s <= MAX_GAP_S).then(|| Piece { rate: turn_between(from, to) / gap_s, gap_s })
        };
        let before = index.checked_sub(1).and_then(|before| between(before, index));
        match (before, between(index, index + 1)) {
            // The parabola through three samples.
            (Some(a), Some(b)) => Some((a.rate * b.gap_s + b.rate * a.gap_s) / (a.gap_s + b.gap_s)),
            (Some(one), None) | (None, Some(one)) => Some(one.rate),
            (None, None) => None,
        }
    }
}

/// The mean turn rate over an interval.
struct Piece {
    rate: Vector3<f64>,
    gap_s: f64,
}

/// The turn from one sample's attitude to the next one's, in the body's axes; attitudes of opposite signs are the same.
fn turn_between(from: &VehicleSample, to: &VehicleSample) -> Vector3<f64> {
    (from.ned_from_body.inverse() * to.ned_from_body).quaternion.scaled_axis()
}

/// Hermite's cubic from zero to `straight`, with its slopes at both ends.
struct Cubic {
    straight: Vector3<f64>,
    begin: Vector3<f64>,
    end: Vector3<f64>,
}

impl Cubic {
    fn at(&self, share: f64) -> Vector3<f64> {
        let rest = 1.0 - share;
        let (begin, end) = (self.begin - self.straight, self.end - self.straight);
        self.straight * share + begin * (share * squared(rest)) - end * (squared(share) * rest)
    }
}

fn is_finite(sample: &VehicleSample) -> bool {
    sample.stamp_s.is_finite()
        && sample.position.is_finite()
        && sample.velocity.is_finite()
        && sample.ned_from_body.wxyz().iter().all(|part| part.is_finite())
}

/// By how much the autopilot's position jumped between two samples; none in a gap, in which it may have flown anywhere.
fn jump(before: &VehicleSample, after: &VehicleSample) -> Vector<Ned> {
    let apart_s = after.stamp_s - before.stamp_s;
    if apart_s > MAX_GAP_S {
        return Vector::zero();
    }
    let velocity = before.velocity * 0.5 + after.velocity * 0.5;
    let beside = after.position - (before.position + velocity * apart_s);
    if beside.norm() > JUMP_M + JUMP_M_S * apart_s { beside } else { Vector::zero() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(stamp_s: f64, north_m: f64, north_m_s: f64) -> VehicleSample {
        VehicleSample {
            stamp_s,
            ned_from_body: Rotation::from_euler(0.1 * stamp_s, 0.0, 0.0),
            position: Point::new(north_m, 0.0, -5.0),
            velocity: Vector::new(north_m_s, 0.0, 0.0),
        }
    }

    #[test]
    fn an_accelerated_motion_is_interpolated_exactly() {
        let at = |t: f64| sample(t, 0.5 * 2.0 * t * t, 2.0 * t);
        let motion = Motion::new(&[at(1.2), at(1.0), at(1.1)]);
        for t in [1.0, 1.03, 1.1, 1.17] {
            let pose = motion.at(t).unwrap();
            assert!((pose.position.x() - t * t).abs() < 1e-12, "{t}");
            assert!((pose.ned_from_body.euler().0 - 0.1 * t).abs() < 1e-12, "{t}");
        }
    }

    #[test]
    fn there_is_no_pose_outside_of_the_flight_and_in_gaps() {
        let motion =
            Motion::new(&[sample(1.0, 0.0, 0.0), sample(1.1, 0.0, 0.0), sample(2.0, 0.0, 0.0)]);
        for t in [0.99, 1.5, 2.0, 2.1, f64::NAN] {
            assert!(motion.at(t).is_none(), "{t}");
        }
    }

    #[test]
    fn a_flight_during_a_gap_is_not_taken_for_a_jump() {
        // From one hover to another, unseen.
        let motion = Motion::new(&[
            sample(1.0, 0.0, 0.0),
            sample(1.1, 0.0, 0.0),
            sample(11.0, 30.0, 0.0),
            sample(11.1, 30.0, 0.0),
        ]);
        assert!((motion.at(11.05).unwrap().position.x() - 30.0).abs() < 1e-9);
    }

    #[test]
    fn a_jump_of_the_position_moves_nothing() {
        let samples: Vec<_> = (0..20)
            .map(|i| {
                sample(0.1 * f64::from(i), 0.1 * f64::from(i) + if i > 9 { 3.0 } else { 0.0 }, 1.0)
            })
            .collect();
        let motion = Motion::new(&samples);
        assert!((motion.at(1.55).unwrap().position.x() - 1.55).abs() < 1e-9);
    }

    #[test]
    fn samples_that_are_no_numbers_are_left_out() {
        let bad = VehicleSample { stamp_s: f64::NAN, ..sample(0.0, 0.0, 0.0) };
        let worse = VehicleSample {
            position: Point::new(f64::INFINITY, 0.0, 0.0),
            ..sample(1.05, 0.0, 0.0)
        };
        let motion = Motion::new(&[bad, sample(1.0, 0.0, 0.0), worse, sample(1.1, 0.0, 0.0)]);
        assert!(motion.at(1.05).unwrap().position.is_finite());
    }
}
