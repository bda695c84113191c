//! Flights with faults, replayed to the bit; changes of a tape or of the configuration are found.

#![allow(clippy::unwrap_used, reason = "helpers of tests may fail like tests")]

use std::collections::BTreeSet;
use std::sync::Arc;

use autopilot::Parser;
use autopilot::dialect::{HEARTBEAT_DATA, MavMessage, MavType};
use autopilot::packet::{Sender, encode};
use controller::limits::Note;
use controller::tape::TapedFlight;
use experiments::faults::flight::fly_with_tape;
use experiments::faults::plan::{Plan, Planned};
use experiments::landing::in_parallel;
use flightlog::{RecordedTape, TapeReader};
use messages::{ControllerCommand, DetectorInfo, Place, Tape, TapeEvent};
use replay::{Stop, Verdict, change, verify};

fn tapes_of(planned: &Planned) -> anyhow::Result<Vec<RecordedTape>> {
    let mut reader = TapeReader::default();
    for part in fly_with_tape(planned)?.1 {
        reader.push(part);
    }
    Ok(reader.tapes())
}

/// The tape of the first life of a controller.
fn one(seed: u64) -> RecordedTape {
    let plan = Plan { flights: 1, seed, ..Plan::default() };
    let mut tapes = tapes_of(&plan.flights()[0]).unwrap();
    tapes.swap_remove(0)
}

fn verified(tape: &RecordedTape) -> Verdict {
    verify(tape, &[]).unwrap()
}

#[test]
fn flights_with_faults_give_the_same_results_to_the_bit() {
    let flights = Plan { flights: 20, seed: 4000, ..Plan::default() }.flights();
    let tapes = in_parallel(&flights, 2, tapes_of).unwrap();
    let (mut events, mut flight_s) = (0, 0.0);
    for (tape, planned) in
        tapes.iter().zip(&flights).flat_map(|(t, p)| t.iter().map(move |t| (t, p)))
    {
        let verdict = verified(tape);
        assert!(verdict.is_verified(), "{}: {:?}", planned.command(), verdict.end.stop);
        events += verdict.end.events;
        flight_s += verdict.end.flight_s;
    }
    println!("{events} events, {flight_s:.0} s of flight");
    assert!(events > 50_000 && flight_s > 300.0, "{events} events, {flight_s} s");
}

/// The heartbeat of a ground station.
fn ground_packet() -> autopilot::Packet {
    let ground = Sender { system: 255, component: 190 };
    let heartbeat = HEARTBEAT_DATA { mavtype: MavType::MAV_TYPE_GCS, ..Default::default() };
    let raw = encode(ground, 1, &MavMessage::HEARTBEAT(heartbeat));
    Parser::new().push(&raw).remove(0)
}

/// The events of a tape, flown again with a note to put back, a ground station, an operator's commands and an end.
fn with_everything(tape: &RecordedTape) -> RecordedTape {
    let mut events = tape.parts.iter().flat_map(Tape::records).map(Result::unwrap);
    let begin = events.next().unwrap();
    let TapeEvent::Begin { configuration, .. } = &begin.event else { unreachable!("{begin:?}") };
    let config: controller::Config =
        node::from_toml("the tape", configuration, &[]).unwrap().settings;
    let note = Note {
        address: config.autopilot.address.clone(),
        system: 1,
        parameter: "GUID_TIMEOUT".to_owned(),
        original_s: 2.5,
        set_s: 0.5,
    };
    let mut flight = TapedFlight::new(begin.now_ns, config, Arc::default()).unwrap();
    flight.take_over(begin.now_ns, note);
    let mut reader = TapeReader::default();
    let mut detector = String::new();
    let mut last_ns = begin.now_ns;
    for (number, event) in events.enumerate() {
        let now_ns = event.now_ns;
        assert!(flight.replay(now_ns, &event.event));
        if let TapeEvent::Presence { detector: name, .. } = &event.event {
            detector = name.to_string();
        }
        let command = match number {
            600 => Some(ControllerCommand::Hold),
            700 => Some(ControllerCommand::Resume),
            800 => Some(ControllerCommand::UseDetector(detector.clone())),
            810 => Some(ControllerCommand::PreferDetectors(Place::Ground)),
            820 => Some(ControllerCommand::Start),
            1200 => Some(ControllerCommand::Abort),
            _ => None,
        };
        if let Some(command) = command {
            flight.command(now_ns, &command);
        }
        match number {
            100 | 900 => flight.ground_packet(now_ns, &ground_packet()),
            200 => flight.refused_version(now_ns),
            300 => {
                let info = DetectorInfo {
                    detector: detector.clone(),
                    host: "host".to_owned(),
                    place: Place::Ground,
                    camera: "camera".to_owned(),
                    markers: Vec::new(),
                    version: "1".to_owned(),
                    pid: 7,
                };
                flight.on_detector_info(now_ns, &detector, &info);
            }
            _ => {}
        }
        if number % 50 == 0 {
            flight.take_tape().into_iter().for_each(|part| reader.push(part));
        }
        while flight.poll_outgoing().is_some() {}
        last_ns = now_ns;
    }
    flight.shutdown(last_ns);
    flight.take_tape().into_iter().for_each(|part| reader.push(part));
    reader.tapes().remove(0)
}

