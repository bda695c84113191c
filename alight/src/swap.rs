//! `alight swap`: starts a new detector in parallel to the one in use, waits until both agree in the controller's comparison, lets the
//! controller switch to it in flight without a gap, and stops the old one.
//!
//! The new detector is started as a process that outlives this one. On any failure before the old one is stopped, the old one
//! stays in use, the operator's preference is restored, and the new one is stopped, unless the old one has gone meanwhile and
//! no other is left.

mod comparison;
mod joined;

use std::collections::BTreeSet;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{ExitCode, Stdio};
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use clap::Args;
use messages::{
    Candidate, CommandReply, Configuration, ControllerCommand, ControllerStatus, Detections,
    DetectorCommand, DetectorInfo, DetectorState, Place, topic,
};
use node::{Layers, Node, Presence, Shutdown, Subscriber};
use rustix::process::{Pid, Signal, kill_process_group};
use serde::Serialize;
use tempfile::TempDir;
use tokio::process::{Child, Command};
use tokio::time::{Instant, sleep, sleep_until, timeout};

use self::comparison::Comparison;
use self::joined::Joined;
use crate::args::{Format, NetworkArgs, WrongUse, whole_number};
use crate::runtime::with_node;
use crate::staleness::Limits;
use crate::terminal::{print, write_error};

/// Timeout for the controller's first status.
const CONTROLLER_TIMEOUT: Duration = Duration::from_secs(5);
/// Timeout for a further status.
const STATUS_TIMEOUT: Duration = Duration::from_secs(1);
/// Timeout until the controller uses the new detector.
const ACTIVE_TIMEOUT: Duration = Duration::from_secs(5);
/// Time that the new detector must stay active before the old one is stopped.
const PROBATION: Duration = Duration::from_millis(600);
/// Timeout for a detector that was asked to stop.
const STOP_TIMEOUT: Duration = Duration::from_secs(3);
/// Minimum ratio of agreeing frames to compared frames for the new detector.
const MIN_AGREEMENT: f64 = 0.9;
/// Timeout for the controller's configuration, which it publishes every three seconds.
const CONFIGURATION_TIMEOUT: Duration = Duration::from_millis(3500);
/// Number of lines of the log that are shown when a detector fails.
const LOG_LINES_SHOWN: usize = 8;

/// The arguments of a swap.
#[derive(Args, Clone)]
pub(crate) struct SwapArgs {
    /// The new detector: a configuration (a `.toml` file), or a command, which is split into words as by a
    /// shell and gets the network's options in its environment (ALIGHT_ZENOH, ALIGHT_CONNECT, ...).
    #[arg(long, value_name = "FILE|COMMAND")]
    to: String,
    /// Name of the new detector. Of a configuration [default: that of the file, with a number if it is taken].
    /// Of a command, the name under which it joins [default: that of the detector that joins as a process of the
    /// command]; give it if the command starts the detector as a service (systemd), in a container or on
    /// another host.
    #[arg(long, value_name = "ID")]
    id: Option<String>,
    /// Number of frames to compare with the active detector, from 1 to 30.
    #[arg(long, default_value_t = 15, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=30))]
    frames: u32,
    /// Timeout until the new detector is ready, in seconds.
    #[arg(long, default_value_t = 20, value_name = "SECONDS", value_parser = whole_number::<u64>(0..=86_400))]
    ready_s: u64,
    /// Timeout until it agrees, in seconds. Frames in which the active one sees no marker are not compared.
    #[arg(long, default_value_t = 20, value_name = "SECONDS", value_parser = whole_number::<u64>(0..=86_400))]
    agree_s: u64,
    /// Keep the old detector running, in shadow.
    #[arg(long)]
    keep_old: bool,
    /// Wait until the new detector exits; Ctrl-C stops it. Without this option it continues in a process
    /// group of its own, and writes to the log.
    #[arg(long)]
    wait: bool,
    /// File for the output of the new detector [default: `detector.log` in a new private folder for temporary
    /// files].
    #[arg(long, value_name = "FILE")]
    log: Option<PathBuf>,
    /// Format of the result: a sentence, or one JSON object.
    #[arg(long, value_enum, default_value_t)]
    format: Format,
    #[command(flatten)]
    network: NetworkArgs,
}

/// The result of a swap.
#[derive(Default, Serialize)]
struct Report {
    swapped: bool,
    from: Option<String>,
    to: Option<String>,
    why: String,
    pid: Option<u32>,
    log: Option<PathBuf>,
    compared: u32,
    agreed: u32,
    disagreement_m: Option<f64>,
    ready_s: Option<f64>,
    agreed_s: Option<f64>,
    active_s: Option<f64>,
    old_stopped: bool,
    new_kept: bool,
}

