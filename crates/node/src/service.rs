//! A service from its start to its end.

use std::future::Future;
use std::io::IsTerminal;

use anyhow::Context;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::watch;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer};

use crate::config::Layers;
use crate::refusals::{OnlyRefusals, Refusals};
use crate::session::{Identity, Node, ZenohSource};

/// The number of threads a cut air link must not be able to stop, and one group of them for all that comes in, so that a
/// message is not handed from the group that made the connection to the one that receives (see `zenoh-config/README.md`).
const ZENOH_RUNTIME: &str =
    "(tx:(worker_threads:4),net:(worker_threads:8),rx:(handover:net),acc:(handover:net))";
const ZENOH_RUNTIME_VARIABLE: &str = "ZENOH_RUNTIME";

/// What every service is started with.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// What is laid over the defaults.
    pub layers: Layers,
    /// The network.
    pub zenoh: ZenohSource,
}

/// Becomes true when the service should end; clones see the same.
#[derive(Clone, Debug)]
pub struct Shutdown {
    requested: watch::Receiver<bool>,
}

impl Shutdown {
    /// Ends when the process is asked to (Ctrl-C, SIGTERM).
    ///
    /// # Errors
    /// When the system refuses the signal handlers.
    pub fn on_signals() -> anyhow::Result<Self> {
        let mut interrupt = signal(SignalKind::interrupt()).context("listening to SIGINT")?;
        let mut terminate = signal(SignalKind::terminate()).context("listening to SIGTERM")?;
        let (sender, requested) = watch::channel(false);
        tokio::spawn(async move {
            tokio::select! {
                _ = interrupt.recv() => {}
                _ = terminate.recv() => {}
            }
            // Nobody listens any more when the service has ended by itself.
            sender.send_replace(true);
            // The sender must outlive the request, or receivers would see a closed channel instead.
            std::future::pending::<()>().await;
        });
        Ok(Self { requested })
    }

    /// Returns when the service should end.
    pub async fn requested(&self) {
        let mut requested = self.requested.clone();
        // A closed channel means that the runtime is going down, which is a request too.
        drop(requested.wait_for(|requested| *requested).await);
    }
}

/// Runs a service on the network until it ends, fails, or is asked to stop; publishes its health meanwhile.
///
/// `service` must call [`Node::announce`] when it is ready.
///
/// # Errors
/// What the service failed with.
pub async fn run<F, Fut>(identity: Identity, zenoh: &ZenohSource, service: F) -> anyhow::Result<()>
where
    F: FnOnce(Node, Shutdown) -> Fut,
    Fut: Future<Output = anyhow::Result<()>>,
{
    let shutdown = Shutdown::on_signals()?;
    let node = tokio::select! {
        node = Node::open(identity, zenoh) => node?,
        // A network that cannot be joined must not keep the process from being stopped.
        () = shutdown.requested() => return Ok(()),
    };
    let result = tokio::select! {
        result = service(node.clone(), shutdown.clone()) => result,
        result = node.publish_health() => result,
    };
    tracing::info!(service = node.identity().service, "Stopping");
    node.close().await;
    result
}

/// Starts logging to standard error: at `default_level` and above, unless `ALIGHT_LOG` says otherwise.
pub fn start_logging(default_level: &str) {
    let ours = std::env::var("ALIGHT_LOG").unwrap_or_else(|_| default_level.to_owned());
    // Zenoh complains about every attempt at the meeting point, by whoever keeps it too; that is how it is meant to work.
    // It also complains about each message that is still under way when its sender's session closes ("Route data with
    // unknown scope", "Route query with unknown scope"; eclipse-zenoh/zenoh issues 980 and 1050, pull request 2524). Such a
    // question gets an empty answer, and a command that reached nobody is sent again.
    let filter = EnvFilter::try_new(format!(
        "zenoh=error,zenoh::net::routing::dispatcher::pubsub=off,zenoh::net::routing::dispatcher::queries=off,zenoh::api::session=off,zenoh_transport=off,zenoh_link=error,zenoh_link_tls=error,zenoh_shm=error,{ours}"
    ))
    .unwrap_or_else(|_| EnvFilter::new("info,zenoh=error,zenoh_transport=off"));
    let log = tracing_subscriber::fmt::layer()
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal())
        .with_target(false)
        // A log that nobody reads any more (a broken pipe) is lost; complaining about it there would end the process.
        .log_internal_errors(false)
        .with_filter(filter);
    let refusals = Refusals.with_filter(OnlyRefusals);
    // Logging that was started already (by a test, say) stays as it is.
    drop(tracing_subscriber::registry().with(log).with(refusals).try_init());
}

/// Gives Zenoh the threads it needs, by starting this program over with the setting in its environment; it is read
/// once, before anything else can change it. Call it first in `main`. Returns when nothing is to be done.
pub fn relaunch_with_zenoh_threads() {
    use std::os::unix::process::CommandExt;
    if std::env::var_os(ZENOH_RUNTIME_VARIABLE).is_some() {
        return;
    }
    let Ok(program) = std::env::current_exe() else { return };
    let problem = std::process::Command::new(program)
        .args(std::env::args_os().skip(1))
        .env(ZENOH_RUNTIME_VARIABLE, ZENOH_RUNTIME)
        .exec();
    // Fewer threads are enough for one machine; only a cut air link needs more.
    tracing::warn!(%problem, "Zenoh runs with its default threads");
}
