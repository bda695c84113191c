//! The landing targets that a flight sends to the autopilot's own precision landing: of each frame that was used, and for some seconds of
//! the estimate.

use landing::FrameObservation;

use super::Flight;
use crate::landing_target::LandingTargetMode;

impl Flight {
    /// Continues the autopilot's landing on the estimate where our own guidance would continue without the marker.
    pub(super) fn send_predicted_target(&mut self, now_ns: i64) {
        let metric = &self.config.metric;
        let max_age_s = metric.stale_target_s + metric.blind_s;
        let target = self.decision.and_then(|decision| decision.target).filter(|target| {
            !target.ambiguous
                && target.height_m <= metric.blind_height_m
                && target.deviation_m <= metric.blind_deviation_m
                && target.age_s <= max_age_s
        });
        let is_trusted = self.view().distrust().is_none();
        let may_send = self.landing_target.is_some() && is_trusted && self.is_state_fresh(now_ns);
        if let Some(target) = target.filter(|_| may_send)
            && let Some(landing_target) = &mut self.landing_target
            && landing_target.send_predicted(now_ns, &target, &mut self.autopilot)
        {
            self.journal.count("predicted landing targets");
        }
    }

    /// Low in the autopilot's landing a target that our own guidance would not trust is sent all the same: it continues to the ground.
    fn may_send_target(&self) -> bool {
        let lands = self.landing_target.as_ref().is_some_and(LandingTargetMode::is_landing);
        self.view().distrust().is_none() || lands && !self.lander.may_recall()
    }

    pub(super) fn send_landing_target(&mut self, now_ns: i64, frame: &FrameObservation) {
        let target = self.decision.and_then(|decision| decision.target);
        let may_send = self.may_send_target();
        if let Some(landing_target) = &mut self.landing_target
            && may_send
            && landing_target.send(now_ns, frame, target, &mut self.autopilot)
        {
            self.journal.count("landing targets");
            self.journal.used_frame(now_ns, frame.stamp.nanos());
        }
    }
}
