//! Detects the three-ring marker: candidate ellipses, their radial profile, a pose by edges or by grey values, and the
//! checks that it is one, pass by pass.
//!
//! Ellipses among the outlines of dark regions ([`imaging::Outlines`], no threshold needed), complete or in
//! arcs, may be any of the marker's circles. The radial profile around an ellipse decides: a single ring is
//! not enough. From the circle follows a pose of the marker; its edges are located where that pose predicts
//! them (`edges`) or, for a small marker, a model is fitted to the grey values (`photometric`). That refines
//! the pose (`circle_pose`), whose centre is the true projection of the marker's, and decides whether it is
//! one (`measure`).

pub(crate) mod circle_pose;
mod dot;
mod edges;
mod flatness;
mod focal_guess;
mod measure;
mod photometric;

use std::ops::Range;

use geometry::{CameraModel, Roi};
use imaging::pyramid::{from_level_0, to_level_0};
use imaging::{Ellipse, GrayView, Outlines, Places, Pyramid, outline};
use markers::{Family, Marker};

use crate::candidates::ellipses::{EllipseCandidate, add_arc_ellipses, complete_ellipse};
use crate::candidates::evidence::Needs;
use crate::candidates::overlap::suppress_non_maxima;
use crate::candidates::ring::Ring;
use crate::candidates::ring_profile::{RingCandidate, add_ring_candidates, blob};
use crate::families::family::{FamilyDetector, FrameInput, Output, PredictedShape, Prediction};
use crate::observation::{MarkerPose, Observation, PoseSolution};
use crate::schedule::{FallbackPass, FallbackStep};
use crate::settings::Settings;
use crate::trace::{Reason, Trace};
use circle_pose::{CirclePose, pixel_covariance, project};
use edges::EdgeSearch;
use focal_guess::{guess_focal_length, nominal_camera};
use measure::{Buffers, MeasuredMarker, ring_with_circle};

/// A search of the image; each runs only when those before found nothing.
#[derive(Clone, Debug, PartialEq, Eq)]
enum RingPass {
    /// Complete ellipses, on these levels of the pyramid.
    Ellipses(Range<usize>),
    /// Arcs of ellipses, on coarse levels.
    Arcs,
    /// The same on a finer level, for markers of 32 to 72 px, only in places with the contrast of ink on paper: elsewhere there are
    /// too many of them.
    FineArcs,
    /// Bright blobs, which may be the paper of a marker far away.
    Blobs,
}

/// The largest markers first, which are found fastest.
const PASSES: [RingPass; 3] =
    [RingPass::Ellipses(2..usize::MAX), RingPass::Ellipses(1..2), RingPass::Ellipses(0..1)];

/// Regions of any shape that are large enough to show arcs.
const ARC_REGIONS: outline::Settings = outline::Settings {
    dark_from: Some(1),
    bright_from: None,
    whole_level: 2,
    min_size_px: 16,
    max_size_px: 36,
    min_contrast: 14,
    min_contrast_percent: 12,
    threshold_256ths: 128,
    steep: true,
    min_fill: 0.02,
    max_raggedness: 5.0,
};

/// Regions as small as the paper of a marker far away.
const BLOB_REGIONS: outline::Settings = outline::Settings {
    dark_from: None,
    bright_from: Some(1),
    whole_level: usize::MAX,
    min_size_px: 4,
    max_size_px: 22,
    steep: false,
    min_fill: 0.5,
    max_raggedness: 1.3,
    ..ARC_REGIONS
};

impl RingPass {
    fn name(&self) -> &'static str {
        match self {
            Self::Ellipses(_) => "ellipses",
            Self::Arcs => "arcs",
            Self::FineArcs => "fine arcs",
            Self::Blobs => "blobs",
        }
    }
}

