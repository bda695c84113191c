//! `alight swap`: replaces the detector in use by another, in flight, without a gap.
//!
//! The new detector is started as a process of its own that outlives this one. It runs in shadow until it agrees with
//! the active one, becomes the active one, and only then is the old one stopped. Whatever goes wrong before, the old
//! one stays and the new one is stopped.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{ExitCode, Stdio};
use std::time::Duration;

use anyhow::{Context, anyhow, bail};
use clap::Args;
use messages::{
    Candidate, ControllerCommand, ControllerStatus, DetectorCommand, DetectorState, topic,
};
use node::{Layers, Node, Presence, Shutdown, Subscriber};
use rustix::process::{Pid, Signal, kill_process_group};
use serde::Serialize;
use tokio::process::{Child, Command};
use tokio::time::{Instant, sleep, sleep_until, timeout};

use crate::cli::{NetworkArgs, OPERATOR, write_error};
use crate::detectors::operator;
use crate::land::Format;
use crate::services;

/// Longest wait for the controller's first word.
const CONTROLLER_PATIENCE: Duration = Duration::from_secs(5);
/// Longest wait until the controller uses the new detector.
const ACTIVE_PATIENCE: Duration = Duration::from_secs(5);
/// For how long the new detector must stay the active one before the old one is stopped.
const PROBATION: Duration = Duration::from_millis(600);
/// Longest wait for the end of a detector that was asked to stop.
const STOP_PATIENCE: Duration = Duration::from_secs(3);
/// Of the frames that were compared, the part in which the new one must agree.
const LEAST_AGREEMENT: f64 = 0.9;
/// Of a log, what is shown when a detector fails, in lines.
const LAST_LINES: usize = 8;

/// What a swap takes.
#[derive(Args, Clone)]
pub(crate) struct SwapArgs {
    /// What to start: a detector's configuration (a `.toml` file), or any command; it is split into words as a shell
    /// does, and finds the network's options in its environment (ALIGHT_ZENOH, ALIGHT_CONNECT, ...).
    #[arg(long, value_name = "FILE|COMMAND")]
    to: String,
    /// Name of the new detector when a configuration is given; the file's own, with a number if that is taken.
    #[arg(long, value_name = "ID")]
    id: Option<String>,
    /// Frames that are compared with the active detector's, from 1 to 30.
    #[arg(long, default_value_t = 15, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=30))]
    frames: u32,
    /// Longest wait until the new detector is ready, in seconds.
    #[arg(long, default_value_t = 20, value_name = "SECONDS")]
    ready_s: u64,
    /// Longest wait until it agrees, in seconds. Where the active one sees no marker, nothing is concluded.
    #[arg(long, default_value_t = 20, value_name = "SECONDS")]
    agree_s: u64,
    /// Leave the old detector running, in shadow.
    #[arg(long)]
    keep_old: bool,
    /// Stay until the new detector ends; Ctrl-C stops it. Otherwise it goes on by itself, in a process group of its
    /// own, and writes to the log.
    #[arg(long)]
    wait: bool,
    /// Where the new detector's output goes; a file in the system's directory for temporary files otherwise.
    #[arg(long, value_name = "FILE")]
    log: Option<PathBuf>,
    /// What is printed at the end: a sentence, or one JSON object.
    #[arg(long, value_enum, default_value_t)]
    format: Format,
    #[command(flatten)]
    network: NetworkArgs,
}

/// How it went.
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
}

/// Swaps; the exit status is 0 when the new detector is in use.
pub(crate) fn run(args: &SwapArgs) -> anyhow::Result<ExitCode> {
    node::start_logging("warn");
    let zenoh = args.network.source(OPERATOR)?;
    let report = services::runtime()?.block_on(async {
        let shutdown = Shutdown::on_signals()?;
        let node = Node::open(operator("swap"), &zenoh).await?;
        let report = swap(args, &node, &shutdown).await;
        node.close().await;
        report
    })?;
    let text = match args.format {
        Format::Json => serde_json::to_string(&report)?,
        Format::Text => report.why.clone(),
    };
    writeln!(std::io::stdout(), "{text}")?;
    Ok(ExitCode::from(u8::from(!report.swapped)))
}

