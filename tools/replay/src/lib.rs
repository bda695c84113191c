//! A recording back into the controller's decisions, and its frames back into detections.
//!
//! The controller's tape has each event in the order in which it was handled. Here they are given to a flight that
//! begins anew, without network and clock. What comes out of it is compared with what came out then.
//!
//! Modules in reading order: [`mod@run`] gives a tape to a flight, [`difference`] names what two results differ in,
//! [`mod@verify`] finds the first difference, and [`mod@change`] sums up what another configuration would have done; [`frames`]
//! searches the recorded pictures again, compares what is found with what was found then, by [`truth`] where there is one,
//! [`brightness`] tells how bright they are, and [`mod@restamp`] gives messages the time at which they are published again.

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
