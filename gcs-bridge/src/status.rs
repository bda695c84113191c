//! Collects the bridge's status for its topic: the link's peer or problem, ground stations by packets and silence, refused packets
//! by reason, the state of signing, and when it is due.

use std::collections::BTreeMap;

use autopilot::dialect::{MessageData, RADIO_STATUS_DATA};
use autopilot::signing::Refusals;
use autopilot::{Packet, Sender};
use messages::{Count, GcsSigning, GcsStatus, GroundStation, PacketSignature, SigningState};

use crate::config::Config;

/// Minimum time between two messages, in nanoseconds.
const MIN_PERIOD_NS: i64 = 500_000_000;
/// Maximum time between two messages, in nanoseconds.
const MAX_PERIOD_NS: i64 = 2_000_000_000;
/// Maximum number of ground stations that are listed.
const MAX_STATIONS: usize = 16;
/// Maximum number of characters of a text.
const MAX_CHARS: usize = 120;

/// Counts of the link to the ground since the start.
#[derive(Copy, Clone, Debug, Default)]
pub(crate) struct LinkCounts {
    /// Packets and connections of others than the peer.
    pub(crate) strangers: u64,
    /// Packets with wrong checksums.
    pub(crate) bad_checksums: u64,
    /// Packets that were not read in time.
    pub(crate) unread: u64,
    /// Packets refused because of their signatures.
    pub(crate) refusals: Refusals,
}

/// The status of the link to the ground and of the ground stations.
#[derive(Debug)]
pub(crate) struct GroundStatus {
    /// The status so far; its stations' silence, its refused packets and its state of signing are computed when it is published.
    so_far: GcsStatus,
    /// Silence after which a station counts as silent, in nanoseconds.
    silence_ns: i64,
    refused: BTreeMap<&'static str, u64>,
    published: Option<GcsStatus>,
}

impl GroundStatus {
    /// A status without ground stations. `link_id` is that of the signatures, with a key.
    pub(crate) fn new(config: &Config, link_id: Option<u8>) -> Self {
        let so_far = GcsStatus {
            bridge: config.id.clone(),
            link: short(&config.ground),
            ground_may: config.ground_may.clone(),
            signing: GcsSigning { link_id, ..GcsSigning::default() },
            ..GcsStatus::default()
        };
        let silence_ns = (config.ground_silence_s * 1e9).round() as i64;
        Self { so_far, silence_ns, refused: BTreeMap::new(), published: None }
    }

    /// The link is up, with this other side.
    pub(crate) fn up(&mut self, peer: &str) {
        self.so_far.peer = Some(short(peer));
        self.so_far.problem = None;
    }

    /// The link is down.
    pub(crate) fn down(&mut self, reason: &str) {
        self.so_far.peer = None;
        self.so_far.problem = Some(short(reason));
    }

    /// Takes a packet from the ground that is no echo of the vehicle. Packets that a radio adds on its own belong to no station.
    pub(crate) fn received(&mut self, now_ns: i64, packet: &Packet) {
        if packet.message_id == RADIO_STATUS_DATA::ID {
            return;
        }
        // With a key, the link accepts only verified packets, and removes the signatures.
        let has_key = self.so_far.signing.link_id.is_some();
        let signature = match packet.is_signed() {
            _ if has_key => PacketSignature::Verified,
            true => PacketSignature::Unchecked,
            false => PacketSignature::Unsigned,
        };
        if has_key {
            self.so_far.signing.verified_ns = Some(now_ns);
        }
        let peer = self.so_far.peer.clone().unwrap_or_default();
        if let Some(station) = self.station(packet.sender) {
            station.packets += 1;
            (station.peer, station.last_ns, station.signature) = (peer, now_ns, signature);
            return;
        }
        if !self.has_room(now_ns) {
            self.so_far.unlisted += 1;
            return;
        }
        let Sender { system, component } = packet.sender;
        self.so_far.stations.push(GroundStation {
            system,
            component,
            peer,
            last_ns: now_ns,
            silent: false,
            packets: 1,
            refused: 0,
            signature,
        });
    }

    /// Counts a refused packet, after `received`; once for each.
    pub(crate) fn refused(&mut self, packet: &Packet, reason: &'static str) {
        *self.refused.entry(reason).or_default() += 1;
        let is_of_radio = packet.message_id == RADIO_STATUS_DATA::ID;
        if let Some(station) = self.station(packet.sender).filter(|_| !is_of_radio) {
            station.refused += 1;
        }
    }

