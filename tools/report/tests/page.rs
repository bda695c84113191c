//! The report's page, document and numbers of recordings flown in lock-step: all sections, topics left out,
//! damaged files, several landings, other versions and clocks, two flights side by side.

#![allow(clippy::unwrap_used, reason = "helpers of tests may fail like tests")]

use std::collections::BTreeMap;
use std::sync::OnceLock;

use experiments::landing::flight::fly_recorded;
use experiments::landing::outcome::Outcome;
use experiments::landing::plan::{Plan, Planned, Values, Vision};
use flightlog::{About, Entry, Picture, Received, TapeReader, Writer};
use messages::{
    Configuration, ControllerStatus, Count, Detections, FrameHeader, GcsStatus, GroundStation,
    Health, Message as _, PacketSignature, SigningState, Tape, encode,
};
use report::chart::Shape;
use report::frames::Fate;
use report::plots;
use report::view::View;
use report::{Flight, FlightReader, comparison, document, page, replay_tapes, summary};

/// The sections that a page has.
const SECTIONS: [&str; 14] = [
    "landing",
    "phases",
    "height",
    "setpoints",
    "detections",
    "latency",
    "losses",
    "detectors",
    "wind",
    "battery",
    "log",
    "thesis",
    "configuration",
    "recording",
];

fn planned(wind_m_s: f64, fault: &str, set: &[&str]) -> Planned {
    let one = |value| Values::List(vec![value]);
    let plan = Plan {
        vision: Vision::Modelled,
        flights: 1,
        seed: 3,
        wind: one(wind_m_s),
        height: one(4.0),
        offset: one(1.0),
        faults: vec![fault.parse().unwrap()],
        set: set.iter().map(|setting| (*setting).to_owned()).collect(),
        ..Plan::default()
    };
    plan.flights().swap_remove(0)
}

/// A flight and its recording.
struct Flown {
    outcome: Outcome,
    recording: Vec<u8>,
}

fn flown(planned: &Planned) -> Flown {
    let mut recording = Vec::new();
    let outcome = fly_recorded(planned, &mut recording).unwrap();
    Flown { outcome, recording }
}

/// A landing in wind.
fn landing() -> &'static Flown {
    static LANDING: OnceLock<Flown> = OnceLock::new();
    LANDING.get_or_init(|| flown(&planned(4.0, "none", &[])))
}

fn read(recording: &[u8]) -> Flight {
    let mut reader = FlightReader::new("flight.mcap");
    reader.add(recording).unwrap();
    reader.finish()
}

/// The recording without the messages whose key is one of these.
fn without(recording: &[u8], keys: &[&str]) -> Vec<u8> {
    let about = About { program: "test".to_owned(), facts: BTreeMap::new(), utc_offset_ns: 0 };
    let mut copy = Vec::new();
    let mut writer = Writer::new(&mut copy, &about).unwrap();
    flightlog::read(recording, |entry| {
        if let Entry::Message(message) = entry
            && !keys.contains(&message.key)
        {
            writer.receive(message).unwrap();
        }
    })
    .unwrap();
    writer.finish().unwrap();
    copy
}

/// The recording as a program would have written it whose messages on some keys have another version.
fn of_other_version(recording: &[u8], keys: &[&str]) -> Vec<u8> {
    let about = About { program: "test".to_owned(), facts: BTreeMap::new(), utc_offset_ns: 0 };
    let mut copy = Vec::new();
    let mut writer = Writer::new(&mut copy, &about).unwrap();
    flightlog::read(recording, |entry| {
        let Entry::Message(message) = entry else { return };
        let mut payload = message.payload.to_vec();
        if keys.contains(&message.key) {
            // After the mark of our messages and their type.
            payload[2] -= 1;
        }
        writer.receive(Received { payload: &payload, ..message }).unwrap();
    })
    .unwrap();
    writer.finish().unwrap();
    copy
}

fn has_all_sections(html: &str) {
    for id in SECTIONS {
        assert!(html.contains(&format!("<section id=\"{id}\">")), "no section {id}");
    }
}

fn near(one: Option<f64>, other: Option<f64>, within: f64) {
    let (one, other) = (one.unwrap(), other.unwrap());
    assert!((one - other).abs() <= within, "{one} is not {other}");
}

/// The recording with the last word of a bridge to the ground station, this long before its end.
fn with_ground(recording: &[u8], status: &GcsStatus, before_ns: i64) -> Vec<u8> {
    with(recording, "gcs/status", &encode(status), before_ns)
}

