//! Photometric refinement of a small square marker: the grey value of every pixel is predicted and compared.
//!
//! The edges of all cells are predicted together, since through the blur of lens and pixels a cell of two pixels never
//! shows its own black or white. In the square's coordinates the blur is a Gaussian whose axes are oblique because of
//! the perspective. A cell's share of it is the product of two differences of edge responses, with the terms of Mehler's
//! series for what the obliqueness adds where edges cross.

use geometry::Pixel;
use imaging::GrayView;
use nalgebra::{SMatrix, SVector};

use crate::optics::edge_response::{EdgeResponse, MAX_SIGMAS, pixel_kurtosis};
use crate::optics::exposure::ClippedExposure;
use crate::optics::homography::{CORNERS, Homography, Inverse};
use crate::optics::least_squares::{
    Damping, Influence, Next, NormalEquations, Problem, Review, Schedule, huber, minimise,
};
use crate::optics::undistort::Undistortion;
use crate::refine::fit::{Design, Fit, MAX_ACROSS, PhotometricModel, PixelSample, Scratch, Target};
use crate::refine::pattern::Pattern;

/// Homography (8), blur, black, contrast, shade (2), brightness beyond the pattern.
const UNKNOWNS: usize = 14;
/// Prior information on the brightness beyond the pattern, in units of one pixel's: it is that of white, give or take
/// the contrast.
const BEYOND_PRIOR: f64 = 1e-4;
/// Largest number of pixels in the first round and in the second.
const MAX_PIXELS: [usize; 2] = [300, 800];
/// A round ends with a move of the corners below this, in pixels.
const SETTLED_PX: [f64; 2] = [0.15, 0.015];
/// A marker that moves less than this in the first round, in pixels, keeps its pixels.
const SAME_PIXELS_PX: f64 = 0.4;
/// Largest number of columns or rows of cells within the blur's reach.
const MAX_BANDS: usize = 28;
/// Limits of the blur, in pixels.
const MIN_SPREAD_PX: f64 = 0.25;
const MAX_SPREAD_PX: f64 = 4.0;
/// Smallest contrast, in grey levels.
const MIN_CONTRAST: f64 = 4.0;
/// Largest share of a pixel's light from cells of unknown colour, and from beyond the pattern.
const MAX_UNKNOWN: f64 = 0.03;
const MAX_BEYOND: f64 = 0.1;

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
    fit_grid(target, &Grid::from_pattern(pattern, target.lens), spread_px, scratch)
}

/// The same for a marker of another design.
pub(crate) fn fit_design(
    target: Target<'_>,
    design: &Design<'_>,
    scratch: &mut Scratch,
) -> Option<Fit> {
    fit_grid(target, &Grid::from_design(design, target.lens), 0.7, scratch)
}

