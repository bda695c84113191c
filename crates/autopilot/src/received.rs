//! Summarises the bytes received over a link without the autopilot's heartbeat (other systems, other packets, noise), with advice.

use std::collections::BTreeSet;

use crate::packet::{Counters, Packet};

/// Maximum number of systems that are named.
const MAX_SYSTEMS: usize = 8;

/// The traffic received since the link was opened.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Received {
    /// Ids of the systems whose autopilots sent a heartbeat.
    systems: BTreeSet<u8>,
    /// The parser's counters.
    counters: Counters,
}

impl Received {
    pub(crate) fn new(systems: BTreeSet<u8>, counters: Counters) -> Self {
        Self { systems, counters }
    }

    /// Why no heartbeat of the autopilot was received, with advice: of the one with the `expected` system id, or of any.
    pub fn why_no_heartbeat(&self, expected: Option<u8>) -> String {
        let systems: Vec<String> = self.systems.iter().map(u8::to_string).collect();
        let Counters { packets, bad_bytes, bad_checksums, unknown_ids, .. } = self.counters;
        // Noise now and then looks like a packet of an unknown message.
        let packets = packets.saturating_sub(unknown_ids);
        match expected {
            Some(expected) if !systems.is_empty() && !self.systems.contains(&expected) => format!(
                "no heartbeat of system {expected} yet, but of {}: set `autopilot.system_id` to the vehicle's, or to 0 for any",
                systems.join(", ")
            ),
            _ if packets > 0 => format!(
                "no heartbeat of an autopilot yet, but {packets} other MAVLink packets: check what is connected there, and that the autopilot sends heartbeats on this port"
            ),
            _ if bad_bytes + bad_checksums + unknown_ids > 0 => format!(
                "no heartbeat yet, and no MAVLink packet in {bad_bytes} bytes received: check the speed (baud) on both sides, and that the autopilot's port sends MAVLink"
            ),
            _ => "no heartbeat yet, no bytes received: check that the autopilot is on, its cable, and `autopilot.address`".to_owned(),
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
    fn a_missing_heartbeat_is_explained_by_the_other_traffic() {
        let explain = |systems: &[u8], counters: Counters, expected| {
            Received::new(systems.iter().copied().collect(), counters).why_no_heartbeat(expected)
        };
        let some = Counters { packets: 9, ..Counters::default() };
        let other = explain(&[1, 4], some, Some(7));
        assert!(
            other.contains("of system 7 yet, but of 1, 4: set `autopilot.system_id`"),
            "{other}"
        );
        assert!(explain(&[], some, None).contains("but 9 other MAVLink packets"));
        let noise = Counters { packets: 1, unknown_ids: 1, bad_bytes: 3000, ..Counters::default() };
        let noise = explain(&[], noise, None);
        assert!(
            noise.contains("no MAVLink packet in 3000 bytes received: check the speed"),
            "{noise}"
        );
        let silent = explain(&[], Counters::default(), Some(1));
        assert!(silent.contains("no bytes received: check that the autopilot is on"), "{silent}");
    }
}
