//! The lander's events: vehicle state and status, frames with their marker, operator's commands, alarms,
//! delay of the link, the autopilot's limits, detectors that are alive or disagree, ticks.

use std::fmt;

use geometry::{Body, Camera, Marker, Ned, Pixel, Point, Rotation, Transform, Vector};
use libm::fmax;
use nalgebra::Matrix3;

use crate::time::Timestamp;

/// Something that happened.
#[derive(Copy, Clone, Debug, PartialEq)]
#[expect(
    clippy::large_enum_variant,
    reason = "passed by value, one at a time; nothing may be allocated in flight"
)]
pub enum Event {
    /// The autopilot reported the vehicle's state.
    Vehicle(VehicleState),
    /// The autopilot reported mode, motors or contact with the ground, which are known also while position or
    /// attitude is missing.
    Status(VehicleStatus),
    /// The last detector has disappeared (false), or one has appeared.
    DetectorsAlive(bool),
    /// A detector has searched an image.
    Frame(FrameObservation),
    /// The operator gave a command.
    Operator(OperatorCommand),
    /// A limit was reached.
    Alarm(Alarm),
    /// The delay of the link to the autopilot, both ways together, in seconds.
    LinkDelay(f64),
    /// How the autopilot follows setpoints has become known.
    Limits(AutopilotLimits),
    /// Two detectors see the marker at two positions or with two headings, and it is not known which is right; or no longer.
    Dispute(bool),
    /// Time has passed.
    Tick,
}

/// An operator's command.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum OperatorCommand {
    /// Start a landing, also after a terminal phase.
    Start,
    /// Stop and hover until `Resume`.
    Hold,
    /// Continue after `Hold`.
    Resume,
    /// Abort the landing.
    Abort,
    /// Land straight down where the vehicle is, without the marker.
    LandHere,
}

/// A limit that the caller monitors; the reaction to each is configured.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Alarm {
    /// There is enough left for one landing.
    BatteryLow,
    /// There is enough left to go straight down.
    BatteryCritical,
    /// The link to the operator is lost.
    OperatorLost,
    /// The link to the autopilot is lost.
    AutopilotLost,
}

impl fmt::Display for Alarm {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::BatteryLow => "the battery is low",
            Self::BatteryCritical => "the battery is nearly empty",
            Self::OperatorLost => "the link to the operator is lost",
            Self::AutopilotLost => "the link to the autopilot is lost",
        })
    }
}

/// How the autopilot follows velocity setpoints. The defaults are those of ArduPilot Copter 4.5.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct AutopilotLimits {
    /// Time for which it follows the last setpoint before it stops, in s (ArduPilot's GUID_TIMEOUT, PX4's
    /// COM_OF_LOSS_T); `None` while it is not known.
    pub setpoint_timeout_s: Option<f64>,
    /// Maximum horizontal acceleration, in m/s^2 (WPNAV_ACCEL).
    pub acceleration_m_s2: f64,
    /// Maximum horizontal jerk, in m/s^3 (PSC_JERK_XY).
    pub jerk_m_s3: f64,
    /// Maximum vertical acceleration, in m/s^2 (WPNAV_ACCEL_Z).
    pub vertical_acceleration_m_s2: f64,
    /// Slowest speed of its LAND down to the ground, in m/s (ArduPilot's LAND_SPEED and LAND_SPEED_HIGH, PX4's
    /// MPC_LAND_SPEED); the default is the slowest that ArduPilot takes.
    pub land_m_s: f64,
}

impl Default for AutopilotLimits {
    fn default() -> Self {
        Self {
            setpoint_timeout_s: None,
            acceleration_m_s2: 2.5,
            jerk_m_s3: 5.0,
            vertical_acceleration_m_s2: 1.0,
            land_m_s: 0.3,
        }
    }
}

impl AutopilotLimits {
    /// Smallest and largest plausible value of each limit; ArduPilot's own ranges are narrower.
    const PLAUSIBLE: std::ops::RangeInclusive<f64> = 0.05..=60.0;

