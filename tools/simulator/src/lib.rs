//! A world with wind, a pad, a vehicle, an autopilot and a camera in it.
//!
//! It stands in for camera-pub and for the autopilot by speaking their topics and MAVLink; no service knows of it.
//! The world is pure: a seed and the packets it receives decide everything.
//!
//! Modules in reading order: [`world`] joins [`vehicle`], [`wind`] and [`ardupilot`], with [`drift`] for their slow
//! errors; what the camera sees is the crate `rendering`'s; [`reported`] is a vehicle that a real autopilot flies;
//! [`config`] and [`service`] run it all in real time.

pub mod ardupilot;
pub mod config;
pub mod drift;
mod laws;
pub mod reported;
pub mod service;
pub mod vehicle;
pub mod wind;
pub mod world;

pub use config::Config;
pub use service::run;
