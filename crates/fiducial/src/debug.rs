//! The thesis' three debug images: valid ellipses, rings, and the marker with the alignment circle.

use std::f64::consts::PI;

use geometry::Pixel;
use imaging::{Ellipse, GrayView};

use crate::ring::RingKind;
use crate::trace::Trace;

/// A colour image, three bytes (red, green, blue) a pixel, row by row.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RgbImageBuf {
    /// The pixels.
    pub data: Vec<u8>,
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
}

/// Radius of the thesis' alignment circle, in pixels.
pub const ALIGNMENT_RADIUS_PX: f64 = 300.0;

type Colour = [u8; 3];
const GREEN: Colour = [0, 220, 60];
const RED: Colour = [235, 40, 40];
const ORANGE: Colour = [255, 150, 0];
const BLUE: Colour = [40, 120, 255];

/// The image with the ellipses that passed the ellipse filter.
pub fn draw_ellipses(view: GrayView<'_>, trace: &Trace, out: &mut RgbImageBuf) {
    out.copy(view);
    for ellipse in &trace.ellipses {
        out.ellipse(ellipse, GREEN);
    }
}

/// The image with the rings by kind (outer red, middle orange, inner blue), inner and outer edge each.
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
}

/// The image with the markers found, and the circle about its middle within which the thesis takes the marker as
/// aligned.
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
        out.circle([x, y], marker.size_px / 2.0, GREEN);
        for offset in -10..=10 {
            out.dot(x + f64::from(offset), y, RED);
            out.dot(x, y + f64::from(offset), RED);
        }
    }
}

impl RgbImageBuf {
    fn copy(&mut self, view: GrayView<'_>) {
        (self.width, self.height) = (view.width(), view.height());
        self.data.clear();
        for y in 0..view.height() {
            self.data.extend(view.row(y).iter().flat_map(|grey| [*grey; 3]));
        }
    }

    fn circle(&mut self, centre: [f64; 2], radius: f64, colour: Colour) {
        let size = 2.0 * radius;
        self.ellipse(&Ellipse { centre, minor: size, major: size, angle: 0.0 }, colour);
    }

    fn ellipse(&mut self, ellipse: &Ellipse, colour: Colour) {
        // Two dots a pixel leave no gap; an ellipse far larger than the image needs no more than this many.
        let dots = (2.0 * PI * ellipse.major).clamp(8.0, 20_000.0) as u32;
        for i in 0..dots {
            let [x, y] = ellipse.at(f64::from(i) * 2.0 * PI / f64::from(dots));
            self.dot(x, y, colour);
        }
    }

    fn dot(&mut self, x: f64, y: f64, colour: Colour) {
        let (x, y) = (x.round(), y.round());
        if !(x >= 0.0 && y >= 0.0 && x < self.width as f64 && y < self.height as f64) {
            return;
        }
        let start = (y as usize * self.width + x as usize) * 3;
        if let Some(pixel) = self.data.get_mut(start..start + 3) {
            pixel.copy_from_slice(&colour);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::TracedMarker;

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
    fn marks_beyond_the_image_are_left_out() {
        let view = GrayView::packed(&[1], 1, 1).unwrap();
        let mut trace = Trace::default();
        for size_px in [1.0, 1e9, f64::NAN, f64::INFINITY] {
            trace.markers.push(TracedMarker { centre: Pixel::new(-1e12, f64::NAN), size_px });
        }
        let mut out = RgbImageBuf::default();
        draw_target(view, &trace, ALIGNMENT_RADIUS_PX, &mut out);
        assert_eq!(out.data, [1, 1, 1]);
    }
}
