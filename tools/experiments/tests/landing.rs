//! Tests flights of the landing experiment in lock-step: the same to the bit for a seed, with modelled vision as with
//! rendered frames, and no unsafe touchdown under any named fault.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use experiments::landing::fault::Fault;
use experiments::landing::flight::{fly, fly_recorded};
use experiments::landing::outcome::{Ending, Outcome};
use experiments::landing::plan::{HEIGHTS_M, Plan, Planned, Request, Values, Vision};
use experiments::landing::{self, Watch, in_parallel};
use experiments::results::Folder;

fn plan(vision: Vision, flights: u64) -> Plan {
    let one = |value| Values::List(vec![value]);
    Plan { vision, flights, wind: one(3.0), height: one(4.0), offset: one(0.5), ..Plan::default() }
}

fn fly_all(flights: &[Planned]) -> Vec<Outcome> {
    in_parallel(flights, 2, |planned| fly(planned, None)).unwrap_or_default()
}

/// Checks a flight; one that fails is flown again for a recording, which the failure names.
#[expect(clippy::panic, reason = "a test fails by a panic")]
fn expect(planned: &Planned, outcome: &Outcome, holds: bool) {
    if holds {
        return;
    }
    let name = format!("failed-{}-seed-{}.mcap", planned.fault.name(), planned.seed);
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let recorded = File::create(&path)
        .map_err(anyhow::Error::from)
        .and_then(|file| fly_recorded(planned, BufWriter::new(file)));
    let left = match recorded {
        Ok(_) => format!("`alight report {}` explains it", path.display()),
        Err(problem) => format!("no recording of it: {problem:#}"),
    };
    panic!("{outcome:?}\n{}\n{left}", planned.command());
}

#[test]
fn the_same_seed_gives_the_same_flight_to_the_bit() {
    for (vision, flights) in [(Vision::Modelled, 3), (Vision::Rendered, 1)] {
        for planned in plan(vision, flights).flights() {
            let (mut first, mut second) = (Vec::new(), Vec::new());
            let outcome = fly(&planned, Some(&mut first)).unwrap();
            assert_eq!(outcome, fly(&planned, Some(&mut second)).unwrap());
            assert_eq!(format!("{first:?}"), format!("{second:?}"));
            assert_eq!(outcome.ending, Ending::Landed, "{outcome:?}");
        }
    }
}

#[test]
fn a_landing_begins_at_every_height_that_is_accepted() {
    for height_m in [*HEIGHTS_M.start(), *HEIGHTS_M.end()] {
        let height = Values::List(vec![height_m]);
        let planned = Plan { height, ..plan(Vision::Modelled, 1) }.flights().remove(0);
        let mut samples = Vec::new();
        fly(&planned, Some(&mut samples)).unwrap();
        assert!(!samples.is_empty(), "{height_m} m");
    }
}

#[test]
fn modelled_vision_lands_as_rendered_vision_does() {
    let [rendered, modelled] = [Vision::Rendered, Vision::Modelled].map(|vision| {
        let outcomes = fly_all(&plan(vision, 4).flights());
        assert_eq!(outcomes.len(), 4);
        let mean = |of: fn(&Outcome) -> Option<f64>| {
            outcomes.iter().map(|o| of(o).unwrap_or(f64::INFINITY)).sum::<f64>() / 4.0
        };
        println!("{}: {:.4} m", vision.name(), mean(|o| o.error_m));
        [mean(|o| o.error_m), mean(|o| o.disarm_s), mean(|o| Some(o.detections as f64))]
    });
    assert!((rendered[0] - modelled[0]).abs() < 0.015, "error {rendered:?} {modelled:?}");
    assert!((rendered[1] - modelled[1]).abs() < 3.0, "time {rendered:?} {modelled:?}");
    assert!((rendered[2] / modelled[2] - 1.0).abs() < 0.3, "detections {rendered:?} {modelled:?}");
}

#[test]
fn no_fault_leads_to_an_unsafe_touchdown() {
    let faults = Fault::all().collect();
    let flights = Plan { faults, ..plan(Vision::Modelled, 3) }.flights();
    let outcomes = fly_all(&flights);
    assert_eq!(outcomes.len(), flights.len());
    for (planned, outcome) in flights.iter().zip(&outcomes) {
        let is_ended = outcome.ending != Ending::Unfinished;
        expect(planned, outcome, !outcome.is_unsafe() && is_ended);
    }
}

