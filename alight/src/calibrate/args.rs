//! The arguments of `alight calibrate board`: size of the board and its tags, images or a running camera, lens model, region of
//! the sensor, calibration file and its format.

use std::path::{Path, PathBuf};

use calibration::{Lens, Options};
use clap::{Args, ValueEnum};
use imaging::BayerPattern;
use markers::{Board, BoardError};
use media::{CalibrationFormat, CalibrationWriteError, OnSensor, SensorMode, SensorRegion};

use crate::args::{Format, NetworkArgs};
use crate::ending::{Ending, format_of};
use crate::marker::{Output, Paper};

/// The arguments of `alight calibrate board`.
#[derive(Args)]
pub(crate) struct BoardArgs {
    /// Print the board into this file instead of calibrating; its name ends in .pdf, .svg or .png.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["images", "output"])]
    pub(super) print: Option<Output>,
    /// The paper that the board is printed on.
    #[arg(long, value_enum, ignore_case = true, default_value_t = Paper::A4)]
    pub(super) paper: Paper,
    /// Pixels per inch of a PNG.
    #[arg(long, value_name = "N", default_value_t = 300, value_parser = clap::value_parser!(u16).range(30..=2400))]
    pub(super) dpi: u16,
    /// Tags of the board side by side.
    #[arg(long, value_name = "N", default_value_t = Board::A4.columns())]
    columns: u32,
    /// Tags of the board one above the other.
    #[arg(long, value_name = "N", default_value_t = Board::A4.rows())]
    rows: u32,
    /// Side of a tag's black square in metres, as measured on the print.
    #[arg(long, value_name = "M", default_value_t = Board::A4.tag_m())]
    tag: f64,
    /// White between two tags in metres, as measured on the print.
    #[arg(long, value_name = "M", default_value_t = Board::A4.gap_m())]
    gap: f64,
    /// The lens model: Brown-Conrady with 4, 5 or 8 numbers for usual lenses, Kannala-Brandt for wide ones.
    #[arg(long, value_enum, default_value_t = LensName::BrownConrady5)]
    pub(super) lens: LensName,
    /// The board is glass or aluminium: do not solve for its bend.
    #[arg(long)]
    pub(super) flat: bool,
    /// Bayer pattern of grey images with a sensor's raw samples: RGGB, GRBG, GBRG or BGGR.
    #[arg(long, value_name = "PATTERN")]
    pub(super) bayer: Option<BayerPattern>,
    /// The calibration file to write. Its name ends in .yaml, or in .json or .xml for OpenCV's.
    #[arg(short, long, value_name = "FILE", value_parser = calibration_file)]
    pub(super) output: Option<PathBuf>,
    /// Replace the file of `--output` where it is there already, as the calibration in use; without it that file is refused.
    #[arg(long)]
    pub(super) replace: bool,
    /// The sensor's size, kept in the file, when the images show it binned or a part of it; other modes of the same camera are
    /// then calculated from this calibration.
    #[arg(long, value_name = "WIDTHxHEIGHT", value_parser = sensor_px)]
    sensor: Option<[u32; 2]>,
    /// The part of the sensor that the images show: left,top,width,height in its pixels [default: all of it].
    #[arg(long, value_name = "L,T,W,H", requires = "sensor", value_parser = region)]
    region: Option<SensorRegion>,
    /// How many pixels of the sensor, across and down, are one of the images'.
    #[arg(long, value_name = "N", requires = "sensor", default_value_t = 1)]
    binning: u32,
    /// The calibration file's format [default: ros, or opencv where the file's name ends in .json or .xml].
    #[arg(long, value_enum)]
    file_format: Option<FileFormat>,
    /// Format of the output: text, or JSON, one object for the result and with --live one for each frame that was taken.
    #[arg(long, value_enum, default_value_t)]
    pub(super) format: Format,
    /// A camera that is running, by its name (camera-pub's `id`): frames are taken while the board is held still in places where
    /// it was not yet, until nothing is missing, or Ctrl-C.
    #[arg(long, value_name = "CAMERA", conflicts_with_all = ["images", "print"])]
    pub(super) live: Option<String>,
    /// Image files (PNG of 8 or 16 bits, JPEG), videos, and folders of them. Of a video those frames are taken in which the
    /// board has moved. Images are read as they are stored, not turned by their Exif orientation.
    #[arg(required_unless_present_any = ["print", "live"], value_name = "IMAGE")]
    pub(super) images: Vec<PathBuf>,
    #[command(flatten)]
    pub(super) network: NetworkArgs,
}

impl BoardArgs {
    /// The board.
    pub(super) fn board(&self) -> Result<Board, BoardError> {
        Board::new(self.columns, self.rows, self.tag, self.gap)
    }

