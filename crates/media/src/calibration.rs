//! Reads calibration files of ROS, Kalibr and OpenCV as a camera model, for images of the calibrated size or of another mode
//! of the sensor (binned, cropped).
//!
//! Three formats are read and distinguished by their keys: ROS `camera_info` (`camera_matrix` or `K`, with
//! `image_width`), Kalibr's camera chain (`cam0` with `intrinsics`), and OpenCV's `FileStorage` as YAML, XML or JSON
//! (`camera_matrix` of type `opencv-matrix`). In all of them the centre of the top-left pixel is (0, 0), as
//! in this project.
//!
//! In reading order: `text` makes keys and values of a file, `fields` a camera of those, `mode` is the part of the sensor that
//! the images show, `writing` is the way back.

mod fields;
mod mode;
mod text;
mod writing;

use std::path::{Path, PathBuf};

use fields::{Parsed, Problem};
use geometry::CameraModel;
use serde_yaml_ng::Value;

pub use mode::{SensorMode, SensorRegion};
pub use writing::{
    CalibrationDetails, CalibrationFormat, CalibrationNote, CalibrationWriteError, OnSensor,
    write_calibration,
};

/// Maximum size of a calibration file, in bytes.
const MAX_FILE_BYTES: u64 = 1 << 20;
/// Why a calibration file was refused.
#[derive(Debug, thiserror::Error)]
pub enum CalibrationError {
    /// The system does not open the file.
    #[error("reading the calibration {path:?}: {cause}")]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        cause: std::io::Error,
    },
    /// Text in none of the three formats.
    #[error(
        "the calibration {path:?} {problem}; it must be ROS camera_info YAML (with `camera_matrix`), a Kalibr \
         camchain (with `cam0`) or OpenCV FileStorage as YAML, XML or JSON (with `camera_matrix`)"
    )]
    Form {
        /// The file.
        path: PathBuf,
        /// The error.
        problem: String,
    },
    /// A key that is missing or has an invalid value.
    #[error("the calibration {path:?}: `{key}` {problem}; {expected}")]
    Key {
        /// The file.
        path: PathBuf,
        /// The key.
        key: String,
        /// The error.
        problem: String,
        /// The valid values.
        expected: &'static str,
    },
    /// Images of another mode than the calibration is for.
    #[error("the calibration {path:?} {problem}")]
    Mode {
        /// The file.
        path: PathBuf,
        /// The mode, and the remedy.
        problem: String,
    },
}

/// A camera from a calibration file, and for which of its modes.
#[derive(Clone, Debug, PartialEq)]
pub struct CalibrationFile {
    /// The file.
    pub path: PathBuf,
    /// The camera of the images in `mode`.
    pub camera: CameraModel,
    /// The mode that the file describes; where it has none the images are of the whole sensor.
    pub mode: SensorMode,
    /// Width and height of the sensor.
    pub sensor_px: [u32; 2],
    /// The part of the sensor for which the calibration holds.
    pub calibrated: SensorRegion,
}

/// A mode as it is configured; the file gives the fields that are `None`.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq)]
pub struct WantedMode {
    /// The part of the sensor that is read; by default the part for which the calibration holds.
    pub region: Option<SensorRegion>,
    /// The binning; none where only a region is given.
    pub binning: Option<u32>,
}

/// The intrinsics in a calibration file, for images as it describes them: ROS `camera_info` YAML, the first camera of a Kalibr
/// camchain (pinhole with radtan, equidistant or no distortion), or OpenCV's `FileStorage`.
///
/// # Errors
/// [`CalibrationError`] names the file, the key and the expected value.
pub fn read_calibration(path: &Path) -> Result<CameraModel, CalibrationError> {
    Ok(CalibrationFile::read(path)?.camera)
}

impl CalibrationFile {
    /// Reads a file.
    ///
    /// # Errors
    /// [`CalibrationError`] names the file, the key and the expected value.
    pub fn read(path: &Path) -> Result<Self, CalibrationError> {
        let root = keys_and_values(path)?;
        let parsed = fields::parse(&root).ok_or_else(|| CalibrationError::Form {
            path: path.to_owned(),
            problem: "has none of the keys of a calibration".to_owned(),
        })?;
        let Parsed { camera, mode, sensor_px, calibrated } =
            parsed.map_err(|Problem { key, problem, expected }| CalibrationError::Key {
                path: path.to_owned(),
                key,
                problem,
                expected,
            })?;
        Ok(Self { path: path.to_owned(), camera, mode, sensor_px, calibrated })
    }

