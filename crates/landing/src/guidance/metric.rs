//! The metric guidance computes a velocity setpoint from the target's position in metres, by closing speed to the side, a funnel downwards,
//! waiting low over the pad, and the touchdown.
//!
//! Laterally, the commanded closing speed is proportional to the error that will be left when a setpoint
//! takes effect, limited to the speed from which the vehicle can still brake before the target. The setpoint
//! is not that speed but the one that makes the autopilot accelerate as needed to reach it. An autopilot
//! smooths a velocity setpoint: ArduPilot's path approaches it with a time constant of acceleration limit
//! over jerk limit, 0.5 s, and the vehicle follows the path. The path's velocity depends only on the
//! setpoints sent, so it is computed here too, and the setpoint is that velocity plus the time constant times
//! the commanded acceleration. Wind that pushes the vehicle off its path is countered at once, and a lasting
//! error accumulates in the path's velocity, which is the only integrator.
//!
//! The reported velocity is biased, by 2 to 3 cm/s normally and by decimetres a second when the autopilot's
//! filter has a wrong tilt; an observer estimates the bias from the displacement of the reported position.
//!
//! Vertically, a funnel. Inside it the vehicle descends, as fast as it can still brake, fastest on the axis
//! and not at all at the edge. The camera of a vehicle that tilts into the wind points past the target; above
//! `view_height_m` the vehicle stays so far upwind that the marker remains in view.
//!
//! Contributions to the error, in 100 modelled flights in 5 m/s of wind with turbulence 3 (`alight experiment
//! landing`), median and worst, and the largest slide at touchdown:
//!
//! | change | error, m | slide, m/s |
//! |---|---|---|
//! | as it is | 0.017, 0.066 | 0.09 |
//! | LAND from 0.1 m | 0.017, 0.062 | 0.16 |
//! | LAND from 0.2 m | 0.028, 0.098 | 0.29 |
//! | LAND from 0.4 m | 0.067, 0.185 | 0.30 |
//! | LAND from 0.8 m | 0.113, 0.427 | 0.24 |
//! | half the gains, no lead | 0.045, 0.157 | 0.18 |
//! | the reported velocity without its bias | 0.024, 0.070 | 0.08 |
//! | an autopilot without estimation errors | 0.014, 0.067 | 0.15 |
//!
//! PX4 follows a velocity setpoint without a path, with a gain of 1.8 per second on the error of its own velocity
//! (`MPC_XY_VEL_P_ACC`), which is near enough to the same time constant.
//!
//! Below `blind_height_m` the vehicle continues down on the estimate when the marker leaves the view. LAND
//! follows no target and drifts by a decimetre in a second of gusts, so it takes over only at
//! `land_height_m`, and only from a vehicle that moves slowly sideways.

use geometry::{Ned, Point, Vector, squared};
use libm::{cos, exp, fmax, fmin, tan};

use crate::config::MetricConfig;
use crate::decision::{Reason, TargetEstimate};
use crate::guidance::observer::{Observer, horizontal, limited};
use crate::guidance::path::{Path, time_constant_s};
use crate::guidance::situation::{Guidance, Progress, Situation};
use crate::time::Timestamp;

/// Multiple of the funnel's radius outside of which a descent becomes an approach again.
const FUNNEL_HYSTERESIS: f64 = 1.2;

/// Fraction of the lateral acceleration that is planned for braking before the target.
const BRAKING: f64 = 0.7;

/// The target's position is known while its standard deviation, in metres, and the age of its newest
/// detection, in seconds, are below these.
const KNOWN_M: f64 = 0.5;
const KNOWN_S: f64 = 20.0;

/// Maximum speed of a pad that counts as still, in m/s: the autopilot's drift is part of it.
const MAX_STILL_M_S: f64 = 0.3;

/// Yaw rate per heading error, in 1/s.
const TURN_GAIN: f64 = 0.8;

/// Height below which the vehicle waits for a small error, in metres.
const LOW_M: f64 = 0.5;

/// A vehicle that waits makes room by climbing to about `LOW_M`; it is no longer low this far above it, in
/// metres.
const LOW_HYSTERESIS_M: f64 = 0.2;

/// Maximum difference between the velocity of the path and the vehicle's in steady flight, in m/s; more is a
/// gust.
const MAX_STEADY_M_S: f64 = 0.3;

