//! Tests keys in the complete system: processes without or with foreign keys at a relay, the rights of each role, holders
//! that are revoked, relays without keys, and the log of an insecure start.

use std::io::{BufRead, BufReader};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, bail, ensure};
use messages::{CommandReply, ControllerCommand, DetectorCommand, FrameAck, Health, Place, topic};
use node::{Identity, Network, Node, Subscriber};
use testing::{ports, python, python_passes};
use tokio::sync::mpsc;
use tokio::time::timeout;

use crate::flight::{beside_another, time_for};

const PATIENCE: Duration = Duration::from_secs(30);
const ALIGHT: &str = env!("CARGO_BIN_EXE_alight-under-test");

fn output_of(arguments: &[&str]) -> anyhow::Result<Output> {
    Ok(Command::new(ALIGHT).args(arguments).stdin(Stdio::null()).output()?)
}

/// Runs `alight keys`.
fn keys(arguments: &[&str]) -> anyhow::Result<()> {
    let output = output_of(&[&["keys"], arguments].concat())?;
    ensure!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(())
}

/// A drone with a relay that requires keys, and a controller that accepts every command.
struct Drone {
    relay: Child,
    said: mpsc::UnboundedReceiver<String>,
    controller: Node,
    air: String,
    folder: tempfile::TempDir,
}

impl Drone {
    async fn start() -> anyhow::Result<Self> {
        let folder = tempfile::tempdir()?;
        let home = text(folder.path())?;
        keys(&["init", "-o", home])?;
        keys(&["issue", "--role", "drone", "--address", "127.0.0.1", "-o", home])?;
        for role in ["operator", "observer"] {
            keys(&["issue", "--role", role, "-o", home])?;
        }
        keys(&["issue", "--role", "detector", "--name", "ground", "-o", home])?;
        let ([meet], air, _) = ports::free()?;
        let air = format!("127.0.0.1:{air}");
        let mut relay = Command::new(ALIGHT)
            .args(["relay", "--zenoh", "drone", "--listen", &air, "--keys", home])
            .args(["--meet", &meet.to_string()])
            .stdin(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()?;
        let lines = BufReader::new(relay.stderr.take().context("standard error")?).lines();
        let (sender, said) = mpsc::unbounded_channel();
        std::thread::Builder::new()
            .name("said".into())
            .spawn(move || lines.map_while(Result::ok).all(|line| sender.send(line).is_ok()))?;
        let local = Network { meet: Some(meet), ..Network::default() };
        let identity = Identity { service: "controller", instance: "main".into() };
        let controller = Node::open(identity, &local.source("controller")?).await?;
        controller.announce().await?;
        let drone = Self { relay, said, controller, air, folder };
        // The relay is ready when its health is received.
        let healths = drone.controller.subscriber(topic::HEALTH, &["relay", "drone"]).await?;
        health(&healths, "the relay is ready", |_| true).await?;
        Ok(drone)
    }

    fn network(&self, keys: Option<PathBuf>) -> Network {
        let connect = Some(self.air.clone());
        Network { config: Some("ground".into()), connect, keys, ..Network::default() }
    }

    async fn on_the_ground(&self, service: &'static str, key: &str) -> anyhow::Result<Node> {
        let network = self.network(Some(self.folder.path().to_owned()));
        let identity = Identity { service, instance: "ground".into() };
        Node::open(identity, &network.source(key)?).await
    }

    /// `alight command hold` from the ground, with the keys of a directory.
    fn command(&self, keys: Option<&Path>) -> anyhow::Result<Output> {
        let mut arguments = vec!["command", "hold", "--zenoh", "ground", "--connect", &self.air];
        if let Some(keys) = keys {
            arguments.extend(["--keys", text(keys)?]);
        }
        output_of(&arguments)
    }
}

impl Drop for Drone {
    fn drop(&mut self) {
        let _ = self.relay.kill();
        let _ = self.relay.wait();
        while let Ok(line) = self.said.try_recv() {
            println!("{line}");
        }
    }
}

fn text(path: &Path) -> anyhow::Result<&str> {
    path.to_str().context("a printable path")
}

async fn health(
    healths: &Subscriber<Health>,
    what: &str,
    holds: impl Fn(&Health) -> bool,
) -> anyhow::Result<Health> {
    let found = async {
        while let Some(health) = healths.next().await {
            if holds(&health) {
                return Ok(health);
            }
        }
        bail!("the session is closed")
    };
    timeout(PATIENCE, found).await.map_err(|_| anyhow!("waiting until {what}"))?
}

/// Publishes acknowledgements until one is received.
async fn is_received(detector: &Node, controller: &Node) -> anyhow::Result<()> {
    let subscriber = controller.subscriber(topic::FRAME_ACK, &["ground"]).await?;
    let publisher = detector.publisher(topic::FRAME_ACK, &["ground"]).await?;
    let ack = FrameAck::sample();
    let received = async {
        loop {
            publisher.publish(&ack).await;
            if timeout(Duration::from_millis(50), subscriber.next()).await.is_ok() {
                return;
            }
        }
    };
    timeout(PATIENCE, received).await.context("no message of the detector is received")
}

#[tokio::test(flavor = "multi_thread")]
async fn each_role_publishes_its_topics_and_unknown_clients_nothing() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    let mut drone = Drone::start().await?;
    let commands = drone.controller.commands(topic::COMMAND, &[]).await?;
    let (sender, mut commanded) = mpsc::unbounded_channel();
    let answering = tokio::spawn(async move {
        while let Some(request) = commands.next().await {
            let _ = sender.send(request.message.clone());
            request.answer(&CommandReply { accepted: true, reason: "held".into() }).await;
        }
    });
    let healths = drone.controller.subscriber(topic::HEALTH, &["relay", "drone"]).await?;
    let refused = |health: &Health, part: &str| {
        health.errors.iter().any(|e| e.reason.contains(part) && e.count > 0)
    };

