//! Kills processes of a drone and a ground station, each under `alight up`, at random moments of landings, and checks
//! the touchdown and that all start again. The world is apart from both; the relay and the supervisors are killed
//! (`kill -9`) as well.

#![allow(dead_code, reason = "each program uses its part")]

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{File, OpenOptions};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use anyhow::{Context, anyhow, bail, ensure};
use messages::{ControllerCommand, ControllerStatus, DetectorState, Phase, Truth, topic};
use node::{Identity, Network, Node, now_ns};
use rustix::process::{Pid, Signal, kill_process};
use testing::ports;
use tokio::sync::watch;
use tokio::time::{sleep, timeout};

use crate::flight::{small_camera, time_for};

const ALIGHT: &str = env!("CARGO_BIN_EXE_alight-under-test");
/// Longest wait for anything.
const PATIENCE: Duration = Duration::from_secs(90);
/// The pause after which systemd starts a supervisor again: `RestartSec` of the units.
const RESTART: Duration = Duration::from_secs(1);

/// A process to kill.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Victim {
    /// A process of a side (`drone`, `ground`), by its name there; and its service and instance in the network.
    Process { side: usize, name: &'static str, alive: (&'static str, &'static str) },
    /// The supervisor of a side; one of its processes in the network, and its name in the table.
    Supervisor { side: usize, name: &'static str, alive: (&'static str, &'static str) },
}

const DRONE: usize = 0;
const GROUND: usize = 1;

const VICTIMS: [Victim; 8] = [
    Victim::Process { side: DRONE, name: "relay", alive: ("relay", "drone") },
    Victim::Process { side: DRONE, name: "camera", alive: ("simulator", "camera") },
    Victim::Process { side: DRONE, name: "detector", alive: ("detector", "onboard") },
    Victim::Process { side: DRONE, name: "controller", alive: ("controller", "main") },
    Victim::Supervisor { side: DRONE, name: "up drone", alive: ("controller", "main") },
    Victim::Process { side: GROUND, name: "detector", alive: ("detector", "ground") },
    Victim::Process { side: GROUND, name: "gcs-bridge", alive: ("gcs-bridge", "main") },
    Victim::Supervisor { side: GROUND, name: "up ground", alive: ("detector", "ground") },
];

impl Victim {
    fn alive(self) -> (String, String) {
        let (Self::Process { alive, .. } | Self::Supervisor { alive, .. }) = self;
        (alive.0.to_owned(), alive.1.to_owned())
    }

    fn in_words(self) -> String {
        match self {
            Self::Process { side: DRONE, name, .. } => format!("{name}, drone"),
            Self::Process { name, .. } => format!("{name}, ground"),
            Self::Supervisor { name, .. } => name.to_owned(),
        }
    }
}

/// The messages that are received on the drone.
#[derive(Clone, Default)]
struct Picture {
    alive: BTreeSet<(String, String)>,
    /// How often each was missed: a process that is back at once may never be seen to be away.
    missed: BTreeMap<(String, String), u32>,
    status: ControllerStatus,
    /// The truth: it has touched down.
    landed: bool,
}

impl Picture {
    /// All processes are present and at work, by a status from after a moment; or the landing is over.
    fn is_well(&self, since_ns: i64) -> bool {
        let there = VICTIMS.iter().all(|victim| self.alive.contains(&victim.alive()));
        let status = &self.status;
        if status.stamp_ns <= since_ns {
            return false;
        }
        let is_received = |name: &str| {
            let known = status.candidates.iter().find(|candidate| candidate.detector == name);
            known.is_some_and(|it| {
                it.alive && matches!(it.state, DetectorState::Active | DetectorState::Shadow)
            })
        };
        let steers = status.started_ns.is_some() && status.setpoint.is_some();
        let both = is_received("onboard") && is_received("ground");
        // A controller that is started after the touchdown has nothing to steer any more.
        there && (self.landed || status.finished || status.phase == Phase::Final || steers && both)
    }
}

/// A flight: the world, both sides under their supervisors, and the received messages.
struct Flight {
    folder: PathBuf,
    world: Child,
    up: [Child; 2],
    picture: watch::Receiver<Picture>,
    truth: watch::Receiver<Option<Truth>>,
    nodes: [Node; 2],
}

/// The site: the drone's camera follows what the world's autopilot reports, as next to a real autopilot.
fn site(seed: u64, [meet, air, autopilot]: [u16; 3]) -> String {
    let small = small_camera();
    format!(
        r#"
vehicle = "tried"
address = "127.0.0.1:{air}"
insecure = true
meet = {meet}

[[drone]]
run = "simulator"
name = "camera"
set = ["id=camera", "vehicle=reported", "seed={seed}", {small}]
[[drone]]
run = "detector"
set = ["id=onboard"]
[[drone]]
run = "controller"
# Slowly, for more time to kill in.
set = ["autopilot.address=udpin:127.0.0.1:{autopilot}", "start=takeoff", "detectors.preferred=ground", "metric.max_descend_m_s=0.5", "phases.landing_timeout_s=600"]

[[ground]]
run = "detector"
set = ["id=ground", "input=jpeg"]
[[ground]]
run = "gcs-bridge"
set = ["ground=udpout:127.0.0.1:9"]
"#
    )
}

impl Flight {
    async fn begin(folder: &Path, seed: u64) -> anyhow::Result<Self> {
        let ([meet, apart], air, autopilot) = ports::free()?;
        std::fs::write(folder.join("site.toml"), site(seed, [meet, air, autopilot]))?;
        let world = Command::new(ALIGHT)
            .args(["simulator", "--meet", &apart.to_string(), "--vehicle", "world"])
            .args(["--set", &format!("autopilot.address=udpout:127.0.0.1:{autopilot}")])
            .args(["--set", &format!("seed={seed}")])
            // The drone's camera follows the autopilot's estimate; the world's camera is not used.
            .args(["--set", "autopilot.errors=0", "--set", "camera.rate_hz=0.1"])
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(File::create(folder.join("world.log"))?)
            .spawn()?;
        let up = [up(folder, DRONE)?, up(folder, GROUND)?];
        let node = open(meet, "tried").await?;
        let (sender, picture) = watch::channel(Picture::default());
        watch_picture(&node, &sender).await?;
        let aside = open(apart, "world").await?;
        let truth = watch_truth(&aside, sender).await?;
        let folder = folder.to_owned();
        Ok(Self { folder, world, up, picture, truth, nodes: [node, aside] })
    }

    /// Waits until something is seen; the answer is when, in seconds after a moment.
    async fn until(
        &mut self,
        what: &str,
        since_ns: i64,
        holds: impl Fn(&Picture) -> bool,
    ) -> anyhow::Result<f64> {
        let seen = async { self.picture.wait_for(holds).await.is_ok() };
        if timeout(PATIENCE, seen).await.is_ok_and(|seen| seen) {
            return Ok((now_ns() - since_ns) as f64 * 1e-9);
        }
        let Picture { alive, status, .. } = self.picture.borrow().clone();
        Err(anyhow!("waiting until {what}; alive: {alive:?}; {status:?}"))
    }

    async fn command(&self, command: &ControllerCommand) -> anyhow::Result<()> {
        let [node, _] = &self.nodes;
        let reply = node.command(topic::COMMAND, &[], command).await?;
        ensure!(reply.accepted, "{reply:?}");
        Ok(())
    }

    fn is_over(&self) -> bool {
        let picture = self.picture.borrow();
        picture.landed || picture.status.finished
    }

    /// The process number of a service, by the last word of its supervisor about it.
    fn process(&self, side: usize, name: &str) -> anyhow::Result<Pid> {
        let log = std::fs::read_to_string(self.folder.join(LOGS[side]))?;
        let begin = format!("{name}: started as process ");
        let last = log.lines().filter_map(|line| line.strip_prefix(&begin)).next_back();
        let number = last.and_then(|rest| rest.split(',').next()).context(begin)?;
        Pid::from_raw(number.parse()?).context("a process number")
    }

    /// Kills, and waits until it was noticed, and until all is well again: both in seconds from the kill.
    async fn kill(&mut self, victim: Victim) -> anyhow::Result<(f64, f64)> {
        let alive = victim.alive();
        let missed = |picture: &Picture| picture.missed.get(&alive).copied().unwrap_or(0);
        let before = missed(&self.picture.borrow());
        let killed_ns = match victim {
            Victim::Process { side, name, .. } => {
                kill_process(self.process(side, name)?, Signal::KILL)?;
                now_ns()
            }
            Victim::Supervisor { side, .. } => {
                self.up[side].kill()?;
                let killed_ns = now_ns();
                self.up[side].wait()?;
                killed_ns
            }
        };
        let gone = |picture: &Picture| missed(picture) > before;
        let noticed_s = self.until("it is missed", killed_ns, gone).await?;
        if let Victim::Supervisor { side, .. } = victim {
            let waited = Duration::from_nanos((now_ns() - killed_ns).unsigned_abs());
            sleep(RESTART.saturating_sub(waited)).await;
            self.up[side] = up(&self.folder, side)?;
        }
        let well = |picture: &Picture| picture.is_well(killed_ns);
        let well_s = self.until("all is well again", killed_ns, well).await?;
        Ok((noticed_s, well_s))
    }

    /// The end: on the ground, stationary, on the pad.
    async fn lands(&mut self) -> anyhow::Result<Truth> {
        let landed = |truth: &Option<Truth>| {
            truth.as_ref().is_some_and(|truth| truth.touchdown.is_some() && truth.on_ground)
        };
        let seen = timeout(PATIENCE, self.truth.wait_for(landed)).await;
        let truth = seen.context("waiting for the touchdown")??.clone();
        let truth = truth.context("the truth")?;
        let touchdown = truth.touchdown.context("a touchdown")?;
        ensure!(touchdown.error_m < 0.1, "far from the pad: {touchdown:?}");
        ensure!(touchdown.vertical_speed_m_s.abs() <= 0.8, "unsafe: {touchdown:?}");
        ensure!(touchdown.lateral_speed_m_s <= 0.3, "unsafe: {touchdown:?}");
        ensure!(truth.max_tilt_rad < 0.6, "unsafe: tilted by {} rad", truth.max_tilt_rad);
        Ok(truth)
    }
}

impl Drop for Flight {
    fn drop(&mut self) {
        for child in &mut self.up {
            // In good order, so that nothing is left.
            let pid = i32::try_from(child.id()).ok().and_then(Pid::from_raw);
            let _ = pid.map(|pid| kill_process(pid, Signal::INT));
            drop(child.wait());
        }
        drop(self.world.kill());
        drop(self.world.wait());
    }
}

const SIDES: [&str; 2] = ["drone", "ground"];
const LOGS: [&str; 2] = ["drone.log", "ground.log"];

/// Starts the supervisor of a side as systemd does.
fn up(folder: &Path, side: usize) -> anyhow::Result<Child> {
    let log = OpenOptions::new().create(true).append(true).open(folder.join(LOGS[side]))?;
    let child = Command::new(ALIGHT)
        .args(["up", SIDES[side], "--config"])
        .arg(folder.join("site.toml"))
        .env("RUNTIME_DIRECTORY", folder)
        .stdin(Stdio::null())
        .stdout(log.try_clone()?)
        .stderr(log)
        .spawn();
    child.context("starting `alight up`")
}

async fn open(meet: u16, vehicle: &str) -> anyhow::Result<Node> {
    let vehicle = Some(vehicle.to_owned());
    let network = Network { meet: Some(meet), vehicle, ..Network::default() };
    let identity = Identity { service: "alight", instance: "test".into() };
    Node::open(identity, &network.source("operator")?).await
}

async fn watch_picture(node: &Node, picture: &watch::Sender<Picture>) -> anyhow::Result<()> {
    for service in ["relay", "simulator", "detector", "controller", "gcs-bridge"] {
        let (presence, picture) = (node.presence(service).await?, picture.clone());
        tokio::spawn(async move {
            while let Some((instance, alive)) = presence.next().await {
                let process = (service.to_owned(), instance);
                picture.send_modify(|picture| {
                    match alive {
                        true => picture.alive.insert(process),
                        false => {
                            *picture.missed.entry(process.clone()).or_default() += 1;
                            picture.alive.remove(&process)
                        }
                    };
                });
            }
        });
    }
    let (statuses, picture) = (node.subscriber(topic::STATUS, &[]).await?, picture.clone());
    tokio::spawn(async move {
        while let Some(status) = statuses.next().await {
            picture.send_modify(|picture| picture.status = status);
        }
    });
    Ok(())
}

async fn watch_truth(
    node: &Node,
    picture: watch::Sender<Picture>,
) -> anyhow::Result<watch::Receiver<Option<Truth>>> {
    let (sender, truth) = watch::channel(None);
    let truths = node.subscriber(topic::TRUTH, &[]).await?;
    tokio::spawn(async move {
        while let Some(truth) = truths.next().await {
            let landed = truth.touchdown.is_some() && truth.on_ground;
            picture.send_if_modified(|picture| {
                std::mem::replace(&mut picture.landed, landed) != landed
            });
            sender.send_replace(Some(truth));
        }
    });
    Ok(truth)
}

/// Kills the controller of a landing that an operator holds: the next one must not descend.
pub(crate) async fn kill_while_held() -> anyhow::Result<()> {
    let _flight = time_for(2).await?;
    let folder = tempfile::tempdir()?;
    let mut flight = Flight::begin(folder.path(), 1).await?;
    let descends = |picture: &Picture| picture.status.phase == Phase::Descend;
    flight.until("it descends", now_ns(), descends).await?;
    flight.command(&ControllerCommand::Hold).await?;
    let is_held = |picture: &Picture| picture.status.waits_for_operator;
    flight.until("it is held", now_ns(), is_held).await?;
    // The supervisor receives the state this late.
    sleep(Duration::from_millis(300)).await;
    kill_process(flight.process(DRONE, "controller")?, Signal::KILL)?;
    let killed_ns = now_ns();
    let is_back = |picture: &Picture| picture.status.stamp_ns > killed_ns + 2_000_000_000;
    flight.until("another controller is there", killed_ns, is_back).await?;
    let height_m = |flight: &Flight| {
        flight.truth.borrow().as_ref().map(|truth| -truth.position_ned_m[2]).context("the truth")
    };
    let before_m = height_m(&flight)?;
    sleep(Duration::from_secs(4)).await;
    let (status, sunk_m) = (flight.picture.borrow().status.clone(), before_m - height_m(&flight)?);
    let log = std::fs::read_to_string(folder.path().join(LOGS[DRONE]))?;
    ensure!(status.started_ns.is_none() && sunk_m < 0.3, "{sunk_m} m lower: {status:?}\n{log}");
    ensure!(log.contains("start = \"command\""), "{log}");
    // The operator continues.
    flight.command(&ControllerCommand::Start).await?;
    flight.lands().await.map(drop)
}

/// Numbers that are the same in each run.
struct Dice(u64);

impl Dice {
    fn roll(&mut self, below: u64) -> u64 {
        // Knuth's generator (MMIX); its upper bits are the better ones.
        self.0 =
            self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) % below
    }
}

