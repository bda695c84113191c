//! Measures brightness and noise of recorded pictures: detectors do not publish whether a camera saw anything.

use airlink::Unpacker;
use imaging::{Converter, GrayView};
use messages::{FrameHeader, PixelFormat};

/// Every so many rows and columns are counted.
const STEP: usize = 4;
/// Fraction of the pixels that are brighter than [`Brightness::brightest`].
const BRIGHTEST: f64 = 0.01;

/// How bright a picture is, from 0, black, to 1, white.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Brightness {
    /// Mean of its pixels.
    pub mean: f64,
    /// The 99th percentile of its pixels.
    pub brightest: f64,
    /// Standard deviation of the noise from pixel to pixel, in the same unit.
    pub noise: f64,
}

/// Reads pictures.
#[derive(Default)]
pub struct Meter {
    converter: Converter,
    unpacker: Unpacker,
}

impl Meter {
    /// How bright a picture is; `None` when it cannot be read. Of one that is sent in parts the largest part of the frame counts.
    pub fn measure(&mut self, header: &FrameHeader, bytes: &[u8]) -> Option<Brightness> {
        let FrameHeader { width, height, format, .. } = *header;
        if format == PixelFormat::Jpeg {
            let parts = self.unpacker.unpack(header, bytes).ok()?;
            let (_, largest) = parts.into_iter().max_by_key(|(part, _)| {
                let across = |pixels: u32| u64::from(pixels) * u64::from(part.scale);
                across(part.width) * across(part.height)
            })?;
            return brightness(largest.view()?);
        }
        let format = format.sample_format()?;
        brightness(self.converter.convert(bytes, width as usize, height as usize, format).ok()?)
    }
}

fn brightness(view: GrayView<'_>) -> Option<Brightness> {
    let mut counts = [0_u32; 256];
    for y in (0..view.height()).step_by(STEP) {
        for level in view.row(y).iter().step_by(STEP) {
            if let Some(count) = counts.get_mut(usize::from(*level)) {
                *count += 1;
            }
        }
    }
    let levels =
        || counts.iter().enumerate().map(|(level, count)| (level as f64, f64::from(*count)));
    let all: f64 = levels().map(|(_, count)| count).sum();
    let mut brighter = 0.0;
    let brightest = levels().rev().find(|(_, count)| {
        brighter += count;
        brighter >= BRIGHTEST * all
    });
    let sum: f64 = levels().map(|(level, count)| level * count).sum();
    let (level, _) = brightest.filter(|_| all > 0.0)?;
    Some(Brightness { mean: sum / all / 255.0, brightest: level / 255.0, noise: noise(view)? })
}

/// Standard deviation of the noise, from 0 to 1: the difference of two second differences across each other contains no edges and
/// slopes (J. Immerkaer, "Fast Noise Variance Estimation", 1996), and the median of its size little of a fine texture. Every second
/// pixel counts: a camera's colour mosaic, its denoising and JPEG make the noise of neighbours alike.
fn noise(view: GrayView<'_>) -> Option<f64> {
    /// The mask's output deviation for a deviation of 1.
    const MASK: f64 = 6.0;
    /// Median of the size of a normal deviate.
    const MEDIAN: f64 = 0.6745;
    /// The largest sum.
    const LARGEST: usize = 8 * 255;
    let mut counts = vec![0_u32; LARGEST + 1];
    for y in (2..view.height().saturating_sub(2)).step_by(STEP) {
        let rows = [view.row(y - 2), view.row(y), view.row(y + 2)];
        let [above, own, below] = rows.map(|row| row.windows(5).step_by(STEP));
        for ((above, own), below) in above.zip(own).zip(below) {
            let across = |row: &[u8]| match *row {
                [left, _, middle, _, right] => {
                    i32::from(left) - 2 * i32::from(middle) + i32::from(right)
                }
                _ => 0,
            };
            let sum = (across(above) - 2 * across(own) + across(below)).unsigned_abs() as usize;
            if let Some(count) = counts.get_mut(sum) {
                *count += 1;
            }
        }
    }
    let all: u32 = counts.iter().sum();
    let mut so_far = 0;
    let median = counts.iter().position(|count| {
        so_far += count;
        2 * so_far >= all
    })?;
    Some(median as f64 / MEDIAN / MASK / 255.0)
}

#[cfg(test)]
mod tests {
    use airlink::picture::jpeg;

    use super::*;

    #[test]
    fn a_picture_has_a_mean_and_a_brightest_part() {
        let header = FrameHeader { width: 64, height: 64, ..FrameHeader::sample() };
        let mut pixels = vec![51; 64 * 64];
        // A sixteenth is white.
        pixels[..256].fill(255);
        let kept = jpeg(&header, &pixels, 90).unwrap();
        let of_jpeg = FrameHeader { format: PixelFormat::Jpeg, ..header.clone() };
        for (header, bytes) in [(&header, &pixels), (&of_jpeg, &kept)] {
            let Brightness { mean, brightest, noise } =
                Meter::default().measure(header, bytes).unwrap();
            assert!((mean - (0.2 + 0.8 / 16.0)).abs() < 0.01, "{mean}");
            assert!((brightest - 1.0).abs() < 0.03, "{brightest}");
            assert!(noise < 0.01, "{noise}");
        }
        // Uniform noise over 61 levels has a deviation of 17.6 of them.
        let noisy: Vec<u8> =
            (0..64 * 64_u32).map(|i| (90 + i.wrapping_mul(2_654_435_761) % 61) as u8).collect();
        let Brightness { noise, .. } = Meter::default().measure(&header, &noisy).unwrap();
        assert!((noise - 17.6 / 255.0).abs() < 0.03, "{noise}");
        assert_eq!(Meter::default().measure(&header, &[1, 2]), None);
        assert_eq!(Meter::default().measure(&of_jpeg, &[1, 2]), None);
    }
}
