//! Solves for the bits of a square marker from all pixels of a quad together, by least squares through the blur, and for how well a
//! codeword explains them.
//!
//! Where cells are hardly wider than a pixel, a pixel shows several of them: the sum of the cells' values, weighted by their
//! fractions of it through the blur. Border and quiet zone are one unknown each, every bit is one more. The sums of the
//! solution also give how well any codeword explains the pixels.

use geometry::Pixel;
use imaging::pyramid::from_level_0;
use imaging::{GrayView, Pyramid, bilinear};
use markers::SquareCode;

use crate::candidates::quad::{at_most_across, mean_side_px};
use crate::optics::homography::{Homography, Inverse, pixel_bounds};
use crate::optics::inverse_tone::{InverseTone, light_of};
use crate::optics::normal;

/// Largest number of bits of a code; with the values of dark and bright known cells, of unknowns.
const MAX_BITS: usize = 64;
const MAX_UNKNOWNS: usize = MAX_BITS + 2;
/// Indices of the unknowns of dark and of bright known cells.
pub(crate) const DARK: usize = 0;
pub(crate) const BRIGHT: usize = 1;
/// Marks cells around the outer bits of a round marker, which have no unknown: they are not part of the marker and may have any colour.
const BEYOND: u8 = u8::MAX;
/// Largest number of cells across: up to 12 in the square, and up to 2 on each side.
const MAX_ACROSS: usize = 16;

/// Standard deviation of the blur of lens and pixel together, in pixels.
const BLUR_PX: f64 = 0.62;
/// Cells are read on the level of the pyramid on which their width is between this and twice this, in pixels.
const CELL_PX: f64 = 1.7;
/// Pixels count up to this far beyond the known cells, in cells; the colour beyond the quiet zone is unknown.
const REACH: f64 = -0.45;
/// Of cells at least this wide, in pixels, half of the pixels suffice.
const WIDE_CELL_PX: f64 = 2.0;
/// Prior that pulls bits to the middle of dark and bright, as a fraction of a pixel's weight; it bounds the
/// noise of cells that are hardly seen.
const PRIOR: f64 = 0.05;
/// Largest fraction of a pixel's light from cells that are not part of a round marker. Pixels with more of it do not count.
const MAX_BEYOND: f64 = 0.15;

/// The cells of one or several codes that have them in common.
#[derive(Clone, Debug)]
pub(crate) struct Layout {
    /// Cells across the square, and by how many of them its border is wider than the code's.
    pub(crate) cells: usize,
    pub(crate) extra_border: u8,
    pub(crate) bits: &'static [[i8; 2]],
    pub(crate) reversed: bool,
    margin: usize,
    /// The unknown of each cell, row by row.
    unknowns: [u8; MAX_ACROSS * MAX_ACROSS],
}

