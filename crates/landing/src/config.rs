//! Every number the lander uses, with its default, unit and range.

use std::fmt;

use serde::Deserialize;

pub use crate::guidance::metric::MetricConfig;
pub use crate::guidance::thesis::ThesisConfig;

/// All settings of a landing. Plain data: check it with [`Config::validate`].
#[derive(Copy, Clone, Debug, PartialEq, Default)]
pub struct Config {
    /// What turns the target into a velocity.
    pub guidance: Guidance,
    /// Which detections are used at all, and the mean that the thesis' guidance takes its height from.
    pub target: TargetConfig,
    /// How detections become a target for our own guidance.
    pub estimator: EstimatorConfig,
    /// What no setpoint exceeds.
    pub envelope: EnvelopeConfig,
    /// When the phases end.
    pub phases: PhaseConfig,
}

/// What turns the target into a velocity.
#[derive(Copy, Clone, Debug, PartialEq)]
pub enum Guidance {
    /// The thesis' pixel controller (its section 3.2).
    Thesis(ThesisConfig),
    /// Our controller in metres.
    Metric(MetricConfig),
}

impl Default for Guidance {
    fn default() -> Self {
        Self::Metric(MetricConfig::default())
    }
}

/// How detections become a target.
#[derive(Copy, Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TargetConfig {
    /// A frame older than this on arrival is not used, in s (0.05 to 5).
    pub max_latency_s: f64,
    /// A frame from further in the future than this is not used, in s (0 to 1).
    pub max_future_s: f64,
    /// The vehicle's states are extrapolated over at most this time, in s (0 to 1).
    pub max_extrapolation_s: f64,
    /// A detection less certain than this is not used (0 to 1).
    pub min_confidence: f64,
    /// A detection further than this is not used, in m (1 to 200).
    pub max_range_m: f64,
    /// Horizontal distance from the estimate beyond which a detection is an outlier, at height 0, in m (0.02 to 10).
    pub gate_m: f64,
    /// What the gate grows by per metre of height (0 to 1).
    pub gate_per_height: f64,
    /// Time constant of the filter over detections at height 0, in s (0 to 5).
    pub smoothing_s: f64,
    /// What the time constant grows by per metre of height, in s/m (0 to 1).
    pub smoothing_s_per_height: f64,
    /// After so long without a detection the estimate is forgotten, in s (0.5 to 600).
    pub forget_after_s: f64,
    /// Outliers in a row that agree with each other and so begin a new estimate (2 to 100).
    pub restart_after: u32,
    /// Detections that make a target (1 to 100).
    pub confirm_after: u32,
}

impl Default for TargetConfig {
    fn default() -> Self {
        Self {
            max_latency_s: 0.5,
            max_future_s: 0.05,
            max_extrapolation_s: 0.1,
            min_confidence: 0.0,
            max_range_m: 40.0,
            gate_m: 0.15,
            gate_per_height: 0.1,
            smoothing_s: 0.1,
            smoothing_s_per_height: 0.05,
            forget_after_s: 5.0,
            restart_after: 6,
            confirm_after: 3,
        }
    }
}

