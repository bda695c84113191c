//! Commands to the autopilot (mode, arm, disarm, take-off): sends and repeats them, matches them with acknowledgements and the state
//! shown, and explains the failure of one with the remedy.

use std::fmt;
use std::time::Duration;

use crate::dialect::{COMMAND_LONG_DATA, MavCmd, MavResult};
use crate::mode::{Firmware, FlightMode};
use crate::state::{LandedState, VehicleState};

/// A command to the autopilot.
#[derive(Copy, Clone, Debug, PartialEq)]
pub enum Command {
    /// Change the flight mode; done when the vehicle shows it.
    SetMode(FlightMode),
    /// Arm the motors; done when the heartbeat shows it.
    Arm,
    /// Disarm the motors; refused in the air; done when the heartbeat shows it.
    Disarm,
    /// Climb to this height in m above the ground, in GUIDED and armed; done when it is accepted.
    Takeoff {
        /// The height in m above the position where it was armed.
        height_m: f64,
    },
}

/// The id of a request.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct CommandId(pub(crate) u64);

/// The status of a request.
#[derive(Clone, Debug, PartialEq)]
pub enum CommandStatus {
    /// Not finished.
    Pending,
    /// Done, as its [`Command`] defines it.
    Done,
    /// Failed, and not repeated.
    Failed(CommandError),
    /// Too old: no longer known.
    Unknown,
}

/// Why a command was not carried out, and the remedy.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CommandError {
    /// No autopilot.
    #[error(
        "{command}: no heartbeat of an autopilot; check the power, the cable and the address of the link"
    )]
    NoAutopilot {
        /// The command.
        command: Command,
    },
    /// The firmware is not supported.
    #[error(
        "{command}: the vehicle runs {firmware}; only copters with ArduPilot or PX4 are supported"
    )]
    Unsupported {
        /// The command.
        command: Command,
        /// The vehicle's firmware.
        firmware: Firmware,
    },
    /// The command is invalid.
    #[error("{command}: {reason}")]
    Invalid {
        /// The command.
        command: Command,
        /// The reason.
        reason: &'static str,
    },
    /// Heartbeats are received, but no acknowledgement.
    #[error(
        "{command}: no acknowledgement of {attempts} requests; packets from the autopilot arrive, check \
         that packets to it do"
    )]
    NoAnswer {
        /// The command.
        command: Command,
        /// Number of attempts.
        attempts: u32,
    },
    /// The autopilot refused.
    #[error("{command}: the autopilot refused it ({}){}; {}", result_text(*result), reason(texts), advice(command))]
    Refused {
        /// The command.
        command: Command,
        /// Its result.
        result: MavResult,
        /// Its texts at the same time, `Arm: ...` for example; may be empty.
        texts: Vec<String>,
    },
    /// The autopilot accepted, and nothing changed.
    #[error(
        "{command}: accepted, but the vehicle still shows {seen} after {} s; another station may command it",
        waited.as_secs_f32()
    )]
    NotConfirmed {
        /// The command.
        command: Command,
        /// The state that the heartbeat shows instead.
        seen: String,
        /// Time waited for the change.
        waited: Duration,
    },
    /// A later command replaced it.
    #[error("{command}: replaced by {by}")]
    Replaced {
        /// The command.
        command: Command,
        /// The later command.
        by: Command,
    },
    /// It was withdrawn.
    #[error("{command}: withdrawn before it was done")]
    Withdrawn {
        /// The command.
        command: Command,
    },
    /// The autopilot restarted.
    #[error("{command}: the autopilot restarted")]
    Restarted {
        /// The command.
        command: Command,
    },
}

/// Why a velocity setpoint was not sent.
#[derive(Copy, Clone, Debug, PartialEq, thiserror::Error)]
pub enum SetpointError {
    /// No heartbeat.
    #[error("velocity not sent: no heartbeat of an autopilot")]
    NoAutopilot,
    /// The firmware is not supported.
    #[error(
        "velocity not sent: the vehicle runs {0}; only copters with ArduPilot or PX4 are supported"
    )]
    Unsupported(Firmware),
    /// A number is not finite, which ArduPilot would take for a stop.
    #[error("velocity not sent: {0:?} m/s with {1} rad/s of yaw is not finite")]
    NotFinite([f64; 3], f64),
    /// The pilot flies.
    #[error(
        "velocity not sent: the vehicle is in {0}, which follows no setpoints; the pilot is in command"
    )]
    NotGuided(FlightMode),
    /// A setpoint would end the takeoff or have no effect.
    #[error("velocity not sent: the vehicle is not armed and in the air ({0})")]
    NotFlying(LandedState),
}

