//! From one circle to the marker: all six of its edges, looked for where the circle says that they are.
//!
//! What is found refines the pose and decides whether there is a marker at all.

use std::f64::consts::{PI, TAU};

use geometry::{CameraModel, Pixel};
use imaging::{GrayView, bilinear};
use markers::{RING_RADII, RingKind};
use nalgebra::Matrix6;

use crate::candidates::ring_profile::{Candidate, LEAST_SCORE, LEAST_STEP, SMALL_PX};
use crate::families::rings::circle_pose::{CirclePose, EdgePoint, project};
use crate::families::rings::photometric::{
    Alternative, MAX_DIAMETER_PX, PhotometricFit, PhotometricInput, PhotometricPoses, PixelSample,
};
use crate::trace::Reason;

/// Where grey values differ more from a fitted marker's, as a share of its contrast, something else is in the picture,
/// such as a shadow's edge.
const MOST_DIFFERENCE: f64 = 0.074;
/// The rings must explain this share of the variance of the grey values about them, of a small marker within its rim
/// more, of a faint one, whose differences are no more than so many grey levels, less.
const LEAST_EXPLAINED: f64 = 0.95;
const LEAST_EXPLAINED_OF_SMALL: f64 = 0.99;
/// Below this diameter in pixels, where what lies beyond the paper shines in, it is this share.
const TINY_PX: f64 = 11.8;
const LEAST_EXPLAINED_OF_TINY: f64 = 0.975;
const LEAST_EXPLAINED_OF_FAINT: f64 = 0.85;
const MOST_NOISE: f64 = 4.0;
/// One ring of a marker of fewer pixels across says too little.
const LEAST_ALONE_PX: f64 = 90.0;
/// An edge is there when this share of its visible places has it: a third may be hidden.
const LEAST_EDGE_SHARE: f64 = 0.5;
/// How many times more the covariance is when something disturbs the marker's look.
const DISTURBED: f64 = 16.0;
/// Pixels as bright as this tell no difference.
const SATURATED: f64 = 252.0;
/// An edge appears nearer to the centre of its circle by this over the radius, all in pixels: half the square of what a
/// lens in focus and the pixels blur.
const BEND_PX2: f64 = 0.2;
/// Poses whose normals differ by less, in radians, are one.
const DISTINCT_TILT: f64 = 0.01;

/// What stays the same while one candidate is looked into.
pub(crate) struct Search<'a> {
    pub(crate) view: GrayView<'a>,
    pub(crate) camera: &'a CameraModel,
    /// The marker's size in metres.
    pub(crate) size_m: f64,
    /// At an edge the dark side lacks at least this share of the bright side's light.
    pub(crate) min_contrast: f64,
    /// White rings on black.
    pub(crate) inverted: bool,
}

/// A marker that was looked for and seen.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Seen {
    pub(crate) circles: CirclePose,
    /// Between the edges in the image and the pose's, in pixels.
    pub(crate) rms_px: f64,
    /// Of centre (m) and rotation vector (rad), in the camera frame.
    pub(crate) covariance: Matrix6<f64>,
    /// The same tilted the other way, and its difference from the edges in pixels, where it is a pose of its own.
    pub(crate) other: Option<(CirclePose, f64)>,
    /// From 0 to 1.
    pub(crate) confidence: f64,
}

