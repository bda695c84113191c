//! `alight up ROLE`: the processes of one machine, started in order, started again when they end, stopped in order.

use std::collections::VecDeque;
use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context;
use clap::Args;
use node::Shutdown;
use tokio::process::Command;
use tokio::time::Instant;

use crate::children::{Children, End, News};
use crate::neighbours::{Memory, Neighbours, Post};
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
    /// Its process number, once it was started.
    pid: i32,
    ends: VecDeque<Instant>,
    state: State,
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum State {
    Running,
    /// To be started again at this time.
    Waiting(Instant),
    /// A detector that was asked to stop: not to be started while another one at its post stands in for it.
    StoodDown(Post),
    GivenUp,
}

impl Watched {
    fn new(job: Job) -> Self {
        Self { job, pid: 0, ends: VecDeque::new(), state: State::Running }
    }

    /// What becomes of a detector that has ended in good order because another one was swapped in for it, and what is
    /// said about it; `None` for any other process and any other end.
    fn stands_down(&mut self, end: &End, neighbours: &Neighbours, own: &[i32]) -> Option<String> {
        let post = neighbours.post_of(self.pid).filter(|_| end.status == Some(0))?;
        let other = neighbours.stand_in(&post, own)?;
        self.state = State::StoodDown(post);
        let name = &self.job.name;
        Some(format!(
            "{name}: was asked to stop, and the detector `{other}` stands in for it; it is started again when that has gone"
        ))
    }

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
    let memory = Memory::of(&site.instance(role));
    let mut neighbours = neighbours(site, role, &jobs, &memory).await?;
    let mut children = Children::new();
    let mut watched: Vec<Watched> = jobs.into_iter().map(Watched::new).collect();
    // After a supervisor that was killed the landing goes on.
    let interrupted = memory.landing();
    if interrupted {
        say("a landing was under way a moment ago; it is taken up");
    }
    for (index, first) in watched.iter_mut().enumerate() {
        let is_controller = first.job.service == Some(Service::Controller);
        let start_as = (interrupted && is_controller).then_some("resume");
        first.pid = start(&mut children, index, &first.job, start_as, site)?;
    }
    let everything_given_up =
        watch(&mut children, &mut watched, &mut neighbours, site, shutdown).await?;
    say("stopping");
    // The last one first: whoever steers stops steering while there still is somebody to hear it.
    for (index, stopped) in watched.iter().enumerate().rev() {
        children.stop_one(&index, |news| tell(&watched, news)).await;
        if stopped.state == State::Running {
            say(&format!("{}: stopped", stopped.job.name));
        }
    }
    // Who stops in good order does not want it to be taken up by the next one; what is still heard must not be noted after.
    neighbours.close().await;
    memory.note(false);
    Ok(ExitCode::from(u8::from(everything_given_up)))
}

/// Whoever must be heard so that the processes are started again rightly.
async fn neighbours(
    site: &Site,
    role: Role,
    jobs: &[Job],
    memory: &Memory,
) -> anyhow::Result<Neighbours> {
    let of = |service| jobs.iter().find(|job| job.service == Some(service));
    // The memory is that of who steers.
    let (key, memory) = match (of(Service::Controller), of(Service::Detector)) {
        (Some(controller), _) => (&controller.key, memory.clone()),
        (None, Some(detector)) => (&detector.key, Memory::default()),
        (None, None) => return Ok(Neighbours::none()),
    };
    Neighbours::follow(&site.network(role), key, memory).await
}

/// Starts again what ends, until the end is asked for (false) or nothing is left to be started (true).
async fn watch(
    children: &mut Children<usize>,
    watched: &mut [Watched],
    neighbours: &mut Neighbours,
    site: &Site,
    shutdown: Shutdown,
) -> anyhow::Result<bool> {
    loop {
        if watched.iter().all(|w| w.state == State::GivenUp) {
            return Ok(true);
        }
        let due = watched.iter().enumerate().filter_map(|(index, w)| match w.state {
            State::Waiting(at) => Some((at, index)),
            State::Running | State::StoodDown(_) | State::GivenUp => None,
        });
        let next = due.min();
        let next_start = tokio::time::sleep_until(next.map_or_else(far_away, |(at, _)| at));
        tokio::select! {
            () = shutdown.requested() => return Ok(false),
            Some(news) = children.next() => {
                tell(watched, &news);
                if let News::Ended(index, end) = news {
                    children.forget(&index);
                    let own = pids(watched);
                    if let Some(ended) = watched.get_mut(index) {
                        let said = ended.stands_down(&end, neighbours, &own);
                        say(&said.unwrap_or_else(|| ended.ended(&end, Instant::now())));
                    }
                }
            }
            () = neighbours.changed() => relieve(watched, neighbours),
            () = next_start => {
                let Some((_, index)) = next else { continue };
                let Some(again) = watched.get_mut(index) else { continue };
                let start_as = start_of(&again.job, neighbours.landing());
                again.pid = start(children, index, &again.job, start_as, site)?;
                again.state = State::Running;
            }
        }
    }
}

fn pids(watched: &[Watched]) -> Vec<i32> {
    watched.iter().map(|watched| watched.pid).collect()
}

/// Has the detectors that stood down started again for which nobody stands in any more.
fn relieve(watched: &mut [Watched], neighbours: &Neighbours) {
    let own = pids(watched);
    for down in watched {
        if let State::StoodDown(post) = &down.state
            && neighbours.stand_in(post, &own).is_none()
        {
            say(&format!("{}: nobody stands in for it any more; again at once", down.job.name));
            down.state = State::Waiting(Instant::now());
        }
    }
}

/// How a controller begins when it is started again. It never takes off a second time, and it takes a landing up only
/// if there was one: a vehicle that is flown in GUIDED by somebody else is not landed.
fn start_of(job: &Job, landing: bool) -> Option<&'static str> {
    let is_controller = job.service == Some(Service::Controller);
    is_controller.then_some(if landing { "resume" } else { "command" })
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
) -> anyhow::Result<i32> {
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
    Ok(pid)
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
        Watched::new(job)
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
