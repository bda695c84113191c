//! The pose of a marker from the grey values themselves.
//!
//! Where rings are a few pixels wide, the blur of one edge reaches the next, and edges located one by one lie too far
//! apart. Here the pose, the blur and the light are fitted together, so that the picture they predict comes
//! closest to the picture there is; nothing in the image says more about the pose than that.

use std::f64::consts::TAU;

use geometry::{CameraModel, Pixel};
use imaging::GrayView;
use nalgebra::{SMatrix, SVector, Vector3};

use crate::candidates::ring::RingKind;
use crate::families::rings::circle_pose::{CirclePlane, CirclePose, RayPlaneIntersection, project};
use crate::optics::edge_response::{Step, boxiness};
use crate::optics::exposure::ClippedExposure;

/// Markers of more pixels across have edges far enough apart.
pub(crate) const MOST_DIAMETER_PX: f64 = 180.0;
/// Of fewer pixels no ring can be told from a disc.
const LEAST_DIAMETER_PX: f64 = 5.0;
/// Up to this diameter all pixels take part, of larger markers those about the edges.
const ALL_PIXELS_PX: f64 = 22.0;
/// About as many pixels take part of a larger marker.
const SPOTS: f64 = 260.0;
/// Of so many or more, every so many-th is enough for the first steps, and for the choice of what to compare in the end.
const MANY_SPOTS: usize = 200;
const FEW_EVERY: usize = 3;
/// Standard deviation, in pixels, of the blur of a lens in focus and of the pixel's own extent.
const FOCUSED_PX: f64 = 0.6;
/// The least blur in any direction.
const LEAST_BLUR_PX: f64 = 0.3;
/// Brighter pixels may be of any brightness.
const WHITEST: f64 = 254.5;
/// So many standard deviations of the blur from an edge nothing is seen of it.
const FURTHEST_BLUR: f64 = 4.0;
/// Root mean square differences above this, in units of the contrast, are not of a marker.
const MOST_DIFFERENCE: f64 = 0.2;
/// Where it is larger before each of the first steps, there is no marker: about a third above the largest that any marker of
/// 800 had in a thousand pictures. Nine of ten other things that are looked at are given up at once, of larger ones half.
const HOPELESS_OF_SMALL: [f64; 3] = [0.27, 0.22, 0.17];
const HOPELESS: [f64; 3] = [0.45, 0.4, 0.35];

/// When a fit ends.
#[derive(Copy, Clone, Debug)]
struct Effort {
    /// So many steps at least, as the first may hardly improve anything; ...
    least_steps: usize,
    /// ... and after so many, where it is a number, what differs much pulls no harder.
    rough_steps: Option<usize>,
    most_steps: usize,
    /// Steps of a fit in the light of another.
    most_steps_of_other: usize,
    /// A step that improves the cost by a smaller share is the last one.
    least_gain: f64,
}

impl Effort {
    const FULL: Self = Self {
        least_steps: 3,
        rough_steps: Some(3),
        most_steps: 22,
        most_steps_of_other: 10,
        least_gain: 3e-4,
    };
    /// Of a marker that is about where it is expected.
    const OF_FOLLOWED: Self = Self {
        least_steps: 1,
        rough_steps: None,
        most_steps: 6,
        most_steps_of_other: 1,
        least_gain: 3e-2,
    };
}

/// Pose (5), blur, black, white, and white's change across and down.
const UNKNOWNS: usize = 10;
/// The same and the blur of a motion.
const UNKNOWNS_MOVING: usize = 12;
/// Where a larger difference is left, in units of the contrast, motion may be why, ...
const LEAST_OF_MOVING: f64 = 0.03;
/// ... if it leaves no more than this share of the cost.
const MOST_COST_OF_MOVING: f64 = 0.5;
/// A tilt, in radians, that is no longer a saddle of the fit: seen squarely, every tilt looks the same at first.
const LEAST_START_TILT: f64 = 0.2;
/// The pose tilted the other way is no alternative when it costs so many times more.
const MOST_COST_OF_OTHER: f64 = 4.0;
/// Poses whose normals differ by less, in radians, are one.
const DISTINCT_TILT: f64 = 0.02;
/// Where one pose costs so many times another, the other is the better one whatever the other spots say.
const CLOSE_COST: f64 = 1.15;
/// A last step that gains a larger share of the cost than this is no small one.
const MOST_GAIN: f64 = 0.5;
/// What is known of a normal before it is measured, as a standard deviation in radians.
const PRIOR_NORMAL: f64 = 0.6;

/// Everything that is fitted.
#[derive(Copy, Clone, Debug)]
struct Picture {
    circles: CirclePose,
    /// Standard deviation of the blur in pixels: the lens', and the pixels' own extent; its mean over all directions.
    blur_px: f64,
    /// What its variance has more to the right than down, over two, and the covariance of both, in square pixels: what a
    /// motion blurs.
    motion: [f64; 2],
    black: f64,
    white: f64,
    /// Change of white per pixel to the right and down.
    slope: [f64; 2],
}

/// A pixel that takes part.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Spot {
    ray: Vector3<f64>,
    /// Offset from the marker's centre, in pixels.
    offset: [f64; 2],
    grey: f64,
    /// Whether it lies well within the marker's rim.
    within: bool,
}

