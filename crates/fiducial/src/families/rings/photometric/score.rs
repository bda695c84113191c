//! Scores a photometric fit of the three-ring marker: its residual compared with a plain disc, rings of free grey values, free
//! radii and rings of equal width; and its covariance.

use nalgebra::{SMatrix, SVector};

use super::blur::{FREE_RADII, PixelResponse};
use super::model::{
    Alternative, Extras, MAX_DISC_RATIO, MAX_EVENNESS_INTERPOLATED, MAX_GREY, PhotometricFit,
    Radii, UNKNOWNS, UNKNOWNS_WITH_EXTRAS,
};
use super::scene::{PixelSample, Scene};
use super::smooth::{Smoother, are_rows};
use super::solve::{ModelFit, RingModel, Start, Sums};
use crate::optics::camera_response::CameraResponse;
use crate::optics::edge_response::PIXEL_VARIANCE;
use crate::optics::least_squares::huber;
use crate::response::{Measured, ResponseEstimate};

/// Prior standard deviation of the normal, in radians.
const PRIOR_NORMAL: f64 = 0.6;

/// The form of a camera's tone curve is not quite the model's: a marker's edge may be off by this fraction of curve times blur,
/// so that it looks larger or smaller. From `positions` of seed 7 in `raspberry-pi`, where rings were too small by 0.012 px
/// beyond their noise.
const CURVE_FORM_ERROR: f64 = 0.0026;

/// The figures that distinguish a marker from other things.
pub(super) struct Score {
    disc_ratio: f64,
    ring_balance: f64,
    r_squared: f64,
}

impl Score {
    /// Whether as much is explained as of any marker, so that it is worth while to compare it with targets.
    fn may_be_marker(&self) -> bool {
        const MIN_R_SQUARED: f64 = 0.85;
        self.r_squared > MIN_R_SQUARED && self.disc_ratio < MAX_DISC_RATIO
    }
}

impl RingModel {
    /// Compares the model with a plain disc and with rings of free grey values.
    pub(super) fn score(&self, scene: &Scene<'_>) -> Option<Score> {
        let mut disc = SMatrix::<f64, 3, 3>::zeros();
        let mut rings = SMatrix::<f64, 4, 4>::zeros();
        let (mut n, mut sum, mut squares, mut unexplained) = (0.0, 0.0, 0.0, 0.0);
        self.for_each_response(scene, |sample, response| {
            let [a, b, c, d, e, f] = response.inside;
            let white = response.white();
            let (grey, _) = self.grey(sample, response.shown);
            let seen = if sample.grey > MAX_GREY { sample.grey.max(grey) } else { sample.grey };
            if sample.inside {
                n += 1.0;
                sum += seen;
                squares += seen * seen;
                unexplained += (grey - seen).powi(2);
            }
            // Without the fitted gradient of the light and the camera's response.
            let flat = seen - grey + self.black + (self.white - self.black) * white;
            let of_disc = SVector::<f64, 3>::new(1.0, a, flat);
            disc.syger(1.0, &of_disc, &of_disc, 1.0);
            let of_rings = SVector::<f64, 4>::new(1.0, a - b, c - d + e - f, flat);
            rings.syger(1.0, &of_rings, &of_rings, 1.0);
        })?;
        disc.fill_upper_triangle_with_lower_triangle();
        rings.fill_upper_triangle_with_lower_triangle();
        let of_disc = disc.fixed_view::<2, 2>(0, 0).into_owned();
        let to_disc = disc.fixed_view::<2, 1>(0, 2).into_owned();
        let left_by_disc = disc[(2, 2)] - to_disc.dot(&(of_disc.try_inverse()? * to_disc));
        let of_rings = rings.fixed_view::<3, 3>(0, 0).into_owned();
        let to_rings = rings.fixed_view::<3, 1>(0, 3).into_owned();
        let levels = of_rings.try_inverse()? * to_rings;
        let left_by_rings = rings[(3, 3)] - to_rings.dot(&levels);
        let variance = squares - sum * sum / n;
        let r_squared = (variance > 0.0).then(|| 1.0 - unexplained / variance)?;
        Some(Score {
            disc_ratio: left_by_rings.max(0.0) / left_by_disc.max(1e-9),
            ring_balance: levels[2] / levels[1],
            r_squared,
        })
    }
}

