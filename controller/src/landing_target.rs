//! Lands by the autopilot's own precision landing: a LANDING_TARGET of the marker's place in the body's frame for each frame used, a
//! request for LAND (PRECISION LAND on PX4), and the way back from it on an abort.
//!
//! No setpoint is sent, but to a PX4 that hovers in OFFBOARD, as after a take-off. Every frame that was used
//! gives the autopilot a landing target, and so does the estimate for some seconds near the ground; the pilot, a mission or our own start changes to LAND (PRECISION LAND on
//! PX4), and the autopilot does the rest.

use autopilot::{Autopilot, Command, CommandId, CommandStatus, Firmware, FlightMode, Parameter};
use geometry::{Body, Ned, Point, Vector};
use landing::{FrameObservation, Reason, TargetEstimate, VehicleState};
use messages::Phase;

use crate::config::{LandingTargetSettings, LandingTargetSource};
use crate::control::hover_in_offboard;
use crate::wire;

/// The parameters of ArduPilot that decide whether it uses landing targets.
pub const PARAMETERS: [&str; 2] = ["PLND_ENABLED", "PLND_TYPE"];
/// PLND_TYPE of landing targets that come by MAVLink.
const MAVLINK: f64 = 1.0;
/// Maximum gap between two landing targets, in nanoseconds; after a longer one ArduPilot starts a new
/// estimate.
const MAX_GAP_NS: i64 = 500_000_000;
/// Time after a landing target after which the estimated one follows, in nanoseconds: several within the half second after which PX4, close to
/// the ground, and ArduPilot count the target as lost.
const PREDICTION_NS: i64 = 200_000_000;
/// Time in which a mode that was asked for until then may still show, in nanoseconds: LAND after an abort, the mode in which it hovers
/// after that was withdrawn. Heartbeats come each second, and one may be lost.
const MAX_LATE_MODE_NS: i64 = 2_500_000_000;

/// Why an aborted landing ended that the autopilot had not begun.
const ABORTED: &str = "aborted by the operator; hovering";

/// A precision landing by the autopilot.
#[derive(Debug)]
pub struct LandingTargetMode {
    settings: LandingTargetSettings,
    /// Timeout for the marker, in seconds.
    timeout_s: f64,
    stream: Option<Stream>,
    /// The last landing target was the estimated one.
    is_predicted: bool,
    state: State,
    /// The landing began with a PX4 that holds its place. Where it did not, HOLD is a pilot's choice.
    from_hold: bool,
}

/// Landing targets sent without a gap.
#[derive(Copy, Clone, Debug)]
struct Stream {
    first_ns: i64,
    last_ns: i64,
}

#[derive(Clone, Debug, PartialEq)]
enum State {
    /// No landing was requested.
    Idle,
    /// The landing began at this time; the autopilot has not had the target long enough.
    Stabilising(i64),
    /// LAND is requested.
    Commanding(CommandId),
    /// The autopilot lands.
    Landing,
    /// Aborted while LAND was asked for; if it shows until this time, the autopilot is taken back from it.
    AbortedEarly(i64),
    /// The autopilot is taken back from landing, for this reason.
    Recalling(CommandId, String),
    /// The autopilot, which has become low, is left to its landing; the request to take it back may still show its effect, until this time.
    LeftToLand(i64, String),
    /// On the ground, disarmed.
    Landed,
    /// Aborted, or the pilot took over.
    Ended(String),
}

/// The vehicle as the lander follows it.
#[derive(Copy, Clone, Debug)]
pub struct Situation {
    /// It is so high that it can be taken back from landing.
    pub may_recall: bool,
    /// Why no target is sent.
    pub distrust: Option<Reason>,
    /// It is certainly in the air.
    pub is_flying: bool,
    /// Its motors have just stopped, and its state is too old to show whether that was in the air.
    pub is_awaiting_state: bool,
    /// The velocity that leads a PX4 back to where it waits in OFFBOARD, in m/s.
    pub back: Vector<Ned>,
}

impl LandingTargetMode {
    /// A mode in which nothing was sent yet; a landing that begins waits `timeout_s` for the marker.
    pub fn new(settings: LandingTargetSettings, timeout_s: f64) -> Self {
        Self {
            settings,
            timeout_s,
            stream: None,
            is_predicted: false,
            state: State::Idle,
            from_hold: false,
        }
    }

