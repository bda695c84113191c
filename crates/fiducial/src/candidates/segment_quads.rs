//! Quads from edge segments, for markers whose outline is not closed.
//!
//! The edge of a shadow, glare or an object in front interrupts the outline of a marker, and the frame cuts
//! it. Its sides are still straight, dark on the inside, and meet at corners. So sides are joined across
//! gaps; a corner is where one side ends and another begins with a turn to the right; a quad goes around two,
//! three or four sides. A hidden corner lies where its sides would meet; a hidden side joins the ends of its
//! neighbours.

use geometry::Pixel;
use imaging::pyramid::to_level_0;
use imaging::{GrayView, Pyramid, Segment, SegmentLimits, Segments};

use crate::candidates::quad::Quad;

/// A quad, and how much of it is visible.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct SegmentQuad {
    pub(crate) quad: Quad,
    /// The fraction of its perimeter on which there are edges.
    pub(crate) visible: f32,
}

/// From pixels of a pyramid level to pixels of the image: `scale` times the level's, plus `offset`.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Placement {
    /// Image pixels per pixel of the level.
    pub(crate) scale: f32,
    /// Place of the level's first pixel in the image.
    pub(crate) offset: f32,
}

/// Segments are found on the finest level of the pyramid with at most this number of pixels, and on the next one: with half as
/// many, markers of 40 to 110 pixels in photographs of two and three million pixels were too small for it.
const MAX_PIXELS: usize = 800_000;

/// One of the levels on which segments are found.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) enum Scale {
    Fine,
    Coarse,
}

impl Scale {
    pub(crate) const ALL: [Self; 2] = [Self::Fine, Self::Coarse];
}

/// Smallest gradient of a marker's sides, in grey levels per pixel: this fraction of the image's brightest
/// part, within these bounds. Textures have many weaker edges; so has a marker deep in the shade beside
/// sunlit ground, which is then found only where it is sharp.
const BRIGHTEST_PER_GRADIENT: u8 = 12;
const MIN_GRADIENT: u8 = 6;
const MAX_MIN_GRADIENT: u8 = 10;
/// Smallest length of a segment, in pixels.
const MIN_LENGTH_PX: f32 = 6.0;
/// The brightest part is measured this many levels above, where small glints vanish.
const BRIGHTNESS_LEVELS: usize = 2;

/// The segment quads of an image, shared by all families. It keeps its memory from image to image.
#[derive(Clone, Debug, Default)]
pub(crate) struct ImageQuads {
    segments: Segments,
    joining: SegmentQuads,
    quads: Vec<Quad>,
    /// The levels still to be searched.
    scales: [Option<Scale>; 2],
}

impl ImageQuads {
    /// Makes the buffers as large as frames with texture need, for images of this size.
    pub(crate) fn make_room(&mut self, view: GrayView<'_>) {
        let (mut width, mut height) = (view.width(), view.height());
        while width * height > MAX_PIXELS {
            (width, height) = (width / 2, height / 2);
        }
        self.segments.make_room(width, height);
        self.joining.make_room([width, height]);
        self.quads.clear();
        self.quads.reserve(2 * Scale::ALL.len() * MAX_QUADS);
    }

    /// Begins another image, of which these levels are to be searched.
    pub(crate) fn begin(&mut self, scales: [Option<Scale>; 2]) {
        self.quads.clear();
        self.scales = scales;
    }

    /// Makes the quads of the image that `pyramid` belongs to; false when they were made before.
    pub(crate) fn make(&mut self, view: GrayView<'_>, pyramid: &Pyramid) -> bool {
        let scales = std::mem::take(&mut self.scales);
        scales.iter().flatten().for_each(|scale| self.add(view, pyramid, *scale));
        scales.iter().any(Option::is_some)
    }

    /// The quads: of the finer level first, on each the dark ones first, then by score.
    pub(crate) fn quads(&self) -> &[Quad] {
        &self.quads
    }

