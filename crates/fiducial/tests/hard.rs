//! Tests the three-ring marker in hard rendered images, from 7 cm to 30 m: cut, tilted, dim, blurred, in shadow,
//! through a lens, covered, inverted; and rings of others that are no marker.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may stop anywhere")]
#![allow(clippy::print_stdout, reason = "the tests print their figures")]

mod render;

use fiducial::{Detector, Observation, Settings, Tracker};
use geometry::{CameraModel, Distortion};
use imaging::GrayImage;
use render::{SIZE_M, Scene};
use rendering::Preset;

fn camera() -> CameraModel {
    CameraModel::pinhole(1296, 972, 1818.0)
}

fn find(image: &GrayImage, camera: &CameraModel) -> Option<Observation> {
    let marker = format!("rings:{SIZE_M}").parse().unwrap();
    let mut detector = Detector::new(&[marker], Settings::default()).unwrap();
    let found = detector.detect(image.view().unwrap(), Some(camera), &mut ());
    assert!(found.len() < 2, "{found:?}");
    let found = found.first().cloned();
    if found.is_none() {
        println!("rings {:#?}, refused {:#?}", detector.trace().rings, detector.trace().refusals);
    }
    found
}

/// Asserts that the marker is found within these bounds; returns the observation.
fn expect(
    name: &str,
    scene: &Scene,
    image: &GrayImage,
    centre_px: f64,
    range_percent: f64,
) -> Observation {
    let Some(marker) = find(image, &scene.camera) else { panic!("{name}: not found") };
    check(name, scene, &marker, centre_px, range_percent);
    marker
}

/// Asserts that the observation is within these bounds.
fn check(name: &str, scene: &Scene, marker: &Observation, centre_px: f64, range_percent: f64) {
    let pose = marker.pose.as_ref().unwrap();
    let range_m = pose.camera_from_marker.origin().coords.coords.norm();
    let range = (range_m / scene.range_m() - 1.0) * 100.0;
    let centre = marker.centre.distance(&scene.centre());
    println!(
        "{name}: centre {centre:.3} px, range {range:+.3} %, confidence {:.2}",
        marker.confidence
    );
    assert!(centre < centre_px && range.abs() < range_percent, "{name}");
}

#[test]
fn from_twenty_centimetres_to_seven_the_rings_that_still_fit_are_enough() {
    for (range_m, sides) in [(0.07, [0.0, 0.2]), (0.1, [0.05, 0.25]), (0.2, [0.0, 0.25])] {
        for side in sides {
            let place = [side * range_m, side * 0.7 * range_m, range_m];
            let scene = Scene::new(camera(), place, 0.05, 1.0);
            expect(&format!("{range_m} m, {side} aside"), &scene, &scene.render(), 0.05, 0.05);
        }
    }
    // The innermost ring alone is found where the marker is followed (`tests/tracker.rs`).
    let scene = Scene::new(camera(), [0.0, 0.0, 0.03], 0.05, 1.0);
    assert_eq!(find(&scene.render(), &camera()), None);
}

#[test]
fn cut_by_the_edge_of_the_image() {
    // Range, and how far to the right of the axis per metre of range; the image ends at 0.356.
    for (range_m, side) in [(0.1, 0.34), (0.2, 0.37), (0.5, 0.37), (1.0, 0.37), (3.0, 0.35)] {
        let scene =
            Scene::new(camera(), [side * range_m, side * 0.3 * range_m, range_m], 0.05, 1.0);
        expect(&format!("{range_m} m, cut at {side}"), &scene, &scene.render(), 0.06, 0.1);
    }
}

#[test]
fn dim_bright_blurred_and_noisy() {
    for range_m in [0.6, 2.0, 7.0] {
        let plain = Scene::new(camera(), [0.05 * range_m, 0.03 * range_m, range_m], 0.2, 1.0);
        let scenes = [
            ("dim", Scene { black: 8.0, white: 40.0, ground: 20.0, texture: 10.0, ..plain }),
            ("bright", Scene { black: 90.0, white: 255.0, ground: 250.0, texture: 60.0, ..plain }),
            ("blurred", Scene { blur_px: 1.5, ..plain }),
            ("noisy", Scene { noise: 10.0, ..plain }),
            ("little paper", Scene { paper: 0.55, ..plain }),
        ];
        for (name, scene) in scenes {
            expect(&format!("{name} at {range_m} m"), &scene, &scene.render(), 0.06, 0.3);
        }
    }
}

