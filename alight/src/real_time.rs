//! Flies one landing with faults in real time: the services run as processes that are killed and stopped, and their link to the simulated
//! autopilot goes through a proxy that fails.

use std::fs::{File, OpenOptions};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use anyhow::{Context, bail};
use experiments::faults::kind::Kind;
use experiments::faults::outcome::{Ending, Outcome};
use experiments::faults::plan::{Fault, Planned};
use messages::{ControllerStatus, Phase, Truth, topic};
use node::{Network, Node, now_ns};
use rustix::process::{Pid, Resource, Rlimit, Signal, kill_process, prlimit};
use tokio::time::{Instant, MissedTickBehavior, interval, timeout};

use crate::fault_link::Proxy;
use crate::land::free_port;
use crate::runtime::tool_identity;

/// Timeout of a flight, in seconds.
const TIMEOUT_S: f64 = 240.0;
/// Timeout for the start of the landing, in seconds.
const START_TIMEOUT_S: f64 = 60.0;
/// Speed below which the vehicle is stationary in the air, in m/s.
const REST_M_S: f64 = 0.6;
/// Time without motion after which a flight is over, in seconds: on the ground and in the air.
const LANDED_S: f64 = 6.0;
const HOVERS_S: f64 = 10.0;
/// Time after the begin of the last fault before which a hover counts for nothing, in seconds.
const AFTER_FAULT_S: f64 = 15.0;
/// Memory that a process may use in addition to its present size when its memory is limited, in bytes.
const SPARE_BYTES: u64 = 1 << 20;
/// Period at which the campaign checks the flight.
const LOOK: Duration = Duration::from_millis(5);
/// The vehicle's name in the network of its services, and in that of its world.
const VEHICLE: &str = "tried";
const WORLD: &str = "world";
/// A start without much shared memory, of the program in the arguments.
const SMALL_MEMORY: &str = "mount -t tmpfs -o size=64k tmpfs /dev/shm && exec \"$@\"";

/// A process that can be killed and stopped.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
enum Part {
    World,
    Camera,
    Detector,
    Controller,
    Bridge,
}

impl Part {
    fn service(self) -> &'static str {
        match self {
            Self::World | Self::Camera => "simulator",
            Self::Detector => "detector",
            Self::Controller => "controller",
            Self::Bridge => "gcs-bridge",
        }
    }

    /// Its log in the folder of a flight.
    fn log(self, folder: &Path) -> PathBuf {
        folder.join(format!("{self:?}.log").to_lowercase())
    }

    fn of(kind: Kind) -> Option<Self> {
        Some(match kind {
            Kind::ControllerKilled | Kind::ControllerStopped | Kind::ControllerMemory => {
                Self::Controller
            }
            Kind::DetectorKilled | Kind::DetectorStopped | Kind::DetectorMemory => Self::Detector,
            Kind::CameraKilled | Kind::CameraStopped => Self::Camera,
            Kind::BridgeKilled | Kind::BridgeStopped => Self::Bridge,
            _ => return None,
        })
    }
}

/// Flies it. `folder` gets the logs of the processes.
///
/// # Errors
/// When a process does not start, or the landing does not begin.
pub(crate) async fn fly(planned: &Planned, folder: &Path) -> anyhow::Result<Outcome> {
    let mut flight = RealFlight::begin(planned, folder).await?;
    flight.run().await.with_context(|| planned.command())?;
    Ok(flight.outcome.clone())
}

/// A fault that has begun.
struct Begun {
    fault: Fault,
    at: Instant,
    ended: bool,
}

struct RealFlight<'a> {
    planned: &'a Planned,
    folder: &'a Path,
    meet: u16,
    apart: u16,
    /// The port at which the controller awaits the autopilot.
    port: u16,
    parts: Vec<(Part, Child)>,
    proxy: Proxy,
    status: Option<ControllerStatus>,
    truth: Option<Truth>,
    started: Option<Instant>,
    reached: Option<Instant>,
    rest_since: Option<Instant>,
    begun: Vec<Begun>,
    ground: Ground,
    outcome: Outcome,
}