/// What a marker of a known look fitted to an image says.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Fit {
    pub(crate) circles: CirclePose,
    /// Covariance of the centre (m) and of the normal along [`CirclePose::basis`] (rad).
    pub(crate) covariance: SMatrix<f64, 5, 5>,
    /// Root mean square of the differences left, in units of the marker's contrast.
    pub(crate) difference: f64,
    /// The share of the variance within the marker that its rings explain.
    pub(crate) explained: f64,
    /// What is left of the differences from a plain disc, as a share of their squares.
    pub(crate) beside_disc: f64,
    /// How dark the middle ring is in units of the outer one, each left to itself.
    pub(crate) balance: f64,
    /// White less black, in grey levels.
    pub(crate) contrast: f64,
    /// Standard deviation of the blur, in pixels.
    pub(crate) blur_px: f64,
}

impl Fit {
    /// Whether it is the marker and not something else of about its size: much closer to the image than a plain disc, with
    /// two rings as black as one another.
    pub(crate) fn is_marker(&self) -> bool {
        const MOST_BESIDE_DISC: f64 = 0.12;
        self.beside_disc < MOST_BESIDE_DISC && (0.8..1.25).contains(&self.balance)
    }
}

/// The marker of this size that looks most like the image, from a pose that is nearly right, and the one tilted the
/// other way where that is another. `spots` is working memory.
pub(crate) fn refined(
    view: GrayView<'_>,
    camera: &CameraModel,
    start: &CirclePose,
    size_m: f64,
    inverted: bool,
    spots: &mut Vec<Spot>,
) -> Option<(Fit, Option<Alternative>)> {
    spots.clear();
    let around = Around { view, camera, size_m, inverted };
    let is_small = start.projected(size_m / 2.0, camera)?.major < ALL_PIXELS_PX;
    let hopeless = if is_small { HOPELESS_OF_SMALL } else { HOPELESS };
    around.gather(start, FOCUSED_PX, spots)?;
    let tilted = |circles: &CirclePose| circles.with_min_tilt(LEAST_START_TILT);
    let every = every(spots);
    let few = Scene { every, ..Scene::new(spots, size_m, camera, hopeless) };
    let mut first = few.fitted(&tilted(start), None, None)?;
    // What lies beyond the paper is kept out once the blur is known.
    let circles = first.picture.circles;
    if first.difference(&few) < MOST_DIFFERENCE
        && around.gather(&circles, first.picture.blur_px, spots)?
    {
        let scene = Scene { every, ..Scene::new(spots, size_m, camera, hopeless) };
        first = scene.fitted(&tilted(&circles), None, None)?;
    }
    let mut all = Scene::new(spots, size_m, camera, hopeless);
    let mut few = Scene { every, ..Scene::new(spots, size_m, camera, hopeless) };
    if (LEAST_OF_MOVING..MOST_DIFFERENCE).contains(&first.difference(&few)) {
        few.moving = true;
        let moving = few.fitted(&first.picture.circles, Some(&first), None);
        match moving.filter(|moving| moving.cost < MOST_COST_OF_MOVING * first.cost) {
            Some(moving) => (first, all.moving) = (moving, true),
            None => few.moving = false,
        }
    }
    // The fit to all spots, from that to few of them.
    let by_all = |fitted: Fitted| match every {
        1 => Some(fitted),
        _ => all.fitted(&fitted.picture.circles, Some(&fitted), None),
    };
    if first.difference(&few) > MOST_DIFFERENCE {
        return Some((all.fit(&by_all(first)?)?, None));
    }
    // Tilted to a wrong side at first, it may have stopped where it faces the camera.
    if first.picture.circles.tilt() < LEAST_START_TILT / 2.0 {
        let turned = tilted(&first.picture.circles).with_tilt_rotated();
        if let Some(other) = few.fitted(&turned, Some(&first), Some(1.1 * first.cost))
            && other.cost < first.cost
        {
            first = other;
        }
    }
    let mirrored = tilted(&first.picture.circles).mirrored();
    let most = MOST_COST_OF_OTHER * first.cost;
    let second = few.fitted(&mirrored, Some(&first), Some(most));
    let first = by_all(first)?;
    let Some(second) = second.and_then(by_all) else {
        return Some((all.fit(&first)?, None));
    };
    let (best, other) = if second.cost < first.cost { (second, first) } else { (first, second) };
    let other = other.alternative(&all);
    let fit = all.fit(&best)?;
    let same = fit.circles.normal.angle(&other.circles.normal) < DISTINCT_TILT;
    Some((fit, (!same).then_some(other)))
}