/// Maximum lateral speed over the pad at which a low vehicle descends, in m/s: at the ground, the increase
/// per metre of height, and, after some seconds of waiting, per second; and the limit however long it waits.
const TOUCHDOWN_M_S: f64 = 0.2;
const TOUCHDOWN_PER_HEIGHT: f64 = 0.4;
const TOUCHDOWN_WAIT_S: f64 = 1.0;
const TOUCHDOWN_RELAXATION_M_S2: f64 = 0.1;
const MAX_TOUCHDOWN_M_S: f64 = 0.3;

/// Minimum descent speed at touchdown on a heaving pad, in m/s.
const MIN_TOUCHDOWN_M_S: f64 = 0.3;

/// Maximum speed down, in m/s, up to which a pad that does not heave and seems to sink is followed: a touch is at 0.8 m/s at most. A pad
/// that sinks faster is a wrong estimate, as from frames with wrong stamps, and would be followed hard onto the ground; an autopilot's
/// height that drifts down by 0.5 m/s, twice the largest measured error, leaves 0.2 m/s of descent.
const MAX_FOLLOWING_M_S: f64 = 0.7;
/// Within these it is followed, in m/s: by the first also in a faster descent, as the autopilot's height drifts there as well; by the
/// second at most, also where the vehicle waits or is to climb, low and to the side of the pad.
const MAX_DRIFT_DOWN_M_S: [f64; 2] = [0.2, 0.5];

/// Time ahead for which the error of a low vehicle is predicted, in seconds.
const LOW_LEAD_S: f64 = 0.4;

/// Maximum climb speed of a low vehicle that is pushed out of its funnel, in m/s, and the gain on the missing
/// height, in 1/s.
const ROOM_M_S: f64 = 0.5;
const ROOM_GAIN: f64 = 2.0;

/// A vehicle that is commanded to descend at this speed, in m/s, and is stationary this long, in seconds, is
/// on the ground: the first where it should be near the ground, the second where it may also just be turning
/// from a climb.
const PUSHING_M_S: f64 = 0.15;
const STANDING_S: [f64; 2] = [0.4, 0.9];

/// A vehicle that leans by more than this, in radians, does not stand: a gust holds it in the air. ArduPilot's levels within 0.2 s of its
/// touch; PX4's simulated one keeps its tilt there, 0.15 in 5 m/s of wind with a drag (`SIH_KDV`) of 0.3.
const MAX_STANDING_TILT_RAD: f64 = 0.3;
/// Maximum speed over the pad, in m/s, of a vehicle near the ground that leans and yet stands, as on an edge, and how long it must be that
/// still, in seconds.
const MAX_RESTING_M_S: f64 = 0.1;
const RESTING_S: f64 = 3.0;

/// Time for which a vehicle near the ground that is commanded down has not sunk until it is steered sideways no more, in seconds:
/// one that stands, and whose reported velocity errs, would be commanded faster and faster, and slide.
const TOUCHING_S: f64 = 0.25;
/// Maximum climb speed of a vehicle that may stand, in m/s: the reported one errs.
const MAX_RISING_M_S: f64 = 0.1;

/// Height below which a descent is fast enough to show whether the vehicle stands, in metres.
const PUSHING_HEIGHT_M: f64 = 0.1;
/// Maximum time from the state in which a vehicle is bound to touch the ground to one in which it stays there, in seconds.
const CONTACT_S: f64 = 0.3;

/// Height below which the rest of the descent takes less time than another try, in metres, and the factor by
/// which the allowed deviation grows there.
const NEAR_M: f64 = 0.3;
const COMMITTED: f64 = 1.5;

/// Fraction of the autopilot's vertical acceleration with which it is expected to brake when setpoints stop.
const UNATTENDED_BRAKING: f64 = 0.9;

/// Delay of the link, both ways together, in seconds, that is part of `dead_time_s`; and the delay beyond it at
/// which the gains are halved: a longer delay needs smaller gains, or the vehicle sways.
const USUAL_LINK_S: f64 = 0.05;
const HALF_GAIN_S: f64 = 0.15;

