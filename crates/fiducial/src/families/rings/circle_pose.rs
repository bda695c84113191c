//! Estimates the pose of concentric circles: two in closed form from an ellipse, the best by least squares from edge points,
//! with covariance, tilt and its mirrored twin.

use std::f64::consts::{PI, TAU};
use std::ops::AddAssign;

use geometry::{Camera, CameraModel, Marker as MarkerFrame, Pixel, Point, Rotation, Transform};
use imaging::{Ellipse, fit_ellipse};
use nalgebra::{Matrix2, Matrix3, Matrix6, SMatrix, SVector, UnitQuaternion, Vector2, Vector3};

use crate::optics::least_squares::{
    Damping, Influence, NormalEquations, Problem, Schedule, huber, minimise,
};

/// Position and normal of concentric circles in the camera frame.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct CirclePose {
    /// The centre, in metres.
    pub(crate) centre: Vector3<f64>,
    /// Unit normal of the printed face; it points back towards the camera.
    pub(crate) normal: Vector3<f64>,
}

/// An edge of one of the circles, located in the image.
#[derive(Copy, Clone, Debug)]
pub(crate) struct EdgePoint {
    /// The viewing ray, with z = 1.
    pub(crate) ray: Vector3<f64>,
    /// The circle's radius in metres.
    pub(crate) radius: f64,
    /// Whether the black is on the circle's inner side.
    pub(crate) black_inside: bool,
}

/// Points sampled on an ellipse to map it through a lens.
const ELLIPSE_POINTS: u32 = 24;
/// Fractions of a circle's radius. The largest that the lens model reaches gives its size.
const REACHED_SHARES: [f64; 5] = [1.0, 0.8, 0.6, 0.4, 0.2];
/// Huber limit of edge residuals, in pixels.
pub(crate) const HUBER_PX: f64 = 0.3;
/// Lower bound of the edges' standard deviation, in pixels. Errors common to all edges, such as the blur of
/// thin rings, do not show in their scatter.
pub(crate) const MIN_EDGE_ERROR_PX: f64 = 0.05;
/// Circles that differ by more, as a ratio of variances, do so by no chance: one of a thousand sets of six does.
const MAX_CHANCE: f64 = 4.0;
/// Fewer edge points do not determine a pose.
const MIN_EDGE_POINTS: usize = 8;
/// Largest turn of the normal in one step, in radians.
const MAX_TURN: f64 = 0.3;
/// Four steps suffice except where the image hardly depends on the tilt.
const SCHEDULE: Schedule = Schedule {
    max_steps: 25,
    damping: Damping {
        first: 1e-6,
        min: 1e-9,
        increase: 30.0,
        min_after_bad: 0.0,
        max: 1e3,
        ridge: 1e-12,
    },
    settled_ratio: 1e-6,
    settled_cost: 0.0,
    fails_without_step: true,
    fails_without_equations: false,
};

