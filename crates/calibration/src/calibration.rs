//! Defines the result of a calibration from a board: camera, covariance, residuals of each view, maps of residuals and of
//! uncertainty, and by how much markers' poses are off.

use geometry::{Board, Camera, CameraModel, Pixel, Point, Transform};
use libm::{fmax, hypot};
use nalgebra::{Isometry3, Matrix2, Matrix6, SMatrix, Translation3, Vector3};

use crate::board::BEND;
use crate::evidence::Evidence;
use crate::halves::CrossValidation;
use crate::lens::{INTRINSICS, Lens};
use crate::stages::Solved;
use crate::turned::is_turned;
use crate::view::{ImageSize, View};

/// The options of a calibration.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Options {
    /// Whether the board may be bent; its shape is then solved for. Glass and aluminium are flat, paper never is.
    pub solve_bend: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self { solve_bend: true }
    }
}

/// A calibrated camera.
#[derive(Clone, Debug)]
pub struct Calibration {
    /// The camera.
    pub camera: CameraModel,
    /// Its kind of lens.
    pub lens: Lens,
    /// Covariance of fx, fy, cx, cy (px) and of the lens's numbers in their order, zero for those that it has not.
    pub covariance: SMatrix<f64, INTRINSICS, INTRINSICS>,
    /// How much deeper the board's centre is than its left and right ends, and than its upper and lower ones, in metres.
    pub bend_m: [f64; 2],
    /// Standard deviation of the bend, in metres.
    pub bend_sigma_m: [f64; 2],
    /// Standard deviation of the points along each axis, in pixels, without outliers.
    pub noise_px: f64,
    /// Root mean square of the residuals' lengths, outliers included: as OpenCV reports it.
    pub rms_px: f64,
    /// How far from the principal point points were seen that fit, in pixels.
    pub seen_radius_px: f64,
    /// The views that were used.
    pub views: Vec<SolvedView>,
    /// How the board was shown, and the residuals that the fit does not explain.
    pub evidence: Evidence,
    /// The comparison of two halves of the views; `None` where a half alone does not determine the camera.
    pub cross_validation: Option<CrossValidation>,
}

/// A view, as the calibration explains it.
#[derive(Clone, Debug)]
pub struct SolvedView {
    /// Its name.
    pub name: String,
    /// Where the board was.
    pub camera_from_board: Transform<Camera, Board>,
    /// Root mean square of its residuals' lengths, in pixels.
    pub rms_px: f64,
    /// Whether the camera explains it better after a turn by 180 degrees.
    pub is_turned: bool,
    /// The residual of each point.
    pub residuals: Vec<Residual>,
}

/// The residual of a point.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Residual {
    /// The tag that it belongs to.
    pub tag: u32,
    /// Where it was seen.
    pub seen: Pixel,
    /// By how much farther right and down than expected, in pixels.
    pub residual_px: [f64; 2],
}

/// The residuals in a part of the image.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct PlaceResidual {
    /// The part's middle.
    pub middle: Pixel,
    /// How many points were seen there.
    pub points: usize,
    /// Their mean residual, in pixels: far from zero where the lens model does not fit.
    pub mean_px: [f64; 2],
    /// Root mean square of their residuals' lengths, in pixels.
    pub rms_px: f64,
}

/// How sure the projection is at a place of the image.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct PlaceUncertainty {
    /// The place.
    pub pixel: Pixel,
    /// One standard deviation along each axis (root mean square of both); `None` where nothing is known.
    pub sigma_px: Option<f64>,
}

/// By how much the pose of a marker is off, one standard deviation, because the camera is not known better.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct PlacementError {
    /// Across the line of sight, in metres.
    pub lateral_m: f64,
    /// Along it, in metres.
    pub range_m: f64,
}

/// Half of the side of the marker of [`Calibration::error_at`], by its distance.
const MARKER_HALF: f64 = 0.05;
/// Points that are farther from where they are expected, in deviations along an axis, do not show the lens.
const MAX_FIT_SIGMAS: f64 = 4.0;
/// Up to this multiple of the radius at which points were seen a lens's polynomial is used.
const MAX_BEYOND_SEEN: f64 = 1.05;
/// Columns and rows of the positions that represent the whole image.
const COLUMNS: usize = 16;
const ROWS: usize = 12;

