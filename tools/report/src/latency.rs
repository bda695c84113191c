//! Computes the latency budget: from a frame's exposure to its detections and to the setpoint that uses it.

use node::stats::quantile;
use serde::Serialize;

use crate::frames::{Fate, Frames, Handled};

/// How long a stage took.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Stage {
    /// Its name.
    pub name: String,
    /// Whether it is a part of the stage above it.
    pub is_part: bool,
    /// Number of frames.
    pub frames: usize,
    /// Median, in milliseconds.
    pub p50_ms: f64,
    /// 90th percentile, in milliseconds.
    pub p90_ms: f64,
    /// 99th percentile, in milliseconds.
    pub p99_ms: f64,
    /// The longest, in milliseconds.
    pub max_ms: f64,
}

/// Name of the stage from exposure to the controller.
pub const TO_CONTROLLER: &str = "exposure to detections at the controller";
/// Name of the stage from exposure to the setpoint.
pub const TO_SETPOINT: &str = "exposure to setpoint";
/// Name of the time outside the detector.
pub const ON_THE_WAY: &str = "exposure, image transport, waiting, message";

/// Time between two stamps in milliseconds.
pub fn between_ms(from_ns: i64, to_ns: i64) -> f64 {
    to_ns.saturating_sub(from_ns) as f64 * 1e-6
}

/// The budget of the frames of the landing whose detector was in use.
pub fn budget(frames: &Frames) -> Vec<Stage> {
    let in_use: Vec<&Handled> = frames
        .all
        .iter()
        .filter(|it| it.is_of_landing())
        // A stamp of another clock has no age.
        .filter(|it| (0.0..60_000.0).contains(&between_ms(it.exposed_ns, it.handled_ns)))
        .collect();
    let mut stages = Vec::new();
    let total: Vec<f64> =
        in_use.iter().map(|it| between_ms(it.exposed_ns, it.handled_ns)).collect();
    stages.extend(stage(TO_CONTROLLER, false, &total));
    let detector_ms =
        |it: &Handled| it.stages.iter().map(|stage| f64::from(stage.micros)).sum::<f64>() * 1e-3;
    let rest: Vec<f64> =
        in_use.iter().zip(&total).map(|(it, total)| total - detector_ms(it)).collect();
    stages.extend(stage(ON_THE_WAY, true, &rest));
    let mut names: Vec<&str> = Vec::new();
    for name in in_use.iter().flat_map(|it| &it.stages).map(|stage| stage.stage.as_str()) {
        if !names.contains(&name) {
            names.push(name);
        }
    }
    for name in names {
        let times: Vec<f64> = in_use
            .iter()
            .flat_map(|it| &it.stages)
            .filter(|stage| stage.stage == name)
            .map(|stage| f64::from(stage.micros) * 1e-3)
            .collect();
        stages.extend(stage(&format!("detector: {name}"), true, &times));
    }
    let used: Vec<&Handled> = in_use.into_iter().filter(|it| it.fate == Fate::Used).collect();
    let to_setpoint: Vec<f64> =
        used.iter().filter_map(|it| Some(between_ms(it.exposed_ns, it.setpoint_ns?))).collect();
    stages.extend(stage(TO_SETPOINT, false, &to_setpoint));
    let waited: Vec<f64> =
        used.iter().filter_map(|it| Some(between_ms(it.handled_ns, it.setpoint_ns?))).collect();
    stages.extend(stage("detections at the controller to setpoint", true, &waited));
    stages
}

fn stage(name: &str, is_part: bool, times_ms: &[f64]) -> Option<Stage> {
    Some(Stage {
        name: name.to_owned(),
        is_part,
        frames: times_ms.len(),
        p50_ms: quantile(times_ms, 0.5)?,
        p90_ms: quantile(times_ms, 0.9)?,
        p99_ms: quantile(times_ms, 0.99)?,
        max_ms: quantile(times_ms, 1.0)?,
    })
}
