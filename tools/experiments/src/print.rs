//! Models prints that are not sharp or not flat: a marker's drawing made of dots, or cut into flat pieces of a bent, folded or wavy
//! sheet.

use geometry::{Marker as MarkerFrame, Point, Rotation, Transform};
use markers::{Drawing, Ink, Layer, Shape};
use nalgebra::{Rotation3, UnitQuaternion, Vector3};
use rendering::PadInScene;

/// How a marker is printed. Lengths are in marker sizes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Print {
    /// Sharp and flat.
    Sharp,
    /// In square dots.
    Dots {
        /// Number of dots along the marker's size, rounded: a printer's file has them, so that size and position of the print
        /// are the marker's, and only the inside is a little off.
        per_size: f64,
    },
    /// On paper that is bent; its centre stays where it is.
    Bent(Bend),
}

/// How paper is bent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bend {
    /// Direction in which its height changes, in radians from the marker's x axis towards its y axis.
    pub towards: f64,
    /// Height at half a size from the centre.
    pub height: f64,
    /// The form.
    pub form: BendForm,
}

/// The form of bent paper.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BendForm {
    /// Curled like a roll.
    Curl,
    /// Folded at its centre.
    Fold,
    /// In waves, as cloth has.
    Waves,
}

/// Number of flat pieces along the edge of bent paper.
const PIECES: usize = 12;
/// Dots along the edge of each piece: finer than the image.
const DOTS: usize = 128;
/// The size of pieces over the distance between them: they overlap by more than the blur, so that nothing shows between them.
const OVERLAP: f64 = 1.5;

impl Bend {
    /// The height at a position along its direction, and its slope.
    fn at(&self, along: f64) -> (f64, f64) {
        let part = 2.0 * along;
        match self.form {
            BendForm::Curl => (self.height * part * part, 4.0 * self.height * part),
            BendForm::Fold => (self.height * part.abs(), 2.0 * self.height * part.signum()),
            BendForm::Waves => {
                // A wave and a half.
                let phase = 1.5 * std::f64::consts::PI * part;
                (self.height * phase.sin(), self.height * 3.0 * std::f64::consts::PI * phase.cos())
            }
        }
    }
}

impl Print {
    /// The flat pieces of which a printed pad consists.
    pub(crate) fn pieces(self, pad: PadInScene) -> Vec<PadInScene> {
        // The quiet zone is a part of the drawing's extent.
        let half_m = pad.drawing.half_extent_m;
        match self {
            Self::Sharp => vec![pad],
            Self::Dots { per_size } => {
                let (half_m, count) = dots(half_m, per_size);
                vec![PadInScene { drawing: dotted(&pad.drawing, [0.0; 2], half_m, count), ..pad }]
            }
            Self::Bent(bend) => {
                let place = |index: usize| half_m * ((2 * index + 1) as f64 / PIECES as f64 - 1.0);
                (0..PIECES * PIECES)
                    .map(|index| {
                        let centre = [place(index % PIECES), place(index / PIECES)];
                        piece(&pad, &bend, centre, half_m / PIECES as f64 * OVERLAP)
                    })
                    .collect()
            }
        }
    }
}

/// Half the edge and the number of dots along the edge of a square that covers a drawing, of which the marker has so many.
fn dots(half_m: f64, per_size: f64) -> (f64, usize) {
    let size_m = crate::set::SIZE_M;
    let inside = per_size.round().max(1.0);
    let dot_m = size_m / inside;
    let beyond = ((half_m - 0.5 * size_m) / dot_m).ceil().max(0.0);
    let count = inside + 2.0 * beyond;
    (0.5 * count * dot_m, count as usize)
}

/// The square piece about a position on a bent print.
fn piece(pad: &PadInScene, bend: &Bend, centre: [f64; 2], half_m: f64) -> PadInScene {
    let size_m = crate::set::SIZE_M;
    let (sin, cos) = bend.towards.sin_cos();
    let (height, slope) = bend.at((centre[0] * cos + centre[1] * sin) / size_m);
    // Rising along (cos, sin) is turning about the axis to the right of it.
    let axis = nalgebra::Unit::new_normalize(Vector3::new(sin, -cos, 0.0));
    let turn = Rotation3::from_axis_angle(&axis, slope.atan());
    let turned: Rotation<MarkerFrame, MarkerFrame> =
        Rotation::from_quaternion(UnitQuaternion::from_rotation_matrix(&turn));
    let on_paper: Transform<MarkerFrame, MarkerFrame> =
        Transform::new(turned, Point::new(centre[0], centre[1], height * size_m));
    PadInScene {
        drawing: dotted(&pad.drawing, centre, half_m, DOTS),
        ned_from_marker: pad.ned_from_marker * on_paper,
        paper_m: 2.0 * half_m,
        thickness_m: 0.0,
    }
}

