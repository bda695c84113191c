//! Many browsers at one page, slow and silent ones among them, and what they cost a flight.

#![allow(dead_code, reason = "each program uses its part")]

use std::time::Duration;

use anyhow::{Context, ensure};
use futures_util::{SinkExt, StreamExt};
use messages::{ControllerCommand, Phase, topic};
use rustix::process::Pid;
use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::{WebSocketStream, client_async};

use crate::flight::{LONG, Landing, PATIENCE};

/// Browsers that draw at once, that draw a picture a second, and that take nothing; as many as a page serves.
const QUICK: usize = 14;
const SLOW: usize = 3;
const SILENT: usize = 3;
/// A silent one is cut off by the server, and comes again.
const SILENT_FOR: Duration = Duration::from_secs(8);
/// How long processors are measured, each time.
const WINDOW: Duration = Duration::from_secs(10);
/// In which Linux counts processor time for programs, on every kind of processor that is flown.
const TICKS_PER_S: f64 = 100.0;
/// The services that fly.
const FLIGHT: [&str; 4] = ["detector", "controller", "gcs-bridge", "simulator"];

/// Twenty browsers; gone with this.
pub(crate) struct Crowd {
    _browsers: JoinSet<()>,
}

impl Crowd {
    pub(crate) fn new(page: &str) -> Self {
        let mut browsers: JoinSet<()> = JoinSet::new();
        for number in 0..QUICK + SLOW + SILENT {
            let page = page.to_owned();
            browsers.spawn(async move {
                loop {
                    // The page may be stopped or gone: another try.
                    drop(browse(&page, number).await);
                    sleep(Duration::from_millis(500)).await;
                }
            });
        }
        Self { _browsers: browsers }
    }
}

async fn browse(page: &str, number: usize) -> anyhow::Result<()> {
    let mut data = connect(page, "/ws").await?;
    let mut video = connect(page, "/video").await?;
    if number >= QUICK + SLOW {
        sleep(SILENT_FOR).await;
        return Ok(());
    }
    let pause = Duration::from_secs(u64::from(number >= QUICK));
    loop {
        tokio::select! {
            told = data.next() => drop(told.context("closed")??),
            shown = video.next() => {
                let bytes = shown.context("closed")??.into_data();
                let Some(length) = bytes.first_chunk().map(|it| u32::from_le_bytes(*it) as usize) else { continue };
                let header: serde_json::Value = serde_json::from_slice(bytes.get(4..4 + length).context("a header")?)?;
                sleep(pause).await;
                video.send(Message::text(header["number"].to_string())).await?;
            }
        }
    }
}

async fn connect(page: &str, path: &str) -> anyhow::Result<WebSocketStream<TcpStream>> {
    let opened = timeout(PATIENCE / 20, async {
        anyhow::Ok(
            client_async(format!("ws://{page}{path}"), TcpStream::connect(page).await?).await?.0,
        )
    });
    opened.await?
}

/// Memory of a process that is in use, in megabytes.
pub(crate) fn memory_mb(pid: Pid) -> anyhow::Result<f64> {
    let status = std::fs::read_to_string(format!("/proc/{}/status", pid.as_raw_nonzero()))?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).context("VmRSS")?;
    let kb: f64 = line.trim().trim_end_matches(" kB").parse()?;
    Ok(kb / 1024.0)
}

/// Processor time of a process so far, in seconds.
fn processor_s(pid: Pid) -> anyhow::Result<f64> {
    let stat = std::fs::read_to_string(format!("/proc/{}/stat", pid.as_raw_nonzero()))?;
    // What follows the name in parentheses; user and system time are the 14th and 15th of all.
    let (_, rest) = stat.rsplit_once(") ").context("a name")?;
    let times: Vec<f64> =
        rest.split(' ').skip(11).take(2).map(str::parse).collect::<Result<_, _>>()?;
    Ok(times.iter().sum::<f64>() / TICKS_PER_S)
}

/// Processor time of each service in a hover without and with the crowd, in turn, so many times; and the page's memory.
pub(crate) async fn cost(times: usize) -> anyhow::Result<()> {
    let ([port], _, _) = testing::ports::free()?;
    let page = format!("127.0.0.1:{port}");
    let args = [&["--seed", "3", "--dashboard", &page], &LONG[..]].concat();
    let landing = Landing::start(&args).await?;
    landing.descends_below(8.0).await?;
    let reply = landing.node.command(topic::COMMAND, &[], &ControllerCommand::Hold).await?;
    ensure!(reply.accepted, "{reply:?}");
    landing.status("it holds", |s| s.phase == Phase::Hold).await?;
    let used = || {
        FLIGHT
            .iter()
            .map(|name| processor_s(landing.service(name)?.pid))
            .collect::<anyhow::Result<Vec<f64>>>()
    };
    let mut windows = [Vec::new(), Vec::new()];
    let mut memories_mb = Vec::new();
    let dashboard = landing.service("dashboard")?.pid;
    for _ in 0..times {
        for (is_crowded, windows) in windows.iter_mut().enumerate() {
            let crowd = (is_crowded == 1).then(|| Crowd::new(&page));
            // Until they are connected, or pictures are no longer made.
            sleep(WINDOW / 2).await;
            let before = used()?;
            sleep(WINDOW).await;
            windows.push(
                used()?
                    .iter()
                    .zip(&before)
                    .map(|(after, before)| after - before)
                    .collect::<Vec<f64>>(),
            );
            if crowd.is_some() {
                memories_mb.push(memory_mb(dashboard)?);
            }
        }
    }
    let median = |windows: &[Vec<f64>], of: &dyn Fn(&[f64]) -> f64| {
        let mut values: Vec<f64> = windows.iter().map(|window| of(window)).collect();
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    let [without, with] = &windows;
    let compare = |name: &str, of: &dyn Fn(&[f64]) -> f64| {
        let [without, with] =
            [median(without, of), median(with, of)].map(|s| 100.0 * s / WINDOW.as_secs_f64());
        println!(
            "{name}: {without:.1} % of a core without, {with:.1} % with 20 browsers: {:+.1} %",
            100.0 * (with / without - 1.0)
        );
    };
    for (at, name) in FLIGHT.iter().enumerate() {
        compare(name, &|window| window[at]);
    }
    compare("detector, controller and gcs-bridge", &|window| window[..3].iter().sum());
    compare("all four", &|window| window.iter().sum());
    println!("memory of the dashboard with them, MB: {memories_mb:.0?}");
    landing.node.command(topic::COMMAND, &[], &ControllerCommand::Resume).await?;
    landing.lands().await.map(drop)
}
