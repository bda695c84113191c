//! Writes pictures of the calibration board with their truth, for `alight calibrate board` and other programs:
//! `cargo run -p rendering --example board_pictures -- FOLDER [PROCESSING] [VIEWS] [SEED]`.
//!
//! The board of A4 (`markers::Board::A4`) lies on the ground; the camera looks at it from all sides, from near and far, so
//! that it appears everywhere in the image. The camera's truth is in `truth.json`.
#![allow(clippy::print_stdout, reason = "a program for people at a terminal")]

use std::error::Error;
use std::fs::File;
use std::path::Path;

use geometry::{Body, CameraModel, Distortion, Ned, Pixel, Point, Rotation, Transform};
use image::codecs::jpeg::JpegEncoder;
use markers::Board;
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rendering::{CameraSettings, PadInScene, Preset, Renderer, Scene, Surface};
use serde_json::json;

/// A usual lens of 65 degrees, wide enough to distort.
const CAMERA: CameraModel = CameraModel {
    width: 1280,
    height: 960,
    fx: 1010.0,
    fy: 1008.5,
    cx: 646.3,
    cy: 471.8,
    distortion: Distortion::BrownConrady([-0.28, 0.09, 0.0006, -0.0004, -0.012, 0.0, 0.0, 0.0]),
};

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let folder = args.next().ok_or("usage: boards FOLDER [PROCESSING] [VIEWS] [SEED]")?;
    let name = args.next().unwrap_or_else(|| Preset::Linear.name().to_owned());
    let preset = Preset::ALL.into_iter().find(|preset| preset.name() == name);
    let preset = preset.ok_or("there is no such processing")?;
    let views: u64 = args.next().map_or(Ok(40), |text| text.parse())?;
    let seed: u64 = args.next().map_or(Ok(1), |text| text.parse())?;
    let folder = Path::new(&folder);
    std::fs::create_dir_all(folder)?;
    let scene = Scene {
        surface: Surface::Plain,
        pads: vec![PadInScene::printed(Board::A4.drawing(), 0.0, 0.0, 0.0)],
        painted_marks: 0,
        light: 1.0,
    };
    let settings = CameraSettings {
        model: CAMERA,
        body_from_camera: Transform::identity(),
        processing: preset.processing(),
        ..CameraSettings::thesis().exposed_for(1.0, 200.0, 0.002)
    };
    let mut renderer = Renderer::new(&scene, settings, seed)?;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut pixels = vec![0; (CAMERA.width * CAMERA.height) as usize];
    for i in 0..views {
        renderer.render(&[pose(&mut rng)?], i, &mut pixels)?;
        let grey = image::ExtendedColorType::L8;
        let name = folder.join(format!("{i:03}"));
        match preset {
            Preset::Linear => {
                let path = name.with_extension("png");
                image::save_buffer(path, &pixels, CAMERA.width, CAMERA.height, grey)?;
            }
            _ => {
                let file = File::create(name.with_extension("jpg"))?;
                JpegEncoder::new_with_quality(file, 90).encode(
                    &pixels,
                    CAMERA.width,
                    CAMERA.height,
                    grey,
                )?;
            }
        }
    }
    let CameraModel { width, height, fx, fy, cx, cy, .. } = CAMERA;
    let Distortion::BrownConrady(k) = CAMERA.distortion else { return Err("another lens".into()) };
    let truth = json!({ "width": width, "height": height, "camera": [fx, fy, cx, cy], "lens": k });
    std::fs::write(folder.join("truth.json"), truth.to_string())?;
    println!("{}: {views} pictures", folder.display());
    Ok(())
}

/// Where the camera is: tilted by up to 50 degrees, its image turned, the board's middle anywhere in the inner image.
fn pose(rng: &mut ChaCha8Rng) -> Result<Transform<Ned, Body>, Box<dyn Error>> {
    let distance_m = rng.random_range(0.22..0.6);
    let tilt = rng.random_range(0.0..50.0_f64).to_radians();
    let side = rng.random_range(0.0..std::f64::consts::TAU);
    let eye = Vector3::new(
        distance_m * tilt.sin() * side.cos(),
        distance_m * tilt.sin() * side.sin(),
        -0.01 - distance_m * tilt.cos(),
    );
    let forward = (Vector3::new(0.0, 0.0, -0.01) - eye).normalize();
    let right = (-Vector3::x()).cross(&forward).normalize();
    let axes = Matrix3::from_columns(&[right, forward.cross(&right), forward]);
    let look = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    let roll = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), rng.random_range(-0.6..0.6));
    let seen = Pixel::new(rng.random_range(200.0..1080.0), rng.random_range(150.0..810.0));
    let ray = CAMERA.unproject(seen).ok_or("the pixel has no ray")?;
    let aside = UnitQuaternion::rotation_between(&ray.coords, &Vector3::z())
        .ok_or("the ray is behind the camera")?;
    let rotation = Rotation::from_quaternion(look * roll * aside);
    Ok(Transform::new(rotation, Point::new(eye.x, eye.y, eye.z)))
}
