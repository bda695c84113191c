//! The bridge's service: one loop between the link to the ground station and the topics, which routes packets both ways, answers for
//! companion and camera, and sends texts and landing point.

use std::collections::{BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use autopilot::compose::heartbeat;
use autopilot::dialect::{
    HEARTBEAT_DATA, MavMessage, MavResult, MavSeverity, MavState, MessageData,
};
use autopilot::link::SendError;
use autopilot::packet::{Counters, encode};
use autopilot::signing::Refusals;
use autopilot::{
    Address, GivenCommand, Link, LinkEvent, LinkSender, Packet, Parser, Permission, Sender,
};
use messages::{
    Configuration, ControllerStatus, Detections, Health, MavlinkBytes, Phase, RecorderStatus,
    TargetEstimate, topic,
};
use node::{BoxFuture, HealthCounters, INSECURE, Node, OPEN, Shutdown, Standstill, now_ns};
use tokio::time::{MissedTickBehavior, interval};

use crate::camera::Camera;
use crate::config::Config;
use crate::neighbours::Neighbours;
use crate::params::{self, Ask, Parameters};
use crate::request;
use crate::route::{self, ECHO, Own, Route};
use crate::silence::Silence;
use crate::status::{GroundStatus, LinkCounts};
use crate::target::LandingTargetPublisher;
use crate::text::{StatusTextSender, refused};
use crate::vehicle::Vehicle;

/// Period of heartbeats in MAVLink.
const HEARTBEAT: Duration = Duration::from_secs(1);
/// Period at which due messages are sent: the marker's position, also when no frame comes, and parameters.
const TICK: Duration = Duration::from_millis(50);
/// Silence of the ground station after which all texts are repeated, in nanoseconds.
const GROUND_TIMEOUT_NS: i64 = 10_000_000_000;

/// Passes MAVLink between the autopilot's topics and the ground station, and reports the landing to it, until
/// shutdown.
///
/// # Errors
/// When the address cannot be opened, another bridge has this name, or the network session ends. A missing
/// ground station is not an error.
pub fn run(
    node: Node,
    config: Config,
    shutdown: Shutdown,
) -> BoxFuture<'static, anyhow::Result<()>> {
    Box::pin(run_service(node, config, shutdown))
}

async fn run_service(node: Node, config: Config, shutdown: Shutdown) -> anyhow::Result<()> {
    let address: Address = config.ground.parse()?;
    node.claim_unique_name(&node.identity().instance).await?;
    let signing = config.signing()?;
    let link_id = signing.as_ref().map(|it| it.link_id);
    let mut ground = Link::open_for(address, config.peering(), signing)
        .await
        .context("opening the link to the ground station")?;
    let from_autopilot = node.subscriber(topic::FROM_AUTOPILOT, &[]).await?;
    let to_autopilot = node.publisher(topic::TO_AUTOPILOT, &[]).await?;
    let ground_statuses = node.publisher(topic::GCS_STATUS, &[]).await?;
    let statuses = node.subscriber(topic::STATUS, &[]).await?;
    let targets = node.subscriber(topic::TARGET, &[]).await?;
    let detections = node.subscriber(topic::DETECTIONS, &[]).await?;
    let controllers = node.presence("controller").await?;
    // A relay without keys, which passes on the commands of any host, reports that in its health.
    let relays = node.subscriber(topic::HEALTH, &["relay", "*"]).await?;
    let recorders = node.subscriber(topic::RECORDER_STATUS, &[]).await?;
    let configurations = node.subscriber(topic::CONFIGURATION, &["controller", "*"]).await?;
    let bridges = node.subscriber(topic::CONFIGURATION, &["gcs-bridge", "*"]).await?;
    let mut second = interval(HEARTBEAT);
    second.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut ticks = interval(TICK);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut bridge = Bridge::new(&config, link_id, ground.sender(), node.shared_health())?;
    if config.is_open() && node.health().failed(OPEN) {
        tracing::warn!(
            ground = config.ground,
            "OPEN: the first sender may command the vehicle; name the ground stations (`ground_stations`), or \
             let them only look (`ground_may = \"monitor\"`)"
        );
    }
    node.announce().await?;
    tracing::info!(ground = config.ground, "Ready");
    let mut standstill = Standstill::default();
    loop {
        standstill.step(now_ns());
        tokio::select! {
            () = shutdown.requested() => return Ok(()),
            event = ground.recv() => {
                // An arming or a mode that waited while this process was frozen is no longer wanted.
                let is_late = standstill.step(now_ns()).is_some();
                match event {
                    LinkEvent::Packet { packet, .. } if is_late => bridge.too_late(now_ns(), &packet),
                    event => {
                        if let Some(packet) = bridge.up(now_ns(), event) {
                            to_autopilot.publish(&MavlinkBytes { packet }).await;
                        }
                    }
                }
            }
            message = from_autopilot.next() => {
                bridge.down(now_ns(), &message.context(CLOSED)?.packet);
            }
            status = statuses.next() => bridge.status(now_ns(), status.context(CLOSED)?),
            target = targets.next() => bridge.target(now_ns(), &target.context(CLOSED)?),
            found = detections.next_with_key() => {
                let (key, found) = found.context(CLOSED)?;
                let detector = topic::DETECTIONS.first_name(&key).unwrap_or_default();
                bridge.detections(now_ns(), detector, &found);
            }
            configuration = configurations.next() => {
                bridge.configuration(now_ns(), &configuration.context(CLOSED)?);
            }
            other = bridges.next() => bridge.neighbours.bridge(&other.context(CLOSED)?, &bridge.health),
            _ = ticks.tick() => {
                bridge.watch_controller(now_ns(), standstill.step(now_ns()).is_some());
                bridge.track(now_ns());
                bridge.send_parameters(now_ns());
                let system = bridge.vehicle.system(now_ns());
                if let Some(status) = bridge.ground_status.due(now_ns(), system, counts(&ground)) {
                    ground_statuses.publish(&status).await;
                }
            }
            change = controllers.next() => {
                let (controller, is_there) = change.context(CLOSED)?;
                bridge.controller(now_ns(), controller, is_there);
            }
            health = relays.next() => bridge.relay(now_ns(), &health.context(CLOSED)?),
            status = recorders.next() => bridge.recorder(now_ns(), &status.context(CLOSED)?),
            _ = second.tick() => {
                bridge.count_losses(ground.counters(), ground.dropped());
                bridge.count_strangers(ground.unknown_senders());
                bridge.count_refusals(now_ns(), ground.refusals());
                bridge.every_second(now_ns());
            }
        }
    }
}

