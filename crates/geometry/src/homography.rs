//! Computes the projective map from a plane to its image.

use nalgebra::{SMatrix, SVector};

/// A point of a plane and its image, in coordinates of any unit.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct PlanePair {
    /// In the plane.
    pub plane: [f64; 2],
    /// In the image.
    pub image: [f64; 2],
}

/// The map that fits pairs best, algebraically: its parameters row by row, of which the ninth is 1. Conditioned well when
/// both sides are near 1 in size. `None` when the pairs do not determine it.
#[inline]
pub fn homography(pairs: impl Iterator<Item = PlanePair>) -> Option<[f64; 8]> {
    let mut matrix = SMatrix::<f64, 8, 8>::zeros();
    let mut right = SVector::<f64, 8>::zeros();
    for PlanePair { plane: [x, y], image: [u, v] } in pairs {
        let rows = [
            (SVector::<f64, 8>::from([x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y]), u),
            (SVector::<f64, 8>::from([0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y]), v),
        ];
        for (row, value) in rows {
            matrix += row * row.transpose();
            right += row * value;
        }
    }
    let h: [f64; 8] = matrix.lu().solve(&right)?.into();
    h.iter().all(|h| h.is_finite()).then_some(h)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pairs_of_a_map_give_the_map() {
        let map = [0.9, 0.2, 0.05, -0.1, 1.1, 0.02, 0.15, -0.2];
        let pairs = (0..9).map(|i| {
            let [x, y] = [f64::from(i % 3) - 1.0, f64::from(i / 3) - 1.0];
            let below = map[6] * x + map[7] * y + 1.0;
            let row = |i: usize| (map[i] * x + map[i + 1] * y + map[i + 2]) / below;
            PlanePair { plane: [x, y], image: [row(0), row(3)] }
        });
        let found = homography(pairs).unwrap();
        assert!(found.iter().zip(map).all(|(found, map)| (found - map).abs() < 1e-12), "{found:?}");
    }

    #[test]
    fn pairs_on_a_line_give_none() {
        let pairs = (0..9)
            .map(|i| f64::from(i) / 8.0)
            .map(|x| PlanePair { plane: [x, 0.0], image: [x, x] });
        assert_eq!(homography(pairs), None);
    }
}