impl Calibration {
    /// The result of a solved bundle; `None` where the views do not determine the camera.
    pub(crate) fn new(solved: &Solved, views: &[&View], middle_m: [f64; 2]) -> Option<Self> {
        let shared = &solved.place.shared;
        let camera = solved.bundle().camera(shared);
        let information = solved.information()?;
        let certainty = information.certainty(&solved.free)?;
        let covariance =
            certainty.covariance.fixed_view::<INTRINSICS, INTRINSICS>(0, 0).into_owned();
        let to_middle = Translation3::new(-middle_m[0], -middle_m[1], 0.0);
        let mut explained = Vec::with_capacity(solved.views.len());
        for ((points, pose), i) in solved.views.iter().zip(&solved.place.poses).zip(&solved.used) {
            let residuals: Vec<Residual> = points
                .iter()
                .filter_map(|point| {
                    let residual_px = point.residual(&camera, shared, pose)?;
                    let seen = Pixel::new(point.seen[0], point.seen[1]);
                    Some(Residual { tag: point.tag, seen, residual_px })
                })
                .collect();
            let camera_from_board: Isometry3<f64> = pose * to_middle;
            explained.push(SolvedView {
                name: views.get(*i)?.name.clone(),
                camera_from_board: Transform::from_isometry(camera_from_board),
                rms_px: rms_px(residuals.iter()),
                is_turned: is_turned(solved, points, pose),
                residuals,
            });
        }
        let seen_radius_px = explained
            .iter()
            .flat_map(|view| &view.residuals)
            .filter(|residual| {
                let [x, y] = residual.residual_px;
                hypot(x, y) <= MAX_FIT_SIGMAS * solved.noise_px
            })
            .map(|residual| residual.seen.distance(&Pixel::new(camera.cx, camera.cy)))
            .fold(0.0, fmax);
        Some(Self {
            camera,
            seen_radius_px,
            lens: solved.lens,
            covariance,
            bend_m: [shared[BEND], shared[BEND + 1]],
            bend_sigma_m: [0, 1]
                .map(|axis| fmax(certainty.covariance[(BEND + axis, BEND + axis)], 0.0).sqrt()),
            noise_px: solved.noise_px,
            rms_px: rms_px(explained.iter().flat_map(|view| &view.residuals)),
            views: explained,
            evidence: Evidence::new(solved, &information),
            cross_validation: None,
        })
    }

    fn size(&self) -> ImageSize {
        ImageSize { width: self.camera.width, height: self.camera.height }
    }

    /// The covariance of the projection, in square pixels, of the direction in the camera frame that is seen at `pixel`. `None`
    /// outside the range of the lens model.
    pub fn projection_covariance(&self, pixel: Pixel) -> Option<Matrix2<f64>> {
        let ray = self.camera.unproject(pixel)?;
        let slope = self.camera.intrinsics_jacobian(Point::from_coords(ray.coords.into()))?;
        Some(slope * self.covariance * slope.transpose())
    }

    /// Whether points were seen as far from the principal point as this, or almost. Farther out no points constrain the
    /// lens's polynomial, and its covariance contains only the uncertainty of its coefficients.
    pub fn is_known_at(&self, pixel: Pixel) -> bool {
        let radius_px = pixel.distance(&Pixel::new(self.camera.cx, self.camera.cy));
        radius_px <= MAX_BEYOND_SEEN * self.seen_radius_px
    }

    /// One standard deviation of the projection at a place of the image, in pixels along each axis (root mean square of both
    /// axes); `None` outside the range of the lens model, or where points were not seen so far from the centre.
    pub fn uncertainty_px(&self, pixel: Pixel) -> Option<f64> {
        self.formal_uncertainty_px(pixel).filter(|_| self.is_known_at(pixel))
    }

    /// The uncertainty by the covariance, also where points were not seen.
    fn formal_uncertainty_px(&self, pixel: Pixel) -> Option<f64> {
        let covariance = self.projection_covariance(pixel)?;
        Some(fmax(covariance.trace() / 2.0, 0.0).sqrt())
    }

    /// The 95th percentile, over the whole image, of the uncertainty by the covariance: if it is too large there are too few
    /// views.
    pub(crate) fn worst_formal_uncertainty_px(&self) -> f64 {
        let places = self.size().middles(COLUMNS, ROWS);
        percentile_95(places.filter_map(|pixel| self.formal_uncertainty_px(pixel)).collect())
    }

    /// The same over the image, row by row, at the middles of equal parts.
    pub fn uncertainty_map(&self, columns: usize, rows: usize) -> Vec<PlaceUncertainty> {
        self.size()
            .middles(columns, rows)
            .map(|pixel| PlaceUncertainty { pixel, sigma_px: self.uncertainty_px(pixel) })
            .collect()
    }

    /// Share of the image at which nothing is known.
    pub fn unknown_share(&self) -> f64 {
        let map = self.uncertainty_map(COLUMNS, ROWS);
        map.iter().filter(|place| place.sigma_px.is_none()).count() as f64 / map.len() as f64
    }

