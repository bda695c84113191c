//! Measures the sides of a square in a drawing: a picture without noise and blur, where only pixels on edges are neither black
//! nor white. Such pixels show little of light and blur, but each side's position at once.

use geometry::Pixel;
use imaging::GrayView;

use crate::refine::fit::diagonals_crossing;

/// At most this part of the pixels along a side may not show it.
const MAX_HIDDEN: f64 = 0.25;
/// The part of a side at each end that is left out.
const END: f64 = 0.1;
/// Shortest side, in pixels.
const MIN_SIDE_PX: f64 = 20.0;
/// Pixels across a side on each side of where it is expected.
const REACH: usize = 3;
/// Largest number of grey pixels on an edge: a turned one crosses two, or three where it was resized twice.
const MAX_GREY: usize = 3;
/// Largest distance of a place from the side's line, in pixels: one drawn in whole pixels has steps.
const MAX_OFF_PX: f64 = 1.0;
/// Variance of a position in whole pixels, in square pixels.
const WHOLE_PIXEL_PX2: f64 = 1.0 / 12.0;
/// Standard deviation of a side that is measured by grey pixels, in pixels.
const SIDE_PX: f64 = 0.05;

/// A square's corners where its sides meet.
#[derive(Copy, Clone, Debug)]
pub(crate) struct DrawnSquare {
    pub(crate) corners: [Pixel; 4],
    /// Standard deviation of a corner along each axis, in pixels, which gives the square's place and size theirs.
    pub(crate) corner_px: f64,
}

/// The square of a drawing near these corners; `None` in any other picture. Its sides must be straight in the image.
pub(crate) fn drawn_square(view: GrayView<'_>, near: &[Pixel; 4]) -> Option<DrawnSquare> {
    let is_inside = |at: f64, size: usize| at >= 0.0 && at < size as f64;
    if !near.iter().all(|c| is_inside(c.x, view.width()) && is_inside(c.y, view.height())) {
        return None;
    }
    let [a, b, c, d] = *near;
    let top = Side::seen(view, a, b)?;
    let right = Side::seen(view, b, c)?;
    let bottom = Side::seen(view, c, d)?;
    let left = Side::seen(view, d, a)?;
    let meeting = |one: &Side, other: &Side| {
        let at = diagonals_crossing(&[one.from, other.from, one.to, other.to]);
        (at.x.is_finite() && at.y.is_finite()).then_some(at)
    };
    let corners = [
        meeting(&left, &top)?,
        meeting(&top, &right)?,
        meeting(&right, &bottom)?,
        meeting(&bottom, &left)?,
    ];
    // Edges that an earlier resizing made grey may be at whole pixels as well.
    let variance = |side: &Side| SIDE_PX * SIDE_PX + side.whole_pixel_px2;
    let side_px2 = [top, right, bottom, left].iter().map(variance).sum::<f64>() / 4.0;
    // Two corners share a side's error: as much as twice its variance in each of them alone.
    Some(DrawnSquare { corners, corner_px: (2.0 * side_px2).sqrt() })
}

/// A side of a square: its line, of two points.
#[derive(Copy, Clone, Debug)]
struct Side {
    from: Pixel,
    to: Pixel,
    /// Variance that whole pixels leave, in square pixels.
    whole_pixel_px2: f64,
}

impl Side {
    /// The side between two corners as its pixels show it.
    fn seen(view: GrayView<'_>, from: Pixel, to: Pixel) -> Option<Self> {
        let is_upright = (to.y - from.y).abs() > (to.x - from.x).abs();
        let swapped =
            |pixel: Pixel| if is_upright { [pixel.y, pixel.x] } else { [pixel.x, pixel.y] };
        let ([from, start], [to, end]) = (swapped(from), swapped(to));
        if (to - from).abs() < MIN_SIDE_PX {
            return None;
        }
        // All pixels along it: even steps might agree with those of whole pixels.
        let margin = END * (to - from).abs();
        let first = (from.min(to) + margin).ceil() as i64;
        let last = (from.max(to) - margin).floor() as i64;
        let count = (last - first + 1) as f64;
        let expected = |along: f64| start + (end - start) * (along - from) / (to - from);
        let middle = (first + last) as f64 / 2.0;
        let (mut seen, mut hidden) = (0.0, 0.0);
        let (mut x, mut y, mut xx, mut xy) = (0.0, 0.0, 0.0, 0.0);
        for along in first..=last {
            let along = along as f64;
            let Some(at) = crossing(view, is_upright, along, expected(along)) else {
                hidden += 1.0;
                if hidden > MAX_HIDDEN * count {
                    return None;
                }
                continue;
            };
            let (dx, dy) = (along - middle, at - start);
            seen += 1.0;
            x += dx;
            y += dy;
            xx += dx * dx;
            xy += dx * dy;
        }
        let slope = (xy - x * y / seen) / (xx - x * x / seen);
        let (middle, at) = (middle + x / seen, start + y / seen);
        let is_line = (first..=last).all(|along| {
            let along = along as f64;
            let seen = crossing(view, is_upright, along, expected(along));
            seen.is_none_or(|seen| (seen - at - slope * (along - middle)).abs() <= MAX_OFF_PX)
        });
        let point = |along: f64| {
            let across = at + slope * (along - middle);
            if is_upright { Pixel::new(across, along) } else { Pixel::new(along, across) }
        };
        is_line.then(|| Self {
            from: point(from),
            to: point(to),
            whole_pixel_px2: whole_pixel_px2(slope, (to - from).abs(), seen),
        })
    }
}

