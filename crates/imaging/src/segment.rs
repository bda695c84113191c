//! Finds straight edge segments in an image: pixels of the strongest gradient chained along the edge, split
//! where the chain bends, fitted with lines.
//!
//! Where a threshold fails (the edge of a shadow, glare, an occluder), edges are still there, in pieces. A
//! chain continues while the gradient keeps its direction, and the lines are exact to a fraction of a pixel.
//! This is edge drawing (Topal and Akinlar, 2012), with the direction of the gradient in place of its
//! routing.

use crate::kernels::with_vectors;
use crate::view::GrayView;

/// A straight edge. Its dark side is to the right of the direction from start to end, so the segments of a
/// dark shape run clockwise as seen in the image.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Segment {
    /// Where it starts, in pixels.
    pub start: [f32; 2],
    /// Where it ends, in pixels.
    pub end: [f32; 2],
    /// Mean gradient, in grey levels per pixel.
    pub gradient: f32,
}

impl Segment {
    /// Its length in pixels.
    pub fn length(&self) -> f32 {
        length([self.end[0] - self.start[0], self.end[1] - self.start[1]])
    }
}

/// Faster than `hypot`, whose protection against overflow is not needed here.
fn length([dx, dy]: [f32; 2]) -> f32 {
    (dx * dx + dy * dy).sqrt()
}

/// Which segments are retained.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct SegmentLimits {
    /// Minimum gradient, in grey levels per pixel.
    pub min_gradient: u8,
    /// Minimum length, in pixels.
    pub min_length_px: f32,
}

/// Maximum length of a chain, in pixels; the rest becomes the next chain.
const MAX_CHAIN: usize = 1024;

/// Memory is reserved for one segment in this many pixels.
const PIXELS_PER_SEGMENT: usize = 50;

/// A chain is split where it deviates from the straight line by more, in pixels.
const STRAIGHT_PX: f32 = 0.8;

/// Finds segments. Its buffers are reused from image to image.
#[derive(Clone, Debug, Default)]
pub struct Segments {
    width: usize,
    height: usize,
    /// Twice the gradient in the middle of four pixels, whose top left one is at the same index.
    across: Vec<i16>,
    down: Vec<i16>,
    /// Sum of the two gradients' sizes, of three rows.
    strengths: [Vec<i16>; 3],
    /// Not zero where the gradient is strongest across the edge and no chain has passed yet; written by
    /// [`strongest`].
    edges: Vec<u8>,
    /// Not zero where an edge continues on both sides.
    seeds: Vec<u8>,
    /// Indices of the pixels of a chain, then their places and strengths.
    chain: Vec<u32>,
    places: Vec<[f32; 3]>,
    parts: Vec<[usize; 2]>,
    found: Vec<Segment>,
}

impl Segments {
    /// Reserves memory for a textured image of this size.
    pub fn make_room(&mut self, width: usize, height: usize) {
        fn reserve<T>(list: &mut Vec<T>, count: usize) {
            list.reserve(count.saturating_sub(list.len()));
        }
        let pixels = width * height;
        reserve(&mut self.across, pixels);
        reserve(&mut self.down, pixels);
        reserve(&mut self.edges, pixels);
        reserve(&mut self.seeds, pixels.next_multiple_of(8));
        for row in &mut self.strengths {
            reserve(row, width);
        }
        reserve(&mut self.chain, MAX_CHAIN + 1);
        reserve(&mut self.places, MAX_CHAIN + 1);
        reserve(&mut self.parts, MAX_CHAIN);
        reserve(&mut self.found, pixels / PIXELS_PER_SEGMENT);
    }

    /// Finds the segments in an image, in no particular order.
    pub fn find(&mut self, view: GrayView<'_>, limits: SegmentLimits) -> &[Segment] {
        self.found.clear();
        if view.width() < 4 || view.height() < 4 {
            return &self.found;
        }
        (self.width, self.height) = (view.width(), view.height());
        with_vectors(|| self.mark(view, limits));
        for start in 0..self.seeds.len() / 8 {
            let eight = &self.seeds[8 * start..][..8];
            if eight == [0; 8] {
                continue;
            }
            for seed in 8 * start..8 * start + 8 {
                if self.seeds[seed] != 0 && self.edges[seed] != 0 {
                    self.follow(seed);
                    self.cut(limits);
                }
            }
        }
        &self.found
    }

