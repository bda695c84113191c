//! The phases of a landing as an explicit state machine: visible marker, progress of the guidance, vehicle, commands, alarms and time in;
//! phase and reason out.
//!
//! ```mermaid
//! stateDiagram-v2
//!     [*] --> Idle
//!     Idle --> Search: start
//!     Search --> Approach: marker visible
//!     Search --> Hold: not found
//!     Approach --> Descend: inside the funnel
//!     Descend --> Approach: outside, or marker out of the camera's view
//!     Approach --> Retry: marker lost, its position known
//!     Descend --> Retry: marker lost or not settling, its position known
//!     Retry --> Approach: marker visible
//!     Retry --> Search: not visible in time
//!     Approach --> Hold: marker lost with its position, no progress
//!     Descend --> Hold: marker lost with its position, no progress
//!     Approach --> Aborted: no retry left
//!     Descend --> Aborted: no retry left
//!     Descend --> Final: at `land_height_m`
//!     Hold --> Search: marker visible, resumed, vehicle state recent again
//!     Hold --> Aborted: timeout
//!     Final --> Landed: disarmed
//!     Final --> Final: LAND refused close to the ground, descent by setpoints
//!     Final --> Aborted: LAND refused, no touchdown, operator's abort while still high
//!     Landed --> [*]
//!     Aborted --> [*]
//! ```
//!
//! From every phase that is not terminal:
//!
//! | event | next phase |
//! |---|---|
//! | the operator's abort | Aborted; in LAND only above `no_return_height_m`, back to GUIDED |
//! | `landing_timeout_s` over | Aborted; not in Final |
//! | the operator's hold | Hold; ignored in LAND and while it is requested |
//! | the axes of camera and autopilot, or the marker's size, are not as configured | Hold |
//! | the vehicle's state is stale, or its mode not known | Hold; Final waits |
//! | the link to the autopilot is slow | Hold |
//! | the controller has stood still, or had no state of the vehicle, for long | Hold; not in Final, where LAND has been asked for |
//! | a mode that is neither GUIDED nor the requested LAND; GUIDED again in LAND, `MAX_OVERTAKEN_S` after it began | PilotInCommand |
//! | on the ground; still and low over the pad, where Search or Retry would follow, in Search, or where the link is slow | Final |
//! | disarmed | Aborted in the air; else, while the state is old, a wait of 2 s for a recent one; Landed on the ground or in LAND; else, half a second later, Aborted |
//! | an alarm | as configured for it |
//!
//! Idle, Landed, Aborted and PilotInCommand are terminal: only a new start leaves them, or the command to land here, which
//! needs no marker, only an armed vehicle in our mode or in LAND.
//!
//! | phase | maximum duration | then |
//! |---|---|---|
//! | Search | `search_timeout_s` | Hold |
//! | Approach, Descend | `approach_timeout_s`, `descend_timeout_s` | Hold |
//! | Retry | `retry_timeout_s`, and `retries` times | Search |
//! | Hold | `hold_timeout_s`, by the operator `operator_hold_timeout_s` | Aborted |
//! | Final | `land_timeout_s` until LAND; until the ground `touchdown_timeout_s` and the descent at the autopilot's landing speed | Aborted, Landed |
//! | all together until Final, and Final while the mode is not known | `landing_timeout_s` | Aborted |

use crate::config::{AlarmAction, OnAbort, PhaseConfig};
use crate::decision::{Phase, Reason};
use crate::event::{Alarm, Event, Landed, Mode, OperatorCommand};
use crate::guidance::situation::Progress;
use crate::time::Timestamp;

/// Minimum climb time of a vehicle that could not settle before it tries again, in seconds.
const MIN_RETRY_S: f64 = 2.0;

/// Time in a search that begins low until a vehicle that may stand counts as one that does, in seconds: one that hovers sees
/// the marker before.
const MIN_LOOK_S: f64 = 1.0;

/// Time after LAND has shown in which our own mode may show again, in seconds: on a link with jitter an older heartbeat is
/// late, and the next one follows in a second. No setpoint is sent meanwhile, so a pilot that takes over does not wait.
const MAX_OVERTAKEN_S: f64 = 1.2;

/// Time in which a mode that was requested until then may still show, in seconds: LAND after an abort, our own mode after a recall from
/// LAND. Heartbeats are sent each second, and one may be lost.
const MAX_LATE_MODE_S: f64 = 2.5;