/// As [`refined`], of a marker that is followed, from where it should be: most of the way goes by few of the spots, and one
/// step by all of them. `None` for one so small that all of its pixels count, too.
pub(crate) fn refined_again(
    view: GrayView<'_>,
    camera: &CameraModel,
    expected: &CirclePose,
    size_m: f64,
    spots: &mut Vec<Spot>,
) -> Option<(Fit, Option<Alternative>)> {
    spots.clear();
    let around = Around { view, camera, size_m, inverted: false };
    around.gather(expected, FOCUSED_PX, spots)?;
    if spots.len() < MANY_SPOTS {
        return None;
    }
    let all = Scene::new(spots, size_m, camera, HOPELESS);
    let few = Scene {
        every: every(spots),
        effort: Effort::OF_FOLLOWED,
        ..Scene::new(spots, size_m, camera, HOPELESS)
    };
    let first = few.fitted(expected, None, None)?;
    if first.difference(&few) > MOST_DIFFERENCE {
        return None;
    }
    let mirrored = first.picture.circles.with_min_tilt(LEAST_START_TILT).mirrored();
    let most = MOST_COST_OF_OTHER * first.cost;
    let second = few.fitted(&mirrored, Some(&first), Some(most));
    let (mut best, mut other) = match second {
        Some(second) if second.cost < first.cost => (second, Some(first)),
        second => (first, second),
    };
    best.limit = few.limit(best.limit, best.cost);
    if let Some(other) = &mut other {
        other.limit = best.limit;
    }
    // Which of the two it is all spots say, where few hardly do.
    let is_open = other.as_ref().is_some_and(|other| other.cost < CLOSE_COST * best.cost);
    best = all.stepped(&best)?;
    if is_open {
        let stepped = other.as_ref().and_then(|other| all.stepped(other));
        other = match stepped {
            Some(stepped) if stepped.cost < best.cost => {
                Some(std::mem::replace(&mut best, stepped))
            }
            stepped => stepped,
        };
    }
    let scene = if is_open { &all } else { &few };
    let other = other
        .map(|other| other.alternative(scene))
        .filter(|other| other.circles.normal.angle(&best.picture.circles.normal) >= DISTINCT_TILT);
    Some((all.fit_judged(&best, best.picture.worth(&few)?)?, other))
}

/// Every so many-th spot that is enough for the first steps, of those not too bright to tell anything.
fn every(spots: &[Spot]) -> usize {
    let clear = spots.iter().filter(|spot| spot.grey <= WHITEST).count();
    if clear < MANY_SPOTS { 1 } else { FEW_EVERY }
}

/// The marker tilted the other way.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Alternative {
    pub(crate) circles: CirclePose,
    /// As of [`Fit`].
    pub(crate) difference: f64,
    pub(crate) blur_px: f64,
}

/// Where spots are gathered.
struct Around<'a> {
    view: GrayView<'a>,
    camera: &'a CameraModel,
    size_m: f64,
    inverted: bool,
}

impl Around<'_> {
    /// The pixels in and just around the marker; of a large one those about its edges. False when they would be the same
    /// as those of a lens in focus that are there already.
    fn gather(&self, circles: &CirclePose, blur_px: f64, spots: &mut Vec<Spot>) -> Option<bool> {
        let outline = circles.projected(self.size_m / 2.0, self.camera)?;
        let middle = project(circles.centre, self.camera)?;
        let diameter_px = outline.major;
        if !(LEAST_DIAMETER_PX..=MOST_DIAMETER_PX).contains(&diameter_px) {
            return None;
        }
        // The paper is white for a ring's width around the marker.
        let reach = |blur_px: f64| (0.6 - 1.5 * blur_px / diameter_px).clamp(0.45, 0.55);
        let focused = reach(FOCUSED_PX).max(0.51);
        let reach = reach(blur_px).min(focused);
        if !spots.is_empty() && (diameter_px > ALL_PIXELS_PX || reach > focused - 0.015) {
            return Some(false);
        }
        spots.clear();
        let mut add = |x: usize, y: usize, within: bool| {
            let place = [x as f64, y as f64];
            let grey = f64::from(self.view.at(x, y));
            spots.push(Spot {
                ray: self.camera.unproject(Pixel::new(place[0], place[1])).coords,
                offset: [place[0] - middle.x, place[1] - middle.y],
                grey: if self.inverted { 255.0 - grey } else { grey },
                within,
            });
        };
        let size = [self.view.width(), self.view.height()];
        if diameter_px > ALL_PIXELS_PX {
            about_edges(circles, self.size_m, self.camera, |place, within| {
                let [x, y] = place.map(f64::round);
                if x >= 0.0 && y >= 0.0 && x < size[0] as f64 && y < size[1] as f64 {
                    add(x as usize, y as usize, within);
                }
            });
        } else {
            let around = outline.grown(diameter_px * (2.0 * reach - 1.0));
            let half = around.major / 2.0;
            let bound = |axis: usize| {
                let from = (outline.centre[axis] - half).floor().max(0.0) as usize;
                let to = (outline.centre[axis] + half).ceil() + 1.0;
                from..to.clamp(0.0, size[axis] as f64) as usize
            };
            let (around, rim) = (around.axes(), outline.axes());
            let (rows, columns) = (bound(1), bound(0));
            for y in rows {
                for x in columns.clone() {
                    let place = [x as f64, y as f64];
                    if around.radius_of(place) <= 1.0 {
                        add(x, y, rim.radius_of(place) < 0.95);
                    }
                }
            }
        }
        (spots.len() > 3 * UNKNOWNS).then_some(true)
    }
}

