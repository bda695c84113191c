//! Errors, speeds at the touchdown and times of hundreds of modelled landings, in calm air, wind and with faults.
//! `examples/landings.rs` flies the same cases in thousands and prints the tables.

mod scene;

use scene::cases::{Case, FAULTS, MOVING, WINDS, anything};
use scene::report::{HEADER, median, quantile, row, worst};
use scene::{Flight, Scene};

fn fly(flights: u64, scene: fn(u64) -> Scene) -> Vec<Flight> {
    (0..flights).map(|seed| Flight { samples: Vec::new(), ..scene(seed).fly() }).collect()
}

fn case(cases: &[Case], name: &str) -> Option<fn(u64) -> Scene> {
    cases.iter().find(|case| case.0 == name).map(|case| case.1)
}

fn disarm_s(flight: &Flight) -> f64 {
    flight.disarm_s.unwrap_or(f64::INFINITY)
}

#[test]
fn calm_and_wind_are_landed_in_as_declared() {
    println!("{HEADER}");
    // Half a second of it is the axis check, which a vehicle that took off in view of the pad has already
    // passed.
    for (name, error_m, worst_m, seconds) in [
        ("calm", 0.01, 0.03, 12.3),
        ("wind 5 m/s, turbulence 1", 0.02, 0.06, 14.0),
        ("wind 5 m/s, turbulence 3", 0.025, 0.08, 14.6),
        ("wind 8 m/s, turbulence 1", 0.04, 0.1, 20.0),
    ] {
        let flights = fly(30, case(&WINDS, name).unwrap());
        println!("{}", row(name, &flights));
        let error = |f: &Flight| f.error_m;
        assert!(median(&flights, error) <= error_m, "{name}");
        assert!(worst(&flights, error) <= worst_m, "{name}");
        assert!(median(&flights, disarm_s) <= seconds, "{name}");
        for touchdown in flights.iter().filter_map(|f| f.touchdown) {
            assert!(
                touchdown.sink_m_s <= 0.6 && touchdown.slide_m_s <= 0.25,
                "{name}: {touchdown:?}"
            );
        }
    }
}

#[test]
fn too_much_wind_ends_in_an_abort_and_never_in_a_crash() {
    let flights = fly(5, case(&WINDS, "wind 12 m/s (too much)").unwrap());
    println!("{HEADER}\n{}", row("wind 12 m/s", &flights));
    assert!(flights.iter().all(|f| !f.is_unsafe()));
}

#[test]
fn no_fault_leads_to_an_unsafe_touchdown() {
    println!("{HEADER}");
    for (name, scene) in FAULTS {
        let flights = fly(12, scene);
        println!("{}", row(name, &flights));
        assert!(flights.iter().all(|f| !f.is_unsafe()), "{name}");
        assert!(flights.iter().all(|f| f.touchdown.is_some() || f.aborted), "{name} does not end");
        let error_m = quantile(&flights, 0.9, |f| f.error_m);
        assert!(error_m <= 0.1, "{name}: {error_m}");
    }
}

#[test]
fn a_moving_pad_is_landed_on() {
    println!("{HEADER}");
    for (name, scene) in MOVING {
        let flights = fly(8, scene);
        println!("{}", row(name, &flights));
        assert!(flights.iter().all(|f| !f.is_unsafe()), "{name}");
        assert!(median(&flights, |f| f.error_m) <= 0.1, "{name}");
    }
}

#[test]
fn nearly_all_of_many_different_flights_land_within_a_decimetre() {
    let flights = fly(100, anything);
    println!("{HEADER}\n{}", row("anything", &flights));
    assert!(flights.iter().all(|f| !f.is_unsafe()));
    let near = flights.iter().filter(|f| f.error_m <= 0.1).count();
    assert!(near >= 99, "{near} of 100");
}
