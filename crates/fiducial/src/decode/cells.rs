//! What a quad's cells say.
//!
//! Where cells are hardly wider than a pixel, a pixel shows several of them. So the picture of the whole marker is
//! solved for: each pixel is the sum of the cells' values, weighted by how much of each cell it sees through the lens'
//! blur; border and paper are one unknown value each, every bit is one more. The least squares solution gives the bits,
//! and the same sums tell how well any word of the code explains the pixels.

use geometry::Pixel;
use imaging::pyramid::from_level_0;
use imaging::{GrayView, Pyramid, bilinear};
use markers::SquareCode;

use crate::families::square::mean_side;

/// Most bits of a code, and with them the two values of known cells.
const MOST_BITS: usize = 64;
const MOST_UNKNOWNS: usize = MOST_BITS + 2;
/// Indices of the values of dark and of bright cells that are known.
const DARK: usize = 0;
const BRIGHT: usize = 1;
/// Most cells across the picture: a border of up to 12 and up to 2 cells on each side.
const MOST_ACROSS: usize = 16;

/// Standard deviation of the blur of lens and pixel together, in pixels.
const BLUR_PX: f64 = 0.62;
/// Cells are looked at on the level of the pyramid on which they are from this wide to twice that, in pixels.
const CELL_PX: f64 = 1.7;
/// How far outside of the known cells pixels are still looked at, in cells: what is beyond the paper is unknown.
const REACH: f64 = -0.45;
/// Of cells as wide as this, in pixels, half of the pixels say enough.
const WIDE_CELL_PX: f64 = 2.0;
/// Pulls bits towards the middle between dark and bright, as a share of a pixel's weight; it keeps noise down where cells
/// are hardly seen.
const PULL: f64 = 0.05;

/// The cells of one or several codes: they have these in common.
#[derive(Clone, Debug)]
pub(crate) struct Layout {
    /// Cells across the square, and how many of them its border is wide beyond the one of the code.
    pub(crate) cells: usize,
    pub(crate) extra_border: u8,
    pub(crate) bits: &'static [[i8; 2]],
    pub(crate) reversed: bool,
    margin: usize,
    /// The unknown that each cell of the picture is, row by row.
    unknowns: [u8; MOST_ACROSS * MOST_ACROSS],
}

impl Layout {
    /// `None` for a code with more cells than any that is published.
    pub(crate) fn of(code: &SquareCode, extra_border: u8) -> Option<Self> {
        let extra = usize::from(extra_border);
        let (cells, margin) = (usize::from(code.cells) + 2 * extra, usize::from(code.margin()));
        let across = cells + 2 * margin;
        if across > MOST_ACROSS || code.bits.len() > MOST_BITS {
            return None;
        }
        let mut unknowns = [DARK as u8; MOST_ACROSS * MOST_ACROSS];
        for row in 0..across {
            for column in 0..across {
                let inside = |at: usize| (margin..margin + cells).contains(&at);
                // The border's colour within the square, the other one outside; bits are set below.
                let within = inside(row) && inside(column);
                let bright = within == code.reversed_border;
                unknowns[row * MOST_ACROSS + column] = if bright { BRIGHT } else { DARK } as u8;
            }
        }
        for (index, [column, row]) in code.bits.iter().enumerate() {
            let place = |at: i8| usize::try_from(i32::from(at) + (margin + extra) as i32).ok();
            let (column, row) = (place(*column)?, place(*row)?);
            *unknowns.get_mut(row * MOST_ACROSS + column)? = (index + 2) as u8;
        }
        let (bits, reversed) = (code.bits, code.reversed_border);
        Some(Self { cells, extra_border, bits, reversed, margin, unknowns })
    }

    /// Whether a code has these cells.
    pub(crate) fn fits(&self, code: &SquareCode, extra_border: u8) -> bool {
        self.extra_border == extra_border
            && self.cells == usize::from(code.cells + 2 * extra_border)
            && self.reversed == code.reversed_border
            && self.bits == code.bits
    }

    fn across(&self) -> usize {
        self.cells + 2 * self.margin
    }
}

/// From the square's cells, whose corners are (0, 0) to (n, n), to pixels of a level, and back.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Grid {
    /// Of a projective map, row by row, to homogeneous cells.
    cells_from_pixels: [[f64; 3]; 3],
    pixels_from_cells: [[f64; 3]; 3],
}

