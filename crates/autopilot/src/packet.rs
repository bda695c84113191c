//! MAVLink packets in a stream of bytes: found, checked and decoded, or made.
//!
//! The packet formats and the checksum are those of <https://mavlink.io/en/guide/serialization.html>.

use mavlink::{MavlinkVersion, Message};

use crate::dialect::MavMessage;

const START_V1: u8 = 0xFE;
const START_V2: u8 = 0xFD;
const HEADER_V1: usize = 6;
const HEADER_V2: usize = 10;
const CHECKSUM: usize = 2;
const SIGNATURE: usize = 13;
const SIGNED: u8 = 0x01;
/// Longest packet: version 2 with 255 bytes of payload and a signature.
pub const MAX_PACKET: usize = HEADER_V2 + 255 + CHECKSUM + SIGNATURE;

/// How much is looked at in one go, so that a huge input does not make a huge buffer.
const PIECE: usize = 4096;
/// Senders whose packets of unknown kind are passed on.
const MAX_SENDERS: usize = 32;

/// Who sends a packet.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash)]
pub struct Sender {
    /// System number: 1 is the first vehicle, 255 the usual ground station.
    pub system: u8,
    /// Component number: 1 is the autopilot, 190 a ground station, 191 a companion computer.
    pub component: u8,
}

/// One packet whose checksum is right, or whose kind is unknown and whose shape is plausible.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// The packet as it was received, from start byte to checksum or signature.
    pub raw: Vec<u8>,
    /// Who sent it.
    pub sender: Sender,
    /// The sender's packet counter.
    pub sequence: u8,
    /// Which message it is.
    pub message_id: u32,
    /// The decoded message; `None` when the dialect does not know its number or one of its values.
    pub message: Option<MavMessage>,
}

/// What a parser has seen so far.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Packets passed on.
    pub frames: u64,
    /// Bytes that belong to no packet.
    pub bad_bytes: u64,
    /// Places that looked like a packet of a known kind but had a wrong checksum.
    pub bad_checksums: u64,
    /// Packets of a kind that the dialect does not know, passed on as they are.
    pub unknown_ids: u64,
    /// Packets with a right checksum and a value the dialect does not know, passed on as they are.
    pub undecodable: u64,
}

/// Finds packets of MAVLink 1 and 2 in any stream of bytes, and loses none to the noise around them.
///
/// It keeps at most one incomplete packet, so it neither grows nor needs the bytes in whole packets.
#[derive(Clone, Debug, Default)]
pub struct Parser {
    buffer: Vec<u8>,
    senders: Vec<Sender>,
    counters: Counters,
}

impl Counters {
    pub(crate) fn add(&mut self, more: Self) {
        self.frames += more.frames;
        self.bad_bytes += more.bad_bytes;
        self.bad_checksums += more.bad_checksums;
        self.unknown_ids += more.unknown_ids;
        self.undecodable += more.undecodable;
    }
}

impl Parser {
    /// A parser that has seen nothing.
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes bytes as they come and returns the packets that they complete.
    pub fn push(&mut self, bytes: &[u8]) -> Vec<Frame> {
        let mut frames = Vec::new();
        for piece in bytes.chunks(PIECE) {
            self.buffer.extend_from_slice(piece);
            self.scan(&mut frames, false);
        }
        frames
    }

    /// Says that nothing follows (the line went quiet, the log ended): what is incomplete is noise, and the packets
    /// that hid behind it are returned.
    pub fn finish(&mut self) -> Vec<Frame> {
        let mut frames = Vec::new();
        self.scan(&mut frames, true);
        frames
    }

    /// True while the beginning of a packet waits for its end.
    pub fn is_waiting(&self) -> bool {
        !self.buffer.is_empty()
    }

    /// What was seen so far.
    pub fn counters(&self) -> Counters {
        self.counters
    }

    /// What was seen since this was asked last.
    pub(crate) fn take_counters(&mut self) -> Counters {
        std::mem::take(&mut self.counters)
    }

