//! Defines modes of a camera: which part of the sensor its images show, and how many pixels of the sensor are one of theirs.

use geometry::{CameraModel, Roi};

/// Maximum binning; sensors have 8 at most.
pub(super) const MAX_BINNING: u32 = 64;

/// A rectangle of a sensor, in its pixels.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct SensorRegion {
    /// The first column.
    pub left: u32,
    /// The first row.
    pub top: u32,
    /// How many columns.
    pub width: u32,
    /// How many rows.
    pub height: u32,
}

impl SensorRegion {
    /// All of a sensor.
    pub fn whole(width: u32, height: u32) -> Self {
        Self { left: 0, top: 0, width, height }
    }

    /// Whether it has pixels, and all of them lie in the other.
    pub fn lies_in(&self, other: &Self) -> bool {
        let within = |start: u32, edge: u32, outer: u32, outer_edge: u32| {
            edge > 0
                && start >= outer
                && u64::from(start) + u64::from(edge) <= u64::from(outer) + u64::from(outer_edge)
        };
        within(self.left, self.width, other.left, other.width)
            && within(self.top, self.height, other.top, other.height)
    }
}

impl std::fmt::Display for SensorRegion {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { left, top, width, height } = self;
        write!(f, "{width} x {height} from column {left} and row {top}")
    }
}

/// How a camera's images come from its sensor.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct SensorMode {
    /// The part of the sensor that is read.
    pub region: SensorRegion,
    /// One pixel of an image is the mean or the sum of so many pixels, across and down.
    pub binning: u32,
}

impl SensorMode {
    /// The images' size; pixels that fill no bin are left out.
    pub fn image_px(&self) -> [u32; 2] {
        [self.region.width, self.region.height].map(|edge| edge / self.binning.max(1))
    }

    /// The camera of the whole sensor, of that of the images in this mode.
    pub(super) fn of_sensor(&self, image: &CameraModel, sensor_px: [u32; 2]) -> CameraModel {
        let binning = f64::from(self.binning);
        // The centre of a bin is half a pixel from that of its first pixel where it is two wide.
        let place = |at: f64, start: u32| at * binning + f64::from(start) + (binning - 1.0) / 2.0;
        CameraModel {
            width: sensor_px[0],
            height: sensor_px[1],
            fx: image.fx * binning,
            fy: image.fy * binning,
            cx: place(image.cx, self.region.left),
            cy: place(image.cy, self.region.top),
            distortion: image.distortion,
        }
    }

    /// The camera of the images in this mode, of that of the whole sensor.
    pub(super) fn of_images(&self, sensor: &CameraModel) -> CameraModel {
        let [width, height] = self.image_px();
        let [left, top] = [self.region.left, self.region.top].map(f64::from);
        Roi::binned(left, top, width, height, f64::from(self.binning)).camera(sensor)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::{Distortion, Point};
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_pixel_of_any_mode_shows_the_same_direction(
            left in 0..200_u32, top in 0..200_u32, width in 64..400_u32, height in 64..400_u32,
            binning in 1..=4_u32,
            x in -0.4..0.4_f64, y in -0.4..0.4_f64,
        ) {
            let sensor = CameraModel {
                fy: 498.0,
                distortion: Distortion::BrownConrady([-0.2, 0.05, 1e-3, -1e-3, 0.0, 0.0, 0.0, 0.0]),
                ..CameraModel::pinhole(600, 600, 500.0)
            };
            let mode = SensorMode { region: SensorRegion { left, top, width, height }, binning };
            let images = mode.of_images(&sensor);
            prop_assert_eq!([images.width, images.height], mode.image_px());
            let back = mode.of_sensor(&images, [600, 600]);
            let point = Point::new(x, y, 1.0);
            let (on_sensor, in_image) =
                (sensor.project(point).unwrap(), images.project(point).unwrap());
            prop_assert!(back.project(point).unwrap().distance(&on_sensor) < 1e-9);
            // The image's pixel covers `binning` pixels of the sensor on either axis, from its first column and row on.
            let b = f64::from(binning);
            prop_assert!(((in_image.x + 0.5) * b + f64::from(left) - 0.5 - on_sensor.x).abs() < 1e-9);
            prop_assert!(((in_image.y + 0.5) * b + f64::from(top) - 0.5 - on_sensor.y).abs() < 1e-9);
        }
    }

    #[test]
    fn a_region_beyond_another_is_not_within_it() {
        let whole = SensorRegion::whole(640, 480);
        assert!(whole.lies_in(&whole));
        let at = |left, top, width, height| SensorRegion { left, top, width, height };
        assert!(at(100, 100, 540, 380).lies_in(&whole));
        assert!(!at(100, 100, 541, 380).lies_in(&whole));
        assert!(!at(0, 0, 0, 10).lies_in(&whole));
        assert!(!at(u32::MAX, 0, u32::MAX, 10).lies_in(&whole));
        assert!(!whole.lies_in(&at(1, 0, 639, 480)));
    }
}