/// The counts of the link to the ground.
fn counts(ground: &Link) -> LinkCounts {
    LinkCounts {
        strangers: ground.unknown_senders(),
        bad_checksums: ground.counters().bad_checksums,
        unread: ground.dropped(),
        refusals: ground.refusals(),
    }
}

/// The reason why a request that only the companion or the camera could answer is refused; without an acknowledgement it is dropped for the
/// same reason.
const NOT_OF_COMPANION: &str = "for the companion, and not supported";
const NOT_OF_CAMERA: &str = "for the camera, and not supported";

/// Minimum pause between two repetitions of all texts, which a ground station that begins causes, in nanoseconds: those of a station that
/// asks again for lost parameters are few.
const REPEAT_PAUSE_NS: i64 = 5_000_000_000;

/// Maximum number of controllers that are followed; there is one, and another while it is replaced.
const MAX_CONTROLLERS: usize = 16;
/// Maximum number of recorders whose problems are reported.
const MAX_RECORDERS: usize = 16;
/// Minimum pause between two texts about refused packets, in nanoseconds.
const REFUSAL_PAUSE_NS: i64 = 5_000_000_000;

/// Maximum number of the camera's heartbeats that are recognised when they return: those of a minute, as long as the backlog of a link
/// may be under way.
const MAX_CAMERA_HEARTBEATS: usize = 60;

/// Maximum number of texts that wait for their sending.
const MAX_UNSENT_TEXTS: usize = 16;

/// A relay that has not reported itself as insecure for this time counts as secure, in nanoseconds.
const INSECURE_NS: i64 = 10_000_000_000;

/// The text when the last controller has gone. On the ground, a lost link has the same effect.
const ABANDONED: &str = "Alight: controller gone, or link to drone lost";

/// The text when the controller's status stops in a landing, after `silence::MAX_SILENCE_NS`.
const SILENT: &str = "Alight: be ready to take over: no status of the controller for 2 s, it hangs, or the link to the drone does";

const CLOSED: &str = "the network session was closed";

/// The bridge between two packets.
struct Bridge {
    component: u8,
    /// The camera's component id; 0 for none.
    camera_component: u8,
    camera: Camera,
    /// Another component has the camera's id, and that was reported.
    camera_is_taken: bool,
    parameters: Parameters,
    permission: Permission,
    /// When a refusal was last reported to the ground station.
    refusal_ns: Option<i64>,
    ground: LinkSender,
    /// The published status of the ground stations.
    ground_status: GroundStatus,
    health: Arc<HealthCounters>,
    vehicle: Vehicle,
    /// Reads the bytes of the autopilot's topic.
    parser: Parser,
    texts: StatusTextSender,
    targets: LandingTargetPublisher,
    status: Option<ControllerStatus>,
    silence: Silence,
    controllers: BTreeSet<String>,
    /// True once the last controller has gone.
    is_abandoned: bool,
    /// When a relay last reported that it has no keys.
    insecure_ns: Option<i64>,
    /// Whether that was reported to the ground station.
    insecure_reported: bool,
    /// Recorders that were reported to the ground station as not recording.
    not_recording: BTreeSet<String>,
    ground_ns: Option<i64>,
    /// When all texts were last repeated.
    repeated_ns: Option<i64>,
    /// Bytes that are not packets, and packets not read in time, as counted so far.
    bad_bytes: u64,
    unread: u64,
    strangers: u64,
    /// Packets refused because of their signatures, as counted so far.
    refusals: Refusals,
    /// Texts that could not be sent yet.
    unsent_texts: VecDeque<(MavSeverity, String)>,
    /// Sequence numbers of our next packets: the companion's and the camera's.
    sequence: u8,
    camera_sequence: u8,
    neighbours: Neighbours,
    /// The camera's last heartbeats with their sequence numbers, the newest first.
    camera_heartbeats: VecDeque<(u8, HEARTBEAT_DATA)>,
}

