//! Predicts the grey values of a marker: the fraction of white at a point of the image, and its derivatives.
//!
//! The edges of all cells are predicted together, since through the blur of lens and pixels a cell of two pixels
//! never shows its own black or white. In the square's coordinates the blur is a Gaussian whose axes are oblique
//! because of the perspective. A cell's fraction of it is the product of two differences of edge responses, with the
//! terms of Mehler's series for the effect of the obliqueness where edges cross.

use geometry::Pixel;
use imaging::GrayView;
use nalgebra::Matrix2;

use crate::optics::edge_response::{EdgeResponse, MAX_SIGMAS, pixel_kurtosis};
use crate::optics::homography::{CORNERS, Homography, Inverse};
use crate::optics::undistort::Undistortion;
use crate::refine::fit::{PixelSample, SmallCells, Target};
use crate::refine::pattern::{MAX_CELLS, Pattern};

/// More pixels than this must be near the marker: twice the number of unknowns.
const MIN_PIXELS: usize = 28;
/// Largest number of columns or rows of cells within the blur's reach.
const MAX_BANDS: usize = 28;
/// Largest fraction of a pixel's light from cells of unknown colour, and from beyond the pattern.
const MAX_UNKNOWN: f64 = 0.03;
const MAX_BEYOND: f64 = 0.1;

/// The colours of a [`Pattern`]'s cells, row by row.
pub(crate) struct PatternCells {
    cells: usize,
    across: usize,
    white: [f64; MAX_CELLS * MAX_CELLS],
    unknown: [f64; MAX_CELLS * MAX_CELLS],
}

impl PatternCells {
    pub(crate) fn new(pattern: &Pattern) -> Self {
        let across = pattern.across();
        let mut white = [0.0; MAX_CELLS * MAX_CELLS];
        let mut unknown = [0.0; MAX_CELLS * MAX_CELLS];
        for (index, (white, unknown)) in
            white.iter_mut().zip(&mut unknown).enumerate().take(across * across)
        {
            match pattern.is_white(index % across, index / across) {
                Some(is_white) => *white = f64::from(u8::from(is_white)),
                None => *unknown = 1.0,
            }
        }
        Self { cells: pattern.cells(), across, white, unknown }
    }
}

/// The cells of a marker, for look-up.
pub(crate) struct PatternGrid<'a> {
    across: usize,
    /// Cells from the middle to the square's side, and to the pattern's end.
    half: f64,
    middle: f64,
    /// The fraction of white in each cell, row by row.
    white: &'a [f64],
    /// The same of unknown colour; empty where all are known.
    unknown: &'a [f64],
    /// Whether cells are small parts of shapes: each differs little from the next, also where an edge is near.
    is_design: bool,
    /// The same in wider cells for a wide blur, where that saves time.
    wide: Option<&'a Self>,
    /// Derivatives of the ideal image by the pixels.
    undistortion: [[f64; 2]; 2],
    response: EdgeResponse,
}

/// The fractions of a blurred point's light that come from each column (or row) of cells, with the factors of
/// their first and second derivatives, in units of the blur.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Bands {
    first: usize,
    count: usize,
    share: [[f64; 3]; MAX_BANDS],
}

impl Bands {
    pub(crate) const NONE: Self = Self { first: 0, count: 0, share: [[0.0; 3]; MAX_BANDS] };
}

/// The predicted share of white at a point, and its derivatives.
#[derive(Copy, Clone, Debug, Default)]
pub(crate) struct Prediction {
    /// The square's coordinates.
    pub(crate) square: [f64; 2],
    pub(crate) white: f64,
    /// By the ideal image point, per pixel.
    pub(crate) by_place: [f64; 2],
    pub(crate) by_spread: f64,
    /// The fraction of light from beyond the pattern.
    pub(crate) beyond: f64,
}

/// A point of the image in the pattern, with the blur there.
pub(crate) struct BlurredPoint {
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

/// One of `interval` places of a plane, evenly spread over it.
struct Lattice {
    interval: usize,
    shift: usize,
}

impl Lattice {
    fn new(interval: usize) -> Self {
        // The golden section: the shift of rows is never near a simple fraction of the interval.
        Self { interval, shift: (0.618 * interval as f64).round() as usize }
    }