/// Minimum fraction of the lateral speed that is allowed at the touchdown over a slow link: errors that are not seen in time must be
/// slower beforehand, but it has to land.
const MIN_TOUCHDOWN_FRACTION: f64 = 0.5;

/// Longest interval between two steps that is counted, in seconds.
const MAX_STEP_S: f64 = 0.1;

/// The metric guidance with its memory.
#[derive(Clone, Debug)]
pub struct Metric {
    config: MetricConfig,
    observer: Option<Observer>,
    waiting_since: Option<Timestamp>,
    standing_since: Option<Timestamp>,
    /// Since when a vehicle that leans is still near the ground, whatever it is commanded.
    resting_since: Option<Timestamp>,
    /// When it was last bound to touch the ground, or stayed there since.
    touching_at: Option<Timestamp>,
}

impl Guidance for Metric {
    /// True when the target is recent, or low below and well known, and no other position may be the pad; or when the vehicle
    /// touches down in any case.
    fn may_descend(&self, situation: &Situation<'_>) -> bool {
        let is_ambiguous = situation.target.is_some_and(|target| target.ambiguous);
        let is_sure = !is_ambiguous && self.is_target_known(situation);
        situation.level_because.is_none() && (is_sure || self.touches_down(situation))
    }

    fn has_target(&self, situation: &Situation<'_>) -> bool {
        situation
            .target
            .is_some_and(|target| target.deviation_m <= KNOWN_M && target.age_s <= KNOWN_S)
    }

    /// True when the vehicle is bound to touch the ground, or was and has stayed there. Detections, or their absence, are
    /// then no reason to climb: that would be from the ground, and the estimate of a vehicle that stands drifts.
    fn touches_down(&self, situation: &Situation<'_>) -> bool {
        let is_near = |it: &TargetEstimate| self.height_m(it).abs() <= NEAR_M;
        situation.target.is_some_and(|it| is_near(&it) && !rises(situation, &it))
            && self.touching_at.is_some_and(|at| situation.now.seconds_since(at) <= CONTACT_S)
    }

    fn steers_until_land(&self) -> bool {
        true
    }

    fn needs_pose(&self) -> bool {
        true
    }

    /// Where the vehicle is in its funnel.
    fn progress(&mut self, situation: &Situation<'_>) -> Progress {
        let Some(target) = situation.target else { return Progress::Unchanged };
        if !self.may_descend(situation) {
            // Also where nothing may descend, a climb would come too late.
            let touches_down = self.touches_down(situation);
            return if touches_down { Progress::Blind } else { Progress::Unchanged };
        }
        if self.stands(situation, &target) {
            return Progress::Ready(Reason::TouchedEarly);
        }
        let is_visible = self.is_visible(situation);
        let height_m = self.height_m(&target);
        let error = self.funnel_error(situation, &target);
        let is_hasty = self.lateral_speed_scale(situation, &target) >= 1.0;
        let is_still = !situation.pad_moves && target.velocity.norm() <= MAX_STILL_M_S;
        if height_m <= self.config.land_height_m
            && error < 1.0
            && !is_hasty
            && is_still
            && self.is_steady(situation)
        {
            return Progress::Ready(if is_visible {
                Reason::LowAndAligned
            } else {
                Reason::LowAndUnseen
            });
        }
        let waits_in_vain = self.waited_s(situation) > 2.0 * self.config.settle_s;
        if waits_in_vain && (error >= 1.0 || is_hasty) && !self.touches_down(situation) {
            return Progress::Stuck;
        }
        match (is_visible, error) {
            (true, error) if error < 1.0 => Progress::Descending,
            (true, error) if error > FUNNEL_HYSTERESIS && height_m > LOW_M => Progress::Aligning,
            (true, _) => Progress::Unchanged,
            (false, _) => Progress::Blind,
        }
    }

