//! Tests `alight up` for the drone and the ground on one machine: processes connect, are restarted when killed and given
//! up when refused; a crash of the supervisor; dry runs, systemd units.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, ensure};
use messages::{ControllerStatus, DetectorCommand, VehicleState, topic};
use node::{Identity, Network, Node, Subscriber};
use rustix::process::{Pid, Signal, kill_process, test_kill_process};
use testing::{ports, with_second_try};
use tokio::sync::mpsc;
use tokio::time::timeout;

use crate::flight::{beside_another, output_of, small_camera, time_for};

const PATIENCE: Duration = Duration::from_secs(60);
const ALIGHT: &str = env!("CARGO_BIN_EXE_alight-under-test");

/// A site whose drone is simulated; the vehicle waits for a command.
fn write_site(folder: &Path) -> anyhow::Result<u16> {
    let ([meet], air, autopilot) = ports::free()?;
    let small = small_camera();
    let site = format!(
        r#"
vehicle = "tested"
address = "127.0.0.1:{air}"
insecure = true
meet = {meet}

[[drone]]
run = "simulator"
set = ["autopilot.address=udpout:127.0.0.1:{autopilot}", {small}]
[[drone]]
run = "detector"
set = ["id=onboard"]
[[drone]]
run = "controller"
set = ["autopilot.address=udpin:127.0.0.1:{autopilot}"]

[[ground]]
run = "detector"
set = ["id=ground"]
"#
    );
    std::fs::write(folder.join("site.toml"), site)?;
    Ok(meet)
}

/// A site with a controller without an autopilot.
fn write_lone_controller(folder: &Path) -> anyhow::Result<u16> {
    let ([meet], _, autopilot) = ports::free()?;
    let site = format!(
        r#"
meet = {meet}
[[local]]
run = "controller"
set = ["autopilot.address=udpin:127.0.0.1:{autopilot}"]
"#
    );
    std::fs::write(folder.join("site.toml"), site)?;
    Ok(meet)
}

fn alight(folder: &Path, arguments: &[&str]) -> anyhow::Result<Output> {
    let site = folder.join("site.toml");
    let command = Command::new(ALIGHT).args(arguments).arg("--config").arg(site).output();
    command.with_context(|| format!("{arguments:?}"))
}

/// A running `alight up ROLE`.
struct Up {
    child: Child,
    said: mpsc::UnboundedReceiver<String>,
    printed: Vec<String>,
}

impl Up {
    fn start(folder: &Path, role: &str) -> anyhow::Result<Self> {
        Self::run(Command::new(ALIGHT), folder, role)
    }

    /// The same of another file of the program, in another environment.
    fn run(mut program: Command, folder: &Path, role: &str) -> anyhow::Result<Self> {
        let mut child = program
            .args(["up", role, "--config"])
            .arg(folder.join("site.toml"))
            .env("RUNTIME_DIRECTORY", folder)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()?;
        let lines = BufReader::new(child.stdout.take().context("standard output")?).lines();
        let (sender, said) = mpsc::unbounded_channel();
        std::thread::Builder::new()
            .name("said".into())
            .spawn(move || lines.map_while(Result::ok).all(|line| sender.send(line).is_ok()))?;
        Ok(Self { child, said, printed: Vec::new() })
    }

    /// Waits for a new line with this beginning and this part.
    async fn wait_for_line(&mut self, begin: &str, part: &str) -> anyhow::Result<String> {
        let line = async {
            while let Some(line) = self.said.recv().await {
                self.printed.push(line.clone());
                if line.starts_with(begin) && line.contains(part) {
                    return Some(line);
                }
            }
            None
        };
        let line = timeout(PATIENCE, line).await.ok().flatten();
        line.ok_or_else(|| anyhow!("`{begin} ... {part}` was not printed: {:#?}", self.printed))
    }

    /// The process of a service, once it is started.
    async fn process(&mut self, name: &str) -> anyhow::Result<Pid> {
        let line = self.wait_for_line(name, "started as process").await?;
        let number = line.split("process ").nth(1).and_then(|rest| rest.split(',').next());
        let number = number.context("a process number")?.parse()?;
        Pid::from_raw(number).context("a process number")
    }

