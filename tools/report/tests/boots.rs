//! A recording that continues while the vehicle's computer is started again, with which its clock restarts.

#![allow(clippy::unwrap_used, reason = "helpers of tests may fail like tests")]

use experiments::landing::flight::fly_recorded;
use experiments::landing::plan::{Plan, Values, Vision};
use flightlog::{About, Entry, Received, Writer};
use messages::{ControllerStatus, GcsStatus, encode};
use replay::Restamp;
use report::{Flight, FlightReader, replay_tapes, summary};

const S: i64 = 1_000_000_000;

fn landing() -> Vec<u8> {
    let one = |value| Values::List(vec![value]);
    let (height, offset) = (one(3.0), one(0.5));
    let plan = Plan { vision: Vision::Modelled, flights: 1, height, offset, ..Plan::default() };
    let mut recording = Vec::new();
    fly_recorded(&plan.flights()[0], &mut recording).unwrap();
    recording
}

fn read(recording: &[u8]) -> Flight {
    let mut reader = FlightReader::new("flight.mcap");
    reader.add(recording).unwrap();
    let mut flight = reader.finish();
    replay_tapes(&mut flight);
    flight
}

/// A landing as the ground recorded it, and once more 1000 s later with stamps that are 1 s earlier; the tape of the first alone.
fn twice(recording: &[u8]) -> Vec<u8> {
    let facts = [("clock".to_owned(), "ground".to_owned())].into();
    let about = About { program: "test".to_owned(), facts, utc_offset_ns: 0 };
    let mut copy = Vec::new();
    let mut writer = Writer::new(&mut copy, &about).unwrap();
    for (earlier_ns, later_ns) in [(0, 0), (S, 1_000 * S)] {
        let mut restamp = Restamp::new(earlier_ns, 0, "monotonic/0");
        flightlog::read(recording, |entry| {
            if let Entry::Message(message) = entry
                && (later_ns == 0 || message.key != "controller/tape")
            {
                let payload = restamp.payload(message);
                let received_ns = message.received_ns + 7_000 * S + later_ns;
                writer.receive(Received { payload: &payload, received_ns, ..message }).unwrap();
            }
        })
        .unwrap();
    }
    writer.finish().unwrap();
    copy
}

#[test]
fn the_status_of_a_bridge_before_a_start_of_the_vehicles_computer_is_not_reported_after_it() {
    let about = About { program: "test".to_owned(), facts: [].into(), utc_offset_ns: 0 };
    let mut recording = Vec::new();
    let mut writer = Writer::new(&mut recording, &about).unwrap();
    let bridge = encode(&GcsStatus { bridge: "main".into(), ..GcsStatus::default() });
    let status = |stamp_ns| {
        encode(&ControllerStatus { stamp_ns, started_ns: Some(0), ..ControllerStatus::default() })
    };
    for (received_ns, key, payload) in [
        (0, "controller/status", status(1_000 * S)),
        (S, "gcs/status", bridge),
        (1_000 * S, "controller/status", status(S)),
    ] {
        let received = Received { key, payload: &payload, attachment: &[], received_ns };
        writer.receive(received).unwrap();
    }
    writer.finish().unwrap();
    let flight = read(&recording);
    assert_eq!((flight.boot.number, flight.boot.of), (2, 2));
    assert!(flight.bridges.is_empty());
    assert_eq!(flight.last_received_ns, 1_000 * S);
    let mut before = flight.clone();
    before.keep_landing(Some(1)).unwrap();
    assert_eq!((before.bridges.len(), before.last_received_ns), (1, S));
}

#[test]
fn landings_before_and_after_a_start_of_the_vehicles_computer_are_distinguished() {
    let recording = landing();
    let alone = summary(&read(&recording));
    let both = read(&twice(&recording));
    for (number, name, tapes) in [
        (Some(1), "landing 1 of 2", 1),
        (Some(2), "landing 2 of 2", 0),
        (None, "landing 2 of 2", 0),
    ] {
        let mut kept = both.clone();
        kept.keep_landing(number).unwrap();
        let found = summary(&kept);
        assert!(found.name.ends_with(name), "{}", found.name);
        assert_eq!(found.outcome(), alone.outcome());
        assert_eq!(kept.tapes.len(), tapes);
        let lasted_s = found.time_to_disarm_s.unwrap();
        assert!((lasted_s - alone.time_to_disarm_s.unwrap()).abs() < 1e-9, "{lasted_s}");
        assert!(found.frames.abs_diff(alone.frames) <= 2, "{} frames", found.frames);
        assert_eq!(found.touchdown_error_m, alone.touchdown_error_m);
        let shift_s = (kept.shift_ns - 7_000 * S) / S;
        assert_eq!(shift_s, if tapes == 1 { 0 } else { 1_001 });
        let is_reported =
            found.problems.iter().any(|it| it.contains("the vehicle's clock restarted"));
        assert!(is_reported, "{:?}", found.problems);
    }
    assert_eq!(both.clone().keep_landing(Some(3)), Err(2));
}
