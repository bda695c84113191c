//! Fits `world::vision::RINGS`, the model of the errors of the detector `rings`, to rendered frames:
//! `cargo run --release -p experiments --example fit_vision [FRAMES [FILE.svg]]`.
//!
//! The frames have the simulator's default camera and pad, distances from 0.4 to 25 m, tilts up to 20 degrees,
//! any position in the image, and up to 6 pixels of motion blur. Below the table are the parameters for
//! `RINGS`; the plot shows the errors and the standard deviation of the model.

#![allow(clippy::print_stdout, reason = "a program's output")]

use std::sync::Mutex;

use anyhow::Context;
use experiments::landing::plots::{COLOURS, picture};
use experiments::landing::sim_vision::errors;
use fiducial::Detector;
use geometry::{Point, Rotation, Transform, Vector};
use imaging::GrayView;
use node::Layers;
use node::stats::quantile;
use plotters::prelude::*;
use simulator::camera::{FrameRequest, SimCamera};
use world::drift::{random_stream, uniform};
use world::vehicle::{Vehicle, VehicleConfig, VehicleTruth};
use world::vision::{RINGS, VisionModel};

/// The result of one frame: size and blur in pixels; the errors, and the stated deviations of centre and
/// range.
struct Sample {
    size_px: f64,
    blur_px: f64,
    found: Option<([f64; 4], [f64; 2])>,
}

fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let frames: u64 = arguments.next().map_or(Ok(1000), |n| n.parse())?;
    let samples = Mutex::new(Vec::new());
    let threads = std::thread::available_parallelism().map_or(1, std::num::NonZero::get) as u64;
    std::thread::scope(|scope| {
        let workers: Vec<_> = (0..threads)
            .map(|first| {
                let samples = &samples;
                scope.spawn(move || -> anyhow::Result<()> {
                    let mut fitter = Fitter::new()?;
                    for seed in (first..frames).step_by(threads as usize) {
                        if let Some(sample) = fitter.sample(seed)? {
                            let mut samples =
                                samples.lock().map_err(|_| anyhow::anyhow!("a thread panicked"))?;
                            samples.push((seed, sample));
                        }
                    }
                    Ok(())
                })
            })
            .collect();
        workers
            .into_iter()
            .try_for_each(|w| w.join().map_err(|_| anyhow::anyhow!("a thread panicked"))?)
    })?;
    let mut samples = samples.into_inner()?;
    samples.sort_by_key(|(seed, _)| *seed);
    let samples: Vec<Sample> = samples.into_iter().map(|(_, sample)| sample).collect();
    table(&samples);
    print_model(&samples);
    if let Some(file) = arguments.next() {
        std::fs::write(&file, plot(&samples)?).with_context(|| format!("writing {file}"))?;
    }
    Ok(())
}

struct Fitter {
    camera: SimCamera,
    detector: Detector,
    pixels: Vec<u8>,
    still: VehicleTruth,
    pad: world::pad::PadState,
    marker_m: f64,
}

impl Fitter {
    fn new() -> anyhow::Result<Self> {
        let config = Layers { file: None, set: Vec::new() }.load::<simulator::Config>()?.settings;
        let marker = config.pad_marker().map_err(anyhow::Error::msg)?;
        let camera = SimCamera::new(&config)?;
        let model = camera.settings().model;
        Ok(Self {
            detector: Detector::new(&[marker], fiducial::Settings::default())?,
            pixels: vec![0; model.width as usize * model.height as usize],
            still: Vehicle::new(VehicleConfig::default(), 1).truth(),
            pad: config.pad.config().at(None),
            marker_m: marker.size_m.unwrap_or_default(),
            camera,
        })
    }

