//! Camera models: from the camera frame to pixels and back.
//!
//! Pixel coordinates: the centre of the top-left pixel is (0, 0), x right, y down.

use nalgebra::{Matrix2, Matrix2x3};

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
        (self.x - other.x).hypot(self.y - other.y)
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

/// Iterations of the fixed-point inversion of a distortion; each gains about a digit for usual lenses.
const UNDISTORT_ITERATIONS: usize = 30;

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

    /// The pixel at which a point appears; `None` for a point behind the camera or beyond what the lens model
    /// describes. The pixel may lie outside the image.
    pub fn project(&self, point: Point<Camera>) -> Option<Pixel> {
        if !point.is_finite() || point.z() <= 1e-9 {
            return None;
        }
        let (u, v) = self.distort(point.x() / point.z(), point.y() / point.z());
        Some(Pixel::new(self.fx * u + self.cx, self.fy * v + self.cy))
    }

    /// As [`CameraModel::project`], with the derivative of the pixel by the point, in pixels per metre.
    pub fn project_with_jacobian(&self, point: Point<Camera>) -> Option<(Pixel, Matrix2x3<f64>)> {
        let pixel = self.project(point)?;
        let (x, y) = (point.x() / point.z(), point.y() / point.z());
        let ideal = Matrix2x3::new(1.0, 0.0, -x, 0.0, 1.0, -y) / point.z();
        let focal = Matrix2::new(self.fx, 0.0, 0.0, self.fy);
        let jacobian = focal * self.distortion_jacobian(x, y) * ideal;
        jacobian.iter().all(|j| j.is_finite()).then_some((pixel, jacobian))
    }

    /// The direction in which a pixel looks, with z = 1. A fisheye's pixels beyond 90 degrees off axis, which no
    /// such direction reaches, give the widest one.
    pub fn unproject(&self, pixel: Pixel) -> Vector<Camera> {
        let (x, y) = self.undistort((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy);
        Vector::new(x, y, 1.0)
    }

    /// True when a pixel lies within the image's outer pixel borders.
    pub fn contains(&self, pixel: Pixel) -> bool {
        pixel.x >= -0.5
            && pixel.y >= -0.5
            && pixel.x <= f64::from(self.width) - 0.5
            && pixel.y <= f64::from(self.height) - 0.5
    }

    /// From ideal to distorted normalised coordinates.
    fn distort(&self, x: f64, y: f64) -> (f64, f64) {
        match self.distortion {
            Distortion::None => (x, y),
            Distortion::BrownConrady(k) => {
                let (radial, dx, dy) = brown_conrady(&k, x, y);
                (x * radial + dx, y * radial + dy)
            }
            Distortion::KannalaBrandt(k) => {
                let r = x.hypot(y);
                if r < 1e-12 {
                    return (x, y);
                }
                let scale = fisheye_angle(&k, r.atan()) / r;
                (x * scale, y * scale)
            }
        }
    }

    /// Derivative of the distorted by the ideal normalised coordinates.
    fn distortion_jacobian(&self, x: f64, y: f64) -> Matrix2<f64> {
        match self.distortion {
            Distortion::None => Matrix2::identity(),
            Distortion::BrownConrady(k) => {
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
            Distortion::KannalaBrandt(k) => {
                let r = x.hypot(y);
                if r < 1e-9 {
                    return Matrix2::identity();
                }
                let (c, s, theta) = (x / r, y / r, r.atan());
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

    /// From distorted to ideal normalised coordinates.
    fn undistort(&self, u: f64, v: f64) -> (f64, f64) {
        match self.distortion {
            Distortion::None => (u, v),
            Distortion::BrownConrady(k) => {
                let (mut x, mut y) = (u, v);
                for _ in 0..UNDISTORT_ITERATIONS {
                    let (radial, dx, dy) = brown_conrady(&k, x, y);
                    (x, y) = ((u - dx) / radial, (v - dy) / radial);
                }
                (x, y)
            }
            Distortion::KannalaBrandt(k) => {
                let distorted = u.hypot(v);
                if distorted < 1e-12 {
                    return (u, v);
                }
                let mut theta = distorted;
                for _ in 0..UNDISTORT_ITERATIONS {
                    theta -= (fisheye_angle(&k, theta) - distorted) / fisheye_slope(&k, theta);
                }
                let scale = theta.clamp(0.0, WIDEST_ANGLE).tan() / distorted;
                (u * scale, v * scale)
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
                let ray = model.unproject(Pixel::new(x, y));
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

    #[test]
    fn the_thesis_camera_sees_a_metre_to_the_right_at_ten_metres() {
        let pixel = models()[0].project(Point::new(1.0, 0.0, 10.0)).unwrap();
        assert!(pixel.distance(&Pixel::new(647.5 + 181.8, 485.5)) < 1e-9);
    }

    #[test]
    fn points_behind_the_camera_have_no_pixel() {
        for z in [0.0, -1.0, f64::NAN] {
            assert!(models()[0].project(Point::new(0.0, 0.0, z)).is_none());
        }
    }
}
