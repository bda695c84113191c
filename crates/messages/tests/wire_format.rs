//! Tests the encoding of every message type against its golden bytes, which change only with a version and are listed in
//! the documentation; and decoding of arbitrary bytes.

use std::borrow::Cow;

use messages::{
    AlternativePose, BayerPattern, CameraControl, CameraInfo, CameraResponse, Candidate,
    CommandReply, Configuration, ControllerCommand, ControllerStatus, Count, DecodeError,
    Detection, Detections, DetectorCommand, DetectorInfo, DetectorState, EllipsePx, ExposureLimits,
    ExposureReason, ExposureSetter, ExposureSetting, FrameAck, FrameHeader, FramePart, GcsSigning,
    GcsStatus, GroundStation, Health, LandedState, Latency, LensModel, MarkerLevels, MarkerPose,
    MavlinkBytes, Message, PacketSignature, Phase, PixelFormat, Place, Rate, RecorderCount,
    RecorderStatus, Refusal, Refusals, RefusedShape, Setpoint, SigningState, StageTime, Tape,
    TapeAction, TapeDecision, TapeEvent, TapeNote, TapeOutput, TapePad, TapeState, TapeTarget,
    TapeWriter, TargetEstimate, Touchdown, Transform3, Truth, VehicleState, Wind, decode, encode,
};
use proptest::prelude::*;

fn header() -> FrameHeader {
    FrameHeader {
        sequence: 300,
        stamp_ns: -1,
        clock: "c".into(),
        exposure_ns: 2,
        ..FrameHeader::sample()
    }
}

fn transform() -> Transform3 {
    Transform3 { translation_m: [0.0, 0.0, 1.0], rotation_wxyz: [1.0, 0.0, 0.0, 0.0] }
}

/// A marker a metre in front of a camera, facing it.
fn facing() -> Transform3 {
    Transform3 { rotation_wxyz: [0.0, 1.0, 0.0, 0.0], ..transform() }
}

/// The message reads back as it was, its encoding has the bytes it always had, and every damaged copy is
/// refused.
fn check<M: Message + PartialEq + std::fmt::Debug>(message: &M, golden: &str) {
    let bytes = encode(message);
    let hex: String = bytes.iter().map(|b| format!("{b:02x}")).collect();
    assert_eq!(hex, golden, "wire bytes of {}", M::NAME);
    assert_eq!(decode::<M>(&bytes).as_ref(), Ok(message));
    for len in 0..bytes.len() {
        assert!(decode::<M>(&bytes[..len]).is_err(), "{} cut to {len} bytes", M::NAME);
    }
    let mut longer = bytes.clone();
    longer.push(0);
    assert_eq!(decode::<M>(&longer), Err(DecodeError::Trailing { extra: 1, expected: M::NAME }));
    let mut older = bytes.clone();
    older[2] -= 1;
    assert!(matches!(decode::<M>(&older), Err(DecodeError::Version { .. })));
    let mut other = bytes;
    other[1] = 200;
    assert!(matches!(decode::<M>(&other), Err(DecodeError::Type { found: 200, .. })));
}

#[test]
fn frame_header() {
    let message = header();
    check(&message, "41010304646f776eac0201016302900acc070000");
    let part = FramePart { x: 300, y: 1, width: 2, height: 3, scale: 4, bytes: 5 };
    let message = FrameHeader { format: PixelFormat::Jpeg, parts: vec![part], ..message };
    check(&message, "41010304646f776eac0201016302900acc070101ac020102030405");
}

#[test]
fn camera_info() {
    let message = CameraInfo {
        camera: "down".into(),
        width: 2,
        height: 1,
        focal_px: Some([1.0, 2.0]),
        principal_px: [0.5, 0.0],
        lens: LensModel::BrownConrady([0.0; 8]),
        body_from_camera: transform(),
    };
    check(
        &message,
        "41020104646f776e020101000000000000f03f0000000000000040000000000000e03f0000000000000000010000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000f03f000000000000f03f000000000000000000000000000000000000000000000000",
    );
}

