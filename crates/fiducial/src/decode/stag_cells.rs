//! What the dots of an STag say.
//!
//! Where a dot is hardly wider than a pixel, a pixel shows several. So the picture of the whole marker is solved for: each
//! pixel is the sum of the dots' values, weighted by how much of each it sees through the lens' blur; all that is known to
//! be black is one more unknown value, all that is known to be white another. The least squares solution gives the dots;
//! the same sums tell how well any word explains the pixels, also where no dot can be told from its neighbours.

use imaging::GrayView;
use markers::stag_code::{self, DISC_RADIUS, DOT_RADIUS, DOTS, QUIET_ZONE};
use nalgebra::{SMatrix, SVector};

use crate::decode::cells::Grid;
use crate::optics::edge_response::EdgeResponse;

/// Small cells across the square and its paper; their borders are the square's outline.
const CELLS: usize = 24;
const MARGIN: usize = (CELLS as f64 * QUIET_ZONE) as usize;
const ACROSS: usize = CELLS + 2 * MARGIN;

const UNKNOWNS: usize = DOTS + 2;
/// Indices of the values of what is known to be black and of what is known to be white.
const DARK: usize = 0;
const BRIGHT: usize = 1;
/// A dot's value counts for what is nearest to it up to this many radii: black grows together, white is white anyway.
const REACH: f64 = 1.2;
/// Samples of a small cell in each direction.
const SAMPLES: usize = 8;

/// Standard deviation of the blur of lens and pixel together, in pixels.
const BLUR_PX: f64 = 0.6;
/// A pixel sees this far, in standard deviations of the blur.
const SEEN: f64 = 2.6;
/// Most small cells that a pixel sees in a row.
const MOST_SEEN: usize = 20;
/// How far outside the paper's end pixels are still looked at, in pixels: what lies beyond is unknown.
const BEYOND_PX: f64 = -0.4;
/// Pulls dots towards the middle between black and white, as a share of a pixel's weight.
const PULL: f64 = 0.05;

/// What a small cell belongs to: at most four unknowns and their shares.
type Parts = [(u8, f32); 4];

/// The sums of a picture's least squares, and its solution.
#[derive(Debug)]
pub(crate) struct Dots {
    parts: Box<[Parts; ACROSS * ACROSS]>,
    normal: Box<SMatrix<f64, UNKNOWNS, UNKNOWNS>>,
    right: SVector<f64, UNKNOWNS>,
    solution: SVector<f64, UNKNOWNS>,
    count: f64,
    sum: f64,
    squares: f64,
}

impl Default for Dots {
    fn default() -> Self {
        let dots = stag_code::dots();
        let mut parts = Box::new([[(0, 0.0); 4]; ACROSS * ACROSS]);
        for (index, parts) in parts.iter_mut().enumerate() {
            *parts = parts_of([index % ACROSS, index / ACROSS], &dots);
        }
        Self {
            parts,
            normal: Box::new(SMatrix::zeros()),
            right: SVector::zeros(),
            solution: SVector::zeros(),
            count: 0.0,
            sum: 0.0,
            squares: 0.0,
        }
    }
}

/// The largest four shares of a small cell.
fn parts_of(cell: [usize; 2], dots: &[[f64; 2]; DOTS]) -> Parts {
    let mut counts = [0_usize; UNKNOWNS];
    let place = |cell: usize, sample: usize| {
        let offset = (sample as f64 + 0.5) / SAMPLES as f64;
        ((cell as f64 + offset) - ACROSS as f64 / 2.0) / CELLS as f64
    };
    for sample in 0..SAMPLES * SAMPLES {
        let [x, y] = [place(cell[0], sample % SAMPLES), -place(cell[1], sample / SAMPLES)];
        counts[unknown_at([x, y], dots)] += 1;
    }
    let mut parts = [(0, 0.0); 4];
    for part in &mut parts {
        let Some((unknown, count)) = counts.iter_mut().enumerate().max_by_key(|(_, c)| **c) else {
            break;
        };
        *part = (unknown as u8, *count as f32 / (SAMPLES * SAMPLES) as f32);
        *count = 0;
    }
    // What is left out goes to the others.
    let kept: f32 = parts.iter().map(|(_, share)| share).sum();
    parts.map(|(unknown, share)| (unknown, share / kept))
}

