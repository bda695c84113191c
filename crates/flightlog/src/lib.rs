//! Writes and reads recordings: their channels, schemas, and the MCAP file.
//!
//! A recording contains every message twice: byte for byte ([`channel::RAW`]), and as JSON or as one of Foxglove's
//! well-known types, for programs other than Alight. This crate uses no network and no clock, and writes to
//! any output.
//!
//! Modules in reading order: [`protobuf`] describes and encodes messages, [`foxglove`] has those of Foxglove,
//! [`channel`] defines records and has messages as they were received and as JSON, [`display`] as Foxglove shows them, with the packets of
//! the vehicle's [`own_autopilot`] alone; [`live`] offers the latter to programs that follow a flight; [`writer`] writes both into a file;
//! `records` iterates over one, [`mod@repair`] ends a file properly whose writer was killed, [`reader`] reads one as far as it is valid,
//! [`damage`] describes the rest, and [`tape`] the controllers' tapes.

pub mod channel;
pub mod damage;
pub mod display;
pub mod foxglove;
pub mod live;
pub mod own_autopilot;
pub mod protobuf;
pub mod reader;
mod records;
pub mod repair;
pub mod tape;
pub mod writer;

pub use channel::{Received, Record, Schema, is_state};
pub use damage::Lost;
pub use display::{Picture, VehicleClock};
pub use live::Live;
pub use own_autopilot::OwnAutopilot;
pub use reader::{Begin, Entry, Reading, in_order, read};
pub use repair::{Repaired, repair};
pub use tape::{RecordedTape, TapeReader};
pub use writer::{About, Error, Writer};
