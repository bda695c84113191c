//! Measures in flight by how much the camera's mount, its focal length and the marker's size are off, from the apparent motion of the pad.
//!
//! A pad that does not move has one position. Under a mount that is off by `θ` it moves by `θ` times the height as
//! the height changes; under a focal length that is off it moves as the vehicle tilts, under a marker of another
//! size as the vehicle moves sideways. A Kalman filter of nearly constant parameters (Bar-Shalom, Li,
//! Kirubarajan: Estimation with Applications to Tracking and Navigation, section 7) explains the apparent
//! horizontal motion by them and by its other causes:
//!
//! | state | unit | meaning |
//! |---|---|---|
//! | `q`, `u` | m, m/s | the pad's position and the autopilot's drift, north and east |
//! | `θ` | rad | error of mount and attitude about the body's axes |
//! | `f`, `s` | | error of the focal length and of the marker's size, relative |
//! | `τ` | s | how much later exposures are than their stamps |
//!
//! Other apparent motions of the pad, as of an estimator that errs more in wind, are not as random as the filter assumes. An error
//! of the mount, the focal length or the size is the same in each part of a flight, so the estimates of the single parts
//! must agree: by as much as they scatter more than by their deviations, the deviation is larger (the ratio of Birge: Physical
//! Review 40, 1932).
//!
//! Heights are left out: a barometer errs by as much as a focal length that is 4 % off. The random walks grow
//! while detections show that the autopilot's position wanders, as in `filter.rs`, and with them the deviations.

use geometry::{Body, Camera, Rotation, Vector, squared};
use libm::{acos, exp, fmax, fmin, hypot, log};
use nalgebra::{Matrix2, Matrix2x3, SMatrix, SVector, Vector2};

use crate::config::EstimatorConfig;
use crate::decision::TargetEstimate;
use crate::event::{FrameObservation, MarkerInFrame};
use crate::history::{History, Motion};
use crate::measurement::{MarkerPose, Measurement};
use crate::time::Timestamp;

/// Size of the state, and the indices of its parts.
const STATES: usize = 10;
const Q: usize = 0;
const U: usize = 2;
const TILT: usize = 4;
const FOCAL: usize = 7;
const SIZE: usize = 8;
const OFFSET: usize = 9;
/// Those that are reported: roll, pitch, focal length and size.
const REPORTED: [usize; 4] = [TILT, TILT + 1, FOCAL, SIZE];

/// Initial standard deviations, in the units of the states.
const UNKNOWN: [f64; STATES] = [100.0, 100.0, 0.08, 0.08, 0.1, 0.1, 0.05, 0.1, 0.05, 0.05];

/// Random walks in calm flight, in the units of the states per square root of a second. The heading's is larger: ArduPilot's swings by 3
/// degrees and back within 4 s in gusts.
const WALK: [f64; STATES] = [0.008, 0.008, 0.004, 0.004, 5e-4, 5e-4, 3e-3, 0.0, 0.0, 1e-3];

/// Change of the logarithm of the random walks per unit of excess NIS, the NIS per degree of freedom, above its
/// mean of one, that counts as no excess, and the largest factor on them.
const NOISE_GAIN: f64 = 0.08;
const NOISE_SLACK: f64 = 0.4;
const MAX_NOISE_SCALE: f64 = 30.0;

/// Normalised innovation squared beyond which a detection is an outlier, and the number of those in a row after
/// which the pad is elsewhere.
const GATE: f64 = 12.0;
const MAX_OUTLIERS: u32 = 8;

/// Time constants with which the marker's depths are smoothed, in seconds, the number of detections after which they
/// count, and the shortest time between two from which a velocity is taken, in seconds.
const DEPTH_S: f64 = 1.0;
const MEAN_S: f64 = 10.0;
const MAX_DEPTHS: u32 = 1000;
const MIN_STEP_S: f64 = 1e-3;

/// Longest time without a detection over which position and drift are predicted, in seconds.
const MAX_GAP_S: f64 = 3.0;

