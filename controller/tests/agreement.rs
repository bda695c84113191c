//! Which of several detectors are believed, whatever their ranges, and whatever their order.

use std::collections::VecDeque;

use controller::agreement::{
    Fault, Sight, Sights, Tolerance, Voter, agree, dispute, faults, within,
};
use proptest::prelude::*;

const TOLERANCE: Tolerance = Tolerance { base_m: 0.1, per_m: 0.03 };
const NAMES: [&str; 6] = ["a", "b", "c", "d", "e", "f"];
/// Frames, more than a conclusion takes.
const FRAMES: i64 = 20;

/// A detector that sees the marker at one place in all frames.
fn steady(position_m: [f64; 3]) -> Sights {
    (0..FRAMES).map(|stamp| (stamp, Some(Sight { position_m: Some(position_m) }))).collect()
}

fn voters(all: &[Sights]) -> Vec<Voter<'_>> {
    NAMES.iter().zip(all).map(|(name, sights)| Voter { name, sights }).collect()
}

fn is_outvoted(fault: Option<&Fault>) -> bool {
    matches!(fault, Some(Fault::Outvoted { .. }))
}

/// A marker straight below, at this range.
fn below(range_m: f64) -> Sights {
    steady([0.0, 0.0, range_m])
}

#[test]
fn of_two_of_which_one_takes_the_marker_for_larger_none_is_outvoted() {
    // 4.2 % of 8.6 m lie between what both ranges allow.
    for range_m in (1..400).map(|step| f64::from(step) * 0.05) {
        for factor in [1.02, 1.042, 1.1] {
            let all = [below(range_m), below(range_m * factor)];
            let [right, wrong] = [0, 1].map(|i| voters(&all)[i]);
            assert_eq!(faults(&[right, wrong], TOLERANCE), [None, None], "{range_m} {factor}");
            let is_told = dispute(right, &[wrong], TOLERANCE).is_some();
            assert_eq!(
                is_told,
                dispute(wrong, &[right], TOLERANCE).is_some(),
                "{range_m} {factor}"
            );
            assert_ne!(is_told, agree(right, wrong, TOLERANCE), "{range_m} {factor}");
        }
    }
}

#[test]
fn the_farther_of_two_gives_the_range() {
    let at = |range_m: f64| [0.0, 0.0, range_m];
    // 0.1 m and 3 % of 10 m are 0.4 m, of 9.6 m 0.388 m.
    assert!(within(TOLERANCE, at(9.605), at(10.0)) && within(TOLERANCE, at(10.0), at(9.605)));
    assert!(!within(TOLERANCE, at(9.595), at(10.0)) && !within(TOLERANCE, at(10.0), at(9.595)));
}

#[test]
fn two_that_agree_outvote_a_third_and_not_one_that_agrees_with_either() {
    let all = [below(5.0), below(5.1), below(7.0)];
    let found = faults(&voters(&all), TOLERANCE);
    assert_eq!(found[..2], [None, None]);
    assert!(matches!(found[2], Some(Fault::Outvoted { by: 2, .. })), "{found:?}");
    // The second agrees with both others, which differ.
    let all = [below(5.0), below(5.2), below(5.4)];
    assert_eq!(faults(&voters(&all), TOLERANCE), [None, None, None]);
    // Two against two.
    let all = [below(5.0), below(5.0), below(7.0), below(7.0)];
    assert_eq!(faults(&voters(&all), TOLERANCE), [None, None, None, None]);
}

fn position() -> impl Strategy<Value = [f64; 3]> {
    // Few directions and ranges near each other, so that some pairs agree only just.
    (0.2..15.0_f64, 0.9..1.1_f64, -0.3..0.3_f64)
        .prop_map(|(range_m, factor, side_m)| [side_m, 0.0, range_m * factor])
}