/// The recording with one more message, which came this long before its end.
fn with(recording: &[u8], key: &str, payload: &[u8], before_ns: i64) -> Vec<u8> {
    let about = About { program: "test".to_owned(), facts: BTreeMap::new(), utc_offset_ns: 0 };
    let mut copy = Vec::new();
    let mut writer = Writer::new(&mut copy, &about).unwrap();
    let mut received_ns = 0;
    flightlog::read(recording, |entry| {
        if let Entry::Message(message) = entry {
            received_ns = message.received_ns;
            writer.receive(message).unwrap();
        }
    })
    .unwrap();
    let received_ns = received_ns - before_ns;
    writer.receive(Received { key, payload, attachment: &[], received_ns }).unwrap();
    writer.finish().unwrap();
    copy
}

#[test]
fn a_page_has_the_ground_stations_and_the_refused_packets() {
    let station = GroundStation {
        silent: true,
        packets: 300,
        refused: 2,
        signature: PacketSignature::Verified,
        ..GroundStation::sample()
    };
    let mut status = GcsStatus {
        bridge: "main".into(),
        link: "udpin:0.0.0.0:14550".into(),
        ground_may: "no-arming".into(),
        stations: vec![station],
        refused: vec![Count { reason: "arming or stopping motors".into(), count: 2 }],
        ..GcsStatus::default()
    };
    status.signing.state = SigningState::InForce;
    let without_bridge = page(&read(&landing().recording)).unwrap();
    assert!(without_bridge.contains("no message of a gcs-bridge was recorded"));
    let html = page(&read(&with_ground(&landing().recording, &status, 0))).unwrap();
    for part in [
        "gcs-bridge main, udpin:0.0.0.0:14550: packets are signed",
        "255/190 at 10.0.0.2:14550",
        "silent at the end",
        "arming or stopping motors",
    ] {
        assert!(html.contains(part), "no {part}");
    }
    assert!(!html.contains("no message of a gcs-bridge was recorded"));
    // Its bridge was gone before the end: it is not known which stations were present then.
    status.stations[0].silent = false;
    for (before_ns, is_old) in [(4_000_000_000, false), (6_000_000_000, true)] {
        let html = page(&read(&with_ground(&landing().recording, &status, before_ns))).unwrap();
        assert_eq!(html.contains("<td>yes</td>"), !is_old, "{before_ns}");
        assert_eq!(html.contains("the bridge published no more"), is_old, "{before_ns}");
    }
    // One whose status was not recorded did run.
    let health =
        Health { service: "gcs-bridge".into(), instance: "main".into(), ..Health::sample() };
    let recording = with(&landing().recording, "health/gcs-bridge/main", &encode(&health), 0);
    let html = page(&read(&recording)).unwrap();
    assert!(html.contains("gcs-bridge main ran, and its status was not recorded"));
    assert!(!html.contains("no message of a gcs-bridge was recorded"));
}

#[test]
fn a_page_has_every_section_and_needs_nothing_else() {
    let flight = read(&landing().recording);
    let html = page(&flight).unwrap();
    has_all_sections(&html);
    // The landing, height, velocities, detections, latency, wind, link, and eight of the thesis.
    assert!(html.matches("<svg ").count() > 20, "{} charts", html.matches("<svg ").count());
    for number in 10..=16 {
        assert!(html.contains(&format!("Figure 4.{number}:")), "no figure 4.{number}");
    }
    for outside in ["<script", "<img", "<link", "src=", "url(", "@import"] {
        assert!(!html.contains(outside), "{outside}");
    }
    // The only addresses are the name of SVG.
    assert_eq!(
        html.matches("http").count(),
        html.matches("http://www.w3.org/2000/svg").count() + 1
    );
    // Lock-step does not record the health of processes.
    assert!(html.contains("Not recorded: the health of the processes"), "health");
    assert!(html.contains("descending over the marker"), "reasons");
    assert!(html.len() < 2_000_000, "{} bytes", html.len());
}

#[test]
fn the_wind_is_named_by_where_it_comes_from() {
    let mut flight = read(&landing().recording);
    for wind in &mut flight.wind {
        wind.velocity_ned_m_s = [-4.0, 2.0, 0.0];
    }
    let charts = plots::wind(&View::new(&flight));
    assert_eq!(charts[0].title, "Wind from the north (negative: from the south)");
    for (chart, from_m_s) in charts.iter().zip([4.0, -2.0]) {
        let truth: Vec<f64> = chart.layers[0].points.iter().map(|it| it.y).collect();
        let drawn: Vec<f64> = truth.into_iter().filter(|speed| speed.is_finite()).collect();
        assert!(!drawn.is_empty() && drawn.iter().all(|speed| *speed == from_m_s), "{drawn:?}");
    }
}