/// Bounds on the time for any image, far above the needs of a frame with a marker.
const MAX_ELLIPSES: usize = 4000;
const MAX_ARC_FITS: usize = 3000;
const MAX_CANDIDATES: usize = 400;
const MAX_EVALUATED: usize = 20;
/// Maximum number of candidates of an image that is also searched brightened: one with more has no lack of outlines.
const MAX_BEFORE_BRIGHTENED: usize = 64;
/// Maximum number of evaluated candidates with a score below `DOUBTFUL_SCORE`, which hardly any marker has.
const MAX_DOUBTFUL: usize = 6;
const DOUBTFUL_SCORE: f64 = 0.75;
const MAX_MARKERS: usize = 8;
/// Levels of the pyramid on which noisy candidates are evaluated again, and the minimum diameter there, in
/// pixels.
const COARSE_LEVELS: [usize; 2] = [1, 2];
const MIN_COARSE_PX: f64 = 16.0;
/// Minimum confidence there: with fewer edges, rings that are not the marker's pass too.
const MIN_COARSE_CONFIDENCE: f64 = 0.75;
/// Minimum relative contrast of a tracked marker's dark rings.
const MIN_TRACKED_CONTRAST: f64 = 0.15;
/// Candidates whose score is below this fraction of a detected marker's are dropped.
const MIN_SCORE_RATIO: f64 = 0.8;

/// Detects three-ring markers. Its buffers are reused from image to image.
#[derive(Debug)]
pub(crate) struct RingDetector {
    marker: Marker,
    /// Number of observations in the image before those of this detector.
    first: usize,
    /// Whether white rings on black are searched.
    white_on_black: bool,
    /// Whether all passes run, also after a marker was found.
    thorough: bool,
    /// Number of candidates among the image's complete ellipses.
    complete: usize,
    ellipses: Vec<EllipseCandidate>,
    candidates: Vec<RingCandidate>,
    buffers: Buffers,
}

/// The image on which candidates are evaluated.
#[derive(Copy, Clone)]
struct Evaluation<'a> {
    view: GrayView<'a>,
    marker: &'a Marker,
    /// The camera, if it is known, and the one to compute with.
    known_camera: Option<&'a CameraModel>,
    camera: &'a CameraModel,
    /// Where markers that are followed should be.
    followed: &'a [Prediction],
    shadow_removed: bool,
}

impl RingDetector {
    /// Detects this marker.
    pub(crate) fn new(marker: Marker, settings: Settings) -> Self {
        Self {
            marker,
            first: 0,
            white_on_black: settings.inverted,
            thorough: settings.thorough,
            complete: 0,
            ellipses: Vec::new(),
            candidates: Vec::new(),
            buffers: Buffers::default(),
        }
    }

    fn reserve(&mut self) {
        const ROOM: usize = 1024;
        self.ellipses.clear();
        self.ellipses.reserve(ROOM);
        self.candidates.clear();
        self.candidates.reserve(ROOM);
        self.buffers.edges.clear();
        self.buffers.edges.reserve(ROOM);
        self.buffers.samples.clear();
        self.buffers.samples.reserve(ROOM);
    }

    /// Searches for complete ellipses, on coarse levels first.
    fn search(&mut self, mut input: FrameInput<'_>, out: &mut Output<'_>) {
        for pass in &PASSES {
            self.run(pass, input.again(), out);
            self.complete += self.candidates.len();
            if out.found.len() > self.first && !self.thorough {
                break;
            }
        }
    }

    /// Runs one pass, and adds the markers it finds to those from the index `self.first` on.
    fn run(&mut self, pass: &RingPass, input: FrameInput<'_>, out: &mut Output<'_>) {
        let FrameInput { view, camera, evidence, schedule, followed, shadow_removed, .. } = input;
        let has_outlines = evidence.has_outlines;
        let (outlines, places) = evidence.outlines_at();
        if let RingPass::Ellipses(levels) = pass
            && !has_outlines
        {
            outlines.add_at(places, view, &outline::Settings::default(), levels.clone());
        }
        self.find_candidates(view, outlines, places, pass);
        out.trace.ellipses.extend(self.ellipses.iter().map(|e| e.ellipse));
        out.trace.rings.extend(self.candidates.iter().map(ring));
        out.stages.ended(pass.name());
        let nominal = nominal_camera(view);
        let marker = self.marker;
        let evaluation = Evaluation {
            view,
            marker: &marker,
            known_camera: camera,
            camera: camera.unwrap_or(&nominal),
            followed,
            shadow_removed,
        };
        let coarse = schedule.allows(FallbackPass::Arcs).then_some(outlines.pyramid());
        self.evaluate_candidates(&evaluation, coarse, out.trace, out.found, self.first);
        out.stages.ended("matching");
        out.found[self.first..].sort_unstable_by(|a, b| b.confidence.total_cmp(&a.confidence));
    }

