//! Detects markers of all families: runs each family's detector and the fallback passes on an image, or reads one marker at its
//! prediction, and joins the observations. It does not depend on any family.

use geometry::CameraModel;
use imaging::{GrayImage, GrayView};
use markers::Marker;

use crate::candidates::evidence::{Evidence, Needs};
use crate::families;
use crate::families::family::{FamilyDetector, FrameInput, Output, PredictedShape, Prediction};
use crate::observation::{Observation, StageObserver};
use crate::optics::shadow::ShadowFinder;
use crate::response::{ResponseEstimate, ResponseSetting};
use crate::schedule::{FallbackPass, FallbackStep, PassSchedule};
use crate::settings::Settings;
use crate::trace::{Trace, TracedMarker};

/// Why there is no detector for these markers.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum DetectorError {
    /// The list of markers is empty.
    #[error("a detector needs at least one marker to look for")]
    NoMarker,
    /// Two markers that look the same.
    #[error(
        "the marker `{name}` is listed twice; two sizes of it cannot be distinguished in one image"
    )]
    Twice {
        /// The marker's name.
        name: String,
    },
    /// Two markers of one print, in two sizes.
    #[error(
        "the markers `{marker}` and `{other}` are one print; two sizes of it cannot be distinguished in one image"
    )]
    LookAlike {
        /// The marker.
        marker: Marker,
        /// Another one before it in the list.
        other: Marker,
    },
}

/// Finds markers in images. It keeps its memory from image to image.
#[derive(Debug)]
pub struct Detector {
    settings: Settings,
    needs: Needs,
    families: Vec<Box<dyn FamilyDetector>>,
    evidence: Evidence,
    /// The image that a fallback pass searches instead of the frame of which it is made.
    derived: GrayImage,
    shadows: ShadowFinder,
    found: Vec<Observation>,
    trace: Trace,
    /// The fallback passes of these families, in the order in which they take turns, and the number of turns.
    passes: Vec<FallbackPass>,
    turns: usize,
    /// Where markers that are followed should be in the next image.
    followed: Vec<Prediction>,
    /// How the camera shows light, where that is known.
    response: Option<ResponseEstimate>,
}

impl Detector {
    /// A detector for these markers.
    ///
    /// # Errors
    /// [`DetectorError`] when there are none, or two of the same name or of one print in two sizes.
    pub fn new(markers: &[Marker], settings: Settings) -> Result<Self, DetectorError> {
        if markers.is_empty() {
            return Err(DetectorError::NoMarker);
        }
        for (i, marker) in markers.iter().enumerate() {
            if markers[..i].iter().any(|m| m.family == marker.family && m.id == marker.id) {
                return Err(DetectorError::Twice { name: marker.name() });
            }
            let has_other_size = |m: &&Marker| {
                m.size_m.zip(marker.size_m).is_some_and(|(a, b)| a != b) && m.looks_like(marker)
            };
            if let Some(other) = markers[..i].iter().find(has_other_size) {
                return Err(DetectorError::LookAlike { marker: *marker, other: *other });
            }
        }
        let families = families::detectors(markers, settings);
        let needs = families.iter().map(|family| family.needs()).fold(Needs::default(), Needs::and);
        let has = |pass: &FallbackPass| {
            families.iter().any(|family| match pass.step() {
                Some(step) => family.fallback_steps().contains(&step),
                None => family.searches_without_shadow(),
            })
        };
        Ok(Self {
            settings,
            needs,
            passes: FallbackPass::ALL.into_iter().filter(has).collect(),
            families,
            evidence: Evidence::default(),
            derived: GrayImage::default(),
            shadows: ShadowFinder::default(),
            found: Vec::new(),
            trace: Trace::default(),
            turns: 0,
            followed: Vec::new(),
            response: match settings.response {
                ResponseSetting::Auto => None,
                ResponseSetting::Known(known) => Some(known),
            },
        })
    }

    /// Finds the markers in an image. Without `camera` there are no poses; with it, `camera` must be the model of
    /// this image's size. Of one family's markers the most confident comes first.
    pub fn detect(
        &mut self,
        view: GrayView<'_>,
        camera: Option<&CameraModel>,
        stages: &mut impl StageObserver,
    ) -> &[Observation] {
        self.detect_with(view, camera, PassSchedule::ALL, stages)
    }

    /// As [`Detector::detect`], in a stream of images in which nothing was found of late: the fallback passes are spread
    /// over the images. When no marker is found without them, one of up to nine passes runs, in the next image the next
    /// one; a marker that is occluded or far away is found up to eight images later.
    pub fn detect_in_turn(
        &mut self,
        view: GrayView<'_>,
        camera: Option<&CameraModel>,
        stages: &mut impl StageObserver,
    ) -> &[Observation] {
        let pass = self.turns.checked_rem(self.passes.len());
        let pass = pass.and_then(|index| self.passes.get(index).copied());
        self.turns = self.turns.wrapping_add(1);
        let schedule = match pass {
            _ if self.settings.thorough => PassSchedule::ALL,
            Some(pass) => PassSchedule::only(pass),
            None => PassSchedule::NONE,
        };
        self.detect_with(view, camera, schedule, stages)
    }

    /// Sets where tracked markers should be in the next image: there a part of a marker is enough.
    pub(crate) fn follow(&mut self, markers: impl Iterator<Item = Prediction>) {
        const MAX_FOLLOWED: usize = 16;
        self.followed.clear();
        self.followed.reserve(MAX_FOLLOWED);
        self.followed.extend(markers.take(MAX_FOLLOWED));
    }

