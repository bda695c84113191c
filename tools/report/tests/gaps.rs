//! Recordings of a part of a flight: damaged and repaired, begun in the middle of the landing, with gaps, and with more than the landing.

#![allow(clippy::unwrap_used, reason = "helpers of tests may fail like tests")]

use std::collections::BTreeMap;
use std::sync::OnceLock;

use experiments::landing::flight::fly_recorded;
use experiments::landing::plan::{Plan, Values, Vision};
use flightlog::{About, Entry, Writer};
use report::chart::Shape;
use report::plots;
use report::view::View;
use report::{Flight, FlightReader, page, summary};

/// The recording of a landing.
fn landing() -> &'static [u8] {
    static LANDING: OnceLock<Vec<u8>> = OnceLock::new();
    LANDING.get_or_init(|| {
        let one = |value| Values::List(vec![value]);
        let (height, offset) = (one(4.0), one(1.0));
        let plan = Plan { vision: Vision::Modelled, flights: 1, height, offset, ..Plan::default() };
        let mut recording = Vec::new();
        fly_recorded(&plan.flights()[0], &mut recording).unwrap();
        recording
    })
}

fn read(recording: &[u8]) -> Flight {
    let mut reader = FlightReader::new("flight.mcap");
    reader.add(recording).unwrap();
    reader.finish()
}

/// The recording with a chunk for each 0.4 s, as a recorder in flight writes them.
fn in_chunks(recording: &[u8]) -> Vec<u8> {
    let about = About { program: "test".to_owned(), facts: BTreeMap::new(), utc_offset_ns: 0 };
    let mut copy = Vec::new();
    let mut writer = Writer::new(&mut copy, &about).unwrap();
    let mut chunk = 0;
    flightlog::read(recording, |entry| {
        if let Entry::Message(message) = entry {
            if message.received_ns / 400_000_000 != chunk {
                writer.flush().unwrap();
                chunk = message.received_ns / 400_000_000;
            }
            writer.receive(message).unwrap();
        }
    })
    .unwrap();
    writer.finish().unwrap();
    copy
}

#[test]
fn a_repaired_copy_reports_the_damage_of_the_recording_in_time_and_a_few_lines() {
    let recording = &in_chunks(landing());
    let mut damaged = recording.to_vec();
    for twentieth in 4..10 {
        damaged[twentieth * recording.len() / 20] ^= 1;
    }
    let mut copy = Vec::new();
    let found = flightlog::repair(&damaged, &mut copy).unwrap();
    let count = found.damage.len();
    assert!(count >= 4, "{found:?}");
    let (complete, of_damaged, of_copy) = (read(recording), read(&damaged), read(&copy));
    assert!(complete.is_complete() && !of_copy.is_complete());
    assert_eq!(of_copy.lost_chunks, of_damaged.lost_chunks);
    let gaps_s = of_copy.lost_chunks.gaps_ns.iter().map(|gap| (gap.end - gap.start) as f64 * 1e-9);
    let lost_s: f64 = gaps_s.sum();
    assert!(lost_s > 1.0, "{lost_s}");
    let problems = summary(&of_copy).problems;
    let first = format!("chunks of the recording are lost, with the messages of {lost_s:.1} s");
    assert!(
        problems[0].starts_with(&format!("{count} of ")) && problems[0].contains(&first),
        "{problems:?}"
    );
    assert!(problems[0].ends_with(" s in the landing"), "{problems:?}");
    let others = format!("{} further parts are damaged", count - 1);
    assert!(problems[1].contains(&others), "{problems:?}");
    assert_eq!(problems.len(), 2, "{problems:?}");
    assert!(
        page(&of_copy).unwrap().contains(&format!("<summary>The {count} damaged parts</summary>"))
    );
    // One that was cut off has an end after its repair, and is still not complete.
    let mut copy = Vec::new();
    flightlog::repair(&recording[..recording.len() / 2], &mut copy).unwrap();
    let of_copy = read(&copy);
    assert!(!of_copy.is_complete());
    let problems = summary(&of_copy).problems;
    assert!(problems[0].starts_with("the recording had no end before its repair"), "{problems:?}");
}

#[test]
fn a_recording_that_begins_in_the_middle_of_the_landing_is_reported() {
    let recording = landing();
    let begun_ns = read(recording).landing_ns().unwrap().start;
    let from = |late_s: f64| {
        let about = About { program: "test".to_owned(), facts: BTreeMap::new(), utc_offset_ns: 0 };
        let mut copy = Vec::new();
        let mut writer = Writer::new(&mut copy, &about).unwrap();
        let from_ns = begun_ns + (late_s * 1e9) as i64;
        flightlog::read(recording, |entry| {
            if let Entry::Message(message) = entry
                && message.received_ns >= from_ns
            {
                writer.receive(message).unwrap();
            }
        })
        .unwrap();
        writer.finish().unwrap();
        summary(&read(&copy)).problems
    };
    let late = from(4.0);
    let number = |text: &str| text.split(' ').nth(3).and_then(|it| it.parse::<f64>().ok());
    assert!(late[0].starts_with("the recording begins "), "{late:?}");
    let late_s = number(&late[0]).unwrap();
    assert!((3.7..4.3).contains(&late_s), "{late:?}");
    assert_eq!([from(0.0), summary(&read(recording)).problems], [Vec::<String>::new(), Vec::new()]);
}

