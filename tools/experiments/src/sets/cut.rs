//! Markers cut off by the frame, as in the last metres of a landing in wind.

use std::f64::consts::TAU;

use geometry::{CameraModel, Pixel};
use markers::Marker;
use rand::RngExt;
use rendering::{CameraSettings, Surface};

use super::scene::{Draw, with_id};
use crate::frame_spec::{FrameSpec, Tilt, pose};
use crate::set::{SIZE_M, Set};
use rendering::occluder::Occluder;

/// Number of views of each marker.
pub(super) const FRAMES: usize = 200;

/// Distances along the optical axis, in metres.
const DISTANCE_M: std::ops::Range<f64> = 0.5..1.5;

/// Maximum tilt, in radians: that of a vehicle in 5 m/s of wind, and some more.
const MAX_TILT: f64 = 0.35;

/// How far the outermost corner is beyond the frame, in marker sizes.
const BEYOND: std::ops::Range<f64> = 0.002..0.3;

pub(super) fn frames(draw: Draw, marker: Marker) -> Vec<FrameSpec> {
    (0..FRAMES).map(|frame| spec(draw, marker, frame)).collect()
}

fn spec(draw: Draw, marker: Marker, frame: usize) -> FrameSpec {
    let (mut rng, seed) = draw.frame_rng(Set::Cut, frame);
    let settings = CameraSettings::thesis();
    let model = settings.model;
    let distance_m = rng.random_range(DISTANCE_M);
    let tilt = Tilt { angle: rng.random_range(0.0..MAX_TILT), about: rng.random_range(0.0..TAU) };
    let heading = rng.random_range(0.0..TAU);
    let along = rng.random_range(0.1..0.9);
    // Half of them by less than a tenth of the marker.
    let beyond =
        BEYOND.start + (BEYOND.end - BEYOND.start) * rng.random_range(0.0_f64..1.0).powi(2);
    let shown = |at: Pixel| {
        let pose = pose(&model, at, distance_m, tilt, heading);
        FrameSpec::new(with_id(marker, frame), settings.clone(), pose, seed)
    };
    let (side, mut at) = (frame % 4, at_side(&model, frame % 4, along));
    // The outermost corner moves almost as the centre does.
    for _ in 0..4 {
        let Some(truth) = shown(at).ground_truth() else { break };
        let is = truth.corners.iter().map(|c| beyond_px(&model, side, *c)).fold(f64::MIN, f64::max);
        let off = beyond * model.fx * SIZE_M / distance_m - is;
        match side {
            0 => at.x -= off,
            1 => at.x += off,
            2 => at.y -= off,
            _ => at.y += off,
        }
    }
    let mut spec = shown(at);
    spec.surface = Surface::ALL[frame / 4 % 3];
    let hidden = spec
        .ground_truth()
        .map_or(0, |truth| truth.corners.iter().filter(|corner| !model.contains(**corner)).count());
    let group = ["none", "one-corner", "two-corners", "three-corners", "all"][hidden];
    spec.with(group, Occluder::None)
}

/// A position on a side of the frame.
fn at_side(model: &CameraModel, side: usize, along: f64) -> Pixel {
    let [right, bottom] = [model.width, model.height].map(f64::from);
    match side {
        0 => Pixel::new(0.0, bottom * along),
        1 => Pixel::new(right, bottom * along),
        2 => Pixel::new(right * along, 0.0),
        _ => Pixel::new(right * along, bottom),
    }
}

/// How far a pixel is beyond a side of the frame.
fn beyond_px(model: &CameraModel, side: usize, pixel: Pixel) -> f64 {
    match side {
        0 => -0.5 - pixel.x,
        1 => pixel.x - f64::from(model.width) + 0.5,
        2 => -0.5 - pixel.y,
        _ => pixel.y - f64::from(model.height) + 0.5,
    }
}