#[test]
fn circles_of_the_deviation_are_whole_and_the_large_ones_are_left_out_aloud() {
    let flight = read(&landing().recording);
    let mut view = View::new(&flight);
    let end_s = view.estimated.last().unwrap().time_s;
    for point in &mut view.estimated {
        point.deviation_m = if point.time_s < 0.5 * end_s { 50.0 } else { 0.2 };
    }
    let charts = plots::landing(&view);
    let (axes, circles) = (&charts[0].axes, &charts[0].layers[0].points);
    assert!(circles.iter().any(|it| it.x.is_finite()), "no circle");
    for run in circles.split(|it| !it.x.is_finite()).filter(|run| !run.is_empty()) {
        assert_eq!(run.len(), 25, "a circle has a part only");
        assert!(run.iter().all(|it| axes.x.contains(&it.x) && axes.y.contains(&it.y)), "{axes:?}");
    }
    assert!(charts[0].note.contains("left out"), "{}", charts[0].note);
    assert_eq!(charts[1].note, "");
    // Over the path that begins there, and larger than that is wide.
    let last = charts[0].layers.last().unwrap();
    assert_eq!((last.name.as_str(), last.shape), ("start", Shape::LargeDots));
}

#[test]
fn a_legend_shows_crosses_as_crosses_and_no_dots_hide_others() {
    let flight = read(&landing().recording);
    let html = page(&flight).unwrap();
    assert!(html.contains("<i class=\"cross text\"></i>pad"));
    let chart = plots::latency(&View::new(&flight)).swap_remove(0);
    let shapes: Vec<Shape> = chart.layers.iter().map(|layer| layer.shape).take(2).collect();
    // The hindmost first.
    assert_eq!(shapes, [Shape::LargeDots, Shape::Dots]);
}

#[test]
fn the_numbers_are_those_of_the_flight_itself() {
    let Flown { outcome, recording } = landing();
    let flight = read(recording);
    let found = summary(&flight);
    assert_eq!(found.landed, Some(true), "{}", found.outcome());
    near(found.touchdown_error_m, outcome.error_m, 1e-12);
    near(found.touchdown_speed_m_s, outcome.sink_m_s, 1e-12);
    near(found.touchdown_lateral_speed_m_s, outcome.slide_m_s, 1e-12);
    near(found.time_to_touchdown_s, outcome.touchdown_s, 0.03);
    near(found.max_tilt_deg, Some(outcome.max_tilt_deg), 0.01);
    near(found.wind_mean_m_s, Some(outcome.wind_m_s), 2.0);
    // The controller counts the same frames as used.
    assert_eq!(found.frames_used as u64, outcome.detections);
    let frames = report::frames::Frames::of(&flight);
    let outside = [Fate::Standby, Fate::NotNeeded, Fate::OnGround].map(|it| frames.count(&it));
    assert!(outside[2] > 0, "no frame was searched on the ground");
    let outside: usize = outside.iter().sum();
    // Frames after the touchdown, which no longer show the marker as from above, do not count as refusals.
    let touchdown = flight.truth.iter().find_map(|truth| truth.touchdown).unwrap();
    let after = frames.all.iter().filter(|it| it.handled_ns > touchdown.stamp_ns + 20_000_000);
    let unused =
        |it: &&report::frames::Handled| matches!(it.fate, Fate::Refused(_) | Fate::NoMarker);
    assert_eq!(after.filter(unused).count(), 0);
    assert_eq!(found.frames + outside, flight.found.len());
    // Latency: each frame's detections came a modelled time after its exposure.
    let of_landing: Vec<i64> =
        frames.all.iter().filter(|it| it.is_of_landing()).map(|it| it.exposed_ns).collect();
    let times: Vec<f64> = flight
        .found
        .iter()
        .filter(|it| of_landing.contains(&it.message.header.stamp_ns))
        .map(|it| (it.received_ns - it.message.header.stamp_ns) as f64 * 1e-6)
        .collect();
    let stage = found.latency.iter().find(|it| it.name == report::latency::TO_CONTROLLER).unwrap();
    near(Some(stage.p50_ms), node::stats::quantile(&times, 0.5), 1e-6);
    assert_eq!(stage.frames, found.frames);
    // The controller's own percentiles are of its last 512 frames.
    let published = flight.statuses.iter().rev().find_map(|status| status.latency_ms).unwrap();
    near(found.latency_p50_ms, Some(published[0]), 30.0);
    // The estimate's error agrees with its stated deviation.
    assert!(found.estimate_error_p50_m.unwrap() < 0.1, "{:?}", found.estimate_error_p50_m);
    let line = found.line();
    assert!(line.contains("landed; ") && line.contains("frames of the landing used"), "{line}");
    let json = serde_json::to_value(&found).unwrap();
    assert_eq!(json["frames_used"], outcome.detections);
}

