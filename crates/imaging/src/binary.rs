//! Binarises with an adaptive threshold: which pixels are dark and which are bright, one bit each.

use crate::kernels::{TILE, above, below, tile_extremes, with_vectors};
use crate::view::GrayView;

/// One bit for each pixel of an image, 64 in a word, surrounded by zeros.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct BitImage {
    /// A row of zeros, the rows, another row of zeros and a zero word. Each row begins with a zero word and
    /// ends with at least one zero bit.
    words: Vec<u64>,
    width: usize,
    height: usize,
    stride: usize,
}

impl BitImage {
    /// Takes a size; the bits inside are then undefined, those around zero.
    fn resize(&mut self, width: usize, height: usize) {
        let stride = (width + 1).div_ceil(64) + 1;
        if (self.width, self.height, self.stride) == (width, height, stride) {
            return;
        }
        (self.width, self.height, self.stride) = (width, height, stride);
        self.words.clear();
        self.words.resize(stride * (height + 2) + 1, 0);
    }

    /// Reserves memory for images of this size.
    pub(crate) fn make_room(&mut self, width: usize, height: usize) {
        let words = ((width + 1).div_ceil(64) + 1) * (height + 2) + 1;
        self.words.reserve(words.saturating_sub(self.words.len()));
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// The bit of a pixel; false outside the image.
    pub fn at(&self, x: i32, y: i32) -> bool {
        let inside = x >= 0 && y >= 0 && (x as usize) < self.width && (y as usize) < self.height;
        inside && self.bit(self.place(x as usize, y as usize))
    }

    /// Index of a pixel's bit.
    pub(crate) fn place(&self, x: usize, y: usize) -> usize {
        (y + 1) * self.row_bits() + 64 + x
    }

    /// Bits from row to row.
    pub(crate) fn row_bits(&self) -> usize {
        self.stride * 64
    }

    /// All words; [`BitImage::place`] is the index of a bit.
    pub(crate) fn bits(&self) -> &[u64] {
        &self.words
    }

    /// The bit of an index from [`BitImage::place`], or of a neighbour's.
    #[inline]
    pub(crate) fn bit(&self, place: usize) -> bool {
        self.words.get(place >> 6).is_some_and(|word| word >> (place & 63) & 1 == 1)
    }

    /// The words of row `y` and a zero word; bit 0 of the first is pixel 0.
    pub(crate) fn row(&self, y: usize) -> &[u64] {
        &self.words[(y + 1) * self.stride + 1..][..self.stride]
    }

    /// The words of the row above row `y`, zeros for row 0, and a zero word.
    pub(crate) fn row_above(&self, y: usize) -> &[u64] {
        &self.words[y * self.stride + 1..][..self.stride]
    }

    fn row_mut(&mut self, y: usize) -> &mut [u64] {
        &mut self.words[(y + 1) * self.stride + 1..][..self.stride - 1]
    }
}

/// Where the threshold lies between the darkest and the brightest pixel of a neighbourhood.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Middle {
    /// This many 256ths of the range above the darkest. 128 keeps dark and bright lines whole that are hardly
    /// wider than a pixel.
    Share(u8),
    /// The geometric mean. At a shadow's edge, white paper in the shade stays above it and black ink in the
    /// sun below, as ink reflects a smaller fraction of the light than shade leaves.
    Ratio,
}

/// The dark and the bright pixels.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Contrast {
    /// The threshold.
    pub middle: Middle,
    /// Minimum range of grey levels; below it pixels are neither dark nor bright. Above the noise.
    pub min_levels: u8,
    /// Minimum range as a fraction of the brightest, in percent.
    pub min_percent: u8,
}

