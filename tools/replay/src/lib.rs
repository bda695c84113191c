//! Replays a recording: its tape gives the controller's decisions again, its frames the detections.
//!
//! The controller's tape has each event in the order in which it was handled. Here they are given to a flight that
//! starts again, without network and clock. Its decisions are compared with the recorded ones.
//!
//! Modules in reading order: [`mod@run`] gives a tape to a flight, [`difference`] names the difference of two results,
//! [`mod@verify`] finds the first difference, and [`mod@change`] summarises the decisions of another configuration; [`frames`]
//! searches the recorded pictures again and compares the new detections with the recorded ones, by [`truth`] where there is one,
//! [`brightness`] measures how bright they are, and [`mod@restamp`] gives messages the time at which they are published again.

pub mod brightness;
pub mod change;
pub mod difference;
pub mod frames;
pub mod restamp;
pub mod run;
pub mod truth;
pub mod verify;

pub use brightness::{Brightness, Meter};
pub use change::{Begun, Change, change};
pub use frames::{Again, Searched, WrongDetector, search};
pub use restamp::Restamp;
pub use run::{End, Replayed, Stop, of_unused_guidance, run};
pub use verify::{Verdict, verify};
