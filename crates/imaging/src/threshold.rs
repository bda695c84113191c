//! Binarises with one threshold.

use crate::view::{GrayImage, GrayView};

/// Binarises with one threshold (Equation 3.3 with M = 255): 255 where the pixel is at least `threshold`,
/// else 0.
///
/// OpenCV's `threshold` compares with `>`, so its T is one less.
pub fn threshold(view: GrayView<'_>, threshold: u8, out: &mut GrayImage) {
    out.resize(view.width(), view.height());
    for y in 0..view.height() {
        for (to, from) in out.row_mut(y).iter_mut().zip(view.row(y)) {
            *to = if *from >= threshold { 255 } else { 0 };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pixel_at_the_threshold_is_white() {
        let view = GrayView::packed(&[69, 70, 71], 3, 1).unwrap();
        let mut out = GrayImage::default();
        threshold(view, 70, &mut out);
        assert_eq!(out.pixels(), [0, 255, 255]);
    }
}