    fn add(&mut self, view: GrayView<'_>, pyramid: &Pyramid, scale: Scale) {
        let pixels = |level: usize| (view.width() * view.height()) >> (2 * level.min(31));
        let finest = (0..pyramid.levels()).find(|level| pixels(*level) <= MAX_PIXELS);
        let finest = finest.unwrap_or(pyramid.levels().saturating_sub(1));
        let level = finest + usize::from(scale == Scale::Coarse);
        let Some(image) = pyramid.level(view, level) else { return };
        let far = pyramid.level(view, finest + BRIGHTNESS_LEVELS).unwrap_or(image);
        let segments = self.segments.find(image, segment_limits(far));
        let offset = to_level_0(0.0, level) as f32;
        let placement = Placement { scale: 1.0 + 2.0 * offset, offset };
        let size = [image.width(), image.height()];
        for inverted in [false, true] {
            let found = self.joining.find(segments, size, placement, inverted);
            self.quads.extend(found.iter().map(|found| found.quad));
        }
    }
}

/// Bounds on the edges of markers, for an image of this brightness.
fn segment_limits(view: GrayView<'_>) -> SegmentLimits {
    let brightest = (0..view.height()).filter_map(|y| view.row(y).iter().copied().max()).max();
    let brightest = brightest.unwrap_or(0);
    let min_gradient = (brightest / BRIGHTEST_PER_GRADIENT).clamp(MIN_GRADIENT, MAX_MIN_GRADIENT);
    SegmentLimits { min_gradient, min_length_px: MIN_LENGTH_PX }
}

/// Bounds on the work in one level.
const MAX_SIDES: usize = 6000;
const MAX_CORNERS: usize = 16_000;
const MAX_CORNERS_PER_SIDE: usize = 6;
const MAX_PROPOSALS: usize = 4000;
/// Largest number of quads returned, of either polarity.
const MAX_QUADS: usize = 150;

/// Cell size of the grid in which sides are looked up, in pixels.
const CELL_PX: f32 = 16.0;

/// Joins segments to quads. It keeps its memory from image to image.
#[derive(Clone, Debug, Default)]
pub(crate) struct SegmentQuads {
    sides: Vec<Side>,
    starts: Grid,
    corners: Vec<Corner>,
    /// Index in `corners` of the first corner at the end of each side.
    corners_from: Vec<u32>,
    proposals: Vec<Proposal>,
    found: Vec<SegmentQuad>,
}

/// A straight side: a segment, or several in one line.
#[derive(Copy, Clone, Debug)]
struct Side {
    start: [f32; 2],
    end: [f32; 2],
    direction: [f32; 2],
    length: f32,
    /// The length over which there is an edge.
    visible: f32,
}

/// Where a side ends and the next one begins.
#[derive(Copy, Clone, Debug)]
struct Corner {
    next: u32,
    place: [f32; 2],
    gap: f32,
}

#[derive(Copy, Clone, Debug)]
struct Proposal {
    corners: [[f32; 2]; 4],
    visible: f32,
    score: f32,
}

impl SegmentQuads {
    fn make_room(&mut self, [width, height]: [usize; 2]) {
        fn reserve<T>(list: &mut Vec<T>, count: usize) {
            list.reserve(count.saturating_sub(list.len()));
        }
        reserve(&mut self.sides, MAX_SIDES);
        reserve(&mut self.corners, MAX_CORNERS + MAX_CORNERS);
        reserve(&mut self.corners_from, MAX_SIDES + 1);
        reserve(&mut self.proposals, MAX_PROPOSALS);
        reserve(&mut self.found, MAX_QUADS);
        reserve(&mut self.starts.sides, MAX_SIDES);
        let cells = (width / CELL_PX as usize + 1) * (height / CELL_PX as usize + 1);
        reserve(&mut self.starts.from, cells + 1);
    }

    /// The quads of these segments of a level of `size` pixels, in the image's pixels, best first: dark ones,
    /// or bright ones when `inverted`.
    pub(crate) fn find(
        &mut self,
        segments: &[Segment],
        size: [usize; 2],
        placement: Placement,
        inverted: bool,
    ) -> &[SegmentQuad] {
        self.found.clear();
        self.sides.clear();
        let sides = segments.iter().filter_map(|segment| Side::from_segment(segment, inverted));
        self.sides.extend(sides.take(MAX_SIDES / 2));
        self.starts.fill(&self.sides, size);
        self.join();
        self.starts.fill(&self.sides, size);
        self.find_corners();
        self.propose(size);
        self.choose(placement, inverted);
        &self.found
    }