/// Longest time by which LAND may exceed the duration by its speed and the known height while the vehicle still sinks, in seconds:
/// the ground may lie far below the position where the vehicle took off.
const MAX_SINKING_S: f64 = 600.0;

/// Wait for the report of the ground after the motors have stopped, in seconds: it may be later.
const MAX_CONTACT_WAIT_S: f64 = 0.5;

/// Maximum time between two events, which are 25 ms apart, and between two states of the vehicle, after which a landing continues
/// automatically, in seconds. A controller that is started again resumes one that is as old.
pub const MAX_STANDSTILL_S: f64 = 15.0;

/// The inputs of one step.
#[derive(Copy, Clone, Debug)]
pub struct Inputs {
    /// The time.
    pub now: Timestamp,
    /// The operator's command that has just arrived.
    pub operator: Option<OperatorCommand>,
    /// The alarm that has just been raised, and the configured reaction.
    pub alarm: Option<(AlarmAction, Reason)>,
    /// The vehicle; `None` before its first state.
    pub vehicle: Option<VehicleInputs>,
    /// Age of the newest detection used, in seconds; infinite without one.
    pub target_age_s: f64,
    /// The same without the time for which the camera did not show the pad's position, up to a limit.
    pub target_missed_s: f64,
    /// True when there were enough detections without a long gap.
    pub target_confirmed: bool,
    /// True when the marker's position is known well enough to wait for it there.
    pub target_known: bool,
    /// True when the marker is being seen, and its detections are refused.
    pub target_refused: bool,
    /// The progress of the guidance.
    pub progress: Progress,
    /// The evidence that the axes of the camera or the marker's size are not as configured; `None` without any.
    pub mismatch: Option<Reason>,
    /// False while the check of the axes is still running.
    pub may_descend: bool,
    /// The link to the autopilot is too slow to steer over it.
    pub is_link_slow: bool,
    /// The vehicle is still, and so low over the pad that it may stand on it.
    pub may_stand: bool,
    /// The controller has just not run, or has had no state of the vehicle, for so long that no landing continues automatically.
    pub has_stood_still: bool,
}

/// The vehicle as far as the phases need it.
#[derive(Copy, Clone, Debug)]
pub struct VehicleInputs {
    /// Age of the state, in seconds.
    pub age_s: f64,
    /// The flight mode.
    pub mode: Mode,
    /// True when the motors may turn.
    pub armed: bool,
    /// Contact with the ground, where it agrees with height and motion.
    pub landed: Landed,
    /// Height over the target, else over the ground that it stood on, in metres.
    pub height_m: f64,
    /// That height is the one over the target.
    pub is_over_target: bool,
    /// It goes down: a vehicle that stands does not.
    pub sinks: bool,
    /// Speed of the autopilot's LAND near the ground, in m/s.
    pub land_m_s: f64,
    /// It is certainly in the air: it falls, or, not reported to stand, sinks or is high over the target.
    pub flies: bool,
    /// Its motors have just stopped, and its state is too old to show whether that was in the air; a newer one may follow.
    pub awaits_state: bool,
}

/// The state: a phase, since when, and the reason.
#[derive(Clone, Debug)]
pub struct StateMachine {
    config: PhaseConfig,
    phase: Phase,
    reason: Reason,
    entered: Timestamp,
    started: Timestamp,
    /// The autopilot has entered the requested LAND mode.
    landing: bool,
    /// Time in LAND until the touchdown is overdue, in seconds.
    touchdown_limit_s: f64,
    /// The pilot has taken over the aborted vehicle, so it gets no setpoint any more.
    released: bool,
    /// The aborted vehicle is being commanded from LAND back to GUIDED.
    is_recalling: bool,
    /// When that ended for a vehicle that had become too low, until it shows another mode than LAND.
    became_low: Option<Timestamp>,
    /// LAND was requested before the abort and the vehicle may still show it: then it is recalled.
    expects_land: bool,
    /// Retries of this landing so far.
    retries: u32,
    /// When the motors were first seen to be off.
    disarmed: Option<Timestamp>,
    /// They stopped in the air.
    stopped_in_air: bool,
    /// The alarm or command that the vehicle lands for, until the next phase after that landing.
    cause: Option<Reason>,
    /// The reason for the phase, where the present one is why a start was refused: it is stated again after that.
    before_refusal: Option<Reason>,
}

