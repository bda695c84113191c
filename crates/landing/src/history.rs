//! Stores the vehicle's last states in the order of their stamps, and computes its motion (pose, velocity, turn rate, position in the
//! odometry frame) interpolated at any time.

use std::collections::VecDeque;

use geometry::{Body, Ned, Odometry, Point, Rotation, Transform, Vector};

use crate::event::VehicleState;
use crate::time::Timestamp;

/// Number of stored states: 2.6 s at 50 Hz, as attitude and position each give one.
const CAPACITY: usize = 256;

/// Longest interval between two states over which motion is interpolated, in seconds.
const MAX_GAP_S: f64 = 0.5;

/// A position further than this from where the velocity leads is a jump of the autopilot's estimate: in
/// metres, plus metres per second between the two states.
const JUMP_M: f64 = 0.1;
const JUMP_M_S: f64 = 0.5;
/// Maximum gap over which a jump is distinguished from a change of the velocity, in seconds: a vehicle that brakes by 2 m/s in a longer
/// one has moved by metres less than by the mean of its velocities. Over a longer one only a difference that no velocity explains is a
/// jump: the larger of the two, and so much more, in m/s.
const MAX_JUMP_GAP_S: f64 = 1.0;
const MARGIN_M_S: f64 = 1.0;

/// The vehicle's latest states, in the order of their stamps.
#[derive(Clone, Debug)]
pub struct History {
    states: VecDeque<VehicleState>,
    /// For each state: the origin of the odometry frame, which moves with every jump of the autopilot's
    /// position.
    odom_origins: VecDeque<Vector<Ned>>,
    max_extrapolation_s: f64,
}

/// The vehicle's motion at one moment.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Motion {
    /// The attitude.
    pub ned_from_body: Rotation<Ned, Body>,
    /// Position of the body's origin.
    pub position: Point<Ned>,
    /// Velocity in m/s.
    pub velocity: Vector<Ned>,
    /// Position of the body's origin without the jumps of the autopilot's estimate.
    pub odometry: Point<Odometry>,
    /// Turn rate in rad/s, from the neighbouring attitudes.
    pub rate: Vector<Body>,
}

impl Motion {
    /// The attitude in the odometry frame, whose axes are those of NED.
    pub fn odometry_from_body(&self) -> Rotation<Odometry, Body> {
        Rotation::from_quaternion(self.ned_from_body.quaternion)
    }

    /// Stationary, its odometry that of the position.
    #[cfg(test)]
    pub(crate) fn still(ned_from_body: Rotation<Ned, Body>, position: Point<Ned>) -> Self {
        Self {
            ned_from_body,
            position,
            velocity: Vector::zero(),
            odometry: Point::from_coords(position.coords),
            rate: Vector::zero(),
        }
    }
}

impl History {
    /// An empty history that extrapolates at most this long beyond its newest state.
    pub fn new(max_extrapolation_s: f64) -> Self {
        Self {
            states: VecDeque::with_capacity(CAPACITY),
            odom_origins: VecDeque::with_capacity(CAPACITY),
            max_extrapolation_s,
        }
    }

    /// Extrapolates at most this long from now on.
    pub fn set_max_extrapolation(&mut self, seconds: f64) {
        self.max_extrapolation_s = seconds;
    }

    /// Adds a state; false when it is not newer than the newest.
    pub fn push(&mut self, state: VehicleState) -> bool {
        if self.newest().is_some_and(|newest| state.stamp <= newest.stamp) {
            return false;
        }
        let origin = self.newest().map_or(Vector::zero(), |newest| {
            self.odom_origin() + jump(newest, &state).unwrap_or(Vector::zero())
        });
        if self.states.len() == CAPACITY {
            self.states.pop_front();
            self.odom_origins.pop_front();
        }
        self.states.push_back(state);
        self.odom_origins.push_back(origin);
        true
    }

    /// The newest state.
    pub fn newest(&self) -> Option<&VehicleState> {
        self.states.back()
    }

