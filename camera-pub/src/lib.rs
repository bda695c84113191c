//! Light to frames: images are published with their stamp, and with the camera's calibration and mount.
//!
//! Frames come from a program that reads a camera, or from image files. The crate knows no vehicle, and of
//! detectors only what they have found where, which a camera can be exposed for.
//!
//! Modules in reading order: [`config`] says what can be chosen, [`service`] publishes, `program` reads what
//! a camera's program writes, `side_channel` what it tells of each frame beside: `metadata` splits that, `pairing`
//! finds each frame's own, `exposure` says from its stamp when the frame was exposed. `repeated` knows a picture that
//! comes again. `rect` publishes frames without the lens' distortion for whoever wants them.
//! `v4l2` reads cameras without a program, `genicam` (a feature) those of that standard, `rtsp` (a feature) those that stream over a network; `clock` is the host's time
//! of a camera's own. `marker` says how cameras are exposed for the marker, `control` publishes that; [`devices`] lists those of this machine,
//! [`announced`] those that are announced over MAVLink.

pub mod announced;
#[cfg(any(feature = "genicam", feature = "rtsp"))]
mod clock;
pub mod config;
mod control;
pub mod devices;
mod exposure;
#[cfg(feature = "genicam")]
mod genicam;
mod marker;
mod metadata;
mod pairing;
mod program;
mod rect;
mod repeated;
#[cfg(feature = "rtsp")]
mod rtsp;
pub mod service;
mod side_channel;
mod v4l2;

pub use announced::{Announced, AnnouncedCamera, AnnouncedStream, announced_cameras};
pub use config::Config;
pub use devices::{ConnectedDevice, connected_devices, source_table};
#[cfg(feature = "genicam")]
pub use genicam::{GenicamCamera, genicam_cameras};
pub use service::run;
pub use v4l2::describe::{
    ControlDescription, DeviceDescription, FormatDescription, SizeDescription,
};
