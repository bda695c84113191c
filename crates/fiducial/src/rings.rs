//! The detector of the three-ring marker with the thesis' faults mended.
//!
//! The same steps as [`crate::rings_thesis`], with these differences. The threshold follows the light
//! ([`imaging::LocalThreshold`]) and the image is not smoothed first, which would close rings thinner than the
//! filter. Orientations are compared only where ellipses have one. Tolerances grow with the marker, except for the
//! pixel that a small one needs. A ring that passes is a question, not an answer: it says where in space the
//! marker would be, and all six edges of the marker are then looked for where that pose puts them, between the
//! pixels of the image as the camera gave it. They refine the pose, whose centre is the true projection of the
//! marker's, and decide whether it is believed.

use std::f64::consts::{PI, TAU};

use geometry::{CameraModel, Pixel};
use imaging::{
    Contours, Ellipse, GrayImage, GrayView, LeastContrast, Limits, LocalThreshold, bilinear,
    contour_area, contour_length, fit_ellipse,
};

use crate::circles::{Circles, EdgePoint, project};
use crate::drawing::RING_RADII;
use crate::marker::{Family, Marker};
use crate::observation::{MarkerPose, Observation, Stages};
use crate::photometry::{self, Spot};
use crate::ring::{Ring, RingKind};
use crate::trace::{Reason, Trace, TracedMarker};

/// Smaller differences are not edges. Black ink seldom has more than a quarter of white paper's brightness; a thin ring
/// far away keeps half of that difference.
const LEAST_CONTRAST: LeastContrast = LeastContrast { levels: 14, percent: 20 };
/// Fewer grey levels are noise.
const LEAST_STEP: f64 = 7.0;
/// The least share of paper's light that ink lacks.
const LEAST_RING_CONTRAST: f64 = 0.15;
/// Outlines that enclose fewer square pixels say nothing about their shape.
const LEAST_AREA_PX2: f64 = 18.0;
/// Where grey values differ more from a fitted marker's, as a share of its contrast, something else is in the picture,
/// such as a shadow's edge.
const MOST_DIFFERENCE: f64 = 0.15;
/// Bounds, far above what a frame with a marker needs, so that no image takes long.
const MOST_CONTOUR_POINTS: usize = 2_000_000;
const MOST_ELLIPSES: usize = 20_000;
const MOST_PAIRS: usize = 40_000;
const MOST_CANDIDATES: usize = 64;
const MOST_MARKERS: usize = 8;

/// An ellipse, and whether black lies within it.
#[derive(Copy, Clone, Debug)]
struct Outline {
    ellipse: Ellipse,
    black_within: bool,
}

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
            match ellipse_of(contour.points, contour.hole) {
                Some(ellipse) => {
                    self.outlines.push(Outline { ellipse, black_within: !contour.hole });
                }
                None => arcs_of(contour.points, &view, &mut self.outlines),
            }
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
            for inner in near {
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
        });
        let centre = project(circles.centre, &lens).ok_or(Reason::Pose)?;
        let outline = circles.outline(size_m / 2.0, &lens).ok_or(Reason::Pose)?;
        Ok(Observation {
            family: Family::Rings,
            id: None,
            centre,
            corners: None,
            size_px: outline.major,
            confidence: seen.confidence,
            pose,
        })
    }
}

/// A marker that was looked for and seen.
#[derive(Copy, Clone, Debug)]
struct Seen {
    circles: Circles,
    rms_px: f64,
    confidence: f64,
}

/// Whether the edges lie where the pose puts them, or a small marker's grey values are what they should be: blur moves
/// the edges of thin rings, but leaves them round.
fn fits(diameter_px: f64, rms_px: f64, difference: Option<f64>) -> bool {
    if diameter_px > photometry::MOST_DIAMETER_PX {
        // Paper is not quite flat, and lenses bend.
        return rms_px < 0.3 + 0.01 * diameter_px;
    }
    rms_px < 0.3 || difference.is_some_and(|d| d < 0.04)
}

