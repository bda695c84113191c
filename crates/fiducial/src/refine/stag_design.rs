//! Defines the design of an STag for the refinement: small cells with their fraction of white, and edges.

use markers::stag_code::{DISC_RADIUS, QUIET_ZONE};
use markers::{Drawing, Family, Ink, Marker, Shape};

use crate::refine::fit::{Design, SmallCells};

/// Small cells across the square; its outline is a border of cells. Their width must be well below that of the blur, or
/// the edges of disc and dots are softer than the outline. The narrower ones are for squares whose side is so many pixels
/// or more; a tone curve and sharpening take small differences of blur for their own.
const CELLS: [usize; SCALES] = [24, 48, 96];
const FROM_PX: [f64; SCALES] = [0.0, 14.0, 40.0];
const PROCESSED_FROM_PX: [f64; SCALES] = [0.0, 14.0, 18.0];
const SCALES: usize = 3;
const FINEST: usize = CELLS[SCALES - 1];
/// Samples of one of the narrowest cells in each direction.
const SAMPLES: usize = 4;
const ACROSS: usize = FINEST + 2 * margin(FINEST);
const FINE: usize = ACROSS * SAMPLES;
/// Places on each side, and on the disc's edge.
const PER_SIDE: usize = 36;
const ON_DISC: usize = 96;
/// Distance from the outline to the disc, and from the disc to the dots, in the square's coordinates (-1 to
/// 1).
const BORDER: f64 = 0.2;
const RIM: f64 = 0.1;

/// The design of one marker.
#[derive(Debug)]
pub(crate) struct StagDesign {
    pub(crate) family: Family,
    pub(crate) id: u32,
    /// The fraction of white in each cell, row by row, for each width of the cells.
    white: [Vec<f64>; SCALES],
    /// For black on white, and for white on black.
    edges: [Vec<[[f64; 2]; 2]>; 2],
}

/// Where the rim between disc and dots is narrower than this, in pixels, the disc's edge takes no part of its
/// own.
const MIN_RIM_PX: f64 = 4.0;

impl StagDesign {
    /// `None` for an id that the family does not have.
    pub(crate) fn new(family: Family, id: u32) -> Option<Self> {
        let drawing = Drawing::new(&Marker { family, id: Some(id), size_m: None }, 1.0)?;
        let finest = white(&drawing);
        let fine = halved(&finest);
        let white = [halved(&fine), fine, finest];
        let black = edges();
        let bright = black.iter().map(|[place, [x, y]]| [*place, [-x, -y]]).collect();
        Some(Self { family, id, white, edges: [black, bright] })
    }

    /// For a square with sides of this length, printed white on black when `inverted`.
    pub(crate) fn design(&self, side_px: f64, inverted: bool) -> Design<'_> {
        let is_wide = side_px * RIM / 2.0 >= MIN_RIM_PX;
        let edges = &self.edges[usize::from(inverted)];
        let edges = if is_wide { &edges[..] } else { &edges[..4 * PER_SIDE] };
        let border = BORDER / 2.0;
        let cells = |from_px: [f64; SCALES]| {
            let scale = from_px.iter().rposition(|from_px| side_px >= *from_px).unwrap_or(0);
            let across = CELLS[scale];
            SmallCells { across, margin: margin(across), white: &self.white[scale] }
        };
        let (plain, processed) = (cells(FROM_PX), cells(PROCESSED_FROM_PX));
        Design { plain, processed, edges, border }
    }
}

/// Cells on each side of so many across the square.
const fn margin(cells: usize) -> usize {
    (cells as f64 * QUIET_ZONE) as usize
}

