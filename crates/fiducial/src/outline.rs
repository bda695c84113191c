//! Which contours are ellipses, whole or cut by the image's border.

use std::f64::consts::PI;

use imaging::{Contour, Ellipse, GrayView, contour_area, contour_length, fit_ellipse};

/// Outlines that enclose fewer square pixels say nothing about their shape.
const LEAST_AREA_PX2: f64 = 18.0;

/// An ellipse, and whether black lies within it.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Outline {
    pub(crate) ellipse: Ellipse,
    pub(crate) black_within: bool,
}

/// Adds the ellipse that a contour of dark regions is, or those of which it shows arcs.
pub(crate) fn add_outlines(
    contour: &Contour<'_>,
    view: &GrayView<'_>,
    outlines: &mut Vec<Outline>,
) {
    match ellipse_of(contour.points, contour.hole) {
        Some(ellipse) => outlines.push(Outline { ellipse, black_within: !contour.hole }),
        None => arcs_of(contour.points, view, outlines),
    }
}

/// The ellipse that a contour is, on the edge itself (Algorithm 1). Contours run along dark pixels, half a pixel
/// inside of dark regions and half a pixel outside of bright ones.
fn ellipse_of(points: &[[i32; 2]], hole: bool) -> Option<Ellipse> {
    let area = contour_area(points);
    let length = contour_length(points);
    // Cheap first: an ellipse three times as long as wide has 0.65 of a circle's area per squared length, and a
    // contour along pixels is up to a tenth longer than its curve.
    if area < LEAST_AREA_PX2 || 4.0 * PI * area < 0.5 * length * length {
        return None;
    }
    let ellipse = fit_ellipse(points.iter().map(|p| p.map(f64::from)))?;
    // A pixel more or less all round is half the area of a small one.
    let tolerance = 0.05 + 0.35 * length / area / 2.0;
    let fits = (area / ellipse.area() - 1.0).abs() <= tolerance;
    let on_edge = ellipse.grown(if hole { -1.0 } else { 1.0 });
    (fits && on_edge.minor > 1.0 && ellipse.minor > 0.2 * ellipse.major).then_some(on_edge)
}

/// The ellipses of which a contour shows arcs between places where the image ends. A ring that the image's border
/// cuts is one region whose contour is both its edges, the outer and, turning the other way, the inner one.
fn arcs_of(points: &[[i32; 2]], view: &GrayView<'_>, outlines: &mut Vec<Outline>) {
    const LEAST_POINTS: usize = 16;
    let (right, bottom) = (view.width() as i32 - 1, view.height() as i32 - 1);
    let ends = |[x, y]: &[i32; 2]| *x <= 0 || *y <= 0 || *x >= right || *y >= bottom;
    if points.len() < LEAST_POINTS {
        return;
    }
    // Few contours reach the image's border; all corners at once is the fastest way to see that.
    let far = points.iter().fold([i32::MAX, i32::MAX, 0, 0], |[a, b, c, d], [x, y]| {
        [a.min(*x), b.min(*y), c.max(*x), d.max(*y)]
    });
    if !ends(&[far[0], far[1]]) && !ends(&[far[2], far[3]]) {
        return;
    }
    let Some(first) = points.iter().position(ends) else { return };
    let mut start = first;
    // Once round, from an end to the next.
    while start < first + points.len() {
        let onwards = points.iter().cycle().skip(start + 1);
        let length = onwards.take(points.len()).take_while(|p| !ends(p)).count();
        if length >= LEAST_POINTS {
            let arc = points.iter().cycle().skip(start + 1).take(length);
            outlines.extend(outline_of_arc(arc.map(|p| p.map(f64::from))));
        }
        start += length + 1;
    }
}

/// The ellipse of an arc, if it is one and goes far enough round.
fn outline_of_arc<I>(arc: I) -> Option<Outline>
where
    I: Iterator<Item = [f64; 2]> + Clone,
{
    const LEAST_TURN: f64 = 1.7;
    const MOST_RMS_PX: f64 = 0.8;
    let ellipse = fit_ellipse(arc.clone())?;
    let off_px = |point: [f64; 2]| (ellipse.radius_of(point) - 1.0) * ellipse.minor / 2.0;
    // A few points of a long border are enough to see that it is none.
    let few = arc.clone().step_by(1 + arc.clone().count() / 24);
    let (squares, count) = few.fold((0.0, 0.0), |(s, n), p| (s + off_px(p).powi(2), n + 1.0));
    if squares > MOST_RMS_PX * MOST_RMS_PX * count || ellipse.minor < 0.3 * ellipse.major {
        return None;
    }
    let [cx, cy] = ellipse.centre;
    let mut turn = 0.0;
    for ([x, y], [next_x, next_y]) in arc.clone().zip(arc.skip(1)) {
        let (a, b) = ([x - cx, y - cy], [next_x - cx, next_y - cy]);
        turn += (a[0] * b[1] - a[1] * b[0]).atan2(a[0] * b[0] + a[1] * b[1]);
    }
    // An outer border runs counter-clockwise on screen, which is a negative turn as y points down; a hole's does not.
    let black_within = turn < 0.0;
    let on_edge = ellipse.grown(if black_within { 1.0 } else { -1.0 });
    (turn.abs() >= LEAST_TURN && ellipse.minor > 12.0)
        .then_some(Outline { ellipse: on_edge, black_within })
}
