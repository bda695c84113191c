//! The extended Kalman filter of the pad's position, velocity, tilt error and time offset: prediction with adaptive process noise,
//! innovation, update.
//!
//! | state | unit | why |
//! |---|---|---|
//! | `q` | m | position of the pad in the odometry frame |
//! | `u` | m/s | its velocity there: the pad's own plus the autopilot's drift (GNSS, barometer), which no image can separate and which a setpoint must contain both |
//! | `θ` | rad | error of mount and attitude together, about the body's axes; observable as the height changes |
//! | `τ` | s | time offset: how much later exposures are than their stamps; observable as image motion that follows the vehicle's turning |
//!
//! A detection of the pad at `r` (north, east, down from the vehicle) by a vehicle that moves with `v` and
//! turns with `ω` measures `y = q + (R θ) × r + τ (u - v - ω × r)`, linearised (Bar-Shalom, Li, Kirubarajan:
//! Estimation with Applications to Tracking and Navigation, sections 5.2 and 10.3).
//!
//! The process noise of drift and tilt adapts (the same, section 11.2.1): it grows, within limits, while the
//! normalised innovation squared (NIS) stays larger than the covariance allows, and shrinks again afterwards.
//! An autopilot whose velocity errs by decimetres a second for seconds also reports a wrong tilt, and its
//! position wanders; one with a good estimate keeps the configured noise. A detection beyond the gate is an outlier, which
//! the caller does not fuse, unless it is so near that the autopilot's position and tilt may have wandered there: then
//! the estimate was too sure of itself, and is widened ([`State::predict_to`]).

use geometry::{Odometry, Point, cubed, squared};
use libm::{exp, fmax, fmin, hypot, log};
use nalgebra::{Matrix2, Matrix3, SMatrix, SVector, Vector3};

use crate::config::EstimatorConfig;
use crate::measurement::Measurement;

/// Size of the state, and the indices of `q`, `u`, `θ`, `τ` in it.
const STATES: usize = 10;
const Q: usize = 0;
const U: usize = 3;
const TILT: usize = 6;
const OFFSET: usize = 9;

/// Initial standard deviation of the position, in metres: larger than any range.
const UNKNOWN_M: f64 = 100.0;

/// Random walk of a heaving pad's velocity relative to its maximum heave speed, per square root of a second:
/// a wave of 4 to 8 s.
const HEAVE_CHANGE: f64 = 1.0;

/// Change of the logarithm of the process noise per unit by which the NIS (per degree of freedom) exceeds its mean of one.
const NOISE_GAIN: f64 = 0.08;

/// Largest factor on the random walk of drift and tilt: an estimate that takes any tilt for possible accepts
/// any detection.
const MAX_NOISE_SCALE: f64 = 30.0;

/// How far the autopilot's position may have wandered since the last detection, in metres: at once, and per second up to a longest
/// time. Half a metre a second is more than the 0.07 to 0.23 m/s by which PX4's position drifts in its own simulation; from frame to
/// frame it jumps as well.
const WANDER_M: f64 = 0.02;
const WANDER_M_S: f64 = 0.5;
const MAX_WANDER_S: f64 = 0.3;
/// How far its height may have wandered per second, in m/s. More is a wrong stamp in a descent: taken for a height, it makes the pad
/// sink or rise.
const HEIGHT_WANDER_M_S: f64 = 0.2;
/// How far its roll and pitch may have wandered, in radians: at once, and per second. By 0.01 rad they err where the velocity errs by
/// 0.3 m/s for seconds, as that of PX4 does in its own simulation. A pad that does not move seems displaced by as much for each metre
/// of range.
const WANDER_RAD: f64 = 0.004;
const WANDER_RAD_S: f64 = 0.01;

/// Fraction of the configured time offset by which it walks, per square root of a second.
const OFFSET_CHANGE: f64 = 0.02;

type Mean = SVector<f64, STATES>;
type Covariance = SMatrix<f64, STATES, STATES>;

/// The filter's state at one moment.
#[derive(Clone, Debug)]
pub(crate) struct State {
    mean: Mean,
    covariance: Covariance,
    /// Logarithm of the factor on the random walk of drift and tilt.
    log_noise_scale: f64,
}