/// How detections become a target: what is noise, what may change, and what is believed.
#[derive(Copy, Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EstimatorConfig {
    /// A detection further than this is not used, in m (1 to 200).
    pub max_range_m: f64,
    /// Noise of a marker's place in the image where the detector does not tell it, in px (0.01 to 10).
    pub pixel_noise_px: f64,
    /// The same as an angle, where the focal length is not known either, in rad (0.00001 to 0.1).
    pub direction_noise_rad: f64,
    /// Noise of the range as a part of it, where the marker's size in the image is not told (0.0001 to 0.5).
    pub range_noise_part: f64,
    /// What the range is wrong by as a part of it, beside what the detector tells (0 to 0.1).
    pub range_floor_part: f64,
    /// Fast noise of the attitude at an exposure, in rad (0.00001 to 0.1).
    pub attitude_noise_rad: f64,
    /// Fast noise of the autopilot's position, in m (0.0001 to 1).
    pub position_noise_m: f64,
    /// Slow error of the autopilot's position, in m per square root of a second (0 to 1).
    pub way_noise_m: f64,
    /// Drift of the autopilot's horizontal position at first, in m/s (0 to 1).
    pub drift_m_s: f64,
    /// What that drift changes by, in m/s per square root of a second (0 to 1).
    pub drift_change: f64,
    /// What it changes by at most, where detections show that the autopilot's position wanders, in m/s per square root of a
    /// second, and no more than 15 times `drift_change`; tilts then change faster in the same proportion. Not more than
    /// `drift_change`, or a `drift_change` of 0, adjusts nothing (0 to 1).
    pub most_drift_change: f64,
    /// Drift of the autopilot's height at first, in m/s (0 to 1).
    pub height_drift_m_s: f64,
    /// What that drift changes by, in m/s per square root of a second (0 to 1).
    pub height_drift_change: f64,
    /// Fastest pad, in m/s; 0 for one that lies still (0 to 10).
    pub pad_speed_m_s: f64,
    /// Fastest heave of the pad, in m/s (0 to 5).
    pub pad_heave_m_s: f64,
    /// What the pad's velocity changes by, in m/s per square root of a second (0 to 5).
    pub pad_acceleration: f64,
    /// Error of mount and attitude, in rad (0.00001 to 0.2).
    pub mount_error_rad: f64,
    /// What that error changes by, in rad per square root of a second (0 to 0.1).
    pub tilt_change: f64,
    /// Error of the heading, in rad (0.00001 to 0.5).
    pub heading_error_rad: f64,
    /// Error of the frames' stamps, in s; 0 trusts them (0 to 0.2).
    pub time_offset_s: f64,
    /// Squared innovation over its covariance beyond which a detection is an outlier; chi-square with 3 degrees of
    /// freedom exceeds 16.3 once in a thousand times (7 to 100).
    pub gate: f64,
    /// Outliers that agree with each other and so begin a new estimate (2 to 30).
    pub restart_after: u32,
    /// Shortest time over which such outliers must come, in s (0 to 10).
    pub restart_s: f64,
    /// After so long without a detection the estimate is forgotten, in s (0.5 to 600).
    pub forget_after_s: f64,
    /// Weight of a new detection in the pad's heading (0.01 to 1).
    pub heading_share: f64,
}

impl Default for EstimatorConfig {
    fn default() -> Self {
        Self {
            max_range_m: 40.0,
            pixel_noise_px: 0.3,
            direction_noise_rad: 0.0003,
            range_noise_part: 0.015,
            range_floor_part: 0.002,
            attitude_noise_rad: 0.0003,
            position_noise_m: 0.002,
            way_noise_m: 0.01,
            drift_m_s: 0.05,
            drift_change: 0.01,
            most_drift_change: 0.15,
            height_drift_m_s: 0.1,
            height_drift_change: 0.05,
            pad_speed_m_s: 0.0,
            pad_heave_m_s: 0.0,
            pad_acceleration: 0.0,
            mount_error_rad: 0.005,
            tilt_change: 0.0005,
            heading_error_rad: 0.015,
            time_offset_s: 0.02,
            gate: 16.3,
            restart_after: 8,
            restart_s: 1.5,
            forget_after_s: 10.0,
            heading_share: 0.1,
        }
    }
}

/// What no setpoint exceeds, whatever the guidance wants.
#[derive(Copy, Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EnvelopeConfig {
    /// Horizontal speed in m/s (0.05 to 10).
    pub horizontal_m_s: f64,
    /// Speed upwards in m/s (0 to 5).
    pub climb_m_s: f64,
    /// Speed downwards in m/s (0.05 to 5).
    pub descend_m_s: f64,
}

impl Default for EnvelopeConfig {
    fn default() -> Self {
        Self { horizontal_m_s: 2.0, climb_m_s: 1.0, descend_m_s: 2.0 }
    }
}

