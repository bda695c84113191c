//! Finds out whether a vehicle is a simulation, by its reports.
//!
//! Three reports show it, and a vehicle with motors sends none of them:
//! - ArduPilot sends SIM_STATE and SIMSTATE only when it is built with its simulator (`AP_SIM_ENABLED`).
//! - PX4 sends HIL_STATE_QUATERNION only while a simulator publishes the true state
//!   (`src/modules/mavlink/streams/HIL_STATE_QUATERNION.hpp`).
//! - The heartbeat's flag MAV_MODE_FLAG_HIL_ENABLED states that "all motors / actuators are blocked"; PX4 sets it
//!   with `SYS_HITL`.
//!
//! AUTOPILOT_VERSION does not show it: a simulated ArduPilot leaves board, vendor and product empty, as some boards do.

use crate::compose;
use crate::dialect::{MavMessage, MavModeFlag};
use crate::mode::Firmware;

/// Period of the request, in nanoseconds.
const PERIOD_NS: i64 = 1_000_000_000;
/// ArduPilot's answer, and PX4's.
const SIM_STATE: u32 = 108;
const HIL_STATE_QUATERNION: u32 = 115;

/// The reports of a vehicle.
#[derive(Clone, Debug, Default)]
pub(crate) struct Simulation {
    is_reported: bool,
    due_ns: Option<i64>,
}

impl Simulation {
    pub(crate) fn is_reported(&self) -> bool {
        self.is_reported
    }

    pub(crate) fn take_mode(&mut self, mode: MavModeFlag) {
        self.is_reported |= mode.contains(MavModeFlag::MAV_MODE_FLAG_HIL_ENABLED);
    }

    pub(crate) fn take(&mut self, message: &MavMessage) {
        self.is_reported |= matches!(
            message,
            MavMessage::SIM_STATE(_)
                | MavMessage::SIMSTATE(_)
                | MavMessage::HIL_STATE_QUATERNION(_)
        );
    }

    /// The request, when it is due: it is sent once a second until it is answered.
    pub(crate) fn question(&mut self, now_ns: i64, firmware: Firmware) -> Option<MavMessage> {
        if self.is_reported || self.due_ns.is_some_and(|due_ns| now_ns < due_ns) {
            return None;
        }
        self.due_ns = Some(now_ns.saturating_add(PERIOD_NS));
        let id = if firmware == Firmware::Px4 { HIL_STATE_QUATERNION } else { SIM_STATE };
        Some(compose::request_message(id))
    }
}