/// Largest accepted time offset, in seconds.
const MAX_OFFSET_S: f64 = 0.15;

/// Minimum height over the marker of a detection that is used, in metres: near the ground the air and the ground
/// itself move the vehicle in ways that the autopilot does not estimate.
const MIN_HEIGHT_M: f64 = 0.5;

/// Smallest horizontal speeds of motions that show the marker's size and the focal length, in m/s. The autopilot holds its own estimate of
/// a hover still, whose drift the vehicle follows: the seen marker then moves while the estimate does not, as one of size zero would.
const MIN_SIZE_SPEED_M_S: f64 = 0.3;
const MIN_FOCAL_SPEED_M_S: f64 = 0.1;

/// An error is reported when it is larger than this many standard deviations and than a minimum, and its standard deviation
/// is smaller than a part of that minimum, in this many detections in a row; and no longer when it is smaller than a part
/// of both.
const MIN_DEVIATIONS: f64 = 3.0;
const MIN_RATIO_DEVIATIONS: f64 = 3.5;
const MIN_ANGLE_RAD: f64 = 1.5 * std::f64::consts::PI / 180.0;
const MIN_RATIO: f64 = 0.03;
/// Standard deviation of the scale of the autopilot's motion over a few metres, and the smallest reported error of the marker's size:
/// both look the same, in each flight again. The estimate of ArduPilot 4.5 in SITL lags behind an approach of 2 m by 2 to 2.5 % and catches
/// up in ten seconds: ten landings made it a marker that is 3.2 +- 0.6 % smaller.
const MOTION_SCALE: f64 = 0.015;
const MIN_SIZE_RATIO: f64 = 0.05;
const MAX_DEVIATION: f64 = 0.5;
const MIN_IN_A_ROW: u32 = 15;
/// Length of a part of the flight whose estimate is compared with those of the others, in seconds, the smallest fraction of the
/// information that a part must bring to count, and the number of such parts without which no error is reported:
/// fewer attribute to the mount the wandering of ArduPilot's estimate in 8 m/s of wind with turbulence 3.
const PART_S: f64 = 1.0;
const MIN_FRACTION: f64 = 0.01;
const MIN_PARTS: [u32; 4] = [6, 6, 3, 3];
/// Time constant with which the vehicle's lean is smoothed, in seconds.
const LEAN_S: f64 = 5.0;
/// Lean above which the wind is strong, in radians. In 8 m/s of wind SITL's vehicle leans by 0.37 to 0.5 rad, and the position of
/// ArduPilot's estimate wanders by 0.1 m, its heading by 3 degrees, within seconds: descents made roll errors of up to 4.4 deviations of
/// that.
const STRONG_LEAN_RAD: f64 = 0.28;
/// By how many times more deviations an angle, focal length or size must be off to be reported in such wind, per radian above that lean.
const STRICTER_PER_RAD: f64 = 6.0;
/// Factor on the random walks above which no new error is reported: the pad's motion then has another cause. It is smaller for
/// focal length and size, which show in less motion than the mount.
const MAX_REPORT_NOISE_SCALE: f64 = 3.0;
const MAX_REPORT_RATIO_NOISE_SCALE: f64 = 1.5;
/// Fraction of the limits of an error below which it is no longer reported.
const CLEAR_FRACTION: f64 = 0.7;

type Mean = SVector<f64, STATES>;
type Covariance = SMatrix<f64, STATES, STATES>;

/// A measured error with its standard deviation.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Measured {
    /// The error of the true value relative to the configured one.
    pub value: f64,
    /// Its standard deviation.
    pub deviation: f64,
}

/// The errors that are certain; `None` for values that may be as configured.
#[derive(Copy, Clone, Debug, Default, PartialEq)]
pub struct MountFindings {
    /// The camera is turned about the vehicle's forward axis by this much more than configured, in radians: it
    /// looks further to the left.
    pub roll_rad: Option<Measured>,
    /// The same about the axis to the right: it looks further forward.
    pub pitch_rad: Option<Measured>,
    /// The focal length is larger than configured by this fraction.
    pub focal_ratio: Option<Measured>,
    /// The marker is larger than configured by this fraction.
    pub size_ratio: Option<Measured>,
}

