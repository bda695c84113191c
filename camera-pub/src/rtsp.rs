//! Cameras that stream over RTSP, H.264 or Motion JPEG, read with the crate `retina` (feature `rtsp`).
//!
//! Modules in reading order: `session` opens a stream and receives its pictures, `stamps` says when they were taken, `feed`
//! decodes them and goes on when the camera is lost. All run in tests against `server`, a camera that is played.

pub(crate) mod feed;
mod session;
mod stamps;

#[cfg(test)]
mod server;
#[cfg(test)]
mod tests;
