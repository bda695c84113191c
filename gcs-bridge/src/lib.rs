//! Topics to and from the ground station.
//!
//! The ground station sees the autopilot through this service, and beside it a companion: its heartbeat, the phases of
//! the landing as texts, and the landing point. It knows nothing of how a landing is decided, and nothing it makes
//! itself ever goes up to the autopilot: only the ground station's own packets do. Without it the others go on.
//!
//! Modules in reading order: [`config`]; `bridge` is the service; `vehicle` learns whom it speaks for, `route` says
//! what passes, `text` and `target` turn the controller's words and estimate into MAVLink.

pub mod config;

mod bridge;
mod route;
mod target;
mod text;
mod vehicle;

pub use bridge::run;
pub use config::Config;
