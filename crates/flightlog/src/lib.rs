//! What a recording is: its channels, their schemas, and the MCAP file.
//!
//! A recording keeps every message twice: byte for byte ([`channel::RAW`]), and as JSON or as one of Foxglove's
//! well-known types, for programs that know nothing of Alight. This crate knows no network and no clock, and writes to
//! whatever is given.
//!
//! Modules in reading order: [`protobuf`] describes and encodes messages, [`foxglove`] has those of Foxglove,
//! [`channel`] says what a record is and keeps messages as they came and as JSON, [`display`] as Foxglove shows them, with the packets of the
//! vehicle's [`own_autopilot`] alone;
//! [`live`] offers the latter to programs that follow a flight; [`writer`] puts both into a file; `records` goes through one,
//! [`mod@repair`] ends a file properly whose writer was killed,
//! [`reader`] reads one as far as it is whole, and [`tape`] the controllers' tapes.

pub mod channel;
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
pub use display::{Picture, VehicleClock};
pub use live::Live;
pub use own_autopilot::OwnAutopilot;
pub use reader::{Begin, Entry, Reading, in_order, read};
pub use repair::{Repaired, repair};
pub use tape::{RecordedTape, TapeReader};
pub use writer::{About, Problem, Writer};
