//! Which of several detectors are believed, whatever their ranges, and whatever their order.

use std::collections::VecDeque;

use controller::agreement::{
    Fault, HEADING_TOLERANCE_RAD, Sight, Sights, Tolerance, Voter, agree, angle_between, dispute,
    faults, heading_rad, turned, within,
};
use geometry::{Body, Marker, Point, Rotation, Transform, Vector};
use proptest::prelude::*;

const TOLERANCE: Tolerance =
    Tolerance { base_m: 0.1, per_m: 0.03, heading_rad: Some(HEADING_TOLERANCE_RAD) };
/// Where the vehicle does not turn to the marker.
const OF_PLACES: Tolerance = Tolerance { heading_rad: None, ..TOLERANCE };
const NAMES: [&str; 6] = ["a", "b", "c", "d", "e", "f"];
/// Frames, more than a conclusion takes.
const FRAMES: i64 = 20;

/// A detector that sees the marker at one place in all frames, its upper edge forward.
fn steady(position_m: [f64; 3]) -> Sights {
    steadily(Sight { position_m: Some(position_m), heading_rad: Some(0.0), has_pose: true })
}

fn steadily(sight: Sight) -> Sights {
    (0..FRAMES).map(|stamp| (stamp, Some(sight))).collect()
}

/// A marker 5 m below, its upper edge turned clockwise by this.
fn turned_by(heading_deg: f64) -> Sights {
    let heading_rad = Some(heading_deg.to_radians());
    steadily(Sight { position_m: Some([0.0, 0.0, 5.0]), heading_rad, has_pose: true })
}

