//! Tests STags as a camera sees them: from close up to where a dot is hardly wider than a pixel, in shadow, in glare, covered,
//! cut, and printed the other way round.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may stop anywhere")]

use fiducial::{Detector, Observation, Settings};
use geometry::{CameraModel, Pixel};
use imaging::GrayView;
use markers::{Drawing, Family, Ink, Marker};

const SIDE: usize = 72;
/// Width and height of the images of markers of which a part cannot be seen.
const LARGE: usize = 192;

/// A marker's drawing with its square `side_px` wide, turned about a point near the middle of the image: every pixel is the
/// mean of the area that it and half of its neighbours cover, with noise of two grey levels.
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
        self.seen(SIDE, |_, light| light)
    }

    /// An image of `size` pixels both ways; `veil` changes the light of a point, which is given in sides of the
    /// marker from its middle, right and down.
    fn seen(&self, size: usize, veil: impl Fn([f64; 2], f64) -> f64) -> Vec<u8> {
        const SAMPLES: usize = 4;
        const WIDTH_PX: f64 = 2.0;
        let (sin, cos) = self.turn.sin_cos();
        let offset = |k: usize| ((k as f64 + 0.5) / SAMPLES as f64 - 0.5) * WIDTH_PX;
        let reach = 0.625;
        let light = |x: f64, y: f64| {
            let (dx, dy) = (x - self.centre[0], y - self.centre[1]);
            let [u, v] = [cos * dx + sin * dy, cos * dy - sin * dx].map(|p| p / self.side_px);
            let grey = match self.drawing.ink_at(u, -v) {
                _ if u.abs().max(v.abs()) > reach => 110.0,
                Ink::White => 210.0,
                Ink::Black => 30.0,
            };
            veil([u, v], grey).clamp(0.0, 255.0)
        };
        let mut noise = 0x2545_f491_u32;
        (0..size * size)
            .map(|i| {
                let (x, y) = ((i % size) as f64, (i / size) as f64);
                let all = (0..SAMPLES * SAMPLES)
                    .map(|s| light(x + offset(s % SAMPLES), y + offset(s / SAMPLES)));
                noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                let mean = all.sum::<f64>() / (SAMPLES * SAMPLES) as f64;
                (mean + f64::from(noise >> 24) / 128.0 * 3.5 - 3.5).round().clamp(0.0, 255.0) as u8
            })
            .collect()
    }
}