    fn velocity(&mut self, situation: &Situation<'_>) -> (Vector<Ned>, Reason) {
        let Some(target) = situation.target else { return (Vector::zero(), Reason::Searching) };
        let before = self.observer.unwrap_or_else(|| Observer::new(situation));
        let step_s = situation.now.seconds_since(before.stamp).clamp(0.0, MAX_STEP_S);
        let mut observer = before.after(&self.config, situation, step_s);
        self.observer = Some(observer);
        let (mut lateral, (mut descent_m_s, why)) =
            (self.lateral(&observer, situation, &target), self.descent(situation, &target));
        // A vehicle that is out of its funnel is to climb, also from the ground.
        if descent_m_s >= 0.0 {
            let touching_s = self.touching_s(situation, &target);
            let is_low = descent_m_s > 0.0 && self.height_m(&target) <= PUSHING_HEIGHT_M;
            // Whether it stands shows while it is pushed down.
            if is_low || touching_s.is_some() || self.touches_down(situation) {
                descent_m_s = fmax(descent_m_s, self.push_m_s());
            }
            if touching_s.is_some_and(|touching_s| touching_s >= TOUCHING_S) {
                // The velocity that the autopilot reports of a vehicle that stands.
                lateral = horizontal(target.velocity) - observer.bias;
                observer.path = Path::new(lateral);
            }
        }
        let [low, high] = MAX_DRIFT_DOWN_M_S;
        let max_m_s = (MAX_FOLLOWING_M_S - descent_m_s).clamp(low, high);
        let followed_m_s = fmin(target.velocity.z(), max_m_s + situation.pad_heave_m_s);
        let down = approach_speed(
            before.setpoint.z(),
            descent_m_s + followed_m_s,
            self.config.descend_acceleration_m_s2 * step_s,
        );
        let setpoint = Vector::new(lateral.x(), lateral.y(), down);
        if !setpoint.is_finite() {
            self.reset();
            return (setpoint, why);
        }
        observer.setpoint = setpoint;
        self.observer = Some(observer);
        self.note_waiting(situation, &target);
        (setpoint, why)
    }

    /// The autopilot's path follows the setpoint that was sent.
    fn on_setpoint_sent(&mut self, velocity: Vector<Ned>) {
        if let Some(observer) = &mut self.observer {
            observer.setpoint = velocity;
        }
    }

    /// The turn towards the pad's heading; none near the ground, where it would only disturb.
    fn yaw_rate(&self, situation: &Situation<'_>) -> f64 {
        let target = situation.target.filter(|target| self.height_m(target) > LOW_M);
        let Some(pad_rad) = target.and_then(|target| target.heading_rad) else { return 0.0 };
        let error = pad_rad + self.config.pad_heading_rad - situation.vehicle.heading_rad();
        let turn = std::f64::consts::TAU;
        let error = error - turn * (error / turn).round();
        (error * TURN_GAIN).clamp(-self.config.turn_rad_s, self.config.turn_rad_s)
    }

    fn begin_retry(&mut self) {
        self.waiting_since = None;
    }

    fn reset(&mut self) {
        self.observer = None;
        self.waiting_since = None;
        self.standing_since = None;
        self.resting_since = None;
        self.touching_at = None;
    }
}

impl Metric {
    /// A guidance without memory.
    pub fn new(config: MetricConfig) -> Self {
        Self {
            config,
            observer: None,
            waiting_since: None,
            standing_since: None,
            resting_since: None,
            touching_at: None,
        }
    }

    fn is_target_known(&self, situation: &Situation<'_>) -> bool {
        self.is_visible(situation) || self.may_descend_blind(situation)
    }

    fn is_visible(&self, situation: &Situation<'_>) -> bool {
        situation.age_s <= self.config.stale_target_s
    }

    fn may_descend_blind(&self, situation: &Situation<'_>) -> bool {
        situation.target.is_some_and(|target| {
            let height_m = self.height_m(&target);
            let relaxation = if height_m <= NEAR_M { COMMITTED } else { 1.0 };
            // A vehicle that presses on something does not climb before it is known to stand there.
            let stands = self.standing_since.or(self.resting_since).is_some() && height_m <= NEAR_M;
            height_m <= self.config.blind_height_m
                && situation.age_s <= self.config.stale_target_s + self.config.blind_s
                && (stands || target.deviation_m <= self.config.blind_deviation_m * relaxation)
        })
    }

    /// True while the vehicle follows its path. In a gust it does not, and LAND, which starts a new path,
    /// would let the vehicle drift: then the touchdown precedes LAND.
    fn is_steady(&self, situation: &Situation<'_>) -> bool {
        self.observer.is_none_or(|observer| {
            let difference = observer.path.velocity() - situation.vehicle.velocity;
            horizontal(difference).norm() <= MAX_STEADY_M_S
        })
    }

