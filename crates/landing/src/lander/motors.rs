//! Decides whether a vehicle whose motors have stopped was in the air, also while its state is old.

use std::ops::RangeInclusive;

use super::{Lander, MAX_CONTACT_M, MAX_CONTACT_M_S};
use crate::event::{Landed, VehicleState};
use crate::guidance::observer::GRAVITY_M_S2;
use crate::standing::{MAX_STANDING_M_S, standing_height_m};
use crate::time::Timestamp;

/// Maximum speed of an autopilot's LAND, in m/s: ArduPilot's LAND_SPEED_HIGH is at most 5 m/s, PX4's MPC_Z_V_AUTO_DN 4 m/s.
const MAX_LAND_M_S: f64 = 5.0;

/// Longest wait for a recent state after the motors have stopped, in seconds.
const MAX_STATE_WAIT_S: f64 = 2.0;

/// Time before the newest state in which the vehicle fell, in seconds: only the heartbeat reports that the motors are off. It is
/// sent once a second, and one may be lost. A fall from 3 m lasts 0.8 s: then the vehicle is still on the ground when it is received.
const MAX_REPORT_S: f64 = 2.3;

/// The same for a vehicle that was faster than any landing, or fell freely, in seconds. Its autopilot may disarm late: PX4 5 s after its kill switch
/// (COM_KILL_DISARM), ArduPilot 2 s after its crash check has found it at rest.
const MAX_LATE_REPORT_S: f64 = 10.0;

/// Interval between two states, in seconds, within which the positions show a fall that no velocity shows.
const FALL_GAP_S: RangeInclusive<f64> = 0.3..=1.5;

/// Maximum error of the positions at the ends of a fall, in metres. A larger difference is a jump of the autopilot's position.
const MAX_POSITION_ERROR_M: f64 = 0.3;

/// Minimum speed down of a vehicle that falls, in m/s, and as a multiple of the autopilot's speed of landing. A vehicle touches down at
/// 0.8 m/s at most, and stands still for a second before its autopilot stops the motors. In a fall from 0.2 m it reaches 2 m/s.
const MIN_FALL_M_S: f64 = 1.5;
const MIN_FALL_FACTOR: f64 = 1.5;

/// Time in which a vehicle that falls freely shows it, in seconds, and the smallest parts of gravity, and of the way that its velocities make, that
/// count. It is the fall from 0.45 m. No wind and no landing accelerates a vehicle down as fast for as long; an estimate's velocity
/// that jumps shows in no position.
const FREE_FALL_S: f64 = 0.3;
const MIN_FREE_FALL: f64 = 0.75;
const MIN_FALLEN: f64 = 0.6;

/// When the vehicle fell last. The states of that time may be forgotten when its motors are reported as off.
#[derive(Copy, Clone, Debug, Default)]
pub(super) struct LastFall {
    /// When it sank faster than a vehicle that touches down.
    sank_at: Option<Timestamp>,
    /// When it sank faster than any LAND, or fell freely.
    fast_at: Option<Timestamp>,
}

impl LastFall {
    /// A landing begins: a pilot's dive before it is no fall.
    pub(super) fn begin(&mut self) {
        self.fast_at = None;
    }
}

/// The speed down after an interval without states, in m/s, of a vehicle that accelerated evenly in it; `None` where the interval is
/// too short or too long, and where not even a fall explains the positions.
fn fallen_m_s(before: &VehicleState, state: &VehicleState) -> Option<f64> {
    let gap_s = state.stamp.seconds_since(before.stamp);
    let before_m_s = before.velocity.z();
    let sunk_m = state.position.z() - before.position.z();
    let max_m = before_m_s * gap_s + 0.5 * GRAVITY_M_S2 * gap_s * gap_s + MAX_POSITION_ERROR_M;
    (FALL_GAP_S.contains(&gap_s) && sunk_m <= max_m).then(|| 2.0 * sunk_m / gap_s - before_m_s)
}