/// Classifies pixels as dark or bright by their neighbourhood: tiles of 4 x 4 pixels with their eight
/// neighbours (Wang and Olson, "AprilTag 2", 2016). Where the contrast is too small they are neither.
#[derive(Clone, Debug, Default)]
pub struct Binarizer {
    columns: usize,
    low: Vec<u8>,
    high: Vec<u8>,
    /// The same, with the tiles to the left and right.
    wide_low: Vec<u8>,
    wide_high: Vec<u8>,
    /// Dark pixels are below it; 0 where the contrast is too small.
    thresholds: Vec<u8>,
    /// Darkest and brightest of a tile and its neighbours.
    extremes: Vec<[u8; 2]>,
    row: Vec<u8>,
}

impl Binarizer {
    /// Reserves memory for images of this size.
    pub(crate) fn make_room(&mut self, width: usize, height: usize) {
        fn reserve<T>(list: &mut Vec<T>, count: usize) {
            list.reserve(count.saturating_sub(list.len()));
        }
        let tiles = width.div_ceil(TILE) * height.div_ceil(TILE);
        for buffer in [&mut self.low, &mut self.high, &mut self.wide_low, &mut self.wide_high] {
            reserve(buffer, tiles);
        }
        reserve(&mut self.thresholds, tiles);
        reserve(&mut self.extremes, tiles);
        reserve(&mut self.row, width.next_multiple_of(TILE));
    }

    /// Writes which pixels of the image that was measured last are dark and which are bright, or one of both.
    pub fn apply(
        &mut self,
        view: GrayView<'_>,
        contrast: Contrast,
        mut dark: Option<&mut BitImage>,
        mut bright: Option<&mut BitImage>,
    ) {
        with_vectors(|| self.decide(contrast, view.height().div_ceil(TILE)));
        let (width, height) = (view.width(), view.height());
        for bits in [dark.as_deref_mut(), bright.as_deref_mut()].into_iter().flatten() {
            bits.resize(width, height);
        }
        self.row.resize(self.columns * TILE, 0);
        for (index, tiles) in self.thresholds.chunks(self.columns).enumerate() {
            let rows = index * TILE..((index + 1) * TILE).min(height);
            if let Some(dark) = dark.as_deref_mut() {
                expand(tiles, &mut self.row, |threshold| threshold);
                for y in rows.clone() {
                    below(view.row(y), &self.row[..width], dark.row_mut(y));
                }
            }
            if let Some(bright) = bright.as_deref_mut() {
                // Nothing is above 255: 0 wraps to it where the contrast is too small.
                expand(tiles, &mut self.row, |threshold| threshold.wrapping_sub(1));
                for y in rows {
                    above(view.row(y), &self.row[..width], bright.row_mut(y));
                }
            }
        }
    }

    /// The threshold at a pixel of the last image: dark pixels are below it, bright ones not. 0 where the
    /// contrast is too small, and outside.
    pub fn threshold(&self, x: usize, y: usize) -> u8 {
        self.of_tile(&self.thresholds, x, y)
    }

    /// The darkest and the brightest pixel of the neighbourhood.
    pub fn extremes(&self, x: usize, y: usize) -> [u8; 2] {
        self.of_tile(&self.extremes, x, y)
    }

    #[inline]
    fn of_tile<T: Copy + Default>(&self, values: &[T], x: usize, y: usize) -> T {
        let inside = x / TILE < self.columns;
        let at = y / TILE * self.columns + x / TILE;
        values.get(at).copied().filter(|_| inside).unwrap_or_default()
    }

    /// Measures an image: the darkest and the brightest pixel of each tile, alone and with the tiles to its left and right.
    pub fn measure(&mut self, view: GrayView<'_>) {
        self.columns = view.width().div_ceil(TILE);
        let count = self.columns * view.height().div_ceil(TILE);
        for buffer in [&mut self.low, &mut self.high, &mut self.wide_low, &mut self.wide_high] {
            buffer.resize(count, 0);
        }
        self.thresholds.resize(count, 0);
        self.extremes.resize(count, [0, 0]);
        let rows = self.low.chunks_mut(self.columns).zip(self.high.chunks_mut(self.columns));
        for (index, (low, high)) in rows.enumerate() {
            // Where fewer than four rows are left, the last one is repeated.
            let rows = [0, 1, 2, 3].map(|i| view.row((index * TILE + i).min(view.height() - 1)));
            tile_extremes(&rows, low, high);
        }
        with_vectors(|| self.widen());
    }

