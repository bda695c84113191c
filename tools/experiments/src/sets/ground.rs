//! Frames of markers outdoors: grass, dirt, snow, rope or a hand on them, wet, faded, dotted or bent prints, low sun,
//! night, and things on the lens. At least half of the marker is plain to see.

use std::f64::consts::TAU;

use geometry::Pixel;
use markers::Marker;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rendering::CameraSettings;
use rendering::occluder::{Disc, Line, Occluder, Stroke};

use super::scene::{Draw, discs, near, on_marker, view};
use crate::frame_spec::FrameSpec;
use crate::print::{Bend, BendForm, Print};
use crate::set::Set;

/// Frames of each kind.
const FRAMES: usize = 40;

/// A name, and the function that changes a plain view into this kind.
type Kind = (&'static str, fn(&mut FrameSpec, &mut ChaCha8Rng));

const KINDS: [Kind; 14] = [
    ("grass", grass),
    ("dirt", dirt),
    ("snow", snow),
    ("rope", rope),
    ("hand", hand),
    ("wet", wet),
    ("faded", faded),
    ("dots", dots),
    ("bent", bent),
    ("glass", glass),
    ("cloth", cloth),
    ("low-sun", low_sun),
    ("night", night),
    ("lens", lens),
];

/// Number of frames.
#[cfg(test)]
pub(super) const COUNT: usize = FRAMES * KINDS.len();

/// The kinds take turns, so that every n-th frame has all of them unless n and their number have a common factor.
pub(super) fn frames(draw: Draw, marker: Marker) -> Vec<FrameSpec> {
    (0..FRAMES * KINDS.len())
        .map(|frame| {
            let drawn = draw.frame(Set::Ground, frame);
            let settings = CameraSettings::thesis();
            let (mut spec, mut rng) = view(drawn, marker, settings, 40.0..160.0, 0.4);
            let (name, make) = KINDS[frame % KINDS.len()];
            spec.group = name.to_owned();
            make(&mut spec, &mut rng);
            spec
        })
        .collect()
}

/// Blades of grass that stand around the marker and bend over it.
fn grass(spec: &mut FrameSpec, rng: &mut ChaCha8Rng) {
    let size_px = spec.size_px();
    let blades = (0..rng.random_range(8..20)).map(|_| {
        // From next to the marker towards its centre.
        let round: f64 = rng.random_range(0.0..TAU);
        let out = size_px * rng.random_range(0.55..0.75);
        let centre = centre(spec);
        let from = Pixel::new(centre.x + out * round.cos(), centre.y + out * round.sin());
        let part = rng.random_range(0.25..0.8);
        let to = near(rng, towards(from, centre, part), 0.15 * size_px);
        let radius_px = (size_px * rng.random_range(0.008..0.02)) as f32;
        Stroke { from, to, radius_px, level: rng.random_range(50.0..130.0) }
    });
    spec.occluder = Occluder::Strokes(blades.collect());
}

/// Clods, and dust over a part.
fn dirt(spec: &mut FrameSpec, rng: &mut ChaCha8Rng) {
    let clods = Occluder::Patches {
        patches: discs(spec, rng, 4..14, 0.6, 0.02..0.08),
        edge_px: 2.0,
        transmission: 0.0,
        levels: rng.random_range(40.0..90.0),
    };
    let dust = Occluder::Patches {
        patches: discs(spec, rng, 1..4, 0.6, 0.15..0.35),
        edge_px: (0.15 * spec.size_px()) as f32,
        transmission: rng.random_range(0.4..0.8),
        levels: rng.random_range(20.0..50.0),
    };
    spec.occluder = Occluder::Several(vec![dust, clods]);
}

/// Snow that melts, on the marker and next to it.
fn snow(spec: &mut FrameSpec, rng: &mut ChaCha8Rng) {
    let patches = discs(spec, rng, 4..12, 0.7, 0.04..0.13);
    let levels = rng.random_range(200.0..250.0);
    spec.occluder = Occluder::Patches { patches, edge_px: 3.0, transmission: 0.0, levels };
}

/// A rope or cable across, with the shadow next to it.
fn rope(spec: &mut FrameSpec, rng: &mut ChaCha8Rng) {
    const PARTS: usize = 8;
    let size_px = spec.size_px();
    let centre = on_marker(spec, rng, 0.35);
    let (sin, cos) = rng.random_range(0.0..TAU).sin_cos();
    let (bow, radius_px) = (rng.random_range(-0.4..0.4), size_px * rng.random_range(0.015..0.04));
    let level = rng.random_range(30.0..200.0);
    let at = |part: usize| {
        let along = 2.4 * (part as f64 / PARTS as f64 - 0.5);
        let aside = bow * along * along;
        let [x, y] = [along * cos - aside * sin, along * sin + aside * cos];
        Pixel::new(centre.x + x * size_px, centre.y + y * size_px)
    };
    let strokes = |shift: f64, level: f32| -> Vec<Stroke> {
        let moved = |pixel: Pixel| Pixel::new(pixel.x + shift, pixel.y + shift);
        (0..PARTS)
            .map(|part| Stroke {
                from: moved(at(part)),
                to: moved(at(part + 1)),
                radius_px: radius_px as f32,
                level,
            })
            .collect()
    };
    let shadow = strokes(1.2 * radius_px, 30.0);
    spec.occluder = Occluder::Strokes([shadow, strokes(0.0, level)].concat());
}

/// A hand that holds the print at its edge.
fn hand(spec: &mut FrameSpec, rng: &mut ChaCha8Rng) {
    let size_px = spec.size_px();
    let round: f64 = rng.random_range(0.0..TAU);
    let (sin, cos) = round.sin_cos();
    let centre = centre(spec);
    let level: f32 = rng.random_range(60.0..170.0);
    let at = |out: f64, aside: f64| {
        let [x, y] = [out * cos - aside * sin, out * sin + aside * cos];
        Pixel::new(centre.x + x * size_px, centre.y + y * size_px)
    };
    let reach: f64 = rng.random_range(0.2..0.4);
    let finger = |number: usize| {
        let aside = 0.13 * (number as f64 - 1.5);
        let out = reach + 0.06 * (number as f64 - 1.5).abs();
        Stroke {
            from: at(1.2, aside),
            to: at(out, aside),
            radius_px: (0.055 * size_px) as f32,
            level: level * (1.0 - 0.06 * number as f32),
        }
    };
    let mut strokes: Vec<Stroke> = (0..4).map(finger).collect();
    // The back of the hand.
    let (from, to) = (at(1.1, 0.0), at(1.6, 0.0));
    strokes.push(Stroke { from, to, radius_px: (0.3 * size_px) as f32, level });
    spec.occluder = Occluder::Strokes(strokes);
}

/// Highlights on wet or glossy print, some of them saturated.
fn wet(spec: &mut FrameSpec, rng: &mut ChaCha8Rng) {
    let size_px = spec.size_px();
    let lights = (0..rng.random_range(2..6)).map(|_| Occluder::Glare {
        centre: on_marker(spec, rng, 0.6),
        radius_px: (size_px * rng.random_range(0.03..0.12)) as f32,
        levels: rng.random_range(60.0..400.0),
    });
    spec.occluder = Occluder::Several(lights.collect());
}

/// Ink that the sun has bleached unevenly.
fn faded(spec: &mut FrameSpec, rng: &mut ChaCha8Rng) {
    let size_px = spec.size_px();
    let spot_px = (size_px * rng.random_range(0.08..0.4)) as f32;
    let min = rng.random_range(0.2..0.5);
    spec.occluder = Occluder::Mottle {
        area: full_disc(spec),
        spot_px: [spot_px; 2],
        share: [min, min + rng.random_range(0.05..0.3)],
        level: paper_level(spec),
    };
}

/// Print of few dots.
fn dots(spec: &mut FrameSpec, rng: &mut ChaCha8Rng) {
    spec.print = Print::Dots { per_size: rng.random_range(40.0..80.0) };
}

/// Paper that is curled or folded, its edges 2 to 5 % of its size out of the plane.
fn bent(spec: &mut FrameSpec, rng: &mut ChaCha8Rng) {
    let form = if rng.random_bool(0.5) { BendForm::Curl } else { BendForm::Fold };
    let height = rng.random_range(0.02..0.05);
    spec.print = Print::Bent(Bend { towards: rng.random_range(0.0..TAU), height, form });
}

/// A pane over the marker: it takes light, reflects the sky, and in places the sun.
fn glass(spec: &mut FrameSpec, rng: &mut ChaCha8Rng) {
    let size_px = spec.size_px();
    let edge = Line { through: on_marker(spec, rng, 0.4), normal: rng.random_range(0.0..TAU) };
    let effects = vec![
        Occluder::Haze {
            transmission: rng.random_range(0.6..0.85),
            levels: rng.random_range(15.0..60.0),
        },
        // The edge of an object that the pane reflects.
        Occluder::Shadow { edge, penumbra_px: 3.0, transmission: rng.random_range(0.6..0.9) },
        Occluder::Glare {
            centre: on_marker(spec, rng, 0.5),
            radius_px: (size_px * rng.random_range(0.05..0.2)) as f32,
            levels: rng.random_range(40.0..200.0),
        },
    ];
    spec.occluder = Occluder::Several(effects);
}

/// On cloth with slight waves: its threads, and light and shade of the waves.
fn cloth(spec: &mut FrameSpec, rng: &mut ChaCha8Rng) {
    let size_px = spec.size_px();
    let height = rng.random_range(0.003..0.01);
    let (towards, form) = (rng.random_range(0.0..TAU), BendForm::Waves);
    spec.print = Print::Bent(Bend { towards, height, form });
    let thread_px = (size_px * rng.random_range(0.01..0.02)) as f32;
    let mottle = |spot_px: [f32; 2], max: f32, level: f32| Occluder::Mottle {
        area: full_disc(spec),
        spot_px,
        share: [0.0, max],
        level,
    };
    spec.occluder = Occluder::Several(vec![
        mottle([thread_px, 6.0 * thread_px], 0.2, 0.0),
        mottle([6.0 * thread_px, thread_px], 0.2, 0.0),
        mottle([(0.4 * size_px) as f32; 2], 0.3, 0.0),
    ]);
}

/// The sun near the horizon: little light, and long shadows of grass and stones.
fn low_sun(spec: &mut FrameSpec, rng: &mut ChaCha8Rng) {
    let light = rng.random_range(0.05..0.3);
    spec.settings = spec.settings.clone().exposed_for(light, 190.0, 0.004);
    spec.light = light;
    let size_px = spec.size_px();
    let along = rng.random_range(0.0..TAU);
    let transmission = rng.random_range(0.2..0.5);
    let shadows = (0..rng.random_range(1..4)).map(|_| {
        let at = on_marker(spec, rng, 0.5);
        let wide_px = size_px * rng.random_range(0.03..0.12);
        // A shadow is a band: the ground beyond its second edge is lit again.
        let edge = |side: f64| Line {
            through: Pixel::new(
                at.x + side * wide_px * along.cos(),
                at.y + side * wide_px * along.sin(),
            ),
            normal: along,
        };
        let penumbra_px = rng.random_range(1.0..3.0);
        Occluder::Several(vec![
            Occluder::Shadow { edge: edge(0.0), penumbra_px, transmission },
            Occluder::Shadow { edge: edge(1.0), penumbra_px, transmission: 1.0 / transmission },
        ])
    });
    spec.occluder = Occluder::Several(shadows.collect());
}

/// Night, and a landing light next to the camera.
fn night(spec: &mut FrameSpec, rng: &mut ChaCha8Rng) {
    let light = rng.random_range(0.004..0.02);
    spec.settings = spec.settings.clone().exposed_for(light, rng.random_range(150.0..230.0), 0.008);
    spec.light = light;
    let size_px = spec.size_px();
    spec.occluder = Occluder::Lamp {
        centre: on_marker(spec, rng, 1.0),
        radius_px: (size_px * rng.random_range(0.8..2.0)) as f32,
        rest: rng.random_range(0.0..0.1),
    };
}

/// Dust and drops on the lens, out of focus.
fn lens(spec: &mut FrameSpec, rng: &mut ChaCha8Rng) {
    let size_px = spec.size_px();
    let dust = Occluder::Patches {
        patches: discs(spec, rng, 3..10, 1.0, 0.08..0.25),
        edge_px: (0.15 * size_px) as f32,
        transmission: rng.random_range(0.6..0.9),
        levels: rng.random_range(0.0..15.0),
    };
    let drops = Occluder::Patches {
        patches: discs(spec, rng, 1..3, 0.6, 0.1..0.22),
        edge_px: (0.08 * size_px) as f32,
        transmission: rng.random_range(0.3..0.6),
        levels: rng.random_range(40.0..90.0),
    };
    spec.occluder = Occluder::Several(vec![dust, drops]);
}

fn centre(spec: &FrameSpec) -> Pixel {
    spec.ground_truth().map_or(Pixel::new(0.0, 0.0), |shown| shown.centre)
}

/// A part of the way from one pixel to another.
fn towards(from: Pixel, to: Pixel, part: f64) -> Pixel {
    Pixel::new(from.x + part * (to.x - from.x), from.y + part * (to.y - from.y))
}

/// The disc that holds the marker with its paper.
fn full_disc(spec: &FrameSpec) -> Disc {
    Disc { centre: centre(spec), radius_px: (0.9 * spec.size_px()) as f32 }
}

/// The grey level of white paper in full light.
fn paper_level(spec: &FrameSpec) -> f32 {
    const PAPER: f64 = 0.88;
    let settings = &spec.settings;
    let electrons = settings.electrons_per_s * settings.exposure_s * spec.light * PAPER;
    (electrons / settings.full_well_e * settings.gain * 255.0) as f32
}
