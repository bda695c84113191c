//! What is in a recording, and recorders that are killed.

#![allow(dead_code, reason = "the test and the measurement use their parts")]

use std::collections::BTreeMap;
use std::path::Path;
use std::time::{Duration, SystemTime};

use anyhow::{Context, bail, ensure};
use flightlog::writer::DROPPED_CHANNEL;
use mcap::read::{LinearReader, Options};
use mcap::records::Record;
use messages::{ControllerCommand, Phase, topic};
use rustix::process::{Signal, kill_process};
use tokio::time::{Instant, sleep};

use crate::flight::{LONG, Landing, PATIENCE};

/// Most that a killed recorder may lose, in seconds.
const MAX_LOSS_S: f64 = 1.0;

/// What is in a recording.
#[derive(Debug, Default)]
pub(crate) struct Contents {
    pub(crate) messages: u64,
    /// Messages of each channel.
    pub(crate) channels: BTreeMap<String, u64>,
    /// Names of the files within it.
    pub(crate) files: Vec<String>,
    /// What was lost, by key.
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

/// Holds over the pad while the recorder is killed again and again at random moments, and lands. Every file is read, and
/// ends at most [`MAX_LOSS_S`] before its recorder did.
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
    let mut random = 1_u64;
    for number in 1..=times {
        has_grown(&file(number)).await?;
        // Numerical Recipes' generator: any will do.
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
    }
    command(&landing, ControllerCommand::Resume).await?;
    losses_s.sort_by(f64::total_cmp);
    let at = |index: usize| losses_s.get(index).copied().unwrap_or_default();
    println!(
        "{times} recorders killed, every file read and repaired; lost {:.2} s in the median, {:.2} s at most",
        at(times / 2),
        at(times.saturating_sub(1)),
    );
    println!("{}", landing.lands().await?["processes"]);
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
    let began = Instant::now();
    while std::fs::metadata(file).map_or(0, |found| found.len()) < SOME_BYTES {
        ensure!(began.elapsed() < PATIENCE, "nothing was recorded to {file:?}");
        sleep(Duration::from_millis(20)).await;
    }
    Ok(())
}
