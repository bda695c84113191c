//! Messages of the bridge: the ground stations whose packets were received, their refused packets, and whether packets are signed.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::codec::wire;
use crate::health::Count;

wire! {
    GcsStatus = 22 v 1;
}

/// The ground stations whose packets were received, their refused packets, and whether packets are signed.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct GcsStatus {
    /// The bridge's name.
    pub bridge: String,
    /// When, in nanoseconds of the bridge's clock.
    pub stamp_ns: i64,
    /// MAVLink system id of the vehicle; none while it is neither known nor assumed.
    pub system: Option<u8>,
    /// Address of the link to the ground, as it is configured.
    pub link: String,
    /// The other side of that link, as text; none while the link is down, and where the bridge listens and no ground station was received.
    pub peer: Option<String>,
    /// Why the link is down, as a sentence.
    pub problem: Option<String>,
    /// The packets that a ground station may send to the autopilot: `everything`, `no-arming` or `monitor`.
    pub ground_may: String,
    /// The ground stations received since the start, silent ones included, in the order of their first packets.
    pub stations: Vec<GroundStation>,
    /// Packets of further ground stations since the start, which are not listed.
    pub unlisted: u64,
    /// Packets from the ground that were neither passed on nor answered as they ask, since the start, by reason; each once, and
    /// without the vehicle's packets that come back.
    pub refused: Vec<Count>,
    /// Whether packets on the link to the ground are signed.
    pub signing: GcsSigning,
}

/// A ground station whose packets were received.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct GroundStation {
    /// Its MAVLink system id.
    pub system: u8,
    /// Its MAVLink component id.
    pub component: u8,
    /// The other side of the link when its last packet came, as text.
    pub peer: String,
    /// When its last packet came, in nanoseconds of the bridge's clock.
    pub last_ns: i64,
    /// True when no packet of it came for `ground_silence_s` of the bridge.
    pub silent: bool,
    /// Packets of it since the start, those that were refused included, and those that the link refused left out.
    pub packets: u64,
    /// Those of them that were refused.
    pub refused: u64,
    /// The signature of its last packet.
    pub signature: PacketSignature,
}

/// The signature of a packet, as far as it was checked.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PacketSignature {
    /// It has none.
    Unsigned,
    /// It has one, which was not checked: there is no key here.
    Unchecked,
    /// It is of a holder of the key, and new.
    Verified,
}

/// Whether packets on the link to the ground are signed. The key itself never leaves the bridge.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct GcsSigning {
    /// Whether they are.
    pub state: SigningState,
    /// Id of the link in the signatures of the bridge's packets; none without a key.
    pub link_id: Option<u8>,
    /// When the last packet with a right signature came, in nanoseconds of the bridge's clock.
    pub verified_ns: Option<i64>,
}

/// Whether the packets of a link are signed.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SigningState {
    /// There is no key here, and no ground station signs.
    #[default]
    Off,
    /// There is no key here, but a ground station signs, by the last packet of one that sends or of the one that sent last: its
    /// packets are passed on unchecked, and it may refuse packets from here.
    NoKey,
    /// Sent packets are signed and unsigned ones are refused, but no packet with a right signature has come yet.
    Wanted,
    /// Sent packets are signed, unsigned ones are refused, and packets with right signatures have come.
    InForce,
}

/// As a clause.
impl fmt::Display for SigningState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Off => "packets are not signed",
            Self::NoKey => "the other side signs, and there is no key here",
            Self::Wanted => "only signed packets pass, and none has come",
            Self::InForce => "packets are signed",
        })
    }
}
