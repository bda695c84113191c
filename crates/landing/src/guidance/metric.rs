//! Our guidance: from the target's position in metres to a velocity.

use crate::config::{ConfigError, check};

/// How the vehicle is brought over the target and down.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct MetricConfig {
    /// Lateral speed per metre of predicted error, in 1/s (0.1 to 3).
    pub lateral_gain: f64,
    /// Lateral speed gained per metre of error and second, in 1/s^2; counters a biased velocity (0 to 1).
    pub lateral_integral_gain: f64,
    /// Largest lateral speed, in m/s (0.1 to 5).
    pub max_lateral_m_s: f64,
    /// Largest change of the lateral setpoint, in m/s^2; tilts the camera (0.1 to 2.5).
    pub lateral_acceleration_m_s2: f64,
    /// How far ahead the lateral error is predicted: what passes until a setpoint shows, in s (0 to 1).
    pub lead_s: f64,
    /// Largest speed of descent, in m/s (0.1 to 3).
    pub max_descend_m_s: f64,
    /// Speed of descent at the hand-over to LAND, in m/s (0.05 to 1).
    pub final_descend_m_s: f64,
    /// Speed of descent gained per metre above the hand-over, in 1/s (0.1 to 2).
    pub descend_gain: f64,
    /// Largest change of the descent's setpoint, in m/s^2 (0.1 to 2.5).
    pub descend_acceleration_m_s2: f64,
    /// Radius of the funnel at height 0, in m; at its edge the descent stops (0.02 to 5).
    pub funnel_m: f64,
    /// What the funnel's radius grows by per metre of height (0 to 2).
    pub funnel_per_height: f64,
    /// Age of the target up to which the descent is not slowed, in s (0 to 5).
    pub fresh_target_s: f64,
    /// Height over the target at which LAND takes over, in m (0.1 to 5).
    pub land_height_m: f64,
    /// Largest lateral error predicted for the touchdown at the hand-over, in m (0.01 to 1).
    pub land_error_m: f64,
    /// Largest lateral speed at the hand-over, in m/s (0.02 to 1).
    pub land_speed_m_s: f64,
    /// For how long lateral speed goes on in LAND, in s (0 to 2).
    pub coast_s: f64,
}

impl Default for MetricConfig {
    fn default() -> Self {
        Self {
            lateral_gain: 0.9,
            lateral_integral_gain: 0.1,
            max_lateral_m_s: 1.5,
            lateral_acceleration_m_s2: 1.0,
            lead_s: 0.4,
            max_descend_m_s: 1.8,
            final_descend_m_s: 0.3,
            descend_gain: 0.7,
            descend_acceleration_m_s2: 1.5,
            funnel_m: 0.06,
            funnel_per_height: 0.25,
            fresh_target_s: 0.25,
            land_height_m: 0.45,
            land_error_m: 0.05,
            land_speed_m_s: 0.1,
            coast_s: 0.6,
        }
    }
}

impl MetricConfig {
    pub(crate) fn validate(&self) -> Result<(), ConfigError> {
        check("metric.lateral_gain", self.lateral_gain, 0.1, 3.0)?;
        check("metric.lateral_integral_gain", self.lateral_integral_gain, 0.0, 1.0)?;
        check("metric.max_lateral_m_s", self.max_lateral_m_s, 0.1, 5.0)?;
        check("metric.lateral_acceleration_m_s2", self.lateral_acceleration_m_s2, 0.1, 2.5)?;
        check("metric.lead_s", self.lead_s, 0.0, 1.0)?;
        check("metric.max_descend_m_s", self.max_descend_m_s, 0.1, 3.0)?;
        check("metric.final_descend_m_s", self.final_descend_m_s, 0.05, 1.0)?;
        check("metric.descend_gain", self.descend_gain, 0.1, 2.0)?;
        check("metric.descend_acceleration_m_s2", self.descend_acceleration_m_s2, 0.1, 2.5)?;
        check("metric.funnel_m", self.funnel_m, 0.02, 5.0)?;
        check("metric.funnel_per_height", self.funnel_per_height, 0.0, 2.0)?;
        check("metric.fresh_target_s", self.fresh_target_s, 0.0, 5.0)?;
        check("metric.land_height_m", self.land_height_m, 0.1, 5.0)?;
        check("metric.land_error_m", self.land_error_m, 0.01, 1.0)?;
        check("metric.land_speed_m_s", self.land_speed_m_s, 0.02, 1.0)?;
        check("metric.coast_s", self.coast_s, 0.0, 2.0)
    }
}
