//! Measures the height of the body's origin over the pad at the end of a landing, when the vehicle stands on it.
//!
//! The autopilot's position is that of its inertial sensors, which a real vehicle carries 10 to 30 cm above the ground. The
//! estimate of the target is relative to the same point, so that its height on the ground is `standing_height_m`. The camera
//! no longer sees the marker then, and the autopilot's height drifts near the ground: the error is 0.15 m at most in the
//! tests. So it is only reported, and changes no landing: one that is too large would request LAND too high.
//!
//! And whether a vehicle may stand on the pad already, although its autopilot does not report it. A lander that takes over the
//! landing of another one has not seen the pad: it receives the position from that one, or, where no position is known, a vehicle that is
//! quite still at the height of the local origin, near which it was armed, may stand: near the origin, and elsewhere only where its
//! autopilot does not report that it flies, as the ground has another height there.

use std::ops::RangeInclusive;

use geometry::{Ned, Point, Vector};

use crate::config::{Config, GuidanceConfig};
use crate::decision::TargetEstimate;
use crate::event::{Landed, VehicleState};
use crate::guidance::situation::Situation;
use crate::time::Timestamp;

/// Maximum speed of a vehicle that stands, in m/s.
pub(crate) const MAX_STANDING_M_S: f64 = 0.2;
/// Maximum height over the one it stands with, in metres, distance from the pad, and standard deviation of that, in metres,
/// at which a still vehicle may stand on the pad. From there LAND is safe if it does not. The height of a vehicle that the guidance
/// steers, which notices a touchdown on its own, is less: in wind LAND is led by a velocity that may err.
pub(crate) const MAX_STANDING_M: f64 = 0.3;
const MAX_STEERED_STANDING_M: f64 = 0.15;
const MAX_STANDING_LATERAL_M: f64 = 0.3;
const MAX_STANDING_DEVIATION_M: f64 = 0.2;
/// How much more or less height per second since the newest detection: the autopilot's height drifts, in m/s, for as long as an
/// autopilot may take to report that it stands, in seconds.
const STANDING_DRIFT_M_S: f64 = 0.02;
const MAX_DRIFT_S: f64 = 15.0;

/// Maximum age of a pad's position, in seconds: the autopilot's position drifts.
const MAX_REMEMBERED_S: f64 = 60.0;
/// Maximum speed of a vehicle that stands where no pad is known, in m/s, its minimum duration, in seconds, and the maximum
/// height over the local origin, in metres: a barometer drifts by so much in a flight.
const MAX_STILL_M_S: f64 = 0.1;
const MIN_STILL_S: f64 = 1.0;
const MAX_STILL_HEIGHT_M: f64 = 0.5;
/// Maximum distance from the local origin, in metres, at which the autopilot's report that such a vehicle flies is ignored: it
/// is seconds late.
const MAX_ORIGIN_M: f64 = 3.0;
/// Maximum time after taking over within which that is assumed, in seconds: an autopilot reports by then that it stands.
const MAX_UNREPORTED_S: f64 = 10.0;
/// Maximum distance from the pad of such a vehicle that stands next to it, in metres.
const MAX_NEXT_TO_PAD_M: f64 = 2.0;

/// Heights that a vehicle may have and that are above the error of the measurement, in metres.
const PLAUSIBLE_M: RangeInclusive<f64> = 0.15..=1.0;
/// Maximum age of the newest detection, in seconds: low over the marker the camera no longer sees it.
const MAX_AGE_S: f64 = 8.0;
/// Maximum standard deviation of the target's horizontal position, in metres.
const MAX_DEVIATION_M: f64 = 0.1;
/// Maximum distance from the target, in metres: next to the pad the ground may have another height.
const MAX_LATERAL_M: f64 = 0.3;

/// The height with which a landing ends.
#[derive(Copy, Clone, Debug, Default)]
pub(crate) struct StandingHeight {
    /// The smallest one, as the autopilot may report too early that it stands.
    lowest_m: Option<f64>,
}

impl StandingHeight {
    /// The autopilot reports that the vehicle stands on the ground, and LAND was requested; with this estimate of the pad.
    pub(crate) fn observe(&mut self, target: Option<TargetEstimate>) {
        let is_sound = |target: &TargetEstimate| {
            !target.ambiguous
                && target.age_s <= MAX_AGE_S
                && target.deviation_m <= MAX_DEVIATION_M
                && target.lateral_error_m <= MAX_LATERAL_M
        };
        if let Some(target) = target.filter(is_sound) {
            let lowest_m = self.lowest_m.filter(|lowest_m| *lowest_m <= target.height_m);
            self.lowest_m = Some(lowest_m.unwrap_or(target.height_m));
        }
    }