    /// Adds sides that consist of several segments on one line.
    fn join(&mut self) {
        let count = self.sides.len();
        for index in 0..count {
            let mut whole = self.sides[index];
            for _ in 0..3 {
                let Some(next) = self.continuation(&whole) else { break };
                if self.sides.len() >= MAX_SIDES {
                    return;
                }
                whole = whole.joined(&self.sides[next]);
                self.sides.push(whole);
            }
        }
    }

    /// The nearest segment ahead on the same line.
    fn continuation(&self, side: &Side) -> Option<usize> {
        if side.length < 8.0 {
            return None;
        }
        let reach = (1.5 * side.length).clamp(8.0, 160.0);
        let mut best = None;
        let mut nearest = reach;
        let mut last_cell = usize::MAX;
        let mut along = 0.0;
        while along <= nearest {
            for offset in [-2.0, 2.0] {
                let x = side.end[0] + along * side.direction[0] - offset * side.direction[1];
                let y = side.end[1] + along * side.direction[1] + offset * side.direction[0];
                let Some(cell) = self.starts.cell([x, y]) else { continue };
                if cell == last_cell {
                    continue;
                }
                last_cell = cell;
                for other in self.starts.within(cell) {
                    let gap = side.gap_to(&self.sides[*other as usize]);
                    if let Some(gap) = gap.filter(|gap| *gap < nearest) {
                        nearest = gap;
                        best = Some(*other as usize);
                    }
                }
            }
            along += 0.5 * CELL_PX;
        }
        best
    }

    /// Finds the corners.
    fn find_corners(&mut self) {
        self.corners.clear();
        self.corners_from.clear();
        for index in 0..self.sides.len() {
            let from = self.corners.len();
            self.corners_from.push(from as u32);
            if from >= MAX_CORNERS {
                continue;
            }
            let side = self.sides[index];
            let reach = 3.0 + 0.08 * side.length.min(80.0);
            for cell in self.starts.around(side.end, reach) {
                for other in self.starts.within(cell) {
                    let next = &self.sides[*other as usize];
                    if let Some((place, gap)) = side.corner_with(next, reach) {
                        self.corners.push(Corner { next: *other, place, gap });
                    }
                }
            }
            let these = &mut self.corners[from..];
            if these.len() > MAX_CORNERS_PER_SIDE {
                these.sort_unstable_by(|a, b| a.gap.total_cmp(&b.gap));
                self.corners.truncate(from + MAX_CORNERS_PER_SIDE);
            }
        }
        self.corners_from.push(self.corners.len() as u32);
    }

    fn corners_of(&self, side: usize) -> &[Corner] {
        &self.corners[self.corners_from[side] as usize..self.corners_from[side + 1] as usize]
    }

    /// Proposes quads around four, three and two sides.
    fn propose(&mut self, size: [usize; 2]) {
        let mut proposals = std::mem::take(&mut self.proposals);
        proposals.clear();
        for (index, a) in self.sides.iter().enumerate() {
            for first in self.corners_of(index) {
                let b = &self.sides[first.next as usize];
                if proposals.len() >= MAX_PROPOSALS {
                    break;
                }
                two_sides([a, b], first.place, &mut proposals);
                for second in self.corners_of(first.next as usize) {
                    let c = &self.sides[second.next as usize];
                    if dot(a.direction, c.direction) > -0.4 {
                        continue;
                    }
                    let places = [first.place, second.place];
                    three_sides([a, b, c], places, size, &mut proposals);
                    for third in self.corners_of(second.next as usize) {
                        let d = &self.sides[third.next as usize];
                        let places = [first.place, second.place, third.place];
                        four_sides([a, b, c, d], places, &mut proposals);
                    }
                }
            }
        }
        self.proposals = proposals;
    }

