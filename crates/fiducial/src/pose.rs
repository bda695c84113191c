//! Estimates the pose of a plane from the images of known points on it, as a square's corners: both solutions in closed
//! form, refined to the smallest reprojection error, with covariance.
//!
//! Four or more points of a plane leave two poses: the plane tilted one way, and tilted the other way about
//! the line of sight. The closed form is that of Collins and Bartoli ("Infinitesimal plane-based pose
//! estimation", IJCV 2014). Levenberg-Marquardt then minimises the reprojection error, weighted by the
//! points' covariance.

use geometry::{Camera, CameraModel, Marker as MarkerFrame, Pixel, Point, Rotation, Transform};
use nalgebra::{
    Isometry3, Matrix2, Matrix3, Matrix6, Rotation3, SMatrix, SVector, Translation3,
    UnitQuaternion, Vector2, Vector3, Vector6,
};

use crate::observation::{MarkerPose, PoseSolution};
use crate::optics::homography::Homography;
use crate::optics::least_squares::{
    Damping, Minimum, NormalEquations, Problem, Schedule, minimise,
};

/// A point of the marker's plane and its image.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct PlanePoint {
    /// Its place in the marker frame (x right, y up), in metres.
    pub place_m: [f64; 2],
    /// Its pixel in the image as captured, with lens distortion.
    pub seen: Pixel,
    /// Covariance of `seen`, in square pixels.
    pub covariance_px2: Matrix2<f64>,
}

/// The pose of the marker frame in which `points` lie, for instance the corners of one marker or of all
/// markers of a pad. `None` for fewer than four points, for points on a line, and when no visible face in
/// front of the camera explains them.
pub fn planar_pose(points: &[PlanePoint], camera: &CameraModel) -> Option<MarkerPose> {
    Plane { points, joint: None, sheets: None, camera }.pose()
}

/// As [`planar_pose`], of points on several sheets.
pub(crate) fn pose_of_sheets(
    points: &[PlanePoint],
    sheets: Sheets<'_>,
    camera: &CameraModel,
) -> Option<MarkerPose> {
    Plane { points, joint: None, sheets: Some(sheets), camera }.pose()
}

/// The pose of a square marker from its four corners and their joint covariance (x and y of the first corner,
/// then of the second, ...; in square pixels). The first corner is the marker's own top left; they go
/// clockwise in the image. `None` as for [`planar_pose`].
pub fn square_pose(
    corners: &[Pixel; 4],
    covariance_px2: &SMatrix<f64, 8, 8>,
    size_m: f64,
    camera: &CameraModel,
) -> Option<MarkerPose> {
    let half = size_m / 2.0;
    let places = [[-half, half], [half, half], [half, -half], [-half, -half]];
    let mut points = places.map(|place_m| PlanePoint {
        place_m,
        seen: corners[0],
        covariance_px2: Matrix2::identity(),
    });
    for (i, (point, seen)) in points.iter_mut().zip(corners).enumerate() {
        point.seen = *seen;
        point.covariance_px2 = covariance_px2.fixed_view::<2, 2>(2 * i, 2 * i).into_owned();
    }
    let information = covariance_px2.cholesky()?.inverse();
    Plane { points: &points, joint: Some(&information), sheets: None, camera }.pose()
}

/// The closed form is so near that a handful of steps is enough.
const SCHEDULE: Schedule = Schedule {
    max_steps: 30,
    damping: Damping {
        first: 1e-4,
        min: 1e-10,
        increase: 20.0,
        min_after_bad: 0.0,
        max: 1e6,
        ridge: 0.0,
    },
    settled_ratio: 1e-10,
    settled_cost: 1e-15,
    fails_without_step: true,
    fails_without_equations: false,
};
/// Prior information on the rotation about each axis, in 1/rad²: that of a uniform angle within half a turn.
/// Far away and face on, the image does not determine the tilt, and the covariance must stay finite.
const ROTATION_PRIOR: f64 = 3.0 / (std::f64::consts::PI * std::f64::consts::PI);

/// The points whose pose is looked for.
struct Plane<'a> {
    points: &'a [PlanePoint],
    /// Inverse of the joint covariance of four points, where it is known.
    joint: Option<&'a SMatrix<f64, 8, 8>>,
    sheets: Option<Sheets<'a>>,
    camera: &'a CameraModel,
}

