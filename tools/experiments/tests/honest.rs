//! Errors are as large as the covariance says that they are, for every family and however blurred it is, and of rings where
//! white is beyond the end of the scale.
#![allow(clippy::unwrap_used, reason = "a test may stop anywhere")]
#![allow(clippy::print_stdout, reason = "the figures are what one wants to read")]

use experiments::score;
use experiments::sets::{MARKERS, SIZE_M, Set};
use experiments::shot::{Shot, Studio};
use fiducial::{Detector, Settings};
use imaging::GrayView;
use markers::Marker;

/// The median of the squared errors of two unknowns in units of their covariance, and what one in a hundred exceeds.
const MEDIAN: f64 = 1.386;
const ONE_IN_A_HUNDRED: f64 = 9.21;

/// Squared errors of the centre in units of its covariance, in each of some frames.
fn centre_errors<'a>(shots: impl Iterator<Item = &'a Shot>, marker: Marker) -> Vec<f64> {
    let mut studio = Studio::default();
    let any = Marker { id: None, ..marker };
    let mut detector = Detector::new(&[any], Settings::default()).unwrap();
    let mut all = Vec::new();
    for shot in shots {
        let pixels = studio.take(shot).unwrap();
        let camera = shot.settings.model;
        let (width, height) = (camera.width as usize, camera.height as usize);
        let view = GrayView::packed(&pixels, width, height).unwrap();
        let truth = shot.shown().unwrap();
        let found = detector.detect(view, Some(&camera), &mut ());
        for found in found.iter().filter(|found| found.centre.distance(&truth.centre) < 5.0) {
            let off_px = [found.centre.x - truth.centre.x, found.centre.y - truth.centre.y];
            let c = found.centre_covariance_px2;
            all.push(score::normalised(off_px, [c[(0, 0)], c[(0, 1)], c[(1, 1)]]));
        }
    }
    all
}

#[test]
fn errors_are_as_large_as_told_in_every_blur() {
    for name in MARKERS {
        let marker: Marker = format!("{name}:{SIZE_M}").parse().unwrap();
        let errors = centre_errors(Set::Blur.shots(marker).iter().step_by(2), marker);
        let median = score::quantile(&errors, 0.5).unwrap();
        let beyond = errors.iter().filter(|error| **error > ONE_IN_A_HUNDRED).count();
        println!(
            "{name}: {} frames, median {median:.2} of {MEDIAN}, {beyond} beyond",
            errors.len()
        );
        assert!(errors.len() >= 36, "{name}: found in {}", errors.len());
        assert!(median < 1.5 * MEDIAN && median > 0.1 * MEDIAN, "{name}: {median}");
        assert!(beyond * 10 <= errors.len(), "{name}: {beyond} of {}", errors.len());
    }
}

#[test]
fn errors_of_rings_are_as_large_as_told_where_white_is_beyond_the_scale() {
    let marker: Marker = format!("rings:{SIZE_M}").parse().unwrap();
    let shots = Set::Light.shots(marker);
    let is_beyond = |shot: &&Shot| ["white400", "white700"].contains(&shot.group.as_str());
    let errors = centre_errors(shots.iter().filter(is_beyond), marker);
    let median = score::quantile(&errors, 0.5).unwrap();
    println!("{} frames, median {median:.2} of {MEDIAN}", errors.len());
    assert_eq!(errors.len(), 12);
    assert!(median < 3.0 * MEDIAN, "{median}");
}