    /// Finds the edge pixels, and where chains may begin.
    #[inline(always)]
    fn mark(&mut self, view: GrayView<'_>, limits: SegmentLimits) {
        self.measure(view);
        self.thin(limits);
        self.sow();
    }

    #[inline(always)]
    fn measure(&mut self, view: GrayView<'_>) {
        let (width, height) = (self.width, self.height);
        self.across.resize(width * height, 0);
        self.down.resize(width * height, 0);
        for y in 0..height - 1 {
            let (above, below) = (view.row(y), view.row(y + 1));
            let across = &mut self.across[y * width..][..width - 1];
            let down = &mut self.down[y * width..][..width - 1];
            gradients(above, below, across, down);
            // There are none behind the last column; an image before may have left some there.
            self.across[y * width + width - 1] = 0;
            self.down[y * width + width - 1] = 0;
        }
    }

    #[inline(always)]
    fn thin(&mut self, limits: SegmentLimits) {
        let (width, height) = (self.width, self.height);
        self.edges.clear();
        self.edges.resize(width * height, 0);
        for row in &mut self.strengths {
            row.resize(width, 0);
        }
        let min_strength = 2 * i16::from(limits.min_gradient);
        for y in 0..height - 1 {
            self.strengths.rotate_left(1);
            let (across, down) =
                (&self.across[y * width..][..width], &self.down[y * width..][..width]);
            let [above, here, below] = &mut self.strengths;
            strengths(across, down, below);
            if y < 2 {
                continue;
            }
            let start = (y - 1) * width;
            strongest(
                [&self.across[start..][..width], &self.down[start..][..width]],
                [above, here, below],
                min_strength,
                &mut self.edges[start..][..width],
            );
        }
    }

    /// Marks where chains may begin: texture has many edge pixels, but few that continue on both sides.
    #[inline(always)]
    fn sow(&mut self) {
        let (width, height) = (self.width, self.height);
        // The last pixels up to a multiple of eight are never seeds.
        self.seeds.clear();
        self.seeds.resize((width * height).next_multiple_of(8), 0);
        for y in 1..height - 1 {
            let row = |y: usize| &self.edges[y * width..][..width];
            let out = &mut self.seeds[y * width..][..width];
            continued([row(y - 1), row(y), row(y + 1)], out);
        }
    }

    /// Writes the chain through `seed` to `self.chain`, the dark side on its right.
    fn follow(&mut self, seed: usize) {
        self.chain.clear();
        self.walk(seed, false);
        self.chain.reverse();
        self.chain.push(seed as u32);
        self.walk(seed, true);
        self.edges[seed] = 0;
    }

    /// Continues from `seed` over edge pixels whose gradients have the seed's direction.
    fn walk(&mut self, seed: usize, forward: bool) {
        let turn = if forward { 0 } else { 4 };
        let ahead = AHEAD[usize::from(self.edges[seed] >> 4)].map(|octant| {
            let [dx, dy] = NEIGHBOURS[(octant + turn) % 8];
            dy * self.width as isize + dx
        });
        let direction = self.edges[seed];
        let mut at = seed;
        while self.chain.len() < MAX_CHAIN {
            let next = ahead.iter().find_map(|step| {
                // An edge pixel is never in the outermost rows or columns.
                let next = at.wrapping_add_signed(*step);
                let edge = self.edges[next];
                is_like(direction, edge).then_some(next)
            });
            let Some(next) = next else { return };
            self.edges[next] = 0;
            self.chain.push(next as u32);
            at = next;
        }
    }

