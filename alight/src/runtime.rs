//! The asynchronous runtime of a process, and the session of a command-line tool.

use std::future::Future;

use anyhow::Context;
use node::{Identity, Node};

use crate::args::{NetworkArgs, OPERATOR, ParentArgs};

/// Runs a future to its end. Its runtime has two workers, which handle messages only.
pub(crate) fn block_on<F: Future>(future: F) -> anyhow::Result<F::Output> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .context("starting the asynchronous runtime")?;
    Ok(node::block_on(runtime.handle(), future))
}

/// The identity of a tool of this program.
pub(crate) fn tool_identity(tool: &str) -> Identity {
    Identity { service: "alight", instance: format!("{tool}-{}", std::process::id()) }
}

/// Joins the network as a tool of the operator, does the work, and leaves.
pub(crate) fn with_node<T>(
    network: &NetworkArgs,
    tool: &str,
    work: impl AsyncFnOnce(&Node) -> anyhow::Result<T>,
) -> anyhow::Result<T> {
    node::start_logging("warn");
    let zenoh = network.source(OPERATOR)?;
    block_on(async {
        let node = Node::open_tool(tool_identity(tool), &zenoh).await?;
        let result = work(&node).await;
        node.close().await;
        result
    })?
}

impl ParentArgs {
    /// Lets this process stop with its parent, if one is named; false when the parent has ended already.
    pub(crate) fn follow(&self) -> bool {
        self.stop_with_parent.is_none_or(stop_with_parent)
    }
}

#[cfg(target_os = "linux")]
fn stop_with_parent(parent: u32) -> bool {
    let signal = Some(rustix::process::Signal::TERM);
    // If this fails, the process merely outlives a parent that is killed.
    let _ = rustix::process::set_parent_process_death_signal(signal);
    std::os::unix::process::parent_id() == parent
}

#[cfg(not(target_os = "linux"))]
fn stop_with_parent(_parent: u32) -> bool {
    true
}

/// The number of cores of this machine.
pub(crate) fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, std::num::NonZero::get)
}
