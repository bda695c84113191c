//! The detector of the three-ring marker with the thesis' faults mended.
//!
//! The same steps as [`crate::rings_thesis`], with these differences. The threshold follows the light
//! ([`imaging::LocalThreshold`]) and the image is not smoothed first, which would close rings thinner than the
//! filter. Orientations are compared only where ellipses have one. Tolerances grow with the marker, except for the
//! pixel that a small one needs. A ring that passes is a question, not an answer: it says where in space the
//! marker would be, and all six edges of the marker are then looked for where that pose puts them, between the
//! pixels of the image as the camera gave it (`search`). They refine the pose, whose centre is the true projection
//! of the marker's, and decide whether it is believed.

use std::f64::consts::TAU;

use geometry::CameraModel;
use imaging::{
    Contours, Ellipse, GrayImage, GrayView, LeastContrast, Limits, LocalThreshold, bilinear,
};

use crate::circles::{EdgePoint, pixel_covariance, project};
use crate::lens::{guess_lens, nominal_camera};
use crate::marker::{Family, Marker};
use crate::observation::{MarkerPose, Observation, PoseSolution, Stages};
use crate::outline::{Outline, add_outlines};
use crate::photometry::Spot;
use crate::ring::{Ring, RingKind};
use crate::rings_thesis::{T_ORIENTATION, T_TYPE};
use crate::search::{LEAST_STEP, Search};
use crate::trace::{Reason, Trace};

/// Smaller differences are not edges. Black ink seldom has more than a quarter of white paper's brightness; a thin ring
/// far away keeps half of that difference.
const LEAST_CONTRAST: LeastContrast = LeastContrast { levels: 14, percent: 20 };
/// The least share of paper's light that ink lacks.
const LEAST_RING_CONTRAST: f64 = 0.15;
/// Bounds, far above what a frame with a marker needs, so that no image takes long.
const MOST_CONTOUR_POINTS: usize = 2_000_000;
const MOST_ELLIPSES: usize = 20_000;
const MOST_PAIRS: usize = 40_000;
const MOST_CANDIDATES: usize = 64;
const MOST_MARKERS: usize = 8;

/// The detector's working memory.
#[derive(Debug, Default)]
pub struct Rings {
    local: LocalThreshold,
    binary: GrayImage,
    contours: Contours,
    outlines: Vec<Outline>,
    candidates: Vec<Candidate>,
    edges: Vec<EdgePoint>,
    spots: Vec<Spot>,
}

/// A ring to be looked into, and how much of the light of what is around it lacks, as a share.
#[derive(Copy, Clone, Debug)]
struct Candidate {
    ring: Ring,
    contrast: f64,
}

impl Rings {
    /// Finds the markers; the surest comes first.
    pub fn detect(
        &mut self,
        view: GrayView<'_>,
        marker: &Marker,
        camera: Option<&CameraModel>,
        (trace, stages): (&mut Trace, &mut impl Stages),
        found: &mut Vec<Observation>,
    ) {
        self.find_ellipses(view, stages);
        trace.ellipses.extend(self.outlines.iter().map(|o| o.ellipse));
        self.find_rings(view, trace);
        stages.ended("rings");
        let nominal = nominal_camera(view);
        let first = found.len();
        for index in 0..self.candidates.len() {
            let candidate = self.candidates[index];
            let taken =
                |o: &Observation| o.centre.distance(&candidate.ring.centre) < o.size_px / 2.0;
            let outcome = if found[first..].iter().any(taken) {
                Err(Reason::Repeated)
            } else {
                self.look_into(view, &candidate, marker, camera, &nominal)
            };
            match outcome {
                Ok(observation) => found.push(observation),
                Err(reason) => trace.refuse(candidate.ring.inner, candidate.ring.outer, reason),
            }
            if found.len() - first >= MOST_MARKERS {
                break;
            }
        }
        found[first..].sort_unstable_by(|a, b| b.confidence.total_cmp(&a.confidence));
        stages.ended("matching");
    }

    fn find_ellipses(&mut self, view: GrayView<'_>, stages: &mut impl Stages) {
        self.local.apply(view, LEAST_CONTRAST, &mut self.binary);
        stages.ended("threshold");
        if let Some(binary) = self.binary.view() {
            let limits = Limits { least_points: 5, most_points: MOST_CONTOUR_POINTS };
            self.contours.find(binary, limits);
        }
        stages.ended("contours");
        self.outlines.clear();
        for contour in self.contours.iter() {
            add_outlines(&contour, &view, &mut self.outlines);
            if self.outlines.len() >= MOST_ELLIPSES {
                break;
            }
        }
        stages.ended("ellipses");
    }

    /// The rings among the pairs of ellipses, largest first.
    fn find_rings(&mut self, view: GrayView<'_>, trace: &mut Trace) {
        self.candidates.clear();
        self.outlines.sort_unstable_by(|a, b| a.ellipse.centre[0].total_cmp(&b.ellipse.centre[0]));
        let mut pairs = 0;
        for (i, outer) in self.outlines.iter().enumerate().filter(|(_, o)| o.black_within) {
            let reach = concentric_tolerance(&outer.ellipse);
            let x = outer.ellipse.centre[0];
            let after = self.outlines[i + 1..].iter();
            let before = self.outlines[..i].iter().rev();
            let near = after
                .take_while(|o| o.ellipse.centre[0] - x <= reach)
                .chain(before.take_while(|o| x - o.ellipse.centre[0] <= reach))
                .filter(|o| !o.black_within);
            let distance = |o: &Outline| {
                let [a, b] = [o.ellipse.centre, outer.ellipse.centre];
                (a[0] - b[0]).hypot(a[1] - b[1])
            };
            for inner in near.filter(|o| distance(o) <= reach) {
                pairs += 1;
                match ring_of(view, &outer.ellipse, &inner.ellipse) {
                    Ok(candidate) => self.candidates.push(candidate),
                    Err(Some(reason)) => trace.refuse(inner.ellipse, outer.ellipse, reason),
                    Err(None) => {}
                }
            }
            if pairs >= MOST_PAIRS {
                break;
            }
        }
        self.candidates.sort_unstable_by(|a, b| b.ring.outer.major.total_cmp(&a.ring.outer.major));
        self.candidates.truncate(MOST_CANDIDATES);
        trace.rings.extend(self.candidates.iter().map(|c| c.ring));
    }