    /// The result for the frame of a seed; `None` when the marker is not completely in the image.
    fn sample(&mut self, seed: u64) -> anyhow::Result<Option<Sample>> {
        let mut random = random_stream(seed, 77);
        let [depth, tilt, about, u, v, heading, blur, towards] =
            [(); 8].map(|()| uniform(&mut random));
        let turn = std::f64::consts::TAU;
        let settings = self.camera.settings().clone();
        let model = settings.model;
        let depth_m = 0.4 * (25.0_f64 / 0.4).powf(depth);
        let (tilt, about) = (20.0_f64.to_radians() * tilt, turn * about);
        let ned_from_body =
            Rotation::from_euler(tilt * about.cos(), tilt * about.sin(), turn * heading);
        let pixel = geometry::Pixel::new(u * f64::from(model.width), v * f64::from(model.height));
        let ray = model.unproject_clamped(pixel);
        let in_camera = Point::origin() + ray * (depth_m / ray.z());
        let ned_from_camera =
            Transform::new(ned_from_body, Point::origin()) * settings.body_from_camera;
        let position = self.pad.position - (ned_from_camera * in_camera - Point::origin());
        // The velocity that causes this motion blur.
        let blur_px = 6.0 * blur * blur;
        let speed_m_s = blur_px * depth_m / model.fx / settings.exposure_s;
        let (sin, cos) = (turn * towards).sin_cos();
        let velocity = Vector::new(cos, sin, 0.0) * speed_m_s;
        let truth = VehicleTruth { position, ned_from_body, velocity, ..self.still };
        let request =
            FrameRequest { sequence: seed, time_s: 0.0, stamp_ns: 0, begun_s: None, pad: self.pad };
        let right = self.camera.camera_from_marker(&truth, &self.pad);
        let half = 0.5 * self.marker_m;
        let corners = [(half, half), (half, -half), (-half, half), (-half, -half)];
        let is_whole = corners.iter().all(|(x, y)| {
            model.project(right * Point::new(*x, *y, 0.0)).is_some_and(|p| model.contains(p))
        });
        if !is_whole {
            return Ok(None);
        }
        let truth_at =
            |time_s: f64| VehicleTruth { position: position + velocity * time_s, ..truth };
        self.camera.render(&request, truth_at, &mut self.pixels)?;
        let view = GrayView::packed(&self.pixels, model.width as usize, model.height as usize)
            .context("an image")?;
        let found = self.detector.detect(view, Some(&model), &mut ()).first().and_then(|seen| {
            let pose = seen.pose.as_ref()?;
            let depth_m = pose.camera_from_marker.origin().z();
            let stated = [
                seen.centre_covariance_px2.m11.max(0.0).sqrt(),
                pose.covariance.m33.max(0.0).sqrt() / depth_m,
            ];
            Some((errors(&model, &pose.camera_from_marker, &right)?, stated))
        });
        Ok(Some(Sample { size_px: self.marker_m * model.fx / right.origin().z(), blur_px, found }))
    }
}

fn rms(numbers: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = numbers.fold((0.0, 0.0), |(sum, count), n| (sum + n * n, count + 1.0));
    if count > 0.0 { (sum / count).sqrt() } else { f64::NAN }
}

/// The standard deviation from the median absolute error, which is robust against outliers.
fn deviation(numbers: impl Iterator<Item = f64>) -> f64 {
    let sizes: Vec<f64> = numbers.map(f64::abs).collect();
    quantile(&sizes, 0.5).map_or(f64::NAN, |median| median / 0.6745)
}

const SIZES_PX: [f64; 10] = [8.0, 12.0, 16.0, 20.0, 30.0, 45.0, 70.0, 110.0, 200.0, 400.0];
const BLURS_PX: [f64; 4] = [0.0, 0.5, 2.0, 6.1];

fn table(samples: &[Sample]) {
    println!(
        "| size, px | blur, px | frames | found | centre: deviation, rms, px | range: mean, deviation, rms, 1/size px \
         | tilt: deviation, deg | stated over measured deviation of centre, range |\n|---|---|---|---|---|---|---|---|"
    );
    for sizes in SIZES_PX.windows(2) {
        for blurs in BLURS_PX.windows(2) {
            let inside: Vec<&Sample> = samples
                .iter()
                .filter(|l| (sizes[0]..sizes[1]).contains(&l.size_px))
                .filter(|l| (blurs[0]..blurs[1]).contains(&l.blur_px))
                .collect();
            let found: Vec<_> = inside.iter().filter_map(|l| Some((l.size_px, l.found?))).collect();
            if found.is_empty() {
                println!(
                    "| {}-{} | {}-{} | {} | 0 |",
                    sizes[0],
                    sizes[1],
                    blurs[0],
                    blurs[1],
                    inside.len()
                );
                continue;
            }
            let centre = || found.iter().flat_map(|(_, (e, _))| [e[0], e[1]]);
            let range = || found.iter().map(|(size, (e, _))| e[2] * size);
            let mean = range().sum::<f64>() / found.len() as f64;
            let stated = |i: usize| rms(found.iter().map(|(_, (_, stated))| stated[i]));
            let range_ratio = deviation(found.iter().map(|(_, (e, _))| e[2]));
            println!(
                "| {}-{} | {}-{} | {} | {} | {:.3} {:.3} | {mean:+.3} {:.3} {:.3} | {:.2} | {:.2} {:.2} |",
                sizes[0],
                sizes[1],
                blurs[0],
                blurs[1],
                inside.len(),
                found.len(),
                deviation(centre()),
                rms(centre()),
                deviation(range()),
                rms(range()),
                deviation(found.iter().map(|(_, (e, _))| e[3])).to_degrees(),
                stated(0) / deviation(centre()),
                stated(1) / range_ratio,
            );
        }
    }
}

