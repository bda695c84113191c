//! The estimator: where the landing point is, how it moves, and how well that is known.
//!
//! A Kalman filter of the pad in the vehicle's own way, that is in the autopilot's local frame without its jumps
//! ([`crate::history::Motion::way`]). There the autopilot's motion needs no integration between detections, and what the
//! filter sees is what velocity setpoints act on: in 160 recorded flights of ArduPilot the reported position moved against the truth by
//! 0.010 m over 2 s, the sum of the reported velocity by 0.032 m.
//!
//! | state | unit | why |
//! |---|---|---|
//! | `q` | m | the pad, in the vehicle's way |
//! | `u` | m/s | its velocity there: the pad's own plus the autopilot's drift (GNSS, barometer), which no image can tell apart and which a setpoint must contain both |
//! | `θ` | rad | error of mount and attitude together, about the body's axes; seen as the height changes |
//! | `τ` | s | exposures are so much later than their stamps; seen as image motion that goes with the vehicle's turning |
//!
//! A detection of the pad at `r` (north, east, down from the vehicle) by a vehicle that moves with `v` and turns with `ω`
//! measures `y = q + (R θ) × r + τ (u - v - ω × r)`, linearised as an extended Kalman filter does (Bar-Shalom, Li, Kirubarajan:
//! Estimation with Applications to Tracking and Navigation, sections 5.2 and 10.3). Its covariance is the detector's, or one
//! from pixel noise, size and range, plus what attitude and position are known to.
//!
//! How fast drift and tilt change is adjusted to what is seen (Bar-Shalom, Li, Kirubarajan, section 11.2.1): while the normalised
//! innovations squared stay larger than their covariance allows, the process noise grows, within limits, and it shrinks again
//! when they do not. An autopilot whose velocity errs by decimetres a second for seconds leans wrongly too, and its position
//! wanders; one that knows its motion is believed as before. A detection beyond the gate adjusts nothing, so a lie opens no
//! gate to itself.
//!
//! A detection is fused at its own stamp: the last [`MEMORY`] detections are kept with the state after each, and one that comes late is put
//! between them and those after it are fused again. A detection whose normalised innovation squared exceeds the gate is an
//! outlier.
//!
//! Outliers that agree with each other are a rival of the estimate. Of both it is counted in which part of the frames that
//! show their place the marker was there (`standing.rs`). The rival becomes the estimate, and the estimate the rival,
//! when its part is clearly the larger, over a long enough time: so a pad that is moved is found again within seconds where its
//! old place is in view, and a second marker is not believed because the first is just out of view. An estimate that was
//! hardly begun gives way at once; one that was never confirmed for `forget_after_s` is forgotten. While the marker is
//! elsewhere in most of the frames that show it, the estimate is contested, and nothing descends on it.

use std::collections::VecDeque;

use geometry::{Body, Marker, Ned, Odometry, Point, Rotation, Transform, Vector};
use nalgebra::{Matrix2, Matrix3, SMatrix, SVector, Vector3};

use crate::config::EstimatorConfig;
use crate::decision::{Rejection, TargetEstimate};
use crate::event::{FrameObservation, MarkerInFrame};
use crate::history::{History, Motion};
use crate::standing::{Standing, View};
use crate::time::Timestamp;

/// Size of the state: `q`, `u`, `θ`, `τ`.
const STATES: usize = 10;
const Q: usize = 0;
const U: usize = 3;
const TILT: usize = 6;
const OFFSET: usize = 9;

/// Detections kept for those that come late.
pub const MEMORY: usize = 32;

/// Deviation of a position never measured, in metres.
const UNKNOWN_M: f64 = 100.0;

/// What a heaving pad's velocity changes by, over its fastest heave, per square root of a second: a wave of 4 to 8 s.
const HEAVE_CHANGE: f64 = 1.0;

/// Time constant with which the heave of a pad out of view is forgotten, in seconds.
const HEAVE_S: f64 = 0.8;

/// Two solutions of a flat marker's pose whose normals are equally upright within this angle are not told apart, in radians.
const UNDECIDED_RAD: f64 = 0.05;

/// What the logarithm of the process noise changes by for a normalised innovation squared that is a degree of freedom too
/// large, of each; and how much larger than its mean of one it may be.
const UNREST_GAIN: f64 = 0.08;
const UNREST_SLACK: f64 = 0.4;

/// What drift and tilt change by is at most so many times what is configured: an estimate that takes any tilt for possible takes
/// any detection.
const MOST_UNREST: f64 = 15.0;

/// A rival detection's distance from the rival before it, beside what both may be wrong by, in metres.
const RIVAL_GATE_M: f64 = 0.15;

/// A rival that stands for fewer detections than this gives way to the next outlier.
const RIVAL_LEAST: f64 = 0.5;

/// A rival that stands for so many detections makes an estimate contested that holds less than this part of its frames.
const CONTENDER: f64 = 2.5;
const CONTESTED: f64 = 0.5;

type State = SVector<f64, STATES>;
type Covariance = SMatrix<f64, STATES, STATES>;

/// The estimate of the landing point.
#[derive(Clone, Debug)]
pub struct Estimator {
    config: EstimatorConfig,
    /// Oldest first, never more than [`MEMORY`].
    past: VecDeque<Fused>,
    detections: u32,
    heading: Option<[f64; 2]>,
    /// How the estimate stands against its rival; `None` before the first detection.
    standing: Option<Standing>,
    rival: Option<Rival>,
    /// What the camera shows, once it is known.
    view: Option<View>,
    nis: Option<f64>,
}

/// A detection and what is known after it.
#[derive(Clone, Debug)]
struct Fused {
    sight: Sight,
    belief: Belief,
}