impl Layout {
    /// `None` for a code with more cells than any published one.
    pub(crate) fn for_code(code: &SquareCode, extra_border: u8) -> Option<Self> {
        let extra = usize::from(extra_border);
        let (cells, margin) = (usize::from(code.cells) + 2 * extra, usize::from(code.margin()));
        let across = cells + 2 * margin;
        if across > MAX_ACROSS || code.bits.len() > MAX_BITS {
            return None;
        }
        let mut unknowns = [DARK as u8; MAX_ACROSS * MAX_ACROSS];
        for row in 0..across {
            for column in 0..across {
                let inside = |at: usize| (margin..margin + cells).contains(&at);
                let beside = |at: usize| (margin..margin + cells + 2).contains(&(at + 1));
                // The border's colour in the square, the other one right outside; bits are set below.
                let is_bright = (inside(row) && inside(column)) == code.reversed_border;
                let is_beyond = code.reversed_border && !(beside(row) && beside(column));
                let known = if is_bright { BRIGHT } else { DARK } as u8;
                unknowns[row * MAX_ACROSS + column] = if is_beyond { BEYOND } else { known };
            }
        }
        for (index, [column, row]) in code.bits.iter().enumerate() {
            let place = |at: i8| usize::try_from(i32::from(at) + (margin + extra) as i32).ok();
            let (column, row) = (place(*column)?, place(*row)?);
            *unknowns.get_mut(row * MAX_ACROSS + column)? = (index + 2) as u8;
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

    /// Whether the other layout has the same square, all bits of this one, and more bits.
    pub(crate) fn is_part_of(&self, other: &Self) -> bool {
        (other.cells, other.extra_border, other.reversed)
            == (self.cells, self.extra_border, self.reversed)
            && other.bits.len() > self.bits.len()
            && self.bits.iter().all(|bit| other.bits.contains(bit))
    }

    fn across(&self) -> usize {
        self.cells + 2 * self.margin
    }
}

/// Which pixels take part.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
enum Pixels {
    All,
    Half,
}

/// The normal equations of the cells, and their solution.
#[derive(Debug)]
pub(crate) struct Cells {
    /// Cumulative normal distribution from -4 to 4 standard deviations.
    cumulative: Vec<f64>,
    count: usize,
    bits: usize,
    normal: Box<[[f64; MAX_UNKNOWNS]; MAX_UNKNOWNS]>,
    factor: Box<[[f64; MAX_UNKNOWNS]; MAX_UNKNOWNS]>,
    right: [f64; MAX_UNKNOWNS],
    solution: [f64; MAX_UNKNOWNS],
    sum: f64,
    sum_of_squares: f64,
}

const CUMULATIVE_STEPS: usize = 1024;
const CUMULATIVE_REACH: f64 = 4.0;

impl Default for Cells {
    fn default() -> Self {
        let cumulative = |i: usize| {
            let x = (i as f64 / CUMULATIVE_STEPS as f64 * 2.0 - 1.0) * CUMULATIVE_REACH;
            normal::cumulative(x)
        };
        Self {
            cumulative: (0..=CUMULATIVE_STEPS).map(cumulative).collect(),
            count: 0,
            bits: 0,
            normal: Box::new([[0.0; MAX_UNKNOWNS]; MAX_UNKNOWNS]),
            factor: Box::new([[0.0; MAX_UNKNOWNS]; MAX_UNKNOWNS]),
            right: [0.0; MAX_UNKNOWNS],
            solution: [0.0; MAX_UNKNOWNS],
            sum: 0.0,
            sum_of_squares: 0.0,
        }
    }
}

/// How a codeword explains the pixels.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Explanation {
    /// Fraction of the pixels' variance that it explains.
    pub(crate) r_squared: f64,
    /// Grey values of dark and bright cells.
    pub(crate) levels: [f64; 2],
}

/// A square on the level of the pyramid on which it is read.
pub(crate) struct SquareImage<'a> {
    view: GrayView<'a>,
    tone: Option<InverseTone>,
    /// From the square's cells, whose corners are (0, 0) to (n, n), to pixels of the level, and back.
    homography: Homography,
    inverse: Inverse,
}

impl<'a> SquareImage<'a> {
    /// On the level on which the cells of a square are two or three pixels wide; of one that is seen from the side one to two across.
    pub(crate) fn new(
        corners: &[Pixel; 4],
        cells: usize,
        view: GrayView<'a>,
        pyramid: &'a Pyramid,
    ) -> Option<Self> {
        let side_px = at_most_across(mean_side_px(corners), corners);
        let cell_px = side_px / cells as f64;
        let level = ((cell_px / CELL_PX).log2().floor().max(0.0) as usize)
            .min(pyramid.levels().saturating_sub(1));
        let corners = corners.map(|c| [from_level_0(c.x, level), from_level_0(c.y, level)]);
        let homography = Homography::from_square([0.0, cells as f64], &corners)?;
        let view = pyramid.level(view, level)?;
        Some(Self { view, tone: None, homography, inverse: homography.inverse() })
    }

    /// As shown by a camera with this tone curve between the darkest and the brightest pixel of the square; 0 is linear.
    pub(crate) fn through(self, curve: f64, cells: usize) -> Self {
        let n = cells as f64;
        let corners = [[0.0, 0.0], [n, 0.0], [n, n], [0.0, n]];
        let corners = corners.map(|cell| self.homography.project(cell).image);
        Self { tone: InverseTone::within(&corners, self.view, curve), ..self }
    }