    /// The height in metres, once it was measured and is not small.
    pub(crate) fn measured_m(&self) -> Option<f64> {
        self.lowest_m.filter(|height_m| PLAUSIBLE_M.contains(height_m))
    }
}

/// The position of the pad, as the lander of an earlier controller knew it.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct RememberedPad {
    /// Its position, in metres from the autopilot's local origin.
    pub position: Point<Ned>,
    /// Standard deviation of its horizontal position, in metres.
    pub deviation_m: f64,
    /// The time of that.
    pub stamp: Timestamp,
}

/// The position of the pad, and where the vehicle is over it.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct SeenPad {
    /// The position.
    pub pad: RememberedPad,
    /// Height of the vehicle over it, in metres.
    pub height_m: f64,
}

/// The knowledge of a lander that takes over the landing of another one, or resumes its own after a silence.
#[derive(Copy, Clone, Debug, Default)]
pub(crate) struct Resumed {
    pad: Option<RememberedPad>,
    /// The time of the first state, and since when the vehicle is still.
    first: Option<Timestamp>,
    still_since: Option<Timestamp>,
}

impl Resumed {
    pub(crate) fn new(pad: Option<RememberedPad>) -> Self {
        Self { pad, first: None, still_since: None }
    }

    /// The vehicle's newest state.
    pub(crate) fn observe(&mut self, vehicle: &VehicleState) {
        self.first.get_or_insert(vehicle.stamp);
        let is_still = vehicle.velocity.norm() <= MAX_STILL_M_S;
        self.still_since = is_still.then(|| self.still_since.unwrap_or(vehicle.stamp));
    }

    /// True when the vehicle may stand although this lander has not seen the pad since.
    pub(crate) fn may_stand(&self, situation: &Situation<'_>, config: &Config) -> bool {
        let vehicle = situation.vehicle;
        let still_s = self.still_since.map_or(0.0, |since| vehicle.stamp.seconds_since(since));
        let is_still = is_recent(situation, config) && still_s >= MIN_STILL_S;
        let is_valid = |pad: &RememberedPad| {
            let age_s = situation.now.seconds_since(pad.stamp);
            (0.0..=MAX_REMEMBERED_S).contains(&age_s)
        };
        let Some(pad) = self.pad.filter(is_valid) else {
            let height_m = -vehicle.position.z() - standing_height_m(config);
            let known_s = self.first.map_or(0.0, |first| vehicle.stamp.seconds_since(first));
            let from_origin_m = (vehicle.position - Point::origin()).horizontal_norm();
            return is_still
                && height_m.abs() <= MAX_STILL_HEIGHT_M
                && known_s <= MAX_UNREPORTED_S
                && (from_origin_m <= MAX_ORIGIN_M || vehicle.landed != Landed::InAir);
        };
        let to_pad = pad.position - vehicle.position;
        let below = Below {
            height_m: to_pad.z(),
            lateral_m: to_pad.horizontal_norm(),
            deviation_m: pad.deviation_m,
            age_s: situation.now.seconds_since(pad.stamp),
            velocity: Vector::zero(),
        };
        let is_next_to_pad = below.lateral_m <= MAX_NEXT_TO_PAD_M
            && below.height_m >= -MAX_STILL_HEIGHT_M
            && is_low(config, &below, MAX_STANDING_M);
        is_right_over(situation, config, &below, MAX_STANDING_M) || is_still && is_next_to_pad
    }
}

/// A pad, as seen from the vehicle.
struct Below {
    height_m: f64,
    lateral_m: f64,
    deviation_m: f64,
    age_s: f64,
    velocity: Vector<Ned>,
}

/// True when the vehicle is still and the pad is known to be right below it: it may have touched down.
pub(crate) fn may_stand(situation: &Situation<'_>, config: &Config, is_steered: bool) -> bool {
    let Some(target) = situation.target else { return false };
    let below = Below {
        height_m: target.height_m,
        lateral_m: target.lateral_error_m,
        deviation_m: target.deviation_m,
        age_s: target.age_s,
        velocity: target.velocity,
    };
    let max_m = if is_steered { MAX_STEERED_STANDING_M } else { MAX_STANDING_M };
    let is_sound = !target.ambiguous && target.age_s <= MAX_REMEMBERED_S;
    is_sound && is_right_over(situation, config, &below, max_m)
}

