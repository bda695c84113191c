//! A flight fed packets of a PX4: from HOLD or a take-off into OFFBOARD with zero setpoints, landings in LAND,
//! and the way out to HOLD wherever setpoints end.

#![allow(clippy::unwrap_used, reason = "helpers of tests may fail like tests")]

mod packets;

use autopilot::FlightMode;
use autopilot::dialect::{
    CURRENT_MODE_DATA, ESTIMATOR_STATUS_DATA, EstimatorStatusFlags, GLOBAL_POSITION_INT_DATA,
    HEARTBEAT_DATA, LOCAL_POSITION_NED_DATA, MavCmd, MavLandedState, MavMessage, MavState,
};
use controller::flight::Flight;
use messages::{CameraInfo, ControllerCommand, Phase};
use packets::{
    MS, Sent, contact, flight, flight_with, heartbeat, hover, pose, pose_at, receive, sent,
};

#[test]
fn a_px4_that_holds_its_place_is_asked_to_land_automatically() {
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
        // A controller that is asked to stop, and has only the mode of almost a second ago.
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
fn a_px4_that_holds_its_place_lands_there_by_command() {
    let asked = |flight: &mut Flight, now_ms: i64| {
        let reply = flight.command(now_ms * MS, &ControllerCommand::LandHere);
        assert!(reply.accepted, "{reply:?}");
        assert_eq!(flight.status(now_ms * MS).phase, Phase::Final);
    };
    // Before a landing, and after an abort, which ends in HOLD.
    for is_aborted in [false, true] {
        let mut flight = if is_aborted {
            let mut flight = px4_in(OFFBOARD, "command", &[]);
            assert!(flight.command(1000 * MS, &ControllerCommand::Start).accepted);
            hover(&mut flight, 1020, 2000, OFFBOARD);
            assert!(flight.command(2000 * MS, &ControllerCommand::Abort).accepted);
            hover(&mut flight, 2020, 9900, OFFBOARD);
            hover(&mut flight, 10_000, 11_000, HOLD);
            flight
        } else {
            let mut flight = px4_in(HOLD, "command", &[]);
            hover(&mut flight, 1000, 11_000, HOLD);
            flight
        };
        asked(&mut flight, 11_000);
        assert!(!flight.command(11_010 * MS, &ControllerCommand::Start).accepted);
        let sent = hover(&mut flight, 11_020, 11_500, HOLD);
        assert_eq!((sent.modes.as_slice(), sent.setpoints), (&[4.0][..], 0), "{sent:?}");
        receive(&mut flight, 11_500 * MS, &heartbeat(LAND, true));
        hover(&mut flight, 11_520, 13_000, LAND);
        let status = flight.status(13_000 * MS);
        assert!(status.phase == Phase::Final && status.started_ns.is_some(), "{status:?}");
        assert!(status.why.contains("command to land here"), "{status:?}");
        receive(&mut flight, 13_000 * MS, &contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND));
        receive(&mut flight, 13_000 * MS, &heartbeat(LAND, false));
        flight.tick(13_010 * MS);
        assert_eq!(flight.status(13_010 * MS).phase, Phase::Landed);
    }
    // The pilot takes over, or the operator thinks better of it: nothing is sent any more.
    for (mode, command) in [(POSITION, None), (HOLD, Some(ControllerCommand::Abort))] {
        let mut flight = px4_in(HOLD, "command", &[]);
        asked(&mut flight, 1000);
        hover(&mut flight, 1020, 1100, HOLD);
        if let Some(command) = command {
            assert!(flight.command(1100 * MS, &command).accepted);
        }
        receive(&mut flight, 1200 * MS, &heartbeat(mode, true));
        let sent = hover(&mut flight, 1220, 9000, mode);
        assert!(sent.modes.is_empty() && sent.setpoints == 0, "{sent:?}");
        assert_eq!(flight.status(9000 * MS).phase, Phase::Failed);
    }
    // The command was on its way already, or taken, and its mode shows only after the operator's abort: back to HOLD.
    for shows_before in [false, true] {
        let mut flight = px4_in(HOLD, "command", &[]);
        asked(&mut flight, 1000);
        assert_eq!(hover(&mut flight, 1020, 1100, HOLD).modes, [4.0]);
        if shows_before {
            // Attitude and position are missing, so that no landing has begun.
            for ms in (1100..1900).step_by(20) {
                flight.tick(ms * MS);
            }
            receive(&mut flight, 1900 * MS, &heartbeat(LAND, true));
            flight.tick(1910 * MS);
            assert!(flight.status(1910 * MS).started_ns.is_none());
        }
        let at_ms = if shows_before { 1920 } else { 1100 };
        let mut sent = Sent::default();
        sent.take(&mut flight);
        let reply = flight.command(at_ms * MS, &ControllerCommand::Abort);
        assert!(reply.accepted && reply.reason.contains("called back to HOLD"), "{reply:?}");
        assert!(!flight.command((at_ms + 10) * MS, &ControllerCommand::Start).accepted);
        // The heartbeat of 2 s shows it.
        let sent = hover(&mut flight, at_ms + 20, 2980, LAND);
        assert_eq!(sent.modes.len(), 1, "asked for once, just after the heartbeat: {sent:?}");
        let status = flight.status(2980 * MS);
        assert!(status.phase == Phase::Idle && status.why.contains("called back"), "{status:?}");
        let sent = hover(&mut flight, 3000, 3900, HOLD);
        assert!(sent.modes.is_empty(), "{sent:?}");
        assert_eq!(flight.status(3900 * MS).phase, Phase::Failed);
    }
    // Nor is it called back against a pilot, once it is low, or for longer than PX4 may need.
    let called_back = |set: &[&str]| {
        let mut flight = px4_in(HOLD, "command", set);
        asked(&mut flight, 1000);
        hover(&mut flight, 1020, 1100, HOLD);
        let reply = flight.command(1100 * MS, &ControllerCommand::Abort);
        (flight, reply)
    };
    let (mut flight, _) = called_back(&[]);
    receive(&mut flight, 1200 * MS, &heartbeat(POSITION, true));
    let sent = hover(&mut flight, 1220, 1980, POSITION);
    assert!(sent.modes.is_empty(), "{sent:?}");
    let sent = hover(&mut flight, 2000, 9000, POSITION);
    assert!(sent.modes.is_empty() && sent.setpoints <= 2, "{sent:?}");
    let (mut flight, _) = called_back(&[]);
    let sent = hover(&mut flight, 1120, 12_000, LAND);
    assert!((3..=8).contains(&sent.modes.len()), "{sent:?}");
    let status = flight.status(12_000 * MS);
    assert!(
        status.why.contains("stays in LAND") && status.why.contains("mode switch"),
        "{status:?}"
    );
    let (flight, reply) = called_back(&["phases.no_return_height_m=10"]);
    assert!(!reply.accepted && reply.reason.contains("mode switch stops it"), "{reply:?}");
    assert_eq!(flight.status(1100 * MS).phase, Phase::Final);
    // A change to OFFBOARD that was asked for before is carried out in between.
    let mut flight = px4_asked_for_offboard("command");
    asked(&mut flight, 3100);
    receive(&mut flight, 3200 * MS, &heartbeat(OFFBOARD, true));
    let sent = hover(&mut flight, 3220, 3900, OFFBOARD);
    assert!(sent.modes.contains(&4.0) && sent.setpoints > 5, "{sent:?}");
    assert_eq!(flight.status(3900 * MS).phase, Phase::Final);
    // A pilot's mode is not ours to end.
    let mut flight = px4_in(POSITION, "command", &[]);
    assert!(!flight.command(1000 * MS, &ControllerCommand::LandHere).accepted);
}

