//! Follows the outlines of dark or of bright regions on one pyramid level, pixel edge by pixel edge from the top of each, within
//! limits of size and contrast.

use super::Settings;
use crate::binary::{Binarizer, BitImage};
use crate::contrast_map::Places;
use crate::view::GrayView;

/// Bounds on time and memory of one level: pixel edges followed and points stored, per pixel of the level.
const MAX_STEPS_PER_PIXEL: f32 = 3.0;
const MAX_POINTS_PER_PIXEL: f32 = 0.3;
/// Added to both bounds, for tiny images.
const MIN_BUDGET: usize = 4096;

#[derive(Copy, Clone, Debug)]
pub(super) struct Span {
    pub(super) level: u8,
    pub(super) dark: bool,
    pub(super) cut: bool,
    pub(super) start: usize,
    pub(super) end: usize,
    pub(super) bounds: [u16; 4],
    pub(super) area: u32,
    pub(super) contrast: f32,
}

/// Where outlines may begin in one row. Each list has a zero word before and after.
#[derive(Clone, Debug, Default)]
pub(super) struct Tops {
    /// The right ends of runs that touch no pixel of the row above.
    ends: Vec<u64>,
    /// The pixels of the other runs, from one that touches to the end of the run.
    flooded: Vec<u64>,
    /// The places where outlines may begin at all.
    places: Vec<u64>,
}

/// The settings applied to one level.
#[derive(Copy, Clone, Debug)]
pub(super) struct Limits {
    min_size: i32,
    max_size: i32,
    max_path: usize,
    max_steps: usize,
    max_points: usize,
    detour_256ths: i32,
    steep: bool,
    /// Smallest step at the top of a steep outline of level 0, in 256ths of the range.
    min_step_256ths: i64,
    min_fill: f32,
    max_raggedness: f32,
}

impl Limits {
    pub(super) fn new(settings: &Settings, level: usize, view: GrayView<'_>) -> Self {
        let longest = view.width().max(view.height()) as i32;
        let max_size = if level >= settings.whole_level {
            longest
        } else {
            longest.min(i32::from(settings.max_size_px))
        };
        let pixels = view.width() as f32 * view.height() as f32;
        Self {
            min_size: i32::from(settings.min_size_px).max(2),
            max_size,
            // The number of pixel edges in the image.
            max_path: ((4.0 * max_size as f32 * settings.max_raggedness) as usize)
                .min(4 * view.width() * view.height()),
            max_steps: (pixels * MAX_STEPS_PER_PIXEL) as usize + MIN_BUDGET,
            max_points: (pixels * MAX_POINTS_PER_PIXEL) as usize + MIN_BUDGET,
            steep: settings.steep && level < 2,
            min_step_256ths: 256 - i64::from(settings.threshold_256ths),
            detour_256ths: ((settings.max_raggedness - 1.0).clamp(0.0, 1e4) * 256.0) as i32,
            min_fill: settings.min_fill,
            max_raggedness: settings.max_raggedness,
        }
    }
}

/// The search for one kind of region on one level.
pub(super) struct Search<'a> {
    pub(super) view: GrayView<'a>,
    /// The image that was binarised.
    pub(super) sharp: GrayView<'a>,
    pub(super) bits: &'a BitImage,
    pub(super) binarizer: &'a Binarizer,
    pub(super) dark: bool,
    pub(super) level: u8,
    /// Where outlines may begin, and the row of the level that is the first one here.
    pub(super) places: Places<'a>,
    pub(super) top: usize,
    pub(super) path: &'a mut Vec<u8>,
    pub(super) tops: &'a mut Tops,
    pub(super) points: &'a mut Vec<[f32; 2]>,
    pub(super) spans: &'a mut Vec<Span>,
}

/// Directions along pixel edges.
const RIGHT: u8 = 0;
const DOWN: u8 = 1;
const LEFT: u8 = 2;
const UP: u8 = 3;

/// A pixel edge of an outline, which begins at a point.
struct PixelEdge {
    /// The pixel inside, from the one to the lower right of the point.
    inside: [i32; 2],
    /// From there to the pixel outside.
    outwards: [i32; 2],
    /// From the point to the next one.
    along: [i32; 2],
}