impl CirclePose {
    /// The two poses of a circle of `radius` metres whose image is this ellipse (Chen, Wu and Wada, "Camera
    /// calibration with two arbitrary coplanar circles", ECCV 2004).
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
        both.iter().all(Self::is_valid).then_some(both)
    }

    /// The pose with the most similar image: the normal mirrored about the line of sight.
    pub(crate) fn mirrored(&self) -> Self {
        let sight = self.centre.normalize();
        Self { normal: sight * (2.0 * self.normal.dot(&sight)) - self.normal, ..*self }
    }

    /// The same centre, with the normal at least this angle (radians) away from the line of sight.
    pub(crate) fn with_min_tilt(&self, angle: f64) -> Self {
        let sight = self.centre.normalize();
        let across = self.normal - sight * self.normal.dot(&sight);
        if across.norm() >= angle.sin() {
            return *self;
        }
        let towards = across.try_normalize(1e-9).unwrap_or_else(|| self.basis().0);
        Self { normal: towards * angle.sin() - sight * angle.cos(), ..*self }
    }

    /// The angle of the normal from the line of sight, in radians.
    pub(crate) fn tilt(&self) -> f64 {
        self.normal.angle(&-self.centre)
    }

    /// The same centre and tilt, with the direction of the tilt rotated by 90 degrees about the line of
    /// sight.
    pub(crate) fn with_tilt_rotated(&self) -> Self {
        let sight = self.centre.normalize();
        let along = sight * self.normal.dot(&sight);
        Self { normal: along + sight.cross(&self.normal), ..*self }
    }

    /// Two unit vectors that span the plane.
    pub(crate) fn basis(&self) -> (Vector3<f64>, Vector3<f64>) {
        let other = if self.normal.x.abs() < 0.8 { Vector3::x() } else { Vector3::y() };
        let first = self.normal.cross(&other).normalize();
        (first, self.normal.cross(&first))
    }

    /// The image of the circle of this radius (metres).
    pub(crate) fn projected(&self, radius: f64, camera: &CameraModel) -> Option<Ellipse> {
        let (u, v) = self.basis();
        let mut points = [[0.0; 2]; ELLIPSE_POINTS as usize];
        for (i, point) in (0..ELLIPSE_POINTS).zip(&mut points) {
            let (sin, cos) = (f64::from(i) * TAU / f64::from(ELLIPSE_POINTS)).sin_cos();
            let pixel = project(self.centre + (u * cos + v * sin) * radius, camera)?;
            *point = [pixel.x, pixel.y];
        }
        fit_ellipse(points.iter().copied())
    }

    /// As [`Self::projected`]; where the lens model does not reach all of the circle, as it may be beyond the image, a smaller circle
    /// that it reaches, scaled.
    pub(crate) fn outline(&self, radius: f64, camera: &CameraModel) -> Option<Ellipse> {
        REACHED_SHARES.into_iter().find_map(|share| {
            let inner = self.projected(share * radius, camera)?;
            Some(Ellipse { minor: inner.minor / share, major: inner.major / share, ..inner })
        })
    }

    /// The pose that fits the edge points best, with the remaining root mean square distance in pixels.
    /// `None` with too few points, or when a step leaves the valid poses.
    pub(crate) fn refined(
        &self,
        points: &[EdgePoint],
        camera: &CameraModel,
    ) -> Option<(Self, f64)> {
        if points.len() < MIN_EDGE_POINTS {
            return None;
        }
        let best = minimise(&mut EdgeFit { points, camera }, *self, &SCHEDULE)?.place;
        Some((best, best.rms_px(points, camera)?))
    }

    /// The pose in the project's conventions. Rings do not determine the rotation about their normal: the
    /// marker's y axis is chosen as close to the image's upward direction as the normal allows.
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

    fn is_valid(&self) -> bool {
        let finite = self.centre.iter().chain(self.normal.iter()).all(|c| c.is_finite());
        finite && self.centre.z > 0.0 && self.normal.dot(&self.centre) < 0.0
    }

    /// The plane of the circles, prepared for the intersection with many rays.
    pub(crate) fn plane(&self, camera: &CameraModel) -> CirclePlane {
        let (u, v) = self.basis();
        CirclePlane {
            normal: self.normal,
            distance: self.normal.dot(&self.centre),
            centre: [u.dot(&self.centre), v.dot(&self.centre)],
            u,
            v,
            ray_per_px: [1.0 / camera.fx, 1.0 / camera.fy],
        }
    }

    /// Root mean square distance in pixels between the edge points and their circles.
    pub(crate) fn rms_px(&self, points: &[EdgePoint], camera: &CameraModel) -> Option<f64> {
        let plane = self.plane(camera);
        let squares: Option<f64> =
            points.iter().map(|point| plane.residual(point).map(|(r, _)| r * r)).sum();
        Some((squares? / points.len().max(1) as f64).sqrt())
    }

    /// Covariance of the pose fitted to these edge points: centre (m), then rotation vector (rad), in the
    /// camera frame. The rotation about the normal is unobservable and gets [`UNKNOWN_ANGLE_VARIANCE`].
    pub(crate) fn covariance(
        &self,
        points: &[EdgePoint],
        camera: &CameraModel,
    ) -> Option<Matrix6<f64>> {
        let equations = EdgeFit { points, camera }.linearised(self)?;
        let error_px = self.rms_px(points, camera)?.max(MIN_EDGE_ERROR_PX);
        let wider = self.disagreement(points, camera, error_px).filter(|it| *it > MAX_CHANCE);
        let of_step =
            equations.matrix.try_inverse()? * (error_px * error_px * wider.unwrap_or(1.0));
        let covariance = self.full_covariance(&of_step);
        covariance.iter().all(|c| c.is_finite()).then_some(covariance)
    }

    /// How much more the circles differ from each other than edge points with this standard deviation let them, as a ratio of
    /// variances: where light, or a camera's processing, moves all of a circle's edges together.
    fn disagreement(
        &self,
        points: &[EdgePoint],
        camera: &CameraModel,
        error_px: f64,
    ) -> Option<f64> {
        let [circles, squares] = self
            .median_residuals(points, camera)
            .fold([0.0, 0.0], |[circles, squares], (_, off)| [circles + 1.0, squares + off * off]);
        let per_circle = points.len() as f64 / circles;
        let ratio = per_circle * squares / (circles - 1.0) / (error_px * error_px);
        (circles > 1.0 && ratio.is_finite()).then_some(ratio)
    }

    /// Covariance of centre (m) and rotation vector (rad), from that of the centre and of the normal along
    /// [`CirclePose::basis`].
    pub(crate) fn full_covariance(&self, of_step: &SMatrix<f64, 5, 5>) -> Matrix6<f64> {
        let mut covariance = self.propagated(of_step);
        let about_normal = self.normal * self.normal.transpose() * UNKNOWN_ANGLE_VARIANCE;
        covariance.fixed_view_mut::<3, 3>(3, 3).add_assign(about_normal);
        covariance
    }

    /// The same without the rotation about the normal.
    pub(crate) fn propagated(&self, of_step: &SMatrix<f64, 5, 5>) -> Matrix6<f64> {
        let (u, v) = self.basis();
        // The rotation vector v moves the normal along u, and -u along v.
        let mut full_from_step = SMatrix::<f64, 6, 5>::zeros();
        full_from_step.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
        full_from_step.fixed_view_mut::<3, 1>(3, 3).copy_from(&v);
        full_from_step.fixed_view_mut::<3, 1>(3, 4).copy_from(&-u);
        full_from_step * of_step * full_from_step.transpose()
    }

    /// The largest median residual of one circle's edge points, in pixels. It is large when the radii are not
    /// the marker's.
    pub(crate) fn max_bias_px(&self, points: &[EdgePoint], camera: &CameraModel) -> f64 {
        self.median_residuals(points, camera)
            .fold(0.0, |worst, (_, median)| worst.max(median.abs()))
    }

    /// How far all edges lie in the black, in pixels, where else only the size is wrong: least squares over the median
    /// residuals of the circles. `None` with fewer than three circles.
    pub(crate) fn shift_into_black_px(
        &self,
        points: &[EdgePoint],
        camera: &CameraModel,
    ) -> Option<f64> {
        let (mut matrix, mut right, mut circles) = (Matrix2::zeros(), Vector2::zeros(), 0);
        for (point, median) in self.median_residuals(points, camera) {
            let into_black = if point.black_inside { -1.0 } else { 1.0 };
            let row = Vector2::new(point.radius, into_black);
            matrix += row * row.transpose();
            right += row * median;
            circles += 1;
        }
        let solved = matrix.try_inverse()? * right;
        (circles >= 3 && solved.y.is_finite()).then_some(solved.y)
    }

    /// Where between the marker and a target of evenly wide rings the radii lie that would fit the edge points best, where
    /// else pose and a camera's processing are as they fit. `None` when the points do not determine it at all.
    pub(crate) fn evenness(
        &self,
        points: &[EdgePoint],
        size_m: f64,
        camera: &CameraModel,
    ) -> Option<Evenness> {
        const UNKNOWNS: usize = 7;
        let mut matrix = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::zeros();
        let mut right = SVector::<f64, UNKNOWNS>::zeros();
        let plane = self.plane(camera);
        for circle in points.chunk_by(|a, b| a.radius == b.radius) {
            let towards_m = circle.first().map_or(0.0, |point| towards_even(point.radius, size_m));
            // An effect that moves an edge moves all of it: many points on a circle are no better than one.
            let share = 1.0 / circle.len() as f64;
            for point in circle {
                let at = plane.intersect(&point.ray);
                let residual = (at.rho - point.radius) * at.px_per_metre;
                if !(at.is_valid() && residual.is_finite()) {
                    return None;
                }
                let weight = share * huber(residual, HUBER_PX).weight;
                let into_black = if point.black_inside { -1.0 } else { 1.0 };
                let [a, b, c, d, e] = at.by_pose;
                let row = SVector::from([a, b, c, d, e, -towards_m * at.px_per_metre, -into_black]);
                matrix.syger(weight, &row, &row, 1.0);
                right -= row * (weight * residual);
            }
        }
        matrix.fill_upper_triangle_with_lower_triangle();
        matrix[(UNKNOWNS - 1, UNKNOWNS - 1)] += (EDGE_BIAS_PX / PROCESSING_PX).powi(2);
        let covariance = matrix.try_inverse()?;
        let step = covariance * right;
        let deviation = covariance[(5, 5)].sqrt() * EDGE_BIAS_PX;
        (step[5].is_finite() && deviation.is_finite())
            .then_some(Evenness { share: step[5], deviation })
    }

    /// A point of each circle with the median residual of the circle's points, in pixels.
    fn median_residuals<'a>(
        &self,
        points: &'a [EdgePoint],
        camera: &CameraModel,
    ) -> impl Iterator<Item = (&'a EdgePoint, f64)> {
        const MAX_POINTS: usize = 128;
        let plane = self.plane(camera);
        points.chunk_by(|a, b| a.radius == b.radius).filter_map(move |circle| {
            let mut residuals = [0.0; MAX_POINTS];
            for (residual, point) in residuals.iter_mut().zip(circle) {
                *residual = plane.residual(point).map_or(f64::MAX, |(residual, _)| residual);
            }
            let count = circle.len().min(MAX_POINTS);
            let residuals = residuals.get_mut(..count)?;
            let (_, median, _) = residuals.select_nth_unstable_by(count / 2, f64::total_cmp);
            Some((circle.first()?, *median))
        })
    }

    /// Removes the edge points whose residual exceeds four times the median.
    pub(crate) fn remove_outliers(&self, points: &mut Vec<EdgePoint>, camera: &CameraModel) {
        const MAX_POINTS: usize = 640;
        let plane = self.plane(camera);
        let size = |point: &EdgePoint| plane.residual(point).map_or(f64::MAX, |(r, _)| r.abs());
        let mut sizes = [0.0; MAX_POINTS];
        let count = points.len().min(MAX_POINTS);
        for (slot, point) in sizes.iter_mut().zip(points.iter()) {
            *slot = size(point);
        }
        let Some(sizes) = sizes.get_mut(..count).filter(|sizes| !sizes.is_empty()) else { return };
        let (_, median, _) = sizes.select_nth_unstable_by(count / 2, f64::total_cmp);
        let limit = (4.0 * *median).max(0.1);
        points.retain(|point| size(point) <= limit);
    }

    /// The pose after a step of the centre (three numbers, metres) and of the normal along
    /// [`CirclePose::basis`].
    pub(crate) fn moved(&self, step: &SVector<f64, 5>) -> Option<Self> {
        let (u, v) = self.basis();
        let turn = (step[3].hypot(step[4]) / MAX_TURN).max(1.0);
        let normal = self.normal + (u * step[3] + v * step[4]) / turn;
        let stepped =
            Self { centre: self.centre + step.fixed_rows::<3>(0), normal: normal.normalize() };
        stepped.is_valid().then_some(stepped)
    }
}