/// The event that ends a hold without a command.
enum EndOfHold {
    /// The marker is seen.
    Marker,
    /// The vehicle's state and mode are known.
    Vehicle,
    /// The link to the autopilot is quick enough.
    Link,
    /// Two detectors agree again: then the lander continues without a command of the operator.
    Agreement,
}

/// The event that ends a hold for this reason; `None` where only a command does.
fn end_of_hold(reason: Reason) -> Option<EndOfHold> {
    match reason {
        Reason::TargetLost | Reason::TargetRefused | Reason::TargetNotFound => {
            Some(EndOfHold::Marker)
        }
        Reason::VehicleStale | Reason::ModeUnknown | Reason::AutopilotLost => {
            Some(EndOfHold::Vehicle)
        }
        Reason::LinkSlow => Some(EndOfHold::Link),
        Reason::Disputed => Some(EndOfHold::Agreement),
        _ => None,
    }
}

/// The configured reaction to an alarm, and the reason; `None` for any other event.
pub(crate) fn reaction(phases: &PhaseConfig, event: Event) -> Option<(AlarmAction, Reason)> {
    let Event::Alarm(alarm) = event else { return None };
    Some(match alarm {
        Alarm::BatteryLow => (phases.on_battery_low, Reason::BatteryLow),
        Alarm::BatteryCritical => (phases.on_battery_critical, Reason::BatteryCritical),
        Alarm::OperatorLost => (phases.on_operator_lost, Reason::OperatorLost),
        Alarm::AutopilotLost => (phases.on_autopilot_lost, Reason::AutopilotLost),
    })
}

impl StateMachine {
    /// A state machine that waits for a start.
    pub fn new(config: PhaseConfig) -> Self {
        Self {
            config,
            phase: Phase::Idle,
            reason: Reason::WaitingForStart,
            entered: Timestamp::default(),
            started: Timestamp::default(),
            landing: false,
            touchdown_limit_s: config.touchdown_timeout_s,
            released: false,
            is_recalling: false,
            became_low: None,
            expects_land: false,
            retries: 0,
            disarmed: None,
            stopped_in_air: false,
            cause: None,
            before_refusal: None,
        }
    }

    /// The present phase.
    pub fn phase(&self) -> Phase {
        self.phase
    }

    /// The reason for it.
    pub fn reason(&self) -> Reason {
        self.reason
    }

    /// The alarm or the operator's command for which it lands, or has landed, away from the marker. The reason states that only
    /// until the autopilot is in LAND.
    pub fn cause(&self) -> Option<Reason> {
        self.cause
    }

    /// Seconds since the phase was entered.
    pub fn elapsed_s(&self, now: Timestamp) -> f64 {
        now.seconds_since(self.entered)
    }

    /// True when the autopilot has entered the requested LAND mode.
    pub fn is_landing(&self) -> bool {
        self.landing
    }

    /// True when the pilot has taken over the aborted vehicle.
    pub fn is_released(&self) -> bool {
        self.released
    }

    /// True while the aborted vehicle is being commanded from LAND back to GUIDED.
    pub fn is_recalling(&self) -> bool {
        self.is_recalling
    }

    /// True while a landing that began continues only by a command: after an abort, and in a hold that does not end on its own.
    pub fn waits_for_operator(&self) -> bool {
        match self.phase {
            Phase::Aborted => true,
            Phase::Hold => end_of_hold(self.reason).is_none(),
            _ => false,
        }
    }

