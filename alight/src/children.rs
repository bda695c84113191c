//! Child processes of a supervisor: starts services and other programs in process groups, forwards their lines of output,
//! reports how each exits, and stops them by SIGTERM, then SIGKILL.

use std::borrow::Cow;
use std::ffi::OsString;
use std::fmt;
use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use anyhow::Context;
use node::Network;
use rustix::process::{Pid, Signal, kill_process, kill_process_group};
use tokio::io::{AsyncBufReadExt, AsyncRead, AsyncReadExt, BufReader};
use tokio::process::{Child, Command};
use tokio::sync::mpsc;

use crate::services::Service;

/// Time that a child gets to stop after SIGTERM.
const STOP_TIMEOUT: Duration = Duration::from_secs(4);
/// Maximum number of queued output lines; further ones are dropped, so that a service never waits for a
/// terminal.
const MAX_QUEUED_LINES: usize = 256;
/// Longest piece of a line, in bytes.
const MAX_LINE_BYTES: u64 = 16 * 1024;
/// Time in which the last lines of a child are read that has ended.
const LAST_LINES: Duration = Duration::from_millis(200);

/// A restarted controller resumes the landing, and never takes off a second time.
const RESUME: &str = "start=\"resume\"";

/// An event of a child.
pub(crate) enum ChildEvent<K> {
    /// A line on its standard output or error.
    Line(K, String),
    /// Its exit.
    Exited(K, Exit),
}

/// How a child exited.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Exit {
    /// The description by the system.
    pub(crate) words: String,
    /// Its exit status, unless a signal ended it.
    pub(crate) status: Option<i32>,
}

impl fmt::Display for Exit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.words)
    }
}

/// A service that was started.
pub(crate) struct Started {
    service: Service,
    number: i32,
    /// The command that starts it again.
    pub(crate) by_hand: String,
}

impl fmt::Display for Started {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { service, number, by_hand } = self;
        write!(f, "{} is process {number}; by hand: {by_hand}", service.name())
    }
}

/// Takes the network of this process's environment out of a child's: it may be another one than the child is to join.
pub(crate) fn without_network(command: &mut Command) {
    for name in node::network::variable::ALL {
        command.env_remove(name);
    }
}

/// Which processes of a child's group are asked to stop; all that is left of it in the end is killed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Reach {
    /// The child, which stops the processes that it started.
    Leader,
    /// All: a script may have started the program that is meant.
    Group,
}

/// The running children, by key.
pub(crate) struct Children<K> {
    pids: Vec<(K, Pid, Reach)>,
    sender: mpsc::Sender<ChildEvent<K>>,
    events: mpsc::Receiver<ChildEvent<K>>,
}

/// The options with which a service joins a network.
fn options(network: &Network) -> Vec<OsString> {
    let named = [
        ("--zenoh", network.config.clone().map(Into::into)),
        ("--meet", network.meet.map(|port| port.to_string().into())),
        ("--vehicle", network.vehicle.clone().map(Into::into)),
    ];
    let given = named.into_iter().filter_map(|(name, value)| Some([name.into(), value?]));
    given.flatten().collect()
}

/// The same for a shell.
pub(crate) fn options_for_shell(network: &Network) -> String {
    let words: Vec<_> = options(network).iter().map(|it| word(&it.to_string_lossy())).collect();
    words.join(" ")
}

impl Children<Service> {
    /// Starts a service as a process of this program; `state` is where it keeps its notes, if not at the usual place.
    pub(crate) fn start(
        &mut self,
        service: Service,
        network: &Network,
        settings: &[String],
        state: Option<&Path>,
    ) -> anyhow::Result<Started> {
        let mut command = Command::new(node::own_program());
        command.arg(service.name()).args(options(network));
        command.arg("--stop-with-parent").arg(std::process::id().to_string());
        without_network(&mut command);
        if let Some(state) = state {
            command.env(node::STATE_VARIABLE, state);
        }
        for setting in settings {
            command.arg("--set").arg(setting);
        }
        if std::env::var_os("ALIGHT_LOG").is_none() {
            command.env("ALIGHT_LOG", "warn");
        }
        let number = self.spawn(service, command, service.name(), Reach::Leader)?;
        Ok(Started { service, number, by_hand: by_hand(service, network, settings, state) })
    }
}

