//! For the system tests: starts `alight land` or a vehicle of its own, kills and restarts its services, waits for statuses and true heights, and
//! returns the result of the landing.

#![allow(dead_code, reason = "each test uses its part")]

use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Child, Command, Output, Stdio};
use std::sync::LazyLock;
use std::time::Duration;

use anyhow::{Context, anyhow, bail, ensure};
use messages::{ControllerStatus, Phase, Truth, topic};
use node::{Identity, Network, Node, Subscriber, now_ns};
use rustix::process::{Pid, Signal, kill_process};
use tokio::sync::{Semaphore, SemaphorePermit, mpsc, watch};
use tokio::time::timeout;

/// Longest wait for anything; a landing takes a fifth of it.
pub(crate) const PATIENCE: Duration = Duration::from_secs(120);
/// Longest time that a landing may take to end after a command.
const MAX_END: Duration = Duration::from_secs(15);
/// Furthest from the pad's centre that a landing may end, after any event on the way; 0.05 m is the worst
/// of the landings without a fault in `docs/results.md`.
const MAX_ERROR_M: f64 = 0.1;
/// The simulated camera with a quarter of its pixels and without a camera's processing: the tests are of the interaction of processes,
/// on machines that may have no time for the rest.
const SMALL_CAMERA: [&str; 4] = [
    "camera.width=648",
    "camera.height=486",
    "camera.focal_px=909.0909090909091",
    "camera.processing=linear",
];
/// Options of a flight that stays in the air for as long as a test takes.
pub(crate) const LONG: [&str; 6] = [
    "--timeout-s",
    "3000",
    "--set",
    "controller.phases.operator_hold_timeout_s=3600",
    "--set",
    "controller.phases.landing_timeout_s=3000",
];
pub(crate) const ALIGHT: &str = env!("CARGO_BIN_EXE_alight-under-test");

/// Landings with the small camera that keep their time on two processors.
const MAX_AT_ONCE: u32 = 6;
static FLIGHTS: Semaphore = Semaphore::const_new(MAX_AT_ONCE as usize);
/// The number of tests that run alone, or wait for it.
static ALONE: LazyLock<watch::Sender<usize>> = LazyLock::new(|| watch::Sender::new(0));

/// Waits until there is time for one more landing, until the result is dropped.
pub(crate) async fn beside_another() -> anyhow::Result<SemaphorePermit<'static>> {
    time_for(1).await
}

/// Waits until there is time for this number of landings, or other work of this load.
pub(crate) async fn time_for(landings: u32) -> anyhow::Result<SemaphorePermit<'static>> {
    ALONE.subscribe().wait_for(|tests| *tests == 0).await?;
    Ok(FLIGHTS.acquire_many(landings).await?)
}

/// Waits until no landing is under way that waited for its time, and lets none begin: for tests that load the machine on their own, or measure milliseconds.
///
/// Such tests follow one another, before the others that wait: each time that all others must end first, the processors are idle.
pub(crate) async fn alone() -> anyhow::Result<Alone> {
    ALONE.send_modify(|tests| *tests += 1);
    let mut alone = Alone { permit: None };
    alone.permit = Some(FLIGHTS.acquire_many(MAX_AT_ONCE).await?);
    Ok(alone)
}

/// A test that runs alone, or waits for it.
pub(crate) struct Alone {
    permit: Option<SemaphorePermit<'static>>,
}

impl Drop for Alone {
    fn drop(&mut self) {
        self.permit = None;
        ALONE.send_modify(|tests| *tests -= 1);
    }
}

/// The small camera as items of the `set` of a site's file.
pub(crate) fn small_camera() -> String {
    SMALL_CAMERA.map(|key| format!("{key:?}")).join(", ")
}

