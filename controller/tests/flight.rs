//! A flight fed packets of an ArduPilot and detections: starts and refusals, the pilot's mode changes, alarms,
//! precision landing, restarts of autopilot and controller, and which setpoints go out.

#![allow(clippy::unwrap_used, reason = "helpers of tests may fail like tests")]

mod packets;

use std::sync::Arc;

use autopilot::dialect::{
    ATTITUDE_DATA, EKF_STATUS_REPORT_DATA, EkfStatusFlags, HEARTBEAT_DATA, LOCAL_POSITION_NED_DATA,
    MavAutopilot, MavCmd, MavLandedState, MavMessage, MavSysStatusSensor, MavType,
    PARAM_VALUE_DATA, SYS_STATUS_DATA, TIMESYNC_DATA,
};
use autopilot::{Parser, Sender};
use controller::flight::Flight;
use controller::pad_note::PadNote;
use messages::{
    CameraInfo, ControllerCommand, ControllerStatus, Detection, Detections, DetectorInfo,
    DetectorState, FrameHeader, MarkerPose, Phase, Place,
};
use node::{HealthCounters, Identity, clock_name};
use packets::{
    MS, Sent, attitude, config, contact, flight, flight_counting, flight_with, header, heartbeat,
    hover, in_flight, in_flight_with, move_to, pose, pose_at, position, receive, receive_from,
    seen, sent,
};

#[test]
fn a_landing_begins_only_once_attitude_and_position_are_known() {
    for start in ["takeoff", "airborne"] {
        let mut flight = in_flight(start);
        flight.tick(2 * MS);
        let status = flight.status(2 * MS);
        assert!(!status.finished && status.phase != Phase::Search, "{status:?}");
        pose(&mut flight, 30 * MS);
        flight.tick(31 * MS);
        assert_eq!(flight.status(31 * MS).phase, Phase::Search);
        assert_eq!(sent(&mut flight).0, 1);
    }
}

#[test]
fn the_pilots_mode_change_stops_the_setpoints_permanently() {
    let mut flight = in_flight("airborne");
    pose(&mut flight, 30 * MS);
    flight.tick(31 * MS);
    assert_eq!(sent(&mut flight), (1, vec![]));
    receive(&mut flight, 100 * MS, &heartbeat(5, true));
    for i in 0..100 {
        let now_ns = (101 + i * 25) * MS;
        pose(&mut flight, now_ns);
        flight.tick(now_ns + 2);
    }
    assert_eq!(flight.status(3000 * MS).phase, Phase::PilotInCommand);
    assert_eq!(sent(&mut flight), (0, vec![]));
}

/// Attitude alone, as from an autopilot that has lost its position.
fn turn(flight: &mut Flight, now_ns: i64) {
    let time_boot_ms = (now_ns / MS) as u32;
    let attitude = ATTITUDE_DATA { time_boot_ms, ..Default::default() };
    receive(flight, now_ns, &MavMessage::ATTITUDE(attitude));
}

#[test]
fn the_pilots_switch_is_seen_while_the_position_is_missing() {
    for pilots in [2, 5, 9] {
        let mut flight = in_flight("airborne");
        pose(&mut flight, 30 * MS);
        flight.tick(31 * MS);
        sent(&mut flight);
        for i in 0..40 {
            let now_ns = (60 + i * 25) * MS;
            turn(&mut flight, now_ns);
            if i == 35 {
                assert_eq!(flight.status(now_ns).phase, Phase::Hold);
                receive(&mut flight, now_ns, &heartbeat(pilots, true));
            }
            flight.tick(now_ns + 2);
        }
        assert_eq!(flight.status(1100 * MS).phase, Phase::PilotInCommand, "in mode {pilots}");
        sent(&mut flight);
        // The battery is nearly empty, for longer than the alarm waits.
        for i in 0..240 {
            let now_ns = (1100 + i * 25) * MS;
            if i % 40 == 0 {
                receive(&mut flight, now_ns, &heartbeat(pilots, true));
                receive(&mut flight, now_ns, &battery(5));
            }
            turn(&mut flight, now_ns);
            flight.tick(now_ns + 2);
        }
        assert_eq!(sent(&mut flight), (0, vec![]));
        // Position and GUIDED are back.
        receive(&mut flight, 7200 * MS, &heartbeat(4, true));
        hover(&mut flight, 7220, 9000, 4);
        assert_eq!(flight.status(9000 * MS).phase, Phase::PilotInCommand);
    }
}

#[test]
fn a_request_that_is_pending_is_not_repeated_against_the_pilot() {
    let mut flight =
        flight_with("airborne", &["phases.on_battery_low=\"land\"", "alarms.battery_s=0.1"]);
    receive(&mut flight, 0, &heartbeat(4, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    hover(&mut flight, 20, 1000, 4);
    receive(&mut flight, 1000 * MS, &battery(15));
    // No acknowledgement comes.
    let asked = hover(&mut flight, 1020, 2000, 4);
    assert!(asked.modes.contains(&9.0), "{:?}", asked.modes);
    receive(&mut flight, 2000 * MS, &heartbeat(5, true));
    let after = hover(&mut flight, 2020, 9000, 5);
    assert!(after.modes.is_empty(), "{:?}", after.modes);
}

#[test]
fn reports_of_the_ground_that_contradict_the_flight_change_nothing() {
    for report in [
        MavLandedState::MAV_LANDED_STATE_UNDEFINED,
        MavLandedState::MAV_LANDED_STATE_TAKEOFF,
        MavLandedState::MAV_LANDED_STATE_ON_GROUND,
    ] {
        let mut flight = in_flight("airborne");
        flight.presence(0, "main", true);
        flight.camera(0, CameraInfo::sample());
        hover(&mut flight, 20, 3000, 4);
        let before = flight.status(3000 * MS);
        assert!(matches!(before.phase, Phase::Approach | Phase::Descend), "{before:?}");
        let mut setpoints = 0;
        for ms in (3000..9000).step_by(200) {
            receive(&mut flight, ms * MS, &heartbeat(4, true));
            receive(&mut flight, ms * MS, &contact(report));
            let sent = hover(&mut flight, ms + 20, ms + 200, 4);
            assert!(sent.modes.is_empty(), "{report:?}");
            setpoints += sent.setpoints;
        }
        let is_ground = report == MavLandedState::MAV_LANDED_STATE_ON_GROUND;
        assert!(setpoints > 100 || is_ground, "{report:?}: {setpoints} setpoints");
        let after = flight.status(9000 * MS).phase;
        assert!(matches!(after, Phase::Approach | Phase::Descend), "{report:?}: {after:?}");
    }
}

#[test]
fn motors_said_to_be_off_high_up_are_no_touchdown() {
    let mut flight = in_flight("resume");
    flight.presence(0, "main", true);
    flight.camera(0, CameraInfo::sample());
    hover(&mut flight, 20, 3000, 4);
    receive(&mut flight, 3000 * MS, &contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND));
    for ms in (3000..4000).step_by(200) {
        receive(&mut flight, ms * MS, &heartbeat(4, false));
        pose(&mut flight, ms * MS + 1);
        flight.tick(ms * MS + 2);
        assert_ne!(flight.status(ms * MS + 3).phase, Phase::Landed, "after {ms} ms");
    }
    let status = flight.status(4000 * MS);
    assert_eq!(status.phase, Phase::Aborted);
    assert!(status.why.contains("disarmed"), "{}", status.why);
}

/// Hovers at a height over the marker.
fn hover_at(flight: &mut Flight, from_ms: i64, to_ms: i64, mode: u32, height_m: f32) {
    let height_scale = f64::from(height_m) / 5.0;
    for ms in (from_ms..to_ms).step_by(20) {
        if ms % 1000 == 0 {
            receive(flight, ms * MS, &heartbeat(mode, true));
        }
        pose_at(flight, ms * MS, height_m);
        if ms % 60 == 0 {
            let mut message = seen(ms * MS - 40 * MS);
            for pose in message.detections.iter_mut().filter_map(|it| it.pose.as_mut()) {
                let position_m = &mut pose.camera_from_marker.translation_m;
                *position_m = position_m.map(|metres| metres * height_scale);
            }
            flight.detections(ms * MS + 2, "main", &message);
        }
        flight.tick(ms * MS + 3);
    }
}

#[test]
fn an_aborted_vehicle_that_may_stand_is_reported_with_its_motors_and_the_remedy() {
    let mut flight = in_flight("airborne");
    flight.presence(0, "main", true);
    flight.camera(0, CameraInfo::sample());
    hover_at(&mut flight, 20, 1000, 4, 0.3);
    flight.command(1000 * MS, &ControllerCommand::Hold);
    hover_at(&mut flight, 1000, 3000, 4, 0.3);
    let reply = flight.command(3000 * MS, &ControllerCommand::Abort);
    for word in ["aborted by the operator", "not lifted", "motors run", "land-here", "take over"] {
        assert!(reply.accepted && reply.reason.contains(word), "{}", reply.reason);
    }
    // Setpoints have stopped long before the end.
    for ms in [3100, 12_000] {
        hover_at(&mut flight, ms - 80, ms, 4, 0.3);
        let status = flight.status(ms * MS);
        assert_eq!(status.phase, Phase::Aborted);
        assert!(status.why.contains("not lifted"), "{}", status.why);
        let warnings = status.warnings.iter().filter(|it| it.contains("not lifted"));
        assert_eq!(warnings.count(), 1, "{:?}", status.warnings);
    }
    receive(&mut flight, 12_000 * MS, &heartbeat(4, false));
    let status = flight.status(12_000 * MS);
    assert!(!status.why.contains("motors run"), "{status:?}");
    assert!(status.warnings.iter().all(|it| it.contains("TIMESYNC")), "{status:?}");
}

#[test]
fn a_hold_that_land_refuses_names_the_commands_that_stop_it() {
    for (set, height_m, expected) in [
        (&[][..], 3.0, "above 1 m `abort` takes the vehicle back"),
        (&[], 0.7, "below 1 m LAND is neither held nor aborted"),
        (&["phases.on_abort=\"land\""], 3.0, "an abort lands as well"),
    ] {
        let mut flight = in_flight_with("airborne", set);
        flight.presence(0, "main", true);
        flight.camera(0, CameraInfo::sample());
        hover_at(&mut flight, 20, 1000, 4, height_m);
        assert!(flight.command(1000 * MS, &ControllerCommand::LandHere).accepted);
        for (from_ms, mode) in [(1000, 4), (2000, 9)] {
            hover_at(&mut flight, from_ms, from_ms + 400, mode, height_m);
            let reply = flight.command((from_ms + 400) * MS, &ControllerCommand::Hold);
            assert!(!reply.accepted, "{}", reply.reason);
            for text in ["phase `final`", expected, "the pilot's mode switch stops it"] {
                assert!(reply.reason.contains(text), "`{text}` is not in {}", reply.reason);
            }
        }
        let end_ms = 2500;
        let reply = flight.command(end_ms * MS, &ControllerCommand::Abort);
        assert_eq!(reply.accepted, expected.starts_with("above"), "{}", reply.reason);
    }
}

#[test]
fn without_the_heartbeat_alone_it_hovers_and_then_goes_on() {
    let mut flight = in_flight("airborne");
    flight.presence(0, "main", true);
    flight.camera(0, CameraInfo::sample());
    hover(&mut flight, 20, 3000, 4);
    // Without any heartbeat for 5 s.
    let mut setpoints = 0;
    for ms in (3020..8000).step_by(20) {
        pose(&mut flight, ms * MS);
        if ms % 60 == 0 {
            flight.detections(ms * MS + 2, "main", &seen(ms * MS - 40 * MS));
        }
        flight.tick(ms * MS + 3);
        setpoints += sent(&mut flight).0;
    }
    assert!(setpoints > 100, "{setpoints}");
    let status = flight.status(8000 * MS);
    assert_eq!(status.phase, Phase::Hold);
    assert!(status.why.contains("heartbeat"), "{}", status.why);
    assert!(status.setpoint.unwrap().velocity_ned_m_s[2] <= 0.0);
    hover(&mut flight, 8000, 9000, 4);
    assert!(matches!(flight.status(9000 * MS).phase, Phase::Approach | Phase::Descend));
}

#[test]
fn the_end_of_the_last_detector_levels_the_next_setpoint() {
    let mut flight = in_flight("airborne");
    flight.presence(0, "main", true);
    flight.camera(0, CameraInfo::sample());
    hover(&mut flight, 20, 5000, 4);
    let down = |flight: &Flight| flight.status(0).setpoint.unwrap().velocity_ned_m_s[2];
    assert!(down(&flight) > 0.1, "{}", down(&flight));
    flight.presence(5000 * MS, "main", false);
    flight.tick(5001 * MS);
    assert!(down(&flight) <= 0.0, "{}", down(&flight));
    let status = flight.status(5001 * MS);
    assert!(status.why.contains("no detector is alive"), "{}", status.why);
    assert!(status.warnings.contains(&status.why), "{:?}", status.warnings);
}

#[test]
fn the_search_waits_for_a_detector_and_climbs_before_it_goes_sideways() {
    let searched = |height_m: f32, has_detector: bool| {
        let mut flight = in_flight("airborne");
        if has_detector {
            flight.presence(0, "main", true);
        }
        for i in 0..80 {
            let now_ns = (30 + i * 25) * MS;
            pose_at(&mut flight, now_ns, height_m);
            flight.tick(now_ns + 2);
        }
        let status = flight.status(2030 * MS);
        assert_eq!(status.phase, Phase::Search);
        status.setpoint.unwrap().velocity_ned_m_s
    };
    assert_eq!(searched(5.0, false), [0.0; 3]);
    let [north, east, down] = searched(5.0, true);
    assert!(north.hypot(east) > 0.5 && down == 0.0);
    let [north, east, down] = searched(0.6, true);
    assert!(north.hypot(east) == 0.0 && down < 0.0);
}

#[test]
fn a_start_is_refused_on_the_ground_and_while_taking_off() {
    let mut rising = flight("takeoff");
    let reply = rising.command(0, &ControllerCommand::Start);
    assert!(!reply.accepted && reply.reason.contains("taking off"), "{reply:?}");
    let mut flight = flight("airborne");
    receive(&mut flight, 0, &heartbeat(4, false));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND));
    pose(&mut flight, 2 * MS);
    let reply = flight.command(3 * MS, &ControllerCommand::Start);
    assert!(!reply.accepted && reply.reason.contains("not armed"), "{reply:?}");
    // It still begins automatically, as configured.
    receive(&mut flight, 10 * MS, &heartbeat(4, true));
    receive(&mut flight, 11 * MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    pose(&mut flight, 12 * MS);
    flight.tick(13 * MS);
    assert_eq!(flight.status(13 * MS).phase, Phase::Search);
}

#[test]
fn a_frame_from_the_future_does_not_shut_out_those_of_now() {
    let mut flight = in_flight("airborne");
    let now_ns = 1000 * MS;
    let seen = |stamp_ns: i64| Detections {
        header: FrameHeader { width: 64, height: 48, ..header(stamp_ns) },
        detections: vec![Detection { pose: None, ..Detection::sample() }],
        ..Detections::sample()
    };
    for stamp_ns in [i64::MAX, now_ns + 10_000 * MS, now_ns + 60 * MS] {
        assert!(flight.detections(now_ns, "main", &seen(stamp_ns)), "the target is published");
        assert_eq!(flight.target(now_ns).rejected.as_deref(), Some("from-the-future"));
    }
    for stamp_ns in [i64::MIN, now_ns - 1] {
        flight.detections(now_ns, "main", &seen(stamp_ns));
    }
    assert_eq!(flight.target(now_ns).rejected.as_deref(), Some("no-pose"), "it was looked at");
    assert_eq!(flight.status(now_ns).active_detector.as_deref(), Some("main"));
    // Detections under another detector's name are refused, which does not concern those of the detector in use.
    assert!(!flight.detections(now_ns, "intruder", &seen(now_ns)));
    assert_eq!(flight.target(now_ns).rejected.as_deref(), Some("no-pose"));
    assert_eq!(flight.status(now_ns).candidates.len(), 1);
}

fn parameter(flight: &mut Flight, now_ns: i64, name: &str, value: f32) {
    let value =
        PARAM_VALUE_DATA { param_value: value, param_id: name.into(), ..Default::default() };
    receive(flight, now_ns, &MavMessage::PARAM_VALUE(value));
}

