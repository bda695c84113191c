//! `alight up ROLE`: the processes of one machine, started in order, started again when they end, stopped in order.

use std::collections::VecDeque;
use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context;
use clap::Args;
use messages::topic;
use node::{Identity, Node, Shutdown};
use tokio::process::Command;
use tokio::time::Instant;

use crate::children::{Children, End, News};
use crate::services::{self, Service};
use crate::site::{Job, Role, Site};

/// What is started.
#[derive(Args, Clone)]
pub(crate) struct UpArgs {
    /// What this machine is for.
    #[arg(value_enum)]
    role: Role,
    /// The site: what runs where (TOML); `docs/deploy.md` explains it.
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Print what would be run, and run nothing.
    #[arg(long)]
    dry_run: bool,
}

/// Pause before a process is started again; doubled each time it ends soon.
const FIRST_PAUSE: Duration = Duration::from_millis(500);
const LONGEST_PAUSE: Duration = Duration::from_secs(8);
/// So many ends within this time, and a process is given up.
const MOST_ENDS: usize = 6;
const PERIOD: Duration = Duration::from_secs(60);
/// The exit status of a process that was asked for something impossible: starting it again changes nothing.
const WRONG_USE: i32 = 2;

/// Runs a role until it is asked to stop, or until everything has been given up.
pub(crate) fn run(args: &UpArgs) -> anyhow::Result<ExitCode> {
    let site = Site::read(&args.config)?;
    let jobs = site.jobs(args.role)?;
    if args.dry_run {
        for job in &jobs {
            say(&by_hand(job));
        }
        return Ok(ExitCode::SUCCESS);
    }
    node::start_logging("warn");
    services::runtime()?.block_on(supervise(&site, args.role, jobs))
}

/// A line for whoever watches; when nobody does, it is lost.
fn say(line: &str) {
    drop(writeln!(std::io::stdout(), "{line}"));
}

/// The command line that does the same.
fn by_hand(job: &Job) -> String {
    let environment: Vec<_> =
        job.environment().into_iter().map(|(name, value)| format!("{name}={value}")).collect();
    let arguments = arguments(job).into_iter().map(|argument| {
        let plain = |c: char| c.is_ascii_alphanumeric() || "-_./:,".contains(c);
        if argument.chars().all(plain) { argument } else { format!("'{argument}'") }
    });
    let command: Vec<_> = arguments.collect();
    format!("{} {}", environment.join(" "), command.join(" "))
}