    // A detector may publish as a detector, and as nothing else.
    let detector = drone.on_the_ground("detector", "detector.ground").await?;
    detector.announce().await?;
    is_received(&detector, &drone.controller).await?;
    ensure!(drone.controller.alive("detector", "*").await? == ["ground"]);
    let command = detector.command(topic::COMMAND, &[], &ControllerCommand::Abort).await;
    ensure!(command.is_err(), "a detector commanded: {command:?}");
    health(&healths, "the command's refusal is counted", |h| {
        refused(h, "query on drone/controller/command")
    })
    .await?;
    let line = async {
        while let Some(line) = drone.said.recv().await {
            if line.contains("Access denied") && line.contains("controller/command") {
                return;
            }
        }
    };
    timeout(PATIENCE, line).await.context("the refusal is not logged")?;
    let counted = health(&healths, "its next health", |_| true).await?;
    ensure!(!refused(&counted, "detector/ground"), "an allowed message was refused: {counted:?}");

    // A client without a key, or with one of another authority, is refused.
    let output = drone.command(None)?;
    ensure!(!output.status.success(), "without a key: {output:?}");
    let foreign = tempfile::tempdir()?;
    keys(&["init", "-o", text(foreign.path())?])?;
    keys(&["issue", "--role", "operator", "-o", text(foreign.path())?])?;
    let output = drone.command(Some(foreign.path()))?;
    ensure!(!output.status.success(), "with a foreign key: {output:?}");
    health(&healths, "the connections' refusal is counted", |h| refused(h, "connection")).await?;
    ensure!(commanded.try_recv().is_err(), "a command came through");

