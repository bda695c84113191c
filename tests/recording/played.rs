//! Publishes a recording again, to services that run.

use std::net::UdpSocket;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use anyhow::{Context, ensure};
use messages::{ControllerStatus, Detections, Phase, topic};
use node::{Identity, Node, Subscriber, ZenohSource, clock_name, now_ns};
use tokio::time::{Instant, timeout};

use crate::flight::{ALIGHT, Landing, PATIENCE, output_of};

/// MAVLink's number of ATTITUDE, which only an autopilot sends.
const ATTITUDE: [u8; 3] = [30, 0, 0];
/// Oldest that a status may seem, in seconds.
const MAX_AGE_S: f64 = 2.0;

/// A process, until this is dropped.
struct Running(Child);

impl Running {
    fn start(meet: u16, args: &[&str]) -> anyhow::Result<Self> {
        let mut command = Command::new(ALIGHT);
        command.args(args).args(["--meet", &meet.to_string()]);
        Ok(Self(command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn()?))
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A landing is recorded, and published again to a detector, a ground station and other subscribers.
pub(crate) async fn to_services() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let file = folder.path().join("flight.mcap");
    let name = file.to_str().context("a path")?;
    Landing::start(&["--seed", "11", "--record", name]).await?.lands().await?;

    let ([meet], _, udp) = testing::ports::free()?;
    let ground = UdpSocket::bind(("127.0.0.1", udp))?;
    ground.set_nonblocking(true)?;
    let config = ZenohSource::Text(node::session::local_config(meet));
    let node = Node::open(Identity { service: "alight", instance: "test".into() }, &config).await?;
    let statuses = node.subscriber(topic::STATUS, &[]).await?;
    let found = node.subscriber(topic::DETECTIONS, &["live"]).await?;
    let _detector = Running::start(meet, &["detector", "--set", "id=live"])?;
    let station = format!("ground=\"udpout:127.0.0.1:{udp}\"");
    let _bridge = Running::start(meet, &["gcs-bridge", "--set", &station])?;
    until(&node, "detector", 1).await?;
    until(&node, "gcs-bridge", 1).await?;

    let mut replay = Running::start(meet, &["replay", name, "--live"])?;
    until(&node, "controller", 1).await?;
    let (phases, frames, with_marker) = follow(&statuses, &found).await?;
    for phase in [Phase::Approach, Phase::Descend, Phase::Landed] {
        ensure!(phases.contains(&phase), "no {phase} in {phases:?}");
    }
    ensure!(frames > 50 && with_marker * 2 > frames, "{with_marker} of {frames}");
    ensure!(has_attitude(&ground), "no attitude of the autopilot at the ground station");
    let output = tokio::task::block_in_place(|| -> anyhow::Result<String> {
        let mut text = String::new();
        let stdout = replay.0.stdout.as_mut().context("standard output")?;
        std::io::Read::read_to_string(stdout, &mut text)?;
        ensure!(replay.0.wait()?.success(), "{text}");
        Ok(text)
    })?;
    ensure!(output.contains("published"), "{output}");
    // With it go the services that it showed.
    until(&node, "controller", 0).await?;
    refuses_to_double_a_controller(&node, &file, meet).await
}

/// The phases up to the landing, the frames that the detector searched meanwhile, and those with a marker. Every status is of
/// now, and every frame of this clock.
async fn follow(
    statuses: &Subscriber<ControllerStatus>,
    found: &Subscriber<Detections>,
) -> anyhow::Result<(Vec<Phase>, usize, usize)> {
    let (mut phases, mut frames, mut with_marker) = (Vec::new(), 0, 0);
    let began = Instant::now();
    while phases.last() != Some(&Phase::Landed) {
        ensure!(began.elapsed() < PATIENCE, "{phases:?}");
        let next = timeout(PATIENCE, statuses.next()).await;
        let status = next.ok().flatten().with_context(|| format!("no status after {phases:?}"))?;
        let age_s = (now_ns() - status.stamp_ns) as f64 * 1e-9;
        ensure!(age_s.abs() < MAX_AGE_S, "a status of {age_s} s ago");
        if phases.last() != Some(&status.phase) {
            phases.push(status.phase);
        }
        while let Some(message) = found.waiting() {
            ensure!(message.header.clock == clock_name(), "{:?}", message.header);
            frames += 1;
            with_marker += usize::from(!message.detections.is_empty());
        }
    }
    Ok((phases, frames, with_marker))
}

fn has_attitude(ground: &UdpSocket) -> bool {
    let mut packet = [0; 300];
    std::iter::from_fn(|| ground.recv(&mut packet).ok().map(|_| packet))
        .any(|packet| packet[0] == 0xfd && packet[7..10] == ATTITUDE)
}

async fn refuses_to_double_a_controller(node: &Node, file: &Path, meet: u16) -> anyhow::Result<()> {
    let ([port], _, _) = testing::ports::free()?;
    let link = format!("autopilot.address=\"udpin:127.0.0.1:{port}\"");
    let _controller = Running::start(meet, &["controller", "--set", &link])?;
    until(node, "controller", 1).await?;
    let mut command = Command::new(ALIGHT);
    command.arg("replay").arg(file).args(["--live", "--meet", &meet.to_string()]);
    let output = tokio::task::block_in_place(|| output_of(&mut command))?;
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    ensure!(!output.status.success() && said.contains("controller `main` run here"), "{said}");
    Ok(())
}

/// Waits until so many of a service are ready.
async fn until(node: &Node, service: &str, count: usize) -> anyhow::Result<()> {
    let are_ready = async || node.alive(service, "*").await.is_ok_and(|ready| ready.len() == count);
    testing::until(&format!("{count} of {service} are ready"), PATIENCE / 4, are_ready).await
}
