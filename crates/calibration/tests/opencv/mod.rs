//! Runs OpenCV's calibration of the same points, and the sets of corners in photographs that it found.
#![allow(dead_code, unreachable_pub, reason = "each of those that share this file uses a part")]
#![allow(clippy::expect_used, reason = "missing data fail the test, or the table")]

use calibration::{ImageSize, Lens, Sighting, View};
use geometry::{CameraModel, Distortion, Pixel};
use serde_json::{Value, json};

/// OpenCV's result.
#[derive(Copy, Clone, Debug)]
pub struct Found {
    pub camera: CameraModel,
    pub rms_px: f64,
    pub seconds: f64,
}

/// OpenCV's result; `None`, and a skip, where there is no OpenCV, and `Err` where it fails.
pub fn solve(views: &[View], lens: Lens) -> Option<Result<Found, String>> {
    let name = match lens {
        Lens::BrownConrady4 => "4",
        Lens::BrownConrady5 => "5",
        Lens::BrownConrady8 => "8",
        Lens::KannalaBrandt => "fisheye",
    };
    let size = views.first()?.size;
    let points = |view: &View| -> Vec<[f64; 4]> {
        let row = |p: &Sighting| [p.place_m[0], p.place_m[1], p.seen.x, p.seen.y];
        view.points.iter().map(row).collect()
    };
    let views: Vec<_> = views.iter().map(points).collect();
    let task = json!({ "width": size.width, "height": size.height, "lens": name, "views": views });
    let file = tempfile::NamedTempFile::new().expect("a temporary file");
    std::fs::write(file.path(), task.to_string()).expect("the file was just made");
    let path = file.path().to_string_lossy().into_owned();
    let script = testing::python("crates/calibration/tests/opencv/solve.py", &[&path])?;
    let output = script.wait_with_output().expect("it was started");
    if !testing::python_passes(&output).expect("it ends well or lacks a package") {
        return None;
    }
    let found: Value = serde_json::from_slice(&output.stdout).expect("it prints JSON");
    if let Some(problem) = found["problem"].as_str() {
        return Some(Err(problem.to_owned()));
    }
    let number = |value: &Value| value.as_f64().expect("a number");
    let numbers = |name: &str| found[name].as_array().expect("a list").iter().map(number).collect();
    let (camera, numbers): (Vec<f64>, Vec<f64>) = (numbers("camera"), numbers("lens"));
    let mut k = [0.0; 8];
    k.iter_mut().zip(numbers).for_each(|(k, number)| *k = number);
    let distortion = match lens {
        Lens::KannalaBrandt => Distortion::KannalaBrandt([k[0], k[1], k[2], k[3]]),
        _ => Distortion::BrownConrady(k),
    };
    let [fx, fy, cx, cy] = [camera[0], camera[1], camera[2], camera[3]];
    let camera = CameraModel { width: size.width, height: size.height, fx, fy, cx, cy, distortion };
    Some(Ok(Found { camera, rms_px: number(&found["rms_px"]), seconds: number(&found["seconds"]) }))
}

/// Corners of chessboards in photographs, with the calibration that came with them.
pub struct Photographs {
    pub name: String,
    pub views: Vec<View>,
    pub rms_px: f64,
}

/// The sets of photographs of which enough show a chessboard; none, and a skip, where they are not there.
pub fn photographs() -> Vec<Photographs> {
    let Some(path) = testing::recording("photos/calibrations.json") else { return Vec::new() };
    let text = std::fs::read_to_string(path).expect("the file is there");
    let sets: Vec<Value> = serde_json::from_str(&text).expect("it is JSON");
    let solved = sets.iter().filter(|set| set["rms_px"].is_f64());
    solved.map(|set| read(set).expect("a set has the fields of its neighbours")).collect()
}

fn read(set: &Value) -> Option<Photographs> {
    let (width, height) = set["res"].as_str()?.split_once('x')?;
    let size = ImageSize { width: width.parse().ok()?, height: height.parse().ok()? };
    let columns = set["pattern"][0].as_u64()? as usize;
    let mut views = Vec::new();
    for (name, corners) in set["corners"].as_object()? {
        let corner = |(i, corner): (usize, &Value)| {
            let seen = Pixel::new(corner[0].as_f64()?, corner[1].as_f64()?);
            let place_m = [(i % columns) as f64 * 0.03, (i / columns) as f64 * 0.03];
            Some(Sighting { tag: i as u32, place_m, seen })
        };
        let points = corners.as_array()?.iter().enumerate().map(corner).collect::<Option<_>>()?;
        views.push(View { name: name.clone(), size, points });
    }
    Some(Photographs {
        name: set["repo"].as_str()?.to_owned(),
        views,
        rms_px: set["rms_px"].as_f64()?,
    })
}
