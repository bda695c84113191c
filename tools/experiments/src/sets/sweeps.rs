//! One thing made worse step by step.

use std::f64::consts::TAU;

use geometry::{Camera, Point, Rotation, Transform};
use markers::Marker;
use rand::RngExt;
use rendering::{CameraSettings, Surface};

use super::{Set, chance, middle, near, view, with_id};
use crate::shot::{Shot, pose};
use rendering::occluder::Occluder;

pub(super) fn tilt(marker: Marker) -> Vec<Shot> {
    let mut shots = Vec::new();
    for tilt_deg in (0..=60).step_by(10) {
        for distance_m in [0.6f64, 1.5, 4.0, 8.0] {
            for frame in 0..3 {
                let (mut rng, seed) = chance(Set::Tilt, shots.len());
                let settings = CameraSettings::thesis();
                let at = near(&mut rng, middle(&settings.model), 150.0);
                let tilt = (f64::from(tilt_deg).to_radians(), rng.random_range(0.0..TAU));
                let heading = rng.random_range(0.0..TAU);
                let pose = pose(&settings.model, at, distance_m, tilt, heading);
                let mut shot = Shot::of(with_id(marker, frame), settings, pose, seed);
                shot.group = format!("{tilt_deg}deg");
                shots.push(shot);
            }
        }
    }
    shots
}

pub(super) fn blur(marker: Marker) -> Vec<Shot> {
    let mut shots = Vec::new();
    for blur_px in [0.3, 0.6, 1.0, 1.5, 2.0, 2.5, 3.0] {
        for _ in 0..6 {
            let settings = CameraSettings { blur_px, ..CameraSettings::thesis() };
            let (shot, _) = view(marker, settings, (Set::Blur, shots.len()), 35.0..120.0, 0.3);
            shots.push(shot.with(format!("lens{blur_px}"), Occluder::None));
        }
    }
    for motion_px in [1.0f64, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0] {
        for _ in 0..6 {
            let frame = (Set::Blur, shots.len());
            let settings = CameraSettings::thesis();
            let (mut shot, mut rng) = view(marker, settings, frame, 50.0..150.0, 0.3);
            let middle = shot.path[0];
            let (sin, cos) = rng.random_range(0.0..TAU).sin_cos();
            let origin = middle.origin();
            let per_px = origin.z() / shot.settings.model.fx * motion_px;
            let at = |part: f64| {
                let offset = geometry::Vector::new(part * per_px * cos, part * per_px * sin, 0.0);
                Transform::new(middle.rotation(), origin + offset)
            };
            shot.path = vec![at(-0.5), at(0.0), at(0.5)];
            shots.push(shot.with(format!("motion{motion_px}"), Occluder::None));
        }
    }
    shots
}

pub(super) fn noise(marker: Marker) -> Vec<Shot> {
    let mut shots = Vec::new();
    // Light that is left, and about the noise of white in grey levels.
    for light in [0.5, 0.1, 0.03, 0.01, 0.004, 0.002, 0.001] {
        for _ in 0..6 {
            let settings = CameraSettings::thesis().exposed_for(light, 200.0, 0.004);
            let frame = (Set::Noise, shots.len());
            let (mut shot, _) = view(marker, settings, frame, 40.0..120.0, 0.3);
            shot.light = light;
            shots.push(shot.with(format!("light{light}"), Occluder::None));
        }
    }
    shots
}

pub(super) fn light(marker: Marker) -> Vec<Shot> {
    let mut shots = Vec::new();
    // White's grey level if there were no end to the scale.
    for white in [8.0, 15.0, 30.0, 60.0, 120.0, 240.0, 400.0, 700.0, 1200.0] {
        for frame in 0..6 {
            let settings = CameraSettings::thesis().exposed_for(1.0, white, 0.1);
            let place = (Set::Light, shots.len());
            let (mut shot, _) = view(marker, settings, place, 30.0..120.0, 0.3);
            shot.surface = [Surface::Asphalt, Surface::Grass][frame % 2];
            shots.push(shot.with(format!("white{white}"), Occluder::None));
        }
    }
    shots
}

/// How long the shutter takes to roll over the image, in seconds.
const READOUT_S: f64 = 0.02;

pub(super) fn rolling(marker: Marker) -> Vec<Shot> {
    // The camera's velocity to the right, to the bottom and forward in the image in m/s, and its turn about its axis in rad/s.
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
    let mut shots = Vec::new();
    for (name, velocity, turn) in motions {
        for _ in 0..6 {
            let (mut rng, seed) = chance(Set::Rolling, shots.len());
            let settings = CameraSettings { readout_s: READOUT_S, ..CameraSettings::thesis() };
            let at = near(&mut rng, middle(&settings.model), 250.0);
            let tilt = (rng.random_range(0.0..0.2), rng.random_range(0.0..TAU));
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
            let mut shot = Shot::of(marker, settings, still, seed);
            shot.path = vec![seen(-half_s), seen(0.0), seen(half_s)];
            shot.surface = Surface::ALL[shots.len() % 3];
            shots.push(shot.with(name, Occluder::None));
        }
    }
    shots
}