/// When the phases end.
#[derive(Copy, Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PhaseConfig {
    /// Age of the target beyond which nothing descends, in s (0.1 to 5).
    pub stale_target_s: f64,
    /// Below this height over the target the descent goes on for `low_grace_s` more, in m (0 to 5).
    pub low_height_m: f64,
    /// What a low vehicle adds to `stale_target_s`, in s (0 to 5).
    pub low_grace_s: f64,
    /// Age of the target beyond which the vehicle stops and holds, in s (0.1 to 10).
    pub lost_target_s: f64,
    /// Age of the vehicle's state beyond which the vehicle holds, in s (0.1 to 5).
    pub stale_vehicle_s: f64,
    /// Longest search before a hold, in s (1 to 600).
    pub search_timeout_s: f64,
    /// Hovering before the search begins to move, in s (0 to 60).
    pub search_delay_s: f64,
    /// Height over the local origin below which the search climbs before it flies its legs, in m; 0 never climbs (0 to 50).
    pub search_height_m: f64,
    /// Speed of that climb, in m/s (0.1 to 3).
    pub search_climb_m_s: f64,
    /// Speed of the search, in m/s; 0 hovers (0 to 3).
    pub search_speed_m_s: f64,
    /// Distance between the legs of the expanding square, in m (0.5 to 20).
    pub search_spacing_m: f64,
    /// How far the search goes along either axis, in m (0 to 50).
    pub search_radius_m: f64,
    /// Radius about the local origin that the search does not leave, in m; 0 sets none (0 to 10000).
    pub fence_radius_m: f64,
    /// Height over the local origin that neither search nor retry exceeds, in m; 0 sets none (0 to 1000).
    pub fence_height_m: f64,
    /// Longest wait before the descent for natural motion that shows whether camera and autopilot mean the same
    /// directions, in s; 0 does not look (0 to 60).
    pub self_test_s: f64,
    /// Longest approach before a hold, in s (1 to 600).
    pub approach_timeout_s: f64,
    /// Longest descent before a hold, in s (1 to 600).
    pub descend_timeout_s: f64,
    /// Longest hold for a lost target or vehicle state before the landing is aborted, in s (1 to 600).
    pub hold_timeout_s: f64,
    /// Longest hold by the operator before the landing is aborted, in s (1 to 3600).
    pub operator_hold_timeout_s: f64,
    /// A vehicle that has held for a lost marker so long climbs to `regain_height_m`, in s (0 to 60).
    pub regain_after_s: f64,
    /// Height over the target up to which a vehicle climbs to see a lost marker again, in m; 0 is never (0 to 10).
    pub regain_height_m: f64,
    /// Speed of that climb, in m/s (0.1 to 2).
    pub regain_climb_m_s: f64,
    /// How often a landing that lost the marker or its patience climbs and begins again (0 to 20).
    pub retries: u32,
    /// How far it climbs, in m (0 to 20), never above the height where the landing began.
    pub retry_climb_m: f64,
    /// Speed of that climb, in m/s (0.1 to 3).
    pub retry_climb_m_s: f64,
    /// Longest climb and look-out before a search, in s (1 to 60).
    pub retry_timeout_s: f64,
    /// Interval at which LAND is asked for again, in s (0.1 to 5).
    pub land_retry_s: f64,
    /// Longest wait for the LAND mode before the landing is aborted, in s (0.5 to 60).
    pub land_timeout_s: f64,
    /// Longest time in LAND before the landing is aborted, in s (5 to 600).
    pub touchdown_timeout_s: f64,
    /// Speed downwards without LAND, where the autopilot refuses it close to the ground, in m/s (0.1 to 1).
    pub refused_descend_m_s: f64,
    /// Height over the target below which the autopilot's LAND is not taken back any more, in m (0 to 20).
    pub no_return_height_m: f64,
    /// Longest landing, from start to LAND, before it is aborted, in s (10 to 3600).
    pub landing_timeout_s: f64,
    /// Height over the local origin below which a start in LAND mode just watches the touchdown, in m (0 to 20).
    pub watch_height_m: f64,
    /// What an aborted landing does.
    pub on_abort: OnAbort,
    /// Height over the local origin to which an aborted landing climbs when it is to climb, in m (0 to 100).
    pub abort_height_m: f64,
    /// How long an aborted landing hovers before it falls silent, in s (0 to 60).
    pub release_after_s: f64,
    /// What a low battery leads to.
    pub on_battery_low: AlarmAction,
    /// What a nearly empty battery leads to.
    pub on_battery_critical: AlarmAction,
    /// What follows when the operator is no longer heard.
    pub on_operator_lost: AlarmAction,
    /// What follows when the autopilot is no longer heard; a hold ends when it is again.
    pub on_autopilot_lost: AlarmAction,
}