    /// Sends the landing target of a frame that was used; false when there is nothing to send.
    pub fn send(
        &mut self,
        now_ns: i64,
        frame: &FrameObservation,
        target: Option<TargetEstimate>,
        autopilot: &mut Autopilot,
    ) -> bool {
        let vehicle = autopilot.state().and_then(wire::vehicle);
        let (Some(target), Some(vehicle)) = (target, vehicle) else { return false };
        let detected = frame.marker.and_then(|marker| marker.body_from_marker);
        let is_raw = self.settings.source == LandingTargetSource::Detection;
        let (stamp, place) = match detected.filter(|_| is_raw) {
            Some(pose) => (frame.stamp, pose.origin()),
            None => (vehicle.stamp, in_body(&vehicle, &target)),
        };
        let is_sent = autopilot.send_landing_target(stamp.nanos(), place, target.position);
        self.sent(now_ns, is_sent, false);
        is_sent
    }

    /// Sends the estimated landing target while the autopilot lands and no frame has shown the marker for a while; false when none is due. A
    /// PX4 whose target has been silent for `PLD_BTOUT` climbs to search, also just after it has touched down: close to the ground the
    /// marker may fill the image, or leave it.
    pub fn send_predicted(
        &mut self,
        now_ns: i64,
        target: &TargetEstimate,
        autopilot: &mut Autopilot,
    ) -> bool {
        let is_due =
            self.stream.is_some_and(|it| now_ns.saturating_sub(it.last_ns) >= PREDICTION_NS);
        let lands = matches!(self.state, State::Landing | State::LeftToLand(..));
        let vehicle = autopilot.state().and_then(wire::vehicle).filter(|_| is_due && lands);
        let Some(vehicle) = vehicle else { return false };
        let place = in_body(&vehicle, target);
        let is_sent = autopilot.send_landing_target(vehicle.stamp.nanos(), place, target.position);
        self.sent(now_ns, is_sent, true);
        is_sent
    }

    fn sent(&mut self, now_ns: i64, is_sent: bool, is_predicted: bool) {
        if is_sent {
            let first_ns = self.active_stream(now_ns).map_or(now_ns, |stream| stream.first_ns);
            self.stream = Some(Stream { first_ns, last_ns: now_ns });
            self.is_predicted = is_predicted;
        }
    }

    /// Begins a landing, perhaps of a PX4 that holds its place: LAND is requested once the autopilot has had the target long
    /// enough.
    pub fn begin(&mut self, now_ns: i64, from_hold: bool) {
        self.from_hold = from_hold;
        self.state = State::Stabilising(now_ns);
    }

    /// Follows what the autopilot does; true when it has just begun to land, by any request.
    pub fn step(&mut self, now_ns: i64, situation: Situation, autopilot: &mut Autopilot) -> bool {
        let Situation { may_recall, distrust, is_flying, is_awaiting_state, back } = situation;
        let Some(state) = autopilot.state().copied() else { return false };
        let lands = state.armed && state.mode.is_landing();
        match self.state.clone() {
            State::Landing if !state.armed && is_flying => {
                self.state = State::Ended(Reason::StoppedInAir.to_string());
            }
            State::Landing if !state.armed && is_awaiting_state => {}
            State::Landing if !state.armed => self.state = State::Landed,
            State::Landing if !lands => {
                self.state = State::Ended(format!("the flight mode was changed to {}", state.mode));
            }
            State::Landing => {}
            State::Recalling(_, why) if lands && !may_recall => {
                tracing::warn!("Not taken back from landing: it is too low by now");
                autopilot.withdraw();
                self.state = State::LeftToLand(now_ns.saturating_add(MAX_LATE_MODE_NS), why);
            }
            State::Recalling(request, why) => match autopilot.status(request) {
                CommandStatus::Pending => {}
                CommandStatus::Failed(problem) if lands => {
                    tracing::error!(%problem, "Recall of the landing failed");
                    self.state = State::Landing;
                }
                _ => self.state = State::Ended(why),
            },
            State::LeftToLand(_, why) if state.armed && state.mode == hover_mode(autopilot) => {
                self.state = State::Ended(why);
            }
            State::LeftToLand(until_ns, _) if lands && now_ns <= until_ns => {}
            State::LeftToLand(..) => self.state = State::Landing,
            State::AbortedEarly(until_ns) if lands && may_recall && now_ns <= until_ns => {
                self.recall(now_ns, autopilot);
            }
            // By the pilot or a mission, or as requested.
            _ if lands => {
                autopilot.withdraw();
                self.state = State::Landing;
                return true;
            }
            // It returns to OFFBOARD with zeros. As a pilot may hold it, nothing is requested before.
            State::Stabilising(_) | State::Commanding(_)
                if !self.is_waiting_in(state.mode)
                    && state.armed
                    && autopilot.may_return_to_offboard(now_ns) =>
            {
                hover_in_offboard(now_ns, back, autopilot);
                autopilot.withdraw();
                self.state = State::Stabilising(now_ns);
            }
            State::Stabilising(_) | State::Commanding(_)
                if !self.is_waiting_in(state.mode) || !state.armed =>
            {
                autopilot.withdraw();
                self.state = State::Ended(format!("the pilot flies, in {}", state.mode));
            }
            State::Stabilising(since_ns) => {
                hover_in_offboard(now_ns, back, autopilot);
                self.command_when_steady(now_ns, since_ns, distrust, autopilot);
            }
            State::Commanding(request) => {
                hover_in_offboard(now_ns, back, autopilot);
                if let CommandStatus::Failed(problem) = autopilot.status(request) {
                    self.state = State::Ended(problem.to_string());
                }
            }
            State::Idle | State::AbortedEarly(_) | State::Landed | State::Ended(_) => {}
        }
        false
    }