    /// Takes at most one transition; true when a landing has just started.
    pub fn advance(&mut self, inputs: &Inputs) -> bool {
        if let Some(reason) = self.before_refusal.take() {
            self.reason = reason;
        }
        if self.phase.is_terminal() {
            let before = self.reason;
            let begun = match inputs.operator {
                Some(OperatorCommand::Start) => Some(self.start(inputs)),
                Some(OperatorCommand::LandHere) => Some(self.land_here(inputs)),
                _ => None,
            };
            if let Some(begun) = begun {
                self.before_refusal = (!begun).then_some(before);
                return begun;
            }
            self.release_on_takeover(inputs);
            return false;
        }
        if let Some(vehicle) = inputs.vehicle
            && self.phase == Phase::Final
            && vehicle.mode == Mode::Land
            && !self.landing
        {
            self.entered = inputs.now;
            self.reason = Reason::AutopilotLands;
            self.follow_land(vehicle);
        }
        let is_disarmed = inputs.vehicle.is_some_and(|vehicle| !vehicle.armed);
        self.disarmed = is_disarmed.then(|| self.disarmed.unwrap_or(inputs.now));
        let flies = inputs.vehicle.is_some_and(|vehicle| vehicle.flies);
        self.stopped_in_air = is_disarmed && (self.stopped_in_air || flies);
        // With the motors off nothing advances: it is only decided where they stopped.
        let next = match self.interruption(inputs) {
            None if !is_disarmed => self.next(inputs),
            interruption => interruption,
        };
        if let Some((phase, reason)) = next {
            // Search and retry climb, and so does a low hold over a slow link. An autopilot reports the ground seconds late:
            // ArduPilot 7 s after the touchdown.
            let climbs = matches!(
                (phase, reason),
                (Phase::Search | Phase::Retry, _) | (Phase::Hold, Reason::LinkSlow)
            );
            let (phase, reason) = if climbs && inputs.may_stand {
                (Phase::Final, Reason::MayStand)
            } else {
                (phase, reason)
            };
            let was_landing = self.phase == Phase::Final;
            self.enter(phase, reason, inputs.now);
            self.expects_land = was_landing
                && phase == Phase::Aborted
                && reason == Reason::OperatorAbort
                && !self.is_recalling
                && self.can_recall(inputs);
        }
        false
    }

    /// Starts a landing, or refuses with the reason while the autopilot would not follow setpoints.
    fn start(&mut self, inputs: &Inputs) -> bool {
        let is_recent = |vehicle: &VehicleInputs| vehicle.age_s <= self.config.stale_vehicle_s;
        let Some(vehicle) = inputs.vehicle.filter(is_recent) else {
            self.reason = Reason::NoVehicleState;
            return false;
        };
        let is_landing =
            vehicle.mode == Mode::Land && vehicle.height_m <= self.config.watch_height_m;
        if !vehicle.armed {
            self.reason = Reason::NotArmed;
        } else if is_landing {
            self.begin(Phase::Final, Reason::AutopilotLands, inputs.now);
            self.follow_land(vehicle);
        } else if vehicle.mode != Mode::Guided {
            self.reason = Reason::NotGuided;
        } else if vehicle.landed == Landed::OnGround {
            self.reason = Reason::OnTheGround;
        } else {
            self.begin(Phase::Search, Reason::Searching, inputs.now);
        }
        !self.phase.is_terminal()
    }

    /// Lands where the vehicle is, or refuses with the reason.
    fn land_here(&mut self, inputs: &Inputs) -> bool {
        let Some(vehicle) = inputs.vehicle else {
            self.reason = Reason::NoVehicleState;
            return false;
        };
        match vehicle.mode {
            _ if !vehicle.armed => self.reason = Reason::NotArmed,
            _ if vehicle.landed == Landed::OnGround => self.reason = Reason::OnTheGround,
            Mode::Guided => self.begin(Phase::Final, Reason::OperatorLand, inputs.now),
            Mode::Land => {
                self.begin(Phase::Final, Reason::AutopilotLands, inputs.now);
                self.cause = Some(Reason::OperatorLand);
                self.follow_land(vehicle);
            }
            Mode::Other => self.reason = Reason::NotGuided,
            Mode::Unknown => self.reason = Reason::NoVehicleState,
        }
        !self.phase.is_terminal()
    }

    /// The autopilot lands from the vehicle's height.
    fn follow_land(&mut self, vehicle: VehicleInputs) {
        self.landing = true;
        self.touchdown_limit_s =
            self.config.touchdown_timeout_s + libm::fmax(vehicle.height_m, 0.0) / vehicle.land_m_s;
    }

    fn begin(&mut self, phase: Phase, reason: Reason, now: Timestamp) {
        self.enter(phase, reason, now);
        self.started = now;
        self.released = false;
        self.retries = 0;
    }

    /// Ends the landing; no action follows until another one is started.
    pub fn stand_down(&mut self, now: Timestamp) {
        self.enter(Phase::Idle, Reason::WaitingForStart, now);
        (self.expects_land, self.released) = (false, false);
    }