    fn has(&self, column: usize, row: usize) -> bool {
        (column + row * self.shift).is_multiple_of(self.interval)
    }
}

/// From the ideal image to the pattern.
pub(crate) struct PatternMap {
    inverse: Inverse,
    spread_px: f64,
    /// The blur all over the pattern, where its perspective is weak.
    blur: Option<Blur>,
}

impl<'a> PatternGrid<'a> {
    /// Derivatives of the ideal image by the pixels.
    pub(crate) fn undistortion(&self) -> Matrix2<f64> {
        Matrix2::from(self.undistortion).transpose()
    }

    pub(crate) fn from_pattern(pattern: &'a PatternCells, lens: &Undistortion<'_>) -> Self {
        let PatternCells { cells, across, white, unknown } = pattern;
        let unknown = if unknown.iter().any(|u| *u > 0.0) { &unknown[..] } else { &[] };
        Self::new(lens, [*cells, *across], white, unknown)
    }

    pub(crate) fn from_design(cells: SmallCells<'a>, lens: &Undistortion<'_>) -> Self {
        let all = cells.across + 2 * cells.margin;
        Self { is_design: true, ..Self::new(lens, [cells.across, all], cells.white, &[]) }
    }

    pub(crate) fn with_wide(self, wide: &'a Self) -> Self {
        Self { wide: Some(wide), ..self }
    }

    /// The grid of the light that a camera blurs before it sharpens.
    pub(crate) fn for_wide_blur(&self) -> &Self {
        self.wide.unwrap_or(self)
    }

    fn new(
        lens: &Undistortion<'_>,
        [cells, across]: [usize; 2],
        white: &'a [f64],
        unknown: &'a [f64],
    ) -> Self {
        let slope = lens.jacobian();
        Self {
            across,
            half: cells as f64 / 2.0,
            middle: across as f64 / 2.0,
            white,
            unknown,
            is_design: false,
            wide: None,
            undistortion: [[slope[(0, 0)], slope[(0, 1)]], [slope[(1, 0)], slope[(1, 1)]]],
            response: EdgeResponse::new(),
        }
    }

    /// Collects the pixels near the marker's known edges, and some others; true when none was left out for
    /// their number.
    pub(crate) fn gather(
        &self,
        target: Target<'_>,
        homography: &Homography,
        spread_px: f64,
        max_pixels: usize,
        pixels: &mut Vec<PixelSample>,
    ) -> Option<bool> {
        let Target { view, lens, .. } = target;
        pixels.clear();
        let [left, top, right, bottom] = self.bounds(view, lens, homography)?;
        let map = self.map(homography, spread_px);
        let origin = homography.origin;
        let area = ((right - left) * (bottom - top)) as f64;
        // Of large markers every n-th pixel is taken, in an order without a pattern of its own.
        let every = (0.5 * area / max_pixels as f64).max(1.0) as usize;
        // Of very large ones most pixels are not even mapped.
        let skipped = (every / 8).max(1);
        let thinned = every / skipped;
        // Lattices that cover both axes evenly: counted along the rows, the pixels taken would be those of a few columns.
        let [near, far] = [thinned, 4 * thinned].map(Lattice::new);
        let mut work = [Bands::NONE; 2];
        for y in top..bottom {
            let row = view.row(y);
            let columns = row.iter().enumerate().take(right).skip(left + y * 5 % skipped);
            for (column, (x, grey)) in columns.step_by(skipped).enumerate() {
                // Beyond the rim of a fisheye's image there is nothing.
                let Some(ideal) = lens.undistort(Pixel::new(x as f64, y as f64)) else { continue };
                let ideal = [ideal[0] - origin[0], ideal[1] - origin[1]];
                let Some(point) = self.point(&map, ideal) else { continue };
                let lattice = if self.is_near_edge(&point) { &near } else { &far };
                if thinned > 1 && !lattice.has(column, y)
                    || self.beyond(&point) > MAX_BEYOND
                    || self.unknown_at(&point, &mut work) > MAX_UNKNOWN
                {
                    continue;
                }
                pixels.push(PixelSample { ideal, grey: f64::from(*grey), residual: 0.0 });
            }
        }
        (pixels.len() > MIN_PIXELS).then_some(every == 1)
    }