impl Grid {
    /// The map for a square of `cells` cells with corners clockwise from the upper left; `None` when they are on a line.
    pub(crate) fn new(corners: &[[f64; 2]; 4], cells: usize) -> Option<Self> {
        // Square to quad in closed form (Heckbert, "Fundamentals of texture mapping", 1989).
        let [[x0, y0], [x1, y1], [x2, y2], [x3, y3]] = *corners;
        let (dx1, dx2, dx3) = (x1 - x2, x3 - x2, x0 - x1 + x2 - x3);
        let (dy1, dy2, dy3) = (y1 - y2, y3 - y2, y0 - y1 + y2 - y3);
        let determinant = dx1 * dy2 - dx2 * dy1;
        let g = (dx3 * dy2 - dx2 * dy3) / determinant;
        let h = (dx1 * dy3 - dx3 * dy1) / determinant;
        let n = cells as f64;
        let m = [
            [(x1 - x0 + g * x1) / n, (x3 - x0 + h * x3) / n, x0],
            [(y1 - y0 + g * y1) / n, (y3 - y0 + h * y3) / n, y0],
            [g / n, h / n, 1.0],
        ];
        let minor = |a: usize, b: usize, c: usize, d: usize| m[a][c] * m[b][d] - m[a][d] * m[b][c];
        let inverse = [
            [minor(1, 2, 1, 2), -minor(0, 2, 1, 2), minor(0, 1, 1, 2)],
            [-minor(1, 2, 0, 2), minor(0, 2, 0, 2), -minor(0, 1, 0, 2)],
            [minor(1, 2, 0, 1), -minor(0, 2, 0, 1), minor(0, 1, 0, 1)],
        ];
        let grid = Self { cells_from_pixels: inverse, pixels_from_cells: m };
        let is_finite = m.iter().chain(&inverse).flatten().all(|v| v.is_finite());
        is_finite.then_some(grid)
    }

    pub(crate) fn pixel(&self, cell: [f64; 2]) -> [f64; 2] {
        apply(&self.pixels_from_cells, cell)
    }

    pub(crate) fn cell(&self, pixel: [f64; 2]) -> [f64; 2] {
        apply(&self.cells_from_pixels, pixel)
    }
}

fn apply(m: &[[f64; 3]; 3], [x, y]: [f64; 2]) -> [f64; 2] {
    let scale = 1.0 / (m[2][0] * x + m[2][1] * y + m[2][2]);
    [(m[0][0] * x + m[0][1] * y + m[0][2]) * scale, (m[1][0] * x + m[1][1] * y + m[1][2]) * scale]
}

/// Which pixels of a picture count.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
enum Pixels {
    All,
    Half,
}

/// The sums of a picture's least squares, and its solution.
#[derive(Debug)]
pub(crate) struct Cells {
    /// Share of a normal distribution below x, for x from -4 to 4.
    below: Vec<f64>,
    count: usize,
    bits: usize,
    normal: Box<[[f64; MOST_UNKNOWNS]; MOST_UNKNOWNS]>,
    factor: Box<[[f64; MOST_UNKNOWNS]; MOST_UNKNOWNS]>,
    right: [f64; MOST_UNKNOWNS],
    solution: [f64; MOST_UNKNOWNS],
    sum: f64,
    sum_of_squares: f64,
}

const BELOW_STEPS: usize = 1024;
const BELOW_REACH: f64 = 4.0;

impl Default for Cells {
    fn default() -> Self {
        let below = |i: usize| {
            let x = (i as f64 / BELOW_STEPS as f64 * 2.0 - 1.0) * BELOW_REACH;
            normal_below(x)
        };
        Self {
            below: (0..=BELOW_STEPS).map(below).collect(),
            count: 0,
            bits: 0,
            normal: Box::new([[0.0; MOST_UNKNOWNS]; MOST_UNKNOWNS]),
            factor: Box::new([[0.0; MOST_UNKNOWNS]; MOST_UNKNOWNS]),
            right: [0.0; MOST_UNKNOWNS],
            solution: [0.0; MOST_UNKNOWNS],
            sum: 0.0,
            sum_of_squares: 0.0,
        }
    }
}

/// Share of the normal distribution below `x` (Abramowitz and Stegun 26.2.17).
fn normal_below(x: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.231_641_9 * x.abs());
    let terms = [0.319_381_530, -0.356_563_782, 1.781_477_937, -1.821_255_978, 1.330_274_429];
    let polynomial = terms.iter().rev().fold(0.0, |sum, term| (sum + term) * t);
    let above = (-x * x / 2.0).exp() / std::f64::consts::TAU.sqrt() * polynomial;
    if x < 0.0 { above } else { 1.0 - above }
}