/// What is known at one moment.
#[derive(Clone, Debug)]
struct Belief {
    state: State,
    covariance: Covariance,
    /// Logarithm of what drift and tilt change by, over what is configured.
    unrest: f64,
}

/// A detection joined with the vehicle's motion at its stamp.
#[derive(Copy, Clone, Debug)]
struct Sight {
    stamp: Timestamp,
    /// The pad in the vehicle's way.
    place: Vector3<f64>,
    noise: Matrix3<f64>,
    /// What a tilt about each of the body's axes adds, in metres per radian.
    tilt: Matrix3<f64>,
    /// What a later exposure adds, apart from the pad's own velocity, in m/s.
    slip: Vector3<f64>,
}

/// For whom a frame speaks.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
enum Claim {
    Estimate,
    Rival,
}

/// Outliers that agree with each other.
#[derive(Copy, Clone, Debug)]
struct Rival {
    newest: Sight,
    since: Timestamp,
    standing: Standing,
}

impl Estimator {
    /// A target never seen.
    pub fn new(config: EstimatorConfig) -> Self {
        Self {
            config,
            past: VecDeque::with_capacity(MEMORY + 1),
            detections: 0,
            heading: None,
            standing: None,
            rival: None,
            view: None,
            nis: None,
        }
    }

    /// Takes note of a frame in which the marker was not found. That alone makes no other place the pad: a pad that blinks
    /// must not lose to one that nobody looks at.
    pub fn miss(&mut self, frame: &FrameObservation, history: &History) {
        self.view = View::of(frame).or(self.view);
        if let Some(motion) = history.at(frame.stamp) {
            self.count(frame.stamp, &motion, None);
        }
    }

    /// Uses one marker of a frame, or says why not.
    pub fn observe(
        &mut self,
        frame: &FrameObservation,
        marker: &MarkerInFrame,
        history: &History,
    ) -> Result<(), Rejection> {
        let pose = marker.body_from_marker.ok_or(Rejection::NoPose)?;
        let motion = history.at(frame.stamp).ok_or(Rejection::NoAttitude)?;
        let (seen, turned, spread) = resolved(&motion, pose, marker.alternative);
        let from_vehicle = motion.ned_from_body * seen;
        self.plausible(from_vehicle)?;
        let in_body = self.noise_in_body(frame, marker, seen) + spread;
        let sight = self.sight(frame.stamp, &motion, from_vehicle, in_body);
        self.view = View::of(frame).or(self.view);
        self.fuse(sight, &motion)?;
        self.turn_towards(motion.ned_from_body * turned);
        Ok(())
    }

    /// The estimate as seen from a vehicle at `vehicle` whose way has the origin `way_origin`, at `now`.
    pub fn seen_from(
        &self,
        vehicle: Point<Ned>,
        ned_from_odometry: Transform<Ned, Odometry>,
        now: Timestamp,
    ) -> Option<TargetEstimate> {
        let Fused { sight, belief } = self.past.back()?;
        let ahead_s = now.seconds_since(sight.stamp).clamp(0.0, self.config.forget_after_s);
        let mut velocity = belief.velocity();
        let mut way = velocity * ahead_s;
        if self.config.pad_heave_m_s > 0.0 {
            // What heaves turns back, and nobody sees when.
            let left = (-ahead_s / HEAVE_S).exp();
            way.z = velocity.z * HEAVE_S * (1.0 - left);
            velocity.z *= left;
        }
        let place = belief.place() + way;
        let position = ned_from_odometry * Point::<Odometry>::new(place.x, place.y, place.z);
        let offset = position - vehicle;
        Some(TargetEstimate {
            position,
            velocity: Vector::from_coords(velocity),
            lateral_error_m: offset.horizontal_norm(),
            height_m: offset.z(),
            age_s: now.seconds_since(sight.stamp),
            deviation_m: self.deviation_m(belief, ahead_s),
            detections: self.detections,
            heading_rad: self.heading.map(|[north, east]| east.atan2(north)),
            time_offset_s: belief.state[OFFSET],
            nis: self.nis,
            contested: self.is_contested(),
        })
    }

    fn is_contested(&self) -> bool {
        let contender = self.rival.is_some_and(|rival| rival.standing.detections() >= CONTENDER);
        contender && self.standing.is_some_and(|standing| standing.share() < CONTESTED)
    }

    /// Counts a frame for the estimate and for its rival, with the marker at the one, the other or neither place.
    fn count(&mut self, stamp: Timestamp, motion: &Motion, seen: Option<Claim>) {
        let view = self.view;
        let is_shown = |place: Vector3<f64>| {
            let place = Point::new(place.x, place.y, place.z);
            view.is_none_or(|view| view.shows(place, motion))
        };
        if let (Some(standing), Some(newest)) = (&mut self.standing, self.past.back()) {
            let ahead_s = stamp.seconds_since(newest.sight.stamp);
            let place = newest.belief.place() + newest.belief.velocity() * ahead_s;
            standing.count(stamp, is_shown(place), seen == Some(Claim::Estimate));
        }
        if let Some(rival) = &mut self.rival {
            let place = rival.newest.place;
            rival.standing.count(stamp, is_shown(place), seen == Some(Claim::Rival));
        }
    }

    fn plausible(&self, from_vehicle: Vector<Ned>) -> Result<(), Rejection> {
        let below = from_vehicle.z() > 0.0;
        let steep = from_vehicle.horizontal_norm() < 3.0 * from_vehicle.z();
        if below && steep && from_vehicle.norm() <= self.config.max_range_m {
            Ok(())
        } else {
            Err(Rejection::Implausible)
        }
    }

