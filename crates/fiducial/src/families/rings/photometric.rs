//! Fits a small three-ring marker to its grey values: pose, blur, black and white, and where it helps motion blur, tone
//! curve, sharpening or a colour mosaic.
//!
//! Where rings are a few pixels wide, the blur of one edge reaches the next, and edges located one by one
//! come out too far apart. Here pose, blur and exposure are fitted together, to minimise the difference
//! between the image predicted by the model and the image observed. `model` has the unknowns, `scene` selects the pixels,
//! `blur` is the model of one pixel, `solve` fits the model, `score` rates the result.

mod blur;
mod model;
mod scene;
mod score;
mod smooth;
mod solve;

use crate::families::rings::circle_pose::CirclePose;
use crate::optics::mosaic::Mosaic;

use model::{Effort, Extras, MAX_GREY, MAX_RESIDUAL};
pub(crate) use model::{
    MAX_EVENNESS_INTERPOLATED, PhotometricFit, PhotometricInput, PhotometricPoses, Radii,
};
pub(crate) use scene::PixelSample;
use scene::{ALL_PIXELS_PX, FOCUSED_PX, MAX_RADII_PX, MAX_TARGETS_PX, SampleSource, Scene};
use solve::{ModelFit, Start};

pub(crate) use scene::MAX_DIAMETER_PX;

/// With this many samples or more, every third is enough for the first steps and for the choice between
/// poses.
const MANY_SAMPLES: usize = 200;
const SPARSE_STRIDE: usize = 3;
/// Largest residual before each of the first steps: about a third above the largest of 800 markers in a
/// thousand images. Nine of ten small candidates other than markers, and half of the larger ones, end here.
const EARLY_REJECT_RESIDUAL_SMALL: [f64; 3] = [0.27, 0.22, 0.17];
const EARLY_REJECT_RESIDUAL: [f64; 3] = [0.45, 0.4, 0.35];
/// Above this residual, in units of the contrast, motion blur and a camera's processing are tried, ...
const MIN_EXTRAS_RESIDUAL: f64 = 0.03;
/// ... and accepted when they lower the cost to this fraction or less.
const MAX_EXTRAS_COST: f64 = 0.5;
/// Between this residual and that, a camera's processing is tried when one step lowers the cost by this fraction, and accepted
/// when the fit does.
const MIN_RESPONSE_RESIDUAL: f64 = 0.008;
const MIN_RESPONSE_GAIN: f64 = 0.2;
/// Above this residual a colour mosaic is tried, and accepted when it lowers the cost to this fraction.
const MIN_MOSAIC_RESIDUAL: f64 = 0.015;
const MAX_MOSAIC_COST: f64 = 0.8;
/// A fit to a small marker without a camera's processing that leaves more than this may be at another minimum: behind a steep
/// tone curve a marker is nearly white, and the fit ends with grey ink.
const MAX_PLAIN_RESIDUAL: f64 = 0.1;
/// It is tried when one step with it costs less than this fraction of one without it, or, where a tone curve hides that, than
/// this fraction of the cost before.
const MAX_MOSAIC_STEP: f64 = 0.85;
const MAX_PROCESSED_STEP: f64 = 0.25;
/// Start tilt in radians. Seen face on, every tilt looks the same to first order: a saddle of the cost.
const MIN_START_TILT: f64 = 0.2;
/// The mirrored pose is dropped above this ratio of costs.
const MAX_ALTERNATIVE_COST: f64 = 4.0;
/// Poses whose normals differ by less, in radians, are the same.
const DISTINCT_TILT: f64 = 0.02;
/// Above this ratio of costs on the sparse samples the better pose is certain.
const CLOSE_COST: f64 = 1.15;