/// Standard deviation of effects that move a whole edge in the image of a marker, in pixels: lens, print, light.
const EDGE_BIAS_PX: f64 = 0.1;
/// The same of the effect of a camera's processing on all edges alike, in pixels.
const PROCESSING_PX: f64 = 0.3;

/// Where between the marker (0) and a target of evenly wide rings (1) radii lie, with its standard deviation.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Evenness {
    pub(crate) share: f64,
    pub(crate) deviation: f64,
}

/// From the radius of a circle of a marker to that of a target of evenly wide rings, in metres: its rings are an eighth of its
/// size wide, and so are the gaps.
fn towards_even(radius_m: f64, size_m: f64) -> f64 {
    let width_m = 0.125 * size_m;
    if radius_m < 0.5 * width_m { 0.0 } else { (radius_m / width_m).round() * width_m - radius_m }
}

/// Edge points to which a pose is fitted.
struct EdgeFit<'a> {
    points: &'a [EdgePoint],
    camera: &'a CameraModel,
}

impl Problem<5> for EdgeFit<'_> {
    type Place = CirclePose;
    type Extra = ();

    fn linearised(&mut self, at: &CirclePose) -> Option<NormalEquations<5>> {
        let mut matrix = SMatrix::<f64, 5, 5>::zeros();
        let (mut right, mut total) = (SVector::zeros(), 0.0);
        let plane = at.plane(self.camera);
        for point in self.points {
            let (residual, gradient) = plane.residual(point)?;
            let Influence { weight, cost } = huber(residual, HUBER_PX);
            total += cost;
            matrix.syger(weight, &gradient, &gradient, 1.0);
            right -= gradient * (weight * residual);
        }
        matrix.fill_upper_triangle_with_lower_triangle();
        Some(NormalEquations { matrix, right, cost: total, extra: () })
    }

    fn moved(&self, from: &CirclePose, step: &SVector<f64, 5>) -> Option<CirclePose> {
        from.moved(step)
    }
}