/// Swaps; the exit status is 0 when the new detector is in use.
pub(crate) fn run(args: &SwapArgs) -> anyhow::Result<ExitCode> {
    let report = with_node(&args.network, "swap", async |node| {
        swap(args, node, &Shutdown::on_signals()?).await
    })?;
    print(&match args.format {
        Format::Json => serde_json::to_string(&report)?,
        Format::Text => report.why.clone(),
    })?;
    Ok(ExitCode::from(u8::from(!report.swapped)))
}

async fn swap(args: &SwapArgs, node: &Node, shutdown: &Shutdown) -> anyhow::Result<Report> {
    let statuses = node.subscriber(topic::STATUS, &[]).await?;
    let detections = node.subscriber(topic::DETECTIONS, &[]).await?;
    let configurations = node.subscriber(topic::CONFIGURATION, &["controller", "*"]).await?;
    let infos = node.subscriber(topic::DETECTOR_INFO, &[]).await?;
    let presence = node.presence("detector").await?;
    let first = timeout(CONTROLLER_TIMEOUT, statuses.next()).await.ok().flatten();
    let Some(first) = first else {
        let why = node.explain_silence("controller", None).await;
        bail!("no controller answered, and `swap` needs one: {why}");
    };
    let mut existing: BTreeSet<String> = node.alive("detector", "*").await?.into_iter().collect();
    existing.extend(first.candidates.iter().map(|candidate| candidate.detector.clone()));
    // A detector with the preferred name is used soon, whether it agrees or not.
    if let ControllerCommand::UseDetector(preferred) = preferring(&first.preference, &first) {
        existing.insert(preferred);
    }
    let new_detector = NewDetector::new(args, &existing)?;
    let mut report = Report {
        from: first.active_detector.clone(),
        to: new_detector.id.clone(),
        ..Report::default()
    };
    let (child, log) = new_detector.start(args)?;
    (report.pid, report.log) = (child.id(), log);
    let joined =
        Joined::new(new_detector.id, existing, report.pid.context("the new detector has exited")?);
    let mut swap = Swap {
        args,
        node,
        shutdown,
        statuses,
        detections,
        configurations,
        comparison: Comparison::default(),
        preference: first.preference.clone(),
        latest: first,
        infos,
        presence,
        joined,
        child,
        is_asked: false,
        began: Instant::now(),
        is_verbose: args.format == Format::Text,
    };
    match swap.carry_out(&mut report).await {
        Ok(()) => {
            report.swapped = true;
            let old = report.from.as_deref().unwrap_or("none");
            let new = report.to.as_deref().unwrap_or_default();
            report.why = format!(
                "swapped: {new} is used instead of {old}; it agreed in {} of {} frames",
                report.agreed, report.compared
            );
            if let (Some(pid), Some(log), true) = (report.pid, &report.log, swap.is_verbose) {
                let log = log.display();
                report.why.push_str(&format!(
                    "\n{new} is process {pid} (`kill {pid}` ends it), its log {log}"
                ));
            }
            if args.wait {
                swap.wait().await;
            }
        }
        Err(problem) => {
            swap.roll_back(&mut report).await;
            let why = |report: &Report, latest: &ControllerStatus| {
                format!("not swapped, {}: {problem:#}", left(report, latest))
            };
            report.why = why(&report, &swap.latest);
            if let Some(last) = report.log.as_deref().and_then(last_lines)
                && swap.is_verbose
            {
                write_error(&format!("End of the new detector's log:\n{last}"));
            }
            if args.wait && report.new_kept {
                swap.show(&report.why);
                swap.wait().await;
                report.new_kept = false;
                swap.learn_status().await;
                report.why = why(&report, &swap.latest);
            }
        }
    }
    Ok(report)
}

/// The detector to start.
struct NewDetector {
    program: PathBuf,
    args: Vec<String>,
    /// Its name, if known beforehand.
    id: Option<String>,
}

impl NewDetector {
    fn new(args: &SwapArgs, existing: &BTreeSet<String>) -> anyhow::Result<Self> {
        let file = Path::new(&args.to);
        if file.extension().is_some_and(|extension| extension == "toml") {
            let layers = Layers { file: Some(file.to_owned()), set: Vec::new() };
            let wanted = match &args.id {
                Some(id) => id.clone(),
                None => layers.load::<detector::Config>()?.settings.id,
            };
            let id = free_name(&wanted, existing);
            let network = args.network.network();
            // As a site's detectors on the ground have it: it takes the place of one of those.
            let is_ground = network.config.is_some_and(|config| config == Path::new("ground"));
            let place = is_ground.then(|| "place=ground".to_owned());
            let set: Vec<_> = place.into_iter().chain([format!("id={id}")]).collect();
            let mut words = vec!["detector".to_owned(), "--config".to_owned(), args.to.clone()];
            words.extend(set.iter().flat_map(|setting| ["--set".to_owned(), setting.clone()]));
            Layers { set, ..layers }.load::<detector::Config>()?;
            return Ok(Self { program: node::own_program(), args: words, id: Some(id) });
        }
        let words = shlex::split(&args.to).filter(|words| !words.is_empty());
        let mut words = words
            .ok_or_else(|| WrongUse(format!("`{}` is not a command: a quote is missing", args.to)))?
            .into_iter();
        if let Some(id) = args.id.as_ref().filter(|id| existing.contains(*id)) {
            let text = format!(
                "`--id {id}`: a detector of that name runs already; choose another name for the new one"
            );
            return Err(WrongUse(text).into());
        }
        let program = words.next().unwrap_or_default().into();
        Ok(Self { program, args: words.collect(), id: args.id.clone() })
    }