fn unknown_at([x, y]: [f64; 2], dots: &[[f64; 2]; DOTS]) -> usize {
    if x.abs().max(y.abs()) > 0.5 {
        return BRIGHT;
    }
    if x.hypot(y) > DISC_RADIUS {
        return DARK;
    }
    let distances = dots.iter().map(|[a, b]| (x - a).hypot(y - b));
    match distances.enumerate().min_by(|(_, a), (_, b)| a.total_cmp(b)) {
        Some((dot, distance)) if distance < REACH * DOT_RADIUS => dot + 2,
        _ => BRIGHT,
    }
}

/// A word as the explanation of a picture.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Explanation {
    /// Share of the pixels' variance that it explains.
    pub(crate) explained: f64,
    /// Grey values of black and white.
    pub(crate) levels: [f64; 2],
}

impl Dots {
    /// Adds up what the pixels of a square with these corners say; false when there are too few.
    pub(crate) fn look(&mut self, view: GrayView<'_>, corners: &[[f64; 2]; 4]) -> bool {
        self.normal.fill(0.0);
        self.right.fill(0.0);
        (self.count, self.sum, self.squares) = (0.0, 0.0, 0.0);
        let Some(grid) = Grid::new(corners, CELLS) else { return false };
        let (n, margin) = (CELLS as f64, MARGIN as f64);
        let [u, v] = cells_per_pixel(&grid);
        let reach = [u, v].map(|per_pixel| margin + BEYOND_PX * per_pixel);
        let ends = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
            .map(|end: [f64; 2]| [0, 1].map(|i| end[i] * (n + 2.0 * reach[i]) - reach[i]))
            .map(|cell| grid.pixel(cell));
        let bounds = |axis: usize, edge: usize| {
            let low = ends.iter().map(|p| p[axis]).fold(f64::MAX, f64::min);
            let high = ends.iter().map(|p| p[axis]).fold(f64::MIN, f64::max);
            let last = edge as f64 - 1.0;
            (low.ceil().clamp(0.0, last) as usize, high.floor().clamp(0.0, last) as usize)
        };
        let (left, right) = bounds(0, view.width());
        let (top, bottom) = bounds(1, view.height());
        let blur = [u, v].map(|per_pixel| (per_pixel * BLUR_PX).clamp(0.05, 3.5));
        let step = EdgeResponse::new();
        for y in top..=bottom {
            for (x, grey) in view.row(y).iter().enumerate().take(right + 1).skip(left) {
                let cell = grid.cell([x as f64, y as f64]);
                if (0..2).all(|i| cell[i] > -reach[i] && cell[i] < n + reach[i]) {
                    self.add(&step, cell.map(|c| c + margin), blur, f64::from(*grey));
                }
            }
        }
        self.count > UNKNOWNS as f64
    }

    /// Adds a pixel at a place in small cells.
    fn add(&mut self, step: &EdgeResponse, place: [f64; 2], blur: [f64; 2], grey: f64) {
        let columns = Shares::new(step, place[0], blur[0]);
        let rows = Shares::new(step, place[1], blur[1]);
        let mut weights = [0.0_f64; UNKNOWNS];
        let mut seen = [0_u8; UNKNOWNS];
        let mut count = 0;
        for (j, down) in rows.each() {
            for (i, along) in columns.each() {
                let weight = down * along;
                // The largest shares come first; most small cells belong to one unknown.
                let parts = &self.parts[j * ACROSS + i];
                for (unknown, share) in parts.iter().take_while(|(_, share)| *share > 0.0) {
                    let slot = &mut weights[usize::from(*unknown)];
                    if *slot == 0.0 {
                        seen[count] = *unknown;
                        count += 1;
                    }
                    *slot += weight * f64::from(*share);
                }
            }
        }
        for (i, row) in seen[..count].iter().enumerate() {
            let row = usize::from(*row);
            self.right[row] += weights[row] * grey;
            for column in &seen[..=i] {
                let column = usize::from(*column);
                self.normal[(row.max(column), row.min(column))] += weights[row] * weights[column];
            }
        }
        self.count += 1.0;
        self.sum += grey;
        self.squares += grey * grey;
    }

    /// Solves for the dots; false when the picture does not determine them.
    pub(crate) fn solve(&mut self) -> bool {
        let mut pulled = *self.normal;
        for k in 2..UNKNOWNS {
            // The square of dot - (dark + bright) / 2.
            pulled[(k, k)] += PULL;
            pulled[(k, DARK)] -= PULL / 2.0;
            pulled[(k, BRIGHT)] -= PULL / 2.0;
        }
        for (row, column) in [(DARK, DARK), (BRIGHT, DARK), (BRIGHT, BRIGHT)] {
            pulled[(row, column)] += PULL * DOTS as f64 / 4.0;
        }
        match pulled.cholesky() {
            Some(factor) => {
                self.solution = factor.solve(&self.right);
                self.solution.iter().all(|v| v.is_finite())
            }
            None => false,
        }
    }