    /// Covariance of a pose's origin: as told, or from the noise of pixels.
    fn noise_in_body(
        &self,
        frame: &FrameObservation,
        marker: &MarkerInFrame,
        seen: Vector<Body>,
    ) -> Matrix3<f64> {
        if let Some(told) = marker.covariance_m2 {
            // A detector knows its pixels, not how large the marker was printed.
            let range = (self.config.range_floor_ratio * seen.norm()).powi(2);
            let along = seen.coords / seen.norm().max(1e-6);
            return (told + told.transpose()) * 0.5 + along * along.transpose() * range;
        }
        let pixel_rad = frame
            .focal_px
            .filter(|focal_px| *focal_px > 1.0)
            .map_or(self.config.direction_noise_rad, |focal_px| {
                self.config.pixel_noise_px / focal_px
            });
        let size_px = marker.size_px.filter(|size_px| *size_px > 1.0);
        let range_part = size_px.map_or(self.config.range_noise_ratio, |size_px| {
            2.0 * self.config.pixel_noise_px / size_px
        });
        let range_m = seen.norm();
        let along = seen.coords / range_m.max(1e-6);
        let across = (range_m * pixel_rad).powi(2);
        Matrix3::identity() * across
            + along * along.transpose() * ((range_m * range_part).powi(2) - across)
    }

    fn sight(
        &self,
        stamp: Timestamp,
        motion: &Motion,
        from_vehicle: Vector<Ned>,
        in_body: Matrix3<f64>,
    ) -> Sight {
        let r = from_vehicle.coords;
        let axis = |x, y, z| (motion.ned_from_body * Vector::<Body>::new(x, y, z)).coords;
        let axes =
            Matrix3::from_columns(&[axis(1.0, 0.0, 0.0), axis(0.0, 1.0, 0.0), axis(0.0, 0.0, 1.0)]);
        let tilt = Matrix3::from_columns(&[
            axes.column(0).cross(&r),
            axes.column(1).cross(&r),
            axes.column(2).cross(&r),
        ]);
        let turning = (motion.ned_from_body * motion.rate).coords;
        let attitude = self.config.attitude_noise_rad.powi(2);
        let position = self.config.position_noise_m.powi(2);
        let noise = axes * in_body * axes.transpose()
            + tilt * tilt.transpose() * attitude
            + Matrix3::identity() * position;
        Sight {
            stamp,
            place: motion.odometry.coords.coords + r,
            noise,
            tilt,
            slip: -motion.velocity.coords - turning.cross(&r),
        }
    }

    /// Puts a detection where it belongs in time, and fuses those after it again.
    fn fuse(&mut self, sight: Sight, motion: &Motion) -> Result<(), Rejection> {
        let newest = self.past.back().map(|fused| fused.sight.stamp);
        let forgotten = newest
            .is_some_and(|newest| sight.stamp.seconds_since(newest) > self.config.forget_after_s);
        if newest.is_none() || forgotten {
            self.begin(sight);
            return Ok(());
        }
        let place = self.past.partition_point(|fused| fused.sight.stamp < sight.stamp);
        if self.past.get(place).is_some_and(|fused| fused.sight.stamp == sight.stamp) {
            return Err(Rejection::Duplicate);
        }
        let Some(before) = place.checked_sub(1).and_then(|index| self.past.get(index)) else {
            return Err(Rejection::Stale);
        };
        let mut belief = before.belief.clone();
        belief.pass(&self.config, sight.stamp.seconds_since(before.sight.stamp));
        let nis = belief.nis(&sight);
        self.nis = Some(nis);
        if nis > self.config.gate {
            return self.rival(sight, motion);
        }
        self.count(sight.stamp, motion, Some(Claim::Estimate));
        if self.settle(sight.stamp) {
            return Err(Rejection::Outlier);
        }
        belief.update(&self.config, &sight);
        self.detections = self.detections.saturating_add(1);
        if self.past.len() == MEMORY {
            self.past.pop_front();
        }
        let place = self.past.partition_point(|fused| fused.sight.stamp < sight.stamp);
        self.past.insert(place, Fused { sight, belief });
        self.fuse_again(place + 1);
        Ok(())
    }

    fn fuse_again(&mut self, from: usize) {
        for index in from..self.past.len() {
            let Some(before) = index.checked_sub(1).and_then(|before| self.past.get(before)) else {
                return;
            };
            let (mut belief, stamp) = (before.belief.clone(), before.sight.stamp);
            if let Some(fused) = self.past.get_mut(index) {
                belief.pass(&self.config, fused.sight.stamp.seconds_since(stamp));
                belief.update(&self.config, &fused.sight);
                fused.belief = belief;
            }
        }
    }

    fn begin(&mut self, sight: Sight) {
        let mut belief = Belief::new(&self.config, sight.place);
        belief.update(&self.config, &sight);
        self.past.clear();
        self.past.push_back(Fused { sight, belief });
        self.detections = 1;
        self.heading = None;
        self.standing = Some(Standing::new(sight.stamp));
        self.rival = None;
    }

    /// An outlier speaks for the rival it agrees with, or is a new one where there is none to speak of.
    fn rival(&mut self, sight: Sight, motion: &Motion) -> Result<(), Rejection> {
        let agrees = self.rival.is_some_and(|rival| self.is_same_place(&sight, &rival.newest));
        self.count(sight.stamp, motion, agrees.then_some(Claim::Rival));
        match &mut self.rival {
            Some(rival) if agrees => {
                if sight.stamp > rival.newest.stamp {
                    rival.newest = sight;
                }
            }
            Some(rival) if rival.standing.detections() >= RIVAL_LEAST => {}
            _ => {
                let standing = Standing::new(sight.stamp);
                self.rival = Some(Rival { newest: sight, since: sight.stamp, standing });
            }
        }
        if self.settle(sight.stamp) { Ok(()) } else { Err(Rejection::Outlier) }
    }

