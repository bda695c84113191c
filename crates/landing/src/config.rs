//! Declares the lander's configuration: estimator, phases, envelope, checks, guidance, and the actions after an abort or an alarm,
//! each number with default, unit and range.

use serde::{Deserialize, Serialize};

use crate::limits::{ConfigError, check, settings};

/// Upper bound of a hypothesis' detection count, so that a position seen for minutes is replaced as fast as one
/// seen for seconds. Also the largest `estimator.restart_after` that can be reached.
pub(crate) const MAX_COUNTED_DETECTIONS: u32 = 30;

/// All settings of a landing. Plain data: check it with [`Config::validate`].
#[derive(Copy, Clone, Debug, PartialEq, Default)]
pub struct Config {
    /// The guidance law, which computes a velocity from the target.
    pub guidance: GuidanceConfig,
    /// Which detections are used, and the mean from which the thesis' guidance takes its height.
    pub target: TargetConfig,
    /// The Kalman filter of the metric guidance.
    pub estimator: EstimatorConfig,
    /// Limits of every setpoint.
    pub envelope: EnvelopeConfig,
    /// When the phases end.
    pub phases: PhaseConfig,
}

/// The guidance law, which computes a velocity from the target.
#[derive(Copy, Clone, Debug, PartialEq)]
pub enum GuidanceConfig {
    /// The thesis' pixel controller (its section 3.2).
    Thesis(ThesisConfig),
    /// The controller in metres.
    Metric(MetricConfig),
}

impl Default for GuidanceConfig {
    fn default() -> Self {
        Self::Metric(MetricConfig::default())
    }
}

impl Config {
    /// Checks every number against its range; the error names the first that lies outside.
    pub fn validate(&self) -> Result<(), ConfigError> {
        match &self.guidance {
            GuidanceConfig::Thesis(thesis) => thesis.validate()?,
            GuidanceConfig::Metric(metric) => metric.validate()?,
        }
        self.target.validate()?;
        self.estimator.validate()?;
        self.envelope.validate()?;
        self.phases.validate()
    }
}

settings! {
    /// Which detections are used, and how the thesis' guidance averages them.
    TargetConfig in "target" {
        /// Maximum age of a frame on arrival, in s.
        max_latency_s: f64 = 0.5, 0.05..=5.0;
        /// Maximum time by which a frame's stamp may lie in the future, in s.
        max_future_s: f64 = 0.05, 0.0..=1.0;
        /// Maximum time over which the vehicle's states are extrapolated, in s.
        max_extrapolation_s: f64 = 0.1, 0.0..=1.0;
        /// Minimum confidence of a detection.
        min_confidence: f64 = 0.0, 0.0..=1.0;
        /// Maximum range of a detection, in m (thesis guidance).
        max_range_m: f64 = 40.0, 1.0..=200.0;
        /// Horizontal distance from the estimate beyond which a detection is an outlier, at height 0, in m
        /// (thesis guidance).
        gate_m: f64 = 0.15, 0.02..=10.0;
        /// Growth of that distance per metre of height.
        gate_per_height: f64 = 0.1, 0.0..=1.0;
        /// Time constant of the mean over detections at height 0, in s (thesis guidance).
        smoothing_s: f64 = 0.1, 0.0..=5.0;
        /// Growth of that time constant per metre of height, in s/m.
        smoothing_s_per_height: f64 = 0.05, 0.0..=1.0;
        /// Time without a detection after which the mean is discarded, in s (thesis guidance).
        forget_after_s: f64 = 5.0, 0.5..=600.0;
        /// Consecutive outliers in agreement that start a new mean (thesis guidance).
        restart_after: u32 = 6, 2.0..=100.0;
        /// Number of detections, without a long gap, that confirm a target.
        confirm_after: u32 = 3, 1.0..=100.0;
    }
}

