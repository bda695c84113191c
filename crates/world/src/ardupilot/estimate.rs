//! Computes the simulated autopilot's estimate of the motion: the truth with slow errors of position, height, velocity,
//! tilt and heading, a wandering tilt, GNSS drift and jumps.

use rand_chacha::ChaCha8Rng;

use crate::drift::{Drift, normal, random_stream};
use crate::laws::{lag, wrap};
use crate::vehicle::{GRAVITY_M_S2, VehicleTruth};

/// Sizes of the errors; the defaults are those seen in the logs of a real autopilot in simulation.
#[derive(Clone, Debug, PartialEq)]
pub struct EstimateConfig {
    /// Deviation of the constant part of the horizontal velocity's error, in m/s per axis.
    pub velocity_bias_m_s: f64,
    /// Deviation of its slow part (a time constant of 10 s), in m/s per axis.
    pub velocity_drift_m_s: f64,
    /// Deviation of the horizontal position's slow error (a time constant of 10 s), in metres per axis.
    pub position_drift_m: f64,
    /// Deviation of the height's slow error (a time constant of 10 s), in metres.
    pub height_drift_m: f64,
    /// Estimated height over true height: the barometer's error.
    pub height_scale: f64,
    /// Time constant with which the estimate takes that error over, in seconds.
    pub height_lag_s: f64,
    /// Estimated vertical speed over the true one.
    pub climb_scale: f64,
    /// Deviation of the constant error of roll and pitch, in radians.
    pub trim_rad: f64,
    /// Deviation of the slow error of roll and pitch (a time constant of 5 s), in radians.
    pub lean_drift_rad: f64,
    /// Deviation of the constant error of the heading, in radians.
    pub heading_bias_rad: f64,
    /// Deviation of the horizontal velocity's error as a filter with a wrong tilt makes it, in m/s per axis;
    /// 0 is none. The tilt wanders, its part of gravity adds up to a velocity, and that to a position, which
    /// GNSS holds.
    pub wander_m_s: f64,
    /// Time constants of that tilt and of that velocity, in seconds.
    pub wander_s: f64,
    /// Drift velocity of the estimated position from the world's begin on, in m/s.
    pub gnss_drift_m_s: [f64; 2],
    /// Jump of the estimated position, in metres, and its time, in seconds after the world's begin.
    pub gnss_jump: Option<([f64; 2], f64)>,
    /// Error of the heading until the filter resets it, in radians, and the time of that reset, in seconds after
    /// the world's begin.
    pub heading_reset: Option<(f64, f64)>,
}

impl Default for EstimateConfig {
    fn default() -> Self {
        Self {
            velocity_bias_m_s: 0.015,
            velocity_drift_m_s: 0.006,
            position_drift_m: 0.012,
            height_drift_m: 0.02,
            height_scale: 1.042,
            height_lag_s: 4.0,
            climb_scale: 1.022,
            trim_rad: 0.13f64.to_radians(),
            lean_drift_rad: 0.05f64.to_radians(),
            heading_bias_rad: 0.7f64.to_radians(),
            wander_m_s: 0.0,
            wander_s: 4.0,
            gnss_drift_m_s: [0.0; 2],
            gnss_jump: None,
            heading_reset: None,
        }
    }
}

impl EstimateConfig {
    /// An estimator without errors.
    pub fn perfect() -> Self {
        Self {
            velocity_bias_m_s: 0.0,
            velocity_drift_m_s: 0.0,
            position_drift_m: 0.0,
            height_drift_m: 0.0,
            height_scale: 1.0,
            height_lag_s: 1.0,
            climb_scale: 1.0,
            trim_rad: 0.0,
            lean_drift_rad: 0.0,
            heading_bias_rad: 0.0,
            wander_m_s: 0.0,
            wander_s: 4.0,
            gnss_drift_m_s: [0.0; 2],
            gnss_jump: None,
            heading_reset: None,
        }
    }

    /// The same with all errors of the logs scaled by a factor; wander, GNSS drift and jumps stay.
    #[must_use]
    pub fn times(&self, factor: f64) -> Self {
        Self {
            velocity_bias_m_s: factor * self.velocity_bias_m_s,
            velocity_drift_m_s: factor * self.velocity_drift_m_s,
            position_drift_m: factor * self.position_drift_m,
            height_drift_m: factor * self.height_drift_m,
            height_scale: 1.0 + factor * (self.height_scale - 1.0),
            climb_scale: 1.0 + factor * (self.climb_scale - 1.0),
            trim_rad: factor * self.trim_rad,
            lean_drift_rad: factor * self.lean_drift_rad,
            heading_bias_rad: factor * self.heading_bias_rad,
            ..self.clone()
        }
    }
}

