//! Finds the straight edge of a shadow in an image by the same rise of the grey values' logarithm all along it, and makes the image without
//! that shadow.
//!
//! On any ground a shadow takes the same fraction of its light all along the edge (the shadows of intrinsic
//! images: Barrow and Tenenbaum, 1978; Finlayson, Hordley, Lu and Drew, 2006). So the edge is a line along which the logarithm of
//! the grey value rises by the same step again and again, where markers, paint and joints rise in places. The divisor
//! is measured: the mean rise across the line, with its penumbra, the lens' blur and the camera's sharpening. A tone curve that is
//! nearly a power changes the light's ratio to another one, which is measured as well.

use std::f64::consts::TAU;
use std::ops::Range;
use std::sync::LazyLock;

use imaging::pyramid::to_level_0;
use imaging::{GrayImage, GrayView, Pyramid, bilinear};
use nalgebra::{Matrix3, Vector3};

/// The level of the pyramid on which lines are searched: means of 4 x 4 pixels.
const LEVEL: usize = 2;
/// Grey levels added to all before their logarithm, as the darkest are mostly noise: for the search, and for the measurement.
const STRAY_LIGHT: f64 = 4.0;
const ROUNDING: f64 = 0.5;
/// Minimum rise of the logarithm across two pixels of the level where a line may be, and minimum step of a shadow.
const MIN_RISE: f32 = 0.22;
const MIN_STEP: f64 = 0.22;
/// Maximum step, a ratio of 16: darker pixels show little but noise.
const MAX_STEP: f64 = 2.77;
/// Directions and distances of the Hough transform; a distance is two pixels of the level.
const DIRECTIONS: usize = 96;
const PX_PER_DISTANCE: f32 = 2.0;
/// Maximum number of pixels of the level that take part. Where texture has more, only those count that rise more, by this factor.
const MAX_EDGE_PIXELS: usize = 10_000;
const MIN_RISE_FACTOR: f32 = 1.5;
/// Minimum number of pixels of the level that agree on a line, two for each of its length; and minimum of the shorter side of an
/// image, as a side of a marker may cross a smaller one.
const MIN_VOTES: u16 = 30;
const MIN_SIDE_PX: usize = 60;
/// Lines that are tried in an image, the longest first.
const MAX_LINES: usize = 3;
/// Maximum distance of a pixel of the level from the line it is part of, and of the directions of their rise as a cosine.
const NEAR_PX: f64 = 3.0;
const MIN_COSINE: f64 = 0.9;
/// Half the width of the profile across the line, in pixels, and the part of it in which no light changes any more.
const HALF_PX: i32 = 16;
const PLAIN_FROM_PX: i32 = 7;
const PLAIN_TO_PX: i32 = 12;
/// Places along the line that are looked at, at most, and at least for a line to be one.
const MAX_PLACES: usize = 400;
const MIN_PLACES: usize = 30;
/// Maximum difference of the step at a place from the median, also as a fraction of it, and of its place from the line, in
/// pixels; of the places along the line across the whole image at least this fraction must be within.
const MAX_STEP_OFF: f64 = 0.3;
const MAX_STEP_SHARE: f64 = 0.6;
const MAX_PLACE_OFF_PX: f64 = 2.0;
const MIN_SHARE: f64 = 0.5;
/// Places of the profile for each pixel.
const PROFILE_PER_PX: i32 = 2;
const PROFILE: usize = (2 * PLAIN_TO_PX * PROFILE_PER_PX) as usize + 1;
/// Entries of the table of gains for each pixel.
const GAINS_PER_PX: f32 = 16.0;

/// A line that may be bent a little, as by a lens: places along it and, to the brighter side, across it, in pixels.
#[derive(Copy, Clone, Debug)]
struct Bend {
    through: [f64; 2],
    /// A unit vector to the brighter side.
    across: [f64; 2],
    /// How far the line is from the straight one: a constant, and coefficients of the place along it over `length` and of its square.
    by_place: [f64; 3],
    length: f64,
}

impl Bend {
    /// Where a pixel is: along the line, and how far from it.
    fn place(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let (dx, dy) = (x - self.through[0], y - self.through[1]);
        let [nx, ny] = self.across;
        let along = dx * ny - dy * nx;
        [along, dx * nx + dy * ny - self.offset(along)]
    }

    fn offset(&self, along: f64) -> f64 {
        let [a, b, c] = self.by_place;
        let u = along / self.length;
        a + (b + c * u) * u
    }