    /// The status, when it is due: soon after a change, and else from time to time.
    pub(crate) fn due(
        &mut self,
        now_ns: i64,
        system: Option<u8>,
        counts: LinkCounts,
    ) -> Option<GcsStatus> {
        let passed_ns = |last: &GcsStatus| now_ns.saturating_sub(last.stamp_ns);
        let passed_ns = self.published.as_ref().map_or(i64::MAX, passed_ns);
        if passed_ns < MIN_PERIOD_NS {
            return None;
        }
        let status = self.status(now_ns, system, counts);
        let has_changed =
            self.published.as_ref().is_none_or(|last| content(last) != content(&status));
        if !has_changed && passed_ns < MAX_PERIOD_NS {
            return None;
        }
        self.published = Some(status.clone());
        Some(status)
    }

    fn status(&self, now_ns: i64, system: Option<u8>, counts: LinkCounts) -> GcsStatus {
        let mut status = GcsStatus { stamp_ns: now_ns, system, ..self.so_far.clone() };
        for station in &mut status.stations {
            station.silent = self.is_silent(now_ns, station);
        }
        let on_link = [
            ("packets or connections of an unknown sender", counts.strangers),
            ("wrong checksum", counts.bad_checksums),
            ("not read in time", counts.unread),
        ];
        let mut refused = self.refused.clone();
        refused.extend(on_link);
        let of_signature = counts.refusals.since(Refusals::default());
        refused.extend(of_signature.map(|(reason, count)| (reason.name(), count)));
        let refused = refused.into_iter().filter(|(_, count)| *count > 0);
        status.refused =
            refused.map(|(reason, count)| Count { reason: reason.to_owned(), count }).collect();
        status.signing.state = match (status.signing.link_id, status.signing.verified_ns) {
            (Some(_), Some(_)) => SigningState::InForce,
            (Some(_), None) => SigningState::Wanted,
            (None, _) if is_signing(&status.stations) => SigningState::NoKey,
            (None, _) => SigningState::Off,
        };
        status
    }

    fn station(&mut self, sender: Sender) -> Option<&mut GroundStation> {
        let Sender { system, component } = sender;
        let is_it = |it: &&mut GroundStation| (it.system, it.component) == (system, component);
        self.so_far.stations.iter_mut().find(is_it)
    }

    fn is_silent(&self, now_ns: i64, station: &GroundStation) -> bool {
        now_ns.saturating_sub(station.last_ns) > self.silence_ns
    }

    /// Whether one more station can be listed: in a full list, a silent one is replaced, and never one that sends packets, or a flood of
    /// senders would hide the operator's station.
    fn has_room(&mut self, now_ns: i64) -> bool {
        if self.so_far.stations.len() < MAX_STATIONS {
            return true;
        }
        let stations = self.so_far.stations.iter().enumerate();
        let silent = stations.filter(|(_, station)| self.is_silent(now_ns, station));
        let oldest = silent.min_by_key(|(_, station)| station.last_ns).map(|(index, _)| index);
        oldest.map(|index| self.so_far.stations.remove(index)).is_some()
    }
}

/// Whether a station signs, by its last packet. The last packet of a silent station does not count, unless no other station has sent one
/// since.
fn is_signing(stations: &[GroundStation]) -> bool {
    let newest_ns = stations.iter().map(|it| it.last_ns).max();
    let mut that_count = stations.iter().filter(|it| !it.silent || Some(it.last_ns) == newest_ns);
    that_count.any(|it| it.signature == PacketSignature::Unchecked)
}

/// The part of a status that is published at once when it changes: all but the fields that every packet changes.
fn content(status: &GcsStatus) -> GcsStatus {
    let mut status = GcsStatus { stamp_ns: 0, unlisted: 0, ..status.clone() };
    status.signing.verified_ns = None;
    for station in &mut status.stations {
        (station.last_ns, station.packets) = (0, 0);
    }
    status
}

