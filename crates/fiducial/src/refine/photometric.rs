//! Refines a small square marker photometrically: the predicted grey value of every pixel is compared with the
//! image.

use nalgebra::{SMatrix, SVector};

use crate::optics::camera_response::{CameraResponse, SHARPENING_PX};
use crate::optics::exposure::ClippedExposure;
use crate::optics::homography::{CORNERS, Homography};
use crate::optics::least_squares::{
    Damping, Influence, Next, NormalEquations, Problem, Review, Schedule, huber, minimise,
};
use crate::refine::fit::{
    Design, Fit, PhotometricModel, PixelSample, Pulls, Scratch, Target, no_pulls, part,
    widen_by_parts,
};
use crate::refine::pattern::Pattern;
use crate::refine::prediction::{Bands, PatternCells, PatternGrid};
use crate::refine::side_errors::{FormError, ROUNDING_VARIANCE, SideErrors, add_size_error};
use crate::response::{Measured, ResponseEstimate};

/// Homography (8), blur, black, contrast, shade (2), brightness beyond the pattern.
const UNKNOWNS: usize = 14;
/// The same with the camera's tone curve and sharpening.
const UNKNOWNS_PROCESSED: usize = 16;
/// From when on a camera's processing is fitted.
#[derive(Copy, Clone, Debug)]
struct MinResponse {
    /// One step towards it lowers the cost by this fraction; it is accepted when the fit does.
    gain: f64,
    /// Smaller values are errors of the model, also of the prior.
    response: f64,
}

const MIN_RESPONSE: MinResponse = MinResponse { gain: 0.15, response: 0.2 };
/// The same where an outline was fitted alone, of which a weak tone curve changes the size as well; sharpening moves no edge.
const MIN_RESPONSE_OF_OUTLINE: MinResponse = MinResponse { gain: 0.05, response: 0.1 };
/// One of this many pixels is used.
const RESPONSE_STRIDE: usize = 4;
/// Prior information on the brightness beyond the pattern, in units of one pixel's: it is that of white, give
/// or take the contrast.
const BEYOND_PRIOR: f64 = 1e-4;
/// Largest number of pixels in the first round and in the second.
const MAX_PIXELS: [usize; 2] = [300, 800];
/// A round ends with a move of the corners below this, in pixels.
const SETTLED_PX: [f64; 2] = [0.15, 0.015];
/// A marker that moves less than this in the first round, in pixels, keeps its pixels.
const SAME_PIXELS_PX: f64 = 0.4;
/// Limits of the blur, in pixels.
const MIN_SPREAD_PX: f64 = 0.25;
const MAX_SPREAD_PX: f64 = 4.0;
/// Largest standard deviation of a corner where the sensor saturates in black and in white, in pixels.
const MAX_BILEVEL_CORNER_PX: f64 = 0.3;
/// Smallest contrast, in grey levels.
const MIN_CONTRAST: f64 = 4.0;

const SCHEDULE: Schedule = Schedule {
    max_steps: 12,
    damping: Damping {
        first: 1e-4,
        min: 1e-7,
        increase: 30.0,
        min_after_bad: 1e-2,
        max: 1e4,
        ridge: 1e-9,
    },
    settled_ratio: 0.0,
    settled_cost: 0.0,
    fails_without_step: false,
    fails_without_equations: true,
};

/// For the last step, with a finer grid.
const FINER_SCHEDULE: Schedule = Schedule { max_steps: 1, ..SCHEDULE };

/// The homography at which the predicted marker agrees with the image best.
pub(crate) fn fit(target: Target<'_>, pattern: &Pattern, scratch: &mut Scratch) -> Option<Fit> {
    let cell_px = target.start.shortest_side_px() / pattern.cells() as f64;
    // A wide blur at first attracts cells that are half a cell off.
    let spread_px = (0.4 * cell_px).clamp(0.7, 1.2);
    let cells = PatternCells::new(pattern);
    let grid = PatternGrid::from_pattern(&cells, target.lens);
    fit_grid(target, &grid, None, Start { spread_px, form_error: FormError::SQUARE }, scratch)
}

