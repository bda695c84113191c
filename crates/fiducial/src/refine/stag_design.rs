//! The design of an STag for the refinement: small cells with their share of white, and edges.

use markers::stag_code::{DISC_RADIUS, QUIET_ZONE};
use markers::{Drawing, Family, Ink, Marker, Shape};

use crate::refine::fit::{Design, MAX_ACROSS};

/// Small cells across the square, around it, and in all; the square's outline is a border of cells. Their
/// width must be well below that of the blur; for squares with a side below `COARSE_PX` they are twice as
/// wide.
const CELLS: usize = 48;
const MARGIN: usize = (CELLS as f64 * QUIET_ZONE) as usize;
const ACROSS: usize = CELLS + 2 * MARGIN;
const _: () = assert!(ACROSS <= MAX_ACROSS);
const COARSE_PX: f64 = 14.0;
/// Samples of a small cell in each direction.
const SAMPLES: usize = 8;
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
    white: Box<[[f64; MAX_ACROSS]; MAX_ACROSS]>,
    /// The same with cells twice as wide.
    coarse: Box<[[f64; MAX_ACROSS]; MAX_ACROSS]>,
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
        let white = white(&drawing);
        let coarse = halved(&white);
        let black = edges();
        let bright = black.iter().map(|[place, [x, y]]| [*place, [-x, -y]]).collect();
        Some(Self { family, id, white, coarse, edges: [black, bright] })
    }

    /// For a square with sides of this length, printed white on black when `inverted`.
    pub(crate) fn design(&self, side_px: f64, inverted: bool) -> Design<'_> {
        let is_wide = side_px * RIM / 2.0 >= MIN_RIM_PX;
        let edges = &self.edges[usize::from(inverted)];
        let edges = if is_wide { &edges[..] } else { &edges[..4 * PER_SIDE] };
        let border = BORDER / 2.0;
        if side_px < COARSE_PX {
            let (cells, margin) = (CELLS / 2, MARGIN / 2);
            Design { cells, margin, white: &self.coarse, edges, border }
        } else {
            Design { cells: CELLS, margin: MARGIN, white: &self.white, edges, border }
        }
    }
}

/// The share of white in each small cell.
fn white(drawing: &Drawing) -> Box<[[f64; MAX_ACROSS]; MAX_ACROSS]> {
    let mut fine = vec![true; FINE * FINE];
    let per_unit = (CELLS * SAMPLES) as f64;
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
    let mut white = Box::new([[0.0; MAX_ACROSS]; MAX_ACROSS]);
    for (index, is_white) in fine.iter().enumerate() {
        let (x, y) = (index % FINE / SAMPLES, index / FINE / SAMPLES);
        white[y][x] += f64::from(u8::from(*is_white)) / (SAMPLES * SAMPLES) as f64;
    }
    white
}

/// The same with cells twice as wide.
fn halved(white: &[[f64; MAX_ACROSS]; MAX_ACROSS]) -> Box<[[f64; MAX_ACROSS]; MAX_ACROSS]> {
    let mut coarse = Box::new([[0.0; MAX_ACROSS]; MAX_ACROSS]);
    for (y, row) in white.iter().enumerate() {
        for (x, share) in row.iter().enumerate() {
            coarse[y / 2][x / 2] += share / 4.0;
        }
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
        // Every seventh cell, to save time.
        for cell in (0..ACROSS * ACROSS).step_by(7) {
            let (x, y) = (cell % ACROSS, cell / ACROSS);
            let place = |cell: usize, k: usize| {
                let offset = (k as f64 + 0.5) / f64::from(samples);
                (cell as f64 + offset - ACROSS as f64 / 2.0) / CELLS as f64
            };
            let all =
                (0..samples as usize).flat_map(|i| (0..samples as usize).map(move |j| (i, j)));
            let white =
                all.filter(|(i, j)| drawing.ink_at(place(x, *i), -place(y, *j)) == Ink::White);
            let share = white.count() as f64 / f64::from(samples * samples);
            assert!((share - design.white[y][x]).abs() < 0.12, "{x} {y}");
        }
        let sum = |white: &[[f64; MAX_ACROSS]; MAX_ACROSS]| white.iter().flatten().sum::<f64>();
        assert!((sum(&design.white) - 4.0 * sum(&design.coarse)).abs() < 1e-6);
    }
}
