//! How good answers are: recall, wrong ids, false detections, errors of centre and range, and whether the stated
//! covariances are true.

use serde::Serialize;

use crate::record::{Found, Record};
use crate::store::{Frame, MarkerLine};

/// What came of some frames.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Score {
    /// Frames with the marker.
    pub frames: usize,
    /// Frames in which it was found.
    pub found: usize,
    /// Detections at the marker with another id.
    pub wrong_ids: usize,
    /// Detections where there is no marker.
    pub elsewhere: usize,
    /// Distances of the centres, in pixels.
    pub centre_px: Vec<f64>,
    /// Mean distances of the corners, in pixels.
    pub corner_px: Vec<f64>,
    /// Errors of the distance along the axis, in metres: estimate less truth.
    pub range_m: Vec<f64>,
    /// The same as parts of the distance.
    pub range_part: Vec<f64>,
    /// Squared centre errors in units of their covariance; 2 on average when it is true.
    pub centre_chi2: Vec<f64>,
    /// Squared range errors in units of their variance; 1 on average when it is true.
    pub range_chi2: Vec<f64>,
    /// Processor times, in milliseconds.
    pub ms: Vec<f64>,
    /// Frames in which the marker was not found.
    pub missed: Vec<String>,
    /// Frames with a wrong id or a detection elsewhere.
    pub false_in: Vec<String>,
}

/// A detection whose centre is farther from the marker's than so many pixels, and than this part of its size, is of
/// something else.
const ELSEWHERE_PX: f64 = 3.0;
const ELSEWHERE_PART: f64 = 0.1;

impl Score {
    /// Of some frames and answers.
    pub fn of<'a>(answers: impl IntoIterator<Item = &'a (Frame, Record)>) -> Self {
        let mut score = Self::default();
        for (frame, record) in answers {
            score.note(frame, record);
        }
        score
    }

    fn note(&mut self, frame: &Frame, record: &Record) {
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
            let is_there = error_px < ELSEWHERE_PX.max(ELSEWHERE_PART * truth.size_px);
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
        if let Some(covariance_px2) = found.covariance_px2 {
            let off_px = [0, 1].map(|i| found.centre_px[i] - truth.centre_px[i]);
            self.centre_chi2.push(normalised(off_px, covariance_px2));
        }
        if let Some(corners) = found.corners_px {
            // Which corner is the first differs between libraries.
            let turned = |turn: usize| {
                (0..4).map(|k| distance(corners[(k + turn) % 4], truth.corners_px[k])).sum::<f64>()
                    / 4.0
            };
            self.corner_px.push((0..4).map(turned).fold(f64::INFINITY, f64::min));
        }
        if let Some(place) = found.translation_m {
            let error_m = place[2] - truth.translation_m[2];
            self.range_m.push(error_m);
            self.range_part.push(error_m / truth.translation_m[2]);
            if let Some(variance) = found.range_variance_m2 {
                self.range_chi2.push(error_m * error_m / variance);
            }
        }
    }

    /// The numbers of a table.
    pub fn summary(&self) -> Summary {
        let absolute: Vec<f64> = self.range_part.iter().map(|part| part.abs()).collect();
        Summary {
            frames: self.frames,
            found: self.found,
            wrong_ids: self.wrong_ids,
            elsewhere: self.elsewhere,
            centre_median_px: quantile(&self.centre_px, 0.5),
            centre_p95_px: quantile(&self.centre_px, 0.95),
            centre_worst_px: quantile(&self.centre_px, 1.0),
            corner_median_px: quantile(&self.corner_px, 0.5),
            range_median_percent: quantile(&absolute, 0.5).map(|part| 100.0 * part),
            range_p95_percent: quantile(&absolute, 0.95).map(|part| 100.0 * part),
            range_bias_percent: mean(&self.range_part).map(|part| 100.0 * part),
            range_bias_mm: mean(&self.range_m).map(|m| 1e3 * m),
            centre_chi2: quantile(&self.centre_chi2, 0.5),
            range_chi2: quantile(&self.range_chi2, 0.5),
            ms: quantile(&self.ms, 0.5),
            ms_p95: quantile(&self.ms, 0.95),
        }
    }
}

/// The numbers of a table; none where there are no values.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// Frames.
    pub frames: usize,
    /// Frames in which the marker was found.
    pub found: usize,
    /// Detections at the marker with another id.
    pub wrong_ids: usize,
    /// Detections where there is no marker.
    pub elsewhere: usize,
    /// Median distance of the centre.
    pub centre_median_px: Option<f64>,
    /// 95th percentile of it.
    pub centre_p95_px: Option<f64>,
    /// The largest of all.
    pub centre_worst_px: Option<f64>,
    /// Median of the corners' mean distance.
    pub corner_median_px: Option<f64>,
    /// Median of the absolute error of the range.
    pub range_median_percent: Option<f64>,
    /// 95th percentile of it.
    pub range_p95_percent: Option<f64>,
    /// Mean error of the range.
    pub range_bias_percent: Option<f64>,
    /// Mean error of the range.
    pub range_bias_mm: Option<f64>,
    /// Median of the normalised squared error of the centre: 1.39 when the covariance is true.
    pub centre_chi2: Option<f64>,
    /// Median of the normalised squared error of the range: 0.45 when the covariance is true.
    pub range_chi2: Option<f64>,
    /// Median processor time in milliseconds.
    pub ms: Option<f64>,
    /// 95th percentile of it.
    pub ms_p95: Option<f64>,
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// The square of an error x, y in units of its covariance xx, xy, yy.
pub fn normalised([x, y]: [f64; 2], [xx, xy, yy]: [f64; 3]) -> f64 {
    (yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
}

/// The mean; none of no values.
pub fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// The standard deviation of a sample; none of fewer than two values.
pub fn deviation(values: &[f64]) -> Option<f64> {
    let mean = mean(values)?;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    (values.len() > 1).then(|| (squares / (values.len() - 1) as f64).sqrt())
}

/// The value below which a part of all values lies; none of no values.
pub fn quantile(values: &[f64], part: f64) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let place = part * sorted.len().saturating_sub(1) as f64;
    let (low, high) = (sorted.get(place.floor() as usize)?, sorted.get(place.ceil() as usize)?);
    Some(low + (high - low) * place.fract())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_interpolated() {
        assert_eq!(quantile(&[3.0, 1.0, 2.0], 0.5), Some(2.0));
        assert_eq!(quantile(&[1.0, 2.0], 0.5), Some(1.5));
        assert_eq!(quantile(&[], 0.5), None);
        assert_eq!(deviation(&[1.0, 3.0]), Some(2f64.sqrt()));
    }
}
