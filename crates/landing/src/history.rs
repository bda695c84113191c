//! Where the vehicle was a moment ago.

use std::collections::VecDeque;

use geometry::{Body, Ned, Point, Rotation, Vector};

use crate::event::VehicleState;
use crate::time::Timestamp;

/// States kept: five seconds at 50 Hz.
const CAPACITY: usize = 256;

/// Two neighbouring states further apart than this are not interpolated between, in seconds.
const WIDEST_GAP_S: f64 = 0.5;

/// A position this far from where the velocity leads is a jump of the autopilot's estimate, in metres, and what is added
/// for each second between the two states.
const JUMP_M: f64 = 0.1;
const JUMP_M_S: f64 = 0.5;

/// The vehicle's latest states, in the order of their stamps.
#[derive(Clone, Debug)]
pub struct History {
    states: VecDeque<VehicleState>,
    /// For each state: by how much the autopilot's position had jumped altogether.
    jumps: VecDeque<Vector<Ned>>,
    max_extrapolation_s: f64,
}

/// The vehicle's motion at one moment.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Motion {
    /// The attitude.
    pub ned_from_body: Rotation<Ned, Body>,
    /// Where the body's origin was, in metres.
    pub position: Point<Ned>,
    /// Velocity in m/s.
    pub velocity: Vector<Ned>,
    /// The position without the jumps of the autopilot's estimate.
    pub way: Point<Ned>,
    /// Turning rate in rad/s, as the neighbouring attitudes tell.
    pub rate: Vector<Body>,
}

impl History {
    /// An empty history that reaches at most so many seconds beyond its newest state.
    pub fn new(max_extrapolation_s: f64) -> Self {
        Self {
            states: VecDeque::with_capacity(CAPACITY),
            jumps: VecDeque::with_capacity(CAPACITY),
            max_extrapolation_s,
        }
    }

    /// Adds a state; false when it is not newer than the newest.
    pub fn push(&mut self, state: VehicleState) -> bool {
        if self.newest().is_some_and(|newest| state.stamp <= newest.stamp) {
            return false;
        }
        let jumps = self.newest().map_or(Vector::zero(), |newest| {
            self.way_origin() + jump(newest, &state).unwrap_or(Vector::zero())
        });
        if self.states.len() == CAPACITY {
            self.states.pop_front();
            self.jumps.pop_front();
        }
        self.states.push_back(state);
        self.jumps.push_back(jumps);
        true
    }

    /// The newest state.
    pub fn newest(&self) -> Option<&VehicleState> {
        self.states.back()
    }

    /// By how much the autopilot's position has jumped altogether: where the way's origin now lies.
    pub fn way_origin(&self) -> Vector<Ned> {
        self.jumps.back().copied().unwrap_or(Vector::zero())
    }

    /// The motion at `stamp`, interpolated between its neighbours; `None` before the oldest state, inside a gap,
    /// and too far beyond the newest state.
    pub fn at(&self, stamp: Timestamp) -> Option<Motion> {
        let after = self.states.partition_point(|state| state.stamp < stamp);
        let Some(later) = self.states.get(after) else { return self.extrapolate(stamp) };
        if later.stamp == stamp {
            return self.known(after);
        }
        let earlier = self.states.get(after.checked_sub(1)?)?;
        let gap_s = later.stamp.seconds_since(earlier.stamp);
        if gap_s > WIDEST_GAP_S {
            return None;
        }
        let fraction = stamp.seconds_since(earlier.stamp) / gap_s;
        let between = |a: Vector<Ned>, b: Vector<Ned>| a + (b - a) * fraction;
        let way = |index: usize, state: &VehicleState| {
            self.jumps.get(index).map(|jumps| state.position - *jumps)
        };
        let (from, to) = (way(after - 1, earlier)?, way(after, later)?);
        Some(Motion {
            way: from + (to - from) * fraction,
            rate: turning(earlier, later),
            ned_from_body: earlier.ned_from_body.interpolate(&later.ned_from_body, fraction),
            position: earlier.position + (later.position - earlier.position) * fraction,
            velocity: between(earlier.velocity, later.velocity),
        })
    }

    /// A frame may be newer than the last report of the vehicle: position follows velocity, attitude stays.
    fn extrapolate(&self, stamp: Timestamp) -> Option<Motion> {
        let newest = self.newest()?;
        let ahead_s = stamp.seconds_since(newest.stamp);
        if ahead_s > self.max_extrapolation_s {
            return None;
        }
        let known = self.known(self.states.len() - 1)?;
        let further = newest.velocity * ahead_s;
        Some(Motion { position: newest.position + further, way: known.way + further, ..known })
    }

    /// The motion at a state that is known.
    fn known(&self, index: usize) -> Option<Motion> {
        let state = self.states.get(index)?;
        let before = index.checked_sub(1).and_then(|before| self.states.get(before));
        Some(Motion {
            ned_from_body: state.ned_from_body,
            position: state.position,
            velocity: state.velocity,
            way: state.position - *self.jumps.get(index)?,
            rate: before.map_or(Vector::zero(), |before| turning(before, state)),
        })
    }
}

/// Turning rate between two states, in rad/s; nought over a gap.
fn turning(earlier: &VehicleState, later: &VehicleState) -> Vector<Body> {
    let gap_s = later.stamp.seconds_since(earlier.stamp);
    if !(1e-4..=WIDEST_GAP_S).contains(&gap_s) {
        return Vector::zero();
    }
    let [w, x, y, z] = (earlier.ned_from_body.inverse() * later.ned_from_body).wxyz();
    // Half the angle's sine and the half angle are one for what a vehicle turns between two states.
    Vector::new(x, y, z) * (2.0 * w.signum() / gap_s)
}

/// The jump of the autopilot's position between two states: what its velocity does not lead to.
pub(crate) fn jump(earlier: &VehicleState, later: &VehicleState) -> Option<Vector<Ned>> {
    let gap_s = later.stamp.seconds_since(earlier.stamp);
    let led = (earlier.velocity + later.velocity) * (0.5 * gap_s);
    let beside = later.position - earlier.position - led;
    (beside.norm() > JUMP_M + JUMP_M_S * gap_s).then_some(beside)
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
    fn nothing_is_said_outside_of_what_is_known() {
        let mut history = History::new(0.1);
        assert!(at(&history, 1.0).is_none());
        history.push(state(1.0, 0.0, 0.0));
        history.push(state(2.0, 1.0, 0.0));
        assert!(at(&history, 0.9).is_none());
        assert!(at(&history, 1.5).is_none(), "a gap of a second is no knowledge");
        assert!((at(&history, 2.05).unwrap().position.x() - 1.05).abs() < 1e-9);
        assert!(at(&history, 2.2).is_none());
    }

    #[test]
    fn states_out_of_order_are_refused_and_old_ones_forgotten() {
        let mut history = History::new(0.1);
        for i in 0..1000 {
            assert!(history.push(state(f64::from(i) * 0.02, 0.0, 0.0)));
        }
        assert!(!history.push(state(3.0, 0.0, 0.0)));
        assert_eq!(history.states.len(), CAPACITY);
        assert!(at(&history, 1.0).is_none());
    }
}
