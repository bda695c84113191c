//! Outlines of dark and of bright regions, on an image and its halvings.

use std::ops::Range;

use crate::binary::{Binarizer, BitImage, Contrast, Middle};
use crate::kernels::{TILE, sharpen_row};
use crate::pyramid::Pyramid;
use crate::view::{GrayImage, GrayView};

/// What is looked for. Sizes are in pixels of the level that is looked at, so that each level sees other regions.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Settings {
    /// The finest level on which outlines of dark regions are looked for: 0 is the image itself, 1 is half its size.
    pub dark_from: Option<usize>,
    /// The finest level on which outlines of bright regions are looked for.
    pub bright_from: Option<usize>,
    /// From this level on, regions may be as large as the image; on finer ones up to `largest_px`.
    pub whole_level: usize,
    /// The longer edge of a region's bounds is at least this.
    pub smallest_px: u16,
    /// The longer edge of a region's bounds is at most this, on levels below `whole_level`.
    pub largest_px: u16,
    /// Where pixels differ by fewer grey levels within 12 x 12 pixels, nothing is seen. Halved with each level from 2 on,
    /// as noise is, down to a third.
    pub least_contrast: u8,
    /// The same as a share of the brightest pixel, in percent, on all levels.
    pub least_contrast_percent: u8,
    /// Outlines on levels 0 and 1 are followed only where, at their top, the grey values step by half of their range
    /// within 12 x 12 pixels (level 1: of its logarithm). It spares following most of the ups and downs of textures.
    pub steep: bool,
    /// Least share of its bounds that a region fills; a disc 0.79, a square 0.5 to 1.
    pub least_fill: f32,
    /// Most pixel edges that an outline has, relative to its bounds': 1 for all convex outlines, more for ragged ones.
    pub most_ragged: f32,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            dark_from: Some(0),
            bright_from: None,
            whole_level: 2,
            smallest_px: 5,
            largest_px: 36,
            least_contrast: 14,
            least_contrast_percent: 12,
            steep: true,
            least_fill: 0.3,
            most_ragged: 1.3,
        }
    }
}

/// The closed outline of a connected region, between its pixels and those around it.
#[derive(Copy, Clone, Debug)]
pub struct Outline<'a> {
    /// The level it was seen on; places are in pixels of that level, see [`crate::pyramid::to_level_0`].
    pub level: usize,
    /// Whether the region is darker than what is around it.
    pub dark: bool,
    /// One point for each pixel edge of the outline, clockwise as seen in the image, where the grey values along the line
    /// across it are in the middle of those of the two pixels within and the two without, interpolated linearly.
    pub points: &'a [[f32; 2]],
    /// Columns and rows of the region: left, top, and right and bottom, which are the first ones beyond it.
    pub bounds: [u16; 4],
    /// Pixels within, holes included.
    pub area: u32,
    /// Mean difference of the grey values across the outline.
    pub contrast: f32,
    /// Whether the region reaches the image's edge; the outline then runs along it.
    pub cut: bool,
}

/// Finds the outlines of regions, level by level of a pyramid. Regions are connected across corners.
///
/// An outline is followed from the right end of a run of pixels that has none of its kind above it, and given up as
/// soon as it rises above that row or outgrows its level's size. So each outline is followed once, without marks, and
/// of texture little is followed. Borders of holes are not outlines; they are those of the other kind's regions.
#[derive(Clone, Debug, Default)]
pub struct Outlines {
    pyramid: Pyramid,
    sharp: GrayImage,
    /// Whether `sharp` is of this image.
    is_sharp: bool,
    binarizer: Binarizer,
    dark: BitImage,
    bright: BitImage,
    path: Vec<u8>,
    tops: Tops,
    points: Vec<[f32; 2]>,
    spans: Vec<Span>,
}

/// What one row says of where outlines begin. Each has a word of noes before and after.
#[derive(Clone, Debug, Default)]
struct Tops {
    /// The right ends of runs of pixels that touch none of the row above.
    ends: Vec<u64>,
    /// The pixels of the other runs, from one that touches to the run's end.
    flooded: Vec<u64>,
}