impl MountFindings {
    /// The angle by which the camera's mount is off, in radians; 0 while it may be as configured.
    pub fn angle_rad(&self) -> f64 {
        let value = |measured: Option<Measured>| measured.map_or(0.0, |it| it.value);
        hypot(value(self.roll_rad), value(self.pitch_rad))
    }
}

/// The filter; nothing is allocated.
#[derive(Clone, Debug)]
pub struct MountCheck {
    mean: Mean,
    covariance: Covariance,
    log_noise_scale: f64,
    /// The pad's position downwards, in metres, its velocity there, in m/s, and the number of detections in both.
    pad_z: f64,
    pad_sinks_m_s: f64,
    depths: u32,
    /// The mean of that position over a longer time, in metres.
    mean_pad_z: f64,
    newest: Option<Timestamp>,
    mount: Option<Rotation<Body, Camera>>,
    /// The angle between the body's down axis and the vertical, smoothed, in radians.
    lean_rad: f64,
    outliers: u32,
    roll: Suspicion,
    pitch: Suspicion,
    focal: Suspicion,
    size: Suspicion,
    /// Of roll, pitch, focal length and size.
    parts: [Parts; 4],
}

/// The estimates of one error by the parts of a flight.
#[derive(Copy, Clone, Debug, Default)]
struct Parts {
    /// The beginning of the present one, and the estimate before it.
    begin: Option<(Timestamp, Measured)>,
    count: u32,
    /// Sums of the weights, the inverse variances, and with them of the estimates and their squares.
    weight: f64,
    sum: f64,
    squares: f64,
}

/// Whether one error is reported.
#[derive(Copy, Clone, Debug, Default)]
struct Suspicion {
    in_a_row: u32,
    is_reported: bool,
}

impl Default for MountCheck {
    fn default() -> Self {
        Self {
            mean: Mean::zeros(),
            covariance: Covariance::from_diagonal(&Mean::from(UNKNOWN.map(|d| d * d))),
            log_noise_scale: 0.0,
            pad_z: 0.0,
            pad_sinks_m_s: 0.0,
            depths: 0,
            mean_pad_z: 0.0,
            newest: None,
            mount: None,
            lean_rad: 0.0,
            outliers: 0,
            roll: Suspicion::default(),
            pitch: Suspicion::default(),
            focal: Suspicion::default(),
            size: Suspicion::default(),
            parts: [Parts::default(); 4],
        }
    }
}

impl MountCheck {
    /// Adds a marker of a pad that does not move sideways.
    pub(crate) fn observe(
        &mut self,
        config: &EstimatorConfig,
        frame: &FrameObservation,
        marker: &MarkerInFrame,
        history: &History,
    ) {
        let exposed = frame.stamp.plus_seconds(self.mean[OFFSET]);
        let (Some(pose), Some(motion)) = (marker.body_from_marker, history.at(exposed)) else {
            return;
        };
        let pose = MarkerPose::resolve(&motion, pose, marker.alternative);
        if config.pad_speed_m_s == 0.0
            && let Ok(seen) = pose.measurement(config, frame, marker, &motion)
        {
            self.add(frame, &motion, &seen);
        }
    }

    /// The estimate with the angle by which the mount is off as part of its deviation.
    pub(crate) fn widen(&self, target: TargetEstimate) -> TargetEstimate {
        let off_m = self.findings().angle_rad() * fmax(target.height_m, 0.0);
        TargetEstimate { deviation_m: hypot(target.deviation_m, off_m), ..target }
    }