    /// Whether a ring is part of a marker, and where that marker is.
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
        let search =
            Search { view, camera: lens, size_m, least_contrast: 0.35 * candidate.contrast };
        let kind = candidate.ring.kind;
        let seen = match search.whole(&candidate.ring, &mut self.edges, &mut self.spots) {
            Ok(seen) => seen,
            Err(reason) => search
                .alone(&candidate.ring, &mut self.edges)
                .filter(|_| kind != RingKind::Inner)
                .ok_or(reason)?,
        };
        let guessed = match camera {
            Some(_) => None,
            None => guess_lens(&seen.circles, lens, &mut self.edges),
        };
        let (circles, lens) = guessed.unwrap_or((seen.circles, *lens));
        let pose = marker.size_m.and(camera).map(|_| MarkerPose {
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
            pixel_covariance(seen.circles.centre, &of_centre, search.camera).ok_or(Reason::Pose)?;
        let centre = project(circles.centre, &lens).ok_or(Reason::Pose)?;
        let outline = circles.outline(size_m / 2.0, &lens).ok_or(Reason::Pose)?;
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
}

/// How far apart the centres of one ring's ellipses may be, in pixels (Algorithm 2): perspective moves them apart
/// in proportion to their size.
fn concentric_tolerance(outer: &Ellipse) -> f64 {
    1.0 + 0.06 * outer.major
}

/// The further checks of Algorithm 7 on an ellipse with black inside and one with white inside. A refusal without a
/// reason is of a pair too unlike a ring to be worth a word.
fn ring_of(
    view: GrayView<'_>,
    outer: &Ellipse,
    inner: &Ellipse,
) -> Result<Candidate, Option<Reason>> {
    if inner.major >= outer.major {
        return Err(None);
    }
    // Half a pixel on each side may be wrong in any length.
    let slack = |length: f64| 0.7 / length;
    let (outer_shape, inner_shape) = (outer.minor / outer.major, inner.minor / inner.major);
    if (outer_shape - inner_shape).abs() > 0.1 + slack(inner.major) {
        return Err(Some(Reason::Eccentricity));
    }
    if outer_shape.max(inner_shape) < 0.85 && inner.major > 10.0 {
        // An ellipse turned by half a turn is the same.
        let twice = 2.0 * (outer.angle - inner.angle);
        if twice.sin().atan2(twice.cos()).abs() > 2.0 * T_ORIENTATION {
            return Err(Some(Reason::Orientation));
        }
    }
    let tolerance = T_TYPE + slack(outer.minor);
    let (ratio_minor, ratio_major) = (inner.minor / outer.minor, inner.major / outer.major);
    let misfit = |kind: &RingKind| {
        (ratio_minor - kind.ratio()).abs().max((ratio_major - kind.ratio()).abs())
    };
    let kind = RingKind::ALL
        .into_iter()
        .min_by(|a, b| misfit(a).total_cmp(&misfit(b)))
        .filter(|kind| misfit(kind) < tolerance)
        .ok_or(Some(Reason::Type))?;
    let contrast = ring_contrast(view, inner, outer).ok_or(Some(Reason::Blackness))?;
    Ok(Candidate { ring: Ring::new(kind, *inner, *outer), contrast })
}

/// What share of the light of what is within and around it a ring lacks (the middle of the shares), if it does so
/// nearly all round (Algorithm 6, in its own light, which may differ from side to side).
fn ring_contrast(view: GrayView<'_>, inner: &Ellipse, outer: &Ellipse) -> Option<f64> {
    const DIRECTIONS: u32 = 24;
    // Within and around, a fifth of the way round.
    const LEAST_PLACES: usize = 10;
    let mut shares = [0.0; 2 * DIRECTIONS as usize];
    let mut count = 0;
    for i in 0..DIRECTIONS {
        let t = f64::from(i) * TAU / f64::from(DIRECTIONS);
        // Near-circles have axes in any direction: the place on the inner one is found from the outer one's.
        let to = outer.at(t);
        let share = inner.radius_of(to).max(1e-9);
        let from = [0, 1].map(|axis| inner.centre[axis] + (to[axis] - inner.centre[axis]) / share);
        let at = |place: f64| {
            let between = |axis: usize| from[axis] + (to[axis] - from[axis]) * place;
            bilinear(view, between(0), between(1))
        };
        // Within, no further than the middle of the marker is.
        let inwards = 0.5_f64.min(0.9 * inner.minor / (outer.minor - inner.minor).max(1e-9));
        let Some(black) = at(0.5) else { continue };
        for white in [at(-inwards), at(1.5)].into_iter().flatten() {
            if let Some(slot) = shares.get_mut(count) {
                *slot = if white - black < LEAST_STEP { 0.0 } else { (white - black) / white };
                count += 1;
            }
        }
    }
    let shares = shares.get_mut(..count).filter(|shares| shares.len() >= LEAST_PLACES)?;
    shares.sort_unstable_by(f64::total_cmp);
    let median = shares.get(count / 2).copied()?;
    let low = shares.get(count / 5).copied()?;
    (median > LEAST_RING_CONTRAST && low > 0.3 * median).then_some(median)
}
