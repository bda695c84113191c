//! STags as a camera sees them: from close up to where a dot is hardly wider than a pixel.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may stop anywhere")]

use fiducial::{Detector, Drawing, Family, Ink, Marker, Observation, Settings};
use geometry::{CameraModel, Pixel};
use imaging::GrayView;

const SIDE: usize = 72;

/// A marker's drawing with its square `side_px` wide, turned about a point near the middle of the image: every pixel is the
/// mean of what it and half of its neighbours cover, with noise of two grey levels.
struct Shot {
    drawing: Drawing,
    side_px: f64,
    turn: f64,
    centre: [f64; 2],
}

impl Shot {
    fn new(family: Family, id: u32, side_px: f64, turn: f64) -> Self {
        let marker = Marker { family, id: Some(id), size_m: None };
        let drawing = Drawing::new(&marker, 1.0).unwrap();
        Self { drawing, side_px, turn, centre: [35.3, 36.6] }
    }

    fn corners(&self) -> [Pixel; 4] {
        let (sin, cos) = self.turn.sin_cos();
        [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]].map(|[x, y]| {
            let [x, y] = [x * self.side_px, y * self.side_px];
            Pixel::new(self.centre[0] + cos * x - sin * y, self.centre[1] + sin * x + cos * y)
        })
    }

    fn image(&self) -> Vec<u8> {
        const SAMPLES: usize = 4;
        const WIDTH_PX: f64 = 2.0;
        let (sin, cos) = self.turn.sin_cos();
        let offset = |k: usize| ((k as f64 + 0.5) / SAMPLES as f64 - 0.5) * WIDTH_PX;
        let reach = 0.625;
        let light = |x: f64, y: f64| {
            let (dx, dy) = (x - self.centre[0], y - self.centre[1]);
            let [u, v] = [cos * dx + sin * dy, cos * dy - sin * dx].map(|p| p / self.side_px);
            match self.drawing.ink_at(u, -v) {
                _ if u.abs().max(v.abs()) > reach => 110.0,
                Ink::White => 210.0,
                Ink::Black => 30.0,
            }
        };
        let mut noise = 0x2545_f491_u32;
        (0..SIDE * SIDE)
            .map(|i| {
                let (x, y) = ((i % SIDE) as f64, (i / SIDE) as f64);
                let all = (0..SAMPLES * SAMPLES)
                    .map(|s| light(x + offset(s % SAMPLES), y + offset(s / SAMPLES)));
                noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                let mean = all.sum::<f64>() / (SAMPLES * SAMPLES) as f64;
                (mean + f64::from(noise >> 24) / 128.0 * 3.5 - 3.5).round() as u8
            })
            .collect()
    }
}

fn detect(detector: &mut Detector, image: &[u8]) -> Vec<Observation> {
    let view = GrayView::packed(image, SIDE, SIDE).unwrap();
    let camera = CameraModel::pinhole(SIDE as u32, SIDE as u32, 900.0);
    detector.detect(view, Some(&camera), &mut ()).to_vec()
}

/// The observation of a shot, when it is the only one and names the marker.
fn check(detector: &mut Detector, family: Family, id: u32, side_px: f64, turn: f64) -> f64 {
    let shot = Shot::new(family, id, side_px, turn);
    let found = detect(detector, &shot.image());
    let name = format!("{family}:{id} of {side_px} px turned by {turn}");
    assert_eq!(found.len(), 1, "{name}: {found:?}");
    assert_eq!((found[0].family, found[0].id), (family, Some(id)), "{name}");
    let corners = found[0].corners.unwrap();
    let errors = (0..4).map(|i| corners[i].distance(&shot.corners()[i]));
    errors.fold(0.0, f64::max)
}

fn detector(text: &str) -> Detector {
    Detector::new(&[text.parse().unwrap()], Settings::default()).unwrap()
}

#[test]
fn ids_of_every_family_are_read() {
    for (family, count) in [
        (Family::StagHd11, 22_309),
        (Family::StagHd13, 2_884),
        (Family::StagHd15, 766),
        (Family::StagHd17, 157),
        (Family::StagHd19, 38),
        (Family::StagHd21, 12),
        (Family::StagHd23, 6),
    ] {
        let mut detector = detector(&format!("{family}:*:0.1"));
        for id in (0..count).step_by(count as usize / 6) {
            let error_px = check(&mut detector, family, id, 36.0, 0.4 + f64::from(id));
            assert!(error_px < 0.2, "{family}:{id}: {error_px} px");
        }
    }
}

#[test]
fn markers_of_fourteen_pixels_are_read() {
    let mut detector = detector("stag-hd23:*:0.15341");
    for id in 0..6 {
        for turn in [0.0, 0.3, 2.0, 4.5] {
            let error_px = check(&mut detector, Family::StagHd23, id, 14.0, turn);
            assert!(error_px < 0.4, "{id} {turn}: {error_px} px");
        }
    }
}

#[test]
fn a_marker_that_is_not_looked_for_is_not_found() {
    let image = Shot::new(Family::StagHd23, 2, 36.0, 0.2).image();
    for text in ["stag-hd23:3", "stag-hd21", "stag-hd11", "apriltag-16h5"] {
        assert_eq!(detect(&mut detector(text), &image), [], "{text}");
    }
    assert_eq!(detect(&mut detector("stag-hd23:2"), &image).len(), 1);
}
