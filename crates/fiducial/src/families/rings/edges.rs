//! Locates the six edges of the three-ring marker in the image where a pose predicts them, and counts how much of each circle
//! is visible, found or missed.

use std::f64::consts::{PI, TAU};

use geometry::{CameraModel, Pixel};
use imaging::{GrayView, bilinear};
use markers::{RING_RADII, RingKind};

use crate::candidates::ring_profile::MIN_STEP;
use crate::families::family::{PredictedShape, Prediction};
use crate::families::rings::circle_pose::{CirclePose, EdgePoint, project};

/// Minimum fraction of the visible places of an edge at which it is found: a third may be hidden.
const MIN_EDGE_SHARE: f64 = 0.5;
/// The same of an edge that is plain to see.
const CLEAR_SHARE: f64 = 0.8;
/// Grey values from here on are saturated.
pub(super) const SATURATED: f64 = 252.0;
/// Largest fraction of white in an object that covers a ring.
const MAX_COVERED_SHARE: f64 = 0.25;
/// Blur shifts a curved edge towards the centre by this over the radius, all in pixels: half the variance of
/// the blur of a lens in focus and of the pixels.
const CURVATURE_SHIFT_PX2: f64 = 0.2;

/// The image and the marker whose edges are located.
#[derive(Copy, Clone)]
pub(super) struct EdgeSearch<'a> {
    pub(super) view: GrayView<'a>,
    pub(super) camera: &'a CameraModel,
    /// The marker's size in metres.
    pub(super) size_m: f64,
    /// Minimum contrast across an edge, as a fraction of the brighter side.
    pub(super) min_contrast: f64,
    pub(super) white_on_black: bool,
    /// How far a camera's processing moves edges into the black, in pixels.
    pub(super) into_black_px: f64,
    /// Where markers that are followed should be.
    pub(super) followed: &'a [Prediction],
    /// Whether a shadow was removed from the image.
    pub(super) shadow_removed: bool,
}

/// How far from its predicted place an edge is searched.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) enum Reach {
    /// As far as the neighbouring edges allow.
    Far,
    Near,
    /// Near, at few places: enough to see whether the edge exists.
    Sparse,
}

/// The image at a place of an edge.
enum EdgeSample {
    /// Outside the image, or saturated.
    NotVisible,
    NoEdge,
    Edge(Pixel),
}

/// At how many places an edge was searched, visible and found.
#[derive(Copy, Clone, Debug, Default)]
pub(super) struct EdgeSupport {
    searched: u32,
    pub(super) visible: u32,
    found: u32,
}

impl EdgeSupport {
    /// Whether some of it is visible, and most of that is not there.
    fn is_missed(&self) -> bool {
        const MIN_PLACES: u32 = 8;
        self.visible >= MIN_PLACES && 2 * self.found < self.visible
    }

    /// Found over visible places; `None` while less than a quarter of the circle is visible.
    pub(super) fn share(&self) -> Option<f64> {
        (self.searched > 0 && 4 * self.visible >= self.searched)
            .then(|| f64::from(self.found) / f64::from(self.visible))
    }
}

