//! Tests the detector's processor time on images of patterns and noise, relative to a normal frame of the same
//! size, and its search of images from 1 x 1 to 16384 pixels long.
#![allow(clippy::unwrap_used, reason = "a test may stop anywhere")]
#![allow(clippy::print_stdout, reason = "the figures are for people to read")]

use experiments::record::processor_ms;
use fiducial::{Detector, Settings};
use imaging::GrayView;
use markers::Marker;
use rendering::views::{Binning, MARKERS, TestScene, View};

/// Maximum time of any image relative to a normal frame of the same size.
const MAX_RATIO: f64 = 20.0;
/// Maximum number of attempts, for a machine with other load.
const TRIES: usize = 4;

fn detector() -> Detector {
    let markers: Vec<Marker> =
        MARKERS.iter().map(|name| format!("{name}:0.15341").parse().unwrap()).collect();
    Detector::new(&markers, Settings::default()).unwrap()
}

/// The shortest of three processor times for an image, in milliseconds.
fn time_ms(detector: &mut Detector, pixels: &[u8], width: usize, height: usize) -> f64 {
    let view = GrayView::packed(pixels, width, height).unwrap();
    let mut shortest = f64::INFINITY;
    for _ in 0..3 {
        let start = processor_ms();
        detector.detect(view, None, &mut ());
        shortest = shortest.min(processor_ms() - start);
    }
    shortest
}

/// The grey level at a position.
type Grey<'a> = &'a dyn Fn(usize, usize) -> u8;

/// A bijection that scatters (splitmix64's finaliser).
fn scattered(index: usize) -> u8 {
    let key = (index as u64).wrapping_add(0x9e37_79b9_7f4a_7c15);
    let key = (key ^ (key >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let key = (key ^ (key >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    (key ^ (key >> 31)) as u8
}

#[test]
fn any_image_is_processed_in_bounded_time() {
    let binning = Binning::FourByFour;
    let (width, height) = (binning.camera().width as usize, binning.camera().height as usize);
    let view = View { binning, height_m: 3, lateral_m: 0.0, tilt_deg: 5.0, repeat: 0 };
    let (normal, _) = TestScene::new(binning).unwrap().render(&view).unwrap();
    let black_or_white = |white: bool| if white { 255 } else { 0 };
    let images: [(&str, Grey<'_>); 10] = [
        ("constant", &|_, _| 128),
        ("single pixels", &|x, y| black_or_white((x + y) % 2 == 0)),
        ("pairs of pixels", &|x, y| black_or_white((x / 2 + y / 2) % 2 == 0)),
        ("cells of 5 px", &|x, y| black_or_white((x / 5 + y / 5) % 2 == 0)),
        ("dots", &|x, y| black_or_white(x % 3 == 0 && y % 3 == 0)),
        ("stripes", &|x, _| black_or_white(x % 2 == 0)),
        ("chance", &|x, y| scattered(y * 10_000 + x)),
        ("coarse chance", &|x, y| black_or_white(scattered(y / 4 * 10_000 + x / 4) > 127)),
        ("squares", &|x, y| black_or_white(!(x % 12 > 2 && y % 12 > 2))),
        ("rings", &|x, y| {
            let [x, y] = [x, y].map(|place| (place % 24) as f64 - 12.0);
            black_or_white(!(6.0..9.0).contains(&x.hypot(y)))
        }),
    ];
    let mut detector = detector();
    for (name, grey) in images {
        let pixels: Vec<u8> =
            (0..width * height).map(|place| grey(place % width, place / width)).collect();
        let mut min_ratio = f64::INFINITY;
        for _ in 0..TRIES {
            let (hostile_ms, normal_ms) = (
                time_ms(&mut detector, &pixels, width, height),
                time_ms(&mut detector, &normal, width, height),
            );
            min_ratio = min_ratio.min(hostile_ms / normal_ms);
            if min_ratio <= MAX_RATIO {
                break;
            }
        }
        println!("{name}: {min_ratio:.1} times a normal frame");
        assert!(min_ratio <= MAX_RATIO, "{name}: {min_ratio:.1} times as long as a normal frame");
    }
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
