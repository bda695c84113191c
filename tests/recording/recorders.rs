//! Reads the files of a recorder: messages and gaps when it is killed or overloaded, compared with Python's reader. Measures
//! its cost.

#![allow(dead_code, reason = "the test and the measurement use their parts")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use anyhow::{Context, bail, ensure};
use flightlog::Entry;
use flightlog::writer::DROPPED_CHANNEL;
use mcap::read::{LinearReader, Options};
use mcap::records::Record;
use messages::{ControllerCommand, Health, NEVER_CAME, Phase, decode, has_never_come, topic};
use rustix::process::{Signal, kill_process};
use testing::{python, python_passes, until};
use tokio::time::sleep;

use crate::flight::{LONG, Landing, PATIENCE};

/// Maximum that a killed recorder may lose, in seconds.
const MAX_LOSS_S: f64 = 1.0;

/// Maximum difference between the frames that an overloaded recorder stored or reported as lost and those that were published.
const MAX_UNREPORTED_FRAMES: u64 = 5;

/// The reason why the simulator's camera leaves out numbers of frames.
const LEFT_OUT: &str = "frames that took too long to render";

/// The contents of a recording.
#[derive(Debug, Default)]
pub(crate) struct Contents {
    pub(crate) messages: u64,
    /// Messages of each channel.
    pub(crate) channels: BTreeMap<String, u64>,
    /// Names of the files within it.
    pub(crate) files: Vec<String>,
    /// Lost messages, by key.
    pub(crate) dropped: BTreeMap<String, u64>,
    /// When the last message came, in nanoseconds since 1970.
    pub(crate) last_ns: u64,
}

impl Contents {
    /// Reads a recording, also one without an end.
    pub(crate) fn read(path: &Path) -> anyhow::Result<Self> {
        let bytes = std::fs::read(path).with_context(|| format!("reading {path:?}"))?;
        let mut contents = Self::default();
        let mut names = BTreeMap::new();
        for record in LinearReader::new_with_options(&bytes, Options::IgnoreEndMagic.into())? {
            match record {
                Ok(Record::Chunk { header, data }) => {
                    for record in mcap::read::ChunkReader::new(header, &data)? {
                        contents.add(record?, &mut names)?;
                    }
                }
                Ok(record) => contents.add(record, &mut names)?,
                Err(mcap::McapError::UnexpectedEof) => break,
                Err(problem) => bail!("{path:?}: {problem}"),
            }
        }
        Ok(contents)
    }

    /// Whether the recorder lost no message that it received.
    pub(crate) fn is_complete(&self) -> bool {
        self.dropped.keys().all(|key| has_never_come(key))
    }

    fn add(&mut self, record: Record<'_>, names: &mut BTreeMap<u16, String>) -> anyhow::Result<()> {
        match record {
            Record::Channel(channel) => drop(names.insert(channel.id, channel.topic)),
            Record::Attachment { header, .. } => self.files.push(header.name),
            Record::Message { header, data } => {
                let name = names.get(&header.channel_id).context("a message without a channel")?;
                self.messages += 1;
                self.last_ns = self.last_ns.max(header.log_time);
                *self.channels.entry(name.clone()).or_default() += 1;
                if name == DROPPED_CHANNEL {
                    self.dropped = serde_json::from_slice(&data)?;
                }
            }
            _ => {}
        }
        Ok(())
    }
}