#[test]
fn a_recorded_flight_verifies() {
    let mut tapes = TapeReader::default();
    tapes.read(&landing().recording).unwrap();
    let tapes = tapes.tapes();
    assert_eq!(tapes.len(), 1);
    let verdict = replay::verify(&tapes[0], &[]).unwrap();
    assert!(verdict.is_verified() && verdict.end.is_ended, "{verdict:?}");
}

#[test]
fn recording_a_flight_changes_nothing_of_it() {
    let planned = planned(4.0, "none", &[]);
    let unrecorded = experiments::landing::flight::fly(&planned, None).unwrap();
    assert_eq!(unrecorded, landing().outcome);
}

#[test]
fn without_a_tape_the_estimates_show_which_frames_were_used() {
    let recording = without(&landing().recording, &["controller/tape"]);
    let flight = read(&recording);
    assert!(flight.tapes.is_empty());
    let frames = report::frames::Frames::of(&flight);
    assert!(!frames.is_from_tape);
    let used = frames.count(&Fate::Used) as i64;
    let by_tape = summary(&read(&landing().recording)).frames_used as i64;
    assert!((used - by_tape).abs() <= 2, "{used} without the tape, {by_tape} with it");
    let html = page(&flight).unwrap();
    has_all_sections(&html);
    assert!(html.contains("Not recorded: the controller&#39;s tape"), "tape");
}

#[test]
fn a_status_of_another_version_is_reported_as_that() {
    let keys = ["controller/status", "controller/tape"];
    let mut flight = read(&of_other_version(&landing().recording, &keys));
    replay_tapes(&mut flight);
    let found = summary(&flight);
    let line = found.line();
    for (text, version) in [
        ("the status of the controller is", ControllerStatus::VERSION),
        ("a part of a tape is", Tape::VERSION),
    ] {
        let found = version - 1;
        let warning = format!("{text} of another version ({found}; this program reads {version})");
        assert!(line.contains(&warning), "`{warning}` is not in: {line}");
    }
    assert!(!line.contains("no status"), "{line}");
    assert_eq!(serde_json::to_value(&found).unwrap()["landed"], serde_json::Value::Null);
    has_all_sections(&page(&flight).unwrap());
    // And where no status was recorded.
    let none = summary(&read(&without(&landing().recording, &keys)));
    assert_eq!((none.landed, none.unreadable_status.is_none()), (None, true));
    assert!(none.line().contains("no status of a controller was recorded"), "{}", none.line());
}

#[test]
fn a_tape_alone_gives_status_and_estimates_again() {
    let complete = read(&landing().recording);
    let others = ["controller/status", "controller/target", "vehicle/state", "truth", "wind"];
    let mut flight = read(&without(&landing().recording, &others));
    assert!(flight.statuses.is_empty() && flight.targets.is_empty());
    replay_tapes(&mut flight);
    assert!(flight.is_rebuilt && flight.replayed.as_ref().unwrap().is_verified);
    let (first, again) = (summary(&complete), summary(&flight));
    assert_eq!((again.landed, again.frames_used), (Some(true), first.frames_used));
    near(again.time_to_disarm_s, first.time_to_disarm_s, 1e-9);
    let names = |summary: &report::Summary| -> Vec<String> {
        summary.phases.iter().map(|phase| phase.name.clone()).collect()
    };
    assert_eq!(names(&again), names(&first));
    for target in &complete.targets {
        assert!(flight.targets.contains(target), "{target:?}");
    }
    let html = page(&flight).unwrap();
    has_all_sections(&html);
    assert!(html.contains("from a replay of its tape"), "missing status");
    assert!(html.contains("tape verified to the bit"), "verified");
}

