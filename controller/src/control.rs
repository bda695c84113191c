//! Taking control of a PX4 that holds its place.
//!
//! PX4 enters OFFBOARD only while setpoints come, so nobody can choose it by hand before a landing begins, and no landing begins
//! outside of it. A start from HOLD therefore sends setpoints of zero velocity, which every other mode ignores, and asks for
//! OFFBOARD. What PX4 did shows in its heartbeat, up to a second later: until then the zeros go on, and a start that is given up
//! asks for HOLD only if OFFBOARD shows.

use autopilot::{Autopilot, Command, CommandId, CommandStatus, Firmware, FlightMode};

/// Time within which a PX4 must have changed to OFFBOARD, in nanoseconds: its heartbeat comes once a second, and a request is
/// sent four times.
const MAX_CHANGE_NS: i64 = 10_000_000_000;
/// Time in OFFBOARD within which the lander must have begun, in nanoseconds.
const MAX_UNUSED_NS: i64 = 1_500_000_000;
/// Time within which a PX4 that is to hold its place must show OFFBOARD no more, in nanoseconds: the request is sent four times.
pub const MAX_RELEASE_NS: i64 = 6_000_000_000;
/// Time after which a heartbeat shows what an earlier request did, in nanoseconds.
const REACTION_NS: i64 = 200_000_000;

/// A change to OFFBOARD that was asked for.
#[derive(Clone, Debug)]
pub struct TakingControl {
    request: CommandId,
    until_ns: i64,
    /// Since when it has been in OFFBOARD.
    follows_since_ns: Option<i64>,
    release: Option<Release>,
}

/// The end of a change that was given up.
#[derive(Clone, Debug)]
struct Release {
    why: String,
    since_ns: i64,
    /// The request for HOLD.
    request: Option<CommandId>,
}

/// How far it is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ControlProgress {
    /// Nothing is decided yet.
    Waiting,
    /// The vehicle follows setpoints: the landing is to begin.
    InControl,
    /// It does not begin, for this reason, and nothing more is sent.
    Ended(String),
}

impl TakingControl {
    /// Asks for OFFBOARD.
    pub fn begin(now_ns: i64, autopilot: &mut Autopilot) -> Self {
        Self {
            request: autopilot.request(now_ns, Command::SetMode(FlightMode::OFFBOARD)),
            until_ns: now_ns.saturating_add(MAX_CHANGE_NS),
            follows_since_ns: None,
            release: None,
        }
    }

    /// Why it was given up.
    pub fn given_up(&self) -> Option<&str> {
        self.release.as_ref().map(|release| release.why.as_str())
    }

    /// Gives it up: OFFBOARD is asked for no more, and left again if it shows.
    pub fn give_up(&mut self, now_ns: i64, autopilot: &mut Autopilot, why: String) {
        if self.release.is_none() {
            autopilot.withdraw();
            self.release = Some(Release { why, since_ns: now_ns, request: None });
        }
    }

    /// Advances it; to be called with each tick.
    pub fn step(&mut self, now_ns: i64, autopilot: &mut Autopilot) -> ControlProgress {
        let progress = self.advance(now_ns, autopilot);
        match progress {
            ControlProgress::Ended(_) => autopilot.withdraw(),
            _ => autopilot.send_zeros(now_ns),
        }
        progress
    }

    fn advance(&mut self, now_ns: i64, autopilot: &mut Autopilot) -> ControlProgress {
        let Some(state) = autopilot.state().copied() else {
            return ControlProgress::Ended("the autopilot is not known any more".to_owned());
        };
        // Another mode is the pilot's.
        if !state.mode.is_guided() && state.mode != FlightMode::AUTO_HOLD {
            let why = || format!("the pilot took over, in {}", state.mode);
            return ControlProgress::Ended(self.given_up().map_or_else(why, str::to_owned));
        }
        if let Some(release) = &mut self.release {
            return release.step(now_ns, state.mode, autopilot);
        }
        if state.mode.is_guided() {
            let since_ns = *self.follows_since_ns.get_or_insert(now_ns);
            let is_in_time = now_ns.saturating_sub(since_ns) <= MAX_UNUSED_NS;
            if is_in_time && state.armed && state.landed.is_flying() {
                return ControlProgress::InControl;
            }
            let why = "the vehicle follows setpoints, but its attitude and position are not known, or it does not fly";
            self.give_up(now_ns, autopilot, why.to_owned());
            return ControlProgress::Waiting;
        }
        if !state.armed || !state.landed.is_flying() {
            self.give_up(now_ns, autopilot, "the vehicle does not fly any more".to_owned());
            return ControlProgress::Waiting;
        }
        match autopilot.status(self.request) {
            CommandStatus::Failed(error) => self.give_up(now_ns, autopilot, error.to_string()),
            _ if now_ns > self.until_ns => {
                self.give_up(now_ns, autopilot, "it does not stay in OFFBOARD".to_owned());
            }
            _ => {}
        }
        ControlProgress::Waiting
    }
}

impl Release {
    fn step(
        &mut self,
        now_ns: i64,
        mode: FlightMode,
        autopilot: &mut Autopilot,
    ) -> ControlProgress {
        let heartbeat_ns = autopilot.heartbeat_age_ns(now_ns).map(|age_ns| now_ns - age_ns);
        let shows = heartbeat_ns.is_some_and(|ns| ns >= self.since_ns.saturating_add(REACTION_NS));
        let is_over = shows && mode == FlightMode::AUTO_HOLD;
        if is_over || now_ns.saturating_sub(self.since_ns) > MAX_RELEASE_NS {
            return ControlProgress::Ended(self.why.clone());
        }
        let is_asked =
            self.request.is_some_and(|id| autopilot.status(id) == CommandStatus::Pending);
        if mode.is_guided() && autopilot.shows_mode_of_now(now_ns) && !is_asked {
            let hold = Command::SetMode(FlightMode::AUTO_HOLD);
            self.request = Some(autopilot.request(now_ns, hold));
        }
        ControlProgress::Waiting
    }
}

/// Keeps a PX4 where it is that is in OFFBOARD while nothing steers it: without setpoints it would leave the mode.
pub fn hover_in_offboard(now_ns: i64, autopilot: &mut Autopilot) {
    if autopilot.state().is_some_and(|state| state.mode == FlightMode::OFFBOARD) {
        autopilot.send_zeros(now_ns);
    }
}

/// True when it is a PX4 that flies and holds its place.
pub fn is_holding_px4(autopilot: &Autopilot) -> bool {
    px4_in_flight(autopilot) == Some(FlightMode::AUTO_HOLD)
}

/// The mode in which a pilot, a mission or a failsafe flies a PX4 now.
pub fn pilots_px4_mode(autopilot: &Autopilot) -> Option<FlightMode> {
    px4_in_flight(autopilot).filter(|mode| !mode.is_guided() && !mode.is_landing())
}

/// The mode of a PX4 that is heard and flies.
fn px4_in_flight(autopilot: &Autopilot) -> Option<FlightMode> {
    let state = autopilot.state().filter(|_| autopilot.firmware() == Some(Firmware::Px4))?;
    (state.connected && state.armed && state.landed.is_flying()).then_some(state.mode)
}