    fn enter(&mut self, phase: Phase, reason: Reason, now: Timestamp) {
        self.is_recalling =
            phase == Phase::Aborted && self.landing && reason == Reason::OperatorAbort;
        self.became_low = None;
        self.cause = match (phase, reason) {
            (
                Phase::Final,
                Reason::OperatorLand
                | Reason::BatteryLow
                | Reason::BatteryCritical
                | Reason::OperatorLost
                | Reason::AutopilotLost,
            ) => Some(reason),
            (Phase::Landed, _) => self.cause,
            _ => None,
        };
        self.phase = phase;
        self.reason = reason;
        self.entered = now;
        self.landing = false;
    }

    /// After an abort, the first foreign mode releases the vehicle.
    fn release_on_takeover(&mut self, inputs: &Inputs) {
        let Some(vehicle) = inputs.vehicle else { return };
        self.expects_land &= !self.timed_out(inputs, MAX_LATE_MODE_S);
        if self.expects_land && vehicle.mode == Mode::Land {
            self.expects_land = false;
            self.is_recalling = true;
        }
        let in_time = !self.timed_out(inputs, self.config.land_timeout_s);
        // One that would stop low over the ground, or on it with its motors running, is landed instead. Where it has carried out the
        // request of it before, it follows again.
        let is_low = !self.is_high(vehicle);
        if matches!(vehicle.mode, Mode::Guided | Mode::Other) {
            self.became_low = None;
        } else if self.is_recalling && is_low {
            self.became_low = Some(inputs.now);
        }
        // While the mode is not known no mode is requested, and it may be LAND still.
        let may_land = matches!(vehicle.mode, Mode::Land | Mode::Unknown);
        self.is_recalling &= may_land && in_time && !is_low;
        let may_follow =
            self.became_low.is_some_and(|since| inputs.now.seconds_since(since) <= MAX_LATE_MODE_S);
        let is_foreign = matches!(vehicle.mode, Mode::Land | Mode::Other);
        self.released |= is_foreign && !self.is_recalling && !may_follow;
    }

    /// The transitions that any phase can take.
    fn interruption(&self, inputs: &Inputs) -> Option<(Phase, Reason)> {
        if let Some(vehicle) = inputs.vehicle {
            // PX4 leaves LAND as it stops the motors (seen with 1.17); that is not the pilot.
            let is_at_end = self.landing && !vehicle.armed;
            if is_at_end && self.stopped_in_air {
                return Some((Phase::Aborted, Reason::StoppedInAir));
            }
            if is_at_end && !vehicle.awaits_state {
                return Some((Phase::Landed, Reason::TouchedDown));
            }
            let is_ours = match vehicle.mode {
                Mode::Guided => !self.landing || self.elapsed_s(inputs.now) < MAX_OVERTAKEN_S,
                Mode::Land => self.phase == Phase::Final,
                Mode::Other => false,
                // Undecided: no mode is requested, and the vehicle hovers.
                Mode::Unknown => true,
            };
            if !is_ours && !is_at_end {
                return Some((Phase::PilotInCommand, Reason::PilotTookOver));
            }
            let disarmed = self.disarmed(inputs.now, vehicle);
            if disarmed.is_some() {
                return disarmed;
            }
        }
        if inputs.operator == Some(OperatorCommand::Abort) && self.can_abort(inputs) {
            return Some((Phase::Aborted, Reason::OperatorAbort));
        }
        if self.landing {
            return None;
        }
        if inputs.operator == Some(OperatorCommand::LandHere) && self.phase != Phase::Final {
            return Some((Phase::Final, Reason::OperatorLand));
        }
        if self.disarmed.is_some() {
            return None;
        }
        if let Some((action, reason)) = inputs.alarm
            && self.phase != Phase::Final
        {
            match action {
                AlarmAction::Ignore => {}
                AlarmAction::Hold if inputs.has_stood_still => {}
                // A hold for another reason continues when the link is back.
                AlarmAction::Hold
                    if reason == Reason::AutopilotLost
                        && self.phase == Phase::Hold
                        && self.reason != Reason::VehicleStale => {}
                AlarmAction::Hold => return Some((Phase::Hold, reason)),
                AlarmAction::Abort => return Some((Phase::Aborted, reason)),
                AlarmAction::Land => return Some((Phase::Final, reason)),
            }
        }
        let continues = match self.phase {
            Phase::Search | Phase::Approach | Phase::Descend | Phase::Retry => true,
            Phase::Hold => end_of_hold(self.reason).is_some(),
            _ => false,
        };
        if inputs.has_stood_still && continues {
            return Some((Phase::Hold, Reason::Standstill));
        }
        // While LAND is requested a hold would let the vehicle enter it unwatched; an abort calls it back.
        let asks_for_land = self.phase == Phase::Final && self.reason != Reason::LandingBySetpoints;
        if inputs.operator == Some(OperatorCommand::Hold) && !asks_for_land {
            return Some((Phase::Hold, Reason::OperatorHold));
        }
        // Final has separate timeouts, except for the wait until the mode is known.
        let is_bounded = self.phase == Phase::Final
            && inputs.vehicle.is_some_and(|vehicle| vehicle.mode != Mode::Unknown);
        let lasted_s = inputs.now.seconds_since(self.started);
        if lasted_s > self.config.landing_timeout_s && !is_bounded {
            return Some((Phase::Aborted, Reason::LandingTooLong));
        }
        let is_moving =
            matches!(self.phase, Phase::Search | Phase::Approach | Phase::Descend | Phase::Retry);
        if let Some(reason) = inputs.mismatch.filter(|_| is_moving) {
            return Some((Phase::Hold, reason));
        }
        let on_ground = inputs.vehicle.is_some_and(|vehicle| vehicle.landed == Landed::OnGround);
        if on_ground && self.phase != Phase::Final {
            return Some((Phase::Final, Reason::TouchedEarly));
        }
        None
    }