/// The edges by direction: [`RIGHT`], [`DOWN`], [`LEFT`], [`UP`].
const EDGES: [PixelEdge; 4] = [
    PixelEdge { inside: [0, 0], outwards: [0, -1], along: [1, 0] },
    PixelEdge { inside: [-1, 0], outwards: [1, 0], along: [0, 1] },
    PixelEdge { inside: [-1, -1], outwards: [0, 1], along: [-1, 0] },
    PixelEdge { inside: [0, -1], outwards: [-1, 0], along: [0, -1] },
];

/// A closed outline; the region is to its right.
struct Trace {
    bounds: [i32; 4],
    area: i64,
    length: usize,
}

/// A walk along pixel edges, in pixels from where it starts.
struct Walk {
    x: i32,
    y: i32,
    /// The pixel to the lower right of the current point.
    place: usize,
    row: usize,
    direction: u8,
    left: i32,
    right: i32,
    bottom: i32,
}

impl Walk {
    /// After the upper edge of a pixel; `place` belongs to the next pixel.
    #[inline]
    fn new(place: usize, row: usize) -> Self {
        Self { x: 0, y: 0, place, row, direction: RIGHT, left: -1, right: 0, bottom: 0 }
    }

    /// The outline, if these steps from a point close it.
    fn closed(&self, [x, y]: [i32; 2], path: &[u8]) -> Option<Trace> {
        let bounds = [x + self.left, y, x + self.right, y + self.bottom];
        let closed = self.direction == RIGHT && [self.x, self.y] == [0, 0];
        closed.then(|| {
            // The columns of vertical edges, downwards minus upwards.
            let (mut column, mut area) = (0, 0);
            for step in path {
                let [right, down] = EDGES[usize::from(*step & 3)].along;
                column += right;
                area += i64::from(column * down);
            }
            Trace { bounds, area, length: path.len() }
        })
    }

    /// One step; false when the walk ends. With `steps`, their number with this one, as a ragged outline ends it.
    #[inline]
    fn right(&mut self, limits: &Limits) -> bool {
        self.direction = RIGHT;
        self.place += 1;
        self.x += 1;
        self.right = self.right.max(self.x);
        let is_top = self.y == 0 && self.x >= 0;
        !is_top && self.right - self.left <= limits.max_size
    }

    #[inline]
    fn down(&mut self, steps: usize, limits: &Limits) -> bool {
        self.direction = DOWN;
        self.place += self.row;
        self.y += 1;
        self.bottom = self.bottom.max(self.y);
        self.bottom <= limits.max_size && !self.is_ragged(steps, limits)
    }

    #[inline]
    fn left(&mut self, steps: usize, limits: &Limits) -> bool {
        self.direction = LEFT;
        self.place -= 1;
        self.x -= 1;
        self.left = self.left.min(self.x);
        self.right - self.left <= limits.max_size && !self.is_ragged(steps, limits)
    }

    #[inline]
    fn up(&mut self) -> bool {
        self.direction = UP;
        self.place -= self.row;
        self.y -= 1;
        self.y >= 0
    }

    /// Whether the steps down and to the left exceed those of a nearly convex outline with these bounds, which has as many as its
    /// width plus its height.
    #[inline]
    fn is_ragged(&self, steps: usize, limits: &Limits) -> bool {
        const SLACK: i32 = 2;
        let convex = self.right - self.left + self.bottom;
        let back = (steps as i32 - self.x + self.y) / 2;
        back - convex > SLACK + ((convex * limits.detour_256ths) >> 8)
    }
}