    // The operator commands, the detector's messages arrive as before.
    let output = drone.command(Some(drone.folder.path()))?;
    ensure!(output.status.success(), "{output:?}");
    ensure!(commanded.recv().await == Some(ControllerCommand::Hold));
    is_received(&detector, &drone.controller).await?;
    answering.abort();
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_program_in_another_language_joins_by_the_session_that_is_printed() -> anyhow::Result<()>
{
    let _flight = beside_another().await?;
    let script = "detector/examples/python/detector.py";
    let Some(probe) = python(script, &["--help"]) else { return Ok(()) };
    if !python_passes(&probe.wait_with_output()?)? {
        return Ok(());
    }
    let drone = Drone::start().await?;
    let home = text(drone.folder.path())?;
    let network = ["--zenoh", "ground", "--connect", &drone.air, "--keys", home];
    let session = |role| output_of(&[&["config", "--session", role], &network[..]].concat());
    let lacking = session("detector.python")?;
    let said = String::from_utf8_lossy(&lacking.stderr).into_owned();
    ensure!(said.contains("issue --role detector --name python"), "{said}");
    let unnamed = session("detector")?;
    let said = String::from_utf8_lossy(&unnamed.stderr).into_owned();
    ensure!(unnamed.status.code() == Some(2) && said.contains("`detector.NAME`"), "{said}");

    keys(&["issue", "--role", "detector", "--name", "python", "-o", home])?;
    let printed = session("detector.python")?;
    ensure!(printed.status.success(), "{printed:?}");
    let file = drone.folder.path().join("session.json");
    std::fs::write(&file, printed.stdout)?;
    // The relay reads the list of holders that may connect again within seconds.
    let infos = drone.controller.subscriber(topic::DETECTOR_INFO, &["python"]).await?;
    let marker = ["--id", "python", "--place", "ground", "--marker", "aruco-4x4-50:7:0.3"];
    let python = python(script, &[&marker[..], &["--zenoh", text(&file)?]].concat());
    let mut python = python.context("it started a moment ago")?;
    let joined = async {
        let info = timeout(PATIENCE, infos.next()).await.context("its message is not received")?;
        ensure!(info.is_some_and(|info| info.place == Place::Ground), "the ground's detector");
        let stop = DetectorCommand::Stop;
        let stopped = drone.controller.command(topic::DETECTOR_COMMAND, &["python"], &stop);
        ensure!(stopped.await?.accepted, "it may not be commanded");
        anyhow::Ok(())
    };
    let joined = joined.await;
    let _ = python.kill();
    python.wait()?;
    joined
}

#[tokio::test(flavor = "multi_thread")]
async fn a_running_relay_rejects_a_revoked_holder_and_continues() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    let drone = Drone::start().await?;
    let commands = drone.controller.commands(topic::COMMAND, &[]).await?;
    let answering = tokio::spawn(async move {
        while let Some(request) = commands.next().await {
            request.answer(&CommandReply { accepted: true, reason: "held".into() }).await;
        }
    });
    let detector = drone.on_the_ground("detector", "detector.ground").await?;
    detector.announce().await?;
    is_received(&detector, &drone.controller).await?;
    let subscriber = drone.controller.subscriber(topic::FRAME_ACK, &["ground"]).await?;
    let publisher = detector.publisher(topic::FRAME_ACK, &["ground"]).await?;
    keys(&["revoke", "detector.ground@drone", "--authority", text(drone.folder.path())?])?;
    let revoked = Instant::now();
    let mut last_received = revoked;
    while revoked.elapsed() < Duration::from_secs(8) {
        publisher.publish(&FrameAck::sample()).await;
        if timeout(Duration::from_millis(50), subscriber.next()).await.is_ok() {
            last_received = Instant::now();
        }
    }
    let took = last_received - revoked;
    println!("received for {took:?} after it was revoked");
    ensure!(took < Duration::from_secs(3), "received for {took:?} after it was revoked");
    // The relay still serves the others.
    let output = drone.command(Some(drone.folder.path()))?;
    ensure!(output.status.success(), "{output:?}");
    answering.abort();
    Ok(())
}

/// Runs `alight relay` until it ends on its own.
fn relay(arguments: &[&str]) -> anyhow::Result<String> {
    let output = output_of(&[&["relay", "--zenoh", "drone"], arguments].concat())?;
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    ensure!(!output.status.success(), "it has started: {said}");
    Ok(said)
}

