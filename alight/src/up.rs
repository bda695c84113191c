//! `alight up ROLE`: supervises the processes that a site has for one machine: starts them in order, restarts each that exits after a
//! growing pause, and stops them in reverse order.

use std::collections::VecDeque;
use std::ffi::OsStr;
use std::io::ErrorKind;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context, anyhow, bail};
use clap::Args;
use node::Shutdown;
use tokio::process::Command;
use tokio::time::{Instant, MissedTickBehavior};

use crate::children::{ChildEvent, Children, Exit, Reach, for_shell, without_network, word};
use crate::interruption::IN_THE_AIR;
use crate::notes::{Note, Notes};
use crate::peers::{Peers, Replacement, STALE_AFTER};
use crate::programs::{OWN_PROGRAM, missing, missing_devices, missing_of_service};
use crate::runtime::block_on;
use crate::services::Service;
use crate::site::{Job, Role, Site};
use crate::terminal::print;

/// The arguments of `alight up`.
#[derive(Args, Clone)]
pub(crate) struct UpArgs {
    /// Role of this machine.
    #[arg(value_enum)]
    role: Role,
    /// The site: which processes run on which machine (TOML, `docs/deploy.md`).
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Print the processes without starting them. Missing items are named, with exit status 1: a program (also one that reads a
    /// camera), the autopilot's serial port, a camera's device, images, a calibration, a key for signed packets (also one that is open to
    /// other users), a detector that looks for the controller's marker.
    #[arg(long)]
    dry_run: bool,
}

/// Pause before a process is restarted; doubled with each further exit within [`PERIOD`].
const MIN_PAUSE: Duration = Duration::from_millis(500);
const MAX_PAUSE: Duration = Duration::from_secs(8);
/// A process that exits this many times within [`PERIOD`] keeps failing, until it has run for that long.
const MAX_EXITS: usize = 6;
const PERIOD: Duration = Duration::from_secs(60);
/// Pause before the restart of a process that keeps failing: a missing device, as a camera, may return.
const LONG_PAUSE: Duration = Duration::from_secs(30);
/// Interval at which the note is written again that this program runs.
const RENEWAL: Duration = Duration::from_secs(60);
/// A running process that has published no health for this long is reported; each service publishes it once a second.
const SILENCE: Duration = Duration::from_secs(10);
/// Period at which the health of the processes is checked.
const HEALTH_PERIOD: Duration = Duration::from_secs(1);
/// The variable with which Python writes each line at once, as to a terminal; its lines would come when the program ends.
const PYTHON_UNBUFFERED: &str = "PYTHONUNBUFFERED";
/// The exit status for an invalid configuration, with which a restart is useless.
const WRONG_USE: i32 = 2;

/// Runs a role until it is asked to stop, or until no process runs and each has been given up or keeps failing.
pub(crate) fn run(args: &UpArgs) -> anyhow::Result<ExitCode> {
    let site = Site::read(&args.config)?;
    let jobs = site.jobs(args.role)?;
    if let Some(note) = &site.meet_note {
        // A shell to which the commands of a dry run are given takes it as a comment.
        say(&format!("{}{note}", if args.dry_run { "# " } else { "" }));
    }
    if args.dry_run {
        // Paths in a site are relative to its folder.
        let is_here = std::env::current_dir().is_ok_and(|here| here == site.folder);
        let go_there = match is_here {
            true => String::new(),
            false => format!("cd {} && ", for_shell(&site.folder)),
        };
        for job in &jobs {
            say(&format!("{go_there}{}", by_hand(job)));
        }
    }
    let search = std::env::var_os("PATH").unwrap_or_default();
    let marker_problem = site.marker_problem(args.role);
    if args.dry_run {
        return report_missing(&jobs, &site.folder, &search, marker_problem);
    }
    // Another detector may be started by hand, and a landing that finds none is refused.
    if let Some(problem) = marker_problem {
        say(&format!("warning: {problem}"));
    }
    // In the air the other processes continue without a camera; camera-pub reports the missing device or program, and is started again.
    if let Some(problem) = jobs.iter().find_map(|job| missing(job, &site.folder, &search)) {
        bail!(problem);
    }
    let _only = only_supervisor(&site.instance(args.role))?;
    node::start_logging("warn");
    block_on(supervise(&site, args.role, jobs))?
}

/// Reports everything that the processes need and this machine lacks, and that no detector looks for the controller's marker.
fn report_missing(
    jobs: &[Job],
    folder: &Path,
    search: &OsStr,
    marker_problem: Option<String>,
) -> anyhow::Result<ExitCode> {
    let of_job = |job: &Job| {
        let programs = [missing(job, folder, search), missing_of_service(job, folder, search)];
        programs.into_iter().flatten().chain(missing_devices(job, folder)).collect::<Vec<_>>()
    };
    let lacking: Vec<String> = jobs.iter().flat_map(of_job).chain(marker_problem).collect();
    match lacking.split_last() {
        None => Ok(ExitCode::SUCCESS),
        Some((last, [])) => bail!(last.clone()),
        Some(_) => {
            bail!("{} things are missing or wrong:\n  {}", lacking.len(), lacking.join("\n  "))
        }
    }
}

/// Takes the place of the only supervisor with this name, until the returned value is dropped: a second one would start every process again
/// in parallel to those of the first. It is a name in the kernel, of the same scope as the port at which processes meet (a network
/// namespace), and gone with the process that has it.
fn only_supervisor(name: &str) -> anyhow::Result<UnixListener> {
    let address = SocketAddr::from_abstract_name(format!("alight-up-{name}"))?;
    UnixListener::bind_addr(&address).map_err(|problem| match problem.kind() {
        ErrorKind::AddrInUse => anyhow!(
            "an `alight up` of this role, vehicle and port ({name}) runs on this machine already; stop that one first, or give this \
             site a `vehicle` or `meet` of its own"
        ),
        _ => anyhow!("taking the name of the supervisor {name}: {problem}"),
    })
}

/// Prints a line. A failure is ignored: the supervisor continues without a terminal.
fn say(line: &str) {
    drop(print(line));
}

/// The equivalent command line for a shell in the site's folder.
fn by_hand(job: &Job) -> String {
    let environment = job.network.environment();
    let environment = environment
        .iter()
        .map(|(name, value)| format!("{name}={}", word(&value.to_string_lossy())));
    let arguments = arguments(job).into_iter().map(|argument| word(&argument));
    let words: Vec<_> = environment.chain(arguments).collect();
    words.join(" ")
}

/// The program and its arguments.
pub(crate) fn arguments(job: &Job) -> Vec<String> {
    let mut arguments = job.command.clone();
    if let Some(file) = &job.layers.file {
        arguments.extend(["--config".to_owned(), file.display().to_string()]);
    }
    for setting in &job.layers.set {
        arguments.extend(["--set".to_owned(), setting.clone()]);
    }
    arguments
}

/// A process and its history.
struct Supervised {
    job: Job,
    /// Its process number, once started.
    pid: i32,
    /// When it was started the last time.
    started: Instant,
    exits: VecDeque<Instant>,
    /// How often in a row it exited with status 0.
    completions: usize,
    /// Whether it has once run for [`PERIOD`], or led a landing under a supervisor that crashed: its configuration is valid then.
    has_run: bool,
    keeps_failing: bool,
    /// Whether it is reported that its process publishes no health.
    is_silent: bool,
    state: State,
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum State {
    Running,
    /// To be restarted at this time.
    Waiting(Instant),
    /// A detector that was stopped in favour of this one, and is restarted when that is gone and no later one has
    /// its place.
    Replaced(Replacement),
    GivenUp,
}

impl Supervised {
    fn new(job: Job) -> Self {
        Self {
            job,
            pid: 0,
            started: Instant::now(),
            exits: VecDeque::new(),
            completions: 0,
            has_run: false,
            keeps_failing: false,
            is_silent: false,
            state: State::Running,
        }
    }

