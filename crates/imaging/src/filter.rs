//! Applies the bilateral filter of 5 x 5 pixels of the thesis' pre-processing, row by row.

use crate::view::{GrayImage, GrayView};

/// Standard deviation of both weights: grey levels for the range, pixels for the distance (thesis, section
/// 3.1.1).
pub const BILATERAL_SIGMA: f32 = 175.0;

/// Radius of the neighbourhood, in pixels.
const REACH: usize = 2;

/// Working memory of [`bilateral_5x5`]: the rows around the one being filtered, with their borders.
#[derive(Clone, Debug, Default)]
pub struct BilateralRows {
    rows: [Vec<f32>; 2 * REACH + 1],
}

/// Bilateral filter (Equations 3.1 and 3.2) in 5 x 5 neighbourhoods with [`BILATERAL_SIGMA`] for both
/// weights.
///
/// As OpenCV's `bilateralFilter(src, 5, 175, 175)`: of the 25 pixels the 13 no further than 2 pixels away
/// count, borders are mirrored without repeating the edge pixel, and the mean is rounded to the nearest
/// integer.
pub fn bilateral_5x5(view: GrayView<'_>, rows: &mut BilateralRows, out: &mut GrayImage) {
    out.resize(view.width(), view.height());
    for (slot, row) in rows.rows.iter_mut().enumerate() {
        let y = mirrored(slot as isize - REACH as isize, view.height());
        fill(row, view.row(y));
    }
    for y in 0..view.height() {
        let [above2, above, here, below, below2] = &rows.rows;
        filter_row([above2, above, here, below, below2], out.row_mut(y));
        rows.rows.rotate_left(1);
        let next = mirrored((y + 1 + REACH) as isize, view.height());
        fill(&mut rows.rows[2 * REACH], view.row(next));
    }
}

/// The index for `at` beyond the ends of a line of `len`: mirrored about the centres of the end pixels.
fn mirrored(at: isize, len: usize) -> usize {
    let last = len as isize - 1;
    if last == 0 {
        return 0;
    }
    let folded = at.rem_euclid(2 * last);
    (if folded > last { 2 * last - folded } else { folded }) as usize
}

/// Copies a row of pixels with its mirrored borders.
fn fill(row: &mut Vec<f32>, pixels: &[u8]) {
    let width = pixels.len();
    row.resize(width + 2 * REACH, 0.0);
    for (to, from) in row[REACH..].iter_mut().zip(pixels) {
        *to = f32::from(*from);
    }
    for margin in 0..REACH {
        row[margin] = f32::from(pixels[mirrored(margin as isize - REACH as isize, width)]);
        row[REACH + width + margin] = f32::from(pixels[mirrored((width + margin) as isize, width)]);
    }
}

fn filter_row(rows: [&[f32]; 5], out: &mut [u8]) {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
        #[allow(
            unsafe_code,
            reason = "wide registers need a named feature; twice as fast on the flight computer"
        )]
        // SAFETY: both features were just detected.
        return unsafe { filter_row_avx2(rows, out) };
    }
    kernel::<false>(rows, out);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn filter_row_avx2(rows: [&[f32]; 5], out: &mut [u8]) {
    kernel::<true>(rows, out);
}

#[inline(always)]
fn multiply_add<const FUSED: bool>(a: f32, b: f32, c: f32) -> f32 {
    // Without the instruction, `mul_add` is a slow library call.
    if FUSED { a.mul_add(b, c) } else { a * b + c }
}

/// exp(-t) for t from 0 to 1.07, to 1e-6 (interpolated at Chebyshev points). A table look-up would stop the
/// compiler from filtering eight pixels at a time.
#[inline(always)]
fn decay<const FUSED: bool>(t: f32) -> f32 {
    const C: [f32; 6] = EXP_COEFFICIENTS;
    let mut sum = C[5];
    for c in [C[4], C[3], C[2], C[1], C[0]] {
        sum = multiply_add::<FUSED>(sum, t, c);
    }
    sum
}

const EXP_COEFFICIENTS: [f32; 6] =
    [0.999_999_4, -0.999_957_56, 0.499_528_47, -0.164_728_05, 0.037_985_91, -0.004_948_195];