async fn swap(args: &SwapArgs, node: &Node, shutdown: &Shutdown) -> anyhow::Result<Report> {
    let statuses = node.subscriber(topic::STATUS, &[]).await?;
    let presence = node.presence("detector").await?;
    let first = timeout(CONTROLLER_PATIENCE, statuses.next()).await.ok().flatten();
    let first = first.context("no controller answered; a detector is swapped while one runs")?;
    let mut there: BTreeSet<String> = node.alive("detector", "*").await?.into_iter().collect();
    there.extend(first.candidates.iter().map(|candidate| candidate.detector.clone()));
    let newcomer = Newcomer::new(args, &there)?;
    let mut report = Report {
        from: first.active_detector.clone(),
        to: newcomer.id.clone(),
        log: newcomer.log.clone(),
        ..Report::default()
    };
    let child = newcomer.start(args)?;
    report.pid = child.id();
    let mut swap = Swap {
        args,
        node,
        shutdown,
        statuses,
        presence,
        there,
        child,
        began: Instant::now(),
        say: args.format == Format::Text,
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
            if args.wait {
                swap.stay().await;
            }
        }
        Err(problem) => {
            swap.give_up(&report).await;
            let old = report.from.as_deref().unwrap_or("none");
            report.why = format!("not swapped, {old} stays in use: {problem:#}");
            if let Some(last) = report.log.as_deref().and_then(last_lines)
                && swap.say
            {
                write_error(&format!("The new detector's last words:\n{last}"));
            }
        }
    }
    Ok(report)
}

/// The detector that is to be started.
struct Newcomer {
    program: PathBuf,
    args: Vec<String>,
    /// Its name, where that is known beforehand.
    id: Option<String>,
    log: Option<PathBuf>,
}

impl Newcomer {
    fn new(args: &SwapArgs, there: &BTreeSet<String>) -> anyhow::Result<Self> {
        let file = Path::new(&args.to);
        let log = |name: &str| match (&args.log, args.wait) {
            (Some(log), _) => Some(log.clone()),
            (None, true) => None,
            (None, false) => {
                let file = format!("alight-{name}-{}.log", std::process::id());
                Some(std::env::temp_dir().join(file))
            }
        };
        if file.extension().is_some_and(|extension| extension == "toml") {
            let layers = Layers { file: Some(file.to_owned()), set: Vec::new() };
            let wanted = match &args.id {
                Some(id) => id.clone(),
                None => layers.load::<detector::Config>()?.settings.id,
            };
            let id = free_name(&wanted, there);
            let layers = Layers { set: vec![format!("id={id}")], ..layers };
            layers.load::<detector::Config>()?;
            let words = ["detector", "--config", &args.to, "--set", &format!("id={id}")];
            return Ok(Self {
                program: std::env::current_exe().context("finding this program's own file")?,
                args: words.map(str::to_owned).into(),
                log: log(&id),
                id: Some(id),
            });
        }
        let words = shlex::split(&args.to).filter(|words| !words.is_empty());
        let mut words = words
            .with_context(|| format!("`{}` is no command: a quote is missing in it", args.to))?
            .into_iter();
        let program = words.next().unwrap_or_default().into();
        Ok(Self { program, args: words.collect(), id: args.id.clone(), log: log("detector") })
    }

    fn start(&self, args: &SwapArgs) -> anyhow::Result<Child> {
        let mut command = Command::new(&self.program);
        command.args(&self.args).envs(args.network.environment()).stdin(Stdio::null());
        if let Some(log) = &self.log {
            let file = File::create(log).with_context(|| format!("writing the log {log:?}"))?;
            command.stdout(file.try_clone()?).stderr(file);
        }
        // Neither this program's end nor Ctrl-C in its terminal ends the detector.
        command.process_group(0);
        command.spawn().with_context(|| format!("starting {}", self.program.display()))
    }
}

/// The name itself, or with the first number that makes it free.
fn free_name(wanted: &str, there: &BTreeSet<String>) -> String {
    let numbered = (2_u32..).map(|number| format!("{wanted}-{number}"));
    std::iter::once(wanted.to_owned())
        .chain(numbered)
        .find(|name| !there.contains(name))
        .unwrap_or_default()
}

/// A swap under way.
struct Swap<'a> {
    args: &'a SwapArgs,
    node: &'a Node,
    shutdown: &'a Shutdown,
    statuses: Subscriber<ControllerStatus>,
    presence: Presence,
    there: BTreeSet<String>,
    child: Child,
    began: Instant,
    say: bool,
}