/// The pad's position, for a lander that has to take over; `None` where it is not known well.
pub(crate) fn to_remember(now: Timestamp, target: &TargetEstimate) -> Option<RememberedPad> {
    let is_sound = !target.ambiguous
        && target.age_s <= MAX_AGE_S
        && target.deviation_m <= MAX_STANDING_DEVIATION_M;
    is_sound.then_some(RememberedPad {
        position: target.position,
        deviation_m: target.deviation_m,
        stamp: now,
    })
}

/// With heights up to `max_height_m`.
fn is_right_over(
    situation: &Situation<'_>,
    config: &Config,
    below: &Below,
    max_height_m: f64,
) -> bool {
    let max_m_s = MAX_STANDING_M_S + situation.pad_heave_m_s;
    let is_still = (situation.vehicle.velocity - below.velocity).norm() <= max_m_s;
    let is_over_pad =
        below.lateral_m <= MAX_STANDING_LATERAL_M && below.deviation_m <= MAX_STANDING_DEVIATION_M;
    is_recent(situation, config) && is_still && is_low(config, below, max_height_m) && is_over_pad
}

fn is_low(config: &Config, below: &Below, max_height_m: f64) -> bool {
    let drift_m = STANDING_DRIFT_M_S * libm::fmin(below.age_s, MAX_DRIFT_S);
    let height_m = below.height_m - standing_height_m(config);
    (-MAX_STILL_HEIGHT_M - drift_m..=max_height_m + drift_m).contains(&height_m)
}

fn is_recent(situation: &Situation<'_>, config: &Config) -> bool {
    situation.now.seconds_since(situation.vehicle.stamp) <= config.phases.stale_vehicle_s
}

/// Height over the pad of the body's origin of a vehicle that stands on it, in metres.
pub(crate) fn standing_height_m(config: &Config) -> f64 {
    match &config.guidance {
        GuidanceConfig::Metric(metric) => metric.standing_height_m,
        GuidanceConfig::Thesis(_) => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::guidance::metric::tests::{sinking, situation};

    /// However old the estimate is: its height errs by decimetres.
    #[test]
    fn a_vehicle_high_over_an_old_estimate_or_below_it_does_not_stand() {
        for (height_m, age_s, expected) in [
            (0.5, 10.0, true),
            (0.7, 50.0, false),
            (0.1, 61.0, false),
            (3.0, 135.0, false),
            (-0.3, 0.0, true),
            (-1.0, 8.0, false),
        ] {
            let vehicle = sinking(0.0, 0.0, height_m, 0.0);
            let mut situation = situation(&vehicle);
            situation.target = situation.target.map(|target| TargetEstimate { age_s, ..target });
            let may_stand = may_stand(&situation, &Config::default(), false);
            assert_eq!(may_stand, expected, "{height_m} m, {age_s} s");
        }
    }

    #[test]
    fn a_vehicle_that_is_steered_may_stand_only_where_it_is_lower() {
        for (height_m, steered, unsteered) in
            [(0.1, true, true), (0.2, false, true), (0.35, false, false)]
        {
            let vehicle = sinking(0.0, 0.0, height_m, 0.0);
            let may_stand =
                |is_steered| may_stand(&situation(&vehicle), &Config::default(), is_steered);
            assert_eq!((may_stand(true), may_stand(false)), (steered, unsteered), "{height_m} m");
        }
    }

    /// Where the pad is not known, a vehicle that hovers low next to a hill must not be landed there.
    #[test]
    fn a_vehicle_that_is_reported_to_fly_far_from_the_origin_does_not_stand() {
        for (north_m, landed, expected) in [
            (0.0, Landed::InAir, true),
            (2.5, Landed::InAir, true),
            (40.0, Landed::InAir, false),
            (40.0, Landed::Unknown, true),
            (40.0, Landed::OnGround, true),
        ] {
            let vehicle = VehicleState {
                position: Point::new(north_m, 0.0, -0.3),
                landed,
                ..sinking(0.0, 0.0, 0.3, 0.0)
            };
            let mut resumed = Resumed::new(None);
            let seconds = vehicle.stamp.nanos() as f64 * 1e-9;
            for step in 0..=20 {
                let stamp = Timestamp::from_seconds(seconds - 2.0 + 0.1 * f64::from(step));
                resumed.observe(&VehicleState { stamp, ..vehicle });
            }
            let may_stand = resumed.may_stand(&situation(&vehicle), &Config::default());
            assert_eq!(may_stand, expected, "{north_m} m from the origin, {landed:?}");
        }
    }
}
