//! The program `alight calibrate` on pictures of its board, rendered through a lens whose truth is known, and
//! on the board that it prints: the calibration file, its error in pixels, and refusals.

use std::path::Path;
use std::process::{Command, Output};

use anyhow::{Context, ensure};
use geometry::{Body, CameraModel, Distortion, Ned, Pixel, Point, Rotation, Transform};
use markers::Board;
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use rendering::{CameraSettings, PadInScene, Renderer, Scene, Surface};
use serde_json::Value;

/// A lens of 67 degrees that bends straight lines by several pixels.
const TRUTH: CameraModel = CameraModel {
    width: 800,
    height: 600,
    fx: 606.0,
    fy: 605.1,
    cx: 404.1,
    cy: 295.3,
    distortion: Distortion::BrownConrady([-0.25, 0.08, 0.0006, -0.0004, -0.01, 0.0, 0.0, 0.0]),
};
/// Where the board's middle appears, from the middle of the image in halves of it, and how the camera is tilted to it.
const PLACES: [[f64; 2]; 6] =
    [[0.0, 0.0], [-0.6, -0.6], [0.6, -0.6], [0.6, 0.6], [-0.6, 0.6], [0.1, -0.1]];
const VIEWS: usize = 24;

fn alight(args: &[&str], folder: &Path) -> anyhow::Result<Output> {
    let mut command = Command::new(env!("CARGO_BIN_EXE_alight"));
    command.args(args).current_dir(folder).output().context("running alight")
}

/// The camera at a board on the ground: each of six places from four sides, tilted, near and far.
fn pose(i: usize) -> anyhow::Result<Transform<Ned, Body>> {
    let (place, side) = (PLACES[i % 6], std::f64::consts::FRAC_PI_2 * (i / 6) as f64 + 0.4);
    let tilt = [0.15, 0.5, 0.7][i % 3];
    let distance_m = [0.25, 0.35, 0.5, 0.42][i % 4];
    let eye = Vector3::new(
        distance_m * f64::sin(tilt) * side.cos(),
        distance_m * f64::sin(tilt) * side.sin(),
        -0.01 - distance_m * f64::cos(tilt),
    );
    let forward = (Vector3::new(0.0, 0.0, -0.01) - eye).normalize();
    let right = (-Vector3::x()).cross(&forward).normalize();
    let axes = Matrix3::from_columns(&[right, forward.cross(&right), forward]);
    let look = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    let roll = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 0.3 * (i % 5) as f64 - 0.6);
    let seen = Pixel::new(400.0 * (1.0 + place[0]), 300.0 * (1.0 + place[1]));
    let ray = TRUTH.unproject(seen).context("the pixel has no ray")?;
    let aside = UnitQuaternion::rotation_between(&ray.coords, &Vector3::z()).context("behind")?;
    let rotation = Rotation::from_quaternion(look * roll * aside);
    Ok(Transform::new(rotation, Point::new(eye.x, eye.y, eye.z)))
}

fn take_pictures(folder: &Path) -> anyhow::Result<()> {
    let scene = Scene {
        surface: Surface::Plain,
        pads: vec![PadInScene::printed(Board::A4.drawing(), 0.0, 0.0, 0.0)],
        painted_marks: 0,
        light: 1.0,
    };
    let settings = CameraSettings {
        model: TRUTH,
        body_from_camera: Transform::identity(),
        ..CameraSettings::thesis().exposed_for(1.0, 200.0, 0.002)
    };
    let mut renderer = Renderer::new(&scene, settings, 1)?;
    let mut pixels = vec![0; (TRUTH.width * TRUTH.height) as usize];
    for i in 0..VIEWS {
        renderer.render(&[pose(i)?], i as u64, &mut pixels)?;
        let path = folder.join(format!("{i:02}.png"));
        let grey = image::ExtendedColorType::L8;
        image::save_buffer(path, &pixels, TRUTH.width, TRUTH.height, grey)?;
    }
    Ok(())
}