/// A word of a code as the explanation of a picture.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Explanation {
    /// Share of the pixels' variance that it explains.
    pub(crate) explained: f64,
    /// Grey values of dark and bright cells.
    pub(crate) levels: [f64; 2],
}

/// Where a square is looked at: the level, its corners in the level's pixels.
pub(crate) struct Look<'a> {
    pub(crate) view: GrayView<'a>,
    pub(crate) grid: Grid,
}

impl<'a> Look<'a> {
    /// On the level on which the cells of a square are two or three pixels wide.
    pub(crate) fn at(
        corners: &[Pixel; 4],
        cells: usize,
        view: GrayView<'a>,
        pyramid: &'a Pyramid,
    ) -> Option<Self> {
        let cell_px = mean_side(corners) / cells as f64;
        let level = ((cell_px / CELL_PX).log2().floor().max(0.0) as usize)
            .min(pyramid.levels().saturating_sub(1));
        let corners = corners.map(|c| [from_level_0(c.x, level), from_level_0(c.y, level)]);
        Some(Self { view: pyramid.level(view, level)?, grid: Grid::new(&corners, cells)? })
    }
}

impl Look<'_> {
    /// About how wide a cell is in the middle of a square of `cells` cells, in pixels of the level.
    fn cell_px(&self, cells: usize) -> f64 {
        let middle = cells as f64 / 2.0;
        let [a, b] = [middle - 0.5, middle + 0.5].map(|at| self.grid.pixel([at, at]));
        (b[0] - a[0]).hypot(b[1] - a[1]) / std::f64::consts::SQRT_2
    }

    /// Whether the ring of cells within the outermost one of a square of `cells` cells is as dark as that, or as bright.
    pub(crate) fn has_second_ring(&self, cells: usize) -> bool {
        /// One of so many may look otherwise.
        const MOST_ODD: usize = 12;
        let ring = |depth: f64| {
            let last = cells as f64 - depth;
            let count = (last - depth).max(1.0) as usize;
            (0..4 * count).filter_map(move |i| {
                let along = depth + (i / 4) as f64;
                let cell = match i % 4 {
                    0 => [along, depth],
                    1 => [last, along],
                    2 => [last + depth - along, last],
                    _ => [depth, last + depth - along],
                };
                let [x, y] = self.grid.pixel(cell);
                bilinear(self.view, x, y)
            })
        };
        let mean = |depth: f64| {
            let [sum, count] = ring(depth).fold([0.0, 0.0], |[s, n], grey| [s + grey, n + 1.0]);
            sum / count
        };
        let (paper, border) = (mean(-0.5), mean(0.5));
        let is_paper = |grey: &f64| (grey - border) / (paper - border) > 0.5;
        let odd = ring(1.5).filter(is_paper).count();
        (paper - border).is_finite() && odd * MOST_ODD <= ring(1.5).count()
    }
}

impl Cells {
    /// Solves for the cells of a picture; false when it does not determine them.
    pub(crate) fn solve(&mut self, look: &Look<'_>, layout: &Layout) -> bool {
        self.solve_by(look, layout, Pixels::All)
    }

    /// As [`Cells::solve`], by half of the pixels where cells are wide: of a marker that is plain to see they say enough.
    pub(crate) fn solve_plain(&mut self, look: &Look<'_>, layout: &Layout) -> bool {
        let is_wide = look.cell_px(layout.cells) >= WIDE_CELL_PX;
        self.solve_by(look, layout, if is_wide { Pixels::Half } else { Pixels::All })
    }

    fn solve_by(&mut self, look: &Look<'_>, layout: &Layout, pixels: Pixels) -> bool {
        self.bits = layout.bits.len();
        self.clear();
        self.add_pixels(look, layout, pixels);
        // Fewer pixels than unknowns say too little, however they are pulled.
        self.count > self.bits + 2 && self.factorise() && self.substitute()
    }

    /// The value of bit k, 0 for dark and 1 for bright; NaN where there is no contrast.
    pub(crate) fn value(&self, bit: usize) -> f64 {
        let [dark, bright] = [self.solution[DARK], self.solution[BRIGHT]];
        (self.solution[bit + 2] - dark) / (bright - dark)
    }

    /// The word that the values are nearest to.
    pub(crate) fn word(&self) -> u64 {
        (0..self.bits).fold(0, |word, bit| word << 1 | u64::from(self.value(bit) > 0.5))
    }

