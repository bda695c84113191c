//! Freezes processes for a while (SIGSTOP) and continues them, without any replacement: no second detector, no
//! supervisor.

use std::net::UdpSocket;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use messages::{ControllerCommand, Phase, Wind, topic};
use node::{Identity, Network, Node, now_ns};
use rustix::process::{Pid, Signal, kill_process};
use testing::ports;
use tokio::time::{sleep, timeout};

use crate::flight::{ALIGHT, Landing, beside_another};

/// Longest time until a process that continues works again.
const BACK: Duration = Duration::from_secs(2);
/// Time within which a command that waited would be carried out.
const LATE: Duration = Duration::from_secs(3);

/// Freezes a process, and continues it.
async fn freeze(pid: Pid, seconds: f64) -> anyhow::Result<Instant> {
    kill_process(pid, Signal::STOP)?;
    sleep(Duration::from_secs_f64(seconds)).await;
    kill_process(pid, Signal::CONT)?;
    Ok(Instant::now())
}

/// Waits until the controller uses frames that were taken after this time.
async fn frames_are_used(landing: &Landing, since_ns: i64) -> anyhow::Result<()> {
    let condition = "new frames are used";
    let is_used = |s: &messages::ControllerStatus| {
        s.stamp_ns > since_ns
            && s.detection_age_ms.is_some_and(|ms| s.stamp_ns - (ms * 1e6) as i64 > since_ns)
    };
    landing.status(condition, is_used).await.map(drop)
}

/// Freezes a process of a landing for each of these times, and lands.
pub(crate) async fn of_a_landing(name: &str, freezes_s: &[f64]) -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    let ([], _, port) = ports::free()?;
    let station = UdpSocket::bind(("127.0.0.1", port))?;
    station.set_read_timeout(Some(Duration::from_secs(20)))?;
    let address = format!("gcs-bridge.ground=udpout:127.0.0.1:{port}");
    let long = "controller.phases.landing_timeout_s=600";
    let args = ["--seed", "3", "--timeout-s", "300", "--set", &address, "--set", long];
    let landing = Landing::start(&args).await?;
    landing.descends_below(9.0).await?;
    for seconds in freezes_s {
        hold(&landing).await?;
        let pid = landing.service(name)?.pid;
        let since = freeze(pid, *seconds).await?;
        let since_ns = now_ns();
        if name == "gcs-bridge" {
            tokio::task::block_in_place(|| receives_from_the_vehicle(&station, since))?;
        } else {
            frames_are_used(&landing, since_ns).await?;
        }
        is_back(name, *seconds, since)?;
        command(&landing, ControllerCommand::Resume).await?;
        landing.status("it continues", |s| s.phase != Phase::Hold).await?;
    }
    landing.lands().await.map(drop)
}

fn is_back(name: &str, seconds: f64, since: Instant) -> anyhow::Result<()> {
    let took = since.elapsed();
    println!("{name} frozen for {seconds} s: back after {took:?}");
    ensure!(took < BACK, "{name}, frozen for {seconds} s, was back after {took:?}");
    Ok(())
}

/// Starts a camera's process that publishes an image in this folder again and again.
fn publish_image(folder: &Path, meet: u16) -> anyhow::Result<Running> {
    image::GrayImage::new(64, 48).save(folder.join("1.png"))?;
    let (paths, meet) = (format!("source.paths=[{folder:?}]"), meet.to_string());
    let set = ["--set", &paths, "--set", "calibration.focal_px=[100, 100]"];
    Running::start(&[&["camera-pub", "--meet", &meet], &set[..]].concat())
}

/// Freezes a camera's process that publishes images.
pub(crate) async fn of_a_camera(freezes_s: &[f64]) -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    let folder = tempfile::tempdir()?;
    let ([meet], _, _) = ports::free()?;
    let camera = publish_image(folder.path(), meet)?;
    let detector = open("detector", "main", on_board(meet)).await?;
    let frames = detector.frame_subscriber(topic::FRAME, &["down"]).await?;
    let is_received = async |since_ns: i64| {
        let fresh = async {
            while frames.next().await.context("frames end")?.header.stamp_ns < since_ns {}
            anyhow::Ok(())
        };
        timeout(Duration::from_secs(20), fresh).await.context("no frame is received")?
    };
    for seconds in freezes_s {
        is_received(now_ns()).await?;
        let since = freeze(camera.pid()?, *seconds).await?;
        is_received(now_ns()).await?;
        is_back("camera-pub", *seconds, since)?;
    }
    Ok(())
}

/// Starts programs one by one while a camera that is known already is frozen, as if the machine had no time for it. Of two processes that
/// learn of each other at the rendezvous the one with the greater id connects, and ids are random: this many show both cases.
pub(crate) async fn of_a_camera_while_another_starts(seconds: f64) -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    let folder = tempfile::tempdir()?;
    let ([meet], _, _) = ports::free()?;
    // The first process has the rendezvous, and announces the camera to those that follow.
    let first = open("detector", "first", on_board(meet)).await?;
    let camera = publish_image(folder.path(), meet)?;
    let patience = Duration::from_secs(20);
    let frames = first.frame_subscriber(topic::FRAME, &["down"]).await?;
    timeout(patience, frames.next()).await.context("the first gets no frame")?;
    for number in 1..=6 {
        kill_process(camera.pid()?, Signal::STOP)?;
        let node = open("detector", &format!("later{number}"), on_board(meet)).await?;
        let frames = node.frame_subscriber(topic::FRAME, &["down"]).await?;
        sleep(Duration::from_secs_f64(seconds)).await;
        kill_process(camera.pid()?, Signal::CONT)?;
        let frame = timeout(patience, frames.next()).await;
        frame.with_context(|| format!("detector {number}, started meanwhile, gets no frame"))?;
        node.close().await;
    }
    first.close().await;
    Ok(())
}

