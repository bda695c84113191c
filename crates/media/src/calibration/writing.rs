//! Writes a camera model as a calibration file of ROS, Kalibr or OpenCV (YAML, XML or JSON), with its mode on the sensor and
//! a note of how it was calibrated.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use geometry::{CameraModel, Distortion};

use super::mode::{SensorMode, SensorRegion};
use crate::atomic::write_atomically;

/// A format of calibration files.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum CalibrationFormat {
    /// ROS `camera_info` as YAML.
    Ros,
    /// Kalibr's camera chain with one camera.
    Kalibr,
    /// OpenCV's `FileStorage`: as XML or JSON when the name ends so, else as YAML.
    OpenCv,
}

/// Details stored next to the camera model.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CalibrationDetails {
    /// How the images come from the sensor; `None` where they are the whole sensor's.
    pub sensor: Option<OnSensor>,
    /// A note about the calibration, under a key that other programs ignore.
    pub note: Option<CalibrationNote>,
}

/// A mode on a sensor.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct OnSensor {
    /// Width and height of the sensor.
    pub sensor_px: [u32; 2],
    /// The mode.
    pub mode: SensorMode,
}

/// The origin of a calibration and its uncertainty.
#[derive(Clone, Debug, PartialEq)]
pub struct CalibrationNote {
    /// When it was made.
    pub made: String,
    /// From how many images.
    pub views: usize,
    /// Standard deviation of the points along each axis, in pixels.
    pub noise_px: f64,
    /// Root mean square of the residuals, in pixels.
    pub rms_px: f64,
    /// One standard deviation of the projection, that 95 % of the image where it is known do not exceed, in pixels.
    pub uncertainty_px: f64,
}

/// Why a calibration was not written.
#[derive(Debug, thiserror::Error)]
pub enum CalibrationWriteError {
    /// The system does not write the file.
    #[error("writing the calibration {path:?}: {cause}")]
    Unwritable {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        cause: std::io::Error,
    },
    /// The format has no room for this lens.
    #[error(
        "a Kalibr camchain holds k1, k2, p1, p2 of Brown-Conrady, and this lens has more numbers: write ROS or OpenCV, or calibrate \
         with four numbers or Kannala-Brandt"
    )]
    Lens,
    /// An ending that only files of OpenCV have.
    #[error(
        "{path:?}: files of ROS and Kalibr are YAML: let its name end in .yaml, or write OpenCV"
    )]
    Ending {
        /// The file.
        path: PathBuf,
    },
    /// A mode that does not give these images.
    #[error(
        "{} of a sensor of {} x {} pixels, binned by {}, gives no images of {image_width} x {image_height}: correct the sensor's \
         size, region or binning",
        sensor.mode.region, sensor.sensor_px[0], sensor.sensor_px[1], sensor.mode.binning
    )]
    Mode {
        /// The mode.
        sensor: OnSensor,
        /// The images' width.
        image_width: u32,
        /// The images' height.
        image_height: u32,
    },
}