/// What happened meanwhile.
enum News {
    Status(Box<ControllerStatus>),
    Came(String),
    Left(String),
}

impl Swap<'_> {
    async fn carry_out(&mut self, report: &mut Report) -> anyhow::Result<()> {
        let new = self.until_ready(report.to.clone()).await?;
        report.to = Some(new.clone());
        report.ready_s = Some(self.elapsed_s());
        self.tell(&format!("{new} is ready and runs in shadow"));
        self.until_agreed(&new, report).await?;
        report.agreed_s = Some(self.elapsed_s());
        self.tell(&format!("it agrees in {} of {} frames", report.agreed, report.compared));
        self.use_detector(&new).await?;
        self.until_active(&new).await?;
        report.active_s = Some(self.elapsed_s());
        self.tell(&format!("{new} is used"));
        if let Some(old) = report.from.clone().filter(|old| *old != new && !self.args.keep_old) {
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

    fn tell(&self, line: &str) {
        if self.say {
            write_error(&format!("{:5.1} s  {line}", self.elapsed_s()));
        }
    }

    /// The next news; an error when the new detector ends, somebody asks to stop, or it takes too long.
    async fn news(&mut self, deadline: Instant, waiting_for: &str) -> anyhow::Result<News> {
        tokio::select! {
            Some(status) = self.statuses.next() => Ok(News::Status(Box::new(status))),
            Some((name, alive)) = self.presence.next() => {
                Ok(if alive { News::Came(name) } else { News::Left(name) })
            }
            status = self.child.wait() => {
                let status = status.map_or_else(|cause| cause.to_string(), |s| s.to_string());
                bail!("the new detector ended ({status}) while waiting until {waiting_for}")
            }
            () = self.shutdown.requested() => bail!("interrupted"),
            () = sleep_until(deadline) => bail!("it takes too long until {waiting_for}"),
        }
    }

    async fn until_ready(&mut self, expected: Option<String>) -> anyhow::Result<String> {
        let deadline = Instant::now() + Duration::from_secs(self.args.ready_s);
        loop {
            if let News::Came(name) = self.news(deadline, "the new detector is ready").await? {
                let is_it = expected.as_ref().is_none_or(|expected| *expected == name);
                if is_it && !self.there.contains(&name) {
                    return Ok(name);
                }
            }
        }
    }

    async fn until_agreed(&mut self, new: &str, report: &mut Report) -> anyhow::Result<()> {
        let deadline = Instant::now() + Duration::from_secs(self.args.agree_s);
        loop {
            let waiting_for = match (report.compared, report.agreed) {
                (0, _) => "it can be compared: the active detector sees no marker, or the new one \
                           searches other frames, and so nothing is concluded"
                    .to_owned(),
                (compared, agreed) => format!("it agrees, so far in {agreed} of {compared} frames"),
            };
            match self.news(deadline, &waiting_for).await? {
                News::Left(name) if name == new => bail!("the new detector left the network"),
                News::Status(status) if status.active_detector.as_deref() == Some(new) => {
                    self.tell("the old one failed meanwhile, and the new one took over by itself");
                    return Ok(());
                }
                News::Status(status) => {
                    let Some(shadow) = find(&status, new) else { continue };
                    (report.compared, report.agreed) = (shadow.compared, shadow.agreed);
                    report.disagreement_m = shadow.disagreement_m;
                    if let Some(verdict) = verdict(shadow, self.args.frames) {
                        return verdict;
                    }
                }
                News::Came(_) | News::Left(_) => {}
            }
        }
    }

    async fn use_detector(&self, name: &str) -> anyhow::Result<()> {
        let command = ControllerCommand::UseDetector(name.to_owned());
        let reply = self.node.command(topic::COMMAND, &[], &command).await?;
        match reply.accepted {
            true => Ok(()),
            false => Err(anyhow!("the controller refused {name}: {}", reply.reason)),
        }
    }

    async fn until_active(&mut self, new: &str) -> anyhow::Result<()> {
        let deadline = Instant::now() + ACTIVE_PATIENCE;
        let mut since: Option<Instant> = None;
        loop {
            let News::Status(status) = self.news(deadline, "the new detector is used").await?
            else {
                continue;
            };
            let is_used = status.active_detector.as_deref() == Some(new)
                && find(&status, new).is_some_and(|it| it.state == DetectorState::Active);
            match (is_used, since) {
                (true, Some(since)) if since.elapsed() >= PROBATION => return Ok(()),
                (true, since_before) => since = since_before.or(Some(Instant::now())),
                (false, Some(_)) if status.active_detector.as_deref() != Some(new) => {
                    bail!("it was left again: {}", status.detector_why)
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
        let deadline = Instant::now() + STOP_PATIENCE;
        loop {
            match self.news(deadline, "the old detector has stopped").await? {
                News::Left(name) if name == old => return Ok(()),
                News::Left(_) | News::Came(_) | News::Status(_) => {}
            }
        }
    }

    /// Back to the old detector, and the new one is stopped.
    async fn give_up(&mut self, report: &Report) {
        if let (Some(old), Some(_)) = (&report.from, report.agreed_s)
            && let Err(problem) = self.use_detector(old).await
        {
            write_error(&format!("{old} could not be made the preferred one again: {problem:#}"));
        }
        self.end_child().await;
    }

    async fn end_child(&mut self) {
        let group = self.child.id().and_then(|id| i32::try_from(id).ok()).and_then(Pid::from_raw);
        for signal in [Signal::TERM, Signal::KILL] {
            if let Some(group) = group {
                // One that has ended meanwhile needs no signal.
                let _ = kill_process_group(group, signal);
            }
            if timeout(STOP_PATIENCE, self.child.wait()).await.is_ok() {
                return;
            }
        }
    }

    /// Until the new detector ends, or somebody wants it to.
    async fn stay(&mut self) {
        self.tell("the new detector runs until Ctrl-C");
        let ended = tokio::select! {
            _ = self.child.wait() => true,
            () = self.shutdown.requested() => false,
        };
        if !ended {
            self.end_child().await;
            // Its last words go to the same terminal.
            sleep(Duration::from_millis(50)).await;
        }
    }
}

fn find<'a>(status: &'a ControllerStatus, name: &str) -> Option<&'a Candidate> {
    status.candidates.iter().find(|candidate| candidate.detector == name)
}

/// Whether a detector agrees, once enough frames were compared; `None` while that is open.
fn verdict(shadow: &Candidate, frames: u32) -> Option<anyhow::Result<()>> {
    let (agreed, compared) = (shadow.agreed, shadow.compared);
    if compared < frames {
        return None;
    }
    let part = f64::from(agreed) / f64::from(compared);
    if part >= LEAST_AGREEMENT && shadow.state == DetectorState::Shadow {
        return Some(Ok(()));
    }
    (part < 0.5).then(|| {
        let apart = shadow.disagreement_m.map_or_else(
            || "it does not see the marker".to_owned(),
            |apart_m| format!("it last saw the marker {apart_m:.2} m elsewhere"),
        );
        Err(anyhow!("it agrees in {agreed} of {compared} frames only; {apart}"))
    })
}

fn last_lines(log: &Path) -> Option<String> {
    let text = std::fs::read_to_string(log).ok()?;
    let lines: Vec<&str> = text.lines().collect();
    let last = lines.get(lines.len().saturating_sub(LAST_LINES)..)?;
    (!last.is_empty()).then(|| last.join("\n"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shadow(compared: u32, agreed: u32) -> Candidate {
        Candidate {
            detector: "new".into(),
            state: DetectorState::Shadow,
            place: None,
            age_ms: 50.0,
            latency_ms: 40.0,
            rate_hz: 15.0,
            alive: true,
            disagreement_m: Some(0.4),
            compared,
            agreed,
        }
    }

    #[test]
    fn agreement_is_concluded_from_enough_frames_only() {
        assert!(verdict(&shadow(14, 14), 15).is_none());
        assert!(verdict(&shadow(15, 14), 15).unwrap().is_ok());
        assert!(verdict(&shadow(15, 10), 15).is_none(), "it may still come to agree");
        let refused = verdict(&shadow(15, 3), 15).unwrap().unwrap_err().to_string();
        assert!(refused.contains("3 of 15") && refused.contains("0.40 m"), "{refused}");
        let stale = Candidate { state: DetectorState::Stale, ..shadow(15, 15) };
        assert!(verdict(&stale, 15).is_none());
    }

    #[test]
    fn a_name_that_is_taken_gets_a_number() {
        let there: BTreeSet<String> = ["main", "main-2"].map(Into::into).into();
        assert_eq!(free_name("main", &there), "main-3");
        assert_eq!(free_name("spare", &there), "spare");
    }
}