#[test]
fn a_tape_with_a_gap_is_reported() {
    let mut flight = read(&landing().recording);
    flight.tapes[0].parts.remove(9);
    replay_tapes(&mut flight);
    let replayed = flight.replayed.clone().unwrap();
    assert!(!replayed.is_verified && replayed.text.contains("not replayable"), "{replayed:?}");
    assert!(summary(&flight).line().contains("tape not verified"));
    let losses = report::losses::tape(&flight);
    assert!(losses[0].count > 0, "{losses:?}");
}

#[test]
fn missing_messages_are_named() {
    let keys = ["truth", "wind", "controller/tape", "mavlink/from-autopilot"];
    let flight = read(&without(&landing().recording, &keys));
    let html = page(&flight).unwrap();
    has_all_sections(&html);
    for messages in ["truth, which only", "the true wind", "packets", "parameters of the autopilot"]
    {
        let is_named = html.contains(&format!("Not recorded: {messages}"))
            || html.contains(&format!("Not recorded: the autopilot&#39;s {messages}"));
        assert!(is_named, "{messages}");
    }
    assert_eq!(summary(&flight).touchdown_error_m, None);
    // Nothing but frames.
    let keys = ["controller/status", "controller/target", "vehicle/state", "camera/down/info"];
    let keys: Vec<&str> = keys.into_iter().chain(["truth", "wind", "controller/tape"]).collect();
    let flight = read(&without(&landing().recording, &keys));
    let html = page(&flight).unwrap();
    has_all_sections(&html);
    assert!(html.contains("Not recorded: the controller&#39;s status"), "status");
}

#[test]
fn damaged_recordings_give_their_remaining_messages() {
    let recording = &landing().recording;
    let flight = read(&recording[..recording.len() / 2]);
    let html = page(&flight).unwrap();
    has_all_sections(&html);
    assert!(!flight.is_ended && html.contains("the recording has no end"), "no end");
    let mut flipped = recording.clone();
    for fifth in [1, 2, 3] {
        flipped[fifth * recording.len() / 5] ^= 1;
    }
    let flight = read(&flipped);
    assert!(!flight.damage.is_empty());
    let html = page(&flight).unwrap();
    assert!(html.contains("is damaged"), "{:?}", flight.damage);
    for length in (0..recording.len()).step_by(recording.len() / 40 + 1) {
        let mut reader = FlightReader::new("cut");
        if reader.add(&recording[..length]).is_ok() {
            has_all_sections(&page(&reader.finish()).unwrap());
        }
    }
}

#[test]
fn of_a_recording_with_two_landings_each_has_its_own_numbers() {
    const LATER_NS: i64 = 100_000_000_000;
    let one = read(&without(&landing().recording, &["controller/tape"]));
    let mut both = one.clone();
    let statuses = one.statuses.iter().cloned().map(|mut it| {
        it.stamp_ns += LATER_NS;
        it.started_ns = it.started_ns.map(|ns| ns + LATER_NS);
        it.disarmed_ns = it.disarmed_ns.map(|ns| ns + LATER_NS);
        it
    });
    both.statuses.extend(statuses);
    both.vehicle.extend(one.vehicle.iter().cloned().map(|mut it| {
        it.stamp_ns += LATER_NS;
        it
    }));
    let first_touchdown = one.truth.last().unwrap().touchdown;
    both.truth.extend(one.truth.iter().cloned().map(|mut it| {
        it.stamp_ns += LATER_NS;
        // The simulator publishes the last touchdown until the next.
        let own = it.touchdown.map(|mut own| {
            own.stamp_ns += LATER_NS;
            own.error_m += 1.0;
            own
        });
        it.touchdown = own.or(first_touchdown);
        it
    }));
    both.found.extend(one.found.iter().cloned().map(|mut it| {
        it.received_ns += LATER_NS;
        it.message.header.stamp_ns += LATER_NS;
        it
    }));
    let alone = summary(&one);
    assert_eq!(
        (one.clone().keep_landing(Some(2)), one.clone().keep_landing(None)),
        (Err(1), Ok(()))
    );
    for (number, name, more_m) in [(Some(1), "landing 1 of 2", 0.0), (None, "landing 2 of 2", 1.0)]
    {
        let mut kept = both.clone();
        kept.keep_landing(number).unwrap();
        let found = summary(&kept);
        assert!(found.name.ends_with(name), "{}", found.name);
        assert_eq!(found.landed, Some(true));
        near(found.time_to_disarm_s, alone.time_to_disarm_s, 1e-9);
        near(found.time_to_touchdown_s, alone.time_to_touchdown_s, 1e-9);
        near(found.touchdown_error_m, alone.touchdown_error_m.map(|it| it + more_m), 1e-12);
        assert_eq!(found.frames, alone.frames);
    }
    assert_eq!(both.keep_landing(Some(3)), Err(2));
}

