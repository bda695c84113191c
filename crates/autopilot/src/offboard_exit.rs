//! The way out of PX4's OFFBOARD.
//!
//! PX4 takes silence in OFFBOARD for a failure of its companion, and without a remote control it then descends and drifts with
//! the wind (`COM_OBL_RC_ACT`). Setpoints of zero velocity, which every other mode ignores, therefore go on until it shows HOLD.
//! HOLD is requested only just after a message that shows OFFBOARD, because a later request could undo a pilot's switch; and a
//! request for OFFBOARD that was sent before may still be carried out.

use crate::client::Autopilot;
use crate::command::{Command, CommandId, CommandStatus};
use crate::mode::FlightMode;

/// Time within which it must show OFFBOARD no more, in nanoseconds: the request is sent four times, a second apart.
const MAX_EXIT_NS: i64 = 6_000_000_000;
/// Time that PX4 takes to carry out a request, in nanoseconds, besides the link's delay.
const REACTION_NS: i64 = 200_000_000;

/// The end of OFFBOARD, or of a request for it.
#[derive(Clone, Debug)]
pub struct OffboardExit {
    since_ns: i64,
    /// The request for HOLD.
    request: Option<CommandId>,
}

impl OffboardExit {
    /// Begins it: nothing that was requested before is sent again.
    pub fn begin(now_ns: i64, autopilot: &mut Autopilot) -> Self {
        autopilot.withdraw();
        Self { since_ns: now_ns, request: None }
    }

    /// Advances it; to be called with each tick. True while it goes on.
    pub fn step(&mut self, now_ns: i64, autopilot: &mut Autopilot) -> bool {
        let goes_on = self.goes_on(now_ns, autopilot);
        if goes_on {
            self.request_hold(now_ns, autopilot);
            autopilot.send_zeros(now_ns);
        } else {
            autopilot.withdraw();
        }
        autopilot.tick(now_ns);
        goes_on
    }

    fn goes_on(&self, now_ns: i64, autopilot: &Autopilot) -> bool {
        let is_armed = autopilot.state().is_some_and(|state| state.armed);
        if !is_armed || now_ns.saturating_sub(self.since_ns) > MAX_EXIT_NS {
            return false;
        }
        if autopilot.is_in_offboard() {
            return true;
        }
        // What was shown earlier says nothing of a request that was sent.
        let Some(sent_ns) = autopilot.offboard_sent_ns() else { return false };
        let delay_ns = autopilot.link_delay(now_ns).map_or(0, |delay| delay.as_nanos() as i64);
        let effect_ns = sent_ns.saturating_add(REACTION_NS).saturating_add(delay_ns);
        let shown_ns = autopilot.mode_age_ns(now_ns).map(|age_ns| now_ns.saturating_sub(age_ns));
        shown_ns.is_none_or(|shown_ns| shown_ns < effect_ns)
    }

    fn request_hold(&mut self, now_ns: i64, autopilot: &mut Autopilot) {
        let is_requested =
            self.request.is_some_and(|id| autopilot.status(id) == CommandStatus::Pending);
        if autopilot.is_in_offboard() && !is_requested && autopilot.shows_mode_of_now(now_ns) {
            let hold = Command::SetMode(FlightMode::AUTO_HOLD);
            self.request = Some(autopilot.request(now_ns, hold));
        }
    }
}
