//! The take-off, step by step with time limits: retries of arming, the reasons of a refusal, real vehicles only where they are
//! allowed. ArduPilot: wait until ready, GUIDED, arm, climb. PX4: wait until ready, arm, climb in its own takeoff mode,
//! OFFBOARD.

use std::fmt;
use std::time::Duration;

use libm::fmax;

use crate::client::Autopilot;
use crate::command::{Command, CommandError, CommandId, CommandStatus, ns};
use crate::conflict::{Conflict, LISTENING};
use crate::mode::{Firmware, FlightMode};
use crate::standstill::MIN_STANDSTILL_NS;
use crate::state::{LandedState, Position, VehicleState};

/// Maximum height error at the end of the climb, in m.
const MAX_HEIGHT_ERROR_M: f64 = 0.5;
/// Maximum vertical speed at the end of the climb, in m/s.
const MAX_CLIMB_M_S: f64 = 0.3;
/// How far below its height PX4 ends its climb automatically, in m, at most: it is there within 0.8 m (`NAV_MC_ALT_RAD`), and heights err.
const MAX_MISSING_M: f64 = 1.5;
/// Maximum age of a position that shows at which height PX4 has ended its climb, in nanoseconds.
const MAX_POSITION_AGE_NS: i64 = 500_000_000;
/// Pause between two attempts to arm.
const ARM_RETRY: Duration = Duration::from_secs(2);
/// Time within which a simulated vehicle reports that it is one.
const SIMULATION_LIMIT: Duration = Duration::from_secs(10);

/// Timeouts of the parts of a takeoff.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Until the autopilot is connected and ready; ArduPilot needs about 42 s after power-on.
    pub ready: Duration,
    /// Until arming succeeds, with all its attempts.
    pub arm: Duration,
    /// Until it flies at its height, for each 10 m of it.
    pub climb_10_m: Duration,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            ready: Duration::from_secs(120),
            arm: Duration::from_secs(30),
            climb_10_m: Duration::from_secs(30),
        }
    }
}

/// A takeoff: call [`Takeoff::step`] after each packet or each tick until it is finished.
#[derive(Clone, Debug)]
pub struct Takeoff {
    height_m: f64,
    limits: Limits,
    part: Part,
    /// The timeout of the current part.
    until_ns: Option<i64>,
    /// The vertical position before the climb, in m downwards from the origin.
    ground_z: Option<f64>,
    guided: bool,
    /// PX4 has shown its own takeoff mode.
    has_lifted: bool,
    /// It has reached its height.
    risen: bool,
    /// Its motors were armed before the first request.
    found_armed: bool,
    /// Only a vehicle that reports that it is a simulation is flown.
    only_simulated: bool,
    /// It would be armed, but a heartbeat of another vehicle on the link may still be due.
    is_listening: bool,
    /// The timeout of that question.
    simulation_until_ns: Option<i64>,
    /// When it was stepped, or put off, last.
    stepped_ns: Option<i64>,
}

/// The progress of a takeoff.
#[derive(Clone, Debug, PartialEq)]
pub enum TakeoffProgress {
    /// The vehicle is not ready, for these reasons.
    Waiting(Vec<String>),
    /// GUIDED or OFFBOARD is requested.
    ChangingMode,
    /// Arming; a number of attempts was refused, the last one for a reason.
    Arming {
        /// Why the last attempt failed, if one did.
        refused: Option<String>,
    },
    /// Climbing.
    Climbing {
        /// The height in m above the ground.
        height_m: f64,
    },
    /// It flies in GUIDED or OFFBOARD: setpoints may be sent.
    Done,
    /// It ended; no more is sent.
    Failed(TakeoffError),
}

