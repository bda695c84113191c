//! Converts between messages, the autopilot's types and the lander's: detections by the camera's mount into
//! the body frame, covariances, phases, vehicle state and status.

use autopilot::VehicleState;
use geometry::{Body, Camera, Marker, Pixel, Rotation, Transform, Vector};
use landing::{Landed, MarkerInFrame, Mode, Timestamp, VehicleStatus};
use messages::{CameraInfo, Detection, MarkerPose, Phase, Transform3};
use nalgebra::Matrix3;

/// Maximum time between attitude and position, in nanoseconds: beyond it one of the two has stopped.
const MAX_SKEW_NS: i64 = 300_000_000;

/// Maximum distance of a marker from the camera, in metres: no lens shows one that is farther away.
const MAX_RANGE_M: f64 = 1e3;

/// Why a detection's numbers are not those of a marker that a camera sees, as the end of a sentence on its detector; `None` for sound ones.
pub fn impossible_because(detection: &Detection) -> Option<String> {
    let Detection { centre_px: [x, y], size_px, confidence, .. } = *detection;
    if [x, y, size_px, confidence].iter().any(|number| !number.is_finite()) {
        return Some(format!(
            "a number is not finite: centre ({x}, {y}) px, size {size_px} px, confidence {confidence}"
        ));
    }
    let pose = detection.pose.as_ref()?.camera_from_marker;
    let [x, y, z] = pose.translation_m;
    let place = format!("({x:.3}, {y:.3}, {z:.3}) m right, down and forward of the camera");
    let range_m = libm::hypot(libm::hypot(x, y), z);
    if !range_m.is_finite() {
        return Some(format!("the marker's place is not finite, {place}"));
    }
    if pose.transform::<Camera, Marker>().is_none() {
        return Some(format!("the marker's rotation is none: w, x, y, z {:?}", pose.rotation_wxyz));
    }
    if z <= 0.0 {
        return Some(format!("the marker would be behind the camera, {place}"));
    }
    (range_m > MAX_RANGE_M)
        .then(|| format!("the marker would be farther away than {MAX_RANGE_M} m, {place}"))
}

/// Where a camera is mounted.
pub fn body_from_camera(info: &CameraInfo) -> Option<Transform<Body, Camera>> {
    info.body_from_camera.transform()
}

/// Converts a detection for the lander.
pub fn marker_in_frame(
    detection: &Detection,
    mount: Option<Transform<Body, Camera>>,
) -> MarkerInFrame {
    let in_body = |pose: &Transform3| -> Option<Transform<Body, Marker>> {
        mount.zip(pose.transform::<Camera, _>()).map(|(mount, pose)| mount * pose)
    };
    let pose = detection.pose.as_ref();
    let [x, y] = detection.centre_px;
    MarkerInFrame {
        centre: Pixel::new(x, y),
        body_from_marker: pose.and_then(|pose| in_body(&pose.camera_from_marker)),
        // A second solution that cannot be is none.
        alternative: pose
            .and_then(|pose| pose.alternative.as_ref())
            .filter(|other| other.camera_from_marker.translation_m[2] > 0.0)
            .and_then(|other| in_body(&other.camera_from_marker)),
        covariance_m2: mount.zip(pose).map(|(mount, pose)| covariance_in_body(&mount, pose)),
        size_px: Some(detection.size_px),
        confidence: detection.confidence,
    }
}

/// Covariance of a marker's position, rotated from the camera's axes to the body's.
fn covariance_in_body(mount: &Transform<Body, Camera>, pose: &MarkerPose) -> Matrix3<f64> {
    let axis = |x, y, z| (mount.rotation() * Vector::<Camera>::new(x, y, z)).coords;
    let turn =
        Matrix3::from_columns(&[axis(1.0, 0.0, 0.0), axis(0.0, 1.0, 0.0), axis(0.0, 0.0, 1.0)]);
    turn * pose.translation_covariance_m2() * turn.transpose()
}

/// The lander's phase as it is sent.
pub fn phase(phase: landing::Phase) -> Phase {
    match phase {
        landing::Phase::Idle => Phase::Idle,
        landing::Phase::Search => Phase::Search,
        landing::Phase::Approach => Phase::Approach,
        landing::Phase::Descend => Phase::Descend,
        landing::Phase::Retry => Phase::Retry,
        landing::Phase::Final => Phase::Final,
        landing::Phase::Landed => Phase::Landed,
        landing::Phase::Hold => Phase::Hold,
        landing::Phase::Aborted => Phase::Aborted,
        landing::Phase::PilotInCommand => Phase::PilotInCommand,
    }
}

/// Converts the vehicle's state for the lander: attitude and position at the time of the newer of the two.
/// `None` when one of the two has stopped (an autopilot without a position estimate still sends its
/// attitude), because it would have to be extrapolated too far.
pub fn vehicle(state: &VehicleState) -> Option<landing::VehicleState> {
    let (attitude, position) = (state.attitude?, state.position?);
    if attitude.stamp_ns.abs_diff(position.stamp_ns) > MAX_SKEW_NS.unsigned_abs() {
        return None;
    }
    let stamp_ns = attitude.stamp_ns.max(position.stamp_ns);
    let since = |ns: i64| (stamp_ns - ns) as f64 * 1e-9;
    let turned = Rotation::from_rotation_vector(attitude.rate_in_body * since(attitude.stamp_ns));
    let VehicleStatus { mode, armed, landed } = vehicle_status(state);
    Some(landing::VehicleState {
        stamp: Timestamp::from_nanos(stamp_ns),
        ned_from_body: attitude.ned_from_body * turned,
        position: position.position + position.velocity * since(position.stamp_ns),
        velocity: position.velocity,
        mode,
        armed,
        landed,
    })
}