#[test]
fn a_landing_that_follows_an_aborted_one_is_shown_whole() {
    let mut flight = read(&without(&landing().recording, &["controller/tape"]));
    let started_ns = flight.statuses.iter().find_map(|it| it.started_ns).unwrap();
    let mut aborted = flight.statuses.iter().find(|it| it.finished).unwrap().clone();
    (aborted.started_ns, aborted.disarmed_ns) = (None, None);
    aborted.stamp_ns = started_ns - 1_000_000_000;
    flight.statuses.insert(0, aborted);
    let mut before = flight.truth[0].clone();
    before.stamp_ns = started_ns - 1_000_000_000;
    let mut earlier = flight.truth.iter().find_map(|it| it.touchdown).unwrap();
    (earlier.stamp_ns, earlier.error_m) = (started_ns - 5_000_000_000, 7.0);
    before.touchdown = Some(earlier);
    flight.truth.insert(0, before);
    let view = View::new(&flight);
    let lasted_s = view.summary.time_to_disarm_s.unwrap();
    assert!(view.time.end > lasted_s, "{:?} of {lasted_s} s", view.time);
    assert!(view.summary.touchdown_error_m.unwrap() < 1.0, "that of the landing before");
}

#[test]
fn times_of_a_recorder_on_another_machine_are_distinguished_by_the_names_of_the_clocks() {
    const AHEAD_NS: i64 = 7_000_000_000;
    let recorded_by = |clock: &str, ahead_ns: i64| {
        let facts = [("clock".to_owned(), clock.to_owned())].into();
        let about = About { program: "test".to_owned(), facts, utc_offset_ns: 0 };
        let mut copy = Vec::new();
        let mut writer = Writer::new(&mut copy, &about).unwrap();
        flightlog::read(&landing().recording, |entry| {
            if let Entry::Message(mut message) = entry {
                message.received_ns += ahead_ns;
                writer.receive(message).unwrap();
            }
        })
        .unwrap();
        writer.finish().unwrap();
        read(&copy)
    };
    let own = landing_clock();
    assert_eq!(recorded_by(&own, AHEAD_NS).shift_ns, 0, "late, but of the same clock");
    let apart_ns = recorded_by("ground", AHEAD_NS).shift_ns - AHEAD_NS;
    assert!((0..100_000_000).contains(&apart_ns), "{apart_ns}");
}

#[test]
fn the_losses_of_recorders_that_ran_one_after_the_other_are_added() {
    let file = |run: &str, lost: u64| {
        let facts = [("run".to_owned(), run.to_owned())].into();
        let about = About { program: "test".to_owned(), facts, utc_offset_ns: 0 };
        let mut file = Vec::new();
        let mut writer = Writer::new(&mut file, &about).unwrap();
        writer.dropped(1, &[("wind".to_owned(), lost)].into()).unwrap();
        writer.finish().unwrap();
        file
    };
    let lost = |files: &[Vec<u8>]| {
        let mut reader = FlightReader::new("flight");
        files.iter().for_each(|file| reader.add(file).unwrap());
        reader.finish().lost.get("wind").copied()
    };
    let [first, second] = [file("1-1", 10), file("1-1", 12)];
    assert_eq!(lost(&[first.clone(), second.clone()]), Some(12), "counted since the start");
    assert_eq!(lost(&[second, first, file("2-1", 5)]), Some(17));
}

#[test]
fn without_detections_the_controllers_health_names_the_vehicles_clock() {
    const AHEAD_NS: i64 = 7_000_000_000;
    let facts = [("clock".to_owned(), "ground".to_owned())].into();
    let about = About { program: "test".to_owned(), facts, utc_offset_ns: 0 };
    let mut copy = Vec::new();
    let mut writer = Writer::new(&mut copy, &about).unwrap();
    let health =
        Health { service: "controller".into(), clock: landing_clock(), ..Health::sample() };
    let (key, payload) = ("health/controller/main", encode(&health));
    writer.receive(Received { key, payload: &payload, attachment: b"", received_ns: 1 }).unwrap();
    flightlog::read(&landing().recording, |entry| {
        if let Entry::Message(mut message) = entry
            && !message.key.starts_with("detector/")
        {
            message.received_ns += AHEAD_NS;
            writer.receive(message).unwrap();
        }
    })
    .unwrap();
    writer.finish().unwrap();
    let flight = read(&copy);
    assert!(flight.found.is_empty());
    let apart_ns = flight.shift_ns - AHEAD_NS;
    assert!((0..100_000_000).contains(&apart_ns), "{apart_ns}");
}

