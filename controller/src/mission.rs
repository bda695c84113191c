//! The mission around a landing: waiting, take-off, the change of a PX4 to OFFBOARD, the triggers of the landing and obstacles to it,
//! and its end after the motors have stopped.

use autopilot::{
    Autopilot, Command, CommandId, CommandStatus, FlightMode, LandedState, OffboardExit, Takeoff,
    TakeoffError, TakeoffProgress,
};

use geometry::{Ned, Vector};
use landing::OperatorCommand;

use crate::config::Start;
use crate::control::{
    ControlProgress, TakingControl, hover_in_offboard, is_held_px4, is_holding_px4,
};

/// Time after the stop of the motors had ended a landing, in nanoseconds, within which motors that run again in our mode mean that it had
/// not ended: the autopilot's heartbeat may have been wrong. One that stands has landed.
const MAX_REARMED_NS: i64 = 10_000_000_000;

/// Time within which a landing that is to be resumed must begin, in nanoseconds: until then a PX4 is kept in OFFBOARD, where it drifts with
/// the error of its velocity.
const MAX_RESUMING_NS: i64 = 15_000_000_000;

/// What to do about a PX4 that waits in HOLD for its landing.
pub const START_FROM_HOLD: &str =
    "it does not follow setpoints there; `start` asks it to, and begins the landing";

/// The mission of a flight.
#[derive(Clone, Debug)]
pub struct Mission {
    start: Start,
    state: State,
    started_ns: Option<i64>,
    disarmed_ns: Option<i64>,
    /// Until when the landing that seemed to have ended continues.
    goes_on_until_ns: Option<i64>,
    /// The landing that was to go on is over: the next one begins once the vehicle flies.
    awaits_next_flight: bool,
    /// Since when the vehicle whose landing is to be resumed is known.
    found_ns: Option<i64>,
    /// Why the landing that was to begin automatically waits for a command.
    held_because: Option<String>,
    /// The operator's command to a landing that is to be resumed, for when it is.
    when_resumed: Option<OperatorCommand>,
}

/// The state of a mission.
#[derive(Clone, Debug)]
pub enum State {
    /// Waiting for the operator's command.
    Idle,
    /// Waiting until the vehicle flies in GUIDED.
    AwaitingTakeoff,
    /// From the ground into the air.
    TakingOff {
        /// The take-off.
        takeoff: Takeoff,
        /// It has taken off, and something keeps the landing from beginning.
        waits_in_air: bool,
        /// The reason for which it waits.
        why: String,
    },
    /// A PX4 that holds its place is asked for OFFBOARD.
    TakingControl {
        /// The change.
        control: TakingControl,
        /// The mission waited for the vehicle to fly, and does so again if the change fails.
        awaits_takeoff: bool,
    },
    /// A PX4 that may be in OFFBOARD, or in a LAND that is called back, is taken back to HOLD.
    LeavingOffboard {
        /// The way out.
        exit: OffboardExit,
        /// Why nothing steers it.
        why: String,
        /// As before.
        awaits_takeoff: bool,
    },
    /// A PX4 that holds its place is asked for LAND there.
    AskingForLand {
        /// The request.
        request: CommandId,
    },
    /// The lander decides.
    Landing,
    /// The autopilot's own precision landing decides; it gets the landing target.
    SendingLandingTarget,
    /// Nothing more happens without a command.
    Failed {
        /// The reason.
        why: String,
    },
}

/// Why a landing begins without a command.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Trigger {
    /// The vehicle was found in flight.
    InFlight,
    /// The motors of a vehicle that seemed to have landed run.
    ArmedAgain,
    /// The take-off is done.
    TakenOff,
    /// The vehicle follows setpoints, as was asked of it.
    InControl,
    /// The vehicle lands where it is, or follows setpoints, as was asked of it.
    LandsHere,
    /// The vehicle was found in LAND instead: the end of a landing that an earlier controller began.
    LandInsteadOfTakeoff,
}