    /// Sub-pixel location of the gradient's maximum about an edge pixel, and the strength there.
    fn place(&self, at: usize) -> [f32; 3] {
        let (y, x) = (at / self.width, at % self.width);
        let strength = |at: usize| {
            f32::from(self.across[at].saturating_abs()) + f32::from(self.down[at].saturating_abs())
        };
        let sideways = self.across[at].saturating_abs() > self.down[at].saturating_abs();
        let step = if sideways { 1 } else { self.width };
        let (before, here, after) = (strength(at - step), strength(at), strength(at + step));
        let bend = before - 2.0 * here + after;
        let shift = if bend < 0.0 { (0.5 * (before - after) / bend).clamp(-0.5, 0.5) } else { 0.0 };
        let (x, y) = (x as f32 + 0.5, y as f32 + 0.5);
        if sideways { [x + shift, y, here] } else { [x, y + shift, here] }
    }

    /// Splits the chain into straight parts and keeps those that are long enough.
    fn cut(&mut self, limits: SegmentLimits) {
        // A diagonal chain is longer than its number of pixels.
        if (self.chain.len() as f32) * std::f32::consts::SQRT_2 < limits.min_length_px {
            return;
        }
        self.places.clear();
        for index in 0..self.chain.len() {
            let place = self.place(self.chain[index] as usize);
            self.places.push(place);
        }
        self.parts.clear();
        self.parts.push([0, self.places.len()]);
        while let Some([from, to]) = self.parts.pop() {
            let chain = &self.places[from..to];
            let (Some(first), Some(last)) = (chain.first(), chain.last()) else { continue };
            let length = length([last[0] - first[0], last[1] - first[1]]);
            if length + 1.0 < limits.min_length_px {
                continue;
            }
            let [dx, dy] = [(last[0] - first[0]) / length, (last[1] - first[1]) / length];
            let (farthest, distance) = chain
                .iter()
                .map(|p| ((p[0] - first[0]) * dy - (p[1] - first[1]) * dx).abs())
                .enumerate()
                .fold((0, 0.0), |max, here| if here.1 > max.1 { here } else { max });
            if distance > STRAIGHT_PX {
                self.parts.push([from, from + farthest]);
                self.parts.push([from + farthest, to]);
            } else {
                self.found.extend(fit(chain).filter(|s| s.length() >= limits.min_length_px));
            }
        }
    }
}

/// The eight neighbours, clockwise as seen in the image from the right one.
const NEIGHBOURS: [[isize; 2]; 8] =
    [[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]];

/// An edge pixel. Its upper four bits are the direction of its gradient, in sixteenths of a turn, clockwise
/// as seen in the image from the right, so that differences of directions wrap like bytes.
const EDGE: u8 = 1;

/// Whether a pixel is an edge whose direction differs by no more than a sixteenth of a turn.
#[inline(always)]
fn is_like(direction: u8, other: u8) -> bool {
    (other.wrapping_sub(direction).wrapping_add(16) <= 32) & (other != 0)
}

/// For each direction of a gradient the neighbours to which its edge may continue, likeliest first, with the
/// dark side on the right.
static AHEAD: [[usize; 3]; 16] = ahead();

const fn ahead() -> [[usize; 3]; 16] {
    let mut ahead = [[0; 3]; 16];
    let mut direction = 0;
    while direction < 16 {
        let edge: usize = (direction + 4) % 16;
        let nearest = edge.div_ceil(2);
        let (second, third) = if edge.is_multiple_of(2) { (1, 7) } else { (7, 1) };
        ahead[direction] = [nearest % 8, (nearest + second) % 8, (nearest + third) % 8];
        direction += 1;
    }
    ahead
}

/// Twice the gradients in the middle of each two by two pixels.
#[inline(always)]
fn gradients(above: &[u8], below: &[u8], across: &mut [i16], down: &mut [i16]) {
    let above = above.iter().zip(&above[1..]);
    let below = below.iter().zip(&below[1..]);
    for (((a, b), (c, d)), (across, down)) in
        above.zip(below).zip(across.iter_mut().zip(down.iter_mut()))
    {
        let [a, b, c, d] = [*a, *b, *c, *d].map(i16::from);
        let (falling, rising) = (d - a, b - c);
        *across = falling + rising;
        *down = falling - rising;
    }
}

#[inline(always)]
fn strengths(across: &[i16], down: &[i16], out: &mut [i16]) {
    for ((out, across), down) in out.iter_mut().zip(across).zip(down) {
        *out = across.wrapping_abs() + down.wrapping_abs();
    }
}

