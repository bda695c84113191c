//! From the target to a velocity: either [`thesis`] or [`metric`].

pub mod metric;
mod path;
pub mod situation;
pub mod thesis;

use geometry::{Ned, Vector};

use crate::config::GuidanceConfig;
use crate::decision::Reason;
use crate::event::FrameObservation;
use metric::Metric;
use situation::{Progress, Situation};
use thesis::Thesis;

/// The guidance that was chosen, with its memory.
#[derive(Clone, Debug)]
pub(crate) enum Guide {
    Thesis(Thesis),
    Metric(Metric),
}

impl Guide {
    pub(crate) fn new(config: GuidanceConfig) -> Self {
        match config {
            GuidanceConfig::Thesis(config) => Self::Thesis(Thesis::new(config)),
            GuidanceConfig::Metric(config) => Self::Metric(Metric::new(config)),
        }
    }

    /// True when the vehicle may go down.
    pub(crate) fn may_descend(&self, situation: &Situation<'_>) -> bool {
        match self {
            Self::Thesis(thesis) => thesis.may_descend(situation),
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
    pub(crate) fn frame(&mut self, frame: &FrameObservation, heading_rad: f64, altitude_m: f64) {
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