    /// Finds the circles that may be the marker's, best first.
    fn find_candidates(
        &mut self,
        view: GrayView<'_>,
        outlines: &mut Outlines,
        places: Places<'_>,
        pass: &RingPass,
    ) {
        self.ellipses.clear();
        self.candidates.clear();
        match pass {
            RingPass::Ellipses(levels) => {
                let dark = outlines.iter().filter(|o| o.dark && levels.contains(&o.level));
                let ellipses = dark.filter_map(|o| complete_ellipse(&o));
                self.ellipses.extend(ellipses.take(MAX_ELLIPSES));
            }
            RingPass::Arcs => {
                let first = outlines.len();
                outlines.add(view, &ARC_REGIONS, 2..usize::MAX);
                self.find_arcs(view, outlines, first);
            }
            RingPass::FineArcs => {
                let first = outlines.len();
                outlines.add_at(places, view, &ARC_REGIONS, 1..2);
                self.find_arcs(view, outlines, first);
            }
            RingPass::Blobs => {
                let first = outlines.len();
                outlines.add_at(places, view, &BLOB_REGIONS, 0..usize::MAX);
                let blobs = outlines.iter().skip(first).take(MAX_ELLIPSES);
                let blobs = blobs.filter_map(|o| blob(view, &o));
                self.candidates.extend(blobs.take(MAX_CANDIDATES));
            }
        }
        for ellipse in &self.ellipses {
            add_ring_candidates(view, ellipse, &mut self.candidates);
            if self.candidates.len() >= MAX_CANDIDATES {
                break;
            }
        }
        let white_on_black = self.white_on_black;
        self.candidates.retain(|candidate| white_on_black || !candidate.white_on_black);
        let score = |c: &RingCandidate| c.score + if c.border.complete { 0.1 } else { 0.0 };
        // The same circle is found on several levels.
        suppress_non_maxima(&mut self.candidates, score, is_same);
    }

    /// Adds the arcs of the outlines from the index `first` on.
    fn find_arcs(&mut self, view: GrayView<'_>, outlines: &Outlines, first: usize) {
        let mut budget = MAX_ARC_FITS;
        for outline in outlines.iter().skip(first) {
            // The fast passes saw it; where they follow no outlines of this level, on the next one, where they follow all.
            if complete_ellipse(&outline).is_some() {
                continue;
            }
            let level = outlines.pyramid().level(view, outline.level);
            let Some(size) = level.map(|v| [v.width(), v.height()]) else { continue };
            add_arc_ellipses(&outline, size, &mut budget, &mut self.ellipses);
            if budget == 0 || self.ellipses.len() >= MAX_ELLIPSES {
                return;
            }
        }
    }

    /// Adds the markers among the candidates to those found from the index `first` on; on `coarse` levels as
    /// well, if there are any.
    fn evaluate_candidates(
        &mut self,
        evaluation: &Evaluation<'_>,
        coarse: Option<&Pyramid>,
        trace: &mut Trace,
        found: &mut Vec<Observation>,
        first: usize,
    ) {
        let (mut min_score, mut doubtful) = (0.0_f64, 0);
        for index in 0..self.candidates.len().min(MAX_EVALUATED) {
            let candidate = self.candidates[index];
            if candidate.score < min_score {
                continue;
            }
            if candidate.score < DOUBTFUL_SCORE {
                doubtful += 1;
                if doubtful > MAX_DOUBTFUL {
                    break;
                }
            }
            let [x, y] = candidate.border.ellipse.centre;
            let covers = |o: &Observation| (o.centre.x - x).hypot(o.centre.y - y) < o.size_px / 2.0;
            let outcome = if found[first..].iter().any(covers) {
                Err(Reason::Repeated)
            } else {
                let outcome = evaluation.evaluate(&candidate, &mut self.buffers);
                // A candidate known to be something else is so on coarse levels as well.
                let is_known = |reason| matches!(reason, Reason::Blackness | Reason::Type);
                let is_open = outcome.as_ref().is_err_and(|reason| !is_known(*reason));
                match coarse.filter(|_| is_open && found.len() == first) {
                    Some(pyramid) => {
                        self.detect_coarse(evaluation, pyramid, &candidate).or(outcome)
                    }
                    None => outcome,
                }
            };
            match outcome {
                Ok(observation) => {
                    found.push(observation);
                    min_score = min_score.max(MIN_SCORE_RATIO * candidate.score);
                }
                Err(reason) => {
                    let Ring { inner, outer, .. } = ring(&candidate);
                    trace.refuse(inner, outer, reason);
                }
            }
            if found.len() - first >= MAX_MARKERS {
                break;
            }
        }
    }

