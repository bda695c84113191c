//! Controls exposure for the marker: the exposure time and gain that a camera's next frames need, so that the pad's white is
//! bright, not clipped, and not blurred.
//!
//! A camera's own metering weighs the complete frame: over dark ground it overexposes a white pad, against snow it
//! underexposes it. This crate does not depend on a camera or a clock. It reads detections, which give the pad's position and
//! speed in the image, and the pixels there. Camera-pub or the simulated camera sets the camera's controls.
//!
//! Modules in reading order: [`pad`] follows the pad from detections, [`region`] measures the grey levels of white and black,
//! [`control`] computes the next exposure time and gain, and [`handover`] chooses between them and the camera's own metering.
//! [`throttle`] limits how often the exposure is published.

pub mod control;
pub mod handover;
pub mod pad;
pub mod region;
pub mod throttle;

pub use control::{ExposureControl, Limits, Seen, Setting, Step};
pub use handover::Handover;
pub use pad::{Pad, PadTrack};
pub use region::{Levels, levels};
pub use throttle::ControlThrottle;
