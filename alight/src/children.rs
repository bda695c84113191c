//! Child processes by their names: start them, hear what they say, notice their end, stop them.

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
pub(crate) enum News<K> {
    /// It wrote a line.
    Said(K, String),
    /// It ended.
    Ended(K, End),
}

/// How a child ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct End {
    /// In words.
    pub(crate) words: String,
    /// Its exit status, if it had one.
    pub(crate) status: Option<i32>,
}

impl std::fmt::Display for End {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.words)
    }
}

/// The running children, each with its key.
pub(crate) struct Children<K> {
    pids: Vec<(K, Pid)>,
    sender: mpsc::Sender<News<K>>,
    news: mpsc::Receiver<News<K>>,
}

impl Children<Service> {
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
            by_hand.push_str(" --set 'start=\"resume\"'");
        }
        if std::env::var_os("ALIGHT_LOG").is_none() {
            command.env("ALIGHT_LOG", "warn");
        }
        let number = self.spawn(service, command, service.name())?;
        Ok(format!("{} is process {number}; by hand: {by_hand}", service.name()))
    }
}

impl<K: Clone + PartialEq + Send + 'static> Children<K> {
    pub(crate) fn new() -> Self {
        let (sender, news) = mpsc::channel(LINES_WAITING);
        Self { pids: Vec::new(), sender, news }
    }

    /// Starts a child; the answer is its process number.
    pub(crate) fn spawn(
        &mut self,
        key: K,
        mut command: Command,
        name: &str,
    ) -> anyhow::Result<i32> {
        let child = command
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .kill_on_drop(true)
            .spawn()
            .with_context(|| format!("starting {name}"))?;
        let pid = child.id().and_then(|id| i32::try_from(id).ok()).and_then(Pid::from_raw);
        self.pids.extend(pid.map(|pid| (key.clone(), pid)));
        tokio::spawn(follow(key, child, self.sender.clone()));
        Ok(pid.map_or(0, |pid| pid.as_raw_nonzero().get()))
    }

    /// The next news.
    pub(crate) async fn next(&mut self) -> Option<News<K>> {
        self.news.recv().await
    }

    /// Forgets a child that has ended.
    pub(crate) fn forget(&mut self, key: &K) {
        self.pids.retain(|(running, _)| running != key);
    }

    /// Asks one to stop, waits, and stops it if it does not; what is heard meanwhile is told.
    pub(crate) async fn stop_one(&mut self, key: &K, mut tell: impl FnMut(&News<K>)) {
        for signal in [Signal::TERM, Signal::KILL] {
            let Some((_, pid)) = self.pids.iter().find(|(running, _)| running == key) else {
                return;
            };
            // One that has ended meanwhile needs no signal.
            let _ = kill_process(*pid, signal);
            let its_end = async {
                while let Some(news) = self.news.recv().await {
                    tell(&news);
                    if let News::Ended(ended, _) = news {
                        self.pids.retain(|(running, _)| *running != ended);
                        if ended == *key {
                            return;
                        }
                    }
                }
            };
            if tokio::time::timeout(STOP_PATIENCE, its_end).await.is_ok() {
                return;
            }
        }
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
                        Some(News::Ended(ended, _)) => self.forget(&ended),
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
async fn follow<K: Clone>(key: K, mut child: Child, news: mpsc::Sender<News<K>>) {
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
                if news.try_send(News::Said(key.clone(), line)).is_ok() { 0 } else { left_out + 1 };
        }
    }
    let end = match child.wait().await {
        Ok(status) => End { words: status.to_string(), status: status.code() },
        Err(cause) => End { words: cause.to_string(), status: None },
    };
    drop(news.send(News::Ended(key, end)).await);
}
