//! Observes the vehicle's motion for the metric guidance: the autopilot's path, the bias of its velocity,
//! and the tilt against the wind.

use geometry::{Ned, Point, Vector, squared};
use libm::{fmax, fmin};

use crate::config::MetricConfig;
use crate::event::VehicleState;
use crate::guidance::path::Path;
use crate::guidance::situation::Situation;
use crate::history::jump;
use crate::time::Timestamp;

/// Time constant of the filter over the acceleration, in seconds.
const ACCELERATION_S: f64 = 0.05;

/// Acceleration of gravity, in m/s^2.
pub(crate) const GRAVITY_M_S2: f64 = 9.81;

/// Time constant of the filter over the tilt against the wind, in seconds.
const TILT_S: f64 = 1.0;

/// Longest interval between two states over which the velocity predicts the position, in seconds.
const MAX_GAP_S: f64 = 0.25;

/// A position further than this from the predicted one is a jump of the estimate, not drift, in metres.
const JUMP_M: f64 = 0.3;

/// The observer's state.
#[derive(Copy, Clone, Debug)]
pub(super) struct Observer {
    pub(super) stamp: Timestamp,
    /// The newest setpoint, in m/s.
    pub(super) setpoint: Vector<Ned>,
    /// The path that the autopilot makes of the setpoints.
    pub(super) path: Path,
    /// The newest state, and the acceleration up to it.
    newest: VehicleState,
    pub(super) acceleration: Vector<Ned>,
    /// The predicted position in the newest state.
    predicted: Point<Ned>,
    /// Velocity of the reported position less the reported velocity, in m/s.
    pub(super) bias: Vector<Ned>,
    /// Horizontal offset of the body's down axis per metre of height, caused by the wind.
    pub(super) tilt: Vector<Ned>,
}

impl Observer {
    pub(super) fn new(situation: &Situation<'_>) -> Self {
        let velocity = situation.vehicle.velocity;
        Self {
            stamp: situation.now,
            setpoint: velocity,
            newest: *situation.vehicle,
            acceleration: Vector::zero(),
            path: Path::new(horizontal(velocity)),
            predicted: situation.vehicle.position,
            bias: Vector::zero(),
            tilt: tilt(situation),
        }
    }

    /// The state after `step_s`: the path follows the setpoint, the filters follow the vehicle's state.
    pub(super) fn after(
        mut self,
        config: &MetricConfig,
        situation: &Situation<'_>,
        step_s: f64,
    ) -> Self {
        self.stamp = situation.now;
        let gap_s = situation.vehicle.stamp.seconds_since(self.newest.stamp);
        if gap_s > 1e-3 {
            let change = horizontal(situation.vehicle.velocity - self.newest.velocity);
            let acceleration = change * (1.0 / gap_s);
            self.acceleration = self.acceleration
                + (acceleration - self.acceleration) * (gap_s / (ACCELERATION_S + gap_s));
            self.observe_bias(config, situation.vehicle, gap_s);
        }
        self.path.advance(step_s, self.setpoint, &situation.limits);
        // The tilt that does not accelerate the vehicle along its path holds it against the wind.
        let against_wind = tilt(situation) + self.path.acceleration() * (1.0 / GRAVITY_M_S2);
        self.tilt = self.tilt + (against_wind - self.tilt) * fmin(step_s / TILT_S, 1.0);
        self
    }

    /// Compares the displacement from state to state with the velocity. Only the stamps of the states count,
    /// so neither pauses between steps nor old states make a bias; after a gap or a jump there is nothing to
    /// compare.
    fn observe_bias(&mut self, config: &MetricConfig, vehicle: &VehicleState, gap_s: f64) {
        let before = std::mem::replace(&mut self.newest, *vehicle);
        let velocity = (before.velocity + vehicle.velocity) * 0.5 + self.bias;
        let predicted = self.predicted + velocity * gap_s;
        let innovation = horizontal(vehicle.position - predicted);
        let has_jumped = jump(&before, vehicle).is_some() || innovation.norm() > JUMP_M;
        if has_jumped || gap_s > MAX_GAP_S {
            self.predicted = vehicle.position;
            return;
        }
        // A critically damped observer.
        let time_s = config.drift_time_s;
        self.predicted = predicted + innovation * fmin(2.0 * gap_s / time_s, 1.0);
        let bias = self.bias + innovation * (gap_s / squared(time_s));
        self.bias = limited(bias, config.max_drift_m_s);
    }
}

/// Horizontal offset of the body's down axis per metre of height.
fn tilt(situation: &Situation<'_>) -> Vector<Ned> {
    let down = situation.vehicle.ned_from_body.down_axis();
    horizontal(down) * (1.0 / fmax(down.z(), 0.5))
}

/// The horizontal part of a vector.
pub(super) fn horizontal(vector: Vector<Ned>) -> Vector<Ned> {
    Vector::new(vector.x(), vector.y(), 0.0)
}

/// The vector, limited to a length.
pub(super) fn limited(vector: Vector<Ned>, max: f64) -> Vector<Ned> {
    let norm = vector.norm();
    if norm > max { vector * (max / norm) } else { vector }
}