/// Holds over the pad while the recorder is killed again and again at random moments, and lands. Every file is read, by Python's
/// reader as well, and ends at most [`MAX_LOSS_S`] before its recorder did.
pub(crate) async fn kills(times: usize, more: &[&str]) -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let first = folder.path().join("flight.mcap");
    let file = |number: usize| match number {
        1 => first.clone(),
        _ => folder.path().join(format!("flight-{number}.mcap")),
    };
    let args = ["--seed", "7", "--record", first.to_str().context("a path")?];
    let mut landing = Landing::start(&[&LONG[..], &args, more].concat()).await?;
    landing.descends_below(9.0).await?;
    command(&landing, ControllerCommand::Hold).await?;
    landing.status("it holds", |s| s.phase == Phase::Hold).await?;
    let mut pid = landing.service("recorder")?.pid;
    let mut losses_s = Vec::new();
    let mut left = Vec::new();
    let mut random = 1_u64;
    for number in 1..=times {
        has_grown(&file(number)).await?;
        // Numerical Recipes' generator: any other is as good.
        random =
            random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        sleep(Duration::from_millis(300 + (random >> 33) % 1500)).await;
        let killed_ns = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH)?.as_nanos();
        kill_process(pid, Signal::KILL)?;
        pid = landing.start_by_hand("recorder", &[])?;
        let contents = Contents::read(&file(number))?;
        let loss_s = (killed_ns as f64 - contents.last_ns as f64) * 1e-9;
        ensure!(loss_s <= MAX_LOSS_S, "kill {number} lost {loss_s:.2} s");
        ensure!(contents.channels.contains_key("camera/down/picture"), "{contents:?}");
        let bytes = std::fs::read(file(number))?;
        let mut mended = Vec::new();
        let found = flightlog::repair(&bytes, &mut mended)?;
        ensure!(found.messages == contents.messages, "{found:?}");
        let again = flightlog::repair(&mended, std::io::sink())?;
        ensure!(again.damage.is_empty() && again.messages == found.messages, "{again:?}");
        losses_s.push(loss_s);
        left.push((file(number), contents));
    }
    let others = read_by_python(&left)?;
    command(&landing, ControllerCommand::Resume).await?;
    losses_s.sort_by(f64::total_cmp);
    let at = |index: usize| losses_s.get(index).copied().unwrap_or_default();
    println!(
        "{times} recorders killed, every file read and repaired, {others} of them read the same by Python; lost {:.2} s in the median, {:.2} s at most",
        at(times / 2),
        at(times.saturating_sub(1)),
    );
    println!("{}", landing.lands().await?["processes"]);
    Ok(())
}

/// How many files Python's reader reads as we do: all, or none where there is no Python.
fn read_by_python(files: &[(PathBuf, Contents)]) -> anyhow::Result<usize> {
    let names: Vec<&str> = files.iter().filter_map(|(path, _)| path.to_str()).collect();
    let Some(reader) = python("tests/recording/killed.py", &names) else { return Ok(0) };
    let output = tokio::task::block_in_place(|| reader.wait_with_output())?;
    if !python_passes(&output)? {
        return Ok(0);
    }
    let text = String::from_utf8_lossy(&output.stdout);
    for ((path, contents), line) in files.iter().zip(text.lines()) {
        let read: serde_json::Value = serde_json::from_str(line)?;
        let is_same = read["messages"] == contents.messages && read["last_ns"] == contents.last_ns;
        ensure!(is_same, "{path:?}: Python reads {read}, we {contents:?}");
    }
    ensure!(text.lines().count() == files.len(), "{} of {}", text.lines().count(), files.len());
    Ok(files.len())
}

/// The cost of a recorder in a landing at a rate of frames, by its health.
pub(crate) async fn cost(rate_hz: u32, more: &[&str]) -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let file = folder.path().join("flight.mcap");
    let rate = format!("simulator.camera.rate_hz={rate_hz}");
    let args = ["--seed", "5", "--set", &rate, "--record", file.to_str().context("a path")?];
    let slowly = ["--set", "controller.metric.max_descend_m_s=0.5"];
    Landing::start(&[&args[..], &slowly, more].concat()).await?.lands().await?;
    let contents = Contents::read(&file)?;
    let mut healths: Vec<Health> = Vec::new();
    let (mut stamps_ns, mut picture_bytes, mut pictures) = (Vec::new(), 0, 0);
    flightlog::read(&std::fs::read(&file)?, |entry| match entry {
        Entry::Message(it) if it.key == "health/recorder/main" => {
            healths.extend(decode::<Health>(it.payload).ok());
        }
        Entry::Picture { header, bytes, .. } => {
            stamps_ns.push(header.stamp_ns);
            picture_bytes += bytes.len();
            pictures += 1;
        }
        _ => {}
    })?;
    let [first, .., last] = healths.as_slice() else { bail!("{} health reports", healths.len()) };
    let share = 100.0 * (last.cpu_s - first.cpu_s) / (last.uptime_s - first.uptime_s);
    let [first_ns, .., last_ns] = stamps_ns.as_slice() else { bail!("{pictures} pictures") };
    let seen_hz = f64::from(pictures - 1) / ((last_ns - first_ns) as f64 * 1e-9);
    println!(
        "{rate_hz} frames a second: {seen_hz:.1} pictures a second of {:.0} kB kept, {share:.1} % of a core over {:.0} s; lost: {:?}",
        picture_bytes as f64 / f64::from(pictures) * 1e-3,
        last.uptime_s - first.uptime_s,
        contents.dropped
    );
    ensure!(contents.is_complete(), "{:?}", contents.dropped);
    Ok(())
}

