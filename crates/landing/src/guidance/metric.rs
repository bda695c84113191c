//! Our guidance: from the target's position in metres to a velocity.
//!
//! Laterally: a wanted closing speed in proportion to the error that will be left when a setpoint shows, bounded by the
//! speed from which the vehicle can still brake before the target. What is sent is not that speed but the setpoint that makes the
//! autopilot accelerate as needed to reach it. An autopilot smooths a velocity setpoint: ArduPilot's path goes towards it
//! with a time constant of acceleration limit over jerk limit, 0.5 s, and the vehicle follows the path. So the path's
//! velocity is computed here too (it depends on nothing but the setpoints sent), and the setpoint is that velocity plus
//! the time constant times the wanted acceleration. Wind that pushes the vehicle off its path is so seen and countered at
//! once, and what stays is summed up in the path's velocity: there is nothing else that could wind up.
//!
//! The reported velocity is biased, by 2 to 3 cm/s where all is well and by decimetres a second where the autopilot's filter
//! leans wrongly; the bias is what an observer finds left over between it and the way that the reported position covers.
//!
//! Vertically: a funnel. Inside it the vehicle descends, as fast as it can still brake, fastest on the axis and not at all
//! at the edge. A vehicle that leans into the wind looks past the target; above `view_height_m` it stays so far upwind
//! that the marker remains in view.
//!
//! Where the error comes from, in 100 modelled flights in 5 m/s of wind with turbulence 3 (`alight experiment landing`), median and
//! worst, and the largest slide at the touch:
//!
//! | change | error, m | slide, m/s |
//! |---|---|---|
//! | as it is | 0.017, 0.066 | 0.09 |
//! | LAND from 0.1 m | 0.017, 0.062 | 0.16 |
//! | LAND from 0.2 m | 0.028, 0.098 | 0.29 |
//! | LAND from 0.4 m | 0.067, 0.185 | 0.30 |
//! | LAND from 0.8 m | 0.113, 0.427 | 0.24 |
//! | half of the gains, no look ahead | 0.045, 0.157 | 0.18 |
//! | the reported velocity believed | 0.024, 0.070 | 0.08 |
//! | an autopilot that knows the truth | 0.014, 0.067 | 0.15 |
//!
//! The end: below `blind_height_m` the vehicle goes on down on the estimate when the marker leaves the view. LAND follows no target
//! and in gusts drifts by a decimetre in a second, so it takes over only half a hand's breadth above the ground, and only from a vehicle
//! that hardly moves sideways.

use geometry::{Body, Ned, Point, Vector};

use crate::config::MetricConfig;
use crate::decision::{Reason, TargetEstimate};
use crate::event::VehicleState;
use crate::guidance::path::{JERK, PATH_TIME_S, Path};
use crate::guidance::situation::{Progress, Situation};
use crate::history::jump;
use crate::time::Timestamp;

/// Outside this multiple of the funnel's radius a descent becomes an approach again.
const FUNNEL_HYSTERESIS: f64 = 1.2;

/// Part of the lateral acceleration that braking before the target counts on.
const BRAKING: f64 = 0.7;

/// The target's place is known while it is better than this, for at most so long, in metres and seconds.
const KNOWN_M: f64 = 0.5;
const KNOWN_S: f64 = 20.0;

/// A pad slower than this lies still, whatever the autopilot's drift adds, in m/s.
const STILL_M_S: f64 = 0.3;

/// Turning rate per heading error, in 1/s.
const TURN_GAIN: f64 = 0.8;

/// Below this height the vehicle waits for a small error, in metres.
const LOW_M: f64 = 0.5;

/// One that waits is no longer low so far above that: it makes room by climbing to about that height.
const LOW_HYSTERESIS_M: f64 = 0.2;

/// Difference between the velocity of the path asked for and the vehicle's that a gust does not explain, in m/s.
const STEADY_M_S: f64 = 0.3;

