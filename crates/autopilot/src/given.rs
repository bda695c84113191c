//! Reads commands in packets of a ground station (number and recipient), and answers that one is not carried out.
//!
//! A ground station repeats a command until it is acknowledged, whatever its number is, and takes no acknowledgement but of the
//! component that the command was for.

use mavlink::{Message, MessageData, calculate_crc};

use crate::dialect::{
    COMMAND_ACK_DATA, COMMAND_INT_DATA, COMMAND_LONG_DATA, MavMessage, MavResult,
};
use crate::packet::{AUTOPILOT, Packet, Sender, encode};

/// Where both messages for commands have the number, the system and the component, in bytes of the payload.
const NUMBER: usize = 28;
const SYSTEM: usize = 30;
const COMPONENT: usize = 31;
/// Lengths of the header and the checksum of MAVLink 2, in bytes.
const HEADER: usize = 10;
const CHECKSUM: usize = 2;

/// A command in a packet, whether the dialect contains it or not.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct GivenCommand {
    /// Its number.
    pub number: u16,
    /// Its recipient.
    pub target: Sender,
}

impl GivenCommand {
    /// The command in a packet.
    pub fn of(packet: &Packet) -> Option<Self> {
        if ![COMMAND_INT_DATA::ID, COMMAND_LONG_DATA::ID].contains(&packet.message_id) {
            return None;
        }
        let payload = packet.payload();
        // Zeros at the end of a payload are not transmitted.
        let byte = |at: usize| payload.get(at).copied().unwrap_or(0);
        Some(Self {
            number: u16::from_le_bytes([byte(NUMBER), byte(NUMBER + 1)]),
            target: Sender { system: byte(SYSTEM), component: byte(COMPONENT) },
        })
    }

    /// The command in a packet, when its number is why the packet could not be decoded.
    pub fn unknown(packet: &Packet) -> Option<Self> {
        Self::of(packet).filter(|_| packet.message.is_none())
    }

    /// The packet that informs its sender that the command is not supported.
    pub fn unsupported(&self, sequence: u8, to: Sender) -> Vec<u8> {
        self.refused(MavResult::MAV_RESULT_UNSUPPORTED, sequence, to)
    }

    /// The packet that informs its sender that the command is not allowed; for one to all, as the autopilot of this system, if that
    /// is known.
    pub fn denied(&self, system: Option<u8>, sequence: u8, to: Sender) -> Vec<u8> {
        let Sender { system: to_system, component: to_component } = self.target;
        let system = if to_system == 0 { system.unwrap_or(0) } else { to_system };
        let component = if to_component == 0 { AUTOPILOT } else { to_component };
        let named = Self { target: Sender { system, component }, ..*self };
        named.refused(MavResult::MAV_RESULT_DENIED, sequence, to)
    }

    /// The acknowledgement with a result that is not zero.
    fn refused(&self, result: MavResult, sequence: u8, to: Sender) -> Vec<u8> {
        let answer = MavMessage::COMMAND_ACK(COMMAND_ACK_DATA {
            result,
            target_system: to.system,
            target_component: to.component,
            ..COMMAND_ACK_DATA::default()
        });
        let mut packet = encode(self.target, sequence, &answer);
        // The number is the first field of the acknowledgement, and the result behind it is never zero.
        packet.iter_mut().skip(HEADER).zip(self.number.to_le_bytes()).for_each(|(to, of)| *to = of);
        let end = packet.len().saturating_sub(CHECKSUM);
        let checked = packet.get(1..end).unwrap_or_default();
        let checksum = calculate_crc(checked, MavMessage::extra_crc(COMMAND_ACK_DATA::ID));
        packet.truncate(end);
        packet.extend(checksum.to_le_bytes());
        packet
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dialect::MavCmd;
    use crate::packet::Parser;

    const GROUND: Sender = Sender { system: 255, component: 190 };
    const CAMERA: Sender = Sender { system: 7, component: 100 };

    /// A command with a number of no dialect.
    fn asked(number: u16) -> Packet {
        let command = MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
            param1: 1.0,
            confirmation: 1,
            target_system: CAMERA.system,
            target_component: CAMERA.component,
            ..COMMAND_LONG_DATA::default()
        });
        let mut raw = encode(GROUND, 0, &command);
        raw[HEADER + NUMBER..HEADER + NUMBER + 2].copy_from_slice(&number.to_le_bytes());
        let end = raw.len() - CHECKSUM;
        let checksum = calculate_crc(&raw[1..end], MavMessage::extra_crc(COMMAND_LONG_DATA::ID));
        raw[end..].copy_from_slice(&checksum.to_le_bytes());
        Parser::new().push(&raw).remove(0)
    }

    #[test]
    fn a_command_of_an_unknown_number_is_answered_with_that_number() {
        let packet = asked(60_123);
        assert_eq!(packet.message, None);
        let unknown = GivenCommand::unknown(&packet).unwrap();
        assert_eq!(unknown, GivenCommand { number: 60_123, target: CAMERA });
        let answer = Parser::new().push(&unknown.unsupported(9, GROUND)).remove(0);
        assert_eq!((answer.sender, answer.sequence, answer.message_id), (CAMERA, 9, 77));
        // Number, result, and after progress and the second result the recipient.
        assert_eq!(answer.payload()[..3], [0xDB, 0xEA, 3]);
        assert_eq!(answer.payload()[8..], [255, 190]);
    }

    #[test]
    fn the_answer_has_the_bytes_of_one_to_a_known_command() {
        let number = MavCmd::MAV_CMD_REQUEST_MESSAGE as u16;
        let given = GivenCommand { number, target: CAMERA };
        let known = MavMessage::COMMAND_ACK(COMMAND_ACK_DATA {
            command: MavCmd::MAV_CMD_REQUEST_MESSAGE,
            result: MavResult::MAV_RESULT_UNSUPPORTED,
            target_system: GROUND.system,
            target_component: GROUND.component,
            ..COMMAND_ACK_DATA::default()
        });
        assert_eq!(given.unsupported(3, GROUND), encode(CAMERA, 3, &known));
        assert_eq!(GivenCommand::of(&asked(number)), Some(given));
        assert_eq!(GivenCommand::unknown(&asked(number)), None);
    }

    #[test]
    fn the_answer_to_a_command_to_all_is_the_autopilots() {
        let to_all = GivenCommand { number: 400, target: Sender { system: 0, component: 0 } };
        let answer = Parser::new().push(&to_all.denied(Some(7), 0, GROUND)).remove(0);
        assert_eq!(answer.sender, Sender { system: 7, component: AUTOPILOT });
        let Some(MavMessage::COMMAND_ACK(answer)) = answer.message else { panic!("no answer") };
        assert_eq!(answer.command, MavCmd::MAV_CMD_COMPONENT_ARM_DISARM);
        assert_eq!(answer.result, MavResult::MAV_RESULT_DENIED);
    }
}
