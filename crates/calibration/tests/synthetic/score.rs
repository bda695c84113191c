//! Compares a result with its truth.

use calibration::Calibration;
use geometry::{CameraModel, Distortion, Pixel, Point};
use nalgebra::{SMatrix, SVector};

use super::{Truth, map_error_px, turned_map_error_px};

/// A result against its truth.
#[derive(Copy, Clone, Debug)]
pub struct Score {
    /// The larger error of the two focal lengths.
    pub focal_percent: f64,
    /// The larger error of the principal point along an axis.
    pub principal_px: f64,
    /// The 95th percentile over the image.
    pub map_px: f64,
    /// The same after the best rotation.
    pub turned_px: f64,
    /// The squared error of all intrinsics by their covariance, by their number: 1 where the covariance is honest.
    pub nees: f64,
    /// The fraction of projections that are within one, and within 1.96, standard deviations along an axis.
    pub within: [f64; 2],
}

impl Score {
    pub fn new(truth: &Truth, found: &Calibration) -> Self {
        let (a, b) = (&truth.camera, &found.camera);
        let errors = errors(a, found);
        let share =
            |limit: f64| errors.iter().filter(|e| **e < limit).count() as f64 / errors.len() as f64;
        Self {
            focal_percent: 100.0 * (b.fx / a.fx - 1.0).abs().max((b.fy / a.fy - 1.0).abs()),
            principal_px: (b.cx - a.cx).abs().max((b.cy - a.cy).abs()),
            map_px: map_error_px(a, b),
            turned_px: turned_map_error_px(a, b),
            nees: nees(truth, found),
            within: [share(1.0), share(1.96)],
        }
    }
}

/// The errors of projections along each axis, by their standard deviations, over the image.
fn errors(truth: &CameraModel, found: &Calibration) -> Vec<f64> {
    let mut errors = Vec::new();
    for row in 0..12 {
        for column in 0..16 {
            let pixel = Pixel::new(f64::from(column) * 80.0 + 39.5, f64::from(row) * 80.0 + 39.5);
            let ray = truth.unproject(pixel);
            let other =
                ray.and_then(|ray| found.camera.project(Point::from_coords(ray.coords.into())));
            let covariance = found.projection_covariance(pixel);
            if let Some((other, covariance)) = other.zip(covariance) {
                errors.push((other.x - pixel.x).abs() / covariance[(0, 0)].sqrt());
                errors.push((other.y - pixel.y).abs() / covariance[(1, 1)].sqrt());
            }
        }
    }
    errors
}

fn numbers(camera: &CameraModel) -> [f64; 12] {
    let mut numbers = [0.0; 12];
    numbers[..4].copy_from_slice(&[camera.fx, camera.fy, camera.cx, camera.cy]);
    match camera.distortion {
        Distortion::None => {}
        Distortion::BrownConrady(k) => numbers[4..].copy_from_slice(&k),
        Distortion::KannalaBrandt(k) => numbers[4..8].copy_from_slice(&k),
    }
    numbers
}

fn nees(truth: &Truth, found: &Calibration) -> f64 {
    let count = truth.lens.parameters();
    let (a, b) = (numbers(&truth.camera), numbers(&found.camera));
    let mut covariance = found.covariance;
    for i in count..12 {
        covariance[(i, i)] = 1.0;
    }
    let scale = SVector::<f64, 12>::from_fn(|i, _| 1.0 / covariance[(i, i)].sqrt());
    let scaled = SMatrix::<f64, 12, 12>::from_fn(|i, j| covariance[(i, j)] * scale[i] * scale[j]);
    let error = SVector::<f64, 12>::from_fn(|i, _| (b[i] - a[i]) * scale[i]);
    // An invalid covariance counts as an infinite error.
    let solved = scaled.cholesky().map(|factors| factors.solve(&error));
    solved.map_or(f64::INFINITY, |solved| error.dot(&solved) / count as f64)
}
