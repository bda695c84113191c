//! A world to land in, faster than time: a vehicle and its autopilot, wind, a pad that may move, a camera's faults.
//!
//! It is pure: a seed, the packets it receives and the times it is asked for decide everything, so the same flight is
//! the same to the bit. It knows no network, no clock, no image, and nothing of how a landing is decided.
//!
//! Modules in reading order: [`world`] joins [`vehicle`], [`wind`], [`pad`] and [`ardupilot`], with [`drift`] for their
//! slow errors; [`camera`] is what happens to frames on their way; [`vision`] what a detector would find in them.

pub mod ardupilot;
pub mod camera;
pub mod drift;
mod laws;
pub mod pad;
pub mod vehicle;
pub mod vision;
pub mod wind;
pub mod world;

pub use world::{World, WorldConfig};
