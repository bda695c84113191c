//! What came of a flight.

use serde::Serialize;

use super::plan::Planned;

/// Declared limits of a touchdown: error and speeds in metres and m/s, tilt in degrees.
pub const FAR_M: f64 = 0.3;
/// See [`FAR_M`].
pub const HARD_M_S: f64 = 0.6;
/// See [`FAR_M`].
pub const SLIDING_M_S: f64 = 0.1;
/// See [`FAR_M`].
pub const TILTED_DEG: f64 = 10.0;
/// Beyond these the vehicle itself is in danger: it bounces or tips over.
pub const CRASH_SINK_M_S: f64 = 0.8;
/// See [`CRASH_SINK_M_S`].
pub const CRASH_SLIDE_M_S: f64 = 0.5;

/// How it ended.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Ending {
    /// On the ground, disarmed.
    Landed,
    /// Given up before the ground.
    Aborted,
    /// Neither, when patience ended.
    Unfinished,
}

/// The row of one flight. Times are in seconds from the start of the landing.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Outcome {
    /// What it has in common with others.
    pub cell: String,
    /// Its seed.
    pub seed: u64,
    /// How the marker was seen.
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
    /// How it ended.
    pub ending: Ending,
    /// The controller's last phase.
    pub phase: messages::Phase,
    /// Its last reason.
    pub why: String,
    /// Horizontal distance from the pad at the touch, in metres.
    pub error_m: Option<f64>,
    /// Its part northwards.
    pub error_north_m: Option<f64>,
    /// Its part eastwards.
    pub error_east_m: Option<f64>,
    /// Downward speed at the touch, relative to the pad, in m/s.
    pub sink_m_s: Option<f64>,
    /// Horizontal speed at the touch, relative to the pad, in m/s.
    pub slide_m_s: Option<f64>,
    /// Tilt at the touch, in degrees.
    pub touch_tilt_deg: Option<f64>,
    /// Largest tilt of the landing, in degrees.
    pub max_tilt_deg: f64,
    /// Until LAND was flown.
    pub land_s: Option<f64>,
    /// Until the touch.
    pub touchdown_s: Option<f64>,
    /// Until the motors stood still.
    pub disarm_s: Option<f64>,
    /// Frames that were taken.
    pub frames: u64,
    /// Detections that were used.
    pub detections: u64,
    /// How often it climbed to try again.
    pub retries: u32,
}

impl Outcome {
    /// A flight that has not begun.
    pub fn of(planned: &Planned) -> Self {
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
            ending: Ending::Unfinished,
            phase: messages::Phase::default(),
            why: String::new(),
            error_m: None,
            error_north_m: None,
            error_east_m: None,
            sink_m_s: None,
            slide_m_s: None,
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

    /// Landed within this distance of the pad's middle.
    pub fn is_within(&self, metres: f64) -> bool {
        self.ending == Ending::Landed && self.error_m.is_some_and(|error| error <= metres)
    }

    /// Touched the ground, without having given up, far from the pad, so hard or so fast sideways that the vehicle is in
    /// danger.
    pub fn is_unsafe(&self) -> bool {
        let beyond = |value: Option<f64>, limit: f64| value.is_some_and(|value| value > limit);
        self.ending != Ending::Aborted
            && (beyond(self.error_m, FAR_M)
                || beyond(self.sink_m_s, CRASH_SINK_M_S)
                || beyond(self.slide_m_s, CRASH_SLIDE_M_S))
    }

    /// Something to look at: unsafe, far, unfinished or given up.
    pub fn is_failure(&self) -> bool {
        self.is_unsafe() || !self.is_within(0.1)
    }
}