#[test]
fn a_saturated_sky_and_light_that_falls_off() {
    for range_m in [0.6, 2.0, 7.0] {
        let scene = Scene::new(camera(), [0.05 * range_m, 0.03 * range_m, range_m], 0.2, 1.0);
        let mut image = scene.render();
        for y in 0..image.height() {
            for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
                let light = 0.2 + 1.2 * x as f64 / 1296.0;
                *pixel = if y < 300 { 255 } else { (f64::from(*pixel) * light) as u8 };
            }
        }
        expect(&format!("sky at {range_m} m"), &scene, &image, 0.06, 0.2);
    }
}

#[test]
fn with_the_edge_of_a_shadow_across_it() {
    for range_m in [0.6, 2.0, 7.0] {
        for (light, aside) in [(0.3, 0.02), (0.25, -0.2), (0.4, 0.3)] {
            let scene = Scene::new(camera(), [0.05 * range_m, 0.03 * range_m, range_m], 0.2, 1.0);
            let mut image = scene.render();
            let (middle, size_px) = (scene.centre(), SIZE_M * 1818.0 / range_m);
            for y in 0..image.height() {
                for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
                    let beyond =
                        (x as f64 - middle.x) + 0.4 * (y as f64 - middle.y) - aside * size_px;
                    let share = (beyond / 2.0).clamp(0.0, 1.0);
                    *pixel = (f64::from(*pixel) * (1.0 - share * (1.0 - light))).round() as u8;
                }
            }
            expect(
                &format!("shadow of {light}, {aside} aside, at {range_m} m"),
                &scene,
                &image,
                0.1,
                0.4,
            );
        }
    }
}

#[test]
fn steeply_tilted() {
    for tilt in [0.8, 1.0] {
        for range_m in [0.6, 2.0, 5.0] {
            let scene = Scene::new(camera(), [0.05 * range_m, 0.03 * range_m, range_m], tilt, 2.0);
            let name = format!("{tilt} rad at {range_m} m");
            let marker = expect(&name, &scene, &scene.render(), 0.05, 0.5);
            let z = nalgebra::Vector3::z();
            let found = marker.pose.unwrap().camera_from_marker.rotation().quaternion * z;
            let truth = scene.camera_from_marker.rotation().quaternion * z;
            assert!(found.angle(&truth) < 0.03, "{name}: {:.3} rad off", found.angle(&truth));
        }
    }
}

#[test]
fn through_a_lens_that_bends() {
    let k = [-0.25, 0.08, 0.001, -0.0005, 0.0, 0.0, 0.0, 0.0];
    let bent = CameraModel { distortion: Distortion::BrownConrady(k), ..camera() };
    for range_m in [0.6, 3.0] {
        let place = [0.22 * range_m, -0.12 * range_m, range_m];
        let scene = Scene::new(bent, place, 0.3, 4.0);
        expect(&format!("bent at {range_m} m"), &scene, &scene.render(), 0.05, 0.1);
    }
}

#[test]
fn without_a_camera_there_is_a_centre_and_no_pose() {
    let marker = format!("rings:{SIZE_M}").parse().unwrap();
    let mut detector = Detector::new(&[marker], Settings::default()).unwrap();
    for range_m in [0.5, 3.0] {
        let scene = Scene::new(camera(), [0.1 * range_m, 0.05 * range_m, range_m], 0.5, 1.0);
        let image = scene.render();
        let found = detector.detect(image.view().unwrap(), None, &mut ());
        assert_eq!(found.len(), 1);
        assert!(found[0].pose.is_none());
        let error = found[0].centre.distance(&scene.centre());
        assert!(error < 0.5, "{error}");
    }
}

