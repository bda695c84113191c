//! Specifies the frames of a set of the marker experiment, by its name, a marker and a variant (seed, processing, fraction
//! of the frames).
//!
//! A set has the same views, grounds and lights for every marker, so that results of different markers are
//! comparable.

mod adverse;
mod circles;
mod clutter;
mod cut;
mod ground;
mod scene;
mod shade;
mod sweeps;
mod views;

use markers::Marker;
use rendering::Preset;

use crate::frame_spec::FrameSpec;
use crate::set::Set;
use scene::Draw;

/// Pixels of the thesis' sensor across.
const SENSOR_WIDTH: u32 = 2592;

/// A selection of frames of a set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Variant {
    /// Seed of poses, ids, lights, grounds and noise. With 0 they are those on which the detector was
    /// developed; figures to report come from others.
    pub seed: u64,
    /// The camera's processing.
    pub processing: Preset,
    /// Only every such frame; 1 for all.
    pub every: usize,
    /// Whether frames are binned by software, from those of the thesis' sensor with all its pixels and colours.
    pub is_binned: bool,
}

impl Default for Variant {
    fn default() -> Self {
        Self { seed: 0, processing: Preset::Linear, every: 1, is_binned: false }
    }
}

impl Variant {
    /// The name of its folder; `None` for all frames on which the detector was developed.
    pub fn name(&self) -> Option<String> {
        let Self { seed, processing, every, is_binned } = *self;
        let part = if every > 1 { format!("-every{every}") } else { String::new() };
        let binned = if is_binned { "-binned" } else { "" };
        (*self != Self::default()).then(|| format!("{processing}-seed{seed}{part}{binned}"))
    }
}

/// The frames of a set with a marker, which is ignored for negatives.
pub fn frames(set: Set, marker: Marker) -> Vec<FrameSpec> {
    frames_of(set, marker, Variant::default())
}

/// Like [`frames`], of a variant.
pub fn frames_of(set: Set, marker: Marker, variant: Variant) -> Vec<FrameSpec> {
    let draw = Draw { seed: variant.seed };
    let frames = match set {
        Set::Positions => views::positions(draw, marker),
        Set::Far => views::far(draw, marker),
        Set::Landing => views::landing(draw, marker),
        Set::Adverse => adverse::frames(draw, marker),
        Set::Tilt => sweeps::tilt(draw, marker),
        Set::Blur => sweeps::blur(draw, marker),
        Set::Noise => sweeps::noise(draw, marker),
        Set::Light => sweeps::light(draw, marker),
        Set::Rolling => sweeps::rolling(draw, marker),
        Set::Shade => shade::frames(draw, marker),
        Set::Ground => ground::frames(draw, marker),
        Set::Cut => cut::frames(draw, marker),
        Set::Textured => views::textured(draw, marker),
        Set::Tracking => views::tracking(draw, marker),
        Set::Negatives => clutter::frames(draw),
        Set::Circles => circles::frames(draw),
    };
    let processing = variant.processing.processing();
    frames
        .into_iter()
        .step_by(variant.every.max(1))
        .map(|mut spec| {
            // Those of the circles are of all cameras.
            if set != Set::Circles || variant.processing != Preset::Linear {
                spec.settings.processing = processing;
            }
            // A camera has one mosaic.
            spec.bayer &= !processing.mosaic;
            if variant.is_binned {
                let pixels = f64::from(SENSOR_WIDTH) / f64::from(spec.settings.model.width.max(1));
                spec.binned = (pixels.round() as u32).max(1);
            }
            spec
        })
        .collect()
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
            ("shade", 160),
            ("ground", ground::COUNT),
            ("cut", cut::FRAMES),
            ("tracking", 30),
            ("negatives", 520),
            ("circles", circles::SCENES),
            ("positions", 37 * 2 * 5),
        ];
        assert_eq!(counts, expected);
        // The documentation's table has them, too.
        let text = include_str!("../../../docs/experiments.md");
        for (name, frames) in expected {
            assert!(text.contains(&format!("| `{name}` | {frames} | ")), "{name}, {frames}");
        }
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
    fn another_seed_has_other_poses_and_a_preset_the_same_ones() {
        let marker = "stag-hd23:0:0.15341".parse().unwrap();
        let of = |seed, processing| {
            frames_of(
                Set::Landing,
                marker,
                Variant { seed, processing, every: 2, ..Variant::default() },
            )
        };
        let [first, usb, other] =
            [of(0, Preset::Linear), of(0, Preset::Usb), of(7, Preset::Linear)];
        assert_eq!([first.len(), usb.len(), other.len()], [26; 3]);
        assert!(first.iter().zip(&usb).all(|(a, b)| a.path == b.path && a.seed == b.seed));
        assert!(first.iter().zip(&other).all(|(a, b)| a.path != b.path && a.seed != b.seed));
        assert!(usb.iter().all(|spec| spec.settings.processing == Preset::Usb.processing()));
    }

    #[test]
    fn negatives_have_clutter_and_no_marker() {
        for set in [Set::Negatives, Set::Circles] {
            let frames = frames(set, "rings:0.1".parse().unwrap());
            assert!(
                frames.iter().all(|frame| frame.marker.is_none() && !frame.clutter.is_empty()),
                "{}",
                set.name()
            );
        }
    }

    #[test]
    fn cut_markers_have_a_corner_beyond_the_frame_and_their_centre_within() {
        let frames = frames(Set::Cut, "aruco-4x4-50:0:0.15341".parse().unwrap());
        let is_within = |spec: &&FrameSpec| {
            spec.ground_truth().is_some_and(|truth| spec.settings.model.contains(truth.centre))
        };
        assert!(frames.iter().all(|spec| !spec.is_whole()));
        assert_eq!(frames.iter().filter(is_within).count(), frames.len());
    }
}