    /// Adds a marker's position with the vehicle's motion at the exposure.
    fn add(&mut self, frame: &FrameObservation, motion: &Motion, measurement: &Measurement) {
        // Another camera, or the same with another mount.
        if self.mount != frame.body_from_camera {
            *self = Self { mount: frame.body_from_camera, ..Self::default() };
        }
        let seen = measurement.position - motion.odometry.coords.coords;
        if seen.z < MIN_HEIGHT_M {
            return;
        }
        let after_s = self.newest.map_or(0.0, |newest| measurement.stamp.seconds_since(newest));
        if after_s < 0.0 {
            return;
        }
        if self.newest.is_none() || after_s > MAX_GAP_S {
            self.reset_position(measurement);
        }
        self.smooth_lean(motion, after_s);
        self.newest = Some(measurement.stamp);
        self.predict(fmin(after_s, MAX_GAP_S));
        self.smooth_depth(measurement.position.z, after_s);
        let height_m = fmax(self.pad_z - motion.odometry.z(), MIN_HEIGHT_M);
        // Errors are multiplied with another height than that of the position: an error that both had would
        // look like a mount that is off towards the marker.
        let lever = fmax(self.mean_pad_z - motion.odometry.z(), MIN_HEIGHT_M) / seen.z;
        // Only the direction of the detection is used; its derivative at that height.
        let slope = seen.xy() / seen.z;
        let scale = height_m / seen.z;
        let direction = Matrix2x3::new(scale, 0.0, -scale * slope.x, 0.0, scale, -scale * slope.y);
        let axis = frame.body_from_camera.map_or(Vector::<Body>::new(0.0, 0.0, 1.0), |mount| {
            mount * Vector::<Camera>::new(0.0, 0.0, 1.0)
        });
        let axis = (motion.ned_from_body * axis).coords;
        let depth = axis * axis.dot(&seen) * lever;
        let slip = direction * measurement.slip;
        let mut h = SMatrix::<f64, 2, STATES>::zeros();
        for i in 0..2 {
            h[(i, Q + i)] = 1.0;
            for j in 0..3 {
                h[(i, TILT + j)] = measurement.tilt[(i, j)] * lever;
            }
            h[(i, FOCAL)] = depth[i];
            h[(i, SIZE)] = seen[i] * lever;
            h[(i, OFFSET)] = slip[i] + self.mean[U + i];
        }
        let position = motion.odometry.coords.coords.xy() + slope * height_m;
        let noise = direction * measurement.noise * direction.transpose()
            + slope * slope.transpose() * measurement.noise[(2, 2)];
        // The motion is that of the estimated time already.
        let expected = h * self.mean - h.column(OFFSET) * self.mean[OFFSET];
        let speed_m_s = motion.velocity.horizontal_norm();
        self.update(&h, position - expected, noise, measurement, speed_m_s);
    }

    /// Smooths the marker's depths. A line is fitted to those of the last second (the fading memory of Morrison:
    /// Introduction to Sequential Smoothing and Prediction, section 13), as the autopilot's height drifts in a
    /// descent.
    fn smooth_depth(&mut self, measured_z: f64, after_s: f64) {
        self.depths = (self.depths + 1).min(MAX_DEPTHS);
        if self.depths == 1 {
            (self.pad_z, self.mean_pad_z, self.pad_sinks_m_s) = (measured_z, measured_z, 0.0);
            return;
        }
        let n = f64::from(self.depths);
        let keep = exp(-after_s / DEPTH_S);
        let level = fmax(1.0 - keep * keep, 2.0 * (2.0 * n - 1.0) / (n * (n + 1.0)));
        let trend = fmax(squared(1.0 - keep), 6.0 / (n * (n + 1.0)));
        let expected = self.pad_z + self.pad_sinks_m_s * after_s;
        let difference = measured_z - expected;
        self.pad_z = expected + fmin(level, 1.0) * difference;
        if after_s > MIN_STEP_S {
            self.pad_sinks_m_s += fmin(trend, 1.0) * difference / after_s;
        }
        let fraction = fmax(1.0 / n, fmin(after_s / MEAN_S, 1.0));
        self.mean_pad_z += fraction * (measured_z - self.mean_pad_z);
    }

