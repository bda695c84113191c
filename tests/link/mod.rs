//! Joins two hosts by a bad radio link, and measures on it.

#![allow(dead_code, reason = "each program uses its part")]

pub(crate) mod flight;
pub(crate) mod probe;
pub(crate) mod saturation;
pub(crate) mod site;

use std::process::ExitCode;

use anyhow::Context;
use site::Radio;

/// A WiFi link as it should be.
pub(crate) const GOOD: Radio = Radio {
    rate_mbit: 20.0,
    delay_ms: 5.0,
    jitter_ms: 2.0,
    loss: 0.0,
    marks: false,
    resends_soon: false,
};
/// The same with packets lost.
pub(crate) const LOSSY: Radio = Radio { loss: 0.02, ..GOOD };
/// Far away.
pub(crate) const POOR: Radio =
    Radio { rate_mbit: 4.0, delay_ms: 20.0, jitter_ms: 10.0, loss: 0.03, ..GOOD };

/// Runs the ground's end of a measurement when the arguments ask for it, else `work`; the failure goes to the output.
pub(crate) fn run(work: impl AsyncFnOnce(&[String]) -> anyhow::Result<()>) -> ExitCode {
    node::relaunch_with_zenoh_threads();
    // `--bench` is cargo's own.
    let args: Vec<String> = std::env::args().skip(1).filter(|arg| arg != "--bench").collect();
    let runtime =
        tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
    let result = runtime.context("starting the runtime").and_then(|runtime| {
        node::block_on(runtime.handle(), async {
            match args.first().map(String::as_str) {
                Some("probe") => probe(&args).await,
                _ => work(&args).await,
            }
        })
    });
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(problem) => {
            println!("FAILED: {problem:?}");
            ExitCode::FAILURE
        }
    }
}

async fn probe(args: &[String]) -> anyhow::Result<()> {
    let (address, seconds) = args.get(1).zip(args.get(2)).context("probe ADDRESS SECONDS")?;
    let commands = args.iter().any(|arg| arg == "commands");
    println!("{}", probe::run(address, seconds.parse()?, commands).await?);
    Ok(())
}
