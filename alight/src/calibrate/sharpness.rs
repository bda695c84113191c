//! Measures the width over which a tag's outline is blurred.

use geometry::Pixel;
use imaging::{GrayView, sample::bilinear};

/// Distance from the outline up to which samples are taken, in pixels, and their step.
const REACH_PX: f64 = 6.0;
const STEP_PX: f64 = 0.5;
/// Minimum contrast of an edge, in grey levels.
const MIN_CONTRAST: f64 = 20.0;

/// The width over which the outline of a tag changes from black to white, in pixels: its contrast by its steepest slope, in
/// the median of its four sides; `None` where no side shows it.
pub(super) fn edge_width_px(view: GrayView<'_>, corners: &[Pixel; 4]) -> Option<f64> {
    let mut widths: Vec<f64> =
        (0..4).filter_map(|i| side_width_px(view, corners[i], corners[(i + 1) % 4])).collect();
    widths.sort_by(f64::total_cmp);
    widths.get(widths.len() / 2).copied()
}

fn side_width_px(view: GrayView<'_>, from: Pixel, to: Pixel) -> Option<f64> {
    let length = from.distance(&to);
    // Within a fourth of the tag's cell there is no other edge: a cell is an eighth of the side.
    let reach = REACH_PX.min(length / 8.0);
    if reach < 2.0 * STEP_PX {
        return None;
    }
    let across = [(to.y - from.y) / length, (from.x - to.x) / length];
    let middle = [(from.x + to.x) / 2.0, (from.y + to.y) / 2.0];
    let steps = (reach / STEP_PX) as i32;
    let levels: Vec<f64> = (-steps..=steps)
        .map(|step| {
            let at = f64::from(step) * STEP_PX;
            bilinear(view, middle[0] + at * across[0], middle[1] + at * across[1])
        })
        .collect::<Option<_>>()?;
    let [darkest, brightest] = [f64::min, f64::max].map(|pick| levels.iter().copied().reduce(pick));
    let contrast = brightest? - darkest?;
    let slope =
        levels.windows(3).map(|w| (w[2] - w[0]).abs() / (2.0 * STEP_PX)).fold(0.0, f64::max);
    (contrast >= MIN_CONTRAST && slope > 0.0).then(|| contrast / slope)
}

#[cfg(test)]
mod tests {
    use super::*;
    use imaging::GrayImage;

    /// The width of the outline of a black square whose edges are ramps of this width.
    fn width_of(ramp_px: f64) -> f64 {
        let mut image = GrayImage::filled(200, 200, 0);
        for (i, pixel) in image.pixels_mut().iter_mut().enumerate() {
            let [x, y] = [i % 200, i / 200].map(|at| at as f64 - 99.5);
            let outside = x.abs().max(y.abs()) - 50.0;
            *pixel = (220.0 * (outside / ramp_px + 0.5).clamp(0.0, 1.0) + 20.0) as u8;
        }
        let corner = |x: f64, y: f64| Pixel::new(99.5 + 50.0 * x, 99.5 + 50.0 * y);
        let corners = [corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)];
        edge_width_px(image.view().unwrap(), &corners).unwrap()
    }

    #[test]
    fn a_wider_ramp_is_wider() {
        for ramp_px in [2.0, 4.0, 8.0] {
            let width = width_of(ramp_px);
            assert!((width - ramp_px).abs() < 0.15 * ramp_px, "{ramp_px}: {width}");
        }
    }
}
