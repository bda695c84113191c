//! What the controller publishes, and what it can be told.

use serde::{Deserialize, Serialize};

use crate::codec::wire;
use crate::detector::Place;

wire! {
    TargetEstimate = 6 v 2;
    ControllerStatus = 7 v 2;
    ControllerCommand = 8 v 2;
    CommandReply = 9 v 1;
}

/// The landing point, as estimated.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TargetEstimate {
    /// When the estimate holds, in nanoseconds of the controller's clock.
    pub stamp_ns: i64,
    /// The landing point in local NED, in metres; `None` while it was never seen.
    pub position_ned_m: Option<[f64; 3]>,
    /// Horizontal distance from the vehicle to it, in metres.
    pub lateral_error_m: Option<f64>,
    /// Height of the vehicle above it, in metres.
    pub height_m: Option<f64>,
    /// Since the capture of the frame that was used last, in milliseconds.
    pub age_ms: Option<f64>,
    /// Why the latest detection was not used, if it was not: a short name for machines.
    pub rejected: Option<String>,
    /// The same in words.
    pub decided: Option<String>,
    /// How it moves in local NED, in m/s: its own motion and the drift of the autopilot's position.
    pub velocity_ned_m_s: Option<[f64; 3]>,
    /// Standard deviation of its horizontal position, in metres.
    pub deviation_m: Option<f64>,
    /// Heading of the marker's upper edge, from north to east, in radians.
    pub heading_rad: Option<f64>,
    /// The newest detection's squared innovation over its covariance: about 3 when all is as expected.
    pub nis: Option<f64>,
    /// By how much exposures are later than their stamps, in milliseconds.
    pub time_offset_ms: Option<f64>,
    /// The wind's velocity to the north and east, as the vehicle's lean tells it, in m/s.
    pub wind_ned_m_s: Option<[f64; 2]>,
}

/// The velocity the autopilot was last asked for.
#[derive(Copy, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Setpoint {
    /// In local NED, in m/s.
    pub velocity_ned_m_s: [f64; 3],
    /// Clockwise seen from above, in rad/s.
    pub yaw_rate_rad_s: f64,
}

/// A detector that could be used.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Candidate {
    /// Its name.
    pub detector: String,
    /// Whether it is used, could be, or could not.
    pub state: DetectorState,
    /// Where it runs, if it has told.
    pub place: Option<Place>,
    /// Since the capture of the frame of its latest detections, in milliseconds.
    pub age_ms: f64,
    /// From the capture of a frame to the arrival of its detections, the median of the last ones, in milliseconds.
    pub latency_ms: f64,
    /// Detections messages a second.
    pub rate_hz: f64,
    /// True while it tells of its presence.
    pub alive: bool,
    /// Distance between its marker and the active detector's in the last frame in which both saw it, in metres.
    pub disagreement_m: Option<f64>,
    /// Of the latest frames in which the active detector saw the marker, those that this one has searched too.
    pub compared: u32,
    /// Those of them in which it saw the marker at the same place.
    pub agreed: u32,
}

/// Whether a detector is used.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DetectorState {
    /// Its detections steer the vehicle.
    Active,
    /// It is healthy and stands by.
    Shadow,
    /// It is silent, late, slow or gone.
    Stale,
}

/// What the controller is doing, and why.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ControllerStatus {
    /// When, in nanoseconds of the controller's clock.
    pub stamp_ns: i64,
    /// The phase of the flight.
    pub phase: String,
    /// Why it does what it does, in words.
    pub why: String,
    /// The guidance in use.
    pub guidance: String,
    /// The link to the autopilot, in words.
    pub autopilot: String,
    /// The detector in use.
    pub active_detector: Option<String>,
    /// Why it is this one, in words.
    pub detector_why: String,
    /// What the operator prefers: a detector's name, `onboard`, `ground` or nothing.
    pub preference: String,
    /// How often another detector became the active one.
    pub detector_changes: u64,
    /// All detectors there are, the active one included.
    pub candidates: Vec<Candidate>,
    /// Since the capture of the frame that was used last, in milliseconds.
    pub detection_age_ms: Option<f64>,
    /// Height above the target, in metres; above the take-off point while no target was seen.
    pub height_m: Option<f64>,
    /// Horizontal distance to the target, in metres.
    pub lateral_error_m: Option<f64>,
    /// The setpoint that was sent last.
    pub setpoint: Option<Setpoint>,
    /// When the landing began, in nanoseconds of the controller's clock.
    pub started_ns: Option<i64>,
    /// When the motors stopped after the landing, in nanoseconds of the controller's clock.
    pub disarmed_ns: Option<i64>,
    /// True once nothing more will happen without a command.
    pub finished: bool,
    /// Detections of the marker that were used.
    pub detections_used: u64,
    /// Median and 99th percentile from a frame's stamp to the setpoint that used it, in milliseconds.
    pub latency_ms: Option<[f64; 2]>,
}

/// What the controller can be told.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum ControllerCommand {
    /// Begin to land.
    Start,
    /// Stop where it is, and wait.
    Hold,
    /// Go on after a hold.
    Resume,
    /// Give the landing up.
    Abort,
    /// Use this detector from now on.
    UseDetector(String),
    /// Change a parameter.
    SetParameter {
        /// Its key in the controller's configuration.
        key: String,
        /// Its new value, in TOML.
        value: String,
    },
    /// Use detectors that run there rather than others.
    PreferDetectors(Place),
}

/// The answer to a command.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CommandReply {
    /// Whether it is carried out.
    pub accepted: bool,
    /// Why not, or what happens now.
    pub reason: String,
}
