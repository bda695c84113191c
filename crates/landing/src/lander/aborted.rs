//! Commands the vehicle after an abort: it hovers, lands or climbs, and is then left to its autopilot.

use geometry::Vector;

use super::{Lander, MAX_HOVER_M_S};
use crate::config::OnAbort;
use crate::decision::{Action, Reason};
use crate::event::{Landed, Mode};
use crate::standing::{MAX_STANDING_M, MAX_STANDING_M_S, standing_height_m};
use crate::time::Timestamp;

/// Time an aborted landing climbs and holds before it stops sending setpoints, in seconds.
const CLIMB_AWAY_S: f64 = 60.0;

/// Height up to which a vehicle that is still may stand, in metres: it carries its sensors up to 0.3 m above the ground, and heights err
/// by decimetres. Where the standing height is configured only the error is left.
pub(super) const MIN_FLYING_M: f64 = 0.5;

/// Height that may be missing from the one at which an aborted landing hovers, in metres.
const HOVER_TOLERANCE_M: f64 = 0.1;

/// How an aborted landing changes its height.
#[derive(Copy, Clone, Debug, Default, PartialEq)]
pub(super) enum AbortClimb {
    /// It has just been aborted, and may still sink.
    #[default]
    Undecided,
    /// It climbs.
    Climbs,
    /// It hovers.
    Hovers {
        /// Since then.
        since: Timestamp,
        /// It may stand, and climbs once it moves.
        may_climb: bool,
    },
    /// No more setpoints are sent.
    Released,
}

impl Lander {
    /// True while the vehicle is so high that it can be called back from LAND, and not left hovering low over the ground, or neither pad
    /// nor ground is known.
    pub fn may_recall(&self) -> bool {
        let Some(now) = self.now else { return true };
        let Some(vehicle) = self.vehicle_inputs(now) else { return true };
        let is_known = self.known_height_m(now).is_some() || vehicle.landed == Landed::OnGround;
        !is_known || self.state_machine.is_high(vehicle)
    }

    /// True while an aborted vehicle is not lifted because it may stand on the ground, and its motors run.
    pub fn is_left_low(&self) -> bool {
        self.is_left_low
    }

    pub(super) fn aborted(&mut self, now: Timestamp) -> Action {
        let action = self.abort_action(now);
        // In another mode nothing keeps it low but the pilot.
        let mode = self.status.filter(|status| status.armed).map(|status| status.mode);
        let is_kept_low = mode == Some(Mode::Guided)
            && matches!(self.abort_climb, AbortClimb::Hovers { may_climb: true, .. });
        let is_left = mode.is_some_and(|mode| mode != Mode::Land);
        self.is_left_low =
            is_left && (self.is_left_low || is_kept_low) && self.may_stand_after_abort(now);
        action
    }

    fn abort_action(&mut self, now: Timestamp) -> Action {
        let phases = self.config.phases;
        if self.state_machine.is_recalling() {
            return self.recall(now);
        }
        let is_recent = self
            .history
            .newest()
            .is_some_and(|state| now.seconds_since(state.stamp) <= phases.stale_vehicle_s);
        let status = self.status.filter(|status| is_recent && status.mode != Mode::Unknown);
        let Some(status) = status else { return Action::None };
        // The time of a vehicle without a link counts from when its states are received again.
        self.received_since.get_or_insert(now);
        if self.state_machine.is_released() || !status.armed || status.mode != Mode::Guided {
            return Action::None;
        }
        let elapsed_s = self.received_s(now);
        match phases.on_abort {
            OnAbort::Hover => self.hover_aborted(now),
            OnAbort::Land if elapsed_s <= phases.land_timeout_s => self.request_land(now),
            OnAbort::Climb if elapsed_s <= CLIMB_AWAY_S => self.climb_away(now),
            OnAbort::Land | OnAbort::Climb => Action::None,
        }
    }