/// How a detection fits the state.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Fit {
    /// Its normalised innovation squared before anything was widened for it.
    pub(crate) nis: f64,
    /// Whether it is fused.
    pub(crate) is_inlier: bool,
}

impl State {
    /// Multiplies the covariance by this factor, as that of the detections was too small by it.
    pub(crate) fn widen(&mut self, factor: f64) {
        self.covariance *= factor;
    }

    /// The state before the first detection, around this position of the pad.
    pub(crate) fn new(config: &EstimatorConfig, position: Vector3<f64>) -> Self {
        let mut mean = Mean::zeros();
        mean.fixed_rows_mut::<3>(Q).copy_from(&position);
        let level = hypot(config.drift_m_s, config.pad_speed_m_s);
        let deviations = [
            UNKNOWN_M,
            UNKNOWN_M,
            UNKNOWN_M,
            level,
            level,
            hypot(config.height_drift_m_s, config.pad_heave_m_s),
            config.mount_error_rad,
            config.mount_error_rad,
            config.heading_error_rad,
            config.time_offset_s,
        ];
        let mut covariance = Covariance::zeros();
        for (i, deviation) in deviations.into_iter().enumerate() {
            covariance[(i, i)] = deviation * deviation;
        }
        Self { mean, covariance, log_noise_scale: 0.0 }
    }

    /// Position of the pad, in metres.
    pub(crate) fn position(&self) -> Vector3<f64> {
        self.mean.fixed_rows::<3>(Q).into_owned()
    }

    /// Velocity of the pad, in m/s.
    pub(crate) fn velocity(&self) -> Vector3<f64> {
        self.mean.fixed_rows::<3>(U).into_owned()
    }

    /// Position of the pad after `ahead_s` of constant velocity.
    pub(crate) fn position_after(&self, ahead_s: f64) -> Point<Odometry> {
        let position = self.position() + self.velocity() * ahead_s;
        Point::new(position.x, position.y, position.z)
    }

    /// How much later exposures are than their stamps, in seconds.
    pub(crate) fn time_offset_s(&self) -> f64 {
        self.mean[OFFSET]
    }

    /// Advances the state by `dt_s`.
    pub(crate) fn predict(&mut self, config: &EstimatorConfig, dt_s: f64) {
        let velocity = self.velocity();
        let p = &mut self.covariance;
        for i in 0..3 {
            self.mean[Q + i] += velocity[i] * dt_s;
            // P <- F P F^T, where F adds dt times row and column U to Q.
            for j in 0..STATES {
                p[(Q + i, j)] += dt_s * p[(U + i, j)];
            }
        }
        for i in 0..3 {
            for j in 0..STATES {
                p[(j, Q + i)] += dt_s * p[(j, U + i)];
            }
        }
        let noise_scale = exp(self.log_noise_scale);
        let level = hypot(config.drift_change * noise_scale, config.pad_acceleration);
        let drift = hypot(config.height_drift_change, config.pad_acceleration);
        let vertical = hypot(drift, HEAVE_CHANGE * config.pad_heave_m_s);
        for (i, u) in [level, level, vertical].into_iter().enumerate() {
            let (u, q) = (u * u, squared(config.odometry_noise_m));
            p[(Q + i, Q + i)] += q * dt_s + u * cubed(dt_s) / 3.0;
            p[(Q + i, U + i)] += u * squared(dt_s) / 2.0;
            p[(U + i, Q + i)] += u * squared(dt_s) / 2.0;
            p[(U + i, U + i)] += u * dt_s;
        }
        for i in 0..3 {
            p[(TILT + i, TILT + i)] += squared(config.tilt_change * noise_scale) * dt_s;
        }
        p[(OFFSET, OFFSET)] += squared(OFFSET_CHANGE * config.time_offset_s) * dt_s;
    }

    /// The normalised innovation squared: chi-square with 3 degrees of freedom.
    pub(crate) fn nis(&self, measurement: &Measurement) -> f64 {
        let h = self.observation_jacobian(measurement);
        let s = h * self.covariance * h.transpose() + measurement.noise;
        let innovation = self.innovation(measurement);
        s.try_inverse().map_or(f64::INFINITY, |inverse| innovation.dot(&(inverse * innovation)))
    }

