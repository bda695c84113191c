//! Removes lens distortion around one marker: converts between pixels and the ideal image, in which straight lines are
//! straight.

use geometry::{CameraModel, Distortion, Pixel, Point};
use nalgebra::{Matrix2, Matrix3, Vector3};

use crate::candidates::quad::middle;
use crate::optics::homography::{CORNERS, Homography};

/// Squares with a shorter side than this, in pixels, are not refined.
const MIN_SIDE_PX: f64 = 4.0;
/// Steps of Newton's method per pixel, all with the slope in the marker's middle; from the ideal image that faces the marker
/// the distortion hardly changes across it, so that each step gains digits.
const MAX_STEPS: usize = 20;
/// The iteration ends at this distance, in pixels.
const CONVERGED_PX: f64 = 1e-3;

/// Maps between the pixels near a marker and the ideal image: that of a camera without distortion which has the same focal
/// length and looks at the marker's middle, as the plane before the camera itself is stretched without bound at the rim of
/// a fisheye's image.
#[derive(Debug)]
pub(crate) struct Undistortion<'a> {
    /// `None` where lines are straight in the image as it is.
    lens: Option<Facing<'a>>,
    /// The marker's middle, the same in the image and in the ideal image.
    middle: Pixel,
    /// Derivatives of the ideal image point by the pixel there.
    jacobian: Matrix2<f64>,
}

/// A camera, and the ideal one that looks at the marker.
#[derive(Debug)]
struct Facing<'a> {
    camera: &'a CameraModel,
    /// The ideal camera's axes, as columns in the camera's frame.
    axes: Matrix3<f64>,
}

impl<'a> Facing<'a> {
    /// `None` where the camera's model gives this pixel no direction.
    fn new(camera: &'a CameraModel, pixel: Pixel) -> Option<Self> {
        let forward = camera.unproject(pixel)?.coords.normalize();
        let right = (Vector3::x() - forward * forward.x).normalize();
        Some(Self { camera, axes: Matrix3::from_columns(&[right, forward.cross(&right), forward]) })
    }

    /// The direction of an ideal image point, in the camera's frame.
    fn ray(&self, ideal: [f64; 2], middle: Pixel) -> Vector3<f64> {
        let x = (ideal[0] - middle.x) / self.camera.fx;
        let y = (ideal[1] - middle.y) / self.camera.fy;
        self.axes * Vector3::new(x, y, 1.0)
    }
}

impl<'a> Undistortion<'a> {
    /// Around these corners. Without a camera, or where its model gives a corner no direction, lines are taken to be straight.
    /// `None` for corners far outside of any image, or where the model gives only their middle no direction.
    pub(crate) fn new(camera: Option<&'a CameraModel>, corners: &[Pixel; 4]) -> Option<Self> {
        if !corners.iter().all(|c| c.x.abs() < 1e6 && c.y.abs() < 1e6) {
            return None;
        }
        let middle = middle(corners);
        let camera = camera.filter(|camera| {
            camera.distortion != Distortion::None
                && corners.iter().all(|corner| camera.unproject(*corner).is_some())
        });
        let mut this = Self { lens: None, middle, jacobian: Matrix2::identity() };
        if let Some(camera) = camera {
            this.lens = Some(Facing::new(camera, middle)?);
            let (_, jacobian) = this.distort([middle.x, middle.y])?;
            this.jacobian = jacobian.try_inverse()?;
        }
        Some(this)
    }

    /// The pixel of an ideal image point, and its derivatives by that point.
    pub(crate) fn distort(&self, ideal: [f64; 2]) -> Option<(Pixel, Matrix2<f64>)> {
        let Some(lens) = &self.lens else {
            return Some((Pixel::new(ideal[0], ideal[1]), Matrix2::identity()));
        };
        let place = Point::from_coords(lens.ray(ideal, self.middle).into());
        let (pixel, by_place) = lens.camera.project_with_jacobian(place)?;
        let mut jacobian = by_place * lens.axes.fixed_columns::<2>(0);
        jacobian.column_mut(0).unscale_mut(lens.camera.fx);
        jacobian.column_mut(1).unscale_mut(lens.camera.fy);
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
        let mut ideal = from([self.middle.x, self.middle.y], pixel, self.middle);
        let Some(lens) = &self.lens else { return Some(ideal) };
        for _ in 0..MAX_STEPS {
            let place = Point::from_coords(lens.ray(ideal, self.middle).into());
            let projected = lens.camera.project(place)?;
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
        let origin = [self.middle.x, self.middle.y];
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

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_4, TAU};

    use super::*;

    fn cameras() -> [CameraModel; 2] {
        let fisheye = Distortion::KannalaBrandt([0.01, -0.008, 0.002, -0.0005]);
        let barrel = Distortion::BrownConrady([-0.28, 0.07, 2e-4, 2e-5, 0.0, 0.0, 0.0, 0.0]);
        [(408.0, fisheye), (900.0, barrel)].map(|(focal_px, distortion)| CameraModel {
            fy: 1.1 * focal_px,
            distortion,
            ..CameraModel::pinhole(1280, 960, focal_px)
        })
    }

    /// Pixels and ideal image points are each other's inverse, and the slopes are those of differences, wherever the
    /// marker is.
    #[test]
    fn the_two_images_and_their_slopes_agree() {
        let mut tried = 0;
        for camera in cameras() {
            for off_axis in [0.0, 0.05, 0.4, 0.8, 1.2] {
                for around in (0..8).map(|i| f64::from(i) * FRAC_PI_4) {
                    let (sin, cos) = f64::sin_cos(off_axis);
                    let ray = Point::new(sin * around.cos(), sin * around.sin(), cos);
                    let Some(middle) = camera.project(ray) else { continue };
                    let corner = |i: u32| {
                        let (sin, cos) = (f64::from(i) * TAU / 4.0 + 0.3).sin_cos();
                        Pixel::new(middle.x + 40.0 * cos, middle.y + 40.0 * sin)
                    };
                    let corners = [0, 1, 2, 3].map(corner);
                    let Some(lens) = Undistortion::new(Some(&camera), &corners) else { continue };
                    for pixel in corners {
                        let Some(ideal) = lens.undistort(pixel) else { continue };
                        let (back, slope) = lens.distort(ideal).unwrap();
                        assert!(back.distance(&pixel) < 2e-3, "{off_axis} {around}");
                        for axis in 0..2 {
                            let mut moved = ideal;
                            moved[axis] += 1e-3;
                            let (moved, _) = lens.distort(moved).unwrap();
                            let by = [(moved.x - back.x) / 1e-3, (moved.y - back.y) / 1e-3];
                            let is_slope = |row: usize| (by[row] - slope[(row, axis)]).abs() < 1e-3;
                            assert!(
                                is_slope(0) && is_slope(1),
                                "{off_axis} {around} {by:?} {slope}"
                            );
                        }
                        tried += 1;
                    }
                }
            }
        }
        assert!(tried > 200, "{tried}");
    }
}