/// A recorder has no room for its data, and for a while no processor: its losses stand in its file, but for the uncertainty of
/// frames under way.
pub(crate) async fn overload() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let file = folder.path().join("flight.mcap");
    let rate = "simulator.camera.rate_hz=30";
    let little = ["recorder.frames=raw", "recorder.max_waiting_mb=2"];
    let args = ["--seed", "5", "--set", rate, "--set", little[0], "--set", little[1]];
    let record = ["--record", file.to_str().context("a path")?];
    let landing = Landing::start(&[&args[..], &record].concat()).await?;
    has_grown(&file).await?;
    let pid = landing.service("recorder")?.pid;
    for _ in 0..3 {
        kill_process(pid, Signal::STOP)?;
        sleep(Duration::from_millis(700)).await;
        kill_process(pid, Signal::CONT)?;
        sleep(Duration::from_millis(700)).await;
    }
    let (result, status) = landing.lands_with_losses().await?;
    let contents = Contents::read(&file)?;
    let has_lost = contents.dropped.keys().any(|key| !has_never_come(key));
    let wanted = if has_lost { 1 } else { 0 };
    ensure!(status == Some(wanted), "{status:?}: {result}, {:?}", contents.dropped);
    let (mut stamps_ns, mut healths) = (Vec::new(), Vec::new());
    flightlog::read(&std::fs::read(&file)?, |entry| match entry {
        Entry::Picture { header, .. } => stamps_ns.push(header.stamp_ns),
        Entry::Message(it) if it.key == "health/simulator/main" => {
            healths.extend(decode::<Health>(it.payload).ok());
        }
        _ => {}
    })?;
    // The simulated camera leaves numbers out when it is late.
    let numbered = |health: &Health| {
        let published = health.rates.iter().find(|rate| rate.name == "frames");
        let left_out = health.drops.iter().find(|drop| drop.reason == LEFT_OUT);
        published.map_or(0, |rate| rate.count) + left_out.map_or(0, |drop| drop.count)
    };
    let [began, .., ended] = healths.as_slice() else { bail!("{} healths", healths.len()) };
    let between = numbered(ended) - numbered(began);
    let is_between = |stamp_ns: &&i64| (began.stamp_ns..ended.stamp_ns).contains(*stamp_ns);
    let kept = stamps_ns.iter().filter(is_between).count() as u64;
    let dropped = |key: &str| contents.dropped.get(key).copied().unwrap_or(0);
    let lost = dropped("camera/down/frame") + dropped(&format!("camera/down/frame {NEVER_CAME}"));
    println!(
        "of {between} frames {kept} are kept, {lost} reported as lost: {:?}",
        contents.dropped
    );
    ensure!(lost > 0, "nothing was lost, so nothing was tried: {contents:?}");
    // Losses while the recorder is stopped show only as missing numbers. The rest are frames under way at the two
    // reports, and before and after them.
    let unreported = between.abs_diff(kept + lost);
    ensure!(
        unreported <= MAX_UNREPORTED_FRAMES,
        "of {between} frames {kept} are kept, {lost} reported as lost"
    );
    Ok(())
}

pub(crate) async fn command(landing: &Landing, command: ControllerCommand) -> anyhow::Result<()> {
    let reply = landing.node.command(topic::COMMAND, &[], &command).await?;
    ensure!(reply.accepted, "{command:?}: {}", reply.reason);
    Ok(())
}

/// Waits until a file has pictures.
async fn has_grown(file: &Path) -> anyhow::Result<()> {
    const SOME_BYTES: u64 = 200_000;
    let has_some = async || std::fs::metadata(file).is_ok_and(|found| found.len() >= SOME_BYTES);
    until(&format!("something is recorded to {file:?}"), PATIENCE, has_some).await
}
