//! Defines camera models (pinhole, Brown-Conrady, Kannala-Brandt): from points in the camera frame to pixels with derivatives,
//! and from pixels back to rays.
//!
//! Pixel coordinates: the centre of the top-left pixel is (0, 0), x right, y down.

use libm::{atan, fmax, fmin, hypot, tan};
use nalgebra::{Matrix2, Matrix2x3, SMatrix};

use crate::frame::Camera;
use crate::transform::{Point, Vector};

/// A place in the image, in pixels; the centre of the top-left pixel is (0, 0).
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Pixel {
    /// To the right.
    pub x: f64,
    /// Downwards.
    pub y: f64,
}

impl Pixel {
    /// The pixel coordinates (x, y).
    pub fn new(x: f64, y: f64) -> Self {
        Self { x, y }
    }

    /// Euclidean distance in pixels.
    pub fn distance(&self, other: &Self) -> f64 {
        hypot(self.x - other.x, self.y - other.y)
    }
}

/// How a lens bends the ideal image.
#[derive(Copy, Clone, Debug, PartialEq)]
pub enum Distortion {
    /// An ideal pinhole.
    None,
    /// Brown-Conrady, in OpenCV's order k1, k2, p1, p2, k3, k4, k5, k6 (unused ones are 0).
    BrownConrady([f64; 8]),
    /// Kannala-Brandt fisheye, k1 to k4 (OpenCV's `fisheye` module).
    KannalaBrandt([f64; 4]),
}

/// A camera's intrinsics.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct CameraModel {
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Focal length along x, in pixels.
    pub fx: f64,
    /// Focal length along y, in pixels.
    pub fy: f64,
    /// Principal point, x in pixels.
    pub cx: f64,
    /// Principal point, y in pixels.
    pub cy: f64,
    /// The lens.
    pub distortion: Distortion,
}

/// Steps of Newton's method by which a distortion is undone; usual lenses take four.
const UNDISTORT_STEPS: usize = 20;
/// Error that is left, in focal lengths: less than a hundred thousandth of a pixel.
const UNDISTORT_ERROR: f64 = 1e-10;
/// Angle off axis, in radians, at which directions with z = 1 end (just under 90 degrees).
const WIDEST_ANGLE: f64 = 1.57;

impl CameraModel {
    /// An ideal pinhole whose axis meets the middle of the image.
    pub fn pinhole(width: u32, height: u32, focal_px: f64) -> Self {
        Self {
            width,
            height,
            fx: focal_px,
            fy: focal_px,
            cx: (f64::from(width) - 1.0) / 2.0,
            cy: (f64::from(height) - 1.0) / 2.0,
            distortion: Distortion::None,
        }
    }

    /// The pixel at which a point appears; `None` for a point behind the camera or beyond the range of the
    /// lens model: further off axis than where its pixels turn back towards the centre. The pixel may lie outside the image.
    pub fn project(&self, point: Point<Camera>) -> Option<Pixel> {
        if !point.is_finite() || point.z() <= 1e-9 {
            return None;
        }
        let (x, y) = (point.x() / point.z(), point.y() / point.z());
        if !self.distortion.describes(x, y) {
            return None;
        }
        let (u, v) = self.distortion.distort(x, y);
        Some(Pixel::new(self.fx * u + self.cx, self.fy * v + self.cy))
    }

    /// As [`CameraModel::project`], with the derivative of the pixel by the point, in pixels per metre.
    pub fn project_with_jacobian(&self, point: Point<Camera>) -> Option<(Pixel, Matrix2x3<f64>)> {
        let pixel = self.project(point)?;
        let (x, y) = (point.x() / point.z(), point.y() / point.z());
        let ideal = Matrix2x3::new(1.0, 0.0, -x, 0.0, 1.0, -y) / point.z();
        let focal = Matrix2::new(self.fx, 0.0, 0.0, self.fy);
        let jacobian = focal * self.distortion.jacobian(x, y) * ideal;
        jacobian.iter().all(|j| j.is_finite()).then_some((pixel, jacobian))
    }