    /// How well a word explains the picture, with levels of its own for dark and bright.
    pub(crate) fn explain(&self, word: u64) -> Explanation {
        // The unknowns fall into two classes, dark and bright; the sums of each are all that is needed.
        let class = |unknown: usize| match unknown {
            DARK | BRIGHT => unknown,
            _ => (word >> (self.bits + 1 - unknown) & 1) as usize,
        };
        let n = self.bits + 2;
        let mut normal = [[0.0; 2]; 2];
        let mut right = [0.0; 2];
        for row in 0..n {
            let a = class(row);
            right[a] += self.right[row];
            for column in 0..row {
                let b = class(column);
                normal[a][b] += self.normal[row][column];
                normal[b][a] += self.normal[row][column];
            }
            normal[a][a] += self.normal[row][row];
        }
        let [[a, b], [_, d]] = normal;
        let determinant = a * d - b * b;
        let dark = (right[0] * d - b * right[1]) / determinant;
        let bright = (a * right[1] - b * right[0]) / determinant;
        let left = self.sum_of_squares - dark * right[0] - bright * right[1];
        let variance = self.sum_of_squares - self.sum * self.sum / self.count.max(1) as f64;
        let explained = 1.0 - left / variance;
        Explanation {
            explained: if explained.is_finite() { explained.clamp(0.0, 1.0) } else { 0.0 },
            levels: [dark, bright],
        }
    }

    fn clear(&mut self) {
        let n = self.bits + 2;
        for row in self.normal.iter_mut().take(n) {
            row[..n].fill(0.0);
        }
        self.right[..n].fill(0.0);
        (self.sum, self.sum_of_squares, self.count) = (0.0, 0.0, 0);
    }

    fn add_pixels(&mut self, look: &Look<'_>, layout: &Layout, pixels: Pixels) {
        let (n, margin) = (layout.cells as f64, layout.margin as f64);
        let reach = margin + REACH;
        let ends =
            [[-reach, -reach], [n + reach, -reach], [n + reach, n + reach], [-reach, n + reach]]
                .map(|cell| look.grid.pixel(cell));
        let bounds = |axis: usize, edge: usize| {
            let low = ends.iter().map(|p| p[axis]).fold(f64::MAX, f64::min);
            let high = ends.iter().map(|p| p[axis]).fold(f64::MIN, f64::max);
            let last = edge as f64 - 1.0;
            (low.ceil().clamp(0.0, last) as usize, high.floor().clamp(0.0, last) as usize)
        };
        let (left, right) = bounds(0, look.view.width());
        let (top, bottom) = bounds(1, look.view.height());
        let blur = blur_in_cells(&look.grid, n / 2.0);
        for y in top..=bottom {
            let row = look.view.row(y);
            // Half of them as on the squares of one colour of a chessboard.
            let (first, step) = match pixels {
                Pixels::All => (left, 1),
                Pixels::Half => (left + (left + y) % 2, 2),
            };
            for (x, grey) in row.iter().enumerate().take(right + 1).skip(first).step_by(step) {
                let [u, v] = look.grid.cell([x as f64, y as f64]);
                if u > -reach && v > -reach && u < n + reach && v < n + reach {
                    self.add(layout, [u + margin, v + margin], blur, f64::from(*grey));
                }
            }
        }
    }