impl Search<'_> {
    pub(super) fn scan(mut self, limits: &Limits) {
        let mut steps_left = limits.max_steps;
        let points_end = self.points.len() + limits.max_points;
        self.path.resize(limits.max_path, 0);
        let bits = self.bits;
        let level = usize::from(self.level);
        let mut has_places = true;
        for y in 0..bits.height() {
            let row = y + self.top;
            if y == 0 || row.is_multiple_of(self.places.rows_alike(level)) {
                self.tops.places.resize(bits.row(y).len(), 0);
                has_places = self.places.mark(row, level, &mut self.tops.places);
            }
            if !has_places {
                continue;
            }
            let mut tops = std::mem::take(self.tops);
            tops.mark(bits.row(y), bits.row_above(y));
            let continues = self.scan_row(y, &tops, limits, &mut steps_left);
            *self.tops = tops;
            if !continues || self.points.len() >= points_end {
                return;
            }
        }
    }

    /// Follows the outlines that begin in a row; false when there are no steps left.
    fn scan_row(&mut self, y: usize, tops: &Tops, limits: &Limits, steps_left: &mut usize) -> bool {
        for (index, (ends, places)) in tops.ends.iter().skip(1).zip(&tops.places).enumerate() {
            let mut word = ends & places;
            while word != 0 {
                let x = index * 64 + word.trailing_zeros() as usize;
                word &= word - 1;
                if limits.steep && !self.is_steep(x, y, limits.min_step_256ths)
                    || self.is_futile(x, y, tops, limits)
                {
                    continue;
                }
                let (trace, steps) = self.follow(x, y, limits);
                if let Some(trace) = trace
                    && limits.admit(&trace)
                {
                    self.keep(x, y, &trace);
                }
                // Starting costs about as much as four steps.
                *steps_left = steps_left.saturating_sub(steps + 4);
                if *steps_left == 0 {
                    return false;
                }
            }
        }
        true
    }

    /// Whether the outline from a top would be dropped: as far as the next rows show within half a word to both sides, its region
    /// rises above the top elsewhere, begins further right as well, or is smaller than wanted.
    fn is_futile(&self, x: usize, y: usize, tops: &Tops, limits: &Limits) -> bool {
        const ROWS: usize = 4;
        let place = self.bits.place(x, y);
        let row = |down: usize| window(self.bits.bits(), place + down * self.bits.row_bits());
        let flooded = window(&tops.flooded, 64 + x);
        let (mut rows, mut parts) = ([row(0); ROWS], [0; ROWS]);
        // The top's own run, from its end to the left.
        let end = 1_u64 << HALF_WORD;
        let beyond = (!rows[0] & (end - 1)).checked_ilog2().map_or(0, |gap| gap + 1);
        let own = 2 * end - (1 << beyond);
        let is_of_other = |top: u64| top & !own & (!(end - 1) | flooded) != 0;
        parts[0] = own;
        for down in 1..ROWS {
            rows[down] = row(down);
            parts[down] = flood(rows[down], with_neighbours(parts[down - 1]) & rows[down]);
            // Most of a texture is joined right below. The end of a run shows whether it is flooded.
            if down == 1 && is_of_other(upwards(rows[0], with_neighbours(parts[1]) & rows[0])) {
                return true;
            }
        }
        for row in (0..ROWS - 1).rev() {
            let touched = with_neighbours(parts[row + 1]) & rows[row];
            if touched & !parts[row] != 0 {
                parts[row] = flood(rows[row], touched | parts[row]);
            }
        }
        if is_of_other(parts[0]) {
            return true;
        }
        if parts[ROWS - 1] != 0 {
            return false;
        }
        // A region that ends above the last row is known as a whole, if none of its pixels touches a further one.
        let is_whole = (1..ROWS).all(|row| {
            let down = with_neighbours(parts[row - 1]) & rows[row] & !parts[row];
            let up = with_neighbours(parts[row]) & rows[row - 1] & !parts[row - 1];
            down | up == 0
        });
        let all = parts.iter().fold(0, |all, part| all | part);
        let width = 64 - all.leading_zeros() - all.trailing_zeros();
        let height = parts.iter().filter(|part| **part != 0).count() as u32;
        is_whole && width.max(height) < limits.min_size.unsigned_abs().min(HALF_WORD as u32)
    }

    /// Whether the grey values at a top step by this much of their range, on level 1 by half of its logarithm. Two pixels up and
    /// down count, as blur spreads a step over two or three.
    fn is_steep(&self, x: usize, y: usize, min_step_256ths: i64) -> bool {
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
            256 * (bright - dark) >= min_step_256ths * (high - low)
        } else {
            // The same in logarithms; the offset avoids the logarithm of zero.
            let [bright, dark, low, high] = [bright, dark, low, high].map(|grey| grey + 4);
            bright * bright * low >= dark * dark * high
        }
    }

    /// Follows an outline once round from the upper edge of pixel (x, y), the right end of a run. `None` when
    /// it belongs to another run, is too large or too ragged; with the number of steps.
    fn follow(&mut self, x: usize, y: usize, limits: &Limits) -> (Option<Trace>, usize) {
        let (bits, row) = (self.bits.bits(), self.bits.row_bits());
        // Whether the pixel is part of the region; false outside the image.
        let part = |place: usize| bits.get(place >> 6).is_some_and(|w| w >> (place & 63) & 1 == 1);
        let mut walk = Walk::new(self.bits.place(x + 1, y), row);
        for (steps, step) in (1..).zip(self.path.iter_mut()) {
            // Regions are connected across corners: turn left if the pixel ahead to the left is set, go
            // straight on if the one ahead to the right is, else turn right.
            let place = walk.place;
            let continues = match walk.direction {
                RIGHT if part(place - row) => walk.up(),
                RIGHT if part(place) => walk.right(limits),
                RIGHT => walk.down(steps, limits),
                DOWN if part(place) => walk.right(limits),
                DOWN if part(place - 1) => walk.down(steps, limits),
                DOWN => walk.left(steps, limits),
                LEFT if part(place - 1) => walk.down(steps, limits),
                LEFT if part(place - row - 1) => walk.left(steps, limits),
                LEFT => walk.up(),
                _ if part(place - row - 1) => walk.left(steps, limits),
                _ if part(place - row) => walk.up(),
                _ => walk.right(limits),
            };
            *step = walk.direction;
            if !continues {
                let start = [x as i32 + 1, y as i32];
                return (walk.closed(start, self.path.get(..steps).unwrap_or_default()), steps);
            }
        }
        (None, self.path.len())
    }

    /// Keeps an outline that was just followed from pixel (x, y).
    fn keep(&mut self, x: usize, y: usize, trace: &Trace) {
        // The pixels that are looked at reach this far beyond the region.
        const BEYOND: i32 = 2;
        let start = self.points.len();
        let [left, top, right, bottom] = trace.bounds;
        let (width, height) = (self.view.width() as i32, self.view.height() as i32);
        let is_inner =
            left.min(top) >= BEYOND && right + BEYOND <= width && bottom + BEYOND <= height;
        let (contrast, cut) = if is_inner {
            // Most are, and need no check of column and row for each pixel.
            let (bytes, stride) = self.view.bytes_and_stride();
            let grey = |x: i32, y: i32| bytes.get(y as usize * stride + x as usize).copied();
            self.add_points(x, y, trace.length, grey)
        } else {
            let view = self.view;
            let is_pixel = |x: i32, y: i32| (0..width).contains(&x) && (0..height).contains(&y);
            let grey = |x: i32, y: i32| is_pixel(x, y).then(|| view.at(x as usize, y as usize));
            self.add_points(x, y, trace.length, grey)
        };
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

    /// Adds the points of an outline that was followed from pixel (x, y); `grey` of a pixel outside the image is `None`. Returns the
    /// sum of the differences across it, and whether the image's edge cuts it.
    #[inline(always)]
    fn add_points(
        &mut self,
        x: usize,
        y: usize,
        length: usize,
        grey: impl Fn(i32, i32) -> Option<u8>,
    ) -> (i64, bool) {
        let (mut x, mut y) = (x as i32 + 1, y as i32);
        let (mut contrast, mut cut) = (0_i64, false);
        let points = self.path.iter().take(length).map(|step| {
            let edge = &EDGES[usize::from(*step & 3)];
            let ([ax, ay], [dx, dy]) = ([x + edge.inside[0], y + edge.inside[1]], edge.outwards);
            (x, y) = (x + edge.along[0], y + edge.along[1]);
            let inside = grey(ax, ay).unwrap_or(0);
            let share = if let Some(outside) = grey(ax + dx, ay + dy) {
                contrast += i64::from(outside) - i64::from(inside);
                let inner = grey(ax - dx, ay - dy).unwrap_or(inside);
                let outer = grey(ax + 2 * dx, ay + 2 * dy).unwrap_or(outside);
                crossing([inner, inside, outside, outer], self.dark)
            } else {
                cut = true;
                0.5
            };
            [ax as f32 + share * dx as f32, ay as f32 + share * dy as f32]
        });
        self.points.extend(points);
        (contrast, cut)
    }
}

