//! Maps where an image has contrast between regions as wide as markers' parts: a texture of dots and blades averages out there,
//! paper and ink do not.

use crate::binary::spread;
use crate::kernels::with_vectors;
use crate::pyramid::Pyramid;
use crate::view::GrayView;

/// The level of the pyramid whose pixels are compared: means of 8 x 8 pixels.
const LEVEL: usize = 3;
/// Grey levels added to both sides of a ratio, as of stray light: the darkest pixels are mostly noise.
const STRAY_LIGHT: u8 = 4;

/// For each 8 x 8 pixels of an image how much brighter the brightest of their neighbourhood (24 x 24 pixels) is than the darkest.
/// It keeps its memory from image to image.
#[derive(Clone, Debug, Default)]
pub struct ContrastMap {
    columns: usize,
    percent: Vec<u8>,
    /// Working memory: darkest and brightest of each pixel and those to its left and right.
    low: Vec<u8>,
    high: Vec<u8>,
}

impl ContrastMap {
    /// Reserves memory for images of this size.
    pub fn make_room(&mut self, view: GrayView<'_>) {
        let count = (view.width() >> LEVEL) * (view.height() >> LEVEL);
        for list in [&mut self.percent, &mut self.low, &mut self.high] {
            list.reserve(count.saturating_sub(list.len()));
        }
    }

    /// Measures the image of which the pyramid was built; one too small for it has contrast everywhere.
    pub fn measure(&mut self, view: GrayView<'_>, pyramid: &Pyramid) {
        self.columns = 0;
        self.percent.clear();
        let Some(means) = pyramid.level(view, LEVEL) else { return };
        let (columns, rows) = (means.width(), means.height());
        self.columns = columns;
        for list in [&mut self.percent, &mut self.low, &mut self.high] {
            list.clear();
            list.resize(columns * rows, 0);
        }
        with_vectors(|| self.compare(means));
    }

    #[inline(always)]
    fn compare(&mut self, means: GrayView<'_>) {
        let (n, rows) = (means.width(), means.height());
        for y in 0..rows {
            spread(means.row(y), &mut self.low[y * n..][..n], u8::min);
            spread(means.row(y), &mut self.high[y * n..][..n], u8::max);
        }
        for y in 0..rows {
            let near = [y.saturating_sub(1), y, (y + 1).min(rows - 1)];
            let [a, b, c] = near.map(|y| &self.low[y * n..][..n]);
            let [d, e, f] = near.map(|y| &self.high[y * n..][..n]);
            let out = &mut self.percent[y * n..][..n];
            for x in 0..n {
                let (low, high) = (a[x].min(b[x]).min(c[x]), d[x].max(e[x]).max(f[x]));
                out[x] = percent_brighter(low, high);
            }
        }
    }

    /// The contrast in percent that is reached in this fraction of the image.
    pub fn reached_in(&self, share: f32) -> u8 {
        let mut counts = [0_usize; 256];
        self.percent.iter().for_each(|percent| counts[usize::from(*percent)] += 1);
        let mut left = (share * self.percent.len() as f32) as usize;
        for (percent, count) in counts.iter().enumerate().rev() {
            if *count > left {
                return percent as u8;
            }
            left -= count;
        }
        0
    }

    /// Whether the contrast is as large as this anywhere; true for an image that is too small.
    pub fn reaches(&self, min_percent: u8) -> bool {
        self.percent.is_empty() || self.percent.iter().any(|percent| *percent >= min_percent)
    }

    /// The places with at least this contrast.
    pub fn places(&self, min_percent: u8) -> Places<'_> {
        Places { columns: self.columns, percent: &self.percent, min_percent }
    }
}

/// By how many percent a grey value is above another one, up to 255. A quotient of such small numbers is not rounded up to a whole one.
#[inline(always)]
fn percent_brighter(low: u8, high: u8) -> u8 {
    let difference = f32::from(high.saturating_sub(low));
    (100.0 * difference / f32::from(low.saturating_add(STRAY_LIGHT))).min(255.0) as u8
}

/// Places of an image.
#[derive(Copy, Clone, Debug)]
pub struct Places<'a> {
    columns: usize,
    percent: &'a [u8],
    min_percent: u8,
}

