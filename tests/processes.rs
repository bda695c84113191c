//! The whole system as processes: it lands, and losing any process leaves the vehicle safe.
//!
//! Each test flies `alight land` in real time, one after the other, and joins its network as one more process.

#![expect(
    clippy::print_stdout,
    reason = "what a test measured, or why it is skipped, is for people to read"
)]

use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

use anyhow::{Context, anyhow, bail, ensure};
use messages::{ControllerCommand, ControllerStatus, Truth, topic};
use node::{Identity, Node, Subscriber, ZenohSource, now_ns};
use rustix::process::{Pid, Signal, kill_process};
use tokio::sync::{Mutex, mpsc};
use tokio::time::timeout;

/// Longest wait for anything; a landing takes a fifth of it.
const PATIENCE: Duration = Duration::from_secs(120);
const ALIGHT: &str = env!("CARGO_BIN_EXE_alight");

/// Two landings at once would share the processor.
static ONE_AT_A_TIME: Mutex<()> = Mutex::const_new(());

/// What a command that should end by itself says; one that goes on is ended.
fn output_of(command: &mut Command) -> anyhow::Result<Output> {
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
struct Landing {
    land: Child,
    said: mpsc::UnboundedReceiver<String>,
    zenoh: PathBuf,
    services: Vec<Service>,
    statuses: Subscriber<ControllerStatus>,
    truths: Subscriber<Truth>,
    node: Node,
    by_hand: Vec<Child>,
}

/// A service that `alight land` started.
struct Service {
    name: String,
    pid: Pid,
    by_hand: Vec<String>,
}

impl Landing {
    async fn start(args: &[&str]) -> anyhow::Result<Self> {
        let mut land = Command::new(ALIGHT)
            .args(["land", "--format", "json", "--timeout-s", "110"])
            // A ground station of the machine's own must not join the flight.
            .args(["--set", "gcs-bridge.ground=udpout:127.0.0.1:9"])
            .args(args)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()?;
        let mut lines = BufReader::new(land.stderr.take().context("standard error")?).lines();
        let mut services = Vec::new();
        let mut zenoh = None;
        while services.len() < 4 {
            let line = lines.next().context("alight land said nothing")??;
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
        let node = Node::open(identity, &ZenohSource::File(zenoh.clone())).await?;
        let statuses = node.subscriber(topic::STATUS, &[]).await?;
        let truths = node.subscriber(topic::TRUTH, &[]).await?;
        let by_hand = Vec::new();
        Ok(Self { land, said, zenoh, services, statuses, truths, node, by_hand })
    }

    fn service(&self, name: &str) -> anyhow::Result<&Service> {
        self.services.iter().find(|s| s.name == name).with_context(|| format!("no {name}"))
    }

    /// `kill -9`; the answer is when.
    fn kill(&self, name: &str) -> anyhow::Result<i64> {
        kill_process(self.service(name)?.pid, Signal::KILL)?;
        Ok(now_ns())
    }

    /// Starts a service again as a person would, with more settings.
    fn start_by_hand(&mut self, name: &str, settings: &[&str]) -> anyhow::Result<Pid> {
        let mut command = Command::new(ALIGHT);
        command.args(&self.service(name)?.by_hand);
        for setting in settings {
            command.args(["--set", setting]);
        }
        let child = command.stdin(Stdio::null()).stderr(Stdio::null()).spawn()?;
        let pid = Pid::from_raw(i32::try_from(child.id())?).context("a process id")?;
        self.by_hand.push(child);
        Ok(pid)
    }

    async fn status(
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
    async fn descends_below(&self, height_m: f64) -> anyhow::Result<ControllerStatus> {
        self.status(&format!("it descends below {height_m} m"), |s| {
            s.phase == "descend" && s.height_m.is_some_and(|h| h < height_m)
        })
        .await
    }

    async fn truth(
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
    async fn motion(&self, duration: Duration) -> Vec<Truth> {
        let mut motion = Vec::new();
        let _ = timeout(duration, async {
            while let Some(truth) = self.truths.next().await {
                motion.push(truth);
            }
        })
        .await;
        motion
    }

    /// Waits for the result, and checks that it landed on the pad.
    async fn lands(mut self) -> anyhow::Result<serde_json::Value> {
        let mut stdout = self.land.stdout.take().context("standard output")?;
        let read = tokio::task::spawn_blocking(move || {
            let mut text = String::new();
            std::io::Read::read_to_string(&mut stdout, &mut text).map(|_| text)
        });
        let text = timeout(PATIENCE, read).await.context("waiting for the result")???;
        let result: serde_json::Value =
            serde_json::from_str(text.lines().last().context("no result")?)?;
        ensure!(result["landed"] == true, "{result}");
        ensure!(self.land.wait()?.success(), "exit status");
        let error_m = result["touchdown_error_m"].as_f64().context("touchdown_error_m")?;
        ensure!(error_m < 0.3, "landed {error_m} m from the pad");
        Ok(result)
    }
}

impl Drop for Landing {
    fn drop(&mut self) {
        let _ = self.land.kill();
        let _ = self.land.wait();
        for child in &mut self.by_hand {
            let _ = child.kill();
            let _ = child.wait();
        }
        // What was said helps when a test fails, and is not shown otherwise.
        while let Ok(line) = self.said.try_recv() {
            println!("{line}");
        }
    }
}

/// The service in a line such as `detector is process 12; by hand: alight detector --zenoh FILE --set 'a=b'`.
fn service_in(line: &str) -> Option<Service> {
    let (start, by_hand) = line.split_once("; by hand: alight ")?;
    let (name, pid) = start.split_once(" is process ")?;
    let by_hand = by_hand.split(' ').map(|word| word.trim_matches('\'').to_owned()).collect();
    Some(Service { name: name.into(), pid: Pid::from_raw(pid.parse().ok()?)?, by_hand })
}

fn descent_m_s(truth: &Truth) -> f64 {
    truth.velocity_ned_m_s[2]
}

fn speed_m_s(truth: &Truth) -> f64 {
    truth.velocity_ned_m_s.iter().map(|v| v * v).sum::<f64>().sqrt()
}

fn seconds(ns: i64) -> f64 {
    ns as f64 * 1e-9
}

#[tokio::test(flavor = "multi_thread")]
async fn it_lands_and_says_how_well_and_losing_the_ground_station_changes_nothing()
-> anyhow::Result<()> {
    let _alone = ONE_AT_A_TIME.lock().await;
    let landing = Landing::start(&["--seed", "2"]).await?;
    landing.descends_below(8.0).await?;
    landing.kill("gcs-bridge")?;
    let result = landing.lands().await?;
    for key in [
        "time_to_disarm_s",
        "time_to_touchdown_s",
        "touchdown_error_m",
        "touchdown_speed_m_s",
        "max_tilt_deg",
        "detections",
        "frames",
    ] {
        ensure!(result[key].is_number(), "`{key}` is {}", result[key]);
    }
    ensure!(result["outcome"] == "landed");
    ensure!(result["latency_ms"]["p50"].as_f64() < result["latency_ms"]["p99"].as_f64());
    let processes = result["processes"].as_array().context("processes")?;
    for service in ["simulator", "detector", "controller"] {
        let cost = processes.iter().find(|p| p["service"] == service).context(service)?;
        ensure!(cost["cpu_percent"].as_f64().is_some_and(|percent| percent > 0.0), "{cost}");
    }
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn without_a_detector_it_stops_descending_and_lands_with_the_next_one() -> anyhow::Result<()>
{
    let _alone = ONE_AT_A_TIME.lock().await;
    let mut landing = Landing::start(&["--seed", "3"]).await?;
    landing.descends_below(7.0).await?;
    let killed_ns = landing.kill("detector")?;
    let stopped = landing
        .status("no descent is asked for", |s| {
            s.stamp_ns > killed_ns && s.setpoint.is_some_and(|s| s.velocity_ned_m_s[2] <= 0.0)
        })
        .await?;
    let after_s = seconds(stopped.stamp_ns - killed_ns);
    println!("descent no longer asked for after {after_s:.2} s");
    // The status is published five times a second, so this is an upper bound.
    ensure!(after_s <= 0.5, "descent asked for until {after_s:.2} s after the kill");
    let still = landing
        .truth("it stands still", |t| t.stamp_ns > killed_ns && descent_m_s(t).abs() < 0.1)
        .await?;
    println!("descent ended after {:.2} s", seconds(still.stamp_ns - killed_ns));
    landing.status("it holds", |s| s.phase == "hold").await?;
    // Drained first: what follows is the motion from now on.
    landing.motion(Duration::from_millis(100)).await;
    let motion = landing.motion(Duration::from_secs(2)).await;
    let fastest = motion.iter().map(speed_m_s).fold(0.0, f64::max);
    ensure!(!motion.is_empty() && fastest < 0.25, "it moves at {fastest:.2} m/s while it holds");
    landing.start_by_hand("detector", &["id=second"])?;
    landing
        .status("the second detector is used", |s| {
            s.active_detector.as_deref() == Some("second") && s.phase == "descend"
        })
        .await?;
    landing.lands().await?;
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn without_a_controller_the_autopilot_stops_it_and_the_next_one_lands() -> anyhow::Result<()>
{
    let _alone = ONE_AT_A_TIME.lock().await;
    let mut landing = Landing::start(&["--seed", "4"]).await?;
    landing.descends_below(9.0).await?;
    let killed_ns = landing.kill("controller")?;
    let stopped = landing
        .truth("the autopilot has stopped it", |t| {
            seconds(t.stamp_ns - killed_ns) > 3.0 && speed_m_s(t) < 0.15
        })
        .await?;
    println!(
        "stopped after {:.1} s at {:.1} m",
        seconds(stopped.stamp_ns - killed_ns),
        -stopped.position_ned_m[2]
    );
    ensure!(!stopped.on_ground, "it came down without a controller");
    landing.start_by_hand("controller", &[])?;
    landing.lands().await?;
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn of_two_detectors_one_is_active_and_the_other_takes_over() -> anyhow::Result<()> {
    let _alone = ONE_AT_A_TIME.lock().await;
    let mut landing = Landing::start(&["--seed", "5"]).await?;
    landing.status("the first detector is active", |s| s.active_detector.is_some()).await?;
    landing.start_by_hand("detector", &["id=spare"])?;
    let both = landing
        .status("both are named", |s| s.candidates.iter().filter(|c| c.alive).count() == 2)
        .await?;
    ensure!(both.active_detector.as_deref() == Some("main"), "{both:?}");
    landing.descends_below(8.0).await?;
    let killed_ns = landing.kill("detector")?;
    let handed_over = landing
        .status("the spare one is active", |s| s.active_detector.as_deref() == Some("spare"))
        .await?;
    let after_s = seconds(handed_over.stamp_ns - killed_ns);
    println!("handed over after {after_s:.3} s");
    ensure!(after_s <= 0.3, "handed over after {after_s:.3} s");
    let result = landing.lands().await?;
    println!("{result}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_operators_choice_of_detector_is_followed_and_a_wrong_one_refused() -> anyhow::Result<()>
{
    let _alone = ONE_AT_A_TIME.lock().await;
    let mut landing = Landing::start(&["--seed", "6"]).await?;
    landing.status("a detector is active", |s| s.active_detector.is_some()).await?;
    landing.start_by_hand("detector", &["id=spare"])?;
    landing.status("both are named", |s| s.candidates.len() == 2).await?;
    let refused = landing
        .node
        .command(topic::COMMAND, &[], &ControllerCommand::UseDetector("nobody".into()))
        .await?;
    ensure!(!refused.accepted && refused.reason.contains("main"), "{refused:?}");
    let output = output_of(
        Command::new(ALIGHT)
            .args(["command", "use-detector", "spare", "--zenoh"])
            .arg(&landing.zenoh),
    )?;
    ensure!(output.status.success(), "{output:?}");
    landing
        .status("the spare one is active", |s| s.active_detector.as_deref() == Some("spare"))
        .await?;
    // Hold and resume on the way down.
    landing.descends_below(9.0).await?;
    let hold = landing.node.command(topic::COMMAND, &[], &ControllerCommand::Hold).await?;
    ensure!(hold.accepted, "{hold:?}");
    landing.status("it holds", |s| s.phase == "hold").await?;
    let resume = landing.node.command(topic::COMMAND, &[], &ControllerCommand::Resume).await?;
    ensure!(resume.accepted, "{resume:?}");
    landing.lands().await?;
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_second_controller_and_a_port_in_use_are_refused_in_words() -> anyhow::Result<()> {
    let _alone = ONE_AT_A_TIME.lock().await;
    let mut landing = Landing::start(&["--seed", "7"]).await?;
    landing.status("the controller is there", |_| true).await?;
    let second =
        output_of(Command::new(ALIGHT).args(&landing.service("controller")?.by_hand).args([
            "--set",
            "id=second",
            "--set",
            "autopilot.address=udpin:127.0.0.1:0",
        ]))?;
    let said = String::from_utf8_lossy(&second.stderr);
    ensure!(second.status.code() == Some(1), "{second:?}");
    ensure!(said.contains("another controller (`main`) is at work for this vehicle"), "{said}");
    let twin = output_of(Command::new(ALIGHT).args(&landing.service("detector")?.by_hand))?;
    let said = String::from_utf8_lossy(&twin.stderr);
    ensure!(twin.status.code() == Some(1) && said.contains("called `main` already"), "{said}");
    // The first still flies; it is asked to stop, and stops all of its services.
    let pids: Vec<Pid> = landing.services.iter().map(|s| s.pid).collect();
    kill_process(Pid::from_raw(i32::try_from(landing.land.id())?).context("pid")?, Signal::TERM)?;
    let status = tokio::task::block_in_place(|| landing.land.wait())?;
    ensure!(status.code() == Some(1), "an interrupted landing ends with {status}");
    for pid in pids {
        ensure!(rustix::process::test_kill_process(pid).is_err(), "{pid:?} still runs");
    }
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_link_whose_port_is_taken_says_so() -> anyhow::Result<()> {
    let _alone = ONE_AT_A_TIME.lock().await;
    let taken = std::net::UdpSocket::bind("127.0.0.1:0")?;
    let port = taken.local_addr()?.port();
    let directory = tempfile::tempdir()?;
    let zenoh = directory.path().join("zenoh.json5");
    let free = std::net::TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
    std::fs::write(&zenoh, node::session::local_config(free))?;
    let output = output_of(
        Command::new(ALIGHT)
            .args([
                "controller",
                "--set",
                &format!("autopilot.address=udpin:127.0.0.1:{port}"),
                "--zenoh",
            ])
            .arg(&zenoh),
    )?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.code() == Some(1), "{output:?}");
    ensure!(said.contains(&format!("port {port} is already in use")), "{said}");
    Ok(())
}

#[test]
fn wrong_settings_stop_the_start_with_file_key_value_and_limit() -> anyhow::Result<()> {
    let check = |args: &[&str], parts: &[&str]| {
        let output = output_of(Command::new(ALIGHT).args(args).stdin(Stdio::null()))?;
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        ensure!(output.status.code() == Some(2), "{args:?} ended with {}: {said}", output.status);
        for part in parts {
            ensure!(said.contains(part), "`{part}` is not in what {args:?} said: {said}");
        }
        anyhow::Ok(())
    };
    let directory = tempfile::tempdir()?;
    let file = directory.path().join("mine.toml");
    std::fs::write(&file, "[phases]\nhold_timeout_s = 9999\n")?;
    let path = file.to_str().context("path")?;
    check(
        &["controller", "--config", path],
        &["mine.toml", "phases.hold_timeout_s", "9999", "from 1 to 600"],
    )?;
    check(&["controller", "--config", "no/such.toml"], &["no/such.toml", "check the path"])?;
    check(&["detector", "--set", "marker=rings"], &["no key `marker`", "did you mean `markers`?"])?;
    check(&["simulator", "--set", "wind.mean_m_s=99"], &["wind.mean_m_s", "99", "from 0 to 20"])?;
    check(&["land", "--set", "wind.mean_m_s=5"], &["begins with its service", "simulator."])?;
    check(&["land", "--guidance", "magic"], &["magic"])?;
    check(&["land", "--autopilot", "usb"], &["usb"])?;
    check(&["config", "detector", "--set", "camera=a/b"], &["camera", "letters, digits"])?;
    check(&["fly"], &["fly"])?;
    Ok(())
}

/// Runs a Python script that status 77 lets skip; the interpreter is $ALIGHT_PYTHON, or python3.
fn python(script: &str, args: &[&str]) -> anyhow::Result<Option<Child>> {
    let interpreter = std::env::var("ALIGHT_PYTHON").unwrap_or_else(|_| "python3".into());
    let script = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../tests").join(script);
    let child = Command::new(&interpreter).arg(&script).args(args).stdout(Stdio::piped()).spawn();
    match child {
        Ok(child) => Ok(Some(child)),
        Err(problem) => {
            println!("skipped: {interpreter} does not start: {problem}");
            Ok(None)
        }
    }
}

fn python_says_yes(child: Child) -> anyhow::Result<()> {
    let output = child.wait_with_output()?;
    let said = String::from_utf8_lossy(&output.stdout);
    println!("{said}");
    match output.status.code() {
        Some(0 | 77) => Ok(()),
        _ => bail!("the script ended with {}: {said}", output.status),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn programs_of_others_see_the_services_the_frames_and_the_vehicle() -> anyhow::Result<()> {
    let _alone = ONE_AT_A_TIME.lock().await;
    let ground = std::net::UdpSocket::bind("127.0.0.1:0")?.local_addr()?.port();
    let address = format!("gcs-bridge.ground=udpout:127.0.0.1:{ground}");
    let station =
        python("gcs/ground_station.py", &["--connect", &format!("udpin:127.0.0.1:{ground}")])?;
    let landing = Landing::start(&["--seed", "8", "--set", &address]).await?;
    landing.status("a detector is active", |s| s.active_detector.is_some()).await?;
    let port = std::fs::read_to_string(&landing.zenoh)?
        .split("connect: {")
        .nth(1)
        .and_then(|rest| rest.split("127.0.0.1:").nth(1)?.split('"').next().map(str::to_owned))
        .context("the meeting point's port")?;
    let client = python("zenoh_client.py", &[&format!("tcp/127.0.0.1:{port}")])?;
    tokio::task::block_in_place(|| client.map_or(Ok(()), python_says_yes))?;
    landing.lands().await?;
    tokio::task::block_in_place(|| station.map_or(Ok(()), python_says_yes))
}
