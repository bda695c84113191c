//! Reads cameras that stream H.264 or Motion JPEG over RTSP, with the crate `retina` (feature `rtsp`).
//!
//! Modules in reading order: `session` opens a stream and receives its pictures, `stamps` estimates when they were taken,
//! `feed` decodes them and opens a lost stream again. All run in tests against `server`, a simulated camera.

pub(crate) mod feed;
mod session;
mod stamps;

#[cfg(test)]
mod server;
#[cfg(test)]
mod tests;
