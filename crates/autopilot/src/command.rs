//! What an autopilot can be asked to do, and why it may not happen.

use std::fmt;
use std::time::Duration;

use crate::dialect::{COMMAND_LONG_DATA, MavCmd, MavResult};
use crate::mode::{Firmware, FlightMode};
use crate::state::{LandedState, VehicleState};

/// Something asked of the autopilot.
#[derive(Copy, Clone, Debug, PartialEq)]
pub enum Command {
    /// Change the flight mode; done when the heartbeat shows it.
    SetMode(FlightMode),
    /// Let the motors turn; done when the heartbeat shows it.
    Arm,
    /// Stop the motors; refused in the air; done when the heartbeat shows it.
    Disarm,
    /// Climb to this height in m above the ground, in GUIDED and armed; done when it is accepted.
    Takeoff {
        /// The height in m above the place where it was armed.
        height_m: f64,
    },
}

/// Names one request.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct CommandId(pub(crate) u64);

/// How a request stands.
#[derive(Clone, Debug, PartialEq)]
pub enum CommandStatus {
    /// On its way.
    Pending,
    /// Done, as its [`Command`] defines it.
    Done,
    /// Not done, and not being tried any more.
    Failed(CommandError),
    /// So long ago that it is forgotten.
    Unknown,
}

/// Why a command was not carried out, and what to do about it.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CommandError {
    /// There is no autopilot, or no more.
    #[error(
        "{command}: no heartbeat of an autopilot; check the power, the cable and the address of the link"
    )]
    NoAutopilot {
        /// What was asked.
        command: Command,
    },
    /// This firmware is not flown.
    #[error("{command}: the vehicle runs {firmware}; only copters with ArduPilot or PX4 are flown")]
    Unsupported {
        /// What was asked.
        command: Command,
        /// What flies the vehicle.
        firmware: Firmware,
    },
    /// The command makes no sense.
    #[error("{command}: {problem}")]
    Invalid {
        /// What was asked.
        command: Command,
        /// What is wrong with it.
        problem: &'static str,
    },
    /// The autopilot was heard but did not answer.
    #[error(
        "{command}: no answer to {attempts} requests; the link carries packets from the autopilot, check \
         that it also carries packets to it"
    )]
    NoAnswer {
        /// What was asked.
        command: Command,
        /// How often.
        attempts: u32,
    },
    /// The autopilot said no.
    #[error("{command}: the autopilot refused it ({}){}; {}", result_in_words(*result), reason(said), advice(command))]
    Refused {
        /// What was asked.
        command: Command,
        /// Its answer.
        result: MavResult,
        /// What it said at the same time, `Arm: ...` for example; may be empty.
        said: Vec<String>,
    },
    /// The autopilot said yes, and yet nothing changed.
    #[error(
        "{command}: accepted, but the heartbeat still shows {seen} after {} s; somebody else may command the vehicle",
        waited.as_secs_f32()
    )]
    NotConfirmed {
        /// What was asked.
        command: Command,
        /// What the vehicle does instead.
        seen: String,
        /// For how long the change was waited for.
        waited: Duration,
    },
    /// A later command took its place.
    #[error("{command}: replaced by {by}")]
    Replaced {
        /// What was asked.
        command: Command,
        /// What was asked later.
        by: Command,
    },
    /// Nobody wants it any more.
    #[error("{command}: withdrawn before it was done, because somebody else decides now")]
    Withdrawn {
        /// What was asked.
        command: Command,
    },
    /// The autopilot restarted in between.
    #[error("{command}: the autopilot restarted")]
    Restarted {
        /// What was asked.
        command: Command,
    },
}

/// Why a velocity setpoint was not sent.
#[derive(Copy, Clone, Debug, PartialEq, thiserror::Error)]
pub enum SetpointError {
    /// The heartbeat is not heard.
    #[error("velocity not sent: no heartbeat of an autopilot")]
    NoAutopilot,
    /// This firmware is not flown.
    #[error(
        "velocity not sent: the vehicle runs {0}; only copters with ArduPilot or PX4 are flown"
    )]
    Unsupported(Firmware),
    /// A number is infinite or not a number, which ArduPilot takes for a stop.
    #[error("velocity not sent: {0:?} m/s with {1} rad/s of yaw is not finite")]
    NotFinite([f64; 3], f64),
    /// Somebody else flies.
    #[error(
        "velocity not sent: the vehicle is in {0}, which follows no setpoints; the pilot is in command"
    )]
    NotGuided(FlightMode),
    /// A setpoint now would end the takeoff or do nothing.
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

/// The result of a command, for people.
pub fn result_in_words(result: MavResult) -> &'static str {
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