    /// The 95th percentile of [`Calibration::uncertainty_px`] over the image, where it is known.
    pub fn worst_uncertainty_px(&self) -> f64 {
        let map = self.uncertainty_map(COLUMNS, ROWS);
        percentile_95(map.iter().filter_map(|place| place.sigma_px).collect())
    }

    /// The residuals by place: equal parts of the image, row by row.
    pub fn residual_map(&self, columns: usize, rows: usize) -> Vec<PlaceResidual> {
        let mut map: Vec<PlaceResidual> = self
            .size()
            .middles(columns, rows)
            .map(|middle| PlaceResidual { middle, points: 0, mean_px: [0.0; 2], rms_px: 0.0 })
            .collect();
        for residual in self.views.iter().flat_map(|view| &view.residuals) {
            let column = part(residual.seen.x, self.camera.width, columns);
            let row = part(residual.seen.y, self.camera.height, rows);
            let Some(place) = map.get_mut(row * columns + column) else { continue };
            place.points += 1;
            let [x, y] = residual.residual_px;
            place.mean_px = [place.mean_px[0] + x, place.mean_px[1] + y];
            place.rms_px += x * x + y * y;
        }
        for place in map.iter_mut().filter(|place| place.points > 0) {
            let count = place.points as f64;
            place.mean_px = place.mean_px.map(|sum| sum / count);
            place.rms_px = (place.rms_px / count).sqrt();
        }
        map
    }

    /// The error of a marker's position that the camera's uncertainty causes: one standard deviation, the 95th percentile over
    /// the known image. The marker is at this distance along the line of sight, faces the camera, has a side of a
    /// tenth of the distance, and its corners are seen without any error; its pose is the one that fits them best. Other
    /// errors of a landing are not included: the corners' own noise, a wrong marker size, the camera's mount.
    pub fn error_at(&self, distance_m: f64) -> PlacementError {
        let [mut lateral_m, mut range_m] = [Vec::new(), Vec::new()];
        for pixel in self.size().middles(COLUMNS, ROWS).filter(|pixel| self.is_known_at(*pixel)) {
            if let Some(error) = self.marker_error(pixel, distance_m) {
                lateral_m.push(error.lateral_m);
                range_m.push(error.range_m);
            }
        }
        PlacementError { lateral_m: percentile_95(lateral_m), range_m: percentile_95(range_m) }
    }

    fn marker_error(&self, pixel: Pixel, distance_m: f64) -> Option<PlacementError> {
        let sight = self.camera.unproject(pixel)?.coords.normalize();
        let across = sight.cross(&Vector3::y()).try_normalize(1e-6)?;
        let down = sight.cross(&across);
        let mut matrix = Matrix6::zeros();
        let mut by_intrinsics = SMatrix::<f64, 6, INTRINSICS>::zeros();
        for [x, y] in [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]] {
            let arm = (across * x + down * y) * MARKER_HALF * distance_m;
            let corner = Point::<Camera>::from_coords((sight * distance_m + arm).into());
            let (_, by_point) = self.camera.project_with_jacobian(corner)?;
            let mut by_pose = SMatrix::<f64, 2, 6>::zeros();
            by_pose.fixed_view_mut::<2, 3>(0, 0).copy_from(&by_point);
            by_pose.fixed_view_mut::<2, 3>(0, 3).copy_from(&(by_point * -arm.cross_matrix()));
            matrix += by_pose.transpose() * by_pose;
            by_intrinsics += by_pose.transpose() * self.camera.intrinsics_jacobian(corner)?;
        }
        let slope = matrix.cholesky()?.inverse() * by_intrinsics;
        let covariance = slope * self.covariance * slope.transpose();
        let place = covariance.fixed_view::<3, 3>(0, 0).into_owned();
        let along = fmax(sight.dot(&(place * sight)), 0.0);
        let across = fmax(place.trace() - along, 0.0);
        Some(PlacementError { lateral_m: across.sqrt(), range_m: along.sqrt() })
    }
}

/// The part of the image's length in which a coordinate lies.
fn part(at: f64, length: u32, parts: usize) -> usize {
    let share = (at + 0.5) / f64::from(length) * parts as f64;
    // The cast converts negative values to zero.
    (share as usize).min(parts.saturating_sub(1))
}

/// The value that 95 of 100 do not exceed.
fn percentile_95(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let at = (values.len() * 95).div_ceil(100).saturating_sub(1);
    values.get(at).copied().unwrap_or(f64::INFINITY)
}

fn rms_px<'a>(residuals: impl Iterator<Item = &'a Residual>) -> f64 {
    let (mut count, mut sum) = (0.0, 0.0);
    for Residual { residual_px: [x, y], .. } in residuals {
        count += 1.0;
        sum += x * x + y * y;
    }
    (sum / fmax(count, 1.0)).sqrt()
}