    /// Starts it; returns its process and its log.
    fn start(&self, args: &SwapArgs) -> anyhow::Result<(Child, Option<PathBuf>)> {
        // Removed again when the start fails.
        let mut folder = None;
        let log = match (&args.log, args.wait) {
            (Some(log), _) => Some(log.clone()),
            (None, true) => None,
            (None, false) => Some(folder.insert(private_folder()?).path().join("detector.log")),
        };
        let mut command = Command::new(&self.program);
        command.args(&self.args).envs(args.network.network().environment()).stdin(Stdio::null());
        if let Some(log) = &log {
            let file = File::create(log).with_context(|| format!("writing the log {log:?}"))?;
            command.stdout(file.try_clone()?).stderr(file);
        }
        // The detector outlives this program, also after Ctrl-C in its terminal.
        command.process_group(0);
        let child =
            command.spawn().with_context(|| format!("starting {}", self.program.display()))?;
        // The log stays, as the detector does.
        drop(folder.map(TempDir::keep));
        Ok((child, log))
    }
}

/// A new folder for temporary files that only this user can access: a file of a predictable name in a shared
/// directory could be a link that another user placed there.
fn private_folder() -> anyhow::Result<TempDir> {
    let folder = tempfile::Builder::new().prefix("alight-").tempdir();
    folder.context("making a private folder for the log")
}

/// The name itself, or the first free one with a number.
fn free_name(wanted: &str, existing: &BTreeSet<String>) -> String {
    let numbered = (2_u32..).map(|number| format!("{wanted}-{number}"));
    std::iter::once(wanted.to_owned())
        .chain(numbered)
        .find(|name| !existing.contains(name))
        .unwrap_or_default()
}

/// A swap under way.
struct Swap<'a> {
    args: &'a SwapArgs,
    node: &'a Node,
    shutdown: &'a Shutdown,
    statuses: Subscriber<ControllerStatus>,
    detections: Subscriber<Detections>,
    configurations: Subscriber<Configuration>,
    comparison: Comparison,
    /// The operator's preference before: a detector's name, a place or nothing.
    preference: String,
    latest: ControllerStatus,
    infos: Subscriber<DetectorInfo>,
    presence: Presence,
    joined: Joined,
    child: Child,
    /// Whether the controller was asked for the new one, and did not refuse it.
    is_asked: bool,
    began: Instant,
    is_verbose: bool,
}

/// An event during a swap.
enum Event {
    Status(Box<ControllerStatus>),
    /// A detector has joined, or has published its information.
    Joined,
    Left(String),
}