    /// Evaluates a candidate on coarser levels of the pyramid, where noise averages out.
    fn detect_coarse(
        &mut self,
        evaluation: &Evaluation<'_>,
        pyramid: &Pyramid,
        candidate: &RingCandidate,
    ) -> Result<Observation, Reason> {
        let mut last = Err(Reason::Edges);
        for level in COARSE_LEVELS {
            let scale = to_level_0(1.0, level) - to_level_0(0.0, level);
            if candidate.diameter_px() < MIN_COARSE_PX * scale {
                break;
            }
            let Some(view) = pyramid.level(evaluation.view, level) else { break };
            let roi = Roi::binned(0.0, 0.0, view.width() as u32, view.height() as u32, scale);
            let camera = roi.camera(evaluation.camera);
            let mut smaller = *candidate;
            let Ellipse { centre, minor, major, .. } = &mut smaller.border.ellipse;
            *centre = centre.map(|c| from_level_0(c, level));
            (*minor, *major) = (*minor / scale, *major / scale);
            let known_camera = evaluation.known_camera.map(|_| &camera);
            let coarse = Evaluation { view, known_camera, camera: &camera, ..*evaluation };
            last = coarse.evaluate(&smaller, &mut self.buffers);
            if let Ok(observation) = last {
                // Where the middle is beyond the frame, radii on coarse pixels are too uncertain.
                let is_likely = camera.contains(observation.centre) || !coarse.followed.is_empty();
                if is_likely && observation.confidence >= MIN_COARSE_CONFIDENCE {
                    return Ok(observation.mapped(&roi));
                }
                last = Err(Reason::Edges);
            }
        }
        last
    }
}

impl FamilyDetector for RingDetector {
    fn needs(&self) -> Needs {
        Needs { pyramid: true, quads: None }
    }

    fn fallback_steps(&self) -> &'static [FallbackStep] {
        &[FallbackStep::Arcs, FallbackStep::Blobs, FallbackStep::Brightened]
    }

    fn make_room(&mut self) {
        self.reserve();
    }

    fn wants_fallback(&mut self, step: FallbackStep, all: bool, _found: &[Observation]) -> bool {
        all && (step != FallbackStep::Brightened || self.complete <= MAX_BEFORE_BRIGHTENED)
    }

    fn detect(&mut self, input: FrameInput<'_>, out: &mut Output<'_>) {
        self.first = out.found.len();
        // How many candidates the frame itself has.
        let of_frame = input.shadow_removed.then_some(self.complete);
        self.complete = 0;
        self.search(input, out);
        self.complete = of_frame.unwrap_or(self.complete);
    }

    fn detect_at(&mut self, input: FrameInput<'_>, at: &Prediction) -> Option<Observation> {
        let FrameInput { view, camera, followed, .. } = input;
        let PredictedShape::Circles(pose) = at.shape else { return None };
        let (camera, size_m) = (camera?, self.marker.size_m?);
        if !self.marker.includes(at.family, at.id) {
            return None;
        }
        let min_contrast = MIN_TRACKED_CONTRAST;
        let search = EdgeSearch {
            view,
            camera,
            size_m,
            min_contrast,
            white_on_black: false,
            into_black_px: 0.0,
            followed,
            shadow_removed: false,
        };
        let measured = search.measure_tracked(&pose, &mut self.buffers)?;
        let marker = self.marker;
        let evaluation = Evaluation {
            view,
            marker: &marker,
            known_camera: Some(camera),
            camera,
            followed,
            shadow_removed: false,
        };
        evaluation.observation(&measured, measured.pose, camera).ok()
    }

    fn fallback(&mut self, step: FallbackStep, input: FrameInput<'_>, out: &mut Output<'_>) {
        match step {
            FallbackStep::Arcs => {
                let mut input = input;
                self.run(&RingPass::Arcs, input.again(), out);
                if out.found.len() == self.first && input.evidence.has_places() {
                    self.run(&RingPass::FineArcs, input, out);
                }
            }
            FallbackStep::Blobs => self.run(&RingPass::Blobs, input, out),
            FallbackStep::Brightened => self.search(input, out),
            _ => {}
        }
    }
}

