//! Defines the input and output of a family's detector.

use std::fmt::Debug;

use geometry::{CameraModel, Pixel};
use imaging::GrayView;
use markers::Family;

use crate::candidates::evidence::{Evidence, Needs};
use crate::families::rings::circle_pose::CirclePose;
use crate::observation::{Observation, StageObserver};
use crate::response::ResponseEstimate;
use crate::schedule::{FallbackStep, PassSchedule};
use crate::trace::Trace;

/// The detector of one kind of marker, for all its families. It keeps its memory from image to image.
pub(crate) trait FamilyDetector: Debug + Send {
    /// The data of an image that it needs.
    fn needs(&self) -> Needs;

    /// The steps of the fallbacks that it has.
    fn fallback_steps(&self) -> &'static [FallbackStep];

    /// Whether it also searches an image without its shadow, by [`FamilyDetector::detect`].
    fn searches_without_shadow(&self) -> bool {
        true
    }

    /// Reserves memory for textured images.
    fn make_room(&mut self) {}

    /// Finds its markers in an image, without fallbacks.
    fn detect(&mut self, input: FrameInput<'_>, out: &mut Output<'_>);

    /// Finds one marker at its prediction and nothing else; `None` when it is not well visible there.
    fn detect_at(&mut self, _input: FrameInput<'_>, _at: &Prediction) -> Option<Observation> {
        None
    }

    /// Whether a step of the fallbacks is to run, after [`FamilyDetector::detect`]. `all` are to be found, or only the further
    /// markers of boards.
    fn wants_fallback(&mut self, step: FallbackStep, all: bool, found: &[Observation]) -> bool {
        let _ = (step, found);
        all
    }

    /// Runs a step of the fallbacks.
    fn fallback(&mut self, step: FallbackStep, input: FrameInput<'_>, out: &mut Output<'_>) {
        let _ = (step, input, out);
    }
}

/// An image and its shared data.
#[derive(Debug)]
pub(crate) struct FrameInput<'a> {
    pub(crate) view: GrayView<'a>,
    /// Without a camera there are no poses.
    pub(crate) camera: Option<&'a CameraModel>,
    /// Of `view`.
    pub(crate) evidence: &'a mut Evidence,
    /// The fallback passes that may run in this image.
    pub(crate) schedule: PassSchedule,
    /// Where markers that are followed should be; none in a single image.
    pub(crate) followed: &'a [Prediction],
    /// How the camera shows light, where that is known.
    pub(crate) response: Option<ResponseEstimate>,
    /// Whether a shadow was removed: noise is stronger where it was, and along its edge something of it is left.
    pub(crate) shadow_removed: bool,
}

impl FrameInput<'_> {
    /// The same once more, for the detector after one that consumes it.
    pub(crate) fn again(&mut self) -> FrameInput<'_> {
        FrameInput { evidence: &mut *self.evidence, ..*self }
    }
}

/// Where detections go.
pub(crate) struct Output<'a> {
    pub(crate) found: &'a mut Vec<Observation>,
    pub(crate) trace: &'a mut Trace,
    pub(crate) stages: &'a mut dyn StageObserver,
}

/// Where a tracked marker is predicted.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Prediction {
    pub(crate) family: Family,
    pub(crate) id: Option<u32>,
    pub(crate) shape: PredictedShape,
}

/// The predicted shape of a marker.
#[derive(Copy, Clone, Debug)]
pub(crate) enum PredictedShape {
    /// Of a square marker, its own top left corner first.
    Corners([Pixel; 4]),
    /// Of rings.
    Circles(CirclePose),
}