    /// The pixel at such a place.
    fn pixel(&self, along: f64, from_line: f64) -> [f64; 2] {
        let [nx, ny] = self.across;
        let away = from_line + self.offset(along);
        [self.through[0] + along * ny + away * nx, self.through[1] - along * nx + away * ny]
    }

    /// The same, moved to fit points (along, from the line) best; `None` where they do not determine it.
    fn fitted(&self, points: impl Iterator<Item = [f64; 2]>) -> Option<Self> {
        let mut matrix = Matrix3::zeros();
        let mut right = Vector3::zeros();
        for [along, from_line] in points {
            let u = along / self.length;
            let row = Vector3::new(1.0, u, u * u);
            matrix += row * row.transpose();
            right += row * from_line;
        }
        let step = matrix.cholesky()?.solve(&right);
        let by_place = std::array::from_fn(|i| self.by_place[i] + step[i]);
        step.iter().all(|part| part.is_finite()).then_some(Self { by_place, ..*self })
    }
}

/// The straight edge of a shadow in an image.
#[derive(Clone, Debug)]
pub(crate) struct ShadowEdge {
    line: Bend,
    /// By how much the logarithm of the grey value rises across it, and at how many places that was seen.
    step: f64,
    places: usize,
    /// The fraction of the step that is made, at places from the dark side to the bright one.
    profile: [f64; PROFILE],
}

/// A pixel of the level where the image rises.
#[derive(Copy, Clone, Debug)]
struct EdgePixel {
    place: [f32; 2],
    /// The rise of the logarithm to the right and down.
    rise: [f32; 2],
}

/// The profile at one position along a line.
#[derive(Copy, Clone, Debug)]
struct Crossing {
    along: f64,
    /// The logarithm on the dark side and on the bright one, and by how much it rises.
    dark: f64,
    bright: f64,
    step: f64,
    /// Where it is half of the way up, from the line; infinite where it does not rise, or not by a likely step.
    at_px: f64,
}

/// Finds the straight edges of shadows. It keeps its memory from image to image.
#[derive(Clone, Debug, Default)]
pub(crate) struct ShadowFinder {
    pixels: Vec<EdgePixel>,
    votes: Vec<u16>,
    crossings: Vec<Crossing>,
    values: Vec<f64>,
}

impl ShadowFinder {
    /// Reserves memory for images of this size.
    pub(crate) fn make_room(&mut self, view: GrayView<'_>) {
        fn reserve<T>(list: &mut Vec<T>, count: usize) {
            list.reserve(count.saturating_sub(list.len()));
        }
        reserve(&mut self.pixels, MAX_EDGE_PIXELS);
        reserve(
            &mut self.votes,
            DIRECTIONS * distances([view.width(), view.height()].map(|px| px >> LEVEL)),
        );
        reserve(&mut self.crossings, MAX_PLACES + 1);
        reserve(&mut self.values, MAX_PLACES + 1);
    }

    /// The straight edge of a shadow in the image of which the pyramid was built: of several the one that changes most.
    pub(crate) fn find(&mut self, view: GrayView<'_>, pyramid: &Pyramid) -> Option<ShadowEdge> {
        let means = pyramid.level(view, LEVEL)?;
        let size = [means.width(), means.height()];
        if size.iter().any(|side| *side < MIN_SIDE_PX) {
            return None;
        }
        self.find_pixels(means);
        self.vote(size);
        let mut best: Option<ShadowEdge> = None;
        for _ in 0..MAX_LINES {
            let Some(line) = self.longest_line(size) else { break };
            let line = self.along_pixels(line).unwrap_or(line);
            let edge = self.measured(view, line);
            // Dark things have larger steps than most shadows.
            let rise = |edge: &ShadowEdge| edge.step.min(1.0) * edge.places as f64;
            if let Some(edge) = edge
                && best.as_ref().is_none_or(|best| rise(&edge) > rise(best))
            {
                best = Some(edge);
            }
            // The pixels of this line do not count in the next one.
            let Self { pixels, votes, .. } = self;
            pixels.retain(|pixel| {
                let stays = !pixel.is_on(&line);
                if !stays {
                    pixel.for_each_bin(size, |bin| {
                        if let Some(votes) = votes.get_mut(bin) {
                            *votes = votes.saturating_sub(1);
                        }
                    });
                }
                stays
            });
        }
        best
    }

