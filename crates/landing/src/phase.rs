//! The phases of a landing: an explicit machine over plain facts.
//!
//! ```mermaid
//! stateDiagram-v2
//!     [*] --> Idle
//!     Idle --> Search: start
//!     Search --> Approach: seen
//!     Search --> Hold: not found
//!     Approach --> Descend: inside the funnel
//!     Descend --> Approach: outside
//!     Approach --> Retry: lost, its place known
//!     Descend --> Retry: lost or not settling, its place known
//!     Retry --> Approach: seen
//!     Retry --> Search: not seen in time
//!     Approach --> Hold: lost, no progress, no retry left
//!     Descend --> Hold: lost, no progress, no retry left
//!     Descend --> Final: a hand's breadth above the ground
//!     Hold --> Search: seen, resumed, vehicle heard again
//!     Hold --> Aborted: held too long
//!     Final --> Landed: disarmed
//!     Final --> Aborted: LAND refused, no touchdown
//!     Landed --> [*]
//!     Aborted --> [*]
//! ```
//!
//! From every phase that is not terminal: the operator's abort and too long a landing lead to Aborted, the operator's hold to Hold
//! (not once the autopilot lands), a stale vehicle state to Hold (Final just waits), a mode that is neither GUIDED nor the
//! LAND we asked for to PilotInCommand, the ground to Final, disarmed motors to Landed or Aborted, an alarm to what is
//! configured for it. Idle, Landed, Aborted and PilotInCommand are terminal: only a new start leaves them.
//!
//! | phase | longest stay | then |
//! |---|---|---|
//! | Search | `search_timeout_s` | Hold |
//! | Approach, Descend | `approach_timeout_s`, `descend_timeout_s` | Hold |
//! | Retry | `retry_timeout_s`, and `retries` times | Search |
//! | Hold | `hold_timeout_s`, by the operator `operator_hold_timeout_s` | Aborted |
//! | Final | `land_timeout_s` until LAND, `touchdown_timeout_s` until the ground | Aborted, Landed |
//! | all together until LAND | `landing_timeout_s` | Aborted |

use std::fmt;

use crate::config::{AlarmAction, PhaseConfig};
use crate::decision::Reason;
use crate::event::{Landed, Mode, OperatorCommand};
use crate::guidance::Progress;
use crate::time::Timestamp;

/// A vehicle that could not settle climbs at least so long before it tries again, in seconds.
const RETRY_REST_S: f64 = 2.0;

/// Where the landing stands.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash)]
pub enum Phase {
    /// Nothing asked for.
    Idle,
    /// Flying an expanding square until the marker is seen.
    Search,
    /// Moving over the marker.
    Approach,
    /// Descending over the marker.
    Descend,
    /// Climbing to where the lost marker must be in view.
    Retry,
    /// The autopilot's LAND mode does the rest.
    Final,
    /// On the ground, disarmed.
    Landed,
    /// Hovering until the reason passes.
    Hold,
    /// Given up.
    Aborted,
    /// Somebody else flies; silent until a new start.
    PilotInCommand,
}

/// What the machine looks at.
#[derive(Copy, Clone, Debug)]
pub struct Facts {
    /// The time.
    pub now: Timestamp,
    /// What the operator has just asked for.
    pub operator: Option<OperatorCommand>,
    /// What has just been reached, and what is to follow.
    pub alarm: Option<(AlarmAction, Reason)>,
    /// The vehicle; `None` before its first state.
    pub vehicle: Option<VehicleFacts>,
    /// Time since the exposure of the newest marker used, in seconds; infinite when there was none.
    pub target_age_s: f64,
    /// True when the marker was seen often enough, without a long gap.
    pub target_confirmed: bool,
    /// True when the marker's place is known although it is not seen.
    pub target_known: bool,
    /// How far the guidance is.
    pub progress: Progress,
}

