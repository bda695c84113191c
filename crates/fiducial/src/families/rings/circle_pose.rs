//! Where concentric circles are in space: from one ellipse to a first pose, from edge points to the best one.

use std::f64::consts::{PI, TAU};
use std::ops::AddAssign;

use geometry::{Camera, CameraModel, Marker as MarkerFrame, Pixel, Point, Rotation, Transform};
use imaging::{Ellipse, fit_ellipse};
use nalgebra::{Matrix2, Matrix3, Matrix6, SMatrix, SVector, UnitQuaternion, Vector3};

/// Concentric circles in the camera frame: their centre, and the direction in which their face looks.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Circles {
    /// The centre, in metres.
    pub(crate) centre: Vector3<f64>,
    /// Unit normal of the printed face; it points back towards the camera.
    pub(crate) normal: Vector3<f64>,
}

/// A place in the image at which one of the circles has its edge.
#[derive(Copy, Clone, Debug)]
pub(crate) struct EdgePoint {
    /// The direction in which it is seen, with z = 1.
    pub(crate) ray: Vector3<f64>,
    /// The circle's radius in metres.
    pub(crate) radius: f64,
}

/// Points of an ellipse that are enough to carry it through a lens.
const ELLIPSE_POINTS: u32 = 24;
/// Steps of the refinement; four are enough but where the tilt hardly shows.
const MOST_STEPS: usize = 25;
/// Edge points further off than this, in pixels, pull no harder than those at this distance.
const HUBER_PX: f64 = 0.3;
/// Edge points are not known better than this, in pixels, however well they agree: what is wrong with them all, such
/// as the blur of thin rings, does not show in their differences.
const LEAST_EDGE_ERROR_PX: f64 = 0.05;

impl Circles {
    /// The two poses of a circle of this radius (metres) that an ellipse in the image may be (Chen, Wu and Wada,
    /// "Camera calibration with two arbitrary coplanar circles", ECCV 2004).
    pub(crate) fn from_ellipse(
        ellipse: &Ellipse,
        radius: f64,
        camera: &CameraModel,
    ) -> Option<[Self; 2]> {
        let eigen = cone(ellipse, camera)?.symmetric_eigen();
        let mut order = [0, 1, 2];
        order.sort_unstable_by(|i, j| eigen.eigenvalues[*j].total_cmp(&eigen.eigenvalues[*i]));
        let [l1, l2, l3] = order.map(|i| eigen.eigenvalues[i]);
        let (e1, e3) = (eigen.eigenvectors.column(order[0]), eigen.eigenvectors.column(order[2]));
        if !(l2 > 0.0 && l3 < 0.0) {
            return None;
        }
        let (s, c) = (((l1 - l2) / (l1 - l3)).sqrt(), ((l2 - l3) / (l1 - l3)).sqrt());
        let distance = l2 * radius / (-l1 * l3).sqrt();
        let pose = |sign: f64| {
            let centre = (e1 * (sign * s * l3 / l2) + e3 * (c * l1 / l2)) * distance;
            let normal = e1 * (sign * s) + e3 * c;
            let ahead = if centre.z < 0.0 { -centre } else { centre };
            let facing = if normal.dot(&ahead) > 0.0 { -normal } else { normal };
            Self { centre: ahead, normal: facing }
        };
        let both = [pose(1.0), pose(-1.0)];
        both.iter().all(Self::is_sound).then_some(both)
    }

    /// The pose whose outlines differ least from this one's: the normal mirrored about the line of sight.
    pub(crate) fn mirrored(&self) -> Self {
        let sight = self.centre.normalize();
        Self { normal: sight * (2.0 * self.normal.dot(&sight)) - self.normal, ..*self }
    }

    /// The same place, its normal no closer to the line of sight than this angle (radians).
    pub(crate) fn tilted_at_least(&self, angle: f64) -> Self {
        let sight = self.centre.normalize();
        let aside = self.normal - sight * self.normal.dot(&sight);
        if aside.norm() >= angle.sin() {
            return *self;
        }
        let towards = aside.try_normalize(1e-9).unwrap_or_else(|| self.basis().0);
        Self { normal: towards * angle.sin() - sight * angle.cos(), ..*self }
    }

    /// The angle of the normal from the line of sight, in radians.
    pub(crate) fn tilt(&self) -> f64 {
        self.normal.angle(&-self.centre)
    }

    /// The same place, tilted as much towards a quarter turn from where it is tilted to.
    pub(crate) fn turned(&self) -> Self {
        let sight = self.centre.normalize();
        let along = sight * self.normal.dot(&sight);
        Self { normal: along + sight.cross(&self.normal), ..*self }
    }