    /// About how wide a cell is in the middle of a square of `cells` cells, in pixels of the level: the shorter diagonal, over that of a
    /// square.
    fn cell_px(&self, cells: usize) -> f64 {
        let middle = cells as f64 / 2.0;
        let place = |dx: f64, dy: f64| self.homography.project([middle + dx, middle + dy]).image;
        let diagonal = |dy: f64| {
            let [a, b] = [place(-0.5, -dy), place(0.5, dy)];
            (b[0] - a[0]).hypot(b[1] - a[1])
        };
        diagonal(0.5).min(diagonal(-0.5)) / std::f64::consts::SQRT_2
    }

    /// Whether the second ring of cells of a square of `cells` cells has the colour of the outermost one.
    pub(crate) fn has_second_ring(&self, cells: usize) -> bool {
        /// One in this many cells may differ.
        const ODD_RATIO: usize = 12;
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
                let [x, y] = self.homography.project(cell).image;
                bilinear(self.view, x, y)
            })
        };
        let mean = |depth: f64| {
            let [sum, count] = ring(depth).fold([0.0, 0.0], |[s, n], grey| [s + grey, n + 1.0]);
            sum / count
        };
        let (quiet_zone, border) = (mean(-0.5), mean(0.5));
        let is_odd = |grey: &f64| (grey - border) / (quiet_zone - border) > 0.5;
        let odd = ring(1.5).filter(is_odd).count();
        (quiet_zone - border).is_finite() && odd * ODD_RATIO <= ring(1.5).count()
    }
}

impl Cells {
    /// Solves for the cells; false when the pixels do not determine them.
    pub(crate) fn solve(&mut self, image: &SquareImage<'_>, layout: &Layout) -> bool {
        self.solve_by(image, layout, Pixels::All)
    }

    /// As [`Cells::solve`], by half of the pixels where cells are wide, which suffices for a marker in full
    /// view.
    pub(crate) fn solve_fast(&mut self, image: &SquareImage<'_>, layout: &Layout) -> bool {
        let is_wide = image.cell_px(layout.cells) >= WIDE_CELL_PX;
        self.solve_by(image, layout, if is_wide { Pixels::Half } else { Pixels::All })
    }

    fn solve_by(&mut self, image: &SquareImage<'_>, layout: &Layout, pixels: Pixels) -> bool {
        self.bits = layout.bits.len();
        self.clear();
        self.add_pixels(image, layout, pixels);
        // With fewer pixels than unknowns, only the prior would determine some.
        self.count > self.bits + 2 && self.factorise() && self.substitute()
    }

    /// The value of bit k, 0 for dark and 1 for bright; NaN where there is no contrast.
    pub(crate) fn value(&self, bit: usize) -> f64 {
        let [dark, bright] = [self.solution[DARK], self.solution[BRIGHT]];
        (self.solution[bit + 2] - dark) / (bright - dark)
    }

    /// The word nearest to the values.
    pub(crate) fn word(&self) -> u64 {
        (0..self.bits).fold(0, |word, bit| word << 1 | u64::from(self.value(bit) > 0.5))
    }