impl Places<'_> {
    /// The whole image.
    pub const EVERYWHERE: Self = Self { columns: 0, percent: &[], min_percent: 0 };

    /// How many rows of a level of the pyramid have the same places. Coarse levels, of few pixels, are among them as a whole.
    pub(crate) fn rows_alike(&self, level: usize) -> usize {
        if level < LEVEL { 1 << (LEVEL - level) } else { usize::MAX }
    }

    /// Marks the pixels of a row of a level of the pyramid that are among them, 64 in a word; false, and no words, when there is none.
    pub(crate) fn mark(&self, y: usize, level: usize, words: &mut [u64]) -> bool {
        let shift = LEVEL.saturating_sub(level);
        let first = (y >> shift) * self.columns;
        // The last rows of an image may not fill eight, and are included.
        let row = self.percent.get(first..first + self.columns).filter(|_| shift > 0);
        let Some((row, last)) = row.and_then(|row| Some((row, row.last()?))) else {
            words.fill(u64::MAX);
            return true;
        };
        let (pixels, places) = (1 << shift, 64 >> shift);
        let is_place = |percent: &u8| *percent >= self.min_percent;
        let marked = |percent: &u8, bits: u64| if is_place(percent) { bits } else { 0 };
        if !row.iter().any(is_place) {
            return false;
        }
        for (index, word) in words.iter_mut().enumerate() {
            let here = row.get(index * places..).unwrap_or_default();
            // The last columns may not fill eight, either, and belong to those before.
            *word = here.iter().take(places).rev().fold(marked(last, u64::MAX), |word, percent| {
                word << pixels | marked(percent, (1 << pixels) - 1)
            });
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::view::GrayImage;

    fn map(image: &GrayImage) -> ContrastMap {
        let (mut pyramid, mut map) = (Pyramid::default(), ContrastMap::default());
        let view = image.view().unwrap();
        pyramid.build(view, 9, 24);
        map.measure(view, &pyramid);
        map
    }

    fn include(places: Places<'_>, x: usize, y: usize, level: usize) -> bool {
        let mut words = [0; 12];
        places.mark(y, level, &mut words) && words[x / 64] >> (x % 64) & 1 == 1
    }

    #[test]
    fn percent_are_whole_parts_of_quotients() {
        for (low, high) in (0..=255_u8).flat_map(|low| (low..=255).map(move |high| (low, high))) {
            let exact = 100 * u32::from(high - low) / u32::from(low.saturating_add(STRAY_LIGHT));
            assert_eq!(u32::from(percent_brighter(low, high)), exact.min(255));
        }
    }

    /// Noise of this height, and paper with a black square on it at (303..327, 203..227).
    fn scene(noise: u8) -> GrayImage {
        let mut image = GrayImage::filled(645, 485, 0);
        let mut random = 1_u32;
        for y in 0..485 {
            for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
                random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                let within = |margin: usize| {
                    (303 - margin..327 + margin).contains(&x)
                        && (203 - margin..227 + margin).contains(&y)
                };
                let grey = if within(0) {
                    20
                } else if within(6) {
                    180
                } else {
                    60
                };
                *pixel = grey + ((random >> 16) % u32::from(noise + 1)) as u8;
            }
        }
        image
    }

    #[test]
    fn paper_and_ink_have_contrast_and_noise_has_not() {
        let map = map(&scene(60));
        assert!(map.reaches(200), "{:?}", map.percent.iter().max());
        let places = map.places(40);
        for level in [0, 1, 2] {
            let on = |x: usize, y: usize| include(places, x >> level, y >> level, level);
            assert!(on(300, 200) && on(315, 198) && on(331, 215), "{level}");
            assert!(!on(20, 20) && !on(200, 215) && !on(644, 479), "{level}");
        }
        assert!(include(places, 0, 0, 3) && include(Places::EVERYWHERE, 9, 9, 0));
        let shown = map.percent.iter().filter(|percent| **percent >= 40).count();
        assert!(shown < map.percent.len() / 50, "{shown}");
    }

    #[test]
    fn the_contrast_of_a_share_is_reached_in_no_more_than_that() {
        let map = map(&scene(60));
        for share in [0.0, 0.01, 0.2, 0.7] {
            let percent = map.reached_in(share);
            let above = map.percent.iter().filter(|p| **p > percent).count();
            let from = map.percent.iter().filter(|p| **p >= percent).count();
            let wanted = share * map.percent.len() as f32;
            assert!(above as f32 <= wanted && from as f32 >= wanted, "{share}: {percent}");
        }
        assert_eq!(map.reached_in(1.0), 0);
    }

    #[test]
    fn an_image_that_is_too_small_has_contrast_everywhere() {
        let map = map(&GrayImage::filled(100, 80, 9));
        assert!(map.reaches(255) && include(map.places(255), 50, 50, 0));
        assert!(!self::map(&GrayImage::filled(300, 300, 9)).reaches(1));
    }
}
