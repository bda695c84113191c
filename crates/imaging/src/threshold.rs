//! From grey to black and white.

use crate::view::{GrayImage, GrayView};

/// Binarises with one threshold (Equation 3.3 with M = 255): 255 where the pixel is at least `threshold`, else 0.
///
/// OpenCV's `threshold` asks for more than its threshold, so its T is one less.
pub fn threshold(view: GrayView<'_>, threshold: u8, out: &mut GrayImage) {
    out.resize(view.width(), view.height());
    for y in 0..view.height() {
        for (to, from) in out.row_mut(y).iter_mut().zip(view.row(y)) {
            *to = if *from >= threshold { 255 } else { 0 };
        }
    }
}

/// Edge of the smallest tile, in pixels.
const TILE: usize = 4;

/// Binarises with a threshold that follows the light.
///
/// Each tile's threshold lies between the darkest and the brightest pixel of the tile and its eight neighbours, in
/// the middle by ratio and not by difference: so white paper in shade stays brighter than it while black ink in the
/// sun, across the shadow's edge, stays darker. Where the two differ by less than a least contrast, the tile takes the threshold of the tile of
/// twice the size that contains it. So an edge is found at its own brightness, in shade or sun, sharp or
/// blurred, and a plain surface takes the side it has on the scale on which there is something to see.
/// The dark side is the white one of the result: of contours, thin dark lines on bright ground then stay whole.
#[derive(Clone, Debug, Default)]
pub struct LocalThreshold {
    levels: Vec<Level>,
    row: Vec<u8>,
    columns: [Vec<u8>; 2],
    spread: Vec<[u8; 2]>,
}

/// What differences in brightness count as edges.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct LeastContrast {
    /// At least this many grey levels, which noise does not reach.
    pub levels: u8,
    /// At least this share of the brighter side: ink on paper keeps its ratio in any light.
    pub percent: u8,
}

impl LeastContrast {
    fn is_met(self, min: u8, max: u8) -> bool {
        let difference = u32::from(max.saturating_sub(min));
        difference >= u32::from(self.levels)
            && 100 * difference >= u32::from(self.percent) * u32::from(max)
    }
}

/// The tiles of one size.
#[derive(Clone, Debug, Default)]
struct Level {
    width: usize,
    height: usize,
    /// Darkest and brightest pixel of each tile.
    extremes: Vec<[u8; 2]>,
    thresholds: Vec<u8>,
}

impl LocalThreshold {
    /// Writes 255 where the pixel is darker than its tile's threshold, else 0.
    pub fn apply(&mut self, view: GrayView<'_>, least: LeastContrast, out: &mut GrayImage) {
        let count = self.measure(view);
        for index in (0..count).rev() {
            let (fine, coarse) = self.levels.split_at_mut(index + 1);
            if let Some(level) = fine.last_mut() {
                level.decide(coarse.first().filter(|_| index + 1 < count), least, &mut self.spread);
            }
        }
        self.binarise(view, out);
    }

    /// Fills the extremes of all levels; returns how many levels this image has.
    fn measure(&mut self, view: GrayView<'_>) -> usize {
        if self.levels.is_empty() {
            self.levels.push(Level::default());
        }
        self.levels[0].measure_pixels(view, &mut self.columns);
        let mut count = 1;
        while self.levels[count - 1].width > 1 || self.levels[count - 1].height > 1 {
            if self.levels.len() == count {
                self.levels.push(Level::default());
            }
            let (fine, coarse) = self.levels.split_at_mut(count);
            if let (Some(fine), Some(coarse)) = (fine.last(), coarse.first_mut()) {
                coarse.measure_tiles(fine);
            }
            count += 1;
        }
        count
    }

    fn binarise(&mut self, view: GrayView<'_>, out: &mut GrayImage) {
        out.resize(view.width(), view.height());
        let level = &self.levels[0];
        self.row.resize(view.width(), 0);
        for y in 0..view.height() {
            if y % TILE == 0 {
                let thresholds = &level.thresholds[y / TILE * level.width..];
                for (pixels, threshold) in self.row.chunks_mut(TILE).zip(thresholds) {
                    pixels.fill(*threshold);
                }
            }
            for ((to, from), threshold) in out.row_mut(y).iter_mut().zip(view.row(y)).zip(&self.row)
            {
                *to = if from < threshold { 255 } else { 0 };
            }
        }
    }
}

impl Level {
    fn resize(&mut self, width: usize, height: usize) {
        (self.width, self.height) = (width, height);
        self.extremes.clear();
        self.extremes.resize(width * height, [255, 0]);
        self.thresholds.resize(width * height, 0);
    }

