//! The controller's service: joins topics and the autopilot's link to the flight, hands it detections, commands and packets,
//! and publishes status, target, vehicle state, tape and the autopilot's packets.

use std::time::Duration;

use anyhow::Context;
use autopilot::dialect::MavMessage;
use autopilot::packet::{MAX_PACKET, is_setpoint};
use autopilot::signing::Refusals;
use autopilot::{Address, GivenCommand, Link, LinkEvent, Packet, Parser, Peering, Permission};
use messages::{
    CommandReply, ControllerCommand, ControllerStatus, MavlinkBytes, VehicleState, topic,
};
use node::{BoxFuture, HealthCounters, Node, Publisher, Request, Shutdown, Standstill, now_ns};
use tokio::sync::mpsc;
use tokio::time::{MissedTickBehavior, interval, sleep, timeout};

use crate::config::{Config, TICK};
use crate::flight::Flight;
use crate::note_file::{LandingFile, NoteFile, PadFile, remove_useless_pads};
use crate::tape::TapedFlight;
use crate::tape_publisher::Tapes;
use crate::unreadable::UnreadableDetections;

/// Longest wait at shutdown for the autopilot to confirm that its parameter is put back, and for the heartbeats, one a second, after
/// which a PX4 is asked to hold its place, and which shows that it does.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(3);
/// Period of the status while nothing changes, in nanoseconds.
const STATUS_PERIOD_NS: i64 = 200_000_000;
/// Period of the check whether the status has changed, in nanoseconds.
const CHECK_PERIOD_NS: i64 = 20_000_000;
/// Minimum period of the vehicle's state, in nanoseconds.
const VEHICLE_PERIOD_NS: i64 = 18_000_000;
/// Maximum number of the autopilot's packets that wait for the network; more are dropped, as the flight never
/// waits.
const MAX_WAITING_PACKETS: usize = 512;
/// Time for the last packet to be put on the wire.
const LAST_PACKET: Duration = Duration::from_millis(100);

/// Runs the service until shutdown.
///
/// # Errors
/// When another controller is running, the link cannot be opened, or the network fails.
pub fn run(
    node: Node,
    config: Config,
    shutdown: Shutdown,
) -> BoxFuture<'static, anyhow::Result<()>> {
    Box::pin(run_service(node, config, shutdown))
}