/// The estimated motion. Arrays are north, east, down, from where the autopilot has its local origin.
#[derive(Copy, Clone, Debug, Default, PartialEq)]
pub(super) struct Estimate {
    /// In metres.
    pub(super) position: [f64; 3],
    /// In m/s.
    pub(super) velocity: [f64; 3],
    /// Downwards, in m/s^2.
    pub(super) acceleration_z: f64,
    /// In radians.
    pub(super) roll: f64,
    /// In radians.
    pub(super) pitch: f64,
    /// In radians from north to east.
    pub(super) yaw: f64,
    /// About the body's axes, in rad/s.
    pub(super) rates: [f64; 3],
    /// Estimated minus true roll, in radians.
    pub(super) roll_error: f64,
    /// Estimated minus true pitch, in radians.
    pub(super) pitch_error: f64,
    /// Estimated minus true heading, in radians.
    pub(super) yaw_error: f64,
    /// The reset of the estimated position in this step, in metres.
    pub(super) reset: Option<[f64; 2]>,
}

/// One axis of a filter whose tilt wanders.
#[derive(Clone, Debug)]
struct Wander {
    /// The tilt's part of gravity, in m/s^2.
    pull: Drift,
    velocity: f64,
    position: f64,
}

/// Time constant with which GNSS corrects the estimated position, in seconds.
const GNSS_HOLDS_S: f64 = 0.6;

impl Wander {
    fn new(config: &EstimateConfig, random: &mut ChaCha8Rng) -> Self {
        // Of a drift behind a lag of the same time constant half of the variance is left.
        let deviation = config.wander_m_s * std::f64::consts::SQRT_2 / config.wander_s;
        let velocity = config.wander_m_s * normal(random);
        let position = GNSS_HOLDS_S * velocity;
        Self { pull: Drift::new(deviation, config.wander_s, random), velocity, position }
    }

    fn step(&mut self, dt_s: f64, time_constant_s: f64, random: &mut ChaCha8Rng) {
        let pull = self.pull.step(dt_s, random);
        self.velocity += (pull - self.velocity / time_constant_s) * dt_s;
        self.position += (self.velocity - self.position / GNSS_HOLDS_S) * dt_s;
    }
}

/// Makes the errors.
#[derive(Clone, Debug)]
pub(super) struct Estimator {
    config: EstimateConfig,
    random: ChaCha8Rng,
    velocity_bias: [f64; 2],
    velocity: [Drift; 2],
    position: [Drift; 3],
    trim: [f64; 2],
    lean: [Drift; 2],
    yaw_error: f64,
    height_error: f64,
    wander: [Wander; 2],
    wandering: ChaCha8Rng,
    /// Time since the world's begin, in seconds.
    begun_s: Option<f64>,
    gnss: [f64; 2],
}

impl Estimator {
    pub(super) fn new(config: EstimateConfig, seed: u64) -> Self {
        let mut random = random_stream(seed, 3);
        let draw = &mut random;
        let velocity_bias = [(); 2].map(|()| config.velocity_bias_m_s * normal(draw));
        let velocity = [(); 2].map(|()| Drift::new(config.velocity_drift_m_s, 10.0, draw));
        let position = [config.position_drift_m, config.position_drift_m, config.height_drift_m]
            .map(|deviation| Drift::new(deviation, 10.0, draw));
        let trim = [(); 2].map(|()| config.trim_rad * normal(draw));
        let lean = [(); 2].map(|()| Drift::new(config.lean_drift_rad, 5.0, draw));
        let yaw_error = config.heading_bias_rad * normal(draw);
        let mut wandering = random_stream(seed, 10);
        let wander = [(); 2].map(|()| Wander::new(&config, &mut wandering));
        Self {
            wander,
            wandering,
            config,
            random,
            velocity_bias,
            velocity,
            position,
            trim,
            lean,
            yaw_error,
            height_error: 0.0,
            begun_s: None,
            gnss: [0.0; 2],
        }
    }

    /// Error of the heading, in radians.
    fn yaw_error(&self) -> f64 {
        let is_before = |at_s: f64| self.begun_s.is_none_or(|now_s| now_s < at_s);
        let error = self.config.heading_reset.filter(|(_, at_s)| is_before(*at_s));
        self.yaw_error + error.map_or(0.0, |(error, _)| error)
    }

    /// From now on GNSS drifts and jumps as configured.
    pub(super) fn begin(&mut self) {
        self.begun_s = Some(0.0);
    }

