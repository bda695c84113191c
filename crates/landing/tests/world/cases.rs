//! The circumstances that a landing must stand, by name.

use geometry::{Point, Vector};
use landing::{GuidanceConfig, MetricConfig};

use super::air::{Gust, Wind};
use super::autopilot::Estimator;
use super::eyes::Faults;
use super::{PadMotion, Scene};

/// A name, and the flight of each seed.
pub(crate) type Case = (&'static str, fn(u64) -> Scene);

/// Wind of 4 m/s with turbulence 1 from any direction, as a background of the faults.
fn breeze(seed: u64) -> Scene {
    Scene::windy(seed, 4.0, 1.0)
}

fn fault(seed: u64, change: impl FnOnce(&mut Faults)) -> Scene {
    let mut scene = breeze(seed);
    change(&mut scene.faults);
    scene
}

/// A number from 0 to 1 that belongs to the seed.
pub(crate) fn part(seed: u64, which: u64) -> f64 {
    let mixed = (seed + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(17 * which as u32 + 5);
    (mixed.wrapping_mul(0xd6e8_feb8_6659_fd93) >> 11) as f64 / (1u64 << 53) as f64
}

/// The rows of the comparison with ArduPilot's own precision landing.
pub(crate) const WINDS: [Case; 6] = [
    ("calm", Scene::new),
    ("wind 5 m/s, turbulence 1", |seed| Scene::windy(seed, 5.0, 1.0)),
    ("wind 5 m/s, turbulence 3", |seed| Scene::windy(seed, 5.0, 3.0)),
    ("wind 8 m/s, turbulence 1", |seed| Scene::windy(seed, 8.0, 1.0)),
    ("calm, a gust of 5 m/s in 3 s", |seed| {
        let gust = Gust { start_s: 2.0 + 8.0 * part(seed, 1), length_s: 3.0, peak_m_s: 5.0 };
        let wind = Wind { gust: Some(gust), ..Wind::new(1.0, 1.0, seed as f64 * 2.399) };
        Scene { wind, ..Scene::new(seed) }
    }),
    ("wind 12 m/s (too much)", |seed| Scene::windy(seed, 12.0, 1.0)),
];

/// The faults.
pub(crate) const FAULTS: [Case; 15] = [
    ("no fault, wind 4 m/s, turbulence 1", breeze),
    ("marker lost below 2 m", |seed| fault(seed, |f| f.outage_below_m = Some((2.0, 1e9)))),
    ("detections stop for 2 s at any height", |seed| {
        let from_s = 1.0 + 9.0 * part(seed, 1);
        fault(seed, |f| f.outage_s = Some((from_s, from_s + 2.0)))
    }),
    ("latency 300 ms", |seed| Scene { latency_s: 0.3, latency_jitter_s: 0.05, ..breeze(seed) }),
    ("frames dropped 50 %", |seed| fault(seed, |f| f.drop = 0.5)),
    ("frames late and out of order, a third twice", |seed| Scene {
        latency_s: 0.05,
        latency_jitter_s: 0.25,
        ..fault(seed, |f| f.duplicate = 0.33)
    }),
    ("a wrong marker 1 m away in 30 %", |seed| fault(seed, |f| f.wrong = Some((0.3, 1.0)))),
    ("detections lie by 0.5 m for 1 s", |seed| {
        let from_s = 1.0 + 9.0 * part(seed, 1);
        fault(seed, |f| f.lie = Some((from_s, from_s + 1.0, 0.5)))
    }),
    ("stamps jump by up to 0.25 s in 10 %", |seed| {
        fault(seed, |f| f.stamp_jumps = Some((0.1, 0.25)))
    }),
    ("stamps 50 ms early", |seed| Scene { stamp_error_s: 0.05, ..breeze(seed) }),
    ("GNSS drift 0.05 m/s", |seed| {
        let (east, north) = (seed as f64).sin_cos();
        let gnss_drift = [0.05 * north, 0.05 * east];
        Scene { estimator: Estimator { gnss_drift, ..Estimator::USUAL }, ..breeze(seed) }
    }),
    ("GNSS jump of 1 m", |seed| {
        let gnss_jump = Some((1.0 + 9.0 * part(seed, 1), 1.0));
        Scene { estimator: Estimator { gnss_jump, ..Estimator::USUAL }, ..breeze(seed) }
    }),
    ("autopilot link lost for 1 s", |seed| {
        let from_s = 1.0 + 9.0 * part(seed, 1);
        Scene { link_lost_s: Some((from_s, from_s + 1.0)), ..breeze(seed) }
    }),
    ("marker 3 % larger than told", |seed| fault(seed, |f| f.size_error = -0.03)),
    ("covariance not told", |seed| Scene { tells_covariance: false, ..breeze(seed) }),
];

fn moving(seed: u64, speed_m_s: f64, heave_m: f64) -> Scene {
    let (east, north) = (seed as f64 * 1.3).sin_cos();
    let mut scene = Scene::windy(seed, 2.0, 1.0);
    scene.pad = Point::new(1.0, -0.5, 0.0);
    scene.start = Point::new(0.0, 0.0, -8.0);
    scene.pad_motion = PadMotion {
        velocity: Vector::new(north, east, 0.0) * speed_m_s,
        heave: (heave_m, 6.0),
        yaw: (0.0, 0.1),
    };
    scene.marker_scale = 1.5;
    scene.frames_hz = 30.0;
    scene.config.estimator.pad_speed_m_s = if speed_m_s > 0.0 { 4.5 } else { 0.0 };
    scene.config.estimator.pad_heave_m_s = if heave_m > 0.0 { 0.4 } else { 0.0 };
    scene.config.estimator.pad_acceleration = if speed_m_s > 0.0 { 0.08 } else { 0.0 };
    scene.config.envelope.horizontal_m_s = 7.0;
    let metric = MetricConfig {
        max_lateral_m_s: 2.5,
        lateral_acceleration_m_s2: 2.0,
        setpoint_loss_s: 1.2,
        blind_deviation_m: 0.2,
        ..MetricConfig::default()
    };
    scene.config.guidance = GuidanceConfig::Metric(metric);
    scene
}

/// A pad that moves, half as large again and seen 30 times a second, and a lander that is told to expect it.
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
    let angle = seed as f64 * 2.4;
    let mut scene = Scene::windy(seed, 8.0 * wind, 1.0);
    let offset_m = 4.0 * offset;
    let (east, north) = angle.sin_cos();
    scene.start = Point::new(
        scene.pad.x() + offset_m * north,
        scene.pad.y() + offset_m * east,
        -(5.0 + 10.0 * height),
    );
    scene.latency_s = 0.02 + 0.28 * latency;
    scene.heading_rad = std::f64::consts::TAU * heading;
    scene.limit_s = 320.0;
    scene
}
