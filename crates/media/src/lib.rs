//! Images, videos and calibration files, read into grey images and camera models; calibration files are written as well.
//!
//! The crate knows no marker, no camera that is connected, and no other process.
//!
//! Modules in reading order: [`jpeg`] finds JPEG files in a stream of bytes, `huffman` gives them the tables that a camera leaves
//! out, `scan` says whether their data are whole, [`image`] reads image files, [`video`] reads videos frame by frame, [`h264`]
//! decodes what a camera streams, [`calibration`] reads and writes the calibration files of other programs, [`rectify`] takes a
//! lens's distortion out of images, [`whole`] writes a file whole or not at all.

mod boxes;
mod budget;
pub mod calibration;
mod contained;
pub mod h264;
mod huffman;
pub mod image;
pub mod jpeg;
pub mod rectify;
mod scan;
pub mod video;
pub mod whole;

pub use calibration::{
    CalibrationDetails, CalibrationError, CalibrationFile, CalibrationFormat, CalibrationNote,
    CalibrationWriteError, OnSensor, SensorMode, SensorRegion, WantedMode, read_calibration,
    write_calibration,
};
pub use h264::{H264Error, LiveH264};
pub use image::{
    DEFAULT_MAX_PIXELS, DecodedImage, IMAGE_EXTENSIONS, ImageError, OTHER_IMAGE_EXTENSIONS,
    StillImage, decode_image, files_in, frame_bytes, images_in, read_image, samples_to_grey,
};
pub use jpeg::JpegScanner;
pub use rectify::Rectifier;
pub use video::{VIDEO_EXTENSIONS, Video, VideoError, VideoFrame, VideoImage, is_video};
pub use whole::{folder_of, write_whole};