/// Marks where the strength is at least `min_strength` and the largest along the axis the gradient is nearest
/// to, and writes the gradient's direction, as [`EDGE`] defines.
#[inline(always)]
fn strongest(
    [across, down]: [&[i16]; 2],
    [above, here, below]: [&[i16]; 3],
    min_strength: i16,
    out: &mut [u8],
) {
    let inner = out.len().saturating_sub(2);
    // Slices of one length spare bounds checks in the loop.
    let (left, right) = (&here[..inner], &here[2..][..inner]);
    let (above, here, below) = (&above[1..][..inner], &here[1..][..inner], &below[1..][..inner]);
    let (across, down) = (&across[1..][..inner], &down[1..][..inner]);
    let out = &mut out[1..][..inner];
    for x in 0..inner {
        let (ax, ay) = (across[x].wrapping_abs(), down[x].wrapping_abs());
        let sideways = ax > ay;
        let along_row = (here[x] > left[x]) & (here[x] >= right[x]);
        let along_column = (here[x] > above[x]) & (here[x] >= below[x]);
        let is_max =
            (here[x] >= min_strength) & ((sideways & along_row) | (!sideways & along_column));
        // More than 22.5 degrees from the nearer axis, whose tangent is close to 5 / 12.
        let oblique = 12 * ax.min(ay) > 5 * ax.max(ay);
        // The sixteenth within the quarter of both signs positive, then mirrored into the others.
        let direction = i16::from(oblique)
            ^ (3 & -i16::from(!sideways))
            ^ (7 & -i16::from(across[x] < 0))
            ^ (15 & -i16::from(down[x] < 0));
        out[x] = ((direction << 4 | i16::from(EDGE)) & -i16::from(is_max)) as u8;
    }
}

/// Marks the edge pixels of the middle row with at least two neighbours of similar direction.
#[inline(always)]
fn continued([above, here, below]: [&[u8]; 3], out: &mut [u8]) {
    let inner = out.len().saturating_sub(2);
    let around = [
        &above[..inner],
        &above[1..][..inner],
        &above[2..][..inner],
        &here[..inner],
        &here[2..][..inner],
        &below[..inner],
        &below[1..][..inner],
        &below[2..][..inner],
    ];
    let here = &here[1..][..inner];
    let out = &mut out[1..][..inner];
    for x in 0..inner {
        let mut like = 0;
        for row in around {
            like += u8::from(is_like(here[x], row[x]));
        }
        out[x] = u8::from((like >= 2) & (here[x] != 0));
    }
}

