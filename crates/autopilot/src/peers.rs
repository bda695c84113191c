//! Chooses among the senders to a listening UDP port the autopilot or ground station that the link talks to, splits each
//! one's datagrams into packets, and replaces a silent one.

use std::net::{IpAddr, SocketAddr};
use std::time::{Duration, Instant};

use crate::gate::Gate;
use crate::packet::{Counters, Packet, Parser};

/// Silence after which an incomplete packet is discarded.
pub(crate) const PACKET_GAP: Duration = Duration::from_millis(200);
/// Silence after which an autopilot is replaced by another one.
const PEER_SILENCE: Duration = Duration::from_secs(3);
/// Minimum time between two heartbeats of other autopilots that are passed on: they show that there are others.
const OTHER_PAUSE: Duration = Duration::from_secs(1);
/// Maximum number of known UDP peers.
const MAX_PEERS: usize = 8;

/// The peer of a listening link.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Peering {
    /// An autopilot: the sender of its heartbeat, until that is silent for 3 s and another address sends it.
    Autopilot {
        /// Its system id; `None` takes that of the first one permanently.
        system: Option<u8>,
    },
    /// A ground station: the first one whose packet was received, until that is silent.
    GroundStation {
        /// The addresses of the ground stations; any address if there are none.
        known: Vec<IpAddr>,
        /// Silence after which another one replaces it.
        silence: Duration,
    },
}

impl Default for Peering {
    fn default() -> Self {
        Self::Autopilot { system: None }
    }
}

impl Peering {
    /// Whether packets from this address are taken at all.
    pub(crate) fn admits(&self, from: IpAddr) -> bool {
        match self {
            Self::Autopilot { .. } => true,
            Self::GroundStation { known, .. } => {
                known.is_empty() || known.iter().any(|k| k.to_canonical() == from.to_canonical())
            }
        }
    }

    /// The kind of its peer, for messages.
    pub(crate) fn other_side(&self) -> &'static str {
        match self {
            Self::Autopilot { .. } => "autopilot (or its simulator)",
            Self::GroundStation { .. } => "ground station",
        }
    }

    /// Silence after which a peer is replaced.
    pub(crate) fn silence(&self) -> Duration {
        match self {
            Self::Autopilot { .. } => PEER_SILENCE,
            Self::GroundStation { silence, .. } => *silence,
        }
    }
}

/// The senders to a UDP port, each with a separate stream of packets.
pub(crate) struct Peers {
    known: Vec<Peer>,
    pub(crate) chosen: Option<SocketAddr>,
    peering: Peering,
    /// The system id of the first autopilot, where none is pinned: a vehicle that is silent for a while must not be replaced by
    /// another one, for which no decision was made.
    pub(crate) first: Option<u8>,
    /// When the heartbeat of another autopilot was passed on last.
    other_reported: Option<Instant>,
}

/// The content of a datagram.
pub(crate) struct Taken {
    /// The packets of the chosen peer.
    pub(crate) packets: Vec<Packet>,
    /// Number of packets of unknown senders, which were dropped.
    pub(crate) unknown_senders: u64,
    /// The heartbeat of an autopilot that is another one than the first, where none is pinned.
    pub(crate) other_autopilot: Option<Packet>,
    pub(crate) counted: Counters,
}

struct Peer {
    address: SocketAddr,
    parser: Parser,
    /// Time of the last bytes.
    received: Instant,
    /// Time of the last packet that was let in; none before the first.
    active: Option<Instant>,
    /// Time of the last autopilot heartbeat from there.
    autopilot: Option<Instant>,
}

impl Peers {
    /// No sender is known; `first` is the autopilot's system id, if its heartbeat was received before.
    pub(crate) fn new(chosen: Option<SocketAddr>, peering: Peering, first: Option<u8>) -> Self {
        Self { known: Vec::new(), chosen, peering, first, other_reported: None }
    }

