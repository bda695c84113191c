//! Tests rings, square markers and STags in frames with tone curve, sharpening and JPEG, also under the edge of a shadow: how
//! many are found, their errors, and the estimated response.
#![allow(clippy::unwrap_used, reason = "a test may stop anywhere")]
#![allow(clippy::print_stdout, reason = "the tests print their figures")]

use std::ops::Range;

use fiducial::{
    Detector, FallbackPass, Observation, PassSchedule, Settings, Tracker, TrackingSettings,
};
use geometry::{Body, CameraModel, Marker as MarkerFrame, Ned, Pixel, Rotation, Transform};
use imaging::GrayView;
use markers::Marker;
use rendering::occluder::{Line, Occluder};
use rendering::processing::{Sharpen, ToneCurve};
use rendering::views::{Binning, SIZE_M, TestScene, View, views};
use rendering::{PadInScene, Preset, Processing, Renderer, Scene, Surface};

const SHARPEN: Sharpen = Sharpen { radius_px: 1.0, amount: 0.8, limit_levels: 255.0 };

/// The steps of cameras' processing, one by one and together.
fn kinds() -> [(&'static str, Processing); 4] {
    let linear = Processing::LINEAR;
    let curve = Processing { tone: ToneCurve::Srgb, ..linear };
    let sharp = Processing { sharpen: Some(SHARPEN), ..linear };
    let all = Processing { sharpen: Some(SHARPEN), jpeg_quality: Some(90), ..curve };
    [("linear", linear), ("tone curve", curve), ("sharpened", sharp), ("all and JPEG", all)]
}

/// Frames and their results.
#[derive(Default)]
struct Errors {
    frames: usize,
    centre_px: Vec<f64>,
    range_percent: Vec<f64>,
}

impl Errors {
    fn note(&mut self, found: &[Observation], centre: Pixel, range_m: f64) {
        self.frames += 1;
        let [marker] = found else { return };
        let pose = marker.pose.unwrap().camera_from_marker;
        self.centre_px.push(marker.centre.distance(&centre));
        let found_m = pose.origin().coords.coords.norm();
        self.range_percent.push(100.0 * (found_m / range_m - 1.0).abs());
    }

    /// Median and 95 %.
    fn shares(values: &mut [f64]) -> [f64; 2] {
        values.sort_unstable_by(f64::total_cmp);
        [0.5, 0.95].map(|share| {
            let last = values.len().saturating_sub(1);
            values.get((share * last as f64) as usize).copied().unwrap_or(f64::NAN)
        })
    }

    /// Asserts that all but so many markers were found, this near (median and 95 %).
    fn expect(
        &mut self,
        name: &str,
        max_missed: usize,
        max_centre_px: [f64; 2],
        max_range_percent: [f64; 2],
    ) {
        let found = self.centre_px.len();
        let centre_px = Self::shares(&mut self.centre_px);
        let range_percent = Self::shares(&mut self.range_percent);
        println!(
            "{name}: {found} of {}, centre {centre_px:.4?} px, range {range_percent:.3?} %",
            self.frames
        );
        assert!(found + max_missed >= self.frames, "{name}: {found} of {}", self.frames);
        for (value, max) in centre_px.iter().zip(max_centre_px) {
            assert!(*value <= max, "{name}: centre {centre_px:?} px");
        }
        for (value, max) in range_percent.iter().zip(max_range_percent) {
            assert!(*value <= max, "{name}: range {range_percent:?} %");
        }
    }
}

fn detector(name: &str) -> Detector {
    let marker: Marker = format!("{name}:{SIZE_M}").parse().unwrap();
    Detector::new(&[marker], Settings::default()).unwrap()
}

fn detect(
    detector: &mut Detector,
    pixels: &[u8],
    processing: &Processing,
    camera: &CameraModel,
) -> Vec<Observation> {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let shown = processing.apply(pixels, width).unwrap();
    let view = GrayView::packed(&shown, width, height).unwrap();
    detector.detect(view, Some(camera), &mut ()).to_vec()
}

#[test]
fn rings_are_found_at_every_position_of_the_thesis() {
    let mut errors = kinds().map(|_| Errors::default());
    let mut detector = detector("rings");
    for binning in [Binning::TwoByTwo, Binning::FourByFour] {
        let mut scene = TestScene::new(binning).unwrap();
        let camera = binning.camera();
        for view in views(binning, 0.0, 1) {
            let (pixels, truth) = scene.render(&view).unwrap();
            let range_m = truth.camera_from_marker.origin().coords.coords.norm();
            for ((_, processing), errors) in kinds().iter().zip(&mut errors) {
                let found = detect(&mut detector, &pixels, processing, &camera);
                errors.note(&found, truth.centre, range_m);
            }
        }
    }
    for ((name, _), errors) in kinds().iter().zip(&mut errors) {
        // Compressed and 10.7 px wide, at 13 m with 4 x 4 binning, not every one is.
        let max_missed = if *name == "all and JPEG" { 2 } else { 0 };
        errors.expect(name, max_missed, [0.02, 0.05], [0.06, 0.3]);
    }
}

/// The frames of a marker on asphalt, squarely from above at these heights, and where it is in the camera frame.
fn square_frames(
    name: &str,
    heights_m: &[f64],
) -> Vec<(Vec<u8>, Transform<geometry::Camera, MarkerFrame>)> {
    let settings = Binning::FourByFour.settings();
    let marker: Marker = format!("{name}:{SIZE_M}").parse().unwrap();
    let pad = PadInScene::flat(marker, 0.0, 0.0, 0.6);
    let ned_from_marker = pad.ned_from_marker;
    let scene = Scene { surface: Surface::Asphalt, pads: vec![pad], painted_marks: 20, light: 1.0 };
    let mut renderer = Renderer::new(&scene, settings.clone(), 77).unwrap();
    let size = settings.model.width as usize * settings.model.height as usize;
    let frame = |(index, height_m): (usize, &f64)| {
        let aside = 0.07 * height_m * ((index % 9) as f64 - 4.0) / 4.0;
        let turn = Rotation::<Ned, Body>::from_euler(0.0, 0.0, 0.7 * index as f64);
        let at = geometry::Point::new(aside, 0.5 * aside, ned_from_marker.origin().z() - height_m);
        let ned_from_body = Transform::new(turn, at);
        let mut pixels = vec![0; size];
        renderer.render(&[ned_from_body], 900 + index as u64, &mut pixels).unwrap();
        let ned_from_camera = ned_from_body * settings.body_from_camera;
        (pixels, ned_from_camera.inverse() * ned_from_marker)
    };
    heights_m.iter().enumerate().map(frame).collect()
}

#[test]
fn rings_are_found_by_ordinary_cameras_at_nearly_all_positions() {
    let presets = [Preset::Usb, Preset::RaspberryPi, Preset::ActionCamera, Preset::Phone];
    let mut near = presets.map(|_| Errors::default());
    let mut farthest = presets.map(|_| Errors::default());
    let mut detector = detector("rings");
    for binning in [Binning::TwoByTwo, Binning::FourByFour] {
        let mut scene = TestScene::new(binning).unwrap();
        let camera = binning.camera();
        // The colour mosaic leaves little of the rings of a marker of 12.7 px or less, from 11 m on with 4 x 4 binning.
        let is_near = |view: &View| binning == Binning::TwoByTwo || view.height_m < 11;
        let (near_views, far_views): (Vec<View>, Vec<View>) =
            views(binning, 0.0, 1).into_iter().partition(is_near);
        for (views, every, errors) in [(near_views, 2, &mut near), (far_views, 1, &mut farthest)] {
            for view in views.into_iter().step_by(every) {
                let (pixels, truth) = scene.render(&view).unwrap();
                let range_m = truth.camera_from_marker.origin().coords.coords.norm();
                for (preset, errors) in presets.iter().zip(errors.iter_mut()) {
                    let found = detect(&mut detector, &pixels, &preset.processing(), &camera);
                    errors.note(&found, truth.centre, range_m);
                }
            }
        }
    }
    for ((preset, near), farthest) in presets.iter().zip(&mut near).zip(&mut farthest) {
        near.expect(preset.name(), 0, [0.02, 0.06], [0.15, 0.5]);
        // The strongest compression leaves least of the rings.
        let max_missed = if *preset == Preset::ActionCamera { 5 } else { 2 };
        farthest.expect(preset.name(), max_missed, [0.04, 0.08], [0.8, 1.5]);
    }
}

/// Of 23 px, between those that have outlines of their own and those that are searched as bright blobs.
#[test]
fn rings_behind_a_steep_curve_are_found_where_they_are_neither_large_nor_small() {
    let (mut detector, mut errors) = (detector("rings"), Errors::default());
    for (binning, height_m) in [(Binning::TwoByTwo, 12), (Binning::FourByFour, 6)] {
        let mut scene = TestScene::new(binning).unwrap();
        let camera = binning.camera();
        for view in views(binning, 0.0, 10).into_iter().filter(|view| view.height_m == height_m) {
            let (pixels, truth) = scene.render(&view).unwrap();
            let found = detect(&mut detector, &pixels, &Preset::RaspberryPi.processing(), &camera);
            let range_m = truth.camera_from_marker.origin().coords.coords.norm();
            errors.note(&found, truth.centre, range_m);
        }
    }
    errors.expect("rings of 23 px", 0, [0.02, 0.06], [0.15, 0.5]);
}

/// All frames of the heights as this camera shows them.
fn rings_seen_by(preset: Preset, binning: Binning, heights_m: Range<u32>) -> Errors {
    let (mut detector, mut errors) = (detector("rings"), Errors::default());
    let mut scene = TestScene::new(binning).unwrap();
    let camera = binning.camera();
    for view in views(binning, 0.0, 4).into_iter().filter(|v| heights_m.contains(&v.height_m)) {
        let (pixels, truth) = scene.render(&view).unwrap();
        let found = detect(&mut detector, &pixels, &preset.processing(), &camera);
        let range_m = truth.camera_from_marker.origin().coords.coords.norm();
        errors.note(&found, truth.centre, range_m);
    }
    errors
}

/// Of 11 to 13 px: that curve shows all but the middle of the ink nearly white, so that a fit without a curve ends with grey ink.
#[test]
fn rings_of_a_few_pixels_are_found_behind_a_steep_curve() {
    let mut errors = rings_seen_by(Preset::RaspberryPi, Binning::FourByFour, 11..14);
    errors.expect("rings of 11 to 13 px", 1, [0.02, 0.06], [0.3, 1.0]);
}

/// Of 11 to 13 px: what compression leaves of the finest detail would make their radii too uncertain.
#[test]
fn rings_of_a_few_pixels_are_found_in_compressed_frames() {
    for (preset, max_missed) in [(Preset::Phone, 0), (Preset::Usb, 2)] {
        let mut errors = rings_seen_by(preset, Binning::FourByFour, 11..14);
        errors.expect(preset.name(), max_missed, [0.04, 0.1], [0.5, 1.5]);
    }
}

/// Of 25 to 31 px: strong compression is a larger part of their residual than the bound for larger ones allows, but their radii
/// are known.
#[test]
fn rings_of_25_px_are_found_in_strongly_compressed_frames() {
    let mut errors = rings_seen_by(Preset::ActionCamera, Binning::TwoByTwo, 9..12);
    errors.expect("rings of 25 to 31 px", 0, [0.04, 0.08], [0.2, 0.6]);
}

#[test]
fn small_squares_are_found_by_ordinary_cameras() {
    // From 23 to 11.6 px: a tone curve makes their borders thin or breaks them, and the ground nearly as bright as the paper.
    let heights_m: Vec<f64> = (0..13).map(|index| 6.0 + 0.5 * f64::from(index)).collect();
    for name in ["apriltag-16h5:7", "apriltag-36h11:7", "aruco-4x4-50:7", "stag-hd23:3"] {
        let frames = square_frames(name, &heights_m);
        let mut detector = detector(name);
        let camera = Binning::FourByFour.camera();
        for preset in [Preset::Usb, Preset::RaspberryPi, Preset::ActionCamera, Preset::Phone] {
            let mut errors = Errors::default();
            for (pixels, pose) in &frames {
                let found = detect(&mut detector, pixels, &preset.processing(), &camera);
                let centre = camera.project(pose.origin()).unwrap();
                errors.note(&found, centre, pose.origin().coords.coords.norm());
            }
            errors.expect(&format!("{name} {}", preset.name()), 0, [0.05, 0.12], [0.4, 1.5]);
        }
    }
}

/// The frame with a hard shadow to one side of a line through a pixel.
fn shaded(pixels: &[u8], width: usize, edge: Line, transmission: f32) -> Vec<u8> {
    let shadow = Occluder::Shadow { edge, penumbra_px: 2.0, transmission };
    let rows = pixels.chunks(width).enumerate();
    rows.flat_map(|(row, pixels)| {
        let mut light: Vec<f32> = pixels.iter().map(|pixel| f32::from(*pixel)).collect();
        shadow.apply(row, &mut light);
        light.into_iter().map(|level| level.round() as u8)
    })
    .collect()
}

#[test]
fn rings_under_the_edge_of_a_shadow_are_found_by_ordinary_cameras() {
    let presets = [Preset::Usb, Preset::RaspberryPi, Preset::ActionCamera, Preset::Phone];
    let mut errors = presets.map(|_| Errors::default());
    let mut detector = detector("rings");
    let binning = Binning::TwoByTwo;
    let mut scene = TestScene::new(binning).unwrap();
    let camera = binning.camera();
    let near = views(binning, 0.0, 1).into_iter().filter(|view| view.height_m <= 6);
    for (index, view) in near.step_by(2).enumerate() {
        let (pixels, truth) = scene.render(&view).unwrap();
        let range_m = truth.camera_from_marker.origin().coords.coords.norm();
        let edge = Line { through: truth.centre, normal: 1.3 * index as f64 };
        let transmission = [0.5, 0.25, 0.12][index % 3];
        let pixels = shaded(&pixels, camera.width as usize, edge, transmission);
        for (preset, errors) in presets.iter().zip(&mut errors) {
            let found = detect(&mut detector, &pixels, &preset.processing(), &camera);
            errors.note(&found, truth.centre, range_m);
        }
    }
    for (preset, errors) in presets.iter().zip(&mut errors) {
        errors.expect(preset.name(), 1, [0.03, 0.06], [0.06, 0.2]);
    }
}

#[test]
fn rings_under_the_edge_of_deep_shade_are_found_by_a_camera_without_a_tone_curve() {
    let [mut with, mut without] = [Errors::default(), Errors::default()];
    let mut detector = detector("rings");
    let binning = Binning::TwoByTwo;
    let mut scene = TestScene::new(binning).unwrap();
    let camera = binning.camera();
    let near = views(binning, 0.0, 1).into_iter().filter(|view| view.height_m <= 6);
    for (index, view) in near.step_by(2).enumerate() {
        let (pixels, truth) = scene.render(&view).unwrap();
        let range_m = truth.camera_from_marker.origin().coords.coords.norm();
        let edge = Line { through: truth.centre, normal: 1.3 * index as f64 };
        let pixels = shaded(&pixels, camera.width as usize, edge, 0.1);
        let (width, height) = (camera.width as usize, camera.height as usize);
        let view = GrayView::packed(&pixels, width, height).unwrap();
        // Straight edges have a pass of their own.
        let all = PassSchedule::ALL.without(FallbackPass::ShadowEdge);
        let fewer = all.without(FallbackPass::Brightened);
        for (schedule, errors) in [(all, &mut with), (fewer, &mut without)] {
            let found = detector.detect_with(view, Some(&camera), schedule, &mut ());
            errors.note(found, truth.centre, range_m);
        }
    }
    assert!(without.centre_px.len() < with.centre_px.len(), "the pass finds nothing");
    with.expect("brightened", 1, [0.03, 0.06], [0.06, 0.2]);
}

#[test]
fn small_markers_under_the_edge_of_a_shadow_are_found_in_the_image_without_it() {
    let camera = Binning::FourByFour.camera();
    let (width, height) = (camera.width as usize, camera.height as usize);
    let mut all = [0; 2];
    for name in ["rings", "apriltag-36h11:3", "apriltag-16h5:3", "aruco-4x4-50:7", "stag-hd23:2"] {
        let [mut with, mut without] = [Errors::default(), Errors::default()];
        let mut detector = detector(name);
        // 23 to 40 px.
        let frames = square_frames(name, &[3.5, 3.9, 4.3, 4.7, 5.0, 5.3, 5.6, 6.0]);
        for (index, (pixels, camera_from_marker)) in frames.iter().enumerate() {
            let place = camera_from_marker.origin();
            let (centre, range_m) = (camera.project(place).unwrap(), place.coords.coords.norm());
            let edge = Line { through: centre, normal: 0.4 + 1.3 * index as f64 };
            let pixels = shaded(pixels, width, edge, [0.25, 0.12][index % 2]);
            let shown = Preset::Usb.processing().apply(&pixels, width).unwrap();
            let view = GrayView::packed(&shown, width, height).unwrap();
            let fewer = PassSchedule::ALL.without(FallbackPass::ShadowEdge);
            for (schedule, errors) in [(PassSchedule::ALL, &mut with), (fewer, &mut without)] {
                let found = detector.detect_with(view, Some(&camera), schedule, &mut ());
                errors.note(found, centre, range_m);
            }
        }
        all.iter_mut().zip([&with, &without]).for_each(|(all, of)| *all += of.centre_px.len());
        with.expect(&format!("{name} across a shadow's edge"), 1, [0.05, 0.3], [0.5, 2.0]);
    }
    let [with, without] = all;
    println!("{with} with the pass, {without} without");
    // Most squares are found by their sides alone, also where an edge hides two of their corners.
    assert!(10 * without <= 9 * with, "{with} with the pass, {without} without");
}

#[test]
fn squares_and_stags_are_where_they_are_in_processed_frames() {
    let camera = Binning::FourByFour.camera();
    let bounds = [
        ("apriltag-36h11:3", [0.015, 0.05], [0.05, 0.2]),
        ("aruco-4x4-50:7", [0.015, 0.05], [0.05, 0.2]),
        ("stag-hd23:2", [0.015, 0.08], [0.1, 0.4]),
    ];
    for (name, centre_px, range_percent) in bounds {
        let mut detector = detector(name);
        let frames = square_frames(name, &[0.8, 1.3, 1.9, 2.6, 3.4, 4.5, 6.2, 8.1, 10.0]);
        for (kind, processing) in kinds() {
            let mut errors = Errors::default();
            for (pixels, camera_from_marker) in &frames {
                let found = detect(&mut detector, pixels, &processing, &camera);
                let place = camera_from_marker.origin();
                errors.note(&found, camera.project(place).unwrap(), place.coords.coords.norm());
            }
            errors.expect(&format!("{name}, {kind}"), 0, centre_px, range_percent);
        }
    }
}

/// Of 40 to 80 px only the outline of a STag is located, which a tone curve makes smaller as if it were farther away.
#[test]
fn a_weak_tone_curve_does_not_change_the_range_of_a_stag() {
    let camera = Binning::FourByFour.camera();
    let tone = ToneCurve::Gamma { exponent: 1.25 };
    let processing = Processing { tone, ..Processing::LINEAR };
    let (mut detector, mut errors) = (detector("stag-hd23:2"), Errors::default());
    for (pixels, camera_from_marker) in
        &square_frames("stag-hd23:2", &[1.8, 2.0, 2.2, 2.5, 2.8, 3.1, 3.4])
    {
        let found = detect(&mut detector, pixels, &processing, &camera);
        let place = camera_from_marker.origin();
        errors.note(&found, camera.project(place).unwrap(), place.coords.coords.norm());
        let pose = found[0].pose.unwrap();
        let off_m = pose.camera_from_marker.origin().z() - place.z();
        let deviations = off_m.abs() / pose.covariance[(2, 2)].sqrt();
        println!("{:.1} px: {deviations:.1} deviations", found[0].size_px);
        assert!(deviations < 4.0, "{off_m} m, {deviations} deviations");
    }
    errors.expect("weak tone curve", 0, [0.01, 0.02], [0.03, 0.1]);
}

/// Most pixels of such a marker, of 26 to 37 px, lie within its cells, where any model agrees with them; its place comes from the
/// others.
#[test]
fn the_range_of_squares_behind_a_steep_curve_is_as_uncertain_as_stated() {
    let camera = Binning::FourByFour.camera();
    let processing = Preset::RaspberryPi.processing();
    let heights_m: Vec<f64> = (0..36).map(|index| 3.8 + 0.045 * f64::from(index)).collect();
    for name in ["apriltag-16h5:0", "aruco-4x4-50:0"] {
        let mut detector = detector(name);
        let mut squares = Vec::new();
        for (pixels, camera_from_marker) in &square_frames(name, &heights_m) {
            let found = detect(&mut detector, pixels, &processing, &camera);
            let pose = found[0].pose.unwrap();
            let off_m = pose.camera_from_marker.origin().z() - camera_from_marker.origin().z();
            squares.push(off_m * off_m / pose.covariance[(2, 2)]);
        }
        let mean = squares.iter().sum::<f64>() / squares.len() as f64;
        println!("{name}: mean normalised squared error of the range {mean:.2}");
        assert!(mean < 2.0, "{name}: {mean}");
    }
}

/// The profile of an edge behind a tone curve is off its model by far more than its place, and errors of grey values along a side that
/// crosses many rows cancel.
#[test]
fn the_centres_of_squares_behind_a_tone_curve_are_as_uncertain_as_stated() {
    let camera = Binning::FourByFour.camera();
    let heights_m: Vec<f64> = (0..40).map(|index| 1.2 + 0.15 * f64::from(index)).collect();
    for preset in [Preset::Industrial, Preset::Usb] {
        let processing = preset.processing();
        let mut squares = Vec::new();
        for name in ["apriltag-16h5:0", "apriltag-36h11:3", "aruco-4x4-50:0"] {
            let mut detector = detector(name);
            for (pixels, camera_from_marker) in &square_frames(name, &heights_m) {
                let found = detect(&mut detector, pixels, &processing, &camera);
                let centre = camera.project(camera_from_marker.origin()).unwrap();
                let off = nalgebra::Vector2::new(
                    found[0].centre.x - centre.x,
                    found[0].centre.y - centre.y,
                );
                let weight = found[0].centre_covariance_px2.try_inverse().unwrap();
                squares.push(off.dot(&(weight * off)) / 2.0);
            }
        }
        let mean = squares.iter().sum::<f64>() / squares.len() as f64;
        println!("{preset}: mean normalised squared error of the centre {mean:.2}");
        assert!((0.7..1.4).contains(&mean), "{preset}: {mean}");
    }
}

/// The camera's response estimated from many markers constrains the next fits, and makes none of them worse.
#[test]
fn the_response_of_a_camera_is_remembered_in_a_stream() {
    let camera = Binning::FourByFour.camera();
    let (width, height) = (camera.width as usize, camera.height as usize);
    let heights_m: Vec<f64> = (0..60).map(|k| 9.0 - 0.13 * f64::from(k)).collect();
    for name in ["apriltag-36h11:3", "aruco-4x4-50:7"] {
        let frames = square_frames(name, &heights_m);
        for preset in [Preset::Linear, Preset::Usb, Preset::RaspberryPi] {
            let processing = preset.processing();
            let (mut alone, mut in_stream) = (detector(name), detector(name));
            let mut tracker = Tracker::new(TrackingSettings { full_search_period: 1 });
            let [mut one_by_one, mut remembered] = [Errors::default(), Errors::default()];
            for (index, (pixels, camera_from_marker)) in frames.iter().enumerate() {
                let shown = processing.apply(pixels, width).unwrap();
                let view = GrayView::packed(&shown, width, height).unwrap();
                let time_s = index as f64 / 15.0;
                let place = camera_from_marker.origin();
                let (centre, range_m) =
                    (camera.project(place).unwrap(), place.coords.coords.norm());
                let found =
                    tracker.detect(&mut in_stream, view, Some(&camera), time_s, &mut ()).to_vec();
                // It learns from the first half of the stream.
                if index >= 30 {
                    remembered.note(&found, centre, range_m);
                    one_by_one.note(alone.detect(view, Some(&camera), &mut ()), centre, range_m);
                }
            }
            let known = tracker.response().known();
            println!("{name}, {preset}: {known:?}");
            // Of the farthest some are not read.
            one_by_one.expect(&format!("{name}, {preset}, alone"), 3, [0.03, 0.3], [0.2, 0.8]);
            // Nearer, both are off by the error of the processing's model.
            let [median, _] = Errors::shares(&mut one_by_one.range_percent);
            let max = [(1.5 * median).max(0.1), 0.8];
            remembered.expect(&format!("{name}, {preset}, remembered"), 3, [0.03, 0.3], max);
            assert!(remembered.centre_px.len() >= one_by_one.centre_px.len());
            match known {
                Some(known) => {
                    assert_ne!(preset, Preset::Linear);
                    assert!((0.4..3.5).contains(&known.curve.value), "{known:?}");
                    assert!(known.curve.deviation < 0.5, "{known:?}");
                }
                None => assert_eq!(preset, Preset::Linear),
            }
        }
    }
}