impl Bridge {
    fn new(
        config: &Config,
        link_id: Option<u8>,
        ground: LinkSender,
        health: Arc<HealthCounters>,
    ) -> anyhow::Result<Self> {
        let now_ns = now_ns();
        let assume_at_ns =
            now_ns.saturating_add((config.assume_system_after_s * 1e9).round() as i64);
        Ok(Self {
            component: config.component_id,
            camera_component: config.camera_component_id,
            camera: Camera::new(now_ns, config.video()),
            camera_is_taken: false,
            parameters: Parameters::default(),
            permission: config.ground_may.parse()?,
            refusal_ns: None,
            ground,
            ground_status: GroundStatus::new(config, link_id),
            health,
            vehicle: Vehicle::new(config.system_id, assume_at_ns),
            parser: Parser::new(),
            texts: StatusTextSender::new(now_ns),
            targets: LandingTargetPublisher::new(config.target_rate_hz, config.target_max_age_ms),
            status: None,
            silence: Silence::default(),
            controllers: BTreeSet::new(),
            is_abandoned: false,
            insecure_ns: None,
            insecure_reported: false,
            not_recording: BTreeSet::new(),
            ground_ns: None,
            repeated_ns: None,
            bad_bytes: 0,
            unread: 0,
            strangers: 0,
            refusals: Refusals::default(),
            unsent_texts: VecDeque::new(),
            sequence: 0,
            camera_sequence: 0,
            neighbours: Neighbours::new(config),
            camera_heartbeats: VecDeque::new(),
        })
    }

    /// Our system and component id, once the vehicle's system id is known.
    fn me(&self, now_ns: i64) -> Option<Sender> {
        let system = self.vehicle.system(now_ns)?;
        Some(Sender { system, component: self.component })
    }

    /// The camera's system and component id, while no other component has them.
    fn camera_sender(&self, now_ns: i64) -> Option<Sender> {
        let system = self.vehicle.system(now_ns)?;
        let camera = Sender { system, component: self.camera_component };
        (self.camera_component != 0 && !self.vehicle.is_aboard(camera)).then_some(camera)
    }

    fn own(&self, now_ns: i64) -> Option<Own> {
        let companion = self.me(now_ns)?;
        Some(Own { companion, camera: self.camera_sender(now_ns) })
    }

    /// Passes the autopilot's packets to the ground station.
    fn down(&mut self, now_ns: i64, payload: &[u8]) {
        let mut packets = self.parser.push(payload);
        packets.extend(self.parser.finish());
        if packets.is_empty() {
            self.health.dropped("from autopilot: not a MAVLink packet");
        }
        for packet in packets {
            if !self.is_echo_of_camera(&packet) {
                self.vehicle.received(now_ns, &packet);
            }
            match route::from_autopilot(&packet, self.own(now_ns)) {
                Route::Drop(reason) => self.health.dropped(reason),
                _ => {
                    self.health.count("from autopilot");
                    self.send(&packet.raw);
                }
            }
        }
    }

    /// Whether a packet may be the camera's own, which the autopilot sends back to all its links. Another camera with that id is
    /// known by heartbeats that the bridge has not sent.
    fn is_echo_of_camera(&self, packet: &Packet) -> bool {
        let is_heartbeat = packet.message_id == HEARTBEAT_DATA::ID;
        let is_sent = self.camera_heartbeats.iter().any(|(sequence, sent)| {
            *sequence == packet.sequence
                && matches!(&packet.message, Some(MavMessage::HEARTBEAT(heartbeat)) if heartbeat == sent)
        });
        packet.sender.component == self.camera_component && (is_sent || !is_heartbeat)
    }

    /// The packet for the autopilot in an event of the ground station's link, if there is one.
    fn up(&mut self, now_ns: i64, event: LinkEvent) -> Option<Vec<u8>> {
        match event {
            LinkEvent::Connected { peer } => {
                tracing::info!(peer, "Link to the ground station is up");
                self.ground_status.up(&peer);
                // It may be another one, and texts that were sent meanwhile are lost.
                self.ground_ns = None;
                None
            }
            LinkEvent::Disconnected { reason } => {
                self.health.failed("link to the ground station lost");
                tracing::warn!(reason, "Link to the ground station is down; reconnecting");
                self.ground_status.down(&reason);
                None
            }
            LinkEvent::Packet { packet, .. } => self.packet_from_ground(now_ns, *packet),
            // Only a link to an autopilot has them.
            LinkEvent::OtherAutopilot { .. } => None,
        }
    }

    /// Drops a packet that waited too long.
    fn too_late(&mut self, now_ns: i64, packet: &Packet) {
        self.health.dropped("packets of the ground station: too late");
        if route::from_ground(packet, self.own(now_ns), &self.vehicle) != Route::Drop(ECHO) {
            self.ground_status.received(now_ns, packet);
            self.ground_status.refused(packet, "too late");
        }
    }

