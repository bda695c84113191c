//! Writes frames of the thesis' marker with their truth, at both binnings, for `alight detect` and other
//! detectors: `cargo run --release -p rendering --example frames -- FOLDER`.
//!
//! Five frames at each of the thesis' positions, straight down and tilted by 5 degrees: PNG files in a folder
//! for each camera and tilt, its calibration beside it, and a line for each in `truth.jsonl`.
#![allow(clippy::print_stdout, reason = "a program for people at a terminal")]

use std::error::Error;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use rendering::views::{Binning, TestScene, views};
use serde_json::json;

const BINNINGS: [Binning; 2] = [Binning::TwoByTwo, Binning::FourByFour];
const REPEATS: u32 = 5;
const TILTS_DEG: [f64; 2] = [0.0, 5.0];

fn main() -> Result<(), Box<dyn Error>> {
    let folder = std::env::args_os().nth(1).ok_or("usage: frames FOLDER")?;
    let folder = Path::new(&folder);
    std::fs::create_dir_all(folder)?;
    let mut truth = BufWriter::new(File::create(folder.join("truth.jsonl"))?);
    for binning in BINNINGS {
        std::fs::write(folder.join(format!("{}.yaml", binning.name())), binning.calibration())?;
        for tilt_deg in TILTS_DEG {
            write_frames(binning, tilt_deg, folder, &mut truth)?;
        }
    }
    truth.flush()?;
    Ok(())
}

fn write_frames(
    binning: Binning,
    tilt_deg: f64,
    folder: &Path,
    truth: &mut impl Write,
) -> Result<(), Box<dyn Error>> {
    let inner = format!("{}-tilt{tilt_deg}", binning.name());
    std::fs::create_dir_all(folder.join(&inner))?;
    let camera = binning.camera();
    let mut scene = TestScene::new(binning)?;
    let views = views(binning, tilt_deg, REPEATS);
    for view in &views {
        let (pixels, shown) = scene.render(view)?;
        let image = format!("{inner}/{}.png", view.name());
        let grey = image::ColorType::L8;
        image::save_buffer(folder.join(&image), &pixels, camera.width, camera.height, grey)?;
        let origin = shown.camera_from_marker.origin();
        let line = json!({
            "image": image,
            "binning": binning.name(),
            "height_m": view.height_m,
            "lateral_m": view.lateral_m,
            "tilt_deg": view.tilt_deg,
            "centre_px": [shown.centre.x, shown.centre.y],
            "translation_m": [origin.x(), origin.y(), origin.z()],
            "rotation_wxyz": shown.camera_from_marker.rotation().wxyz(),
        });
        writeln!(truth, "{line}")?;
    }
    println!("{inner}: {} frames", views.len());
    Ok(())
}
