//! The trait of a guidance (may it descend, has it a target, how far it is, which velocity and yaw rate), and its
//! input: vehicle, target and its age, limits, link delay.

use geometry::{Ned, Vector};

use crate::decision::{Reason, TargetEstimate};
use crate::event::{AutopilotLimits, FrameObservation, VehicleState};
use crate::time::Timestamp;

/// The input of a guidance.
#[derive(Copy, Clone, Debug)]
pub struct Situation<'a> {
    /// The present time.
    pub now: Timestamp,
    /// The vehicle's newest state.
    pub vehicle: &'a VehicleState,
    /// The target, once it was measured.
    pub target: Option<TargetEstimate>,
    /// Age of the newest detection used, in seconds; infinite without one.
    pub age_s: f64,
    /// Smallest angle from the image's centre to its edge, in radians, when it is known.
    pub half_view_rad: Option<f64>,
    /// The pad may move: LAND, which stops the vehicle over the ground, must come after the touchdown.
    pub pad_moves: bool,
    /// Maximum heave speed of the pad, in m/s.
    pub pad_heave_m_s: f64,
    /// How the autopilot follows setpoints.
    pub limits: AutopilotLimits,
    /// Delay of the link to the autopilot, both ways together, in seconds.
    pub link_delay_s: f64,
    /// Why the vehicle must not descend now, whatever the guidance sees; `None` when it may.
    pub level_because: Option<Reason>,
}

/// The progress of a guidance.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Progress {
    /// Too far from the target to descend.
    Aligning,
    /// Over the target.
    Descending,
    /// Over the target without a recent detection; the estimate is good enough for the rest of the descent.
    Blind,
    /// Low for too long without reaching the target.
    Stuck,
    /// As before.
    Unchanged,
    /// Low enough for the autopilot's LAND, for this reason.
    Ready(Reason),
}

/// A guidance law: steers the vehicle over the target and down.
pub trait Guidance {
    /// True when the vehicle may descend.
    fn may_descend(&self, situation: &Situation<'_>) -> bool;

    /// True when the target's position is known well enough to wait there for the marker.
    fn has_target(&self, _situation: &Situation<'_>) -> bool {
        false
    }

    /// True when the vehicle touches the ground, or is so low and fast that it will: a command to climb would come too late.
    fn touches_down(&self, _situation: &Situation<'_>) -> bool {
        false
    }

    /// True when it also steers the vehicle while LAND is awaited.
    fn steers_until_land(&self) -> bool {
        false
    }

    /// True when it cannot use a marker without a pose.
    fn needs_pose(&self) -> bool {
        false
    }

    /// A frame has arrived while the vehicle is guided; heading in radians from north, altitude over the
    /// marker in metres.
    fn observe(&mut self, _frame: &FrameObservation, _heading_rad: f64, _altitude_m: f64) {}

    /// How far it has brought the vehicle.
    fn progress(&mut self, situation: &Situation<'_>) -> Progress;

    /// The commanded velocity, and why.
    fn velocity(&mut self, situation: &Situation<'_>) -> (Vector<Ned>, Reason);

    /// The setpoint that was sent in place of the commanded velocity.
    fn on_setpoint_sent(&mut self, _velocity: Vector<Ned>) {}

    /// The commanded yaw rate, in rad/s clockwise seen from above.
    fn yaw_rate(&self, _situation: &Situation<'_>) -> f64 {
        0.0
    }

    /// A retry begins: it has the time of the first try, also where it cannot climb.
    fn begin_retry(&mut self) {}

    /// Resets the integrators of the guidance: the vehicle is not guided now.
    fn reset(&mut self);
}

impl Situation<'_> {
    /// Height over the target in metres by the detections' poses; infinite before the first of them.
    pub fn height_m(&self) -> f64 {
        self.target.map_or(f64::INFINITY, |target| target.height_m)
    }
}