/// The vehicle as far as phases care.
#[derive(Copy, Clone, Debug)]
pub struct VehicleFacts {
    /// Age of the state, in seconds.
    pub age_s: f64,
    /// The flight mode.
    pub mode: Mode,
    /// True when the motors may turn.
    pub armed: bool,
    /// Contact with the ground.
    pub landed: Landed,
    /// Height over the autopilot's local origin, in metres.
    pub altitude_m: f64,
}

/// The machine: a phase, since when, and why.
#[derive(Clone, Debug)]
pub struct Machine {
    config: PhaseConfig,
    phase: Phase,
    why: Reason,
    entered: Timestamp,
    started: Timestamp,
    /// The autopilot has entered the LAND mode we asked for.
    landing: bool,
    /// Somebody has taken an aborted vehicle over, so it is never spoken to again.
    released: bool,
    /// Retries of this landing so far.
    retries: u32,
}

impl Phase {
    /// True when only a new start leaves this phase.
    pub fn is_terminal(self) -> bool {
        matches!(self, Self::Idle | Self::Landed | Self::Aborted | Self::PilotInCommand)
    }

    /// A short name for machines, in kebab-case; it does not change between versions.
    pub fn name(self) -> &'static str {
        match self {
            Self::Idle => "idle",
            Self::Search => "search",
            Self::Approach => "approach",
            Self::Descend => "descend",
            Self::Retry => "retry",
            Self::Final => "final",
            Self::Landed => "landed",
            Self::Hold => "hold",
            Self::Aborted => "aborted",
            Self::PilotInCommand => "pilot-in-command",
        }
    }
}

impl fmt::Display for Phase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl Machine {
    /// A machine that waits for a start.
    pub fn new(config: PhaseConfig) -> Self {
        Self {
            config,
            phase: Phase::Idle,
            why: Reason::WaitingForStart,
            entered: Timestamp::default(),
            started: Timestamp::default(),
            landing: false,
            released: false,
            retries: 0,
        }
    }

    /// Where the landing stands.
    pub fn phase(&self) -> Phase {
        self.phase
    }

    /// Why the landing stands there.
    pub fn why(&self) -> Reason {
        self.why
    }

    /// Seconds since the phase was entered.
    pub fn elapsed_s(&self, now: Timestamp) -> f64 {
        now.seconds_since(self.entered)
    }

    /// True when the autopilot has entered the LAND mode we asked for.
    pub fn is_landing(&self) -> bool {
        self.landing
    }

    /// True when somebody has taken an aborted vehicle over.
    pub fn is_released(&self) -> bool {
        self.released
    }

    /// Takes at most one step; true when a landing has just begun.
    pub fn advance(&mut self, facts: &Facts) -> bool {
        if facts.operator == Some(OperatorCommand::Start) && self.phase.is_terminal() {
            return self.start(facts);
        }
        if self.phase.is_terminal() {
            self.watch_release(facts);
            return false;
        }
        if let Some(vehicle) = facts.vehicle
            && self.phase == Phase::Final
            && vehicle.mode == Mode::Land
            && !self.landing
        {
            self.landing = true;
            self.entered = facts.now;
            self.why = Reason::AutopilotLands;
        }
        if let Some((phase, why)) = self.interruption(facts).or_else(|| self.next(facts)) {
            self.enter(phase, why, facts.now);
        }
        false
    }

    /// A start is refused, with the reason, while the autopilot would not follow.
    fn start(&mut self, facts: &Facts) -> bool {
        let fresh = |vehicle: &VehicleFacts| vehicle.age_s <= self.config.stale_vehicle_s;
        let Some(vehicle) = facts.vehicle.filter(fresh) else {
            self.why = Reason::NoVehicleState;
            return false;
        };
        let watching =
            vehicle.mode == Mode::Land && vehicle.altitude_m <= self.config.watch_height_m;
        if !vehicle.armed {
            self.why = Reason::NotArmed;
        } else if watching {
            self.begin(Phase::Final, Reason::AutopilotLands, facts.now);
            self.landing = true;
        } else if vehicle.mode != Mode::Guided {
            self.why = Reason::NotGuided;
        } else if vehicle.landed == Landed::OnGround {
            self.why = Reason::OnTheGround;
        } else {
            self.begin(Phase::Search, Reason::Searching, facts.now);
        }
        !self.phase.is_terminal()
    }