/// Prints the parameters of the model.
fn print_model(samples: &[Sample]) {
    let found = |blur: std::ops::Range<f64>| {
        samples
            .iter()
            .filter(move |l| blur.contains(&l.blur_px) && l.size_px > 14.0)
            .filter_map(|l| Some((l.size_px, l.found?)))
    };
    let centre = |blur| deviation(found(blur).flat_map(|(_, (e, _))| [e[0], e[1]]));
    let size = |blur| deviation(found(blur).map(|(size, (e, _))| e[2] * size));
    let slope =
        |of: &dyn Fn(std::ops::Range<f64>) -> f64| ((of(2.0..6.1) - of(0.0..0.5)) / 3.7).max(0.0);
    let (still_centre, still_size) = (centre(0.0..0.5), size(0.0..0.5));
    let all: Vec<_> = found(0.0..6.1).collect();
    let outliers = all
        .iter()
        .filter(|(_, (e, _))| e[0].hypot(e[1]) > 4.0 * 1.25 * still_centre.max(centre(0.0..6.1)))
        .count();
    let large = samples.iter().filter(|l| l.size_px > 20.0);
    let missed = large.clone().filter(|l| l.found.is_none()).count() as f64;
    println!(
        "\ncentre_px {still_centre:.3}, centre_per_blur {:.3}, size_px {still_size:.3}, size_per_blur {:.3}",
        slope(&centre),
        slope(&size)
    );
    println!(
        "miss {:.4}, outliers {:.4}, tilt_rad_px {:.3}, stated over measured {:.2} {:.2}",
        missed / large.count().max(1) as f64,
        outliers as f64 / all.len().max(1) as f64,
        deviation(all.iter().map(|(size, (e, _))| e[3] * size)),
        rms(all.iter().map(|(_, (_, stated))| stated[0])) / centre(0.0..6.1),
        rms(all.iter().map(|(size, (_, stated))| stated[1] * size)) / size(0.0..6.1),
    );
    println!("now: {RINGS:?}");
}

/// Computes the value of a panel from the errors of a sample and the marker's size in pixels.
type ErrorOf = fn(&[f64; 4], f64) -> f64;
/// The model's deviation for a panel.
type DeviationOf = fn(&VisionModel) -> f64;

/// Plots the errors of centre and range against the size, with the model's deviation without blur.
fn plot(samples: &[Sample]) -> anyhow::Result<String> {
    picture([1100, 520], |area| {
        let (left, right) = area.split_horizontally(550);
        let panels: [(_, &str, ErrorOf, DeviationOf); 2] = [
            (left, "centre along an axis, px", |e, _| e[0], |m| m.centre_px),
            (right, "range as a size, px", |e, size| e[2] * size, |m| m.size_px),
        ];
        for (half, name, of, model) in panels {
            let deviation = model(&RINGS);
            let reach = 8.0 * deviation;
            let mut chart = ChartBuilder::on(&half)
                .caption(name, ("sans-serif", 18))
                .margin(12)
                .x_label_area_size(40)
                .y_label_area_size(50)
                .build_cartesian_2d((6.0_f64..700.0).log_scale(), -reach..reach)?;
            chart.configure_mesh().x_desc("size of the marker, px").y_desc("error, px").draw()?;
            for (colour, blurs) in BLURS_PX.windows(2).enumerate() {
                let dots = samples.iter().filter(|l| (blurs[0]..blurs[1]).contains(&l.blur_px));
                let dots = dots.filter_map(|l| Some((l.size_px, of(&l.found?.0, l.size_px))));
                let inside = dots.filter(|(_, error)| error.abs() < reach);
                let colour = COLOURS[colour];
                chart
                    .draw_series(inside.map(|at| Circle::new(at, 2, colour.mix(0.6).filled())))?
                    .label(format!("blur {} to {} px", blurs[0], blurs[1]))
                    .legend(move |(x, y)| Circle::new((x + 8, y), 3, colour.filled()));
            }
            for sign in [-1.0, 1.0] {
                let line = [(6.0, sign * deviation), (700.0, sign * deviation)];
                chart.draw_series(LineSeries::new(line, BLACK.stroke_width(2)))?;
            }
            chart
                .configure_series_labels()
                .background_style(WHITE.mix(0.85))
                .border_style(BLACK)
                .draw()?;
        }
        Ok(())
    })
}
