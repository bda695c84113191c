//! Tests that errors are consistent with the covariance, for every family at any blur, and for rings with saturated
//! white.
#![allow(clippy::unwrap_used, reason = "a test may stop anywhere")]
#![allow(clippy::print_stdout, reason = "the figures are for people to read")]

use experiments::frame_spec::{FrameRenderer, FrameSpec};
use experiments::set::{MARKERS, SIZE_M, Set};
use experiments::{score, sets};
use fiducial::{Detector, Settings};
use imaging::GrayView;
use markers::Marker;
use node::stats::interpolated_quantile;

/// Median and 99th percentile of the chi-squared distribution with 2 degrees of freedom.
const MEDIAN: f64 = 1.386;
const PERCENTILE_99: f64 = 9.21;

/// Normalised squared errors of the centre in some frames.
fn centre_errors<'a>(frames: impl Iterator<Item = &'a FrameSpec>, marker: Marker) -> Vec<f64> {
    let mut renderer = FrameRenderer::default();
    let any = Marker { id: None, ..marker };
    let mut detector = Detector::new(&[any], Settings::default()).unwrap();
    let mut all = Vec::new();
    for spec in frames {
        let pixels = renderer.render(spec).unwrap();
        let camera = spec.settings.model;
        let (width, height) = (camera.width as usize, camera.height as usize);
        let view = GrayView::packed(&pixels, width, height).unwrap();
        let truth = spec.ground_truth().unwrap();
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
fn errors_are_consistent_at_any_blur() {
    for name in MARKERS {
        let marker: Marker = format!("{name}:{SIZE_M}").parse().unwrap();
        let errors = centre_errors(sets::frames(Set::Blur, marker).iter().step_by(2), marker);
        let median = interpolated_quantile(&errors, 0.5).unwrap();
        let beyond = errors.iter().filter(|error| **error > PERCENTILE_99).count();
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
fn errors_of_rings_are_consistent_with_saturated_white() {
    let marker: Marker = format!("rings:{SIZE_M}").parse().unwrap();
    let frames = sets::frames(Set::Light, marker);
    let is_saturated = |spec: &&FrameSpec| ["white400", "white700"].contains(&spec.group.as_str());
    let errors = centre_errors(frames.iter().filter(is_saturated), marker);
    let median = interpolated_quantile(&errors, 0.5).unwrap();
    println!("{} frames, median {median:.2} of {MEDIAN}", errors.len());
    assert_eq!(errors.len(), 12);
    assert!(median < 3.0 * MEDIAN, "{median}");
}