/// The plane of the circles, as a camera sees it.
pub(crate) struct CirclePlane {
    normal: Vector3<f64>,
    /// Its distance from the camera along the normal, and the centre along `u` and `v`, in metres.
    distance: f64,
    centre: [f64; 2],
    /// As [`CirclePose::basis`].
    u: Vector3<f64>,
    v: Vector3<f64>,
    /// Change of a ray from one pixel to the next.
    ray_per_px: [f64; 2],
}

/// Where a viewing ray meets the plane of the circles.
#[derive(Copy, Clone)]
pub(crate) struct RayPlaneIntersection {
    /// Ray times normal: negative where the ray meets the printed face.
    facing: f64,
    /// Distance from the centre, in metres.
    pub(crate) rho: f64,
    /// Change of the intersection per pixel to the right and down, radially and tangentially, in metres.
    pub(crate) radial: [f64; 2],
    pub(crate) tangential: [f64; 2],
    /// The length of `radial`, and its inverse.
    pub(crate) metres_per_px: f64,
    pub(crate) px_per_metre: f64,
    /// Gradient of the distance, in pixels, by the centre (three numbers) and by the normal along
    /// [`CirclePose::basis`].
    pub(crate) by_pose: [f64; 5],
}

impl RayPlaneIntersection {
    /// Whether the ray meets the printed face, at a place where the radial scale is defined.
    #[inline]
    pub(crate) fn is_valid(&self) -> bool {
        self.facing < -1e-9 && self.px_per_metre.is_finite()
    }
}

