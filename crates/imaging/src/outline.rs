//! Finds the outlines of dark and of bright regions on the levels of an image pyramid: settings of size and contrast, thresholds, and the list
//! of closed outlines.

mod follow;

use std::ops::Range;

use crate::binary::{Binarizer, BitImage, Contrast, Middle};
use crate::contrast_map::Places;
use crate::kernels::{TILE, sharpen_row};
use crate::pyramid::Pyramid;
use crate::view::{GrayImage, GrayView};
use follow::{Limits, Search, Span, Tops};

/// Which regions are outlined. Sizes are in pixels of the level, so that each level sees other regions.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Settings {
    /// The finest level on which dark regions are outlined: 0 is the image itself, 1 is half its size.
    pub dark_from: Option<usize>,
    /// The finest level on which bright regions are outlined.
    pub bright_from: Option<usize>,
    /// From this level on, regions may be as large as the image; on finer levels up to `max_size_px`.
    pub whole_level: usize,
    /// Minimum of the longer edge of a region's bounds.
    pub min_size_px: u16,
    /// Maximum of the longer edge of a region's bounds, on levels below `whole_level`.
    pub max_size_px: u16,
    /// Minimum range of grey levels within 12 x 12 pixels. Halved with each level from 2 on, as noise is,
    /// down to a third.
    pub min_contrast: u8,
    /// The same as a fraction of the brightest pixel, in percent, on all levels.
    pub min_contrast_percent: u8,
    /// Where the threshold of level 0 lies within the range of 12 x 12 pixels, in 256ths: 128 in the middle. Paper is separated
    /// from its ground above that, where black ink next to it makes the range larger.
    pub threshold_256ths: u8,
    /// On levels 0 and 1, an outline is followed only if the grey values at its top step by as much of their
    /// range within 12 x 12 pixels as lies above the threshold (level 1: by half of its logarithm). This skips most of a texture.
    pub steep: bool,
    /// Minimum fraction of its bounds that a region fills: a disc fills 0.79, a square 0.5 to 1, one seen from the side under 8
    /// degrees
    /// 0.14 along a diagonal.
    pub min_fill: f32,
    /// Maximum number of pixel edges of an outline over that of its bounds: 1 for convex outlines, more for
    /// ragged ones.
    pub max_raggedness: f32,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            dark_from: Some(0),
            bright_from: None,
            whole_level: 2,
            min_size_px: 5,
            max_size_px: 36,
            min_contrast: 14,
            min_contrast_percent: 12,
            threshold_256ths: 128,
            steep: true,
            min_fill: 0.12,
            max_raggedness: 1.3,
        }
    }
}

/// The closed outline of a connected region, between its pixels and those around it.
#[derive(Copy, Clone, Debug)]
pub struct Outline<'a> {
    /// The pyramid level; coordinates are in pixels of that level, see [`crate::pyramid::to_level_0`].
    pub level: usize,
    /// Whether the region is darker than its surroundings.
    pub dark: bool,
    /// One point for each pixel edge of the outline, clockwise as seen in the image: where the grey values
    /// across it, linearly interpolated, are in the middle between the two pixels inside and the two outside.
    pub points: &'a [[f32; 2]],
    /// Columns and rows of the region: left, top, right, bottom; the last two exclusive.
    pub bounds: [u16; 4],
    /// Pixels inside, holes included.
    pub area: u32,
    /// Mean difference of the grey values across the outline.
    pub contrast: f32,
    /// Whether the region touches the image's edge; the outline then runs along it.
    pub cut: bool,
}

/// Finds the outlines of regions, level by level of a pyramid. Regions are connected across corners.
///
/// An outline is followed from the right end of a run of pixels with none of its kind above it, and dropped
/// as soon as it rises above that row or exceeds the maximum size. So each outline is followed once, without
/// marking pixels, and little of a texture is followed. Borders of holes are not outlined; they are outlines
/// of the other kind's regions.
#[derive(Clone, Debug, Default)]
pub struct Outlines {
    pyramid: Pyramid,
    sharp: GrayImage,
    /// Whether `sharp` belongs to this image.
    is_sharp: bool,
    binarizer: Binarizer,
    /// The level and its rows that were measured for the binarizer last.
    measured: Option<(usize, Option<Range<usize>>)>,
    dark: BitImage,
    bright: BitImage,
    path: Vec<u8>,
    tops: Tops,
    points: Vec<[f32; 2]>,
    spans: Vec<Span>,
}