    fn packet_from_ground(&mut self, now_ns: i64, packet: Packet) -> Option<Vec<u8>> {
        self.health.count("from ground");
        let route = route::from_ground(&packet, self.own(now_ns), &self.vehicle);
        // No ground station sent this packet.
        if route == Route::Drop(ECHO) {
            self.health.dropped(ECHO);
            return None;
        }
        self.ground_status.received(now_ns, &packet);
        let me = self.me(now_ns);
        if me.is_some_and(|me| params::begins(&packet, me)) {
            self.ground_begins(now_ns, packet.sender);
        }
        let asked = me.and_then(|me| Ask::of(&packet, me));
        let mut refusal = None;
        if let Some(asked) = asked {
            self.ground_active(now_ns, packet.sender);
            refusal = self.asked_for_parameters(now_ns, &asked);
        }
        match route {
            Route::Drop(reason) => {
                self.health.dropped(reason);
                let reason = reason.strip_prefix("from ground: ").unwrap_or(reason);
                self.ground_status.refused(&packet, reason);
            }
            Route::Parameters => {
                if let Some(refusal) = refusal {
                    self.ground_status.refused(&packet, refusal);
                }
            }
            Route::Answer(message) => {
                self.ground_active(now_ns, packet.sender);
                self.ground_status.refused(&packet, NOT_OF_COMPANION);
                self.send_own(now_ns, &message);
            }
            Route::Camera(command) => {
                self.ground_active(now_ns, packet.sender);
                match self.command_camera(now_ns, packet.sender, command) {
                    MavResult::MAV_RESULT_ACCEPTED => {}
                    MavResult::MAV_RESULT_UNSUPPORTED => {
                        self.ground_status.refused(&packet, NOT_OF_CAMERA);
                    }
                    _ => self.ground_status.refused(&packet, "denied by the camera"),
                }
            }
            Route::Key => {
                self.ground_active(now_ns, packet.sender);
                self.ground_status.refused(&packet, "SETUP_SIGNING");
                if self.health.failed("from ground: refused: SETUP_SIGNING") {
                    tracing::warn!(
                        "A key for signed packets was not passed on; set it on the autopilot's own USB port"
                    );
                }
                let text = "Alight: SETUP_SIGNING not passed on; set the key by USB";
                self.send_answer(now_ns, MavSeverity::MAV_SEVERITY_WARNING, text);
            }
            Route::Unknown(command) => {
                self.ground_active(now_ns, packet.sender);
                let is_companions = command.target.component == self.component;
                let reason = if is_companions { NOT_OF_COMPANION } else { NOT_OF_CAMERA };
                self.ground_status.refused(&packet, reason);
                self.send(&command.unsupported(self.sequence, packet.sender));
                self.sequence = self.sequence.wrapping_add(1);
            }
            Route::Pass => {
                self.ground_active(now_ns, packet.sender);
                let Some(refusal) = self.permission.refusal(&packet) else {
                    self.health.count("to autopilot");
                    return Some(packet.raw);
                };
                self.refuse(now_ns, &packet, refusal);
            }
        }
        None
    }

    /// Acknowledges a command to the camera with the result, and sends the requested messages.
    fn command_camera(
        &mut self,
        now_ns: i64,
        from: Sender,
        command: request::Command,
    ) -> MavResult {
        let answer = request::answer(&mut self.camera, now_ns, command);
        let acknowledgement = route::acknowledgement(command.command, answer.result, from);
        self.send_from_camera(now_ns, &acknowledgement);
        for message in answer.message.iter().chain(&answer.next) {
            self.send_from_camera(now_ns, message);
        }
        if let Some(why) = answer.why {
            let text = format!("Alight: not tracked: {why}");
            self.send_answer(now_ns, MavSeverity::MAV_SEVERITY_NOTICE, &text);
        }
        answer.result
    }

