//! Holds a hovering vehicle at its position: chooses the position, and computes the velocity back to it.
//!
//! ArduPilot holds its position on its own while the commanded velocity is zero. PX4 holds that velocity as it estimates it: where the
//! estimate errs, as in wind and with a wrong tilt, the vehicle drifts away as fast as it errs. So a hover commands a velocity back
//! to its position in the odometry frame, in which the autopilot's jumps do not move it. The remaining error is that of the velocity over
//! `RETURN_PER_S`.

use geometry::{Ned, Odometry, Point, Vector};
use libm::{fmax, fmin};

use crate::time::Timestamp;

/// Velocity back to a position per metre from it, in 1/s: slower than an autopilot's velocity loop, which it must not excite.
const RETURN_PER_S: f64 = 0.5;

/// Maximum speed back to the position of a hover, in m/s: more than the error of an autopilot's velocity.
const MAX_RETURN_M_S: f64 = 1.0;

/// Speed below which a vehicle that brakes is where it stays, in m/s, and time after which it is at any speed, in seconds: back to
/// where it began to brake it would swing.
const MAX_REST_M_S: f64 = 0.3;
const MAX_BRAKING_S: f64 = 2.0;

/// Distance from its position at which a vehicle that is led back to it has arrived, in metres: where an autopilot's velocity errs, a
/// hover keeps it no closer.
const ARRIVED_M: f64 = 2.0;

/// The horizontal velocity of a vehicle to a position that is so far from it, in m/s, at most as fast as `max_m_s`.
pub(crate) fn back(offset: Vector<Odometry>, max_m_s: f64) -> Vector<Ned> {
    let back = Vector::<Ned>::new(offset.x(), offset.y(), 0.0) * RETURN_PER_S;
    let scale = fmin(1.0, max_m_s / fmax(back.horizontal_norm(), f64::MIN_POSITIVE));
    back * scale
}

/// One hover, from the end of a motion to the next.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Hover {
    began: Timestamp,
    /// The time of the vehicle's newest state.
    newest: Timestamp,
    /// Where it stays, once it has braked.
    position: Option<Point<Odometry>>,
    /// It is led there from somewhere else.
    is_return: bool,
}

impl Hover {
    /// A hover that begins with a state of this time.
    pub(crate) fn new(stamp: Timestamp) -> Self {
        Self { began: stamp, newest: stamp, position: None, is_return: false }
    }

    /// A hover to which the vehicle is led back first.
    pub(crate) fn back_at(stamp: Timestamp, position: Point<Odometry>) -> Self {
        Self { position: Some(position), is_return: true, ..Self::new(stamp) }
    }

    /// Whether the vehicle is led back to this position.
    pub(crate) fn leads_back_to(&self, position: Point<Odometry>) -> bool {
        self.is_return && self.position == Some(position)
    }

    /// The same hover for a vehicle at `position` that is not to be led back any more: one that has arrived stays; `None` for one that is
    /// still on its way.
    pub(crate) fn without_return(self, position: Point<Odometry>) -> Option<Self> {
        let is_away = self.position.is_some_and(|it| (it - position).horizontal_norm() > ARRIVED_M);
        (!(self.is_return && is_away)).then_some(Self { is_return: false, ..self })
    }

    /// Where the vehicle stays; `None` while it brakes.
    pub(crate) fn position(&self) -> Option<Point<Odometry>> {
        self.position
    }

