//! The result row of a flight of the landing experiment: how it ended, times, touchdown error and speeds, and whether that
//! was unsafe.

use messages::Touchdown;
use serde::{Deserialize, Serialize};

use super::plan::Planned;

/// Specified limit of the vertical speed at touchdown, in m/s.
pub const HARD_M_S: f64 = 0.6;
/// Specified limit of the horizontal speed at touchdown, in m/s.
pub const SLIDING_M_S: f64 = 0.1;
/// Specified limit of the tilt at touchdown, in degrees.
pub const TILTED_DEG: f64 = 10.0;
/// Maximum downward speed of a safe touchdown, in m/s: a faster vehicle may bounce.
pub const MAX_SINK_M_S: f64 = 0.8;
/// Maximum horizontal speed of a safe touchdown, in m/s: a faster vehicle may tip over.
pub const MAX_SLIDE_M_S: f64 = 0.3;
/// Height after a touch, in metres, beyond which a vehicle has left the ground again.
pub const MAX_HOP_M: f64 = 0.15;

/// Whether a touch of the ground with these greatest speeds in m/s, if there was one, was faster than is safe.
pub(crate) fn is_too_fast(sink_m_s: Option<f64>, slide_m_s: Option<f64>) -> bool {
    beyond(sink_m_s, MAX_SINK_M_S) || beyond(slide_m_s, MAX_SLIDE_M_S)
}

/// Whether a flight landed within so many metres of the pad's centre.
pub(crate) fn is_within(ending: Ending, error_m: Option<f64>, metres: f64) -> bool {
    ending == Ending::Landed && error_m.is_some_and(|error_m| error_m <= metres)
}

/// Whether a flight touched the ground faster than is safe, by its greatest speeds in m/s, or, without an abort, far from the pad.
/// The position of an aborted flight is the pilot's decision.
pub(crate) fn is_unsafe(
    ending: Ending,
    error_m: Option<f64>,
    sink_m_s: Option<f64>,
    slide_m_s: Option<f64>,
) -> bool {
    let is_far = ending != Ending::Aborted && beyond(error_m, Touchdown::MAX_ERROR_M);
    is_far || is_too_fast(sink_m_s, slide_m_s)
}

fn beyond(value: Option<f64>, limit: f64) -> bool {
    value.is_some_and(|value| value > limit)
}

/// The greater of the values that exist.
pub(crate) fn greater(before: Option<f64>, value: Option<f64>) -> Option<f64> {
    before.into_iter().chain(value).reduce(f64::max)
}

/// How it ended.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Ending {
    /// On the ground, disarmed.
    Landed,
    /// Aborted, in the air or on the ground.
    Aborted,
    /// Neither before the timeout, or a pilot took over.
    Unfinished,
}

/// The row of one flight. Times are in seconds from the start of the landing. In files a value is named as `alight land --format json`
/// and the report name it, and columns are in this order.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Outcome {
    /// The name of its cell.
    pub cell: String,
    /// Its seed.
    pub seed: u64,
    /// The vision.
    pub vision: &'static str,
    /// The fault.
    pub fault: &'static str,
    /// Mean wind, in m/s.
    pub wind_m_s: f64,
    /// Strength of the turbulence.
    pub turbulence: f64,
    /// From exposure to arrival, in milliseconds.
    pub latency_ms: f64,
    /// Height at the start, in metres.
    pub height_m: f64,
    /// Horizontal distance from the pad at the start, in metres.
    pub offset_m: f64,
    /// The guidance, the marker where one was requested, and the further settings.
    pub settings: String,
    /// The version of the program that flew it.
    pub program: String,
    /// How it ended.
    pub ending: Ending,
    /// The controller's last phase.
    pub phase: messages::Phase,
    /// Its last reason.
    pub why: String,
    /// Horizontal distance from the pad at the touch, in metres; of several, at the last.
    #[serde(rename = "touchdown_error_m")]
    pub error_m: Option<f64>,
    /// Its north component.
    #[serde(rename = "touchdown_error_north_m")]
    pub error_north_m: Option<f64>,
    /// Its east component.
    #[serde(rename = "touchdown_error_east_m")]
    pub error_east_m: Option<f64>,
    /// Downward speed at touchdown, relative to the pad, in m/s; of several, the greatest.
    #[serde(rename = "touchdown_speed_m_s")]
    pub sink_m_s: Option<f64>,
    /// Horizontal speed at touchdown, relative to the pad, in m/s; of several, the greatest.
    #[serde(rename = "touchdown_lateral_speed_m_s")]
    pub slide_m_s: Option<f64>,
    /// Greatest height over the pad after a touch, in metres.
    pub hop_m: Option<f64>,
    /// Tilt at touchdown, in degrees; of several, at the last.
    #[serde(rename = "touchdown_tilt_deg")]
    pub touch_tilt_deg: Option<f64>,
    /// Maximum tilt during the landing, in degrees.
    pub max_tilt_deg: f64,
    /// Time until LAND.
    #[serde(rename = "time_to_land_s")]
    pub land_s: Option<f64>,
    /// Time until touchdown; of several, the last.
    #[serde(rename = "time_to_touchdown_s")]
    pub touchdown_s: Option<f64>,
    /// Time until disarmed.
    #[serde(rename = "time_to_disarm_s")]
    pub disarm_s: Option<f64>,
    /// Number of frames.
    pub frames: u64,
    /// Number of detections used.
    pub detections: u64,
    /// Number of retries.
    pub retries: u32,
}

impl Outcome {
    /// The outcome before the flight.
    pub fn new(planned: &Planned) -> Self {
        Self {
            cell: planned.cell.clone(),
            seed: planned.seed,
            vision: planned.vision.name(),
            fault: planned.fault.name(),
            wind_m_s: planned.wind_m_s,
            turbulence: planned.turbulence,
            latency_ms: planned.latency_ms,
            height_m: planned.height_m,
            offset_m: planned.offset_m,
            settings: planned.settings.clone(),
            program: node::version().to_owned(),
            ending: Ending::Unfinished,
            phase: messages::Phase::default(),
            why: String::new(),
            error_m: None,
            error_north_m: None,
            error_east_m: None,
            sink_m_s: None,
            slide_m_s: None,
            hop_m: None,
            touch_tilt_deg: None,
            max_tilt_deg: 0.0,
            land_s: None,
            touchdown_s: None,
            disarm_s: None,
            frames: 0,
            detections: 0,
            retries: 0,
        }
    }

    /// Whether it landed within this distance of the pad's centre.
    pub fn is_within(&self, metres: f64) -> bool {
        is_within(self.ending, self.error_m, metres)
    }

    /// Whether it touched the ground dangerously fast, or, without an abort, far from the pad.
    pub fn is_unsafe(&self) -> bool {
        is_unsafe(self.ending, self.error_m, self.sink_m_s, self.slide_m_s)
    }

    /// Whether it touched the ground faster than is safe.
    pub fn is_too_fast(&self) -> bool {
        is_too_fast(self.sink_m_s, self.slide_m_s)
    }

    /// Whether it left the ground again after a touch.
    pub fn has_left_ground(&self) -> bool {
        self.hop_m.is_some_and(|hop_m| hop_m > MAX_HOP_M)
    }

    /// Whether it is unsafe, inaccurate, unfinished or aborted.
    pub fn is_failure(&self) -> bool {
        self.is_unsafe() || !self.is_within(0.1)
    }
}