    fn is_same_place(&self, one: &Sight, other: &Sight) -> bool {
        let gap_s = one.stamp.seconds_since(other.stamp).abs();
        let reach_m = RIVAL_GATE_M
            + 3.0 * (one.noise.trace() + other.noise.trace()).sqrt()
            + (self.config.pad_speed_m_s + self.config.drift_m_s) * gap_s;
        gap_s <= self.config.forget_after_s && (one.place - other.place).norm() <= reach_m
    }

    /// True when the rival is the pad by all that was seen.
    fn gives_way(&self, now: Timestamp) -> bool {
        let (Some(standing), Some(rival)) = (&self.standing, &self.rival) else { return false };
        let lasted_s = now.seconds_since(rival.since);
        let young = self.detections < self.config.restart_after;
        let enough = self.is_contested()
            || rival.standing.detections() >= f64::from(self.config.restart_after) - 1.0;
        enough && (young || lasted_s >= self.config.restart_s) && rival.standing.beats(standing)
    }

    /// Lets estimate and rival change places when the rival is the pad; true when they did.
    fn settle(&mut self, now: Timestamp) -> bool {
        let (Some(rival), Some(standing)) = (self.rival, self.standing) else { return false };
        if !self.gives_way(now) {
            return false;
        }
        let old = self.past.back().map(|fused| fused.sight);
        self.begin(rival.newest);
        self.standing = Some(rival.standing);
        self.rival = old.map(|newest| Rival { newest, since: newest.stamp, standing });
        true
    }

    /// Largest horizontal deviation so long after the newest detection, in metres.
    fn deviation_m(&self, belief: &Belief, ahead_s: f64) -> f64 {
        // Of what drift changes by, only what was seen to be more than is configured: that much is in the limits for a descent
        // without the marker.
        let raised = self.config.drift_change.powi(2) * ((2.0 * belief.unrest).exp() - 1.0);
        let change = self.config.pad_acceleration.powi(2) + raised;
        let p = &belief.covariance;
        let block = |row: usize, column: usize| p.fixed_view::<2, 2>(row, column).into_owned();
        let cross: Matrix2<f64> = block(Q, U);
        let grown = block(Q, Q)
            + (cross + cross.transpose()) * ahead_s
            + block(U, U) * ahead_s.powi(2)
            + Matrix2::identity() * (self.config.odometry_noise_m.powi(2) * ahead_s)
            + Matrix2::identity() * (change * ahead_s.powi(3) / 3.0);
        let (mean, half) = (0.5 * (grown.m11 + grown.m22), 0.5 * (grown.m11 - grown.m22));
        (mean + half.hypot(grown.m12)).max(0.0).sqrt()
    }

    /// The pad's heading is that of the marker's upper edge, averaged.
    fn turn_towards(&mut self, ned_from_marker: Rotation<Ned, Marker>) {
        let up = ned_from_marker * Vector::<Marker>::new(0.0, 1.0, 0.0);
        let length = up.horizontal_norm();
        if length < 0.1 {
            return;
        }
        let seen = [up.x() / length, up.y() / length];
        let share = self.config.heading_weight;
        self.heading = Some(match self.heading {
            Some([north, east]) => {
                [north + (seen[0] - north) * share, east + (seen[1] - east) * share]
            }
            None => seen,
        });
    }
}

/// Of two solutions of a flat marker's pose the one whose face looks up; when both do, their mean with what they differ by.
fn resolved(
    motion: &Motion,
    pose: Transform<Body, Marker>,
    alternative: Option<Transform<Body, Marker>>,
) -> (Vector<Body>, Rotation<Body, Marker>, Matrix3<f64>) {
    let first = pose.origin() - Point::origin();
    let Some(other) = alternative else { return (first, pose.rotation(), Matrix3::zeros()) };
    let leaning = |pose: Transform<Body, Marker>| {
        let face = motion.ned_from_body * (pose.rotation() * Vector::<Marker>::new(0.0, 0.0, 1.0));
        (-face.z()).clamp(-1.0, 1.0).acos()
    };
    let second = other.origin() - Point::origin();
    let preference = leaning(other) - leaning(pose);
    if preference > UNDECIDED_RAD {
        (first, pose.rotation(), Matrix3::zeros())
    } else if preference < -UNDECIDED_RAD {
        (second, other.rotation(), Matrix3::zeros())
    } else {
        let half = (second - first) * 0.5;
        (first + half, pose.rotation(), half.coords * half.coords.transpose())
    }
}

impl Belief {
    fn new(config: &EstimatorConfig, place: Vector3<f64>) -> Self {
        let mut state = State::zeros();
        state.fixed_rows_mut::<3>(Q).copy_from(&place);
        let level = config.drift_m_s.hypot(config.pad_speed_m_s);
        let deviations = [
            UNKNOWN_M,
            UNKNOWN_M,
            UNKNOWN_M,
            level,
            level,
            config.height_drift_m_s.hypot(config.pad_heave_m_s),
            config.mount_error_rad,
            config.mount_error_rad,
            config.heading_error_rad,
            config.time_offset_s,
        ];
        let mut covariance = Covariance::zeros();
        for (i, deviation) in deviations.into_iter().enumerate() {
            covariance[(i, i)] = deviation * deviation;
        }
        Self { state, covariance, unrest: 0.0 }
    }

    fn place(&self) -> Vector3<f64> {
        self.state.fixed_rows::<3>(Q).into_owned()
    }

    fn velocity(&self) -> Vector3<f64> {
        self.state.fixed_rows::<3>(U).into_owned()
    }

