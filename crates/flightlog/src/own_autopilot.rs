//! Finds the packets of the vehicle's own autopilot on its link: others may be on it as well, of another vehicle, a gimbal or a
//! companion.

use autopilot::Packet;
use autopilot::packet::AUTOPILOT;
use messages::Configuration;

/// Distinguishes the packets of the vehicle's own autopilot from others, as the controller does.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct OwnAutopilot {
    /// The system id of the controller's configuration, if it has one.
    configured: Option<u8>,
    /// That of the first autopilot whose heartbeat was received.
    first_received: Option<u8>,
}

impl OwnAutopilot {
    /// Takes the system id from a controller's configuration.
    pub fn configure(&mut self, configuration: &Configuration) {
        if configuration.service == "controller" {
            let table: Option<toml::Table> = configuration.toml.parse().ok();
            let system =
                table.and_then(|table| table.get("autopilot")?.get("system_id")?.as_integer());
            self.configured = system.and_then(|id| u8::try_from(id).ok()).filter(|id| *id != 0);
        }
    }

    /// Whether it has sent this packet; unknown until its first heartbeat, unless it is configured.
    pub fn has_sent(&mut self, packet: &Packet) -> bool {
        let system = packet.sender.system;
        if packet.sender.component != AUTOPILOT {
            return false;
        }
        if packet.is_heartbeat_of_autopilot() {
            self.first_received.get_or_insert(system);
        }
        self.configured.or(self.first_received) == Some(system)
    }
}

#[cfg(test)]
mod tests {
    use autopilot::dialect::{HEARTBEAT_DATA, MavAutopilot, MavMessage, STATUSTEXT_DATA};
    use autopilot::{Sender, packet};

    use super::*;

    fn sent(system: u8, component: u8, message: &MavMessage) -> Packet {
        Packet::from_raw(&packet::encode(Sender { system, component }, 0, message)).unwrap()
    }

    fn heartbeat(system: u8, autopilot: MavAutopilot) -> Packet {
        let data = HEARTBEAT_DATA { autopilot, ..HEARTBEAT_DATA::default() };
        sent(system, 1, &MavMessage::HEARTBEAT(data))
    }

    fn configuration(toml: &str) -> Configuration {
        Configuration {
            service: "controller".to_owned(),
            instance: "main".to_owned(),
            host: String::new(),
            version: String::new(),
            toml: toml.to_owned(),
        }
    }

    #[test]
    fn the_own_autopilot_is_the_first_with_a_heartbeat_or_the_configured_one() {
        let text = |system, component| {
            sent(system, component, &MavMessage::STATUSTEXT(STATUSTEXT_DATA::default()))
        };
        let mut own = OwnAutopilot::default();
        assert!(!own.has_sent(&text(3, 1)), "not known yet");
        assert!(!own.has_sent(&heartbeat(2, MavAutopilot::MAV_AUTOPILOT_INVALID)), "no autopilot");
        assert!(own.has_sent(&heartbeat(3, MavAutopilot::MAV_AUTOPILOT_PX4)));
        assert!(!own.has_sent(&heartbeat(4, MavAutopilot::MAV_AUTOPILOT_PX4)));
        assert!(own.has_sent(&text(3, 1)));
        assert!(!own.has_sent(&text(3, 154)) && !own.has_sent(&text(4, 1)));
        own.configure(&configuration("[autopilot]\nsystem_id = 4\n"));
        assert!(!own.has_sent(&text(3, 1)) && own.has_sent(&text(4, 1)));
        own.configure(&configuration("[autopilot]\nsystem_id = 0\n"));
        assert!(own.has_sent(&text(3, 1)) && !own.has_sent(&text(4, 1)));
    }
}