/// Most levels; the coarsest is then 256 times smaller.
const MOST_LEVELS: usize = 9;
/// No level has an edge shorter than this, in pixels.
const SHORTEST_EDGE_PX: usize = 24;
/// Bounds on the work and memory of one level: pixel edges followed per pixel, and points kept per pixel.
const MOST_STEPS_PER_PIXEL: f32 = 3.0;
const MOST_POINTS_PER_PIXEL: f32 = 0.3;
/// There is room from the start for a point and for an outline in so many pixels.
const POINTS_EVERY: usize = 8;
const SPANS_EVERY: usize = 250;
/// Tiny images may have this many anyway.
const LEAST_BUDGET: usize = 4096;

#[derive(Copy, Clone, Debug)]
struct Span {
    level: u8,
    dark: bool,
    cut: bool,
    start: usize,
    end: usize,
    bounds: [u16; 4],
    area: u32,
    contrast: f32,
}

impl Outlines {
    /// Finds the outlines in an image; those found before are forgotten.
    pub fn find(&mut self, view: GrayView<'_>, settings: &Settings) {
        self.begin(view);
        self.add(view, settings, 0..MOST_LEVELS);
    }

    /// Turns to another image, in which nothing is found yet.
    pub fn begin(&mut self, view: GrayView<'_>) {
        self.points.clear();
        self.spans.clear();
        self.pyramid.build(view, MOST_LEVELS, SHORTEST_EDGE_PX);
        // As much as textures have; a frame that has more makes the buffers grow.
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
    }

    /// Adds the outlines on some levels of the image that was begun with; `view` is that image.
    pub fn add(&mut self, view: GrayView<'_>, settings: &Settings, levels: Range<usize>) {
        let finest = settings.dark_from.into_iter().chain(settings.bright_from).min();
        let first = levels.start.max(finest.unwrap_or(MOST_LEVELS));
        for level in first..levels.end.min(self.pyramid.levels()) {
            self.find_on(view, level, settings, None);
        }
    }