impl fmt::Display for Command {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::SetMode(mode) => write!(f, "change to {mode}"),
            Self::Arm => f.write_str("arm"),
            Self::Disarm => f.write_str("disarm"),
            Self::Takeoff { height_m } => write!(f, "take off to {height_m} m"),
        }
    }
}

/// The result of a command, as text.
pub fn result_text(result: MavResult) -> &'static str {
    match result {
        MavResult::MAV_RESULT_ACCEPTED => "accepted",
        MavResult::MAV_RESULT_TEMPORARILY_REJECTED => "not now",
        MavResult::MAV_RESULT_DENIED => "invalid request",
        MavResult::MAV_RESULT_UNSUPPORTED => "not supported",
        MavResult::MAV_RESULT_FAILED => "failed",
        MavResult::MAV_RESULT_IN_PROGRESS => "in progress",
        MavResult::MAV_RESULT_CANCELLED => "cancelled",
        _ => "for another reason",
    }
}

fn reason(texts: &[String]) -> String {
    if texts.is_empty() { String::new() } else { format!(": {}", texts.join("; ")) }
}

fn advice(command: &Command) -> &'static str {
    match command {
        Command::SetMode(_) => "the mode may need a position first, or be disabled",
        Command::Arm => "remove the cause and arm again",
        Command::Disarm => "it must stand on the ground",
        Command::Takeoff { .. } => {
            "it must be armed, on the ground, and in GUIDED if it is ArduPilot"
        }
    }
}

impl Command {
    /// The message of the command. `ground_amsl_m` is the altitude above mean sea level of the ground, in m:
    /// PX4 takes off to an altitude.
    pub(crate) fn message(&self, attempt: u32, ground_amsl_m: Option<f64>) -> COMMAND_LONG_DATA {
        let mut message = COMMAND_LONG_DATA {
            command: self.number(),
            confirmation: attempt.saturating_sub(1).min(255) as u8,
            ..Default::default()
        };
        match *self {
            Self::SetMode(mode) => {
                // MAV_MODE_FLAG_CUSTOM_MODE_ENABLED: the firmware's own mode follows.
                message.param1 = 1.0;
                if let FlightMode::Px4(number) = mode {
                    let [_, _, main, sub] = number.to_le_bytes();
                    message.param2 = main.into();
                    message.param3 = sub.into();
                } else {
                    message.param2 = mode.custom_mode() as f32;
                }
            }
            Self::Arm => message.param1 = 1.0,
            Self::Disarm => {}
            Self::Takeoff { height_m } => match ground_amsl_m {
                // NaN: the present heading, latitude and longitude.
                Some(ground_m) => {
                    message.param4 = f32::NAN;
                    message.param5 = f32::NAN;
                    message.param6 = f32::NAN;
                    message.param7 = (ground_m + height_m) as f32;
                }
                None => message.param7 = height_m as f32,
            },
        }
        message
    }

    fn number(&self) -> MavCmd {
        match self {
            Self::SetMode(_) => MavCmd::MAV_CMD_DO_SET_MODE,
            Self::Arm | Self::Disarm => MavCmd::MAV_CMD_COMPONENT_ARM_DISARM,
            Self::Takeoff { .. } => MavCmd::MAV_CMD_NAV_TAKEOFF,
        }
    }

    pub(crate) fn is_answered_by(&self, command: MavCmd) -> bool {
        self.number() == command
    }

    /// Whether the later of both replaces the earlier one.
    pub(crate) fn concerns_same_as(&self, other: &Self) -> bool {
        self.number() == other.number()
    }

    /// Whether the vehicle's state shows that it is done.
    pub(crate) fn is_shown_by(&self, state: &VehicleState) -> bool {
        match self {
            Self::SetMode(mode) => state.mode == *mode,
            Self::Arm => state.armed,
            Self::Disarm => !state.armed,
            Self::Takeoff { .. } => state.armed && state.landed.is_flying(),
        }
    }

    /// Whether the acknowledgement alone is enough.
    pub(crate) fn is_done_when_accepted(&self) -> bool {
        matches!(self, Self::Takeoff { .. })
    }

    /// Whether PX4 needs a stream of setpoints for it.
    pub(crate) fn is_offboard(&self) -> bool {
        *self == Self::SetMode(FlightMode::OFFBOARD)
    }

    pub(crate) fn why_invalid(&self, state: Option<&VehicleState>) -> Option<&'static str> {
        match self {
            Self::Takeoff { height_m } if !(0.5..=500.0).contains(height_m) => {
                Some("the height must be from 0.5 to 500 m")
            }
            Self::Takeoff { .. } if state.is_some_and(|s| s.armed && s.landed.is_flying()) => {
                Some("it is flying already")
            }
            _ => None,
        }
    }
}

