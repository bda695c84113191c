//! Our guidance: from the target's position in metres to a velocity.
//!
//! Laterally: a speed in proportion to the error that will be left when a setpoint shows (a velocity setpoint of
//! 1 m/s takes 0.27 s until anything moves and 0.43 s more to two thirds of it), bounded by the speed from which
//! the vehicle can still brake before the target, and by the acceleration that keeps the camera from tilting the
//! marker out of view. A slow integral counters the autopilot's biased velocity, which is 2 to 3 cm/s.
//!
//! Vertically: a funnel. Inside it the vehicle descends, fastest on the axis and not at all at the edge, more slowly near the
//! ground, and more slowly the older the newest detection is.
//!
//! The end: low over the target, with a small error and a small speed, the autopilot's LAND mode takes over. LAND
//! holds the place where the vehicle comes to rest, so the error that counts is the one after coasting.

use geometry::{Ned, Vector};
use serde::Deserialize;

use crate::config::{ConfigError, check};
use crate::decision::{Reason, TargetEstimate};
use crate::guidance::{Progress, Situation};
use crate::time::Timestamp;

/// How the vehicle is brought over the target and down.
#[derive(Copy, Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MetricConfig {
    /// Lateral speed per metre of predicted error, in 1/s (0.1 to 3).
    pub lateral_gain: f64,
    /// Largest lateral speed, in m/s (0.1 to 5).
    pub max_lateral_m_s: f64,
    /// Largest change of the lateral setpoint, in m/s^2; tilts the camera (0.1 to 2.5).
    pub lateral_acceleration_m_s2: f64,
    /// Time from a setpoint to the first motion, in s (0 to 1).
    pub dead_time_s: f64,
    /// Time constant with which the velocity then follows, in s (0 to 1).
    pub lag_s: f64,
    /// Largest speed of descent, in m/s (0.1 to 3).
    pub max_descend_m_s: f64,
    /// Speed of descent at the hand-over to LAND, in m/s (0.05 to 1).
    pub final_descend_m_s: f64,
    /// Speed of descent gained per metre above the hand-over, in 1/s (0.1 to 2).
    pub descend_gain: f64,
    /// Largest change of the descent's setpoint, in m/s^2 (0.1 to 2.5).
    pub descend_acceleration_m_s2: f64,
    /// Radius of the funnel at the hand-over to LAND, in m; at its edge the descent stops (0.02 to 5).
    pub funnel_m: f64,
    /// What the funnel's radius grows by per metre above the hand-over (0 to 2).
    pub funnel_per_height: f64,
    /// Age of the target up to which the descent is not slowed, in s (0 to 5).
    pub fresh_target_s: f64,
    /// Height over the target at which LAND takes over, in m (0.1 to 5).
    pub land_height_m: f64,
    /// Largest lateral error predicted for the touchdown at the hand-over, in m (0.01 to 1).
    pub land_error_m: f64,
    /// Largest lateral speed at the hand-over, in m/s (0.02 to 1).
    pub land_speed_m_s: f64,
    /// For how long lateral speed goes on in LAND, in s (0 to 2).
    pub coast_s: f64,
    /// Over this time of settling the hand-over's limits widen to `blind_error_m`, in s (0.1 to 60).
    pub settle_s: f64,
    /// Largest lateral error at which the vehicle lands on although the marker left the view, in m (0.01 to 1).
    pub blind_error_m: f64,
    /// Time constant of the observer of the drift that the autopilot's velocity does not show, in s (0.2 to 60).
    pub drift_time_s: f64,
    /// Largest drift countered, in m/s; 0 turns the observer off (0 to 1).
    pub max_drift_m_s: f64,
}