/// Tells places across each edge of the marker, all round, and whether they lie within its rim.
fn about_edges(
    circles: &CirclePose,
    size_m: f64,
    camera: &CameraModel,
    mut tell: impl FnMut([f64; 2], bool),
) {
    const ACROSS: i32 = 2;
    let px_per_m = camera.fx / circles.centre.z;
    let (u, v) = circles.basis();
    let edges = RingKind::ALL.map(RingKind::radii);
    let total: f64 = edges.iter().map(|(inner, outer)| inner + outer).sum();
    for (index, radius) in edges.iter().flat_map(|(inner, outer)| [outer, inner]).enumerate() {
        let radius = radius * size_m;
        if radius * px_per_m < 2.5 {
            continue;
        }
        let share = radius / (total * size_m);
        let count = (SPOTS * share / f64::from(2 * ACROSS + 1)).ceil() as u32;
        for i in 0..count {
            let turn = (f64::from(i) + 0.37 * index as f64) * TAU / f64::from(count);
            let (sin, cos) = turn.sin_cos();
            let out = u * cos + v * sin;
            let (Some(on), Some(beyond)) = (
                project(circles.centre + out * radius, camera),
                project(circles.centre + out * (radius * 1.001), camera),
            ) else {
                continue;
            };
            let length = on.distance(&beyond);
            for step in -ACROSS..=ACROSS {
                let along = f64::from(step) / length;
                let place = [on.x + (beyond.x - on.x) * along, on.y + (beyond.y - on.y) * along];
                tell(place, index > 0 || step < 0);
            }
        }
    }
}

/// What a picture is fitted to.
struct Scene<'a> {
    spots: &'a [Spot],
    /// Of the spots every so many-th counts.
    every: usize,
    camera: &'a CameraModel,
    /// Radii of the circles in metres, the outermost first, and their logarithms.
    radii: [(f64, f64); 6],
    step: Step,
    /// The difference before each of the first steps above which there is no hope.
    hopeless: [f64; 3],
    effort: Effort,
    /// Whether the blur may be a motion's.
    moving: bool,
}

/// A picture that fits as well as any near it.
struct Fitted {
    picture: Picture,
    system: System,
    /// Sum of the squared differences, large ones counting less, ...
    cost: f64,
    /// ... those beyond this.
    limit: f64,
}

impl Fitted {
    /// Root mean square of the differences, in units of the contrast.
    fn difference(&self, scene: &Scene<'_>) -> f64 {
        (self.cost / scene.count()).sqrt() / (self.picture.white - self.picture.black)
    }

    fn alternative(&self, scene: &Scene<'_>) -> Alternative {
        Alternative {
            circles: self.picture.circles,
            difference: self.difference(scene),
            blur_px: self.picture.blur_px,
        }
    }
}

impl<'a> Scene<'a> {
    fn new(spots: &'a [Spot], size_m: f64, camera: &'a CameraModel, hopeless: [f64; 3]) -> Self {
        let mut radii = [(0.0, 0.0); 6];
        for (pair, kind) in radii.chunks_mut(2).zip(RingKind::ALL) {
            let (inner, outer) = kind.radii();
            for (slot, radius) in pair.iter_mut().zip([outer, inner]) {
                *slot = (radius * size_m, (radius * size_m).ln());
            }
        }
        let (every, effort) = (1, Effort::FULL);
        Self { spots, every, camera, radii, step: Step::new(), hopeless, effort, moving: false }
    }

    /// The best fit from here, in the light of another fit where there is one; `None` when its cost stays above what is
    /// `hopeless`.
    fn fitted(
        &self,
        start: &CirclePose,
        like: Option<&Fitted>,
        hopeless: Option<f64>,
    ) -> Option<Fitted> {
        let mut best = match like {
            Some(like) => Picture { circles: *start, ..like.picture },
            None => Picture {
                circles: *start,
                blur_px: FOCUSED_PX,
                motion: [0.0; 2],
                black: 0.0,
                white: 255.0,
                slope: [0.0; 2],
            },
        };
        if like.is_none() {
            best.expose(self)?;
        }
        // Differences beyond this pull no harder; about thrice what they are once the fit is good.
        let mut limit = match like {
            Some(like) => like.limit,
            None => 0.25 * (best.white - best.black),
        };
        let Effort { least_steps, most_steps, most_steps_of_other, least_gain, .. } = self.effort;
        let least_steps = if like.is_some() { 1 } else { least_steps };
        let (mut system, mut cost) = best.system(self, limit)?;
        let mut damping = if like.is_some() { 1e-4 } else { 1e-3 };
        let most_steps = if like.is_some() { most_steps_of_other } else { most_steps };
        for step in 0..most_steps {
            // Of what is no marker most is seen at once to be none.
            let most = self.hopeless.get(step).filter(|_| like.is_none());
            let most = most.map(|most| self.count() * (most * (best.white - best.black)).powi(2));
            if most.is_some_and(|most| cost > most) {
                return None;
            }
            let bad = hopeless.is_some_and(|most| cost > most)
                || cost > self.count() * (MOST_DIFFERENCE * (best.white - best.black)).powi(2);
            if step > least_steps && bad {
                break;
            }
            let candidate = best.stepped(&system, damping);
            match candidate.and_then(|c| Some((c, c.system(self, limit)?))) {
                Some((next, (next_system, next_cost))) if next_cost <= cost => {
                    let settled = cost - next_cost < least_gain * cost;
                    (best, system, cost) = (next, next_system, next_cost);
                    damping = (damping * 0.1).max(1e-7);
                    if like.is_none() && self.effort.rough_steps == Some(step + 1) {
                        limit = self.limit(limit, cost);
                        (system, cost) = best.system(self, limit)?;
                    } else if settled && step >= least_steps {
                        break;
                    }
                }
                _ => {
                    damping *= 20.0;
                    if damping > 1e4 {
                        break;
                    }
                }
            }
        }
        let fits = best.white > best.black && hopeless.is_none_or(|most| cost <= most);
        fits.then_some(Fitted { picture: best, system, cost, limit })
    }

