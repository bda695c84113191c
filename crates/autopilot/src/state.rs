//! The vehicle's state from MAVLink messages: attitude, position, velocity and range with their stamps,
//! battery, landed state, and readiness to arm with the missing conditions.
//!
//! A stamp is in nanoseconds of the caller's clock: the time of the measurement where the autopilot's clock
//! is known ([`crate::clock`]), else that of its reception. `boot_ms` is the autopilot's own clock.

use std::fmt;

use geometry::{Body, Ned, Point, Rotation, Vector};

use crate::dialect::{
    ATTITUDE_DATA, ATTITUDE_QUATERNION_DATA, BATTERY_STATUS_DATA, DISTANCE_SENSOR_DATA,
    EkfStatusFlags, EstimatorStatusFlags, LOCAL_POSITION_NED_DATA, MavLandedState,
    MavSensorOrientation, MavSysStatusSensor, SYS_STATUS_DATA,
};
use crate::mode::FlightMode;

/// The attitude at one time.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Attitude {
    /// Time of the measurement, or of the reception, in ns.
    pub stamp_ns: i64,
    /// Time of the measurement, in ms since the autopilot started.
    pub boot_ms: u32,
    /// The attitude.
    pub ned_from_body: Rotation<Ned, Body>,
    /// The angular rate in rad/s.
    pub rate_in_body: Vector<Body>,
}

/// Position and velocity at one time.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Position {
    /// Time of the measurement, or of the reception, in ns.
    pub stamp_ns: i64,
    /// Time of the measurement, in ms since the autopilot started.
    pub boot_ms: u32,
    /// The position in m from the autopilot's local origin.
    pub position: Point<Ned>,
    /// The velocity in m/s.
    pub velocity: Vector<Ned>,
}

/// A distance measured downwards.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Range {
    /// When it was received, in ns.
    pub stamp_ns: i64,
    /// The distance in m along the body's z axis.
    pub distance_m: f64,
}

/// The battery; unknown values are `None`.
#[derive(Copy, Clone, Debug, Default, PartialEq)]
pub struct Battery {
    /// Voltage in V.
    pub voltage_v: Option<f64>,
    /// Current in A.
    pub current_a: Option<f64>,
    /// Remaining charge, from 0 to 1.
    pub remaining: Option<f64>,
}

/// Contact with the ground, as the autopilot reports it.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq)]
pub enum LandedState {
    /// Not reported yet.
    #[default]
    Unknown,
    /// On the ground.
    OnGround,
    /// In the air.
    InAir,
    /// Taking off.
    TakingOff,
    /// Landing in LAND.
    Landing,
}

/// The state of the vehicle.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct VehicleState {
    /// Time of the last reception, in ns.
    pub stamp_ns: i64,
    /// The newest attitude.
    pub attitude: Option<Attitude>,
    /// The newest position and velocity; none before the autopilot has an origin.
    pub position: Option<Position>,
    /// The newest distance measured downwards.
    pub range: Option<Range>,
    /// The flight mode.
    pub mode: FlightMode,
    /// Whether the motors are armed, and not stopped by PX4's kill switch or flight termination.
    pub armed: bool,
    /// Contact with the ground, as far as its reports are believed: those that contradict a flight are not.
    pub landed: LandedState,
    /// Whether it can be armed and flown: pre-arm checks passed and a position known.
    pub ready: bool,
    /// The battery.
    pub battery: Battery,
    /// Whether heartbeats are received, and with them the mode and the motors known.
    pub connected: bool,
}

/// Whether the vehicle can be armed and flown by position, and why not.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Readiness {
    /// Result of the pre-arm checks; none while unknown or not supported.
    prearm: Option<bool>,
    ekf: Option<EkfStatusFlags>,
    /// The same of PX4.
    estimator: Option<EstimatorStatusFlags>,
    has_position: bool,
    /// ArduPilot's last text about the pre-arm checks.
    complaint: Option<String>,
    /// The reasons that PX4's checks give. They stay while the checks pass: those of another mode may fail without a new report.
    checks: Option<String>,
}

impl LandedState {
    /// True when it is off the ground.
    pub fn is_flying(self) -> bool {
        matches!(self, Self::InAir | Self::TakingOff | Self::Landing)
    }
}

impl fmt::Display for LandedState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Unknown => "unknown",
            Self::OnGround => "on the ground",
            Self::InAir => "in the air",
            Self::TakingOff => "taking off",
            Self::Landing => "landing",
        })
    }
}