    /// Horizontal offset from the vehicle to the target, in metres.
    fn offset(&self, situation: &Situation<'_>, target: &TargetEstimate) -> Vector<Ned> {
        horizontal(target.position - self.position_now(situation))
    }

    /// The vehicle's position extrapolated from its newest state.
    fn position_now(&self, situation: &Situation<'_>) -> Point<Ned> {
        let max_s = fmax(MAX_STEP_S, situation.link_delay_s);
        let age_s = situation.now.seconds_since(situation.vehicle.stamp).clamp(0.0, max_s);
        let velocity = horizontal(situation.vehicle.velocity) + self.bias();
        situation.vehicle.position + velocity * age_s
    }

    fn bias(&self) -> Vector<Ned> {
        self.observer.map_or(Vector::zero(), |observer| observer.bias)
    }

    /// The vehicle's horizontal velocity over the pad, in m/s.
    fn closing(&self, situation: &Situation<'_>, target: &TargetEstimate) -> Vector<Ned> {
        let pad_m_s = limited(horizontal(target.velocity), self.config.max_pad_m_s);
        horizontal(situation.vehicle.velocity) + self.bias() - pad_m_s
    }

    /// Horizontal offset to the point that is aimed at, in metres: high up, where the wind tilts the vehicle,
    /// that is not the target but the nearest point from which the marker is in view.
    fn error(&self, situation: &Situation<'_>, target: &TargetEstimate) -> Vector<Ned> {
        self.offset(situation, target) - self.upwind(situation, target)
    }

    fn upwind(&self, situation: &Situation<'_>, target: &TargetEstimate) -> Vector<Ned> {
        let config = &self.config;
        let (Some(view_rad), Some(observer)) = (situation.half_view_rad, self.observer) else {
            return Vector::zero();
        };
        let height_m = self.height_m(target);
        let fraction = (height_m / config.view_height_m - 1.0).clamp(0.0, 1.0);
        let seen_m = height_m * tan(view_rad - config.view_margin_rad) - config.view_margin_m;
        let axis = observer.tilt * height_m;
        let excess_m = axis.norm() - fmax(seen_m, 0.0);
        if excess_m <= 0.0 { Vector::zero() } else { axis * (fraction * excess_m / axis.norm()) }
    }

    fn height_m(&self, target: &TargetEstimate) -> f64 {
        target.height_m - self.config.standing_height_m
    }

    fn waited_s(&self, situation: &Situation<'_>) -> f64 {
        self.waiting_since.map_or(0.0, |since| situation.now.seconds_since(since))
    }

    /// The error relative to the funnel's radius, which near the ground grows with the waiting time.
    fn funnel_error(&self, situation: &Situation<'_>, target: &TargetEstimate) -> f64 {
        let config = &self.config;
        let height_m = fmax(self.height_m(target), 0.0);
        let relaxation = (self.waited_s(situation) / config.settle_s).clamp(0.0, 1.0);
        let widest_m = fmax(config.funnel_m, config.blind_error_m);
        let radius_m = config.funnel_m
            + (widest_m - config.funnel_m) * relaxation
            + config.funnel_per_height * height_m;
        let error = self.error(situation, target);
        if height_m > LOW_M {
            return error.norm() / radius_m;
        }
        // A low vehicle touches down before a growing error is seen, so the predicted error counts too.
        let closing = self.closing(situation, target);
        fmax(error.norm(), (error - closing * LOW_LEAD_S).norm()) / radius_m
    }

    /// The lateral speed over the pad relative to the one allowed at this height, which grows with the
    /// waiting time: a vehicle that touches down while a gust moves it slides.
    fn lateral_speed_scale(&self, situation: &Situation<'_>, target: &TargetEstimate) -> f64 {
        let height_m = fmax(self.height_m(target), 0.0);
        if height_m > LOW_M || self.observer.is_none() {
            return 0.0;
        }
        let max_m_s = TOUCHDOWN_M_S
            + TOUCHDOWN_PER_HEIGHT * height_m
            + TOUCHDOWN_RELAXATION_M_S2 * fmax(self.waited_s(situation) - TOUCHDOWN_WAIT_S, 0.0);
        let fraction = fmax(gentleness(extra_delay_s(situation)), MIN_TOUCHDOWN_FRACTION);
        self.touchdown_slide_m_s(situation, target) / (fmin(max_m_s, MAX_TOUCHDOWN_M_S) * fraction)
    }