    /// Answers a request of the ground station for our parameters. Returns why it is not answered as it asks: it would set one, or
    /// asks for an unknown one.
    fn asked_for_parameters(&mut self, now_ns: i64, asked: &Ask) -> Option<&'static str> {
        let answer = self.parameters.answer(asked);
        if let Some(message) = &answer.message {
            self.send_own(now_ns, message);
        }
        let why = answer.why?;
        self.send_answer(now_ns, MavSeverity::MAV_SEVERITY_WARNING, &format!("Alight: {why}"));
        Some(if matches!(asked, Ask::Set { .. }) {
            if self.health.failed("from ground: a parameter is not set from there") {
                tracing::warn!("{why} (further ones are only counted)");
            }
            "a parameter is not set from there"
        } else {
            self.health.dropped("from ground: unknown parameter");
            "unknown parameter"
        })
    }

    /// Takes the configuration of a controller.
    fn configuration(&mut self, now_ns: i64, configuration: &Configuration) {
        if !self.parameters.update(now_ns, configuration) {
            self.health.dropped("configuration of a controller: not readable");
        }
    }

    /// Sends the next of the parameters that were asked for.
    fn send_parameters(&mut self, now_ns: i64) {
        if self.me(now_ns).is_some() {
            for message in self.parameters.due() {
                self.send_own(now_ns, &message);
            }
        }
    }

    /// Takes the detections of a frame.
    fn detections(&mut self, now_ns: i64, detector: &str, found: &Detections) {
        self.camera.sees(now_ns, detector, self.status.as_ref(), found);
        self.track(now_ns);
    }

    /// Sends the tracked marker's position, when it is due.
    fn track(&mut self, now_ns: i64) {
        if let Some(message) = self.camera.due_tracking(now_ns) {
            self.health.count("tracked markers");
            self.send_from_camera(now_ns, &message);
        }
    }

    /// Counts a packet that the ground station may not send, and reports it to the ground station.
    fn refuse(&mut self, now_ns: i64, packet: &Packet, refusal: &'static str) {
        let to = packet.sender;
        self.ground_status.refused(packet, refusal);
        if self.health.failed(&format!("from ground: refused: {refusal}")) {
            let Sender { system, component } = to;
            tracing::warn!(
                system,
                component,
                permission = %self.permission,
                "Packet refused: {refusal} (`ground_may`; further ones are only counted)"
            );
        }
        if let Some(command) = GivenCommand::of(packet) {
            self.send(&command.denied(self.vehicle.system(now_ns), self.sequence, to));
        }
        let is_due =
            self.refusal_ns.is_none_or(|last| now_ns.saturating_sub(last) > REFUSAL_PAUSE_NS);
        if is_due {
            self.refusal_ns = Some(now_ns);
            let text = refused(packet, self.permission, refusal);
            self.send_answer(now_ns, MavSeverity::MAV_SEVERITY_WARNING, &text);
        }
    }

    /// Handles the health of a relay.
    fn relay(&mut self, now_ns: i64, health: &Health) {
        if health.errors.iter().any(|error| error.reason == INSECURE) {
            self.insecure_ns = Some(now_ns);
        }
        self.warn_insecure(now_ns);
    }

    /// Reports that a recorder does not record, and when it does again.
    fn recorder(&mut self, now_ns: i64, status: &RecorderStatus) {
        let was_reported = self.not_recording.contains(&status.recorder);
        match &status.problem {
            Some(problem) if !was_reported && self.not_recording.len() < MAX_RECORDERS => {
                let text = format!("Alight: not recording: {problem}");
                if self.send_text(now_ns, MavSeverity::MAV_SEVERITY_WARNING, &text) {
                    self.not_recording.insert(status.recorder.clone());
                }
            }
            None if was_reported => {
                let text = "Alight: recording again";
                if self.send_text(now_ns, MavSeverity::MAV_SEVERITY_INFO, text) {
                    self.not_recording.remove(&status.recorder);
                }
            }
            Some(_) | None => {}
        }
    }

    /// Warns each ground station once that any host can command the vehicle.
    fn warn_insecure(&mut self, now_ns: i64) {
        let is_insecure =
            self.insecure_ns.is_some_and(|last| now_ns.saturating_sub(last) < INSECURE_NS);
        if is_insecure && !self.insecure_reported && self.me(now_ns).is_some() {
            let text = "Alight: insecure: anyone in reach can command the vehicle";
            self.insecure_reported =
                self.send_text(now_ns, MavSeverity::MAV_SEVERITY_WARNING, text);
        }
    }

    fn ground_active(&mut self, now_ns: i64, sender: Sender) {
        let last = self.ground_ns.replace(now_ns);
        if last.is_none_or(|last| now_ns.saturating_sub(last) > GROUND_TIMEOUT_NS) {
            let Sender { system, component } = sender;
            tracing::info!(system, component, "Ground station found");
            self.repeat_texts(now_ns);
        }
    }

    /// A ground station begins, perhaps anew after less than the silence after which one counts as new.
    fn ground_begins(&mut self, now_ns: i64, sender: Sender) {
        self.ground_active(now_ns, sender);
        let is_due =
            self.repeated_ns.is_none_or(|last| now_ns.saturating_sub(last) > REPEAT_PAUSE_NS);
        if is_due {
            self.repeat_texts(now_ns);
        }
    }

    /// Sends all texts that describe the present state again.
    fn repeat_texts(&mut self, now_ns: i64) {
        self.repeated_ns = Some(now_ns);
        self.texts.reset();
        self.insecure_reported = false;
        self.not_recording.clear();
        if self.is_abandoned {
            self.send_or_queue(now_ns, MavSeverity::MAV_SEVERITY_WARNING, ABANDONED);
        }
        // What a silent controller stated last is not the present state; its next status sends all texts.
        if self.silence.is_long() {
            self.send_or_queue(now_ns, MavSeverity::MAV_SEVERITY_WARNING, SILENT);
        } else {
            self.send_texts(now_ns);
        }
        self.warn_insecure(now_ns);
    }

    /// Handles the controller's status.
    fn status(&mut self, now_ns: i64, status: ControllerStatus) {
        let silence_ns = self.silence.status(now_ns, is_landing(&status));
        self.status = Some(status);
        if let Some(silence_ns) = silence_ns {
            let silence_s = silence_ns / 1_000_000_000;
            let text = format!("Alight: the controller's status is back after {silence_s} s");
            tracing::info!(silence_s, "The controller's status is back");
            self.send_or_queue(now_ns, MavSeverity::MAV_SEVERITY_NOTICE, &text);
        }
        self.send_texts(now_ns);
    }

    /// Reports once that the controller's status has stopped in a landing.
    fn watch_controller(&mut self, now_ns: i64, is_after_standstill: bool) {
        if self.silence.begins(now_ns, is_after_standstill) && !self.is_abandoned {
            tracing::warn!("No status of the controller in a landing for 2 s");
            self.health.failed("no status of the controller in a landing");
            self.send_or_queue(now_ns, MavSeverity::MAV_SEVERITY_WARNING, SILENT);
        }
    }

    /// Sends the texts on changes in the controller's status.
    fn send_texts(&mut self, now_ns: i64) {
        // A text counts as sent only if it can be sent.
        if self.me(now_ns).is_none() {
            return;
        }
        let Some(status) = &self.status else { return };
        for packet in self.texts.status(now_ns, status) {
            self.health.count("texts");
            self.send_own(now_ns, &packet);
        }
    }

    /// Sends the landing point.
    fn target(&mut self, now_ns: i64, estimate: &TargetEstimate) {
        if self.me(now_ns).is_none() {
            return;
        }
        if let Some(message) = self.targets.message(now_ns, estimate) {
            self.health.count("landing targets");
            self.send_own(now_ns, &message);
        }
    }

    /// Reports when the last controller has gone, and when one is there again.
    fn controller(&mut self, now_ns: i64, controller: String, is_there: bool) {
        if !is_there {
            self.controllers.remove(&controller);
        } else if self.controllers.len() < MAX_CONTROLLERS {
            self.controllers.insert(controller);
        } else {
            self.health.dropped("controllers: too many");
        }
        let is_abandoned = self.controllers.is_empty() && !is_there;
        if is_abandoned == self.is_abandoned {
            return;
        }
        self.is_abandoned = is_abandoned;
        let (severity, text) = if is_abandoned {
            // The next controller's phase is sent even when it is the same.
            self.status = None;
            self.silence.gone();
            self.texts.reset();
            (MavSeverity::MAV_SEVERITY_WARNING, ABANDONED)
        } else {
            (MavSeverity::MAV_SEVERITY_NOTICE, "Alight: the controller is back")
        };
        self.send_or_queue(now_ns, severity, text);
    }

    /// Sends a text now, or as soon as the system id is known and it does not exceed the rate.
    fn send_or_queue(&mut self, now_ns: i64, severity: MavSeverity, text: &str) {
        let is_new = !self.unsent_texts.iter().any(|(_, it)| it == text);
        if is_new && self.unsent_texts.len() < MAX_UNSENT_TEXTS {
            self.unsent_texts.push_back((severity, text.to_owned()));
        } else if is_new {
            self.health.dropped("texts: too many");
        }
        self.send_queued(now_ns);
    }

    /// Sends the texts that could not be sent yet.
    fn send_queued(&mut self, now_ns: i64) {
        while let Some((severity, text)) = self.unsent_texts.pop_front() {
            if !self.send_text(now_ns, severity, &text) {
                self.unsent_texts.push_front((severity, text));
                return;
            }
        }
    }

    /// Sends the answer to a request, if it does not exceed the rate of such answers.
    fn send_answer(&mut self, now_ns: i64, severity: MavSeverity, text: &str) {
        if self.me(now_ns).is_none() {
            return;
        }
        match self.texts.answer(now_ns, severity, text) {
            Some(packets) => packets.iter().for_each(|packet| self.send_own(now_ns, packet)),
            None => self.health.dropped("texts: too many"),
        }
    }

    /// Sends a text, if we have a system id and it does not exceed the rate; whether it was sent.
    fn send_text(&mut self, now_ns: i64, severity: MavSeverity, text: &str) -> bool {
        if self.me(now_ns).is_none() {
            return false;
        }
        match self.texts.text(now_ns, severity, text) {
            Some(packets) => {
                packets.iter().for_each(|packet| self.send_own(now_ns, packet));
                true
            }
            None => {
                self.health.dropped("texts: too many");
                false
            }
        }
    }

    /// Counts the packets and connections of unknown senders since the last second.
    fn count_strangers(&mut self, strangers: u64) {
        let more = strangers.saturating_sub(self.strangers);
        if more > 0 {
            self.health
                .failed_times("from ground: packets or connections of an unknown sender", more);
        }
        self.strangers = strangers;
    }

    /// Counts the packets that were refused because of their signatures, and reports each reason once to the ground station: it may just
    /// have no key.
    fn count_refusals(&mut self, now_ns: i64, refusals: Refusals) {
        for (reason, more) in refusals.since(self.refusals) {
            if self.health.failed_times(&format!("from ground: refused: {reason}"), more) {
                tracing::warn!(
                    "Packets of the ground station refused: {reason} (further ones are only counted)"
                );
                let text = format!("Alight: packets refused: {reason}");
                self.send_or_queue(now_ns, MavSeverity::MAV_SEVERITY_WARNING, &text);
            }
        }
        self.refusals = refusals;
    }

    /// Counts losses on the ground station's link since the last second.
    fn count_losses(&mut self, counters: Counters, unread: u64) {
        if counters.bad_bytes > self.bad_bytes {
            self.health.dropped("from ground: seconds with bytes outside of packets");
        }
        for _ in self.unread..unread {
            self.health.dropped("from ground: not read in time");
        }
        self.bad_bytes = counters.bad_bytes;
        self.unread = unread;
    }

    /// Sends the heartbeat, and texts that could not be sent earlier.
    fn every_second(&mut self, now_ns: i64) {
        self.send_own(now_ns, &self.heartbeat());
        if let Some(heartbeat) = self.camera.heartbeat(now_ns) {
            self.warn_if_taken(now_ns);
            self.camera_heartbeats.truncate(MAX_CAMERA_HEARTBEATS - 1);
            self.camera_heartbeats.push_front((self.camera_sequence, heartbeat.clone()));
            self.send_from_camera(now_ns, &MavMessage::HEARTBEAT(heartbeat));
        }
        self.send_queued(now_ns);
        self.send_texts(now_ns);
        self.warn_insecure(now_ns);
    }

    /// Warns once that the vehicle has another camera with our camera's id, so that ours is not shown.
    fn warn_if_taken(&mut self, now_ns: i64) {
        let component = self.camera_component;
        let is_taken =
            component != 0 && self.me(now_ns).is_some() && self.camera_sender(now_ns).is_none();
        if is_taken && !self.camera_is_taken {
            tracing::warn!(
                component,
                "The vehicle has another component with the camera's id, so the ground station does not see \
                 this camera; set `camera_component_id` to another one, from 100 to 105"
            );
        }
        self.camera_is_taken = is_taken;
    }

    fn heartbeat(&self) -> MavMessage {
        let system_status = match &self.status {
            // The landing's state is unknown.
            _ if self.silence.is_long() => MavState::MAV_STATE_CRITICAL,
            Some(status) if is_landing(status) => MavState::MAV_STATE_ACTIVE,
            _ => MavState::MAV_STATE_STANDBY,
        };
        MavMessage::HEARTBEAT(HEARTBEAT_DATA { system_status, ..heartbeat() })
    }

    /// Sends a message of our own to the ground station, if we have a system id.
    fn send_own(&mut self, now_ns: i64, message: &MavMessage) {
        let Some(me) = self.me(now_ns) else { return };
        let packet = encode(me, self.sequence, message);
        self.sequence = self.sequence.wrapping_add(1);
        self.send(&packet);
    }

    /// Sends a message of the camera to the ground station, if it has ids of its own.
    fn send_from_camera(&mut self, now_ns: i64, message: &MavMessage) {
        let Some(camera) = self.camera_sender(now_ns) else { return };
        let packet = encode(camera, self.camera_sequence, message);
        self.camera_sequence = self.camera_sequence.wrapping_add(1);
        self.send(&packet);
    }

    fn send(&self, packet: &[u8]) {
        match self.ground.send(packet) {
            Ok(()) => self.health.count("to ground"),
            Err(SendError::NotConnected) => self.health.dropped("to ground: not connected"),
            Err(SendError::Full) => self.health.dropped("to ground: the line is too slow"),
        }
    }
}

