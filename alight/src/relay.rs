//! `alight relay`: passes messages on between the drone's own processes and the ground.
//!
//! Zenoh does the passing on; this keeps a session open for it, and tells how it fares and whom it refused.

use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use node::{Identity, Node, Shutdown, refusals};

use crate::cli::NetworkArgs;
use crate::services;

/// The service's name.
pub(crate) const NAME: &str = "relay";

/// What the relay takes.
#[derive(Args, Clone)]
pub(crate) struct RelayArgs {
    /// Name of this relay: 1 to 64 letters, digits, `-` and `_`.
    #[arg(long, value_name = "NAME", default_value = "drone")]
    id: String,
    /// Stop when the process of this number, which started this one, ends.
    #[arg(long, hide = true, value_name = "PID")]
    stop_with_parent: Option<u32>,
    #[command(flatten)]
    network: NetworkArgs,
}

/// Passes messages on until it is asked to stop.
pub(crate) fn run(args: &RelayArgs) -> anyhow::Result<ExitCode> {
    if let Some(parent) = args.stop_with_parent
        && !services::stop_with_parent(parent)
    {
        return Ok(ExitCode::FAILURE);
    }
    node::start_logging("info");
    let mut network = args.network.clone();
    let config = network.zenoh.get_or_insert_with(|| "drone".into()).clone();
    // A relay shows who it is: the drone itself, or one that stands before it.
    let role = if config.as_os_str() == "drone" { "drone" } else { NAME };
    let identity = Identity { service: NAME, instance: args.id.clone() };
    let zenoh = network.source(role)?;
    services::runtime()?.block_on(node::run(identity, &zenoh, relay))?;
    Ok(ExitCode::SUCCESS)
}

async fn relay(node: Node, shutdown: Shutdown) -> anyhow::Result<()> {
    node.announce().await?;
    let mut second = tokio::time::interval(Duration::from_secs(1));
    loop {
        tokio::select! {
            _ = second.tick() => report(&node),
            () = shutdown.requested() => return Ok(()),
        }
    }
}

/// Counts what was refused, and tells of the first of each kind.
fn report(node: &Node) {
    for (reason, times) in refusals::take() {
        if node.health().failed_times(&reason, times) {
            tracing::warn!(%reason, "Not let in; more of this are counted only");
        }
    }
}
