//! Simulates a world to land in, faster than real time: a vehicle and its autopilot, wind, a pad that may move, a
//! camera's faults.
//!
//! It is pure: seed, received packets and requested times determine everything, so a flight repeats to the
//! bit. It does not depend on network, clock or images, nor on how a landing is decided.
//!
//! Modules in reading order: [`world`] joins [`vehicle`], [`wind`], [`pad`] and [`ardupilot`], with [`drift`]
//! for their slow errors; [`camera`] has the faults of frames, [`vision`] a model of the detector.

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
