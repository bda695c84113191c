//! Classifies each frame that a detector searched: used, refused and why, or without a marker; and when.

use std::collections::BTreeSet;

use autopilot::Parser;
use autopilot::dialect::MavMessage;
use flightlog::RecordedTape;
use messages::{Detections, LandedState, StageTime, TapeDecision, TapeEvent, VehicleState};

use crate::flight::{Flight, Found};

/// How far stamps of the same frame may be apart that were computed from ages, in nanoseconds.
const SAME_FRAME_NS: i64 = 2_000;
/// How much later the recorder may receive detections than the controller's estimate from them, in nanoseconds.
const MAX_LATER_NS: i64 = 30_000_000;
/// Longest time from detections to the setpoint that uses them, in nanoseconds: the next one later has other reasons.
const MAX_TO_SETPOINT_NS: i64 = 2_000_000_000;
/// Greatest vertical speed of a vehicle that stands, by its autopilot's estimate, in m/s.
const MAX_RESTING_M_S: f64 = 0.1;
/// Shortest time without a vehicle state in which it may have flown, in nanoseconds.
const GAP_NS: i64 = 1_000_000_000;
/// How far the height of a vehicle that stands may be from that with which its autopilot says so, in metres.
const MAX_RISE_M: f64 = 0.2;
/// Phases in which no vehicle is landing.
const OUTSIDE: [&str; 5] = ["idle", "takeoff", "landed", "aborted", "pilot-in-command"];

/// The outcome of a frame.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Fate {
    /// The estimate used it.
    Used,
    /// The configured marker was not in it.
    NoMarker,
    /// Its marker was refused, for this reason.
    Refused(String),
    /// Another detector was in use.
    Standby,
    /// No landing was under way.
    NotNeeded,
    /// The estimate did not use it, and the vehicle had touched down by then: at most a part of the marker is in view, level with it.
    OnGround,
    /// The controller refused it before the estimate, or another frame had overtaken it.
    NotTaken,
    /// The recording does not show it.
    Unknown,
}

impl Fate {
    /// In a few words.
    pub fn name(&self) -> &str {
        match self {
            Self::Used => "used",
            Self::NoMarker => "no marker",
            Self::Refused(why) => why,
            Self::Standby => "standby",
            Self::NotNeeded => "not needed",
            Self::OnGround => "on the ground",
            Self::NotTaken => "not taken",
            Self::Unknown => "not known",
        }
    }

    /// As a sentence.
    pub fn meaning(&self) -> String {
        match self {
            Self::Used => "the estimate used it".to_owned(),
            Self::NoMarker => "the configured marker was not found in it".to_owned(),
            Self::Refused(why) => refusal(why).to_owned(),
            Self::Standby => "another detector was in use".to_owned(),
            Self::NotNeeded => "no landing was under way".to_owned(),
            Self::OnGround => "not used, as the vehicle had touched down by then".to_owned(),
            Self::NotTaken => "overtaken by another frame, or refused before the estimate: of another clock or camera, or by \
                               another detector's name (the controller's losses count those)"
                .to_owned(),
            Self::Unknown => "the recording does not show it".to_owned(),
        }
    }
}

/// The meaning of a refusal's short name.
fn refusal(name: &str) -> &str {
    match name {
        "stale" => "refused: too old when it arrived",
        "from-the-future" => "refused: its stamp lies in the future",
        "out-of-order" => "refused: not newer than an event already used",
        "not-finite" => "refused: a number in it is not finite",
        "no-attitude" => "refused: the vehicle's attitude at its stamp is not known",
        "no-pose" => "refused: it has no pose",
        "implausible" => "refused: its pose is not below the vehicle",
        "bad-covariance" => "refused: its covariance is not valid",
        "low-confidence" => "refused: its confidence is too low",
        "repeated-picture" => "refused: an old picture, which the camera repeats",
        "duplicate" => "refused: a frame of the same stamp was used already",
        "outlier" => "refused: too far from the estimate",
        _ => "refused by the controller, before the estimate",
    }
}

/// A frame that a detector searched.
#[derive(Clone, Debug, PartialEq)]
pub struct Handled {
    /// The detector.
    pub detector: String,
    /// Mid-exposure, in nanoseconds of the vehicle's clock.
    pub exposed_ns: i64,
    /// When the controller had the detections, in nanoseconds of its clock; without a tape when the recorder had them.
    pub handled_ns: i64,
    /// Its outcome.
    pub fate: Fate,
    /// How long each stage of the detector took.
    pub stages: Vec<StageTime>,
    /// When the next setpoint went out, of a frame that was used, in nanoseconds.
    pub setpoint_ns: Option<i64>,
}

