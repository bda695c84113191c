//! Models a three-ring marker's grey values (pose, blur, exposure, camera response) and fits the model by least squares to
//! pixel samples.

use nalgebra::{SMatrix, SVector};

use super::blur::{Blur, InterpolatedBlur, PixelResponse, RadiusDistribution};
use super::model::{Effort, Extras, MAX_GREY, MAX_RESIDUAL, UNKNOWNS, UNKNOWNS_WITH_EXTRAS};
use super::scene::{FOCUSED_PX, PixelSample, Scene};
use super::{MAX_MOSAIC_STEP, MAX_PROCESSED_STEP};
use crate::families::rings::circle_pose::CirclePose;
use crate::optics::camera_response::{CameraResponse, SHARPENING_PX};
use crate::optics::exposure::ClippedExposure;
use crate::optics::least_squares::{
    Damping, Influence, Next, NormalEquations, Problem, Schedule, huber, minimise,
};
use crate::optics::mosaic::Mosaic;
use crate::response::Measured;

/// Bounds of the blur in any direction, as a standard deviation in pixels.
const MIN_BLUR_PX: f64 = 0.3;
const MAX_BLUR_PX: f64 = 6.0;
/// Largest change of the blur in one step, in pixels.
const MAX_BLUR_STEP_PX: f64 = 0.3;
/// A single step that lowers the cost by a larger fraction than this is too long for the quadratic model.
const MAX_GAIN: f64 = 0.5;
/// The Huber limit in root mean square residuals, and in grey levels beyond that.
const HUBER_SIGMAS: f64 = 3.0;
const HUBER_OFFSET: f64 = 1.0;
/// Places of black and white among the unknowns.
const BLACK: usize = 6;
const WHITE: usize = 7;
/// Added to the diagonal of the normal equations.
const RIDGE: f64 = 1e-9;

/// Everything that is fitted.
#[derive(Copy, Clone, Debug)]
pub(super) struct RingModel {
    pub(super) pose: CirclePose,
    /// Blur of lens and pixel, averaged over all directions, as a standard deviation in pixels.
    pub(super) blur_px: f64,
    /// Motion blur, in square pixels: half of the difference between the blur's variances to the right and
    /// down, and their covariance.
    pub(super) motion: [f64; 2],
    pub(super) black: f64,
    pub(super) white: f64,
    /// Change of white per pixel to the right and down.
    pub(super) gradient: [f64; 2],
    pub(super) response: CameraResponse,
}

/// A pixel as blurred by the sharpening's kernel.
pub(super) struct Sharpened {
    pub(super) radius: RadiusDistribution,
    /// The blur over that with the kernel, and its derivative by the blur.
    pub(super) ratio: f64,
    ratio_by_blur: f64,
    /// Derivative of the blur with the kernel by the lens' blur.
    wide_by_blur: f64,
}

impl Sharpened {
    /// The value that a camera of this response shows for a pixel and its neighbours.
    #[inline]
    pub(super) fn processed(
        &self,
        own: &PixelResponse,
        blurred: &PixelResponse,
        response: &CameraResponse,
    ) -> PixelResponse {
        own.processed(response, blurred, self.ratio, self.ratio_by_blur, self.wide_by_blur)
    }
}

impl RingModel {
    /// White minus black, in grey levels.
    pub(super) fn contrast(&self) -> f64 {
        self.white - self.black
    }

    /// Calls `visit` with each sample that counts and the model's response there; `None` when a ray misses
    /// the plane.
    #[inline]
    pub(super) fn for_each_response(
        &self,
        scene: &Scene<'_>,
        mut visit: impl FnMut(&PixelSample, &PixelResponse),
    ) -> Option<()> {
        self.for_each_place(scene, |sample, radius, wide| {
            visit(sample, &self.response_at(scene, radius, wide));
        })
    }

    /// The model's response at a distance from the centre, as the camera shows it.
    #[inline]
    pub(super) fn response_at(
        &self,
        scene: &Scene<'_>,
        radius: &RadiusDistribution,
        wide: Option<&Sharpened>,
    ) -> PixelResponse {
        let own = radius.response(scene);
        match wide {
            None => own,
            Some(wide) => wide.processed(&own, &wide.radius.response(scene), &self.response),
        }
    }

