//! The sets of frames: which there are, and what is in them.
//!
//! A set has the same views, grounds and lights for every marker, so that markers are compared and not chance.

mod adverse;
mod clutter;
mod sweeps;

use std::f64::consts::{PI, TAU};

use geometry::{CameraModel, Distortion, Pixel};
use markers::Marker;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rendering::views::{Binning, MAX_HEIGHT_M, laterals_m};
use rendering::{CameraSettings, Surface};

use crate::shot::{Shot, pose};
use rendering::occluder::Occluder;

/// Size of the thesis' markers, in metres.
pub const SIZE_M: f64 = rendering::views::SIZE_M;

/// The markers of the experiment: the thesis' four, and the most used one.
pub const MARKERS: [&str; 5] =
    ["rings", "apriltag-16h5:0", "aruco-4x4-50:0", "stag-hd23:0", "apriltag-36h11:0"];

/// A set of frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Set {
    /// The thesis' 37 positions (Table 4.1) with both binnings, five frames each.
    Positions,
    /// Straight down from 10 to 40 m, five frames each.
    Far,
    /// Anything that a landing meets: 51 frames.
    Landing,
    /// Shadows, glare, occlusion, low contrast, noise, defocus, inverted, cut by the frame.
    Adverse,
    /// Tilted by up to 60 degrees at four distances.
    Tilt,
    /// Blurred by the lens and by motion.
    Blur,
    /// Noisier and noisier.
    Noise,
    /// From night to far too bright.
    Light,
    /// Moving before a rolling shutter.
    Rolling,
    /// Textured grounds for timing.
    Textured,
    /// A marker 48 px wide that drifts through the image.
    Tracking,
    /// Scenes without a marker.
    Negatives,
}

impl Set {
    /// Every set, in the order in which they are made.
    pub const ALL: [Self; 12] = [
        Self::Textured,
        Self::Adverse,
        Self::Landing,
        Self::Far,
        Self::Tilt,
        Self::Blur,
        Self::Noise,
        Self::Light,
        Self::Rolling,
        Self::Tracking,
        Self::Negatives,
        Self::Positions,
    ];

    /// The name of its folder.
    pub fn name(self) -> &'static str {
        match self {
            Self::Positions => "positions",
            Self::Far => "far",
            Self::Landing => "landing",
            Self::Adverse => "adverse",
            Self::Tilt => "tilt",
            Self::Blur => "blur",
            Self::Noise => "noise",
            Self::Light => "light",
            Self::Rolling => "rolling",
            Self::Textured => "textured",
            Self::Tracking => "tracking",
            Self::Negatives => "negatives",
        }
    }

    /// Whether its frames show the marker.
    pub fn has_marker(self) -> bool {
        self != Self::Negatives
    }

    /// Its frames with one marker; the marker of negatives is of no matter.
    pub fn shots(self, marker: Marker) -> Vec<Shot> {
        match self {
            Self::Positions => positions(marker),
            Self::Far => far(marker),
            Self::Landing => landing(marker),
            Self::Adverse => adverse::shots(marker),
            Self::Tilt => sweeps::tilt(marker),
            Self::Blur => sweeps::blur(marker),
            Self::Noise => sweeps::noise(marker),
            Self::Light => sweeps::light(marker),
            Self::Rolling => sweeps::rolling(marker),
            Self::Textured => textured(marker),
            Self::Tracking => tracking(marker),
            Self::Negatives => clutter::shots(),
        }
    }
}

impl std::str::FromStr for Set {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL.into_iter().find(|set| set.name() == text).ok_or_else(|| {
            let known = Self::ALL.map(Self::name).join(", ");
            format!("there is no set `{text}`; known are {known}")
        })
    }
}

/// Chance for one frame of a set.
fn chance(set: Set, frame: usize) -> (ChaCha8Rng, u64) {
    let seed = 1000 * (set.name().bytes().map(u64::from).sum::<u64>()) + frame as u64;
    (ChaCha8Rng::seed_from_u64(seed), seed)
}

/// A pixel at most so far from another, along both axes.
fn near(rng: &mut ChaCha8Rng, pixel: Pixel, by_px: f64) -> Pixel {
    Pixel::new(pixel.x + rng.random_range(-by_px..by_px), pixel.y + rng.random_range(-by_px..by_px))
}