    /// In LAND only a vehicle that is still high is commanded back, and only if the abort does not land it as
    /// well.
    fn can_abort(&self, inputs: &Inputs) -> bool {
        !self.landing || self.can_recall(inputs)
    }

    fn can_recall(&self, inputs: &Inputs) -> bool {
        let is_high = inputs.vehicle.is_some_and(|vehicle| self.is_high(vehicle));
        is_high && self.config.on_abort != OnAbort::Land
    }

    /// Whether the vehicle is so high that it can still be called back from LAND.
    pub(crate) fn is_high(&self, vehicle: VehicleInputs) -> bool {
        // Below the position where it took off the ground is not known; a vehicle that sinks flies, as does one that is not in LAND yet.
        let flies = vehicle.landed != Landed::OnGround && (vehicle.sinks || !self.landing);
        let is_in_valley = !vehicle.is_over_target && vehicle.height_m < 0.0 && flies;
        vehicle.height_m > self.config.no_return_height_m || is_in_valley
    }

    /// The end of a landing whose motors are off.
    fn disarmed(&self, now: Timestamp, vehicle: VehicleInputs) -> Option<(Phase, Reason)> {
        if vehicle.awaits_state && !self.stopped_in_air {
            return None;
        }
        if !vehicle.armed && vehicle.landed == Landed::OnGround && !self.stopped_in_air {
            return Some((Phase::Landed, Reason::TouchedDown));
        }
        let reason = if self.stopped_in_air { Reason::StoppedInAir } else { Reason::Disarmed };
        let waited_s = now.seconds_since(self.disarmed?);
        (waited_s >= MAX_CONTACT_WAIT_S).then_some((Phase::Aborted, reason))
    }

    /// The transitions of the present phase.
    fn next(&mut self, inputs: &Inputs) -> Option<(Phase, Reason)> {
        let is_stale =
            inputs.vehicle.is_none_or(|vehicle| vehicle.age_s > self.config.stale_vehicle_s);
        let is_unknown = inputs.vehicle.is_some_and(|vehicle| vehicle.mode == Mode::Unknown);
        match self.phase {
            Phase::Idle | Phase::Landed | Phase::Aborted | Phase::PilotInCommand => None,
            Phase::Search | Phase::Approach | Phase::Descend | Phase::Retry if is_stale => {
                Some((Phase::Hold, Reason::VehicleStale))
            }
            Phase::Search | Phase::Approach | Phase::Descend | Phase::Retry if is_unknown => {
                Some((Phase::Hold, Reason::ModeUnknown))
            }
            Phase::Search | Phase::Approach | Phase::Descend | Phase::Retry
                if inputs.is_link_slow =>
            {
                Some((Phase::Hold, Reason::LinkSlow))
            }
            Phase::Search => self.after_search(inputs),
            Phase::Approach => self.after_approach(inputs),
            Phase::Descend => self.after_descend(inputs),
            Phase::Retry => self.after_retry(inputs),
            Phase::Hold => self.after_hold(inputs, is_stale || is_unknown),
            Phase::Final => self.after_final(inputs),
        }
    }