    /// Calls `visit` with each sample that counts and its distance from the centre, and with that as blurred by the
    /// sharpening's kernel where the camera's processing takes part.
    #[inline]
    pub(super) fn for_each_place(
        &self,
        scene: &Scene<'_>,
        mut visit: impl FnMut(&PixelSample, &RadiusDistribution, Option<&Sharpened>),
    ) -> Option<()> {
        // Large enough to hide the latency of divisions and roots.
        const BATCH: usize = 8;
        let plane = self.pose.plane(scene.camera);
        let blur = Blur::new(self.blur_px, self.motion);
        let phases = scene.mosaic.map(|m| InterpolatedBlur::by_phase(m, self.blur_px, self.motion));
        // Sharpening spreads pixels of all phases.
        let blur_px = match scene.mosaic {
            None => self.blur_px,
            Some(_) => (self.blur_px * self.blur_px + Mosaic::MEAN_VARIANCE).sqrt(),
        };
        let wide_px = blur_px.hypot(SHARPENING_PX);
        let is_linear = self.response == CameraResponse::LINEAR && scene.extras != Extras::Response;
        let wide = (!is_linear).then(|| Blur::new(wide_px, self.motion));
        let ratio = blur_px / wide_px;
        let ratio_by_blur = (1.0 - ratio * ratio) / wide_px * (self.blur_px / blur_px);
        let wide_by_blur = self.blur_px / wide_px;
        for samples in scene.samples.chunks(BATCH * scene.stride) {
            let mut counted = samples.iter().step_by(scene.stride);
            let last = samples.last()?;
            let batch: [&PixelSample; BATCH] =
                std::array::from_fn(|_| counted.next().unwrap_or(last));
            let radii = match &phases {
                None => batch.map(|sample| RadiusDistribution::about(&sample.ray, &plane, &blur)),
                Some(blurs) => batch.map(|sample| {
                    let [first, others @ ..] = blurs;
                    let blur = match usize::from(sample.phase).checked_sub(1) {
                        None => first,
                        Some(other) => others.get(other).unwrap_or(first),
                    };
                    RadiusDistribution::interpolated(&sample.ray, &plane, blur)
                }),
            };
            let count = samples.len().div_ceil(scene.stride);
            for (sample, radius) in batch.iter().zip(&radii).take(count) {
                if !radius.at.is_valid() {
                    return None;
                }
                let wide = wide.as_ref().map(|wide| {
                    let radius = RadiusDistribution::about(&sample.ray, &plane, wide);
                    Sharpened { radius, ratio, ratio_by_blur, wide_by_blur }
                });
                visit(sample, radius, wide.as_ref());
            }
        }
        Some(())
    }

    /// The predicted grey value of a pixel of this whiteness, and the contrast there.
    #[inline]
    pub(super) fn grey(&self, sample: &PixelSample, white: f64) -> (f64, f64) {
        let [x, y] = sample.offset;
        let contrast = self.white + self.gradient[0] * x + self.gradient[1] * y - self.black;
        (self.black + contrast * white, contrast)
    }

    /// Sets black and white to the values that fit best with all other unknowns fixed.
    fn expose(&mut self, scene: &Scene<'_>) -> Option<()> {
        let mut exposure = ClippedExposure::new(MAX_GREY);
        self.for_each_response(scene, |sample, response| {
            exposure.add(response.shown, sample.grey);
        })?;
        let [black, contrast] = exposure.black_and_contrast();
        (self.black, self.white) = (black, black + contrast);
        (contrast > 1.0).then_some(())
    }

