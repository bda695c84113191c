//! Cameras of the GenICam standard, GigE Vision and USB3 Vision, read with the Aravis library (feature `genicam`).
//!
//! Modules in reading order: `camera` opens and reads a camera; `feed` goes on when it is lost. All run in tests against the camera that Aravis itself plays.

mod camera;
pub(crate) mod feed;
#[cfg(test)]
mod tests;

pub use camera::{GenicamCamera, genicam_cameras};