#[test]
fn every_kind_of_event_is_replayed_to_the_bit() {
    let tape = with_everything(&one(12));
    let records: Vec<_> = tape.parts.iter().flat_map(Tape::records).map(Result::unwrap).collect();
    let kinds: BTreeSet<_> = records.iter().map(|record| record.event.name()).collect();
    assert_eq!(kinds.len(), 13, "{kinds:?}");
    let replies: Vec<bool> =
        records.iter().filter_map(|record| record.reply.as_ref()).map(|r| r.accepted).collect();
    assert_eq!(replies.len(), 6);
    assert!(replies.contains(&true) && replies.contains(&false), "{replies:?}");
    let phases: BTreeSet<_> =
        records.iter().filter_map(|record| Some(record.decision()?.phase)).collect();
    assert!(phases.contains("hold") && phases.contains("aborted"), "{phases:?}");
    let verdict = verified(&tape);
    assert!(verdict.is_verified() && verdict.end.is_ended, "{verdict:?}");
}

#[test]
fn a_flipped_bit_in_any_event_is_found_and_its_event_named() {
    let tape = one(12);
    let parts = tape.parts.len();
    for step in 0..200 {
        let mut flipped = tape.clone();
        // The first part has the configuration.
        let part = if step < 50 { 0 } else { step * 7919 % parts };
        let bytes = flipped.parts[part].records.len();
        let bit = step * 104_729 % (8 * bytes);
        flipped.parts[part].records[bit / 8] ^= 1 << (bit % 8);
        let verdict = verified(&flipped);
        let Some(Stop::Damaged { number, .. }) = verdict.end.stop else {
            panic!("bit {bit} of part {part}: {verdict:?}");
        };
        let within = flipped.parts[part].first
            ..=flipped.parts[part].first + u64::from(flipped.parts[part].count);
        assert!(within.contains(&number), "{number} is not in {within:?}");
    }
}

#[test]
fn a_tape_names_the_clock_whose_frames_its_flight_used() {
    let tape = one(12);
    assert!(verified(&tape).is_verified());
    let first = tape.parts[0].records().next().unwrap().unwrap();
    let TapeEvent::Begin { configuration, .. } = &first.event else { panic!("{first:?}") };
    assert!(configuration.contains(node::clock_name()), "{configuration}");
    // On a machine with another clock the frames would be refused, if the tape did not name their clock.
    let verdict = verify(&tape, &["clock=another".into()]).unwrap();
    assert!(matches!(verdict.end.stop, Some(Stop::Different { .. })), "{verdict:?}");
}

#[test]
fn a_missing_part_makes_the_rest_not_replayable() {
    let mut tape = one(12);
    let removed = tape.parts.remove(30);
    let verdict = verified(&tape);
    let missing = u64::from(removed.count);
    let is_named = matches!(verdict.end.stop, Some(Stop::Gap { from, missing: m, .. }) if from == removed.first && m == missing);
    assert!(is_named, "{verdict:?}");
    tape.parts.remove(0);
    let verdict = verified(&tape);
    assert!(matches!(verdict.end.stop, Some(Stop::NoBeginning { .. })), "{verdict:?}");
    assert!(matches!(verified(&RecordedTape::default()).end.stop, Some(Stop::NoBeginning { .. })));
}

#[test]
fn small_changes_of_the_configuration_are_noticed_and_the_value_is_named() {
    let tape = one(12);
    for (set, place) in [
        ("metric.lateral_gain=1.8001", "velocity_ned_m_s"),
        ("metric.velocity_gain=4.4999", "velocity_ned_m_s"),
        ("metric.max_descend_m_s=0.99", "velocity_ned_m_s"),
        ("autopilot.setpoint_rate_hz=19", "packet"),
    ] {
        let verdict = verify(&tape, &[set.to_owned()]).unwrap();
        let Some(Stop::Different { field, .. }) = &verdict.end.stop else {
            panic!("{set}: {verdict:?}");
        };
        assert!(field.contains(place), "{set}: {field}");
    }
    let verdict = verify(&tape, &["metric.lateral_gain=1.8001".to_owned()]).unwrap();
    let Some(Stop::Different { field, recorded, replayed, .. }) = verdict.end.stop else {
        panic!("{verdict:?}");
    };
    assert!(field.starts_with("decision.action.Velocity.velocity_ned_m_s["), "{field}");
    assert_ne!(recorded, replayed);
    assert!(verify(&tape, &["metric.lateral_gain=90".to_owned()]).is_err(), "it is out of range");
}

#[test]
fn another_guidance_on_the_same_detections_is_summed_up() {
    let tape = one(12);
    let same = change(&tape, &[]).unwrap();
    assert_eq!((same.different, same.other_outputs, same.other_phase), (0, 0, 0));
    assert_eq!(same.max_velocity_m_s, 0.0);
    assert!(same.phases.iter().any(|begun| begun.phase.name() == "descend"), "{:?}", same.phases);
    let other = change(&tape, &["metric.lateral_gain=0.9".to_owned()]).unwrap();
    assert!(other.different > 100 && other.max_velocity_m_s > 0.05, "{other:?}");
    // Other packets, with the same decisions.
    let rarer = change(&tape, &["autopilot.setpoint_rate_hz=10".to_owned()]).unwrap();
    assert!(rarer.different == 0 && rarer.other_outputs > 100, "{rarer:?}");
}