    /// The horizontal speed over the pad with which the vehicle touches the ground, in m/s: that of now or, should a gust end on the way,
    /// that of then. A vehicle leans against a gust by following a path that is faster than the vehicle itself, and gets up to the path's
    /// speed once the gust is over. One that stands leans against nothing, whatever path it is to follow. Of 3000 modelled flights with a
    /// gust of 5 m/s (seeds from 880001, up to 8 m/s of wind) 16 touch faster than 0.3 m/s sideways by the speed of now alone, and 3 by
    /// this one.
    fn touchdown_slide_m_s(&self, situation: &Situation<'_>, target: &TargetEstimate) -> f64 {
        let closing = self.closing(situation, target);
        let leaning = self.observer.filter(|_| leans(situation)).map_or(Vector::zero(), |it| {
            horizontal(it.path.velocity() - situation.vehicle.velocity)
        });
        let gust = leaning - limited(leaning, MAX_STEADY_M_S);
        let descent_m_s = fmax(sinking_m_s(situation, target), self.config.touchdown_descend_m_s);
        let until_touch_s = fmax(self.height_m(target), 0.0) / descent_m_s;
        let gained = 1.0 - exp(-until_touch_s / time_constant_s(&situation.limits));
        fmax(closing.norm(), (closing + gust * gained).norm())
    }

    /// Notes since when the vehicle is low, since when it is stationary although commanded down, and whether it is bound to
    /// touch the ground.
    fn note_waiting(&mut self, situation: &Situation<'_>, target: &TargetEstimate) {
        let height_m = self.height_m(target);
        if height_m <= LOW_M {
            self.waiting_since.get_or_insert(situation.now);
        } else if height_m > LOW_M + LOW_HYSTERESIS_M {
            self.waiting_since = None;
        }
        let is_still = sinking_m_s(situation, target) < 0.3 * PUSHING_M_S;
        if self.is_pushed(target) && is_still && height_m <= LOW_M && !leans(situation) {
            self.standing_since.get_or_insert(situation.now);
        } else {
            self.standing_since = None;
        }
        let rests = is_still && self.closing(situation, target).norm() <= MAX_RESTING_M_S;
        if rests && leans(situation) && height_m.abs() <= NEAR_M {
            self.resting_since.get_or_insert(situation.now);
        } else {
            self.resting_since = None;
        }
        if self.is_bound_to_touch(situation, target) || self.has_touched(situation, target) {
            self.touching_at = Some(situation.now);
        }
    }

    /// The speed down that shows whether a vehicle stands, in m/s: that of the touchdown, within limits.
    fn push_m_s(&self) -> f64 {
        self.config.touchdown_descend_m_s.clamp(1.2 * PUSHING_M_S, 2.0 * PUSHING_M_S)
    }

    /// True when the last setpoint was down, fast enough to show whether the vehicle stands.
    fn is_pushed(&self, target: &TargetEstimate) -> bool {
        self.observer
            .is_some_and(|observer| observer.setpoint.z() - target.velocity.z() >= PUSHING_M_S)
    }

    /// True when the vehicle is so low that a climb which is commanded now would stop it on the ground or a few centimetres above; not
    /// where it has sunk so far below the ground that the height must be wrong.
    fn is_bound_to_touch(&self, situation: &Situation<'_>, target: &TargetEstimate) -> bool {
        let (height_m, sinking_m_s) = (self.height_m(target), sinking_m_s(situation, target));
        let lag_s = self.config.descend_lag_s + extra_delay_s(situation);
        let stopping_m = sinking_m_s * lag_s
            + squared(sinking_m_s) / (2.0 * situation.limits.vertical_acceleration_m_s2);
        sinking_m_s >= PUSHING_M_S && height_m <= stopping_m && height_m.abs() <= NEAR_M
    }