/// The output of a command that should end on its own; a command that continues is killed.
pub(crate) fn output_of(command: &mut Command) -> anyhow::Result<Output> {
    let mut child =
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn()?;
    let began = std::time::Instant::now();
    while child.try_wait()?.is_none() {
        if began.elapsed() > PATIENCE / 4 {
            child.kill()?;
            bail!("{command:?} does not end: {:?}", child.wait_with_output()?);
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    Ok(child.wait_with_output()?)
}

/// A landing under way.
pub(crate) struct Landing {
    pub(crate) land: Child,
    pub(crate) said: mpsc::UnboundedReceiver<String>,
    pub(crate) zenoh: PathBuf,
    pub(crate) services: Vec<Service>,
    pub(crate) statuses: Subscriber<ControllerStatus>,
    pub(crate) truths: Subscriber<Truth>,
    pub(crate) node: Node,
    pub(crate) by_hand: Vec<Child>,
}

/// A separate simulated vehicle, in a separate network, which flies on when the landing that leads it is killed.
pub(crate) struct Vehicle {
    _simulator: Simulator,
    truths: Subscriber<Truth>,
    _node: Node,
    /// Where its autopilot is, for `alight land --autopilot`.
    pub(crate) address: String,
}

impl Vehicle {
    pub(crate) async fn start() -> anyhow::Result<Self> {
        let ([meet], _, port) = testing::ports::free()?;
        let simulator = Command::new(ALIGHT)
            .args(["simulator", "--meet", &meet.to_string()])
            .args(["--set", &format!("autopilot.address=udpout:127.0.0.1:{port}")])
            // Its pictures are not used: the landing's camera follows its pose.
            .args(["--set", "camera.rate_hz=1"])
            .args(SMALL_CAMERA.iter().flat_map(|key| ["--set", key]))
            .env("ALIGHT_LOG", "warn")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .spawn()?;
        let simulator = Simulator(simulator);
        let identity = Identity { service: "alight", instance: "test".into() };
        let network = Network { meet: Some(meet), ..Network::default() };
        let node = Node::open(identity, &network.source("operator")?).await?;
        let truths = node.subscriber(topic::TRUTH, &[]).await?;
        let address = format!("udpin:127.0.0.1:{port}");
        let vehicle = Self { _simulator: simulator, truths, _node: node, address };
        timeout(PATIENCE, vehicle.truths.next()).await.context("waiting for the vehicle")?;
        Ok(vehicle)
    }

    /// Its motion over a time, newest last.
    pub(crate) async fn motion(&self, duration: Duration) -> Vec<Truth> {
        motion(&self.truths, duration).await
    }
}

/// It ends also where its start is given up.
struct Simulator(Child);

impl Drop for Simulator {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

async fn motion(truths: &Subscriber<Truth>, duration: Duration) -> Vec<Truth> {
    let mut motion = Vec::new();
    let _ = timeout(duration, async {
        while let Some(truth) = truths.next().await {
            motion.push(truth);
        }
    })
    .await;
    motion
}

/// A service that `alight land` started.
pub(crate) struct Service {
    pub(crate) name: String,
    pub(crate) pid: Pid,
    pub(crate) by_hand: Vec<String>,
    /// The folder of its notes, if it is not the usual one.
    state: Option<String>,
}

impl Landing {
    pub(crate) async fn start(args: &[&str]) -> anyhow::Result<Self> {
        let options: &[&str] =
            if args.contains(&"--timeout-s") { &[] } else { &["--timeout-s", "110"] };
        let mut land = Command::new(ALIGHT)
            .args(["land", "--format", "json"])
            .args(options)
            // A ground station of the machine's own must not join the flight.
            .args(["--set", "gcs-bridge.ground=udpout:127.0.0.1:9"])
            .args(SMALL_CAMERA.iter().flat_map(|key| ["--set".into(), format!("simulator.{key}")]))
            .args(args)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()?;
        let mut lines = BufReader::new(land.stderr.take().context("standard error")?).lines();
        let mut services = Vec::new();
        let mut zenoh = None;
        let number = 4 + ["--record", "--dashboard"].iter().filter(|it| args.contains(it)).count();
        while services.len() < number {
            let line = lines.next().context("alight land printed nothing")??;
            if let Some(rest) = line.split("--zenoh ").nth(1).filter(|_| zenoh.is_none()) {
                zenoh = rest.split_whitespace().next().map(PathBuf::from);
            }
            services.extend(service_in(&line));
        }
        let (sender, said) = mpsc::unbounded_channel();
        std::thread::Builder::new().name("said".into()).spawn(move || {
            for line in lines.map_while(Result::ok) {
                if sender.send(line).is_err() {
                    return;
                }
            }
        })?;
        let zenoh = zenoh.context("the Zenoh configuration")?;
        let identity = Identity { service: "alight", instance: "test".into() };
        let vehicle = args.iter().skip_while(|it| **it != "--vehicle").nth(1);
        let vehicle = vehicle.map(|name| (*name).to_owned());
        let network = Network { config: Some(zenoh.clone()), vehicle, ..Network::default() };
        let node = Node::open(identity, &network.source("operator")?).await?;
        let statuses = node.subscriber(topic::STATUS, &[]).await?;
        let truths = node.subscriber(topic::TRUTH, &[]).await?;
        let by_hand = Vec::new();
        Ok(Self { land, said, zenoh, services, statuses, truths, node, by_hand })
    }

    pub(crate) fn service(&self, name: &str) -> anyhow::Result<&Service> {
        self.services.iter().find(|s| s.name == name).with_context(|| format!("no {name}"))
    }

    /// `kill -9`; the answer is when.
    pub(crate) fn kill(&self, name: &str) -> anyhow::Result<i64> {
        kill_process(self.service(name)?.pid, Signal::KILL)?;
        Ok(now_ns())
    }

    /// Starts a service again as a person would, with more settings.
    pub(crate) fn start_by_hand(&mut self, name: &str, settings: &[&str]) -> anyhow::Result<Pid> {
        let mut command = Command::new(ALIGHT);
        let Service { by_hand, state, .. } = self.service(name)?;
        command.args(by_hand);
        command.envs(state.iter().map(|state| ("STATE_DIRECTORY", state)));
        for setting in settings {
            command.args(["--set", setting]);
        }
        let child = command.stdin(Stdio::null()).stderr(Stdio::null()).spawn()?;
        let pid = Pid::from_raw(i32::try_from(child.id())?).context("a process id")?;
        self.by_hand.push(child);
        Ok(pid)
    }

    pub(crate) async fn status(
        &self,
        what: &str,
        mut holds: impl FnMut(&ControllerStatus) -> bool,
    ) -> anyhow::Result<ControllerStatus> {
        let mut last = None;
        let found = timeout(PATIENCE, async {
            while let Some(status) = self.statuses.next().await {
                if holds(&status) {
                    return Some(status);
                }
                last = Some(status);
            }
            None
        });
        found.await.ok().flatten().ok_or_else(|| anyhow!("waiting until {what}; last: {last:?}"))
    }

    /// Waits until the vehicle descends below a height.
    pub(crate) async fn descends_below(&self, height_m: f64) -> anyhow::Result<ControllerStatus> {
        self.status(&format!("it descends below {height_m} m"), |s| {
            s.phase == Phase::Descend && s.height_m.is_some_and(|h| h < height_m)
        })
        .await
    }

    pub(crate) async fn truth(
        &self,
        what: &str,
        mut holds: impl FnMut(&Truth) -> bool,
    ) -> anyhow::Result<Truth> {
        let found = timeout(PATIENCE, async {
            while let Some(truth) = self.truths.next().await {
                if holds(&truth) {
                    return Some(truth);
                }
            }
            None
        });
        found.await.ok().flatten().with_context(|| format!("waiting until {what}"))
    }

    /// The vehicle's motion over a time, newest last.
    pub(crate) async fn motion(&self, duration: Duration) -> Vec<Truth> {
        motion(&self.truths, duration).await
    }

    /// Waits for the result, and checks that it landed on the pad, and that nothing else was left undone.
    pub(crate) async fn lands(self) -> anyhow::Result<serde_json::Value> {
        let (result, status) = self.lands_with_losses().await?;
        ensure!(status == Some(0), "exit status {status:?}: {result}");
        Ok(result)
    }

    /// Waits for the result and the exit status, which reports an incomplete recording, and checks that it landed on
    /// the pad.
    pub(crate) async fn lands_with_losses(
        self,
    ) -> anyhow::Result<(serde_json::Value, Option<i32>)> {
        let (result, status) = self.ends().await?;
        ensure!(result["landed"] == true, "{result}");
        let error_m = result["touchdown_error_m"].as_f64().context("touchdown_error_m")?;
        ensure!(error_m < MAX_ERROR_M, "landed {error_m} m from the pad");
        Ok((result, status))
    }

    /// Waits for the result and the exit status.
    pub(crate) async fn ends(mut self) -> anyhow::Result<(serde_json::Value, Option<i32>)> {
        let mut stdout = self.land.stdout.take().context("standard output")?;
        let read = tokio::task::spawn_blocking(move || {
            let mut text = String::new();
            std::io::Read::read_to_string(&mut stdout, &mut text).map(|_| text)
        });
        let text = timeout(PATIENCE, read).await.context("waiting for the result")???;
        let result = serde_json::from_str(text.lines().last().context("no result")?)?;
        Ok((result, self.land.wait()?.code()))
    }
}

impl Drop for Landing {
    fn drop(&mut self) {
        // In order, with all its processes: those of a landing that is killed would meet with the next one.
        let began = std::time::Instant::now();
        if matches!(self.land.try_wait(), Ok(None)) {
            let _ = kill_process(Pid::from_child(&self.land), Signal::TERM);
        }
        while matches!(self.land.try_wait(), Ok(None)) && began.elapsed() < MAX_END {
            std::thread::sleep(Duration::from_millis(20));
        }
        let _ = self.land.kill();
        let _ = self.land.wait();
        for child in &mut self.by_hand {
            let _ = child.kill();
            let _ = child.wait();
        }
        // The output helps when a test fails, and is not shown otherwise.
        while let Ok(line) = self.said.try_recv() {
            println!("{line}");
        }
    }
}

/// The service in a line such as `detector is process 12; by hand: alight detector --zenoh FILE --set 'a=b'`; that of a controller
/// may begin with the folder of its notes.
pub(crate) fn service_in(line: &str) -> Option<Service> {
    let (start, by_hand) = line.split_once("; by hand: ")?;
    let (before, by_hand) = by_hand.split_once("alight ")?;
    let (name, pid) = start.split_once(" is process ")?;
    let by_hand = by_hand.split(' ').map(|word| word.trim_matches('\'').to_owned()).collect();
    let state = before.trim_end().strip_prefix("STATE_DIRECTORY=").map(str::to_owned);
    Some(Service { name: name.into(), pid: Pid::from_raw(pid.parse().ok()?)?, by_hand, state })
}

pub(crate) fn descent_m_s(truth: &Truth) -> f64 {
    truth.velocity_ned_m_s[2]
}

pub(crate) fn speed_m_s(truth: &Truth) -> f64 {
    truth.velocity_ned_m_s.iter().map(|v| v * v).sum::<f64>().sqrt()
}

pub(crate) fn seconds(ns: i64) -> f64 {
    ns as f64 * 1e-9
}