impl Swap<'_> {
    async fn carry_out(&mut self, report: &mut Report) -> anyhow::Result<()> {
        let new = self.until_ready().await?;
        report.to = Some(new.clone());
        report.ready_s = Some(self.elapsed_s());
        self.show(&format!("{new} is ready and runs in shadow"));
        self.until_agreed(&new, report).await?;
        report.agreed_s = Some(self.elapsed_s());
        self.show(&format!("it agrees in {} of {} frames", report.agreed, report.compared));
        let reply = self.ask(&ControllerCommand::UseDetector(new.clone())).await;
        // Without an answer it may have been carried out.
        self.is_asked = reply.as_ref().map_or(true, |reply| reply.accepted);
        taken(&reply?)?;
        self.until_active(&new).await?;
        report.active_s = Some(self.elapsed_s());
        self.show(&format!("{new} is used"));
        let is_to_stop =
            |old: &String| *old != new && !self.args.keep_old && is_alive(&self.latest, old);
        if let Some(old) = report.from.clone().filter(is_to_stop) {
            match self.stop_old(&old).await {
                Ok(()) => report.old_stopped = true,
                Err(problem) => {
                    write_error(&format!("{old} still runs, in shadow: {problem:#}"));
                }
            }
        }
        Ok(())
    }

    fn elapsed_s(&self) -> f64 {
        self.began.elapsed().as_secs_f64()
    }

    fn show(&self, line: &str) {
        if self.is_verbose {
            write_error(&format!("{:5.1} s  {line}", self.elapsed_s()));
        }
    }

    /// The next event; an error when the new detector exits, on a shutdown request, and at the deadline, with what was waited for or why in
    /// vain.
    async fn next_event(&mut self, deadline: Instant, waiting_for: &str) -> anyhow::Result<Event> {
        self.next_event_or(deadline, || format!("timeout while waiting until {waiting_for}")).await
    }

    async fn next_event_or(
        &mut self,
        deadline: Instant,
        timeout: impl Fn() -> String,
    ) -> anyhow::Result<Event> {
        loop {
            return tokio::select! {
                Some(status) = self.statuses.next() => {
                    self.latest = status.clone();
                    Ok(Event::Status(Box::new(status)))
                }
                Some((name, alive)) = self.presence.next() => {
                    self.joined.set_ready(&name, alive);
                    Ok(if alive { Event::Joined } else { Event::Left(name) })
                }
                Some((key, info)) = self.infos.next_with_key() => {
                    let name = topic::DETECTOR_INFO.first_name(&key).unwrap_or_default();
                    self.joined.set_info(name, &info);
                    Ok(Event::Joined)
                }
                Some(found) = self.detections.next() => {
                    self.comparison.found(&found);
                    continue;
                }
                Some(configuration) = self.configurations.next() => {
                    self.comparison.configured(&configuration);
                    continue;
                }
                status = self.child.wait() => {
                    let status = status.map_or_else(|cause| cause.to_string(), |s| s.to_string());
                    bail!("the new detector exited ({status})")
                }
                () = self.shutdown.requested() => bail!("interrupted"),
                () = sleep_until(deadline) => bail!("{}", timeout()),
            };
        }
    }

    /// Waits until the started detector is ready; returns its name.
    async fn until_ready(&mut self) -> anyhow::Result<String> {
        let deadline = Instant::now() + Duration::from_secs(self.args.ready_s);
        loop {
            if let Some(name) = self.joined.started() {
                return Ok(name);
            }
            let waiting_for = self.joined.waiting_for();
            self.next_event(deadline, &waiting_for).await?;
        }
    }

    async fn until_agreed(&mut self, new: &str, report: &mut Report) -> anyhow::Result<()> {
        let deadline = Instant::now() + Duration::from_secs(self.args.agree_s);
        self.comparison.of(report.from.as_deref(), new);
        let mut unfit = None;
        loop {
            let problem = self.unreadable(new).or_else(|| unfit.clone());
            let waiting_for = match (report.compared, report.agreed) {
                (0, _) => "it can be compared: the active detector sees no marker, or the new one searches \
                           other frames"
                    .to_owned(),
                (compared, agreed) => {
                    let differs = self.comparison.text().filter(|_| agreed < compared);
                    let differs = differs.map_or_else(String::new, |text| format!("; {text}"));
                    format!("it agrees, so far in {agreed} of {compared} frames{differs}")
                }
            };
            let timeout = || match &problem {
                Some(problem) => problem.clone(),
                None => format!("timeout while waiting until {waiting_for}"),
            };
            match self.next_event_or(deadline, timeout).await? {
                Event::Left(name) if name == new => bail!("the new detector left the network"),
                Event::Status(status) if status.active_detector.as_deref() == Some(new) => {
                    self.show("the old one failed, and the new one took over");
                    return Ok(());
                }
                Event::Status(status) => {
                    let Some(shadow) = find(&status, new) else { continue };
                    (report.compared, report.agreed) = (shadow.compared, shadow.agreed);
                    report.disagreement_m = shadow.disagreement_m;
                    self.comparison.of(status.active_detector.as_deref(), new);
                    unfit = self
                        .comparison
                        .limits()
                        .and_then(|limits| unfit_because(shadow, self.args.frames, limits));
                    match verdict(shadow, self.args.frames) {
                        Some(Verdict::Agrees) => return Ok(()),
                        Some(Verdict::Differs(why)) => {
                            self.learn_limit().await;
                            bail!("{why}{}", self.difference(shadow));
                        }
                        None => {}
                    }
                }
                Event::Joined | Event::Left(_) => {}
            }
        }
    }

    /// Why the new detector's detections cannot be read, if some could not.
    fn unreadable(&self, new: &str) -> Option<String> {
        let all = self.node.health().more_unreadable(&mut 0)?;
        let its = all.into_iter().find(|it| topic::DETECTIONS.first_name(&it.key) == Some(new))?;
        Some(format!("its detections cannot be read ({} times): {}", its.count, its.why))
    }

    /// Waits for the controller's configuration, which it publishes every few seconds: the limit is in it.
    async fn learn_limit(&mut self) {
        let deadline = Instant::now() + CONFIGURATION_TIMEOUT;
        let waiting_for = "the controller publishes its configuration";
        // Without it the keys of the limit are named, and not their values.
        while !self.comparison.is_configured()
            && self.next_event(deadline, waiting_for).await.is_ok()
        {}
    }

    /// How it differs, as a text.
    fn difference(&self, shadow: &Candidate) -> String {
        match (shadow.disagreement_m, self.comparison.text()) {
            (None, _) if self.comparison.lacks_pose() => {
                "; it sees the marker, and gives no pose of it".to_owned()
            }
            (None, _) => "; it does not see the marker".to_owned(),
            (Some(_), Some(text)) => format!("; {text}"),
            (Some(apart_m), None) => {
                format!("; its last position of the marker is {apart_m:.2} m off")
            }
        }
    }

    async fn send(&self, command: &ControllerCommand) -> anyhow::Result<()> {
        taken(&self.ask(command).await?)
    }

    async fn ask(&self, command: &ControllerCommand) -> anyhow::Result<CommandReply> {
        self.node.command(topic::COMMAND, &[], command).await
    }

    async fn until_active(&mut self, new: &str) -> anyhow::Result<()> {
        let deadline = Instant::now() + ACTIVE_TIMEOUT;
        let mut since: Option<Instant> = None;
        loop {
            let Event::Status(status) =
                self.next_event(deadline, "the new detector is used").await?
            else {
                continue;
            };
            let is_used = status.active_detector.as_deref() == Some(new)
                && find(&status, new).is_some_and(|it| it.state == DetectorState::Active);
            match (is_used, since) {
                (true, Some(since)) if since.elapsed() >= PROBATION => return Ok(()),
                (true, since_before) => since = since_before.or(Some(Instant::now())),
                (false, Some(_)) if status.active_detector.as_deref() != Some(new) => {
                    bail!("the controller switched back: {}", status.detector_why)
                }
                (false, _) => {}
            }
        }
    }

    async fn stop_old(&mut self, old: &str) -> anyhow::Result<()> {
        let reply =
            self.node.command(topic::DETECTOR_COMMAND, &[old], &DetectorCommand::Stop).await?;
        if !reply.accepted {
            bail!("it refuses to stop: {}", reply.reason);
        }
        let deadline = Instant::now() + STOP_TIMEOUT;
        loop {
            match self.next_event(deadline, "the old detector has stopped").await? {
                Event::Left(name) if name == old => return Ok(()),
                Event::Left(_) | Event::Joined | Event::Status(_) => {}
            }
        }
    }

    /// Waits for the controller's newest status.
    async fn learn_status(&mut self) {
        while let Some(status) = self.statuses.waiting() {
            self.latest = status;
        }
        if let Ok(Some(status)) = timeout(STATUS_TIMEOUT, self.statuses.next()).await {
            self.latest = status;
        }
    }

    /// Switches back to the old detector and to the previous preference, and stops the new one, unless it is the last.
    async fn roll_back(&mut self, report: &mut Report) {
        self.learn_status().await;
        // The request for the new one is undone before that one ends, so that no frame is missed.
        let old = report.from.as_deref().filter(|old| self.is_asked && is_alive(&self.latest, old));
        if let Some(old) = old
            && let Err(problem) = self.send(&ControllerCommand::UseDetector(old.to_owned())).await
        {
            write_error(&format!("going back to {old}: {problem:#}"));
        }
        let is_running = matches!(self.child.try_wait(), Ok(None));
        report.new_kept = is_running && report.ready_s.is_some() && is_last(report, &self.latest);
        if !report.new_kept {
            self.end_child().await;
        }
        if self.is_asked
            && let Err(problem) = self.send(&preferring(&self.preference, &self.latest)).await
        {
            let before = Some(self.preference.as_str()).filter(|it| !it.is_empty());
            let before = before.unwrap_or("any detector");
            write_error(&format!("preferring {before} again, as before: {problem:#}"));
        }
    }

    async fn end_child(&mut self) {
        let group = self.child.id().and_then(|id| i32::try_from(id).ok()).and_then(Pid::from_raw);
        for signal in [Signal::TERM, Signal::KILL] {
            if let Some(group) = group {
                // Fails when the group has exited already.
                let _ = kill_process_group(group, signal);
            }
            if timeout(STOP_TIMEOUT, self.child.wait()).await.is_ok() {
                return;
            }
        }
    }

    /// Waits until the new detector exits or a shutdown is requested.
    async fn wait(&mut self) {
        self.show("the new detector runs until Ctrl-C");
        let ended = tokio::select! {
            _ = self.child.wait() => true,
            () = self.shutdown.requested() => false,
        };
        if !ended {
            self.end_child().await;
            // Its last output goes to the same terminal.
            sleep(Duration::from_millis(50)).await;
        }
    }
}

