//! The services as child processes: start them, hear what they say, notice their end, stop them.

use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use anyhow::Context;
use rustix::process::{Pid, Signal, kill_process};
use tokio::io::{AsyncBufReadExt, BufReader};
use tokio::process::{Child, Command};
use tokio::sync::mpsc;

use crate::services::Service;

/// How long a service may take to stop by itself.
const STOP_PATIENCE: Duration = Duration::from_secs(2);
/// Lines that wait to be shown; more are left out, as no service may ever wait for a terminal.
const LINES_WAITING: usize = 256;

/// What a child did.
pub(crate) enum News {
    /// It wrote a line.
    Said(Service, String),
    /// It ended.
    Ended(Service, String),
}

/// The running children.
pub(crate) struct Children {
    pids: Vec<(Service, Pid)>,
    sender: mpsc::Sender<News>,
    news: mpsc::Receiver<News>,
}

impl Children {
    pub(crate) fn new() -> Self {
        let (sender, news) = mpsc::channel(LINES_WAITING);
        Self { pids: Vec::new(), sender, news }
    }

    /// Starts a service as a process of this same program; the answer is how to start it again by hand.
    pub(crate) fn start(
        &mut self,
        service: Service,
        zenoh: &Path,
        settings: &[String],
    ) -> anyhow::Result<String> {
        let program = std::env::current_exe().context("finding this program's own file")?;
        let mut command = Command::new(program);
        command.arg(service.name()).arg("--zenoh").arg(zenoh);
        command.arg("--stop-with-parent").arg(std::process::id().to_string());
        let mut by_hand = format!("alight {} --zenoh {}", service.name(), zenoh.display());
        for setting in settings {
            command.arg("--set").arg(setting);
            by_hand.push_str(&format!(" --set '{setting}'"));
        }
        if service == Service::Controller {
            // One that is started again takes the landing up, and never takes off a second time.
            by_hand.push_str(" --set 'start=\"airborne\"'");
        }
        if std::env::var_os("ALIGHT_LOG").is_none() {
            command.env("ALIGHT_LOG", "warn");
        }
        let child = command
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .kill_on_drop(true)
            .spawn()
            .with_context(|| format!("starting {}", service.name()))?;
        let pid = child.id().and_then(|id| i32::try_from(id).ok()).and_then(Pid::from_raw);
        self.pids.extend(pid.map(|pid| (service, pid)));
        tokio::spawn(follow(service, child, self.sender.clone()));
        let number = pid.map_or(0, |pid| pid.as_raw_nonzero().get());
        Ok(format!("{} is process {number}; by hand: {by_hand}", service.name()))
    }

    /// The next news.
    pub(crate) async fn next(&mut self) -> Option<News> {
        self.news.recv().await
    }

    /// Forgets a child that has ended.
    pub(crate) fn forget(&mut self, service: Service) {
        self.pids.retain(|(running, _)| *running != service);
    }

    /// Asks all to stop, waits, and stops those that do not.
    pub(crate) async fn stop(mut self) {
        for signal in [Signal::TERM, Signal::KILL] {
            for (_, pid) in &self.pids {
                // One that has ended meanwhile needs no signal.
                let _ = kill_process(*pid, signal);
            }
            let all_ended = async {
                while !self.pids.is_empty() {
                    match self.news.recv().await {
                        Some(News::Ended(service, _)) => {
                            self.pids.retain(|(running, _)| *running != service);
                        }
                        Some(News::Said(..)) => {}
                        None => return,
                    }
                }
            };
            if tokio::time::timeout(STOP_PATIENCE, all_ended).await.is_ok() {
                return;
            }
        }
    }
}

/// Tells what a child says, and then its end.
async fn follow(service: Service, mut child: Child, news: mpsc::Sender<News>) {
    if let Some(stderr) = child.stderr.take() {
        let mut lines = BufReader::new(stderr).lines();
        let mut left_out = 0_u64;
        while let Ok(Some(line)) = lines.next_line().await {
            let line = match left_out {
                0 => line,
                _ => format!("({left_out} lines are left out) {line}"),
            };
            // Nobody listens any more once everything is being stopped.
            left_out =
                if news.try_send(News::Said(service, line)).is_ok() { 0 } else { left_out + 1 };
        }
    }
    let end = match child.wait().await {
        Ok(status) => status.to_string(),
        Err(cause) => cause.to_string(),
    };
    drop(news.send(News::Ended(service, end)).await);
}