fn near(range_m: f64) -> impl Strategy<Value = [f64; 3]> {
    (0.9..1.1_f64, -0.3..0.3_f64).prop_map(move |(factor, side_m)| [side_m, 0.0, range_m * factor])
}

/// What a detector saw: the marker about a place, without a place, or nothing, in some of the frames.
fn sights(range_m: f64) -> impl Strategy<Value = Sights> {
    let sight = prop_oneof![
        6 => near(range_m).prop_map(|position_m| Some(Sight { position_m: Some(position_m) })),
        1 => Just(Some(Sight { position_m: None })),
        1 => Just(None),
    ];
    prop::collection::vec((prop::bool::weighted(0.8), sight), FRAMES as usize).prop_map(|frames| {
        let searched = (0..).zip(frames).filter(|(_, (is_searched, _))| *is_searched);
        searched.map(|(stamp, (_, sight))| (stamp, sight)).collect::<VecDeque<_>>()
    })
}

fn several() -> impl Strategy<Value = Vec<Sights>> {
    (0.2..15.0_f64).prop_flat_map(|range_m| {
        let steady = near(range_m).prop_map(steady);
        prop::collection::vec(prop_oneof![3 => steady, 1 => sights(range_m)], 2..=NAMES.len())
    })
}

proptest! {
    #[test]
    fn of_two_nobody_is_ever_outvoted(one in position(), other in position()) {
        let all = [steady(one), steady(other)];
        prop_assert_eq!(faults(&voters(&all), TOLERANCE), [None, None]);
    }

    #[test]
    fn of_two_whatever_they_see_nobody_is_ever_outvoted(all in several()) {
        let found = faults(&voters(&all[..2]), TOLERANCE);
        prop_assert!(!found.iter().any(|fault| is_outvoted(fault.as_ref())), "{:?}", found);
    }

    #[test]
    fn of_a_pair_the_order_does_not_matter(all in several()) {
        let voters = voters(&all);
        for one in &voters {
            for other in &voters {
                let both = [(*one, *other), (*other, *one)];
                let [there, back] = both.map(|(a, b)| agree(a, b, TOLERANCE));
                prop_assert_eq!(there, back);
                let [there, back] = both.map(|(a, b)| dispute(a, &[b], TOLERANCE).map(|it| it.apart_m));
                prop_assert_eq!(there, back);
            }
        }
    }

    #[test]
    fn whom_others_outvote_differs_from_at_least_two_that_agree(all in several()) {
        let voters = voters(&all);
        let found = faults(&voters, TOLERANCE);
        for (voter, fault) in voters.iter().zip(&found) {
            let Some(Fault::Outvoted { by, .. }) = fault else { continue };
            let differs = |it: &&Voter<'_>| dispute(*voter, &[**it], TOLERANCE).is_some();
            let opponents: Vec<_> = voters.iter().filter(differs).collect();
            prop_assert!(*by >= 2 && *by <= opponents.len(), "{:?}", found);
            let agrees = |one: &Voter<'_>| {
                opponents.iter().filter(|it| it.name != one.name && agree(*one, ***it, TOLERANCE)).count()
            };
            prop_assert!(opponents.iter().any(|it| agrees(it) + 1 == *by), "{:?}", found);
        }
        prop_assert!(!found.iter().all(|it| is_outvoted(it.as_ref())), "{:?}", found);
    }

    #[test]
    fn who_is_outvoted_does_not_depend_on_the_order(all in several()) {
        let mut voters = voters(&all);
        let outvoted = |voters: &[Voter<'_>]| {
            let found = faults(voters, TOLERANCE);
            let named = voters.iter().zip(found).filter(|(_, fault)| is_outvoted(fault.as_ref()));
            let mut names: Vec<_> = named.map(|(voter, _)| voter.name.to_owned()).collect();
            names.sort();
            names
        };
        let before = outvoted(&voters);
        voters.reverse();
        prop_assert_eq!(before, outvoted(&voters));
    }
}
