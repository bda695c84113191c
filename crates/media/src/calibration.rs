//! Calibration files of other programs: their intrinsics as a camera model.
//!
//! Three formats are read and distinguished by their keys: ROS `camera_info` (`camera_matrix` or `K`, with
//! `image_width`), Kalibr's camera chain (`cam0` with `intrinsics`), and OpenCV's `FileStorage`
//! (`camera_matrix` of type `opencv-matrix`). In all of them the centre of the top-left pixel is (0, 0), as
//! in this project.

use std::path::{Path, PathBuf};

use geometry::{CameraModel, Distortion};
use serde_yaml_ng::Value;

/// Maximum size of a calibration file, in bytes.
const MAX_FILE_BYTES: u64 = 1 << 20;
/// Maximum edge of an image, in pixels.
const MAX_EDGE_PX: f64 = 65_535.0;
/// Maximum focal length, in pixels.
const MAX_FOCAL_PX: f64 = 1e6;

/// Keys that different programs use for the same value; messages name the first.
const MATRIX: &[&str] = &["camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "k"];
const COEFFICIENTS: &[&str] =
    &["distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "D", "d"];
const WIDTH: &[&str] = &["image_width", "image_Width", "width"];
const HEIGHT: &[&str] = &["image_height", "image_Height", "height"];

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
         camchain (with `cam0`) or OpenCV FileStorage YAML (with `camera_matrix`)"
    )]
    Form {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// A key that is missing or has an invalid value.
    #[error("the calibration {path:?}: `{key}` {problem}; {expected}")]
    Key {
        /// The file.
        path: PathBuf,
        /// The key.
        key: String,
        /// What is wrong with it.
        problem: String,
        /// What it must be.
        expected: &'static str,
    },
}

/// A problem with a key, before the file's name is added.
#[derive(Debug)]
struct Problem {
    key: String,
    problem: String,
    expected: &'static str,
}

/// The intrinsics in a calibration file: ROS `camera_info` YAML, the first camera of a Kalibr camchain
/// (pinhole with radtan, equidistant or no distortion), or OpenCV `FileStorage` YAML.
///
/// # Errors
/// [`CalibrationError`] names the file, the key and the expected value.
pub fn read_calibration(path: &Path) -> Result<CameraModel, CalibrationError> {
    let path = || path.to_owned();
    let unreadable = |cause| CalibrationError::Unreadable { path: path(), cause };
    let metadata = std::fs::metadata(path()).map_err(unreadable)?;
    let form = |problem: String| CalibrationError::Form { path: path(), problem };
    if !metadata.is_file() || metadata.len() > MAX_FILE_BYTES {
        return Err(form(format!("is not a file of at most {MAX_FILE_BYTES} bytes")));
    }
    let bytes = std::fs::read(path()).map_err(unreadable)?;
    let text = String::from_utf8(bytes).map_err(|_cause| form("is not text".to_owned()))?;
    let root = parse(&text).map_err(form)?;
    let model = if let Some(camera) = root.get("cam0") {
        kalibr(camera)
    } else if root.get("intrinsics").is_some() && root.get("camera_model").is_some() {
        kalibr(&root)
    } else if find(&root, MATRIX).is_some() {
        matrix_form(&root)
    } else {
        return Err(form("has none of the keys of a calibration".to_owned()));
    };
    model.map_err(|Problem { key, problem, expected }| CalibrationError::Key {
        path: path(),
        key,
        problem,
        expected,
    })
}

fn parse(text: &str) -> Result<Value, String> {
    let text = text.trim_start_matches('\u{feff}');
    if text.trim_start().starts_with('<') {
        return Err(
            "is XML; save it as YAML instead (in OpenCV, by a name that ends in .yaml)".to_owned()
        );
    }
    // OpenCV writes a directive and a type tag that are not valid YAML.
    let body = match text.strip_prefix("%YAML") {
        Some(rest) => rest.split_once('\n').map_or("", |(_, body)| body),
        None => text,
    };
    let root: Value = serde_yaml_ng::from_str(&body.replace("!!opencv-matrix", ""))
        .map_err(|cause| format!("is not valid YAML: {cause}"))?;
    if root.is_mapping() { Ok(root) } else { Err("is not a list of keys and values".to_owned()) }
}