/// The conditions for a landing to begin.
#[derive(Copy, Clone, Debug)]
pub struct Conditions<'a> {
    /// Attitude and position of the vehicle are as new as the lander requires.
    pub is_fresh: bool,
    /// Why no landing can begin now, such as a vehicle's state that is not fresh.
    pub obstacle: Option<&'a str>,
    /// Our setpoints control the landing.
    pub steers: bool,
    /// The velocity that leads a PX4 back to where it waits in OFFBOARD, in m/s.
    pub back: Vector<Ned>,
}

impl Mission {
    /// A mission that has not begun.
    pub fn new(start: Start, takeoff: Takeoff) -> Self {
        let state = match start {
            Start::Command => State::Idle,
            Start::Airborne | Start::Resume => State::AwaitingTakeoff,
            Start::Takeoff => State::TakingOff {
                takeoff,
                waits_in_air: false,
                why: "waiting for the autopilot's heartbeat".to_owned(),
            },
        };
        Self {
            start,
            state,
            started_ns: None,
            disarmed_ns: None,
            goes_on_until_ns: None,
            awaits_next_flight: false,
            found_ns: None,
            held_because: None,
            when_resumed: None,
        }
    }

    /// The state.
    pub fn state(&self) -> &State {
        &self.state
    }

    /// When the landing began.
    pub fn started_ns(&self) -> Option<i64> {
        self.started_ns
    }

    /// When the motors stopped after the landing.
    pub fn disarmed_ns(&self) -> Option<i64> {
        self.disarmed_ns
    }

    /// True while the vehicle takes off.
    pub fn is_taking_off(&self) -> bool {
        matches!(self.state, State::TakingOff { .. })
    }

    /// True while the vehicle has taken off, and something keeps the landing from beginning.
    pub fn waits_in_air(&self) -> bool {
        matches!(self.state, State::TakingOff { waits_in_air: true, .. })
    }

    /// True while a PX4 that holds its place is asked for OFFBOARD.
    pub fn is_taking_control(&self) -> bool {
        matches!(self.state, State::TakingControl { .. })
    }

    /// Puts off a take-off that has not begun, for this reason, which the status shows: nothing requests its motors, and its times do not advance. True
    /// where there is one.
    pub fn put_off(&mut self, now_ns: i64, autopilot: &mut Autopilot, reason: String) -> bool {
        let State::TakingOff { takeoff, why, .. } = &mut self.state else { return false };
        let is_put_off = takeoff.put_off(now_ns, autopilot);
        if is_put_off {
            *why = reason;
        }
        is_put_off
    }

    /// This process has not run for so long that nothing begins without a command. A take-off on the ground ends, as persons may be near
    /// the vehicle by now, and so does a change to OFFBOARD; a landing that was to begin automatically waits. One that `is_active` is held
    /// by the lander.
    pub fn stand_still(
        &mut self,
        now_ns: i64,
        autopilot: &mut Autopilot,
        seconds: f64,
        is_active: bool,
    ) {
        let stood_still = format!("the controller did not run for {seconds:.0} s");
        let is_armed = autopilot.state().is_some_and(|state| state.armed);
        let stands = autopilot.state().is_some_and(|it| it.landed == LandedState::OnGround);
        match &self.state {
            State::TakingOff { .. } if !is_armed => {
                self.fail(autopilot, format!("no take-off: {stood_still}"));
            }
            // Its state may be from before: one that was asked to rise may be in the air.
            State::TakingOff { .. } if stands => {
                let why = format!(
                    "no take-off: {stood_still}, and the motors ran: if it stands, disarm it; if it flies, `start` lands it"
                );
                self.fail(autopilot, why);
            }
            State::TakingOff { .. } | State::AwaitingTakeoff | State::LeavingOffboard { .. } => {
                self.hold(&stood_still);
            }
            State::TakingControl { .. } => {
                self.leave_offboard(now_ns, autopilot, &stood_still);
                self.hold(&stood_still);
            }
            // The next flight is landed automatically.
            State::Landing | State::SendingLandingTarget
                if !is_active && self.start == Start::Airborne =>
            {
                self.hold(&stood_still);
            }
            _ => return,
        }
        tracing::warn!("Nothing begins without a command: {stood_still}");
    }

