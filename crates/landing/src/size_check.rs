//! Measures in flight whether the marker is as large as configured, from how much nearer it comes as the vehicle goes down.
//!
//! The distance to a marker is taken from its size: under one that is twice as large as configured all distances are half of the true
//! ones. How high the pad lies is not known, so a single distance shows nothing; but where the vehicle goes down by a metre the
//! marker must come nearer by a metre, on a roof as on a field. The slope of the marker's depth below the vehicle over the height that
//! the autopilot reports is the configured over the true size, wherever the vehicle is and however far to the side the pad lies.
//!
//! The slope is that of a line fitted by least squares to the detections of the last seconds, whose weights fade (West: Updating Mean and
//! Variance Estimates, 1979). Heights that do not fit one line, as of a pad that heaves, of two markers in turn, or of an autopilot whose
//! height wanders, make it uncertain.

use geometry::{Body, Camera, Rotation, squared};
use libm::{exp, fabs, fmax, hypot, log};

use crate::config::EstimatorConfig;
use crate::event::{FrameObservation, MarkerInFrame};
use crate::history::Motion;
use crate::measurement::MarkerPose;
use crate::time::Timestamp;

/// Time constant with which detections are forgotten, in seconds, and the longest time between two.
const MEMORY_S: f64 = 10.0;
const MAX_GAP_S: f64 = 5.0;

/// Minimum height over the marker of a detection that is used, as computed from its size, in metres: near the ground a barometer errs in
/// the vehicle's own wind.
const MIN_DEPTH_M: f64 = 0.4;

/// Minimum standard deviation of the heights, in metres, that of a descent of 1.2 m, and the number of detections without which the slope
/// shows nothing.
const MIN_SPREAD_M: f64 = 0.35;
const MIN_DETECTIONS: f64 = 15.0;

/// Slopes beyond which something else than the marker's size is wrong, such as a frozen picture.
const MIN_SLOPE: f64 = 0.03;
const MAX_SLOPE: f64 = 30.0;

/// Factors on the size from which it is reported, and from which the landing stops. A barometer that is 8 % off and follows 8 s late made
/// it seem 1.32 times as large in one of 30 flights to pads on roofs and in hollows, and never more.
const REPORTED: f64 = 1.4;
const REFUSED: f64 = 1.5;
/// Fraction of the logarithm of the first below which it is no longer reported.
const CLEAR_FRACTION: f64 = 0.7;

/// Minimum number of standard deviations by which the slope differs from one, and the number of detections in a row that must show it.
const MIN_DEVIATIONS: f64 = 2.0;
const MIN_IN_A_ROW: u32 = 10;

/// Weight of the fit's residual in the deviation: its errors are alike over seconds.
const RESIDUAL_WEIGHT: f64 = 0.5;
/// Standard deviation of a pad's height by its heave, in metres per m/s of its largest speed, and by the slope of the ground under one that
/// drives, in metres per m/s over the memory.
const HEAVE_S: f64 = 0.5;
const GRADE_S: f64 = 0.1;

/// The check; nothing is allocated.
#[derive(Copy, Clone, Debug, Default)]
pub(crate) struct SizeCheck {
    fit: Fit,
    mount: Option<Rotation<Body, Camera>>,
    reportable_in_a_row: u32,
    refused_in_a_row: u32,
    reported: Option<f64>,
    is_refused: bool,
}

/// A line through depths over heights.
#[derive(Copy, Clone, Debug, Default)]
struct Fit {
    newest: Option<Timestamp>,
    weight: f64,
    height_m: f64,
    depth_m: f64,
    /// Sums of squares and products about the means, in m^2.
    heights: f64,
    products: f64,
    depths: f64,
}

/// The slope of the line and its standard deviation.
#[derive(Copy, Clone, Debug)]
struct Slope {
    value: f64,
    deviation: f64,
}

impl SizeCheck {
    /// Adds a marker as it was seen from a vehicle that moved so.
    pub(crate) fn observe(
        &mut self,
        config: &EstimatorConfig,
        frame: &FrameObservation,
        marker: &MarkerInFrame,
        motion: &Motion,
    ) {
        let Some(pose) = marker.body_from_marker else { return };
        let pose = MarkerPose::resolve(motion, pose, marker.alternative);
        let Ok(seen) = pose.measurement(config, frame, marker, motion) else { return };
        if self.mount != frame.body_from_camera {
            *self = Self { mount: frame.body_from_camera, ..Self::default() };
        }
        let position = motion.odometry.coords.coords;
        let depth_m = seen.position.z - position.z;
        if depth_m >= MIN_DEPTH_M && self.fit.add(frame.stamp, -position.z, depth_m) {
            self.judge(config);
        }
    }

    /// Forgets the detections and retains their result: the vehicle stands, or its height restarts.
    pub(crate) fn interrupt(&mut self) {
        self.fit = Fit::default();
    }

    /// Checks again whether a landing on it is safe; the reported ratio stays until then.
    pub(crate) fn look_again(&mut self) {
        *self = Self { mount: self.mount, reported: self.reported, ..Self::default() };
    }

    /// How many times as large as configured the marker is, once that is certain and far from one.
    pub(crate) fn ratio(&self) -> Option<f64> {
        self.reported
    }

    /// True once it is certainly so far from its configured size that no landing on it is safe.
    pub(crate) fn is_refused(&self) -> bool {
        self.is_refused
    }