    /// Takes the time at which the health of its process was received last; returns the message to show. A process that has published none
    /// since its start is still starting.
    fn on_health(&mut self, last: Option<Instant>, now: Instant) -> Option<String> {
        let last = last.filter(|last| self.state == State::Running && *last >= self.started)?;
        let is_silent = now.duration_since(last) >= SILENCE;
        if is_silent == std::mem::replace(&mut self.is_silent, is_silent) {
            return None;
        }
        let (name, pid) = (&self.job.name, self.pid);
        Some(match is_silent {
            true => format!(
                "{name}: process {pid} runs, but has published no health for {} s: it hangs or is stopped (`ps -o stat= -p {pid}` shows T then). \
                 `kill -9 {pid}` ends it, and it is restarted",
                SILENCE.as_secs()
            ),
            false => format!("{name}: process {pid} publishes its health again"),
        })
    }

    /// Whether it is a program that is none of ours: one may do its work once.
    fn is_foreign(&self) -> bool {
        self.job.service.is_none() && self.job.command.first().is_none_or(|it| it != OWN_PROGRAM)
    }

    /// Whether it does not run, and is not likely to.
    fn is_out(&self) -> bool {
        match self.state {
            State::GivenUp => true,
            State::Waiting(_) => self.keeps_failing,
            State::Running | State::Replaced(_) => false,
        }
    }