    /// Keeps the best proposals, each place once.
    fn choose(&mut self, placement: Placement, inverted: bool) {
        self.proposals.sort_unstable_by(|a, b| b.score.total_cmp(&a.score));
        let place = |p: [f32; 2]| {
            let [x, y] = p.map(|v| f64::from(v * placement.scale + placement.offset));
            Pixel::new(x, y)
        };
        let mut kept = 0;
        for index in 0..self.proposals.len() {
            let proposal = self.proposals[index];
            if self.proposals[..kept].iter().any(|other| other.is_like(&proposal)) {
                continue;
            }
            self.proposals[kept] = proposal;
            kept += 1;
            let quad = Quad { corners: proposal.corners.map(place), inverted };
            self.found.push(SegmentQuad { quad, visible: proposal.visible });
            if kept == MAX_QUADS {
                return;
            }
        }
    }
}

/// Around four sides, of which the last corner may be hidden.
fn four_sides([a, b, c, d]: [&Side; 4], [ab, bc, cd]: [[f32; 2]; 3], out: &mut Vec<Proposal>) {
    let Some(da) = intersection(d, a) else { return };
    // How far the two sides extend beyond their visible part.
    let beyond_d = dot(minus(da, d.end), d.direction);
    let beyond_a = dot(minus(a.start, da), a.direction);
    let lies_near = |beyond: f32, side: &Side| {
        beyond > -0.15 * side.length - 3.0 && beyond < 0.8 * side.length + 3.0
    };
    if lies_near(beyond_d, d) && lies_near(beyond_a, a) {
        Proposal::add([da, ab, bc, cd], [a, b, c, d], out);
    }
}

/// Around three sides; the fourth joins their ends, or is parallel to the second.
fn three_sides(
    sides: [&Side; 3],
    [ab, bc]: [[f32; 2]; 2],
    size: [usize; 2],
    out: &mut Vec<Proposal>,
) {
    let [a, b, c] = sides;
    let (first, last) = (distance(a.start, ab), distance(bc, c.end));
    if is_at_frame(a.start, size) || is_at_frame(c.end, size) {
        // How far the marker extends beyond the frame is unknown, but it is a square.
        let middle = distance(ab, bc);
        for share in [0.84, 0.92, 1.0, 1.09, 1.18] {
            let length = share * middle;
            if length > 0.97 * first.max(last) {
                let start = [ab[0] - length * a.direction[0], ab[1] - length * a.direction[1]];
                let end = [bc[0] + length * c.direction[0], bc[1] + length * c.direction[1]];
                Proposal::add([start, ab, bc, end], [a, b, c], out);
            }
        }
    }
    Proposal::add([a.start, ab, bc, c.end], sides, out);
    if (first - last).abs() > 0.06 * first.max(last) {
        let (start, end) = if first > last {
            (a.start, plus(bc, minus(a.start, ab)))
        } else {
            (plus(ab, minus(c.end, bc)), c.end)
        };
        Proposal::add([start, ab, bc, end], [a, b, c], out);
    }
}

/// Whether a place is at the edge of the level.
fn is_at_frame([x, y]: [f32; 2], [width, height]: [usize; 2]) -> bool {
    const NEAR_PX: f32 = 4.0;
    let beyond = |at: f32, edge: usize| at < NEAR_PX || at > edge as f32 - 1.0 - NEAR_PX;
    beyond(x, width) || beyond(y, height)
}

/// Around two sides, with the other two parallel to them.
fn two_sides([a, b]: [&Side; 2], ab: [f32; 2], out: &mut Vec<Proposal>) {
    if a.length.min(b.length) < 16.0 {
        return;
    }
    let last = plus(a.start, minus(b.end, ab));
    Proposal::add([a.start, ab, b.end, last], [a, b], out);
}

