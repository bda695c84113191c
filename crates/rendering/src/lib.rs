//! Pictures of printed markers on the ground, with their truth: what a camera over a pad would see.
//!
//! This crate knows drawings of markers, cameras as models, and poses. It knows no vehicle, no file, no clock, and
//! nothing of how markers are found; a seed decides all that is left to chance.
//!
//! Modules in reading order: [`render`] is the camera, [`veil`] what is between it and the scene, [`ground`] what lies
//! around the pads, [`views`] the frames of the thesis' experiment.

pub mod ground;
pub mod render;
pub mod veil;
pub mod views;

pub use ground::Surface;
pub use render::{CameraSettings, PadInScene, RenderError, Renderer, Scene};
pub use veil::Veil;
