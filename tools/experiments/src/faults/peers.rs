//! Makes the messages of faulty detectors and cameras: wrong, absurd or too many.

use geometry::{Body, Camera, Rotation, Transform, Vector};
use messages::{CameraInfo, Detections};

use super::kind::FAULTY_DETECTOR;

/// Offset of a faulty detector's marker from its position, in metres.
const OFFSET_M: f64 = 1.0;
/// Speed at which a drifting detector reaches it, in m/s.
const DRIFT_M_S: f64 = 0.05;
/// Distance between the marker and that of the unknown detectors, in metres.
const UNKNOWN_M: f64 = 2.0;
/// How far another camera's mount is turned, in radians.
const STRANGE_ROLL_RAD: f64 = 0.3;

/// The behaviour of a preferred detector.
#[derive(Copy, Clone, Debug, PartialEq)]
pub enum Behaviour {
    /// Its detections are correct.
    Correct,
    /// It is off, from one frame to the next.
    Jumps,
    /// It has drifted for this time, in seconds.
    Drifts(f64),
    /// It finds nothing.
    Blind,
}

/// The message of the faulty preferred detector, from a correct one.
pub fn faulty_detector(
    correct: &Detections,
    camera: &CameraInfo,
    behaviour: Behaviour,
) -> Detections {
    let mut message = Detections { detector: FAULTY_DETECTOR.to_owned(), ..correct.clone() };
    match behaviour {
        Behaviour::Correct => {}
        Behaviour::Jumps => shift(&mut message, camera, OFFSET_M),
        Behaviour::Drifts(for_s) => {
            shift(&mut message, camera, (DRIFT_M_S * for_s).min(OFFSET_M));
        }
        Behaviour::Blind => message.detections.clear(),
    }
    message
}

/// The message of one of many unknown detectors.
pub fn unknown_detector(
    correct: &Detections,
    camera: &CameraInfo,
    name: &str,
    number: usize,
) -> Detections {
    let mut message = Detections { detector: name.to_owned(), ..correct.clone() };
    shift(&mut message, camera, if number.is_multiple_of(2) { UNKNOWN_M } else { -UNKNOWN_M });
    message
}

/// Moves the marker in the picture's plane, and its centre with it: a pose that does not agree with its pixel is refused.
fn shift(message: &mut Detections, camera: &CameraInfo, metres: f64) {
    for detection in &mut message.detections {
        if let Some(pose) = &mut detection.pose {
            let place_m = &mut pose.camera_from_marker.translation_m;
            place_m[0] += metres;
            detection.centre_px = camera.pixel_of(*place_m).unwrap_or(detection.centre_px);
        }
    }
}

/// Detections whose poses no marker has; `number` chooses among them.
pub fn babble(correct: &Detections, number: u64) -> Detections {
    let mut message = correct.clone();
    for detection in &mut message.detections {
        let Some(pose) = &mut detection.pose else { continue };
        let translation = &mut pose.camera_from_marker.translation_m;
        match number % 7 {
            0 => *translation = [f64::NAN; 3],
            1 => *translation = [f64::INFINITY, 0.0, 1.0],
            2 => *translation = [1e160, -1e160, 1e160],
            3 => pose.camera_from_marker.rotation_wxyz = [0.0; 4],
            4 => pose.covariance = [-1.0; 21],
            5 => pose.covariance = [f32::MAX; 21],
            _ => translation[2] = -translation[2],
        }
    }
    message
}

/// Another camera's calibration and mount, under the same name.
pub fn other_camera(info: &CameraInfo) -> CameraInfo {
    let mut strange = info.clone();
    strange.focal_px = strange.focal_px.map(|focal| focal.map(|px| 1.5 * px));
    let turned =
        Rotation::<Body, Body>::from_rotation_vector(Vector::new(STRANGE_ROLL_RAD, 0.0, 0.0));
    if let Some(mount) = info.body_from_camera.transform::<Body, Camera>() {
        let mount = Transform::new(turned * mount.rotation(), mount.origin());
        strange.body_from_camera = (&mount).into();
    }
    strange
}
