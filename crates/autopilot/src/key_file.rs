//! Reads and writes the files of signed packets: the key, which only its owner can read, and the newest stamp, which outlasts a restart.

use std::io::{self, Write};
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::SystemTime;

use crate::signing::Key;

/// How far beyond the newest stamp the file's one is: 20 s. After a restart stamps continue from there, so none is used twice.
const RESERVE: u64 = 2_000_000;
/// Maximum size of a key file, in bytes.
const MAX_KEY_FILE: u64 = 4096;

/// How a link's packets are signed.
#[derive(Clone, Debug)]
pub struct SigningConfig {
    /// The key, the same as the other side's.
    pub key: Key,
    /// The id of this link, which no other sender on the same link has.
    pub link_id: u8,
    /// The file that stores the newest stamp over a restart; `None` stores none.
    pub stamp_file: Option<PathBuf>,
    /// The clock.
    pub clock: fn() -> SystemTime,
}

/// Why a file's key is not used.
#[derive(Debug, thiserror::Error)]
pub enum KeyFileError {
    /// It cannot be read.
    #[error("reading the signing key {path:?}: {cause}")]
    Read {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        cause: io::Error,
    },
    /// Other users can read it.
    #[error(
        "the signing key {path:?} is open to other users (mode {mode:o}): `chmod 600 {}`; if another person may have \
         read it, take another key", path.display()
    )]
    Open {
        /// The file.
        path: PathBuf,
        /// Its permissions.
        mode: u32,
    },
    /// It is no key.
    #[error("the signing key {path:?} is {cause}")]
    NotAKey {
        /// The file.
        path: PathBuf,
        /// Why not.
        cause: crate::signing::NotAKey,
    },
}

impl SigningConfig {
    /// The key in a file that only its owner can read; in `state`, if there is one, the newest stamp is stored under this
    /// `name`.
    ///
    /// # Errors
    /// When there is no key, or others can read it.
    pub fn read(
        path: &Path,
        link_id: u8,
        state: Option<PathBuf>,
        name: &str,
    ) -> Result<Self, KeyFileError> {
        let failed = |cause| KeyFileError::Read { path: path.to_owned(), cause };
        let about = std::fs::metadata(path).map_err(failed)?;
        let mode = about.permissions().mode() & 0o777;
        if mode & 0o077 != 0 {
            return Err(KeyFileError::Open { path: path.to_owned(), mode });
        }
        if about.len() > MAX_KEY_FILE {
            return Err(failed(io::Error::other(format!("it has more than {MAX_KEY_FILE} bytes"))));
        }
        let text = std::fs::read_to_string(path).map_err(failed)?;
        let key =
            text.parse().map_err(|cause| KeyFileError::NotAKey { path: path.to_owned(), cause })?;
        let stamp_file = state.map(|directory| directory.join(format!("signing-{name}.stamp")));
        Ok(Self { key, link_id, stamp_file, clock: SystemTime::now })
    }
}

/// The file of the newest stamp, which is written ahead every 10 s.
#[derive(Debug)]
pub(crate) struct StampFile {
    path: PathBuf,
    /// The stamp in the file; all below it may have been used.
    pub(crate) reserved: u64,
    is_writing: Arc<AtomicBool>,
}

impl StampFile {
    /// Reads it; without one, or with one that cannot be read, no stamps are reserved.
    pub(crate) fn read(path: PathBuf) -> Self {
        let reserved = match std::fs::read_to_string(&path) {
            Ok(text) => text.trim().parse().unwrap_or_else(|_| {
                tracing::warn!(
                    ?path,
                    "The newest stamp of signed packets cannot be read; the clock's is taken"
                );
                0
            }),
            Err(error) => {
                if error.kind() != io::ErrorKind::NotFound {
                    tracing::warn!(%error, ?path, "The newest stamp of signed packets cannot be read");
                }
                0
            }
        };
        Self { path, reserved, is_writing: Arc::default() }
    }

    /// Writes ahead when half of the reserve is used. A slow disk delays no packet.
    pub(crate) fn keep(&mut self, newest: u64) {
        if newest + RESERVE / 2 < self.reserved || self.is_writing.swap(true, Ordering::AcqRel) {
            return;
        }
        self.reserved = newest + RESERVE;
        let (path, reserved, is_writing) =
            (self.path.clone(), self.reserved, Arc::clone(&self.is_writing));
        tokio::task::spawn_blocking(move || {
            if let Err(error) = write(&path, reserved) {
                tracing::warn!(%error, ?path, "The newest stamp of signed packets is not stored");
            }
            is_writing.store(false, Ordering::Release);
        });
    }
}

fn write(path: &Path, stamp: u64) -> io::Result<()> {
    if let Some(directory) = path.parent() {
        std::fs::create_dir_all(directory)?;
    }
    // Renamed, so that a reader never sees half of it.
    let new = path.with_extension("new");
    let mut file = std::fs::OpenOptions::new()
        .write(true)
        .create(true)
        .truncate(true)
        .mode(0o600)
        .open(&new)?;
    writeln!(file, "{stamp}")?;
    file.sync_all()?;
    std::fs::rename(&new, path)
}