/// The flights of these seeds in wind of 4 m/s, from 10 m, as `alight experiment landing` flies them.
fn with_fault(fault: &str, seeds: &[u64]) -> Vec<(Planned, Outcome)> {
    let wind = Values::List(vec![4.0]);
    fly_seeds(&Plan { wind, ..Plan::default() }, fault, seeds)
}

/// The flights of a plan with these seeds and this fault.
fn fly_seeds(plan: &Plan, fault: &str, seeds: &[u64]) -> Vec<(Planned, Outcome)> {
    let flights = seeds.iter().flat_map(|seed| {
        let faults = fault.parse().into_iter().collect();
        Plan { faults, flights: 1, seed: *seed, ..plan.clone() }.flights()
    });
    let flights = flights.collect::<Vec<_>>();
    let outcomes = fly_all(&flights);
    assert_eq!(outcomes.len(), seeds.len());
    flights.into_iter().zip(outcomes).collect()
}

#[test]
fn a_second_marker_is_rejected_while_the_first_is_out_of_view() {
    // With these seeds the vehicle tilts so that for a while only the wrong marker is in view.
    for (planned, outcome) in with_fault("wrong-marker", &[38, 54, 58, 81, 151, 265]) {
        let holds = outcome.is_within(0.1) || outcome.ending == Ending::Aborted;
        expect(&planned, &outcome, holds);
    }
}

#[test]
fn a_gust_close_to_the_ground_does_not_cause_a_sliding_touchdown() {
    for (planned, outcome) in with_fault("gust", &[26, 64, 68, 74, 92, 129]) {
        expect(&planned, &outcome, outcome.is_within(0.3) && !outcome.is_unsafe());
    }
}

#[test]
fn frames_with_wrong_stamps_do_not_lead_it_hard_onto_the_ground() {
    // With this seed three of them close to the ground show a pad that sinks.
    let plan = Plan { wind: Values::List(vec![5.0]), ..Plan::default() };
    for (planned, outcome) in fly_seeds(&plan, "stamp-jumps", &[770_039]) {
        let is_soft = outcome.sink_m_s.is_some_and(|sink| sink < 0.75);
        expect(&planned, &outcome, is_soft && !outcome.is_unsafe());
    }
}

#[test]
fn a_vehicle_that_has_touched_down_does_not_leave_the_ground_again() {
    // On these seeds the estimate became too unsure, ambiguous or false just before the contact or soon after it.
    let plan = Plan {
        wind: Values::Range(0.0, 9.0),
        turbulence: Values::Range(0.0, 3.0),
        height: Values::Range(2.0, 30.0),
        ..Plan::default()
    };
    let wandering =
        [120_002, 120_010, 120_024, 120_061, 120_076, 120_091, 120_137, 120_175, 120_241, 150_089];
    let confused = [120_006, 120_020, 120_026, 120_043];
    let jumping = [120_148, 120_166, 120_218];
    for (fault, seeds) in [
        ("velocity-wander", &wandering[..]),
        ("wrong-marker", &confused),
        ("stamp-jumps", &jumping),
    ] {
        for (planned, outcome) in fly_seeds(&plan, fault, seeds) {
            expect(&planned, &outcome, !outcome.has_left_ground() && outcome.is_within(0.3));
        }
    }
}

#[test]
fn heaving_and_moving_pads_are_landed_on() {
    for (planned, outcome) in with_fault("pad-heaves", &[4, 8, 29, 43]) {
        let is_gentle = outcome.sink_m_s.is_some_and(|sink| sink <= 0.6);
        expect(&planned, &outcome, outcome.is_within(0.1) && is_gentle);
    }
    for (planned, outcome) in with_fault("pad-moves-4.2", &[3, 19, 24, 31]) {
        expect(&planned, &outcome, outcome.is_within(0.1));
    }
}

#[test]
fn px4_lands_guided_and_by_its_own_precision_landing() {
    let fly_with = |more: &[&str]| {
        let always = ["simulator.autopilot.firmware=\"px4\"", "controller.start=takeoff"];
        let set = always.iter().chain(more).map(|setting| (*setting).to_owned()).collect();
        let one = |value| Values::List(vec![value]);
        let plan = Plan {
            set,
            wind: one(2.0),
            height: one(0.0),
            offset: one(1.0),
            ..plan(Vision::Modelled, 2)
        };
        let outcomes = fly_all(&plan.flights());
        assert_eq!(outcomes.len(), 2);
        for outcome in outcomes {
            assert!(outcome.is_within(0.1), "{more:?}: {outcome:?}");
        }
    };
    fly_with(&[]);
    let precision = "simulator.autopilot.precision_landing=true";
    fly_with(&["controller.mode=\"landing-target\"", precision]);
}

