//! Calibrates synthetic cameras from synthetic boards, and prints what the results are worth.
#![expect(clippy::print_stdout, clippy::print_stderr, reason = "the tables are its purpose")]

use std::time::Instant;

use calibration::{Calibration, Options, calibrate_unjudged};
use geometry::{CameraModel, Distortion, Pixel, Point};

#[path = "../tests/synthetic/mod.rs"]
mod synthetic;

use synthetic::{Taking, Truth, lenses, map_error_px, views};

fn main() {
    let number = |at: usize, default: u64| {
        std::env::args().nth(at).and_then(|arg| arg.parse().ok()).unwrap_or(default)
    };
    let (solves, first_seed) = (number(1, 10), number(2, 0));
    println!(
        "{:14} {:>6} {:>24} {:>24} {:>24} {:>6} {:>12} {:>6}",
        "lens", "solves", "f %", "c px", "map px", "NEES", "coverage", "ms"
    );
    for truth in lenses() {
        let solved = (0..solves).map(|i| Solved::new(&truth, first_seed + i)).collect::<Vec<_>>();
        let of = |value: fn(&Solved) -> f64| solved.iter().map(value).collect::<Vec<_>>();
        println!(
            "{:14} {:6} {:>24} {:>24} {:>24} {:6.2} {:>12} {:6.0}",
            truth.name,
            solves,
            spread(of(|s| s.focal_percent)),
            spread(of(|s| s.principal_px)),
            spread(of(|s| s.map_px)),
            mean(&of(|s| s.nees)),
            format!(
                "{:.0}/{:.0} %",
                mean(&of(|s| s.within_1)) * 100.0,
                mean(&of(|s| s.within_2)) * 100.0
            ),
            mean(&of(|s| s.ms)),
        );
        println!(
            "   cross {} noise {} lateral cm {} points {:.0}",
            spread(of(|s| s.cross)),
            spread(of(|s| s.noise)),
            spread(of(|s| s.lateral)),
            mean(&of(|s| s.points))
        );
    }
}

/// One solve against its truth.
struct Solved {
    focal_percent: f64,
    principal_px: f64,
    map_px: f64,
    nees: f64,
    within_1: f64,
    within_2: f64,
    cross: f64,
    noise: f64,
    lateral: f64,
    points: f64,
    ms: f64,
}

impl Solved {
    fn new(truth: &Truth, seed: u64) -> Self {
        let views = views(&truth.camera, &Taking::default(), seed);
        let begin = Instant::now();
        let found = match calibrate_unjudged(&views, truth.lens, &Options::default()) {
            Ok(found) => found,
            Err(refusal) => {
                eprintln!("{} {seed}: {refusal}", truth.name);
                eprintln!("{:?}", truth.camera);
                std::process::exit(1);
            }
        };
        let ms = begin.elapsed().as_secs_f64() * 1e3;
        let (a, b) = (&truth.camera, &found.camera);
        let errors = coverage(a, &found);
        let share =
            |limit: f64| errors.iter().filter(|e| **e < limit).count() as f64 / errors.len() as f64;
        Self {
            focal_percent: 100.0 * (b.fx / a.fx - 1.0).abs().max((b.fy / a.fy - 1.0).abs()),
            principal_px: (b.cx - a.cx).abs().max((b.cy - a.cy).abs()),
            map_px: map_error_px(a, b),
            nees: nees(truth, &found),
            within_1: share(1.0),
            within_2: share(1.96),
            cross: found.cross_validation.map_or(f64::NAN, |c| c.ratio()),
            noise: found.noise_px,
            lateral: 100.0 * found.error_at(5.0).lateral_m,
            points: views.iter().map(|v| v.points.len() as f64).sum(),
            ms,
        }
    }
}

/// The errors of projections along each axis, by their standard deviations, over the image.
fn coverage(truth: &CameraModel, found: &Calibration) -> Vec<f64> {
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

/// Median, 95 of 100, largest.
fn spread(mut values: Vec<f64>) -> String {
    values.sort_by(f64::total_cmp);
    let at = |share: usize| values[((values.len() * share).div_ceil(100)).max(1) - 1];
    format!("{:.4} {:.4} {:.4}", at(50), at(95), at(100))
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
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