/// The least-squares line through a chain, from the projection of its first point to that of its last.
fn fit(chain: &[[f32; 3]]) -> Option<Segment> {
    let (first, last) = (chain.first()?, chain.last()?);
    let count = chain.len() as f32;
    let mut sums = [0.0_f32; 6];
    for [x, y, strength] in chain {
        let (x, y) = (x - first[0], y - first[1]);
        for (sum, term) in sums.iter_mut().zip([x, y, x * x, x * y, y * y, *strength]) {
            *sum += term;
        }
    }
    let [x, y, xx, xy, yy, strength] = sums.map(|sum| sum / count);
    let (xx, xy, yy) = (xx - x * x, xy - x * y, yy - y * y);
    let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
    let (dy, dx) = angle.sin_cos();
    let middle = [first[0] + x, first[1] + y];
    let projected = |p: &[f32; 3]| {
        let along = (p[0] - middle[0]) * dx + (p[1] - middle[1]) * dy;
        [middle[0] + along * dx, middle[1] + along * dy]
    };
    Some(Segment { start: projected(first), end: projected(last), gradient: 0.5 * strength })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::view::GrayImage;

    const LIMITS: SegmentLimits = SegmentLimits { min_gradient: 6, min_length_px: 5.0 };

    /// A dark square, turned by `angle`, on bright ground; each pixel has the mean of 16 places.
    fn square(angle: f32, centre: [f32; 2], half: f32) -> GrayImage {
        let mut image = GrayImage::filled(120, 100, 0);
        let (sin, cos) = angle.sin_cos();
        for y in 0..100 {
            for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
                let dark = (0..16).filter(|i| {
                    let dx = x as f32 - 0.375 + 0.25 * (i % 4) as f32 - centre[0];
                    let dy = y as f32 - 0.375 + 0.25 * (i / 4) as f32 - centre[1];
                    (dx * cos + dy * sin).abs().max((dy * cos - dx * sin).abs()) < half
                });
                *pixel = 200 - 10 * dark.count() as u8;
            }
        }
        image
    }

    #[test]
    fn the_sides_of_a_square_are_found_in_place_and_clockwise() {
        let centre = [60.3, 49.8];
        for step in 0..40 {
            let angle = 0.04 * step as f32;
            let image = square(angle, centre, 30.0);
            let mut segments = Segments::default();
            let found = segments.find(image.view().unwrap(), LIMITS);
            let mut seen = [0.0; 4];
            for segment in found {
                // From the centre to the segment is the side's outward normal.
                let mut sides = [0.0; 2];
                for (side, [x, y]) in sides.iter_mut().zip([segment.start, segment.end]) {
                    let (dx, dy) = (x - centre[0], y - centre[1]);
                    let length = segment.length();
                    let across =
                        [segment.end[1] - segment.start[1], segment.start[0] - segment.end[0]];
                    *side = (dx * across[0] + dy * across[1]) / length;
                }
                for side in sides {
                    assert!((side - 30.0).abs() < 0.5, "{angle}: {side} in {segment:?}");
                }
                let direction =
                    (segment.end[1] - segment.start[1]).atan2(segment.end[0] - segment.start[0]);
                let quarter = (direction - angle) / std::f32::consts::FRAC_PI_2;
                seen[(quarter.round() as i32).rem_euclid(4) as usize] += segment.length();
            }
            for length in seen {
                assert!((48.0..=60.5).contains(&length), "{angle}: {seen:?}");
            }
        }
    }

    #[test]
    fn flat_and_noisy_images_are_harmless() {
        let mut segments = Segments::default();
        let mut random = 1_u32;
        for (width, height) in [(1, 1), (3, 9), (4, 4), (5, 64), (64, 5), (97, 61), (33, 2)] {
            let mut image = GrayImage::filled(width, height, 128);
            assert!(segments.find(image.view().unwrap(), LIMITS).is_empty());
            for pattern in 0..4 {
                for (i, pixel) in image.pixels_mut().iter_mut().enumerate() {
                    random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    *pixel = match pattern {
                        0 => (random >> 24) as u8,
                        1 => 255 * ((i % width + i / width) % 2) as u8,
                        2 => 255 * (i % width / 2 % 2) as u8,
                        _ => 255 * (i / width / 3 % 2) as u8,
                    };
                }
                for segment in segments.find(image.view().unwrap(), LIMITS) {
                    assert!(segment.start.iter().chain(&segment.end).all(|v| v.is_finite()));
                }
            }
        }
    }

    #[test]
    fn an_edge_at_the_border_is_found_whatever_the_image_before() {
        let mut image = GrayImage::filled(64, 48, 50);
        for y in 0..48 {
            image.row_mut(y)[63] = 200;
        }
        let mut stripes = GrayImage::filled(50, 64, 0);
        for y in 0..64 {
            stripes.row_mut(y).iter_mut().skip(1).step_by(2).for_each(|pixel| *pixel = 255);
        }
        let mut segments = Segments::default();
        let first = segments.find(image.view().unwrap(), LIMITS).to_vec();
        assert_eq!(first.len(), 1, "{first:?}");
        segments.find(stripes.view().unwrap(), LIMITS);
        assert_eq!(segments.find(image.view().unwrap(), LIMITS), first);
    }

    #[test]
    fn a_circle_has_no_long_segment() {
        let mut image = GrayImage::filled(200, 200, 0);
        for y in 0..200 {
            for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
                let beyond = (x as f32 - 99.5).hypot(y as f32 - 99.5) - 80.0;
                *pixel = (20.0 + 180.0 * (beyond + 0.5).clamp(0.0, 1.0)) as u8;
            }
        }
        let mut segments = Segments::default();
        let found = segments.find(image.view().unwrap(), LIMITS);
        assert!(found.iter().all(|segment| segment.length() < 35.0));
    }
}
