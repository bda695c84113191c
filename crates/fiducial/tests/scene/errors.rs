//! Collects errors of refined corners over many scenes.

use std::time::Instant;

use fiducial::refine::corners::refine;
use fiducial::refine::fit::{CornerGuess, Refined, Scratch};
use fiducial::square_pose;
use geometry::{CameraModel, Distortion, Pixel, Point, Rotation, Transform, Vector};
use imaging::GrayView;
use nalgebra::SVector;

use super::Scene;

pub(crate) const BARREL: Distortion =
    Distortion::BrownConrady([-0.28, 0.07, 2e-4, 2e-5, 0.0, 0.0, 0.0, 0.0]);

/// Errors of many frames.
#[derive(Default)]
pub(crate) struct Errors {
    pub(crate) frames: usize,
    pub(crate) centre_px: Vec<f64>,
    /// Of the square root of the area, as a fraction: it causes the error of the range.
    pub(crate) size: Vec<f64>,
    /// Squared errors of the corners in units of their covariance; 8 on average.
    pub(crate) normalised: Vec<f64>,
    /// Of the pose's range, as a fraction.
    pub(crate) range: Vec<f64>,
    pub(crate) corner_px: Vec<f64>,
    pub(crate) blur_px: Vec<f64>,
    pub(crate) micros: Vec<f64>,
}

impl Errors {
    pub(crate) fn note(&mut self, scene: &Scene, refined: Option<&Refined>) {
        self.frames += 1;
        let Some(refined) = refined else { return };
        let truth = scene.corners();
        let mut error = SVector::<f64, 8>::zeros();
        for (i, (a, b)) in refined.corners.iter().zip(&truth).enumerate() {
            (error[2 * i], error[2 * i + 1]) = (a.x - b.x, a.y - b.y);
            self.corner_px.push(a.distance(b));
        }
        let Some(cholesky) = refined.covariance_px2.cholesky() else { return };
        let inverse = cholesky.inverse();
        self.normalised.push(error.dot(&(inverse * error)));
        self.centre_px.push(refined.centre.distance(&scene.centre()));
        self.size.push((area(&refined.corners) / area(&truth)).sqrt() - 1.0);
        self.blur_px.push(refined.blur_px);
        let pose =
            square_pose(&refined.corners, &refined.covariance_px2, scene.size_m, &scene.camera);
        let range = |pose: &Transform<_, geometry::Marker>| {
            let origin: Point<geometry::Camera> = pose.origin();
            origin.coords.coords.norm()
        };
        if let Some(pose) = pose {
            let found = range(&pose.camera_from_marker);
            self.range.push(found / range(&scene.camera_from_marker) - 1.0);
        }
    }

    pub(crate) fn print(&self, name: &str) {
        let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len().max(1) as f64;
        println!(
            "{name:34} {:3}/{:3} centre {:.4}/{:.4} px  corner {:.4}/{:.4}  size {:+.4} %/{:.4} %  range {:+.4} %/{:.4} % chi2 {:5.2}/{:5.1} blur {:.3} {:6.1} us",
            self.normalised.len(),
            self.frames,
            share(&self.centre_px, 0.5),
            share(&self.centre_px, 0.95),
            share(&self.corner_px, 0.5),
            share(&self.corner_px, 0.95),
            100.0 * mean(&self.size),
            100.0 * share(&self.size.iter().map(|s| s.abs()).collect::<Vec<_>>(), 0.95),
            100.0 * mean(&self.range),
            100.0 * mean(&self.range.iter().map(|s| s.abs()).collect::<Vec<_>>()),
            mean(&self.normalised),
            share(&self.normalised, 0.95),
            mean(&self.blur_px),
            // Others use the machine as well: short times are the work's own.
            share(&self.micros, 0.1),
        );
    }
}

pub(crate) fn area(corners: &[Pixel; 4]) -> f64 {
    let [a, b, c, d] = corners;
    ((c.x - a.x) * (d.y - b.y) - (d.x - b.x) * (c.y - a.y)) / 2.0
}

pub(crate) fn share(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    sorted.get(((sorted.len() as f64 - 1.0) * share).round() as usize).copied().unwrap_or(f64::NAN)
}

pub(crate) fn guess<'a>(
    view: GrayView<'a>,
    corners: &'a [Pixel; 4],
    camera: &'a CameraModel,
) -> CornerGuess<'a> {
    CornerGuess { view, corners, camera: Some(camera), is_near: false, response: None }
}

pub(crate) fn errors(scenes: usize, noises: usize, make: impl Fn(u64) -> Scene) -> Errors {
    let mut errors = Errors::default();
    let mut scratch = Scratch::default();
    for seed in 0..scenes as u64 {
        let scene = make(seed);
        let light = scene.expose();
        for noise in 0..noises as u64 {
            let image = scene.developed(&light, seed * 1000 + noise);
            let coarse = scene.coarse(1.0_f64.min(0.08 * area(&scene.corners()).sqrt()));
            let pattern = scene.pattern();
            let start = Instant::now();
            let refined = refine(
                &guess(image.view().unwrap(), &coarse, &scene.camera),
                &pattern,
                &mut scratch,
            );
            errors.micros.push(start.elapsed().as_secs_f64() * 1e6);
            errors.note(&scene, refined.as_ref());
        }
    }
    errors
}

/// Of the thesis' camera a window around the marker, which is seen at a random place of its pixels.
pub(crate) fn scene(focal_px: f64, range_m: f64, tilt: f64, seed: u64) -> Scene {
    let side_px = 0.15341 * focal_px / range_m;
    let window = (2.5 * side_px + 20.0) as u32;
    let mut scene = Scene::new(CameraModel::pinhole(window, window, focal_px), range_m, tilt, seed);
    let centre = scene.centre();
    let middle = f64::from(window) / 2.0;
    scene.camera.cx += (middle - centre.x).round();
    scene.camera.cy += (middle - centre.y).round();
    scene
}

/// The same far from the axis of a fisheye lens, by so many radians, in each of four directions in turn: the image is a window
/// around the marker there.
pub(crate) fn at_the_rim(focal_px: f64, range_m: f64, off_axis: f64, seed: u64) -> Scene {
    let mut scene = scene(focal_px, range_m, 0.3, seed);
    scene.camera.distortion = Distortion::KannalaBrandt([0.01, -0.008, 0.002, -0.0005]);
    let towards = seed as f64 * std::f64::consts::FRAC_PI_2;
    let turn = Rotation::from_rotation_vector(Vector::new(
        off_axis * towards.cos(),
        off_axis * towards.sin(),
        0.0,
    ));
    scene.camera_from_marker = Transform::new(turn, Point::origin()) * scene.camera_from_marker;
    let (centre, middle) = (scene.centre(), f64::from(scene.camera.width) / 2.0);
    scene.camera.cx += (middle - centre.x).round();
    scene.camera.cy += (middle - centre.y).round();
    scene
}