    /// Adds a pixel at a place in cells of the picture.
    fn add(&mut self, layout: &Layout, place: [f64; 2], blur: [f64; 2], grey: f64) {
        const MOST_SEEN: usize = 6;
        let across = layout.across();
        let mut weights = [[0.0; MOST_SEEN]; 2];
        let mut firsts = [0; 2];
        let mut counts = [0; 2];
        for axis in 0..2 {
            let first =
                (place[axis] - 2.5 * blur[axis]).floor().max(place[axis].floor() - 2.0).max(0.0);
            let last = (place[axis] + 2.5 * blur[axis]).floor().min(place[axis].floor() + 2.0);
            firsts[axis] = first as usize;
            let end = (last.max(first) as usize + 1).min(across);
            counts[axis] = end.saturating_sub(firsts[axis]).min(MOST_SEEN);
            // What lies beyond counts as the last cell on its side.
            let mut before = 0.0;
            for (i, weight) in weights[axis].iter_mut().enumerate().take(counts[axis]) {
                let edge = (firsts[axis] + i + 1) as f64;
                let is_last = i + 1 == counts[axis];
                let upto =
                    if is_last { 1.0 } else { self.below((edge - place[axis]) / blur[axis]) };
                *weight = upto - before;
                before = upto;
            }
        }
        let mut seen = [(0_usize, 0.0); MOST_SEEN * MOST_SEEN];
        let mut seen_count = 0;
        for (j, down) in weights[1].iter().enumerate().take(counts[1]) {
            let row = &layout.unknowns[(firsts[1] + j) * MOST_ACROSS..];
            for (i, right) in weights[0].iter().enumerate().take(counts[0]) {
                let weight = down * right;
                if weight > 1e-3 {
                    seen[seen_count] = (usize::from(row[firsts[0] + i]), weight);
                    seen_count += 1;
                }
            }
        }
        let seen = &seen[..seen_count];
        for (i, (row, weight)) in seen.iter().enumerate() {
            self.right[*row] += weight * grey;
            for (column, other) in &seen[..=i] {
                // The lower triangle; a pair of different cells that are the same unknown counts twice.
                let (a, b) = (*row.max(column), *row.min(column));
                let twice = if a == b && !std::ptr::eq(weight, other) { 2.0 } else { 1.0 };
                self.normal[a][b] += twice * weight * other;
            }
        }
        self.sum += grey;
        self.sum_of_squares += grey * grey;
        self.count += 1;
    }

    fn below(&self, x: f64) -> f64 {
        let place = (x + BELOW_REACH) * (BELOW_STEPS as f64 / (2.0 * BELOW_REACH));
        if place <= 0.0 { 0.0 } else { self.below.get(place as usize).copied().unwrap_or(1.0) }
    }

    /// Cholesky's factor of the sums, with the pull on the bits.
    fn factorise(&mut self) -> bool {
        let n = self.bits + 2;
        for row in 0..n {
            for column in 0..=row {
                let mut value = self.normal[row][column] + self.pull(row, column);
                let (a, b) = (&self.factor[row], &self.factor[column]);
                value -= dot(&a[..column], &b[..column]);
                self.factor[row][column] = if row == column {
                    if value <= 1e-9 {
                        return false;
                    }
                    value.sqrt()
                } else {
                    value / self.factor[column][column]
                };
            }
        }
        true
    }

    /// What the pull of each bit towards the middle of dark and bright adds: the square of b - (dark + bright) / 2.
    fn pull(&self, row: usize, column: usize) -> f64 {
        let bits = self.bits as f64;
        match (row, column) {
            (DARK | BRIGHT, _) => PULL * bits / 4.0,
            (_, DARK | BRIGHT) => -PULL / 2.0,
            _ if row == column => PULL,
            _ => 0.0,
        }
    }

    fn substitute(&mut self) -> bool {
        let n = self.bits + 2;
        for row in 0..n {
            let known = dot(&self.factor[row][..row], &self.solution[..row]);
            self.solution[row] = (self.right[row] - known) / self.factor[row][row];
        }
        for row in (0..n).rev() {
            let mut value = self.solution[row];
            for below in row + 1..n {
                value -= self.factor[below][row] * self.solution[below];
            }
            self.solution[row] = value / self.factor[row][row];
        }
        self.solution[..n].iter().all(|v| v.is_finite())
    }
}

/// The sum of products, in four sums at once, which need not wait for one another.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let (four_a, rest_a) = a.as_chunks::<4>();
    let (four_b, rest_b) = b.as_chunks::<4>();
    let mut sums = [0.0; 4];
    for (a, b) in four_a.iter().zip(four_b) {
        for (sum, (a, b)) in sums.iter_mut().zip(a.iter().zip(b)) {
            *sum += a * b;
        }
    }
    let rest: f64 = rest_a.iter().zip(rest_b).map(|(a, b)| a * b).sum();
    sums.iter().sum::<f64>() + rest
}

/// The blur along the cells' rows and columns, in cells, in the middle of the square.
fn blur_in_cells(grid: &Grid, middle: f64) -> [f64; 2] {
    let [x, y] = grid.pixel([middle, middle]);
    let [u0, v0] = grid.cell([x, y]);
    let [u1, v1] = grid.cell([x + 1.0, y]);
    let [u2, v2] = grid.cell([x, y + 1.0]);
    let along = (u1 - u0).hypot(u2 - u0);
    let down = (v1 - v0).hypot(v2 - v0);
    [(along * BLUR_PX).clamp(1e-3, 1.0), (down * BLUR_PX).clamp(1e-3, 1.0)]
}
