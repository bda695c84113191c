//! Compares exposure for the marker with a camera's own metering and with a fixed exposure.
//!
//! `cargo run --release -p experiments --example exposure -- frames [SEED [CHANGE]]` changes the light on a pad in rendered frames, and
//! prints the level that its white reaches, after how many frames, and in how many the marker was found.
//! `... -- flights [SEED [NUMBER [WAY [LIGHT]]]]` flies landings in light for which the camera was not set, and prints how they end.
#![allow(clippy::print_stdout, reason = "a program for people at a terminal")]

use anyhow::{Context, bail};
use detector::wire;
use experiments::landing::flight::fly;
use experiments::landing::outcome::{Ending, Outcome};
use experiments::landing::plan::{Plan, Values, Vision};
use fiducial::Detector;
use geometry::{Point, Rotation};
use imaging::GrayView;
use messages::{Detections, FrameHeader, PixelFormat};
use metering::{Pad, levels};
use node::Layers;
use simulator::camera::{FrameRequest, SimCamera};
use world::pad::PadState;
use world::vehicle::{Vehicle, VehicleConfig, VehicleTruth};

/// The three ways to set an exposure.
const WAYS: [&str; 3] = ["fixed", "average", "marker"];
const RATE_HZ: f64 = 15.0;
/// When the light changes, and when it is over, in frames.
const CHANGE: u64 = 15;
const END: u64 = 60;
/// Frames from an exposure to the detections that the camera receives.
const LATENCY: usize = 1;
/// The light for which the camera is set, of full sun: six stops less is the light of a dull evening.
const LIGHT: f64 = 0.5;
const HEIGHT_M: f64 = 4.0;
/// How the vehicle sways: by so much, so often.
const SWAY_RAD: f64 = 0.04;
const SWAY_HZ: f64 = 0.7;
/// The levels of white that are good.
const GOOD: std::ops::RangeInclusive<f64> = 0.6..=0.85;

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number = |index: usize, default: u64| -> anyhow::Result<u64> {
        let text = arguments.get(index);
        text.map_or(Ok(default), |text| text.parse().with_context(|| format!("`{text}`")))
    };
    match arguments.first().map(String::as_str) {
        Some("frames") => frames(number(1, 1)?, arguments.get(2).map_or("", String::as_str)),
        Some("flights") => {
            let text = |index: usize| arguments.get(index).map_or("", String::as_str);
            flights(number(1, 1)?, number(2, 10)?, [text(3), text(4)])
        }
        _ => {
            bail!("usage: exposure frames [SEED [CHANGE]] | flights [SEED [NUMBER [WAY [LIGHT]]]]")
        }
    }
}

/// Prints the rows of the changes whose names contain `wanted`.
fn frames(seed: u64, wanted: &str) -> anyhow::Result<()> {
    println!(
        "| camera | change | way | white | frames until 60 to 85 % | found | exposure, gain | blur, max |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    for processing in ["linear", "usb"] {
        let stops = (-6..=6).map(|stops| {
            let set = vec![format!("ground.light_step_stops={stops}")];
            (format!("{stops:+} stops"), set)
        });
        let occluder = |kind: &str, strength: f64| {
            vec![format!("occluder.kind={kind}"), format!("occluder.strength={strength}")]
        };
        let sun = [occluder("glare", 1.0), vec!["ground.light_step_stops=2".to_owned()]].concat();
        let others = [
            ("low sun: +2 stops, and a reflection", sun),
            ("shadow on half of the pad, 3 stops", occluder("shadow", 0.875)),
            ("ground of bright tiles", vec!["ground.surface=tiles".to_owned()]),
        ];
        let others = others.map(|(name, set)| (name.to_owned(), set));
        let changes = stops.chain(others).filter(|(name, _)| name.contains(wanted));
        for (name, set) in changes {
            for way in WAYS {
                let mut set = set.clone();
                set.push(format!("camera.processing={processing}"));
                set.push(format!("camera.exposure={way}"));
                let row = Run::new(seed, set)?.row()?;
                println!("| {processing} | {name} | {way} | {row} |");
            }
        }
    }
    Ok(())
}

/// A vehicle that sways over the pad while the light changes.
struct Run {
    camera: SimCamera,
    detector: Detector,
    pad: PadState,
    still: VehicleTruth,
    marker_m: f64,
}

/// The vehicle over the pad, at a time.
fn swaying(still: &VehicleTruth, pad: &PadState, time_s: f64) -> VehicleTruth {
    let sway = SWAY_RAD * (std::f64::consts::TAU * SWAY_HZ * time_s).sin();
    let ned_from_body = Rotation::from_euler(sway, 0.0, 0.3);
    let position = Point::new(pad.position.x(), pad.position.y(), -HEIGHT_M);
    VehicleTruth { position, ned_from_body, ..*still }
}

