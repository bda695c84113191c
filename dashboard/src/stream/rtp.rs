//! Makes RTP packets of H.264 (RFC 3550, RFC 6184, packetisation mode 1).

use anyhow::Context;

/// Payload type: the first of those that are not assigned, which receivers expect for H.264.
const PAYLOAD_TYPE: u8 = 96;
/// Maximum size of a payload, in bytes, so that no network on the path fragments a packet.
const MAX_PAYLOAD: usize = 1200;
/// Type of a unit that contains a fragment of another one (FU-A).
const PART: u8 = 28;
/// Rate of the time stamps, in Hz.
const CLOCK_HZ: i128 = 90_000;

/// The time stamp of a picture; it wraps.
pub(super) fn time(taken_ns: i64) -> u32 {
    (i128::from(taken_ns) * CLOCK_HZ / 1_000_000_000) as u32
}

/// Makes the packets of one stream.
#[derive(Debug)]
pub(super) struct Packetizer {
    /// The stream's identifier (SSRC).
    source: u32,
    sequence: u16,
}

impl Packetizer {
    pub(super) fn new() -> anyhow::Result<Self> {
        let mut random = [0; 6];
        getrandom::fill(&mut random).context("asking the system for random bytes")?;
        let [a, b, c, d, e, f] = random;
        Ok(Self { source: u32::from_be_bytes([a, b, c, d]), sequence: u16::from_be_bytes([e, f]) })
    }

    /// The packets of a picture's units (NAL units, without start codes).
    pub(super) fn packets(&mut self, time: u32, units: &[Vec<u8>]) -> Vec<Vec<u8>> {
        let mut packets = Vec::new();
        for (index, unit) in units.iter().enumerate() {
            let is_last = index + 1 == units.len();
            let Some((&head, body)) = unit.split_first() else { continue };
            if unit.len() <= MAX_PAYLOAD {
                packets.push(self.packet(time, is_last, &[], unit));
                continue;
            }
            // The head's importance goes into the part's indicator, its type into the part's header.
            let parts = body.chunks(MAX_PAYLOAD - 2);
            let count = parts.len();
            for (number, part) in parts.enumerate() {
                let (is_first, is_end) = (number == 0, number + 1 == count);
                let indicator = (head & 0xe0) | PART;
                let header = (head & 0x1f) | (u8::from(is_first) << 7) | (u8::from(is_end) << 6);
                packets.push(self.packet(time, is_last && is_end, &[indicator, header], part));
            }
        }
        packets
    }

    /// One packet; the marker shows that the picture ends with it.
    fn packet(&mut self, time: u32, marker: bool, head: &[u8], payload: &[u8]) -> Vec<u8> {
        let mut packet = Vec::with_capacity(12 + head.len() + payload.len());
        packet.extend_from_slice(&[0x80, (u8::from(marker) << 7) | PAYLOAD_TYPE]);
        packet.extend_from_slice(&self.sequence.to_be_bytes());
        packet.extend_from_slice(&time.to_be_bytes());
        packet.extend_from_slice(&self.source.to_be_bytes());
        packet.extend_from_slice(head);
        packet.extend_from_slice(payload);
        self.sequence = self.sequence.wrapping_add(1);
        packet
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The units in packets, reassembled by RFC 6184, and the numbers of the packets with a marker.
    fn units_of(packets: &[Vec<u8>]) -> (Vec<Vec<u8>>, Vec<usize>) {
        let mut units: Vec<Vec<u8>> = Vec::new();
        for packet in packets {
            let payload = &packet[12..];
            if payload[0] & 0x1f != PART {
                units.push(payload.to_vec());
                continue;
            }
            if payload[1] & 0x80 != 0 {
                units.push(vec![(payload[0] & 0xe0) | (payload[1] & 0x1f)]);
            }
            units.last_mut().unwrap().extend_from_slice(&payload[2..]);
        }
        let marked = (0..packets.len()).filter(|at| packets[*at][1] & 0x80 != 0).collect();
        (units, marked)
    }

    #[test]
    fn a_picture_is_the_same_after_transmission() {
        let mut packetizer = Packetizer { source: 7, sequence: u16::MAX - 1 };
        for length in [1, 2, 1199, 1200, 1201, 1202, 2397, 2398, 9999] {
            let long: Vec<u8> = (0..length).map(|at| (at % 251) as u8 | 0x65).collect();
            let units = [vec![0x67, 1, 2], vec![0x68, 3], long];
            let first = packetizer.sequence;
            let packets = packetizer.packets(90_000, &units);
            assert!(packets.iter().all(|packet| packet.len() <= 12 + MAX_PAYLOAD), "{length}");
            let (found, marked) = units_of(&packets);
            assert_eq!(found, units, "{length}");
            assert_eq!(marked, [packets.len() - 1], "{length}");
            for (at, packet) in packets.iter().enumerate() {
                let sequence = first.wrapping_add(at as u16);
                assert_eq!(packet[2..4], sequence.to_be_bytes());
                assert_eq!(packet[..2], [0x80, if at + 1 == packets.len() { 0xe0 } else { 0x60 }]);
                assert_eq!(packet[4..12], [0, 1, 0x5f, 0x90, 0, 0, 0, 7]);
            }
        }
    }

    #[test]
    fn stamps_count_90_000_in_a_second_and_wrap() {
        assert_eq!(time(1_000_000_000), 90_000);
        assert_eq!(time(i64::MAX).wrapping_sub(time(i64::MAX - 1_000_000_000)), 90_000);
    }
}