    /// The normal equations with residuals weighted by this Huber limit, in grey levels.
    fn linearised(&self, scene: &Scene<'_>, limit: f64) -> Option<Equations> {
        let mut fixed = ([[0.0; UNKNOWNS]; UNKNOWNS], [0.0; UNKNOWNS]);
        let (matrix, right) = (&mut fixed.0, &mut fixed.1);
        let mut extras = [[0.0; UNKNOWNS_WITH_EXTRAS + 1]; 2];
        let (mut total, mut count, mut pose_weight, mut pose_squares) = (0.0, 0.0, 0.0, 0.0);
        self.for_each_response(scene, |sample, response| {
            let white = response.shown;
            let [x, y] = sample.offset;
            let (grey, contrast) = self.grey(sample, white);
            // Both saturated: no information.
            if grey > MAX_GREY && sample.grey > MAX_GREY {
                return;
            }
            count += 1.0;
            let residual = grey - sample.grey;
            let Influence { weight, cost } = huber(residual, limit);
            total += cost;
            let by_distance = response.by_distance * contrast;
            pose_squares += by_distance * by_distance * cost;
            pose_weight += by_distance * by_distance;
            let [a, b, c, d, e] = response.distance_by_pose;
            let gradient: [f64; UNKNOWNS] = [
                a * by_distance,
                b * by_distance,
                c * by_distance,
                d * by_distance,
                e * by_distance,
                contrast * response.by_blur,
                1.0 - white,
                white,
                white * x,
                white * y,
            ];
            let weighted = gradient.map(|g| g * weight);
            for (row, (scaled, sum)) in matrix.iter_mut().zip(weighted.iter().zip(&mut *right)) {
                *sum -= scaled * residual;
                // The whole row takes no longer than half of it.
                for (entry, other) in row.iter_mut().zip(&gradient) {
                    *entry += scaled * other;
                }
            }
            let by_extras = match scene.extras {
                Extras::Nothing => return,
                Extras::Motion => response.by_motion,
                Extras::Response => response.by_response,
            };
            let by_extras = by_extras.map(|by| by * contrast);
            let others = gradient.iter().chain(&by_extras).copied().chain([-residual]);
            for (index, other) in others.enumerate() {
                extras[0][index] += weight * by_extras[0] * other;
                extras[1][index] += weight * by_extras[1] * other;
            }
        })?;
        let pose_variance = if pose_weight > 0.0 { pose_squares / pose_weight } else { 0.0 };
        let are_fitted = scene.extras != Extras::Nothing;
        let (mut matrix, mut right) = with_extras(&fixed, &extras, are_fitted);
        let mut prior_cost = 0.0;
        for prior in self.priors(scene, limit) {
            matrix.ger(prior.weight, &prior.gradient, &prior.gradient, 1.0);
            right -= prior.gradient * (prior.weight * prior.residual);
            prior_cost += prior.cost();
        }
        total += prior_cost;
        let extra = Sums { count, pose_variance, prior_cost };
        total.is_finite().then_some(NormalEquations { matrix, right, cost: total, extra })
    }

    /// The prior of cameras in general, where this one's processing is fitted. The pixels of a small marker alone leave tone
    /// curve, sharpening, blur and black nearly open: without a prior the fit explains noise by a camera that does not exist,
    /// and then other radii fit best. `limit` is the Huber limit of the residuals, in grey levels.
    pub(super) fn priors(
        &self,
        scene: &Scene<'_>,
        limit: f64,
    ) -> impl Iterator<Item = PriorTerm> + use<> {
        let has_prior = scene.extras == Extras::Response && scene.has_prior;
        has_prior.then(|| self.prior_terms(noise_of(limit).powi(2))).into_iter().flatten()
    }

    fn prior_terms(&self, variance: f64) -> [PriorTerm; 3] {
        let CameraResponse { curve, sharpening } = self.response;
        let term = |index: usize, value: f64, prior: Measured| {
            let mut gradient = SVector::zeros();
            gradient[index] = 1.0;
            let weight = variance / (prior.deviation * prior.deviation);
            PriorTerm { gradient, residual: value - prior.value, weight }
        };
        let of_white = 1.0 / self.white.max(1.0);
        let share = self.black * of_white;
        let mut black = term(BLACK, share, CameraResponse::BLACK_PRIOR);
        black.gradient[BLACK] = of_white;
        black.gradient[WHITE] = -share * of_white;
        [
            term(UNKNOWNS, curve, CameraResponse::CURVE_PRIOR),
            term(UNKNOWNS + 1, sharpening, CameraResponse::SHARPENING_PRIOR),
            black,
        ]
    }

    /// The same with a lens as sharp as it is when a part of the blur is that of a mosaic.
    pub(super) fn sharper(&self) -> Self {
        let variance = self.blur_px * self.blur_px - Mosaic::MEAN_VARIANCE;
        let blur_px = variance.max(FOCUSED_PX * FOCUSED_PX / 2.0).sqrt();
        Self { blur_px, ..*self }
    }

