//! Wind estimate from the vehicle's tilt.
//!
//! The tilt accelerates the vehicle against a drag that grows with the airspeed `w = v - wind`, by the momentum that rotors
//! take from the air (proportional to `|w|`) and by the body's shape (to its square): `dv/dt = tilt - (linear + quadratic |w|) w`.

use landing::VehicleState;
use libm::{exp, fmax, hypot, sqrt};

const GRAVITY_M_S2: f64 = 9.806_65;
/// Time constant of the mean, in seconds.
const MEAN_S: f64 = 3.0;
/// Maximum gap between two states, in seconds; after a longer one the mean starts again.
const MAX_GAP_S: f64 = 1.0;

/// The vehicle's drag: the acceleration against the air that passes.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Drag {
    /// Per airspeed, in 1/s.
    pub linear_per_s: f64,
    /// Per squared airspeed, in 1/m.
    pub quadratic_per_m: f64,
}

impl Drag {
    /// The airspeed at which the drag is so large, per drag, in s; `None` without drag.
    fn airspeed_per_drag_s(self, drag_m_s2: f64) -> Option<f64> {
        let Self { linear_per_s: linear, quadratic_per_m: quadratic } = self;
        if linear <= 0.0 && quadratic <= 0.0 {
            return None;
        }
        // The positive root of `quadratic s^2 + linear s = drag`, in the form without a difference.
        let divisor = linear + sqrt(linear * linear + 4.0 * quadratic * drag_m_s2);
        Some(if divisor > 0.0 { 2.0 / divisor } else { 0.0 })
    }
}

/// Estimates the wind at one vehicle.
#[derive(Clone, Debug, Default)]
pub struct WindEstimate {
    /// Means of velocity and of the acceleration by the tilt, north and east.
    mean: Option<Mean>,
}

#[derive(Copy, Clone, Debug)]
struct Mean {
    stamp_s: f64,
    since_s: f64,
    newest: [f64; 2],
    velocity: [f64; 2],
    tilt: [f64; 2],
}

impl WindEstimate {
    /// Updates the estimate with a state of the flying vehicle.
    pub fn update(&mut self, state: &VehicleState) {
        let up = -state.ned_from_body.down_axis();
        let scale = GRAVITY_M_S2 / fmax(-up.z(), 0.5);
        let (now_s, velocity) = (state.stamp.seconds(), [state.velocity.x(), state.velocity.y()]);
        let tilt = [up.x() * scale, up.y() * scale];
        let last = self.mean.filter(|mean| (0.0..MAX_GAP_S).contains(&(now_s - mean.stamp_s)));
        let Some(mut mean) = last else {
            let (stamp_s, since_s) = (now_s, now_s);
            self.mean = Some(Mean { stamp_s, since_s, newest: velocity, velocity, tilt });
            return;
        };
        let weight = 1.0 - exp(-(now_s - mean.stamp_s) / MEAN_S);
        for axis in 0..2 {
            mean.velocity[axis] += weight * (velocity[axis] - mean.velocity[axis]);
            mean.tilt[axis] += weight * (tilt[axis] - mean.tilt[axis]);
        }
        (mean.stamp_s, mean.newest) = (now_s, velocity);
        self.mean = Some(mean);
    }

    /// The wind's velocity, north and east in m/s; `None` until the mean has settled, and without drag.
    pub fn velocity_m_s(&self, drag: Drag) -> Option<[f64; 2]> {
        let mean = self.mean.filter(|mean| mean.stamp_s - mean.since_s > 2.0 * MEAN_S)?;
        let forces = [0, 1].map(|axis| {
            // The lag of the mean is proportional to the mean acceleration.
            let acceleration = (mean.newest[axis] - mean.velocity[axis]) / MEAN_S;
            mean.tilt[axis] - acceleration
        });
        let scale_s = drag.airspeed_per_drag_s(hypot(forces[0], forces[1]))?;
        Some([0, 1].map(|axis| mean.velocity[axis] - forces[axis] * scale_s))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::{Point, Rotation, Vector};
    use landing::{Landed, Mode, Timestamp};
    use node::Layers;
    use world::vehicle::VehicleConfig;

    use crate::config::Config;

    #[test]
    fn the_wind_is_found_hovering_and_on_the_move() {
        let wind = [4.0, -2.0];
        for (linear_per_s, quadratic_per_m) in [(0.3, 0.0), (0.25, 0.0314), (0.0, 0.05)] {
            let drag = Drag { linear_per_s, quadratic_per_m };
            let found = estimated(drag, wind).unwrap();
            let is_near = (found[0] - wind[0]).abs() < 0.3 && (found[1] - wind[1]).abs() < 0.1;
            assert!(is_near, "{drag:?}: {found:?}");
        }
        // Where nothing pushes, the air goes along.
        let quadratic = Drag { linear_per_s: 0.0, quadratic_per_m: 0.05 };
        assert_eq!(quadratic.airspeed_per_drag_s(0.0), Some(0.0));
        let none = Drag { linear_per_s: 0.0, quadratic_per_m: 0.0 };
        assert_eq!(estimated(none, wind), None);
        assert_eq!(WindEstimate::default().velocity_m_s(none), None);
    }

    /// The estimate for a vehicle of this drag that moves in this wind.
    fn estimated(drag: Drag, wind: [f64; 2]) -> Option<[f64; 2]> {
        let mut estimate = WindEstimate::default();
        for i in 0..1500 {
            let t = f64::from(i) * 0.02;
            // A sine to the north, steady to the east.
            let velocity = [(0.5 * t).sin(), 0.7];
            let acceleration = [0.5 * (0.5 * t).cos(), 0.0];
            let airspeed = [0, 1].map(|axis| velocity[axis] - wind[axis]);
            let per_speed =
                drag.linear_per_s + drag.quadratic_per_m * hypot(airspeed[0], airspeed[1]);
            let tilt: [f64; 2] = [0, 1].map(|axis| acceleration[axis] + per_speed * airspeed[axis]);
            let (roll, pitch) = ((tilt[1] / GRAVITY_M_S2).atan(), -(tilt[0] / GRAVITY_M_S2).atan());
            estimate.update(&VehicleState {
                stamp: Timestamp::from_seconds(t),
                ned_from_body: Rotation::from_euler(roll, pitch, 0.0),
                position: Point::origin(),
                velocity: Vector::new(velocity[0], velocity[1], 0.0),
                mode: Mode::Guided,
                armed: true,
                landed: Landed::InAir,
            });
        }
        estimate.velocity_m_s(drag)
    }

    #[test]
    fn the_default_is_the_simulated_vehicles_drag() {
        let drag = Layers::default().load::<Config>().unwrap().settings.autopilot.drag();
        let simulated = VehicleConfig::default();
        assert_eq!(drag.linear_per_s, simulated.linear_drag);
        assert_eq!(drag.quadratic_per_m, simulated.quadratic_drag);
    }
}