/// Lateral speed over the pad at which a low vehicle no longer descends, in m/s: at the ground, what is added per metre of
/// height, and, after so many seconds of waiting, per second; and however long it waits, at most.
const TOUCH_M_S: f64 = 0.2;
const TOUCH_PER_HEIGHT: f64 = 0.4;
const TOUCH_WAIT_S: f64 = 1.0;
const TOUCH_PATIENCE_M_S2: f64 = 0.1;
const MOST_TOUCH_M_S: f64 = 0.45;

/// A touch on a heaving pad is not slower than this, in m/s.
const SLOWEST_TOUCH_M_S: f64 = 0.3;

/// So far ahead its error is looked at there, in seconds.
const LOW_LEAD_S: f64 = 0.4;

/// A low vehicle that is pushed out of its funnel makes room at most so fast, in m/s, and in proportion to what it lacks, in 1/s.
const ROOM_M_S: f64 = 0.5;
const ROOM_GAIN: f64 = 2.0;

/// A vehicle asked to descend this fast that stands still for so long is on the ground, in m/s and seconds: the first where it
/// should be near the ground, the second where it may also just be turning from a climb.
const PUSHING_M_S: f64 = 0.15;
const STANDING_S: [f64; 2] = [0.4, 0.9];
const NEAR_M: f64 = 0.3;

/// So near the ground the rest of the way is shorter than another try, and so much more deviation is allowed.
const COMMITTED: f64 = 1.5;

/// Time constant of the filter over the acceleration, in seconds.
const SLOPE_S: f64 = 0.05;

/// Acceleration of gravity, in m/s^2.
const GRAVITY: f64 = 9.81;

/// Time constant of the lean that is taken for the wind's, in seconds.
const LEAN_S: f64 = 1.0;

/// Steps are taken as if no longer than this apart, in seconds.
const LONGEST_STEP_S: f64 = 0.1;

/// Between states further apart than this the velocity does not tell where the position should be, in seconds.
const LONGEST_GAP_S: f64 = 0.25;

/// A position further than this from the expected one is a jump of the estimate, not drift, in metres.
const JUMP_M: f64 = 0.3;

/// Our guidance with its memory.
#[derive(Clone, Debug)]
pub struct Metric {
    config: MetricConfig,
    memory: Option<Memory>,
    waiting_since: Option<Timestamp>,
    standing_since: Option<Timestamp>,
}

/// What builds up while guiding.
#[derive(Copy, Clone, Debug)]
struct Memory {
    stamp: Timestamp,
    /// The newest setpoint, in m/s.
    setpoint: Vector<Ned>,
    /// The path that the autopilot makes of the setpoints.
    path: Path,
    /// The newest state, and the acceleration up to it.
    newest: VehicleState,
    acceleration: Vector<Ned>,
    /// Where the vehicle was expected to be in the newest state, in metres.
    expected: Point<Ned>,
    /// What the reported position moves with beside the reported velocity, in m/s.
    bias: Vector<Ned>,
    /// How far ahead of the vehicle the body's down axis points, as a part of the height.
    lean: Vector<Ned>,
}

impl Metric {
    /// A guidance without memory.
    pub fn new(config: MetricConfig) -> Self {
        Self { config, memory: None, waiting_since: None, standing_since: None }
    }

    /// Forgets what builds up while guiding.
    pub fn rest(&mut self) {
        self.memory = None;
        self.waiting_since = None;
        self.standing_since = None;
    }

    /// True when the vehicle may go down: the target is recent, or low below and well known, and no other place claims to
    /// be it.
    pub fn may_descend(&self, situation: &Situation<'_>) -> bool {
        let contested = situation.target.is_some_and(|target| target.contested);
        !contested && (self.sees(situation) || self.is_blind_but_sure(situation))
    }

    /// True when the target's place is good enough to fly to where it must be seen.
    pub fn knows(&self, situation: &Situation<'_>) -> bool {
        situation
            .target
            .is_some_and(|target| target.deviation_m <= KNOWN_M && target.age_s <= KNOWN_S)
    }