    /// Parses a datagram and returns its packets if they come from the chosen peer and the gate lets them in;
    /// `stamp` is the clock's.
    pub(crate) fn take(
        &mut self,
        from: SocketAddr,
        bytes: &[u8],
        now: Instant,
        gate: &mut Gate,
        stamp: u64,
    ) -> Taken {
        if !self.peering.admits(from.ip()) {
            // Almost all senders send one packet per datagram; an unknown sender's is not parsed.
            return Taken {
                packets: Vec::new(),
                unknown_senders: 1,
                other_autopilot: None,
                counted: Counters::default(),
            };
        }
        let peer = self.peer(from, now);
        if now.duration_since(peer.received) > PACKET_GAP {
            // The rest of an incomplete packet is lost.
            peer.parser.finish();
        }
        peer.received = now;
        let admitted = gate.admit(stamp, peer.parser.push(bytes));
        let packets = admitted.packets;
        if admitted.is_peer {
            peer.active = Some(now);
        }
        let counted = peer.parser.take_counters();
        let is_autopilot = packets.iter().any(|packet| self.is_heartbeat(packet));
        if is_autopilot {
            self.peer(from, now).autopilot = Some(now);
        }
        if admitted.is_peer && self.chosen != Some(from) && self.is_replaced(is_autopilot, now) {
            self.chosen = Some(from);
        }
        // Until it has our stamps, which are newer, all its packets are too old. A peer that is let in replaces it at once.
        if admitted.is_behind && self.is_silent(now) {
            self.chosen = Some(from);
        }
        if self.chosen == Some(from) {
            let heartbeat = packets.iter().find(|packet| self.is_heartbeat(packet));
            self.first = self.first.or(heartbeat.map(|packet| packet.sender.system));
            return Taken { packets, unknown_senders: 0, other_autopilot: None, counted };
        }
        let unknown_senders = packets.len() as u64;
        let other_autopilot = self.other_autopilot(packets, now);
        Taken { packets: Vec::new(), unknown_senders, other_autopilot, counted }
    }

    /// True for the heartbeat of the autopilot, as opposed to another vehicle's.
    fn is_heartbeat(&self, packet: &Packet) -> bool {
        let Peering::Autopilot { system } = self.peering else { return false };
        packet.is_heartbeat_of_autopilot()
            && system.or(self.first).is_none_or(|system| system == packet.sender.system)
    }

    /// The heartbeat of another autopilot among an unknown sender's packets, once a second.
    fn other_autopilot(&mut self, packets: Vec<Packet>, now: Instant) -> Option<Packet> {
        let Peering::Autopilot { system: None } = self.peering else { return None };
        let first = self.first?;
        let is_due = self.other_reported.is_none_or(|at| now.duration_since(at) >= OTHER_PAUSE);
        let is_other = |it: &Packet| it.is_heartbeat_of_autopilot() && it.sender.system != first;
        let heartbeat = packets.into_iter().find(is_other).filter(|_| is_due)?;
        self.other_reported = Some(now);
        Some(heartbeat)
    }

    /// Whether no packet was let in from the chosen peer lately.
    fn is_silent(&self, now: Instant) -> bool {
        let chosen = self.known.iter().find(|peer| Some(peer.address) == self.chosen);
        let active = chosen.and_then(|peer| peer.active);
        active.is_none_or(|at| now.duration_since(at) > self.peering.silence())
    }

    /// Whether the chosen peer is replaced by one that just sent a packet.
    fn is_replaced(&self, to_autopilot: bool, now: Instant) -> bool {
        let recent = |at: Instant| now.duration_since(at) <= self.peering.silence();
        let Some(chosen) = self.chosen else { return true };
        let Some(chosen) = self.known.iter().find(|peer| peer.address == chosen) else {
            return true;
        };
        match (&self.peering, chosen.autopilot) {
            (Peering::Autopilot { .. }, Some(at)) => to_autopilot && !recent(at),
            (Peering::Autopilot { .. }, None) => to_autopilot || self.is_silent(now),
            (Peering::GroundStation { .. }, _) => self.is_silent(now),
        }
    }

    fn peer(&mut self, address: SocketAddr, now: Instant) -> &mut Peer {
        let index = match self.known.iter().position(|peer| peer.address == address) {
            Some(index) => index,
            None => {
                self.forget_one();
                self.known.push(Peer {
                    address,
                    parser: Parser::new(),
                    received: now,
                    active: None,
                    autopilot: None,
                });
                self.known.len() - 1
            }
        };
        &mut self.known[index]
    }

