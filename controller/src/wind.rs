//! The wind, from how the vehicle leans.
//!
//! What the lean accelerates and the motion does not show is taken by the air: with a drag that grows with the speed
//! through it, `dv/dt = lean - drag * (v - wind)`.

use geometry::{Body, Vector};
use landing::VehicleState;

const GRAVITY_M_S2: f64 = 9.806_65;
/// Time constant of the mean, in seconds.
const MEAN_S: f64 = 3.0;
/// A longer gap begins anew, in seconds.
const LONGEST_GAP_S: f64 = 1.0;

/// Follows one vehicle.
#[derive(Clone, Debug, Default)]
pub struct WindEstimate {
    /// Means of velocity and of what the lean accelerates, north and east, and of when.
    mean: Option<Mean>,
}

#[derive(Copy, Clone, Debug)]
struct Mean {
    stamp_s: f64,
    since_s: f64,
    newest: [f64; 2],
    velocity: [f64; 2],
    lean: [f64; 2],
}

impl WindEstimate {
    /// Takes a state of the flying vehicle.
    pub fn take(&mut self, state: &VehicleState) {
        let up = state.ned_from_body * Vector::<Body>::new(0.0, 0.0, -1.0);
        let scale = GRAVITY_M_S2 / (-up.z()).max(0.5);
        let (now_s, velocity) = (state.stamp.seconds(), [state.velocity.x(), state.velocity.y()]);
        let lean = [up.x() * scale, up.y() * scale];
        let last = self.mean.filter(|mean| (0.0..LONGEST_GAP_S).contains(&(now_s - mean.stamp_s)));
        let Some(mut mean) = last else {
            let (stamp_s, since_s) = (now_s, now_s);
            self.mean = Some(Mean { stamp_s, since_s, newest: velocity, velocity, lean });
            return;
        };
        let share = 1.0 - (-(now_s - mean.stamp_s) / MEAN_S).exp();
        for axis in 0..2 {
            mean.velocity[axis] += share * (velocity[axis] - mean.velocity[axis]);
            mean.lean[axis] += share * (lean[axis] - mean.lean[axis]);
        }
        (mean.stamp_s, mean.newest) = (now_s, velocity);
        self.mean = Some(mean);
    }

    /// The wind's velocity, north and east in m/s, for a drag in 1/s; `None` until the mean has settled.
    pub fn velocity_m_s(&self, drag_per_s: f64) -> Option<[f64; 2]> {
        let mean = self.mean.filter(|mean| mean.stamp_s - mean.since_s > 2.0 * MEAN_S)?;
        (drag_per_s > 0.0).then(|| {
            [0, 1].map(|axis| {
                // The mean lags, and by so much that its lag tells the mean acceleration.
                let acceleration = (mean.newest[axis] - mean.velocity[axis]) / MEAN_S;
                mean.velocity[axis] + (acceleration - mean.lean[axis]) / drag_per_s
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
            let lean: [f64; 2] =
                [0, 1].map(|axis| acceleration[axis] + drag * (velocity[axis] - wind[axis]));
            let (roll, pitch) = ((lean[1] / GRAVITY_M_S2).atan(), -(lean[0] / GRAVITY_M_S2).atan());
            estimate.take(&VehicleState {
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
