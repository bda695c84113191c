//! Converts raw images (more than 8 bits, Bayer patterns) to 8-bit grey.

use crate::view::{GrayImage, GrayView, ViewError};

/// The layout of the samples of a raw image, row by row without gaps.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct SampleFormat {
    /// Significant bits: up to 8 in one byte per pixel, up to 16 in two, the low byte first.
    pub bits: u32,
    /// The Bayer pattern; `None` for a grey sensor.
    pub bayer: Option<BayerPattern>,
}

/// A Bayer pattern, named by its first two rows of two pixels.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum BayerPattern {
    /// Red, green; green, blue.
    Rggb,
    /// Green, red; blue, green.
    Grbg,
    /// Green, blue; red, green.
    Gbrg,
    /// Blue, green; green, red.
    Bggr,
}

/// The error for an invalid name of a Bayer pattern.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UnknownBayerPattern(String);

impl std::fmt::Display for UnknownBayerPattern {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "`{}` is not a Bayer pattern; it must be RGGB, GRBG, GBRG or BGGR", self.0)
    }
}

impl std::error::Error for UnknownBayerPattern {}

impl std::str::FromStr for BayerPattern {
    type Err = UnknownBayerPattern;

    /// Reads the colours of the first two rows of two pixels, as in `RGGB`.
    fn from_str(text: &str) -> Result<Self, UnknownBayerPattern> {
        match text.to_ascii_uppercase().as_str() {
            "RGGB" => Ok(Self::Rggb),
            "GRBG" => Ok(Self::Grbg),
            "GBRG" => Ok(Self::Gbrg),
            "BGGR" => Ok(Self::Bggr),
            _ => Err(UnknownBayerPattern(text.to_owned())),
        }
    }
}

/// Converts raw images to 8-bit grey. Its buffers are reused from image to image.
#[derive(Clone, Debug, Default)]
pub struct Converter {
    histogram: Vec<u32>,
    samples: GrayImage,
    gray: GrayImage,
}

/// Bins of the histogram that gives the range of grey levels.
const BINS: usize = 4096;
/// Share of the pixels, at either end, that count as defects of the sensor and do not set the range.
const OUTLIERS: f64 = 2e-5;
/// Minimum range of levels mapped to 8 bits, so that noise is not amplified.
const MIN_RANGE: u32 = 255;

