//! Calibrates synthetic cameras from synthetic boards, and prints what the results are worth.
#![expect(clippy::print_stdout, reason = "the tables are its purpose")]

use std::time::Instant;

use calibration::{Options, calibrate_unjudged};
use geometry::Distortion;

#[path = "../tests/synthetic/mod.rs"]
mod synthetic;

use synthetic::{Taking, Truth, lenses, map_error_px, views};

fn main() {
    let seeds: u64 = std::env::args().nth(1).and_then(|arg| arg.parse().ok()).unwrap_or(3);
    for truth in lenses() {
        for seed in 0..seeds {
            one(&truth, seed);
        }
    }
}

fn one(truth: &Truth, seed: u64) {
    let views = views(&truth.camera, &Taking::default(), seed);
    let begin = Instant::now();
    let found = calibrate_unjudged(&views, truth.lens, &Options::default());
    let ms = begin.elapsed().as_secs_f64() * 1e3;
    match found {
        Err(refusal) => println!("{:12} {seed:3} {ms:6.0} ms refused: {refusal}", truth.name),
        Ok(found) => {
            let nees = nees(truth, &found);
            let c = found.camera;
            println!(
                "{:12} {seed:3} {ms:6.0} ms f {:+.4} % c {:+.3} {:+.3} map {:.3} nees {nees:.2} noise {:.3} rms {:.3} bend {:.2?} mm \
                 sure {:.3} cross {:?} error {:?} n {}",
                truth.name,
                (c.fx / truth.camera.fx - 1.0) * 100.0,
                c.cx - truth.camera.cx,
                c.cy - truth.camera.cy,
                map_error_px(&truth.camera, &c),
                found.noise_px,
                found.rms_px,
                found.bend_m.map(|b| b * 1e3),
                found.worst_uncertainty_px(),
                found.cross_validation.map(|c| (c.difference_px, c.ratio())),
                found.error_at(5.0),
                views.iter().map(|v| v.points.len()).sum::<usize>(),
            );
        }
    }
}

fn numbers(camera: &geometry::CameraModel) -> [f64; 12] {
    let mut numbers = [0.0; 12];
    numbers[..4].copy_from_slice(&[camera.fx, camera.fy, camera.cx, camera.cy]);
    match camera.distortion {
        Distortion::None => {}
        Distortion::BrownConrady(k) => numbers[4..].copy_from_slice(&k),
        Distortion::KannalaBrandt(k) => numbers[4..8].copy_from_slice(&k),
    }
    numbers
}

/// The squared error of all intrinsics by their covariance, by their number.
fn nees(truth: &Truth, found: &calibration::Calibration) -> f64 {
    let count = truth.lens.parameters();
    let (a, b) = (numbers(&truth.camera), numbers(&found.camera));
    let error = nalgebra::SVector::<f64, 12>::from_fn(|i, _| b[i] - a[i]);
    let mut covariance = found.covariance;
    for i in count..12 {
        covariance[(i, i)] = 1.0;
    }
    let scale = nalgebra::SVector::<f64, 12>::from_fn(|i, _| 1.0 / covariance[(i, i)].sqrt());
    let scaled =
        nalgebra::SMatrix::<f64, 12, 12>::from_fn(|i, j| covariance[(i, j)] * scale[i] * scale[j]);
    let error = error.component_mul(&scale);
    let Some(cholesky) = scaled.cholesky() else { return f64::NAN };
    error.dot(&cholesky.solve(&error)) / count as f64
}