    fn moved(&self, step: &SVector<f64, UNKNOWNS_WITH_EXTRAS>, extras: Extras) -> Option<Self> {
        let blur_px = self.blur_px + step[5].clamp(-MAX_BLUR_STEP_PX, MAX_BLUR_STEP_PX);
        let blur_px = blur_px.clamp(MIN_BLUR_PX, MAX_BLUR_PX);
        let by = [step[10], step[11]];
        let (motion, response) = match extras {
            Extras::Nothing => (self.motion, self.response),
            Extras::Motion => ([self.motion[0] + by[0], self.motion[1] + by[1]], self.response),
            Extras::Response => (self.motion, self.response.moved(by)),
        };
        let max_px2 = blur_px * blur_px - MIN_BLUR_PX * MIN_BLUR_PX;
        let scale = (max_px2 / motion[0].hypot(motion[1]).max(1e-12)).min(1.0);
        Some(Self {
            pose: self.pose.moved(&step.fixed_rows::<5>(0).into_owned())?,
            blur_px,
            motion: motion.map(|part| part * scale),
            black: self.black + step[6],
            white: self.white + step[7],
            gradient: [self.gradient[0] + step[8], self.gradient[1] + step[9]],
            response,
        })
    }
}

/// A residual of the unknowns themselves, how far they are from their expected values, and its gradient.
pub(super) struct PriorTerm {
    pub(super) gradient: SVector<f64, UNKNOWNS_WITH_EXTRAS>,
    pub(super) residual: f64,
    /// Of its square, so that the cost is in squared grey levels.
    pub(super) weight: f64,
}

impl PriorTerm {
    /// Its part of the cost.
    pub(super) fn cost(&self) -> f64 {
        self.weight * self.residual * self.residual
    }
}

/// The noise in grey levels to which a Huber limit belongs, as [`Scene::huber_limit`] sets it.
fn noise_of(limit: f64) -> f64 {
    const MIN_NOISE: f64 = 0.5;
    ((limit - HUBER_OFFSET) / HUBER_SIGMAS).max(MIN_NOISE)
}

/// Sums that come with the normal equations.
#[derive(Copy, Clone, Debug)]
pub(super) struct Sums {
    /// Samples without those that are saturated.
    pub(super) count: f64,
    /// Mean squared residual, weighted by the squared dependence on the pose.
    pub(super) pose_variance: f64,
    /// The part of the cost other than the pixels' residuals.
    pub(super) prior_cost: f64,
}

type Equations = NormalEquations<UNKNOWNS_WITH_EXTRAS, Sums>;

fn cost_of_pixels(equations: &Equations) -> f64 {
    equations.cost - equations.extra.prior_cost
}

/// The normal equations with the rows of the extras; those that are not fitted get a prior that keeps them.
fn with_extras(
    (matrix, right): &([[f64; UNKNOWNS]; UNKNOWNS], [f64; UNKNOWNS]),
    extras: &[[f64; UNKNOWNS_WITH_EXTRAS + 1]; 2],
    are_fitted: bool,
) -> (SMatrix<f64, UNKNOWNS_WITH_EXTRAS, UNKNOWNS_WITH_EXTRAS>, SVector<f64, UNKNOWNS_WITH_EXTRAS>)
{
    const FIXED: f64 = 1e12;
    let mut all = SMatrix::<f64, UNKNOWNS_WITH_EXTRAS, UNKNOWNS_WITH_EXTRAS>::zeros();
    let mut all_right = SVector::<f64, UNKNOWNS_WITH_EXTRAS>::zeros();
    all.fixed_view_mut::<UNKNOWNS, UNKNOWNS>(0, 0).copy_from(&SMatrix::from(*matrix));
    all_right.fixed_rows_mut::<UNKNOWNS>(0).copy_from(&SVector::from(*right));
    for (row, sums) in (UNKNOWNS..).zip(extras) {
        let Some((right, sums)) = sums.split_last() else { continue };
        all_right[row] = *right;
        for (column, sum) in sums.iter().enumerate() {
            (all[(row, column)], all[(column, row)]) = (*sum, *sum);
        }
        if !are_fitted {
            all[(row, row)] = FIXED;
        }
    }
    (all, all_right)
}