#[inline(always)]
fn kernel<const FUSED: bool>(rows: [&[f32]; 5], out: &mut [u8]) {
    /// Range weights' scale: -ln(weight) per squared grey level.
    const RANGE: f32 = 0.5 / (BILATERAL_SIGMA * BILATERAL_SIGMA);
    // exp(-d^2 / (2 sigma^2)) at the squared distances 1, 2 and 4.
    let near = (-RANGE).exp();
    let weights = [near, near.powi(2), near.powi(4)];
    let width = out.len();
    let line = |row: usize, offset: usize| &rows[row][offset..offset + width];
    let centre = line(2, 2);
    // Neighbours by distance: 1, the square root of 2, 2.
    let groups = [
        [line(1, 2), line(3, 2), line(2, 1), line(2, 3)],
        [line(1, 1), line(1, 3), line(3, 1), line(3, 3)],
        [line(0, 2), line(4, 2), line(2, 0), line(2, 4)],
    ];
    for x in 0..width {
        let mid = centre[x];
        let (mut sum, mut total) = (0.0, 1.0);
        for (group, weight) in groups.iter().zip(weights) {
            let (mut group_sum, mut group_total) = (0.0, 0.0);
            for neighbour in group {
                let difference = neighbour[x] - mid;
                let w = decay::<FUSED>(difference * difference * RANGE);
                group_sum = multiply_add::<FUSED>(w, difference, group_sum);
                group_total += w;
            }
            sum = multiply_add::<FUSED>(weight, group_sum, sum);
            total = multiply_add::<FUSED>(weight, group_total, total);
        }
        out[x] = (mid + sum / total + 0.5) as i32 as u8;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn exact(view: GrayView<'_>, x: usize, y: usize) -> f64 {
        let sigma = f64::from(BILATERAL_SIGMA);
        let mid = f64::from(view.at(x, y));
        let (mut sum, mut total) = (0.0, 0.0);
        for dy in -2_isize..=2 {
            for dx in -2_isize..=2 {
                let square = (dx * dx + dy * dy) as f64;
                if square <= 4.0 {
                    let px = mirrored(x as isize + dx, view.width());
                    let py = mirrored(y as isize + dy, view.height());
                    let value = f64::from(view.at(px, py));
                    let w = (-(square + (value - mid).powi(2)) / (2.0 * sigma * sigma)).exp();
                    sum += w * value;
                    total += w;
                }
            }
        }
        sum / total
    }

    proptest! {
        #[test]
        fn every_pixel_is_the_weighted_mean_of_its_thirteen(
            (width, height, data) in (1_usize..20, 1_usize..9).prop_flat_map(|(w, h)| {
                (Just(w), Just(h), prop::collection::vec(any::<u8>(), w * h))
            })
        ) {
            let view = GrayView::packed(&data, width, height).unwrap();
            let mut out = GrayImage::default();
            bilateral_5x5(view, &mut BilateralRows::default(), &mut out);
            for y in 0..height {
                for x in 0..width {
                    let error = f64::from(out.row(y)[x]) - exact(view, x, y);
                    prop_assert!(error.abs() < 0.502, "{error} at {x}, {y}");
                }
            }
        }
    }

    #[test]
    fn the_slow_kernel_agrees_with_the_fast_one() {
        let data: Vec<u8> =
            (0..40_000_u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
        let view = GrayView::packed(&data, 200, 200).unwrap();
        let mut fast = GrayImage::default();
        bilateral_5x5(view, &mut BilateralRows::default(), &mut fast);
        let mut rows: [Vec<f32>; 5] = Default::default();
        for (row, y) in rows.iter_mut().zip(98..) {
            fill(row, view.row(y));
        }
        let [a, b, c, d, e] = &rows;
        let mut slow = vec![0; 200];
        kernel::<false>([a, b, c, d, e], &mut slow);
        let worst = slow.iter().zip(fast.row(100)).map(|(a, b)| a.abs_diff(*b)).max();
        assert!(worst <= Some(1));
    }
}
