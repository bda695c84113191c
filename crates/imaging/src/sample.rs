//! Grey values between the pixels.

use crate::view::GrayView;

/// The grey value at a place between pixel centres, interpolated linearly both ways; `None` outside the pixels'
/// centres.
#[inline]
pub fn bilinear(view: GrayView<'_>, x: f64, y: f64) -> Option<f64> {
    let (last_x, last_y) = (view.width() - 1, view.height() - 1);
    // Written so that a place that is not a number is outside.
    if !(x >= 0.0 && y >= 0.0 && x <= last_x as f64 && y <= last_y as f64) {
        return None;
    }
    let (left, top) = (x as usize, y as usize);
    let (right, bottom) = ((left + 1).min(last_x), (top + 1).min(last_y));
    let (fx, fy) = (x - left as f64, y - top as f64);
    let across = |row: &[u8]| {
        let (a, b) = (f64::from(row[left]), f64::from(row[right]));
        a + (b - a) * fx
    };
    let (above, below) = (across(view.row(top)), across(view.row(bottom)));
    Some(above + (below - above) * fy)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_between_pixels_and_beyond_them() {
        let view = GrayView::packed(&[0, 100, 200, 60], 2, 2).unwrap();
        assert_eq!(bilinear(view, 1.0, 0.0), Some(100.0));
        assert_eq!(bilinear(view, 0.5, 0.5), Some(90.0));
        assert_eq!(bilinear(view, 1.0, 1.0), Some(60.0));
        for (x, y) in
            [(-0.01, 0.0), (1.01, 0.0), (0.0, 1.01), (f64::NAN, 0.0), (0.0, f64::INFINITY)]
        {
            assert_eq!(bilinear(view, x, y), None);
        }
    }
}
