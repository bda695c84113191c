//! Tests parser and client with logs of real and simulated flights: every packet is found, and the client reports changes when
//! they happen.
//!
//! The recordings are not part of the repository; a short log of our own is.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::print_stdout,
    reason = "helpers of tests may fail and print like tests"
)]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use autopilot::packet::Counters;
use autopilot::{Autopilot, Config, Event, FlightMode, LandedState, Packet, Parser};
use serde_json::Value;

/// All logs under a folder.
fn logs(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(logs(&path));
        } else if path.extension().is_some_and(|extension| extension == "tlog") {
            found.push(path);
        }
    }
    found.sort();
    found
}

/// A log is, for each packet, the time in microseconds (8 bytes, big endian) and the packet; the parser gets
/// it as it is, with the times as noise between the packets.
fn parse(log: &[u8]) -> (Vec<Packet>, Counters) {
    let mut parser = Parser::new();
    let mut packets: Vec<Packet> = log.chunks(1000).flat_map(|piece| parser.push(piece)).collect();
    packets.extend(parser.finish());
    (packets, parser.counters())
}

/// The packets with their times in ns, of a log without bad bytes.
fn timed(log: &[u8]) -> Vec<(i64, Packet)> {
    let mut at = 0;
    let stamp = |packet: Packet| {
        let time = i64::from_be_bytes(log[at..at + 8].try_into().unwrap()) * 1000;
        at += 8 + packet.raw.len();
        (time, packet)
    };
    parse(log).0.into_iter().map(stamp).collect()
}

#[test]
fn every_packet_of_the_simulated_flights_is_found() {
    let Some(folder) = testing::recording("ardupilot") else { return };
    for path in logs(&folder) {
        let log = std::fs::read(&path).unwrap();
        let (packets, counters) = parse(&log);
        println!("{}: {counters:?}", path.display());
        assert_eq!(counters.bad_bytes, 8 * packets.len() as u64, "only the times are no packets");
        assert_eq!((counters.undecodable, counters.unknown_ids), (0, 0));
        assert!(packets.len() > 10_000);
    }
}

#[test]
fn the_real_logs_give_the_packets_that_pymavlink_finds() {
    let Some(folder) = testing::recording("autopilot-logs") else { return };
    let summary = std::fs::read(folder.join("logs_summary.json")).unwrap();
    let summary: Value = serde_json::from_slice(&summary).unwrap();
    for path in logs(&folder) {
        let (packets, counters) = parse(&std::fs::read(&path).unwrap());
        let mut names = BTreeMap::<&str, u64>::new();
        for packet in &packets {
            *names.entry(packet.name().unwrap_or("unknown")).or_default() += 1;
        }
        let file = path.strip_prefix(&folder).unwrap().to_str().unwrap();
        let entries = summary.as_array().unwrap();
        let Some(entry) = entries.iter().find(|e| e["file"].as_str().unwrap().ends_with(file))
        else {
            continue;
        };
        let good = entry["messages"].as_u64().unwrap() - entry["bad_data"].as_u64().unwrap();
        println!("{file}: {} packets, {counters:?}", packets.len());
        assert_eq!(packets.len() as u64, good, "{file}");
        for (name, count) in entry["message_counts"].as_object().unwrap() {
            assert_eq!(names.get(name.as_str()), count.as_u64().as_ref(), "{name} in {file}");
        }
    }
}

/// The changes that the client must report, in seconds since the first heartbeat.
#[derive(Debug, PartialEq)]
enum Change {
    Mode(FlightMode),
    Armed(bool),
    Landed(LandedState),
}

fn changes_of_client(log: &[u8]) -> (Vec<(f64, Change)>, Autopilot) {
    let mut client = Autopilot::new(Config::default());
    let mut changes = Vec::new();
    let mut first_ns = None;
    for (now_ns, packet) in timed(log) {
        client.handle(now_ns, &packet);
        client.tick(now_ns);
        while client.poll_outgoing().is_some() {}
        while let Some(event) = client.poll_event() {
            let change = match event {
                Event::Found { system: 1, .. } => {
                    first_ns = Some(now_ns);
                    continue;
                }
                Event::ModeChanged { from: Some(_), to } => Change::Mode(to),
                Event::ArmedChanged(armed) => Change::Armed(armed),
                Event::LandedChanged { to, .. } => Change::Landed(to),
                // The simulator pauses for 3 s while it starts.
                Event::Lost { .. } if !client.state().unwrap().armed => continue,
                Event::Lost { .. } | Event::Restarted { .. } | Event::OtherVehicle { .. } => {
                    panic!("{event:?} in a log without losses")
                }
                _ => continue,
            };
            let first_ns = first_ns.expect("the vehicle is found before its first change");
            changes.push(((now_ns - first_ns) as f64 * 1e-9, change));
        }
    }
    (changes, client)
}

