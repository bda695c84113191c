//! Runs measurements of the complete system that take too long for a test; each prints its results and fails as the test of
//! the same name does.
//!
//! ```text
//! cargo bench -p tests -- kills [TIMES]       kill each process so often (20)
//! cargo bench -p tests -- swaps [TIMES]       swap detectors so often in one flight (100)
//! cargo bench -p tests -- freezes             freeze each process (SIGSTOP) for 0.5, 2, 5 and 30 s
//! cargo bench -p tests -- recorder [TIMES]    kill the recorder so often in one flight at 30 frames a second (50)
//! cargo bench -p tests -- recording [KEY=VALUE...] the cost of the recorder at 15 and 30 frames a second
//! cargo bench -p tests -- link [NAME...]      the trials on a bad radio link, or some of them
//! cargo bench -p tests -- overlay [FRAMES]    read back so many drawn pictures of the page with their overlay (1000)
//! cargo bench -p tests -- video [SECONDS] [link]  the page's pictures, from sent to drawn: at most a minute on this machine at 15
//!                                             and at 30 Hz, and for so long (600) over a link of 6 Mbit/s, or that alone
//! cargo bench -p tests -- crowd [TIMES]       the cost of 1 and 20 browsers for a flight, and of other work of that size, in so many rounds (6)
//! ```

#![expect(clippy::print_stdout, reason = "results are for people to read")]

#[path = "dashboard/film.rs"]
mod film;
mod flight;
mod freezes;
mod kills;
#[path = "link/mod.rs"]
mod link;
#[path = "dashboard/many_clients.rs"]
mod many_clients;
#[path = "link/onehost.rs"]
mod onehost;
#[path = "recording/recorders.rs"]
mod recorders;
#[path = "link/setpoint.rs"]
mod setpoint;
mod swaps;

use std::process::ExitCode;

use anyhow::{Context, bail, ensure};

use crate::link::site;
use crate::link::site::Radio;
use crate::link::{GOOD, LOSSY, POOR, flight as trial, saturation};

fn main() -> ExitCode {
    link::run(async |args| {
        let times = |default: usize| args.get(1).map_or(Ok(default), |text| text.parse());
        match args.first().map(String::as_str) {
            Some("kills") => kills::kill_each(times(20)?).await,
            Some("swaps") => {
                ensure!(swaps::swaps(times(100)?).await?, "frames were late for every detector");
                Ok(())
            }
            Some("freezes") => freeze_each(&[0.5, 2.0, 5.0, 30.0]).await,
            Some("recorder") => {
                let fast = ["--set", "simulator.camera.rate_hz=30"];
                recorders::kills(times(50)?, &fast).await
            }
            Some("recording") => {
                let set: Vec<&str> = args[1..].iter().flat_map(|it| ["--set", it]).collect();
                recorders::cost(15, &set).await?;
                recorders::cost(30, &set).await
            }
            Some("link") => table(&args[1..]).await,
            Some("overlay") => {
                print("drawn with their overlay", film::overlay(times(1000)? as u64).await?);
                Ok(())
            }
            Some("video") => {
                let is_link_only = args.get(2).is_some_and(|it| it == "link");
                video(times(600)? as f64, is_link_only).await
            }
            Some("crowd") => many_clients::cost(times(6)?).await,
            Some("reader") => {
                println!("{}", onehost::reader(args.get(1).context("reader PORT")?).await?);
                Ok(())
            }
            Some(other) => {
                bail!(
                    "`{other}` is not measured: kills, swaps, freezes, recorder, recording, link, overlay, video and crowd are"
                )
            }
            None => {
                println!(
                    "Nothing is measured: say kills, swaps, freezes, recorder, recording, link, overlay, video or crowd"
                );
                Ok(())
            }
        }
    })
}

async fn freeze_each(freezes_s: &[f64]) -> anyhow::Result<()> {
    for name in ["detector", "gcs-bridge", "simulator", "controller"] {
        freezes::of_a_landing(name, freezes_s).await.context(name)?;
    }
    freezes::of_a_commanded_controller().await.context("a commanded controller")?;
    freezes::of_a_camera(freezes_s).await.context("camera-pub")?;
    for seconds in freezes_s {
        let start = freezes::of_a_camera_while_another_starts(*seconds).await;
        start.context("camera-pub while a detector starts")?;
    }
    freezes::of_a_relay(freezes_s).await.context("relay")
}

/// The page's pictures, from sent to drawn.
async fn video(seconds: f64, is_link_only: bool) -> anyhow::Result<()> {
    for rate_hz in [15.0, 30.0].into_iter().filter(|_| !is_link_only) {
        let name = format!("loopback, {rate_hz} Hz");
        print(&name, film::latency(rate_hz, seconds.min(60.0), None).await?);
    }
    let radio = Radio { rate_mbit: 6.0, ..GOOD };
    print("6 Mbit/s, 15 Hz", film::latency(15.0, seconds, Some(radio)).await?);
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
            print("onboard", trial::onboard(seed).await?);
        }
        if is_wanted("setpoint") {
            print("exposure to setpoint without the search", setpoint::run(GOOD, seed).await?);
        }
        if is_wanted("good") {
            print("ground, 20 Mbit/s", trial::ground(GOOD, seed, camera).await?);
        }
        if is_wanted("full") {
            let full = &["air.mode=\"full\""];
            print("ground, 20 Mbit/s, whole frames", trial::ground(GOOD, seed, full).await?);
        }
        if is_wanted("lossy") {
            print("ground, 20 Mbit/s, 2 % loss", trial::ground(LOSSY, seed, camera).await?);
        }
        if is_wanted("tuned") {
            let tuned = Radio { resends_soon: true, ..LOSSY };
            print(
                "the same, lost packets sent again soon",
                trial::ground(tuned, seed, camera).await?,
            );
        }
        if is_wanted("poor") {
            print("ground, 4 Mbit/s, 3 % loss", trial::ground(POOR, seed, camera).await?);
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
            print(&format!("link cut for {seconds} s"), trial::cut(GOOD, 1, seconds).await?);
        }
    }
    Ok(())
}

fn print(name: &str, trial: Option<impl std::fmt::Display>) {
    if let Some(trial) = trial {
        println!("{name}: {trial}");
    }
}
