//! Lens distortion around one marker: between pixels and the ideal image, in which straight lines are
//! straight.

use geometry::{CameraModel, Distortion, Pixel, Point};
use nalgebra::Matrix2;

use crate::candidates::quad::middle;
use crate::optics::homography::{CORNERS, Homography};

/// Squares with a shorter side than this, in pixels, are not refined.
const MIN_SIDE_PX: f64 = 4.0;
/// Newton steps per pixel; the distortion hardly changes across a marker, so that each step gains digits.
const MAX_STEPS: usize = 20;
/// The iteration ends at this distance, in pixels.
const CONVERGED_PX: f64 = 1e-3;

/// Maps between the pixels near a marker and the ideal image, which has the same focal length and no
/// distortion.
#[derive(Debug)]
pub(crate) struct Undistortion<'a> {
    /// `None` where lines are straight in the image as it is.
    camera: Option<&'a CameraModel>,
    /// The marker's middle, and its place in the ideal image.
    pixel: Pixel,
    ideal: [f64; 2],
    /// Derivatives of the ideal image point by the pixel there.
    jacobian: Matrix2<f64>,
}

impl<'a> Undistortion<'a> {
    /// Around these corners. Without a camera, or where its model is not defined, lines are taken to be
    /// straight.
    pub(crate) fn new(camera: Option<&'a CameraModel>, corners: &[Pixel; 4]) -> Option<Self> {
        if !corners.iter().all(|c| c.x.abs() < 1e6 && c.y.abs() < 1e6) {
            return None;
        }
        let pixel = middle(corners);
        let camera = camera.filter(|camera| {
            camera.distortion != Distortion::None
                && corners.iter().all(|corner| camera.unproject(*corner).is_some())
        });
        let ideal = [pixel.x, pixel.y];
        let mut this = Self { camera, pixel, ideal, jacobian: Matrix2::identity() };
        if let Some(camera) = camera {
            let ray = camera.unproject(pixel)?;
            this.ideal = [camera.fx * ray.x() + camera.cx, camera.fy * ray.y() + camera.cy];
            let (_, jacobian) = this.distort(this.ideal)?;
            this.jacobian = jacobian.try_inverse()?;
        }
        Some(this)
    }

    /// The pixel of an ideal image point, and its derivatives by that point.
    pub(crate) fn distort(&self, ideal: [f64; 2]) -> Option<(Pixel, Matrix2<f64>)> {
        let Some(camera) = self.camera else {
            return Some((Pixel::new(ideal[0], ideal[1]), Matrix2::identity()));
        };
        let ray = [(ideal[0] - camera.cx) / camera.fx, (ideal[1] - camera.cy) / camera.fy];
        let (pixel, by_ray) = camera.project_with_jacobian(Point::new(ray[0], ray[1], 1.0))?;
        let jacobian = Matrix2::new(
            by_ray[(0, 0)] / camera.fx,
            by_ray[(0, 1)] / camera.fy,
            by_ray[(1, 0)] / camera.fx,
            by_ray[(1, 1)] / camera.fy,
        );
        Some((pixel, jacobian))
    }

    /// The ideal image point of a pixel near the marker.
    #[inline]
    pub(crate) fn undistort(&self, pixel: Pixel) -> Option<[f64; 2]> {
        let slope = &self.jacobian;
        let from = |to: [f64; 2], pixel: Pixel, other: Pixel| {
            let (dx, dy) = (pixel.x - other.x, pixel.y - other.y);
            [
                to[0] + slope[(0, 0)] * dx + slope[(0, 1)] * dy,
                to[1] + slope[(1, 0)] * dx + slope[(1, 1)] * dy,
            ]
        };
        let mut ideal = from(self.ideal, pixel, self.pixel);
        let Some(camera) = self.camera else { return Some(ideal) };
        for _ in 0..MAX_STEPS {
            let ray = [(ideal[0] - camera.cx) / camera.fx, (ideal[1] - camera.cy) / camera.fy];
            let projected = camera.project(Point::new(ray[0], ray[1], 1.0))?;
            let error = (pixel.x - projected.x).abs() + (pixel.y - projected.y).abs();
            ideal = from(ideal, pixel, projected);
            if error < CONVERGED_PX {
                return Some(ideal);
            }
        }
        None
    }

    /// Derivatives of the ideal image point by the pixel, in the marker's middle.
    pub(crate) fn jacobian(&self) -> &Matrix2<f64> {
        &self.jacobian
    }

    /// The homography from the square to the ideal image by the square's corners; `None` where no square
    /// looks so.
    pub(crate) fn homography(&self, corners: &[Pixel; 4]) -> Option<Homography> {
        let origin = self.ideal;
        let mut relative = [[0.0; 2]; CORNERS.len()];
        for (relative, corner) in relative.iter_mut().zip(corners) {
            let [x, y] = self.undistort(*corner)?;
            *relative = [x - origin[0], y - origin[1]];
        }
        let homography = Homography { origin, ..Homography::from_square([-1.0, 1.0], &relative)? };
        (homography.is_valid() && homography.shortest_side_px() >= MIN_SIDE_PX)
            .then_some(homography)
    }
}