/// A frame of a run.
struct Taken {
    white: Option<f64>,
    is_found: bool,
    blur_px: f64,
    exposure_s: f64,
    gain: f64,
}

impl Run {
    fn new(seed: u64, mut set: Vec<String>) -> anyhow::Result<Self> {
        let at_s = CHANGE as f64 / RATE_HZ;
        set.extend([
            format!("seed={seed}"),
            format!("ground.light={LIGHT}"),
            format!("ground.light_step_at_s={at_s}"),
            format!("occluder.at_s={at_s}"),
            "occluder.for_s=3600".to_owned(),
        ]);
        let config = Layers { file: None, set }.load::<simulator::Config>()?.settings;
        let marker = config.pad_marker().map_err(anyhow::Error::msg)?;
        Ok(Self {
            camera: SimCamera::new(&config)?,
            detector: Detector::new(&[marker], fiducial::Settings::default())?,
            pad: config.pad.config().at(None),
            still: Vehicle::new(VehicleConfig::default(), 1).truth(),
            marker_m: marker.size_m.unwrap_or_default(),
        })
    }

    fn truth_at(&self, time_s: f64) -> VehicleTruth {
        swaying(&self.still, &self.pad, time_s)
    }

    /// The true pad in the image.
    fn pad_at(&self, time_s: f64) -> Option<Pad> {
        let seen = self.camera.camera_from_marker(&self.truth_at(time_s), &self.pad);
        let model = self.camera.settings().model;
        let centre = model.project(seen.origin())?;
        let size_px = self.marker_m * model.fx / seen.origin().z();
        Some(Pad { centre_px: [centre.x, centre.y], size_px, motion_px_s: 0.0, drift_px: 0.0 })
    }

    fn take(&mut self, sequence: u64, pixels: &mut [u8]) -> anyhow::Result<(Taken, Detections)> {
        let time_s = sequence as f64 / RATE_HZ;
        let stamp_ns = (time_s * 1e9) as i64;
        let pad = self.pad;
        let request = FrameRequest { sequence, time_s, stamp_ns, begun_s: Some(time_s), pad };
        let truth = self.truth_at(time_s);
        self.camera.open(&request, &truth);
        let still = self.still;
        self.camera.render(&request, |time_s| swaying(&still, &pad, time_s), pixels)?;
        let settings = self.camera.settings().clone();
        let model = settings.model;
        let view = GrayView::packed(pixels, model.width as usize, model.height as usize)?;
        let ends = [-0.5, 0.5].map(|part| self.pad_at(time_s + part * settings.exposure_s));
        let blur_px = match ends {
            [Some(a), Some(b)] => {
                (a.centre_px[0] - b.centre_px[0]).hypot(a.centre_px[1] - b.centre_px[1])
            }
            _ => f64::NAN,
        };
        let white = self.pad_at(time_s).and_then(|pad| levels(view, &pad)).map(|l| l.white);
        let found = self.detector.detect(view, Some(&model), &mut ());
        let taken = Taken {
            white,
            is_found: !found.is_empty(),
            blur_px,
            exposure_s: settings.exposure_s,
            gain: settings.gain,
        };
        let header = FrameHeader {
            camera: "down".to_owned(),
            sequence,
            stamp_ns,
            clock: String::new(),
            exposure_ns: 0,
            width: model.width,
            height: model.height,
            format: PixelFormat::Mono8,
            parts: Vec::new(),
        };
        let detections = found.iter().map(wire::detection).collect();
        let detector = "main".to_owned();
        Ok((taken, Detections { detector, header, detections, stages: Vec::new() }))
    }

    fn row(mut self) -> anyhow::Result<String> {
        let model = self.camera.settings().model;
        let mut pixels = vec![0; model.width as usize * model.height as usize];
        let mut late = std::collections::VecDeque::new();
        let mut after = Vec::new();
        for sequence in 0..END {
            let (taken, message) = self.take(sequence, &mut pixels)?;
            late.push_back(message);
            if late.len() > LATENCY
                && let Some(message) = late.pop_front()
            {
                self.camera.detected(&message);
            }
            if sequence >= CHANGE {
                after.push(taken);
            }
        }
        let is_good = |taken: &Taken| taken.white.is_some_and(|white| GOOD.contains(&white));
        // From which frame on it is good to the end.
        let bad = after.iter().rposition(|taken| !is_good(taken)).map_or(0, |last| last + 1);
        let until = if bad == after.len() { "never".to_owned() } else { bad.to_string() };
        let found = after.iter().filter(|taken| taken.is_found).count();
        let settled = after.get(after.len() / 2..).unwrap_or_default();
        let blur_px = settled.iter().map(|taken| taken.blur_px).fold(0.0, f64::max);
        let last = after.last().context("no frame")?;
        Ok(format!(
            "{:.0} % | {until} | {found} of {} | {:.2} ms, {:.1} | {blur_px:.2} px",
            100.0 * last.white.unwrap_or(f64::NAN),
            after.len(),
            1e3 * last.exposure_s,
            last.gain
        ))
    }
}