/// The greatest difference of what two cameras project, over the image, in pixels.
fn map_error_px(camera: &CameraModel) -> anyhow::Result<f64> {
    let mut worst_px = 0.0_f64;
    for (column, row) in (0..=20).flat_map(|column| (0..=15).map(move |row| (column, row))) {
        let pixel = Pixel::new(f64::from(column) * 39.9, f64::from(row) * 39.9);
        let ray = TRUTH.unproject(pixel).context("the pixel has no ray")?;
        let seen = camera.project(Point::from_coords(ray.coords.into()));
        worst_px = worst_px.max(seen.context("the camera does not see it")?.distance(&pixel));
    }
    Ok(worst_px)
}

#[test]
fn a_camera_is_calibrated_from_pictures_to_a_tenth_of_a_pixel() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    take_pictures(folder.path())?;
    let done = alight(
        &["calibrate", "board", ".", "-o", "camera.yaml", "--format", "json"],
        folder.path(),
    )?;
    ensure!(done.status.success(), "{done:?}");
    let said: Value = serde_json::from_slice(&done.stdout)?;
    ensure!(said["with_board"] == VIEWS && said["refused"].is_null(), "{said}");
    let number = |value: &Value| value.as_f64().context("a number");
    let lateral_m = number(&said["calibration"]["error_at_5_m"]["lateral_m"])?;
    ensure!(lateral_m < 0.005, "{said}");
    let camera = media::read_calibration(&folder.path().join("camera.yaml"))?;
    ensure!((camera.fx / TRUTH.fx - 1.0).abs() < 2e-4, "{camera:?}");
    ensure!((camera.fy / TRUTH.fy - 1.0).abs() < 2e-4, "{camera:?}");
    ensure!((camera.cx - TRUTH.cx).hypot(camera.cy - TRUTH.cy) < 0.1, "{camera:?}");
    let error_px = map_error_px(&camera)?;
    ensure!(error_px < 0.1, "{error_px}");
    println!("{camera:?}: {error_px:.4} px off at most");
    // Another calibration does not replace it without `--replace`, and the error comes before the pictures are read.
    let again = alight(&["calibrate", "board", "none", "-o", "camera.yaml"], folder.path())?;
    let problem = String::from_utf8_lossy(&again.stderr).into_owned();
    ensure!(!again.status.success() && problem.contains("`--replace`"), "{again:?}");
    Ok(())
}

#[test]
fn the_printed_board_is_found_and_one_picture_of_it_is_refused() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let print = ["calibrate", "board", "--print", "board.png", "--dpi", "100"];
    let printed = alight(&print, folder.path())?;
    ensure!(printed.status.success(), "{printed:?}");
    let args = ["calibrate", "board", "board.png", "-o", "camera.yaml", "--format", "json"];
    let done = alight(&args, folder.path())?;
    ensure!(done.status.code() == Some(1), "{done:?}");
    let said: Value = serde_json::from_slice(&done.stdout)?;
    let counts = said["shown"]["point_counts"].as_array().context("counts")?;
    let points: i64 =
        counts.iter().flat_map(|row| row.as_array()).flatten().filter_map(Value::as_i64).sum();
    ensure!(points == 4 * 35, "{said}");
    ensure!(said["refused"].as_str().is_some_and(|why| why.contains("take more")), "{said}");
    ensure!(!folder.path().join("camera.yaml").exists(), "a refused calibration was written");
    Ok(())
}

#[test]
fn mirrored_images_are_refused_as_mirrored() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let print = ["calibrate", "board", "--print", "board.png", "--dpi", "100"];
    let printed = alight(&print, folder.path())?;
    ensure!(printed.status.success(), "{printed:?}");
    let images = folder.path().join("images");
    std::fs::create_dir(&images)?;
    let board = image::open(folder.path().join("board.png"))?;
    board.fliph().save(images.join("a.png"))?;
    image::GrayImage::new(640, 480).save(images.join("b.png"))?;
    let done = alight(&["calibrate", "board", "images", "--format", "json"], folder.path())?;
    ensure!(done.status.code() == Some(1), "{done:?}");
    let said: Value = serde_json::from_slice(&done.stdout)?;
    let reason = said["refused"].as_str().context("a reason")?;
    ensure!(reason.contains("a.png") && reason.contains("are mirrored"), "{said}");
    Ok(())
}
