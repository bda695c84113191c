//! Writes one recording: the MCAP writer with its chunks, the buffer in front of the disk's thread, and
//! which messages have reached the disk.

use std::collections::{BTreeMap, VecDeque};
use std::io::Write;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use flightlog::{About, Writer};

use crate::disk::{Disk, DiskStatus};

/// Period in which everything is handed to the disk, which syncs it at once.
const FLUSH_PERIOD: Duration = Duration::from_millis(400);

/// A recording that is being written.
pub(crate) struct Recording {
    pub(crate) writer: Writer<Buffer>,
    buffer: Buffer,
    disk: Disk,
    handed_bytes: u64,
    began: Instant,
    flushed: Instant,
    /// Messages since the last flush, by key.
    written: BTreeMap<String, u64>,
    /// Those before, until they are on the disk.
    unsynced: VecDeque<Batch>,
}

/// A recording whose rest is handed to the disk.
pub(crate) struct Ending {
    disk: Disk,
    unsynced: VecDeque<Batch>,
}

/// The messages up to a position in the file, by key.
struct Batch {
    end_bytes: u64,
    written: BTreeMap<String, u64>,
}

/// The bytes that the format's writer has written and the disk does not have yet.
#[derive(Clone, Debug, Default)]
pub(crate) struct Buffer {
    bytes: Arc<Mutex<Vec<u8>>>,
}

impl Write for Buffer {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.bytes.lock().unwrap_or_else(PoisonError::into_inner).extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

impl Buffer {
    fn take(&self) -> Vec<u8> {
        std::mem::take(&mut self.bytes.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Recording {
    /// Begins a recording in a new file.
    pub(crate) fn begin(path: PathBuf, about: &About) -> anyhow::Result<Self> {
        let buffer = Buffer::default();
        let writer = Writer::new(buffer.clone(), about)?;
        let now = Instant::now();
        let disk = Disk::open(path)?;
        Ok(Self {
            writer,
            buffer,
            disk,
            handed_bytes: 0,
            began: now,
            flushed: now,
            written: BTreeMap::new(),
            unsynced: VecDeque::new(),
        })
    }

    /// Counts a message that was written.
    pub(crate) fn count(&mut self, key: &str) {
        match self.written.get_mut(key) {
            Some(count) => *count += 1,
            None => drop(self.written.insert(key.to_owned(), 1)),
        }
    }

    /// Hands complete chunks to the disk, and every [`FLUSH_PERIOD`] everything; true when it did so.
    pub(crate) fn hand_over(&mut self) -> anyhow::Result<bool> {
        let is_due = self.flushed.elapsed() >= FLUSH_PERIOD;
        if is_due {
            self.writer.flush()?;
            self.flushed = Instant::now();
        }
        let bytes = self.buffer.take();
        if !bytes.is_empty() {
            self.handed_bytes += bytes.len() as u64;
            self.disk.append(bytes);
        }
        if is_due {
            self.close_batch();
            let synced_bytes = self.disk.status().bytes;
            while self.unsynced.front().is_some_and(|batch| batch.end_bytes <= synced_bytes) {
                self.unsynced.pop_front();
            }
        }
        Ok(is_due)
    }

    fn close_batch(&mut self) {
        let written = std::mem::take(&mut self.written);
        self.unsynced.push_back(Batch { end_bytes: self.handed_bytes, written });
    }

    /// How its file is doing.
    pub(crate) fn status(&self) -> DiskStatus {
        self.disk.status()
    }

    /// The messages that are not on the disk, by key, of a file that is given up.
    pub(crate) fn unsynced(mut self) -> BTreeMap<String, u64> {
        self.close_batch();
        Ending { disk: self.disk, unsynced: self.unsynced }.unsynced()
    }

    /// Whether another file is to be begun.
    pub(crate) fn is_full(&self, max_bytes: u64, max_age: Duration) -> bool {
        self.handed_bytes >= max_bytes || self.began.elapsed() >= max_age
    }

    /// Ends the file with its index; the disk takes the rest in the background.
    pub(crate) fn end(mut self) -> anyhow::Result<Ending> {
        self.close_batch();
        let Self { writer, buffer, disk, mut unsynced, handed_bytes, .. } = self;
        writer.finish()?;
        let rest = buffer.take();
        if let Some(last) = unsynced.back_mut() {
            last.end_bytes = handed_bytes + rest.len() as u64;
        }
        disk.append(rest);
        disk.complete();
        Ok(Ending { disk, unsynced })
    }
}

impl Ending {
    /// How its file is doing.
    pub(crate) fn status(&self) -> DiskStatus {
        self.disk.status()
    }

    /// Waits until it has ended; how it is doing then.
    pub(crate) fn wait(&self, limit: Duration) -> DiskStatus {
        self.disk.wait(limit)
    }

    /// The messages that are not on the disk, by key.
    pub(crate) fn unsynced(self) -> BTreeMap<String, u64> {
        let synced_bytes = self.disk.status().bytes;
        let missing = self.unsynced.into_iter().filter(|batch| batch.end_bytes > synced_bytes);
        let mut lost = BTreeMap::new();
        for (key, count) in missing.flat_map(|batch| batch.written) {
            *lost.entry(key).or_default() += count;
        }
        lost
    }
}