/// Why a takeoff ended before it was done.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum TakeoffError {
    /// The pilot flies, or has taken over.
    #[error(
        "no takeoff: the vehicle is {landed} in {mode}, so the pilot is in command; change to GUIDED to hand over (a PX4: to HOLD, and start the landing by command)"
    )]
    PilotInCommand {
        /// The pilot's mode.
        mode: FlightMode,
        /// Contact with the ground.
        landed: LandedState,
    },
    /// The vehicle may be a real one, which was not allowed.
    #[error(
        "no takeoff: within {} s the vehicle did not report that it is a simulation (no SIM_STATE, SIMSTATE or \
         HIL_STATE_QUATERNION, and no HIL flag in its heartbeat), so it may be a real one. Check the address of \
         the autopilot; `alight land --real-vehicle` (`takeoff_real_vehicle = true` of the controller) starts \
         the motors of any vehicle",
        SIMULATION_LIMIT.as_secs()
    )]
    NotSimulated,
    /// Another controller commands the vehicle, or it may be another vehicle.
    #[error("no takeoff: {0}")]
    Conflict(Conflict),
    /// It did not become ready.
    #[error("no takeoff: not ready after {} s: {}", after.as_secs(), reasons.join("; "))]
    NotReady {
        /// Time waited.
        after: Duration,
        /// The missing conditions.
        reasons: Vec<String>,
    },
    /// A command failed.
    #[error("no takeoff: {0}")]
    Command(#[from] CommandError),
    /// The heartbeat was lost.
    #[error("takeoff interrupted: the autopilot's heartbeat is lost")]
    Lost,
    /// The motors were disarmed.
    #[error("takeoff ended: the autopilot or the pilot disarmed the motors")]
    Disarmed,
    /// The climb took too long.
    #[error("takeoff not finished after {} s: {height_m:.1} m of {wanted_m:.1} m, {landed}", after.as_secs())]
    TooSlow {
        /// Time of the climb.
        after: Duration,
        /// The height reached in m.
        height_m: f64,
        /// The requested height in m.
        wanted_m: f64,
        /// Contact with the ground.
        landed: LandedState,
    },
}

#[derive(Clone, Debug)]
enum Part {
    Ready,
    Mode(CommandId),
    Arm(Arming),
    Lift(CommandId),
    Climb,
    Done,
    Failed(TakeoffError),
}

/// Attempts to arm.
#[derive(Clone, Debug)]
struct Arming {
    /// The mode in which it began.
    mode: Option<FlightMode>,
    request: Option<CommandId>,
    /// It was requested, if not now: motors that run may be ours.
    was_asked: bool,
    retry_ns: i64,
    refused: Option<CommandError>,
}

impl Takeoff {
    /// A takeoff to this height in m above the ground.
    pub fn new(height_m: f64) -> Self {
        Self::with_limits(height_m, Limits::default())
    }

    /// The same with other time limits.
    pub fn with_limits(height_m: f64, limits: Limits) -> Self {
        Self {
            height_m,
            limits,
            part: Part::Ready,
            until_ns: None,
            ground_z: None,
            guided: false,
            has_lifted: false,
            risen: false,
            found_armed: false,
            only_simulated: false,
            is_listening: false,
            simulation_until_ns: None,
            stepped_ns: None,
        }
    }

    /// The same, with or without real vehicles: without them one that does not report that it is a simulation is not
    /// armed, moved or landed.
    #[must_use]
    pub fn of_real_vehicle(self, may_be_real: bool) -> Self {
        Self { only_simulated: !may_be_real, ..self }
    }

    /// Advances the takeoff and returns its progress.
    ///
    /// A vehicle that already flies in GUIDED is done at once; one that flies in another mode is left alone.
    /// One that stands with armed motors is left on the ground: it may have landed a moment ago.
    pub fn step(&mut self, now_ns: i64, autopilot: &mut Autopilot) -> TakeoffProgress {
        let passed_ns = self.passed_ns(now_ns);
        if passed_ns > MIN_STANDSTILL_NS {
            // This process stood still: the vehicle went on, and its packets of that time have not been read. The limits of a process that is
            // always slow end all the same.
            self.move_limits(passed_ns - MIN_STANDSTILL_NS);
        }
        if let Err(error) = self.advance(now_ns, autopilot) {
            autopilot.withdraw();
            self.part = Part::Failed(error);
        }
        self.progress(autopilot)
    }