#[test]
fn a_relay_without_keys_does_not_start_unless_configured_and_keys_are_private() -> anyhow::Result<()>
{
    let ([meet], air, _) = ports::free()?;
    let (meet, air) = (meet.to_string(), format!("0.0.0.0:{air}"));
    let said = relay(&["--listen", &air, "--meet", &meet])?;
    ensure!(said.contains("without keys") && said.contains("--insecure"), "{said}");

    let folder = tempfile::tempdir()?;
    let home = text(folder.path())?;
    keys(&["init", "-o", home])?;
    keys(&["issue", "--role", "drone", "--address", "127.0.0.1", "-o", home])?;
    let key = folder.path().join("drone.key");
    std::fs::set_permissions(&key, std::fs::Permissions::from_mode(0o644))?;
    let said = relay(&["--listen", &air, "--meet", &meet, "--keys", home])?;
    ensure!(said.contains("chmod 600"), "{said}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn insecure_processes_report_it() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    let ([meet], air, _) = ports::free()?;
    let (port, air) = (meet.to_string(), format!("0.0.0.0:{air}"));
    let mut relay = Command::new(ALIGHT)
        .args(["relay", "--zenoh", "drone", "--listen", &air, "--meet", &port, "--insecure"])
        .stdin(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()?;
    let local = Network { meet: Some(meet), ..Network::default() };
    let identity = Identity { service: "controller", instance: "main".into() };
    let inside = Node::open(identity, &local.source("controller")?).await?;
    let healths = inside.subscriber(topic::HEALTH, &["relay", "drone"]).await?;
    let reported = health(&healths, "its health reports it", |h| {
        h.errors.iter().any(|error| error.reason == node::INSECURE)
    })
    .await;
    let output = output_of(&["doctor", "--meet", &port, "--seconds", "2"]);
    relay.kill()?;
    let said = relay.wait_with_output()?;
    reported?;
    let said = String::from_utf8_lossy(&said.stderr).into_owned();
    ensure!(said.contains("INSECURE"), "{said}");
    let output = output?;
    let found = String::from_utf8_lossy(&output.stdout).into_owned();
    ensure!(found.contains("anyone in reach can command the vehicle"), "{found}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_vehicle_that_may_be_real_is_left_on_the_ground() -> anyhow::Result<()> {
    let _flight = time_for(2).await?;
    let ([meet], _, mavlink) = ports::free()?;
    let vehicle = format!("autopilot.address=udpout:127.0.0.1:{mavlink}");
    let mut simulator = Command::new(ALIGHT)
        .args(["simulator", "--meet", &meet.to_string(), "--set", &vehicle])
        // As a real one.
        .args(["--set", "autopilot.says_simulated=false"])
        .stdin(Stdio::null())
        .stderr(Stdio::null())
        .spawn()?;
    let local = Network { meet: Some(meet), ..Network::default() };
    let identity = Identity { service: "alight", instance: "test".into() };
    let watching = Node::open(identity, &local.source("observer")?).await?;
    let truths = watching.subscriber(topic::TRUTH, &[]).await?;
    let address = format!("udpin:127.0.0.1:{mavlink}");
    let land = [
        "land",
        "--autopilot",
        &address,
        "--timeout-s",
        "60",
        "--set",
        "gcs-bridge.ground=udpout:127.0.0.1:9",
    ];
    let asked = output_of(&[&land[..], &["--real-vehicle"]].concat());
    let refused = tokio::task::block_in_place(|| output_of(&land));
    let mut seen = 0;
    let mut flown = false;
    while let Ok(Some(truth)) = timeout(Duration::from_millis(100), truths.next()).await {
        seen += 1;
        flown |= !truth.on_ground;
        if seen >= 4 {
            break;
        }
    }
    simulator.kill()?;
    simulator.wait()?;
    let asked = asked?;
    let said = String::from_utf8_lossy(&asked.stderr).into_owned();
    ensure!(asked.status.code() == Some(2) && said.contains("--real-vehicle --yes"), "{said}");
    let refused = refused?;
    let said = format!(
        "{}{}",
        String::from_utf8_lossy(&refused.stdout),
        String::from_utf8_lossy(&refused.stderr)
    );
    println!("{said}");
    ensure!(!refused.status.success() && said.contains("--real-vehicle"), "{said}");
    ensure!(seen > 0 && !flown, "{seen} states, flown: {flown}");
    Ok(())
}
