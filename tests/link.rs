//! Two hosts joined by a bad radio link: what must hold with the detector on the ground, and how well it holds.
//!
//! `cargo test -p tests --test link` tries the short ones; they are skipped where namespaces and TUN devices may not be made.
//! `cargo test --release -p tests --test link -- table [NAME...]` measures all, longer, and prints a table.

#![expect(
    clippy::print_stdout,
    reason = "what was measured, or why it is skipped, is for people to read"
)]

#[path = "link/flight.rs"]
mod flight;
#[path = "link/onehost.rs"]
mod onehost;
#[path = "link/probe.rs"]
mod probe;
#[path = "link/saturation.rs"]
mod saturation;
#[path = "link/setpoint.rs"]
mod setpoint;
#[path = "link/site.rs"]
mod site;

use std::process::ExitCode;

use anyhow::{Context, ensure};
use site::Radio;

/// A WiFi link as it should be.
const GOOD: Radio = Radio {
    rate_mbit: 20.0,
    delay_ms: 5.0,
    jitter_ms: 2.0,
    loss: 0.0,
    marks: false,
    resends_soon: false,
};
/// The same with packets lost.
const LOSSY: Radio = Radio { loss: 0.02, ..GOOD };
/// Far away.
const POOR: Radio = Radio { rate_mbit: 4.0, delay_ms: 20.0, jitter_ms: 10.0, loss: 0.03, ..GOOD };

fn main() -> ExitCode {
    node::relaunch_with_zenoh_threads();
    let args: Vec<String> = std::env::args().skip(1).collect();
    let runtime =
        tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
    let result = runtime.context("starting the runtime").and_then(|runtime| {
        runtime.block_on(async {
            match args.first().map(String::as_str) {
                Some("probe") => measure(&args).await,
                Some("reader") => {
                    println!("{}", onehost::reader(args.get(1).context("reader PORT")?).await?);
                    Ok(())
                }
                Some("table") => table(args.get(1..).unwrap_or_default()).await,
                // What a test runner asks of its harness; there is one test.
                Some("--list") => Ok(()),
                _ => test().await,
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

/// The ground's end of a measurement.
async fn measure(args: &[String]) -> anyhow::Result<()> {
    let (address, seconds) = args.get(1).zip(args.get(2)).context("probe ADDRESS SECONDS")?;
    let commands = args.iter().any(|arg| arg == "commands");
    println!("{}", probe::run(address, seconds.parse()?, commands).await?);
    Ok(())
}

/// The short trials, with bounds that a busy machine keeps as well.
async fn test() -> anyhow::Result<()> {
    let Some(trial) = flight::ground(LOSSY, 1, &[]).await? else { return Ok(()) };
    println!("ground detector, 2 % loss: {trial}");
    ensure!(trial.landed && trial.error_m < 0.3, "it did not land on the pad");
    ensure!(trial.frames_received > 40, "only {} frames arrived", trial.frames_received);
    let Some(trial) = saturation::run(GOOD, 4.0).await? else { return Ok(()) };
    println!("frames offered at twice the link's rate: {trial}");
    for name in saturation::CLASSES {
        ensure!(trial.lost(name) == 0, "{name}: messages are lost");
        let (idle, busy) = (trial.p99_ms(name, 0), trial.p99_ms(name, 1));
        // Without a link of its own it would wait behind frames, hundreds of milliseconds.
        ensure!(busy < idle + 150.0, "{name}: {busy:.0} ms, and {idle:.0} ms on the idle link");
    }
    let Some(trial) = flight::cut(GOOD, 2, 3.0).await? else { return Ok(()) };
    println!("link cut for 3 s: {trial}");
    ensure!(trial.landed && trial.error_m < 0.3, "it did not land on the pad");
    Ok(())
}

/// The long trials.
async fn table(names: &[String]) -> anyhow::Result<()> {
    // `KEY=VALUE` is for the camera, anything else names a trial.
    let (camera, names): (Vec<&str>, Vec<&str>) =
        names.iter().map(String::as_str).partition(|name| name.contains('='));
    let camera = camera.as_slice();
    let is_wanted = |name: &str| names.is_empty() || names.contains(&name);
    if is_wanted("onehost") {
        print("one host", onehost::run().await?);
    }
    for seed in 1..=3 {
        if is_wanted("onboard") {
            print("onboard", flight::onboard(seed).await?);
        }
        if is_wanted("setpoint") {
            print("frame to setpoint without the search", setpoint::run(GOOD, seed).await?);
        }
        if is_wanted("good") {
            print("ground, 20 Mbit/s", flight::ground(GOOD, seed, camera).await?);
        }
        if is_wanted("full") {
            let full = &["air.mode=\"full\""];
            print("ground, 20 Mbit/s, whole frames", flight::ground(GOOD, seed, full).await?);
        }
        if is_wanted("lossy") {
            print("ground, 20 Mbit/s, 2 % loss", flight::ground(LOSSY, seed, camera).await?);
        }
        if is_wanted("tuned") {
            let tuned = Radio { resends_soon: true, ..LOSSY };
            print(
                "the same, lost packets sent again soon",
                flight::ground(tuned, seed, camera).await?,
            );
        }
        if is_wanted("poor") {
            print("ground, 4 Mbit/s, 3 % loss", flight::ground(POOR, seed, camera).await?);
        }
    }
    if is_wanted("saturation") {
        print("frames at twice the rate", saturation::run(GOOD, 15.0).await?);
        print("frames at twice the rate, 2 % loss", saturation::run(LOSSY, 15.0).await?);
        let tuned = Radio { resends_soon: true, ..LOSSY };
        print("the same, lost packets sent again soon", saturation::run(tuned, 15.0).await?);
        let honoured = Radio { marks: true, ..GOOD };
        print("frames at twice the rate, marks honoured", saturation::run(honoured, 15.0).await?);
    }
    for seconds in [3.0, 30.0] {
        if is_wanted("cut") {
            print(&format!("link cut for {seconds} s"), flight::cut(GOOD, 1, seconds).await?);
        }
    }
    Ok(())
}

fn print(name: &str, trial: Option<impl std::fmt::Display>) {
    if let Some(trial) = trial {
        println!("{name}: {trial}");
    }
}