    /// The limits, with the defaults in place of values that no vehicle has.
    #[must_use]
    pub fn plausible(self) -> Self {
        let or = |value: f64, default: f64| {
            if Self::PLAUSIBLE.contains(&value) { value } else { default }
        };
        let default = Self::default();
        Self {
            setpoint_timeout_s: self.setpoint_timeout_s.filter(|s| (0.0..=3600.0).contains(s)),
            acceleration_m_s2: or(self.acceleration_m_s2, default.acceleration_m_s2),
            jerk_m_s3: or(self.jerk_m_s3, default.jerk_m_s3),
            vertical_acceleration_m_s2: or(
                self.vertical_acceleration_m_s2,
                default.vertical_acceleration_m_s2,
            ),
            land_m_s: or(self.land_m_s, default.land_m_s),
        }
    }
}

/// The vehicle as the autopilot estimates it at one moment.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct VehicleState {
    /// Time of the state.
    pub stamp: Timestamp,
    /// The attitude.
    pub ned_from_body: Rotation<Ned, Body>,
    /// Position of the body's origin, in metres from the autopilot's local origin.
    pub position: Point<Ned>,
    /// Velocity in m/s.
    pub velocity: Vector<Ned>,
    /// The flight mode.
    pub mode: Mode,
    /// True when the motors may turn.
    pub armed: bool,
    /// The autopilot's landed state.
    pub landed: Landed,
}

/// The state of the vehicle that does not depend on its position.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct VehicleStatus {
    /// The flight mode.
    pub mode: Mode,
    /// True when the motors may turn.
    pub armed: bool,
    /// The autopilot's landed state.
    pub landed: Landed,
}

/// A flight mode, as far as a landing cares.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Mode {
    /// The autopilot follows velocity setpoints.
    Guided,
    /// The autopilot lands where it is.
    Land,
    /// The pilot or another program flies.
    Other,
    /// Not reported for seconds: the pilot may fly.
    Unknown,
}

/// Contact with the ground, as the autopilot sees it.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Landed {
    /// Not reported yet.
    Unknown,
    /// On the ground.
    OnGround,
    /// A take-off is under way.
    TakingOff,
    /// Flying.
    InAir,
    /// The autopilot is landing.
    Landing,
}

/// A detector's result for one image, with or without the marker.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct FrameObservation {
    /// Mid-exposure.
    pub stamp: Timestamp,
    /// Width and height of the image in pixels.
    pub image_size: (u32, u32),
    /// Focal length in pixels, when the camera is calibrated.
    pub focal_px: Option<f64>,
    /// How the camera is mounted, when that is known.
    pub body_from_camera: Option<Rotation<Body, Camera>>,
    /// The marker, when it was found.
    pub marker: Option<MarkerInFrame>,
}

/// A marker found in a frame.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct MarkerInFrame {
    /// The projection of its centre.
    pub centre: Pixel,
    /// Where it is, seen from the vehicle; `None` when its size or the camera is unknown.
    pub body_from_marker: Option<Transform<Body, Marker>>,
    /// The other solution of a flat marker's pose, when there is one.
    pub alternative: Option<Transform<Body, Marker>>,
    /// Covariance of the pose's origin, in body axes and m^2; `None` when the detector gives none.
    pub covariance_m2: Option<Matrix3<f64>>,
    /// Edge or diameter of the marker in the image, in pixels.
    pub size_px: Option<f64>,
    /// From 0 (a guess) to 1 (certain).
    pub confidence: f64,
}

/// Maximum distance of a marker from the vehicle in a pose that is looked at, in metres.
const MAX_POSE_M: f64 = 1e3;
/// Maximum sum of a covariance's diagonal, in m^2: 100 m in each direction.
const MAX_VARIANCE_M2: f64 = 3e4;
/// Rounding error of a covariance relative to its diagonal.
const COVARIANCE_ERROR: f64 = 1e-6;

impl VehicleState {
    /// Mode, motors and contact with the ground.
    pub fn status(&self) -> VehicleStatus {
        VehicleStatus { mode: self.mode, armed: self.armed, landed: self.landed }
    }

    /// True when no number is infinite or not a number.
    pub fn is_finite(&self) -> bool {
        self.position.is_finite()
            && self.velocity.is_finite()
            && self.ned_from_body.wxyz().iter().all(|c| c.is_finite())
    }