    /// The derivative of a point's pixel by fx, fy, cx, cy and the lens's numbers in their order (those that it has not are
    /// zero); `None` where [`CameraModel::project`] gives none.
    pub fn intrinsics_jacobian(&self, point: Point<Camera>) -> Option<SMatrix<f64, 2, 12>> {
        self.project(point)?;
        let (x, y) = (point.x() / point.z(), point.y() / point.z());
        let (u, v) = self.distortion.distort(x, y);
        let mut jacobian = SMatrix::zeros();
        (jacobian[(0, 0)], jacobian[(1, 1)]) = (u, v);
        (jacobian[(0, 2)], jacobian[(1, 3)]) = (1.0, 1.0);
        for (i, [by_u, by_v]) in self.distortion.parameter_slopes(x, y).into_iter().enumerate() {
            (jacobian[(0, 4 + i)], jacobian[(1, 4 + i)]) = (self.fx * by_u, self.fy * by_v);
        }
        Some(jacobian)
    }

    /// The direction of a pixel's ray, with z = 1; `None` where no direction in front of the camera that the
    /// lens model describes gives this pixel, and for a fisheye's pixels from 90 degrees off axis on.
    pub fn unproject(&self, pixel: Pixel) -> Option<Vector<Camera>> {
        let (u, v) = ((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy);
        let (x, y) = self.distortion.undistort(u, v)?;
        Some(Vector::new(x, y, 1.0))
    }

    /// As [`CameraModel::unproject`]; where there is none, the outermost direction on the line to the pixel.
    pub fn unproject_clamped(&self, pixel: Pixel) -> Vector<Camera> {
        if let Some(ray) = self.unproject(pixel) {
            return ray;
        }
        let mut outermost = Vector::new(0.0, 0.0, 1.0);
        let (mut within, mut beyond) = (0.0, 1.0);
        for _ in 0..24 {
            let share = (within + beyond) / 2.0;
            let between = |middle: f64, end: f64| middle + (end - middle) * share;
            match self.unproject(Pixel::new(between(self.cx, pixel.x), between(self.cy, pixel.y))) {
                Some(ray) => (within, outermost) = (share, ray),
                None => beyond = share,
            }
        }
        outermost
    }

    /// True when a pixel lies within the image's outer pixel borders.
    pub fn contains(&self, pixel: Pixel) -> bool {
        pixel.x >= -0.5
            && pixel.y >= -0.5
            && pixel.x <= f64::from(self.width) - 0.5
            && pixel.y <= f64::from(self.height) - 0.5
    }
}

impl Distortion {
    /// From ideal to distorted normalised coordinates.
    fn distort(&self, x: f64, y: f64) -> (f64, f64) {
        match *self {
            Self::None => (x, y),
            Self::BrownConrady(k) => {
                let (radial, dx, dy) = brown_conrady(&k, x, y);
                (x * radial + dx, y * radial + dy)
            }
            Self::KannalaBrandt(k) => {
                let r = hypot(x, y);
                if r < 1e-12 {
                    return (x, y);
                }
                let scale = fisheye_angle(&k, atan(r)) / r;
                (x * scale, y * scale)
            }
        }
    }