/// Prints the rows of the ways and lights whose names contain the requested texts.
fn flights(seed: u64, number: u64, wanted: [&str; 2]) -> anyhow::Result<()> {
    let ways = || WAYS.into_iter().filter(|way| way.contains(wanted[0]));
    let is_wanted = |light: &str| light.contains(wanted[1]);
    println!(
        "| light, of that for which the camera was set | way | landed | within 0.1 m | error, median / worst | frames with the marker |"
    );
    println!("|---|---|---|---|---|---|");
    for stops in [-6, -4, -2, 0, 2, 4, 6] {
        for way in ways().filter(|_| is_wanted(&format!("{stops:+} stops"))) {
            let light = LIGHT * f64::powi(2.0, stops);
            let set = vec![
                format!("simulator.camera.set_for_light={LIGHT}"),
                format!("simulator.ground.light={light}"),
                format!("simulator.camera.exposure={way}"),
            ];
            println!("| {stops:+} stops | {way} | {} |", landings(seed, number, set)?);
        }
    }
    let low_sun = |strength| {
        [
            "simulator.ground.light=2",
            "simulator.camera.set_for_light=0.5",
            "simulator.occluder.kind=glare",
            strength,
            "simulator.occluder.for_s=3600",
        ]
    };
    let (weak, strong) =
        (low_sun("simulator.occluder.strength=0.3"), low_sun("simulator.occluder.strength=1"));
    let shadow = [
        "simulator.ground.light=0.5",
        "simulator.occluder.kind=shadow",
        "simulator.occluder.strength=0.875",
        "simulator.occluder.for_s=3600",
    ];
    let shade = [&shadow[..], &["simulator.occluder.beside_m=0.5"]].concat();
    for (name, set) in [
        ("low sun: +2 stops, and a reflection of 0.3 of white", weak.as_slice()),
        ("low sun: +2 stops, and a reflection as bright as white", &strong),
        ("in shade of 3 stops, its edge 0.5 m next to the pad", &shade),
        ("a shadow's edge across the pad, 3 stops", &shadow),
    ] {
        for way in ways().filter(|_| is_wanted(name)) {
            let mut set: Vec<String> = set.iter().map(|setting| (*setting).to_owned()).collect();
            // The camera that is flown by default: one without a tone curve resolves no pad of which half is three stops darker.
            set.push("simulator.camera.processing=usb".to_owned());
            set.push("simulator.occluder.at_s=0".to_owned());
            set.push(format!("simulator.camera.exposure={way}"));
            println!("| {name} | {way} | {} |", landings(seed, number, set)?);
        }
    }
    Ok(())
}

/// The end of landings with these settings.
fn landings(seed: u64, number: u64, set: Vec<String>) -> anyhow::Result<String> {
    let plan = Plan {
        vision: Vision::Rendered,
        flights: number,
        seed,
        wind: Values::List(vec![2.0]),
        set,
        ..Plan::default()
    };
    let outcomes = plan.flights().into_iter().map(|planned| fly(&planned, None));
    let outcomes: Vec<Outcome> = outcomes.collect::<anyhow::Result<_>>()?;
    let landed = outcomes.iter().filter(|outcome| outcome.ending == Ending::Landed);
    let mut errors_m: Vec<f64> = landed.filter_map(|outcome| outcome.error_m).collect();
    errors_m.sort_by(f64::total_cmp);
    let near = errors_m.iter().filter(|error_m| **error_m <= 0.1).count();
    let errors = match (errors_m.get(errors_m.len() / 2), errors_m.last()) {
        (Some(median), Some(worst)) => format!("{median:.3} / {worst:.3} m"),
        _ => "-".to_owned(),
    };
    let sum = |of: fn(&Outcome) -> u64| outcomes.iter().map(of).sum::<u64>() as f64;
    let seen = 100.0 * sum(|outcome| outcome.detections) / sum(|outcome| outcome.frames);
    Ok(format!("{} of {number} | {near} | {errors} | {seen:.0} %", errors_m.len()))
}
