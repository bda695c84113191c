//! A lander that falls silent at any height, for ever or for a while: a table of touchdowns, all of them soft.

#![expect(clippy::print_stdout, reason = "the table of a passing run is for people to read")]

mod scene;

use landing::{Action, Alarm, Event, Phase, Reason};
use scene::{Flight, MAX_SINK_M_S, MAX_SLIDE_M_S, Sample, Scene, Silence, Then};

/// Heights over the pad at which the silence begins, in metres.
const HEIGHTS_M: [f64; 9] = [0.3, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0];

/// A flight in the wind of this speed whose lander falls silent.
fn silent(seed: u64, wind_m_s: f64, silence: Silence) -> Scene {
    let scene = if wind_m_s > 0.0 { Scene::windy(seed, wind_m_s, 1.0) } else { Scene::new(seed) };
    scene.with(|scene| {
        scene.silence = Some(silence);
        scene.limit_s = if silence.for_s.is_finite() { 120.0 } else { 40.0 };
    })
}

/// The hardest touchdowns of some flights, in m/s: downwards and sideways; zero without one.
fn worst(flights: impl Iterator<Item = Flight>) -> [f64; 2] {
    flights.filter_map(|flight| flight.touchdown).fold([0.0, 0.0], |[sink, slide], touchdown| {
        [touchdown.sink_m_s.max(sink), touchdown.slide_m_s.max(slide)]
    })
}

/// The worst touchdown for each height, as a table; fails when one is unsafe.
fn check(winds_m_s: &[f64], durations_s: &[f64], change: impl Fn(&mut Scene)) {
    let mut table = String::new();
    let mut is_safe = true;
    for wind_m_s in winds_m_s {
        for for_s in durations_s {
            table += &format!("\nwind {wind_m_s} m/s, silent for {for_s} s:");
            for below_m in HEIGHTS_M {
                let silence = Silence { below_m, for_s: *for_s, then: Then::Continues };
                let [sink, slide] =
                    worst((0..4).map(|seed| silent(seed, *wind_m_s, silence).with(&change).fly()));
                is_safe &= sink <= MAX_SINK_M_S && slide <= MAX_SLIDE_M_S;
                table += &format!(" {below_m} m: {sink:.2} {slide:.2};");
            }
        }
    }
    println!("{table}");
    assert!(is_safe, "{table}");
}

#[test]
fn silence_at_any_height_ends_in_a_soft_touchdown_or_in_none() {
    check(&[0.0, 5.0], &[f64::INFINITY, 0.5, 2.0, 5.0], |_| {});
}

/// A vehicle that brakes in a long silence has moved by less than by its velocities before and after. That is not a jump of the
/// autopilot's position, after which the pad would seem to be right below.
#[test]
fn after_a_long_silence_no_landing_is_asked_for_high_up() {
    for (below_m, for_s) in [(6.0, 7.0), (7.0, 8.0), (8.0, 8.0), (9.0, 9.0), (9.0, 12.0)] {
        for seed in 0..4 {
            let silence = Silence { below_m, for_s, then: Then::Continues };
            let flight = silent(seed, 0.0, silence).fly();
            let lands = |it: &&Sample| it.decision.phase == Phase::Final;
            let from_m = flight.samples.iter().find(lands).map(height_m);
            println!(
                "silent below {below_m} m for {for_s} s, seed {seed}: lands from {from_m:?} m"
            );
            assert!(from_m.is_some_and(|from_m| from_m < 1.0), "{below_m} {for_s} {seed}");
        }
    }
}

/// A controller that is started again resumes a landing for the same time.
#[test]
fn after_a_silence_of_more_than_15_s_nothing_descends_without_a_command() {
    for (below_m, for_s) in [(6.0, 15.5), (3.0, 20.0), (7.0, 42.0)] {
        let flight = silent(0, 0.0, Silence { below_m, for_s, then: Then::Continues }).fly();
        let mut pairs = flight.samples.windows(2);
        let end = pairs.find(|pair| pair[1].seconds - pair[0].seconds > 0.5 * for_s);
        let end_s = end.map_or(f64::INFINITY, |pair| pair[1].seconds);
        check_waits(&flight, end_s);
    }
    // The autopilot alone is silent, in a hold that ends on its own otherwise.
    let lost_s = 6.0;
    let slow = |seconds: f64, delay_s: f64| (seconds, Event::LinkDelay(delay_s));
    let alarm = |seconds: f64| (seconds, Event::Alarm(Alarm::AutopilotLost));
    for (for_s, held_for, events) in [
        (40.0, Reason::LinkSlow, vec![slow(5.0, 1.0), alarm(7.0), slow(20.0, 0.1)]),
        (40.0, Reason::LinkSlow, vec![slow(5.0, 1.0), alarm(7.0), slow(46.5, 0.1)]),
        (40.0, Reason::TargetNotFound, vec![alarm(7.0)]),
        // The alarm comes later than usual.
        (24.0, Reason::AutopilotLost, vec![alarm(lost_s + 20.0)]),
        (16.0, Reason::VehicleStale, vec![]),
    ] {
        let flight = Scene::new(0)
            .with(|scene| {
                scene.world.link_lost_s = Some((lost_s, for_s));
                scene.events = events;
                scene.limit_s = lost_s + for_s + 30.0;
                if held_for == Reason::TargetNotFound {
                    scene.config.phases.search_timeout_s = 2.0;
                    scene.camera.outage_s = Some((0.0, lost_s + for_s - 5.0));
                }
            })
            .fly();
        let held = flight.at(lost_s + for_s - 0.5).map(|it| it.decision);
        let found = held.map(|it| (it.phase, it.why));
        assert_eq!(found, Some((Phase::Hold, held_for)), "{for_s} s");
        check_waits(&flight, lost_s + for_s + 0.1);
    }
}

