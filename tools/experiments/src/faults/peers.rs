//! What lying, babbling and shouting detectors and cameras publish.

use geometry::{Body, Camera, Rotation, Transform, Vector};
use messages::{CameraInfo, Detections};

use super::kind::LIAR;

/// How far beside its place a liar puts the marker, in metres.
const LIE_M: f64 = 1.0;
/// How fast a drifting liar gets there, in m/s.
const DRIFT_M_S: f64 = 0.05;
/// Distance from the marker at which the crowd sees its own, in metres.
const CROWD_M: f64 = 2.0;
/// How far another camera's mount is turned, in radians.
const STRANGE_ROLL_RAD: f64 = 0.3;

/// What a preferred detector does.
#[derive(Copy, Clone, Debug, PartialEq)]
pub enum Lie {
    /// It says what it sees.
    None,
    /// It is off, from one frame to the next.
    Jumps,
    /// It has drifted for this time, in seconds.
    Drifts(f64),
    /// It finds nothing.
    Blind,
}

/// The message of the preferred detector that lies, from what an honest one has found.
pub fn liar(honest: &Detections, lie: Lie) -> Detections {
    let mut message = Detections { detector: LIAR.to_owned(), ..honest.clone() };
    match lie {
        Lie::None => {}
        Lie::Jumps => shift(&mut message, LIE_M),
        Lie::Drifts(for_s) => shift(&mut message, (DRIFT_M_S * for_s).min(LIE_M)),
        Lie::Blind => message.detections.clear(),
    }
    message
}

/// The message of one of the crowd.
pub fn stranger(honest: &Detections, name: &str, number: usize) -> Detections {
    let mut message = Detections { detector: name.to_owned(), ..honest.clone() };
    shift(&mut message, if number.is_multiple_of(2) { CROWD_M } else { -CROWD_M });
    message
}

/// Moves the marker in the picture's plane.
fn shift(message: &mut Detections, metres: f64) {
    for detection in &mut message.detections {
        if let Some(pose) = &mut detection.pose {
            pose.camera_from_marker.translation_m[0] += metres;
        }
    }
}

/// Detections whose poses no marker has; `number` chooses among them.
pub fn babble(honest: &Detections, number: u64) -> Detections {
    let mut message = honest.clone();
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
pub fn strange_camera(info: &CameraInfo) -> CameraInfo {
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
