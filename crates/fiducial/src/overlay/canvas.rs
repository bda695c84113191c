//! Provides a colour image on which marks are drawn.

use std::f64::consts::PI;

use imaging::{Ellipse, GrayView};

use crate::overlay::font;

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

/// Red, green and blue.
pub type Colour = [u8; 3];

/// Distance from one letter to the next, in dots.
const ADVANCE: f64 = 6.0;
/// Distance from one line to the next, in dots.
pub const LINE: f64 = 9.0;
/// Largest number of dots of an ellipse or a line, for those far larger than the image.
const MAX_DOTS: f64 = 40_000.0;

impl RgbImageBuf {
    /// Becomes a copy of a grey image.
    pub fn copy(&mut self, view: GrayView<'_>) {
        (self.width, self.height) = (view.width(), view.height());
        self.data.clear();
        for y in 0..view.height() {
            self.data.extend(view.row(y).iter().flat_map(|grey| [*grey; 3]));
        }
    }

    /// Draws a circle.
    pub fn circle(&mut self, centre: [f64; 2], radius: f64, colour: Colour) {
        let size = 2.0 * radius;
        self.ellipse(&Ellipse { centre, minor: size, major: size, angle: 0.0 }, colour);
    }

    /// Draws an ellipse.
    pub fn ellipse(&mut self, ellipse: &Ellipse, colour: Colour) {
        // Two dots a pixel leave no gap.
        let dots = (2.0 * PI * ellipse.major).clamp(8.0, MAX_DOTS) as u32;
        for i in 0..dots {
            let [x, y] = ellipse.at(f64::from(i) * 2.0 * PI / f64::from(dots));
            self.dot(x, y, colour);
        }
    }

    /// Draws a straight line, `width_px` wide.
    pub fn line(&mut self, from: [f64; 2], to: [f64; 2], width_px: f64, colour: Colour) {
        let step = [to[0] - from[0], to[1] - from[1]];
        let length = step[0].hypot(step[1]);
        let dots = (2.0 * length).clamp(1.0, MAX_DOTS) as u32;
        let across = [-step[1] / length.max(1e-9), step[0] / length.max(1e-9)];
        let strands = (2.0 * width_px - 1.0).clamp(1.0, 32.0) as u32;
        for strand in 0..strands {
            let aside = (f64::from(strand) - f64::from(strands - 1) / 2.0) / 2.0;
            let start = [from[0] + aside * across[0], from[1] + aside * across[1]];
            for i in 0..=dots {
                let part = f64::from(i) / f64::from(dots);
                self.dot(start[0] + part * step[0], start[1] + part * step[1], colour);
            }
        }
    }

    /// Draws a closed line through points.
    pub fn polygon(&mut self, points: &[[f64; 2]], width_px: f64, colour: Colour) {
        for (from, to) in points.iter().zip(points.iter().cycle().skip(1)) {
            self.line(*from, *to, width_px, colour);
        }
    }

    /// Writes a line of text on a dark ground, its top-left corner at `at`, moved into the image as far as it fits. A dot of
    /// a letter is `dot_px` wide.
    pub fn text(&mut self, at: [f64; 2], text: &str, dot_px: usize, colour: Colour) {
        let dot = dot_px.clamp(1, 64) as f64;
        let size = [(text.chars().count() as f64 * ADVANCE + 1.0) * dot, LINE * dot];
        let [left, top] = [0, 1].map(|axis| {
            let room = [self.width, self.height][axis] as f64 - size[axis];
            at[axis].min(room).max(0.0).round()
        });
        self.fill([left, top], size, |pixel| *pixel /= 4);
        for (index, letter) in (0..).zip(text.chars()) {
            for (row, bits) in (0..).zip(font::rows(letter)) {
                for column in (0..5).filter(|column| bits >> (4 - column) & 1 == 1) {
                    let x = left + (1.0 + f64::from(index) * ADVANCE + f64::from(column)) * dot;
                    let y = top + (1.0 + f64::from(row)) * dot;
                    self.square([x, y], dot, colour);
                }
            }
        }
    }

    /// Sets the pixel nearest to a point, if it is in the image.
    pub fn dot(&mut self, x: f64, y: f64, colour: Colour) {
        let (x, y) = (x.round(), y.round());
        if !(x >= 0.0 && y >= 0.0 && x < self.width as f64 && y < self.height as f64) {
            return;
        }
        let start = (y as usize * self.width + x as usize) * 3;
        if let Some(pixel) = self.data.get_mut(start..start + 3) {
            pixel.copy_from_slice(&colour);
        }
    }

    fn square(&mut self, [left, top]: [f64; 2], edge: f64, colour: Colour) {
        for y in 0..edge as u32 {
            for x in 0..edge as u32 {
                self.dot(left + f64::from(x), top + f64::from(y), colour);
            }
        }
    }

    /// Changes all values in a rectangle that lies in the image or beyond its right and lower border.
    fn fill(&mut self, [left, top]: [f64; 2], [width, height]: [f64; 2], change: fn(&mut u8)) {
        let columns = (left as usize).min(self.width)..((left + width) as usize).min(self.width);
        for y in top as usize..((top + height) as usize).min(self.height) {
            let row = y * self.width * 3;
            if let Some(bytes) = self.data.get_mut(row + columns.start * 3..row + columns.end * 3) {
                bytes.iter_mut().for_each(change);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grey(width: usize, height: usize) -> RgbImageBuf {
        RgbImageBuf { data: vec![100; width * height * 3], width, height }
    }

    #[test]
    fn lines_and_letters_are_where_they_should_be() {
        let mut canvas = grey(40, 20);
        canvas.line([2.0, 15.0], [12.0, 15.0], 1.0, [1, 2, 3]);
        canvas.text([0.0, 0.0], "I", 1, [9, 9, 9]);
        let at = |x: usize, y: usize| canvas.data[(y * 40 + x) * 3];
        assert_eq!(
            (at(1, 15), at(2, 15), at(12, 15), at(13, 15), at(2, 16)),
            (100, 1, 1, 100, 100)
        );
        // The letter's upper bar and stem on their dark ground.
        assert_eq!((at(2, 1), at(3, 3), at(2, 3), at(0, 0), at(7, 0)), (9, 9, 25, 25, 100));
    }

    #[test]
    fn nothing_is_drawn_outside_of_the_image() {
        for (width, height) in [(0, 0), (1, 1), (7, 3)] {
            let mut canvas = grey(width, height);
            for far in [1e300, f64::NAN, f64::INFINITY, -1e12, 3.0] {
                canvas.line([far, 0.0], [-far, far], far, [0; 3]);
                canvas.circle([far, far], far, [0; 3]);
                canvas.text([far, far], "a label", 1000, [0; 3]);
                canvas.polygon(&[[far, far]], 1.0, [0; 3]);
            }
            assert_eq!(canvas.data.len(), width * height * 3);
        }
    }
}
