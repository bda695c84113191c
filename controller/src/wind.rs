//! Wind estimate from the vehicle's tilt.
//!
//! The tilt accelerates the vehicle against a drag proportional to the airspeed: `dv/dt = tilt - drag * (v -
//! wind)`.

use geometry::{Body, Vector};
use landing::VehicleState;
use libm::{exp, fmax};

const GRAVITY_M_S2: f64 = 9.806_65;
/// Time constant of the mean, in seconds.
const MEAN_S: f64 = 3.0;
/// Maximum gap between two states, in seconds; after a longer one the mean starts again.
const MAX_GAP_S: f64 = 1.0;

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
        let up = state.ned_from_body * Vector::<Body>::new(0.0, 0.0, -1.0);
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

    /// The wind's velocity, north and east in m/s, for a drag in 1/s; `None` until the mean has settled.
    pub fn velocity_m_s(&self, drag_per_s: f64) -> Option<[f64; 2]> {
        let mean = self.mean.filter(|mean| mean.stamp_s - mean.since_s > 2.0 * MEAN_S)?;
        (drag_per_s > 0.0).then(|| {
            [0, 1].map(|axis| {
                // The lag of the mean is proportional to the mean acceleration.
                let acceleration = (mean.newest[axis] - mean.velocity[axis]) / MEAN_S;
                mean.velocity[axis] + (acceleration - mean.tilt[axis]) / drag_per_s
            })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::{Point, Rotation};
    use landing::{Landed, Mode, Timestamp};

    #[test]
    fn the_wind_is_found_hovering_and_on_the_move() {
        let (drag, wind) = (0.3, [4.0, -2.0]);
        let mut estimate = WindEstimate::default();
        assert_eq!(estimate.velocity_m_s(drag), None);
        for i in 0..1500 {
            let t = f64::from(i) * 0.02;
            // A sine to the north, steady to the east.
            let velocity = [(0.5 * t).sin(), 0.7];
            let acceleration = [0.5 * (0.5 * t).cos(), 0.0];
            let tilt: [f64; 2] =
                [0, 1].map(|axis| acceleration[axis] + drag * (velocity[axis] - wind[axis]));
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
        let found = estimate.velocity_m_s(drag).unwrap();
        assert!((found[0] - wind[0]).abs() < 0.3 && (found[1] - wind[1]).abs() < 0.1, "{found:?}");
        assert_eq!(estimate.velocity_m_s(0.0), None);
    }
}