    fn scan(&mut self, frames: &mut Vec<Frame>, last: bool) {
        let mut at = 0;
        while let Some(rest) = self.buffer.get(at..).filter(|rest| !rest.is_empty()) {
            match look(rest, &self.senders) {
                Verdict::Packet(shape) => {
                    let Some(raw) = rest.get(..shape.length) else { break };
                    let frame = decode(raw, &shape);
                    at += shape.length;
                    self.count(&frame, shape.known);
                    frames.push(frame);
                }
                Verdict::Incomplete if !last => break,
                verdict => {
                    // Only the start byte is given up: a good packet may begin right behind it.
                    self.counters.bad_checksums +=
                        u64::from(matches!(verdict, Verdict::BadChecksum));
                    self.counters.bad_bytes += 1;
                    at += 1;
                }
            }
        }
        self.buffer.drain(..at.min(self.buffer.len()));
    }

    fn count(&mut self, frame: &Frame, known: bool) {
        self.counters.frames += 1;
        if !known {
            self.counters.unknown_ids += 1;
        } else if frame.message.is_none() {
            self.counters.undecodable += 1;
        }
        if known && !self.senders.contains(&frame.sender) {
            if self.senders.len() >= MAX_SENDERS {
                self.senders.remove(0);
            }
            self.senders.push(frame.sender);
        }
    }
}

impl Frame {
    /// The message's fields as they were sent; version 2 leaves out nought bytes at the end.
    pub fn payload(&self) -> &[u8] {
        let header = if self.is_v2() { HEADER_V2 } else { HEADER_V1 };
        let length = self.raw.get(1).copied().unwrap_or(0).into();
        self.raw.get(header..).and_then(|rest| rest.get(..length)).unwrap_or(&[])
    }

    /// True for MAVLink 2.
    pub fn is_v2(&self) -> bool {
        self.raw.first() == Some(&START_V2)
    }

    /// The message's name, `None` when the dialect does not know it.
    pub fn name(&self) -> Option<&'static str> {
        self.message.as_ref().map(Message::message_name)
    }
}

/// Makes the MAVLink 2 packet that carries `message`.
pub fn encode(sender: Sender, sequence: u8, message: &MavMessage) -> Vec<u8> {
    let mut payload = [0_u8; 255];
    let length = message.ser(MavlinkVersion::V2, &mut payload).min(payload.len());
    let [id0, id1, id2, _] = message.message_id().to_le_bytes();
    let mut raw = Vec::with_capacity(HEADER_V2 + length + CHECKSUM);
    raw.extend_from_slice(&[START_V2, length as u8, 0, 0]);
    raw.extend_from_slice(&[sequence, sender.system, sender.component, id0, id1, id2]);
    raw.extend_from_slice(payload.get(..length).unwrap_or(&[]));
    let crc = raw.iter().skip(1).copied().fold(CRC_START, crc_step);
    let crc = crc_step(crc, MavMessage::extra_crc(message.message_id()));
    raw.extend_from_slice(&crc.to_le_bytes());
    raw
}

/// Where a packet's parts are.
#[derive(Copy, Clone)]
struct Shape {
    v2: bool,
    header: usize,
    payload: usize,
    length: usize,
    sender: Sender,
    sequence: u8,
    id: u32,
    known: bool,
}

enum Verdict {
    Packet(Shape),
    Incomplete,
    Noise,
    BadChecksum,
}