    fn hold(&mut self, stood_still: &str) {
        self.held_because =
            Some(format!("{stood_still}: `resume` begins the landing that was to follow"));
    }

    /// Why the landing that was to begin automatically waits for a command; `None` if it does not.
    pub fn held_because(&self) -> Option<&str> {
        let is_ahead = self.is_taking_off() || self.is_awaiting_takeoff();
        self.held_because.as_deref().filter(|_| is_ahead)
    }

    /// The command for which such a landing waits; false where none does.
    pub fn resume(&mut self) -> bool {
        let is_held = self.held_because().is_some();
        if is_held {
            (self.held_because, self.found_ns) = (None, None);
        }
        let kept = self.when_resumed.take_if(|it| *it == OperatorCommand::Hold);
        is_held || kept.is_some() && self.is_resuming()
    }

    /// True while it is not known yet whether there is a landing to resume, or while one waits for that.
    pub fn is_resuming(&self) -> bool {
        self.start == Start::Resume && self.is_awaiting_takeoff()
    }

    /// True while a landing that is to be resumed waits, and no abort of it was given.
    pub fn waits_to_resume(&self) -> bool {
        self.is_resuming() && self.when_resumed != Some(OperatorCommand::Abort)
    }

    /// Keeps a command to the landing that is to be resumed. A hold does not replace an abort.
    pub fn command_when_resumed(&mut self, command: OperatorCommand) {
        if self.when_resumed != Some(OperatorCommand::Abort) {
            self.when_resumed = Some(command);
        }
    }

    /// The command that was kept.
    pub fn when_resumed(&self) -> Option<OperatorCommand> {
        self.when_resumed
    }

    /// Ends a landing that waits for a command before it began, for this reason: a PX4 is taken back to HOLD. False where none waits.
    pub fn cancel(&mut self, now_ns: i64, autopilot: &mut Autopilot, why: &str) -> bool {
        let waits = self.held_because().is_some() && !self.is_taking_off();
        if waits && !self.leave_offboard(now_ns, autopilot, why) && !self.is_over() {
            self.fail(autopilot, why.to_owned());
        }
        waits
    }

    fn is_over(&self) -> bool {
        matches!(self.state, State::Failed { .. })
    }

    /// Asks a PX4 that holds its place to follow setpoints. The landing begins once it does.
    pub fn take_control(&mut self, now_ns: i64, autopilot: &mut Autopilot) {
        let awaits_takeoff = self.is_awaiting_takeoff();
        (self.goes_on_until_ns, self.when_resumed) = (None, None);
        let control = TakingControl::begin(now_ns, autopilot);
        self.state = State::TakingControl { control, awaits_takeoff };
    }

    /// Asks a PX4 that holds its place to land there. The lander follows once it does.
    pub fn ask_for_land(&mut self, now_ns: i64, autopilot: &mut Autopilot) {
        self.goes_on_until_ns = None;
        self.awaits_next_flight = false;
        self.started_ns = None;
        let request = autopilot.request(now_ns, Command::SetMode(FlightMode::AUTO_LAND));
        self.state = State::AskingForLand { request };
    }

    /// True while a PX4 that holds its place is asked for LAND there.
    pub fn is_asking_for_land(&self) -> bool {
        matches!(self.state, State::AskingForLand { .. })
    }

    /// Advances the request for LAND. A change to OFFBOARD that was asked for before may be carried out in between.
    fn advance_land(
        &mut self,
        now_ns: i64,
        autopilot: &mut Autopilot,
        is_fresh: bool,
    ) -> Option<Trigger> {
        let State::AskingForLand { request } = self.state else { return None };
        hover_in_offboard(now_ns, Vector::zero(), autopilot);
        let state = autopilot.state()?;
        let end = match (state.armed, state.mode) {
            (false, _) => "the motors were stopped".to_owned(),
            (true, mode) if mode.is_landing() || mode.is_guided() => {
                return is_fresh.then_some(Trigger::LandsHere);
            }
            (true, FlightMode::AUTO_HOLD) => match autopilot.status(request) {
                CommandStatus::Failed(problem) => problem.to_string(),
                _ => return None,
            },
            (true, mode) => format!("the pilot took over, in {mode}"),
        };
        self.fail(autopilot, format!("not landed here: {end}"));
        None
    }