impl Default for MetricConfig {
    fn default() -> Self {
        Self {
            lateral_gain: 1.1,
            max_lateral_m_s: 1.5,
            lateral_acceleration_m_s2: 1.0,
            dead_time_s: 0.25,
            lag_s: 0.43,
            max_descend_m_s: 1.8,
            final_descend_m_s: 0.25,
            descend_gain: 0.5,
            descend_acceleration_m_s2: 1.5,
            funnel_m: 0.06,
            funnel_per_height: 0.25,
            fresh_target_s: 0.3,
            land_height_m: 0.4,
            land_error_m: 0.05,
            land_speed_m_s: 0.1,
            coast_s: 0.6,
            settle_s: 5.0,
            blind_error_m: 0.15,
            drift_time_s: 1.0,
            max_drift_m_s: 0.1,
        }
    }
}

impl MetricConfig {
    pub(crate) fn validate(&self) -> Result<(), ConfigError> {
        check("metric.lateral_gain", self.lateral_gain, 0.1, 3.0)?;
        check("metric.max_lateral_m_s", self.max_lateral_m_s, 0.1, 5.0)?;
        check("metric.lateral_acceleration_m_s2", self.lateral_acceleration_m_s2, 0.1, 2.5)?;
        check("metric.dead_time_s", self.dead_time_s, 0.0, 1.0)?;
        check("metric.lag_s", self.lag_s, 0.0, 1.0)?;
        check("metric.max_descend_m_s", self.max_descend_m_s, 0.1, 3.0)?;
        check("metric.final_descend_m_s", self.final_descend_m_s, 0.05, 1.0)?;
        check("metric.descend_gain", self.descend_gain, 0.1, 2.0)?;
        check("metric.descend_acceleration_m_s2", self.descend_acceleration_m_s2, 0.1, 2.5)?;
        check("metric.funnel_m", self.funnel_m, 0.02, 5.0)?;
        check("metric.funnel_per_height", self.funnel_per_height, 0.0, 2.0)?;
        check("metric.fresh_target_s", self.fresh_target_s, 0.0, 5.0)?;
        check("metric.land_height_m", self.land_height_m, 0.1, 5.0)?;
        check("metric.land_error_m", self.land_error_m, 0.01, 1.0)?;
        check("metric.land_speed_m_s", self.land_speed_m_s, 0.02, 1.0)?;
        check("metric.coast_s", self.coast_s, 0.0, 2.0)?;
        check("metric.settle_s", self.settle_s, 0.1, 60.0)?;
        check("metric.blind_error_m", self.blind_error_m, 0.01, 1.0)?;
        check("metric.drift_time_s", self.drift_time_s, 0.2, 60.0)?;
        check("metric.max_drift_m_s", self.max_drift_m_s, 0.0, 1.0)
    }
}

/// The height band above the hand-over in which the vehicle counts as arrived, in metres.
const ARRIVED_M: f64 = 0.03;

/// Outside this multiple of the funnel's radius a descent becomes an approach again.
const FUNNEL_HYSTERESIS: f64 = 1.2;

/// Part of the lateral acceleration that braking before the target counts on.
const BRAKING: f64 = 0.7;

/// Steps are taken as if no longer than this apart, in seconds.
const LONGEST_STEP_S: f64 = 0.1;

/// An observed error further than this from the expected one is a jump of the estimate, not drift, in metres.
const JUMP_M: f64 = 0.3;

/// Our guidance with its memory: the last setpoint, the drift, and since when the vehicle settles.
#[derive(Clone, Debug)]
pub struct Metric {
    config: MetricConfig,
    last: Option<(Timestamp, Vector<Ned>)>,
    drift: Option<Drift>,
    settling_since: Option<Timestamp>,
}

/// What moves the vehicle although the autopilot's velocity does not show it.
#[derive(Copy, Clone, Debug)]
struct Drift {
    /// The lateral error expected now.
    expected: Vector<Ned>,
    velocity: Vector<Ned>,
}

impl Metric {
    /// A guidance without memory.
    pub fn new(config: MetricConfig) -> Self {
        Self { config, last: None, drift: None, settling_since: None }
    }