/// The clock of the landing's frames.
fn landing_clock() -> String {
    read(&landing().recording).found[0].message.header.clock.clone()
}

#[test]
fn no_recording_is_refused() {
    let mut reader = FlightReader::new("text");
    assert!(reader.add(b"this is no recording at all").is_err());
    assert!(FlightReader::new("empty").is_empty());
    assert!(page(&Flight::default()).is_ok(), "an empty flight has a page of missing messages");
}

#[test]
fn two_flights_stand_side_by_side_with_their_differences() {
    let other = flown(&planned(0.0, "none", &["controller.metric.max_descend_m_s=0.7"]));
    let (one, other) = (read(&landing().recording), read(&other.recording));
    let html = comparison(&one, &other).unwrap();
    has_all_sections(&html);
    assert!(html.contains("controller/main: metric.max_descend_m_s"), "setting");
    assert!(html.contains("simulator/main: wind.mean_m_s"), "wind");
    assert!(!html.contains("controller/main: metric.lateral_gain</td>"), "the same in both");
    assert!(html.contains("B less A"), "numbers");
}

/// The texts of a document, in the order in which they stand in the file.
fn texts(document: &[u8]) -> Vec<String> {
    let file: String = document.iter().map(|byte| char::from(*byte)).collect();
    let shown = file.split(") Tj").filter_map(|before| before.rsplit_once('('));
    shown.map(|(_, text)| text.to_owned()).collect()
}

#[test]
fn a_document_has_every_section_and_chart_on_pages_of_a4() {
    let flight = read(&landing().recording);
    let file = document(&flight, None).unwrap();
    assert!(file.starts_with(b"%PDF-") && file.len() < 4_000_000, "{} bytes", file.len());
    let texts = texts(&file);
    let has = |text: &str| texts.iter().any(|it| it == text);
    for title in ["Flight report", "flight.mcap", "Phases and reasons", "Latency budget", "Log"] {
        assert!(has(title), "no `{title}` in {texts:?}");
    }
    assert!(has("Height over the pad") && has("Velocity downwards") && has("estimate"));
    assert!(texts.iter().any(|it| it.starts_with("landed")), "{texts:?}");
    assert!(texts.iter().any(|it| it.contains("health of the processes")));
    let pages = texts.iter().filter(|it| it.starts_with("flight.mcap, page ")).count();
    assert!((4..20).contains(&pages), "{pages} pages");
}

#[test]
fn a_document_of_two_flights_has_each_chart_twice_and_their_differences() {
    let one = read(&landing().recording);
    let other =
        read(&flown(&planned(0.0, "none", &["controller.metric.max_descend_m_s=0.7"])).recording);
    let texts = texts(&document(&one, Some(&other)).unwrap());
    let has = |text: &str| texts.iter().any(|it| it == text);
    assert!(has("A: Height over the pad") && has("B: Height over the pad"));
    assert!(texts.iter().any(|it| it.contains("metric.max_descend_m_s")), "{texts:?}");
    assert!(has("B less A") && has("In numbers"));
}

#[test]
fn texts_of_the_autopilot_stay_text() {
    let mut flight = read(&landing().recording);
    flight.name = "<b>name</b>".to_owned();
    flight.statuses.iter_mut().for_each(|status| status.why = "<script>alert(1)</script>".into());
    let html = page(&flight).unwrap();
    assert!(!html.contains("<script>") && !html.contains("<b>name"), "escaped");
}

#[test]
fn a_vehicle_that_landed_by_a_command_was_not_led_to_the_marker() {
    let mut flight = read(&landing().recording);
    assert!(summary(&flight).is_on_the_pad());
    let why = "on the ground, disarmed: the operator's command to land here";
    why.clone_into(&mut flight.statuses.last_mut().unwrap().why);
    let found = summary(&flight);
    assert!(!found.is_on_the_pad());
    let outcome = "landed, but not led to the marker: the operator's command to land here";
    assert_eq!(found.outcome(), outcome);
    assert!(page(&flight).unwrap().contains("class=\"outcome bad\""));
}