impl PhotometricInput<'_> {
    /// Fits the marker from a start that is nearly right. `samples` is working memory.
    pub(crate) fn fit(
        &self,
        start: &CirclePose,
        samples: &mut Vec<PixelSample>,
    ) -> Option<PhotometricPoses> {
        let Self { camera, size_m, white_on_black, .. } = *self;
        // Turned grey values have another tone curve.
        let has_prior = !white_on_black;
        samples.clear();
        let source = SampleSource(*self);
        let outline = start.projected(size_m / 2.0, camera)?;
        let diameter_px = outline.major;
        let is_small = diameter_px < ALL_PIXELS_PX;
        let early_reject =
            if is_small { EARLY_REJECT_RESIDUAL_SMALL } else { EARLY_REJECT_RESIDUAL };
        source.gather(start, FOCUSED_PX, samples)?;
        let tilted = |pose: &CirclePose| pose.with_min_tilt(MIN_START_TILT);
        let stride = sparse_stride(samples);
        let mut sparse =
            Scene { stride, has_prior, ..Scene::new(samples, size_m, camera, early_reject) };
        let plain = sparse.fitted(Start::Pose(&tilted(start)));
        let is_far_off = |fit: &ModelFit| fit.residual(&sparse) > MAX_PLAIN_RESIDUAL;
        let mut first = match plain {
            Some(fit) if !is_small || !is_far_off(&fit) => fit,
            plain => {
                let max_cost = plain.as_ref().map(|fit| MAX_MOSAIC_COST * fit.cost());
                let mosaics = source.mosaics(&outline).filter(|_| is_small);
                let processed = mosaics
                    .and_then(|mosaics| sparse.fitted_to_mosaic(&tilted(start), mosaics, max_cost));
                processed.or(plain)?
            }
        };
        let (extras, mosaic) = (sparse.extras, sparse.mosaic);
        let scene = |samples, stride| Scene {
            stride,
            extras,
            mosaic,
            has_prior,
            ..Scene::new(samples, size_m, camera, early_reject)
        };
        // With the blur known, pixels reached by light from beyond the paper are left out.
        let pose = first.model.pose;
        if first.residual(&sparse) < MAX_RESIDUAL
            && source.gather(&pose, first.model.blur_px, samples)?
        {
            first = scene(samples, stride).fitted(Start::Pose(&tilted(&pose)))?;
        }
        let mut all = scene(samples, 1);
        let mut sparse = scene(samples, stride);
        if mosaic.is_none() {
            let plain = first;
            first = sparse.with_extras(plain);
            first = sparse.with_mosaic(plain, first);
            (all.extras, all.mosaic) = (sparse.extras, sparse.mosaic);
            if sparse.extras == Extras::Response {
                // So far the noise was that of a fit without a camera's processing.
                first = sparse.fitted_with_own_noise(&first).unwrap_or(first);
            }
        }
        all.radii_count = diameter_px < MAX_RADII_PX;
        all.compares_targets = diameter_px < MAX_TARGETS_PX;
        let fit_all = |fit: ModelFit| match stride {
            1 => Some(fit),
            _ => all.fitted(Start::like(&fit.model.pose, &fit)),
        };
        if first.residual(&sparse) > MAX_RESIDUAL {
            return Some(all.rated(&fit_all(first)?)?.alone());
        }
        // From a start tilted to the wrong side the fit may have stopped face on.
        if first.model.pose.tilt() < MIN_START_TILT / 2.0 {
            let rotated = tilted(&first.model.pose).with_tilt_rotated();
            let max_cost = 1.1 * first.cost();
            if let Some(other) = sparse.fitted(Start::rival(&rotated, &first, max_cost))
                && other.cost() < first.cost()
            {
                first = other;
            }
        }
        let mirrored = tilted(&first.model.pose).mirrored();
        let max_cost = MAX_ALTERNATIVE_COST * first.cost();
        let second = sparse.fitted(Start::rival(&mirrored, &first, max_cost));
        let first = fit_all(first)?;
        let Some(second) = second.and_then(fit_all) else {
            return Some(all.rated(&first)?.alone());
        };
        let (best, other) =
            if second.cost() < first.cost() { (second, first) } else { (first, second) };
        let other = other.alternative(&all);
        let best = all.rated(&best)?;
        let same = best.pose.normal.angle(&other.pose.normal) < DISTINCT_TILT;
        Some(PhotometricPoses { best, alternative: (!same).then_some(other) })
    }

    /// As [`PhotometricInput::fit`] for a tracked marker near its predicted pose: most steps use the sparse
    /// samples, one uses all. `None` for a marker so small that all of its pixels are needed anyway.
    pub(crate) fn fit_tracked(
        &self,
        predicted: &CirclePose,
        samples: &mut Vec<PixelSample>,
    ) -> Option<PhotometricPoses> {
        let Self { camera, size_m, .. } = *self;
        samples.clear();
        SampleSource(*self).gather(predicted, FOCUSED_PX, samples)?;
        if samples.len() < MANY_SAMPLES {
            return None;
        }
        let all = Scene::new(samples, size_m, camera, EARLY_REJECT_RESIDUAL);
        let sparse = Scene {
            stride: sparse_stride(samples),
            effort: Effort::TRACKED,
            ..Scene::new(samples, size_m, camera, EARLY_REJECT_RESIDUAL)
        };
        let first = sparse.fitted(Start::Pose(predicted))?;
        if first.residual(&sparse) > MAX_RESIDUAL {
            return None;
        }
        let mirrored = first.model.pose.with_min_tilt(MIN_START_TILT).mirrored();
        let max_cost = MAX_ALTERNATIVE_COST * first.cost();
        let second = sparse.fitted(Start::rival(&mirrored, &first, max_cost));
        let (mut best, mut other) = match second {
            Some(second) if second.cost() < first.cost() => (second, Some(first)),
            second => (first, second),
        };
        best.huber_limit = sparse.huber_limit(best.huber_limit, best.cost());
        if let Some(other) = &mut other {
            other.huber_limit = best.huber_limit;
        }
        // Where the sparse samples leave the choice open, all samples decide.
        let is_open = other.as_ref().is_some_and(|other| other.cost() < CLOSE_COST * best.cost());
        best = all.stepped(&best)?;
        if is_open {
            let stepped = other.as_ref().and_then(|other| all.stepped(other));
            other = match stepped {
                Some(stepped) if stepped.cost() < best.cost() => {
                    Some(std::mem::replace(&mut best, stepped))
                }
                stepped => stepped,
            };
        }
        let scene = if is_open { &all } else { &sparse };
        let alternative = other
            .map(|other| other.alternative(scene))
            .filter(|other| other.pose.normal.angle(&best.model.pose.normal) >= DISTINCT_TILT);
        let score = best.model.score(&sparse)?;
        Some(PhotometricPoses { best: all.with_score(&best, &score)?, alternative })
    }
}