impl Search<'_> {
    /// The marker of which a candidate is one circle.
    pub(crate) fn marker(
        &self,
        candidate: &Candidate,
        edges: &mut Vec<EdgePoint>,
        spots: &mut Vec<PixelSample>,
    ) -> Result<Seen, Reason> {
        edges.clear();
        let radius_m = candidate.radius * self.size_m;
        let both = CirclePose::from_ellipse(&candidate.border.ellipse, radius_m, self.camera)
            .ok_or(Reason::Pose)?;
        if candidate.diameter_px() < SMALL_PX {
            return self.small(&both[0], candidate.diameter_px(), spots);
        }
        let kind = ring_of(candidate.radius);
        if candidate.score < LEAST_SCORE {
            return self.alone(&both[0], kind, edges).ok_or(Reason::Edges);
        }
        let rough = self.rough(&both[0], edges);
        if let Some(rough) = &rough
            && let Some(seen) = self.at_once(rough, edges, spots)
        {
            return Ok(seen);
        }
        let (circles, rms_px, support) = self.whole(rough, &both[1], edges)?;
        let diameter_px =
            circles.projected(self.size_m / 2.0, self.camera).ok_or(Reason::Pose)?.major;
        let judged = believable(&support);
        if judged != Belief::None
            && let Some((fit, other)) = self.by_grey_values(&circles, diameter_px, spots)
        {
            return self.seen_by_grey_values(&fit, other, confidence(&support)).ok_or(Reason::Pose);
        }
        // Paper is not quite flat, and lenses bend; but each circle has its radius.
        self.measure(&circles, Reach::Near, edges);
        let bias_px = circles.max_bias_px(edges, self.camera);
        circles.remove_outliers(edges, self.camera);
        let large = diameter_px > MAX_DIAMETER_PX;
        let share = if large { 2e-3 } else { 6e-4 };
        let lies = |rms: f64, bias: f64| {
            rms_px < (rms + 3e-3 * diameter_px).min(0.9)
                && bias_px < bias * (diameter_px / 60.0).min(1.0) + share * diameter_px
        };
        let fits = match judged {
            Belief::None => false,
            Belief::Some => lies(0.1, 0.05),
            Belief::All => lies(0.3, 0.12),
        };
        if !fits {
            return self.alone(&circles, kind, edges).ok_or(Reason::Edges);
        }
        let mut seen =
            self.seen(circles, rms_px, edges, confidence(&support)).ok_or(Reason::Pose)?;
        if !large {
            // Its grey values are not a marker's: light or something on it moves edges, all of one side together.
            seen.covariance *= DISTURBED;
        }
        Ok(seen)
    }

    fn photometric(&self) -> PhotometricInput<'_> {
        let Self { view, camera, size_m, inverted, .. } = *self;
        PhotometricInput { view, camera, size_m, white_on_black: inverted }
    }

    /// The marker that should be where this pose has it, when it is neither too small nor too large and plain to see.
    pub(crate) fn again(
        &self,
        expected: &CirclePose,
        edges: &mut Vec<EdgePoint>,
        spots: &mut Vec<PixelSample>,
    ) -> Option<Seen> {
        let diameter_px = expected.projected(self.size_m / 2.0, self.camera)?.major;
        if diameter_px < SMALL_PX {
            return None;
        }
        if let Some(seen) = self.at_expected(expected, diameter_px, edges, spots) {
            return Some(seen);
        }
        let rough = self.rough(expected, edges)?;
        self.at_once(&rough, edges, spots)
    }

    /// The marker right where this pose has it, when its grey values and its edges are a marker's.
    fn at_expected(
        &self,
        expected: &CirclePose,
        diameter_px: f64,
        edges: &mut Vec<EdgePoint>,
        spots: &mut Vec<PixelSample>,
    ) -> Option<Seen> {
        let PhotometricPoses { best: fit, alternative: other } =
            self.photometric().fit_tracked(expected, spots)?;
        let is_near = self.is_near(expected, &fit.pose, 1.0 + 0.03 * diameter_px, 0.1);
        if !is_near || !is_plain(&fit) {
            return None;
        }
        let support = self.measure(&fit.pose, Reach::Glance, edges);
        let seen = self.seen_by_grey_values(&fit, other, confidence(&support))?;
        (believable(&support) == Belief::All).then_some(seen)
    }

    /// A marker too small for edges: its grey values decide.
    fn small(
        &self,
        start: &CirclePose,
        candidate_px: f64,
        spots: &mut Vec<PixelSample>,
    ) -> Result<Seen, Reason> {
        let PhotometricPoses { best: fit, alternative: other } =
            self.photometric().fit(start, spots).ok_or(Reason::Pose)?;
        // Noise may be a large part of a faint marker.
        let faint = fit.r_squared > LEAST_EXPLAINED_OF_FAINT
            && fit.residual * fit.contrast < MOST_NOISE
            && fit.residual < 1.5 * MOST_DIFFERENCE;
        let tiny = candidate_px < TINY_PX;
        let least = if tiny { LEAST_EXPLAINED_OF_TINY } else { LEAST_EXPLAINED_OF_SMALL };
        let clear = fit.r_squared > least && fit.residual < MOST_DIFFERENCE;
        let sound = (clear || faint)
            && fit.contrast > 2.0 * LEAST_STEP
            // Blur that hides the rings of something else makes them blacker than black.
            && (!tiny || fit.contrast < 260.0)
            && fit.has_rings()
            && self.is_near(start, &fit.pose, 1.5, 0.3);
        if !sound {
            return Err(Reason::Edges);
        }
        self.seen_by_grey_values(&fit, other, fit.r_squared).ok_or(Reason::Pose)
    }

    /// Whether a pose has its centre within so many pixels of another's, at nearly its distance.
    fn is_near(&self, start: &CirclePose, found: &CirclePose, px: f64, share: f64) -> bool {
        let ends = project(start.centre, self.camera).zip(project(found.centre, self.camera));
        ends.is_some_and(|(a, b)| a.distance(&b) < px)
            && (found.centre.z / start.centre.z - 1.0).abs() < share
    }

    /// The pose that the edges speak for that are near enough to where this one has them; `None` when too few are.
    fn rough(&self, start: &CirclePose, edges: &mut Vec<EdgePoint>) -> Option<CirclePose> {
        let support = self.measure(start, Reach::Far, edges);
        let there = |s: &&Support| s.share().is_some_and(|share| share > 0.4);
        let beyond_view = support[..4].iter().all(|s| s.share().is_none());
        if support.iter().filter(there).count() < if beyond_view { 2 } else { 3 } {
            return None;
        }
        start.refined(edges, self.camera).map(|(rough, _)| rough)
    }

    /// The marker of which a pose is known roughly, when it is not too large and its grey values are a marker's.
    fn at_once(
        &self,
        rough: &CirclePose,
        edges: &mut Vec<EdgePoint>,
        spots: &mut Vec<PixelSample>,
    ) -> Option<Seen> {
        let diameter_px = rough.projected(self.size_m / 2.0, self.camera)?.major;
        let (fit, other) = self.by_grey_values(rough, diameter_px, spots)?;
        let support = self.measure(&fit.pose, Reach::Near, edges);
        let seen = self.seen_by_grey_values(&fit, other, confidence(&support))?;
        (believable(&support) != Belief::None).then_some(seen)
    }

    /// The pose that all edges speak for, the distances left, and how much of each edge there is, from a pose that is known
    /// roughly or from another start.
    fn whole(
        &self,
        rough: Option<CirclePose>,
        start: &CirclePose,
        edges: &mut Vec<EdgePoint>,
    ) -> Result<(CirclePose, f64, [Support; 6]), Reason> {
        let mut best: Option<(CirclePose, f64)> = None;
        for is_first in [true, false] {
            let rough = if is_first { rough } else { self.rough(start, edges) };
            let Some(rough) = rough else { continue };
            let near = self.measure(&rough, Reach::Near, edges);
            let Some((circles, rms)) = rough.refined(edges, self.camera) else { continue };
            // Per edge found: a wrong pose finds few.
            let cost = (rms + 0.1) / edges.len() as f64;
            if best.is_none_or(|(_, least)| cost < least) {
                best = Some((circles, cost));
            }
            let visible: u32 = near.iter().map(|s| s.visible).sum();
            if rms < 0.3 && 10 * edges.len() > 9 * visible as usize {
                break;
            }
        }
        let (mut circles, _) = best.ok_or(Reason::Edges)?;
        let support = self.measure(&circles, Reach::Near, edges);
        circles.remove_outliers(edges, self.camera);
        let mut rms_px;
        (circles, rms_px) = circles.refined(edges, self.camera).ok_or(Reason::Edges)?;
        // The same outlines come nearly as well from the marker tilted the other way.
        if let Some((other, other_rms)) = circles.mirrored().refined(edges, self.camera)
            && other_rms < rms_px
        {
            (circles, rms_px) = (other, other_rms);
        }
        Ok((circles, rms_px, support))
    }

    /// The pose from the grey values, and the one tilted the other way; `None` for a large marker, and when they
    /// are not a marker's or disagree with its edges.
    fn by_grey_values(
        &self,
        circles: &CirclePose,
        diameter_px: f64,
        spots: &mut Vec<PixelSample>,
    ) -> Option<(PhotometricFit, Option<Alternative>)> {
        let PhotometricPoses { best: fit, alternative: other } =
            self.photometric().fit(circles, spots)?;
        let is_it =
            is_plain(&fit) && self.is_near(circles, &fit.pose, 0.3 + 0.01 * diameter_px, 0.1);
        is_it.then_some((fit, other))
    }

    /// The marker of which only one ring can be seen, because its neighbour's place is covered by something.
    fn alone(
        &self,
        start: &CirclePose,
        kind: RingKind,
        edges: &mut Vec<EdgePoint>,
    ) -> Option<Seen> {
        if kind == RingKind::Inner || self.inverted || !self.is_covered(start, kind)? {
            return None;
        }
        // A middle ring alone has the dot in it.
        edges.clear();
        let dot = self.measure_edge(start, 4, Reach::Near, edges).share();
        if kind == RingKind::Middle && dot.is_none_or(|share| share < 0.9) {
            return None;
        }
        edges.clear();
        let own = kind as usize * 2;
        let mut support = [Support::default(); 6];
        for (index, support) in support.iter_mut().enumerate().skip(own).take(2) {
            *support = self.measure_edge(start, index, Reach::Near, edges);
        }
        let whole = support.iter().skip(own).take(2).all(|s| s.share().is_some_and(|s| s >= 0.95));
        let (circles, rms_px) = start.refined(edges, self.camera)?;
        let diameter_px = circles.projected(self.size_m / 2.0, self.camera)?.major;
        // Of two circles alone the radii must be right.
        let limit_px = 0.06 + 4e-4 * diameter_px;
        let fits = diameter_px > LEAST_ALONE_PX
            && rms_px < 2.0 * limit_px
            && circles.max_bias_px(edges, self.camera) < limit_px;
        let good = whole && fits && self.is_covered(&circles, kind)?;
        good.then(|| self.seen(circles, rms_px, edges, 0.5 * confidence(&support))).flatten()
    }

    /// The marker with how well it is known and what else it could be.
    fn seen(
        &self,
        circles: CirclePose,
        rms_px: f64,
        edges: &[EdgePoint],
        confidence: f64,
    ) -> Option<Seen> {
        let covariance = circles.covariance(edges, self.camera)?;
        let other = circles
            .mirrored()
            .refined(edges, self.camera)
            .filter(|(other, _)| other.normal.angle(&circles.normal) > DISTINCT_TILT);
        Some(Seen { circles, rms_px, covariance, other, confidence })
    }

    fn seen_by_grey_values(
        &self,
        fit: &PhotometricFit,
        other: Option<Alternative>,
        confidence: f64,
    ) -> Option<Seen> {
        // A step as high as the contrast rises within two and a half times the blur.
        let rms_px = |blur_px: f64, difference: f64| 2.5 * blur_px * difference;
        let covariance = fit.pose.full_covariance(&fit.covariance);
        Some(Seen {
            circles: fit.pose,
            rms_px: rms_px(fit.blur_px, fit.residual),
            covariance: covariance.iter().all(|c| c.is_finite()).then_some(covariance)?,
            other: other.map(|o| (o.pose, rms_px(o.blur_px, o.residual))),
            confidence,
        })
    }

    /// Whether the place of a ring's neighbour is not plain white, as beside other rings, but covered.
    fn is_covered(&self, circles: &CirclePose, kind: RingKind) -> Option<bool> {
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
    fn median_at(&self, circles: &CirclePose, radius: f64) -> Option<f64> {
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
    fn measure(
        &self,
        circles: &CirclePose,
        reach: Reach,
        edges: &mut Vec<EdgePoint>,
    ) -> [Support; 6] {
        edges.clear();
        let mut support = [Support::default(); 6];
        for (index, support) in support.iter_mut().enumerate() {
            *support = self.measure_edge(circles, index, reach, edges);
        }
        support
    }

    /// Looks for one edge all round; nowhere when its bands are too narrow to be seen.
    fn measure_edge(
        &self,
        circles: &CirclePose,
        index: usize,
        reach: Reach,
        edges: &mut Vec<EdgePoint>,
    ) -> Support {
        let (radius, width, black_within) = EDGES[index];
        let black_within = black_within != self.inverted;
        let radius = radius * self.size_m;
        let px_per_m = self.camera.fx / circles.centre.z;
        let width_px = width * self.size_m * px_per_m;
        let mut support = Support::default();
        if width_px < 1.0 || radius * px_per_m < 3.0 {
            return support;
        }
        let most = match reach {
            Reach::Near => 96.0,
            Reach::Far => 40.0,
            Reach::Glance => 16.0,
        };
        let count = (PI * radius * px_per_m).clamp(16.0, most) as u32;
        let furthest = if reach == Reach::Far { 0.45 * width_px } else { 5.0 };
        let reach = (0.5 * width_px).min(furthest).max(1.25);
        let bend_px = BEND_PX2 / (radius * px_per_m);
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
                    let at =
                        Pixel::new(at.x + direction[0] * bend_px, at.y + direction[1] * bend_px);
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
        // In glare nothing is seen.
        if values.iter().all(|value| value.abs() >= SATURATED) {
            return Sight::Outside;
        }
        let ends = (values[0].min(values[1]), values[2 * half].max(values[2 * half - 1]));
        let bright = if black_within { ends.1 } else { -ends.0 };
        if ends.1 - ends.0 < (self.min_contrast * bright).max(LEAST_STEP) {
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

/// Whether a fit looks like a marker with nothing on it.
fn is_plain(fit: &PhotometricFit) -> bool {
    fit.residual < MOST_DIFFERENCE && fit.has_rings() && fit.r_squared > LEAST_EXPLAINED
}

/// How far from where it should be an edge is looked for: at first as far as its neighbours allow.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
enum Reach {
    Far,
    Near,
    /// As near, at so few places that it only tells whether the edge is there.
    Glance,
}

/// What was seen at a place where an edge should be.
enum Sight {
    Outside,
    Nothing,
    Edge(Pixel),
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

/// The ring to which a circle of this radius (in marker sizes) belongs.
fn ring_of(radius: f64) -> RingKind {
    let belongs = |kind: &RingKind| {
        let (inner, outer) = kind.radii();
        (inner - 1e-6..=outer + 1e-6).contains(&radius)
    };
    RingKind::ALL.into_iter().find(belongs).unwrap_or(RingKind::Inner)
}

/// Whether the edges found are those of a marker: most of those that could be seen, of two rings at least; or the
/// innermost ring alone where the camera is too near to see any other.
fn believable(support: &[Support; 6]) -> Belief {
    let shares = support.map(|s| s.share());
    let seen = shares.iter().flatten().filter(|s| **s >= LEAST_EDGE_SHARE).count();
    let clear = shares.iter().flatten().filter(|s| **s >= 0.8).count();
    let missed = shares.iter().flatten().filter(|s| **s < LEAST_EDGE_SHARE).count();
    let alone = shares[..4].iter().all(Option::is_none);
    let (found, visible) = support.iter().fold((0, 0), |(f, v), s| (f + s.found, v + s.visible));
    if 2 * found < visible {
        return Belief::None;
    }
    match missed {
        0 if seen >= 4 || clear >= 3 || clear >= 2 && alone => Belief::All,
        1 | 2 if seen >= 4 => Belief::Some,
        _ => Belief::None,
    }
}

/// Whether edges are where a marker has them.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
enum Belief {
    None,
    /// Some are missing.
    Some,
    All,
}

/// How sure a believable marker is: the share of its visible edges that were found, less when few can be seen.
fn confidence(support: &[Support; 6]) -> f64 {
    let shares = support.iter().filter_map(Support::share);
    let (count, sum) = shares.fold((0.0, 0.0), |(count, sum), share| (count + 1.0, sum + share));
    if count == 0.0 { 0.0 } else { sum / count * (0.5 + count / 12.0) }
}
