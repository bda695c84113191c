//! Estimates the size of the errors in a flight by maximum likelihood.

use super::filter::{Prior, filtered};
use super::model::{Linearised, Parameters};
use super::noise::{COUNT, Noise};

/// Deviations of the logarithms around [`Noise::default`]: errors of a third to three times as much are usual.
const USUAL: [f64; COUNT] = [2.0, 2.0, 1.0, 1.5, 1.0, 0.7, 0.7];
/// First and last step of the search, in logarithms, and its longest way.
const FIRST_STEP: f64 = 1.0;
const LAST_STEP: f64 = 0.12;
const MAX_ROUNDS: usize = 30;

/// The sizes that make a flight most likely, beginning at some; a pattern search (Hooke and Jeeves, 1961).
pub(super) fn noise(
    steps: &[Linearised],
    place: &Parameters,
    prior: &Prior,
    begin: Noise,
) -> Noise {
    let usual = Noise::default().logarithms();
    let worth = |logarithms: [f64; COUNT]| {
        let noise = Noise::from_logarithms(logarithms);
        let result = filtered(steps, place, prior, &noise)?;
        let apart = |i: usize| (logarithms[i] - usual[i]) / USUAL[i];
        let unusual: f64 = (0..COUNT).map(|i| 0.5 * apart(i) * apart(i)).sum();
        Some(result.likelihood - unusual)
    };
    let mut here = begin.logarithms();
    let Some(mut best) = worth(here) else { return begin };
    let mut step = FIRST_STEP;
    for _ in 0..MAX_ROUNDS {
        let before = best;
        for i in 0..COUNT {
            for aside in [step, -step] {
                let mut there = here;
                there[i] += aside;
                if let Some(value) = worth(there).filter(|value| *value > best) {
                    (here, best) = (there, value);
                    break;
                }
            }
        }
        if best <= before {
            step *= 0.5;
        }
        if step < LAST_STEP {
            break;
        }
    }
    Noise::from_logarithms(here)
}
