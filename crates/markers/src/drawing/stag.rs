//! Draws STags.

use super::{Drawing, Ink, Layer, Shape};
use crate::stag_code::{self, DISC_RADIUS, DOT_RADIUS, DOTS};

/// Radius of the discs that join near black dots, in radii of a dot. STag's generator joins dots by discs too and smooths
/// the picture by majority; with these two values the drawing differs from it in 0.8 % of the area of the dots.
const JOINT: f64 = 0.85;
/// Distance below which two black dots are joined, in radii of a dot.
const NEAR: f64 = 3.5;

/// The marker with this codeword.
pub(super) fn drawing(codeword: u64, size_m: f64) -> Drawing {
    let half_m = size_m / 2.0;
    let square = Shape::Rectangle { min_m: [-half_m; 2], max_m: [half_m; 2] };
    let disc = |centre: [f64; 2], radius: f64, ink| Layer {
        shape: Shape::Disc { centre_m: centre.map(|c| c * size_m), radius_m: radius * size_m },
        ink,
    };
    let dots = stag_code::dots();
    let (black, white): (Vec<_>, Vec<_>) =
        (0..DOTS).map(|k| (k, dots[k])).partition(|(k, _)| stag_code::is_black(codeword, *k));
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
    Drawing { half_extent_m: (0.5 + stag_code::QUIET_ZONE) * size_m, layers }
}
