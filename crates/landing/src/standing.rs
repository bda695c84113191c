//! The height of the body's origin over the pad when the vehicle stands on it, measured at the end of a landing.
//!
//! The autopilot's position is that of its inertial sensors, which a real vehicle carries 10 to 30 cm above the ground. The
//! estimate of the target is relative to the same point, so that its height on the ground is `standing_height_m`. The camera
//! no longer sees the marker then, and the autopilot's height drifts near the ground: the error is 0.15 m at most in the
//! tests. So it is told, and changes no landing: one that is too large would ask for LAND too high.
//!
//! And whether a vehicle may stand on the pad already, although its autopilot does not say so.

use std::ops::RangeInclusive;

use crate::config::{Config, GuidanceConfig};
use crate::decision::TargetEstimate;
use crate::guidance::situation::Situation;

/// Maximum speed of a vehicle that stands, in m/s.
pub(crate) const MAX_STANDING_M_S: f64 = 0.2;
/// Maximum height over the one it stands with, in metres, distance from the pad, and standard deviation of that, in metres,
/// at which a still vehicle may stand on the pad. From there LAND is safe if it does not.
const MAX_STANDING_M: f64 = 0.3;
const MAX_STANDING_ASIDE_M: f64 = 0.3;
const MAX_STANDING_DEVIATION_M: f64 = 0.2;
/// How much more height per second since the newest detection: the autopilot's height drifts, in m/s.
const STANDING_DRIFT_M_S: f64 = 0.02;

/// Heights that a vehicle may have and that are above the error of the measurement, in metres.
const PLAUSIBLE_M: RangeInclusive<f64> = 0.15..=1.0;
/// Maximum age of the newest detection, in seconds: low over the marker the camera no longer sees it.
const MAX_AGE_S: f64 = 8.0;
/// Maximum standard deviation of the target's horizontal position, in metres.
const MAX_DEVIATION_M: f64 = 0.1;
/// Maximum distance from the target, in metres: beside the pad the ground may have another height.
const MAX_LATERAL_M: f64 = 0.3;

/// The height with which a landing ends.
#[derive(Copy, Clone, Debug, Default)]
pub(crate) struct StandingHeight {
    /// The smallest one, as the autopilot may say too early that it stands.
    lowest_m: Option<f64>,
}

impl StandingHeight {
    /// The autopilot says that the vehicle stands on the ground, and LAND was asked for; with this estimate of the pad.
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

/// True when the vehicle is still and the pad is known to be right below it: it may have touched down while nothing arrived
/// from it.
pub(crate) fn may_stand(situation: &Situation<'_>, config: &Config) -> bool {
    let (vehicle, Some(target)) = (situation.vehicle, situation.target) else { return false };
    let standing_height_m = match &config.guidance {
        GuidanceConfig::Metric(metric) => metric.standing_height_m,
        GuidanceConfig::Thesis(_) => 0.0,
    };
    let is_recent = situation.now.seconds_since(vehicle.stamp) <= config.phases.stale_vehicle_s;
    let max_m_s = MAX_STANDING_M_S + situation.pad_heave_m_s;
    let is_still = (vehicle.velocity - target.velocity).norm() <= max_m_s;
    let max_m = MAX_STANDING_M + STANDING_DRIFT_M_S * target.age_s;
    let is_low = target.height_m - standing_height_m <= max_m;
    let is_over_pad = !target.ambiguous
        && target.lateral_error_m <= MAX_STANDING_ASIDE_M
        && target.deviation_m <= MAX_STANDING_DEVIATION_M;
    is_recent && is_still && is_low && is_over_pad
}
