//! The detector of the three-ring marker, second generation.
//!
//! The outlines of dark regions ([`imaging::Outlines`], which need no threshold) that are ellipses, or show arcs of such, may
//! be any of the marker's circles (`outline`). Whether one is, the bands about it say
//! (`profile`): a lone ring is not enough. From the circle follows where in space the marker would be; all
//! its edges are looked for where that pose puts them, between the pixels of the image as the camera gave it
//! (`search`), or, of a small marker, the whole picture is fitted to its grey values
//! (`photometry`). That refines the pose, whose centre is the true projection of the
//! marker's, and decides whether it is believed.

pub(crate) mod circle_pose;
mod edges;
mod focal_guess;
mod photometric;

use geometry::{CameraModel, Pixel};
use imaging::pyramid::{from_level_0, to_level_0};
use imaging::{Ellipse, GrayView, Outlines, Pyramid, outline};
use markers::{Family, Marker, RingKind};

use crate::candidates::ellipses::{Border, add_arcs, whole_border};
use crate::candidates::ring::Ring;
use crate::candidates::ring_profile::{Candidate, candidates, speck};
use crate::detector::{Allowed, SlowPass};
use crate::families::rings::circle_pose::{CirclePose, EdgePoint, pixel_covariance, project};
use crate::families::rings::edges::{Search, Seen};
use crate::families::rings::focal_guess::{guess_lens, nominal_camera};
use crate::families::rings::photometric::PixelSample;
use crate::observation::{MarkerPose, Observation, PoseSolution, Stages};
use crate::trace::{Reason, Trace};

/// Where the marker is looked for; what comes later only when it was not found before.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
enum Stage {
    /// Outlines that are ellipses, on levels of the image's pyramid from this one on up to the other.
    Whole(usize, usize),
    /// Outlines that show arcs of ellipses.
    Parts,
    /// Bright specks, which may be the paper of a marker far away.
    Specks,
}

/// The largest markers first, which take the least time to find.
const STAGES: [Stage; 5] = [
    Stage::Whole(2, usize::MAX),
    Stage::Whole(1, 2),
    Stage::Whole(0, 1),
    Stage::Parts,
    Stage::Specks,
];

/// Regions of any shape that are large enough to show arcs.
const PARTS: outline::Settings = outline::Settings {
    dark_from: Some(2),
    bright_from: None,
    whole_level: 2,
    min_size_px: 16,
    max_size_px: 36,
    min_contrast: 14,
    min_contrast_percent: 12,
    steep: true,
    min_fill: 0.02,
    max_raggedness: 5.0,
};

/// Regions as small as the paper of a marker far away.
const SPECKS: outline::Settings = outline::Settings {
    dark_from: None,
    bright_from: Some(1),
    whole_level: usize::MAX,
    min_size_px: 4,
    max_size_px: 16,
    steep: false,
    min_fill: 0.5,
    max_raggedness: 1.3,
    ..PARTS
};

impl Stage {
    /// What it is of the detector's slow passes, for markers that are cut or hidden in part, or very far.
    fn slow_pass(self) -> Option<SlowPass> {
        match self {
            Self::Whole(..) => None,
            Self::Parts => Some(SlowPass::Arcs),
            Self::Specks => Some(SlowPass::Specks),
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Whole(..) => "ellipses",
            Self::Parts => "arcs",
            Self::Specks => "specks",
        }
    }
}

/// Bounds, far above what a frame with a marker needs, so that no image takes long.
const MOST_BORDERS: usize = 4000;
const MOST_ARC_FITS: usize = 3000;
const MOST_CANDIDATES: usize = 400;
const MOST_LOOKED_INTO: usize = 20;
/// The same of candidates with a lower score than this, which hardly any marker has.
const MOST_DOUBTFUL: usize = 6;
const DOUBTFUL: f64 = 0.75;
const MOST_MARKERS: usize = 8;
/// Levels of the pyramid on which what noise hides is looked for, and the least diameter there, in pixels.
const COARSER: [usize; 2] = [1, 2];
const LEAST_FROM_AFAR_PX: f64 = 16.0;
/// Confidence that is believed there: every edge of the pattern is seen, or a ring that is not quite ours passes too.
const LEAST_FROM_AFAR: f64 = 0.75;
/// What a followed marker's dark rings lack of the light beside them at least, as a share.
const LEAST_CONTRAST: f64 = 0.15;
/// What looks like the marker less than this share of how much one does that was found is no other one.
const LEAST_OF_BEST: f64 = 0.8;