/// The times from a kill until it was noticed and until all was well again, in seconds.
type Times = Vec<(Victim, f64, f64)>;

/// Flies until as many as possible of these were killed, from the last one on; the killed ones are taken out.
async fn fly(
    seed: u64,
    dice: &mut Dice,
    victims: &mut Vec<Victim>,
    times: &mut Times,
) -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let mut flight = Flight::begin(folder.path(), seed).await?;
    let flown = async {
        let began = |picture: &Picture| {
            let there = VICTIMS.iter().all(|victim| picture.alive.contains(&victim.alive()));
            there && picture.status.phase == Phase::Descend || picture.landed
        };
        flight.until("all processes are there and it descends", now_ns(), began).await?;
        while let Some(victim) = victims.last().copied() {
            sleep(Duration::from_millis(dice.roll(1500))).await;
            if flight.is_over() {
                break;
            }
            victims.pop();
            let killed = flight.kill(victim).await;
            let (noticed_s, well_s) = killed.with_context(|| victim.in_words())?;
            times.push((victim, noticed_s, well_s));
        }
        flight.lands().await
    };
    match flown.await {
        Ok(truth) => {
            println!("flight {seed}: {:?}", truth.touchdown);
            Ok(())
        }
        Err(problem) => {
            for log in LOGS {
                println!("{log}:\n{}", std::fs::read_to_string(folder.path().join(log))?);
            }
            Err(problem.context(format!("flight {seed}")))
        }
    }
}