    /// Two unit vectors that span the plane.
    pub(crate) fn basis(&self) -> (Vector3<f64>, Vector3<f64>) {
        let aside = if self.normal.x.abs() < 0.8 { Vector3::x() } else { Vector3::y() };
        let first = self.normal.cross(&aside).normalize();
        (first, self.normal.cross(&first))
    }

    /// The outline of the circle of this radius (metres) as an ellipse in the image.
    pub(crate) fn outline(&self, radius: f64, camera: &CameraModel) -> Option<Ellipse> {
        let (u, v) = self.basis();
        let mut points = [[0.0; 2]; ELLIPSE_POINTS as usize];
        for (i, point) in (0..ELLIPSE_POINTS).zip(&mut points) {
            let (sin, cos) = (f64::from(i) * TAU / f64::from(ELLIPSE_POINTS)).sin_cos();
            let pixel = project(self.centre + (u * cos + v * sin) * radius, camera)?;
            *point = [pixel.x, pixel.y];
        }
        fit_ellipse(points.iter().copied())
    }

    /// The pose that brings the circles closest to the edge points, and the root mean square of the distances that
    /// are left, in pixels. `None` when there are too few, or they lead nowhere.
    pub(crate) fn refined(
        &self,
        points: &[EdgePoint],
        camera: &CameraModel,
    ) -> Option<(Self, f64)> {
        if points.len() < 8 {
            return None;
        }
        let mut best = *self;
        let (mut system, mut cost) = best.system(points, camera)?;
        let mut damping = 1e-6;
        for _ in 0..MOST_STEPS {
            let candidate = best.stepped(&system, damping)?;
            match candidate.system(points, camera) {
                Some((next, next_cost)) if next_cost <= cost => {
                    let settled = cost - next_cost < 1e-6 * cost;
                    (best, system, cost) = (candidate, next, next_cost);
                    damping = (damping * 0.1).max(1e-9);
                    if settled {
                        break;
                    }
                }
                _ => {
                    damping *= 30.0;
                    if damping > 1e3 {
                        break;
                    }
                }
            }
        }
        Some((best, best.rms_px(points, camera)?))
    }

