//! Reads the bits around a tag, for it may be a part of a tag of another family, whose bits include all of its own.

use geometry::Pixel;
use markers::SquareCode;

use super::max_hamming;
use crate::decode::cells::{Cells, Layout, SquareImage};
use crate::families::query::ImageInput;

/// Fewer more bits than these may complete a tag to one of a larger code by chance.
const MIN_MORE_BITS: usize = 16;

/// A code of larger tags, which need not be listed.
#[derive(Debug)]
pub(super) struct LargerCode {
    code: &'static SquareCode,
    layout: Layout,
}

impl LargerCode {
    /// The codes whose tags may contain one of this code.
    pub(super) fn all_of(code: &SquareCode) -> Vec<Self> {
        let prepared = |code| Some(Self { code, layout: Layout::for_code(code, 0)? });
        code.containing(MIN_MORE_BITS).filter_map(prepared).collect()
    }

    /// Whether the square is that of a tag of this code. Around a tag that was printed alone are paper and ground: with straight edges
    /// between two brightnesses at any place they differ from each codeword by 5 bits or more (all 38 tags of Circle21h7).
    pub(super) fn is_shown(
        &self,
        cells: &mut Cells,
        input: ImageInput<'_>,
        corners: &[Pixel; 4],
    ) -> bool {
        let Self { code, layout } = self;
        SquareImage::new(corners, layout.cells, input.view, input.pyramid).is_some_and(|image| {
            cells.solve_fast(&image, layout)
                && code.nearest(cells.word(), max_hamming(code)).is_some()
        })
    }
}
