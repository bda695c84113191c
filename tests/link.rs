//! Tests two hosts joined by a bad radio link, with the detector on the ground.
//!
//! It is skipped where namespaces and TUN devices may not be made. `measure.rs` has the long trials.

#![expect(clippy::print_stdout, reason = "results of a test are for people to read")]

#[path = "link/mod.rs"]
mod link;

use std::process::ExitCode;

use anyhow::ensure;
use testing::with_second_try;

use crate::link::{GOOD, LOSSY, flight, saturation};

fn main() -> ExitCode {
    link::run(async |args| match args.first().map(String::as_str) {
        // A test runner requests the list of tests.
        Some("--list") if args.iter().any(|arg| arg == "--ignored") => Ok(()),
        Some("--list") => {
            println!("a_bad_link_is_survived: test");
            Ok(())
        }
        _ => test().await,
    })
}

/// The short trials, with bounds that a busy machine keeps as well.
async fn test() -> anyhow::Result<()> {
    with_second_try(a_detector_on_the_ground).await?;
    with_second_try(a_saturated_link).await?;
    with_second_try(a_cut_link).await
}

async fn a_detector_on_the_ground() -> anyhow::Result<()> {
    let Some(trial) = flight::ground(LOSSY, 1, &[]).await? else { return Ok(()) };
    println!("ground detector, 2 % loss: {trial}");
    ensure!(trial.landed && trial.error_m < 0.1, "it did not land on the pad");
    ensure!(trial.frames_received > 40, "only {} frames arrived", trial.frames_received);
    Ok(())
}

async fn a_saturated_link() -> anyhow::Result<()> {
    let Some(trial) = saturation::run(GOOD, 4.0).await? else { return Ok(()) };
    println!("frames offered at twice the link's rate: {trial}");
    for name in saturation::CLASSES {
        ensure!(trial.lost(name) == 0, "{name}: messages are lost");
        let (idle, busy) = (trial.p99_ms(name, 0), trial.p99_ms(name, 1));
        // Without a separate link it would wait behind frames, hundreds of milliseconds.
        ensure!(busy < idle + 150.0, "{name}: {busy:.0} ms, and {idle:.0} ms on the idle link");
    }
    Ok(())
}

async fn a_cut_link() -> anyhow::Result<()> {
    let Some(trial) = flight::cut(GOOD, 2, 3.0).await? else { return Ok(()) };
    println!("link cut for 3 s: {trial}");
    ensure!(trial.landed && trial.error_m < 0.1, "it did not land on the pad");
    Ok(())
}