    /// True when it was bound to touch the ground, and does not sink any more though it is pushed down: its speed may err by more than
    /// counts as standing still.
    fn has_touched(&self, situation: &Situation<'_>, target: &TargetEstimate) -> bool {
        self.touches_down(situation)
            && !leans(situation)
            && self.is_pushed(target)
            && sinking_m_s(situation, target) < PUSHING_M_S
    }

    /// For how long a vehicle near the ground has not sunk although it is commanded down; `None` if it sinks, or rises as in a gust.
    fn touching_s(&self, situation: &Situation<'_>, target: &TargetEstimate) -> Option<f64> {
        let may_stand = self.height_m(target) <= NEAR_M && !rises(situation, target);
        let since = self.standing_since.filter(|_| may_stand)?;
        Some(situation.now.seconds_since(since))
    }

    fn stands(&self, situation: &Situation<'_>, target: &TargetEstimate) -> bool {
        let height_m = self.height_m(target);
        let enough_s = STANDING_S[usize::from(height_m > NEAR_M)];
        let persists = |since: Option<Timestamp>, enough_s: f64| {
            since.is_some_and(|since| situation.now.seconds_since(since) >= enough_s)
        };
        height_m <= LOW_M
            && (persists(self.standing_since, enough_s) || persists(self.resting_since, RESTING_S))
    }

    fn lateral(
        &self,
        observer: &Observer,
        situation: &Situation<'_>,
        target: &TargetEstimate,
    ) -> Vector<Ned> {
        let config = &self.config;
        let delay_s = extra_delay_s(situation);
        let gentle = gentleness(delay_s);
        let closing = self.closing(situation, target);
        let lead_s = config.acceleration_lead_s;
        let left = self.error(situation, target)
            - closing * (config.dead_time_s + delay_s)
            - observer.acceleration * (0.5 * squared(lead_s));
        // While the autopilot reduces its acceleration, within its jerk, the speed still grows.
        let fading = observer.path.acceleration();
        let closing = closing
            + observer.acceleration * lead_s
            + fading * (fading.norm() / (2.0 * situation.limits.jerk_m_s3));
        let left_m = left.norm();
        let braking_m_s = (2.0 * BRAKING * config.lateral_acceleration_m_s2 * left_m).sqrt();
        let speed_m_s =
            fmin(fmin(gentle * config.lateral_gain * left_m, braking_m_s), config.max_lateral_m_s);
        let desired = if left_m > 1e-9 { left * (speed_m_s / left_m) } else { Vector::zero() };
        let acceleration = limited(
            (desired - closing) * (gentle * config.velocity_gain),
            config.lateral_acceleration_m_s2,
        );
        limited(
            observer.path.velocity() + acceleration * time_constant_s(&situation.limits),
            config.max_lateral_m_s + config.max_pad_m_s,
        )
    }

    /// Speed towards the pad, and why.
    fn descent(&self, situation: &Situation<'_>, target: &TargetEstimate) -> (f64, Reason) {
        let config = &self.config;
        let touches_down = self.touches_down(situation);
        if target.ambiguous && !touches_down {
            return (0.0, Reason::Ambiguous);
        }
        if !self.is_target_known(situation) && !touches_down {
            return (0.0, Reason::TargetAging);
        }
        let error = self.funnel_error(situation, target);
        let speed_scale = self.lateral_speed_scale(situation, target);
        let centred = fmax(1.0 - error * error, 0.0) * fmax(1.0 - speed_scale * speed_scale, 0.0);
        let fresh = self.freshness(situation);
        let height_m = self.height_m(target);
        let why = if touches_down {
            self.descending(situation)
        } else if centred == 0.0 && height_m <= LOW_M {
            Reason::Settling
        } else if centred == 0.0 {
            Reason::Aligning
        } else if fresh == 0.0 {
            Reason::TargetAging
        } else {
            self.descending(situation)
        };
        let is_low = height_m < LOW_M && !self.has_touched(situation, target);
        if error > FUNNEL_HYSTERESIS && is_low {
            // Tilting against a gust costs height, and the vehicle must not touch down sliding.
            return (-fmin(ROOM_GAIN * (LOW_M - height_m), ROOM_M_S), Reason::Settling);
        }
        let sinking_m_s = fmax(sinking_m_s(situation, target), 0.0);
        // Over a slow link it is already lower, and lower still when the setpoint arrives.
        let height_m = height_m - sinking_m_s * extra_delay_s(situation);
        let ahead_m = height_m
            - config.land_height_m
            - fmax(sinking_m_s - config.touchdown_descend_m_s, 0.0) * config.descend_lag_s;
        // The part of a heave that is not estimated adds to the touchdown's speed.
        let min_m_s = fmin(MIN_TOUCHDOWN_M_S, config.touchdown_descend_m_s);
        let end_m_s = fmax(config.touchdown_descend_m_s - 0.5 * situation.pad_heave_m_s, min_m_s);
        let braking = squared(end_m_s) + 2.0 * config.descend_braking_m_s2 * fmax(ahead_m, 0.0);
        let unattended_m_s = self.unattended_m_s(situation, height_m, end_m_s);
        let gust_m_s = fmax(height_m / config.gust_time_s, end_m_s);
        let max_m_s =
            fmin(fmin(fmin(braking.sqrt(), unattended_m_s), gust_m_s), config.max_descend_m_s);
        match situation.level_because {
            Some(reason) if centred * fresh > 0.0 => (0.0, reason),
            _ => (max_m_s * centred * fresh, why),
        }
    }

