//! `alight relay`: relays messages between the processes on the drone and the ground.
//!
//! Zenoh forwards the messages; this process keeps the session open, and reports its health and what it
//! denies. When the list of holders among its keys changes, it restarts with the rights of the new one.

use std::io::ErrorKind;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use clap::Args;
use node::access::{HOLDERS, Holders};
use node::{HealthCounters, Identity, Network, Node, RELAY, Shutdown, denied};
use tokio::time::MissedTickBehavior;

use crate::args::{NetworkArgs, ParentArgs, source_of};
use crate::runtime::block_on;
use crate::services::warn_if_open;

/// Period at which the process checks that it is running.
const BEAT: Duration = Duration::from_millis(100);
/// Gap between two beats after which the process was frozen: a little less than the lease of
/// `zenoh-config/drone.json5`.
const FROZEN: Duration = Duration::from_millis(1200);
/// Period at which the list of holders is read.
const HOLDERS_PERIOD: Duration = Duration::from_millis(500);
/// Time for which the relay waits for a port that another process has.
const PORTS_TIMEOUT: Duration = Duration::from_secs(2);
/// Pause before it restarts after a panic, so that one at every start does not use all of a core.
const RELAUNCH_PAUSE: Duration = Duration::from_millis(200);

/// The error in the health of a list of holders that cannot be read.
const NOT_TAKEN_UP: &str =
    "the list of holders is not taken up, so holders that were revoked since are not shut out";

/// The arguments of the relay.
#[derive(Args, Clone)]
pub(crate) struct RelayArgs {
    /// Name of this relay: 1 to 64 letters, digits, `-` and `_`.
    #[arg(long, value_name = "NAME", default_value = "drone")]
    id: String,
    #[command(flatten)]
    parent: ParentArgs,
    #[command(flatten)]
    network: NetworkArgs,
}

/// Relays messages until it is asked to stop.
pub(crate) fn run(args: &RelayArgs) -> anyhow::Result<ExitCode> {
    if !args.parent.follow() {
        return Ok(ExitCode::FAILURE);
    }
    node::start_logging("info");
    let mut network = args.network.network();
    let config = network.config.get_or_insert_with(|| "drone".into());
    // The certificate is that of the drone itself, or of a relay between drone and ground.
    let role = if config.as_os_str() == "drone" { "drone" } else { RELAY };
    let identity = Identity { service: RELAY, instance: args.id.clone() };
    let zenoh = source_of(&network, role)?;
    wait_for_ports(&network, role)?;
    let holders = HoldersFile::new(&network);
    relaunch_after_panics();
    let serve = async |node, shutdown| {
        warn_if_open(&node, &network);
        relay(node, shutdown, holders).await
    };
    block_on(node::run(identity, &zenoh, serve))??;
    Ok(ExitCode::SUCCESS)
}

/// Waits until no other process has the relay's ports, which one that ends now may have for a moment.
fn wait_for_ports(network: &Network, role: &str) -> anyhow::Result<()> {
    let begun = Instant::now();
    while let Some(endpoint) = network.taken_endpoint(role)? {
        ensure!(
            begun.elapsed() < PORTS_TIMEOUT,
            "another process listens at the relay's address {endpoint}, so no process on the ground would reach this one. Stop it \
             (another relay?), or choose another port: `address` of the site, or `--listen`"
        );
        std::thread::sleep(BEAT);
    }
    Ok(())
}

/// Restarts the process when a thread panics: a thread of Zenoh that panicked leaves its routing tables locked, and the process would
/// continue without relaying.
fn relaunch_after_panics() {
    let report = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        report(panic);
        std::thread::sleep(RELAUNCH_PAUSE);
        let problem = node::relaunch(&[]);
        tracing::error!(%problem, "Restarting this process failed; ending it");
        std::process::abort();
    }));
}

