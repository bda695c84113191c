//! The service: a world in real time, its autopilot on a MAVLink link, its camera on the topics.
//!
//! The world advances on a task of its own; the camera renders on a thread of its own, named `camera`, and reads
//! the world's recent past, so that neither waits for the other longer than it takes to copy a pose.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use airlink::AirSender;
use anyhow::Context;
use autopilot::dialect::{COMMAND_LONG_DATA, MavCmd, MavMessage};
use autopilot::{Address, Link, LinkEvent, Parser, Sender};
use messages::{
    CameraInfo, FrameHeader, LensModel, MavlinkBytes, PixelFormat, Touchdown, Transform3, Truth,
    Wind, topic,
};
use node::{FramePublisher, Loan, Node, Publisher, Shutdown, clock_name, now_ns};
use tokio::runtime::Handle;
use tokio::sync::oneshot;
use tokio::time::{MissedTickBehavior, interval};

use world::pad::{PadConfig, PadState};
use world::vehicle::VehicleTruth;
use world::world::World;

use crate::config::{Config, Flown};
use crate::eye::{Eye, Moment};
use crate::reported::Reported;

/// How often the world is brought up to date.
const TICK: Duration = Duration::from_millis(4);
/// Every so many ticks the truth is published: 50 Hz.
const TRUTH_EVERY: u64 = 5;
/// Every so many ticks the wind is published: 10 Hz.
const WIND_EVERY: u64 = 25;
/// Frames that are on their way late; the oldest is lost first.
const MOST_LATE: usize = 32;
/// After this time without the truth it is asked for (again).
const ASK_PERIOD: Duration = Duration::from_secs(1);
/// The messages in which a simulated ArduPilot (SIM_STATE) or PX4 (HIL_STATE_QUATERNION) tells the truth.
const TRUTH_MESSAGES: [f32; 2] = [108.0, 115.0];
/// Time between two of them, in microseconds.
const TRUTH_INTERVAL_US: f32 = 10_000.0;
/// Height at which the vehicle counts as having been in the air, in metres.
const IN_AIR_M: f64 = 0.3;

/// Height from which the vehicle is clear of the ground, in metres.
const CLEAR_M: f64 = 0.04;

/// Runs the service until it is asked to stop.
///
/// # Errors
/// When another simulator has the same name, the link cannot be opened, or the scene makes no sense.
pub async fn run(node: Node, config: Config, shutdown: Shutdown) -> anyhow::Result<()> {
    node.claim_unique_name(&config.id).await?;
    let stage = Arc::new(Stage::new(&config));
    let (stopped, _thread) = Camera::new(&node, &config, Arc::clone(&stage)).await?.start()?;
    let world = advance(&node, &config, &stage);
    tokio::select! {
        () = shutdown.requested() => Ok(()),
        result = world => result,
        _ = stopped => anyhow::bail!("the camera's thread ended"),
    }
}

/// What the world's task and the camera's thread share.
struct Stage {
    actor: Mutex<Actor>,
    /// The moment of the world's time 0, on the host's clock.
    start_ns: i64,
    witness: Mutex<Witness>,
    pad: PadConfig,
    begin_height_m: f64,
    /// When the world of a reported vehicle began, in seconds.
    begun_s: Mutex<Option<f64>>,
}

/// What flies.
enum Actor {
    Simulated(Box<World>),
    Reported(Reported),
}