fn print_times(times: &Times) {
    println!(
        "{:20} {:>5} {:>22} {:>22}",
        "killed", "times", "noticed, median / max", "well, median / max"
    );
    for victim in VICTIMS {
        let column = |pick: fn(&(Victim, f64, f64)) -> f64| {
            let mut column: Vec<f64> = times.iter().filter(|it| it.0 == victim).map(pick).collect();
            column.sort_by(f64::total_cmp);
            let median = column.get(column.len() / 2).copied().unwrap_or_default();
            let last = column.last().copied().unwrap_or_default();
            (column.len(), format!("{median:.2} / {last:.2} s"))
        };
        let ((number, noticed), (_, well)) = (column(|it| it.1), column(|it| it.2));
        println!("{:20} {number:>5} {noticed:>22} {well:>22}", victim.in_words());
    }
}

/// Kills each victim so often, in as many flights as that takes.
pub(crate) async fn kill_each(often: usize) -> anyhow::Result<()> {
    let _flight = time_for(2).await?;
    let mut dice = Dice(1);
    let mut victims: Vec<Victim> = (0..often).flat_map(|_| VICTIMS).collect();
    for last in (1..victims.len()).rev() {
        let other = dice.roll(last as u64 + 1) as usize;
        victims.swap(last, other);
    }
    let mut times = Times::new();
    let flights_at_most = 4 * often as u64 + 6;
    for seed in 1..=flights_at_most {
        let flown = fly(seed, &mut dice, &mut victims, &mut times).await;
        print_times(&times);
        flown?;
        if victims.is_empty() {
            return Ok(());
        }
    }
    bail!("after {flights_at_most} flights there is still to be killed: {victims:?}")
}