    /// From the odometry frame, as it now lies, to NED.
    pub fn ned_from_odometry(&self) -> Transform<Ned, Odometry> {
        Transform::new(Rotation::identity(), Point::origin() + self.odom_origin())
    }

    fn odom_origin(&self) -> Vector<Ned> {
        self.odom_origins.back().copied().unwrap_or(Vector::zero())
    }

    /// The motion at `stamp`, interpolated between its neighbours; `None` before the oldest state, inside a
    /// gap, and too far beyond the newest state.
    pub fn at(&self, stamp: Timestamp) -> Option<Motion> {
        let after = self.states.partition_point(|state| state.stamp < stamp);
        let Some(later) = self.states.get(after) else { return self.extrapolate(stamp) };
        if later.stamp == stamp {
            return self.at_state(after);
        }
        let before = after.checked_sub(1)?;
        let earlier = self.states.get(before)?;
        let gap_s = later.stamp.seconds_since(earlier.stamp);
        if gap_s > MAX_GAP_S {
            return None;
        }
        let fraction = stamp.seconds_since(earlier.stamp) / gap_s;
        let (from, to) = (self.odometry(before)?, self.odometry(after)?);
        Some(Motion {
            odometry: from + (to - from) * fraction,
            rate: turn_rate(earlier, later),
            ned_from_body: earlier.ned_from_body.interpolate(&later.ned_from_body, fraction),
            position: earlier.position + (later.position - earlier.position) * fraction,
            velocity: earlier.velocity + (later.velocity - earlier.velocity) * fraction,
        })
    }

    /// A frame may be newer than the newest state: position follows velocity, attitude stays.
    fn extrapolate(&self, stamp: Timestamp) -> Option<Motion> {
        let newest = self.newest()?;
        let ahead_s = stamp.seconds_since(newest.stamp);
        if ahead_s > self.max_extrapolation_s {
            return None;
        }
        let motion = self.at_state(self.states.len() - 1)?;
        let moved = newest.velocity * ahead_s;
        Some(Motion {
            position: newest.position + moved,
            odometry: motion.odometry + Vector::from_coords(moved.coords),
            ..motion
        })
    }

    fn at_state(&self, index: usize) -> Option<Motion> {
        let state = self.states.get(index)?;
        let before = index.checked_sub(1).and_then(|before| self.states.get(before));
        Some(Motion {
            ned_from_body: state.ned_from_body,
            position: state.position,
            velocity: state.velocity,
            odometry: self.odometry(index)?,
            rate: before.map_or(Vector::zero(), |before| turn_rate(before, state)),
        })
    }

    fn odometry(&self, index: usize) -> Option<Point<Odometry>> {
        let position = self.states.get(index)?.position - *self.odom_origins.get(index)?;
        Some(Point::from_coords(position.coords))
    }
}

/// Turn rate between two states, in rad/s; zero over a gap.
fn turn_rate(earlier: &VehicleState, later: &VehicleState) -> Vector<Body> {
    let gap_s = later.stamp.seconds_since(earlier.stamp);
    if !(1e-4..=MAX_GAP_S).contains(&gap_s) {
        return Vector::zero();
    }
    let [w, x, y, z] = (earlier.ned_from_body.inverse() * later.ned_from_body).wxyz();
    // Small angle: the sine of half the angle is half the angle.
    Vector::new(x, y, z) * (2.0 * w.signum() / gap_s)
}