fn changes_of_events(events: &[Value]) -> Vec<(f64, Change)> {
    let text = |event: &Value| event["name"].as_str().unwrap().to_owned();
    let first =
        events.iter().find(|event| text(event) == "HEARTBEAT").unwrap()["wall"].as_f64().unwrap();
    let mut changes = Vec::new();
    let (mut mode, mut armed) = (0, false);
    for event in events {
        let at = event["wall"].as_f64().unwrap() - first;
        match text(event).as_str() {
            "HEARTBEAT" => {
                let now = event["custom_mode"].as_u64().unwrap() as u32;
                if std::mem::replace(&mut mode, now) != now {
                    changes
                        .push((at, Change::Mode(FlightMode::of(autopilot::Firmware::Copter, now))));
                }
                let now = event["base_mode"].as_u64().unwrap() & 128 != 0;
                if std::mem::replace(&mut armed, now) != now {
                    changes.push((at, Change::Armed(now)));
                }
            }
            "LANDED_STATE" => {
                let state = match event["v"].as_u64().unwrap() {
                    1 => LandedState::OnGround,
                    2 => LandedState::InAir,
                    3 => LandedState::TakingOff,
                    4 => LandedState::Landing,
                    other => panic!("landed state {other}"),
                };
                changes.push((at, Change::Landed(state)));
            }
            _ => {}
        }
    }
    changes
}

/// Compares the changes that the client reports with the events of a log; returns their number.
fn compare_with_events(log: &Path, events: &[u8]) -> usize {
    let events: Vec<Value> = serde_json::from_slice(events).unwrap();
    let (changes, client) = changes_of_client(&std::fs::read(log).unwrap());
    let expected = changes_of_events(&events);
    assert_eq!(changes.len(), expected.len(), "{changes:?}\n{expected:?}");
    for ((at, change), (expected_at, expected)) in changes.iter().zip(&expected) {
        assert_eq!(change, expected, "at {at} s");
        // The ground is believed after three reports.
        let later_s = if *change == Change::Landed(LandedState::OnGround) { 0.65 } else { 0.1 };
        let is_in_time = (-0.1..later_s).contains(&(at - expected_at));
        assert!(is_in_time, "{change:?} at {at} s, expected at {expected_at} s");
    }
    assert!(expected.iter().any(|(_, change)| *change == Change::Mode(FlightMode::Land)));
    assert_eq!(client.refused_numbers(), 0);
    assert!(client.state().unwrap().position.is_some());
    expected.len()
}

/// The flight that `flight.py` wrote with pymavlink.
#[test]
fn a_flight_written_by_pymavlink_is_followed() {
    let log = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/flight.tlog");
    let (packets, counters) = parse(&std::fs::read(&log).unwrap());
    assert_eq!(packets.len(), 352);
    assert_eq!(counters.bad_bytes, 8 * packets.len() as u64, "only the times are no packets");
    assert_eq!((counters.undecodable, counters.unknown_ids), (0, 0));
    let events = std::fs::read(log.with_extension("events.json")).unwrap();
    assert_eq!(compare_with_events(&log, &events), 9);
}

#[test]
fn the_client_reports_changes_when_they_happen() {
    let Some(folder) = testing::recording("ardupilot") else { return };
    let mut compared = 0;
    for path in logs(&folder) {
        let Ok(events) = std::fs::read(path.with_extension("tlog.events.json")) else { continue };
        compared += compare_with_events(&path, &events);
    }
    println!("{compared} changes reported at the right time");
    assert!(compared > 10);
}

#[test]
fn a_precision_landing_is_followed_to_the_ground() {
    let Some(folder) = testing::recording("ardupilot") else { return };
    for path in logs(&folder) {
        let (changes, client) = changes_of_client(&std::fs::read(&path).unwrap());
        let state = client.state().unwrap();
        assert!(!state.armed && state.landed == LandedState::OnGround, "{}", path.display());
        assert!(changes.iter().any(|(_, change)| *change == Change::Landed(LandedState::InAir)));
        println!("{}: {} changes, {state:?}", path.display(), changes.len());
    }
}
