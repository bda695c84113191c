//! What came over a link on which the autopilot that is waited for does not speak: other systems, other packets, or bytes that are none.

use std::collections::BTreeSet;

use crate::packet::{Counters, Packet};

/// Maximum number of systems that are told.
const MAX_SYSTEMS: usize = 8;

/// What was heard since the link was opened.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Heard {
    /// Ids of the systems whose autopilots sent a heartbeat.
    systems: BTreeSet<u8>,
    /// The parser's counters.
    counters: Counters,
}

impl Heard {
    pub(crate) fn new(systems: BTreeSet<u8>, counters: Counters) -> Self {
        Self { systems, counters }
    }

    /// Why no heartbeat of the autopilot has come, and what to do: of the one with this system id, or of any.
    pub fn instead(&self, wanted: Option<u8>) -> String {
        let systems: Vec<String> = self.systems.iter().map(u8::to_string).collect();
        let Counters { packets, bad_bytes, bad_checksums, unknown_ids, .. } = self.counters;
        // Noise now and then looks like a packet of an unknown message.
        let packets = packets.saturating_sub(unknown_ids);
        match wanted {
            Some(wanted) if !systems.is_empty() && !self.systems.contains(&wanted) => format!(
                "no heartbeat of system {wanted} yet, but of {}: set `autopilot.system_id` to the vehicle's, or to 0 for any",
                systems.join(", ")
            ),
            _ if packets > 0 => format!(
                "no heartbeat of an autopilot yet, but {packets} other MAVLink packets: check what is connected there, and that the autopilot sends heartbeats on this port"
            ),
            _ if bad_bytes + bad_checksums + unknown_ids > 0 => format!(
                "no heartbeat yet, and in {bad_bytes} bytes that came no MAVLink packet: check the speed (baud) on both sides, and that the autopilot's port speaks MAVLink"
            ),
            _ => "no heartbeat yet, nothing came: check that the autopilot is on, its cable, and `autopilot.address`".to_owned(),
        }
    }
}

/// Adds the systems whose autopilots' heartbeats are among the packets.
pub(crate) fn note_systems(systems: &mut BTreeSet<u8>, packets: &[Packet]) {
    for packet in packets.iter().filter(|packet| packet.is_heartbeat_of_autopilot()) {
        if systems.len() < MAX_SYSTEMS {
            systems.insert(packet.sender.system);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_came_instead_of_the_heartbeat_is_told() {
        let told = |systems: &[u8], counters: Counters, wanted| {
            Heard::new(systems.iter().copied().collect(), counters).instead(wanted)
        };
        let some = Counters { packets: 9, ..Counters::default() };
        let other = told(&[1, 4], some, Some(7));
        assert!(
            other.contains("of system 7 yet, but of 1, 4: set `autopilot.system_id`"),
            "{other}"
        );
        assert!(told(&[], some, None).contains("but 9 other MAVLink packets"));
        let noise = Counters { packets: 1, unknown_ids: 1, bad_bytes: 3000, ..Counters::default() };
        let noise = told(&[], noise, None);
        assert!(
            noise.contains("in 3000 bytes that came no MAVLink packet: check the speed"),
            "{noise}"
        );
        let nothing = told(&[], Counters::default(), Some(1));
        assert!(nothing.contains("nothing came: check that the autopilot is on"), "{nothing}");
    }
}