/// The fraction of white in each of the narrowest cells.
fn white(drawing: &Drawing) -> Vec<f64> {
    let mut fine = vec![true; FINE * FINE];
    let per_unit = (FINEST * SAMPLES) as f64;
    let middle = FINE as f64 / 2.0;
    // The samples whose middles lie between two places.
    let range = |low: f64, high: f64| {
        let index = |place: f64| (place * per_unit + middle - 0.5).ceil().clamp(0.0, FINE as f64);
        index(low) as usize..index(high) as usize
    };
    for layer in &drawing.layers {
        let ink = layer.ink == Ink::White;
        match layer.shape {
            Shape::Rectangle { min_m, max_m } => {
                for y in range(-max_m[1], -min_m[1]) {
                    let row = &mut fine[y * FINE..(y + 1) * FINE];
                    row[range(min_m[0], max_m[0])].fill(ink);
                }
            }
            Shape::Disc { centre_m: [x, y], radius_m } => {
                for row in range(-y - radius_m, -y + radius_m) {
                    let off = (row as f64 + 0.5 - middle) / per_unit + y;
                    let half = (radius_m * radius_m - off * off).max(0.0).sqrt();
                    let columns = range(x - half, x + half);
                    fine[row * FINE..(row + 1) * FINE][columns].fill(ink);
                }
            }
        }
    }
    let mut white = vec![0.0; ACROSS * ACROSS];
    for (index, is_white) in fine.iter().enumerate() {
        let (x, y) = (index % FINE / SAMPLES, index / FINE / SAMPLES);
        white[y * ACROSS + x] += f64::from(u8::from(*is_white)) / (SAMPLES * SAMPLES) as f64;
    }
    white
}

/// The same with cells twice as wide.
fn halved(white: &[f64]) -> Vec<f64> {
    let across = white.len().isqrt();
    let mut coarse = vec![0.0; white.len() / 4];
    for (index, share) in white.iter().enumerate() {
        let (x, y) = (index % across, index / across);
        coarse[y / 2 * (across / 2) + x / 2] += share / 4.0;
    }
    coarse
}

/// Places on the outline and on the disc's edge, in the square's coordinates (x right, y down, -1 to 1), each
/// with the vector towards white whose length is the distance to the next edge.
fn edges() -> Vec<[[f64; 2]; 2]> {
    let mut edges = Vec::with_capacity(4 * PER_SIDE + ON_DISC);
    for k in 0..PER_SIDE {
        let along = (k as f64 + 0.5) / PER_SIDE as f64 * 1.9 - 0.95;
        edges.extend([
            [[along, -1.0], [0.0, -BORDER]],
            [[along, 1.0], [0.0, BORDER]],
            [[-1.0, along], [-BORDER, 0.0]],
            [[1.0, along], [BORDER, 0.0]],
        ]);
    }
    let radius = 2.0 * DISC_RADIUS;
    edges.extend((0..ON_DISC).map(|k| {
        let (sin, cos) = ((k as f64 + 0.5) / ON_DISC as f64 * std::f64::consts::TAU).sin_cos();
        [[radius * cos, radius * sin], [-RIM * cos, -RIM * sin]]
    }));
    edges
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_cells_have_the_share_of_white_of_the_drawing() {
        let marker = "stag-hd21:3".parse().unwrap();
        let drawing = Drawing::new(&marker, 1.0).unwrap();
        let design = StagDesign::new(Family::StagHd21, 3).unwrap();
        let samples = 20;
        for side_px in [10.0, 30.0, 60.0] {
            let cells = design.design(side_px, false).plain;
            let across = cells.across + 2 * cells.margin;
            assert_eq!(cells.white.len(), across * across);
            // Every seventh cell, to save time.
            for (index, white) in cells.white.iter().enumerate().step_by(7) {
                let (x, y) = (index % across, index / across);
                let place = |cell: usize, k: usize| {
                    let offset = (k as f64 + 0.5) / f64::from(samples);
                    (cell as f64 + offset - across as f64 / 2.0) / cells.across as f64
                };
                let all =
                    (0..samples as usize).flat_map(|i| (0..samples as usize).map(move |j| (i, j)));
                let seen =
                    all.filter(|(i, j)| drawing.ink_at(place(x, *i), -place(y, *j)) == Ink::White);
                let share = seen.count() as f64 / f64::from(samples * samples);
                assert!((share - white).abs() < 0.13, "{side_px} {x} {y}: {share} {white}");
            }
        }
    }
}