/// The command that starts a service again.
fn by_hand(
    service: Service,
    network: &Network,
    settings: &[String],
    state: Option<&Path>,
) -> String {
    let mut command = String::new();
    if let Some(state) = state {
        command = format!("{}={} ", node::STATE_VARIABLE, for_shell(state));
    }
    command.push_str(&format!("alight {} {}", service.name(), options_for_shell(network)));
    let is_start =
        |setting: &str| setting.split('=').next().is_some_and(|key| key.trim() == "start");
    let mut set = |setting: &str| command.push_str(&format!(" --set {}", word(setting)));
    if service == Service::Controller {
        settings.iter().filter(|setting| !is_start(setting)).for_each(|setting| set(setting));
        set(RESUME);
    } else {
        settings.iter().for_each(|setting| set(setting));
    }
    command
}

/// A path as a shell takes it for one word.
pub(crate) fn for_shell(path: &Path) -> String {
    word(&path.to_string_lossy())
}

/// This command, as a shell takes it.
pub(crate) fn this_command() -> String {
    let words = std::env::args_os().skip(1).map(|argument| word(&argument.to_string_lossy()));
    std::iter::once("alight".to_owned()).chain(words).collect::<Vec<_>>().join(" ")
}

/// A text as a shell takes it for one word.
pub(crate) fn word(text: &str) -> String {
    // Only a zero byte cannot be quoted, and no argument has one.
    shlex::try_quote(text).map_or_else(|_| text.to_owned(), Cow::into_owned)
}

impl<K: Clone + PartialEq + Send + 'static> Children<K> {
    pub(crate) fn new() -> Self {
        let (sender, events) = mpsc::channel(MAX_QUEUED_LINES);
        Self { pids: Vec::new(), sender, events }
    }

    /// Starts a child; returns its process number.
    pub(crate) fn spawn(
        &mut self,
        key: K,
        mut command: Command,
        name: &str,
        reach: Reach,
    ) -> anyhow::Result<i32> {
        let child = command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .kill_on_drop(true)
            // Ctrl-C in a terminal is for this process, which stops them in their order.
            .process_group(0)
            .spawn()
            .with_context(|| format!("starting {name}"))?;
        let pid = child.id().and_then(|id| i32::try_from(id).ok()).and_then(Pid::from_raw);
        self.pids.extend(pid.map(|pid| (key.clone(), pid, reach)));
        tokio::spawn(follow(key, child, pid, self.sender.clone()));
        Ok(pid.map_or(0, |pid| pid.as_raw_nonzero().get()))
    }

    /// The next event.
    pub(crate) async fn next(&mut self) -> Option<ChildEvent<K>> {
        self.events.recv().await
    }

    /// Removes a child that has exited.
    pub(crate) fn remove(&mut self, key: &K) {
        self.pids.retain(|(running, ..)| running != key);
    }

    /// Stops a child, by SIGKILL if it ignores SIGTERM; events until then go to `on_event`.
    pub(crate) async fn stop_one(&mut self, key: &K, on_event: impl FnMut(&ChildEvent<K>)) {
        self.stop_those(|running| running == key, on_event).await;
    }

    /// Stops all children, by SIGKILL those that ignore SIGTERM; events until then go to `on_event`.
    pub(crate) async fn stop(mut self, on_event: impl FnMut(&ChildEvent<K>)) {
        self.stop_those(|_| true, on_event).await;
    }

    /// The same, but one.
    pub(crate) async fn stop_all_but(&mut self, key: &K, on_event: impl FnMut(&ChildEvent<K>)) {
        self.stop_those(|running| running != key, on_event).await;
    }

    async fn stop_those(
        &mut self,
        is_stopped: impl Fn(&K) -> bool,
        mut on_event: impl FnMut(&ChildEvent<K>),
    ) {
        for signal in [Signal::TERM, Signal::KILL] {
            for (_, pid, reach) in self.pids.iter().filter(|(running, ..)| is_stopped(running)) {
                // Fails when the child has exited already.
                let _ = match (signal, reach) {
                    (Signal::TERM, Reach::Leader) => kill_process(*pid, signal),
                    _ => kill_process_group(*pid, signal),
                };
            }
            let all_exited = async {
                while self.pids.iter().any(|(running, ..)| is_stopped(running)) {
                    let Some(event) = self.events.recv().await else { return };
                    on_event(&event);
                    if let ChildEvent::Exited(ended, _) = event {
                        self.remove(&ended);
                    }
                }
            };
            if tokio::time::timeout(STOP_TIMEOUT, all_exited).await.is_ok() {
                return;
            }
        }
    }
}

