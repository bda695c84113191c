//! The arguments of `alight detect`.

use std::path::PathBuf;

use clap::{ArgGroup, Args, ValueEnum};
use imaging::BayerPattern;
use markers::Marker;

/// The arguments of `alight detect`.
#[derive(Args, Clone, Debug)]
#[command(group(ArgGroup::new("what to find").args(["markers", "pads"]).required(true).multiple(true)))]
pub(crate) struct DetectArgs {
    /// Marker to find: `FAMILY:ID[:SIZE_M]`, `FAMILY:*[:SIZE_M]` for all ids, or `FAMILY[:SIZE_M]` for a family without ids (rings; the
    /// thesis' own detection of them, `rings-thesis`, is kept for comparison and finds few markers in pictures of ordinary cameras). A
    /// wrong name lists all families. May be repeated. One of these or `--pad` is needed.
    #[arg(long = "marker", value_name = "MARKER")]
    pub(super) markers: Vec<Marker>,
    /// Pad to find, whose markers are solved together: the built-in `a4`, or a TOML file. It needs a camera,
    /// and is reported as a marker `pad:ID`. May be repeated.
    #[arg(long = "pad", value_name = "PAD")]
    pub(super) pads: Vec<String>,
    /// Calibration of the camera (ROS camera_info, Kalibr camchain or OpenCV FileStorage), for the pose of
    /// markers of known size.
    #[arg(long, value_name = "FILE", conflicts_with = "focal_px")]
    pub(super) camera: Option<PathBuf>,
    /// Focal length in pixels instead of a calibration: an ideal lens with its axis at the image centre.
    #[arg(long, value_name = "PX", value_parser = focal_px)]
    pub(super) focal_px: Option<f64>,
    /// Number of images processed in parallel [default: number of processors].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    pub(super) threads: Option<u16>,
    /// Format of the output: text, or one JSON object per line.
    #[arg(long, value_enum, default_value_t = LineFormat::Text)]
    pub(super) format: LineFormat,
    /// Bayer pattern of grey images with a sensor's raw samples: RGGB, GRBG, GBRG or BGGR.
    #[arg(long, value_name = "PATTERN")]
    pub(super) bayer: Option<BayerPattern>,
    /// Track: search first where the markers of the last images are predicted; one image after the other.
    #[arg(long, conflicts_with = "threads")]
    pub(super) track: bool,
    /// Folder for annotated images, IMAGE.drawn.png (of a video VIDEO-000123.drawn.png, with the frame's number), in grey as
    /// they are searched and those narrower than 900 pixels two to four times as large: outlines (green) with the marker's own top-left corner (red circle), a circle around
    /// small ones (yellow), the axes of poses (x red, y green, z blue, towards the viewer; a red cross without a pose), and name, id,
    /// confidence and position in the camera frame (x, y, z). Earlier ones of that name are replaced, other files never, and none is
    /// searched as an image of its folder.
    #[arg(long, value_name = "DIR")]
    pub(super) draw: Option<PathBuf>,
    /// Image files (PNG of 8 or 16 bits, JPEG; up to 100 megapixels), `-` for one image from standard input, videos
    /// (Motion JPEG as AVI or stream, H.264 as MP4 or stream), and folders of them, of which images of other formats are
    /// left out and named. An image is searched as it is stored, as the sensor saw it: it is not turned by its Exif
    /// orientation, nor a video by the rotation in its header; a note reports that.
    #[arg(required = true, value_name = "IMAGE")]
    pub(super) images: Vec<PathBuf>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum LineFormat {
    Text,
    Jsonl,
}

fn focal_px(text: &str) -> Result<f64, &'static str> {
    let number: Option<f64> = text.parse().ok();
    number
        .filter(|px| *px > 0.0 && *px <= 1e6)
        .ok_or("a focal length is a number of pixels above 0 and up to 1e6")
}
