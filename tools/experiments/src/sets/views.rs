//! Frames of a marker as in a landing: the thesis' positions, far off, on the way down, on textured
//! ground, and in sequences for tracking.

use std::f64::consts::{PI, TAU};

use geometry::{Distortion, Pixel};
use markers::Marker;
use rand::RngExt;
use rendering::views::{Binning, MAX_HEIGHT_M, laterals_m};
use rendering::{CameraSettings, Surface};

use super::scene::{Draw, centre, near, with_id};
use crate::frame_spec::{FrameSpec, Tilt, pose};
use crate::set::{SIZE_M, Set};

/// Frames of each position.
const FRAMES_PER_POSITION: usize = 5;

pub(super) fn positions(draw: Draw, marker: Marker) -> Vec<FrameSpec> {
    let mut frames = Vec::new();
    for binning in [Binning::TwoByTwo, Binning::FourByFour] {
        for height_m in 1..=MAX_HEIGHT_M {
            for lateral_m in laterals_m(height_m) {
                for _ in 0..FRAMES_PER_POSITION {
                    let (mut rng, seed) = draw.frame_rng(Set::Positions, frames.len());
                    let settings = binning.settings();
                    let model = settings.model;
                    let right_px = model.fx * lateral_m / f64::from(height_m);
                    let at = Pixel::new(model.cx + right_px, model.cy);
                    let at = near(&mut rng, at, 4.0);
                    let heading = rng.random_range(0.0..TAU);
                    let pose = pose(&model, at, f64::from(height_m), Tilt::NONE, heading);
                    let mut spec = FrameSpec::new(marker, settings, pose, seed);
                    spec.group = format!("{}-{height_m:02}m{lateral_m:+}m", binning.name());
                    frames.push(spec);
                }
            }
        }
    }
    frames
}

pub(super) fn far(draw: Draw, marker: Marker) -> Vec<FrameSpec> {
    let mut frames = Vec::new();
    for height_m in (10..=40).step_by(2) {
        for frame in 0..5 {
            let (mut rng, seed) = draw.frame_rng(Set::Far, frames.len());
            let settings = CameraSettings::thesis();
            let at = near(&mut rng, centre(&settings.model), 100.0);
            let tilt =
                Tilt { angle: rng.random_range(0.0..0.05), about: rng.random_range(0.0..TAU) };
            let heading = rng.random_range(0.0..TAU);
            let pose = pose(&settings.model, at, f64::from(height_m), tilt, heading);
            let mut spec = FrameSpec::new(with_id(marker, frame), settings, pose, seed);
            spec.group = format!("{height_m}m");
            spec.surface = Surface::ALL[frame % 3];
            frames.push(spec);
        }
    }
    frames
}

pub(super) fn landing(draw: Draw, marker: Marker) -> Vec<FrameSpec> {
    const FRAMES: usize = 51;
    (0..FRAMES)
        .map(|frame| {
            let (mut rng, seed) = draw.frame_rng(Set::Landing, frame);
            let light = 10f64.powf(rng.random_range(-0.8..0.1));
            let mut settings = CameraSettings::thesis().exposed_for(light, 190.0, 0.004);
            if frame % 2 == 1 {
                let [k1, k2] = [rng.random_range(-0.25..0.05), rng.random_range(-0.05..0.1)];
                settings.model.distortion =
                    Distortion::BrownConrady([k1, k2, 3e-4, -2e-4, 0.0, 0.0, 0.0, 0.0]);
            }
            settings.blur_px = rng.random_range(0.5..1.0);
            let model = settings.model;
            let distance_m = 0.3 * 50f64.powf(rng.random_range(0.0..1.0));
            let [x, y] = [model.width, model.height].map(|edge| {
                let edge = f64::from(edge);
                edge * rng.random_range(0.1..0.9)
            });
            let tilt = Tilt {
                angle: rng.random_range(0.0..25f64.to_radians()),
                about: rng.random_range(0.0..TAU),
            };
            let heading = rng.random_range(0.0..TAU);
            let seen = |x: f64, y: f64, turn: f64| {
                pose(&model, Pixel::new(x, y), distance_m, tilt, heading + turn)
            };
            let motion_px: f64 = rng.random_range(0.0..5.0);
            let (sin, cos) = rng.random_range(0.0..TAU).sin_cos();
            let turn = rng.random_range(-0.003..0.003);
            let at = |part: f64| {
                seen(x + part * motion_px * cos, y + part * motion_px * sin, part * turn)
            };
            let mut spec = FrameSpec::new(with_id(marker, frame), settings, at(0.0), seed);
            spec.path = vec![at(-0.5), at(0.0), at(0.5)];
            spec.light = light;
            spec.surface = Surface::ALL[frame % 3];
            spec.painted_marks = rng.random_range(0..40);
            spec.bayer = frame % 3 == 2;
            spec.group = if spec.is_whole() { "whole" } else { "cut" }.to_owned();
            spec
        })
        .collect()
}

pub(super) fn textured(draw: Draw, marker: Marker) -> Vec<FrameSpec> {
    const FRAMES: usize = 15;
    (0..FRAMES)
        .map(|frame| {
            let (mut rng, seed) = draw.frame_rng(Set::Textured, frame);
            let settings = CameraSettings::thesis();
            let at = near(&mut rng, centre(&settings.model), 200.0);
            let distance_m = 1.5 + 0.6 * frame as f64;
            let tilt =
                Tilt { angle: rng.random_range(0.0..0.2), about: rng.random_range(0.0..TAU) };
            let heading = rng.random_range(0.0..TAU);
            let pose = pose(&settings.model, at, distance_m, tilt, heading);
            let mut spec = FrameSpec::new(with_id(marker, frame), settings, pose, seed);
            spec.surface = Surface::ALL[frame % 3];
            spec.group = spec.surface.name().to_owned();
            spec
        })
        .collect()
}

pub(super) fn tracking(draw: Draw, marker: Marker) -> Vec<FrameSpec> {
    const FRAMES: usize = 30;
    const SIZE_PX: f64 = 48.0;
    let settings = CameraSettings::thesis();
    let (mut rng, _) = draw.frame_rng(Set::Tracking, 0);
    let heading = rng.random_range(0.0..PI);
    (0..FRAMES)
        .map(|frame| {
            let (_, seed) = draw.frame_rng(Set::Tracking, frame);
            let model = settings.model;
            let along = frame as f64;
            let at = Pixel::new(300.0 + 9.3 * along, 300.0 + 5.7 * along);
            let distance_m = model.fx * SIZE_M / SIZE_PX * (1.0 - 0.003 * along);
            let tilt = Tilt { angle: 0.1 * (along / 7.0).sin(), about: along / 11.0 };
            let pose = pose(&model, at, distance_m, tilt, heading + 0.01 * along);
            let mut spec = FrameSpec::new(marker, settings.clone(), pose, seed);
            spec.group = "drift".to_owned();
            spec
        })
        .collect()
}