    /// Ends the mode of [`Detector::follow`]: the next images are searched as single ones.
    pub(crate) fn follow_none(&mut self) {
        self.followed.clear();
    }

    /// As [`Detector::detect`], with some of the fallback passes.
    pub fn detect_with(
        &mut self,
        view: GrayView<'_>,
        camera: Option<&CameraModel>,
        schedule: PassSchedule,
        stages: &mut impl StageObserver,
    ) -> &[Observation] {
        self.found.clear();
        self.trace.clear();
        self.make_room(view);
        let Self { families, evidence, derived, found, trace, .. } = self;
        let response = self.response;
        let followed = self.followed.as_slice();
        let stages: &mut dyn StageObserver = stages;
        evidence.find(view, &self.needs, trace, stages);
        let mut out = Output { found, trace, stages };
        let shadow_removed = false;
        let mut input =
            FrameInput { view, camera, evidence, schedule, followed, response, shadow_removed };
        for family in families.iter_mut() {
            family.detect(input.again(), &mut out);
        }
        let mut is_of_frame = true;
        // Other passes place a marker under a shadow's edge less well.
        if schedule.allows(FallbackPass::ShadowEdge)
            && self.passes.contains(&FallbackPass::ShadowEdge)
            && out.found.is_empty()
        {
            let edge = self.shadows.find(view, input.evidence.outlines.pyramid());
            if let Some(edge) = &edge {
                edge.remove(view, derived);
            }
            out.stages.ended("shadow");
            if let Some(view) = edge.and_then(|_| derived.view()) {
                input.evidence.find(view, &self.needs, out.trace, out.stages);
                for family in families.iter_mut().filter(|it| it.searches_without_shadow()) {
                    let input = FrameInput { view, shadow_removed: true, ..input.again() };
                    family.detect(input, &mut out);
                }
                is_of_frame = false;
            }
        }
        input.evidence.begin_fallbacks(schedule);
        for step in FallbackStep::ALL.into_iter().filter(|step| schedule.allows_step(*step)) {
            if !input.evidence.may_help(step) {
                continue;
            }
            let mut is_prepared = false;
            for family in families.iter_mut() {
                let all = self.settings.thorough || out.found.is_empty();
                if !family.fallback_steps().contains(&step)
                    || !family.wants_fallback(step, all, out.found)
                {
                    continue;
                }
                if !std::mem::replace(&mut is_of_frame, true) {
                    input.evidence.find(view, &self.needs, out.trace, out.stages);
                    input.evidence.begin_fallbacks(schedule);
                }
                let is_first = !std::mem::replace(&mut is_prepared, true);
                let is_brightened = step == FallbackStep::Brightened;
                if is_first && is_brightened {
                    derived.make_brightened(view);
                }
                let view = derived.view().filter(|_| is_brightened).unwrap_or(view);
                if is_first {
                    input.evidence.prepare(view, step, schedule, out.stages);
                }
                family.fallback(step, FrameInput { view, ..input.again() }, &mut out);
            }
            if let Some(stage) = step.stage().filter(|_| is_prepared) {
                out.stages.ended(stage);
            }
        }
        self.trace.markers.extend(self.found.iter().map(TracedMarker::from));
        &self.found
    }

    /// Takes this for how the camera of the next images shows light, unless that is configured. For a stream of images;
    /// single images may be of any camera.
    pub fn assume_response(&mut self, response: Option<ResponseEstimate>) {
        if self.settings.response == ResponseSetting::Auto {
            self.response = response;
        }
    }

    /// Finds one marker at its prediction and nothing else. `None` when it is not well visible there; a search of the region
    /// may still find it.
    pub(crate) fn detect_at(
        &mut self,
        view: GrayView<'_>,
        camera: Option<&CameraModel>,
        at: &Prediction,
        stages: &mut impl StageObserver,
    ) -> Option<Observation> {
        self.trace.clear();
        // A thorough search finds other markers next to it.
        if self.settings.thorough {
            return None;
        }
        let Self { families, evidence, response, .. } = self;
        let response = *response;
        if matches!(at.shape, PredictedShape::Corners(_)) {
            evidence.outlines.begin(view);
        }
        let schedule = PassSchedule::NONE;
        let shadow_removed = false;
        let seen = families.iter_mut().find_map(|family| {
            let followed = std::slice::from_ref(at);
            let input =
                FrameInput { view, camera, evidence, schedule, followed, response, shadow_removed };
            family.detect_at(input, at)
        })?;
        self.trace.markers.push(TracedMarker::from(&seen));
        stages.ended("following");
        Some(seen)
    }

    /// Makes the buffers as large as textured images need, so that none grows from one frame to another.
    fn make_room(&mut self, view: GrayView<'_>) {
        const MAX_AT_ONCE: usize = 64;
        self.found.reserve(MAX_AT_ONCE);
        self.trace.make_room();
        self.evidence.make_room(view, &self.needs);
        if self.passes.contains(&FallbackPass::ShadowEdge) {
            self.derived.resize(view.width(), view.height());
            self.shadows.make_room(view);
        }
        self.families.iter_mut().for_each(|family| family.make_room());
    }

    /// Candidates and markers of the last detection.
    pub fn trace(&self) -> &Trace {
        &self.trace
    }
}
