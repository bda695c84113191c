//! Accuracy and time of the refined corners of square markers, in minutes:
//! `cargo run --release -p fiducial --example square_accuracy -- [figures|ranges|conditions|speed]`.
#![allow(clippy::unwrap_used, reason = "a measurement may stop anywhere")]
#![allow(clippy::print_stdout, reason = "the figures are what one wants to read")]

#[path = "../tests/scene/mod.rs"]
mod scene;

use std::time::Instant;

use fiducial::refine::corners::refine;
use fiducial::refine::fit::Scratch;
use geometry::Distortion;
use scene::Scene;
use scene::errors::{BARREL, errors, guess, scene};

fn main() {
    match std::env::args().nth(1).as_deref() {
        Some("ranges") => ranges(),
        Some("conditions") => conditions(),
        Some("speed") => speed(),
        _ => figures(),
    }
}

/// All ranges of the thesis at both binnings, and beyond.
fn figures() {
    let far = [1.0, 2.0, 4.0, 7.0, 10.0, 13.0, 20.0, 30.0];
    let near = [1.0, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0, 13.0];
    for (focal_px, ranges) in [(1818.0, far), (909.0, near)] {
        for range_m in ranges {
            for (cells, tilt) in [(6, 0.1), (8, 0.1), (6, 0.9)] {
                let found =
                    errors(6, 10, |seed| Scene { cells, ..scene(focal_px, range_m, tilt, seed) });
                found.print(&format!("{cells} cells, tilt {tilt}, f {focal_px}, {range_m} m"));
            }
        }
    }
}

/// The effect of tilt on the range.
fn ranges() {
    for (focal_px, range_m) in [(1818.0, 10.0), (1818.0, 20.0), (1818.0, 28.0), (1818.0, 36.0)] {
        for tilt in [0.0, 0.2, 0.5] {
            let found = errors(15, 8, |seed| scene(focal_px, range_m, tilt, seed));
            found.print(&format!("f {focal_px}, {range_m} m, tilt {tilt}"));
        }
    }
}

/// Light, blur, lens and what is in the way, near and far.
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
            found.print(&format!("{name}, f {focal_px}, {range_m} m"));
        }
    }
}

/// One marker again and again, for a profiler.
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