/// The same for a marker of another design.
pub(crate) fn fit_design(
    target: Target<'_>,
    design: &Design<'_>,
    scratch: &mut Scratch,
) -> Option<Fit> {
    let grid = PatternGrid::from_design(design.plain, target.lens);
    let finer = PatternGrid::from_design(design.processed, target.lens).with_wide(&grid);
    let start = Start { spread_px: 0.7, form_error: FormError::STAG };
    fit_grid(target, &grid, design.is_finer().then_some(&finer), start, scratch)
}

/// The fit of a design with a camera's processing, near a fit along its outline alone, of which a tone curve changes the
/// size; `None` where the image is linear in light.
pub(crate) fn fit_processed_design(
    target: Target<'_>,
    design: &Design<'_>,
    near: &Fit,
    scratch: &mut Scratch,
) -> Option<Fit> {
    let grid = PatternGrid::from_design(design.processed, target.lens);
    let homography = near.homography;
    let light = PhotometricModel { beyond: 0.0, shade: [0.0; 2], ..near.model };
    let half_px = homography.shortest_side_px() / 2.0;
    let loss = Loss { limit: f64::INFINITY, is_huber: true };
    let (response, known) = (CameraResponse::LINEAR, None);
    let mut state = State { homography, light, response, known, half_px, loss };
    let pixels = &mut scratch.pixels;
    grid.gather(target, &homography, light.spread_px, MAX_PIXELS[1], pixels)?;
    state.expose(&grid, pixels)?;
    let (state, equations) =
        processed(&state, &grid, target.response, MIN_RESPONSE_OF_OUTLINE, scratch)?;
    let is_curved = state.response.curve > MIN_RESPONSE_OF_OUTLINE.response;
    let pixels = &mut scratch.pixels;
    is_curved.then(|| state.processed_result(&equations, &grid, FormError::STAG, pixels))?
}

/// The start of a fit.
#[derive(Copy, Clone, Debug)]
struct Start {
    spread_px: f64,
    form_error: FormError,
}

/// The fit without a camera's processing, or, where there is one, with it, and its last step with a `finer` grid if it
/// needs one.
fn fit_grid(
    target: Target<'_>,
    grid: &PatternGrid<'_>,
    finer: Option<&PatternGrid<'_>>,
    Start { spread_px, form_error }: Start,
    scratch: &mut Scratch,
) -> Option<Fit> {
    let Target { start, response: known_response, .. } = target;
    let light =
        PhotometricModel { black: 0.0, contrast: 1.0, shade: [0.0; 2], beyond: 0.0, spread_px };
    let loss = Loss { limit: f64::INFINITY, is_huber: true };
    let half_px = start.shortest_side_px() / 2.0;
    let (response, known) = (CameraResponse::LINEAR, None);
    let mut state = State { homography: *start, light, response, known, half_px, loss };
    let mut solved: Option<NormalEquations<UNKNOWNS, Residuals>> = None;
    for (max_pixels, settled_px) in MAX_PIXELS.into_iter().zip(SETTLED_PX) {
        let is_complete = grid.gather(
            target,
            &state.homography,
            state.light.spread_px,
            max_pixels,
            &mut scratch.pixels,
        )?;
        if solved.is_none() {
            state.expose(grid, &scratch.pixels)?;
            state.loss = Loss { limit: 0.25 * state.light.contrast.abs(), is_huber: true };
        }
        let settled_px = if is_complete { SETTLED_PX[1] } else { settled_px };
        let Scratch { pixels, magnitudes, .. } = &mut *scratch;
        let mut problem = Photometric::<UNKNOWNS> { grid, pixels, magnitudes, settled_px };
        let minimum = minimise(&mut problem, state, &SCHEDULE)?;
        let has_stayed = minimum.place.homography.distance_px(start) < SAME_PIXELS_PX;
        state = minimum.place;
        solved = Some(minimum.equations);
        // Where all pixels took part, only a move would bring others.
        if is_complete && has_stayed {
            break;
        }
    }
    let Some((state, equations)) = processed(&state, grid, known_response, MIN_RESPONSE, scratch)
    else {
        return state.plain_result(&solved?, grid, form_error);
    };
    let Some(finer) = finer else {
        return state.processed_result(&equations, grid, form_error, &mut scratch.pixels);
    };
    let Scratch { pixels, magnitudes, .. } = &mut *scratch;
    let settled_px = SETTLED_PX[1];
    let mut problem = Photometric { grid: finer, pixels, magnitudes, settled_px };
    match minimise(&mut problem, state, &FINER_SCHEDULE) {
        Some(last) => {
            let pixels = &mut scratch.pixels;
            last.place.processed_result(&last.equations, finer, form_error, pixels)
        }
        None => state.processed_result(&equations, grid, form_error, &mut scratch.pixels),
    }
}

