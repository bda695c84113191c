//! Publishes a camera's frames with their stamps, and with its calibration and mount.
//!
//! Frames come from a program that reads a camera, or from image files. The crate does not depend on the vehicle. Of
//! detectors it reads only the detections, for which a camera can be exposed.
//!
//! Modules in reading order: [`config`] has the settings, [`service`] publishes, `program` reads the output of
//! a camera's program, `side_channel` its metadata: `metadata` splits that into records, `pairing`
//! finds the record of each frame, `exposure` computes from its stamp when the frame was exposed. `repeated` detects a
//! picture that is delivered again. `rect` publishes frames without the lens' distortion where a subscriber requests them.
//! `v4l2` reads cameras without a program, `genicam` (a feature) those of that standard, `rtsp` (a feature) those that stream
//! over a network. `clock` converts a camera's time to the host's. `marker` decides how cameras are exposed for the marker,
//! `control` publishes that. [`devices`] lists the cameras of this machine, [`announced`] those announced over MAVLink.

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
mod no_frame;
mod pairing;
mod program;
mod rect;
mod repeated;
#[cfg(feature = "rtsp")]
mod rtsp;
pub mod service;
mod side_channel;
mod thread;
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