/// The ground as the vehicle met it.
#[derive(Debug, Default)]
struct Ground {
    /// Where it first touched, downwards, in metres.
    touched_z: Option<f64>,
    /// When it touched last: every truth contains the latest touch, until the vehicle is well in the air again.
    touch_ns: Option<i64>,
}

impl Ground {
    /// Notes each touch, and how far the vehicle rises from the first.
    fn see(&mut self, truth: &Truth, outcome: &mut Outcome) {
        let z = truth.position_ned_m[2];
        if let Some(touch) = truth.touchdown
            && self.touch_ns != Some(touch.stamp_ns)
        {
            self.touch_ns = Some(touch.stamp_ns);
            self.touched_z.get_or_insert(z);
            outcome.touch(touch.vertical_speed_m_s, touch.lateral_speed_m_s, touch.error_m);
        }
        if let Some(touched_z) = self.touched_z {
            outcome.hop(touched_z - z);
        }
    }
}

impl<'a> RealFlight<'a> {
    async fn begin(planned: &'a Planned, folder: &'a Path) -> anyhow::Result<Self> {
        std::fs::create_dir_all(folder).with_context(|| format!("making {}", folder.display()))?;
        let port = || free_port().map(|(port, _)| port);
        let (meet, apart, world_port, port) = (port()?, port()?, port()?, port()?);
        let seed = planned.seed;
        let proxy = Proxy::start(seed, world_port, port).await?;
        let mut flight = Self::waiting(planned, folder, [meet, apart, port], proxy);
        let mut world = settings_of_world(planned);
        world.push(format!("autopilot.address=udpout:127.0.0.1:{world_port}"));
        if flight.has_own_camera() {
            // The camera follows what the autopilot reports; the world's own would only take time.
            world.extend(["autopilot.errors=0", "camera.rate_hz=0.1"].map(str::to_owned));
        }
        flight.start(Part::World, &world)?;
        for part in [Part::Camera, Part::Detector, Part::Controller, Part::Bridge] {
            if part != Part::Camera || flight.has_own_camera() {
                flight.start(part, &flight.settings(part, false)?)?;
            }
        }
        Ok(flight)
    }

    /// A flight of which no process is started yet, with the ports of its networks and its controller.
    fn waiting(planned: &'a Planned, folder: &'a Path, ports: [u16; 3], proxy: Proxy) -> Self {
        let [meet, apart, port] = ports;
        Self {
            planned,
            folder,
            meet,
            apart,
            port,
            parts: Vec::new(),
            proxy,
            status: None,
            truth: None,
            started: None,
            reached: None,
            rest_since: None,
            begun: Vec::new(),
            ground: Ground::default(),
            outcome: Outcome::new(planned),
        }
    }

    /// True when the camera is a process apart from the world's.
    fn has_own_camera(&self) -> bool {
        self.has(|kind| Part::of(kind) == Some(Part::Camera))
    }

    fn has(&self, is_it: impl Fn(Kind) -> bool) -> bool {
        self.planned.faults.iter().any(|fault| is_it(fault.kind))
    }

    fn settings(&self, part: Part, again: bool) -> anyhow::Result<Vec<String>> {
        let text =
            |settings: &[&str]| settings.iter().map(|&s| s.to_owned()).collect::<Vec<String>>();
        Ok(match part {
            Part::World => Vec::new(),
            Part::Camera => {
                let seed = format!("seed={}", self.planned.seed);
                let mut settings = self.planned.given("simulator");
                settings.extend(text(&["id=camera", "vehicle=reported", &seed]));
                settings
            }
            Part::Detector => self.planned.detector()?,
            Part::Controller => {
                let mut settings = self.planned.controller.clone();
                settings.push(format!("autopilot.address=udpin:127.0.0.1:{}", self.port));
                settings.extend(again.then(|| "start=resume".to_owned()));
                settings
            }
            Part::Bridge => text(&["ground=udpout:127.0.0.1:9"]),
        })
    }