    /// True where a PX4 that is asked for LAND may have taken it, as the request was sent.
    pub fn may_be_in_land(&self, autopilot: &Autopilot) -> bool {
        self.land_sent_ns(autopilot, i64::MAX).is_some()
    }

    /// When LAND was asked for last, where a PX4 may have taken it; now, where it shows it.
    fn land_sent_ns(&self, autopilot: &Autopilot, now_ns: i64) -> Option<i64> {
        let State::AskingForLand { request } = self.state else { return None };
        autopilot.sent_ns(request).or(autopilot.is_in_auto_land().then_some(now_ns))
    }

    /// Gives up a request for LAND, for this reason: a PX4 that may have taken it is taken back to HOLD. True while that continues.
    pub fn call_back_land(&mut self, now_ns: i64, autopilot: &mut Autopilot, why: &str) -> bool {
        let Some(sent_ns) = self.land_sent_ns(autopilot, now_ns) else {
            self.fail(autopilot, why.to_owned());
            return false;
        };
        let exit = OffboardExit::begin_out_of_land(now_ns, sent_ns, autopilot);
        let why =
            format!("{why}; a LAND that the vehicle has taken already is called back to HOLD");
        self.state = State::LeavingOffboard { exit, why, awaits_takeoff: false };
        self.advance_exit(now_ns, autopilot)
    }

    /// A LAND that is called back continues, as the vehicle is too low to be held there.
    pub fn leave_in_land(&mut self, autopilot: &mut Autopilot) {
        if autopilot.is_in_auto_land()
            && let State::LeavingOffboard { .. } = self.state
        {
            let why = "ended by the operator, too low for it: the LAND that the vehicle has taken continues; the pilot's mode switch stops it";
            self.fail(autopilot, why.to_owned());
        }
    }

    /// Why a PX4 that may be in OFFBOARD is taken back to HOLD; `None` when it is not.
    pub fn leaves_offboard_because(&self) -> Option<&str> {
        match &self.state {
            State::LeavingOffboard { why, .. } => Some(why),
            _ => None,
        }
    }

    /// Gives up a take-off or a change to OFFBOARD, for this reason, where a PX4 may be in OFFBOARD before a landing, or change to
    /// it; true while the way out continues.
    pub fn leave_offboard(&mut self, now_ns: i64, autopilot: &mut Autopilot, why: &str) -> bool {
        let may_be_in_it = autopilot.is_requesting_offboard()
            || autopilot.is_in_offboard()
            || autopilot.may_return_to_offboard(now_ns);
        match &self.state {
            State::TakingControl { .. } => {
                let why = format!("the landing did not begin: {why}");
                self.begin_exit(now_ns, autopilot, why);
            }
            State::TakingOff { .. } if may_be_in_it => {
                self.begin_exit(now_ns, autopilot, why.to_owned());
            }
            // Kept there by our zeros.
            State::AwaitingTakeoff if may_be_in_it && self.start == Start::Resume => {
                self.begin_exit(now_ns, autopilot, why.to_owned());
            }
            _ => {}
        }
        self.advance_exit(now_ns, autopilot)
    }

    fn begin_exit(&mut self, now_ns: i64, autopilot: &mut Autopilot, why: String) {
        tracing::warn!(why, "Back to HOLD, if the vehicle changes to OFFBOARD");
        let awaits_takeoff =
            matches!(self.state, State::TakingControl { awaits_takeoff: true, .. });
        let exit = OffboardExit::begin(now_ns, autopilot);
        self.state = State::LeavingOffboard { exit, why, awaits_takeoff };
    }