impl Default for PhaseConfig {
    fn default() -> Self {
        Self {
            stale_target_s: 0.4,
            low_height_m: 0.8,
            low_grace_s: 0.4,
            lost_target_s: 1.0,
            stale_vehicle_s: 0.5,
            search_timeout_s: 60.0,
            search_delay_s: 0.5,
            search_height_m: 5.0,
            search_climb_m_s: 1.0,
            search_speed_m_s: 1.0,
            search_spacing_m: 2.0,
            search_radius_m: 5.0,
            fence_radius_m: 0.0,
            fence_height_m: 0.0,
            self_test_s: 1.5,
            approach_timeout_s: 60.0,
            descend_timeout_s: 120.0,
            hold_timeout_s: 60.0,
            operator_hold_timeout_s: 180.0,
            regain_after_s: 2.0,
            regain_height_m: 1.5,
            regain_climb_m_s: 0.3,
            retries: 5,
            retry_climb_m: 2.0,
            retry_climb_m_s: 0.8,
            retry_timeout_s: 8.0,
            land_retry_s: 0.5,
            land_timeout_s: 5.0,
            touchdown_timeout_s: 60.0,
            refused_descend_m_s: 0.3,
            no_return_height_m: 1.0,
            landing_timeout_s: 300.0,
            watch_height_m: 2.0,
            on_abort: OnAbort::Hover,
            abort_height_m: 10.0,
            release_after_s: 5.0,
            on_battery_low: AlarmAction::Ignore,
            on_battery_critical: AlarmAction::Land,
            on_operator_lost: AlarmAction::Ignore,
            on_autopilot_lost: AlarmAction::Hold,
        }
    }
}

/// What an aborted landing does.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OnAbort {
    /// Hover for `release_after_s`, then fall silent: the autopilot holds its position by itself.
    Hover,
    /// Land where it is, by the autopilot's LAND mode.
    Land,
    /// Climb to `abort_height_m`, then as `Hover`.
    Climb,
}

/// What an alarm leads to.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AlarmAction {
    /// The landing goes on.
    Ignore,
    /// As if the operator had asked to hold.
    Hold,
    /// The landing is given up, and `on_abort` follows.
    Abort,
    /// The autopilot's LAND mode, where the vehicle is.
    Land,
}

/// A setting that cannot be used.
#[derive(Clone, Debug, PartialEq)]
pub struct ConfigError {
    /// The key, with dots, as in `phases.hold_timeout_s`.
    pub key: &'static str,
    /// What it was set to.
    pub value: f64,
    /// The smallest value allowed.
    pub min: f64,
    /// The largest value allowed.
    pub max: f64,
}

impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} is {}, must lie between {} and {}", self.key, self.value, self.min, self.max)
    }
}

impl std::error::Error for ConfigError {}

impl Config {
    /// Checks every number against its range; the first that lies outside is named.
    pub fn validate(&self) -> Result<(), ConfigError> {
        match &self.guidance {
            Guidance::Thesis(thesis) => thesis.validate()?,
            Guidance::Metric(metric) => metric.validate()?,
        }
        self.target.validate()?;
        self.estimator.validate()?;
        self.envelope.validate()?;
        self.phases.validate()
    }
}