/// The fit with a camera's processing, from one without; `None` where that explains the pixels as well, and of a camera
/// that is `known` to have none.
fn processed(
    plain: &State,
    grid: &PatternGrid<'_>,
    known: Option<ResponseEstimate>,
    min: MinResponse,
    scratch: &mut Scratch,
) -> Option<(State, NormalEquations<UNKNOWNS_PROCESSED, Residuals>)> {
    // Outliers of the narrow loss may be effects of the processing.
    let wide = Loss { limit: 0.25 * plain.light.contrast.abs(), is_huber: true };
    let start = State { loss: wide, ..*plain };
    let Scratch { pixels, magnitudes, .. } = &mut *scratch;
    let settled_px = SETTLED_PX[1];
    if let Some(known) = known {
        let response = CameraResponse::known(&known);
        if response.curve.abs().max(response.sharpening) < min.response {
            return None;
        }
        let start = State { response, known: Some(known), ..start };
        let mut problem =
            Photometric::<UNKNOWNS_PROCESSED> { grid, pixels, magnitudes, settled_px };
        let minimum = minimise(&mut problem, start, &SCHEDULE)?;
        return Some((minimum.place, minimum.equations));
    }
    let first = start.equations::<UNKNOWNS_PROCESSED>(grid, pixels, RESPONSE_STRIDE)?;
    let gain = first.step(1e-6, 1e-9)?.dot(&first.right);
    // The gain of a step without the processing.
    let of_plain = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::from_fn(|i, j| first.matrix[(i, j)]);
    let right = SVector::<f64, UNKNOWNS>::from_fn(|i, _| first.right[i]);
    let plain_gain = right.dot(&of_plain.cholesky()?.solve(&right));
    if gain - plain_gain < min.gain * (first.cost - plain_gain) {
        return None;
    }
    let mut problem = Photometric::<UNKNOWNS_PROCESSED> { grid, pixels, magnitudes, settled_px };
    let minimum = minimise(&mut problem, start, &SCHEDULE)?;
    let found = State { loss: wide, ..minimum.place };
    let [before, after] = [start, found].map(|state| {
        state.equations::<UNKNOWNS_PROCESSED>(grid, pixels, RESPONSE_STRIDE).map(|e| e.cost)
    });
    let CameraResponse { curve, sharpening } = found.response;
    let is_processed =
        curve.abs().max(sharpening) > min.response && after? < (1.0 - min.gain) * before?;
    is_processed.then_some((minimum.place, minimum.equations))
}

/// Everything that is fitted.
#[derive(Copy, Clone, Debug)]
struct State {
    homography: Homography,
    light: PhotometricModel,
    response: CameraResponse,
    /// The prior of the response.
    known: Option<ResponseEstimate>,
    /// Half the marker, the unit of `shade`.
    half_px: f64,
    loss: Loss,
}

/// The robust loss of the residuals.
#[derive(Copy, Clone, Debug)]
struct Loss {
    /// Residuals beyond this, in grey levels, get less weight.
    limit: f64,
    /// Huber's loss while the marker moves; then a redescending one, since the rest is not the marker.
    is_huber: bool,
}

impl Loss {
    /// Standard deviation of a pixel for which the limit is made.
    fn deviation(&self) -> f64 {
        self.limit / 3.0
    }

    #[inline]
    fn influence(&self, residual: f64) -> Influence {
        let size = residual.abs();
        if self.is_huber || size <= self.limit {
            return huber(residual, self.limit);
        }
        let ratio = self.limit / size;
        let cost = self.limit * self.limit * (1.0 - 2.0 * ratio.ln());
        Influence { weight: ratio * ratio, cost }
    }

