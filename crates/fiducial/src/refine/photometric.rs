//! The whole picture of a small square marker, compared with the image grey value by grey value.
//!
//! Every cell's edges are predicted together: through the blur of lens and pixels a cell of two pixels never shows its
//! own black or white. In the square's own coordinates the blur is a Gaussian whose axes the perspective has made
//! oblique; a cell's share of it is the product of two steps' differences, with the terms of Mehler's series for what
//! the obliqueness adds where edges cross.

use geometry::Pixel;
use imaging::GrayView;
use nalgebra::{SMatrix, SVector};

use crate::optics::edge_response::{EdgeResponse, MAX_SIGMAS, PIXEL_VARIANCE, pixel_kurtosis};
use crate::optics::exposure::ClippedExposure;
use crate::refine::corners::{Design, Fit, Homography, Lens, MOST_ACROSS, Scratch};
use crate::refine::pattern::Pattern;

/// Light and blur of a marker's picture.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Picture {
    /// Grey value of black, and how much brighter white is, in the marker's middle.
    pub(crate) black: f64,
    pub(crate) contrast: f64,
    /// Change of the light to the right and down, as a share of it, per half a marker.
    pub(crate) shade: [f64; 2],
    /// How much brighter than white it is beyond the pattern, in grey levels: as a rule, less bright.
    pub(crate) beyond: f64,
    /// Standard deviation of the blur of lens and pixel together, in pixels.
    pub(crate) spread_px: f64,
}

/// A pixel that takes part.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Spot {
    /// Its place in the ideal image, relative to the homography's.
    ideal: [f64; 2],
    grey: f64,
    /// How much brighter it is than was predicted last; not a number where the sensor cannot tell.
    difference: f64,
}

/// Homography (8), spread, black, contrast, shade (2), what is beyond.
const UNKNOWNS: usize = 14;
/// What is known of what is beyond the pattern before the image is seen, in units of a pixel's difference: it is about
/// as bright as white, give or take the contrast.
const PRIOR_OF_BEYOND: f64 = 1e-4;
/// Pixels that take part at most in the first, rough round, and in the second.
const MOST_SPOTS: [usize; 2] = [300, 800];
/// Steps of a round, and the move in pixels at which it ends.
const MOST_STEPS: usize = 12;
const SETTLED_PX: [f64; 2] = [0.15, 0.015];
/// A marker that moves less than this keeps its pixels.
const SAME_PIXELS_PX: f64 = 0.4;
/// Columns or rows of cells that the blur reaches across at most.
const MOST_BANDS: usize = 28;
/// The spread may become this, in pixels.
const SPREAD_LIMITS_PX: (f64, f64) = (0.25, 4.0);
/// Less contrast, in grey levels, is none.
const LEAST_CONTRAST: f64 = 4.0;
/// A pixel takes no part when more of its light than this comes from cells of which nothing is known.
const MOST_UNKNOWN: f64 = 0.03;
/// The same of light from beyond the pattern.
const MOST_BEYOND: f64 = 0.1;

impl Picture {
    /// Standard deviation of the lens' blur alone.
    pub(crate) fn blur_px(&self) -> f64 {
        (self.spread_px * self.spread_px - PIXEL_VARIANCE).max(0.0).sqrt()
    }
}

/// The homography at which the marker's picture agrees with the image best.
pub(crate) fn fit(
    view: GrayView<'_>,
    lens: &Lens<'_>,
    start: &Homography,
    pattern: &Pattern,
    scratch: &mut Scratch,
) -> Option<Fit> {
    let cell_px = start.shortest_side_px() / pattern.cells() as f64;
    // A wide blur at first: what is half a cell off is still drawn to its place.
    let spread_px = (0.4 * cell_px).clamp(0.7, 1.2);
    fit_grid(view, lens, start, (&Grid::new(pattern, lens), spread_px), scratch)
}

/// The same for a picture that is not made of square cells.
pub(crate) fn fit_design(
    view: GrayView<'_>,
    lens: &Lens<'_>,
    start: &Homography,
    design: &Design<'_>,
    scratch: &mut Scratch,
) -> Option<Fit> {
    fit_grid(view, lens, start, (&Grid::of(design, lens), 0.7), scratch)
}

