//! Topics to and from the ground station.
//!
//! The ground station gets the autopilot's packets through this service, and those of a companion: its
//! heartbeat, the phases of the landing as texts, and the landing point. The service knows nothing of how a
//! landing is decided. Only the ground station's own packets go to the autopilot, never one that the service
//! makes. Landings do not depend on it.
//!
//! Modules in reading order: [`config`]; `bridge` is the service; `vehicle` finds the vehicle's system id,
//! `route` decides which packets pass, `text` and `target` turn the controller's status and estimate into
//! MAVLink.

pub mod config;

mod bridge;
mod route;
mod target;
mod text;
mod vehicle;

pub use bridge::run;
pub use config::Config;
