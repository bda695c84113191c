//! Measures the rendering time of a frame of the thesis' camera by height, tilt and motion; with a folder
//! as argument, writes the frames there.
#![allow(clippy::print_stdout, reason = "a table for people is what this example is for")]

use std::path::PathBuf;

use experiments::record::processor_ms;
use geometry::{Body, Ned, Point, Rotation, Transform};
use rendering::{CameraSettings, PadInScene, Renderer, Scene, Surface};

/// Frames per mean.
const FRAMES: u64 = 20;

type Failure = Box<dyn std::error::Error>;

fn main() -> Result<(), Failure> {
    let folder = std::env::args().nth(1).map(PathBuf::from);
    println!("surface  marks height_m tilt_deg motion_px      ms");
    for surface in Surface::ALL {
        for (height_m, tilt_deg, motion_px) in [
            (0.1, 0.0, 0.0),
            (0.2, 0.0, 0.0),
            (0.2, 5.0, 4.0),
            (0.5, 0.0, 0.0),
            (0.5, 10.0, 8.0),
            (1.0, 0.0, 0.0),
            (1.0, 10.0, 4.0),
            (3.0, 0.0, 0.0),
            (3.0, 20.0, 4.0),
            (10.0, 0.0, 0.0),
            (10.0, 20.0, 1.5),
            (10.0, 20.0, 8.0),
            (10.0, 85.0, 0.0),
            (20.0, 0.0, 0.0),
            (30.0, 10.0, 16.0),
        ] {
            time(surface, height_m, tilt_deg, motion_px, folder.as_ref())?;
        }
    }
    Ok(())
}

/// Renders one view several times.
fn time(
    surface: Surface,
    height_m: f64,
    tilt_deg: f64,
    motion_px: f64,
    folder: Option<&PathBuf>,
) -> Result<(), Failure> {
    let pad = PadInScene::flat("rings:0.15341".parse()?, 0.0, 0.0, 0.3);
    let painted_marks = if surface == Surface::Asphalt { 30 } else { 0 };
    let scene = Scene { surface, pads: vec![pad], painted_marks, light: 1.0 };
    let settings = CameraSettings::thesis();
    let pixels = (settings.model.width * settings.model.height) as usize;
    let focal_px = settings.model.fx;
    let mut renderer = Renderer::new(&scene, settings, 1)?;
    let tilt = tilt_deg.to_radians();
    // The camera looks at the pad, a little off the middle.
    let away_m = height_m * (tilt.min(0.6).tan() + 0.03);
    let pose = |fraction: f64| -> Transform<Ned, Body> {
        let shift_m = (fraction - 0.5) * motion_px * height_m / focal_px;
        let place = Point::new(-away_m + shift_m, 0.02 * height_m, -height_m);
        Transform::new(Rotation::from_euler(0.0, tilt, 0.0), place)
    };
    let poses = [0.0, 0.5, 1.0].map(pose);
    let mut out = vec![0; pixels];
    let start = processor_ms();
    for frame in 0..FRAMES {
        renderer.render(&poses, frame, &mut out)?;
    }
    let mean_ms = (processor_ms() - start) / FRAMES as f64;
    println!(
        "{:8} {painted_marks:5} {height_m:8.1} {tilt_deg:8.0} {motion_px:9.1} {mean_ms:7.2}",
        surface.name()
    );
    if let Some(folder) = folder {
        let name = format!("{}-{height_m}-{tilt_deg}-{motion_px}.pgm", surface.name());
        let mut bytes = b"P5 1296 972 255\n".to_vec();
        bytes.extend(&out);
        std::fs::write(folder.join(name), bytes)?;
    }
    Ok(())
}