settings! {
    /// The Kalman filter: measurement noise, process noise, gating.
    EstimatorConfig in "estimator" {
        /// Maximum range of a detection, in m.
        max_range_m: f64 = 40.0, 1.0..=200.0;
        /// Standard deviation of a marker's position in the image where the detector gives no covariance, in
        /// px.
        pixel_noise_px: f64 = 0.3, 0.01..=10.0;
        /// The same as an angle, where the focal length is unknown too, in rad.
        direction_noise_rad: f64 = 0.0003, 1e-5..=0.1;
        /// Standard deviation of the range relative to the range, where the marker's size in the image is
        /// unknown.
        range_noise_ratio: f64 = 0.015, 1e-4..=0.5;
        /// Standard deviation of the range relative to the range, added to the detector's covariance.
        range_floor_ratio: f64 = 0.002, 0.0..=0.1;
        /// Fast noise of the attitude at an exposure, in rad.
        attitude_noise_rad: f64 = 0.0003, 1e-5..=0.1;
        /// Fast noise of the autopilot's position, in m.
        position_noise_m: f64 = 0.002, 1e-4..=1.0;
        /// Random walk of the autopilot's position, in m per square root of a second.
        odometry_noise_m: f64 = 0.01, 0.0..=1.0;
        /// Initial standard deviation of the drift of the autopilot's horizontal position, in m/s.
        drift_m_s: f64 = 0.05, 0.0..=1.0;
        /// Random walk of that drift, in m/s per square root of a second.
        drift_change: f64 = 0.01, 0.0..=1.0;
        /// Maximum random walk of that drift while detections show that the autopilot's position wanders, in
        /// m/s per square root of a second. At most 30 times `drift_change`; the random walk of tilts grows
        /// in the same proportion. Values up to `drift_change`, or a `drift_change` of 0, turn the adaptation
        /// off.
        max_drift_change: f64 = 0.3, 0.0..=1.0;
        /// Initial standard deviation of the drift of the autopilot's height, in m/s.
        height_drift_m_s: f64 = 0.1, 0.0..=1.0;
        /// Random walk of that drift, in m/s per square root of a second.
        height_drift_change: f64 = 0.05, 0.0..=1.0;
        /// Maximum speed of the pad, in m/s; 0 for a pad that does not move.
        pad_speed_m_s: f64 = 0.0, 0.0..=10.0;
        /// Maximum heave speed of the pad, in m/s.
        pad_heave_m_s: f64 = 0.0, 0.0..=5.0;
        /// Random walk of the pad's velocity, in m/s per square root of a second.
        pad_acceleration: f64 = 0.0, 0.0..=5.0;
        /// Initial standard deviation of the error of mount and attitude, in rad.
        mount_error_rad: f64 = 0.005, 1e-5..=0.2;
        /// Random walk of that error, in rad per square root of a second.
        tilt_change: f64 = 0.0005, 0.0..=0.1;
        /// Initial standard deviation of the heading error, in rad.
        heading_error_rad: f64 = 0.015, 1e-5..=0.5;
        /// Initial standard deviation of the frames' time offset, in s; 0 trusts the stamps.
        time_offset_s: f64 = 0.02, 0.0..=0.2;
        /// Normalised innovation squared (NIS) beyond which a detection is an outlier; chi-square with 3
        /// degrees of freedom exceeds 16.3 once in a thousand times.
        gate: f64 = 16.3, 7.0..=100.0;
        /// Outliers in agreement that start a new estimate, when the marker is found in a larger fraction of the
        /// frames that show their position than of those that show the estimate's position.
        restart_after: u32 = 8, 2.0..=f64::from(MAX_COUNTED_DETECTIONS);
        /// Minimum time over which such outliers must occur, in s.
        restart_s: f64 = 1.5, 0.0..=10.0;
        /// Time without a detection after which the estimate is discarded, in s.
        forget_after_s: f64 = 10.0, 0.5..=600.0;
        /// Weight of a new detection in the average of the pad's heading.
        heading_weight: f64 = 0.1, 0.01..=1.0;
    }
}

