//! Writes one view as each kind of camera shows it, and prints the time that the processing takes:
//! `cargo run --release -p rendering --example cameras -- FOLDER`.
#![allow(clippy::print_stdout, reason = "a program for people at a terminal")]

use std::error::Error;
use std::path::Path;
use std::time::Instant;

use geometry::{Body, Ned, Point, Rotation, Transform};
use rendering::{CameraSettings, PadInScene, Preset, Renderer, Scene, Surface};

/// Markers around the middle of the image and towards its corner: name, north and east in metres.
const MARKERS: [(&str, f64, f64); 4] = [
    ("rings:0.15341", 0.1, -0.2),
    ("aruco-4x4-50:3:0.15341", 0.1, 0.1),
    ("stag-hd23:5:0.15341", -0.2, -0.1),
    ("apriltag-36h11:7:0.15341", 0.75, 1.05),
];
const HEIGHT_M: f64 = 3.5;

fn main() -> Result<(), Box<dyn Error>> {
    let folder = std::env::args_os().nth(1).ok_or("usage: cameras FOLDER")?;
    let folder = Path::new(&folder);
    std::fs::create_dir_all(folder)?;
    let mut pads = Vec::new();
    for (name, north_m, east_m) in MARKERS {
        pads.push(PadInScene::flat(name.parse()?, north_m, east_m, 0.3));
    }
    let scene = Scene { surface: Surface::Asphalt, pads, painted_marks: 20, light: 1.0 };
    let level = Rotation::<Ned, Body>::from_euler(0.02, 0.03, 0.4);
    let pose = Transform::new(level, Point::<Ned>::new(0.0, 0.0, -HEIGHT_M));
    let mut linear_ms = None;
    for preset in Preset::ALL {
        let processing = preset.processing();
        let settings = CameraSettings { processing, ..CameraSettings::thesis() };
        let (width, height) = (settings.model.width, settings.model.height);
        let mut renderer = Renderer::new(&scene, settings, 1)?;
        let mut pixels = vec![0; width as usize * height as usize];
        let mut shortest_ms = f64::INFINITY;
        for frame in 0..5 {
            let start = Instant::now();
            renderer.render(&[pose], frame, &mut pixels)?;
            shortest_ms = shortest_ms.min(1e3 * start.elapsed().as_secs_f64());
        }
        let linear_ms = *linear_ms.get_or_insert(shortest_ms);
        println!("{preset}: {:.1} ms more than {linear_ms:.1} ms", shortest_ms - linear_ms);
        let grey = image::ColorType::L8;
        image::save_buffer(folder.join(format!("{preset}.png")), &pixels, width, height, grey)?;
    }
    Ok(())
}