    fn smooth_lean(&mut self, motion: &Motion, after_s: f64) {
        let lean_rad = acos(motion.ned_from_body.down_axis().z().clamp(-1.0, 1.0));
        let fraction = if self.newest.is_none() { 1.0 } else { 1.0 - exp(-after_s / LEAN_S) };
        self.lean_rad += fraction * (lean_rad - self.lean_rad);
    }

    /// The errors that are certain.
    pub fn findings(&self) -> MountFindings {
        let of = |suspicion: Suspicion, error: Measured| {
            // The filter's errors are relative to the configured value.
            suspicion.is_reported.then_some(Measured { value: -error.value, ..error })
        };
        let [roll, pitch, focal, size] = self.errors();
        MountFindings {
            roll_rad: of(self.roll, roll),
            pitch_rad: of(self.pitch, pitch),
            focal_ratio: of(self.focal, focal),
            size_ratio: of(self.size, size),
        }
    }

    /// The estimates of roll, pitch, focal length and size, with what their parts' scatter and the motion's scale add to the deviations.
    fn errors(&self) -> [Measured; 4] {
        let [mut roll, mut pitch, mut focal, mut size] = self.estimates();
        let errors = [&mut roll, &mut pitch, &mut focal, &mut size].into_iter();
        for ((error, parts), min_parts) in errors.zip(self.parts).zip(MIN_PARTS) {
            error.deviation *= parts.scatter(min_parts);
        }
        size.deviation = hypot(size.deviation, MOTION_SCALE);
        [roll, pitch, focal, size]
    }

    /// The same as the filter has them.
    fn estimates(&self) -> [Measured; 4] {
        REPORTED.map(|index| Measured { value: self.mean[index], deviation: self.deviation(index) })
    }

    fn deviation(&self, index: usize) -> f64 {
        fmax(self.covariance[(index, index)], 0.0).sqrt()
    }

    /// Begins with another position of the pad, and retains the estimates of the camera.
    fn reset_position(&mut self, measurement: &Measurement) {
        for (i, unknown) in UNKNOWN.iter().enumerate().take(TILT) {
            self.covariance.row_mut(i).fill(0.0);
            self.covariance.column_mut(i).fill(0.0);
            self.covariance[(i, i)] = unknown * unknown;
            self.mean[i] = 0.0;
        }
        self.mean.fixed_rows_mut::<2>(Q).copy_from(&measurement.position.xy());
        (self.outliers, self.depths) = (0, 0);
    }

    fn predict(&mut self, dt_s: f64) {
        let p = &mut self.covariance;
        for i in 0..2 {
            self.mean[Q + i] += self.mean[U + i] * dt_s;
            for j in 0..STATES {
                p[(Q + i, j)] += dt_s * p[(U + i, j)];
            }
        }
        for i in 0..2 {
            for j in 0..STATES {
                p[(j, Q + i)] += dt_s * p[(j, U + i)];
            }
        }
        let scale = exp(2.0 * self.log_noise_scale);
        for (i, walk) in WALK.iter().enumerate() {
            p[(i, i)] += scale * walk * walk * dt_s;
        }
    }