    fn start(&mut self, part: Part, settings: &[String]) -> anyhow::Result<()> {
        let program = node::own_program();
        let is_apart = part == Part::World && self.has_own_camera();
        let (meet, vehicle) = if is_apart { (self.apart, WORLD) } else { (self.meet, VEHICLE) };
        let mut command = if self.has(|kind| kind == Kind::FullSharedMemory) {
            let mut command = Command::new("unshare");
            command.args(["-rm", "sh", "-c", SMALL_MEMORY, "sh"]).arg(&program);
            command
        } else {
            Command::new(&program)
        };
        command.arg(part.service()).args(["--meet", &meet.to_string(), "--vehicle", vehicle]);
        command.arg("--stop-with-parent").arg(std::process::id().to_string());
        for setting in settings {
            command.args(["--set", setting]);
        }
        // A controller's notes of this vehicle are of use in this flight only.
        command.env(node::STATE_VARIABLE, self.folder);
        let log = if self.has(|kind| kind == Kind::FullDisk) && part != Part::World {
            command.env("ALIGHT_LOG", "debug");
            File::create("/dev/full").context("opening /dev/full")?
        } else {
            OpenOptions::new().create(true).append(true).open(part.log(self.folder))?
        };
        let child = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(log).spawn();
        let child = child.with_context(|| format!("starting {}", part.service()))?;
        self.parts.push((part, child));
        Ok(())
    }

    async fn run(&mut self) -> anyhow::Result<()> {
        let node = open(self.meet, VEHICLE).await?;
        let world_meet = if self.has_own_camera() { self.apart } else { self.meet };
        let world_vehicle = if self.has_own_camera() { WORLD } else { VEHICLE };
        let aside = open(world_meet, world_vehicle).await?;
        let statuses = node.subscriber(topic::STATUS, &[]).await?;
        let truths = aside.subscriber(topic::TRUTH, &[]).await?;
        let opened = Instant::now();
        let mut looks = interval(LOOK);
        looks.set_missed_tick_behavior(MissedTickBehavior::Skip);
        loop {
            tokio::select! {
                Some(status) = statuses.next() => self.status = Some(status),
                Some(truth) = truths.next() => self.see(truth),
                _ = looks.tick() => {}
            }
            self.check_parts()?;
            self.begin_and_end_faults()?;
            self.describe();
            let (since, timeout_s) = match self.started {
                Some(started) => (started, TIMEOUT_S),
                None => (opened, START_TIMEOUT_S),
            };
            if self.is_over() || since.elapsed().as_secs_f64() > timeout_s {
                break;
            }
        }
        for node in [node, aside] {
            // A peer that was killed may leave a session that does not end in good order.
            let _ = timeout(Duration::from_secs(2), node.close()).await;
        }
        Ok(())
    }

    /// Checks that all processes run until the landing begins. If one ends later, the flight shows the consequence.
    fn check_parts(&mut self) -> anyhow::Result<()> {
        // Faults of the start are active from the beginning, and it is their effect that a process ends.
        let may_end = self.has(|kind| matches!(kind, Kind::FullDisk | Kind::FullSharedMemory));
        if self.started.is_some() || may_end {
            return Ok(());
        }
        for (part, child) in &mut self.parts {
            if let Some(status) = child.try_wait().context("looking after the processes")? {
                let log = std::fs::read_to_string(part.log(self.folder)).unwrap_or_default();
                bail!(
                    "{} ended before the landing began ({status}): {}",
                    part.service(),
                    last_line(&log)
                );
            }
        }
        Ok(())
    }

