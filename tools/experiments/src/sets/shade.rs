//! Frames with light and cover as they are outdoors: edges of hard shadows of any contrast, dappled shade, leaves.

use std::f64::consts::TAU;
use std::ops::Range;

use markers::Marker;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rendering::CameraSettings;
use rendering::occluder::{Line, Occluder};

use super::scene::{Draw, discs, on_marker, view};
use crate::frame_spec::FrameSpec;
use crate::set::Set;

/// Frames of each group; of small markers half as many.
const FRAMES: usize = 20;

/// Light in the sun over light in the shade.
const CONTRASTS: [f64; 4] = [2.0, 4.0, 6.0, 10.0];

pub(super) fn frames(draw: Draw, marker: Marker) -> Vec<FrameSpec> {
    let mut frames = Vec::new();
    for contrast in CONTRASTS {
        for _ in 0..FRAMES {
            let (spec, mut rng) = large(draw, marker, frames.len());
            let occluder = edge(&spec, &mut rng, contrast, 1.0..4.0);
            frames.push(spec.with(format!("edge1:{contrast}"), occluder));
        }
    }
    for _ in 0..FRAMES {
        let (spec, mut rng) = large(draw, marker, frames.len());
        let size_px = spec.size_px();
        let suns = discs(&spec, &mut rng, 6..16, 0.8, 0.08..0.3);
        let occluder = Occluder::Dapple {
            suns,
            // Suns seen through leaves are discs of half a degree: soft over the height of the tree.
            penumbra_px: (size_px * rng.random_range(0.02..0.1)) as f32,
            transmission: (1.0 / rng.random_range(3.0..8.0)) as f32,
        };
        frames.push(spec.with("dapple", occluder));
    }
    for _ in 0..FRAMES {
        let (spec, mut rng) = large(draw, marker, frames.len());
        // Together at most a quarter of the marker.
        let leaves = discs(&spec, &mut rng, 2..6, 0.6, 0.04..0.12);
        let level = [25.0, 60.0, 110.0][frames.len() % 3];
        frames.push(spec.with("leaves", Occluder::Leaves { leaves, level }));
    }
    for contrast in CONTRASTS {
        for _ in 0..FRAMES / 2 {
            let (spec, mut rng) = of_size(18.0..40.0, draw, marker, frames.len());
            let occluder = edge(&spec, &mut rng, contrast, 0.5..2.0);
            frames.push(spec.with(format!("small1:{contrast}"), occluder));
        }
    }
    frames
}

/// The edge of a shadow through the central parts of the marker, with a penumbra of so many pixels.
fn edge(
    spec: &FrameSpec,
    rng: &mut ChaCha8Rng,
    contrast: f64,
    penumbra_px: Range<f32>,
) -> Occluder {
    Occluder::Shadow {
        edge: Line { through: on_marker(spec, rng, 0.4), normal: rng.random_range(0.0..TAU) },
        penumbra_px: rng.random_range(penumbra_px),
        transmission: (1.0 / contrast) as f32,
    }
}

fn large(draw: Draw, marker: Marker, frame: usize) -> (FrameSpec, ChaCha8Rng) {
    of_size(40.0..160.0, draw, marker, frame)
}

/// A view of a marker of so many pixels.
fn of_size(
    size_px: Range<f64>,
    draw: Draw,
    marker: Marker,
    frame: usize,
) -> (FrameSpec, ChaCha8Rng) {
    view(draw.frame(Set::Shade, frame), marker, CameraSettings::thesis(), size_px, 0.4)
}
