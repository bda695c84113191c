//! Helpers for all sets: random generators, positions and views.

use std::f64::consts::TAU;
use std::ops::Range;

use geometry::{CameraModel, Pixel};
use markers::Marker;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rendering::occluder::Disc;
use rendering::{CameraSettings, Surface};

use crate::frame_spec::{FrameSpec, Tilt, pose};
use crate::set::{SIZE_M, Set};

/// One draw of all sets.
#[derive(Clone, Copy, Debug)]
pub(super) struct Draw {
    /// Its seed; 0 has the frames on which the detector was developed.
    pub(super) seed: u64,
}

/// One frame of a set.
#[derive(Clone, Copy, Debug)]
pub(super) struct DrawnFrame {
    draw: Draw,
    set: Set,
    frame: usize,
}

impl Draw {
    /// A frame of a set.
    pub(super) fn frame(self, set: Set, frame: usize) -> DrawnFrame {
        DrawnFrame { draw: self, set, frame }
    }

    /// The random generator and the seed of one frame of a set.
    pub(super) fn frame_rng(self, set: Set, frame: usize) -> (ChaCha8Rng, u64) {
        /// Further than any two frames of one draw are apart.
        const APART: u64 = 1 << 32;
        let in_draw = 1000 * (set.name().bytes().map(u64::from).sum::<u64>()) + frame as u64;
        let seed = in_draw.wrapping_add(self.seed.wrapping_mul(APART));
        (ChaCha8Rng::seed_from_u64(seed), seed)
    }
}

/// A random pixel at most `by_px` from another, along both axes.
pub(super) fn near(rng: &mut ChaCha8Rng, pixel: Pixel, by_px: f64) -> Pixel {
    Pixel::new(pixel.x + rng.random_range(-by_px..by_px), pixel.y + rng.random_range(-by_px..by_px))
}

/// The principal point.
pub(super) fn centre(model: &CameraModel) -> Pixel {
    Pixel::new(model.cx, model.cy)
}

/// The marker with another id of its family, unless `number` is 0.
pub(super) fn with_id(marker: Marker, number: usize) -> Marker {
    let id = marker.family.id_count().map(|count| (number as u32 * 7) % count);
    Marker { id: if number == 0 { marker.id } else { id }, ..marker }
}

/// A random view of a marker: its size in the image within `size_px`, tilted by up to `max_tilt`.
pub(super) fn view(
    drawn: DrawnFrame,
    marker: Marker,
    settings: CameraSettings,
    size_px: Range<f64>,
    max_tilt: f64,
) -> (FrameSpec, ChaCha8Rng) {
    let frame = drawn.frame;
    let (mut rng, seed) = drawn.draw.frame_rng(drawn.set, frame);
    let model = settings.model;
    let distance_m = model.fx * SIZE_M / rng.random_range(size_px);
    let at = near(&mut rng, centre(&model), 200.0);
    let tilt = Tilt { angle: rng.random_range(0.0..=max_tilt), about: rng.random_range(0.0..TAU) };
    let heading = rng.random_range(0.0..TAU);
    let pose = pose(&model, at, distance_m, tilt, heading);
    let mut spec = FrameSpec::new(with_id(marker, frame), settings, pose, seed);
    spec.surface = Surface::ALL[frame % 3];
    (spec, rng)
}

/// A random pixel on or near the marker: up to `reach` of its size from its centre along both axes.
pub(super) fn on_marker(spec: &FrameSpec, rng: &mut ChaCha8Rng, reach: f64) -> Pixel {
    let by_px = reach * spec.size_px();
    let centre = spec.ground_truth().map_or(Pixel::new(0.0, 0.0), |shown| shown.centre);
    near(rng, centre, by_px)
}

/// Discs at random pixels on or near the marker, with radii in its sizes.
pub(super) fn discs(
    spec: &FrameSpec,
    rng: &mut ChaCha8Rng,
    count: Range<i32>,
    reach: f64,
    radius: Range<f64>,
) -> Vec<Disc> {
    (0..rng.random_range(count))
        .map(|_| Disc {
            centre: on_marker(spec, rng, reach),
            radius_px: (spec.size_px() * rng.random_range(radius.clone())) as f32,
        })
        .collect()
}