impl Proposal {
    /// Adds the quad with these corners if it may be the image of a square.
    fn add<const N: usize>(corners: [[f32; 2]; 4], sides: [&Side; N], out: &mut Vec<Self>) {
        let mut perimeter = 0.0;
        let (mut shortest, mut longest) = (f32::INFINITY, 0.0_f32);
        for i in 0..4 {
            let [p, q, r] = [corners[i], corners[(i + 1) % 4], corners[(i + 2) % 4]];
            let (side, next) = (minus(q, p), minus(r, q));
            let length = distance(p, q);
            // At each corner it turns right by at least 25 degrees.
            if cross(side, next) < 0.42 * length * distance(q, r) {
                return;
            }
            perimeter += length;
            shortest = shortest.min(length);
            longest = longest.max(length);
        }
        if shortest < 5.0 || longest > 4.0 * shortest || out.len() >= MAX_PROPOSALS {
            return;
        }
        let visible: f32 = sides.iter().map(|side| side.visible).sum();
        let visible = (visible / perimeter).min(1.0);
        let score = visible * visible * (1.0 + perimeter / 200.0).min(2.0);
        out.push(Self { corners, visible, score });
    }

    fn is_like(&self, other: &Self) -> bool {
        let edge = distance(self.corners[0], self.corners[1]);
        let near = 0.03 * edge + 0.5;
        (0..4).any(|turn| {
            (0..4).all(|i| {
                let [dx, dy] = minus(self.corners[i], other.corners[(i + turn) % 4]);
                dx.abs() < near && dy.abs() < near
            })
        })
    }
}

impl Side {
    /// A segment with the dark side on the right, or the bright one when `inverted`.
    fn from_segment(segment: &Segment, inverted: bool) -> Option<Self> {
        let length = segment.length();
        let (start, end) = (segment.start, segment.end);
        let (start, end) = if inverted { (end, start) } else { (start, end) };
        (length > 1.0).then(|| Self::between(start, end, length))
    }

    fn between(start: [f32; 2], end: [f32; 2], visible: f32) -> Self {
        let along = minus(end, start);
        let length = dot(along, along).sqrt().max(1e-3);
        Self { start, end, direction: along.map(|v| v / length), length, visible }
    }

    /// The gap to the start of a side that continues this one's line.
    fn gap_to(&self, other: &Self) -> Option<f32> {
        // Few others have its direction.
        let is_along = dot(self.direction, other.direction) > 0.98;
        if !is_along {
            return None;
        }
        let to_start = minus(other.start, self.end);
        let along = dot(to_start, self.direction);
        let to_end = minus(other.end, self.end);
        let far = dot(to_end, self.direction);
        let offset = |to: [f32; 2], along: f32| {
            cross(self.direction, to).abs() <= 0.8 + 0.03 * along.max(0.0)
        };
        let in_line = along > -2.0
            && far > along
            && along < 1.5 * (self.length + other.length)
            && offset(to_start, along)
            && offset(to_end, far);
        in_line.then_some(along.max(0.0))
    }

    /// One side for this one and one that continues it: the line through both, weighted by their visible
    /// lengths.
    fn joined(&self, other: &Self) -> Self {
        let middle = |side: &Self| mix(side.start, side.end, 0.5);
        let (a, b) = (middle(self), middle(other));
        let weight = other.visible / (self.visible + other.visible);
        let centre = mix(a, b, weight);
        // Second moments of two rods.
        let mut xx = 0.0;
        let mut xy = 0.0;
        let mut yy = 0.0;
        for (side, middle) in [(self, a), (other, b)] {
            let [dx, dy] = minus(middle, centre);
            let spread = side.visible * side.length * side.length / 12.0;
            xx += side.visible * dx * dx + spread * side.direction[0] * side.direction[0];
            xy += side.visible * dx * dy + spread * side.direction[0] * side.direction[1];
            yy += side.visible * dy * dy + spread * side.direction[1] * side.direction[1];
        }
        let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
        let (dy, dx) = angle.sin_cos();
        let beside = |p: [f32; 2]| {
            let along = dot(minus(p, centre), [dx, dy]);
            [centre[0] + along * dx, centre[1] + along * dy]
        };
        Self::between(beside(self.start), beside(other.end), self.visible + other.visible)
    }

