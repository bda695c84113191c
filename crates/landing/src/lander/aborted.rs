//! What a lander does after an abort: it hovers, lands or climbs, and then leaves the vehicle to its autopilot.

use super::Lander;
use crate::config::OnAbort;
use crate::decision::{Action, Reason};
use crate::event::{Landed, Mode};
use crate::standing::MAX_STANDING_M_S;
use crate::time::Timestamp;

/// Time an aborted landing climbs and holds before it stops sending setpoints, in seconds.
const CLIMB_AWAY_S: f64 = 60.0;

/// Height up to which a vehicle that is still may stand, in metres: it carries its sensors above the ground, and heights err by
/// decimetres.
const MIN_FLYING_M: f64 = 0.5;

/// Height that may be missing from the one at which an aborted landing hovers, in metres.
const HOVER_TOLERANCE_M: f64 = 0.1;

impl Lander {
    pub(super) fn aborted(&mut self, now: Timestamp) -> Action {
        let phases = self.config.phases;
        if self.state_machine.is_recalling() {
            return self.recall(now);
        }
        let follows = self
            .history
            .newest()
            .is_some_and(|state| now.seconds_since(state.stamp) <= phases.stale_vehicle_s)
            && self.status.is_some_and(|status| status.armed && status.mode == Mode::Guided);
        if self.state_machine.is_released() || !follows {
            return Action::None;
        }
        let elapsed_s = self.state_machine.elapsed_s(now);
        match phases.on_abort {
            OnAbort::Hover => self.hover_aborted(now),
            OnAbort::Land if elapsed_s <= phases.land_timeout_s => self.request_land(now),
            OnAbort::Climb if elapsed_s <= CLIMB_AWAY_S => self.climb_away(now),
            OnAbort::Land | OnAbort::Climb => Action::None,
        }
    }

    /// Requests the mode that follows setpoints, at once and at intervals.
    fn recall(&mut self, now: Timestamp) -> Action {
        if !self.is_ours() || !self.is_land_request_due(now) {
            return Action::None;
        }
        self.land_requested = Some(now);
        Action::Guided
    }

    /// Hovers for `release_after_s`, at `abort_hover_m` or higher: where the autopilot's velocity errs, a vehicle that hovers low
    /// drifts onto the ground.
    fn hover_aborted(&mut self, now: Timestamp) -> Action {
        let climb_m_s = self.climb_after_abort(now).filter(|_| self.hovers_since.is_none());
        if let Some(climb_m_s) = climb_m_s
            && self.state_machine.elapsed_s(now) <= CLIMB_AWAY_S
        {
            return self.climb(climb_m_s);
        }
        let since = *self.hovers_since.get_or_insert(now);
        let is_over = now.seconds_since(since) > self.config.phases.release_after_s;
        if is_over { Action::None } else { Action::hover() }
    }

    /// The speed at which an aborted landing climbs to `abort_hover_m`; `None` once it is there, and where the vehicle may stand: one
    /// that is still, and lower than the heights err or where LAND was refused, is not lifted again.
    fn climb_after_abort(&self, now: Timestamp) -> Option<f64> {
        let vehicle = self.history.newest()?;
        let height_m = self.known_height_m(now)?;
        let is_still = vehicle.velocity.norm() <= MAX_STANDING_M_S;
        let is_refused = self.state_machine.reason() == Reason::LandRefused;
        let may_stand = is_still && (height_m < MIN_FLYING_M || is_refused) || self.may_stand(now);
        if may_stand || self.landed(now) == Landed::OnGround {
            return None;
        }
        let wanted_m = self.altitude_m(now, self.config.phases.abort_hover_m);
        let to_m = libm::fmin(wanted_m, self.altitude_of(self.start));
        let missing_m = to_m + vehicle.position.z();
        (missing_m > HOVER_TOLERANCE_M).then(|| self.climb_speed(missing_m))
    }

    /// Climbs to `abort_height_m` and stays there.
    fn climb_away(&self, now: Timestamp) -> Action {
        let altitude_m = self.history.newest().map_or(f64::MAX, |state| -state.position.z());
        let to_m = self.altitude_m(now, self.config.phases.abort_height_m);
        self.climb((to_m - altitude_m).clamp(0.0, self.config.envelope.climb_m_s))
    }
}
