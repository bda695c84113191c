//! Light to frames: images are published with their stamp, and with the camera's calibration and mount.
//!
//! Frames come from a program that reads a camera, or from image files. The crate knows no marker, no vehicle
//! and no detector.
//!
//! Modules in reading order: [`config`] says what can be chosen, [`service`] publishes, `program` reads what
//! a camera's program writes.

pub mod config;
mod program;
pub mod service;

pub use config::Config;
pub use service::run;
