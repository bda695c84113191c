//! The thesis' guidance: a pixel PI controller (its section 3.2, Algorithms 16 to 18).

use crate::config::{ConfigError, check};

/// The constants of the thesis' section 3.2.1.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct ThesisConfig {
    /// Proportional gain for x and y, in m/s per pixel (0 to 0.1).
    pub kp: f64,
    /// Integral gain for x and y, in m/s per pixel and frame (0 to 0.01).
    pub ki: f64,
    /// Proportional gain for the descent, in m/s per centimetre of altitude; negative is down (-0.01 to 0).
    pub kpz: f64,
    /// Largest speed along x and y, in m/s (0.01 to 5).
    pub max_horizontal_m_s: f64,
    /// Smallest speed of descent, in m/s (0 to 1).
    pub min_descend_m_s: f64,
    /// Largest speed of descent, in m/s (0.01 to 5).
    pub max_descend_m_s: f64,
    /// Radius of the circle around the image's centre in which the marker counts as aligned, in pixels (1 to 5000).
    pub tolerance_px: f64,
    /// Altitude over the marker at which the autopilot's LAND takes over, in m (0.1 to 10).
    pub land_altitude_m: f64,
    /// How much of the last wind noise remains (lambda of Equation 3.15; 0 to 1).
    pub wind_memory: f64,
    /// Mean of the wind noise's random term, in m/s (-5 to 5).
    pub wind_mean_m_s: f64,
    /// Standard deviation of the wind noise's random term, in m/s; 0 turns the noise off (0 to 5).
    pub wind_sigma_m_s: f64,
    /// Seed of the wind noise.
    pub seed: u64,
    /// Heading of the image's upper edge relative to the vehicle's nose, in radians, clockwise seen from above (-7 to 7).
    pub image_up_rad: f64,
}

impl Default for ThesisConfig {
    fn default() -> Self {
        Self {
            kp: 1e-6,
            ki: 7e-7,
            kpz: -5e-4,
            max_horizontal_m_s: 0.5,
            min_descend_m_s: 1e-5,
            max_descend_m_s: 0.5,
            tolerance_px: 300.0,
            land_altitude_m: 0.8,
            wind_memory: 0.9,
            wind_mean_m_s: 0.0,
            wind_sigma_m_s: 0.1,
            seed: 0,
            image_up_rad: 0.0,
        }
    }
}

impl ThesisConfig {
    pub(crate) fn validate(&self) -> Result<(), ConfigError> {
        check("thesis.kp", self.kp, 0.0, 0.1)?;
        check("thesis.ki", self.ki, 0.0, 0.01)?;
        check("thesis.kpz", self.kpz, -0.01, 0.0)?;
        check("thesis.max_horizontal_m_s", self.max_horizontal_m_s, 0.01, 5.0)?;
        check("thesis.min_descend_m_s", self.min_descend_m_s, 0.0, 1.0)?;
        check("thesis.max_descend_m_s", self.max_descend_m_s, 0.01, 5.0)?;
        check("thesis.tolerance_px", self.tolerance_px, 1.0, 5000.0)?;
        check("thesis.land_altitude_m", self.land_altitude_m, 0.1, 10.0)?;
        check("thesis.wind_memory", self.wind_memory, 0.0, 1.0)?;
        check("thesis.wind_mean_m_s", self.wind_mean_m_s, -5.0, 5.0)?;
        check("thesis.wind_sigma_m_s", self.wind_sigma_m_s, 0.0, 5.0)?;
        check("thesis.image_up_rad", self.image_up_rad, -7.0, 7.0)
    }
}