    /// Advances the way out of OFFBOARD; true while it continues.
    fn advance_exit(&mut self, now_ns: i64, autopilot: &mut Autopilot) -> bool {
        let State::LeavingOffboard { exit, why, awaits_takeoff } = &mut self.state else {
            return false;
        };
        if exit.step(now_ns, autopilot) {
            return true;
        }
        // In OFFBOARD still, the landing that was given up would begin automatically.
        let is_armed = autopilot.state().is_some_and(|state| state.armed);
        let is_out = !autopilot.is_in_offboard();
        let (mut why, awaits_takeoff) = (std::mem::take(why), *awaits_takeoff && is_out);
        if is_armed && autopilot.is_in_auto_land() {
            why.push_str(", and it stays in LAND all the same: the pilot's mode switch stops it");
        } else if is_armed && !is_out {
            why.push_str(
                ", and it stays in OFFBOARD all the same: the pilot's mode switch ends that",
            );
        } else if is_holding_px4(autopilot) {
            why.push_str("; it is in HOLD");
        }
        self.fail(autopilot, why);
        if awaits_takeoff {
            self.stand_down(true);
        }
        false
    }

    /// True while a landing begins automatically once the vehicle flies.
    pub fn is_awaiting_takeoff(&self) -> bool {
        matches!(self.state, State::AwaitingTakeoff) || self.awaits_next_flight
    }

    /// True once the lander decides.
    pub fn is_landing(&self) -> bool {
        matches!(self.state, State::Landing)
    }

    /// True once the autopilot's own precision landing decides.
    pub fn is_sending_landing_target(&self) -> bool {
        matches!(self.state, State::SendingLandingTarget)
    }

    /// A landing begins: the lander's, or the autopilot's own.
    pub fn begin(&mut self, now_ns: i64, is_autopilots: bool) {
        self.started_ns = Some(now_ns);
        (self.held_because, self.when_resumed) = (None, None);
        self.disarmed_ns = None;
        self.goes_on_until_ns = None;
        self.awaits_next_flight = false;
        self.state = if is_autopilots { State::SendingLandingTarget } else { State::Landing };
    }

    /// The landing that was to begin does not: back to waiting, for the vehicle to fly or for a command.
    pub fn stand_down(&mut self, awaits_takeoff: bool) {
        self.started_ns = None;
        self.state = if awaits_takeoff { State::AwaitingTakeoff } else { State::Idle };
    }

    /// There is no landing to follow, for this reason: the pilot landed high up or had landed already. Where only a landing under way was
    /// to be resumed, nothing begins without a command any more; otherwise the next flight may be landed. An abort that was `kept` ends the
    /// mission, so that the status has it.
    pub fn skip(&mut self, autopilot: &mut Autopilot, kept: Option<OperatorCommand>, why: &str) {
        if let Some(command) = kept {
            tracing::warn!(?command, "No landing was resumed that could follow the command: {why}");
        }
        match kept {
            Some(OperatorCommand::Abort) => {
                let why = format!("aborted by the operator; no landing was resumed: {why}");
                // The vehicle stays the pilot's, or another controller's.
                self.started_ns = None;
                self.fail(autopilot, why);
            }
            _ => self.stand_down(self.start != Start::Resume),
        }
    }

    /// The landing that was to go on had ended: the vehicle stands with its motors armed. It stays landed until it
    /// flies; `airborne` lands that flight too.
    pub fn stay_landed(&mut self) {
        self.awaits_next_flight = self.start == Start::Airborne;
    }

    /// After a landing: `airborne` lands flight after flight.
    fn await_next_flight(&mut self) {
        if self.start == Start::Airborne {
            self.stand_down(true);
        }
    }

    /// Ends the mission: nothing is sent any more, and no pending command is repeated.
    pub fn fail(&mut self, autopilot: &mut Autopilot, why: String) {
        autopilot.withdraw();
        self.goes_on_until_ns = None;
        self.awaits_next_flight = false;
        self.state = State::Failed { why };
    }

