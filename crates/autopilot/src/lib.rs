//! The link to the autopilot, and the only crate that knows MAVLink.
//!
//! It finds an autopilot on a serial line or a socket, asks it for the messages that landing needs, reports the
//! vehicle's state in this project's types, and carries commands to it with acknowledgement, time limit and clear
//! errors. ArduPilot Copter is flown; so is PX4 on a copter, as its documentation tells (1.17 in its own simulation was flown, too).
//!
//! Everything but [`link`] and [`session`] is a pure state machine that takes the time as an argument (nanoseconds of any clock that
//! does not jump) and does no input or output. The crate knows nothing of markers, of landing or of other processes.
//!
//! Modules in reading order: [`address`] says where the autopilot is, [`link`] moves bytes to and from it,
//! [`packet`] finds MAVLink packets in them, [`mode`], [`state`] and [`parameter`] are what the vehicle tells about itself,
//! [`clock`] is when that was so, [`client`] keeps up the conversation, [`command`] is what can be asked and why it may fail, [`takeoff`] is the way
//! from the ground into the air, [`compose`] makes the messages a companion sends, [`session`] ties link and client
//! together for a service.

pub mod address;
pub mod client;
pub mod clock;
pub mod command;
pub mod compose;
pub mod link;
pub mod mode;
pub mod packet;
pub mod parameter;
pub mod session;
pub mod state;
mod stream;
pub mod takeoff;
mod text;

/// The MAVLink messages, enumerations and bit fields of ArduPilot's dialect.
pub mod dialect {
    pub use mavlink::dialects::ardupilotmega::*;
    pub use mavlink::types::CharArray;
    pub use mavlink::{Message, MessageData};
}

pub use address::Address;
pub use client::{Autopilot, Config, Event};
pub use command::{Command, CommandError, CommandId, CommandStatus};
pub use link::{Link, LinkEvent, LinkSender};
pub use mode::{Firmware, FlightMode};
pub use packet::{Frame, Parser, Sender};
pub use parameter::Parameter;
pub use session::{Happening, Session};
pub use state::{Attitude, Battery, LandedState, Position, Range, VehicleState};
pub use takeoff::{Takeoff, TakeoffError, TakeoffProgress};