impl EdgeSearch<'_> {
    /// Locates all six edges.
    pub(super) fn locate(
        &self,
        pose: &CirclePose,
        reach: Reach,
        edges: &mut Vec<EdgePoint>,
    ) -> [EdgeSupport; 6] {
        edges.clear();
        let mut support = [EdgeSupport::default(); 6];
        for (index, support) in support.iter_mut().enumerate() {
            *support = self.locate_edge(pose, index, reach, edges);
        }
        support
    }

    /// Locates one edge all round, unless its bands are too narrow to be seen.
    pub(super) fn locate_edge(
        &self,
        pose: &CirclePose,
        index: usize,
        reach: Reach,
        edges: &mut Vec<EdgePoint>,
    ) -> EdgeSupport {
        let RingEdge { radius, width, black_inside } = EDGES[index];
        let black_inside = black_inside != self.white_on_black;
        let radius = radius * self.size_m;
        let px_per_m = self.camera.fx / pose.centre.z;
        let width_px = width * self.size_m * px_per_m;
        let mut support = EdgeSupport::default();
        if width_px < 1.0 || radius * px_per_m < 3.0 {
            return support;
        }
        let max_places = match reach {
            Reach::Near => 96.0,
            Reach::Far => 40.0,
            Reach::Sparse => 16.0,
        };
        let count = (PI * radius * px_per_m).clamp(16.0, max_places) as u32;
        let max_reach = if reach == Reach::Far { 0.45 * width_px } else { 5.0 };
        let reach_px = (0.5 * width_px).min(max_reach).max(1.25);
        let from_black_px = if black_inside { self.into_black_px } else { -self.into_black_px };
        let shift_px = CURVATURE_SHIFT_PX2 / (radius * px_per_m) + from_black_px;
        let (u, v) = pose.basis();
        for i in 0..count {
            support.searched += 1;
            let (sin, cos) = (f64::from(i) * TAU / f64::from(count)).sin_cos();
            let out = u * cos + v * sin;
            let (Some(on), Some(beyond)) = (
                project(pose.centre + out * radius, self.camera),
                project(pose.centre + out * (radius * 1.001), self.camera),
            ) else {
                continue;
            };
            let length = on.distance(&beyond);
            let direction = [(beyond.x - on.x) / length, (beyond.y - on.y) / length];
            let line = SearchLine { on, direction, reach_px };
            match self.edge_along(&line, black_inside) {
                EdgeSample::NotVisible => {}
                EdgeSample::NoEdge => support.visible += 1,
                EdgeSample::Edge(at) => {
                    support.visible += 1;
                    support.found += 1;
                    let at = offset(at, direction, shift_px);
                    let ray = self.camera.unproject_clamped(at);
                    edges.push(EdgePoint { ray: ray.coords, radius, black_inside });
                }
            }
        }
        support
    }

    /// Which edges are there at a pose. Edges that clutter shows as well are too few unless a marker is tracked there: one ring
    /// of the two large ones, three circles of which the middle is beyond the frame, white rings on black with gaps.
    pub(super) fn completeness(
        &self,
        pose: &CirclePose,
        support: &[EdgeSupport; 6],
    ) -> Completeness {
        let found = Completeness::from_support(support);
        let shares = support.map(|edge| edge.share());
        let is_weak = match found {
            Completeness::Insufficient => return found,
            Completeness::Innermost => true,
            Completeness::Partial | Completeness::Full => {
                let has_gaps = shares.iter().flatten().any(|share| *share < CLEAR_SHARE);
                let lacks_outer = shares[..4].iter().any(Option::is_none);
                let lacks_ring =
                    support[..4].chunks(2).any(|ring| ring.iter().all(EdgeSupport::is_missed));
                lacks_ring
                    || self.white_on_black && has_gaps
                    || (self.white_on_black || lacks_outer) && !self.shows_middle(pose)
            }
        };
        match found {
            _ if is_weak && !self.is_followed(pose) => Completeness::Insufficient,
            Completeness::Innermost => Completeness::Full,
            _ => found,
        }
    }

    /// Whether a marker is followed that should be near this pose.
    pub(super) fn is_followed(&self, pose: &CirclePose) -> bool {
        /// Maximum distance of the centre in marker sizes, and bounds on the ratio of the distances from the camera: the
        /// possible change of a vehicle's motion from one frame to the next.
        const MAX_AWAY: f64 = 0.1;
        const RATIO: std::ops::Range<f64> = 0.7..1.4;
        let is_near = |followed: &CirclePose| {
            let ratio = pose.centre.z / followed.centre.z;
            let [own, others] = [pose, followed].map(|p| p.centre / p.centre.z);
            let away_m = (own - others).norm() * pose.centre.z;
            RATIO.contains(&ratio) && away_m < MAX_AWAY * self.size_m
        };
        self.followed.iter().any(|marker| match &marker.shape {
            PredictedShape::Circles(circles) => is_near(circles),
            PredictedShape::Corners(_) => false,
        })
    }

    /// Where the grey values cross the middle between those of the line's two ends.
    fn edge_along(&self, line: &SearchLine, black_inside: bool) -> EdgeSample {
        const MAX_VALUES: usize = 21;
        let SearchLine { on, direction, reach_px } = *line;
        let half = ((reach_px / 0.5).round() as usize).clamp(3, MAX_VALUES / 2);
        let step = reach_px / half as f64;
        let mut values = [0.0; MAX_VALUES];
        let Some(values) = values.get_mut(..2 * half + 1) else { return EdgeSample::NotVisible };
        for (i, value) in values.iter_mut().enumerate() {
            let at = offset(on, direction, (i as f64 - half as f64) * step);
            let Some(grey) = bilinear(self.view, at.x, at.y) else {
                return EdgeSample::NotVisible;
            };
            *value = if black_inside { grey } else { -grey };
        }
        if values.iter().all(|value| value.abs() >= SATURATED) {
            return EdgeSample::NotVisible;
        }
        let ends = (values[0].min(values[1]), values[2 * half].max(values[2 * half - 1]));
        let bright = if black_inside { ends.1 } else { -ends.0 };
        if ends.1 - ends.0 < (self.min_contrast * bright).max(MIN_STEP) {
            return EdgeSample::NoEdge;
        }
        let middle = (ends.0 + ends.1) / 2.0;
        // Of several crossings the one nearest to the predicted place.
        let crosses = |pair: &[f64]| pair[0] < middle && pair[1] >= middle;
        let crossing = values
            .windows(2)
            .enumerate()
            .filter(|(_, pair)| crosses(pair))
            .map(|(i, pair)| i as f64 + (middle - pair[0]) / (pair[1] - pair[0]) - half as f64)
            .min_by(|a, b| a.abs().total_cmp(&b.abs()));
        match crossing {
            Some(crossing) => EdgeSample::Edge(offset(on, direction, crossing * step)),
            None => EdgeSample::NoEdge,
        }
    }

    /// The blur of the image as the outermost edge shows it: the standard deviation of a Gaussian whose integral rises as
    /// steeply, in pixels; the median over the circle.
    pub(super) fn edge_blur_px(&self, pose: &CirclePose) -> Option<f64> {
        const PLACES: usize = 32;
        const STEP_PX: f64 = 0.25;
        const HALF: usize = 12;
        /// Between the quartiles of a Gaussian, in standard deviations.
        const QUARTILES: f64 = 1.349;
        let RingEdge { radius, width, .. } = EDGES[0];
        let reach_px = 0.5 * width * self.size_m * self.camera.fx / pose.centre.z;
        let half = ((reach_px / STEP_PX) as usize).clamp(3, HALF);
        let (u, v) = pose.basis();
        let mut blurs = [0.0; PLACES];
        let mut count = 0;
        for i in 0..PLACES {
            let (sin, cos) = (i as f64 * TAU / PLACES as f64).sin_cos();
            let out = (u * cos + v * sin) * (radius * self.size_m);
            let (Some(on), Some(beyond)) = (
                project(pose.centre + out, self.camera),
                project(pose.centre + out * 1.001, self.camera),
            ) else {
                continue;
            };
            let length = on.distance(&beyond);
            let direction = [(beyond.x - on.x) / length, (beyond.y - on.y) / length];
            let grey = |step: usize| {
                let at = offset(on, direction, (step as f64 - half as f64) * STEP_PX);
                bilinear(self.view, at.x, at.y)
                    .map(|grey| if self.white_on_black { -grey } else { grey })
            };
            let (Some(black), Some(white)) = (grey(0), grey(2 * half)) else { continue };
            let crossing = |part: f64| {
                let level = black + part * (white - black);
                (0..2 * half).find_map(|step| {
                    let (from, to) = (grey(step)?, grey(step + 1)?);
                    (from < level && to >= level)
                        .then(|| step as f64 + (level - from) / (to - from))
                })
            };
            if let Some((low, high)) = crossing(0.25).zip(crossing(0.75))
                && let Some(blur) = blurs.get_mut(count)
            {
                *blur = (high - low) * STEP_PX / QUARTILES;
                count += 1;
            }
        }
        let blurs = blurs.get_mut(..count).filter(|blurs| 4 * blurs.len() >= PLACES)?;
        let (_, median, _) = blurs.select_nth_unstable_by(count / 2, f64::total_cmp);
        Some(*median)
    }

    /// Whether the position of a ring's neighbour is covered: not white, as it is next to other rings.
    pub(super) fn is_neighbour_covered(&self, pose: &CirclePose, kind: RingKind) -> Option<bool> {
        let neighbour = if kind == RingKind::Middle { RingKind::Outer } else { RingKind::Middle };
        let median_of = |(inner, outer): (f64, f64)| self.median_at(pose, (inner + outer) / 2.0);
        let (inner, outer) = kind.radii();
        let beside = 0.4 * (outer - inner);
        let (inside, outside) =
            (self.median_at(pose, inner - beside)?, self.median_at(pose, outer + beside)?);
        let black = median_of(kind.radii())?;
        let (white, seen) = (inside.min(outside), median_of(neighbour.radii())?);
        // A tone curve lifts grey more than black, so that the geometric mean is not enough.
        let share = MAX_COVERED_SHARE * (white - black);
        Some(seen < (black * white).sqrt().min(black + share))
    }

    /// The median grey value on a circle of this radius (in marker sizes).
    fn median_at(&self, pose: &CirclePose, radius: f64) -> Option<f64> {
        const PLACES: usize = 24;
        let (u, v) = pose.basis();
        let mut values = [0.0; PLACES];
        let mut count = 0;
        for i in 0..PLACES {
            let (sin, cos) = (i as f64 * TAU / PLACES as f64).sin_cos();
            let place = pose.centre + (u * cos + v * sin) * (radius * self.size_m);
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
}

/// A line across an edge, from inside to outside.
struct SearchLine {
    /// The predicted place of the edge.
    on: Pixel,
    direction: [f64; 2],
    reach_px: f64,
}

#[inline]
fn offset(from: Pixel, direction: [f64; 2], by_px: f64) -> Pixel {
    Pixel::new(from.x + direction[0] * by_px, from.y + direction[1] * by_px)
}

/// A circle of the marker.
#[derive(Copy, Clone)]
struct RingEdge {
    /// In marker sizes.
    radius: f64,
    /// Width of the narrower neighbouring band, in marker sizes.
    width: f64,
    black_inside: bool,
}

/// The six edges, outermost first.
const EDGES: [RingEdge; 6] = edges();

const fn edges() -> [RingEdge; 6] {
    let mut radii = [0.0; 6];
    let mut i = 0;
    while i < 3 {
        radii[2 * i] = RING_RADII[i].1;
        radii[2 * i + 1] = RING_RADII[i].0;
        i += 1;
    }
    let size = 2.0 * RING_RADII[0].1;
    let mut edges = [RingEdge { radius: 0.0, width: 0.0, black_inside: false }; 6];
    let mut i = 0;
    while i < 6 {
        let inside = if i < 5 { radii[i] - radii[i + 1] } else { radii[i] };
        // The paper around the marker is white for the width of the outer ring.
        let outside = if i > 0 { radii[i - 1] - radii[i] } else { inside };
        let width = if inside < outside { inside } else { outside };
        edges[i] =
            RingEdge { radius: radii[i] / size, width: width / size, black_inside: i % 2 == 0 };
        i += 1;
    }
    edges
}

/// Which of the marker's edges are there.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) enum Completeness {
    /// Too few for a marker.
    Insufficient,
    /// The innermost ring where the camera is too near to see any other: one circle is a marker only where one is
    /// followed.
    Innermost,
    /// One or two are missing.
    Partial,
    Full,
}