impl TargetConfig {
    fn validate(&self) -> Result<(), ConfigError> {
        check("target.max_latency_s", self.max_latency_s, 0.05, 5.0)?;
        check("target.max_future_s", self.max_future_s, 0.0, 1.0)?;
        check("target.max_extrapolation_s", self.max_extrapolation_s, 0.0, 1.0)?;
        check("target.min_confidence", self.min_confidence, 0.0, 1.0)?;
        check("target.max_range_m", self.max_range_m, 1.0, 200.0)?;
        check("target.gate_m", self.gate_m, 0.02, 10.0)?;
        check("target.gate_per_height", self.gate_per_height, 0.0, 1.0)?;
        check("target.smoothing_s", self.smoothing_s, 0.0, 5.0)?;
        check("target.smoothing_s_per_height", self.smoothing_s_per_height, 0.0, 1.0)?;
        check("target.forget_after_s", self.forget_after_s, 0.5, 600.0)?;
        check("target.restart_after", f64::from(self.restart_after), 2.0, 100.0)?;
        check("target.confirm_after", f64::from(self.confirm_after), 1.0, 100.0)
    }
}

impl EstimatorConfig {
    fn validate(&self) -> Result<(), ConfigError> {
        check("estimator.max_range_m", self.max_range_m, 1.0, 200.0)?;
        check("estimator.pixel_noise_px", self.pixel_noise_px, 0.01, 10.0)?;
        check("estimator.direction_noise_rad", self.direction_noise_rad, 1e-5, 0.1)?;
        check("estimator.range_noise_part", self.range_noise_part, 1e-4, 0.5)?;
        check("estimator.range_floor_part", self.range_floor_part, 0.0, 0.1)?;
        check("estimator.attitude_noise_rad", self.attitude_noise_rad, 1e-5, 0.1)?;
        check("estimator.position_noise_m", self.position_noise_m, 1e-4, 1.0)?;
        check("estimator.way_noise_m", self.way_noise_m, 0.0, 1.0)?;
        check("estimator.drift_m_s", self.drift_m_s, 0.0, 1.0)?;
        check("estimator.drift_change", self.drift_change, 0.0, 1.0)?;
        check("estimator.most_drift_change", self.most_drift_change, 0.0, 1.0)?;
        check("estimator.height_drift_m_s", self.height_drift_m_s, 0.0, 1.0)?;
        check("estimator.height_drift_change", self.height_drift_change, 0.0, 1.0)?;
        check("estimator.pad_speed_m_s", self.pad_speed_m_s, 0.0, 10.0)?;
        check("estimator.pad_heave_m_s", self.pad_heave_m_s, 0.0, 5.0)?;
        check("estimator.pad_acceleration", self.pad_acceleration, 0.0, 5.0)?;
        check("estimator.mount_error_rad", self.mount_error_rad, 1e-5, 0.2)?;
        check("estimator.tilt_change", self.tilt_change, 0.0, 0.1)?;
        check("estimator.heading_error_rad", self.heading_error_rad, 1e-5, 0.5)?;
        check("estimator.time_offset_s", self.time_offset_s, 0.0, 0.2)?;
        check("estimator.gate", self.gate, 7.0, 100.0)?;
        let most = f64::from(crate::standing::MOST_SIGHTED);
        check("estimator.restart_after", f64::from(self.restart_after), 2.0, most)?;
        check("estimator.restart_s", self.restart_s, 0.0, 10.0)?;
        check("estimator.forget_after_s", self.forget_after_s, 0.5, 600.0)?;
        check("estimator.heading_share", self.heading_share, 0.01, 1.0)
    }
}

impl EnvelopeConfig {
    fn validate(&self) -> Result<(), ConfigError> {
        check("envelope.horizontal_m_s", self.horizontal_m_s, 0.05, 10.0)?;
        check("envelope.climb_m_s", self.climb_m_s, 0.0, 5.0)?;
        check("envelope.descend_m_s", self.descend_m_s, 0.05, 5.0)
    }
}