    /// Adds those outlines of the image itself, of which [`Outlines::add`] finds all, that begin in some rows of it, so that
    /// the work can be spread; none is higher than `largest_px` of the settings.
    pub fn add_rows(&mut self, view: GrayView<'_>, settings: &Settings, rows: Range<usize>) {
        // What decides on a row and an outline's last: the tiles next to theirs, and the row next to those.
        const MARGIN: usize = 3 * TILE;
        let top = rows.start.saturating_sub(MARGIN) / TILE * TILE;
        let below = rows.end + usize::from(settings.largest_px) + MARGIN;
        let bottom = below.next_multiple_of(TILE).min(view.height());
        let first = self.spans.len();
        self.find_on(view, 0, settings, Some(top..bottom));
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

    /// The outlines in the order in which they were found: finest level first, on each level the dark ones first, from top
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
        view: GrayView<'_>,
        level: usize,
        settings: &Settings,
        rows: Option<Range<usize>>,
    ) {
        let Some(whole) = self.pyramid.level(view, level) else {
            return;
        };
        let wanted = |from: Option<usize>| from.is_some_and(|from| from <= level);
        let bright = wanted(settings.bright_from).then_some(&mut self.bright);
        // Full resolution serves regions a few pixels wide, whose lines are hardly wider than a pixel and blurred.
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
        let rows = rows.as_ref();
        let Some((view, sharp)) = part(whole, rows).zip(part(sharp, rows)) else { return };
        self.binarizer.apply(sharp, contrast(settings, level), &mut self.dark, bright);
        let limits = Limits::new(settings, level, view);
        for (from, bits, dark) in
            [(settings.dark_from, &self.dark, true), (settings.bright_from, &self.bright, false)]
        {
            if wanted(from) {
                let found = Found {
                    view,
                    sharp,
                    bits,
                    binarizer: &self.binarizer,
                    dark,
                    level: level as u8,
                    path: &mut self.path,
                    tops: &mut self.tops,
                    points: &mut self.points,
                    spans: &mut self.spans,
                };
                found.scan(&limits);
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

/// In the middle, lines of a pixel's width stay whole, dark and bright ones alike; on coarser levels shadows matter more.
fn contrast(settings: &Settings, level: usize) -> Contrast {
    let least = settings.least_contrast;
    Contrast {
        middle: if level == 0 { Middle::Share(128) } else { Middle::Ratio },
        least_levels: (least >> level.saturating_sub(1).min(7)).max(least / 3),
        least_percent: settings.least_contrast_percent,
    }
}

/// What is kept on one level.
#[derive(Copy, Clone, Debug)]
struct Limits {
    smallest: i32,
    largest: i32,
    most_path: usize,
    most_steps: usize,
    most_points: usize,
    detour_256ths: i32,
    steep: bool,
    least_fill: f32,
    most_ragged: f32,
}

impl Limits {
    fn new(settings: &Settings, level: usize, view: GrayView<'_>) -> Self {
        let longest = view.width().max(view.height()) as i32;
        let largest = if level >= settings.whole_level {
            longest
        } else {
            longest.min(i32::from(settings.largest_px))
        };
        let pixels = view.width() as f32 * view.height() as f32;
        Self {
            smallest: i32::from(settings.smallest_px).max(2),
            largest,
            // An image has no more pixel edges than this.
            most_path: ((4.0 * largest as f32 * settings.most_ragged) as usize)
                .min(4 * view.width() * view.height()),
            most_steps: (pixels * MOST_STEPS_PER_PIXEL) as usize + LEAST_BUDGET,
            most_points: (pixels * MOST_POINTS_PER_PIXEL) as usize + LEAST_BUDGET,
            steep: settings.steep && level < 2,
            detour_256ths: ((settings.most_ragged - 1.0).clamp(0.0, 1e4) * 256.0) as i32,
            least_fill: settings.least_fill,
            most_ragged: settings.most_ragged,
        }
    }
}

/// The outlines of one kind of region on one level.
struct Found<'a> {
    view: GrayView<'a>,
    /// What the bits were made of.
    sharp: GrayView<'a>,
    bits: &'a BitImage,
    binarizer: &'a Binarizer,
    dark: bool,
    level: u8,
    path: &'a mut Vec<u8>,
    tops: &'a mut Tops,
    points: &'a mut Vec<[f32; 2]>,
    spans: &'a mut Vec<Span>,
}

/// Directions along pixel edges.
const RIGHT: u8 = 0;
const DOWN: u8 = 1;
const LEFT: u8 = 2;
const UP: u8 = 3;

/// The outline of a region, whose pixels lie to the right of the way.
struct Trace {
    bounds: [i32; 4],
    area: i64,
    length: usize,
}

/// The way along an outline.
struct Walk {
    start: [i32; 2],
    x: i32,
    y: i32,
    /// The pixel to the lower right of the point that was reached.
    place: usize,
    row: usize,
    direction: u8,
    left: i32,
    right: i32,
    bottom: i32,
    /// The sum over the upright edges of where they are, down less up.
    area: i64,
    /// Steps down and to the left; a convex outline takes as many as it is high and wide.
    back: i32,
}

impl Walk {
    /// Has taken the upper edge of pixel (x, y); `place` is the next pixel's.
    #[inline]
    fn new(x: usize, y: usize, place: usize, row: usize) -> Self {
        let (x, y) = (x as i32 + 1, y as i32);
        let (start, left, right, bottom) = ([x, y], x - 1, x, y);
        Self { start, x, y, place, row, direction: RIGHT, left, right, bottom, area: 0, back: 0 }
    }

    /// The outline, if this is its end.
    fn closed(&self, length: usize) -> Option<Trace> {
        let bounds = [self.left, self.start[1], self.right, self.bottom];
        let closed = self.direction == RIGHT && [self.x, self.y] == self.start;
        closed.then_some(Trace { bounds, area: self.area, length })
    }

    /// A step; false when the way ends.
    #[inline]
    fn right(&mut self, limits: &Limits) -> bool {
        self.direction = RIGHT;
        self.place += 1;
        self.x += 1;
        self.right = self.right.max(self.x);
        let is_top = self.y == self.start[1] && self.x >= self.start[0];
        !is_top && self.right - self.left <= limits.largest
    }

    #[inline]
    fn down(&mut self, limits: &Limits) -> bool {
        self.direction = DOWN;
        self.place += self.row;
        self.y += 1;
        self.area += i64::from(self.x);
        self.back += 1;
        self.bottom = self.bottom.max(self.y);
        self.bottom - self.start[1] <= limits.largest && !self.is_ragged(limits)
    }

    #[inline]
    fn left(&mut self, limits: &Limits) -> bool {
        self.direction = LEFT;
        self.place -= 1;
        self.x -= 1;
        self.back += 1;
        self.left = self.left.min(self.x);
        self.right - self.left <= limits.largest && !self.is_ragged(limits)
    }

    #[inline]
    fn up(&mut self) -> bool {
        self.direction = UP;
        self.place -= self.row;
        self.y -= 1;
        self.area -= i64::from(self.x);
        self.y >= self.start[1]
    }

    /// Whether an outline with these bounds so far went too far down and to the left for one that is nearly convex.
    #[inline]
    fn is_ragged(&self, limits: &Limits) -> bool {
        const SLACK: i32 = 2;
        let convex = self.right - self.left + self.bottom - self.start[1];
        self.back - convex > SLACK + ((convex * limits.detour_256ths) >> 8)
    }
}

impl Found<'_> {
    fn scan(mut self, limits: &Limits) {
        let mut steps_left = limits.most_steps;
        let points_end = self.points.len() + limits.most_points;
        self.path.resize(limits.most_path, 0);
        let bits = self.bits;
        for y in 0..bits.height() {
            let mut tops = std::mem::take(self.tops);
            tops.mark(bits.row(y), bits.row_above(y));
            let goes_on = self.scan_row(y, &tops, limits, &mut steps_left);
            *self.tops = tops;
            if !goes_on || self.points.len() >= points_end {
                return;
            }
        }
    }

    /// Follows the outlines that begin in a row; false when there are no steps left.
    fn scan_row(&mut self, y: usize, tops: &Tops, limits: &Limits, steps_left: &mut usize) -> bool {
        for (index, word) in tops.ends.iter().skip(1).enumerate() {
            let mut word = *word;
            while word != 0 {
                let x = index * 64 + word.trailing_zeros() as usize;
                word &= word - 1;
                if limits.steep && !self.is_steep(x, y) || self.rises(x, y, tops) {
                    continue;
                }
                let (trace, steps) = self.follow(x, y, limits);
                if let Some(trace) = trace
                    && limits.admit(&trace)
                {
                    self.keep(x, y, &trace);
                }
                // A start costs about as much as some steps.
                *steps_left = steps_left.saturating_sub(steps + 4);
                if *steps_left == 0 {
                    return false;
                }
            }
        }
        true
    }

    /// Whether the region that begins at a top rises above it elsewhere, or begins further right as well, by what the next
    /// rows say within half a word to both sides. Its outline, followed from here, would be given up.
    fn rises(&self, x: usize, y: usize, tops: &Tops) -> bool {
        const ROWS: usize = 3;
        let (words, place) = (self.bits.bits(), self.bits.place(x, y));
        let mut rows = [0; ROWS];
        for (down, row) in rows.iter_mut().enumerate() {
            *row = window(words, place + down * self.bits.row_bits());
        }
        let flooded = window(&tops.flooded, 64 + x);
        // The top's own run, from its end to the left.
        let end = 1_u64 << HALF_WORD;
        let own = flood(rows[0], end);
        let mut parts = [0; ROWS];
        parts[0] = own;
        // Down and up again.
        for (row, from) in
            (1..ROWS).map(|row| (row, row - 1)).chain((1..ROWS).rev().map(|row| (row - 1, row)))
        {
            let part = parts[from];
            let touched = (part | part << 1 | part >> 1) & rows[row];
            if touched & !parts[row] != 0 {
                parts[row] = flood(rows[row], touched | parts[row]);
            }
        }
        let others = parts[0] & !own;
        others & !(end - 1) != 0 || others & flooded != 0
    }

    /// Whether the grey values step at a top by half of their range. Looks two pixels up and down, as blur spreads a step
    /// over two or three.
    fn is_steep(&self, x: usize, y: usize) -> bool {
        let row = |y: usize| self.sharp.row(y.min(self.sharp.height() - 1));
        let (near, far) = (row(y.saturating_sub(1)), row(y.saturating_sub(2)));
        let (here, next, last) = (row(y), row(y + 1), row(y + 2));
        let (before, after) = (x.saturating_sub(1), (x + 1).min(self.sharp.width() - 1));
        let (bright, dark) = if self.dark {
            let above = near[x].max(far[x]).max(near[after]);
            (above, here[x].min(next[x]).min(next[before]).min(last[before]))
        } else {
            let within = here[x].max(next[x]).max(next[before]).max(last[before]);
            (within, near[x].min(far[x]).min(near[after]))
        };
        let [low, high] = self.binarizer.extremes(x, y);
        let [bright, dark, low, high] = [bright, dark, low, high].map(i64::from);
        if self.level == 0 {
            2 * (bright - dark) >= high - low
        } else {
            // The same in logarithms; a little is added so that nothing is infinitely darker.
            let [bright, dark, low, high] = [bright, dark, low, high].map(|grey| grey + 4);
            bright * bright * low >= dark * dark * high
        }
    }

    /// Follows an outline from the upper edge of pixel (x, y), the right end of a run, once round. `None` when it is
    /// another run's, too large or too ragged; and how many steps it took.
    fn follow(&mut self, x: usize, y: usize, limits: &Limits) -> (Option<Trace>, usize) {
        let (bits, row) = (self.bits.bits(), self.bits.row_bits());
        // Whether the pixel is part of the region; no for those beyond the image.
        let part = |place: usize| bits.get(place >> 6).is_some_and(|w| w >> (place & 63) & 1 == 1);
        let mut walk = Walk::new(x, y, self.bits.place(x + 1, y), row);
        for (length, step) in self.path.iter_mut().enumerate() {
            // Regions are connected across corners, so a pixel ahead to the left is part of it whatever is to its right;
            // else the way is straight on along a pixel ahead to the right, or turns right.
            let place = walk.place;
            let goes_on = match walk.direction {
                RIGHT if part(place - row) => walk.up(),
                RIGHT if part(place) => walk.right(limits),
                RIGHT => walk.down(limits),
                DOWN if part(place) => walk.right(limits),
                DOWN if part(place - 1) => walk.down(limits),
                DOWN => walk.left(limits),
                LEFT if part(place - 1) => walk.down(limits),
                LEFT if part(place - row - 1) => walk.left(limits),
                LEFT => walk.up(),
                _ if part(place - row - 1) => walk.left(limits),
                _ if part(place - row) => walk.up(),
                _ => walk.right(limits),
            };
            *step = walk.direction;
            if !goes_on {
                return (walk.closed(length + 1), length + 1);
            }
        }
        (None, self.path.len())
    }

    /// Keeps an outline that was just followed from pixel (x, y).
    fn keep(&mut self, x: usize, y: usize, trace: &Trace) {
        let start = self.points.len();
        let (mut x, mut y) = (x as i32 + 1, y as i32);
        let (mut cut, mut contrast) = (false, 0_i64);
        for step in self.path.iter().take(trace.length) {
            // The pixels on both sides of the edge.
            let ([ax, ay], [bx, by], [nx, ny]) = match *step {
                RIGHT => ([x, y], [x, y - 1], [x + 1, y]),
                DOWN => ([x - 1, y], [x, y], [x, y + 1]),
                LEFT => ([x - 1, y - 1], [x - 1, y], [x - 1, y]),
                _ => ([x, y - 1], [x - 1, y - 1], [x, y - 1]),
            };
            let (dx, dy) = (bx - ax, by - ay);
            let within = self.grey(ax, ay).unwrap_or(0);
            let share = if let Some(without) = self.grey(bx, by) {
                contrast += i64::from(without) - i64::from(within);
                let inner = self.grey(ax - dx, ay - dy).unwrap_or(within);
                let outer = self.grey(bx + dx, by + dy).unwrap_or(without);
                crossing([inner, within, without, outer], self.dark)
            } else {
                cut = true;
                0.5
            };
            self.points.push([ax as f32 + share * dx as f32, ay as f32 + share * dy as f32]);
            (x, y) = (nx, ny);
        }
        let contrast = contrast as f32 / trace.length.max(1) as f32;
        self.spans.push(Span {
            level: self.level,
            dark: self.dark,
            cut,
            start,
            end: self.points.len(),
            bounds: trace.bounds.map(|b| b as u16),
            area: trace.area as u32,
            contrast: if self.dark { contrast } else { -contrast },
        });
    }

    #[inline]
    fn grey(&self, x: i32, y: i32) -> Option<u8> {
        let inside = x >= 0
            && y >= 0
            && (x as usize) < self.view.width()
            && (y as usize) < self.view.height();
        inside.then(|| self.view.at(x as usize, y as usize))
    }
}

/// How far from the pixel within, in pixels outwards, the grey values of four pixels in a row from within to without are in
/// the middle between those within and those without.
fn crossing(greys: [u8; 4], dark: bool) -> f32 {
    let upwards = |grey: u8| f32::from(if dark { grey } else { !grey });
    let [inner, a, b, outer] = greys.map(upwards);
    let middle = (inner.min(a) + outer.max(b)) / 2.0;
    let between = |low: f32, high: f32| (middle - low) / (high - low);
    let share = if b < middle {
        1.0 + between(b, outer)
    } else if a > middle {
        between(inner, a) - 1.0
    } else {
        between(a, b)
    };
    // Where all are alike there is no crossing.
    if share.is_finite() { share.clamp(-1.0, 2.0) } else { 0.5 }
}

impl Limits {
    fn admit(&self, trace: &Trace) -> bool {
        let [left, top, right, bottom] = trace.bounds;
        let (width, height) = (right - left, bottom - top);
        let around = 2 * (width + height);
        width.max(height) >= self.smallest
            && trace.length as f32 <= self.most_ragged * around as f32
            && trace.area as f32 >= self.least_fill * width as f32 * height as f32
    }
}

/// Bit in the middle of a [`window`].
const HALF_WORD: usize = 31;

/// 64 bits of which that of `place` is in the middle; noes where there are none.
#[inline]
fn window(words: &[u64], place: usize) -> u64 {
    let first = place - HALF_WORD;
    let word = |index: usize| words.get(index).copied().unwrap_or(0);
    let (low, shift) = (word(first >> 6), first & 63);
    // Shifted twice, as 64 is no shift.
    low >> shift | word((first >> 6) + 1) << 1 << (63 - shift)
}

/// The runs of which some bits are `seeds`.
#[inline]
fn flood(bits: u64, seeds: u64) -> u64 {
    // Adding them carries a one from each to its run's end and changes the bits on the way.
    let upwards = |bits: u64, seeds: u64| (bits ^ bits.wrapping_add(seeds)) & bits | seeds;
    let up = upwards(bits, seeds);
    up | upwards(bits.reverse_bits(), seeds.reverse_bits()).reverse_bits()
}

impl Tops {
    /// Makes room for rows of this length.
    fn make_room(&mut self, width: usize) {
        for words in [&mut self.ends, &mut self.flooded] {
            words.reserve((width / 64 + 4).saturating_sub(words.len()));
        }
    }

    /// Marks the tops of a row. Both rows have a word of noes at their end.
    fn mark(&mut self, row: &[u64], above: &[u64]) {
        for words in [&mut self.ends, &mut self.flooded] {
            words.resize(row.len() + 1, 0);
            if let Some(last) = words.last_mut() {
                *last = 0;
            }
        }
        let (mut above_before, mut carry) = (0, false);
        let out = self.ends.iter_mut().zip(&mut self.flooded).skip(1);
        for ((end, flooded), (run, above)) in out.zip(row.windows(2).zip(above.windows(2))) {
            let ([run, run_after], [above, above_after]) = ([run[0], run[1]], [above[0], above[1]]);
            let touched = above | above << 1 | above_before >> 63 | above >> 1 | above_after << 63;
            above_before = above;
            // Adding a run's touched pixels to it carries a one from each of them to the run's end and changes the bits on
            // the way: the last bit of a run stays as it is only where nothing touches.
            let seeds = run & touched;
            let (sum, over) = run.overflowing_add(seeds);
            let (sum, over_too) = sum.overflowing_add(u64::from(carry));
            *flooded = (run ^ sum) & run | seeds;
            *end = run & !(run >> 1 | run_after << 63) & !*flooded;
            // A run that touches may go on in the next word.
            carry = (over | over_too) && run_after & 1 == 1;
        }
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
        smallest_px: 1,
        largest_px: 0,
        least_contrast: 10,
        least_contrast_percent: 0,
        steep: false,
        least_fill: 0.0,
        most_ragged: 1e6,
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
    fn a_square_has_its_four_sides_in_the_middle_between_pixels() {
        let rows = [
            "........", "........", "..####..", "..#..#..", "..#..#..", "..####..", "........",
            "........",
        ];
        let outlines = find(&rows, &Settings { smallest_px: 2, ..ALL });
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
    }

    #[test]
    fn rows_have_the_outlines_that_begin_in_them() {
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
            Settings { whole_level: 1, smallest_px: 3, largest_px: 20, least_contrast: 14, ..ALL };
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
                parts.add_rows(view, &kind, rows);
            }
        }
        let (parts, whole) = (list(&parts), list(&whole));
        assert!(whole.len() > 50, "{}", whole.len());
        assert_eq!(parts.len(), whole.len());
        for (part, whole) in parts.iter().zip(&whole) {
            assert_eq!((part.0, part.1, part.2, part.3), (whole.0, whole.1, whole.2, whole.3));
            assert_eq!(part.4.len(), whole.4.len());
            // Where rows are added to places, these are rounded.
            for ([x, y], [u, v]) in part.4.iter().zip(&whole.4) {
                assert!((x - u).abs() < 1e-3 && (y - v).abs() < 1e-3, "{x} {y} {u} {v}");
            }
        }
    }

    #[test]
    fn regions_of_the_wrong_size_or_shape_are_left_out() {
        let rows =
            ["#.......", "..#..#..", "..#..#..", "..####..", "........", "...###..", "........"];
        let bounds = |settings: &Settings| -> Vec<_> {
            find(&rows, settings).iter().filter(|o| o.dark).map(|o| o.bounds).collect()
        };
        // A lone pixel is noise at any setting.
        assert_eq!(bounds(&ALL), [[2, 1, 6, 4], [3, 5, 6, 6]]);
        assert_eq!(bounds(&Settings { smallest_px: 4, ..ALL }), [[2, 1, 6, 4]]);
        assert_eq!(bounds(&Settings { most_ragged: 1.2, smallest_px: 3, ..ALL }), [[3, 5, 6, 6]]);
        let finite = Settings { whole_level: 9, largest_px: 3, smallest_px: 2, ..ALL };
        assert_eq!(bounds(&finite), [[3, 5, 6, 6]]);
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
            (width, bits) in (1_usize..150).prop_flat_map(|w| {
                (Just(w), (1_usize..12).prop_flat_map(move |h| prop::collection::vec(prop::bool::ANY, w * h)))
            })
        ) {
            let data: Vec<u8> = bits.iter().map(|dark| if *dark { 20 } else { 200 }).collect();
            let view = GrayView::packed(&data, width, bits.len() / width).unwrap();
            let mut outlines = Outlines::default();
            outlines.find(view, &ALL);
            // Where all is the same in a neighbourhood nothing is dark, so the bits themselves are the truth.
            let dark = |x: usize, y: usize| outlines.dark.at(x as i32, y as i32);
            let seen: Vec<bool> = (0..bits.len()).map(|i| dark(i % width, i / width)).collect();
            let mut expected = regions(&seen, width);
            let mut found: Vec<_> = outlines
                .iter()
                .filter(|o| o.dark && o.level == 0)
                .map(|o| o.bounds.map(usize::from))
                .filter(|b| (b[2] - b[0]).max(b[3] - b[1]) >= 2)
                .collect();
            expected.retain(|b| (b[2] - b[0]).max(b[3] - b[1]) >= 2);
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