fn find<'a>(status: &'a ControllerStatus, name: &str) -> Option<&'a Candidate> {
    status.candidates.iter().find(|candidate| candidate.detector == name)
}

fn is_alive(status: &ControllerStatus, name: &str) -> bool {
    find(status, name).is_some_and(|candidate| candidate.alive)
}

/// A detector that is there in addition to the new one, preferably the one in use.
fn other_there<'a>(report: &Report, status: &'a ControllerStatus) -> Option<&'a str> {
    let new = report.to.as_deref();
    let is_other = |it: &&Candidate| it.alive && new != Some(it.detector.as_str());
    let others = status.candidates.iter().filter(is_other).map(|it| it.detector.as_str());
    others.max_by_key(|other| is_used(other, status))
}

fn is_used(name: &str, status: &ControllerStatus) -> bool {
    status.active_detector.as_deref() == Some(name)
}

/// Whether the new detector is the last one: the old one has gone, and no other is there.
fn is_last(report: &Report, status: &ControllerStatus) -> bool {
    report.from.is_some() && other_there(report, status).is_none()
}

/// The state after a failed swap, as a text.
fn left(report: &Report, status: &ControllerStatus) -> String {
    let Some(old) = &report.from else { return "none stays in use".to_owned() };
    let new = report.to.as_deref().unwrap_or_default();
    match (report.new_kept, report.pid, other_there(report, status)) {
        (true, Some(pid), _) => format!(
            "but {old} has gone, and {new} is kept as the last one (process {pid}, `kill {pid}` ends it)"
        ),
        _ if is_alive(status, old) => format!("{old} stays in use"),
        (_, _, Some(other)) if is_used(other, status) => {
            format!("{other} is used, as {old} has gone")
        }
        (_, _, Some(other)) => format!("but {old} has gone, and {other} is there, not used yet"),
        _ => format!("but {old} has gone, and no other is left"),
    }
}

