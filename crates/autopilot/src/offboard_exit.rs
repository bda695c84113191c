//! The way out of PX4's OFFBOARD, and of a LAND that is called back.
//!
//! PX4 takes silence in OFFBOARD for a failure of its companion, and without a remote control it then descends and drifts with
//! the wind (`COM_OBL_RC_ACT`). Setpoints of zero velocity, which a mode that was chosen ignores, therefore continue until it shows HOLD.
//! HOLD is requested only just after a message that shows OFFBOARD, because a later request could undo a pilot's switch; and a
//! request for OFFBOARD that was sent before may still be carried out. A HOLD that may be the failsafe for missing setpoints ends with them, so
//! it counts only once it was certainly chosen, or stays. The same holds for LAND, where it was requested and is called back.

use crate::client::Autopilot;
use crate::command::{Command, CommandId, CommandStatus};
use crate::mode::FlightMode;

/// Time within which it must show OFFBOARD no more, in nanoseconds: the request is sent four times, a second apart.
const MAX_EXIT_NS: i64 = 6_000_000_000;
/// Time that PX4 takes to carry out a request, in nanoseconds, in addition to the link's delay.
const REACTION_NS: i64 = 200_000_000;

/// The end of OFFBOARD, or of a request for it; where it is called back, of LAND as well.
#[derive(Clone, Debug)]
pub struct OffboardExit {
    since_ns: i64,
    /// The request for HOLD.
    request: Option<CommandId>,
    /// When the LAND that is called back was requested last.
    land_sent_ns: Option<i64>,
}

impl OffboardExit {
    /// Begins it: no earlier request is sent again.
    pub fn begin(now_ns: i64, autopilot: &mut Autopilot) -> Self {
        autopilot.withdraw();
        Self { since_ns: now_ns, request: None, land_sent_ns: None }
    }

    /// The same, out of LAND as well, which was requested at this time and may be carried out yet.
    pub fn begin_out_of_land(now_ns: i64, land_sent_ns: i64, autopilot: &mut Autopilot) -> Self {
        Self { land_sent_ns: Some(land_sent_ns), ..Self::begin(now_ns, autopilot) }
    }

    /// Advances it; to be called with each tick. True while it continues.
    pub fn step(&mut self, now_ns: i64, autopilot: &mut Autopilot) -> bool {
        let continues = self.continues(now_ns, autopilot);
        if continues {
            self.request_hold(now_ns, autopilot);
            if self.land_sent_ns.is_none() || autopilot.offboard_sent_ns().is_some() {
                autopilot.send_zeros(now_ns);
            }
        } else {
            autopilot.withdraw();
        }
        autopilot.tick(now_ns);
        continues
    }

    fn continues(&self, now_ns: i64, autopilot: &Autopilot) -> bool {
        let is_armed = autopilot.state().is_some_and(|state| state.armed);
        if !is_armed || now_ns.saturating_sub(self.since_ns) > MAX_EXIT_NS {
            return false;
        }
        // A HOLD that was requested here is chosen.
        let may_return = self.request.is_none() && autopilot.may_return_to_offboard(now_ns);
        if self.is_in_mode_to_leave(autopilot) || may_return {
            return true;
        }
        // A mode that was shown earlier does not show the effect of a request.
        let sent_ns = autopilot.offboard_sent_ns().max(self.land_sent_ns);
        let Some(sent_ns) = sent_ns else { return false };
        let delay_ns = autopilot.link_delay(now_ns).map_or(0, |delay| delay.as_nanos() as i64);
        let effect_ns = sent_ns.saturating_add(REACTION_NS).saturating_add(delay_ns);
        let shown_ns = autopilot.mode_age_ns(now_ns).map(|age_ns| now_ns.saturating_sub(age_ns));
        shown_ns.is_none_or(|shown_ns| shown_ns < effect_ns)
    }

    fn is_in_mode_to_leave(&self, autopilot: &Autopilot) -> bool {
        let lands = self.land_sent_ns.is_some() && autopilot.is_in_auto_land();
        autopilot.is_in_offboard() || lands
    }

    fn request_hold(&mut self, now_ns: i64, autopilot: &mut Autopilot) {
        let is_requested =
            self.request.is_some_and(|id| autopilot.status(id) == CommandStatus::Pending);
        let is_of_now = autopilot.shows_mode_of_now(now_ns);
        if self.is_in_mode_to_leave(autopilot) && !is_requested && is_of_now {
            let hold = Command::SetMode(FlightMode::AUTO_HOLD);
            self.request = Some(autopilot.request(now_ns, hold));
        } else if is_requested && !is_of_now && !autopilot.is_in_offboard() {
            // Out of LAND no other rule prevents that it is sent again after a pilot has changed the mode.
            autopilot.withdraw();
        }
    }
}
