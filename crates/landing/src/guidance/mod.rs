//! From the target to a velocity: either [`thesis`] or [`metric`].

pub mod metric;
mod path;
pub mod thesis;

use geometry::{Ned, Vector};

use crate::config::{Guidance, PhaseConfig};
use crate::decision::{Reason, TargetEstimate};
use crate::event::{Frame, VehicleState};
use crate::time::Timestamp;
use metric::Metric;
use thesis::Thesis;

/// What a guidance looks at.
#[derive(Copy, Clone, Debug)]
pub struct Situation<'a> {
    /// The time.
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
    /// When a target is stale.
    pub phases: PhaseConfig,
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

/// The guidance that was chosen, with its memory.
#[derive(Clone, Debug)]
pub(crate) enum Guide {
    Thesis(Thesis),
    Metric(Metric),
}

impl Situation<'_> {
    /// Height over the target in metres: by the detections' poses, else over the autopilot's local origin.
    pub fn height_m(&self) -> f64 {
        self.target.map_or(-self.vehicle.position.z(), |target| target.height_m)
    }

    /// True when the target is recent enough for a descent: near the ground a short gap may be flown through.
    pub fn may_descend(&self) -> bool {
        let low = self.height_m() <= self.phases.low_height_m;
        self.age_s <= self.phases.stale_target_s + if low { self.phases.low_grace_s } else { 0.0 }
    }
}

impl Guide {
    pub(crate) fn new(config: Guidance) -> Self {
        match config {
            Guidance::Thesis(config) => Self::Thesis(Thesis::new(config)),
            Guidance::Metric(config) => Self::Metric(Metric::new(config)),
        }
    }

    /// True when the vehicle may go down.
    pub(crate) fn may_descend(&self, situation: &Situation<'_>) -> bool {
        match self {
            Self::Thesis(_) => situation.may_descend(),
            Self::Metric(metric) => metric.may_descend(situation),
        }
    }

    /// True when the target's place is good enough to fly to where it must be seen.
    pub(crate) fn knows(&self, situation: &Situation<'_>) -> bool {
        match self {
            Self::Thesis(_) => false,
            Self::Metric(metric) => metric.knows(situation),
        }
    }

    /// True when it also flies the vehicle while LAND is awaited.
    pub(crate) fn flies_until_land(&self) -> bool {
        matches!(self, Self::Metric(_))
    }

    /// True when a marker without a pose is of no use.
    pub(crate) fn needs_pose(&self) -> bool {
        matches!(self, Self::Metric(_))
    }

    /// A frame has arrived while the vehicle is guided.
    pub(crate) fn frame(&mut self, frame: &Frame, heading_rad: f64, altitude_m: f64) {
        if let Self::Thesis(thesis) = self {
            thesis.frame(frame, heading_rad, altitude_m);
        }
    }

    pub(crate) fn progress(&mut self, situation: &Situation<'_>) -> Progress {
        match self {
            Self::Thesis(thesis) => thesis.progress(),
            Self::Metric(metric) => metric.progress(situation),
        }
    }

    /// The velocity wanted now, and what it does.
    pub(crate) fn velocity(&mut self, situation: &Situation<'_>) -> (Vector<Ned>, Reason) {
        match self {
            Self::Thesis(thesis) => thesis.velocity(),
            Self::Metric(metric) => metric.velocity(situation),
        }
    }

    /// What was really sent of the velocity wanted.
    pub(crate) fn sent(&mut self, velocity: Vector<Ned>) {
        if let Self::Metric(metric) = self {
            metric.sent(velocity);
        }
    }

    /// The turn wanted now, in rad/s clockwise seen from above.
    pub(crate) fn yaw_rate(&self, situation: &Situation<'_>) -> f64 {
        match self {
            Self::Thesis(_) => 0.0,
            Self::Metric(metric) => metric.yaw_rate(situation),
        }
    }

    /// The vehicle is not guided now: forget what builds up while it is.
    pub(crate) fn rest(&mut self) {
        match self {
            Self::Thesis(thesis) => thesis.rest(),
            Self::Metric(metric) => metric.rest(),
        }
    }
}
