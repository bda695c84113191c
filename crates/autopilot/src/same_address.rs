//! Packets with our system and component id that come over the autopilot's link: our own, which a router sends back, or those of another
//! companion, probably a second controller of the same vehicle.

use std::collections::BTreeMap;

use crate::conflict::Conflict;
use crate::dialect::MavMessage;
use crate::packet::{Packet, Sender};

/// Silence after which another companion with our ids counts as gone, in nanoseconds.
const GONE_NS: i64 = 10_000_000_000;
/// Time within which a packet of ours returns, in nanoseconds. One that returns later counts as another companion's: the longer the
/// time, the more packets of that one look like ours by chance.
const MAX_ECHO_NS: i64 = 2_000_000_000;

/// Detects another companion with our ids.
#[derive(Clone, Debug, Default)]
pub(crate) struct SameAddress {
    /// The last packet that we sent with each sequence number.
    sent: BTreeMap<u8, Sent>,
    other: Option<Other>,
}

#[derive(Copy, Clone, Debug, PartialEq, Eq)]
struct Sent {
    at_ns: i64,
    content: Content,
}

/// Distinguishes packets with one sequence number: the checksum covers the complete packet, from the header on.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
struct Content {
    length: usize,
    checksum: [u8; 2],
}

/// Another companion.
#[derive(Copy, Clone, Debug)]
struct Other {
    last_ns: i64,
    /// The message by which it is named: one that steers, if it has sent any.
    message: &'static str,
    steers: bool,
}

impl Content {
    fn of(raw: &[u8]) -> Option<Self> {
        Some(Self { length: raw.len(), checksum: *raw.last_chunk()? })
    }
}

impl SameAddress {
    /// We send this packet, which has no signature yet.
    pub(crate) fn sent(&mut self, now_ns: i64, sequence: u8, raw: &[u8]) {
        if let Some(content) = Content::of(raw) {
            self.sent.insert(sequence, Sent { at_ns: now_ns, content });
        }
    }

    /// Takes a packet with our ids; true for the first one of another companion.
    pub(crate) fn take(&mut self, now_ns: i64, packet: &Packet, message: &MavMessage) -> bool {
        if self.is_ours(now_ns, packet) {
            return false;
        }
        let before = self.other(now_ns);
        let steers = matches!(
            message,
            MavMessage::SET_POSITION_TARGET_LOCAL_NED(_) | MavMessage::LANDING_TARGET(_)
        );
        let name = packet.name().unwrap_or_default();
        let other = match before {
            Some(before) if before.steers && !steers => Other { last_ns: now_ns, ..before },
            _ => Other { last_ns: now_ns, message: name, steers },
        };
        self.other = Some(other);
        before.is_none()
    }

    /// Whether we sent this packet a moment ago.
    fn is_ours(&self, now_ns: i64, packet: &Packet) -> bool {
        let sent = self.sent.get(&packet.sequence);
        sent.is_some_and(|sent| {
            let age_ns = now_ns.saturating_sub(sent.at_ns);
            age_ns <= MAX_ECHO_NS && Some(sent.content) == Content::of(&packet.raw)
        })
    }

    fn other(&self, now_ns: i64) -> Option<Other> {
        self.other.filter(|other| now_ns.saturating_sub(other.last_ns) < GONE_NS)
    }

    /// Why no flight may begin: another companion has `sender`, our ids.
    pub(crate) fn conflict(&self, now_ns: i64, sender: Sender) -> Option<Conflict> {
        let Other { message, steers, .. } = self.other(now_ns)?;
        Some(match steers {
            true => Conflict::SecondController { sender, message },
            false => Conflict::SameAddress { sender, message },
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::compose;
    use crate::packet::{AUTOPILOT, Parser, encode};
    use geometry::Vector;

    const MS: i64 = 1_000_000;
    const OURS: Sender = Sender { system: 1, component: 191 };

    fn take(same: &mut SameAddress, now_ns: i64, raw: &[u8]) {
        let packet = Parser::new().push(raw).remove(0);
        let message = packet.message.clone().unwrap();
        same.take(now_ns, &packet, &message);
    }

    fn setpoint(sequence: u8, time_ms: u32) -> Vec<u8> {
        let target = Sender { system: 1, component: AUTOPILOT };
        encode(OURS, sequence, &compose::velocity(time_ms, Vector::zero(), 0.0, target))
    }

    #[test]
    fn our_packets_that_a_router_returns_are_not_another_controllers() {
        let mut same = SameAddress::default();
        for i in 0..1000_i64 {
            let raw = match i % 20 {
                0 => encode(OURS, i as u8, &MavMessage::HEARTBEAT(compose::heartbeat())),
                _ => setpoint(i as u8, (50 * i) as u32),
            };
            same.sent(i * 50 * MS, i as u8, &raw);
            // Some twice, all late.
            take(&mut same, i * 50 * MS + 900 * MS, &raw);
            if i % 7 == 0 {
                take(&mut same, i * 50 * MS + 1000 * MS, &raw);
            }
        }
        assert_eq!(same.conflict(50_000 * MS, OURS), None);
    }

    #[test]
    fn another_companion_with_our_ids_is_reported_to_steer_once_it_does() {
        let mut same = SameAddress::default();
        let heartbeat = encode(OURS, 7, &MavMessage::HEARTBEAT(compose::heartbeat()));
        same.sent(0, 7, &heartbeat);
        // Ours, much later.
        take(&mut same, 4000 * MS, &heartbeat);
        let reason =
            |same: &SameAddress, ms: i64| same.conflict(ms * MS, OURS).map(|it| it.to_string());
        let waits = reason(&same, 4001).unwrap();
        let parts = ["(1 and 191)", "HEARTBEAT", "no setpoints so far", "`autopilot.component_id`"];
        assert!(parts.iter().all(|part| waits.contains(part)), "{waits}");
        // A setpoint with the number of one of ours, and another content.
        same.sent(5000 * MS, 9, &setpoint(9, 5000));
        take(&mut same, 5001 * MS, &setpoint(9, 4990));
        take(&mut same, 5002 * MS, &heartbeat);
        let steers = reason(&same, 5003).unwrap();
        assert!(
            steers.contains("SET_POSITION_TARGET_LOCAL_NED") && steers.contains("End that one"),
            "{steers}"
        );
        assert_eq!(reason(&same, 15_003), None, "it has gone");
    }
}