    /// Forgets what builds up while guiding.
    pub fn rest(&mut self) {
        self.last = None;
        self.drift = None;
        self.settling_since = None;
    }

    /// Where the vehicle is in its funnel.
    pub fn progress(&mut self, situation: &Situation<'_>) -> Progress {
        let Some(target) = situation.target else { return Progress::Unchanged };
        if !situation.may_descend() {
            return self.unseen(situation, &target);
        }
        if target.height_m <= self.config.land_height_m + ARRIVED_M {
            let since = *self.settling_since.get_or_insert(situation.now);
            let patience = situation.now.seconds_since(since) / self.config.settle_s;
            return if self.settled(situation, &target, patience) {
                Progress::Ready(Reason::LowAndAligned)
            } else {
                Progress::Descending
            };
        }
        self.settling_since = None;
        let outside = self.error(situation, &target, 0.0).norm() / self.funnel_m(target.height_m);
        if outside < 1.0 {
            Progress::Descending
        } else if outside > FUNNEL_HYSTERESIS {
            Progress::Aligning
        } else {
            Progress::Unchanged
        }
    }

    /// The velocity wanted now, and what it does.
    pub fn velocity(&mut self, situation: &Situation<'_>) -> (Vector<Ned>, Reason) {
        let Some(target) = situation.target else { return (Vector::zero(), Reason::Searching) };
        let (before, last) = self.last.unwrap_or((situation.now, situation.vehicle.velocity));
        let step_s = situation.now.seconds_since(before).clamp(0.0, LONGEST_STEP_S);
        self.observe_drift(situation, &target, step_s);
        let lateral = self.lateral(situation, &target, last);
        let (descent_m_s, why) = self.descent(situation, &target);
        let down =
            approach_speed(last.z(), descent_m_s, self.config.descend_acceleration_m_s2 * step_s);
        let change = lateral - Vector::new(last.x(), last.y(), 0.0);
        let change = shortened(change, self.config.lateral_acceleration_m_s2 * step_s);
        let velocity = Vector::new(last.x() + change.x(), last.y() + change.y(), down);
        if velocity.is_finite() {
            self.last = Some((situation.now, velocity));
        } else {
            self.rest();
        }
        (velocity, why)
    }

    /// The marker is out of view for too long: near the ground and above the target, landing blindly is
    /// better than hovering in ground effect until a timeout.
    fn unseen(&self, situation: &Situation<'_>, target: &TargetEstimate) -> Progress {
        let low = target.height_m <= situation.phases.low_height_m;
        let near =
            self.error(situation, target, self.config.coast_s).norm() <= self.config.blind_error_m;
        if low && near { Progress::Ready(Reason::LowAndUnseen) } else { Progress::Unchanged }
    }

    /// True when LAND would end close enough; `patience` runs from 0 to 1 and allows up to the blind error.
    fn settled(&self, situation: &Situation<'_>, target: &TargetEstimate, patience: f64) -> bool {
        let patience = patience.clamp(0.0, 1.0);
        let limit_m = self.config.land_error_m
            + (self.config.blind_error_m - self.config.land_error_m).max(0.0) * patience;
        self.error(situation, target, self.config.coast_s).norm() <= limit_m
            && situation.vehicle.velocity.horizontal_norm()
                <= self.config.land_speed_m_s * (1.0 + patience)
    }

    /// Horizontal way to the target that will be left in `ahead_s` seconds, at the present velocity.
    fn error(
        &self,
        situation: &Situation<'_>,
        target: &TargetEstimate,
        ahead_s: f64,
    ) -> Vector<Ned> {
        let age_s = situation.now.seconds_since(situation.vehicle.stamp).clamp(0.0, LONGEST_STEP_S);
        let drift = self.drift.map_or(Vector::zero(), |drift| drift.velocity);
        let vehicle = situation.vehicle.position + situation.vehicle.velocity * age_s;
        let way = target.position - vehicle - (situation.vehicle.velocity + drift) * ahead_s;
        Vector::new(way.x(), way.y(), 0.0)
    }

