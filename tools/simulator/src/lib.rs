//! A world with wind, a pad, a vehicle, an autopilot and a camera in it.

pub mod ardupilot;
pub mod drift;
mod laws;
pub mod vehicle;
pub mod wind;
pub mod world;
pub mod ground;
pub mod render;
