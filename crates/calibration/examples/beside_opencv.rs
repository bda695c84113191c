//! The same points calibrated here and by OpenCV: synthetic boards, whose truth is known, and photographs of chessboards.
#![expect(clippy::print_stdout, reason = "the tables are its purpose")]

use std::time::Instant;

use calibration::{Lens, Options, calibrate, calibrate_unjudged};
use geometry::CameraModel;

#[path = "../tests/opencv/mod.rs"]
mod opencv;
#[path = "../tests/synthetic/mod.rs"]
mod synthetic;

use synthetic::{Taking, Truth, lenses, map_error_px, views};

fn main() {
    let seed = std::env::args().nth(1).and_then(|arg| arg.parse().ok()).unwrap_or(0);
    println!("synthetic: f in %, principal point and map in px, against the truth");
    for truth in lenses() {
        for bend in [0.0, 1.0] {
            synthetic(&truth, bend, seed);
        }
    }
    println!("photographs of chessboards of 30 mm: RMS, f and principal point in px");
    for set in opencv::photographs() {
        photographed(&set);
    }
}

fn synthetic(truth: &Truth, bend: f64, seed: u64) {
    let usual = Taking::default();
    let taking = Taking { bend_m: usual.bend_m.map(|m| m * bend), ..usual };
    let views = views(&truth.camera, &taking, seed);
    let begin = Instant::now();
    let ours = calibrate(&views, truth.lens, &Options::default());
    let seconds = begin.elapsed().as_secs_f64();
    let errors = |camera: &CameraModel| {
        let t = &truth.camera;
        format!(
            "f {:.4} % c {:.3} map {:.3}",
            100.0 * (camera.fx / t.fx - 1.0).abs().max((camera.fy / t.fy - 1.0).abs()),
            (camera.cx - t.cx).abs().max((camera.cy - t.cy).abs()),
            map_error_px(t, camera)
        )
    };
    let head = format!("{:13} bend {:.0} mm", truth.name, taking.bend_m[0] * 1e3);
    match &ours {
        Ok(ours) => {
            println!(
                "{head} here   {} rms {:.4} {seconds:.2} s",
                errors(&ours.camera),
                ours.rms_px
            );
        }
        Err(refusal) => println!("{head} here   {refusal}"),
    }
    match opencv::solve(&views, truth.lens) {
        None => {}
        Some(Err(problem)) => println!("{head} OpenCV {problem}"),
        Some(Ok(found)) => println!(
            "{head} OpenCV {} rms {:.4} {:.2} s, {:.1} times ours",
            errors(&found.camera),
            found.rms_px,
            found.seconds,
            found.seconds / seconds
        ),
    }
}

fn photographed(set: &opencv::Photographs) {
    let lens = Lens::BrownConrady5;
    let head = format!("{:36} {:2} views", set.name, set.views.len());
    for solve_bend in [false, true] {
        let ours = match calibrate_unjudged(&set.views, lens, &Options { solve_bend }) {
            Ok(ours) => ours,
            Err(refusal) => {
                println!("{head} {refusal}");
                continue;
            }
        };
        let (c, sigma) = (ours.camera, |i: usize| ours.covariance[(i, i)].sqrt());
        println!(
            "{head} here, {} rms {:.4} f {:.2} {:.2} +- {:.2} c {:.2} {:.2} +- {:.2} bend {:.1?} mm",
            if solve_bend { "bent" } else { "flat" },
            ours.rms_px,
            c.fx,
            c.fy,
            sigma(0),
            c.cx,
            c.cy,
            sigma(2),
            ours.bend_m.map(|m| m * 1e3),
        );
        if !solve_bend && let Some(Ok(found)) = opencv::solve(&set.views, lens) {
            let d = found.camera;
            let differences = [d.fx - c.fx, d.fy - c.fy, d.cx - c.cx, d.cy - c.cy];
            let sigmas: Vec<String> =
                (0..4).map(|i| format!("{:+.2}", differences[i] / sigma(i))).collect();
            println!(
                "{head} OpenCV     rms {:.4} f {:.2} {:.2} c {:.2} {:.2}, differences in sigma {}",
                found.rms_px,
                d.fx,
                d.fy,
                d.cx,
                d.cy,
                sigmas.join(" ")
            );
        }
    }
    if let Err(refusal) = calibrate(&set.views, lens, &Options::default()) {
        println!("{head} refused: {refusal}");
    }
}
