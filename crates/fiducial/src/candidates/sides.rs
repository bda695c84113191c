//! Finds the straight sides of quads, segments or several in one line, and looks them up by position.

use imaging::Segment;

/// Cell size of the grid in which sides are looked up, in pixels.
pub(crate) const CELL_PX: f32 = 16.0;

/// Two sides whose corner is hidden overlap by this number of pixels at most.
const MAX_OVERLAP_PX: f32 = 3.0;
/// Two opposite sides: largest cosine between them, and largest ratio of the length of one to the visible length of the other.
const MAX_OPPOSITE: f32 = -0.7;
const OPPOSITE_RATIO: f32 = 3.0;

/// A straight side: a segment, or several in one line.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Side {
    pub(crate) start: [f32; 2],
    pub(crate) end: [f32; 2],
    pub(crate) direction: [f32; 2],
    pub(crate) length: f32,
    /// The length over which there is an edge.
    pub(crate) visible: f32,
}

impl Side {
    /// A segment with the dark side on the right, or the bright one when `inverted`.
    pub(crate) fn from_segment(segment: &Segment, inverted: bool) -> Option<Self> {
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

    /// A place on its line so far before its start.
    pub(crate) fn before_start(&self, length: f32) -> [f32; 2] {
        let [x, y] = self.direction;
        minus(self.start, [length * x, length * y])
    }

    /// A place on its line so far after its end.
    pub(crate) fn after_end(&self, length: f32) -> [f32; 2] {
        let [x, y] = self.direction;
        plus(self.end, [length * x, length * y])
    }

    /// Whether it begins after a corner.
    pub(crate) fn begins_after(&self, corner: [f32; 2]) -> bool {
        dot(minus(self.start, corner), self.direction) > -MAX_OVERLAP_PX
    }

    /// Whether it ends before a corner.
    pub(crate) fn ends_before(&self, corner: [f32; 2]) -> bool {
        dot(minus(corner, self.end), self.direction) > -MAX_OVERLAP_PX
    }

    /// Whether it may be the side of a quad that is opposite to another one.
    pub(crate) fn is_opposite(&self, other: &Self) -> bool {
        dot(self.direction, other.direction) < MAX_OPPOSITE
            && OPPOSITE_RATIO * self.visible > other.length
    }

    /// The gap to the start of a side that continues this one's line.
    pub(crate) fn gap_to(&self, other: &Self) -> Option<f32> {
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
    pub(crate) fn joined(&self, other: &Self) -> Self {
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
    pub(crate) fn corner_with(&self, next: &Self, reach: f32) -> Option<([f32; 2], f32)> {
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
pub(crate) struct SideGrid {
    columns: usize,
    rows: usize,
    /// Index in `sides` of the first side that starts in each cell.
    from: Vec<u32>,
    sides: Vec<u32>,
}

impl SideGrid {
    /// Makes room for so many sides in a level of this size.
    pub(crate) fn make_room(&mut self, sides: usize, [width, height]: [usize; 2]) {
        let cells = (width / CELL_PX as usize + 1) * (height / CELL_PX as usize + 1);
        self.sides.reserve(sides.saturating_sub(self.sides.len()));
        self.from.reserve((cells + 1).saturating_sub(self.from.len()));
    }

    pub(crate) fn fill(&mut self, sides: &[Side], [width, height]: [usize; 2]) {
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

    pub(crate) fn cell(&self, [x, y]: [f32; 2]) -> Option<usize> {
        // NaN is outside.
        if !(x >= 0.0 && y >= 0.0) {
            return None;
        }
        let (column, row) = ((x / CELL_PX) as usize, (y / CELL_PX) as usize);
        (column < self.columns && row < self.rows).then(|| row * self.columns + column)
    }

    pub(crate) fn within(&self, cell: usize) -> &[u32] {
        &self.sides[self.from[cell] as usize..self.from[cell + 1] as usize]
    }

    /// The sides in the cells that touch the smallest upright rectangle around some places, row by row.
    pub(crate) fn touching(&self, places: &[[f32; 2]]) -> impl Iterator<Item = &[u32]> {
        let range = |axis: usize, count: usize| {
            let last = count.saturating_sub(1);
            let values = || places.iter().map(|place| place[axis]);
            let from = (values().fold(f32::INFINITY, f32::min).max(0.0) / CELL_PX) as usize;
            let to = (values().fold(0.0, f32::max) / CELL_PX) as usize;
            // Also of NaN.
            let to = to.min(last);
            [from.min(to), to]
        };
        let ([left, right], [top, bottom]) = (range(0, self.columns), range(1, self.rows));
        (top..=bottom).map(move |row| {
            let [from, to] = [left, right + 1].map(|cell| self.from[row * self.columns + cell]);
            &self.sides[from as usize..to as usize]
        })
    }
}

/// Where the lines of two sides meet; `None` when they are parallel.
pub(crate) fn intersection(a: &Side, b: &Side) -> Option<[f32; 2]> {
    let sine = cross(a.direction, b.direction);
    if sine.abs() < 0.1 {
        return None;
    }
    let along = cross(minus(b.start, a.end), b.direction) / sine;
    Some([a.end[0] + along * a.direction[0], a.end[1] + along * a.direction[1]])
}

pub(crate) fn dot(a: [f32; 2], b: [f32; 2]) -> f32 {
    a[0] * b[0] + a[1] * b[1]
}

pub(crate) fn cross(a: [f32; 2], b: [f32; 2]) -> f32 {
    a[0] * b[1] - a[1] * b[0]
}

pub(crate) fn minus(a: [f32; 2], b: [f32; 2]) -> [f32; 2] {
    [a[0] - b[0], a[1] - b[1]]
}

pub(crate) fn plus(a: [f32; 2], b: [f32; 2]) -> [f32; 2] {
    [a[0] + b[0], a[1] + b[1]]
}

pub(crate) fn mix(a: [f32; 2], b: [f32; 2], share: f32) -> [f32; 2] {
    [a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])]
}

pub(crate) fn distance(a: [f32; 2], b: [f32; 2]) -> f32 {
    let difference = minus(a, b);
    dot(difference, difference).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sides_around_places_are_those_of_the_cells_that_they_touch() {
        let sides: Vec<Side> = (0..300)
            .map(|i| {
                let start = [(i * 37 % 331) as f32, (i * 53 % 197) as f32];
                Side::between(start, [start[0] + 9.0, start[1]], 9.0)
            })
            .collect();
        let mut grid = SideGrid::default();
        grid.fill(&sides, [331, 197]);
        let cell = |v: f32, last: f32| (v.max(0.0) / CELL_PX).floor().min(last);
        for places in [
            [[10.0, 20.0], [60.0, 90.0]],
            [[60.0, 90.0], [10.0, 20.0]],
            [[-50.0, -9.0], [-3.0, 40.0]],
            [[300.0, 150.0], [900.0, 900.0]],
            [[400.0, 400.0], [500.0, 500.0]],
        ] {
            let range = |axis: usize, last: f32| {
                let [a, b] = places.map(|place| cell(place[axis], last));
                a.min(b)..=a.max(b)
            };
            let is_touched = |side: &Side| {
                range(0, 20.0).contains(&cell(side.start[0], 20.0))
                    && range(1, 12.0).contains(&cell(side.start[1], 12.0))
            };
            let mut found: Vec<u32> = grid.touching(&places).flatten().copied().collect();
            found.sort_unstable();
            let expected: Vec<u32> = (0..300).filter(|i| is_touched(&sides[*i as usize])).collect();
            assert_eq!(found, expected, "{places:?}");
        }
        // Invalid coordinates fall into some cell.
        assert!(grid.touching(&[[f32::NAN; 2]; 2]).flatten().count() <= sides.len());
    }
}
