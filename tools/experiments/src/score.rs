//! Scores results: recall, wrong ids, false detections, errors of centre and range, consistency of the
//! covariances.

use node::stats::{interpolated_quantile as quantile, mean};
use serde::Serialize;

use crate::landing::table::percentile;
use crate::record::{Found, Record};
use crate::store::{MarkerLine, StoredFrame};

/// The score of some frames.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Score {
    /// Frames with the marker.
    pub frames: usize,
    /// Frames in which it was detected.
    pub found: usize,
    /// Detections at the marker with another id.
    pub wrong_ids: usize,
    /// Detections elsewhere.
    pub elsewhere: usize,
    /// Centre errors, in pixels.
    pub centre_px: Vec<f64>,
    /// Mean corner errors, in pixels.
    pub corner_px: Vec<f64>,
    /// Errors of the distance along the optical axis, in metres: estimate minus truth.
    pub range_m: Vec<f64>,
    /// The same relative to the distance.
    pub range_ratio: Vec<f64>,
    /// Normalised squared centre errors (NEES); mean 2 for a consistent covariance.
    pub centre_chi2: Vec<f64>,
    /// Normalised squared range errors; mean 1 for a consistent variance.
    pub range_chi2: Vec<f64>,
    /// Processor times, in milliseconds.
    pub ms: Vec<f64>,
    /// Frames in which the marker was missed.
    pub missed: Vec<String>,
    /// Frames with a wrong id or a detection elsewhere.
    pub false_in: Vec<String>,
}

/// A detection is elsewhere if its centre is off by more than this many pixels and by more than this fraction
/// of the marker's size.
const ELSEWHERE_PX: f64 = 3.0;
const ELSEWHERE_RATIO: f64 = 0.1;

/// Normalised squared errors below which 99 % are: quantiles of chi square with two degrees of freedom and with one.
const CENTRE_BOUND_99: f64 = 9.210;
const RANGE_BOUND_99: f64 = 6.635;

impl Score {
    /// The score of frames with their results.
    pub fn new<'a>(answers: impl IntoIterator<Item = &'a (StoredFrame, Record)>) -> Self {
        let mut score = Self::default();
        for (frame, record) in answers {
            score.add(frame, record);
        }
        score
    }

    fn add(&mut self, frame: &StoredFrame, record: &Record) {
        self.ms.push(record.ms);
        let Some(truth) = &frame.marker else {
            self.frames += 1;
            if !record.found.is_empty() {
                self.elsewhere += record.found.len();
                self.false_in.push(frame.image.clone());
            }
            return;
        };
        self.frames += 1;
        let (mut is_found, mut is_false) = (false, false);
        for found in &record.found {
            let error_px = distance(found.centre_px, truth.centre_px);
            let is_there = error_px < ELSEWHERE_PX.max(ELSEWHERE_RATIO * truth.size_px);
            let is_same = found.family == truth.family && found.id == truth.id;
            if is_there && is_same && !is_found {
                is_found = true;
                self.found += 1;
                self.measure(found, truth);
            } else if is_there && found.family == truth.family && !is_same {
                self.wrong_ids += 1;
                is_false = true;
            } else {
                self.elsewhere += 1;
                is_false = true;
            }
        }
        if !is_found {
            self.missed.push(frame.image.clone());
        }
        if is_false {
            self.false_in.push(frame.image.clone());
        }
    }

    fn measure(&mut self, found: &Found, truth: &MarkerLine) {
        self.centre_px.push(distance(found.centre_px, truth.centre_px));
        if let Some(covariance_px2) = found.centre_covariance_px2 {
            let off_px = [0, 1].map(|i| found.centre_px[i] - truth.centre_px[i]);
            self.centre_chi2.push(normalised(off_px, covariance_px2));
        }
        if let Some(corners) = found.corners_px {
            // The first corner differs between libraries.
            let turned = |turn: usize| {
                (0..4).map(|k| distance(corners[(k + turn) % 4], truth.corners_px[k])).sum::<f64>()
                    / 4.0
            };
            self.corner_px.push((0..4).map(turned).fold(f64::INFINITY, f64::min));
        }
        if let Some(place) = found.translation_m {
            let error_m = place[2] - truth.translation_m[2];
            self.range_m.push(error_m);
            self.range_ratio.push(error_m / truth.translation_m[2]);
            if let Some(variance) = found.range_variance_m2 {
                self.range_chi2.push(error_m * error_m / variance);
            }
        }
    }

    /// The summary.
    pub fn summary(&self) -> Summary {
        let absolute: Vec<f64> = self.range_ratio.iter().map(|part| part.abs()).collect();
        Summary {
            frames: self.frames,
            found: self.found,
            wrong_ids: self.wrong_ids,
            elsewhere: self.elsewhere,
            centre_median_px: quantile(&self.centre_px, 0.5),
            centre_p95_px: percentile(&self.centre_px, 0.95),
            centre_worst_px: quantile(&self.centre_px, 1.0),
            corner_median_px: quantile(&self.corner_px, 0.5),
            range_median_percent: quantile(&absolute, 0.5).map(|part| 100.0 * part),
            range_p95_percent: percentile(&absolute, 0.95).map(|part| 100.0 * part),
            range_bias_percent: mean(&self.range_ratio).map(|part| 100.0 * part),
            range_bias_mm: mean(&self.range_m).map(|m| 1e3 * m),
            centre_chi2: quantile(&self.centre_chi2, 0.5),
            centre_worst_sigmas: quantile(&self.centre_chi2, 1.0).map(f64::sqrt),
            range_worst_sigmas: quantile(&self.range_chi2, 1.0).map(f64::sqrt),
            range_chi2: quantile(&self.range_chi2, 0.5),
            centre_nees: mean(&self.centre_chi2).map(|squares| squares / 2.0),
            range_nees: mean(&self.range_chi2),
            centre_beyond_99: beyond(&self.centre_chi2, CENTRE_BOUND_99),
            range_beyond_99: beyond(&self.range_chi2, RANGE_BOUND_99),
            ms: quantile(&self.ms, 0.5),
            ms_p95: percentile(&self.ms, 0.95),
        }
    }
}

