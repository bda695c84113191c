//! The events that the lander reacts to.

use geometry::{Body, Camera, Marker, Ned, Pixel, Point, Rotation, Transform, Vector};
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
    /// A detector has searched an image.
    Frame(FrameObservation),
    /// The operator gave a command.
    Operator(OperatorCommand),
    /// A limit was reached.
    Alarm(Alarm),
    /// How the autopilot follows setpoints has become known.
    Limits(AutopilotLimits),
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
}

impl Default for AutopilotLimits {
    fn default() -> Self {
        Self {
            setpoint_timeout_s: None,
            acceleration_m_s2: 2.5,
            jerk_m_s3: 5.0,
            vertical_acceleration_m_s2: 1.0,
        }
    }
}

impl AutopilotLimits {
    /// Smallest and largest value that is believed of each limit; ArduPilot's own ranges are narrower.
    const BELIEVED: std::ops::RangeInclusive<f64> = 0.05..=60.0;

    /// The limits, with the defaults in place of values that no vehicle has.
    #[must_use]
    pub fn plausible(self) -> Self {
        let or = |value: f64, default: f64| {
            if Self::BELIEVED.contains(&value) { value } else { default }
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

/// A flight mode, as far as a landing cares.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Mode {
    /// The autopilot follows velocity setpoints.
    Guided,
    /// The autopilot lands where it is.
    Land,
    /// Somebody else flies.
    Other,
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

/// What a detector found in one image, with or without the marker.
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

impl VehicleState {
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
}

fn is_finite(pose: &Transform<Body, Marker>) -> bool {
    pose.origin().is_finite() && pose.rotation().wxyz().iter().all(|c| c.is_finite())
}
