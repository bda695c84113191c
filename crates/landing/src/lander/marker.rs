//! Takes the marker in a frame: fuses its measurement into the target, or returns the reason for which it is rejected.

use super::Lander;
use crate::decision::{Phase, Rejection};
use crate::event::{FrameObservation, Landed, MarkerInFrame};
use crate::repeated_picture::Picture;

impl Lander {
    /// Fuses a marker; one without a pose is used only by a guidance that needs none.
    pub(super) fn marker(
        &mut self,
        frame: &FrameObservation,
        marker: &MarkerInFrame,
    ) -> Result<(), Rejection> {
        if marker.confidence < self.config.target.min_confidence {
            return Err(Rejection::LowConfidence);
        }
        let mut picture = Picture::Alike;
        if let Some(motion) = self.history.at(frame.stamp) {
            let config = &self.config.estimator;
            let stands = self.now.is_some_and(|now| self.landed(now) == Landed::OnGround);
            picture = self.repeated_picture.add(frame, marker, &motion, config, stands);
            // Nothing was seen: neither the marker, nor that it is elsewhere; nor was it in the earlier frames with this picture.
            if let Picture::Old(since) = picture {
                self.target_filter.go_back();
                self.sightings.forget_since(since);
                return Err(Rejection::RepeatedPicture);
            }
            // One that is carried by hand, as before the first flight, gives no information: its height is not that of a flight.
            if stands || !self.status.is_some_and(|status| status.armed) {
                self.size_check.interrupt();
            } else {
                self.size_check.observe(config, frame, marker, &motion);
            }
            if let Some(pose) = marker.body_from_marker {
                self.axis_check.add(frame.stamp, &motion, pose.origin());
            }
        }
        let result = self.fuse(frame, marker);
        if picture == Picture::Other {
            self.target_filter.keep();
        }
        result
    }

    fn fuse(&mut self, frame: &FrameObservation, marker: &MarkerInFrame) -> Result<(), Rejection> {
        // A hover shows no error of the mount: in a long one the wandering of the autopilot's estimate looks like it.
        if self.phase() != Phase::Hold {
            self.mount_check.observe(&self.config.estimator, frame, marker, &self.history);
        }
        self.first_seen.get_or_insert(frame.stamp);
        match self.target_filter.observe(frame, marker, &self.history) {
            Err(Rejection::NoPose) if !self.guidance.needs_pose() => {}
            Err(rejection) => {
                self.sightings.refuse(frame.stamp, rejection);
                return Err(rejection);
            }
            Ok(()) => {}
        }
        self.sightings.add(frame.stamp, self.config.phases.lost_target_s);
        if self.sightings.in_a_row >= self.config.target.confirm_after {
            self.resumed = None;
        }
        Ok(())
    }
}