impl Converter {
    /// An image in 8-bit grey; the image itself when it is that already.
    ///
    /// More than 8 bits are scaled linearly, which leaves edges where they are, so that all levels but for
    /// outliers fit. Behind a Bayer pattern, missing green is interpolated along edges with the other
    /// colour's curvature as a correction (Hamilton and Adams, US patent 5629734, expired); black and white
    /// stay sharp and colours make no pattern.
    ///
    /// # Errors
    /// [`ViewError`] when the size is zero or too large, or there are too few bytes.
    pub fn convert<'a>(
        &'a mut self,
        data: &'a [u8],
        width: usize,
        height: usize,
        format: SampleFormat,
    ) -> Result<GrayView<'a>, ViewError> {
        let is_wide = format.bits > 8;
        let bytes_wide = if is_wide { width.saturating_mul(2) } else { width };
        // The size in bytes, and then the size in pixels.
        let needed = bytes_wide.saturating_mul(height);
        if data.len() < needed {
            return Err(ViewError::Length { len: data.len(), needed });
        }
        let plain = GrayView::packed(data, width, height)?;
        let view = if is_wide {
            let (pairs, _) = data[..needed].as_chunks::<2>();
            self.scale(pairs, width, height, format.bits.min(16));
            GrayView::packed(self.samples.pixels(), width, height)?
        } else {
            plain
        };
        match format.bayer {
            None => Ok(view),
            Some(pattern) => {
                demosaic(view, pattern, &mut self.gray);
                GrayView::packed(self.gray.pixels(), width, height)
            }
        }
    }

    /// Scales samples of two bytes so that their range fills 8 bits.
    fn scale(&mut self, pairs: &[[u8; 2]], width: usize, height: usize, bits: u32) {
        let [low, high] = self.range(pairs, bits);
        let span = (high - low).max(MIN_RANGE);
        // 255 / span with 16 fractional bits, rounded.
        let factor = ((255 << 16) + span / 2) / span;
        self.samples.resize(width, height);
        for (to, from) in self.samples.pixels_mut().iter_mut().zip(pairs) {
            let value = u32::from(u16::from_le_bytes(*from)).clamp(low, high) - low;
            *to = ((value.min(span) * factor + (1 << 15)) >> 16) as u8;
        }
    }

    /// The lowest and the highest level without outliers.
    fn range(&mut self, pairs: &[[u8; 2]], bits: u32) -> [u32; 2] {
        let shift = bits.saturating_sub(BINS.ilog2());
        let top = (1_u32 << bits) - 1;
        self.histogram.clear();
        self.histogram.resize(BINS, 0);
        for pair in pairs {
            let level = u32::from(u16::from_le_bytes(*pair)).min(top);
            if let Some(bin) = self.histogram.get_mut((level >> shift) as usize) {
                *bin += 1;
            }
        }
        let outliers = (pairs.len() as f64 * OUTLIERS) as u32;
        let beyond = |bins: &mut dyn Iterator<Item = &u32>| {
            let mut left = outliers;
            bins.take_while(|count| {
                let is_outlier = **count <= left;
                left = left.saturating_sub(**count);
                is_outlier
            })
            .count() as u32
        };
        let bins = BINS as u32;
        let low = beyond(&mut self.histogram.iter()).min(bins - 1);
        let high = bins.saturating_sub(beyond(&mut self.histogram.iter().rev())).max(low + 1);
        [low << shift, ((high << shift) - 1).min(top)]
    }
}

/// The green channel at every pixel of a Bayer image.
fn demosaic(view: GrayView<'_>, pattern: BayerPattern, out: &mut GrayImage) {
    let (width, height) = (view.width(), view.height());
    out.resize(width, height);
    // The parity of the columns of green in the first row.
    let green = match pattern {
        BayerPattern::Rggb | BayerPattern::Bggr => 1,
        BayerPattern::Grbg | BayerPattern::Gbrg => 0,
    };
    let balance = balance(view, green);
    for y in 0..height {
        let rows = [-2, -1, 0, 1, 2].map(|dy| view.row(mirrored(y, dy, height)));
        let first_other = (green + y + 1) % 2;
        let row = out.row_mut(y);
        row.copy_from_slice(rows[2]);
        let inner = first_other + 2..width.saturating_sub(2);
        for x in (first_other..width).step_by(2) {
            let near = if inner.contains(&x) {
                Neighbours::inside(&rows, x)
            } else {
                Neighbours::at_border(&rows, x, width)
            };
            row[x] = near.green(balance[y % 2]);
        }
    }
}

/// The place `offset` pixels on, mirrored at the image's borders, which keeps its colour.
fn mirrored(at: usize, offset: isize, len: usize) -> usize {
    let last = len as isize - 1;
    let place = at as isize + offset;
    let folded = if place < 0 {
        -place
    } else if place > last {
        2 * last - place
    } else {
        place
    };
    folded.clamp(0, last) as usize
}

/// By how much the red or blue pixels of even and of odd rows differ less than green ones do, in 256ths: the
/// curvature of a darker channel is smaller by its part of the light.
fn balance(view: GrayView<'_>, green: usize) -> [i32; 2] {
    [0, 1].map(|parity| {
        let (mut greens, mut others) = (0_u64, 0_u64);
        // A few rows suffice.
        for y in (parity..view.height()).step_by(16) {
            let (pairs, _) = view.row(y).as_chunks::<2>();
            let even: u64 = pairs.iter().map(|[even, _]| u64::from(*even)).sum();
            let odd: u64 = pairs.iter().map(|[_, odd]| u64::from(*odd)).sum();
            let green_is_odd = (green + y) % 2 == 1;
            greens += if green_is_odd { odd } else { even };
            others += if green_is_odd { even } else { odd };
        }
        ((greens + 1) * 256 / (others + 1)).clamp(128, 1024) as i32
    })
}

