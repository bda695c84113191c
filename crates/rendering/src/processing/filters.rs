//! Filters of a few pixels: denoising and blur. The border is continued outwards.

/// Half width of a blur, in standard deviations.
const REACH: f32 = 3.0;

/// Copies an image with `margin` more pixels on each side, which repeat the border; with a margin of 1 for a
/// mosaic, `mirror` repeats the pixel beside it, which has the same colours.
pub(super) fn pad(image: &[f32], width: usize, mirror: bool, padded: &mut Vec<f32>) {
    let height = image.len() / width.max(1);
    padded.clear();
    padded.reserve((width + 2) * (height + 2));
    let outside = |edge: usize| if mirror && edge > 1 { [1, edge - 2] } else { [0, edge - 1] };
    let [above, below] = outside(height.max(1));
    let [left, right] = outside(width.max(1));
    let rows = std::iter::once(above).chain(0..height).chain(std::iter::once(below));
    for v in rows {
        let row = image.get(v * width..(v + 1) * width).unwrap_or(&[]);
        let end = |at: usize| row.get(at).copied().unwrap_or(0.0);
        padded.push(end(left));
        padded.extend_from_slice(row);
        padded.push(end(right));
    }
}

/// Calls `filter` with the 3 x 3 pixels about each pixel of an image, of which `padded` has one more on each
/// side.
fn each_nine(
    padded: &[f32],
    width: usize,
    image: &mut [f32],
    filter: impl Fn([[f32; 3]; 3]) -> f32,
) {
    let stride = width + 2;
    for (v, row) in image.chunks_mut(width.max(1)).enumerate() {
        let [above, own, below] = [0, 1, 2].map(|i| {
            let from = (v + i) * stride;
            padded.get(from..from + row.len() + 2).unwrap_or(&[])
        });
        if own.len() != row.len() + 2 || above.len() != own.len() || below.len() != own.len() {
            continue;
        }
        for x in 0..row.len() {
            row[x] = filter([
                [above[x], above[x + 1], above[x + 2]],
                [own[x], own[x + 1], own[x + 2]],
                [below[x], below[x + 1], below[x + 2]],
            ]);
        }
    }
}

/// The median of 3 x 3 pixels.
pub(super) fn median(padded: &[f32], width: usize, image: &mut [f32]) {
    let sorted = |[a, b, c]: [f32; 3]| {
        let (low, high) = (a.min(b), a.max(b));
        [low.min(c), low.max(high.min(c)), high.max(c)]
    };
    each_nine(padded, width, image, |rows| {
        // The median of nine is that of the largest minimum, the middle median and the smallest maximum.
        let [a, b, c] = rows.map(sorted);
        let low = a[0].max(b[0]).max(c[0]);
        let middle = sorted([a[1], b[1], c[1]])[1];
        let high = a[2].min(b[2]).min(c[2]);
        sorted([low, middle, high])[1]
    });
}

/// The mean of 3 x 3 pixels, weighted by distance and by difference from the middle one: half the weight at
/// `range`, a quarter at about 1.7 times that.
pub(super) fn bilateral(
    padded: &[f32],
    width: usize,
    sigma_px: f32,
    range: f32,
    image: &mut [f32],
) {
    let beside = (-0.5 / (sigma_px * sigma_px)).exp();
    let scale = 1.0 / (range * range);
    each_nine(padded, width, image, |rows| {
        let middle = rows[1][1];
        let (mut sum, mut total) = (0.0, 0.0);
        for (row, down) in rows.iter().zip([beside, 1.0, beside]) {
            for (value, across) in row.iter().zip([beside, 1.0, beside]) {
                let off = value - middle;
                let weight = down * across / (1.0 + off * off * scale);
                sum += weight * value;
                total += weight;
            }
        }
        sum / total
    });
}

/// A Gaussian blur.
#[derive(Debug)]
pub(super) struct Gaussian {
    /// From the middle outwards; those of both sides sum to 1.
    weights: Vec<f32>,
}

impl Gaussian {
    pub(super) fn new(sigma_px: f32) -> Self {
        let reach = (REACH * sigma_px).ceil() as usize;
        let mut weights: Vec<f32> =
            (0..=reach).map(|k| (-0.5 * (k as f32 / sigma_px).powi(2)).exp()).collect();
        let total = 2.0 * weights.iter().sum::<f32>() - weights[0];
        weights.iter_mut().for_each(|weight| *weight /= total);
        Self { weights }
    }

    /// Blurs an image; `work` is overwritten.
    pub(super) fn blur(
        &self,
        image: &[f32],
        width: usize,
        work: &mut Vec<f32>,
        out: &mut Vec<f32>,
    ) {
        let (width, height) = (width.max(1), image.len() / width.max(1));
        work.resize(image.len(), 0.0);
        out.resize(image.len(), 0.0);
        let reach = self.weights.len() - 1;
        // Down the columns.
        for (v, row) in work.chunks_mut(width).enumerate() {
            let at = |k: usize| image.get(k * width..(k + 1) * width).unwrap_or(&[]);
            for (value, own) in row.iter_mut().zip(at(v)) {
                *value = self.weights[0] * own;
            }
            for (k, weight) in self.weights.iter().enumerate().skip(1) {
                let pair = at(v.saturating_sub(k)).iter().zip(at((v + k).min(height - 1)));
                for (value, (above, below)) in row.iter_mut().zip(pair) {
                    *value += weight * (above + below);
                }
            }
        }
        // Along the rows.
        let mut line = vec![0.0; width + 2 * reach];
        for (row, target) in work.chunks(width).zip(out.chunks_mut(width)) {
            line[..reach].fill(row[0]);
            line[reach..reach + row.len()].copy_from_slice(row);
            line[reach + row.len()..].fill(row[row.len() - 1]);
            for (value, own) in target.iter_mut().zip(&line[reach..]) {
                *value = self.weights[0] * own;
            }
            for (k, weight) in self.weights.iter().enumerate().skip(1) {
                let pair = line[reach - k..].iter().zip(&line[reach + k..]);
                for (value, (left, right)) in target.iter_mut().zip(pair) {
                    *value += weight * (left + right);
                }
            }
        }
    }
}