/// The focal length at which the circles fit a tilted marker's edges best: without it the true centre of a large one
/// would be a pixel off. `None` when none fits better than the `nominal` one.
fn guess_lens(
    circles: &Circles,
    nominal: &CameraModel,
    edges: &mut [EdgePoint],
) -> Option<(Circles, CameraModel)> {
    const STEPS: i32 = 9;
    const RATIO: f64 = 1.18;
    let mut best = None;
    let mut least = circles.rms_px(edges, nominal)?;
    let mut previous = 1.0;
    for step in -STEPS..=STEPS {
        let factor = RATIO.powi(step);
        let mut lens = *nominal;
        (lens.fx, lens.fy) = (nominal.fx * factor, nominal.fy * factor);
        for edge in edges.iter_mut() {
            edge.ray.x *= previous / factor;
            edge.ray.y *= previous / factor;
        }
        previous = factor;
        let mut start = *circles;
        start.centre.z *= factor;
        if let Some((found, rms)) = start.refined(edges, &lens)
            && rms < least
        {
            (best, least) = (Some((found, lens)), rms);
        }
    }
    best
}

/// A camera for images whose own is not known; the marker's centre hardly depends on it.
fn nominal_camera(view: GrayView<'_>) -> CameraModel {
    let (width, height) = (view.width() as u32, view.height() as u32);
    CameraModel::pinhole(width, height, 1.2 * f64::from(width.max(height)))
}

/// The ellipse that a contour is, on the edge itself (Algorithm 1). Contours run along dark pixels, half a pixel
/// inside of dark regions and half a pixel outside of bright ones.
fn ellipse_of(points: &[[i32; 2]], hole: bool) -> Option<Ellipse> {
    let area = contour_area(points);
    let length = contour_length(points);
    // Cheap first: an ellipse three times as long as wide has 0.65 of a circle's area per squared length, and a
    // contour along pixels is up to a tenth longer than its curve.
    if area < LEAST_AREA_PX2 || 4.0 * PI * area < 0.5 * length * length {
        return None;
    }
    let ellipse = fit_ellipse(points.iter().map(|p| p.map(f64::from)))?;
    // A pixel more or less all round is half the area of a small one.
    let tolerance = 0.05 + 0.35 * length / area / 2.0;
    let fits = (area / ellipse.area() - 1.0).abs() <= tolerance;
    let on_edge = ellipse.grown(if hole { -1.0 } else { 1.0 });
    (fits && on_edge.minor > 1.0 && ellipse.minor > 0.2 * ellipse.major).then_some(on_edge)
}

/// The ellipses of which a contour shows arcs between places where the image ends. A ring that the image's border
/// cuts is one region whose contour is both its edges, the outer and, turning the other way, the inner one.
fn arcs_of(points: &[[i32; 2]], view: &GrayView<'_>, outlines: &mut Vec<Outline>) {
    const LEAST_POINTS: usize = 16;
    let (right, bottom) = (view.width() as i32 - 1, view.height() as i32 - 1);
    let ends = |[x, y]: &[i32; 2]| *x <= 0 || *y <= 0 || *x >= right || *y >= bottom;
    if points.len() < LEAST_POINTS {
        return;
    }
    // Few contours reach the image's border; all corners at once is the fastest way to see that.
    let far = points.iter().fold([i32::MAX, i32::MAX, 0, 0], |[a, b, c, d], [x, y]| {
        [a.min(*x), b.min(*y), c.max(*x), d.max(*y)]
    });
    if !ends(&[far[0], far[1]]) && !ends(&[far[2], far[3]]) {
        return;
    }
    let Some(first) = points.iter().position(ends) else { return };
    let mut start = first;
    // Once round, from an end to the next.
    while start < first + points.len() {
        let onwards = points.iter().cycle().skip(start + 1);
        let length = onwards.take(points.len()).take_while(|p| !ends(p)).count();
        if length >= LEAST_POINTS {
            let arc = points.iter().cycle().skip(start + 1).take(length);
            outlines.extend(outline_of_arc(arc.map(|p| p.map(f64::from))));
        }
        start += length + 1;
    }
}