/// An error unless the controller has taken a command.
fn taken(reply: &CommandReply) -> anyhow::Result<()> {
    ensure!(reply.accepted, "the controller refused: {}", reply.reason);
    Ok(())
}

/// The command after which this is preferred; an empty name is none. The controller's status does not distinguish a place from a detector
/// of that name: it counts as the detector while that is there.
fn preferring(preference: &str, status: &ControllerStatus) -> ControllerCommand {
    let place = [Place::Onboard, Place::Ground].into_iter().find(|it| it.name() == preference);
    match place.filter(|_| !is_alive(status, preference)) {
        Some(place) => ControllerCommand::PreferDetectors(place),
        None if preference.is_empty() => ControllerCommand::PreferAnyDetector,
        None => ControllerCommand::UseDetector(preference.to_owned()),
    }
}

/// Whether a detector agrees.
#[derive(Debug, PartialEq)]
enum Verdict {
    Agrees,
    /// In how many frames it does.
    Differs(String),
}

/// Whether a detector agrees, once enough frames are compared; `None` while that is undecided.
fn verdict(shadow: &Candidate, frames: u32) -> Option<Verdict> {
    let (agreed, compared) = (shadow.agreed, shadow.compared);
    if compared < frames {
        return None;
    }
    let ratio = agreement(shadow);
    if ratio >= MIN_AGREEMENT && shadow.state == DetectorState::Shadow {
        return Some(Verdict::Agrees);
    }
    (ratio < 0.5)
        .then(|| Verdict::Differs(format!("it agrees in only {agreed} of {compared} frames")))
}

/// The part of the compared frames in which a detector agrees.
fn agreement(shadow: &Candidate) -> f64 {
    f64::from(shadow.agreed) / f64::from(shadow.compared)
}

/// Why a detector that agrees cannot be used, or why one is too slow or too late for a comparison.
fn unfit_because(shadow: &Candidate, frames: u32, limits: Limits) -> Option<String> {
    let Candidate { state, agreed, compared, age_ms, latency_ms, .. } = shadow;
    let agrees = *compared >= frames && agreement(shadow) >= MIN_AGREEMENT;
    let what = match state {
        DetectorState::Active | DetectorState::Shadow => return None,
        DetectorState::Stale => {
            if let Some(problem) = limits.slow(shadow).or_else(|| limits.late(shadow)) {
                return Some(format!("too {problem}; it agrees in {agreed} of {compared} frames"));
            }
            "is silent"
        }
        DetectorState::Blind => "is blind",
        DetectorState::Outvoted => "is outvoted",
        DetectorState::NoPose => "gives no pose of the marker",
    };
    agrees.then(|| {
        format!(
            "timeout while waiting until it can be used: it agrees in {agreed} of {compared} frames and {what} (detections come {latency_ms:.0} ms \
             after their frames, the newest frame is {age_ms:.0} ms old)"
        )
    })
}

