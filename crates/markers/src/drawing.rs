//! What a marker looks like: shapes painted one over the other, in the marker's plane.
//!
//! A family's drawing is that of its reference: the bitmaps of AprilTag and OpenCV cell by cell (white where AprilTag's
//! pictures are transparent), STag as its marker generator paints it, without the id in letters. One description
//! serves the printer (SVG, PDF, PNG), the simulator's camera and the tests.

use crate::marker::{Family, Marker};
use crate::square::code::Code;
use crate::square::codebook;

mod cover;
mod square;
mod stag;

/// What a shape is painted with.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Ink {
    /// No light comes back.
    Black,
    /// All light comes back.
    White,
}

/// A shape in the marker's plane: x right, y up, origin at the marker's centre, in metres.
#[derive(Copy, Clone, Debug, PartialEq)]
pub enum Shape {
    /// A filled circle.
    Disc {
        /// Its centre.
        centre_m: [f64; 2],
        /// Its radius.
        radius_m: f64,
    },
    /// A filled, upright rectangle.
    Rectangle {
        /// Its bottom left corner.
        min_m: [f64; 2],
        /// Its top right corner.
        max_m: [f64; 2],
    },
}

/// A shape and its ink.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Layer {
    /// The shape.
    pub shape: Shape,
    /// Its ink.
    pub ink: Ink,
}

/// A marker as layers on paper; later layers hide earlier ones. Around and under them the paper is white.
#[derive(Clone, Debug, PartialEq)]
pub struct Drawing {
    /// Half the edge of the square the layers and their quiet zone need, in metres.
    pub half_extent_m: f64,
    /// The layers, bottom first.
    pub layers: Vec<Layer>,
}

/// Inner and outer radius of the three rings, outer ring first, in units of `x`, the inner radius of the
/// innermost ring (Table 3.1). The marker's size is twice the outermost radius.
pub const RING_RADII: [(f64, f64); 3] = [(40.0, 50.0), (15.0, 25.0), (1.0, 3.0)];

impl Drawing {
    /// The drawing of `marker` at `size_m`, whatever size the marker itself states; `None` without an id that the family
    /// has.
    pub fn new(marker: &Marker, size_m: f64) -> Option<Self> {
        match (marker.family, marker.id) {
            (Family::Rings | Family::RingsThesis, _) => Some(rings(size_m)),
            (family, Some(id)) => {
                let word = *codebook::words(family).get(id as usize)?;
                Some(match Code::of(family) {
                    Some(code) => square::drawing(code, word, size_m),
                    None => stag::drawing(word, size_m),
                })
            }
            (_, None) => None,
        }
    }

    /// Ink at a place in the marker's plane (metres, x right, y up).
    pub fn ink_at(&self, x_m: f64, y_m: f64) -> Ink {
        let covers = |layer: &&Layer| match layer.shape {
            Shape::Disc { centre_m: [x, y], radius_m } => (x_m - x).hypot(y_m - y) <= radius_m,
            Shape::Rectangle { min_m, max_m } => {
                (min_m[0]..=max_m[0]).contains(&x_m) && (min_m[1]..=max_m[1]).contains(&y_m)
            }
        };
        self.layers.iter().rev().find(covers).map_or(Ink::White, |layer| layer.ink)
    }
}

fn rings(size_m: f64) -> Drawing {
    let unit_m = size_m / (2.0 * RING_RADII[0].1);
    let disc = |radius: f64, ink| Layer {
        shape: Shape::Disc { centre_m: [0.0; 2], radius_m: radius * unit_m },
        ink,
    };
    let layers = RING_RADII
        .iter()
        .flat_map(|&(inner, outer)| [disc(outer, Ink::Black), disc(inner, Ink::White)])
        .collect();
    // A ring's width of white all round keeps the outer edge an edge on dark ground.
    Drawing { half_extent_m: 60.0 * unit_m, layers }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rings_are_where_table_3_1_puts_them() {
        let marker = "rings".parse().unwrap();
        let drawing = Drawing::new(&marker, 1.0).unwrap();
        let inks: Vec<_> =
            [0.005, 0.02, 0.09, 0.2, 0.3, 0.45, 0.55].map(|r| drawing.ink_at(0.0, r)).into();
        use Ink::{Black, White};
        assert_eq!(inks, [White, Black, White, Black, White, Black, White]);
    }
}
