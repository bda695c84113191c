//! Measures the accuracy of calibrations from rendered images of boards through known lenses, and of OpenCV's from the same corners.

use calibration::{Calibration, Lens, Options, Refusal, View, calibrate};
use geometry::{Body, CameraModel, Ned, Pixel, Point, Rotation, Transform};
use imaging::GrayImage;
use markers::Board;
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rendering::{CameraSettings, PadInScene, Renderer, Scene, Surface};

use super::LOOKS;
use super::found::{Finder, FoundImages, Origin, Picture};
use super::report;
use super::shown::Shown;

#[path = "../../../crates/calibration/tests/opencv/mod.rs"]
mod opencv;

#[path = "../../../crates/calibration/tests/synthetic/mod.rs"]
mod synthetic;

use synthetic::{Truth, known_error_px, lenses, map_error_px, turned_map_error_px};

const VIEWS: usize = 60;

/// The images with the board, and the calibration.
type Judged = (FoundImages, Result<Calibration, Refusal>);

/// The camera before a board on the ground, whose middle it sees anywhere in its image: near and far, tilted to all sides.
fn pose(camera: &CameraModel, random: &mut ChaCha8Rng) -> Option<Transform<Ned, Body>> {
    let mut between = |from: f64, to: f64| random.random_range(from..to);
    let (tilt, side, turn) = (between(0.1, 0.8), between(0.0, 6.3), between(-0.6, 0.6));
    let distance_m = camera.fx / 1105.0 * between(0.25, 0.55);
    let seen = Pixel::new(between(0.1, 0.9) * 1280.0, between(0.1, 0.9) * 960.0);
    let eye = Vector3::new(
        distance_m * tilt.sin() * side.cos(),
        distance_m * tilt.sin() * side.sin(),
        -distance_m * tilt.cos(),
    );
    let forward = -eye.normalize();
    let right = (-Vector3::x()).cross(&forward).normalize();
    let axes = Matrix3::from_columns(&[right, forward.cross(&right), forward]);
    let look = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    let roll = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn);
    let ray = camera.unproject(seen)?;
    let aside = UnitQuaternion::rotation_between(&ray.coords, &Vector3::z())?;
    let rotation = Rotation::from_quaternion(look * roll * aside);
    Some(Transform::new(rotation, Point::new(eye.x, eye.y, eye.z)))
}

fn found(board: &Board, lens: Lens, camera: &CameraModel, seed: u64) -> Judged {
    let scene = Scene {
        surface: Surface::Plain,
        pads: vec![PadInScene::printed(board.drawing(), 0.0, 0.0, 0.0)],
        painted_marks: 0,
        light: 1.0,
    };
    let size = [camera.width as usize, camera.height as usize];
    let settings = CameraSettings {
        model: *camera,
        body_from_camera: Transform::identity(),
        ..CameraSettings::thesis().exposed_for(1.0, 200.0, 0.002)
    };
    let mut renderer = Renderer::new(&scene, settings, seed).unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut finder = Finder::new(board).unwrap();
    let mut found = FoundImages::default();
    for i in 0..VIEWS {
        let mut image = GrayImage::filled(size[0], size[1], 0);
        let pose = pose(camera, &mut random).unwrap();
        renderer.render(&[pose], i as u64, image.pixels_mut()).unwrap();
        let name = i.to_string();
        found.add(&mut finder, Picture { name, image, origin: Origin::File });
    }
    let options = Options::default();
    for _ in 0..LOOKS {
        let first = calibration::calibrate_unjudged(&found.views, lens, &options).unwrap();
        found.look_again(&mut finder, &first.camera);
    }
    let result = calibrate(&found.views, lens, &options);
    (found, result)
}

/// Errors of a camera: of its focal length in %, its principal point in pixels, and of its projection, in pixels, over 95 % of the image,
/// as it is and after the best rotation.
fn errors(truth: &CameraModel, camera: &CameraModel) -> [f64; 4] {
    let focal = (camera.fx / truth.fx - 1.0).abs().max((camera.fy / truth.fy - 1.0).abs());
    let principal = (camera.cx - truth.cx).hypot(camera.cy - truth.cy);
    [100.0 * focal, principal, map_error_px(truth, camera), turned_map_error_px(truth, camera)]
}

#[test]
fn images_that_were_turned_are_reported_by_name() {
    let Truth { lens, camera: truth, .. } = lenses()[0];
    let mut views = synthetic::views(&truth, &synthetic::Taking::default(), 1);
    let report = |views: &[View]| {
        let calibration = calibrate(views, lens, &Options::default()).unwrap();
        let found = FoundImages::default();
        let json = report::json(&found, &Shown::new(&found, None), Some(&calibration), None);
        (report::worth_text(&calibration), json["calibration"]["turned"].to_string())
    };
    let (text, turned) = report(&views);
    assert!(!text.contains("turn by 180 degrees") && turned == "[]", "{text}");
    for point in &mut views[2].points {
        point.seen = Pixel::new(1279.0 - point.seen.x, 959.0 - point.seen.y);
    }
    let (text, turned) = report(&views);
    assert!(text.contains("1 image fits better after a turn by 180 degrees: 002.png;"), "{text}");
    assert_eq!(turned, "[\"002.png\"]");
}

#[test]
#[ignore = "a measurement of some minutes"]
fn how_exact_cameras_from_rendered_boards_are() {
    let number = |name: &str, usual: u64| {
        std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(usual)
    };
    let (sets, first) = (number("ALIGHT_SETS", 3), number("ALIGHT_SEED", 900));
    let shown = lenses().into_iter().filter(|truth| truth.lens != Lens::BrownConrady8);
    for Truth { name, lens, camera: truth } in shown {
        for seed in first..first + sets {
            let (found, result) = found(&Board::A4, lens, &truth, seed);
            let result = match result {
                Ok(result) => result,
                Err(refusal) => {
                    println!("{name}, seed {seed}: refused, as {refusal}");
                    continue;
                }
            };
            let error_text = |[focal, principal, map, turned]: [f64; 4]| {
                format!(
                    "focal length {focal:.4} %, principal point {principal:.3} px, map {map:.3} px, turned {turned:.3} px"
                )
            };
            let ours = errors(&truth, &result.camera);
            let theirs = match opencv::solve(&found.views, lens) {
                Some(Ok(theirs)) => error_text(errors(&truth, &theirs.camera)),
                Some(Err(problem)) => problem,
                None => "not installed".to_owned(),
            };
            println!(
                "{name}, seed {seed}, {} images: {}, where it is known {:.3} px, stated {:.3} px, {:.0} % unknown; OpenCV: {theirs}",
                found.views.len(),
                error_text(ours),
                known_error_px(&truth, &result),
                result.worst_uncertainty_px(),
                100.0 * result.unknown_share()
            );
            assert!(ours[0] < 0.02 && ours[1] < 0.1, "{name} {seed}: {ours:?}");
        }
    }
}
