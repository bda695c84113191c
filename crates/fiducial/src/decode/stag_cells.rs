//! Solves for the 48 dots of an STag from all pixels of a quad together, by least squares through the blur, and for how well a
//! codeword explains them.
//!
//! Where a dot is hardly wider than a pixel, a pixel shows several of them: the sum of the dots' values, weighted by their
//! fractions of it through the blur. All that is always black is one more unknown, all that is always white another. The sums
//! of the solution also give how well any codeword explains the pixels, even where dots cannot be distinguished from their
//! neighbours.

use imaging::GrayView;
use markers::stag_code::{self, DISC_RADIUS, DOT_RADIUS, DOTS, QUIET_ZONE};
use nalgebra::{SMatrix, SVector};

use crate::decode::cells::{BRIGHT, DARK, Explanation};
use crate::optics::edge_response::EdgeResponse;
use crate::optics::homography::{Homography, pixel_bounds};
use crate::optics::inverse_tone::{InverseTone, light_of};

/// Small cells across the square, around it, and in all; the square's outline is a border of cells.
const CELLS: usize = 24;
const MARGIN: usize = (CELLS as f64 * QUIET_ZONE) as usize;
const ACROSS: usize = CELLS + 2 * MARGIN;

const UNKNOWNS: usize = DOTS + 2;
/// A dot's value holds within this multiple of its radius: neighbouring black dots merge in print, and white
/// ones do not show.
const REACH: f64 = 1.2;
/// Samples of a small cell in each direction.
const SAMPLES: usize = 8;

/// Standard deviation of the blur of lens and pixel together, in pixels.
const BLUR_PX: f64 = 0.6;
/// Reach of the blur, in standard deviations.
const BLUR_REACH: f64 = 2.6;
/// Largest number of small cells within the blur's reach in a row.
const MAX_SEEN: usize = 20;
/// Pixels count up to this far beyond the quiet zone's end, in pixels; the colour there is unknown.
const BEYOND_PX: f64 = -0.4;
/// Prior that pulls dots to the middle of black and white, as a fraction of a pixel's weight.
const PRIOR: f64 = 0.05;

/// The at most four unknowns that a small cell belongs to, with their fractions.
type Parts = [(u8, f32); 4];

/// The normal equations of the dots, and their solution.
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

/// The largest four fractions of a small cell.
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
    // Smaller fractions are given to these.
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

impl Dots {
    /// Adds up the pixels of a square with these corners, as shown by a camera with this tone curve between the darkest and the
    /// brightest of them; false when there are too few.
    pub(crate) fn add_pixels(
        &mut self,
        view: GrayView<'_>,
        corners: &[[f64; 2]; 4],
        curve: f64,
    ) -> bool {
        let tone = InverseTone::within(corners, view, curve);
        self.normal.fill(0.0);
        self.right.fill(0.0);
        (self.count, self.sum, self.squares) = (0.0, 0.0, 0.0);
        let (n, margin) = (CELLS as f64, MARGIN as f64);
        let Some(homography) = Homography::from_square([0.0, n], corners) else { return false };
        let inverse = homography.inverse();
        let [u, v] = inverse.units_per_pixel(homography.project([n / 2.0; 2]).image);
        let reach = [u, v].map(|per_pixel| margin + BEYOND_PX * per_pixel);
        let ends = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
            .map(|end: [f64; 2]| [0, 1].map(|i| end[i] * (n + 2.0 * reach[i]) - reach[i]))
            .map(|cell| homography.project(cell).image);
        let [left, top, right, bottom] = pixel_bounds(&ends, view);
        let blur = [u, v].map(|per_pixel| (per_pixel * BLUR_PX).clamp(0.05, 3.5));
        let response = EdgeResponse::new();
        for y in top..=bottom {
            for (x, grey) in view.row(y).iter().enumerate().take(right + 1).skip(left) {
                let cell = inverse.plane([x as f64, y as f64]);
                if (0..2).all(|i| cell[i] > -reach[i] && cell[i] < n + reach[i]) {
                    let light = light_of(tone.as_ref(), *grey);
                    self.add(&response, cell.map(|c| c + margin), blur, light);
                }
            }
        }
        self.count > UNKNOWNS as f64
    }

