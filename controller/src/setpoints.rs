//! Sends the lander's actions to the autopilot: velocity setpoints at their rate, LAND and GUIDED, disarming; stops
//! the vehicle at the end, and leads a PX4 out of OFFBOARD. Setpoints are sent unchanged: the guidance assumes
//! so. Of several decisions to land at one time one is sent.

use std::time::Duration;

use autopilot::command::{CommandError, SetpointError};
use autopilot::{Autopilot, Command, CommandId, CommandStatus, Firmware, FlightMode, OffboardExit};
use geometry::{Ned, Vector};
use landing::{Action, Decision, Phase};
use messages::Setpoint;

/// Sends setpoints at their rate, mode changes and disarming.
#[derive(Debug)]
pub struct Setpoints {
    period_ns: i64,
    /// Age up to which a position is of now.
    stale_ns: i64,
    /// Time after a request of LAND in which it is not requested again.
    land_pause_ns: i64,
    last: Option<Setpoint>,
    sent_ns: i64,
    /// The change to the mode that follows setpoints, or the disarming, that was requested last.
    request: Option<CommandId>,
    /// The request of LAND, and when it was made last.
    land: Option<CommandId>,
    land_ns: Option<i64>,
    /// The way out of OFFBOARD.
    exit: Option<OffboardExit>,
}

/// Time after a request in which LAND may not show yet, in nanoseconds.
const LAND_SHOWS_NS: i64 = 3_000_000_000;

impl Setpoints {
    /// Nothing was sent yet. `stale_after` is the age from which the vehicle's state is not of now; LAND is decided for again after
    /// `land_retry`.
    pub fn new(rate_hz: f64, stale_after: Duration, land_retry: Duration) -> Self {
        let nanos = |time: Duration| i64::try_from(time.as_nanos()).unwrap_or(i64::MAX);
        Self {
            period_ns: (1e9 / rate_hz) as i64,
            stale_ns: nanos(stale_after),
            // A packet's time, by which a decision is carried out, may be earlier than that of the decision.
            land_pause_ns: nanos(land_retry / 2),
            last: None,
            sent_ns: i64::MIN,
            request: None,
            land: None,
            land_ns: None,
            exit: None,
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

    /// True while a PX4 is led out of OFFBOARD, or gets zeros until it is known whether it returns to it.
    pub fn is_leaving(&self) -> bool {
        self.last.is_some() || self.exit.is_some()
    }

    /// Carries out a decision; the result is that of a setpoint, if one was due. One that `is_urgent` is sent
    /// before its time.
    pub fn carry_out(
        &mut self,
        now_ns: i64,
        decision: &Decision,
        is_urgent: bool,
        autopilot: &mut Autopilot,
    ) -> Option<Result<(), SetpointError>> {
        let action = decision.action;
        if action == Action::None {
            self.leave_offboard(now_ns, autopilot);
            // With them a PX4 follows at once when the landing is called back.
            if decision.phase == Phase::Final && is_landing_px4(autopilot) {
                autopilot.send_zeros(now_ns);
            }
            return None;
        }
        self.exit = None;
        match action {
            Action::None => {}
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
            Action::Land if !self.is_land_due(now_ns, autopilot) => {}
            Action::Land => {
                self.land_ns = Some(now_ns);
                let mode = autopilot.firmware().and_then(Firmware::land);
                let command = Command::SetMode(mode.unwrap_or(FlightMode::Land));
                self.land = Some(autopilot.request(now_ns, command));
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

    /// Ends the setpoints, after the last one has stopped the vehicle; true while a PX4 may be in OFFBOARD.
    pub fn end(&mut self, now_ns: i64, autopilot: &mut Autopilot) -> bool {
        // A landing that is called back from LAND is asked for OFFBOARD.
        if self.exit.is_none() && autopilot.is_requesting_offboard() {
            self.exit = Some(OffboardExit::begin(now_ns, autopilot));
        }
        self.leave_offboard(now_ns, autopilot)
    }

    /// No setpoint follows: a PX4 that would take that for a failure is led out of OFFBOARD. True while that continues. One whose HOLD may
    /// be its failsafe gets zeros until it is known whether it is: as setpoints were sent after the interruption, it may be in OFFBOARD
    /// already, although it has not shown it.
    fn leave_offboard(&mut self, now_ns: i64, autopilot: &mut Autopilot) -> bool {
        if self.last.is_some() && self.exit.is_none() && autopilot.may_return_to_offboard(now_ns) {
            autopilot.send_zeros(now_ns);
            self.last = Some(Setpoint { velocity_ned_m_s: [0.0; 3], yaw_rate_rad_s: 0.0 });
            return true;
        }
        if self.last.is_some() && self.needs_hold(now_ns, autopilot) {
            self.exit = Some(OffboardExit::begin(now_ns, autopilot));
        }
        self.last = None;
        let goes_on = self.exit.as_mut().is_some_and(|exit| exit.step(now_ns, autopilot));
        if !goes_on {
            self.exit = None;
        }
        goes_on
    }

    /// False just after a request of LAND that was neither withdrawn nor replaced: several decisions may have one time, and each of them is
    /// to land.
    fn is_land_due(&self, now_ns: i64, autopilot: &Autopilot) -> bool {
        let is_recent =
            self.land_ns.is_some_and(|at_ns| now_ns.saturating_sub(at_ns) < self.land_pause_ns);
        let is_dropped = self.land.is_none_or(|request| {
            matches!(
                autopilot.status(request),
                CommandStatus::Unknown
                    | CommandStatus::Failed(
                        CommandError::Withdrawn { .. } | CommandError::Replaced { .. }
                    )
            )
        });
        !is_recent || is_dropped
    }

    /// Whether silence would be a failure: to a PX4 in OFFBOARD it is one. ArduPilot stops.
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

    /// Stops a vehicle of which only the system id is known, if it is in the mode that follows setpoints, or returns to it with them.
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

/// True while a PX4 lands in its own mode, and flies.
fn is_landing_px4(autopilot: &Autopilot) -> bool {
    autopilot.firmware() == Some(Firmware::Px4)
        && autopilot
            .state()
            .is_some_and(|state| state.armed && state.mode.is_landing() && state.landed.is_flying())
}

/// True while the autopilot's own mode is known and is ours: another one is the pilot's, and nothing is asked of it.
fn is_ours(autopilot: &Autopilot) -> bool {
    autopilot
        .state()
        .is_some_and(|state| state.connected && (state.mode.is_guided() || state.mode.is_landing()))
}
