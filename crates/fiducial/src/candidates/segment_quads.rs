//! Joins straight edge segments into quads where the outline of a square marker is broken by shadow, glare, an object or the frame,
//! with hidden corners and sides added.
//!
//! The sides of such a marker are still straight, dark on the inside, and meet at corners. So sides are joined across gaps; a
//! corner is where one side ends and another begins with a turn to the right; a quad goes around two, three or four sides. A hidden
//! corner lies where its sides would meet; a hidden side joins the ends of its neighbours.

use geometry::Pixel;
use imaging::pyramid::to_level_0;
use imaging::{GrayView, Pyramid, Segment, SegmentLimits, Segments};

use crate::candidates::quad::Quad;
use crate::candidates::sides::{
    CELL_PX, Side, SideGrid, cross, distance, dot, intersection, minus, mix, plus,
};

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

/// The finest level of an image's pyramid on which segments are found.
fn finest_level(view: GrayView<'_>) -> usize {
    let pixels = view.width() * view.height();
    (0..31).find(|level| pixels >> (2 * level) <= MAX_PIXELS).unwrap_or(31)
}

/// Width of a pixel of the coarsest level on which segments are found, in pixels of the image.
pub(crate) fn coarsest_pixel(view: GrayView<'_>) -> f64 {
    (2u64 << finest_level(view)) as f64
}

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
/// part, within these bounds. Textures have many weaker edges; so has a marker deep in the shade next to
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
    /// Those with two hidden corners.
    hidden: Vec<Quad>,
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
        self.quads.reserve(2 * Scale::ALL.len() * (MAX_QUADS + MAX_HIDDEN));
        self.hidden.clear();
        self.hidden.reserve(2 * Scale::ALL.len() * MAX_HIDDEN);
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
        self.quads.append(&mut self.hidden);
        scales.iter().any(Option::is_some)
    }

    /// The quads: of the finer level first, on each the dark ones first, then by score; after all of them, in the same order, those
    /// with two hidden corners.
    pub(crate) fn quads(&self) -> &[Quad] {
        &self.quads
    }

    fn add(&mut self, view: GrayView<'_>, pyramid: &Pyramid, scale: Scale) {
        let finest = finest_level(view).min(pyramid.levels().saturating_sub(1));
        let level = finest + usize::from(scale == Scale::Coarse);
        let Some(image) = pyramid.level(view, level) else { return };
        let far = pyramid.level(view, finest + BRIGHTNESS_LEVELS).unwrap_or(image);
        let segments = self.segments.find(image, segment_limits(far));
        let offset = to_level_0(0.0, level) as f32;
        let placement = Placement { scale: 1.0 + 2.0 * offset, offset };
        for inverted in [false, true] {
            let [quads, hidden] = self.joining.find(segments, image, placement, inverted);
            self.quads.extend_from_slice(quads);
            self.hidden.extend_from_slice(hidden);
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
/// Largest number of quads of either polarity, and of quads with two hidden corners in addition.
const MAX_QUADS: usize = 150;
const MAX_HIDDEN: usize = 60;
/// Largest ratio of two sides of a quad.
const MAX_ASPECT: f32 = 4.0;

/// Largest number of sides looked at beyond hidden corners.
const MAX_LOOKS: usize = 200_000;
/// Quads with two hidden corners: smallest length of the sides next to these, in pixels, largest ratio of two sides, and
/// smallest share of the perimeter that is visible.
const MIN_OPPOSITE_PX: f32 = 8.0;
const MAX_HIDDEN_ASPECT: f32 = 2.5;
const MIN_HIDDEN_VISIBLE: f32 = 0.65;
/// How far hidden corners are searched, over the length of the longest side that is seen.
const MAX_STRETCH: f32 = 1.3;
/// Their border is looked at in twelve places, so deep inside of the quad and as far outside, as a fraction of its size; in so
/// many of them it must stand out.
const BORDER_DEPTH: f32 = 0.06;
const MIN_BORDER_PLACES: usize = 7;

/// Joins segments to quads. It keeps its memory from image to image.
#[derive(Clone, Debug, Default)]
pub(crate) struct SegmentQuads {
    sides: Vec<Side>,
    starts: SideGrid,
    corners: Vec<Corner>,
    /// Index in `corners` of the first corner at the end of each side.
    corners_from: Vec<u32>,
    proposals: Vec<Proposal>,
    /// Those with two hidden corners.
    hidden: Vec<Proposal>,
    chosen: Vec<Proposal>,
    found: Vec<Quad>,
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
    /// Mean of the corners.
    middle: [f32; 2],
    visible: f32,
    score: f32,
}

impl SegmentQuads {
    fn make_room(&mut self, size: [usize; 2]) {
        fn reserve<T>(list: &mut Vec<T>, count: usize) {
            list.reserve(count.saturating_sub(list.len()));
        }
        reserve(&mut self.sides, MAX_SIDES);
        reserve(&mut self.corners, MAX_CORNERS + MAX_CORNERS);
        reserve(&mut self.corners_from, MAX_SIDES + 1);
        reserve(&mut self.proposals, MAX_PROPOSALS);
        reserve(&mut self.hidden, MAX_PROPOSALS);
        reserve(&mut self.chosen, MAX_QUADS + MAX_HIDDEN);
        reserve(&mut self.found, MAX_QUADS + MAX_HIDDEN);
        self.starts.make_room(MAX_SIDES, size);
    }

    /// The quads of these segments of a level of the pyramid, in the image's pixels, and those with two hidden corners, both
    /// by score: dark ones, or bright ones when `inverted`.
    pub(crate) fn find(
        &mut self,
        segments: &[Segment],
        image: GrayView<'_>,
        placement: Placement,
        inverted: bool,
    ) -> [&[Quad]; 2] {
        let size = [image.width(), image.height()];
        self.found.clear();
        self.sides.clear();
        let sides = segments.iter().filter_map(|segment| Side::from_segment(segment, inverted));
        self.sides.extend(sides.take(MAX_SIDES / 2));
        self.starts.fill(&self.sides, size);
        self.join();
        self.starts.fill(&self.sides, size);
        self.find_corners();
        self.propose(size);
        self.propose_hidden(image, inverted);
        let whole = self.choose(placement, inverted);
        let (quads, hidden) = self.found.split_at(whole);
        [quads, hidden]
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
            let [x, y] = side.end;
            for sides in self.starts.touching(&[[x - reach, y - reach], [x + reach, y + reach]]) {
                for other in sides {
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

    /// Proposes quads around four sides of which two corners are hidden.
    fn propose_hidden(&mut self, image: GrayView<'_>, inverted: bool) {
        let mut hidden = std::mem::take(&mut self.hidden);
        hidden.clear();
        let border = Border { image, inverted };
        let mut search = HiddenSearch { border, looks: MAX_LOOKS, out: &mut hidden };
        for (index, a) in self.sides.iter().enumerate() {
            for first in self.corners_of(index) {
                let b = &self.sides[first.next as usize];
                self.opposite_corner(index, b, first.place, &mut search);
                for second in self.corners_of(first.next as usize) {
                    let c = &self.sides[second.next as usize];
                    if c.is_opposite(a) {
                        self.fourth_side([a, b, c], [first.place, second.place], &mut search);
                    }
                }
            }
            if search.is_over() {
                break;
            }
        }
        self.hidden = hidden;
    }

    /// Proposes quads around three sides and a fourth whose corners are both hidden.
    fn fourth_side(
        &self,
        sides: [&Side; 3],
        [ab, bc]: [[f32; 2]; 2],
        search: &mut HiddenSearch<'_>,
    ) {
        let [a, b, c] = sides;
        let [a_px, b_px, c_px] = [distance(a.start, ab), distance(ab, bc), distance(bc, c.end)];
        if a.length.min(c.length) < MIN_OPPOSITE_PX || a_px.max(c_px) > MAX_HIDDEN_ASPECT * b_px {
            return;
        }
        // It is no nearer than the ends of its neighbours.
        let far_px = MAX_STRETCH * b_px.max(a_px).max(c_px);
        let places = [a.start, a.before_start(far_px - a_px), c.end, c.after_end(far_px - c_px)];
        for other in self.starts.touching(&places).flatten() {
            if !search.looks_on() {
                return;
            }
            let d = &self.sides[*other as usize];
            if !d.is_opposite(b) {
                continue;
            }
            let (Some(cd), Some(da)) = (intersection(c, d), intersection(d, a)) else { continue };
            if c.ends_before(cd) && d.begins_after(cd) && d.ends_before(da) && a.begins_after(da) {
                search.add([da, ab, bc, cd], [a, b, c, d]);
            }
        }
    }

    /// Proposes quads around two sides and two others, which meet in the opposite corner, where the corners between are hidden.
    fn opposite_corner(&self, index: usize, b: &Side, ab: [f32; 2], search: &mut HiddenSearch<'_>) {
        let a = &self.sides[index];
        if a.length.min(b.length) < MIN_OPPOSITE_PX {
            return;
        }
        let [a_px, b_px] = [distance(a.start, ab), distance(ab, b.end)];
        let far_px = MAX_STRETCH * a_px.max(b_px);
        let back = |[x, y]: [f32; 2]| [x - far_px * a.direction[0], y - far_px * a.direction[1]];
        let far = b.after_end(far_px - b_px);
        for third in self.starts.touching(&[b.end, far, back(b.end), back(far)]).flatten() {
            if !search.looks_on() {
                return;
            }
            // From the other corner it would be found again.
            let (third, c) = (*third as usize, &self.sides[*third as usize]);
            if third < index || !c.is_opposite(a) {
                continue;
            }
            let Some(bc) = intersection(b, c) else { continue };
            if !(b.ends_before(bc) && c.begins_after(bc)) {
                continue;
            }
            for corner in self.corners_of(third) {
                let d = &self.sides[corner.next as usize];
                if !d.is_opposite(b) {
                    continue;
                }
                let Some(da) = intersection(d, a) else { continue };
                if d.ends_before(da) && a.begins_after(da) {
                    search.add([da, ab, bc, corner.place], [a, b, c, d]);
                }
            }
        }
    }

    /// Keeps the best proposals, each place once; returns the number of those without two hidden corners.
    fn choose(&mut self, placement: Placement, inverted: bool) -> usize {
        let place = |p: [f32; 2]| {
            let [x, y] = p.map(|v| f64::from(v * placement.scale + placement.offset));
            Pixel::new(x, y)
        };
        let mut whole = 0;
        self.chosen.clear();
        for (list, max) in [(&mut self.proposals, MAX_QUADS), (&mut self.hidden, MAX_HIDDEN)] {
            list.sort_unstable_by(|a, b| b.score.total_cmp(&a.score));
            whole = self.chosen.len();
            for proposal in list.iter() {
                if self.chosen.len() == whole + max {
                    break;
                }
                if !self.chosen.iter().any(|other| other.is_like(proposal)) {
                    self.chosen.push(*proposal);
                }
            }
        }
        let quad = |it: &Proposal| Quad { corners: it.corners.map(place), inverted };
        self.found.extend(self.chosen.iter().map(quad));
        whole
    }
}

/// The search for quads with two hidden corners.
struct HiddenSearch<'a> {
    border: Border<'a>,
    /// How many sides may still be looked at.
    looks: usize,
    out: &'a mut Vec<Proposal>,
}

impl HiddenSearch<'_> {
    fn is_over(&self) -> bool {
        self.looks == 0 || self.out.len() >= MAX_PROPOSALS
    }

    /// Whether one side more may be looked at, which is then counted.
    fn looks_on(&mut self) -> bool {
        let looks_on = !self.is_over();
        self.looks -= usize::from(looks_on);
        looks_on
    }

    /// Adds a quad if enough of it is visible, and it has a border.
    fn add(&mut self, corners: [[f32; 2]; 4], sides: [&Side; 4]) {
        if self.is_over() {
            return;
        }
        let proposal = Proposal::new(corners, &sides, MAX_HIDDEN_ASPECT);
        let is_likely =
            |it: &Proposal| it.visible >= MIN_HIDDEN_VISIBLE && self.border.is_around(&it.corners);
        self.out.extend(proposal.filter(is_likely));
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

/// The level of the image in which a quad may have a dark border, or a bright one.
#[derive(Copy, Clone)]
struct Border<'a> {
    image: GrayView<'a>,
    inverted: bool,
}

impl Border<'_> {
    /// Whether most of a quad is darker along its sides than right outside: the joint between two tiles is too narrow for a border.
    fn is_around(&self, corners: &[[f32; 2]; 4]) -> bool {
        let mut seen = 0;
        for side in 0..4 {
            let [p, q, r, s] = [0, 1, 2, 3].map(|i| corners[(side + i) % 4]);
            for along in [0.25, 0.5, 0.75] {
                let (near, far) = (mix(p, q, along), mix(s, r, along));
                let grey = |depth: f32| {
                    let [x, y] = mix(near, far, depth).map(f64::from);
                    imaging::bilinear(self.image, x, y)
                };
                if let (Some(inside), Some(outside)) = (grey(BORDER_DEPTH), grey(-BORDER_DEPTH)) {
                    let step = if self.inverted { inside - outside } else { outside - inside };
                    seen += usize::from(step >= f64::from(MIN_GRADIENT));
                }
            }
        }
        seen >= MIN_BORDER_PLACES
    }
}

impl Proposal {
    /// Adds the quad with these corners if it may be the image of a square.
    fn add<const N: usize>(corners: [[f32; 2]; 4], sides: [&Side; N], out: &mut Vec<Self>) {
        if out.len() < MAX_PROPOSALS {
            out.extend(Self::new(corners, &sides, MAX_ASPECT));
        }
    }

    /// The quad with these corners if it may be the image of a square, none of its sides longer than another by more than a ratio.
    fn new(corners: [[f32; 2]; 4], sides: &[&Side], max_aspect: f32) -> Option<Self> {
        let mut perimeter = 0.0;
        let (mut shortest, mut longest) = (f32::INFINITY, 0.0_f32);
        for i in 0..4 {
            let [p, q, r] = [corners[i], corners[(i + 1) % 4], corners[(i + 2) % 4]];
            let (side, next) = (minus(q, p), minus(r, q));
            let length = distance(p, q);
            // At each corner it turns right by at least 25 degrees.
            if cross(side, next) < 0.42 * length * distance(q, r) {
                return None;
            }
            perimeter += length;
            shortest = shortest.min(length);
            longest = longest.max(length);
        }
        if shortest < 5.0 || longest > max_aspect * shortest {
            return None;
        }
        let visible: f32 = sides.iter().map(|side| side.visible).sum();
        let visible = (visible / perimeter).min(1.0);
        let score = visible * visible * (1.0 + perimeter / 200.0).min(2.0);
        let middle =
            [0, 1].map(|axis| 0.25 * corners.iter().map(|corner| corner[axis]).sum::<f32>());
        Some(Self { corners, middle, visible, score })
    }

    fn is_like(&self, other: &Self) -> bool {
        let edge = distance(self.corners[0], self.corners[1]);
        let near = 0.03 * edge + 0.5;
        // Where all corners are near the middles are, too, but for rounding.
        let [dx, dy] = minus(self.middle, other.middle);
        if dx.abs().max(dy.abs()) > 1.01 * near {
            return false;
        }
        (0..4).any(|turn| {
            (0..4).all(|i| {
                let [dx, dy] = minus(self.corners[i], other.corners[(i + turn) % 4]);
                dx.abs() < near && dy.abs() < near
            })
        })
    }
}
