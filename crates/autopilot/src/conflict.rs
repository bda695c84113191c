//! Reasons against the start of a flight: with another vehicle or another controller on the link it is uncertain which vehicle is
//! flown, or by which controller.

use crate::packet::Sender;

/// Time within which a heartbeat of another vehicle on the link is received, in nanoseconds: two heartbeats, which come once a second, and a margin.
pub(crate) const LISTENS_NS: i64 = 2_500_000_000;
/// The reason that is shown for this time, while a heartbeat of another vehicle on the link may still be due.
pub const LISTENING: &str = "waiting 2.5 s for heartbeats of another vehicle on the link; there is no wait where `autopilot.system_id` is set";

/// Why neither a take-off nor a landing may begin.
#[derive(Copy, Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Conflict {
    /// Another companion uses our ids, and steers.
    #[error(
        "another controller with our system and component id ({} and {}) is on the autopilot's link: it sends {message}, and may fly \
         this vehicle. End that one, or check the address of the autopilot",
        sender.system, sender.component
    )]
    SecondController {
        /// Our ids.
        sender: Sender,
        /// The message by which it steers.
        message: &'static str,
    },
    /// Another companion uses our ids, and has not steered so far.
    #[error(
        "another program with our system and component id ({} and {}) is on the autopilot's link: it sends {message}, and no setpoints so \
         far. It may be a second controller of this vehicle, which may fly it. End that one, or check the address of the autopilot; where it is \
         something else, set `autopilot.component_id` to another id (192, for example), as the autopilot's answers would go to both",
        sender.system, sender.component
    )]
    SameAddress {
        /// Our ids.
        sender: Sender,
        /// The newest message of it.
        message: &'static str,
    },
    /// Two autopilots are on the link, and the configuration does not state which one is flown.
    #[error(
        "two vehicles are on the autopilot's link, with the system ids {system} and {other}, and the configuration does not \
         state which one is to be flown. Set `autopilot.system_id` to its id, and start the controller again; in the air the autopilot's \
         own modes continue"
    )]
    SeveralVehicles {
        /// The system id of the vehicle whose heartbeat was received first.
        system: u8,
        /// The other one's.
        other: u8,
    },
}