/// Circles of the marker.
const CIRCLES: usize = 6;
/// The unknowns of a fit in which radii are free as well.
const UNKNOWNS_WITH_RADII: usize = UNKNOWNS_WITH_EXTRAS + FREE_RADII;
/// The columns of both: the radii separately, and all of them together towards evenly wide rings.
const COLUMNS: usize = UNKNOWNS_WITH_RADII + 1;
const COLUMNS_AND_RESIDUAL: usize = COLUMNS + 1;
/// The unknowns of a fit in which the rings may become evenly wide.
const UNKNOWNS_WITH_EVENNESS: usize = UNKNOWNS_WITH_EXTRAS + 1;
/// Where a fit explains less than this, errors of compression predominate, which are largest in the finest detail. Smoothed
/// residuals determine radii of a few pixels better there (by a fifth, in frames of a USB camera), and worse where nothing was
/// compressed.
const MAX_R_SQUARED_COMPRESSED: f64 = 0.985;
/// They are consulted where evenness has a larger standard deviation than this: markers of 10 to 13 px.
const MIN_OPEN_DEVIATION: f64 = 0.1;
/// Radii of the circles between the outermost and the dot of a target of evenly wide rings, in units of the outermost.
const EVEN_RADII: [f64; FREE_RADII] = [0.75, 0.5, 0.25];
/// Targets as people like to draw them, of two and of three evenly wide rings: the radii of their circles in units of the
/// outermost. The first has no dot.
const TARGETS: [[f64; CIRCLES]; 2] = {
    let [outer, middle, inner] = EVEN_RADII;
    [
        [1.0, outer, middle, inner, NO_DOT, NO_DOT],
        [1.0, 5.0 / 6.0, 4.0 / 6.0, 3.0 / 6.0, 2.0 / 6.0, 1.0 / 6.0],
    ]
};
/// Two circles of one radius leave nothing between them.
const NO_DOT: f64 = 1e-3;
/// Targets are fitted where the radii lie above this between the marker's (0) and evenly wide ones (1): targets that are taken for
/// markers have 0.28 and more at two deviations, 98 % of markers at the positions of the thesis less than 0.17.
const MIN_TARGET_EVENNESS: f64 = 0.2;

/// The residuals that determine the radii.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) enum Residuals {
    OfPixels,
    Smoothed,
}