    /// Heading in radians, from north towards east.
    pub fn heading_rad(&self) -> f64 {
        self.ned_from_body.euler().2
    }
}

impl MarkerInFrame {
    /// True when no number is infinite or not a number.
    pub fn is_finite(&self) -> bool {
        self.centre.x.is_finite()
            && self.centre.y.is_finite()
            && self.confidence.is_finite()
            && self.body_from_marker.is_none_or(|pose| is_finite(&pose))
            && self.alternative.is_none_or(|pose| is_finite(&pose))
            && self.covariance_m2.is_none_or(|m| m.iter().all(|c| c.is_finite()))
            && self.size_px.is_none_or(f64::is_finite)
    }

    /// True when its poses are near enough to be those of a pad.
    pub fn is_near(&self) -> bool {
        let is_near =
            |pose: Transform<Body, Marker>| (pose.origin() - Point::origin()).norm() <= MAX_POSE_M;
        self.body_from_marker.is_none_or(is_near) && self.alternative.is_none_or(is_near)
    }

    /// True when its covariance, if it has one, can be that of a position: symmetric, positive semi-definite
    /// and not larger than any range.
    pub fn has_sound_covariance(&self) -> bool {
        self.covariance_m2.is_none_or(|covariance| is_covariance(&covariance))
    }
}

/// True for a matrix in m^2 that can be the covariance of a position: finite, symmetric, positive semi-definite and not larger than any
/// range. A symmetric matrix is positive semi-definite when no principal minor is negative.
pub fn is_covariance(m: &Matrix3<f64>) -> bool {
    let trace = m.trace();
    if !(0.0..=MAX_VARIANCE_M2).contains(&trace) {
        return false;
    }
    // Scaled, so that small covariances are not judged by their rounding errors and products do not vanish.
    let scale = fmax(trace, f64::MIN_POSITIVE);
    let m = m / scale;
    let is_symmetric = (m - m.transpose()).amax() <= COVARIANCE_ERROR;
    let minor = |i: usize, j: usize| m[(i, i)] * m[(j, j)] - m[(i, j)] * m[(j, i)];
    let minors =
        [m[(0, 0)], m[(1, 1)], m[(2, 2)], minor(0, 1), minor(0, 2), minor(1, 2), m.determinant()];
    is_symmetric && minors.iter().all(|minor| *minor >= -COVARIANCE_ERROR)
}

fn is_finite(pose: &Transform<Body, Marker>) -> bool {
    pose.origin().is_finite() && pose.rotation().wxyz().iter().all(|c| c.is_finite())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_valid_covariances_are_accepted() {
        let diagonal = |x, y, z| Matrix3::from_diagonal(&nalgebra::Vector3::new(x, y, z));
        let with = |row, column, value: f64| {
            let mut m = diagonal(1e-4, 1e-4, 1e-4);
            m[(row, column)] = value;
            m[(column, row)] = value;
            m
        };
        let tiny = f64::from_bits(1);
        for sound in [
            diagonal(0.0, 0.0, 0.0),
            diagonal(tiny, tiny, tiny),
            diagonal(1e-300, 0.0, 1e-300),
            diagonal(1e-4, 1e-4, 1e-2),
            diagonal(1e4, 1e4, 1e4),
            with(0, 1, 0.99e-4),
            with(0, 2, -1e-4),
        ] {
            assert!(is_covariance(&sound), "{sound}");
        }
        let mut crooked = diagonal(1e-4, 1e-4, 1e-4);
        crooked[(0, 1)] = 5e-5;
        for unsound in [
            diagonal(-1e-4, 1e-4, 1e-4),
            diagonal(1e-4, 1e-4, -1e-9),
            diagonal(-1.0, -1.0, -1.0),
            with(0, 1, 2e-4),
            with(1, 2, -1.01e-4),
            diagonal(1e5, 1e-4, 1e-4),
            diagonal(f64::MAX, f64::MAX, 1.0),
            diagonal(f64::NAN, 1.0, 1.0),
            diagonal(f64::INFINITY, 1.0, 1.0),
            with(0, 1, f64::NAN),
            crooked,
        ] {
            assert!(!is_covariance(&unsound), "{unsound}");
        }
    }
}