    /// Where this side meets the next one, and how much of both is missing there.
    fn corner_with(&self, next: &Self, reach: f32) -> Option<([f32; 2], f32)> {
        let between = minus(next.start, self.end);
        if between[0].abs() > 2.0 * reach || between[1].abs() > 2.0 * reach {
            return None;
        }
        if cross(self.direction, next.direction) < 0.42
            || self.length > 8.0 * next.length
            || next.length > 8.0 * self.length
        {
            return None;
        }
        let place = intersection(self, next)?;
        let (first, second) = (distance(place, self.end), distance(place, next.start));
        (first <= reach && second <= reach).then_some((place, first + second))
    }
}

/// Look-up of sides by their start.
#[derive(Clone, Debug, Default)]
struct Grid {
    columns: usize,
    rows: usize,
    from: Vec<u32>,
    sides: Vec<u32>,
}

impl Grid {
    fn fill(&mut self, sides: &[Side], [width, height]: [usize; 2]) {
        self.columns = width / CELL_PX as usize + 1;
        self.rows = height / CELL_PX as usize + 1;
        self.from.clear();
        self.from.resize(self.columns * self.rows + 1, 0);
        for side in sides {
            if let Some(cell) = self.cell(side.start) {
                self.from[cell] += 1;
            }
        }
        let mut sum = 0;
        for from in &mut self.from {
            sum += *from;
            *from = sum;
        }
        self.sides.clear();
        self.sides.resize(sum as usize, 0);
        for (index, side) in sides.iter().enumerate() {
            if let Some(cell) = self.cell(side.start) {
                self.from[cell] -= 1;
                self.sides[self.from[cell] as usize] = index as u32;
            }
        }
    }

    fn cell(&self, [x, y]: [f32; 2]) -> Option<usize> {
        // NaN is outside.
        if !(x >= 0.0 && y >= 0.0) {
            return None;
        }
        let (column, row) = ((x / CELL_PX) as usize, (y / CELL_PX) as usize);
        (column < self.columns && row < self.rows).then(|| row * self.columns + column)
    }

    fn within(&self, cell: usize) -> &[u32] {
        &self.sides[self.from[cell] as usize..self.from[cell + 1] as usize]
    }

    /// The cells that touch a square around a place.
    fn around(&self, [x, y]: [f32; 2], reach: f32) -> impl Iterator<Item = usize> + use<> {
        let range = |v: f32, count: usize| {
            let last = count.saturating_sub(1);
            let from = ((v - reach).max(0.0) / CELL_PX) as usize;
            let to = ((v + reach).max(0.0) / CELL_PX) as usize;
            from.min(last)..to.min(last) + 1
        };
        let (columns, rows) = (range(x, self.columns), range(y, self.rows));
        let width = self.columns;
        rows.flat_map(move |row| columns.clone().map(move |column| row * width + column))
    }
}

/// Where the lines of two sides meet; `None` when they are parallel.
fn intersection(a: &Side, b: &Side) -> Option<[f32; 2]> {
    let sine = cross(a.direction, b.direction);
    if sine.abs() < 0.1 {
        return None;
    }
    let along = cross(minus(b.start, a.end), b.direction) / sine;
    Some([a.end[0] + along * a.direction[0], a.end[1] + along * a.direction[1]])
}

fn dot(a: [f32; 2], b: [f32; 2]) -> f32 {
    a[0] * b[0] + a[1] * b[1]
}

fn cross(a: [f32; 2], b: [f32; 2]) -> f32 {
    a[0] * b[1] - a[1] * b[0]
}

fn minus(a: [f32; 2], b: [f32; 2]) -> [f32; 2] {
    [a[0] - b[0], a[1] - b[1]]
}

fn plus(a: [f32; 2], b: [f32; 2]) -> [f32; 2] {
    [a[0] + b[0], a[1] + b[1]]
}

fn mix(a: [f32; 2], b: [f32; 2], share: f32) -> [f32; 2] {
    [a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])]
}

fn distance(a: [f32; 2], b: [f32; 2]) -> f32 {
    let difference = minus(a, b);
    dot(difference, difference).sqrt()
}