    fn begin(&mut self, phase: Phase, why: Reason, now: Timestamp) {
        self.enter(phase, why, now);
        self.started = now;
        self.released = false;
        self.retries = 0;
    }

    fn enter(&mut self, phase: Phase, why: Reason, now: Timestamp) {
        self.phase = phase;
        self.why = why;
        self.entered = now;
        self.landing = false;
    }

    /// After an abort, the first mode that is not ours ends our say.
    fn watch_release(&mut self, facts: &Facts) {
        if let Some(vehicle) = facts.vehicle {
            self.released |= vehicle.mode != Mode::Guided;
        }
    }

    /// What ends or stops a landing in whatever phase it is.
    fn interruption(&self, facts: &Facts) -> Option<(Phase, Reason)> {
        if let Some(vehicle) = facts.vehicle {
            let ours = vehicle.mode == Mode::Guided && !self.landing
                || vehicle.mode == Mode::Land && self.phase == Phase::Final;
            if !ours {
                return Some((Phase::PilotInCommand, Reason::PilotTookOver));
            }
            if !vehicle.armed {
                return Some(self.disarmed(vehicle));
            }
        }
        if facts.operator == Some(OperatorCommand::Abort) {
            return Some((Phase::Aborted, Reason::OperatorAbort));
        }
        if self.landing {
            return None;
        }
        if let Some((action, why)) = facts.alarm
            && self.phase != Phase::Final
        {
            match action {
                AlarmAction::Ignore => {}
                AlarmAction::Hold => return Some((Phase::Hold, Reason::OperatorHold)),
                AlarmAction::Abort => return Some((Phase::Aborted, why)),
                AlarmAction::Land => return Some((Phase::Final, why)),
            }
        }
        if facts.operator == Some(OperatorCommand::Hold) {
            return Some((Phase::Hold, Reason::OperatorHold));
        }
        if facts.now.seconds_since(self.started) > self.config.landing_timeout_s {
            return Some((Phase::Aborted, Reason::LandingTooLong));
        }
        let touched = facts.vehicle.is_some_and(|vehicle| vehicle.landed == Landed::OnGround);
        if touched && self.phase != Phase::Final {
            return Some((Phase::Final, Reason::TouchedEarly));
        }
        None
    }

    fn disarmed(&self, vehicle: VehicleFacts) -> (Phase, Reason) {
        if self.landing || vehicle.landed == Landed::OnGround {
            (Phase::Landed, Reason::TouchedDown)
        } else {
            (Phase::Aborted, Reason::Disarmed)
        }
    }

    /// What comes after the present phase by itself.
    fn next(&mut self, facts: &Facts) -> Option<(Phase, Reason)> {
        let deaf = facts.vehicle.is_none_or(|vehicle| vehicle.age_s > self.config.stale_vehicle_s);
        match self.phase {
            Phase::Idle | Phase::Landed | Phase::Aborted | Phase::PilotInCommand => None,
            Phase::Search | Phase::Approach | Phase::Descend | Phase::Retry if deaf => {
                Some((Phase::Hold, Reason::VehicleStale))
            }
            Phase::Search => self.after_search(facts),
            Phase::Approach => self.after_approach(facts),
            Phase::Descend => self.after_descend(facts),
            Phase::Retry => self.after_retry(facts),
            Phase::Hold => self.after_hold(facts, deaf),
            Phase::Final => self.after_final(facts),
        }
    }

    fn after_search(&mut self, facts: &Facts) -> Option<(Phase, Reason)> {
        if facts.vehicle.is_some_and(|vehicle| vehicle.landed == Landed::TakingOff) {
            self.why = Reason::TakingOff;
            self.entered = facts.now;
            return None;
        }
        self.why = Reason::Searching;
        if self.sees(facts) {
            return Some((Phase::Approach, Reason::Aligning));
        }
        self.over(facts, self.config.search_timeout_s)
            .then_some((Phase::Hold, Reason::TargetNotFound))
    }

