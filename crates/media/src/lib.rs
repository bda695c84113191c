//! Reads images, videos and calibration files into grey images and camera models; writes calibration files as well.
//!
//! The crate does not depend on markers, connected cameras or other processes.
//!
//! Modules in reading order: [`jpeg`] finds JPEG files in a stream of bytes, `huffman` adds the tables that a camera leaves
//! out, `scan` checks whether their data are complete, [`image`] reads image files, [`video`] reads videos frame by frame,
//! `cut` recognises a bare stream whose last picture is cut, [`h264`] decodes a camera's stream, [`calibration`] reads and
//! writes the calibration files of other programs, [`rectify`] removes a lens's distortion from images, [`atomic`] replaces a
//! file by a complete one.

pub mod atomic;
mod boxes;
mod budget;
pub mod calibration;
mod contained;
mod cut;
pub mod h264;
mod huffman;
pub mod image;
pub mod jpeg;
pub mod rectify;
mod scan;
pub mod video;

pub use atomic::{folder_of, write_atomically};
pub use calibration::{
    CalibrationDetails, CalibrationError, CalibrationFile, CalibrationFormat, CalibrationNote,
    CalibrationWriteError, OnSensor, SensorMode, SensorRegion, WantedMode, read_calibration,
    write_calibration,
};
pub use h264::{H264Error, LiveH264};
pub use image::{
    DEFAULT_MAX_PIXELS, DecodedImage, IMAGE_EXTENSIONS, ImageError, OTHER_IMAGE_EXTENSIONS,
    StillImage, decode_image, files_in, frame_bytes, images_in, max_file_bytes, read_image,
    read_image_bytes, samples_to_grey,
};
pub use jpeg::JpegScanner;
pub use rectify::Rectifier;
pub use video::{VIDEO_EXTENSIONS, Video, VideoError, VideoFrame, VideoImage, is_video};