    fn after_search(&mut self, inputs: &Inputs) -> Option<(Phase, Reason)> {
        if inputs.vehicle.is_some_and(|vehicle| vehicle.landed == Landed::TakingOff) {
            self.reason = Reason::TakingOff;
            self.entered = inputs.now;
            return None;
        }
        self.reason = Reason::Searching;
        if self.target_visible(inputs) {
            return Some((Phase::Approach, Reason::Aligning));
        }
        let looked_s = libm::fmin(self.config.search_delay_s, MIN_LOOK_S);
        if inputs.may_stand && self.elapsed_s(inputs.now) >= looked_s {
            return Some((Phase::Final, Reason::MayStand));
        }
        self.timed_out(inputs, self.config.search_timeout_s)
            .then_some((Phase::Hold, Reason::TargetNotFound))
    }

    fn after_approach(&mut self, inputs: &Inputs) -> Option<(Phase, Reason)> {
        let waits = self.waits_for_view(inputs);
        match inputs.progress {
            Progress::Ready(reason) => Some((Phase::Final, reason)),
            Progress::Blind if inputs.may_descend && !self.was_out_of_view(inputs) => {
                Some((Phase::Descend, Reason::DescendingUnseen))
            }
            _ if self.target_lost(inputs) && !waits => {
                Some(self.retry_or_abort(inputs, Reason::Retrying))
            }
            Progress::Stuck => Some(self.retry_or_abort(inputs, Reason::NotSettling)),
            Progress::Descending if inputs.may_descend && !waits => {
                Some((Phase::Descend, Reason::Descending))
            }
            Progress::Descending | Progress::Blind | Progress::Aligning | Progress::Unchanged => {
                self.timed_out(inputs, self.config.approach_timeout_s)
                    .then_some((Phase::Hold, Reason::NoProgress))
            }
        }
    }

    fn after_descend(&mut self, inputs: &Inputs) -> Option<(Phase, Reason)> {
        match inputs.progress {
            Progress::Ready(reason) => Some((Phase::Final, reason)),
            Progress::Descending | Progress::Aligning | Progress::Unchanged
                if self.target_lost(inputs) =>
            {
                // On approach it is waited for.
                Some(match self.waits_for_view(inputs) {
                    true => (Phase::Approach, Reason::Aligning),
                    false => self.retry_or_abort(inputs, Reason::Retrying),
                })
            }
            Progress::Stuck => Some(self.retry_or_abort(inputs, Reason::NotSettling)),
            Progress::Aligning => Some((Phase::Approach, Reason::Aligning)),
            Progress::Descending | Progress::Blind | Progress::Unchanged => self
                .timed_out(inputs, self.config.descend_timeout_s)
                .then_some((Phase::Hold, Reason::NoProgress)),
        }
    }

    /// True for a lost target whose position was out of the camera's view meanwhile.
    fn was_out_of_view(&self, inputs: &Inputs) -> bool {
        self.target_lost(inputs) && inputs.target_missed_s < inputs.target_age_s
    }

    /// True while such a target is waited for, and not descended upon unseen: to accelerate towards it the vehicle tilts the camera
    /// away from it.
    fn waits_for_view(&self, inputs: &Inputs) -> bool {
        self.was_out_of_view(inputs) && inputs.target_missed_s <= self.config.lost_target_s
    }

    /// A retry while one is left; a hold where the marker's position is unknown.
    fn retry_or_abort(&mut self, inputs: &Inputs, reason: Reason) -> (Phase, Reason) {
        let (lost, reason) = match reason {
            Reason::Retrying if inputs.target_refused => {
                (Reason::TargetRefused, Reason::RetryingRefused)
            }
            reason => (Reason::TargetLost, reason),
        };
        if !inputs.target_known {
            return (Phase::Hold, lost);
        }
        if self.retries >= self.config.retries {
            return (Phase::Aborted, Reason::RetriesUsed);
        }
        self.retries += 1;
        (Phase::Retry, reason)
    }