    /// Handles the regular exit of a detector for which another one was swapped in; returns the message to
    /// show, `None` for any other process and any other exit.
    fn on_replaced(&mut self, exit: &Exit, peers: &Peers, own: &[i32]) -> Option<String> {
        let by = peers.replacement(self.pid, own).filter(|_| exit.status == Some(0))?;
        let name = &self.job.name;
        let message = format!(
            "{name}: stopped and replaced by the detector `{}`; restarted when that one is gone",
            by.name
        );
        self.state = State::Replaced(by);
        Some(message)
    }

    /// Handles the exit of a process; returns the message to show.
    fn on_exit(&mut self, exit: &Exit, now: Instant) -> String {
        self.exits.push_back(now);
        self.exits.retain(|exit| now.duration_since(*exit) <= PERIOD);
        self.completions = if exit.status == Some(0) { self.completions + 1 } else { 0 };
        let has_run_long = now.duration_since(self.started) >= PERIOD;
        self.has_run |= has_run_long;
        let name = &self.job.name;
        // A process that has run may be refused for a moment, as while its keys are copied, and in flight it has to return.
        if exit.status == Some(WRONG_USE) && !self.has_run {
            self.state = State::GivenUp;
            return format!(
                "{name}: cannot run with its configuration ({exit}); given up. See its stderr above, then restart `alight up`"
            );
        }
        let kept_failing = self.keeps_failing && !has_run_long;
        self.keeps_failing = kept_failing || self.exits.len() >= MAX_EXITS;
        if self.keeps_failing && self.is_foreign() && self.completions >= MAX_EXITS {
            self.state = State::GivenUp;
            return format!(
                "{name}: exited {MAX_EXITS} times in a row with status 0, so it seems to be done; given up. Restart `alight up` to run it again"
            );
        }
        if self.keeps_failing {
            self.state = State::Waiting(now + LONG_PAUSE);
            let pause_s = LONG_PAUSE.as_secs();
            return match kept_failing {
                true => format!("{name}: exited with {exit}; restarting in {pause_s} s"),
                false => format!(
                    "{name}: exited {MAX_EXITS} times within {} s, last with {exit}; restarting every {pause_s} s from now on, while another process \
                     runs. See its stderr above",
                    PERIOD.as_secs()
                ),
            };
        }
        let doublings = u32::try_from(self.exits.len()).unwrap_or(u32::MAX).saturating_sub(1);
        let pause = (MIN_PAUSE * 2_u32.saturating_pow(doublings)).min(MAX_PAUSE);
        self.state = State::Waiting(now + pause);
        format!("{name}: exited with {exit}; restarting in {} s", pause.as_secs_f64())
    }
}

async fn supervise(site: &Site, role: Role, jobs: Vec<Job>) -> anyhow::Result<ExitCode> {
    let shutdown = Shutdown::on_signals()?;
    let notes = Notes::of_supervisor(&site.instance(role));
    let before = Before::noted_in(&notes);
    let mut peers = follow_peers(site, role, &jobs, &notes.landing, before).await?;
    // Joining the network may have taken long.
    let before = before.by_now(peers.landing());
    let mut children = Children::new();
    let is_noted = notes.running.write();
    for line in jobs.iter().filter_map(|job| before.start_message(job, is_noted)) {
        say(line);
    }
    // Those of a landing that was under way have run.
    let have_run = matches!(before, Before::Landing { .. });
    let mut supervised: Vec<Supervised> = jobs
        .into_iter()
        .map(|job| Supervised { has_run: have_run, ..Supervised::new(job) })
        .collect();
    for (index, first) in supervised.iter_mut().enumerate() {
        let start_as = before.start_mode(&first.job);
        start_or_retry(&mut children, index, first, start_as, site);
    }
    let all_are_out =
        watch(&mut children, &mut supervised, &mut peers, &notes.running, site, &shutdown).await?;
    let runs = |service| supervised.iter().any(|it| it.job.service == Some(service));
    let may_be_in_the_air = runs(Service::Controller) && peers.may_be_in_the_air();
    let is_simulated = runs(Service::Simulator);
    say("stopping");
    // In reverse order: the controller stops while its peers can still receive its last messages.
    for (index, stopped) in supervised.iter().enumerate().rev() {
        children.stop_one(&index, |event| show(&supervised, event)).await;
        if stopped.state == State::Running {
            say(&format!("{}: stopped", stopped.job.name));
        }
    }
    // The peers are closed first, as they write the note of a landing too. The loss of a terminal is no request to remove notes.
    peers.close().await;
    if !shutdown.is_by_hangup() {
        notes.landing.remove();
        // A supervisor such as systemd restarts this program after a failure, and then nothing may take off.
        if !all_are_out {
            notes.running.remove();
        }
    }
    match (may_be_in_the_air, is_simulated) {
        (true, false) => say(IN_THE_AIR),
        (true, true) => say(&format!(
            "The simulated landing was not over. With a real vehicle this warning follows: {IN_THE_AIR}"
        )),
        (false, _) => {}
    }
    Ok(ExitCode::from(u8::from(all_are_out)))
}

/// How the supervisor before this one ended, by its notes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Before {
    /// Nothing, or an orderly stop.
    Nothing,
    /// It was killed, it failed, or its terminal was closed.
    Crash,
    /// The same during a landing, which was under way a moment ago.
    Landing { last: Instant },
}

impl Before {
    fn noted_in(notes: &Notes) -> Self {
        let age = notes.landing.age().filter(|age| *age < STALE_AFTER);
        match age.and_then(|age| Instant::now().checked_sub(age)) {
            Some(last) => Self::Landing { last },
            None if notes.running.is_there() => Self::Crash,
            None => Self::Nothing,
        }
    }