    /// A critically damped observer: the error should shrink by the velocity reported; what is left over is drift.
    fn observe_drift(&mut self, situation: &Situation<'_>, target: &TargetEstimate, step_s: f64) {
        let error = self.error(situation, target, 0.0);
        let moved = situation.vehicle.velocity * step_s;
        let fresh = Drift { expected: error, velocity: Vector::zero() };
        let mut drift = self.drift.unwrap_or(fresh);
        let expected =
            drift.expected - (Vector::new(moved.x(), moved.y(), 0.0) + drift.velocity * step_s);
        let surprise = error - expected;
        if surprise.norm() > JUMP_M {
            self.drift = Some(fresh);
            return;
        }
        let time_s = self.config.drift_time_s;
        drift.expected = expected + surprise * (2.0 * step_s / time_s).min(1.0);
        let grown = drift.velocity - surprise * (step_s / time_s.powi(2));
        drift.velocity = shortened(grown, self.config.max_drift_m_s);
        self.drift = Some(drift);
    }

    fn funnel_m(&self, height_m: f64) -> f64 {
        let above_m = height_m - self.config.land_height_m;
        self.config.funnel_m + self.config.funnel_per_height * above_m.max(0.0)
    }

    fn lateral(
        &self,
        situation: &Situation<'_>,
        target: &TargetEstimate,
        last: Vector<Ned>,
    ) -> Vector<Ned> {
        let config = &self.config;
        // What the setpoints already sent will still move the vehicle by.
        let under_way = Vector::new(last.x(), last.y(), 0.0) * config.dead_time_s;
        let error = self.error(situation, target, config.lag_s) - under_way;
        let distance_m = error.norm();
        let braking_m_s = (2.0 * BRAKING * config.lateral_acceleration_m_s2 * distance_m).sqrt();
        let speed_m_s =
            (config.lateral_gain * distance_m).min(braking_m_s).min(config.max_lateral_m_s);
        let towards =
            if distance_m > 1e-9 { error * (speed_m_s / distance_m) } else { Vector::zero() };
        towards - self.drift.map_or(Vector::zero(), |drift| drift.velocity)
    }

    fn descent(&self, situation: &Situation<'_>, target: &TargetEstimate) -> (f64, Reason) {
        let config = &self.config;
        if !situation.may_descend() {
            return (0.0, Reason::TargetAging);
        }
        let above_m = target.height_m - config.land_height_m;
        if above_m <= 0.0 {
            return (0.0, Reason::Settling);
        }
        let outside = self.error(situation, target, 0.0).norm() / self.funnel_m(target.height_m);
        let centred = (1.0 - outside * outside).max(0.0);
        let stale_s = situation.phases.stale_target_s;
        let low = target.height_m <= situation.phases.low_height_m;
        let fresh = if low || config.fresh_target_s >= stale_s {
            1.0
        } else {
            ((stale_s - situation.age_s) / (stale_s - config.fresh_target_s)).clamp(0.0, 1.0)
        };
        let deepest_m_s =
            (config.final_descend_m_s + config.descend_gain * above_m).min(config.max_descend_m_s);
        let why = if centred == 0.0 {
            Reason::Aligning
        } else if fresh == 0.0 {
            Reason::TargetAging
        } else {
            Reason::Descending
        };
        (deepest_m_s * centred * fresh, why)
    }
}

/// From `last` towards `wanted` by at most `step`; a descent ends at once, the autopilot smooths it.
fn approach_speed(last: f64, wanted: f64, step: f64) -> f64 {
    if wanted < last { wanted } else { wanted.min(last + step) }
}

/// The vector, with at most this length.
fn shortened(vector: Vector<Ned>, length: f64) -> Vector<Ned> {
    let norm = vector.norm();
    if norm > length { vector * (length / norm) } else { vector }
}
