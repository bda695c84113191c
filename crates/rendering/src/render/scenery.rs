//! Makes the paintings of a scene: its pads, and painted marks that are not markers.

use geometry::{Marker as MarkerFrame, Ned, Point, Rotation, Transform};
use markers::{Ink, Shape};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::painting::{Area, BARE, Coat, Paint, Painting};
use crate::error::RenderError;
use crate::scene::{PAPER, PadInScene, Scene};

/// Reflectance of printer's ink.
const BLACK: f32 = 0.05;
/// Reflectance of the sides of a pad's box.
const SIDES: f32 = 0.3;

/// The painting of a pad: the box, its lid and its print.
pub(super) fn pad_painting(pad: &PadInScene) -> Result<Painting, RenderError> {
    let finite = |value: f64| value.is_finite() && value >= 0.0;
    if !(finite(pad.paper_m) && finite(pad.thickness_m) && pad.ned_from_marker.origin().is_finite())
    {
        return Err(RenderError::Setting(
            "a pad's marker has no size or no id, or its position is not finite",
        ));
    }
    let half_m = pad.paper_m / 2.0;
    let opaque = |area, light| Coat { area, paint: Paint { cover: 1.0, light }, within: None };
    let lid = Area::Rectangle([-half_m; 2], [half_m; 2]);
    let mut coats =
        vec![opaque(Area::Box, SIDES), Coat { within: Some(SIDES), ..opaque(lid, PAPER) }];
    for layer in &pad.drawing.layers {
        let area = match layer.shape {
            Shape::Disc { centre_m, radius_m } => Area::Disc { centre: centre_m, radius: radius_m },
            Shape::Rectangle { min_m, max_m } => Area::Rectangle(min_m, max_m),
        };
        let light = match layer.ink {
            Ink::Black => BLACK,
            Ink::White => PAPER,
        };
        coats.push(Coat { within: light_beneath(&area, &coats), ..opaque(area, light) });
    }
    Ok(Painting {
        ned_from_plane: pad.ned_from_marker,
        half_extent_m: half_m,
        thickness_m: pad.thickness_m,
        coats,
    })
}

/// The light of the one coat beneath a rectangle, so that adjacent rectangles join without a seam.
fn light_beneath(area: &Area, below: &[Coat]) -> Option<f32> {
    let Area::Rectangle(min, max) = area else { return None };
    // Coinciding edges differ by rounding.
    let slack = 1e-6 * (max[0] - min[0]).min(max[1] - min[1]);
    for coat in below.iter().rev() {
        let Area::Rectangle(low, high) = &coat.area else { return None };
        let apart = |i: usize| min[i] > high[i] - slack || max[i] < low[i] + slack;
        let inside = |i: usize| min[i] >= low[i] - slack && max[i] <= high[i] + slack;
        if inside(0) && inside(1) {
            return Some(coat.paint.light);
        }
        if !(apart(0) || apart(1)) {
            return None;
        }
    }
    None
}

/// Lines, discs and rings on the ground, at a distance from the pads.
pub(super) fn painted_marks(scene: &Scene, seed: u64) -> Vec<Painting> {
    const SPREAD_M: f64 = 5.0;
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x6d_6172_6b73);
    let about = scene.pads.first().map_or(Point::origin(), |pad| pad.ned_from_marker.origin());
    let mut marks = Vec::new();
    for _ in 0..scene.painted_marks {
        let paint = Paint { cover: 1.0, light: rng.random_range(0.35..0.7) };
        let light = if rng.random::<f64>() < 0.25 { Paint { light: 0.06, ..paint } } else { paint };
        let (kind, size_m): (u32, f64) = (rng.random_range(0..3), rng.random_range(0.05..0.5));
        let coat = |area, paint| Coat { area, paint, within: None };
        let disc = |radius| Area::Disc { centre: [0.0; 2], radius };
        let (half_extent_m, coats) = match kind {
            0 => {
                let half = [rng.random_range(0.02..0.08), 3.0 * size_m];
                (half[1], vec![coat(Area::Rectangle(half.map(|h| -h), half), light)])
            }
            1 => (size_m, vec![coat(disc(size_m), light)]),
            _ => {
                let inner = size_m * rng.random_range(0.4..0.9);
                (size_m, vec![coat(disc(size_m), light), coat(disc(inner), BARE)])
            }
        };
        let mut offset = || rng.random_range(-SPREAD_M..SPREAD_M);
        let place = Point::<Ned>::new(about.x() + offset(), about.y() + offset(), 0.0);
        let turn = rng.random_range(0.0..std::f64::consts::TAU);
        let near = |pad: &PadInScene| {
            let clear_m = half_extent_m * 1.5 + pad.paper_m;
            (pad.ned_from_marker.origin() - place).horizontal_norm() < clear_m
        };
        if !scene.pads.iter().any(near) {
            let up = Rotation::<Ned, MarkerFrame>::from_euler(std::f64::consts::PI, 0.0, turn);
            let ned_from_plane = Transform::new(up, place);
            marks.push(Painting { ned_from_plane, half_extent_m, thickness_m: 0.0, coats });
        }
    }
    marks
}
