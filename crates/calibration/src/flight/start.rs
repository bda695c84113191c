//! Finds a start value: the time offset that explains a flight best, roughly.

use geometry::{Ned, Point};

use super::excitation::Excitation;
use super::filter::{Prior, filtered};
use super::model::{Model, PAD, Parameters};
use super::noise::Noise;
use super::quantity::{OFFSET, Quantity};

/// Offsets that are tried: as far to both sides, in seconds, and how far apart.
const FARTHEST_S: f64 = 8.0;
const APART_S: f64 = 0.1;
/// Smallest part of the detections that must be within the flight with an offset.
const MIN_SHARE: f64 = 0.75;
/// Detections that are used for it.
const MARKERS: usize = 150;

/// By how much another offset than none must be more likely: in logarithms, of all detections that are used.
const MIN_GAIN: f64 = 12.0;

/// Parameters near the minimum; `None` when no detection is in front of the camera.
pub(super) fn parameters(model: &Model<'_>, excitation: &Excitation) -> Option<Parameters> {
    let pad: Point<Ned> = model.first_pad()?;
    let mut begin = Parameters::zeros();
    for (i, coordinate) in pad.coords.iter().enumerate() {
        begin[PAD + i] = *coordinate;
    }
    if !excitation.shows(Quantity::TimeOffset) {
        return Some(begin);
    }
    let prior = Prior::around(&begin);
    let thin = model.thinned(MARKERS);
    let noise = Noise::default();
    let likelihood = |offset_s: f64| {
        let mut parameters = begin;
        parameters[OFFSET] = offset_s;
        let steps = thin.linearised(&parameters);
        let result =
            filtered(&steps, &parameters, &prior.with(Quantity::TimeOffset, offset_s), &noise)?;
        // Much of the flight must be left, or there is nothing to explain.
        let share = steps.len() as f64 / thin.markers().len() as f64;
        (share >= MIN_SHARE).then_some(result.likelihood / share)
    };
    let count = (FARTHEST_S / APART_S) as i32;
    let offsets = (-count..=count).map(|i| APART_S * f64::from(i));
    let tried = offsets.filter_map(|offset_s| Some((likelihood(offset_s)?, offset_s)));
    let best = tried.max_by(|a, b| a.0.total_cmp(&b.0));
    let without = likelihood(0.0);
    if let Some((best, offset_s)) = best
        && without.is_none_or(|without| best > without + MIN_GAIN)
    {
        begin[OFFSET] = offset_s;
    }
    Some(begin)
}
