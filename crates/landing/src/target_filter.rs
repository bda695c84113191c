//! Tracks the target of a landing by the filter of its guidance (the estimator, or the mean of the thesis'), and the stamps of
//! the markers that were used or refused.

use geometry::{Ned, Point};

use crate::config::{Config, GuidanceConfig};
use crate::decision::{Rejection, TargetEstimate};
use crate::estimator::Estimator;
use crate::event::{FrameObservation, MarkerInFrame};
use crate::history::History;
use crate::mean_target::MeanTarget;
use crate::scatter::ScatterExcess;
use crate::time::Timestamp;

/// The estimate of the landing point, by the filter that the guidance needs.
#[derive(Clone, Debug)]
#[expect(clippy::large_enum_variant, reason = "one instance; nothing may be allocated in flight")]
pub(crate) enum TargetFilter {
    Mean(MeanTarget),
    Kalman(Estimator),
}

/// Maximum time for which a marker is not missed while its position is out of the camera's view, in seconds, and maximum time
/// between two frames for which that is known.
const MAX_OUT_OF_VIEW_S: f64 = 2.0;
const MAX_FRAME_GAP_S: f64 = 0.2;

/// The stamps of the markers used.
#[derive(Copy, Clone, Debug, Default)]
pub(crate) struct Sightings {
    pub(crate) newest: Option<Timestamp>,
    /// Number of markers without a long gap.
    pub(crate) in_a_row: u32,
    /// For how long since then the camera did not show the pad's position, in seconds.
    out_of_view_s: f64,
    /// When one was last seen too far from the estimate to be used, and when before that.
    refused: [Option<Timestamp>; 2],
}

impl TargetFilter {
    pub(crate) fn new(config: &Config) -> Self {
        match config.guidance {
            GuidanceConfig::Thesis(_) => Self::Mean(MeanTarget::new(config.target)),
            GuidanceConfig::Metric(_) => Self::Kalman(Estimator::new(config.estimator)),
        }
    }

    pub(crate) fn takes_late_frames(&self) -> bool {
        matches!(self, Self::Kalman(_))
    }

    pub(crate) fn miss(&mut self, frame: &FrameObservation, history: &History) {
        if let Self::Kalman(estimator) = self {
            estimator.miss(frame, history);
        }
    }

    pub(crate) fn observe(
        &mut self,
        frame: &FrameObservation,
        marker: &MarkerInFrame,
        history: &History,
    ) -> Result<(), Rejection> {
        match self {
            Self::Mean(target) => target.observe(frame, marker, history),
            Self::Kalman(estimator) => estimator.observe(frame, marker, history),
        }
    }

    /// By how much more than their covariance states detections scatter; unknown to the mean, which uses none.
    pub(crate) fn scatter(&self) -> Option<ScatterExcess> {
        match self {
            Self::Mean(_) => None,
            Self::Kalman(estimator) => estimator.scatter(),
        }
    }

    /// Stores the estimate, for the case that the next detections are to be forgotten.
    pub(crate) fn keep(&mut self) {
        if let Self::Kalman(estimator) = self {
            estimator.keep();
        }
    }

    /// Goes back to the estimate that was kept.
    pub(crate) fn go_back(&mut self) {
        if let Self::Kalman(estimator) = self {
            estimator.go_back();
        }
    }

    /// The landing point at a time, seen from the vehicle.
    pub(crate) fn estimate(
        &self,
        vehicle: Point<Ned>,
        history: &History,
        now: Timestamp,
    ) -> Option<TargetEstimate> {
        match self {
            Self::Mean(target) => target.estimate(vehicle, now),
            Self::Kalman(estimator) => {
                estimator.estimate(vehicle, history.ned_from_odometry(), now)
            }
        }
    }
}

impl Sightings {
    pub(crate) fn add(&mut self, stamp: Timestamp, max_gap_s: f64) {
        let gap_s = self.age_s(stamp);
        if gap_s < 0.0 {
            return;
        }
        self.in_a_row = if gap_s > max_gap_s { 1 } else { self.in_a_row.saturating_add(1) };
        self.newest = Some(stamp);
        self.out_of_view_s = 0.0;
    }

    /// Forgets that markers of later frames than this were seen.
    pub(crate) fn forget_since(&mut self, stamp: Timestamp) {
        self.newest = self.newest.map(|newest| newest.min(stamp));
    }

