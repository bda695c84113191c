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
//!     Approach --> Hold: lost with its place, no progress
//!     Descend --> Hold: lost with its place, no progress
//!     Approach --> Aborted: no retry left
//!     Descend --> Aborted: no retry left
//!     Descend --> Final: a hand's breadth above the ground
//!     Hold --> Search: seen, resumed, vehicle heard again
//!     Hold --> Aborted: held too long
//!     Final --> Landed: disarmed
//!     Final --> Final: LAND refused close to the ground, down by setpoints
//!     Final --> Aborted: LAND refused, no touchdown, operator's abort while still high
//!     Landed --> [*]
//!     Aborted --> [*]
//! ```
//!
//! From every phase that is not terminal: the operator's abort and too long a landing lead to Aborted, the operator's hold to Hold
//! (not once the autopilot lands: then an abort takes it back to GUIDED, but not below `no_return_height_m`), a camera and
//! an autopilot that do not mean the same directions to Hold, a stale vehicle state to Hold (Final just waits), a mode that is neither GUIDED nor the
//! LAND we asked for to PilotInCommand, the ground to Final, disarmed motors to Landed or Aborted, an alarm to what is
//! configured for it. Idle, Landed, Aborted and PilotInCommand are terminal: only a new start leaves them.
//!
//! | phase | longest stay | then |
//! |---|---|---|
//! | Search | `search_timeout_s` | Hold |
//! | Approach, Descend | `approach_timeout_s`, `descend_timeout_s` | Hold |
//! | Retry | `retry_timeout_s`, and `retries` times | Search |
//! | Hold | `hold_timeout_s`, by the operator `operator_hold_timeout_s` | Aborted |
//! | Final | `land_timeout_s` until LAND, `touchdown_timeout_s` until the ground, both ways | Aborted, Landed |
//! | all together until LAND | `landing_timeout_s` | Aborted |

use crate::config::{AlarmAction, OnAbort, PhaseConfig};
use crate::decision::{Phase, Reason};
use crate::event::{Landed, Mode, OperatorCommand};
use crate::guidance::situation::Progress;
use crate::time::Timestamp;