    fn sees(&self, situation: &Situation<'_>) -> bool {
        situation.age_s <= self.config.stale_target_s
    }

    fn is_blind_but_sure(&self, situation: &Situation<'_>) -> bool {
        situation.target.is_some_and(|target| {
            let height_m = self.height_m(&target);
            let patience = if height_m <= NEAR_M { COMMITTED } else { 1.0 };
            // What presses on something does not climb before it is known to stand there.
            let stands = self.standing_since.is_some() && height_m <= NEAR_M;
            height_m <= self.config.blind_height_m
                && situation.age_s <= self.config.stale_target_s + self.config.blind_s
                && (stands || target.deviation_m <= self.config.blind_deviation_m * patience)
        })
    }

    /// Where the vehicle is in its funnel.
    pub fn progress(&mut self, situation: &Situation<'_>) -> Progress {
        let Some(target) = situation.target else { return Progress::Unchanged };
        if !self.may_descend(situation) {
            return Progress::Unchanged;
        }
        if self.stands(situation, &target) {
            return Progress::Ready(Reason::TouchedEarly);
        }
        let seen = self.sees(situation);
        let height_m = self.height_m(&target);
        let outside = self.outside(situation, &target);
        let hasty = self.hurry(situation, &target) >= 1.0;
        let lies_still = !situation.pad_moves && target.velocity.norm() <= STILL_M_S;
        if height_m <= self.config.land_height_m
            && outside < 1.0
            && !hasty
            && lies_still
            && self.is_steady(situation)
        {
            return Progress::Ready(if seen {
                Reason::LowAndAligned
            } else {
                Reason::LowAndUnseen
            });
        }
        let waited_s = self.waiting_since.map_or(0.0, |since| situation.now.seconds_since(since));
        if waited_s > 2.0 * self.config.settle_s && (outside >= 1.0 || hasty) {
            return Progress::Stuck;
        }
        match (seen, outside) {
            (true, outside) if outside < 1.0 => Progress::Descending,
            (true, outside) if outside > FUNNEL_HYSTERESIS && height_m > LOW_M => {
                Progress::Aligning
            }
            (true, _) => Progress::Unchanged,
            (false, _) => Progress::Blind,
        }
    }

    /// True while what is asked of the autopilot is what the vehicle does. In a gust it is not, and LAND, which forgets what was
    /// asked for, would let the vehicle go: then the touch comes first.
    fn is_steady(&self, situation: &Situation<'_>) -> bool {
        self.memory.is_none_or(|memory| {
            flat(memory.path.velocity() - situation.vehicle.velocity).norm() <= STEADY_M_S
        })
    }

    /// The velocity wanted now, and what it does.
    pub fn velocity(&mut self, situation: &Situation<'_>) -> (Vector<Ned>, Reason) {
        let Some(target) = situation.target else { return (Vector::zero(), Reason::Searching) };
        let before = self.memory.unwrap_or_else(|| Self::begin(situation));
        let step_s = situation.now.seconds_since(before.stamp).clamp(0.0, LONGEST_STEP_S);
        let mut memory = self.observed(before, situation, step_s);
        self.memory = Some(memory);
        let lateral = self.lateral(&memory, situation, &target);
        let (descent_m_s, why) = self.descent(situation, &target);
        let down = approach_speed(
            before.setpoint.z(),
            descent_m_s + target.velocity.z(),
            self.config.descend_acceleration_m_s2 * step_s,
        );
        let setpoint = Vector::new(lateral.x(), lateral.y(), down);
        if !setpoint.is_finite() {
            self.rest();
            return (setpoint, why);
        }
        memory.setpoint = setpoint;
        self.memory = Some(memory);
        self.wait(situation, &target);
        (setpoint, why)
    }