    fn after_approach(&mut self, facts: &Facts) -> Option<(Phase, Reason)> {
        match facts.progress {
            Progress::Ready(why) => Some((Phase::Final, why)),
            Progress::Blind => Some((Phase::Descend, Reason::DescendingUnseen)),
            _ if self.lost(facts) => Some(self.again(facts, Reason::Retrying)),
            Progress::Stuck => Some(self.again(facts, Reason::NotSettling)),
            Progress::Descending => Some((Phase::Descend, Reason::Descending)),
            Progress::Aligning | Progress::Unchanged => self
                .over(facts, self.config.approach_timeout_s)
                .then_some((Phase::Hold, Reason::NoProgress)),
        }
    }

    fn after_descend(&mut self, facts: &Facts) -> Option<(Phase, Reason)> {
        match facts.progress {
            Progress::Ready(why) => Some((Phase::Final, why)),
            Progress::Descending | Progress::Aligning | Progress::Unchanged if self.lost(facts) => {
                Some(self.again(facts, Reason::Retrying))
            }
            Progress::Stuck => Some(self.again(facts, Reason::NotSettling)),
            Progress::Aligning => Some((Phase::Approach, Reason::Aligning)),
            Progress::Descending | Progress::Blind | Progress::Unchanged => self
                .over(facts, self.config.descend_timeout_s)
                .then_some((Phase::Hold, Reason::NoProgress)),
        }
    }

    /// Another try, while there is one left and the marker's place is known; otherwise a hold.
    fn again(&mut self, facts: &Facts, why: Reason) -> (Phase, Reason) {
        if facts.target_known && self.retries < self.config.retries {
            self.retries += 1;
            (Phase::Retry, why)
        } else {
            (Phase::Hold, Reason::TargetLost)
        }
    }

    fn after_retry(&self, facts: &Facts) -> Option<(Phase, Reason)> {
        let rested = self.why == Reason::Retrying || self.elapsed_s(facts.now) > RETRY_REST_S;
        if self.sees(facts) && rested {
            return Some((Phase::Approach, Reason::Aligning));
        }
        self.over(facts, self.config.retry_timeout_s).then_some((Phase::Search, Reason::Searching))
    }

    fn after_hold(&self, facts: &Facts, deaf: bool) -> Option<(Phase, Reason)> {
        if facts.operator == Some(OperatorCommand::Resume) {
            return Some((Phase::Search, Reason::Searching));
        }
        let by_operator = self.why == Reason::OperatorHold;
        let timeout_s = if by_operator {
            self.config.operator_hold_timeout_s
        } else {
            self.config.hold_timeout_s
        };
        if self.over(facts, timeout_s) {
            return Some((Phase::Aborted, Reason::HeldTooLong));
        }
        let resumes = match self.why {
            Reason::TargetLost | Reason::TargetNotFound => self.sees(facts) && !deaf,
            Reason::VehicleStale => !deaf,
            _ => false,
        };
        resumes.then_some((Phase::Search, Reason::Searching))
    }

    fn after_final(&mut self, facts: &Facts) -> Option<(Phase, Reason)> {
        if !self.landing {
            return self
                .over(facts, self.config.land_timeout_s)
                .then_some((Phase::Aborted, Reason::LandRefused));
        }
        if !self.over(facts, self.config.touchdown_timeout_s) {
            return None;
        }
        // Some autopilots are set up never to disarm by themselves.
        let down = facts.vehicle.is_some_and(|vehicle| vehicle.landed == Landed::OnGround);
        Some(if down {
            (Phase::Landed, Reason::TouchedDown)
        } else {
            (Phase::Aborted, Reason::TouchdownOverdue)
        })
    }

    fn sees(&self, facts: &Facts) -> bool {
        facts.target_confirmed && facts.target_age_s <= self.config.stale_target_s
    }