impl Handled {
    /// Whether the detector in use searched it during the landing, before the vehicle stood.
    pub fn is_of_landing(&self) -> bool {
        !matches!(self.fate, Fate::Standby | Fate::NotNeeded | Fate::OnGround)
    }
}

/// All frames that detectors searched.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Frames {
    /// Whether they are from the controller's tape, which has each with the time at which it was handled.
    pub is_from_tape: bool,
    /// The frames, in the order in which their detections were received.
    pub all: Vec<Handled>,
}

impl Frames {
    /// The frames of a flight.
    pub fn of(flight: &Flight) -> Self {
        let marker = flight.marker();
        let mut all: Vec<Handled> = Vec::new();
        for tape in &flight.tapes {
            all.extend(of_tape(tape, marker.as_deref()));
        }
        all.retain(|it| flight.has(it.handled_ns));
        let mut frames = match all.is_empty() {
            false => Self { is_from_tape: true, all },
            true => Self { is_from_tape: false, all: of_messages(flight, marker.as_deref()) },
        };
        for frame in &mut frames.all {
            let is_unused = matches!(frame.fate, Fate::Refused(_) | Fate::NoMarker);
            if is_unused && stands(flight, frame.handled_ns) {
                frame.fate = Fate::OnGround;
            }
        }
        frames
    }

    /// How many became this.
    pub fn count(&self, fate: &Fate) -> usize {
        self.all.iter().filter(|frame| frame.fate == *fate).count()
    }

    /// How many the detector in use searched during the landing, until the vehicle stood.
    pub fn of_landing(&self) -> usize {
        self.all.iter().filter(|frame| frame.is_of_landing()).count()
    }

    /// The outcomes of frames, the best first.
    pub fn fates(&self) -> BTreeSet<Fate> {
        self.all.iter().map(|frame| frame.fate.clone()).collect()
    }

    /// Those of which the marker was refused.
    pub fn refused(&self) -> usize {
        self.all.iter().filter(|frame| matches!(frame.fate, Fate::Refused(_))).count()
    }
}

/// Whether the vehicle stood on the ground at a time, by the truth or by its autopilot.
fn stands(flight: &Flight, at_ns: i64) -> bool {
    let truth = newest(&flight.truth, at_ns, |it| it.stamp_ns);
    truth.is_some_and(|it| it.on_ground) || rests(&flight.vehicle, at_ns)
}

/// Whether the autopilot reports at a time that the vehicle stands, or the vehicle neither sinks nor climbs any more until it does: an
/// autopilot takes a second or two to be sure, and no vehicle reaches the ground without sinking. Where states are missing
/// it may have sunk meanwhile, and another height shows that it has.
fn rests(vehicle: &[VehicleState], at_ns: i64) -> bool {
    let later = vehicle.partition_point(|it| it.stamp_ns <= at_ns);
    let from_now = later.checked_sub(1).and_then(|now| vehicle.get(now..)).unwrap_or_default();
    let rests = |it: &VehicleState| {
        let [_, _, down_m_s] = it.velocity_ned_m_s;
        it.landed != LandedState::OnGround && down_m_s.abs() <= MAX_RESTING_M_S
    };
    let resting = from_now.iter().take_while(|it| rests(it)).count();
    let reported = from_now.get(resting).filter(|it| it.landed == LandedState::OnGround);
    let (Some(reported), Some(until_reported)) = (reported, from_now.get(..=resting)) else {
        return false;
    };
    let down_m = |it: &VehicleState| {
        let [_, _, down_m] = it.position_ned_m;
        down_m
    };
    let is_level = |it: &VehicleState| (down_m(it) - down_m(reported)).abs() <= MAX_RISE_M;
    let mut steps = until_reported.iter().zip(until_reported.iter().skip(1));
    until_reported.iter().all(is_level)
        && steps.all(|(one, next)| next.stamp_ns.saturating_sub(one.stamp_ns) < GAP_NS)
}

/// The newest of some messages, in the order of their stamps, up to a time.
fn newest<T>(messages: &[T], at_ns: i64, stamp_ns: impl Fn(&T) -> i64) -> Option<&T> {
    let later = messages.partition_point(|it| stamp_ns(it) <= at_ns);
    messages.get(later.checked_sub(1)?)
}