async fn run_service(node: Node, mut config: Config, shutdown: Shutdown) -> anyhow::Result<()> {
    node.claim_unique_name("*").await?;
    let address: Address = config.autopilot.address.parse()?;
    let mut landing_file = LandingFile::new(&config.id, &config.autopilot.address);
    config.go_on_with(landing_file.read());
    let wanted = config.system_id();
    let peering = Peering::Autopilot { system: wanted };
    let permission: Permission = config.autopilot.ground_may.parse()?;
    let mut link = Link::open_for(address, peering, config.signing()?)
        .await
        .context("opening the link to the autopilot")?;
    drop(tokio::task::spawn_blocking(remove_useless_pads));
    let mut note_file = NoteFile::new(&config.id, &config.autopilot.address);
    let mut pad_file = PadFile::new(&config.id, &config.autopilot.address);
    let mut flight = TapedFlight::new(now_ns(), config, node.shared_health())?;
    if let Some(note) = note_file.read() {
        flight.take_over(now_ns(), note);
    }
    if let Some(note) = pad_file.read() {
        flight.take_over_pad(now_ns(), note);
    }

    let detections = node.subscriber(topic::DETECTIONS, &[]).await?;
    let cameras = node.subscriber(topic::CAMERA_INFO, &[]).await?;
    let presence = node.presence("detector").await?;
    let infos = node.subscriber(topic::DETECTOR_INFO, &[]).await?;
    let commands = node.commands(topic::COMMAND, &[]).await?;
    let to_autopilot = node.subscriber(topic::TO_AUTOPILOT, &[]).await?;
    let targets = node.publisher(topic::TARGET, &[]).await?;
    let mut reports = Reports::new(&node).await?;
    let mut tapes = Tapes::new(&node).await?;
    node.announce().await?;

    let (mut strangers, mut replaced) = (0, 0);
    let mut refusals = Refusals::default();
    let mut other_versions = 0;
    let mut unreadable = UnreadableDetections::default();
    let mut standstill = Standstill::default();
    let mut ticks = interval(TICK);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        standstill.step(now_ns());
        tokio::select! {
            // Whichever is ready, in random order: a busy source must not starve the others.
            () = shutdown.requested() => break,
            event = link.recv() => match event {
                LinkEvent::Packet { packet, received } => {
                    // The time spent in our own queue is not part of the link's delay.
                    let waited_ns = i64::try_from(received.elapsed().as_nanos()).unwrap_or(0);
                    flight.packet(now_ns().saturating_sub(waited_ns), &packet);
                    reports.pass_on(&node, packet.raw);
                }
                // Not passed on: a ground station would take it for a vehicle that it can fly through us.
                LinkEvent::OtherAutopilot { packet, received } => {
                    let waited_ns = i64::try_from(received.elapsed().as_nanos()).unwrap_or(0);
                    flight.packet(now_ns().saturating_sub(waited_ns), &packet);
                }
                LinkEvent::Connected { peer } => tracing::info!(peer, "Link to the autopilot is up"),
                LinkEvent::Disconnected { reason } => {
                    node.health().failed("link");
                    tracing::warn!(reason, "Link to the autopilot is down; reconnecting");
                }
            },
            Some((key, message)) = detections.next_with_key() => {
                let publisher = topic::DETECTIONS.first_name(&key).unwrap_or_default();
                if flight.detections(now_ns(), publisher, &message) {
                    send(&node, &link, &mut flight);
                    targets.publish(&flight.flight().target(now_ns())).await;
                }
            }
            _ = ticks.tick() => {
                if has_more_other_versions(node.health(), &mut other_versions) {
                    flight.refused_version(now_ns());
                }
                flight.tick(now_ns());
                unreadable.step(now_ns(), node.health());
                let more = link.unknown_senders().saturating_sub(strangers);
                if more > 0 {
                    strangers += more;
                    if node.health().failed_times("packets of an unknown sender at the autopilot's port", more) {
                        tracing::warn!("Packets of another sender than the autopilot arrive at its port, and are ignored (further ones are only counted)");
                    }
                }
                let more = link.replaced().saturating_sub(replaced);
                if more > 0 {
                    replaced += more;
                    node.health().dropped_times("setpoints: the line to the autopilot is too slow", more);
                }
                for (reason, more) in link.refusals().since(refusals) {
                    if node.health().failed_times(&format!("from autopilot: refused: {reason}"), more) {
                        tracing::warn!(%reason, "Packets on the autopilot's link are refused (further ones are only counted)");
                    }
                }
                refusals = link.refusals();
            }
            Some((detector, alive)) = presence.next() => flight.presence(now_ns(), &detector, alive),
            Some((key, info)) = infos.next_with_key() => {
                let publisher = topic::DETECTOR_INFO.first_name(&key).unwrap_or_default();
                unreadable.announced(publisher, &info.camera);
                flight.on_detector_info(now_ns(), publisher, &info);
            }
            Some(request) = commands.next() => {
                let reply = match late_because(&mut standstill, &request) {
                    Some(reason) => {
                        node.health().failed("commands: too late");
                        CommandReply { accepted: false, reason }
                    }
                    None => flight.command(now_ns(), &request.message),
                };
                // The requester may be gone, and the setpoints do not wait for it.
                tokio::spawn(async move { request.answer(&reply).await });
            }
            Some(info) = cameras.next() => flight.camera(now_ns(), info),
            Some(message) = to_autopilot.next() => {
                // An arming or a mode that waited while this process was frozen is not wanted any more.
                if standstill.step(now_ns()).is_some() {
                    node.health().dropped("packets of the ground station: too late");
                } else if let Some(kind) =
                    pass_up(&node, &mut flight, &reports, permission, &message.packet)
                {
                    send_up(&node, &link, kind, &message.packet);
                }
            }
        }
        // Written before the packet that changes the parameter is sent.
        note_file.keep(flight.flight().note());
        pad_file.keep(flight.flight().pad_note());
        landing_file.keep(flight.flight().landed_system());
        send(&node, &link, &mut flight);
        tapes.pass_on(&mut flight);
        let instead = || link.received().why_no_heartbeat(wanted);
        reports.publish(flight.flight(), &unreadable, instead).await;
    }
    let deadline = tokio::time::Instant::now() + SHUTDOWN_TIMEOUT;
    while flight.shutdown(now_ns()) && tokio::time::Instant::now() < deadline {
        send(&node, &link, &mut flight);
        if let Ok(LinkEvent::Packet { packet, .. }) = timeout(TICK, link.recv()).await {
            flight.packet(now_ns(), &packet);
        }
    }
    note_file.keep(flight.flight().note());
    send(&node, &link, &mut flight);
    tapes.end(&mut flight).await;
    // The link's own task needs a moment to put the last packet on the wire, a setpoint on a slow line a little more.
    sleep(LAST_PACKET).await;
    Ok(())
}

/// Why a command is not carried out that may have waited while this process was frozen, and does not say when it was sent.
fn late_because(
    standstill: &mut Standstill,
    request: &Request<ControllerCommand>,
) -> Option<String> {
    let frozen = standstill.step(now_ns()).filter(|_| request.sent_ns.is_none())?;
    Some(format!(
        "the controller stood still for {:.1} s, and the command may have waited as long; give it again if it is still wanted",
        frozen.as_secs_f64()
    ))
}

