//! Tests the calibration from simulated views of boards, bent and noisy, against each camera's truth, its stated uncertainty,
//! and bad sets of views that are refused. `examples/boards.rs` and `examples/judged.rs` do the same by the hundred.
#![allow(clippy::panic, reason = "a calibration that is refused fails the test")]

mod synthetic;

use calibration::{ImageSize, Lens, Options, Refusal, Sighting, View, calibrate};
use geometry::Pixel;
use proptest::prelude::*;
use synthetic::bad::Bad;
use synthetic::score::Score;
use synthetic::{Taking, Truth, lenses, views};

fn scores(truth: &Truth, taking: &Taking, seeds: std::ops::Range<u64>) -> Vec<Score> {
    let score = |seed| {
        let views = views(&truth.camera, taking, seed);
        let found = calibrate(&views, truth.lens, &Options::default());
        Score::new(
            truth,
            &found.unwrap_or_else(|refusal| panic!("{} {seed}: {refusal}", truth.name)),
        )
    };
    seeds.map(score).collect()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

#[test]
fn sixty_views_of_a_bent_board_give_the_camera() {
    for truth in lenses() {
        let scores = scores(&truth, &Taking::default(), 100..103);
        assert!(scores.iter().all(|s| s.focal_percent < 0.02), "{}: {scores:?}", truth.name);
        assert!(scores.iter().all(|s| s.principal_px < 0.1), "{}: {scores:?}", truth.name);
        assert!(scores.iter().all(|s| s.turned_px < 0.1), "{}: {scores:?}", truth.name);
        let narrow = truth.lens == Lens::BrownConrady5;
        // With a narrow lens the principal point and the tilt of all views look nearly the same.
        let max_px = if narrow { 0.15 } else { 0.1 };
        assert!(scores.iter().all(|s| s.map_px < max_px), "{}: {scores:?}", truth.name);
    }
}

#[test]
fn the_lens_is_unknown_farther_out_than_the_board_was_seen() {
    let truth = lenses()[0];
    let all =
        calibrate(&views(&truth.camera, &Taking::default(), 100), truth.lens, &Options::default());
    let all = all.unwrap_or_else(|refusal| panic!("{refusal}"));
    assert!(all.unknown_share() < 0.05, "{}", all.unknown_share());
    let (middle, corner) = (Pixel::new(640.0, 480.0), Pixel::new(2.0, 2.0));
    let taking = Taking { part: [0.4, 0.6, 0.4, 0.6], distances: [1.0, 1.5], ..Taking::default() };
    let some = views(&truth.camera, &taking, 101);
    let some = calibration::calibrate_unjudged(&some, truth.lens, &Options::default());
    let some = some.unwrap_or_else(|refusal| panic!("{refusal}"));
    assert!(some.uncertainty_px(middle).is_some() && some.uncertainty_px(corner).is_none());
    assert!(some.unknown_share() > 0.1, "{}", some.unknown_share());
}

#[test]
fn the_stated_uncertainty_is_that_of_the_errors() {
    let mut all = Vec::new();
    for truth in lenses().into_iter().filter(|truth| truth.lens != Lens::BrownConrady8) {
        let taking = Taking { views: 25, noise_px: 0.02, tag_noise_px: 0.04, ..Taking::default() };
        all.extend(scores(&truth, &taking, 200..210));
    }
    let nees = mean(&all.iter().map(|s| s.nees).collect::<Vec<_>>());
    assert!((0.7..1.35).contains(&nees), "{nees}");
    let [one, two] = [0, 1].map(|i| mean(&all.iter().map(|s| s.within[i]).collect::<Vec<_>>()));
    assert!((0.58..0.78).contains(&one) && two > 0.88, "{one} {two}");
}

#[test]
fn tags_that_are_found_elsewhere_do_not_move_the_camera() {
    let truth = lenses()[2];
    let scores = scores(&truth, &Taking { outliers: 0.05, ..Taking::default() }, 300..303);
    assert!(scores.iter().all(|s| s.focal_percent < 0.02 && s.map_px < 0.1), "{scores:?}");
}

#[test]
fn good_sets_of_many_kinds_are_accepted() {
    for (truth, seed) in lenses().into_iter().cycle().zip(400..412) {
        let views = views(&truth.camera, &Taking::good(seed), seed);
        let found = calibrate(&views, truth.lens, &Options::default());
        let found = found.unwrap_or_else(|refusal| panic!("{} {seed}: {refusal}", truth.name));
        assert!(found.views.iter().all(|view| !view.is_turned), "{} {seed}", truth.name);
    }
}

#[test]
fn views_that_were_turned_by_180_degrees_are_recognised() {
    for truth in lenses() {
        let mut views = views(&truth.camera, &Taking::default(), 602);
        for point in views.iter_mut().step_by(6).flat_map(|view| &mut view.points) {
            let right_px = f64::from(synthetic::SIZE.width) - 1.0 - point.seen.x;
            let down_px = f64::from(synthetic::SIZE.height) - 1.0 - point.seen.y;
            point.seen = Pixel::new(right_px, down_px);
        }
        let found = calibrate(&views, truth.lens, &Options::default());
        let found = found.unwrap_or_else(|refusal| panic!("{}: {refusal}", truth.name));
        let turned = found.views.iter().filter(|view| view.is_turned);
        let turned: Vec<&str> = turned.map(|view| view.name.as_str()).collect();
        let expected: Vec<&str> = views.iter().step_by(6).map(|view| view.name.as_str()).collect();
        assert_eq!(turned, expected, "{}", truth.name);
    }
}

#[test]
fn bad_sets_are_refused_with_their_reason() {
    let lenses = lenses();
    for (i, bad) in Bad::ALL.into_iter().enumerate() {
        for seed in 500..502 {
            let truth = &lenses[[0, 2, 3][(i + seed as usize) % 3]];
            let (views, lens) = bad.set(truth, seed);
            let refusal = calibrate(&views, lens, &Options::default()).err();
            let is_named = refusal.as_ref().is_some_and(|refusal| bad.is_named_by(refusal));
            assert!(is_named, "{bad:?} {} {seed}: {refusal:?}", truth.name);
        }
    }
}

#[test]
fn a_refusal_states_the_value_the_limit_and_the_remedy() {
    let truth = lenses()[0];
    for (seed, comparison) in [(502, "larger"), (501, "smaller")] {
        let (views, lens) = Bad::TagSize.set(&truth, seed);
        let refusal = calibrate(&views, lens, &Options::default()).unwrap_err();
        let Refusal::TagSize { percent, .. } = refusal else { panic!("{refusal}") };
        let text = refusal.to_string();
        let difference = format!("are {:.2} % {comparison} than stated", percent.abs());
        assert!(text.contains(&difference) && text.contains("limit 0.30 %"), "{text}");
        for part in ["measure the side", "caliper", "across several tags"] {
            assert!(text.contains(part), "`{part}` is not in: {text}");
        }
    }
}

#[test]
fn a_wrong_scale_of_the_whole_board_leaves_the_camera_as_it_is() {
    let truth = lenses()[0];
    let mut views = views(&truth.camera, &Taking::default(), 600);
    let right = calibrate(&views, truth.lens, &Options::default()).unwrap();
    for point in views.iter_mut().flat_map(|view| &mut view.points) {
        point.place_m = point.place_m.map(|at| 1.1 * at);
    }
    let wrong = calibrate(&views, truth.lens, &Options::default()).unwrap();
    assert!((wrong.camera.fx - right.camera.fx).abs() < 1e-3);
    let distance = |found: &calibration::Calibration| {
        found.views[0].camera_from_board.origin().coords.coords.norm()
    };
    assert!((distance(&wrong) / distance(&right) - 1.1).abs() < 1e-4);
}

#[test]
fn poses_are_those_of_the_board_as_it_was_described() {
    let truth = lenses()[2];
    let views = views(&truth.camera, &Taking::default(), 601);
    let found = calibrate(&views, truth.lens, &Options::default()).unwrap();
    for (view, solved) in views.iter().zip(&found.views) {
        assert_eq!(view.name, solved.name);
        let point = &view.points[0];
        let [x, y] = point.place_m;
        let place = solved.camera_from_board * geometry::Point::new(x, y, 0.0);
        let distance = found.camera.project(place).unwrap().distance(&point.seen);
        // The bend is not in the pose.
        assert!(distance < 8.0, "{distance}");
    }
}

fn any_coordinate() -> impl Strategy<Value = f64> {
    prop_oneof![
        8 => -100.0..1400.0,
        1 => Just(0.0),
        1 => prop::sample::select(vec![f64::NAN, f64::INFINITY, 1e300, -1e-300]),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn any_points_give_a_camera_or_a_reason(
        points in prop::collection::vec((any_coordinate(), any_coordinate(), -0.5..0.5f64, -0.5..0.5f64), 100..200),
        views in 1..10usize,
        lens in prop::sample::select(Lens::ALL.to_vec()),
        tags in 1..40u32,
    ) {
        let size = ImageSize { width: 1280, height: 960 };
        let sighting = |(i, (u, v, x, y)): (usize, &(f64, f64, f64, f64))| {
            Sighting { tag: i as u32 % tags, place_m: [*x, *y], seen: Pixel::new(*u, *v) }
        };
        let points: Vec<Sighting> = points.iter().enumerate().map(sighting).collect();
        let view = |points: &[Sighting]| View { name: "any".into(), size, points: points.to_vec() };
        let views: Vec<View> = points.chunks(points.len() / views).map(view).collect();
        let refusal = calibrate(&views, lens, &Options::default()).unwrap_err();
        prop_assert!(refusal.to_string().len() > 40);
    }
}

/// Points that are all the same, on one line, or exact: none may leave numbers that are not finite.
#[test]
fn degenerate_points_are_refused() {
    let size = ImageSize { width: 640, height: 480 };
    let line = |i: u32| [0.01 * f64::from(i), 0.0];
    let same = |_: u32| [0.1, 0.1];
    for place in [line as fn(u32) -> [f64; 2], same] {
        let point = |i: u32| {
            let seen = Pixel::new(f64::from(i) * 30.0 % 640.0, f64::from(i) * 77.0 % 480.0);
            Sighting { tag: i, place_m: place(i), seen }
        };
        let view =
            |i: u32| View { name: i.to_string(), size, points: (0..40).map(point).collect() };
        let views: Vec<View> = (0..10).map(view).collect();
        for lens in Lens::ALL {
            let refusal = calibrate(&views, lens, &Options::default()).unwrap_err();
            assert!(matches!(refusal, Refusal::Diverged { .. }), "{refusal:?}");
        }
    }
}
