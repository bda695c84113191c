//! The link to the autopilot, and the only crate that knows MAVLink.
//!
//! Modules in reading order: [`address`] says where the autopilot is, [`link`] moves bytes to and from it,
//! [`frame`] finds MAVLink packets in them.

pub mod address;
pub mod frame;
pub mod link;

/// The MAVLink messages, enumerations and bit fields of ArduPilot's dialect.
pub mod dialect {
    pub use mavlink::dialects::ardupilotmega::*;
    pub use mavlink::types::CharArray;
    pub use mavlink::{Message, MessageData};
}

pub use address::Address;
pub use frame::{Frame, Parser, Sender};
pub use link::{Link, LinkEvent, LinkSender};