    fn update(
        &mut self,
        h: &SMatrix<f64, 2, STATES>,
        innovation: Vector2<f64>,
        noise: Matrix2<f64>,
        measurement: &Measurement,
        speed_m_s: f64,
    ) {
        let ph = self.covariance * h.transpose();
        let innovation_covariance = h * ph + noise;
        let Some(inverse) = innovation_covariance.try_inverse() else { return };
        let nis = innovation.dot(&(inverse * innovation));
        let excess = 0.5 * nis.clamp(0.0, GATE) - 1.0 - NOISE_SLACK;
        let scale = self.log_noise_scale + NOISE_GAIN * excess;
        self.log_noise_scale =
            if nis.is_finite() { scale.clamp(0.0, log(MAX_NOISE_SCALE)) } else { 0.0 };
        if !(0.0..=GATE).contains(&nis) {
            self.outliers = self.outliers.saturating_add(1);
            if self.outliers > MAX_OUTLIERS {
                self.reset_position(measurement);
            }
            return;
        }
        self.outliers = 0;
        let mut gain = ph * inverse;
        // A state that is not estimated keeps its part in the uncertainty (Schmidt: Application of State-Space Methods to Navigation
        // Problems, 1966).
        for (index, min_m_s) in [(FOCAL, MIN_FOCAL_SPEED_M_S), (SIZE, MIN_SIZE_SPEED_M_S)] {
            if speed_m_s < min_m_s {
                gain.row_mut(index).fill(0.0);
            }
        }
        let mean = self.mean + gain * innovation;
        let less = gain * ph.transpose();
        let p = self.covariance - less - less.transpose()
            + gain * innovation_covariance * gain.transpose();
        let p = (p + p.transpose()) * 0.5;
        if !mean.iter().chain(p.iter()).all(|number| number.is_finite()) {
            *self = Self::default();
            return;
        }
        (self.mean, self.covariance) = (mean, p);
        self.mean[OFFSET] = self.mean[OFFSET].clamp(-MAX_OFFSET_S, MAX_OFFSET_S);
        self.suspect(measurement.stamp);
    }

    fn suspect(&mut self, stamp: Timestamp) {
        for (estimate, parts) in self.estimates().into_iter().zip(&mut self.parts) {
            parts.add(stamp, estimate);
        }
        let [roll, pitch, focal, size] = self.errors();
        let is_calm = |max_scale: f64| self.log_noise_scale < log(max_scale);
        let is_calm_for_ratios = is_calm(MAX_REPORT_RATIO_NOISE_SCALE);
        let is_calm = is_calm(MAX_REPORT_NOISE_SCALE);
        let stricter = 1.0 + STRICTER_PER_RAD * fmax(self.lean_rad - STRONG_LEAN_RAD, 0.0);
        let deviations = |suspicion: &Suspicion, min: f64| {
            // An error that was found in calmer air stays found.
            if suspicion.is_reported { min } else { stricter * min }
        };
        for (suspicion, angle) in [(&mut self.roll, roll), (&mut self.pitch, pitch)] {
            let min_deviations = deviations(suspicion, MIN_DEVIATIONS);
            suspicion.follow(angle, min_deviations, MIN_ANGLE_RAD, is_calm);
        }
        let ratios = [(&mut self.focal, focal, MIN_RATIO), (&mut self.size, size, MIN_SIZE_RATIO)];
        for (suspicion, ratio, min) in ratios {
            let min_deviations = deviations(suspicion, MIN_RATIO_DEVIATIONS);
            suspicion.follow(ratio, min_deviations, min, is_calm_for_ratios);
        }
    }
}

impl Parts {
    /// Follows the estimate over all parts.
    fn add(&mut self, stamp: Timestamp, all: Measured) {
        let (since, before) = *self.begin.get_or_insert((stamp, all));
        if stamp.seconds_since(since) < PART_S {
            return;
        }
        self.begin = Some((stamp, all));
        let [weight_before, weight_all] = [before, all].map(|it| 1.0 / squared(it.deviation));
        let weight = weight_all - weight_before;
        if weight > MIN_FRACTION * weight_all && weight.is_finite() {
            let value = (all.value * weight_all - before.value * weight_before) / weight;
            self.count = self.count.saturating_add(1);
            self.weight += weight;
            self.sum += weight * value;
            self.squares += weight * value * value;
        }
    }

    /// By how much more than by their deviations the estimates of the parts scatter; infinite for fewer than a minimum.
    fn scatter(&self, min_parts: u32) -> f64 {
        if self.count < min_parts {
            return f64::INFINITY;
        }
        let squares = self.squares - self.sum * self.sum / self.weight;
        fmax(squares / f64::from(self.count - 1), 1.0).sqrt()
    }
}

