//! Runs the simulator's service: steps the world in real time, or follows a real autopilot's vehicle, exchanges MAVLink
//! packets, renders the camera's frames, and publishes them with the truth.
//!
//! The simulation advances on a task of its own. The camera renders on a thread of its own, named `camera`,
//! from the recent history of the simulation, so that neither blocks the other for longer than it takes to
//! copy a pose.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use airlink::AirSender;
use anyhow::Context;
use autopilot::dialect::{COMMAND_LONG_DATA, MavCmd, MavMessage};
use autopilot::{
    Address, Firmware, Link, LinkEvent, Packet, Parser, Peering, Sender, SigningConfig,
};
use messages::{
    CameraControl, CameraInfo, ControllerStatus, Detections, FrameHeader, MavlinkBytes,
    PixelFormat, Touchdown, Truth, Wind, topic,
};
use metering::ControlThrottle;
use node::{
    BoxFuture, FramePublisher, Loan, Node, Publisher, Shutdown, Subscriber, clock_name, now_ns,
};
use tokio::runtime::Handle;
use tokio::sync::oneshot;
use tokio::time::{MissedTickBehavior, interval};

use world::pad::{PadConfig, PadState};
use world::vehicle::VehicleTruth;
use world::world::World;

use crate::camera::{FrameRequest, SimCamera};
use crate::config::{Config, ExposureKind, VehicleKind};
use crate::reported::ReportedVehicle;

/// Interval at which the simulation advances.
const TICK: Duration = Duration::from_millis(4);
/// Ticks between publications of the truth (50 Hz).
const TRUTH_EVERY: u64 = 5;
/// Ticks between publications of the wind (10 Hz).
const WIND_EVERY: u64 = 25;
/// Maximum number of delayed frames; beyond it the oldest is dropped.
const MAX_DELAYED: usize = 32;
/// Why numbers of frames are left out.
const TOO_LONG: &str = "frames that took too long to render";
/// Time without the truth after which it is requested again.
const REQUEST_PERIOD: Duration = Duration::from_secs(1);
/// Ids of the messages with the truth of a simulated ArduPilot and PX4. ArduPilot warns the pilot of a request for an unknown
/// id.
const SIM_STATE: f32 = 108.0;
const HIL_STATE_QUATERNION: f32 = 115.0;
/// Number of such requests without an answer after which a warning is logged.
const MAX_UNANSWERED: u32 = 5;
const NO_TRUTH: &str = "the autopilot sends no truth of its simulation (SIM_STATE, HIL_STATE_QUATERNION), so the camera and the touchdown's error follow its estimate";
/// The MAVLink component id of an autopilot.
const AUTOPILOT: u8 = 1;
/// Requested interval of these messages, in microseconds.
const TRUTH_INTERVAL_US: f32 = 10_000.0;
/// Height above which the vehicle has been in the air, in metres.
const IN_AIR_M: f64 = 0.3;
/// Height above which the legs do not touch the ground, in metres.
const CLEAR_M: f64 = 0.04;
/// Height up to which a vehicle that has touched the ground may bounce, in metres. ArduPilot's simulated one, dropped from
/// 4 m, bounced by 0.1 m.
const BOUNCE_M: f64 = 1.0;

/// Runs the service until a shutdown is requested.
///
/// # Errors
/// When another simulator has the same name, the link cannot be opened, or the scene is invalid.
pub fn run(
    node: Node,
    config: Config,
    shutdown: Shutdown,
) -> BoxFuture<'static, anyhow::Result<()>> {
    Box::pin(run_service(node, config, shutdown))
}

async fn run_service(node: Node, config: Config, shutdown: Shutdown) -> anyhow::Result<()> {
    node.claim_unique_name(&config.id).await?;
    let simulation = Arc::new(Simulation::new(&config));
    let camera = Camera::new(&node, &config, Arc::clone(&simulation)).await?;
    let (stopped, _thread) = camera.start()?;
    let world = advance(&node, &config, &simulation);
    tokio::select! {
        () = shutdown.requested() => Ok(()),
        result = world => result,
        _ = stopped => anyhow::bail!("the camera's thread ended"),
    }
}