    /// The same once it is known whether the landing can still be resumed.
    fn by_now(self, landing: bool) -> Self {
        match self {
            Self::Landing { .. } if !landing => Self::Crash,
            _ => self,
        }
    }

    /// When the landing was under way the last time.
    fn under_way(self) -> Option<Instant> {
        match self {
            Self::Landing { last } => Some(last),
            Self::Nothing | Self::Crash => None,
        }
    }

    /// The mode of a process's first start; `None` for the `start` of the site. A crash restarts the controller like any other of its ends.
    fn start_mode(self, job: &Job) -> Option<&'static str> {
        match self {
            Self::Nothing => None,
            Self::Crash => start_mode(job, false),
            Self::Landing { .. } => start_mode(job, true),
        }
    }

    /// The message to show about it before a process is started.
    fn start_message(self, job: &Job, is_noted: bool) -> Option<&'static str> {
        if job.service != Some(Service::Controller) {
            return None;
        }
        match self {
            Self::Nothing if !is_noted && starts_without_command(job) => Some(
                "a crash of this `alight up` cannot be noted, and after one its controller would begin again as its `start` specifies: set \
                 $RUNTIME_DIRECTORY to a directory that exists, has room, and to which only this user can write",
            ),
            Self::Nothing => None,
            Self::Crash => Some(
                "the `alight up` before this one was killed or failed, or its terminal was closed: the controller waits for a command and starts no motors, whatever its \
                 `start` says. It follows that after an orderly stop (Ctrl-C) and another start",
            ),
            Self::Landing { .. } => Some("a landing was interrupted a moment ago; resuming it"),
        }
    }
}

