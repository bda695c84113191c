//! Estimates the landing point's position and motion: fuses each detection at its own stamp, also late
//! ones, and refuses outliers by their innovation.
//!
//! It runs the `filter` in the odometry frame, the autopilot's local frame without its jumps
//! ([`crate::history::Motion::odometry`]). There the autopilot's motion needs no integration between
//! detections, and the filter estimates the state on which velocity setpoints act: in 160 recorded flights of ArduPilot
//! the reported position moved against the truth by 0.010 m over 2 s, the sum of the reported velocity by
//! 0.032 m.
//!
//! The last [`MEMORY`] detections are stored with the state after each; a late one is inserted between them,
//! and those after it are fused again. A detection whose normalised innovation squared (NIS) exceeds the
//! gate is an outlier, and may start a competing hypothesis (`hypotheses.rs`). A covariance that is far smaller than the detections scatter is raised
//! before (`scatter.rs`). An estimate without a
//! detection for `forget_after_s` is discarded.

use std::collections::VecDeque;

use geometry::{Marker, Ned, Odometry, Point, Rotation, Transform, Vector};
use libm::{atan2, exp};

use crate::config::EstimatorConfig;
use crate::decision::{Rejection, TargetEstimate};
use crate::event::{FrameObservation, MarkerInFrame};
use crate::filter::State;
use crate::history::{History, Motion};
use crate::hypotheses::{Hypotheses, Supported};
use crate::measurement::{MarkerPose, Measurement};
use crate::scatter::{Scatter, ScatterExcess};
use crate::time::Timestamp;

/// Number of stored detections, among which late ones are inserted.
pub const MEMORY: usize = 32;

/// Time constant with which the heave of a pad out of view is forgotten, in seconds.
const HEAVE_S: f64 = 0.8;

/// Smallest horizontal part of the marker's upper edge from which a heading is taken.
const MIN_EDGE: f64 = 0.1;

/// The estimate of the landing point.
#[derive(Clone, Debug)]
pub struct Estimator {
    config: EstimatorConfig,
    /// Oldest first, never more than [`MEMORY`].
    past: VecDeque<FusedMeasurement>,
    detections: u32,
    /// Average direction of the marker's upper edge: north, east.
    heading: Option<[f64; 2]>,
    hypotheses: Hypotheses,
    nis: Option<f64>,
    scatter: Scatter,
    stored: Option<Stored>,
}

/// The estimate of an earlier time.
#[derive(Clone, Debug)]
struct Stored {
    newest: FusedMeasurement,
    detections: u32,
    heading: Option<[f64; 2]>,
    hypotheses: Hypotheses,
}

/// A detection and the state after it.
#[derive(Clone, Debug)]
struct FusedMeasurement {
    measurement: Measurement,
    state: State,
}

impl Estimator {
    /// An estimator without a detection.
    pub fn new(config: EstimatorConfig) -> Self {
        Self {
            config,
            past: VecDeque::with_capacity(MEMORY + 1),
            detections: 0,
            heading: None,
            hypotheses: Hypotheses::default(),
            nis: None,
            scatter: Scatter::default(),
            stored: None,
        }
    }

    /// Counts a frame without the marker. It alone never makes the competing hypothesis the estimate: a pad
    /// that blinks must not lose to a position out of view.
    pub fn miss(&mut self, frame: &FrameObservation, history: &History) {
        self.hypotheses.set_view(frame);
        if let Some(motion) = history.at(frame.stamp) {
            self.count(frame.stamp, &motion, None);
        }
    }

    /// Fuses one marker of a frame, or returns why not.
    pub fn observe(
        &mut self,
        frame: &FrameObservation,
        marker: &MarkerInFrame,
        history: &History,
    ) -> Result<(), Rejection> {
        let pose = marker.body_from_marker.ok_or(Rejection::NoPose)?;
        let motion = history.at(frame.stamp).ok_or(Rejection::NoAttitude)?;
        let pose = MarkerPose::resolve(&motion, pose, marker.alternative);
        let measurement = pose.measurement(&self.config, frame, marker, &motion)?;
        let was_raised = self.scatter.factor().is_some();
        let measurement = self.scatter.raised(measurement);
        if let (Some(factor), Some(newest)) = (self.scatter.factor(), self.past.back_mut())
            && !was_raised
        {
            // By the covariances so far, the estimate is certain of what the noise has taught it.
            newest.state.widen(factor);
        }
        self.hypotheses.set_view(frame);
        self.fuse(measurement, &motion)?;
        self.average_heading(motion.ned_from_body * pose.rotation);
        Ok(())
    }

    /// Stores the estimate, for the case that the next detections are to be forgotten.
    pub fn keep(&mut self) {
        self.stored = self.past.back().map(|newest| Stored {
            newest: newest.clone(),
            detections: self.detections,
            heading: self.heading,
            hypotheses: self.hypotheses.clone(),
        });
    }

    /// Restores the stored estimate, if any; earlier late frames are not inserted any more.
    pub fn go_back(&mut self) {
        self.past.clear();
        let Some(stored) = self.stored.clone() else { return };
        self.past.push_back(stored.newest);
        (self.detections, self.heading, self.hypotheses) =
            (stored.detections, stored.heading, stored.hypotheses);
    }