    /// The horizontal velocity in m/s of a vehicle that was at `position` at `stamp`, with this horizontal speed. After a silence of more
    /// than `max_gap_s` the hover restarts: its motion in the gap is not known.
    pub(crate) fn velocity(
        &mut self,
        stamp: Timestamp,
        position: Point<Odometry>,
        speed_m_s: f64,
        max_gap_s: f64,
    ) -> Vector<Ned> {
        if stamp.seconds_since(self.newest) > max_gap_s {
            *self = Self::new(stamp);
        }
        self.newest = stamp;
        let rests = speed_m_s < MAX_REST_M_S || stamp.seconds_since(self.began) >= MAX_BRAKING_S;
        if rests {
            self.position.get_or_insert(position);
        }
        self.position.map_or(Vector::zero(), |stays_at| back(stays_at - position, MAX_RETURN_M_S))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::VecDeque;

    const DT_S: f64 = 0.02;

    /// The way of a vehicle that hovers from the origin on, at first with this velocity. The autopilot's velocity errs by `drift`; the
    /// vehicle takes half a second to fly as commanded, and `delay_s` until it begins to.
    fn fly(from: Vector<Odometry>, drift: Vector<Odometry>, delay_s: f64) -> Vec<Point<Odometry>> {
        let (mut position, mut flown, mut path) = (Point::<Odometry>::origin(), from, Vec::new());
        let mut sent: VecDeque<_> = (0..(delay_s / DT_S) as u32).map(|_| Vector::zero()).collect();
        let mut hover = Hover::new(Timestamp::from_seconds(0.0));
        for step in 0..2000 {
            let now = Timestamp::from_seconds(f64::from(step) * DT_S);
            sent.push_back(hover.velocity(now, position, flown.horizontal_norm(), 0.5));
            let desired = sent.pop_front().unwrap_or(Vector::zero());
            assert!(desired.norm() <= MAX_RETURN_M_S + 1e-9, "{desired:?}");
            flown = flown + (Vector::from_coords(desired.coords) - flown) * (DT_S / 0.5);
            position = position + (flown + drift) * DT_S;
            path.push(position);
        }
        path
    }

    fn along(turn: u32, length: f64) -> Vector<Odometry> {
        let (east, north) = libm::sincos(f64::from(turn) * std::f64::consts::FRAC_PI_8);
        Vector::new(north * length, east * length, 0.0)
    }

    fn farthest_m(path: &[Point<Odometry>], from: Point<Odometry>) -> f64 {
        path.iter().map(|position| (*position - from).horizontal_norm()).fold(0.0, f64::max)
    }

    #[test]
    fn a_velocity_that_errs_moves_it_by_no_more_than_that_over_the_gain() {
        for turn in 0..16 {
            for drift_m_s in [0.3, 0.5, 0.8] {
                let path = fly(Vector::zero(), along(turn, drift_m_s), 0.2);
                let away_m = farthest_m(&path, Point::origin());
                assert!(away_m < 1.1 * drift_m_s / RETURN_PER_S, "{turn}, {drift_m_s}: {away_m} m");
            }
        }
    }

    #[test]
    fn it_neither_swings_nor_sways_also_with_much_delay() {
        for delay_s in [0.1, 0.2, 0.7] {
            let end = Point::origin() + along(0, 0.5 / RETURN_PER_S);
            let path = fly(Vector::zero(), along(0, 0.5), delay_s);
            let sway_m = farthest_m(&path[1000..], end);
            assert!(sway_m < 0.02, "{delay_s} s: {sway_m} m");
        }
    }

    #[test]
    fn it_stays_where_it_has_braked() {
        for speed_m_s in [0.2, 1.0, 2.0] {
            let path = fly(along(0, speed_m_s), Vector::zero(), 0.2);
            let turn_m = path.iter().map(Point::x).fold(0.0, f64::max);
            let last_m = path.last().map_or(f64::NAN, Point::x);
            assert!(turn_m - last_m < 0.2, "{speed_m_s} m/s: {turn_m} m, {last_m} m");
            assert!(last_m > 0.3 * speed_m_s - 0.1, "{speed_m_s} m/s: {last_m} m");
        }
    }

    #[test]
    fn one_that_is_never_slow_stays_where_it_is_after_two_seconds() {
        let mut hover = Hover::new(Timestamp::from_seconds(0.0));
        for tenths in 0..=20 {
            assert_eq!(hover.position(), None);
            let seconds = 0.1 * f64::from(tenths);
            hover.velocity(
                Timestamp::from_seconds(seconds),
                Point::new(seconds, 0.0, 0.0),
                1.0,
                0.5,
            );
        }
        assert_eq!(hover.position(), Some(Point::new(2.0, 0.0, 0.0)));
    }
}