/// A pending command.
#[derive(Clone, Debug)]
pub(crate) struct Request {
    pub(crate) id: CommandId,
    pub(crate) command: Command,
    /// The mode in which it was requested.
    from: Option<FlightMode>,
    phase: Phase,
    attempts: u32,
    /// When it was sent last.
    sent_ns: i64,
    began_ns: i64,
    texts: Vec<String>,
}

#[derive(Copy, Clone, Debug)]
enum Phase {
    /// To be sent at this time.
    Due(i64),
    /// Sent; the acknowledgement is awaited until then.
    Sent(i64),
    /// Accepted; the change is awaited until then.
    Accepted(i64),
    /// Refused; the autopilot's texts are collected until then.
    Refused(MavResult, i64),
}

/// The next step of a request.
pub(crate) enum Step {
    Wait,
    Send(Command, u32),
    Finish(Result<(), CommandError>),
}

/// Timeouts of commands.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Timeouts {
    /// Timeout of an acknowledgement.
    pub acknowledgement: Duration,
    /// Maximum number of attempts without an acknowledgement.
    pub attempts: u32,
    /// Timeout of the change after acceptance; a heartbeat comes once a second.
    pub confirmation: Duration,
    /// Time for which texts are collected after a refusal; they come after it.
    pub explanation: Duration,
}

impl Default for Timeouts {
    fn default() -> Self {
        Self {
            acknowledgement: Duration::from_secs(1),
            attempts: 4,
            confirmation: Duration::from_secs(3),
            explanation: Duration::from_millis(300),
        }
    }
}

/// Maximum age of a message whose mode is the one of now, in nanoseconds.
pub(crate) const MODE_OF_NOW_NS: i64 = 200_000_000;
/// Minimum age of it, in nanoseconds: when PX4 has accepted another mode, it sends the former one once more, and up to 48 ms later the new
/// one (measured with PX4 1.17 in its own simulation).
pub(crate) const MODE_SETTLES_NS: i64 = 80_000_000;
/// Maximum number of texts stored as an explanation.
const MAX_TEXTS: usize = 8;

impl Request {
    pub(crate) fn new(
        id: CommandId,
        command: Command,
        from: Option<FlightMode>,
        now_ns: i64,
    ) -> Self {
        Self {
            id,
            command,
            from,
            phase: Phase::Due(now_ns),
            attempts: 0,
            sent_ns: now_ns,
            began_ns: now_ns,
            texts: Vec::new(),
        }
    }

    /// When it was sent last; `None` before that.
    pub(crate) fn sent_ns(&self) -> Option<i64> {
        (self.attempts > 0).then_some(self.sent_ns)
    }

    /// The same was requested again: without an acknowledgement it is sent again now; after one the timeout
    /// of the change stays.
    pub(crate) fn repeat(&mut self, now_ns: i64) {
        if matches!(self.phase, Phase::Sent(_)) {
            self.phase = Phase::Due(now_ns);
        }
    }

    /// The autopilot sent a text while this was pending.
    pub(crate) fn add_text(&mut self, text: &str) {
        let about_arming = is_about_arming(text);
        if about_arming && self.command != Command::Arm {
            return;
        }
        if about_arming && !self.texts.iter().any(|text| is_about_arming(text)) {
            // It names the reason, so earlier texts are about something else.
            self.texts.clear();
        }
        let needed = about_arming || !self.texts.iter().any(|text| is_about_arming(text));
        if needed
            && self.attempts > 0
            && self.texts.len() < MAX_TEXTS
            && !self.texts.iter().any(|s| s == text)
        {
            self.texts.push(text.to_owned());
        }
    }

    /// A check before arming failed while this was pending.
    pub(crate) fn add_check(&mut self, text: &str) {
        if self.command == Command::Arm {
            self.add_text(text);
        }
    }

    /// The autopilot acknowledged.
    pub(crate) fn acknowledge(&mut self, now_ns: i64, result: MavResult, timeouts: &Timeouts) {
        let after = |wait: Duration| now_ns.saturating_add(ns(wait));
        self.phase = match (self.phase, result) {
            // An acknowledgement of an earlier attempt has no effect.
            (Phase::Accepted(_) | Phase::Refused(..) | Phase::Due(_), _) => return,
            (_, MavResult::MAV_RESULT_ACCEPTED) => Phase::Accepted(after(timeouts.confirmation)),
            (_, MavResult::MAV_RESULT_IN_PROGRESS) => Phase::Sent(after(timeouts.confirmation)),
            (_, MavResult::MAV_RESULT_TEMPORARILY_REJECTED)
                if self.attempts < timeouts.attempts =>
            {
                Phase::Due(after(timeouts.acknowledgement))
            }
            (_, refusal) => Phase::Refused(refusal, after(timeouts.explanation)),
        };
    }