impl RingModel {
    /// One step of a fit in which the radii of the circles between the outermost and the dot are free, and one of a fit in
    /// which all three change together to those of evenly wide rings, and the dot disappears.
    pub(super) fn radii(
        &self,
        scene: &Scene<'_>,
        huber_limit: f64,
        residuals: Residuals,
    ) -> Option<Radii> {
        let mut matrix = SMatrix::<f64, COLUMNS, COLUMNS>::zeros();
        let mut right = SVector::<f64, COLUMNS>::zeros();
        let (mut count, mut squares) = (0.0, 0.0);
        let mut add = |seen: &SVector<f64, COLUMNS_AND_RESIDUAL>| {
            let (gradient, residual) = (seen.fixed_rows::<COLUMNS>(0), seen[COLUMNS]);
            squares += residual * residual;
            matrix.syger(1.0, &gradient, &gradient, 1.0);
            right += gradient * residual;
        };
        let are_smoothed = residuals == Residuals::Smoothed;
        let mut smoother = are_smoothed.then(Smoother::new);
        let [(outer, _), between @ .., _dot, _middle] = scene.radii;
        let to_even: [f64; FREE_RADII] =
            std::array::from_fn(|index| match (between.get(index), EVEN_RADII.get(index)) {
                (Some((radius, _)), Some(even)) => (even * outer / radius).ln(),
                _ => 0.0,
            });
        let towards_even = |by_radii: &[f64; FREE_RADII], inside: &[f64; 6]| {
            let by: f64 = by_radii.iter().zip(to_even).map(|(by, to)| by * to).sum();
            by + inside[4] - inside[5]
        };
        self.for_each_place(scene, |sample, radius, wide| {
            let mut shown = radius.response(scene);
            let mut by_radii = radius.by_log_radii(scene);
            let mut by_evenness = towards_even(&by_radii, &shown.inside);
            if let Some(wide) = wide {
                let own = shown.white();
                let blurred = wide.radius.response(scene);
                let seen = self.response.shown(own, blurred.white(), wide.ratio);
                let by_wide = wide.radius.by_log_radii(scene);
                let wide_by_evenness = towards_even(&by_wide, &blurred.inside);
                by_evenness = seen.by_own * by_evenness + seen.by_blurred * wide_by_evenness;
                for (own, wide) in by_radii.iter_mut().zip(by_wide) {
                    *own = seen.by_own * *own + seen.by_blurred * wide;
                }
                shown = wide.processed(&shown, &blurred, &self.response);
            }
            let (grey, contrast) = self.grey(sample, shown.shown);
            if sample.grey > MAX_GREY && grey > MAX_GREY {
                return;
            }
            let residual = sample.grey - grey;
            let weight = huber(residual, huber_limit).weight;
            count += 1.0;
            let mut seen = SVector::<f64, COLUMNS_AND_RESIDUAL>::zeros();
            let parts = by_unknowns(scene, sample, &shown, contrast)
                .into_iter()
                .chain(by_radii.map(|by| by * contrast))
                .chain([by_evenness * contrast, residual]);
            for (slot, part) in seen.iter_mut().zip(parts) {
                *slot = part * weight.sqrt();
            }
            match &mut smoother {
                Some(smoother) => smoother.add(sample.offset, &seen, &mut add),
                None => add(&seen),
            }
        })?;
        if let Some(smoother) = &mut smoother {
            smoother.end(&mut add);
        }
        for prior in self.priors(scene, huber_limit) {
            let mut gradient = SVector::<f64, COLUMNS>::zeros();
            gradient.fixed_rows_mut::<UNKNOWNS_WITH_EXTRAS>(0).copy_from(&prior.gradient);
            matrix.syger(prior.weight, &gradient, &gradient, 1.0);
            right -= gradient * (prior.weight * prior.residual);
        }
        for i in 0..COLUMNS {
            matrix[(i, i)] += 1e-9;
        }
        matrix.fill_upper_triangle_with_lower_triangle();
        let information = matrix.remove_fixed_rows::<1>(UNKNOWNS_WITH_RADII);
        let information = information.remove_fixed_columns::<1>(UNKNOWNS_WITH_RADII);
        let with_radii = Step::solve(
            information,
            right.remove_fixed_rows::<1>(UNKNOWNS_WITH_RADII),
            count,
            squares,
        )?;
        let (mut off, mut deviation) = (0.0_f64, 0.0_f64);
        for (index, (radius, _)) in (UNKNOWNS_WITH_EXTRAS..).zip(between) {
            off = off.max(radius / outer * with_radii.step[index].abs());
            deviation = deviation.max(radius / outer * with_radii.variance[index].sqrt());
        }
        let information = matrix.remove_fixed_rows::<FREE_RADII>(UNKNOWNS_WITH_EXTRAS);
        let information = information.remove_fixed_columns::<FREE_RADII>(UNKNOWNS_WITH_EXTRAS);
        let with_evenness: Step<UNKNOWNS_WITH_EVENNESS> = Step::solve(
            information,
            right.remove_fixed_rows::<FREE_RADII>(UNKNOWNS_WITH_EXTRAS),
            count,
            squares,
        )?;
        Some(Radii {
            off,
            deviation,
            evenness: with_evenness.step[UNKNOWNS_WITH_EXTRAS],
            evenness_deviation: with_evenness.variance[UNKNOWNS_WITH_EXTRAS].sqrt(),
            are_smoothed,
        })
    }
}

/// The derivatives of a pixel's grey value by all that is fitted.
fn by_unknowns(
    scene: &Scene<'_>,
    sample: &PixelSample,
    shown: &PixelResponse,
    contrast: f64,
) -> [f64; UNKNOWNS_WITH_EXTRAS] {
    let [x, y] = sample.offset;
    let white = shown.shown;
    let [a, b, c, d, e] = shown.distance_by_pose.map(|by| by * contrast * shown.by_distance);
    let [f, g] = match scene.extras {
        Extras::Nothing => [0.0; 2],
        Extras::Motion => shown.by_motion.map(|by| by * contrast),
        Extras::Response => shown.by_response.map(|by| by * contrast),
    };
    let by_blur = contrast * shown.by_blur;
    [a, b, c, d, e, by_blur, 1.0 - white, white, white * x, white * y, f, g]
}

