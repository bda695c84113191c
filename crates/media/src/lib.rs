//! Images, videos and calibration files, read into grey images and camera models.
//!
//! The crate reads files. It knows no marker, no connected camera, and no other process.
//!
//! Modules in reading order: [`image`] reads image files, [`video`] reads videos frame by frame, [`calibration`] reads
//! the calibration files of other programs.

pub mod calibration;
pub mod image;
pub mod video;

pub use calibration::{CalibrationError, read_calibration};
pub use image::{
    Decoded, IMAGE_EXTENSIONS, ImageError, MOST_PIXELS, decode_image, files_in, frame_bytes,
    grey_of, images_in, jpeg_len, read_image,
};
pub use video::{Picture, VIDEO_EXTENSIONS, Video, VideoError, VideoFrame, is_video};
