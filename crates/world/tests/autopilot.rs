//! Compares the simulated autopilot with measurements of ArduPilot Copter 4.5.4: intervals, acknowledgements,
//! arming, modes, take-off, velocity setpoints, landings and their times.

#![allow(clippy::unwrap_used, reason = "a test prints where it fails")]
#![allow(deprecated, reason = "messages of real programs are tested, superseded or not")]

mod bench;

use std::collections::BTreeSet;

use autopilot::dialect::{
    CharArray, MavDataStream, MavFrame, MavMessage, MavModeFlag, MavParamType,
    PARAM_REQUEST_LIST_DATA, PARAM_REQUEST_READ_DATA, PARAM_SET_DATA, REQUEST_DATA_STREAM_DATA,
    SET_MODE_DATA, TIMESYNC_DATA,
};
use bench::{Bench, COMPANION, FREE_HEADING, GROUND, HOLD_HEADING, WITH_YAW, steady, whole, windy};
use world::ardupilot::AutopilotConfig;
use world::world::{STEP_S, WorldConfig};

const LOCAL: MavFrame = MavFrame::MAV_FRAME_LOCAL_NED;

fn with_parameters(parameters: &[(&str, f32)]) -> WorldConfig {
    let mut config = steady();
    config.autopilot.parameters =
        parameters.iter().map(|(name, value)| ((*name).into(), *value)).collect();
    config
}

fn slow_start() -> WorldConfig {
    WorldConfig {
        autopilot: AutopilotConfig { ready_after_s: 42.0, ..AutopilotConfig::default() },
        ..WorldConfig::default()
    }
}

fn near(value: f64, expected: f64, tolerance: f64) {
    assert!((value - expected).abs() <= tolerance, "{value} instead of {expected} +- {tolerance}");
}

fn yaw_deg(bench: &Bench) -> f64 {
    bench.world.truth().ned_from_body.euler().2.to_degrees()
}

// Link and messages.

#[test]
fn unrequested_messages_are_few() {
    let mut bench = Bench::new(&WorldConfig::default(), 1);
    bench.run(60.0);
    let ids: BTreeSet<u32> = bench.log.iter().map(|(_, frame)| frame.message_id).collect();
    assert_eq!(ids, BTreeSet::from([0, 49, 111, 242, 253]));
    assert_eq!(bench.of(0).count(), 61);
    assert_eq!(bench.of(111).count(), 6);
}

#[test]
fn a_mode_change_brings_one_heartbeat_more() {
    let mut bench = Bench::new(&WorldConfig::default(), 1);
    bench.run(3.3);
    let before = bench.of(0).count();
    bench.mode(4);
    assert_eq!(bench.of(0).count(), before + 1);
    assert_eq!(bench.heartbeat(), (89, 4, 3));
    bench.mode(4);
    assert_eq!(bench.of(0).count(), before + 1);
}

#[test]
fn intervals_are_acknowledged_and_exact() {
    let mut bench = Bench::new(&WorldConfig::default(), 1);
    bench.run(2.5);
    assert_eq!(bench.request(30, 200.0), 0);
    assert_eq!(bench.request(32, 50.0), 0);
    bench.run(10.0 - STEP_S);
    assert_eq!(bench.of(30).count(), 2000);
    assert_eq!(bench.of(32).count(), 500);
    bench.step();
    assert_eq!(bench.request(30, -1.0), 0);
    let sent = bench.of(30).count();
    bench.run(1.0);
    assert_eq!(bench.of(30).count(), sent);
    assert_eq!(bench.request(149, 5.0), 2);
    assert!(bench.texts().contains(&"No ap_message for mavlink id (149)".to_owned()));
}

