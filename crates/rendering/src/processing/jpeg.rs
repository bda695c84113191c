//! Applies the losses of JPEG: blocks of 8 x 8 pixels become cosines, whose amplitudes are rounded to multiples of a step.
//!
//! The next step of an encoder, the coding of those numbers, loses nothing and takes most of the time, so it is left out. The
//! tests compare with an encoder and a decoder.

use crate::quantise::quantise;

const EDGE: usize = 8;
/// Rows of a block.
type Block = [[f32; EDGE]; EDGE];

/// Steps of the amplitudes of luma at quality 50, by rows (ITU-T T.81, Table K.1).
const STEPS: [[u16; EDGE]; EDGE] = [
    [16, 11, 10, 16, 24, 40, 51, 61],
    [12, 12, 14, 19, 26, 58, 60, 55],
    [14, 13, 16, 24, 40, 57, 69, 56],
    [14, 17, 22, 29, 51, 87, 80, 62],
    [18, 22, 37, 56, 68, 109, 103, 77],
    [24, 35, 55, 64, 81, 104, 113, 92],
    [49, 64, 78, 87, 103, 121, 120, 101],
    [72, 92, 95, 98, 112, 100, 103, 99],
];

/// Compression of one quality.
#[derive(Debug)]
pub(super) struct Jpeg {
    /// Of the amplitude of each cosine, by columns, and the inverse.
    steps: Block,
    per_step: Block,
}

impl Jpeg {
    /// The quality, from 1 to 100, scales the steps as encoders have it since the Independent JPEG Group's.
    pub(super) fn new(quality: u8) -> Self {
        let quality = u32::from(quality.clamp(1, 100));
        let percent = if quality < 50 { 5000 / quality } else { 200 - 2 * quality };
        let step = |at: u16| ((u32::from(at) * percent + 50) / 100).clamp(1, 255) as f32;
        let steps = transposed(&STEPS.map(|row| row.map(step)));
        Self { steps, per_step: steps.map(|row| row.map(|step| 1.0 / step)) }
    }

    /// Replaces an image by its compressed version.
    pub(super) fn apply(&self, pixels: &mut [u8], width: usize) {
        for rows in pixels.chunks_mut(EDGE * width.max(1)) {
            let height = rows.len() / width.max(1);
            for left in (0..width).step_by(EDGE) {
                let columns = left..(left + EDGE).min(width);
                let mut block = [[0.0; EDGE]; EDGE];
                for (y, line) in block.iter_mut().enumerate() {
                    // Below and to the side of the image its border is repeated.
                    let start = y.min(height.saturating_sub(1)) * width;
                    let row = rows.get(start + columns.start..start + columns.end).unwrap_or(&[]);
                    let last = row.last().copied().unwrap_or(0);
                    let all = row.iter().copied().chain(std::iter::repeat(last));
                    for (value, pixel) in line.iter_mut().zip(all) {
                        *value = f32::from(pixel) - 128.0;
                    }
                }
                self.lose(&mut block);
                for (row, line) in rows.chunks_mut(width.max(1)).zip(&block) {
                    let part = row.get_mut(columns.clone()).unwrap_or(&mut []);
                    for (pixel, value) in part.iter_mut().zip(line) {
                        *pixel = quantise(value + 128.0);
                    }
                }
            }
        }
    }

    /// Rounds the amplitudes of a block.
    fn lose(&self, block: &mut Block) {
        // Numbers of this size are 1 apart, so that adding it rounds.
        const ROUNDING: f32 = 12_582_912.0;
        let mut amplitudes = cosines(&transposed(&cosines(block)));
        for ((line, steps), per_step) in amplitudes.iter_mut().zip(&self.steps).zip(&self.per_step)
        {
            for ((value, step), per_step) in line.iter_mut().zip(steps).zip(per_step) {
                *value = ((*value * per_step + ROUNDING) - ROUNDING) * step;
            }
        }
        *block = values(&transposed(&values(&amplitudes)));
    }
}

fn transposed<T: Copy + Default>(block: &[[T; EDGE]; EDGE]) -> [[T; EDGE]; EDGE] {
    let mut out = [[T::default(); EDGE]; EDGE];
    for (y, row) in block.iter().enumerate() {
        for (value, line) in row.iter().zip(&mut out) {
            line[y] = *value;
        }
    }
    out
}

/// Half the cosine of k pi / 16.
const C: [f32; EDGE] = [
    0.5,
    0.490_392_63,
    0.461_939_76,
    0.415_734_8,
    0.353_553_4,
    0.277_785_1,
    0.191_341_71,
    0.097_545_16,
];

/// The amplitudes of the cosines down each column, which make an orthonormal base. All columns at once: the sums and
/// differences of opposite rows halve the products.
fn cosines(rows: &Block) -> Block {
    let mut out = [[0.0; EDGE]; EDGE];
    for k in 0..EDGE {
        let x: [f32; EDGE] = std::array::from_fn(|i| rows[i][k]);
        let [s0, s1, s2, s3] = [x[0] + x[7], x[1] + x[6], x[2] + x[5], x[3] + x[4]];
        let [d0, d1, d2, d3] = [x[0] - x[7], x[1] - x[6], x[2] - x[5], x[3] - x[4]];
        let [a0, a1, b0, b1] = [s0 + s3, s1 + s2, s0 - s3, s1 - s2];
        out[0][k] = C[4] * (a0 + a1);
        out[1][k] = C[1] * d0 + C[3] * d1 + C[5] * d2 + C[7] * d3;
        out[2][k] = C[2] * b0 + C[6] * b1;
        out[3][k] = C[3] * d0 - C[7] * d1 - C[1] * d2 - C[5] * d3;
        out[4][k] = C[4] * (a0 - a1);
        out[5][k] = C[5] * d0 - C[1] * d1 + C[7] * d2 + C[3] * d3;
        out[6][k] = C[6] * b0 - C[2] * b1;
        out[7][k] = C[7] * d0 - C[5] * d1 + C[3] * d2 - C[1] * d3;
    }
    out
}