settings! {
    /// Limits of every setpoint, whatever the guidance requests.
    EnvelopeConfig in "envelope" {
        /// Maximum horizontal speed, in m/s.
        horizontal_m_s: f64 = 2.0, 0.05..=10.0;
        /// Maximum climb speed, in m/s.
        climb_m_s: f64 = 1.0, 0.0..=5.0;
        /// Maximum descent speed, in m/s.
        descend_m_s: f64 = 2.0, 0.05..=5.0;
    }
}

settings! {
    /// When the phases end.
    PhaseConfig in "phases" {
        /// Maximum age of the newest detection for the marker to count as visible, in s.
        stale_target_s: f64 = 0.4, 0.1..=5.0;
        /// Age of the newest detection beyond which the marker is lost and the vehicle holds or retries, in
        /// s. More than 1.5 m over the pad, up to 2 s in which the camera does not show the pad's position do not
        /// count.
        lost_target_s: f64 = 1.0, 0.1..=10.0;
        /// Age of the vehicle's state beyond which the vehicle holds, in s.
        stale_vehicle_s: f64 = 0.5, 0.1..=5.0;
        /// Maximum duration of a search, in s; then the vehicle holds.
        search_timeout_s: f64 = 60.0, 1.0..=600.0;
        /// Hover time before the search moves, in s.
        search_delay_s: f64 = 0.5, 0.0..=60.0;
        /// Height to which the search climbs before it flies its legs, in m: over the pad once it was seen, else
        /// over the ground that the vehicle took off from. A lander that began in the air takes the local origin
        /// for the ground, and climbs at most this far over the start of the landing. 0 never climbs.
        search_height_m: f64 = 5.0, 0.0..=50.0;
        /// Speed of that climb, in m/s.
        search_climb_m_s: f64 = 1.0, 0.1..=3.0;
        /// Speed of the search, in m/s; 0 hovers. A vehicle that the wind carried off its line flies back to it at up to
        /// twice that.
        search_speed_m_s: f64 = 1.0, 0.0..=3.0;
        /// Distance between the legs of the expanding square, in m.
        search_spacing_m: f64 = 2.0, 0.5..=20.0;
        /// Maximum distance of the search along either axis, in m.
        search_radius_m: f64 = 5.0, 0.0..=50.0;
        /// Radius about the local origin that the search does not leave, in m; 0 sets none.
        fence_radius_m: f64 = 0.0, 0.0..=10_000.0;
        /// Height over the local origin that neither search nor retry nor the climb of an aborted landing or of
        /// a dispute exceeds, in m; 0 sets none.
        fence_height_m: f64 = 0.0, 0.0..=1_000.0;
        /// Maximum wait before the descent for natural motion that shows whether the axes of camera and
        /// autopilot agree, in s; 0 turns the check off.
        axis_check_s: f64 = 1.5, 0.0..=60.0;
        /// Maximum duration of an approach, in s; then the vehicle holds.
        approach_timeout_s: f64 = 60.0, 1.0..=600.0;
        /// Maximum duration of a descent, in s; then the vehicle holds.
        descend_timeout_s: f64 = 120.0, 1.0..=600.0;
        /// Maximum hold for a lost target or vehicle state, in s; then the landing is aborted.
        hold_timeout_s: f64 = 60.0, 1.0..=600.0;
        /// Maximum hold by the operator, in s; then the landing is aborted.
        operator_hold_timeout_s: f64 = 180.0, 1.0..=3600.0;
        /// Hold time for a lost marker after which the vehicle climbs to `regain_height_m`, in s.
        regain_after_s: f64 = 2.0, 0.0..=60.0;
        /// Height over the target to which the vehicle climbs to see a lost marker again, in m; 0 never
        /// climbs.
        regain_height_m: f64 = 1.5, 0.0..=10.0;
        /// Speed of that climb, in m/s.
        regain_climb_m_s: f64 = 0.3, 0.1..=2.0;
        /// Maximum number of retries: climbs after which the landing starts again, for a lost marker or a
        /// vehicle that does not settle.
        retries: u32 = 10, 0.0..=20.0;
        /// Height gain of a retry, in m, never above the height where the landing started.
        retry_climb_m: f64 = 2.0, 0.0..=20.0;
        /// Speed of that climb, in m/s.
        retry_climb_m_s: f64 = 0.8, 0.1..=3.0;
        /// Maximum duration of a retry, in s; then the search starts.
        retry_timeout_s: f64 = 8.0, 1.0..=60.0;
        /// Height over the target above which the vehicle stays while two detectors see the marker at two
        /// positions, in m; from below it climbs back, but not above the height where the landing started. 0 lets it
        /// descend.
        dispute_height_m: f64 = 2.5, 0.0..=50.0;
        /// Maximum time there until the vehicle holds, in s.
        dispute_timeout_s: f64 = 15.0, 1.0..=600.0;
        /// Interval at which LAND is requested again, in s.
        land_retry_s: f64 = 0.5, 0.1..=5.0;
        /// Maximum wait for the LAND mode, in s; then the landing is aborted.
        land_timeout_s: f64 = 5.0, 0.5..=60.0;
        /// Maximum time in LAND, in s, in addition to the duration of a descent at the autopilot's landing speed; then the
        /// landing is aborted.
        touchdown_timeout_s: f64 = 60.0, 5.0..=600.0;
        /// Descent speed without LAND, where the autopilot refuses it close to the ground, in m/s.
        refused_descend_m_s: f64 = 0.3, 0.1..=1.0;
        /// Height over the target below which LAND can no longer be aborted, in m.
        no_return_height_m: f64 = 1.0, 0.0..=20.0;
        /// Maximum duration of a landing, from start to LAND, in s; then it is aborted.
        landing_timeout_s: f64 = 300.0, 10.0..=3600.0;
        /// Height below which a start in LAND mode only monitors the touchdown, in m, over the same as
        /// `search_height_m`.
        watch_height_m: f64 = 2.0, 0.0..=20.0;
        /// The action of an aborted landing.
        on_abort: OnAbort = OnAbort::Hover;
        /// Height to which an aborted landing climbs with `on_abort = "climb"`, in m, over the same as
        /// `search_height_m`.
        abort_height_m: f64 = 10.0, 0.0..=100.0;
        /// Minimum height at which an aborted landing hovers, in m, over the same as `search_height_m`: lower, it first
        /// climbs, but not above the height where the landing started. 0 never climbs. A vehicle that is still and may stand on
        /// the ground is not lifted.
        abort_hover_m: f64 = 2.5, 0.0..=20.0;
        /// Hover time of an aborted landing before setpoints stop, in s.
        release_after_s: f64 = 5.0, 0.0..=60.0;
        /// Reaction to a low battery.
        on_battery_low: AlarmAction = AlarmAction::Ignore;
        /// Reaction to a nearly empty battery.
        on_battery_critical: AlarmAction = AlarmAction::Land;
        /// Reaction to a lost operator link.
        on_operator_lost: AlarmAction = AlarmAction::Ignore;
        /// Reaction to a lost autopilot link; a hold ends when the link is back.
        on_autopilot_lost: AlarmAction = AlarmAction::Hold;
    }
}

