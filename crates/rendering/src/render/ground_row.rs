//! Renders the ground and the sky, row by row.

use geometry::{Camera, Ned, Transform};

use super::exposure::Exposure;
use super::lens::Lens;
use crate::ground::{Ground, Span};

/// Reflectance of the sky.
const SKY: f32 = 0.95;
/// Reflectance of everything for a camera below the ground.
const UNDERGROUND: f32 = 0.02;
/// Maximum depth at which the ground has grain, in metres.
const MAX_GRAIN_DEPTH_M: f64 = 500.0;

/// The ground and the sky along a row of the image.
pub(super) struct GroundRow<'a> {
    ground: &'a Ground,
    lens: &'a Lens,
    v: usize,
    middle: CameraPose,
    ends: [CameraPose; 2],
    moves: bool,
}

/// A camera's position and the rows of its rotation.
#[derive(Copy, Clone)]
struct CameraPose {
    place: [f64; 3],
    turn: [[f64; 3]; 3],
}

/// Intersection of a ray with the ground.
#[derive(Copy, Clone)]
struct GroundHit {
    place_m: [f64; 2],
    /// Depth along the optical axis, in metres; negative or very large where the ray misses the ground.
    depth_m: f64,
    /// Length of the ray over the height of the camera.
    slant: f64,
}

impl CameraPose {
    fn new(ned_from_camera: &Transform<Ned, Camera>) -> Self {
        let turn = ned_from_camera.isometry.rotation.to_rotation_matrix();
        let origin = ned_from_camera.origin();
        Self {
            place: [origin.x(), origin.y(), origin.z()],
            turn: [0, 1, 2].map(|i| [0, 1, 2].map(|j| turn[(i, j)])),
        }
    }

    /// The ray through ideal image coordinates, in NED.
    fn ray(&self, ideal: [f64; 2]) -> [f64; 3] {
        self.turn.map(|row| row[0] * ideal[0] + row[1] * ideal[1] + row[2])
    }

    fn ground_hit(&self, ideal: [f64; 2]) -> GroundHit {
        let ray = self.ray(ideal);
        let depth_m = -self.place[2] / ray[2];
        let place_m = [0, 1].map(|i| self.place[i] + ray[i] * depth_m);
        let slant = (1.0 + ideal[0] * ideal[0] + ideal[1] * ideal[1]).sqrt() / ray[2];
        GroundHit { place_m, depth_m, slant }
    }
}

impl GroundHit {
    fn is_ground(&self) -> bool {
        self.depth_m > 0.0 && self.depth_m < MAX_GRAIN_DEPTH_M
    }
}

impl<'a> GroundRow<'a> {
    pub(super) fn new(ground: &'a Ground, exposure: &Exposure, lens: &'a Lens, v: usize) -> Self {
        Self {
            ground,
            lens,
            v,
            middle: CameraPose::new(&exposure.middle),
            ends: [CameraPose::new(&exposure.ends[0]), CameraPose::new(&exposure.ends[1])],
            moves: exposure.motion_px > 0.5,
        }
    }

    fn node(&self, column: usize) -> ([f64; 2], GroundHit, f32) {
        let ideal = self.lens.at_node(column, self.v);
        let hit = self.middle.ground_hit(ideal);
        let patch = if hit.is_ground() { self.ground.patch(hit.place_m) } else { 0.0 };
        (ideal, hit, patch)
    }

    /// Fills the pixels of `run` tiles from `column` on.
    pub(super) fn fill(&self, column: usize, run: usize, span: &mut [f32]) {
        if self.middle.place[2] >= 0.0 {
            span.fill(UNDERGROUND);
            return;
        }
        let (ideal, from, patch) = self.node(column);
        let (ideal_to, to, patch_to) = self.node(column + run);
        if !(from.is_ground() && to.is_ground()) {
            self.fill_horizon(ideal, ideal_to, span);
            return;
        }
        let count = span.len().max(1) as f64;
        let step = (patch_to - patch) / count as f32;
        for (index, value) in span.iter_mut().enumerate() {
            *value = patch + step * index as f32;
        }
        let middle = [0, 1].map(|i| 0.5 * (ideal[i] + ideal_to[i]));
        let smear_m = if self.moves { self.smear(middle) } else { [0.0; 2] };
        let pixel = length([0, 1].map(|i| ideal_to[i] - ideal[i])) / count;
        let footprint_m = pixel * from.depth_m * from.slant.abs().sqrt();
        let span_m = Span { from_m: from.place_m, to_m: to.place_m, smear_m, footprint_m };
        self.ground.add_grain(&span_m, span);
    }

    /// Motion of a pixel over the ground during the exposure.
    fn smear(&self, ideal: [f64; 2]) -> [f64; 2] {
        let [first, last] = self.ends.map(|pose| pose.ground_hit(ideal));
        if first.is_ground() && last.is_ground() {
            [0, 1].map(|i| last.place_m[i] - first.place_m[i])
        } else {
            [0.0; 2]
        }
    }

    /// Pixel by pixel, without grain.
    fn fill_horizon(&self, from: [f64; 2], to: [f64; 2], span: &mut [f32]) {
        let count = span.len().max(1) as f64;
        let pixel = length([0, 1].map(|i| to[i] - from[i])) / count;
        for (index, value) in span.iter_mut().enumerate() {
            let part = index as f64 / count;
            let ray = self.middle.ray([0, 1].map(|i| from[i] + (to[i] - from[i]) * part));
            let ground = (ray[2] / pixel + 0.5).clamp(0.0, 1.0) as f32;
            *value = SKY + (self.ground.mean() - SKY) * ground;
        }
    }
}

/// Euclidean length, without the range checks of `hypot`.
fn length([x, y]: [f64; 2]) -> f64 {
    (x * x + y * y).sqrt()
}