    /// Puts it off, instead of a step, while a reason other than the vehicle prevents its beginning: its timers are stopped, and the motors
    /// are not requested to start. False where it has begun, as the motors run, and where no vehicle is known: then it must be stepped.
    pub fn put_off(&mut self, now_ns: i64, autopilot: &mut Autopilot) -> bool {
        let Some(state) = autopilot.state() else { return false };
        // An arming that was withdrawn may be carried out all the same.
        let is_ours = matches!(&self.part, Part::Arm(it) if it.was_asked || it.request.is_some());
        let stands = is_ours && state.landed == LandedState::OnGround;
        if self.is_finished() || state.armed && !stands {
            return false;
        }
        let passed_ns = self.passed_ns(now_ns);
        self.move_limits(passed_ns);
        if let Part::Arm(arming) = &mut self.part {
            if arming.request.take().is_some() {
                autopilot.withdraw();
                arming.was_asked = true;
            }
            arming.retry_ns = now_ns;
        }
        true
    }

    /// The time since it was stepped, or put off, last, in nanoseconds.
    fn passed_ns(&mut self, now_ns: i64) -> i64 {
        self.stepped_ns.replace(now_ns).map_or(0, |last_ns| now_ns.saturating_sub(last_ns))
    }

    /// Moves the time limits on, by time that does not count.
    fn move_limits(&mut self, by_ns: i64) {
        for until_ns in self.until_ns.iter_mut().chain(&mut self.simulation_until_ns) {
            *until_ns = until_ns.saturating_add(by_ns);
        }
    }

    /// True when it is done or has failed.
    pub fn is_finished(&self) -> bool {
        matches!(self.part, Part::Done | Part::Failed(_))
    }

    fn advance(&mut self, now_ns: i64, autopilot: &mut Autopilot) -> Result<(), TakeoffError> {
        if self.is_finished() {
            return Ok(());
        }
        if let (Part::Ready, Some(conflict)) = (&self.part, autopilot.conflict(now_ns)) {
            return Err(TakeoffError::Conflict(conflict));
        }
        let state = autopilot.state().copied();
        if let Some(state) = &state {
            self.check_pilot(now_ns, state)?;
        }
        match self.part.clone() {
            Part::Ready => self.wait_until_ready(now_ns, autopilot, state.as_ref()),
            Part::Mode(request) => self.wait_for_mode(now_ns, autopilot, request),
            Part::Arm(arming) => self.arm(now_ns, autopilot, arming),
            Part::Lift(request) => self.wait_for_lift(now_ns, autopilot, request),
            Part::Climb => self.climb(now_ns, autopilot, state.as_ref()),
            Part::Done | Part::Failed(_) => Ok(()),
        }
    }