/// A controller continues to end.
fn continues_to_end(flight: &mut Flight, from_ms: i64, to_ms: i64) {
    (from_ms..to_ms).step_by(20).for_each(|ms| assert!(flight.shutdown(ms * MS), "at {ms} ms"));
}

/// A controller that is ended, since 400 ms, sees OFFBOARD, and asks for HOLD until that shows.
fn ends_in_hold(flight: &mut Flight, from_ms: i64) {
    continues_to_end(flight, from_ms - 380, from_ms);
    receive(flight, from_ms * MS, &heartbeat(OFFBOARD, true));
    assert!(flight.shutdown((from_ms + 90) * MS));
    assert!(flight.shutdown((from_ms + 110) * MS));
    let mut sent = Sent::default();
    sent.take(flight);
    assert_eq!(sent.modes, [4.0], "{sent:?}");
    continues_to_end(flight, from_ms + 130, from_ms + 400);
    receive(flight, (from_ms + 400) * MS, &heartbeat(HOLD, true));
    assert!(!flight.shutdown((from_ms + 410) * MS));
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
    ends_in_hold(&mut flight, 3500);
}

#[test]
fn a_px4_of_unknown_state_in_offboard_gets_zeros_and_is_taken_back() {
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
    // Pinned, it need not listen for other vehicles.
    let mut flight = flight_with("takeoff", &["takeoff_height_m=5", "autopilot.system_id=1"]);
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
        continues_to_end(&mut flight, 5100, 5500);
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
    let mut flight = px4_in_land(3980);
    assert!(flight.command(3980 * MS, &ControllerCommand::Abort).accepted);
    let sent = hover(&mut flight, 4000, 4100, LAND);
    assert_eq!(sent.modes, [6.0], "just after the heartbeat of 4 s: {sent:?}");
    assert!(flight.shutdown(4100 * MS), "it may be in OFFBOARD");
    ends_in_hold(&mut flight, 4500);
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
        // It is commanded to stop 0.7 s after the last position.
        assert_eq!(flight.shutdown(1680 * MS), is_asked, "{set}");
    }
}

const LAND: u32 = 0x0604_0000;