/// Variance of the place of a line that is drawn in whole pixels and seen in so many columns, in square pixels. Their errors cancel, but
/// for slopes by which they come again after one column, two or three.
fn whole_pixel_px2(slope: f64, length_px: f64, seen: f64) -> f64 {
    let kept = |[columns, rows]: [f64; 2]| {
        let steps = 1.0 + (columns * slope.abs() - rows).abs() * length_px;
        1.0 / (columns * columns * steps)
    };
    let again = [[1.0, 0.0], [1.0, 1.0], [2.0, 1.0], [3.0, 1.0], [3.0, 2.0]];
    WHOLE_PIXEL_PX2 * again.map(kept).into_iter().fold(1.0 / seen, f64::max)
}

/// Where a column of pixels crosses the edge near `expected`, or a row an upright one.
fn crossing(view: GrayView<'_>, is_upright: bool, along: f64, expected: f64) -> Option<f64> {
    let [length, lines] =
        if is_upright { [view.width(), view.height()] } else { [view.height(), view.width()] };
    let first = expected.round() - REACH as f64;
    let last = first + (2 * REACH) as f64;
    let is_inside = first >= 0.0 && last < length as f64 && along >= 0.0 && along < lines as f64;
    if !is_inside {
        return None;
    }
    let (start, line) = (first as usize, along as usize);
    let greys: [u8; 2 * REACH + 1] = std::array::from_fn(|k| {
        if is_upright { view.at(start + k, line) } else { view.at(line, start + k) }
    });
    let [begin, end] = [*greys.first()?, *greys.last()?];
    if !matches!([begin, end], [0, 255] | [255, 0]) {
        return None;
    }
    let before = greys.iter().take_while(|grey| **grey == begin).count();
    let after = greys.iter().rev().take_while(|grey| **grey == end).count();
    let between = greys.get(before..greys.len() - after)?;
    let is_drawn = between.len() <= MAX_GREY && between.iter().all(|grey| (1..255).contains(grey));
    let like_first = |grey: &u8| f64::from(begin.abs_diff(*grey).abs_diff(255)) / 255.0;
    let covered = before as f64 + between.iter().map(like_first).sum::<f64>();
    is_drawn.then_some(first - 0.5 + covered)
}

#[cfg(test)]
mod tests {
    use super::*;
    use imaging::GrayImage;

    /// A black square on white, of which each pixel shows the covered fraction.
    fn square([left, top]: [f64; 2], [right, bottom]: [f64; 2]) -> GrayImage {
        let mut image = GrayImage::filled(60, 60, 0);
        let covered = |from: f64, to: f64, at: usize| {
            let at = at as f64;
            (to.min(at + 0.5) - from.max(at - 0.5)).clamp(0.0, 1.0)
        };
        for y in 0..60 {
            for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
                let black = covered(left, right, x) * covered(top, bottom, y);
                *pixel = (255.0 * (1.0 - black)).round() as u8;
            }
        }
        image
    }

    fn seen(image: &GrayImage) -> Option<DrawnSquare> {
        let near = [[11.3, 10.2], [45.4, 9.8], [45.0, 46.1], [10.1, 45.2]];
        drawn_square(image.view().unwrap(), &near.map(|[x, y]| Pixel::new(x, y)))
    }

    #[test]
    fn grey_pixels_give_the_position_of_a_side() {
        let found = seen(&square([10.3, 9.8], [45.1, 46.4])).unwrap();
        let truth = [[10.3, 9.8], [45.1, 9.8], [45.1, 46.4], [10.3, 46.4]];
        for (corner, [x, y]) in found.corners.iter().zip(truth) {
            assert!(corner.distance(&Pixel::new(x, y)) < 0.01, "{corner:?}");
        }
        // Each side may be drawn at whole pixels.
        assert!((found.corner_px - 0.414).abs() < 1e-3, "{}", found.corner_px);
    }

    #[test]
    fn whole_pixels_widen_the_covariance_of_sides_along_them_and_at_45_degrees() {
        let sigma_px = |slope: f64| whole_pixel_px2(slope, 100.0, 80.0).sqrt();
        assert!((sigma_px(0.0) - 0.2887).abs() < 1e-3 && (sigma_px(-1.0) - 0.2887).abs() < 1e-3);
        assert!((sigma_px(0.5) - 0.1443).abs() < 1e-3);
        assert!(sigma_px(0.2) < 0.07 && sigma_px(-0.7) < 0.06);
    }

    #[test]
    fn no_other_picture_is_a_drawing() {
        let mut image = square([10.3, 9.8], [45.1, 46.4]);
        for y in 0..60 {
            for pixel in image.row_mut(y) {
                *pixel = (*pixel).max(1);
            }
        }
        assert!(seen(&image).is_none());
        assert!(seen(&GrayImage::filled(60, 60, 255)).is_none());
        // A side that is bent by more than whole pixels do.
        let mut image = square([10.5, 9.5], [45.5, 45.5]);
        for y in 20..36 {
            image.row_mut(y)[8..11].fill(0);
        }
        assert!(seen(&image).is_none());
    }
}