    /// Takes the autopilot back from landing to the mode in which it hovers; returns why.
    fn recall(&mut self, now_ns: i64, autopilot: &mut Autopilot) -> String {
        let hover = hover_mode(autopilot);
        let request = autopilot.request(now_ns, Command::SetMode(hover));
        let why = format!("aborted by the operator; hovering in {hover}");
        self.state = State::Recalling(request, why.clone());
        why
    }

    fn command_when_steady(
        &mut self,
        now_ns: i64,
        since_ns: i64,
        distrust: Option<Reason>,
        autopilot: &mut Autopilot,
    ) {
        let mode = autopilot.firmware().and_then(Firmware::precision_land);
        let waited_s = now_ns.saturating_sub(since_ns) as f64 * 1e-9;
        if self.is_steady(now_ns)
            && problem(autopilot).is_none()
            && let Some(mode) = mode
        {
            self.state = State::Commanding(autopilot.request(now_ns, Command::SetMode(mode)));
        } else if waited_s > self.timeout_s {
            let distrusted = distrust.map(|why| why.to_string());
            self.state = State::Ended(problem(autopilot).or(distrusted).unwrap_or_else(|| {
                format!("no marker without gaps for {waited_s:.0} s; hovering")
            }));
        }
    }

    /// The controller has not run for so long that nothing descends without a command: a landing that the autopilot has not begun ends. One that
    /// it flies continues.
    pub fn stand_still(&mut self, seconds: f64, autopilot: &mut Autopilot) {
        if matches!(self.state, State::Stabilising(_) | State::Commanding(_)) {
            autopilot.withdraw();
            let why = format!(
                "the controller did not run for {seconds:.0} s before the autopilot landed; hovering: `start` begins a landing"
            );
            tracing::warn!("{why}");
            self.state = State::Ended(why);
        }
    }

    /// Aborts a landing: one that the autopilot flies already is taken back to the mode in which it hovers,
    /// unless it may not be recalled: it is lower than `no_return_m`.
    ///
    /// # Errors
    /// Says why not.
    pub fn abort(
        &mut self,
        now_ns: i64,
        may_recall: bool,
        no_return_m: f64,
        autopilot: &mut Autopilot,
    ) -> Result<String, String> {
        match self.state {
            State::Stabilising(_) | State::Commanding(_) => {
                autopilot.withdraw();
                self.state = match self.state {
                    State::Commanding(_) if may_recall => {
                        State::AbortedEarly(now_ns.saturating_add(MAX_LATE_MODE_NS))
                    }
                    _ => State::Ended(ABORTED.to_owned()),
                };
                Ok(ABORTED.to_owned())
            }
            State::Landing | State::LeftToLand(..) if !may_recall => {
                Err(format!("below {no_return_m} m the autopilot's landing is not interrupted"))
            }
            State::Landing | State::LeftToLand(..) => Ok(self.recall(now_ns, autopilot)),
            State::Idle
            | State::AbortedEarly(_)
            | State::Recalling(..)
            | State::Landed
            | State::Ended(_) => {
                Err(format!("no landing is active (phase `{}`)", self.phase(now_ns, None).0))
            }
        }
    }

