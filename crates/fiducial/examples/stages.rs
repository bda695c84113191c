//! Writes the result of each stage of the two ring detectors for an image, for comparison with other libraries, and
//! prints how long each stage takes: `cargo run --release -p fiducial --example stages -- IMAGE FOLDER`.
#![allow(clippy::print_stdout, reason = "a program for people at a terminal")]

use std::error::Error;
use std::path::Path;
use std::time::Instant;

use fiducial::families::rings_thesis::{ContourEllipse, ellipse_filter};
use fiducial::overlay::canvas::RgbImageBuf;
use fiducial::overlay::debug::{ALIGNMENT_RADIUS_PX, draw_ellipses, draw_rings, draw_target};
use fiducial::{Detector, Settings, StageObserver};
use geometry::CameraModel;
use imaging::{
    BilateralRows, Contours, GrayImage, GrayView, Limits, bilateral_5x5, contour_area, fit_ellipse,
    threshold,
};
use serde_json::json;

type Outcome<T> = Result<T, Box<dyn Error>>;

/// Keeps the shortest time each stage took.
#[derive(Default)]
struct Clock {
    last: Option<Instant>,
    stages: Vec<(&'static str, f64)>,
}

impl StageObserver for Clock {
    fn ended(&mut self, stage: &'static str) {
        let now = Instant::now();
        let spent_ms = self.last.replace(now).map_or(0.0, |l| (now - l).as_secs_f64() * 1e3);
        match self.stages.iter_mut().find(|(name, _)| *name == stage) {
            Some((_, min_ms)) => *min_ms = min_ms.min(spent_ms),
            None => self.stages.push((stage, spent_ms)),
        }
    }
}

fn main() -> Outcome<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [image, folder] = arguments.as_slice() else {
        return Err("usage: stages IMAGE FOLDER".into());
    };
    let image = image::open(image)?.into_luma8();
    let (width, height) = (image.width() as usize, image.height() as usize);
    let view = GrayView::packed(image.as_raw(), width, height)?;
    let folder = Path::new(folder);
    std::fs::create_dir_all(folder)?;
    image.save(folder.join("grey.png"))?;
    thesis_stages(view, folder)?;
    for family in ["rings", "rings-thesis"] {
        detect(view, family, folder)?;
    }
    Ok(())
}

fn save(image: &GrayImage, path: &Path) -> Outcome<()> {
    let (width, height) = (image.width() as u32, image.height() as u32);
    image::save_buffer(path, image.pixels(), width, height, image::ColorType::L8)?;
    Ok(())
}

/// The stages up to Algorithm 1, each written as it is.
fn thesis_stages(view: GrayView<'_>, folder: &Path) -> Outcome<()> {
    let (mut filtered, mut binary) = (GrayImage::default(), GrayImage::default());
    bilateral_5x5(view, &mut BilateralRows::default(), &mut filtered);
    save(&filtered, &folder.join("filtered.png"))?;
    let level = Settings::default().thesis_threshold;
    threshold(filtered.view().ok_or("no pixels")?, level, &mut binary);
    save(&binary, &folder.join("binary.png"))?;
    let mut contours = Contours::default();
    let all = Limits { min_points: 1, max_points: usize::MAX };
    contours.find(binary.view().ok_or("no pixels")?, all);
    let mut valid: Vec<ContourEllipse> = Vec::new();
    ellipse_filter(&contours, &mut valid);
    let listed: Vec<_> = contours
        .iter()
        .enumerate()
        .map(|(index, contour)| {
            let ellipse = fit_ellipse(contour.points.iter().map(|p| p.map(f64::from)));
            json!({
                "points": contour.points,
                "hole": contour.hole,
                "area": contour_area(contour.points),
                "ellipse": ellipse.map(|e| [e.centre[0], e.centre[1], e.minor, e.major, e.angle.to_degrees()]),
                "valid": valid.iter().any(|v| v.contour == index),
            })
        })
        .collect();
    let text = json!({ "threshold": level, "contours": listed }).to_string();
    std::fs::write(folder.join("contours.json"), text)?;
    Ok(())
}

/// Detections, debug images and timings of one family.
fn detect(view: GrayView<'_>, family: &str, folder: &Path) -> Outcome<()> {
    const REPEATS: u32 = 20;
    let marker = format!("{family}:0.15341").parse()?;
    let mut detector = Detector::new(&[marker], Settings::default())?;
    let camera = CameraModel::pinhole(view.width() as u32, view.height() as u32, 1818.0);
    detector.detect(view, Some(&camera), &mut ());
    let mut clock = Clock::default();
    let mut found = Vec::new();
    for _ in 0..REPEATS {
        clock.last = Some(Instant::now());
        found = detector.detect(view, Some(&camera), &mut clock).to_vec();
    }
    println!("{family}: {} found", found.len());
    for marker in &found {
        println!(
            "  centre {:.3} {:.3} px, size {:.3} px, confidence {:.2}",
            marker.centre.x, marker.centre.y, marker.size_px, marker.confidence
        );
    }
    let mut total = 0.0;
    for (stage, min_ms) in &clock.stages {
        println!("  {stage:10} {min_ms:7.3} ms");
        total += min_ms;
    }
    println!("  {:10} {total:7.3} ms", "all");
    let trace = detector.trace();
    println!(
        "  {} ellipses, {} rings, {} refused",
        trace.ellipses.len(),
        trace.rings.len(),
        trace.refusals.len()
    );
    let mut out = RgbImageBuf::default();
    let write = |name: &str, out: &RgbImageBuf| {
        let path = folder.join(format!("{family}-{name}.png"));
        image::save_buffer(
            path,
            &out.data,
            out.width as u32,
            out.height as u32,
            image::ColorType::Rgb8,
        )
    };
    draw_ellipses(view, trace, &mut out);
    write("ellipses", &out)?;
    draw_rings(view, trace, &mut out);
    write("rings", &out)?;
    draw_target(view, trace, ALIGNMENT_RADIUS_PX, &mut out);
    write("target", &out)?;
    Ok(())
}
