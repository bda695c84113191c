//! The events of a conversation with an autopilot: found, lost, restarted, a new attitude, position or state, another
//! mode, a text.

use std::time::Duration;

use crate::command::{Command, CommandError, CommandId};
use crate::dialect::MavSeverity;
use crate::mode::{Firmware, FlightMode};
use crate::packet::Sender;
use crate::state::{Attitude, LandedState, Position, Range, VehicleState};
use crate::stream::Notice;

/// An event of the conversation.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// The autopilot was found.
    Found {
        /// Its system id.
        system: u8,
        /// Its firmware.
        firmware: Firmware,
    },
    /// Another vehicle is on the same link; it is ignored. Reported once: pin the right one in the
    /// configuration.
    OtherVehicle {
        /// Its system id.
        system: u8,
    },
    /// Another companion uses our ids, probably a second controller of the same vehicle. Reported once until it is gone.
    SameAddress {
        /// Our ids.
        sender: Sender,
    },
    /// The heartbeat was lost.
    Lost {
        /// The silence.
        silence: Duration,
    },
    /// The heartbeat is back.
    Returned,
    /// The autopilot restarted: requests are lost, and its origin may have changed.
    Restarted {
        /// When it started, by our clock.
        started_ns: i64,
    },
    /// A new attitude.
    Attitude(Attitude),
    /// A new position.
    Position(Position),
    /// A new distance measured downwards.
    Range(Range),
    /// The complete state, after each attitude and position.
    State(VehicleState),
    /// The complete state, after each heartbeat and each report of the contact with the ground, and when the
    /// heartbeat is lost: mode, motors and contact are known also where attitude or position stopped.
    Status(VehicleState),
    /// The flight mode changed.
    ModeChanged {
        /// The mode before; none at the beginning.
        from: Option<FlightMode>,
        /// The mode now.
        to: FlightMode,
    },
    /// The motors were armed (true) or disarmed.
    ArmedChanged(bool),
    /// The contact with the ground changed.
    LandedChanged {
        /// The state before.
        from: LandedState,
        /// The state now.
        to: LandedState,
    },
    /// Its readiness to fly changed.
    ReadyChanged {
        /// Whether it is ready.
        ready: bool,
        /// The missing conditions, as texts.
        reasons: Vec<String>,
    },
    /// A text of the autopilot.
    Text {
        /// Its severity.
        severity: MavSeverity,
        /// The complete text.
        text: String,
    },
    /// A command is finished.
    Command {
        /// The request.
        id: CommandId,
        /// The command.
        command: Command,
        /// The result.
        result: Result<(), CommandError>,
    },
    /// A required message does not stream at the requested rate, in spite of repeated requests.
    StreamMissing {
        /// Its name.
        message: &'static str,
        /// Requested rate, in Hz.
        wanted_hz: f64,
        /// Measured rate, in Hz.
        measured_hz: f64,
    },
    /// A missing message streams again.
    StreamRestored {
        /// Its name.
        message: &'static str,
        /// Measured rate, in Hz.
        measured_hz: f64,
    },
}

impl From<Notice> for Event {
    fn from(notice: Notice) -> Self {
        match notice {
            Notice::Missing { message, wanted_hz, measured_hz } => {
                Self::StreamMissing { message, wanted_hz, measured_hz }
            }
            Notice::Restored { message, measured_hz } => {
                Self::StreamRestored { message, measured_hz }
            }
        }
    }
}
