//! The yield of each fallback pass: `cargo run --release -p experiments --example fallback_yield -- [STEP [MARKER...]]`
//! counts, over the rendered sets, the markers that only this pass finds, and measures its time per frame. Of each set
//! every STEP-th frame is used.
#![allow(clippy::print_stdout, reason = "a program for people at a terminal")]

use std::time::Instant;

use anyhow::Context;
use experiments::frame_spec::{FrameRenderer, FrameSpec};
use experiments::set::{MARKERS, SIZE_M, Set};
use experiments::sets;
use fiducial::{Detector, FallbackPass, PassSchedule, Settings};
use geometry::CameraModel;
use imaging::GrayView;
use markers::Marker;

/// What one pass adds.
#[derive(Clone, Copy, Default)]
struct Yield {
    /// Markers that are found with all passes, and not without this one.
    only: usize,
    /// Markers that this pass finds alone, and that are not found without any pass.
    alone: usize,
    /// Time of a detection with this pass alone over that without any, in seconds; in frames in which nothing is found
    /// without a pass.
    seconds: f64,
}

/// The sums over all frames of a marker.
#[derive(Clone, Copy, Default)]
struct Sums {
    shown: usize,
    found: usize,
    without_any: usize,
    searched: usize,
    passes: [Yield; FallbackPass::ALL.len()],
}

fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let step = arguments.next().map_or(Ok(1), |step| step.parse::<usize>()).context("STEP")?;
    let mut names: Vec<String> = arguments.collect();
    if names.is_empty() {
        names = MARKERS.iter().map(|name| (*name).to_owned()).collect();
    }
    println!("| marker | pass | only this pass | share of found | this pass alone | ms |");
    println!("|---|---|---|---|---|---|");
    let mut renderer = FrameRenderer::default();
    for name in &names {
        let marker: Marker =
            format!("{name}:{SIZE_M}").parse().with_context(|| format!("the marker {name}"))?;
        let mut detector = Detector::new(&[marker], Settings::default())?;
        let mut sums = Sums::default();
        for set in Set::ALL {
            for spec in sets::frames(set, marker).iter().step_by(step.max(1)) {
                measure(&mut renderer, &mut detector, spec, &mut sums)?;
            }
        }
        print(name, &sums);
    }
    Ok(())
}

fn print(name: &str, sums: &Sums) {
    let Sums { shown, found, without_any, searched, .. } = *sums;
    println!("| {name} | all | {found} of {shown} | | without any {without_any} | |");
    for (pass, result) in FallbackPass::ALL.iter().zip(&sums.passes) {
        let share = 100.0 * result.only as f64 / found.max(1) as f64;
        let ms = 1e3 * result.seconds / searched.max(1) as f64;
        println!("| | {pass:?} | {} | {share:.2} % | {} | {ms:.2} |", result.only, result.alone);
    }
}

fn measure(
    renderer: &mut FrameRenderer,
    detector: &mut Detector,
    spec: &FrameSpec,
    sums: &mut Sums,
) -> anyhow::Result<()> {
    let pixels = renderer.render(spec)?;
    let model = spec.settings.model;
    let (width, height) = (model.width as usize, model.height as usize);
    let view = GrayView::new(&pixels, width, height, width).context("an image")?;
    let truth = spec.ground_truth();
    let mut is_found = |schedule: PassSchedule| -> (bool, f64) {
        let begin = Instant::now();
        let found = detector.detect_with(view, Some(&model), schedule, &mut ());
        let seconds = begin.elapsed().as_secs_f64();
        let is_true = |truth: &experiments::frame_spec::GroundTruth| {
            let radius_px = 0.25 * size_px(&model, truth.camera_from_marker.origin().z());
            found.iter().any(|seen| seen.centre.distance(&truth.centre) < radius_px)
        };
        (truth.as_ref().is_some_and(is_true), seconds)
    };
    let (with_all, _) = is_found(PassSchedule::ALL);
    let (without_any, base_s) = is_found(PassSchedule::NONE);
    sums.shown += usize::from(spec.marker.is_some());
    sums.found += usize::from(with_all);
    sums.without_any += usize::from(without_any);
    if without_any {
        return Ok(());
    }
    sums.searched += 1;
    for (pass, result) in FallbackPass::ALL.into_iter().zip(&mut sums.passes) {
        let (alone, seconds) = is_found(PassSchedule::only(pass));
        result.alone += usize::from(alone);
        result.seconds += seconds - base_s;
        if with_all {
            let (without, _) = is_found(PassSchedule::ALL.without(pass));
            result.only += usize::from(!without);
        }
    }
    Ok(())
}

fn size_px(model: &CameraModel, distance_m: f64) -> f64 {
    model.fx * SIZE_M / distance_m
}