impl From<MavLandedState> for LandedState {
    fn from(state: MavLandedState) -> Self {
        match state {
            MavLandedState::MAV_LANDED_STATE_UNDEFINED => Self::Unknown,
            MavLandedState::MAV_LANDED_STATE_ON_GROUND => Self::OnGround,
            MavLandedState::MAV_LANDED_STATE_IN_AIR => Self::InAir,
            MavLandedState::MAV_LANDED_STATE_TAKEOFF => Self::TakingOff,
            MavLandedState::MAV_LANDED_STATE_LANDING => Self::Landing,
        }
    }
}

impl Attitude {
    /// From ATTITUDE; `None` when a number is not finite.
    pub fn from_angles(stamp_ns: i64, message: &ATTITUDE_DATA) -> Option<Self> {
        let [roll, pitch, yaw] = [message.roll, message.pitch, message.yaw].map(f64::from);
        let finite = [roll, pitch, yaw].iter().all(|angle| angle.is_finite());
        let ned_from_body = finite.then(|| Rotation::from_euler(roll, pitch, yaw))?;
        let rate = [message.rollspeed, message.pitchspeed, message.yawspeed];
        Self::new(stamp_ns, message.time_boot_ms, ned_from_body, rate)
    }

    /// From ATTITUDE_QUATERNION; `None` when a number is not finite or the quaternion has no length.
    pub fn from_quaternion(stamp_ns: i64, message: &ATTITUDE_QUATERNION_DATA) -> Option<Self> {
        let wxyz = [message.q1, message.q2, message.q3, message.q4].map(f64::from);
        let rate = [message.rollspeed, message.pitchspeed, message.yawspeed];
        Self::new(stamp_ns, message.time_boot_ms, Rotation::from_wxyz(wxyz)?, rate)
    }

    fn new(
        stamp_ns: i64,
        boot_ms: u32,
        ned_from_body: Rotation<Ned, Body>,
        rate: [f32; 3],
    ) -> Option<Self> {
        let [x, y, z] = rate.map(f64::from);
        let rate_in_body = Vector::new(x, y, z);
        rate_in_body.is_finite().then_some(Self { stamp_ns, boot_ms, ned_from_body, rate_in_body })
    }
}

impl Position {
    /// From LOCAL_POSITION_NED; `None` when a number is not finite.
    pub fn from_local(stamp_ns: i64, message: &LOCAL_POSITION_NED_DATA) -> Option<Self> {
        let position = Point::new(message.x.into(), message.y.into(), message.z.into());
        let velocity = Vector::new(message.vx.into(), message.vy.into(), message.vz.into());
        let finite = position.is_finite() && velocity.is_finite();
        finite.then_some(Self { stamp_ns, boot_ms: message.time_boot_ms, position, velocity })
    }

    /// True for the numbers of an `earlier` one to the last bit although they show that the vehicle moves: there is no new
    /// estimate. An estimator's numbers change always, also on the ground; only a simulated vehicle is stationary.
    pub(crate) fn repeats(&self, earlier: &Self) -> bool {
        self.position == earlier.position
            && self.velocity == earlier.velocity
            && self.velocity != Vector::zero()
    }
}

impl Range {
    /// From DISTANCE_SENSOR; `None` unless it looks down and sees the ground.
    pub fn downwards(stamp_ns: i64, message: &DISTANCE_SENSOR_DATA) -> Option<Self> {
        let down = message.orientation == MavSensorOrientation::MAV_SENSOR_ROTATION_PITCH_270;
        let seen =
            (message.min_distance..=message.max_distance).contains(&message.current_distance);
        let distance_m = f64::from(message.current_distance) / 100.0;
        (down && seen && distance_m > 0.0).then_some(Self { stamp_ns, distance_m })
    }
}

impl Battery {
    /// From SYS_STATUS, where -1 and 65535 mean unknown.
    pub fn from_status(message: &SYS_STATUS_DATA) -> Self {
        let voltage = message.voltage_battery;
        Self {
            voltage_v: (voltage != u16::MAX).then(|| f64::from(voltage) / 1000.0),
            current_a: amperes(message.current_battery),
            remaining: fraction(message.battery_remaining),
        }
    }

    /// From BATTERY_STATUS, which may contain the charge where SYS_STATUS does not.
    pub fn from_details(message: &BATTERY_STATUS_DATA) -> Self {
        Self {
            voltage_v: None,
            current_a: amperes(message.current_battery),
            remaining: fraction(message.battery_remaining),
        }
    }

