//! Connects many browsers to one page, some of them slow or silent, and measures their cost for a flight.

#![allow(dead_code, reason = "each program uses its part")]

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use futures_util::{SinkExt, StreamExt};
use messages::{ControllerCommand, Phase, topic};
use node::stats::{mean, standard_deviation};
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
const ALL: usize = QUICK + SLOW + SILENT;
/// The server closes the connection of a silent browser, which then connects again.
const SILENT_FOR: Duration = Duration::from_secs(8);
/// Duration of each measurement of processor time.
const WINDOW: Duration = Duration::from_secs(10);
/// The unit in which Linux counts processor time for programs, on every kind of processor that is flown.
const TICKS_PER_S: f64 = 100.0;
/// The services that fly.
const FLIGHT: [&str; 4] = ["detector", "controller", "gcs-bridge", "simulator"];

/// Twenty browsers, until this is dropped.
pub(crate) struct Browsers {
    _browsers: JoinSet<()>,
}

impl Browsers {
    pub(crate) fn new(page: &str) -> Self {
        Self::of(page, ALL)
    }

    /// This number of browsers, the quick ones first.
    fn of(page: &str, count: usize) -> Self {
        let mut browsers: JoinSet<()> = JoinSet::new();
        for number in 0..count {
            let page = page.to_owned();
            browsers.spawn(async move {
                loop {
                    // The page may be stopped or gone: try again.
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
            message = data.next() => drop(message.context("closed")??),
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
    // The text after the name in parentheses; user and system time are the 14th and 15th of all.
    let (_, rest) = stat.rsplit_once(") ").context("a name")?;
    let times: Vec<f64> =
        rest.split(' ').skip(11).take(2).map(str::parse).collect::<Result<_, _>>()?;
    Ok(times.iter().sum::<f64>() / TICKS_PER_S)
}

/// The other load of the machine, next to the services that fly.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
enum Load {
    /// This number of browsers, which need processors together with their page.
    Browsers(usize),
    /// Threads without any part in the flight, with the processor time of the last browsers and their page.
    Threads,
}

/// The flight alone, with one browser, with all, and the control: the cost of other work alone on the same processors.
const LOADS: [Load; 4] = [Load::Browsers(0), Load::Browsers(1), Load::Browsers(ALL), Load::Threads];
/// How often each thread works, as a browser takes pictures.
const THREAD_HZ: f64 = 15.0;
/// Bytes that a thread copies at a time, the size of a picture.
const THREAD_BYTES: usize = 40_000;

/// Threads that use processors, until this is dropped.
struct LoadThreads {
    are_over: Arc<AtomicBool>,
}

impl LoadThreads {
    /// As many as there are browsers, which together need this fraction of a core.
    fn new(fraction: f64) -> Self {
        let are_over = Arc::new(AtomicBool::new(false));
        let count = ALL;
        let period = Duration::from_secs_f64(1.0 / THREAD_HZ);
        let work = period.mul_f64(fraction / count as f64);
        for number in 0..count {
            let over = Arc::clone(&are_over);
            std::thread::spawn(move || {
                std::thread::sleep(period.mul_f64(number as f64 / count as f64));
                let (from, mut to) = (vec![7_u8; THREAD_BYTES], vec![0; THREAD_BYTES]);
                while !over.load(Ordering::Relaxed) {
                    let began = Instant::now();
                    while began.elapsed() < work {
                        to.copy_from_slice(std::hint::black_box(&from));
                        std::hint::black_box(&mut to);
                    }
                    std::thread::sleep(period.saturating_sub(began.elapsed()));
                }
            });
        }
        Self { are_over }
    }
}

impl Drop for LoadThreads {
    fn drop(&mut self) {
        self.are_over.store(true, Ordering::Relaxed);
    }
}

/// The mean of measurements, and the standard deviation of that mean; a single one has none.
fn mean_and_deviation(values: &[f64]) -> [f64; 2] {
    let deviation = standard_deviation(values).unwrap_or(f64::NAN);
    [mean(values).unwrap_or(f64::NAN), deviation / (values.len() as f64).sqrt()]
}

/// Processor time of each service in a hover alone, with one browser and twenty, and with other work of the same size, in turn,
/// this number of times; and the page's memory.
pub(crate) async fn cost(times: usize) -> anyhow::Result<()> {
    let ([port], _, _) = testing::ports::free()?;
    let page = format!("127.0.0.1:{port}");
    let args = [&["--seed", "3", "--dashboard", &page], &LONG[..]].concat();
    let landing = Landing::start(&args).await?;
    landing.descends_below(8.0).await?;
    let reply = landing.node.command(topic::COMMAND, &[], &ControllerCommand::Hold).await?;
    ensure!(reply.accepted, "{reply:?}");
    landing.status("it holds", |s| s.phase == Phase::Hold).await?;
    let flight: Vec<Pid> =
        FLIGHT.iter().map(|name| Ok(landing.service(name)?.pid)).collect::<anyhow::Result<_>>()?;
    let dashboard = landing.service("dashboard")?.pid;
    let page_and_browsers = [dashboard, rustix::process::getpid()];
    let used = |pids: &[Pid]| {
        pids.iter().map(|pid| processor_s(*pid)).collect::<anyhow::Result<Vec<f64>>>()
    };
    let mut windows = LOADS.map(|_| Vec::new());
    let [mut memories_mb, mut percents, mut threads] = [const { Vec::new() }; 3];
    let mut fraction = 0.0;
    for round in 0..times {
        // Each round begins with another load, so that changes within a minute favour none.
        for at in (0..LOADS.len()).map(|at| (at + round) % LOADS.len()) {
            let (load, windows) = (&LOADS[at], &mut windows[at]);
            let _load: (Option<Browsers>, Option<LoadThreads>) = match load {
                Load::Browsers(count) => (Some(Browsers::of(&page, *count)), None),
                Load::Threads => (None, Some(LoadThreads::new(fraction))),
            };
            // Until they are connected, or pictures are no longer made.
            sleep(WINDOW / 2).await;
            let before = [used(&flight)?, used(&page_and_browsers)?];
            sleep(WINDOW).await;
            let after = [used(&flight)?, used(&page_and_browsers)?];
            let [flown, others] = [0, 1].map(|of: usize| {
                let pairs = after[of].iter().zip(&before[of]);
                pairs.map(|(after, before)| after - before).collect::<Vec<f64>>()
            });
            windows.push(flown);
            let used = others.iter().sum::<f64>() / WINDOW.as_secs_f64();
            match load {
                Load::Browsers(ALL) => {
                    fraction = used;
                    memories_mb.push(memory_mb(dashboard)?);
                    percents.push(100.0 * used);
                }
                Load::Threads => threads.push(100.0 * used),
                Load::Browsers(_) => {}
            }
        }
    }
    let compare = |name: &str, of: &dyn Fn(&[f64]) -> f64| {
        let used = windows.each_ref().map(|windows| {
            windows.iter().map(|window| 100.0 * of(window) / WINDOW.as_secs_f64()).collect()
        });
        let [alone, one, all, threads]: [Vec<f64>; 4] = used;
        let usual = mean_and_deviation(&alone)[0];
        // Each is compared with the window of its round without load: a machine changes within minutes.
        let more = |with: &[f64]| {
            let more: Vec<f64> =
                with.iter().zip(&alone).map(|(with, alone)| with - alone).collect();
            let [mean, deviation] = mean_and_deviation(&more).map(|it| 100.0 * it / usual);
            format!("{mean:+.1} ± {deviation:.1} %")
        };
        println!(
            "{name}: {usual:.1} % of a core alone, {} with one browser, {} with 20, {} with other work",
            more(&one),
            more(&all),
            more(&threads)
        );
    };
    for (at, name) in FLIGHT.iter().enumerate() {
        compare(name, &|window| window[at]);
    }
    compare("detector, controller and gcs-bridge", &|window| window[..3].iter().sum());
    compare("all four", &|window| window.iter().sum());
    println!("page and 20 browsers, % of a core: {percents:.0?}; other work: {threads:.0?}");
    println!("memory of the dashboard with them, MB: {memories_mb:.0?}");
    landing.node.command(topic::COMMAND, &[], &ControllerCommand::Resume).await?;
    landing.lands().await.map(drop)
}