/// Sends the output lines of a child, and its exit when it has ended. Processes that it started and left behind are ended then. Otherwise
/// they would keep the child's name and devices while the next one is started.
async fn follow<K: Clone>(
    key: K,
    mut child: Child,
    pid: Option<Pid>,
    events: mpsc::Sender<ChildEvent<K>>,
) {
    let (stdout, stderr) = (child.stdout.take(), child.stderr.take());
    let out = forward(key.clone(), stdout, events.clone());
    let err = forward(key.clone(), stderr, events.clone());
    let lines = async { tokio::join!(out, err) };
    tokio::pin!(lines);
    let ended = tokio::select! {
        ended = child.wait() => {
            // A process that still has the child's standard output or error open was started by the child.
            let left = tokio::time::timeout(LAST_LINES, &mut lines).await.is_err();
            if let Some(pid) = pid.filter(|_| left) {
                let _ = kill_process_group(pid, Signal::KILL);
            }
            ended
        }
        _ = &mut lines => child.wait().await,
    };
    let exit = match ended {
        Ok(status) => Exit { words: status.to_string(), status: status.code() },
        Err(cause) => Exit { words: cause.to_string(), status: None },
    };
    // There is no receiver left when all children are being stopped.
    drop(events.send(ChildEvent::Exited(key, exit)).await);
}