    /// Both combined: a value that only one of them contains is retained, and of two charges the lower one counts.
    pub fn joined_with(&self, details: &Self) -> Self {
        let lower = |a: f64, b: f64| if b < a { b } else { a };
        let remaining = match (self.remaining, details.remaining) {
            (Some(a), Some(b)) => Some(lower(a, b)),
            (a, b) => a.or(b),
        };
        Self {
            voltage_v: self.voltage_v.or(details.voltage_v),
            current_a: details.current_a.or(self.current_a),
            remaining,
        }
    }
}

fn amperes(centiamperes: i16) -> Option<f64> {
    (centiamperes >= 0).then(|| f64::from(centiamperes) / 100.0)
}

fn fraction(percent: i8) -> Option<f64> {
    (0..=100).contains(&percent).then(|| f64::from(percent) / 100.0)
}

impl Readiness {
    pub(crate) fn take_status(&mut self, message: &SYS_STATUS_DATA) {
        let prearm = MavSysStatusSensor::MAV_SYS_STATUS_PREARM_CHECK;
        let offered = message.onboard_control_sensors_present.contains(prearm);
        self.prearm = offered.then(|| message.onboard_control_sensors_health.contains(prearm));
        if self.prearm == Some(true) {
            self.complaint = None;
        }
    }

    pub(crate) fn take_ekf(&mut self, flags: EkfStatusFlags) {
        self.ekf = Some(flags);
    }

    pub(crate) fn take_estimator(&mut self, flags: EstimatorStatusFlags) {
        self.estimator = Some(flags);
    }

    pub(crate) fn take_position(&mut self) {
        self.has_position = true;
    }

    pub(crate) fn take_text(&mut self, text: &str) {
        if let Some(complaint) = text.strip_prefix("PreArm: ") {
            self.complaint = Some(complaint.to_owned());
        }
    }

    /// Why PX4 cannot be armed, by its checks.
    pub(crate) fn take_checks(&mut self, why: Option<String>) {
        self.checks = why;
    }

    pub(crate) fn is_ready(&self) -> bool {
        let estimates = match (self.ekf, self.estimator) {
            (Some(flags), _) => ekf_is_ready(flags),
            (None, Some(flags)) => estimator_is_ready(flags),
            (None, None) => false,
        };
        self.prearm != Some(false) && estimates && self.has_position
    }

    /// The missing conditions, as texts; empty when it is ready.
    pub(crate) fn reasons(&self) -> Vec<String> {
        let mut reasons = Vec::new();
        if !self.has_position {
            reasons.push("waiting for the EKF origin (no LOCAL_POSITION_NED yet)".to_owned());
        }
        match (self.ekf, self.estimator) {
            (None, None) => {
                reasons.push("waiting for EKF_STATUS_REPORT or ESTIMATOR_STATUS".to_owned());
            }
            (Some(flags), _) if !ekf_is_ready(flags) => {
                reasons.push(format!("the EKF has no position yet (flags {})", flags.bits()));
            }
            (None, Some(flags)) if !estimator_is_ready(flags) => {
                reasons.push(format!("the estimator has no position yet (flags {})", flags.bits()));
            }
            _ => {}
        }
        if self.prearm == Some(false) {
            let complaint = self.checks.as_deref().or(self.complaint.as_deref());
            let complaint = complaint.unwrap_or("checks not passed yet");
            reasons.push(format!("prearm: {complaint}"));
        }
        reasons
    }
}

/// Attitude, velocity and an absolute or relative position are valid, and the filter is not in constant
/// position mode.
fn ekf_is_ready(flags: EkfStatusFlags) -> bool {
    let needed = EkfStatusFlags::EKF_ATTITUDE
        | EkfStatusFlags::EKF_VELOCITY_HORIZ
        | EkfStatusFlags::EKF_VELOCITY_VERT
        | EkfStatusFlags::EKF_POS_VERT_ABS;
    let horizontal = EkfStatusFlags::EKF_POS_HORIZ_ABS | EkfStatusFlags::EKF_POS_HORIZ_REL;
    let wrong = EkfStatusFlags::EKF_CONST_POS_MODE | EkfStatusFlags::EKF_UNINITIALIZED;
    flags.contains(needed) && flags.intersects(horizontal) && !flags.intersects(wrong)
}