/// Judges whether a packet begins at the first byte.
fn look(bytes: &[u8], senders: &[Sender]) -> Verdict {
    let shape = match shape(bytes) {
        Ok(shape) => shape,
        Err(verdict) => return verdict,
    };
    let checked = shape.header + shape.payload;
    let (Some(covered), Some(&[low, high])) =
        (bytes.get(1..checked), bytes.get(checked..).and_then(|rest| rest.first_chunk()))
    else {
        return Verdict::Incomplete;
    };
    if bytes.len() < shape.length {
        return Verdict::Incomplete;
    }
    let sent = u16::from_le_bytes([low, high]);
    let crc = covered.iter().copied().fold(CRC_START, crc_step);
    if shape.known {
        let right = crc_step(crc, MavMessage::extra_crc(shape.id)) == sent;
        return if right { Verdict::Packet(shape) } else { Verdict::BadChecksum };
    }
    // The checksum of an unknown kind contains a byte that is not sent. It is believed when some value of that byte
    // fits, its sender is known from checked packets, and what follows begins a packet or has not come yet.
    let follows = bytes.get(shape.length).is_none_or(|next| [START_V1, START_V2].contains(next));
    let fits = follows
        && senders.contains(&shape.sender)
        && (0..=u8::MAX).any(|extra| crc_step(crc, extra) == sent);
    if fits { Verdict::Packet(shape) } else { Verdict::Noise }
}

/// Reads the header at the first byte.
fn shape(bytes: &[u8]) -> Result<Shape, Verdict> {
    match *bytes {
        [START_V1, payload, sequence, system, component, id, ..] => {
            let header = HEADER_V1;
            let payload = payload.into();
            let sender = Sender { system, component };
            let id = id.into();
            let length = header + payload + CHECKSUM;
            Ok(Shape {
                v2: false,
                header,
                payload,
                length,
                sender,
                sequence,
                id,
                known: is_known(id),
            })
        }
        [START_V2, payload, flags, _, sequence, system, component, id0, id1, id2, ..] => {
            // A receiver must refuse incompatible features that it does not know; signing is the only one it knows.
            if flags & !SIGNED != 0 {
                return Err(Verdict::Noise);
            }
            let header = HEADER_V2;
            let payload = payload.into();
            let sender = Sender { system, component };
            let id = u32::from_le_bytes([id0, id1, id2, 0]);
            let signature = if flags & SIGNED != 0 { SIGNATURE } else { 0 };
            let length = header + payload + CHECKSUM + signature;
            Ok(Shape {
                v2: true,
                header,
                payload,
                length,
                sender,
                sequence,
                id,
                known: is_known(id),
            })
        }
        [START_V2, _, flags, ..] if flags & !SIGNED != 0 => Err(Verdict::Noise),
        [START_V1 | START_V2, ..] => Err(Verdict::Incomplete),
        _ => Err(Verdict::Noise),
    }
}

fn decode(raw: &[u8], shape: &Shape) -> Frame {
    let version = if shape.v2 { MavlinkVersion::V2 } else { MavlinkVersion::V1 };
    let payload = raw.get(shape.header..shape.header + shape.payload).unwrap_or(&[]);
    let message =
        if shape.known { MavMessage::parse(version, shape.id, payload).ok() } else { None };
    Frame {
        raw: raw.to_vec(),
        sender: shape.sender,
        sequence: shape.sequence,
        message_id: shape.id,
        message,
    }
}

/// The dialect lists its message numbers in ascending order (a test checks it).
fn is_known(id: u32) -> bool {
    MavMessage::all_ids().binary_search(&id).is_ok()
}

const CRC_START: u16 = 0xFFFF;