/// Which points are on one sheet, that may lie elsewhere in the plane than it should.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Sheets<'a> {
    /// The index of the last point of each sheet, in the points' order.
    pub(crate) last: &'a [usize],
    /// Standard deviation of a sheet's place along each axis, in metres.
    pub(crate) tolerance_m: f64,
}

/// The part of the normal equations that the displacement of one sheet has.
struct Displacement {
    matrix: Matrix2<f64>,
    by_pose: SMatrix<f64, 6, 2>,
    right: Vector2<f64>,
}

impl Displacement {
    fn new() -> Self {
        let (matrix, by_pose, right) = (Matrix2::zeros(), SMatrix::zeros(), Vector2::zeros());
        Self { matrix, by_pose, right }
    }

    /// Takes the displacement out of the normal equations of the pose, as far as its tolerance lets it differ.
    fn eliminate(self, tolerance_m: f64, equations: &mut NormalEquations<6, f64>) -> Option<()> {
        if tolerance_m <= 0.0 {
            return Some(());
        }
        let prior = Matrix2::identity() / (tolerance_m * tolerance_m);
        let inverse = (self.matrix + prior).cholesky()?.inverse();
        equations.matrix -= self.by_pose * inverse * self.by_pose.transpose();
        equations.right -= self.by_pose * (inverse * self.right);
        equations.cost -= self.right.dot(&(inverse * self.right));
        Some(())
    }
}

/// A pose, the normal equations there (translation, then rotation vector) and the reprojection error in
/// pixels.
type Solution = Minimum<6, Isometry3<f64>, f64>;

impl Problem<6> for Plane<'_> {
    type Place = Isometry3<f64>;
    type Extra = f64;

    /// `None` where a point would lie behind the camera, or the face away from it.
    fn linearised(&mut self, pose: &Isometry3<f64>) -> Option<NormalEquations<6, f64>> {
        let (matrix, right) = (Matrix6::zeros(), Vector6::zeros());
        let mut equations = NormalEquations { matrix, right, cost: 0.0, extra: 0.0 };
        let mut displacement = Displacement::new();
        let rotation = pose.rotation.to_rotation_matrix();
        let facing = rotation.matrix().column(2).dot(&pose.translation.vector);
        if facing.is_nan() || facing >= 0.0 {
            return None;
        }
        let mut residuals = SVector::<f64, 8>::zeros();
        let mut jacobian = SMatrix::<f64, 8, 6>::zeros();
        let mut squares = 0.0;
        for (i, point) in self.points.iter().enumerate() {
            let arm = rotation * Vector3::new(point.place_m[0], point.place_m[1], 0.0);
            let place = Point::from_coords((arm + pose.translation.vector).into());
            let (pixel, by_place) = self.camera.project_with_jacobian(place)?;
            let residual = Vector2::new(point.seen.x - pixel.x, point.seen.y - pixel.y);
            squares += residual.norm_squared();
            let mut slope = SMatrix::<f64, 2, 6>::zeros();
            slope.fixed_view_mut::<2, 3>(0, 0).copy_from(&by_place);
            slope.fixed_view_mut::<2, 3>(0, 3).copy_from(&(by_place * -arm.cross_matrix()));
            if self.joint.is_some() {
                residuals.fixed_rows_mut::<2>(2 * i).copy_from(&residual);
                jacobian.fixed_view_mut::<2, 6>(2 * i, 0).copy_from(&slope);
                continue;
            }
            let weight = point.covariance_px2.cholesky()?.inverse();
            equations.matrix += slope.transpose() * weight * slope;
            equations.right += slope.transpose() * weight * residual;
            equations.cost += residual.dot(&(weight * residual));
            if let Some(sheets) = self.sheets {
                let by_shift = by_place * rotation.matrix().fixed_view::<3, 2>(0, 0);
                displacement.matrix += by_shift.transpose() * weight * by_shift;
                displacement.by_pose += slope.transpose() * weight * by_shift;
                displacement.right += by_shift.transpose() * weight * residual;
                if sheets.last.contains(&i) {
                    displacement.eliminate(sheets.tolerance_m, &mut equations)?;
                    displacement = Displacement::new();
                }
            }
        }
        if let Some(information) = self.joint {
            equations.matrix = jacobian.transpose() * information * jacobian;
            equations.right = jacobian.transpose() * (information * residuals);
            equations.cost = residuals.dot(&(information * residuals));
        }
        equations.extra = (squares / self.points.len() as f64).sqrt();
        let is_finite =
            equations.cost.is_finite() && equations.matrix.iter().all(|m| m.is_finite());
        is_finite.then_some(equations)
    }

    fn moved(&self, from: &Isometry3<f64>, step: &Vector6<f64>) -> Option<Isometry3<f64>> {
        Some(moved(from, step))
    }
}