/// The coarsest level is 256 times smaller than the image.
const MAX_LEVELS: usize = 9;
/// Minimum edge of a level, in pixels.
const MIN_EDGE_PX: usize = 24;
/// Memory is reserved for a point and for an outline in this many pixels.
const POINTS_EVERY: usize = 8;
const SPANS_EVERY: usize = 250;
impl Outlines {
    /// Finds the outlines in an image, replacing those found before.
    pub fn find(&mut self, view: GrayView<'_>, settings: &Settings) {
        self.begin(view);
        self.add(view, settings, 0..MAX_LEVELS);
    }

    /// Starts with another image and no outlines.
    pub fn begin(&mut self, view: GrayView<'_>) {
        self.points.clear();
        self.spans.clear();
        self.pyramid.build(view, MAX_LEVELS, MIN_EDGE_PX);
        // Enough for textures; a frame with more makes the buffers grow.
        let (width, height) = (view.width(), view.height());
        let pixels = width * height;
        self.points.reserve(pixels / POINTS_EVERY);
        self.spans.reserve(pixels / SPANS_EVERY);
        let longest = 4 * (width + height);
        self.path.reserve(longest.saturating_sub(self.path.len()));
        self.dark.make_room(width, height);
        self.bright.make_room(width, height);
        self.binarizer.make_room(width, height);
        self.tops.make_room(width);
        self.sharp.resize(width, height);
        self.is_sharp = false;
        self.measured = None;
    }

    /// Adds the outlines on these levels; `view` is the image given to [`Outlines::begin`].
    pub fn add(&mut self, view: GrayView<'_>, settings: &Settings, levels: Range<usize>) {
        self.add_at(Places::EVERYWHERE, view, settings, levels);
    }

    /// As [`Outlines::add`], those that begin at these places.
    pub fn add_at(
        &mut self,
        places: Places<'_>,
        view: GrayView<'_>,
        settings: &Settings,
        levels: Range<usize>,
    ) {
        let finest = settings.dark_from.into_iter().chain(settings.bright_from).min();
        let first = levels.start.max(finest.unwrap_or(MAX_LEVELS));
        for level in first..levels.end.min(self.pyramid.levels()) {
            self.find_on(places, view, level, settings, None);
        }
    }

    /// Adds the outlines of level 0 that begin at these places and in these rows, to spread the work of [`Outlines::add_at`] over
    /// several images. None is higher than `max_size_px`.
    pub fn add_rows(
        &mut self,
        places: Places<'_>,
        view: GrayView<'_>,
        settings: &Settings,
        rows: Range<usize>,
    ) {
        // The first and last row depend on the tiles next to theirs, and those on the next row.
        const MARGIN: usize = 3 * TILE;
        let top = rows.start.saturating_sub(MARGIN) / TILE * TILE;
        let below = rows.end + usize::from(settings.max_size_px) + MARGIN;
        let bottom = below.next_multiple_of(TILE).min(view.height());
        let first = self.spans.len();
        self.find_on(places, view, 0, settings, Some(top..bottom));
        let mut kept = first;
        for index in first..self.spans.len() {
            let mut span = self.spans[index];
            if !rows.contains(&(usize::from(span.bounds[1]) + top)) {
                continue;
            }
            for row in [1, 3] {
                span.bounds[row] += top as u16;
            }
            for point in self.points.get_mut(span.start..span.end).unwrap_or_default() {
                point[1] += top as f32;
            }
            self.spans[kept] = span;
            kept += 1;
        }
        self.spans.truncate(kept);
    }

    /// Number of outlines.
    pub fn len(&self) -> usize {
        self.spans.len()
    }

    /// True when there are none.
    pub fn is_empty(&self) -> bool {
        self.spans.is_empty()
    }

