//! Checks camera and marker before and during the descent: whether the axes of camera and autopilot agree, and whether
//! the marker is as large as configured.

use super::Lander;
use crate::axis_check::{AxisConsistencyCheck, AxisError, Verdict};
use crate::config::GuidanceConfig;
use crate::decision::Reason;
use crate::scatter::ScatterExcess;
use crate::time::Timestamp;

impl Lander {
    /// The evidence that camera or marker are not as configured, once that is certain: the vehicle may not descend.
    pub fn mismatch(&self) -> Option<Reason> {
        let size = self.size_check.is_refused().then_some(Reason::MarkerSize);
        self.axis_mismatch().or(size)
    }

    /// How many times as large as configured the marker is, once that is certain and far from one.
    pub fn marker_size_ratio(&self) -> Option<f64> {
        self.size_check.ratio()
    }

    /// By how much more than their stated covariance the detections scatter, once that is certain.
    pub fn scatter_excess(&self) -> Option<ScatterExcess> {
        self.target_filter.scatter()
    }

    /// Repeats the checks of a vehicle that holds because of a mismatch, when the operator resumes the landing.
    pub fn repeat_checks(&mut self) {
        if self.axis_mismatch().is_some() {
            self.axis_check = AxisConsistencyCheck::default();
            self.first_seen = None;
        }
        self.repeat_size_check();
    }

    /// Repeats the size check after a landing that it has ended. Detections before a landing, as in a take-off over the pad,
    /// counts in that.
    pub(super) fn repeat_size_check(&mut self) {
        if self.size_check.is_refused() {
            self.size_check.look_again();
        }
    }

    /// Restarts the axis check for a landing that has just started.
    pub(super) fn begin_checks(&mut self) {
        if self.axis_mismatch().is_some() {
            self.axis_check = AxisConsistencyCheck::default();
        }
        self.first_seen = None;
    }

    /// A moving pad gives no information about the mount, and the thesis' guidance has no such check.
    fn checks_axes(&self) -> bool {
        let is_metric = matches!(self.config.guidance, GuidanceConfig::Metric(_));
        is_metric
            && self.config.phases.axis_check_s > 0.0
            && self.config.estimator.pad_speed_m_s == 0.0
    }

    /// How the axes of camera and autopilot differ.
    fn axis_mismatch(&self) -> Option<Reason> {
        match self.axis_check.verdict() {
            Verdict::Mismatch(error) if self.checks_axes() => Some(match error {
                AxisError::Turned(_) => Reason::CameraTurned,
                AxisError::Mirrored(_) => Reason::ImageMirrored,
                AxisError::RollSign | AxisError::PitchSign => Reason::AttitudeSign,
            }),
            _ => None,
        }
    }

    /// True once the axes are consistent, or the time allowed for the check is over.
    pub(super) fn is_axis_check_done(&self, now: Timestamp) -> bool {
        let waited_s = self.first_seen.map_or(0.0, |seen| now.seconds_since(seen));
        let is_over = waited_s > self.config.phases.axis_check_s;
        !self.checks_axes() || is_over || self.axis_check.verdict() == Verdict::Consistent
    }
}