/// The state shared by the simulation's task and the camera's thread.
struct Simulation {
    source: Mutex<VehicleSource>,
    /// Time 0 of the simulation on the host's clock.
    start_ns: i64,
    touchdown: Mutex<TouchdownMonitor>,
    pad: PadConfig,
    begin_height_m: f64,
    /// When the scenario of a reported vehicle began, in seconds.
    begun_s: Mutex<Option<f64>>,
}

/// Where the vehicle's motion comes from.
enum VehicleSource {
    Simulated(Box<World>),
    Reported(ReportedVehicle),
}

impl Simulation {
    fn new(config: &Config) -> Self {
        let (source, passed_s) = match config.vehicle {
            VehicleKind::Simulated => {
                let world = World::new(&config.world(), config.seed);
                let passed_s = world.now_s();
                (VehicleSource::Simulated(Box::new(world)), passed_s)
            }
            VehicleKind::Reported => (VehicleSource::Reported(ReportedVehicle::default()), 0.0),
        };
        Self {
            source: Mutex::new(source),
            // A vehicle that starts in the air has hovered before.
            start_ns: now_ns().saturating_sub((passed_s * 1e9).round() as i64),
            touchdown: Mutex::default(),
            pad: config.pad.config(),
            begin_height_m: config.begin_height_m,
            begun_s: Mutex::new(None),
        }
    }

    fn now_s(&self) -> f64 {
        (now_ns() - self.start_ns) as f64 * 1e-9
    }

    fn stamp_ns(&self, time_s: f64) -> i64 {
        self.start_ns.saturating_add((time_s * 1e9).round() as i64)
    }

    // The simulation stays valid when another thread panicked.
    fn source(&self) -> MutexGuard<'_, VehicleSource> {
        self.source.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn touchdown(&self) -> MutexGuard<'_, TouchdownMonitor> {
        self.touchdown.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The time since the beginning of the scenario, and the pad at `time_s`.
    fn pad_at(&self, time_s: f64) -> (Option<f64>, PadState) {
        if let VehicleSource::Simulated(world) = &*self.source() {
            return (world.since_begin_s(time_s), world.pad_at(time_s));
        }
        let begun_s = *self.begun_s.lock().unwrap_or_else(PoisonError::into_inner);
        let moved_s = begun_s.map(|begun_s| time_s - begun_s).filter(|s| *s >= 0.0);
        (moved_s, self.pad.at(moved_s))
    }

    /// Begins the scenario of a reported vehicle. That of a simulated one begins automatically.
    fn begin_when_high(&self, truth: &VehicleTruth) {
        if truth.height_m >= self.begin_height_m {
            let mut begun_s = self.begun_s.lock().unwrap_or_else(PoisonError::into_inner);
            begun_s.get_or_insert(truth.time_s);
        }
    }

    /// The vehicle's state at `time_s`; `None` before an autopilot has reported one.
    fn truth_at(&self, time_s: f64) -> Option<VehicleTruth> {
        match &*self.source() {
            VehicleSource::Simulated(world) => Some(world.truth_at(time_s)),
            VehicleSource::Reported(reported) => reported.truth_at(time_s),
        }
    }
}

/// Detects the touchdown and measures it.
#[derive(Default)]
struct TouchdownMonitor {
    was_in_air: bool,
    /// The last state clear of the ground, or the fastest one down since: contact brakes the vehicle faster than the ticks resolve, and a
    /// hard one throws it up again.
    before_contact: Option<VehicleTruth>,
    /// The vehicle was as low as its legs since it was last high.
    has_been_low: bool,
    touchdown: Option<Touchdown>,
    max_tilt_rad: f64,
    frames: u64,
}

