//! The world of the crate `world` in real time: its autopilot on a MAVLink link, its camera on the topics.
//!
//! It stands in for camera-pub and for the autopilot by speaking their topics and MAVLink; no service knows of it.
//!
//! Modules in reading order: [`config`] says what there is; [`eye`] is the camera as a function;
//! [`reported`] is a vehicle that a real autopilot flies;
//! [`service`] runs it all in real time.

pub mod config;
pub mod eye;
pub mod reported;
pub mod service;

pub use config::Config;
pub use service::run;