    /// The pose in the project's conventions. Rings do not tell a turn about their normal: the marker's y axis
    /// is taken as close to the image's upward direction as the normal allows.
    pub(crate) fn camera_from_marker(&self) -> Transform<Camera, MarkerFrame> {
        let z = self.normal;
        let up = -Vector3::y();
        let along = up - z * up.dot(&z);
        let y = along.try_normalize(1e-6).unwrap_or_else(|| self.basis().0);
        let x = y.cross(&z);
        let rotation =
            nalgebra::Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[x, y, z]));
        Transform::new(
            Rotation::from_quaternion(UnitQuaternion::from_rotation_matrix(&rotation)),
            Point::new(self.centre.x, self.centre.y, self.centre.z),
        )
    }

    fn is_sound(&self) -> bool {
        let finite = self.centre.iter().chain(self.normal.iter()).all(|c| c.is_finite());
        finite && self.centre.z > 0.0 && self.normal.dot(&self.centre) < 0.0
    }

    /// The plane of the circles, ready for many rays.
    pub(crate) fn plane(&self, camera: &CameraModel) -> Plane {
        let (u, v) = self.basis();
        Plane {
            normal: self.normal,
            distance: self.normal.dot(&self.centre),
            centre: [u.dot(&self.centre), v.dot(&self.centre)],
            u,
            v,
            per_px: [1.0 / camera.fx, 1.0 / camera.fy],
        }
    }

    /// Root mean square distance in pixels between edge points and their circles.
    pub(crate) fn rms_px(&self, points: &[EdgePoint], camera: &CameraModel) -> Option<f64> {
        let plane = self.plane(camera);
        let squares: Option<f64> =
            points.iter().map(|point| plane.residual(point).map(|(r, _)| r * r)).sum();
        Some((squares? / points.len().max(1) as f64).sqrt())
    }

    /// Covariance of the pose that was fitted to these edge points: centre (m), then rotation vector (rad), in the
    /// camera frame. The turn about the normal does not show, and has the variance of any angle.
    pub(crate) fn covariance(
        &self,
        points: &[EdgePoint],
        camera: &CameraModel,
    ) -> Option<Matrix6<f64>> {
        let (system, _) = self.system(points, camera)?;
        let error_px = self.rms_px(points, camera)?.max(LEAST_EDGE_ERROR_PX);
        let of_step = system.matrix.try_inverse()? * (error_px * error_px);
        let covariance = self.spread(&of_step);
        covariance.iter().all(|c| c.is_finite()).then_some(covariance)
    }

    /// Covariance of centre (m) and rotation vector (rad) from that of the centre and of the normal along
    /// [`Circles::basis`].
    pub(crate) fn spread(&self, of_step: &SMatrix<f64, 5, 5>) -> Matrix6<f64> {
        let (u, v) = self.basis();
        // The rotation vector v moves the normal along u, and -u along v.
        let mut full_from_step = SMatrix::<f64, 6, 5>::zeros();
        full_from_step.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
        full_from_step.fixed_view_mut::<3, 1>(3, 3).copy_from(&v);
        full_from_step.fixed_view_mut::<3, 1>(3, 4).copy_from(&-u);
        let mut covariance = full_from_step * of_step * full_from_step.transpose();
        let turn = self.normal * self.normal.transpose() * ANY_ANGLE_VARIANCE;
        covariance.fixed_view_mut::<3, 3>(3, 3).add_assign(turn);
        covariance
    }

    /// The largest distance, in pixels, that lies in the middle of those of one circle's edge points from it: circles of
    /// other radii have some.
    pub(crate) fn bias_px(&self, points: &[EdgePoint], camera: &CameraModel) -> f64 {
        const MOST: usize = 128;
        let plane = self.plane(camera);
        let mut worst = 0.0_f64;
        for circle in points.chunk_by(|a, b| a.radius == b.radius) {
            let mut offs = [0.0; MOST];
            for (off, point) in offs.iter_mut().zip(circle) {
                *off = plane.residual(point).map_or(f64::MAX, |(off, _)| off);
            }
            let count = circle.len().min(MOST);
            let Some(offs) = offs.get_mut(..count) else { continue };
            let (_, middle, _) = offs.select_nth_unstable_by(count / 2, f64::total_cmp);
            worst = worst.max(middle.abs());
        }
        worst
    }

    /// Leaves out the edge points that lie much further off than most.
    pub(crate) fn leave_outliers(&self, points: &mut Vec<EdgePoint>, camera: &CameraModel) {
        const MOST: usize = 640;
        let plane = self.plane(camera);
        let off = |point: &EdgePoint| plane.residual(point).map_or(f64::MAX, |(r, _)| r.abs());
        let mut offs = [0.0; MOST];
        let count = points.len().min(MOST);
        for (slot, point) in offs.iter_mut().zip(points.iter()) {
            *slot = off(point);
        }
        let Some(offs) = offs.get_mut(..count).filter(|offs| !offs.is_empty()) else { return };
        let (_, median, _) = offs.select_nth_unstable_by(count / 2, f64::total_cmp);
        let limit = (4.0 * *median).max(0.1);
        points.retain(|point| off(point) <= limit);
    }

    /// The normal equations of one step, and the cost here.
    fn system(&self, points: &[EdgePoint], camera: &CameraModel) -> Option<(System, f64)> {
        let mut system = System { matrix: SMatrix::zeros(), right: SVector::zeros() };
        let mut cost = 0.0;
        let plane = self.plane(camera);
        for point in points {
            let (residual, slope) = plane.residual(point)?;
            let size = residual.abs();
            let weight = if size > HUBER_PX { HUBER_PX / size } else { 1.0 };
            cost += if size > HUBER_PX { HUBER_PX * (2.0 * size - HUBER_PX) } else { size * size };
            system.matrix.syger(weight, &slope, &slope, 1.0);
            system.right -= slope * (weight * residual);
        }
        system.matrix.fill_upper_triangle_with_lower_triangle();
        Some((system, cost))
    }

    fn stepped(&self, system: &System, damping: f64) -> Option<Self> {
        let mut matrix = system.matrix;
        for i in 0..5 {
            matrix[(i, i)] += damping * system.matrix[(i, i)] + 1e-12;
        }
        self.moved(&matrix.cholesky()?.solve(&system.right))
    }

    /// The pose after a step of the centre (three numbers, metres) and of the normal along [`Circles::basis`].
    pub(crate) fn moved(&self, step: &SVector<f64, 5>) -> Option<Self> {
        let (u, v) = self.basis();
        // The normal is a direction: more than a third of a radian at once is no small step.
        let turn = (step[3].hypot(step[4]) / 0.3).max(1.0);
        let normal = self.normal + (u * step[3] + v * step[4]) / turn;
        let stepped =
            Self { centre: self.centre + step.fixed_rows::<3>(0), normal: normal.normalize() };
        stepped.is_sound().then_some(stepped)
    }
}