    fn measure_pixels(&mut self, view: GrayView<'_>, columns: &mut [Vec<u8>; 2]) {
        self.resize(view.width().div_ceil(TILE), view.height().div_ceil(TILE));
        let [lows, highs] = columns;
        for (index, tiles) in self.extremes.chunks_mut(self.width).enumerate() {
            let rows = index * TILE..((index + 1) * TILE).min(view.height());
            lows.clear();
            lows.resize(view.width(), 255);
            highs.clear();
            highs.resize(view.width(), 0);
            // Down the columns first: many at a time.
            for y in rows {
                for ((low, high), pixel) in lows.iter_mut().zip(highs.iter_mut()).zip(view.row(y)) {
                    *low = (*low).min(*pixel);
                    *high = (*high).max(*pixel);
                }
            }
            for ((tile, lows), highs) in
                tiles.iter_mut().zip(lows.chunks(TILE)).zip(highs.chunks(TILE))
            {
                let low = lows.iter().copied().fold(255, u8::min);
                let high = highs.iter().copied().fold(0, u8::max);
                *tile = [low, high];
            }
        }
    }

    fn measure_tiles(&mut self, fine: &Self) {
        self.resize(fine.width.div_ceil(2), fine.height.div_ceil(2));
        for (y, row) in fine.extremes.chunks(fine.width).enumerate() {
            let tiles = &mut self.extremes[y / 2 * self.width..];
            for (tile, pair) in tiles.iter_mut().zip(row.chunks(2)) {
                for [min, max] in pair {
                    tile[0] = tile[0].min(*min);
                    tile[1] = tile[1].max(*max);
                }
            }
        }
    }

    fn decide(&mut self, coarse: Option<&Self>, least: LeastContrast, spread: &mut Vec<[u8; 2]>) {
        for y in 0..self.height {
            // Over the three rows, then over three columns.
            let row = |y: usize| &self.extremes[y * self.width..][..self.width];
            spread.clear();
            spread.extend_from_slice(row(y));
            for near in [y.saturating_sub(1), (y + 1).min(self.height - 1)] {
                for (tile, other) in spread.iter_mut().zip(row(near)) {
                    *tile = wider(*tile, *other);
                }
            }
            for x in 0..self.width {
                let right = (x + 1).min(self.width - 1);
                let [min, max] =
                    wider(wider(spread[x.saturating_sub(1)], spread[x]), spread[right]);
                self.thresholds[y * self.width + x] = match coarse {
                    Some(coarse) if !least.is_met(min, max) => {
                        coarse.thresholds[y / 2 * coarse.width + x / 2]
                    }
                    _ => middle_by_ratio(min, max),
                };
            }
        }
    }
}

/// The extremes of two tiles together.
fn wider(a: [u8; 2], b: [u8; 2]) -> [u8; 2] {
    [a[0].min(b[0]), a[1].max(b[1])]
}

/// The grey value as many times brighter than `min` as it is darker than `max`, and above `min` unless both are the
/// same. What the lens scatters into the dark is allowed for, or else the darkest pixels would decide alone.
fn middle_by_ratio(min: u8, max: u8) -> u8 {
    const SCATTERED: f32 = 10.0;
    let product = (f32::from(min) + SCATTERED) * (f32::from(max) + SCATTERED);
    let middle = (product.sqrt() - SCATTERED) as u8;
    middle.clamp(min.saturating_add(1).min(max), max.max(min))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pixel_at_the_threshold_is_white() {
        let view = GrayView::packed(&[69, 70, 71], 3, 1).unwrap();
        let mut out = GrayImage::default();
        threshold(view, 70, &mut out);
        assert_eq!(out.pixels(), [0, 255, 255]);
    }

    /// A dark disc on bright ground whose light falls from 250 on the left to a tenth of that on the right.
    #[test]
    fn dark_stays_dark_in_sun_and_shade() {
        let (width, height) = (400, 100);
        let dark = |x: usize, y: usize| {
            [80_usize, 300].iter().any(|cx| x.abs_diff(*cx) < 25 && y.abs_diff(50) < 25)
        };
        let data: Vec<u8> = (0..width * height)
            .map(|i| {
                let (x, y) = (i % width, i / width);
                let light = 250.0 - 225.0 * x as f64 / width as f64;
                (light * if dark(x, y) { 0.2 } else { 1.0 }) as u8
            })
            .collect();
        let mut out = GrayImage::default();
        let view = GrayView::packed(&data, width, height).unwrap();
        LocalThreshold::default().apply(view, LeastContrast { levels: 16, percent: 20 }, &mut out);
        for cx in [80, 300] {
            // Just inside and just outside of the edges, all along them.
            for t in 30..70 {
                assert_eq!((out.row(t)[cx - 24], out.row(t)[cx - 25]), (255, 0));
                assert_eq!((out.row(26)[cx + t - 50], out.row(25)[cx + t - 50]), (255, 0));
            }
        }
    }

    #[test]
    fn odd_sizes_are_covered_to_the_last_pixel() {
        for (width, height) in [(1, 1), (1, 7), (9, 1), (5, 5), (17, 3)] {
            let mut data = vec![10; width * height];
            if let Some(last) = data.last_mut() {
                *last = 200;
            }
            let mut out = GrayImage::default();
            let view = GrayView::packed(&data, width, height).unwrap();
            LocalThreshold::default().apply(
                view,
                LeastContrast { levels: 16, percent: 20 },
                &mut out,
            );
            assert_eq!(out.pixels().last(), Some(&0));
            assert_eq!(out.pixels().len(), width * height);
        }
    }
}