impl Stage {
    fn new(config: &Config) -> Self {
        let actor = match config.vehicle {
            Flown::Simulated => {
                Actor::Simulated(Box::new(World::new(&config.world(), config.seed)))
            }
            Flown::Reported => Actor::Reported(Reported::default()),
        };
        Self {
            actor: Mutex::new(actor),
            start_ns: now_ns(),
            witness: Mutex::default(),
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

    // A thread that panicked leaves a world that still is one.
    fn actor(&self) -> MutexGuard<'_, Actor> {
        self.actor.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn witness(&self) -> MutexGuard<'_, Witness> {
        self.witness.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The time since the world's begin at a moment, and the pad then.
    fn pad_at(&self, time_s: f64) -> (Option<f64>, PadState) {
        if let Actor::Simulated(world) = &*self.actor() {
            return (world.since_begin_s(time_s), world.pad_at(time_s));
        }
        let begun_s = *self.begun_s.lock().unwrap_or_else(PoisonError::into_inner);
        let moved_s = begun_s.map(|begun_s| time_s - begun_s).filter(|s| *s >= 0.0);
        (moved_s, self.pad.at(moved_s))
    }

    /// Begins the world of a vehicle that is flown elsewhere; our own does so by itself.
    fn begin_when_high(&self, truth: &VehicleTruth) {
        if truth.height_m >= self.begin_height_m {
            let mut begun_s = self.begun_s.lock().unwrap_or_else(PoisonError::into_inner);
            begun_s.get_or_insert(truth.time_s);
        }
    }

    /// The motion at a moment; `None` while an autopilot has not told where the vehicle is.
    fn truth_at(&self, time_s: f64) -> Option<VehicleTruth> {
        match &*self.actor() {
            Actor::Simulated(world) => Some(world.truth_at(time_s)),
            Actor::Reported(reported) => reported.truth_at(time_s),
        }
    }
}

/// Sees the touchdown.
#[derive(Default)]
struct Witness {
    was_in_air: bool,
    /// The last motion clear of the ground: once the legs touch, the ground takes the speed in steps too short to see.
    clear: Option<VehicleTruth>,
    touchdown: Option<Touchdown>,
    max_tilt_rad: f64,
    frames: u64,
}

impl Witness {
    fn see(&mut self, truth: &VehicleTruth, pad: &PadState, stamp_ns: i64) {
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
            let before = self.clear.unwrap_or(*truth);
            let speed = before.velocity - pad.velocity;
            self.touchdown = Some(Touchdown {
                stamp_ns,
                error_m: (truth.position - pad.position).horizontal_norm(),
                vertical_speed_m_s: speed.z(),
                lateral_speed_m_s: speed.horizontal_norm(),
            });
        }
        if truth.height_m > CLEAR_M {
            self.clear = Some(*truth);
        }
    }

    /// `lid_m`: how high the marker is over the pad, in metres.
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

/// Lets the world's time pass as the host's does, and tells the truth.
async fn advance(node: &Node, config: &Config, stage: &Stage) -> anyhow::Result<()> {
    let scene = config.scene().map_err(anyhow::Error::msg)?;
    let lid_m = scene.pads.first().map_or(0.0, |pad| pad.thickness_m);
    let truths = node.publisher(topic::TRUTH, &[]).await?;
    let winds = node.publisher(topic::WIND, &[]).await?;
    let mut outside = Outside::open(node, config).await?;
    node.announce().await?;
    let mut ticks = interval(TICK);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut tick: u64 = 0;
    loop {
        tokio::select! {
            // Time goes on whoever talks without end.
            biased;
            _ = ticks.tick() => {}
            () = outside.listen(stage) => continue,
        }
        tick += 1;
        outside.speak(node, stage).await;
        let now_s = stage.now_s();
        let truth = match &*stage.actor() {
            Actor::Simulated(world) => Some(world.truth()),
            Actor::Reported(reported) => reported.truth(),
        };
        let Some(truth) = truth else { continue };
        let stamp_ns = stage.stamp_ns(truth.time_s);
        stage.begin_when_high(&truth);
        let (_, pad) = stage.pad_at(truth.time_s);
        stage.witness().see(&truth, &pad, stamp_ns);
        if tick.is_multiple_of(TRUTH_EVERY) {
            let message = stage.witness().message(&truth, &pad, stamp_ns, lid_m);
            truths.publish(&message).await;
        }
        let air = match &*stage.actor() {
            Actor::Simulated(world) => Some(world.wind()),
            Actor::Reported(_) => None,
        };
        if let Some(air) = air.filter(|_| tick.is_multiple_of(WIND_EVERY)) {
            let stamp_ns = stage.stamp_ns(now_s);
            winds.publish(&Wind { stamp_ns, velocity_ned_m_s: air.coords.into() }).await;
        }
    }
}

/// The autopilot's side: our own on a link, or a real one through the controller.
#[expect(clippy::large_enum_variant, reason = "there is one")]
enum Outside {
    Link(Link),
    Topics {
        packets: node::Subscriber<MavlinkBytes>,
        requests: Publisher<MavlinkBytes>,
        asked_s: f64,
    },
}

impl Outside {
    async fn open(node: &Node, config: &Config) -> anyhow::Result<Self> {
        Ok(match config.vehicle {
            Flown::Simulated => {
                let address: Address = config.autopilot.address.parse()?;
                let link = Link::open(address).await;
                Self::Link(link.context("opening the simulated autopilot's link")?)
            }
            Flown::Reported => Self::Topics {
                packets: node.subscriber(topic::FROM_AUTOPILOT, &[]).await?,
                requests: node.publisher(topic::TO_AUTOPILOT, &[]).await?,
                asked_s: f64::NEG_INFINITY,
            },
        })
    }

    /// Takes the next packet in.
    async fn listen(&mut self, stage: &Stage) {
        match self {
            Self::Link(link) => {
                if let LinkEvent::Frame { frame, .. } = link.recv().await
                    && let Actor::Simulated(world) = &mut *stage.actor()
                {
                    world.advance_to(stage.now_s());
                    world.handle(&frame);
                }
            }
            Self::Topics { packets, .. } => {
                let Some(message) = packets.next().await else {
                    return std::future::pending().await;
                };
                let mut parser = Parser::new();
                let mut frames = parser.push(&message.packet);
                frames.extend(parser.finish());
                let now_s = stage.now_s();
                if let Actor::Reported(reported) = &mut *stage.actor() {
                    frames.iter().for_each(|frame| reported.handle(now_s, frame));
                }
            }
        }
    }

    /// Brings the world up to date and sends what its autopilot says; or asks a real one for the truth.
    async fn speak(&mut self, node: &Node, stage: &Stage) {
        match self {
            Self::Link(link) => {
                let packets: Vec<Vec<u8>> = match &mut *stage.actor() {
                    Actor::Simulated(world) => {
                        world.advance_to(stage.now_s());
                        world.outgoing().collect()
                    }
                    Actor::Reported(_) => Vec::new(),
                };
                for packet in packets {
                    if link.send(&packet).is_err() {
                        node.health().dropped("packets without a listener");
                    }
                }
            }
            Self::Topics { requests, asked_s, .. } => {
                let now_s = stage.now_s();
                let is_true = match &*stage.actor() {
                    Actor::Reported(reported) => reported.is_true(now_s),
                    Actor::Simulated(_) => true,
                };
                if !is_true && now_s - *asked_s > ASK_PERIOD.as_secs_f64() {
                    *asked_s = now_s;
                    for message in TRUTH_MESSAGES {
                        requests.publish(&MavlinkBytes { packet: request_for(message) }).await;
                    }
                }
            }
        }
    }
}

/// SET_MESSAGE_INTERVAL for a message, to any system.
fn request_for(message: f32) -> Vec<u8> {
    let message = MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
        param1: message,
        param2: TRUTH_INTERVAL_US,
        command: MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL,
        target_system: 0,
        target_component: 1,
        ..COMMAND_LONG_DATA::default()
    });
    autopilot::frame::encode(Sender { system: 255, component: 192 }, 0, &message)
}

