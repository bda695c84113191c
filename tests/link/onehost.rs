//! Measures on one host a frame from its camera to a reader in another process, next to a bare ring of buffers in shared memory.
//!
//! The ring is the limit: two threads that share the buffers, in memory of the same kind, woken by a condition variable,
//! which is a futex. (Two processes with a futex between them take the same time within 5 %, but need `unsafe`.) Between both
//! stands Zenoh alone, the example `bare_zenoh` of `node`, when it is built: its time is the limit of this implementation.

use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use anyhow::Context;
use messages::{FrameHeader, topic};
use node::{FramePublisher, Identity, Loan, Network, Node, now_ns};
use serde_json::{Value, json};
use testing::ports;
use tokio::time::interval;

use crate::link::probe::Times;

const WIDTH: u32 = 1296;
const HEIGHT: u32 = 972;
const LEN: usize = WIDTH as usize * HEIGHT as usize;
/// 30 frames a second.
const PERIOD: Duration = Duration::from_micros(33_333);
const FRAMES: u64 = 90;
const ROUNDS: usize = 3;
/// Frames before the measurement.
const WARM_UP: u64 = 10;
const BUFFERS: usize = 4;

/// The measured times, in milliseconds.
pub(crate) struct OneHost {
    ring: Times,
    frames: Times,
    cpu_ms: [f64; 2],
    ring_cpu_ms: f64,
    bare: Option<Bare>,
}

/// Zenoh without any other code of Alight.
#[derive(Default)]
struct Bare {
    frames: Times,
    cpu_ms: [f64; 2],
}

impl std::fmt::Display for OneHost {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [ring, frames] = [&self.ring, &self.frames].map(|times| times.at(0.5) * 1e3);
        let [writer, reader] = self.cpu_ms;
        write!(
            f,
            "median {frames:.0} us, ring {ring:.0} us: ratio {:.2}; p99 {:.0} and {:.0} us; processor per frame: camera {writer:.2} ms, reader {reader:.2} ms, both ends of the ring {:.2} ms",
            frames / ring,
            self.frames.at(0.99) * 1e3,
            self.ring.at(0.99) * 1e3,
            self.ring_cpu_ms,
        )?;
        let Some(bare) = &self.bare else {
            return write!(
                f,
                "; Zenoh alone is not measured: `cargo build --release -p node --example bare_zenoh` first"
            );
        };
        let (us, [writer, reader]) = (bare.frames.at(0.5) * 1e3, bare.cpu_ms);
        write!(
            f,
            "\nZenoh alone: median {us:.0} us: ratio to the ring {:.2}, ours to it {:.2}; p99 {:.0} us; processor per frame: camera {writer:.2} ms, reader {reader:.2} ms",
            us / ring,
            frames / us,
            bare.frames.at(0.99) * 1e3,
        )
    }
}