    /// What was really sent of the velocity wanted, in m/s: the autopilot's path follows that.
    pub fn sent(&mut self, velocity: Vector<Ned>) {
        if let Some(memory) = &mut self.memory {
            memory.setpoint = velocity;
        }
    }

    /// The turn towards the pad's heading, in rad/s clockwise seen from above; none near the ground, where it would only disturb.
    pub fn yaw_rate(&self, situation: &Situation<'_>) -> f64 {
        let heading = situation.target.filter(|target| self.height_m(target) > LOW_M);
        let Some(pad_rad) = heading.and_then(|target| target.heading_rad) else { return 0.0 };
        let error = pad_rad + self.config.pad_heading_rad - situation.vehicle.heading_rad();
        let turn = std::f64::consts::TAU;
        let error = error - turn * (error / turn).round();
        (error * TURN_GAIN).clamp(-self.config.turn_rad_s, self.config.turn_rad_s)
    }

    fn begin(situation: &Situation<'_>) -> Memory {
        let velocity = situation.vehicle.velocity;
        let level = Vector::new(velocity.x(), velocity.y(), 0.0);
        Memory {
            stamp: situation.now,
            setpoint: velocity,
            newest: *situation.vehicle,
            acceleration: Vector::zero(),
            path: Path::new(level),
            expected: situation.vehicle.position,
            bias: Vector::zero(),
            lean: lean(situation),
        }
    }

    /// The memory after the time that has passed: the path follows the setpoint, the observers what they see.
    fn observed(&self, mut memory: Memory, situation: &Situation<'_>, step_s: f64) -> Memory {
        memory.stamp = situation.now;
        let gap_s = situation.vehicle.stamp.seconds_since(memory.newest.stamp);
        if gap_s > 1e-3 {
            let slope = flat(situation.vehicle.velocity - memory.newest.velocity) * (1.0 / gap_s);
            memory.acceleration =
                memory.acceleration + (slope - memory.acceleration) * (gap_s / (SLOPE_S + gap_s));
            self.compare(&mut memory, situation.vehicle, gap_s);
        }
        memory.path.pass(step_s, memory.setpoint);
        // What the vehicle leans beside what its path accelerates by, it leans against the wind.
        let against_wind = lean(situation) + memory.path.acceleration() * (1.0 / GRAVITY);
        memory.lean = memory.lean + (against_wind - memory.lean) * (step_s / LEAN_S).min(1.0);
        memory
    }

    /// Compares the way from state to state with the velocity, from which neither a pause of ours nor the state's age keeps it.
    /// After a gap or a jump there is nothing to compare.
    fn compare(&self, memory: &mut Memory, vehicle: &VehicleState, gap_s: f64) {
        let before = std::mem::replace(&mut memory.newest, *vehicle);
        let velocity = (before.velocity + vehicle.velocity) * 0.5 + memory.bias;
        let expected = memory.expected + velocity * gap_s;
        let surprise = flat(vehicle.position - expected);
        let has_jumped = jump(&before, vehicle).is_some() || surprise.norm() > JUMP_M;
        if has_jumped || gap_s > LONGEST_GAP_S {
            memory.expected = vehicle.position;
            return;
        }
        // A critically damped observer.
        let time_s = self.config.drift_time_s;
        memory.expected = expected + surprise * (2.0 * gap_s / time_s).min(1.0);
        let bias = memory.bias + surprise * (gap_s / time_s.powi(2));
        memory.bias = shortened(bias, self.config.max_drift_m_s);
    }

    /// Horizontal way from the vehicle to the target, in metres.
    fn way(&self, situation: &Situation<'_>, target: &TargetEstimate) -> Vector<Ned> {
        flat(target.position - self.here(situation))
    }

    /// Where the vehicle is by now, in metres.
    fn here(&self, situation: &Situation<'_>) -> Point<Ned> {
        let age_s = situation.now.seconds_since(situation.vehicle.stamp).clamp(0.0, LONGEST_STEP_S);
        let bias = self.memory.map_or(Vector::zero(), |memory| memory.bias);
        situation.vehicle.position + (flat(situation.vehicle.velocity) + bias) * age_s
    }