/// Commands a controller that is frozen until its operator has given up, continues it, and lands.
pub(crate) async fn of_a_commanded_controller() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    let landing = Landing::start(&["--seed", "4", "--timeout-s", "300"]).await?;
    landing.descends_below(9.0).await?;
    hold(&landing).await?;
    let pid = landing.service("controller")?.pid;
    kill_process(pid, Signal::STOP)?;
    let given_up = landing.node.command(topic::COMMAND, &[], &ControllerCommand::Abort).await;
    kill_process(pid, Signal::CONT)?;
    ensure!(given_up.is_err(), "a frozen controller answered: {given_up:?}");
    let since_ns = now_ns();
    let later_ns = since_ns + LATE.as_nanos() as i64;
    let is_later = |s: &messages::ControllerStatus| s.stamp_ns > later_ns;
    let status = landing.status("it continues", is_later).await?;
    ensure!(status.phase == Phase::Hold, "the command was carried out late: {status:?}");
    command(&landing, ControllerCommand::Resume).await?;
    landing.lands().await.map(drop)
}

async fn hold(landing: &Landing) -> anyhow::Result<()> {
    command(landing, ControllerCommand::Hold).await?;
    landing.status("it holds", |s| s.phase == Phase::Hold).await.map(drop)
}

async fn command(landing: &Landing, command: ControllerCommand) -> anyhow::Result<()> {
    let reply = landing.node.command(topic::COMMAND, &[], &command).await?;
    ensure!(reply.accepted, "{command:?}: {reply:?}");
    Ok(())
}

/// Waits for the autopilot's packets at the ground station: many, as a few may have waited.
fn receives_from_the_vehicle(station: &UdpSocket, since: Instant) -> anyhow::Result<()> {
    station.set_nonblocking(true)?;
    let mut bytes = [0; 2048];
    while station.recv(&mut bytes).is_ok() {}
    station.set_nonblocking(false)?;
    for _ in 0..20 {
        station.recv(&mut bytes).with_context(|| format!("nothing since {:?}", since.elapsed()))?;
    }
    Ok(())
}

/// A process that is ended with its owner.
struct Running(Child);

impl Running {
    fn start(args: &[&str]) -> anyhow::Result<Self> {
        let mut command = Command::new(ALIGHT);
        command.args(args).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        Ok(Self(command.spawn()?))
    }

    fn pid(&self) -> anyhow::Result<Pid> {
        Pid::from_raw(i32::try_from(self.0.id())?).context("a process id")
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Waits until a message of one process reaches the other.
async fn reaches(from: &Node, by: &Node) -> anyhow::Result<()> {
    let publisher = from.publisher(topic::WIND, &[]).await?;
    let subscriber = by.subscriber(topic::WIND, &[]).await?;
    let wind = Wind { velocity_ned_m_s: [1.0, 2.0, 3.0], stamp_ns: now_ns() };
    let received = async {
        loop {
            publisher.publish(&wind).await;
            let next = timeout(Duration::from_millis(20), subscriber.next()).await;
            if next.is_ok_and(|next| next == Some(wind)) {
                return;
            }
        }
    };
    timeout(Duration::from_secs(20), received).await.context("nothing is received")
}

async fn open(service: &'static str, name: &str, network: Network) -> anyhow::Result<Node> {
    let identity = Identity { service, instance: name.into() };
    Node::open(identity, &network.source(service)?).await
}

/// The network of a process on board whose peers meet at this port.
fn on_board(meet: u16) -> Network {
    Network { config: Some("local".into()), meet: Some(meet), ..Network::default() }
}

/// Freezes a relay between two processes on board and one on the ground.
pub(crate) async fn of_a_relay(freezes_s: &[f64]) -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    let ([meet], air, _) = ports::free()?;
    let (meet_text, air) = (meet.to_string(), format!("127.0.0.1:{air}"));
    let first = open("simulator", "main", on_board(meet)).await?;
    let second = open("controller", "main", on_board(meet)).await?;
    let relay =
        Running::start(&["relay", "--zenoh", "drone", "--listen", &air, "--meet", &meet_text])?;
    let network =
        Network { config: Some("ground".into()), connect: Some(air), ..Network::default() };
    let ground = open("detector", "ground", network).await?;
    for seconds in freezes_s {
        for node in [&first, &second] {
            reaches(node, &ground).await?;
            reaches(&ground, node).await?;
        }
        let since = freeze(relay.pid()?, *seconds).await?;
        for node in [&first, &second] {
            reaches(node, &ground).await?;
            reaches(&ground, node).await?;
        }
        is_back("relay", *seconds, since)?;
    }
    Ok(())
}