#[test]
fn detections() {
    let message = Detections {
        detector: "main".into(),
        header: header(),
        detections: vec![Detection {
            family: "rings".into(),
            id: None,
            centre_px: [1.0, 2.0],
            centre_covariance_px2: [1.0, 0.0, 2.0],
            corners_px: None,
            size_px: 3.0,
            wrong_bits: 1,
            confidence: 1.0,
            pose: Some(MarkerPose {
                camera_from_marker: facing(),
                reprojection_rms_px: 0.5,
                covariance: std::array::from_fn(|i| i as f32),
                alternative: Some(AlternativePose {
                    camera_from_marker: facing(),
                    reprojection_rms_px: 1.0,
                }),
            }),
        }],
        stages: vec![StageTime { stage: "threshold".into(), micros: 7 }],
    };
    check(
        &message,
        "410303046d61696e04646f776eac0201016302900acc070000010572696e677300000000000000f03f00000000000000400000803f000000000000004000000000000000084001000000000000f03f0100000000000000000000000000000000000000000000f03f0000000000000000000000000000f03f00000000000000000000000000000000000000000000e03f000000000000803f0000004000004040000080400000a0400000c0400000e0400000004100001041000020410000304100004041000050410000604100007041000080410000884100009041000098410000a0410100000000000000000000000000000000000000000000f03f0000000000000000000000000000f03f00000000000000000000000000000000000000000000f03f01097468726573686f6c6407",
    );
}

#[test]
fn configuration() {
    let message = Configuration {
        service: "detector".into(),
        instance: "main".into(),
        host: "h".into(),
        version: "0.1.0".into(),
        toml: "a = 1".into(),
    };
    check(&message, "411101086465746563746f72046d61696e016805302e312e300561203d2031");
}

#[test]
fn recorder_status() {
    let message = RecorderStatus {
        recorder: "main".into(),
        stamp_ns: -1,
        file: "f".into(),
        bytes: 300,
        waiting_bytes: 1,
        free_bytes: Some(300),
        kept: vec![RecorderCount { key: "wind".into(), count: 2 }],
        dropped: vec![RecorderCount { key: "wind".into(), count: 3 }],
        problem: Some("x".into()),
    };
    check(&message, "411202046d61696e010166ac020101ac02010477696e6402010477696e6403010178");
}

#[test]
fn gcs_status() {
    let message = GcsStatus {
        bridge: "main".into(),
        stamp_ns: -1,
        system: Some(7),
        link: "l".into(),
        peer: Some("p".into()),
        problem: None,
        ground_may: "monitor".into(),
        stations: vec![GroundStation {
            system: 255,
            component: 190,
            peer: "p".into(),
            last_ns: -1,
            silent: true,
            packets: 300,
            refused: 1,
            signature: PacketSignature::Verified,
        }],
        unlisted: 2,
        refused: vec![Count { reason: "x".into(), count: 3 }],
        signing: GcsSigning {
            state: SigningState::InForce,
            link_id: Some(191),
            verified_ns: Some(-1),
        },
    };
    check(
        &message,
        "411601046d61696e010107016c01017000076d6f6e69746f7201ffbe01700101ac02010202010178030301bf0101",
    );
    let states =
        [SigningState::Off, SigningState::NoKey, SigningState::Wanted, SigningState::InForce];
    for (number, state) in (0..).zip(states) {
        let signing = GcsSigning { state, ..GcsSigning::default() };
        let bytes = encode(&GcsStatus { signing, ..GcsStatus::default() });
        assert_eq!(bytes[13..], [number, 0, 0], "{state:?}");
    }
}

#[test]
fn frame_ack() {
    let message = FrameAck {
        camera: "down".into(),
        sequence: 300,
        stamp_ns: -1,
        clock: "c".into(),
        bytes: 300,
    };
    check(&message, "41100104646f776eac02010163ac02");
}

/// A camera that is too dark for its marker and refuses to be set.
fn camera_control() -> CameraControl {
    CameraControl {
        camera: "down".into(),
        sequence: Some(300),
        stamp_ns: 1_000_000_000,
        clock: "monotonic/1a2b3c4d".into(),
        set_by: ExposureSetter::Marker,
        in_use: Some(ExposureSetting { exposure_ns: 2_000_000, gain: Some(1.0) }),
        wanted: Some(ExposureSetting { exposure_ns: 4_000_000, gain: Some(2.0) }),
        why: ExposureReason::TooDark,
        refused: Some("x".into()),
        levels: Some(MarkerLevels { white: 0.25, black: 0.0625 }),
        motion_px_s: Some(250.0),
        limits: Some(ExposureLimits {
            min_exposure_ns: 100_000,
            max_exposure_ns: 4_000_000,
            max_gain: 16.0,
        }),
    }
}

