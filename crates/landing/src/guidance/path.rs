//! Models the horizontal path that an autopilot flies from velocity setpoints.
//!
//! ArduPilot Copter does not hand a setpoint to its loops: it bends a path towards it within limits of
//! acceleration and jerk (`shape_vel_accel` of `AP_Math/control.cpp`), and the loops of position and velocity
//! follow that path. The path depends on the setpoints alone, so it can be computed here as well as there.

use geometry::{Ned, Vector};
use nalgebra::Vector2;

use crate::event::AutopilotLimits;

/// The path is computed in steps of this length, in seconds.
const STEP_S: f64 = 0.005;
/// From a setpoint to its effect, in seconds: half of the interval at which they are sent, and the link.
const SETPOINT_LAG_S: f64 = 0.06;
type Level = Vector2<f64>;

/// Time constant with which the path goes towards a setpoint, in seconds.
pub(super) fn time_constant_s(limits: &AutopilotLimits) -> f64 {
    limits.acceleration_m_s2 / limits.jerk_m_s3
}

/// The autopilot's path.
#[derive(Copy, Clone, Debug)]
pub(super) struct Path {
    setpoint: Level,
    velocity: Level,
    acceleration: Level,
    remainder_s: f64,
}

impl Path {
    /// The path of a vehicle that moves steadily, as commanded.
    pub(super) fn new(velocity: Vector<Ned>) -> Self {
        let velocity = Level::new(velocity.x(), velocity.y());
        Self { setpoint: velocity, velocity, acceleration: Level::zeros(), remainder_s: 0.0 }
    }

    /// Its velocity now, in m/s.
    pub(super) fn velocity(&self) -> Vector<Ned> {
        Vector::new(self.velocity.x, self.velocity.y, 0.0)
    }

    /// Its acceleration now, in m/s^2.
    pub(super) fn acceleration(&self) -> Vector<Ned> {
        Vector::new(self.acceleration.x, self.acceleration.y, 0.0)
    }

    /// Advances the path by `dt_s` towards this setpoint, within the autopilot's limits.
    pub(super) fn advance(&mut self, dt_s: f64, setpoint: Vector<Ned>, limits: &AutopilotLimits) {
        let setpoint = Level::new(setpoint.x(), setpoint.y());
        self.remainder_s += dt_s;
        while self.remainder_s >= STEP_S {
            self.remainder_s -= STEP_S;
            self.setpoint += (setpoint - self.setpoint) * (STEP_S / SETPOINT_LAG_S);
            let desired = (self.setpoint - self.velocity) / time_constant_s(limits);
            let desired = limited(desired, limits.acceleration_m_s2);
            self.acceleration += limited(desired - self.acceleration, limits.jerk_m_s3 * STEP_S);
            self.velocity += self.acceleration * STEP_S;
        }
    }
}

fn limited(v: Level, length: f64) -> Level {
    let norm = v.norm();
    if norm > length { v * (length / norm) } else { v }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Seconds until the path has this part of a velocity step.
    fn rise_s(size: f64, part: f64) -> f64 {
        let mut path = Path::new(Vector::zero());
        (1..1000)
            .find_map(|i| {
                path.advance(0.01, Vector::new(size, 0.0, 0.0), &AutopilotLimits::default());
                (path.velocity().x() >= part * size).then_some(f64::from(i) * 0.01)
            })
            .unwrap_or(f64::NAN)
    }

    #[test]
    fn a_step_takes_as_long_as_measured_less_the_lag_of_the_tilt() {
        // t50 of Copter 4.5.4 in its own simulation is 0.46, 0.52 and 0.60 s; the tilt follows after 0.17 s.
        for (size, half_s) in [(0.25, 0.46), (0.5, 0.52), (1.0, 0.60)] {
            let half = rise_s(size, 0.5) + 0.1;
            assert!((half - half_s).abs() < 0.1, "{size}: {half} not {half_s}");
        }
    }

    #[test]
    fn a_steady_motion_continues_and_limits_hold() {
        let steady = Vector::new(0.4, -0.2, 0.0);
        let mut path = Path::new(steady);
        let limits = AutopilotLimits::default();
        path.advance(5.0, steady, &limits);
        assert!((path.velocity() - steady).norm() < 1e-9);
        let mut before = path.velocity();
        for _ in 0..1200 {
            path.advance(STEP_S, Vector::new(-5.0, 5.0, 0.0), &limits);
            assert!((path.velocity() - before).norm() <= 1.01 * limits.acceleration_m_s2 * STEP_S);
            before = path.velocity();
        }
        assert!((path.velocity() - Vector::new(-5.0, 5.0, 0.0)).norm() < 0.5);
    }
}
