//! Signs and verifies packets of MAVLink 2 (<https://mavlink.io/en/guide/message_signing.html>). Without the key a sender can neither
//! make a packet nor replay an old one, except those of the last minute before this side was started, which the standard allows.
//!
//! A signature is 13 bytes behind the checksum: a link id, a stamp of 48 bits in units of 10 µs since 2015, and the first
//! 48 bits of SHA-256 over the key and the packet. Stamps only grow: a sender takes the later of its clock and the
//! newest stamp that it has sent or accepted, so that one whose clock is wrong is still accepted by its
//! peers.

use std::fmt;
use std::str::FromStr;
use std::time::Duration;

use sha2::{Digest, Sha256};
use subtle::ConstantTimeEq;

use crate::dialect::{MessageData, RADIO_STATUS_DATA};
use crate::packet::{Packet, SIGNATURE, SIGNED, Sender, reframe};

/// Bytes of a key.
const KEY: usize = 32;
/// Bytes of link id and stamp at the beginning of a signature.
const STAMPED: usize = 7;
/// Minimum and maximum number of characters of a passphrase.
const PASSPHRASE: std::ops::RangeInclusive<usize> = 8..=256;
/// Begin of the stamps, 2015-01-01 00:00 UTC, in seconds since 1970.
const EPOCH_S: u64 = 1_420_070_400;
/// Units of a stamp in a second.
const PER_S: u64 = 100_000;
/// By how much the first stamp of a stream may be behind ours: one minute, as MAVLink demands.
const MAX_BEHIND: u64 = 60 * PER_S;
/// The last stamp.
const MAX_STAMP: u64 = (1 << 48) - 1;
/// Maximum number of streams (link, system and component) of the holders of the key.
const MAX_STREAMS: usize = 32;
/// Messages that a radio adds to the line on its own, without a key, and on which no receiver acts.
const OF_RADIO: u32 = RADIO_STATUS_DATA::ID;

/// The stamp of a time since 1970; 0 before 2015.
pub fn stamp(since_1970: Duration) -> u64 {
    let since_2015 = since_1970.saturating_sub(Duration::from_secs(EPOCH_S));
    u64::try_from(since_2015.as_micros() / 10).unwrap_or(MAX_STAMP).min(MAX_STAMP)
}

/// A secret key.
#[derive(Clone)]
pub struct Key([u8; KEY]);

/// A text that is no key.
#[derive(Copy, Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "neither 64 hexadecimal digits nor a passphrase of {} to {} characters in one line",
    PASSPHRASE.start(),
    PASSPHRASE.end()
)]
pub struct NotAKey;

impl FromStr for Key {
    type Err = NotAKey;

    /// The key that 64 hexadecimal digits are, or the SHA-256 of any other text, as QGroundControl, Mission Planner and
    /// MAVProxy make it from a passphrase. White space around it does not count.
    fn from_str(text: &str) -> Result<Self, NotAKey> {
        let text = text.trim();
        if let Some(key) = from_hex(text) {
            return Ok(Self(key));
        }
        if text.contains(char::is_control) || !PASSPHRASE.contains(&text.chars().count()) {
            return Err(NotAKey);
        }
        Ok(Self(Sha256::digest(text).into()))
    }
}

impl fmt::Debug for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Key(secret)")
    }
}

fn from_hex(text: &str) -> Option<[u8; KEY]> {
    let mut key = [0; KEY];
    if text.len() != 2 * KEY || !text.bytes().all(|byte| byte.is_ascii_hexdigit()) {
        return None;
    }
    for (at, byte) in key.iter_mut().enumerate() {
        *byte = u8::from_str_radix(text.get(2 * at..2 * at + 2)?, 16).ok()?;
    }
    Some(key)
}

/// Why a packet is refused.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// It has no signature.
    Unsigned,
    /// Its signature is of another key, or it was changed on the way.
    WrongKey,
    /// Its stamp is not after that of the stream's last packet, or it is our own: it was sent before.
    Replayed,
    /// The first packet of a stream is more than a minute behind.
    Old,
    /// There are too many streams.
    TooManyStreams,
}

impl Refusal {
    /// All reasons.
    pub const ALL: [Self; 5] =
        [Self::Unsigned, Self::WrongKey, Self::Replayed, Self::Old, Self::TooManyStreams];

