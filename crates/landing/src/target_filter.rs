//! The estimate of the landing point by the filter that the guidance needs, and how often the marker was seen.

use geometry::{Ned, Point};

use crate::config::{Config, GuidanceConfig};
use crate::decision::{Rejection, TargetEstimate};
use crate::estimator::Estimator;
use crate::event::{FrameObservation, MarkerInFrame};
use crate::history::History;
use crate::mean_target::MeanTarget;
use crate::time::Timestamp;

/// The estimate of the landing point, by the filter that the guidance needs.
#[derive(Clone, Debug)]
#[expect(clippy::large_enum_variant, reason = "one instance; nothing may be allocated in flight")]
pub(crate) enum TargetFilter {
    Mean(MeanTarget),
    Kalman(Estimator),
}

/// The stamps of the markers used.
#[derive(Copy, Clone, Debug, Default)]
pub(crate) struct Sightings {
    pub(crate) newest: Option<Timestamp>,
    /// Number of markers without a long gap.
    pub(crate) in_a_row: u32,
    /// When one was seen too far from the estimate to be used.
    refused: Option<Timestamp>,
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
    }

    /// Notes a marker that was refused.
    pub(crate) fn refuse(&mut self, stamp: Timestamp, why: Rejection) {
        if why == Rejection::Outlier {
            self.refused = Some(stamp);
        }
    }

    /// True while the marker is seen, too far from the estimate to be used.
    pub(crate) fn is_refused(&self, now: Timestamp, max_age_s: f64) -> bool {
        self.refused.is_some_and(|stamp| now.seconds_since(stamp) <= max_age_s)
    }

    pub(crate) fn age_s(&self, now: Timestamp) -> f64 {
        self.newest.map_or(f64::INFINITY, |newest| now.seconds_since(newest))
    }
}