fn middle(model: &CameraModel) -> Pixel {
    Pixel::new(model.cx, model.cy)
}

/// Another id of the marker's family.
fn with_id(marker: Marker, number: usize) -> Marker {
    let id = marker.family.id_count().map(|count| (number as u32 * 7) % count);
    Marker { id: if number == 0 { marker.id } else { id }, ..marker }
}

const FRAMES_OF_A_POSITION: usize = 5;

fn positions(marker: Marker) -> Vec<Shot> {
    let mut shots = Vec::new();
    for binning in [Binning::TwoByTwo, Binning::FourByFour] {
        for height_m in 1..=MAX_HEIGHT_M {
            for lateral_m in laterals_m(height_m) {
                for _ in 0..FRAMES_OF_A_POSITION {
                    let (mut rng, seed) = chance(Set::Positions, shots.len());
                    let settings = binning.settings();
                    let model = settings.model;
                    let right_px = model.fx * lateral_m / f64::from(height_m);
                    let at = Pixel::new(model.cx + right_px, model.cy);
                    let at = near(&mut rng, at, 4.0);
                    let heading = rng.random_range(0.0..TAU);
                    let pose = pose(&model, at, f64::from(height_m), (0.0, 0.0), heading);
                    let mut shot = Shot::of(marker, settings, pose, seed);
                    shot.group = format!("{}-{height_m:02}m{lateral_m:+}m", binning.name());
                    shots.push(shot);
                }
            }
        }
    }
    shots
}

fn far(marker: Marker) -> Vec<Shot> {
    let mut shots = Vec::new();
    for height_m in (10..=40).step_by(2) {
        for frame in 0..5 {
            let (mut rng, seed) = chance(Set::Far, shots.len());
            let settings = CameraSettings::thesis();
            let at = near(&mut rng, middle(&settings.model), 100.0);
            let tilt = (rng.random_range(0.0..0.05), rng.random_range(0.0..TAU));
            let heading = rng.random_range(0.0..TAU);
            let pose = pose(&settings.model, at, f64::from(height_m), tilt, heading);
            let mut shot = Shot::of(with_id(marker, frame), settings, pose, seed);
            shot.group = format!("{height_m}m");
            shot.surface = Surface::ALL[frame % 3];
            shots.push(shot);
        }
    }
    shots
}

fn landing(marker: Marker) -> Vec<Shot> {
    const FRAMES: usize = 51;
    (0..FRAMES)
        .map(|frame| {
            let (mut rng, seed) = chance(Set::Landing, frame);
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
            // Low down a marker is rarely quite outside of the view.
            let [x, y] = [model.width, model.height].map(|edge| {
                let edge = f64::from(edge);
                edge * rng.random_range(0.1..0.9)
            });
            let tilt = (rng.random_range(0.0..25f64.to_radians()), rng.random_range(0.0..TAU));
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
            let mut shot = Shot::of(with_id(marker, frame), settings, at(0.0), seed);
            shot.path = vec![at(-0.5), at(0.0), at(0.5)];
            shot.light = light;
            shot.surface = Surface::ALL[frame % 3];
            shot.painted_marks = rng.random_range(0..40);
            shot.bayer = frame % 3 == 2;
            shot.group = if shot.is_whole() { "whole" } else { "cut" }.to_owned();
            shot
        })
        .collect()
}

fn textured(marker: Marker) -> Vec<Shot> {
    const FRAMES: usize = 15;
    (0..FRAMES)
        .map(|frame| {
            let (mut rng, seed) = chance(Set::Textured, frame);
            let settings = CameraSettings::thesis();
            let at = near(&mut rng, middle(&settings.model), 200.0);
            let distance_m = 1.5 + 0.6 * frame as f64;
            let tilt = (rng.random_range(0.0..0.2), rng.random_range(0.0..TAU));
            let heading = rng.random_range(0.0..TAU);
            let pose = pose(&settings.model, at, distance_m, tilt, heading);
            let mut shot = Shot::of(with_id(marker, frame), settings, pose, seed);
            shot.surface = Surface::ALL[frame % 3];
            shot.group = shot.surface.name().to_owned();
            shot
        })
        .collect()
}