fn landing_target(start: &str) -> Flight {
    let mut flight = flight_with(start, &["mode=landing-target"]);
    flight.camera(0, CameraInfo::sample());
    flight.presence(0, "main", true);
    receive(&mut flight, 0, &heartbeat(4, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    flight
}

#[test]
fn precision_landing_gets_the_target_and_no_setpoint() {
    let mut flight = landing_target("airborne");
    parameter(&mut flight, 2 * MS, "PLND_ENABLED", 1.0);
    parameter(&mut flight, 2 * MS, "PLND_TYPE", 1.0);
    let early = hover(&mut flight, 1000, 3000, 4);
    assert!(early.modes.is_empty(), "it has not had the target long enough");
    let sent = hover(&mut flight, 3000, 6000, 4);
    assert_eq!((early.setpoints, sent.setpoints), (0, 0));
    assert_eq!(sent.modes.first(), Some(&9.0), "LAND");
    assert!(sent.targets.len() >= 45, "at the frames' rate: {}", sent.targets.len());
    for target in &sent.targets {
        assert_eq!((target.frame as u8, target.position_valid.bits()), (12, 1));
        // Image right (0.2 m) is the vehicle's right, image down (0.1 m) its back.
        let [x, y, z] = [target.x, target.y, target.z];
        assert!((x + 0.1).abs() < 0.03 && (y - 0.2).abs() < 0.03 && (z - 5.0).abs() < 0.1);
    }
    let stamps = sent.targets.windows(2).all(|pair| pair[0].time_usec <= pair[1].time_usec);
    assert!(stamps, "of one steady clock");
    hover(&mut flight, 6000, 7000, 9);
    assert_eq!(flight.status(7000 * MS).phase, Phase::Final);
    // Without these states it would have fallen by 5 m in a second.
    for ms in (7000..7980).step_by(20) {
        pose_at(&mut flight, ms * MS, 5.0 - 0.005 * (ms - 7000) as f32);
    }
    receive(&mut flight, 7998 * MS, &contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND));
    pose_at(&mut flight, 7999 * MS, 0.0);
    receive(&mut flight, 8000 * MS, &heartbeat(9, false));
    flight.tick(8001 * MS);
    let status = flight.status(8001 * MS);
    assert!(status.phase == Phase::Landed && status.finished, "{status:?}");
    assert_eq!(status.guidance, "landing-target");
}

/// The autopilot has no information about the reasons for which our own guidance would not descend.
#[test]
fn no_landing_target_is_sent_while_two_detectors_see_the_marker_at_two_places() {
    for lie_m in [0.0, 1.0] {
        let mut flight = landing_target("airborne");
        parameter(&mut flight, 2 * MS, "PLND_ENABLED", 1.0);
        parameter(&mut flight, 2 * MS, "PLND_TYPE", 1.0);
        let mut modes = Vec::new();
        for ms in (20..9000).step_by(20) {
            if ms % 1000 == 0 {
                receive(&mut flight, ms * MS, &heartbeat(4, true));
            }
            pose_at(&mut flight, ms * MS, 5.0);
            if ms % 60 == 0 {
                for (name, lie_m) in [("main", 0.0), ("other", lie_m)] {
                    let mut seen = Detections { detector: name.into(), ..seen(ms * MS - 40 * MS) };
                    move_to(&mut seen, [lie_m, 0.0, 5.0]);
                    flight.detections(ms * MS + 2, name, &seen);
                }
            }
            flight.tick(ms * MS + 3);
            modes.extend(sent(&mut flight).1);
        }
        let status = flight.status(9000 * MS);
        assert_eq!(modes.is_empty(), lie_m > 0.0, "{lie_m} m: {status:?}");
        assert_eq!(status.why.contains("at two places"), lie_m > 0.0, "{status:?}");
    }
}

#[test]
fn a_precision_landing_that_is_off_is_reported_with_the_parameters_to_set() {
    let mut flight = landing_target("command");
    let requested = hover(&mut flight, 1000, 1500, 4).requested;
    assert!(requested.iter().any(|name| name == "PLND_ENABLED"), "{requested:?}");
    for (name, value, word) in [
        ("PLND_ENABLED", 0.0, "set PLND_ENABLED to 1"),
        ("PLND_ENABLED", 1.0, "PLND_TYPE"),
        ("PLND_TYPE", 2.0, "set PLND_TYPE to 1"),
    ] {
        parameter(&mut flight, 1600 * MS, name, value);
        let reply = flight.command(1600 * MS, &ControllerCommand::Start);
        assert!(!reply.accepted && reply.reason.contains(word), "{reply:?}");
        assert!(flight.status(1600 * MS).why.contains(word));
    }
    parameter(&mut flight, 1700 * MS, "PLND_TYPE", 1.0);
    assert!(flight.command(1700 * MS, &ControllerCommand::Start).accepted);
}

#[test]
fn motors_that_stop_in_the_air_abort_a_precision_landing() {
    let mut flight = landing_target("command");
    parameter(&mut flight, 2 * MS, "PLND_ENABLED", 1.0);
    parameter(&mut flight, 2 * MS, "PLND_TYPE", 1.0);
    hover(&mut flight, 1000, 4000, 4);
    hover(&mut flight, 4000, 5000, 9);
    receive(&mut flight, 5000 * MS, &heartbeat(9, false));
    flight.tick(5001 * MS);
    let status = flight.status(5001 * MS);
    assert_eq!(status.phase, Phase::Aborted);
    assert!(status.why.contains("stopped (disarmed) in the air"), "{}", status.why);
}

#[test]
fn motors_that_stop_while_the_state_is_old_end_a_precision_landing_by_the_next_state() {
    for (height_m, phase) in [(3.0, Phase::Aborted), (0.0, Phase::Landed)] {
        let mut flight = landing_target("command");
        parameter(&mut flight, 2 * MS, "PLND_ENABLED", 1.0);
        parameter(&mut flight, 2 * MS, "PLND_TYPE", 1.0);
        hover(&mut flight, 1000, 4000, 4);
        hover(&mut flight, 4000, 5000, 9);
        receive(&mut flight, 6500 * MS, &heartbeat(9, false));
        receive(&mut flight, 6501 * MS, &contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND));
        flight.tick(6502 * MS);
        assert_eq!(flight.status(6502 * MS).phase, Phase::Final);
        receive(&mut flight, 6600 * MS, &attitude(6600 * MS));
        let falls = LOCAL_POSITION_NED_DATA {
            time_boot_ms: 6600,
            z: -height_m,
            vz: height_m,
            ..Default::default()
        };
        receive(&mut flight, 6600 * MS + 1, &MavMessage::LOCAL_POSITION_NED(falls));
        flight.tick(6603 * MS);
        assert_eq!(flight.status(6603 * MS).phase, phase, "{height_m} m");
    }
}

#[test]
fn the_pilots_landing_gets_the_target_and_is_recalled_from_high_up() {
    let mut flight = landing_target("command");
    parameter(&mut flight, 2 * MS, "PLND_ENABLED", 1.0);
    parameter(&mut flight, 2 * MS, "PLND_TYPE", 1.0);
    hover(&mut flight, 1000, 4000, 4);
    let sent = hover(&mut flight, 4000, 5000, 9);
    assert!(sent.targets.len() > 10 && sent.modes.is_empty());
    assert_eq!(flight.status(5000 * MS).phase, Phase::Final);
    assert!(flight.command(5000 * MS, &ControllerCommand::Abort).accepted);
    let sent = hover(&mut flight, 5020, 5500, 9);
    assert_eq!(sent.modes, [4.0], "GUIDED");
    assert_eq!(flight.status(5500 * MS).phase, Phase::Aborted);
}

#[test]
fn an_abort_while_land_is_asked_for_takes_the_autopilot_back_from_it() {
    for (shown_after_ms, asked, phase) in
        [(400, vec![4.0], Phase::Aborted), (3000, vec![], Phase::Final)]
    {
        let mut flight = landing_target("airborne");
        parameter(&mut flight, 2 * MS, "PLND_ENABLED", 1.0);
        parameter(&mut flight, 2 * MS, "PLND_TYPE", 1.0);
        let asked_for_land = hover(&mut flight, 1000, 6000, 4).modes;
        assert_eq!(asked_for_land.first(), Some(&9.0));
        let reply = flight.command(6000 * MS, &ControllerCommand::Abort);
        assert!(reply.accepted, "{reply:?}");
        assert_eq!(flight.status(6000 * MS).phase, Phase::Aborted);
        let early = hover(&mut flight, 6020, 6000 + shown_after_ms, 4);
        assert!(early.modes.is_empty(), "{:?}", early.modes);
        receive(&mut flight, (6000 + shown_after_ms) * MS, &heartbeat(9, true));
        let after = hover(&mut flight, 6020 + shown_after_ms, 6500 + shown_after_ms, 9);
        assert_eq!(after.modes, asked, "LAND shows after {shown_after_ms} ms");
        assert_eq!(flight.status((6500 + shown_after_ms) * MS).phase, phase);
    }
}

/// The packets that are sent in this mode, without a marker, from one height to another.
fn sent_at(
    flight: &mut Flight,
    mode: u32,
    (from_ms, to_ms): (i64, i64),
    (from_m, to_m): (f32, f32),
) -> Sent {
    let mut sent = Sent::default();
    for ms in (from_ms..to_ms).step_by(20) {
        if ms % 1000 == 0 {
            receive(flight, ms * MS, &heartbeat(mode, true));
        }
        let share = (ms - from_ms) as f32 / (to_ms - from_ms) as f32;
        pose_at(flight, ms * MS, from_m + share * (to_m - from_m));
        flight.tick(ms * MS + 3);
        sent.take(flight);
    }
    sent
}

#[test]
fn low_over_the_ground_the_autopilot_is_not_taken_back_from_its_precision_landing() {
    let landing = || {
        let mut flight = landing_target("airborne");
        parameter(&mut flight, 2 * MS, "PLND_ENABLED", 1.0);
        parameter(&mut flight, 2 * MS, "PLND_TYPE", 1.0);
        assert_eq!(hover(&mut flight, 1000, 6000, 4).modes.first(), Some(&9.0));
        flight
    };
    let abort = |flight: &mut Flight, ms: i64| {
        let reply = flight.command(ms * MS, &ControllerCommand::Abort);
        assert!(reply.accepted, "{reply:?}");
    };
    // LAND, asked for before the abort, shows when the vehicle is low already.
    let mut flight = landing();
    abort(&mut flight, 6000);
    assert!(sent_at(&mut flight, 4, (6020, 8000), (5.0, 0.9)).modes.is_empty());
    assert!(sent_at(&mut flight, 9, (8000, 12_000), (0.9, 0.2)).modes.is_empty());
    assert_eq!(flight.status(12_000 * MS).phase, Phase::Final);
    // The request that takes it back is lost, and it becomes low.
    let mut flight = landing();
    sent_at(&mut flight, 9, (6020, 8000), (5.0, 3.0));
    abort(&mut flight, 8000);
    assert!(sent_at(&mut flight, 9, (8000, 9500), (3.0, 1.1)).modes.contains(&4.0));
    sent_at(&mut flight, 9, (9500, 9700), (1.1, 0.9));
    assert!(sent_at(&mut flight, 9, (9700, 14_000), (0.9, 0.8)).modes.is_empty());
    assert_eq!(flight.status(14_000 * MS).phase, Phase::Final);
    // It has reached the autopilot all the same.
    let mut flight = landing();
    sent_at(&mut flight, 9, (6020, 8000), (5.0, 1.3));
    abort(&mut flight, 8000);
    sent_at(&mut flight, 9, (8000, 8600), (1.3, 0.9));
    sent_at(&mut flight, 4, (8600, 9500), (0.9, 0.9));
    let status = flight.status(9500 * MS);
    assert_eq!(status.phase, Phase::Aborted);
    assert!(status.why.contains("aborted by the operator"), "{}", status.why);
}

/// A PX4 whose target is silent for 5 s climbs to search, also when it has just touched down.
#[test]
fn the_autopilot_gets_the_estimated_target_for_some_seconds_where_it_lands_low_without_the_marker()
{
    for (firmware, mode, land) in [("ardupilot", 4, 9), ("px4", 0x0006_0000, 0x0904_0000)] {
        let mut flight = flight_with("airborne", &["mode=landing-target"]);
        flight.camera(0, CameraInfo::sample());
        flight.presence(0, "main", true);
        receive(&mut flight, 0, &heartbeat(mode, true));
        receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        parameter(&mut flight, 2 * MS, "PLND_ENABLED", 1.0);
        parameter(&mut flight, 2 * MS, "PLND_TYPE", 1.0);
        hover(&mut flight, 1000, 5980, mode);
        let seen = hover(&mut flight, 6000, 7000, land).targets;
        let high = sent_at(&mut flight, land, (7000, 8400), (5.0, 2.4));
        assert!(high.targets.is_empty(), "{firmware}: {high:?}");
        let low = sent_at(&mut flight, land, (8400, 9400), (2.4, 0.4));
        assert!((3..=6).contains(&low.targets.len()), "{firmware}: {low:?}");
        let why = flight.status(9400 * MS).why;
        assert!(why.contains("no detection is used"), "{firmware}: {why}");
        // Where it was seen last, from 2 m lower.
        let (first, last) = (seen.last().unwrap(), low.targets.last().unwrap());
        let sunk_m = if land == 9 { 4.4 } else { 0.0 };
        let apart_m = [last.x - first.x, last.y - first.y, last.z + sunk_m - first.z];
        assert!(apart_m.iter().all(|it| it.abs() < 0.2), "{firmware}: {first:?}, {last:?}");
        // As long as the estimate is certain.
        let standing = sent_at(&mut flight, land, (9400, 14_000), (0.4, 0.4));
        assert!((7..20).contains(&standing.targets.len()), "{firmware}: {standing:?}");
        let late = sent_at(&mut flight, land, (14_000, 16_000), (0.4, 0.4));
        assert!(late.targets.is_empty() && late.setpoints == 0, "{firmware}: {late:?}");
    }
}

#[test]
fn a_vehicle_that_follows_a_late_recall_climbs_also_where_it_has_become_low() {
    let mut flight = in_flight("airborne");
    hover(&mut flight, 20, 1000, 4);
    assert!(flight.command(1000 * MS, &ControllerCommand::LandHere).accepted);
    sent_at(&mut flight, 9, (1000, 3000), (5.0, 1.2));
    assert!(flight.command(3000 * MS, &ControllerCommand::Abort).accepted);
    assert_eq!(sent_at(&mut flight, 9, (3000, 3400), (1.2, 0.9)).modes, [4.0]);
    receive(&mut flight, 3400 * MS, &heartbeat(4, true));
    let setpoints = sent_at(&mut flight, 4, (3420, 3980), (0.9, 0.9)).setpoints;
    assert!(setpoints > 10, "{setpoints}");
    assert_eq!(flight.status(3980 * MS).phase, Phase::Aborted);
}

#[test]
fn a_vehicle_that_is_called_back_from_land_is_left_to_it_low_over_the_ground() {
    let mut flight = in_flight("airborne");
    let land = |flight: &mut Flight, from_ms: i64, to_ms: i64, height_m: f32| {
        sent_at(flight, 9, (from_ms, to_ms), (height_m, height_m)).modes
    };
    hover(&mut flight, 20, 1000, 4);
    assert!(flight.command(1000 * MS, &ControllerCommand::LandHere).accepted);
    land(&mut flight, 1000, 2000, 1.6);
    assert!(flight.command(2000 * MS, &ControllerCommand::Abort).accepted);
    assert!(land(&mut flight, 2000, 3000, 1.6).contains(&4.0), "GUIDED is asked for");
    // It does not come: all of it is lost on the way.
    land(&mut flight, 3000, 3020, 0.9);
    assert_eq!(land(&mut flight, 3020, 9000, 0.9), Vec::<f32>::new());
    assert_eq!(flight.status(9000 * MS).phase, Phase::Aborted);
}

/// Detections of a frame that another computer has stamped.
fn of_another_clock(stamp_ns: i64) -> Detections {
    Detections {
        header: FrameHeader { clock: "monotonic/myhost".into(), ..header(stamp_ns) },
        ..Detections::sample()
    }
}

/// A battery with so many percent of its charge.
fn battery(battery_remaining: i8) -> MavMessage {
    MavMessage::SYS_STATUS(SYS_STATUS_DATA { battery_remaining, ..Default::default() })
}

#[test]
fn a_start_is_refused_with_the_reason_while_all_detections_are() {
    let mut flight = in_flight_with("command", &["autopilot.timesync=false"]);
    flight.camera(0, CameraInfo::sample());
    for ms in (20..1600).step_by(20) {
        pose(&mut flight, ms * MS);
        if ms % 60 == 0 {
            flight.detections(ms * MS, "main", &of_another_clock(ms * MS));
        }
        flight.tick(ms * MS + 3);
    }
    let status = flight.status(1600 * MS);
    let warnings = status.warnings.join("; ");
    assert!(warnings.contains("monotonic/myhost") && warnings.contains(clock_name()), "{warnings}");
    let reply = flight.command(1600 * MS, &ControllerCommand::Start);
    assert!(!reply.accepted && reply.reason.contains("monotonic/myhost"), "{reply:?}");
    // With the right clock nothing is in the way any more.
    hover(&mut flight, 1600, 4000, 4);
    assert_eq!(flight.status(4000 * MS).warnings, Vec::<String>::new());
    let reply = flight.command(4000 * MS, &ControllerCommand::Start);
    assert!(reply.accepted, "{reply:?}");
}