/// A value of a file.
enum Entry {
    Whole(u32),
    Real(f64),
    Text(String),
    Wholes(Vec<u32>),
    Reals(Vec<f64>),
    Matrix { columns: usize, data: Vec<f64> },
    Keys(Vec<(&'static str, Entry)>),
}

type Entries = Vec<(&'static str, Entry)>;

/// How a text is written.
#[derive(Copy, Clone, PartialEq, Eq)]
enum Syntax {
    Yaml,
    /// With OpenCV's tags of matrices.
    OpenCvYaml,
    Xml,
    Json,
}

/// Writes a camera in a format; an existing file is replaced only by a complete one.
///
/// # Errors
/// [`CalibrationWriteError`] where the format cannot hold the lens, the mode does not give such images, or the file cannot be
/// written.
pub fn write_calibration(
    path: &Path,
    camera: &CameraModel,
    format: CalibrationFormat,
    details: &CalibrationDetails,
) -> Result<(), CalibrationWriteError> {
    let extension = path.extension().and_then(|it| it.to_str()).unwrap_or_default();
    let syntax = match (format, extension.to_ascii_lowercase().as_str()) {
        (CalibrationFormat::OpenCv, "xml") => Syntax::Xml,
        (CalibrationFormat::OpenCv, "json") => Syntax::Json,
        (CalibrationFormat::OpenCv, _) => Syntax::OpenCvYaml,
        (CalibrationFormat::Ros | CalibrationFormat::Kalibr, "xml" | "json") => {
            return Err(CalibrationWriteError::Ending { path: path.to_owned() });
        }
        (CalibrationFormat::Ros | CalibrationFormat::Kalibr, _) => Syntax::Yaml,
    };
    let text = syntax.text(&entries(camera, format, details)?);
    write_atomically(path, text.as_bytes())
        .map_err(|cause| CalibrationWriteError::Unwritable { path: path.to_owned(), cause })
}

fn entries(
    camera: &CameraModel,
    format: CalibrationFormat,
    details: &CalibrationDetails,
) -> Result<Entries, CalibrationWriteError> {
    if let Some(sensor) = details.sensor {
        sensor.check([camera.width, camera.height])?;
    }
    match format {
        CalibrationFormat::Ros => Ok(ros(camera, details)),
        CalibrationFormat::Kalibr => {
            let mut entries = kalibr(camera)?;
            entries.extend(own_entries(details, details.sensor));
            Ok(vec![("cam0", Entry::Keys(entries))])
        }
        CalibrationFormat::OpenCv => {
            let mut entries = open_cv(camera);
            entries.extend(own_entries(details, details.sensor));
            Ok(entries)
        }
    }
}

impl OnSensor {
    /// Whether images of this size come from the sensor in this mode.
    ///
    /// # Errors
    /// [`CalibrationWriteError::Mode`] with the sizes.
    pub fn check(&self, image_px: [u32; 2]) -> Result<(), CalibrationWriteError> {
        let sensor = SensorRegion::whole(self.sensor_px[0], self.sensor_px[1]);
        if super::fields::is_possible(&self.mode, &sensor) && self.mode.image_px() == image_px {
            return Ok(());
        }
        let [image_width, image_height] = image_px;
        Err(CalibrationWriteError::Mode { sensor: *self, image_width, image_height })
    }
}

/// Entries that other programs ignore; the mode where the format has no keys for it.
fn own_entries(
    details: &CalibrationDetails,
    sensor: Option<OnSensor>,
) -> Option<(&'static str, Entry)> {
    let mut own = Vec::new();
    if let Some(OnSensor { sensor_px, mode: SensorMode { region, binning } }) = sensor {
        own.push(("sensor", Entry::Wholes(sensor_px.to_vec())));
        let region = vec![region.left, region.top, region.width, region.height];
        own.push(("region", Entry::Wholes(region)));
        own.push(("binning", Entry::Whole(binning)));
    }
    if let Some(note) = &details.note {
        let is_plain = |c: &char| c.is_ascii_alphanumeric() || " -+:.".contains(*c);
        own.push(("made", Entry::Text(note.made.chars().filter(is_plain).collect())));
        own.push(("views", Entry::Whole(note.views.try_into().unwrap_or(u32::MAX))));
        own.push(("noise_px", Entry::Real(note.noise_px)));
        own.push(("rms_px", Entry::Real(note.rms_px)));
        own.push(("uncertainty_px", Entry::Real(note.uncertainty_px)));
    }
    (!own.is_empty()).then_some(("alight", Entry::Keys(own)))
}

/// A lens as OpenCV and ROS write it.
struct Coefficients {
    ros_model: &'static str,
    values: Vec<f64>,
}

fn coefficients(distortion: &Distortion) -> Coefficients {
    match distortion {
        Distortion::None => Coefficients { ros_model: "plumb_bob", values: vec![0.0; 5] },
        Distortion::BrownConrady([head @ .., k4, k5, k6]) if [*k4, *k5, *k6] == [0.0; 3] => {
            Coefficients { ros_model: "plumb_bob", values: head.to_vec() }
        }
        Distortion::BrownConrady(k) => {
            Coefficients { ros_model: "rational_polynomial", values: k.to_vec() }
        }
        Distortion::KannalaBrandt(k) => {
            Coefficients { ros_model: "equidistant", values: k.to_vec() }
        }
    }
}

fn matrix(camera: &CameraModel) -> Entry {
    let CameraModel { fx, fy, cx, cy, .. } = *camera;
    Entry::Matrix { columns: 3, data: vec![fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0] }
}

/// ROS has the whole sensor's matrix and size, and binning and region in addition.
fn ros(image: &CameraModel, details: &CalibrationDetails) -> Entries {
    let camera = match details.sensor {
        Some(OnSensor { sensor_px, mode }) => mode.of_sensor(image, sensor_px),
        None => *image,
    };
    let lens = coefficients(&camera.distortion);
    let CameraModel { fx, fy, cx, cy, .. } = camera;
    let projection = vec![fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0];
    let identity = vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    let mut entries = vec![
        ("image_width", Entry::Whole(camera.width)),
        ("image_height", Entry::Whole(camera.height)),
        ("camera_name", Entry::Text("camera".to_owned())),
        ("camera_matrix", matrix(&camera)),
        ("distortion_model", Entry::Text(lens.ros_model.to_owned())),
        (
            "distortion_coefficients",
            Entry::Matrix { columns: lens.values.len(), data: lens.values },
        ),
        ("rectification_matrix", Entry::Matrix { columns: 3, data: identity }),
        ("projection_matrix", Entry::Matrix { columns: 4, data: projection }),
    ];
    if let Some(OnSensor { mode: SensorMode { region, binning }, .. }) = details.sensor {
        let roi = vec![
            ("x_offset", Entry::Whole(region.left)),
            ("y_offset", Entry::Whole(region.top)),
            ("width", Entry::Whole(region.width)),
            ("height", Entry::Whole(region.height)),
        ];
        entries.push(("binning_x", Entry::Whole(binning)));
        entries.push(("binning_y", Entry::Whole(binning)));
        entries.push(("roi", Entry::Keys(roi)));
    }
    entries.extend(own_entries(details, None));
    entries
}

fn kalibr(camera: &CameraModel) -> Result<Entries, CalibrationWriteError> {
    let (model, values) = match camera.distortion {
        Distortion::None => ("none", Vec::new()),
        Distortion::BrownConrady([head @ .., k3, k4, k5, k6]) => {
            if [k3, k4, k5, k6] != [0.0; 4] {
                return Err(CalibrationWriteError::Lens);
            }
            ("radtan", head.to_vec())
        }
        Distortion::KannalaBrandt(k) => ("equidistant", k.to_vec()),
    };
    let CameraModel { width, height, fx, fy, cx, cy, .. } = *camera;
    Ok(vec![
        ("camera_model", Entry::Text("pinhole".to_owned())),
        ("distortion_coeffs", Entry::Reals(values)),
        ("distortion_model", Entry::Text(model.to_owned())),
        ("intrinsics", Entry::Reals(vec![fx, fy, cx, cy])),
        ("resolution", Entry::Wholes(vec![width, height])),
    ])
}

fn open_cv(camera: &CameraModel) -> Entries {
    let lens = coefficients(&camera.distortion);
    let is_fisheye = u32::from(matches!(camera.distortion, Distortion::KannalaBrandt(_)));
    vec![
        ("image_width", Entry::Whole(camera.width)),
        ("image_height", Entry::Whole(camera.height)),
        ("fisheye_model", Entry::Whole(is_fisheye)),
        ("camera_matrix", matrix(camera)),
        (
            "distortion_coefficients",
            Entry::Matrix { columns: lens.values.len(), data: lens.values },
        ),
    ]
}

impl Syntax {
    fn text(self, entries: &Entries) -> String {
        match self {
            Self::Yaml => self.yaml(entries, 0),
            Self::OpenCvYaml => format!("%YAML:1.0\n---\n{}", self.yaml(entries, 0)),
            Self::Xml => {
                format!(
                    "<?xml version=\"1.0\"?>\n<opencv_storage>\n{}</opencv_storage>\n",
                    xml(entries)
                )
            }
            Self::Json => format!("{}\n", json(entries, 1)),
        }
    }

    fn yaml(self, entries: &Entries, depth: usize) -> String {
        let mut text = String::new();
        let indent = "   ".repeat(depth);
        for (key, entry) in entries {
            let value = match entry {
                Entry::Keys(entries) => format!("\n{}", self.yaml(entries, depth + 1)),
                Entry::Matrix { columns, data } => {
                    let (tag, kind) = match self {
                        Self::OpenCvYaml => (" !!opencv-matrix", format!("{indent}   dt: d\n")),
                        _ => ("", String::new()),
                    };
                    let rows = data.len() / (*columns).max(1);
                    format!(
                        "{tag}\n{indent}   rows: {rows}\n{indent}   cols: {columns}\n{kind}{indent}   data: [{}]\n",
                        joined(data, ", ")
                    )
                }
                Entry::Text(text) if text.contains(':') => format!(" \"{text}\"\n"),
                Entry::Text(text) => format!(" {text}\n"),
                other => format!(" {}\n", other.plain()),
            };
            // Writing to a string cannot fail.
            let _ = write!(text, "{indent}{key}:{value}");
        }
        text
    }
}

fn xml(entries: &Entries) -> String {
    let mut text = String::new();
    for (key, entry) in entries {
        let _ = match entry {
            Entry::Keys(entries) => write!(text, "<{key}>\n{}</{key}>\n", xml(entries)),
            Entry::Matrix { columns, data } => write!(
                text,
                "<{key} type_id=\"opencv-matrix\">\n  <rows>{}</rows>\n  <cols>{columns}</cols>\n  <dt>d</dt>\n  <data>\n    \
                 {}</data></{key}>\n",
                data.len() / (*columns).max(1),
                joined(data, " ")
            ),
            Entry::Text(value) => writeln!(text, "<{key}>\"{value}\"</{key}>"),
            Entry::Reals(values) => write!(text, "<{key}>\n  {}</{key}>\n", joined(values, " ")),
            Entry::Wholes(values) => {
                let words: Vec<String> = values.iter().map(u32::to_string).collect();
                write!(text, "<{key}>\n  {}</{key}>\n", words.join(" "))
            }
            other => writeln!(text, "<{key}>{}</{key}>", other.plain()),
        };
    }
    text
}

fn json(entries: &Entries, depth: usize) -> String {
    let indent = "    ".repeat(depth);
    let one = |(key, entry): &(&'static str, Entry)| {
        let value = match entry {
            Entry::Keys(entries) => json(entries, depth + 1),
            Entry::Matrix { columns, data } => format!(
                "{{ \"type_id\": \"opencv-matrix\", \"rows\": {}, \"cols\": {columns}, \"dt\": \"d\", \"data\": [{}] }}",
                data.len() / (*columns).max(1),
                joined(data, ", ")
            ),
            Entry::Text(text) => format!("\"{text}\""),
            other => other.plain(),
        };
        format!("{indent}\"{key}\": {value}")
    };
    let lines: Vec<String> = entries.iter().map(one).collect();
    format!("{{\n{}\n{}}}", lines.join(",\n"), "    ".repeat(depth.saturating_sub(1)))
}

impl Entry {
    /// A number or a list of them, as YAML and JSON have it.
    fn plain(&self) -> String {
        match self {
            Self::Whole(value) => value.to_string(),
            Self::Real(value) => number(*value),
            Self::Text(text) => text.clone(),
            Self::Wholes(values) => format!("{values:?}"),
            Self::Reals(values) | Self::Matrix { data: values, .. } => {
                format!("[{}]", joined(values, ", "))
            }
            Self::Keys(_) => String::new(),
        }
    }
}

fn joined(values: &[f64], separator: &str) -> String {
    values.iter().map(|value| number(*value)).collect::<Vec<_>>().join(separator)
}

/// The shortest text that reads back as the same number, with the point and the sign of the exponent that YAML 1.1 requires
/// for: without them Python reads text.
fn number(value: f64) -> String {
    let text = format!("{value:?}");
    match text.split_once('e') {
        None => text,
        Some((digits, exponent)) => {
            let point = if digits.contains('.') { "" } else { ".0" };
            let sign = if exponent.starts_with('-') { "" } else { "+" };
            format!("{digits}{point}e{sign}{exponent}")
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::CalibrationFile;
    use super::*;
    use proptest::prelude::*;

    fn camera(distortion: Distortion, numbers: [f64; 4]) -> CameraModel {
        let [fx, fy, cx, cy] = numbers;
        CameraModel { width: 1280, height: 960, fx, fy, cx, cy, distortion }
    }

    fn note() -> CalibrationNote {
        CalibrationNote {
            made: "2026-01-02T03:04:05Z".into(),
            views: 40,
            noise_px: 0.05,
            rms_px: 1e-7,
            uncertainty_px: 0.1,
        }
    }

    /// In each of the syntaxes of a format.
    fn read_back(
        camera: &CameraModel,
        format: CalibrationFormat,
        sensor: Option<OnSensor>,
    ) -> Vec<CalibrationFile> {
        let details = CalibrationDetails { sensor, note: Some(note()) };
        let endings: &[&str] = match format {
            CalibrationFormat::OpenCv => &[".yaml", ".xml", ".json"],
            _ => &[".yaml"],
        };
        let folder = tempfile::tempdir().unwrap();
        let read = |ending: &&str| {
            let path = folder.path().join(format!("camera{ending}"));
            write_calibration(&path, camera, format, &details).unwrap();
            CalibrationFile::read(&path).unwrap()
        };
        endings.iter().map(read).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]
        #[test]
        fn a_written_calibration_is_read_back_to_the_bit(
            numbers in proptest::array::uniform4(1e-3..5e3_f64),
            k in proptest::array::uniform8(-0.5..0.5_f64),
            tiny in -12..0_i32,
        ) {
            use CalibrationFormat::{Kalibr, OpenCv, Ros};
            let k = k.map(|k| k * 10_f64.powi(tiny));
            let fisheye = Distortion::KannalaBrandt([k[0], k[1], k[2], k[3]]);
            let four = Distortion::BrownConrady([k[0], k[1], k[2], k[3], 0.0, 0.0, 0.0, 0.0]);
            let five = Distortion::BrownConrady([k[0], k[1], k[2], k[3], k[4], 0.0, 0.0, 0.0]);
            let eight = Distortion::BrownConrady(k);
            for (lens, formats) in [
                (Distortion::None, &[Ros, OpenCv, Kalibr][..]),
                (fisheye, &[Ros, OpenCv, Kalibr]),
                (four, &[Ros, OpenCv, Kalibr]),
                (five, &[Ros, OpenCv]),
                (eight, &[Ros, OpenCv]),
            ] {
                for format in formats {
                    let camera = camera(lens, numbers);
                    for file in read_back(&camera, *format, None) {
                        prop_assert_eq!(file.camera, camera);
                    }
                }
            }
        }
    }

    #[test]
    fn every_format_stores_the_mode() {
        let camera = camera(Distortion::None, [1000.0, 1001.0, 639.0, 480.0]);
        let region = SensorRegion { left: 16, top: 8, width: 2561, height: 1920 };
        let mode = SensorMode { region, binning: 2 };
        let sensor = OnSensor { sensor_px: [2592, 1944], mode };
        for format in [CalibrationFormat::Ros, CalibrationFormat::Kalibr, CalibrationFormat::OpenCv]
        {
            for file in read_back(&camera, format, Some(sensor)) {
                assert_eq!((file.mode, file.sensor_px), (mode, [2592, 1944]), "{format:?}");
                assert_eq!((file.camera, file.calibrated), (camera, region), "{format:?}");
            }
        }
        let wrong = OnSensor { sensor_px: [1280, 960], mode };
        let details = CalibrationDetails { sensor: Some(wrong), note: None };
        let Err(problem) = entries(&camera, CalibrationFormat::Ros, &details) else { panic!() };
        assert!(problem.to_string().contains("correct the sensor's size"), "{problem}");
    }

    #[test]
    fn kalibr_refuses_a_lens_that_it_cannot_hold() {
        let k = Distortion::BrownConrady([0.1, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0]);
        let camera = camera(k, [500.0, 500.0, 320.0, 240.0]);
        let details = CalibrationDetails::default();
        let Err(problem) = entries(&camera, CalibrationFormat::Kalibr, &details) else { panic!() };
        assert!(problem.to_string().contains("write ROS or OpenCV"), "{problem}");
    }

    #[test]
    fn numbers_are_numbers_in_yaml_of_any_version() {
        assert_eq!([1e-7, 2.5e20, 640.0].map(number), ["1.0e-7", "2.5e+20", "640.0"]);
    }
}