    /// Derivative of the distorted by the ideal normalised coordinates.
    fn jacobian(&self, x: f64, y: f64) -> Matrix2<f64> {
        match *self {
            Self::None => Matrix2::identity(),
            Self::BrownConrady(k) => {
                let [k1, k2, p1, p2, k3, k4, k5, k6] = k;
                let r2 = x * x + y * y;
                let above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
                let below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
                let above_slope = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3);
                let below_slope = k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6);
                let radial = above / below;
                // By r squared, whose own derivatives are 2 x and 2 y.
                let slope = 2.0 * (above_slope - radial * below_slope) / below;
                let across = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y;
                Matrix2::new(
                    radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
                    across,
                    across,
                    radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
                )
            }
            Self::KannalaBrandt(k) => {
                let r = hypot(x, y);
                if r < 1e-9 {
                    return Matrix2::identity();
                }
                let (c, s, theta) = (x / r, y / r, atan(r));
                let along = fisheye_slope(&k, theta) / (1.0 + r * r);
                let around = fisheye_angle(&k, theta) / r;
                let mixed = (along - around) * c * s;
                Matrix2::new(
                    along * c * c + around * s * s,
                    mixed,
                    mixed,
                    along * s * s + around * c * c,
                )
            }
        }
    }

    /// Derivatives of the distorted normalised coordinates by each of the lens's numbers.
    fn parameter_slopes(&self, x: f64, y: f64) -> [[f64; 2]; 8] {
        let mut slopes = [[0.0; 2]; 8];
        match *self {
            Self::None => {}
            Self::BrownConrady(k) => {
                let [k1, k2, _, _, k3, k4, k5, k6] = k;
                let r2 = x * x + y * y;
                let above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
                let below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
                let powers = [(r2, 0, 5), (r2 * r2, 1, 6), (r2 * r2 * r2, 4, 7)];
                for (power, numerator, denominator) in powers {
                    let power = power / below;
                    slopes[numerator] = [x * power, y * power];
                    let slope = -power * above / below;
                    slopes[denominator] = [x * slope, y * slope];
                }
                slopes[2] = [2.0 * x * y, r2 + 2.0 * y * y];
                slopes[3] = [r2 + 2.0 * x * x, 2.0 * x * y];
            }
            Self::KannalaBrandt(_) => {
                let r = hypot(x, y);
                if r < 1e-12 {
                    return slopes;
                }
                let theta = atan(r);
                let mut power = theta;
                for slope in slopes.iter_mut().take(4) {
                    power *= theta * theta;
                    *slope = [x / r * power, y / r * power];
                }
            }
        }
        slopes
    }

    /// From distorted to ideal normalised coordinates; `None` for coordinates outside the model's range.
    fn undistort(&self, u: f64, v: f64) -> Option<(f64, f64)> {
        let (x, y) = match *self {
            Self::None => (u, v),
            Self::BrownConrady(_) => self.undistort_by_newton(u, v)?,
            Self::KannalaBrandt(k) => {
                let distorted = hypot(u, v);
                if distorted < 1e-12 {
                    return Some((u, v));
                }
                let mut theta = fmin(distorted, WIDEST_ANGLE);
                for _ in 0..UNDISTORT_STEPS {
                    let error = fisheye_angle(&k, theta) - distorted;
                    theta = (theta - error / fisheye_slope(&k, theta)).clamp(0.0, WIDEST_ANGLE);
                    if error.abs() < UNDISTORT_ERROR {
                        break;
                    }
                }
                if (fisheye_angle(&k, theta) - distorted).abs() > 10.0 * UNDISTORT_ERROR {
                    return None;
                }
                let scale = tan(theta) / distorted;
                (u * scale, v * scale)
            }
        };
        (x.is_finite() && y.is_finite() && self.describes(x, y)).then_some((x, y))
    }

    fn undistort_by_newton(&self, u: f64, v: f64) -> Option<(f64, f64)> {
        let (mut x, mut y) = (u, v);
        for _ in 0..UNDISTORT_STEPS {
            let (du, dv) = self.distort(x, y);
            let (eu, ev) = (u - du, v - dv);
            if fmax(eu.abs(), ev.abs()) < UNDISTORT_ERROR {
                return Some((x, y));
            }
            let j = self.jacobian(x, y);
            let determinant = j[(0, 0)] * j[(1, 1)] - j[(0, 1)] * j[(1, 0)];
            let dx = (j[(1, 1)] * eu - j[(0, 1)] * ev) / determinant;
            let dy = (j[(0, 0)] * ev - j[(1, 0)] * eu) / determinant;
            // Near the end of the model's reach steps become too long.
            let limit = (0.5 + 0.5 * hypot(x, y)) / fmax(hypot(dx, dy), 1e-12);
            let share = fmin(limit, 1.0);
            (x, y) = (x + dx * share, y + dy * share);
        }
        None
    }

    /// Whether the distance from the middle grows with the angle off axis all the way to this place.
    fn describes(&self, x: f64, y: f64) -> bool {
        const SHARES: [f64; 4] = [0.25, 0.5, 0.75, 1.0];
        match *self {
            Self::None => true,
            Self::BrownConrady(k) => {
                let r2 = x * x + y * y;
                SHARES.iter().all(|share| brown_conrady_slope(&k, share * r2) > 0.0)
            }
            Self::KannalaBrandt(k) => {
                let theta = atan(hypot(x, y));
                SHARES.iter().all(|share| fisheye_slope(&k, share * theta) > 0.0)
            }
        }
    }
}

/// Radial factor and tangential offsets at ideal coordinates.
fn brown_conrady(k: &[f64; 8], x: f64, y: f64) -> (f64, f64, f64) {
    let [k1, k2, p1, p2, k3, k4, k5, k6] = *k;
    let r2 = x * x + y * y;
    let radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)));
    let dx = 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
    let dy = p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
    (radial, dx, dy)
}

/// How the distorted distance from the middle changes with the ideal one, tangential parts left out, at the square of
/// the latter.
fn brown_conrady_slope(k: &[f64; 8], r2: f64) -> f64 {
    let [k1, k2, _, _, k3, k4, k5, k6] = *k;
    let above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
    let below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
    let above_slope = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3);
    let below_slope = k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6);
    (above * below + 2.0 * r2 * (above_slope * below - above * below_slope)) / (below * below)
}