    /// The outlines in the order of detection: finest level first, on each level dark before bright, from top
    /// to bottom.
    pub fn iter(&self) -> impl Iterator<Item = Outline<'_>> {
        self.spans.iter().map(|span| self.outline(span))
    }

    /// The outline of an index below [`Outlines::len`], in the same order.
    pub fn get(&self, index: usize) -> Option<Outline<'_>> {
        self.spans.get(index).map(|span| self.outline(span))
    }

    /// The levels of the last image.
    pub fn pyramid(&self) -> &Pyramid {
        &self.pyramid
    }

    fn outline(&self, span: &Span) -> Outline<'_> {
        Outline {
            level: usize::from(span.level),
            dark: span.dark,
            points: self.points.get(span.start..span.end).unwrap_or_default(),
            bounds: span.bounds,
            area: span.area,
            contrast: span.contrast,
            cut: span.cut,
        }
    }

    /// Finds the outlines on a level, or in some rows of it.
    fn find_on(
        &mut self,
        places: Places<'_>,
        view: GrayView<'_>,
        level: usize,
        settings: &Settings,
        rows: Option<Range<usize>>,
    ) {
        let Some(whole) = self.pyramid.level(view, level) else {
            return;
        };
        let wanted = |from: Option<usize>| from.is_some_and(|from| from <= level);
        let dark = wanted(settings.dark_from).then_some(&mut self.dark);
        let bright = wanted(settings.bright_from).then_some(&mut self.bright);
        // At full resolution regions are a few pixels wide, with blurred lines hardly wider than a pixel.
        let sharp = if level == 0 {
            if !std::mem::replace(&mut self.is_sharp, true) {
                sharpen(whole, &mut self.sharp);
            }
            self.sharp.view().unwrap_or(whole)
        } else {
            whole
        };
        fn part<'a>(view: GrayView<'a>, rows: Option<&Range<usize>>) -> Option<GrayView<'a>> {
            match rows {
                Some(rows) => view.crop(0, rows.start, view.width(), rows.len()),
                None => Some(view),
            }
        }
        let Some((view, sharp)) = part(whole, rows.as_ref()).zip(part(sharp, rows.as_ref())) else {
            return;
        };
        let top = rows.as_ref().map_or(0, |rows| rows.start);
        // Small paper is searched with two thresholds, one right after the other.
        let measured = Some((level, rows));
        if self.measured != measured {
            self.binarizer.measure(sharp);
            self.measured = measured;
        }
        self.binarizer.apply(sharp, contrast(settings, level), dark, bright);
        let limits = Limits::new(settings, level, view);
        for (from, bits, dark) in
            [(settings.dark_from, &self.dark, true), (settings.bright_from, &self.bright, false)]
        {
            if wanted(from) {
                let search = Search {
                    view,
                    sharp,
                    bits,
                    binarizer: &self.binarizer,
                    dark,
                    level: level as u8,
                    places,
                    top,
                    path: &mut self.path,
                    tops: &mut self.tops,
                    points: &mut self.points,
                    spans: &mut self.spans,
                };
                search.scan(&limits);
            }
        }
    }
}

fn sharpen(view: GrayView<'_>, out: &mut GrayImage) {
    out.resize(view.width(), view.height());
    for y in 0..view.height() {
        let (above, below) = (y.saturating_sub(1), (y + 1).min(view.height() - 1));
        sharpen_row(view.row(above), view.row(y), view.row(below), out.row_mut(y));
    }
}