/// The pixels about a red or blue one: of its own colour two steps away, and green ones next to it.
struct Neighbours {
    here: i32,
    /// Left, right, above, below.
    greens: [i32; 4],
    /// The same.
    own: [i32; 4],
}

impl Neighbours {
    #[inline]
    fn inside(rows: &[&[u8]; 5], x: usize) -> Self {
        let at = |row: usize, column: usize| i32::from(rows[row][column]);
        Self {
            here: at(2, x),
            greens: [at(2, x - 1), at(2, x + 1), at(1, x), at(3, x)],
            own: [at(2, x - 2), at(2, x + 2), at(0, x), at(4, x)],
        }
    }

    fn at_border(rows: &[&[u8]; 5], x: usize, width: usize) -> Self {
        let at = |row: usize, offset: isize| i32::from(rows[row][mirrored(x, offset, width)]);
        Self {
            here: at(2, 0),
            greens: [at(2, -1), at(2, 1), at(1, 0), at(3, 0)],
            own: [at(2, -2), at(2, 2), at(0, 0), at(4, 0)],
        }
    }

    /// Green here: the mean of its neighbours in the direction in which the image changes less, corrected by
    /// the other colour's curvature; where it changes as much in both, the mean of both.
    #[inline]
    fn green(&self, balance: i32) -> u8 {
        let [left, right, above, below] = self.greens;
        let curvature = |a: i32, b: i32| (2 * self.here - a - b) * balance / 256;
        let across = curvature(self.own[0], self.own[1]);
        let along = curvature(self.own[2], self.own[3]);
        let change_across = (left - right).abs() + across.abs();
        let change_along = (above - below).abs() + along.abs();
        // Four times the value, to round once.
        let of_row = 2 * (left + right) + across;
        let of_column = 2 * (above + below) + along;
        let four_times = match change_across.cmp(&change_along) {
            std::cmp::Ordering::Less => of_row,
            std::cmp::Ordering::Greater => of_column,
            std::cmp::Ordering::Equal => (of_row + of_column) / 2,
        };
        ((four_times + 2) >> 2).clamp(0, 255) as u8
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const GREY: SampleFormat = SampleFormat { bits: 8, bayer: None };

    fn wide(levels: &[u16]) -> Vec<u8> {
        levels.iter().flat_map(|level| level.to_le_bytes()).collect()
    }

    #[test]
    fn eight_bits_are_left_where_they_are() {
        let data = [1, 2, 3, 4];
        let mut converter = Converter::default();
        let view = converter.convert(&data, 2, 2, GREY).unwrap();
        assert_eq!((view.row(0).as_ptr(), view.row(1)), (data.as_ptr(), &[3, 4][..]));
    }

    #[test]
    fn more_bits_are_scaled_to_the_range_they_use() {
        let mut converter = Converter::default();
        let mut scaled = |levels: &[u16], bits| {
            let format = SampleFormat { bits, bayer: None };
            converter.convert(&wide(levels), levels.len(), 1, format).unwrap().row(0).to_vec()
        };
        assert_eq!(scaled(&[0, 2048, 4095], 12), [0, 128, 255]);
        assert_eq!(scaled(&[1000, 1500, 2000], 12), [0, 128, 255]);
        assert_eq!(scaled(&[0, 0xffff], 16), [0, 255]);
        // Values beyond the bits saturate, and low contrast stays low.
        assert_eq!(scaled(&[0, 1023, 0xffff], 10), [0, 255, 255]);
        assert_eq!(scaled(&[500, 510, 500], 10), [0, 10, 0]);
    }

    #[test]
    fn single_faulty_pixels_do_not_set_the_range() {
        let mut levels = vec![400_u16; 100_000];
        levels[50_000..].fill(800);
        (levels[7], levels[99_999]) = (4095, 0);
        let format = SampleFormat { bits: 12, bayer: None };
        let mut converter = Converter::default();
        let data = wide(&levels);
        let view = converter.convert(&data, 1000, 100, format).unwrap();
        assert_eq!((view.at(0, 0), view.at(7, 0), view.at(500, 99)), (0, 255, 255));
    }

    #[test]
    fn bayer_patterns_are_named_by_their_colours() {
        assert_eq!("rggb".parse(), Ok(BayerPattern::Rggb));
        assert!("RGB".parse::<BayerPattern>().unwrap_err().to_string().contains("BGGR"));
    }

    #[test]
    fn wrong_sizes_are_refused() {
        let mut converter = Converter::default();
        let bits12 = SampleFormat { bits: 12, bayer: Some(BayerPattern::Rggb) };
        for (len, width, height, format) in
            [(0, 0, 0, GREY), (3, 2, 1, bits12), (9, usize::MAX, 3, bits12), (5, 2, 3, GREY)]
        {
            assert!(converter.convert(&vec![0; len], width, height, format).is_err());
        }
    }

    /// A slanted black edge on white paper through a Bayer pattern whose red is half, and whose blue a third
    /// as bright.
    fn slanted(x: usize, y: usize) -> f64 {
        let distance = (x as f64 - 20.0) * 0.94 + (y as f64 - 16.0) * 0.34;
        20.0 + 200.0 / (1.0 + (-2.5 * distance).exp())
    }

    fn colour_gain(pattern: BayerPattern, x: usize, y: usize) -> f64 {
        let names = match pattern {
            BayerPattern::Rggb => "RGGB",
            BayerPattern::Grbg => "GRBG",
            BayerPattern::Gbrg => "GBRG",
            BayerPattern::Bggr => "BGGR",
        };
        match names.as_bytes()[y % 2 * 2 + x % 2] {
            b'G' => 1.0,
            b'R' => 0.5,
            _ => 1.0 / 3.0,
        }
    }

    #[test]
    fn edges_stay_as_sharp_as_they_were_behind_every_bayer_pattern() {
        for pattern in
            [BayerPattern::Rggb, BayerPattern::Grbg, BayerPattern::Gbrg, BayerPattern::Bggr]
        {
            let (width, height) = (41, 33);
            let data: Vec<u8> = (0..width * height)
                .map(|i| (i % width, i / width))
                .map(|(x, y)| (slanted(x, y) * colour_gain(pattern, x, y)).round() as u8)
                .collect();
            let mut converter = Converter::default();
            let format = SampleFormat { bits: 8, bayer: Some(pattern) };
            let view = converter.convert(&data, width, height, format).unwrap();
            let error = |x: usize, y: usize| f64::from(view.at(x, y)) - slanted(x, y);
            let errors = (0..width * height).map(|i| error(i % width, i / width));
            let squares: f64 = errors.map(|e| e * e).sum();
            let rms = (squares / (width * height) as f64).sqrt();
            assert!(rms < 3.5, "{pattern:?}: {rms}");
        }
    }

    proptest! {
        #[test]
        fn no_bytes_make_it_panic(
            width in 0_usize..9, height in 0_usize..9, bits in 0_u32..20,
            data in prop::collection::vec(any::<u8>(), 0..200), pattern in 0_usize..5,
        ) {
            let patterns = [BayerPattern::Rggb, BayerPattern::Grbg, BayerPattern::Gbrg, BayerPattern::Bggr];
            let format = SampleFormat { bits, bayer: patterns.get(pattern).copied() };
            let mut converter = Converter::default();
            if let Ok(view) = converter.convert(&data, width, height, format) {
                prop_assert_eq!((view.width(), view.height()), (width, height));
            }
        }
    }
}