impl TouchdownMonitor {
    fn update(&mut self, truth: &VehicleTruth, pad: &PadState, stamp_ns: i64) {
        if truth.height_m > IN_AIR_M && !self.was_in_air {
            self.was_in_air = true;
            self.touchdown = None;
            self.max_tilt_rad = 0.0;
        }
        if self.was_in_air && !truth.on_ground {
            self.max_tilt_rad = self.max_tilt_rad.max(truth.tilt_rad());
        }
        if self.was_in_air && truth.on_ground {
            self.was_in_air = false;
            let before = self.before_contact.unwrap_or(*truth);
            let speed = before.velocity - pad.velocity;
            self.touchdown = Some(Touchdown {
                stamp_ns,
                error_m: (truth.position - pad.position).horizontal_norm(),
                vertical_speed_m_s: speed.z(),
                lateral_speed_m_s: speed.horizontal_norm(),
            });
        }
        let is_faster = |than: VehicleTruth| truth.velocity.z() > than.velocity.z();
        self.has_been_low =
            truth.height_m <= BOUNCE_M && (self.has_been_low || truth.height_m <= CLEAR_M);
        let is_clear =
            truth.height_m > CLEAR_M && (!self.has_been_low || self.before_contact.is_none());
        if is_clear || self.before_contact.is_some_and(is_faster) {
            self.before_contact = Some(*truth);
        }
    }

    /// The truth as a message. `lid_m` is the height of the marker above the pad, in metres.
    fn message(&self, truth: &VehicleTruth, pad: &PadState, stamp_ns: i64, lid_m: f64) -> Truth {
        Truth {
            stamp_ns,
            ned_from_body_wxyz: truth.ned_from_body.wxyz(),
            position_ned_m: truth.position.coords.into(),
            velocity_ned_m_s: truth.velocity.coords.into(),
            pad_ned_m: [pad.position.x(), pad.position.y(), pad.position.z() - lid_m],
            on_ground: truth.on_ground,
            touchdown: self.touchdown,
            max_tilt_rad: self.max_tilt_rad,
            frames: self.frames,
        }
    }
}

/// Advances the simulation in real time and publishes the truth.
async fn advance(node: &Node, config: &Config, simulation: &Simulation) -> anyhow::Result<()> {
    let scene = config.scene().map_err(anyhow::Error::msg)?;
    let lid_m = scene.pads.first().map_or(0.0, |pad| pad.thickness_m);
    let truths = node.publisher(topic::TRUTH, &[]).await?;
    let winds = node.publisher(topic::WIND, &[]).await?;
    let mut mavlink = AutopilotSide::open(node, config).await?;
    node.announce().await?;
    let mut ticks = interval(TICK);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut tick: u64 = 0;
    loop {
        tokio::select! {
            // Time advances first, however many packets arrive.
            biased;
            _ = ticks.tick() => {}
            () = mavlink.receive(node, simulation) => continue,
        }
        tick += 1;
        mavlink.send(node, simulation).await;
        let now_s = simulation.now_s();
        let truth = match &*simulation.source() {
            VehicleSource::Simulated(world) => Some(world.truth()),
            VehicleSource::Reported(reported) => reported.truth(),
        };
        let Some(truth) = truth else { continue };
        let stamp_ns = simulation.stamp_ns(truth.time_s);
        simulation.begin_when_high(&truth);
        let (_, pad) = simulation.pad_at(truth.time_s);
        simulation.touchdown().update(&truth, &pad, stamp_ns);
        if tick.is_multiple_of(TRUTH_EVERY) {
            let message = simulation.touchdown().message(&truth, &pad, stamp_ns, lid_m);
            truths.publish(&message).await;
        }
        let air = match &*simulation.source() {
            VehicleSource::Simulated(world) => Some(world.wind()),
            VehicleSource::Reported(_) => None,
        };
        if let Some(air) = air.filter(|_| tick.is_multiple_of(WIND_EVERY)) {
            let stamp_ns = simulation.stamp_ns(now_s);
            winds.publish(&Wind { stamp_ns, velocity_ned_m_s: air.coords.into() }).await;
        }
    }
}

/// The connection for MAVLink: a link of the simulated autopilot, or topics to a real one through the
/// controller.
#[expect(clippy::large_enum_variant, reason = "there is only one value")]
enum AutopilotSide {
    Link(Link),
    Topics {
        packets: Subscriber<MavlinkBytes>,
        requests: Publisher<MavlinkBytes>,
        requested_s: f64,
        /// Requests since the truth came last.
        unanswered: u32,
        /// The autopilot, once its heartbeat has come.
        autopilot: Option<TruthOf>,
        /// It has sent something since the last request.
        has_spoken: bool,
    },
}

