//! How well the corners of square markers are found in pictures whose every edge is known.
#![allow(clippy::unwrap_used, reason = "a test may stop anywhere")]
#![allow(clippy::print_stdout, reason = "the figures are what one wants to read")]

mod scene;

use std::time::Instant;

use fiducial::refine::corners::refine;
use fiducial::refine::fit::{CornerGuess, Refined, Scratch};
use fiducial::refine::pattern::Pattern;
use fiducial::square_pose;
use geometry::{CameraModel, Distortion, Pixel};
use imaging::GrayView;
use nalgebra::SVector;
use scene::{Random, Scene};

/// Errors of many frames.
#[derive(Default)]
struct Errors {
    frames: usize,
    centre_px: Vec<f64>,
    /// Of the square root of the area, as a share: what makes the range wrong.
    size: Vec<f64>,
    /// Squared errors of the corners in units of their covariance; 8 on average.
    normalised: Vec<f64>,
    /// Of the pose's range, as a share.
    range: Vec<f64>,
    corner_px: Vec<f64>,
    blur_px: Vec<f64>,
    micros: Vec<f64>,
}

impl Errors {
    fn note(&mut self, scene: &Scene, refined: Option<&Refined>) {
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
        let range = |pose: &geometry::Transform<_, geometry::Marker>| {
            let origin: geometry::Point<geometry::Camera> = pose.origin();
            origin.coords.coords.norm()
        };
        if let Some(pose) = pose {
            let found = range(&pose.camera_from_marker);
            self.range.push(found / range(&scene.camera_from_marker) - 1.0);
        }
    }

    fn tell(&self, name: &str) {
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

fn area(corners: &[Pixel; 4]) -> f64 {
    let [a, b, c, d] = corners;
    ((c.x - a.x) * (d.y - b.y) - (d.x - b.x) * (c.y - a.y)) / 2.0
}

fn share(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    sorted.get(((sorted.len() as f64 - 1.0) * share).round() as usize).copied().unwrap_or(f64::NAN)
}

fn guess<'a>(
    view: GrayView<'a>,
    corners: &'a [Pixel; 4],
    camera: &'a CameraModel,
) -> CornerGuess<'a> {
    CornerGuess { view, corners, camera: Some(camera), is_near: false }
}

