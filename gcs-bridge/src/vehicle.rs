//! Whom the bridge speaks for: the autopilot's system number, and who else is aboard.

use std::collections::HashSet;

use autopilot::dialect::{MavAutopilot, MavMessage};
use autopilot::{Packet, Sender};

/// Assumed when no autopilot is heard: the number autopilots are delivered with.
const USUAL_SYSTEM: u8 = 1;
/// The component number of an autopilot.
const AUTOPILOT: u8 = 1;
/// After this silence another autopilot is believed to be the vehicle.
const SILENCE_NS: i64 = 10_000_000_000;

/// What is known of the vehicle.
#[derive(Debug)]
pub(crate) struct Vehicle {
    configured: Option<u8>,
    heard: Option<Heard>,
    /// When 1 is assumed, in ns.
    assume_at_ns: i64,
    /// Components of the vehicle whose packets came from the autopilot's side; at most 256.
    aboard: HashSet<u8>,
}

#[derive(Copy, Clone, Debug)]
struct Heard {
    system: u8,
    at_ns: i64,
}

impl Vehicle {
    /// A vehicle with a configured number, or with 0 for one that is to be learned.
    pub(crate) fn new(configured: u8, assume_at_ns: i64) -> Self {
        let configured = (configured != 0).then_some(configured);
        Self { configured, heard: None, assume_at_ns, aboard: HashSet::new() }
    }

    /// Learns from a packet from the autopilot's side.
    pub(crate) fn hear(&mut self, now_ns: i64, packet: &Packet) {
        if is_autopilot(packet) {
            self.hear_autopilot(now_ns, packet.sender.system);
        }
        if self.number() == Some(packet.sender.system) {
            self.aboard.insert(packet.sender.component);
        }
    }

    /// The system number to speak under; none while it would be a guess.
    pub(crate) fn system(&self, now_ns: i64) -> Option<u8> {
        self.number().or_else(|| (now_ns >= self.assume_at_ns).then_some(USUAL_SYSTEM))
    }

    /// True for the sender of packets that came from the autopilot's side.
    pub(crate) fn is_aboard(&self, sender: Sender) -> bool {
        self.number() == Some(sender.system) && self.aboard.contains(&sender.component)
    }

    fn number(&self) -> Option<u8> {
        self.configured.or(self.heard.map(|heard| heard.system))
    }

    /// The link may carry heartbeats of other vehicles too, so the first autopilot stays until it falls silent.
    fn hear_autopilot(&mut self, now_ns: i64, system: u8) {
        let stays = self.heard.is_some_and(|heard| {
            heard.system != system && now_ns.saturating_sub(heard.at_ns) <= SILENCE_NS
        });
        if stays || system == 0 {
            return;
        }
        if self.heard.is_none_or(|heard| heard.system != system) {
            if self.configured.is_none() {
                tracing::info!(system, "The vehicle's system number is known");
                self.aboard.clear();
            } else if self.configured != Some(system) {
                tracing::warn!(system, configured = ?self.configured, "The autopilot has another system number than configured");
            }
        }
        self.heard = Some(Heard { system, at_ns: now_ns });
    }
}

fn is_autopilot(packet: &Packet) -> bool {
    match &packet.message {
        Some(MavMessage::HEARTBEAT(heartbeat)) => {
            packet.sender.component == AUTOPILOT
                && heartbeat.autopilot != MavAutopilot::MAV_AUTOPILOT_INVALID
        }
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use autopilot::Parser;
    use autopilot::dialect::HEARTBEAT_DATA;
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
    fn the_number_is_that_of_the_autopilot_and_of_nobody_else() {
        let mut vehicle = Vehicle::new(0, 5 * SECOND_NS);
        vehicle.hear(0, &heartbeat(255, 190, MavAutopilot::MAV_AUTOPILOT_INVALID));
        vehicle.hear(0, &heartbeat(9, 1, MavAutopilot::MAV_AUTOPILOT_INVALID));
        vehicle.hear(0, &heartbeat(9, 154, MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA));
        assert_eq!(vehicle.system(5 * SECOND_NS - 1), None);
        assert_eq!(vehicle.system(5 * SECOND_NS), Some(1));
        vehicle.hear(6 * SECOND_NS, &ardupilot(7));
        assert_eq!(vehicle.system(6 * SECOND_NS), Some(7));
    }

    #[test]
    fn another_vehicle_takes_over_only_after_silence() {
        let mut vehicle = Vehicle::new(0, 0);
        vehicle.hear(0, &ardupilot(7));
        vehicle.hear(SILENCE_NS, &ardupilot(8));
        assert_eq!(vehicle.system(SILENCE_NS), Some(7));
        vehicle.hear(SILENCE_NS + 1, &ardupilot(8));
        assert_eq!(vehicle.system(SILENCE_NS + 1), Some(8));
        assert!(!vehicle.is_aboard(Sender { system: 7, component: 1 }));
    }

    #[test]
    fn a_configured_number_is_never_replaced() {
        let mut vehicle = Vehicle::new(3, SECOND_NS);
        vehicle.hear(0, &ardupilot(7));
        assert_eq!(vehicle.system(0), Some(3));
    }

    #[test]
    fn who_is_aboard_is_known_by_what_came_from_there() {
        let mut vehicle = Vehicle::new(0, 0);
        vehicle.hear(0, &ardupilot(7));
        vehicle.hear(0, &heartbeat(7, 154, MavAutopilot::MAV_AUTOPILOT_INVALID));
        vehicle.hear(0, &heartbeat(255, 190, MavAutopilot::MAV_AUTOPILOT_INVALID));
        assert!(vehicle.is_aboard(Sender { system: 7, component: 154 }));
        assert!(!vehicle.is_aboard(Sender { system: 7, component: 100 }));
        assert!(!vehicle.is_aboard(Sender { system: 255, component: 190 }));
    }
}