impl Scene<'_> {
    /// A fit with motion blur or a camera's processing where they explain much more; they are then the scene's extras.
    fn with_extras(&mut self, plain: ModelFit) -> ModelFit {
        let residual = plain.residual(self);
        let start = Start::like(&plain.model.pose, &plain);
        if (MIN_RESPONSE_RESIDUAL..MIN_EXTRAS_RESIDUAL).contains(&residual)
            && self.response_gain(&plain).is_some_and(|gain| gain > MIN_RESPONSE_GAIN)
        {
            self.extras = Extras::Response;
            match self.fitted(start) {
                Some(fit) if fit.cost() < (1.0 - MIN_RESPONSE_GAIN) * plain.cost() => return fit,
                _ => self.extras = Extras::Nothing,
            }
        }
        if !(MIN_EXTRAS_RESIDUAL..MAX_RESIDUAL).contains(&residual) {
            return plain;
        }
        let mut max_cost = MAX_EXTRAS_COST * plain.cost();
        let (mut best, mut extras) = (None, Extras::Nothing);
        for tried in [Extras::Response, Extras::Motion] {
            self.extras = tried;
            let fit = self.fitted(start);
            if let Some(fit) = fit.filter(|fit| fit.cost() < max_cost) {
                max_cost = fit.cost();
                (best, extras) = (Some(fit), tried);
            }
        }
        self.extras = extras;
        best.unwrap_or(plain)
    }

    /// The better fit to pixels interpolated from one of these mosaics, which is then the scene's; `None` where it costs more
    /// than `max_cost`, if there is one.
    fn fitted_to_mosaic(
        &mut self,
        start: &CirclePose,
        mosaics: [Mosaic; 2],
        max_cost: Option<f64>,
    ) -> Option<ModelFit> {
        let fits = mosaics.into_iter().filter_map(|mosaic| {
            let scene = Scene { mosaic: Some(mosaic), extras: Extras::Response, ..*self };
            Some((mosaic, scene.fitted(Start::Pose(start))?))
        });
        let (mosaic, fit) = fits
            .min_by(|a, b| a.1.cost().total_cmp(&b.1.cost()))
            .filter(|(_, fit)| max_cost.is_none_or(|max| fit.cost() < max))?;
        (self.mosaic, self.extras) = (Some(mosaic), Extras::Response);
        Some(fit)
    }

    /// A fit to pixels interpolated from a colour mosaic where that explains more than the best without it; the mosaic, and
    /// the processing of a camera that has one, are then the scene's.
    fn with_mosaic(&mut self, plain: ModelFit, best: ModelFit) -> ModelFit {
        if !(MIN_MOSAIC_RESIDUAL..MAX_RESIDUAL).contains(&best.residual(self)) {
            return best;
        }
        let processed = Scene { extras: Extras::Response, ..*self };
        let Some(mosaic) = processed.likely_mosaic(&plain) else { return best };
        let processed = Scene { mosaic: Some(mosaic), ..processed };
        let start = ModelFit { model: plain.model.sharper(), ..plain };
        match processed.fitted(Start::like(&plain.model.pose, &start)) {
            Some(fit) if fit.cost() < MAX_MOSAIC_COST * best.cost() => {
                (self.extras, self.mosaic) = (processed.extras, processed.mosaic);
                fit
            }
            _ => best,
        }
    }
}

