//! Drawings of STags.

use super::{Drawing, Ink, Layer, Shape};
use crate::stag::code::{self, DISC_RADIUS, DOT_RADIUS, DOTS};

/// Black dots whose centres are nearer than this many radii of a dot grow together.
const NEAR: f64 = 4.0 / 1.4;
/// Radius of the disc between two black dots, in radii of a dot.
const JOINT: f64 = 0.7;

/// The marker with this word.
pub(super) fn drawing(word: u64, size_m: f64) -> Drawing {
    let half_m = size_m / 2.0;
    let square = Shape::Rectangle { min_m: [-half_m; 2], max_m: [half_m; 2] };
    let disc = |centre: [f64; 2], radius: f64, ink| Layer {
        shape: Shape::Disc { centre_m: centre.map(|c| c * size_m), radius_m: radius * size_m },
        ink,
    };
    let dots = code::dots();
    let (black, white): (Vec<_>, Vec<_>) =
        (0..DOTS).map(|k| (k, dots[k])).partition(|(k, _)| code::is_black(word, *k));
    let mut layers =
        vec![Layer { shape: square, ink: Ink::Black }, disc([0.0; 2], DISC_RADIUS, Ink::White)];
    layers.extend(black.iter().map(|(_, dot)| disc(*dot, DOT_RADIUS, Ink::Black)));
    for (i, (_, a)) in black.iter().enumerate() {
        let near = |b: &[f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]) < NEAR * DOT_RADIUS;
        layers.extend(black[i + 1..].iter().filter(|(_, b)| near(b)).map(|(_, b)| {
            let middle = [(a[0] + b[0]) / 2.0, (a[1] + b[1]) / 2.0];
            disc(middle, JOINT * DOT_RADIUS, Ink::Black)
        }));
    }
    layers.extend(white.iter().map(|(_, dot)| disc(*dot, DOT_RADIUS, Ink::White)));
    Drawing { half_extent_m: (0.5 + code::QUIET) * size_m, layers }
}
