//! Bins raw images: square blocks of samples become one pixel.

use crate::view::{GrayView, ViewError};

/// Averages each block of `by` x `by` samples into a pixel of 8-bit grey, row by row into `pixels`, which has as many bytes as there
/// are whole blocks. Samples have one byte up to 8 `bits`, else two, the low byte first; they are scaled so that the largest is
/// 255. A block of even edges has as many samples of each colour of a Bayer pattern as every other, so that grey stays even behind
/// one.
///
/// # Errors
/// [`ViewError`] when there is no whole block, an edge is too large, or there are too few bytes of either.
pub fn bin(
    samples: &[u8],
    [width, height]: [usize; 2],
    bits: u32,
    by: usize,
    pixels: &mut [u8],
) -> Result<(), ViewError> {
    let bits = bits.clamp(1, 16);
    let bytes = if bits > 8 { 2 } else { 1 };
    // Checks size and length.
    let view = GrayView::packed(samples, width * bytes, height)?;
    let by = by.max(1);
    let [columns, rows] = [width / by, height / by];
    if columns == 0 || rows == 0 {
        return Err(ViewError::Size { width: columns, height: rows });
    }
    if pixels.len() < columns * rows {
        return Err(ViewError::Length { len: pixels.len(), needed: columns * rows });
    }
    let mut sums = vec![0u32; columns];
    let largest = u64::from((1u32 << bits) - 1) * (by * by) as u64;
    for (row, pixels) in pixels.chunks_exact_mut(columns).take(rows).enumerate() {
        sums.fill(0);
        for y in row * by..(row + 1) * by {
            let line = view.row(y);
            for (sum, block) in sums.iter_mut().zip(line.chunks_exact(by * bytes)) {
                *sum += match bytes {
                    1 => block.iter().map(|sample| u32::from(*sample)).sum::<u32>(),
                    _ => block
                        .chunks_exact(2)
                        .map(|sample| u32::from(u16::from_le_bytes([sample[0], sample[1]])))
                        .sum(),
                };
            }
        }
        for (pixel, sum) in pixels.iter_mut().zip(&sums) {
            *pixel = ((u64::from(*sum) * 255 + largest / 2) / largest).min(255) as u8;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn binned(samples: &[u8], size: [usize; 2], bits: u32, by: usize) -> Vec<u8> {
        let mut pixels = vec![0; size[0] / by * (size[1] / by)];
        bin(samples, size, bits, by, &mut pixels).unwrap();
        pixels
    }

    #[test]
    fn a_pixel_is_the_mean_of_its_block() {
        let samples = [0, 10, 200, 201, 9, 20, 30, 202, 203, 9, 1, 1, 1, 1, 1];
        assert_eq!(binned(&samples, [5, 3], 8, 2), [15, 202]);
        assert_eq!(binned(&samples, [5, 3], 8, 1), samples);
        assert_eq!(binned(&[255; 64], [8, 8], 8, 4), [255; 4]);
    }

    #[test]
    fn more_than_eight_bits_are_scaled() {
        let samples: Vec<u8> = [4095u16, 4095, 0, 0, 4095, 4095, 0, 4095]
            .iter()
            .flat_map(|s| s.to_le_bytes())
            .collect();
        assert_eq!(binned(&samples, [4, 2], 12, 2), [255, 64]);
    }

    #[test]
    fn grey_behind_a_bayer_pattern_is_even() {
        let filters = [[60, 100], [100, 75]];
        let samples: Vec<u8> = (0..8 * 6).map(|i| filters[i / 8 % 2][i % 2]).collect();
        for by in [2, 4] {
            let pixels = binned(&samples, [8, 6], 8, by);
            assert_eq!(pixels, vec![84; (8 / by) * (6 / by)]);
        }
    }

    #[test]
    fn impossible_sizes_are_refused() {
        let mut pixels = [0; 9];
        for (size, by) in [([3, 3], 4), ([0, 3], 2), ([5, 2], 2)] {
            assert!(bin(&[0; 9], size, 8, by, &mut pixels).is_err(), "{size:?} {by}");
        }
        assert!(bin(&[0; 9], [3, 3], 12, 2, &mut pixels).is_err());
        assert!(bin(&[0; 9], [3, 3], 8, 1, &mut pixels[..8]).is_err());
    }
}
