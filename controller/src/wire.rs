//! Converts between messages, the autopilot's types and the lander's: detections by the camera's mount into
//! the body frame, covariances, phases, vehicle state and status.

use autopilot::{FlightMode, VehicleState};
use geometry::{Body, Camera, Marker, Pixel, Point, Rotation, Transform, Vector};
use landing::{Landed, MarkerInFrame, Mode, Timestamp, VehicleStatus};
use messages::{CameraInfo, Detection, FrameHeader, MarkerPose, Phase, Transform3};
use nalgebra::Matrix3;

/// Maximum time between attitude and position, in nanoseconds: beyond it one of the two has stopped.
const MAX_SKEW_NS: i64 = 300_000_000;

/// Maximum distance of a marker from the camera, in metres: no lens shows one that is farther away.
const MAX_RANGE_M: f64 = 1e3;

/// Maximum difference of a rotation quaternion's length from 1, from rounding: a rotation vector or an angle in degrees has another length.
const MAX_LENGTH_ERROR: f64 = 0.01;

/// Maximum angle between the normal of a marker's face and the direction to the camera, in degrees; 90 is a face seen edge-on. A marker that
/// is tilted by 80 degrees is a sixth as wide as it is long, and no detector reads one that is tilted by more: a right pose at that tilt
/// must err by 20 degrees to exceed the limit, and a pose whose normal is reversed exceeds it at any tilt below.
const MAX_TURNED_DEG: f64 = 100.0;

/// Why a detection's numbers are not those of a marker that a camera sees, as the end of a sentence on its detector; `None` for sound ones.
pub fn impossible_because(detection: &Detection) -> Option<String> {
    if let Some(why) = not_finite_because(detection) {
        return Some(why);
    }
    let pose = detection.pose.as_ref()?;
    let [x, y, z] = pose.camera_from_marker.translation_m;
    let place = format!("({x:.3}, {y:.3}, {z:.3}) m right, down and forward of the camera");
    if pose.camera_from_marker.transform::<Camera, Marker>().is_none() {
        let wxyz = pose.camera_from_marker.rotation_wxyz;
        return Some(format!("the marker's rotation is none: w, x, y, z {wxyz:?}"));
    }
    if let Some(why) = not_a_unit_because(pose.camera_from_marker.rotation_wxyz) {
        return Some(why);
    }
    if z <= 0.0 {
        return Some(format!(
            "the marker would be behind the camera, {place}; z points along its optical axis, away from it"
        ));
    }
    if !is_in_view([x, y, z]) {
        return Some(format!(
            "the marker would be farther away than {MAX_RANGE_M} m, {place}; a translation is in metres"
        ));
    }
    if let Some(why) = turned_away_because(&pose.camera_from_marker) {
        return Some(why);
    }
    let covariance = pose.translation_covariance_m2();
    (!landing::is_covariance(&covariance)).then(|| {
        let [xx, xy, xz, _, _, _, yy, yz, _, _, _, zz, ..] = pose.covariance;
        format!(
            "`pose.covariance` is not that of a position (positive semi-definite, no larger than (100 m)^2): xx {xx:e}, xy {xy:e}, xz {xz:e}, \
             yy {yy:e}, yz {yz:e}, zz {zz:e} m^2"
        )
    })
}

/// Why a rotation is not a unit quaternion, as the end of a sentence on the detector; `None` for a unit quaternion.
fn not_a_unit_because(wxyz: [f64; 4]) -> Option<String> {
    let [w, x, y, z] = wxyz;
    let length = libm::hypot(libm::hypot(w, x), libm::hypot(y, z));
    let is_unit = (length - 1.0).abs() <= MAX_LENGTH_ERROR;
    (!is_unit).then(|| {
        format!(
            "`pose.rotation_wxyz` is not a unit quaternion: its length is {length:.3}, w, x, y, z {wxyz:?}; w is the cosine of half the angle"
        )
    })
}

/// Why a camera would see the back of a marker with this pose, as the end of a sentence on the detector; `None` for a face towards it.
fn turned_away_because(pose: &Transform3) -> Option<String> {
    let camera_from_marker = pose.transform::<Camera, Marker>()?;
    let normal = camera_from_marker.rotation() * Vector::<Marker>::new(0.0, 0.0, 1.0);
    let to_camera = Point::origin() - camera_from_marker.origin();
    let cosine = normal.coords.dot(&to_camera.coords) / to_camera.norm();
    let turned_deg = libm::acos(cosine.clamp(-1.0, 1.0)).to_degrees();
    (turned_deg > MAX_TURNED_DEG).then(|| {
        format!(
            "the marker's face would be turned away from the camera: its normal, the marker's z axis, points {turned_deg:.0} degrees away from the direction to the \
             camera, and {MAX_TURNED_DEG} are allowed; check its rotation, which may be AprilTag's own, with z into the print (multiply it by diag(1, -1, -1) from the \
             right), a quaternion in the order x, y, z, w, or from corners in counter-clockwise order"
        )
    })
}