/// The columns whose amplitudes these are.
fn values(amplitudes: &Block) -> Block {
    let mut out = [[0.0; EDGE]; EDGE];
    for k in 0..EDGE {
        let x: [f32; EDGE] = std::array::from_fn(|i| amplitudes[i][k]);
        let [e0, e1] = [C[4] * (x[0] + x[4]), C[4] * (x[0] - x[4])];
        let [f0, f1] = [C[2] * x[2] + C[6] * x[6], C[6] * x[2] - C[2] * x[6]];
        let s = [e0 + f0, e1 + f1, e1 - f1, e0 - f0];
        let d = [
            C[1] * x[1] + C[3] * x[3] + C[5] * x[5] + C[7] * x[7],
            C[3] * x[1] - C[7] * x[3] - C[1] * x[5] - C[5] * x[7],
            C[5] * x[1] - C[1] * x[3] + C[7] * x[5] + C[3] * x[7],
            C[7] * x[1] - C[5] * x[3] + C[3] * x[5] - C[1] * x[7],
        ];
        for i in 0..EDGE / 2 {
            out[i][k] = s[i] + d[i];
            out[EDGE - 1 - i][k] = s[i] - d[i];
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use jpeg_encoder::{ColorType, Encoder};
    use zune_jpeg::JpegDecoder;
    use zune_jpeg::zune_core::bytestream::ZCursor;
    use zune_jpeg::zune_core::colorspace::ColorSpace;
    use zune_jpeg::zune_core::options::DecoderOptions;

    use super::*;
    use crate::processing::rms;

    /// Through an encoder and a decoder.
    fn through_a_file(pixels: &[u8], width: usize, quality: u8) -> Vec<u8> {
        let mut file = Vec::new();
        let [columns, rows] = [width, pixels.len() / width].map(|edge| edge as u16);
        Encoder::new(&mut file, quality).encode(pixels, columns, rows, ColorType::Luma).unwrap();
        let grey = DecoderOptions::default().jpeg_set_out_colorspace(ColorSpace::Luma);
        let mut decoder = JpegDecoder::new_with_options(ZCursor::new(file.as_slice()), grey);
        decoder.decode().unwrap()
    }

    /// Edges, waves and noise; neither edge is a multiple of a block's.
    fn picture(width: usize, height: usize) -> Vec<u8> {
        let mut noise = 7_u32;
        (0..width * height)
            .map(|i| {
                noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                let (x, y) = ((i % width) as f64, (i / width) as f64);
                let wave = 60.0 * (0.4 * x).sin() * (0.02 * x * y).cos();
                let step = if (x - 70.0).hypot(y - 50.0) < 30.0 { 80.0 } else { 0.0 };
                (60.0 + wave + step + f64::from(noise >> 24) / 16.0).clamp(0.0, 255.0) as u8
            })
            .collect()
    }

    #[test]
    fn the_result_is_that_of_an_encoder_and_a_decoder() {
        let (width, height) = (141, 99);
        let pixels = picture(width, height);
        for quality in [30, 60, 75, 85, 92, 100] {
            let file = through_a_file(&pixels, width, quality);
            let mut own = pixels.clone();
            Jpeg::new(quality).apply(&mut own, width);
            assert_eq!(own.len(), file.len());
            let near = own.iter().zip(&file).filter(|(a, b)| a.abs_diff(**b) <= 1).count();
            // Encoders compute in whole numbers, so that now and then an amplitude half-way between two steps goes the other
            // way, which a block shows.
            assert!(near * 100 >= 90 * own.len(), "quality {quality}: {near} of {}", own.len());
            let [differs, loses, lost] =
                [rms(&own, &file), rms(&own, &pixels), rms(&file, &pixels)];
            println!("quality {quality}: {differs:.2} differ, {loses:.2} and {lost:.2} lost");
            assert!(differs < 0.35 * lost.max(1.2), "quality {quality}: {differs}, {lost}");
            assert!((loses - lost).abs() < 0.03 * lost.max(3.0), "{quality}: {loses}, {lost}");
        }
    }

    #[test]
    fn cosines_are_an_orthonormal_base() {
        let block: Block =
            std::array::from_fn(|y| std::array::from_fn(|x| ((x * 37 + y * 11) % 64) as f32));
        let amplitudes = cosines(&block);
        let energy = |block: &Block| block.iter().flatten().map(|v| v * v).sum::<f32>();
        assert!((energy(&amplitudes) / energy(&block) - 1.0).abs() < 1e-5);
        for (row, back) in block.iter().zip(values(&amplitudes)) {
            assert!(row.iter().zip(back).all(|(a, b)| (a - b).abs() < 1e-3));
        }
    }
}