    /// The loss for the noise of these pixels, by the median of their residuals.
    fn from_residuals(pixels: &[PixelSample], magnitudes: &mut Vec<f64>) -> Self {
        magnitudes.clear();
        magnitudes.extend(pixels.iter().map(|p| p.residual.abs()).filter(|r| r.is_finite()));
        let middle = magnitudes.len() / 2;
        let median = match magnitudes.get(middle) {
            Some(_) => *magnitudes.select_nth_unstable_by(middle, f64::total_cmp).1,
            None => 0.0,
        };
        Self { limit: 3.0 * 1.4826 * median + 0.7, is_huber: false }
    }
}

/// Sums over the pixels' residuals.
#[derive(Copy, Clone, Debug, Default)]
struct Residuals {
    /// Weighted sum of squares, and sum of the weights.
    squares: f64,
    weight: f64,
    /// The same, weighted with each pixel's information on the marker's place as well.
    informative_squares: f64,
    information: f64,
    /// Pixels at which the sensor is saturated, and those of them that are black.
    saturated: usize,
    saturated_black: usize,
}

impl Residuals {
    /// Variance of a pixel. Where the sensor saturates, little is left but edges.
    fn variance(&self) -> f64 {
        if self.saturated > 0 { self.place_variance() } else { self.squares / self.weight }
    }

    /// Variance of a pixel that determines the marker's place. The flat areas within wide cells differ by little and say
    /// nothing about edges, at which the model of a camera's processing is off by more.
    fn place_variance(&self) -> f64 {
        (self.squares / self.weight).max(self.informative_squares / self.information)
    }

    /// Counts a saturated pixel.
    fn saturate(&mut self, is_black: bool) {
        self.saturated += 1;
        self.saturated_black += usize::from(is_black);
    }

    /// Whether most pixels are saturated, some black and some white, as in a drawing without light and blur: the few others, on the
    /// edges, may not determine the square's position, its light and its blur together.
    fn is_bilevel(&self) -> bool {
        let is_both = self.saturated_black > 0 && self.saturated > self.saturated_black;
        is_both && self.saturated as f64 > self.weight
    }
}

/// The least-squares problem of one round.
struct Photometric<'a, const N: usize> {
    grid: &'a PatternGrid<'a>,
    pixels: &'a mut [PixelSample],
    magnitudes: &'a mut Vec<f64>,
    settled_px: f64,
}

impl<const N: usize> Problem<N> for Photometric<'_, N> {
    type Place = State;
    type Extra = Residuals;

    fn linearised(&mut self, at: &State) -> Option<NormalEquations<N, Residuals>> {
        at.equations(self.grid, self.pixels, 1)
    }

    fn moved(&self, from: &State, step: &SVector<f64, N>) -> Option<State> {
        let light = &from.light;
        let spread_px = light.spread_px + step[8].clamp(-0.3, 0.3);
        Some(State {
            homography: from.homography.stepped(|i| step[i])?,
            light: PhotometricModel {
                black: light.black + step[9],
                contrast: light.contrast + step[10],
                shade: [light.shade[0] + step[11], light.shade[1] + step[12]]
                    .map(|s| s.clamp(-0.9, 0.9)),
                beyond: light.beyond + step[13],
                spread_px: spread_px.clamp(MIN_SPREAD_PX, MAX_SPREAD_PX),
            },
            response: match N {
                UNKNOWNS_PROCESSED => from.response.moved([step[14], step[15]]),
                _ => from.response,
            },
            ..*from
        })
    }

    /// The loss gets narrower in stages, as the marker gets to its place.
    fn review(&mut self, best: &State, candidate: &mut State) -> Review {
        let moved_px = best.homography.distance_px(&candidate.homography);
        let narrower = Loss::from_residuals(self.pixels, self.magnitudes);
        if moved_px < 0.3 && best.loss.limit > 1.3 * narrower.limit {
            candidate.loss = narrower;
            Review::Take
        } else if moved_px < self.settled_px {
            Review::Finish
        } else {
            Review::Compare
        }
    }

    fn after_step(
        &mut self,
        _tried: usize,
        _has_settled: bool,
        _best: &State,
        _equations: &mut NormalEquations<N, Residuals>,
    ) -> Next {
        Next::Continue
    }
}