    /// Extremes of each tile and the ones to its left and right.
    #[inline(always)]
    fn widen(&mut self) {
        let n = self.columns;
        let rows = self.low.chunks(n).zip(self.wide_low.chunks_mut(n));
        rows.for_each(|(from, to)| spread(from, to, u8::min));
        let rows = self.high.chunks(n).zip(self.wide_high.chunks_mut(n));
        rows.for_each(|(from, to)| spread(from, to, u8::max));
    }

    #[inline(always)]
    fn decide(&mut self, contrast: Contrast, rows: usize) {
        let n = self.columns;
        for y in 0..rows {
            let near = [y.saturating_sub(1), y, (y + 1).min(rows - 1)];
            let [a, b, c] = near.map(|y| &self.wide_low[y * n..][..n]);
            let [d, e, f] = near.map(|y| &self.wide_high[y * n..][..n]);
            let out = &mut self.thresholds[y * n..][..n];
            let extremes = &mut self.extremes[y * n..][..n];
            // One loop each, so that each runs on many tiles at a time.
            match contrast.middle {
                Middle::Share(share) => {
                    for x in 0..n {
                        let low = a[x].min(b[x]).min(c[x]);
                        let high = d[x].max(e[x]).max(f[x]);
                        extremes[x] = [low, high];
                        out[x] = contrast.gate(low, high, between(low, high, share));
                    }
                }
                Middle::Ratio => {
                    for x in 0..n {
                        let low = a[x].min(b[x]).min(c[x]);
                        let high = d[x].max(e[x]).max(f[x]);
                        extremes[x] = [low, high];
                        out[x] = contrast.gate(low, high, mean_by_ratio(low, high));
                    }
                }
            }
        }
    }
}

impl Contrast {
    /// The threshold, or 0 where the contrast is too small.
    #[inline(always)]
    fn gate(&self, low: u8, high: u8, threshold: u8) -> u8 {
        let difference = high.saturating_sub(low);
        let share =
            100 * u16::from(difference) >= u16::from(self.min_percent.min(100)) * u16::from(high);
        if difference >= self.min_levels.max(1) && share { threshold } else { 0 }
    }
}

/// Each value with its two neighbours.
#[inline(always)]
pub(crate) fn spread(from: &[u8], to: &mut [u8], wider: impl Fn(u8, u8) -> u8) {
    to.copy_from_slice(from);
    let n = from.len();
    for (to, left) in to[1.min(n)..].iter_mut().zip(from) {
        *to = wider(*to, *left);
    }
    for (to, right) in to.iter_mut().zip(&from[1.min(n)..]) {
        *to = wider(*to, *right);
    }
}

/// Above `low` unless both are the same.
#[inline(always)]
fn between(low: u8, high: u8, share: u8) -> u8 {
    let up = u16::from(high.saturating_sub(low)) * u16::from(share);
    low + ((up + 255) >> 8) as u8
}

/// Above `low` unless both are the same. An offset for stray light keeps the darkest pixels from dominating.
#[inline(always)]
fn mean_by_ratio(low: u8, high: u8) -> u8 {
    const STRAY_LIGHT: f32 = 4.0;
    let mean =
        ((f32::from(low) + STRAY_LIGHT) * (f32::from(high) + STRAY_LIGHT)).sqrt() - STRAY_LIGHT;
    (mean + 0.999) as u8
}