    /// Whether the nearest line between columns, or between rows, has black on one side and white on the
    /// other; of a design, whether white begins or ends within the blur's reach.
    fn is_near_edge(&self, point: &BlurredPoint) -> bool {
        const REACH: f64 = 1.8;
        let last = self.across - 1;
        let white = |row: usize, column: usize| self.white.get(row * self.across + column);
        if self.is_design {
            let line = |axis: usize| {
                let (at, reach) = (point.cells[axis], REACH * point.blur.sigma[axis]);
                [at - reach, at, at + reach].map(|at| (at.max(0.0) as usize).min(last))
            };
            let [[left, column, right], [top, row, bottom]] = [line(0), line(1)];
            return white(row, left) != white(row, right)
                || white(top, column) != white(bottom, column)
                || white(row, left) != white(row, column)
                || white(top, column) != white(row, column);
        }
        let place = |axis: usize| {
            let at = point.cells[axis].max(0.0);
            let nearest = (at + 0.5) as usize;
            let is_near = (at - nearest as f64).abs() < REACH * point.blur.sigma[axis];
            ((at as usize).min(last), nearest, is_near && nearest > 0 && nearest <= last)
        };
        let ((column, x, upright), (row, y, level)) = (place(0), place(1));
        upright && white(row, x - 1) != white(row, x)
            || level && white(y - 1, column) != white(y, column)
    }

    /// First column and row around the pattern within the image, and those after the last.
    fn bounds(
        &self,
        view: GrayView<'_>,
        lens: &Undistortion<'_>,
        homography: &Homography,
    ) -> Option<[usize; 4]> {
        let mut bounds = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
        let reach = self.middle / self.half;
        for [a, b] in CORNERS {
            let projected = homography.project([a * reach, b * reach]);
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

    pub(crate) fn map(&self, homography: &Homography, spread_px: f64) -> PatternMap {
        let mut map = PatternMap { inverse: homography.inverse(), spread_px, blur: None };
        let perspective = homography.h[6].abs() + homography.h[7].abs();
        if perspective < Self::MIN_PERSPECTIVE {
            map.blur = self.point(&map, [homography.h[2], homography.h[5]]).map(|s| s.blur);
        }
        map
    }

    /// The point of the pattern at an ideal image point relative to the origin; `None` outside of the
    /// pattern.
    #[inline]
    pub(crate) fn point(&self, map: &PatternMap, [x, y]: [f64; 2]) -> Option<BlurredPoint> {
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
    fn both_bands<'b>(&self, point: &BlurredPoint, work: &'b mut [Bands; 2]) -> &'b [Bands; 2] {
        for (axis, bands) in work.iter_mut().enumerate() {
            self.bands(point.cells[axis], &point.blur, axis, bands);
        }
        work
    }

    /// The fraction of a point's light that comes from cells of unknown colour.
    fn unknown_at(&self, point: &BlurredPoint, work: &mut [Bands; 2]) -> f64 {
        if self.unknown.is_empty() {
            return 0.0;
        }
        let mut sum = 0.0;
        let [columns, rows] = self.both_bands(point, work);
        for (row, [share, ..]) in self
            .unknown
            .chunks_exact(self.across)
            .skip(rows.first)
            .zip(&rows.share)
            .take(rows.count)
        {
            let cells = row.iter().skip(columns.first).zip(&columns.share).take(columns.count);
            sum += share * cells.map(|(unknown, [share, ..])| unknown * share).sum::<f64>();
        }
        sum
    }

    /// The fraction of a point's light that comes from beyond the pattern.
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
    pub(crate) fn predict(
        &self,
        point: &BlurredPoint,
        spread_px: f64,
        work: &mut [Bands; 2],
    ) -> Prediction {
        let [columns, rows] = self.both_bands(point, work);
        // Sums over the cells with the derivatives by column and by row.
        let (mut w, mut wx, mut wy, mut wxy, mut wxx, mut wyy, mut wxxyy) =
            (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        for (row, [share, slope, curve]) in
            self.white.chunks_exact(self.across).skip(rows.first).zip(&rows.share).take(rows.count)
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