/// Whether a camera may see a marker so.
fn is_possible(pose: &Transform3) -> bool {
    is_in_view(pose.translation_m)
        && not_a_unit_because(pose.rotation_wxyz).is_none()
        && turned_away_because(pose).is_none()
}

/// Whether a place in the camera frame, in metres, is in front of it and near enough for a marker.
fn is_in_view([x, y, z]: [f64; 3]) -> bool {
    z > 0.0 && libm::hypot(libm::hypot(x, y), z) <= MAX_RANGE_M
}

/// Why the header of a frame is not that of a picture, as the end of a sentence on the detector; `None` for a sound one.
pub fn impossible_frame_because(header: &FrameHeader) -> Option<String> {
    let FrameHeader { width, height, .. } = header;
    (*width == 0 || *height == 0)
        .then(|| format!("the frame's header has no size, {width} x {height} pixels"))
}

/// The first field of a detection with a number that is not finite, and its numbers.
fn not_finite_because(detection: &Detection) -> Option<String> {
    let Detection {
        centre_px, centre_covariance_px2, corners_px, size_px, confidence, pose, ..
    } = detection;
    let doubles = |floats: &[f32]| floats.iter().copied().map(f64::from).collect::<Vec<_>>();
    let mut fields = vec![
        ("centre_px", centre_px.to_vec()),
        ("centre_covariance_px2", doubles(centre_covariance_px2)),
        ("corners_px", corners_px.iter().flatten().flatten().copied().collect()),
        ("size_px", vec![*size_px]),
        ("confidence", vec![*confidence]),
    ];
    if let Some(pose) = pose {
        fields.extend([
            ("pose.translation_m", pose.camera_from_marker.translation_m.to_vec()),
            ("pose.rotation_wxyz", pose.camera_from_marker.rotation_wxyz.to_vec()),
            ("pose.reprojection_rms_px", vec![pose.reprojection_rms_px]),
            ("pose.covariance", doubles(&pose.covariance)),
        ]);
        if let Some(other) = &pose.alternative {
            fields.extend([
                ("alternative.translation_m", other.camera_from_marker.translation_m.to_vec()),
                ("alternative.rotation_wxyz", other.camera_from_marker.rotation_wxyz.to_vec()),
                ("alternative.reprojection_rms_px", vec![other.reprojection_rms_px]),
            ]);
        }
    }
    let is_unsound = |(_, numbers): &(&str, Vec<f64>)| numbers.iter().any(|it| !it.is_finite());
    let (field, numbers) = fields.into_iter().find(is_unsound)?;
    Some(format!("a number in `{field}` is not finite: {numbers:?}"))
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
            .filter(|other| is_possible(&other.camera_from_marker))
            .and_then(|other| in_body(&other.camera_from_marker)),
        covariance_m2: mount.zip(pose).and_then(|(mount, pose)| covariance_in_body(&mount, pose)),
        size_px: Some(detection.size_px),
        confidence: detection.confidence,
    }
}