    /// The next step, where `is_of_now` states that the state's mode has just been shown. Unless it `may_send`, no packet is sent and no
    /// request is given up.
    pub(crate) fn step(
        &mut self,
        now_ns: i64,
        state: &VehicleState,
        is_of_now: bool,
        may_send: bool,
        timeouts: &Timeouts,
    ) -> Step {
        let command = self.command;
        let sent = self.attempts > 0;
        if command.is_shown_by(state) && (sent || !command.is_done_when_accepted()) {
            return Step::Finish(Ok(()));
        }
        let waits = self.needs_mode_of_now() && !is_of_now;
        if self.needs_mode_of_now() && !self.is_requested_in(state.mode) {
            return Step::Finish(Err(CommandError::Withdrawn { command }));
        }
        match self.phase {
            Phase::Due(_) | Phase::Sent(_) if !may_send => Step::Wait,
            Phase::Due(at) if now_ns >= at && !waits => self.send(now_ns, timeouts),
            Phase::Sent(until) if now_ns >= until => {
                if self.attempts < timeouts.attempts {
                    return if waits { Step::Wait } else { self.send(now_ns, timeouts) };
                }
                Step::Finish(Err(CommandError::NoAnswer { command, attempts: self.attempts }))
            }
            Phase::Accepted(_) if command.is_done_when_accepted() => Step::Finish(Ok(())),
            Phase::Accepted(until) if now_ns >= until => {
                let waited =
                    Duration::from_nanos(now_ns.saturating_sub(self.began_ns).max(0) as u64);
                let seen = match command {
                    Command::SetMode(_) => state.mode.to_string(),
                    _ if state.armed => "armed motors".to_owned(),
                    _ => "disarmed motors".to_owned(),
                };
                Step::Finish(Err(CommandError::NotConfirmed { command, seen, waited }))
            }
            Phase::Accepted(_)
                if may_send && is_of_now && self.is_mode_missing(now_ns, state, timeouts) =>
            {
                self.attempts += 1;
                self.sent_ns = now_ns;
                Step::Send(command, self.attempts)
            }
            Phase::Refused(result, until) if now_ns >= until => {
                let texts = std::mem::take(&mut self.texts);
                Step::Finish(Err(CommandError::Refused { command, result, texts }))
            }
            _ => Step::Wait,
        }
    }

    /// Whether it is sent only just after a message that shows the mode in which it was requested: OFFBOARD, and HOLD out of it, take the
    /// vehicle from a pilot who has changed the mode since.
    fn needs_mode_of_now(&self) -> bool {
        let is_hold = self.command == Command::SetMode(FlightMode::AUTO_HOLD);
        self.command.is_offboard() || is_hold && self.from == Some(FlightMode::OFFBOARD)
    }

    /// Whether the mode is the one in which it was requested. PX4 ends its own take-off in HOLD.
    fn is_requested_in(&self, mode: FlightMode) -> bool {
        let rises = [FlightMode::AUTO_TAKEOFF, FlightMode::AUTO_HOLD];
        self.from.is_none_or(|from| mode == from || rises.contains(&mode) && rises.contains(&from))
    }

    /// Whether a mode that was accepted a while ago is sent again. All modes have the same acknowledgement, which may be a late one of
    /// another mode that was requested before, and this one lost. It is sent only just after a message that shows the mode of before, or it
    /// could undo a pilot's switch.
    fn is_mode_missing(&self, now_ns: i64, state: &VehicleState, timeouts: &Timeouts) -> bool {
        let is_late = now_ns.saturating_sub(self.sent_ns) >= ns(timeouts.acknowledgement);
        matches!(self.command, Command::SetMode(_))
            && is_late
            && self.attempts < timeouts.attempts
            && self.is_requested_in(state.mode)
    }

    fn send(&mut self, now_ns: i64, timeouts: &Timeouts) -> Step {
        self.attempts += 1;
        self.sent_ns = now_ns;
        self.phase = Phase::Sent(now_ns.saturating_add(ns(timeouts.acknowledgement)));
        Step::Send(self.command, self.attempts)
    }
}

/// True for ArduPilot's reasons not to arm.
fn is_about_arming(text: &str) -> bool {
    text.starts_with("Arm: ") || text.starts_with("PreArm: ")
}

/// A duration in the unit of stamps.
pub(crate) fn ns(duration: Duration) -> i64 {
    duration.as_nanos().try_into().unwrap_or(i64::MAX)
}
