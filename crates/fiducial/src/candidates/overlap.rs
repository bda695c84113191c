//! Finds quads of the same square, and suppresses those that conflict with a better one.

use geometry::Pixel;

use crate::candidates::quad::{diagonal_px, middle};

/// How a quad lies to one that is known.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Overlap {
    /// Distance of their middles.
    distance_px: f64,
    /// Diagonals of the known and of the other quad.
    known_px: f64,
    other_px: f64,
}

impl Overlap {
    pub(crate) fn new(known: &[Pixel; 4], other: &[Pixel; 4]) -> Self {
        Self {
            distance_px: middle(known).distance(&middle(other)),
            known_px: diagonal_px(known),
            other_px: diagonal_px(other),
        }
    }

    /// Whether both are the same square, up to a rotation.
    pub(crate) fn is_same_square(&self) -> bool {
        let Self { distance_px, known_px, other_px } = *self;
        distance_px < 0.2 * known_px && other_px < 1.5 * known_px && known_px < 1.5 * other_px
    }

    /// Whether they have the same centre, at any sizes.
    pub(crate) fn is_concentric(&self) -> bool {
        self.distance_px < 0.25 * self.known_px
    }

    /// Whether the known one leaves no room for the other; a larger one around it is possible.
    pub(crate) fn is_covered(&self) -> bool {
        self.distance_px < 0.4 * self.known_px && self.other_px < 1.5 * self.known_px
    }

    /// Whether at most one of them can be a marker.
    pub(crate) fn is_conflict(&self) -> bool {
        self.distance_px < 0.4 * self.known_px.max(self.other_px)
    }
}

/// Non-maximum suppression: sorts by score, best first, and drops results that conflict with a better one.
pub(crate) fn suppress_non_maxima<T: Copy>(
    found: &mut Vec<T>,
    score: impl Fn(&T) -> f64,
    is_conflict: impl Fn(&T, &T) -> bool,
) {
    found.sort_unstable_by(|a, b| score(b).total_cmp(&score(a)));
    let mut kept = 0;
    for index in 0..found.len() {
        let candidate = found[index];
        if !found[..kept].iter().any(|better| is_conflict(better, &candidate)) {
            found[kept] = candidate;
            kept += 1;
        }
    }
    found.truncate(kept);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(x: f64, side: f64) -> [Pixel; 4] {
        [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]
            .map(|[u, v]| Pixel::new(x + side * u, side * v))
    }

    #[test]
    fn squares_overlap_by_their_middles_and_sizes() {
        let known = square(0.0, 10.0);
        for (x, side, expected) in [
            (1.0, 10.0, [true, true, true, true]),
            (3.0, 10.0, [false, true, true, true]),
            (5.0, 10.0, [false, false, true, true]),
            (0.0, 20.0, [false, true, false, true]),
            (8.0, 30.0, [false, false, false, true]),
            (12.5, 10.0, [false, false, false, false]),
        ] {
            let overlap = Overlap::new(&known, &square(x, side));
            let found = [
                overlap.is_same_square(),
                overlap.is_concentric(),
                overlap.is_covered(),
                overlap.is_conflict(),
            ];
            assert_eq!(found, expected, "{x} {side}");
        }
    }

    #[test]
    fn the_best_at_each_position_is_retained() {
        let mut found = vec![[0.0, 1.0], [10.0, 3.0], [0.4, 2.0], [10.3, 0.5]];
        suppress_non_maxima(&mut found, |f| f[1], |a, b| f64::abs(a[0] - b[0]) < 1.0);
        assert_eq!(found, [[10.0, 3.0], [0.4, 2.0]]);
    }
}