impl CirclePlane {
    /// Intersects a ray with the plane; check [`RayPlaneIntersection::is_valid`]. Free of branches, for
    /// vectorisation.
    #[inline(always)]
    pub(crate) fn intersect(&self, ray: &Vector3<f64>) -> RayPlaneIntersection {
        let facing = self.normal.dot(ray);
        let inverse = 1.0 / facing;
        let along = self.distance * inverse;
        let (ur, vr) = (self.u.dot(ray), self.v.dot(ray));
        let (a, b) = (ur * along - self.centre[0], vr * along - self.centre[1]);
        // Faster than `hypot`, whose care for denormal numbers is not needed.
        let rho = (a * a + b * b).sqrt();
        let inverse_rho = 1.0 / rho;
        // At the centre every direction is radial.
        let [p, q] = if rho < 1e-12 { [1.0, 0.0] } else { [a * inverse_rho, b * inverse_rho] };
        let [nx, ny] = [self.normal.x * inverse, self.normal.y * inverse];
        let by_pixel = |axis: &Vector3<f64>, component: f64| {
            let [x, y] = self.ray_per_px;
            [along * (axis.x - component * nx) * x, along * (axis.y - component * ny) * y]
        };
        let (of_u, of_v) = (by_pixel(&self.u, ur), by_pixel(&self.v, vr));
        let radial = [p * of_u[0] + q * of_v[0], p * of_u[1] + q * of_v[1]];
        let tangential = [p * of_v[0] - q * of_u[0], p * of_v[1] - q * of_u[1]];
        let metres_per_px = (radial[0] * radial[0] + radial[1] * radial[1]).sqrt();
        let px_per_metre = 1.0 / metres_per_px;
        let lean = (p * ur + q * vr) * inverse * px_per_metre;
        let by_centre = self.normal * lean - (self.u * p + self.v * q) * px_per_metre;
        let by_pose = [by_centre.x, by_centre.y, by_centre.z, -a * lean, -b * lean];
        RayPlaneIntersection {
            facing,
            rho,
            radial,
            tangential,
            metres_per_px,
            px_per_metre,
            by_pose,
        }
    }

