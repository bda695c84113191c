//! Images of any size are looked at. How long images take is tried where there is a clock, in `tools/experiments`.
#![allow(clippy::unwrap_used, reason = "a test may stop anywhere")]

use fiducial::{Detector, Marker, Settings};
use imaging::GrayView;

fn detector() -> Detector {
    let names = ["rings", "apriltag-16h5:0", "apriltag-36h11:0", "aruco-4x4-50:0", "stag-hd23:0"];
    let markers: Vec<Marker> =
        names.iter().map(|name| format!("{name}:0.15341").parse().unwrap()).collect();
    Detector::new(&markers, Settings::default()).unwrap()
}

/// A bijection that scatters (splitmix64's finaliser).
fn scattered(index: usize) -> u8 {
    let key = (index as u64).wrapping_add(0x9e37_79b9_7f4a_7c15);
    let key = (key ^ (key >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let key = (key ^ (key >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    (key ^ (key >> 31)) as u8
}

#[test]
fn images_of_any_size_are_looked_at() {
    let mut detector = detector();
    assert!(GrayView::packed(&[], 0, 0).is_err());
    for (width, height) in [(1, 1), (2, 3), (16_384, 1), (1, 16_384), (16_384, 40), (7, 16_384)] {
        let pixels: Vec<u8> = (0..width * height).map(scattered).collect();
        let view = GrayView::packed(&pixels, width, height).unwrap();
        let found = detector.detect(view, None, &mut ()).len();
        assert_eq!(found, 0, "{width} x {height}");
    }
}