/// Covariance of a marker's position, rotated from the camera's axes to the body's; `None` where the detector states none: zeros are an
/// unknown covariance, as no position is certain.
fn covariance_in_body(mount: &Transform<Body, Camera>, pose: &MarkerPose) -> Option<Matrix3<f64>> {
    let in_camera = pose.translation_covariance_m2();
    if in_camera.iter().all(|element| *element == 0.0) {
        return None;
    }
    let axis = |x, y, z| (mount.rotation() * Vector::<Camera>::new(x, y, z)).coords;
    let turn =
        Matrix3::from_columns(&[axis(1.0, 0.0, 0.0), axis(0.0, 1.0, 0.0), axis(0.0, 0.0, 1.0)]);
    Some(turn * in_camera * turn.transpose())
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
            // The motors are stopped; it is no mode that a pilot chooses to fly in.
            FlightMode::TERMINATION => Mode::Unknown,
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
            let place = "`pose.translation_m` is not finite";
            assert!(at([number, 0.0, 5.0]).contains(place), "{number}");
            assert!(at([0.0, 0.0, number]).contains(place), "{number}");
            let centre = Detection { centre_px: [number, 0.0], ..Detection::sample() };
            assert!(impossible_because(&centre).unwrap().contains("centre"), "{number}");
        }
        let far = at([0.0, 0.0, 1e9]);
        assert!(far.contains("farther away than 1000 m") && far.contains("1000000000"), "{far}");
        let none = with(&|pose| pose.rotation_wxyz = [0.0; 4]);
        assert!(none.contains("rotation is none"), "{none}");
        let metres = at([3.0, 4.0, 6000.0]);
        assert!(metres.contains("a translation is in metres"), "{metres}");
    }

    #[test]
    fn a_rotation_must_be_a_unit_quaternion() {
        let refused = |wxyz: [f64; 4]| {
            let mut detection = Detection::sample();
            detection.pose.as_mut().unwrap().camera_from_marker.rotation_wxyz = wxyz;
            impossible_because(&detection)
        };
        // Single precision, and both signs of one rotation.
        let half = f64::from(0.5_f32.sqrt());
        for unit in [[0.0, 1.0, 0.0, 0.0], [0.0, -half, half, 0.0], [0.0, 0.0, 0.999, 0.0]] {
            assert_eq!(refused(unit), None, "{unit:?}");
        }
        // A rotation vector in radians and in degrees, and twice a unit quaternion.
        for (wrong, length) in [
            ([0.0, 3.0, 0.5, 0.0], "3.041"),
            ([0.0, 180.0, 0.0, 0.0], "180.000"),
            ([0.0, 2.0, 0.0, 0.0], "2.000"),
            ([0.5, 0.0, 0.0, 0.0], "0.500"),
        ] {
            let why = refused(wrong).unwrap();
            assert!(why.contains("not a unit quaternion") && why.contains(length), "{why}");
        }
    }

    /// A marker whose upper edge is turned clockwise in the image, and which is then tilted about the camera's x axis.
    fn turned(heading_deg: f64, tilt_deg: f64) -> Rotation<Camera, Marker> {
        let about = |x: f64, y: f64, z: f64| {
            Rotation::<Camera, Camera>::from_rotation_vector(Vector::new(x, y, z))
        };
        let upright = Rotation::<Camera, Marker>::from_rotation_vector(Vector::new(
            std::f64::consts::PI,
            0.0,
            0.0,
        ));
        about(tilt_deg.to_radians(), 0.0, 0.0) * about(0.0, 0.0, heading_deg.to_radians()) * upright
    }

    fn rotated(wxyz: [f64; 4]) -> Detection {
        let mut detection = Detection::sample();
        let pose = &mut detection.pose.as_mut().unwrap().camera_from_marker;
        (pose.translation_m, pose.rotation_wxyz) = ([0.0, 0.0, 5.0], wxyz);
        detection
    }

    #[test]
    fn a_face_that_is_turned_away_from_the_camera_is_refused_with_the_likely_causes() {
        let refused = |wxyz| impossible_because(&rotated(wxyz));
        let about_x = Rotation::<Marker, Marker>::from_rotation_vector(Vector::new(
            std::f64::consts::PI,
            0.0,
            0.0,
        ));
        for heading_deg in [-170.0, -90.0, -30.0, 0.0, 60.0, 90.0, 135.0] {
            for tilt_deg in [-79.0, -45.0, 0.0, 30.0, 60.0, 79.0] {
                let right = turned(heading_deg, tilt_deg);
                assert_eq!(refused(right.wxyz()), None, "{heading_deg}, {tilt_deg}");
                // AprilTag's own frame has z into the print.
                let into_print = refused((right * about_x).wxyz()).unwrap_or_default();
                assert!(into_print.contains("turned away from the camera"), "{into_print}");
                assert!(into_print.contains("x, y, z, w"), "{into_print}");
            }
        }
        let why = refused((turned(0.0, 30.0) * about_x).wxyz()).unwrap();
        assert!(why.contains("150 degrees away") && why.contains("100 are allowed"), "{why}");
        let [w, x, y, z] = turned(30.0, 0.0).wxyz();
        assert!(refused([x, y, z, w]).unwrap().contains("150 degrees away"));
    }

    #[test]
    fn noise_at_a_grazing_view_is_not_a_face_that_is_turned_away() {
        for (tilt_deg, is_refused) in [(90.0, false), (99.9, false), (100.1, true)] {
            let why = impossible_because(&rotated(turned(20.0, tilt_deg).wxyz()));
            assert_eq!(why.is_some(), is_refused, "{tilt_deg}: {why:?}");
        }
        // Seen from the side, a face is turned away by less than its tilt, or by more.
        for (x, is_refused) in [(-5.0, true), (5.0, false)] {
            let about_y =
                Rotation::<Camera, Camera>::from_rotation_vector(Vector::new(0.0, 1.2, 0.0));
            let mut detection = rotated((about_y * turned(0.0, 0.0)).wxyz());
            detection.pose.as_mut().unwrap().camera_from_marker.translation_m[0] = x;
            assert_eq!(impossible_because(&detection).is_some(), is_refused, "{x}");
        }
    }

    #[test]
    fn every_number_of_a_detection_must_be_finite() {
        let sound = || {
            let mut detection = Detection::sample();
            detection.corners_px = Some([[1.0, 2.0]; 4]);
            let pose = detection.pose.as_mut().unwrap();
            pose.alternative = Some(messages::AlternativePose {
                camera_from_marker: pose.camera_from_marker,
                reprojection_rms_px: 0.1,
            });
            detection
        };
        assert_eq!(impossible_because(&sound()), None);
        type Change = fn(&mut Detection, f64);
        fn pose(detection: &mut Detection) -> &mut MarkerPose {
            detection.pose.as_mut().unwrap()
        }
        fn other(detection: &mut Detection) -> &mut messages::AlternativePose {
            pose(detection).alternative.as_mut().unwrap()
        }
        let changes: [(&str, Change); 13] = [
            ("centre_px", |it, n| it.centre_px[1] = n),
            ("centre_covariance_px2", |it, n| it.centre_covariance_px2[2] = n as f32),
            ("corners_px", |it, n| it.corners_px.as_mut().unwrap()[3][1] = n),
            ("size_px", |it, n| it.size_px = n),
            ("confidence", |it, n| it.confidence = n),
            ("pose.translation_m", |it, n| pose(it).camera_from_marker.translation_m[2] = n),
            ("pose.rotation_wxyz", |it, n| pose(it).camera_from_marker.rotation_wxyz[0] = n),
            ("pose.reprojection_rms_px", |it, n| pose(it).reprojection_rms_px = n),
            ("pose.covariance", |it, n| pose(it).covariance[0] = n as f32),
            ("pose.covariance", |it, n| pose(it).covariance[20] = n as f32),
            ("alternative.translation_m", |it, n| {
                other(it).camera_from_marker.translation_m[0] = n;
            }),
            ("alternative.rotation_wxyz", |it, n| {
                other(it).camera_from_marker.rotation_wxyz[3] = n;
            }),
            ("alternative.reprojection_rms_px", |it, n| other(it).reprojection_rms_px = n),
        ];
        for (field, change) in changes {
            for number in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
                let mut detection = sound();
                change(&mut detection, number);
                let why = impossible_because(&detection).unwrap_or_default();
                assert!(why.contains(&format!("a number in `{field}` is not finite")), "{why}");
            }
        }
    }

    #[test]
    fn a_covariance_that_no_position_has_is_reported_with_its_numbers() {
        // At the place of xx, yy, zz or xy of the upper triangle.
        for (index, value) in [(0, -1e-4), (6, -1e-4), (11, -1e-4), (1, 2e-4), (0, 1e6)] {
            let mut detection = Detection::sample();
            detection.pose.as_mut().unwrap().covariance[index] = value;
            let why = impossible_because(&detection).unwrap_or_default();
            assert!(why.contains("`pose.covariance` is not that of a position"), "{why}");
            assert!(why.contains(&format!("{value:e}")), "{why}");
        }
    }

    #[test]
    fn zeros_are_an_unknown_covariance() {
        let mount = body_from_camera(&CameraInfo::sample());
        for (covariance, is_known) in [
            (MarkerPose::sample().covariance, true),
            ([0.0; 21], false),
            // That of the rotation alone.
            (std::array::from_fn(|i| if i == 15 { 1.0 } else { 0.0 }), false),
        ] {
            let mut detection = Detection::sample();
            detection.pose.as_mut().unwrap().covariance = covariance;
            assert_eq!(impossible_because(&detection), None);
            let marker = marker_in_frame(&detection, mount);
            assert_eq!(marker.covariance_m2.is_some(), is_known, "{covariance:?}");
            assert!(marker.body_from_marker.is_some());
        }
    }

    #[test]
    fn a_second_solution_out_of_view_is_none() {
        let mount = body_from_camera(&CameraInfo::sample());
        for (z, is_taken) in [(5.0, true), (0.0, false), (-5.0, false), (1e160, false)] {
            let mut detection = Detection::sample();
            let pose = detection.pose.as_mut().unwrap();
            let camera_from_marker =
                Transform3 { translation_m: [0.0, 0.0, z], ..pose.camera_from_marker };
            pose.alternative =
                Some(messages::AlternativePose { camera_from_marker, reprojection_rms_px: 0.1 });
            assert_eq!(marker_in_frame(&detection, mount).alternative.is_some(), is_taken, "{z}");
            for (wxyz, what) in
                [([0.0, 3.0, 0.0, 0.0], "no rotation"), ([1.0, 0.0, 0.0, 0.0], "turned away")]
            {
                let other = detection.pose.as_mut().unwrap().alternative.as_mut().unwrap();
                other.camera_from_marker.rotation_wxyz = wxyz;
                assert!(marker_in_frame(&detection, mount).alternative.is_none(), "{z}, {what}");
                assert_eq!(impossible_because(&detection), None, "the first solution is used");
            }
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
