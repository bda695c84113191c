//! Frames without a marker of ours, of circles that people make: manholes, washers, wheels, helipads,
//! traffic signs, archery targets, discs, and the markers of others (WhyCon, CCTag).

use std::f64::consts::TAU;

use geometry::Pixel;
use markers::{Drawing, Ink, Layer, Shape};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rendering::views::Binning;
use rendering::{Preset, Surface};

use super::clutter::{disc, drawing, place, rectangle};
use super::scene::{Draw, centre, near};
use crate::frame_spec::{FrameSpec, Tilt, pose};
use crate::set::Set;
use rendering::occluder::{Line, Occluder};

/// Number of scenes.
pub(super) const SCENES: usize = 520;

/// Distances of the camera, in metres.
const DISTANCE_M: std::ops::Range<f64> = 0.5..5.0;

/// A name, and a random drawing about as wide as 1 m.
type Kind = (&'static str, fn(&mut ChaCha8Rng) -> Vec<Layer>);

/// The kinds of circles, and their sizes in metres from the smallest.
const KINDS: [(Kind, [f64; 2]); 14] = [
    (("manhole", manhole), [0.4, 0.8]),
    (("washer", washer), [0.02, 0.3]),
    (("wheel", wheel), [0.2, 0.7]),
    (("lamp", lamp), [0.1, 0.5]),
    (("bulls-eye", bulls_eye), [0.05, 0.8]),
    (("helipad", helipad), [0.3, 1.5]),
    (("roundel", roundel), [0.1, 0.8]),
    (("traffic-sign", traffic_sign), [0.2, 0.9]),
    (("archery", archery), [0.2, 1.2]),
    (("disc", compact_disc), [0.08, 0.3]),
    (("drain", drain), [0.1, 0.4]),
    (("cup", cup), [0.06, 0.25]),
    (("whycon", whycon), [0.05, 0.4]),
    (("cctag", cctag), [0.05, 0.5]),
];

/// Those of the scenes in turn; fixed, so that a further kind of camera leaves the scenes of a seed as they are.
const CAMERAS: [Preset; 6] = [
    Preset::Linear,
    Preset::Usb,
    Preset::RaspberryPi,
    Preset::Industrial,
    Preset::ActionCamera,
    Preset::Phone,
];

pub(super) fn frames(draw: Draw) -> Vec<FrameSpec> {
    (0..SCENES).map(|frame| spec(draw, frame)).collect()
}

fn spec(draw: Draw, frame: usize) -> FrameSpec {
    let (mut rng, seed) = draw.frame_rng(Set::Circles, frame);
    let round = frame / KINDS.len();
    let binning = if round.is_multiple_of(3) { Binning::TwoByTwo } else { Binning::FourByFour };
    let light = 10f64.powf(rng.random_range(-1.0..0.2));
    let mut settings = binning.settings().exposed_for(light, rng.random_range(120.0..280.0), 0.004);
    settings.blur_px = rng.random_range(0.3..1.2);
    // Every other scene as cameras show it.
    let preset = CAMERAS[if round.is_multiple_of(2) { 0 } else { round / 2 % CAMERAS.len() }];
    settings.processing = preset.processing();
    let model = settings.model;
    let tilt = Tilt { angle: rng.random_range(0.0..0.9), about: rng.random_range(0.0..TAU) };
    let distance_m =
        DISTANCE_M.start * (DISTANCE_M.end / DISTANCE_M.start).powf(rng.random_range(0.0..1.0));
    let at = near(&mut rng, centre(&model), 50.0);
    let ((group, _), _) = KINDS[frame % KINDS.len()];
    let mut spec = FrameSpec {
        group: group.to_owned(),
        surface: Surface::ALL[round % 4],
        painted_marks: rng.random_range(0..20),
        light,
        ..FrameSpec::negative(settings, pose(&model, at, distance_m, tilt, 0.0), seed)
    };
    let centre = spec.place();
    for number in 0..rng.random_range(5..20) {
        let kind = if rng.random_bool(0.2) { rng.random_range(0..KINDS.len()) } else { frame };
        let ((_, drawn), [min_m, max_m]) = KINDS[kind % KINDS.len()];
        let size_m = min_m * (max_m / min_m).powf(rng.random_range(0.0..1.0));
        let mut layers = drawn(&mut rng);
        if rng.random_bool(0.15) {
            dirty(&mut rng, &mut layers);
        }
        let half = 0.5 * rng.random_range(1.02..1.5);
        let mut thing = drawing(half, layers);
        if rng.random_bool(0.3) {
            // Painted or cast in something dark.
            thing.layers.insert(0, rectangle([-half; 2], [half; 2], Ink::Black));
        }
        let mut put = place(scaled(thing, size_m), &centre, &mut rng);
        if number == 0 {
            put.ned_from_marker.isometry.translation.vector.x = centre.x();
            put.ned_from_marker.isometry.translation.vector.y = centre.y();
        }
        spec.clutter.push(put);
    }
    if frame % 5 == 4 {
        let through = Pixel::new(at.x, at.y);
        let edge =
            Line { through: near(&mut rng, through, 150.0), normal: rng.random_range(0.0..TAU) };
        let transmission = rng.random_range(0.2..0.6);
        spec.occluder = Occluder::Shadow { edge, penumbra_px: 2.0, transmission };
    }
    spec
}

/// A drawing of 1 m at another size.
fn scaled(drawing: Drawing, size_m: f64) -> Drawing {
    let by = |m: f64| m * size_m;
    let layers = drawing.layers.into_iter().map(|layer| {
        let shape = match layer.shape {
            Shape::Disc { centre_m, radius_m } => {
                Shape::Disc { centre_m: centre_m.map(by), radius_m: by(radius_m) }
            }
            Shape::Rectangle { min_m, max_m } => {
                Shape::Rectangle { min_m: min_m.map(by), max_m: max_m.map(by) }
            }
        };
        Layer { shape, ..layer }
    });
    Drawing { half_extent_m: by(drawing.half_extent_m), layers: layers.collect() }
}

/// Concentric discs from the outermost radius inwards, black and white in turn.
fn nested(radii: &[f64], first: Ink) -> Vec<Layer> {
    let inks = match first {
        Ink::Black => [Ink::Black, Ink::White],
        Ink::White => [Ink::White, Ink::Black],
    };
    radii.iter().zip(inks.into_iter().cycle()).map(|(radius, ink)| disc(*radius, ink)).collect()
}

/// Discs of one radius around a centre.
fn around(count: u32, away: f64, radius_m: f64, ink: Ink) -> impl Iterator<Item = Layer> {
    (0..count).map(move |k| {
        let (sin, cos) = (f64::from(k) * TAU / f64::from(count)).sin_cos();
        Layer { shape: Shape::Disc { centre_m: [away * cos, away * sin], radius_m }, ink }
    })
}

/// Dirt on an object: a few spots.
fn dirty(rng: &mut ChaCha8Rng, layers: &mut Vec<Layer>) {
    for _ in 0..rng.random_range(1..4) {
        let centre_m = [0, 1].map(|_| rng.random_range(-0.4..0.4));
        let ink = if rng.random_bool(0.5) { Ink::Black } else { Ink::White };
        let radius_m = rng.random_range(0.02..0.12);
        layers.push(Layer { shape: Shape::Disc { centre_m, radius_m }, ink });
    }
}

/// A lid in its frame, with studs, bars or a hole.
fn manhole(rng: &mut ChaCha8Rng) -> Vec<Layer> {
    let lid = 0.5 * rng.random_range(0.75..0.95);
    let mut layers = nested(&[0.5, lid, lid * rng.random_range(0.9..0.98)], Ink::Black);
    match rng.random_range(0..4) {
        0 => {
            for ring in 1..5 {
                let away = lid * f64::from(ring) / 5.5;
                layers.extend(around(6 * ring, away, 0.02, Ink::White));
            }
        }
        1 => {
            for k in -3..=3 {
                let (y, half) = (f64::from(k) * 0.1, 0.3 - 0.02 * f64::from(k * k));
                layers.push(rectangle([-half, y - 0.02], [half, y + 0.02], Ink::White));
            }
        }
        2 => layers
            .extend(nested(&[rng.random_range(0.1..0.3), rng.random_range(0.02..0.1)], Ink::White)),
        _ => layers.push(disc(rng.random_range(0.05..0.15), Ink::White)),
    }
    layers
}

/// A ring: washer, tyre, pipe, gasket.
fn washer(rng: &mut ChaCha8Rng) -> Vec<Layer> {
    let first = if rng.random_bool(0.8) { Ink::Black } else { Ink::White };
    let mut layers = nested(&[0.5, 0.5 * rng.random_range(0.2..0.92)], first);
    if first == Ink::White {
        layers.insert(0, disc(0.6, Ink::Black));
    }
    layers
}

/// A tyre, a rim, spokes or holes, a hub.
fn wheel(rng: &mut ChaCha8Rng) -> Vec<Layer> {
    let rim = 0.5 * rng.random_range(0.55..0.85);
    let hub = rim * rng.random_range(0.15..0.35);
    let mut layers = nested(&[0.5, rim], Ink::Black);
    if rng.random_bool(0.5) {
        layers.extend(around(rng.random_range(4..9), 0.6 * rim, 0.16 * rim, Ink::Black));
    } else {
        layers.push(rectangle([-rim, -0.02], [rim, 0.02], Ink::Black));
        layers.push(rectangle([-0.02, -rim], [0.02, rim], Ink::Black));
    }
    layers.extend(nested(&[hub, hub * rng.random_range(0.2..0.7)], Ink::Black));
    layers
}

/// A bright disc in a dark ring, perhaps of many lights.
fn lamp(rng: &mut ChaCha8Rng) -> Vec<Layer> {
    let glass = 0.5 * rng.random_range(0.6..0.95);
    let mut layers = nested(&[0.5, glass], Ink::Black);
    if rng.random_bool(0.5) {
        layers.extend(around(rng.random_range(6..14), 0.7 * glass, 0.1 * glass, Ink::Black));
    }
    if rng.random_bool(0.5) {
        layers.push(disc(glass * rng.random_range(0.05..0.3), Ink::Black));
    }
    layers
}

/// Equally wide rings, or rings of any width.
fn bulls_eye(rng: &mut ChaCha8Rng) -> Vec<Layer> {
    let count = rng.random_range(3..8);
    let first = if rng.random_bool(0.5) { Ink::Black } else { Ink::White };
    let even = rng.random_bool(0.6);
    let mut radius = 0.5;
    let radii: Vec<f64> = (0..count)
        .map(|k| {
            let own = if even { 0.5 * (1.0 - f64::from(k) / f64::from(count)) } else { radius };
            radius *= rng.random_range(0.4..0.95);
            own
        })
        .collect();
    nested(&radii, first)
}

/// An H in a circle, or in two.
fn helipad(rng: &mut ChaCha8Rng) -> Vec<Layer> {
    let width = rng.random_range(0.02..0.08);
    let mut layers = nested(&[0.5, 0.5 - width], Ink::Black);
    if rng.random_bool(0.4) {
        let inner = 0.5 - 2.0 * width;
        layers.extend(nested(&[inner, inner - width], Ink::Black));
    }
    let (half, bar) = (rng.random_range(0.12..0.2), rng.random_range(0.025..0.05));
    for x in [-half, half] {
        layers.push(rectangle([x - bar, -0.25], [x + bar, 0.25], Ink::Black));
    }
    layers.push(rectangle([-half, -bar], [half, bar], Ink::Black));
    layers
}

/// Two or three discs in each other.
fn roundel(rng: &mut ChaCha8Rng) -> Vec<Layer> {
    let second = 0.5 * rng.random_range(0.4..0.85);
    let inner = second * rng.random_range(0.2..0.7);
    let radii = [0.5, second, inner];
    nested(&radii[..rng.random_range(2..4)], Ink::Black)
}

/// A border with a bar, a number or an arrow.
fn traffic_sign(rng: &mut ChaCha8Rng) -> Vec<Layer> {
    let mut layers = nested(&[0.5, 0.5 * rng.random_range(0.7..0.9)], Ink::Black);
    match rng.random_range(0..3) {
        0 => layers.push(rectangle([-0.3, -0.07], [0.3, 0.07], Ink::Black)),
        1 => {
            for x in [-0.15, 0.08] {
                layers.push(rectangle([x, -0.18], [x + 0.12, 0.18], Ink::Black));
                layers.push(rectangle([x + 0.04, -0.12], [x + 0.08, 0.12], Ink::White));
            }
        }
        _ => layers.push(rectangle([-0.04, -0.25], [0.04, 0.2], Ink::Black)),
    }
    layers
}

/// Ten rings of one width in five shades; here black and white.
fn archery(rng: &mut ChaCha8Rng) -> Vec<Layer> {
    let thin = rng.random_range(0.003..0.01);
    let mut layers = Vec::new();
    for k in 0..10 {
        let radius = 0.5 * (1.0 - f64::from(k) / 10.0);
        let dark = (2..4).contains(&k) || (6..8).contains(&k);
        let [line, fill] = if dark { [Ink::White, Ink::Black] } else { [Ink::Black, Ink::White] };
        layers.extend([disc(radius, line), disc(radius - thin, fill)]);
    }
    layers
}

/// 120 mm with a hole of 15 mm and a clear ring of 38 to 46 mm.
fn compact_disc(rng: &mut ChaCha8Rng) -> Vec<Layer> {
    let clear = 0.5 * rng.random_range(0.28..0.4);
    let mut layers = nested(&[0.5, clear, 0.5 * 0.27, 0.5 * 0.125], Ink::Black);
    if rng.random_bool(0.5) {
        layers.truncate(3);
    }
    layers
}

/// A grate: bars or holes in a ring.
fn drain(rng: &mut ChaCha8Rng) -> Vec<Layer> {
    let inner = 0.5 * rng.random_range(0.75..0.95);
    let mut layers = nested(&[0.5, inner], Ink::Black);
    if rng.random_bool(0.5) {
        for (count, away) in [(1, 0.0), (6, 0.4), (12, 0.75)] {
            layers.extend(around(count, away * inner, 0.1 * inner, Ink::Black));
        }
    } else {
        for k in -2..=2 {
            let (x, half) = (f64::from(k) * 0.15, inner - 0.06 * f64::from(k * k));
            layers.push(rectangle([x - 0.03, -half], [x + 0.03, half], Ink::Black));
        }
    }
    layers
}

/// From above: a rim, coffee, perhaps a saucer.
fn cup(rng: &mut ChaCha8Rng) -> Vec<Layer> {
    let rim = rng.random_range(0.25..0.4);
    let coffee = rim * rng.random_range(0.8..0.95);
    let line = rng.random_range(0.005..0.03);
    let mut layers = nested(&[0.5, 0.5 - line, rim, rim - line], Ink::Black);
    layers.push(disc(coffee - line, if rng.random_bool(0.7) { Ink::Black } else { Ink::White }));
    layers.push(rectangle([rim, -0.03], [rim + 0.08, 0.03], Ink::Black));
    layers
}

/// A black disc with a white one in it, on paper (Krajník et al., 2014: 122 and 50 mm).
fn whycon(rng: &mut ChaCha8Rng) -> Vec<Layer> {
    nested(&[0.5, 0.5 * rng.random_range(0.35..0.65)], Ink::Black)
}

/// Three or four black rings, whose radii are the code (Calvet et al., 2016).
fn cctag(rng: &mut ChaCha8Rng) -> Vec<Layer> {
    let count = if rng.random_bool(0.5) { 6 } else { 8 };
    // Inner radii are at 0.3 of the outermost or more; neighbours at least 0.08 apart.
    let mut fractions: Vec<f64> = (0..count)
        .map(|k| 0.95 - 0.65 * (f64::from(k) + rng.random_range(-0.3..0.3)) / f64::from(count))
        .collect();
    fractions.sort_by(|a, b| b.total_cmp(a));
    let radii: Vec<f64> = fractions.into_iter().map(|fraction| 0.5 * fraction).collect();
    nested(&radii, Ink::Black)
}