impl State {
    /// Sets black and contrast to those that fit best with everything else as it is.
    fn expose(&mut self, grid: &PatternGrid<'_>, pixels: &[PixelSample]) -> Option<()> {
        let map = grid.map(&self.homography, self.light.spread_px);
        let mut work = [Bands::NONE; 2];
        let mut exposure = ClippedExposure::new(255.0);
        for pixel in pixels {
            let point = grid.point(&map, pixel.ideal)?;
            let white = grid.predict(&point, self.light.spread_px, &mut work).white;
            exposure.add(white, pixel.grey);
        }
        let [black, contrast] = exposure.black_and_contrast();
        (self.light.black, self.light.contrast) = (black, contrast);
        (contrast.is_finite() && contrast.abs() > MIN_CONTRAST).then_some(())
    }

    /// The fit without a camera's processing.
    fn plain_result(
        &self,
        equations: &NormalEquations<UNKNOWNS, Residuals>,
        grid: &PatternGrid<'_>,
        form_error: FormError,
    ) -> Option<Fit> {
        let mut fit = self.result(equations)?;
        fit.covariance *= SideErrors::OF_PIXELS.factor(&self.homography, &grid.undistortion());
        self.add_form_error(form_error, &mut fit);
        Some(fit)
    }

    /// The fit at these equations' minimum.
    fn result<const N: usize>(&self, equations: &NormalEquations<N, Residuals>) -> Option<Fit> {
        let residuals = &equations.extra;
        let contrast = self.light.contrast.abs();
        let freedom = residuals.weight - N as f64;
        if contrast < MIN_CONTRAST || freedom < 1.0 {
            return None;
        }
        let [variance, place_variance] = [residuals.variance(), residuals.place_variance()]
            .map(|variance| (variance * residuals.weight / freedom).max(ROUNDING_VARIANCE));
        let inverse = inverse(&equations.matrix)?;
        let covariance = SMatrix::<f64, 8, 8>::from_fn(|i, j| inverse[(i, j)]) * place_variance;
        // A result that is no better than that of the outline alone is left to the outline.
        let max_px2 = MAX_BILEVEL_CORNER_PX * MAX_BILEVEL_CORNER_PX;
        if residuals.is_bilevel() && self.worst_corner_px2(&covariance) > max_px2 {
            return None;
        }
        let estimate = |index: usize, value: f64, known: Option<Measured>| {
            let variance = inverse.get((index, index))? * variance;
            Measured { value, deviation: variance.sqrt() }.without(known)
        };
        let CameraResponse { curve, sharpening } = self.response;
        let response = (N == UNKNOWNS_PROCESSED).then(|| {
            Some(ResponseEstimate {
                curve: estimate(UNKNOWNS, curve, self.known.map(|known| known.curve))?,
                sharpening: estimate(UNKNOWNS + 1, sharpening, self.known.map(|k| k.sharpening))?,
            })
        });
        Some(Fit {
            homography: self.homography,
            covariance,
            model: self.light,
            residual: variance.sqrt() / contrast,
            is_shift_known: true,
            shift_px: 0.0,
            response: response.flatten(),
        })
    }

    /// The largest variance of a corner in both directions together, in square pixels of the ideal image.
    fn worst_corner_px2(&self, covariance: &SMatrix<f64, 8, 8>) -> f64 {
        let variance = |place: [f64; 2]| {
            let by_parameters = self.homography.project(place).parameter_jacobian();
            (by_parameters * covariance * by_parameters.transpose()).trace()
        };
        CORNERS.map(variance).into_iter().fold(0.0, f64::max)
    }