    /// Horizontal way to the place that is aimed at, in metres: high up, where the wind makes the vehicle lean, that is
    /// not the target but the nearest place from which the marker is in view.
    fn error(&self, situation: &Situation<'_>, target: &TargetEstimate) -> Vector<Ned> {
        self.way(situation, target) - self.upwind(situation, target)
    }

    fn upwind(&self, situation: &Situation<'_>, target: &TargetEstimate) -> Vector<Ned> {
        let config = &self.config;
        let (Some(view_rad), Some(memory)) = (situation.half_view_rad, self.memory) else {
            return Vector::zero();
        };
        let height_m = self.height_m(target);
        let share = (height_m / config.view_height_m - 1.0).clamp(0.0, 1.0);
        let seen_m = height_m * (view_rad - config.view_margin_rad).tan() - config.view_margin_m;
        let axis = memory.lean * height_m;
        let excess_m = axis.norm() - seen_m.max(0.0);
        if excess_m <= 0.0 { Vector::zero() } else { axis * (share * excess_m / axis.norm()) }
    }

    fn height_m(&self, target: &TargetEstimate) -> f64 {
        target.height_m - self.config.standing_height_m
    }

    /// The error as a part of the funnel's radius, which near the ground grows with the time spent waiting.
    fn outside(&self, situation: &Situation<'_>, target: &TargetEstimate) -> f64 {
        let config = &self.config;
        let height_m = self.height_m(target).max(0.0);
        let waited_s = self.waiting_since.map_or(0.0, |since| situation.now.seconds_since(since));
        let patience = (waited_s / config.settle_s).clamp(0.0, 1.0);
        let widest_m = config.funnel_m.max(config.blind_error_m);
        let radius_m = config.funnel_m
            + (widest_m - config.funnel_m) * patience
            + config.funnel_per_height * height_m;
        let error = self.error(situation, target);
        if height_m > LOW_M {
            return error.norm() / radius_m;
        }
        // So low the vehicle has touched before an error that grows is seen.
        let bias = self.memory.map_or(Vector::zero(), |memory| memory.bias);
        let pad_m_s = shortened(flat(target.velocity), config.max_pad_m_s);
        let closing = flat(situation.vehicle.velocity) + bias - pad_m_s;
        error.norm().max((error - closing * LOW_LEAD_S).norm()) / radius_m
    }

    /// The lateral speed over the pad as a part of what it may be so low, which grows with the time spent waiting: a vehicle
    /// that touches while a gust moves it slides.
    fn hurry(&self, situation: &Situation<'_>, target: &TargetEstimate) -> f64 {
        let height_m = self.height_m(target).max(0.0);
        let Some(memory) = self.memory.filter(|_| height_m <= LOW_M) else { return 0.0 };
        let waited_s = self.waiting_since.map_or(0.0, |since| situation.now.seconds_since(since));
        let most_m_s = TOUCH_M_S
            + TOUCH_PER_HEIGHT * height_m
            + TOUCH_PATIENCE_M_S2 * (waited_s - TOUCH_WAIT_S).max(0.0);
        let most_m_s = most_m_s.min(MOST_TOUCH_M_S);
        let pad_m_s = shortened(flat(target.velocity), self.config.max_pad_m_s);
        (flat(situation.vehicle.velocity) + memory.bias - pad_m_s).norm() / most_m_s
    }

    /// Notes since when the vehicle is low, and since when it stands although it is to go down.
    fn wait(&mut self, situation: &Situation<'_>, target: &TargetEstimate) {
        let height_m = self.height_m(target);
        if height_m <= LOW_M {
            self.waiting_since.get_or_insert(situation.now);
        } else if height_m > LOW_M + LOW_HYSTERESIS_M {
            self.waiting_since = None;
        }
        let pushed = self
            .memory
            .is_some_and(|memory| memory.setpoint.z() - target.velocity.z() >= PUSHING_M_S);
        let still = situation.vehicle.velocity.z() - target.velocity.z() < 0.3 * PUSHING_M_S;
        if pushed && still && height_m <= LOW_M {
            self.standing_since.get_or_insert(situation.now);
        } else {
            self.standing_since = None;
        }
    }