    /// The pilot's mode change wins at once, and so does a vehicle armed by the pilot.
    fn check_pilot(&mut self, now_ns: i64, state: &VehicleState) -> Result<(), TakeoffError> {
        let waiting = matches!(self.part, Part::Ready);
        if !state.connected {
            return if waiting { Ok(()) } else { Err(TakeoffError::Lost) };
        }
        // PX4 passes through modes of its own from the command to rise on; before it, while it is armed, they are the pilot's.
        let may_rise = !matches!(self.part, Part::Ready | Part::Arm(_));
        self.has_lifted |= may_rise && state.mode == FlightMode::AUTO_TAKEOFF;
        let rises = may_rise
            && match state.mode {
                FlightMode::AUTO_TAKEOFF => true,
                FlightMode::AUTO_HOLD => !self.is_held_by_pilot(now_ns, state),
                _ => false,
            };
        let guided = state.mode.is_guided() || rises;
        self.guided |= guided;
        let taken = match &self.part {
            Part::Ready => state.armed,
            // PX4 is armed in the pilot's own mode.
            Part::Arm(arming) => {
                // It leaves LAND automatically once it stands.
                let is_changed = arming.mode.is_some_and(|mode| {
                    let leaves_land = mode.is_landing() && state.mode == FlightMode::AUTO_HOLD;
                    mode != state.mode && !leaves_land
                });
                let is_ours = arming.request.is_some() || arming.was_asked;
                self.guided || is_changed || state.armed && !is_ours
            }
            _ => self.guided,
        };
        if taken && !guided {
            let (mode, landed) = (state.mode, state.landed);
            return Err(TakeoffError::PilotInCommand { mode, landed });
        }
        if matches!(self.part, Part::Lift(_) | Part::Climb) && !state.armed {
            return Err(TakeoffError::Disarmed);
        }
        Ok(())
    }

    /// Whether a pilot has ended PX4's climb in HOLD: it does so itself only at its height. Where that is not known it is the pilot. An old
    /// position decides nothing: after a standstill or a loss of the link the mode may be received first.
    fn is_held_by_pilot(&self, now_ns: i64, state: &VehicleState) -> bool {
        if is_position_old(now_ns, state) {
            return false;
        }
        let climbs = matches!(self.part, Part::Lift(_) | Part::Climb);
        let is_low = self.height(state) < self.height_m - MAX_MISSING_M;
        climbs && self.has_lifted && (is_low || self.ground_z.is_none())
    }

    fn wait_until_ready(
        &mut self,
        now_ns: i64,
        autopilot: &mut Autopilot,
        state: Option<&VehicleState>,
    ) -> Result<(), TakeoffError> {
        let connected = state.filter(|state| state.connected);
        if connected.is_some() && !self.may_be_flown(now_ns, autopilot)? {
            return Ok(());
        }
        match connected {
            Some(state) if state.armed && state.landed == LandedState::InAir => {
                self.part = Part::Done;
            }
            Some(state) if state.armed && state.landed == LandedState::TakingOff => {
                self.begin(now_ns, Part::Climb, self.climb_limit());
            }
            Some(state) if self.found_armed && !state.armed => return Err(TakeoffError::Disarmed),
            Some(state)
                if state.ready
                    && !state.armed
                    && state.landed == LandedState::OnGround
                    && autopilot.has_listened(now_ns) =>
            {
                if autopilot.firmware() == Some(Firmware::Px4) {
                    self.begin_arming(now_ns, autopilot);
                } else {
                    let request = autopilot.request(now_ns, Command::SetMode(FlightMode::Guided));
                    self.begin(now_ns, Part::Mode(request), self.limits.ready);
                }
            }
            _ => {
                self.is_listening = !autopilot.has_listened(now_ns);
                self.found_armed |= connected
                    .is_some_and(|state| state.armed && state.landed == LandedState::OnGround);
                let until_ns =
                    *self.until_ns.get_or_insert(now_ns.saturating_add(ns(self.limits.ready)));
                if now_ns >= until_ns {
                    let reasons = reasons(autopilot);
                    return Err(TakeoffError::NotReady { after: self.limits.ready, reasons });
                }
            }
        }
        Ok(())
    }

    /// Whether it may be flown as far as it is known: any vehicle, or one that reports that it is a simulation.
    fn may_be_flown(
        &mut self,
        now_ns: i64,
        autopilot: &mut Autopilot,
    ) -> Result<bool, TakeoffError> {
        if !self.only_simulated || autopilot.is_simulated() {
            return Ok(true);
        }
        autopilot.ask_whether_simulated(now_ns);
        let limit_ns = now_ns.saturating_add(ns(SIMULATION_LIMIT));
        if now_ns >= *self.simulation_until_ns.get_or_insert(limit_ns) {
            return Err(TakeoffError::NotSimulated);
        }
        Ok(false)
    }

