//! The height of the body's origin over the pad when the vehicle stands on it, measured at the end of a landing.
//!
//! The autopilot's position is that of its inertial sensors, which a real vehicle carries 10 to 30 cm above the ground. The
//! estimate of the target is relative to the same point, so that its height on the ground is `standing_height_m`. The camera
//! no longer sees the marker then, and the autopilot's height drifts near the ground: the error is up to a decimetre.

use std::ops::RangeInclusive;

use libm::fmax;

use crate::config::GuidanceConfig;
use crate::decision::{Phase, TargetEstimate};

/// Heights that a vehicle may have and that are above the error of the measurement, in metres.
const PLAUSIBLE_M: RangeInclusive<f64> = 0.15..=1.0;
/// Maximum age of the newest detection, in seconds: low over the marker the camera no longer sees it.
const MAX_AGE_S: f64 = 8.0;
/// Maximum standard deviation of the target's horizontal position, in metres.
const MAX_DEVIATION_M: f64 = 0.1;

/// The height with which the last landing ended.
#[derive(Copy, Clone, Debug, Default)]
pub(crate) struct StandingHeight {
    measured_m: Option<f64>,
    /// This landing has been looked at: what is seen while the vehicle goes on standing is older and less certain.
    is_over: bool,
}

impl StandingHeight {
    /// A landing begins.
    pub(crate) fn begin(&mut self) {
        self.is_over = false;
    }

    /// The vehicle stands, in this phase and with this estimate of the pad.
    pub(crate) fn observe(&mut self, phase: Phase, target: Option<TargetEstimate>) {
        if self.is_over || !matches!(phase, Phase::Final | Phase::Landed) {
            return;
        }
        self.is_over = true;
        let is_sound = |target: &TargetEstimate| {
            target.age_s <= MAX_AGE_S && target.deviation_m <= MAX_DEVIATION_M
        };
        if let Some(target) = target.filter(is_sound) {
            let height_m = target.height_m;
            self.measured_m = PLAUSIBLE_M.contains(&height_m).then_some(height_m);
        }
    }

    /// The guidance's settings, with the measured height where it is above the configured one: a vehicle that is believed to
    /// stand higher is slow and asks for LAND earlier.
    pub(crate) fn applied_to(&self, mut config: GuidanceConfig) -> GuidanceConfig {
        if let (GuidanceConfig::Metric(metric), Some(measured_m)) = (&mut config, self.measured_m) {
            metric.standing_height_m = fmax(metric.standing_height_m, measured_m);
        }
        config
    }

    /// The height in metres, once it was measured and is not small.
    pub(crate) fn measured_m(&self) -> Option<f64> {
        self.measured_m
    }
}