    fn see(&mut self, truth: Truth) {
        self.ground.see(&truth, &mut self.outcome);
        self.outcome.max_tilt_deg = truth.max_tilt_rad.to_degrees();
        let speed_m_s = truth.velocity_ned_m_s.iter().map(|v| v * v).sum::<f64>().sqrt();
        let was_on_ground = self.truth.as_ref().is_some_and(|before| before.on_ground);
        if !(truth.on_ground || speed_m_s < REST_M_S) {
            self.rest_since = None;
        } else if self.rest_since.is_none() || was_on_ground != truth.on_ground {
            self.rest_since = Some(Instant::now());
        }
        let height_m = truth.pad_ned_m[2] - truth.position_ned_m[2];
        let has_begun = self.status.as_ref().is_some_and(|status| status.started_ns.is_some());
        if has_begun {
            self.started.get_or_insert_with(Instant::now);
        }
        if self.started.is_some() && height_m <= self.planned.height_m {
            self.reached.get_or_insert_with(Instant::now);
            self.outcome.began = true;
        }
        self.truth = Some(truth);
    }

    fn begin_and_end_faults(&mut self) -> anyhow::Result<()> {
        let Some(reached) = self.reached else { return Ok(()) };
        while let Some(fault) = self.planned.faults.get(self.begun.len()).copied()
            && reached.elapsed().as_secs_f64() >= fault.after_s
        {
            self.begin_fault(fault)?;
            self.begun.push(Begun { fault, at: Instant::now(), ended: false });
        }
        for index in 0..self.begun.len() {
            let Some(begun) = self.begun.get_mut(index) else { break };
            if !begun.ended && begun.at.elapsed().as_secs_f64() >= begun.fault.for_s {
                begun.ended = true;
                let fault = begun.fault;
                self.end_fault(fault)?;
            }
        }
        Ok(())
    }

    fn begin_fault(&mut self, fault: Fault) -> anyhow::Result<()> {
        self.proxy.begin(fault);
        let Some(part) = Part::of(fault.kind) else { return Ok(()) };
        match fault.kind {
            Kind::ControllerMemory | Kind::DetectorMemory => self.limit_memory(part),
            Kind::ControllerStopped
            | Kind::DetectorStopped
            | Kind::CameraStopped
            | Kind::BridgeStopped => self.signal(part, Signal::STOP),
            _ => {
                self.signal(part, Signal::KILL)?;
                self.bury(part);
                Ok(())
            }
        }
    }

    fn end_fault(&mut self, fault: Fault) -> anyhow::Result<()> {
        let Some(part) = Part::of(fault.kind) else { return Ok(()) };
        match fault.kind {
            Kind::ControllerMemory | Kind::DetectorMemory => Ok(()),
            Kind::ControllerStopped
            | Kind::DetectorStopped
            | Kind::CameraStopped
            | Kind::BridgeStopped => self.signal(part, Signal::CONT),
            _ => self.start(part, &self.settings(part, true)?),
        }
    }

    fn pid(&self, part: Part) -> Option<Pid> {
        let (_, child) = self.parts.iter().find(|(running, _)| *running == part)?;
        i32::try_from(child.id()).ok().and_then(Pid::from_raw)
    }

    fn signal(&self, part: Part, signal: Signal) -> anyhow::Result<()> {
        let Some(pid) = self.pid(part) else { return Ok(()) };
        kill_process(pid, signal).with_context(|| format!("signalling {}", part.service()))
    }

    /// Takes the exit of a killed process.
    fn bury(&mut self, part: Part) {
        if let Some(at) = self.parts.iter().position(|(running, _)| *running == part) {
            let (_, mut child) = self.parts.remove(at);
            // Its status is known: it was killed.
            let _ = child.wait();
        }
    }

    /// Limits a process to hardly more memory than it has.
    fn limit_memory(&self, part: Part) -> anyhow::Result<()> {
        let Some(pid) = self.pid(part) else { return Ok(()) };
        let path = format!("/proc/{}/status", pid.as_raw_nonzero());
        let status = std::fs::read_to_string(&path).with_context(|| path.clone())?;
        let line = status.lines().find_map(|line| line.strip_prefix("VmSize:"));
        let size = line.and_then(|line| line.split_whitespace().next());
        let size: u64 = size.with_context(|| format!("VmSize in {path}"))?.parse()?;
        let bytes = 1024 * size + SPARE_BYTES;
        let limit = Rlimit { current: Some(bytes), maximum: Some(bytes) };
        prlimit(Some(pid), Resource::As, limit).context("limiting memory")?;
        Ok(())
    }

