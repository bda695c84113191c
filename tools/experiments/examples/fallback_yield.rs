//! The yield of each fallback pass: counts, over the rendered sets, the markers that only this pass finds, and measures
//! its time per frame.
//!
//! ```text
//! cargo run --release -p experiments --example fallback_yield -- [--every N] [--seed N] [--processing PRESET]... [--set SET]... [MARKER...]
//! cargo run --release -p experiments --example fallback_yield -- --photographs FOLDER
//! ```
//!
//! Of each SET (all unless named) every N-th frame is used, as a camera of each PRESET shows it. FOLDER has photographs with `labels.jsonl`.
#![allow(clippy::print_stdout, reason = "a program for people at a terminal")]

use std::path::PathBuf;
use std::time::Instant;

use anyhow::Context;
use experiments::frame_spec::{FrameRenderer, FrameSpec};
use experiments::photographs;
use experiments::record::Found;
use experiments::set::{MARKERS, SIZE_M, Set};
use experiments::sets::{Variant, frames_of};
use fiducial::{Detector, FallbackPass, PassSchedule, Settings};
use geometry::CameraModel;
use imaging::GrayView;
use markers::Marker;
use rendering::Preset;

/// The yield of one pass.
#[derive(Clone, Copy, Default)]
struct Yield {
    /// Markers that are found with all passes, and not without this one.
    only: usize,
    /// Markers that this pass finds alone, and that are not found without any pass.
    alone: usize,
    /// Time of a detection with this pass alone over that without any, in seconds; in images in which nothing is found
    /// without a pass.
    seconds: f64,
}

