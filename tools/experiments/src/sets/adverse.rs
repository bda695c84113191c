//! Frames of markers under one adverse condition each: shadow, glare, occlusion, haze, noise, defocus,
//! inverted colours, cut by the frame.

use std::f64::consts::{FRAC_PI_4, TAU};

use geometry::{Pixel, Point};
use markers::Marker;
use rand::RngExt;
use rendering::CameraSettings;

use super::scene::{Draw, view, with_id};
use crate::frame_spec::{FrameSpec, Tilt, pose};
use crate::set::{SIZE_M, Set};
use rendering::occluder::{Line, Occluder};

const FRAMES: usize = 8;

pub(super) fn frames(draw: Draw, marker: Marker) -> Vec<FrameSpec> {
    let kinds = [shadow, glare, occlusion, contrast, noise, defocus, inverted, cut, cut_border];
    let numbered = kinds.iter().enumerate();
    numbered
        .flat_map(|(kind, spec)| {
            (0..FRAMES).map(move |frame| spec(draw, marker, 100 * kind + frame))
        })
        .collect()
}

/// The edge of a hard shadow across the marker.
fn shadow(draw: Draw, marker: Marker, frame: usize) -> FrameSpec {
    let (spec, mut rng) = large(draw, marker, frame);
    let edge = Line {
        through: at_marker(&spec, rng.random_range(-0.25..0.25), rng.random_range(-0.25..0.25)),
        normal: rng.random_range(0.0..TAU),
    };
    let occluder = Occluder::Shadow {
        edge,
        penumbra_px: rng.random_range(1.5..4.0),
        transmission: rng.random_range(0.12..0.35),
    };
    spec.with("shadow", occluder)
}

/// A reflection that saturates a part of the marker.
fn glare(draw: Draw, marker: Marker, frame: usize) -> FrameSpec {
    let (spec, mut rng) = large(draw, marker, frame);
    let size_px = spec.size_px();
    let centre = at_marker(&spec, rng.random_range(-0.5..0.5), rng.random_range(-0.5..0.5));
    let occluder = Occluder::Glare {
        centre,
        radius_px: (size_px * rng.random_range(0.15..0.3)) as f32,
        levels: rng.random_range(220.0..500.0),
    };
    spec.with("glare", occluder)
}

/// An occluded corner of a square, or third of the outer ring.
fn occlusion(draw: Draw, marker: Marker, frame: usize) -> FrameSpec {
    let (spec, mut rng) = large(draw, marker, frame);
    // Distance of the edge from the centre in marker sizes: a chord that hides a third of a circle, or a
    // corner.
    let (towards, away) = if marker.family.id_count().is_none() {
        (rng.random_range(0.0..TAU), 0.25)
    } else {
        let corner = f64::from(rng.random_range(0..4));
        let legs = rng.random_range(0.18..0.32);
        (FRAC_PI_4 + corner * TAU / 4.0, (1.0 - legs) * std::f64::consts::FRAC_1_SQRT_2)
    };
    let (sin, cos) = towards.sin_cos();
    let level = [20.0, 90.0, 230.0][frame % 3];
    let (through, centre) = (at_marker(&spec, away * cos, away * sin), at_marker(&spec, 0.0, 0.0));
    let normal = (through.y - centre.y).atan2(through.x - centre.x);
    spec.with("occlusion", Occluder::Cover { edge: Line { through, normal }, level })
}

/// Low contrast by haze.
fn contrast(draw: Draw, marker: Marker, frame: usize) -> FrameSpec {
    let (spec, mut rng) = large(draw, marker, frame);
    let occluder = Occluder::Haze {
        transmission: rng.random_range(0.07..0.16),
        levels: rng.random_range(40.0..150.0),
    };
    spec.with("contrast", occluder)
}