/// The ellipse of an arc, if it is one and goes far enough round.
fn outline_of_arc<I>(arc: I) -> Option<Outline>
where
    I: Iterator<Item = [f64; 2]> + Clone,
{
    const LEAST_TURN: f64 = 1.7;
    const MOST_RMS_PX: f64 = 0.8;
    let ellipse = fit_ellipse(arc.clone())?;
    let [cx, cy] = ellipse.centre;
    let (mut turn, mut squares, mut count) = (0.0, 0.0, 0.0);
    for ([x, y], [next_x, next_y]) in arc.clone().zip(arc.skip(1)) {
        let (a, b) = ([x - cx, y - cy], [next_x - cx, next_y - cy]);
        turn += (a[0] * b[1] - a[1] * b[0]).atan2(a[0] * b[0] + a[1] * b[1]);
        squares += ((ellipse.radius_of([x, y]) - 1.0) * ellipse.minor / 2.0).powi(2);
        count += 1.0;
    }
    let fits = squares <= MOST_RMS_PX * MOST_RMS_PX * count && ellipse.minor > 0.3 * ellipse.major;
    // Dark regions lie to the left of their contours, which on screen is within when these turn from y to x.
    let black_within = turn < 0.0;
    let on_edge = ellipse.grown(if black_within { 1.0 } else { -1.0 });
    (turn.abs() >= LEAST_TURN && fits && ellipse.minor > 12.0)
        .then_some(Outline { ellipse: on_edge, black_within })
}

/// How far apart the centres of one ring's ellipses may be, in pixels (Algorithm 2): perspective moves them apart
/// in proportion to their size.
fn concentric_tolerance(outer: &Ellipse) -> f64 {
    1.0 + 0.06 * outer.major
}

/// The checks of Algorithm 7 on an ellipse with black inside and one with white inside. A refusal without a
/// reason is of a pair too unlike a ring to be worth a word.
fn ring_of(
    view: GrayView<'_>,
    outer: &Ellipse,
    inner: &Ellipse,
) -> Result<Candidate, Option<Reason>> {
    let distance = (outer.centre[0] - inner.centre[0]).hypot(outer.centre[1] - inner.centre[1]);
    if distance > concentric_tolerance(outer) || inner.major >= outer.major {
        return Err(None);
    }
    // Half a pixel on each side may be wrong in any length.
    let slack = |length: f64| 0.7 / length;
    let (outer_shape, inner_shape) = (outer.minor / outer.major, inner.minor / inner.major);
    if (outer_shape - inner_shape).abs() > 0.1 + slack(inner.major) {
        return Err(Some(Reason::Eccentricity));
    }
    if outer_shape.max(inner_shape) < 0.85 && inner.major > 10.0 {
        // Half a turn is no difference.
        let difference = (2.0 * (outer.angle - inner.angle))
            .sin()
            .atan2((2.0 * (outer.angle - inner.angle)).cos())
            / 2.0;
        if difference.abs() > 20.0_f64.to_radians() {
            return Err(Some(Reason::Orientation));
        }
    }
    let tolerance = 0.1 + slack(outer.minor);
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

/// How many of the places at which an edge of the marker should be were looked at, and how many had it.
#[derive(Copy, Clone, Debug, Default)]
struct Support {
    sought: u32,
    visible: u32,
    found: u32,
}

impl Support {
    /// Share of the visible places that had the edge; `None` while less than a quarter of the circle is in view.
    fn share(&self) -> Option<f64> {
        (self.sought > 0 && 4 * self.visible >= self.sought)
            .then(|| f64::from(self.found) / f64::from(self.visible))
    }
}

/// The six edges, outermost first, as (radius, width of the nearer neighbour band, black within).
const EDGES: [(f64, f64, bool); 6] = edges();

const fn edges() -> [(f64, f64, bool); 6] {
    let mut radii = [0.0; 6];
    let mut i = 0;
    while i < 3 {
        radii[2 * i] = RING_RADII[i].1;
        radii[2 * i + 1] = RING_RADII[i].0;
        i += 1;
    }
    let size = 2.0 * RING_RADII[0].1;
    let mut edges = [(0.0, 0.0, false); 6];
    let mut i = 0;
    while i < 6 {
        let inside = if i < 5 { radii[i] - radii[i + 1] } else { radii[i] };
        // Outside of the marker is white for as far as its outer ring is wide.
        let outside = if i > 0 { radii[i - 1] - radii[i] } else { inside };
        let width = if inside < outside { inside } else { outside };
        edges[i] = (radii[i] / size, width / size, i % 2 == 0);
        i += 1;
    }
    edges
}

/// What stays the same while one candidate is looked into.
struct Search<'a> {
    view: GrayView<'a>,
    camera: &'a CameraModel,
    size_m: f64,
    /// At an edge the dark side lacks at least this share of the bright side's light.
    least_contrast: f64,
}

