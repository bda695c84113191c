//! The frames of the sets.
//!
//! A set has the same views, grounds and lights for every marker, so that results of different markers are
//! comparable.

mod adverse;
mod clutter;
mod scene;
mod sweeps;
mod views;

use markers::Marker;

use crate::frame_spec::FrameSpec;
use crate::set::Set;

/// The frames of a set with a marker, which is ignored for negatives.
pub fn frames(set: Set, marker: Marker) -> Vec<FrameSpec> {
    match set {
        Set::Positions => views::positions(marker),
        Set::Far => views::far(marker),
        Set::Landing => views::landing(marker),
        Set::Adverse => adverse::frames(marker),
        Set::Tilt => sweeps::tilt(marker),
        Set::Blur => sweeps::blur(marker),
        Set::Noise => sweeps::noise(marker),
        Set::Light => sweeps::light(marker),
        Set::Rolling => sweeps::rolling(marker),
        Set::Textured => views::textured(marker),
        Set::Tracking => views::tracking(marker),
        Set::Negatives => clutter::frames(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::set::{MARKERS, SIZE_M};

    #[test]
    fn sets_have_their_number_of_frames() {
        let marker = "apriltag-16h5:0:0.15341".parse().unwrap();
        let counts = Set::ALL.map(|set| (set.name(), frames(set, marker).len()));
        let expected = [
            ("textured", 15),
            ("adverse", 72),
            ("landing", 51),
            ("far", 80),
            ("tilt", 84),
            ("blur", 84),
            ("noise", 42),
            ("light", 54),
            ("rolling", 48),
            ("tracking", 30),
            ("negatives", 520),
            ("positions", 37 * 2 * 5),
        ];
        assert_eq!(counts, expected);
    }

    #[test]
    fn every_marker_has_the_same_views_and_is_in_front_of_the_camera() {
        let frames = MARKERS.map(|name| {
            let marker = format!("{name}:{SIZE_M}").parse().unwrap();
            frames(Set::Landing, marker)
        });
        for of_marker in &frames {
            for (spec, first) in of_marker.iter().zip(&frames[0]) {
                assert_eq!(spec.path, first.path);
                assert_eq!(
                    spec.ground_truth().unwrap().centre,
                    first.ground_truth().unwrap().centre
                );
            }
        }
    }

    #[test]
    fn negatives_have_clutter_and_no_marker() {
        assert!(
            frames(Set::Negatives, "rings:0.1".parse().unwrap())
                .iter()
                .all(|frame| frame.marker.is_none() && !frame.clutter.is_empty())
        );
    }
}