    /// Advances the state by `dt_s` to a detection, and returns how it fits. A detection beyond the gate that
    /// is as near as the autopilot's position and tilt may have wandered since the last one is not of another position: the covariance of
    /// position and velocity is widened by the factor by which it is beyond (a fading factor: Xia, Rao, Ying, Shen: Adaptive Fading
    /// Kalman Filter with an Application, Automatica 30, 1994).
    pub(crate) fn predict_to(
        &mut self,
        config: &EstimatorConfig,
        dt_s: f64,
        measurement: &Measurement,
    ) -> Fit {
        self.predict(config, dt_s);
        let nis = self.nis(measurement);
        // Neither a NaN nor a negative value, as of an invalid covariance, is an inlier.
        let is_inlier = |nis: f64| (0.0..=config.gate).contains(&nis);
        let wander_s = fmin(dt_s, MAX_WANDER_S);
        let is_still = config.pad_speed_m_s <= 0.0;
        let wander_rad = if is_still { WANDER_RAD + WANDER_RAD_S * wander_s } else { 0.0 };
        let wander_m = WANDER_M + WANDER_M_S * wander_s + measurement.range_m * wander_rad;
        let innovation = self.innovation(measurement);
        let height_noise_m = fmax(measurement.noise[(2, 2)], 0.0).sqrt();
        // A tilt raises a marker that is seen to the side.
        let height_wander_m = WANDER_M
            + (HEIGHT_WANDER_M_S + config.pad_heave_m_s) * wander_s
            + measurement.tilt.row(2).norm() * wander_rad
            + height_noise_m;
        let is_near = innovation.norm() <= wander_m && innovation.z.abs() <= height_wander_m;
        if !(nis > config.gate && nis.is_finite() && is_near) {
            return Fit { nis, is_inlier: is_inlier(nis) };
        }
        let factor = (nis / config.gate).sqrt();
        let factor_of = |state: usize| if state < TILT { factor } else { 1.0 };
        for i in 0..STATES {
            for j in 0..STATES {
                self.covariance[(i, j)] *= factor_of(i) * factor_of(j);
            }
        }
        // Now it is at the gate, or beyond it by the noise of the detection, which is not widened.
        Fit { nis, is_inlier: is_inlier(fmin(self.nis(measurement), config.gate)) }
    }

    /// Fuses a detection.
    pub(crate) fn update(&mut self, config: &EstimatorConfig, measurement: &Measurement) {
        let h = self.observation_jacobian(measurement);
        let ph = self.covariance * h.transpose();
        let Some(inverse) = (h * ph + measurement.noise).try_inverse() else { return };
        let gain = ph * inverse;
        let innovation = self.innovation(measurement);
        self.adapt_process_noise(config, innovation, h * ph + measurement.noise);
        self.mean += gain * innovation;
        let less = gain * ph.transpose();
        let p = self.covariance - (less + less.transpose()) * 0.5;
        self.covariance = (p + p.transpose()) * 0.5;
        let max_s = 3.0 * config.time_offset_s;
        self.mean[OFFSET] = self.mean[OFFSET].clamp(-max_s, max_s);
    }

    /// Largest horizontal standard deviation after `ahead_s` without a detection, in metres.
    pub(crate) fn deviation_m(&self, config: &EstimatorConfig, ahead_s: f64) -> f64 {
        // Of the random walk of the drift only the part above the configured one counts: the configured part
        // is in the limits for a descent without the marker.
        let raised = squared(config.drift_change) * (exp(2.0 * self.log_noise_scale) - 1.0);
        let change = squared(config.pad_acceleration) + raised;
        let p = &self.covariance;
        let block = |row: usize, column: usize| p.fixed_view::<2, 2>(row, column).into_owned();
        let cross: Matrix2<f64> = block(Q, U);
        let grown = block(Q, Q)
            + (cross + cross.transpose()) * ahead_s
            + block(U, U) * squared(ahead_s)
            + Matrix2::identity() * (squared(config.odometry_noise_m) * ahead_s)
            + Matrix2::identity() * (change * cubed(ahead_s) / 3.0);
        let (mean, half) = (0.5 * (grown.m11 + grown.m22), 0.5 * (grown.m11 - grown.m22));
        fmax(mean + hypot(half, grown.m12), 0.0).sqrt()
    }