    fn stands(&self, situation: &Situation<'_>, target: &TargetEstimate) -> bool {
        let height_m = self.height_m(target);
        let enough_s = STANDING_S[usize::from(height_m > NEAR_M)];
        height_m <= LOW_M
            && self
                .standing_since
                .is_some_and(|since| situation.now.seconds_since(since) >= enough_s)
    }

    fn lateral(
        &self,
        memory: &Memory,
        situation: &Situation<'_>,
        target: &TargetEstimate,
    ) -> Vector<Ned> {
        let config = &self.config;
        let pad_m_s = shortened(flat(target.velocity), config.max_pad_m_s);
        let closing = flat(situation.vehicle.velocity) + memory.bias - pad_m_s;
        let lead_s = config.acceleration_lead_s;
        let left = self.error(situation, target)
            - closing * config.dead_time_s
            - memory.acceleration * (0.5 * lead_s.powi(2));
        // While the autopilot takes its acceleration back, within its jerk, the speed goes on growing.
        let fading = memory.path.acceleration();
        let closing =
            closing + memory.acceleration * lead_s + fading * (fading.norm() / (2.0 * JERK));
        let left_m = left.norm();
        let braking_m_s = (2.0 * BRAKING * config.lateral_acceleration_m_s2 * left_m).sqrt();
        let speed_m_s = (config.lateral_gain * left_m).min(braking_m_s).min(config.max_lateral_m_s);
        let wanted = if left_m > 1e-9 { left * (speed_m_s / left_m) } else { Vector::zero() };
        let acceleration =
            shortened((wanted - closing) * config.velocity_gain, config.lateral_acceleration_m_s2);
        shortened(
            memory.path.velocity() + acceleration * PATH_TIME_S,
            config.max_lateral_m_s + config.max_pad_m_s,
        )
    }

    /// Speed towards the pad, and what it does.
    fn descent(&self, situation: &Situation<'_>, target: &TargetEstimate) -> (f64, Reason) {
        let config = &self.config;
        if target.contested {
            return (0.0, Reason::Contested);
        }
        if !self.may_descend(situation) {
            return (0.0, Reason::TargetAging);
        }
        let outside = self.outside(situation, target);
        let hurry = self.hurry(situation, target);
        let centred = (1.0 - outside * outside).max(0.0) * (1.0 - hurry * hurry).max(0.0);
        let fresh = self.freshness(situation);
        let why = if centred == 0.0 && self.height_m(target) <= LOW_M {
            Reason::Settling
        } else if centred == 0.0 {
            Reason::Aligning
        } else if fresh == 0.0 {
            Reason::TargetAging
        } else if self.sees(situation) {
            Reason::Descending
        } else {
            Reason::DescendingUnseen
        };
        let height_m = self.height_m(target);
        if outside > FUNNEL_HYSTERESIS && height_m < LOW_M {
            // Leaning against a gust costs height, and the ground must not be touched sliding.
            return (-(ROOM_GAIN * (LOW_M - height_m)).min(ROOM_M_S), Reason::Settling);
        }
        let sinking_m_s = (situation.vehicle.velocity.z() - target.velocity.z()).max(0.0);
        let ahead_m = self.height_m(target)
            - config.land_height_m
            - (sinking_m_s - config.touchdown_descend_m_s).max(0.0) * config.descend_lag_s;
        // What is not known of a heave comes on top.
        let least_m_s = SLOWEST_TOUCH_M_S.min(config.touchdown_descend_m_s);
        let slowest = (config.touchdown_descend_m_s - 0.5 * situation.pad_heave_m_s).max(least_m_s);
        let brakes = slowest.powi(2) + 2.0 * config.descend_braking_m_s2 * ahead_m.max(0.0);
        let silent_m_s = (self.height_m(target) / config.setpoint_loss_s).max(slowest);
        (brakes.sqrt().min(silent_m_s).min(config.max_descend_m_s) * centred * fresh, why)
    }

