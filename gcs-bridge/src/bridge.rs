//! The service: one loop over everything that arrives, from either side.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use autopilot::compose::heartbeat;
use autopilot::dialect::{MavMessage, MavSeverity, MavState};
use autopilot::link::SendError;
use autopilot::packet::{Counters, encode};
use autopilot::{Address, Link, LinkEvent, LinkSender, Packet, Parser, Sender};
use messages::{ControllerStatus, MavlinkBytes, Phase, TargetEstimate, topic};
use node::{HealthCounters, Node, Shutdown, now_ns};
use tokio::time::{MissedTickBehavior, interval};

use crate::config::Config;
use crate::route::{self, Route};
use crate::target::Display;
use crate::text::Teller;
use crate::vehicle::Vehicle;

/// How often MAVLink wants a heartbeat.
const HEARTBEAT: Duration = Duration::from_secs(1);
/// A ground station that was silent for so long is told everything anew.
const GROUND_SILENCE_NS: i64 = 10_000_000_000;

/// Passes MAVLink between the autopilot's topics and the ground station, and tells it of the landing, until shutdown.
///
/// # Errors
/// When the address cannot be listened on, another bridge has this name, or the network session ends. A ground station
/// that is not there is no error.
pub async fn run(node: Node, config: Config, shutdown: Shutdown) -> anyhow::Result<()> {
    let address: Address = config.ground.parse()?;
    node.claim_unique_name(&node.identity().instance).await?;
    let mut ground = Link::open(address).await.context("opening the link to the ground station")?;
    let from_autopilot = node.subscriber(topic::FROM_AUTOPILOT, &[]).await?;
    let to_autopilot = node.publisher(topic::TO_AUTOPILOT, &[]).await?;
    let statuses = node.subscriber(topic::STATUS, &[]).await?;
    let targets = node.subscriber(topic::TARGET, &[]).await?;
    let controllers = node.presence("controller").await?;
    let mut second = interval(HEARTBEAT);
    second.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut bridge = Bridge::new(&config, ground.sender(), node.shared_health());
    node.announce().await?;
    tracing::info!(ground = config.ground, "Ready");
    loop {
        tokio::select! {
            () = shutdown.requested() => return Ok(()),
            event = ground.recv() => {
                if let Some(packet) = bridge.up(now_ns(), event) {
                    to_autopilot.publish(&MavlinkBytes { packet }).await;
                }
            }
            message = from_autopilot.next() => {
                bridge.down(now_ns(), &message.context(CLOSED)?.packet);
            }
            status = statuses.next() => bridge.status(now_ns(), status.context(CLOSED)?),
            target = targets.next() => bridge.target(now_ns(), &target.context(CLOSED)?),
            change = controllers.next() => {
                let (controller, is_there) = change.context(CLOSED)?;
                bridge.controller(now_ns(), controller, is_there);
            }
            _ = second.tick() => {
                bridge.count_losses(ground.counters(), ground.dropped());
                bridge.second(now_ns());
            }
        }
    }
}

const CLOSED: &str = "the network session was closed";

/// The bridge between two packets.
struct Bridge {
    component: u8,
    forwards: bool,
    ground: LinkSender,
    health: Arc<HealthCounters>,
    vehicle: Vehicle,
    /// Reads what comes from the autopilot's topic.
    parser: Parser,
    teller: Teller,
    display: Display,
    status: Option<ControllerStatus>,
    controllers: BTreeSet<String>,
    /// Whether a controller was there and left.
    deserted: bool,
    ground_heard_ns: Option<i64>,
    /// Bytes and packets of the ground that were lost, as far as they are counted.
    noise: u64,
    unread: u64,
    /// Number of our next packet.
    sequence: u8,
}

impl Bridge {
    fn new(config: &Config, ground: LinkSender, health: Arc<HealthCounters>) -> Self {
        let now_ns = now_ns();
        let assume_at_ns =
            now_ns.saturating_add((config.assume_system_after_s * 1e9).round() as i64);
        Self {
            component: config.component_id,
            forwards: config.forward_to_autopilot,
            ground,
            health,
            vehicle: Vehicle::new(config.system_id, assume_at_ns),
            parser: Parser::new(),
            teller: Teller::new(now_ns),
            display: Display::new(config.target_rate_hz, config.target_max_age_ms),
            status: None,
            controllers: BTreeSet::new(),
            deserted: false,
            ground_heard_ns: None,
            noise: 0,
            unread: 0,
            sequence: 0,
        }
    }

    /// Who we are, once it is known whose companion.
    fn me(&self, now_ns: i64) -> Option<Sender> {
        let system = self.vehicle.system(now_ns)?;
        Some(Sender { system, component: self.component })
    }

    /// Passes packets of the autopilot down.
    fn down(&mut self, now_ns: i64, payload: &[u8]) {
        let mut packets = self.parser.push(payload);
        packets.extend(self.parser.finish());
        if packets.is_empty() {
            self.health.dropped("from autopilot: no MAVLink packet");
        }
        for packet in packets {
            self.vehicle.hear(now_ns, &packet);
            match route::from_autopilot(&packet, self.me(now_ns)) {
                Route::Drop(reason) => self.health.dropped(reason),
                Route::Pass | Route::Answer(_) => {
                    self.health.count("from autopilot");
                    self.send(&packet.raw);
                }
            }
        }
    }