/// The pose of a marker that lies flat under a level vehicle.
fn flat(heading_deg: f64) -> Rotation<Body, Marker> {
    let turned = Rotation::<Body, Body>::from_euler(0.0, 0.0, heading_deg.to_radians());
    // With no turn its upper edge points forward, and its printed side up.
    let right = std::f64::consts::FRAC_PI_2;
    let to_body = Rotation::<Body, Marker>::from_euler(std::f64::consts::PI, 0.0, right);
    turned * to_body
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
    // 4.2 % of 8.6 m lie between the limits of both ranges.
    for range_m in (1..400).map(|step| f64::from(step) * 0.05) {
        for factor in [1.02, 1.042, 1.1] {
            let all = [below(range_m), below(range_m * factor)];
            let [right, wrong] = [0, 1].map(|i| voters(&all)[i]);
            assert_eq!(faults(&[right, wrong], TOLERANCE), [None, None], "{range_m} {factor}");
            let is_disputed = dispute(right, &[wrong], TOLERANCE).is_some();
            assert_eq!(
                is_disputed,
                dispute(wrong, &[right], TOLERANCE).is_some(),
                "{range_m} {factor}"
            );
            assert_ne!(is_disputed, agree(right, wrong, TOLERANCE), "{range_m} {factor}");
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

#[test]
fn a_detector_with_corners_in_another_order_is_outvoted_by_two_and_disputed_by_one() {
    for wrong_deg in [90.0, 180.0, -90.0, 25.0] {
        let all = [turned_by(170.0), turned_by(-179.0), turned_by(175.0 + wrong_deg)];
        let all = voters(&all);
        let found = faults(&all, TOLERANCE);
        assert_eq!(found[..2], [None, None], "{wrong_deg}");
        let Some(Fault::Outvoted { by: 2, turned_rad: Some(turned_rad), .. }) = found[2] else {
            panic!("{wrong_deg}: {found:?}");
        };
        assert!((turned_rad.to_degrees() - f64::abs(wrong_deg)).abs() < 6.1, "{turned_rad}");
        assert_eq!(faults(&all[1..], TOLERANCE), [None, None]);
        let found = dispute(all[1], &all[2..], TOLERANCE).unwrap();
        assert!(found.turned_rad.is_some() && found.apart_m == 0.0, "{found:?}");
        assert!(!agree(all[1], all[2], TOLERANCE));
        // Where the vehicle does not turn to the marker nothing comes of it.
        assert_eq!(faults(&all, OF_PLACES), [None, None, None]);
        assert_eq!(dispute(all[1], &all[2..], OF_PLACES), None);
        assert!(agree(all[1], all[2], OF_PLACES));
    }
}

#[test]
fn of_two_that_differ_in_position_alone_no_turn_is_reported() {
    let all = [below(5.0), below(7.0)];
    let all = voters(&all);
    assert_eq!(dispute(all[0], &all[1..], TOLERANCE).unwrap().turned_rad, None);
}

#[test]
fn a_heading_is_that_of_the_upper_edge_clockwise_from_above() {
    for heading_deg in [-170.0_f64, -90.0, 0.0, 30.0, 90.0, 179.0] {
        let up = flat(heading_deg) * Vector::<Marker>::new(0.0, 1.0, 0.0);
        let right = flat(heading_deg) * Vector::<Marker>::new(1.0, 0.0, 0.0);
        let out = flat(heading_deg) * Vector::<Marker>::new(0.0, 0.0, 1.0);
        let (sin, cos) = heading_deg.to_radians().sin_cos();
        assert!((up - Vector::new(cos, sin, 0.0)).norm() < 1e-9, "{up:?}");
        assert!((right - Vector::new(-sin, cos, 0.0)).norm() < 1e-9, "{right:?}");
        assert!((out - Vector::new(0.0, 0.0, -1.0)).norm() < 1e-9, "{out:?}");
        let heading = heading_rad(flat(heading_deg)).unwrap();
        assert!(angle_between(heading, heading_deg.to_radians()) < 1e-9, "{heading}");
        let pose = Transform::new(flat(heading_deg), Point::new(0.1, 0.2, 3.0));
        let sight = Sight::new(true, Some(pose));
        assert_eq!(
            sight,
            Sight { position_m: Some([0.1, 0.2, 3.0]), heading_rad: Some(heading), has_pose: true }
        );
    }
    // From behind, where it cannot be seen, it has none.
    let behind = Rotation::<Body, Body>::from_euler(std::f64::consts::PI, 0.0, 0.0) * flat(10.0);
    assert_eq!(heading_rad(behind), None);
    let without = Sight { position_m: None, heading_rad: None, has_pose: false };
    assert_eq!(Sight::new(false, None), without);
}

fn position() -> impl Strategy<Value = [f64; 3]> {
    // Few directions and ranges near each other, so that some pairs agree only just.
    (0.2..15.0_f64, 0.9..1.1_f64, -0.3..0.3_f64)
        .prop_map(|(range_m, factor, side_m)| [side_m, 0.0, range_m * factor])
}

fn near(range_m: f64) -> impl Strategy<Value = [f64; 3]> {
    (0.9..1.1_f64, -0.3..0.3_f64).prop_map(move |(factor, side_m)| [side_m, 0.0, range_m * factor])
}

/// A marker about a place with one of a few headings, of which some pairs agree only just, or with none.
fn seen(range_m: f64) -> impl Strategy<Value = Sight> {
    let heading_deg = prop::sample::select(vec![0.0, 10.0, 20.0, 90.0, 180.0, -175.0]);
    let heading_rad = prop::option::weighted(0.9, heading_deg.prop_map(f64::to_radians));
    (near(range_m), heading_rad).prop_map(|(position_m, heading_rad)| Sight {
        position_m: Some(position_m),
        heading_rad,
        has_pose: true,
    })
}

/// The sights of a detector: the marker about a place, without a place, or nothing, in some of the frames.
fn sights(range_m: f64) -> impl Strategy<Value = Sights> {
    let sight = prop_oneof![
        6 => seen(range_m).prop_map(Some),
        1 => Just(Some(Sight { position_m: None, heading_rad: None, has_pose: true })),
        1 => Just(None),
    ];
    prop::collection::vec((prop::bool::weighted(0.8), sight), FRAMES as usize).prop_map(|frames| {
        let searched = (0..).zip(frames).filter(|(_, (is_searched, _))| *is_searched);
        searched.map(|(stamp, (_, sight))| (stamp, sight)).collect::<VecDeque<_>>()
    })
}

fn several() -> impl Strategy<Value = Vec<Sights>> {
    (0.2..15.0_f64).prop_flat_map(|range_m| {
        let steady = seen(range_m).prop_map(steadily);
        prop::collection::vec(prop_oneof![3 => steady, 1 => sights(range_m)], 2..=NAMES.len())
    })
}

proptest! {
    #[test]
    fn of_two_none_is_ever_outvoted(one in position(), other in position()) {
        let all = [steady(one), steady(other)];
        prop_assert_eq!(faults(&voters(&all), TOLERANCE), [None, None]);
    }

    #[test]
    fn of_two_none_is_ever_outvoted_whatever_they_see(all in several()) {
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
                let [there, back] = both.map(|(a, b)| {
                    dispute(a, &[b], TOLERANCE).map(|it| (it.apart_m, it.turned_rad))
                });
                prop_assert_eq!(there, back);
            }
        }
    }

    #[test]
    fn an_outvoted_one_differs_from_at_least_two_that_agree(all in several()) {
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
    fn where_headings_do_not_matter_nothing_comes_of_them(all in several()) {
        let mut without = all.clone();
        let all_sights = without.iter_mut().flatten().filter_map(|(_, sight)| sight.as_mut());
        all_sights.for_each(|sight| sight.heading_rad = None);
        prop_assert_eq!(faults(&voters(&all), OF_PLACES), faults(&voters(&without), TOLERANCE));
    }

    #[test]
    fn the_two_poses_of_an_ambiguous_tilt_have_one_heading(
        heading_deg in -180.0..180.0_f64, other_deg in -180.0..180.0_f64,
        aside in 0.0..0.7_f64, about in -3.2..3.2_f64,
    ) {
        // Seen from far away the depth of each point along the line of sight may as well be the opposite.
        let ray = Vector::<Body>::new(aside.sin() * about.cos(), aside.sin() * about.sin(), aside.cos());
        let flipped = |rotation: Rotation<Body, Marker>| {
            let mirrored = |axis: Vector<Marker>| {
                let axis = rotation * axis;
                axis - ray * (2.0 * axis.coords.dot(&ray.coords))
            };
            let right = mirrored(Vector::new(1.0, 0.0, 0.0)).coords;
            let up = mirrored(Vector::new(0.0, 1.0, 0.0)).coords;
            let axes = nalgebra::Matrix3::from_columns(&[right, up, right.cross(&up)]);
            let axes = nalgebra::Rotation3::from_matrix_unchecked(axes);
            Rotation::<Body, Marker>::from_quaternion(nalgebra::UnitQuaternion::from_rotation_matrix(&axes))
        };
        let [one, other] = [heading_deg, other_deg].map(flat);
        let sight = |rotation| Sight::new(true, Some(Transform::new(rotation, Point::new(0.0, 0.0, 5.0))));
        prop_assert_eq!(turned(TOLERANCE, sight(one), sight(flipped(one))), None);
        let is_turned = turned(TOLERANCE, sight(one), sight(other)).is_some();
        prop_assert_eq!(turned(TOLERANCE, sight(one), sight(flipped(other))).is_some(), is_turned);
    }

    #[test]
    fn the_outvoted_one_does_not_depend_on_the_order(all in several()) {
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
