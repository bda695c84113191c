//! Tests flights of the campaign with faults, in lock-step: the same to the bit for a seed, a landing once
//! a fault is over, and slow touchdowns or none when processes die, links fail or the
//! autopilot reports wrong values.

use experiments::faults::flight::fly;
use experiments::faults::kind::Kind;
use experiments::faults::outcome::{Ending, Outcome};
use experiments::faults::plan::{Plan, Second};
use experiments::landing::in_parallel;
use experiments::landing::plan::Values;

fn fly_all(plan: &Plan) -> Vec<Outcome> {
    let outcomes = in_parallel(&plan.flights(), 2, fly).unwrap_or_default();
    assert_eq!(outcomes.len() as u64, plan.flights);
    outcomes
}

fn one(kind: Kind, height_m: f64, for_s: f64) -> Plan {
    Plan {
        flights: 1,
        kinds: vec![kind],
        height: Values::List(vec![height_m]),
        durations_s: vec![for_s],
        winds_m_s: vec![0.0],
        second: Second::None,
        ..Plan::default()
    }
}

#[test]
fn the_same_seed_gives_the_same_flight_to_the_bit() {
    let plan = Plan { flights: 4, seed: 11, ..Plan::default() };
    assert_eq!(fly_all(&plan), fly_all(&plan));
}

#[test]
fn a_fault_that_is_over_leaves_a_landing() {
    for kind in
        [Kind::ControllerKilled, Kind::ControllerStopped, Kind::SilenceBoth, Kind::CameraStopped]
    {
        let outcome = &fly_all(&one(kind, 8.0, 0.5))[0];
        assert_eq!(outcome.ending, Ending::Landed, "{outcome:?}");
        assert!(outcome.began && outcome.error_m.is_some_and(|error| error < 0.1), "{outcome:?}");
    }
}

#[test]
fn any_marker_is_landed_on() {
    for name in ["apriltag-36h11:7:0.2", "aruco-4x4-50:3:0.2"] {
        let marker = Some(name.parse().unwrap());
        let outcome = &fly_all(&Plan { marker, ..one(Kind::DetectorKilled, 5.0, 0.5) })[0];
        assert_eq!(outcome.ending, Ending::Landed, "{outcome:?}");
        assert!(outcome.error_m.is_some_and(|error| error < 0.1), "{outcome:?}");
        assert!(outcome.settings.contains(name) && outcome.command.contains(name), "{outcome:?}");
    }
}

#[test]
fn without_a_controller_the_vehicle_is_followed_to_its_rest() {
    let outcome = &fly_all(&one(Kind::ControllerKilled, 8.0, f64::INFINITY))[0];
    assert_eq!((outcome.ending, outcome.touches), (Ending::Hovers, 0), "{outcome:?}");
    assert!(outcome.is_over && outcome.why.contains("gone"), "{outcome:?}");
}

#[test]
fn with_killed_processes_wrong_values_or_lost_messages_the_vehicle_touches_slowly_or_not_at_all() {
    let kinds = vec![
        Kind::ControllerKilled,
        Kind::ControllerStopped,
        Kind::DetectorKilled,
        Kind::DetectorStopped,
        Kind::CameraKilled,
        Kind::CameraStopped,
        Kind::SilenceFrom,
        Kind::SilenceTo,
        Kind::SilenceBoth,
        Kind::LandedUndefined,
        Kind::LandedTakingOff,
        Kind::LandedOnGround,
        Kind::HeartbeatMissing,
        Kind::ModeLie,
        Kind::DisarmedLie,
        Kind::OldBootTime,
    ];
    let height = Values::List(vec![0.3, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0]);
    let plan = Plan { flights: 96, kinds, height, second: Second::None, ..Plan::default() };
    for outcome in fly_all(&plan) {
        assert!(!outcome.is_unsafe() && !outcome.is_unended(), "{outcome:?}");
    }
}
