//! Resamples a camera's grey images as one without lens distortion would have taken them, of the same size, focal lengths and
//! principal point.

use geometry::{CameraModel, Distortion, Pixel, Point};
use imaging::GrayView;
use imaging::sample::bilinear;

/// Takes the distortion out of a camera's images.
#[derive(Clone, Debug)]
pub struct Rectifier {
    camera: CameraModel,
    straight: CameraModel,
    /// Where in the camera's image each pixel is, row by row; not a number where it shows nothing.
    places: Vec<[f32; 2]>,
}

impl Rectifier {
    /// To images of the same size with the same focal lengths and principal point, as ROS' `projection_matrix` of one camera.
    pub fn new(camera: &CameraModel) -> Self {
        let straight = CameraModel { distortion: Distortion::None, ..*camera };
        let CameraModel { width, height, .. } = straight;
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| [x, y].map(f64::from)));
        let place = |[x, y]: [f64; 2]| {
            let ray = straight.unproject(Pixel::new(x, y))?;
            camera.project(Point::from_coords(ray.coords.into()))
        };
        let places = pixels
            .map(|pixel| place(pixel).map_or([f32::NAN; 2], |at| [at.x as f32, at.y as f32]))
            .collect();
        Self { camera: *camera, straight, places }
    }

    /// The camera whose images are taken.
    pub fn camera(&self) -> &CameraModel {
        &self.camera
    }

    /// The camera whose images come out.
    pub fn straight(&self) -> &CameraModel {
        &self.straight
    }

    /// Writes the image without distortion, row by row; black where the camera saw nothing. False, and nothing is written, when
    /// the image or the output is not of the camera's size.
    #[must_use]
    pub fn rectify(&self, view: GrayView<'_>, out: &mut [u8]) -> bool {
        let size = [self.camera.width as usize, self.camera.height as usize];
        if [view.width(), view.height()] != size || out.len() != self.places.len() {
            return false;
        }
        for (level, [x, y]) in out.iter_mut().zip(&self.places) {
            // The cast rounds after a half is added, and converts NaN to black.
            *level = bilinear(view, f64::from(*x), f64::from(*y)).map_or(0, |it| (it + 0.5) as u8);
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use imaging::GrayImage;

    fn camera(distortion: Distortion) -> CameraModel {
        CameraModel { distortion, cy: 51.0, ..CameraModel::pinhole(160, 120, 130.0) }
    }

    /// A straight slope of grey across the scene, as the camera shows it.
    fn slope(camera: &CameraModel) -> GrayImage {
        let mut image = GrayImage::filled(160, 120, 0);
        for (i, level) in image.pixels_mut().iter_mut().enumerate() {
            let pixel = Pixel::new((i % 160) as f64, (i / 160) as f64);
            if let Some(ray) = camera.unproject(pixel) {
                *level = (120.0 + 110.0 * ray.x() + 60.0 * ray.y()).round() as u8;
            }
        }
        image
    }

    #[test]
    fn straight_lines_of_the_scene_are_straight_in_the_image() {
        for lens in [
            Distortion::BrownConrady([-0.3, 0.1, 1e-3, -1e-3, 0.0, 0.0, 0.0, 0.0]),
            Distortion::KannalaBrandt([0.02, -0.01, 0.0, 0.0]),
        ] {
            let rectifier = Rectifier::new(&camera(lens));
            let mut out = vec![0; 160 * 120];
            assert!(rectifier.rectify(slope(rectifier.camera()).view().unwrap(), &mut out));
            let straight = slope(rectifier.straight());
            let mut compared = 0;
            for (level, expected) in
                out.iter().zip(straight.pixels()).filter(|(level, _)| **level > 0)
            {
                assert!(level.abs_diff(*expected) <= 1, "{level} {expected}");
                compared += 1;
            }
            // The barrel's corners lie outside of the straight image, and none of it is black.
            assert!(compared > 160 * 120 * 9 / 10, "{compared}");
        }
    }

    #[test]
    fn images_of_another_size_are_refused() {
        let rectifier = Rectifier::new(&camera(Distortion::None));
        let small = GrayImage::filled(80, 60, 9);
        assert!(!rectifier.rectify(small.view().unwrap(), &mut [0; 160 * 120]));
        let image = GrayImage::filled(160, 120, 9);
        assert!(!rectifier.rectify(image.view().unwrap(), &mut [0; 80 * 60]));
        let mut out = vec![0; 160 * 120];
        assert!(rectifier.rectify(image.view().unwrap(), &mut out));
        assert!(out.iter().all(|level| *level == 9));
    }
}