    /// The phase and the reason for it; `problem` is the reason for which the autopilot cannot use landing targets.
    pub fn phase(&self, now_ns: i64, problem: Option<String>) -> (Phase, String) {
        let target = match self.active_stream(now_ns) {
            Some(_) if self.is_predicted => {
                "no detection is used, sending the marker's estimated position"
            }
            Some(_) => "sending the landing target",
            None => "no landing target to send",
        };
        match &self.state {
            State::Idle => (
                Phase::Idle,
                problem.unwrap_or_else(|| {
                    format!("waiting for LAND by the pilot, a mission or a start; {target}")
                }),
            ),
            State::Stabilising(_) => (
                Phase::Approach,
                problem.unwrap_or_else(|| {
                    format!("waiting until the autopilot has the target; {target}")
                }),
            ),
            State::Commanding(_) => (Phase::Final, "requesting LAND".to_owned()),
            State::Landing | State::LeftToLand(..) => {
                let why = problem.map_or_else(String::new, |problem| format!(": {problem}"));
                (Phase::Final, format!("the autopilot lands; {target}{why}"))
            }
            State::Landed => (Phase::Landed, Reason::TouchedDown.to_string()),
            State::AbortedEarly(_) => (Phase::Aborted, ABORTED.to_owned()),
            State::Recalling(_, why) | State::Ended(why) => (Phase::Aborted, why.clone()),
        }
    }

    /// True from the beginning of a landing to its end.
    pub fn is_active(&self) -> bool {
        matches!(
            self.state,
            State::Stabilising(_) | State::Commanding(_) | State::Landing | State::LeftToLand(..)
        )
    }

    /// True once a landing was aborted, or the pilot took over.
    pub fn is_aborted(&self) -> bool {
        matches!(self.state, State::AbortedEarly(_) | State::Recalling(..) | State::Ended(_))
    }

    /// True while the autopilot lands.
    pub fn is_landing(&self) -> bool {
        self.state == State::Landing
    }

    /// True once a landing has ended.
    pub fn is_finished(&self) -> bool {
        matches!(self.state, State::AbortedEarly(_) | State::Landed | State::Ended(_))
    }

    /// True in the modes in which the vehicle hovers until LAND is requested.
    fn is_waiting_in(&self, mode: FlightMode) -> bool {
        mode.is_guided() || self.from_hold && mode == FlightMode::AUTO_HOLD
    }

    fn active_stream(&self, now_ns: i64) -> Option<Stream> {
        self.stream.filter(|stream| now_ns.saturating_sub(stream.last_ns) < MAX_GAP_NS)
    }

    fn is_steady(&self, now_ns: i64) -> bool {
        let steady_ns = (self.settings.steady_s * 1e9) as i64;
        self.active_stream(now_ns).is_some_and(|s| s.last_ns - s.first_ns >= steady_ns)
    }
}

/// The estimated place of the marker in the body frame, in metres.
fn in_body(vehicle: &VehicleState, target: &TargetEstimate) -> Point<Body> {
    Point::origin() + vehicle.ned_from_body.inverse() * (target.position - vehicle.position)
}

/// The mode in which the autopilot hovers once it is taken back from landing.
fn hover_mode(autopilot: &Autopilot) -> FlightMode {
    match autopilot.firmware() {
        Some(Firmware::Px4) => FlightMode::AUTO_HOLD,
        _ => FlightMode::Guided,
    }
}

/// The reason for which this autopilot cannot use landing targets, and the remedy.
pub fn problem(autopilot: &Autopilot) -> Option<String> {
    match autopilot.firmware()? {
        // PX4 needs no preparation: its mode PRECISION LAND uses them.
        Firmware::Px4 => return None,
        Firmware::Copter => {}
        other => return Some(format!("{other} has no supported precision landing")),
    }
    match autopilot.parameter("PLND_ENABLED") {
        Parameter::Unknown => return Some("waiting for the parameter PLND_ENABLED".to_owned()),
        Parameter::Silent => {
            return Some(
                "the autopilot does not report PLND_ENABLED: it was built without precision landing, or does not receive our packets"
                    .to_owned(),
            );
        }
        Parameter::Value(0.0) => {
            return Some(
                "the autopilot's precision landing is off: set PLND_ENABLED to 1 and PLND_TYPE to 1, and restart it"
                    .to_owned(),
            );
        }
        Parameter::Value(_) => {}
    }
    match autopilot.parameter("PLND_TYPE") {
        Parameter::Unknown => Some("waiting for the parameter PLND_TYPE".to_owned()),
        Parameter::Value(MAVLINK) => None,
        Parameter::Value(other) => Some(format!(
            "the autopilot's precision landing uses another sensor (PLND_TYPE is {other}): set PLND_TYPE to 1 and restart it"
        )),
        Parameter::Silent => Some(
            "the autopilot does not report PLND_TYPE: restart it, as PLND_ENABLED enables the others only at its start"
                .to_owned(),
        ),
    }
}
