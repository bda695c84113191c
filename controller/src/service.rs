//! The service: detectors, autopilot and operator in, setpoints and reports out.

use std::time::Duration;

use anyhow::Context;
use autopilot::packet::MAX_PACKET;
use autopilot::{Address, Link, LinkEvent, Parser};
use messages::{ControllerStatus, MavlinkBytes, VehicleState, topic};
use node::{Node, Publisher, Shutdown, now_ns};
use tokio::sync::mpsc;
use tokio::time::{MissedTickBehavior, interval};

use crate::config::Config;
use crate::flight::Flight;

/// How often time is let pass for the flight.
const TICK: Duration = Duration::from_millis(25);
/// How often the status is published when nothing changes.
const STATUS_PERIOD_NS: i64 = 200_000_000;
/// How often it is looked at whether something has changed.
const LOOK_PERIOD_NS: i64 = 20_000_000;
/// How often the vehicle's state is published at most.
const VEHICLE_PERIOD_NS: i64 = 18_000_000;
/// Packets of the autopilot that wait to be passed on; more are dropped, as the flight never waits for the network.
const PACKETS_WAITING: usize = 512;

/// Runs the service until it is asked to stop.
///
/// # Errors
/// When another controller is there, the link cannot be opened, or the network fails.
pub async fn run(node: Node, config: Config, shutdown: Shutdown) -> anyhow::Result<()> {
    node.claim_unique_name("*").await?;
    let address: Address = config.autopilot.address.parse()?;
    let mut link = Link::open(address).await.context("opening the link to the autopilot")?;
    let mut flight = Flight::new(config, node.shared_health())?;

    let detections = node.subscriber(topic::DETECTIONS, &[]).await?;
    let cameras = node.subscriber(topic::CAMERA_INFO, &[]).await?;
    let presence = node.presence("detector").await?;
    let infos = node.subscriber(topic::DETECTOR_INFO, &[]).await?;
    let commands = node.commands(topic::COMMAND, &[]).await?;
    let to_autopilot = node.subscriber(topic::TO_AUTOPILOT, &[]).await?;
    let targets = node.publisher(topic::TARGET, &[]).await?;
    let mut reports = Reports::new(&node).await?;
    node.announce().await?;

    let mut ticks = interval(TICK);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            // Whichever is ready, in no order: one that talks without end must not silence the others.
            () = shutdown.requested() => break,
            event = link.recv() => match event {
                LinkEvent::Packet { packet, received } => {
                    // What waited in a queue here was not under way from the autopilot.
                    let waited_ns = i64::try_from(received.elapsed().as_nanos()).unwrap_or(0);
                    flight.packet(now_ns().saturating_sub(waited_ns), &packet);
                    reports.pass_on(&node, packet.raw);
                }
                LinkEvent::Connected { peer } => tracing::info!(peer, "Link to the autopilot"),
                LinkEvent::Disconnected { reason } => {
                    node.health().failed("link");
                    tracing::warn!(reason, "The link to the autopilot is down; it is tried again");
                }
            },
            Some((key, message)) = detections.next_with_key() => {
                let publisher = topic::DETECTIONS.first_name(&key).unwrap_or_default();
                if flight.detections(now_ns(), publisher, &message) {
                    send(&node, &link, &mut flight);
                    targets.publish(&flight.target(now_ns())).await;
                }
            }
            _ = ticks.tick() => flight.tick(now_ns()),
            Some((detector, alive)) = presence.next() => flight.presence(now_ns(), &detector, alive),
            Some((key, info)) = infos.next_with_key() => {
                let publisher = topic::DETECTOR_INFO.first_name(&key).unwrap_or_default();
                flight.introduced(now_ns(), publisher, &info);
            }
            Some(request) = commands.next() => {
                let reply = flight.command(now_ns(), &request.message);
                // Whoever asked may not listen, and the setpoints do not wait for that.
                tokio::spawn(async move { request.answer(&reply).await });
            }
            Some(info) = cameras.next() => flight.camera(info),
            Some(message) = to_autopilot.next() => {
                let is_packet = (1..=MAX_PACKET).contains(&message.packet.len());
                for packet in Parser::new().push(&message.packet) {
                    flight.ground_packet(now_ns(), &packet);
                }
                if !is_packet || link.send_spare(&message.packet).is_err() {
                    node.health().dropped("packets of the ground station");
                }
            }
        }
        send(&node, &link, &mut flight);
        reports.publish(&flight).await;
    }
    flight.leave(now_ns());
    send(&node, &link, &mut flight);
    // The link's own task needs a moment to put the last packet on the wire.
    tokio::time::sleep(TICK).await;
    Ok(())
}

/// Sends what the flight wants to say.
fn send(node: &Node, link: &Link, flight: &mut Flight) {
    while let Some(packet) = flight.poll_outgoing() {
        if link.send(&packet).is_err() {
            node.health().dropped("packets for the autopilot");
        }
    }
}

/// What the service tells others.
struct Reports {
    status: Publisher<ControllerStatus>,
    vehicle: Publisher<VehicleState>,
    packets: mpsc::Sender<Vec<u8>>,
    last: Option<ControllerStatus>,
    vehicle_ns: i64,
    looked_ns: i64,
}

impl Reports {
    async fn new(node: &Node) -> anyhow::Result<Self> {
        let (packets, mut waiting) = mpsc::channel::<Vec<u8>>(PACKETS_WAITING);
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
            looked_ns: i64::MIN,
        })
    }

    fn pass_on(&self, node: &Node, packet: Vec<u8>) {
        if self.packets.try_send(packet).is_err() {
            node.health().dropped("packets of the autopilot");
        }
    }

    /// Publishes the vehicle at its rate, and the status when it changes or is due.
    async fn publish(&mut self, flight: &Flight) {
        let now = now_ns();
        if now.saturating_sub(self.vehicle_ns) >= VEHICLE_PERIOD_NS
            && let Some(vehicle) = flight.vehicle()
        {
            self.vehicle_ns = now;
            self.vehicle.publish(&vehicle).await;
        }
        if now.saturating_sub(self.looked_ns) < LOOK_PERIOD_NS {
            return;
        }
        self.looked_ns = now;
        let status = flight.status(now);
        let is_due = self.last.as_ref().is_none_or(|last| {
            now - last.stamp_ns >= STATUS_PERIOD_NS
                || (&last.phase, &last.active_detector, last.finished)
                    != (&status.phase, &status.active_detector, status.finished)
        });
        if is_due {
            self.status.publish(&status).await;
            self.last = Some(status);
        }
    }
}