    /// The word that the dots' values are nearest to; what is black in print is bright where the print is inverted.
    pub(crate) fn word(&self) -> u64 {
        let (dark, bright) = (self.solution[DARK], self.solution[BRIGHT]);
        let (middle, inverted) = ((dark + bright) / 2.0, dark > bright);
        let is_black = |value: f64| (value < middle) != inverted;
        self.solution.iter().skip(2).fold(0, |word, value| word << 1 | u64::from(is_black(*value)))
    }

    /// How well a word explains the picture, with levels of its own for black and white.
    pub(crate) fn explain(&self, word: u64) -> Explanation {
        let is_white = |unknown: usize| match unknown {
            DARK | BRIGHT => unknown == BRIGHT,
            _ => !stag_code::is_black(word, unknown - 2),
        };
        // Sums over what is white, and over all: the light of all is 1 in each pixel.
        let (mut white, mut grey) = (0.0, 0.0);
        let mut whites = [0_usize; UNKNOWNS];
        let mut count = 0;
        for unknown in (0..UNKNOWNS).filter(|unknown| is_white(*unknown)) {
            whites[count] = unknown;
            count += 1;
        }
        let mut both = 0.0;
        for (i, row) in whites[..count].iter().enumerate() {
            grey += self.right[*row];
            both += self.normal[(*row, *row)];
            let others: f64 = whites[..i].iter().map(|column| self.normal[(*row, *column)]).sum();
            both += 2.0 * others;
            white += self.light(*row);
        }
        let determinant = self.count * both - white * white;
        let contrast = (self.count * grey - white * self.sum) / determinant;
        let dark = (self.sum - contrast * white) / self.count;
        let left = self.squares - dark * self.sum - contrast * grey;
        let variance = self.squares - self.sum * self.sum / self.count;
        let explained = 1.0 - left / variance;
        Explanation {
            explained: if explained.is_finite() { explained.clamp(0.0, 1.0) } else { 0.0 },
            levels: [dark, dark + contrast],
        }
    }

    /// What an unknown contributes to all pixels together: each pixel's shares add up to one.
    fn light(&self, unknown: usize) -> f64 {
        let row: f64 = (0..=unknown).map(|k| self.normal[(unknown, k)]).sum();
        let column: f64 = (unknown + 1..UNKNOWNS).map(|k| self.normal[(k, unknown)]).sum();
        row + column
    }
}

/// The shares that small cells in a row have of a pixel's light.
struct Shares {
    first: usize,
    count: usize,
    share: [f64; MOST_SEEN],
}

impl Shares {
    fn new(step: &EdgeResponse, place: f64, blur: f64) -> Self {
        let reach = SEEN * blur;
        let last = ACROSS as f64 - 1.0;
        let first = (place - reach).floor().clamp(0.0, last) as usize;
        let end = (place + reach).floor().clamp(0.0, last) as usize + 1;
        let count = end.saturating_sub(first).clamp(1, MOST_SEEN);
        let mut share = [0.0; MOST_SEEN];
        let mut before = 0.0;
        for (i, share) in share.iter_mut().enumerate().take(count) {
            // What lies beyond counts as the last cell on its side.
            let line = (first + i + 1) as f64;
            let upto = if i + 1 == count { 1.0 } else { step.at((line - place) / blur, 0.0).0 };
            *share = upto - before;
            before = upto;
        }
        Self { first, count, share }
    }

    fn each(&self) -> impl Iterator<Item = (usize, f64)> {
        self.share.iter().take(self.count).enumerate().map(|(i, share)| (self.first + i, *share))
    }
}

/// How many small cells a pixel is wide along their rows and columns, in the middle of the square.
fn cells_per_pixel(grid: &Grid) -> [f64; 2] {
    let [x, y] = grid.pixel([CELLS as f64 / 2.0; 2]);
    let [u0, v0] = grid.cell([x, y]);
    let [u1, v1] = grid.cell([x + 1.0, y]);
    let [u2, v2] = grid.cell([x, y + 1.0]);
    [(u1 - u0).hypot(u2 - u0), (v1 - v0).hypot(v2 - v0)]
}