    /// Lets time pass.
    fn pass(&mut self, config: &EstimatorConfig, dt_s: f64) {
        let velocity = self.velocity();
        let p = &mut self.covariance;
        for i in 0..3 {
            self.state[Q + i] += velocity[i] * dt_s;
            // P <- F P F^T, where F adds dt times row and column U to Q.
            for j in 0..STATES {
                p[(Q + i, j)] += dt_s * p[(U + i, j)];
            }
        }
        for i in 0..3 {
            for j in 0..STATES {
                p[(j, Q + i)] += dt_s * p[(j, U + i)];
            }
        }
        let unrest = self.unrest.exp();
        let level = (config.drift_change * unrest).hypot(config.pad_acceleration);
        let upright = config
            .height_drift_change
            .hypot(config.pad_acceleration)
            .hypot(HEAVE_CHANGE * config.pad_heave_m_s);
        for (i, u) in [level, level, upright].into_iter().enumerate() {
            let (u, q) = (u * u, config.odometry_noise_m.powi(2));
            p[(Q + i, Q + i)] += q * dt_s + u * dt_s.powi(3) / 3.0;
            p[(Q + i, U + i)] += u * dt_s.powi(2) / 2.0;
            p[(U + i, Q + i)] += u * dt_s.powi(2) / 2.0;
            p[(U + i, U + i)] += u * dt_s;
        }
        for i in 0..3 {
            p[(TILT + i, TILT + i)] += (config.tilt_change * unrest).powi(2) * dt_s;
        }
        p[(OFFSET, OFFSET)] += (0.02 * config.time_offset_s).powi(2) * dt_s;
    }

    /// How the detection depends on the state.
    fn sensitivity(&self, sight: &Sight) -> SMatrix<f64, 3, STATES> {
        let mut h = SMatrix::<f64, 3, STATES>::zeros();
        let offset_s = self.state[OFFSET];
        for i in 0..3 {
            h[(i, Q + i)] = 1.0;
            h[(i, U + i)] = offset_s;
        }
        h.fixed_view_mut::<3, 3>(0, TILT).copy_from(&sight.tilt);
        h.fixed_view_mut::<3, 1>(0, OFFSET).copy_from(&(sight.slip + self.velocity()));
        h
    }

    fn innovation(&self, sight: &Sight) -> Vector3<f64> {
        let tilt = self.state.fixed_rows::<3>(TILT).into_owned();
        let slip = sight.slip + self.velocity();
        sight.place - self.place() - sight.tilt * tilt - slip * self.state[OFFSET]
    }

    /// The innovation squared over its covariance: chi-square with 3 degrees of freedom.
    fn nis(&self, sight: &Sight) -> f64 {
        let h = self.sensitivity(sight);
        let s = h * self.covariance * h.transpose() + sight.noise;
        let innovation = self.innovation(sight);
        s.try_inverse().map_or(f64::INFINITY, |inverse| innovation.dot(&(inverse * innovation)))
    }

    fn update(&mut self, config: &EstimatorConfig, sight: &Sight) {
        let h = self.sensitivity(sight);
        let ph = self.covariance * h.transpose();
        let Some(inverse) = (h * ph + sight.noise).try_inverse() else { return };
        let gain = ph * inverse;
        let innovation = self.innovation(sight);
        self.stir(config, innovation, h * ph + sight.noise);
        self.state += gain * innovation;
        let less = gain * ph.transpose();
        let p = self.covariance - (less + less.transpose()) * 0.5;
        self.covariance = (p + p.transpose()) * 0.5;
        let most_s = 3.0 * config.time_offset_s;
        self.state[OFFSET] = self.state[OFFSET].clamp(-most_s, most_s);
    }