impl Lander {
    /// Notes whether the vehicle falls, by its newest state and the one before.
    pub(super) fn watch_fall(&mut self, before: Option<&VehicleState>, state: &VehicleState) {
        let down_m_s = state.velocity.z();
        let heave_m_s = self.config.estimator.pad_heave_m_s;
        let landing_m_s = MIN_FALL_FACTOR * self.limits.land_m_s;
        if down_m_s > libm::fmax(MIN_FALL_M_S, landing_m_s) + heave_m_s {
            self.last_fall.sank_at = Some(state.stamp);
        }
        let fallen_m_s = before.and_then(|before| fallen_m_s(before, state)).unwrap_or(down_m_s);
        let is_fast = libm::fmax(down_m_s, fallen_m_s) > MAX_LAND_M_S + heave_m_s;
        if is_fast || self.falls_freely(state) {
            self.last_fall.fast_at = Some(state.stamp);
        }
    }

    /// Whether the vehicle has fallen freely up to its newest state.
    fn falls_freely(&self, state: &VehicleState) -> bool {
        let earlier = self.history.at(state.stamp.plus_seconds(-FREE_FALL_S));
        let (Some(earlier), Some(position)) = (earlier, self.position()) else { return false };
        let [before_m_s, down_m_s] = [earlier.velocity.z(), state.velocity.z()];
        let sunk_m = position.z() - earlier.odometry.z();
        down_m_s > MIN_FALL_M_S
            && down_m_s - before_m_s >= MIN_FREE_FALL * GRAVITY_M_S2 * FREE_FALL_S
            && sunk_m >= MIN_FALLEN * 0.5 * (before_m_s + down_m_s) * FREE_FALL_S
    }

    /// Whether the vehicle is certainly in the air, although its motors are off: it falls, or, where its autopilot does not report the ground,
    /// sinks or is high over a target that was seen lately. A vehicle stands still for a second before its autopilot stops the motors.
    /// One that fell within the last seconds was in the air, although it is still now: the report of the motors is late.
    /// From its last state, if that is old, it may have come down as fast as LAND does; if it was higher, it was in the air, also where the
    /// ground is reported, as autopilots report it of each vehicle whose motors are off.
    pub(super) fn flies(&self, now: Timestamp) -> bool {
        let (Some(vehicle), Some(status)) = (self.history.newest(), self.status) else {
            return false;
        };
        let age_s = now.seconds_since(vehicle.stamp);
        let is_recent = age_s <= self.config.phases.stale_vehicle_s;
        let down_m_s = vehicle.velocity.z() - self.config.estimator.pad_heave_m_s;
        let standing_m = standing_height_m(&self.config);
        let max_sunk_m = if is_recent { 0.0 } else { MAX_LAND_M_S * age_s };
        let is_high = self
            .recent_target(now)
            .is_some_and(|target| target.height_m - standing_m - max_sunk_m > MAX_CONTACT_M);
        let sinks = down_m_s > MAX_STANDING_M_S;
        let falls = down_m_s > MAX_CONTACT_M_S;
        if is_recent {
            falls
                || self.fell(vehicle.stamp)
                || status.landed != Landed::OnGround && (sinks || is_high)
        } else {
            is_high
        }
    }

    /// Whether the vehicle has fallen since the last heartbeat could be sent that its motors run.
    fn fell(&self, newest: Timestamp) -> bool {
        let within = |at: Option<Timestamp>, max_s: f64| {
            at.is_some_and(|at| newest.seconds_since(at) <= max_s)
        };
        within(self.last_fall.sank_at, MAX_REPORT_S)
            || within(self.last_fall.fast_at, MAX_LATE_REPORT_S)
    }

    /// The same now.
    pub fn is_flying(&self) -> bool {
        self.now.is_some_and(|now| self.flies(now))
    }

    /// Whether the motors have just stopped, and the vehicle's state is too old to show whether that was in the air.
    pub(super) fn awaits_state(&self, now: Timestamp) -> bool {
        let is_old = self.history.newest().is_none_or(|vehicle| {
            now.seconds_since(vehicle.stamp) > self.config.phases.stale_vehicle_s
        });
        let waits = |since| now.seconds_since(since) < MAX_STATE_WAIT_S;
        is_old && self.disarmed.is_some_and(waits)
    }

    /// The same now: a state that follows within seconds decides whether the vehicle has landed.
    pub fn is_awaiting_state(&self) -> bool {
        self.now.is_some_and(|now| self.awaits_state(now))
    }
}
