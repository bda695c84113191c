//! Reads cameras of the GenICam standard, GigE Vision and USB3 Vision, with the Aravis library (feature `genicam`).
//!
//! Modules in reading order: `camera` opens and reads a camera; `feed` opens it again when it is lost. All run in tests
//! against the camera that Aravis itself simulates.

mod camera;
pub(crate) mod feed;
#[cfg(test)]
mod tests;

pub use camera::{GenicamCamera, genicam_cameras};