#[test]
fn a_warning_of_refused_detections_has_the_value_its_limit_and_the_remedy() {
    let of = |camera: &str, ahead_ms: i64, detector: &str, ms: i64| Detections {
        header: FrameHeader { camera: camera.into(), ..header((ms + ahead_ms) * MS) },
        detector: detector.into(),
        ..Detections::sample()
    };
    for (camera, ahead_ms, detector, parts) in [
        (
            "down",
            300,
            "main",
            &["0.30 s in the future", "0.05 s are allowed", "target.max_future_s"][..],
        ),
        (
            "down",
            56 * 365 * 86_400_000,
            "main",
            &["20440 days in the future", "of another clock", "`time.monotonic_ns()`"],
        ),
        ("down", -20, "mine", &["`main` gives them the name of `mine`", "must give its own id"]),
        ("front", -20, "main", &["mount of camera `front`", "`camera/front/info`"]),
        (
            "wrong",
            -20,
            "main",
            &["`main` names camera `wrong`", "`down` does", "copy the frame's header unchanged"],
        ),
    ] {
        let mut flight = in_flight("command");
        // Of one case no camera is known.
        if camera != "front" {
            flight.camera(0, CameraInfo::sample());
        }
        for ms in (20..1600).step_by(20) {
            pose(&mut flight, ms * MS);
            flight.detections(ms * MS, "main", &of(camera, ahead_ms, detector, ms));
            flight.tick(ms * MS + 3);
        }
        let warnings = flight.status(1600 * MS).warnings;
        let is_of_another_clock = ahead_ms > 60_000;
        assert!(!(is_of_another_clock && warnings.join(" ").contains("max_future_s")));
        let has_all = |text: &String| parts.iter().all(|part| text.contains(part));
        assert!(warnings.iter().any(has_all), "{parts:?}: {warnings:?}");
    }
}

#[test]
fn a_detector_with_an_impossible_marker_is_refused_reported_and_passed_over() {
    type Change = fn(&mut Detection);
    fn pose_of(detection: &mut Detection) -> &mut MarkerPose {
        detection.pose.as_mut().unwrap()
    }
    let changes: [(&str, Change); 11] = [
        ("not its inverse", |it| pose_of(it).camera_from_marker.translation_m[0] = -0.2),
        ("turned away", |it| pose_of(it).camera_from_marker.rotation_wxyz = [1.0, 0.0, 0.0, 0.0]),
        ("-5.000", |it| pose_of(it).camera_from_marker.translation_m = [0.0, 0.0, -5.0]),
        ("1000000000.000", |it| pose_of(it).camera_from_marker.translation_m = [0.0, 0.0, 1e9]),
        ("`pose.translation_m`", |it| pose_of(it).camera_from_marker.translation_m[0] = f64::NAN),
        ("`pose.covariance`", |it| pose_of(it).covariance = [f32::NAN; 21]),
        ("`pose.covariance`", |it| pose_of(it).covariance[0] = -1e-4),
        ("`pose.reprojection_rms_px`", |it| pose_of(it).reprojection_rms_px = f64::NAN),
        ("`centre_covariance_px2`", |it| it.centre_covariance_px2 = [f32::NAN; 3]),
        ("`corners_px`", |it| it.corners_px = Some([[f64::NAN; 2]; 4])),
        ("`size_px`", |it| it.size_px = f64::INFINITY),
    ];
    // Of one that was in use before, and of one that gave no sound frame.
    for ((value, change), sound_ms) in changes.into_iter().flat_map(|it| [(it, 0), (it, 1500)]) {
        let health = Arc::<HealthCounters>::default();
        let mut flight = flight_counting("airborne", &["detectors.preferred=mine"], &health);
        flight.camera(0, CameraInfo::sample());
        receive(&mut flight, 0, &heartbeat(4, true));
        receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        for ms in (20..sound_ms + 4000).step_by(20) {
            if ms % 1000 == 0 {
                receive(&mut flight, ms * MS, &heartbeat(4, true));
            }
            pose(&mut flight, ms * MS);
            if ms % 60 == 0 {
                let stamp_ns = ms * MS - 40 * MS;
                let mut mine = Detections { detector: "mine".into(), ..seen(stamp_ns) };
                if ms > sound_ms {
                    change(&mut mine.detections[0]);
                }
                flight.detections(ms * MS + 2, "mine", &mine);
                flight.detections(ms * MS + 2, "main", &seen(stamp_ns));
            }
            flight.tick(ms * MS + 3);
        }
        let status = flight.status((sound_ms + 4000) * MS);
        assert_eq!(status.active_detector.as_deref(), Some("main"), "{status:?}");
        assert!(matches!(status.phase, Phase::Approach | Phase::Descend), "{status:?}");
        let is_it = |it: &String| it.contains("`mine` are refused") && it.contains(value);
        assert!(status.warnings.iter().any(is_it), "{:?}", status.warnings);
        let mine = status.candidates.iter().find(|it| it.detector == "mine");
        let was_used = sound_ms > 0;
        assert_eq!(mine.map(|it| it.state), was_used.then_some(DetectorState::Stale), "{status:?}");
        assert_eq!(status.detector_changes, u64::from(was_used), "{status:?}");
        let identity = Identity { service: "controller", instance: "main".into() };
        let drops = health.report(&identity, 0).drops;
        let counted = drops.iter().find(|it| it.reason == "detection: impossible-marker");
        assert!(counted.is_some_and(|it| it.count > 60), "{drops:?}");
    }
}

/// Neither the estimate nor the checks of mount, axes and size, which widen it, get detections of a detector on standby, early or late, whatever it sees.
#[test]
fn detections_of_a_detector_on_standby_change_no_decision() {
    let fly = |standby: Option<f64>| {
        let mut flight = in_flight("airborne");
        flight.camera(0, CameraInfo::sample());
        flight.presence(0, "main", true);
        flight.presence(0, "other", standby.is_some());
        let mut decisions = Vec::new();
        for ms in (20..9000).step_by(20) {
            if ms % 1000 == 0 {
                receive(&mut flight, ms * MS, &heartbeat(4, true));
            }
            // It rises and sinks, as the check of the mount needs.
            pose_at(&mut flight, ms * MS, 5.0 + 0.5 * (ms as f32 * 1e-3).sin());
            if ms % 60 == 0 {
                let mut seen = seen(ms * MS - 40 * MS);
                flight.detections(ms * MS + 2, "main", &seen);
                if let Some(off_m) = standby {
                    let pose = seen.detections[0].pose.as_mut().unwrap();
                    pose.camera_from_marker.translation_m[0] += off_m;
                    for late_ns in [60 * MS, 0] {
                        seen.header.stamp_ns = ms * MS - 40 * MS - late_ns;
                        let seen = Detections { detector: "other".into(), ..seen.clone() };
                        flight.detections(ms * MS + 2, "other", &seen);
                    }
                }
            }
            flight.tick(ms * MS + 3);
            decisions.push(*flight.decision().unwrap());
        }
        assert_eq!(flight.active_detector(), Some("main"));
        (decisions, flight.status(9000 * MS).warnings)
    };
    let alone = fly(None);
    assert!(alone.0.iter().filter(|it| it.target.is_some()).count() > 400);
    for off_m in [0.0, 0.05] {
        assert_eq!(fly(Some(off_m)), alone, "{off_m} m");
    }
}

/// Hovers in GUIDED while the detector sends these messages, by the time in nanoseconds.
fn hover_with(flight: &mut Flight, from_ms: i64, to_ms: i64, message: impl Fn(i64) -> Detections) {
    for ms in (from_ms..to_ms).step_by(20) {
        let now_ns = ms * MS;
        if ms % 1000 == 0 {
            receive(flight, now_ns, &heartbeat(4, true));
        }
        pose(flight, now_ns);
        if ms % 60 == 0 {
            flight.detections(now_ns, "main", &message(now_ns));
        }
        flight.tick(now_ns + 3);
    }
}

#[test]
fn detections_that_come_too_late_are_reported_with_the_limit() {
    let mut flight = in_flight_with("airborne", &["autopilot.timesync=false"]);
    flight.camera(0, CameraInfo::sample());
    hover(&mut flight, 1000, 2000, 4);
    hover_with(&mut flight, 2000, 8000, |now_ns| seen(now_ns - 600 * MS));
    let status = flight.status(8000 * MS);
    let text = "detections of `main` come 600 ms after their frames, and at most 500 ms are used (`target.max_latency_s`); search the newest frame only, with fewer pixels or a faster program";
    assert_eq!(status.warnings, [text]);
    assert!(status.why.ends_with(text), "{}", status.why);
}

#[test]
fn detections_in_another_detectors_name_are_frames_of_the_camera() {
    let mut flight = in_flight("airborne");
    let info = detector_info("main", "down");
    for ms in (1000..20_000).step_by(20) {
        let now_ns = ms * MS;
        if ms % 1000 == 0 {
            receive(&mut flight, now_ns, &heartbeat(4, true));
            flight.on_detector_info(now_ns, "main", &info);
        }
        pose(&mut flight, now_ns);
        if ms % 60 == 0 {
            let message = Detections { detector: "mine".into(), ..seen(now_ns - 40 * MS) };
            flight.detections(now_ns, "main", &message);
        }
        flight.tick(now_ns + 3);
    }
    let status = flight.status(20_000 * MS);
    let texts = status.warnings.join("; ");
    assert!(texts.contains("gives them the name of `mine`"), "{texts}");
    assert!(!texts.contains("no frame") && !status.why.contains("no frame"), "{status:?}");
}

#[test]
fn a_landing_without_a_usable_detection_says_why() {
    let mut flight = in_flight("airborne");
    hover(&mut flight, 1000, 2000, 4);
    hover_with(&mut flight, 2000, 8000, |now_ns| {
        let mut message = seen(now_ns - 40 * MS);
        for pose in message.detections.iter_mut().filter_map(|it| it.pose.as_mut()) {
            pose.covariance[6] = -1.0;
        }
        message
    });
    let status = flight.status(8000 * MS);
    let text = "detections of `main` are refused: `pose.covariance` is not that of a position";
    assert!(status.why.contains(text), "{}", status.why);
    assert_eq!(status.candidates[0].state, DetectorState::Stale, "{status:?}");
    // A frame without a size is no picture.
    let mut message = seen(8000 * MS);
    message.header.width = 0;
    let refused = |flight: &mut Flight| flight.target(8001 * MS).rejected;
    flight.detections(8001 * MS, "main", &message);
    assert_eq!(refused(&mut flight).as_deref(), Some("impossible-marker"));
}

#[test]
fn landing_here_needs_neither_detections_nor_a_landing() {
    let land_here = |flight: &mut Flight, now_ms: i64| {
        sent(flight);
        let reply = flight.command(now_ms * MS, &ControllerCommand::LandHere);
        let asked = hover(flight, now_ms + 20, now_ms + 100, 4).modes;
        (reply, asked, flight.status((now_ms + 100) * MS).phase)
    };
    // After a take-off, while all detections are refused.
    for start in ["takeoff", "airborne", "command"] {
        let mut flight = in_flight(start);
        flight.camera(0, CameraInfo::sample());
        for ms in (20..1600).step_by(20) {
            pose(&mut flight, ms * MS);
            if ms % 60 == 0 {
                flight.detections(ms * MS, "main", &of_another_clock(ms * MS));
            }
            flight.tick(ms * MS + 3);
        }
        let status = flight.status(1600 * MS);
        assert!(matches!(status.phase, Phase::Takeoff | Phase::Idle | Phase::Search), "{status:?}");
        if status.phase == Phase::Takeoff {
            assert!(status.why.contains("monotonic/myhost"), "{}", status.why);
        }
        let (reply, asked, phase) = land_here(&mut flight, 1600);
        assert!(reply.accepted, "{start}: {reply:?}");
        assert_eq!((asked.contains(&9.0), phase), (true, Phase::Final), "{start}: {asked:?}");
    }
    // After an abort.
    let mut flight = in_flight("airborne");
    hover(&mut flight, 20, 1000, 4);
    assert!(flight.command(1000 * MS, &ControllerCommand::Abort).accepted);
    hover(&mut flight, 1020, 9000, 4);
    assert_eq!(flight.status(9000 * MS).phase, Phase::Aborted);
    let (reply, asked, phase) = land_here(&mut flight, 9000);
    assert!(reply.accepted, "{reply:?}");
    assert_eq!((asked.contains(&9.0), phase), (true, Phase::Final), "{asked:?}");
    // Against a pilot it is refused, and the present state continues.
    let mut flight = in_flight("airborne");
    receive(&mut flight, 2 * MS, &heartbeat(5, true));
    pose(&mut flight, 20 * MS);
    flight.tick(21 * MS);
    let reply = flight.command(30 * MS, &ControllerCommand::LandHere);
    assert!(!reply.accepted && reply.reason.contains("GUIDED"), "{reply:?}");
    receive(&mut flight, 1000 * MS, &heartbeat(4, true));
    hover(&mut flight, 1020, 1500, 4);
    assert_eq!(flight.status(1500 * MS).phase, Phase::Search);
}

#[test]
fn the_calibration_of_another_program_is_refused_in_flight_and_reported() {
    let mut flight = in_flight("airborne");
    flight.camera(0, CameraInfo::sample());
    flight.presence(0, "main", true);
    hover(&mut flight, 20, 1000, 4);
    for ms in (1000..2500).step_by(20) {
        let focal_px = Some([400.0; 2]);
        flight.camera(ms * MS, CameraInfo { focal_px, ..CameraInfo::sample() });
        flight.camera(ms * MS + 1, CameraInfo::sample());
        hover(&mut flight, ms, ms + 20, 4);
    }
    let status = flight.status(2500 * MS);
    assert!(status.warnings.iter().any(|text| text.contains("400.0")), "{status:?}");
    assert!(matches!(status.phase, Phase::Approach | Phase::Descend), "{status:?}");
}

#[test]
fn while_two_detectors_see_the_marker_at_two_places_nothing_descends_near_the_ground() {
    // It comes down to a height from where the landing began, so much higher.
    let descent_from = |above_m: f32, end_m: f32, lie_m: f64| {
        let mut flight = flight("airborne");
        flight.camera(0, CameraInfo::sample());
        flight.presence(0, "main", true);
        receive(&mut flight, 0, &heartbeat(4, true));
        receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        for ms in (20..4000).step_by(20) {
            if ms % 1000 == 0 {
                receive(&mut flight, ms * MS, &heartbeat(4, true));
            }
            let height_m = end_m + above_m * (1.0 - ms as f32 / 1000.0).max(0.0);
            pose_at(&mut flight, ms * MS, height_m);
            if ms % 60 == 0 {
                for (name, lie_m) in [("main", 0.0), ("other", lie_m)] {
                    let mut seen = Detections { detector: name.into(), ..seen(ms * MS - 40 * MS) };
                    move_to(&mut seen, [lie_m, 0.0, f64::from(height_m)]);
                    flight.detections(ms * MS + 2, name, &seen);
                }
            }
            flight.tick(ms * MS + 3);
        }
        let status = flight.status(4000 * MS);
        (status.setpoint.unwrap().velocity_ned_m_s[2], status)
    };
    let descent = |end_m: f32, lie_m: f64| descent_from(1.0, end_m, lie_m);
    let (down_m_s, status) = descent(2.0, 0.0);
    assert!(down_m_s > 0.0, "{status:?}");
    let (down_m_s, status) = descent(2.0, 1.0);
    assert!(down_m_s < 0.0 && status.why.contains("at two places"), "{status:?}");
    assert!(status.warnings[0].contains("1.00 m apart"), "{status:?}");
    let (down_m_s, status) = descent_from(0.0, 2.0, 1.0);
    assert!(down_m_s == 0.0 && status.why.contains("at two places"), "it began there: {status:?}");
    let (down_m_s, status) = descent(6.0, 1.0);
    assert!(down_m_s > 0.0, "high up it continues: {status:?}");
}

#[test]
fn a_marker_of_another_size_than_configured_is_reported_and_holds() {
    for (size, is_expected) in [(1.0, false), (2.0, true)] {
        let mut flight = flight("airborne");
        flight.camera(0, CameraInfo::sample());
        flight.presence(0, "main", true);
        receive(&mut flight, 0, &heartbeat(4, true));
        receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        for ms in (20..6000).step_by(20) {
            if ms % 1000 == 0 {
                receive(&mut flight, ms * MS, &heartbeat(4, true));
            }
            let height_at = |ms: i64| 10.0 - (ms as f32 / 1000.0 - 2.0).clamp(0.0, 3.0);
            pose_at(&mut flight, ms * MS, height_at(ms));
            if ms % 60 == 0 {
                let mut seen = seen(ms * MS - 40 * MS);
                move_to(&mut seen, [0.0, 0.0, f64::from(height_at(ms - 40)) / size]);
                flight.detections(ms * MS + 2, "main", &seen);
            }
            flight.tick(ms * MS + 3);
        }
        let status = flight.status(6000 * MS);
        let text = "the marker seems 2.0 times as large as configured";
        let is_warned = status.warnings.iter().any(|warning| warning.contains(text));
        assert_eq!(is_warned, is_expected, "{status:?}");
        assert_eq!(status.phase == Phase::Hold, is_expected, "{status:?}");
        assert_eq!(status.why.contains("check the size of the printed marker"), is_expected);
    }
}