    /// The packet for the autopilot in what happened on the ground's side, if there is one.
    fn up(&mut self, now_ns: i64, event: LinkEvent) -> Option<Vec<u8>> {
        match event {
            LinkEvent::Connected { peer } => {
                tracing::info!(peer, "The link to the ground station is open");
                None
            }
            LinkEvent::Disconnected { reason } => {
                self.health.failed("link to the ground station lost");
                tracing::warn!(reason, "The link to the ground station is closed");
                None
            }
            LinkEvent::Packet { packet, .. } => self.packet_from_ground(now_ns, *packet),
        }
    }

    fn packet_from_ground(&mut self, now_ns: i64, packet: Packet) -> Option<Vec<u8>> {
        self.health.count("from ground");
        match route::from_ground(&packet, self.me(now_ns), &self.vehicle) {
            Route::Drop(reason) => self.health.dropped(reason),
            Route::Answer(message) => {
                self.hear_ground(now_ns, packet.sender);
                self.speak(now_ns, &message);
            }
            Route::Pass => {
                self.hear_ground(now_ns, packet.sender);
                if self.forwards {
                    self.health.count("to autopilot");
                    return Some(packet.raw);
                }
                self.health.dropped("from ground: forward_to_autopilot is off");
            }
        }
        None
    }

    fn hear_ground(&mut self, now_ns: i64, sender: Sender) {
        let heard = self.ground_heard_ns.replace(now_ns);
        if heard.is_none_or(|heard| now_ns.saturating_sub(heard) > GROUND_SILENCE_NS) {
            let Sender { system, component } = sender;
            tracing::info!(system, component, "A ground station is heard");
            self.teller.forget();
            self.tell(now_ns);
        }
    }

    /// Takes what the controller does.
    fn status(&mut self, now_ns: i64, status: ControllerStatus) {
        self.status = Some(status);
        self.tell(now_ns);
    }

    /// Tells what is new in the controller's status.
    fn tell(&mut self, now_ns: i64) {
        // Nothing counts as told that could not be sent.
        if self.me(now_ns).is_none() {
            return;
        }
        let Some(status) = &self.status else { return };
        for packet in self.teller.status(now_ns, status) {
            self.health.count("texts");
            self.speak(now_ns, &packet);
        }
    }

    /// Shows the landing point.
    fn target(&mut self, now_ns: i64, estimate: &TargetEstimate) {
        if self.me(now_ns).is_none() {
            return;
        }
        if let Some(message) = self.display.show(now_ns, estimate) {
            self.health.count("landing targets");
            self.speak(now_ns, &message);
        }
    }

    /// Tells when the last controller leaves, and when one is back.
    fn controller(&mut self, now_ns: i64, controller: String, is_there: bool) {
        if is_there {
            self.controllers.insert(controller);
        } else {
            self.controllers.remove(&controller);
        }
        let deserted = self.controllers.is_empty() && !is_there;
        if deserted == self.deserted {
            return;
        }
        self.deserted = deserted;
        let (severity, text) = if deserted {
            // The next controller's phase is news even when it is the same.
            self.status = None;
            self.teller.forget();
            (MavSeverity::MAV_SEVERITY_WARNING, "Alight: the controller is gone")
        } else {
            (MavSeverity::MAV_SEVERITY_NOTICE, "Alight: the controller is back")
        };
        if self.me(now_ns).is_none() {
            return;
        }
        match self.teller.say(now_ns, severity, text) {
            Some(packets) => packets.iter().for_each(|packet| self.speak(now_ns, packet)),
            None => self.health.dropped("texts: too many"),
        }
    }

    /// Counts what was lost on the ground's side since the last second.
    fn count_losses(&mut self, heard: Counters, unread: u64) {
        if heard.bad_bytes > self.noise {
            self.health.dropped("from ground: seconds with bytes that are no packet");
        }
        for _ in self.unread..unread {
            self.health.dropped("from ground: not read in time");
        }
        self.noise = heard.bad_bytes;
        self.unread = unread;
    }

    /// What is done every second: the heartbeat, and what could not be told earlier.
    fn second(&mut self, now_ns: i64) {
        self.speak(now_ns, &self.heartbeat());
        self.tell(now_ns);
    }

    fn heartbeat(&self) -> MavMessage {
        let lands = self
            .status
            .as_ref()
            .is_some_and(|status| !status.finished && status.phase != Phase::Idle);
        let mut message = heartbeat();
        if let MavMessage::HEARTBEAT(heartbeat) = &mut message
            && !lands
        {
            heartbeat.system_status = MavState::MAV_STATE_STANDBY;
        }
        message
    }

    /// Sends a message of our own to the ground, if we have a number.
    fn speak(&mut self, now_ns: i64, message: &MavMessage) {
        let Some(me) = self.me(now_ns) else { return };
        let packet = encode(me, self.sequence, message);
        self.sequence = self.sequence.wrapping_add(1);
        self.send(&packet);
    }

    fn send(&self, packet: &[u8]) {
        match self.ground.send(packet) {
            Ok(()) => self.health.count("to ground"),
            Err(SendError::NotConnected) => self.health.dropped("to ground: nobody there"),
            Err(SendError::Full) => self.health.dropped("to ground: the line is too slow"),
        }
    }
}