/// Whether the configured marker is in a frame; without its name, whether any is.
fn has_marker(message: &Detections, marker: Option<&str>) -> bool {
    let Some(marker) = marker else { return !message.detections.is_empty() };
    let (family, id) = match marker.split_once(':') {
        Some((family, id)) => (family, id.parse().ok()),
        None => (marker, None),
    };
    message.detections.iter().any(|it| it.family == family && (id.is_none() || it.id == id))
}

/// The decision that a tape has after a record.
#[derive(Clone, Debug, Default)]
struct Latest {
    rejected: Option<String>,
    detector: Option<String>,
    used: u32,
    is_landing: bool,
}

impl Latest {
    fn of(decision: &TapeDecision<'_>) -> Self {
        Self {
            rejected: decision.rejected.map(str::to_owned),
            detector: decision.detector.map(str::to_owned),
            used: decision.target.map_or(0, |target| target.detections),
            is_landing: !OUTSIDE.contains(&decision.phase),
        }
    }
}

fn of_tape(tape: &RecordedTape, marker: Option<&str>) -> Vec<Handled> {
    let mut frames: Vec<Handled> = Vec::new();
    let mut latest = Latest::default();
    // The first of the frames that wait for a setpoint.
    let mut waiting = 0;
    for record in tape.parts.iter().flat_map(messages::Tape::records).flatten() {
        let before = latest.used;
        let is_new = record.decision().map(|decision| latest = Latest::of(&decision)).is_some();
        if let TapeEvent::Detections { publisher, message } = &record.event {
            let is_active = latest.detector.as_deref().is_none_or(|active| active == publisher);
            let fate = match &latest.rejected {
                _ if !is_active => Fate::Standby,
                _ if !latest.is_landing => Fate::NotNeeded,
                _ if !has_marker(message, marker) => Fate::NoMarker,
                Some(why) => Fate::Refused(why.clone()),
                None if is_new && latest.used > before => Fate::Used,
                // A landing that starts again is counted from its start.
                None if is_new && latest.used > 0 && latest.used < before => Fate::Used,
                None => Fate::NotTaken,
            };
            frames.push(Handled {
                detector: publisher.to_string(),
                exposed_ns: message.header.stamp_ns,
                handled_ns: record.now_ns,
                fate,
                stages: message.stages.clone(),
                setpoint_ns: None,
            });
        }
        if waiting < frames.len() && has_setpoint(&record.packets) {
            let is_soon =
                |it: &Handled| record.now_ns.saturating_sub(it.handled_ns) <= MAX_TO_SETPOINT_NS;
            let used = frames.iter_mut().skip(waiting).filter(|it| it.fate == Fate::Used);
            for frame in used.filter(|it| is_soon(it)) {
                frame.setpoint_ns = Some(record.now_ns);
            }
            waiting = frames.len();
        }
    }
    frames
}

/// Whether a velocity setpoint is among packets for the autopilot.
fn has_setpoint(packets: &[u8]) -> bool {
    let is_setpoint = |message: &MavMessage| {
        matches!(
            message,
            MavMessage::SET_POSITION_TARGET_LOCAL_NED(_) | MavMessage::LANDING_TARGET(_)
        )
    };
    !packets.is_empty()
        && Parser::new().push(packets).iter().filter_map(|it| it.message.as_ref()).any(is_setpoint)
}