    /// Where a viewing ray meets the plane: from the centre along [`CirclePose::basis`], in metres.
    pub(crate) fn place(&self, ray: &Vector3<f64>) -> [f64; 2] {
        let along = self.distance / self.normal.dot(ray);
        [self.u.dot(ray) * along - self.centre[0], self.v.dot(ray) * along - self.centre[1]]
    }

    /// Distance in pixels from an edge point to its circle, positive outside, with its gradient by the pose.
    #[inline]
    pub(crate) fn residual(&self, point: &EdgePoint) -> Option<(f64, SVector<f64, 5>)> {
        let at = self.intersect(&point.ray);
        let residual = (at.rho - point.radius) * at.px_per_metre;
        (at.is_valid() && residual.is_finite()).then_some((residual, at.by_pose.into()))
    }
}

/// Variance of an angle of which nothing is known (uniform over a turn), in square radians.
pub(crate) const UNKNOWN_ANGLE_VARIANCE: f64 = PI * PI / 3.0;

/// Covariance, in square pixels, of the image of a point in the camera frame with this covariance.
pub(crate) fn pixel_covariance(
    point: Vector3<f64>,
    covariance: &Matrix3<f64>,
    camera: &CameraModel,
) -> Option<Matrix2<f64>> {
    let (_, jacobian) = camera.project_with_jacobian(Point::from_coords(point.into()))?;
    Some(jacobian * covariance * jacobian.transpose())
}

/// The pixel of a point in the camera frame.
pub(crate) fn project(point: Vector3<f64>, camera: &CameraModel) -> Option<Pixel> {
    camera.project(Point::new(point.x, point.y, point.z))
}