fn last_lines(log: &Path) -> Option<String> {
    let text = std::fs::read_to_string(log).ok()?;
    let lines: Vec<&str> = text.lines().collect();
    let last = lines.get(lines.len().saturating_sub(LOG_LINES_SHOWN)..)?;
    (!last.is_empty()).then(|| last.join("\n"))
}

#[cfg(test)]
mod tests {
    use clap::Parser;
    use node::{Identity, ZenohSource};

    use super::*;
    use crate::land::free_port;

    #[derive(Parser)]
    struct Tool {
        #[command(flatten)]
        swap: SwapArgs,
    }

    fn shadow(compared: u32, agreed: u32) -> Candidate {
        Candidate {
            detector: "new".into(),
            disagreement_m: Some(0.4),
            compared,
            agreed,
            ..Candidate::sample()
        }
    }

    #[test]
    fn agreement_needs_enough_frames() {
        assert!(verdict(&shadow(14, 14), 15).is_none());
        assert_eq!(verdict(&shadow(15, 14), 15), Some(Verdict::Agrees));
        assert!(verdict(&shadow(15, 10), 15).is_none(), "undecided");
        let late = Candidate { state: DetectorState::Stale, latency_ms: 201.0, ..shadow(30, 30) };
        assert!(verdict(&late, 15).is_none());
        let limits = Limits { max_age_s: 0.2, min_rate_hz: 3.0 };
        let unfit = unfit_because(&late, 15, limits).unwrap();
        assert!(
            unfit.starts_with(
                "too late: its detections come 201 ms after the exposure, limit 200 ms"
            ) && unfit.ends_with("it agrees in 30 of 30 frames"),
            "{unfit}"
        );
        let slow = Candidate { state: DetectorState::Stale, rate_hz: 2.0, ..shadow(9, 9) };
        let unfit = unfit_because(&slow, 15, limits).unwrap();
        assert!(unfit.starts_with("too slow: 2.0 of at least 3 Hz"), "{unfit}");
        let silent = Candidate { age_ms: 700.0, latency_ms: 30.0, rate_hz: 15.0, ..late.clone() };
        let unfit = unfit_because(&silent, 15, limits).unwrap();
        assert!(
            unfit.contains("30 of 30 frames and is silent") && unfit.contains("700 ms"),
            "{unfit}"
        );
        let centres_only = Candidate { state: DetectorState::NoPose, ..shadow(30, 30) };
        assert!(verdict(&centres_only, 15).is_none());
        let unfit = unfit_because(&centres_only, 15, limits).unwrap();
        assert!(unfit.contains("30 of 30 frames and gives no pose of the marker"), "{unfit}");
        assert_eq!(unfit_because(&shadow(30, 30), 15, limits), None);
        let refused = Verdict::Differs("it agrees in only 3 of 15 frames".into());
        assert_eq!(verdict(&shadow(15, 3), 15), Some(refused));
        let stale = Candidate { state: DetectorState::Stale, ..shadow(15, 15) };
        assert!(verdict(&stale, 15).is_none());
    }

    #[test]
    fn the_new_detector_is_kept_only_as_the_last_one() {
        let known = |name: &str, alive: bool| Candidate {
            detector: name.into(),
            alive,
            ..Candidate::sample()
        };
        let status = |candidates: &[Candidate], active: Option<&str>| ControllerStatus {
            candidates: candidates.to_vec(),
            active_detector: active.map(Into::into),
            ..ControllerStatus::default()
        };
        let report = |new_kept: bool| Report {
            from: Some("old".into()),
            to: Some("new".into()),
            pid: Some(7),
            new_kept,
            ..Report::default()
        };
        let (old, new) = (known("old", true), known("new", true));
        let (gone, spare) = (known("old", false), known("spare", true));
        for (status, is_kept, part) in [
            (status(&[old.clone(), new.clone()], Some("old")), false, "old stays in use"),
            // It is silent for a while.
            (status(&[old, new.clone()], None), false, "old stays in use"),
            (status(&[gone.clone(), new.clone()], Some("old")), true, "`kill 7` ends it"),
            (status(std::slice::from_ref(&new), Some("new")), true, "new is kept as the last one"),
            (
                status(&[gone.clone(), new.clone(), spare.clone()], Some("spare")),
                false,
                "spare is used, as old",
            ),
            // None is used for a moment, or the new one still is.
            (status(&[gone.clone(), new.clone(), spare.clone()], None), false, "spare is there"),
            (status(&[gone.clone(), new, spare], Some("new")), false, "spare is there"),
        ] {
            assert_eq!(is_last(&report(false), &status), is_kept, "{status:?}");
            let left = left(&report(is_kept), &status);
            assert!(left.contains(part), "{left}");
        }
        // The new one has ended as well.
        let left = left(&report(false), &status(&[gone], None));
        assert!(left.contains("no other is left"), "{left}");
        assert!(!is_last(&Report::default(), &status(&[], None)), "there was none before");
    }