/// Without a tape: the estimates show which frame was used last, and why the newest was refused.
fn of_messages(flight: &Flight, marker: Option<&str>) -> Vec<Handled> {
    let age_ns = |age_ms: f64| (age_ms * 1e6).round() as i64;
    let used: BTreeSet<i64> = flight
        .targets
        .iter()
        .filter(|target| target.rejected.is_none())
        .filter_map(|target| Some(target.stamp_ns.saturating_sub(age_ns(target.age_ms?))))
        .collect();
    let is_used = |stamp_ns: i64| {
        let near = stamp_ns.saturating_sub(SAME_FRAME_NS)..=stamp_ns.saturating_add(SAME_FRAME_NS);
        used.range(near).next().is_some()
    };
    let fate = |found: &Found, handled_ns: i64| {
        let status = newest(&flight.statuses, handled_ns, |it| it.stamp_ns);
        let active = status.and_then(|status| status.active_detector.as_deref());
        if active.is_some_and(|active| active != found.detector) {
            return Fate::Standby;
        }
        if status.is_some_and(|status| OUTSIDE.contains(&status.phase.name())) {
            return Fate::NotNeeded;
        }
        if is_used(found.message.header.stamp_ns) {
            return Fate::Used;
        }
        if !has_marker(&found.message, marker) {
            return Fate::NoMarker;
        }
        let from = handled_ns.saturating_sub(MAX_LATER_NS);
        let after = flight.targets.partition_point(|target| target.stamp_ns < from);
        let near = flight.targets.iter().skip(after);
        let near = near.take_while(|it| it.stamp_ns <= handled_ns.saturating_add(MAX_LATER_NS));
        let refusal = near.filter_map(|target| target.rejected.clone()).next();
        refusal.map_or(Fate::Unknown, Fate::Refused)
    };
    let handled = |found: &Found| {
        let handled_ns = flight.vehicle_ns(found.received_ns);
        Handled {
            detector: found.detector.clone(),
            exposed_ns: found.message.header.stamp_ns,
            handled_ns,
            fate: fate(found, handled_ns),
            stages: found.message.stages.clone(),
            setpoint_ns: None,
        }
    };
    flight.found.iter().map(handled).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use messages::Truth;

    fn state(stamp_ns: i64, down_m_s: f64, landed: LandedState) -> VehicleState {
        VehicleState {
            stamp_ns,
            ned_from_body_wxyz: [1.0, 0.0, 0.0, 0.0],
            position_ned_m: [0.0; 3],
            velocity_ned_m_s: [0.5, 0.0, down_m_s],
            mode: "LAND".to_owned(),
            armed: true,
            landed,
            battery: None,
        }
    }

    #[test]
    fn a_vehicle_stands_from_when_it_rests_and_not_only_when_its_autopilot_says_so() {
        use LandedState::{InAir, Landing, OnGround};
        // It hovers, sinks, touches down at 3 on a pad that moves, and is reported to stand at 5.
        let speeds = [(0, 0.0, InAir), (1, 0.0, InAir), (2, 0.4, Landing), (3, 0.03, Landing)];
        let mut vehicle: Vec<_> = speeds.map(|(at, down, landed)| state(at, down, landed)).into();
        vehicle.push(state(4, -0.04, Landing));
        let mut flight = Flight::default();
        flight.vehicle = vehicle;
        let standing =
            |flight: &Flight| (-1..8).filter(|at| stands(flight, *at)).collect::<Vec<_>>();
        // No message reports yet that it stands.
        assert!(standing(&flight).is_empty());
        flight.vehicle.extend([state(5, 0.0, OnGround), state(6, 0.0, OnGround)]);
        assert_eq!(standing(&flight), [3, 4, 5, 6, 7]);
        // It takes off again.
        flight.vehicle.push(state(7, -0.5, InAir));
        assert_eq!(standing(&flight), [3, 4, 5, 6]);
    }

    #[test]
    fn a_hover_before_lost_states_or_at_another_height_is_no_rest_on_the_ground() {
        use LandedState::{Landing, OnGround};
        let rest_at = |gap_ns: i64, down_m: f64| {
            let mut vehicle: Vec<_> = [0, 500_000_000].map(|at| state(at, 0.0, Landing)).into();
            for it in &mut vehicle {
                it.position_ned_m = [0.0, 0.0, down_m];
            }
            vehicle.push(state(500_000_000 + gap_ns, 0.0, OnGround));
            rests(&vehicle, 1)
        };
        assert!(rest_at(500_000_000, 0.0) && rest_at(999_999_999, -0.15));
        assert!(!rest_at(1_000_000_000, 0.0));
        assert!(!rest_at(500_000_000, -0.25) && !rest_at(500_000_000, 3.0));
        assert!(!rest_at(500_000_000, f64::NAN));
    }

    #[test]
    fn the_truth_says_first_that_a_vehicle_stands() {
        let truth = |stamp_ns: i64, on_ground: bool| Truth {
            stamp_ns,
            ned_from_body_wxyz: [1.0, 0.0, 0.0, 0.0],
            position_ned_m: [0.0; 3],
            velocity_ned_m_s: [0.0; 3],
            pad_ned_m: [0.0; 3],
            on_ground,
            touchdown: None,
            max_tilt_rad: 0.0,
            frames: 0,
        };
        let mut flight = Flight::default();
        flight.truth = vec![truth(0, false), truth(2, true), truth(4, false)];
        flight.vehicle = vec![state(0, 0.5, LandedState::Landing)];
        let standing: Vec<_> = (-1..6).filter(|at| stands(&flight, *at)).collect();
        assert_eq!(standing, [2, 3]);
    }
}