/// Where the grey values of four pixels across an edge cross the middle between the inner and the outer two,
/// in pixels outwards from the second.
fn crossing(greys: [u8; 4], dark: bool) -> f32 {
    let flip = if dark { 0 } else { u8::MAX };
    let greys = greys.map(|grey| i32::from(grey ^ flip));
    let [inner, a, b, outer] = greys;
    // Twice the middle, a whole number; and the pixel that it is crossed after.
    let middle = inner.min(a) + outer.max(b);
    let index = if 2 * b < middle { 2 } else { usize::from(2 * a <= middle) };
    let (low, high) = (greys[index], greys[index + 1]);
    let share = index as f32 - 1.0 + (middle - 2 * low) as f32 / (2 * (high - low)) as f32;
    // Equal values have no crossing.
    if share.is_finite() { share.clamp(-1.0, 2.0) } else { 0.5 }
}

impl Limits {
    fn admit(&self, trace: &Trace) -> bool {
        let [left, top, right, bottom] = trace.bounds;
        let (width, height) = (right - left, bottom - top);
        let around = 2 * (width + height);
        width.max(height) >= self.min_size
            && trace.length as f32 <= self.max_raggedness * around as f32
            && trace.area as f32 >= self.min_fill * width as f32 * height as f32
    }
}

