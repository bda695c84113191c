//! Landings over a link to the autopilot that delays, repeats and falsifies packets, in lock-step with the
//! modelled world: a fault of the link ends on the pad or in a hover, never in a hard touchdown.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "helpers of tests may fail like tests, and a measurement shows its result"
)]

mod modelled;
mod packets;

use std::cell::Cell;
use std::collections::VecDeque;
use std::sync::Arc;

use autopilot::Parser;
use autopilot::dialect::{LOCAL_POSITION_NED_DATA, MavLandedState, MavMessage};
use controller::Config;
use controller::flight::Flight;
use geometry::CameraModel;
use messages::{CameraInfo, Phase};
use modelled::{
    FOCAL_PX, FRAME_LATENCY_S, FRAME_STEPS, IMAGE, START_NS, TICK_STEPS, body_from_camera,
    detections, stamp_ns,
};
use node::Layers;
use packets::{bytes, contact};
use world::world::STEP_S;
use world::{World, WorldConfig};

const LIMIT_S: f64 = 120.0;

/// A packet of the autopilot, on its way.
struct Passing {
    now_s: f64,
    /// Height over the ground in a descent; infinite before it.
    height_m: f64,
    message_id: u32,
    bytes: Vec<u8>,
}

/// Where packets go: the time of arrival and the bytes of each.
type Way<'a> = dyn FnMut(&Passing) -> Vec<(f64, Vec<u8>)> + 'a;

#[derive(Debug)]
struct Ended {
    phase: Phase,
    why: String,
    /// Speed down and sideways and the distance from the pad at the first touch.
    touch: Option<[f64; 3]>,
    seconds: f64,
}

impl Ended {
    fn is_safe(&self) -> bool {
        self.touch.is_none_or(|[down, sideways, _]| down <= 0.8 && sideways <= 0.3)
    }

    fn is_on_the_pad(&self) -> bool {
        self.phase == Phase::Landed && self.touch.is_some_and(|[.., error_m]| error_m < 0.15)
    }
}

/// A flight from the takeoff on, with the autopilot's packets and ours taking their ways.
fn fly(from_autopilot: &mut Way<'_>, to_autopilot_s: &mut dyn FnMut(f64, f64) -> f64) -> Ended {
    let settings = Layers { file: None, set: vec!["start=takeoff".to_owned()] };
    let mut flight =
        Flight::new(settings.load::<Config>().unwrap().settings, Arc::default()).unwrap();
    let mut world = World::new(&WorldConfig::default(), 1);
    let model = CameraModel::pinhole(IMAGE.0, IMAGE.1, FOCAL_PX);
    let camera = CameraInfo::sample().camera;
    flight.presence(START_NS, "main", true);
    flight.camera(0, CameraInfo::new(&camera, &model, &body_from_camera()));
    let (mut to_us, mut to_it) = (VecDeque::new(), VecDeque::new());
    let mut frames = VecDeque::new();
    let mut parsers = [Parser::new(), Parser::new()];
    let (mut touch, mut landing_s, mut over_s) = (None, None, None);
    let mut steps = 0u64;
    loop {
        steps += 1;
        let before = world.truth();
        world.advance_to(steps as f64 * STEP_S);
        let now_s = world.now_s();
        let truth = world.truth();
        if truth.on_ground && !before.on_ground && touch.is_none() && landing_s.is_some() {
            let away = truth.position - world.pad_at(now_s).position;
            let sideways = before.velocity.horizontal_norm();
            touch = Some([before.velocity.z(), sideways, away.horizontal_norm()]);
        }
        let height_m = landing_s.map_or(f64::INFINITY, |_| -truth.position.z());
        for bytes in world.outgoing().collect::<Vec<_>>() {
            for packet in parsers[0].push(&bytes) {
                let message_id = packet.message_id;
                let passing = Passing { now_s, height_m, message_id, bytes: packet.raw.clone() };
                for arrival in from_autopilot(&passing) {
                    let place = to_us.partition_point(|(at_s, _)| *at_s <= arrival.0);
                    to_us.insert(place, arrival);
                }
            }
        }
        while to_us.front().is_some_and(|(at_s, _)| *at_s <= now_s) {
            for packet in Parser::new().push(&to_us.pop_front().unwrap().1) {
                flight.packet(stamp_ns(now_s), &packet);
            }
        }
        if steps.is_multiple_of(FRAME_STEPS) {
            frames.push_back((now_s + FRAME_LATENCY_S, detections(&world, now_s, steps)));
        }
        while frames.front().is_some_and(|(at_s, _)| *at_s <= now_s) {
            flight.detections(stamp_ns(now_s), "main", &frames.pop_front().unwrap().1);
        }
        if steps.is_multiple_of(TICK_STEPS) {
            flight.tick(stamp_ns(now_s));
            let status = flight.status(stamp_ns(now_s));
            if landing_s.is_none() && status.started_ns.is_some() {
                landing_s = Some(now_s);
                world.begin();
            }
            let ended = matches!(
                status.phase,
                Phase::Landed | Phase::Aborted | Phase::Failed | Phase::PilotInCommand
            );
            // An end in the air is watched until the vehicle has stopped.
            let watched_s = over_s.map_or(0.0, |at_s: f64| now_s - at_s);
            if ended && over_s.is_none() {
                over_s = Some(now_s);
            }
            if watched_s > 5.0 || now_s > LIMIT_S {
                let seconds = over_s.unwrap_or(now_s) - landing_s.unwrap_or(0.0);
                return Ended { phase: status.phase, why: status.why, touch, seconds };
            }
        }
        while let Some(packet) = flight.poll_outgoing() {
            let at_s = to_autopilot_s(now_s, height_m);
            let place = to_it.partition_point(|(due_s, _): &(f64, Vec<u8>)| *due_s <= at_s);
            to_it.insert(place, (at_s, packet));
        }
        while to_it.front().is_some_and(|(at_s, _)| *at_s <= now_s) {
            for packet in parsers[1].push(&to_it.pop_front().unwrap().1) {
                world.handle(&packet);
            }
        }
    }
}