#[test]
fn a_marker_with_covered_centre_or_rim_is_found_only_where_one_is_tracked() {
    let marker = format!("rings:{SIZE_M}").parse().unwrap();
    for range_m in [0.8, 2.5] {
        for rim in [false, true] {
            let scene = Scene::new(camera(), [0.03, 0.02, range_m], 0.15, 1.0);
            let plain = scene.render();
            let mut image = plain.clone();
            let (middle, size_px) = (scene.centre(), SIZE_M * 1818.0 / range_m);
            for y in 0..image.height() {
                for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
                    let (dx, dy) = ((x as f64 - middle.x).abs(), (y as f64 - middle.y).abs());
                    // A leaf on the middle, or grass grown over all but a square.
                    let covered = if rim {
                        dx.max(dy) > 0.29 * size_px
                    } else {
                        dx + 1.3 * dy < 0.33 * size_px
                    };
                    if covered {
                        *pixel = 40 + ((x / 3 + y / 5) % 4 * 6) as u8;
                    }
                }
            }
            let name = format!("{} covered at {range_m} m", if rim { "rim" } else { "middle" });
            // In a single image it may be a washer or a lamp next to a dark object.
            assert_eq!(find(&image, &scene.camera), None, "{name}");
            let mut detector = Detector::new(&[marker], Settings::default()).unwrap();
            let mut tracker = Tracker::default();
            for (frame, shown) in [&plain, &plain, &plain, &image, &image].into_iter().enumerate() {
                let (view, time_s) = (shown.view().unwrap(), 0.05 * frame as f64);
                let found =
                    tracker.detect(&mut detector, view, Some(&scene.camera), time_s, &mut ());
                assert_eq!(found.len(), 1, "{name}, frame {frame}");
                check(&name, &scene, &found[0], 0.1, 0.3);
            }
        }
    }
}

#[test]
fn thirty_metres_away() {
    for (range_m, side) in [(16.0, 0.1), (22.0, -0.05), (26.0, 0.12), (30.0, 0.03)] {
        let place = [side * range_m, 0.5 * side * range_m, range_m];
        let plain = Scene::new(camera(), place, 0.1, 1.0);
        // The ground begins where the quiet zone ends.
        let scene = Scene { paper: 0.6, ground: 60.0, texture: 20.0, ..plain };
        expect(&format!("{range_m} m"), &scene, &scene.render(), 0.05, 1.5);
    }
}

#[test]
fn white_on_black_overexposed_and_partly_hidden() {
    for range_m in [0.6, 2.0, 5.0] {
        let place = [0.05 * range_m, 0.03 * range_m, range_m];
        let plain = Scene::new(camera(), place, 0.2, 1.0);
        let mut inverted = plain.render();
        inverted.pixels_mut().iter_mut().for_each(|pixel| *pixel = 255 - *pixel);
        expect(&format!("white on black at {range_m} m"), &plain, &inverted, 0.03, 0.05);
        let bright = Scene { black: 45.0, white: 700.0, ground: 350.0, ..plain };
        let name = format!("overexposed at {range_m} m");
        expect(&name, &bright, &bright.render(), 0.1, 0.3);
        // Something white lies on a quarter of it, over all rings but the innermost.
        let mut hidden = plain.render();
        let (middle, size_px) = (plain.centre(), SIZE_M * 1818.0 / range_m);
        for y in 0..hidden.height() {
            for (x, pixel) in hidden.row_mut(y).iter_mut().enumerate() {
                let (dx, dy) = (x as f64 - middle.x, y as f64 - middle.y);
                if dx > 0.04 * size_px && dy > 0.04 * size_px {
                    *pixel = 190;
                }
            }
        }
        expect(&format!("a quarter hidden at {range_m} m"), &plain, &hidden, 0.2, 0.3);
    }
}

#[test]
fn rings_of_other_radii_are_no_marker() {
    let camera = CameraModel::pinhole(1000, 800, 909.0);
    // Radii of the edges, the outermost first, in units of the outermost; the marker's are 1, 0.8, 0.5, 0.3.
    let others: [&[f64]; 5] = [
        &[1.0, 0.85, 0.5, 0.3],
        &[1.0, 0.75, 0.5, 0.35],
        &[1.0, 0.8, 0.6, 0.4, 0.2],
        &[1.0, 0.82, 0.45, 0.25],
        &[1.0, 0.66, 0.33],
    ];
    for radii in others {
        for radius_px in [14.0, 25.0, 60.0, 150.0] {
            let mut image = GrayImage::filled(1000, 800, 210);
            for y in 0..800 {
                for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
                    let from_centre = (x as f64 - 500.3).hypot(y as f64 - 400.6);
                    let within =
                        |radius: &f64| (radius * radius_px - from_centre + 0.5).clamp(0.0, 1.0);
                    let black: f64 = radii
                        .iter()
                        .enumerate()
                        .map(|(i, r)| if i % 2 == 0 { within(r) } else { -within(r) })
                        .sum();
                    *pixel = (210.0 - 180.0 * black).round() as u8;
                }
            }
            assert_eq!(find(&image, &camera), None, "{radii:?} of {radius_px} px");
        }
    }
}