/// One byte of the X.25 checksum (CRC-16/MCRF4XX).
fn crc_step(crc: u16, byte: u8) -> u16 {
    let mut mixed = byte ^ (crc & 0xFF) as u8;
    mixed ^= mixed << 4;
    let mixed = u16::from(mixed);
    (crc >> 8) ^ (mixed << 8) ^ (mixed << 3) ^ (mixed >> 4)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dialect::{ATTITUDE_DATA, HEARTBEAT_DATA, STATUSTEXT_DATA};
    use proptest::prelude::*;
    use proptest::test_runner::RngSeed;

    const AUTOPILOT: Sender = Sender { system: 1, component: 1 };

    fn message(kind: u8) -> MavMessage {
        match kind % 3 {
            0 => MavMessage::HEARTBEAT(HEARTBEAT_DATA::default()),
            1 => MavMessage::ATTITUDE(ATTITUDE_DATA { roll: 0.1, yaw: -3.0, ..Default::default() }),
            _ => MavMessage::STATUSTEXT(STATUSTEXT_DATA {
                text: "a text with \u{fd} in it".into(),
                ..Default::default()
            }),
        }
    }

    /// The same packet as MAVLink 1, written by hand because only version 2 is ever sent.
    fn encode_v1(sequence: u8, message: &MavMessage) -> Vec<u8> {
        let mut payload = [0; 255];
        let length = message.ser(MavlinkVersion::V1, &mut payload);
        let id = message.message_id() as u8;
        let mut raw = vec![START_V1, length as u8, sequence, 1, 1, id];
        raw.extend_from_slice(&payload[..length]);
        let extra = MavMessage::extra_crc(id.into());
        raw.extend_from_slice(&mavlink::calculate_crc(&raw[1..], extra).to_le_bytes());
        raw
    }

    fn unknown(id: u32, sender: Sender) -> Vec<u8> {
        let [id0, id1, id2, _] = id.to_le_bytes();
        let mut raw =
            vec![START_V2, 3, 0, 0, 7, sender.system, sender.component, id0, id1, id2, 1, 2, 3];
        let crc = mavlink::calculate_crc(&raw[1..], 77);
        raw.extend_from_slice(&crc.to_le_bytes());
        raw
    }

    #[derive(Clone, Debug)]
    enum Item {
        Good(Vec<u8>),
        Bad(Vec<u8>),
    }

    fn item() -> impl Strategy<Value = Item> {
        let packet = (any::<u8>(), any::<u8>(), any::<bool>()).prop_map(|(sequence, kind, v1)| {
            let message = message(kind);
            if v1 { encode_v1(sequence, &message) } else { encode(AUTOPILOT, sequence, &message) }
        });
        let start = prop_oneof![Just(START_V1), Just(START_V2), any::<u8>()];
        prop_oneof![
            4 => packet.clone().prop_map(Item::Good),
            2 => prop::collection::vec(start, 0..40).prop_map(Item::Bad),
            1 => (packet.clone(), any::<prop::sample::Index>()).prop_map(|(mut raw, cut)| {
                raw.truncate(cut.index(raw.len()));
                Item::Bad(raw)
            }),
            1 => (packet, any::<prop::sample::Index>(), 1..=255_u8).prop_map(|(mut raw, at, flip)| {
                let at = at.index(raw.len());
                raw[at] ^= flip;
                Item::Bad(raw)
            }),
        ]
    }

    proptest! {
        // One in 65536 damaged packets has a right checksum by chance; a fixed seed keeps that out of the test.
        #![proptest_config(ProptestConfig { cases: 400, rng_seed: RngSeed::Fixed(7), ..Default::default() })]

        #[test]
        fn every_good_packet_is_found_whatever_surrounds_it(
            items in prop::collection::vec(item(), 0..30),
            pieces in prop::collection::vec(1..300_usize, 1..20),
        ) {
            let mut stream = Vec::new();
            let mut good = Vec::new();
            for item in items {
                match item {
                    Item::Good(raw) => {
                        stream.extend_from_slice(&raw);
                        good.push(raw);
                    }
                    Item::Bad(raw) => stream.extend_from_slice(&raw),
                }
            }
            let mut parser = Parser::new();
            let mut found = Vec::new();
            let mut rest = stream.as_slice();
            for piece in pieces.iter().cycle() {
                let (now, later) = rest.split_at((*piece).min(rest.len()));
                found.extend(parser.push(now));
                prop_assert!(parser.buffer.len() <= MAX_PACKET);
                rest = later;
                if rest.is_empty() { break; }
            }
            found.extend(parser.finish());
            prop_assert!(!parser.is_waiting());
            let bytes: usize = found.iter().map(|frame| frame.raw.len()).sum();
            prop_assert_eq!(bytes as u64 + parser.counters().bad_bytes, stream.len() as u64);
            let mut found = found.iter();
            for raw in &good {
                prop_assert!(found.any(|frame| &frame.raw == raw), "a good packet was lost");
            }
        }

        #[test]
        fn no_payload_of_any_known_message_panics(
            kind in any::<prop::sample::Index>(), payload in prop::collection::vec(any::<u8>(), 0..=255),
        ) {
            let id = *kind.get(MavMessage::all_ids());
            let [id0, id1, id2, _] = id.to_le_bytes();
            let mut raw = vec![START_V2, payload.len() as u8, 0, 0, 0, 1, 1, id0, id1, id2];
            raw.extend_from_slice(&payload);
            let crc = mavlink::calculate_crc(&raw[1..], MavMessage::extra_crc(id));
            raw.extend_from_slice(&crc.to_le_bytes());
            let frames = Parser::new().push(&raw);
            prop_assert_eq!(frames.len(), 1);
            prop_assert_eq!(frames[0].payload(), payload.as_slice());
        }
    }

    #[test]
    fn the_dialect_lists_its_messages_in_ascending_order() {
        assert!(MavMessage::all_ids().is_sorted());
    }

    #[test]
    fn what_is_encoded_is_decoded() {
        for kind in 0..3 {
            let sender = Sender { system: 7, component: 191 };
            let raw = encode(sender, 200, &message(kind));
            let frames = Parser::new().push(&raw);
            assert_eq!(frames.len(), 1);
            assert_eq!(frames[0].sender, sender);
            assert_eq!(frames[0].sequence, 200);
            assert_eq!(frames[0].raw, raw);
            assert_eq!(frames[0].message, Some(message(kind)));
        }
    }

    #[test]
    fn an_unknown_message_of_a_known_sender_is_passed_on_as_it_is() {
        let mut parser = Parser::new();
        let raw = unknown(9_999_999, AUTOPILOT);
        assert!(parser.push(&raw).is_empty(), "its sender is not known yet");
        parser.push(&encode(AUTOPILOT, 0, &message(0)));
        let frames = parser.push(&raw);
        assert_eq!(frames.len(), 1);
        assert_eq!((frames[0].message_id, &frames[0].message), (9_999_999, &None));
        assert_eq!(frames[0].raw, raw);
        assert_eq!(parser.counters().unknown_ids, 1);
        assert!(parser.push(&unknown(9_999_999, Sender { system: 9, component: 9 })).is_empty());
    }

    #[test]
    fn a_signed_packet_keeps_its_signature() {
        let mut raw = encode(AUTOPILOT, 3, &message(1));
        raw.truncate(raw.len() - CHECKSUM);
        raw[2] = SIGNED;
        let crc = mavlink::calculate_crc(&raw[1..], MavMessage::extra_crc(30));
        raw.extend_from_slice(&crc.to_le_bytes());
        raw.extend_from_slice(&[0xFD; SIGNATURE]);
        let mut parser = Parser::new();
        let (head, tail) = raw.split_at(raw.len() - 1);
        assert!(parser.push(head).is_empty());
        let frames = parser.push(tail);
        assert_eq!(frames[0].raw, raw);
        assert_eq!(frames[0].message, Some(message(1)));
        assert_eq!(parser.counters().bad_bytes, 0);
    }

    #[test]
    fn text_in_front_of_the_first_packet_is_skipped() {
        let mut parser = Parser::new();
        let mut stream = b"Init ArduCopter V4.5.4\r\n\xFE\xFD".to_vec();
        stream.extend(encode(AUTOPILOT, 0, &message(0)));
        assert!(parser.push(&stream).len() + parser.finish().len() == 1);
        assert_eq!(parser.counters().bad_bytes, 26);
    }
}