/// Whether a controller takes off or lands without a command.
fn starts_without_command(job: &Job) -> bool {
    let config = job.service.and_then(|service| service.effective_config(&job.layers).ok());
    let start = config.as_ref().and_then(|config| config.get("start")?.as_str());
    matches!(start, Some("takeoff" | "airborne"))
}

/// Follows the peers on which restarts depend.
async fn follow_peers(
    site: &Site,
    role: Role,
    jobs: &[Job],
    landing: &Note,
    before: Before,
) -> anyhow::Result<Peers> {
    let job_of = |service| jobs.iter().find(|job| job.service == Some(service));
    // Only the supervisor of the controller notes its landings.
    let (key, note) = match (job_of(Service::Controller), job_of(Service::Detector)) {
        (Some(controller), _) => (&controller.key, landing.clone()),
        (None, Some(detector)) => (&detector.key, Note::default()),
        (None, None) => return Ok(Peers::none()),
    };
    Peers::follow(&site.network(role), key, note, before.under_way()).await
}

/// Restarts processes that exit; returns false on a shutdown request, true when none runs, and each has been given up or keeps failing.
async fn watch(
    children: &mut Children<usize>,
    supervised: &mut [Supervised],
    peers: &mut Peers,
    running: &Note,
    site: &Site,
    shutdown: &Shutdown,
) -> anyhow::Result<bool> {
    let mut renewal = tokio::time::interval_at(Instant::now() + RENEWAL, RENEWAL);
    let mut last_check = Instant::now();
    let mut check = tokio::time::interval(HEALTH_PERIOD);
    check.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        if all_are_out(supervised) {
            say("no process runs, and none is likely to: ending with an error");
            return Ok(true);
        }
        let due = supervised.iter().enumerate().filter_map(|(index, s)| match s.state {
            State::Waiting(at) => Some((at, index)),
            State::Running | State::Replaced(_) | State::GivenUp => None,
        });
        let next = due.min();
        let next_start = tokio::time::sleep_until(next.map_or_else(far_away, |(at, _)| at));
        tokio::select! {
            () = shutdown.requested() => return Ok(false),
            Some(event) = children.next() => {
                show(supervised, &event);
                if let ChildEvent::Exited(index, exit) = event {
                    children.remove(&index);
                    let own = pids(supervised);
                    if let Some(exited) = supervised.get_mut(index) {
                        let message = exited.on_replaced(&exit, peers, &own);
                        say(&message.unwrap_or_else(|| exited.on_exit(&exit, Instant::now())));
                    }
                }
            }
            () = peers.changed() => restart_unreplaced(supervised, peers),
            // The first one may have found no room, or was removed; a failure is in the log.
            _ = renewal.tick() => { running.write(); }
            _ = check.tick() => {
                let now = Instant::now();
                // If this process was stopped, the healths of that time are still queued.
                let is_late = now.duration_since(std::mem::replace(&mut last_check, now)) > 2 * HEALTH_PERIOD;
                for process in supervised.iter_mut().filter(|_| !is_late) {
                    let last = peers.last_health(process.pid);
                    process.on_health(last, now).iter().for_each(|line| say(line));
                }
            }
            () = next_start => {
                let Some((_, index)) = next else { continue };
                let Some(again) = supervised.get_mut(index) else { continue };
                let start_as = start_mode(&again.job, peers.landing());
                start_or_retry(children, index, again, start_as, site);
            }
        }
    }
}

fn all_are_out(supervised: &[Supervised]) -> bool {
    supervised.iter().all(Supervised::is_out)
}

fn pids(supervised: &[Supervised]) -> Vec<i32> {
    supervised.iter().map(|s| s.pid).collect()
}

/// Restarts the replaced detectors whose replacement is gone, unless a later one has taken its place.
fn restart_unreplaced(supervised: &mut [Supervised], peers: &Peers) {
    let own = pids(supervised);
    for replaced in supervised {
        let State::Replaced(by) = &replaced.state else { continue };
        let name = &replaced.job.name;
        replaced.state = match peers.successor(by, &own) {
            Some(same) if same == *by => continue,
            Some(next) => {
                say(&format!(
                    "{name}: the detector `{}` has taken the place of its replacement",
                    next.name
                ));
                State::Replaced(next)
            }
            None => {
                say(&format!("{name}: its replacement is gone; restarting"));
                State::Waiting(Instant::now())
            }
        };
    }
}

