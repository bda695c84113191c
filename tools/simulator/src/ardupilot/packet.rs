//! Packets with the extension fields of MAVLink 2, which the dialect's types leave out.

use autopilot::Sender;
use autopilot::dialect::{MavMessage, MavResult, MavSeverity, Message};

/// Longest text of one STATUSTEXT.
const TEXT: usize = 50;

/// A MAVLink 2 packet with this payload (<https://mavlink.io/en/guide/serialization.html>).
pub(super) fn packet(sender: Sender, sequence: u8, message_id: u32, payload: &[u8]) -> Vec<u8> {
    let zeros = payload.iter().rev().take_while(|byte| **byte == 0).count();
    let length = (payload.len() - zeros).clamp(1, 255);
    let [id0, id1, id2, _] = message_id.to_le_bytes();
    let mut raw =
        vec![0xFD, length as u8, 0, 0, sequence, sender.system, sender.component, id0, id1, id2];
    raw.extend(payload.iter().copied().chain(std::iter::repeat(0)).take(length));
    let extra = MavMessage::extra_crc(message_id);
    let checksum =
        raw.iter().skip(1).chain([&extra]).fold(0xFFFF, |sum, byte| accumulate(sum, *byte));
    raw.extend_from_slice(&checksum.to_le_bytes());
    raw
}

/// CRC-16/MCRF4XX.
fn accumulate(sum: u16, byte: u8) -> u16 {
    let mut low = byte ^ (sum as u8);
    low ^= low << 4;
    let low = u16::from(low);
    (sum >> 8) ^ (low << 8) ^ (low << 3) ^ (low >> 4)
}

/// The payload of COMMAND_ACK, for any command number, addressed to whoever sent the command.
pub(super) fn acknowledgement(command: u16, result: MavResult, to: Sender) -> Vec<u8> {
    let mut payload = command.to_le_bytes().to_vec();
    payload.push(result as u8);
    payload.extend_from_slice(&[0; 5]);
    payload.extend_from_slice(&[to.system, to.component]);
    payload
}

/// The payloads of the STATUSTEXTs that carry one text: a long one comes in numbered parts.
pub(super) fn texts(severity: MavSeverity, text: &str, id: u16) -> Vec<Vec<u8>> {
    let parts: Vec<&[u8]> = text.as_bytes().chunks(TEXT).collect();
    let id = if parts.len() > 1 { id } else { 0 };
    let payload = |(number, part): (usize, &&[u8])| {
        let mut payload = vec![severity as u8];
        payload.extend(part.iter().copied().chain(std::iter::repeat(0)).take(TEXT));
        payload.extend_from_slice(&id.to_le_bytes());
        payload.push(number as u8);
        payload
    };
    parts.iter().enumerate().map(payload).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use autopilot::Parser;
    use autopilot::frame::encode;

    const SENDER: Sender = Sender { system: 1, component: 1 };

    #[test]
    fn a_packet_is_the_one_that_the_dialect_makes() {
        let message = MavMessage::default_message_from_id(30).unwrap();
        let mut payload = vec![0; 28];
        payload[3] = 1;
        let raw = packet(SENDER, 7, 30, &payload);
        let frames = Parser::new().push(&raw);
        assert_eq!(frames.len(), 1);
        assert_eq!((frames[0].sequence, frames[0].message_id), (7, 30));
        assert_eq!(packet(SENDER, 7, 30, &[0; 28]), encode(SENDER, 7, &message));
    }

    #[test]
    fn a_long_text_comes_in_two_parts() {
        let text = "AHRS: EKF3 Yaw inconsistent 77 deg. Wait or reboot the thing";
        let parts = texts(MavSeverity::MAV_SEVERITY_CRITICAL, text, 9);
        assert_eq!(parts.len(), 2);
        assert_eq!(parts[1][1..].iter().position(|b| *b == 0), Some(text.len() - 50));
        assert_eq!((parts[0][51], parts[0][53], parts[1][53]), (9, 0, 1));
        assert_eq!(texts(MavSeverity::MAV_SEVERITY_INFO, "short", 9)[0][51], 0);
    }
}