    /// Why it descends.
    fn descending(&self, situation: &Situation<'_>) -> Reason {
        if self.is_visible(situation) { Reason::Descending } else { Reason::DescendingUnseen }
    }

    /// The fastest descent from which the vehicle, should no setpoint follow, reaches the ground no faster than
    /// `end_m_s`: for the autopilot's setpoint timeout it continues unchanged, then it brakes.
    fn unattended_m_s(&self, situation: &Situation<'_>, height_m: f64, end_m_s: f64) -> f64 {
        let limits = &situation.limits;
        let timeout_s = limits.setpoint_timeout_s.unwrap_or(self.config.setpoint_loss_s);
        let braking_m_s2 = UNATTENDED_BRAKING * limits.vertical_acceleration_m_s2;
        // Solves speed * delay + (speed^2 - end^2) / (2 * braking) = height.
        let delay_m_s = braking_m_s2 * (timeout_s + self.config.descend_lag_s);
        let end = squared(end_m_s);
        let speed_m_s = (squared(delay_m_s) + end + 2.0 * braking_m_s2 * fmax(height_m, 0.0))
            .sqrt()
            - delay_m_s;
        fmax(speed_m_s, end_m_s)
    }

    /// From 1 for a fresh target to 0 for a stale one; 1 low above a well-known target.
    fn freshness(&self, situation: &Situation<'_>) -> f64 {
        let (fresh_s, stale_s) = (self.config.fresh_target_s, self.config.stale_target_s);
        if self.may_descend_blind(situation) || fresh_s >= stale_s {
            return 1.0;
        }
        ((stale_s - situation.age_s) / (stale_s - fresh_s)).clamp(0.0, 1.0)
    }
}

/// Speed of the vehicle down towards the pad, in m/s.
fn sinking_m_s(situation: &Situation<'_>, target: &TargetEstimate) -> f64 {
    situation.vehicle.velocity.z() - target.velocity.z()
}

/// True when the vehicle rises as in a gust.
fn rises(situation: &Situation<'_>, target: &TargetEstimate) -> bool {
    sinking_m_s(situation, target) < -MAX_RISING_M_S
}

/// True when the vehicle leans so far that it cannot stand on the ground.
fn leans(situation: &Situation<'_>) -> bool {
    situation.vehicle.ned_from_body.down_axis().z() < cos(MAX_STANDING_TILT_RAD)
}

/// The part of the link's delay that `dead_time_s` does not contain, in seconds.
fn extra_delay_s(situation: &Situation<'_>) -> f64 {
    fmax(situation.link_delay_s - USUAL_LINK_S, 0.0)
}

/// The factor of the gains over a link that is slower than usual by `delay_s`.
fn gentleness(delay_s: f64) -> f64 {
    HALF_GAIN_S / (HALF_GAIN_S + delay_s)
}

/// From `last` towards `desired` by at most `step`; a descent ends at once, because the autopilot smooths it.
fn approach_speed(last: f64, desired: f64, step: f64) -> f64 {
    if desired < last { desired } else { fmin(desired, last + step) }
}

#[cfg(test)]
pub(crate) mod tests;