/// The kind of a ground station's packet.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
enum FromGround {
    /// A command, or a change of mode.
    Command,
    /// Anything else.
    Other,
}

impl FromGround {
    #[allow(deprecated, reason = "ground stations still send what the standard calls superseded")]
    fn of(packets: &[Packet]) -> Self {
        let is_command = packets.iter().any(|packet| {
            let is_mode = matches!(packet.message, Some(MavMessage::SET_MODE(_)));
            is_mode || GivenCommand::of(packet).is_some()
        });
        if is_command { Self::Command } else { Self::Other }
    }
}

/// Sends a packet of a ground station to the autopilot, behind all of ours.
fn send_up(node: &Node, link: &Link, kind: FromGround, packet: &[u8]) {
    let sent = match kind {
        FromGround::Command => link.send_command(packet),
        FromGround::Other => link.send_spare(packet),
    };
    match (sent, kind) {
        (Ok(()), _) => {}
        (Err(_), FromGround::Other) => node.health().dropped("packets of the ground station"),
        (Err(problem), FromGround::Command) => {
            if node.health().failed("commands of the ground station: not sent") {
                tracing::warn!(
                    %problem,
                    "A command of a ground station was dropped, and has no answer (further ones are only counted)"
                );
            }
        }
    }
}

/// The kind of a ground station's packet that goes to the autopilot, and `None` if it does not; the flight receives it before.
fn pass_up(
    node: &Node,
    flight: &mut TapedFlight,
    reports: &Reports,
    permission: Permission,
    bytes: &[u8],
) -> Option<FromGround> {
    if !(1..=MAX_PACKET).contains(&bytes.len()) {
        node.health().dropped("packets of the ground station");
        return None;
    }
    let mut parser = Parser::new();
    let mut packets = parser.push(bytes);
    packets.extend(parser.finish());
    for packet in &packets {
        flight.ground_packet(now_ns(), packet);
    }
    let Some(name) = refused(permission, &packets, bytes.len()) else {
        return Some(FromGround::of(&packets));
    };
    if node.health().failed(&format!("packets of the ground station refused: {name}")) {
        tracing::warn!(
            %permission,
            "Packet of a ground station refused: {name} (see `autopilot.ground_may`; further ones are only counted)"
        );
    }
    denials(&packets, flight.flight().system()).for_each(|answer| reports.pass_on(node, answer));
    None
}

/// The kind of the refused packet among those in so many bytes, if one is refused.
fn refused(permission: Permission, packets: &[Packet], bytes: usize) -> Option<&'static str> {
    // Bytes in which no packet is recognised could be any message.
    let parsed: usize = packets.iter().map(|packet| packet.raw.len()).sum();
    let is_read = parsed == bytes || permission == Permission::Everything;
    let refusal = packets.iter().find_map(|packet| permission.refusal(packet));
    refusal.or((!is_read).then_some("unknown message"))
}

/// The answers to the commands in refused packets, in the name of their target: the commands would be repeated until an answer comes.
fn denials(packets: &[Packet], system: Option<u8>) -> impl Iterator<Item = Vec<u8>> {
    packets.iter().filter_map(move |it| Some(GivenCommand::of(it)?.denied(system, 0, it.sender)))
}

/// Sends the flight's packets.
fn send(node: &Node, link: &Link, flight: &mut TapedFlight) {
    while let Some(packet) = flight.poll_outgoing() {
        let sent = match is_setpoint(&packet) {
            true => link.send_newest(&packet),
            false => link.send(&packet),
        };
        if sent.is_err() {
            node.health().dropped("packets for the autopilot");
        }
    }
}

/// Whether messages of another version were refused since the last call.
fn has_more_other_versions(health: &HealthCounters, so_far: &mut u64) -> bool {
    let refused = health.failures("payload: wrong version");
    std::mem::replace(so_far, refused) < refused
}

/// Publishes status, vehicle state and the autopilot's packets.
struct Reports {
    status: Publisher<ControllerStatus>,
    vehicle: Publisher<VehicleState>,
    packets: mpsc::Sender<Vec<u8>>,
    last: Option<ControllerStatus>,
    vehicle_ns: i64,
    checked_ns: i64,
}

impl Reports {
    async fn new(node: &Node) -> anyhow::Result<Self> {
        let (packets, mut waiting) = mpsc::channel::<Vec<u8>>(MAX_WAITING_PACKETS);
        let publisher = node.publisher(topic::FROM_AUTOPILOT, &[]).await?;
        tokio::spawn(async move {
            while let Some(packet) = waiting.recv().await {
                publisher.publish(&MavlinkBytes { packet }).await;
            }
        });
        Ok(Self {
            status: node.publisher(topic::STATUS, &[]).await?,
            vehicle: node.publisher(topic::VEHICLE_STATE, &[]).await?,
            packets,
            last: None,
            vehicle_ns: i64::MIN,
            checked_ns: i64::MIN,
        })
    }