    /// Whether the controller is gone or stopped permanently.
    fn is_without_controller(&self) -> bool {
        let gone = |begun: &Begun| {
            matches!(
                begun.fault.kind,
                Kind::ControllerKilled | Kind::ControllerStopped | Kind::ControllerMemory
            ) && !begun.ended
        };
        let status_age_ns =
            self.status.as_ref().map_or(i64::MAX, |status| now_ns() - status.stamp_ns);
        self.begun.iter().any(gone) && status_age_ns > 1_000_000_000
    }

    fn describe(&mut self) {
        if let Some(started) = self.started {
            self.outcome.time_s = started.elapsed().as_secs_f64();
        }
        let outcome = &mut self.outcome;
        if let Some(status) = &self.status {
            outcome.phase = status.phase.name().to_owned();
            outcome.why.clone_from(&status.why);
            outcome.is_over = matches!(
                status.phase,
                Phase::Landed | Phase::Aborted | Phase::PilotInCommand | Phase::Failed
            );
        }
        if self.is_without_controller() {
            self.outcome.is_over = true;
            self.outcome.phase.clear();
            self.outcome.why = "the controller is gone".to_owned();
        }
    }

    fn is_over(&mut self) -> bool {
        let (Some(truth), Some(since)) = (&self.truth, self.rest_since) else { return false };
        let rests_s = since.elapsed().as_secs_f64();
        let waits = self.begun.iter().any(|begun| {
            begun.at.elapsed().as_secs_f64() < AFTER_FAULT_S
                || begun.fault.for_s.is_finite() && !begun.ended
        });
        let is_over = self.outcome.is_over;
        let touched = truth.on_ground && truth.touchdown.is_some();
        let ending = if touched && rests_s > LANDED_S && is_over {
            Ending::Landed
        } else if touched && rests_s > 3.0 * LANDED_S {
            Ending::Grounded
        } else if !truth.on_ground && rests_s > HOVERS_S && is_over && !waits {
            Ending::Hovers
        } else {
            return false;
        };
        self.outcome.ending = ending;
        true
    }
}

