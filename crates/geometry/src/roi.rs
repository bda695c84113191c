//! Converts between a frame and a region of it that is used as an image.

use crate::camera::{CameraModel, Pixel};

/// A region of interest: a rectangle of a frame, maybe scaled down. It is the image of a camera at the same place and in the
/// same orientation, so poses in it are those of the frame; only values in pixels are mapped.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Roi {
    /// The frame's pixel at the centre of the region's first pixel.
    pub origin: Pixel,
    /// Width in the region's own pixels.
    pub width: u32,
    /// Height in the region's own pixels.
    pub height: u32,
    /// Pixels of the frame along the edge of a pixel of the region.
    pub scale: f64,
}

impl Roi {
    /// The region whose first pixel is the frame's pixel in column `left` and row `top`, in pixels of the frame.
    pub fn cropped(left: f64, top: f64, width: u32, height: u32) -> Self {
        Self::binned(left, top, width, height, 1.0)
    }

    /// The region from column `left` and row `top` on, each of its pixels the mean of `scale` x `scale` pixels.
    pub fn binned(left: f64, top: f64, width: u32, height: u32, scale: f64) -> Self {
        let half = (scale - 1.0) / 2.0;
        Self { origin: Pixel::new(left + half, top + half), width, height, scale }
    }

    /// The frame's pixel at a pixel of the region.
    pub fn to_frame(&self, pixel: Pixel) -> Pixel {
        Pixel::new(self.origin.x + self.scale * pixel.x, self.origin.y + self.scale * pixel.y)
    }

    /// The camera whose image the region is, of a camera whose image the frame is.
    pub fn camera(&self, camera: &CameraModel) -> CameraModel {
        CameraModel {
            width: self.width,
            height: self.height,
            fx: camera.fx / self.scale,
            fy: camera.fy / self.scale,
            cx: (camera.cx - self.origin.x) / self.scale,
            cy: (camera.cy - self.origin.y) / self.scale,
            ..*camera
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transform::Point;

    #[test]
    fn a_regions_camera_sees_the_same_directions() {
        let camera = CameraModel::pinhole(640, 480, 500.0);
        let roi = Roi::binned(160.0, 80.0, 120, 100, 2.0);
        let own = roi.camera(&camera);
        let point = Point::new(-0.3, 0.2, 2.0);
        let (whole, own) = (camera.project(point).unwrap(), own.project(point).unwrap());
        assert!((whole.x - (160.5 + 2.0 * own.x)).abs() < 1e-9);
        assert!((whole.y - (80.5 + 2.0 * own.y)).abs() < 1e-9);
        assert!(roi.to_frame(own).distance(&whole) < 1e-9);
    }
}
