//! Compares tracking a marker through rendered frames with searches of whole frames.
#![allow(clippy::unwrap_used, reason = "a test may stop anywhere")]

mod render;

use fiducial::{Detector, Settings, Tracker, TrackingSettings};
use geometry::CameraModel;
use imaging::GrayImage;
use render::{SIZE_M, Scene};

/// A marker that crosses the image, with a jump in the middle, and is out of sight in two frames.
fn frames(camera: CameraModel) -> Vec<(Option<Scene>, GrayImage)> {
    let frame = |i: u32| {
        let along = f64::from(i) * 0.03 + if i < 10 { 0.0 } else { 0.6 };
        let mut scene = Scene::new(camera, [along - 0.9, 0.3 - 0.4 * along, 4.0], 0.1, 0.3);
        scene.seed = u64::from(i) + 1;
        match i {
            14 | 15 => {
                (None, GrayImage::filled(camera.width as usize, camera.height as usize, 110))
            }
            _ => (Some(scene), scene.render()),
        }
    };
    (0..24).map(frame).collect()
}

/// Counts the searches by the stage that each search reports first.
#[derive(Default)]
struct Stages {
    first: Option<&'static str>,
    searches: usize,
}

impl fiducial::StageObserver for Stages {
    fn ended(&mut self, stage: &'static str) {
        let first = *self.first.get_or_insert(stage);
        self.searches += usize::from(stage == first);
    }
}

#[test]
fn a_marker_that_moves_jumps_and_vanishes_is_followed() {
    let camera = CameraModel::pinhole(648, 486, 909.0);
    let marker = format!("rings:{SIZE_M}").parse().unwrap();
    let mut detector = Detector::new(&[marker], Settings::default()).unwrap();
    let mut whole = Detector::new(&[marker], Settings::default()).unwrap();
    let mut tracker = Tracker::new(TrackingSettings { full_search_period: 8 });
    for (i, (scene, image)) in frames(camera).iter().enumerate() {
        let view = image.view().unwrap();
        let mut stages = Stages::default();
        let time_s = i as f64 * 0.05;
        let found =
            tracker.detect(&mut detector, view, Some(&camera), time_s, &mut stages).to_vec();
        let expected = whole.detect(view, Some(&camera), &mut ());
        assert_eq!(
            (found.len(), expected.len()),
            (scene.iter().count(), scene.iter().count()),
            "{i}"
        );
        if let (Some(scene), Some(found)) = (scene, found.first()) {
            assert!(found.centre.distance(&expected[0].centre) < 0.02, "{i}");
            let at = found.pose.unwrap().camera_from_marker.origin();
            let truth = scene.camera_from_marker.origin();
            assert!((at.coords - truth.coords).norm() < 0.02, "{i}: {at:?}");
            assert_eq!(tracker.trace().markers.len(), 1);
            assert!(tracker.trace().markers[0].centre.distance(&scene.centre()) < 0.5);
        }
        // The marker was not where it was expected after the jump and when it vanished.
        let searches = if matches!(i, 10 | 14) { 2 } else { 1 };
        assert_eq!(stages.searches, searches, "{i}");
    }
}

#[test]
fn the_innermost_ring_alone_is_a_marker_only_where_one_is_followed() {
    let camera = CameraModel::pinhole(648, 486, 909.0);
    let marker = format!("rings:{SIZE_M}").parse().unwrap();
    let mut detector = Detector::new(&[marker], Settings::default()).unwrap();
    let mut whole = Detector::new(&[marker], Settings::default()).unwrap();
    let mut tracker = Tracker::default();
    let mut alone = 0;
    for i in 0..15_u32 {
        // Down to where the next ring is out of sight.
        let range_m = 0.19 - 0.01 * f64::from(i);
        let mut scene = Scene::new(camera, [0.001, -0.002, range_m], 0.05, 0.3);
        scene.seed = u64::from(i) + 1;
        let image = scene.render();
        let view = image.view().unwrap();
        let time_s = f64::from(i) / 15.0;
        let found = tracker.detect(&mut detector, view, Some(&camera), time_s, &mut ()).to_vec();
        assert_eq!(found.len(), 1, "{range_m}");
        assert!(found[0].centre.distance(&scene.centre()) < 0.5, "{range_m}");
        if whole.detect(view, Some(&camera), &mut ()).is_empty() {
            alone += 1;
        }
    }
    // In a single image it may be any circle.
    assert!(alone >= 2, "{alone}");
}

/// The slow passes' stages, in the order in which they run in one image.
const ALL: [&str; 6] = ["shadow", "arcs", "blobs", "segments", "quiet zones", "brightened"];

/// Keeps the names of the slow passes' stages.
#[derive(Default)]
struct SlowPasses(Vec<&'static str>);

impl fiducial::StageObserver for SlowPasses {
    fn ended(&mut self, stage: &'static str) {
        if ALL.contains(&stage) {
            self.0.push(stage);
        }
    }
}

#[test]
fn slow_passes_take_turns_until_a_damaged_marker_is_found() {
    let camera = CameraModel::pinhole(648, 486, 909.0);
    let markers = [
        format!("rings:{SIZE_M}"),
        "apriltag-36h11:0:0.2".to_owned(),
        "stag-hd23:0:0.2".to_owned(),
    ];
    let markers = markers.map(|marker| marker.parse().unwrap());
    let mut detector = Detector::new(&markers, Settings::default()).unwrap();
    let mut tracker = Tracker::default();
    // Only arcs of the rings are in view.
    let mut scene = Scene::new(camera, [0.53, 0.0, 1.5], 0.0, 0.0);
    scene.seed = 3;
    let (cut, mut bare) = (scene.render(), GrayImage::filled(648, 486, 110));
    // Nothing lies in shade where nothing is in the light.
    let mut slow = SlowPasses::default();
    detector.detect(bare.view().unwrap(), Some(&camera), &mut slow);
    assert_eq!(slow.0, ALL[..5]);
    (0..486).for_each(|y| bare.row_mut(y)[..300].fill(30));
    let mut passes = Vec::new();
    let mut found_after = None;
    for i in 0..20_u32 {
        let image = if i < 9 { &bare } else { &cut };
        let mut slow = SlowPasses::default();
        let view = image.view().unwrap();
        let time_s = f64::from(i) * 0.05;
        let found =
            !tracker.detect(&mut detector, view, Some(&camera), time_s, &mut slow).is_empty();
        if i == 0 {
            assert_eq!(slow.0, ALL);
        } else {
            assert_eq!(slow.0.len(), 1, "{i}: {:?}", slow.0);
            passes.append(&mut slow.0);
        }
        if found {
            found_after = Some(i - 9);
            break;
        }
    }
    let in_turn = [
        "arcs",
        "quiet zones",
        "segments",
        "blobs",
        "quiet zones",
        "segments",
        "shadow",
        "brightened",
        "quiet zones",
    ];
    assert_eq!(passes[..9], in_turn);
    assert!(found_after.is_some_and(|images| images < 9), "{found_after:?}");
}