fn fit_grid(target: Target<'_>, grid: &Grid, spread_px: f64, scratch: &mut Scratch) -> Option<Fit> {
    let Target { start, .. } = target;
    let light =
        PhotometricModel { black: 0.0, contrast: 1.0, shade: [0.0; 2], beyond: 0.0, spread_px };
    let loss = Loss { limit: f64::INFINITY, is_huber: true };
    let half_px = start.shortest_side_px() / 2.0;
    let mut state = State { homography: *start, light, half_px, loss };
    let mut solved: Option<NormalEquations<UNKNOWNS, Residuals>> = None;
    for (max_pixels, settled_px) in MAX_PIXELS.into_iter().zip(SETTLED_PX) {
        let is_complete = grid.gather(target, &state, max_pixels, &mut scratch.pixels)?;
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

/// The cells of a marker, for look-up.
struct Grid {
    across: usize,
    /// Cells from the middle to the square's side, and to the pattern's end.
    half: f64,
    middle: f64,
    white: [[f64; MAX_ACROSS]; MAX_ACROSS],
    unknown: [[f64; MAX_ACROSS]; MAX_ACROSS],
    has_unknown: bool,
    /// Derivatives of the ideal image by the pixels.
    undistortion: [[f64; 2]; 2],
    response: EdgeResponse,
}

/// The shares of a blurred point's light that come from each column (or row) of cells, with the factors of their first
/// and second derivatives, in units of the blur.
#[derive(Copy, Clone, Debug)]
struct Bands {
    first: usize,
    count: usize,
    share: [[f64; 3]; MAX_BANDS],
}

impl Bands {
    const NONE: Self = Self { first: 0, count: 0, share: [[0.0; 3]; MAX_BANDS] };
}

/// The predicted share of white at a point, and its derivatives.
#[derive(Copy, Clone, Debug, Default)]
struct Prediction {
    /// The square's coordinates.
    square: [f64; 2],
    white: f64,
    /// By the ideal image point, per pixel.
    by_place: [f64; 2],
    by_spread: f64,
    /// The share of light from beyond the pattern.
    beyond: f64,
}

/// A point of the image in the pattern, with the blur there.
struct BlurredPoint {
    square: [f64; 2],
    /// In cells from the pattern's left and top end.
    cells: [f64; 2],
    /// Derivatives of `cells` by the ideal image point.
    jacobian: [[f64; 2]; 2],
    blur: Blur,
}

/// The blur in the pattern's coordinates.
#[derive(Copy, Clone, Debug)]
struct Blur {
    /// Standard deviations across columns and rows, in cells, and their inverses.
    sigma: [f64; 2],
    scale: [f64; 2],
    pixel_kurtosis: [f64; 2],
    correlation: f64,
}

/// From the ideal image to the pattern.
struct PatternMap {
    inverse: Inverse,
    spread_px: f64,
    /// The blur all over the pattern, where its perspective is weak.
    blur: Option<Blur>,
}

impl Grid {
    fn from_pattern(pattern: &Pattern, lens: &Undistortion<'_>) -> Self {
        let across = pattern.across();
        let mut white = [[0.0; MAX_ACROSS]; MAX_ACROSS];
        let mut unknown = [[0.0; MAX_ACROSS]; MAX_ACROSS];
        for y in 0..across {
            for x in 0..across {
                match pattern.is_white(x, y) {
                    Some(is_white) => white[y][x] = f64::from(u8::from(is_white)),
                    None => unknown[y][x] = 1.0,
                }
            }
        }
        Self::new(lens, [pattern.cells(), across], white, unknown)
    }

    fn from_design(design: &Design<'_>, lens: &Undistortion<'_>) -> Self {
        let across = (design.cells + 2 * design.margin).min(MAX_ACROSS);
        let known = [[0.0; MAX_ACROSS]; MAX_ACROSS];
        Self::new(lens, [design.cells, across], *design.white, known)
    }

    fn new(
        lens: &Undistortion<'_>,
        [cells, across]: [usize; 2],
        white: [[f64; MAX_ACROSS]; MAX_ACROSS],
        unknown: [[f64; MAX_ACROSS]; MAX_ACROSS],
    ) -> Self {
        let slope = lens.jacobian();
        Self {
            across,
            half: cells as f64 / 2.0,
            middle: across as f64 / 2.0,
            white,
            unknown,
            has_unknown: unknown.iter().flatten().any(|u| *u > 0.0),
            undistortion: [[slope[(0, 0)], slope[(0, 1)]], [slope[(1, 0)], slope[(1, 1)]]],
            response: EdgeResponse::new(),
        }
    }

    /// Collects the pixels near the marker's known edges, and some others; true when none was left out for their number.
    fn gather(
        &self,
        target: Target<'_>,
        state: &State,
        max_pixels: usize,
        pixels: &mut Vec<PixelSample>,
    ) -> Option<bool> {
        let Target { view, lens, .. } = target;
        pixels.clear();
        let [left, top, right, bottom] = self.bounds(view, lens, state)?;
        let map = self.map(&state.homography, state.light.spread_px);
        let origin = state.homography.origin;
        let area = ((right - left) * (bottom - top)) as f64;
        // Of large markers every n-th pixel is taken, in an order without a pattern of its own.
        let every = (0.5 * area / max_pixels as f64).max(1.0) as usize;
        // Of very large ones most pixels are not even mapped.
        let skipped = (every / 8).max(1);
        let thinned = every / skipped;
        let mut turn = 0;
        let mut work = [Bands::NONE; 2];
        for y in top..bottom {
            let row = view.row(y);
            let columns = row.iter().enumerate().take(right).skip(left + y * 5 % skipped);
            for (x, grey) in columns.step_by(skipped) {
                let ideal = lens.undistort(Pixel::new(x as f64, y as f64))?;
                let ideal = [ideal[0] - origin[0], ideal[1] - origin[1]];
                let Some(point) = self.point(&map, ideal) else { continue };
                turn += 1;
                let interval = if self.is_near_edge(&point) { thinned } else { 4 * thinned };
                if thinned > 1 && turn % interval != 0
                    || self.beyond(&point) > MAX_BEYOND
                    || self.unknown_at(&point, &mut work) > MAX_UNKNOWN
                {
                    continue;
                }
                pixels.push(PixelSample { ideal, grey: f64::from(*grey), residual: 0.0 });
            }
        }
        (pixels.len() > 2 * UNKNOWNS).then_some(every == 1)
    }

    /// Whether the nearest line between columns, or between rows, has black on one side and white on the other.
    fn is_near_edge(&self, point: &BlurredPoint) -> bool {
        const REACH: f64 = 1.8;
        let last = self.across - 1;
        let place = |axis: usize| {
            let at = point.cells[axis].max(0.0);
            let nearest = (at + 0.5) as usize;
            let is_near = (at - nearest as f64).abs() < REACH * point.blur.sigma[axis];
            ((at as usize).min(last), nearest, is_near && nearest > 0 && nearest <= last)
        };
        let ((column, x, upright), (row, y, level)) = (place(0), place(1));
        upright && self.white[row][x - 1] != self.white[row][x]
            || level && self.white[y - 1][column] != self.white[y][column]
    }

    /// First column and row around the pattern within the image, and those after the last.
    fn bounds(
        &self,
        view: GrayView<'_>,
        lens: &Undistortion<'_>,
        state: &State,
    ) -> Option<[usize; 4]> {
        let mut bounds = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
        let reach = self.middle / self.half;
        for [a, b] in CORNERS {
            let projected = state.homography.project([a * reach, b * reach]);
            let (pixel, _) = lens.distort(projected.image)?;
            bounds = [
                bounds[0].min(pixel.x),
                bounds[1].min(pixel.y),
                bounds[2].max(pixel.x),
                bounds[3].max(pixel.y),
            ];
        }
        let limit = |value: f64, end: usize| value.clamp(0.0, end as f64) as usize;
        let (width, height) = (view.width(), view.height());
        Some([
            limit(bounds[0].floor(), width),
            limit(bounds[1].floor(), height),
            limit(bounds[2].ceil() + 1.0, width),
            limit(bounds[3].ceil() + 1.0, height),
        ])
    }

    /// From this change of scale across half a marker on, the blur in cells differs from place to place.
    const MIN_PERSPECTIVE: f64 = 0.04;

    fn map(&self, homography: &Homography, spread_px: f64) -> PatternMap {
        let mut map = PatternMap { inverse: homography.inverse(), spread_px, blur: None };
        let perspective = homography.h[6].abs() + homography.h[7].abs();
        if perspective < Self::MIN_PERSPECTIVE {
            map.blur = self.point(&map, [homography.h[2], homography.h[5]]).map(|s| s.blur);
        }
        map
    }

    /// The point of the pattern at an ideal image point relative to the origin; `None` outside of the pattern.
    #[inline]
    fn point(&self, map: &PatternMap, [x, y]: [f64; 2]) -> Option<BlurredPoint> {
        let (square, inverse_scale) = map.inverse.plane_and_scale([x, y]);
        let [a, b] = square;
        let (column, row) = (a * self.half + self.middle, b * self.half + self.middle);
        let end = self.across as f64 + 0.5;
        if !(column > -0.5 && column < end && row > -0.5 && row < end) {
            return None;
        }
        let jacobian = map.inverse.jacobian(square, inverse_scale * self.half);
        let blur = match map.blur {
            Some(blur) => blur,
            None => self.blur(&jacobian, map.spread_px),
        };
        Some(BlurredPoint { square, cells: [column, row], jacobian, blur })
    }

    fn blur(&self, slopes: &[[f64; 2]; 2], spread_px: f64) -> Blur {
        let bent = slopes.map(|slope| {
            [0, 1].map(|axis| {
                slope[0] * self.undistortion[0][axis] + slope[1] * self.undistortion[1][axis]
            })
        });
        let lengths = bent.map(|[x, y]| (x * x + y * y).sqrt());
        let normals = [0, 1].map(|axis| bent[axis].map(|b| b / lengths[axis]));
        let sigma = lengths.map(|length| length * spread_px);
        let [p, q] = normals;
        Blur {
            sigma,
            scale: sigma.map(|s| 1.0 / s),
            pixel_kurtosis: normals.map(|normal| pixel_kurtosis(normal, spread_px * spread_px)),
            correlation: p[0] * q[0] + p[1] * q[1],
        }
    }

    #[inline]
    fn bands(&self, at: f64, blur: &Blur, axis: usize, bands: &mut Bands) {
        let last = self.across as f64;
        let reach = (MAX_SIGMAS * blur.sigma[axis]).min(0.5 * MAX_BANDS as f64 - 1.0);
        // The lines between columns from `first` until before `beyond`: casts round down.
        let first = (at - reach).clamp(0.0, last - 1.0) as usize + 1;
        let beyond = ((at + reach).clamp(0.0, last - 1.0) as usize + 1).max(first);
        (bands.first, bands.count) = (first - 1, beyond - first + 1);
        // Of each line between two columns: the light from before it, and that number's derivatives.
        let mut before = [0.0; 3];
        let (scale, pixel_kurtosis) = (blur.scale[axis], blur.pixel_kurtosis[axis]);
        let mut z = (first as f64 - at) * scale;
        let Some((end, shares)) =
            bands.share.get_mut(..bands.count).and_then(<[_]>::split_last_mut)
        else {
            return;
        };
        for share in shares {
            let (height, slope) = self.response.at(z, pixel_kurtosis);
            let here = [height, -slope, -z * slope];
            *share = [here[0] - before[0], here[1] - before[1], here[2] - before[2]];
            before = here;
            z += scale;
        }
        *end = [1.0 - before[0], -before[1], -before[2]];
    }

    #[inline]
    fn both_bands<'a>(&self, point: &BlurredPoint, work: &'a mut [Bands; 2]) -> &'a [Bands; 2] {
        for (axis, bands) in work.iter_mut().enumerate() {
            self.bands(point.cells[axis], &point.blur, axis, bands);
        }
        work
    }

    /// The share of a point's light that comes from cells of unknown colour.
    fn unknown_at(&self, point: &BlurredPoint, work: &mut [Bands; 2]) -> f64 {
        if !self.has_unknown {
            return 0.0;
        }
        let mut sum = 0.0;
        let [columns, rows] = self.both_bands(point, work);
        for (row, [share, ..]) in
            self.unknown.iter().skip(rows.first).zip(&rows.share).take(rows.count)
        {
            let cells = row.iter().skip(columns.first).zip(&columns.share).take(columns.count);
            sum += share * cells.map(|(unknown, [share, ..])| unknown * share).sum::<f64>();
        }
        sum
    }

    /// The share of a point's light that comes from beyond the pattern.
    #[inline]
    fn beyond(&self, point: &BlurredPoint) -> f64 {
        let size = self.across as f64;
        let within = |axis: usize| {
            let (at, scale) = (point.cells[axis], point.blur.scale[axis]);
            if at.min(size - at) * scale > MAX_SIGMAS {
                return 1.0;
            }
            let before = self.response.at(-at * scale, point.blur.pixel_kurtosis[axis]).0;
            self.response.at((size - at) * scale, point.blur.pixel_kurtosis[axis]).0 - before
        };
        1.0 - within(0) * within(1)
    }

    #[inline]
    fn predict(&self, point: &BlurredPoint, spread_px: f64, work: &mut [Bands; 2]) -> Prediction {
        let [columns, rows] = self.both_bands(point, work);
        // Sums over the cells with the derivatives by column and by row.
        let (mut w, mut wx, mut wy, mut wxy, mut wxx, mut wyy, mut wxxyy) =
            (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        for (row, [share, slope, curve]) in
            self.white.iter().skip(rows.first).zip(&rows.share).take(rows.count)
        {
            let (mut r, mut rx, mut rxx) = (0.0, 0.0, 0.0);
            for (white, [share, slope, curve]) in
                row.iter().skip(columns.first).zip(&columns.share).take(columns.count)
            {
                r += white * share;
                rx += white * slope;
                rxx += white * curve;
            }
            w += share * r;
            wx += share * rx;
            wxx += share * rxx;
            wy += slope * r;
            wxy += slope * rx;
            wyy += curve * r;
            wxxyy += curve * rxx;
        }
        let c = point.blur.correlation;
        let [by_u, by_v] = [wx * point.blur.scale[0], wy * point.blur.scale[1]];
        Prediction {
            square: point.square,
            white: w + c * (wxy + 0.5 * c * wxxyy),
            by_place: [
                by_u * point.jacobian[0][0] + by_v * point.jacobian[1][0],
                by_u * point.jacobian[0][1] + by_v * point.jacobian[1][1],
            ],
            by_spread: (wxx + wyy + 2.0 * c * wxy) / spread_px,
            beyond: self.beyond(point),
        }
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
    /// Variance of a pixel. Where the sensor saturates, little is left but edges; dark areas with their little noise do
    /// not show how well these agree.
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
    grid: &'a Grid,
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
    fn expose(&mut self, grid: &Grid, pixels: &[PixelSample]) -> Option<()> {
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
        grid: &Grid,
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
