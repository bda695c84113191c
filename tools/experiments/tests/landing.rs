//! Landings in lock-step: repeatable to the bit, alike with rendered and with modelled vision, and safe whatever goes wrong.

use experiments::landing::fault::Fault;
use experiments::landing::flight::fly;
use experiments::landing::in_parallel;
use experiments::landing::outcome::{Ending, Outcome};
use experiments::landing::plan::{Plan, Planned, Values, Vision};

fn plan(vision: Vision, flights: u64) -> Plan {
    let one = |value| Values::List(vec![value]);
    Plan { vision, flights, wind: one(3.0), height: one(4.0), offset: one(0.5), ..Plan::default() }
}

fn fly_all(flights: &[Planned]) -> Vec<Outcome> {
    in_parallel(flights, 2, |planned| fly(planned, None)).unwrap_or_default()
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
        assert!(!outcome.is_unsafe(), "{outcome:?}: {}", planned.command());
        assert!(outcome.ending != Ending::Unfinished, "{outcome:?}: {}", planned.command());
    }
}
