//! Measures sub-pixel corners of a square marker, to a hundredth of a pixel.
//!
//! All edges of the marker take part, those between its cells as well. There are two refinements. Where cells
//! are wide, each edge is compared on its own, with its own black and white (`edges`). Where the blur of one
//! edge reaches the next, the grey values of the whole marker are predicted (`photometric`). A drawing without light and blur has nothing
//! for either: its corners are where the sides meet that its pixels show (`drawing`).
//!
//! Edges are straight in the ideal image, without lens distortion. The model is made there and its places are
//! distorted; the image is never resampled.

use crate::optics::homography::CORNERS;
use crate::optics::undistort::Undistortion;
use crate::refine::drawing::{DrawnSquare, drawn_square};
use crate::refine::fit::{CornerGuess, Design, Refined, Scratch, Target};
use crate::refine::pattern::Pattern;
use crate::refine::{edges, photometric};

/// Where cells are narrower than this, in pixels, the blurs of neighbouring edges overlap.
const MIN_CELL_PX: f64 = 5.5;
/// The same where a camera's processing has moved the edges by so many pixels or more, or may have: the halos of sharpening
/// reach farther than a blur.
const MIN_SHARPENED_CELL_PX: f64 = 7.5;
const MIN_SHIFT_PX: f64 = 0.1;
/// The same for a border without fine detail next to it.
const MIN_BORDER_PX: f64 = 4.0;
/// Sides that a lens bends by no more than this, in pixels, are straight.
const MAX_BOW_PX: f64 = 0.1;

/// Refines the corners of a marker of square cells. `None` when no such marker is there.
pub fn refine(
    guess: &CornerGuess<'_>,
    pattern: &Pattern,
    scratch: &mut Scratch,
) -> Option<Refined> {
    drawn(guess).or_else(|| fitted(guess, pattern, scratch))
}

/// The corners of a drawing, in which neither fit finds the light and the blur that it is for; `None` in other pictures, and where the lens
/// bends the sides.
fn drawn(guess: &CornerGuess<'_>) -> Option<Refined> {
    let DrawnSquare { corners, corner_px } = drawn_square(guess.view, guess.corners)?;
    let lens = Undistortion::new(guess.camera, &corners)?;
    let square = lens.homography(&corners)?;
    for (i, [x, y]) in CORNERS.into_iter().enumerate() {
        let [next_x, next_y] = CORNERS[(i + 1) % 4];
        let middle = square.project([(x + next_x) / 2.0, (y + next_y) / 2.0]);
        let (middle, _) = lens.distort(middle.image)?;
        let [from, to] = [corners[i], corners[(i + 1) % 4]];
        let area = (to.x - from.x) * (middle.y - from.y) - (to.y - from.y) * (middle.x - from.x);
        if area.abs() > MAX_BOW_PX * from.distance(&to) {
            return None;
        }
    }
    Some(Refined::unrefined(&corners, corner_px))
}

fn fitted(guess: &CornerGuess<'_>, pattern: &Pattern, scratch: &mut Scratch) -> Option<Refined> {
    let lens = Undistortion::new(guess.camera, guess.corners)?;
    let start = lens.homography(guess.corners)?;
    let CornerGuess { view, response, .. } = *guess;
    let target = Target { view, lens: &lens, start: &start, response };
    let cell_px = start.narrowest_cell_px(pattern.cells());
    let along_edges = (cell_px >= MIN_CELL_PX)
        .then(|| edges::fit(target, pattern, guess.is_near, scratch))
        .flatten();
    let is_narrow = cell_px < MIN_SHARPENED_CELL_PX;
    let fit = match along_edges {
        Some(fit) if !is_narrow || fit.is_shift_known && fit.shift_px.abs() < MIN_SHIFT_PX => fit,
        Some(fit) => {
            let near = Target { start: &fit.homography, ..target };
            photometric::fit(near, pattern, scratch).unwrap_or(fit)
        }
        None => photometric::fit(target, pattern, scratch)?,
    };
    fit.refined(&lens, guess, start.shortest_side_px())
}

/// Refines the corners of a marker of another design.
pub(crate) fn refine_design(
    guess: &CornerGuess<'_>,
    design: &Design<'_>,
    scratch: &mut Scratch,
) -> Option<Refined> {
    drawn(guess).or_else(|| fitted_design(guess, design, scratch))
}

fn fitted_design(
    guess: &CornerGuess<'_>,
    design: &Design<'_>,
    scratch: &mut Scratch,
) -> Option<Refined> {
    let lens = Undistortion::new(guess.camera, guess.corners)?;
    let start = lens.homography(guess.corners)?;
    let CornerGuess { view, response, .. } = *guess;
    let target = Target { view, lens: &lens, start: &start, response };
    let side_px = start.shortest_side_px();
    let along_edges = (design.border * side_px >= MIN_BORDER_PX)
        .then(|| edges::fit_edges(target, design.edges, scratch))
        .flatten();
    let fit = match along_edges {
        Some(fit) if fit.is_shift_known => fit,
        Some(fit) => {
            let processed = photometric::fit_processed_design(target, design, &fit, scratch);
            processed.unwrap_or(fit)
        }
        None => photometric::fit_design(target, design, scratch)?,
    };
    fit.refined(&lens, guess, side_px)
}