/// A frame that is on its way.
struct Late {
    due_s: f64,
    header: FrameHeader,
    pixels: Loan,
}

/// The camera's thread.
struct Camera {
    node: Node,
    stage: Arc<Stage>,
    eye: Eye,
    late: VecDeque<Late>,
    frames: FramePublisher,
    air: AirSender,
    infos: Publisher<CameraInfo>,
    info: CameraInfo,
    period_s: f64,
}

impl Camera {
    async fn new(node: &Node, config: &Config, stage: Arc<Stage>) -> anyhow::Result<Self> {
        let eye = Eye::new(config)?;
        let settings = eye.settings().clone();
        let name = &config.camera.name;
        let bytes = config.camera.width as usize * config.camera.height as usize;
        let mount = settings.body_from_camera;
        let origin = mount.origin();
        let info = CameraInfo {
            camera: name.clone(),
            width: config.camera.width,
            height: config.camera.height,
            focal_px: Some([settings.model.fx, settings.model.fy]),
            principal_px: [settings.model.cx, settings.model.cy],
            lens: LensModel::Pinhole,
            body_from_camera: Transform3 {
                translation_m: [origin.x(), origin.y(), origin.z()],
                rotation_wxyz: mount.rotation().wxyz(),
            },
        };
        let jpegs = node.frame_publisher(topic::JPEG, &[name], 0).await?;
        Ok(Self {
            eye,
            late: VecDeque::new(),
            frames: node.frame_publisher(topic::FRAME, &[name], bytes).await?,
            air: AirSender::start(node, name, jpegs, &config.air).await?,
            infos: node.publisher(topic::CAMERA_INFO, &[name]).await?,
            info,
            period_s: 1.0 / config.camera.rate_hz,
            node: node.clone(),
            stage,
        })
    }