impl Plane<'_> {
    fn pose(mut self) -> Option<MarkerPose> {
        let starts = self.closed_form()?;
        let [first, second] =
            starts.map(|start| start.and_then(|start| minimise(&mut self, start, &SCHEDULE)));
        let (best, other) = match (first, second) {
            (Some(a), Some(b)) if a.equations.cost <= b.equations.cost => (a, Some(b)),
            (Some(a), Some(b)) => (b, Some(a)),
            (one, other) => (one.or(other)?, None),
        };
        let mut information = best.equations.matrix;
        for axis in 3..6 {
            information[(axis, axis)] += ROTATION_PRIOR;
        }
        let mut covariance = information.cholesky()?.inverse();
        covariance *= self.variance_factor(best.equations.cost);
        let other = other.filter(|other| self.is_other_minimum(&best, other));
        covariance.iter().all(|c| c.is_finite()).then_some(MarkerPose {
            camera_from_marker: Transform::from_isometry(best.place),
            reprojection_rms_px: best.equations.extra,
            covariance,
            alternative: other.map(|other| PoseSolution {
                camera_from_marker: Transform::from_isometry(other.place),
                reprojection_rms_px: other.equations.extra,
            }),
        })
    }

    /// The factor by which a pose's covariance exceeds that of its points, because they contradict each
    /// other by more: 1 unless that is significant.
    fn variance_factor(&self, cost: f64) -> f64 {
        const MAX_CHANCE: f64 = 6.0;
        let freedom = (2 * self.points.len()).saturating_sub(6).max(1) as f64;
        let ratio = cost / freedom;
        if ratio > MAX_CHANCE { ratio } else { 1.0 }
    }

    /// Whether two poses are different minima: the pose between them costs more than both.
    fn is_other_minimum(&mut self, a: &Solution, b: &Solution) -> bool {
        let [from, to] = [a.place, b.place];
        let between = Isometry3::from_parts(
            Translation3::from((from.translation.vector + to.translation.vector) / 2.0),
            Rotation::<Camera, MarkerFrame>::from_quaternion(from.rotation)
                .interpolate(&Rotation::from_quaternion(to.rotation), 0.5)
                .quaternion,
        );
        let worst = a.equations.cost.max(b.equations.cost);
        let middle = self.linearised(&between).map_or(f64::INFINITY, |fit| fit.cost);
        middle > worst * (1.0 + 1e-6) + 1e-9
    }

    /// The two poses of the plane in closed form.
    fn closed_form(&self) -> Option<[Option<Isometry3<f64>>; 2]> {
        let rotations = rotations(&self.homography()?)?;
        Some(rotations.map(|rotation| {
            let translation = self.translation(&rotation)?;
            let quaternion = UnitQuaternion::from_rotation_matrix(&rotation);
            Some(Isometry3::from_parts(Translation3::from(translation), quaternion))
        }))
    }

    /// The homography to normalised image coordinates, from the plane about the points' middle in units of
    /// their extent.
    fn homography(&self) -> Option<Homography> {
        let count = self.points.len();
        if count < 4 {
            return None;
        }
        let sum = self
            .points
            .iter()
            .fold([0.0, 0.0], |sum, point| [sum[0] + point.place_m[0], sum[1] + point.place_m[1]]);
        let middle = sum.map(|s| s / count as f64);
        let arm = |point: &PlanePoint| [0, 1].map(|axis| point.place_m[axis] - middle[axis]);
        let extent =
            self.points.iter().map(arm).fold(0.0_f64, |max, [x, y]| max.max(x.abs()).max(y.abs()));
        let first = self.camera.unproject(self.points.first()?.seen)?;
        let origin = [first.x(), first.y()];
        let mut is_seen = true;
        let pairs = self.points.iter().filter_map(|point| {
            let ray = self.camera.unproject(point.seen);
            is_seen &= ray.is_some();
            let ray = ray?;
            Some([arm(point).map(|a| a / extent), [ray.x() - origin[0], ray.y() - origin[1]]])
        });
        let homography = Homography::from_points(pairs, origin)?;
        is_seen.then_some(homography)
    }

    /// The translation that fits the points best, algebraically, for a rotation.
    fn translation(&self, rotation: &Rotation3<f64>) -> Option<Vector3<f64>> {
        let mut matrix = Matrix3::zeros();
        let mut right = Vector3::zeros();
        for point in self.points {
            let ray = self.camera.unproject(point.seen)?.coords;
            let arm = rotation * Vector3::new(point.place_m[0], point.place_m[1], 0.0);
            for (axis, along) in [(0, ray.x), (1, ray.y)] {
                let mut row = Vector3::zeros();
                row[axis] = 1.0;
                row.z = -along;
                matrix += row * row.transpose();
                right += row * (along * arm.z - arm[axis]);
            }
        }
        let translation = matrix.lu().solve(&right)?;
        (translation.iter().all(|t| t.is_finite()) && translation.z > 0.0).then_some(translation)
    }
}

