//! Defines the input, memory and result that both refinements share, that along the edges and that on grey values.

use geometry::{CameraModel, Pixel};
use imaging::GrayView;
use nalgebra::{Matrix2, SMatrix, SVector};

use crate::optics::edge_response::PIXEL_VARIANCE;
use crate::optics::homography::{CORNERS, Homography};
use crate::optics::undistort::Undistortion;
use crate::response::ResponseEstimate;

/// Where a square is about.
#[derive(Copy, Clone, Debug)]
pub struct CornerGuess<'a> {
    /// The image.
    pub view: GrayView<'a>,
    /// The corners, clockwise in the image; the first is the top left one of the marker's pattern.
    pub corners: &'a [Pixel; 4],
    /// Without a camera, lines are taken to be straight in the image.
    pub camera: Option<&'a CameraModel>,
    /// Whether the corners are right to about half a pixel.
    pub is_near: bool,
    /// How the camera shows light, where that is known.
    pub response: Option<ResponseEstimate>,
}

/// The corners of a square marker, refined.
#[derive(Clone, Debug, PartialEq)]
pub struct Refined {
    /// The corners of the square, in the order in which they were given.
    pub corners: [Pixel; 4],
    /// Joint covariance of the corners (x and y of the first, then of the second, ...), in square pixels.
    pub covariance_px2: SMatrix<f64, 8, 8>,
    /// The image of the square's centre.
    pub centre: Pixel,
    /// Covariance of `centre`, in square pixels.
    pub centre_covariance_px2: Matrix2<f64>,
    /// Standard deviation of the lens' blur, in pixels.
    pub blur_px: f64,
    /// Grey value of unblurred black in the marker's middle.
    pub black: f64,
    /// Grey value of unblurred white in the marker's middle.
    pub white: f64,
    /// Root mean square residual of the pixels, as a fraction of the contrast.
    pub residual: f64,
    /// The camera's response to light, where the marker gave it.
    pub response: Option<ResponseEstimate>,
}

impl Refined {
    /// Corners that were not refined, with this standard deviation.
    pub(crate) fn unrefined(corners: &[Pixel; 4], corner_px: f64) -> Self {
        let corner_px2 = corner_px * corner_px;
        Self {
            corners: *corners,
            covariance_px2: SMatrix::identity() * corner_px2,
            centre: diagonals_crossing(corners),
            centre_covariance_px2: Matrix2::identity() * (corner_px2 / 4.0),
            blur_px: 0.0,
            black: 0.0,
            white: 0.0,
            residual: 1.0,
            response: None,
        }
    }

    /// Adds the uncertainty of corners with this standard deviation.
    pub(crate) fn add_uncertainty(&mut self, corner_px: f64) {
        let corner_px2 = corner_px * corner_px;
        self.covariance_px2 += SMatrix::<f64, 8, 8>::identity() * corner_px2;
        self.centre_covariance_px2 += Matrix2::identity() * (corner_px2 / 4.0);
    }
}

/// Where the diagonals of a quad cross: the image of the square's centre.
pub(crate) fn diagonals_crossing(corners: &[Pixel; 4]) -> Pixel {
    let [a, b, c, d] = corners;
    let (ux, uy) = (c.x - a.x, c.y - a.y);
    let (vx, vy) = (d.x - b.x, d.y - b.y);
    let t = ((b.x - a.x) * vy - (b.y - a.y) * vx) / (ux * vy - uy * vx);
    Pixel::new(a.x + t * ux, a.y + t * uy)
}

/// Working memory of the refinements.
#[derive(Debug, Default)]
pub struct Scratch {
    pub(crate) edges: Vec<EdgeSample>,
    pub(crate) magnitudes: Vec<f64>,
    pub(crate) pixels: Vec<PixelSample>,
}

impl Scratch {
    /// Makes the buffers as large as markers need.
    pub(crate) fn make_room(&mut self) {
        const MAX_EDGES: usize = 512;
        const MAX_PIXELS: usize = 2048;
        self.edges.clear();
        self.edges.reserve(MAX_EDGES);
        self.magnitudes.clear();
        self.magnitudes.reserve(MAX_EDGES);
        self.pixels.clear();
        self.pixels.reserve(MAX_PIXELS);
    }
}