    /// For how long states of the aborted vehicle have been received, in seconds.
    fn received_s(&self, now: Timestamp) -> f64 {
        self.received_since.map_or(0.0, |since| now.seconds_since(since))
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
    /// drifts onto the ground. One that may stand is not lifted, until it moves. One that sinks hovers only once it has stopped: it loses
    /// height while it brakes.
    fn hover_aborted(&mut self, now: Timestamp) -> Action {
        let missing_m = self.missing_after_abort(now);
        let is_late = self.received_s(now) > CLIMB_AWAY_S;
        self.abort_climb = match self.abort_climb {
            AbortClimb::Hovers { since, .. }
                if now.seconds_since(since) > self.config.phases.release_after_s =>
            {
                AbortClimb::Released
            }
            AbortClimb::Undecided if self.may_stand_after_abort(now) => {
                AbortClimb::Hovers { since: now, may_climb: true }
            }
            AbortClimb::Hovers { may_climb: true, .. }
                if !self.may_stand_after_abort(now) && missing_m.is_some() =>
            {
                AbortClimb::Climbs
            }
            AbortClimb::Undecided | AbortClimb::Climbs if missing_m.is_some() && !is_late => {
                AbortClimb::Climbs
            }
            AbortClimb::Undecided if self.sinks_fast() && !is_late => AbortClimb::Undecided,
            AbortClimb::Undecided | AbortClimb::Climbs => {
                AbortClimb::Hovers { since: now, may_climb: false }
            }
            other => other,
        };
        match self.abort_climb {
            AbortClimb::Released => Action::None,
            AbortClimb::Climbs => self.climb(self.climb_speed(missing_m.unwrap_or(0.0))),
            AbortClimb::Undecided | AbortClimb::Hovers { .. } => Action::hover(),
        }
    }

    /// Whether the vehicle still goes down faster than one that hovers.
    fn sinks_fast(&self) -> bool {
        self.history.newest().is_some_and(|vehicle| vehicle.velocity.z() > MAX_HOVER_M_S)
    }

    /// Whether the vehicle may stand: it is still over the pad, and so low as heights err, or at a height that is not known, or LAND was
    /// refused.
    pub(super) fn may_stand_after_abort(&self, now: Timestamp) -> bool {
        let pad = self.recent_target(now).map_or(Vector::zero(), |target| target.velocity);
        let is_still = self
            .history
            .newest()
            .is_some_and(|vehicle| (vehicle.velocity - pad).norm() <= MAX_STANDING_M_S);
        let is_low = self.known_height_m(now).is_none_or(|height_m| height_m < self.min_flying_m());
        let is_refused = self.state_machine.reason() == Reason::LandRefused;
        is_still && (is_low || is_refused) || self.may_stand(now)
    }

    /// The height from which a vehicle flies although it is still. The autopilot's report that it flies is needed for the lower one, and
    /// is no proof: the ground is reported seconds late, and not while a hover is requested, as the land detectors of ArduPilot
    /// (`update_throttle_mix`) and PX4 (`MulticopterLandDetector`) need a requested descent. The thrust of a vehicle that stands may be
    /// close to that of a hover, and a climb would distinguish the two only by lifting it.
    fn min_flying_m(&self) -> f64 {
        let standing_m = standing_height_m(&self.config);
        let is_in_air = self.status.is_some_and(|status| status.landed == Landed::InAir);
        if is_in_air && standing_m > 0.0 {
            libm::fmin(standing_m + MAX_STANDING_M, MIN_FLYING_M)
        } else {
            MIN_FLYING_M
        }
    }

    /// The height that is missing from `abort_hover_m`, from the fence or from where the landing began, in metres; `None` if none is, and
    /// on the ground.
    fn missing_after_abort(&self, now: Timestamp) -> Option<f64> {
        let vehicle = self.history.newest()?;
        if self.landed(now) == Landed::OnGround {
            return None;
        }
        let phases = &self.config.phases;
        let fence_m = if phases.fence_height_m > 0.0 { phases.fence_height_m } else { f64::MAX };
        let wanted_m = self.altitude_m(now, phases.abort_hover_m);
        let to_m = libm::fmin(libm::fmin(wanted_m, self.altitude_of(self.start)), fence_m);
        let missing_m = to_m + vehicle.position.z();
        (missing_m > HOVER_TOLERANCE_M).then_some(missing_m)
    }

    /// Climbs to `abort_height_m` and stays there. One that may stand is not lifted, until it moves.
    fn climb_away(&mut self, now: Timestamp) -> Action {
        if self.abort_climb != AbortClimb::Climbs && self.may_stand_after_abort(now) {
            self.abort_climb = AbortClimb::Hovers { since: now, may_climb: true };
            return Action::hover();
        }
        self.abort_climb = AbortClimb::Climbs;
        let altitude_m = self.history.newest().map_or(f64::MAX, |state| -state.position.z());
        let to_m = self.altitude_m(now, self.config.phases.abort_height_m);
        self.climb((to_m - altitude_m).clamp(0.0, self.config.envelope.climb_m_s))
    }
}
