//! A flight by its packets and detections: what is sent, and in which phase it is.

#![allow(clippy::unwrap_used, reason = "helpers of tests may fail like tests")]

mod packets;

use std::sync::Arc;

use autopilot::Parser;
use autopilot::dialect::{
    ATTITUDE_DATA, ESTIMATOR_STATUS_DATA, EstimatorStatusFlags, GLOBAL_POSITION_INT_DATA,
    LANDING_TARGET_DATA, MavCmd, MavLandedState, MavMessage, PARAM_VALUE_DATA, SYS_STATUS_DATA,
};
use controller::Config;
use controller::flight::Flight;
use controller::pad_note::PadNote;
use messages::{CameraInfo, ControllerCommand, Detection, Detections, FrameHeader, Phase};
use node::{Layers, clock_name};
use packets::{MS, attitude, contact, heartbeat, position, receive};

fn flight(start: &str) -> Flight {
    flight_with(start, &[])
}

fn flight_with(start: &str, set: &[&str]) -> Flight {
    let mut all = vec![format!("start={start}"), "takeoff_real_vehicle=true".to_owned()];
    all.extend(set.iter().map(|s| (*s).to_owned()));
    let layers = Layers { file: None, set: all };
    Flight::new(layers.load::<Config>().unwrap().settings, Arc::default()).unwrap()
}

/// Attitude and position 5 m over the origin.
fn pose(flight: &mut Flight, now_ns: i64) {
    pose_at(flight, now_ns, 5.0);
}

fn pose_at(flight: &mut Flight, now_ns: i64, height_m: f32) {
    receive(flight, now_ns, &attitude(now_ns));
    receive(flight, now_ns + 1, &position(now_ns, height_m));
}

/// Setpoints, and commands other than for messages, since the last call.
fn sent(flight: &mut Flight) -> (usize, Vec<MavCmd>) {
    let (mut setpoints, mut commands) = (0, Vec::new());
    while let Some(packet) = flight.poll_outgoing() {
        for packet in Parser::new().push(&packet) {
            match packet.message {
                Some(MavMessage::SET_POSITION_TARGET_LOCAL_NED(_)) => setpoints += 1,
                Some(MavMessage::COMMAND_LONG(c))
                    if c.command != MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL =>
                {
                    commands.push(c.command);
                }
                _ => {}
            }
        }
    }
    (setpoints, commands)
}