/// Kalibr's `camchain.yaml`, one camera.
fn kalibr(camera: &Value) -> Result<CameraModel, Problem> {
    if let Some(model) = camera.get("camera_model")
        && model.as_str() != Some("pinhole")
    {
        return Err(Problem {
            key: "camera_model".to_owned(),
            problem: format!("is {}", short(model)),
            expected: "it must be `pinhole`",
        });
    }
    let expected = "it must be the list [fx, fy, cx, cy] in pixels";
    let (key, value) = required(camera, &["intrinsics"], expected)?;
    let &[fx, fy, cx, cy] = numbers(key, value, expected)?.as_slice() else {
        return Err(wrong(key, value, expected));
    };
    let expected = "it must be the list [width, height] in pixels";
    let (key, value) = required(camera, &["resolution"], expected)?;
    let &[width, height] = numbers(key, value, expected)?.as_slice() else {
        return Err(wrong(key, value, expected));
    };
    let size = [edge("resolution", width)?, edge("resolution", height)?];
    let coefficients = coefficients(camera, &["distortion_coeffs"])?;
    let name = camera.get("distortion_model").and_then(Value::as_str).unwrap_or("none");
    let distortion = distortion("distortion_model", name, "distortion_coeffs", &coefficients)?;
    checked("intrinsics", size, [fx, fy, cx, cy], distortion)
}

/// The format of ROS and OpenCV: a 3 x 3 matrix, a list of coefficients, a size.
fn matrix_form(root: &Value) -> Result<CameraModel, Problem> {
    let expected = "it must hold the 9 numbers fx, 0, cx, 0, fy, cy, 0, 0, 1";
    let (key, value) = required(root, MATRIX, expected)?;
    let &[fx, skew, cx, zero, fy, cy, zero_x, zero_y, one] =
        numbers(key, value, expected)?.as_slice()
    else {
        return Err(wrong(key, value, expected));
    };
    let rest = [skew, zero, zero_x, zero_y, one - 1.0];
    // A skew of less than a millionth of the focal length moves no pixel of any image.
    if rest.iter().any(|r| r.abs() > 1e-6 * fx.abs().max(1.0)) {
        return Err(wrong(key, value, expected));
    }
    let size = size(root)?;
    let coefficients = coefficients(root, COEFFICIENTS)?;
    let distortion_key = find(root, COEFFICIENTS).map_or(COEFFICIENTS[0], |(key, _)| key);
    let is_fisheye = root.get("fisheye_model").and_then(Value::as_i64) == Some(1);
    let name = match root.get("distortion_model").and_then(Value::as_str) {
        Some(name) => name,
        None if is_fisheye => "fisheye",
        None if coefficients.is_empty() => "none",
        None => "plumb_bob",
    };
    let distortion = distortion("distortion_model", name, distortion_key, &coefficients)?;
    checked(key, size, [fx, fy, cx, cy], distortion)
}

fn size(root: &Value) -> Result<[u32; 2], Problem> {
    if let Some(value) = root.get("image_size") {
        let expected = "it must be the list [width, height] in pixels";
        let &[width, height] = numbers("image_size", value, expected)?.as_slice() else {
            return Err(wrong("image_size", value, expected));
        };
        return Ok([edge("image_size", width)?, edge("image_size", height)?]);
    }
    let one = |names: &'static [&'static str]| {
        let expected = "it must be the image's edge in pixels, from 1 to 65535";
        let (key, value) = required(root, names, expected)?;
        edge(key, number(value).ok_or_else(|| wrong(key, value, expected))?)
    };
    Ok([one(WIDTH)?, one(HEIGHT)?])
}

fn edge(key: &str, px: f64) -> Result<u32, Problem> {
    if px.fract() == 0.0 && (1.0..=MAX_EDGE_PX).contains(&px) {
        return Ok(px as u32);
    }
    Err(Problem {
        key: key.to_owned(),
        problem: format!("is {px}"),
        expected: "it must be whole numbers of pixels from 1 to 65535",
    })
}

fn coefficients(root: &Value, names: &'static [&'static str]) -> Result<Vec<f64>, Problem> {
    match find(root, names) {
        None | Some((_, Value::Null)) => Ok(Vec::new()),
        Some((key, value)) => numbers(key, value, "it must be a list of numbers"),
    }
}