/// The same of PX4's ESTIMATOR_STATUS. Its filter is in constant position mode whenever the vehicle is
/// stationary (since
/// 1.15, `EKF/ekf_helper.cpp: get_ekf_soln_status`): that is a problem only without any position source.
fn estimator_is_ready(flags: EstimatorStatusFlags) -> bool {
    let needed = EstimatorStatusFlags::ESTIMATOR_ATTITUDE
        | EstimatorStatusFlags::ESTIMATOR_VELOCITY_HORIZ
        | EstimatorStatusFlags::ESTIMATOR_VELOCITY_VERT
        | EstimatorStatusFlags::ESTIMATOR_POS_VERT_ABS;
    let horizontal = EstimatorStatusFlags::ESTIMATOR_POS_HORIZ_ABS
        | EstimatorStatusFlags::ESTIMATOR_POS_HORIZ_REL;
    let is_known = EstimatorStatusFlags::ESTIMATOR_PRED_POS_HORIZ_ABS
        | EstimatorStatusFlags::ESTIMATOR_PRED_POS_HORIZ_REL;
    let only_assumed = flags.contains(EstimatorStatusFlags::ESTIMATOR_CONST_POS_MODE)
        && !flags.intersects(is_known);
    flags.contains(needed) && flags.intersects(horizontal) && !only_assumed
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_that_are_not_finite_are_refused() {
        let attitude = ATTITUDE_DATA { yaw: f32::NAN, ..Default::default() };
        assert_eq!(Attitude::from_angles(0, &attitude), None);
        let attitude = ATTITUDE_QUATERNION_DATA::default();
        assert_eq!(Attitude::from_quaternion(0, &attitude), None, "no length");
        let position = LOCAL_POSITION_NED_DATA { vz: f32::INFINITY, ..Default::default() };
        assert_eq!(Position::from_local(0, &position), None);
    }

    #[test]
    fn it_is_ready_with_the_flags_of_a_ready_ardupilot_and_gives_reasons_before() {
        let mut readiness = Readiness::default();
        let prearm = MavSysStatusSensor::MAV_SYS_STATUS_PREARM_CHECK;
        let mut status =
            SYS_STATUS_DATA { onboard_control_sensors_present: prearm, ..Default::default() };
        status.onboard_control_sensors_health = MavSysStatusSensor::empty();
        readiness.take_status(&status);
        readiness.take_text("PreArm: Need Position Estimate");
        readiness.take_ekf(EkfStatusFlags::from_bits_retain(167));
        let reasons = readiness.reasons().join("; ");
        assert!(
            reasons.contains("EKF origin") && reasons.contains("prearm: Need Position"),
            "{reasons}"
        );
        assert!(!readiness.is_ready());

        status.onboard_control_sensors_health = prearm;
        readiness.take_status(&status);
        readiness.take_ekf(EkfStatusFlags::from_bits_retain(831));
        readiness.take_position();
        assert!(readiness.is_ready());
        assert!(readiness.reasons().is_empty());
    }

    #[test]
    fn a_stationary_px4_is_ready_and_one_that_only_assumes_its_position_is_not() {
        let mut readiness = Readiness::default();
        readiness.take_position();
        // The flags that PX4 1.17 reports before takeoff, with and without a satellite fix.
        readiness.take_estimator(EstimatorStatusFlags::from_bits_retain(1023));
        assert!(readiness.is_ready(), "{:?}", readiness.reasons());
        readiness.take_estimator(EstimatorStatusFlags::from_bits_retain(1023 - 256 - 512));
        assert!(!readiness.is_ready());
        assert!(readiness.reasons().join("; ").contains("no position yet (flags 255)"));
    }

    #[test]
    fn unknown_battery_values_stay_unknown() {
        let message = SYS_STATUS_DATA {
            voltage_battery: u16::MAX,
            current_battery: -1,
            battery_remaining: -1,
            ..Default::default()
        };
        assert_eq!(Battery::from_status(&message), Battery::default());
    }

    #[test]
    fn a_charge_that_only_one_message_contains_is_retained_and_of_two_the_lower_one() {
        let (unknown, low) = (
            Battery::default(),
            BATTERY_STATUS_DATA { battery_remaining: 8, ..Default::default() },
        );
        let low = Battery::from_details(&low);
        assert_eq!(unknown.joined_with(&low).remaining, Some(0.08));
        let half = Battery { remaining: Some(0.5), ..unknown };
        assert_eq!(half.joined_with(&low).remaining, Some(0.08));
        assert_eq!(low.joined_with(&half).remaining, Some(0.08));
        assert_eq!(half.joined_with(&unknown).remaining, Some(0.5));
    }
}