/// A vehicle that could not settle climbs at least so long before it tries again, in seconds.
const RETRY_REST_S: f64 = 2.0;

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
    /// Why camera and autopilot do not mean the same directions; `None` while nothing shows it.
    pub disagreement: Option<Reason>,
    /// False while it is still looked whether they do.
    pub may_descend: bool,
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
    /// Height over the target, or over the local origin while no target is known, in metres.
    pub height_m: f64,
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
    /// The aborted vehicle is being taken back from LAND.
    recalls: bool,
    /// Retries of this landing so far.
    retries: u32,
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
            recalls: false,
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

    /// True while an aborted vehicle is being taken back from LAND.
    pub fn recalls(&self) -> bool {
        self.recalls
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
        self.recalls = phase == Phase::Aborted && self.landing && why == Reason::OperatorAbort;
        self.phase = phase;
        self.why = why;
        self.entered = now;
        self.landing = false;
    }

    /// After an abort, the first mode that is not ours ends our say.
    fn watch_release(&mut self, facts: &Facts) {
        let Some(vehicle) = facts.vehicle else { return };
        let in_time = !self.over(facts, self.config.land_timeout_s);
        self.recalls &= vehicle.mode == Mode::Land && in_time;
        self.released |= vehicle.mode != Mode::Guided && !self.recalls;
    }

    /// What ends or stops a landing in whatever phase it is.
    fn interruption(&self, facts: &Facts) -> Option<(Phase, Reason)> {
        if let Some(vehicle) = facts.vehicle {
            // PX4 leaves LAND as it stops the motors (seen with 1.17); that is no pilot's doing.
            if self.landing && !vehicle.armed {
                return Some(self.disarmed(vehicle));
            }
            let ours = vehicle.mode == Mode::Guided && !self.landing
                || vehicle.mode == Mode::Land && self.phase == Phase::Final;
            if !ours {
                return Some((Phase::PilotInCommand, Reason::PilotTookOver));
            }
            if !vehicle.armed {
                return Some(self.disarmed(vehicle));
            }
        }
        if facts.operator == Some(OperatorCommand::Abort) && self.can_abort(facts) {
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
                // Whoever holds for another reason goes on holding for that when the link is back.
                AlarmAction::Hold
                    if why == Reason::AutopilotLost
                        && self.phase == Phase::Hold
                        && self.why != Reason::VehicleStale => {}
                AlarmAction::Hold => return Some((Phase::Hold, why)),
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
        let moves =
            matches!(self.phase, Phase::Search | Phase::Approach | Phase::Descend | Phase::Retry);
        if let Some(why) = facts.disagreement.filter(|_| moves) {
            return Some((Phase::Hold, why));
        }
        let touched = facts.vehicle.is_some_and(|vehicle| vehicle.landed == Landed::OnGround);
        if touched && self.phase != Phase::Final {
            return Some((Phase::Final, Reason::TouchedEarly));
        }
        None
    }

    /// Once the autopilot lands, only a vehicle that is still high is taken back, and only to do something else.
    fn can_abort(&self, facts: &Facts) -> bool {
        let high =
            facts.vehicle.is_some_and(|vehicle| vehicle.height_m > self.config.no_return_height_m);
        !self.landing || high && self.config.on_abort != OnAbort::Land
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
            Progress::Descending if facts.may_descend => Some((Phase::Descend, Reason::Descending)),
            Progress::Descending | Progress::Aligning | Progress::Unchanged => self
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

    /// Another try while there is one left; a hold where the marker's place is not known either.
    fn again(&mut self, facts: &Facts, why: Reason) -> (Phase, Reason) {
        if !facts.target_known {
            return (Phase::Hold, Reason::TargetLost);
        }
        if self.retries >= self.config.retries {
            return (Phase::Aborted, Reason::RetriesUsed);
        }
        self.retries += 1;
        (Phase::Retry, why)
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
        let by_operator = matches!(
            self.why,
            Reason::OperatorHold
                | Reason::BatteryLow
                | Reason::BatteryCritical
                | Reason::OperatorLost
        );
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
            Reason::VehicleStale | Reason::AutopilotLost => !deaf,
            _ => false,
        };
        resumes.then_some((Phase::Search, Reason::Searching))
    }

    fn after_final(&mut self, facts: &Facts) -> Option<(Phase, Reason)> {
        if self.why == Reason::LandingBySetpoints {
            return self
                .over(facts, self.config.touchdown_timeout_s)
                .then_some((Phase::Aborted, Reason::LandRefused));
        }
        if !self.landing {
            // So close to the ground there is no other way: hovering there for good helps nobody.
            let low = matches!(
                self.why,
                Reason::LowAndAligned | Reason::LowAndUnseen | Reason::TouchedEarly
            );
            return self.over(facts, self.config.land_timeout_s).then_some(if low {
                (Phase::Final, Reason::LandingBySetpoints)
            } else {
                (Phase::Aborted, Reason::LandRefused)
            });
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
        height_m: 5.0,
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
            disagreement: None,
            may_descend: true,
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
        // An autopilot may leave LAND as it stops the motors.
        let left = flown(12.0, |v| (v.mode, v.armed) = (Mode::Guided, false));
        let [a, b, c, d, e, _] = all;
        check(&[a, b, c, d, e, left], Phase::Landed, Reason::TouchedDown);
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
        let refused = [approach[0], approach[1], ready, at(14.1), at(74.2)];
        check(&refused[..4], Phase::Final, Reason::LandingBySetpoints);
        check(&refused, Phase::Aborted, Reason::LandRefused);
        let alarm = Facts { alarm: Some((AlarmAction::Land, Reason::BatteryCritical)), ..at(1.0) };
        check(&[start(), alarm, at(6.1)], Phase::Aborted, Reason::LandRefused);
        let land = |seconds| flown(seconds, |v| v.mode = Mode::Land);
        check(
            &[approach[0], approach[1], ready, land(9.1), land(69.3)],
            Phase::Aborted,
            Reason::TouchdownOverdue,
        );
    }

    #[test]
    fn land_is_taken_back_while_it_is_high_and_not_below() {
        let ready = seen(9.0, Progress::Ready(Reason::LowAndAligned));
        let land = |seconds, height_m| {
            flown(seconds, move |v| (v.mode, v.height_m) = (Mode::Land, height_m))
        };
        let abort = |facts| Facts { operator: Some(OperatorCommand::Abort), ..facts };
        let way = [start(), seen(1.0, Progress::Unchanged), ready, land(9.2, 3.0)];
        let [a, b, c, d] = way;
        check(&[a, b, c, d, abort(land(9.3, 0.5))], Phase::Final, Reason::AutopilotLands);
        check(&[a, b, c, d, abort(land(9.3, 3.0))], Phase::Aborted, Reason::OperatorAbort);
        let after = |facts: &[Facts]| {
            let mut machine = Machine::new(PhaseConfig::default());
            way.iter().chain([&abort(land(9.3, 3.0))]).chain(facts).for_each(|facts| {
                machine.advance(facts);
            });
            (machine.recalls(), machine.is_released())
        };
        assert_eq!(after(&[]), (true, false));
        assert_eq!(after(&[land(9.4, 3.0)]), (true, false));
        assert_eq!(after(&[land(9.4, 3.0), at(9.6)]), (false, false), "it follows again");
        assert_eq!(after(&[land(15.0, 1.0)]), (false, true), "it did not come back");
        assert_eq!(after(&[flown(9.4, |v| v.mode = Mode::Other)]), (false, true));
        let landing = PhaseConfig { on_abort: OnAbort::Land, ..PhaseConfig::default() };
        let mut machine = Machine::new(landing);
        for facts in way.iter().chain([&abort(land(9.3, 3.0))]) {
            machine.advance(facts);
        }
        assert_eq!(machine.phase(), Phase::Final, "it lands already");
    }

    #[test]
    fn a_camera_that_disagrees_is_held_for_and_an_open_question_keeps_it_up() {
        let open = Facts { may_descend: false, ..seen(2.0, Progress::Descending) };
        check(&[start(), seen(1.0, Progress::Unchanged), open], Phase::Approach, Reason::Aligning);
        let turned = Facts { disagreement: Some(Reason::CameraTurned), ..open };
        let way = [start(), seen(1.0, Progress::Unchanged), turned, turned];
        check(&way, Phase::Hold, Reason::CameraTurned);
        check(&[way[0], way[1], way[2], at(63.0)], Phase::Aborted, Reason::HeldTooLong);
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

    mod every_way {
        //! Everything the machine can do: it is driven through every event of an alphabet from every state that it can be
        //! in, where two states count as the same when phase, reason, flags, retries and the timeouts already over agree.

        use super::*;
        use std::collections::hash_map::Entry;
        use std::collections::{HashMap, VecDeque};

        /// What tells two states apart.
        type Key = (Phase, Reason, bool, bool, bool, u32, [bool; 4], bool);

        const LONG_S: f64 = 1e6;

        fn config() -> PhaseConfig {
            PhaseConfig { retries: 2, on_battery_low: AlarmAction::Hold, ..PhaseConfig::default() }
        }

        fn now() -> Timestamp {
            Timestamp::from_seconds(LONG_S)
        }

        fn key(machine: &Machine) -> Key {
            let (config, elapsed_s) = (&machine.config, machine.elapsed_s(now()));
            let over = [
                elapsed_s > RETRY_REST_S,
                elapsed_s > config.retry_timeout_s,
                elapsed_s > config.search_timeout_s.min(config.hold_timeout_s),
                elapsed_s > config.descend_timeout_s.max(config.operator_hold_timeout_s),
            ];
            let late = now().seconds_since(machine.started) > config.landing_timeout_s;
            let terminal = machine.phase.is_terminal();
            // The time spent in a terminal phase does not matter.
            let (over, late) = if terminal { ([false; 4], false) } else { (over, late) };
            let released = machine.phase == Phase::Aborted && machine.released;
            let retries = if terminal { 0 } else { machine.retries };
            let recalls = machine.recalls;
            (machine.phase, machine.why, machine.landing, released, recalls, retries, over, late)
        }

        /// The same machine, so much later, with its moments moved so that it is always the same time.
        fn aged(machine: &Machine, seconds: f64) -> Machine {
            let earlier = |moment: Timestamp| {
                let age_s = (now().seconds_since(moment) + seconds).min(2000.0);
                now().plus_seconds(-age_s)
            };
            Machine {
                entered: earlier(machine.entered),
                started: earlier(machine.started),
                ..machine.clone()
            }
        }

        fn vehicles() -> Vec<Option<VehicleFacts>> {
            let change = |change: fn(&mut VehicleFacts)| {
                let mut vehicle = FLYING;
                change(&mut vehicle);
                Some(vehicle)
            };
            vec![
                None,
                Some(FLYING),
                change(|v| v.age_s = 1.0),
                change(|v| v.mode = Mode::Land),
                change(|v| (v.mode, v.altitude_m, v.height_m) = (Mode::Land, 0.4, 0.4)),
                change(|v| v.mode = Mode::Other),
                change(|v| v.armed = false),
                change(|v| (v.armed, v.landed) = (false, Landed::OnGround)),
                change(|v| (v.mode, v.armed, v.landed) = (Mode::Land, false, Landed::OnGround)),
                change(|v| v.landed = Landed::OnGround),
                change(|v| (v.mode, v.landed) = (Mode::Land, Landed::OnGround)),
                change(|v| v.landed = Landed::TakingOff),
            ]
        }

        fn alphabet() -> Vec<Facts> {
            let operators = [
                None,
                Some(OperatorCommand::Start),
                Some(OperatorCommand::Hold),
                Some(OperatorCommand::Resume),
                Some(OperatorCommand::Abort),
            ];
            let alarms = [
                None,
                Some((AlarmAction::Hold, Reason::BatteryLow)),
                Some((AlarmAction::Abort, Reason::OperatorLost)),
                Some((AlarmAction::Land, Reason::BatteryCritical)),
            ];
            let progresses = [
                Progress::Aligning,
                Progress::Descending,
                Progress::Blind,
                Progress::Stuck,
                Progress::Unchanged,
                Progress::Ready(Reason::LowAndAligned),
            ];
            let mut all = Vec::new();
            for vehicle in vehicles() {
                for operator in operators {
                    for alarm in alarms {
                        // A command and an alarm never come as one event.
                        if operator.is_some() && alarm.is_some() {
                            continue;
                        }
                        for progress in progresses {
                            for (target_age_s, target_known) in
                                [(0.1, true), (0.7, true), (5.0, true), (5.0, false)]
                            {
                                all.push(Facts {
                                    now: now(),
                                    operator,
                                    alarm,
                                    vehicle,
                                    target_age_s,
                                    target_confirmed: true,
                                    target_known,
                                    progress,
                                    disagreement: None,
                                    may_descend: true,
                                });
                            }
                        }
                    }
                }
            }
            let turned = Some(Reason::CameraTurned);
            all.push(Facts { disagreement: turned, may_descend: false, now: now(), ..at(0.0) });
            all
        }

        /// What holds for every single step.
        fn check_step(before: &Machine, facts: &Facts, after: &Machine) {
            let (from, to) = (before.phase, after.phase);
            let told = format!("{from} to {to} after {facts:?}");
            if from.is_terminal() {
                let started = facts.operator == Some(OperatorCommand::Start);
                assert!(from == to || started, "left by itself: {told}");
                return;
            }
            let vehicle = facts.vehicle;
            if vehicle.is_some_and(|v| v.mode == Mode::Other) {
                assert_eq!(to, Phase::PilotInCommand, "the pilot is not obeyed: {told}");
                return;
            }
            if to == Phase::Descend && from != Phase::Descend {
                let seen = facts.target_age_s <= before.config.lost_target_s;
                assert!(seen || facts.progress == Progress::Blind, "descends blindly: {told}");
                assert!(vehicle.is_some_and(|v| v.age_s < 0.5), "descends deaf: {told}");
            }
            if to == Phase::Landed {
                assert!(
                    vehicle.is_some_and(|v| !v.armed || v.landed == Landed::OnGround),
                    "{told}"
                );
            }
            if facts.operator == Some(OperatorCommand::Abort) {
                let lands = before.landing || vehicle.is_some_and(|v| v.mode == Mode::Land);
                let too_late = lands && vehicle.is_none_or(|v| v.height_m < 1.0);
                assert!(to.is_terminal() || too_late, "an abort is not obeyed: {told}");
            }
            assert!(after.retries <= before.config.retries, "too many retries: {told}");
        }

        #[test]
        fn no_way_through_the_machine_is_wrong_or_endless() {
            let alphabet = alphabet();
            let first = aged(&Machine::new(config()), 10.0);
            let mut found = HashMap::from([(key(&first), first.clone())]);
            let mut open = VecDeque::from([first]);
            let mut steps = 0u64;
            while let Some(machine) = open.pop_front() {
                for wait_s in [0.0, 3.0, 10.0, 65.0, 200.0, 400.0] {
                    let waited = aged(&machine, wait_s);
                    for facts in &alphabet {
                        let mut after = waited.clone();
                        after.advance(facts);
                        check_step(&waited, facts, &after);
                        steps += 1;
                        let key = key(&after);
                        if let Entry::Vacant(place) = found.entry(key) {
                            place.insert(after.clone());
                            open.push_back(after);
                        }
                    }
                }
            }
            for phase in [
                Phase::Idle,
                Phase::Search,
                Phase::Approach,
                Phase::Descend,
                Phase::Retry,
                Phase::Final,
                Phase::Landed,
                Phase::Hold,
                Phase::Aborted,
                Phase::PilotInCommand,
            ] {
                assert!(found.values().any(|m| m.phase == phase), "{phase} is never reached");
            }
            println!("{} states, {steps} steps", found.len());
            for machine in found.values() {
                assert!(ends(machine), "does not end: {machine:?}");
            }
        }

        /// Left alone with a vehicle that flies or lands as asked, whatever state it is in ends.
        fn ends(machine: &Machine) -> bool {
            let mut machine = machine.clone();
            for _ in 0..200 {
                if machine.phase.is_terminal() {
                    return true;
                }
                let mut vehicle = FLYING;
                if machine.landing {
                    vehicle.mode = Mode::Land;
                }
                machine = aged(&machine, 5.0);
                machine.advance(&Facts { vehicle: Some(vehicle), now: now(), ..at(0.0) });
            }
            false
        }
    }
}