impl PhaseConfig {
    fn validate(&self) -> Result<(), ConfigError> {
        check("phases.stale_target_s", self.stale_target_s, 0.1, 5.0)?;
        check("phases.low_height_m", self.low_height_m, 0.0, 5.0)?;
        check("phases.low_grace_s", self.low_grace_s, 0.0, 5.0)?;
        check("phases.lost_target_s", self.lost_target_s, 0.1, 10.0)?;
        check("phases.stale_vehicle_s", self.stale_vehicle_s, 0.1, 5.0)?;
        check("phases.search_timeout_s", self.search_timeout_s, 1.0, 600.0)?;
        check("phases.search_delay_s", self.search_delay_s, 0.0, 60.0)?;
        check("phases.search_height_m", self.search_height_m, 0.0, 50.0)?;
        check("phases.search_climb_m_s", self.search_climb_m_s, 0.1, 3.0)?;
        check("phases.search_speed_m_s", self.search_speed_m_s, 0.0, 3.0)?;
        check("phases.search_spacing_m", self.search_spacing_m, 0.5, 20.0)?;
        check("phases.search_radius_m", self.search_radius_m, 0.0, 50.0)?;
        check("phases.fence_radius_m", self.fence_radius_m, 0.0, 10_000.0)?;
        check("phases.fence_height_m", self.fence_height_m, 0.0, 1_000.0)?;
        check("phases.self_test_s", self.self_test_s, 0.0, 60.0)?;
        check("phases.approach_timeout_s", self.approach_timeout_s, 1.0, 600.0)?;
        check("phases.descend_timeout_s", self.descend_timeout_s, 1.0, 600.0)?;
        check("phases.hold_timeout_s", self.hold_timeout_s, 1.0, 600.0)?;
        check("phases.operator_hold_timeout_s", self.operator_hold_timeout_s, 1.0, 3600.0)?;
        check("phases.regain_after_s", self.regain_after_s, 0.0, 60.0)?;
        check("phases.regain_height_m", self.regain_height_m, 0.0, 10.0)?;
        check("phases.regain_climb_m_s", self.regain_climb_m_s, 0.1, 2.0)?;
        check("phases.retries", f64::from(self.retries), 0.0, 20.0)?;
        check("phases.retry_climb_m", self.retry_climb_m, 0.0, 20.0)?;
        check("phases.retry_climb_m_s", self.retry_climb_m_s, 0.1, 3.0)?;
        check("phases.retry_timeout_s", self.retry_timeout_s, 1.0, 60.0)?;
        check("phases.abort_height_m", self.abort_height_m, 0.0, 100.0)?;
        check("phases.land_retry_s", self.land_retry_s, 0.1, 5.0)?;
        check("phases.land_timeout_s", self.land_timeout_s, 0.5, 60.0)?;
        check("phases.touchdown_timeout_s", self.touchdown_timeout_s, 5.0, 600.0)?;
        check("phases.refused_descend_m_s", self.refused_descend_m_s, 0.1, 1.0)?;
        check("phases.no_return_height_m", self.no_return_height_m, 0.0, 20.0)?;
        check("phases.landing_timeout_s", self.landing_timeout_s, 10.0, 3600.0)?;
        check("phases.watch_height_m", self.watch_height_m, 0.0, 20.0)?;
        check("phases.release_after_s", self.release_after_s, 0.0, 60.0)
    }
}

/// Refuses a value outside its range; not a number lies outside every range.
pub(crate) fn check(key: &'static str, value: f64, min: f64, max: f64) -> Result<(), ConfigError> {
    if (min..=max).contains(&value) { Ok(()) } else { Err(ConfigError { key, value, min, max }) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_defaults_are_within_their_ranges() {
        assert_eq!(Config::default().validate(), Ok(()));
        let thesis =
            Config { guidance: Guidance::Thesis(ThesisConfig::default()), ..Config::default() };
        assert_eq!(thesis.validate(), Ok(()));
    }

    #[test]
    fn a_value_out_of_range_is_named_with_its_limits() {
        let mut config = Config::default();
        config.phases.hold_timeout_s = 0.0;
        let error = config.validate().unwrap_err();
        assert_eq!(error.to_string(), "phases.hold_timeout_s is 0, must lie between 1 and 600");
        config = Config::default();
        config.envelope.climb_m_s = f64::NAN;
        assert_eq!(config.validate().unwrap_err().key, "envelope.climb_m_s");
    }
}