/// Bit in the middle of a [`window`].
const HALF_WORD: usize = 31;

/// 64 bits with that of `place` in the middle; zeros outside.
#[inline]
fn window(words: &[u64], place: usize) -> u64 {
    let first = place - HALF_WORD;
    let word = |index: usize| words.get(index).copied().unwrap_or(0);
    let (low, shift) = (word(first >> 6), first & 63);
    // Two shifts, as a shift by 64 is undefined.
    low >> shift | word((first >> 6) + 1) << 1 << (63 - shift)
}

/// The bits of the next row that ones touch.
#[inline]
fn with_neighbours(bits: u64) -> u64 {
    bits | bits << 1 | bits >> 1
}

/// The runs of ones that contain `seeds`.
#[inline]
fn flood(bits: u64, seeds: u64) -> u64 {
    let mut runs = upwards(bits, seeds);
    // To the start of its run each spreads by one bit, then by two, four and so on.
    let mut whole = bits;
    for shift in [1, 2, 4, 8, 16, 32] {
        runs |= runs >> shift & whole;
        whole &= whole >> shift;
    }
    runs
}

/// The runs of ones from each of `seeds` to their ends.
#[inline]
fn upwards(bits: u64, seeds: u64) -> u64 {
    // Adding the seeds carries a one from each to the end of its run and changes the bits in between.
    (bits ^ bits.wrapping_add(seeds)) & bits | seeds
}

impl Tops {
    /// Reserves memory for rows of this length.
    pub(super) fn make_room(&mut self, width: usize) {
        for words in [&mut self.ends, &mut self.flooded, &mut self.places] {
            words.reserve((width / 64 + 4).saturating_sub(words.len()));
        }
    }

    /// Marks the tops of a row. Both rows end with a zero word.
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
            // Adding a run's touched pixels carries a one from each to the end of the run and changes the
            // bits in between: the last bit of a run is unchanged only where nothing touches.
            let seeds = run & touched;
            let (sum, over) = run.overflowing_add(seeds);
            let (sum, over_too) = sum.overflowing_add(u64::from(carry));
            *flooded = (run ^ sum) & run | seeds;
            *end = run & !(run >> 1 | run_after << 63) & !*flooded;
            // A run that touches may continue in the next word.
            carry = (over | over_too) && run_after & 1 == 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_flood_fills_the_runs_with_seeds(bits in any::<u64>(), more in any::<u64>(), seeds in any::<u64>()) {
            // Long runs, too.
            for bits in [bits, bits | more, u64::MAX] {
                let seeds = bits & seeds & seeds.rotate_left(7);
                let (mut runs, mut ends) = (seeds, seeds);
                for _ in 0..64 {
                    runs |= with_neighbours(runs) & bits;
                    ends |= ends << 1 & bits;
                }
                prop_assert_eq!(flood(bits, seeds), runs);
                prop_assert_eq!(upwards(bits, seeds), ends);
            }
        }
    }
}