    /// Lists the pixels where the image rises, in a textured image those where it rises most.
    fn find_pixels(&mut self, means: GrayView<'_>) {
        static LOGARITHMS: LazyLock<[f32; 256]> =
            LazyLock::new(|| std::array::from_fn(|grey| (grey as f64 + STRAY_LIGHT).ln() as f32));
        let logarithms: &[f32; 256] = &LOGARITHMS;
        let log = |grey: u8| logarithms[usize::from(grey)];
        let square = |[x, y]: [f32; 2]| x * x + y * y;
        let mut min_square = MIN_RISE * MIN_RISE;
        self.pixels.clear();
        for y in 1..means.height().saturating_sub(1) {
            let [above, row, below] = [y - 1, y, y + 1].map(|y| means.row(y));
            for x in 1..means.width().saturating_sub(1) {
                let rise = [log(row[x + 1]) - log(row[x - 1]), log(below[x]) - log(above[x])];
                // Few are left after one round or two, as no image rises without end.
                while self.pixels.len() == MAX_EDGE_PIXELS {
                    min_square *= MIN_RISE_FACTOR * MIN_RISE_FACTOR;
                    self.pixels.retain(|pixel| square(pixel.rise) >= min_square);
                }
                if square(rise) >= min_square {
                    self.pixels.push(EdgePixel { place: [x as f32, y as f32], rise });
                }
            }
        }
    }

    /// Counts the pixels on each line.
    fn vote(&mut self, size: [usize; 2]) {
        self.votes.clear();
        self.votes.resize(DIRECTIONS * distances(size), 0);
        for pixel in &self.pixels {
            pixel.for_each_bin(size, |bin| {
                if let Some(votes) = self.votes.get_mut(bin) {
                    *votes = votes.saturating_add(1);
                }
            });
        }
    }

    /// The straight line with the most pixels that rise across it, in pixels of the image; `None` where none is long enough.
    fn longest_line(&self, size: [usize; 2]) -> Option<Bend> {
        let (distances, middle) = (distances(size), middle(size));
        let (index, votes) = self.votes.iter().enumerate().max_by_key(|(_, votes)| **votes)?;
        if *votes < MIN_VOTES {
            return None;
        }
        let across = units()[index / distances];
        let bin = (index % distances) as f32 + 0.5;
        let distance = (bin - distances as f32 / 2.0) * PX_PER_DISTANCE;
        let through: [f64; 2] = std::array::from_fn(|axis| {
            to_level_0(f64::from(middle[axis] + across[axis] * distance), LEVEL)
        });
        let across = across.map(f64::from);
        let length = f64::from(middle[0].hypot(middle[1])) * f64::from(1 << LEVEL);
        Some(Bend { through, across, by_place: [0.0; 3], length })
    }

    /// A line moved and bent to the pixels along it.
    fn along_pixels(&self, mut line: Bend) -> Option<Bend> {
        const STEPS: usize = 3;
        for _ in 0..STEPS {
            let near = self.pixels.iter().filter(|pixel| pixel.is_on(&line));
            line = line.fitted(near.map(|pixel| line.place(pixel.in_image())))?;
        }
        Some(line)
    }

    /// The shadow's edge that a line is, where the image rises by the same step along most of it: a side of a marker or
    /// of other things ends in the image.
    fn measured(&mut self, view: GrayView<'_>, mut line: Bend) -> Option<ShadowEdge> {
        const STEPS: usize = 2;
        let mut step = self.step_across(view, &line)?;
        for _ in 0..STEPS {
            let likely = self.crossings.iter().filter(|it| it.is_likely(step));
            line = line.fitted(likely.map(|it| [it.along, it.at_px]))?;
            step = self.step_across(view, &line)?;
        }
        let all = self.crossings.len();
        self.crossings.retain(|it| it.is_likely(step));
        let count = self.crossings.len();
        if count < MIN_PLACES || (count as f64) < MIN_SHARE * all as f64 {
            return None;
        }
        let mut edge = ShadowEdge { line, step, places: count, profile: [0.0; PROFILE] };
        for index in 0..PROFILE {
            let from_line = (index as f64) / f64::from(PROFILE_PER_PX) - f64::from(PLAIN_TO_PX);
            self.values.clear();
            self.values.extend(self.crossings.iter().filter_map(|it| {
                let log = logarithm(view, line.pixel(it.along, from_line))?;
                Some(((log - it.dark) / it.step).clamp(-0.5, 1.5))
            }));
            // Markers and texture are in the tails.
            let mean = interquartile_mean(&mut self.values)?;
            let side = if from_line < 0.0 { 0.0 } else { 1.0 };
            let plain = f64::from(PLAIN_FROM_PX)..f64::from(PLAIN_TO_PX);
            let weight = (from_line.abs() - plain.start) / (plain.end - plain.start);
            let weight = weight.clamp(0.0, 1.0);
            edge.profile[index] = mean + weight * (side - mean);
        }
        Some(edge)
    }

