//! Converts the keys and values of a calibration file of ROS, Kalibr or OpenCV to a camera model and sensor mode, or the key
//! that is wrong.

use geometry::{CameraModel, Distortion};
use serde_yaml_ng::Value;

use super::mode::{MAX_BINNING, SensorMode, SensorRegion};

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

/// A problem with a key, before the file's name is added.
#[derive(Debug)]
pub(super) struct Problem {
    pub(super) key: String,
    pub(super) problem: String,
    pub(super) expected: &'static str,
}

/// The calibration in a file.
pub(super) struct Parsed {
    pub(super) camera: CameraModel,
    pub(super) mode: SensorMode,
    pub(super) sensor_px: [u32; 2],
    pub(super) calibrated: SensorRegion,
}

/// Parses a camera's keys and values; `None` where there are none of the keys of a calibration.
pub(super) fn parse(root: &Value) -> Option<Result<Parsed, Problem>> {
    if let Some(camera) = root.get("cam0") {
        Some(kalibr(camera).and_then(|image| in_noted_mode(camera, image)))
    } else if root.get("intrinsics").is_some() && root.get("camera_model").is_some() {
        Some(kalibr(root).and_then(|image| in_noted_mode(root, image)))
    } else {
        find(root, MATRIX)?;
        let noted = root.get("alight").and_then(|own| own.get("sensor"));
        Some(matrix_form(root).and_then(|camera| match noted {
            Some(_) => in_noted_mode(root, camera),
            None => in_ros_mode(root, camera),
        }))
    }
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
    let is_fisheye = root.get("fisheye_model").and_then(Value::as_i64).map(|model| model == 1);
    let name = match (root.get("distortion_model").and_then(Value::as_str), is_fisheye) {
        (Some(name), _) => name,
        (None, Some(true)) => "fisheye",
        (None, _) if coefficients.is_empty() => "none",
        (None, None) if coefficients.len() == 4 && coefficients.iter().any(|k| *k != 0.0) => {
            return Err(Problem {
                key: distortion_key.to_owned(),
                problem: "has four numbers, and no lens model is stated".to_owned(),
                expected: "add `fisheye_model: 1` for k1, k2, k3, k4 of OpenCV's fisheye, or `fisheye_model: 0` for k1, k2, p1, p2",
            });
        }
        (None, _) => "plumb_bob",
    };
    let distortion = distortion("distortion_model", name, distortion_key, &coefficients)?;
    checked(key, size, [fx, fy, cx, cy], distortion)
}

/// The camera of the images that ROS' `binning_x`, `binning_y` and `roi` describe: the matrix is that of the whole sensor's.
fn in_ros_mode(root: &Value, sensor: CameraModel) -> Result<Parsed, Problem> {
    let expected = "it must be a whole number of pixels, both binnings the same, and the region within the image";
    let px = |at: &Value, key: &str| match at.get(key) {
        None => Ok(0),
        Some(value) => whole_px(value).ok_or_else(|| Problem {
            key: key.to_owned(),
            problem: format!("is {}", short(value)),
            expected,
        }),
    };
    // 0 means 1, and a whole image.
    let [binning, other] = [px(root, "binning_x")?.max(1), px(root, "binning_y")?.max(1)];
    let none = Value::Null;
    let roi = root.get("roi").unwrap_or(&none);
    let [width, height] = [px(roi, "width")?, px(roi, "height")?];
    let whole = SensorRegion::whole(sensor.width, sensor.height);
    let region = SensorRegion {
        left: px(roi, "x_offset")?,
        top: px(roi, "y_offset")?,
        width: if width > 0 { width } else { whole.width },
        height: if height > 0 { height } else { whole.height },
    };
    let mode = SensorMode { region, binning };
    if binning != other || !is_possible(&mode, &whole) {
        return Err(Problem {
            key: "binning_x, binning_y, roi".to_owned(),
            problem: format!(
                "are {binning}, {other}, {region} of {} x {}",
                whole.width, whole.height
            ),
            expected,
        });
    }
    // A file of this program states its part of the sensor; in other files the matrix is that of the whole sensor.
    let calibrated = if root.get("alight").is_some() { region } else { whole };
    let camera = if region == whole && binning == 1 { sensor } else { mode.of_images(&sensor) };
    Ok(Parsed { camera, mode, sensor_px: [sensor.width, sensor.height], calibrated })
}

/// The mode that this program noted next to the intrinsics of images, in formats without keys for it.
fn in_noted_mode(root: &Value, image: CameraModel) -> Result<Parsed, Problem> {
    let whole = SensorRegion::whole(image.width, image.height);
    let none = Value::Null;
    let note = root.get("alight").unwrap_or(&none);
    let Some(sensor) = note.get("sensor") else {
        let mode = SensorMode { region: whole, binning: 1 };
        let sensor_px = [image.width, image.height];
        return Ok(Parsed { camera: image, mode, sensor_px, calibrated: whole });
    };
    let expected = "`sensor` [width, height], `region` [left, top, width, height] and `binning` must give the images' size";
    let problem =
        || Problem { key: "alight".to_owned(), problem: format!("is {}", short(note)), expected };
    let list = |value: Option<&Value>| -> Option<Vec<u32>> {
        value?.as_sequence()?.iter().map(whole_px).collect()
    };
    let &[sensor_width, sensor_height] = list(Some(sensor)).ok_or_else(problem)?.as_slice() else {
        return Err(problem());
    };
    let &[left, top, width, height] = list(note.get("region")).ok_or_else(problem)?.as_slice()
    else {
        return Err(problem());
    };
    let binning = note.get("binning").and_then(whole_px).ok_or_else(problem)?;
    let mode = SensorMode { region: SensorRegion { left, top, width, height }, binning };
    let sensor = SensorRegion::whole(sensor_width, sensor_height);
    if !is_possible(&mode, &sensor) || mode.image_px() != [image.width, image.height] {
        return Err(problem());
    }
    Ok(Parsed {
        camera: image,
        mode,
        sensor_px: [sensor_width, sensor_height],
        calibrated: mode.region,
    })
}

/// Whether a sensor has this mode.
pub(super) fn is_possible(mode: &SensorMode, sensor: &SensorRegion) -> bool {
    (1..=MAX_BINNING).contains(&mode.binning)
        && mode.region.lies_in(sensor)
        && mode.image_px().iter().all(|edge| *edge > 0)
}

fn whole_px(value: &Value) -> Option<u32> {
    number(value)
        .filter(|px| px.fract() == 0.0 && (0.0..=MAX_EDGE_PX).contains(px))
        .map(|px| px as u32)
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

/// A value as in the file, cut to 60 characters.
fn short(value: &Value) -> String {
    let text = serde_yaml_ng::to_string(value).unwrap_or_default();
    let line = text.split_whitespace().collect::<Vec<_>>().join(" ");
    match line.char_indices().nth(60) {
        Some((end, _)) => format!("{}...", &line[..end]),
        None => line,
    }
}
