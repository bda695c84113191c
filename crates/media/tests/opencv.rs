//! Tests calibration files between this crate and OpenCV, and by the documented fields of ROS and Kalibr.

use std::path::{Path, PathBuf};

use geometry::{CameraModel, Distortion, Point};
use media::{
    CalibrationDetails, CalibrationFormat, CalibrationNote, read_calibration, write_calibration,
};
use serde_json::{Value, json};

/// Greatest distance between two projections of a point, in pixels.
const MAX_DISTANCE_PX: f64 = 1e-9;

fn cameras() -> Vec<CameraModel> {
    let of = |distortion| CameraModel {
        width: 1288,
        height: 964,
        fx: 1_010.123_456_789_012_3,
        fy: 1_008.5,
        cx: 646.3,
        cy: 471.800_000_000_000_1,
        distortion,
    };
    vec![
        of(Distortion::None),
        of(Distortion::BrownConrady([-0.28, 0.09, 6e-4, -4e-4, 0.0, 0.0, 0.0, 0.0])),
        of(Distortion::BrownConrady([-0.28, 0.09, 6e-4, -1.0 / 3e7, -0.012, 0.0, 0.0, 0.0])),
        of(Distortion::BrownConrady([0.4, 0.2, 1e-3, -7e-5, 0.01, 0.7, 0.25, 0.02])),
        of(Distortion::KannalaBrandt([-0.021, 0.013, -0.004, 1.0 / 3e4])),
    ]
}

/// A thousand points in front of the camera, by two additive sequences that fill the square evenly.
fn points() -> Vec<[f64; 3]> {
    let place = |i: u32| {
        let part = |step: f64| (f64::from(i) * step).fract() - 0.5;
        [1.1 * part(0.754_877_666_2), 0.9 * part(0.569_840_290_9), 1.0]
    };
    (0..1000).map(place).collect()
}

fn lens_numbers(distortion: &Distortion) -> &[f64] {
    match distortion {
        Distortion::None => &[0.0; 4],
        Distortion::BrownConrady(k) => k,
        Distortion::KannalaBrandt(k) => k,
    }
}

/// Infinite where a pixel is missing.
fn greatest_distance_px(camera: &CameraModel, pixels: &Value) -> f64 {
    let distance = |(i, [x, y, z]): (usize, [f64; 3])| {
        let ours = camera.project(Point::new(x, y, z))?;
        let [right, down] = [pixels[i][0].as_f64()?, pixels[i][1].as_f64()?];
        Some((ours.x - right).hypot(ours.y - down))
    };
    let distances = points().into_iter().enumerate().map(distance);
    distances.map(|distance_px| distance_px.unwrap_or(f64::INFINITY)).fold(0.0, f64::max)
}

struct File {
    camera: CameraModel,
    format: CalibrationFormat,
    path: PathBuf,
}

/// Each camera in each format that holds it, in each syntax of that.
fn written_files(folder: &Path) -> Vec<File> {
    use CalibrationFormat::{Kalibr, OpenCv, Ros};
    let note = CalibrationNote {
        made: "2026-01-02T03:04:05Z".into(),
        views: 40,
        noise_px: 0.05,
        rms_px: 1e-7,
        uncertainty_px: 0.1,
    };
    let details = CalibrationDetails { sensor: None, note: Some(note) };
    let mut files = Vec::new();
    for (i, camera) in cameras().into_iter().enumerate() {
        for (format, ending) in
            [(Ros, "yaml"), (Kalibr, "yaml"), (OpenCv, "yaml"), (OpenCv, "xml"), (OpenCv, "json")]
        {
            let path = folder.join(format!("{format:?}-{i}.{ending}"));
            match write_calibration(&path, &camera, format, &details) {
                Ok(()) => files.push(File { camera, format, path }),
                // A camchain has no room for more than four numbers.
                Err(problem) => assert!(format == Kalibr && (i == 2 || i == 3), "{problem}"),
            }
        }
    }
    assert_eq!(files.len(), 23);
    files
}

#[test]
fn opencv_reads_our_files_and_we_its_and_a_thousand_points_agree() {
    let folder = tempfile::tempdir().unwrap();
    let ours = written_files(folder.path());
    let theirs: Vec<(PathBuf, CameraModel)> = ["yaml", "xml", "json"]
        .iter()
        .flat_map(|ending| {
            let named = |(i, camera)| (folder.path().join(format!("theirs-{i}.{ending}")), camera);
            cameras().into_iter().enumerate().map(named).collect::<Vec<_>>()
        })
        .collect();
    let read: Vec<Value> = ours
        .iter()
        .map(|file| json!({ "file": file.path, "format": format!("{:?}", file.format) }))
        .collect();
    let write: Vec<Value> = theirs
        .iter()
        .map(|(path, camera)| {
            let CameraModel { width, height, fx, fy, cx, cy, distortion } = camera;
            json!({
                "file": path, "size": [width, height], "camera": [fx, fy, cx, cy],
                "lens": lens_numbers(distortion),
                "is_fisheye": matches!(distortion, Distortion::KannalaBrandt(_)),
            })
        })
        .collect();
    let task = json!({ "points": points(), "read": read, "write": write });
    let task_path = folder.path().join("task.json");
    std::fs::write(&task_path, task.to_string()).unwrap();
    let answer_path = folder.path().join("answer.json");
    let paths = [&task_path, &answer_path].map(|path| path.to_string_lossy().into_owned());
    let script = "crates/media/tests/opencv/files.py";
    let Some(script) = testing::python(script, &[&paths[0], &paths[1]]) else {
        return;
    };
    let output = script.wait_with_output().unwrap();
    if !testing::python_passes(&output).unwrap() {
        return;
    }
    let answer: Value = serde_json::from_slice(&std::fs::read(&answer_path).unwrap()).unwrap();

    let mut worst_px = 0.0_f64;
    for (file, read) in ours.iter().zip(answer["read"].as_array().unwrap()) {
        assert_eq!(read["size"], json!([1288, 964]), "{:?}", file.path);
        let distance_px = greatest_distance_px(&file.camera, &read["pixels"]);
        assert!(distance_px <= MAX_DISTANCE_PX, "{:?}: {distance_px}", file.path);
        worst_px = worst_px.max(distance_px);
    }
    for ((path, camera), pixels) in theirs.iter().zip(answer["written"].as_array().unwrap()) {
        let held = read_calibration(path).unwrap();
        assert_eq!((held.width, held.height), (camera.width, camera.height));
        let distance_px = greatest_distance_px(&held, pixels);
        assert!(distance_px <= MAX_DISTANCE_PX, "{path:?}: {distance_px}");
        worst_px = worst_px.max(distance_px);
    }
    println!(
        "{} files of ours read by OpenCV, {} of OpenCV's read: 1000 points each, {worst_px:.1e} px apart at most",
        ours.len(),
        theirs.len()
    );
}
