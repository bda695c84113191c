//! Messages of the controller: status with phase, reason, setpoint and detectors, the target estimate; and the commands to it with
//! their replies.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::codec::wire;
use crate::detector::{Place, marker_name};

wire! {
    TargetEstimate = 6 v 2;
    ControllerStatus = 7 v 9;
    ControllerCommand = 8 v 3;
    CommandReply = 9 v 1;
}

/// The landing point, as estimated.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TargetEstimate {
    /// Time of the estimate, in nanoseconds of the controller's clock.
    pub stamp_ns: i64,
    /// The landing point in local NED, in metres; `None` before the first detection.
    pub position_ned_m: Option<[f64; 3]>,
    /// Horizontal distance from the vehicle to it, in metres.
    pub lateral_error_m: Option<f64>,
    /// Height of the vehicle above it, in metres.
    pub height_m: Option<f64>,
    /// Age of the last frame that was used, since its exposure, in milliseconds.
    pub age_ms: Option<f64>,
    /// Why the latest detection was rejected: a short name for programs.
    pub rejected: Option<String>,
    /// The same as a sentence.
    pub decided: Option<String>,
    /// Its velocity in local NED, in m/s: its own motion and the drift of the autopilot's position.
    pub velocity_ned_m_s: Option<[f64; 3]>,
    /// Standard deviation of its horizontal position, in metres.
    pub deviation_m: Option<f64>,
    /// Heading of the marker's upper edge, from north to east, in radians.
    pub heading_rad: Option<f64>,
    /// Normalised innovation squared of the newest detection: about 3 for a consistent filter.
    pub nis: Option<f64>,
    /// Delay of exposures after their stamps, in milliseconds.
    pub time_offset_ms: Option<f64>,
    /// Wind velocity north and east, estimated from the vehicle's tilt, in m/s.
    pub wind_ned_m_s: Option<[f64; 2]>,
}

/// The last velocity setpoint.
#[derive(Copy, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Setpoint {
    /// In local NED, in m/s.
    pub velocity_ned_m_s: [f64; 3],
    /// Clockwise seen from above, in rad/s.
    pub yaw_rate_rad_s: f64,
}

/// A detector known to the controller.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Candidate {
    /// Its name.
    pub detector: String,
    /// Whether it is used.
    pub state: DetectorState,
    /// Where it runs, if known.
    pub place: Option<Place>,
    /// Age of the frame of its latest detections, since its exposure, in milliseconds.
    pub age_ms: f64,
    /// Median time from a frame's exposure to the arrival of its detections, in milliseconds.
    pub latency_ms: f64,
    /// Rate of its detection messages, in Hz.
    pub rate_hz: f64,
    /// True while its liveliness token is present.
    pub alive: bool,
    /// Distance between its marker position and the active detector's in the last frame with both, in metres.
    pub disagreement_m: Option<f64>,
    /// Latest frames with a marker from the active detector that this detector has searched too.
    pub compared: u32,
    /// Those of them in which both positions agree.
    pub agreed: u32,
}

/// Whether a detector is used.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DetectorState {
    /// Its detections control the vehicle.
    Active,
    /// It is healthy and on standby.
    Shadow,
    /// It is silent, late, slow or gone.
    Stale,
    /// It answers in time, and sees no marker where another one sees it.
    Blind,
    /// It answers in time, and others see the marker elsewhere.
    Outvoted,
    /// It answers in time and sees the marker, and gives no pose of it where the landing needs one.
    NoPose,
}

/// The phase of a flight.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Phase {
    /// Waiting for the start of a landing.
    #[default]
    Idle,
    /// Taking off before the landing.
    Takeoff,
    /// Searching for the marker.
    Search,
    /// Flying above the marker, or waiting until the autopilot has the landing target.
    Approach,
    /// Descending to the marker.
    Descend,
    /// Climbing for another attempt.
    Retry,
    /// The autopilot lands.
    Final,
    /// On the ground, disarmed.
    Landed,
    /// Holding the position.
    Hold,
    /// Ended before the landing.
    Aborted,
    /// The pilot, or a failsafe of the autopilot, flies.
    PilotInCommand,
    /// Ended by a failure; no setpoint or command is sent any more.
    Failed,
}

impl Phase {
    /// Its name in kebab-case, as in JSON.
    pub fn name(self) -> &'static str {
        match self {
            Self::Idle => "idle",
            Self::Takeoff => "takeoff",
            Self::Search => "search",
            Self::Approach => "approach",
            Self::Descend => "descend",
            Self::Retry => "retry",
            Self::Final => "final",
            Self::Landed => "landed",
            Self::Hold => "hold",
            Self::Aborted => "aborted",
            Self::PilotInCommand => "pilot-in-command",
            Self::Failed => "failed",
        }
    }
}

impl fmt::Display for Phase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

