//! Finds the autopilot's system id and the components on board from the packets of the autopilot's side.

use std::collections::HashSet;

use autopilot::{Packet, Sender};

/// Assumed without an autopilot: the default system id of autopilots.
const DEFAULT_SYSTEM: u8 = 1;
/// Silence of the autopilot after which another one is accepted, in nanoseconds.
const TIMEOUT_NS: i64 = 10_000_000_000;

/// The known ids of the vehicle.
#[derive(Debug)]
pub(crate) struct Vehicle {
    configured: Option<u8>,
    found: Option<Found>,
    /// When 1 is assumed, in ns.
    assume_at_ns: i64,
    /// Components of the vehicle whose packets came from the autopilot's side; at most 256.
    aboard: HashSet<u8>,
}

#[derive(Copy, Clone, Debug)]
struct Found {
    system: u8,
    at_ns: i64,
}

impl Vehicle {
    /// A vehicle with a configured system id, or 0 to take that of the autopilot's heartbeat.
    pub(crate) fn new(configured: u8, assume_at_ns: i64) -> Self {
        let configured = (configured != 0).then_some(configured);
        Self { configured, found: None, assume_at_ns, aboard: HashSet::new() }
    }

    /// Registers the sender of a packet from the autopilot's side.
    pub(crate) fn received(&mut self, now_ns: i64, packet: &Packet) {
        if packet.is_heartbeat_of_autopilot() {
            self.autopilot_active(now_ns, packet.sender.system);
        }
        if self.id() == Some(packet.sender.system) {
            self.aboard.insert(packet.sender.component);
        }
    }

    /// Our system id; none while it would be a guess.
    pub(crate) fn system(&self, now_ns: i64) -> Option<u8> {
        self.id().or_else(|| (now_ns >= self.assume_at_ns).then_some(DEFAULT_SYSTEM))
    }

    /// True for the sender of packets that came from the autopilot's side.
    pub(crate) fn is_aboard(&self, sender: Sender) -> bool {
        self.id() == Some(sender.system) && self.aboard.contains(&sender.component)
    }

    fn id(&self) -> Option<u8> {
        self.configured.or(self.found.map(|found| found.system))
    }

    /// The link may carry heartbeats of other vehicles too, so the first autopilot stays until it falls
    /// silent.
    fn autopilot_active(&mut self, now_ns: i64, system: u8) {
        let stays = self.found.is_some_and(|found| {
            found.system != system && now_ns.saturating_sub(found.at_ns) <= TIMEOUT_NS
        });
        if stays || system == 0 {
            return;
        }
        if self.found.is_none_or(|found| found.system != system) {
            if self.configured.is_none() {
                tracing::info!(system, "Vehicle found");
                self.aboard.clear();
            } else if self.configured != Some(system) {
                tracing::warn!(system, configured = ?self.configured, "The autopilot's system id differs from the configured one");
            }
        }
        self.found = Some(Found { system, at_ns: now_ns });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use autopilot::Parser;
    use autopilot::dialect::{HEARTBEAT_DATA, MavAutopilot, MavMessage};
    use autopilot::packet::encode;

    const SECOND_NS: i64 = 1_000_000_000;

    fn heartbeat(system: u8, component: u8, autopilot: MavAutopilot) -> Packet {
        let message =
            MavMessage::HEARTBEAT(HEARTBEAT_DATA { autopilot, ..HEARTBEAT_DATA::default() });
        Parser::new().push(&encode(Sender { system, component }, 0, &message)).remove(0)
    }

    fn ardupilot(system: u8) -> Packet {
        heartbeat(system, 1, MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA)
    }

    #[test]
    fn the_system_id_is_that_of_the_autopilot_only() {
        let mut vehicle = Vehicle::new(0, 5 * SECOND_NS);
        vehicle.received(0, &heartbeat(255, 190, MavAutopilot::MAV_AUTOPILOT_INVALID));
        vehicle.received(0, &heartbeat(9, 1, MavAutopilot::MAV_AUTOPILOT_INVALID));
        vehicle.received(0, &heartbeat(9, 154, MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA));
        assert_eq!(vehicle.system(5 * SECOND_NS - 1), None);
        assert_eq!(vehicle.system(5 * SECOND_NS), Some(1));
        vehicle.received(6 * SECOND_NS, &ardupilot(7));
        assert_eq!(vehicle.system(6 * SECOND_NS), Some(7));
    }

    #[test]
    fn another_vehicle_takes_over_only_after_silence() {
        let mut vehicle = Vehicle::new(0, 0);
        vehicle.received(0, &ardupilot(7));
        vehicle.received(TIMEOUT_NS, &ardupilot(8));
        assert_eq!(vehicle.system(TIMEOUT_NS), Some(7));
        vehicle.received(TIMEOUT_NS + 1, &ardupilot(8));
        assert_eq!(vehicle.system(TIMEOUT_NS + 1), Some(8));
        assert!(!vehicle.is_aboard(Sender { system: 7, component: 1 }));
    }

    #[test]
    fn a_configured_system_id_is_never_replaced() {
        let mut vehicle = Vehicle::new(3, SECOND_NS);
        vehicle.received(0, &ardupilot(7));
        assert_eq!(vehicle.system(0), Some(3));
    }

    #[test]
    fn components_on_board_are_known_by_their_packets() {
        let mut vehicle = Vehicle::new(0, 0);
        vehicle.received(0, &ardupilot(7));
        vehicle.received(0, &heartbeat(7, 154, MavAutopilot::MAV_AUTOPILOT_INVALID));
        vehicle.received(0, &heartbeat(255, 190, MavAutopilot::MAV_AUTOPILOT_INVALID));
        assert!(vehicle.is_aboard(Sender { system: 7, component: 154 }));
        assert!(!vehicle.is_aboard(Sender { system: 7, component: 100 }));
        assert!(!vehicle.is_aboard(Sender { system: 255, component: 190 }));
    }
}
