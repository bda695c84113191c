//! Runs the simulation of the crate `world` in real time: its autopilot on a MAVLink link, its camera on the
//! topics.
//!
//! It replaces camera-pub and the autopilot by using the same topics and MAVLink; no service depends on it.
//!
//! Modules in reading order: [`config`] has the keys, [`camera`] is the camera as a function, `exposing` sets its
//! exposure, [`reported`] is a vehicle that a real autopilot flies, [`service`] runs everything in real time.

pub mod camera;
pub mod config;
mod exposing;
pub mod reported;
pub mod service;

pub use config::Config;
pub use service::run;