/// The source of the requested truth: the autopilot's MAVLink system id, and the id of the message.
#[derive(Copy, Clone)]
struct TruthOf {
    system: u8,
    message: f32,
}

impl TruthOf {
    /// From a packet of an autopilot that contains its firmware.
    fn new(packet: &Packet) -> Option<Self> {
        let Some(MavMessage::HEARTBEAT(heartbeat)) = &packet.message else { return None };
        let message = match Firmware::of(heartbeat) {
            Firmware::Px4 | Firmware::OtherPx4 => HIL_STATE_QUATERNION,
            _ => SIM_STATE,
        };
        Some(Self { system: packet.sender.system, message })
    }
}

impl AutopilotSide {
    async fn open(node: &Node, config: &Config) -> anyhow::Result<Self> {
        Ok(match config.vehicle {
            VehicleKind::Simulated => {
                let address: Address = config.autopilot.address.parse()?;
                let signing = match config.autopilot.signing_key.as_str() {
                    "" => None,
                    // No other program receives from the simulated autopilot, so it keeps no stamps.
                    path => Some(SigningConfig::read(path.as_ref(), 0, None, "simulator")?),
                };
                let link = Link::open_for(address, Peering::default(), signing).await;
                Self::Link(link.context("opening the link of the simulated autopilot")?)
            }
            VehicleKind::Reported => Self::Topics {
                packets: node.subscriber(topic::FROM_AUTOPILOT, &[]).await?,
                requests: node.publisher(topic::TO_AUTOPILOT, &[]).await?,
                requested_s: f64::NEG_INFINITY,
                unanswered: 0,
                autopilot: None,
                has_spoken: false,
            },
        })
    }

    /// Receives and handles the next packet. Answers go out at once: one that waited for the next tick would make the way back
    /// longer than the way there, and the controller's clock of the autopilot wrong by half of that.
    async fn receive(&mut self, node: &Node, simulation: &Simulation) {
        match self {
            Self::Link(link) => {
                if let LinkEvent::Packet { packet, received } = link.recv().await {
                    let answers = match &mut *simulation.source() {
                        VehicleSource::Simulated(world) => {
                            // The time for which the packet waited here is not part of the link's delay.
                            let received_s = simulation.now_s() - received.elapsed().as_secs_f64();
                            world.advance_to(received_s);
                            world.handle_at(received_s.max(world.now_s()), &packet);
                            world.outgoing().collect()
                        }
                        VehicleSource::Reported(_) => Vec::new(),
                    };
                    send_all(node, link, answers);
                }
            }
            Self::Topics { packets, autopilot, has_spoken, .. } => {
                let Some(message) = packets.next().await else {
                    return std::future::pending().await;
                };
                let mut parser = Parser::new();
                let mut packets = parser.push(&message.packet);
                packets.extend(parser.finish());
                let now_s = simulation.now_s();
                let of_autopilot = || packets.iter().filter(|it| it.sender.component == AUTOPILOT);
                *has_spoken |= of_autopilot().next().is_some();
                *autopilot = of_autopilot().rev().find_map(TruthOf::new).or(*autopilot);
                if let VehicleSource::Reported(reported) = &mut *simulation.source() {
                    packets.iter().for_each(|packet| reported.handle(now_s, packet));
                }
            }
        }
    }

