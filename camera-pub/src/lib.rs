//! Light to frames: images are published with their stamp, and with the camera's calibration and mount.
//!
//! Frames come from a program that reads a camera, or from image files. The crate also reads images, videos and calibrations for programs that publish nothing.
//! It knows no marker, no vehicle and no detector.
//!
//! Modules in reading order: [`config`] says what can be chosen, [`service`] publishes, `program` reads what a camera's program
//! writes, [`image`] reads image files, [`video`] reads videos, [`calibration`] reads calibration files.

pub mod calibration;
pub mod config;
pub mod image;
mod program;
pub mod service;
pub mod video;

pub use calibration::{CalibrationError, read_calibration};
pub use config::Config;
pub use image::{
    IMAGE_EXTENSIONS, ImageError, MOST_PIXELS, decode_image, files_in, images_in, read_image,
};
pub use service::run;
pub use video::{Picture, VIDEO_EXTENSIONS, Video, VideoError, VideoFrame, is_video};
