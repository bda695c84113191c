//! Smooths the residuals of neighbouring pixels, with their gradients: cameras leave their largest errors in the finest
//! detail, so that means over a few pixels determine a fit better than single ones.
//!
//! JPEG rounds the finest parts of an image the most, noise reduction and sharpening change them the most. With errors that
//! grow so, the best weights are those of a low-pass filter. Its form matters little: with the tables of JPEG a weight of
//! [`BESIDE`] for each neighbour has two thirds of the effect of the exact covariance of the errors.

use nalgebra::SVector;

use super::scene::PixelSample;

/// Weight of a pixel beside, above or below; of a diagonal one its square.
const BESIDE: f64 = 0.25;
/// Maximum number of pixels of a row; a marker of which all pixels are used has fewer.
const MAX_ACROSS: usize = 32;

/// Whether samples are all pixels of an area, row by row.
pub(super) fn are_rows(samples: &[PixelSample]) -> bool {
    let follows = |pair: &[PixelSample]| match pair {
        [from, to] => {
            let [right, down] = [0, 1].map(|axis| to.offset[axis] - from.offset[axis]);
            down > 0.5 || right > 0.5 && down > -0.5
        }
        _ => true,
    };
    samples.windows(2).all(follows)
}

/// The values of the pixels of one row.
#[derive(Copy, Clone)]
struct Row<const N: usize> {
    down: i32,
    right: i32,
    values: [SVector<f64, N>; MAX_ACROSS],
    count: usize,
}

impl<const N: usize> Row<N> {
    fn empty() -> Self {
        Self { down: i32::MIN / 2, right: 0, values: [SVector::zeros(); MAX_ACROSS], count: 0 }
    }

    /// The value at a column.
    fn at(&self, right: i32) -> Option<&SVector<f64, N>> {
        let index = usize::try_from(right - self.right).ok()?;
        self.values.get(..self.count)?.get(index)
    }

    /// The weighted sum of the values at and beside a column.
    fn smoothed(&self, right: i32) -> SVector<f64, N> {
        let mut sum = SVector::zeros();
        for (by, weight) in [(-1, BESIDE), (0, 1.0), (1, BESIDE)] {
            if let Some(value) = self.at(right + by) {
                sum += value * weight;
            }
        }
        sum
    }
}

/// Smooths values of pixels that are added row by row.
pub(super) struct Smoother<const N: usize> {
    first: Option<[f64; 2]>,
    /// The row of which sums are due, between those above and below.
    rows: [Row<N>; 3],
}

impl<const N: usize> Smoother<N> {
    pub(super) fn new() -> Self {
        Self { first: None, rows: [Row::empty(); 3] }
    }

    /// Adds the value of a pixel at this offset, after those above it and to its left; a value that no pixel has yet is taken
    /// for zero. Visits the sums that are complete.
    pub(super) fn add(
        &mut self,
        offset: [f64; 2],
        value: &SVector<f64, N>,
        visit: impl FnMut(&SVector<f64, N>),
    ) {
        let [x, y] = *self.first.get_or_insert(offset);
        let [right, down] = [offset[0] - x, offset[1] - y].map(|by| by.round() as i32);
        if self.rows[2].down != down {
            self.end_row(visit);
            (self.rows[2].down, self.rows[2].right) = (down, right);
        }
        let row = &mut self.rows[2];
        // Saturated pixels leave gaps in a row.
        let index = usize::try_from(right - row.right).unwrap_or(MAX_ACROSS);
        if let Some(slot) = row.values.get_mut(index) {
            *slot = *value;
            row.count = index + 1;
        }
    }

    /// Visits the remaining sums.
    pub(super) fn end(&mut self, mut visit: impl FnMut(&SVector<f64, N>)) {
        self.end_row(&mut visit);
        self.end_row(&mut visit);
    }

    /// Visits the sums of the row before the last one, and begins another.
    fn end_row(&mut self, mut visit: impl FnMut(&SVector<f64, N>)) {
        // White noise keeps its variance.
        const PER_GAIN: f64 = 1.0 / (1.0 + 2.0 * BESIDE * BESIDE);
        let [above, own, below] = &self.rows;
        for right in (own.right..).take(own.count) {
            let mut sum = own.smoothed(right);
            for row in [above, below] {
                if (row.down - own.down).abs() == 1 {
                    sum += row.smoothed(right) * BESIDE;
                }
            }
            visit(&(sum * PER_GAIN));
        }
        self.rows.rotate_left(1);
        self.rows[2] = Row::empty();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The sums about one pixel of a square of 7 x 7 that is 1 where all others are 0, in the order of the pixels.
    fn smoothed_pixel() -> Vec<f64> {
        let mut smoother = Smoother::<1>::new();
        let mut sums = Vec::new();
        for k in 0..49 {
            let offset = [f64::from(k % 7) - 2.7, f64::from(k / 7) + 0.4];
            let value = SVector::<f64, 1>::new(if k == 24 { 1.0 } else { 0.0 });
            smoother.add(offset, &value, |sum| sums.push(sum[0]));
        }
        smoother.end(|sum| sums.push(sum[0]));
        sums
    }

    #[test]
    fn each_pixel_has_one_sum_of_itself_and_its_neighbours() {
        let sums = smoothed_pixel();
        assert_eq!(sums.len(), 49);
        for (k, sum) in sums.iter().enumerate() {
            let away = (k % 7).abs_diff(3).max((k / 7).abs_diff(3));
            assert_eq!(*sum > 0.0, away <= 1, "{k}: {sum}");
        }
        let share = |k: usize| sums[k] / sums[24];
        assert!((share(23) - BESIDE).abs() < 1e-12 && (share(17) - BESIDE).abs() < 1e-12);
        assert!((share(16) - BESIDE * BESIDE).abs() < 1e-12);
    }

    #[test]
    fn white_noise_keeps_its_variance() {
        let squares: f64 = smoothed_pixel().iter().map(|sum| sum * sum).sum();
        assert!((squares - 1.0).abs() < 1e-12, "{squares}");
    }
}
