//! Compares two hypotheses of the pad's position: the estimate, and a competing position at which outliers agree.
//!
//! Detections of one position alone do not decide between the two, because the other may just be out of view:
//! low over the ground, or while the vehicle tilts into the wind. So support is the fraction of the frames
//! showing a position in which the marker was there, and a position out of view retains its support for a while. The
//! competing position becomes the estimate, and the estimate the competing position, once its fraction is clearly
//! larger over a long enough time. A pad that is moved is found again within seconds where its old position is
//! in view, and a second marker is not accepted just because the first is out of view. An estimate with few
//! detections is replaced at once. While the marker is elsewhere in most of the frames that show the
//! estimate's position, the estimate is ambiguous, and the vehicle does not descend.

use geometry::{Odometry, Point};
use libm::{exp, fmax, fmin};
use nalgebra::Vector3;

use crate::config::{EstimatorConfig, MAX_COUNTED_DETECTIONS};
use crate::event::FrameObservation;
use crate::history::Motion;
use crate::measurement::Measurement;
use crate::time::Timestamp;
use crate::view::View;

/// Time constant with which frames that show the position are forgotten, in seconds.
const SHOWN_S: f64 = 2.0;

/// Time constant with which a position out of view loses its support, in seconds.
const UNSHOWN_S: f64 = 6.0;

/// Longest interval between two frames that is counted, in seconds.
const MAX_GAP_S: f64 = 0.2;

/// Difference of the fractions from which one hypothesis is clearly better than the other.
const MAJORITY: f64 = 0.2;

/// Gate for associating an outlier with the competing hypothesis, in metres, in addition to both
/// uncertainties.
const ASSOCIATION_GATE_M: f64 = 0.15;

/// A competing hypothesis with fewer detections than this is replaced by the next outlier.
const MIN_DETECTIONS: f64 = 0.5;

/// The estimate is ambiguous when the competing hypothesis has this many detections and the estimate's fraction
/// is below the second number.
const AMBIGUOUS_DETECTIONS: f64 = 2.5;
const AMBIGUOUS_FRACTION: f64 = 0.5;

/// Which hypothesis a frame's marker supports.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) enum Supported {
    Estimate,
    Competitor,
}

/// The frames that support one hypothesis, older ones with less weight.
#[derive(Copy, Clone, Debug, PartialEq)]
struct HypothesisSupport {
    /// Frames showing the position with the marker there, and all frames showing the position.
    seen: f64,
    shown: f64,
    /// All detections there, including those at the image's edge.
    detections: f64,
    /// Fraction of the support that is left after a time out of view.
    trust: f64,
    newest: Timestamp,
}

/// A position at which outliers agree.
#[derive(Copy, Clone, Debug)]
struct Hypothesis {
    newest: Measurement,
    since: Timestamp,
    support: HypothesisSupport,
}

/// The estimate's support, and the competing hypothesis.
#[derive(Clone, Debug, Default)]
pub(crate) struct Hypotheses {
    /// `None` before the first detection.
    estimate: Option<HypothesisSupport>,
    competitor: Option<Hypothesis>,
    /// The camera's field of view, once it is known.
    view: Option<View>,
}

impl Hypotheses {
    /// Takes the field of view from a frame.
    pub(crate) fn set_view(&mut self, frame: &FrameObservation) {
        self.view = View::from_frame(frame).or(self.view);
    }

    /// Starts again with an estimate from one detection.
    pub(crate) fn restart(&mut self, stamp: Timestamp) {
        self.estimate = Some(HypothesisSupport::new(stamp));
        self.competitor = None;
    }

    /// Counts a frame for both hypotheses; `estimate` is the estimated position at its stamp.
    pub(crate) fn count(
        &mut self,
        stamp: Timestamp,
        motion: &Motion,
        estimate: Option<Point<Odometry>>,
        supported: Option<Supported>,
    ) {
        let view = self.view;
        let is_shown =
            |position: Point<Odometry>| view.is_none_or(|view| view.shows(position, motion));
        if let (Some(support), Some(position)) = (&mut self.estimate, estimate) {
            support.count(stamp, is_shown(position), supported == Some(Supported::Estimate));
        }
        if let Some(competitor) = &mut self.competitor {
            let position = point(competitor.newest.position);
            let is_seen = supported == Some(Supported::Competitor);
            competitor.support.count(stamp, is_shown(position), is_seen);
        }
    }

    /// Counts an outlier: for the competing hypothesis it agrees with, or as a new one where the old has
    /// little support.
    pub(crate) fn count_outlier(
        &mut self,
        config: &EstimatorConfig,
        outlier: &Measurement,
        motion: &Motion,
        estimate: Option<Point<Odometry>>,
    ) {
        let agrees =
            self.competitor.is_some_and(|it| is_same_position(config, outlier, &it.newest));
        self.count(outlier.stamp, motion, estimate, agrees.then_some(Supported::Competitor));
        match &mut self.competitor {
            Some(competitor) if agrees => {
                if outlier.stamp > competitor.newest.stamp {
                    competitor.newest = *outlier;
                }
            }
            Some(competitor) if competitor.support.detections >= MIN_DETECTIONS => {}
            _ => {
                self.competitor = Some(Hypothesis {
                    newest: *outlier,
                    since: outlier.stamp,
                    support: HypothesisSupport::new(outlier.stamp),
                });
            }
        }
    }

