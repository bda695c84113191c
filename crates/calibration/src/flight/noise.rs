//! Defines the standard deviations of the autopilot's and the detector's errors.

use nalgebra::{Matrix3, Vector3};

/// How many there are.
pub(super) const COUNT: usize = 7;

/// Standard deviations of the errors.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(super) struct Noise {
    /// Of a detection's direction beyond its own covariance, in pixels.
    pub(super) pixel_px: f64,
    /// Of the logarithm of its distance beyond its own covariance.
    pub(super) distance: f64,
    /// Of the slow error of the horizontal position, in metres.
    pub(super) position_m: f64,
    /// Of the slow error of the height, in metres.
    pub(super) height_m: f64,
    /// Of the slow error of roll and pitch, in radians.
    pub(super) lean_rad: f64,
    /// How long errors of the position last, and those of roll and pitch, in seconds.
    pub(super) position_s: f64,
    pub(super) lean_s: f64,
}

impl Default for Noise {
    /// Typical values in logs of autopilots.
    fn default() -> Self {
        Self {
            pixel_px: 0.3,
            distance: 0.002,
            position_m: 0.03,
            height_m: 0.1,
            lean_rad: 0.001,
            position_s: 10.0,
            lean_s: 6.0,
        }
    }
}

impl Noise {
    /// The addition to a detection's own covariance.
    pub(super) fn of_detection(&self) -> Matrix3<f64> {
        let (pixel, distance) = (self.pixel_px, self.distance);
        Matrix3::from_diagonal(&Vector3::new(pixel * pixel, pixel * pixel, distance * distance))
    }

    /// Standard deviation of the change of the position's error within a second, in metres.
    pub(super) fn wander_m(&self) -> f64 {
        self.position_m * (2.0 * (1.0 - libm::exp(-1.0 / self.position_s))).sqrt()
    }

    pub(super) fn logarithms(&self) -> [f64; COUNT] {
        let Self { pixel_px, distance, position_m, height_m, lean_rad, position_s, lean_s } = *self;
        [pixel_px, distance, position_m, height_m, lean_rad, position_s, lean_s].map(libm::log)
    }

    pub(super) fn from_logarithms(logarithms: [f64; COUNT]) -> Self {
        let [pixel_px, distance, position_m, height_m, lean_rad, position_s, lean_s] =
            logarithms.map(libm::exp);
        Self { pixel_px, distance, position_m, height_m, lean_rad, position_s, lean_s }
    }
}