    fn wait_for_mode(
        &mut self,
        now_ns: i64,
        autopilot: &mut Autopilot,
        request: CommandId,
    ) -> Result<(), TakeoffError> {
        if finished(autopilot, request)? {
            if self.risen {
                self.part = Part::Done;
            } else {
                self.begin_arming(now_ns, autopilot);
            }
        }
        Ok(())
    }

    fn begin_arming(&mut self, now_ns: i64, autopilot: &Autopilot) {
        let mode = autopilot.state().map(|state| state.mode);
        let arming =
            Arming { mode, request: None, was_asked: false, retry_ns: now_ns, refused: None };
        self.begin(now_ns, Part::Arm(arming), self.limits.arm);
    }

    fn arm(
        &mut self,
        now_ns: i64,
        autopilot: &mut Autopilot,
        arming: Arming,
    ) -> Result<(), TakeoffError> {
        let Some(id) = arming.request else {
            if now_ns >= arming.retry_ns {
                let request = Some(autopilot.request(now_ns, Command::Arm));
                self.part = Part::Arm(Arming { request, ..arming });
            }
            return Ok(());
        };
        match finished(autopilot, id) {
            Ok(false) => {}
            Ok(true) => {
                let height_m = self.height_m;
                self.ground_z = autopilot.state().and_then(|s| s.position).map(|p| p.position.z());
                let request = autopilot.request(now_ns, Command::Takeoff { height_m });
                self.begin(now_ns, Part::Lift(request), self.climb_limit());
            }
            // Shortly after power-on, checks may alternately pass and fail.
            Err(error @ CommandError::Refused { .. })
                if self.until_ns.is_some_and(|until_ns| now_ns < until_ns) =>
            {
                let retry_ns = now_ns.saturating_add(ns(ARM_RETRY));
                let (request, was_asked, refused) = (None, false, Some(error));
                self.part = Part::Arm(Arming { request, was_asked, retry_ns, refused, ..arming });
            }
            Err(error) => return Err(error.into()),
        }
        Ok(())
    }

    fn wait_for_lift(
        &mut self,
        now_ns: i64,
        autopilot: &mut Autopilot,
        request: CommandId,
    ) -> Result<(), TakeoffError> {
        if finished(autopilot, request)? {
            self.begin(now_ns, Part::Climb, self.climb_limit());
        }
        Ok(())
    }

    fn climb(
        &mut self,
        now_ns: i64,
        autopilot: &mut Autopilot,
        state: Option<&VehicleState>,
    ) -> Result<(), TakeoffError> {
        let Some(state) = state else { return Ok(()) };
        let height_m = self.height(state);
        let is_level = |p: &Position| p.velocity.z().abs() < MAX_CLIMB_M_S;
        let level =
            state.position.as_ref().is_some_and(is_level) && !is_position_old(now_ns, state);
        // A climb that an earlier controller began ends at that one's height: the ground's position is
        // unknown here.
        let arrived =
            self.ground_z.is_none() || (height_m - self.height_m).abs() < MAX_HEIGHT_ERROR_M;
        if state.landed == LandedState::InAir && level && arrived {
            self.risen = true;
            if state.mode.is_guided() {
                self.part = Part::Done;
            } else {
                let request = autopilot.request(now_ns, Command::SetMode(FlightMode::OFFBOARD));
                self.begin(now_ns, Part::Mode(request), self.limits.arm);
            }
        } else if self.until_ns.is_some_and(|until_ns| now_ns >= until_ns) {
            let (after, landed, wanted_m) = (self.climb_limit(), state.landed, self.height_m);
            return Err(TakeoffError::TooSlow { after, height_m, wanted_m, landed });
        }
        Ok(())
    }