    fn lost(&self, facts: &Facts) -> bool {
        facts.target_age_s > self.config.lost_target_s
    }

    fn over(&self, facts: &Facts, timeout_s: f64) -> bool {
        self.elapsed_s(facts.now) > timeout_s
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FLYING: VehicleFacts = VehicleFacts {
        age_s: 0.0,
        mode: Mode::Guided,
        armed: true,
        landed: Landed::InAir,
        altitude_m: 5.0,
    };

    fn at(seconds: f64) -> Facts {
        Facts {
            now: Timestamp::from_seconds(seconds),
            operator: None,
            alarm: None,
            vehicle: Some(FLYING),
            target_age_s: f64::INFINITY,
            target_confirmed: false,
            target_known: false,
            progress: Progress::Unchanged,
        }
    }

    fn seen(seconds: f64, progress: Progress) -> Facts {
        Facts { target_age_s: 0.1, target_confirmed: true, progress, ..at(seconds) }
    }

    fn told(seconds: f64, command: OperatorCommand) -> Facts {
        Facts { operator: Some(command), ..at(seconds) }
    }

    fn flown(seconds: f64, change: impl Fn(&mut VehicleFacts)) -> Facts {
        let mut vehicle = FLYING;
        change(&mut vehicle);
        Facts { vehicle: Some(vehicle), ..at(seconds) }
    }

    /// Takes a new machine through the facts and compares where it ends.
    fn check(facts: &[Facts], phase: Phase, why: Reason) {
        let mut machine = Machine::new(PhaseConfig::default());
        for fact in facts {
            machine.advance(fact);
        }
        assert_eq!((machine.phase(), machine.why()), (phase, why), "after {facts:#?}");
    }

    fn start() -> Facts {
        told(0.0, OperatorCommand::Start)
    }

    #[test]
    fn a_start_is_refused_with_the_reason() {
        let starting = |change: fn(&mut VehicleFacts)| Facts {
            operator: start().operator,
            ..flown(0.0, change)
        };
        check(&[Facts { vehicle: None, ..start() }], Phase::Idle, Reason::NoVehicleState);
        check(&[starting(|v| v.age_s = 0.6)], Phase::Idle, Reason::NoVehicleState);
        check(&[starting(|v| v.armed = false)], Phase::Idle, Reason::NotArmed);
        check(&[starting(|v| v.landed = Landed::OnGround)], Phase::Idle, Reason::OnTheGround);
        check(&[starting(|v| v.mode = Mode::Other)], Phase::Idle, Reason::NotGuided);
        check(&[starting(|v| v.mode = Mode::Land)], Phase::Idle, Reason::NotGuided);
        check(&[start()], Phase::Search, Reason::Searching);
    }

    #[test]
    fn a_start_low_in_land_mode_watches_the_touchdown() {
        let low = |v: &mut VehicleFacts| (v.mode, v.altitude_m) = (Mode::Land, 0.4);
        let starting = Facts { operator: start().operator, ..flown(0.0, low) };
        check(&[starting], Phase::Final, Reason::AutopilotLands);
        let down =
            flown(3.0, |v| (v.mode, v.armed, v.landed) = (Mode::Land, false, Landed::OnGround));
        check(&[starting, down], Phase::Landed, Reason::TouchedDown);
    }

    #[test]
    fn a_landing_goes_through_its_phases() {
        let aligned = seen(2.0, Progress::Descending);
        let ready = seen(9.0, Progress::Ready(Reason::LowAndAligned));
        let land = flown(9.2, |v| v.mode = Mode::Land);
        let down =
            flown(12.0, |v| (v.mode, v.armed, v.landed) = (Mode::Land, false, Landed::OnGround));
        let all = [start(), seen(1.0, Progress::Unchanged), aligned, ready, land, down];
        check(&all[..2], Phase::Approach, Reason::Aligning);
        check(&all[..3], Phase::Descend, Reason::Descending);
        check(&all[..4], Phase::Final, Reason::LowAndAligned);
        check(&all[..5], Phase::Final, Reason::AutopilotLands);
        check(&all, Phase::Landed, Reason::TouchedDown);
    }

    #[test]
    fn nothing_is_waited_for_without_end() {
        let approach = [start(), seen(1.0, Progress::Unchanged)];
        check(&[start(), at(60.1)], Phase::Hold, Reason::TargetNotFound);
        check(&[start(), at(60.1), at(120.3)], Phase::Aborted, Reason::HeldTooLong);
        check(
            &[approach[0], approach[1], seen(61.2, Progress::Aligning)],
            Phase::Hold,
            Reason::NoProgress,
        );
        check(
            &[start(), told(1.0, OperatorCommand::Hold), at(182.0)],
            Phase::Aborted,
            Reason::HeldTooLong,
        );
        check(
            &[start(), told(1.0, OperatorCommand::Hold), at(301.0)],
            Phase::Aborted,
            Reason::LandingTooLong,
        );
        let ready = seen(9.0, Progress::Ready(Reason::LowAndAligned));
        check(&[approach[0], approach[1], ready, at(14.1)], Phase::Aborted, Reason::LandRefused);
        let land = |seconds| flown(seconds, |v| v.mode = Mode::Land);
        check(
            &[approach[0], approach[1], ready, land(9.1), land(69.3)],
            Phase::Aborted,
            Reason::TouchdownOverdue,
        );
    }

    #[test]
    fn a_lost_vehicle_or_target_is_waited_for() {
        let approach = [start(), seen(1.0, Progress::Unchanged)];
        let deaf = flown(2.0, |v| v.age_s = 0.6);
        check(&[approach[0], approach[1], deaf], Phase::Hold, Reason::VehicleStale);
        check(&[approach[0], approach[1], deaf, at(3.0)], Phase::Search, Reason::Searching);
        check(&[approach[0], approach[1], at(2.0)], Phase::Hold, Reason::TargetLost);
        let again = seen(3.0, Progress::Unchanged);
        check(
            &[approach[0], approach[1], at(2.0), again, again],
            Phase::Approach,
            Reason::Aligning,
        );
    }

    #[test]
    fn the_pilot_and_only_the_pilot_takes_over() {
        let land = |seconds| flown(seconds, |v| v.mode = Mode::Land);
        let taken = (Phase::PilotInCommand, Reason::PilotTookOver);
        check(&[start(), flown(1.0, |v| v.mode = Mode::Other)], taken.0, taken.1);
        check(&[start(), land(1.0)], taken.0, taken.1);
        let ready = seen(9.0, Progress::Ready(Reason::LowAndAligned));
        let finals = [start(), seen(1.0, Progress::Unchanged), ready, land(9.1)];
        check(&[finals[0], finals[1], finals[2], finals[3], at(10.0)], taken.0, taken.1);
        check(&[start(), land(1.0), at(2.0), start()], Phase::Search, Reason::Searching);
    }

    #[test]
    fn disarmed_motors_end_the_landing() {
        check(&[start(), flown(1.0, |v| v.armed = false)], Phase::Aborted, Reason::Disarmed);
        let down = |v: &mut VehicleFacts| (v.armed, v.landed) = (false, Landed::OnGround);
        check(&[start(), flown(1.0, down)], Phase::Landed, Reason::TouchedDown);
        check(
            &[start(), flown(1.0, |v| v.landed = Landed::OnGround)],
            Phase::Final,
            Reason::TouchedEarly,
        );
    }

    #[test]
    fn a_take_off_is_waited_for_in_silence() {
        let rising = |seconds| flown(seconds, |v| v.landed = Landed::TakingOff);
        let starting = Facts { operator: start().operator, ..rising(0.0) };
        check(&[starting, rising(0.1)], Phase::Search, Reason::TakingOff);
        check(&[starting, rising(30.0), at(31.0)], Phase::Search, Reason::Searching);
    }
}
