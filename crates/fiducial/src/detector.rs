//! The detector: markers in, observations out.

use std::ops::Range;

use markers::{Family, Marker};
use geometry::{CameraModel, Pixel};
use imaging::{GrayView, Outlines, outline};

use crate::candidates::outline_quads::OutlineQuads;
use crate::candidates::quad::Quad;
use crate::candidates::quiet_zone::{MAX_QUIET_ZONES, quiet_zone_quads};
use crate::candidates::segment_quads::{ImageQuads, Scale};
use crate::families::query::{ExpectedMarker, ImageInput, Output};
use crate::families::rings::Rings;
use crate::families::rings::circle_pose::CirclePose;
use crate::families::rings_thesis::RingsThesis;
use crate::families::square::SquareTagDetector;
use crate::families::stag::StagDetector;
use crate::observation::{Observation, Stages};
use crate::trace::{Trace, TracedMarker};

/// What can be chosen about a detection.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Settings {
    /// T of Equation 3.3, in grey levels, for `rings-thesis`. The thesis does not state it; 70 finds most in
    /// renderings of its camera.
    pub thesis_threshold: u8,
    /// Whether markers printed white on black are looked for as well; `rings-thesis` has none.
    pub inverted: bool,
    /// Whether what is slow, and finds markers that are damaged, seen in part or very small, is also done in images in which
    /// others were found. Otherwise it is where none was, and for families of any id where two were, as on boards.
    pub thorough: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self { thesis_threshold: 70, inverted: true, thorough: false }
    }
}

/// The level of the image's pyramid from which on bright outlines are followed for markers printed white on black.
const INVERTED_FROM: usize = 2;

/// Of so many quads at most the dots of a STag are read; of frames with markers, more than there are.
const MOST_STAG_QUADS: usize = 128;

/// What takes long, and is for markers that are not plain to see; it is done when nothing else was found.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) enum SlowPass {
    /// Arcs of rings that are cut or covered, and rings that noise hides but on coarser levels.
    Arcs,
    /// Bright specks, which may be the paper of rings far away.
    Specks,
    /// Square markers that are damaged, STags among them, by the segments of edges in the image.
    Segments(Scale),
    /// The paper of square markers far away, STags among them, that begins in a part of the image.
    Papers(Third),
}

/// A third of the image's rows.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) enum Third {
    Upper,
    Middle,
    Lower,
}

impl Third {
    const ALL: [Self; 3] = [Self::Upper, Self::Middle, Self::Lower];

    fn rows(self, height: usize) -> Range<usize> {
        let from = self as usize * height / 3;
        from..(self as usize + 1) * height / 3
    }
}

/// The slow passes that may be made in an image.
#[derive(Copy, Clone, Debug)]
pub(crate) enum Allowed {
    All,
    One(Option<SlowPass>),
}

impl Allowed {
    pub(crate) fn has(self, pass: SlowPass) -> bool {
        match self {
            Self::All => true,
            Self::One(one) => one == Some(pass),
        }
    }
}

/// How to look for the paper of square markers so small that their border and what is in it, or, of STags, the disc, cannot
/// be told apart.
const PAPERS: outline::Settings = outline::Settings {
    dark_from: None,
    bright_from: Some(0),
    whole_level: 2,
    min_size_px: 5,
    max_size_px: 40,
    min_contrast: 14,
    min_contrast_percent: 12,
    steep: true,
    min_fill: 0.3,
    max_raggedness: 1.2,
};

/// Where a marker should be.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Expected {
    pub(crate) family: Family,
    pub(crate) id: Option<u32>,
    /// The corners of a square marker, its own top left first.
    pub(crate) corners: Option<[Pixel; 4]>,
    /// The place of rings.
    pub(crate) circles: Option<CirclePose>,
}

/// Why there is no detector for these markers.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum DetectorError {
    /// Nothing to look for.
    #[error("a detector needs at least one marker to look for")]
    NoMarker,
    /// Two markers that look the same.
    #[error("the marker `{name}` is listed twice; one image cannot tell two sizes of it apart")]
    Twice {
        /// The marker's name.
        name: String,
    },
}

/// Finds markers in images. It keeps its memory from image to image.
#[derive(Debug)]
pub struct Detector {
    markers: Vec<Marker>,
    settings: Settings,
    outlines: Outlines,
    outline_quads: OutlineQuads,
    squares: SquareTagDetector,
    stags: StagDetector,
    rings: Rings,
    thesis: RingsThesis,
    broken: ImageQuads,
    /// Quads that may be the paper of markers far away.
    papers: Vec<Quad>,
    found: Vec<Observation>,
    trace: Trace,
    /// The slow passes there are for these markers, and how many were made in turn.
    slow_passes: Vec<SlowPass>,
    turns: usize,
}

