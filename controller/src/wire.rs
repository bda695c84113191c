//! Converts between messages, the autopilot's types and the lander's: detections by the camera's mount into
//! the body frame, covariances, phases, vehicle state and status.

use autopilot::VehicleState;
use geometry::{Body, Camera, Marker, Pixel, Rotation, Transform, Vector};
use landing::{Landed, MarkerInFrame, Mode, Timestamp, VehicleStatus};
use messages::{CameraInfo, Detection, MarkerPose, Phase, Transform3};
use nalgebra::Matrix3;

/// Maximum time between attitude and position, in nanoseconds: beyond it one of the two has stopped.
const MAX_SKEW_NS: i64 = 300_000_000;

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
        alternative: pose
            .and_then(|pose| pose.alternative.as_ref())
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