/// Numbers from 0 to 1 that look random, the same in each run.
fn luck() -> impl FnMut() -> f64 {
    let mut state = 0x2545_f491_4f6c_dd1d_u64;
    move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 11) as f64 / (1u64 << 53) as f64
    }
}

fn show(name: &str, ended: &Ended) {
    let touch = ended.touch.map_or_else(
        || "no touch".to_owned(),
        |[down, sideways, error_m]| {
            format!("{down:.2} m/s down, {sideways:.2} m/s sideways, {error_m:.3} m off")
        },
    );
    println!("{name}: {touch}; {:.1} s, {}: {}", ended.seconds, ended.phase.name(), ended.why);
}

/// As it is, with another way for the autopilot's packets.
fn falsified(name: &str, mut way: impl FnMut(&Passing) -> Vec<(f64, Vec<u8>)>) -> Ended {
    let ended = fly(&mut way, &mut |now_s, _| now_s);
    show(name, &ended);
    ended
}

fn unchanged(packet: &Passing) -> Vec<(f64, Vec<u8>)> {
    vec![(packet.now_s, packet.bytes.clone())]
}

const HEARTBEAT: u32 = 0;
const ATTITUDE: u32 = 30;
const LOCAL_POSITION_NED: u32 = 32;
const EXTENDED_SYS_STATE: u32 = 245;

/// True from the first time that something holds until so many seconds later.
fn lasting(seconds: f64) -> impl FnMut(f64, bool) -> bool {
    let mut since_s = None;
    move |now_s, holds| {
        if holds {
            since_s.get_or_insert(now_s);
        }
        since_s.is_some_and(|since_s| now_s - since_s < seconds)
    }
}

#[test]
fn an_untouched_link_lands_on_the_pad() {
    let ended = falsified("untouched", unchanged);
    assert!(ended.is_on_the_pad() && ended.is_safe(), "{ended:?}");
}

#[test]
fn a_landed_state_that_contradicts_the_flight_is_landed_over() {
    for state in [
        MavLandedState::MAV_LANDED_STATE_UNDEFINED,
        MavLandedState::MAV_LANDED_STATE_TAKEOFF,
        MavLandedState::MAV_LANDED_STATE_ON_GROUND,
    ] {
        let mut is_on = lasting(6.0);
        let ended = falsified(&format!("{state:?} for 6 s from 5 m on"), |packet| {
            let is_on = is_on(packet.now_s, packet.height_m < 5.0);
            if packet.message_id == EXTENDED_SYS_STATE && is_on {
                return vec![(packet.now_s, bytes(&contact(state)))];
            }
            unchanged(packet)
        });
        assert!(ended.is_on_the_pad() && ended.is_safe(), "{ended:?}");
    }
}

#[test]
fn one_report_of_the_ground_at_six_metres_is_not_believed() {
    let mut is_said = false;
    let ended = falsified("one report of the ground at 6 m", |packet| {
        let mut arrivals = unchanged(packet);
        if packet.height_m < 6.0 && !std::mem::replace(&mut is_said, true) {
            let ground = contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND);
            arrivals.push((packet.now_s, bytes(&ground)));
        }
        arrivals
    });
    assert!(ended.is_on_the_pad() && ended.is_safe(), "{ended:?}");
}

#[test]
fn a_heartbeat_that_is_missing_alone_costs_time_only() {
    for from_m in [7.0, 5.0, 3.0, 1.5, 0.5] {
        let mut is_on = lasting(5.0);
        let ended = falsified(&format!("no heartbeat for 5 s from {from_m} m on"), |packet| {
            let is_on = is_on(packet.now_s, packet.height_m < from_m);
            if packet.message_id == HEARTBEAT && is_on { Vec::new() } else { unchanged(packet) }
        });
        assert!(ended.is_on_the_pad() && ended.is_safe(), "{ended:?}");
    }
}

