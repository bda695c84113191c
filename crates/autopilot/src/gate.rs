//! Filters the packets of a link: with a key, only packets of holders of the same key come in, and only signed packets go out.

use crate::packet::Packet;
use crate::signing::{Refusal, Refusals, Signing};

/// The gate of one link; without a key it is open.
#[derive(Debug)]
pub(crate) struct Gate {
    signing: Option<Signing>,
    refusals: Refusals,
}

/// The packets that came through.
pub(crate) struct Admitted {
    pub(crate) packets: Vec<Packet>,
    /// Whether the sender may be the peer of the link. A radio's own packets need no signature, and so do not
    /// authenticate their sender.
    pub(crate) is_peer: bool,
    /// A holder of the key may have sent a packet that is too old: it needs our newer stamps.
    pub(crate) is_behind: bool,
}

impl Gate {
    pub(crate) fn new(signing: Option<Signing>) -> Self {
        Self { signing, refusals: Refusals::default() }
    }

    pub(crate) fn is_open(&self) -> bool {
        self.signing.is_none()
    }

    pub(crate) fn refusals(&self) -> Refusals {
        self.refusals
    }

    /// The newest stamp sent or accepted.
    pub(crate) fn newest(&self) -> Option<u64> {
        self.signing.as_ref().map(Signing::newest)
    }

    /// The packets that are let in, without their signatures; `stamp` is the clock's.
    pub(crate) fn admit(&mut self, stamp: u64, packets: Vec<Packet>) -> Admitted {
        let Some(signing) = &mut self.signing else {
            return Admitted { is_peer: !packets.is_empty(), packets, is_behind: false };
        };
        let mut admitted = Admitted { packets: Vec::new(), is_peer: false, is_behind: false };
        for packet in packets {
            match signing.verify(stamp, &packet) {
                Ok(()) => {
                    admitted.is_peer |= packet.is_signed();
                    admitted.packets.push(packet.without_signature());
                }
                Err(reason) => {
                    admitted.is_behind |= matches!(reason, Refusal::Old | Refusal::Replayed);
                    self.refusals.count(reason);
                }
            }
        }
        admitted
    }

    /// The packet as it is sent; `None` for bytes that are no packet.
    pub(crate) fn seal(&mut self, stamp: u64, raw: Vec<u8>) -> Option<Vec<u8>> {
        match &mut self.signing {
            Some(signing) => signing.sign(stamp, &raw),
            None => Some(raw),
        }
    }
}
