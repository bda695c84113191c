//! Images of printed markers on the ground, with their truth: what a camera above a pad would see.
//!
//! The crate knows drawings of markers, camera models and poses. It knows no vehicle, file or clock, and no
//! detector. All randomness comes from a seed.
//!
//! Modules in reading order: [`scene`] has what is rendered and the camera, [`render`] renders it,
//! [`occluder`] has effects between scene and sensor, [`processing`] what a camera makes of the light on its
//! sensor, [`ground`] the textures around the pads, [`views`] the frames of the thesis' experiment; `error` says why
//! something cannot be drawn, `quantise` makes grey levels whole.

mod error;
pub mod ground;
pub mod occluder;
pub mod processing;
mod quantise;
pub mod render;
pub mod scene;
pub mod views;

pub use error::RenderError;
pub use ground::Surface;
pub use occluder::Occluder;
pub use processing::{Preset, Processing};
pub use render::Renderer;
pub use scene::{CameraSettings, PadInScene, Scene};
