//! Quads that may be STags of which a part is in shadow, washed out, covered or beyond the frame: made of segments of
//! edges, the slow way, for when closed outlines show nothing.

use imaging::pyramid::to_level_0;
use imaging::{GrayView, LeastEdge, Pyramid, Segments};

use super::Reading;
use crate::square::quad::{Quad, diagonal_px, middle};
use crate::square::segments::{Placement, SegmentQuads};

/// Segments are taken on the finest level of the pyramid with no more pixels than this, and on the next one.
const MOST_PIXELS: usize = 400_000;
const LEVELS: usize = 2;
const LEAST_EDGE: LeastEdge = LeastEdge { gradient: 6, length_px: 5.0 };
/// The most quads that are kept for a closer look.
const MOST_FOUND: usize = 64;

/// Makes quads of segments. It keeps its memory from image to image.
#[derive(Debug, Default)]
pub(super) struct Damaged {
    segments: Segments,
    quads: SegmentQuads,
    found: Vec<Candidate>,
}

/// A quad, what it says, and how sure that is.
#[derive(Copy, Clone, Debug)]
pub(super) struct Candidate {
    pub(super) quad: Quad,
    pub(super) reading: Reading,
    pub(super) sureness: f64,
}

impl Damaged {
    /// The quads in an image that `read` reads, each place once, the surest first.
    pub(super) fn find(
        &mut self,
        (view, pyramid): (GrayView<'_>, &Pyramid),
        mut read: impl FnMut(&Quad) -> Option<(Reading, f64)>,
    ) -> &[Candidate] {
        self.found.clear();
        let pixels = |level: usize| (view.width() * view.height()) >> (2 * level.min(31));
        let finest = (0..pyramid.levels()).find(|level| pixels(*level) <= MOST_PIXELS);
        let finest = finest.unwrap_or(pyramid.levels().saturating_sub(1));
        for level in finest..(finest + LEVELS).min(pyramid.levels()) {
            let Some(picture) = pyramid.level(view, level) else { continue };
            let segments = self.segments.find(picture, LEAST_EDGE);
            let offset = to_level_0(0.0, level) as f32;
            let placement = Placement { scale: 1.0 + 2.0 * offset, offset };
            let size = [picture.width(), picture.height()];
            for inverted in [false, true] {
                for seen in self.quads.find(segments, size, placement, inverted) {
                    if self.found.len() >= MOST_FOUND {
                        break;
                    }
                    if let Some((reading, sureness)) = read(&seen.quad) {
                        self.found.push(Candidate { quad: seen.quad, reading, sureness });
                    }
                }
            }
        }
        self.found.sort_unstable_by(|a, b| b.sureness.total_cmp(&a.sureness));
        let mut kept = 0;
        for index in 0..self.found.len() {
            let candidate = self.found[index];
            let (known, quad) = (&self.found[..kept], &candidate.quad);
            if !known.iter().any(|other| is_same_place(&other.quad, quad)) {
                self.found[kept] = candidate;
                kept += 1;
            }
        }
        self.found.truncate(kept);
        &self.found
    }
}

/// Whether two quads overlap so much that only one of them can be a marker.
fn is_same_place(a: &Quad, b: &Quad) -> bool {
    let size = diagonal_px(&a.corners).max(diagonal_px(&b.corners));
    middle(&a.corners).distance(&middle(&b.corners)) < 0.4 * size
}