    /// One step from a fit that is nearly this scene's: so near, what the cost is after it follows from what it is before.
    fn stepped(&self, fitted: &Fitted) -> Option<Fitted> {
        const DAMPING: f64 = 1e-6;
        let limit = fitted.limit;
        let (system, cost) = fitted.picture.system(self, limit)?;
        let (picture, gain) = fitted.picture.stepped_by(&system, DAMPING)?;
        (gain < MOST_GAIN * cost).then_some(Fitted { picture, system, cost: cost - gain, limit })
    }

    fn fit(&self, fitted: &Fitted) -> Option<Fit> {
        self.fit_judged(fitted, fitted.picture.worth(self)?)
    }

    /// What a fit says, as worth what [`Picture::worth`] says.
    fn fit_judged(
        &self,
        fitted: &Fitted,
        [beside_disc, balance, explained]: [f64; 3],
    ) -> Option<Fit> {
        let picture = &fitted.picture;
        Some(Fit {
            circles: picture.circles,
            covariance: self.covariance(&fitted.system, fitted.cost)?,
            difference: fitted.difference(self),
            explained,
            beside_disc,
            balance,
            contrast: picture.white - picture.black,
            blur_px: picture.blur_px,
        })
    }

    /// Differences of a good fit are hardly larger than this.
    fn limit(&self, before: f64, cost: f64) -> f64 {
        before.min(3.0 * (cost / self.count()).sqrt() + 1.0)
    }

    fn count(&self) -> f64 {
        self.spots.len().div_ceil(self.every) as f64
    }

    /// Of the pose, from the differences that are left: noise, and what the model does not know.
    fn covariance(&self, system: &System, cost: f64) -> Option<SMatrix<f64, 5, 5>> {
        let count = system.count;
        let unknowns = if self.moving { UNKNOWNS_MOVING } else { UNKNOWNS };
        // Of what noise there is where the picture tells of the pose, when that is more than elsewhere.
        let mean = (cost / count).max(system.told_variance);
        let variance = mean * count / (count - unknowns as f64).max(1.0) + 1.0 / 12.0;
        let mut information = system.matrix / variance;
        for i in 0..UNKNOWNS_MOVING {
            information[(i, i)] += 1e-9;
        }
        for i in 3..5 {
            information[(i, i)] += 1.0 / (PRIOR_NORMAL * PRIOR_NORMAL);
        }
        let all = information.cholesky()?.inverse();
        Some(all.fixed_view::<5, 5>(0, 0).into_owned())
    }
}

/// What a pixel sees of the marker.
struct Looks {
    /// The shares of the pixel's light from within each circle, the outermost first.
    within: [f64; 6],
    /// How the distance from the centre, in pixels, changes with the pose.
    by_pose: [f64; 5],
    /// How the whiteness changes with that distance, and with the blur.
    by_distance: f64,
    by_blur: f64,
    by_motion: [f64; 2],
}

impl Looks {
    /// How white the pixel is, from 0 (black) to 1.
    fn white(&self) -> f64 {
        let [a, b, c, d, e, f] = self.within;
        1.0 - a + b - c + d - e + f
    }
}

/// The blur of a picture.
struct Blur {
    blur_px: f64,
    /// To the right, between right and down, and down, in square pixels.
    covariance: [f64; 3],
    /// In the direction in which there is least.
    least_variance: f64,
    /// One over the standard deviation in the direction in which there is most.
    per_most: f64,
}

/// Where the places lie that are drawn from the blur about a pixel.
///
/// Of such a place the squared distance from the centre is a quadratic form in normal variables; how often it falls within
/// a circle is known closely (Jensen and Solomon, "A Gaussian approximation to the distribution of a definite quadratic
/// form", JASA 1972), also for circles no larger than the blur: to this power, it is nearly normal.
#[derive(Copy, Clone)]
struct Places {
    meeting: RayPlaneIntersection,
    /// The logarithm of the mean of the squared distance.
    log_square: f64,
    power: f64,
    /// Mean of that power of what the squared distance is in units of its mean, and one over its standard deviation.
    mean: f64,
    per_deviation: f64,
    /// How the share within a circle changes with the pixel's distance, in pixels outwards.
    outwards: f64,
    boxiness: f64,
    /// One over what the blur is at most, in metres outwards: what is around the centre moves places outwards as well.
    per_blur: f64,
    /// How the logarithm of that deviation changes with the blur and with the motion's two numbers.
    by_blur: f64,
    by_motion: [f64; 2],
}