#[test]
fn control_of_a_camera() {
    check(
        &camera_control(),
        "41170104646f776e01ac0280a8d6b907126d6f6e6f746f6e69632f3161326233633464020180897a01000000000000f03f018092f4010100000000000000400a01017801000000000000d03f000000000000b03f010000000000406f4001a08d068092f4010000000000003040",
    );
    check(
        &CameraControl { camera: "down".into(), clock: "c".into(), ..CameraControl::default() },
        "41170104646f776e000001630000000000000000",
    );
    // Numbers on the wire stay those of their reasons and setters.
    let reasons = [
        ExposureReason::Configured,
        ExposureReason::NoMarker,
        ExposureReason::LostSoon,
        ExposureReason::TakenOver,
        ExposureReason::Settling,
        ExposureReason::NotInFrame,
        ExposureReason::NoContrast,
        ExposureReason::Good,
        ExposureReason::Clipped,
        ExposureReason::TooBright,
        ExposureReason::TooDark,
        ExposureReason::MotionBlur,
        ExposureReason::LessNoise,
        ExposureReason::AtLimits,
    ];
    let setters = [ExposureSetter::Fixed, ExposureSetter::Camera, ExposureSetter::Marker];
    for (number, why) in reasons.into_iter().enumerate() {
        let bytes = encode(&CameraControl { why, ..CameraControl::default() });
        assert_eq!(usize::from(bytes[10]), number, "{why:?}");
    }
    for (number, set_by) in setters.into_iter().enumerate() {
        let bytes = encode(&CameraControl { set_by, ..CameraControl::default() });
        assert_eq!(usize::from(bytes[7]), number, "{set_by:?}");
    }
}

#[test]
fn refusals() {
    let square = [[1.0, 2.0], [3.0, 2.0], [3.0, 4.0], [1.0, 4.0]];
    let edge = |axes_px| EllipsePx { centre_px: [1.0, 2.0], axes_px, angle_rad: 0.5 };
    let message = Refusals {
        detector: "main".into(),
        header: header(),
        total: 300,
        refusals: vec![
            Refusal { reason: "code".into(), shape: RefusedShape::Quad(square) },
            Refusal {
                reason: "type".into(),
                shape: RefusedShape::Ring([edge([2.0, 4.0]), edge([4.0, 8.0])]),
            },
        ],
    };
    check(
        &message,
        "411501046d61696e04646f776eac0201016302900acc070000ac020204636f6465000000803f00000040000040400000004000004040000080400000803f000080400474797065010000803f0000004000000040000080400000003f0000803f0000004000008040000000410000003f",
    );
}

#[test]
fn detector_command() {
    let message =
        DetectorCommand::SetParameter { key: "thesis_threshold".into(), value: "80".into() };
    check(&message, "410d0200107468657369735f7468726573686f6c64023830");
    check(&DetectorCommand::Stop, "410d0201");
}

#[test]
fn detector_info() {
    let message = DetectorInfo {
        detector: "main".into(),
        host: "pi".into(),
        place: Place::Ground,
        camera: "down".into(),
        markers: vec!["rings:0.15341".into()],
        version: "alight 0.1.0".into(),
        pid: 300,
    };
    check(
        &message,
        "410f01046d61696e0270690104646f776e010d72696e67733a302e31353334310c616c6967687420302e312e30ac02",
    );
}

#[test]
fn camera_response() {
    let bytes = "411401046d61696e04646f776e00ac02000000000000f03f000000000000b03f000000000000e03f000000000000c03f";
    check(&response(), bytes);
}

fn response() -> CameraResponse {
    CameraResponse {
        detector: "main".into(),
        camera: "down".into(),
        configured: false,
        markers: 300,
        curve: 1.0,
        curve_deviation: 0.0625,
        sharpening: 0.5,
        sharpening_deviation: 0.125,
    }
}

#[test]
fn pixel_formats() {
    let bytes =
        |format| encode(&FrameHeader { format, ..header() })[18..].split_last().unwrap().1.to_vec();
    let formats = [PixelFormat::Mono8, PixelFormat::Jpeg, PixelFormat::Mono10, PixelFormat::Mono12];
    for (number, format) in (0..).zip(formats) {
        assert_eq!(bytes(format), [number], "{format:?}");
    }
    let patterns = [BayerPattern::Rggb, BayerPattern::Grbg, BayerPattern::Gbrg, BayerPattern::Bggr];
    for (number, pattern) in (0..).zip(patterns) {
        assert_eq!(bytes(PixelFormat::Bayer8(pattern)), [5, number]);
        assert_eq!(bytes(PixelFormat::Bayer16(pattern)), [8, number]);
    }
    assert_eq!(bytes(PixelFormat::Mono16), [4]);
}