    /// Advances the simulation and sends its autopilot's packets, or requests the truth from a real
    /// autopilot.
    async fn send(&mut self, node: &Node, simulation: &Simulation) {
        match self {
            Self::Link(link) => {
                let packets: Vec<Vec<u8>> = match &mut *simulation.source() {
                    VehicleSource::Simulated(world) => {
                        world.advance_to(simulation.now_s());
                        world.outgoing().collect()
                    }
                    VehicleSource::Reported(_) => Vec::new(),
                };
                send_all(node, link, packets);
            }
            Self::Topics {
                requests,
                requested_s,
                unanswered,
                autopilot: Some(autopilot),
                has_spoken,
                ..
            } => {
                let now_s = simulation.now_s();
                let is_true = match &*simulation.source() {
                    VehicleSource::Reported(reported) => reported.is_true(now_s),
                    VehicleSource::Simulated(_) => true,
                };
                if is_true {
                    *unanswered = 0;
                } else if now_s - *requested_s > REQUEST_PERIOD.as_secs_f64() {
                    *requested_s = now_s;
                    // One that is silent does not lack the truth alone.
                    let has_spoken = std::mem::take(has_spoken);
                    *unanswered += u32::from(has_spoken);
                    let lacks_it = has_spoken && *unanswered > MAX_UNANSWERED;
                    if lacks_it && node.health().failed(NO_TRUTH) {
                        tracing::warn!("{NO_TRUTH}");
                    }
                    let packet = request_for(*autopilot);
                    requests.publish(&MavlinkBytes { packet }).await;
                }
            }
            Self::Topics { autopilot: None, .. } => {}
        }
    }
}

fn send_all(node: &Node, link: &mut Link, packets: Vec<Vec<u8>>) {
    for packet in packets {
        if link.send(&packet).is_err() {
            node.health().dropped("packets without a listener");
        }
    }
}

/// SET_MESSAGE_INTERVAL for a message. PX4 takes no command that is addressed to all systems.
fn request_for(truth: TruthOf) -> Vec<u8> {
    let message = MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
        param1: truth.message,
        param2: TRUTH_INTERVAL_US,
        command: MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL,
        target_system: truth.system,
        target_component: AUTOPILOT,
        ..COMMAND_LONG_DATA::default()
    });
    autopilot::packet::encode(Sender { system: 255, component: 192 }, 0, &message)
}

/// A frame that arrives later.
struct Delayed {
    due_s: f64,
    header: FrameHeader,
    pixels: Loan,
}

/// The subscriptions that give the pad's position.
struct Sightings {
    detections: Subscriber<Detections>,
    /// Names the detector in use.
    status: Subscriber<ControllerStatus>,
}

/// The camera's thread.
struct Camera {
    node: Node,
    simulation: Arc<Simulation>,
    sensor: SimCamera,
    /// For an exposure that follows the marker.
    sightings: Option<Sightings>,
    delayed: VecDeque<Delayed>,
    frames: FramePublisher,
    air: AirSender,
    infos: Publisher<CameraInfo>,
    info: CameraInfo,
    controls: Publisher<CameraControl>,
    throttle: ControlThrottle,
    period_s: f64,
}

impl Camera {
    async fn new(
        node: &Node,
        config: &Config,
        simulation: Arc<Simulation>,
    ) -> anyhow::Result<Self> {
        let sensor = SimCamera::new(config)?;
        let settings = sensor.settings().clone();
        let name = &config.camera.name;
        let bytes = config.camera.width as usize * config.camera.height as usize;
        let info = CameraInfo::new(name, &settings.model, &settings.body_from_camera);
        let jpegs = node.frame_publisher(topic::JPEG, &[name], 0).await?;
        let sightings = match config.camera.exposure {
            ExposureKind::Marker => Some(Sightings {
                detections: node.subscriber(topic::DETECTIONS, &[]).await?,
                status: node.subscriber(topic::STATUS, &[]).await?,
            }),
            _ => None,
        };
        Ok(Self {
            sensor,
            sightings,
            delayed: VecDeque::new(),
            frames: node.frame_publisher(topic::FRAME, &[name], bytes).await?,
            air: AirSender::start(node, name, jpegs, &config.air).await?,
            infos: node.publisher(topic::CAMERA_INFO, &[name]).await?,
            info,
            controls: node.publisher(topic::CAMERA_CONTROL, &[name]).await?,
            throttle: ControlThrottle::default(),
            period_s: 1.0 / config.camera.rate_hz,
            node: node.clone(),
            simulation,
        })
    }