/// The action of an aborted landing.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum OnAbort {
    /// Hover for `release_after_s`, at `abort_hover_m` or higher, then stop sending setpoints: the autopilot holds its
    /// position on its own.
    Hover,
    /// Land where it is, by the autopilot's LAND mode.
    Land,
    /// Climb to `abort_height_m`, then as `Hover`.
    Climb,
}

/// Reaction to an alarm.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum AlarmAction {
    /// The landing continues.
    Ignore,
    /// As if the operator had commanded a hold.
    Hold,
    /// The landing is aborted, and `on_abort` follows.
    Abort,
    /// The autopilot's LAND mode, where the vehicle is.
    Land,
}

settings! {
    /// How the metric guidance brings the vehicle over the target and down.
    MetricConfig in "metric" {
        /// Closing speed per metre of predicted error, in 1/s.
        lateral_gain: f64 = 1.8, 0.1..=3.0;
        /// Acceleration per difference between commanded and actual closing speed, in 1/s.
        velocity_gain: f64 = 4.5, 0.2..=6.0;
        /// Maximum closing speed, in m/s.
        max_lateral_m_s: f64 = 2.0, 0.1..=5.0;
        /// Maximum lateral acceleration, in m/s^2; it tilts the camera.
        lateral_acceleration_m_s2: f64 = 1.2, 0.1..=2.5;
        /// Dead time from the arrival of a detection to the vehicle's response, in s.
        dead_time_s: f64 = 0.3, 0.0..=1.0;
        /// Time for which the present acceleration is assumed to continue, in s.
        acceleration_lead_s: f64 = 0.1, 0.0..=1.0;
        /// Maximum descent speed, in m/s.
        max_descend_m_s: f64 = 2.0, 0.1..=3.0;
        /// Descent speed at the ground, in m/s.
        touchdown_descend_m_s: f64 = 0.5, 0.1..=1.0;
        /// Deceleration of the descent, in m/s^2.
        descend_braking_m_s2: f64 = 0.5, 0.1..=2.5;
        /// Lag from a descent setpoint to its speed, in s.
        descend_lag_s: f64 = 0.45, 0.0..=2.0;
        /// Maximum rate of change of the descent setpoint, in m/s^2.
        descend_acceleration_m_s2: f64 = 2.0, 0.1..=5.0;
        /// Radius of the funnel at the ground, in m; at its edge the descent stops.
        funnel_m: f64 = 0.08, 0.02..=5.0;
        /// Growth of the funnel's radius per metre of height.
        funnel_per_height: f64 = 0.25, 0.0..=2.0;
        /// Age of the newest detection up to which the descent is not slowed, in s.
        fresh_target_s: f64 = 0.5, 0.0..=5.0;
        /// Age of the newest detection beyond which the descent stops, in s, except low over a well-known
        /// target (`blind_height_m`).
        stale_target_s: f64 = 0.7, 0.1..=5.0;
        /// Minimum time left until the ground at the present speed, in s, for gusts to be seen and countered.
        gust_time_s: f64 = 2.0, 0.1..=10.0;
        /// Time for which the autopilot is assumed to follow the last setpoint where it does not report it, in s.
        /// The descent is so slow that the vehicle, should setpoints stop, still brakes before the ground.
        setpoint_loss_s: f64 = 3.0, 0.1..=60.0;
        /// Height over the target at which LAND takes over, in m.
        land_height_m: f64 = 0.05, 0.02..=5.0;
        /// Height of the body's origin over the pad when the vehicle stands on it, in m.
        standing_height_m: f64 = 0.0, -1.0..=2.0;
        /// Waiting time near the ground over which the funnel widens to `blind_error_m`, in s.
        settle_s: f64 = 5.0, 0.1..=60.0;
        /// Maximum lateral error for a touchdown after that wait or without the marker in view, in m.
        blind_error_m: f64 = 0.15, 0.01..=1.0;
        /// Height over the target below which the descent continues without the marker, in m.
        blind_height_m: f64 = 2.2, 0.0..=10.0;
        /// Maximum duration of a descent without the marker, in s.
        blind_s: f64 = 6.0, 0.0..=20.0;
        /// Maximum standard deviation of the estimate for a descent without the marker, in m.
        blind_deviation_m: f64 = 0.06, 0.005..=1.0;
        /// Height down to which the vehicle stays upwind to keep the marker in view, in m.
        view_height_m: f64 = 1.3, 0.2..=50.0;
        /// Image margin around the marker's centre for the marker's size, in m.
        view_margin_m: f64 = 0.11, 0.0..=2.0;
        /// Image margin for the vehicle's attitude changes, in rad.
        view_margin_rad: f64 = 0.07, 0.0..=0.5;
        /// Time constant of the observer of the autopilot's velocity bias, in s.
        drift_time_s: f64 = 0.3, 0.2..=60.0;
        /// Maximum bias of the autopilot's velocity, in m/s; 0 turns the observer off.
        max_drift_m_s: f64 = 0.8, 0.0..=1.0;
        /// Maximum speed of a pad that is followed, in m/s.
        max_pad_m_s: f64 = 5.0, 0.0..=10.0;
        /// Maximum yaw rate towards the pad's heading, in rad/s; 0 holds the heading.
        turn_rad_s: f64 = 0.0, 0.0..=1.0;
        /// Heading at touchdown relative to the marker's upper edge, in rad, clockwise seen from above.
        pad_heading_rad: f64 = 0.0, -7.0..=7.0;
    }
}