#[test]
fn late_detections_are_used() {
    for (planned, outcome) in with_fault("latency-300ms", &[1, 2, 3]) {
        expect(&planned, &outcome, outcome.is_within(0.1));
    }
}

#[test]
fn the_worst_flight_of_each_row_is_written_as_a_recording() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("worst-flights");
    let mut results = Folder::claim(&folder, true).unwrap();
    let wind = Values::List(vec![0.0, 3.0]);
    let plan = Plan { wind, ..plan(Vision::Modelled, 2) };
    let request = Request { plan, jobs: 2, recordings: 1, ..Request::default() };
    let watch = Watch { progress: &|_, _| {}, is_interrupted: &|| false };
    let report = landing::run(&request, &mut results, watch).unwrap().report;
    let names: Vec<&str> = report
        .lines()
        .filter_map(|line| line.strip_prefix("- `row-")?.split_once('`').map(|(name, _)| name))
        .collect();
    assert_eq!(names.len(), 2, "{report}");
    for name in names {
        let recording =
            std::fs::read(folder.join("recordings").join(format!("row-{name}"))).unwrap();
        let mut statuses = 0;
        let reading = flightlog::read(&recording, |entry| {
            statuses += usize::from(
                matches!(entry, flightlog::Entry::Message(it) if it.key == "controller/status"),
            );
        });
        let reading = reading.unwrap();
        assert!(reading.is_ended && reading.damage.is_empty() && statuses > 20, "{reading:?}");
        let mut tapes = flightlog::TapeReader::default();
        tapes.read(&recording).unwrap();
        assert_eq!(tapes.tapes().len(), 1, "{name}");
    }
}

#[test]
fn an_interruption_leaves_the_results_of_the_flights_that_were_flown() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("interrupted-flights");
    let mut results = Folder::claim(&folder, true).unwrap();
    let plan = plan(Vision::Modelled, 5);
    let request = Request { plan, jobs: 1, recordings: 1, ..Request::default() };
    let flown = AtomicUsize::new(0);
    let mut run = |flights: usize| {
        flown.store(0, Ordering::Relaxed);
        let watch = Watch {
            progress: &|done, _| flown.store(done, Ordering::Relaxed),
            is_interrupted: &|| flown.load(Ordering::Relaxed) >= flights,
        };
        landing::run(&request, &mut results, watch).unwrap()
    };
    let landings = run(2);
    assert_eq!((landings.flown, landings.planned), (2, 5));
    assert!(landings.report.contains("after 2 of 5 flights"), "{}", landings.report);
    let lines = std::fs::read_to_string(folder.join("flights.jsonl")).unwrap();
    assert_eq!(lines.lines().count(), 2);
    assert_eq!(std::fs::read_to_string(folder.join("report.md")).unwrap(), landings.report);
    assert_eq!(run(0).flown, 0);
}

#[test]
fn old_results_outlast_a_run_without_results() {
    let folder = tempfile::tempdir().unwrap();
    let old = folder.path().join("flights.csv");
    std::fs::write(&old, "old").unwrap();
    let run = |set: &[&str], is_interrupted: bool| {
        let set = set.iter().map(|&it| it.to_owned()).collect();
        let plan = Plan { set, ..plan(Vision::Modelled, 1) };
        let request = Request { plan, jobs: 1, recordings: 0, ..Request::default() };
        let watch = Watch { progress: &|_, _| {}, is_interrupted: &|| is_interrupted };
        let mut results = Folder::claim(folder.path(), true).unwrap();
        landing::run(&request, &mut results, watch)
    };
    run(&["simulator.no_such_key=1"], false).unwrap_err();
    assert_eq!(run(&[], true).unwrap().flown, 0);
    assert_eq!(std::fs::read_to_string(&old).unwrap(), "old");
    assert_eq!(run(&[], false).unwrap().flown, 1);
    assert_ne!(std::fs::read_to_string(&old).unwrap(), "old");
}