/// The jump of the autopilot's position between two states: the part of the displacement that its velocity
/// does not explain, when that is large.
pub(crate) fn jump(earlier: &VehicleState, later: &VehicleState) -> Option<Vector<Ned>> {
    let gap_s = later.stamp.seconds_since(earlier.stamp);
    let expected = (earlier.velocity + later.velocity) * (0.5 * gap_s);
    let moved = later.position - earlier.position;
    let difference = moved - expected;
    if gap_s > MAX_JUMP_GAP_S {
        let max_m_s = libm::fmax(earlier.velocity.norm(), later.velocity.norm()) + MARGIN_M_S;
        return (moved.norm() > JUMP_M + max_m_s * gap_s).then_some(difference);
    }
    (difference.norm() > JUMP_M + JUMP_M_S * gap_s).then_some(difference)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::event::{Landed, Mode};

    fn state(seconds: f64, north: f64, yaw: f64) -> VehicleState {
        VehicleState {
            stamp: Timestamp::from_seconds(seconds),
            ned_from_body: Rotation::from_euler(0.0, 0.0, yaw),
            position: Point::new(north, 0.0, -5.0),
            velocity: Vector::new(1.0, 0.0, 0.0),
            mode: Mode::Guided,
            armed: true,
            landed: Landed::InAir,
        }
    }

    fn at(history: &History, seconds: f64) -> Option<Motion> {
        history.at(Timestamp::from_seconds(seconds))
    }

    #[test]
    fn motion_is_interpolated_between_neighbours() {
        let mut history = History::new(0.1);
        assert!(history.push(state(1.0, 0.0, 0.0)));
        assert!(history.push(state(1.2, 1.0, 0.4)));
        let motion = at(&history, 1.05).unwrap();
        assert!((motion.position.x() - 0.25).abs() < 1e-9);
        assert!((motion.ned_from_body.euler().2 - 0.1).abs() < 1e-9);
        assert_eq!(at(&history, 1.2).unwrap().position.x(), 1.0);
    }

    #[test]
    fn motion_is_unknown_before_the_first_state_in_gaps_and_far_ahead() {
        let mut history = History::new(0.1);
        assert!(at(&history, 1.0).is_none());
        history.push(state(1.0, 0.0, 0.0));
        history.push(state(2.0, 1.0, 0.0));
        assert!(at(&history, 0.9).is_none());
        assert!(at(&history, 1.5).is_none(), "a gap of a second");
        assert!((at(&history, 2.05).unwrap().position.x() - 1.05).abs() < 1e-9);
        assert!(at(&history, 2.2).is_none());
    }

    /// Over a long gap a vehicle may have braked; a new origin is further than it flies.
    #[test]
    fn over_a_long_gap_only_a_difference_that_no_velocity_explains_is_a_jump() {
        let at = |seconds: f64, down_m: f64, down_m_s: f64| VehicleState {
            position: Point::new(0.0, 0.0, down_m),
            velocity: Vector::new(0.0, 0.0, down_m_s),
            ..state(seconds, 0.0, 0.0)
        };
        let jump_m = |earlier: (f64, f64), gap_s: f64, later: (f64, f64)| {
            let (earlier, later) = (at(0.0, earlier.0, earlier.1), at(gap_s, later.0, later.1));
            jump(&earlier, &later).map(|jump| jump.z())
        };
        assert_eq!(jump_m((-8.0, 2.0), 8.0, (-5.0, 0.0)), None);
        assert_eq!(jump_m((-10.0, 0.0), 3.0, (0.0, 0.0)), Some(10.0));
        assert_eq!(jump_m((-8.0, 0.0), 0.5, (-7.0, 0.0)), Some(1.0));
    }

    #[test]
    fn a_jump_moves_the_odometry_frame_and_not_the_odometry() {
        let mut history = History::new(0.1);
        history.push(state(1.0, 0.0, 0.0));
        history.push(state(1.1, 3.1, 0.0));
        let motion = at(&history, 1.1).unwrap();
        assert!((motion.odometry.x() - 0.1).abs() < 1e-9, "{motion:?}");
        let back = history.ned_from_odometry() * motion.odometry;
        assert!((back - motion.position).norm() < 1e-12);
    }

    #[test]
    fn states_out_of_order_are_refused_and_old_ones_dropped() {
        let mut history = History::new(0.1);
        for i in 0..1000 {
            assert!(history.push(state(f64::from(i) * 0.02, 0.0, 0.0)));
        }
        assert!(!history.push(state(3.0, 0.0, 0.0)));
        assert_eq!(history.states.len(), CAPACITY);
        assert!(at(&history, 1.0).is_none());
    }
}