    /// The likely step across the line, and where the image makes it.
    fn step_across(&mut self, view: GrayView<'_>, line: &Bend) -> Option<f64> {
        self.look_across(view, line);
        let step = self.likely_step()?;
        for it in self.crossings.iter_mut().filter(|it| it.has_step(step)) {
            it.at_px = it.place(view, line)?;
        }
        Some(step)
    }

    /// Lists the profiles across the line, at positions along it.
    fn look_across(&mut self, view: GrayView<'_>, line: &Bend) {
        self.crossings.clear();
        let half = line.length;
        let every = (2.0 * half / MAX_PLACES as f64).max(1.0);
        let places = (0..MAX_PLACES).map(|index| index as f64 * every - half);
        self.crossings.extend(places.filter_map(|along| crossing(view, line, along)));
    }

    /// The median of the steps, where that is a shadow's.
    fn likely_step(&mut self) -> Option<f64> {
        self.values.clear();
        self.values.extend(self.crossings.iter().map(|it| it.step));
        let middle = self.values.len() / 2;
        if self.values.len() < MIN_PLACES {
            return None;
        }
        let (_, median, _) = self.values.select_nth_unstable_by(middle, f64::total_cmp);
        (MIN_STEP..MAX_STEP).contains(median).then_some(*median)
    }
}

impl EdgePixel {
    /// Calls with the index of each line that the pixel is on: in the nearest direction and those next to it.
    fn for_each_bin(&self, size: [usize; 2], mut is_on: impl FnMut(usize)) {
        let Self { place, rise } = self;
        let (distances, middle) = (distances(size), middle(size));
        let turn = rise[1].atan2(rise[0]) / std::f32::consts::TAU;
        let nearest = (turn * DIRECTIONS as f32).round() as isize;
        for direction in nearest - 1..=nearest + 1 {
            let direction = direction.rem_euclid(DIRECTIONS as isize) as usize;
            let [nx, ny] = units()[direction];
            let distance = (place[0] - middle[0]) * nx + (place[1] - middle[1]) * ny;
            let bin = (distance / PX_PER_DISTANCE + distances as f32 / 2.0) as usize;
            is_on(direction * distances + bin);
        }
    }

    fn in_image(&self) -> [f64; 2] {
        self.place.map(|place| to_level_0(f64::from(place), LEVEL))
    }

    /// Whether it is near a line and rises across it.
    fn is_on(&self, line: &Bend) -> bool {
        let [_, from_line] = line.place(self.in_image());
        let [x, y] = self.rise.map(f64::from);
        let [nx, ny] = line.across;
        let near_px = NEAR_PX * f64::from(1 << LEVEL);
        from_line.abs() < near_px && x * nx + y * ny > MIN_COSINE * x.hypot(y)
    }
}

impl Crossing {
    fn has_step(&self, step: f64) -> bool {
        (self.step - step).abs() < MAX_STEP_OFF.min(MAX_STEP_SHARE * step)
    }

    fn is_likely(&self, step: f64) -> bool {
        self.has_step(step) && self.at_px.abs() < MAX_PLACE_OFF_PX
    }

    /// Where the logarithm is half of the way up, from the line; `None` beyond the image.
    fn place(&self, view: GrayView<'_>, line: &Bend) -> Option<f64> {
        let half = (self.dark + self.bright) / 2.0;
        let mut nearest = f64::INFINITY;
        let mut before = None;
        for from_line in -HALF_PX..=HALF_PX {
            let after = logarithm(view, line.pixel(self.along, f64::from(from_line)))? - half;
            if let Some(before) = before.replace(after).filter(|before| *before < 0.0)
                && after >= 0.0
            {
                let at = f64::from(from_line - 1) - before / (after - before);
                // Of two as near the first.
                nearest = if at.abs() < nearest.abs() { at } else { nearest };
            }
        }
        Some(nearest)
    }
}