    /// Checks before the calibration that the file's format can hold its result.
    ///
    /// # Errors
    /// Brown-Conrady with more than four numbers for Kalibr, and an ending that only OpenCV's files have.
    pub(super) fn check(&self) -> Result<(), CalibrationWriteError> {
        let is_long = matches!(self.lens, LensName::BrownConrady5 | LensName::BrownConrady8);
        match (self.file_format(), &self.output) {
            (FileFormat::Kalibr, _) if is_long => Err(CalibrationWriteError::Lens),
            (FileFormat::Kalibr | FileFormat::Ros, Some(path)) if is_of_open_cv(path) => {
                Err(CalibrationWriteError::Ending { path: path.clone() })
            }
            (FileFormat::Kalibr | FileFormat::Ros | FileFormat::Opencv, _) => Ok(()),
        }
    }

    /// The file's format: by its option, or by the ending of its name.
    pub(super) fn file_format(&self) -> FileFormat {
        self.file_format.unwrap_or(match &self.output {
            Some(path) if is_of_open_cv(path) => FileFormat::Opencv,
            _ => FileFormat::Ros,
        })
    }

    /// How to solve.
    pub(super) fn options(&self) -> Options {
        Options { solve_bend: !self.flat }
    }

    /// The conversion from the sensor to the images, if it was given.
    pub(super) fn on_sensor(&self) -> Option<OnSensor> {
        let [width, height] = self.sensor?;
        let region = self.region.unwrap_or_else(|| SensorRegion::whole(width, height));
        let mode = SensorMode { region, binning: self.binning };
        Some(OnSensor { sensor_px: [width, height], mode })
    }
}

/// The endings of calibration files, and whether only those of OpenCV have them.
const ENDINGS: [Ending<bool>; 4] = [
    Ending::new("yaml", false),
    Ending::new("yml", false),
    Ending::new("json", true),
    Ending::new("xml", true),
];

fn calibration_file(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    format_of(&path, &ENDINGS)?;
    Ok(path)
}

fn is_of_open_cv(path: &Path) -> bool {
    format_of(path, &ENDINGS).unwrap_or(false)
}

fn sensor_px(text: &str) -> Result<[u32; 2], String> {
    let edges = text.split_once('x').and_then(|(w, h)| Some([w.parse().ok()?, h.parse().ok()?]));
    edges
        .filter(|edges| edges.iter().all(|edge| (1..=65_535).contains(edge)))
        .ok_or_else(|| "write WIDTHxHEIGHT, each from 1 to 65535, such as 2592x1944".to_owned())
}

/// The region of a command line: `left,top,width,height`.
pub(super) fn region(text: &str) -> Result<SensorRegion, String> {
    let numbers: Option<Vec<u32>> = text.split(',').map(|part| part.parse().ok()).collect();
    match numbers.as_deref() {
        Some(&[left, top, width, height]) => Ok(SensorRegion { left, top, width, height }),
        _ => Err("write left,top,width,height in pixels, such as 16,8,1280,960".to_owned()),
    }
}

/// A lens model by its name on the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum LensName {
    #[value(name = "brown-conrady-4")]
    BrownConrady4,
    #[value(name = "brown-conrady-5")]
    BrownConrady5,
    #[value(name = "brown-conrady-8")]
    BrownConrady8,
    KannalaBrandt,
}

impl LensName {
    pub(super) fn model(self) -> Lens {
        match self {
            Self::BrownConrady4 => Lens::BrownConrady4,
            Self::BrownConrady5 => Lens::BrownConrady5,
            Self::BrownConrady8 => Lens::BrownConrady8,
            Self::KannalaBrandt => Lens::KannalaBrandt,
        }
    }
}

/// A calibration file's format by its name on the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum FileFormat {
    /// ROS camera_info.
    Ros,
    /// Kalibr camchain (Brown-Conrady with 4 numbers, or Kannala-Brandt).
    Kalibr,
    /// OpenCV FileStorage.
    Opencv,
}

impl FileFormat {
    pub(crate) fn format(self) -> CalibrationFormat {
        match self {
            Self::Ros => CalibrationFormat::Ros,
            Self::Kalibr => CalibrationFormat::Kalibr,
            Self::Opencv => CalibrationFormat::OpenCv,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Program {
        #[command(flatten)]
        args: BoardArgs,
    }

    #[test]
    fn the_ending_of_the_file_and_its_format_agree() {
        let format = |text: &[&str]| {
            let text = ["board", "."].iter().chain(text);
            let args = Program::try_parse_from(text).map_err(|problem| problem.to_string())?.args;
            args.check().map(|()| args.file_format()).map_err(|problem| problem.to_string())
        };
        assert_eq!(format(&["-o", "camera.yaml"]), Ok(FileFormat::Ros));
        assert_eq!(format(&["-o", "camera.json"]), Ok(FileFormat::Opencv));
        assert_eq!(format(&["-o", "camera.XML"]), Ok(FileFormat::Opencv));
        assert_eq!(
            format(&["-o", "camera.yml", "--file-format", "opencv"]),
            Ok(FileFormat::Opencv)
        );
        let refused = format(&["-o", "camera.json", "--file-format", "ros"]).unwrap_err();
        assert!(refused.contains("camera.json") && refused.contains(".yaml"), "{refused}");
        assert!(format(&["-o", "camera.txt"]).unwrap_err().contains(".yaml, .yml, .json or .xml"));
    }
}
