//! Light to frames: images are published with their stamp, and with the camera's calibration and mount.
//!
//! Frames come from a program that reads a camera, or from image files. The crate knows no marker, no vehicle
//! and no detector.
//!
//! Modules in reading order: [`config`] says what can be chosen, [`service`] publishes, `program` reads what
//! a camera's program writes, `side_channel` what it tells of each frame beside: `metadata` splits that, `pairing`
//! finds each frame's own, `exposure` says from its stamp when the frame was exposed.

pub mod config;
mod exposure;
mod metadata;
mod pairing;
mod program;
pub mod service;
mod side_channel;

pub use config::Config;
pub use service::run;