#[test]
fn vehicle_state() {
    let message = VehicleState {
        stamp_ns: 5,
        ned_from_body_wxyz: [1.0, 0.0, 0.0, 0.0],
        position_ned_m: [0.0, 0.0, -10.0],
        velocity_ned_m_s: [0.0; 3],
        mode: "GUIDED".into(),
        armed: true,
        landed: LandedState::InAir,
        battery: Some(0.5),
    };
    check(
        &message,
        "4104010a000000000000f03f0000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000024c0000000000000000000000000000000000000000000000000064755494445440103010000003f",
    );
}

#[test]
fn mavlink_bytes() {
    let message = MavlinkBytes { packet: vec![0xfd, 0, 1] };
    check(&message, "41050103fd0001");
}

#[test]
fn target_estimate() {
    let message = TargetEstimate {
        stamp_ns: 1,
        position_ned_m: Some([1.5, -1.5, 0.0]),
        lateral_error_m: Some(0.25),
        height_m: Some(2.0),
        age_ms: Some(50.0),
        rejected: Some("stale".into()),
        decided: Some("old".into()),
        velocity_ned_m_s: Some([0.25, 0.0, 0.0]),
        deviation_m: Some(0.5),
        heading_rad: None,
        nis: Some(2.0),
        time_offset_ms: Some(1.0),
        wind_ned_m_s: Some([1.0, 2.0]),
    };
    check(
        &message,
        "4106020201000000000000f83f000000000000f8bf000000000000000001000000000000d03f01000000000000004001000000000000494001057374616c6501036f6c6401000000000000d03f0000000000000000000000000000000001000000000000e03f0001000000000000004001000000000000f03f01000000000000f03f0000000000000040",
    );
}

#[test]
fn controller_status() {
    let message = ControllerStatus {
        stamp_ns: 1,
        phase: Phase::Descend,
        why: "w".into(),
        guidance: "metric".into(),
        marker: "rings".into(),
        autopilot: "ok".into(),
        active_detector: Some("main".into()),
        detector_why: "y".into(),
        preference: "ground".into(),
        detector_changes: 2,
        candidates: vec![Candidate {
            detector: "main".into(),
            state: DetectorState::Active,
            place: Some(Place::Onboard),
            age_ms: 1.0,
            latency_ms: 2.0,
            rate_hz: 15.0,
            alive: true,
            disagreement_m: None,
            compared: 15,
            agreed: 14,
        }],
        detection_age_ms: None,
        height_m: None,
        lateral_error_m: None,
        setpoint: Some(Setpoint { velocity_ned_m_s: [0.0; 3], yaw_rate_rad_s: 0.0 }),
        started_ns: None,
        disarmed_ns: None,
        finished: false,
        waits_for_operator: true,
        detections_used: 9,
        latency_ms: Some([1.0, 2.0]),
        setpoint_timeout_s: Some(0.5),
        warnings: vec!["x".into()],
    };
    check(
        &message,
        "41070902040177066d65747269630572696e6773026f6b01046d61696e01790667726f756e640201046d61696e000100000000000000f03f00000000000000400000000000002e4001000f0e000000010000000000000000000000000000000000000000000000000000000000000000000000010901000000000000f03f000000000000004001000000000000e03f010178",
    );
}

#[test]
fn phases() {
    let phases = [
        Phase::Idle,
        Phase::Takeoff,
        Phase::Search,
        Phase::Approach,
        Phase::Descend,
        Phase::Retry,
        Phase::Final,
        Phase::Landed,
        Phase::Hold,
        Phase::Aborted,
        Phase::PilotInCommand,
        Phase::Failed,
    ];
    for (number, phase) in (0..).zip(phases) {
        let message = ControllerStatus { phase, ..ControllerStatus::default() };
        assert_eq!(encode(&message)[4], number, "{phase}");
    }
}