    /// Notes a marker that was refused; frames may come late and twice.
    pub(crate) fn refuse(&mut self, stamp: Timestamp, why: Rejection) {
        let stamp = Some(stamp);
        if why != Rejection::Outlier || self.refused.contains(&stamp) {
            return;
        }
        let [newest, before] = self.refused;
        self.refused = if stamp > newest { [stamp, newest] } else { [newest, before.max(stamp)] };
    }

    /// True while the marker is seen, too far from the estimate to be used. A single outlier may be something else.
    pub(crate) fn is_refused(&self, now: Timestamp, max_age_s: f64) -> bool {
        let [Some(newest), Some(before)] = self.refused else { return false };
        let is_recent =
            now.seconds_since(newest) <= max_age_s && newest.seconds_since(before) <= max_age_s;
        is_recent && self.newest.is_none_or(|used| before > used)
    }

    /// Notes a frame without a marker whose camera did not show the pad's position, and the time since the frame before it.
    pub(crate) fn miss_out_of_view(&mut self, after_s: f64) {
        let out_of_view_s = self.out_of_view_s + after_s.clamp(0.0, MAX_FRAME_GAP_S);
        self.out_of_view_s = libm::fmin(out_of_view_s, MAX_OUT_OF_VIEW_S);
    }

    /// For how long the marker was not seen, without the time for which its position was out of view, in seconds.
    pub(crate) fn missed_s(&self, now: Timestamp) -> f64 {
        self.age_s(now) - self.out_of_view_s
    }

    pub(crate) fn age_s(&self, now: Timestamp) -> f64 {
        self.newest.map_or(f64::INFINITY, |newest| now.seconds_since(newest))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: f64) -> Timestamp {
        Timestamp::from_seconds(seconds)
    }

    /// Markers refused at these times, after one that was used at 1 s; whether that is a marker that is refused, at 2 s.
    fn is_refused(stamps: &[f64]) -> bool {
        let mut sightings = Sightings::default();
        sightings.add(at(1.0), 1.0);
        stamps.iter().for_each(|stamp| sightings.refuse(at(*stamp), Rejection::Outlier));
        sightings.is_refused(at(2.0), 0.4)
    }

    #[test]
    fn two_outliers_after_the_last_marker_used_are_a_marker_that_is_refused() {
        assert!(is_refused(&[1.8, 1.9]));
        assert!(is_refused(&[1.7, 1.9, 1.5, 1.2]), "late frames change nothing");
        assert!(is_refused(&[1.9, 1.7]), "nor does their order");
        assert!(!is_refused(&[1.9]), "one");
        assert!(!is_refused(&[1.9, 1.9]), "one frame twice");
        assert!(!is_refused(&[1.2, 1.9]), "one, and one of long ago");
        assert!(!is_refused(&[1.3, 1.4]), "long ago");
        assert!(!Sightings::default().is_refused(at(0.0), 0.4));
    }

    #[test]
    fn a_marker_used_since_or_refused_for_another_reason_is_not_refused() {
        let mut sightings = Sightings::default();
        for stamp in [1.8, 1.9] {
            sightings.refuse(at(stamp), Rejection::LowConfidence);
        }
        assert!(!sightings.is_refused(at(2.0), 0.4));
        for stamp in [1.8, 1.9] {
            sightings.refuse(at(stamp), Rejection::Outlier);
        }
        assert!(sightings.is_refused(at(2.0), 0.4));
        sightings.add(at(1.85), 1.0);
        assert!(!sightings.is_refused(at(2.0), 0.4));
    }

    #[test]
    fn a_marker_whose_position_is_out_of_view_is_not_missed_for_a_while() {
        let mut sightings = Sightings::default();
        assert!(sightings.missed_s(at(3.0)).is_infinite());
        sightings.miss_out_of_view(0.1);
        sightings.add(at(1.0), 1.0);
        assert!((sightings.missed_s(at(3.0)) - 2.0).abs() < 1e-9, "before the newest");
        (0..5).for_each(|_| sightings.miss_out_of_view(0.1));
        assert!((sightings.missed_s(at(3.0)) - 1.5).abs() < 1e-9, "seconds in between are not");
        sightings.miss_out_of_view(1.0);
        assert!((sightings.missed_s(at(3.0)) - 1.3).abs() < 1e-9, "without frames");
        (0..50).for_each(|_| sightings.miss_out_of_view(0.1));
        assert!((sightings.missed_s(at(9.0)) - 6.0).abs() < 1e-9, "no longer than a while");
        sightings.add(at(9.1), 1.0);
        assert!((sightings.missed_s(at(9.5)) - 0.4).abs() < 1e-9);
    }
}