impl ShadowEdge {
    /// Makes `out` the image without this shadow: its dark side as bright as the other one.
    pub(crate) fn remove(&self, view: GrayView<'_>, out: &mut GrayImage) {
        let half_px = PLAIN_TO_PX as f32;
        let gain = |made: f64| (self.step * (1.0 - made)).exp() as f32;
        let mut gains = [1.0_f32; (2 * PLAIN_TO_PX) as usize * GAINS_PER_PX as usize + 1];
        for (index, slot) in gains.iter_mut().enumerate() {
            let at = index as f64 / f64::from(GAINS_PER_PX) * f64::from(PROFILE_PER_PX);
            let (before, share) = (at as usize, at.fract());
            let made = |index: usize| self.profile.get(index).copied().unwrap_or(1.0);
            *slot = gain(made(before) + share * (made(before + 1) - made(before)));
        }
        let full = gain(0.0);
        let in_shade: [u8; 256] = std::array::from_fn(|grey| brightened(grey as f32, full));
        let Bend { through, across: [nx, ny], by_place: [a, b, c], length } = self.line;
        out.resize(view.width(), view.height());
        for y in 0..view.height() {
            let dy = y as f64 - through[1];
            // Both are linear in x.
            let (along, away) = (-through[0] * ny - dy * nx, -through[0] * nx + dy * ny);
            for (x, (to, from)) in out.row_mut(y).iter_mut().zip(view.row(y)).enumerate() {
                let x = x as f64;
                let u = (along + x * ny) / length;
                let from_line = (away + x * nx - (a + (b + c * u) * u)) as f32;
                *to = if from_line >= half_px {
                    *from
                } else if from_line <= -half_px {
                    in_shade[usize::from(*from)]
                } else {
                    let index = ((from_line + half_px) * GAINS_PER_PX) as usize;
                    let gain = gains.get(index).copied().unwrap_or(1.0);
                    brightened(f32::from(*from), gain)
                };
            }
        }
    }
}

/// The directions as unit vectors.
fn units() -> &'static [[f32; 2]; DIRECTIONS] {
    static UNITS: LazyLock<[[f32; 2]; DIRECTIONS]> = LazyLock::new(|| {
        std::array::from_fn(|index| {
            let (sin, cos) = (index as f64 * TAU / DIRECTIONS as f64).sin_cos();
            [cos as f32, sin as f32]
        })
    });
    &UNITS
}

fn middle(size: [usize; 2]) -> [f32; 2] {
    size.map(|edge| edge as f32 / 2.0)
}

/// Number of distances from the middle of an image of this size that lines may have.
fn distances([width, height]: [usize; 2]) -> usize {
    (width as f32).hypot(height as f32) as usize / PX_PER_DISTANCE as usize + 2
}

/// A grey value in so much more light, rounded.
fn brightened(grey: f32, gain: f32) -> u8 {
    (grey * gain + 0.5).min(255.0) as u8
}

/// The logarithm of the grey value at a place.
fn logarithm(view: GrayView<'_>, [x, y]: [f64; 2]) -> Option<f64> {
    Some((bilinear(view, x, y)? + ROUNDING).ln())
}

/// The profile across a line at a position along it, without the position of its rise; `None` beyond the image.
fn crossing(view: GrayView<'_>, line: &Bend, along: f64) -> Option<Crossing> {
    // All between the ends is in the image as well.
    for end in [-HALF_PX, HALF_PX] {
        let [x, y] = line.pixel(along, f64::from(end));
        bilinear(view, x, y)?;
    }
    let mean = |places: Range<i32>| {
        let count = places.len() as f64;
        let logs = places.map(|from_line| logarithm(view, line.pixel(along, f64::from(from_line))));
        logs.sum::<Option<f64>>().map(|sum| sum / count)
    };
    let dark = mean(-PLAIN_TO_PX..1 - PLAIN_FROM_PX)?;
    let bright = mean(PLAIN_FROM_PX..PLAIN_TO_PX + 1)?;
    Some(Crossing { along, dark, bright, step: bright - dark, at_px: f64::INFINITY })
}