#[test]
fn detector_states() {
    let states = [
        DetectorState::Active,
        DetectorState::Shadow,
        DetectorState::Stale,
        DetectorState::Blind,
        DetectorState::Outvoted,
        DetectorState::NoPose,
    ];
    for (number, state) in (0..).zip(states) {
        let candidate = Candidate { detector: String::new(), state, ..Candidate::sample() };
        let message =
            ControllerStatus { candidates: vec![candidate], ..ControllerStatus::default() };
        // Head, ten empty fields, a list of one, an empty name.
        assert_eq!(encode(&message).get(15), Some(&number), "{state:?}");
    }
}

#[test]
fn controller_command() {
    let message = ControllerCommand::UseDetector("spare".into());
    check(&message, "41080304057370617265");
    check(&ControllerCommand::PreferDetectors(Place::Ground), "4108030501");
    check(&ControllerCommand::LandHere, "41080306");
    check(&ControllerCommand::PreferAnyDetector, "41080307");
}

#[test]
fn command_reply() {
    let message = CommandReply { accepted: false, reason: "no".into() };
    check(&message, "41090100026e6f");
}

#[test]
fn truth() {
    let message = Truth {
        stamp_ns: 1,
        ned_from_body_wxyz: [1.0, 0.0, 0.0, 0.0],
        position_ned_m: [0.0; 3],
        velocity_ned_m_s: [0.0; 3],
        pad_ned_m: [1.5, -1.5, 0.0],
        on_ground: true,
        touchdown: Some(Touchdown {
            stamp_ns: 1,
            error_m: 0.5,
            vertical_speed_m_s: 0.25,
            lateral_speed_m_s: 0.0,
        }),
        max_tilt_rad: 0.0,
        frames: 3,
    };
    check(
        &message,
        "410a0102000000000000f03f000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000f83f000000000000f8bf0000000000000000010102000000000000e03f000000000000d03f0000000000000000000000000000000003",
    );
}

#[test]
fn tape() {
    let message = Tape { begun_ns: 1, first: 300, count: 2, records: vec![7, 0] };
    check(&message, "41130702ac0202020700");
}