/// The detector's working memory.
#[derive(Debug, Default)]
pub struct Rings {
    /// Whether white rings on black are looked for.
    inverted: bool,
    /// Whether everything is looked at, whatever was found.
    thorough: bool,
    borders: Vec<Border>,
    candidates: Vec<Candidate>,
    edges: Vec<EdgePoint>,
    spots: Vec<PixelSample>,
}

impl Rings {
    /// Looks for white rings on black as well when `inverted`, and on where some were found when `thorough`.
    pub fn new(inverted: bool, thorough: bool) -> Self {
        Self { inverted, thorough, ..Self::default() }
    }

    /// Makes the buffers as large as frames with texture need.
    pub(crate) fn make_room(&mut self) {
        const MOST: usize = 1024;
        self.borders.clear();
        self.borders.reserve(MOST);
        self.candidates.clear();
        self.candidates.reserve(MOST);
        self.edges.clear();
        self.edges.reserve(MOST);
        self.spots.clear();
        self.spots.reserve(MOST);
    }

    /// Finds the markers in an image; the surest comes first. `outlines` has the outlines of that image as other families
    /// share them, or, when it is told to be empty, only its pyramid; what else is looked at is added to it. When markers of
    /// other families are among `found`, only those that are whole are looked for.
    pub(crate) fn detect(
        &mut self,
        (view, outlines, is_empty): (GrayView<'_>, &mut Outlines, bool),
        marker: &Marker,
        (camera, allowed): (Option<&CameraModel>, Allowed),
        (trace, stages): (&mut Trace, &mut impl Stages),
        found: &mut Vec<Observation>,
    ) {
        let nominal = nominal_camera(view);
        let first = found.len();
        for stage in STAGES {
            // Who has something to land on need not look harder.
            let is_closed = |pass| first > 0 && !self.thorough || !allowed.has(pass);
            if stage.slow_pass().is_some_and(is_closed) {
                continue;
            }
            self.find_candidates((view, outlines, is_empty), stage);
            trace.ellipses.extend(self.borders.iter().map(|b| b.ellipse));
            trace.rings.extend(self.candidates.iter().map(ring));
            stages.ended(stage.name());
            let seen = (view, outlines.pyramid());
            let lens = (camera, &nominal, allowed.has(SlowPass::Arcs));
            self.look_into_all(seen, marker, lens, trace, (found, first));
            stages.ended("matching");
            if found.len() > first && !self.thorough {
                break;
            }
        }
        found[first..].sort_unstable_by(|a, b| b.confidence.total_cmp(&a.confidence));
    }

    /// Finds the marker that should be about here.
    pub(crate) fn detect_at(
        &mut self,
        view: GrayView<'_>,
        marker: &Marker,
        camera: &CameraModel,
        expected: &CirclePose,
    ) -> Option<Observation> {
        let size_m = marker.size_m?;
        let search = Search { view, camera, size_m, min_contrast: LEAST_CONTRAST, inverted: false };
        let seen = search.again(expected, &mut self.edges, &mut self.spots)?;
        observed(&seen, (seen.circles, camera), (Some(size_m), Some(camera)), camera).ok()
    }

    /// The circles that may be the marker's, those that look most like it first.
    fn find_candidates(
        &mut self,
        (view, outlines, is_empty): (GrayView<'_>, &mut Outlines, bool),
        stage: Stage,
    ) {
        self.borders.clear();
        self.candidates.clear();
        match stage {
            Stage::Whole(finest, end) => {
                if is_empty {
                    outlines.add(view, &outline::Settings::default(), finest..end);
                }
                let dark = outlines.iter().filter(|o| o.dark && (finest..end).contains(&o.level));
                let whole = dark.filter_map(|o| whole_border(&o));
                self.borders.extend(whole.take(MOST_BORDERS));
            }
            Stage::Parts => {
                let first = outlines.len();
                outlines.add(view, &PARTS, 0..usize::MAX);
                self.find_arcs(view, outlines, first);
            }
            Stage::Specks => {
                let first = outlines.len();
                outlines.add(view, &SPECKS, 0..usize::MAX);
                let specks = outlines.iter().skip(first).take(MOST_BORDERS);
                let specks = specks.filter_map(|o| speck(view, &o));
                self.candidates.extend(specks.take(MOST_CANDIDATES));
            }
        }
        for border in &self.borders {
            candidates(view, border, &mut self.candidates);
            if self.candidates.len() >= MOST_CANDIDATES {
                break;
            }
        }
        let inverted = self.inverted;
        self.candidates.retain(|candidate| inverted || !candidate.inverted);
        let worth = |c: &Candidate| c.score + if c.border.whole { 0.1 } else { 0.0 };
        self.candidates.sort_unstable_by(|a, b| worth(b).total_cmp(&worth(a)));
        // The same circle is seen on several levels.
        let mut kept = 0;
        for index in 0..self.candidates.len() {
            let candidate = self.candidates[index];
            if !self.candidates[..kept].iter().any(|c| is_same(c, &candidate)) {
                self.candidates[kept] = candidate;
                kept += 1;
            }
        }
        self.candidates.truncate(kept);
    }

    /// Takes the arcs of the outlines from the index `first` on.
    fn find_arcs(&mut self, view: GrayView<'_>, outlines: &Outlines, first: usize) {
        let mut budget = MOST_ARC_FITS;
        for outline in outlines.iter().skip(first) {
            if whole_border(&outline).is_some() {
                continue;
            }
            let level = outlines.pyramid().level(view, outline.level);
            let Some(size) = level.map(|v| [v.width(), v.height()]) else { continue };
            add_arcs(&outline, size, &mut budget, &mut self.borders);
            if budget == 0 || self.borders.len() >= MOST_BORDERS {
                return;
            }
        }
    }

    /// Adds the markers among the candidates to those found from the index `first` on, looking on coarser levels as well when
    /// `from_afar`.
    fn look_into_all(
        &mut self,
        (view, pyramid): (GrayView<'_>, &Pyramid),
        marker: &Marker,
        (camera, nominal, from_afar): (Option<&CameraModel>, &CameraModel, bool),
        trace: &mut Trace,
        (found, first): (&mut Vec<Observation>, usize),
    ) {
        let (mut least_score, mut doubtful) = (0.0_f64, 0);
        for index in 0..self.candidates.len().min(MOST_LOOKED_INTO) {
            let candidate = self.candidates[index];
            if candidate.score < least_score {
                continue;
            }
            if candidate.score < DOUBTFUL {
                doubtful += 1;
                if doubtful > MOST_DOUBTFUL {
                    break;
                }
            }
            let [x, y] = candidate.border.ellipse.centre;
            let taken = |o: &Observation| (o.centre.x - x).hypot(o.centre.y - y) < o.size_px / 2.0;
            let outcome = if found[first..].iter().any(taken) {
                Err(Reason::Repeated)
            } else {
                let seen = self.look_into(view, &candidate, marker, camera, nominal);
                if seen.is_err() && from_afar && found.len() == first {
                    let eyes = (view, pyramid, camera.unwrap_or(nominal));
                    self.look_from_afar(eyes, &candidate, marker, camera.is_some()).or(seen)
                } else {
                    seen
                }
            };
            match outcome {
                Ok(observation) => {
                    found.push(observation);
                    least_score = least_score.max(LEAST_OF_BEST * candidate.score);
                }
                Err(reason) => {
                    let Ring { inner, outer, .. } = ring(&candidate);
                    trace.refuse(inner, outer, reason);
                }
            }
            if found.len() - first >= MOST_MARKERS {
                break;
            }
        }
    }

    /// As [`Rings::look_into`] on coarser levels of the pyramid, where noise has averaged out.
    fn look_from_afar(
        &mut self,
        (view, pyramid, camera): (GrayView<'_>, &Pyramid, &CameraModel),
        candidate: &Candidate,
        marker: &Marker,
        is_known: bool,
    ) -> Result<Observation, Reason> {
        let mut last = Err(Reason::Edges);
        for level in COARSER {
            let scale = to_level_0(1.0, level) - to_level_0(0.0, level);
            if candidate.diameter_px() < LEAST_FROM_AFAR_PX * scale {
                break;
            }
            let Some(coarse) = pyramid.level(view, level) else { break };
            let lens = camera_on_level(camera, coarse, level);
            let mut smaller = *candidate;
            let Ellipse { centre, minor, major, .. } = &mut smaller.border.ellipse;
            *centre = centre.map(|c| from_level_0(c, level));
            (*minor, *major) = (*minor / scale, *major / scale);
            let camera = is_known.then_some(&lens);
            last = self.look_into(coarse, &smaller, marker, camera, &lens);
            if let Ok(observation) = last {
                if observation.confidence >= LEAST_FROM_AFAR {
                    return Ok(in_image(observation, level));
                }
                last = Err(Reason::Edges);
            }
        }
        last
    }

    /// Whether a candidate is part of a marker, and where that marker is.
    fn look_into(
        &mut self,
        view: GrayView<'_>,
        candidate: &Candidate,
        marker: &Marker,
        camera: Option<&CameraModel>,
        nominal: &CameraModel,
    ) -> Result<Observation, Reason> {
        let size_m = marker.size_m.unwrap_or(1.0);
        let lens = camera.unwrap_or(nominal);
        let search = Search {
            view,
            camera: lens,
            size_m,
            min_contrast: 0.35 * candidate.contrast,
            inverted: candidate.inverted,
        };
        let seen = search.marker(candidate, &mut self.edges, &mut self.spots)?;
        let guessed = match camera {
            Some(_) => None,
            None => guess_lens(&seen.circles, lens, &mut self.edges),
        };
        let (circles, lens) = guessed.unwrap_or((seen.circles, *lens));
        observed(&seen, (circles, &lens), (marker.size_m, camera), search.camera)
    }
}

/// The camera whose image a level of the pyramid is.
fn camera_on_level(camera: &CameraModel, view: GrayView<'_>, level: usize) -> CameraModel {
    let scale = to_level_0(1.0, level) - to_level_0(0.0, level);
    CameraModel {
        width: view.width() as u32,
        height: view.height() as u32,
        fx: camera.fx / scale,
        fy: camera.fy / scale,
        cx: from_level_0(camera.cx, level),
        cy: from_level_0(camera.cy, level),
        ..*camera
    }
}

/// What was observed on a level of the pyramid, in pixels of the image.
fn in_image(mut observation: Observation, level: usize) -> Observation {
    let scale = to_level_0(1.0, level) - to_level_0(0.0, level);
    let Pixel { x, y } = observation.centre;
    observation.centre = Pixel::new(to_level_0(x, level), to_level_0(y, level));
    observation.centre_covariance_px2 *= scale * scale;
    observation.size_px *= scale;
    if let Some(pose) = &mut observation.pose {
        pose.reprojection_rms_px *= scale;
        if let Some(other) = &mut pose.alternative {
            other.reprojection_rms_px *= scale;
        }
    }
    observation
}

/// A marker that was seen, its circles through a lens that may be guessed.
fn observed(
    seen: &Seen,
    (circles, lens): (CirclePose, &CameraModel),
    (size_m, camera): (Option<f64>, Option<&CameraModel>),
    nominal: &CameraModel,
) -> Result<Observation, Reason> {
    let pose = size_m.and(camera).map(|_| MarkerPose {
        camera_from_marker: circles.camera_from_marker(),
        reprojection_rms_px: seen.rms_px,
        covariance: seen.covariance,
        alternative: seen.other.map(|(other, reprojection_rms_px)| PoseSolution {
            camera_from_marker: other.camera_from_marker(),
            reprojection_rms_px,
        }),
    });
    let of_centre = seen.covariance.fixed_view::<3, 3>(0, 0).into_owned();
    let centre_covariance_px2 =
        pixel_covariance(seen.circles.centre, &of_centre, nominal).ok_or(Reason::Pose)?;
    let centre = project(circles.centre, lens).ok_or(Reason::Pose)?;
    let outline = circles.projected(size_m.unwrap_or(1.0) / 2.0, lens).ok_or(Reason::Pose)?;
    Ok(Observation {
        family: Family::Rings,
        id: None,
        centre,
        centre_covariance_px2,
        corners: None,
        wrong_bits: 0,
        size_px: outline.major,
        confidence: seen.confidence,
        pose,
    })
}

/// Whether two candidates are one circle.
fn is_same(a: &Candidate, b: &Candidate) -> bool {
    let [first, second] = [a, b].map(|c| c.border.ellipse);
    let off = (first.centre[0] - second.centre[0]).hypot(first.centre[1] - second.centre[1]);
    a.radius == b.radius
        && off < 0.1 * first.minor
        && (first.minor / second.minor - 1.0).abs() < 0.15
}

/// The ring of which a candidate is one edge.
fn ring(candidate: &Candidate) -> Ring {
    let Candidate { border, radius, .. } = *candidate;
    let of = |kind: &RingKind| kind.radii().0 - 1e-6 <= radius && radius <= kind.radii().1 + 1e-6;
    let kind = RingKind::ALL.into_iter().find(of).unwrap_or(RingKind::Outer);
    let scaled = |to: f64| {
        let factor = to / radius;
        let Ellipse { minor, major, .. } = border.ellipse;
        Ellipse { minor: minor * factor, major: major * factor, ..border.ellipse }
    };
    let (inner, outer) = kind.radii();
    Ring::new(kind, scaled(inner), scaled(outer))
}