/// The program and its arguments.
fn arguments(job: &Job) -> Vec<String> {
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
struct Watched {
    job: Job,
    ends: VecDeque<Instant>,
    state: State,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Running,
    /// To be started again at this time.
    Waiting(Instant),
    GivenUp,
}

impl Watched {
    /// What becomes of a process that has ended now, and what is said about it.
    fn ended(&mut self, end: &End, now: Instant) -> String {
        self.ends.push_back(now);
        self.ends.retain(|end| now.duration_since(*end) <= PERIOD);
        let name = &self.job.name;
        if end.status == Some(WRONG_USE) {
            self.state = State::GivenUp;
            return format!(
                "{name}: it cannot run as it is configured ({end}); given up. Its last words above say what to change; then start `alight up` again"
            );
        }
        if self.ends.len() >= MOST_ENDS {
            self.state = State::GivenUp;
            return format!(
                "{name}: ended {MOST_ENDS} times within {} s, at last with {end}; given up. Its last words above say why; the others go on without it",
                PERIOD.as_secs()
            );
        }
        let doublings = u32::try_from(self.ends.len()).unwrap_or(u32::MAX).saturating_sub(1);
        let pause = (FIRST_PAUSE * 2_u32.saturating_pow(doublings)).min(LONGEST_PAUSE);
        self.state = State::Waiting(now + pause);
        format!("{name}: ended with {end}; again in {} s", pause.as_secs_f64())
    }
}

async fn supervise(site: &Site, role: Role, jobs: Vec<Job>) -> anyhow::Result<ExitCode> {
    let shutdown = Shutdown::on_signals()?;
    let landing = Landing::follow(site, role, &jobs).await?;
    let mut children = Children::new();
    let mut watched = Vec::new();
    for (index, job) in jobs.into_iter().enumerate() {
        start(&mut children, index, &job, None, site)?;
        watched.push(Watched { job, ends: VecDeque::new(), state: State::Running });
    }
    let everything_given_up = watch(&mut children, &mut watched, &landing, site, shutdown).await?;
    say("stopping");
    // The last one first: whoever steers stops steering while there still is somebody to hear it.
    for (index, stopped) in watched.iter().enumerate().rev() {
        children.stop_one(&index, |news| tell(&watched, news)).await;
        if stopped.state == State::Running {
            say(&format!("{}: stopped", stopped.job.name));
        }
    }
    Ok(ExitCode::from(u8::from(everything_given_up)))
}

/// Starts again what ends, until the end is asked for (false) or nothing is left to be started (true).
async fn watch(
    children: &mut Children<usize>,
    watched: &mut [Watched],
    landing: &Landing,
    site: &Site,
    shutdown: Shutdown,
) -> anyhow::Result<bool> {
    loop {
        if watched.iter().all(|w| w.state == State::GivenUp) {
            return Ok(true);
        }
        let due = watched.iter().enumerate().filter_map(|(index, w)| match w.state {
            State::Waiting(at) => Some((at, index)),
            State::Running | State::GivenUp => None,
        });
        let next = due.min();
        let next_start = tokio::time::sleep_until(next.map_or_else(far_away, |(at, _)| at));
        tokio::select! {
            () = shutdown.requested() => return Ok(false),
            Some(news) = children.next() => {
                tell(watched, &news);
                if let News::Ended(index, end) = news {
                    children.forget(&index);
                    if let Some(ended) = watched.get_mut(index) {
                        say(&ended.ended(&end, Instant::now()));
                    }
                }
            }
            () = next_start => {
                let Some((_, index)) = next else { continue };
                let Some(again) = watched.get_mut(index) else { continue };
                let start_as = landing.start_of(&again.job);
                start(children, index, &again.job, start_as, site)?;
                again.state = State::Running;
            }
        }
    }
}

fn far_away() -> Instant {
    Instant::now() + Duration::from_secs(3600)
}

/// Shows what a child says.
fn tell(watched: &[Watched], news: &News<usize>) {
    if let News::Said(index, line) = news
        && let Some(speaker) = watched.get(*index)
    {
        say(&format!("{}: {line}", speaker.job.name));
    }
}

fn start(
    children: &mut Children<usize>,
    index: usize,
    job: &Job,
    start_as: Option<&str>,
    site: &Site,
) -> anyhow::Result<()> {
    let mut words = arguments(job);
    if let Some(start) = start_as {
        words.extend(["--set".to_owned(), format!("start=\"{start}\"")]);
    }
    let (program, rest) = words.split_first().context("an empty command")?;
    let own = program == "alight";
    let file = if own {
        std::env::current_exe().context("finding this program's own file")?
    } else {
        PathBuf::from(program)
    };
    let mut command = Command::new(file);
    command.args(rest).envs(job.environment()).current_dir(&site.folder);
    // Ctrl-C in a terminal is for the supervisor, which stops the others in order.
    command.process_group(0);
    if own {
        command.arg("--stop-with-parent").arg(std::process::id().to_string());
    }
    let pid = children.spawn(index, command, &job.name)?;
    let as_what = start_as.map_or_else(String::new, |start| format!(", start = \"{start}\""));
    say(&format!("{}: started as process {pid}{as_what}", job.name));
    Ok(())
}

/// Knows whether a landing is under way, so that a controller that is started again takes it up, and only then.
struct Landing {
    under_way: tokio::sync::watch::Receiver<bool>,
    _node: Option<Node>,
}

impl Landing {
    async fn follow(site: &Site, role: Role, jobs: &[Job]) -> anyhow::Result<Self> {
        let (sender, under_way) = tokio::sync::watch::channel(false);
        if !jobs.iter().any(|job| job.service == Some(Service::Controller)) {
            return Ok(Self { under_way, _node: None });
        }
        let identity =
            Identity { service: "alight", instance: format!("up-{}", std::process::id()) };
        let node = Node::open(identity, &site.network(role).source("controller")?).await?;
        let statuses = node.subscriber(topic::STATUS, &[]).await?;
        tokio::spawn(async move {
            while let Some(status) = statuses.next().await {
                sender.send_replace(status.started_ns.is_some() && !status.finished);
            }
        });
        Ok(Self { under_way, _node: Some(node) })
    }

    /// How a controller begins when it is started again. It never takes off a second time, and it takes a landing up
    /// only if there was one: a vehicle that is flown in GUIDED by somebody else is not landed.
    fn start_of(&self, job: &Job) -> Option<&'static str> {
        if job.service != Some(Service::Controller) {
            return None;
        }
        Some(if *self.under_way.borrow() { "airborne" } else { "command" })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn watched() -> Watched {
        let job = Job {
            name: "detector".to_owned(),
            service: Some(Service::Detector),
            command: vec!["alight".to_owned(), "detector".to_owned()],
            network: node::Network::default(),
            key: "detector".to_owned(),
            layers: node::Layers::default(),
        };
        Watched { job, ends: VecDeque::new(), state: State::Running }
    }

    fn failure(status: i32) -> End {
        End { words: format!("exit status: {status}"), status: Some(status) }
    }

    #[test]
    fn what_keeps_ending_is_started_ever_later_and_then_given_up() {
        let mut watched = watched();
        let mut now = Instant::now();
        let mut pauses = Vec::new();
        while watched.state != State::GivenUp {
            let said = watched.ended(&failure(1), now);
            if let State::Waiting(at) = watched.state {
                pauses.push(at - now);
                now = at;
            } else {
                assert!(said.contains("given up"), "{said}");
            }
        }
        let half_seconds: Vec<_> = pauses.iter().map(|p| p.as_millis() / 500).collect();
        assert_eq!(half_seconds, [1, 2, 4, 8, 16]);
    }

    #[test]
    fn what_ends_now_and_then_is_started_at_once() {
        let mut watched = watched();
        let mut now = Instant::now();
        for _ in 0..20 {
            watched.ended(&failure(1), now);
            assert_eq!(watched.state, State::Waiting(now + FIRST_PAUSE));
            now += PERIOD + FIRST_PAUSE;
        }
    }

    #[test]
    fn what_cannot_run_is_given_up_at_once() {
        let mut watched = watched();
        let said = watched.ended(&failure(WRONG_USE), Instant::now());
        assert_eq!(watched.state, State::GivenUp);
        assert!(said.contains("cannot run"), "{said}");
    }
}