    fn judge(&mut self, config: &EstimatorConfig) {
        let Some(slope) = self.fit.slope(config) else {
            (self.reportable_in_a_row, self.refused_in_a_row) = (0, 0);
            return;
        };
        let off = fabs(log(slope.value));
        let is_certain = fabs(slope.value - 1.0) > MIN_DEVIATIONS * slope.deviation;
        let count = |in_a_row: u32, factor: f64| {
            if is_certain && off > log(factor) { in_a_row.saturating_add(1) } else { 0 }
        };
        self.reportable_in_a_row = count(self.reportable_in_a_row, REPORTED);
        self.refused_in_a_row = count(self.refused_in_a_row, REFUSED);
        self.is_refused |= self.refused_in_a_row >= MIN_IN_A_ROW;
        if self.reportable_in_a_row >= MIN_IN_A_ROW {
            self.reported = Some(1.0 / slope.value);
        } else if !self.is_refused && off < CLEAR_FRACTION * log(REPORTED) {
            self.reported = None;
        }
    }
}

impl Fit {
    /// Adds a depth at a height, both in metres; false for one that is older than another.
    fn add(&mut self, stamp: Timestamp, height_m: f64, depth_m: f64) -> bool {
        let after_s = self.newest.map_or(0.0, |newest| stamp.seconds_since(newest));
        if after_s < 0.0 {
            return false;
        }
        if after_s > MAX_GAP_S {
            *self = Self::default();
        }
        self.newest = Some(stamp);
        let keep = exp(-after_s / MEMORY_S);
        self.weight = keep * self.weight + 1.0;
        let (by_height, by_depth) = (height_m - self.height_m, depth_m - self.depth_m);
        self.height_m += by_height / self.weight;
        self.depth_m += by_depth / self.weight;
        let fraction = 1.0 - 1.0 / self.weight;
        self.heights = keep * self.heights + fraction * by_height * by_height;
        self.products = keep * self.products + fraction * by_height * by_depth;
        self.depths = keep * self.depths + fraction * by_depth * by_depth;
        if !(self.heights + self.depths).is_finite() {
            *self = Self::default();
        }
        true
    }

    /// `None` while the heights show none.
    fn slope(&self, config: &EstimatorConfig) -> Option<Slope> {
        if self.weight < MIN_DETECTIONS || self.heights < self.weight * squared(MIN_SPREAD_M) {
            return None;
        }
        let value = self.products / self.heights;
        let residual = fmax(self.depths - self.products * value, 0.0);
        let pad_m = hypot(HEAVE_S * config.pad_heave_m_s, GRADE_S * config.pad_speed_m_s);
        let residual_m = hypot(RESIDUAL_WEIGHT * (residual / self.weight).sqrt(), pad_m);
        let deviation = residual_m / (self.heights / self.weight).sqrt();
        (MIN_SLOPE..=MAX_SLOPE).contains(&value).then_some(Slope { value, deviation })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Depths of a marker while the vehicle goes down from 8 m at 1 m/s for so many metres, 15 a second, after a hover of 3 s.
    fn descend(by_m: f64, depth_m: impl Fn(f64, f64) -> f64) -> SizeCheck {
        let mut check = SizeCheck::default();
        for i in 0..(15.0 * (3.0 + by_m)) as u32 {
            let seconds = f64::from(i) / 15.0;
            let height_m = 8.0 - fmax(seconds - 3.0, 0.0);
            if check.fit.add(Timestamp::from_seconds(seconds), height_m, depth_m(height_m, seconds))
            {
                check.judge(&EstimatorConfig::default());
            }
        }
        check
    }

    #[test]
    fn a_marker_of_another_size_is_reported_after_a_descent_of_two_metres_wherever_the_pad_lies() {
        for size in [0.5, 2.0, 10.0] {
            for roof_m in [-3.0, 0.0, 5.0] {
                let check = descend(2.0, |height_m, _| (height_m - roof_m) / size);
                let ratio = check.ratio().unwrap();
                assert!((ratio / size - 1.0).abs() < 0.01 && check.is_refused(), "{ratio}");
            }
        }
        assert!(!descend(0.8, |height_m, _| height_m / 2.0).is_refused(), "too early");
        let check = descend(3.0, |height_m, _| height_m / 1.45);
        assert!(check.ratio().is_some() && !check.is_refused(), "{check:?}");
    }

    #[test]
    fn a_marker_of_the_right_size_on_a_roof_is_never_reported() {
        for roof_m in [-20.0, -3.0, 0.0, 5.0] {
            for scale in [0.9, 1.0, 1.1] {
                let check = descend(7.0, |height_m, _| scale * (height_m - roof_m));
                assert!(check.ratio().is_none() && !check.is_refused(), "{check:?}");
            }
        }
    }

    #[test]
    fn depths_that_do_not_change_or_jump_show_no_size() {
        let frozen = descend(7.0, |_, _| 6.0);
        assert!(frozen.ratio().is_none(), "{frozen:?}");
        let in_turn = descend(7.0, |height_m, seconds| {
            if ((4.0 * seconds) as u32).is_multiple_of(2) { height_m } else { height_m - 3.0 }
        });
        assert!(!in_turn.is_refused(), "{in_turn:?}");
    }

    #[test]
    fn numbers_that_are_not_finite_are_forgotten() {
        let check = descend(
            4.0,
            |height_m, seconds| {
                if seconds < 0.5 { f64::INFINITY } else { height_m / 2.0 }
            },
        );
        assert!(check.is_refused(), "{check:?}");
    }
}
