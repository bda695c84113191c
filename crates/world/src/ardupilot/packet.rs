//! Composes messages that need more than the dialect's types: texts in parts, and acknowledgements of any number.

use autopilot::Sender;
use autopilot::dialect::{
    COMMAND_ACK_DATA, MavMessage, MavResult, MavSeverity, Message, STATUSTEXT_DATA, calculate_crc,
};
use autopilot::packet::encode;

/// Longest text of one STATUSTEXT.
const TEXT: usize = 50;
/// Where the payload of a MAVLink 2 packet begins.
const PAYLOAD: usize = 10;

/// The acknowledgement of any command number, also one that the dialect does not define, addressed to the
/// sender.
pub(super) fn acknowledgement(
    sender: Sender,
    sequence: u8,
    command: u16,
    result: MavResult,
    to: Sender,
) -> Vec<u8> {
    let message = MavMessage::COMMAND_ACK(COMMAND_ACK_DATA {
        result,
        target_system: to.system,
        target_component: to.component,
        ..COMMAND_ACK_DATA::default()
    });
    let mut raw = encode(sender, sequence, &message);
    let end = raw.len().saturating_sub(2);
    raw.truncate(end);
    for (byte, number) in raw.iter_mut().skip(PAYLOAD).zip(command.to_le_bytes()) {
        *byte = number;
    }
    let extra = MavMessage::extra_crc(message.message_id());
    let checksum = calculate_crc(raw.get(1..).unwrap_or(&[]), extra);
    raw.extend_from_slice(&checksum.to_le_bytes());
    raw
}

/// The STATUSTEXTs that carry one text: a long one comes in numbered parts.
pub(super) fn texts(severity: MavSeverity, text: &str, id: u16) -> Vec<MavMessage> {
    let parts: Vec<&[u8]> = text.as_bytes().chunks(TEXT).collect();
    let id = if parts.len() > 1 { id } else { 0 };
    let message = |(number, part): (usize, &&[u8])| {
        let mut text = [0; TEXT];
        for (to, from) in text.iter_mut().zip(part.iter()) {
            *to = *from;
        }
        MavMessage::STATUSTEXT(STATUSTEXT_DATA {
            severity,
            text: text.into(),
            id,
            chunk_seq: number as u8,
        })
    };
    parts.iter().enumerate().map(message).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use autopilot::Parser;

    const ME: Sender = Sender { system: 1, component: 1 };
    const OTHER: Sender = Sender { system: 255, component: 190 };

    #[test]
    fn an_acknowledgement_is_a_right_packet_for_any_number() {
        for command in [0_u16, 11, 22, 400, 65535] {
            let raw = acknowledgement(ME, 7, command, MavResult::MAV_RESULT_FAILED, OTHER);
            let packets = Parser::new().push(&raw);
            assert_eq!(packets.len(), 1, "{command}");
            assert_eq!((packets[0].sequence, packets[0].message_id), (7, 77));
            let mut expected = command.to_le_bytes().to_vec();
            expected.extend_from_slice(&[4, 0, 0, 0, 0, 0, 255, 190]);
            assert_eq!(packets[0].payload(), expected);
        }
    }

    #[test]
    fn a_long_text_comes_in_numbered_parts() {
        let text = "AHRS: EKF3 Yaw inconsistent 77 deg. Wait or reboot the thing";
        let critical = MavSeverity::MAV_SEVERITY_CRITICAL;
        let parts: Vec<(String, u16, u8)> = texts(critical, text, 9)
            .into_iter()
            .map(|part| match part {
                MavMessage::STATUSTEXT(part) => {
                    (part.text.to_str().unwrap().to_owned(), part.id, part.chunk_seq)
                }
                other => panic!("{other:?}"),
            })
            .collect();
        let (first, second) = text.split_at(50);
        assert_eq!(parts, [(first.to_owned(), 9, 0), (second.to_owned(), 9, 1)]);
        let short = texts(critical, "short", 9);
        assert!(matches!(&short[..], [MavMessage::STATUSTEXT(part)] if part.id == 0));
    }
}