/// Sends the lines of a child, in any encoding; a very long one in pieces.
async fn forward<K: Clone>(
    key: K,
    output: Option<impl AsyncRead + Unpin>,
    events: mpsc::Sender<ChildEvent<K>>,
) {
    let Some(output) = output else { return };
    let mut output = BufReader::new(output);
    let (mut line, mut dropped) = (Vec::new(), 0_u64);
    loop {
        line.clear();
        let mut piece = (&mut output).take(MAX_LINE_BYTES);
        if !matches!(piece.read_until(b'\n', &mut line).await, Ok(1..)) {
            return;
        }
        let text = String::from_utf8_lossy(&line);
        let text = text.trim_end_matches(['\n', '\r']);
        let text = match dropped {
            0 => text.to_owned(),
            _ => format!("({dropped} lines dropped) {text}"),
        };
        let sent = events.try_send(ChildEvent::Line(key.clone(), text));
        dropped = if sent.is_ok() { 0 } else { dropped + 1 };
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;

    /// The lines and the exit of a shell script, and how long it took.
    async fn run(script: &str) -> (Vec<String>, Exit, Duration) {
        let mut children = Children::new();
        let mut command = Command::new("sh");
        command.args(["-c", script]);
        let began = Instant::now();
        children.spawn((), command, "sh", Reach::Group).unwrap();
        let mut lines = Vec::new();
        loop {
            match children.next().await.unwrap() {
                ChildEvent::Line((), line) => lines.push(line),
                ChildEvent::Exited((), exit) => return (lines, exit, began.elapsed()),
            }
        }
    }

    #[tokio::test]
    async fn the_exit_of_a_child_is_noticed_while_its_own_child_runs_and_that_one_is_ended() {
        let (lines, exit, took) = run("sleep 600 & echo $! >&2; exit 3").await;
        assert_eq!(exit.status, Some(3));
        assert!(took < Duration::from_secs(20), "{took:?}");
        let left: i32 = lines[0].parse().unwrap();
        let status = format!("/proc/{left}/status");
        let is_running = || {
            let status = std::fs::read_to_string(&status).unwrap_or_default();
            status.contains("State:") && !status.contains("State:\tZ")
        };
        let ends = format!("process {left} ends");
        testing::until(&ends, Duration::from_secs(20), async || !is_running()).await.unwrap();
    }

    #[tokio::test]
    async fn a_line_in_another_encoding_or_without_an_end_is_passed_on_like_others() {
        let script = r"printf '\377caf\351\n' >&2; echo there still >&2; head -c 40000 /dev/zero | tr '\0' x >&2";
        let (lines, exit, _) = run(script).await;
        assert_eq!(exit.status, Some(0));
        assert_eq!(lines[..2], ["\u{fffd}caf\u{fffd}", "there still"]);
        let lengths: Vec<_> = lines[2..].iter().map(String::len).collect();
        assert_eq!(lengths, [16 * 1024, 16 * 1024, 40_000 - 32 * 1024]);
    }

    #[tokio::test]
    async fn lines_of_both_outputs_are_passed_on() {
        let (mut lines, exit, _) = run("echo out; echo err >&2; exit 3").await;
        lines.sort();
        assert_eq!((lines, exit.status), (vec!["err".to_owned(), "out".to_owned()], Some(3)));
    }

    #[tokio::test]
    async fn a_program_behind_a_script_is_asked_to_stop() {
        let mut children = Children::new();
        let mut command = Command::new("sh");
        command.args([
            "-c",
            "sh -c 'trap \"echo asked >&2; exit 0\" TERM; echo ready >&2; sleep 600 & wait'; true",
        ]);
        children.spawn(1, command, "sh", Reach::Group).unwrap();
        let is_line = |event: &ChildEvent<i32>, text| matches!(event, ChildEvent::Line(_, line) if line == text);
        while !is_line(&children.next().await.unwrap(), "ready") {}
        let mut was_asked = false;
        children.stop(|event| was_asked |= is_line(event, "asked")).await;
        assert!(was_asked);
    }

    #[test]
    fn a_path_is_one_word_of_a_shell() {
        assert_eq!(for_shell(Path::new("a/zenoh.json5")), "a/zenoh.json5");
        for path in ["my flights/zenoh.json5", "it's/$HOME"] {
            assert_eq!(shlex::split(&for_shell(Path::new(path))), Some(vec![path.to_owned()]));
        }
    }

    #[test]
    fn the_command_by_hand_has_each_setting_as_it_was_given() {
        let settings = ["id=\"it's $HOME\"", "start=\"airborne\"", "file=/a b"].map(str::to_owned);
        let config = Some("my flights/zenoh.json5".into());
        let network = Network { config, ..Network::default() };
        let words = |service| shlex::split(&by_hand(service, &network, &settings, None)).unwrap();
        let start = ["alight", "detector", "--zenoh", "my flights/zenoh.json5"];
        let set = settings.each_ref().map(|setting| ["--set", setting]);
        assert_eq!(words(Service::Detector), [&start[..], &set.concat()].concat());
        // A controller resumes, however it was started.
        let words = words(Service::Controller);
        assert_eq!(words[4..], ["--set", &settings[0], "--set", &settings[2], "--set", RESUME]);
        let with_notes = by_hand(Service::Detector, &network, &[], Some(Path::new("a b")));
        let elsewhere =
            Network { meet: Some(28_111), vehicle: Some("kestrel".into()), ..network.clone() };
        let options = "--zenoh 'my flights/zenoh.json5' --meet 28111 --vehicle kestrel";
        assert_eq!(
            by_hand(Service::Detector, &elsewhere, &[], None),
            format!("alight detector {options}")
        );
        assert!(with_notes.starts_with(&format!("{}='a b' alight ", node::STATE_VARIABLE)));
    }
}
