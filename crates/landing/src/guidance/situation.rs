//! The input of a guidance, and its progress.

use crate::decision::{Reason, TargetEstimate};
use crate::event::VehicleState;
use crate::time::Timestamp;

/// The input of a guidance.
#[derive(Copy, Clone, Debug)]
pub struct Situation<'a> {
    /// The present time.
    pub now: Timestamp,
    /// The vehicle's newest state.
    pub vehicle: &'a VehicleState,
    /// The target, when detections have poses.
    pub target: Option<TargetEstimate>,
    /// Time since the exposure of the newest marker used, in seconds; infinite when there was none.
    pub age_s: f64,
    /// Smallest angle from the middle of the camera's image to its edge, in radians, when it is known.
    pub half_view_rad: Option<f64>,
    /// The pad may move: LAND, which stops the vehicle over the ground, must come after the touch.
    pub pad_moves: bool,
    /// Fastest heave of the pad, in m/s.
    pub pad_heave_m_s: f64,
}

/// How far a guidance has brought the vehicle.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Progress {
    /// Too far beside the target to descend.
    Aligning,
    /// Over the target.
    Descending,
    /// Over the target, which is not seen; its estimate is good enough for the rest of the way.
    Blind,
    /// Low for long and never near enough.
    Stuck,
    /// As before.
    Unchanged,
    /// Low enough for the autopilot's LAND, for this reason.
    Ready(Reason),
}

impl Situation<'_> {
    /// Height over the target in metres: by the detections' poses, else over the autopilot's local origin.
    pub fn height_m(&self) -> f64 {
        self.target.map_or(-self.vehicle.position.z(), |target| target.height_m)
    }
}