    /// Asks it to end; the answer is its exit status.
    fn stop(&mut self) -> anyhow::Result<Option<i32>> {
        self.stop_by(Signal::INT)
    }

    /// Sends it a signal, and waits for its end; the answer is its exit status, if it has one.
    fn stop_by(&mut self, signal: Signal) -> anyhow::Result<Option<i32>> {
        let pid = Pid::from_raw(i32::try_from(self.child.id())?).context("a process id")?;
        kill_process(pid, signal)?;
        let began = Instant::now();
        while began.elapsed() < PATIENCE {
            if let Some(status) = self.child.try_wait()? {
                return Ok(status.code());
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        Err(anyhow!("it does not end"))
    }
}

impl Drop for Up {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        while let Ok(line) = self.said.try_recv() {
            self.printed.push(line);
        }
        for line in &self.printed {
            println!("{line}");
        }
    }
}

/// The longest time without a message, over three seconds.
async fn longest_gap(states: &Subscriber<VehicleState>) -> Duration {
    let mut last = Instant::now();
    let mut longest = Duration::ZERO;
    let watched = async {
        while states.next().await.is_some() {
            longest = longest.max(last.elapsed());
            last = Instant::now();
        }
    };
    let _: Result<(), _> = timeout(Duration::from_secs(3), watched).await;
    longest.max(last.elapsed())
}

#[tokio::test(flavor = "multi_thread")]
async fn two_roles_connect_killed_processes_start_again_and_the_end_is_orderly()
-> anyhow::Result<()> {
    with_second_try(two_roles_meet).await
}

async fn two_roles_meet() -> anyhow::Result<()> {
    let _flight = time_for(3).await?;
    let folder = tempfile::tempdir()?;
    let meet = write_site(folder.path())?;
    let mut drone = Up::start(folder.path(), "drone")?;
    let relay = drone.process("relay").await?;
    let mut processes = vec![relay];
    for name in ["simulator", "detector", "controller"] {
        processes.push(drone.process(name).await?);
    }
    let mut ground = Up::start(folder.path(), "ground")?;
    let on_the_ground = ground.process("detector").await?;
    processes.push(on_the_ground);

    // As it is seen on the drone.
    let local = Network { meet: Some(meet), vehicle: Some("tested".into()), ..Network::default() };
    let identity = Identity { service: "alight", instance: "test".into() };
    let node = Node::open(identity, &local.source("operator")?).await?;
    let presence = node.presence("detector").await?;
    let change = async |name: &str, there: bool| -> anyhow::Result<()> {
        let wanted = Some((name.to_owned(), there));
        let seen = async { while presence.next().await != wanted {} };
        timeout(PATIENCE, seen).await.with_context(|| format!("`{name}` is there: {there}"))
    };
    change("ground", true).await?;

    // A link that hangs (here: its other end does) delays nothing between the drone's own processes.
    let states = node.subscriber(topic::VEHICLE_STATE, &[]).await?;
    let mut calm = false;
    for _ in 0..3 {
        let before = longest_gap(&states).await;
        kill_process(on_the_ground, Signal::STOP)?;
        let during = longest_gap(&states).await;
        kill_process(on_the_ground, Signal::CONT)?;
        println!("longest gap in the vehicle's state: {before:?}, while the link hangs {during:?}");
        // Missed after the lease, and back when it continues.
        change("ground", false).await?;
        change("ground", true).await?;
        calm = during < before * 3;
        if calm {
            break;
        }
    }
    ensure!(calm, "local messages were held up");

    // A killed detector starts again, and so does the relay, with the ground behind it.
    kill_process(on_the_ground, Signal::KILL)?;
    change("ground", false).await?;
    change("ground", true).await?;
    ground.wait_for_line("detector", "restarting in").await?;
    processes.push(ground.process("detector").await?);
    kill_process(relay, Signal::KILL)?;
    change("ground", false).await?;
    change("ground", true).await?;
    drone.wait_for_line("relay", "restarting in").await?;
    processes.push(drone.process("relay").await?);

    // A detector that was swapped stays stopped while its replacement runs, and no longer.
    let mut other = Command::new(ALIGHT)
        .args(["detector", "--meet", &meet.to_string(), "--vehicle", "tested"])
        .args(["--set", "id=other"])
        .stdin(Stdio::null())
        .spawn()?;
    let relieved = async {
        change("other", true).await?;
        let stop = &DetectorCommand::Stop;
        let reply = node.command(topic::DETECTOR_COMMAND, &["onboard"], stop).await?;
        ensure!(reply.accepted, "{reply:?}");
        drone.wait_for_line("detector", "replaced by the detector `other`").await?;
        change("onboard", false).await
    };
    let relieved = relieved.await;
    other.kill()?;
    other.wait()?;
    relieved?;
    drone.wait_for_line("detector", "its replacement is gone").await?;
    processes.push(drone.process("detector").await?);
    change("onboard", true).await?;

    // A new controller waits for a command: there was no landing to be resumed.
    let controller = processes[3];
    kill_process(controller, Signal::KILL)?;
    let again = drone.wait_for_line("controller", "started as process").await?;
    ensure!(again.contains("start = \"command\""), "{again}");

    // The doctor on the ground finds no error.
    timeout(PATIENCE, async {
        while node.alive("controller", "*").await.is_ok_and(|alive| alive.is_empty()) {}
    })
    .await?;
    let output = alight(folder.path(), &["doctor", "ground", "--format", "json"])?;
    let text = String::from_utf8_lossy(&output.stdout);
    let seen: serde_json::Value = serde_json::from_str(&text).with_context(|| text.to_string())?;
    let findings = seen["findings"].as_array().context("findings")?;
    let wrong: Vec<_> = findings.iter().filter(|f| f["verdict"] == "wrong").collect();
    ensure!(wrong.is_empty() && output.status.success(), "{wrong:#?}");
    for part in ["controller `main`", "detector `ground`", "relay `drone`"] {
        let names_it =
            |f: &serde_json::Value| f["finding"].as_str().is_some_and(|f| f.contains(part));
        ensure!(findings.iter().any(names_it), "`{part}` is not in {text}");
    }

    // The last one first, and none is left.
    ensure!(drone.stop()? == Some(0));
    ensure!(ground.stop()? == Some(0));
    let stopped = drone.wait_for_line("controller: stopped", "").await;
    ensure!(
        stopped.is_ok() && drone.wait_for_line("relay: stopped", "").await.is_ok(),
        "{stopped:?}"
    );
    for process in processes {
        ensure!(test_kill_process(process).is_err(), "{process:?} is left");
    }
    let output = alight(folder.path(), &["doctor", "ground", "--seconds", "1"])?;
    ensure!(output.status.code() == Some(1), "{output:?}");
    let text = String::from_utf8_lossy(&output.stdout);
    ensure!(text.contains("does not answer"), "{text}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_program_that_is_removed_takes_no_other_with_it() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    let folder = tempfile::tempdir()?;
    let ([meet], ..) = ports::free()?;
    let (program, script) = (folder.path().join("alight"), folder.path().join("own.sh"));
    std::fs::copy(ALIGHT, &program)?;
    std::fs::write(&script, "#!/bin/sh\necho meets at ${ALIGHT_MEET} >&2\nexec sleep 600\n")?;
    std::fs::set_permissions(&script, std::fs::Permissions::from_mode(0o755))?;
    let site = format!(
        r#"
vehicle = "tested"
meet = {meet}
[[local]]
run = "detector"
[[local]]
name = "own"
command = ["./own.sh"]
"#
    );
    std::fs::write(folder.path().join("site.toml"), site)?;
    let mut alight = Command::new(&program);
    // The environment of the user's shell is not the site's.
    alight.env("ALIGHT_MEET", "1").env("ALIGHT_VEHICLE", "other");
    let mut up = Up::run(alight, folder.path(), "local")?;
    let detector = up.process("detector:").await?;
    let own = up.process("own:").await?;
    up.wait_for_line("own:", &format!("meets at {meet}")).await?;
    let network =
        Network { meet: Some(meet), vehicle: Some("tested".into()), ..Network::default() };
    let identity = Identity { service: "controller", instance: "main".into() };
    let node = Node::open(identity, &network.source("controller")?).await?;
    let presence = node.presence("detector").await?;
    let joined = timeout(PATIENCE, presence.next()).await.context("the detector has not joined")?;
    ensure!(joined == Some(("main".to_owned(), true)), "{joined:?}");

    std::fs::remove_file(&program)?;
    std::fs::remove_file(&script)?;
    kill_process(own, Signal::KILL)?;
    up.wait_for_line("own:", "restarting").await?;
    // It cannot be started: that counts as its end, and does not end the others.
    up.wait_for_line("own:", "./own.sh").await?;
    kill_process(detector, Signal::KILL)?;
    let again = up.process("detector:").await?;
    ensure!(again != detector && test_kill_process(again).is_ok(), "{again:?}");
    let code = up.stop()?;
    ensure!(code == Some(0), "{code:?}: {:#?}", up.printed);
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_program_that_cannot_be_started_is_tried_again_while_the_others_run() -> anyhow::Result<()>
{
    let _flight = beside_another().await?;
    let folder = tempfile::tempdir()?;
    let script = folder.path().join("own.sh");
    // It is executable, but its interpreter is missing.
    std::fs::write(&script, "#!/no/such/shell\n")?;
    std::fs::set_permissions(&script, std::fs::Permissions::from_mode(0o755))?;
    let ([meet], ..) = ports::free()?;
    let site = format!(
        r#"
meet = {meet}
[[local]]
name = "other"
command = ["sleep", "600"]
[[local]]
name = "own"
command = ["./own.sh"]
"#
    );
    std::fs::write(folder.path().join("site.toml"), site)?;
    let mut up = Up::start(folder.path(), "local")?;
    let other = up.process("other:").await?;
    up.wait_for_line("own: exited with an error at its start", "./own.sh").await?;
    std::fs::write(&script, "#!/bin/sh\nexec sleep 600\n")?;
    up.process("own:").await?;
    ensure!(test_kill_process(other).is_ok(), "the other one has ended");
    ensure!(up.stop()? == Some(0));
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn after_a_crash_of_the_supervisor_the_controller_does_not_take_off() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    let folder = tempfile::tempdir()?;
    let ([meet], _, autopilot) = ports::free()?;
    let site = format!(
        r#"
meet = {meet}
[[local]]
run = "controller"
set = ["autopilot.address=udpin:127.0.0.1:{autopilot}", "start=takeoff"]
"#
    );
    std::fs::write(folder.path().join("site.toml"), site)?;
    // The end of a terminal, unless that is ignored here, is no order to forget the crash.
    let hangup = if node::ignores_hangups() { Signal::KILL } else { Signal::HUP };
    for (signal, mode) in [
        (Signal::KILL, None),
        (hangup, Some("command")),
        (Signal::KILL, Some("command")),
        (Signal::INT, Some("command")),
    ] {
        let mut up = Up::start(folder.path(), "local")?;
        if mode.is_some() {
            up.wait_for_line("the `alight up` before this one was killed", "starts no motors")
                .await?;
        }
        let started = up.wait_for_line("controller:", "started as process").await?;
        let started_mode = started.split_once("start = ").map(|(_, mode)| mode.trim_matches('"'));
        ensure!(started_mode == mode, "{started}");
        let code = up.stop_by(signal)?;
        ensure!(code == (signal != Signal::KILL).then_some(0), "{code:?}");
    }
    let mut up = Up::start(folder.path(), "local")?;
    let started = up.wait_for_line("controller:", "started as process").await?;
    ensure!(!started.contains("start ="), "{started}");
    ensure!(up.stop()? == Some(0));
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_process_that_hangs_is_reported_by_the_supervisor_and_the_doctor() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    let folder = tempfile::tempdir()?;
    write_lone_controller(folder.path())?;
    let mut up = Up::start(folder.path(), "local")?;
    let controller = up.process("controller:").await?;
    up.wait_for_line("controller:", "Ready").await?;
    tokio::time::sleep(Duration::from_secs(3)).await;
    kill_process(controller, Signal::STOP)?;
    let number = controller.as_raw_nonzero();
    let silent = format!("process {number} runs, but has published no health for 10 s");
    let reported = up.wait_for_line("controller:", &silent).await;
    let output = alight(folder.path(), &["doctor", "local", "--format", "json"]);
    kill_process(controller, Signal::CONT)?;
    reported?;
    let output = output?;
    let said = String::from_utf8_lossy(&output.stdout);
    let running = format!("the controller runs here as process {number}, but does not answer");
    ensure!(said.contains(&running), "{said}");
    ensure!(!said.contains("alight up drone") && !said.contains("nothing can land"), "{said}");
    up.wait_for_line("controller:", "publishes its health again").await?;
    ensure!(up.stop()? == Some(0));
    Ok(())
}

/// The output of a tool as JSON, with its exit status.
fn json_of(arguments: &[&str], meet: &str) -> anyhow::Result<(serde_json::Value, Option<i32>)> {
    let json = ["--format", "json", "--meet", meet];
    let output = output_of(Command::new(ALIGHT).args(arguments).args(json))?;
    let parsed = serde_json::from_slice(&output.stdout);
    Ok((parsed.with_context(|| format!("{output:?}"))?, output.status.code()))
}

#[tokio::test(flavor = "multi_thread")]
async fn programs_read_the_reply_to_a_command_and_the_list_of_detectors() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    let folder = tempfile::tempdir()?;
    let meet = write_lone_controller(folder.path())?.to_string();
    let (list, status) = json_of(&["detectors"], &meet)?;
    ensure!(list["controller"] == false && status == Some(1), "{list}, {status:?}");
    for arguments in [&["command", "hold"][..], &["detectors", "use", "main"]] {
        let (reply, status) = json_of(arguments, &meet)?;
        ensure!(reply["accepted"].is_null() && reply["by"].is_null(), "{reply}");
        let is_named = reply["reason"].as_str().is_some_and(|reason| reason.contains("controller"));
        ensure!(is_named && status == Some(1), "{reply}, {status:?}");
    }
    let mut up = Up::start(folder.path(), "local")?;
    up.wait_for_line("controller:", "Ready").await?;
    let (list, status) = json_of(&["detectors"], &meet)?;
    ensure!(list["controller"] == true && status == Some(0), "{list}, {status:?}");
    let (reply, status) = json_of(&["detectors", "prefer", "any"], &meet)?;
    ensure!(reply["accepted"] == true && status == Some(0), "{reply}, {status:?}");
    let (reply, status) = json_of(&["command", "resume"], &meet)?;
    ensure!(reply["accepted"] == false && reply["by"] == "controller", "{reply}");
    ensure!(status == Some(1), "{reply}, {status:?}");
    up.wait_for_line("controller:", "command=Resume").await?;
    ensure!(up.stop()? == Some(0));
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_end_during_a_landing_warns_of_the_vehicle_in_the_air() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    let folder = tempfile::tempdir()?;
    let meet = write_lone_controller(folder.path())?;
    for is_landing in [false, true] {
        let mut up = Up::start(folder.path(), "local")?;
        up.wait_for_line("controller:", "started as process").await?;
        if is_landing {
            let identity = Identity { service: "tester", instance: "main".into() };
            let network = Network { meet: Some(meet), ..Network::default() };
            let node = Node::open(identity, &network.source("controller")?).await?;
            let statuses = node.publisher(topic::STATUS, &[]).await?;
            let landing = ControllerStatus { started_ns: Some(1), ..ControllerStatus::default() };
            let note = || {
                std::fs::read_dir(folder.path()).map(|files| {
                    files
                        .flatten()
                        .any(|file| file.path().extension().is_some_and(|it| it == "landing"))
                })
            };
            let began = Instant::now();
            while !note()? && began.elapsed() < PATIENCE {
                statuses.publish(&landing).await;
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
            node.close().await;
        }
        ensure!(up.stop()? == Some(0));
        let warned = up.wait_for_line("The vehicle may be in the air", "the mode switch").await;
        ensure!(warned.is_ok() == is_landing, "{warned:?}");
    }
    Ok(())
}

#[test]
fn a_dry_run_prints_the_commands_and_an_error_is_named() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    write_site(folder.path())?;
    let output = alight(folder.path(), &["up", "drone", "--dry-run"])?;
    let text = String::from_utf8_lossy(&output.stdout);
    let commands: Vec<_> =
        text.lines().filter_map(|line| line.split("alight ").nth(1)?.split(' ').next()).collect();
    ensure!(commands == ["relay", "simulator", "detector", "controller"], "{text}");
    let output = alight(folder.path(), &["up", "relay", "--dry-run"])?;
    ensure!(output.status.success(), "{output:?}");
    // A command is taken by a shell as it is, anywhere.
    let own = r#"local = [{ command = ["sh", "-c", "echo it\\'s > said"] }]"#;
    std::fs::write(folder.path().join("site.toml"), own)?;
    let output = alight(folder.path(), &["up", "local", "--dry-run"])?;
    let pasted = output_of(Command::new("sh").arg("-c").arg(String::from_utf8(output.stdout)?))?;
    ensure!(pasted.status.success(), "{pasted:?}");
    ensure!(std::fs::read_to_string(folder.path().join("said"))? == "it's\n");
    let set = "\"source.command=['no-such-camera']\", \"source.size_px=[64, 48]\"";
    let camera = format!("[[local]]\nrun = 'camera-pub'\nset = [{set}]\n");
    std::fs::write(folder.path().join("site.toml"), camera)?;
    let output = alight(folder.path(), &["up", "local", "--dry-run"])?;
    let text = String::from_utf8_lossy(&output.stderr);
    let named = "camera-pub: there is no program `no-such-camera` in the PATH";
    ensure!(output.status.code() == Some(1) && text.contains(named), "{output:?}");
    let port =
        "[[local]]\nrun = 'controller'\nset = ['autopilot.address=serial:/dev/no-such:921600']\n";
    let device = "[[local]]\nrun = 'camera-pub'\nset = ['source.device=/dev/no-video', 'source.size_px=[64, 48]']\n";
    std::fs::write(folder.path().join("site.toml"), format!("{port}{device}"))?;
    let output = alight(folder.path(), &["up", "local", "--dry-run"])?;
    let text = String::from_utf8_lossy(&output.stderr);
    let are_named =
        text.contains("no device /dev/no-such") && text.contains("no device /dev/no-video");
    ensure!(output.status.code() == Some(1) && are_named, "{output:?}");
    ensure!(String::from_utf8_lossy(&output.stdout).lines().count() == 2, "{output:?}");
    let site = folder.path().join("site.toml");
    std::fs::write(&site, "[[local]]\nrun = 'detector'\n")?;
    let mut dry_run = Command::new(ALIGHT);
    dry_run.args(["up", "local", "--dry-run", "--config"]).arg(&site).env("ALIGHT_MEET", "7555");
    let output = output_of(&mut dry_run)?;
    let text = String::from_utf8_lossy(&output.stdout);
    let is_commented = text.starts_with("# the processes of this machine meet at port 7555");
    ensure!(output.status.success() && is_commented, "{output:?}");
    ensure!(text.contains("ALIGHT_MEET=7555"), "{text}");
    std::fs::write(&site, "[[drone]]\nrun = 'detectr'\n")?;
    let output = alight(folder.path(), &["up", "drone", "--dry-run"])?;
    let text = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.code() == Some(2) && text.contains("detectr"), "{output:?}");
    Ok(())
}

#[test]
fn a_camera_is_ready_once_its_first_frame_is_there() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let ([meet], _, _) = ports::free()?;
    let frames = "while [ ! -e go ]; do sleep 0.05; done; while :; do head -c 3072 /dev/urandom; sleep 0.1; done";
    let mut camera = Command::new(ALIGHT)
        .args(["camera-pub", "--set", &format!("source.command=['sh', '-c', '{frames}']")])
        .args(["--set", "source.size_px=[64, 48]", "--set", "source.rate_hz=10"])
        .args(["--set", "source.timeout_s=60", "--meet", &meet.to_string()])
        .current_dir(folder.path())
        .env("ALIGHT_LOG", "info")
        .stdin(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()?;
    let said = BufReader::new(camera.stderr.take().context("standard error")?).lines();
    let mut has_waited = false;
    let mut is_ready = false;
    for line in said.map_while(Result::ok) {
        println!("{line}");
        if line.contains("waiting for the first frame") {
            has_waited = true;
            std::fs::write(folder.path().join("go"), "")?;
        } else if line.contains("Ready") {
            is_ready = true;
            break;
        }
    }
    camera.kill()?;
    camera.wait()?;
    ensure!(has_waited && is_ready, "waited: {has_waited}, ready: {is_ready}");
    Ok(())
}

#[test]
fn a_camera_of_image_files_reports_once_that_it_is_ready() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let ([meet], _, _) = ports::free()?;
    image::GrayImage::new(64, 48).save(folder.path().join("frame.png"))?;
    let set = ["--set", "source.paths=['frame.png']", "--set", "source.wait_for_subscriber=false"];
    let output = Command::new(ALIGHT)
        .args(["camera-pub", "--set", "source.repeat=false", "--meet", &meet.to_string()])
        .args(set)
        .current_dir(folder.path())
        .env("ALIGHT_LOG", "info")
        .stdin(Stdio::null())
        .output()?;
    let text = String::from_utf8_lossy(&output.stderr);
    let times = text.matches("Ready").count();
    ensure!(output.status.success() && times == 1, "{output:?}");
    Ok(())
}