/// Writes each tile's value once for each of its columns.
fn expand(tiles: &[u8], row: &mut [u8], value: impl Fn(u8) -> u8) {
    for (pixels, tile) in row.chunks_exact_mut(TILE).zip(tiles) {
        pixels.copy_from_slice(&[value(*tile); TILE]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const PLAIN: Contrast = Contrast { middle: Middle::Share(128), min_levels: 10, min_percent: 0 };

    fn apply(data: &[u8], width: usize, contrast: Contrast) -> (BitImage, BitImage) {
        let view = GrayView::packed(data, width, data.len() / width).unwrap();
        let (mut dark, mut bright) = (BitImage::default(), BitImage::default());
        let mut binarizer = Binarizer::default();
        binarizer.measure(view);
        binarizer.apply(view, contrast, Some(&mut dark), Some(&mut bright));
        (dark, bright)
    }

    #[test]
    fn a_plain_surface_is_neither_dark_nor_bright() {
        let data: Vec<u8> = (0..64 * 64).map(|i| 100 + (i * 7 % 9) as u8).collect();
        let (dark, bright) = apply(&data, 64, PLAIN);
        let all = (0..64).flat_map(|y| (0..64).map(move |x| (x, y)));
        assert!(all.clone().all(|(x, y)| !dark.at(x, y) && !bright.at(x, y)));
        assert!(!dark.at(-1, 0) && !dark.at(0, 64) && !dark.at(i32::MAX, i32::MIN));
    }

    #[test]
    fn the_geometric_mean_separates_ink_and_paper_across_a_shadow() {
        // Paper 200 and ink 30 in the sun, a quarter of that in the shade that begins in column 16.
        let shade = |x: i32, value: u8| if x >= 16 { value / 4 } else { value };
        let ink = |x: i32, y: i32| (x / 6 + y / 6) % 2 == 0;
        let grey = |x: i32, y: i32| shade(x, if ink(x, y) { 30 } else { 200 });
        let data: Vec<u8> = (0..32 * 32).map(|i| grey(i % 32, i / 32)).collect();
        let ratio = Contrast { middle: Middle::Ratio, ..PLAIN };
        let (dark, bright) = apply(&data, 32, ratio);
        let all = || (0..32).flat_map(|y| (0..32).map(move |x| (x, y)));
        assert!(all().all(|(x, y)| dark.at(x, y) == ink(x, y) && bright.at(x, y) != ink(x, y)));
        let (dark, _) = apply(&data, 32, PLAIN);
        assert!(all().any(|(x, y)| dark.at(x, y) != ink(x, y)));
    }

    proptest! {
        #[test]
        fn each_pixel_is_on_its_side_of_the_threshold(
            (width, data) in (1_usize..90).prop_flat_map(|w| {
                (Just(w), (1_usize..20).prop_flat_map(move |h| prop::collection::vec(any::<u8>(), w * h)))
            }),
            ratio in any::<bool>(),
        ) {
            let middle = if ratio { Middle::Ratio } else { Middle::Share(140) };
            let contrast = Contrast { middle, min_levels: 40, min_percent: 30 };
            let view = GrayView::packed(&data, width, data.len() / width).unwrap();
            let (mut dark, mut bright) = (BitImage::default(), BitImage::default());
            let mut binarizer = Binarizer::default();
            binarizer.measure(view);
            binarizer.apply(view, contrast, Some(&mut dark), Some(&mut bright));
            for y in 0..view.height() {
                for x in 0..width {
                    let near = |x: usize, edge: usize| {
                        let tile = x / TILE * TILE;
                        tile.saturating_sub(TILE)..(tile + 2 * TILE).min(edge)
                    };
                    let around = near(y, view.height())
                        .flat_map(|y| near(x, width).map(move |x| view.at(x, y)));
                    let low = around.clone().min().unwrap();
                    let high = around.max().unwrap();
                    let threshold = binarizer.threshold(x, y);
                    let enough = high - low >= 40 && 10 * (high as u32 - low as u32) >= 3 * high as u32;
                    prop_assert_eq!(threshold != 0, enough);
                    prop_assert!(!enough || (low < threshold && threshold <= high));
                    let (x, y, grey) = (x as i32, y as i32, view.at(x, y));
                    prop_assert_eq!(dark.at(x, y), enough && grey < threshold);
                    prop_assert_eq!(bright.at(x, y), enough && grey >= threshold);
                }
            }
        }
    }
}