#[test]
fn a_position_that_freezes_is_no_position() {
    for from_m in [4.0, 1.9, 0.7] {
        let mut is_on = lasting(5.0);
        let mut frozen: Option<LOCAL_POSITION_NED_DATA> = None;
        let ended = falsified(&format!("frozen for 5 s from {from_m} m on"), |packet| {
            let is_on = is_on(packet.now_s, packet.height_m < from_m);
            if packet.message_id == LOCAL_POSITION_NED
                && is_on
                && let Some(MavMessage::LOCAL_POSITION_NED(position)) =
                    Parser::new().push(&packet.bytes).remove(0).message
            {
                let time_boot_ms = position.time_boot_ms;
                let kept = frozen.get_or_insert(position).clone();
                let message = LOCAL_POSITION_NED_DATA { time_boot_ms, ..kept };
                let message = MavMessage::LOCAL_POSITION_NED(message);
                return vec![(packet.now_s, bytes(&message))];
            }
            unchanged(packet)
        });
        assert!(ended.is_on_the_pad() && ended.is_safe(), "{ended:?}");
    }
}

#[test]
fn a_link_that_becomes_slow_in_the_descent_stops_it() {
    for (delay_s, from_m) in [(0.48, 4.0), (0.48, 2.6), (0.4, 1.5), (0.3, 1.0)] {
        let is_slow = Cell::new(false);
        let late_s = |height_m: f64| {
            is_slow.set(is_slow.get() || height_m < from_m);
            if is_slow.get() { delay_s } else { 0.0 }
        };
        let ended = fly(
            &mut |packet: &Passing| {
                vec![(packet.now_s + late_s(packet.height_m), packet.bytes.clone())]
            },
            &mut |now_s, height_m| now_s + late_s(height_m),
        );
        show(&format!("{:.0} ms each way from {from_m} m on", delay_s * 1e3), &ended);
        assert!(ended.is_safe(), "{ended:?}");
        assert!(matches!(ended.phase, Phase::Landed | Phase::Aborted), "{ended:?}");
    }
}

#[test]
fn one_packet_of_another_time_is_no_restart() {
    for boot_ms in [1u32, 100, 5_000_000] {
        let mut is_said = false;
        let ended = falsified(&format!("one packet of {boot_ms} ms"), |packet| {
            let mut arrivals = unchanged(packet);
            if packet.message_id == ATTITUDE
                && packet.height_m < 6.0
                && !std::mem::replace(&mut is_said, true)
                && let Some(MavMessage::ATTITUDE(mut attitude)) =
                    Parser::new().push(&packet.bytes).remove(0).message
            {
                attitude.time_boot_ms = boot_ms;
                let message = MavMessage::ATTITUDE(attitude);
                arrivals.push((packet.now_s, bytes(&message)));
            }
            arrivals
        });
        assert!(ended.is_on_the_pad() && ended.is_safe(), "{ended:?}");
    }
}

#[test]
fn packets_that_are_replayed_are_no_restart() {
    for later_s in [0.8, 2.0] {
        let ended = falsified(&format!("replayed {later_s} s later"), |packet| {
            let again = (packet.now_s + later_s, packet.bytes.clone());
            let is_measured = ![HEARTBEAT, EXTENDED_SYS_STATE].contains(&packet.message_id);
            let mut arrivals = unchanged(packet);
            arrivals.extend(is_measured.then_some(again));
            arrivals
        });
        assert!(ended.is_on_the_pad() && ended.is_safe(), "{ended:?}");
    }
}

#[test]
fn a_delayed_link_ends_safely_with_its_reason() {
    for delay_s in [0.02, 0.05, 0.1, 0.15, 0.25, 0.5] {
        let late = |packet: &Passing| vec![(packet.now_s + delay_s, packet.bytes.clone())];
        let ended = fly(&mut { late }, &mut |now_s, _| now_s + delay_s);
        show(&format!("{:.0} ms each way", delay_s * 1e3), &ended);
        assert!(ended.is_safe(), "{ended:?}");
        assert_eq!(ended.is_on_the_pad(), delay_s <= 0.25, "{ended:?}");
    }
}

#[test]
fn a_link_with_jitter_ends_safely_with_its_reason() {
    for jitter_s in [0.05, 0.1, 0.3, 1.5] {
        let (mut there, mut back) = (luck(), luck());
        let ended = fly(
            &mut |packet: &Passing| {
                let is_on = jitter_s < 1.0 || packet.height_m < 6.0;
                let late_s = if is_on { jitter_s * there() } else { 0.0 };
                vec![(packet.now_s + late_s, packet.bytes.clone())]
            },
            &mut |now_s, height_m| {
                let is_on = jitter_s < 1.0 || height_m < 6.0;
                now_s + if is_on { jitter_s * back() } else { 0.0 }
            },
        );
        show(&format!("{:.0} ms of jitter", jitter_s * 1e3), &ended);
        assert!(ended.is_safe(), "{ended:?}");
        assert!(ended.is_on_the_pad() || jitter_s > 0.2, "{ended:?}");
    }
}
