//! Marker detections in, velocity setpoints out.
//!
//! The service listens to detectors and to the autopilot, lets the lander decide, and tells the autopilot. It stands
//! between three crates that do not know each other: `messages` (what detectors say), `landing` (what to do) and
//! `autopilot` (how to ask for it).
//!
//! Modules in reading order: [`config`] is what it is told, [`service`] joins network and link to the [`flight`],
//! which takes everything in and tells the lander; [`feed`] is the other way to fly, by the autopilot's own precision
//! landing; [`alarms`] watches battery and operator, [`wind`] the lean; [`selection`] chooses the detector; [`wire`] turns messages into
//! the lander's types and back.

pub mod alarms;
pub mod config;
pub mod feed;
pub mod flight;
pub mod selection;
pub mod service;
pub mod wind;
pub mod wire;

pub use config::Config;
pub use service::run;
