//! Photometric refinement of a small square marker: the predicted grey value of every pixel is compared with the
//! image.

use nalgebra::{SMatrix, SVector};

use crate::optics::exposure::ClippedExposure;
use crate::optics::homography::Homography;
use crate::optics::least_squares::{
    Damping, Influence, Next, NormalEquations, Problem, Review, Schedule, huber, minimise,
};
use crate::refine::fit::{Design, Fit, PhotometricModel, PixelSample, Scratch, Target};
use crate::refine::pattern::Pattern;
use crate::refine::prediction::{Bands, PatternGrid};

/// Homography (8), blur, black, contrast, shade (2), brightness beyond the pattern.
const UNKNOWNS: usize = 14;
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

/// The homography at which the predicted marker agrees with the image best.
pub(crate) fn fit(target: Target<'_>, pattern: &Pattern, scratch: &mut Scratch) -> Option<Fit> {
    let cell_px = target.start.shortest_side_px() / pattern.cells() as f64;
    // A wide blur at first attracts cells that are half a cell off.
    let spread_px = (0.4 * cell_px).clamp(0.7, 1.2);
    fit_grid(target, &PatternGrid::from_pattern(pattern, target.lens), spread_px, scratch)
}

/// The same for a marker of another design.
pub(crate) fn fit_design(
    target: Target<'_>,
    design: &Design<'_>,
    scratch: &mut Scratch,
) -> Option<Fit> {
    fit_grid(target, &PatternGrid::from_design(design, target.lens), 0.7, scratch)
}

fn fit_grid(
    target: Target<'_>,
    grid: &PatternGrid,
    spread_px: f64,
    scratch: &mut Scratch,
) -> Option<Fit> {
    let Target { start, .. } = target;
    let light =
        PhotometricModel { black: 0.0, contrast: 1.0, shade: [0.0; 2], beyond: 0.0, spread_px };
    let loss = Loss { limit: f64::INFINITY, is_huber: true };
    let half_px = start.shortest_side_px() / 2.0;
    let mut state = State { homography: *start, light, half_px, loss };
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
        let mut problem = Photometric { grid, pixels, magnitudes, settled_px };
        let minimum = minimise(&mut problem, state, &SCHEDULE)?;
        let has_stayed = minimum.place.homography.distance_px(start) < SAME_PIXELS_PX;
        state = minimum.place;
        solved = Some(minimum.equations);
        // Where all pixels took part, only a move would bring others.
        if is_complete && has_stayed {
            break;
        }
    }
    let equations = solved?;
    let residuals = &equations.extra;
    let contrast = state.light.contrast.abs();
    let freedom = residuals.weight - UNKNOWNS as f64;
    if contrast < MIN_CONTRAST || freedom < 1.0 {
        return None;
    }
    let variance = residuals.variance() * residuals.weight / freedom;
    let inverse = equations.matrix.cholesky()?.inverse();
    Some(Fit {
        homography: state.homography,
        covariance: inverse.fixed_view::<8, 8>(0, 0) * variance,
        model: state.light,
        residual: variance.sqrt() / contrast,
    })
}

/// Everything that is fitted.
#[derive(Copy, Clone, Debug)]
struct State {
    homography: Homography,
    light: PhotometricModel,
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
    /// Pixels at which the sensor is saturated.
    saturated: usize,
}

impl Residuals {
    /// Variance of a pixel. Where the sensor saturates, little is left but edges; dark areas with their
    /// little noise do not show how well these agree.
    fn variance(&self) -> f64 {
        let mean = self.squares / self.weight;
        if self.saturated > 0 {
            mean.max(self.informative_squares / self.information)
        } else {
            mean
        }
    }
}

/// The least-squares problem of one round.
struct Photometric<'a> {
    grid: &'a PatternGrid,
    pixels: &'a mut [PixelSample],
    magnitudes: &'a mut Vec<f64>,
    settled_px: f64,
}

impl Problem<UNKNOWNS> for Photometric<'_> {
    type Place = State;
    type Extra = Residuals;

    fn linearised(&mut self, at: &State) -> Option<NormalEquations<UNKNOWNS, Residuals>> {
        at.equations(self.grid, self.pixels)
    }

    fn moved(&self, from: &State, step: &SVector<f64, UNKNOWNS>) -> Option<State> {
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
        _equations: &mut NormalEquations<UNKNOWNS, Residuals>,
    ) -> Next {
        Next::Continue
    }
}

impl State {
    /// Sets black and contrast to those that fit best with everything else as it is.
    fn expose(&mut self, grid: &PatternGrid, pixels: &[PixelSample]) -> Option<()> {
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

    fn equations(
        &self,
        grid: &PatternGrid,
        pixels: &mut [PixelSample],
    ) -> Option<NormalEquations<UNKNOWNS, Residuals>> {
        // The upper half.
        let mut matrix = [[0.0; UNKNOWNS]; UNKNOWNS];
        let mut right = [0.0; UNKNOWNS];
        let mut total_cost = 0.0;
        let mut residuals = Residuals::default();
        let mut work = [Bands::NONE; 2];
        let map = grid.map(&self.homography, self.light.spread_px);
        let light = &self.light;
        let unit = 1.0 / self.half_px;
        for pixel in pixels {
            let point = grid.point(&map, pixel.ideal)?;
            let prediction = grid.predict(&point, light.spread_px, &mut work);
            let (x, y) = (pixel.ideal[0] * unit, pixel.ideal[1] * unit);
            let shade = 1.0 + light.shade[0] * x + light.shade[1] * y;
            let flat =
                light.black + light.contrast * prediction.white + light.beyond * prediction.beyond;
            let grey = flat * shade;
            // A saturated pixel agrees with every prediction beyond it.
            if pixel.grey >= 255.0 && grey > 254.5 || pixel.grey <= 0.0 && grey < 0.5 {
                pixel.residual = f64::NAN;
                residuals.saturated += 1;
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
            let mut gradient = [0.0; UNKNOWNS];
            gradient[..8].copy_from_slice(&place.parameter_gradient(slope));
            gradient[8] = shade * light.contrast * prediction.by_spread;
            gradient[9] = shade;
            gradient[10] = shade * prediction.white;
            gradient[11] = flat * x;
            gradient[12] = flat * y;
            gradient[13] = shade * prediction.beyond;
            for (i, row) in matrix.iter_mut().enumerate() {
                let scaled = weight * gradient[i];
                right[i] += scaled * residual;
                for (entry, other) in row[i..].iter_mut().zip(&gradient[i..]) {
                    *entry += scaled * other;
                }
            }
        }
        matrix[13][13] += BEYOND_PRIOR;
        right[13] -= BEYOND_PRIOR * light.beyond;
        (total_cost.is_finite() && residuals.weight > UNKNOWNS as f64).then(|| NormalEquations {
            matrix: SMatrix::from_fn(|i, j| matrix[i.min(j)][i.max(j)]),
            right: SVector::from(right),
            cost: total_cost,
            extra: residuals,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn with_saturation_pixels_count_by_their_information() {
        let residuals = |saturated: usize| Residuals {
            // Ten of a hundred pixels carry information and differ by three grey levels, the others by one.
            squares: 90.0 + 10.0 * 9.0,
            weight: 100.0,
            informative_squares: 10.0 * 50.0 * 9.0,
            information: 10.0 * 50.0,
            saturated,
        };
        assert!((residuals(0).variance() - 1.8).abs() < 1e-12);
        assert!((residuals(40).variance() - 9.0).abs() < 1e-12);
    }
}
