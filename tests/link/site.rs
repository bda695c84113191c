//! Makes two hosts on one machine: the drone, and the ground in a network namespace, joined by an emulated radio link.

use std::io::{BufRead, BufReader, Write};
use std::path::PathBuf;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use anyhow::{Context, bail, ensure};
use node::{Identity, Network, Node};
use testing::ports;

/// The program under test.
const ALIGHT: &str = env!("CARGO_BIN_EXE_alight-under-test");
const EMULATOR: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/link/emulator.py");
/// Runs a program on the ground, where there is no shared memory of the drone's.
const WITHOUT_SHARED_MEMORY: &str = "mount -t tmpfs tmpfs /dev/shm && exec \"$@\"";

/// The properties of the link.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Radio {
    pub(crate) rate_mbit: f64,
    pub(crate) delay_ms: f64,
    pub(crate) jitter_ms: f64,
    /// Part of the packets that are lost.
    pub(crate) loss: f64,
    /// Packets marked for expedited forwarding go first.
    pub(crate) marks: bool,
    /// Both hosts send lost packets again after 30 ms at the soonest, instead of 200.
    pub(crate) resends_soon: bool,
}

/// The emulated link and the ground's namespace, until this is dropped.
pub(crate) struct Air {
    emulator: Child,
    settings: Option<ChildStdin>,
    answers: BufReader<ChildStdout>,
    namespace: String,
    /// The drone's address on the link.
    pub(crate) drone: String,
}

impl Air {
    /// `None` with a message where this machine does not allow it.
    pub(crate) fn new(radio: Radio) -> anyhow::Result<Option<Self>> {
        let id = std::process::id() % 100_000;
        let (drone_end, ground_end) = (format!("aird{id}"), format!("airg{id}"));
        let emulator = Command::new("python3")
            .args([EMULATOR, &drone_end, &ground_end])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn();
        let mut emulator = match emulator {
            Ok(emulator) => emulator,
            Err(problem) => {
                testing::skip("python", problem);
                return Ok(None);
            }
        };
        let settings = emulator.stdin.take();
        let mut answers = BufReader::new(emulator.stdout.take().context("its output")?);
        let mut line = String::new();
        answers.read_line(&mut line)?;
        if line.trim() != "ready" {
            testing::skip("namespaces", line.trim());
            emulator.kill().context("ending the emulator")?;
            emulator.wait()?;
            return Ok(None);
        }
        let subnet = format!("10.{}.{}", 64 + id / 250 % 64, id % 250);
        let (drone, ground) = (format!("{subnet}.1"), format!("{subnet}.2"));
        let namespace = format!("alight-{id}");
        let mut air = Self { emulator, settings, answers, namespace: namespace.clone(), drone };
        let drone_address = format!("{}/30", air.drone);
        let ground_address = format!("{ground}/30");
        for command in [
            vec!["netns", "add", &namespace],
            vec!["link", "set", &ground_end, "netns", &namespace],
            vec!["address", "add", &drone_address, "dev", &drone_end],
            vec!["link", "set", &drone_end, "up"],
            vec!["-n", &namespace, "address", "add", &ground_address, "dev", &ground_end],
            vec!["-n", &namespace, "link", "set", &ground_end, "up"],
            vec!["-n", &namespace, "link", "set", "lo", "up"],
        ] {
            let problem = match Command::new("ip").args(&command).output() {
                Ok(output) if output.status.success() => continue,
                Ok(output) => String::from_utf8_lossy(&output.stderr).into_owned(),
                Err(problem) => problem.to_string(),
            };
            testing::skip("namespaces", format_args!("ip {command:?}: {problem}"));
            return Ok(None);
        }
        if radio.resends_soon {
            let route = format!("{subnet}.0/30");
            for (namespace, end) in [(None, &drone_end), (Some(namespace.as_str()), &ground_end)] {
                let mut command = Command::new("ip");
                command.args(namespace.iter().flat_map(|name| ["-n", name]));
                command.args(["route", "change", &route, "dev", end, "rto_min", "30ms"]);
                ensure!(command.status()?.success(), "the route of {end} was not changed");
            }
        }
        air.set(radio)?;
        Ok(Some(air))
    }

    /// Changes the properties of the link.
    pub(crate) fn set(&mut self, radio: Radio) -> anyhow::Result<()> {
        let Radio { rate_mbit, delay_ms, jitter_ms, loss, marks, .. } = radio;
        self.change(&serde_json::json!({
            "rate_mbit": rate_mbit, "delay_ms": delay_ms, "jitter_ms": jitter_ms, "loss": loss, "marks": marks,
        }))
    }

    /// Cuts the link, or joins it again.
    pub(crate) fn cut(&mut self, is_cut: bool) -> anyhow::Result<()> {
        self.change(&serde_json::json!({ "cut": is_cut }))
    }

    /// A command that runs on the ground.
    pub(crate) fn on_the_ground(&self, program: &str) -> Command {
        let mut command = Command::new("ip");
        command.args(["netns", "exec", &self.namespace, "sh", "-c", WITHOUT_SHARED_MEMORY]);
        command.args(["sh", program]);
        command
    }