/// A target of evenly wide rings, white in the middle, seen slightly from the side.
fn target(rings: u32, radius_px: f64) -> GrayImage {
    target_at(500.3, 1.15, rings, radius_px)
}

/// The same with its middle in this column, so many times as wide as high.
fn target_at(column: f64, flatness: f64, rings: u32, radius_px: f64) -> GrayImage {
    let count = f64::from(2 * rings);
    let mut image = GrayImage::filled(1000, 800, 190);
    for y in 0..800 {
        for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
            let from_centre = (x as f64 - column).hypot(flatness * (y as f64 - 400.6));
            let black: f64 = (0..2 * rings)
                .map(|k| {
                    let edge = radius_px * (1.0 - f64::from(k) / count) - from_centre;
                    let within = (0.6 * edge + 0.5).clamp(0.0, 1.0);
                    if k % 2 == 0 { within } else { -within }
                })
                .sum();
            *pixel = (190.0 - 150.0 * black).round() as u8;
        }
    }
    image
}

#[test]
fn targets_of_evenly_wide_rings_are_no_marker() {
    let camera = CameraModel::pinhole(1000, 800, 909.0);
    for rings in [2, 3] {
        for radius_px in [13.0, 16.0, 20.0, 24.0, 30.0, 60.0] {
            let found = find(&target(rings, radius_px), &camera);
            assert_eq!(found, None, "{rings} rings of {radius_px} px");
        }
    }
}

#[test]
fn targets_with_their_centre_beyond_the_frame_are_refused() {
    let camera = CameraModel::pinhole(1000, 800, 909.0);
    for radius_px in [90.0, 120.0, 160.0, 220.0] {
        for (beyond, flatness) in [(0.2, 1.0), (0.2, 1.3), (0.3, 1.0), (0.3, 1.15), (0.3, 1.3)] {
            let image = target_at(-beyond * radius_px, flatness, 3, radius_px);
            let name = format!("{radius_px} px, {beyond} beyond, {flatness}");
            assert_eq!(find(&image, &camera), None, "{name}");
        }
    }
}

#[test]
fn small_targets_of_evenly_wide_rings_are_no_marker_to_cameras() {
    let camera = CameraModel::pinhole(1000, 800, 909.0);
    for preset in Preset::ALL {
        let mut taken = Vec::new();
        for rings in [2, 3] {
            for radius_px in [5.5, 7.0, 8.5, 10.0, 11.5, 13.0, 16.0] {
                let light = target(rings, radius_px);
                let shown = preset.processing().apply(light.pixels(), 1000).unwrap();
                let mut image = GrayImage::filled(1000, 800, 0);
                image.pixels_mut().copy_from_slice(&shown);
                if find(&image, &camera).is_some() {
                    taken.push(format!("{preset}: {rings} rings of {radius_px} px"));
                }
            }
        }
        // A video's key frame leaves less of 23 pixels than the JPEG of any other camera.
        let known: &[&str] = match preset {
            Preset::IpCamera => &["ip-camera: 3 rings of 11.5 px"],
            _ => &[],
        };
        assert!(taken.iter().all(|name| known.contains(&name.as_str())), "{taken:?}");
    }
}

#[test]
fn a_single_ring_is_refused_when_the_others_would_be_seen() {
    // Grey values of a disc with a hole, of these radii, on white.
    let draw = |outer: f64, inner: f64| {
        let mut image = GrayImage::filled(1000, 800, 210);
        for y in 0..800 {
            for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
                let radius = (x as f64 - 500.3).hypot(y as f64 - 400.6);
                let cover = |edge: f64| (edge - radius + 0.5).clamp(0.0, 1.0);
                *pixel = (210.0 - 180.0 * (cover(outer) - cover(inner))).round() as u8;
            }
        }
        image
    };
    let camera = CameraModel::pinhole(1000, 800, 909.0);
    // A wheel, a traffic sign, a washer: the other rings would be seen.
    assert_eq!(find(&draw(60.0, 48.0), &camera), None);
    assert_eq!(find(&draw(60.0, 36.0), &camera), None);
    assert_eq!(find(&draw(60.0, 20.0), &camera), None);
}