/// Whether a landing is active.
fn is_landing(status: &ControllerStatus) -> bool {
    !status.finished && status.phase != Phase::Idle
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use autopilot::dialect::{
        COMMAND_LONG_DATA, MavAutopilot, MavCmd, MavType, PARAM_REQUEST_LIST_DATA,
        PARAM_REQUEST_READ_DATA, PARAM_SET_DATA,
    };
    use messages::GcsStatus;
    use node::Layers;

    const AUTOPILOT: Sender = Sender { system: 7, component: 1 };
    const GROUND: Sender = Sender { system: 255, component: 190 };
    const COMPANION: u8 = 191;
    const CAMERA: u8 = 100;

    fn packet(sender: Sender, message: &MavMessage) -> Packet {
        Parser::new().push(&encode(sender, 0, message)).remove(0)
    }

    fn heartbeat_of(sender: Sender) -> Packet {
        let heartbeat = HEARTBEAT_DATA {
            mavtype: MavType::MAV_TYPE_QUADROTOR,
            autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
            ..HEARTBEAT_DATA::default()
        };
        packet(sender, &MavMessage::HEARTBEAT(heartbeat))
    }

    fn command(target_component: u8, command: MavCmd) -> MavMessage {
        MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
            command,
            target_system: AUTOPILOT.system,
            target_component,
            ..COMMAND_LONG_DATA::default()
        })
    }

    /// A bridge that has received its autopilot's heartbeat, and the link that it must not lose.
    async fn bridge(set: &[&str]) -> (Bridge, Link) {
        let set = set.iter().map(|text| (*text).to_owned()).collect();
        let config = Layers { file: None, set }.load::<Config>().unwrap().settings;
        let link = Link::open("udpin:127.0.0.1:0".parse().unwrap()).await.unwrap();
        let mut bridge = Bridge::new(&config, None, link.sender(), Arc::default()).unwrap();
        bridge.down(0, &heartbeat_of(AUTOPILOT).raw);
        assert!(bridge.me(0).is_some());
        (bridge, link)
    }

    /// The status a second later.
    fn status(bridge: &mut Bridge) -> GcsStatus {
        bridge.ground_status.due(1_000_000_000, None, LinkCounts::default()).unwrap()
    }

    fn by_reason(status: &GcsStatus) -> BTreeMap<&str, u64> {
        status.refused.iter().map(|it| (it.reason.as_str(), it.count)).collect()
    }

    #[tokio::test]
    async fn each_packet_that_is_neither_passed_on_nor_answered_as_it_asks_counts_once() {
        let (mut bridge, _link) = bridge(&["ground_may=monitor"]).await;
        let parameter = |target_system| {
            MavMessage::PARAM_SET(PARAM_SET_DATA {
                target_system,
                target_component: COMPANION,
                param_id: "ALIGHT_NONE".into(),
                ..PARAM_SET_DATA::default()
            })
        };
        let asked = MavMessage::PARAM_REQUEST_READ(PARAM_REQUEST_READ_DATA {
            target_system: AUTOPILOT.system,
            target_component: COMPANION,
            param_index: 0,
            ..PARAM_REQUEST_READ_DATA::default()
        });
        let mut unknown = packet(GROUND, &command(CAMERA, MavCmd::MAV_CMD_COMPONENT_ARM_DISARM));
        // A number that no command has; the number of the command is behind seven parameters of four bytes.
        unknown.raw[10 + 28..10 + 30].copy_from_slice(&60_001_u16.to_le_bytes());
        unknown.message = None;
        let messages = [
            command(COMPANION, MavCmd::MAV_CMD_DO_SET_SERVO),
            command(CAMERA, MavCmd::MAV_CMD_DO_SET_SERVO),
            command(CAMERA, MavCmd::MAV_CMD_CAMERA_TRACK_POINT),
            command(CAMERA, MavCmd::MAV_CMD_CAMERA_STOP_TRACKING),
            command(AUTOPILOT.component, MavCmd::MAV_CMD_COMPONENT_ARM_DISARM),
            parameter(AUTOPILOT.system),
            // To all components with this id, of any system: refused here, and not passed on.
            parameter(0),
            asked,
        ];
        let packets = messages.iter().map(|message| packet(GROUND, message));
        for packet in packets.chain([unknown]) {
            assert_eq!(bridge.packet_from_ground(0, packet), None);
        }
        let status = status(&mut bridge);
        let expected = BTreeMap::from([
            (NOT_OF_COMPANION, 1),
            (NOT_OF_CAMERA, 2),
            ("denied by the camera", 1),
            ("a parameter is not set from there", 1),
            ("unknown parameter", 1),
            ("only monitoring", 2),
        ]);
        assert_eq!(by_reason(&status), expected);
        let [station] = status.stations.as_slice() else { panic!("{status:?}") };
        assert_eq!((station.packets, station.refused), (9, 8));
    }

    #[tokio::test]
    async fn the_present_state_is_sent_again_to_a_ground_station_that_begins_anew() {
        const SECOND_NS: i64 = 1_000_000_000;
        let (mut bridge, _link) = bridge(&[]).await;
        let texts = |bridge: &Bridge| {
            let report = bridge
                .health
                .report(&node::Identity { service: "gcs-bridge", instance: "main".into() }, 0);
            report.rates.iter().find(|it| it.name == "texts").map_or(0, |it| it.count)
        };
        let list = |target_component| {
            let target_system = AUTOPILOT.system;
            let list = PARAM_REQUEST_LIST_DATA { target_system, target_component };
            packet(GROUND, &MavMessage::PARAM_REQUEST_LIST(list))
        };
        let _ = bridge.packet_from_ground(0, heartbeat_of(GROUND));
        bridge.status(0, ControllerStatus { phase: Phase::Idle, ..ControllerStatus::default() });
        assert_eq!(texts(&bridge), 1);
        let _ = bridge.packet_from_ground(4 * SECOND_NS, list(0));
        assert_eq!(texts(&bridge), 1, "it has just received it");
        for (at_s, component, count) in
            [(6, 0, 2), (7, 0, 2), (11, 0, 2), (12, COMPANION, 3), (18, 1, 4), (24, CAMERA, 4)]
        {
            let _ = bridge.packet_from_ground(at_s * SECOND_NS, list(component));
            assert_eq!(texts(&bridge), count, "{at_s} s");
            let _ = bridge.packet_from_ground(at_s * SECOND_NS, heartbeat_of(GROUND));
            assert_eq!(texts(&bridge), count, "a heartbeat is no start: {at_s} s");
        }
    }

    #[tokio::test]
    async fn an_echo_of_the_vehicle_belongs_to_no_station_and_is_not_refused() {
        let (mut bridge, _link) = bridge(&[]).await;
        for _ in 0..3 {
            assert_eq!(bridge.packet_from_ground(0, heartbeat_of(AUTOPILOT)), None);
            bridge.too_late(0, &heartbeat_of(AUTOPILOT));
        }
        let status = status(&mut bridge);
        assert_eq!((status.stations.len(), status.refused.len()), (0, 0), "{status:?}");
    }

    #[tokio::test]
    async fn a_packet_that_is_too_late_counts_for_its_sender() {
        let (mut bridge, _link) = bridge(&[]).await;
        bridge.too_late(0, &heartbeat_of(GROUND));
        let status = status(&mut bridge);
        assert_eq!(by_reason(&status), BTreeMap::from([("too late", 1)]));
        let [station] = status.stations.as_slice() else { panic!("{status:?}") };
        assert_eq!((station.system, station.packets, station.refused), (GROUND.system, 1, 1));
    }
}