/// The sums over all images of a marker.
#[derive(Clone, Default)]
struct Sums {
    shown: usize,
    found: usize,
    without_any: usize,
    /// Images in which nothing is found without a pass.
    searched: usize,
    passes: [Yield; FallbackPass::ALL.len()],
    /// Markers that only one pass finds: its number, the set and the group.
    groups: Vec<(usize, &'static str, String)>,
}

#[derive(Default)]
struct Arguments {
    every: usize,
    seed: u64,
    presets: Vec<Preset>,
    sets: Vec<Set>,
    photographs: Option<PathBuf>,
    markers: Vec<String>,
}

fn arguments() -> anyhow::Result<Arguments> {
    let mut read = Arguments { every: 1, ..Arguments::default() };
    let mut words = std::env::args().skip(1);
    while let Some(word) = words.next() {
        let mut value = || words.next().with_context(|| format!("{word} needs a value"));
        match word.as_str() {
            "--every" => read.every = value()?.parse().context("--every")?,
            "--seed" => read.seed = value()?.parse().context("--seed")?,
            "--processing" => {
                read.presets.push(value()?.parse::<Preset>().map_err(anyhow::Error::msg)?);
            }
            "--set" => read.sets.push(value()?.parse::<Set>().map_err(anyhow::Error::msg)?),
            "--photographs" => read.photographs = Some(value()?.into()),
            _ => read.markers.push(word),
        }
    }
    if read.presets.is_empty() {
        read.presets.push(Preset::Linear);
    }
    if read.sets.is_empty() {
        read.sets.extend(Set::ALL);
    }
    if read.markers.is_empty() {
        read.markers = MARKERS.iter().map(|name| (*name).to_owned()).collect();
    }
    Ok(read)
}

fn main() -> anyhow::Result<()> {
    let Arguments { every, seed, presets, sets, photographs, markers } = arguments()?;
    println!("| marker | pass | only this pass | fraction of found | this pass alone | ms |");
    println!("|---|---|---|---|---|---|");
    if let Some(folder) = photographs {
        for family in photographs::labelled_families() {
            let mut sums = Sums::default();
            let mut detector = Detector::new(&[photographs::any_of(family)], Settings::default())?;
            for labelled in photographs::labelled(&folder, family)? {
                let labelled = labelled?;
                let image = &labelled.image;
                let (width, height) = (image.width() as usize, image.height() as usize);
                let view = GrayView::packed(image.as_raw(), width, height).context("an image")?;
                sums.shown += labelled.shown();
                sums.measure(("photographs", ""), |schedule| {
                    let begin = Instant::now();
                    let seen = detector.detect_with(view, None, schedule, &mut ());
                    let seconds = begin.elapsed().as_secs_f64();
                    let found: Vec<Found> = seen.iter().map(Found::from).collect();
                    (labelled.found(&found), seconds)
                });
            }
            print(family.name(), &sums);
        }
        return Ok(());
    }
    let mut renderer = FrameRenderer::default();
    for preset in presets {
        for name in &markers {
            let marker: Marker =
                format!("{name}:{SIZE_M}").parse().with_context(|| format!("the marker {name}"))?;
            // Frames of a set show different ids.
            let any = Marker { id: None, ..marker };
            let mut detector = Detector::new(&[any], Settings::default())?;
            let mut sums = Sums::default();
            for set in sets.iter().copied() {
                let variant = Variant { seed, processing: preset, every, is_binned: false };
                for spec in &frames_of(set, marker, variant) {
                    measure(&mut renderer, &mut detector, (set.name(), spec), &mut sums)?;
                }
            }
            print(&format!("{name}, {preset}"), &sums);
        }
    }
    Ok(())
}

/// Times are of images in which a pass has to run, found or not.
fn print(name: &str, sums: &Sums) {
    let Sums { shown, found, without_any, searched, .. } = *sums;
    println!("| {name} | all | {found} of {shown} | | without any {without_any} | |");
    for (index, (pass, result)) in FallbackPass::ALL.iter().zip(&sums.passes).enumerate() {
        let share = 100.0 * result.only as f64 / found.max(1) as f64;
        let ms = 1e3 * result.seconds / searched.max(1) as f64;
        let mut groups: Vec<_> = sums.groups.iter().filter(|(of, ..)| *of == index).collect();
        groups.sort();
        let groups: Vec<String> = groups
            .chunk_by(|a, b| a == b)
            .filter_map(|same| {
                same.first().map(|(_, set, of)| format!("{set} {of} {}", same.len()))
            })
            .collect();
        println!(
            "| | {pass:?} | {} | {share:.2} % | {} | {ms:.2} | {} |",
            result.only,
            result.alone,
            groups.join(", ")
        );
    }
}

impl Sums {
    /// Counts the markers of one image that are found with each schedule of interest. `detect` returns their number and
    /// the time.
    fn measure(
        &mut self,
        (set, group): (&'static str, &str),
        mut detect: impl FnMut(PassSchedule) -> (usize, f64),
    ) {
        let (with_all, _) = detect(PassSchedule::ALL);
        let (without_any, base_s) = detect(PassSchedule::NONE);
        self.found += with_all;
        self.without_any += without_any;
        // On boards a pass may add to earlier detections.
        if without_any > 0 && with_all <= without_any {
            return;
        }
        let is_empty = without_any == 0;
        self.searched += usize::from(is_empty);
        for (index, pass) in FallbackPass::ALL.into_iter().enumerate() {
            let (alone, seconds) = detect(PassSchedule::only(pass));
            let result = &mut self.passes[index];
            result.alone += alone.saturating_sub(without_any);
            if is_empty {
                result.seconds += seconds - base_s;
            }
            if with_all > without_any {
                let (without, _) = detect(PassSchedule::ALL.without(pass));
                let only = with_all.saturating_sub(without);
                self.passes[index].only += only;
                self.groups.extend((0..only).map(|_| (index, set, group.to_owned())));
            }
        }
    }
}

fn measure(
    renderer: &mut FrameRenderer,
    detector: &mut Detector,
    (set, spec): (&'static str, &FrameSpec),
    sums: &mut Sums,
) -> anyhow::Result<()> {
    let pixels = renderer.render(spec)?;
    let model = spec.settings.model;
    let (width, height) = (model.width as usize, model.height as usize);
    let view = GrayView::new(&pixels, width, height, width).context("an image")?;
    let truth = spec.ground_truth();
    sums.shown += usize::from(spec.marker.is_some());
    sums.measure((set, &spec.group), |schedule| {
        let begin = Instant::now();
        let found = detector.detect_with(view, Some(&model), schedule, &mut ());
        let seconds = begin.elapsed().as_secs_f64();
        let is_true = |truth: &experiments::frame_spec::GroundTruth| {
            let radius_px = 0.25 * size_px(&model, truth.camera_from_marker.origin().z());
            found.iter().any(|seen| seen.centre.distance(&truth.centre) < radius_px)
        };
        (usize::from(truth.as_ref().is_some_and(is_true)), seconds)
    });
    Ok(())
}

fn size_px(model: &CameraModel, distance_m: f64) -> f64 {
    model.fx * SIZE_M / distance_m
}