fn short(text: &str) -> String {
    text.chars().take(MAX_CHARS).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use autopilot::Parser;
    use autopilot::dialect::{HEARTBEAT_DATA, MavMessage};
    use autopilot::packet::encode;
    use node::Layers;

    const SECOND_NS: i64 = 1_000_000_000;
    const GROUND: Sender = Sender { system: 255, component: 190 };

    fn config(set: &[&str]) -> Config {
        let set = set.iter().map(|text| (*text).to_owned()).collect();
        Layers { file: None, set }.load::<Config>().unwrap().settings
    }

    fn ground(link_id: Option<u8>) -> GroundStatus {
        GroundStatus::new(&config(&["ground_silence_s=10"]), link_id)
    }

    fn packet(sender: Sender, message: &MavMessage) -> Packet {
        Parser::new().push(&encode(sender, 0, message)).remove(0)
    }

    fn heartbeat(sender: Sender) -> Packet {
        packet(sender, &MavMessage::HEARTBEAT(HEARTBEAT_DATA::default()))
    }

    fn now(status: &GroundStatus, now_ns: i64) -> GcsStatus {
        status.status(now_ns, Some(7), LinkCounts::default())
    }

    #[test]
    fn a_station_is_listed_with_its_peer_and_as_silent_once_it_is() {
        let mut status = ground(None);
        status.up("10.0.0.2:14550");
        status.received(SECOND_NS, &heartbeat(GROUND));
        status.received(2 * SECOND_NS, &heartbeat(GROUND));
        let status_now = now(&status, 12 * SECOND_NS);
        assert_eq!(
            (status_now.system, status_now.peer.as_deref()),
            (Some(7), Some("10.0.0.2:14550"))
        );
        let expected = GroundStation {
            system: 255,
            component: 190,
            peer: "10.0.0.2:14550".into(),
            last_ns: 2 * SECOND_NS,
            silent: false,
            packets: 2,
            refused: 0,
            signature: PacketSignature::Unsigned,
        };
        assert_eq!(status_now.stations, [expected]);
        assert!(now(&status, 12 * SECOND_NS + 1).stations[0].silent);
        // It sends again, from another address.
        status.up("10.0.0.3:14550");
        status.received(20 * SECOND_NS, &heartbeat(GROUND));
        let status_now = now(&status, 20 * SECOND_NS).stations.remove(0);
        assert_eq!((status_now.silent, status_now.peer.as_str()), (false, "10.0.0.3:14550"));
    }

    #[test]
    fn a_link_that_is_down_has_its_reason_in_a_bounded_text() {
        let mut status = ground(None);
        assert_eq!(now(&status, 0).peer, None);
        status.up("10.0.0.2:14550");
        status.down(&"x".repeat(1000));
        let status_now = now(&status, 0);
        assert_eq!(
            (status_now.peer, status_now.problem.map(|it| it.len())),
            (None, Some(MAX_CHARS))
        );
        status.up("10.0.0.2:14550");
        assert_eq!(now(&status, 0).problem, None);
    }

    #[test]
    fn a_radio_is_no_ground_station() {
        let mut status = ground(Some(191));
        let radio = MavMessage::RADIO_STATUS(RADIO_STATUS_DATA::default());
        status.received(0, &packet(Sender { system: 51, component: 68 }, &radio));
        let status_now = now(&status, 0);
        assert!(status_now.stations.is_empty() && status_now.signing.state == SigningState::Wanted);
    }

    #[test]
    fn refused_packets_are_counted_by_reason_and_by_station() {
        let mut status = ground(None);
        status.received(0, &heartbeat(GROUND));
        status.refused(&heartbeat(GROUND), "only monitoring");
        status.refused(&heartbeat(GROUND), "only monitoring");
        // Neither a station that is not listed, nor a packet of a radio with a station's ids.
        status.refused(&heartbeat(Sender { system: 254, ..GROUND }), "too late");
        let radio = MavMessage::RADIO_STATUS(RADIO_STATUS_DATA::default());
        status.refused(&packet(GROUND, &radio), "too late");
        let counts = LinkCounts { strangers: 40, bad_checksums: 3, ..LinkCounts::default() };
        let status_now = status.status(0, None, counts);
        let counted = |reason: &str| {
            status_now.refused.iter().find(|it| it.reason == reason).map_or(0, |it| it.count)
        };
        assert_eq!(counted("only monitoring"), 2);
        assert_eq!(counted("too late"), 2);
        assert_eq!(counted("packets or connections of an unknown sender"), 40);
        assert_eq!(counted("wrong checksum"), 3);
        assert_eq!(status_now.refused.len(), 4, "reasons without a refused packet are not named");
        assert_eq!(status_now.stations[0].refused, 2);
    }

    #[test]
    fn signing_is_off_wanted_or_in_force() {
        let mut status = ground(None);
        assert_eq!(now(&status, 0).signing, GcsSigning::default());
        let mut signed = heartbeat(GROUND);
        signed.raw[2] = 1;
        status.received(0, &signed);
        assert_eq!(now(&status, 0).stations[0].signature, PacketSignature::Unchecked);
        assert_eq!(now(&status, 0).signing.state, SigningState::NoKey);
        // It no longer signs.
        status.received(1, &heartbeat(GROUND));
        assert_eq!(now(&status, 1).signing.state, SigningState::Off);
        // It was silent after a signed one: that counts as long as no other station sends.
        status.received(2, &signed);
        assert_eq!(now(&status, 60 * SECOND_NS).signing.state, SigningState::NoKey);
        status.received(60 * SECOND_NS, &heartbeat(Sender { system: 254, ..GROUND }));
        assert_eq!(now(&status, 60 * SECOND_NS).signing.state, SigningState::Off);

        let mut status = ground(Some(191));
        let wanted =
            GcsSigning { state: SigningState::Wanted, link_id: Some(191), verified_ns: None };
        assert_eq!(now(&status, 0).signing, wanted);
        // As the link passes it on: verified, and without its signature.
        status.received(5, &heartbeat(GROUND));
        let in_force = GcsSigning { state: SigningState::InForce, verified_ns: Some(5), ..wanted };
        assert_eq!(now(&status, 0).signing, in_force);
        assert_eq!(now(&status, 0).stations[0].signature, PacketSignature::Verified);
    }

    #[test]
    fn of_300_senders_those_that_speak_stay_and_the_others_are_counted() {
        let mut status = ground(None);
        let sender = |number: usize| Sender {
            system: (number / 250) as u8 + 1,
            component: (number % 250) as u8,
        };
        status.received(0, &heartbeat(GROUND));
        for number in 0..300 {
            status.received(1, &heartbeat(sender(number)));
        }
        let status_now = now(&status, 1);
        assert_eq!((status_now.stations.len(), status_now.unlisted), (MAX_STATIONS, 285));
        assert_eq!((status_now.stations[0].system, status_now.stations[0].component), (255, 190));
        // Once they are silent, a new one takes the place of the oldest.
        let later_ns = 11 * SECOND_NS;
        status.received(later_ns, &heartbeat(sender(299)));
        let status_now = now(&status, later_ns);
        assert_eq!((status_now.stations.len(), status_now.unlisted), (MAX_STATIONS, 285));
        let last = status_now.stations.last().unwrap();
        assert_eq!((last.system, last.component, last.silent), (2, 49, false));
        assert!(status_now.stations.iter().all(|it| it.system != 255), "the oldest gave way");
        assert!(
            messages::encode(&status_now).len() < 1000,
            "{}",
            messages::encode(&status_now).len()
        );
    }

    #[test]
    fn a_change_is_published_soon_and_all_else_from_time_to_time() {
        let mut status = ground(None);
        let mut published = Vec::new();
        // 20 s in steps of 50 ms; the station sends from 1 s to 2.7 s.
        for step in 0..400_i64 {
            let now_ns = step * 50_000_000;
            if (20..55).contains(&step) {
                status.received(now_ns, &heartbeat(GROUND));
            }
            published.extend(status.due(now_ns, None, LinkCounts::default()));
        }
        let at_ms: Vec<i64> = published.iter().map(|it| it.stamp_ns / 1_000_000).collect();
        // At the start, when it appears, every two seconds, and when it is silent.
        assert_eq!(at_ms, [0, 1000, 3000, 5000, 7000, 9000, 11000, 12750, 14750, 16750, 18750]);
        let silent: Vec<bool> =
            published.iter().flat_map(|it| &it.stations).map(|it| it.silent).collect();
        assert_eq!(silent.iter().filter(|it| **it).count(), 4);
        // A flood of refused packets is reported twice a second.
        let mut times = 0;
        for step in 0..200_i64 {
            status.refused(&heartbeat(GROUND), "only monitoring");
            let now_ns = 30 * SECOND_NS + step * 50_000_000;
            times += usize::from(status.due(now_ns, None, LinkCounts::default()).is_some());
        }
        assert_eq!(times, 20);
    }
}
