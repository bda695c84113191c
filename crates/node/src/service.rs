//! Runs a service from its start (logging, Zenoh's threads, session) to an orderly shutdown on a signal, with its health
//! report each second.

use std::future::Future;
use std::io::IsTerminal;
use std::path::PathBuf;

use anyhow::Context;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::watch;
use tracing_subscriber::Layer;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

use crate::config::Layers;
use crate::denied::{DeniedCounter, DeniedFilter};
use crate::identity::Identity;
use crate::session::{Node, ZenohSource};

/// Zenoh's threads: enough that a broken air link cannot block them all, and one pool for everything
/// incoming, so that a message is not passed from the accepting to the receiving pool (measured:
/// `zenoh-config/README.md`).
const ZENOH_RUNTIME: &str =
    "(tx:(worker_threads:4),net:(worker_threads:8),rx:(handover:net),acc:(handover:net))";
const ZENOH_RUNTIME_VARIABLE: &str = "ZENOH_RUNTIME";

/// The start options of a service.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Settings over the defaults.
    pub layers: Layers,
    /// The network.
    pub zenoh: ZenohSource,
}

/// A request to shut down; clones share it.
#[derive(Clone, Debug)]
pub struct Shutdown {
    requested: watch::Receiver<Option<Cause>>,
}

/// The cause of a shutdown request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Cause {
    /// The user or supervisor, by SIGINT or SIGTERM.
    Operator,
    /// SIGHUP.
    Hangup,
}

impl Shutdown {
    /// Requested by SIGINT (Ctrl-C), SIGTERM, or SIGHUP (the end of a terminal) unless that is ignored, as `nohup` does.
    ///
    /// # Errors
    /// When the signal handlers cannot be installed.
    pub fn on_signals() -> anyhow::Result<Self> {
        let mut interrupt = signal(SignalKind::interrupt()).context("listening to SIGINT")?;
        let mut terminate = signal(SignalKind::terminate()).context("listening to SIGTERM")?;
        // A handler would undo that it is ignored.
        let mut hangup = match ignores_hangups() {
            true => None,
            false => Some(signal(SignalKind::hangup()).context("listening to SIGHUP")?),
        };
        let (sender, requested) = watch::channel(None);
        tokio::spawn(async move {
            let hung_up = async {
                match &mut hangup {
                    Some(hangup) => drop(hangup.recv().await),
                    None => std::future::pending().await,
                }
            };
            let cause = tokio::select! {
                _ = interrupt.recv() => Cause::Operator,
                _ = terminate.recv() => Cause::Operator,
                () = hung_up => Cause::Hangup,
            };
            if cause == Cause::Hangup {
                tracing::warn!(
                    "SIGHUP came, as when a terminal is closed, so this process stops; one that is started as a systemd unit or in tmux has no \
                     terminal that is closed, and one that is started with `nohup` ignores it"
                );
            }
            // There is no receiver left when the service has ended on its own.
            sender.send_replace(Some(cause));
            // Keeps the sender: without it receivers would see a closed channel.
            std::future::pending::<()>().await;
        });
        Ok(Self { requested })
    }

    /// Returns when a shutdown is requested.
    pub async fn requested(&self) {
        let mut requested = self.requested.clone();
        // The channel closes when the runtime shuts down, which is a request too.
        drop(requested.wait_for(Option::is_some).await);
    }

    /// Whether it was requested by SIGHUP, so perhaps unintentionally.
    pub fn is_by_hangup(&self) -> bool {
        *self.requested.borrow() == Some(Cause::Hangup)
    }
}

/// Whether this process was started with SIGHUP ignored.
pub fn ignores_hangups() -> bool {
    const HANGUP: u8 = 1;
    std::fs::read_to_string("/proc/self/status").is_ok_and(|status| is_ignored(&status, HANGUP))
}

/// Whether a process with this status (`/proc/PID/status`) ignores a signal.
fn is_ignored(status: &str, signal: u8) -> bool {
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let ignored = ignored.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    ignored.is_some_and(|mask| mask >> (signal - 1) & 1 == 1)
}

/// Runs a service until it ends, fails or is asked to stop, and publishes its health.
///
/// `service` must call [`Node::announce`] when it is ready.
///
/// # Errors
/// The error of the service.
pub async fn run<F, Fut>(identity: Identity, zenoh: &ZenohSource, service: F) -> anyhow::Result<()>
where
    F: FnOnce(Node, Shutdown) -> Fut,
    Fut: Future<Output = anyhow::Result<()>>,
{
    let shutdown = Shutdown::on_signals()?;
    let node = tokio::select! {
        node = Node::open(identity, zenoh) => node?,
        // The process can be stopped also while it cannot join the network.
        () = shutdown.requested() => return Ok(()),
    };
    // In a separate task: it continues however busy the service is.
    let reporter = node.clone();
    let mut health = tokio::spawn(async move { reporter.publish_health().await });
    let result = tokio::select! {
        result = service(node.clone(), shutdown.clone()) => result,
        result = &mut health => result.context("reporting the health").flatten(),
    };
    health.abort();
    tracing::info!(service = node.identity().service, "Stopping");
    node.close().await;
    result
}

