//! Why no flight may begin that would begin on the first heartbeat alone: who else is on the link makes it uncertain which vehicle
//! is flown, or by whom.

use crate::packet::Sender;

/// What is told while another vehicle on the link might not have been heard yet.
pub const LISTENING: &str = "listening for 2.5 s whether another vehicle is on the link; nothing is listened for where `autopilot.system_id` is set";

/// Why neither a take-off nor a landing may begin.
#[derive(Copy, Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Conflict {
    /// Another companion uses our ids.
    #[error(
        "another companion with our system and component id ({} and {}) is on the autopilot's link, probably a \
         second controller of this vehicle, which may fly it. End that one, check the address of the autopilot, or change \
         `autopilot.component_id` on one of them",
        sender.system, sender.component
    )]
    SameAddress {
        /// Our ids.
        sender: Sender,
    },
    /// Two autopilots are on the link, and the configuration does not say which one is flown.
    #[error(
        "two vehicles are on the autopilot's link, with the system ids {system} and {other}, and nothing says which one is to be \
         flown. Set `autopilot.system_id` to its id, and start the controller again; in the air the autopilot's own modes go on"
    )]
    SeveralVehicles {
        /// The system id of the vehicle that was heard first.
        system: u8,
        /// The other one's.
        other: u8,
    },
}