/// The state of the controller, with its reason.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ControllerStatus {
    /// Time in nanoseconds of the controller's clock.
    pub stamp_ns: i64,
    /// The phase of the flight.
    pub phase: Phase,
    /// The reason, as text.
    pub why: String,
    /// The guidance in use.
    pub guidance: String,
    /// The marker it lands on, as `FAMILY` or `FAMILY:ID`.
    pub marker: String,
    /// State of the link to the autopilot, as text.
    pub autopilot: String,
    /// The active detector.
    pub active_detector: Option<String>,
    /// Why this one is active, as text.
    pub detector_why: String,
    /// The operator's preference: a detector's name, `onboard`, `ground` or nothing.
    pub preference: String,
    /// Number of changes of the active detector.
    pub detector_changes: u64,
    /// All known detectors, the active one included.
    pub candidates: Vec<Candidate>,
    /// Age of the last frame that was used, since its exposure, in milliseconds.
    pub detection_age_ms: Option<f64>,
    /// Height above the target, in metres; while there is none, above the origin of the autopilot's local frame, which need not be
    /// where the vehicle took off.
    pub height_m: Option<f64>,
    /// Horizontal distance to the target, in metres.
    pub lateral_error_m: Option<f64>,
    /// The last setpoint that was sent.
    pub setpoint: Option<Setpoint>,
    /// When the landing began, in nanoseconds of the controller's clock.
    pub started_ns: Option<i64>,
    /// When the motors stopped after the landing, in nanoseconds of the controller's clock.
    pub disarmed_ns: Option<i64>,
    /// True once the controller does no more without a command.
    pub finished: bool,
    /// True while a landing that began is held or aborted and continues only by a command: after a restart of the controller it must not be
    /// resumed.
    pub waits_for_operator: bool,
    /// Detections of the marker that were used.
    pub detections_used: u64,
    /// Median and 99th percentile from a frame's exposure to the setpoint that used it, in milliseconds.
    pub latency_ms: Option<[f64; 2]>,
    /// Time after which the autopilot stops when setpoints stop, in seconds; none while it is not known.
    pub setpoint_timeout_s: Option<f64>,
    /// Warnings for the operator, as sentences: refused inputs, and detectors that disagree.
    pub warnings: Vec<String>,
}

impl ControllerStatus {
    /// The marker it lands on, unless that is no marker's name, as in a status without one.
    pub fn landing_marker(&self) -> Option<&str> {
        marker_name(&self.marker).is_ok().then_some(self.marker.as_str())
    }

    /// The phase and its reason as a sentence. A reason that begins with the phase's name stands alone, as "aborted: held too long" and
    /// "aborted by the operator" do.
    pub fn sentence(&self) -> String {
        let phase = self.phase.name();
        let after = self.why.strip_prefix(phase);
        let names_phase =
            after.is_some_and(|after| after.starts_with(": ") || after.starts_with(" by "));
        match self.why.as_str() {
            "" => phase.to_owned(),
            why if names_phase => why.to_owned(),
            why => format!("{phase}: {why}"),
        }
    }

    /// The alarm or the command for which it has landed where it was; `None` where the landing led it to the marker.
    pub fn landed_for(&self) -> Option<&str> {
        let (_, cause) = self.why.split_once(": ").filter(|_| self.phase == Phase::Landed)?;
        Some(cause)
    }
}

/// The subject of a text of a status: all but its numbers, which change with each second. Digits within backquotes stay, as
/// they are part of a name.
pub fn matter(text: &str) -> String {
    let mut is_name = false;
    text.chars()
        .filter(|c| {
            is_name ^= *c == '`';
            is_name || !c.is_ascii_digit()
        })
        .collect()
}

/// A command to the controller.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum ControllerCommand {
    /// Begin a landing.
    Start,
    /// Stop and hold the position.
    Hold,
    /// Continue after a hold.
    Resume,
    /// Abort the landing.
    Abort,
    /// Use this detector from now on.
    UseDetector(String),
    /// Prefer detectors that run there.
    PreferDetectors(Place),
    /// Land straight down where the vehicle is, without the marker.
    LandHere,
    /// Prefer no detector to another.
    PreferAnyDetector,
}

/// The answer to a command.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CommandReply {
    /// Whether the command is carried out.
    pub accepted: bool,
    /// The reason of a refusal, or the next step.
    pub reason: String,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_reason_repeats_the_name_of_its_phase() {
        let sentence = |phase, why: &str| {
            ControllerStatus { phase, why: why.into(), ..ControllerStatus::default() }.sentence()
        };
        assert_eq!(sentence(Phase::Aborted, "aborted by the operator"), "aborted by the operator");
        assert_eq!(sentence(Phase::Aborted, "aborted: held too long"), "aborted: held too long");
        assert_eq!(sentence(Phase::Aborted, "the battery is low"), "aborted: the battery is low");
        assert_eq!(sentence(Phase::Aborted, ""), "aborted");
    }

    #[test]
    fn the_subject_of_a_text_contains_names_and_no_numbers() {
        let text = "detector `ground1` is 1.2 m from `air 2`";
        assert_eq!(matter(text), "detector `ground1` is . m from `air 2`");
        assert_eq!(matter(text), matter("detector `ground1` is 30.45 m from `air 2`"));
        assert_ne!(matter(text), matter("detector `ground2` is 1.2 m from `air 2`"));
    }
}
