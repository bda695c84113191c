//! Flights with faults, replayed to the bit; and what was changed in a tape or in the configuration, found.

#![allow(clippy::unwrap_used, reason = "helpers of tests may fail like tests")]

use experiments::faults::flight::fly_with_tape;
use experiments::faults::plan::{Plan, Planned};
use experiments::landing::in_parallel;
use flightlog::{RecordedTape, TapeReader};
use messages::TapeEvent;
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
    // On a machine with another clock the frames would be refused, if the tape did not say whose they are.
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
    assert_eq!((same.different, same.other_phase, same.max_velocity_m_s), (0, 0, 0.0));
    assert!(same.phases.iter().any(|begun| begun.phase.name() == "descend"), "{:?}", same.phases);
    let other = change(&tape, &["metric.lateral_gain=0.9".to_owned()]).unwrap();
    assert!(other.different > 100 && other.max_velocity_m_s > 0.05, "{other:?}");
}