/// Fails where the vehicle does not hold until a command from this time on.
fn check_waits(flight: &Flight, from_s: f64) {
    let after: Vec<&Sample> = flight.samples.iter().filter(|it| it.seconds >= from_s).collect();
    assert!(after.len() > 100, "{} samples", after.len());
    for sample in after {
        let decision = sample.decision;
        let found = (decision.phase, decision.why);
        assert_eq!(found, (Phase::Hold, Reason::Standstill), "after {} s", sample.seconds);
        let stays =
            matches!(decision.action, Action::Velocity { velocity, .. } if velocity.z() <= 0.0);
        assert!(stays, "{decision:?}");
    }
}

#[test]
fn an_autopilot_with_a_long_timeout_is_descended_with_slowly() {
    check(&[0.0], &[f64::INFINITY, 2.0], |scene| scene.setpoint_timeout_s = 3.0);
}

#[test]
fn an_autopilot_that_does_not_report_its_timeout_is_taken_for_the_slowest() {
    check(&[0.0], &[f64::INFINITY], |scene| {
        scene.setpoint_timeout_s = 3.0;
        scene.is_timeout_known = false;
    });
}

#[test]
fn a_short_timeout_costs_no_time() {
    let time_s = |seed: u64, timeout_s: f64| {
        let scene = Scene::new(seed).with(|scene| scene.setpoint_timeout_s = timeout_s);
        scene.fly().touchdown_s.unwrap_or(f64::INFINITY)
    };
    let mean_s = |timeout_s: f64| (0..10).map(|seed| time_s(seed, timeout_s)).sum::<f64>() / 10.0;
    let (short_s, long_s) = (mean_s(0.5), mean_s(3.0));
    println!("until the touchdown: {short_s:.2} s, with a timeout of 3 s {long_s:.2} s");
    assert!(short_s < 13.0 && short_s < long_s - 1.5, "{short_s} {long_s}");
}

/// Height over the position of the first touchdown that no flight has left the ground with, in metres.
const MAX_HOP_M: f64 = 0.15;

/// Time on the ground after which a vehicle stands, in seconds.
const MIN_STANDING_S: f64 = 0.3;

fn height_m(sample: &Sample) -> f64 {
    sample.pad.z() - sample.position.z()
}

/// True where the lander has the vehicle climb.
fn climbs(sample: &Sample) -> bool {
    matches!(sample.decision.action, Action::Velocity { velocity, .. } if velocity.z() < 0.0)
}

/// Flights whose lander is silent below this height: vehicles that stand at its end must stay on the ground. One that hovers so
/// low that wind lets it touch the ground may fly on: a lander without a position of the pad has it climb, where wind has lifted it before.
/// Returns how many stood.
fn check_stays_down(below_m: f64, then: Then, seeds: std::ops::Range<u64>) -> u32 {
    let mut table = String::new();
    let (mut is_safe, mut stood) = (true, 0);
    for wind_m_s in [0.0, 5.0] {
        for for_s in [1.0, 2.0, 3.0, 5.0, 7.0] {
            for seed in seeds.clone() {
                let flight = silent(seed, wind_m_s, Silence { below_m, for_s, then })
                    .with(|scene| scene.is_ground_reported_late = true)
                    .fly();
                let mut pairs = flight.samples.windows(2);
                let end = pairs.find(|pair| pair[1].seconds - pair[0].seconds > 0.5 * for_s);
                let Some(end) = end.map(|pair| &pair[1]) else { continue };
                let after = flight.samples.iter().filter(|it| it.seconds > end.seconds);
                let mut unmoved = after.clone().take_while(|it| !climbs(it));
                let is_lifted = then == Then::Another
                    && wind_m_s > 0.0
                    && unmoved.any(|it| it.on_ground_s == 0.0);
                if end.on_ground_s < MIN_STANDING_S || is_lifted {
                    continue;
                }
                let hop_m = after.map(height_m).fold(0.0, f64::max);
                stood += 1;
                is_safe &= hop_m <= MAX_HOP_M && flight.phase == Phase::Landed;
                table += &format!(
                    "\nwind {wind_m_s} m/s, silent below {below_m} m for {for_s} s, seed {seed}: {hop_m:.2} m, {:?}, {:.3} m off",
                    flight.phase, flight.error_m
                );
            }
        }
    }
    println!("{table}");
    println!("{stood} vehicles stood");
    assert!(is_safe, "{table}");
    stood
}

#[test]
fn a_vehicle_that_touched_down_meanwhile_stays_on_the_ground() {
    let stood = [0.3, 0.4, 0.5].map(|below_m| check_stays_down(below_m, Then::Continues, 0..16));
    assert!(stood.iter().sum::<u32>() > 100, "{stood:?}");
}

#[test]
fn a_lander_that_takes_over_leaves_a_vehicle_on_the_ground_that_touched_down_meanwhile() {
    for then in [Then::AnotherWithPad, Then::Another] {
        let stood = [0.3, 0.4, 0.5].map(|below_m| check_stays_down(below_m, then, 100..116));
        assert!(stood.iter().sum::<u32>() > 100, "{then:?}: {stood:?}");
    }
}