    /// The camera of images of this size, in this mode. Binning and cropping are exact; images that were scaled otherwise, and
    /// parts of the sensor for which the calibration does not hold, are refused.
    ///
    /// # Errors
    /// [`CalibrationError::Mode`] with both modes, and the remedy.
    pub fn camera_in(
        &self,
        image_px: [u32; 2],
        wanted: WantedMode,
    ) -> Result<CameraModel, CalibrationError> {
        let [width, height] = image_px;
        let refused = |problem: String| CalibrationError::Mode { path: self.path.clone(), problem };
        if wanted == WantedMode::default() {
            if [self.camera.width, self.camera.height] == image_px {
                return Ok(self.camera);
            }
            return Err(refused(format!(
                "is for images of {} x {} pixels, and these have {width} x {height}: {}",
                self.camera.width,
                self.camera.height,
                self.other_size_advice(image_px),
            )));
        }
        let mode = SensorMode {
            region: wanted.region.unwrap_or(self.calibrated),
            binning: wanted.binning.unwrap_or(1),
        };
        if !(1..=mode::MAX_BINNING).contains(&mode.binning) {
            let max = mode::MAX_BINNING;
            return Err(refused(format!(
                "has no binning by {}: it is from 1 to {max}",
                mode.binning
            )));
        }
        if !mode.region.lies_in(&self.calibrated) {
            return Err(refused(format!(
                "holds for {} of the sensor, and the region of the images is {}: calibrate with images of that region",
                self.calibrated, mode.region
            )));
        }
        if mode.image_px() != image_px {
            let [w, h] = mode.image_px();
            return Err(refused(format!(
                "gives images of {w} x {h} pixels when {} are binned {} x {}, and these have {width} x {height}: correct region \
                 and binning, or calibrate with images of this mode",
                mode.region, mode.binning, mode.binning
            )));
        }
        if mode == self.mode {
            return Ok(self.camera);
        }
        Ok(mode.of_images(&self.mode.of_sensor(&self.camera, self.sensor_px)))
    }

    /// The size alone does not show whether the sensor was binned, cropped, or read at every second pixel only.
    fn other_size_advice(&self, [width, height]: [u32; 2]) -> String {
        let SensorRegion { width: all_width, height: all_height, .. } = self.calibrated;
        let binning = (2..=8).find(|b| [all_width / b, all_height / b] == [width, height]);
        match binning {
            Some(binning) => format!(
                "if the camera averages {binning} x {binning} pixels, configure it (binning {binning}); otherwise calibrate at this size"
            ),
            None if width <= all_width && height <= all_height => {
                "if they are a part of the sensor, configure it (a region of left, top, width and height); otherwise calibrate at this \
                 size"
                    .to_owned()
            }
            None => "calibrate at this size".to_owned(),
        }
    }
}

fn keys_and_values(path: &Path) -> Result<Value, CalibrationError> {
    let unreadable = |cause| CalibrationError::Unreadable { path: path.to_owned(), cause };
    let metadata = std::fs::metadata(path).map_err(unreadable)?;
    let form = |problem: String| CalibrationError::Form { path: path.to_owned(), problem };
    if !metadata.is_file() || metadata.len() > MAX_FILE_BYTES {
        return Err(form(format!("is not a file of at most {MAX_FILE_BYTES} bytes")));
    }
    let bytes = std::fs::read(path).map_err(unreadable)?;
    let text = String::from_utf8(bytes).map_err(|_cause| form("is not text".to_owned()))?;
    text::parse(&text).map_err(form)
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::Distortion;

    const ROS: &str = "
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [651.2, 0, 326.5, 0., 653.1, 239.25, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.41, 0.17, 0.001, -0.002, 0.0]
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
";

    const KALIBR: &str = "
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.01, 0.02, -0.003, 0.0004]
  distortion_model: equidistant
  intrinsics: [461.629, 460.152, 362.68, 246.049]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  camera_model: omni