impl PhotometricFit {
    fn alone(self) -> PhotometricPoses {
        PhotometricPoses { best: self, alternative: None }
    }
}

/// The stride that leaves enough samples for the first steps, not counting saturated ones.
fn sparse_stride(samples: &[PixelSample]) -> usize {
    let clear = samples.iter().filter(|sample| sample.grey <= MAX_GREY).count();
    if clear < MANY_SAMPLES { 1 } else { SPARSE_STRIDE }
}

#[cfg(test)]
mod tests {
    use geometry::{CameraModel, Pixel};
    use imaging::GrayView;
    use nalgebra::Vector3;

    use super::solve::RingModel;
    use super::*;
    use crate::families::rings::circle_pose::project;
    use crate::optics::camera_response::CameraResponse;

    /// Also where white is saturated or motion blurs the image.
    #[test]
    fn a_model_is_recovered_from_its_own_image() {
        for (white, blur_px, motion) in
            [(200.0, 0.6, [0.0; 2]), (500.0, 0.6, [0.0; 2]), (200.0, 1.1, [0.8, -0.5])]
        {
            let (found, truth) = fit_to_own_image(white, blur_px, motion);
            assert!(found.residual < 0.005 && found.r_squared > 0.999, "{white} {found:?}");
            let error = found.pose.centre - truth.centre;
            assert!(error.norm() < 2e-4 * 6.0, "{white} {found:?}");
            assert!(found.pose.normal.angle(&truth.normal) < 0.02, "{white} {found:?}");
        }
    }

    /// The fit to the image of a model with this white and blur, and the model's pose.
    fn fit_to_own_image(
        white: f64,
        blur_px: f64,
        motion: [f64; 2],
    ) -> (PhotometricFit, CirclePose) {
        let camera = CameraModel::pinhole(100, 80, 909.0);
        let size_m = 0.15341;
        let truth = CirclePose {
            centre: Vector3::new(0.03, -0.05, 6.0),
            normal: Vector3::new(0.3, 0.2, -0.9).normalize(),
        };
        let gradient = [0.5, -0.3];
        let response = CameraResponse::LINEAR;
        let model =
            RingModel { pose: truth, blur_px, motion, black: 30.0, white, gradient, response };
        let middle = project(truth.centre, &camera).unwrap();
        let data: Vec<u8> = (0..8000)
            .map(|i| {
                let (x, y) = (f64::from(i % 100), f64::from(i / 100));
                let ray = camera.unproject_clamped(Pixel::new(x, y)).coords;
                let offset = [x - middle.x, y - middle.y];
                let samples = [PixelSample { ray, offset, grey: 0.0, phase: 0, inside: true }];
                let scene = Scene::new(&samples, size_m, &camera, EARLY_REJECT_RESIDUAL);
                let mut grey = 0.0;
                model
                    .for_each_response(&scene, |sample, response| {
                        grey = model.grey(sample, response.white()).0;
                    })
                    .unwrap();
                grey.round() as u8
            })
            .collect();
        let view = GrayView::packed(&data, 100, 80).unwrap();
        let start = CirclePose {
            centre: truth.centre * 1.01,
            normal: Vector3::new(0.1, 0.1, -0.9).normalize(),
        };
        let input = PhotometricInput { view, camera: &camera, size_m, white_on_black: false };
        (input.fit(&start, &mut Vec::new()).unwrap().best, truth)
    }
}