    /// Starts the thread. The receiver resolves when it ends.
    fn start(mut self) -> anyhow::Result<(oneshot::Receiver<()>, std::thread::JoinHandle<()>)> {
        let runtime = Handle::current();
        let (running, stopped) = oneshot::channel();
        let thread = std::thread::Builder::new()
            .name("camera".to_owned())
            .spawn(move || {
                // The frame grid starts now; the simulation may have started long before.
                let mut sequence = (self.simulation.now_s() / self.period_s) as u64 + 1;
                while !running.is_closed() {
                    let time_s = sequence as f64 * self.period_s;
                    let exposed_s = time_s + self.sensor.settings().exposure_s / 2.0;
                    // A tick later the history contains the whole exposure.
                    let ready_s = exposed_s + TICK.as_secs_f64() * 1.5;
                    while let Some(due_s) = self.next_due_s().filter(|due_s| *due_s < ready_s) {
                        self.sleep_until(due_s);
                        node::block_on(&runtime, self.publish_delayed());
                    }
                    self.sleep_until(ready_s);
                    node::block_on(&runtime, self.take(sequence, time_s));
                    let due = (self.simulation.now_s() / self.period_s) as u64;
                    let left_out = due.saturating_sub(sequence + 1);
                    if left_out > 0 {
                        self.node.health().dropped_times(TOO_LONG, left_out);
                    }
                    sequence += 1 + left_out;
                }
            })
            .context("starting the camera's thread")?;
        Ok((stopped, thread))
    }

    /// Passes the pad's position to the sensor.
    fn follow_pad(&mut self) {
        let Some(sightings) = &self.sightings else { return };
        while let Some(status) = sightings.status.waiting() {
            self.sensor.follow(&status);
        }
        while let Some(message) = sightings.detections.waiting() {
            self.sensor.detected(&message);
        }
    }

    /// Takes a frame and publishes it.
    async fn take(&mut self, sequence: u64, time_s: f64) {
        if sequence.is_multiple_of((1.0 / self.period_s).ceil() as u64) {
            self.infos.publish(&self.info).await;
        }
        let Some(truth) = self.simulation.truth_at(time_s) else { return };
        let (begun_s, pad) = self.simulation.pad_at(time_s);
        let stamp_ns = self.simulation.stamp_ns(time_s);
        let request = FrameRequest { sequence, time_s, stamp_ns, begun_s, pad };
        self.follow_pad();
        let Some(passage) = self.sensor.open(&request, &truth) else { return };
        let started_ns = now_ns();
        let mut frame = self.frames.loan(self.info.width as usize * self.info.height as usize);
        let simulation = &self.simulation;
        let truth_at = |time_s| simulation.truth_at(time_s).unwrap_or(truth);
        if let Err(problem) = self.sensor.render(&request, truth_at, &mut frame) {
            if self.node.health().failed("render") {
                tracing::error!(%problem, "Failed to render a frame");
            }
            return;
        }
        let took = Duration::from_nanos((now_ns() - started_ns).max(0).unsigned_abs());
        self.node.health().latency("render", took);
        let header = FrameHeader {
            camera: self.info.camera.clone(),
            sequence,
            stamp_ns: self.simulation.stamp_ns(time_s + passage.stamp_error_s),
            clock: clock_name().to_owned(),
            exposure_ns: (self.sensor.settings().exposure_s * 1e9) as u32,
            width: self.info.width,
            height: self.info.height,
            format: PixelFormat::Mono8,
            parts: Vec::new(),
        };
        self.publish_control(&header).await;
        let again = passage.again_after_s.map(|after_s| (time_s + after_s, frame.to_vec()));
        if passage.arrives_after_s > 0.0 {
            self.delay(time_s + passage.arrives_after_s, header.clone(), frame);
        } else {
            self.publish(&header, frame).await;
        }
        if let Some((due_s, copy)) = again {
            self.delay(due_s, header, Loan::Private(copy));
        }
        self.publish_delayed().await;
    }

    /// Publishes how the camera is exposed after the frame with this header.
    async fn publish_control(&mut self, header: &FrameHeader) {
        let control = CameraControl {
            camera: header.camera.clone(),
            sequence: Some(header.sequence),
            stamp_ns: header.stamp_ns,
            clock: header.clock.clone(),
            ..self.sensor.control().clone()
        };
        if self.throttle.is_due(&control) {
            self.controls.publish(&control).await;
        }
    }

