//! Measures how sharp an image is, with any content.

use crate::GrayView;

/// Rows, and columns, that are looked at; of a larger image every second, third and so on.
const LINES: usize = 200;
/// Minimum slope of an edge, in grey levels per two pixels, and its minimum contrast, in grey levels: less may be noise.
const MIN_SLOPE: i32 = 8;
const MIN_CONTRAST: i32 = 40;
/// Minimum number of edges for a result.
const MIN_EDGES: usize = 50;
/// Noise that is left, in grey levels: of an image with more, so many lines are averaged that as much is left.
const MAX_NOISE: f64 = 1.5;
/// Maximum number of lines that are averaged. Those across a tilted edge make it wider; there are others.
const MAX_AVERAGED: usize = 16;
/// Median of the absolute second difference of normal noise, in its standard deviations.
const SECOND_DIFFERENCE: f64 = 1.652;
/// The part of the edges that is narrower: a picture also shows soft edges, and edges oblique to rows and columns.
const NARROW: f64 = 0.1;

/// The width of an image's narrow edges in pixels: contrast by steepest slope, the first decile over rows and columns. A step
/// that a Gaussian of deviation s blurs is 2.5 s wide. A camera in focus has 2 to 3 pixels. `None` where too little has contrast.
///
/// Noise would cut a wide edge into narrow ones, so neighbouring lines are averaged where there is much of it.
pub fn edge_width_px(view: GrayView<'_>) -> Option<f64> {
    let (width, height) = (view.width(), view.height());
    let averaged = (noise(view) / MAX_NOISE).powi(2).ceil() as usize;
    let averaged = averaged.clamp(1, MAX_AVERAGED);
    let mut widths = Vec::new();
    let mut line = vec![0; width.max(height)];
    let along = [(width, height), (height, width)];
    for (is_column, (length, lines)) in [false, true].into_iter().zip(along) {
        for first in (0..lines).step_by(lines.div_ceil(LINES).max(1)) {
            let count = averaged.min(lines - first);
            let level = |at: usize| {
                let beside = first..first + count;
                let levels = beside.map(|other| match is_column {
                    true => u32::from(view.at(other, at)),
                    false => u32::from(view.at(at, other)),
                });
                ((levels.sum::<u32>() + count as u32 / 2) / count as u32) as u8
            };
            let line = &mut line[..length];
            line.iter_mut().enumerate().for_each(|(at, pixel)| *pixel = level(at));
            add_widths(line, &mut widths);
        }
    }
    if widths.len() < MIN_EDGES {
        return None;
    }
    let rank = (widths.len() as f64 * NARROW) as usize;
    let (_, width, _) = widths.select_nth_unstable_by(rank, f32::total_cmp);
    Some(f64::from(*width))
}

/// Standard deviation of an image's noise, in grey levels, where most of it is even; more where it has texture.
fn noise(view: GrayView<'_>) -> f64 {
    let mut counts = [0usize; 1024];
    for y in (0..view.height()).step_by(view.height().div_ceil(LINES).max(1)) {
        for w in view.row(y).windows(3) {
            let second = i32::from(w[0]) - 2 * i32::from(w[1]) + i32::from(w[2]);
            counts[second.unsigned_abs() as usize] += 1;
        }
    }
    let half = counts.iter().sum::<usize>().div_ceil(2);
    let mut below = 0;
    let median = counts.iter().position(|count| {
        below += count;
        below >= half
    });
    median.unwrap_or(0) as f64 / SECOND_DIFFERENCE
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
    fn noise_hides_no_blur() {
        for ramp_px in [3.0, 5.0, 8.0, 12.0] {
            let mut image = bars(ramp_px, 180.0);
            let mut state = 7u32;
            let mut uniform = || {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                f64::from(state >> 8) / f64::from(1 << 24)
            };
            for pixel in image.pixels_mut() {
                // Twelve of them have a variance of 1.
                let normal = (0..12).map(|_| uniform()).sum::<f64>() - 6.0;
                *pixel = (f64::from(*pixel) + 8.0 * normal).round().clamp(0.0, 255.0) as u8;
            }
            let width = edge_width_px(image.view().unwrap()).unwrap();
            assert!((width / ramp_px - 1.0).abs() < 0.3, "{ramp_px}: {width}");
        }
    }

    #[test]
    fn an_image_without_contrast_has_no_focus_value() {
        assert_eq!(edge_width_px(bars(3.0, 30.0).view().unwrap()), None);
        assert_eq!(edge_width_px(GrayImage::filled(1, 1, 7).view().unwrap()), None);
        let mut noise = GrayImage::filled(320, 240, 100);
        for (i, pixel) in noise.pixels_mut().iter_mut().enumerate() {
            *pixel += ((i * 7919) % 31) as u8;
        }
        assert_eq!(edge_width_px(noise.view().unwrap()), None);
    }
}