    /// Starts the thread. The receiver hears when it ends.
    fn start(mut self) -> anyhow::Result<(oneshot::Receiver<()>, std::thread::JoinHandle<()>)> {
        let runtime = Handle::current();
        let (running, stopped) = oneshot::channel();
        let thread = std::thread::Builder::new()
            .name("camera".to_owned())
            .spawn(move || {
                // The frames' grid begins now; the world may have begun long before.
                let mut sequence = (self.stage.now_s() / self.period_s) as u64 + 1;
                while !running.is_closed() {
                    let time_s = sequence as f64 * self.period_s;
                    let exposed_s = time_s + self.eye.settings().exposure_s / 2.0;
                    // A tick later the world's past holds the whole exposure.
                    let ready_s = exposed_s + TICK.as_secs_f64() * 1.5;
                    while let Some(due_s) = self.next_due_s().filter(|due_s| *due_s < ready_s) {
                        self.sleep_until(due_s);
                        runtime.block_on(self.publish_late());
                    }
                    self.sleep_until(ready_s);
                    runtime.block_on(self.take(sequence, time_s));
                    let due = (self.stage.now_s() / self.period_s) as u64;
                    if due > sequence + 1 {
                        self.node.health().dropped("frames that took too long to render");
                    }
                    sequence = (sequence + 1).max(due);
                }
            })
            .context("starting the camera's thread")?;
        Ok((stopped, thread))
    }