/// The start mode of a restarted controller. It never takes off a second time, and it resumes only a landing
/// that was under way: a vehicle that another program flies in GUIDED is not landed.
fn start_mode(job: &Job, landing: bool) -> Option<&'static str> {
    let is_controller = job.service == Some(Service::Controller);
    is_controller.then_some(if landing { "resume" } else { "command" })
}

fn far_away() -> Instant {
    Instant::now() + Duration::from_secs(3600)
}

/// Shows an output line of a child.
fn show(supervised: &[Supervised], event: &ChildEvent<usize>) {
    if let ChildEvent::Line(index, line) = event
        && let Some(child) = supervised.get(*index)
    {
        say(&format!("{}: {line}", child.job.name));
    }
}

/// Starts a process. A failure counts as one of its ends: the others continue, and so do the attempts.
fn start_or_retry(
    children: &mut Children<usize>,
    index: usize,
    process: &mut Supervised,
    start_as: Option<&str>,
    site: &Site,
) {
    process.started = Instant::now();
    process.is_silent = false;
    match start(children, index, &process.job, start_as, site) {
        Ok(pid) => (process.pid, process.state) = (pid, State::Running),
        Err(problem) => {
            let exit = Exit { words: format!("an error at its start: {problem:#}"), status: None };
            say(&process.on_exit(&exit, Instant::now()));
        }
    }
}