/// The mean of the middle half of the values; `None` of too few.
fn interquartile_mean(values: &mut [f64]) -> Option<f64> {
    values.sort_unstable_by(f64::total_cmp);
    let quarter = values.len() / 4;
    let middle = values.get(quarter..values.len() - quarter).filter(|middle| middle.len() > 1)?;
    Some(middle.iter().sum::<f64>() / middle.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 2] = [320, 240];

    /// Ground of patches with noise, in the shade on the side where `n . (x, y) < distance`, with a penumbra of that many pixels.
    fn ground(n: [f64; 2], distance: f64, ratio: f64, penumbra_px: f64) -> Vec<u8> {
        let mut state = 1_u32;
        let mut noise = move || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(state >> 16) / 65_536.0 - 0.5
        };
        let pixels = (0..SIZE[0] * SIZE[1]).map(|index| {
            let (x, y) = ((index % SIZE[0]) as f64, (index / SIZE[0]) as f64);
            let patch = ((x / 23.0).floor() * 3.0 + (y / 17.0).floor() * 5.0) % 7.0;
            let lit = ((n[0] * x + n[1] * y - distance) / penumbra_px + 0.5).clamp(0.0, 1.0);
            let light = 1.0 / ratio + lit * (1.0 - 1.0 / ratio);
            ((150.0 + 4.0 * patch) * (1.0 + 0.06 * noise()) * light).round() as u8
        });
        pixels.collect()
    }

    fn find(data: &[u8]) -> Option<ShadowEdge> {
        let view = GrayView::packed(data, SIZE[0], SIZE[1]).unwrap();
        let mut pyramid = Pyramid::default();
        pyramid.build(view, 9, 24);
        let mut finder = ShadowFinder::default();
        finder.make_room(view);
        finder.find(view, &pyramid)
    }

    #[test]
    fn a_shadow_is_found_where_it_is_and_removed() {
        for (degrees, distance, ratio, penumbra_px) in [
            (0.0_f64, 150.0, 2.0, 1.0),
            (33.0, 170.0, 5.0, 3.0),
            (90.0, 110.0, 10.0, 1.0),
            (200.0, -230.0, 3.0, 8.0),
        ] {
            let (ny, nx) = degrees.to_radians().sin_cos();
            let data = ground([nx, ny], distance, ratio, penumbra_px);
            let edge = find(&data).unwrap();
            assert!((edge.step - f64::ln(ratio)).abs() < 0.08, "{degrees}: {}", edge.step);
            let place = |along: f64| [nx * distance + along * ny, ny * distance - along * nx];
            for along in [-40.0, 0.0, 40.0] {
                let middle = place(along);
                let [_, from_line] = edge.line.place(middle);
                // Half of the logarithm's step is made on the darker side of the light's middle.
                assert!(from_line.abs() < 0.3 + 0.5 * penumbra_px, "{degrees}: {from_line}");
            }
            let mut out = GrayImage::default();
            edge.remove(GrayView::packed(&data, SIZE[0], SIZE[1]).unwrap(), &mut out);
            let plain = ground([nx, ny], -1e6, ratio, penumbra_px);
            let off = |(a, b): (&u8, &u8)| f64::from(a.abs_diff(*b)).powi(2);
            let squares: f64 = out.pixels().iter().zip(&plain).map(off).sum();
            let rms = (squares / plain.len() as f64).sqrt();
            let before: f64 = data.iter().zip(&plain).map(off).sum();
            let rms_before = (before / plain.len() as f64).sqrt();
            assert!(rms < 0.1 * rms_before, "{degrees}: {rms} of {rms_before}");
        }
    }

    #[test]
    fn edges_other_than_shadows_are_not_found() {
        assert!(find(&ground([1.0, 0.0], -1e6, 2.0, 1.0)).is_none());
        assert!(find(&vec![0; SIZE[0] * SIZE[1]]).is_none());
        assert!(find(&vec![255; SIZE[0] * SIZE[1]]).is_none());
        // A dark disc rises all round, and noise everywhere.
        let disc = (0..SIZE[0] * SIZE[1]).map(|index| {
            let (x, y) = ((index % SIZE[0]) as f64 - 160.0, (index / SIZE[0]) as f64 - 120.0);
            if x.hypot(y) < 60.0 { 30 } else { 200 }
        });
        assert!(find(&disc.collect::<Vec<u8>>()).is_none());
        let mut state = 7_u32;
        let noise = (0..SIZE[0] * SIZE[1]).map(|_| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        });
        assert!(find(&noise.collect::<Vec<u8>>()).is_none());
    }

    #[test]
    fn an_image_of_any_size_is_searched() {
        for [width, height] in [[1, 1], [24, 24], [96, 96], [120, 300], [300, 97], [240, 240]] {
            let data: Vec<u8> =
                (0..width * height).map(|i| if i % width < width / 2 { 40 } else { 160 }).collect();
            let view = GrayView::packed(&data, width, height).unwrap();
            let mut pyramid = Pyramid::default();
            pyramid.build(view, 9, 24);
            let found = ShadowFinder::default().find(view, &pyramid);
            assert_eq!(found.is_some(), width == 240, "{width} x {height}");
        }
    }
}
