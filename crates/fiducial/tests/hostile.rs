//! Tests the detector of all families and its debug drawings on images of odd shapes, patterns and noise and with
//! senseless camera models: no panic, no image beyond a minute.
#![allow(clippy::unwrap_used, reason = "a test may stop anywhere")]

mod render;

use std::time::{Duration, Instant};

use fiducial::overlay::canvas::RgbImageBuf;
use fiducial::overlay::debug::{ALIGNMENT_RADIUS_PX, draw_ellipses, draw_rings, draw_target};
use fiducial::{Detector, DetectorError, Settings};
use geometry::{CameraModel, Distortion};
use imaging::GrayView;
use render::Random;

fn look_at(name: &str, data: &[u8], width: usize, height: usize) {
    let view = GrayView::packed(data, width, height).unwrap();
    let names = ["rings:0.1", "rings-thesis:0.1", "apriltag-36h11:*:0.1", "stag-hd23:*:0.1"];
    let markers = names.map(|m| m.parse().unwrap());
    let mut detector = Detector::new(&markers, Settings::default()).unwrap();
    let camera = CameraModel::pinhole(width as u32, height as u32, 100.0);
    let start = Instant::now();
    detector.detect(view, Some(&camera), &mut ());
    detector.detect(view, None, &mut ());
    let spent = start.elapsed();
    // Far more than any of them takes even on a busy machine; a search without bounds takes hours.
    assert!(spent < Duration::from_secs(60), "{name} {width} x {height}: {spent:?}");
    let mut out = RgbImageBuf::default();
    draw_ellipses(view, detector.trace(), &mut out);
    draw_rings(view, detector.trace(), &mut out);
    draw_target(view, detector.trace(), ALIGNMENT_RADIUS_PX, &mut out);
    assert_eq!(out.data.len(), width * height * 3);
}

#[test]
fn images_of_every_shape() {
    for (width, height) in
        [(1, 1), (1, 2), (2, 1), (3, 3), (5, 1), (1, 900), (65_535, 1), (65_535, 9), (4, 65_535)]
    {
        for fill in [0, 128, 255] {
            look_at("plain", &vec![fill; width * height], width, height);
        }
        let mixed: Vec<u8> = (0..width * height).map(|i| (i * 97 % 251) as u8).collect();
        look_at("mixed", &mixed, width, height);
    }
}

#[test]
fn patterns_of_pixels() {
    let (width, height) = (1296, 972);
    let image = |grey: &dyn Fn(usize, usize) -> u8| -> Vec<u8> {
        (0..width * height).map(|i| grey(i % width, i / width)).collect()
    };
    let black_or_white = |white: bool| if white { 255 } else { 0 };
    look_at("checkerboard", &image(&|x, y| black_or_white((x + y) % 2 == 0)), width, height);
    look_at("dots", &image(&|x, y| black_or_white(x % 3 == 0 && y % 3 == 0)), width, height);
    look_at("stripes", &image(&|x, _| black_or_white(x % 2 == 0)), width, height);
    look_at("ramp", &image(&|x, y| ((x + y) % 256) as u8), width, height);
    // Every side of these has dozens of others next to it.
    for period in [6, 10, 24] {
        let squares =
            |x: usize, y: usize| x.abs_diff(648).max(y.abs_diff(486)) % period < period / 2;
        look_at("squares", &image(&|x, y| black_or_white(squares(x, y))), width, height);
        let tiles =
            |x: usize, y: usize| (x * 5 + y) / 5 % period < 2 || (y * 6 + x) / 6 % period < 2;
        look_at("joints", &image(&|x, y| black_or_white(tiles(x, y))), width, height);
    }
    // Thousands of small rings side by side, and rings about one centre.
    let radius = |x: usize, y: usize, cell: usize| {
        let half = (cell / 2) as f64;
        ((x % cell) as f64 - half).hypot((y % cell) as f64 - half)
    };
    for cell in [9, 14, 24] {
        let ring = |x: usize, y: usize| {
            let r = radius(x, y, cell) / cell as f64;
            black_or_white(!(0.25..0.4).contains(&r))
        };
        look_at("rings", &image(&ring), width, height);
    }
    let target = |x: usize, y: usize| {
        black_or_white((x as f64 - 648.0).hypot(y as f64 - 486.0) as usize % 6 < 3)
    };
    look_at("target", &image(&target), width, height);
}

#[test]
fn noise() {
    let mut random = Random(7);
    let data: Vec<u8> = (0..1296 * 972).map(|_| (random.uniform() * 256.0) as u8).collect();
    look_at("noise", &data, 1296, 972);
    let coarse: Vec<u8> =
        (0..1296 * 972).map(|i| data[(i / 1296 / 4) * 1296 + (i % 1296) / 4]).collect();
    look_at("coarse noise", &coarse, 1296, 972);
}

#[test]
fn a_camera_model_that_makes_no_sense_gives_no_marker_or_a_sound_one() {
    let scene =
        render::Scene::new(CameraModel::pinhole(640, 480, 909.0), [0.0, 0.0, 2.0], 0.1, 0.0);
    let image = scene.render();
    let marker = "rings:0.15341".parse().unwrap();
    let mut detector = Detector::new(&[marker], Settings::default()).unwrap();
    let good = scene.camera;
    let models = [
        CameraModel { fx: 0.0, ..good },
        CameraModel { fx: f64::NAN, ..good },
        CameraModel { fx: -909.0, ..good },
        CameraModel { cx: f64::INFINITY, ..good },
        CameraModel { fy: 1e300, ..good },
        CameraModel { distortion: Distortion::BrownConrady([1e9; 8]), ..good },
        CameraModel { distortion: Distortion::KannalaBrandt([-1e3, 1e3, f64::NAN, 0.0]), ..good },
    ];
    for camera in models {
        for found in detector.detect(image.view().unwrap(), Some(&camera), &mut ()) {
            let pose = found.pose.unwrap().camera_from_marker;
            assert!(
                pose.origin().is_finite()
                    && found.centre.x.is_finite()
                    && found.size_px.is_finite()
            );
        }
    }
}

#[test]
fn a_detector_needs_different_markers() {
    let new = |names: &[&str]| {
        let markers: Vec<_> = names.iter().map(|n| n.parse().unwrap()).collect();
        Detector::new(&markers, Settings::default()).map(|_| ()).map_err(|e| e.to_string())
    };
    assert_eq!(new(&[]), Err(DetectorError::NoMarker.to_string()));
    assert_eq!(new(&["rings", "rings-thesis"]), Ok(()));
    assert!(new(&["rings:1", "rings:2"]).unwrap_err().contains("`rings` is listed twice"));
    // The same print by two names, as where dictionaries are compared, has one size.
    let same = ["aruco-4x4-50:3:0.1", "aruco-4x4-250:3:0.1", "aruco-4x4-250:4:0.2"];
    assert_eq!(new(&same), Ok(()));
    let problem = new(&["aruco-4x4-50:3:0.1", "aruco-4x4-250:3:0.2"]).unwrap_err();
    assert!(problem.contains("are one print"), "{problem}");
}