impl Search<'_> {
    /// The marker of which all edges speak that can be seen, starting from one ring.
    fn whole(
        &self,
        ring: &Ring,
        edges: &mut Vec<EdgePoint>,
        spots: &mut Vec<Spot>,
    ) -> Result<Seen, Reason> {
        let (mut circles, mut rms_px) = self.own(ring, edges)?;
        for _ in 0..2 {
            self.measure(&circles, edges);
            (circles, rms_px) = circles.refined(edges, self.camera).ok_or(Reason::Edges)?;
        }
        // The same outlines come nearly as well from the marker tilted the other way.
        if let Some((other, other_rms)) = circles.mirrored().refined(edges, self.camera)
            && other_rms < rms_px
        {
            (circles, rms_px) = (other, other_rms);
        }
        let support = self.measure(&circles, edges);
        let diameter_px =
            circles.outline(self.size_m / 2.0, self.camera).ok_or(Reason::Pose)?.major;
        let small = self.refine_small(&circles, spots);
        let difference = small.map(|(_, difference)| difference);
        if !believable(&support, ring.kind) || !fits(diameter_px, rms_px, difference) {
            return Err(Reason::Edges);
        }
        if let Some((better, _)) = small.filter(|(_, difference)| *difference < MOST_DIFFERENCE) {
            circles = better;
            rms_px = circles.rms_px(edges, self.camera).ok_or(Reason::Pose)?;
        }
        Ok(Seen { circles, rms_px, confidence: confidence(&support) })
    }

    /// The marker of which only one ring can be seen, because its neighbour's place is covered by something.
    fn alone(&self, ring: &Ring, edges: &mut Vec<EdgePoint>) -> Option<Seen> {
        let (start, _) = self.own(ring, edges).ok()?;
        edges.clear();
        let own = ring.kind as usize * 2;
        let mut support = [Support::default(); 6];
        for (index, support) in support.iter_mut().enumerate().skip(own).take(2) {
            *support = self.measure_edge(&start, index, edges);
        }
        let whole = support.iter().skip(own).take(2).all(|s| s.share().is_some_and(|s| s >= 0.95));
        let (circles, rms_px) = start.refined(edges, self.camera)?;
        let diameter_px = circles.outline(self.size_m / 2.0, self.camera)?.major;
        let good =
            whole && fits(diameter_px, rms_px, None) && self.is_covered(&circles, ring.kind)?;
        good.then(|| Seen { circles, rms_px, confidence: 0.5 * confidence(&support) })
    }

    /// The pose that a ring's own two edges speak for.
    fn own(&self, ring: &Ring, edges: &mut Vec<EdgePoint>) -> Result<(Circles, f64), Reason> {
        let (_, outer) = ring.kind.radii();
        let both = Circles::from_ellipse(&ring.outer, outer * self.size_m, self.camera)
            .ok_or(Reason::Pose)?;
        let own = ring.kind as usize * 2;
        let mut best: Option<(Circles, f64)> = None;
        for start in both {
            edges.clear();
            for index in own..own + 2 {
                self.measure_edge(&start, index, edges);
            }
            let Some((circles, rms)) = start.refined(edges, self.camera) else { continue };
            if best.is_none_or(|(_, least)| rms < least) {
                best = Some((circles, rms));
            }
        }
        best.ok_or(Reason::Pose)
    }

    /// A small marker's pose from its grey values, and the difference left; `None` for a large one, and when they
    /// disagree with its edges.
    fn refine_small(&self, circles: &Circles, spots: &mut Vec<Spot>) -> Option<(Circles, f64)> {
        let refined = |start: &Circles, spots: &mut Vec<Spot>| {
            photometry::refined(self.view, self.camera, start, self.size_m, spots)
        };
        let first = refined(circles, spots);
        let second = first.and_then(|(found, _)| refined(&found.mirrored(), spots));
        let all = first.into_iter().chain(second);
        let (best, difference) = all.min_by(|a, b| a.1.total_cmp(&b.1))?;
        let moved =
            project(best.centre, self.camera)?.distance(&project(circles.centre, self.camera)?);
        let scaled = best.centre.z / circles.centre.z;
        (moved < 0.5 && (0.9..1.1).contains(&scaled)).then_some((best, difference))
    }

    /// Whether the place of a ring's neighbour is not plain white, as beside other rings, but covered.
    fn is_covered(&self, circles: &Circles, kind: RingKind) -> Option<bool> {
        let neighbour = if kind == RingKind::Middle { RingKind::Outer } else { RingKind::Middle };
        let middle = |(inner, outer): (f64, f64)| self.median_at(circles, (inner + outer) / 2.0);
        let (inner, outer) = kind.radii();
        let aside = 0.4 * (outer - inner);
        let (within, around) =
            (self.median_at(circles, inner - aside)?, self.median_at(circles, outer + aside)?);
        let black = middle(kind.radii())?;
        Some(middle(neighbour.radii())? < (black * within.min(around)).sqrt())
    }

    /// The middle grey value on a circle of this radius (in marker sizes).
    fn median_at(&self, circles: &Circles, radius: f64) -> Option<f64> {
        const PLACES: usize = 24;
        let (u, v) = circles.basis();
        let mut values = [0.0; PLACES];
        let mut count = 0;
        for i in 0..PLACES {
            let (sin, cos) = (i as f64 * TAU / PLACES as f64).sin_cos();
            let place = circles.centre + (u * cos + v * sin) * (radius * self.size_m);
            let value = project(place, self.camera).and_then(|p| bilinear(self.view, p.x, p.y));
            if let Some((slot, value)) = values.get_mut(count).zip(value) {
                *slot = value;
                count += 1;
            }
        }
        let values = values.get_mut(..count).filter(|values| 2 * values.len() > PLACES)?;
        values.sort_unstable_by(f64::total_cmp);
        values.get(count / 2).copied()
    }

    /// Looks for all six edges.
    fn measure(&self, circles: &Circles, edges: &mut Vec<EdgePoint>) -> [Support; 6] {
        edges.clear();
        let mut support = [Support::default(); 6];
        for (index, support) in support.iter_mut().enumerate() {
            *support = self.measure_edge(circles, index, edges);
        }
        support
    }

    /// Looks for one edge all round; nowhere when its bands are too narrow to be seen.
    fn measure_edge(&self, circles: &Circles, index: usize, edges: &mut Vec<EdgePoint>) -> Support {
        let (radius, width, black_within) = EDGES[index];
        let radius = radius * self.size_m;
        let px_per_m = self.camera.fx / circles.centre.z;
        let width_px = width * self.size_m * px_per_m;
        let mut support = Support::default();
        if width_px < 1.0 || radius * px_per_m < 1.5 {
            return support;
        }
        let reach = (0.5 * width_px).clamp(1.25, 5.0);
        let count = (PI * radius * px_per_m).clamp(16.0, 96.0) as u32;
        let (u, v) = circles.basis();
        for i in 0..count {
            support.sought += 1;
            let (sin, cos) = (f64::from(i) * TAU / f64::from(count)).sin_cos();
            let out = u * cos + v * sin;
            let (Some(on), Some(beyond)) = (
                project(circles.centre + out * radius, self.camera),
                project(circles.centre + out * (radius * 1.001), self.camera),
            ) else {
                continue;
            };
            let length = on.distance(&beyond);
            let direction = [(beyond.x - on.x) / length, (beyond.y - on.y) / length];
            match self.edge_along(on, direction, reach, black_within) {
                Sight::Outside => {}
                Sight::Nothing => support.visible += 1,
                Sight::Edge(at) => {
                    support.visible += 1;
                    support.found += 1;
                    let ray = self.camera.unproject(at);
                    edges.push(EdgePoint { ray: ray.coords, radius });
                }
            }
        }
        support
    }

    /// Where the grey values cross the middle between those `reach` pixels inwards and outwards.
    fn edge_along(&self, on: Pixel, direction: [f64; 2], reach: f64, black_within: bool) -> Sight {
        const MOST: usize = 21;
        let half = ((reach / 0.5).round() as usize).clamp(3, MOST / 2);
        let step = reach / half as f64;
        let mut values = [0.0; MOST];
        let Some(values) = values.get_mut(..2 * half + 1) else { return Sight::Outside };
        for (i, value) in values.iter_mut().enumerate() {
            let along = (i as f64 - half as f64) * step;
            let (x, y) = (on.x + direction[0] * along, on.y + direction[1] * along);
            let Some(sample) = bilinear(self.view, x, y) else { return Sight::Outside };
            *value = if black_within { sample } else { -sample };
        }
        let ends = (values[0].min(values[1]), values[2 * half].max(values[2 * half - 1]));
        let bright = if black_within { ends.1 } else { -ends.0 };
        if ends.1 - ends.0 < (self.least_contrast * bright).max(LEAST_STEP) {
            return Sight::Nothing;
        }
        let middle = (ends.0 + ends.1) / 2.0;
        // Of several crossings the one nearest to where the edge is expected.
        let crossing = |pair: &[f64]| pair[0] < middle && pair[1] >= middle;
        let place = values
            .windows(2)
            .enumerate()
            .filter(|(_, pair)| crossing(pair))
            .map(|(i, pair)| i as f64 + (middle - pair[0]) / (pair[1] - pair[0]) - half as f64)
            .min_by(|a, b| a.abs().total_cmp(&b.abs()));
        match place {
            Some(place) => {
                let along = place * step;
                Sight::Edge(Pixel::new(on.x + direction[0] * along, on.y + direction[1] * along))
            }
            None => Sight::Nothing,
        }
    }
}

