//! Draws a marker as layers of shapes in the marker's plane.
//!
//! A family's drawing is that of its reference implementation: the bitmaps of AprilTag and OpenCV cell by cell (white
//! where AprilTag's pictures are transparent), STag as its marker generator paints it, without the id in letters.
//! Printing (SVG, PDF, PNG), the simulated camera and the tests use this one description.

use crate::marker::{Family, Marker};
use crate::ring_design::RING_RADII;
use crate::square_code::SquareCode;
use crate::tables;

mod cover;
mod square;
mod stag;

/// The colour of a shape.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Ink {
    /// Reflects no light.
    Black,
    /// Reflects all light.
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

/// A marker as layers on white paper; later layers hide earlier ones.
#[derive(Clone, Debug, PartialEq)]
pub struct Drawing {
    /// Half the edge of the square that the layers and their quiet zone fill, in metres.
    pub half_extent_m: f64,
    /// The layers, bottom first.
    pub layers: Vec<Layer>,
}

impl Marker {
    /// Whether the print of two markers of one size is the same, also under two names: small ArUco dictionaries are the
    /// beginnings of large ones.
    pub fn looks_like(&self, other: &Self) -> bool {
        let drawing = |marker: &Self| Drawing::new(marker, 1.0);
        match self.family == other.family {
            true => self.id == other.id,
            false => drawing(self).is_some_and(|it| Some(it) == drawing(other)),
        }
    }
}

impl Drawing {
    /// The drawing of `marker` at `size_m`, independent of the size that the marker itself states; `None` when the family has
    /// ids and this is none of them.
    pub fn new(marker: &Marker, size_m: f64) -> Option<Self> {
        match (marker.family, marker.id) {
            (Family::Rings | Family::RingsThesis, _) => Some(rings(size_m)),
            (family, Some(id)) => {
                let codeword = *tables::codewords(family).get(id as usize)?;
                Some(match SquareCode::for_family(family) {
                    Some(code) => square::drawing(code, codeword, size_m),
                    None => stag::drawing(codeword, size_m),
                })
            }
            (_, None) => None,
        }
    }

    /// Ink at a point of the marker's plane (metres, x right, y up).
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