    /// Height above the position where it stood, in m; above the origin when it was not seen standing.
    fn height(&self, state: &VehicleState) -> f64 {
        let z = state.position.map_or(0.0, |position| position.position.z());
        self.ground_z.unwrap_or(0.0) - z
    }

    fn climb_limit(&self) -> Duration {
        self.limits.climb_10_m.mul_f64((self.height_m / 10.0).clamp(0.5, 100.0))
    }

    fn begin(&mut self, now_ns: i64, part: Part, limit: Duration) {
        self.part = part;
        self.until_ns = Some(now_ns.saturating_add(ns(limit)));
    }

    fn progress(&self, autopilot: &Autopilot) -> TakeoffProgress {
        match &self.part {
            Part::Ready => {
                let mut reasons = reasons(autopilot);
                if self.only_simulated && autopilot.is_connected() && !autopilot.is_simulated() {
                    reasons.insert(0, "waiting for its report that it is a simulation".to_owned());
                }
                if self.is_listening && autopilot.is_connected() {
                    reasons.push(LISTENING.to_owned());
                }
                TakeoffProgress::Waiting(reasons)
            }
            Part::Mode(_) => TakeoffProgress::ChangingMode,
            Part::Arm(Arming { refused, .. }) => {
                TakeoffProgress::Arming { refused: refused.as_ref().map(ToString::to_string) }
            }
            Part::Lift(_) | Part::Climb => TakeoffProgress::Climbing {
                height_m: autopilot.state().map_or(0.0, |state| self.height(state)),
            },
            Part::Done => TakeoffProgress::Done,
            Part::Failed(error) => TakeoffProgress::Failed(error.clone()),
        }
    }
}

impl fmt::Display for TakeoffProgress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Waiting(reasons) => write!(f, "waiting: {}", reasons.join("; ")),
            Self::ChangingMode => f.write_str("changing to the mode that follows setpoints"),
            Self::Arming { refused: None } => f.write_str("arming"),
            Self::Arming { refused: Some(reason) } => write!(f, "arming again: {reason}"),
            Self::Climbing { height_m } => write!(f, "climbing, {:.0} m", fmax(*height_m, 0.0)),
            Self::Done => f.write_str("flying"),
            Self::Failed(error) => error.fmt(f),
        }
    }
}

/// Whether the last position is too old to decide by.
fn is_position_old(now_ns: i64, state: &VehicleState) -> bool {
    let is_old = |it: Position| now_ns.saturating_sub(it.stamp_ns) > MAX_POSITION_AGE_NS;
    state.position.is_some_and(is_old)
}

/// Whether a request is done; its error when it failed.
fn finished(autopilot: &Autopilot, request: CommandId) -> Result<bool, CommandError> {
    match autopilot.status(request) {
        CommandStatus::Pending => Ok(false),
        CommandStatus::Done => Ok(true),
        CommandStatus::Failed(error) => Err(error),
        // Only this takeoff is under way, so its request is forgotten only if it was finished long ago.
        CommandStatus::Unknown => Ok(true),
    }
}

fn reasons(autopilot: &Autopilot) -> Vec<String> {
    let mut reasons = autopilot.not_ready_because();
    match autopilot.state() {
        Some(state) if !state.connected => {
            reasons = vec!["the autopilot's heartbeat is lost".to_owned()];
        }
        Some(state) if state.landed == LandedState::Unknown => {
            reasons.push("waiting for EXTENDED_SYS_STATE (whether it stands or flies)".to_owned());
        }
        Some(state) if state.landed == LandedState::Landing => {
            reasons.push("waiting for the end of a landing".to_owned());
        }
        Some(state) if state.landed == LandedState::OnGround && state.armed => {
            reasons.push(
                "it is armed on the ground, by another station or after a landing; disarm it first"
                    .to_owned(),
            );
        }
        Some(state) if state.landed != LandedState::OnGround && !state.armed => {
            reasons.push(format!("the motors are off, and yet it is {}", state.landed));
        }
        _ => {}
    }
    reasons
}
