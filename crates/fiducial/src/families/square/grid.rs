//! Finds the tags of a calibration grid, each next to one that was found.
//!
//! In a grid of Kalibr's (Furgale, Rehder and Siegwart, "Unified temporal and spatial calibration for multi-sensor systems", 2013) black
//! squares fill the gaps between the corners of the tags. Blur joins them to the tags, so that many tags have no separate
//! outline. Their positions follow from a neighbour.

use geometry::Pixel;

use super::{Decoded, MAX_FOUND, MAX_SOLVED, SquareTagDetector, Unread, is_covered};
use crate::candidates::quad::{Quad, mean_side_px};
use crate::decode::cells::{Layout, SquareImage};
use crate::families::query::ImageInput;
use crate::optics::camera_response::CameraResponse;
use crate::optics::homography::Homography;
use crate::trace::Trace;

/// The gap between tags, in sides of a tag: Kalibr's default `tagSpacing`.
const SPACING: f64 = 0.3;

/// Quads are moved to where their cells explain the pixels best, so many in an image, by these fractions of their side.
const MAX_ALIGNED_IN_GRID: usize = 24;
const ALIGNING_IN_GRID: [f64; 4] = [0.03, 0.02, 0.015, 0.01];

impl SquareTagDetector {
    /// Reads the other tags of a calibration grid, each next to one that was found.
    pub(super) fn decode_grid(&mut self, input: ImageInput<'_>, trace: &mut Trace) {
        (self.solved, self.aligned) = (0, 0);
        let mut index = 0;
        while let Some(known) = self.found.get(index).copied() {
            index += 1;
            let query = &self.queries[known.query];
            let [_, wide] = query.layouts;
            let Some(layout) = wide.filter(|_| known.extra_border > 0) else { continue };
            if neighbours(&known.corners).all(|quad| is_covered(&self.found, &quad)) {
                continue;
            }
            let refined = known.refined(query, input, false, &mut self.scratch);
            let corners = refined.map_or(known.corners, |refined| refined.corners);
            for quad in neighbours(&corners) {
                if self.solved < MAX_SOLVED
                    && self.found.len() < MAX_FOUND
                    && !is_covered(&self.found, &quad)
                    && let Some(found) = self.decode_in_grid(input, &quad, layout)
                {
                    self.accept(found, trace);
                }
            }
        }
    }

    /// The tag near a quad, whose place is only known to some percent of its side: a lens bends the grid.
    fn decode_in_grid(
        &mut self,
        input: ImageInput<'_>,
        quad: &Quad,
        layout: usize,
    ) -> Option<Decoded> {
        let Layout { cells, .. } = self.layouts[layout];
        let image = SquareImage::new(&quad.corners, cells, input.view, input.pyramid)?;
        if !image.has_second_ring(cells) {
            return None;
        }
        let curve = CameraResponse::LINEAR.curve;
        let r_squared = match self.decode_shown(input, quad, layout, curve) {
            Ok(found) => return Some(found),
            Err(r_squared) => r_squared,
        };
        if self.aligned >= MAX_ALIGNED_IN_GRID {
            return None;
        }
        self.aligned += 1;
        let side_px = mean_side_px(&quad.corners);
        let steps_px = ALIGNING_IN_GRID.map(|ratio| ratio * side_px);
        self.decode_aligned(input, Unread { quad: *quad, curve, r_squared }, layout, steps_px)
    }
}

/// The quads of the four tags next to one with these outer corners; of those that are in front of the camera.
fn neighbours(corners: &[Pixel; 4]) -> impl Iterator<Item = Quad> {
    let square = Homography::from_square([0.0, 1.0], &corners.map(|c| [c.x, c.y]));
    const STEP: f64 = 1.0 + SPACING;
    [[STEP, 0.0], [0.0, STEP], [-STEP, 0.0], [0.0, -STEP]].into_iter().filter_map(
        move |[dx, dy]| {
            let square = square.as_ref()?;
            let mut moved = *corners;
            for (corner, [x, y]) in
                moved.iter_mut().zip([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
            {
                let [x, y] = square.project_visible([x + dx, y + dy])?;
                *corner = Pixel::new(x, y);
            }
            Some(Quad { corners: moved, inverted: false })
        },
    )
}
