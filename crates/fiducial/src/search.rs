//! From one ring to the marker: its six edges, looked for where the ring says that they are.
//!
//! What is found refines the pose and decides whether there is a marker at all.

use std::f64::consts::{PI, TAU};

use geometry::{CameraModel, Pixel};
use imaging::{GrayView, bilinear};
use nalgebra::Matrix6;

use crate::circles::{Circles, EdgePoint, project};
use crate::drawing::RING_RADII;
use crate::photometry::{self, Spot};
use crate::ring::{Ring, RingKind};
use crate::trace::Reason;

/// Fewer grey levels are noise.
pub(crate) const LEAST_STEP: f64 = 7.0;
/// Where grey values differ more from a fitted marker's, as a share of its contrast, something else is in the picture,
/// such as a shadow's edge.
const MOST_DIFFERENCE: f64 = 0.15;
/// Poses whose normals differ by less, in radians, are one.
const DISTINCT_TILT: f64 = 0.01;

/// What stays the same while one candidate is looked into.
pub(crate) struct Search<'a> {
    pub(crate) view: GrayView<'a>,
    pub(crate) camera: &'a CameraModel,
    /// The marker's size in metres.
    pub(crate) size_m: f64,
    /// At an edge the dark side lacks at least this share of the bright side's light.
    pub(crate) least_contrast: f64,
}

/// A marker that was looked for and seen.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Seen {
    pub(crate) circles: Circles,
    /// Between the edges in the image and the pose's, in pixels.
    pub(crate) rms_px: f64,
    /// Of centre (m) and rotation vector (rad), in the camera frame.
    pub(crate) covariance: Matrix6<f64>,
    /// The same tilted the other way, and its difference from the edges in pixels, where it is a pose of its own.
    pub(crate) other: Option<(Circles, f64)>,
    /// From 0 to 1.
    pub(crate) confidence: f64,
}

impl Search<'_> {
    /// The marker of which all edges speak that can be seen, starting from one ring.
    pub(crate) fn whole(
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
        self.seen(circles, rms_px, edges, confidence(&support)).ok_or(Reason::Pose)
    }

    /// The marker of which only one ring can be seen, because its neighbour's place is covered by something.
    pub(crate) fn alone(&self, ring: &Ring, edges: &mut Vec<EdgePoint>) -> Option<Seen> {
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
        good.then(|| self.seen(circles, rms_px, edges, 0.5 * confidence(&support))).flatten()
    }

    /// The marker with how well it is known and what else it could be.
    fn seen(
        &self,
        circles: Circles,
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

    /// The pose that a ring's own two edges speak for.
    fn own(&self, ring: &Ring, edges: &mut Vec<EdgePoint>) -> Result<(Circles, f64), Reason> {
        let (_, outer) = ring.kind.radii();
        let both = Circles::from_ellipse(&ring.outer, outer * self.size_m, self.camera)
            .ok_or(Reason::Pose)?;
        let own = ring.kind as usize * 2;
        let mut best: Option<(Circles, f64)> = None;
        for start in both {
            edges.clear();
            let support = [own, own + 1].map(|index| self.measure_edge(&start, index, edges));
            if !support.iter().all(|s| s.share().is_some_and(|share| share >= 0.6)) {
                continue;
            }
            let Some((circles, rms)) = start.refined(edges, self.camera) else { continue };
            if best.is_none_or(|(_, least)| rms < least) {
                best = Some((circles, rms));
            }
        }
        best.ok_or(Reason::Edges)
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

/// Whether the edges lie where the pose puts them, or a small marker's grey values are what they should be: blur moves
/// the edges of thin rings, but leaves them round.
fn fits(diameter_px: f64, rms_px: f64, difference: Option<f64>) -> bool {
    if diameter_px > photometry::MOST_DIAMETER_PX {
        // Paper is not quite flat, and lenses bend.
        return rms_px < 0.3 + 0.01 * diameter_px;
    }
    rms_px < 0.3 || difference.is_some_and(|d| d < 0.04)
}
