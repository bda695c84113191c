//! Frames through Zenoh alone, on one host: written in place into shared memory, read in another process.
//!
//! It has the configuration, the quality of service and the threads of the services but no other code of theirs,
//! so it shows the part of Zenoh in a frame's latency. Build it with
//! `cargo build --release -p node --example bare_zenoh`; then
//! `cargo bench -p tests -- link onehost` runs it in turns with frames through `node` and
//! with a plain ring of buffers. `bare_zenoh PERIOD_US FRAMES WARM_UP BYTES` prints the latency of each frame
//! and the processor time as JSON.

#![expect(clippy::print_stdout, reason = "the result is for the program that started it")]

use std::io::Read;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use anyhow::{Context, anyhow, ensure};
use node::{Network, ZenohSource, now_ns};
use serde_json::{Value, json};
use zenoh::Wait;
use zenoh::bytes::ZBytes;
use zenoh::handlers::RingChannel;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::shm::{GarbageCollect, ShmProviderBuilder};

const KEY: &str = "camera/bare/frame";
const BUFFERS: usize = 4;
/// Interval at which the writer polls for the reader.
const POLL: Duration = Duration::from_millis(10);
/// Number of polls before it gives up, and before it publishes the last frame again.
const MAX_POLLS: u32 = 1000;
const POLLS_BEFORE_ANOTHER: u32 = 100;

/// The parameters of a measurement.
#[derive(Copy, Clone)]
struct Trial {
    period: Duration,
    frames: u64,
    warm_up: u64,
    bytes: usize,
}

/// The process that reads; killed on drop.
struct Reader(Child);

impl Drop for Reader {
    fn drop(&mut self) {
        // Fails when it has exited already.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn main() -> anyhow::Result<()> {
    node::relaunch_with_zenoh_threads();
    let mut numbers = Vec::new();
    for arg in std::env::args().skip(1) {
        numbers.push(arg.parse::<u64>().with_context(|| format!("`{arg}` is not a number"))?);
    }
    let (numbers, meet) = numbers
        .split_at_checked(4)
        .context("usage: bare_zenoh PERIOD_US FRAMES WARM_UP BYTES [RENDEZVOUS_PORT]")?;
    let [period_us, frames, warm_up, bytes] = *numbers else { return Ok(()) };
    let period = Duration::from_micros(period_us);
    let trial = Trial { period, frames, warm_up, bytes: bytes.try_into()? };
    let report = match meet.first() {
        Some(meet) => trial.read((*meet).try_into()?)?,
        None => trial.write()?,
    };
    println!("{report}");
    Ok(())
}

impl Trial {
    fn write(self) -> anyhow::Result<Value> {
        let meet = std::net::TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
        let session = open(meet)?;
        let publisher = session
            .declare_publisher(KEY)
            .priority(Priority::DataLow)
            .congestion_control(CongestionControl::BlockFirst)
            .wait()
            .map_err(problem)?;
        let pool_bytes = BUFFERS * self.bytes.next_multiple_of(4096) + 4096;
        let pool = ShmProviderBuilder::default_backend(pool_bytes).wait().map_err(problem)?;
        let mut reader = Reader(
            Command::new(std::env::current_exe()?)
                .args(std::env::args().skip(1))
                .arg(meet.to_string())
                .stdin(Stdio::null())
                .stdout(Stdio::piped())
                .spawn()?,
        );
        while !publisher.matching_status().wait().map_err(problem)?.matching() {
            std::thread::sleep(POLL);
        }
        let before_ms = cpu_ms();
        let publish = |sequence: u64| -> anyhow::Result<()> {
            let stamp_ns = now_ns();
            let mut pixels =
                pool.alloc(self.bytes).with_policy::<GarbageCollect>().wait().map_err(problem)?;
            pixels.fill(sequence as u8);
            let header: Vec<u8> = [stamp_ns.to_le_bytes(), sequence.to_le_bytes()].concat();
            publisher.put(ZBytes::from(pixels)).attachment(header).wait().map_err(problem)
        };
        let count = self.warm_up + self.frames;
        for sequence in 0..count {
            std::thread::sleep(self.period);
            publish(sequence)?;
        }
        let used_ms = (cpu_ms() - before_ms) / self.frames.max(1) as f64;
        // Zenoh may drop a frame, also the last one, for which the reader waits.
        for polls in 1.. {
            if reader.0.try_wait()?.is_some() {
                break;
            }
            ensure!(polls < MAX_POLLS, "the reader had no last frame in {:?}", MAX_POLLS * POLL);
            std::thread::sleep(POLL);
            if polls % POLLS_BEFORE_ANOTHER == 0 {
                publish(count.saturating_sub(1))?;
            }
        }
        let mut output = String::new();
        reader.0.stdout.take().context("the output of the reader")?.read_to_string(&mut output)?;
        let mut report: Value = serde_json::from_str(&output)?;
        report["writer_cpu_ms"] = json!(used_ms);
        Ok(report)
    }

    fn read(self, meet: u16) -> anyhow::Result<Value> {
        let session = open(meet)?;
        let frames =
            session.declare_subscriber(KEY).with(RingChannel::new(1)).wait().map_err(problem)?;
        let mut ms = Vec::new();
        let mut before_ms = cpu_ms();
        loop {
            let sample = frames.recv().map_err(problem)?;
            let header = sample.attachment().context("a header")?.to_bytes();
            let (stamp_ns, sequence) = header.split_first_chunk().context("a stamp")?;
            let stamp_ns = i64::from_le_bytes(*stamp_ns);
            let sequence = u64::from_le_bytes(*sequence.first_chunk().context("a number")?);
            let sum: u64 = sample.payload().to_bytes().iter().map(|pixel| u64::from(*pixel)).sum();
            let took_ms = (now_ns() - stamp_ns) as f64 * 1e-6;
            ensure!(sum == u64::from(sequence as u8) * self.bytes as u64, "other pixels");
            if sequence < self.warm_up {
                before_ms = cpu_ms();
            } else {
                ms.push(took_ms);
            }
            if sequence + 1 >= self.warm_up + self.frames {
                break;
            }
        }
        let used_ms = (cpu_ms() - before_ms) / ms.len().max(1) as f64;
        Ok(json!({ "ms": ms, "reader_cpu_ms": used_ms }))
    }
}

fn open(meet: u16) -> anyhow::Result<zenoh::Session> {
    let network = Network { meet: Some(meet), ..Network::default() };
    let ZenohSource::Text(text) = network.source("detector")? else {
        return Err(anyhow!("no text of a configuration"));
    };
    let config = zenoh::Config::from_json5(&text).map_err(problem)?;
    zenoh::open(config).wait().map_err(problem)
}

fn problem(cause: impl std::fmt::Display) -> anyhow::Error {
    anyhow!("Zenoh: {cause}")
}

/// Processor time of this process so far, in milliseconds.
fn cpu_ms() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    time.tv_sec as f64 * 1e3 + time.tv_nsec as f64 * 1e-6
}