/// A web server, which answers after the first bytes of a client, until this is dropped.
struct WebServer {
    port: u16,
    ends: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl WebServer {
    fn start() -> anyhow::Result<Self> {
        let listener = TcpListener::bind("127.0.0.1:0")?;
        let port = listener.local_addr()?.port();
        let ends = Arc::new(AtomicBool::new(false));
        let asked = Arc::clone(&ends);
        let thread = std::thread::Builder::new().name("web server".into()).spawn(move || {
            for mut stream in listener.incoming().map_while(Result::ok) {
                if asked.load(Ordering::Relaxed) {
                    return;
                }
                // A client may disconnect at any time, or send nothing.
                let _ = stream.set_read_timeout(Some(Duration::from_millis(300)));
                let _ = stream.read(&mut [0; 256]);
                let _ = stream.write_all(b"HTTP/1.0 400 Bad request\r\n\r\n");
            }
        })?;
        Ok(Self { port, ends, thread: Some(thread) })
    }
}

impl Drop for WebServer {
    fn drop(&mut self) {
        self.ends.store(true, Ordering::Relaxed);
        // It accepts the next connection.
        drop(TcpStream::connect(("127.0.0.1", self.port)));
        drop(self.thread.take().map(JoinHandle::join));
    }
}

#[test]
fn another_program_where_tools_connect_is_reported_at_the_start() -> anyhow::Result<()> {
    let server = WebServer::start()?;
    let port = server.port.to_string();
    let address = format!("127.0.0.1:{port}");
    let folder = tempfile::tempdir()?;
    let file = folder.path().join("zenoh.json5").display().to_string();
    std::fs::write(&file, node::session::local_config(server.port))?;
    for (arguments, remedy) in [
        (&["detectors", "--meet", &port][..], "`--meet PORT`"),
        (&["command", "start", "--meet", &port], "`--meet PORT`"),
        (&["land", "--zenoh", &file], "the endpoints of the file"),
    ] {
        let begun = Instant::now();
        let output = output_of(Command::new(ALIGHT).args(arguments))?;
        let said = String::from_utf8_lossy(&output.stderr);
        println!("{:?} {arguments:?}: {said}", begun.elapsed());
        ensure!(output.status.code() == Some(1), "{arguments:?}: {output:?}");
        for part in [&address, "does not speak Zenoh", "HTTP/1.0 400", "ss -ltnp", remedy] {
            ensure!(said.contains(part), "`{part}` is not in {said}");
        }
    }
    Ok(())
}

/// A process that is killed at the end.
struct Service(Child);

impl Drop for Service {
    fn drop(&mut self) {
        // A supervisor ends its processes.
        let _ = kill_process(Pid::from_child(&self.0), Signal::TERM);
        let _ = self.0.wait();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn services_outlast_another_program_where_they_connect() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    services_outlast_it().await
}

async fn services_outlast_it() -> anyhow::Result<()> {
    let server = WebServer::start()?;
    let port = server.port;
    let folder = tempfile::tempdir()?;
    let site = folder.path().join("site.toml").display().to_string();
    std::fs::write(
        &site,
        format!("meet = {port}\n[[local]]\nrun = 'detector'\nset = ['id=supervised']\n"),
    )?;
    let meet = port.to_string();
    let ([], air, _) = ports::free()?;
    let listen = format!("127.0.0.1:{air}");
    let all = [
        &["up", "local", "--config", &site][..],
        &["detector", "--meet", &meet, "--set", "id=alone"],
        &["relay", "--meet", &meet, "--listen", &listen, "--insecure"],
    ];
    let mut services = Vec::new();
    for arguments in all {
        let child = Command::new(ALIGHT).args(arguments).stderr(Stdio::piped()).spawn()?;
        let mut service = Service(child);
        let mut lines = BufReader::new(service.0.stderr.take().context("standard error")?).lines();
        let (sender, mut said) = mpsc::unbounded_channel();
        std::thread::Builder::new().name("said".into()).spawn(move || {
            while let Some(Ok(line)) = lines.next() {
                println!("{line}");
                drop(sender.send(line));
            }
        })?;
        let reports = async {
            while let Some(line) = said.recv().await {
                if line.contains("ERROR") && line.contains("answers `HTTP/1.0 400") {
                    return Ok(());
                }
            }
            anyhow::bail!("{arguments:?} ended")
        };
        timeout(PATIENCE, reports).await??;
        services.push(service);
    }
    tokio::time::sleep(Duration::from_secs(1)).await;
    for (service, arguments) in services.iter_mut().zip(all) {
        ensure!(service.0.try_wait()?.is_none(), "{arguments:?} ended");
    }
    // The program ends, and they connect.
    drop(server);
    let network = Network { meet: Some(port), ..Network::default() };
    let identity = Identity { service: "alight", instance: "test".into() };
    let node = Node::open(identity, &network.source("operator")?).await?;
    let meet = async {
        loop {
            let peers = node.list_peers().await?;
            let is_there = |name: &str| peers.iter().any(|(_, instance)| instance == name);
            if is_there("alone") && is_there("supervised") {
                return anyhow::Ok(());
            }
        }
    };
    timeout(PATIENCE, meet).await.context("they never connect")??;
    Ok(())
}

#[test]
fn systemd_accepts_the_units() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let deploy = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy");
    let mut command = Command::new("systemd-analyze");
    command.arg("verify");
    for role in ["drone", "ground", "relay"] {
        let name = format!("alight-{role}.service");
        let unit = std::fs::read_to_string(deploy.join(&name))?;
        ensure!(unit.contains(&format!("/usr/local/bin/alight up {role} ")), "{unit}");
        // The end of one process is no end of the others.
        ensure!(unit.lines().any(|line| line == "OOMPolicy=continue"), "{unit}");
        // The notes for the case of a crash are kept if systemd does not start the unit again.
        let notes = unit.lines().find(|line| line.starts_with("RuntimeDirectoryPreserve="));
        ensure!(notes.is_none_or(|line| line.ends_with("=yes")), "{unit}");
        // It also checks whether the program exists.
        std::fs::write(folder.path().join(&name), unit.replace("/usr/local/bin/alight", ALIGHT))?;
        command.arg(folder.path().join(&name));
    }
    let Ok(output) = command.output() else {
        testing::skip("systemd-analyze", "it does not start");
        return Ok(());
    };
    let said = String::from_utf8_lossy(&output.stderr);
    println!("{said}");
    ensure!(!said.contains("alight-"), "{said}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_process_with_a_refused_configuration_is_given_up_at_once() -> anyhow::Result<()> {
    with_second_try(a_process_refuses_its_configuration).await
}

async fn a_process_refuses_its_configuration() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let site =
        "[[local]]\ncommand = ['sh', '-c', 'echo out of order >&2; exit 2']\nname = 'broken'\n";
    std::fs::write(folder.path().join("site.toml"), site)?;
    let mut up = Up::start(folder.path(), "local")?;
    up.wait_for_line("broken: out of order", "").await?;
    up.wait_for_line("broken", "given up").await?;
    let status = tokio::task::spawn_blocking(move || up.child.wait()).await??;
    ensure!(status.code() == Some(1), "{status}");
    Ok(())
}