/// Frames from the pilot's flight count.
#[test]
fn a_landing_on_a_marker_that_was_seen_to_be_of_another_size_does_not_descend() {
    let mut flight = flight("command");
    flight.camera(0, CameraInfo::sample());
    flight.presence(0, "main", true);
    receive(&mut flight, 0, &heartbeat(4, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    for ms in (20..7000).step_by(20) {
        if ms % 1000 == 0 {
            receive(&mut flight, ms * MS, &heartbeat(4, true));
        }
        if ms == 6000 {
            let reply = flight.command(ms * MS, &ControllerCommand::Start);
            assert!(reply.accepted, "{reply:?}");
        }
        let height_at = |ms: i64| 5.0 + (ms as f32 / 1000.0 - 2.0).clamp(0.0, 3.0);
        pose_at(&mut flight, ms * MS, height_at(ms));
        if ms % 60 == 0 {
            let mut seen = seen(ms * MS - 40 * MS);
            move_to(&mut seen, [0.0, 0.0, f64::from(height_at(ms - 40)) / 2.0]);
            flight.detections(ms * MS + 2, "main", &seen);
        }
        flight.tick(ms * MS + 3);
    }
    let status = flight.status(7000 * MS);
    assert!(status.phase == Phase::Hold, "{status:?}");
    assert!(status.why.contains("check the size of the printed marker"), "{status:?}");
}

#[test]
fn a_detector_with_another_first_corner_counts_where_the_vehicle_turns_to_the_pad() {
    let status_of = |set: &[&str]| {
        let set: Vec<&str> = ["marker=aruco-4x4-50:7"].iter().chain(set).copied().collect();
        let mut flight = flight_with("airborne", &set);
        flight.camera(0, CameraInfo::sample());
        flight.presence(0, "main", true);
        receive(&mut flight, 0, &heartbeat(4, true));
        receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        for ms in (20..3000).step_by(20) {
            if ms % 1000 == 0 {
                receive(&mut flight, ms * MS, &heartbeat(4, true));
            }
            pose_at(&mut flight, ms * MS, 2.0);
            if ms % 60 == 0 {
                // Facing the camera; the other one begins with the marker's second corner.
                let quarter = std::f64::consts::FRAC_1_SQRT_2;
                for (name, rotation_wxyz) in
                    [("main", [0.0, 1.0, 0.0, 0.0]), ("other", [0.0, quarter, quarter, 0.0])]
                {
                    let mut seen = Detections { detector: name.into(), ..seen(ms * MS - 40 * MS) };
                    move_to(&mut seen, [0.0, 0.0, 2.0]);
                    let found = &mut seen.detections[0];
                    (found.family, found.id) = ("aruco-4x4-50".into(), Some(7));
                    let pose = &mut found.pose.as_mut().unwrap().camera_from_marker;
                    pose.rotation_wxyz = rotation_wxyz;
                    flight.detections(ms * MS + 2, name, &seen);
                }
            }
            flight.tick(ms * MS + 3);
        }
        flight.status(3000 * MS)
    };
    let status = status_of(&["metric.turn_rad_s=0.3"]);
    assert!(status.warnings[0].contains("0.00 m apart and turned by 90 degrees"), "{status:?}");
    assert!(status.why.contains("at two places or turned"), "{status:?}");
    for set in [
        &[][..],
        &["metric.turn_rad_s=0.3", "guidance=thesis"],
        &["metric.turn_rad_s=0.3", "mode=landing-target"],
    ] {
        let status = status_of(set);
        assert!(!status.warnings.iter().any(|it| it.contains("apart")), "{status:?}");
        assert!(!status.why.contains("turned"), "{status:?}");
    }
}

/// The warnings of a flight in view of a marker, with a frame each so many milliseconds; `sinks`: the vehicle goes down, and the
/// detections stay as they are.
fn warnings_of_frames(every_ms: i64, sinks: bool) -> Vec<String> {
    let mut flight = flight_with("airborne", &["autopilot.timesync=false"]);
    flight.camera(0, CameraInfo::sample());
    flight.presence(0, "main", true);
    receive(&mut flight, 0, &heartbeat(4, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    for ms in (20..12_000).step_by(20) {
        if ms % 1000 == 0 {
            receive(&mut flight, ms * MS, &heartbeat(4, true));
        }
        let sunk_m = (ms as f32 / 1000.0 - 4.0).clamp(0.0, 4.0);
        pose_at(&mut flight, ms * MS, 9.0 - if sinks { sunk_m } else { 0.0 });
        if ms % every_ms == 0 {
            flight.detections(ms * MS + 2, "main", &seen(ms * MS - 40 * MS));
        }
        flight.tick(ms * MS + 3);
    }
    flight.status(12_000 * MS).warnings
}

#[test]
fn a_detector_that_searches_too_few_frames_is_reported() {
    assert_eq!(warnings_of_frames(60, false), Vec::<String>::new());
    let warnings = warnings_of_frames(1000, false).join("; ");
    let text = "detector `main` searches only 1.0 frames per second, and 3 are needed (`detectors.min_rate_hz`)";
    assert!(warnings.contains(text), "{warnings}");
}

#[test]
fn old_detections_with_the_headers_of_new_frames_are_reported() {
    let warnings = warnings_of_frames(60, true).join("; ");
    assert!(warnings.contains("old detections with the headers of new frames"), "{warnings}");
    assert!(warnings.contains("`main`") && warnings.contains("; check the camera"), "{warnings}");
}

#[test]
fn a_low_battery_leads_to_the_configured_reaction() {
    let set = ["phases.on_battery_low=\"hold\"", "alarms.battery_s=1"];
    let mut flight = flight_with("airborne", &set);
    receive(&mut flight, 0, &heartbeat(4, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    hover(&mut flight, 1000, 2000, 4);
    assert_eq!(flight.status(2000 * MS).phase, Phase::Search);
    receive(&mut flight, 2000 * MS, &battery(15));
    hover(&mut flight, 2000, 3500, 4);
    let status = flight.status(3500 * MS);
    assert_eq!((status.phase, status.why.as_str()), (Phase::Hold, "the battery is low"));
}

fn warns_of_link_delay(flight: &Flight, now_ns: i64) -> bool {
    flight.status(now_ns).warnings.iter().any(|it| it.contains("TIMESYNC"))
}

#[test]
fn a_link_of_unknown_delay_counts_as_slow_and_is_reported() {
    for (set, is_expected) in
        [("autopilot.timesync=true", true), ("autopilot.timesync=false", false)]
    {
        let mut flight = flight_with("airborne", &[set]);
        flight.presence(0, "main", true);
        flight.camera(0, CameraInfo::sample());
        receive(&mut flight, 0, &heartbeat(4, true));
        receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        let warns = |flight: &Flight, ms: i64| warns_of_link_delay(flight, ms * MS);
        hover(&mut flight, 20, 2500, 4);
        assert!(!warns(&flight, 2500) && flight.link_delay_s() < 0.01, "it may still answer");
        hover(&mut flight, 2500, 6000, 4);
        assert_eq!(warns(&flight, 6000), is_expected, "{set}");
        assert!((flight.link_delay_s() - 0.3).abs() < 0.01, "{set}: {}", flight.link_delay_s());
    }
}

#[test]
fn the_last_known_delay_is_assumed_for_a_while() {
    let mut flight = flight("airborne");
    receive(&mut flight, 0, &heartbeat(4, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    // Each question is answered 200 ms later, for 5 s.
    let mut questions = Vec::new();
    for ms in (20..60_000).step_by(20) {
        let now_ns = ms * MS;
        if ms % 1000 == 0 {
            receive(&mut flight, now_ns, &heartbeat(4, true));
        }
        pose(&mut flight, now_ns);
        flight.tick(now_ns + 3);
        while let Some(packet) = flight.poll_outgoing() {
            for packet in Parser::new().push(&packet) {
                if let Some(MavMessage::TIMESYNC(question)) = packet.message {
                    questions.push((ms, question));
                }
            }
        }
        let (due, later) = questions.into_iter().partition(|(asked_ms, _)| ms - asked_ms >= 200);
        questions = later;
        let due: Vec<(i64, TIMESYNC_DATA)> = due;
        for (asked_ms, question) in due.into_iter().filter(|(asked_ms, _)| *asked_ms < 5000) {
            // Its clock is so far ahead that its positions are 100 ms old when they come.
            let answer = TIMESYNC_DATA { tc1: (asked_ms + 200) * MS, ..question };
            receive(&mut flight, now_ns, &MavMessage::TIMESYNC(answer));
        }
        // The age of positions shows it for 30 s more, and 10 s later it counts as not known.
        let (delay_s, is_reported) = (flight.link_delay_s(), warns_of_link_delay(&flight, now_ns));
        match ms {
            5000..44_000 => {
                assert!(
                    !is_reported && (0.15..0.25).contains(&delay_s),
                    "after {ms} ms: {delay_s} s"
                );
            }
            47_000.. => {
                assert!(is_reported && (delay_s - 0.3).abs() < 0.01, "after {ms} ms: {delay_s} s");
            }
            _ => {}
        }
    }
}

/// While the controller does not run the delay is not measured, and no frame is missing.
#[test]
fn a_standstill_of_the_controller_is_neither_a_link_without_answers_nor_a_camera_without_frames() {
    let mut flight = flight("airborne");
    flight.camera(0, CameraInfo::sample());
    flight.presence(0, "main", true);
    receive(&mut flight, 0, &heartbeat(4, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    for ms in (20..5000).chain(25_000..25_400).step_by(20) {
        let now_ns = ms * MS;
        if ms % 1000 == 0 {
            receive(&mut flight, now_ns, &heartbeat(4, true));
        }
        pose(&mut flight, now_ns);
        if ms % 60 == 0 && ms < 5000 {
            flight.detections(now_ns + 2, "main", &seen(now_ns));
        }
        flight.tick(now_ns + 3);
        let warnings = flight.status(now_ns + 4).warnings;
        let is_expected = |text: &String| !text.contains("TIMESYNC") && !text.contains("no frame");
        assert!(warnings.iter().all(is_expected), "after {ms} ms: {warnings:?}");
        while let Some(packet) = flight.poll_outgoing() {
            for packet in Parser::new().push(&packet) {
                if let Some(MavMessage::TIMESYNC(question)) = packet.message {
                    let answer = TIMESYNC_DATA { tc1: now_ns, ..question };
                    receive(&mut flight, now_ns + 4, &MavMessage::TIMESYNC(answer));
                }
            }
        }
    }
}

#[test]
fn a_link_that_was_unsteady_is_not_taken_for_a_slow_one_permanently() {
    let mut flight = flight("airborne");
    receive(&mut flight, 0, &heartbeat(4, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    let mut slow_s: f64 = 0.0;
    for ms in (20..30_000).step_by(20) {
        let now_ns = ms * MS;
        if ms % 1000 == 0 {
            receive(&mut flight, now_ns, &heartbeat(4, true));
        }
        // TIMESYNC is answered at once for 2 s; from 3 s to 8 s most packets are late by a time of their own.
        let is_unsteady = (3000..8000).contains(&ms);
        let late_ms = if is_unsteady { (ms * 7) % 900 } else { 0 };
        receive(&mut flight, now_ns, &attitude(now_ns - late_ms * MS));
        receive(&mut flight, now_ns + 1, &position(now_ns - late_ms * MS, 5.0));
        flight.tick(now_ns + 3);
        while let Some(packet) = flight.poll_outgoing() {
            for packet in Parser::new().push(&packet) {
                if let (Some(MavMessage::TIMESYNC(question)), true) = (packet.message, ms < 2000) {
                    let answer = TIMESYNC_DATA { tc1: now_ns, ..question };
                    receive(&mut flight, now_ns + 4, &MavMessage::TIMESYNC(answer));
                }
            }
        }
        slow_s = slow_s.max(flight.link_delay_s());
    }
    assert!(slow_s >= 1.0, "{slow_s} s");
    assert!(flight.link_delay_s() < 0.35, "{} s", flight.link_delay_s());
}

/// A ground station's heartbeat.
fn of_ground_station() -> MavMessage {
    MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        mavtype: MavType::MAV_TYPE_GCS,
        autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
        ..Default::default()
    })
}

#[test]
fn an_operator_is_lost_while_a_program_on_the_vehicle_says_that_it_is_a_ground_station() {
    let set = ["alarms.operator_lost_s=2", "phases.on_operator_lost=\"hold\""];
    for (system, is_lost) in [(1, true), (254, false)] {
        let mut flight = flight_with("airborne", &set);
        receive(&mut flight, 0, &heartbeat(4, true));
        receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        let operator = Sender { system: 255, component: 190 };
        receive_from(&mut flight, 2 * MS, operator, &of_ground_station());
        let program = Sender { system, component: 240 };
        for ms in (0..6000).step_by(500) {
            receive_from(&mut flight, ms * MS, program, &of_ground_station());
            hover(&mut flight, ms + 20, ms + 520, 4);
        }
        let status = flight.status(6000 * MS);
        assert_eq!(status.why.contains("operator"), is_lost, "{system}: {status:?}");
    }
}

#[test]
fn an_operator_is_not_lost_while_the_controller_does_not_run() {
    let set = ["alarms.operator_lost_s=5", "phases.on_operator_lost=\"hold\""];
    let mut flight = flight_with("airborne", &set);
    receive(&mut flight, 0, &heartbeat(4, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    let operator = Sender { system: 255, component: 190 };
    receive_from(&mut flight, 2 * MS, operator, &of_ground_station());
    hover(&mut flight, 20, 1000, 4);
    let is_lost = |flight: &Flight, ms: i64| {
        let status = flight.status(ms * MS);
        status.why.contains("operator")
    };
    // It does not run for 6 s.
    receive(&mut flight, 7000 * MS, &heartbeat(4, true));
    hover(&mut flight, 7020, 9000, 4);
    assert!(!is_lost(&flight, 9000), "{:?}", flight.status(9000 * MS));
    receive(&mut flight, 9000 * MS, &heartbeat(4, true));
    hover(&mut flight, 9020, 11_500, 4);
    assert!(is_lost(&flight, 11_500), "{:?}", flight.status(11_500 * MS));
}

/// The heartbeats of a vehicle with another system id, and of a companion with our ids.
fn others() -> [(Sender, MavMessage, &'static str); 2] {
    let companion = MavMessage::HEARTBEAT(autopilot::compose::heartbeat());
    [
        (Sender { system: 2, component: 1 }, heartbeat(4, true), "system ids 1 and 2"),
        (Sender { system: 1, component: 191 }, companion, "autopilot.component_id"),
    ]
}

#[test]
fn no_landing_begins_where_another_vehicle_or_another_controller_is_on_the_link() {
    let unpinned = |start: &str| {
        let mut flight = in_flight_with(start, &["autopilot.system_id=0"]);
        flight.camera(0, CameraInfo::sample());
        flight
    };
    for (sender, message, text) in others() {
        // By command.
        let mut flight = unpinned("command");
        receive_from(&mut flight, 2 * MS, sender, &message);
        hover(&mut flight, 20, 3000, 4);
        for command in [ControllerCommand::Start, ControllerCommand::LandHere] {
            let reply = flight.command(3000 * MS, &command);
            assert!(!reply.accepted && reply.reason.contains(text), "{reply:?}");
        }
        let status = flight.status(3001 * MS);
        assert!(status.warnings.iter().any(|it| it.contains(text)), "{:?}", status.warnings);
        assert_eq!(hover(&mut flight, 3020, 3500, 4).setpoints, 0);
        // By itself.
        for start in ["airborne", "resume", "takeoff"] {
            let mut flight = unpinned(start);
            receive_from(&mut flight, 2 * MS, sender, &message);
            sent(&mut flight);
            let asked = hover(&mut flight, 20, 3000, 4);
            assert!(asked.setpoints == 0 && asked.modes.is_empty(), "{start}: {asked:?}");
            let status = flight.status(3000 * MS);
            assert!(matches!(status.phase, Phase::Idle | Phase::Failed), "{start}: {status:?}");
            assert!(status.why.contains(text), "{start}: {}", status.why);
        }
    }
    // A landing under way is not ended.
    for (sender, message, _) in others() {
        let mut flight = unpinned("airborne");
        hover(&mut flight, 20, 3000, 4);
        receive_from(&mut flight, 3000 * MS, sender, &message);
        assert!(hover(&mut flight, 3000, 4000, 4).setpoints > 10);
    }
    // Nor is the vehicle that it has flown prevented from landing where it is, and, next to another vehicle, from beginning again.
    for (number, (sender, message, text)) in others().into_iter().enumerate() {
        let mut flight = unpinned("airborne");
        hover(&mut flight, 20, 3000, 4);
        receive_from(&mut flight, 3000 * MS, sender, &message);
        hover(&mut flight, 3000, 3500, 4);
        assert!(flight.command(3500 * MS, &ControllerCommand::Abort).accepted);
        hover(&mut flight, 3520, 10_000, 4);
        assert_eq!(flight.status(10_000 * MS).phase, Phase::Aborted);
        let again = flight.command(10_000 * MS, &ControllerCommand::Start);
        assert_eq!(again.reason.contains(text), number == 1, "{again:?}");
        let here = flight.command(10_020 * MS, &ControllerCommand::LandHere);
        assert!(here.accepted, "{here:?}");
    }
    // Nor does another vehicle keep the one from landing that is pinned.
    let [(sender, message, _), _] = others();
    let mut flight = flight_with("airborne", &["autopilot.system_id=1"]);
    receive(&mut flight, 0, &heartbeat(4, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    receive_from(&mut flight, 2 * MS, sender, &message);
    assert!(hover(&mut flight, 20, 3000, 4).setpoints > 10);
}

#[test]
fn no_landing_begins_automatically_before_packets_of_another_vehicle_would_arrive() {
    let [(other, of_other, text), _] = others();
    for start in ["airborne", "resume"] {
        for is_alone in [true, false] {
            let mut flight = in_flight_with(start, &["autopilot.system_id=0"]);
            flight.camera(0, CameraInfo::sample());
            flight.presence(0, "main", true);
            // A resumed landing is stopped at once.
            sent(&mut flight);
            assert_eq!(hover(&mut flight, 20, 900, 4).setpoints, 0);
            let status = flight.status(900 * MS);
            let listens = "waiting 2.5 s for heartbeats of another vehicle on the link";
            assert!(status.phase == Phase::Idle && status.why.contains(listens), "{status:?}");
            assert!(status.why.contains("`autopilot.system_id`"), "{status:?}");
            if !is_alone {
                receive_from(&mut flight, 900 * MS, other, &of_other);
            }
            assert_eq!(hover(&mut flight, 920, 2480, 4).setpoints, 0);
            let sent = hover(&mut flight, 2500, 4000, 4);
            assert_eq!(sent.setpoints > 10, is_alone, "{start}: {sent:?}");
            let status = flight.status(4000 * MS);
            assert_eq!(status.why.contains(text), !is_alone, "{status:?}");
        }
    }
}

#[test]
fn a_command_before_a_landing_is_resumed_counts_as_soon_as_it_is() {
    let at_once = |command| match command {
        ControllerCommand::Hold => (Phase::Hold, "held"),
        _ => (Phase::Aborted, "aborted"),
    };
    for is_known in [false, true] {
        for command in [ControllerCommand::Hold, ControllerCommand::Abort] {
            let setting = "autopilot.system_id=0";
            let mut flight = flight_with("resume", &[setting]);
            if is_known {
                flight = in_flight_with("resume", &[setting]);
                hover(&mut flight, 20, 900, 4);
            }
            flight.camera(0, CameraInfo::sample());
            flight.presence(0, "main", true);
            flight.tick(900 * MS);
            let why = flight.status(900 * MS).why;
            assert!(why.ends_with("; a landing under way is resumed then"), "{why}");
            let (phase, done) = at_once(command.clone());
            let reply = flight.command(901 * MS, &command);
            let later = format!("{done} as soon as it is resumed");
            assert!(reply.accepted && reply.reason.ends_with(&later), "{reply:?}");
            // A hold does not replace an abort.
            flight.command(902 * MS, &ControllerCommand::Hold);
            let why = flight.status(902 * MS).why;
            assert!(why.ends_with(&format!("is resumed then, and {done} at once")), "{why}");
            receive(&mut flight, 903 * MS, &heartbeat(4, true));
            receive(&mut flight, 903 * MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
            hover(&mut flight, 920, 6000, 4);
            let status = flight.status(6000 * MS);
            assert!(status.phase == phase && status.started_ns.is_some(), "{status:?}");
        }
    }
    // A hold is withdrawn by `resume`.
    let mut flight = flight_with("resume", &["autopilot.system_id=1"]);
    flight.camera(0, CameraInfo::sample());
    flight.presence(0, "main", true);
    assert!(flight.command(0, &ControllerCommand::Hold).accepted);
    assert!(flight.command(0, &ControllerCommand::Resume).accepted);
    receive(&mut flight, 0, &heartbeat(4, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    hover(&mut flight, 20, 4000, 4);
    let phase = flight.status(4000 * MS).phase;
    assert!(matches!(phase, Phase::Approach | Phase::Descend), "{phase:?}");
    // Without a landing to resume the command is of no effect on a later one.
    let mut flight = flight_with("resume", &["autopilot.system_id=1"]);
    assert!(flight.command(0, &ControllerCommand::Abort).accepted);
    receive(&mut flight, MS, &heartbeat(4, false));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND));
    pose_at(&mut flight, 2 * MS, 0.0);
    flight.tick(3 * MS);
    let reply = flight.command(4 * MS, &ControllerCommand::Abort);
    assert!(!reply.accepted && reply.reason.contains("no landing is active"), "{reply:?}");
    flight.camera(5 * MS, CameraInfo::sample());
    flight.presence(5 * MS, "main", true);
    receive(&mut flight, 1000 * MS, &heartbeat(4, true));
    receive(&mut flight, 1000 * MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    hover(&mut flight, 1020, 2000, 4);
    assert!(flight.command(2000 * MS, &ControllerCommand::Start).accepted);
    hover(&mut flight, 2020, 2500, 4);
    assert_eq!(flight.status(2500 * MS).phase, Phase::Approach);
}

#[test]
fn an_abort_before_there_proves_to_be_no_landing_to_resume_is_in_the_status() {
    let (in_air, on_ground) =
        (MavLandedState::MAV_LANDED_STATE_IN_AIR, MavLandedState::MAV_LANDED_STATE_ON_GROUND);
    for (mode, landed, text) in [
        // LAND high up may be the pilot's.
        (9, in_air, "the vehicle is not in GUIDED"),
        (5, in_air, "the vehicle is in LOITER"),
        (4, on_ground, "stands on the ground, and its motors run: disarm it"),
    ] {
        for command in [ControllerCommand::Abort, ControllerCommand::Hold] {
            let mut flight = flight("resume");
            flight.camera(0, CameraInfo::sample());
            flight.presence(0, "main", true);
            assert!(flight.command(0, &command).accepted);
            receive(&mut flight, MS, &heartbeat(mode, true));
            receive(&mut flight, MS, &contact(landed));
            let sent = hover(&mut flight, 20, 4000, mode);
            let status = flight.status(4000 * MS);
            let is_aborted = command == ControllerCommand::Abort;
            let expected = if is_aborted { Phase::Failed } else { Phase::Idle };
            assert_eq!(status.phase, expected, "{mode}: {status:?}");
            let is_stated =
                status.why.starts_with("aborted by the operator; no landing was resumed");
            assert_eq!(is_stated && status.why.contains(text), is_aborted, "{mode}: {status:?}");
            assert_eq!(status.finished, is_aborted);
            assert_eq!(status.started_ns, None, "it is not a vehicle that lands for us");
            // Before the mode is known, one setpoint stops a vehicle that follows setpoints.
            assert!(sent.setpoints <= 1 && sent.modes.is_empty(), "{mode}: {sent:?}");
            // The next one is landed by command.
            receive(&mut flight, 4000 * MS, &contact(in_air));
            hover(&mut flight, 5000, 6500, 4);
            assert!(flight.command(6500 * MS, &ControllerCommand::Start).accepted, "{mode}");
        }
    }
}

#[test]
fn an_abort_before_a_precision_landing_is_found_takes_the_autopilot_back_from_it() {
    let mut flight = flight_with("resume", &["mode=landing-target", "autopilot.system_id=1"]);
    flight.camera(0, CameraInfo::sample());
    flight.presence(0, "main", true);
    flight.tick(0);
    assert!(flight.command(0, &ControllerCommand::Abort).accepted);
    let why = flight.status(0).why;
    assert!(why.ends_with("; a landing under way is aborted once found"), "{why}");
    receive(&mut flight, MS, &heartbeat(9, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    let sent = hover(&mut flight, 20, 900, 9);
    assert!(sent.modes.contains(&4.0), "{sent:?} {:?}", flight.status(900 * MS));
    hover(&mut flight, 1000, 3000, 4);
    assert_eq!(flight.status(3000 * MS).phase, Phase::Aborted);
}

#[test]
fn what_was_missing_in_a_standstill_is_not_stated_before_the_next_tick() {
    let mut flight = in_flight("command");
    hover(&mut flight, 20, 1000, 4);
    assert!(!flight.has_stood_still(1010 * MS));
    receive(&mut flight, 21_000 * MS, &heartbeat(4, true));
    assert!(flight.has_stood_still(21_000 * MS));
    flight.tick(21_001 * MS);
    assert!(!flight.has_stood_still(21_001 * MS));
}

#[test]
fn no_command_begins_a_landing_before_packets_of_another_vehicle_would_arrive() {
    for command in [ControllerCommand::Start, ControllerCommand::LandHere] {
        for system_id in [0, 1] {
            let pinned = format!("autopilot.system_id={system_id}");
            let mut flight = in_flight_with("command", &[&pinned]);
            flight.camera(0, CameraInfo::sample());
            flight.presence(0, "main", true);
            hover(&mut flight, 20, 2480, 4);
            let early = flight.command(2480 * MS, &command);
            assert_eq!(early.accepted, system_id == 1, "{early:?}");
            if system_id == 1 {
                continue;
            }
            assert!(early.reason.contains("waiting 2.5 s for heartbeats"), "{early:?}");
            assert!(early.reason.ends_with("Give the command again"), "{early:?}");
            assert_eq!(hover(&mut flight, 2500, 2600, 4).setpoints, 0);
            let reply = flight.command(2600 * MS, &command);
            assert!(reply.accepted, "{reply:?}");
        }
    }
}

#[test]
fn a_landing_is_resumed_with_its_own_vehicle_although_another_one_is_present() {
    let [(other, of_other, text), _] = others();
    let on_ground = contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND);
    for landed in [None, Some(1)] {
        let mut config = config("resume", &["autopilot.system_id=0"]);
        config.go_on_with(landed);
        let mut flight = Flight::new(config, Arc::default()).unwrap();
        flight.presence(0, "main", true);
        assert_eq!(flight.landed_system(), landed, "it is to be resumed");
        // A packet of the other one arrives first.
        receive_from(&mut flight, 0, other, &of_other);
        receive(&mut flight, MS, &heartbeat(4, true));
        receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        let sent = hover(&mut flight, 20, 5000, 4);
        let status = flight.status(5000 * MS);
        if landed.is_none() {
            let is_reported = ["system ids 2 and 1", text].iter().any(|it| status.why.contains(it));
            assert!(status.phase == Phase::Idle && is_reported, "{status:?}");
            continue;
        }
        assert!(status.phase == Phase::Search && sent.setpoints > 50, "{status:?} {sent:?}");
        assert!(status.autopilot.contains("system 1"), "{status:?}");
        assert_eq!(flight.landed_system(), Some(1));
        receive(&mut flight, 5000 * MS, &heartbeat(4, false));
        receive(&mut flight, 5001 * MS, &on_ground);
        pose_at(&mut flight, 5020 * MS, 0.0);
        flight.tick(5030 * MS);
        assert_eq!(flight.landed_system(), None, "{:?}", flight.status(5030 * MS));
    }
    // A pinned vehicle stays pinned, and no other start takes over a landing.
    for (start, set, pinned) in
        [("resume", "autopilot.system_id=3", 3), ("airborne", "autopilot.system_id=0", 0)]
    {
        let mut config = config(start, &[set]);
        config.go_on_with(Some(7));
        assert_eq!(config.autopilot.system_id, pinned);
    }
}

#[test]
fn a_landing_begins_once_the_other_controller_has_ended() {
    let [_, (sender, message, _)] = others();
    let mut flight = in_flight("airborne");
    flight.presence(0, "main", true);
    flight.camera(0, CameraInfo::sample());
    receive_from(&mut flight, 2 * MS, sender, &message);
    assert_eq!(hover(&mut flight, 20, 9000, 4).setpoints, 0);
    assert!(hover(&mut flight, 9000, 12_000, 4).setpoints > 10);
}

#[test]
fn land_is_requested_once_per_interval_after_a_battery_alarm() {
    let set = ["alarms.battery_critical_v=13", "alarms.battery_s=0.1"];
    let mut flight = in_flight_with("airborne", &set);
    hover(&mut flight, 1000, 2000, 4);
    let battery = SYS_STATUS_DATA { voltage_battery: 12_600, ..Default::default() };
    receive(&mut flight, 2000 * MS, &MavMessage::SYS_STATUS(battery));
    let mut asked_ms = Vec::new();
    for ms in (2000..3500).step_by(20) {
        // The second state has waited in a queue since before the tick.
        for (state_ms, tick_ms) in [(ms, ms + 3), (ms + 2, ms + 3)] {
            pose(&mut flight, state_ms * MS);
            flight.tick(tick_ms * MS);
        }
        let mut sent = Sent::default();
        sent.take(&mut flight);
        asked_ms.extend(sent.modes.iter().map(|_| ms));
    }
    assert_eq!(flight.status(3500 * MS).phase, Phase::Final);
    assert!(asked_ms.len() > 1 && asked_ms[0] < 2150, "{asked_ms:?}");
    assert!(asked_ms.windows(2).all(|it| it[1] - it[0] >= 480), "{asked_ms:?}");
}

#[test]
fn a_landing_for_an_alarm_or_a_command_shows_the_reason_until_after_it() {
    let reasons = |set: &[&str], begin: &dyn Fn(&mut Flight)| {
        let mut flight = flight_with("airborne", set);
        receive(&mut flight, 0, &heartbeat(4, true));
        receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        hover(&mut flight, 1000, 2000, 4);
        begin(&mut flight);
        let asked = hover(&mut flight, 2000, 2500, 4);
        assert!(asked.modes.contains(&9.0), "{:?}", asked.modes);
        hover(&mut flight, 3000, 4000, 9);
        let landing = flight.status(4000 * MS);
        receive(&mut flight, 4001 * MS, &contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND));
        receive(&mut flight, 4002 * MS, &heartbeat(9, false));
        pose(&mut flight, 4020 * MS);
        flight.tick(4030 * MS);
        let landed = flight.status(4030 * MS);
        assert_eq!((landing.phase, landed.phase), (Phase::Final, Phase::Landed));
        (landing.why, landed.why)
    };
    let empty = |flight: &mut Flight| {
        let battery = SYS_STATUS_DATA { voltage_battery: 12_600, ..Default::default() };
        receive(flight, 2000 * MS, &MavMessage::SYS_STATUS(battery));
    };
    let (landing, landed) =
        reasons(&["alarms.battery_critical_v=13", "alarms.battery_s=0.1"], &empty);
    assert_eq!(landing, "the battery is nearly empty: the autopilot is landing");
    assert_eq!(landed, "on the ground, disarmed: the battery is nearly empty");
    let command = |flight: &mut Flight| {
        assert!(flight.command(2000 * MS, &ControllerCommand::LandHere).accepted);
    };
    let (landing, landed) = reasons(&[], &command);
    assert_eq!(landing, "the operator's command to land here: the autopilot is landing");
    assert_eq!(landed, "on the ground, disarmed: the operator's command to land here");
}

fn detector_info(detector: &str, camera: &str) -> DetectorInfo {
    DetectorInfo {
        detector: detector.into(),
        host: "drone".into(),
        place: Place::Onboard,
        camera: camera.into(),
        markers: Vec::new(),
        version: "test".into(),
        pid: 1,
    }
}

#[test]
fn a_camera_without_frames_is_reported_and_its_detectors_are_not_reported_as_gone() {
    let mut flight = in_flight_with("airborne", &["autopilot.timesync=false"]);
    hover(&mut flight, 1000, 3000, 4);
    let info = detector_info("main", "down");
    let is_reported =
        |status: &ControllerStatus| status.warnings.iter().any(|it| it.contains("no frame"));
    // The frames end; the detector continues to publish its information. After a minute the selection forgets it.
    for ms in (3000..80_000).step_by(20) {
        let now_ns = ms * MS;
        if ms % 1000 == 0 {
            receive(&mut flight, now_ns, &heartbeat(4, true));
            flight.on_detector_info(now_ns, "main", &info);
        }
        pose(&mut flight, now_ns);
        flight.tick(now_ns + 3);
        let status = flight.status(now_ns + 3);
        let gone = ["gone", "no detector is alive"];
        assert!(!gone.iter().any(|it| status.why.contains(it)), "{status:?}");
        assert!(!status.detector_why.contains("gone"), "{status:?}");
        assert_eq!(is_reported(&status), ms >= 4940, "after {ms} ms: {status:?}");
        if ms == 16_000 {
            let text = "no frame from camera `down` for 13 s: check the camera, and whether its detector hangs or sends unreadable messages";
            assert_eq!(status.warnings, [text]);
            assert!(status.why.ends_with(text), "{}", status.why);
        }
    }
    // One that has gone is reported as before.
    flight.presence(80_000 * MS, "main", false);
    flight.tick(80_001 * MS);
    let status = flight.status(80_001 * MS);
    assert!(!is_reported(&status), "{status:?}");
    assert_eq!(status.why, "no detector is alive, nothing descends");
}

#[test]
fn a_camera_without_frames_is_reported_next_to_one_with_frames() {
    let mut flight = in_flight("airborne");
    let (main, other) = (detector_info("main", "down"), detector_info("other", "wide"));
    let dead = |s: i64| {
        format!(
            "no frame from camera `wide` for {s} s: check the camera, and whether its detector hangs or sends unreadable messages"
        )
    };
    for s in 1..40 {
        hover(&mut flight, s * 1000, (s + 1) * 1000, 4);
        let now_ns = (s + 1) * 1000 * MS;
        flight.on_detector_info(now_ns, "main", &main);
        let (since, is_there) = match s {
            // The other camera takes more than ten seconds to start.
            3..18 => (3, true),
            // Its detector ends and returns: nothing shows the camera, and it has time to start again.
            24..40 => (24, s < 36),
            _ => (s, false),
        };
        if is_there {
            flight.on_detector_info(now_ns, "other", &other);
        }
        if s == 18 {
            flight.presence(now_ns, "other", false);
        }
        let status = flight.status(now_ns);
        let silence_s = s - since;
        // A detector without a message for three and a half seconds is not present.
        let is_forgotten = s >= 39;
        let is_reported = silence_s > 10 && !is_forgotten;
        let expected: Vec<_> = is_reported.then(|| dead(silence_s)).into_iter().collect();
        let warnings: Vec<_> =
            status.warnings.iter().filter(|it| it.contains("no frame")).collect();
        assert_eq!(warnings, expected.iter().collect::<Vec<_>>(), "after {s} s: {status:?}");
        assert!(!status.why.contains("nothing descends"), "{status:?}");
    }
}

#[test]
fn a_landing_on_centres_without_poses_is_refused_with_its_reason_and_one_under_way_shows_it() {
    for (start, guidance, is_expected) in
        [("command", "metric", true), ("airborne", "metric", true), ("command", "thesis", false)]
    {
        let mut flight = flight_with(start, &[&format!("guidance=\"{guidance}\"")]);
        flight.camera(0, CameraInfo::sample());
        receive(&mut flight, 0, &heartbeat(4, true));
        receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        for ms in (20..3000).step_by(20) {
            if ms % 1000 == 0 {
                receive(&mut flight, ms * MS, &heartbeat(4, true));
            }
            pose(&mut flight, ms * MS);
            if ms % 60 == 0 {
                let mut seen = seen(ms * MS - 40 * MS);
                seen.detections[0].pose = None;
                flight.detections(ms * MS + 2, "main", &seen);
            }
            flight.tick(ms * MS + 3);
        }
        let now_ns = 3000 * MS;
        let status = flight.status(now_ns);
        let text = "`main` gives no pose";
        assert_eq!(status.warnings.iter().any(|it| it.contains(text)), is_expected, "{status:?}");
        if start == "airborne" {
            assert!(status.why.contains(text), "{}: {}", status.phase, status.why);
        } else {
            let reply = flight.command(now_ns, &ControllerCommand::Start);
            assert_eq!(!reply.accepted && reply.reason.contains(text), is_expected, "{reply:?}");
        }
    }
}

/// At a start a detector searches frames before the camera's calibration arrives.
#[test]
fn first_frames_without_poses_are_no_warning() {
    let mut flight = flight_with("command", &[]);
    flight.camera(0, CameraInfo::sample());
    receive(&mut flight, 0, &heartbeat(4, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    for ms in (20..6000).step_by(20) {
        if ms % 1000 == 0 {
            receive(&mut flight, ms * MS, &heartbeat(4, true));
        }
        pose(&mut flight, ms * MS);
        if ms % 60 == 0 {
            let mut seen = seen(ms * MS - 40 * MS);
            if ms < 1500 {
                seen.detections[0].pose = None;
            }
            flight.detections(ms * MS + 2, "main", &seen);
        }
        flight.tick(ms * MS + 3);
        let status = flight.status(ms * MS + 3);
        assert!(!status.warnings.iter().any(|it| it.contains("pose")), "{ms} ms: {status:?}");
        assert!(!status.why.contains("pose"), "{ms} ms: {status:?}");
    }
}

/// The information of a detector that looks for these markers.
fn looking_for(detector: &str, markers: &[&str]) -> DetectorInfo {
    let markers = markers.iter().map(|it| (*it).to_owned()).collect();
    DetectorInfo { markers, ..detector_info(detector, "down") }
}

#[test]
fn a_landing_on_a_marker_that_no_detector_looks_for_is_refused_and_no_motor_started() {
    let other = ["aruco-4x4-50:7:0.15"];
    let text = "no detector looks for the landing's marker rings: `main` looks for aruco-4x4-50:7";
    let start = |infos: &[DetectorInfo], sees: bool| {
        let mut flight = in_flight("command");
        flight.camera(0, CameraInfo::sample());
        flight.presence(0, "main", true);
        for info in infos {
            flight.on_detector_info(2 * MS, &info.detector, info);
        }
        for ms in (20..1000).step_by(20) {
            pose(&mut flight, ms * MS);
            let seen = seen(ms * MS - 10 * MS);
            let none = Detections { detections: Vec::new(), ..seen.clone() };
            flight.detections(ms * MS + 2, "main", if sees { &seen } else { &none });
            flight.tick(ms * MS + 3);
        }
        let warned = flight.status(1000 * MS).warnings.iter().any(|it| it.contains(text));
        let reply = flight.command(1000 * MS, &ControllerCommand::Start);
        assert_eq!(!reply.accepted, warned, "{reply:?}");
        assert!(reply.accepted || reply.reason.contains(text), "{reply:?}");
        reply.accepted
    };
    let main = looking_for("main", &other);
    assert!(!start(std::slice::from_ref(&main), false));
    assert!(!start(&[main.clone(), looking_for("spare", &other)], false));
    assert!(start(&[main.clone(), looking_for("spare", &["rings:0.15"])], false));
    assert!(start(&[main.clone(), looking_for("mine", &[])], false), "one states no markers");
    assert!(start(&[], false), "it publishes no information");
    assert!(start(std::slice::from_ref(&main), true), "it sees the marker all the same");

    for (markers, is_armed) in [(&other, false), (&["rings:0.15341"], true)] {
        let mut flight = flight("takeoff");
        let mut commands = Vec::new();
        for ms in (0..20_000).step_by(20) {
            let now_ns = ms * MS;
            if ms % 1000 == 0 {
                receive(&mut flight, now_ns, &heartbeat(4, false));
                let on_ground = MavLandedState::MAV_LANDED_STATE_ON_GROUND;
                receive(&mut flight, now_ns, &contact(on_ground));
                let ready = MavSysStatusSensor::MAV_SYS_STATUS_PREARM_CHECK;
                let ready = SYS_STATUS_DATA {
                    onboard_control_sensors_present: ready,
                    onboard_control_sensors_enabled: ready,
                    onboard_control_sensors_health: ready,
                    battery_remaining: -1,
                    ..Default::default()
                };
                receive(&mut flight, now_ns, &MavMessage::SYS_STATUS(ready));
                let flags = EkfStatusFlags::EKF_ATTITUDE
                    | EkfStatusFlags::EKF_VELOCITY_HORIZ
                    | EkfStatusFlags::EKF_VELOCITY_VERT
                    | EkfStatusFlags::EKF_POS_VERT_ABS
                    | EkfStatusFlags::EKF_POS_HORIZ_ABS;
                let estimate = EKF_STATUS_REPORT_DATA { flags, ..Default::default() };
                receive(&mut flight, now_ns, &MavMessage::EKF_STATUS_REPORT(estimate));
                flight.on_detector_info(now_ns, "main", &looking_for("main", markers));
            }
            pose_at(&mut flight, now_ns, 0.0);
            flight.tick(now_ns + 3);
            commands.extend(sent(&mut flight).1);
        }
        let arms = commands.contains(&MavCmd::MAV_CMD_COMPONENT_ARM_DISARM);
        let status = flight.status(20_000 * MS);
        assert_eq!(arms, is_armed, "{commands:?}, {}", status.why);
        assert_eq!(status.why.contains(text), !is_armed, "{status:?}");
        assert!(is_armed || status.phase == Phase::Takeoff, "{status:?}");
    }
}

/// A vehicle that stands, ready or not, in this mode.
fn stand(flight: &mut Flight, ms: i64, mode: u32, is_ready: bool) {
    if ms % 1000 == 0 {
        receive(flight, ms * MS, &heartbeat(mode, false));
        let on_ground = MavLandedState::MAV_LANDED_STATE_ON_GROUND;
        receive(flight, ms * MS, &contact(on_ground));
        let flags = EkfStatusFlags::from_bits_retain(if is_ready { 831 } else { 0 });
        let estimate = EKF_STATUS_REPORT_DATA { flags, ..Default::default() };
        receive(flight, ms * MS, &MavMessage::EKF_STATUS_REPORT(estimate));
    }
    pose_at(flight, ms * MS, 0.0);
    if ms % 200 == 0 {
        let searched = Detections { detections: Vec::new(), ..seen((ms - 40) * MS) };
        flight.detections(ms * MS + 2, "main", &searched);
    }
    flight.tick(ms * MS + 3);
}

#[test]
fn a_takeoff_that_waits_for_a_detector_asks_for_no_motors_and_its_time_stands_still() {
    // The wait comes before the vehicle is ready, and once its motors are asked for.
    for asks_first in [false, true] {
        let mut flight = flight_with("takeoff", &["autopilot.system_id=1"]);
        flight.presence(0, "main", true);
        let look = |flight: &mut Flight, ms: i64, marker: &str| {
            flight.on_detector_info(ms * MS, "main", &looking_for("main", &[marker]));
        };
        let arms = |flight: &mut Flight| {
            let arm = MavCmd::MAV_CMD_COMPONENT_ARM_DISARM;
            sent(flight).1.iter().filter(|it| **it == arm).count()
        };
        look(&mut flight, 0, "rings:0.15341");
        let mut ms = 0;
        let mut asked = 0;
        while ms < 50_000 && asked == 0 {
            stand(&mut flight, ms, 4, asks_first);
            asked += arms(&mut flight);
            ms += 20;
        }
        assert_eq!(asked > 0, asks_first, "{:?}", flight.status(ms * MS));
        look(&mut flight, ms, "aruco-4x4-50:7:0.15");
        let until_ms = ms + 55_000;
        while ms < until_ms {
            stand(&mut flight, ms, 4, asks_first);
            ms += 20;
            let status = flight.status(ms * MS);
            let is_shown = status.why.contains("no detector looks for the landing's marker");
            assert!(status.phase == Phase::Takeoff && is_shown, "{status:?}");
            assert_eq!(arms(&mut flight), 0, "at {ms} ms");
        }
        // It is there: the remaining time has not changed, and the motors are requested.
        look(&mut flight, ms, "rings:0.15341");
        let until_ms = ms + 60_000;
        let mut asked = 0;
        while ms < until_ms && asked == 0 {
            stand(&mut flight, ms, 4, asks_first || ms > until_ms - 10_000);
            asked += arms(&mut flight);
            ms += 20;
        }
        let status = flight.status(ms * MS);
        assert!(asked > 0 && status.phase == Phase::Takeoff, "{asks_first}: {asked} {status:?}");
    }
}

#[test]
fn other_markers_that_are_seen_instead_of_the_landings_are_named() {
    let text = "`main` sees aruco-4x4-50:3, pad:2 and not the landing's marker aruco-4x4-50:7";
    let seen_as = |ms: i64, id: u32| {
        let mut seen = seen(ms * MS - 40 * MS);
        let found = seen.detections.remove(0);
        let tag = Detection { family: "aruco-4x4-50".into(), id: Some(id), ..found.clone() };
        let pad = Detection { family: "pad".into(), id: Some(2), ..found };
        seen.detections.extend([tag, pad]);
        seen
    };
    let mut flight = flight_with("airborne", &["marker=aruco-4x4-50:7"]);
    flight.camera(0, CameraInfo::sample());
    receive(&mut flight, 0, &heartbeat(4, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    for ms in (20..8000).step_by(20) {
        if ms % 1000 == 0 {
            receive(&mut flight, ms * MS, &heartbeat(4, true));
        }
        pose(&mut flight, ms * MS);
        if ms % 60 == 0 {
            flight.detections(ms * MS + 2, "main", &seen_as(ms, if ms < 4000 { 3 } else { 7 }));
        }
        flight.tick(ms * MS + 3);
        let status = flight.status(ms * MS + 3);
        let is_reported = status.warnings.iter().any(|it| it.contains(text));
        let says_why = status.why.contains(text);
        match ms {
            ..2000 => assert!(!is_reported && !says_why, "{ms}: {status:?}"),
            2200..4000 => assert!(is_reported && says_why, "{ms}: {status:?}"),
            4100.. => assert!(!is_reported && !says_why, "{ms}: {status:?}"),
            _ => {}
        }
    }
}

#[test]
fn a_takeoff_with_a_battery_at_its_critical_limit_is_refused_before_the_motors_are_armed() {
    let off = "phases.on_battery_critical=ignore";
    // One reading decides nothing, nor does an alarm that is off.
    for (volts, later, set, is_refused) in [
        (13.0, 13.0, "", true),
        (13.1, 13.1, "", false),
        (13.0, 13.1, "", false),
        (13.0, 13.0, off, false),
    ] {
        let set: Vec<&str> =
            ["alarms.battery_critical_v=13", set].into_iter().filter(|it| !it.is_empty()).collect();
        let mut flight = flight_with("takeoff", &set);
        receive(&mut flight, 0, &heartbeat(4, false));
        receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND));
        for ms in (20..4000).step_by(20) {
            if ms % 500 == 0 || ms == 20 {
                let volts: f64 = if ms < 1500 { volts } else { later };
                let voltage_battery = (volts * 1e3) as u16;
                let battery = SYS_STATUS_DATA {
                    voltage_battery,
                    battery_remaining: -1,
                    ..Default::default()
                };
                receive(&mut flight, ms * MS, &MavMessage::SYS_STATUS(battery));
            }
            if ms % 1000 == 0 {
                receive(&mut flight, ms * MS, &heartbeat(4, false));
            }
            flight.tick(ms * MS + 3);
            let is_failed = flight.status(ms * MS + 4).phase == Phase::Failed;
            assert!(!is_failed || is_refused && ms >= 3000, "{ms} ms");
        }
        let status = flight.status(4000 * MS);
        assert_eq!(status.phase == Phase::Failed && status.finished, is_refused, "{status:?}");
        let names = ["13.0 V", "critical at 13 V", "alarms.battery_critical_v"];
        assert_eq!(names.iter().all(|name| status.why.contains(name)), is_refused, "{status:?}");
    }
}

#[test]
fn a_controller_that_ends_arms_no_motors_any_more() {
    let mut flight = flight_with("takeoff", &[]);
    receive(&mut flight, 0, &heartbeat(4, false));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND));
    let ready = EkfStatusFlags::from_bits_retain(831);
    let mut asked = false;
    let mut ms = 20;
    while !asked {
        assert!(ms < 5000, "{:?}", flight.status(ms * MS));
        let ekf = EKF_STATUS_REPORT_DATA { flags: ready, ..Default::default() };
        receive(&mut flight, ms * MS, &MavMessage::EKF_STATUS_REPORT(ekf));
        if ms % 1000 == 0 {
            receive(&mut flight, ms * MS, &heartbeat(4, false));
        }
        pose_at(&mut flight, ms * MS, 0.0);
        flight.tick(ms * MS + 3);
        asked = sent(&mut flight).1.contains(&MavCmd::MAV_CMD_COMPONENT_ARM_DISARM);
        ms += 20;
    }
    // It has no answer.
    for ms in (ms..ms + 2900).step_by(20) {
        if ms % 1000 == 0 {
            receive(&mut flight, ms * MS, &heartbeat(4, false));
        }
        flight.shutdown(ms * MS);
        assert_eq!(sent(&mut flight).1, [], "at {ms} ms");
    }
}

#[test]
fn after_a_pilots_landing_the_next_flight_is_landed() {
    let mut flight = flight("airborne");
    receive(&mut flight, 0, &heartbeat(9, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_LANDING));
    hover(&mut flight, 20, 1000, 9);
    assert_eq!(flight.status(1000 * MS).phase, Phase::Idle);
    receive(&mut flight, 1000 * MS, &heartbeat(9, false));
    receive(&mut flight, 1001 * MS, &contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND));
    receive(&mut flight, 5000 * MS, &heartbeat(4, true));
    receive(&mut flight, 5001 * MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    hover(&mut flight, 5020, 5500, 4);
    assert_eq!(flight.status(5500 * MS).phase, Phase::Search);
}

#[test]
fn only_a_resumed_landing_begins_automatically() {
    let next_flight = |start: &str, mode: u32, contact_at_start: MavLandedState, armed_ms: i64| {
        let mut flight = flight(start);
        flight.presence(0, "main", true);
        receive(&mut flight, 0, &heartbeat(mode, true));
        receive(&mut flight, MS, &contact(contact_at_start));
        hover(&mut flight, 20, 1000, mode);
        let first = flight.status(1000 * MS).phase;
        receive(&mut flight, 1000 * MS, &heartbeat(mode, false));
        receive(&mut flight, 1001 * MS, &contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND));
        pose(&mut flight, 1010 * MS);
        flight.tick(1011 * MS);
        (1020..armed_ms).step_by(20).for_each(|ms| flight.tick(ms * MS));
        receive(&mut flight, armed_ms * MS, &heartbeat(4, true));
        let now_ns = (armed_ms + 1) * MS;
        receive(&mut flight, now_ns, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        hover(&mut flight, armed_ms + 20, armed_ms + 500, 4);
        (first, flight.status((armed_ms + 500) * MS).phase)
    };
    let (flying, landing) =
        (MavLandedState::MAV_LANDED_STATE_IN_AIR, MavLandedState::MAV_LANDED_STATE_LANDING);
    for (start, mode, contact, first, armed_ms, next) in [
        ("resume", 4, flying, Phase::Search, 20_000, Phase::Landed),
        ("resume", 5, flying, Phase::Idle, 20_000, Phase::Idle),
        ("resume", 9, landing, Phase::Idle, 20_000, Phase::Idle),
        ("airborne", 4, flying, Phase::Search, 20_000, Phase::Search),
        ("airborne", 5, flying, Phase::Idle, 20_000, Phase::Search),
        // Motors that run again so soon were not off: the landing continues.
        ("resume", 4, flying, Phase::Search, 5000, Phase::Search),
        ("resume", 5, flying, Phase::Idle, 5000, Phase::Idle),
    ] {
        let phases = next_flight(start, mode, contact, armed_ms);
        assert_eq!(phases, (first, next), "{start} in {mode}, armed after {armed_ms} ms");
    }
}

#[test]
fn arming_again_right_after_a_landing_has_the_next_flight_landed() {
    let mut flight = in_flight("airborne");
    let phase_at = |flight: &mut Flight, from_ms: i64, to_ms: i64| {
        for ms in (from_ms..to_ms).step_by(20) {
            pose(flight, ms * MS);
            flight.tick(ms * MS + 3);
        }
        flight.status(to_ms * MS).phase
    };
    assert_eq!(phase_at(&mut flight, 20, 500), Phase::Search);
    receive(&mut flight, 500 * MS, &heartbeat(4, false));
    receive(&mut flight, 501 * MS, &contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND));
    assert_eq!(phase_at(&mut flight, 520, 1000), Phase::Landed);
    receive(&mut flight, 1000 * MS, &heartbeat(4, true));
    assert_eq!(phase_at(&mut flight, 1020, 2000), Phase::Landed, "it stands, armed");
    receive(&mut flight, 2000 * MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    assert_eq!(phase_at(&mut flight, 2020, 2500), Phase::Search);
}

#[test]
fn a_pilot_ends_the_wait_of_a_vehicle_that_took_off_for_its_landing() {
    for (mode, armed, text) in [(5, true, "the pilot took over, in LOITER"), (4, false, "stopped")]
    {
        let mut flight = in_flight("takeoff");
        flight.camera(0, CameraInfo::sample());
        for ms in (20..2600).step_by(20) {
            flight.detections(ms * MS, "main", &of_another_clock(ms * MS));
            if ms > 1600 {
                pose(&mut flight, ms * MS);
            }
            if ms % 1000 == 0 {
                receive(&mut flight, ms * MS, &heartbeat(4, true));
            }
            flight.tick(ms * MS + 3);
        }
        let status = flight.status(2600 * MS);
        assert!(status.phase == Phase::Takeoff && status.why.contains("myhost"), "{status:?}");
        receive(&mut flight, 2600 * MS, &heartbeat(mode, armed));
        hover(&mut flight, 2620, 2700, mode);
        let status = flight.status(2700 * MS);
        assert!(status.phase == Phase::Failed && status.why.contains(text), "{status:?}");
        // Back in GUIDED, with nothing in the way any more, only a command begins.
        receive(&mut flight, 5000 * MS, &heartbeat(4, true));
        hover(&mut flight, 5020, 8000, 4);
        assert_eq!(flight.status(8000 * MS).phase, Phase::Failed);
        let reply = flight.command(8000 * MS, &ControllerCommand::Start);
        assert!(reply.accepted, "{reply:?}");
    }
}

#[test]
fn after_a_standstill_of_more_than_15_s_a_takeoff_starts_no_motors() {
    for (stood_ms, arms) in [(14_000, true), (20_000, false)] {
        let mut flight = flight_with("takeoff", &[]);
        flight.presence(0, "main", true);
        for ms in (0..5000).step_by(20) {
            stand(&mut flight, ms, 4, false);
        }
        sent(&mut flight);
        let mut commands = Vec::new();
        for ms in (5000 + stood_ms..10_000 + stood_ms).step_by(20) {
            stand(&mut flight, ms, 4, true);
            commands.extend(sent(&mut flight).1);
        }
        let status = flight.status((10_000 + stood_ms) * MS);
        let arm = MavCmd::MAV_CMD_COMPONENT_ARM_DISARM;
        assert_eq!(commands.contains(&arm), arms, "{stood_ms} ms: {status:?}");
        assert_eq!(status.phase == Phase::Failed, !arms, "{status:?}");
        assert_eq!(status.why.contains("did not run for 20 s"), !arms, "{status:?}");
    }
}

#[test]
fn after_a_standstill_of_more_than_15_s_a_landing_that_was_to_begin_waits_for_a_command() {
    let commands = [ControllerCommand::Resume, ControllerCommand::Start];
    for (start, command) in ["takeoff", "resume", "airborne"]
        .into_iter()
        .flat_map(|start| commands.iter().map(move |command| (start, command)))
    {
        for (stood_ms, begins) in [(14_000, true), (20_000, false)] {
            let mut flight = in_flight(start);
            flight.camera(0, CameraInfo::sample());
            flight.presence(0, "main", true);
            // Attitude and position are missing.
            for ms in (20..3000).step_by(20) {
                if ms % 1000 == 0 {
                    receive(&mut flight, ms * MS, &heartbeat(4, true));
                }
                flight.tick(ms * MS + 3);
            }
            // A resumed landing is stopped at once.
            sent(&mut flight);
            let end_ms = 3000 + stood_ms;
            receive(&mut flight, end_ms * MS, &heartbeat(4, true));
            let after = hover(&mut flight, end_ms, end_ms + 4000, 4);
            let status = flight.status((end_ms + 4000) * MS);
            assert_eq!(after.setpoints > 0, begins, "{start}: {status:?}");
            if begins {
                continue;
            }
            assert!(status.why.contains("did not run for 20 s: `resume` begins"), "{status:?}");
            assert!(status.started_ns.is_none(), "{status:?}");
            let reply = flight.command((end_ms + 4000) * MS, command);
            assert!(reply.accepted, "{start}: {reply:?}");
            let sent = hover(&mut flight, end_ms + 4020, end_ms + 6000, 4);
            assert!(sent.setpoints > 10, "{start}: {:?}", flight.status((end_ms + 6000) * MS));
        }
    }
}

#[test]
fn after_a_standstill_of_more_than_15_s_a_takeoff_whose_motors_run_on_the_ground_ends() {
    let mut flight = flight_with("takeoff", &["autopilot.system_id=1"]);
    flight.camera(0, CameraInfo::sample());
    flight.presence(0, "main", true);
    for ms in (0..1000).step_by(20) {
        stand(&mut flight, ms, 4, true);
    }
    assert!(sent(&mut flight).1.contains(&MavCmd::MAV_CMD_COMPONENT_ARM_DISARM));
    receive(&mut flight, 1000 * MS, &heartbeat(4, true));
    flight.tick(1020 * MS);
    sent(&mut flight);
    let mut commands = Vec::new();
    for ms in (21_000..40_000).step_by(20) {
        if ms % 1000 == 0 {
            receive(&mut flight, ms * MS, &heartbeat(4, true));
        }
        pose_at(&mut flight, ms * MS, 0.0);
        flight.tick(ms * MS + 3);
        commands.extend(sent(&mut flight).1);
    }
    let status = flight.status(40_000 * MS);
    assert!(status.phase == Phase::Failed && status.why.contains("disarm it"), "{status:?}");
    assert!(!commands.contains(&MavCmd::MAV_CMD_NAV_TAKEOFF), "{commands:?}");
}

#[test]
fn after_a_standstill_between_two_flights_the_second_one_is_landed_by_command() {
    for (stood_ms, begins) in [(14_000, true), (20_000, false)] {
        let mut flight = in_flight("airborne");
        hover(&mut flight, 20, 1000, 4);
        receive(&mut flight, 1000 * MS, &heartbeat(4, false));
        receive(&mut flight, 1001 * MS, &contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND));
        pose(&mut flight, 1020 * MS);
        flight.tick(1021 * MS);
        assert_eq!(flight.status(1021 * MS).phase, Phase::Landed);
        flight.camera(1021 * MS, CameraInfo::sample());
        let ms = 1000 + stood_ms;
        receive(&mut flight, ms * MS, &heartbeat(4, true));
        receive(&mut flight, ms * MS + 1, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        let sent = hover(&mut flight, ms + 20, ms + 2000, 4);
        let status = flight.status((ms + 2000) * MS);
        assert_eq!(sent.setpoints > 20, begins, "{status:?}");
        if !begins {
            assert!(status.why.contains("`resume` begins"), "{status:?}");
            assert!(flight.command((ms + 2000) * MS, &ControllerCommand::Resume).accepted);
            let sent = hover(&mut flight, ms + 2020, ms + 4000, 4);
            let status = flight.status((ms + 4000) * MS);
            assert!(sent.setpoints > 20, "{sent:?} {status:?}");
        }
    }
}

#[test]
fn after_a_standstill_of_more_than_15_s_no_precision_landing_asks_for_land() {
    for (stood_ms, asks) in [(14_000, true), (20_000, false)] {
        let mut flight = landing_target("command");
        parameter(&mut flight, 2 * MS, "PLND_ENABLED", 1.0);
        parameter(&mut flight, 2 * MS, "PLND_TYPE", 1.0);
        hover(&mut flight, 20, 1000, 4);
        assert!(flight.command(1000 * MS, &ControllerCommand::Start).accepted);
        hover(&mut flight, 1000, 1200, 4);
        let end_ms = 1000 + stood_ms;
        let sent = hover(&mut flight, end_ms, end_ms + 4000, 4);
        let status = flight.status((end_ms + 4000) * MS);
        assert_eq!(sent.modes.contains(&9.0), asks, "{status:?}");
        if !asks {
            assert_eq!(status.phase, Phase::Aborted);
            assert!(status.why.contains("`start` begins a landing"), "{status:?}");
            let reply = flight.command((end_ms + 4000) * MS, &ControllerCommand::Start);
            assert!(reply.accepted, "{reply:?}");
        }
    }
    // One that the autopilot flies continues.
    let mut flight = landing_target("command");
    parameter(&mut flight, 2 * MS, "PLND_ENABLED", 1.0);
    parameter(&mut flight, 2 * MS, "PLND_TYPE", 1.0);
    hover(&mut flight, 1000, 4000, 4);
    hover(&mut flight, 4000, 5000, 9);
    let sent = hover(&mut flight, 25_000, 27_000, 9);
    assert_eq!(flight.status(27_000 * MS).phase, Phase::Final);
    assert!(sent.targets.len() > 20 && sent.modes.is_empty(), "{sent:?}");
}

#[test]
fn a_vehicle_that_waits_in_the_air_for_its_landing_lands_before_its_battery_is_empty() {
    for (set, lands) in [("", true), ("phases.on_battery_critical=hold", false)] {
        let set: Vec<&str> = [set].into_iter().filter(|it| !it.is_empty()).collect();
        let mut flight = flight_with("takeoff", &set);
        flight.presence(0, "main", true);
        flight.camera(0, CameraInfo::sample());
        receive(&mut flight, 0, &heartbeat(4, true));
        receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        for ms in (20..10_000).step_by(20) {
            flight.detections(ms * MS, "main", &of_another_clock(ms * MS));
            if ms > 1600 {
                pose(&mut flight, ms * MS);
            }
            if ms % 1000 == 0 {
                receive(&mut flight, ms * MS, &heartbeat(4, true));
                let percent = if ms < 5000 { 50 } else { 8 };
                receive(&mut flight, ms * MS, &battery(percent));
            }
            flight.tick(ms * MS + 3);
            if ms == 7000 {
                let status = flight.status(ms * MS);
                let waits = status.phase == Phase::Takeoff && status.why.contains("myhost");
                assert!(waits, "{status:?}");
            }
        }
        let status = flight.status(10_000 * MS);
        assert_eq!(status.phase == Phase::Final, lands, "{status:?}");
        assert_eq!(status.why.contains("battery"), lands, "{status:?}");
    }
}

/// The lander takes no positions outside of the world.
#[test]
fn an_alarm_in_a_wait_whose_landing_the_lander_refuses_is_logged_once_and_lands_as_soon_as_it_may()
{
    let health = Arc::new(HealthCounters::default());
    let mut flight = flight_counting("takeoff", &[], &health);
    flight.presence(0, "main", true);
    flight.camera(0, CameraInfo::sample());
    receive(&mut flight, 0, &heartbeat(4, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    let mut sent = Sent::default();
    for ms in (20..24_000).step_by(20) {
        flight.detections(ms * MS, "main", &of_another_clock(ms * MS));
        if (1600..5000).contains(&ms) || ms >= 22_000 {
            pose(&mut flight, ms * MS);
        } else if ms >= 5000 {
            receive(&mut flight, ms * MS, &attitude(ms * MS));
            receive(&mut flight, ms * MS + 1, &position(ms * MS, 2e6));
        }
        if ms % 1000 == 0 {
            receive(&mut flight, ms * MS, &heartbeat(4, true));
            let percent = if ms < 6000 { 50 } else { 8 };
            receive(&mut flight, ms * MS, &battery(percent));
        }
        flight.tick(ms * MS + 3);
        sent.take(&mut flight);
        assert_eq!(sent.modes.contains(&9.0), ms >= 22_000, "{ms} ms: {sent:?}");
    }
    let identity = Identity { service: "controller", instance: "main".into() };
    let rates = health.report(&identity, 0).rates;
    let alarms = rates.iter().find(|rate| rate.name == "alarms");
    assert_eq!(alarms.map(|rate| rate.count), Some(1), "{rates:?}");
}

#[test]
fn a_landing_that_is_to_be_resumed_lands_before_the_battery_is_empty_and_not_against_its_pilot() {
    for (case, set, mode_after, command, lands) in [
        ("held", "", 4, None, true),
        ("held, and held by the operator", "", 4, Some(ControllerCommand::Hold), true),
        ("held, in the pilot's mode", "", 5, None, false),
        ("held, to abort", "", 4, Some(ControllerCommand::Abort), false),
        ("held, with another reaction", "phases.on_battery_critical=hold", 4, None, false),
    ] {
        let set: Vec<&str> = [set].into_iter().filter(|it| !it.is_empty()).collect();
        let mut flight = in_flight_with("resume", &set);
        flight.camera(0, CameraInfo::sample());
        flight.presence(0, "main", true);
        // Attitude and position are missing, until the controller has stood still.
        for ms in (20..3000).step_by(20) {
            if ms % 1000 == 0 {
                receive(&mut flight, ms * MS, &heartbeat(4, true));
            }
            flight.tick(ms * MS + 3);
        }
        receive(&mut flight, 23_000 * MS, &heartbeat(mode_after, true));
        hover(&mut flight, 23_000, 25_000, mode_after);
        if let Some(command) = command {
            assert!(flight.command(25_000 * MS, &command).accepted, "{case}");
        }
        receive(&mut flight, 25_000 * MS, &battery(8));
        let sent = hover(&mut flight, 25_000, 29_000, mode_after);
        let status = flight.status(29_000 * MS);
        assert_eq!(sent.modes.contains(&9.0), lands, "{case}: {sent:?} {status:?}");
        assert_eq!(status.phase == Phase::Final, lands, "{case}: {status:?}");
        assert_eq!(status.why.contains("battery"), lands, "{case}: {status:?}");
        assert!(lands || sent.setpoints == 0, "{case}: {sent:?}");
    }
    // With another vehicle or controller on the link it may not be ours; with states that come seldom it lands with the first of them.
    for other in others().map(Some).into_iter().chain([None]) {
        let mut flight = in_flight_with("resume", &["autopilot.system_id=0"]);
        flight.camera(0, CameraInfo::sample());
        flight.presence(0, "main", true);
        let mut sent = Sent::default();
        for ms in (20..3000).chain(23_000..30_000).step_by(20) {
            if ms % 1000 == 0 {
                let percent = if ms < 24_000 { 50 } else { 8 };
                receive(&mut flight, ms * MS, &heartbeat(4, true));
                receive(&mut flight, ms * MS, &battery(percent));
                if let Some((sender, message, _)) = &other {
                    receive_from(&mut flight, ms * MS, *sender, message);
                }
            }
            if ms == 28_500 {
                pose(&mut flight, ms * MS);
            }
            flight.tick(ms * MS + 3);
            sent.take(&mut flight);
            let lands = ms >= 28_500 && other.is_none();
            assert_eq!(sent.modes.contains(&9.0), lands, "{ms} ms: {other:?} {sent:?}");
        }
    }
    // One whose detections are refused.
    let mut flight = in_flight("resume");
    flight.presence(0, "main", true);
    flight.camera(0, CameraInfo::sample());
    for ms in (20..9000).step_by(20) {
        flight.detections(ms * MS, "main", &of_another_clock(ms * MS));
        if ms > 1600 {
            pose(&mut flight, ms * MS);
        }
        if ms % 1000 == 0 {
            receive(&mut flight, ms * MS, &heartbeat(4, true));
            let percent = if ms < 3000 { 50 } else { 8 };
            receive(&mut flight, ms * MS, &battery(percent));
        }
        flight.tick(ms * MS + 3);
        if ms == 4000 {
            let status = flight.status(ms * MS);
            assert!(status.phase == Phase::Idle && status.why.contains("myhost"), "{status:?}");
        }
    }
    let status = flight.status(9000 * MS);
    assert!(status.phase == Phase::Final && status.why.contains("battery"), "{status:?}");
}

#[test]
fn a_landing_that_waits_as_detections_are_refused_waits_after_a_standstill_as_well() {
    // Detections or a tick come first after it.
    for ticks_first in [false, true] {
        let mut flight = flight_with("takeoff", &[]);
        flight.presence(0, "main", true);
        flight.camera(0, CameraInfo::sample());
        receive(&mut flight, 0, &heartbeat(4, true));
        receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        for ms in (20..6000).chain(8200..9000).step_by(20) {
            if ms % 1000 == 0 {
                receive(&mut flight, ms * MS, &heartbeat(4, true));
            }
            if ms > 1600 {
                pose(&mut flight, ms * MS);
            }
            if ticks_first {
                flight.tick(ms * MS + 1);
            }
            flight.detections(ms * MS + 2, "main", &of_another_clock(ms * MS));
            flight.tick(ms * MS + 3);
            if ms > 3000 {
                let status = flight.status(ms * MS + 4);
                assert!(status.why.contains("myhost"), "{ticks_first}, {ms} ms: {status:?}");
            }
        }
        assert_eq!(flight.status(9000 * MS).phase, Phase::Takeoff);
    }
}

#[test]
fn a_flight_that_follows_a_landing_within_seconds_is_not_landed_without_a_command() {
    let (on_ground, in_air) =
        (MavLandedState::MAV_LANDED_STATE_ON_GROUND, MavLandedState::MAV_LANDED_STATE_IN_AIR);
    let fly = |flight: &mut Flight, from_ms: i64, to_ms: i64, mode: u32| {
        for ms in (from_ms..to_ms).step_by(20) {
            if ms % 1000 == 0 {
                receive(flight, ms * MS, &heartbeat(mode, true));
            }
            pose(flight, ms * MS);
            flight.tick(ms * MS + 3);
        }
    };
    // The mode in which the motors are started again; GUIDED comes later.
    for (start, mode, is_aborted) in
        [("command", 5, false), ("command", 4, false), ("command", 4, true), ("takeoff", 5, false)]
    {
        let mut flight = in_flight(start);
        fly(&mut flight, 20, 500, 4);
        if start == "command" {
            let reply = flight.command(500 * MS, &ControllerCommand::Start);
            assert!(reply.accepted, "{reply:?}");
        }
        fly(&mut flight, 520, 1000, 4);
        if is_aborted {
            assert!(flight.command(1000 * MS, &ControllerCommand::Abort).accepted);
        }
        fly(&mut flight, 1020, 2000, 4);
        let ended = if is_aborted { Phase::Aborted } else { Phase::Landed };
        receive(&mut flight, 2000 * MS, &heartbeat(4, false));
        receive(&mut flight, 2001 * MS, &contact(on_ground));
        pose(&mut flight, 2020 * MS);
        flight.tick(2021 * MS);
        assert_eq!(flight.status(2021 * MS).phase, ended);
        receive(&mut flight, 3000 * MS, &heartbeat(mode, true));
        fly(&mut flight, 3020, 4000, mode);
        receive(&mut flight, 4000 * MS, &contact(in_air));
        fly(&mut flight, 4020, 6000, mode);
        receive(&mut flight, 6000 * MS, &heartbeat(4, true));
        fly(&mut flight, 6020, 9000, 4);
        let status = flight.status(9000 * MS);
        assert_eq!(status.phase, ended, "{start} in {mode}: {status:?}");
        assert_eq!(status.disarmed_ns, Some(2000 * MS), "of the landing that was");
    }
}

#[test]
fn a_start_that_is_refused_takes_nothing_back() {
    // After a landing the next flight is landed automatically.
    let mut flight = in_flight("airborne");
    hover(&mut flight, 20, 1000, 4);
    let (off, down) = (heartbeat(4, false), contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND));
    receive(&mut flight, 1000 * MS, &off);
    receive(&mut flight, 1001 * MS, &down);
    pose(&mut flight, 1020 * MS);
    flight.tick(1021 * MS);
    assert_eq!(flight.status(1021 * MS).phase, Phase::Landed);
    let reply = flight.command(1100 * MS, &ControllerCommand::Start);
    assert!(!reply.accepted, "{reply:?}");
    assert_eq!(flight.status(1100 * MS).phase, Phase::Landed);
    (1120..20_000).step_by(20).for_each(|ms| flight.tick(ms * MS));
    receive(&mut flight, 20_000 * MS, &heartbeat(4, true));
    receive(&mut flight, 20_001 * MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    hover(&mut flight, 20_020, 20_500, 4);
    let phase = flight.status(20_500 * MS).phase;
    assert!(matches!(phase, Phase::Search | Phase::Approach), "{phase}");
}

#[test]
fn a_pad_that_was_seen_long_ago_is_not_shown() {
    let mut flight = in_flight("airborne");
    flight.camera(0, CameraInfo::sample());
    flight.presence(0, "main", true);
    hover(&mut flight, 20, 2000, 4);
    let is_shown = |flight: &Flight, now_ms: i64| {
        let status = flight.status(now_ms * MS);
        (status.lateral_error_m.is_some(), flight.target(now_ms * MS).position_ned_m.is_some())
    };
    assert_eq!(is_shown(&flight, 2000), (true, true));
    for ms in (2000..14_000).step_by(20) {
        pose(&mut flight, ms * MS);
        flight.tick(ms * MS + 3);
        sent(&mut flight);
    }
    assert_eq!(is_shown(&flight, 11_000), (true, true));
    assert_eq!(is_shown(&flight, 14_000), (false, false));
    assert!(flight.status(14_000 * MS).height_m.is_some(), "over the place of the take-off");
}

#[test]
fn a_hold_is_taken_in_a_hold_of_another_reason() {
    let mut flight = in_flight("airborne");
    for ms in (20..62_000).step_by(20) {
        if ms % 1000 == 0 {
            receive(&mut flight, ms * MS, &heartbeat(4, true));
        }
        pose(&mut flight, ms * MS);
        flight.tick(ms * MS + 3);
        sent(&mut flight);
    }
    let before = flight.status(62_000 * MS);
    assert_eq!((before.phase, before.waits_for_operator), (Phase::Hold, false));
    for _ in 0..2 {
        let reply = flight.command(62_000 * MS, &ControllerCommand::Hold);
        assert!(reply.accepted && reply.reason.contains("operator"), "{reply:?}");
    }
    assert!(flight.status(62_000 * MS).waits_for_operator);
}

#[test]
fn a_landing_that_was_held_or_aborted_waits_for_the_operator() {
    let waits = |flight: &Flight, ms: i64| flight.status(ms * MS).waits_for_operator;
    let mut flight = in_flight("airborne");
    hover(&mut flight, 20, 1000, 4);
    assert!(!waits(&flight, 1000));
    for (ms, command, expected) in [
        (1000, ControllerCommand::Hold, true),
        (2000, ControllerCommand::Resume, false),
        (3000, ControllerCommand::Abort, true),
    ] {
        let reply = flight.command(ms * MS, &command);
        assert!(reply.accepted, "{command:?}: {reply:?}");
        assert_eq!(waits(&flight, ms), expected, "{command:?}");
        hover(&mut flight, ms + 20, ms + 1000, 4);
        assert_eq!(waits(&flight, ms + 980), expected, "{command:?}");
    }
    // The autopilot's own landing.
    let mut flight = landing_target("airborne");
    hover(&mut flight, 20, 1000, 4);
    assert!(!waits(&flight, 1000));
    let reply = flight.command(1000 * MS, &ControllerCommand::Abort);
    assert!(reply.accepted && waits(&flight, 1000), "{reply:?}");
}

#[test]
fn an_autopilot_that_is_restarted_after_a_landing_is_no_failure() {
    let mut flight = in_flight("airborne");
    let poses = |flight: &mut Flight, from_ms: i64, to_ms: i64, booted_ms: i64| {
        for ms in (from_ms..to_ms).step_by(20) {
            receive(flight, ms * MS, &attitude((ms - booted_ms) * MS));
            receive(flight, ms * MS + 1, &position((ms - booted_ms) * MS, 5.0));
            flight.tick(ms * MS + 3);
        }
        flight.status(to_ms * MS).phase
    };
    poses(&mut flight, 20, 500, 0);
    receive(&mut flight, 500 * MS, &heartbeat(4, false));
    receive(&mut flight, 501 * MS, &contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND));
    assert_eq!(poses(&mut flight, 520, 8000, 0), Phase::Landed);
    receive(&mut flight, 13_000 * MS, &heartbeat(4, false));
    assert_eq!(poses(&mut flight, 13_020, 14_000, 10_000), Phase::Landed);
    (14_000..30_000).step_by(20).for_each(|ms| flight.tick(ms * MS));
    receive(&mut flight, 30_000 * MS, &heartbeat(4, true));
    receive(&mut flight, 30_001 * MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    assert_eq!(poses(&mut flight, 30_020, 31_000, 10_000), Phase::Search);
}

#[test]
fn an_autopilot_that_restarts_in_flight_has_not_landed() {
    for (mode, shown_ms) in [(9, 11_600), (4, 11_600), (9, 17_000)] {
        let mut flight = in_flight("airborne");
        let poses = |flight: &mut Flight, (from_ms, to_ms): (i64, i64), booted_ms: i64| {
            for ms in (from_ms..to_ms).step_by(20) {
                receive(flight, ms * MS, &attitude((ms - booted_ms) * MS));
                receive(flight, ms * MS + 1, &position((ms - booted_ms) * MS, 3.0));
                flight.tick(ms * MS + 3);
            }
        };
        hover(&mut flight, 20, 8000, 4);
        assert!(flight.command(8000 * MS, &ControllerCommand::LandHere).accepted);
        receive(&mut flight, 8010 * MS, &heartbeat(mode, true));
        poses(&mut flight, (8020, 9000), 0);
        assert_eq!(flight.status(9000 * MS).phase, Phase::Final);
        // It falls silent, and its first heartbeat comes before the packets with the time since its start.
        receive(&mut flight, 11_000 * MS, &heartbeat(0, false));
        poses(&mut flight, (shown_ms, shown_ms + 800), 10_900);
        let status = flight.status((shown_ms + 800) * MS);
        assert_eq!(status.phase, Phase::Failed, "{}", status.why);
        assert!(status.why.contains("restarted in flight"), "{}", status.why);
        // The earlier landing does not continue behind a start.
        let from_ms = shown_ms + 800;
        receive(&mut flight, from_ms * MS, &heartbeat(4, true));
        receive(&mut flight, from_ms * MS + 1, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        poses(&mut flight, (from_ms + 20, from_ms + 200), 10_900);
        let reply = flight.command((from_ms + 200) * MS, &ControllerCommand::Start);
        let status = flight.status((from_ms + 200) * MS);
        assert!(reply.accepted && status.phase == Phase::Search, "{reply:?} {status:?}");
    }
}

#[test]
fn after_a_restart_of_the_autopilot_nothing_begins_automatically() {
    let mut flight = in_flight("airborne");
    let poses = |flight: &mut Flight, from_ms: i64, to_ms: i64, booted_ms: i64| {
        for ms in (from_ms..to_ms).step_by(20) {
            receive(flight, ms * MS, &attitude((ms - booted_ms) * MS));
            receive(flight, ms * MS + 1, &position((ms - booted_ms) * MS, 5.0));
            flight.tick(ms * MS + 3);
        }
        flight.status(to_ms * MS).phase
    };
    poses(&mut flight, 20, 500, 0);
    receive(&mut flight, 500 * MS, &heartbeat(4, false));
    receive(&mut flight, 501 * MS, &contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND));
    assert_eq!(poses(&mut flight, 520, 8000, 0), Phase::Landed);
    receive(&mut flight, 8000 * MS, &heartbeat(4, true));
    assert_eq!(poses(&mut flight, 8020, 9000, 0), Phase::Landed);
    assert_eq!(poses(&mut flight, 13_000, 14_000, 10_000), Phase::Failed);
    receive(&mut flight, 14_000 * MS, &heartbeat(4, true));
    receive(&mut flight, 14_001 * MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    assert_eq!(poses(&mut flight, 14_020, 16_000, 10_000), Phase::Failed);
}

#[test]
fn a_controller_restarted_after_touchdown_lands_no_later_flight() {
    let first_and_next = |mode: u32, contact_at_start: MavLandedState| {
        let mut flight = flight("resume");
        flight.presence(0, "main", true);
        receive(&mut flight, 0, &heartbeat(mode, true));
        // Whether it stands is not known yet.
        hover(&mut flight, 20, 500, mode);
        receive(&mut flight, 500 * MS, &contact(contact_at_start));
        hover(&mut flight, 520, 1000, mode);
        let status = flight.status(1000 * MS);
        let is_said_to_stand = status.why.contains("stands on the ground");
        assert_eq!(
            is_said_to_stand,
            contact_at_start == MavLandedState::MAV_LANDED_STATE_ON_GROUND
        );
        let first = status.phase;
        receive(&mut flight, 5001 * MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        hover(&mut flight, 5020, 5500, 4);
        (first, flight.status(5500 * MS).phase)
    };
    let on_ground = MavLandedState::MAV_LANDED_STATE_ON_GROUND;
    for mode in [4, 9] {
        let (first, next) = first_and_next(mode, on_ground);
        assert_eq!((first, next), (Phase::Idle, Phase::Idle), "in mode {mode}");
    }
    let (first, _) = first_and_next(4, MavLandedState::MAV_LANDED_STATE_IN_AIR);
    assert_eq!(first, Phase::Search);
}

#[test]
fn a_restarted_controller_does_not_believe_a_flying_vehicle_that_its_motors_are_off() {
    let mut flight = flight("resume");
    flight.presence(0, "main", true);
    receive(&mut flight, 0, &heartbeat(4, false));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    for ms in (20..2000).step_by(20) {
        pose(&mut flight, ms * MS);
        flight.tick(ms * MS + 1);
    }
    assert_eq!(flight.status(2000 * MS).phase, Phase::Idle);
    receive(&mut flight, 2000 * MS, &heartbeat(4, true));
    hover(&mut flight, 2020, 2500, 4);
    assert_eq!(flight.status(2500 * MS).phase, Phase::Search);
}

#[test]
fn a_controller_restarted_in_the_last_metre_of_land_resumes_the_landing() {
    for contact_at_start in
        [MavLandedState::MAV_LANDED_STATE_LANDING, MavLandedState::MAV_LANDED_STATE_IN_AIR]
    {
        let mut flight = flight("resume");
        flight.presence(0, "main", true);
        receive(&mut flight, 0, &heartbeat(9, true));
        receive(&mut flight, MS, &contact(contact_at_start));
        pose_at(&mut flight, 20 * MS, 0.5);
        flight.tick(21 * MS);
        assert_eq!(flight.status(21 * MS).phase, Phase::Final);
    }
}

#[test]
fn a_restarted_controller_does_not_climb_with_a_vehicle_that_may_stand_on_the_pad() {
    let note = |down_m: f64, system: u8, stamp_ns: i64| PadNote {
        address: "udpin:127.0.0.1:14550".into(),
        system,
        stamp_ns,
        position_ned_m: [0.1, 0.0, down_m],
        deviation_m: 0.02,
    };
    let now_ns = 100_000 * MS;
    for (case, height_m, left, phase) in [
        ("noted", 0.05, Some(note(0.0, 1, now_ns - 5000 * MS)), Phase::Final),
        ("noted, on a pad on a hill", 3.05, Some(note(-3.0, 1, now_ns - 5000 * MS)), Phase::Final),
        ("noted, over it", 1.0, Some(note(0.0, 1, now_ns - 5000 * MS)), Phase::Search),
        ("noted, over a valley", 0.05, Some(note(2.0, 1, now_ns - 5000 * MS)), Phase::Search),
        ("noted long ago", 3.05, Some(note(-3.0, 1, now_ns - 90_000 * MS)), Phase::Search),
        ("noted for another vehicle", 3.05, Some(note(-3.0, 2, now_ns)), Phase::Search),
        ("not noted, still at the height of the origin", 0.05, None, Phase::Final),
        ("not noted, in flight", 5.0, None, Phase::Search),
    ] {
        let mut flight = flight_with("resume", &["autopilot.address=\"udpin:127.0.0.1:14550\""]);
        if let Some(left) = left {
            flight.take_over_pad(left);
        }
        flight.presence(now_ns, "main", true);
        let (mut highest_m_s, mut land) = (0.0, false);
        for ms in (0..4000).step_by(20) {
            let at_ns = now_ns + ms * MS;
            if ms % 1000 == 0 {
                receive(&mut flight, at_ns, &heartbeat(4, true));
                receive(&mut flight, at_ns, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
            }
            pose_at(&mut flight, at_ns + 1, height_m);
            flight.tick(at_ns + 3);
            let mut sent = Sent::default();
            sent.take(&mut flight);
            land |= sent.modes.contains(&9.0);
            let setpoint = flight.status(at_ns + 3).setpoint;
            highest_m_s =
                setpoint.map_or(highest_m_s, |it| f64::max(highest_m_s, -it.velocity_ned_m_s[2]));
        }
        let status = flight.status(now_ns + 4000 * MS);
        assert_eq!(status.phase, phase, "{case}: {status:?}");
        assert_eq!(land, phase == Phase::Final, "{case}");
        assert!(!land || highest_m_s <= 0.0, "{case}: it climbed at {highest_m_s} m/s");
    }
}

#[test]
fn no_setpoint_follows_the_heartbeat_with_the_pilots_mode() {
    let mut flight = in_flight("airborne");
    flight.presence(0, "main", true);
    let mut last_ms = 0;
    for ms in (20..4000).step_by(5) {
        // The news of the switch comes at 2 s, between two ticks.
        if ms == 2000 {
            receive(&mut flight, ms * MS, &heartbeat(5, true));
        }
        if ms % 20 == 0 {
            pose(&mut flight, ms * MS);
        }
        if ms % 25 == 0 {
            flight.tick(ms * MS + 3);
        }
        if sent(&mut flight).0 > 0 {
            last_ms = ms;
        }
    }
    assert!((1900..2000).contains(&last_ms), "{last_ms} ms");
    assert_eq!(flight.status(4000 * MS).setpoint, None);
}
