//! Keeps a vehicle at its position that is commanded no horizontal velocity: one that waits, holds, or climbs straight up. Leads one
//! back that has searched without a result.

use geometry::{Ned, Odometry, Point, Vector};

use super::Lander;
use super::aborted::MIN_FLYING_M;
use crate::config::GuidanceConfig;
use crate::decision::{Action, Phase, Reason};
use crate::envelope;
use crate::event::{Landed, Mode};
use crate::hover::Hover;
use crate::time::Timestamp;

/// Depth under the pad, or the ground that the vehicle took off from, in metres, at which it is not taken for standing on it.
const MAX_SUNK_M: f64 = 1.0;

impl Lander {
    /// The same action, but a vehicle that is to hover or to climb straight up is led back to where that began. A request of a mode
    /// does not end a hover. After a search without a result it is led back to where the search began: the marker was lost there, and the end
    /// of the search is any place. The thesis' guidance hovers as the thesis' program did.
    pub(super) fn keep_position(&mut self, now: Timestamp, action: Action) -> Action {
        let Action::Velocity { velocity, yaw_rate } = action else {
            if action == Action::None {
                self.hover = None;
            }
            return action;
        };
        let before = self.hover.take();
        let is_thesis = matches!(self.config.guidance, GuidanceConfig::Thesis(_));
        let is_steered = is_thesis
            || velocity.horizontal_norm() > 0.0
            || velocity.z() > 0.0
            || matches!(self.phase(), Phase::Approach | Phase::Descend);
        let (Some(vehicle), Some(position)) = (self.history.newest().copied(), self.position())
        else {
            return action;
        };
        let max_age_s = self.config.phases.stale_vehicle_s;
        let is_known = now.seconds_since(vehicle.stamp) <= max_age_s && !self.is_link_slow;
        if is_steered || !is_known || self.may_touch_ground(now) {
            return action;
        }
        let mut hover = match (self.begin_of_search(), before) {
            (Some(centre), before) => before
                .filter(|it| it.leads_back_to(centre))
                .unwrap_or(Hover::back_at(vehicle.stamp, centre)),
            (None, before) => before
                .and_then(|it| it.without_return(position))
                .unwrap_or(Hover::new(vehicle.stamp)),
        };
        let speed_m_s = vehicle.velocity.horizontal_norm();
        let back = hover.velocity(vehicle.stamp, position, speed_m_s, max_age_s);
        self.hover = Some(hover);
        let desired = Vector::new(back.x(), back.y(), velocity.z());
        let desired = envelope::clamp_to_fence(&self.config.phases, vehicle.position, desired);
        let velocity = envelope::clamp_setpoint(&self.config.envelope, desired, false);
        self.guidance.on_setpoint_sent(velocity);
        Action::Velocity { velocity, yaw_rate }
    }

    /// The horizontal velocity, in m/s, that leads a vehicle back to where it began to wait for a landing; zero where it may stand on the ground, or
    /// its state is old. To be called at least as often as its states come: after a pause it waits where it is then.
    pub fn back_to_wait(&mut self, now: Timestamp) -> Vector<Ned> {
        let (Some(vehicle), Some(position)) = (self.history.newest().copied(), self.position())
        else {
            return Vector::zero();
        };
        let max_age_s = self.config.phases.stale_vehicle_s;
        let is_known = now.seconds_since(vehicle.stamp) <= max_age_s && !self.is_link_slow;
        if !is_known || self.may_touch_ground(now) {
            self.wait = None;
            return Vector::zero();
        }
        let hover = self.wait.get_or_insert(Hover::new(vehicle.stamp));
        let speed_m_s = vehicle.velocity.horizontal_norm();
        let back = hover.velocity(vehicle.stamp, position, speed_m_s, max_age_s);
        let back = envelope::clamp_to_fence(&self.config.phases, vehicle.position, back);
        envelope::clamp_setpoint(&self.config.envelope, back, false)
    }

    /// Forgets where the vehicle waited for a landing.
    pub fn end_wait(&mut self) {
        self.wait = None;
    }

    /// Where the search began that has had no result, while the vehicle is held for that; without a detector, or in a mode that is not known
    /// to be ours, it stays where it is. The next search is about the same position.
    fn begin_of_search(&mut self) -> Option<Point<Odometry>> {
        let is_over =
            self.phase() == Phase::Hold && self.state_machine.reason() == Reason::TargetNotFound;
        let follows = self.status.is_some_and(|status| status.mode == Mode::Guided);
        let may_return = is_over && follows && self.detectors_alive;
        let square = self.square.as_mut().filter(|_| may_return)?;
        square.begin_again();
        Some(square.centre())
    }

    /// True where the vehicle may stand: a drift of the autopilot's position is then no motion of the vehicle, and a velocity to the
    /// side would tip it over.
    fn may_touch_ground(&self, now: Timestamp) -> bool {
        let is_low = self
            .known_height_m(now)
            .is_some_and(|height_m| (-MAX_SUNK_M..MIN_FLYING_M).contains(&height_m));
        is_low
            || self.landed(now) == Landed::OnGround
            || self.state_machine.reason() == Reason::MayStand
            || self.may_stand(now)
            || self.phase() == Phase::Aborted && self.may_stand_after_abort(now)
    }
}