fn fit_grid(
    view: GrayView<'_>,
    lens: &Lens<'_>,
    start: &Homography,
    (grid, spread_px): (&Grid, f64),
    scratch: &mut Scratch,
) -> Option<Fit> {
    let side_px = start.shortest_side_px();
    let light = Picture { black: 0.0, contrast: 1.0, shade: [0.0; 2], beyond: 0.0, spread_px };
    let pull = Pull { limit: f64::INFINITY, is_rough: true };
    let mut state = State { homography: *start, light, half_px: side_px / 2.0, pull };
    let mut solved: Option<System> = None;
    for (most_spots, settled_px) in MOST_SPOTS.into_iter().zip(SETTLED_PX) {
        let is_complete = grid.gather(view, lens, &state, most_spots, &mut scratch.spots)?;
        if solved.is_none() {
            state.expose(grid, &scratch.spots)?;
            state.pull = Pull { limit: 0.25 * state.light.contrast.abs(), is_rough: true };
        }
        let settled_px = if is_complete { SETTLED_PX[1] } else { settled_px };
        let (next, system) = state.solved(grid, scratch, settled_px)?;
        // Where all pixels take part at once, others would only after a move.
        let is_last = is_complete && next.homography.distance_px(start) < SAME_PIXELS_PX;
        state = next;
        solved = Some(system);
        if is_last {
            break;
        }
    }
    let system = solved?;
    let contrast = state.light.contrast.abs();
    let freedom = system.weight - UNKNOWNS as f64;
    if contrast < LEAST_CONTRAST || freedom < 1.0 {
        return None;
    }
    let variance = system.variance() * system.weight / freedom;
    let covariance = system.full().cholesky()?.inverse().fixed_view::<8, 8>(0, 0) * variance;
    Some(Fit {
        homography: state.homography,
        covariance,
        picture: state.light,
        residual: variance.sqrt() / contrast,
    })
}

/// Everything that is fitted.
#[derive(Copy, Clone, Debug)]
struct State {
    homography: Homography,
    light: Picture,
    /// Half the marker, the unit of `shade`.
    half_px: f64,
    pull: Pull,
}

/// How hard a pixel pulls that differs from its prediction.
#[derive(Copy, Clone, Debug)]
struct Pull {
    /// From this difference on, in grey levels, it pulls no harder (Huber), ...
    limit: f64,
    /// ... or, once the marker is nearly in its place, ever less (Cauchy): something else is in the picture.
    is_rough: bool,
}

impl Pull {
    /// The pixel's weight and its part of the cost.
    #[inline]
    fn of(&self, difference: f64) -> (f64, f64) {
        let size = difference.abs();
        let share = self.limit / size;
        if share >= 1.0 {
            (1.0, size * size)
        } else if self.is_rough {
            (share, self.limit * (2.0 * size - self.limit))
        } else {
            (share * share, self.limit * self.limit * (1.0 - 2.0 * share.ln()))
        }
    }

    /// What suits pixels that agree with the picture as well as these.
    fn usual(spots: &[Spot], differences: &mut Vec<f64>) -> Self {
        differences.clear();
        differences.extend(spots.iter().map(|s| s.difference.abs()).filter(|d| d.is_finite()));
        let middle = differences.len() / 2;
        let median = match differences.get(middle) {
            Some(_) => *differences.select_nth_unstable_by(middle, f64::total_cmp).1,
            None => 0.0,
        };
        Self { limit: 3.0 * 1.4826 * median + 0.7, is_rough: false }
    }
}

/// The cells, ready to be looked up.
struct Grid {
    across: usize,
    /// Cells from the middle to the square's side, and from the pattern's to its end.
    half: f64,
    middle: f64,
    white: [[f64; MOST_ACROSS]; MOST_ACROSS],
    unknown: [[f64; MOST_ACROSS]; MOST_ACROSS],
    has_unknown: bool,
    bend: [[f64; 2]; 2],
    step: EdgeResponse,
}

/// The shares that the columns (or rows) of cells have of a blurred place's light, times what they are multiplied by
/// in its first and second derivative, in units of the blur.
#[derive(Copy, Clone, Debug)]
struct Bands {
    first: usize,
    count: usize,
    share: [[f64; 3]; MOST_BANDS],
}

impl Bands {
    const NONE: Self = Self { first: 0, count: 0, share: [[0.0; 3]; MOST_BANDS] };
}

/// A place's whiteness and how it changes.
#[derive(Copy, Clone, Debug, Default)]
struct Look {
    /// The square's coordinates.
    square: [f64; 2],
    white: f64,
    /// By the place in the ideal image, per pixel.
    by_place: [f64; 2],
    by_spread: f64,
    /// The share of light from beyond the pattern.
    beyond: f64,
}