    /// Advances take-off and waiting; the trigger when a landing is to begin.
    pub fn step(
        &mut self,
        now_ns: i64,
        autopilot: &mut Autopilot,
        conditions: Conditions<'_>,
    ) -> Option<Trigger> {
        let Conditions { is_fresh, obstacle, steers, back } = conditions;
        let is_known = obstacle.is_none();
        if let Some(until_ns) = self.goes_on_until_ns {
            let armed = autopilot.state().filter(|state| state.armed);
            let is_pilots = armed.is_some_and(|s| !s.mode.is_guided() && !s.mode.is_landing());
            let stands = armed.is_some_and(|state| state.landed == LandedState::OnGround);
            if is_pilots || now_ns > until_ns && is_known {
                self.goes_on_until_ns = None;
                self.await_next_flight();
            } else if stands {
                self.goes_on_until_ns = None;
                self.stay_landed();
            } else if armed.is_some() && is_known && steers {
                return Some(Trigger::ArmedAgain);
            }
        }
        let lands = autopilot.state().is_some_and(|state| {
            state.armed && state.mode.is_landing() && state.landed.is_flying()
        });
        let is_flying = is_known && (is_flying_guided(autopilot) || lands && steers);
        match &mut self.state {
            State::Landing if self.awaits_next_flight && is_flying => Some(Trigger::InFlight),
            State::AwaitingTakeoff => {
                if is_flying {
                    return Some(Trigger::InFlight);
                }
                if self.start == Start::Resume {
                    self.await_landing(now_ns, autopilot, back);
                }
                None
            }
            State::TakingOff { takeoff, waits_in_air, why } => {
                match takeoff.step(now_ns, autopilot) {
                    end @ (TakeoffProgress::Done
                    | TakeoffProgress::Failed(TakeoffError::PilotInCommand {
                        mode: FlightMode::Land | FlightMode::AUTO_LAND,
                        ..
                    })) => {
                        let of_mode = why_not_followed(now_ns, autopilot);
                        let obstacle = match obstacle {
                            Some(obstacle) if !is_held_px4(now_ns, autopilot) => Some(obstacle),
                            _ => of_mode.as_deref(),
                        };
                        if let Some(obstacle) = obstacle {
                            *waits_in_air = true;
                            obstacle.clone_into(why);
                            hover_in_offboard(now_ns, back, autopilot);
                            if let Some(end) = end_of_waiting(autopilot) {
                                let why = format!("{end} while the landing waited: {obstacle}");
                                tracing::error!("No landing after the take-off: {why}");
                                self.fail(autopilot, why);
                            }
                            return None;
                        }
                        Some(match end {
                            TakeoffProgress::Done => Trigger::TakenOff,
                            _ => Trigger::LandInsteadOfTakeoff,
                        })
                    }
                    TakeoffProgress::Failed(problem) => {
                        tracing::error!(%problem, "Take-off failed");
                        self.fail(autopilot, problem.to_string());
                        None
                    }
                    progress => {
                        *why = match progress {
                            TakeoffProgress::Waiting(reasons) => reasons.join("; "),
                            progress => progress.to_string(),
                        };
                        None
                    }
                }
            }
            State::TakingControl { .. } => self.advance_control(now_ns, autopilot, is_fresh),
            State::AskingForLand { .. } => self.advance_land(now_ns, autopilot, is_fresh),
            State::LeavingOffboard { .. } => {
                self.advance_exit(now_ns, autopilot);
                None
            }
            State::Idle | State::Landing | State::SendingLandingTarget | State::Failed { .. } => {
                None
            }
        }
    }

    /// Ends the wait for a landing to resume where there is none. A PX4 gets setpoints for a while: it has stopped in HOLD as the earlier
    /// controller ended, returns to OFFBOARD with them, and stays in it until the landing begins. While that waits for a command they
    /// continue: the failsafe for missing setpoints could not be distinguished from a pilot's choice later.
    fn await_landing(&mut self, now_ns: i64, autopilot: &mut Autopilot, back: Vector<Ned>) {
        if autopilot.state().is_none() {
            return;
        }
        let found_ns = *self.found_ns.get_or_insert(now_ns);
        let may_return = autopilot.may_return_to_offboard(now_ns);
        let is_in_time = now_ns.saturating_sub(found_ns) <= MAX_RESUMING_NS;
        if is_in_time || self.held_because.is_some() {
            hover_in_offboard(now_ns, back, autopilot);
        }
        if let Some(why) = no_landing_because(autopilot).filter(|_| !may_return) {
            let kept = self.when_resumed.take();
            self.skip(autopilot, kept, &why);
        }
    }