settings! {
    /// The constants of the thesis' section 3.2.1, and when its guidance descends.
    ThesisConfig in "thesis" {
        /// Proportional gain for x and y, in m/s per pixel; printed as 1e-6, see `guidance/thesis.rs`.
        kp: f64 = 1e-3, 0.0..=0.1;
        /// Integral gain for x and y, in m/s per pixel and frame.
        ki: f64 = 7e-7, 0.0..=0.01;
        /// Proportional gain for the descent, in m/s per centimetre of altitude; negative is down.
        kpz: f64 = -5e-4, -0.01..=0.0;
        /// Maximum speed along x and y, in m/s.
        max_horizontal_m_s: f64 = 0.5, 0.01..=5.0;
        /// Minimum descent speed, in m/s.
        min_descend_m_s: f64 = 1e-5, 0.0..=1.0;
        /// Maximum descent speed, in m/s.
        max_descend_m_s: f64 = 0.5, 0.01..=5.0;
        /// Radius of the circle around the image's centre in which the marker counts as aligned, in pixels.
        tolerance_px: f64 = 300.0, 1.0..=5000.0;
        /// Altitude over the marker at which the autopilot's LAND takes over, in m.
        land_altitude_m: f64 = 0.8, 0.1..=10.0;
        /// Age of the newest detection beyond which the descent stops, in s.
        stale_target_s: f64 = 0.4, 0.1..=5.0;
        /// Height over the target below which `low_grace_s` is added to that age, in m.
        low_height_m: f64 = 0.8, 0.0..=5.0;
        /// Time added to `stale_target_s` below `low_height_m`, in s.
        low_grace_s: f64 = 0.4, 0.0..=5.0;
        /// Weight of the previous wind noise (lambda of Equation 3.15).
        wind_memory: f64 = 0.9, 0.0..=1.0;
        /// Mean of the wind noise's random term, in m/s.
        wind_mean_m_s: f64 = 0.0, -5.0..=5.0;
        /// Standard deviation of the wind noise's random term, in m/s; 0 turns the noise off.
        wind_sigma_m_s: f64 = 0.1, 0.0..=5.0;
        /// Seed of the wind noise.
        seed: u64 = 0;
        /// Heading of the image's upper edge relative to the vehicle's nose, in rad, clockwise seen from
        /// above.
        image_up_rad: f64 = 0.0, -7.0..=7.0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_defaults_are_within_their_ranges() {
        assert_eq!(Config::default().validate(), Ok(()));
        let guidance = GuidanceConfig::Thesis(ThesisConfig::default());
        assert_eq!(Config { guidance, ..Config::default() }.validate(), Ok(()));
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
