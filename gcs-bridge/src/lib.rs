//! Bridges the topics to the ground station (MAVLink).
//!
//! The ground station gets the autopilot's packets through this service, and those of a companion: its
//! heartbeat, the phases of the landing as texts, and the landing point; and those of a camera, in whose picture the
//! marker is tracked. The service does not depend on how a landing is decided. Only the ground station's own packets go to the autopilot,
//! never one that the service makes. Landings do not depend on it.
//!
//! Modules in reading order: [`config`]; `bridge` is the service; `vehicle` finds the vehicle's system id,
//! `route` decides which packets pass, `text` and `target` turn the controller's status and estimate into
//! MAVLink, `silence` watches whether that status keeps coming; `camera` shows the detector's camera, at the rate of `frame_rate`, whose `video` another program serves, and `request` reads and answers the ground
//! station's commands to it; `params` shows it the keys of the controller's configuration that are in `parameter_table`; `status` is the
//! published status of the ground stations, `neighbours` warns of another bridge with the same id.

pub mod config;

mod bridge;
mod camera;
mod frame_rate;
mod neighbours;
mod parameter_table;
mod params;
mod request;
mod route;
mod silence;
mod status;
mod target;
mod text;
mod vehicle;
mod video;

pub use bridge::run;
pub use config::Config;