/// The plane of some circles, as a camera sees it.
pub(crate) struct Plane {
    normal: Vector3<f64>,
    /// Its distance from the camera along the normal, and the centre along `u` and `v`, in metres.
    distance: f64,
    centre: [f64; 2],
    /// As [`Circles::basis`].
    u: Vector3<f64>,
    v: Vector3<f64>,
    /// Change of a ray from pixel to pixel.
    per_px: [f64; 2],
}

/// Where a ray meets the plane.
#[derive(Copy, Clone)]
pub(crate) struct Meeting {
    /// How much the plane faces the ray; not below nought when they do not meet.
    facing: f64,
    /// Distance from the centre, in metres.
    pub(crate) rho: f64,
    /// How the place changes with the pixel, to the right and down: outwards from the centre and around it, in metres.
    pub(crate) outwards: [f64; 2],
    pub(crate) around: [f64; 2],
    /// The length of `outwards`, and one over it.
    pub(crate) metres_per_px: f64,
    pub(crate) px_per_metre: f64,
    /// How the distance, in pixels, changes with the centre (three numbers) and with the normal along the two vectors of
    /// [`Circles::basis`].
    pub(crate) slope: [f64; 5],
}

impl Meeting {
    /// Whether there is such a place, and it says how the pose moves it.
    #[inline]
    pub(crate) fn is_sound(&self) -> bool {
        self.facing < -1e-9 && self.px_per_metre.is_finite()
    }
}

impl Plane {
    /// Where a ray meets it, when that [`Meeting::is_sound`]. Without a branch, so that many are worked out at once.
    #[inline(always)]
    pub(crate) fn meets(&self, ray: &Vector3<f64>) -> Meeting {
        let facing = self.normal.dot(ray);
        let inverse = 1.0 / facing;
        let along = self.distance * inverse;
        let (ur, vr) = (self.u.dot(ray), self.v.dot(ray));
        let (a, b) = (ur * along - self.centre[0], vr * along - self.centre[1]);
        // Faster than `hypot`, whose care for the smallest numbers is not needed.
        let rho = (a * a + b * b).sqrt();
        // From the centre itself any way is outwards.
        let inward = 1.0 / rho;
        let [p, q] = if rho < 1e-12 { [1.0, 0.0] } else { [a * inward, b * inward] };
        let [nx, ny] = [self.normal.x * inverse, self.normal.y * inverse];
        let by_pixel = |axis: &Vector3<f64>, component: f64| {
            let [x, y] = self.per_px;
            [along * (axis.x - component * nx) * x, along * (axis.y - component * ny) * y]
        };
        let (of_u, of_v) = (by_pixel(&self.u, ur), by_pixel(&self.v, vr));
        let outwards = [p * of_u[0] + q * of_v[0], p * of_u[1] + q * of_v[1]];
        let around = [p * of_v[0] - q * of_u[0], p * of_v[1] - q * of_u[1]];
        let metres_per_px = (outwards[0] * outwards[0] + outwards[1] * outwards[1]).sqrt();
        let scale = 1.0 / metres_per_px;
        let lean = (p * ur + q * vr) * inverse * scale;
        let by_centre = self.normal * lean - (self.u * p + self.v * q) * scale;
        let slope = [by_centre.x, by_centre.y, by_centre.z, -a * lean, -b * lean];
        Meeting { facing, rho, outwards, around, metres_per_px, px_per_metre: scale, slope }
    }

    /// Distance in pixels from an edge point to its circle, positive outside, and how it changes with the pose.
    #[inline]
    fn residual(&self, point: &EdgePoint) -> Option<(f64, SVector<f64, 5>)> {
        let meeting = self.meets(&point.ray);
        let off = (meeting.rho - point.radius) * meeting.px_per_metre;
        (meeting.is_sound() && off.is_finite()).then_some((off, meeting.slope.into()))
    }
}

/// Variance of an angle of which nothing is known, in square radians.
pub(crate) const ANY_ANGLE_VARIANCE: f64 = PI * PI / 3.0;

/// Covariance, in square pixels, of the image of a point whose place in the camera frame has this covariance.
pub(crate) fn pixel_covariance(
    point: Vector3<f64>,
    covariance: &Matrix3<f64>,
    camera: &CameraModel,
) -> Option<Matrix2<f64>> {
    let (_, jacobian) = camera.project_with_jacobian(Point::from_coords(point.into()))?;
    Some(jacobian * covariance * jacobian.transpose())
}

struct System {
    matrix: SMatrix<f64, 5, 5>,
    right: SVector<f64, 5>,
}