    /// Takes over the barometer's error at a height at once, as it is after a long time there.
    pub(super) fn settle(&mut self, truth: &VehicleTruth) {
        self.height_error = truth.position.z() * (self.config.height_scale - 1.0);
    }

    /// Moves the error of GNSS on; the jump that happens in this step.
    fn drift(&mut self, dt_s: f64) -> Option<[f64; 2]> {
        let before_s = self.begun_s?;
        let now_s = before_s + dt_s;
        self.begun_s = Some(now_s);
        let jump =
            self.config.gnss_jump.filter(|(_, at_s)| (before_s..now_s).contains(at_s)).map(|j| j.0);
        let rates = self.config.gnss_drift_m_s;
        for (i, error) in self.gnss.iter_mut().enumerate() {
            *error += rates[i] * dt_s + jump.map_or(0.0, |jump| jump[i]);
        }
        jump
    }

    /// Advances by `dt_s` and returns the estimate of `truth`.
    pub(super) fn step(&mut self, dt_s: f64, truth: &VehicleTruth) -> Estimate {
        let reset = self.drift(dt_s);
        let drifts = if self.begun_s.is_some() { self.config.gnss_drift_m_s } else { [0.0; 2] };
        let random = &mut self.random;
        let position = self.position.each_mut().map(|drift| drift.step(dt_s, random));
        let velocity = self.velocity.each_mut().map(|drift| drift.step(dt_s, random));
        let lean = self.lean.each_mut().map(|drift| drift.step(dt_s, random));
        for wander in &mut self.wander {
            wander.step(dt_s, self.config.wander_s, &mut self.wandering);
        }
        let [north, east] = &self.wander;
        let (p, v) = (truth.position, truth.velocity);
        let barometer_error = p.z() * (self.config.height_scale - 1.0);
        self.height_error +=
            (barometer_error - self.height_error) * lag(dt_s, self.config.height_lag_s);
        let (roll, pitch, yaw) = truth.ned_from_body.euler();
        // An estimated roll smaller than the true one looks like an acceleration to the left.
        let (sin, cos) = yaw.sin_cos();
        let [north_m_s2, east_m_s2] = [north.pull.value(), east.pull.value()];
        let ahead_rad = (north_m_s2 * cos + east_m_s2 * sin) / GRAVITY_M_S2;
        let aside_rad = (east_m_s2 * cos - north_m_s2 * sin) / GRAVITY_M_S2;
        let roll_error = self.trim[0] + lean[0] + aside_rad;
        let pitch_error = self.trim[1] + lean[1] - ahead_rad;
        let yaw_error = self.yaw_error();
        Estimate {
            position: [
                p.x() + position[0] + self.gnss[0] + north.position,
                p.y() + position[1] + self.gnss[1] + east.position,
                p.z() + self.height_error + position[2],
            ],
            velocity: [
                v.x() + self.velocity_bias[0] + velocity[0] + drifts[0] + north.velocity,
                v.y() + self.velocity_bias[1] + velocity[1] + drifts[1] + east.velocity,
                v.z() * self.config.climb_scale,
            ],
            acceleration_z: truth.acceleration.z(),
            roll: roll + roll_error,
            pitch: pitch + pitch_error,
            yaw: wrap(yaw + yaw_error),
            rates: [truth.angular_rate.x(), truth.angular_rate.y(), truth.angular_rate.z()],
            roll_error,
            pitch_error,
            yaw_error,
            reset,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wandering_velocity_errs_as_much_as_asked_and_its_position_is_held() {
        let config = EstimateConfig { wander_m_s: 0.3, ..EstimateConfig::perfect() };
        let (mut square, mut farthest_m, mut tilt, steps) = (0.0, 0.0f64, 0.0, 100_000);
        let mut random = random_stream(3, 10);
        let mut wander = Wander::new(&config, &mut random);
        for _ in 0..steps {
            wander.step(0.02, config.wander_s, &mut random);
            square += wander.velocity.powi(2);
            tilt += (wander.pull.value() / GRAVITY_M_S2).powi(2);
            farthest_m = farthest_m.max(wander.position.abs());
        }
        let deviation_m_s = (square / f64::from(steps)).sqrt();
        assert!((deviation_m_s - 0.3).abs() < 0.05, "{deviation_m_s}");
        assert!(farthest_m < 1.0, "{farthest_m}");
        let tilt_rad = (tilt / f64::from(steps)).sqrt();
        assert!((tilt_rad - 0.011).abs() < 0.002, "{tilt_rad}");
    }
}
