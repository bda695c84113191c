//! Frames in which one parameter grows step by step: tilt, motion blur, noise, light, or the motion under a
//! rolling shutter.

use std::f64::consts::TAU;

use geometry::{Camera, Point, Rotation, Transform};
use markers::Marker;
use rand::RngExt;
use rendering::{CameraSettings, Surface};

use super::scene::{Draw, centre, near, view, with_id};
use crate::frame_spec::{FrameSpec, Tilt, pose};
use crate::set::Set;
use rendering::occluder::Occluder;

pub(super) fn tilt(draw: Draw, marker: Marker) -> Vec<FrameSpec> {
    let mut frames = Vec::new();
    for tilt_deg in (0..=60).step_by(10) {
        for distance_m in [0.6f64, 1.5, 4.0, 8.0] {
            for frame in 0..3 {
                let (mut rng, seed) = draw.frame_rng(Set::Tilt, frames.len());
                let settings = CameraSettings::thesis();
                let at = near(&mut rng, centre(&settings.model), 150.0);
                let tilt = Tilt {
                    angle: f64::from(tilt_deg).to_radians(),
                    about: rng.random_range(0.0..TAU),
                };
                let heading = rng.random_range(0.0..TAU);
                let pose = pose(&settings.model, at, distance_m, tilt, heading);
                let mut spec = FrameSpec::new(with_id(marker, frame), settings, pose, seed);
                spec.group = format!("{tilt_deg}deg");
                frames.push(spec);
            }
        }
    }
    frames
}

pub(super) fn blur(draw: Draw, marker: Marker) -> Vec<FrameSpec> {
    let mut frames = Vec::new();
    for blur_px in [0.3, 0.6, 1.0, 1.5, 2.0, 2.5, 3.0] {
        for _ in 0..6 {
            let settings = CameraSettings { blur_px, ..CameraSettings::thesis() };
            let (spec, _) =
                view(draw.frame(Set::Blur, frames.len()), marker, settings, 35.0..120.0, 0.3);
            frames.push(spec.with(format!("lens{blur_px}"), Occluder::None));
        }
    }
    for motion_px in [1.0f64, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0] {
        for _ in 0..6 {
            let settings = CameraSettings::thesis();
            let (mut spec, mut rng) =
                view(draw.frame(Set::Blur, frames.len()), marker, settings, 50.0..150.0, 0.3);
            let centre = spec.path[0];
            let (sin, cos) = rng.random_range(0.0..TAU).sin_cos();
            let origin = centre.origin();
            let per_px = origin.z() / spec.settings.model.fx * motion_px;
            let at = |part: f64| {
                let offset = geometry::Vector::new(part * per_px * cos, part * per_px * sin, 0.0);
                Transform::new(centre.rotation(), origin + offset)
            };
            spec.path = vec![at(-0.5), at(0.0), at(0.5)];
            frames.push(spec.with(format!("motion{motion_px}"), Occluder::None));
        }
    }
    frames
}

pub(super) fn noise(draw: Draw, marker: Marker) -> Vec<FrameSpec> {
    let mut frames = Vec::new();
    // Light on the scene; the gain makes up for it.
    for light in [0.5, 0.1, 0.03, 0.01, 0.004, 0.002, 0.001] {
        for _ in 0..6 {
            let settings = CameraSettings::thesis().exposed_for(light, 200.0, 0.004);
            let (mut spec, _) =
                view(draw.frame(Set::Noise, frames.len()), marker, settings, 40.0..120.0, 0.3);
            spec.light = light;
            frames.push(spec.with(format!("light{light}"), Occluder::None));
        }
    }
    frames
}

pub(super) fn light(draw: Draw, marker: Marker) -> Vec<FrameSpec> {
    let mut frames = Vec::new();
    // Grey level of white without saturation.
    for white in [8.0, 15.0, 30.0, 60.0, 120.0, 240.0, 400.0, 700.0, 1200.0] {
        for frame in 0..6 {
            let settings = CameraSettings::thesis().exposed_for(1.0, white, 0.1);
            let (mut spec, _) =
                view(draw.frame(Set::Light, frames.len()), marker, settings, 30.0..120.0, 0.3);
            spec.surface = [Surface::Asphalt, Surface::Grass][frame % 2];
            frames.push(spec.with(format!("white{white}"), Occluder::None));
        }
    }
    frames
}

/// Readout time of the rolling shutter, in seconds.
const READOUT_S: f64 = 0.02;

pub(super) fn rolling(draw: Draw, marker: Marker) -> Vec<FrameSpec> {
    // The camera's velocity right, down and forward in m/s, and its rate of turn about the optical axis in
    // rad/s.
    let motions = [
        ("still", [0.0, 0.0, 0.0], 0.0),
        ("right0.5", [0.5, 0.0, 0.0], 0.0),
        ("right1", [1.0, 0.0, 0.0], 0.0),
        ("right2", [2.0, 0.0, 0.0], 0.0),
        ("down1", [0.0, 1.0, 0.0], 0.0),
        ("down2", [0.0, 2.0, 0.0], 0.0),
        ("forward1", [0.0, 0.0, 1.0], 0.0),
        ("turn1", [0.0, 0.0, 0.0], 1.0),
    ];
    let mut frames = Vec::new();
    for (name, velocity, turn) in motions {
        for _ in 0..6 {
            let (mut rng, seed) = draw.frame_rng(Set::Rolling, frames.len());
            let settings = CameraSettings { readout_s: READOUT_S, ..CameraSettings::thesis() };
            let at = near(&mut rng, centre(&settings.model), 250.0);
            let tilt =
                Tilt { angle: rng.random_range(0.0..0.2), about: rng.random_range(0.0..TAU) };
            let heading = rng.random_range(0.0..TAU);
            let still = pose(&settings.model, at, 3.0, tilt, heading);
            let half_s = 0.5 * (settings.readout_s + settings.exposure_s);
            let seen = |time_s: f64| {
                let moved = geometry::Vector::new(
                    -velocity[0] * time_s,
                    -velocity[1] * time_s,
                    -velocity[2] * time_s,
                );
                let turned = Rotation::<Camera, Camera>::from_euler(0.0, 0.0, -turn * time_s);
                Transform::new(turned, Point::origin())
                    * Transform::new(still.rotation(), still.origin() + moved)
            };
            let mut spec = FrameSpec::new(marker, settings, still, seed);
            spec.path = vec![seen(-half_s), seen(0.0), seen(half_s)];
            spec.surface = Surface::ALL[frames.len() % 3];
            frames.push(spec.with(name, Occluder::None));
        }
    }
    frames
}
