//! The lander's actions, sent to the autopilot as they are: what guidance believes is what was sent.

use std::time::Duration;

use autopilot::command::SetpointError;
use autopilot::{Autopilot, Command, CommandId, CommandStatus, Firmware, FlightMode};
use geometry::{Ned, Vector};
use landing::Action;
use messages::Setpoint;

use crate::control::MAX_RELEASE_NS;

/// Sends setpoints at their rate, mode changes and disarming.
#[derive(Debug)]
pub struct Setpoints {
    period_ns: i64,
    /// Age up to which a position is of now.
    stale_ns: i64,
    last: Option<Setpoint>,
    sent_ns: i64,
    /// The change to the mode that follows setpoints, or the disarming, that was requested last.
    request: Option<CommandId>,
    /// When LAND was requested last.
    land_ns: Option<i64>,
    /// When a PX4 was asked to hold its place: until it does, zero setpoints go on, as the request may be lost.
    hold_ns: Option<i64>,
}

/// Time after a request in which LAND may not show yet, in nanoseconds.
const LAND_SHOWS_NS: i64 = 3_000_000_000;

impl Setpoints {
    /// Nothing was sent yet. `stale_after` is the age from which the vehicle's state is not of now.
    pub fn new(rate_hz: f64, stale_after: Duration) -> Self {
        Self {
            period_ns: (1e9 / rate_hz) as i64,
            stale_ns: i64::try_from(stale_after.as_nanos()).unwrap_or(i64::MAX),
            last: None,
            sent_ns: i64::MIN,
            request: None,
            land_ns: None,
            hold_ns: None,
        }
    }

    /// The last setpoint; `None` while none is sent.
    pub fn last(&self) -> Option<Setpoint> {
        self.last
    }

    /// When the last setpoint was sent.
    pub fn sent_ns(&self) -> i64 {
        self.sent_ns
    }

    /// Carries out an action; the result is that of a setpoint, if one was due. One that `is_urgent` is sent
    /// before its time.
    pub fn carry_out(
        &mut self,
        now_ns: i64,
        action: Action,
        is_urgent: bool,
        autopilot: &mut Autopilot,
    ) -> Option<Result<(), SetpointError>> {
        match action {
            Action::None if self.last.is_some() && self.needs_hold(now_ns, autopilot) => {
                return self.hold_when_known(now_ns, autopilot);
            }
            Action::None => {
                self.last = None;
                self.is_awaiting_hold(now_ns, autopilot);
            }
            Action::Guided | Action::Disarm | Action::Land if !is_ours(autopilot) => {
                self.last = None;
                autopilot.withdraw();
            }
            Action::Guided => {
                self.last = None;
                if let Some(mode) = autopilot.firmware().and_then(Firmware::guided) {
                    self.request(now_ns, Command::SetMode(mode), autopilot);
                }
            }
            Action::Disarm => self.request(now_ns, Command::Disarm, autopilot),
            Action::Land => {
                self.land_ns = Some(now_ns);
                let mode = autopilot.firmware().and_then(Firmware::land);
                autopilot.request(now_ns, Command::SetMode(mode.unwrap_or(FlightMode::Land)));
                // Sent at once: at half a metre every tick counts.
                autopilot.tick(now_ns);
            }
            Action::Velocity { velocity, yaw_rate } => {
                let is_due = now_ns.saturating_sub(self.sent_ns) >= self.period_ns;
                return (is_urgent || is_due)
                    .then(|| self.send(now_ns, velocity, yaw_rate, autopilot));
            }
        }
        None
    }

    /// Stops the vehicle, if setpoints are being sent: without one it would stop only after its setpoint timeout.
    pub fn stop(
        &mut self,
        now_ns: i64,
        autopilot: &mut Autopilot,
    ) -> Option<Result<(), SetpointError>> {
        self.last.map(|_| self.send(now_ns, Vector::zero(), 0.0, autopilot))
    }

    /// Ends the setpoints, after the last one has stopped the vehicle; true while it waits for the heartbeat after which a PX4 is
    /// asked to hold its place.
    pub fn end(&mut self, now_ns: i64, autopilot: &mut Autopilot) -> bool {
        if self.last.is_none() || !self.needs_hold(now_ns, autopilot) {
            self.last = None;
            return self.is_awaiting_hold(now_ns, autopilot);
        }
        self.hold_when_known(now_ns, autopilot);
        self.last.is_some() || self.is_awaiting_hold(now_ns, autopilot)
    }

