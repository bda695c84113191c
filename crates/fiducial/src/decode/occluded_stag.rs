//! Quads that may be STags of which a part is in shadow, washed out, covered or beyond the frame: made of segments of
//! edges, the slow way, for when closed outlines show nothing.

use crate::candidates::quad::{Quad, diagonal_px, middle};
use crate::families::stag::Reading;

/// The most quads that are kept for a closer look.
const MOST_FOUND: usize = 64;

/// Reads quads of segments. It keeps its memory from image to image.
#[derive(Debug, Default)]
pub(crate) struct Damaged {
    found: Vec<Candidate>,
}

/// A quad, what it says, and how sure that is.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Candidate {
    pub(crate) quad: Quad,
    pub(crate) reading: Reading,
    pub(crate) sureness: f64,
}

impl Damaged {
    /// Makes room for what may be found.
    pub(crate) fn make_room(&mut self) {
        self.found.clear();
        self.found.reserve(MOST_FOUND);
    }

    /// The quads that `read` reads, each place once, the surest first.
    pub(crate) fn find(
        &mut self,
        quads: &[Quad],
        mut read: impl FnMut(&Quad) -> Option<(Reading, f64)>,
    ) -> &[Candidate] {
        self.found.clear();
        for quad in quads {
            if self.found.len() >= MOST_FOUND {
                break;
            }
            if let Some((reading, sureness)) = read(quad) {
                self.found.push(Candidate { quad: *quad, reading, sureness });
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