fn current_mode(custom_mode: u32) -> MavMessage {
    MavMessage::CURRENT_MODE(CURRENT_MODE_DATA { custom_mode, ..Default::default() })
}

/// The same with the mode that its user chose last.
fn chosen_mode(custom_mode: u32, intended_custom_mode: u32) -> MavMessage {
    let mode = CURRENT_MODE_DATA { custom_mode, intended_custom_mode, ..Default::default() };
    MavMessage::CURRENT_MODE(mode)
}

/// The heartbeat of a PX4 that flies in HOLD, with an active failsafe or without.
fn heartbeat_in_hold(system_status: MavState) -> MavMessage {
    match heartbeat(HOLD, true) {
        MavMessage::HEARTBEAT(heartbeat) => {
            MavMessage::HEARTBEAT(HEARTBEAT_DATA { system_status, ..heartbeat })
        }
        other => other,
    }
}

/// A PX4 that has been landing in its own mode for 2 s, as requested.
fn px4_in_land(to_ms: i64) -> Flight {
    let mut flight = flight("airborne");
    flight.camera(0, CameraInfo::sample());
    flight.presence(0, "main", true);
    receive(&mut flight, 0, &heartbeat(OFFBOARD, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    hover(&mut flight, 20, 1000, OFFBOARD);
    assert!(flight.command(1000 * MS, &ControllerCommand::LandHere).accepted);
    hover(&mut flight, 1020, 1980, OFFBOARD);
    let sent = hover(&mut flight, 2000, to_ms, LAND);
    assert!(sent.setpoints > 30, "for the way back: {sent:?}");
    flight
}

#[test]
fn a_px4_that_leaves_land_as_its_motors_stop_has_landed() {
    for after in [OFFBOARD, HOLD] {
        let mut flight = px4_in_land(5980);
        let mut sent = Sent::default();
        for ms in (6000..11_000).step_by(20) {
            if ms % 200 == 0 {
                let ground = contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND);
                receive(&mut flight, ms * MS, &ground);
            }
            if ms % 1000 == 0 {
                let is_over = ms > 8300;
                let mode = if is_over { after } else { LAND };
                receive(&mut flight, ms * MS, &heartbeat(mode, !is_over));
            }
            // Disarmed at 8.3 s.
            if ms == 8320 {
                receive(&mut flight, ms * MS, &current_mode(after));
            }
            pose_at(&mut flight, ms * MS, 0.0);
            flight.tick(ms * MS + 3);
            if ms == 8300 {
                sent.take(&mut flight);
                sent = Sent::default();
            }
        }
        sent.take(&mut flight);
        let status = flight.status(11_000 * MS);
        assert!(status.phase == Phase::Landed && status.finished, "{status:?}");
        assert!(sent.setpoints == 0 && sent.modes.is_empty(), "{sent:?}");
    }
}

#[test]
fn after_a_standstill_of_more_than_15_s_no_px4_is_asked_for_offboard() {
    let mut flight = px4_asked_for_offboard("command");
    // The change was carried out in the meantime.
    receive(&mut flight, 25_000 * MS, &heartbeat(OFFBOARD, true));
    hover(&mut flight, 25_000, 28_000, OFFBOARD);
    let status = flight.status(28_000 * MS);
    assert!(status.started_ns.is_none(), "{status:?}");
    assert!(status.why.contains("did not run for 22 s"), "{status:?}");
}

/// A PX4 that is landing in OFFBOARD, at 2 s.
fn px4_landing() -> Flight {
    let mut flight = flight("airborne");
    flight.camera(0, CameraInfo::sample());
    flight.presence(0, "main", true);
    receive(&mut flight, 0, &heartbeat(OFFBOARD, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    assert!(hover(&mut flight, 20, 2000, OFFBOARD).setpoints > 20);
    assert!(is_steered(&flight, 2000), "{:?}", flight.status(2000 * MS));
    flight
}

fn is_steered(flight: &Flight, ms: i64) -> bool {
    matches!(flight.status(ms * MS).phase, Phase::Approach | Phase::Descend)
}

/// PX4 holds while setpoints are missing, and returns to OFFBOARD with the next one. Packets of the time without setpoints are read after it.
#[test]
fn a_hold_for_missing_setpoints_ends_with_them_in_whatever_order_packets_are_read() {
    let backlogs: [&[u32]; 4] = [&[], &[HOLD], &[OFFBOARD, HOLD], &[HOLD, OFFBOARD, HOLD]];
    for is_frozen in [true, false] {
        for backlog in backlogs {
            let mut flight = px4_landing();
            if !is_frozen {
                // No packet arrives for 5 s.
                for ms in (2000..7000).step_by(20) {
                    flight.tick(ms * MS);
                }
            }
            for mode in backlog {
                receive(&mut flight, 7000 * MS, &heartbeat(*mode, true));
            }
            let mut sent = Sent::default();
            sent.take(&mut flight);
            // It shows HOLD until its next heartbeat.
            let sent = hover(&mut flight, 7020, 7980, OFFBOARD);
            let status = flight.status(7980 * MS);
            assert!(sent.setpoints > 20, "{is_frozen} {backlog:x?}: {sent:?} {status:?}");
            assert_ne!(status.phase, Phase::PilotInCommand, "{is_frozen} {backlog:x?}");
            hover(&mut flight, 8000, 10_000, OFFBOARD);
            let status = flight.status(10_000 * MS);
            assert!(is_steered(&flight, 10_000), "{is_frozen} {backlog:x?}: {status:?}");
            // Long after that HOLD is a pilot's choice.
            receive(&mut flight, 10_010 * MS, &heartbeat(HOLD, true));
            flight.tick(10_020 * MS);
            assert_eq!(flight.status(10_020 * MS).phase, Phase::PilotInCommand);
        }
    }
}

#[test]
fn a_mode_that_was_chosen_while_setpoints_were_missing_is_kept() {
    // HOLD stays although setpoints are sent.
    let mut flight = px4_landing();
    receive(&mut flight, 7000 * MS, &heartbeat(HOLD, true));
    let sent = hover(&mut flight, 7020, 8980, HOLD);
    assert_eq!(flight.status(8980 * MS).phase, Phase::Hold, "{sent:?}");
    assert!(sent.modes.is_empty(), "{sent:?}");
    let sent = hover(&mut flight, 9000, 12_000, HOLD);
    assert!(sent.setpoints < 40 && sent.modes.is_empty(), "{sent:?}");
    assert_eq!(flight.status(12_000 * MS).phase, Phase::PilotInCommand);
    // Another mode is a pilot's at once.
    let mut flight = px4_landing();
    receive(&mut flight, 7000 * MS, &heartbeat(HOLD, true));
    receive(&mut flight, 7001 * MS, &heartbeat(POSITION, true));
    assert_eq!(flight.status(7001 * MS).phase, Phase::PilotInCommand);
    Sent::default().take(&mut flight);
    assert_eq!(hover(&mut flight, 7020, 9000, POSITION).setpoints, 0);
    // The status names that mode, also where another one follows.
    receive(&mut flight, 9010 * MS, &heartbeat(OFFBOARD, true));
    let why = flight.status(9020 * MS).why;
    assert!(why.contains(&FlightMode::Px4(POSITION).to_string()), "{why}");
    assert!(!why.contains("OFFBOARD"), "{why}");
}

#[test]
fn a_px4_is_held_until_resume_after_a_standstill_of_more_than_15_s() {
    let mut flight = px4_landing();
    receive(&mut flight, 25_000 * MS, &heartbeat(HOLD, true));
    let sent = hover(&mut flight, 25_020, 30_000, OFFBOARD);
    let status = flight.status(30_000 * MS);
    assert!(status.phase == Phase::Hold && sent.setpoints > 100, "{status:?} {sent:?}");
    assert!(status.why.contains("for more than 15 s"), "{status:?}");
    assert!(flight.command(30_000 * MS, &ControllerCommand::Resume).accepted);
    hover(&mut flight, 30_020, 32_000, OFFBOARD);
    assert!(is_steered(&flight, 32_000), "{:?}", flight.status(32_000 * MS));
}

#[test]
fn the_landing_of_a_px4_that_holds_for_missing_setpoints_is_resumed_whatever_mode_it_shows_first() {
    for (first, then, resumes) in
        [(HOLD, OFFBOARD, true), (OFFBOARD, OFFBOARD, true), (HOLD, HOLD, false)]
    {
        let mut flight = flight("resume");
        flight.camera(0, CameraInfo::sample());
        flight.presence(0, "main", true);
        receive(&mut flight, 0, &heartbeat(first, true));
        receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        let zeros = hover(&mut flight, 20, 980, first).setpoints;
        assert!(zeros > 10, "{first:x} {zeros}");
        hover(&mut flight, 1000, 4000, then);
        let status = flight.status(4000 * MS);
        assert_eq!(is_steered(&flight, 4000), resumes, "{first:x} {then:x}: {status:?}");
        let sent = hover(&mut flight, 4000, 6000, then);
        assert_eq!(sent.setpoints > 20, resumes, "{first:x} {then:x}: {sent:?}");
        assert!(sent.modes.is_empty(), "{sent:?}");
    }
}

#[test]
fn a_heartbeat_that_current_mode_overtook_is_no_pilots_switch() {
    let mut flight = px4_asked_for_offboard("command");
    receive(&mut flight, 3110 * MS, &current_mode(OFFBOARD));
    hover(&mut flight, 3120, 3200, OFFBOARD);
    receive(&mut flight, 3210 * MS, &heartbeat(HOLD, true));
    let sent = hover(&mut flight, 3220, 3600, OFFBOARD);
    assert!(sent.setpoints > 5, "{sent:?}");
    let phase = flight.status(3600 * MS).phase;
    assert!(matches!(phase, Phase::Approach | Phase::Descend), "{phase:?}");
    // Later it is one.
    receive(&mut flight, 3900 * MS, &heartbeat(HOLD, true));
    assert_eq!(flight.status(3900 * MS).phase, Phase::PilotInCommand);

    let mut flight = px4_in_land(3980);
    assert!(flight.command(3980 * MS, &ControllerCommand::Abort).accepted);
    assert_eq!(hover(&mut flight, 4000, 4100, LAND).modes, [6.0]);
    receive(&mut flight, 4110 * MS, &current_mode(OFFBOARD));
    hover(&mut flight, 4120, 4300, OFFBOARD);
    receive(&mut flight, 4310 * MS, &heartbeat(LAND, true));
    let sent = hover(&mut flight, 4320, 5900, OFFBOARD);
    assert!(sent.setpoints > 40 && sent.modes.is_empty(), "it hovers: {sent:?}");
}

#[test]
fn a_px4_that_comes_into_offboard_after_all_is_asked_to_hold_its_place() {
    // A landing is called back, no packet arrives for 5 s, and then the last request is carried out.
    let mut flight = px4_in_land(3980);
    assert!(flight.command(3980 * MS, &ControllerCommand::Abort).accepted);
    hover(&mut flight, 4000, 10_980, LAND);
    let sent = hover(&mut flight, 11_000, 12_900, OFFBOARD);
    assert!(sent.modes.contains(&4.0) && sent.setpoints > 20, "{sent:?}");
    let sent = hover(&mut flight, 13_000, 14_900, HOLD);
    assert!(sent.modes.is_empty() && sent.setpoints <= 1, "{sent:?}");

    // A take-off fails because the heartbeat is lost, and OFFBOARD was on its way.
    let mut flight = px4_at_the_end_of_its_takeoff();
    for ms in (5120..9000).step_by(20) {
        pose(&mut flight, ms * MS);
        flight.tick(ms * MS + 3);
    }
    assert_eq!(flight.status(9000 * MS).phase, Phase::Failed);
    let sent = hover(&mut flight, 9000, 10_900, OFFBOARD);
    assert!(sent.modes.contains(&4.0) && sent.setpoints > 20, "{sent:?}");

    // OFFBOARD is chosen by a switch while it lands, which PX4 allows as zeros are sent.
    let mut flight = px4_in_land(5980);
    let sent = hover(&mut flight, 6000, 7900, OFFBOARD);
    assert!(sent.modes.contains(&4.0) && sent.setpoints > 20, "{sent:?}");

    // Once: a second choice comes from another program.
    hover(&mut flight, 8000, 8900, HOLD);
    let sent = hover(&mut flight, 9000, 12_000, OFFBOARD);
    assert!(sent.modes.is_empty() && sent.setpoints <= 1, "{sent:?}");

    // Another program's OFFBOARD is none of ours.
    let mut flight = px4_in(OFFBOARD, "command", &[]);
    let sent = hover(&mut flight, 1020, 5000, OFFBOARD);
    assert!(sent.modes.is_empty() && sent.setpoints == 0, "{sent:?}");
}

#[test]
fn a_precision_landing_that_ends_before_it_began_leaves_no_px4_in_offboard() {
    for ends in [Some(ControllerCommand::Abort), None] {
        let mut flight = px4_in(OFFBOARD, "command", &["mode=landing-target"]);
        assert!(flight.command(1000 * MS, &ControllerCommand::Start).accepted);
        let sent = hover(&mut flight, 1020, 1980, OFFBOARD);
        assert!(sent.setpoints > 10 && sent.modes.is_empty(), "{sent:?}");
        let sent = match ends {
            Some(command) => {
                assert!(flight.command(1990 * MS, &command).accepted);
                hover(&mut flight, 2000, 3900, OFFBOARD)
            }
            None => {
                let mut sent = Sent::default();
                for ms in (2000..3900).step_by(20) {
                    if ms % 1000 == 0 {
                        receive(&mut flight, ms * MS, &heartbeat(OFFBOARD, true));
                    }
                    assert!(flight.shutdown(ms * MS + 3));
                    sent.take(&mut flight);
                }
                receive(&mut flight, 4000 * MS, &heartbeat(HOLD, true));
                assert!(!flight.shutdown(4020 * MS));
                sent
            }
        };
        assert!(sent.modes.contains(&4.0) && sent.setpoints > 20, "{sent:?}");
    }
}

#[test]
fn hold_is_not_asked_for_again_once_the_pilot_may_have_another_mode() {
    let mut flight = px4_asked_for_offboard("command");
    assert!(flight.command(3100 * MS, &ControllerCommand::Abort).accepted);
    hover(&mut flight, 3120, 3980, HOLD);
    receive(&mut flight, 4000 * MS, &heartbeat(OFFBOARD, true));
    let mut asked_ms = Vec::new();
    for ms in (4020..8000).step_by(20) {
        // The pilot switched at 4.3 s, and the heartbeat of 5 s comes late.
        if ms % 1000 == 180 {
            receive(&mut flight, ms * MS, &heartbeat(POSITION, true));
        }
        pose(&mut flight, ms * MS);
        flight.tick(ms * MS + 3);
        let mut sent = Sent::default();
        sent.take(&mut flight);
        asked_ms.extend(sent.modes.iter().map(|_| ms));
    }
    assert!(asked_ms.len() == 1 && asked_ms[0] < 4300, "{asked_ms:?}");
}

#[test]
fn a_pilot_who_lands_gets_no_zeros() {
    let mut flight = px4_in_land(3980);
    hover(&mut flight, 4000, 6000, POSITION);
    assert_eq!(flight.status(6000 * MS).phase, Phase::PilotInCommand);
    let sent = hover(&mut flight, 6000, 9000, LAND);
    assert!(sent.setpoints == 0 && sent.modes.is_empty(), "{sent:?}");
}

#[test]
fn a_start_that_was_aborted_does_not_begin_a_landing_where_px4_refuses_hold() {
    let mut flight = px4_asked_for_offboard("airborne");
    assert!(flight.command(3100 * MS, &ControllerCommand::Abort).accepted);
    hover(&mut flight, 3120, 3980, HOLD);
    for ms in (4000..20_000).step_by(1000) {
        hover(&mut flight, ms, ms + 1000, OFFBOARD);
        let status = flight.status((ms + 1000) * MS);
        assert!(matches!(status.phase, Phase::Idle | Phase::Failed), "{status:?}");
    }
}

#[test]
fn a_pause_in_which_no_zero_is_sent_ends_no_precision_landing() {
    let mut flight = px4_in(OFFBOARD, "command", &["mode=landing-target"]);
    assert!(flight.command(1000 * MS, &ControllerCommand::Start).accepted);
    hover(&mut flight, 1020, 1980, OFFBOARD);
    // Nothing runs for 0.4 s.
    let sent = hover(&mut flight, 2380, 2980, OFFBOARD);
    assert!(sent.setpoints > 5, "{sent:?}");
    let status = flight.status(2980 * MS);
    assert!(status.phase == Phase::Final && status.why.contains("LAND"), "{status:?}");
}

#[test]
fn a_px4_that_is_just_being_led_out_of_offboard_is_led_out_when_the_controller_ends() {
    // OFFBOARD is chosen by a switch while it lands.
    let mut flight = px4_in_land(5980);
    assert_eq!(hover(&mut flight, 6000, 6300, OFFBOARD).modes, [4.0]);
    let reply = flight.command(6290 * MS, &ControllerCommand::Start);
    assert!(!reply.accepted, "{reply:?}");
    let mut sent = Sent::default();
    for ms in (6300..6900).step_by(20) {
        assert!(flight.shutdown(ms * MS));
        sent.take(&mut flight);
    }
    assert!(sent.setpoints > 5, "until it shows HOLD: {sent:?}");
    receive(&mut flight, 7000 * MS, &heartbeat(HOLD, true));
    assert!(!flight.shutdown(7020 * MS));
}

#[test]
fn an_abort_while_hold_is_undecided_hovers_by_zeros_until_it_is_known() {
    let aborted = || {
        let mut flight = px4_landing();
        receive(&mut flight, 7000 * MS, &heartbeat(HOLD, true));
        hover(&mut flight, 7020, 7100, HOLD);
        let reply = flight.command(7100 * MS, &ControllerCommand::Abort);
        assert!(reply.accepted && reply.reason.contains("not known yet"), "{reply:?}");
        let sent = hover(&mut flight, 7120, 7980, HOLD);
        assert!(sent.setpoints > 10 && sent.modes.is_empty(), "{sent:?}");
        flight
    };
    // It has returned to OFFBOARD with the first setpoint after the interruption.
    let mut flight = aborted();
    let sent = hover(&mut flight, 8000, 11_900, OFFBOARD);
    assert!(sent.setpoints > 60 && sent.modes.is_empty(), "{sent:?}");
    let why = flight.status(11_900 * MS).why;
    assert!(why.contains("in OFFBOARD, by setpoints"), "{why}");
    let sent = hover(&mut flight, 12_000, 14_900, OFFBOARD);
    assert!(sent.setpoints > 30 && sent.modes.contains(&4.0), "{sent:?}");
    // HOLD stays: it was chosen.
    let mut flight = aborted();
    let sent = hover(&mut flight, 8000, 14_000, HOLD);
    assert!(sent.setpoints < 40 && sent.modes.is_empty(), "{sent:?}");
    let status = flight.status(14_000 * MS);
    assert!(status.phase == Phase::Aborted && status.why.ends_with("in HOLD"), "{status:?}");
    // The controller is ended: it continues until that is known.
    let mut flight = aborted();
    continues_to_end(&mut flight, 8000, 8400);
    ends_in_hold(&mut flight, 8800);
}

#[test]
fn a_pilot_who_chooses_hold_in_a_failsafe_keeps_it_in_whatever_order_packets_are_read() {
    let packets = [
        heartbeat_in_hold(MavState::MAV_STATE_CRITICAL),
        chosen_mode(HOLD, OFFBOARD),
        heartbeat_in_hold(MavState::MAV_STATE_ACTIVE),
        chosen_mode(HOLD, HOLD),
    ];
    for is_interrupted in [false, true] {
        for order in 0..24 {
            let mut flight = px4_landing();
            receive(&mut flight, 1990 * MS, &chosen_mode(OFFBOARD, OFFBOARD));
            let from_ms = if is_interrupted { 4000 } else { 2000 };
            let mut left: Vec<&MavMessage> = packets.iter().collect();
            let mut rest = order;
            for count in (1..=packets.len()).rev() {
                let packet = left.remove(rest % count);
                rest /= count;
                receive(&mut flight, from_ms * MS, packet);
            }
            Sent::default().take(&mut flight);
            let mut sent = Sent::default();
            for ms in (from_ms + 20..from_ms + 6000).step_by(20) {
                if ms % 500 == 0 {
                    receive(&mut flight, ms * MS, &chosen_mode(HOLD, HOLD));
                    receive(&mut flight, ms * MS, &heartbeat_in_hold(MavState::MAV_STATE_ACTIVE));
                }
                pose(&mut flight, ms * MS);
                flight.tick(ms * MS + 3);
                sent.take(&mut flight);
            }
            let status = flight.status((from_ms + 6000) * MS);
            assert_eq!(status.phase, Phase::PilotInCommand, "{order}: {status:?}");
            // For half a second at most, which HOLD ignores.
            assert!(sent.setpoints <= 12 && sent.modes.is_empty(), "{order}: {sent:?}");
        }
    }
}

#[test]
fn an_abort_after_the_link_was_lost_states_no_mode_from_before() {
    for (silent_ms, is_stated) in [(100, true), (400, false), (900, false)] {
        let mut flight = px4_landing();
        receive(&mut flight, 2000 * MS, &heartbeat(OFFBOARD, true));
        for ms in (2000..2000 + silent_ms).step_by(20) {
            flight.tick(ms * MS);
        }
        let reply = flight.command((2000 + silent_ms) * MS, &ControllerCommand::Abort);
        let states_mode = reply.reason.contains("in OFFBOARD, by setpoints");
        assert!(reply.accepted && states_mode == is_stated, "{silent_ms} ms: {reply:?}");
    }
}

/// A PX4 holds a velocity as it estimates it.
#[test]
fn a_px4_that_waits_for_its_landing_in_offboard_is_led_back_to_where_it_waits() {
    let waiting = [("command", "mode=landing-target"), ("resume", "clock=\"elsewhere\"")];
    for (start, set) in waiting {
        let mut flight = flight_with(start, &[set]);
        receive(&mut flight, 0, &heartbeat(OFFBOARD, true));
        receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        hover(&mut flight, 20, 1000, OFFBOARD);
        let mut sent = Sent::default();
        let drift = |flight: &mut Flight, sent: &mut Sent, ms: i64, north_m: f32| {
            if ms % 500 == 0 {
                receive(flight, ms * MS, &heartbeat(OFFBOARD, true));
            }
            receive(flight, ms * MS, &packets::attitude(ms * MS));
            let MavMessage::LOCAL_POSITION_NED(position) = packets::position(ms * MS, 5.0) else {
                unreachable!()
            };
            let position = LOCAL_POSITION_NED_DATA { x: north_m, ..position };
            receive(flight, ms * MS + 1, &MavMessage::LOCAL_POSITION_NED(position));
            flight.tick(ms * MS + 3);
            sent.take(flight);
        };
        // Another program flies it in OFFBOARD, before the landing is commanded.
        for ms in (1020..4000).step_by(20) {
            let is_flown = start == "command";
            drift(
                &mut flight,
                &mut sent,
                ms,
                if is_flown { 0.01 * (ms - 4000) as f32 } else { 0.0 },
            );
        }
        if start == "command" {
            assert_eq!(sent.setpoints, 0);
            assert!(flight.command(4000 * MS, &ControllerCommand::Start).accepted);
        }
        for ms in (4000..7000).step_by(20) {
            drift(&mut flight, &mut sent, ms, 0.0);
        }
        assert_eq!(sent.velocity_m_s, [0.0; 3], "{start}");
        for ms in (7000..11_000).step_by(20) {
            drift(&mut flight, &mut sent, ms, 0.25e-3 * (ms - 7000) as f32);
        }
        let [north_m_s, east_m_s, down_m_s] = sent.velocity_m_s;
        assert!((-0.6..-0.4).contains(&north_m_s), "{start}: {sent:?}");
        assert!(east_m_s.abs() < 0.01 && down_m_s == 0.0, "{start}: {sent:?}");
        assert!(sent.setpoints > 100, "{start}: {}", sent.setpoints);
    }
}

/// The kill switch disarms 5 s later, flight termination never; the vehicle falls from 1 m, and the ground is reported.
#[test]
fn a_px4_whose_motors_are_killed_in_the_air_has_not_landed() {
    const TERMINATION: u32 = 10 << 16;
    let killed = |mode| match heartbeat(mode, true) {
        MavMessage::HEARTBEAT(heartbeat) => MavMessage::HEARTBEAT(HEARTBEAT_DATA {
            system_status: MavState::MAV_STATE_FLIGHT_TERMINATION,
            ..heartbeat
        }),
        other => other,
    };
    for (name, report, shown) in [
        ("kill switch", killed(OFFBOARD), OFFBOARD),
        ("termination", killed(TERMINATION), TERMINATION),
        ("termination by CURRENT_MODE", chosen_mode(TERMINATION, OFFBOARD), TERMINATION),
    ] {
        let mut flight = px4_landing();
        hover(&mut flight, 2000, 3000, OFFBOARD);
        let mut sent = Sent::default();
        let (mut height_m, mut sinks_m_s) = (1.0_f32, 0.0_f32);
        for ms in (3000..9000).step_by(20) {
            sinks_m_s = if height_m > 0.0 { sinks_m_s + 0.02 * 9.8 } else { 0.0 };
            height_m = (height_m - 0.02 * sinks_m_s).max(0.0);
            receive(&mut flight, ms * MS, &packets::attitude(ms * MS));
            let MavMessage::LOCAL_POSITION_NED(position) = packets::position(ms * MS, height_m)
            else {
                unreachable!()
            };
            let falls = MavMessage::LOCAL_POSITION_NED(LOCAL_POSITION_NED_DATA {
                vz: sinks_m_s,
                ..position
            });
            receive(&mut flight, ms * MS + 1, &falls);
            if ms == 3100 {
                receive(&mut flight, ms * MS + 1, &report);
            }
            if ms > 3600 && ms % 200 == 0 {
                let ground = contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND);
                receive(&mut flight, ms * MS + 1, &ground);
            }
            if ms >= 4000 && ms % 1000 == 0 {
                receive(&mut flight, ms * MS + 1, &killed(shown));
            }
            flight.tick(ms * MS + 3);
            if ms == 3200 {
                sent.take(&mut flight);
                sent = Sent::default();
            }
        }
        sent.take(&mut flight);
        let status = flight.status(9000 * MS);
        assert_eq!(status.phase, Phase::Aborted, "{name}: {status:?}");
        assert!(status.why.contains("stopped (disarmed) in the air"), "{name}: {status:?}");
        assert!(sent.setpoints == 0 && sent.modes.is_empty(), "{name}: {sent:?}");
    }
}

#[test]
fn a_failsafe_that_flies_another_mode_than_hold_is_reported_as_one() {
    const RETURN: u32 = 0x0504_0000;
    for (chosen, expected) in [
        (OFFBOARD, "a failsafe of the autopilot flies the vehicle, in PX4 RETURN"),
        (RETURN, "the pilot flies, in PX4 RETURN"),
    ] {
        // The report of both modes comes before the heartbeat, or after it.
        for shows_first in [false, true] {
            let mut flight = px4_landing();
            let reports = [heartbeat(RETURN, true), chosen_mode(RETURN, chosen)];
            let order = if shows_first { [0, 1] } else { [1, 0] };
            for (i, index) in order.into_iter().enumerate() {
                receive(&mut flight, (2000 + 40 * i as i64) * MS, &reports[index]);
                flight.tick((2010 + 40 * i as i64) * MS);
            }
            let sent = hover(&mut flight, 2100, 4000, RETURN);
            assert!(sent.setpoints == 0 && sent.modes.is_empty(), "{sent:?}");
            let status = flight.status(4000 * MS);
            assert_eq!(status.phase, Phase::PilotInCommand, "{status:?}");
            assert!(status.why.contains(expected), "{status:?}");
        }
    }
}

#[test]
fn a_hold_for_another_failsafe_than_missing_setpoints_ends_the_landing_after_15_s() {
    let mut flight = px4_landing();
    let mut sent = Sent::default();
    for ms in (2000..22_000).step_by(20) {
        if ms % 500 == 0 {
            receive(&mut flight, ms * MS, &chosen_mode(HOLD, OFFBOARD));
            receive(&mut flight, ms * MS, &heartbeat_in_hold(MavState::MAV_STATE_CRITICAL));
        }
        pose(&mut flight, ms * MS);
        flight.tick(ms * MS + 3);
        let phase = flight.status(ms * MS).phase;
        let expected = if ms < 16_980 { Phase::Hold } else { Phase::PilotInCommand };
        assert!(
            ms < 2040 || (16_980..17_100).contains(&ms) || phase == expected,
            "{ms}: {phase:?}"
        );
        if ms == 17_200 {
            sent.take(&mut flight);
            assert!(sent.modes.is_empty(), "{sent:?}");
            sent = Sent::default();
        }
    }
    sent.take(&mut flight);
    assert!(sent.setpoints == 0 && sent.modes.is_empty(), "{sent:?}");
}