impl RingModel {
    /// How strongly the pixels about each circle pull at all that is fitted; together they balance the prior.
    fn pulls(
        &self,
        scene: &Scene<'_>,
        huber_limit: f64,
    ) -> Option<[SVector<f64, UNKNOWNS_WITH_EXTRAS>; CIRCLES]> {
        let mut pulls = [SVector::zeros(); CIRCLES];
        self.for_each_place(scene, |sample, radius, wide| {
            let shown = self.response_at(scene, radius, wide);
            let (grey, contrast) = self.grey(sample, shown.shown);
            if sample.grey > MAX_GREY && grey > MAX_GREY {
                return;
            }
            let residual = sample.grey - grey;
            let weight = huber(residual, huber_limit).weight;
            let off = |(circle, _): &(f64, f64)| (circle - radius.at.rho).abs();
            let beside = pulls.iter_mut().zip(&scene.radii);
            if let Some((pull, _)) = beside.min_by(|a, b| off(a.1).total_cmp(&off(b.1))) {
                let gradient = by_unknowns(scene, sample, &shown, contrast);
                *pull += SVector::from(gradient) * (weight * residual);
            }
        })?;
        Some(pulls)
    }
}

/// A step of linear least squares, and the variances of the unknowns after it.
struct Step<const N: usize> {
    step: SVector<f64, N>,
    variance: SVector<f64, N>,
}

impl<const N: usize> Step<N> {
    /// The step of `count` residuals whose weighted squares sum up to `squares`; `None` when an unknown stays open.
    fn solve(
        information: SMatrix<f64, N, N>,
        right: SVector<f64, N>,
        count: f64,
        squares: f64,
    ) -> Option<Self> {
        let inverse = information.cholesky()?.inverse();
        let step = inverse * right;
        let free = (count - N as f64).max(1.0);
        let variance = (squares - step.dot(&right)).max(0.0) / free + 1.0 / 12.0;
        let variance = inverse.diagonal() * variance;
        let is_finite = step.iter().chain(&variance).all(|value| value.is_finite());
        is_finite.then_some(Self { step, variance })
    }
}

impl ModelFit {
    /// Root mean square residual, in units of the contrast.
    pub(super) fn residual(&self, scene: &Scene<'_>) -> f64 {
        (self.cost() / scene.count()).sqrt() / self.model.contrast()
    }

    pub(super) fn alternative(&self, scene: &Scene<'_>) -> Alternative {
        Alternative {
            pose: self.model.pose,
            residual: self.residual(scene),
            blur_px: self.model.blur_px,
        }
    }
}

