//! Checks the memory: a few frames' worth at first, and nothing for any frame after the first, with any content.
#![allow(clippy::unwrap_used, reason = "a test may stop anywhere")]
#![allow(clippy::print_stdout, reason = "the tests print their figures")]

use allocation_counter::{AllocationInfo, measure};
use fiducial::{Detector, Settings};
use geometry::CameraModel;
use imaging::GrayView;
use markers::Marker;
use rendering::views::{Binning, MARKERS, TestScene, View};

/// The limit of a detector's first allocation, in frames.
const MAX_FRAMES: f64 = 8.0;

/// A marker on painted asphalt, from several heights; and tiles, among whose joints there are as many quads as are
/// kept.
fn frames(binning: Binning) -> Vec<Vec<u8>> {
    let mut scene = TestScene::new(binning).unwrap();
    let asphalt = [3, 2, 6, 9].map(|height_m| {
        let view = View { binning, height_m, lateral_m: 0.0, tilt_deg: 5.0, repeat: 0 };
        scene.render(&view).unwrap().0
    });
    let camera = binning.camera();
    let (width, height) = (camera.width as usize, camera.height as usize);
    let grey = |x: usize, y: usize| {
        let is_joint = (x + y / 8) % 72 < 6 || (y + 1000 - x / 8) % 72 < 6;
        if is_joint { 30 } else { 120 + ((x / 72 * 37 + y / 72 * 91) % 60) as u8 }
    };
    let tiles = (0..width * height).map(|i| grey(i % width, i / width)).collect();
    asphalt.into_iter().chain([tiles]).collect()
}

fn detect(detector: &mut Detector, camera: &CameraModel, pixels: &[u8]) -> AllocationInfo {
    let view = GrayView::packed(pixels, camera.width as usize, camera.height as usize).unwrap();
    measure(|| {
        detector.detect(view, Some(camera), &mut ());
    })
}

#[test]
fn nothing_is_allocated_per_frame() {
    let binning = Binning::TwoByTwo;
    let (camera, frames) = (binning.camera(), frames(binning));
    let markers: Vec<Marker> =
        MARKERS.iter().map(|name| format!("{name}:0.15341").parse().unwrap()).collect();
    let each = MARKERS.iter().zip(&markers).map(|(name, marker)| (*name, vec![*marker]));
    for (name, markers) in each.chain([("all", markers.clone())]) {
        let mut detector = Detector::new(&markers, Settings::default()).unwrap();
        let first = detect(&mut detector, &camera, &frames[0]);
        let again = detect(&mut detector, &camera, &frames[0]).count_total;
        let mut of_all = || -> u64 {
            frames.iter().map(|frame| detect(&mut detector, &camera, frame).count_total).sum()
        };
        let (others, later) = (of_all(), of_all());
        let in_frames = first.bytes_max as f64 / frames[0].len() as f64;
        println!(
            "{name}: at first {in_frames:.1} frames' worth; allocations for the same frame {again}, for others {others}, for those again {later}"
        );
        assert!(in_frames <= MAX_FRAMES, "{name}: {in_frames} frames' worth");
        assert_eq!((again, others, later), (0, 0, 0), "{name}");
    }
}
