//! Finds the quads among the closed outlines of an image, for all families of square markers.

use imaging::{GrayView, Outlines};

use crate::candidates::quad::Quad;
use crate::candidates::quiet_zone::{MAX_CONTRAST_VARIATION, border_contrast_variation};
use crate::trace::{Reason, Trace};

/// Largest number of quads in one image, far above that of frames with markers.
const MAX_QUADS: usize = 4000;

/// Quads with an even border. It keeps its memory from image to image.
#[derive(Debug, Default)]
pub(crate) struct OutlineQuads {
    found: Vec<OutlineQuad>,
}

#[derive(Copy, Clone, Debug)]
struct OutlineQuad {
    quad: Quad,
    contrast_variation: f64,
}

impl OutlineQuads {
    /// Makes room for the quads of a frame with texture.
    pub(crate) fn make_room(&mut self) {
        const QUADS: usize = 2000;
        self.found.clear();
        self.found.reserve(QUADS);
    }

    /// Finds the quads among the outlines of an image.
    pub(crate) fn find(&mut self, view: GrayView<'_>, outlines: &Outlines, trace: &mut Trace) {
        self.found.clear();
        for outline in outlines.iter() {
            let Some(quad) = Quad::from_outline(&outline) else { continue };
            let Some(level) = outlines.pyramid().level(view, outline.level) else { continue };
            let contrast_variation = border_contrast_variation(&quad, level, outline.level);
            if contrast_variation > MAX_CONTRAST_VARIATION {
                trace.refuse_quad(quad.corners, Reason::Border);
                continue;
            }
            self.found.push(OutlineQuad { quad, contrast_variation });
            if self.found.len() >= MAX_QUADS {
                break;
            }
        }
        // The likeliest first, so that bounds on later work cost the least likely ones.
        let order = |a: &OutlineQuad, b: &OutlineQuad| {
            a.contrast_variation.total_cmp(&b.contrast_variation)
        };
        self.found.sort_unstable_by(order);
    }

    /// The quads of the last image, those with the most even border first.
    pub(crate) fn iter(&self) -> impl Iterator<Item = &Quad> {
        self.found.iter().map(|found| &found.quad)
    }
}
