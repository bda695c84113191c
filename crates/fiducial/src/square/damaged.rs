//! Finds square markers that are in part in shadow, washed out, covered or beyond the frame: the slow way, for when
//! closed outlines do not show them.

use geometry::Pixel;
use imaging::pyramid::to_level_0;
use imaging::{GrayView, LeastEdge, Pyramid, Segments};

use super::code::Code;
use super::erasures::{self, Reading};
use super::quad::Quad;
use super::segments::{Placement, SegmentQuads};

/// The markers of one family that are looked for.
#[derive(Copy, Clone, Debug)]
pub struct Sought<'a> {
    /// What the caller knows the family by.
    pub index: usize,
    /// The family's code.
    pub code: &'a Code,
    /// The ids; `None` stands for all.
    pub ids: Option<&'a [u32]>,
}

/// A marker that was found.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct DamagedMarker {
    /// What the caller knows its family by.
    pub index: usize,
    /// Its outline, the marker's own top left corner first.
    pub quad: Quad,
    /// What it says.
    pub reading: Reading,
}

/// Finds damaged markers. It keeps its memory from image to image.
#[derive(Clone, Debug, Default)]
pub struct Damaged {
    segments: Segments,
    quads: SegmentQuads,
    found: Vec<DamagedMarker>,
}

/// Segments are taken on the finest level of the pyramid with no more pixels than this, and on the next one.
const MOST_PIXELS: usize = 400_000;
const LEVELS: usize = 2;
const LEAST_EDGE: LeastEdge = LeastEdge { gradient: 6, length_px: 5.0 };
/// The most quads that are read in an image, and the most markers that are found.
const MOST_READ: usize = 200;
const MOST_FOUND: usize = 64;

impl Damaged {
    /// The markers in an image, of which `pyramid` was built; the surest first.
    pub fn find<'a>(
        &mut self,
        view: GrayView<'_>,
        pyramid: &Pyramid,
        sought: impl Iterator<Item = Sought<'a>> + Clone,
    ) -> &[DamagedMarker] {
        self.found.clear();
        let pixels = |level: usize| (view.width() * view.height()) >> (2 * level.min(31));
        let finest = (0..pyramid.levels()).find(|level| pixels(*level) <= MOST_PIXELS);
        let finest = finest.unwrap_or(pyramid.levels().saturating_sub(1));
        let mut left = MOST_READ;
        for level in finest..(finest + LEVELS).min(pyramid.levels()) {
            let Some(picture) = pyramid.level(view, level) else { continue };
            let segments = self.segments.find(picture, LEAST_EDGE);
            let offset = to_level_0(0.0, level) as f32;
            let placement = Placement { scale: 1.0 + 2.0 * offset, offset };
            for inverted in [false, true] {
                let size = [picture.width(), picture.height()];
                for quad in self.quads.find(segments, size, placement, inverted) {
                    read(view, &quad.quad, sought.clone(), &mut left, &mut self.found);
                }
            }
        }
        self.choose();
        &self.found
    }

    /// Of what was found in one place more than once, keeps the surest.
    fn choose(&mut self) {
        let sureness = |marker: &DamagedMarker| marker.reading.intact * marker.reading.evidence;
        self.found.sort_unstable_by(|a, b| sureness(b).total_cmp(&sureness(a)));
        let mut kept = 0;
        for index in 0..self.found.len() {
            let marker = self.found[index];
            if !self.found[..kept].iter().any(|other| is_same_place(&other.quad, &marker.quad)) {
                self.found[kept] = marker;
                kept += 1;
            }
        }
        self.found.truncate(kept);
    }
}

/// Reads a quad as a marker of each family that is looked for.
fn read<'a>(
    view: GrayView<'_>,
    quad: &Quad,
    sought: impl Iterator<Item = Sought<'a>>,
    left: &mut usize,
    found: &mut Vec<DamagedMarker>,
) {
    // What was read well needs no second reading.
    let is_known = found.iter().any(|m| m.reading.intact > 0.9 && is_same_place(&m.quad, quad));
    if is_known {
        return;
    }
    for family in sought {
        if *left == 0 || found.len() >= MOST_FOUND || !erasures::has_border(view, quad, family.code)
        {
            continue;
        }
        *left -= 1;
        if let Some(reading) = erasures::read(view, quad, family.code, family.ids) {
            let mut quad = *quad;
            quad.corners.rotate_left(usize::from(reading.quarter_turns % 4));
            found.push(DamagedMarker { index: family.index, quad, reading });
        }
    }
}

/// Whether two quads overlap so much that only one of them can be a marker.
fn is_same_place(a: &Quad, b: &Quad) -> bool {
    let middle = |quad: &Quad| {
        let [a, b, c, d] = quad.corners;
        Pixel::new((a.x + b.x + c.x + d.x) / 4.0, (a.y + b.y + c.y + d.y) / 4.0)
    };
    let size = |quad: &Quad| {
        let [a, b, c, d] = quad.corners;
        a.distance(&c).max(b.distance(&d))
    };
    middle(a).distance(&middle(b)) < 0.4 * size(a).max(size(b))
}