/// The two rotations of a plane with this homography to normalised image coordinates.
fn rotations(homography: &Homography) -> Option<[Rotation3<f64>; 2]> {
    let origin = homography.project([0.0, 0.0]);
    let seen = Vector2::from(origin.image);
    let [by_x, by_y] = origin.jacobian(homography);
    let jacobian = Matrix2::new(by_x[0], by_y[0], by_x[1], by_y[1]);
    let sight = Vector3::new(seen.x, seen.y, 1.0);
    let turn = Rotation3::rotation_between(&Vector3::z(), &sight)?;
    let across = turn.matrix();
    let ahead = Matrix2::new(
        across[(0, 0)] - seen.x * across[(2, 0)],
        across[(0, 1)] - seen.x * across[(2, 1)],
        across[(1, 0)] - seen.y * across[(2, 0)],
        across[(1, 1)] - seen.y * across[(2, 1)],
    );
    let affine = ahead.try_inverse()? * jacobian;
    let square = affine * affine.transpose();
    let gap = (square[(0, 0)] - square[(1, 1)]).hypot(2.0 * square[(0, 1)]);
    let largest = (0.5 * (square.trace() + gap)).sqrt();
    if !(largest.is_finite() && largest > 0.0)
        || affine.determinant().abs() < 1e-9 * largest * largest
    {
        return None;
    }
    let flat = affine / largest;
    let rest = Matrix2::identity() - flat.transpose() * flat;
    let depth = Vector2::new(rest[(0, 0)].max(0.0).sqrt(), rest[(1, 1)].max(0.0).sqrt());
    let depth = if rest[(0, 1)] < 0.0 { Vector2::new(depth.x, -depth.y) } else { depth };
    Some([1.0, -1.0].map(|sign| {
        let x = Vector3::new(flat[(0, 0)], flat[(1, 0)], sign * depth.x);
        let y = Vector3::new(flat[(0, 1)], flat[(1, 1)], sign * depth.y);
        // Rounding leaves the columns not quite orthogonal.
        turn * Rotation3::from_matrix_eps(
            &Matrix3::from_columns(&[x, y, x.cross(&y)]),
            1e-9,
            20,
            Rotation3::from_basis_unchecked(&[x, y, x.cross(&y)]),
        )
    }))
}

