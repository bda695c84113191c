//! The axis check finds a wrong mount before the descent, and never rejects a right one.

mod scene;

use std::f64::consts::{FRAC_PI_2, PI};

use landing::{OperatorCommand, Phase, Reason};
use scene::cases::{FAULTS, WINDS, anything};
use scene::{Flight, Sample, Scene};

fn doubts(sample: &Sample) -> bool {
    use Reason::{AttitudeSign, CameraTurned, ImageMirrored};
    matches!(sample.decision.why, CameraTurned | ImageMirrored | AttitudeSign)
}

/// When it doubted the mount, how far the vehicle had gone sideways by then, and how deep it went at all.
fn doubt(flight: &Flight) -> (f64, f64, f64) {
    let start = flight.samples[0].position;
    let first = flight.samples.iter().find(|sample| doubts(sample));
    let gone_m = first.map_or(f64::NAN, |s| (s.position - start).horizontal_norm());
    let deepest = flight.samples.iter().map(|s| s.position.z() - start.z()).fold(0.0, f64::max);
    (first.map_or(f64::NAN, |sample| sample.seconds), gone_m, deepest)
}

#[test]
fn a_wrong_mount_is_found_before_the_descent() {
    for (name, turned, mirrored) in [
        ("turned by 90 degrees", FRAC_PI_2, false),
        ("turned by -90 degrees", -FRAC_PI_2, false),
        ("turned by 180 degrees", PI, false),
        ("mirrored", 0.0, true),
        ("mirrored and turned by 90 degrees", FRAC_PI_2, true),
    ] {
        for seed in 0..6 {
            for calm in [true, false] {
                let scene = if calm { Scene::new(seed) } else { Scene::windy(seed, 5.0, 1.0) };
                let flight =
                    Scene { camera_turned_rad: turned, mirrored, limit_s: 20.0, ..scene }.fly();
                let (at_s, gone_m, deepest_m) = doubt(&flight);
                println!(
                    "{name}, seed {seed}, calm {calm}: {at_s:.1} s, {gone_m:.1} m sideways, {deepest_m:.1} m down"
                );
                assert_eq!(flight.phase, Phase::Hold, "{name}");
                assert!(at_s < 8.0 && gone_m < 4.0 && deepest_m < 2.5);
            }
        }
    }
}

#[test]
fn a_resumed_landing_looks_at_the_axes_again() {
    let turned = || Scene { camera_turned_rad: PI, limit_s: 20.0, ..Scene::new(1) };
    let (doubted_s, ..) = doubt(&turned().fly());
    let resumed_s = doubted_s + 1.0;
    let commands = vec![(0.0, OperatorCommand::Start), (resumed_s, OperatorCommand::Resume)];
    let flight = Scene { commands, ..turned() }.fly();
    let after = flight.at(resumed_s + 0.1).unwrap();
    assert_ne!(after.decision.phase, Phase::Hold, "as was answered");
    let (_, _, deepest_m) = doubt(&flight);
    assert!(deepest_m < 2.5, "{deepest_m} m");
}

#[test]
fn a_right_mount_is_never_doubted() {
    let cases = FAULTS.into_iter().chain(WINDS).map(|(name, scene)| (name, scene, 4));
    let mut flights = 0;
    for (name, scene, seeds) in cases.chain([("anything", anything as fn(u64) -> Scene, 40)]) {
        for seed in 1000..1000 + seeds {
            let flight = scene(seed).fly();
            assert!(!flight.samples.iter().any(doubts), "{name}, seed {seed}");
            flights += 1;
        }
    }
    println!("{flights} flights");
}