/// Noise in low light.
fn noise(draw: Draw, marker: Marker, frame: usize) -> FrameSpec {
    let light = 0.002 * (1.0 + (frame % 4) as f64);
    let settings = CameraSettings::thesis().exposed_for(light, 200.0, 0.004);
    let (mut spec, _) = view(draw.frame(Set::Adverse, frame), marker, settings, 60.0..140.0, 0.4);
    spec.light = light;
    spec.with("noise", Occluder::None)
}

/// Out of focus.
fn defocus(draw: Draw, marker: Marker, frame: usize) -> FrameSpec {
    let blur_px = 2.0 + 0.14 * (frame % FRAMES) as f64;
    let settings = CameraSettings { blur_px, ..CameraSettings::thesis() };
    let (spec, _) = view(draw.frame(Set::Adverse, frame), marker, settings, 45.0..90.0, 0.4);
    spec.with("defocus", Occluder::None)
}

/// White on black.
fn inverted(draw: Draw, marker: Marker, frame: usize) -> FrameSpec {
    let (mut spec, _) = large(draw, marker, frame);
    spec.inverted = true;
    spec.with("inverted", Occluder::None)
}

/// A corner beyond the border of the frame.
fn cut(draw: Draw, marker: Marker, frame: usize) -> FrameSpec {
    cut_by(draw, marker, frame, |rng| {
        let legs = rng.random_range(0.15..0.32);
        (FRAC_PI_4 + rng.random_range(-0.25..0.25), (1.0 - legs) * 0.68)
    })
    .with("cut", Occluder::None)
}

/// Half of one side's border, or almost half of rings, beyond the border of the frame.
fn cut_border(draw: Draw, marker: Marker, frame: usize) -> FrameSpec {
    let without_ids = marker.family.id_count().is_none();
    cut_by(draw, marker, frame, |rng| {
        let away = if without_ids { 0.1 } else { 0.47 };
        (rng.random_range(-0.02..0.02), away)
    })
    .with("cut-border", Occluder::None)
}

/// A marker near a side of the frame. `how` returns its rotation relative to that side, and the distance of
/// its centre from it in marker sizes.
fn cut_by(
    draw: Draw,
    marker: Marker,
    frame: usize,
    how: impl Fn(&mut rand_chacha::ChaCha8Rng) -> (f64, f64),
) -> FrameSpec {
    let (mut rng, seed) = draw.frame_rng(Set::Adverse, frame);
    let settings = CameraSettings::thesis();
    let model = settings.model;
    let size_px = rng.random_range(80.0..300.0);
    let (turned, away) = how(&mut rng);
    let away_px = away * size_px;
    let [right, bottom] = [model.width, model.height].map(|edge| f64::from(edge) - 0.5);
    let along = rng.random_range(0.3..0.7);
    let at = match frame % 4 {
        0 => Pixel::new(away_px - 0.5, bottom * along),
        1 => Pixel::new(right - away_px, bottom * along),
        2 => Pixel::new(right * along, away_px - 0.5),
        _ => Pixel::new(right * along, bottom - away_px),
    };
    let heading = turned + f64::from(rng.random_range(0..4)) * TAU / 4.0;
    let pose = pose(&model, at, model.fx * SIZE_M / size_px, Tilt::NONE, heading);
    FrameSpec::new(with_id(marker, frame), settings, pose, seed)
}

fn large(draw: Draw, marker: Marker, frame: usize) -> (FrameSpec, rand_chacha::ChaCha8Rng) {
    view(draw.frame(Set::Adverse, frame), marker, CameraSettings::thesis(), 60.0..160.0, 0.4)
}

/// The pixel of a point on the marker, in marker sizes from its centre.
fn at_marker(spec: &FrameSpec, x: f64, y: f64) -> Pixel {
    let seen = spec.path.first().and_then(|camera_from_marker| {
        let place = *camera_from_marker * Point::new(x * SIZE_M, y * SIZE_M, 0.0);
        spec.settings.model.project(place)
    });
    seen.unwrap_or(Pixel::new(0.0, 0.0))
}
