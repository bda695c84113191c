//! Makes the pipe over which a camera's program sends the metadata of each frame.
//!
//! The service makes a named pipe in a new folder and passes its path to the program, where its arguments have
//! [`PLACEHOLDER`].

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::Context;
use node::{boot_ahead_ns, now_ns};
use rustix::fs::{CWD, FileType, Mode, mknodat};
use tempfile::TempDir;
use tokio::net::unix::pipe::{OpenOptions, Receiver};
use tokio::time::timeout;

use crate::exposure::{Exposure, Shutter};
use crate::metadata::MetadataReader;
use crate::pairing::Pairing;

/// The placeholder of the pipe's path in a program's arguments.
pub(crate) const PLACEHOLDER: &str = "{metadata}";
/// Maximum time to wait for a frame's metadata after its last byte; `rpicam-vid` writes them at once.
const MAX_WAIT_NS: i64 = 10_000_000;
/// Number of frames in a row without metadata after which a warning is logged, and they are waited for only now and then.
const SILENT_FRAMES: u32 = 60;
/// Of so many frames from then on, those of one are waited for: a program may have held them back for a while.
const RETRY_FRAMES: u32 = 30;

/// Reads metadata and finds each frame's own.
pub(crate) struct SideChannel {
    // It is removed with the channel.
    _folder: TempDir,
    path: PathBuf,
    input: Receiver,
    reader: MetadataReader,
    pairing: Pairing,
    wait_ns: i64,
    /// Number of frames in a row without metadata.
    silent: u32,
}

impl SideChannel {
    /// Makes the pipe.
    pub(crate) fn open(shutter: Shutter, period: Duration) -> anyhow::Result<Self> {
        let folder = TempDir::with_prefix("alight-camera-")
            .context("making a folder for the metadata of the camera program")?;
        let path = folder.path().join("metadata");
        let input = mknodat(CWD, &path, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0)
            .map_err(std::io::Error::from)
            // Also open for writing: so the program may open and close it as it likes.
            .and_then(|()| OpenOptions::new().read_write(true).open_receiver(&path))
            .with_context(|| format!("making the pipe {path:?} for metadata"))?;
        let period_ns = period.as_nanos().try_into().unwrap_or(i64::MAX);
        Ok(Self {
            _folder: folder,
            path,
            input,
            reader: MetadataReader::default(),
            pairing: Pairing::new(shutter, period_ns, boot_ahead_ns()),
            wait_ns: MAX_WAIT_NS.min(period_ns / 4),
            silent: 0,
        })
    }

    /// The pipe's path.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Waits for metadata while there is no frame, and takes them: they are of a frame that was there before.
    pub(crate) async fn take_before_frame(&mut self) {
        match self.input.readable().await {
            Ok(()) => self.drain(),
            Err(_closed) => std::future::pending().await,
        }
        self.pairing.forget_unmatched();
    }

    /// The frame that arrived at `arrival_ns` has been read: when it was exposed, if its metadata state it.
    ///
    /// # Errors
    /// The metadata are of another clock.
    pub(crate) async fn end_frame(&mut self, arrival_ns: i64) -> anyhow::Result<Option<Exposure>> {
        let until_ns = now_ns() + self.wait_ns;
        self.drain();
        let is_awaited = self.silent < SILENT_FRAMES || self.silent.is_multiple_of(RETRY_FRAMES);
        while is_awaited && !self.pairing.is_settled(arrival_ns) {
            let left_ns = u64::try_from(until_ns - now_ns()).unwrap_or(0);
            match timeout(Duration::from_nanos(left_ns), self.input.readable()).await {
                Ok(Ok(())) if left_ns > 0 => self.drain(),
                _ => break,
            }
        }
        let exposure = self.pairing.end_frame(arrival_ns)?;
        self.silent = if exposure.is_some() { 0 } else { self.silent.saturating_add(1) };
        if self.silent == SILENT_FRAMES {
            tracing::warn!(
                "{SILENT_FRAMES} frames in a row without metadata of their own; they are stamped with their arrival less \
                 `source.delay_ms`, and marked as not exact. Does the program write JSON to `{PLACEHOLDER}` for each frame, \
                 right after it?"
            );
        }
        Ok(exposure)
    }

    /// A frame that was queued has been read.
    pub(crate) fn skip_frame(&mut self) {
        self.drain();
        self.pairing.skip_frame();
    }

    /// True once frames and metadata agree.
    pub(crate) fn has_agreed(&self) -> bool {
        self.pairing.has_agreed()
    }

    /// Reads the bytes that have arrived.
    fn drain(&mut self) {
        let mut bytes = [0; 4096];
        loop {
            match self.input.try_read(&mut bytes) {
                Ok(0) => break,
                Ok(count) => self.reader.push(bytes.get(..count).unwrap_or_default()),
                Err(cause) if cause.kind() == ErrorKind::Interrupted => {}
                Err(_would_block) => break,
            }
        }
        while let Some(record) = self.reader.next() {
            self.pairing.add(record);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::exposure::StampedAt;
    use std::fs::{File, OpenOptions};
    use std::io::Write;

    const MS: i64 = 1_000_000;

    /// Ends a frame whose metadata are written once they are waited for, as of a program that writes them right after it.
    async fn end_frame(channel: &mut SideChannel, pipe: &mut File, arrival_ns: i64) -> bool {
        let sensor_ns = arrival_ns - 70 * MS + boot_ahead_ns();
        let line = format!("{{\"SensorTimestamp\": {sensor_ns}, \"ExposureTime\": 4000}}\n");
        let writing = async { pipe.write_all(line.as_bytes()).unwrap() };
        let (exposure, ()) = tokio::join!(channel.end_frame(arrival_ns), writing);
        channel.drain();
        exposure.unwrap().is_some()
    }

    #[tokio::test]
    async fn exact_stamps_come_back_after_frames_without_metadata() {
        let shutter = Shutter { stamped_at: StampedAt::ReadoutStart, readout_ns: 0 };
        let mut channel = SideChannel::open(shutter, Duration::from_millis(40)).unwrap();
        let mut pipe = OpenOptions::new().write(true).open(channel.path()).unwrap();
        let mut arrival_ns = now_ns();
        let mut exact = Vec::new();
        for number in 0..200 {
            arrival_ns += 40 * MS;
            let is_exact = if (20..100).contains(&number) {
                channel.end_frame(arrival_ns).await.unwrap().is_some()
            } else {
                end_frame(&mut channel, &mut pipe, arrival_ns).await
            };
            exact.extend(is_exact.then_some(number));
        }
        let first = exact.iter().find(|number| **number >= 20);
        assert!(exact.starts_with(&[5, 6, 7]), "{exact:?}");
        assert!(first.is_some_and(|number| *number <= 130), "{exact:?}");
        assert!(exact.len() > 80, "{exact:?}");
    }
}