impl Suspicion {
    fn follow(&mut self, error: Measured, min_deviations: f64, min: f64, is_calm: bool) {
        let fraction = if self.is_reported { CLEAR_FRACTION } else { 1.0 };
        let limit = fmax(min_deviations * error.deviation, min) * fraction;
        let is_known = error.deviation < MAX_DEVIATION * min;
        if error.value.abs() > limit && (self.is_reported || is_known && is_calm) {
            self.in_a_row = self.in_a_row.saturating_add(1);
            self.is_reported |= self.in_a_row >= MIN_IN_A_ROW;
        } else {
            *self = Self::default();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::{Ned, Pixel, Point, Transform};

    fn frame(seconds: f64, body_from_camera: Rotation<Body, Camera>) -> FrameObservation {
        FrameObservation {
            stamp: Timestamp::from_seconds(seconds),
            image_size: (1296, 972),
            focal_px: Some(1818.0),
            body_from_camera: Some(body_from_camera),
            marker: None,
        }
    }

    /// Sees a pad's marker there, relative to the vehicle.
    fn see(check: &mut MountCheck, frame: &FrameObservation, motion: &Motion, seen: Vector<Body>) {
        let pose = Transform::new(Rotation::identity(), Point::origin() + seen);
        let marker = MarkerInFrame {
            centre: Pixel::new(0.0, 0.0),
            body_from_marker: Some(pose),
            alternative: None,
            covariance_m2: None,
            size_px: Some(40.0),
            confidence: 1.0,
        };
        let pose = MarkerPose::resolve(motion, pose, None);
        if let Ok(seen) = pose.measurement(&EstimatorConfig::default(), frame, &marker, motion) {
            check.add(frame, motion, &seen);
        }
    }

    /// Moves down and up again over a pad whose marker is seen by a camera that is pitched by this much more than
    /// configured.
    fn descend(check: &mut MountCheck, from_s: f64, mount: Rotation<Body, Camera>, pitch: f64) {
        descend_leaning(check, from_s, mount, pitch, 0.0);
    }

    /// The same of a vehicle that leans sideways by `lean_rad` against its wind.
    fn descend_leaning(
        check: &mut MountCheck,
        from_s: f64,
        mount: Rotation<Body, Camera>,
        pitch: f64,
        lean_rad: f64,
    ) {
        let off = Rotation::<Body, Body>::from_euler(0.0, pitch, 0.0);
        for i in 0..150 {
            let t = f64::from(i) / 15.0;
            let position =
                Point::new((0.7 * t).sin(), (0.5 * t).cos(), -7.0 - 3.0 * (0.6 * t).cos());
            let attitude =
                Rotation::<Ned, Body>::from_euler(0.05 * t.sin() + lean_rad, 0.05 * t.cos(), 0.3);
            let in_body = off.inverse() * (attitude.inverse() * (Point::origin() - position));
            let motion = Motion::still(attitude, position);
            see(check, &frame(from_s + t, mount), &motion, in_body);
        }
    }

    /// Approaches a pad 2 m to the side at 6 m, sinks and stops, in each of so many flights; the marker is larger than configured by this
    /// fraction, and the autopilot's position moves by this fraction of the way.
    fn size_found(flights: u32, larger: f64, moved: f64) -> Option<Measured> {
        let mut check = MountCheck::default();
        for number in 0..flights {
            for i in 0..180 {
                let t = f64::from(i) / 15.0;
                let way = |from_s: f64, for_s: f64| {
                    let fraction = ((t - from_s) / for_s).clamp(0.0, 1.0);
                    (
                        fraction * fraction * (3.0 - 2.0 * fraction),
                        6.0 * fraction * (1.0 - fraction) / for_s,
                    )
                };
                let ((aside, speed), (down, sinks)) = (way(2.0, 3.0), way(5.0, 6.0));
                let position = Point::new(2.0 * (aside - 1.0), 0.0, 5.0 * down - 6.0);
                let seen = (Point::<Ned>::origin() - position) * (1.0 / (1.0 + larger));
                let reported = Point::new(2.0 * moved * (aside - 1.0), 0.0, position.z());
                let motion = Motion {
                    velocity: Vector::new(2.0 * moved * speed, 0.0, 5.0 * sinks),
                    ..Motion::still(Rotation::identity(), reported)
                };
                let frame = frame(60.0 * f64::from(number) + t, Rotation::identity());
                see(&mut check, &frame, &motion, Rotation::identity() * seen);
            }
        }
        check.findings().size_ratio
    }

    #[test]
    fn a_motion_that_the_autopilot_underestimates_in_each_flight_is_no_marker_of_another_size() {
        for flights in [1, 4, 16] {
            assert_eq!(size_found(flights, 0.0, 0.965), None, "{flights} flights");
            assert_eq!(size_found(flights, 0.0, 1.035), None, "{flights} flights");
        }
        for (larger, moved) in [(0.1, 1.0), (-0.1, 1.0), (0.1, 0.965), (-0.1, 0.965)] {
            let found = size_found(4, larger, moved);
            assert!(
                found.is_some_and(|it| (it.value - larger).abs() < 0.05),
                "{larger}: {found:?}"
            );
        }
    }

    #[test]
    fn a_mount_error_needs_more_evidence_while_the_vehicle_leans_into_a_strong_wind() {
        for (lean_rad, off_rad, is_reported) in
            [(0.0, 0.035, true), (0.28, 0.035, true), (0.4, 0.035, false), (0.4, 0.06, true)]
        {
            let mut check = MountCheck::default();
            descend_leaning(&mut check, 0.0, Rotation::identity(), off_rad, lean_rad);
            let found = check.findings().pitch_rad;
            assert_eq!(found.is_some(), is_reported, "{lean_rad}: {found:?} {:?}", check.errors());
        }
    }

    #[test]
    fn an_error_found_in_calm_air_stays_found_in_a_strong_wind() {
        let mut check = MountCheck::default();
        let mount = Rotation::identity();
        descend(&mut check, 0.0, mount, 0.035);
        assert!(check.findings().pitch_rad.is_some());
        descend_leaning(&mut check, 10.0, mount, 0.035, 0.6);
        assert!(check.findings().pitch_rad.is_some(), "{:?}", check.errors());
    }

    #[test]
    fn another_mount_is_measured_from_the_start() {
        let mut check = MountCheck::default();
        let mount = Rotation::identity();
        descend(&mut check, 0.0, mount, 0.05);
        let found = check.findings().pitch_rad.unwrap();
        assert!((found.value - 0.05).abs() < 0.01, "{found:?}");
        descend(&mut check, 20.0, Rotation::from_euler(0.0, 0.05, 0.0), 0.0);
        assert_eq!(check.findings(), MountFindings::default());
    }

    #[test]
    fn numbers_that_are_not_finite_are_forgotten() {
        let mut check = MountCheck::default();
        let mount = Rotation::identity();
        for (i, wild) in
            [1e300, f64::INFINITY, f64::NAN, -1e300].into_iter().cycle().take(40).enumerate()
        {
            let position = Point::new(0.0, 0.0, -8.0);
            let motion = Motion::still(Rotation::identity(), position);
            let frame = frame(0.01 * i as f64, mount);
            let seen = Measurement {
                stamp: frame.stamp,
                position: nalgebra::Vector3::new(wild, 1.0, if i % 3 == 0 { wild } else { 0.0 }),
                range_m: 8.0,
                noise: nalgebra::Matrix3::identity(),
                tilt: nalgebra::Matrix3::zeros(),
                slip: nalgebra::Vector3::zeros(),
            };
            check.add(&frame, &motion, &seen);
        }
        descend(&mut check, 10.0, mount, 0.05);
        let found = check.findings().pitch_rad.unwrap();
        assert!((found.value - 0.05).abs() < 0.01, "{found:?}");
    }
}
