//! Frames for the link between drone and ground: the part that matters, compressed, and no more than the link carries.
//!
//! The camera's side sends JPEG frames on `camera/{camera}/jpeg`, whole or as a region about the markers with a small
//! overview, and sends the next one only when the last one has arrived. The detector's side turns such a payload back
//! into pictures. The crate knows no marker beyond where detections saw it, and no Zenoh but through `node`.
//!
//! Modules in reading order: [`config`] says what can be chosen, [`sender`] is the camera's side, [`window`] says when
//! the next frame may go and how large it may be, [`expected`] where the markers should be in it, [`plan`] which parts
//! of it are sent how finely, and [`payload`] makes the bytes and reads them again.

pub mod config;
pub mod expected;
pub mod payload;
pub mod plan;
pub mod sender;
pub mod window;

pub use config::AirConfig;
pub use payload::{Packer, PayloadError, Pictures};
pub use plan::{Plan, Planner};
pub use sender::AirSender;