fn start(
    children: &mut Children<usize>,
    index: usize,
    job: &Job,
    start_as: Option<&str>,
    site: &Site,
) -> anyhow::Result<i32> {
    let mut command_line = arguments(job);
    if let Some(start) = start_as {
        command_line.extend(["--set".to_owned(), format!("start=\"{start}\"")]);
    }
    let (program, rest) = command_line.split_first().context("an empty command")?;
    let own = program == OWN_PROGRAM;
    let mut command = match own {
        true => Command::new(node::own_program()),
        false => Command::new(program),
    };
    without_network(&mut command);
    command.args(rest).envs(job.network.environment()).current_dir(&site.folder);
    if own {
        command.arg("--stop-with-parent").arg(std::process::id().to_string());
    } else if std::env::var_os(PYTHON_UNBUFFERED).is_none() {
        command.env(PYTHON_UNBUFFERED, "1");
    }
    let reach = if own { Reach::Leader } else { Reach::Group };
    let pid = children
        .spawn(index, command, &job.name, reach)
        .with_context(|| format!("the program `{program}`"))?;
    let mode = start_as.map_or_else(String::new, |start| format!(", start = \"{start}\""));
    say(&format!("{}: started as process {pid}{mode}", job.name));
    Ok(pid)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn supervised() -> Supervised {
        let job = Job {
            name: "detector".to_owned(),
            service: Some(Service::Detector),
            instance: None,
            command: vec!["alight".to_owned(), "detector".to_owned()],
            network: node::Network::default(),
            key: "detector".to_owned(),
            layers: node::Layers::default(),
        };
        Supervised::new(job)
    }

    #[test]
    fn the_command_by_hand_is_for_a_shell() {
        let mut job = supervised().job;
        job.network.keys = Some("/etc/alight/my keys".into());
        job.layers.file = Some("/etc/alight/it's.toml".into());
        job.layers.set = vec!["markers=[\"rings:0.15\"]".to_owned()];
        let expected = [
            "ALIGHT_KEYS=/etc/alight/my keys",
            "alight",
            "detector",
            "--config",
            "/etc/alight/it's.toml",
            "--set",
            "markers=[\"rings:0.15\"]",
        ];
        let line = by_hand(&job);
        assert_eq!(shlex::split(&line).unwrap(), expected);
        // The variable's name is outside of the quotes, or it would be a command.
        assert!(line.starts_with("ALIGHT_KEYS='/etc"), "{line}");
    }

    #[tokio::test]
    async fn the_standard_output_of_a_command_is_passed_on_and_python_does_not_collect_it() {
        let mut site: Site = toml::from_str("local = []").unwrap();
        site.folder = ".".into();
        let words = ["sh", "-c", "echo out $PYTHONUNBUFFERED"].map(str::to_owned);
        let job = Job { service: None, command: words.into(), ..supervised().job };
        let mut children = Children::new();
        start(&mut children, 0, &job, None, &site).unwrap();
        let line = match children.next().await {
            Some(ChildEvent::Line(0, line)) => line,
            _ => String::new(),
        };
        assert!(line.starts_with("out ") && line != "out ", "{line}");
    }

    fn failure(status: i32) -> Exit {
        Exit { words: format!("exit status: {status}"), status: Some(status) }
    }

    #[test]
    fn a_second_supervisor_of_the_same_name_is_refused_while_the_first_is_there() {
        let name = format!("test-{}", std::process::id());
        let first = only_supervisor(&name).unwrap();
        let refusal = only_supervisor(&name).unwrap_err().to_string();
        assert!(refusal.contains("runs on this machine already"), "{refusal}");
        only_supervisor(&format!("{name}-other")).unwrap();
        drop(first);
        only_supervisor(&name).unwrap();
    }

    #[test]
    fn the_end_of_the_previous_supervisor_is_read_from_its_notes() {
        let folder = tempfile::tempdir().unwrap();
        let notes = Notes::kept_in(Some(folder.path()), "x");
        let before = || Before::noted_in(&notes);
        assert_eq!(before(), Before::Nothing);
        notes.running.write();
        assert_eq!(before(), Before::Crash);
        let is_landing = || matches!(before(), Before::Landing { .. });
        notes.landing.write_aged(node::clock_name(), STALE_AFTER / 2);
        assert!(is_landing() && before().by_now(true).under_way().is_some());
        assert_eq!(before().by_now(false), Before::Crash);
        notes.landing.write_aged(node::clock_name(), STALE_AFTER);
        assert_eq!(before(), Before::Crash, "a note of so long ago");
        notes.landing.write_aged("before the machine was restarted", Duration::ZERO);
        assert_eq!(before(), Before::Crash);
        notes.running.write_aged("before the machine was restarted", Duration::ZERO);
        assert_eq!(before(), Before::Nothing);
        std::fs::write(folder.path().join("alight-x.running"), "half of").unwrap();
        assert_eq!(before(), Before::Crash, "it is there, whatever is in it");
    }

    #[test]
    fn a_controller_starts_no_motors_after_a_crash() {
        let mut job = supervised().job;
        let (now, crash) = (Instant::now(), Before::Crash);
        let landing = Before::Landing { last: now };
        assert_eq!([crash, landing].map(|it| it.start_mode(&job)), [None, None], "a detector");
        job.service = Some(Service::Controller);
        assert_eq!(Before::Nothing.start_mode(&job), None);
        assert_eq!(crash.start_mode(&job), Some("command"));
        assert_eq!(landing.start_mode(&job), Some("resume"));
    }

    #[test]
    fn repeated_exits_delay_the_restart_up_to_half_a_minute() {
        let mut process = supervised();
        let mut now = Instant::now();
        let (mut pauses, mut messages) = (Vec::new(), Vec::new());
        for _ in 0..9 {
            process.started = now;
            now += Duration::from_millis(100);
            messages.push(process.on_exit(&failure(1), now));
            let State::Waiting(at) = process.state else { panic!("{:?}", process.state) };
            pauses.push(at - now);
            now = at;
        }
        let half_seconds: Vec<_> = pauses.iter().map(|p| p.as_millis() / 500).collect();
        assert_eq!(half_seconds, [1, 2, 4, 8, 16, 60, 60, 60, 60]);
        assert!(process.is_out());
        let news: Vec<_> =
            (0..).zip(&messages).filter(|(_, it)| it.contains("from now on")).collect();
        assert!(news.len() == 1 && news[0].0 == 5, "{messages:#?}");
        // It has run again for a while.
        process.started = now;
        now += PERIOD;
        process.on_exit(&failure(1), now);
        assert_eq!(process.state, State::Waiting(now + MIN_PAUSE));
        assert!(!process.is_out());
    }

    #[test]
    fn it_continues_while_one_runs_and_ends_when_all_keep_failing() {
        let mut all = [supervised(), supervised(), supervised()];
        let now = Instant::now();
        let fail = |process: &mut Supervised, status: i32| {
            (0..MAX_EXITS).for_each(|_| drop(process.on_exit(&failure(status), now)));
        };
        fail(&mut all[0], 1);
        fail(&mut all[1], WRONG_USE);
        assert!(!all_are_out(&all), "one runs");
        all[2].on_exit(&failure(1), now);
        assert!(!all_are_out(&all), "it is soon started again");
        fail(&mut all[2], 1);
        assert!(all_are_out(&all));
        all[0].state = State::Running;
        assert!(!all_are_out(&all), "one has returned");
    }

    #[test]
    fn a_program_of_others_that_is_done_is_given_up() {
        let ended = |command: &[&str], service: Option<Service>, status: i32| {
            let mut process = supervised();
            process.job.service = service;
            process.job.command = command.iter().map(|&word| word.to_owned()).collect();
            let now = Instant::now();
            let said = (0..MAX_EXITS).map(|_| process.on_exit(&failure(status), now)).last();
            (process.state == State::GivenUp, said.unwrap())
        };
        let (is_given_up, said) = ended(&["./setup.sh"], None, 0);
        assert!(is_given_up && said.contains("seems to be done"), "{said}");
        assert!(!ended(&["./setup.sh"], None, 1).0);
        assert!(!ended(&["alight", "relay"], None, 0).0);
        assert!(!ended(&["alight", "detector"], Some(Service::Detector), 0).0);
        // A failure between them resets the count.
        let mut process = supervised();
        (process.job.service, process.job.command) = (None, vec!["./setup.sh".to_owned()]);
        for status in [0, 0, 0, 1, 0, 0, 0, 0, 0] {
            process.on_exit(&failure(status), Instant::now());
            assert_ne!(process.state, State::GivenUp);
        }
        process.on_exit(&failure(0), Instant::now());
        assert_eq!(process.state, State::GivenUp);
    }

    #[test]
    fn rare_exits_do_not_delay_the_restart() {
        let mut process = supervised();
        let mut now = Instant::now();
        for _ in 0..20 {
            process.on_exit(&failure(1), now);
            assert_eq!(process.state, State::Waiting(now + MIN_PAUSE));
            now += PERIOD + MIN_PAUSE;
        }
    }

    #[test]
    fn a_process_that_publishes_no_health_is_reported_once() {
        let mut process = supervised();
        let start = process.started;
        let at = |seconds| start + Duration::from_secs(seconds);
        assert_eq!(process.on_health(None, at(60)), None, "it is still starting");
        assert_eq!(process.on_health(Some(at(60)), at(69)), None);
        let silent = process.on_health(Some(at(60)), at(70)).unwrap();
        assert!(
            silent.contains("detector: process 0 runs, but has published no health"),
            "{silent}"
        );
        assert_eq!(process.on_health(Some(at(60)), at(71)), None);
        let again = process.on_health(Some(at(71)), at(72)).unwrap();
        assert!(again.contains("publishes its health again"), "{again}");
        // The health of a process before this one, of the same number.
        process.started = at(80);
        assert_eq!(process.on_health(Some(at(72)), at(90)), None);
        process.state = State::GivenUp;
        assert_eq!(process.on_health(Some(at(81)), at(99)), None);
    }

    #[test]
    fn an_invalid_configuration_gives_up_at_once() {
        let mut process = supervised();
        let message = process.on_exit(&failure(WRONG_USE), Instant::now());
        assert_eq!(process.state, State::GivenUp);
        assert!(process.is_out());
        assert!(message.contains("cannot run"), "{message}");
    }

    #[test]
    fn a_process_that_has_run_is_started_again_although_it_is_refused_now() {
        let mut process = supervised();
        let mut now = process.started + PERIOD;
        process.on_exit(&failure(1), now);
        for _ in 0..2 * MAX_EXITS {
            process.started = now;
            now += Duration::from_millis(100);
            process.on_exit(&failure(WRONG_USE), now);
            assert!(matches!(process.state, State::Waiting(_)), "{:?}", process.state);
        }
        // Where it is alone, `alight up` ends in the end, as with any other failure.
        assert!(process.is_out());
    }
}