impl Places {
    /// Without a branch, so that many are worked out at once.
    #[inline(always)]
    fn about(ray: &Vector3<f64>, plane: &CirclePlane, blur: &Blur) -> Self {
        let meeting = plane.intersect(ray);
        let RayPlaneIntersection {
            rho, radial: a, tangential: b, metres_per_px, px_per_metre, ..
        } = meeting;
        // Variances outwards and around, and the two together.
        let [xx, xy, yy] = blur.covariance;
        let blurred = |[x, y]: [f64; 2]| [xx * x + xy * y, xy * x + yy * y];
        let dot = |[x, y]: [f64; 2], [u, v]: [f64; 2]| x * u + y * v;
        let (rr, tt, rt) = (dot(a, blurred(a)), dot(b, blurred(b)), dot(b, blurred(a)));
        let (trace, det) = (rr + tt, rr * tt - rt * rt);
        let square = rho * rho;
        // Cumulants of the squared distance.
        let k1 = square + trace;
        let k2 = 2.0 * (trace * trace - 2.0 * det) + 4.0 * square * rr;
        let k3 = 8.0 * (trace * trace - 3.0 * det) * trace + 24.0 * square * (rr * rr + rt * rt);
        let (per_k1, per_k2) = (1.0 / k1, 1.0 / k2);
        let power = 1.0 - k1 * k3 * (per_k2 * per_k2) / 3.0;
        let mean = 1.0 + power * (power - 1.0) * k2 * (per_k1 * per_k1) / 2.0;
        let per_spread = k2.sqrt() * per_k2;
        let normal = a.map(|part| part * px_per_metre);
        let [nx, ny] = normal;
        let variance = rr * (px_per_metre * px_per_metre);
        let per_variance = 1.0 / variance;
        // A motion is a box, as a pixel is, of which the variance here is that beyond the least in any direction.
        let of_box = 1.0 - blur.least_variance * per_variance;
        Self {
            meeting,
            log_square: k1.ln(),
            power,
            mean,
            per_deviation: k1 * per_spread / power,
            outwards: -2.0 * rho * metres_per_px * per_spread,
            boxiness: boxiness(normal, variance) - of_box * of_box / 20.0,
            per_blur: px_per_metre * blur.per_most,
            by_blur: blur.blur_px * per_variance,
            by_motion: [0.5 * (nx * nx - ny * ny) * per_variance, nx * ny * per_variance],
        }
    }

    /// What a pixel with such a blur sees of the marker.
    #[inline]
    fn looks(&self, scene: &Scene<'_>) -> Looks {
        let RayPlaneIntersection { rho, by_pose, .. } = self.meeting;
        let (mut within, mut by_distance, mut by_deviation) = ([0.0; 6], 0.0, 0.0);
        for (index, (within, (radius, log_radius))) in
            within.iter_mut().zip(scene.radii).enumerate()
        {
            // Outer edges end the black, inner ones begin the white.
            let sign = if index % 2 == 0 { -1.0 } else { 1.0 };
            let rough = (radius - rho) * self.per_blur;
            if rough.abs() > FURTHEST_BLUR {
                *within = if rough > 0.0 { 1.0 } else { 0.0 };
                continue;
            }
            let ratio = exp(self.power * (2.0 * log_radius - self.log_square));
            let z = (ratio - self.mean) * self.per_deviation;
            let (step, density) = scene.step.at(z, self.boxiness);
            *within = step;
            // Outwards, per pixel.
            by_distance += sign * density * self.outwards * ratio;
            by_deviation -= sign * density * z;
        }
        Looks {
            within,
            by_pose,
            by_distance,
            by_blur: by_deviation * self.by_blur,
            by_motion: self.by_motion.map(|by| by_deviation * by),
        }
    }
}

impl Picture {
    /// Tells what each spot that counts sees of the marker; `None` when one does not see its plane.
    #[inline]
    fn look_at(&self, scene: &Scene<'_>, mut tell: impl FnMut(&Spot, &Looks)) -> Option<()> {
        // So many at once that divisions and roots do not wait for one another.
        const BATCH: usize = 8;
        let plane = self.circles.plane(scene.camera);
        let (variance, [p, q]) = (self.blur_px * self.blur_px, self.motion);
        let blur = Blur {
            blur_px: self.blur_px,
            covariance: [variance + p, q, variance - p],
            least_variance: variance - p.hypot(q),
            per_most: 1.0 / (variance + p.hypot(q)).sqrt(),
        };
        for spots in scene.spots.chunks(BATCH * scene.every) {
            let mut counted = spots.iter().step_by(scene.every);
            let last = spots.last()?;
            let batch: [&Spot; BATCH] = std::array::from_fn(|_| counted.next().unwrap_or(last));
            let places = batch.map(|spot| Places::about(&spot.ray, &plane, &blur));
            let count = spots.len().div_ceil(scene.every);
            for (spot, places) in batch.iter().zip(&places).take(count) {
                if !places.meeting.is_valid() {
                    return None;
                }
                tell(spot, &places.looks(scene));
            }
        }
        Some(())
    }

    /// How many times less a marker differs from the image than a plain disc in its place does; how dark its middle ring
    /// is in units of the outer one, when each has a grey value of its own; and the share of the variance of the pixels
    /// within the rim that the picture explains.
    fn worth(&self, scene: &Scene<'_>) -> Option<[f64; 3]> {
        let mut disc = SMatrix::<f64, 3, 3>::zeros();
        let mut rings = SMatrix::<f64, 4, 4>::zeros();
        let (mut n, mut sum, mut squares, mut unexplained) = (0.0, 0.0, 0.0, 0.0);
        self.look_at(scene, |spot, looks| {
            let [a, b, c, d, e, f] = looks.within;
            let (grey, _) = self.grey(spot, looks.white());
            // The light's slope is taken as found.
            let seen = if spot.grey > WHITEST { spot.grey.max(grey) } else { spot.grey };
            if spot.within {
                n += 1.0;
                sum += seen;
                squares += seen * seen;
                unexplained += (grey - seen).powi(2);
            }
            let lit = seen - grey + self.black + (self.white - self.black) * looks.white();
            let plain = SVector::<f64, 3>::new(1.0, a, lit);
            disc.syger(1.0, &plain, &plain, 1.0);
            let apart = SVector::<f64, 4>::new(1.0, a - b, c - d + e - f, lit);
            rings.syger(1.0, &apart, &apart, 1.0);
        })?;
        disc.fill_upper_triangle_with_lower_triangle();
        rings.fill_upper_triangle_with_lower_triangle();
        let of_disc = disc.fixed_view::<2, 2>(0, 0).into_owned();
        let to_disc = disc.fixed_view::<2, 1>(0, 2).into_owned();
        let left = disc[(2, 2)] - to_disc.dot(&(of_disc.try_inverse()? * to_disc));
        let of_rings = rings.fixed_view::<3, 3>(0, 0).into_owned();
        let to_rings = rings.fixed_view::<3, 1>(0, 3).into_owned();
        let levels = of_rings.try_inverse()? * to_rings;
        let own = rings[(3, 3)] - to_rings.dot(&levels);
        let variance = squares - sum * sum / n;
        let explained = (variance > 0.0).then(|| 1.0 - unexplained / variance)?;
        Some([own.max(0.0) / left.max(1e-9), levels[2] / levels[1], explained])
    }

