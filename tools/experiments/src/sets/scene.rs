//! What the sets share: random generators, positions and views.

use std::f64::consts::TAU;

use geometry::{CameraModel, Pixel};
use markers::Marker;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
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
    size_px: std::ops::Range<f64>,
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