    /// From 1 for a fresh target to 0 for a stale one; low above a well-known target it makes no difference.
    fn freshness(&self, situation: &Situation<'_>) -> f64 {
        let (fresh_s, stale_s) = (self.config.fresh_target_s, self.config.stale_target_s);
        if self.is_blind_but_sure(situation) || fresh_s >= stale_s {
            return 1.0;
        }
        ((stale_s - situation.age_s) / (stale_s - fresh_s)).clamp(0.0, 1.0)
    }
}

/// Where the body's down axis points, as a part of the height.
fn lean(situation: &Situation<'_>) -> Vector<Ned> {
    let down = situation.vehicle.ned_from_body * Vector::<Body>::new(0.0, 0.0, 1.0);
    flat(down) * (1.0 / down.z().max(0.5))
}

fn flat(vector: Vector<Ned>) -> Vector<Ned> {
    Vector::new(vector.x(), vector.y(), 0.0)
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::event::{Landed, Mode, VehicleState};
    use geometry::Rotation;

    #[test]
    fn a_velocity_that_the_position_does_not_follow_is_found_out_within_two_seconds() {
        let mut metric = Metric::new(MetricConfig::default());
        for i in 0..80u32 {
            let s = f64::from(i) / 40.0;
            // It is reported to move at 0.5 m/s, and stays where it is.
            let vehicle = vehicle(s, Point::new(0.3, 0.0, -5.0), Vector::new(0.0, 0.5, 0.0));
            let _ = metric.velocity(&situation(&vehicle));
        }
        let bias = metric.memory.unwrap().bias;
        assert!((bias - Vector::new(0.0, -0.5, 0.0)).norm() < 0.1, "{bias:?}");
    }

    /// The largest bias found in the velocity of a vehicle that moves east at 0.5 m/s and tells so, with states and ticks at the
    /// times given, and whose reported position is shifted north as a function of time.
    fn largest_bias(times: impl Iterator<Item = (f64, f64)>, north: impl Fn(f64) -> f64) -> f64 {
        let mut metric = Metric::new(MetricConfig::default());
        let mut largest_m_s = 0.0f64;
        for (told_s, now_s) in times {
            let place = Point::new(north(told_s), 0.5 * told_s, -5.0);
            let vehicle = vehicle(told_s, place, Vector::new(0.0, 0.5, 0.0));
            let now = Timestamp::from_seconds(now_s);
            let _ = metric.velocity(&Situation { now, ..situation(&vehicle) });
            largest_m_s = largest_m_s.max(metric.memory.unwrap().bias.norm());
        }
        largest_m_s
    }

    #[test]
    fn neither_jumps_nor_pauses_nor_old_states_are_taken_for_a_bias() {
        let steady = |i: u32| f64::from(i) * 0.025;
        let every = || (0..120u32).map(steady);
        let jumped = largest_bias(every().map(|s| (s, s)), |s| 0.25 * f64::from(u8::from(s > 1.0)));
        assert!(jumped < 1e-6, "{jumped}");
        for pause_s in [0.2, 0.3, 0.5] {
            let missed = |s: f64| s > 1.0 && s < 1.0 + pause_s;
            let paused = largest_bias(every().filter(|s| !missed(*s)).map(|s| (s, s)), |_| 0.0);
            assert!(paused < 1e-6, "a pause of {pause_s} s: {paused}");
            let told = |s: f64| (if missed(s) { 1.0 } else { s }, s);
            let silent = largest_bias(every().map(told), |_| 0.0);
            assert!(silent < 1e-6, "no state for {pause_s} s: {silent}");
        }
        let late = largest_bias(every().map(|s| (s, s + 0.3)), |_| 0.0);
        assert!(late < 1e-6, "states that come late: {late}");
    }

    #[test]
    fn no_patience_allows_a_fast_slide_at_the_touch_and_waiting_for_less_ends() {
        for (speed_m_s, ready) in [(0.4, true), (0.5, false)] {
            let mut metric = Metric::new(MetricConfig::default());
            let mut ends = Vec::new();
            for i in 0..600u32 {
                let s = f64::from(i) / 40.0;
                // Over the target, and never still.
                let velocity =
                    Vector::new(speed_m_s * if s % 2.0 < 1.0 { 1.0 } else { -1.0 }, 0.0, 0.0);
                let aside_m = speed_m_s * (0.5 - (s % 2.0 - 1.0).abs());
                let vehicle = vehicle(s, Point::new(aside_m, 0.0, -0.04), velocity);
                let situation = situation(&vehicle);
                let hurry = metric.hurry(&situation, &situation.target.unwrap());
                ends.push((s, hurry < 1.0, metric.progress(&situation)));
                let _ = metric.velocity(&situation);
            }
            let slow = ends.iter().any(|(s, slow, _)| *s > 3.5 && *slow);
            assert_eq!(slow, ready, "at {speed_m_s} m/s");
            let stuck = ends.iter().any(|(s, _, end)| *s > 10.1 && *end == Progress::Stuck);
            assert!(stuck || ready, "at {speed_m_s} m/s");
        }
    }

    fn vehicle(seconds: f64, position: Point<Ned>, velocity: Vector<Ned>) -> VehicleState {
        VehicleState {
            stamp: Timestamp::from_seconds(seconds),
            ned_from_body: Rotation::identity(),
            position,
            velocity,
            mode: Mode::Guided,
            armed: true,
            landed: Landed::InAir,
        }
    }

    /// A well-known target at the origin.
    fn situation(vehicle: &VehicleState) -> Situation<'_> {
        let offset = Point::origin() - vehicle.position;
        let target = TargetEstimate {
            position: Point::origin(),
            velocity: Vector::zero(),
            lateral_error_m: offset.horizontal_norm(),
            height_m: offset.z(),
            age_s: 0.05,
            deviation_m: 0.01,
            detections: 100,
            heading_rad: None,
            time_offset_s: 0.0,
            nis: None,
            contested: false,
        };
        Situation {
            now: vehicle.stamp,
            vehicle,
            target: Some(target),
            age_s: 0.05,
            half_view_rad: None,
            pad_moves: false,
            pad_heave_m_s: 0.0,
        }
    }

    /// A vehicle that stays so far beside its target at heights that change with time.
    fn hovered(aside_m: f64, seconds: f64, height_m: impl Fn(f64) -> f64) -> Progress {
        let mut metric = Metric::new(MetricConfig::default());
        let mut progress = Progress::Unchanged;
        for i in 0..(seconds * 40.0) as u32 {
            let s = f64::from(i) / 40.0;
            let vehicle = vehicle(s, Point::new(aside_m, 0.0, -height_m(s)), Vector::zero());
            let situation = situation(&vehicle);
            progress = metric.progress(&situation);
            let _ = metric.velocity(&situation);
        }
        progress
    }

    #[test]
    fn patience_ends_also_for_a_vehicle_that_sways_about_the_height_at_which_it_waits() {
        let sways = |s: f64| LOW_M + 0.1 * (2.0 * s).sin();
        assert!(!matches!(hovered(0.6, 5.0, sways), Progress::Stuck));
        assert!(matches!(hovered(0.6, 12.0, sways), Progress::Stuck));
        // One that has climbed away waits no more.
        let climbs = |s: f64| LOW_M - 0.1 + 0.5 * f64::from(u8::from(s > 6.0));
        assert!(!matches!(hovered(0.6, 12.0, climbs), Progress::Stuck));
    }
}