/// On level 0 the arithmetic mean, or another fraction of the range, keeps lines of a pixel's width connected; on coarser
/// levels shadows are more important.
fn contrast(settings: &Settings, level: usize) -> Contrast {
    let min = settings.min_contrast;
    Contrast {
        middle: if level == 0 { Middle::Share(settings.threshold_256ths) } else { Middle::Ratio },
        min_levels: (min >> level.saturating_sub(1).min(7)).max(min / 3),
        min_percent: settings.min_contrast_percent,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const ALL: Settings = Settings {
        dark_from: Some(0),
        bright_from: Some(0),
        whole_level: 0,
        min_size_px: 1,
        max_size_px: 0,
        min_contrast: 10,
        min_contrast_percent: 0,
        threshold_256ths: 128,
        steep: false,
        min_fill: 0.0,
        max_raggedness: 1e6,
    };

    fn image(rows: &[&str]) -> (Vec<u8>, usize) {
        let grey = |b| if b == b'#' { 20 } else { 200 };
        (rows.iter().flat_map(|row| row.bytes().map(grey)).collect(), rows[0].len())
    }

    fn find(rows: &[&str], settings: &Settings) -> Outlines {
        let (data, width) = image(rows);
        let mut outlines = Outlines::default();
        outlines.find(GrayView::packed(&data, width, rows.len()).unwrap(), settings);
        outlines
    }

    #[test]
    fn the_sides_of_a_square_lie_between_pixels() {
        let rows = [
            "........", "........", "..####..", "..#..#..", "..#..#..", "..####..", "........",
            "........",
        ];
        let outlines = find(&rows, &Settings { min_size_px: 2, ..ALL });
        let dark: Vec<_> = outlines.iter().filter(|o| o.dark).collect();
        assert_eq!(dark.len(), 1);
        assert_eq!((dark[0].bounds, dark[0].area, dark[0].cut), ([2, 2, 6, 6], 16, false));
        assert_eq!(dark[0].points.len(), 16);
        assert!((dark[0].contrast - 180.0).abs() < 1e-3);
        for [x, y] in dark[0].points {
            let off = (x - 3.5).abs().max((y - 3.5).abs());
            assert!((1.95..2.08).contains(&off), "{x} {y}");
        }
        let hole = outlines.iter().find(|o| !o.dark && !o.cut).unwrap();
        assert_eq!((hole.bounds, hole.area, hole.level), ([3, 3, 5, 5], 4, 0));
        // Nearer to the image's edge, where not all pixels across the sides are in it.
        let nearer: Vec<&str> = rows[1..7].iter().map(|row| &row[1..7]).collect();
        let nearer = find(&nearer, &Settings { min_size_px: 2, ..ALL });
        let moved = nearer.get(0).unwrap().points.iter().map(|p| p.map(|v| v + 1.0));
        assert!(moved.eq(dark[0].points.iter().copied()));
    }

    #[test]
    fn outlines_by_rows_are_those_of_the_whole_image() {
        let (width, height) = (230, 190);
        let mut random = 1_u32;
        let mut pixel = |i: usize| {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let spot = (i % width / 9 * 7 + i / width / 11 * 5).is_multiple_of(4);
            (random >> 26) as u8 + if spot { 180 } else { 30 }
        };
        let data: Vec<u8> = (0..width * height).map(&mut pixel).collect();
        let view = GrayView::packed(&data, width, height).unwrap();
        let settings =
            Settings { whole_level: 1, min_size_px: 3, max_size_px: 20, min_contrast: 14, ..ALL };
        let list = |outlines: &Outlines| -> Vec<_> {
            let keep = |o: Outline<'_>| (o.bounds, o.dark, o.area, o.cut, o.points.to_vec());
            outlines.iter().map(keep).collect()
        };
        let (mut whole, mut parts) = (Outlines::default(), Outlines::default());
        whole.begin(view);
        parts.begin(view);
        for kind in
            [Settings { bright_from: None, ..settings }, Settings { dark_from: None, ..settings }]
        {
            whole.add(view, &kind, 0..1);
            for rows in [0..61, 61..130, 130..height] {
                parts.add_rows(Places::EVERYWHERE, view, &kind, rows);
            }
        }
        let (parts, whole) = (list(&parts), list(&whole));
        assert!(whole.len() > 50, "{}", whole.len());
        assert_eq!(parts.len(), whole.len());
        for (part, whole) in parts.iter().zip(&whole) {
            assert_eq!((part.0, part.1, part.2, part.3), (whole.0, whole.1, whole.2, whole.3));
            assert_eq!(part.4.len(), whole.4.len());
            // Adding the offset of the rows rounds.
            for ([x, y], [u, v]) in part.4.iter().zip(&whole.4) {
                assert!((x - u).abs() < 1e-3 && (y - v).abs() < 1e-3, "{x} {y} {u} {v}");
            }
        }
    }

    #[test]
    fn regions_of_the_wrong_size_or_shape_are_dropped() {
        let rows =
            ["#.......", "..#..#..", "..#..#..", "..####..", "........", "...###..", "........"];
        let bounds = |settings: &Settings| -> Vec<_> {
            find(&rows, settings).iter().filter(|o| o.dark).map(|o| o.bounds).collect()
        };
        // Single pixels are always dropped.
        assert_eq!(bounds(&ALL), [[2, 1, 6, 4], [3, 5, 6, 6]]);
        assert_eq!(bounds(&Settings { min_size_px: 4, ..ALL }), [[2, 1, 6, 4]]);
        assert_eq!(
            bounds(&Settings { max_raggedness: 1.2, min_size_px: 3, ..ALL }),
            [[3, 5, 6, 6]]
        );
        let finite = Settings { whole_level: 9, max_size_px: 3, min_size_px: 2, ..ALL };
        assert_eq!(bounds(&finite), [[3, 5, 6, 6]]);
    }

    #[test]
    fn paper_next_to_black_ink_is_separated_from_its_ground_above_the_middle() {
        let inside = |x: usize, y: usize, margin: usize| {
            (margin..40 - margin).contains(&x) && (margin..40 - margin).contains(&y)
        };
        // A frame of ink, 2 pixels wide, in white paper, on ground between the two.
        let grey = |x, y| match () {
            () if inside(x, y, 16) => 240,
            () if inside(x, y, 14) => 40,
            () if inside(x, y, 12) => 240,
            () => 145,
        };
        let data: Vec<u8> = (0..40 * 40).map(|i| grey(i % 40, i / 40)).collect();
        let paper = |threshold_256ths| {
            let mut outlines = Outlines::default();
            let settings = Settings { steep: true, threshold_256ths, ..ALL };
            outlines.find(GrayView::packed(&data, 40, 40).unwrap(), &settings);
            outlines.iter().any(|o| !o.dark && o.level == 0 && o.bounds == [12, 12, 28, 28])
        };
        assert!(!paper(128) && paper(160) && paper(208));
    }

    #[test]
    fn coarser_levels_see_the_same_square_smaller() {
        let data: Vec<u8> = (0..200 * 200)
            .map(|i| (i % 200, i / 200))
            .map(|(x, y)| if (40..120).contains(&x) && (60..140).contains(&y) { 10 } else { 220 })
            .collect();
        let mut outlines = Outlines::default();
        outlines.find(GrayView::packed(&data, 200, 200).unwrap(), &Settings::default());
        let seen: Vec<_> = outlines.iter().map(|o| (o.level, o.bounds)).collect();
        assert_eq!(seen, [(2, [10, 15, 30, 35]), (3, [5, 8, 15, 17])]);
        for [x, y] in outlines.get(0).unwrap().points {
            let place = |p: f32| crate::pyramid::to_level_0(f64::from(p), 2);
            let off = (place(*x) - 79.5).abs().max((place(*y) - 99.5).abs());
            assert!((off - 40.0).abs() < 0.6, "{off}");
        }
    }

    proptest! {
        #[test]
        fn each_region_has_one_outline_whatever_its_shape(
            (width, greys) in (1_usize..150).prop_flat_map(|w| {
                (Just(w), (1_usize..24).prop_flat_map(move |h| prop::collection::vec(any::<u8>(), w * h)))
            }),
            dark_256ths in 10_u8..160,
            min_size_px in 1_u16..40,
        ) {
            let data: Vec<u8> =
                greys.iter().map(|grey| if *grey < dark_256ths { 20 } else { 200 }).collect();
            let view = GrayView::packed(&data, width, greys.len() / width).unwrap();
            let mut outlines = Outlines::default();
            outlines.find(view, &Settings { min_size_px, ..ALL });
            // Flat neighbourhoods are not dark, so the bits themselves are the ground truth.
            let dark = |x: usize, y: usize| outlines.dark.at(x as i32, y as i32);
            let seen: Vec<bool> = (0..greys.len()).map(|i| dark(i % width, i / width)).collect();
            let mut expected = regions(&seen, width);
            let mut found: Vec<_> = outlines
                .iter()
                .filter(|o| o.dark && o.level == 0)
                .map(|o| o.bounds.map(usize::from))
                .collect();
            let min_size = usize::from(min_size_px).max(2);
            expected.retain(|b| (b[2] - b[0]).max(b[3] - b[1]) >= min_size);
            expected.sort_unstable();
            found.sort_unstable();
            prop_assert_eq!(found, expected);
        }
    }

    /// Bounds of the regions, connected across corners, by flooding.
    fn regions(bits: &[bool], width: usize) -> Vec<[usize; 4]> {
        let mut left = bits.to_vec();
        let mut found = Vec::new();
        while let Some(seed) = left.iter().position(|w| *w) {
            let mut bounds = [usize::MAX, usize::MAX, 0, 0];
            let mut stack = vec![seed];
            while let Some(at) = stack.pop() {
                if !std::mem::replace(&mut left[at], false) {
                    continue;
                }
                let (x, y) = (at % width, at / width);
                bounds = [
                    bounds[0].min(x),
                    bounds[1].min(y),
                    bounds[2].max(x + 1),
                    bounds[3].max(y + 1),
                ];
                for ny in y.saturating_sub(1)..(y + 2).min(bits.len() / width) {
                    for nx in x.saturating_sub(1)..(x + 2).min(width) {
                        stack.push(ny * width + nx);
                    }
                }
            }
            found.push(bounds);
        }
        found
    }
}