/// The pixel of a point in the camera frame.
pub(crate) fn project(point: Vector3<f64>, camera: &CameraModel) -> Option<Pixel> {
    camera.project(Point::new(point.x, point.y, point.z))
}

/// The cone of rays through an ellipse, as a symmetric matrix that vanishes on it and is negative within.
fn cone(ellipse: &Ellipse, camera: &CameraModel) -> Option<Matrix3<f64>> {
    let rays = (0..ELLIPSE_POINTS).map(|i| {
        let [x, y] = ellipse.at(f64::from(i) * TAU / f64::from(ELLIPSE_POINTS));
        let ray = camera.unproject(Pixel::new(x, y));
        [ray.x(), ray.y()]
    });
    let ellipse = fit_ellipse(rays)?;
    let (sin, cos) = ellipse.angle.sin_cos();
    let (p, q) = (4.0 / ellipse.minor.powi(2), 4.0 / ellipse.major.powi(2));
    let (a, b, c) =
        (p * cos * cos + q * sin * sin, p * sin * sin + q * cos * cos, (p - q) * sin * cos);
    let [x, y] = ellipse.centre;
    let (d, e) = (-(a * x + c * y), -(c * x + b * y));
    let f = -(d * x + e * y) - 1.0;
    // A scale near 1 keeps the eigenvalues comparable.
    Some(Matrix3::new(a, c, d, c, b, e, d, e, f) / (p + q))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn circles(x: f64, y: f64, z: f64, tilt: f64, towards: f64) -> Circles {
        let (sin, cos) = tilt.sin_cos();
        let normal = Vector3::new(sin * towards.cos(), sin * towards.sin(), -cos);
        Circles { centre: Vector3::new(x * z, y * z, z), normal }
    }

    proptest! {
        #[test]
        fn a_circle_is_one_of_the_two_that_its_ellipse_may_be(
            x in -0.3..0.3f64, y in -0.25..0.25f64, z in 0.3..15.0f64,
            tilt in 0.01..1.0f64, towards in 0.0..TAU,
        ) {
            let camera = CameraModel::pinhole(1296, 972, 1818.0);
            let truth = circles(x, y, z, tilt, towards);
            let ellipse = truth.outline(0.0767, &camera).unwrap();
            let both = Circles::from_ellipse(&ellipse, 0.0767, &camera).unwrap();
            let error = both.map(|c| (c.centre - truth.centre).norm() / z + (c.normal - truth.normal).norm());
            prop_assert!(error[0].min(error[1]) < 1e-4, "{both:?} {truth:?}");
        }

        #[test]
        fn edge_points_of_two_circles_lead_back_to_the_pose(
            x in -0.3..0.3f64, y in -0.25..0.25f64, z in 0.3..4.0f64,
            tilt in 0.1..0.9f64, towards in 0.0..TAU,
        ) {
            let camera = CameraModel::pinhole(1296, 972, 1818.0);
            let truth = circles(x, y, z, tilt, towards);
            let (u, v) = truth.basis();
            let points: Vec<_> = (0..64).map(|i| {
                let radius = if i % 2 == 0 { 0.0767 } else { 0.0614 };
                let (sin, cos) = (f64::from(i) * TAU / 64.0).sin_cos();
                let point = truth.centre + (u * cos + v * sin) * radius;
                EdgePoint { ray: point / point.z, radius }
            }).collect();
            let start = Circles {
                centre: truth.centre * 1.02,
                normal: (truth.normal + u * 0.03 - v * 0.03).normalize(),
            };
            // Far away the marker tilted the other way looks nearly the same; the better one is the right one.
            let (near, near_rms) = start.refined(&points, &camera).unwrap();
            let (other, other_rms) = near.mirrored().refined(&points, &camera).unwrap();
            let (found, rms) = if near_rms < other_rms { (near, near_rms) } else { (other, other_rms) };
            prop_assert!(rms < 1e-3, "{rms}");
            prop_assert!((found.centre - truth.centre).norm() < 1e-3 * z);
        }
    }

    #[test]
    fn the_marker_faces_the_camera_with_its_y_axis_up() {
        let level = circles(0.1, 0.0, 2.0, 0.0, 0.0).camera_from_marker();
        let up = level.rotation() * geometry::Vector::new(0.0, 1.0, 0.0);
        let face = level.rotation() * geometry::Vector::new(0.0, 0.0, 1.0);
        assert!((up - geometry::Vector::new(0.0, -1.0, 0.0)).norm() < 1e-12);
        assert!((face - geometry::Vector::new(0.0, 0.0, -1.0)).norm() < 1e-12);
    }
}