/// The log levels of Zenoh. It warns about every failed attempt to listen at or connect to the rendezvous, which are expected here, and
/// about messages in flight when their sender's session closes ("Route data with unknown scope", "Route query with unknown scope";
/// eclipse-zenoh/zenoh issues 980 and 1050, pull request 2524). Such a query gets an empty reply, and a command without a recipient is
/// sent again.
const ZENOH_LEVELS: &str = "zenoh=error,zenoh::net::routing::dispatcher::pubsub=off,zenoh::net::routing::dispatcher::queries=off,zenoh::api::session=off,zenoh_transport=off,zenoh_link=error,zenoh_link_tls=error,zenoh_shm=error";

/// Starts logging to standard error, at `default_level` unless `ALIGHT_LOG` sets another: a level (`debug`), or levels by module
/// (`info,controller=debug`).
pub fn start_logging(default_level: &str) {
    let wanted = std::env::var("ALIGHT_LOG").ok().filter(|level| !level.is_empty());
    let level = wanted.as_deref().unwrap_or(default_level);
    let (filter, problem) = match levels(level) {
        Ok(filter) => (filter, None),
        Err(problem) => (levels(default_level).unwrap_or_default(), Some(problem)),
    };
    let log = tracing_subscriber::fmt::layer()
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal())
        .with_target(false)
        // Reporting a broken pipe to that pipe would end the process.
        .log_internal_errors(false)
        .with_filter(filter);
    let denied = DeniedCounter.with_filter(DeniedFilter);
    // A subscriber that is installed already (by a test, say) stays.
    drop(tracing_subscriber::registry().with(log).with(denied).try_init());
    if let Some(problem) = problem {
        tracing::warn!(
            ALIGHT_LOG = level,
            %problem,
            "Logging at {default_level:?}: the value of ALIGHT_LOG is no level (error, warn, info, debug, trace, off), nor levels by module (info,controller=debug)"
        );
    }
}

/// These levels over those of Zenoh.
fn levels(ours: &str) -> anyhow::Result<Targets> {
    // A word other than a level would be taken for a module: all of it would be logged, and nothing of the others.
    for level in ours.split(',').filter(|entry| !entry.contains('=')) {
        level.parse::<LevelFilter>().with_context(|| format!("{level:?}"))?;
    }
    Ok(format!("{ZENOH_LEVELS},{ours}").parse()?)
}

/// Sets the number of Zenoh's threads by re-executing this program with `ZENOH_RUNTIME` in its environment,
/// which Zenoh reads once, and which a program with threads must not change. Call it first in `main`; returns
/// when the variable is set already.
pub fn relaunch_with_zenoh_threads() {
    if std::env::var_os(ZENOH_RUNTIME_VARIABLE).is_some() {
        return;
    }
    let problem = relaunch(&[(ZENOH_RUNTIME_VARIABLE, ZENOH_RUNTIME)]);
    // The default is enough on one machine; only a broken air link needs more.
    tracing::warn!(%problem, "Zenoh runs with its default threads");
}

/// Replaces this process by a new one of the same program with the same arguments; process id, parent and
/// standard streams stay, and every connection is closed at once. Returns only if that fails.
pub fn relaunch(environment: &[(&str, &str)]) -> std::io::Error {
    use std::os::unix::process::CommandExt;
    std::process::Command::new(own_program())
        .args(std::env::args_os().skip(1))
        .envs(environment.iter().copied())
        .exec()
}

/// The file of this program, to start it again: also where it was replaced or removed since it started.
pub fn own_program() -> PathBuf {
    let file = std::env::current_exe().ok().filter(|file| file.is_file());
    file.unwrap_or_else(|| "/proc/self/exe".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_are_set_by_module_over_those_of_zenoh() -> Result<(), Box<dyn std::error::Error>> {
        use tracing::Level;
        let info = levels("info")?;
        assert!(info.would_enable("controller::service", &Level::INFO));
        assert!(!info.would_enable("controller::service", &Level::DEBUG));
        assert!(!info.would_enable("zenoh::net::runtime", &Level::WARN));
        assert!(!info.would_enable("zenoh::api::session", &Level::ERROR));
        let debug = levels("info,controller=debug,zenoh=warn")?;
        assert!(debug.would_enable("controller::service", &Level::DEBUG));
        assert!(!debug.would_enable("detector::service", &Level::DEBUG));
        assert!(debug.would_enable("zenoh::net::runtime", &Level::WARN));
        assert!(levels("loud").is_err() && levels("info,controller=loud").is_err());
        Ok(())
    }

    #[test]
    fn an_ignored_signal_is_found_in_the_status_of_the_process() {
        let status =
            "SigBlk:\t0000000000000000\nSigIgn:\t0000000000001001\nSigCgt:\t0000000000004002\n";
        assert!(is_ignored(status, 1));
        assert!(!is_ignored(status, 2) && !is_ignored(status, 15));
        assert!(!is_ignored("", 1));
    }
}