";

    const OPENCV: &str = "%YAML:1.0
---
calibration_time: \"Wed 08 Dec 2021\"
image_width: 640
image_height: 480
flags: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 4.5e+02, 0., 3.1770297317353277e+02, 0.,
       4.5676707935146891e+02, 2.7775155919135995e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ .12, -1., 1.1786843796668460e-04, -4.6240686046485508e-04,
       2. ]
";

    fn read(text: &str) -> Result<CameraModel, String> {
        let file = tempfile::Builder::new().suffix(".yaml").tempfile().unwrap();
        std::fs::write(file.path(), text).unwrap();
        let name = file.path().display().to_string();
        read_calibration(file.path()).map_err(|e| {
            let problem = e.to_string();
            assert!(problem.contains(&name), "{name} is not in: {problem}");
            problem
        })
    }

    #[test]
    fn the_binning_and_the_region_of_ros_move_pixel_centres() {
        let mode = "binning_x: 2\nbinning_y: 2\nroi: {x_offset: 40, y_offset: 20, width: 500, height: 400}\n";
        let camera = read(&format!("{ROS}{mode}")).unwrap();
        assert_eq!((camera.width, camera.height, camera.fx), (250, 200, 651.2 / 2.0));
        // The centre of a pair of pixels is half a pixel from that of its first one.
        assert!((camera.cx - (326.5 - 40.0 - 0.5) / 2.0).abs() < 1e-12);
        assert!((camera.cy - (239.25 - 20.0 - 0.5) / 2.0).abs() < 1e-12);
        let whole =
            "binning_x: 0\nbinning_y: 0\nroi: {x_offset: 0, y_offset: 0, width: 0, height: 0}\n";
        assert_eq!(read(&format!("{ROS}{whole}")), read(ROS));
        for wrong in [
            "binning_x: 2\n",
            "roi: {x_offset: 1, width: 640}\n",
            "binning_x: 3.5\nbinning_y: 3.5\n",
        ] {
            let problem = read(&format!("{ROS}{wrong}")).unwrap_err();
            assert!(problem.contains("both binnings the same"), "{problem}");
        }
    }

    fn in_mode(text: &str, image_px: [u32; 2], wanted: WantedMode) -> Result<CameraModel, String> {
        let file = tempfile::Builder::new().suffix(".yaml").tempfile().unwrap();
        std::fs::write(file.path(), text).unwrap();
        let held = CalibrationFile::read(file.path()).unwrap();
        held.camera_in(image_px, wanted).map_err(|problem| problem.to_string())
    }

    #[test]
    fn another_mode_is_converted_when_it_bins_or_crops() {
        let as_it_is = WantedMode::default();
        let whole = in_mode(ROS, [640, 480], as_it_is).unwrap();
        assert_eq!(Ok(whole), read(ROS));
        let binned = WantedMode { region: None, binning: Some(2) };
        let half = in_mode(ROS, [320, 240], binned).unwrap();
        assert_eq!((half.fx, half.cx, half.cy), (325.6, 163.0, 119.375));
        assert_eq!(half.distortion, whole.distortion);
        let region = SensorRegion { left: 40, top: 20, width: 500, height: 400 };
        let cropped = WantedMode { region: Some(region), binning: None };
        let part = in_mode(ROS, [500, 400], cropped).unwrap();
        assert_eq!((part.fx, part.cx, part.cy), (651.2, 286.5, 219.25));
    }

    #[test]
    fn a_mode_that_cannot_be_converted_is_refused_with_the_remedy() {
        let refused = |image_px, region: Option<SensorRegion>, binning| {
            in_mode(ROS, image_px, WantedMode { region, binning }).unwrap_err()
        };
        let check = |problem: String, part: &str| assert!(problem.contains(part), "{problem}");
        check(
            refused([320, 240], None, None),
            "these have 320 x 240: if the camera averages 2 x 2",
        );
        check(refused([600, 400], None, None), "if they are a part of the sensor, configure it");
        check(refused([1280, 960], None, None), "these have 1280 x 960: calibrate at this size");
        check(refused([320, 200], None, Some(2)), "gives images of 320 x 240");
        check(refused([320, 240], None, Some(0)), "no binning by 0");
        let beyond = SensorRegion { left: 200, top: 0, width: 500, height: 400 };
        check(refused([500, 400], Some(beyond), None), "calibrate with images of that region");
    }

    #[test]
    fn modes_beyond_the_calibrated_part_of_a_sensor_are_refused() {
        let text = format!(
            "{OPENCV}alight:\n   sensor: [2000, 1500]\n   region: [100, 60, 1280, 960]\n   binning: 2\n"
        );
        let whole = WantedMode { region: None, binning: Some(1) };
        let camera = in_mode(&text, [1280, 960], whole).unwrap();
        assert_eq!(camera.fx, 900.0);
        assert!((camera.cx - (2.0 * 317.702_973_173_532_77 + 0.5)).abs() < 1e-9);
        let all = SensorRegion::whole(2000, 1500);
        let beyond = WantedMode { region: Some(all), binning: None };
        let problem = in_mode(&text, [2000, 1500], beyond).unwrap_err();
        assert!(problem.contains("1280 x 960 from column 100 and row 60"), "{problem}");
        let wrong = read(&text.replace("binning: 2", "binning: 3")).unwrap_err();
        assert!(wrong.contains("must give the images' size"), "{wrong}");
    }

    #[test]
    fn ros_camera_info_is_read() {
        let camera = read(ROS).unwrap();
        assert_eq!((camera.width, camera.height), (640, 480));
        assert_eq!([camera.fx, camera.fy, camera.cx, camera.cy], [651.2, 653.1, 326.5, 239.25]);
        let k = [-0.41, 0.17, 0.001, -0.002, 0.0, 0.0, 0.0, 0.0];
        assert_eq!(camera.distortion, Distortion::BrownConrady(k));
    }

    #[test]
    fn a_camera_info_message_is_read() {
        let message = "header: {seq: 1}\nheight: 480\nwidth: 640\ndistortion_model: equidistant\n\
                       D: [0.1, 0.2, 0.3, 0.4]\nK: [500, 0, 320, 0, 500, 240, 0, 0, 1]\n";
        let camera = read(message).unwrap();
        assert_eq!(camera.distortion, Distortion::KannalaBrandt([0.1, 0.2, 0.3, 0.4]));
        assert_eq!(read(&message.to_lowercase()), Ok(camera));
    }

    #[test]
    fn the_first_camera_of_a_kalibr_chain_is_read() {
        let camera = read(KALIBR).unwrap();
        assert_eq!((camera.width, camera.height, camera.fx), (752, 480, 461.629));
        assert_eq!(camera.distortion, Distortion::KannalaBrandt([-0.01, 0.02, -0.003, 0.0004]));
        let radtan = read(&KALIBR.replace("equidistant", "radtan")).unwrap();
        let k = [-0.01, 0.02, -0.003, 0.0004, 0.0, 0.0, 0.0, 0.0];
        assert_eq!(radtan.distortion, Distortion::BrownConrady(k));
    }

    #[test]
    fn opencv_file_storage_is_read() {
        let camera = read(OPENCV).unwrap();
        assert_eq!([camera.fx, camera.cx], [450.0, 317.70297317353277]);
        let Distortion::BrownConrady([k1, k2, .., k6]) = camera.distortion else { panic!() };
        assert_eq!([k1, k2, k6], [0.12, -1.0, 0.0]);
        let fisheye =
            OPENCV.replace("flags: 0", "fisheye_model: 1").replace(",\n       2. ]", " ]");
        assert!(matches!(read(&fisheye).unwrap().distortion, Distortion::KannalaBrandt(_)));
    }

    #[test]
    fn four_coefficients_of_an_unnamed_lens_are_no_guess() {
        let four = OPENCV.replace(",\n       2. ]", " ]");
        let problem = read(&four).unwrap_err();
        assert!(
            problem.contains("four numbers") && problem.contains("fisheye_model: 1"),
            "{problem}"
        );
        let narrow = read(&four.replace("flags: 0", "fisheye_model: 0")).unwrap();
        assert!(matches!(narrow.distortion, Distortion::BrownConrady(_)));
        let none =
            four.replace(".12, -1., 1.1786843796668460e-04, -4.6240686046485508e-04", "0, 0, 0, 0");
        assert_eq!(read(&none).unwrap().distortion, Distortion::None);
    }

    #[test]
    fn lists_of_rows_are_matrices_too() {
        let text = "image_size: [640, 480]\nK: [[500, 0, 320], [0, 500, 240], [0, 0, 1]]\n";
        assert_eq!(read(text).unwrap().distortion, Distortion::None);
    }

    #[test]
    fn errors_name_the_key() {
        let check = |text: &str, from: &str, to: &str, parts: &[&str]| {
            assert!(text.contains(from), "{from}");
            let problem = read(&text.replace(from, to)).unwrap_err();
            for part in parts {
                assert!(problem.contains(part), "`{part}` is not in: {problem}");
            }
        };
        check(ROS, "651.2", "0", &["`camera_matrix` has fx = 0", "above 0"]);
        check(ROS, "651.2", "-651.2", &["fx = -651.2"]);
        check(ROS, "651.2", ".nan", &["`camera_matrix` is", ".nan", "9 numbers"]);
        check(ROS, "651.2", ".inf", &["`camera_matrix` is"]);
        check(ROS, "651.2, 0, 326.5", "651.2, 3, 326.5", &["`camera_matrix`", "0, cx, 0"]);
        check(ROS, "239.25, 0, 0, 1", "239.25", &["`camera_matrix`", "9 numbers"]);
        check(ROS, "image_width: 640", "", &["`image_width` is missing", "1 to 65535"]);
        check(ROS, "image_width: 640", "image_width: 0", &["`image_width` is 0"]);
        check(ROS, "image_width: 640", "image_width: 1e9", &["`image_width` is 1000000000"]);
        check(ROS, "plumb_bob", "thin_prism", &["`distortion_model` is `thin_prism`", "radtan"]);
        check(ROS, ", -0.002, 0.0]", "]", &["`distortion_coefficients` has 3 numbers"]);
    }

    #[test]
    fn errors_name_the_key_of_kalibr_and_opencv_too() {
        let check = |text: &str, from: &str, to: &str, part: &str| {
            assert!(text.contains(from), "{from}");
            let problem = read(&text.replace(from, to)).unwrap_err();
            assert!(problem.contains(part), "`{part}` is not in: {problem}");
        };
        check(KALIBR, "pinhole", "omni", "`camera_model` is omni");
        check(KALIBR, "[461.629, ", "[", "[fx, fy, cx, cy]");
        check(KALIBR, "461.629", "abc", "[fx, fy, cx, cy]");
        check(KALIBR, "resolution: [752, 480]", "", "`resolution` is missing");
        check(KALIBR, ", 0.0004]", "]", "k1, k2, k3, k4");
        check(OPENCV, "image_height: 480", "", "`image_height` is missing");
        check(OPENCV, "2. ]", "2., 0., 0., 0., 1., 0., 0., 0. ]", "thin prism");
    }

    #[test]
    fn other_files_are_refused() {
        let check = |text: &str, part: &str| {
            let problem = read(text).unwrap_err();
            assert!(problem.contains(part), "`{part}` is not in: {problem}");
        };
        check("", "not a list of keys");
        check("a: [1", "not valid YAML");
        check("a: 1", "none of the keys");
        check("<?xml version=\"1.0\"?><opencv_storage/>", "is not valid XML");
        let missing = read_calibration(Path::new("no/such.yaml")).unwrap_err().to_string();
        assert!(missing.contains("no/such.yaml"), "{missing}");
        let binary = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(binary.path(), [0xff, 0xfe, 0x00]).unwrap();
        assert!(read_calibration(binary.path()).unwrap_err().to_string().contains("is not text"));
    }

    #[test]
    fn published_calibrations_of_real_cameras_are_read() {
        let Some(folder) = testing::recording("photos/groundtruth") else { return };
        let rows = [
            ("wykrichard__opencv/left_intrinsics.yml", 535.915_733_961_632),
            ("opencv__opencv_contrib/tutorial_camera_charuco.yml", 452.510_722_196_376_7),
        ];
        for (name, fx) in rows {
            let camera = read_calibration(&folder.join(name)).unwrap();
            assert_eq!((camera.fx, camera.width, camera.height), (fx, 640, 480));
        }
    }
}
