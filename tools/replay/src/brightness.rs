//! How bright the recorded pictures are: whether a camera saw anything is not in what detectors publish.

use airlink::Unpacker;
use imaging::{Converter, GrayView};
use messages::{FrameHeader, PixelFormat};

/// Every so many rows and columns are counted.
const STEP: usize = 4;
/// Share of the pixels that are brighter than [`Brightness::brightest`].
const BRIGHTEST: f64 = 0.01;

/// How bright a picture is, from 0, black, to 1, white.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Brightness {
    /// Mean of its pixels.
    pub mean: f64,
    /// What the brightest hundredth of them reaches.
    pub brightest: f64,
}

/// Reads pictures.
#[derive(Default)]
pub struct Meter {
    converter: Converter,
    unpacker: Unpacker,
}

impl Meter {
    /// How bright a picture is; `None` when it cannot be read. Of one that came in parts the largest part of the frame counts.
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
    Some(Brightness { mean: sum / all / 255.0, brightest: level / 255.0 })
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
            let Brightness { mean, brightest } = Meter::default().measure(header, bytes).unwrap();
            assert!((mean - (0.2 + 0.8 / 16.0)).abs() < 0.01, "{mean}");
            assert!((brightest - 1.0).abs() < 0.03, "{brightest}");
        }
        assert_eq!(Meter::default().measure(&header, &[1, 2]), None);
        assert_eq!(Meter::default().measure(&of_jpeg, &[1, 2]), None);
    }
}