    /// Publishes a frame, and offers it to the air link.
    async fn publish(&mut self, header: &FrameHeader, frame: Loan) {
        self.air.offer(header, &frame);
        self.frames.publish(header, frame).await;
        self.simulation.touchdown().frames += 1;
    }

    /// Queues a frame that arrives at `due_s`.
    fn delay(&mut self, due_s: f64, header: FrameHeader, pixels: Loan) {
        if self.delayed.len() >= MAX_DELAYED {
            self.delayed.pop_front();
            self.node.health().dropped("delayed frames");
        }
        let index = self.delayed.partition_point(|delayed| delayed.due_s <= due_s);
        self.delayed.insert(index, Delayed { due_s, header, pixels });
    }

    fn next_due_s(&self) -> Option<f64> {
        self.delayed.front().map(|delayed| delayed.due_s)
    }

    fn sleep_until(&self, time_s: f64) {
        let wait_s = time_s - self.simulation.now_s();
        if wait_s > 0.0 {
            std::thread::sleep(Duration::from_secs_f64(wait_s));
        }
    }

    /// Publishes the delayed frames that are due.
    async fn publish_delayed(&mut self) {
        while self.next_due_s().is_some_and(|due_s| due_s <= self.simulation.now_s()) {
            let Some(Delayed { header, pixels, .. }) = self.delayed.pop_front() else { return };
            self.publish(&header, pixels).await;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::{Point, Vector};
    use node::Layers;
    use world::vehicle::{Vehicle, VehicleConfig};

    #[test]
    fn a_touchdown_is_measured_from_the_motion_before_contact() {
        let mut monitor = TouchdownMonitor::default();
        let pad = PadConfig::default().at(None);
        let still = Vehicle::new(VehicleConfig::default(), 1).truth();
        let at = |height_m: f64, fall: f64, on_ground| VehicleTruth {
            position: Point::new(1.4, -1.5, -height_m),
            velocity: Vector::new(0.1, 0.0, fall),
            height_m,
            on_ground,
            ..still
        };
        monitor.update(&at(0.0, 0.0, true), &pad, 0);
        assert!(monitor.touchdown.is_none(), "it has not flown yet");
        monitor.update(&at(5.0, 1.0, false), &pad, 1);
        monitor.update(&at(0.1, 0.5, false), &pad, 2);
        // A gust just above the ground counts; a vehicle that contact has slowed down does not.
        monitor.update(&at(0.02, 0.7, false), &pad, 3);
        monitor.update(&at(0.001, 0.0, false), &pad, 4);
        monitor.update(&at(0.0, 0.0, true), &pad, 5);
        let touchdown = monitor.touchdown.unwrap();
        assert!((touchdown.error_m - 0.1).abs() < 1e-9 && touchdown.stamp_ns == 5);
        assert!((touchdown.vertical_speed_m_s - 0.7).abs() < 1e-9);
        assert!((touchdown.lateral_speed_m_s - 0.1).abs() < 1e-9);
        // The first contact of a vehicle that falls and bounces counts, not its last one.
        monitor.update(&at(3.0, 4.0, false), &pad, 6);
        for (height_m, fall) in [(0.05, 7.2), (-0.01, 6.0), (0.08, -0.5), (0.06, 0.4)] {
            monitor.update(&at(height_m, fall, false), &pad, 7);
        }
        monitor.update(&at(0.0, 0.0, true), &pad, 8);
        assert!((monitor.touchdown.unwrap().vertical_speed_m_s - 7.2).abs() < 1e-9);
    }

    #[test]
    fn a_vehicle_that_starts_in_the_air_moves_on_from_there() {
        let set = vec!["start.height_m=10".to_owned()];
        let config = Layers { file: None, set }.load::<Config>().unwrap().settings;
        let simulation = Simulation::new(&config);
        let VehicleSource::Simulated(world) = &*simulation.source() else {
            panic!("a simulated vehicle")
        };
        let ahead_s = world.now_s() - simulation.now_s();
        assert!(ahead_s <= 0.0, "the world is {ahead_s} s ahead of the clock");
    }
}