    /// Adjusts the process noise to the horizontal part of an innovation; heights wander by their own rules.
    fn stir(
        &mut self,
        config: &EstimatorConfig,
        innovation: Vector3<f64>,
        covariance: Matrix3<f64>,
    ) {
        let level = innovation.xy();
        let Some(inverse) = covariance.fixed_view::<2, 2>(0, 0).into_owned().try_inverse() else {
            return;
        };
        let excess = 0.5 * level.dot(&(inverse * level)) - 1.0 - UNREST_SLACK;
        let most = if config.drift_change > 0.0 {
            (config.max_drift_change / config.drift_change).clamp(1.0, MOST_UNREST).ln()
        } else {
            0.0
        };
        self.unrest = (self.unrest + UNREST_GAIN * excess).clamp(0.0, most);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::event::{Landed, Mode, VehicleState};
    use geometry::Pixel;
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    /// A vehicle that sways down towards a pad, and a detector with the noise it tells.
    struct Scene {
        random: ChaCha8Rng,
        history: History,
        estimator: Estimator,
        seconds: f64,
        pad: Point<Ned>,
        pad_velocity: Vector<Ned>,
        drift: Vector<Ned>,
        tilt_error: [f64; 2],
        late_s: f64,
        noise_m: [f64; 3],
        focal_px: Option<f64>,
    }

    impl Scene {
        fn new(config: EstimatorConfig, seed: u64) -> Self {
            Self {
                random: ChaCha8Rng::seed_from_u64(seed),
                history: History::new(0.1),
                estimator: Estimator::new(config),
                seconds: 0.0,
                pad: Point::new(1.5, -1.5, 0.0),
                pad_velocity: Vector::zero(),
                drift: Vector::zero(),
                tilt_error: [0.0; 2],
                late_s: 0.0,
                noise_m: [0.004, 0.004, 0.03],
                focal_px: None,
            }
        }

        fn normal(&mut self) -> f64 {
            StandardNormal.sample(&mut self.random)
        }

        /// Place and attitude at a time.
        fn motion(&self, s: f64) -> (Point<Ned>, Vector<Ned>, Rotation<Ned, Body>) {
            let position =
                Point::new(1.5 + (0.9 * s).sin(), -1.5 + 0.8 * (0.7 * s).cos(), -9.0 + 0.4 * s);
            let velocity = Vector::new(0.9 * (0.9 * s).cos(), -0.56 * (0.7 * s).sin(), 0.4);
            let attitude =
                Rotation::from_euler(0.12 * (1.7 * s).sin(), 0.15 * (1.3 * s).cos(), 0.6 + 0.1 * s);
            (position, velocity, attitude)
        }

        /// Lets the autopilot report for so long.
        fn pass(&mut self, dt_s: f64) {
            let steps = (dt_s / 0.01).round() as u32;
            for _ in 0..steps {
                self.seconds += 0.01;
                let (position, velocity, ned_from_body) = self.motion(self.seconds);
                self.history.push(VehicleState {
                    stamp: Timestamp::from_seconds(self.seconds),
                    ned_from_body,
                    position: position + self.drift * self.seconds,
                    velocity: velocity + self.drift,
                    mode: Mode::Guided,
                    armed: true,
                    landed: Landed::InAir,
                });
            }
        }

        /// A frame taken `ago_s` ago.
        fn frame(&mut self, ago_s: f64) -> (FrameObservation, MarkerInFrame) {
            let stamp_s = self.seconds - ago_s;
            let exposed_s = stamp_s + self.late_s;
            let (position, _, ned_from_body) = self.motion(exposed_s);
            let pad = self.pad + self.pad_velocity * exposed_s;
            let in_body = ned_from_body.inverse() * (pad - position);
            let [roll, pitch] = self.tilt_error;
            let seen: Vector<Body> = Rotation::<Body, Body>::from_euler(roll, pitch, 0.0) * in_body;
            let noise = self.noise_m;
            let [x, y, z] = noise.map(|sigma| sigma * self.normal());
            let place = Point::new(seen.x() + x, seen.y() + y, seen.z() + z);
            let heading = Rotation::<Ned, Marker>::from_euler(
                std::f64::consts::PI,
                0.0,
                std::f64::consts::FRAC_PI_2 + 0.3,
            );
            let marker = MarkerInFrame {
                centre: Pixel::new(0.0, 0.0),
                body_from_marker: Some(Transform::new(ned_from_body.inverse() * heading, place)),
                alternative: None,
                covariance_m2: Some(Matrix3::from_diagonal(&noise.map(|s| s * s).into())),
                size_px: None,
                confidence: 1.0,
            };
            let stamp = Timestamp::from_seconds(stamp_s);
            (
                FrameObservation {
                    stamp,
                    image_size: (1296, 972),
                    focal_px: self.focal_px,
                    body_from_camera: None,
                    marker: None,
                },
                marker,
            )
        }

        fn see(&mut self, ago_s: f64) -> Result<(), Rejection> {
            let (frame, marker) = self.frame(ago_s);
            self.estimator.observe(&frame, &marker, &self.history)
        }

        /// Where the estimate is, less where the pad is.
        fn error(&self) -> Vector<Ned> {
            let estimate = self.estimate();
            let (position, _, _) = self.motion(self.seconds);
            let pad = self.pad + self.pad_velocity * self.seconds;
            estimate.position - (position + self.drift * self.seconds) - (pad - position)
        }

        fn estimate(&self) -> TargetEstimate {
            let newest = self.history.newest().unwrap();
            let origin = self.history.ned_from_odometry();
            self.estimator.seen_from(newest.position, origin, newest.stamp).unwrap()
        }
    }

    /// No noise but what the detector tells.
    fn exact() -> EstimatorConfig {
        EstimatorConfig {
            attitude_noise_rad: 1e-5,
            position_noise_m: 1e-4,
            odometry_noise_m: 0.0005,
            drift_change: 0.0005,
            height_drift_change: 0.0005,
            tilt_change: 1e-5,
            range_floor_ratio: 0.0,
            ..EstimatorConfig::default()
        }
    }

    #[test]
    fn normalised_innovations_are_chi_square() {
        let (mut sum, mut count, mut beyond) = (0.0, 0u32, 0u32);
        for seed in 0..40 {
            let mut scene = Scene::new(exact(), seed);
            let [roll, pitch] = [(); 2].map(|()| 0.005 * scene.normal());
            let [north, east] = [(); 2].map(|()| 0.03 * scene.normal());
            scene.tilt_error = [roll, pitch];
            scene.late_s = 0.015 * scene.normal();
            scene.drift = Vector::new(north, east, 0.0);
            for _ in 0..150 {
                scene.pass(0.07);
                let _ = scene.see(0.03);
                if let Some(nis) = scene.estimator.nis {
                    sum += nis;
                    count += 1;
                    beyond += u32::from(nis > 7.81);
                }
            }
        }
        // Of 6000 values with 3 degrees of freedom the mean is 3 within 0.03, and one in twenty is above 7.81.
        let (mean, part) = (sum / f64::from(count), f64::from(beyond) / f64::from(count));
        assert!((2.85..3.15).contains(&mean), "{mean}");
        assert!((0.04..0.06).contains(&part), "{part}");
    }

    #[test]
    fn errors_are_as_large_as_the_covariance_says() {
        let mut squares = 0.0;
        let n = 60;
        for seed in 0..n {
            let mut scene = Scene::new(exact(), seed);
            scene.tilt_error = [0.005 * scene.normal(), 0.005 * scene.normal()];
            for _ in 0..100 {
                scene.pass(0.07);
                let _ = scene.see(0.03);
            }
            let error = scene.error();
            let p = scene.estimator.past.back().unwrap().belief.covariance;
            let block: Matrix3<f64> = p.fixed_view::<3, 3>(Q, Q).into_owned();
            squares += error.coords.dot(&(block.try_inverse().unwrap() * error.coords));
        }
        let mean = squares / n as f64;
        assert!((2.0..4.2).contains(&mean), "normalised squared error {mean}, expected 3");
    }

    #[test]
    fn late_and_mixed_up_detections_give_the_same_as_those_in_order() {
        let order = |late: bool| {
            let mut scene = Scene::new(EstimatorConfig::default(), 5);
            for i in 0..40 {
                scene.pass(0.1);
                let mut frames = [scene.frame(0.08), scene.frame(0.05), scene.frame(0.02)];
                if late && i > 0 {
                    frames.rotate_left(i % 3);
                    frames.swap(0, 1);
                }
                for (frame, marker) in frames {
                    scene.estimator.observe(&frame, &marker, &scene.history).unwrap();
                }
            }
            scene.estimate()
        };
        let (straight, mixed) = (order(false), order(true));
        assert!((straight.position - mixed.position).norm() < 1e-9);
        assert!((straight.deviation_m - mixed.deviation_m).abs() < 1e-9);
    }

    #[test]
    fn what_comes_twice_or_far_too_late_is_refused() {
        let mut scene = Scene::new(EstimatorConfig::default(), 1);
        scene.pass(0.5);
        let (frame, marker) = scene.frame(0.2);
        scene.estimator.observe(&frame, &marker, &scene.history).unwrap();
        let again = scene.estimator.observe(&frame, &marker, &scene.history);
        assert_eq!(again, Err(Rejection::Duplicate));
        assert_eq!(scene.see(0.3), Err(Rejection::Stale), "before all that is remembered");
        for _ in 0..2 * MEMORY {
            scene.pass(0.05);
            scene.see(0.0).unwrap();
        }
        assert_eq!(scene.estimator.past.len(), MEMORY);
        assert_eq!(
            scene.estimator.past.capacity(),
            Estimator::new(EstimatorConfig::default()).past.capacity()
        );
    }

    #[test]
    fn a_moving_pad_is_followed_and_a_wrong_stamp_found() {
        let config = EstimatorConfig {
            pad_speed_m_s: 4.0,
            pad_acceleration: 0.05,
            ..EstimatorConfig::default()
        };
        let mut scene = Scene::new(config, 3);
        scene.pad_velocity = Vector::new(2.0, -1.0, 0.0);
        scene.pad = Point::new(-14.0, 6.0, 0.0);
        let mut scene = Scene { pad: scene.motion(0.0).0 + Vector::new(0.5, 0.5, 9.0), ..scene };
        for _ in 0..60 {
            scene.pass(0.05);
            scene.see(0.02).unwrap();
        }
        let estimate = scene.estimate();
        assert!((estimate.velocity - scene.pad_velocity).horizontal_norm() < 0.1, "{estimate:?}");
        let mut scene = Scene::new(EstimatorConfig::default(), 4);
        scene.late_s = 0.04;
        for _ in 0..120 {
            scene.pass(0.07);
            let _ = scene.see(0.05);
        }
        let found_s = scene.estimate().time_offset_s;
        assert!((found_s - 0.04).abs() < 0.006, "{found_s} s");
    }

    #[test]
    fn drift_of_the_autopilot_is_told_from_the_pad_by_nobody_and_followed() {
        let mut scene = Scene::new(EstimatorConfig::default(), 2);
        scene.drift = Vector::new(0.05, -0.03, 0.0);
        for _ in 0..150 {
            scene.pass(0.07);
            scene.see(0.03).unwrap();
        }
        assert!(scene.error().horizontal_norm() < 0.01, "{:?}", scene.error());
        // The autopilot's frame moves with its drift, and with it the pad stands still in the world.
        assert!((scene.estimate().velocity - scene.drift).horizontal_norm() < 0.015);
    }

    #[test]
    fn an_autopilot_whose_position_wanders_is_believed_less_and_a_steady_one_as_before() {
        let fly = |max_drift_change: f64, wander_m_s: f64| {
            let config = EstimatorConfig { max_drift_change, ..EstimatorConfig::default() };
            let mut scene = Scene::new(config, 12);
            let home = scene.pad;
            let (mut refused, mut worst_m) = (0, 0.0f64);
            for i in 0..300 {
                // The reported position moves away and comes back, and the reported attitude leans as that velocity changes.
                let (sin, cos) = (1.2 * scene.seconds).sin_cos();
                scene.pad = home + Vector::new(wander_m_s / 1.2 * sin, 0.0, 0.0);
                scene.tilt_error = [0.0, 0.1 * wander_m_s * cos];
                scene.pass(0.07);
                refused += u32::from(scene.see(0.03).is_err());
                if i > 30 {
                    worst_m = worst_m.max(scene.error().horizontal_norm());
                }
            }
            let unrest = scene.estimator.past.back().unwrap().belief.unrest;
            (refused, worst_m, unrest)
        };
        let (trusting, adjusted) = (fly(0.0, 0.15), fly(0.15, 0.15));
        assert!(trusting.0 > 40 && adjusted.0 < 25, "refused of 300: {trusting:?}, {adjusted:?}");
        assert!(trusting.1 > 0.3 && adjusted.1 < 0.2, "{trusting:?}, {adjusted:?}");
        let steady = fly(0.15, 0.0);
        assert!(steady.0 == 0 && steady.2 < 0.5, "{steady:?}");
    }

    #[test]
    fn no_drift_change_opens_the_gate_to_tilts_beyond_reason() {
        for (drift_change, most) in [(0.0, 1.0), (1e-6, MOST_UNREST), (0.01, MOST_UNREST)] {
            let config = EstimatorConfig { drift_change, ..EstimatorConfig::default() };
            let mut belief = Belief::new(&config, Vector3::zeros());
            for _ in 0..1000 {
                belief.stir(&config, Vector3::new(3.0, 0.0, 0.0), Matrix3::identity());
            }
            assert!((belief.unrest.exp() - most).abs() < 1e-6, "{drift_change}: {}", belief.unrest);
        }
    }

    #[test]
    fn the_deviation_foretold_grows_with_unrest_as_the_filters_does() {
        let config = EstimatorConfig::default();
        let estimator = Estimator::new(config);
        let variances = |unrest: f64| {
            let mut belief = Belief::new(&config, Vector3::zeros());
            belief.covariance = Covariance::identity() * 1e-4;
            belief.unrest = unrest;
            let foretold_m = estimator.deviation_m(&belief, 2.0);
            belief.pass(&config, 2.0);
            [foretold_m, estimator.deviation_m(&belief, 0.0)].map(|m| m * m)
        };
        let calm = variances(0.0);
        for unrest in [1.0, MOST_UNREST.ln()] {
            let wild = variances(unrest);
            let (foretold, reached) = (wild[0] - calm[0], wild[1] - calm[1]);
            assert!((foretold - reached).abs() < 1e-9, "{foretold} m^2, {reached} m^2");
            assert!(foretold > 1e-3, "{foretold} m^2");
        }
    }

    #[test]
    fn a_minority_never_becomes_the_target_and_a_steady_majority_does() {
        let home = Point::new(1.5, -1.5, 0.0);
        let away = Point::new(1.5, -0.5, 0.0);
        let fly = |first: Point<Ned>, wrong: fn(u32) -> bool| {
            let mut scene = Scene::new(EstimatorConfig::default(), 6);
            for i in 0..150 {
                scene.pass(0.07);
                scene.pad = if i < 3 {
                    first
                } else if wrong(i) {
                    away
                } else {
                    home
                };
                let _ = scene.see(0.03);
            }
            scene.pad = home;
            scene.error().horizontal_norm()
        };
        assert!(fly(home, |i| i % 3 == 0) < 0.02, "a third of the detections is wrong");
        assert!(fly(away, |i| i % 3 == 0) < 0.02, "it began with the wrong one");
        assert!(fly(home, |i| (60..74).contains(&i)) < 0.02, "a second of lies");
        assert!((fly(home, |i| i > 60) - 1.0).abs() < 0.02, "the marker is elsewhere now");
    }

    #[test]
    fn a_pad_that_blinks_does_not_lose_to_a_place_that_nobody_looks_at() {
        let mut scene = Scene::new(EstimatorConfig::default(), 10);
        scene.focal_px = Some(1818.0);
        let home = scene.pad;
        let mut after_blinking_m = 0.0;
        for i in 0..130 {
            scene.pass(0.07);
            // Four detections where the image ends, long ago, and 3 s without the pad, which is there before and after.
            let is_away = (20..24).contains(&i);
            scene.pad = if is_away { home + Vector::new(4.5, 0.0, 0.0) } else { home };
            if (40..82).contains(&i) {
                let (frame, _) = scene.frame(0.03);
                scene.estimator.miss(&frame, &scene.history);
                after_blinking_m = scene.error().horizontal_norm();
            } else {
                let _ = scene.see(0.03);
            }
        }
        assert!(after_blinking_m < 0.1, "{after_blinking_m} m");
        assert!(scene.error().horizontal_norm() < 0.02 && !scene.estimate().contested);
    }

    #[test]
    fn of_two_poses_the_one_that_lies_flat_is_taken() {
        let mut scene = Scene::new(EstimatorConfig::default(), 8);
        for i in 0..60 {
            scene.pass(0.07);
            let (frame, marker) = scene.frame(0.03);
            let pose = marker.body_from_marker.unwrap();
            let leans = Rotation::<Body, Body>::from_euler(0.5, 0.2, 0.0) * pose.rotation();
            let beside = pose.origin() + Vector::new(0.1, 0.0, 0.0);
            let other = Transform::new(leans, beside);
            let (first, second) = if i % 2 == 0 { (pose, other) } else { (other, pose) };
            let marker = MarkerInFrame {
                body_from_marker: Some(first),
                alternative: Some(second),
                ..marker
            };
            scene.estimator.observe(&frame, &marker, &scene.history).unwrap();
        }
        assert!(scene.error().horizontal_norm() < 0.02, "{:?}", scene.error());
    }

    #[test]
    fn the_heading_of_the_pad_is_that_of_the_markers_upper_edge() {
        let mut scene = Scene::new(EstimatorConfig::default(), 9);
        for _ in 0..60 {
            scene.pass(0.07);
            scene.see(0.03).unwrap();
        }
        assert!((scene.estimate().heading_rad.unwrap() - 0.3).abs() < 0.02);
    }

    #[test]
    fn a_jump_of_the_autopilots_position_moves_the_pad_along() {
        let mut scene = Scene::new(EstimatorConfig::default(), 7);
        for _ in 0..40 {
            scene.pass(0.07);
            scene.see(0.03).unwrap();
        }
        let before = scene.estimate();
        // From one report to the next everything is a metre further north.
        scene.seconds += 0.01;
        let (position, velocity, ned_from_body) = scene.motion(scene.seconds);
        scene.history.push(VehicleState {
            stamp: Timestamp::from_seconds(scene.seconds),
            ned_from_body,
            position: position + Vector::new(1.0, 0.0, 0.0),
            velocity,
            mode: Mode::Guided,
            armed: true,
            landed: Landed::InAir,
        });
        let after = scene.estimate();
        assert!((after.position.x() - before.position.x() - 1.0).abs() < 0.02);
        assert!((after.lateral_error_m - before.lateral_error_m).abs() < 0.02);
    }

    #[test]
    fn a_marker_above_the_vehicle_is_implausible() {
        let mut scene = Scene::new(EstimatorConfig::default(), 1);
        scene.pass(0.5);
        scene.pad = Point::new(1.5, -1.5, -30.0);
        assert_eq!(scene.see(0.0), Err(Rejection::Implausible));
    }
}