/// Where a place of the image is in the pattern, and how far the blur reaches there.
struct Spread {
    square: [f64; 2],
    /// In cells from the pattern's left and top end.
    cells: [f64; 2],
    /// Change of `cells` with the place in the ideal image.
    slopes: [[f64; 2]; 2],
    blur: Blur,
}

/// The blur in the pattern's coordinates.
#[derive(Copy, Clone, Debug)]
struct Blur {
    /// Standard deviations across columns and rows, in cells, and one over them.
    sigma: [f64; 2],
    scale: [f64; 2],
    pixel_kurtosis: [f64; 2],
    correlation: f64,
}

/// From the ideal image to the pattern.
struct Map {
    inverse: [f64; 9],
    spread_px: f64,
    /// The blur all over the pattern, where its perspective is so weak that it is the same.
    blur: Option<Blur>,
}

impl Grid {
    fn new(pattern: &Pattern, lens: &Lens<'_>) -> Self {
        let across = pattern.across();
        let mut white = [[0.0; MOST_ACROSS]; MOST_ACROSS];
        let mut unknown = [[0.0; MOST_ACROSS]; MOST_ACROSS];
        for y in 0..across {
            for x in 0..across {
                match pattern.is_white(x, y) {
                    Some(is_white) => white[y][x] = f64::from(u8::from(is_white)),
                    None => unknown[y][x] = 1.0,
                }
            }
        }
        Self::with(lens, (pattern.cells(), across), white, unknown)
    }

    fn of(design: &Design<'_>, lens: &Lens<'_>) -> Self {
        let across = (design.cells + 2 * design.margin).min(MOST_ACROSS);
        let known = [[0.0; MOST_ACROSS]; MOST_ACROSS];
        Self::with(lens, (design.cells, across), *design.white, known)
    }

    fn with(
        lens: &Lens<'_>,
        (cells, across): (usize, usize),
        white: [[f64; MOST_ACROSS]; MOST_ACROSS],
        unknown: [[f64; MOST_ACROSS]; MOST_ACROSS],
    ) -> Self {
        let bend = lens.slope();
        Self {
            across,
            half: cells as f64 / 2.0,
            middle: across as f64 / 2.0,
            white,
            unknown,
            has_unknown: unknown.iter().flatten().any(|u| *u > 0.0),
            bend: [[bend[(0, 0)], bend[(0, 1)]], [bend[(1, 0)], bend[(1, 1)]]],
            step: EdgeResponse::new(),
        }
    }

    /// The pixels near the marker's known edges, and some others; true when none were left out for their number.
    fn gather(
        &self,
        view: GrayView<'_>,
        lens: &Lens<'_>,
        state: &State,
        most: usize,
        spots: &mut Vec<Spot>,
    ) -> Option<bool> {
        spots.clear();
        let [left, top, right, bottom] = self.bounds(view, lens, state)?;
        let map = self.map(&state.homography, state.light.spread_px);
        let about = state.homography.about;
        let area = ((right - left) * (bottom - top)) as f64;
        // Of large markers every so many-th pixel, in an order without a pattern of its own.
        let every = (0.5 * area / most as f64).max(1.0) as usize;
        // Of very large ones most are not even looked at.
        let skipped = (every / 8).max(1);
        let thinned = every / skipped;
        let mut turn = 0;
        let mut work = [Bands::NONE; 2];
        for y in top..bottom {
            let row = view.row(y);
            let columns = row.iter().enumerate().take(right).skip(left + y * 5 % skipped);
            for (x, grey) in columns.step_by(skipped) {
                let ideal = lens.ideal(Pixel::new(x as f64, y as f64))?;
                let ideal = [ideal[0] - about[0], ideal[1] - about[1]];
                let Some(spread) = self.spread(&map, ideal) else { continue };
                turn += 1;
                let interval = if self.is_near_edge(&spread) { thinned } else { 4 * thinned };
                if thinned > 1 && turn % interval != 0
                    || self.beyond(&spread) > MOST_BEYOND
                    || self.unknown_at(&spread, &mut work) > MOST_UNKNOWN
                {
                    continue;
                }
                spots.push(Spot { ideal, grey: f64::from(*grey), difference: 0.0 });
            }
        }
        (spots.len() > 2 * UNKNOWNS).then_some(every == 1)
    }