/// What was seen at a place where an edge should be.
enum Sight {
    Outside,
    Nothing,
    Edge(Pixel),
}

/// Whether the edges found are those of a marker: the ring's own two, and of the others either all that could be
/// seen, or a second ring.
fn believable(support: &[Support; 6], kind: RingKind) -> bool {
    let own = kind as usize * 2;
    let shares = support.map(|s| s.share());
    let own_found = shares[own..own + 2].iter().all(|s| s.is_some_and(|s| s >= 0.8));
    let seen = shares.iter().flatten().filter(|s| **s >= 0.7).count();
    let missed = shares.iter().flatten().filter(|s| **s < 0.7).count();
    own_found && (missed == 0 || seen >= 4)
}

/// How sure a believable marker is: the share of its visible edges that were found, less when few can be seen.
fn confidence(support: &[Support; 6]) -> f64 {
    let shares = support.iter().filter_map(Support::share);
    let (count, sum) = shares.fold((0.0, 0.0), |(count, sum), share| (count + 1.0, sum + share));
    if count == 0.0 { 0.0 } else { sum / count * (0.5 + count / 12.0) }
}

impl From<&Observation> for TracedMarker {
    fn from(observation: &Observation) -> Self {
        Self { centre: observation.centre, size_px: observation.size_px }
    }
}