    /// Black and white that fit the image best with everything else as it is.
    fn expose(&mut self, scene: &Scene<'_>) -> Option<()> {
        let mut exposure = ClippedExposure::new(WHITEST);
        self.look_at(scene, |spot, looks| exposure.add(looks.white(), spot.grey))?;
        let [black, contrast] = exposure.black_and_contrast();
        (self.black, self.white) = (black, black + contrast);
        (contrast > 1.0).then_some(())
    }

    /// The grey value predicted for a pixel of this whiteness.
    fn grey(&self, spot: &Spot, white: f64) -> (f64, f64) {
        let [x, y] = spot.offset;
        let contrast = self.white + self.slope[0] * x + self.slope[1] * y - self.black;
        (self.black + contrast * white, contrast)
    }

    /// The normal equations of one step, and the cost here.
    fn system(&self, scene: &Scene<'_>, limit: f64) -> Option<(System, f64)> {
        let (mut matrix, mut right) = ([[0.0; UNKNOWNS]; UNKNOWNS], [0.0; UNKNOWNS]);
        let mut of_motion = [[0.0; UNKNOWNS_MOVING + 1]; 2];
        let (mut cost, mut count, mut telling, mut told) = (0.0, 0.0, 0.0, 0.0);
        self.look_at(scene, |spot, looks| {
            let white = looks.white();
            let [x, y] = spot.offset;
            let (grey, contrast) = self.grey(spot, white);
            // Where both are beyond what a pixel tells, nothing is known.
            if grey > WHITEST && spot.grey > WHITEST {
                return;
            }
            count += 1.0;
            let difference = grey - spot.grey;
            let size = difference.abs();
            let weight = if size > limit { limit / size } else { 1.0 };
            let square = if size > limit { limit * (2.0 * size - limit) } else { size * size };
            cost += square;
            let by_distance = looks.by_distance * contrast;
            told += by_distance * by_distance * square;
            telling += by_distance * by_distance;
            let [a, b, c, d, e] = looks.by_pose;
            let slope: [f64; UNKNOWNS] = [
                a * by_distance,
                b * by_distance,
                c * by_distance,
                d * by_distance,
                e * by_distance,
                contrast * looks.by_blur,
                1.0 - white,
                white,
                white * x,
                white * y,
            ];
            let weighted = slope.map(|s| s * weight);
            for (row, (scaled, sum)) in matrix.iter_mut().zip(weighted.iter().zip(&mut right)) {
                *sum -= scaled * difference;
                // All of the row, though half would do: it takes no longer.
                for (entry, other) in row.iter_mut().zip(&slope) {
                    *entry += scaled * other;
                }
            }
            if scene.moving {
                let by_motion = looks.by_motion.map(|by| by * contrast);
                let others = slope.iter().chain(&by_motion).copied().chain([-difference]);
                for (index, other) in others.enumerate() {
                    of_motion[0][index] += weight * by_motion[0] * other;
                    of_motion[1][index] += weight * by_motion[1] * other;
                }
            }
        })?;
        let told_variance = if telling > 0.0 { told / telling } else { 0.0 };
        let (matrix, right) = with_motion((matrix, right), of_motion, scene.moving);
        let system = System { matrix, right, count, told_variance };
        cost.is_finite().then_some((system, cost))
    }

    fn stepped(&self, system: &System, damping: f64) -> Option<Self> {
        self.stepped_by(system, damping).map(|(picture, _)| picture)
    }

    /// The picture after a step, and by how much less it costs.
    fn stepped_by(&self, system: &System, damping: f64) -> Option<(Self, f64)> {
        let mut matrix = system.matrix;
        for i in 0..UNKNOWNS_MOVING {
            matrix[(i, i)] += damping * system.matrix[(i, i)] + 1e-9;
        }
        let step = matrix.cholesky()?.solve(&system.right);
        let blur_px = (self.blur_px + step[5].clamp(-0.3, 0.3)).clamp(LEAST_BLUR_PX, 6.0);
        // In no direction may less blur be left.
        let motion = [self.motion[0] + step[10], self.motion[1] + step[11]];
        let most = blur_px * blur_px - LEAST_BLUR_PX * LEAST_BLUR_PX;
        let scale = (most / motion[0].hypot(motion[1]).max(1e-12)).min(1.0);
        let picture = Self {
            circles: self.circles.moved(&step.fixed_rows::<5>(0).into_owned())?,
            blur_px,
            motion: motion.map(|part| part * scale),
            black: self.black + step[6],
            white: self.white + step[7],
            slope: [self.slope[0] + step[8], self.slope[1] + step[9]],
        };
        Some((picture, step.dot(&system.right)))
    }
}