    /// Whether the nearest line between columns, or between rows, has black on one side and white on the other.
    fn is_near_edge(&self, spread: &Spread) -> bool {
        const REACH: f64 = 1.8;
        let last = self.across - 1;
        let place = |axis: usize| {
            let at = spread.cells[axis].max(0.0);
            let nearest = (at + 0.5) as usize;
            let is_near = (at - nearest as f64).abs() < REACH * spread.blur.sigma[axis];
            ((at as usize).min(last), nearest, is_near && nearest > 0 && nearest <= last)
        };
        let ((column, x, upright), (row, y, level)) = (place(0), place(1));
        upright && self.white[row][x - 1] != self.white[row][x]
            || level && self.white[y - 1][column] != self.white[y][column]
    }

    /// First column and row around the pattern within the image, and those after the last.
    fn bounds(&self, view: GrayView<'_>, lens: &Lens<'_>, state: &State) -> Option<[usize; 4]> {
        let mut bounds = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
        let reach = self.middle / self.half;
        for [a, b] in crate::refine::corners::CORNERS {
            let (seen, _) = lens.seen(state.homography.at([a * reach, b * reach]).ideal)?;
            bounds = [
                bounds[0].min(seen.x),
                bounds[1].min(seen.y),
                bounds[2].max(seen.x),
                bounds[3].max(seen.y),
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

    /// Above this change of scale across half a marker, the blur in cells differs from place to place.
    const LEAST_PERSPECTIVE: f64 = 0.04;

    fn map(&self, homography: &Homography, spread_px: f64) -> Map {
        let mut map = Map { inverse: homography.inverse(), spread_px, blur: None };
        let perspective = homography.h[6].abs() + homography.h[7].abs();
        if perspective < Self::LEAST_PERSPECTIVE {
            map.blur = self.spread(&map, [homography.h[2], homography.h[5]]).map(|s| s.blur);
        }
        map
    }

    /// The place in the pattern; `None` outside of it.
    #[inline]
    fn spread(&self, map: &Map, [x, y]: [f64; 2]) -> Option<Spread> {
        let i = &map.inverse;
        let depth = 1.0 / (i[6] * x + i[7] * y + i[8]);
        let square = [(i[0] * x + i[1] * y + i[2]) * depth, (i[3] * x + i[4] * y + i[5]) * depth];
        let [a, b] = square;
        let (column, row) = (a * self.half + self.middle, b * self.half + self.middle);
        let end = self.across as f64 + 0.5;
        if !(column > -0.5 && column < end && row > -0.5 && row < end) {
            return None;
        }
        let scale = depth * self.half;
        let slopes = [
            [(i[0] - a * i[6]) * scale, (i[1] - a * i[7]) * scale],
            [(i[3] - b * i[6]) * scale, (i[4] - b * i[7]) * scale],
        ];
        let blur = match map.blur {
            Some(blur) => blur,
            None => self.blur(&slopes, map.spread_px),
        };
        Some(Spread { square, cells: [column, row], slopes, blur })
    }

    fn blur(&self, slopes: &[[f64; 2]; 2], spread_px: f64) -> Blur {
        let bent = slopes.map(|slope| {
            [0, 1].map(|axis| slope[0] * self.bend[0][axis] + slope[1] * self.bend[1][axis])
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
        let reach = (MAX_SIGMAS * blur.sigma[axis]).min(0.5 * MOST_BANDS as f64 - 1.0);
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
            let (height, slope) = self.step.at(z, pixel_kurtosis);
            let here = [height, -slope, -z * slope];
            *share = [here[0] - before[0], here[1] - before[1], here[2] - before[2]];
            before = here;
            z += scale;
        }
        *end = [1.0 - before[0], -before[1], -before[2]];
    }

    #[inline]
    fn both_bands<'a>(&self, spread: &Spread, work: &'a mut [Bands; 2]) -> &'a [Bands; 2] {
        for (axis, bands) in work.iter_mut().enumerate() {
            self.bands(spread.cells[axis], &spread.blur, axis, bands);
        }
        work
    }

    /// The share of a place's light that comes from cells of which nothing is known.
    fn unknown_at(&self, spread: &Spread, work: &mut [Bands; 2]) -> f64 {
        if !self.has_unknown {
            return 0.0;
        }
        let mut sum = 0.0;
        let [columns, rows] = self.both_bands(spread, work);
        for (row, [share, ..]) in
            self.unknown.iter().skip(rows.first).zip(&rows.share).take(rows.count)
        {
            let cells = row.iter().skip(columns.first).zip(&columns.share).take(columns.count);
            sum += share * cells.map(|(unknown, [share, ..])| unknown * share).sum::<f64>();
        }
        sum
    }

    /// The share of a place's light that comes from beyond the pattern.
    #[inline]
    fn beyond(&self, spread: &Spread) -> f64 {
        let size = self.across as f64;
        let within = |axis: usize| {
            let (at, scale) = (spread.cells[axis], spread.blur.scale[axis]);
            if at.min(size - at) * scale > MAX_SIGMAS {
                return 1.0;
            }
            let before = self.step.at(-at * scale, spread.blur.pixel_kurtosis[axis]).0;
            self.step.at((size - at) * scale, spread.blur.pixel_kurtosis[axis]).0 - before
        };
        1.0 - within(0) * within(1)
    }

    #[inline]
    fn look_at(&self, spread: &Spread, spread_px: f64, work: &mut [Bands; 2]) -> Look {
        let [columns, rows] = self.both_bands(spread, work);
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
        let c = spread.blur.correlation;
        let [by_u, by_v] = [wx * spread.blur.scale[0], wy * spread.blur.scale[1]];
        Look {
            square: spread.square,
            white: w + c * (wxy + 0.5 * c * wxxyy),
            by_place: [
                by_u * spread.slopes[0][0] + by_v * spread.slopes[1][0],
                by_u * spread.slopes[0][1] + by_v * spread.slopes[1][1],
            ],
            by_spread: (wxx + wyy + 2.0 * c * wxy) / spread_px,
            beyond: self.beyond(spread),
        }
    }
}

/// The normal equations, upper half, and the cost.
#[derive(Clone, Debug)]
struct System {
    matrix: [[f64; UNKNOWNS]; UNKNOWNS],
    right: [f64; UNKNOWNS],
    cost: f64,
    /// Weighted squares of the differences, and the sum of their weights.
    squares: f64,
    weight: f64,
    /// The same, each counting as much as it says about the marker's place.
    told: f64,
    telling: f64,
    /// Pixels of which the sensor cannot tell how bright or dark they are.
    clipped: usize,
}

impl System {
    /// Of a pixel. Where the sensor clips, little is left but edges, and dark places with little noise say nothing of how
    /// well these agree.
    fn variance(&self) -> f64 {
        let mean = self.squares / self.weight;
        if self.clipped > 0 { mean.max(self.told / self.telling) } else { mean }
    }

    fn full(&self) -> SMatrix<f64, UNKNOWNS, UNKNOWNS> {
        SMatrix::from_fn(|i, j| self.matrix[i.min(j)][i.max(j)])
    }
}

impl State {
    /// Black and contrast that fit best with everything else as it is.
    fn expose(&mut self, grid: &Grid, spots: &[Spot]) -> Option<()> {
        let map = grid.map(&self.homography, self.light.spread_px);
        let mut work = [Bands::NONE; 2];
        let mut exposure = ClippedExposure::new(255.0);
        for spot in spots {
            let spread = grid.spread(&map, spot.ideal)?;
            let white = grid.look_at(&spread, self.light.spread_px, &mut work).white;
            exposure.add(white, spot.grey);
        }
        let [black, contrast] = exposure.black_and_contrast();
        (self.light.black, self.light.contrast) = (black, contrast);
        (contrast.is_finite() && contrast.abs() > LEAST_CONTRAST).then_some(())
    }

    /// The best state near this one, and the equations of its last but one step.
    fn solved(
        &self,
        grid: &Grid,
        scratch: &mut Scratch,
        settled_px: f64,
    ) -> Option<(Self, System)> {
        let Scratch { spots, shifts, .. } = scratch;
        let mut best = *self;
        let mut system = best.system(grid, spots)?;
        let mut damping = 1e-4;
        for _ in 0..MOST_STEPS {
            let Some(mut next) = best.stepped(&system, damping) else {
                damping = (damping * 30.0).max(1e-2);
                continue;
            };
            let moved_px = best.homography.distance_px(&next.homography);
            // The light's compromise with what is not the marker is undone in stages.
            let usual = Pull::usual(spots, shifts);
            let tightens = moved_px < 0.3 && best.pull.limit > 1.3 * usual.limit;
            if moved_px < settled_px && !tightens {
                return Some((next, system));
            }
            if tightens {
                next.pull = usual;
            }
            let next_system = next.system(grid, spots)?;
            if tightens || next_system.cost <= system.cost {
                (best, system) = (next, next_system);
                damping = (damping * 0.1).max(1e-7);
            } else {
                damping = (damping * 30.0).max(1e-2);
                if damping > 1e4 {
                    break;
                }
            }
        }
        Some((best, system))
    }

    fn system(&self, grid: &Grid, spots: &mut [Spot]) -> Option<System> {
        let mut system = System {
            matrix: [[0.0; UNKNOWNS]; UNKNOWNS],
            right: [0.0; UNKNOWNS],
            cost: 0.0,
            squares: 0.0,
            weight: 0.0,
            told: 0.0,
            telling: 0.0,
            clipped: 0,
        };
        let mut work = [Bands::NONE; 2];
        let map = grid.map(&self.homography, self.light.spread_px);
        let light = &self.light;
        let unit = 1.0 / self.half_px;
        for spot in spots {
            let spread = grid.spread(&map, spot.ideal)?;
            let look = grid.look_at(&spread, light.spread_px, &mut work);
            let (x, y) = (spot.ideal[0] * unit, spot.ideal[1] * unit);
            let shade = 1.0 + light.shade[0] * x + light.shade[1] * y;
            let flat = light.black + light.contrast * look.white + light.beyond * look.beyond;
            let predicted = flat * shade;
            // Where the sensor has reached its end, nothing more can be asked of it.
            if spot.grey >= 255.0 && predicted > 254.5 || spot.grey <= 0.0 && predicted < 0.5 {
                spot.difference = f64::NAN;
                system.clipped += 1;
                continue;
            }
            let difference = spot.grey - predicted;
            spot.difference = difference;
            let (weight, cost) = self.pull.of(difference);
            system.cost += cost;
            system.squares += weight * difference * difference;
            system.weight += weight;
            let place = self.homography.at(look.square);
            let steepness = -shade * light.contrast;
            let tilt = [steepness * look.by_place[0], steepness * look.by_place[1]];
            let telling = weight * (tilt[0] * tilt[0] + tilt[1] * tilt[1]);
            system.told += telling * difference * difference;
            system.telling += telling;
            let moved = place.along(tilt);
            let mut slope = [0.0; UNKNOWNS];
            slope[..8].copy_from_slice(&moved);
            slope[8] = shade * light.contrast * look.by_spread;
            slope[9] = shade;
            slope[10] = shade * look.white;
            slope[11] = flat * x;
            slope[12] = flat * y;
            slope[13] = shade * look.beyond;
            for (i, row) in system.matrix.iter_mut().enumerate() {
                let scaled = weight * slope[i];
                system.right[i] += scaled * difference;
                for (entry, other) in row[i..].iter_mut().zip(&slope[i..]) {
                    *entry += scaled * other;
                }
            }
        }
        system.matrix[13][13] += PRIOR_OF_BEYOND;
        system.right[13] -= PRIOR_OF_BEYOND * light.beyond;
        (system.cost.is_finite() && system.weight > UNKNOWNS as f64).then_some(system)
    }

    fn stepped(&self, system: &System, damping: f64) -> Option<Self> {
        let mut matrix = system.full();
        for i in 0..UNKNOWNS {
            matrix[(i, i)] += damping * matrix[(i, i)] + 1e-9;
        }
        let step = matrix.cholesky()?.solve(&SVector::from(system.right));
        let light = &self.light;
        let spread_px = light.spread_px + step[8].clamp(-0.3, 0.3);
        Some(Self {
            homography: self.homography.moved(|i| step[i])?,
            light: Picture {
                black: light.black + step[9],
                contrast: light.contrast + step[10],
                shade: [light.shade[0] + step[11], light.shade[1] + step[12]]
                    .map(|s| s.clamp(-0.9, 0.9)),
                beyond: light.beyond + step[13],
                spread_px: spread_px.clamp(SPREAD_LIMITS_PX.0, SPREAD_LIMITS_PX.1),
            },
            ..*self
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn where_the_sensor_clips_pixels_count_as_much_as_they_tell() {
        let system = |clipped: usize| System {
            matrix: [[0.0; UNKNOWNS]; UNKNOWNS],
            right: [0.0; UNKNOWNS],
            cost: 0.0,
            // Of a hundred pixels ten tell something, and differ by three grey levels, the others by one.
            squares: 90.0 + 10.0 * 9.0,
            weight: 100.0,
            told: 10.0 * 50.0 * 9.0,
            telling: 10.0 * 50.0,
            clipped,
        };
        assert!((system(0).variance() - 1.8).abs() < 1e-12);
        assert!((system(40).variance() - 9.0).abs() < 1e-12);
    }
}
