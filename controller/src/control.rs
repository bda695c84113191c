//! Taking control of a PX4 that holds its place.
//!
//! PX4 enters OFFBOARD only while setpoints come, so it cannot be chosen by hand before a landing begins, and no landing begins
//! outside of it. A start from HOLD therefore sends setpoints of zero velocity, which a mode that was chosen ignores, and asks for
//! OFFBOARD. (A HOLD that is the failsafe of OFFBOARD ends with them.) A start that is given up is followed by an [`autopilot::OffboardExit`].

use autopilot::{Autopilot, Command, CommandId, CommandStatus, Firmware, FlightMode};
use geometry::{Ned, Vector};

/// Time within which a PX4 must have changed to OFFBOARD, in nanoseconds: its heartbeat comes once a second, and a request is
/// sent four times.
const MAX_CHANGE_NS: i64 = 10_000_000_000;
/// Time in OFFBOARD within which the lander must have begun, in nanoseconds.
const MAX_UNUSED_NS: i64 = 1_500_000_000;

/// A change to OFFBOARD that was asked for.
#[derive(Clone, Debug)]
pub struct TakingControl {
    request: CommandId,
    until_ns: i64,
    /// Since when it has been in OFFBOARD.
    follows_since_ns: Option<i64>,
}

/// How far it is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ControlProgress {
    /// Nothing is decided yet.
    Waiting,
    /// The vehicle follows setpoints: the landing is to begin.
    InControl,
    /// It does not begin, for this reason; the vehicle may be in OFFBOARD, or change to it.
    GivenUp(String),
}

impl TakingControl {
    /// Asks for OFFBOARD.
    pub fn begin(now_ns: i64, autopilot: &mut Autopilot) -> Self {
        Self {
            request: autopilot.request(now_ns, Command::SetMode(FlightMode::OFFBOARD)),
            until_ns: now_ns.saturating_add(MAX_CHANGE_NS),
            follows_since_ns: None,
        }
    }

    /// Advances it; to be called with each tick.
    pub fn step(&mut self, now_ns: i64, autopilot: &mut Autopilot) -> ControlProgress {
        autopilot.send_zeros(now_ns);
        let given_up = |why: &str| ControlProgress::GivenUp(why.to_owned());
        let Some(state) = autopilot.state().copied() else {
            return given_up("the autopilot is not known any more");
        };
        if state.mode.is_guided() {
            let since_ns = *self.follows_since_ns.get_or_insert(now_ns);
            let is_in_time = now_ns.saturating_sub(since_ns) <= MAX_UNUSED_NS;
            if is_in_time && state.armed && state.landed.is_flying() {
                return ControlProgress::InControl;
            }
            return given_up(
                "the vehicle follows setpoints, but its attitude and position are not known, or it does not fly",
            );
        }
        if state.mode != FlightMode::AUTO_HOLD {
            return given_up(&format!("the pilot took over, in {}", state.mode));
        }
        if !state.armed || !state.landed.is_flying() {
            return given_up("the vehicle does not fly any more");
        }
        match autopilot.status(self.request) {
            CommandStatus::Failed(error) => given_up(&error.to_string()),
            _ if now_ns > self.until_ns => given_up("it does not stay in OFFBOARD"),
            _ => ControlProgress::Waiting,
        }
    }
}

/// Whether a PX4 is in OFFBOARD, or shows a HOLD that may be the failsafe for setpoints that were missing: it returns with them.
pub fn needs_setpoints(now_ns: i64, autopilot: &Autopilot) -> bool {
    autopilot.is_in_offboard() || autopilot.may_return_to_offboard(now_ns)
}

/// Keeps a PX4 where it is that is in OFFBOARD while nothing steers it: without setpoints it would leave the mode, and with zeros it would drift
/// with the error of its own velocity. `back` is the velocity that leads it back to where it waits, in m/s.
pub fn hover_in_offboard(now_ns: i64, back: Vector<Ned>, autopilot: &mut Autopilot) {
    if needs_setpoints(now_ns, autopilot) {
        autopilot.send_hover(now_ns, back);
    }
}

/// True when it is a PX4 that flies and holds its place.
pub fn is_holding_px4(autopilot: &Autopilot) -> bool {
    px4_in_flight(autopilot) == Some(FlightMode::AUTO_HOLD)
}

/// True when it holds its place by choice: setpoints alone do not change that.
pub fn is_held_px4(now_ns: i64, autopilot: &Autopilot) -> bool {
    is_holding_px4(autopilot) && !autopilot.may_return_to_offboard(now_ns)
}

/// The mode in which a pilot, a mission or a failsafe flies a PX4 now.
pub fn pilots_px4_mode(autopilot: &Autopilot) -> Option<FlightMode> {
    px4_in_flight(autopilot).filter(|mode| !mode.is_guided() && !mode.is_landing())
}

/// The mode of a connected PX4 that flies.
fn px4_in_flight(autopilot: &Autopilot) -> Option<FlightMode> {
    let state = autopilot.state().filter(|_| autopilot.firmware() == Some(Firmware::Px4))?;
    (state.connected && state.armed && state.landed.is_flying()).then_some(state.mode)
}