impl Detector {
    /// A detector for these markers.
    ///
    /// # Errors
    /// [`DetectorError`] when there are none, or two of the same name.
    pub fn new(markers: &[Marker], settings: Settings) -> Result<Self, DetectorError> {
        if markers.is_empty() {
            return Err(DetectorError::NoMarker);
        }
        for (i, marker) in markers.iter().enumerate() {
            if markers[..i].iter().any(|m| m.family == marker.family && m.id == marker.id) {
                return Err(DetectorError::Twice { name: marker.name() });
            }
        }
        let (squares, stags) = (
            SquareTagDetector::new(markers, settings.inverted),
            StagDetector::new(markers, settings.inverted),
        );
        let has_rings = markers.iter().any(|marker| marker.family == Family::Rings);
        let has_quads = !squares.is_empty() || !stags.is_empty();
        let slow_passes = [
            (SlowPass::Arcs, has_rings),
            (SlowPass::Papers(Third::Upper), has_quads),
            (SlowPass::Segments(Scale::Fine), has_quads),
            (SlowPass::Specks, has_rings),
            (SlowPass::Papers(Third::Middle), has_quads),
            (SlowPass::Segments(Scale::Coarse), has_quads),
            (SlowPass::Papers(Third::Lower), has_quads),
        ];
        let slow_passes = slow_passes.into_iter().filter(|(_, is_there)| *is_there);
        Ok(Self {
            markers: markers.to_vec(),
            settings,
            outlines: Outlines::default(),
            outline_quads: OutlineQuads::default(),
            squares,
            stags,
            rings: Rings::new(settings.inverted, settings.thorough),
            thesis: RingsThesis::default(),
            broken: ImageQuads::default(),
            papers: Vec::new(),
            found: Vec::new(),
            trace: Trace::default(),
            slow_passes: slow_passes.map(|(pass, _)| pass).collect(),
            turns: 0,
        })
    }

    /// Finds the markers in an image. Without `camera` there are no poses; with it, `camera` must be the model of
    /// this image's size. Of one family's markers the surest comes first.
    pub fn detect(
        &mut self,
        view: GrayView<'_>,
        camera: Option<&CameraModel>,
        stages: &mut impl Stages,
    ) -> &[Observation] {
        self.search(view, camera, Allowed::All, stages)
    }

    /// As [`Detector::detect`], in a stream of images in which nothing was found of late: what takes long is spread over
    /// the images. When no marker is plain to see, one of up to seven slow passes is made, with the next image the next
    /// one; a marker that is damaged, or very far, is found up to six images later.
    pub fn detect_in_turn(
        &mut self,
        view: GrayView<'_>,
        camera: Option<&CameraModel>,
        stages: &mut impl Stages,
    ) -> &[Observation] {
        let pass = self.turns.checked_rem(self.slow_passes.len());
        let pass = pass.and_then(|index| self.slow_passes.get(index).copied());
        self.turns = self.turns.wrapping_add(1);
        let allowed = if self.settings.thorough { Allowed::All } else { Allowed::One(pass) };
        self.search(view, camera, allowed, stages)
    }

    /// Looks for one marker where it should be, and nothing else. `None` when it is not plain to see there; a search of the
    /// surroundings may still find it.
    pub(crate) fn detect_at(
        &mut self,
        view: GrayView<'_>,
        camera: Option<&CameraModel>,
        expected: &Expected,
        stages: &mut impl Stages,
    ) -> Option<Observation> {
        self.trace.clear();
        // Who looks thoroughly looks for others beside it.
        if self.settings.thorough {
            return None;
        }
        let Expected { family, id, .. } = *expected;
        let seen = match (expected.corners, expected.circles, camera) {
            (Some(corners), _, _) => {
                self.outlines.begin(view);
                let expected = ExpectedMarker { family, id: id?, corners };
                let input = ImageInput { view, pyramid: self.outlines.pyramid(), camera };
                let found = self.squares.detect_at(input, &expected);
                found.or_else(|| self.stags.detect_at(input, &expected))?
            }
            (None, Some(circles), Some(camera)) => {
                let marker = self.markers.iter().find(|m| m.family == family && m.id == id)?;
                self.rings.detect_at(view, marker, camera, &circles)?
            }
            _ => return None,
        };
        self.trace.markers.push(TracedMarker::from(&seen));
        stages.ended("following");
        Some(seen)
    }