impl Completeness {
    /// A marker needs most of the visible edges, of at least two rings.
    pub(super) fn from_support(support: &[EdgeSupport; 6]) -> Self {
        let shares = support.map(|s| s.share());
        let seen = shares.iter().flatten().filter(|s| **s >= MIN_EDGE_SHARE).count();
        let clear = shares.iter().flatten().filter(|s| **s >= CLEAR_SHARE).count();
        let missed = shares.iter().flatten().filter(|s| **s < MIN_EDGE_SHARE).count();
        let inner_only = shares[..4].iter().all(Option::is_none);
        let (found, visible) =
            support.iter().fold((0, 0), |(f, v), s| (f + s.found, v + s.visible));
        if 2 * found < visible {
            return Self::Insufficient;
        }
        match missed {
            0 if clear >= 2 && inner_only => Self::Innermost,
            0 if seen >= 4 || clear >= 3 => Self::Full,
            1 | 2 if seen >= 4 => Self::Partial,
            _ => Self::Insufficient,
        }
    }
}

/// The mean fraction of the visible edges, from 0 to 1, reduced when few are visible.
pub(super) fn confidence(support: &[EdgeSupport; 6]) -> f64 {
    let shares = support.iter().filter_map(EdgeSupport::share);
    let (count, sum) = shares.fold((0.0, 0.0), |(count, sum), share| (count + 1.0, sum + share));
    if count == 0.0 { 0.0 } else { sum / count * (0.5 + count / 12.0) }
}