    /// Takes the frame of a moment and publishes it.
    async fn take(&mut self, sequence: u64, time_s: f64) {
        if sequence.is_multiple_of((1.0 / self.period_s).ceil() as u64) {
            self.infos.publish(&self.info).await;
        }
        let Some(truth) = self.stage.truth_at(time_s) else { return };
        let (begun_s, pad) = self.stage.pad_at(time_s);
        let moment = Moment { sequence, time_s, begun_s, pad };
        let Some(passage) = self.eye.open(&moment, &truth) else { return };
        let started_ns = now_ns();
        let mut frame = self.frames.loan(self.info.width as usize * self.info.height as usize);
        let stage = &self.stage;
        let truth_at = |time_s| stage.truth_at(time_s).unwrap_or(truth);
        if let Err(problem) = self.eye.render(&moment, truth_at, &mut frame) {
            if self.node.health().failed("render") {
                tracing::error!(%problem, "A frame could not be rendered");
            }
            return;
        }
        let took = Duration::from_nanos((now_ns() - started_ns).max(0).unsigned_abs());
        self.node.health().latency("render", took);
        let header = FrameHeader {
            camera: self.info.camera.clone(),
            sequence,
            stamp_ns: self.stage.stamp_ns(time_s + passage.stamp_error_s),
            clock: clock_name().to_owned(),
            exposure_ns: (self.eye.settings().exposure_s * 1e9) as u32,
            width: self.info.width,
            height: self.info.height,
            format: PixelFormat::Mono8,
            parts: Vec::new(),
        };
        let again = passage.again_after_s.map(|after_s| (time_s + after_s, frame.to_vec()));
        let late = passage.arrives_after_s > 0.0;
        if late {
            self.delay(time_s + passage.arrives_after_s, header.clone(), frame);
        } else {
            self.publish(&header, frame).await;
        }
        if let Some((due_s, copy)) = again {
            self.delay(due_s, header, Loan::Private(copy));
        }
        self.publish_late().await;
    }

    /// Publishes a frame, and offers it to the air link.
    async fn publish(&mut self, header: &FrameHeader, frame: Loan) {
        self.air.offer(header, &frame);
        self.frames.publish(header, frame).await;
        self.stage.witness().frames += 1;
    }

    /// Sends a frame on its way.
    fn delay(&mut self, due_s: f64, header: FrameHeader, pixels: Loan) {
        if self.late.len() >= MOST_LATE {
            self.late.pop_front();
            self.node.health().dropped("late frames");
        }
        let place = self.late.partition_point(|late| late.due_s <= due_s);
        self.late.insert(place, Late { due_s, header, pixels });
    }

    fn next_due_s(&self) -> Option<f64> {
        self.late.front().map(|late| late.due_s)
    }

    fn sleep_until(&self, time_s: f64) {
        let wait_s = time_s - self.stage.now_s();
        if wait_s > 0.0 {
            std::thread::sleep(Duration::from_secs_f64(wait_s));
        }
    }

    /// Publishes the frames that have arrived.
    async fn publish_late(&mut self) {
        while self.next_due_s().is_some_and(|due_s| due_s <= self.stage.now_s()) {
            let Some(Late { header, pixels, .. }) = self.late.pop_front() else { return };
            self.publish(&header, pixels).await;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::{Point, Vector};
    use world::vehicle::{Vehicle, VehicleConfig};

    #[test]
    fn a_touchdown_is_told_by_the_motion_before_the_legs_touch() {
        let mut witness = Witness::default();
        let pad = PadConfig::default().at(None);
        let still = Vehicle::new(VehicleConfig::default(), 1).truth();
        let at = |height_m: f64, fall: f64, on_ground| VehicleTruth {
            position: Point::new(1.4, -1.5, -height_m),
            velocity: Vector::new(0.1, 0.0, fall),
            height_m,
            on_ground,
            ..still
        };
        witness.see(&at(0.0, 0.0, true), &pad, 0);
        assert!(witness.touchdown.is_none(), "it has not flown yet");
        witness.see(&at(5.0, 1.0, false), &pad, 1);
        witness.see(&at(0.1, 0.5, false), &pad, 2);
        // A hop too short to see ends in a touch without speed.
        witness.see(&at(0.001, 0.0, false), &pad, 3);
        witness.see(&at(0.0, 0.0, true), &pad, 4);
        let touchdown = witness.touchdown.unwrap();
        assert!((touchdown.error_m - 0.1).abs() < 1e-9 && touchdown.stamp_ns == 4);
        assert!((touchdown.vertical_speed_m_s - 0.5).abs() < 1e-9);
        assert!((touchdown.lateral_speed_m_s - 0.1).abs() < 1e-9);
    }
}
