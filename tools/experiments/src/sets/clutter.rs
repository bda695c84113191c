//! Frames without a marker, of shapes like one: squares, circles, nested rings, black frames, text,
//! checkerboards and random grids.

use std::f64::consts::TAU;

use geometry::{Marker as MarkerFrame, Ned, Point, Rotation, Transform};
use markers::{Drawing, Ink, Layer, Shape};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rendering::views::Binning;
use rendering::{PadInScene, Surface};

use super::scene::{Draw, centre, near};
use crate::frame_spec::{FrameSpec, Tilt, pose};
use crate::set::Set;
use rendering::occluder::{Line, Occluder};

/// Number of scenes; with the photographs and their crops there are more than a thousand negatives.
const SCENES: usize = 520;

/// Typical distance of the camera, and half the side of the cluttered square on the ground, in metres.
const DISTANCE_M: f64 = 3.0;
const HALF_M: f64 = 1.3;

pub(super) fn frames(draw: Draw) -> Vec<FrameSpec> {
    (0..SCENES).map(|frame| spec(draw, frame)).collect()
}

/// A name, and a random drawing.
type Kind = (&'static str, fn(&mut ChaCha8Rng) -> Drawing);

/// The kinds of clutter.
const KINDS: [Kind; 10] = [
    ("squares", squares),
    ("circles", circles),
    ("text", text),
    ("checkerboard", checkerboard),
    ("grid", random_grid),
    ("bars", bars),
    ("rings", many_rings),
    ("frames", black_frames),
    ("letter", letter),
    ("dots", dots),
];

fn spec(draw: Draw, frame: usize) -> FrameSpec {
    let (mut rng, seed) = draw.frame_rng(Set::Negatives, frame);
    // Large frames take long, so that most are small.
    let binning = if (frame / KINDS.len()).is_multiple_of(4) {
        Binning::TwoByTwo
    } else {
        Binning::FourByFour
    };
    let light = 10f64.powf(rng.random_range(-1.5..0.2));
    let settings = binning.settings().exposed_for(light, rng.random_range(120.0..260.0), 0.004);
    let model = settings.model;
    let tilt = Tilt { angle: rng.random_range(0.0..0.7), about: rng.random_range(0.0..TAU) };
    let distance_m = DISTANCE_M * rng.random_range(0.4..2.0);
    let at = near(&mut rng, centre(&model), 50.0);
    let pose = pose(&model, at, distance_m, tilt, 0.0);
    let (group, drawn) = KINDS[frame % KINDS.len()];
    let mut spec = FrameSpec {
        group: group.to_owned(),
        surface: Surface::ALL[frame / KINDS.len() % 4],
        painted_marks: rng.random_range(0..60),
        light,
        bayer: frame % 7 == 3,
        ..FrameSpec::negative(settings, pose, seed)
    };
    let pad = spec.place();
    for _ in 0..rng.random_range(8..40) {
        let other = rng.random_bool(0.2);
        let drawing = if other {
            KINDS[rng.random_range(0..KINDS.len())].1(&mut rng)
        } else {
            drawn(&mut rng)
        };
        spec.clutter.push(place(drawing, &pad, &mut rng));
    }
    if frame % 5 == 4 {
        let line = Line { through: near(&mut rng, at, 150.0), normal: rng.random_range(0.0..TAU) };
        spec.occluder = Occluder::Shadow {
            edge: line,
            penumbra_px: 2.0,
            transmission: rng.random_range(0.2..0.6),
        };
    }
    spec
}

/// Places a drawing near a point on the ground.
pub(super) fn place(drawing: Drawing, centre: &Point<Ned>, rng: &mut ChaCha8Rng) -> PadInScene {
    let turn = rng.random_range(0.0..TAU);
    let mut offset = || rng.random_range(-HALF_M..HALF_M);
    let place = Point::new(centre.x() + offset(), centre.y() + offset(), -1e-4);
    let up = Rotation::<Ned, MarkerFrame>::from_euler(std::f64::consts::PI, 0.0, turn);
    PadInScene {
        paper_m: 2.0 * drawing.half_extent_m,
        drawing,
        ned_from_marker: Transform::new(up, place),
        thickness_m: 0.0,
    }
}

pub(super) fn rectangle(min_m: [f64; 2], max_m: [f64; 2], ink: Ink) -> Layer {
    Layer { shape: Shape::Rectangle { min_m, max_m }, ink }
}

fn square(half_m: f64, ink: Ink) -> Layer {
    rectangle([-half_m; 2], [half_m; 2], ink)
}

pub(super) fn disc(radius_m: f64, ink: Ink) -> Layer {
    Layer { shape: Shape::Disc { centre_m: [0.0; 2], radius_m }, ink }
}

pub(super) fn drawing(half_extent_m: f64, layers: Vec<Layer>) -> Drawing {
    Drawing { half_extent_m, layers }
}

/// Concentric shapes, alternately black and white.
fn nested(rng: &mut ChaCha8Rng, shape: impl Fn(f64, Ink) -> Layer) -> Drawing {
    let outer = rng.random_range(0.02..0.12);
    let mut layers = Vec::new();
    let mut size = outer;
    for depth in 0..rng.random_range(1..6) {
        layers.push(shape(size, if depth % 2 == 0 { Ink::Black } else { Ink::White }));
        size *= rng.random_range(0.3..0.95);
    }
    drawing(outer * rng.random_range(1.05..1.5), layers)
}

fn squares(rng: &mut ChaCha8Rng) -> Drawing {
    nested(rng, square)
}

fn circles(rng: &mut ChaCha8Rng) -> Drawing {
    nested(rng, disc)
}

/// Rings with other radii than the marker.
fn many_rings(rng: &mut ChaCha8Rng) -> Drawing {
    let outer = rng.random_range(0.03..0.12);
    let mut layers = Vec::new();
    let mut radius = outer;
    for _ in 0..rng.random_range(1..5) {
        let inner = radius * rng.random_range(0.6..0.92);
        layers.extend([disc(radius, Ink::Black), disc(inner, Ink::White)]);
        radius = inner * rng.random_range(0.2..0.9);
    }
    drawing(outer * 1.2, layers)
}

/// Black frames, empty or with a few bars.
fn black_frames(rng: &mut ChaCha8Rng) -> Drawing {
    let outer = rng.random_range(0.03..0.12);
    let inner = outer * rng.random_range(0.5..0.85);
    let mut layers = vec![square(outer, Ink::Black), square(inner, Ink::White)];
    for _ in 0..rng.random_range(0..4) {
        let [x, y] = [0, 1].map(|_| rng.random_range(-0.9..0.5) * inner);
        let [w, h] = [0, 1].map(|_| rng.random_range(0.1..0.4) * inner);
        layers.push(rectangle([x, y], [x + w, y + h], Ink::Black));
    }
    drawing(outer * 1.3, layers)
}

/// Lines of text of vertical strokes.
fn text(rng: &mut ChaCha8Rng) -> Drawing {
    let (half, height) = (rng.random_range(0.06..0.15), rng.random_range(0.006..0.03));
    let mut layers = Vec::new();
    let mut y = half * 0.85;
    while y - height > -half * 0.9 && layers.len() < 150 {
        let mut x = -half * 0.9;
        while x < half * 0.85 {
            let (wide, thin) = (height * rng.random_range(0.3..0.8), height * 0.18);
            if rng.random_bool(0.85) {
                let top = rng.random_range(0.0..0.3) * height;
                layers.push(rectangle([x, y - height], [x + thin, y - top], Ink::Black));
                let bar = y - rng.random_range(0.2..0.9) * height;
                layers.push(rectangle([x, bar - thin], [x + wide * 0.8, bar], Ink::Black));
            }
            x += wide + height * 0.2;
        }
        y -= height * 1.6;
    }
    drawing(half, layers)
}

fn cells(
    rng: &mut ChaCha8Rng,
    count: u32,
    half: f64,
    ink: impl Fn(&mut ChaCha8Rng, u32, u32) -> bool,
) -> Vec<Layer> {
    let cell = 2.0 * half / f64::from(count);
    let mut layers = Vec::new();
    for (x, y) in (0..count).flat_map(|x| (0..count).map(move |y| (x, y))) {
        if ink(rng, x, y) {
            let min = [x, y].map(|i| -half + f64::from(i) * cell);
            layers.push(rectangle(min, min.map(|m| m + cell), Ink::Black));
        }
    }
    layers
}

fn checkerboard(rng: &mut ChaCha8Rng) -> Drawing {
    let half = rng.random_range(0.04..0.2);
    let count = rng.random_range(3..11);
    let layers = cells(rng, count, half, |_, x, y| (x + y) % 2 == 0);
    drawing(half * rng.random_range(1.02..1.3), layers)
}

/// A random grid as in QR codes, sometimes with their finder patterns or in a black frame. Framed grids of
/// the sizes of markers are excluded, as some would be markers.
fn random_grid(rng: &mut ChaCha8Rng) -> Drawing {
    let half = rng.random_range(0.03..0.15);
    let count = [3, 9, 11, 13, 17, 21][rng.random_range(0..6)];
    let mut layers = Vec::new();
    let framed = rng.random_bool(0.4);
    let inner = if framed { half * f64::from(count) / f64::from(count + 2) } else { half };
    if framed {
        layers.extend([square(half, Ink::Black), square(inner, Ink::White)]);
    }
    let part = rng.random_range(0.3..0.7);
    layers.extend(cells(rng, count, inner, |rng, _, _| rng.random_bool(part)));
    if count > 9 {
        let cell = 2.0 * inner / f64::from(count);
        for (x, y) in [(-1.0, 1.0), (1.0, 1.0), (-1.0, -1.0)] {
            let centre = [x, y].map(|side: f64| side * (inner - 3.5 * cell));
            for (size, ink) in
                [(4.0, Ink::White), (3.5, Ink::Black), (2.5, Ink::White), (1.5, Ink::Black)]
            {
                let to = |sign: f64| {
                    [0, 1].map(|i| (centre[i] + sign * size * cell).clamp(-inner, inner))
                };
                layers.push(rectangle(to(-1.0), to(1.0), ink));
            }
        }
    }
    drawing(half * 1.2, layers)
}

/// Stripes as in barcodes and zebra crossings.
fn bars(rng: &mut ChaCha8Rng) -> Drawing {
    let half = rng.random_range(0.04..0.2);
    let mut layers = Vec::new();
    let mut x = -half * 0.9;
    while x < half * 0.85 {
        let wide = half * rng.random_range(0.02..0.2);
        layers.push(rectangle(
            [x, -half * 0.8],
            [(x + wide).min(half * 0.9), half * 0.8],
            Ink::Black,
        ));
        x += wide + half * rng.random_range(0.02..0.2);
    }
    drawing(half, layers)
}

/// The H of a helipad in a circle or a square.
fn letter(rng: &mut ChaCha8Rng) -> Drawing {
    let half = rng.random_range(0.05..0.2);
    let shape: fn(f64, Ink) -> Layer = if rng.random_bool(0.5) { disc } else { square };
    let (edge, bar) = (half * 0.85, half * 0.12);
    let mut layers = vec![shape(half, Ink::Black), shape(edge, Ink::White)];
    for x in [-0.35, 0.35] {
        layers.push(rectangle(
            [x * half - bar, -0.5 * half],
            [x * half + bar, 0.5 * half],
            Ink::Black,
        ));
    }
    layers.push(rectangle([-0.35 * half, -bar], [0.35 * half, bar], Ink::Black));
    drawing(half * 1.1, layers)
}

/// Small black squares in rows.
fn dots(rng: &mut ChaCha8Rng) -> Drawing {
    let half = rng.random_range(0.05..0.2);
    let count = rng.random_range(3..9);
    let pitch = 2.0 * half / f64::from(count);
    let size = pitch * rng.random_range(0.15..0.4);
    let places = (0..count).flat_map(|x| (0..count).map(move |y| [x, y]));
    let layers = places
        .map(|place| {
            let centre = place.map(|i| -half + (f64::from(i) + 0.5) * pitch);
            rectangle(centre.map(|m| m - size), centre.map(|m| m + size), Ink::Black)
        })
        .collect();
    drawing(half * 1.1, layers)
}