    fn search(
        &mut self,
        view: GrayView<'_>,
        camera: Option<&CameraModel>,
        allowed: Allowed,
        stages: &mut impl Stages,
    ) -> &[Observation] {
        self.found.clear();
        self.trace.clear();
        self.make_room(view);
        let has_quads = !self.squares.is_empty() || !self.stags.is_empty();
        if !has_quads && self.markers.iter().any(|marker| marker.family == Family::Rings) {
            // Rings look for their outlines themselves, where those of other families are not there anyway.
            self.outlines.begin(view);
            stages.ended("outlines");
        }
        if has_quads {
            // Markers with a white border may be as small as others; others printed white on black are only looked for where
            // they are large.
            let bright_from = if self.squares.has_reversed_border() { 0 } else { INVERTED_FROM };
            let bright_from = (self.settings.inverted || self.squares.has_reversed_border())
                .then_some(bright_from);
            let mut settings = outline::Settings { bright_from, ..outline::Settings::default() };
            if !self.squares.is_empty() {
                settings.max_size_px = settings.max_size_px.max(SquareTagDetector::MAX_OUTLINE_PX);
            }
            if !self.stags.is_empty() {
                settings.max_size_px = settings.max_size_px.max(StagDetector::MAX_OUTLINE_PX);
            }
            self.outlines.find(view, &settings);
            stages.ended("outlines");
        }
        if has_quads {
            self.outline_quads.find(view, &self.outlines, &mut self.trace);
            stages.ended("quads");
            let input = ImageInput { view, pyramid: self.outlines.pyramid(), camera };
            let mut out = Output { trace: &mut self.trace, found: &mut self.found };
            self.squares.detect(input, self.outline_quads.iter(), stages, &mut out);
            if !self.stags.is_empty() {
                let quads = self.outline_quads.iter().take(MOST_STAG_QUADS);
                self.stags.detect(input, quads, stages, &mut out);
            }
        }
        for marker in &self.markers {
            let watch = (&mut self.trace, &mut *stages);
            let seen = (view, &mut self.outlines, !has_quads);
            let found = &mut self.found;
            match marker.family {
                Family::Rings => {
                    self.rings.detect(seen, marker, (camera, allowed), watch, found);
                }
                Family::RingsThesis => {
                    let threshold = self.settings.thesis_threshold;
                    found.extend(self.thesis.detect(view, marker, threshold, camera, watch));
                }
                _ => {}
            }
        }
        self.look_harder(view, camera, allowed, stages);
        self.trace.markers.extend(self.found.iter().map(TracedMarker::from));
        &self.found
    }

    /// Makes the buffers as large as frames with texture need, so that none grows from one frame to another.
    fn make_room(&mut self, view: GrayView<'_>) {
        const MOST_AT_ONCE: usize = 64;
        self.found.reserve(MOST_AT_ONCE);
        self.trace.make_room();
        if !self.squares.is_empty() || !self.stags.is_empty() {
            self.outline_quads.make_room();
            self.squares.make_room();
            self.stags.make_room();
        }
        let is_slow = |pass| self.slow_passes.contains(&pass);
        if is_slow(SlowPass::Arcs) {
            self.rings.make_room();
        }
        if is_slow(SlowPass::Papers(Third::Upper)) {
            self.broken.make_room(view);
            self.papers.clear();
            self.papers.reserve(MAX_QUIET_ZONES);
        }
    }

    /// Looks in the slow ways that are allowed, one after the other: who finds nothing has time for them.
    fn look_harder(
        &mut self,
        view: GrayView<'_>,
        camera: Option<&CameraModel>,
        allowed: Allowed,
        stages: &mut impl Stages,
    ) {
        let is_needed = |found: &[Observation]| self.settings.thorough || found.is_empty();
        let passes = &self.slow_passes;
        let is_open = |pass| passes.contains(&pass) && allowed.has(pass);
        let scales = Scale::ALL.map(|scale| is_open(SlowPass::Segments(scale)).then_some(scale));
        let has_segments = scales.iter().any(Option::is_some);
        self.broken.begin(scales);
        if has_segments && self.squares.note_missing(is_needed(&self.found)) {
            if self.broken.make(view, self.outlines.pyramid()) {
                stages.ended("segments");
            }
            let input = ImageInput { view, pyramid: self.outlines.pyramid(), camera };
            let mut out = Output { trace: &mut self.trace, found: &mut self.found };
            self.squares.detect_occluded(input, self.broken.quads(), stages, &mut out);
        }
        let thirds = Third::ALL.map(|third| is_open(SlowPass::Papers(third)).then_some(third));
        if thirds.iter().any(Option::is_some) && is_needed(&self.found) {
            let first = self.outlines.len();
            for third in thirds.into_iter().flatten() {
                self.outlines.add_rows(view, &PAPERS, third.rows(view.height()));
            }
            self.papers.clear();
            self.papers.extend(quiet_zone_quads(view, &self.outlines, first));
            let input = ImageInput { view, pyramid: self.outlines.pyramid(), camera };
            let mut out = Output { trace: &mut self.trace, found: &mut self.found };
            self.squares.detect_in_quiet_zones(input, &self.papers, &mut out);
            if self.stags.is_missing(is_needed(out.found), out.found) {
                self.stags.detect_in_quiet_zones(input, &self.papers, &mut out);
            }
            stages.ended("papers");
        }
        if has_segments && self.stags.is_missing(is_needed(&self.found), &self.found) {
            let pyramid = self.outlines.pyramid();
            if self.broken.make(view, pyramid) {
                stages.ended("segments");
            }
            let input = ImageInput { view, pyramid, camera };
            let mut out = Output { trace: &mut self.trace, found: &mut self.found };
            self.stags.detect_occluded(input, self.broken.quads(), stages, &mut out);
        }
    }

    /// What the last detection saw on its way.
    pub fn trace(&self) -> &Trace {
        &self.trace
    }
}