/// The cone of rays through an ellipse, as a symmetric matrix that is zero on it and negative inside.
fn cone(ellipse: &Ellipse, camera: &CameraModel) -> Option<Matrix3<f64>> {
    let rays = (0..ELLIPSE_POINTS).map(|i| {
        let [x, y] = ellipse.at(f64::from(i) * TAU / f64::from(ELLIPSE_POINTS));
        let ray = camera.unproject_clamped(Pixel::new(x, y));
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

    fn pose(x: f64, y: f64, z: f64, tilt: f64, towards: f64) -> CirclePose {
        let (sin, cos) = tilt.sin_cos();
        let normal = Vector3::new(sin * towards.cos(), sin * towards.sin(), -cos);
        CirclePose { centre: Vector3::new(x * z, y * z, z), normal }
    }

    proptest! {
        #[test]
        fn one_of_the_two_poses_from_an_ellipse_is_the_true_one(
            x in -0.3..0.3f64, y in -0.25..0.25f64, z in 0.3..15.0f64,
            tilt in 0.01..1.0f64, towards in 0.0..TAU,
        ) {
            let camera = CameraModel::pinhole(1296, 972, 1818.0);
            let truth = pose(x, y, z, tilt, towards);
            let ellipse = truth.projected(0.0767, &camera).unwrap();
            let both = CirclePose::from_ellipse(&ellipse, 0.0767, &camera).unwrap();
            let error = both.map(|c| (c.centre - truth.centre).norm() / z + (c.normal - truth.normal).norm());
            prop_assert!(error[0].min(error[1]) < 1e-4, "{both:?} {truth:?}");
        }

        #[test]
        fn edge_points_of_two_circles_lead_back_to_the_pose(
            x in -0.3..0.3f64, y in -0.25..0.25f64, z in 0.3..4.0f64,
            tilt in 0.1..0.9f64, towards in 0.0..TAU,
        ) {
            let camera = CameraModel::pinhole(1296, 972, 1818.0);
            let truth = pose(x, y, z, tilt, towards);
            let (u, v) = truth.basis();
            let points: Vec<_> = (0..64).map(|i| {
                let radius = if i % 2 == 0 { 0.0767 } else { 0.0614 };
                let (sin, cos) = (f64::from(i) * TAU / 64.0).sin_cos();
                let point = truth.centre + (u * cos + v * sin) * radius;
                EdgePoint { ray: point / point.z, radius, black_inside: true }
            }).collect();
            let start = CirclePose {
                centre: truth.centre * 1.02,
                normal: (truth.normal + u * 0.03 - v * 0.03).normalize(),
            };
            // From afar the mirrored pose looks nearly the same; the better one is the true one.
            let (near, near_rms) = start.refined(&points, &camera).unwrap();
            let (other, other_rms) = near.mirrored().refined(&points, &camera).unwrap();
            let (found, rms) = if near_rms < other_rms { (near, near_rms) } else { (other, other_rms) };
            // Where the two poses look alike, one of 16,000 cases settles early, at 0.007 px.
            prop_assert!(rms < 2e-2, "{rms}");
            prop_assert!((found.centre - truth.centre).norm() < 1e-3 * z);
        }
    }

    #[test]
    fn edges_that_are_all_in_the_black_give_their_offset() {
        let camera = CameraModel::pinhole(1296, 972, 1818.0);
        let truth = pose(0.1, -0.2, 2.0, 0.2, 0.1);
        let (u, v) = truth.basis();
        let points = |into_black_px: f64| -> Vec<EdgePoint> {
            let circles = [(0.0767, true), (0.0614, false), (0.0384, true), (0.023, false)];
            let places = circles.iter().flat_map(|circle| (0..40).map(move |i| (*circle, i)));
            places
                .map(|((radius, black_inside), i)| {
                    let (sin, cos) = (f64::from(i) * TAU / 40.0).sin_cos();
                    let inwards_m = into_black_px * truth.centre.z / camera.fx;
                    let shown = radius + if black_inside { -inwards_m } else { inwards_m };
                    let point = truth.centre + (u * cos + v * sin) * shown;
                    EdgePoint { ray: point / point.z, radius, black_inside }
                })
                .collect()
        };
        for into_black_px in [-0.2, 0.0, 0.4] {
            // Also from a pose whose range is wrong.
            for scale in [1.0, 1.01] {
                let start = CirclePose { centre: truth.centre * scale, ..truth };
                let shift_px = start.shift_into_black_px(&points(into_black_px), &camera).unwrap();
                assert!((shift_px - into_black_px).abs() < 0.03, "{shift_px} {into_black_px}");
            }
        }
        // If edges were so far off by chance, each independently, the circles would be far closer to each other.
        let range_variance =
            |into_black_px| truth.covariance(&points(into_black_px), &camera).unwrap()[(2, 2)];
        let by_chance = (0.4f64 / MIN_EDGE_ERROR_PX).powi(2) * range_variance(0.0);
        assert!(range_variance(0.4) > 10.0 * by_chance);
        let two = points(0.4).into_iter().take(80).collect::<Vec<_>>();
        assert_eq!(truth.shift_into_black_px(&two, &camera), None);
    }

    #[test]
    fn the_marker_faces_the_camera_with_its_y_axis_up() {
        let level = pose(0.1, 0.0, 2.0, 0.0, 0.0).camera_from_marker();
        let up = level.rotation() * geometry::Vector::new(0.0, 1.0, 0.0);
        let face = level.rotation() * geometry::Vector::new(0.0, 0.0, 1.0);
        assert!((up - geometry::Vector::new(0.0, -1.0, 0.0)).norm() < 1e-12);
        assert!((face - geometry::Vector::new(0.0, 0.0, -1.0)).norm() < 1e-12);
    }
}