    /// Forgets the peer with the longest silence, never the chosen one.
    fn forget_one(&mut self) {
        if self.known.len() < MAX_PEERS {
            return;
        }
        let others = self.known.iter().enumerate().filter(|(_, p)| Some(p.address) != self.chosen);
        if let Some((oldest, _)) = others.min_by_key(|(_, peer)| peer.received) {
            self.known.swap_remove(oldest);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dialect::HEARTBEAT_DATA;
    use crate::dialect::{MavAutopilot, MavMessage};
    use crate::packet::{AUTOPILOT, Sender, encode};
    use crate::signing::Signing;

    impl Peers {
        fn take_any(&mut self, from: SocketAddr, bytes: &[u8], now: Instant) -> Taken {
            self.take(from, bytes, now, &mut Gate::new(None), 0)
        }
    }

    const GROUND: Sender = Sender { system: 255, component: 190 };

    fn at(host: u8) -> SocketAddr {
        SocketAddr::from(([10, 0, 0, host], 14_550))
    }

    fn station(known: Vec<IpAddr>) -> Peers {
        let silence = Duration::from_secs(10);
        Peers::new(None, Peering::GroundStation { known, silence }, None)
    }

    fn heartbeat(autopilot: MavAutopilot, sender: Sender) -> Vec<u8> {
        let data = HEARTBEAT_DATA { autopilot, ..Default::default() };
        encode(sender, 0, &MavMessage::HEARTBEAT(data))
    }

    #[test]
    fn the_first_ground_station_is_held_until_it_is_silent() {
        let mut peers = station(Vec::new());
        let began = Instant::now();
        let bytes = heartbeat(MavAutopilot::MAV_AUTOPILOT_INVALID, GROUND);
        assert_eq!(peers.take_any(at(1), &bytes, began).packets.len(), 1);
        // The kind that an unknown sender states has no effect.
        let autopilot = Sender { system: 1, component: 1 };
        let false_heartbeat = heartbeat(MavAutopilot::MAV_AUTOPILOT_PX4, autopilot);
        for second in 1..=10 {
            let now = began + Duration::from_secs(second);
            let taken = peers.take_any(at(2), &false_heartbeat, now);
            assert_eq!((taken.packets.len(), taken.unknown_senders), (0, 1), "after {second} s");
        }
        assert_eq!(peers.chosen, Some(at(1)));
        let later = began + Duration::from_secs(11);
        assert_eq!(
            peers.take_any(at(2), &bytes, later).packets.len(),
            1,
            "the first one is silent"
        );
        assert_eq!(peers.take_any(at(1), &bytes, later).unknown_senders, 1);
    }

    #[test]
    fn a_station_with_old_stamps_is_chosen_once_the_other_is_silent_and_replaced_by_one_that_is_let_in()
     {
        const NOW: u64 = 34_715_520_000_000;
        let signing = |link_id| Signing::new("correct horse".parse().unwrap(), link_id, 0);
        let bytes = heartbeat(MavAutopilot::MAV_AUTOPILOT_INVALID, GROUND);
        let (mut peers, mut gate) = (station(Vec::new()), Gate::new(Some(signing(7))));
        let (mut ahead, mut right, mut third) = (signing(1), signing(2), signing(3));
        let began = Instant::now();
        let early = ahead.sign(NOW + 1_000_000_000, &bytes).unwrap();
        assert_eq!(peers.take(at(1), &early, began, &mut gate, NOW).packets.len(), 1);
        let behind = right.sign(NOW, &bytes).unwrap();
        let taken = peers.take(at(2), &behind, began, &mut gate, NOW);
        assert!(taken.packets.is_empty() && peers.chosen == Some(at(1)), "it is not silent yet");
        let later = began + Duration::from_secs(11);
        peers.take(at(2), &behind, later, &mut gate, NOW);
        assert_eq!(peers.chosen, Some(at(2)), "it gets our stamps");
        let fresh = third.sign(NOW + 1_000_000_001, &bytes).unwrap();
        assert_eq!(peers.take(at(3), &fresh, later, &mut gate, NOW).packets.len(), 1);
        assert_eq!(peers.chosen, Some(at(3)), "an old packet does not keep the link");
        peers.take(at(2), &behind, later, &mut gate, NOW);
        assert_eq!(peers.chosen, Some(at(3)));
    }

    /// The heartbeat of the autopilot with this system id.
    fn of(system: u8) -> Vec<u8> {
        let autopilot = MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA;
        heartbeat(autopilot, Sender { system, component: AUTOPILOT })
    }

    #[test]
    fn an_autopilot_that_is_silent_is_not_replaced_by_another_vehicle() {
        let mut peers = Peers::new(None, Peering::default(), None);
        let began = Instant::now();
        assert_eq!(peers.take_any(at(1), &of(1), began).packets.len(), 1);
        for second in 1..60 {
            let now = began + Duration::from_secs(second);
            let taken = peers.take_any(at(2), &of(2), now);
            assert_eq!((taken.packets.len(), taken.unknown_senders), (0, 1), "after {second} s");
            let other = taken.other_autopilot.map(|packet| packet.sender.system);
            assert_eq!(other, Some(2), "it is reported, after {second} s");
            assert_eq!(peers.take_any(at(2), &of(2), now).other_autopilot, None, "not so often");
        }
        let later = began + Duration::from_secs(60);
        assert_eq!(peers.take_any(at(1), &of(1), later).packets.len(), 1, "it is back");
        // On a new connection, too.
        let mut peers = Peers::new(None, Peering::default(), peers.first);
        peers.take_any(at(2), &of(2), later);
        assert_eq!(peers.take_any(at(1), &of(1), later).packets.len(), 1);
        assert_eq!(peers.take_any(at(2), &of(2), later).unknown_senders, 1);
    }

    #[test]
    fn an_autopilot_that_restarts_is_received_from_another_port_once_the_old_one_is_silent() {
        let mut peers = Peers::new(None, Peering::default(), None);
        let began = Instant::now();
        peers.take_any(at(1), &of(1), began);
        let at_second = |second| began + Duration::from_secs(second);
        assert!(peers.take_any(at(2), &of(1), at_second(1)).packets.is_empty());
        let taken = peers.take_any(at(2), &of(1), at_second(4));
        assert_eq!((taken.packets.len(), taken.other_autopilot), (1, None));
        assert_eq!(peers.chosen, Some(at(2)));
    }

    #[test]
    fn of_several_vehicles_at_one_port_only_the_pinned_one_is_received() {
        let mut peers = Peers::new(None, Peering::Autopilot { system: Some(2) }, None);
        let began = Instant::now();
        for second in 0..20 {
            let now = began + Duration::from_secs(second);
            assert_eq!(peers.take_any(at(1), &of(1), now).other_autopilot, None);
            assert_eq!(peers.take_any(at(2), &of(2), now).packets.len(), 1, "after {second} s");
            assert_eq!(peers.chosen, Some(at(2)));
        }
        // Also while it is silent.
        peers.take_any(at(1), &of(1), began + Duration::from_secs(60));
        assert_eq!(peers.chosen, Some(at(2)));
    }

    #[test]
    fn only_packets_of_known_ground_stations_are_received() {
        let mut peers = station(vec![at(3).ip()]);
        let now = Instant::now();
        let bytes = heartbeat(MavAutopilot::MAV_AUTOPILOT_INVALID, GROUND);
        assert_eq!(peers.take_any(at(1), &bytes, now).unknown_senders, 1);
        assert_eq!(peers.chosen, None);
        assert_eq!(peers.take_any(at(3), &bytes, now).packets.len(), 1);
    }

    #[test]
    fn a_peer_that_sends_only_noise_is_replaced() {
        let mut peers = station(Vec::new());
        let began = Instant::now();
        let bytes = heartbeat(MavAutopilot::MAV_AUTOPILOT_INVALID, GROUND);
        peers.take_any(at(1), &bytes, began);
        let later = began + Duration::from_secs(11);
        peers.take_any(at(1), b"noise", later);
        assert_eq!(peers.take_any(at(2), &bytes, later).packets.len(), 1);
    }
}