    /// Its name for counters.
    pub fn name(self) -> &'static str {
        match self {
            Self::Unsigned => "not signed",
            Self::WrongKey => "signed with another key",
            Self::Replayed => "signed, but sent before",
            Self::Old => "signed, but more than a minute old",
            Self::TooManyStreams => "signed, but of too many senders",
        }
    }

    /// The remedy.
    pub fn advice(self) -> &'static str {
        match self {
            Self::Unsigned => "give the other side the same key, or take `signing_key` away here",
            Self::WrongKey => "the other side must have the key of the file `signing_key`",
            Self::Replayed => {
                "a copy of an earlier packet: two paths to the same peer, or an attack"
            }
            Self::Old => {
                "the other side's clock is more than a minute behind; it catches up with ours"
            }
            Self::TooManyStreams => "too many systems and components sign with this key",
        }
    }
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// How many packets were refused for each reason.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq)]
pub struct Refusals([u64; Refusal::ALL.len()]);

impl Refusals {
    /// Number of packets refused for this reason.
    pub fn of(&self, reason: Refusal) -> u64 {
        self.0[reason as usize]
    }

    /// The reasons for which more packets were refused than `earlier`, and how many.
    pub fn since(self, earlier: Self) -> impl Iterator<Item = (Refusal, u64)> {
        let more = move |it| self.of(it).saturating_sub(earlier.of(it));
        Refusal::ALL.into_iter().map(move |it| (it, more(it))).filter(|(_, more)| *more > 0)
    }

    pub(crate) fn count(&mut self, reason: Refusal) {
        self.0[reason as usize] += 1;
    }
}

/// One leg of the path: signs sent packets, and verifies received ones.
#[derive(Debug)]
pub struct Signing {
    key: Key,
    link_id: u8,
    /// The newest stamp sent or accepted.
    newest: u64,
    streams: Vec<Stream>,
    /// Senders whose packets were signed here. Their packets never come from the other side.
    signed: Vec<Sender>,
}

#[derive(Debug)]
struct Stream {
    link_id: u8,
    sender: Sender,
    newest: u64,
}

impl Signing {
    /// With the id of this link, and the stamp below which all may have been used before.
    pub fn new(key: Key, link_id: u8, used: u64) -> Self {
        let newest = used.min(MAX_STAMP);
        Self { key, link_id, newest, streams: Vec::new(), signed: Vec::new() }
    }

    /// The newest stamp sent or accepted.
    pub fn newest(&self) -> u64 {
        self.newest
    }

    /// The packet with our signature in place of any other; one of MAVLink 1 becomes one of MAVLink 2. `None` for bytes that are no
    /// packet. `now` is the clock's [`stamp`].
    pub fn sign(&mut self, now: u64, raw: &[u8]) -> Option<Vec<u8>> {
        let mut signed = reframe(raw, SIGNED)?;
        self.note_signed(&signed);
        self.newest = now.max(self.newest + 1).min(MAX_STAMP);
        signed.push(self.link_id);
        signed.extend_from_slice(&self.newest.to_le_bytes()[..6]);
        let signature = signature(&self.key, &signed);
        signed.extend_from_slice(&signature);
        Some(signed)
    }

    /// Notes the sender of a packet that is signed here.
    fn note_signed(&mut self, raw: &[u8]) {
        // As `reframe` makes it.
        let &[_, _, _, _, _, system, component, ..] = raw else { return };
        let sender = Sender { system, component };
        if !self.signed.contains(&sender) && self.signed.len() < MAX_STREAMS {
            self.signed.push(sender);
        }
    }

    /// Whether a received packet is of a holder of the key, and new. `now` is the clock's [`stamp`].
    ///
    /// # Errors
    /// Why not.
    pub fn verify(&mut self, now: u64, packet: &Packet) -> Result<(), Refusal> {
        let Some((stamped, sent)) = packet.is_signed().then(|| parts(&packet.raw)).flatten() else {
            return if packet.message_id == OF_RADIO { Ok(()) } else { Err(Refusal::Unsigned) };
        };
        if !bool::from(signature(&self.key, stamped.all).ct_eq(sent)) {
            return Err(Refusal::WrongKey);
        }
        let Stamped { link_id, stamp, .. } = stamped;
        // A packet of ours was sent back to us.
        if link_id == self.link_id && self.signed.contains(&packet.sender) {
            return Err(Refusal::Replayed);
        }
        let is_full = self.streams.len() >= MAX_STREAMS;
        let is_it = |it: &&mut Stream| it.link_id == link_id && it.sender == packet.sender;
        match self.streams.iter_mut().find(is_it) {
            Some(stream) if stamp <= stream.newest => return Err(Refusal::Replayed),
            Some(stream) => stream.newest = stamp,
            None if stamp + MAX_BEHIND < now.max(self.newest) => return Err(Refusal::Old),
            None if is_full => return Err(Refusal::TooManyStreams),
            None => self.streams.push(Stream { link_id, sender: packet.sender, newest: stamp }),
        }
        self.newest = self.newest.max(stamp);
        Ok(())
    }
}

