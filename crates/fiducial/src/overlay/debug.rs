//! Draws debug images: the three of the thesis (valid ellipses, rings, the marker with the alignment circle), and the quads.

use geometry::Pixel;
use imaging::GrayView;
use markers::RingKind;

use crate::overlay::canvas::{Colour, RgbImageBuf};
use crate::trace::{Candidate, Trace};

/// Radius of the thesis' alignment circle, in pixels.
pub const ALIGNMENT_RADIUS_PX: f64 = 300.0;

const GREEN: Colour = [0, 220, 60];
const RED: Colour = [235, 40, 40];
const ORANGE: Colour = [255, 150, 0];
const BLUE: Colour = [40, 120, 255];
const YELLOW: Colour = [255, 230, 60];
const MAGENTA: Colour = [230, 80, 230];

/// The image with the ellipses that passed the ellipse filter.
pub fn draw_ellipses(view: GrayView<'_>, trace: &Trace, out: &mut RgbImageBuf) {
    out.copy(view);
    for ellipse in &trace.ellipses {
        out.ellipse(ellipse, GREEN);
    }
}

/// The image with the rings by kind (outer red, middle orange, inner blue), inner and outer edge each, and those that
/// were refused (magenta) with the reason.
pub fn draw_rings(view: GrayView<'_>, trace: &Trace, out: &mut RgbImageBuf) {
    out.copy(view);
    for ring in &trace.rings {
        let colour = match ring.kind {
            RingKind::Outer => RED,
            RingKind::Middle => ORANGE,
            RingKind::Inner => BLUE,
        };
        out.ellipse(&ring.inner, colour);
        out.ellipse(&ring.outer, colour);
    }
    for refusal in &trace.refusals {
        if let Candidate::Ring(edges) = refusal.candidate {
            for edge in &edges {
                out.ellipse(edge, MAGENTA);
            }
            let [x, y] = edges[0].centre;
            let below = edges.iter().map(|edge| edge.major / 2.0).fold(0.0, f64::max);
            label(out, [x, y + below], refusal.reason.name(), YELLOW);
        }
    }
}

/// The image with the quads: those whose code was read (green), those that were refused (magenta) with the reason.
pub fn draw_squares(view: GrayView<'_>, trace: &Trace, out: &mut RgbImageBuf) {
    out.copy(view);
    for refusal in &trace.refusals {
        if let Candidate::Quad(corners) = refusal.candidate {
            out.polygon(&corners.map(point), 1.0, MAGENTA);
            label(out, below(&corners), refusal.reason.name(), YELLOW);
        }
    }
    for corners in &trace.quads {
        out.polygon(&corners.map(point), 1.0, GREEN);
    }
}

/// The image with the markers, and the circle around its middle within which the thesis takes the marker as aligned.
pub fn draw_target(
    view: GrayView<'_>,
    trace: &Trace,
    alignment_radius_px: f64,
    out: &mut RgbImageBuf,
) {
    out.copy(view);
    let middle = [(view.width() as f64 - 1.0) / 2.0, (view.height() as f64 - 1.0) / 2.0];
    out.circle(middle, alignment_radius_px, BLUE);
    for marker in &trace.markers {
        let Pixel { x, y } = marker.centre;
        match marker.corners {
            Some(corners) => out.polygon(&corners.map(point), 1.0, GREEN),
            None => out.circle([x, y], marker.size_px / 2.0, GREEN),
        }
        out.line([x - 10.0, y], [x + 10.0, y], 1.0, RED);
        out.line([x, y - 10.0], [x, y + 10.0], 1.0, RED);
    }
}

fn point(pixel: Pixel) -> [f64; 2] {
    [pixel.x, pixel.y]
}

/// A point under a quad.
fn below(corners: &[Pixel; 4]) -> [f64; 2] {
    let x = corners.iter().map(|c| c.x).sum::<f64>() / 4.0;
    [x, corners.iter().map(|c| c.y).fold(f64::NEG_INFINITY, f64::max)]
}

/// A word centred under a point.
fn label(out: &mut RgbImageBuf, [x, y]: [f64; 2], word: &str, colour: Colour) {
    out.text([x - 3.0 * word.len() as f64, y + 2.0], word, 1, colour);
}

#[cfg(test)]
mod tests {
    use geometry::Roi;
    use imaging::Ellipse;

    use super::*;
    use crate::trace::{Reason, TracedMarker};

    #[test]
    fn marks_are_drawn_where_they_are_and_nowhere_else() {
        let data = vec![7; 100 * 80];
        let view = GrayView::packed(&data, 100, 80).unwrap();
        let mut trace = Trace::default();
        let mut out = RgbImageBuf::default();
        draw_ellipses(view, &trace, &mut out);
        assert!(out.data.len() == 100 * 80 * 3 && out.data.iter().all(|b| *b == 7));
        let ellipse = Ellipse { centre: [50.0, 40.0], minor: 20.0, major: 40.0, angle: 0.0 };
        trace.ellipses.push(ellipse);
        draw_ellipses(view, &trace, &mut out);
        let at = |x: usize, y: usize| &out.data[(y * 100 + x) * 3..][..3];
        assert_eq!((at(60, 40), at(50, 20), at(50, 40)), (&GREEN[..], &GREEN[..], &[7, 7, 7][..]));
    }

    #[test]
    fn refused_squares_are_marked_with_their_reason() {
        let data = vec![200; 100 * 80];
        let view = GrayView::packed(&data, 100, 80).unwrap();
        let square = |x: f64| {
            [(x, 10.0), (x + 20.0, 10.0), (x + 20.0, 30.0), (x, 30.0)]
                .map(|(x, y)| Pixel::new(x, y))
        };
        let mut part = Trace::default();
        part.refuse_quad(square(10.0), Reason::Border);
        part.accept_quad(square(60.0));
        let mut trace = Trace::default();
        trace.add_roi(&part, &Roi::cropped(5.0, 2.0, 95, 78));
        let mut out = RgbImageBuf::default();
        draw_squares(view, &trace, &mut out);
        let at = |x: usize, y: usize| &out.data[(y * 100 + x) * 3..][..3];
        assert_eq!((at(15, 20), at(65, 20), at(50, 20)), (&MAGENTA[..], &GREEN[..], &[200; 3][..]));
        let letters = (0..100 * 80).filter(|i| out.data[i * 3..][..3] == YELLOW).count();
        assert!(letters > 50, "{letters}");
    }

    #[test]
    fn marks_outside_the_image_are_clipped() {
        let view = GrayView::packed(&[1], 1, 1).unwrap();
        let mut trace = Trace::default();
        for size_px in [1.0, 1e9, f64::NAN, f64::INFINITY] {
            let centre = Pixel::new(-1e12, f64::NAN);
            trace.markers.push(TracedMarker { centre, size_px, corners: Some([centre; 4]) });
        }
        let mut out = RgbImageBuf::default();
        draw_target(view, &trace, ALIGNMENT_RADIUS_PX, &mut out);
        assert_eq!(out.data, [1, 1, 1]);
    }
}
