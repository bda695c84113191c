//! The circumstances that a landing must survive, by name.

use geometry::{Point, Vector};
use landing::{GuidanceConfig, MetricConfig};
use world::wind::Gust;

use super::Scene;

/// A name, and the flight of each seed.
pub(crate) type Case = (&'static str, fn(u64) -> Scene);

/// Wind of 4 m/s with turbulence 1 from any direction, as a background of the faults.
fn fault(seed: u64, change: impl FnOnce(&mut Scene)) -> Scene {
    Scene::windy(seed, 4.0, 1.0).with(change)
}

/// A number from 0 to 1 that belongs to the seed.
pub(crate) fn part(seed: u64, which: u64) -> f64 {
    let mixed = (seed + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(17 * which as u32 + 5);
    (mixed.wrapping_mul(0xd6e8_feb8_6659_fd93) >> 11) as f64 / (1u64 << 53) as f64
}

/// A time from 1 to 10 s that belongs to the seed.
fn moment_s(seed: u64) -> f64 {
    1.0 + 9.0 * part(seed, 1)
}

/// The rows of the comparison with ArduPilot's own precision landing.
pub(crate) const WINDS: [Case; 6] = [
    ("calm", Scene::new),
    ("wind 5 m/s, turbulence 1", |seed| Scene::windy(seed, 5.0, 1.0)),
    ("wind 5 m/s, turbulence 3", |seed| Scene::windy(seed, 5.0, 3.0)),
    ("wind 8 m/s, turbulence 1", |seed| Scene::windy(seed, 8.0, 1.0)),
    ("calm, a gust of 5 m/s in 3 s", |seed| {
        let start_s = 2.0 + 8.0 * part(seed, 1);
        let gust = Gust { start_s, length_s: 3.0, peak_m_s: 5.0, period_s: 0.0 };
        Scene::windy(seed, 1.0, 1.0).with(|scene| scene.world.wind.gust = Some(gust))
    }),
    ("wind 12 m/s (too much)", |seed| Scene::windy(seed, 12.0, 1.0)),
];

/// The faults.
pub(crate) const FAULTS: [Case; 15] = [
    ("no fault, wind 4 m/s, turbulence 1", |seed| fault(seed, |_| {})),
    ("marker lost below 2 m", |seed| fault(seed, |s| s.camera.outage_below_m = Some((2.0, 1e9)))),
    ("detections stop for 2 s at any height", |seed| {
        fault(seed, |s| s.camera.outage_s = Some((moment_s(seed), 2.0)))
    }),
    ("latency 300 ms", |seed| {
        fault(seed, |s| (s.camera.latency_s, s.camera.jitter_s) = (0.3, 0.05))
    }),
    ("frames dropped 50 %", |seed| fault(seed, |s| s.camera.drop = 0.5)),
    ("frames late and out of order, a third twice", |seed| {
        fault(seed, |s| {
            (s.camera.latency_s, s.camera.jitter_s, s.camera.duplicate) = (0.05, 0.25, 0.33);
        })
    }),
    ("a wrong marker 1 m away in 30 %", |seed| fault(seed, |s| s.vision.wrong = Some((0.3, 1.0)))),
    ("detections off by 0.5 m for 1 s", |seed| {
        let from_s = moment_s(seed);
        fault(seed, |s| s.vision.offset = Some((from_s, from_s + 1.0, 0.5)))
    }),
    ("stamps jump by up to 0.25 s in 10 %", |seed| {
        fault(seed, |s| (s.camera.stamp_jumps, s.camera.stamp_jump_s) = (0.1, 0.25))
    }),
    ("stamps 50 ms early", |seed| fault(seed, |s| s.camera.stamp_early_s = 0.05)),
    ("GNSS drift 0.05 m/s", |seed| {
        let (east, north) = (seed as f64).sin_cos();
        let drift = [0.05 * north, 0.05 * east];
        fault(seed, |s| s.world.autopilot.estimate.gnss_drift_m_s = drift)
    }),
    ("GNSS jump of 1 m", |seed| {
        let jump = ([1.0, 0.0], moment_s(seed));
        fault(seed, |s| s.world.autopilot.estimate.gnss_jump = Some(jump))
    }),
    ("autopilot link lost for 1 s", |seed| {
        fault(seed, |s| s.world.link_lost_s = Some((moment_s(seed), 1.0)))
    }),
    ("marker 3 % larger than configured", |seed| fault(seed, |s| s.vision.size_error = -0.03)),
    ("no covariance", |seed| fault(seed, |s| s.has_covariance = false)),
];

fn moving(seed: u64, speed_m_s: f64, heave_m: f64) -> Scene {
    let (east, north) = (seed as f64 * 1.3).sin_cos();
    let mut scene = Scene::windy(seed, 2.0, 1.0).from(Point::new(0.0, 0.0, -8.0));
    let pad = &mut scene.world.pad;
    pad.position = Point::new(1.0, -0.5, 0.0);
    pad.velocity = Vector::new(north, east, 0.0) * speed_m_s;
    pad.heave_m = heave_m;
    pad.turn_rad_s = 0.1;
    scene.marker_scale = 1.5;
    scene.frames_hz = 30.0;
    let estimator = &mut scene.config.estimator;
    estimator.pad_speed_m_s = if speed_m_s > 0.0 { 4.5 } else { 0.0 };
    estimator.pad_heave_m_s = if heave_m > 0.0 { 0.4 } else { 0.0 };
    estimator.pad_acceleration = if speed_m_s > 0.0 { 0.08 } else { 0.0 };
    scene.config.envelope.horizontal_m_s = 7.0;
    scene.config.guidance = GuidanceConfig::Metric(MetricConfig {
        max_lateral_m_s: 2.5,
        lateral_acceleration_m_s2: 2.0,
        gust_time_s: 1.2,
        blind_deviation_m: 0.2,
        ..MetricConfig::default()
    });
    scene
}

/// A pad that moves, half as large again and seen 30 times a second, and a lander that is configured for it.
pub(crate) const MOVING: [Case; 5] = [
    ("pad moves at 1 m/s", |seed| moving(seed, 1.0, 0.0)),
    ("pad moves at 2.5 m/s", |seed| moving(seed, 2.5, 0.0)),
    ("pad moves at 4.2 m/s", |seed| moving(seed, 4.2, 0.0)),
    ("pad heaves by 0.3 m in 6 s", |seed| moving(seed, 0.0, 0.3)),
    ("pad moves at 2.5 m/s and heaves by 0.3 m", |seed| moving(seed, 2.5, 0.3)),
];

/// Wind 0 to 8 m/s, offsets up to 4 m, heights 5 to 15 m, latency 20 to 300 ms, any heading.
pub(crate) fn anything(seed: u64) -> Scene {
    let [wind, offset, height, latency, heading] = [1, 2, 3, 4, 5].map(|which| part(seed, which));
    let offset_m = 4.0 * offset;
    let (east, north) = (seed as f64 * 2.4).sin_cos();
    let start = Point::new(1.5 + offset_m * north, -1.5 + offset_m * east, -(5.0 + 10.0 * height));
    Scene::windy(seed, 8.0 * wind, 1.0).from(start).with(|scene| {
        scene.camera.latency_s = 0.02 + 0.28 * latency;
        scene.world.vehicle.start_heading_rad = std::f64::consts::TAU * heading;
        scene.limit_s = 320.0;
    })
}