    #[test]
    fn the_previous_preference_is_restored() {
        let place = ControllerCommand::PreferDetectors;
        let named = |name: &str| ControllerCommand::UseDetector(name.into());
        let with = |alive: bool| ControllerStatus {
            candidates: vec![Candidate { detector: "ground".into(), alive, ..Candidate::sample() }],
            ..ControllerStatus::default()
        };
        let none = ControllerStatus::default();
        assert_eq!(preferring("ground", &none), place(Place::Ground));
        assert_eq!(preferring("onboard", &with(true)), place(Place::Onboard));
        assert_eq!(preferring("ground", &with(true)), named("ground"), "a detector of that name");
        assert_eq!(preferring("ground", &with(false)), place(Place::Ground));
        assert_eq!(preferring("spare", &none), named("spare"));
        assert_eq!(preferring("", &none), ControllerCommand::PreferAnyDetector);
    }

    /// Swaps to a command while another detector joins, and a detector `mine` with the process that the command writes to a file.
    async fn swapped_to(command: &str, ready_s: &str) -> anyhow::Result<Report> {
        let (port, _lock) = free_port()?;
        let zenoh = ZenohSource::Text(node::session::local_config(port));
        let open = async |service: &'static str, instance: &str| {
            Node::open(Identity { service, instance: instance.to_owned() }, &zenoh).await
        };
        let operator = open("alight", "swap").await?;
        let (third, mine) = (open("detector", "third").await?, open("detector", "mine").await?);
        let statuses = operator.publisher(topic::STATUS, &[]).await?;
        let folder = tempfile::tempdir()?;
        let file = folder.path().join("pid");
        let command = command.replace("FILE", &file.display().to_string());
        let log = folder.path().join("log").display().to_string();
        let args =
            ["swap", "--to", &command, "--ready-s", ready_s, "--agree-s", "0", "--log", &log];
        let args = Tool::try_parse_from(args)?.swap;
        let introduce = async |node: &Node, name: &str, pid: u32| {
            let info = DetectorInfo {
                detector: name.into(),
                host: node::host_name(),
                place: Place::Onboard,
                camera: "down".into(),
                markers: Vec::new(),
                version: String::new(),
                pid,
            };
            let infos = node.publisher(topic::DETECTOR_INFO, &[name]).await?;
            infos.publish(&info).await;
            node.announce().await?;
            anyhow::Ok(infos)
        };
        let others = async {
            let written = async || {
                loop {
                    statuses.publish(&ControllerStatus::default()).await;
                    let text = std::fs::read_to_string(&file).unwrap_or_default();
                    if let Ok(pid) = text.trim().parse::<u32>() {
                        return pid;
                    }
                    sleep(Duration::from_millis(20)).await;
                }
            };
            let pid = written().await;
            let _third = introduce(&third, "third", std::process::id()).await?;
            sleep(Duration::from_millis(500)).await;
            let _mine = match pid {
                0 => None,
                pid => Some(introduce(&mine, "mine", pid).await?),
            };
            loop {
                statuses.publish(&ControllerStatus::default()).await;
                sleep(Duration::from_millis(100)).await;
            }
            #[expect(unreachable_code, reason = "it gives the type of the errors")]
            anyhow::Ok(())
        };
        let shutdown = Shutdown::on_signals()?;
        let report = tokio::select! {
            report = swap(&args, &operator, &shutdown) => report?,
            ended = others => bail!("the other detectors: {ended:?}"),
        };
        for node in [operator, third, mine] {
            node.close().await;
        }
        Ok(report)
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn only_a_process_of_its_command_is_switched_to() -> anyhow::Result<()> {
        let report = swapped_to("sh -c 'sleep 60 & echo $! > FILE; wait'", "30").await?;
        assert_eq!(report.to.as_deref(), Some("mine"), "{}", report.why);
        let report = swapped_to("sh -c 'echo 0 > FILE; exec sleep 60'", "6").await?;
        assert_eq!(report.to, None, "{}", report.why);
        let why = "`third` joined, and is not used: it is process";
        assert!(report.why.contains(why) && report.why.contains("`--id third`"), "{}", report.why);
        assert!(!report.swapped && report.ready_s.is_none(), "{}", report.why);
        let report = swapped_to("sh -c 'echo 0 > FILE; exit 3'", "30").await?;
        let why = "the new detector exited (exit status: 3)";
        assert!(report.why.ends_with(why), "{}", report.why);
        Ok(())
    }

    #[test]
    fn a_taken_name_gets_a_number() {
        let existing: BTreeSet<String> = ["main", "main-2"].map(Into::into).into();
        assert_eq!(free_name("main", &existing), "main-3");
        assert_eq!(free_name("spare", &existing), "spare");
    }
}