struct System {
    matrix: Matrix,
    right: Column,
    /// Of so many spots: not of those that are so bright that they say nothing.
    count: f64,
    /// Mean of the squared differences, each counting as much as it says about the pose.
    told_variance: f64,
}

type Matrix = SMatrix<f64, UNKNOWNS_MOVING, UNKNOWNS_MOVING>;
type Column = SVector<f64, UNKNOWNS_MOVING>;

/// The normal equations of one step with the rows of the motion; a motion that is not asked for is nought for sure.
fn with_motion(
    (matrix, right): ([[f64; UNKNOWNS]; UNKNOWNS], [f64; UNKNOWNS]),
    of_motion: [[f64; UNKNOWNS_MOVING + 1]; 2],
    moving: bool,
) -> (Matrix, Column) {
    const SURE: f64 = 1e12;
    let (mut all, mut all_right) = (Matrix::zeros(), Column::zeros());
    all.fixed_view_mut::<UNKNOWNS, UNKNOWNS>(0, 0).copy_from(&SMatrix::from(matrix));
    all_right.fixed_rows_mut::<UNKNOWNS>(0).copy_from(&SVector::from(right));
    for (row, sums) in (UNKNOWNS..).zip(of_motion) {
        let Some((right, sums)) = sums.split_last() else { continue };
        all_right[row] = *right;
        for (column, sum) in sums.iter().enumerate() {
            (all[(row, column)], all[(column, row)]) = (*sum, *sum);
        }
        if !moving {
            all[(row, row)] = SURE;
        }
    }
    (all, all_right)
}

/// The exponential function, in fewer steps where the argument is small.
#[inline]
fn exp(x: f64) -> f64 {
    if x.abs() > 0.4 {
        return x.exp();
    }
    // To the eighth power: wrong by about a billionth at most.
    let [a, b, c, d] = [1.0 / 6.0, 1.0 / 24.0, 1.0 / 120.0, 1.0 / 720.0];
    // In pairs, which need not wait for one another (Estrin's scheme).
    let square = x * x;
    let low = 1.0 + x + square * (0.5 + x * a);
    let high = b + x * c + square * (d + x * (1.0 / 5040.0) + square * (1.0 / 40_320.0));
    low + square * square * high
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_exponential_function() {
        for i in -80..=80 {
            let x = f64::from(i) * 0.01;
            assert!((exp(x) / x.exp() - 1.0).abs() < 2e-9, "{x}");
        }
    }

    /// A picture made by the model itself leads back to the pose it was made with, also where white is beyond the scale
    /// or a motion blurs it.
    #[test]
    fn the_pose_comes_back_from_its_picture() {
        for (paper, blur_px, motion) in
            [(200.0, 0.6, [0.0; 2]), (500.0, 0.6, [0.0; 2]), (200.0, 1.1, [0.8, -0.5])]
        {
            let (found, truth) = from_its_picture(paper, blur_px, motion);
            assert!(found.difference < 0.005 && found.explained > 0.999, "{paper} {found:?}");
            let off = found.circles.centre - truth.centre;
            assert!(off.norm() < 2e-4 * 6.0, "{paper} {found:?}");
            assert!(found.circles.normal.angle(&truth.normal) < 0.02, "{paper} {found:?}");
        }
    }

    /// What is found in a picture whose white is so bright and that is blurred so, and the truth.
    fn from_its_picture(paper: f64, blur_px: f64, motion: [f64; 2]) -> (Fit, CirclePose) {
        let camera = CameraModel::pinhole(100, 80, 909.0);
        let size_m = 0.15341;
        let truth = CirclePose {
            centre: Vector3::new(0.03, -0.05, 6.0),
            normal: Vector3::new(0.3, 0.2, -0.9).normalize(),
        };
        let picture = Picture {
            circles: truth,
            blur_px,
            motion,
            black: 30.0,
            white: paper,
            slope: [0.5, -0.3],
        };
        let middle = project(truth.centre, &camera).unwrap();
        let data: Vec<u8> = (0..8000)
            .map(|i| {
                let (x, y) = (f64::from(i % 100), f64::from(i / 100));
                let ray = camera.unproject(Pixel::new(x, y)).coords;
                let offset = [x - middle.x, y - middle.y];
                let spots = [Spot { ray, offset, grey: 0.0, within: true }];
                let scene = Scene::new(&spots, size_m, &camera, HOPELESS);
                let mut grey = 0.0;
                picture
                    .look_at(&scene, |spot, looks| grey = picture.grey(spot, looks.white()).0)
                    .unwrap();
                grey.round() as u8
            })
            .collect();
        let view = GrayView::packed(&data, 100, 80).unwrap();
        let start = CirclePose {
            centre: truth.centre * 1.01,
            normal: Vector3::new(0.1, 0.1, -0.9).normalize(),
        };
        let (fit, _) = refined(view, &camera, &start, size_m, false, &mut Vec::new()).unwrap();
        (fit, truth)
    }
}
