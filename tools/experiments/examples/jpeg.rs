//! The effect of JPEG: `cargo run --release -p experiments --example jpeg -- [MARKER...]` renders frames of
//! the thesis' camera, compresses them as the air link does, and prints the detection range and the centre
//! error of each marker.
#![allow(clippy::print_stdout, reason = "a program for people at a terminal")]

use anyhow::Context;
use experiments::frame_spec::{FrameRenderer, FrameSpec};
use experiments::set::{MARKERS, SIZE_M, Set};
use experiments::sets;
use fiducial::Detector;
use geometry::{CameraModel, Roi};
use imaging::GrayImage;
use jpeg_encoder::{ColorType, Encoder};
use markers::Marker;
use node::stats::interpolated_quantile;

/// Compressions: the scale of reduction, and the JPEG quality (`None` for raw pixels).
const COMPRESSIONS: [(usize, Option<u8>); 13] = [
    (1, None),
    (1, Some(95)),
    (1, Some(90)),
    (1, Some(85)),
    (1, Some(75)),
    (1, Some(65)),
    (1, Some(55)),
    (1, Some(45)),
    (1, Some(35)),
    (1, Some(30)),
    (1, Some(20)),
    (2, Some(75)),
    (4, Some(75)),
];
/// One in this many of the thesis' positions is used.
const POSITIONS_STEP: usize = 5;

/// The results of one compression for one marker.
#[derive(Clone, Default)]
struct Cost {
    bytes: Vec<f64>,
    /// For each frame of the far set, its distance in metres and whether the marker was detected.
    far: Vec<(f64, bool)>,
    near_found: usize,
    near_frames: usize,
    errors_px: Vec<f64>,
}

fn main() -> anyhow::Result<()> {
    let mut names: Vec<String> = std::env::args().skip(1).collect();
    if names.is_empty() {
        names = MARKERS.iter().map(|name| (*name).to_owned()).collect();
    }
    println!(
        "| marker | scale | quality | kB | every frame found to | found of {{10 to 40 m}} | centre median / 95 % px |"
    );
    println!("|---|---|---|---|---|---|---|");
    let mut renderer = FrameRenderer::default();
    for name in &names {
        let marker: Marker =
            format!("{name}:{SIZE_M}").parse().with_context(|| format!("the marker {name}"))?;
        let mut costs = vec![Cost::default(); COMPRESSIONS.len()];
        for spec in sets::frames(Set::Far, marker) {
            measure(&mut renderer, &spec, &mut costs, true)?;
        }
        let near = sets::frames(Set::Positions, marker);
        for spec in near.iter().take(near.len() / 2).step_by(POSITIONS_STEP) {
            measure(&mut renderer, spec, &mut costs, false)?;
        }
        for ((scale, quality), cost) in COMPRESSIONS.iter().zip(&costs) {
            print(name, *scale, *quality, cost);
        }
    }
    Ok(())
}

fn print(name: &str, scale: usize, quality: Option<u8>, cost: &Cost) {
    let mut range_m: f64 = 0.0;
    let mut missed_m = f64::INFINITY;
    for (distance_m, found) in &cost.far {
        if !found {
            missed_m = missed_m.min(*distance_m);
        }
    }
    for (distance_m, _) in &cost.far {
        if *distance_m < missed_m {
            range_m = range_m.max(*distance_m);
        }
    }
    let far = cost.far.iter().filter(|(_, found)| *found).count();
    let at = |part| interpolated_quantile(&cost.errors_px, part).unwrap_or(f64::NAN);
    println!(
        "| {name} | {scale} | {} | {:.0} | {range_m:.0} m | {far} of {}, near {} of {} | {:.3} / {:.3} |",
        quality.map_or("raw".to_owned(), |quality| quality.to_string()),
        interpolated_quantile(&cost.bytes, 0.5).unwrap_or(f64::NAN) / 1000.0,
        cost.far.len(),
        cost.near_found,
        cost.near_frames,
        at(0.5),
        at(0.95),
    );
}

/// Runs the detector on one frame with every compression.
fn measure(
    renderer: &mut FrameRenderer,
    spec: &FrameSpec,
    costs: &mut [Cost],
    is_far: bool,
) -> anyhow::Result<()> {
    let (marker, shown) = spec.marker.zip(spec.ground_truth()).context("a marker in the frame")?;
    let model = spec.settings.model;
    let pixels = renderer.render(spec)?;
    let mut detector = Detector::new(&[marker], fiducial::Settings::default())?;
    for ((scale, quality), cost) in COMPRESSIONS.iter().zip(costs) {
        let coarse = shrunk(&pixels, &model, *scale);
        let (image, bytes) = match quality {
            Some(quality) => through_jpeg(&coarse, *quality)?,
            None => (coarse, pixels.len()),
        };
        cost.bytes.push(bytes as f64);
        let (width, height) = (image.width() as u32, image.height() as u32);
        let roi = Roi::binned(0.0, 0.0, width, height, *scale as f64);
        let camera = roi.camera(&model);
        let seen = detector.detect(image.view().context("an image")?, Some(&camera), &mut ());
        let off_px = seen
            .iter()
            .map(|seen| roi.to_frame(seen.centre).distance(&shown.centre))
            .fold(f64::INFINITY, f64::min);
        let found = off_px < 0.25 * model.fx * SIZE_M / shown.camera_from_marker.origin().z();
        if is_far {
            cost.far.push((shown.camera_from_marker.origin().z().round(), found));
        } else {
            cost.near_frames += 1;
            cost.near_found += usize::from(found);
            cost.errors_px.extend(found.then_some(off_px));
        }
    }
    Ok(())
}

/// Means of `scale` x `scale` pixels.
fn shrunk(pixels: &[u8], model: &CameraModel, scale: usize) -> GrayImage {
    let wide = model.width as usize;
    let (width, height) = (wide / scale, model.height as usize / scale);
    let mut image = GrayImage::filled(width, height, 0);
    for v in 0..height {
        for (u, pixel) in image.row_mut(v).iter_mut().enumerate() {
            let block = (0..scale * scale).map(|i| {
                let (x, y) = (u * scale + i % scale, v * scale + i / scale);
                u32::from(pixels.get(y * wide + x).copied().unwrap_or(0))
            });
            let area = (scale * scale) as u32;
            *pixel = ((block.sum::<u32>() + area / 2) / area) as u8;
        }
    }
    image
}

fn through_jpeg(image: &GrayImage, quality: u8) -> anyhow::Result<(GrayImage, usize)> {
    let mut bytes = Vec::new();
    let (width, height) = (u16::try_from(image.width())?, u16::try_from(image.height())?);
    Encoder::new(&mut bytes, quality).encode(image.pixels(), width, height, ColorType::Luma)?;
    let decoded = image::load_from_memory(&bytes)?.into_luma8();
    let mut out = GrayImage::filled(image.width(), image.height(), 0);
    out.pixels_mut().copy_from_slice(decoded.as_raw());
    Ok((out, bytes.len()))
}