fn fisheye_angle(k: &[f64; 4], theta: f64) -> f64 {
    let t2 = theta * theta;
    theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
}

fn fisheye_slope(k: &[f64; 4], theta: f64) -> f64 {
    let t2 = theta * theta;
    1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3])))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn models() -> [CameraModel; 3] {
        let pinhole = CameraModel::pinhole(1296, 972, 1818.0);
        [
            pinhole,
            CameraModel {
                distortion: Distortion::BrownConrady([
                    -0.28, 0.07, 0.0002, 0.00002, 0.0, 0.0, 0.0, 0.0,
                ]),
                ..pinhole
            },
            CameraModel {
                fx: 620.0,
                fy: 620.0,
                distortion: Distortion::KannalaBrandt([-0.01, 0.03, -0.02, 0.004]),
                ..pinhole
            },
        ]
    }

    proptest! {
        #[test]
        fn a_pixel_comes_back_from_its_direction(x in 0.0..1295.0f64, y in 0.0..971.0f64) {
            for model in models() {
                let ray = model.unproject_clamped(Pixel::new(x, y));
                let pixel = model.project(Point::new(ray.x() * 3.0, ray.y() * 3.0, 3.0)).unwrap();
                prop_assert!(pixel.distance(&Pixel::new(x, y)) < 1e-6, "{model:?} {pixel:?}");
            }
        }
    }

    proptest! {
        #[test]
        fn the_jacobian_is_the_slope_of_the_projection(
            x in -0.35..0.35f64, y in -0.25..0.25f64, z in 0.3..20.0f64,
        ) {
            let rational = Distortion::BrownConrady([0.3, -0.1, 1e-3, -2e-3, 0.02, 0.4, 0.05, 0.01]);
            let rational = CameraModel { distortion: rational, ..models()[0] };
            for model in models().into_iter().chain([rational]) {
                let at = |d: [f64; 3]| {
                    model.project(Point::new(x * z + d[0], y * z + d[1], z + d[2])).unwrap()
                };
                let (_, jacobian) = model.project_with_jacobian(Point::new(x * z, y * z, z)).unwrap();
                for axis in 0..3 {
                    let step = 1e-5 * z;
                    let (mut ahead, mut behind) = ([0.0; 3], [0.0; 3]);
                    (ahead[axis], behind[axis]) = (step, -step);
                    let (ahead, behind) = (at(ahead), at(behind));
                    let slope = [ahead.x - behind.x, ahead.y - behind.y].map(|d| d / (2.0 * step));
                    for row in 0..2 {
                        let error = (jacobian[(row, axis)] - slope[row]).abs();
                        prop_assert!(error < 1e-4 * model.fx / z, "{model:?} {jacobian} {slope:?}");
                    }
                }
            }
        }
    }

    proptest! {
        #[test]
        fn the_jacobian_by_the_intrinsics_is_the_slope_by_each(
            x in -0.35..0.35f64, y in -0.25..0.25f64, z in 0.3..20.0f64,
        ) {
            let rational = Distortion::BrownConrady([0.3, -0.1, 1e-3, -2e-3, 0.02, 0.4, 0.05, 0.01]);
            let rational = CameraModel { distortion: rational, ..models()[0] };
            let point = Point::new(x * z, y * z, z);
            for model in models().into_iter().chain([rational]) {
                let jacobian = model.intrinsics_jacobian(point).unwrap();
                for parameter in 0..12 {
                    let at = |step: f64| {
                        let mut moved = model;
                        let step = if parameter < 4 { step * 100.0 } else { step };
                        match (parameter, &mut moved.distortion) {
                            (0, _) => moved.fx += step,
                            (1, _) => moved.fy += step,
                            (2, _) => moved.cx += step,
                            (3, _) => moved.cy += step,
                            (_, Distortion::BrownConrady(k)) => k[parameter - 4] += step,
                            (4..8, Distortion::KannalaBrandt(k)) => k[parameter - 4] += step,
                            _ => {}
                        }
                        moved.project(point).unwrap()
                    };
                    let scale = if parameter < 4 { 2e-4 } else { 2e-6 };
                    let (ahead, behind) = (at(1e-6), at(-1e-6));
                    for (row, slope) in [ahead.x - behind.x, ahead.y - behind.y].into_iter().enumerate() {
                        let error = (jacobian[(row, parameter)] - slope / scale).abs();
                        prop_assert!(error < 1e-4, "{model:?} {parameter}: {jacobian} {slope}");
                    }
                }
            }
        }
    }

    #[test]
    fn the_thesis_camera_sees_a_metre_to_the_right_at_ten_metres() {
        let pixel = models()[0].project(Point::new(1.0, 0.0, 10.0)).unwrap();
        assert!(pixel.distance(&Pixel::new(647.5 + 181.8, 485.5)) < 1e-9);
    }

    /// Values of OpenCV 5.0 (`projectPoints` and `fisheye::projectPoints`) for the same points.
    #[test]
    fn lenses_are_those_of_opencv() {
        let points = [
            [0.1, 0.2, 1.0],
            [-0.5, 0.3, 1.2],
            [0.6, -0.45, 0.9],
            [-1.0, -0.8, 1.5],
            [0.0, 0.0, 2.0],
        ];
        let five = Distortion::BrownConrady([-0.28, 0.07, 2e-4, -3e-5, 0.01, 0.0, 0.0, 0.0]);
        let eight = Distortion::BrownConrady([0.3, -0.1, 1e-3, -2e-3, 0.02, 0.4, 0.05, 0.01]);
        let fisheye = Distortion::KannalaBrandt([-0.01, 0.03, -0.02, 0.004]);
        let expected = [
            (
                five,
                [
                    [383.305_291_25, 370.905_332_75],
                    [65.140_753_768, 395.336_275_681],
                    [684.236_100_594, -34.102_315_102],
                    [-43.427_435_011, -50.526_558_877],
                    [319.2, 241.7],
                ],
            ),
            (
                eight,
                [
                    [383.792_597_528, 372.042_677_325],
                    [55.331_577_617, 401.207_977_131],
                    [704.082_421_107, -49.409_721_892],
                    [-67.029_396_747, -68.419_015_907],
                    [319.2, 241.7],
                ],
            ),
            (
                fisheye,
                [
                    [383.121_451_371, 370.526_309_685],
                    [67.333_989_177, 393.982_065_006],
                    [680.511_046_975, -31.367_772_041],
                    [-39.567_376_948, -47.521_700_801],
                    [319.2, 241.7],
                ],
            ),
        ];
        for (distortion, pixels) in expected {
            let camera = CameraModel {
                width: 640,
                height: 480,
                fx: 650.0,
                fy: 655.0,
                cx: 319.2,
                cy: 241.7,
                distortion,
            };
            for ([x, y, z], [u, v]) in points.into_iter().zip(pixels) {
                let expected = Pixel::new(u, v);
                let found = camera.project(Point::new(x, y, z)).unwrap();
                assert!(found.distance(&expected) < 1e-7, "{found:?} {expected:?}");
                let ray = camera.unproject(expected).unwrap();
                assert!((ray.x() - x / z).hypot(ray.y() - y / z) < 1e-8, "{ray:?}");
            }
        }
    }

    /// A calibration that was fitted too closely: its pixels turn back within the image.
    #[test]
    fn a_lens_model_gives_no_result_beyond_its_range() {
        let distortion = Distortion::BrownConrady([
            -0.040062, 2.499804, 0.005404, -0.000658, -13.76708, 0.0, 0.0, 0.0,
        ]);
        let camera = CameraModel {
            fx: 770.502,
            fy: 769.174,
            distortion,
            ..CameraModel::pinhole(816, 612, 770.0)
        };
        assert!(camera.unproject(Pixel::new(700.0, 305.0)).is_some());
        assert_eq!(camera.unproject(Pixel::new(1500.0, 305.0)), None);
        assert_eq!(camera.project(Point::new(0.7, 0.0, 1.0)), None);
        let outermost = camera.unproject_clamped(Pixel::new(1500.0, 305.0));
        assert!((0.4..0.7).contains(&outermost.x()), "{outermost:?}");
        assert!(outermost.y().abs() < 0.1);
        let fisheye = CameraModel { distortion: Distortion::KannalaBrandt([0.0; 4]), ..camera };
        assert_eq!(fisheye.unproject(Pixel::new(408.0 + 770.5 * 1.6, 305.0)), None);
        for model in [camera, fisheye] {
            assert_eq!(model.unproject(Pixel::new(f64::NAN, 3.0)), None);
            assert!(model.unproject_clamped(Pixel::new(f64::INFINITY, 3.0)).is_finite());
        }
    }

    #[test]
    fn points_behind_the_camera_have_no_pixel() {
        for z in [0.0, -1.0, f64::NAN] {
            assert!(models()[0].project(Point::new(0.0, 0.0, z)).is_none());
        }
    }
}
