//! Commands the vehicle while the marker is out of view or lost: the height to which a retry climbs, and the pad's position to remember
//! over a silence of the autopilot.

use geometry::Vector;

use super::Lander;
use crate::decision::{Action, Reason};
use crate::envelope;
use crate::event::FrameObservation;
use crate::standing::{RememberedPad, to_remember};
use crate::time::Timestamp;
use crate::view::View;

/// Minimum height over the pad, in metres, and maximum standard deviation of its position, in metres, at which time without the marker
/// in the camera's view is waiting time: below it a disturbance must be seen at once, and above that deviation the marker must be seen
/// again.
const MIN_WAIT_HEIGHT_M: f64 = 1.5;
const MAX_WAIT_DEVIATION_M: f64 = 0.2;

/// Shortest time without a state of the vehicle, in seconds, after which it may have touched down meanwhile.
const MIN_SILENCE_S: f64 = 0.6;

impl Lander {
    /// The pad's position before a silence that ends with a state of this time: the estimate after it is less certain.
    pub(super) fn pad_before_silence(&self, stamp: Timestamp) -> Option<RememberedPad> {
        let last = self.history.newest()?.stamp;
        let is_silence = stamp.seconds_since(last) > MIN_SILENCE_S;
        let is_active = is_silence && !self.phase().is_terminal() && !self.pad_moves();
        to_remember(last, &self.target(last).filter(|_| is_active)?)
    }

    /// True when the position of a pad that does not move is well known, and the camera of a vehicle that is not low over it did not
    /// show it: low down, one that waits to see it is moved by a gust meanwhile.
    pub(super) fn is_out_of_view(&self, frame: &FrameObservation) -> bool {
        let (Some(view), Some(motion), Some(target)) =
            (View::from_frame(frame), self.history.at(frame.stamp), self.target(frame.stamp))
        else {
            return false;
        };
        let position = self.history.ned_from_odometry().inverse() * target.position;
        let is_known = self.has_target(frame.stamp) && target.deviation_m <= MAX_WAIT_DEVIATION_M;
        let is_low = target.height_m <= MIN_WAIT_HEIGHT_M;
        is_known && !is_low && !self.pad_moves() && !view.shows(position, &motion)
    }

    /// Stays where the marker must be in view, and climbs, never above the height where the landing started. After markers that
    /// were too far from the estimate of a pad that stands it climbs where it is: the estimate may be wrong, and a vehicle that follows
    /// it leaves the marker behind.
    pub(super) fn retry(&mut self, now: Timestamp) -> Action {
        let Some(vehicle) = self.history.newest().copied() else { return Action::hover() };
        let phases = self.config.phases;
        let altitude_m = -vehicle.position.z();
        let ceiling_m = self.altitude_of(self.start);
        let climbed_m = libm::fmin(altitude_m + phases.retry_climb_m, ceiling_m);
        if self.retry_to_m.is_none() {
            self.guidance.begin_retry();
        }
        let to_m = *self.retry_to_m.get_or_insert(climbed_m);
        let situation = self.situation(now, &vehicle);
        let (desired, _) = self.guidance.velocity(&situation);
        let climb_m_s = self.climb_speed(to_m - altitude_m);
        let aside = match self.state_machine.reason() {
            Reason::RetryingRefused if !self.pad_moves() => Vector::zero(),
            _ => desired,
        };
        let desired = Vector::new(aside.x(), aside.y(), -climb_m_s);
        let desired = envelope::below_fence(&phases, vehicle.position, desired);
        let velocity = envelope::clamp_setpoint(&self.config.envelope, desired, false);
        self.guidance.on_setpoint_sent(velocity);
        Action::Velocity { velocity, yaw_rate: 0.0 }
    }
}