/// A model at its least cost.
#[derive(Copy, Clone)]
pub(super) struct ModelFit {
    pub(super) model: RingModel,
    pub(super) equations: Equations,
    /// Huber limit of the residuals, in grey levels.
    pub(super) huber_limit: f64,
}

impl ModelFit {
    /// Of the pixels, without the prior's.
    pub(super) fn cost(&self) -> f64 {
        cost_of_pixels(&self.equations)
    }
}

/// Where a fit starts.
#[derive(Copy, Clone)]
pub(super) enum Start<'a> {
    /// From a pose, with nothing known of blur and light.
    Pose(&'a CirclePose),
    /// From a pose, with blur and light of another fit. The result costs no more than `max_cost`, if there is
    /// one.
    Other { pose: &'a CirclePose, other: &'a ModelFit, max_cost: Option<f64> },
}

impl<'a> Start<'a> {
    pub(super) fn like(pose: &'a CirclePose, other: &'a ModelFit) -> Self {
        Self::Other { pose, other, max_cost: None }
    }

    pub(super) fn rival(pose: &'a CirclePose, other: &'a ModelFit, max_cost: f64) -> Self {
        Self::Other { pose, other, max_cost: Some(max_cost) }
    }
}

/// A fit in progress.
struct Solver<'a> {
    scene: &'a Scene<'a>,
    huber_limit: f64,
    min_steps: usize,
    /// Without another fit to start from: residuals too large are rejected early, and the limit is tightened
    /// once.
    is_first: bool,
    max_cost: Option<f64>,
}

impl Problem<UNKNOWNS_WITH_EXTRAS> for Solver<'_> {
    type Place = RingModel;
    type Extra = Sums;

    #[inline]
    fn linearised(&mut self, at: &RingModel) -> Option<Equations> {
        at.linearised(self.scene, self.huber_limit)
    }

    #[inline]
    fn moved(
        &self,
        from: &RingModel,
        step: &SVector<f64, UNKNOWNS_WITH_EXTRAS>,
    ) -> Option<RingModel> {
        from.moved(step, self.scene.extras)
    }

    fn before_step(&mut self, tried: usize, best: &RingModel, equations: &Equations) -> Next {
        let cost_of = |residual: f64| self.scene.count() * (residual * best.contrast()).powi(2);
        let early = self.scene.early_reject.get(tried).filter(|_| self.is_first);
        if early.is_some_and(|max| equations.cost > cost_of(*max)) {
            return Next::Fail;
        }
        let is_bad = self.max_cost.is_some_and(|max| equations.cost > max)
            || equations.cost > cost_of(MAX_RESIDUAL);
        if tried > self.min_steps && is_bad { Next::Stop } else { Next::Continue }
    }

    fn after_step(
        &mut self,
        tried: usize,
        has_settled: bool,
        best: &RingModel,
        equations: &mut Equations,
    ) -> Next {
        if self.is_first && self.scene.effort.rough_steps == Some(tried + 1) {
            let cost = cost_of_pixels(equations);
            self.huber_limit = self.scene.huber_limit(self.huber_limit, cost);
            let Some(next) = self.linearised(best) else { return Next::Fail };
            *equations = next;
            return Next::Continue;
        }
        if has_settled && tried >= self.min_steps { Next::Stop } else { Next::Continue }
    }
}