#[test]
fn errors_of_the_estimate_before_and_after_the_landing_do_not_count() {
    let flight = read(landing());
    let touchdown_ns = flight.truth.iter().find_map(|it| it.touchdown).unwrap().stamp_ns;
    let landing_ns = flight.landing_ns().unwrap().start..touchdown_ns;
    let mut wrong = flight.clone();
    let outside = wrong.targets.iter_mut().filter(|it| !landing_ns.contains(&it.stamp_ns));
    for target in outside {
        target.position_ned_m =
            target.position_ned_m.map(|[north, east, down]| [north + 50.0, east, down]);
    }
    let worst = |flight: &Flight| {
        report::track::estimate_errors(flight).iter().map(|it| it.horizontal_m).fold(0.0, f64::max)
    };
    assert!(worst(&wrong) > 40.0, "no estimate is outside of the landing");
    let [before, after] = [&flight, &wrong].map(summary);
    assert!(before.estimate_error_p50_m.is_some());
    assert_eq!(after.estimate_error_p50_m, before.estimate_error_p50_m);
    assert_eq!(after.estimate_error_p95_m, before.estimate_error_p95_m);
}

#[test]
fn a_gap_of_the_recording_is_a_gap_of_the_claimed_deviation() {
    let mut flight = read(landing());
    let gap_s = 3.0..6.0;
    let zero_ns = flight.zero_ns;
    flight.targets.retain(|it| !gap_s.contains(&((it.stamp_ns - zero_ns) as f64 * 1e-9)));
    let view = View::new(&flight);
    let chart = plots::height(&view).pop().unwrap();
    let claimed = &chart.layers[0];
    assert_eq!((claimed.name.as_str(), claimed.shape), ("claimed standard deviation", Shape::Area));
    let pieces = claimed.points.split(|it| !it.y.is_finite()).filter(|it| !it.is_empty());
    let pieces: Vec<_> = pieces.collect();
    assert!(pieces.len() >= 2, "{}", pieces.len());
    for piece in pieces {
        let [from, to] = [piece[0], piece[piece.len() - 1]];
        assert!(from.y == 0.0 && to.y == 0.0 && piece.len() > 2, "{from:?} {to:?}");
        assert!(to.x <= gap_s.start + 0.1 || from.x >= gap_s.end - 0.1, "{from:?} {to:?}");
    }
    let from_the_side = plots::landing(&view).pop().unwrap();
    let areas = &from_the_side.layers[0].points;
    assert!(areas.split(|it| !it.y.is_finite()).filter(|it| !it.is_empty()).count() >= 2);
}

#[test]
fn date_duration_and_size_are_at_the_top_of_a_page() {
    let facts = BTreeMap::new();
    let about =
        About { program: "test".to_owned(), facts, utc_offset_ns: 1_796_053_151_000_000_000 };
    let with_date = |is_landing: bool| {
        let mut copy = Vec::new();
        let mut writer = Writer::new(&mut copy, &about).unwrap();
        flightlog::read(landing(), |entry| {
            if let Entry::Message(message) = entry
                && (is_landing || message.key == "truth")
            {
                writer.receive(message).unwrap();
            }
        })
        .unwrap();
        writer.finish().unwrap();
        copy
    };
    let recording = with_date(true);
    let flight = read(&recording);
    let found = summary(&flight);
    assert_eq!(found.recording_bytes, recording.len() as u64);
    let length_s = found.recording_s.unwrap();
    assert!(length_s > found.time_to_disarm_s.unwrap(), "{length_s}");
    assert!(found.begun_utc.as_ref().unwrap().starts_with("2026-11-30T15:39:"), "{found:?}");
    let origin = found.origin();
    assert!(origin.starts_with("landing began 2026-11-30 15:39:"), "{origin}");
    assert!(origin.contains(&format!(" UTC, {length_s:.0} s recorded, ")), "{origin}");
    let html = page(&flight).unwrap();
    assert!(html.contains(&origin) && html.contains("time since the landing began, s"));
    // Without a landing all times are those of the recording.
    let flight = read(&with_date(false));
    let html = page(&flight).unwrap();
    assert!(html.contains("recording began 2026-11-30 15:39:"), "{}", summary(&flight).origin());
    assert!(!html.contains("since the landing began"));
    // The clock of a flight in lock-step was never set.
    assert_eq!(summary(&read(landing())).begun_utc, None);
}
