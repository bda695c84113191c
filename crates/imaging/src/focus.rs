//! How sharp an image is, whatever it shows.

use crate::GrayView;

/// Rows, and columns, that are looked at; of a larger image every second, third and so on.
const LINES: usize = 200;
/// Minimum slope of an edge, in grey levels per two pixels, and its minimum contrast, in grey levels: less may be noise.
const MIN_SLOPE: i32 = 8;
const MIN_CONTRAST: i32 = 40;
/// Minimum number of edges of which something can be said.
const MIN_EDGES: usize = 50;
/// The part of the edges that is narrower: a picture also shows what is soft, or lies askew to rows and columns.
const NARROW: f64 = 0.1;

/// The width of an image's narrow edges in pixels: contrast by steepest slope, the first decile over rows and columns. A step
/// that a Gaussian of deviation s blurs is 2.5 s wide. A camera in focus has 2 to 3 pixels. `None` where too little has contrast.
pub fn edge_width_px(view: GrayView<'_>) -> Option<f64> {
    let (width, height) = (view.width(), view.height());
    let mut widths = Vec::new();
    for y in (0..height).step_by(height.div_ceil(LINES).max(1)) {
        add_widths(view.row(y), &mut widths);
    }
    let mut column = vec![0; height];
    for x in (0..width).step_by(width.div_ceil(LINES).max(1)) {
        column.iter_mut().enumerate().for_each(|(y, level)| *level = view.at(x, y));
        add_widths(&column, &mut widths);
    }
    if widths.len() < MIN_EDGES {
        return None;
    }
    let rank = (widths.len() as f64 * NARROW) as usize;
    let (_, width, _) = widths.select_nth_unstable_by(rank, f32::total_cmp);
    Some(f64::from(*width))
}

/// Adds the widths of the edges along a line of pixels.
fn add_widths(line: &[u8], widths: &mut Vec<f32>) {
    let slope = |x: usize| match (line.get(x + 1), x.checked_sub(1).and_then(|x| line.get(x))) {
        (Some(next), Some(before)) => i32::from(*next) - i32::from(*before),
        _ => 0,
    };
    for x in 1..line.len().saturating_sub(1) {
        let steepest = slope(x);
        let is_peak = steepest.abs() >= slope(x - 1).abs() && steepest.abs() > slope(x + 1).abs();
        if !is_peak || steepest.abs() < MIN_SLOPE {
            continue;
        }
        // The ends of the run of rising, or falling, levels.
        let goes_on = |pair: &&[u8]| pair[1] != pair[0] && (pair[1] > pair[0]) == (steepest > 0);
        let after = line[x..].windows(2).take_while(goes_on).count();
        let before = line[..=x].windows(2).rev().take_while(goes_on).count();
        let contrast = (i32::from(line[x + after]) - i32::from(line[x - before])).abs();
        if contrast >= MIN_CONTRAST {
            widths.push(2.0 * contrast as f32 / steepest.abs() as f32);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::GrayImage;

    /// Bars of 16 pixels whose edges are ramps of this width.
    fn bars(ramp_px: f64, contrast: f64) -> GrayImage {
        let mut image = GrayImage::filled(320, 240, 0);
        for (i, pixel) in image.pixels_mut().iter_mut().enumerate() {
            let x = (i % 320) as f64 + 0.37;
            let from_edge = (x / 16.0).fract() * 16.0 - 8.0;
            let is_rising = ((x / 16.0) as usize).is_multiple_of(2);
            let part = (from_edge / ramp_px + 0.5).clamp(0.0, 1.0);
            *pixel = (20.0 + contrast * if is_rising { part } else { 1.0 - part }) as u8;
        }
        image
    }

    #[test]
    fn ramps_are_as_wide_as_they_are() {
        for ramp_px in [3.0, 5.0, 8.0, 12.0] {
            let width = edge_width_px(bars(ramp_px, 200.0).view().unwrap()).unwrap();
            assert!((width / ramp_px - 1.0).abs() < 0.15, "{ramp_px}: {width}");
        }
        let step = edge_width_px(bars(0.1, 200.0).view().unwrap()).unwrap();
        assert!((1.0..=2.0).contains(&step), "{step}");
    }

    #[test]
    fn of_an_image_without_contrast_nothing_is_said() {
        assert_eq!(edge_width_px(bars(3.0, 30.0).view().unwrap()), None);
        assert_eq!(edge_width_px(GrayImage::filled(1, 1, 7).view().unwrap()), None);
        let mut noise = GrayImage::filled(320, 240, 100);
        for (i, pixel) in noise.pixels_mut().iter_mut().enumerate() {
            *pixel += ((i * 7919) % 31) as u8;
        }
        assert_eq!(edge_width_px(noise.view().unwrap()), None);
    }
}