#[test]
fn a_touchdown_beside_the_pad_is_reported() {
    let mut flight = read(&landing().recording);
    let touchdowns = flight.truth.iter_mut().filter_map(|truth| truth.touchdown.as_mut());
    touchdowns.for_each(|touchdown| touchdown.error_m = 0.44);
    let found = summary(&flight);
    assert_eq!(found.outcome(), "landed, beside the pad: 0.440 m from its centre");
    assert!(!found.is_on_the_pad());
    assert!(page(&flight).unwrap().contains("class=\"outcome bad\""));
}

#[test]
fn a_setting_that_a_service_changed_is_reported_with_its_time() {
    let about = About { program: "test".to_owned(), facts: BTreeMap::new(), utc_offset_ns: 0 };
    let mut recording = Vec::new();
    let mut writer = Writer::new(&mut recording, &about).unwrap();
    let write = |writer: &mut Writer<&mut Vec<u8>>, is_thorough: bool, received_ns: i64| {
        let configuration = Configuration {
            service: "detector".to_owned(),
            instance: "main".to_owned(),
            host: "drone".to_owned(),
            version: "0.1.0".to_owned(),
            toml: format!("thorough = {is_thorough}\n[tracking]\nenabled = true\n"),
        };
        let (key, payload) = ("config/detector/main", encode(&configuration));
        writer.receive(Received { key, payload: &payload, attachment: b"", received_ns }).unwrap();
    };
    for (is_thorough, at_s) in [(false, 3), (false, 6), (true, 8), (true, 9)] {
        write(&mut writer, is_thorough, at_s * 1_000_000_000);
    }
    writer.finish().unwrap();
    let flight = read(&recording);
    let change = flight.changes.first().unwrap();
    assert_eq!((flight.changes.len(), change.received_ns), (1, 8_000_000_000));
    let (lines, _) = report::journal::of(&flight);
    let line = lines.iter().find(|line| line.source == "detector/main").unwrap();
    assert_eq!(line.text, "setting `thorough` changed from false to true");
    assert!((line.time_s - flight.at_s(8_000_000_000)).abs() < 1e-9, "{line:?}");
    assert!(page(&flight).unwrap().contains("setting `thorough` changed from false to true"));
}

#[test]
fn pictures_in_which_it_was_too_dark_for_a_marker_are_reported() {
    let report = |level: u8| {
        let about = About { program: "test".to_owned(), facts: BTreeMap::new(), utc_offset_ns: 0 };
        let mut recording = Vec::new();
        let mut writer = Writer::new(&mut recording, &about).unwrap();
        for sequence in 0..30 {
            let received_ns = 100_000_000 * sequence as i64;
            let header = FrameHeader {
                sequence,
                stamp_ns: received_ns,
                width: 64,
                height: 48,
                exposure_ns: 20_000_000,
                ..FrameHeader::sample()
            };
            let (pixels, attachment) = (vec![level; 64 * 48], encode(&header));
            let key = "camera/down/frame";
            let frame = Received { key, payload: &pixels, attachment: &attachment, received_ns };
            writer.frame(frame, &header, &Picture::Pixels).unwrap();
            let found = Detections {
                detector: "main".to_owned(),
                header,
                detections: Vec::new(),
                stages: Vec::new(),
            };
            let (key, payload) = ("detector/main/detections", encode(&found));
            let found = Received { key, payload: &payload, attachment: b"", received_ns };
            writer.receive(found).unwrap();
        }
        writer.finish().unwrap();
        let flight = read(&recording);
        assert_eq!(flight.light["down"].len(), 3, "one of each second");
        (summary(&flight), page(&flight).unwrap())
    };
    let (dark, html) = report(5);
    let sentence = "the pictures of camera `down` are too dark for a marker: in the median their mean is 2.0 % of white";
    assert!(dark.light[0].starts_with(sentence), "{:?}", dark.light);
    assert!(dark.line().contains(sentence), "{}", dark.line());
    assert!(
        html.matches(sentence).count() >= 2
            && html.contains("Brightness and noise of the pictures")
    );
    assert!(html.contains("20.0 ms"));
    let (grey, html) = report(120);
    assert_eq!(grey.light, Vec::<String>::new());
    assert!(html.contains("Brightness and noise of the pictures") && html.contains("47.1 %"));
}
