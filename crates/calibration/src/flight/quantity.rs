//! Defines the quantities that a flight gives of a camera (time offset, roll, pitch and yaw of the mount, focal length, k1),
//! and the deviation up to which each counts.

/// Where the quantities are among the parameters.
pub(super) const OFFSET: usize = 0;
pub(super) const MOUNT: usize = 1;
pub(super) const FOCAL: usize = 4;
pub(super) const K1: usize = 5;

/// An estimated quantity.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Quantity {
    /// How much later than their stamps frames are exposed, in seconds.
    TimeOffset,
    /// The camera is turned about the body's forward axis by this much more than configured, in radians.
    MountRoll,
    /// The same about the body's axis to the right.
    MountPitch,
    /// The same about the body's downward axis.
    MountYaw,
    /// True over configured focal length, less 1.
    FocalScale,
    /// The correction of the lens's first radial coefficient.
    K1,
}

/// All quantities, in the order of a result's covariance.
pub const QUANTITIES: [Quantity; 6] = [
    Quantity::TimeOffset,
    Quantity::MountRoll,
    Quantity::MountPitch,
    Quantity::MountYaw,
    Quantity::FocalScale,
    Quantity::K1,
];

impl Quantity {
    /// Its name.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::TimeOffset => "time offset",
            Self::MountRoll => "roll of the mount",
            Self::MountPitch => "pitch of the mount",
            Self::MountYaw => "yaw of the mount",
            Self::FocalScale => "focal length",
            Self::K1 => "lens's k1",
        }
    }

    /// The standard deviation from which on a quantity counts as not observable, in its unit: its error costs about
    /// a centimetre at touchdown, and for k1 the same as the focal length's at the image's border.
    pub fn max_deviation(self) -> f64 {
        match self {
            Self::TimeOffset => 0.0015,
            Self::MountRoll | Self::MountPitch => 0.2f64.to_radians(),
            Self::MountYaw => 0.5f64.to_radians(),
            Self::FocalScale => 0.005,
            Self::K1 => 0.02,
        }
    }

    /// The standard deviation that is assumed before the flight, in its unit: an estimate goes towards the configured value by the
    /// square of its own deviation over this one, so that a focal length which is off by a tenth is found to 0.03 % where 0.5 %
    /// would do.
    pub(super) fn prior_deviation(self) -> f64 {
        match self {
            Self::TimeOffset => 0.3,
            Self::MountRoll | Self::MountPitch | Self::MountYaw => 0.1,
            Self::FocalScale => 0.1,
            Self::K1 => 0.05,
        }
    }

    /// The standard deviation of errors that no flight averages out, in its unit: telemetry that comes with stamps of whole
    /// milliseconds and every 50 ms. Found in simulated landings whose autopilot does not err.
    pub(super) fn model_deviation(self) -> f64 {
        match self {
            Self::TimeOffset => 1e-4,
            Self::MountRoll | Self::MountPitch | Self::MountYaw => 0.01f64.to_radians(),
            Self::FocalScale => 4e-4,
            Self::K1 => 5e-4,
        }
    }

    /// The longest step of an iteration, in its unit: so far the equations are about linear.
    pub(super) fn max_step(self) -> f64 {
        match self {
            Self::TimeOffset => 0.05,
            Self::MountRoll | Self::MountPitch | Self::MountYaw => 0.1,
            Self::FocalScale | Self::K1 => 0.05,
        }
    }

    pub(super) fn index(self) -> usize {
        match self {
            Self::TimeOffset => OFFSET,
            Self::MountRoll => MOUNT,
            Self::MountPitch => MOUNT + 1,
            Self::MountYaw => MOUNT + 2,
            Self::FocalScale => FOCAL,
            Self::K1 => K1,
        }
    }
}