async fn relay(node: Node, shutdown: Shutdown, holders: HoldersFile) -> anyhow::Result<()> {
    node.announce().await?;
    let mut reads = tokio::time::interval(HOLDERS_PERIOD);
    reads.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut second = tokio::time::interval(Duration::from_secs(1));
    let mut beat = tokio::time::interval(BEAT);
    beat.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut last = Instant::now();
    loop {
        tokio::select! {
            _ = second.tick() => report(&node),
            _ = beat.tick() => {}
            _ = reads.tick() => {
                // Zenoh reads its rights once.
                if holders.has_changed(node.health()) {
                    tracing::info!("The list of holders has changed; joining the network again");
                    return Err(node::relaunch(&[])).context("restarting this process");
                }
            }
            () = shutdown.requested() => return Ok(()),
        }
        // The peers have given up some of the connections, and none of them reopens those that gossip made. A
        // session that is closed in order meanwhile takes new connections from the others, which are then lost.
        if last.elapsed() > FROZEN {
            tracing::warn!(gap = ?last.elapsed(), "This process was frozen; joining the network again");
            return Err(node::relaunch(&[])).context("restarting this process");
        }
        last = Instant::now();
    }
}

/// The list of holders among the keys, as it was read at the start.
struct HoldersFile {
    path: Option<PathBuf>,
    holders: Option<Holders>,
}

impl HoldersFile {
    fn new(network: &Network) -> Self {
        let path = network.keys.as_ref().map(|keys| keys.join(HOLDERS));
        let file = Self { path, holders: None };
        Self { holders: file.read().ok().flatten(), ..file }
    }

    /// The list; `None` while there is none, as when it is being replaced.
    fn read(&self) -> anyhow::Result<Option<Holders>> {
        let Some(path) = &self.path else { return Ok(None) };
        let text = match std::fs::read_to_string(path) {
            Ok(text) => text,
            Err(cause) if cause.kind() == ErrorKind::NotFound => return Ok(None),
            Err(cause) => return Err(cause).with_context(|| format!("reading {path:?}")),
        };
        text.parse().map(Some).with_context(|| format!("{path:?}"))
    }

    /// True if the list differs now. A list that cannot be read is reported and has no effect: with it the relay would not start.
    fn has_changed(&self, health: &HealthCounters) -> bool {
        match self.read() {
            Ok(read) => read.is_some() && read != self.holders,
            Err(problem) => {
                let reason = format!("{NOT_TAKEN_UP}: {problem:#}");
                if health.failed(&reason) {
                    tracing::warn!(
                        %reason,
                        "Copy the list of holders from the authority's folder again, readable for the user of this process"
                    );
                }
                false
            }
        }
    }
}

/// Counts denials in the health report, and logs the first one of each reason.
fn report(node: &Node) {
    for (reason, times) in denied::take() {
        if node.health().failed_times(&reason, times) {
            tracing::warn!(%reason, "Access denied (further denials are only counted)");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_list_of_holders_that_cannot_be_taken_up_is_an_error_in_the_health() {
        let keys = tempfile::tempdir().unwrap();
        let list = keys.path().join(HOLDERS);
        let write = |text: &str| std::fs::write(&list, text).unwrap();
        write("drone@drone\noperator@drone\n");
        let network = Network { keys: Some(keys.path().to_owned()), ..Network::default() };
        let (holders, health) = (HoldersFile::new(&network), HealthCounters::default());
        let identity = Identity { service: RELAY, instance: "drone".into() };
        let errors = || health.report(&identity, 0).errors;
        assert!(!holders.has_changed(&health));
        write("drone@drone\nrevoked operator@drone\n");
        assert!(holders.has_changed(&health));
        std::fs::remove_file(&list).unwrap();
        assert!(!holders.has_changed(&health), "it is being replaced");
        assert_eq!(errors(), []);
        write("drone@drone\nrevoked operator\n");
        for times in 1..3 {
            assert!(!holders.has_changed(&health));
            let reported = errors();
            assert!(reported[0].reason.contains("`operator` is not ROLE@VEHICLE"), "{reported:?}");
            assert!(
                reported[0].reason.contains("holders that were revoked since are not shut out"),
                "{reported:?}"
            );
            assert_eq!((reported.len(), reported[0].count), (1, times));
        }
        // The user of the tests may be allowed to read any file (root), but a directory is not a file.
        std::fs::remove_file(&list).unwrap();
        std::fs::create_dir(&list).unwrap();
        assert!(!holders.has_changed(&health));
        assert!(errors().iter().any(|error| error.reason.contains("reading")), "{:?}", errors());
    }
}