/// A place on an edge of the marker.
#[derive(Copy, Clone, Debug)]
pub(crate) struct EdgeSample {
    /// In the square's coordinates.
    pub(crate) place: [f64; 2],
    /// From black to white across the edge, one cell long, in the square's coordinates.
    pub(crate) across: [f64; 2],
    /// The last measurement of the edge.
    pub(crate) measurement: Option<EdgeMeasurement>,
}

/// The measurement of the pixels across an edge.
#[derive(Copy, Clone, Debug)]
pub(crate) struct EdgeMeasurement {
    /// Derivatives of the edge's position by the homography's parameters.
    pub(crate) gradient: [f64; 8],
    /// Normal equations of the edge's shift in pixels and of the blur; black and contrast are eliminated.
    pub(crate) matrix: [f64; 3],
    pub(crate) right: [f64; 2],
    /// Sum of squared residuals, and their degrees of freedom.
    pub(crate) squares: f64,
    pub(crate) freedom: f64,
    pub(crate) black: f64,
    pub(crate) contrast: f64,
    pub(crate) weight: f64,
}

/// A pixel that takes part in the photometric refinement.
#[derive(Copy, Clone, Debug)]
pub(crate) struct PixelSample {
    /// Its ideal image point, relative to the homography's origin.
    pub(crate) ideal: [f64; 2],
    pub(crate) grey: f64,
    /// Grey value less its last prediction; NaN where the sensor is saturated.
    pub(crate) residual: f64,
}

/// A square in small cells.
#[derive(Copy, Clone, Debug)]
pub(crate) struct SmallCells<'a> {
    /// Cells across the square, and around it on each side.
    pub(crate) across: usize,
    pub(crate) margin: usize,
    /// The fraction of white in each, row by row, those around the square included.
    pub(crate) white: &'a [f64],
}

/// A square marker that does not consist of square cells of one colour.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Design<'a> {
    /// In cells for an image that is linear in light, and in such as a camera's processing needs.
    pub(crate) plain: SmallCells<'a>,
    pub(crate) processed: SmallCells<'a>,
    /// Places on edges, in the square's coordinates, and the vector from there towards white up to the next
    /// edge.
    pub(crate) edges: &'a [[[f64; 2]; 2]],
    /// Distance from the square's outline to the next edge, in sides of the square.
    pub(crate) border: f64,
}

impl Design<'_> {
    /// Whether a camera's processing needs narrower cells.
    pub(crate) fn is_finer(&self) -> bool {
        self.processed.across > self.plain.across
    }
}

/// Light and blur of a marker.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct PhotometricModel {
    /// Grey value of black, and white less black, in the marker's middle.
    pub(crate) black: f64,
    pub(crate) contrast: f64,
    /// Relative gradient of the light to the right and down, per half a marker.
    pub(crate) shade: [f64; 2],
    /// Brightness beyond the pattern less white, in grey levels; usually negative.
    pub(crate) beyond: f64,
    /// Standard deviation of the blur of lens and pixel together, in pixels.
    pub(crate) spread_px: f64,
}

impl PhotometricModel {
    /// Standard deviation of the lens' blur alone.
    fn blur_px(&self) -> f64 {
        (self.spread_px * self.spread_px - PIXEL_VARIANCE).max(0.0).sqrt()
    }
}

/// The input of a fit: an image, its lens, and the square's first homography.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Target<'a> {
    pub(crate) view: GrayView<'a>,
    pub(crate) lens: &'a Undistortion<'a>,
    pub(crate) start: &'a Homography,
    /// How the camera shows light, where that is known.
    pub(crate) response: Option<ResponseEstimate>,
}

/// How strongly each part of a marker pulls at all that is fitted; together they are in balance.
pub(crate) type Pulls<const N: usize> = [SVector<f64, N>; PARTS];

/// Parts of a square: its outline, its centre and the area between, on each of four sides; those on opposite sides follow
/// each other.
const PARTS: usize = 12;

pub(crate) fn no_pulls<const N: usize>() -> Pulls<N> {
    [SVector::zeros(); PARTS]
}

/// The part at a place in the square's coordinates.
pub(crate) fn part([a, b]: [f64; 2]) -> usize {
    const BANDS: [f64; 2] = [0.55, 0.87];
    let is_aside = a.abs() > b.abs();
    let along = if is_aside { a } else { b };
    let band = BANDS.iter().filter(|end| along.abs() > **end).count();
    2 * (2 * band + usize::from(is_aside)) + usize::from(along > 0.0)
}