    /// True while a PX4 that was asked to hold its place has not shown it: zero setpoints keep it where it is.
    fn is_awaiting_hold(&mut self, now_ns: i64, autopilot: &mut Autopilot) -> bool {
        let is_recent = |asked_ns: &i64| {
            now_ns.saturating_sub(*asked_ns) <= MAX_RELEASE_NS && is_offboard(autopilot)
        };
        self.hold_ns = self.hold_ns.filter(is_recent);
        if self.hold_ns.is_some() {
            autopilot.send_zeros(now_ns);
        }
        self.hold_ns.is_some()
    }

    /// Asks for HOLD once a heartbeat has just told that the mode is ours; until then it may be the pilot's already, and zero
    /// setpoints go on.
    fn hold_when_known(
        &mut self,
        now_ns: i64,
        autopilot: &mut Autopilot,
    ) -> Option<Result<(), SetpointError>> {
        if autopilot.shows_mode_of_now(now_ns) {
            self.last = None;
            self.hold_ns = Some(now_ns);
            self.request(now_ns, Command::SetMode(FlightMode::AUTO_HOLD), autopilot);
            return None;
        }
        let is_due = now_ns.saturating_sub(self.sent_ns) >= self.period_ns;
        is_due.then(|| self.send(now_ns, Vector::zero(), 0.0, autopilot))
    }

    /// Whether silence would be a failure: a PX4 in OFFBOARD takes it for that of its companion, and without a remote control it
    /// then descends and drifts with the wind (`COM_OBL_RC_ACT`). ArduPilot stops.
    fn needs_hold(&self, now_ns: i64, autopilot: &Autopilot) -> bool {
        let lands =
            self.land_ns.is_some_and(|land_ns| now_ns.saturating_sub(land_ns) < LAND_SHOWS_NS);
        let is_followed = autopilot.state().is_some_and(|state| {
            let is_fresh = state
                .position
                .is_some_and(|it| now_ns.saturating_sub(it.stamp_ns) <= self.stale_ns);
            state.connected && state.armed && state.mode.is_guided() && is_fresh
        });
        is_followed && !lands && autopilot.firmware() == Some(Firmware::Px4)
    }

    /// Stops a vehicle of which only the system id is known.
    pub fn stop_unknown(&mut self, now_ns: i64, system: u8, autopilot: &mut Autopilot) {
        if now_ns.saturating_sub(self.sent_ns) >= self.period_ns {
            self.sent_ns = now_ns;
            autopilot.send_stop(now_ns, system);
        }
    }

    fn send(
        &mut self,
        now_ns: i64,
        velocity: Vector<Ned>,
        yaw_rate: f64,
        autopilot: &mut Autopilot,
    ) -> Result<(), SetpointError> {
        let result = autopilot.set_velocity(now_ns, velocity, yaw_rate);
        self.last = result.is_ok().then(|| Setpoint {
            velocity_ned_m_s: velocity.coords.into(),
            yaw_rate_rad_s: yaw_rate,
        });
        if result.is_ok() {
            self.sent_ns = now_ns;
        }
        result
    }

    /// Sends a command, unless one is pending.
    fn request(&mut self, now_ns: i64, command: Command, autopilot: &mut Autopilot) {
        if !self.request.is_some_and(|id| autopilot.status(id) == CommandStatus::Pending) {
            self.request = Some(autopilot.request(now_ns, command));
            autopilot.tick(now_ns);
        }
    }
}

fn is_offboard(autopilot: &Autopilot) -> bool {
    autopilot.state().is_some_and(|state| state.armed && state.mode == FlightMode::OFFBOARD)
}

/// True while the autopilot's own mode is known and is ours: another one is the pilot's, and nothing is asked of it.
fn is_ours(autopilot: &Autopilot) -> bool {
    autopilot
        .state()
        .is_some_and(|state| state.connected && (state.mode.is_guided() || state.mode.is_landing()))
}
