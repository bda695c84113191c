//! Makes the message with the landing point for the ground station's display (LANDING_TARGET in local NED).
//!
//! It never goes to the autopilot, which would use it for its own precision landing.

use autopilot::dialect::{LANDING_TARGET_DATA, LandingTargetType, MavBool, MavFrame, MavMessage};
use messages::TargetEstimate;

/// Makes landing targets at a bounded rate.
#[derive(Debug)]
pub(crate) struct LandingTargetPublisher {
    period_ns: i64,
    max_age_ms: f64,
    due_ns: i64,
}

impl LandingTargetPublisher {
    /// A publisher with this rate, for estimates up to this age.
    pub(crate) fn new(rate_hz: f64, max_age_ms: f64) -> Self {
        Self { period_ns: (1e9 / rate_hz) as i64, max_age_ms, due_ns: i64::MIN }
    }

    /// The message for an estimate, if one is due and the estimate is recent.
    pub(crate) fn message(&mut self, now_ns: i64, estimate: &TargetEstimate) -> Option<MavMessage> {
        let due = now_ns >= self.due_ns;
        let fresh = estimate.age_ms.is_some_and(|age_ms| age_ms <= self.max_age_ms);
        let position = estimate.position_ned_m.filter(|p| p.iter().all(|c| c.is_finite()));
        let message = position.filter(|_| due && fresh).map(|at| message(estimate, at))?;
        // Counted from when it was due, so that the rate is right whenever estimates come; missed messages
        // are not repeated.
        self.due_ns = self.due_ns.max(now_ns.saturating_sub(self.period_ns)) + self.period_ns;
        Some(message)
    }
}

fn message(estimate: &TargetEstimate, position_ned_m: [f64; 3]) -> MavMessage {
    let [x, y, z] = position_ned_m.map(|metres| metres as f32);
    let distance = match (estimate.lateral_error_m, estimate.height_m) {
        (Some(lateral_m), Some(height_m)) => lateral_m.hypot(height_m),
        _ => 0.0,
    };
    MavMessage::LANDING_TARGET(LANDING_TARGET_DATA {
        time_usec: u64::try_from(estimate.stamp_ns / 1000).unwrap_or(0),
        distance: if distance.is_finite() { distance as f32 } else { 0.0 },
        frame: MavFrame::MAV_FRAME_LOCAL_NED,
        x,
        y,
        z,
        q: [1.0, 0.0, 0.0, 0.0],
        mavtype: LandingTargetType::LANDING_TARGET_TYPE_VISION_FIDUCIAL,
        position_valid: MavBool::MAV_BOOL_TRUE,
        angle_x: 0.0,
        angle_y: 0.0,
        size_x: 0.0,
        size_y: 0.0,
        target_num: 0,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND_NS: i64 = 1_000_000_000;

    fn estimate() -> TargetEstimate {
        TargetEstimate {
            stamp_ns: 5_000_000,
            position_ned_m: Some([1.5, -1.5, 0.25]),
            lateral_error_m: Some(3.0),
            height_m: Some(4.0),
            age_ms: Some(40.0),
            ..TargetEstimate::sample()
        }
    }

    #[test]
    fn the_landing_point_is_sent_in_local_ned() {
        let shown = LandingTargetPublisher::new(5.0, 1000.0).message(0, &estimate());
        let Some(MavMessage::LANDING_TARGET(target)) = shown else { panic!("{shown:?}") };
        assert_eq!([target.x, target.y, target.z], [1.5, -1.5, 0.25]);
        assert_eq!(target.frame, MavFrame::MAV_FRAME_LOCAL_NED);
        assert_eq!(target.position_valid, MavBool::MAV_BOOL_TRUE);
        assert_eq!((target.time_usec, target.distance), (5000, 5.0));
    }

    #[test]
    fn the_rate_is_bounded() {
        let mut publisher = LandingTargetPublisher::new(5.0, 1000.0);
        // Two seconds of estimates, then two more after a pause, at a rate that is not a multiple of the
        // publisher's.
        for start_s in [0, 60] {
            let times = (0..34).map(|i| start_s * SECOND_NS + i * SECOND_NS / 17);
            let shown =
                times.filter(|now_ns| publisher.message(*now_ns, &estimate()).is_some()).count();
            assert!((10..=11).contains(&shown), "{shown}");
        }
    }

    #[test]
    fn unknown_or_old_estimates_are_not_sent() {
        let mut publisher = LandingTargetPublisher::new(5.0, 1000.0);
        for unknown in [
            TargetEstimate { position_ned_m: None, ..estimate() },
            TargetEstimate { position_ned_m: Some([0.0, f64::NAN, 0.0]), ..estimate() },
            TargetEstimate { age_ms: None, ..estimate() },
            TargetEstimate { age_ms: Some(f64::NAN), ..estimate() },
            TargetEstimate { age_ms: Some(1001.0), ..estimate() },
        ] {
            assert_eq!(publisher.message(0, &unknown), None);
        }
        let odd = TargetEstimate { height_m: Some(f64::INFINITY), stamp_ns: -1, ..estimate() };
        assert!(publisher.message(0, &odd).is_some());
    }
}