    fn pass_on(&self, node: &Node, packet: Vec<u8>) {
        if self.packets.try_send(packet).is_err() {
            node.health().dropped("packets of the autopilot");
        }
    }

    /// Publishes the vehicle at its rate, and the status when it changes or is due, with the unreadable detections, and with the packets
    /// that the link received before the first heartbeat.
    async fn publish(
        &mut self,
        flight: &Flight,
        unreadable: &UnreadableDetections,
        instead: impl FnOnce() -> String,
    ) {
        let now = now_ns();
        if now.saturating_sub(self.vehicle_ns) >= VEHICLE_PERIOD_NS
            && let Some(vehicle) = flight.vehicle()
        {
            self.vehicle_ns = now;
            self.vehicle.publish(&vehicle).await;
        }
        if now.saturating_sub(self.checked_ns) < CHECK_PERIOD_NS || flight.has_stood_still(now) {
            return;
        }
        self.checked_ns = now;
        let mut status = flight.status(now);
        unreadable.report(now, &mut status);
        if flight.system().is_none() {
            status.autopilot = instead();
        }
        let is_due = self.last.as_ref().is_none_or(|last| {
            now - last.stamp_ns >= STATUS_PERIOD_NS
                || (&last.phase, &last.active_detector, last.finished, last.waits_for_operator)
                    != (
                        &status.phase,
                        &status.active_detector,
                        status.finished,
                        status.waits_for_operator,
                    )
        });
        if is_due {
            self.status.publish(&status).await;
            self.last = Some(status);
        }
    }
}

#[cfg(test)]
#[allow(deprecated, reason = "ground stations still send what the standard calls superseded")]
mod tests {
    use super::*;
    use autopilot::Sender;
    use autopilot::dialect::{
        COMMAND_INT_DATA, COMMAND_LONG_DATA, MavCmd, MavResult, PARAM_SET_DATA, SET_MODE_DATA,
        SETUP_SIGNING_DATA,
    };
    use autopilot::packet::encode;

    #[test]
    fn no_key_of_signed_packets_goes_to_the_autopilot() {
        let ground = Sender { system: 255, component: 190 };
        let key = MavMessage::SETUP_SIGNING(SETUP_SIGNING_DATA::default());
        let bytes = encode(ground, 0, &key);
        let packets = Parser::new().push(&bytes);
        let name = refused(Permission::Everything, &packets, bytes.len());
        assert_eq!(name, Some("SETUP_SIGNING"));
    }

    #[test]
    fn a_refused_command_is_answered_as_by_the_autopilot() {
        let ground = Sender { system: 255, component: 190 };
        let arm = COMMAND_LONG_DATA {
            command: MavCmd::MAV_CMD_COMPONENT_ARM_DISARM,
            target_system: 7,
            target_component: 1,
            ..COMMAND_LONG_DATA::default()
        };
        let bytes = encode(ground, 0, &MavMessage::COMMAND_LONG(arm));
        let packets = Parser::new().push(&bytes);
        assert_eq!(refused(Permission::Everything, &packets, bytes.len()), None);
        let name = refused(Permission::NoArming, &packets, bytes.len());
        assert_eq!(name, Some("arming or stopping motors"));
        let answer = Parser::new().push(&denials(&packets, None).next().unwrap()).remove(0);
        assert_eq!(answer.sender, Sender { system: 7, component: 1 });
        let Some(MavMessage::COMMAND_ACK(answer)) = answer.message else { panic!("no answer") };
        assert_eq!(answer.command, MavCmd::MAV_CMD_COMPONENT_ARM_DISARM);
        assert_eq!(answer.result, MavResult::MAV_RESULT_DENIED);
        assert_eq!((answer.target_system, answer.target_component), (255, 190));
    }

    #[test]
    fn commands_and_modes_of_a_ground_station_are_distinguished_from_its_other_packets() {
        let kind = |message: &MavMessage| {
            let bytes = encode(Sender { system: 255, component: 190 }, 0, message);
            FromGround::of(&Parser::new().push(&bytes))
        };
        for command in [
            MavMessage::COMMAND_LONG(COMMAND_LONG_DATA::default()),
            MavMessage::COMMAND_INT(COMMAND_INT_DATA::default()),
            MavMessage::SET_MODE(SET_MODE_DATA::default()),
        ] {
            assert_eq!(kind(&command), FromGround::Command, "{command:?}");
        }
        let other = MavMessage::PARAM_SET(PARAM_SET_DATA::default());
        assert_eq!(kind(&other), FromGround::Other);
    }
}