    /// How well a word explains the pixels, with the best levels of dark and bright for it.
    pub(crate) fn explain(&self, word: u64) -> Explanation {
        // The unknowns fall into two classes, dark and bright; only the sums of each are needed.
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
        let residual = self.sum_of_squares - dark * right[0] - bright * right[1];
        let variance = self.sum_of_squares - self.sum * self.sum / self.count.max(1) as f64;
        let r_squared = 1.0 - residual / variance;
        Explanation {
            r_squared: if r_squared.is_finite() { r_squared.clamp(0.0, 1.0) } else { 0.0 },
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

    fn add_pixels(&mut self, image: &SquareImage<'_>, layout: &Layout, pixels: Pixels) {
        let (n, margin) = (layout.cells as f64, layout.margin as f64);
        let reach = margin + REACH;
        let ends =
            [[-reach, -reach], [n + reach, -reach], [n + reach, n + reach], [-reach, n + reach]]
                .map(|cell| image.homography.project(cell).image);
        let [left, top, right, bottom] = pixel_bounds(&ends, image.view);
        let middle = image.homography.project([n / 2.0; 2]).image;
        let per_pixel = image.inverse.units_per_pixel(middle);
        let blur = per_pixel.map(|cells| (cells * BLUR_PX).clamp(1e-3, 1.0));
        for y in top..=bottom {
            let row = image.view.row(y);
            // Half of them in a checkerboard pattern.
            let (first, step) = match pixels {
                Pixels::All => (left, 1),
                Pixels::Half => (left + (left + y) % 2, 2),
            };
            for (x, grey) in row.iter().enumerate().take(right + 1).skip(first).step_by(step) {
                let [u, v] = image.inverse.plane([x as f64, y as f64]);
                if u > -reach && v > -reach && u < n + reach && v < n + reach {
                    let light = light_of(image.tone.as_ref(), *grey);
                    self.add(layout, [u + margin, v + margin], blur, light);
                }
            }
        }
    }

    /// Adds a pixel at a place in cells.
    fn add(&mut self, layout: &Layout, place: [f64; 2], blur: [f64; 2], grey: f64) {
        const MAX_SEEN: usize = 6;
        let across = layout.across();
        let mut weights = [[0.0; MAX_SEEN]; 2];
        let mut firsts = [0; 2];
        let mut counts = [0; 2];
        for axis in 0..2 {
            let first =
                (place[axis] - 2.5 * blur[axis]).floor().max(place[axis].floor() - 2.0).max(0.0);
            let last = (place[axis] + 2.5 * blur[axis]).floor().min(place[axis].floor() + 2.0);
            firsts[axis] = first as usize;
            let end = (last.max(first) as usize + 1).min(across);
            counts[axis] = end.saturating_sub(firsts[axis]).min(MAX_SEEN);
            // Light from beyond counts as the last cell's.
            let mut before = 0.0;
            for (i, weight) in weights[axis].iter_mut().enumerate().take(counts[axis]) {
                let edge = (firsts[axis] + i + 1) as f64;
                let is_last = i + 1 == counts[axis];
                let up_to =
                    if is_last { 1.0 } else { self.cumulative((edge - place[axis]) / blur[axis]) };
                *weight = up_to - before;
                before = up_to;
            }
        }
        let mut seen = [(0_usize, 0.0); MAX_SEEN * MAX_SEEN];
        let mut seen_count = 0;
        let mut beyond = 0.0;
        for (j, down) in weights[1].iter().enumerate().take(counts[1]) {
            let row = &layout.unknowns[(firsts[1] + j) * MAX_ACROSS..];
            for (i, right) in weights[0].iter().enumerate().take(counts[0]) {
                let weight = down * right;
                let unknown = row[firsts[0] + i];
                if unknown == BEYOND {
                    beyond += weight;
                } else if weight > 1e-3 {
                    seen[seen_count] = (usize::from(unknown), weight);
                    seen_count += 1;
                }
            }
        }
        let seen = &mut seen[..seen_count];
        if beyond > MAX_BEYOND {
            return;
        }
        // The marker's cells in this pixel take the place of the others.
        if beyond > 0.0 {
            seen.iter_mut().for_each(|(_, weight)| *weight /= 1.0 - beyond);
        }
        let seen = &*seen;
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

    fn cumulative(&self, x: f64) -> f64 {
        let place = (x + CUMULATIVE_REACH) * (CUMULATIVE_STEPS as f64 / (2.0 * CUMULATIVE_REACH));
        if place <= 0.0 { 0.0 } else { self.cumulative.get(place as usize).copied().unwrap_or(1.0) }
    }

    /// The Cholesky factor of the normal equations with the prior.
    fn factorise(&mut self) -> bool {
        let n = self.bits + 2;
        for row in 0..n {
            for column in 0..=row {
                let mut value = self.normal[row][column] + self.prior(row, column);
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

    /// The prior's part: of each bit b the square of b - (dark + bright) / 2.
    fn prior(&self, row: usize, column: usize) -> f64 {
        let bits = self.bits as f64;
        match (row, column) {
            (DARK | BRIGHT, _) => PRIOR * bits / 4.0,
            (_, DARK | BRIGHT) => -PRIOR / 2.0,
            _ if row == column => PRIOR,
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

/// The dot product, in four independent sums for instruction-level parallelism.
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