/// Statistics of a score; `None` without values.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// Frames.
    pub frames: usize,
    /// Frames in which the marker was found.
    pub found: usize,
    /// Detections at the marker with another id.
    pub wrong_ids: usize,
    /// Detections elsewhere.
    pub elsewhere: usize,
    /// Median centre error.
    pub centre_median_px: Option<f64>,
    /// 95th percentile of it.
    pub centre_p95_px: Option<f64>,
    /// Largest centre error.
    pub centre_worst_px: Option<f64>,
    /// Median corner error.
    pub corner_median_px: Option<f64>,
    /// Median of the absolute error of the range.
    pub range_median_percent: Option<f64>,
    /// 95th percentile of it.
    pub range_p95_percent: Option<f64>,
    /// Mean error of the range.
    pub range_bias_percent: Option<f64>,
    /// Mean error of the range.
    pub range_bias_mm: Option<f64>,
    /// Median normalised squared centre error: 1.39 for a consistent covariance.
    pub centre_chi2: Option<f64>,
    /// Largest centre error over its standard deviation.
    pub centre_worst_sigmas: Option<f64>,
    /// Largest range error over its standard deviation.
    pub range_worst_sigmas: Option<f64>,
    /// Median normalised squared range error: 0.45 for a consistent variance.
    pub range_chi2: Option<f64>,
    /// Mean normalised squared centre error over its expectation: 1 for a consistent covariance.
    pub centre_nees: Option<f64>,
    /// The same of the range.
    pub range_nees: Option<f64>,
    /// Number of centres with an error beyond its 99 % bound; one in a hundred for a consistent covariance.
    pub centre_beyond_99: usize,
    /// The same of the range.
    pub range_beyond_99: usize,
    /// Median processor time in milliseconds.
    pub ms: Option<f64>,
    /// 95th percentile of it.
    pub ms_p95: Option<f64>,
}

fn beyond(normalised: &[f64], bound: f64) -> usize {
    normalised.iter().filter(|square| **square > bound).count()
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// The squared Mahalanobis length of an error x, y with covariance xx, xy, yy.
pub fn normalised([x, y]: [f64; 2], [xx, xy, yy]: [f64; 3]) -> f64 {
    (yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn single_errors_far_beyond_their_deviation_count_in_the_mean_and_beyond_the_bound() {
        let mut score = Score::default();
        score.range_chi2.extend([0.2, 0.4, 0.4, 7.0]);
        score.centre_chi2.extend([1.0, 1.4, 2.0, 9.2]);
        let summary = score.summary();
        assert_eq!([summary.range_chi2, summary.range_nees], [Some(0.4), Some(2.0)]);
        assert_eq!([summary.centre_chi2, summary.centre_nees], [Some(1.7), Some(1.7)]);
        assert_eq!([summary.range_beyond_99, summary.centre_beyond_99], [1, 0]);
    }
}