/// The pose after a step: translation, then rotation vector, both in the camera frame.
fn moved(pose: &Isometry3<f64>, step: &Vector6<f64>) -> Isometry3<f64> {
    let turn = Vector3::new(step[3], step[4], step[5]);
    // No single step may flip the plane.
    let turn = turn * (0.5 / turn.norm().max(0.5));
    Isometry3::from_parts(
        Translation3::from(pose.translation.vector + step.fixed_rows::<3>(0)),
        UnitQuaternion::from_scaled_axis(turn) * pose.rotation,
    )
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{PI, TAU};

    use geometry::Distortion;
    use proptest::prelude::*;

    use super::*;

    const SIZE_M: f64 = 0.15341;

    fn cameras() -> [CameraModel; 3] {
        let pinhole = CameraModel::pinhole(1296, 972, 1818.0);
        let barrel = Distortion::BrownConrady([-0.28, 0.07, 2e-4, 2e-5, 0.0, 0.0, 0.0, 0.0]);
        let fisheye = Distortion::KannalaBrandt([-0.01, 0.03, -0.02, 0.004]);
        [
            pinhole,
            CameraModel { distortion: barrel, ..pinhole },
            CameraModel { fx: 620.0, fy: 630.0, distortion: fisheye, ..pinhole },
        ]
    }

    fn pose(place: [f64; 3], tilt: f64, towards: f64, turn: f64) -> Isometry3<f64> {
        let facing = UnitQuaternion::from_euler_angles(PI, 0.0, turn);
        let tilt = UnitQuaternion::from_scaled_axis(
            Vector3::new(-towards.sin(), towards.cos(), 0.0) * tilt,
        );
        Isometry3::from_parts(Translation3::new(place[0], place[1], place[2]), tilt * facing)
    }

    fn corners(pose: &Isometry3<f64>, camera: &CameraModel) -> [Pixel; 4] {
        let half = SIZE_M / 2.0;
        [[-half, half], [half, half], [half, -half], [-half, -half]].map(|[x, y]| {
            camera.project(Point::from_coords(pose * nalgebra::Point3::new(x, y, 0.0))).unwrap()
        })
    }

    fn difference(found: &Transform<Camera, MarkerFrame>, truth: &Isometry3<f64>) -> Vector6<f64> {
        let turn = (found.isometry.rotation * truth.rotation.inverse()).scaled_axis();
        let moved = found.isometry.translation.vector - truth.translation.vector;
        Vector6::new(moved.x, moved.y, moved.z, turn.x, turn.y, turn.z)
    }

    fn is_near(
        found: &Transform<Camera, MarkerFrame>,
        truth: &Isometry3<f64>,
        within: f64,
    ) -> bool {
        let error = difference(found, truth);
        let moved = error.fixed_rows::<3>(0).norm() / truth.translation.vector.norm();
        moved < within && error.fixed_rows::<3>(3).norm() < within.sqrt()
    }

    proptest! {
        #[test]
        fn the_pose_comes_back_from_its_corners(
            x in -0.3..0.3f64, y in -0.2..0.2f64, z in 0.3..12.0f64,
            tilt in 0.05..1.1f64, towards in 0.0..TAU, turn in -PI..PI,
        ) {
            for camera in cameras() {
                let truth = pose([x * z, y * z, z], tilt, towards, turn);
                prop_assume!(truth.rotation.transform_vector(&Vector3::z()).dot(&truth.translation.vector) < -0.2 * z);
                let corners = corners(&truth, &camera);
                let found = square_pose(&corners, &SMatrix::identity(), SIZE_M, &camera).unwrap();
                prop_assert!(found.reprojection_rms_px < 1e-5, "{found:?}");
                prop_assert!(is_near(&found.camera_from_marker, &truth, 1e-4), "{found:?} {truth:?}");
                if let Some(other) = found.alternative {
                    prop_assert!(other.reprojection_rms_px > found.reprojection_rms_px);
                }
            }
        }

        #[test]
        fn points_that_make_no_sense_have_no_pose(
            numbers in prop::array::uniform16(prop_oneof![
                -1e3..1e3f64, Just(0.0), Just(f64::NAN), Just(f64::INFINITY), Just(1e300),
            ])
        ) {
            let points: Vec<_> = numbers.chunks(4).map(|n| PlanePoint {
                place_m: [n[0], n[1]],
                seen: Pixel::new(n[2], n[3]),
                covariance_px2: Matrix2::identity(),
            }).collect();
            for camera in cameras() {
                if let Some(found) = planar_pose(&points, &camera) {
                    prop_assert!(found.covariance.iter().all(|c| c.is_finite()));
                    prop_assert!(found.camera_from_marker.origin().z() > 0.0);
                }
            }
        }
    }

    #[test]
    fn points_on_a_line_and_mirrored_ones_have_no_pose() {
        let [camera, ..] = cameras();
        let line = [0.0, 1.0, 2.0, 3.0].map(|i| PlanePoint {
            place_m: [i * 0.1, i * 0.2],
            seen: Pixel::new(100.0 + 10.0 * i, 200.0 + 5.0 * i),
            covariance_px2: Matrix2::identity(),
        });
        assert_eq!(planar_pose(&line, &camera), None);
        assert_eq!(planar_pose(&line[..3], &camera), None);
        let mut mirrored = corners(&pose([0.1, 0.0, 2.0], 0.3, 1.0, 0.2), &camera);
        mirrored.reverse();
        assert_eq!(square_pose(&mirrored, &SMatrix::identity(), SIZE_M, &camera), None);
    }

    #[test]
    fn the_other_tilt_of_a_far_marker_is_reported_with_its_error() {
        let [camera, ..] = cameras();
        let truth = pose([0.5, 0.2, 8.0], 0.5, 1.0, 0.3);
        let found =
            square_pose(&corners(&truth, &camera), &SMatrix::identity(), SIZE_M, &camera).unwrap();
        let other = found.alternative.unwrap();
        assert!(other.reprojection_rms_px > 0.01 && other.reprojection_rms_px < 1.0, "{other:?}");
        let turned =
            found.camera_from_marker.rotation().inverse() * other.camera_from_marker.rotation();
        assert!(turned.angle() > 0.7, "{turned:?}");
    }

    /// The points of two markers of one pad, one in front of the other's centre.
    #[test]
    fn more_points_make_one_pose() {
        let camera = cameras()[1];
        let truth = pose([0.2, -0.1, 3.0], 0.4, 2.0, 0.5);
        let points: Vec<_> = (0..8)
            .map(|i| {
                let place_m = [0.1 + 0.3 * f64::from(i % 3), -0.2 + 0.17 * f64::from(i * i % 5)];
                let place = truth * nalgebra::Point3::new(place_m[0], place_m[1], 0.0);
                let seen = camera.project(Point::from_coords(place)).unwrap();
                PlanePoint { place_m, seen, covariance_px2: Matrix2::identity() * 0.01 }
            })
            .collect();
        let found = planar_pose(&points, &camera).unwrap();
        assert!(is_near(&found.camera_from_marker, &truth, 1e-7), "{found:?}");
    }

    /// Six unknowns: the squared error in units of the covariance is 6 on average.
    #[test]
    fn the_covariance_is_that_of_the_errors() {
        let mut seed = 1_u64;
        let mut gaussian = move || {
            let mut uniform = || {
                seed = seed
                    .wrapping_mul(6_364_136_223_846_793_005)
                    .wrapping_add(1_442_695_040_888_963_407);
                ((seed >> 33) as f64 + 0.5) / 2_f64.powi(31)
            };
            let radius = (-2.0 * uniform().ln()).sqrt();
            radius * (TAU * uniform()).cos()
        };
        // Corners that err together as well as alone.
        let root = SMatrix::<f64, 8, 8>::from_fn(|i, j| match i.abs_diff(j) {
            0 => 0.02,
            2 => 0.008,
            _ => 0.002,
        });
        let covariance = root * root.transpose();
        for camera in cameras() {
            let mut sum = 0.0;
            for i in 0..500 {
                let t = f64::from(i);
                let truth = pose([0.2 * t.sin(), 0.1 * t.cos(), 1.5], 0.6, t, 2.0 * t);
                let error = root * SVector::<f64, 8>::from_fn(|_, _| gaussian());
                let mut seen = corners(&truth, &camera);
                for (k, pixel) in seen.iter_mut().enumerate() {
                    (pixel.x, pixel.y) = (pixel.x + error[2 * k], pixel.y + error[2 * k + 1]);
                }
                let found = square_pose(&seen, &covariance, SIZE_M, &camera).unwrap();
                let error = difference(&found.camera_from_marker, &truth);
                sum += error.dot(&(found.covariance.cholesky().unwrap().inverse() * error));
            }
            let mean = sum / 500.0;
            assert!((mean - 6.0).abs() < 0.6, "{mean}");
        }
    }
}