fn detect(detector: &mut Detector, image: &[u8]) -> Vec<Observation> {
    let size = image.len().isqrt();
    let view = GrayView::packed(image, size, size).unwrap();
    let camera = CameraModel::pinhole(size as u32, size as u32, 900.0);
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

/// Asserts that markers of several families and turns are found with their corners to `max_px` in spite of the veil.
fn expect(name: &str, centre: [f64; 2], max_px: f64, veil: impl Fn([f64; 2], f64) -> f64) {
    for (family, id) in [(Family::StagHd23, 3), (Family::StagHd21, 7), (Family::StagHd11, 12_345)] {
        let mut detector = detector(&format!("{family}:*:0.1"));
        for turn in [0.8, 4.3] {
            let shot = Shot { centre, ..Shot::new(family, id, 84.0, turn) };
            let found = detect(&mut detector, &shot.seen(LARGE, &veil));
            let name = format!("{family}:{id} turned by {turn} {name}");
            assert_eq!(found.len(), 1, "{name}: {found:?}");
            assert_eq!(found[0].id, Some(id), "{name}");
            let corners = found[0].corners.unwrap();
            for (corner, truth) in corners.iter().zip(shot.corners()) {
                let off_px = corner.distance(&truth);
                assert!(off_px < max_px, "{name}: {off_px} px");
            }
        }
    }
}

const MIDDLE: [f64; 2] = [95.3, 96.6];

#[test]
fn white_on_black_is_found() {
    expect("inverted", MIDDLE, 0.1, |_, light| 240.0 - light);
}

#[test]
fn the_edge_of_a_shadow_does_not_hide_a_marker() {
    expect(
        "in shadow",
        MIDDLE,
        0.3,
        |[u, v], light| {
            if u + 0.4 * v > 0.07 { 0.25 * light } else { light }
        },
    );
}

#[test]
fn a_reflection_does_not_hide_a_marker() {
    expect("in glare", MIDDLE, 3.0, |[u, v], light| {
        let away = (u - 0.3).hypot(v + 0.15) / 0.13;
        light + 300.0 * (-0.5 * away * away).exp()
    });
}

#[test]
fn a_covered_corner_does_not_hide_a_marker() {
    for level in [20.0, 90.0, 230.0] {
        let cover = |[u, v]: [f64; 2], light: f64| if u + v > 0.7 { level } else { light };
        expect("covered", MIDDLE, 0.5, cover);
    }
}

#[test]
fn a_marker_that_the_frame_cuts_is_found() {
    // Its left end, and where it is turned the most its left corner, is beyond the frame.
    expect("cut", [38.5, 96.6], 1.5, |_, light| light);
}

/// A lens' Gaussian blur instead of the shot's even one, from samples a quarter of a pixel apart, elsewhere in each pixel.
fn blurred(shot: &Shot) -> Vec<u8> {
    const SAMPLES: usize = 15;
    let (sin, cos) = shot.turn.sin_cos();
    let light = |x: f64, y: f64| {
        let (dx, dy) = (x - shot.centre[0], y - shot.centre[1]);
        let [u, v] = [cos * dx + sin * dy, cos * dy - sin * dx].map(|p| p / shot.side_px);
        match shot.drawing.ink_at(u, -v) {
            _ if u.abs().max(v.abs()) > 0.625 => 80.0,
            Ink::White => 210.0,
            Ink::Black => 30.0,
        }
    };
    let grey = |i: usize| {
        let (x, y, place) = ((i % SIDE) as f64, (i / SIDE) as f64, i as f64);
        let offsets = [0.7549 * place, 0.5698 * place]
            .map(|part| (0..SAMPLES).map(move |k| (k as f64 - 7.5 + part.fract()) / 4.0));
        let (mut sum, mut weights) = (0.0, 0.0);
        for dy in offsets[1].clone() {
            for dx in offsets[0].clone() {
                let weight = (-2.5 * (dx * dx + dy * dy)).exp();
                sum += weight * light(x + dx, y + dy);
                weights += weight;
            }
        }
        (sum / weights).round() as u8
    };
    (0..SIDE * SIDE).map(grey).collect()
}

#[test]
fn small_markers_are_as_large_as_they_are() {
    let mut detector = detector("stag-hd23:*:0.1");
    for side_px in [18.0, 30.0] {
        let errors: Vec<f64> = (0..12)
            .map(|k| {
                let k = f64::from(k);
                let centre = [35.0 + (0.37 * k).fract(), 36.0 + (0.73 * k).fract()];
                let shot =
                    Shot { centre, ..Shot::new(Family::StagHd23, 4, side_px, 0.1 + 0.37 * k) };
                let found = detect(&mut detector, &blurred(&shot));
                let [a, b, c, d] = found[0].corners.unwrap();
                let twice = (c.x - a.x) * (d.y - b.y) - (d.x - b.x) * (c.y - a.y);
                (twice / 2.0).sqrt() - side_px
            })
            .collect();
        let mean_px = errors.iter().sum::<f64>() / errors.len() as f64;
        assert!(mean_px.abs() < 0.004, "{side_px}: {mean_px} px");
    }
}

#[test]
fn where_the_border_is_hardly_seen_the_paper_shows_the_marker() {
    for (id, turn) in [(0, 0.8), (1, 0.7), (2, 2.3), (3, 0.9)] {
        let mut detector = detector("stag-hd23:*:0.1");
        let shot = Shot::new(Family::StagHd23, id, 10.0, turn);
        let found = detect(&mut detector, &blurred(&shot));
        assert_eq!(found.len(), 1, "{id}");
        assert_eq!(found[0].id, Some(id));
        for (corner, truth) in found[0].corners.unwrap().iter().zip(shot.corners()) {
            assert!(corner.distance(&truth) < 0.15, "{id}");
        }
    }
}

/// A square image seen through a lens out of focus, whose blur is normal with this standard deviation, in pixels.
fn out_of_focus(image: &[u8], blur_px: f64) -> Vec<u8> {
    let size = image.len().isqrt();
    let reach = (3.0 * blur_px).ceil() as isize;
    let weights: Vec<f64> =
        (-reach..=reach).map(|k| (-0.5 * (k as f64 / blur_px).powi(2)).exp()).collect();
    let whole: f64 = weights.iter().sum();
    // Along the rows, with rows and columns exchanged.
    let along = |image: &[f64]| -> Vec<f64> {
        let grey = |i: usize| {
            let (x, y) = (i / size, i % size);
            let place = |k: usize| (x + k).saturating_sub(reach as usize).min(size - 1);
            let sum = weights.iter().enumerate().map(|(k, w)| w * image[y * size + place(k)]);
            sum.sum::<f64>() / whole
        };
        (0..size * size).map(grey).collect()
    };
    let greys: Vec<f64> = image.iter().map(|grey| f64::from(*grey)).collect();
    along(&along(&greys)).iter().map(|grey| grey.round() as u8).collect()
}

#[test]
fn a_lens_out_of_focus_does_not_hide_a_marker() {
    let mut detector = detector("stag-hd23:*:0.15341");
    for (k, side_px) in [38.0, 42.0, 45.0, 48.0, 53.0].into_iter().enumerate() {
        for id in 0..6 {
            let turn = 0.3 + 0.9 * f64::from(id) + 0.2 * k as f64;
            let shot =
                Shot { centre: [95.3, 96.6], ..Shot::new(Family::StagHd23, id, side_px, turn) };
            let image = out_of_focus(&shot.seen(LARGE, |_, light| light), 2.5);
            let found = detect(&mut detector, &image);
            let name = format!("{id} of {side_px} px turned by {turn}");
            assert_eq!(found.len(), 1, "{name}");
            assert_eq!(found[0].id, Some(id), "{name}");
            for (corner, truth) in found[0].corners.unwrap().iter().zip(shot.corners()) {
                let off = corner.distance(&truth);
                assert!(off < 0.3, "{name}: {off} px");
            }
        }
    }
}

#[test]
fn a_drawing_in_black_and_white_is_as_certain_as_its_sides() {
    let mut detector = detector("stag-hd21:3:0.2");
    for side_px in [60.0, 101.3, 124.7] {
        for turn in [0.0, 0.02, 0.785] {
            let shot = Shot { centre: MIDDLE, ..Shot::new(Family::StagHd21, 3, side_px, turn) };
            let grey = shot.seen(LARGE, |_, light| if light < 60.0 { 30.0 } else { 210.0 });
            let image: Vec<u8> = grey.iter().map(|it| if *it < 120 { 0 } else { 255 }).collect();
            let found = detect(&mut detector, &image);
            let [seen] = found.as_slice() else { panic!("{side_px} px, {turn} rad: {found:?}") };
            let name = format!("{side_px} px, {turn} rad");
            let off_px = (seen.centre.x - MIDDLE[0]).hypot(seen.centre.y - MIDDLE[1]);
            let variance_px2 = seen.centre_covariance_px2.trace();
            assert!(off_px < 0.4 && off_px * off_px < 4.0 * variance_px2, "{name}: {off_px} px");
            assert!(variance_px2 < 0.15, "{name}: {variance_px2}");
        }
    }
}