/// The bytes that a signature covers, without the key.
struct Stamped<'a> {
    all: &'a [u8],
    link_id: u8,
    stamp: u64,
}

/// A signed packet, parted before its signature's last six bytes.
fn parts(raw: &[u8]) -> Option<(Stamped<'_>, &[u8])> {
    let (all, sent) = raw.split_at_checked(raw.len().checked_sub(SIGNATURE - STAMPED)?)?;
    let [link_id, stamp @ ..] = all.last_chunk::<STAMPED>()?;
    let [a, b, c, d, e, f] = *stamp;
    let stamp = u64::from_le_bytes([a, b, c, d, e, f, 0, 0]);
    Some((Stamped { all, link_id: *link_id, stamp }, sent))
}

fn signature(key: &Key, stamped: &[u8]) -> [u8; SIGNATURE - STAMPED] {
    let hash = Sha256::new().chain_update(key.0).chain_update(stamped).finalize();
    let [a, b, c, d, e, f, ..] = <[u8; 32]>::from(hash);
    [a, b, c, d, e, f]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dialect::{HEARTBEAT_DATA, MavMessage};
    use crate::packet::{Parser, encode};
    use proptest::prelude::*;

    const AUTOPILOT: Sender = Sender { system: 1, component: 1 };
    /// 2026-01-01.
    const NOW: u64 = 34_715_520_000_000;

    fn key(text: &str) -> Key {
        text.parse().unwrap()
    }

    fn heartbeat(sender: Sender) -> Vec<u8> {
        encode(sender, 0, &MavMessage::HEARTBEAT(HEARTBEAT_DATA::default()))
    }

    fn packet(raw: &[u8]) -> Packet {
        Parser::new().push(raw).remove(0)
    }

    #[test]
    fn stamps_begin_in_2015() {
        let at = |s| stamp(Duration::from_secs(s));
        assert_eq!((at(0), at(EPOCH_S), at(EPOCH_S + 2)), (0, 0, 2 * PER_S));
        assert_eq!(at(1_767_225_600), NOW);
        assert_eq!(at(10_000_000_000), MAX_STAMP);
    }

    #[test]
    fn a_key_is_hexadecimal_digits_or_a_passphrase() {
        // printf 'correct horse' | sha256sum
        let digits = "4104d36f8da2c254349f85836793ebe029e0c957063a34c91c2e9203187b5631";
        assert_eq!(key(&format!(" {digits}\n")).0[..3], [0x41, 0x04, 0xd3]);
        assert_eq!(key("correct horse\n").0, key(digits).0);
        for text in ["", "  \n", "1234567", "two\nlines of text", &"x".repeat(257)] {
            assert!(text.parse::<Key>().is_err(), "{text:?}");
        }
        assert_eq!(format!("{:?}", key("correct horse")), "Key(secret)");
    }

    #[test]
    fn a_signed_packet_is_verified_once() {
        let mut here = Signing::new(key("correct horse"), 191, 0);
        let mut there = Signing::new(key("correct horse"), 0, 0);
        let raw = here.sign(NOW, &heartbeat(AUTOPILOT)).unwrap();
        let signed = packet(&raw);
        assert_eq!(there.verify(NOW, &signed), Ok(()));
        assert_eq!(there.verify(NOW, &signed), Err(Refusal::Replayed));
        assert_eq!(signed.without_signature(), packet(&heartbeat(AUTOPILOT)));

        assert_eq!(there.verify(NOW, &packet(&heartbeat(AUTOPILOT))), Err(Refusal::Unsigned));
        let mut attacker = Signing::new(key("another horse"), 191, 0);
        let forged = attacker.sign(NOW + 9, &heartbeat(AUTOPILOT)).unwrap();
        assert_eq!(there.verify(NOW, &packet(&forged)), Err(Refusal::WrongKey));
        // A packet that another leg has signed is signed again.
        let again = here.sign(NOW, &forged).unwrap();
        assert_eq!(again.len(), forged.len());
        assert_eq!(there.verify(NOW, &packet(&again)), Ok(()));
    }

    #[test]
    fn our_packets_are_not_accepted_from_other_senders() {
        let mut here = Signing::new(key("correct horse"), 191, 0);
        let raw = here.sign(NOW, &heartbeat(AUTOPILOT)).unwrap();
        assert_eq!(here.verify(NOW, &packet(&raw)), Err(Refusal::Replayed));
        // Those of another sender on a link of the same id are.
        let mut there = Signing::new(key("correct horse"), 191, 0);
        let raw = there.sign(NOW, &heartbeat(Sender { system: 255, component: 190 })).unwrap();
        assert_eq!(here.verify(NOW, &packet(&raw)), Ok(()));
    }

    #[test]
    fn a_radio_need_not_sign() {
        let radio = encode(AUTOPILOT, 0, &MavMessage::RADIO_STATUS(RADIO_STATUS_DATA::default()));
        let mut signing = Signing::new(key("correct horse"), 0, 0);
        assert_eq!(signing.verify(NOW, &packet(&radio)), Ok(()));
    }

    #[test]
    fn a_stream_begins_within_a_minute_of_our_stamp() {
        let mut signing = Signing::new(key("correct horse"), 0, NOW);
        let mut sent = |link_id, at| {
            let mut sender = Signing::new(key("correct horse"), link_id, 0);
            let raw = sender.sign(at, &heartbeat(AUTOPILOT)).unwrap();
            signing.verify(0, &packet(&raw))
        };
        assert_eq!(sent(1, NOW - MAX_BEHIND - 1), Err(Refusal::Old));
        assert_eq!(sent(1, NOW - MAX_BEHIND), Ok(()));
        // Within a stream the order decides, and not the clock.
        assert_eq!(sent(1, NOW - MAX_BEHIND + 1), Ok(()));
        assert_eq!(sent(1, NOW - MAX_BEHIND + 1), Err(Refusal::Replayed));
        // A clock in the future is followed.
        assert_eq!(sent(2, NOW + 1_000_000_000), Ok(()));
        assert_eq!(sent(3, NOW), Err(Refusal::Old));
        assert_eq!(signing.newest(), NOW + 1_000_000_000);
    }

    #[test]
    fn the_streams_are_bounded() {
        let mut signing = Signing::new(key("correct horse"), 0, 0);
        let mut sender = Signing::new(key("correct horse"), 1, 0);
        for component in 0..=MAX_STREAMS {
            let from = Sender { system: 1, component: component as u8 };
            let raw = sender.sign(NOW, &heartbeat(from)).unwrap();
            let expected =
                if component < MAX_STREAMS { Ok(()) } else { Err(Refusal::TooManyStreams) };
            assert_eq!(signing.verify(NOW, &packet(&raw)), expected, "{component}");
        }
    }

    #[test]
    fn without_a_clock_no_stamp_is_used_twice() {
        let mut there = Signing::new(key("correct horse"), 0, NOW);
        let mut used = 0;
        for start in 0..5 {
            let mut here = Signing::new(key("correct horse"), 191, used);
            for sent in 0..3 {
                let raw = here.sign(0, &heartbeat(AUTOPILOT)).unwrap();
                // The first packet of the other side brings it into our time, once and for all starts.
                let is_first = (start, sent) == (0, 0);
                let expected = if is_first { Err(Refusal::Old) } else { Ok(()) };
                assert_eq!(there.verify(0, &packet(&raw)), expected, "start {start}");
                let answer = there.sign(0, &heartbeat(Sender { system: 255, component: 190 }));
                assert_eq!(here.verify(0, &packet(&answer.unwrap())), Ok(()));
            }
            used = here.newest();
        }
    }

    proptest! {
        #[test]
        fn a_changed_packet_is_refused(at in any::<prop::sample::Index>(), flip in 1..=255_u8) {
            let mut here = Signing::new(key("correct horse"), 191, 0);
            let raw = here.sign(NOW, &heartbeat(AUTOPILOT)).unwrap();
            let mut signing = Signing::new(key("correct horse"), 0, 0);
            let mut changed = raw.clone();
            changed[at.index(raw.len())] ^= flip;
            let mut parser = Parser::new();
            let mut packets = parser.push(&changed);
            packets.extend(parser.finish());
            for damaged in packets {
                prop_assert!(signing.verify(NOW, &damaged).is_err());
            }
            prop_assert_eq!(signing.verify(NOW, &packet(&raw)), Ok(()));
        }

        #[test]
        fn no_bytes_panic(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            let mut signing = Signing::new(key("correct horse"), 0, 0);
            let _ = signing.sign(NOW, &bytes);
            let _ = parts(&bytes);
        }
    }
}