    fn change(&mut self, settings: &serde_json::Value) -> anyhow::Result<()> {
        writeln!(self.settings.as_mut().context("the emulator's input")?, "{settings}")?;
        let mut line = String::new();
        ensure!(self.answers.read_line(&mut line)? > 0, "the link's emulator ended");
        Ok(())
    }
}

impl Drop for Air {
    fn drop(&mut self) {
        self.settings = None;
        if self.emulator.wait().is_err() {
            println!("The link's emulator did not end in good order");
        }
        let gone = Command::new("ip").args(["netns", "delete", &self.namespace]).output();
        drop(gone);
    }
}

/// Two hosts with processes; they end with this.
pub(crate) struct Site {
    pub(crate) air: Air,
    meet: u16,
    port: u16,
    autopilot: u16,
    children: Vec<(String, Child)>,
    /// On the drone.
    pub(crate) node: Node,
}

impl Site {
    /// Both hosts, with nothing on them but this process on the drone.
    pub(crate) async fn new(radio: Radio) -> anyhow::Result<Option<Self>> {
        let Some(air) = Air::new(radio)? else { return Ok(None) };
        let ([meet], _, autopilot) = ports::free()?;
        let network = Network { meet: Some(meet), ..Network::default() };
        let identity = Identity { service: "alight", instance: "link".into() };
        let node = Node::open(identity, &network.source("alight")?).await?;
        let children = Vec::new();
        Ok(Some(Self { air, meet, port: 7448, autopilot, children, node }))
    }

    /// Where the ground finds the drone.
    fn drone_address(&self) -> String {
        format!("{}:{}", self.air.drone, self.port)
    }

    /// Starts a process on the drone.
    pub(crate) fn drone(&mut self, service: &str, args: &[&str]) -> anyhow::Result<()> {
        let mut command = Command::new(ALIGHT);
        command.arg(service).args(["--meet", &self.meet.to_string()]).args(args);
        self.spawn(service, command)
    }

    /// Starts the drone's end of the air link.
    pub(crate) fn relay(&mut self) -> anyhow::Result<()> {
        let address = self.drone_address();
        self.drone("relay", &["--zenoh", "drone", "--listen", &address, "--insecure"])
    }

    /// Starts a simulated flight: world, camera, autopilot and controller.
    pub(crate) fn flight(&mut self, seed: u64, camera: &[&str]) -> anyhow::Result<()> {
        let (seed, port) = (format!("seed={seed}"), self.autopilot);
        let address = format!("autopilot.address=\"udpout:127.0.0.1:{port}\"");
        let mut args = vec!["--set", seed.as_str(), "--set", &address];
        args.extend(camera.iter().flat_map(|set| ["--set", set]));
        self.drone("simulator", &args)?;
        let address = format!("autopilot.address=\"udpin:127.0.0.1:{port}\"");
        self.drone("controller", &["--set", &address, "--set", "start=\"takeoff\""])
    }

    /// Starts a service on the ground.
    pub(crate) fn ground(&mut self, service: &str, args: &[&str]) -> anyhow::Result<()> {
        let mut command = self.air.on_the_ground(ALIGHT);
        let address = self.drone_address();
        command.args([service, "--zenoh", "ground", "--connect", &address]).args(args);
        self.spawn(service, command)
    }

    /// Starts this program's probe on the ground; it prints its measurements as it ends. Where there is no controller
    /// but the drone's end of the probe, it also sends commands.
    pub(crate) fn probe(&mut self, seconds: f64, commands: bool) -> anyhow::Result<Child> {
        let this = std::env::current_exe()?;
        let mut command = self.air.on_the_ground(&this.to_string_lossy());
        command.args(["probe", &self.drone_address(), &seconds.to_string()]);
        command.args(commands.then_some("commands"));
        command.stdin(Stdio::null()).stdout(Stdio::piped());
        command.spawn().context("starting the probe")
    }

    fn spawn(&mut self, name: &str, mut command: Command) -> anyhow::Result<()> {
        if std::env::var_os("ALIGHT_LOG").is_none() {
            command.env("ALIGHT_LOG", "error");
        }
        let child = command.stdin(Stdio::null()).stdout(Stdio::null()).spawn();
        self.children.push((name.to_owned(), child.with_context(|| format!("starting {name}"))?));
        Ok(())
    }

    /// An error when a process has ended.
    pub(crate) fn all_run(&mut self) -> anyhow::Result<()> {
        for (name, child) in &mut self.children {
            if let Some(status) = child.try_wait()? {
                bail!("{name} ended: {status}");
            }
        }
        Ok(())
    }
}

impl Drop for Site {
    fn drop(&mut self) {
        for (_, child) in &mut self.children {
            // A process that has ended needs no kill.
            drop(child.kill());
            drop(child.wait());
        }
    }
}

/// The network of a process on the ground.
pub(crate) fn ground_network(address: &str) -> Network {
    Network {
        config: Some(PathBuf::from("ground")),
        connect: Some(address.to_owned()),
        ..Network::default()
    }
}