    /// The same with a camera's processing, of which the model is not quite the camera's.
    fn processed_result(
        &self,
        equations: &NormalEquations<UNKNOWNS_PROCESSED, Residuals>,
        grid: &PatternGrid<'_>,
        form_error: FormError,
        pixels: &mut [PixelSample],
    ) -> Option<Fit> {
        let mut fit = self.result(equations)?;
        fit.covariance *=
            SideErrors::OF_PROCESSED_PIXELS.factor(&self.homography, &grid.undistortion());
        let mut pulls = no_pulls();
        self.equations_of(grid, pixels, 1, Some(&mut pulls))?;
        let inverse = inverse(&equations.matrix)?;
        widen_by_parts(&mut fit.covariance, &inverse, &pulls);
        self.add_form_error(form_error, &mut fit);
        Some(fit)
    }

    /// Adds the uncertainty of the size that the form of edges leaves.
    fn add_form_error(&self, form_error: FormError, fit: &mut Fit) {
        let edge_px = form_error.distance_px(self.response.curve, self.light.spread_px);
        add_size_error(&mut fit.covariance, &self.homography, edge_px);
    }

    /// The normal equations over one of `stride` pixels.
    fn equations<const N: usize>(
        &self,
        grid: &PatternGrid<'_>,
        pixels: &mut [PixelSample],
        stride: usize,
    ) -> Option<NormalEquations<N, Residuals>> {
        self.equations_of(grid, pixels, stride, None)
    }

    /// The same, with the pulls of the marker's parts.
    fn equations_of<const N: usize>(
        &self,
        grid: &PatternGrid<'_>,
        pixels: &mut [PixelSample],
        stride: usize,
        mut pulls: Option<&mut Pulls<N>>,
    ) -> Option<NormalEquations<N, Residuals>> {
        // The upper half.
        let mut matrix = [[0.0; N]; N];
        let mut right = [0.0; N];
        let mut total_cost = 0.0;
        let mut residuals = Residuals::default();
        let mut work = [Bands::NONE; 2];
        let map = grid.map(&self.homography, self.light.spread_px);
        let light = &self.light;
        let wide_px = light.spread_px.hypot(SHARPENING_PX);
        let ratio = light.spread_px / wide_px;
        let wide_grid = grid.for_wide_blur();
        let wide_map = (N == UNKNOWNS_PROCESSED).then(|| wide_grid.map(&self.homography, wide_px));
        let unit = 1.0 / self.half_px;
        for pixel in pixels.iter_mut().step_by(stride) {
            let point = grid.point(&map, pixel.ideal)?;
            let mut prediction = grid.predict(&point, light.spread_px, &mut work);
            let mut by_response = [0.0; 2];
            if let Some(wide_map) = &wide_map {
                let wide_point = wide_grid.point(wide_map, pixel.ideal)?;
                let wide = wide_grid.predict(&wide_point, wide_px, &mut work);
                let shown = self.response.shown(prediction.white, wide.white, ratio);
                let both = |own: f64, wide: f64| shown.by_own * own + shown.by_blurred * wide;
                prediction.white = shown.white;
                for (own, wide) in prediction.by_place.iter_mut().zip(wide.by_place) {
                    *own = both(*own, wide);
                }
                prediction.by_spread = both(prediction.by_spread, wide.by_spread * ratio)
                    + shown.by_ratio * (1.0 - ratio * ratio) / wide_px;
                by_response = shown.by_response;
            }
            let (x, y) = (pixel.ideal[0] * unit, pixel.ideal[1] * unit);
            let shade = 1.0 + light.shade[0] * x + light.shade[1] * y;
            let flat =
                light.black + light.contrast * prediction.white + light.beyond * prediction.beyond;
            let grey = flat * shade;
            // A saturated pixel agrees with every prediction beyond it.
            if pixel.grey >= 255.0 && grey > 254.5 || pixel.grey <= 0.0 && grey < 0.5 {
                pixel.residual = f64::NAN;
                residuals.saturate(pixel.grey <= 0.0);
                continue;
            }
            let shown = grey.clamp(0.0, 255.0);
            if N == UNKNOWNS_PROCESSED && shown != grey {
                // Compression comes after saturation. Such pixels differ a little and contain no information.
                pixel.residual = f64::NAN;
                residuals.saturate(grey < 0.0);
                total_cost += self.loss.influence(pixel.grey - shown).cost;
                continue;
            }
            let residual = pixel.grey - grey;
            pixel.residual = residual;
            let Influence { weight, cost } = self.loss.influence(residual);
            total_cost += cost;
            residuals.squares += weight * residual * residual;
            residuals.weight += weight;
            let place = self.homography.project(prediction.square);
            let steepness = -shade * light.contrast;
            let slope = [steepness * prediction.by_place[0], steepness * prediction.by_place[1]];
            let information = weight * (slope[0] * slope[0] + slope[1] * slope[1]);
            residuals.informative_squares += information * residual * residual;
            residuals.information += information;
            let mut gradient = [0.0; N];
            gradient[..8].copy_from_slice(&place.parameter_gradient(slope));
            gradient[8] = shade * light.contrast * prediction.by_spread;
            gradient[9] = shade;
            gradient[10] = shade * prediction.white;
            gradient[11] = flat * x;
            gradient[12] = flat * y;
            gradient[13] = shade * prediction.beyond;
            for (entry, by) in gradient.iter_mut().skip(UNKNOWNS).zip(by_response) {
                *entry = shade * light.contrast * by;
            }
            if let Some(pull) = pulls.as_mut().and_then(|all| all.get_mut(part(prediction.square)))
            {
                *pull += SVector::from(gradient) * (weight * residual);
            }
            for (i, row) in matrix.iter_mut().enumerate() {
                let scaled = weight * gradient[i];
                right[i] += scaled * residual;
                for (entry, other) in row[i..].iter_mut().zip(&gradient[i..]) {
                    *entry += scaled * other;
                }
            }
        }
        if let Some(known) = self.known {
            let CameraResponse { curve, sharpening } = self.response;
            let held = [(curve, known.curve), (sharpening, known.sharpening)];
            for (index, (now, known)) in (UNKNOWNS..N).zip(held) {
                let weight = (self.loss.deviation() / known.deviation).powi(2);
                let off = known.value - now;
                if let Some(row) = matrix.get_mut(index) {
                    row[index] += weight;
                    right[index] += weight * off;
                    total_cost += weight * off * off;
                }
            }
        }
        matrix[13][13] += BEYOND_PRIOR;
        right[13] -= BEYOND_PRIOR * light.beyond;
        (total_cost.is_finite() && residuals.weight > N as f64).then(|| NormalEquations {
            matrix: SMatrix::from_fn(|i, j| matrix[i.min(j)][i.max(j)]),
            right: SVector::from(right),
            cost: total_cost,
            extra: residuals,
        })
    }
}

