//! Calibrates synthetic cameras from synthetic boards, and prints the errors and uncertainties of the results.
#![expect(clippy::print_stdout, clippy::panic, reason = "the tables are its purpose")]

use std::time::Instant;

use calibration::{Calibration, Options, calibrate_unjudged};

#[path = "../tests/synthetic/mod.rs"]
mod synthetic;

use synthetic::score::Score;
use synthetic::{Taking, Truth, lenses, views};

fn main() {
    let number = |at: usize, default: u64| {
        std::env::args().nth(at).and_then(|arg| arg.parse().ok()).unwrap_or(default)
    };
    let (solves, first_seed) = (number(1, 10), number(2, 0));
    println!(
        "median, 95 of 100, largest; cross: difference of two halves by its expectation; lateral: error at 5 m; turned: map after the best rotation"
    );
    println!(
        "{:13} {:>6} {:>18} {:>18} {:>18} {:>18} {:>5} {:>8} {:>18} {:>18} {:>5}",
        "lens",
        "solves",
        "f %",
        "c px",
        "map px",
        "turned px",
        "NEES",
        "1/1.96 s",
        "cross",
        "lateral cm",
        "ms"
    );
    for truth in lenses() {
        let solves: Vec<Solve> = (0..solves).map(|i| Solve::new(&truth, first_seed + i)).collect();
        let of = |value: fn(&Solve) -> f64| solves.iter().map(value).collect::<Vec<_>>();
        let within = [0, 1]
            .map(|i| 100.0 * mean(&solves.iter().map(|s| s.score.within[i]).collect::<Vec<_>>()));
        println!(
            "{:13} {:6} {:>18} {:>18} {:>18} {:>18} {:5.2} {:>8} {:>18} {:>18} {:5.0}",
            truth.name,
            solves.len(),
            spread(of(|s| s.score.focal_percent)),
            spread(of(|s| s.score.principal_px)),
            spread(of(|s| s.score.map_px)),
            spread(of(|s| s.score.turned_px)),
            mean(&of(|s| s.score.nees)),
            format!("{:.0}/{:.0} %", within[0], within[1]),
            spread(of(|s| s.found.cross_validation.map_or(f64::NAN, |halves| halves.ratio()))),
            spread(of(|s| 100.0 * s.found.error_at(5.0).lateral_m)),
            mean(&of(|s| s.ms)),
        );
    }
}

/// A calibration and its errors.
struct Solve {
    found: Calibration,
    score: Score,
    ms: f64,
}

impl Solve {
    fn new(truth: &Truth, seed: u64) -> Self {
        let views = views(&truth.camera, &Taking::default(), seed);
        let begin = Instant::now();
        let found = calibrate_unjudged(&views, truth.lens, &Options::default());
        let ms = begin.elapsed().as_secs_f64() * 1e3;
        let found = found.unwrap_or_else(|refusal| panic!("{} {seed}: {refusal}", truth.name));
        Self { score: Score::new(truth, &found), found, ms }
    }
}

/// Median, 95 of 100, largest.
fn spread(mut values: Vec<f64>) -> String {
    values.sort_by(f64::total_cmp);
    let at = |share: usize| values[((values.len() * share).div_ceil(100)).max(1) - 1];
    format!("{:.3} {:.3} {:.3}", at(50), at(95), at(100))
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}