/// A record with one event: its bytes without the hash, which the bytes give.
fn record(event: &TapeEvent<'_>, output: &TapeOutput<'_>) -> String {
    let mut tape = TapeWriter::new(0);
    tape.write(1, event, output);
    let records = tape.take().unwrap_or_default().records;
    let (bytes, _hash) = records.split_at(records.len() - 8);
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

#[test]
fn records_of_a_tape() {
    let note = TapeNote {
        address: "a".into(),
        system: 1,
        parameter: "p".into(),
        original_s: 0.5,
        set_s: 1.0,
    };
    let text = |text: &'static str| Cow::Borrowed(text);
    let raw = || Cow::Borrowed(&[0xfd, 7][..]);
    let detections = Detections {
        detector: "main".into(),
        header: header(),
        detections: vec![],
        stages: vec![],
    };
    let info = DetectorInfo {
        detector: "d".into(),
        host: "h".into(),
        place: Place::Onboard,
        camera: "c".into(),
        markers: vec![],
        version: "v".into(),
        pid: 1,
    };
    let camera = CameraInfo {
        camera: "down".into(),
        width: 2,
        height: 1,
        focal_px: None,
        principal_px: [0.5, 0.0],
        lens: LensModel::BrownConrady([0.0; 8]),
        body_from_camera: transform(),
    };
    let camera_bytes: String = encode(&camera)[3..].iter().map(|b| format!("{b:02x}")).collect();
    let command = ControllerCommand::Start;
    let reply = CommandReply { accepted: true, reason: "r".into() };
    let no_output = TapeOutput::default();
    let begin = TapeEvent::Begin { program: text("a"), build: text("b"), configuration: text("c") };
    assert_eq!(record(&begin, &no_output), "0200016101620163000000");
    assert_eq!(
        record(&TapeEvent::TakeOver(note), &no_output),
        "02010161010170000000000000e03f000000000000f03f000000"
    );
    assert_eq!(record(&TapeEvent::Packet { raw: raw() }, &no_output), "020202fd07000000");
    assert_eq!(record(&TapeEvent::GroundPacket { raw: raw() }, &no_output), "020302fd07000000");
    let tick = TapeOutput { packets: b"ab", ..no_output };
    assert_eq!(record(&TapeEvent::Tick, &tick), "02040002616200");
    let event = TapeEvent::Detections { publisher: text("m"), message: Cow::Owned(detections) };
    assert_eq!(
        record(&event, &no_output),
        "0205016d046d61696e04646f776eac0201016302900acc0700000000000000"
    );
    let event = TapeEvent::Camera(Cow::Owned(camera));
    assert_eq!(record(&event, &no_output), format!("0206{camera_bytes}000000"));
    let event = TapeEvent::Presence { detector: text("m"), alive: true };
    assert_eq!(record(&event, &no_output), "0207016d01000000");
    let event = TapeEvent::DetectorInfo { publisher: text("d"), info: Cow::Owned(info) };
    assert_eq!(record(&event, &no_output), "020801640164016800016300017601000000");
    let answered = TapeOutput { reply: Some(&reply), ..no_output };
    assert_eq!(record(&TapeEvent::Command(Cow::Owned(command)), &answered), "020900000001010172");
    assert_eq!(record(&TapeEvent::RefusedVersion, &no_output), "020a000000");
    assert_eq!(record(&TapeEvent::Shutdown, &no_output), "020b000000");
    let pad = TapePad {
        address: "a".into(),
        system: 1,
        stamp_ns: 1,
        position_ned_m: [0.0, 0.0, 1.0],
        deviation_m: 0.5,
    };
    let position = "00000000000000000000000000000000000000000000f03f000000000000e03f";
    let taken_over = record(&TapeEvent::TakeOverPad(pad), &no_output);
    assert_eq!(taken_over, format!("020d01610102{position}000000"));
    let status = ControllerStatus { phase: Phase::Hold, ..ControllerStatus::default() };
    let target = TargetEstimate {
        stamp_ns: 1,
        position_ned_m: None,
        lateral_error_m: None,
        height_m: Some(1.0),
        age_ms: None,
        rejected: None,
        decided: None,
        velocity_ned_m_s: None,
        deviation_m: None,
        heading_rad: None,
        nis: None,
        time_offset_ms: None,
        wind_ned_m_s: None,
    };
    let state = TapeState { status, target };
    assert_eq!(
        record(&TapeEvent::State(Box::new(state)), &no_output),
        "020c000800000000000000000000000000000000000000000002000001000000000000f03f000000000000000000000000"
    );
    let decision = TapeDecision {
        phase: "p",
        action: TapeAction::Velocity { velocity_ned_m_s: [1.0, 0.0, -1.0], yaw_rate_rad_s: 0.5 },
        why: "w",
        target: Some(TapeTarget {
            position_ned_m: [1.0, 0.0, 0.0],
            velocity_ned_m_s: [0.0; 3],
            lateral_error_m: 1.0,
            height_m: 2.0,
            age_s: 0.5,
            deviation_m: 0.25,
            detections: 300,
            heading_rad: None,
            time_offset_s: 0.0,
            nis: Some(2.0),
            ambiguous: false,
        }),
        rejected: None,
        detector: Some("m"),
    };
    let decided = TapeOutput { decision: Some(decision), ..no_output };
    assert_eq!(
        record(&TapeEvent::Tick, &decided),
        "02048f01a901007001007701006d000000000000f03f0000000000000000000000000000f0bf000000000000e03f000000000000f03f00000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000f03f0000000000000040000000000000e03f000000000000d03f000000000000000000000000000000402c010000000000"
    );
    for (number, action) in [
        (0, TapeAction::None),
        (2, TapeAction::Guided),
        (3, TapeAction::Disarm),
        (4, TapeAction::Land),
    ] {
        let decided = TapeOutput {
            decision: Some(TapeDecision { action, target: None, ..decision }),
            ..no_output
        };
        assert_eq!(
            record(&TapeEvent::Tick, &decided),
            format!("02040a2{number}01007001007701006d0000")
        );
    }
}

#[test]
fn wind() {
    let message = Wind { stamp_ns: 1, velocity_ned_m_s: [1.0, 0.0, 0.0] };
    check(&message, "410b0102000000000000f03f00000000000000000000000000000000");
}

#[test]
fn health() {
    let message = Health {
        service: "detector".into(),
        instance: "main".into(),
        host: "h".into(),
        version: "v".into(),
        clock: "c".into(),
        stamp_ns: 1,
        pid: 2,
        cpu_s: 0.5,
        uptime_s: 1.0,
        rates: vec![Rate { name: "frames".into(), count: 1, hz: 15.0 }],
        latencies: vec![Latency { name: "detect".into(), p50_ms: 1.0, p99_ms: 2.0 }],
        drops: vec![],
        errors: vec![Count { reason: "damaged".into(), count: 1 }],
    };
    check(
        &message,
        "410c02086465746563746f72046d61696e0168017601630202000000000000e03f000000000000f03f01066672616d6573010000000000002e400106646574656374000000000000f03f000000000000004000010764616d6167656401",
    );
}

proptest! {
    #[test]
    fn no_bytes_make_decoding_panic(mut bytes in prop::collection::vec(any::<u8>(), 0..200), kind in 0u8..16, version in 1u8..3) {
        if bytes.len() > 2 {
            (bytes[0], bytes[1], bytes[2]) = (b'A', kind, version);
        }
        let refused = [
            decode::<FrameHeader>(&bytes).is_err(),
            decode::<CameraInfo>(&bytes).is_err(),
            decode::<Detections>(&bytes).is_err(),
            decode::<DetectorCommand>(&bytes).is_err(),
            decode::<VehicleState>(&bytes).is_err(),
            decode::<ControllerStatus>(&bytes).is_err(),
            decode::<Health>(&bytes).is_err(),
        ];
        prop_assert!(refused.iter().filter(|r| !**r).count() <= 1, "two types took the same bytes");
    }
}

/// The messages whose bytes `docs/wire-format.md` shows.
fn documented() -> Vec<(&'static str, Vec<u8>)> {
    let clock = "monotonic/1a2b3c4d".to_owned();
    let header = FrameHeader {
        stamp_ns: 1_000_000_000,
        clock: clock.clone(),
        exposure_ns: 2_000_000,
        ..header()
    };
    let turned = |translation_m| Transform3 { translation_m, rotation_wxyz: [0.0, 1.0, 0.0, 0.0] };
    let camera = CameraInfo {
        camera: "down".into(),
        width: 1296,
        height: 972,
        focal_px: Some([1818.0, 1818.0]),
        principal_px: [647.5, 485.5],
        lens: LensModel::Pinhole,
        body_from_camera: turned([0.0; 3]),
    };
    // The diagonal of the upper triangle of 6 x 6.
    let diagonal = [0, 6, 11, 15, 18, 20];
    let marker = Detection {
        family: "aruco-4x4-50".into(),
        id: Some(7),
        // A marker of 0.15 m at the pose below, as that camera sees it.
        centre_px: [874.75, 599.125],
        centre_covariance_px2: [0.25, 0.0, 0.25],
        corners_px: Some([
            [840.75, 565.125],
            [908.75, 565.125],
            [908.75, 633.125],
            [840.75, 633.125],
        ]),
        size_px: 96.0,
        wrong_bits: 0,
        confidence: 1.0,
        pose: Some(MarkerPose {
            camera_from_marker: turned([0.5, 0.25, 4.0]),
            reprojection_rms_px: 0.125,
            covariance: std::array::from_fn(|i| if diagonal.contains(&i) { 1.0 } else { 0.0 }),
            alternative: None,
        }),
    };
    let detections = Detections {
        detector: "python".into(),
        header: header.clone(),
        detections: vec![marker],
        stages: vec![StageTime { stage: "opencv".into(), micros: 5000 }],
    };
    let info = DetectorInfo {
        detector: "python".into(),
        host: "pi".into(),
        place: Place::Ground,
        camera: "down".into(),
        markers: vec!["aruco-4x4-50:7:0.15".into()],
        version: "python".into(),
        pid: 300,
    };
    let response = response();
    let set = DetectorCommand::SetParameter { key: "markers".into(), value: "[]".into() };
    let reply = CommandReply { accepted: true, reason: "it stops".into() };
    let ack = FrameAck {
        camera: "down".into(),
        sequence: 300,
        stamp_ns: 1_000_000_000,
        clock,
        bytes: 20_000,
    };
    let refusals = Refusals {
        detector: "python".into(),
        header: header.clone(),
        total: 300,
        refusals: vec![Refusal {
            reason: "code".into(),
            shape: RefusedShape::Quad([[1.0, 2.0], [3.0, 2.0], [3.0, 4.0], [1.0, 4.0]]),
        }],
    };
    let status = ControllerStatus {
        stamp_ns: 1_000_000_000,
        phase: Phase::Descend,
        why: "w".into(),
        guidance: "metric".into(),
        marker: "rings".into(),
        autopilot: "a".into(),
        active_detector: Some("main".into()),
        detector_why: "d".into(),
        preference: String::new(),
        detector_changes: 0,
        candidates: vec![Candidate {
            state: DetectorState::Active,
            age_ms: 64.0,
            latency_ms: 32.0,
            rate_hz: 16.0,
            ..Candidate::sample()
        }],
        detection_age_ms: Some(64.0),
        height_m: Some(4.0),
        lateral_error_m: Some(0.25),
        setpoint: Some(Setpoint { velocity_ned_m_s: [0.0, 0.0, 1.0], yaw_rate_rad_s: 0.0 }),
        started_ns: Some(300),
        disarmed_ns: None,
        finished: false,
        waits_for_operator: false,
        detections_used: 300,
        latency_ms: Some([32.0, 64.0]),
        setpoint_timeout_s: Some(0.5),
        warnings: vec!["x".into()],
    };
    let target = TargetEstimate { stamp_ns: 1_000_000_000, ..TargetEstimate::sample() };
    let vehicle = VehicleState {
        stamp_ns: 1_000_000_000,
        ned_from_body_wxyz: [1.0, 0.0, 0.0, 0.0],
        position_ned_m: [0.0, 0.0, -4.0],
        velocity_ned_m_s: [0.0, 0.0, 1.0],
        mode: "GUIDED".into(),
        armed: true,
        landed: LandedState::InAir,
        battery: Some(0.5),
    };
    let health = Health {
        service: "detector".into(),
        instance: "main".into(),
        host: "pi".into(),
        version: "0.1.0".into(),
        clock: header.clock.clone(),
        stamp_ns: 1_000_000_000,
        pid: 300,
        cpu_s: 1.0,
        uptime_s: 2.0,
        rates: vec![Rate { name: "frames".into(), count: 30, hz: 15.0 }],
        latencies: vec![Latency { name: "detect".into(), p50_ms: 2.0, p99_ms: 4.0 }],
        drops: vec![Count { reason: "x".into(), count: 1 }],
        errors: Vec::new(),
    };
    let gcs = GcsStatus {
        bridge: "main".into(),
        stamp_ns: 1_000_000_000,
        system: Some(1),
        link: "udpin:0.0.0.0:14550".into(),
        peer: Some("10.0.0.2:14550".into()),
        problem: None,
        ground_may: "no-arming".into(),
        stations: vec![GroundStation {
            system: 255,
            component: 190,
            peer: "10.0.0.2:14550".into(),
            last_ns: 1_000_000_000,
            silent: false,
            packets: 300,
            refused: 2,
            signature: PacketSignature::Verified,
        }],
        unlisted: 0,
        refused: vec![Count { reason: "arming or stopping motors".into(), count: 2 }],
        signing: GcsSigning {
            state: SigningState::InForce,
            link_id: Some(191),
            verified_ns: Some(1_000_000_000),
        },
    };
    let named = ControllerCommand::UseDetector("main".into());
    vec![
        ("FrameHeader", encode(&header)),
        ("CameraInfo", encode(&camera)),
        ("CameraControl", encode(&camera_control())),
        ("Detections", encode(&detections)),
        ("DetectorInfo", encode(&info)),
        ("CameraResponse", encode(&response)),
        ("DetectorCommand SetParameter", encode(&set)),
        ("DetectorCommand Stop", encode(&DetectorCommand::Stop)),
        ("CommandReply", encode(&reply)),
        ("FrameAck", encode(&ack)),
        ("Refusals", encode(&refusals)),
        ("ControllerStatus", encode(&status)),
        ("ControllerCommand UseDetector", encode(&named)),
        ("TargetEstimate", encode(&target)),
        ("VehicleState", encode(&vehicle)),
        ("Health", encode(&health)),
        ("GcsStatus", encode(&gcs)),
    ]
}

#[test]
fn the_documented_bytes_are_those_of_the_program() {
    let page = include_str!("../../../docs/wire-format.md");
    let blocks = page.split("```bytes ").skip(1).filter_map(|rest| rest.split_once('\n'));
    let is_hex = |word: &&str| word.len() == 2 && word.chars().all(|c| c.is_ascii_hexdigit());
    let shown: Vec<(&str, Vec<u8>)> = blocks
        .map(|(name, rest)| {
            let lines = rest.split("```").next().unwrap_or_default().lines();
            // The bytes take the first 48 columns, their meaning follows.
            let bytes = lines.flat_map(|line| {
                line.get(..line.len().min(48)).unwrap_or_default().split(' ').take_while(is_hex)
            });
            (name, bytes.map(|word| u8::from_str_radix(word, 16).unwrap()).collect())
        })
        .collect();
    assert_eq!(shown, documented());
}