fn in_flight(start: &str) -> Flight {
    let mut flight = flight(start);
    receive(&mut flight, 0, &heartbeat(4, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    flight
}

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
fn the_pilots_mode_change_stops_the_setpoints_for_good() {
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

/// Attitude alone, as an autopilot sends it whose position is lost.
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
                let battery = SYS_STATUS_DATA { battery_remaining: 5, ..Default::default() };
                receive(&mut flight, now_ns, &MavMessage::SYS_STATUS(battery));
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
    let battery = SYS_STATUS_DATA { battery_remaining: 15, ..Default::default() };
    receive(&mut flight, 1000 * MS, &MavMessage::SYS_STATUS(battery));
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
    // It still begins by itself, as configured.
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
        flight.detections(now_ns, "main", &seen(stamp_ns));
        assert_eq!(flight.target(now_ns).rejected.as_deref(), Some("from-the-future"));
    }
    for stamp_ns in [i64::MIN, now_ns - 1] {
        flight.detections(now_ns, "main", &seen(stamp_ns));
    }
    assert_eq!(flight.target(now_ns).rejected.as_deref(), Some("no-pose"), "it was looked at");
    assert_eq!(flight.status(now_ns).active_detector.as_deref(), Some("main"));
    // Detections under another detector's name are refused.
    flight.detections(now_ns, "intruder", &seen(now_ns));
    assert_eq!(flight.target(now_ns).rejected.as_deref(), Some("another-detectors-name"));
    assert_eq!(flight.status(now_ns).candidates.len(), 1);
}

fn header(stamp_ns: i64) -> FrameHeader {
    FrameHeader { stamp_ns, clock: clock_name().into(), ..FrameHeader::sample() }
}

/// A frame in which the marker lies 5 m below a camera at the body's origin.
fn seen(stamp_ns: i64) -> Detections {
    Detections { header: header(stamp_ns), ..Detections::sample() }
}

/// Hovers in view of the marker in a mode of the autopilot.
fn hover(flight: &mut Flight, from_ms: i64, to_ms: i64, mode: u32) -> Sent {
    let mut sent = Sent::default();
    for ms in (from_ms..to_ms).step_by(20) {
        if ms % 1000 == 0 {
            receive(flight, ms * MS, &heartbeat(mode, true));
        }
        pose(flight, ms * MS);
        if ms % 60 == 0 {
            flight.detections(ms * MS + 2, "main", &seen(ms * MS - 40 * MS));
        }
        flight.tick(ms * MS + 3);
        sent.take(flight);
    }
    sent
}

#[derive(Debug, Default)]
struct Sent {
    setpoints: usize,
    targets: Vec<LANDING_TARGET_DATA>,
    modes: Vec<f32>,
    requested: Vec<String>,
}

impl Sent {
    fn take(&mut self, flight: &mut Flight) {
        while let Some(packet) = flight.poll_outgoing() {
            for packet in Parser::new().push(&packet) {
                match packet.message {
                    Some(MavMessage::SET_POSITION_TARGET_LOCAL_NED(_)) => self.setpoints += 1,
                    Some(MavMessage::LANDING_TARGET(target)) => self.targets.push(target),
                    Some(MavMessage::COMMAND_LONG(c))
                        if c.command == MavCmd::MAV_CMD_DO_SET_MODE =>
                    {
                        self.modes.push(c.param2);
                    }
                    Some(MavMessage::PARAM_REQUEST_READ(r)) => {
                        self.requested.push(r.param_id.to_str().unwrap_or_default().to_owned());
                    }
                    _ => {}
                }
            }
        }
    }
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
    receive(&mut flight, 8000 * MS, &heartbeat(9, false));
    flight.tick(8001 * MS);
    let status = flight.status(8001 * MS);
    assert!(status.phase == Phase::Landed && status.finished, "{status:?}");
    assert_eq!(status.guidance, "landing-target");
}

#[test]
fn a_px4_that_holds_its_place_is_asked_to_land_by_itself() {
    const PRECISION_LAND: u32 = 0x0904_0000;
    let mut flight = px4_in(POSITION, "command", &["mode=landing-target"]);
    let reply = flight.command(1000 * MS, &ControllerCommand::Start);
    assert!(!reply.accepted && reply.reason.contains("HOLD"), "{reply:?}");
    receive(&mut flight, 1010 * MS, &heartbeat(HOLD, true));
    assert!(flight.command(1015 * MS, &ControllerCommand::Start).accepted);
    let sent = hover(&mut flight, 1020, 4900, HOLD);
    assert_eq!((sent.setpoints, sent.modes.first()), (0, Some(&4.0)), "{sent:?}");
    assert!(sent.targets.len() > 30, "{sent:?}");
    receive(&mut flight, 4900 * MS, &heartbeat(PRECISION_LAND, true));
    hover(&mut flight, 4920, 5500, PRECISION_LAND);
    assert_eq!(flight.status(5500 * MS).phase, Phase::Final);

    // Of one that began in OFFBOARD, HOLD is a pilot's choice.
    let mut flight = px4_in(OFFBOARD, "command", &["mode=landing-target"]);
    assert!(flight.command(1000 * MS, &ControllerCommand::Start).accepted);
    let sent = hover(&mut flight, 2000, 6000, HOLD);
    assert!(sent.modes.is_empty(), "{sent:?}");
    assert_eq!(flight.status(6000 * MS).phase, Phase::Aborted);
}

#[test]
fn a_precision_landing_that_is_off_is_reported_with_what_to_set() {
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
fn a_start_is_refused_while_all_detections_are_and_the_reason_is_told() {
    let mut flight = in_flight("command");
    flight.camera(0, CameraInfo::sample());
    let foreign = |stamp_ns| Detections {
        header: FrameHeader { clock: "monotonic/myhost".into(), ..header(stamp_ns) },
        ..Detections::sample()
    };
    for ms in (20..1600).step_by(20) {
        pose(&mut flight, ms * MS);
        if ms % 60 == 0 {
            flight.detections(ms * MS, "main", &foreign(ms * MS));
        }
        flight.tick(ms * MS + 3);
    }
    let status = flight.status(1600 * MS);
    let told = status.warnings.join("; ");
    assert!(told.contains("monotonic/myhost") && told.contains(clock_name()), "{told}");
    let reply = flight.command(1600 * MS, &ControllerCommand::Start);
    assert!(!reply.accepted && reply.reason.contains("monotonic/myhost"), "{reply:?}");
    // With the right clock nothing is in the way any more.
    hover(&mut flight, 1600, 4000, 4);
    assert_eq!(flight.status(4000 * MS).warnings, Vec::<String>::new());
    let reply = flight.command(4000 * MS, &ControllerCommand::Start);
    assert!(reply.accepted, "{reply:?}");
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
                let header = FrameHeader { clock: "monotonic/myhost".into(), ..header(ms * MS) };
                let foreign = Detections { header, ..Detections::sample() };
                flight.detections(ms * MS, "main", &foreign);
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
    // Against a pilot it is refused, and what was going on goes on.
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
fn a_px4_is_asked_to_hold_its_place_when_setpoints_end() {
    const GUIDED: u32 = 4;
    let begun = |mode| {
        let mut flight = flight("airborne");
        receive(&mut flight, 0, &heartbeat(mode, true));
        receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        assert!(hover(&mut flight, 20, 1000, mode).setpoints > 20);
        flight
    };
    // 4 is AUTO; without an answer the command is sent again.
    for (mode, asked) in [(GUIDED, None), (OFFBOARD, Some(&4.0))] {
        let mut flight = begun(mode);
        assert!(flight.command(1000 * MS, &ControllerCommand::Abort).accepted);
        let sent = hover(&mut flight, 1020, 5900, mode);
        assert!(sent.setpoints > 100 && sent.modes.is_empty(), "{sent:?}");
        let sent = hover(&mut flight, 5920, 7500, mode);
        assert_eq!(sent.modes.first(), asked, "{sent:?}");
        // The request may be lost, and silence is a failure to a PX4.
        assert_eq!(sent.setpoints > 25, asked.is_some(), "{sent:?}");
        let sent = hover(&mut flight, 8000, 9900, if asked.is_some() { HOLD } else { mode });
        assert!(sent.setpoints <= 2, "{sent:?}");
        // A controller that is asked to stop, and knows the mode of almost a second ago only.
        let mut flight = begun(mode);
        assert_eq!(flight.shutdown(1000 * MS), asked.is_some());
        let mut sent = Sent::default();
        sent.take(&mut flight);
        assert!(sent.setpoints == 1 && sent.modes.is_empty(), "{sent:?}");
        pose(&mut flight, 1040 * MS);
        receive(&mut flight, 1050 * MS, &heartbeat(mode, true));
        assert_eq!(flight.shutdown(1060 * MS), asked.is_some(), "another mode may follow at once");
        sent.take(&mut flight);
        assert!(sent.modes.is_empty(), "{sent:?}");
        assert_eq!(flight.shutdown(1140 * MS), asked.is_some(), "until it holds");
        sent.take(&mut flight);
        assert_eq!(sent.modes.first(), asked, "{sent:?}");
        receive(&mut flight, 1500 * MS, &heartbeat(HOLD, true));
        assert!(!flight.shutdown(1510 * MS));
        // The pilot has taken over meanwhile.
        let mut flight = begun(mode);
        flight.shutdown(1000 * MS);
        receive(&mut flight, 1050 * MS, &heartbeat(mode + (1 << 16), true));
        assert!(!flight.shutdown(1060 * MS));
        let mut sent = Sent::default();
        sent.take(&mut flight);
        assert!(sent.modes.is_empty(), "{sent:?}");
    }
}

const POSITION: u32 = 0x0003_0000;
const HOLD: u32 = 0x0304_0000;
const OFFBOARD: u32 = 0x0006_0000;

/// A PX4 that flies in this mode, one second long.
fn px4_in(mode: u32, start: &str, set: &[&str]) -> Flight {
    let mut flight = flight_with(start, set);
    flight.camera(0, CameraInfo::sample());
    flight.presence(0, "main", true);
    receive(&mut flight, 0, &heartbeat(mode, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    assert_eq!(hover(&mut flight, 20, 1000, mode).setpoints, 0);
    flight
}

/// One that holds its place was asked for OFFBOARD at 3 s, and has not shown it.
fn px4_asked_for_offboard(start: &str) -> Flight {
    let mut flight = px4_in(HOLD, start, &[]);
    let reply = flight.command(1000 * MS, &ControllerCommand::Start);
    assert!(reply.accepted && reply.reason.contains("OFFBOARD"), "{reply:?}");
    let sent = hover(&mut flight, 1000, 2980, HOLD);
    assert!(sent.setpoints > 15, "{sent:?}");
    assert!(sent.modes.is_empty(), "2 s is too early, and then the mode is not known: {sent:?}");
    let sent = hover(&mut flight, 2980, 3100, HOLD);
    assert_eq!(sent.modes, [6.0], "{sent:?}");
    assert_eq!(flight.status(3100 * MS).phase, Phase::Idle);
    flight
}

#[test]
fn a_px4_that_holds_its_place_is_asked_to_follow_setpoints_when_a_landing_is_started() {
    let mut flight = px4_asked_for_offboard("command");
    assert!(!flight.command(3100 * MS, &ControllerCommand::Start).accepted, "it is under way");
    receive(&mut flight, 3100 * MS, &heartbeat(OFFBOARD, true));
    let sent = hover(&mut flight, 3120, 3700, OFFBOARD);
    let status = flight.status(3700 * MS);
    assert!(sent.setpoints > 10, "{sent:?}");
    assert!(matches!(status.phase, Phase::Approach | Phase::Descend), "{status:?}");

    // The markers are of no use any more when it has changed.
    let mut flight = px4_asked_for_offboard("command");
    receive(&mut flight, 3100 * MS, &heartbeat(OFFBOARD, true));
    for ms in (3120..5000).step_by(20) {
        if ms % 1000 == 0 {
            receive(&mut flight, ms * MS, &heartbeat(OFFBOARD, true));
        }
        pose(&mut flight, ms * MS);
        flight.tick(ms * MS + 3);
    }
    let mut sent = Sent::default();
    sent.take(&mut flight);
    assert!(sent.setpoints > 30, "{sent:?} {:?}", flight.status(5000 * MS));

    // The pilot takes over before it changed; a controller that lands flight after flight waits for the next one.
    for (start, phase) in [("command", Phase::Failed), ("airborne", Phase::Idle)] {
        let mut flight = px4_asked_for_offboard(start);
        receive(&mut flight, 3300 * MS, &heartbeat(POSITION, true));
        let sent = hover(&mut flight, 3420, 6000, POSITION);
        assert!(sent.setpoints <= 1 && sent.modes.is_empty(), "{sent:?}");
        assert!(flight.command(6000 * MS, &ControllerCommand::Start).reason.contains("HOLD"));
        let status = flight.status(6000 * MS);
        assert_eq!(status.phase, phase, "{status:?}");
        assert!(phase == Phase::Idle || status.why.contains("pilot"), "{status:?}");
    }

    // A heartbeat as old as the request does not show that the pilot came after it: OFFBOARD may come yet.
    for last in [POSITION, OFFBOARD] {
        let mut flight = px4_asked_for_offboard("command");
        receive(&mut flight, 3100 * MS, &heartbeat(POSITION, true));
        let sent = hover(&mut flight, 3120, 3980, POSITION);
        assert!(sent.setpoints > 10 && sent.modes.is_empty(), "{sent:?}");
        let sent = hover(&mut flight, 4000, 4980, last);
        assert_eq!(sent.modes.first(), (last == OFFBOARD).then_some(&4.0), "{sent:?}");
        assert_eq!(sent.setpoints > 10, last == OFFBOARD, "{sent:?}");
    }

    // The heartbeat before the request shows the pilot's mode.
    let mut flight = px4_in(HOLD, "command", &[]);
    flight.command(1000 * MS, &ControllerCommand::Start);
    hover(&mut flight, 1000, 2980, HOLD);
    let sent = hover(&mut flight, 2980, 6000, POSITION);
    assert!(sent.modes.is_empty(), "{sent:?}");

    // It never changes.
    let mut flight = px4_asked_for_offboard("command");
    hover(&mut flight, 3100, 25_000, HOLD);
    let status = flight.status(25_000 * MS);
    assert!(status.phase == Phase::Failed && status.why.contains("did not begin"), "{status:?}");
    let sent = hover(&mut flight, 25_000, 30_000, HOLD);
    assert!(sent.setpoints == 0 && sent.modes.is_empty(), "{sent:?}");
    assert!(flight.command(30_000 * MS, &ControllerCommand::Start).accepted, "once more");

    // A pilot is not disturbed.
    let mut flight = px4_in(POSITION, "command", &[]);
    let reply = flight.command(1000 * MS, &ControllerCommand::Start);
    assert!(!reply.accepted && reply.reason.contains("HOLD"), "{reply:?}");
    let sent = hover(&mut flight, 1020, 3000, POSITION);
    assert!(sent.setpoints == 0 && sent.modes.is_empty(), "{sent:?}");
}

#[test]
fn a_px4_that_may_have_changed_to_offboard_is_not_left_there_when_the_start_is_given_up() {
    let given_up = |command: &ControllerCommand| {
        let mut flight = px4_asked_for_offboard("command");
        assert!(!flight.command(3100 * MS, &ControllerCommand::Resume).accepted);
        assert!(flight.command(3100 * MS, command).accepted);
        let sent = hover(&mut flight, 3120, 3980, HOLD);
        assert!(sent.setpoints > 10 && sent.modes.is_empty(), "it is not known yet: {sent:?}");
        flight
    };
    for command in [ControllerCommand::Abort, ControllerCommand::Hold] {
        // It has not changed.
        let mut flight = given_up(&command);
        let sent = hover(&mut flight, 3980, 6000, HOLD);
        assert!(sent.setpoints <= 2 && sent.modes.is_empty(), "{sent:?}");
        assert_eq!(flight.status(6000 * MS).phase, Phase::Failed);
        // It has changed, and the first request for HOLD is lost.
        let mut flight = given_up(&command);
        let sent = hover(&mut flight, 3980, 5900, OFFBOARD);
        assert!(sent.setpoints > 30 && sent.modes.len() >= 2, "{sent:?}");
        assert!(sent.modes.iter().all(|mode| *mode == 4.0), "{sent:?}");
        let sent = hover(&mut flight, 6000, 8000, HOLD);
        assert!(sent.setpoints <= 2 && sent.modes.is_empty(), "{sent:?}");
        assert_eq!(flight.status(8000 * MS).phase, Phase::Failed);
        // The pilot has taken over.
        let mut flight = given_up(&command);
        let sent = hover(&mut flight, 4000, 8000, POSITION);
        assert!(sent.setpoints <= 1 && sent.modes.is_empty(), "{sent:?}");
        assert_eq!(flight.status(8000 * MS).phase, Phase::Failed);
    }

    // The controller is ended, before it asked and after.
    let mut flight = px4_in(HOLD, "command", &[]);
    flight.command(1000 * MS, &ControllerCommand::Start);
    hover(&mut flight, 1020, 1900, HOLD);
    assert!(!flight.shutdown(1900 * MS), "nothing to take back");
    let mut sent = Sent::default();
    sent.take(&mut flight);
    assert!(sent.modes.is_empty(), "{sent:?}");
    let mut flight = px4_asked_for_offboard("command");
    assert!(flight.shutdown(3100 * MS));
    receive(&mut flight, 3500 * MS, &heartbeat(OFFBOARD, true));
    assert!(flight.shutdown(3590 * MS));
    assert!(flight.shutdown(3610 * MS));
    let mut sent = Sent::default();
    sent.take(&mut flight);
    assert_eq!(sent.modes, [4.0], "{sent:?}");
    receive(&mut flight, 4000 * MS, &heartbeat(HOLD, true));
    assert!(!flight.shutdown(4010 * MS));
}

#[test]
fn a_px4_whose_state_is_not_known_in_offboard_gets_zeros_and_is_taken_back() {
    let mut flight = px4_asked_for_offboard("command");
    let mut sent = Sent::default();
    for ms in (3120..9000).step_by(20) {
        if ms % 1000 == 700 {
            let is_asked = sent.modes.contains(&4.0);
            let mode = if is_asked { HOLD } else { OFFBOARD };
            receive(&mut flight, ms * MS, &heartbeat(mode, true));
        }
        flight.tick(ms * MS + 3);
        sent.take(&mut flight);
        if ms == 5200 {
            assert!(sent.setpoints > 30 && sent.modes.is_empty(), "{sent:?}");
        }
    }
    assert_eq!(sent.modes.first(), Some(&4.0), "{sent:?}");
    let status = flight.status(9000 * MS);
    assert!(status.phase == Phase::Failed && status.why.contains("not known"), "{status:?}");
}

/// A PX4 that has taken off to 5 m, holds its place, and was asked for OFFBOARD at 5 s.
fn px4_at_the_end_of_its_takeoff() -> Flight {
    const TAKEOFF: u32 = 0x0204_0000;
    let mut flight = flight_with("takeoff", &["takeoff_height_m=5"]);
    flight.camera(0, CameraInfo::sample());
    flight.presence(0, "main", true);
    receive(&mut flight, 0, &heartbeat(HOLD, false));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND));
    let flags = EstimatorStatusFlags::from_bits_retain(831);
    let estimator = ESTIMATOR_STATUS_DATA { flags, ..Default::default() };
    receive(&mut flight, MS, &MavMessage::ESTIMATOR_STATUS(estimator));
    let altitude = GLOBAL_POSITION_INT_DATA::default();
    receive(&mut flight, MS, &MavMessage::GLOBAL_POSITION_INT(altitude));
    let mut commands = Vec::new();
    for ms in (20..1000).step_by(20) {
        pose_at(&mut flight, ms * MS, 0.0);
        flight.tick(ms * MS + 3);
        commands.extend(sent(&mut flight).1);
    }
    assert!(commands.contains(&MavCmd::MAV_CMD_COMPONENT_ARM_DISARM), "{commands:?}");
    receive(&mut flight, 1000 * MS, &heartbeat(HOLD, true));
    flight.tick(1010 * MS);
    receive(&mut flight, 1200 * MS, &heartbeat(TAKEOFF, true));
    receive(&mut flight, 1200 * MS, &contact(MavLandedState::MAV_LANDED_STATE_TAKEOFF));
    hover(&mut flight, 1220, 2980, TAKEOFF);
    receive(&mut flight, 2990 * MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    let sent = hover(&mut flight, 3000, 4980, HOLD);
    assert!(sent.setpoints > 10 && sent.modes.is_empty(), "{sent:?}");
    let sent = hover(&mut flight, 5000, 5100, HOLD);
    assert_eq!(sent.modes, [6.0], "{sent:?}");
    assert_eq!(flight.status(5100 * MS).phase, Phase::Takeoff);
    flight
}

#[test]
fn a_px4_that_was_asked_for_offboard_after_its_takeoff_is_not_left_there() {
    for (mode, asked) in [(OFFBOARD, Some(&4.0)), (HOLD, None)] {
        // The operator aborts.
        let mut flight = px4_at_the_end_of_its_takeoff();
        assert!(flight.command(5100 * MS, &ControllerCommand::Abort).accepted);
        let sent = hover(&mut flight, 5120, 5980, HOLD);
        assert!(sent.setpoints > 10 && sent.modes.is_empty(), "it is not known yet: {sent:?}");
        let sent = hover(&mut flight, 6000, 6900, mode);
        assert_eq!(sent.modes.first(), asked, "{sent:?}");
        assert_eq!(sent.setpoints > 10, mode == OFFBOARD, "{sent:?}");
        let sent = hover(&mut flight, 7000, 8000, HOLD);
        assert!(sent.setpoints <= 1 && sent.modes.is_empty(), "{sent:?}");
        let status = flight.status(8000 * MS);
        assert!(status.phase == Phase::Failed && status.why.contains("aborted"), "{status:?}");
        // The controller is ended.
        let mut flight = px4_at_the_end_of_its_takeoff();
        assert!(flight.shutdown(5100 * MS));
        receive(&mut flight, 5500 * MS, &heartbeat(mode, true));
        for ms in (5520..5600).step_by(20) {
            assert_eq!(flight.shutdown(ms * MS), mode == OFFBOARD);
        }
        let mut sent = Sent::default();
        sent.take(&mut flight);
        assert_eq!(sent.modes.first(), asked, "{sent:?}");
        receive(&mut flight, 5700 * MS, &heartbeat(HOLD, true));
        assert!(!flight.shutdown(5720 * MS));
    }
}

#[test]
fn a_px4_called_back_from_land_is_not_left_in_offboard_by_a_controller_that_ends() {
    const LAND: u32 = 0x0604_0000;
    let mut flight = flight("airborne");
    flight.camera(0, CameraInfo::sample());
    flight.presence(0, "main", true);
    receive(&mut flight, 0, &heartbeat(OFFBOARD, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    hover(&mut flight, 20, 1000, OFFBOARD);
    assert!(flight.command(1000 * MS, &ControllerCommand::LandHere).accepted);
    hover(&mut flight, 1020, 1980, OFFBOARD);
    let sent = hover(&mut flight, 2000, 3980, LAND);
    assert!(sent.setpoints > 30, "for the way back: {sent:?}");
    assert!(flight.command(3980 * MS, &ControllerCommand::Abort).accepted);
    let sent = hover(&mut flight, 4000, 4100, LAND);
    assert_eq!(sent.modes, [6.0], "just after the heartbeat of 4 s: {sent:?}");
    assert!(flight.shutdown(4100 * MS), "it may be in OFFBOARD");
    receive(&mut flight, 4400 * MS, &heartbeat(OFFBOARD, true));
    assert!(flight.shutdown(4490 * MS));
    assert!(flight.shutdown(4510 * MS));
    let mut sent = Sent::default();
    sent.take(&mut flight);
    assert_eq!(sent.modes, [4.0], "{sent:?}");
    receive(&mut flight, 4800 * MS, &heartbeat(HOLD, true));
    assert!(!flight.shutdown(4810 * MS));
}

#[test]
fn a_px4_is_asked_to_hold_its_place_only_while_its_position_is_no_older_than_configured() {
    for (set, is_asked) in
        [("phases.stale_vehicle_s=0.5", false), ("phases.stale_vehicle_s=0.9", true)]
    {
        let mut flight = flight_with("airborne", &[set]);
        receive(&mut flight, 0, &heartbeat(OFFBOARD, true));
        receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        assert!(hover(&mut flight, 20, 1000, OFFBOARD).setpoints > 20);
        // It is told to stop 0.7 s after the last position.
        assert_eq!(flight.shutdown(1680 * MS), is_asked, "{set}");
    }
}

#[test]
fn a_strangers_calibration_is_refused_in_flight_and_told() {
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
    let descent = |height_m: f32, lie_m: f64| {
        let mut flight = flight("airborne");
        flight.camera(0, CameraInfo::sample());
        flight.presence(0, "main", true);
        receive(&mut flight, 0, &heartbeat(4, true));
        receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        for ms in (20..4000).step_by(20) {
            if ms % 1000 == 0 {
                receive(&mut flight, ms * MS, &heartbeat(4, true));
            }
            pose_at(&mut flight, ms * MS, height_m);
            if ms % 60 == 0 {
                for (name, lie_m) in [("main", 0.0), ("other", lie_m)] {
                    let mut seen = Detections { detector: name.into(), ..seen(ms * MS - 40 * MS) };
                    let pose = seen.detections[0].pose.as_mut().unwrap();
                    pose.camera_from_marker.translation_m = [lie_m, 0.0, f64::from(height_m)];
                    flight.detections(ms * MS + 2, name, &seen);
                }
            }
            flight.tick(ms * MS + 3);
        }
        let status = flight.status(4000 * MS);
        (status.setpoint.unwrap().velocity_ned_m_s[2], status)
    };
    let (down_m_s, status) = descent(2.0, 0.0);
    assert!(down_m_s > 0.0, "{status:?}");
    let (down_m_s, status) = descent(2.0, 1.0);
    assert!(down_m_s < 0.0 && status.why.contains("at two places"), "{status:?}");
    assert!(status.warnings[0].contains("1.00 m apart"), "{status:?}");
    let (down_m_s, status) = descent(6.0, 1.0);
    assert!(down_m_s > 0.0, "high up it goes on: {status:?}");
}

#[test]
fn a_low_battery_leads_to_what_is_configured() {
    let set = ["phases.on_battery_low=\"hold\"", "alarms.battery_s=1"];
    let mut flight = flight_with("airborne", &set);
    receive(&mut flight, 0, &heartbeat(4, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    hover(&mut flight, 1000, 2000, 4);
    assert_eq!(flight.status(2000 * MS).phase, Phase::Search);
    let battery = SYS_STATUS_DATA { battery_remaining: 15, ..Default::default() };
    receive(&mut flight, 2000 * MS, &MavMessage::SYS_STATUS(battery));
    hover(&mut flight, 2000, 3500, 4);
    let status = flight.status(3500 * MS);
    assert_eq!((status.phase, status.why.as_str()), (Phase::Hold, "the battery is low"));
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
fn only_a_resumed_landing_begins_by_itself() {
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
        // Motors that run again so soon were not off: the landing goes on.
        ("resume", 4, flying, Phase::Search, 5000, Phase::Search),
        ("resume", 5, flying, Phase::Idle, 5000, Phase::Idle),
    ] {
        let phases = next_flight(start, mode, contact, armed_ms);
        assert_eq!(phases, (first, next), "{start} in {mode}, armed after {armed_ms} ms");
    }
}

#[test]
fn a_pilot_who_arms_again_at_once_after_a_landing_has_the_next_flight_landed() {
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
fn after_a_restart_of_the_autopilot_nothing_begins_by_itself() {
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
    for (what, height_m, left, phase) in [
        ("told", 0.05, Some(note(0.0, 1, now_ns - 5000 * MS)), Phase::Final),
        ("told, on a pad on a hill", 3.05, Some(note(-3.0, 1, now_ns - 5000 * MS)), Phase::Final),
        ("told, over it", 1.0, Some(note(0.0, 1, now_ns - 5000 * MS)), Phase::Search),
        ("told, over a valley", 0.05, Some(note(2.0, 1, now_ns - 5000 * MS)), Phase::Search),
        ("told long ago", 3.05, Some(note(-3.0, 1, now_ns - 90_000 * MS)), Phase::Search),
        ("told of another vehicle", 3.05, Some(note(-3.0, 2, now_ns)), Phase::Search),
        ("not told, still at the height of the origin", 0.05, None, Phase::Final),
        ("not told, in flight", 5.0, None, Phase::Search),
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
        assert_eq!(status.phase, phase, "{what}: {status:?}");
        assert_eq!(land, phase == Phase::Final, "{what}");
        assert!(!land || highest_m_s <= 0.0, "{what}: it climbed at {highest_m_s} m/s");
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
