//! Interpolates grey values between pixels.

use crate::view::GrayView;

/// The bilinearly interpolated grey value; `None` outside the pixels' centres.
#[inline]
pub fn bilinear(view: GrayView<'_>, x: f64, y: f64) -> Option<f64> {
    // The casts saturate: negative numbers and NaN become 0 and fail the check of the fractions.
    let (left, top) = (x as u32, y as u32);
    let (fx, fy) = (x - f64::from(left), y - f64::from(top));
    if !(fx >= 0.0 && fy >= 0.0) {
        return None;
    }
    let (left, top) = (left as usize, top as usize);
    let beyond = |edge: usize, at: usize| edge.checked_sub(at)?.checked_sub(1);
    let (right, below) = (beyond(view.width(), left)?, beyond(view.height(), top)?);
    // The last column and row end at their pixels' centres.
    if (right == 0 && fx > 0.0) || (below == 0 && fy > 0.0) {
        return None;
    }
    // Nearly all places are well inside, where the four pixels need two checks.
    let pixels = match (right, below) {
        (1.., 1..) => view.four(left, top),
        _ => view.square(left, top, [right.min(1), below.min(1)]),
    };
    let [a, b, c, d] = pixels?.map(f64::from);
    let (above, below) = (a + (b - a) * fx, c + (d - c) * fx);
    Some(above + (below - above) * fy)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_interpolated_inside_the_image_only() {
        let view = GrayView::packed(&[0, 100, 200, 60], 2, 2).unwrap();
        assert_eq!(bilinear(view, 1.0, 0.0), Some(100.0));
        assert_eq!(bilinear(view, 0.5, 0.5), Some(90.0));
        assert_eq!(bilinear(view, 1.0, 1.0), Some(60.0));
        for (x, y) in [
            (-0.01, 0.0),
            (1.01, 0.0),
            (0.0, 1.01),
            (f64::NAN, 0.0),
            (0.0, f64::INFINITY),
            (5e9, 0.0),
            (-1e30, 1.0),
        ] {
            assert_eq!(bilinear(view, x, y), None);
        }
    }
}