/// Measures both in turns.
pub(crate) async fn run() -> anyhow::Result<Option<OneHost>> {
    let ([meet], _, _) = ports::free()?;
    let network = Network { meet: Some(meet), ..Network::default() };
    let identity = Identity { service: "camera-pub", instance: "probe".into() };
    let node = Node::open(identity, &network.source("camera-pub")?).await?;
    let publisher = node.frame_publisher(topic::FRAME, &["probe"], LEN).await?;
    let mut result = OneHost {
        ring: Times::default(),
        frames: Times::default(),
        cpu_ms: [0.0; 2],
        ring_cpu_ms: 0.0,
        bare: None,
    };
    for _ in 0..ROUNDS {
        let reader = start_reader(meet)?;
        while !publisher.has_subscribers().await {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        let before_ms = cpu_ms();
        film(&publisher).await;
        result.cpu_ms[0] += (cpu_ms() - before_ms) / FRAMES as f64 / ROUNDS as f64;
        let output = tokio::task::spawn_blocking(move || reader.wait_with_output()).await??;
        let text = String::from_utf8(output.stdout)?;
        let report: Value =
            serde_json::from_str(text.lines().last().context("the reader failed")?)?;
        result.cpu_ms[1] += report["cpu_ms"].as_f64().context("cpu_ms")? / ROUNDS as f64;
        for ms in report["ms"].as_array().context("ms")? {
            result.frames.add(ms.as_f64().context("a time")?);
        }
        tokio::task::block_in_place(|| add_bare(&mut result.bare))?;
        let before_ms = cpu_ms();
        for ms in {
            let buffers = (0..BUFFERS).map(|_| Mutex::new(publisher.loan(LEN))).collect();
            tokio::task::spawn_blocking(|| ring(buffers)).await??
        } {
            result.ring.add(ms);
        }
        result.ring_cpu_ms += (cpu_ms() - before_ms) / FRAMES as f64 / ROUNDS as f64;
    }
    Ok(Some(result))
}

/// Frames through Zenoh alone.
fn add_bare(bare: &mut Option<Bare>) -> anyhow::Result<()> {
    let program = std::env::current_exe()?;
    let folder = program.parent().and_then(std::path::Path::parent).context("a folder")?;
    let program = folder.join("examples/bare_zenoh");
    if !program.is_file() {
        return Ok(());
    }
    let numbers = [PERIOD.as_micros() as u64, FRAMES, WARM_UP, LEN as u64];
    let output = Command::new(program).args(numbers.map(|number| number.to_string())).output()?;
    let report: Value = serde_json::from_slice(&output.stdout).context("Zenoh alone failed")?;
    let bare = bare.get_or_insert_default();
    for ms in report["ms"].as_array().context("ms")? {
        bare.frames.add(ms.as_f64().context("a time")?);
    }
    for (sum, key) in bare.cpu_ms.iter_mut().zip(["writer_cpu_ms", "reader_cpu_ms"]) {
        *sum += report[key].as_f64().context(key)? / ROUNDS as f64;
    }
    Ok(())
}

fn start_reader(meet: u16) -> anyhow::Result<Child> {
    let mut command = Command::new(std::env::current_exe()?);
    command.args(["reader", &meet.to_string()]).stdin(Stdio::null()).stdout(Stdio::piped());
    command.spawn().context("starting the reader")
}

/// The camera's work: it writes every pixel.
fn write(pixels: &mut [u8], sequence: u64) {
    pixels.fill(sequence as u8);
}

/// The reader's work: it reads every pixel.
fn read(pixels: &[u8]) -> u64 {
    pixels.iter().map(|pixel| u64::from(*pixel)).sum()
}

async fn film(publisher: &FramePublisher) {
    let mut ticks = interval(PERIOD);
    for sequence in 0..FRAMES + WARM_UP {
        ticks.tick().await;
        let stamp_ns = now_ns();
        let mut pixels = publisher.loan(LEN);
        write(&mut pixels, sequence);
        let header = FrameHeader {
            camera: "probe".into(),
            sequence,
            stamp_ns,
            width: WIDTH,
            height: HEIGHT,
            ..FrameHeader::sample()
        };
        publisher.publish(&header, pixels).await;
    }
}

/// The reader, a process of its own.
pub(crate) async fn reader(meet: &str) -> anyhow::Result<Value> {
    let network = Network {
        config: Some(PathBuf::from("local")),
        meet: Some(meet.parse()?),
        ..Network::default()
    };
    let identity = Identity { service: "detector", instance: "probe".into() };
    let node = Node::open(identity, &network.source("detector")?).await?;
    let frames = node.frame_subscriber(topic::FRAME, &["probe"]).await?;
    let mut ms = Vec::new();
    let mut before_ms = cpu_ms();
    while let Some(frame) = frames.next().await {
        let sum = read(&frame.bytes());
        let took_ms = (now_ns() - frame.header.stamp_ns) as f64 * 1e-6;
        anyhow::ensure!(sum == u64::from(frame.header.sequence as u8) * LEN as u64, "other pixels");
        if frame.header.sequence < WARM_UP {
            before_ms = cpu_ms();
        } else {
            ms.push(took_ms);
        }
        if frame.header.sequence + 1 >= FRAMES + WARM_UP {
            break;
        }
    }
    let used_ms = (cpu_ms() - before_ms) / ms.len().max(1) as f64;
    Ok(json!({ "ms": ms, "cpu_ms": used_ms }))
}

/// Frames through a bare ring; how long each took, in milliseconds.
fn ring(buffers: Vec<Mutex<Loan>>) -> anyhow::Result<Vec<f64>> {
    let buffers = Arc::new(buffers);
    let newest = Arc::new((Mutex::new(None::<(u64, i64)>), Condvar::new()));
    let (theirs, announced) = (Arc::clone(&buffers), Arc::clone(&newest));
    let reader = std::thread::spawn(move || {
        let mut ms = Vec::new();
        let mut next = 0;
        while next < FRAMES + WARM_UP {
            let (lock, arrived) = &*announced;
            let mut newest = lock.lock().unwrap_or_else(PoisonError::into_inner);
            let (sequence, stamp_ns) = loop {
                match *newest {
                    Some((sequence, stamp_ns)) if sequence >= next => break (sequence, stamp_ns),
                    _ => newest = arrived.wait(newest).unwrap_or_else(PoisonError::into_inner),
                }
            };
            drop(newest);
            if let Some(buffer) = theirs.get(sequence as usize % BUFFERS) {
                let sum = read(&buffer.lock().unwrap_or_else(PoisonError::into_inner));
                let took_ms = (now_ns() - stamp_ns) as f64 * 1e-6;
                if sequence >= WARM_UP && sum == u64::from(sequence as u8) * LEN as u64 {
                    ms.push(took_ms);
                }
            }
            next = sequence + 1;
        }
        ms
    });
    for sequence in 0..FRAMES + WARM_UP {
        std::thread::sleep(PERIOD);
        let stamp_ns = now_ns();
        if let Some(buffer) = buffers.get(sequence as usize % BUFFERS) {
            write(&mut buffer.lock().unwrap_or_else(PoisonError::into_inner), sequence);
        }
        let (lock, arrived) = &*newest;
        *lock.lock().unwrap_or_else(PoisonError::into_inner) = Some((sequence, stamp_ns));
        arrived.notify_one();
    }
    reader.join().map_err(|_| anyhow::anyhow!("the ring's reader ended"))
}

/// Processor time of this process so far, in milliseconds.
fn cpu_ms() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    time.tv_sec as f64 * 1e3 + time.tv_nsec as f64 * 1e-6
}