    fn observation_jacobian(&self, measurement: &Measurement) -> SMatrix<f64, 3, STATES> {
        let mut h = SMatrix::<f64, 3, STATES>::zeros();
        let offset_s = self.mean[OFFSET];
        for i in 0..3 {
            h[(i, Q + i)] = 1.0;
            h[(i, U + i)] = offset_s;
        }
        h.fixed_view_mut::<3, 3>(0, TILT).copy_from(&measurement.tilt);
        h.fixed_view_mut::<3, 1>(0, OFFSET).copy_from(&(measurement.slip + self.velocity()));
        h
    }

    fn innovation(&self, measurement: &Measurement) -> Vector3<f64> {
        let tilt = self.mean.fixed_rows::<3>(TILT).into_owned();
        let slip = measurement.slip + self.velocity();
        measurement.position - self.position() - measurement.tilt * tilt - slip * self.mean[OFFSET]
    }

    /// Adapts the process noise to the horizontal part of an innovation; heights drift by their own rules.
    fn adapt_process_noise(
        &mut self,
        config: &EstimatorConfig,
        innovation: Vector3<f64>,
        covariance: Matrix3<f64>,
    ) {
        let level = innovation.xy();
        let Some(inverse) = covariance.fixed_view::<2, 2>(0, 0).into_owned().try_inverse() else {
            return;
        };
        let excess = 0.5 * level.dot(&(inverse * level)) - 1.0;
        let max = if config.drift_change > 0.0 {
            log((config.max_drift_change / config.drift_change).clamp(1.0, MAX_NOISE_SCALE))
        } else {
            0.0
        };
        self.log_noise_scale = (self.log_noise_scale + NOISE_GAIN * excess).clamp(0.0, max);
    }

    /// Logarithm of the factor on the random walk of drift and tilt.
    #[cfg(test)]
    pub(crate) fn log_noise_scale(&self) -> f64 {
        self.log_noise_scale
    }

    /// Squared error of a position over its covariance: chi-square with 3 degrees of freedom.
    #[cfg(test)]
    pub(crate) fn normalised_error(&self, error: Vector3<f64>) -> f64 {
        let block: Matrix3<f64> = self.covariance.fixed_view::<3, 3>(Q, Q).into_owned();
        block.try_inverse().map_or(f64::INFINITY, |inverse| error.dot(&(inverse * error)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_process_noise_grows_up_to_its_limit_only() {
        for (drift_change, max) in [(0.0, 1.0), (1e-6, MAX_NOISE_SCALE), (0.01, MAX_NOISE_SCALE)] {
            let config = EstimatorConfig { drift_change, ..EstimatorConfig::default() };
            let mut state = State::new(&config, Vector3::zeros());
            for _ in 0..1000 {
                let innovation = Vector3::new(3.0, 0.0, 0.0);
                state.adapt_process_noise(&config, innovation, Matrix3::identity());
            }
            let scale = state.log_noise_scale.exp();
            assert!((scale - max).abs() < 1e-6, "{drift_change}: {scale}");
        }
    }

    #[test]
    fn the_predicted_deviation_grows_with_the_process_noise() {
        let config = EstimatorConfig::default();
        let variances = |log_noise_scale: f64| {
            let mut state = State::new(&config, Vector3::zeros());
            state.covariance = Covariance::identity() * 1e-4;
            state.log_noise_scale = log_noise_scale;
            let predicted_m = state.deviation_m(&config, 2.0);
            state.predict(&config, 2.0);
            [predicted_m, state.deviation_m(&config, 0.0)].map(|m| m * m)
        };
        let calm = variances(0.0);
        for log_noise_scale in [1.0, MAX_NOISE_SCALE.ln()] {
            let raised = variances(log_noise_scale);
            let (predicted, reached) = (raised[0] - calm[0], raised[1] - calm[1]);
            assert!((predicted - reached).abs() < 1e-9, "{predicted} m^2, {reached} m^2");
            assert!(predicted > 1e-3, "{predicted} m^2");
        }
    }
}