impl Drop for RealFlight<'_> {
    fn drop(&mut self) {
        for (_, child) in &mut self.parts {
            // A stopped process is ended as well.
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// The simulator's settings: of those that are drawn, the camera's and the landing's begin are for lock-step, as here images and
/// processes take their own time.
fn settings_of_world(planned: &Planned) -> Vec<String> {
    let given = planned.given("simulator");
    let drawn = planned.simulator.len().saturating_sub(given.len());
    let is_for_lockstep =
        |setting: &String| setting.starts_with("camera.") || setting.starts_with("begin_");
    let drawn = planned.simulator.iter().take(drawn).filter(|setting| !is_for_lockstep(setting));
    drawn.cloned().chain(given).collect()
}

/// The last line of a log.
fn last_line(log: &str) -> &str {
    log.lines().rev().find(|line| !line.trim().is_empty()).unwrap_or("its log is empty")
}

async fn open(meet: u16, vehicle: &str) -> anyhow::Result<Node> {
    let network =
        Network { vehicle: Some(vehicle.to_owned()), meet: Some(meet), ..Network::default() };
    Node::open(tool_identity("faults"), &network.source(crate::args::OPERATOR)?).await
}

#[cfg(test)]
mod tests {
    use super::*;
    use experiments::faults::plan::Plan;
    use messages::Touchdown;
    use node::Layers;

    #[test]
    fn a_process_that_ends_before_the_landing_is_reported_with_its_last_line() {
        let folder = tempfile::tempdir().unwrap();
        let mut plan = Plan { flights: 1, ..Plan::default() };
        plan.kinds = vec![Kind::ControllerKilled];
        let planned = plan.flights().remove(0);
        let error = crate::runtime::block_on(async {
            let proxy = Proxy::start(1, 0, 9).await?;
            let mut flight = RealFlight::waiting(&planned, folder.path(), [0; 3], proxy);
            let log = Part::Controller.log(folder.path());
            std::fs::write(&log, "starting\nno key `nonsense`\n\n")?;
            let mut child = Command::new("false").spawn()?;
            child.wait()?;
            flight.parts.push((Part::Controller, child));
            let error = flight.check_parts().unwrap_err().to_string();
            flight.started = Some(Instant::now());
            flight.check_parts()?;
            anyhow::Ok(error)
        });
        let error = error.unwrap().unwrap();
        assert!(error.contains("controller ended") && error.contains("`nonsense`"), "{error}");
    }

    #[test]
    fn every_process_has_the_marker_that_was_asked_for() {
        let folder = tempfile::tempdir().unwrap();
        let name = "apriltag-36h11:7:0.2";
        let marker = name.parse().ok();
        let kinds = vec![Kind::CameraKilled];
        let planned = Plan { flights: 1, marker, kinds, ..Plan::default() }.flights().remove(0);
        let flown = crate::runtime::block_on(async {
            let proxy = Proxy::start(1, 0, 9).await?;
            let flight = RealFlight::waiting(&planned, folder.path(), [0; 3], proxy);
            let of = |part| flight.settings(part, true);
            anyhow::Ok([of(Part::Detector)?, of(Part::Camera)?, of(Part::Controller)?])
        });
        let [detector, camera, controller] = flown.unwrap().unwrap();
        let detector = Layers { file: None, set: detector }.load::<detector::Config>().unwrap();
        assert_eq!(detector.settings.markers, [name]);
        for set in [camera, settings_of_world(&planned)] {
            let simulator = Layers { file: None, set }.load::<simulator::Config>().unwrap();
            assert_eq!(simulator.settings.pad.marker, name);
        }
        let controller = Layers { file: None, set: controller }.load::<controller::Config>();
        assert_eq!(controller.unwrap().settings.marker, "apriltag-36h11:7");
    }

    #[test]
    fn the_worlds_settings_are_drawn_but_for_lock_steps_own_and_then_those_given() {
        let set = vec!["simulator.camera.rate_hz=20".to_owned()];
        let planned = Plan { set, ..Plan::default() }.flights().remove(0);
        let settings = settings_of_world(&planned);
        let cameras: Vec<&String> =
            settings.iter().filter(|setting| setting.starts_with("camera.")).collect();
        assert_eq!(cameras, ["camera.rate_hz=20"]);
        assert!(!settings.iter().any(|setting| setting.starts_with("begin_")));
        assert!(settings.iter().any(|setting| setting.starts_with("start.height_m=")));
    }

    #[test]
    fn a_vehicle_that_leaves_the_ground_again_is_reported() {
        let mut outcome = Outcome::new(&Plan::default().flights()[0]);
        let mut ground = Ground::default();
        let touch = |stamp_ns, vertical_speed_m_s| {
            Some(Touchdown { stamp_ns, error_m: 0.1, vertical_speed_m_s, lateral_speed_m_s: 0.0 })
        };
        let (soft, hard) = (touch(1, 0.5), touch(2, 2.0));
        let seen =
            [(1.0, None), (0.02, soft), (0.22, soft), (0.62, None), (0.02, hard), (0.02, hard)];
        for (height_m, touchdown) in seen {
            let truth = Truth {
                position_ned_m: [0.0, 0.0, -height_m],
                on_ground: height_m < 0.03,
                touchdown,
                ..Truth::sample()
            };
            ground.see(&truth, &mut outcome);
        }
        assert_eq!((outcome.touches, outcome.sink_m_s), (2, Some(2.0)));
        assert!(outcome.has_left_ground() && (outcome.hop_m.unwrap() - 0.6).abs() < 1e-9);
    }
}