    /// The estimate relative to a vehicle at `vehicle`, at `now`, with the odometry frame's present position.
    pub fn estimate(
        &self,
        vehicle: Point<Ned>,
        ned_from_odometry: Transform<Ned, Odometry>,
        now: Timestamp,
    ) -> Option<TargetEstimate> {
        let FusedMeasurement { measurement, state } = self.past.back()?;
        let ahead_s = now.seconds_since(measurement.stamp).clamp(0.0, self.config.forget_after_s);
        let mut velocity = state.velocity();
        let mut moved = velocity * ahead_s;
        if self.config.pad_heave_m_s > 0.0 {
            // A heave reverses, at a time that is unknown without the marker in view.
            let left = exp(-ahead_s / HEAVE_S);
            moved.z = velocity.z * HEAVE_S * (1.0 - left);
            velocity.z *= left;
        }
        let moved = state.position() + moved;
        let position = ned_from_odometry * Point::new(moved.x, moved.y, moved.z);
        let offset = position - vehicle;
        Some(TargetEstimate {
            position,
            velocity: Vector::from_coords(velocity),
            lateral_error_m: offset.horizontal_norm(),
            height_m: offset.z(),
            age_s: now.seconds_since(measurement.stamp),
            deviation_m: state.deviation_m(&self.config, ahead_s),
            detections: self.detections,
            heading_rad: self.heading.map(|[north, east]| atan2(east, north)),
            time_offset_s: state.time_offset_s(),
            nis: self.nis,
            ambiguous: self.hypotheses.is_ambiguous(),
        })
    }

    /// By how much more than their covariance states detections scatter, once that has lasted.
    pub(crate) fn scatter(&self) -> Option<ScatterExcess> {
        self.scatter.reported()
    }

    fn newest_stamp(&self) -> Option<Timestamp> {
        self.past.back().map(|fused| fused.measurement.stamp)
    }

    /// The estimated position at a time.
    fn position_at(&self, stamp: Timestamp) -> Option<Point<Odometry>> {
        let newest = self.past.back()?;
        Some(newest.state.position_after(stamp.seconds_since(newest.measurement.stamp)))
    }

    fn count(&mut self, stamp: Timestamp, motion: &Motion, supported: Option<Supported>) {
        let position = self.position_at(stamp);
        self.hypotheses.count(stamp, motion, position, supported);
    }

    /// Inserts a detection at its stamp, and fuses those after it again.
    fn fuse(&mut self, measurement: Measurement, motion: &Motion) -> Result<(), Rejection> {
        let stamp = measurement.stamp;
        let newest = self.newest_stamp();
        let is_forgotten =
            newest.is_some_and(|newest| stamp.seconds_since(newest) > self.config.forget_after_s);
        if newest.is_none() || is_forgotten {
            self.restart(measurement);
            self.hypotheses.restart(stamp);
            return Ok(());
        }
        let index = self.past.partition_point(|fused| fused.measurement.stamp < stamp);
        if self.past.get(index).is_some_and(|fused| fused.measurement.stamp == stamp) {
            return Err(Rejection::Duplicate);
        }
        let Some(before) = index.checked_sub(1).and_then(|index| self.past.get(index)) else {
            return Err(Rejection::Stale);
        };
        let mut state = before.state.clone();
        let dt_s = stamp.seconds_since(before.measurement.stamp);
        let fit = state.predict_to(&self.config, dt_s, &measurement);
        self.nis = Some(fit.nis);
        if !fit.is_inlier {
            let position = self.position_at(stamp);
            self.hypotheses.count_outlier(&self.config, &measurement, motion, position);
            return if self.resolve(stamp) { Ok(()) } else { Err(Rejection::Outlier) };
        }
        self.count(stamp, motion, Some(Supported::Estimate));
        if self.resolve(stamp) {
            return Err(Rejection::Outlier);
        }
        state.update(&self.config, &measurement);
        self.detections = self.detections.saturating_add(1);
        if self.past.len() == MEMORY {
            self.past.pop_front();
        }
        let index = self.past.partition_point(|fused| fused.measurement.stamp < stamp);
        self.past.insert(index, FusedMeasurement { measurement, state });
        self.fuse_again(index + 1);
        Ok(())
    }

    fn fuse_again(&mut self, from: usize) {
        for index in from..self.past.len() {
            let Some(before) = index.checked_sub(1).and_then(|before| self.past.get(before)) else {
                return;
            };
            let (mut state, stamp) = (before.state.clone(), before.measurement.stamp);
            if let Some(fused) = self.past.get_mut(index) {
                let dt_s = fused.measurement.stamp.seconds_since(stamp);
                state.predict_to(&self.config, dt_s, &fused.measurement);
                state.update(&self.config, &fused.measurement);
                fused.state = state;
            }
        }
    }

    fn restart(&mut self, measurement: Measurement) {
        let mut state = State::new(&self.config, measurement.position);
        state.update(&self.config, &measurement);
        self.past.clear();
        self.past.push_back(FusedMeasurement { measurement, state });
        self.detections = 1;
        self.heading = None;
    }

    /// Makes the competing hypothesis the estimate when it is clearly better; true when it did.
    fn resolve(&mut self, now: Timestamp) -> bool {
        let newest = self.past.back().map(|fused| fused.measurement);
        let better = self.hypotheses.resolve(&self.config, now, self.detections, newest);
        better.map(|measurement| self.restart(measurement)).is_some()
    }

    /// The pad's heading is that of the marker's upper edge, averaged.
    fn average_heading(&mut self, ned_from_marker: Rotation<Ned, Marker>) {
        let up = ned_from_marker * Vector::<Marker>::new(0.0, 1.0, 0.0);
        let length = up.horizontal_norm();
        if length < MIN_EDGE {
            return;
        }
        let seen = [up.x() / length, up.y() / length];
        let weight = self.config.heading_weight;
        self.heading = Some(match self.heading {
            Some([north, east]) => {
                [north + (seen[0] - north) * weight, east + (seen[1] - east) * weight]
            }
            None => seen,
        });
    }
}

#[cfg(test)]
mod tests;