fn reason(said: &[String]) -> String {
    if said.is_empty() { String::new() } else { format!(": {}", said.join("; ")) }
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
    /// The message that asks for it. `ground_amsl_m` is the altitude over the sea, in m, of where the vehicle stands:
    /// PX4 takes off to an altitude.
    pub(crate) fn message(&self, attempt: u32, ground_amsl_m: Option<f64>) -> COMMAND_LONG_DATA {
        let mut message = COMMAND_LONG_DATA {
            command: self.number(),
            confirmation: attempt.saturating_sub(1).min(255) as u8,
            ..Default::default()
        };
        match *self {
            Self::SetMode(mode) => {
                // MAV_MODE_FLAG_CUSTOM_MODE_ENABLED: what follows is the firmware's own mode.
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
                // Not a number: the present heading, latitude and longitude.
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

    /// Whether both are about the same thing, so that the later one takes the earlier one's place.
    pub(crate) fn concerns_same_as(&self, other: &Self) -> bool {
        self.number() == other.number()
    }

    /// Whether the vehicle's own report shows that it happened.
    pub(crate) fn is_shown_by(&self, state: &VehicleState) -> bool {
        match self {
            Self::SetMode(mode) => state.mode == *mode,
            Self::Arm => state.armed,
            Self::Disarm => !state.armed,
            Self::Takeoff { .. } => state.armed && state.landed.is_flying(),
        }
    }

    /// Whether an acknowledgement alone is enough.
    pub(crate) fn is_done_when_accepted(&self) -> bool {
        matches!(self, Self::Takeoff { .. })
    }

    pub(crate) fn problem(&self, state: Option<&VehicleState>) -> Option<&'static str> {
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

/// A command on its way.
#[derive(Clone, Debug)]
pub(crate) struct Request {
    pub(crate) id: CommandId,
    pub(crate) command: Command,
    phase: Phase,
    attempts: u32,
    began_ns: i64,
    said: Vec<String>,
}

#[derive(Copy, Clone, Debug)]
enum Phase {
    /// To be sent at this time.
    Due(i64),
    /// Sent; an answer is waited for until then.
    Sent(i64),
    /// Accepted; the change is waited for until then.
    Accepted(i64),
    /// Refused; what the autopilot says about it is collected until then.
    Refused(MavResult, i64),
}

/// What a request needs next.
pub(crate) enum Step {
    Wait,
    Send(Command, u32),
    Finish(Result<(), CommandError>),
}

/// How long commands are tried.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Patience {
    /// How long an acknowledgement may take.
    pub answer: Duration,
    /// How often a command is sent when no acknowledgement comes.
    pub attempts: u32,
    /// How long an accepted change may take to show; a heartbeat comes once a second.
    pub confirmation: Duration,
    /// How long reasons are collected after a refusal; they come after it.
    pub explanation: Duration,
}

impl Default for Patience {
    fn default() -> Self {
        Self {
            answer: Duration::from_secs(1),
            attempts: 4,
            confirmation: Duration::from_secs(3),
            explanation: Duration::from_millis(300),
        }
    }
}

/// More of the autopilot's words than this is no explanation.
const MAX_SAID: usize = 8;

impl Request {
    pub(crate) fn new(id: CommandId, command: Command, now_ns: i64) -> Self {
        Self {
            id,
            command,
            phase: Phase::Due(now_ns),
            attempts: 0,
            began_ns: now_ns,
            said: Vec::new(),
        }
    }

    /// The same was asked for once more: what was not answered is sent again now; what was accepted has until the next
    /// heartbeat to show.
    pub(crate) fn ask_again(&mut self, now_ns: i64) {
        if matches!(self.phase, Phase::Sent(_)) {
            self.phase = Phase::Due(now_ns);
        }
    }

    /// The autopilot said something while this was under way.
    pub(crate) fn hear(&mut self, text: &str) {
        let about_arming = is_about_arming(text);
        if about_arming && self.command != Command::Arm {
            return;
        }
        if about_arming && !self.said.iter().any(|said| is_about_arming(said)) {
            // It names the reason, so what was said before is about something else.
            self.said.clear();
        }
        let needed = about_arming || !self.said.iter().any(|said| is_about_arming(said));
        if needed
            && self.attempts > 0
            && self.said.len() < MAX_SAID
            && !self.said.iter().any(|s| s == text)
        {
            self.said.push(text.to_owned());
        }
    }

    /// The autopilot answered.
    pub(crate) fn answer(&mut self, now_ns: i64, result: MavResult, patience: &Patience) {
        let after = |wait: Duration| now_ns.saturating_add(ns(wait));
        self.phase = match (self.phase, result) {
            // An answer to an earlier attempt changes nothing any more.
            (Phase::Accepted(_) | Phase::Refused(..) | Phase::Due(_), _) => return,
            (_, MavResult::MAV_RESULT_ACCEPTED) => Phase::Accepted(after(patience.confirmation)),
            (_, MavResult::MAV_RESULT_IN_PROGRESS) => Phase::Sent(after(patience.confirmation)),
            (_, MavResult::MAV_RESULT_TEMPORARILY_REJECTED)
                if self.attempts < patience.attempts =>
            {
                Phase::Due(after(patience.answer))
            }
            (_, refusal) => Phase::Refused(refusal, after(patience.explanation)),
        };
    }

    pub(crate) fn step(&mut self, now_ns: i64, state: &VehicleState, patience: &Patience) -> Step {
        let command = self.command;
        let sent = self.attempts > 0;
        if command.is_shown_by(state) && (sent || !command.is_done_when_accepted()) {
            return Step::Finish(Ok(()));
        }
        match self.phase {
            Phase::Due(at) if now_ns >= at => self.send(now_ns, patience),
            Phase::Sent(until) if now_ns >= until => {
                if self.attempts < patience.attempts {
                    return self.send(now_ns, patience);
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
            Phase::Refused(result, until) if now_ns >= until => {
                let said = std::mem::take(&mut self.said);
                Step::Finish(Err(CommandError::Refused { command, result, said }))
            }
            _ => Step::Wait,
        }
    }

    fn send(&mut self, now_ns: i64, patience: &Patience) -> Step {
        self.attempts += 1;
        self.phase = Phase::Sent(now_ns.saturating_add(ns(patience.answer)));
        Step::Send(self.command, self.attempts)
    }
}

/// How ArduPilot begins the reasons why it does not arm.
fn is_about_arming(text: &str) -> bool {
    text.starts_with("Arm: ") || text.starts_with("PreArm: ")
}

/// A duration in the unit of stamps.
pub(crate) fn ns(duration: Duration) -> i64 {
    duration.as_nanos().try_into().unwrap_or(i64::MAX)
}