#[test]
fn every_known_message_is_sent_on_request() {
    let mut config = WorldConfig::default();
    config.autopilot.rangefinder = true;
    let mut bench = Bench::flying(&config, 1, 5.0);
    for id in [1, 2, 24, 30, 31, 32, 33, 49, 74, 85, 108, 132, 147, 164, 173, 193, 242, 245] {
        bench.velocity(LOCAL, HOLD_HEADING, [0.0; 3], [0.0; 2]);
        assert_eq!(bench.request(id, 10.0), 0, "{id}");
        let before = bench.of(id.into()).count();
        bench.run(0.98);
        assert_eq!(bench.of(id.into()).count() - before, 10, "{id}");
    }
}

#[test]
fn a_data_stream_is_not_acknowledged_and_overwrites_intervals() {
    let mut bench = Bench::new(&WorldConfig::default(), 1);
    bench.run(2.5);
    bench.request(30, 50.0);
    let sent = bench.log.len();
    bench.send(&MavMessage::REQUEST_DATA_STREAM(REQUEST_DATA_STREAM_DATA {
        req_message_rate: 4,
        target_system: 1,
        target_component: 1,
        req_stream_id: MavDataStream::MAV_DATA_STREAM_ALL,
        start_stop: 1,
    }));
    assert!(bench.log[sent..].iter().all(|(_, frame)| frame.message_id != 77));
    let before = bench.of(30).count();
    bench.run(4.9);
    assert_eq!(bench.of(30).count() - before, 20);
}

#[test]
fn a_slow_start_is_ready_after_42_seconds() {
    let mut bench = Bench::new(&slow_start(), 1);
    bench.step();
    for id in [1, 32, 193] {
        assert_eq!(bench.request(id, 10.0), 0);
    }
    bench.run(60.0);
    let prearm = |frame: &autopilot::Packet| whole(frame)[11] & 0x10 != 0;
    near(bench.of(1).find(|(_, frame)| prearm(frame)).unwrap().0, 42.0, 0.2);
    let flags =
        |frame: &autopilot::Packet| u16::from_le_bytes([whole(frame)[20], whole(frame)[21]]);
    near(bench.of(193).find(|(_, frame)| flags(frame) == 831).unwrap().0, 42.0, 0.2);
    near(bench.of(32).next().unwrap().0, 20.0, 0.5);
}

#[test]
fn modes_are_acknowledged_also_while_disarmed() {
    let mut bench = Bench::new(&slow_start(), 1);
    bench.run(1.0);
    assert_eq!(bench.mode(4), 0);
    assert_eq!(bench.mode(99), 4);
    let sent = bench.log.len();
    bench.send(&MavMessage::SET_MODE(SET_MODE_DATA {
        custom_mode: 5,
        target_system: 1,
        base_mode: MavModeFlag::MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
    }));
    assert_eq!(bench.acknowledgement(sent, 11), Some(0));
    assert_eq!(bench.heartbeat(), (81, 5, 3));
}

#[test]
fn arming_too_early_fails_with_its_reasons() {
    let mut bench = Bench::new(&slow_start(), 1);
    bench.run(10.0);
    assert_eq!(bench.command(400, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), Some(4));
    let texts = bench.texts();
    assert!(texts.iter().any(|text| text == "Arm: Need Position Estimate"), "{texts:?}");
    let last = &texts[texts.len() - 2..];
    assert_eq!(
        (last[0].len(), last.concat().as_str()),
        (50, "Arm: AHRS: EKF3 Yaw inconsistent 77 deg. Wait or reboot")
    );
}

#[test]
fn arming_shows_in_the_next_heartbeat() {
    let mut bench = Bench::new(&WorldConfig::default(), 1);
    bench.run(3.25);
    bench.mode(4);
    assert_eq!(bench.command(400, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), Some(0));
    assert_eq!(bench.heartbeat().0, 89);
    let late = bench.wait(1.1, "an armed heartbeat", |bench| bench.heartbeat().0 == 217);
    near(late, 0.75, 0.01);
    assert_eq!(bench.heartbeat(), (217, 4, 3));
    assert!(bench.texts().contains(&"Arming motors".to_owned()));
}