    /// Adds a pixel at a place in small cells.
    fn add(&mut self, response: &EdgeResponse, place: [f64; 2], blur: [f64; 2], grey: f64) {
        let columns = Shares::new(response, place[0], blur[0]);
        let rows = Shares::new(response, place[1], blur[1]);
        let mut weights = [0.0_f64; UNKNOWNS];
        let mut seen = [0_u8; UNKNOWNS];
        let mut count = 0;
        for (j, down) in rows.each() {
            for (i, along) in columns.each() {
                let weight = down * along;
                // The largest fractions come first; most small cells belong to one unknown.
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

    /// Solves for the dots; false when the pixels do not determine them.
    pub(crate) fn solve(&mut self) -> bool {
        let mut matrix = *self.normal;
        for k in 2..UNKNOWNS {
            // The square of dot - (dark + bright) / 2.
            matrix[(k, k)] += PRIOR;
            matrix[(k, DARK)] -= PRIOR / 2.0;
            matrix[(k, BRIGHT)] -= PRIOR / 2.0;
        }
        for (row, column) in [(DARK, DARK), (BRIGHT, DARK), (BRIGHT, BRIGHT)] {
            matrix[(row, column)] += PRIOR * DOTS as f64 / 4.0;
        }
        match matrix.cholesky() {
            Some(factor) => {
                self.solution = factor.solve(&self.right);
                self.solution.iter().all(|v| v.is_finite())
            }
            None => false,
        }
    }

    /// The word nearest to the dots' values; black dots are bright where the marker is printed white on
    /// black.
    pub(crate) fn word(&self) -> u64 {
        let (dark, bright) = (self.solution[DARK], self.solution[BRIGHT]);
        let (middle, inverted) = ((dark + bright) / 2.0, dark > bright);
        let is_black = |value: f64| (value < middle) != inverted;
        self.solution.iter().skip(2).fold(0, |word, value| word << 1 | u64::from(is_black(*value)))
    }

    /// How well a word explains the pixels, with the best levels of black and white for it.
    pub(crate) fn explain(&self, word: u64) -> Explanation {
        let is_white = |unknown: usize| match unknown {
            DARK | BRIGHT => unknown == BRIGHT,
            _ => !stag_code::is_black(word, unknown - 2),
        };
        // Sums over the white unknowns, and over all; in each pixel the fractions of all add up to 1.
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
        let residual = self.squares - dark * self.sum - contrast * grey;
        let variance = self.squares - self.sum * self.sum / self.count;
        let r_squared = 1.0 - residual / variance;
        Explanation {
            r_squared: if r_squared.is_finite() { r_squared.clamp(0.0, 1.0) } else { 0.0 },
            levels: [dark, dark + contrast],
        }
    }

    /// An unknown's fraction of all pixels together.
    fn light(&self, unknown: usize) -> f64 {
        let row: f64 = (0..=unknown).map(|k| self.normal[(unknown, k)]).sum();
        let column: f64 = (unknown + 1..UNKNOWNS).map(|k| self.normal[(k, unknown)]).sum();
        row + column
    }
}

/// The fractions of a pixel's light from small cells in a row.
struct Shares {
    first: usize,
    count: usize,
    share: [f64; MAX_SEEN],
}

impl Shares {
    fn new(response: &EdgeResponse, place: f64, blur: f64) -> Self {
        let reach = BLUR_REACH * blur;
        let last = ACROSS as f64 - 1.0;
        let first = (place - reach).floor().clamp(0.0, last) as usize;
        let end = (place + reach).floor().clamp(0.0, last) as usize + 1;
        let count = end.saturating_sub(first).clamp(1, MAX_SEEN);
        let mut share = [0.0; MAX_SEEN];
        let mut before = 0.0;
        for (i, share) in share.iter_mut().enumerate().take(count) {
            // Light from beyond counts as the last cell's.
            let line = (first + i + 1) as f64;
            let up_to =
                if i + 1 == count { 1.0 } else { response.at((line - place) / blur, 0.0).0 };
            *share = up_to - before;
            before = up_to;
        }
        Self { first, count, share }
    }

    fn each(&self) -> impl Iterator<Item = (usize, f64)> {
        self.share.iter().take(self.count).enumerate().map(|(i, share)| (self.first + i, *share))
    }
}