    /// True while it is undecided which of two positions is the pad.
    pub(crate) fn is_ambiguous(&self) -> bool {
        self.competitor.is_some_and(|it| it.support.detections >= AMBIGUOUS_DETECTIONS)
            && self.estimate.is_some_and(|support| support.fraction() < AMBIGUOUS_FRACTION)
    }

    /// Swaps the hypotheses when the competing one is clearly better; returns the measurement from which the
    /// estimate starts again. `detections` and `newest` are those of the present estimate.
    pub(crate) fn resolve(
        &mut self,
        config: &EstimatorConfig,
        now: Timestamp,
        detections: u32,
        newest: Option<Measurement>,
    ) -> Option<Measurement> {
        let (support, competitor) = (self.estimate?, self.competitor?);
        let lasted_s = now.seconds_since(competitor.since);
        let is_young = detections < config.restart_after;
        let is_enough = self.is_ambiguous()
            || competitor.support.detections >= f64::from(config.restart_after) - 1.0;
        let yields = is_enough
            && (is_young || lasted_s >= config.restart_s)
            && competitor.support.beats(&support);
        if !yields {
            return None;
        }
        self.estimate = Some(competitor.support);
        self.competitor = newest.map(|newest| Hypothesis { newest, since: newest.stamp, support });
        Some(competitor.newest)
    }
}

impl HypothesisSupport {
    /// A position seen in one frame.
    fn new(stamp: Timestamp) -> Self {
        Self { seen: 1.0, shown: 1.0, detections: 1.0, trust: 1.0, newest: stamp }
    }

    /// Counts a frame. A detection at the image's edge, where the marker is found by chance, only keeps the
    /// trust.
    fn count(&mut self, stamp: Timestamp, is_shown: bool, is_seen: bool) {
        let gap_s = stamp.seconds_since(self.newest).clamp(0.0, MAX_GAP_S);
        self.newest = self.newest.max(stamp);
        let unshown = exp(-gap_s / UNSHOWN_S);
        self.detections = if is_seen {
            fmin(self.detections + 1.0, f64::from(MAX_COUNTED_DETECTIONS))
        } else {
            self.detections * unshown
        };
        if !is_shown {
            self.trust = if is_seen { 1.0 } else { self.trust * unshown };
            return;
        }
        let kept = exp(-gap_s / SHOWN_S);
        self.shown = self.shown * kept + 1.0;
        self.seen = self.seen * kept + f64::from(u8::from(is_seen));
        self.trust = 1.0;
    }

    /// Fraction of the frames showing the position in which the marker was there, from 0 to 1.
    fn fraction(&self) -> f64 {
        self.trust * self.seen / fmax(self.shown, 1.0)
    }

    /// True when the marker is clearly more often here than at the other position.
    fn beats(&self, other: &Self) -> bool {
        self.fraction() > other.fraction() + MAJORITY
    }
}

fn is_same_position(config: &EstimatorConfig, one: &Measurement, other: &Measurement) -> bool {
    let gap_s = one.stamp.seconds_since(other.stamp).abs();
    let reach_m = ASSOCIATION_GATE_M
        + 3.0 * (one.noise.trace() + other.noise.trace()).sqrt()
        + (config.pad_speed_m_s + config.drift_m_s) * gap_s;
    gap_s <= config.forget_after_s && (one.position - other.position).norm() <= reach_m
}

fn point(position: Vector3<f64>) -> Point<Odometry> {
    Point::new(position.x, position.y, position.z)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counted(frames: u32, shown: bool, seen: impl Fn(u32) -> bool) -> HypothesisSupport {
        let mut support = HypothesisSupport::new(Timestamp::default());
        for i in 1..=frames {
            support.count(Timestamp::from_seconds(f64::from(i) / 15.0), shown, seen(i));
        }
        support
    }

    #[test]
    fn the_fraction_is_that_of_the_frames_that_show_the_position() {
        let third = counted(150, true, |i| i % 3 == 0);
        let rest = counted(150, true, |i| i % 3 != 0);
        assert!((third.fraction() - 0.33).abs() < 0.05 && (rest.fraction() - 0.67).abs() < 0.05);
        assert!(rest.beats(&third) && !third.beats(&rest));
    }

    #[test]
    fn a_position_out_of_view_keeps_its_support_for_seconds() {
        let mut pad = counted(60, true, |_| true);
        let mut other = HypothesisSupport::new(Timestamp::from_seconds(4.0));
        for i in 0..60 {
            let stamp = Timestamp::from_seconds(4.0 + f64::from(i) / 15.0);
            pad.count(stamp, false, false);
            other.count(stamp, true, i % 3 == 0);
        }
        assert!(pad.fraction() > 0.5 && !other.beats(&pad), "{pad:?}");
    }

    #[test]
    fn a_position_seen_for_minutes_is_forgotten_as_soon_as_one_seen_for_seconds() {
        let left_after_s = |frames: u32| {
            let mut position = counted(frames, true, |_| true);
            let start_s = f64::from(frames) / 15.0;
            for i in 0..15 * 30 {
                let stamp = Timestamp::from_seconds(start_s + f64::from(i) / 15.0);
                position.count(stamp, true, false);
            }
            position.detections
        };
        assert!((left_after_s(15 * 600) - left_after_s(15 * 3)).abs() < 1e-6);
        assert!(left_after_s(15 * 600) < 0.5, "{}", left_after_s(15 * 600));
    }
}
