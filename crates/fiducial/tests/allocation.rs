//! After the first image of a size nothing is allocated for another one.
#![allow(clippy::unwrap_used, reason = "a test may stop anywhere")]
#![allow(clippy::print_stdout, reason = "the figures are what one wants to read")]

use allocation_counter::{AllocationInfo, measure};
use fiducial::{Detector, Marker, Settings};
use geometry::CameraModel;
use imaging::GrayView;
use rendering::views::{Binning, Studio, View};

/// Marker on painted asphalt, from several heights.
fn frames(binning: Binning) -> Vec<Vec<u8>> {
    let mut studio = Studio::new(binning).unwrap();
    let heights = [3, 2, 6, 9];
    heights
        .map(|height_m| {
            let view = View { binning, height_m, lateral_m: 0.0, tilt_deg: 5.0, repeat: 0 };
            studio.take(&view).unwrap().0
        })
        .to_vec()
}

fn detect(detector: &mut Detector, camera: &CameraModel, pixels: &[u8]) -> AllocationInfo {
    let view = GrayView::packed(pixels, camera.width as usize, camera.height as usize).unwrap();
    measure(|| {
        detector.detect(view, Some(camera), &mut ());
    })
}

/// Allocations for a frame seen before, and for others of its size.
fn allocations(markers: &[Marker]) -> (u64, u64, u64) {
    let binning = Binning::FourByFour;
    let camera = binning.camera();
    let frames = frames(binning);
    let mut detector = Detector::new(markers, Settings::default()).unwrap();
    let first = detect(&mut detector, &camera, &frames[0]);
    let again = detect(&mut detector, &camera, &frames[0]).count_total;
    let others = frames.iter().map(|frame| detect(&mut detector, &camera, frame).count_total);
    (first.bytes_max, again, others.sum())
}

#[test]
fn nothing_is_allocated_per_frame() {
    let families =
        ["rings", "rings-thesis", "apriltag-16h5", "apriltag-36h11", "aruco-4x4-50", "stag-hd23"];
    let marker = |family: &str| format!("{family}:0.15341").parse::<Marker>();
    let of = |family: &str| {
        marker(family).unwrap_or_else(|_| format!("{family}:0:0.15341").parse().unwrap())
    };
    let all: Vec<Marker> = families.iter().map(|family| of(family)).collect();
    let mut lists: Vec<(String, Vec<Marker>)> =
        families.iter().map(|family| ((*family).to_owned(), vec![of(family)])).collect();
    lists.push(("all".to_owned(), all));
    for (name, markers) in lists {
        let (most_bytes, again, others) = allocations(&markers);
        println!(
            "{name}: {most_bytes} bytes at first, {again} allocations for the same frame, {others} for others"
        );
    }
}
