//! The link to the autopilot, and the only crate that depends on MAVLink.
//!
//! It finds an autopilot on a serial line or a socket, requests the messages that landing needs, reports the
//! vehicle's state in this project's types, and sends it commands with acknowledgement, time limit and clear
//! errors. ArduPilot Copter and PX4 multicopters are supported; both were flown in their own simulators (PX4
//! 1.17).
//!
//! Everything but [`link`] with its `connect` and `newest`, and [`key_file`] is a pure state machine that takes the time as an argument (nanoseconds of any
//! monotonic clock) and does no input or output. The crate does not depend on markers, on landing or on other
//! processes.
//!
//! Modules in reading order: [`address`] is the autopilot's address, [`link`] moves bytes to and from it, of setpoints only the `newest`, and
//! [`peers`] chooses the peer of a listening one, [`received`] explains a missing heartbeat, [`packet`] finds MAVLink packets in them, [`signing`] signs and verifies
//! them, `gate` is where a link does so, with the files of [`key_file`], [`mode`],
//! [`state`] and [`parameter`] are the vehicle's reports, [`clock`] converts its time stamps, `boot` and
//! `contact` decide which of its reports are believed, `standstill` whether its mode was received after a pause of this process, `simulation` asks whether it is simulated, [`client`] is the
//! conversation with it with the settings of [`config`], [`event`] its events, [`command`] has the commands that can be requested
//! and why they may fail, [`conflict`] has the reasons why neither a take-off nor a landing may begin, of which `same_address` finds one, [`takeoff`] arms the vehicle and takes off, [`offboard_exit`] ends PX4's OFFBOARD, which needs the `setpoint_stream`, `offboard_return` distinguishes its failsafe from a pilot's HOLD, [`permission`] restricts the packets of a ground station,
//! [`compose`] makes the messages that a companion sends, and `given` the answer to a command that is not carried out.

#![cfg_attr(not(test), deny(clippy::disallowed_methods))] // The same results on every machine.

pub mod address;
mod boot;
pub mod client;
pub mod clock;
pub mod command;
pub mod compose;
pub mod config;
pub mod conflict;
mod connect;
mod contact;
pub mod event;
mod gate;
mod given;
pub mod key_file;
pub mod link;
pub mod mode;
mod newest;
pub mod offboard_exit;
mod offboard_return;
pub mod packet;
pub mod parameter;
pub mod peers;
pub mod permission;
mod px4_events;
mod px4_listener;
pub mod received;
mod same_address;
mod setpoint_stream;
pub mod signing;
mod simulation;
mod standstill;
pub mod state;
mod stream;
pub mod takeoff;
mod text;

/// The MAVLink messages, enumerations and bit fields of ArduPilot's dialect.
pub mod dialect {
    pub use mavlink::dialects::ardupilotmega::*;
    pub use mavlink::types::CharArray;
    pub use mavlink::{Message, MessageData, calculate_crc};
}

pub use address::Address;
pub use client::Autopilot;
pub use command::{Command, CommandError, CommandId, CommandStatus};
pub use config::Config;
pub use conflict::{Conflict, LISTENING};
pub use event::Event;
pub use given::GivenCommand;
pub use key_file::{KeyFileError, SigningConfig};
pub use link::{Link, LinkEvent, LinkSender};
pub use mode::{Firmware, FlightMode};
pub use offboard_exit::OffboardExit;
pub use packet::{Packet, Parser, Sender};
pub use parameter::Parameter;
pub use peers::Peering;
pub use permission::Permission;
pub use standstill::{MIN_STANDSTILL_NS, without_standstill};
pub use state::{Attitude, Battery, LandedState, Position, Range, VehicleState};
pub use takeoff::{Takeoff, TakeoffError, TakeoffProgress};
