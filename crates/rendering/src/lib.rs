//! Renders images of printed markers on the ground, as a camera above a pad sees them, with their truth.
//!
//! The crate uses drawings of markers, camera models and poses. It does not depend on vehicles, files, a clock or
//! detectors. All randomness comes from a seed.
//!
//! Modules in reading order: [`scene`] has the objects and the camera, [`render`] renders them,
//! [`occluder`] has effects between scene and sensor, [`processing`] a camera's processing of the light on its
//! sensor, [`ground`] the textures around the pads, [`views`] the frames of the thesis' experiment; `error` has the
//! errors of scenes that cannot be drawn, `quantise` rounds grey levels.

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