fn distortion(
    name_key: &str,
    name: &str,
    key: &str,
    coefficients: &[f64],
) -> Result<Distortion, Problem> {
    let all_zero = coefficients.iter().all(|c| *c == 0.0);
    match name {
        "none" | "" if all_zero => Ok(Distortion::None),
        "radtan" | "plumb_bob" | "rational_polynomial" if coefficients.is_empty() => {
            Ok(Distortion::None)
        }
        "radtan" | "plumb_bob" | "rational_polynomial" | "none" | "" => {
            brown_conrady(key, coefficients)
        }
        "equidistant" | "fisheye" => {
            let k: [f64; 4] = coefficients.try_into().map_err(|_cause| Problem {
                key: key.to_owned(),
                problem: format!("has {} numbers", coefficients.len()),
                expected: "a fisheye lens has the four coefficients k1, k2, k3, k4",
            })?;
            Ok(Distortion::KannalaBrandt(k))
        }
        other => Err(Problem {
            key: name_key.to_owned(),
            problem: format!("is `{other}`"),
            expected: "it must be one of none, radtan, plumb_bob, rational_polynomial, equidistant, fisheye",
        }),
    }
}

/// OpenCV's order k1, k2, p1, p2, k3, k4, k5, k6. Coefficients of a thin prism or a tilted sensor must be
/// zero.
fn brown_conrady(key: &str, coefficients: &[f64]) -> Result<Distortion, Problem> {
    let beyond = coefficients.iter().skip(8).any(|c| *c != 0.0);
    if !matches!(coefficients.len(), 4 | 5 | 8 | 12 | 14) || beyond {
        let problem = format!("has {} numbers", coefficients.len());
        let expected = "it must be k1, k2, p1, p2, optionally k3, or k3 to k6 (a thin prism or tilted sensor is not modelled)";
        return Err(Problem { key: key.to_owned(), problem, expected });
    }
    let mut k = [0.0; 8];
    for (slot, value) in k.iter_mut().zip(coefficients) {
        *slot = *value;
    }
    Ok(if k == [0.0; 8] { Distortion::None } else { Distortion::BrownConrady(k) })
}

fn checked(
    key: &str,
    size: [u32; 2],
    intrinsics: [f64; 4],
    distortion: Distortion,
) -> Result<CameraModel, Problem> {
    let [fx, fy, cx, cy] = intrinsics;
    for (name, focal) in [("fx", fx), ("fy", fy)] {
        if !(focal > 0.0 && focal <= MAX_FOCAL_PX) {
            let problem = format!("has {name} = {focal}");
            let expected = "focal lengths must be above 0 and at most 1e6 pixels";
            return Err(Problem { key: key.to_owned(), problem, expected });
        }
    }
    Ok(CameraModel { width: size[0], height: size[1], fx, fy, cx, cy, distortion })
}

fn find<'a>(root: &'a Value, names: &'static [&'static str]) -> Option<(&'static str, &'a Value)> {
    names.iter().find_map(|name| root.get(name).map(|value| (*name, value)))
}

fn required<'a>(
    root: &'a Value,
    names: &'static [&'static str],
    expected: &'static str,
) -> Result<(&'static str, &'a Value), Problem> {
    find(root, names).ok_or_else(|| Problem {
        key: names.first().copied().unwrap_or_default().to_owned(),
        problem: "is missing".to_owned(),
        expected,
    })
}

/// The finite numbers of a list, of a list of lists, or of the `data` of a matrix.
fn numbers(key: &str, value: &Value, expected: &'static str) -> Result<Vec<f64>, Problem> {
    let list = match value.get("data") {
        Some(data) if value.is_mapping() => data,
        _ => value,
    };
    let mut flat = Vec::new();
    let items = list.as_sequence().ok_or_else(|| wrong(key, value, expected))?;
    for item in items {
        match item.as_sequence() {
            Some(row) => flat.extend(row),
            None => flat.push(item),
        }
    }
    let one = |item: &&Value| number(item).filter(|n| n.is_finite());
    flat.iter().map(one).collect::<Option<Vec<f64>>>().ok_or_else(|| wrong(key, list, expected))
}

/// A number, also as C programs write it and YAML reads as text (`1.`, `.5e-3`).
fn number(value: &Value) -> Option<f64> {
    value.as_f64().or_else(|| value.as_str().and_then(|text| text.parse().ok()))
}

fn wrong(key: &str, value: &Value, expected: &'static str) -> Problem {
    Problem { key: key.to_owned(), problem: format!("is {}", short(value)), expected }
}

/// A value as it stands in the file, cut to 60 characters.
fn short(value: &Value) -> String {
    let text = serde_yaml_ng::to_string(value).unwrap_or_default();
    let line = text.split_whitespace().collect::<Vec<_>>().join(" ");
    match line.char_indices().nth(60) {
        Some((end, _)) => format!("{}...", &line[..end]),
        None => line,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
        check("<?xml version=\"1.0\"?><opencv_storage/>", "is XML");
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
