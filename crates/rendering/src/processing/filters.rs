//! Applies filters of a few pixels: denoising and blur. The border is continued outwards.

/// Half width of a blur, in standard deviations.
const REACH: f32 = 3.0;

/// Copies an image with `margin` more pixels on each side, which repeat the border; with a margin of 1 for a
/// mosaic, `mirror` repeats the pixel next to it, which has the same colours.
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

/// The rows above, at and below row `v` of an image, of which `padded` has one pixel more on each side; `None` of a
/// `padded` that is too small.
pub(super) fn three_rows(padded: &[f32], width: usize, v: usize) -> Option<[&[f32]; 3]> {
    let stride = width + 2;
    let row = |i: usize| padded.get((v + i) * stride..(v + i + 1) * stride);
    Some([row(0)?, row(1)?, row(2)?])
}

/// The pixels to the left of, at and to the right of those of a row with one pixel more on each side.
pub(super) fn beside(row: &[f32]) -> [&[f32]; 3] {
    let width = row.len().saturating_sub(2);
    [0, 1, 2].map(|i| row.get(i..i + width).unwrap_or(&[]))
}

/// Calls `filter` with the 3 x 3 pixels about each pixel of an image, of which `padded` has one more on each
/// side.
#[inline]
fn each_nine(
    padded: &[f32],
    width: usize,
    image: &mut [f32],
    filter: impl Fn([[f32; 3]; 3]) -> f32,
) {
    for (v, row) in image.chunks_exact_mut(width.max(1)).enumerate() {
        let Some(rows) = three_rows(padded, width, v) else { continue };
        // All of one length, so that the loop below needs no test of its indices and takes several pixels at once.
        let [[a, b, c], [d, e, f], [g, h, i]] = rows.map(beside);
        let all = [a, b, c, d, e, f, g, h, i];
        if all.iter().any(|part| part.len() != row.len()) {
            continue;
        }
        let up = a.iter().zip(b).zip(c);
        let own = d.iter().zip(e).zip(f);
        let down = g.iter().zip(h).zip(i);
        for (((pixel, ((a, b), c)), ((d, e), f)), ((g, h), i)) in
            row.iter_mut().zip(up).zip(own).zip(down)
        {
            *pixel = filter([[*a, *b, *c], [*d, *e, *f], [*g, *h, *i]]);
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
    let across = beside * beside;
    let scale = 1.0 / (range * range);
    each_nine(padded, width, image, |[[a, b, c], [d, middle, f], [g, h, i]]| {
        let weight = |value: f32, near: f32| {
            let off = value - middle;
            near / (1.0 + off * off * scale)
        };
        let [wa, wb, wc] = [weight(a, across), weight(b, beside), weight(c, across)];
        let [wd, wf] = [weight(d, beside), weight(f, beside)];
        let [wg, wh, wi] = [weight(g, across), weight(h, beside), weight(i, across)];
        let sum = (wa * a + wb * b + wc * c) + (wd * d + wf * f) + (wg * g + wh * h + wi * i);
        let total = (wa + wb + wc) + (wd + wf) + (wg + wh + wi);
        (middle + sum) / (1.0 + total)
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