    fn after_retry(&self, inputs: &Inputs) -> Option<(Phase, Reason)> {
        let rested = self.reason != Reason::NotSettling || self.elapsed_s(inputs.now) > MIN_RETRY_S;
        if self.target_visible(inputs) && rested {
            return Some((Phase::Approach, Reason::Aligning));
        }
        self.timed_out(inputs, self.config.retry_timeout_s)
            .then_some((Phase::Search, Reason::Searching))
    }

    fn after_hold(&self, inputs: &Inputs, is_stale: bool) -> Option<(Phase, Reason)> {
        if inputs.operator == Some(OperatorCommand::Resume) {
            return Some((Phase::Search, Reason::Searching));
        }
        let by_operator = matches!(
            self.reason,
            Reason::OperatorHold
                | Reason::BatteryLow
                | Reason::BatteryCritical
                | Reason::OperatorLost
                | Reason::Disputed
                | Reason::MarkerSize
                | Reason::Standstill
        );
        let timeout_s = if by_operator {
            self.config.operator_hold_timeout_s
        } else {
            self.config.hold_timeout_s
        };
        if self.timed_out(inputs, timeout_s) {
            return Some((Phase::Aborted, Reason::HeldTooLong));
        }
        let may_end_on_pad = matches!(self.reason, Reason::LinkSlow | Reason::Standstill);
        if may_end_on_pad && inputs.may_stand && !is_stale {
            return Some((Phase::Final, Reason::MayStand));
        }
        let resumes = match end_of_hold(self.reason) {
            Some(EndOfHold::Marker) => self.target_visible(inputs) && !is_stale,
            Some(EndOfHold::Vehicle) => !is_stale,
            Some(EndOfHold::Link) => !is_stale && !inputs.is_link_slow,
            Some(EndOfHold::Agreement) | None => false,
        };
        resumes.then_some((Phase::Search, Reason::Searching))
    }

    fn after_final(&mut self, inputs: &Inputs) -> Option<(Phase, Reason)> {
        if self.reason == Reason::LandingBySetpoints {
            return self
                .timed_out(inputs, self.config.touchdown_timeout_s)
                .then_some((Phase::Aborted, Reason::LandRefused));
        }
        if !self.landing {
            let is_unknown = inputs.vehicle.is_some_and(|vehicle| vehicle.mode == Mode::Unknown);
            // This close to the ground the descent by setpoints is the only way down.
            let low = matches!(
                self.reason,
                Reason::LowAndAligned
                    | Reason::LowAndUnseen
                    | Reason::TouchedEarly
                    | Reason::MayStand
            );
            if is_unknown && !low {
                // LAND cannot be requested; a vehicle that hovers waits for the heartbeat.
                self.entered = inputs.now;
                return None;
            }
            return self.timed_out(inputs, self.config.land_timeout_s).then_some(if low {
                (Phase::Final, Reason::LandingBySetpoints)
            } else {
                (Phase::Aborted, Reason::LandRefused)
            });
        }
        let sinks = inputs.vehicle.is_some_and(|vehicle| vehicle.sinks);
        let more_s = if sinks { MAX_SINKING_S } else { 0.0 };
        if !self.timed_out(inputs, self.touchdown_limit_s + more_s) {
            return None;
        }
        // Some autopilots are configured never to disarm on their own.
        let down = inputs.vehicle.is_some_and(|vehicle| vehicle.landed == Landed::OnGround);
        Some(if down {
            (Phase::Landed, Reason::TouchedDown)
        } else {
            (Phase::Aborted, Reason::TouchdownOverdue)
        })
    }

    fn target_visible(&self, inputs: &Inputs) -> bool {
        inputs.target_confirmed && inputs.target_age_s <= self.config.stale_target_s
    }

    fn target_lost(&self, inputs: &Inputs) -> bool {
        inputs.target_age_s > self.config.lost_target_s
    }

    fn timed_out(&self, inputs: &Inputs, timeout_s: f64) -> bool {
        self.elapsed_s(inputs.now) > timeout_s
    }
}

#[cfg(test)]
mod tests;