    /// Advances a change to OFFBOARD. Whatever is seen of markers then, the lander holds or searches.
    fn advance_control(
        &mut self,
        now_ns: i64,
        autopilot: &mut Autopilot,
        is_fresh: bool,
    ) -> Option<Trigger> {
        let State::TakingControl { control, .. } = &mut self.state else { return None };
        match control.step(now_ns, autopilot) {
            ControlProgress::InControl => is_fresh.then_some(Trigger::InControl),
            ControlProgress::Waiting => None,
            ControlProgress::GivenUp(why) => {
                self.leave_offboard(now_ns, autopilot, &why);
                None
            }
        }
    }

    /// The motors were armed or disarmed; `is_finished`: the landing had ended; `by_motors`: their stop had ended it.
    pub fn armed_changed(&mut self, now_ns: i64, armed: bool, is_finished: bool, by_motors: bool) {
        if !armed && self.started_ns.is_some() {
            self.disarmed_ns = self.disarmed_ns.or(Some(now_ns));
        }
        // Only `airborne` lands flight after flight; others wait for a command once the pilot has ended the
        // flight. `resume` believes that only of a vehicle that does not fly.
        let is_believed = !matches!(self.start, Start::Airborne | Start::Resume);
        if !armed && is_believed && self.is_awaiting_takeoff() {
            self.state = State::Idle;
        }
        let is_over = is_finished && !matches!(self.state, State::Failed { .. });
        if armed && is_over {
            let until_ns = self.disarmed_ns.map(|at_ns| at_ns.saturating_add(MAX_REARMED_NS));
            self.goes_on_until_ns = until_ns.filter(|until_ns| by_motors && now_ns <= *until_ns);
            if self.goes_on_until_ns.is_none() {
                self.await_next_flight();
            }
        }
    }
}

/// What happens to a landing by this command; `None` for one that only a landing under way can follow.
pub fn what_happens(command: OperatorCommand) -> Option<&'static str> {
    match command {
        OperatorCommand::Abort => Some("aborted"),
        OperatorCommand::Hold => Some("held"),
        _ => None,
    }
}

/// True when the vehicle flies in the mode that follows setpoints.
pub fn is_flying_guided(autopilot: &Autopilot) -> bool {
    autopilot.state().is_some_and(|s| s.armed && s.mode.is_guided() && s.landed.is_flying())
}

/// The end of the wait of a vehicle that took off for its landing: motors that are off, or a pilot. A PX4 that holds its position does
/// not end it, as it does so automatically where setpoints are late: from there the landing begins by command.
fn end_of_waiting(autopilot: &Autopilot) -> Option<String> {
    let state = autopilot.state().filter(|state| state.connected)?;
    let is_ours = state.mode.is_guided() || state.mode.is_landing() || is_holding_px4(autopilot);
    match (state.armed, is_ours) {
        (false, _) => Some("the motors were stopped".to_owned()),
        (true, false) => Some(format!("the pilot took over, in {},", state.mode)),
        (true, true) => None,
    }
}

/// Why a vehicle that took off cannot be landed in its mode now; `None` where it follows setpoints, or lands.
fn why_not_followed(now_ns: i64, autopilot: &Autopilot) -> Option<String> {
    let mode = autopilot.state()?.mode;
    if mode.is_guided() || mode.is_landing() {
        return None;
    }
    Some(match is_held_px4(now_ns, autopilot) {
        true => format!("the vehicle is in {mode}: {START_FROM_HOLD}"),
        false => format!("waiting until the vehicle follows setpoints, in {mode} now"),
    })
}

/// Why there is no landing to resume: it has ended, though the motors may still run, or the pilot flies; `None` where there may be one. A
/// vehicle with motors reported as off, but not reported to stand, may fly all the same.
fn no_landing_because(autopilot: &Autopilot) -> Option<String> {
    let state = autopilot.state()?;
    let motors = if state.armed { ", and its motors run: disarm it" } else { "" };
    if state.landed == LandedState::OnGround {
        return Some(format!(
            "the autopilot reports that the vehicle stands on the ground{motors}"
        ));
    }
    let is_pilots = !state.mode.is_guided() && !state.mode.is_landing();
    is_pilots.then(|| format!("the vehicle is in {}", state.mode))
}