fn errors(scenes: usize, noises: usize, make: impl Fn(u64) -> Scene) -> Errors {
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
fn scene(focal_px: f64, range_m: f64, tilt: f64, seed: u64) -> Scene {
    let side_px = 0.15341 * focal_px / range_m;
    let window = (2.5 * side_px + 20.0) as u32;
    let mut scene = Scene::new(CameraModel::pinhole(window, window, focal_px), range_m, tilt, seed);
    let centre = scene.centre();
    let middle = f64::from(window) / 2.0;
    scene.camera.cx += (middle - centre.x).round();
    scene.camera.cy += (middle - centre.y).round();
    scene
}

/// All ranges of the thesis at both binnings, and beyond; takes minutes.
#[test]
#[ignore = "takes minutes; for who wants to see the figures"]
fn figures() {
    let far = [1.0, 2.0, 4.0, 7.0, 10.0, 13.0, 20.0, 30.0];
    let near = [1.0, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0, 13.0];
    for (focal_px, ranges) in [(1818.0, far), (909.0, near)] {
        for range_m in ranges {
            for (cells, tilt) in [(6, 0.1), (8, 0.1), (6, 0.9)] {
                let found =
                    errors(6, 10, |seed| Scene { cells, ..scene(focal_px, range_m, tilt, seed) });
                found.tell(&format!("{cells} cells, tilt {tilt}, f {focal_px}, {range_m} m"));
            }
        }
    }
}

/// What tilt does to the range; takes minutes.
#[test]
#[ignore = "takes minutes; for who wants to see the figures"]
fn ranges() {
    for (focal_px, range_m) in [(1818.0, 10.0), (1818.0, 20.0), (1818.0, 28.0), (1818.0, 36.0)] {
        for tilt in [0.0, 0.2, 0.5] {
            let found = errors(15, 8, |seed| scene(focal_px, range_m, tilt, seed));
            found.tell(&format!("f {focal_px}, {range_m} m, tilt {tilt}"));
        }
    }
}

/// Light, blur, lens and what is in the way, near and far; takes minutes.
#[test]
#[ignore = "takes minutes; for who wants to see the figures"]
fn conditions() {
    type Change = fn(&mut Scene);
    let all: [(&str, Change); 13] = [
        ("plain", |_| {}),
        ("blur 0.3", |s| s.blur_px = 0.3),
        ("blur 1.0", |s| s.blur_px = 1.0),
        ("blur 1.5", |s| s.blur_px = 1.5),
        ("white 300", |s| s.white = 300.0),
        ("white 250", |s| s.white = 250.0),
        ("black -10", |s| s.black = -10.0),
        ("dim", |s| (s.white, s.black, s.ground) = (60.0, 20.0, 40.0)),
        ("shadow", |s| s.shadow = 0.6),
        ("covered", |s| s.covered = true),
        ("inverted", |s| s.inverted = true),
        ("barrel", |s| {
            s.camera.distortion = BARREL;
        }),
        ("fisheye", |s| {
            s.camera.distortion = Distortion::KannalaBrandt([-0.01, 0.03, -0.02, 0.004]);
        }),
    ];
    for (focal_px, range_m) in [(1818.0, 3.0), (1818.0, 7.0), (1818.0, 11.0), (909.0, 13.0)] {
        for (name, change) in all {
            let found = errors(10, 5, |seed| {
                let mut scene = scene(focal_px, range_m, 0.3, seed);
                change(&mut scene);
                scene
            });
            found.tell(&format!("{name}, f {focal_px}, {range_m} m"));
        }
    }
}

/// The same from afar and from near in any light, in focus and out of it, through a lens, and half hidden. Centre (px)
/// and size (%), 95 %.
#[test]
fn corners_are_found_in_bad_light_and_behind_bent_lenses() {
    type Change = fn(&mut Scene);
    let all: [(&str, Change, [f64; 2]); 8] = [
        ("sharp", |s| s.blur_px = 0.3, [0.03, 0.1]),
        ("blurred", |s| s.blur_px = 1.5, [0.06, 0.2]),
        ("too bright", |s| s.white = 300.0, [0.03, 0.1]),
        ("too dark", |s| s.black = -10.0, [0.03, 0.1]),
        ("dim", |s| (s.white, s.black, s.ground) = (60.0, 20.0, 40.0), [0.1, 0.3]),
        ("covered", |s| s.covered = true, [0.06, 0.3]),
        ("inverted", |s| s.inverted = true, [0.03, 0.1]),
        ("barrel", |s| s.camera.distortion = BARREL, [0.03, 0.1]),
    ];
    for range_m in [5.0, 11.0] {
        for (name, change, allowed) in all {
            let found = errors(4, 5, |seed| {
                let mut scene = scene(1818.0, range_m, 0.3, seed);
                change(&mut scene);
                scene
            });
            found.tell(&format!("{name}, {range_m} m"));
            assert_eq!(found.normalised.len(), found.frames, "{name}");
            let of_size: Vec<_> = found.size.iter().map(|s| 100.0 * s.abs()).collect();
            let measured = [share(&found.centre_px, 0.95), share(&of_size, 0.95)];
            assert!(measured[0] <= allowed[0] && measured[1] <= allowed[1], "{name} {measured:?}");
        }
    }
    let found = errors(4, 5, |seed| Scene { shadow: 0.6, ..scene(1818.0, 4.0, 0.3, seed) });
    found.tell("shadow");
    assert!(share(&found.centre_px, 0.95) < 0.04);
}

const BARREL: Distortion = Distortion::BrownConrady([-0.28, 0.07, 2e-4, 2e-5, 0.0, 0.0, 0.0, 0.0]);

/// Range (m), then the most that is allowed: centre (px, median and 95 %), size (%, mean and 95 %).
#[test]
fn corners_are_found_to_a_hundredth_of_a_pixel() {
    for (focal_px, range_m, allowed) in [
        (1818.0, 3.0, [0.010, 0.04, 0.003, 0.02]),
        (1818.0, 7.0, [0.010, 0.04, 0.006, 0.04]),
        (1818.0, 10.0, [0.010, 0.04, 0.006, 0.04]),
        (1818.0, 13.0, [0.010, 0.04, 0.01, 0.06]),
        (909.0, 13.0, [0.010, 0.04, 0.04, 0.2]),
        (1818.0, 28.0, [0.012, 0.04, 0.06, 0.4]),
    ] {
        for cells in [6, 8] {
            let found = errors(8, 8, |seed| Scene { cells, ..scene(focal_px, range_m, 0.2, seed) });
            found.tell(&format!("{cells} cells, f {focal_px}, {range_m} m"));
            assert_eq!(found.normalised.len(), found.frames);
            let of_size: Vec<_> = found.size.iter().map(|s| 100.0 * s.abs()).collect();
            let mean = 100.0 * found.size.iter().sum::<f64>() / found.size.len() as f64;
            let measured = [
                share(&found.centre_px, 0.5),
                share(&found.centre_px, 0.95),
                mean.abs(),
                share(&of_size, 0.95),
            ];
            for (measured, allowed) in measured.into_iter().zip(allowed) {
                assert!(measured <= allowed, "{measured} > {allowed}");
            }
        }
    }
}

/// Of a marker that is larger than the image, what is put together of pieces is off by tens of pixels outside of it.
#[test]
fn corners_outside_of_the_image_are_found_from_far_off() {
    let mut scratch = Scratch::default();
    for seed in 0..12 {
        let mut scene = scene(1818.0, 1.0, 0.2, seed);
        // A third of a side beyond the centre, towards the middle of a side, the image ends.
        let (corners, centre) = (scene.corners(), scene.centre());
        let [from, to] = [0, 1].map(|next| corners[(seed as usize + next) % 4]);
        let [x, y] = [(from.x + to.x) / 2.0 - centre.x, (from.y + to.y) / 2.0 - centre.y];
        let size = 300;
        let half = f64::from(size) / 2.0;
        let back = half / x.abs().max(y.abs()) - 0.66;
        scene.camera.cx += (half - centre.x + back * x).round();
        scene.camera.cy += (half - centre.y + back * y).round();
        (scene.camera.width, scene.camera.height) = (size, size);
        let image = scene.developed(&scene.expose(), seed);
        let mut coarse = scene.coarse(2.0);
        let size = f64::from(size);
        let mut hidden = 0;
        for (i, corner) in coarse.iter_mut().enumerate() {
            let inside = |at: f64| (0.0..size).contains(&at);
            if !(inside(corner.x) && inside(corner.y)) {
                hidden += 1;
                corner.x += if i % 2 == 0 { 18.0 } else { -12.0 };
                corner.y += if i % 3 == 0 { -14.0 } else { 16.0 };
            }
        }
        assert!(hidden >= 1, "{seed}");
        let view = image.view().unwrap();
        let refined =
            refine(&guess(view, &coarse, &scene.camera), &scene.pattern(), &mut scratch).unwrap();
        let off_px = refined.centre.distance(&scene.centre());
        println!("{seed}: {hidden} hidden, {off_px:.4} px");
        assert!(off_px < 0.1, "{seed}: {off_px}");
    }
}

/// Squared errors in units of the covariance follow the chi-square distribution of eight unknowns: 8 on average, and
/// in one of twenty cases above 15.5.
#[test]
fn the_covariance_is_that_of_the_errors() {
    for range_m in [5.0, 10.0, 16.0] {
        let found = errors(25, 20, |seed| scene(1818.0, range_m, 0.02 * seed as f64, seed));
        found.tell(&format!("{range_m} m"));
        assert!(found.normalised.len() >= 499);
        let mean = found.normalised.iter().sum::<f64>() / found.normalised.len() as f64;
        assert!((5.5..10.0).contains(&mean), "{mean}");
        let beyond = found.normalised.iter().filter(|n| **n > 15.5).count();
        assert!(beyond * 100 <= 12 * found.normalised.len(), "{beyond}");
    }
}

/// Corners of anything, in images of anything, give an answer or none.
#[test]
fn nonsense_is_survived() {
    let mut random = Random::new(5);
    let mut scratch = Scratch::default();
    let odd = [f64::NAN, f64::INFINITY, -1e300, 1e300, 0.0, -0.5, 1e6, 65_535.0];
    let patterns =
        [Pattern::border(6, false), Pattern::border(8, true), Pattern::new(1, 0, |_, _| None)];
    for round in 0..3000 {
        let (width, height) = (1 + random.next() as usize % 60, 1 + random.next() as usize % 60);
        let kind = round % 3;
        let data: Vec<u8> = (0..width * height)
            .map(|i| match kind {
                0 => random.next() as u8,
                1 => 255 * ((i % width + i / width) % 2) as u8,
                _ => 128,
            })
            .collect();
        let view = GrayView::packed(&data, width, height).unwrap();
        let corners = [(); 4].map(|()| {
            let mut number = || match random.next() % 12 {
                0 if round % 2 == 0 => odd[random.next() as usize % odd.len()],
                _ => random.between(-20.0, 80.0),
            };
            Pixel::new(number(), number())
        });
        let mut camera = CameraModel::pinhole(width as u32, height as u32, 50.0);
        camera.distortion = [Distortion::None, BARREL, Distortion::KannalaBrandt([9.0; 4])][kind];
        for pattern in patterns.iter().flatten() {
            if let Some(found) = refine(&guess(view, &corners, &camera), pattern, &mut scratch) {
                assert!(found.corners.iter().all(|c| c.x.is_finite() && c.y.is_finite()));
                assert!(found.covariance_px2.iter().all(|c| c.is_finite()));
            }
        }
    }
}

/// For a profiler: one marker, over and over.
#[test]
#[ignore = "for a profiler"]
fn speed() {
    let scene = scene(1818.0, 10.0, 0.2, 3);
    let image = scene.developed(&scene.expose(), 1);
    let (coarse, pattern) = (scene.coarse(0.7), scene.pattern());
    let mut scratch = Scratch::default();
    let view = image.view().unwrap();
    let start = Instant::now();
    let found = (0..3000)
        .filter(|_| refine(&guess(view, &coarse, &scene.camera), &pattern, &mut scratch).is_some())
        .count();
    println!("{found}: {:.1} us each", start.elapsed().as_secs_f64() * 1e6 / 3000.0);
}