impl Scene<'_> {
    /// A fit with its score and covariance.
    pub(super) fn rated(&self, fit: &ModelFit) -> Option<PhotometricFit> {
        self.with_score(fit, &fit.model.score(self)?)
    }

    /// A fit with its covariance and a score that may come from fewer samples.
    pub(super) fn with_score(&self, fit: &ModelFit, score: &Score) -> Option<PhotometricFit> {
        let all = self.covariance(fit)?;
        let is_estimated = self.extras == Extras::Response && self.has_prior;
        let estimated_response = is_estimated.then(|| {
            let CameraResponse { curve, sharpening } = fit.model.response;
            let estimate = |index: usize, value: f64, prior: Measured| {
                Measured { value, deviation: all[(index, index)].sqrt() }.without(Some(prior))
            };
            Some(ResponseEstimate {
                curve: estimate(UNKNOWNS, curve, CameraResponse::CURVE_PRIOR)?,
                sharpening: estimate(UNKNOWNS + 1, sharpening, CameraResponse::SHARPENING_PRIOR)?,
            })
        });
        let radii = self.radii_count.then(|| self.best_radii(fit, score.r_squared)).flatten();
        let may_be_target = self.compares_targets
            && self.extras != Extras::Response
            && score.may_be_marker()
            && radii.is_none_or(|radii| !radii.is_below_evenness(MIN_TARGET_EVENNESS));
        Some(PhotometricFit {
            pose: fit.model.pose,
            covariance: all.fixed_view::<5, 5>(0, 0).into_owned(),
            residual: fit.residual(self),
            r_squared: score.r_squared,
            disc_ratio: score.disc_ratio,
            ring_balance: score.ring_balance,
            contrast: fit.model.contrast(),
            black: fit.model.black,
            blur_px: fit.model.blur_px,
            response: fit.model.response,
            estimated_response: estimated_response.flatten(),
            mosaic: self.mosaic,
            radii,
            target_cost: may_be_target.then(|| self.target_cost(fit)).flatten(),
        })
    }

    /// The radii that would fit best to the pixels of a fit that explains this fraction of them.
    fn best_radii(&self, fit: &ModelFit, r_squared: f64) -> Option<Radii> {
        let by = |residuals: Residuals| fit.model.radii(self, fit.huber_limit, residuals);
        let radii = by(Residuals::OfPixels)?;
        let is_compressed = self.mosaic.is_some() && r_squared < MAX_R_SQUARED_COMPRESSED;
        let is_open = is_compressed
            && radii.evenness_deviation > MIN_OPEN_DEVIATION
            && !radii.is_below_evenness(MAX_EVENNESS_INTERPOLATED);
        let smoothed = (is_open && self.stride == 1 && are_rows(self.samples))
            .then(|| by(Residuals::Smoothed));
        smoothed.flatten().or(Some(radii))
    }

    /// The least cost of a target of evenly wide rings fitted to the same pixels, over that of this fit.
    fn target_cost(&self, fit: &ModelFit) -> Option<f64> {
        let [(outer, _), ..] = self.radii;
        let own = Start::like(&fit.model.pose, fit);
        let costs = TARGETS.iter().flat_map(|radii| {
            let radii = radii.map(|radius| (radius * outer, (radius * outer).ln()));
            let scene = Scene { radii, early_reject: [f64::MAX; 3], ..*self };
            // Blur and light of this fit may be far from the target's, so that one from its pose alone is a start as well.
            let afresh = scene.fitted(Start::Pose(&fit.model.pose)).and_then(|target| {
                let same_limit = ModelFit { huber_limit: fit.huber_limit, ..target };
                scene.fitted(Start::like(&target.model.pose, &same_limit))
            });
            [scene.fitted(own), afresh].into_iter().flatten().map(|target| target.cost())
        });
        costs.min_by(f64::total_cmp).map(|min_cost| min_cost / fit.cost())
    }

    /// Covariance of all that was fitted, from the remaining residuals: noise and errors of the model.
    fn covariance(
        &self,
        fit: &ModelFit,
    ) -> Option<SMatrix<f64, UNKNOWNS_WITH_EXTRAS, UNKNOWNS_WITH_EXTRAS>> {
        let Sums { count, pose_variance, .. } = fit.equations.extra;
        let unknowns = match self.extras {
            Extras::Nothing => UNKNOWNS,
            Extras::Motion | Extras::Response => UNKNOWNS_WITH_EXTRAS,
        };
        // Where the pixels that depend on the pose are noisier than the others, their noise counts.
        let mean = (fit.cost() / count).max(pose_variance);
        let variance = mean * count / (count - unknowns as f64).max(1.0) + 1.0 / 12.0;
        let mut information = fit.equations.matrix / variance;
        for i in 0..UNKNOWNS_WITH_EXTRAS {
            information[(i, i)] += 1e-9;
        }
        for i in 3..5 {
            information[(i, i)] += 1.0 / (PRIOR_NORMAL * PRIOR_NORMAL);
        }
        let mut all = information.cholesky()?.inverse();
        if self.extras == Extras::Response {
            // The model of a camera's processing is not quite the camera's: all edges of a circle are off together, and those of
            // different circles differently. Then the circles are independent, not the pixels (a cluster-robust
            // covariance).
            const FEW: f64 = CIRCLES as f64 / (CIRCLES - 1) as f64;
            let pulls = fit.model.pulls(self, fit.huber_limit)?;
            let spread = pulls.iter().map(|pull| (all * pull / variance).map(|by| by * by));
            let spread = spread.sum::<SVector<f64, UNKNOWNS_WITH_EXTRAS>>() * FEW;
            let wider =
                spread.zip_map(&all.diagonal(), |clustered, own| (clustered / own).max(1.0).sqrt());
            for (row, by_row) in wider.iter().enumerate() {
                for (column, by_column) in wider.iter().enumerate() {
                    all[(row, column)] *= by_row * by_column;
                }
            }
            // The error of the curve's form looks like another range.
            let pose = &fit.model.pose;
            let outline = pose.projected(self.radii[0].0, self.camera)?;
            let spread_px = (fit.model.blur_px.powi(2) + PIXEL_VARIANCE).sqrt();
            let edge_px = CURVE_FORM_ERROR * fit.model.response.curve.abs() * spread_px;
            let by_size = pose.centre * (2.0 * edge_px / outline.major);
            let mut of_centre = all.fixed_view_mut::<3, 3>(0, 0);
            of_centre += by_size * by_size.transpose();
        }
        Some(all)
    }
}