/// Widens the covariance of the first unknowns where the parts contradict each other by more than their noise, as on bent
/// paper, or where the model of a camera's processing is not quite the camera's: neighbouring pixels are off together. Then the
/// parts, or opposite ones together, are independent (a cluster-robust covariance), beyond what chance explains. `inverse` is that of the
/// normal equations.
pub(crate) fn widen_by_parts<const N: usize>(
    covariance: &mut SMatrix<f64, 8, 8>,
    inverse: &SMatrix<f64, N, N>,
    pulls: &Pulls<N>,
) {
    // The larger of two variances of so few parts exceeds the stated one by half by chance: where this was not taken off, the squared errors
    // of centres behind a tone curve were 0.7 to 0.95 of the stated ones, and 0.8 to 1.05 where it was divided by (`positions`, seeds
    // 1300001 and 1300002).
    const CHANCE: f64 = 0.5;
    let opposite: [_; PARTS / 2] = std::array::from_fn(|k| pulls[2 * k] + pulls[2 * k + 1]);
    let mut wider = SVector::<f64, 8>::repeat(1.0);
    for pulls in [&pulls[..], &opposite] {
        let count = pulls.len() as f64;
        for (i, wider) in wider.iter_mut().enumerate() {
            let row = inverse.fixed_rows::<1>(i);
            let squares: f64 = pulls.iter().map(|pull| (row * pull)[0].powi(2)).sum();
            let variance = squares * count / (count - 1.0);
            *wider = wider.max((variance / covariance[(i, i)] - CHANCE).max(0.0).sqrt());
        }
    }
    covariance.component_mul_assign(&(wider * wider.transpose()));
}

/// The result of either refinement.
#[derive(Clone, Debug)]
pub(crate) struct Fit {
    pub(crate) homography: Homography,
    /// Of the homography's eight parameters.
    pub(crate) covariance: SMatrix<f64, 8, 8>,
    pub(crate) model: PhotometricModel,
    /// As in [`Refined`].
    pub(crate) residual: f64,
    /// Whether a shift of all edges towards black, as by a tone curve, can be distinguished from the square's size.
    pub(crate) is_shift_known: bool,
    /// That shift, towards white; 0 where it was not fitted as such.
    pub(crate) shift_px: f64,
    /// How the camera shows light, where that was fitted.
    pub(crate) response: Option<ResponseEstimate>,
}

/// Largest distance by which a corner is moved: in pixels, and as a fraction of the shortest side.
const MAX_MOVE_PX: f64 = 2.0;
const MAX_MOVE_RATIO: f64 = 0.12;

impl Fit {
    /// The corners with their covariance; `None` when one is too far from where it was expected.
    pub(crate) fn refined(
        &self,
        lens: &Undistortion<'_>,
        guess: &CornerGuess<'_>,
        side_px: f64,
    ) -> Option<Refined> {
        let mut corners = *guess.corners;
        let mut jacobian = SMatrix::<f64, 8, 8>::zeros();
        let max_move_px = MAX_MOVE_PX + MAX_MOVE_RATIO * side_px;
        for (i, place) in CORNERS.into_iter().enumerate() {
            let (pixel, by_parameters) = self.pixel(lens, place)?;
            if pixel.distance(&guess.corners[i]) > max_move_px {
                return None;
            }
            corners[i] = pixel;
            jacobian.fixed_view_mut::<2, 8>(2 * i, 0).copy_from(&by_parameters);
        }
        let (centre, by_parameters) = self.pixel(lens, [0.0, 0.0])?;
        let covariance_px2 = jacobian * self.covariance * jacobian.transpose();
        let refined = Refined {
            corners,
            covariance_px2,
            centre,
            centre_covariance_px2: by_parameters * self.covariance * by_parameters.transpose(),
            blur_px: self.model.blur_px(),
            black: self.model.black,
            white: self.model.black + self.model.contrast,
            residual: self.residual,
            response: self.response,
        };
        refined.covariance_px2.iter().all(|c| c.is_finite()).then_some(refined)
    }

    /// The pixel of a point of the square, and its derivatives by the homography's parameters.
    fn pixel(
        &self,
        lens: &Undistortion<'_>,
        place: [f64; 2],
    ) -> Option<(Pixel, SMatrix<f64, 2, 8>)> {
        let projected = self.homography.project(place);
        let (pixel, distortion_jacobian) = lens.distort(projected.image)?;
        Some((pixel, distortion_jacobian * projected.parameter_jacobian()))
    }
}