impl Evaluation<'_> {
    /// The marker of which a candidate is part.
    fn evaluate(
        &self,
        candidate: &RingCandidate,
        buffers: &mut Buffers,
    ) -> Result<Observation, Reason> {
        let search = EdgeSearch {
            view: self.view,
            camera: self.camera,
            size_m: self.marker.size_m.unwrap_or(1.0),
            min_contrast: 0.35 * candidate.contrast,
            white_on_black: candidate.white_on_black,
            into_black_px: 0.0,
            followed: self.followed,
            shadow_removed: self.shadow_removed,
        };
        let measured = search.measure(candidate, buffers)?;
        if search.is_target(&measured.pose) && !search.is_followed(&measured.pose) {
            return Err(Reason::Blackness);
        }
        let guessed = match self.known_camera {
            Some(_) => None,
            None => guess_focal_length(&measured.pose, self.camera, &mut buffers.edges),
        };
        let (pose, camera) = guessed.unwrap_or((measured.pose, *self.camera));
        self.observation(&measured, pose, &camera)
    }

    /// A measured marker as an observation; `pose` is its pose with a `camera` that may be guessed.
    fn observation(
        &self,
        measured: &MeasuredMarker,
        pose: CirclePose,
        camera: &CameraModel,
    ) -> Result<Observation, Reason> {
        let size_m = self.marker.size_m;
        let marker_pose = size_m.and(self.known_camera).map(|_| MarkerPose {
            camera_from_marker: pose.camera_from_marker(),
            reprojection_rms_px: measured.rms_px,
            covariance: measured.covariance,
            alternative: measured.alternative.map(|other| PoseSolution {
                camera_from_marker: other.pose.camera_from_marker(),
                reprojection_rms_px: other.rms_px,
            }),
        });
        let of_centre = measured.covariance.fixed_view::<3, 3>(0, 0).into_owned();
        let centre_covariance_px2 =
            pixel_covariance(measured.pose.centre, &of_centre, self.camera).ok_or(Reason::Pose)?;
        let centre = project(pose.centre, camera).ok_or(Reason::Pose)?;
        let outline = pose.outline(size_m.unwrap_or(1.0) / 2.0, camera).ok_or(Reason::Pose)?;
        Ok(Observation {
            family: Family::Rings,
            id: None,
            centre,
            centre_covariance_px2,
            corners: None,
            wrong_bits: 0,
            size_px: outline.major,
            confidence: measured.confidence,
            pose: marker_pose,
            response: measured.response,
        })
    }
}

/// Whether two candidates are the same circle.
fn is_same(a: &RingCandidate, b: &RingCandidate) -> bool {
    let [first, second] = [a, b].map(|c| c.border.ellipse);
    let distance = (first.centre[0] - second.centre[0]).hypot(first.centre[1] - second.centre[1]);
    a.radius == b.radius
        && distance < 0.1 * first.minor
        && (first.minor / second.minor - 1.0).abs() < 0.15
}

/// The ring of which a candidate is one edge.
fn ring(candidate: &RingCandidate) -> Ring {
    let RingCandidate { border, radius, .. } = *candidate;
    let kind = ring_with_circle(radius);
    let scaled = |to: f64| {
        let factor = to / radius;
        let Ellipse { minor, major, .. } = border.ellipse;
        Ellipse { minor: minor * factor, major: major * factor, ..border.ellipse }
    };
    let (inner, outer) = kind.radii();
    Ring::new(kind, scaled(inner), scaled(outer))
}