impl Scene<'_> {
    /// The model of least cost near the start. `None` when it is rejected early or its cost exceeds the
    /// start's bound.
    pub(super) fn fitted(&self, start: Start<'_>) -> Option<ModelFit> {
        let Effort { min_steps, max_steps, max_steps_from_other, min_gain, .. } = self.effort;
        let (model, mut solver, max_steps) = match start {
            Start::Pose(pose) => {
                let mut model = RingModel {
                    pose: *pose,
                    blur_px: FOCUSED_PX,
                    motion: [0.0; 2],
                    black: 0.0,
                    white: 255.0,
                    gradient: [0.0; 2],
                    response: match self.extras {
                        Extras::Response => CameraResponse::ORDINARY,
                        _ => CameraResponse::LINEAR,
                    },
                };
                model.expose(self)?;
                // About three times the residuals of a good fit.
                let huber_limit = 0.25 * model.contrast();
                let (is_first, max_cost) = (true, None);
                let solver = Solver { scene: self, huber_limit, min_steps, is_first, max_cost };
                (model, solver, max_steps)
            }
            Start::Other { pose, other, max_cost } => {
                let (huber_limit, is_first) = (other.huber_limit, false);
                let solver = Solver { scene: self, huber_limit, min_steps: 1, is_first, max_cost };
                (RingModel { pose: *pose, ..other.model }, solver, max_steps_from_other)
            }
        };
        let schedule = Schedule {
            max_steps,
            damping: Damping {
                first: if solver.is_first { 1e-3 } else { 1e-4 },
                min: 1e-7,
                increase: 20.0,
                min_after_bad: 0.0,
                max: 1e4,
                ridge: RIDGE,
            },
            settled_ratio: min_gain,
            settled_cost: 0.0,
            fails_without_step: false,
            fails_without_equations: false,
        };
        let best = minimise(&mut solver, model, &schedule)?;
        let (model, equations) = (best.place, best.equations);
        let fits =
            model.white > model.black && solver.max_cost.is_none_or(|max| equations.cost <= max);
        fits.then_some(ModelFit { model, equations, huber_limit: solver.huber_limit })
    }

    /// The same fit once more, with a limit, and so a prior, for the residuals that it has.
    pub(super) fn fitted_with_own_noise(&self, fit: &ModelFit) -> Option<ModelFit> {
        let huber_limit = self.huber_limit(fit.huber_limit, fit.cost());
        self.fitted(Start::like(&fit.model.pose, &ModelFit { huber_limit, ..*fit }))
    }

    /// One step from a fit close to this scene's. The cost after it is that of the quadratic model.
    pub(super) fn stepped(&self, fit: &ModelFit) -> Option<ModelFit> {
        const DAMPING: f64 = 1e-6;
        let huber_limit = fit.huber_limit;
        let mut equations = fit.model.linearised(self, huber_limit)?;
        let step = equations.step(DAMPING, RIDGE)?;
        let model = fit.model.moved(&step, self.extras)?;
        let gain = step.dot(&equations.right);
        let is_small = gain < MAX_GAIN * equations.cost;
        equations.cost -= gain;
        is_small.then_some(ModelFit { model, equations, huber_limit })
    }

    /// The mosaic of which one step from a linear fit explains most, where that is more than without one.
    pub(super) fn likely_mosaic(&self, fit: &ModelFit) -> Option<Mosaic> {
        let cost = |model: &RingModel, mosaic: Option<Mosaic>| {
            let scene = Scene { mosaic, has_prior: false, ..*self };
            let equations = model.linearised(&scene, fit.huber_limit)?;
            let step = equations.step(1e-6, RIDGE)?;
            Some(equations.cost - step.dot(&equations.right))
        };
        let sharper = fit.model.sharper();
        let costs = Mosaic::ALL.iter().filter_map(|m| Some((*m, cost(&sharper, Some(*m))?)));
        let (mosaic, min_cost) = costs.min_by(|a, b| a.1.total_cmp(&b.1))?;
        let is_likely = min_cost < MAX_PROCESSED_STEP * fit.cost()
            || min_cost < MAX_MOSAIC_STEP * cost(&fit.model, None)?;
        is_likely.then_some(mosaic)
    }

    /// The fraction of a linear fit's cost that a camera's processing would explain, by the quadratic model.
    pub(super) fn response_gain(&self, fit: &ModelFit) -> Option<f64> {
        let processed = Scene { extras: Extras::Response, has_prior: false, ..*self };
        let equations = fit.model.linearised(&processed, fit.huber_limit)?;
        let step = equations.step(1e-6, RIDGE)?;
        Some(step.dot(&equations.right) / equations.cost)
    }

    /// A limit that residuals of a good fit hardly exceed, but no more than before.
    pub(super) fn huber_limit(&self, before: f64, cost: f64) -> f64 {
        before.min(HUBER_SIGMAS * (cost / self.count()).sqrt() + HUBER_OFFSET)
    }
}
