//! The pipe over which a camera's program tells of each frame what is not in its pixels.
//!
//! The service makes a named pipe in a folder of its own and hands its path to the program, in the place of
//! [`PLACEHOLDER`] in its arguments.

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

/// What stands for the pipe's path in a program's arguments.
pub(crate) const PLACEHOLDER: &str = "{metadata}";
/// Maximum time to wait for a frame's metadata after its last byte; `rpicam-vid` writes them at once.
const MAX_WAIT_NS: i64 = 10_000_000;
/// Number of frames in a row without metadata after which this is said, and they are no longer waited for.
const SILENT_FRAMES: u32 = 60;

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

    /// The frame that arrived at `arrival_ns` has been read: when it was exposed, if its metadata say so.
    ///
    /// # Errors
    /// The metadata are of another clock.
    pub(crate) async fn end_frame(&mut self, arrival_ns: i64) -> anyhow::Result<Option<Exposure>> {
        let until_ns = now_ns() + self.wait_ns;
        self.drain();
        while self.silent < SILENT_FRAMES && !self.pairing.is_settled(arrival_ns) {
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

    /// Takes what has arrived.
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
