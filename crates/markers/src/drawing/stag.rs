//! Drawings of STags.

use super::{Drawing, Ink, Layer, Shape};
use crate::stag::code::{self, DISC_RADIUS, DOT_RADIUS, DOTS};

/// The generator joins black dots by discs and smooths the whole by majority. Discs of this size between dots that are this
/// near, both in radii of a dot, make the same figure but for 0.8 % of the area of the dots.
const JOINT: f64 = 0.85;
const NEAR: f64 = 3.5;

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
    let distance = |a: &[f64; 2], b: &[f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]) / DOT_RADIUS;
    let mut joints = Vec::new();
    for (i, (_, a)) in black.iter().enumerate() {
        let near = black[i + 1..].iter().filter(|(_, b)| distance(a, b) < NEAR);
        joints.extend(near.map(|(_, b)| [(a[0] + b[0]) / 2.0, (a[1] + b[1]) / 2.0]));
    }
    layers.extend(joints.iter().map(|joint| disc(*joint, JOINT * DOT_RADIUS, Ink::Black)));
    // White dots show where a joint would cover them.
    let is_covered = |dot: &[f64; 2]| joints.iter().any(|joint| distance(dot, joint) < 1.0 + JOINT);
    let shown = white.iter().filter(|(_, dot)| is_covered(dot));
    layers.extend(shown.map(|(_, dot)| disc(*dot, DOT_RADIUS, Ink::White)));
    Drawing { half_extent_m: (0.5 + code::QUIET) * size_m, layers }
}