/// A square of a drawing in `count` x `count` dots; each is of the ink at its centre.
fn dotted(drawing: &Drawing, centre: [f64; 2], half_m: f64, count: usize) -> Drawing {
    let dot_m = 2.0 * half_m / count as f64;
    let edge = |index: usize| -half_m + index as f64 * dot_m;
    let is_black = |x: usize, y: usize| {
        let at = |index: usize, axis: usize| centre[axis] + edge(index) + 0.5 * dot_m;
        x < count && drawing.ink_at(at(x, 0), at(y, 1)) == Ink::Black
    };
    let mut layers = Vec::new();
    for y in 0..count {
        let mut begin = None;
        for x in 0..=count {
            match (begin, is_black(x, y)) {
                (None, true) => begin = Some(x),
                (Some(from), false) => {
                    let (min_m, max_m) = ([edge(from), edge(y)], [edge(x), edge(y + 1)]);
                    layers
                        .push(Layer { shape: Shape::Rectangle { min_m, max_m }, ink: Ink::Black });
                    begin = None;
                }
                _ => {}
            }
        }
    }
    Drawing { half_extent_m: half_m, layers }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pad() -> PadInScene {
        let marker = format!("rings:{}", crate::set::SIZE_M).parse().unwrap();
        PadInScene::flat(marker, 1.0, 2.0, 0.3)
    }

    #[test]
    fn dots_have_the_ink_of_their_centre() {
        let pad = pad();
        let sharp = pad.drawing.clone();
        let [dotted] = Print::Dots { per_size: 40.3 }.pieces(pad).try_into().unwrap();
        let (half_m, count) = dots(sharp.half_extent_m, 40.3);
        let dot_m = 2.0 * half_m / count as f64;
        // The marker's edge is a dot's.
        assert!((crate::set::SIZE_M / dot_m - 40.0).abs() < 1e-9 && half_m >= sharp.half_extent_m);
        assert!((0.5 * crate::set::SIZE_M / dot_m + 0.5 * count as f64).fract().abs() < 1e-9);
        let centre = |index: usize| -half_m + (index as f64 + 0.5) * dot_m;
        for index in 0..count * count {
            let (x, y) = (centre(index % count), centre(index / count));
            assert_eq!(dotted.drawing.ink_at(x, y), sharp.ink_at(x, y), "{x} {y}");
        }
    }

    #[test]
    fn bent_paper_has_the_stated_height_and_its_centre_stays() {
        let flat = pad().ned_from_marker;
        for form in [BendForm::Curl, BendForm::Fold, BendForm::Waves] {
            let bend = Bend { towards: 0.7, height: 0.05, form };
            let pieces = Print::Bent(bend).pieces(pad());
            assert_eq!(pieces.len(), PIECES * PIECES);
            for piece in &pieces {
                let at = flat.inverse() * piece.ned_from_marker.origin();
                let along = (at.x() * 0.7f64.cos() + at.y() * 0.7f64.sin()) / crate::set::SIZE_M;
                let (height, slope) = bend.at(along);
                assert!((at.z() / crate::set::SIZE_M - height).abs() < 1e-9);
                // A step on the piece along the slope rises by it.
                let step = Point::new(1e-3 * 0.7f64.cos(), 1e-3 * 0.7f64.sin(), 0.0);
                let moved = flat.inverse() * (piece.ned_from_marker * step);
                let rise = (moved.z() - at.z()) / 1e-3;
                assert!((rise - slope.atan().sin()).abs() < 1e-6, "{rise} {slope}");
            }
            assert_eq!(bend.at(0.0).0, 0.0);
        }
        let curl = Bend { towards: 0.0, height: 0.05, form: BendForm::Curl };
        assert!((curl.at(0.5).0 - 0.05).abs() < 1e-12);
    }
}
