//! Clamps each velocity setpoint: finite, within speed limits, no descent unless it is allowed, and not out
//! of the fence, to the side or upwards.

use geometry::{Ned, Point, Vector};
use libm::{fmax, hypot};

use crate::config::{EnvelopeConfig, PhaseConfig};

/// Time ahead for which the position is predicted against the fence, in seconds.
const FENCE_LEAD_S: f64 = 1.0;

/// The nearest setpoint that may be sent: finite, within the limits, and downwards only when `may_descend`. A
/// setpoint that is not finite becomes a stop.
pub fn clamp_setpoint(
    config: &EnvelopeConfig,
    desired: Vector<Ned>,
    may_descend: bool,
) -> Vector<Ned> {
    if !desired.is_finite() {
        return Vector::zero();
    }
    let speed = desired.horizontal_norm();
    let scale = if speed > config.horizontal_m_s { config.horizontal_m_s / speed } else { 1.0 };
    let max_down = if may_descend { config.descend_m_s } else { 0.0 };
    let clamped = Vector::new(
        desired.x() * scale,
        desired.y() * scale,
        desired.z().clamp(-config.climb_m_s, max_down),
    );
    // Finite components can have an infinite length.
    if clamped.is_finite() { clamped } else { Vector::zero() }
}

/// The velocity without its components that lead out of the fence; the way back stays open.
pub fn clamp_to_fence(
    phases: &PhaseConfig,
    position: Point<Ned>,
    desired: Vector<Ned>,
) -> Vector<Ned> {
    let ahead = position + desired * FENCE_LEAD_S;
    let far = |p: Point<Ned>| hypot(p.x(), p.y());
    let radius_m = phases.fence_radius_m;
    let leaves = radius_m > 0.0 && far(ahead) > radius_m && far(ahead) > far(position);
    let (x, y) = if leaves { (0.0, 0.0) } else { (desired.x(), desired.y()) };
    below_fence(phases, position, Vector::new(x, y, desired.z()))
}

/// The velocity without a climb that leads over the fence.
pub fn below_fence(
    phases: &PhaseConfig,
    position: Point<Ned>,
    desired: Vector<Ned>,
) -> Vector<Ned> {
    let ahead = position + desired * FENCE_LEAD_S;
    let is_high = phases.fence_height_m > 0.0 && -ahead.z() > phases.fence_height_m;
    let z = if is_high { fmax(desired.z(), 0.0) } else { desired.z() };
    Vector::new(desired.x(), desired.y(), z)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn nothing_leaves_the_envelope(
            x in prop::num::f64::ANY, y in prop::num::f64::ANY, z in prop::num::f64::ANY, may_descend: bool,
        ) {
            let config = EnvelopeConfig::default();
            let sent = clamp_setpoint(&config, Vector::new(x, y, z), may_descend);
            prop_assert!(sent.is_finite());
            prop_assert!(sent.horizontal_norm() <= config.horizontal_m_s + 1e-9);
            prop_assert!(sent.z() >= -config.climb_m_s && sent.z() <= config.descend_m_s);
            prop_assert!(may_descend || sent.z() <= 0.0);
        }
    }

    #[test]
    fn a_setpoint_inside_is_not_changed() {
        let desired = Vector::new(0.3, -0.4, 0.5);
        assert_eq!(clamp_setpoint(&EnvelopeConfig::default(), desired, true), desired);
        assert_eq!(clamp_setpoint(&EnvelopeConfig::default(), desired, false).z(), 0.0);
    }
}
