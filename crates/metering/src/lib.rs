//! Exposure for the marker: which exposure time and gain a camera's next frames need, so that the pad's white is bright,
//! not clipped, and not blurred.
//!
//! A camera's own metering weighs the whole frame: over dark ground it washes a white pad out, against snow it loses it. This
//! crate knows no camera and no clock. It reads detections, which tell where the pad is and how fast it moves in the image,
//! and the pixels there; who sets a camera's controls is camera-pub, or the simulated camera.
//!
//! Modules in reading order: [`pad`] follows the pad from detections, [`region`] has the grey levels of its white and black,
//! [`control`] the next exposure time and gain, and why, and [`handover`] says when they count, and when the camera's own metering.
//! [`telling`] says what others are told of it.

pub mod control;
pub mod handover;
pub mod pad;
pub mod region;
pub mod telling;

pub use control::{ExposureControl, Limits, Seen, Setting, Step};
pub use handover::Handover;
pub use pad::{Pad, PadTrack};
pub use region::{Levels, levels};
pub use telling::Telling;