/// Mode, motors and contact with the ground for the lander. The mode is known as long as heartbeats come.
pub fn vehicle_status(state: &VehicleState) -> VehicleStatus {
    VehicleStatus {
        mode: match state.mode {
            _ if !state.connected => Mode::Unknown,
            mode if mode.is_guided() => Mode::Guided,
            mode if mode.is_landing() => Mode::Land,
            _ => Mode::Other,
        },
        armed: state.armed,
        landed: match state.landed {
            autopilot::LandedState::Unknown => Landed::Unknown,
            autopilot::LandedState::OnGround => Landed::OnGround,
            autopilot::LandedState::TakingOff => Landed::TakingOff,
            autopilot::LandedState::InAir => Landed::InAir,
            autopilot::LandedState::Landing => Landed::Landing,
        },
    }
}

/// The vehicle as it is published.
pub fn vehicle_message(state: &VehicleState) -> Option<messages::VehicleState> {
    let seen = vehicle(state)?;
    let landed = match state.landed {
        autopilot::LandedState::Unknown => messages::LandedState::Unknown,
        autopilot::LandedState::OnGround => messages::LandedState::OnGround,
        autopilot::LandedState::TakingOff => messages::LandedState::TakingOff,
        autopilot::LandedState::InAir => messages::LandedState::InAir,
        autopilot::LandedState::Landing => messages::LandedState::Landing,
    };
    Some(messages::VehicleState {
        stamp_ns: seen.stamp.nanos(),
        ned_from_body_wxyz: seen.ned_from_body.wxyz(),
        position_ned_m: seen.position.coords.into(),
        velocity_ned_m_s: seen.velocity.coords.into(),
        mode: state.mode.to_string(),
        armed: state.armed,
        landed,
        battery: state.battery.remaining.map(|remaining| remaining as f32),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn impossible_numbers_of_a_marker_are_reported() {
        assert_eq!(impossible_because(&Detection::sample()), None);
        let with = |change: &dyn Fn(&mut Transform3)| {
            let mut detection = Detection::sample();
            change(&mut detection.pose.as_mut().unwrap().camera_from_marker);
            impossible_because(&detection).unwrap()
        };
        let at = |place_m: [f64; 3]| with(&|pose| pose.translation_m = place_m);
        for z in [0.0, -0.0, -5.0] {
            let text = at([0.0, 1.0, z]);
            assert!(text.contains("behind the camera") && text.contains("1.000"), "{text}");
        }
        for number in [f64::NAN, f64::INFINITY, -f64::INFINITY] {
            assert!(at([number, 0.0, 5.0]).contains("place is not finite"), "{number}");
            assert!(at([0.0, 0.0, number]).contains("place is not finite"), "{number}");
            let centre = Detection { centre_px: [number, 0.0], ..Detection::sample() };
            assert!(impossible_because(&centre).unwrap().contains("centre"), "{number}");
        }
        let far = at([0.0, 0.0, 1e9]);
        assert!(far.contains("farther away than 1000 m") && far.contains("1000000000"), "{far}");
        let none = with(&|pose| pose.rotation_wxyz = [0.0; 4]);
        assert!(none.contains("rotation is none"), "{none}");
    }

    #[test]
    fn a_second_solution_behind_the_camera_is_none() {
        let mount = body_from_camera(&CameraInfo::sample());
        for (z, is_taken) in [(5.0, true), (0.0, false), (-5.0, false)] {
            let mut detection = Detection::sample();
            let pose = detection.pose.as_mut().unwrap();
            let camera_from_marker =
                Transform3 { translation_m: [0.0, 0.0, z], ..pose.camera_from_marker };
            pose.alternative =
                Some(messages::AlternativePose { camera_from_marker, reprojection_rms_px: 0.1 });
            assert_eq!(marker_in_frame(&detection, mount).alternative.is_some(), is_taken, "{z}");
        }
    }

    #[test]
    fn a_position_that_has_stopped_is_not_flown_on() {
        use autopilot::{Attitude, Battery, FlightMode, Position};
        use geometry::Point;
        let ms = 1_000_000;
        let at = |attitude_ms: i64, position_ms: i64| VehicleState {
            stamp_ns: attitude_ms.max(position_ms) * ms,
            attitude: Some(Attitude {
                stamp_ns: attitude_ms * ms,
                boot_ms: 0,
                ned_from_body: Rotation::identity(),
                rate_in_body: Vector::zero(),
            }),
            position: Some(Position {
                stamp_ns: position_ms * ms,
                boot_ms: 0,
                position: Point::origin(),
                velocity: Vector::new(1.0, 0.0, 0.0),
            }),
            range: None,
            mode: FlightMode::Guided,
            armed: true,
            landed: autopilot::LandedState::InAir,
            ready: true,
            battery: Battery::default(),
            connected: true,
        };
        let seen = vehicle(&at(1100, 1000)).unwrap();
        assert_eq!(seen.stamp.nanos(), 1100 * ms);
        assert!((seen.position.x() - 0.1).abs() < 1e-9);
        assert!(vehicle(&at(1301, 1000)).is_none());
        assert!(vehicle(&at(1000, 1301)).is_none());
    }
}