fn tracking(marker: Marker) -> Vec<Shot> {
    const FRAMES: usize = 30;
    const SIZE_PX: f64 = 48.0;
    let settings = CameraSettings::thesis();
    let (mut rng, _) = chance(Set::Tracking, 0);
    let heading = rng.random_range(0.0..PI);
    (0..FRAMES)
        .map(|frame| {
            let (_, seed) = chance(Set::Tracking, frame);
            let model = settings.model;
            let along = frame as f64;
            let at = Pixel::new(300.0 + 9.3 * along, 300.0 + 5.7 * along);
            let distance_m = model.fx * SIZE_M / SIZE_PX * (1.0 - 0.003 * along);
            let tilt = (0.1 * (along / 7.0).sin(), along / 11.0);
            let pose = pose(&model, at, distance_m, tilt, heading + 0.01 * along);
            let mut shot = Shot::of(marker, settings.clone(), pose, seed);
            shot.group = "drift".to_owned();
            shot
        })
        .collect()
}

impl Shot {
    /// Whether all of the marker's square (for rings the outer circle's) is in the frame.
    pub(crate) fn is_whole(&self) -> bool {
        self.shown().is_some_and(|shown| {
            shown.corners.iter().all(|corner| self.settings.model.contains(*corner))
        })
    }

    /// The largest extent of the marker's square in the image, in pixels.
    pub(crate) fn size_px(&self) -> f64 {
        self.shown().map_or(0.0, |shown| {
            let [a, b, c, d] = shown.corners;
            [a.distance(&b), b.distance(&c), c.distance(&d), d.distance(&a)]
                .into_iter()
                .fold(0.0, f64::max)
        })
    }

    fn with(mut self, group: impl Into<String>, occluder: Occluder) -> Self {
        self.group = group.into();
        self.occluder = occluder;
        self
    }
}

/// A view of a marker, level with it up to `tilt`, so large in the image.
fn view(
    marker: Marker,
    settings: CameraSettings,
    (set, frame): (Set, usize),
    size_px: std::ops::Range<f64>,
    tilt: f64,
) -> (Shot, ChaCha8Rng) {
    let (mut rng, seed) = chance(set, frame);
    let model = settings.model;
    let distance_m = model.fx * SIZE_M / rng.random_range(size_px);
    let at = near(&mut rng, middle(&model), 200.0);
    let tilt = (rng.random_range(0.0..=tilt), rng.random_range(0.0..TAU));
    let heading = rng.random_range(0.0..TAU);
    let pose = pose(&model, at, distance_m, tilt, heading);
    let mut shot = Shot::of(with_id(marker, frame), settings, pose, seed);
    shot.surface = Surface::ALL[frame % 3];
    (shot, rng)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sets_have_the_frames_they_are_said_to_have() {
        let marker = "apriltag-16h5:0:0.15341".parse().unwrap();
        let counts = Set::ALL.map(|set| (set.name(), set.shots(marker).len()));
        let expected = [
            ("textured", 15),
            ("adverse", 72),
            ("landing", 51),
            ("far", 80),
            ("tilt", 84),
            ("blur", 84),
            ("noise", 42),
            ("light", 54),
            ("rolling", 48),
            ("tracking", 30),
            ("negatives", 520),
            ("positions", 37 * 2 * 5),
        ];
        assert_eq!(counts, expected);
    }

    #[test]
    fn every_marker_has_the_same_views_and_is_in_front_of_the_camera() {
        let shots = MARKERS.map(|name| {
            let marker = format!("{name}:{SIZE_M}").parse().unwrap();
            Set::Landing.shots(marker)
        });
        for of_marker in &shots {
            for (shot, first) in of_marker.iter().zip(&shots[0]) {
                assert_eq!(shot.path, first.path);
                assert_eq!(shot.shown().unwrap().centre, first.shown().unwrap().centre);
            }
        }
    }

    #[test]
    fn no_clutter_has_a_marker() {
        assert!(
            Set::Negatives
                .shots("rings:0.1".parse().unwrap())
                .iter()
                .all(|shot| { shot.marker.is_none() && !shot.clutter.is_empty() })
        );
    }
}