/// The inverse of a positive definite matrix.
fn inverse<const N: usize>(matrix: &SMatrix<f64, N, N>) -> Option<SMatrix<f64, N, N>> {
    Some(matrix.cholesky()?.inverse())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn residuals(saturated: usize) -> Residuals {
        Residuals {
            // Ten of a hundred pixels carry information and differ by three grey levels, the others by one.
            squares: 90.0 + 10.0 * 9.0,
            weight: 100.0,
            informative_squares: 10.0 * 50.0 * 9.0,
            information: 10.0 * 50.0,
            saturated,
            saturated_black: 0,
        }
    }

    #[test]
    fn with_saturation_pixels_count_by_their_information() {
        assert!((residuals(0).variance() - 1.8).abs() < 1e-12);
        assert!((residuals(40).variance() - 9.0).abs() < 1e-12);
    }

    #[test]
    fn a_markers_place_is_as_uncertain_as_the_pixels_at_its_edges_show() {
        assert!((residuals(0).place_variance() - 9.0).abs() < 1e-12);
        // Edges that agree better than flat areas do so by chance.
        let even = Residuals { informative_squares: 10.0 * 50.0, ..residuals(0) };
        assert!((even.place_variance() - 1.8).abs() < 1e-12);
    }

    #[test]
    fn a_picture_is_bilevel_where_most_is_saturated_in_black_and_in_white() {
        let is_bilevel = |saturated: usize, saturated_black: usize| {
            Residuals { weight: 100.0, saturated, saturated_black, ..Residuals::default() }
                .is_bilevel()
        };
        assert!(is_bilevel(300, 100) && is_bilevel(101, 1));
        assert!(!is_bilevel(300, 0) && !is_bilevel(300, 300) && !is_bilevel(99, 50));
    }
}