#[test]
fn takeoff_is_accepted_only_armed_on_the_ground_in_guided() {
    let climb = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 10.0];
    let mut bench = Bench::new(&steady(), 1);
    bench.run(2.5);
    bench.mode(4);
    assert_eq!(bench.command(22, climb), Some(4));
    bench.take_off(10.0);
    let time_s = bench.wait(20.0, "9.5 m", |bench| {
        let z = |payload: Vec<u8>| f32::from_le_bytes(payload[12..16].try_into().unwrap());
        bench.latest(32).is_some_and(|payload| z(payload) <= -9.5)
    });
    // Armed at the same moment, so the 2 s for which the motors are held are added to the 7.4 s.
    near(time_s, 7.4 + 2.0, 0.4);
    bench.wait(5.0, "the end of the climb", |bench| bench.landed_state() == Some(2));
    assert_eq!(bench.command(22, climb), Some(4));
}

#[test]
fn a_takeoff_some_time_after_arming_takes_the_measured_time() {
    let mut bench = Bench::new(&steady(), 1);
    bench.run(2.5);
    bench.request(245, 20.0);
    bench.mode(4);
    bench.command(400, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    bench.run(2.0);
    let start_s = bench.now_s();
    assert_eq!(bench.command(22, [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 10.0]), Some(0));
    near(bench.wait(3.0, "lift", |bench| bench.landed_state() == Some(3)), 1.38, 0.1);
    bench.wait(20.0, "9.5 m", |bench| bench.world.truth().height_m >= 9.19);
    near(bench.now_s() - start_s, 7.36, 0.4);
    bench.wait(5.0, "the end of the climb", |bench| bench.landed_state() == Some(2));
    near(bench.now_s() - start_s, 8.38, 0.5);
}

#[test]
fn a_velocity_on_the_ground_does_nothing_and_the_motors_stop_after_ten_seconds() {
    let mut bench = Bench::new(&WorldConfig::default(), 1);
    bench.run(2.5);
    bench.mode(4);
    bench.command(400, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    bench.fly(9.9, [0.0, 0.0, -1.0]);
    assert!(bench.world.autopilot().armed() && bench.world.truth().on_ground);
    bench.fly(0.3, [0.0, 0.0, -1.0]);
    assert!(!bench.world.autopilot().armed());
    assert_eq!(bench.world.truth().height_m, 0.0);
}

#[test]
fn a_velocity_during_the_takeoff_aborts_it() {
    let mut bench = Bench::new(&steady(), 1);
    bench.run(2.5);
    bench.take_off(10.0);
    bench.wait(20.0, "0.8 m", |bench| bench.world.truth().height_m > 0.8);
    bench.fly(8.0, [0.0; 3]);
    assert_eq!(bench.landed_state(), Some(2));
    near(bench.world.truth().height_m, 1.9, 0.4);
    let height_m = bench.world.truth().height_m;
    bench.fly(5.0, [0.0; 3]);
    near(bench.world.truth().height_m, height_m, 0.05);
}

#[test]
fn modes_and_states_have_their_numbers_through_a_flight() {
    let mut bench = Bench::new(&steady(), 1);
    bench.run(3.0);
    assert_eq!(bench.heartbeat(), (81, 0, 3));
    bench.take_off(5.0);
    bench.run(1.1);
    assert_eq!(bench.heartbeat(), (217, 4, 3));
    bench.wait(20.0, "the end of the climb", |bench| bench.landed_state() == Some(2));
    bench.run(1.1);
    assert_eq!(bench.heartbeat(), (217, 4, 4));
    bench.mode(9);
    bench.run(0.1);
    assert_eq!((bench.heartbeat(), bench.landed_state()), ((209, 9, 4), Some(4)));
    bench.wait(30.0, "disarm", |bench| !bench.world.autopilot().armed());
    bench.run(1.1);
    assert_eq!(bench.heartbeat(), (81, 9, 3));
    let mut states: Vec<u8> = bench.of(245).map(|(_, frame)| whole(frame)[1]).collect();
    states.dedup();
    assert_eq!(states, [1, 3, 2, 4, 1]);
}

#[test]
fn ground_station_and_companion_are_both_obeyed() {
    let mut bench = Bench::new(&WorldConfig::default(), 1);
    bench.run(2.5);
    for (sender, mode) in [(GROUND, 4), (COMPANION, 5)] {
        let read = MavMessage::SET_MODE(SET_MODE_DATA {
            custom_mode: mode,
            target_system: 1,
            base_mode: MavModeFlag::MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
        });
        bench.send_as(sender, &read);
        assert_eq!(bench.heartbeat().1, mode);
    }
}

#[test]
fn heartbeats_of_a_ground_station_are_forwarded_when_asked() {
    let mut config = WorldConfig::default();
    config.autopilot.forward_ground_station = true;
    let mut bench = Bench::new(&config, 1);
    bench.run(10.0);
    assert_eq!(bench.log.iter().filter(|(_, frame)| frame.sender == GROUND).count(), 11);
    assert_eq!(bench.of(0).count(), 11);
}

#[test]
fn the_link_begins_with_text() {
    let mut bench = Bench::new(&WorldConfig::default(), 1);
    bench.run(0.1);
    assert!(bench.raw.starts_with(b"\r\n") && bench.raw[0] != 0xFD);
    assert_eq!(bench.of(0).count(), 1);
}

#[test]
fn disarming_in_the_air_is_refused_and_nav_land_lands() {
    let mut bench = Bench::flying(&steady(), 1, 3.0);
    assert_eq!(bench.command(400, [0.0; 7]), Some(4));
    assert_eq!(bench.command(21, [0.0; 7]), Some(0));
    assert_eq!(bench.heartbeat().1, 9);
    bench.wait(20.0, "disarm", |bench| !bench.world.autopilot().armed());
}

#[test]
fn the_same_seed_flies_the_same_flight() {
    let run = |seed| {
        let mut bench = Bench::flying(&windy(1.0), seed, 5.0);
        bench.fly(3.0, [0.3, -0.2, 0.1]);
        (bench.world.truth(), bench.raw)
    };
    assert!(run(5) == run(5));
    assert!(run(5).0 != run(6).0);
}

#[test]
fn parameters_are_listed_read_and_set() {
    let mut bench = Bench::new(&WorldConfig::default(), 1);
    bench.run(1.0);
    bench.send(&MavMessage::PARAM_REQUEST_LIST(PARAM_REQUEST_LIST_DATA {
        target_system: 1,
        target_component: 1,
    }));
    let values = |bench: &Bench| -> Vec<(String, f32, u16)> {
        bench
            .of(22)
            .filter_map(|(_, frame)| match &frame.message {
                Some(MavMessage::PARAM_VALUE(p)) => {
                    Some((p.param_id.to_str().unwrap().to_owned(), p.param_value, p.param_index))
                }
                _ => None,
            })
            .collect()
    };
    assert!(values(&bench).contains(&("LAND_SPEED".into(), 50.0, 3)));
    let id: CharArray<16> = "LAND_ALT_LOW".into();
    bench.send(&MavMessage::PARAM_SET(PARAM_SET_DATA {
        param_value: 300.0,
        target_system: 1,
        target_component: 1,
        param_id: id,
        param_type: MavParamType::MAV_PARAM_TYPE_REAL32,
    }));
    assert_eq!(values(&bench).pop().unwrap(), ("LAND_ALT_LOW".into(), 300.0, u16::MAX));
    bench.send(&MavMessage::PARAM_REQUEST_READ(PARAM_REQUEST_READ_DATA {
        param_index: -1,
        target_system: 1,
        target_component: 1,
        param_id: id,
    }));
    assert_eq!(values(&bench).pop().unwrap(), ("LAND_ALT_LOW".into(), 300.0, 2));
}

#[test]
fn a_time_synchronisation_is_answered() {
    let mut bench = Bench::new(&WorldConfig::default(), 1);
    bench.run(1.5);
    bench.send(&MavMessage::TIMESYNC(TIMESYNC_DATA { ts1: 77, ..TIMESYNC_DATA::default() }));
    let reply = bench.of(111).next_back().unwrap().1.message.clone();
    let Some(MavMessage::TIMESYNC(reply)) = reply else { unreachable!("{reply:?}") };
    assert_eq!((reply.tc1, reply.ts1), (1_500_000_000, 77));
}

#[test]
fn the_true_state_can_be_asked_for() {
    let mut bench = Bench::flying(&steady(), 1, 10.0);
    bench.request(108, 50.0);
    bench.fly(4.0, [1.0, -0.5, 0.0]);
    bench.step();
    let payload = bench.latest(108).unwrap();
    let integer = |at: usize| i32::from_le_bytes(payload[at..at + 4].try_into().unwrap());
    let truth = bench.world.truth();
    near(f64::from(integer(84) + 353_632_620) * 0.011_131_884_5, truth.position.x(), 0.05);
    near(
        f64::from(integer(88) - 1_491_652_370) * 0.011_131_884_5 * 0.8155,
        truth.position.y(),
        0.05,
    );
}

// Velocity setpoints.

#[test]
fn without_an_order_for_the_nose_it_turns_into_the_direction_of_travel() {
    let mut bench = Bench::flying(&steady(), 1, 10.0);
    let fly = |bench: &mut Bench, frame, seconds: f64, velocity| {
        for _ in 0..(seconds * 10.0) as usize {
            bench.velocity(frame, FREE_HEADING, velocity, [0.0; 2]);
            bench.run(0.1);
        }
    };
    fly(&mut bench, LOCAL, 4.0, [0.0, 0.5, 0.0]);
    near(yaw_deg(&bench), 0.0, 2.0);
    fly(&mut bench, LOCAL, 4.0, [0.0, 1.0, 0.0]);
    near(yaw_deg(&bench), 90.0, 3.0);
    near(bench.world.truth().velocity.y(), 1.0, 0.03);
    // To the right of a nose that follows: circles.
    fly(&mut bench, MavFrame::MAV_FRAME_BODY_NED, 6.0, [0.0, 1.0, 0.0]);
    near(bench.world.truth().angular_rate.z().to_degrees(), 60.0, 6.0);
}

#[test]
fn a_yaw_rate_of_nought_holds_the_heading_and_another_turns() {
    let mut bench = Bench::flying(&steady(), 1, 10.0);
    bench.fly(4.0, [0.0, -1.0, 0.0]);
    near(yaw_deg(&bench), 0.0, 0.5);
    let from = yaw_deg(&bench);
    for _ in 0..50 {
        bench.velocity(LOCAL, HOLD_HEADING, [0.0; 3], [0.0, 0.2]);
        bench.run(0.1);
    }
    near((yaw_deg(&bench) - from) / 5.0, 11.4, 0.6);
}

#[test]
fn a_yaw_is_turned_to_with_the_measured_overshoot() {
    let mut bench = Bench::flying(&steady(), 1, 10.0);
    let mut max_deg = 0.0f64;
    let mut crossed = None;
    let start_s = bench.now_s();
    for step in 0..3200 {
        if step % 40 == 0 {
            bench.velocity(LOCAL, WITH_YAW, [0.0; 3], [58.0f32.to_radians(), 0.0]);
        }
        bench.step();
        max_deg = max_deg.max(yaw_deg(&bench));
        if crossed.is_none() && yaw_deg(&bench) >= 58.0 {
            crossed = Some(bench.now_s() - start_s);
        }
    }
    assert!(crossed.unwrap() < 1.5, "{crossed:?}");
    near(max_deg - 58.0, 8.0, 2.0);
    near(yaw_deg(&bench), 58.0, 0.5);
}

#[test]
fn body_frames_turn_with_the_yaw_only_and_down_stays_down() {
    let mut config = steady();
    config.vehicle.start_heading_rad = 1.0;
    for frame in [MavFrame::MAV_FRAME_BODY_NED, MavFrame::MAV_FRAME_BODY_OFFSET_NED] {
        let mut bench = Bench::flying(&config, 1, 10.0);
        for _ in 0..40 {
            bench.velocity(frame, HOLD_HEADING, [0.5, 0.2, 0.1], [0.0; 2]);
            bench.run(0.1);
        }
        let v = bench.world.truth().velocity;
        near(v.x(), 0.5 * 1f64.cos() - 0.2 * 1f64.sin(), 0.02);
        near(v.y(), 0.5 * 1f64.sin() + 0.2 * 1f64.cos(), 0.02);
        near(v.z(), 0.1, 0.01);
    }
}

#[test]
fn setpoints_that_cannot_be_flown_stop_the_vehicle() {
    let nan = f32::NAN;
    let cases = [
        (MavFrame::MAV_FRAME_BODY_FRD, HOLD_HEADING, [0.5, 0.0, 0.0], 0.0),
        (LOCAL, HOLD_HEADING | 0x20, [0.5, 0.0, 0.0], 0.0),
        (LOCAL, HOLD_HEADING, [0.5, nan, 0.0], 0.0),
        (LOCAL, HOLD_HEADING, [0.5, 0.0, 0.0], nan),
    ];
    for (frame, mask, velocity, yaw_rate) in cases {
        let mut bench = Bench::flying(&steady(), 1, 10.0);
        bench.fly(3.0, [0.5, 0.0, 0.0]);
        assert!(bench.world.truth().velocity.x() > 0.45);
        let sent = bench.log.len();
        for _ in 0..20 {
            bench.velocity(frame, mask, velocity, [0.0, yaw_rate]);
            bench.run(0.1);
        }
        near(bench.world.truth().velocity.norm(), 0.0, 0.05);
        assert!(bench.log[sent..].iter().all(|(_, frame)| frame.message_id != 77));
    }
}

#[test]
fn absurd_numbers_leave_the_vehicle_finite() {
    let mut bench = Bench::flying(&WorldConfig::default(), 1, 10.0);
    let max = f32::MAX;
    for number in [max, -max, f32::INFINITY, f32::NAN] {
        bench.velocity(LOCAL, HOLD_HEADING, [number; 3], [number; 2]);
        bench.run(0.5);
        bench.velocity(LOCAL, WITH_YAW, [0.0, 0.0, -number], [number; 2]);
        bench.run(0.5);
        for command in [22, 176, 178, 400, 511, 512] {
            bench.command(command, [number; 7]);
            bench.run(0.1);
        }
    }
    let truth = bench.world.truth();
    assert!(truth.position.is_finite() && truth.velocity.is_finite(), "{truth:?}");
    assert!(truth.ned_from_body.wxyz().iter().all(|part| part.is_finite()));
    assert!(bench.world.autopilot().armed());
}

#[test]
fn when_setpoints_stop_coming_the_vehicle_flies_on_for_three_seconds_and_brakes() {
    let mut bench = Bench::flying(&steady(), 1, 10.0);
    bench.fly(4.0, [0.5, 0.0, 0.0]);
    let (start_s, from) = (bench.now_s(), bench.world.truth().position);
    bench.wait(5.0, "braking", |bench| bench.world.truth().velocity.x() < 0.48);
    near(bench.now_s() - start_s, 3.1, 0.1);
    bench.run(5.0);
    near((bench.world.truth().position - from).norm(), 1.8, 0.1);
    near(bench.world.truth().velocity.norm(), 0.0, 0.02);
}

#[test]
fn the_rate_of_setpoints_changes_nothing() {
    let distance = |period_s: f64| {
        let mut bench = Bench::flying(&steady(), 1, 10.0);
        let from = bench.world.truth().position;
        for _ in 0..(5.0 / period_s).round() as usize {
            bench.velocity(LOCAL, HOLD_HEADING, [0.5, 0.0, 0.0], [0.0; 2]);
            bench.run(period_s);
        }
        (bench.world.truth().position - from).norm()
    };
    near(distance(0.5), distance(0.1), 0.01);
    near(distance(0.05), distance(0.1), 0.01);
}

#[test]
fn velocity_is_ignored_in_land_and_guided_stops_the_landing() {
    let mut bench = Bench::flying(&steady(), 1, 10.0);
    bench.mode(9);
    bench.wait(20.0, "6.6 m", |bench| bench.world.truth().height_m <= 6.6);
    bench.fly(1.0, [1.0, 0.0, -1.0]);
    assert!(bench.world.truth().velocity.horizontal_norm() < 0.02);
    let height_m = bench.world.truth().height_m;
    bench.mode(4);
    bench.fly(4.0, [0.0; 3]);
    near(height_m - bench.world.truth().height_m, 0.2, 0.1);
    bench.fly(4.0, [0.0, 0.0, -0.5]);
    assert!(bench.world.truth().height_m > height_m + 1.0);
}

#[test]
fn a_pilots_mode_takes_the_vehicle_out_of_the_setpoints_at_once() {
    for mode in [0, 2, 5, 16, 17] {
        let mut bench = Bench::flying(&steady(), 1, 10.0);
        bench.fly(3.0, [0.5, 0.0, 0.3]);
        assert_eq!(bench.mode(mode), 0);
        bench.fly(4.0, [0.5, 0.0, 0.3]);
        near(bench.world.truth().velocity.norm(), 0.0, 0.03);
        assert!(bench.world.autopilot().armed());
    }
}

// LAND mode.

/// Impact time and speed, and time to disarm, from the order to land at about this height.
fn land(bench: &mut Bench) -> [f64; 3] {
    let start_s = bench.now_s();
    assert_eq!(bench.mode(9), 0);
    bench.wait(60.0, "touch", |bench| bench.world.truth().on_ground);
    let impact_s = bench.now_s() - start_s;
    bench.wait(20.0, "disarm", |bench| !bench.world.autopilot().armed());
    [impact_s, bench.world.truth().impact_m_s.unwrap(), bench.now_s() - start_s]
}

#[test]
fn landings_take_the_measured_times() {
    const DEFAULTS: &[(&str, f32)] = &[];
    let cases = [
        (DEFAULTS, 10.0, [20.2, 0.48, 22.2]),
        (DEFAULTS, 20.0, [28.0, 0.48, 30.4]),
        (&[("LAND_ALT_LOW", 300.0)], 10.0, [12.0, 0.48, 14.4]),
        (&[("LAND_SPEED", 100.0)], 10.0, [10.5, 0.96, 12.4]),
    ];
    for (parameters, height_m, [impact_s, speed, disarm_s]) in cases {
        let mut bench = Bench::flying(&with_parameters(parameters), 1, height_m);
        let landing = land(&mut bench);
        println!(
            "{parameters:?} from {height_m} m: {landing:.2?}, measured {impact_s} {speed} {disarm_s}"
        );
        near(landing[0], impact_s, 0.8);
        near(landing[1], speed, 0.02);
        near(landing[2], disarm_s, 0.8);
        near(landing[2] - landing[0], 2.05, 0.2);
    }
}

#[test]
fn the_fast_part_of_a_landing_is_as_fast_as_measured() {
    let mut bench = Bench::flying(&steady(), 1, 20.0);
    bench.mode(9);
    bench.wait(20.0, "14 m", |bench| bench.world.truth().height_m < 14.0);
    near(bench.world.truth().velocity.z(), 1.44, 0.06);
    bench.wait(20.0, "8 m", |bench| bench.world.truth().height_m < 8.5);
    near(bench.world.truth().velocity.z(), 0.48, 0.04);
}

#[test]
fn the_touchdown_is_detected_after_the_measured_delays() {
    for seed in 0..5 {
        let mut bench = Bench::flying(&WorldConfig::default(), seed, 2.0);
        bench.request(245, 50.0);
        bench.mode(9);
        bench.wait(20.0, "touch", |bench| bench.world.truth().on_ground);
        let sure_s = bench.wait(5.0, "landed", |bench| bench.landed_state() == Some(1));
        assert!((1.58..=1.75).contains(&sure_s), "{sure_s}");
        let still_s = bench.wait(5.0, "disarm", |bench| !bench.world.autopilot().armed());
        assert!((0.28..=0.52).contains(&still_s), "{still_s}");
        let reported_s = bench.wait(1.1, "heartbeat", |bench| bench.heartbeat().0 == 81);
        assert!(reported_s <= 1.0 + STEP_S, "{reported_s}");
    }
}

#[test]
fn low_landings_take_the_measured_times() {
    for (height_m, measured_s) in [(3.0, 6.3), (2.0, 4.3), (1.0, 2.3), (0.5, 1.4)] {
        let mut bench = Bench::flying(&steady(), 1, 5.0);
        let down_s = (5.0 - height_m) / 0.5;
        bench.fly(down_s - 0.3, [0.0, 0.0, 0.5]);
        bench.fly(4.0, [0.0; 3]);
        let from_m = bench.world.truth().height_m * 1.042;
        let [impact_s, ..] = land(&mut bench);
        println!("from {from_m:.2} m: {impact_s:.2} s, measured from {height_m} m: {measured_s}");
        // The measurement names the height as the autopilot estimated it.
        near(impact_s - (from_m - height_m) / 0.5, measured_s, 0.2);
    }
}

#[test]
fn a_landing_that_begins_sideways_coasts() {
    let mut bench = Bench::flying(&steady(), 1, 3.0);
    bench.fly(4.0, [0.5, 0.0, 0.0]);
    let from = bench.world.truth().position;
    land(&mut bench);
    let to = bench.world.truth().position;
    near(to.x() - from.x(), 0.39, 0.12);
}

#[test]
fn landings_drift_as_little_as_measured() {
    let worst = |config: &WorldConfig| {
        let drift = |seed| {
            let mut bench = Bench::flying(config, seed, 3.0);
            let from = bench.world.truth().position;
            land(&mut bench);
            (bench.world.truth().position - from).horizontal_norm()
        };
        let mut drifts: Vec<f64> = (0..12).map(drift).collect();
        drifts.sort_by(f64::total_cmp);
        println!("{drifts:.3?}");
        (drifts[6], drifts[11])
    };
    let calm = worst(&WorldConfig::default());
    let windy_1 = worst(&windy(1.0));
    let windy_3 = worst(&windy(3.0));
    assert!(calm.1 < 0.05, "{calm:?}");
    assert!((0.01..0.09).contains(&windy_1.0) && windy_1.1 < 0.15, "{windy_1:?}");
    assert!((0.01..0.20).contains(&windy_3.0), "{windy_3:?}");
}

#[test]
fn landing_in_guided_disarms_late() {
    let mut bench = Bench::flying(&steady(), 1, 2.0);
    bench.request(245, 50.0);
    while !bench.world.truth().on_ground {
        bench.fly(0.1, [0.0, 0.0, 0.3]);
    }
    let touch_s = bench.now_s();
    let mut landed_s = None;
    while bench.world.autopilot().armed() {
        bench.fly(0.1, [0.0, 0.0, 0.3]);
        if landed_s.is_none() && bench.landed_state() == Some(1) {
            landed_s = Some(bench.now_s() - touch_s);
        }
    }
    near(landed_s.unwrap(), 2.0, 0.2);
    near(bench.now_s() - touch_s, 12.5, 0.3);
}
