//! Writes to the disk: a separate thread opens a file under a free name, appends to it and syncs it. No other thread waits for the disk.

use std::collections::VecDeque;
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, bail};
use rustix::fs::fstatvfs;

/// A file that is being written.
#[derive(Debug)]
pub(crate) struct Disk {
    shared: Arc<Shared>,
}

#[derive(Debug, Default)]
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    /// The bytes that wait, and their number with those that are being written.
    waiting: VecDeque<Vec<u8>>,
    waiting_bytes: usize,
    /// Since when the oldest of it waits.
    since: Option<Instant>,
    /// No more bytes will be handed over.
    is_complete: bool,
    status: DiskStatus,
}

/// How a file is doing.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct DiskStatus {
    /// The file, once it is open.
    pub(crate) path: Option<PathBuf>,
    /// Bytes that are on the disk.
    pub(crate) bytes: u64,
    /// Bytes that are free on it, once the file is open; `None` where its file system has no bound.
    pub(crate) free_bytes: Option<u64>,
    /// Bytes that wait for it.
    pub(crate) waiting_bytes: usize,
    /// How long the oldest of them wait.
    pub(crate) stalled: Duration,
    /// Everything is on the disk, or an error ended it.
    pub(crate) has_ended: bool,
    /// Why the file takes no more.
    pub(crate) problem: Option<String>,
}

impl Disk {
    /// Opens a new file in the background; one that is there already is never written over.
    ///
    /// # Errors
    /// When no thread can be started.
    pub(crate) fn open(requested: PathBuf) -> anyhow::Result<Self> {
        let shared = Arc::new(Shared::default());
        let writer = Arc::clone(&shared);
        // The thread ends with its file; one that hangs in the system ends with the process.
        std::thread::Builder::new()
            .name("disk".to_owned())
            .spawn(move || {
                let result = writer.write_all(&requested);
                let mut state = writer.lock();
                state.status.problem = result.err().map(|error| in_words(&error));
                state.status.has_ended = true;
                writer.changed.notify_all();
            })
            .context("starting the thread of the disk")?;
        Ok(Self { shared })
    }

    /// Hands over bytes to be written.
    pub(crate) fn append(&self, bytes: Vec<u8>) {
        let mut state = self.shared.lock();
        state.since.get_or_insert_with(Instant::now);
        state.waiting_bytes += bytes.len();
        state.waiting.push_back(bytes);
        self.shared.changed.notify_all();
    }

    /// No more bytes will be handed over.
    pub(crate) fn complete(&self) {
        self.shared.lock().is_complete = true;
        self.shared.changed.notify_all();
    }

    /// How it is doing.
    pub(crate) fn status(&self) -> DiskStatus {
        self.shared.lock().status()
    }

    /// Waits until it has ended; how it is doing then.
    pub(crate) fn wait(&self, limit: Duration) -> DiskStatus {
        let is_running = |state: &mut State| !state.status.has_ended;
        let waited = self.shared.changed.wait_timeout_while(self.shared.lock(), limit, is_running);
        waited.unwrap_or_else(PoisonError::into_inner).0.status()
    }
}

impl State {
    fn status(&self) -> DiskStatus {
        DiskStatus {
            waiting_bytes: self.waiting_bytes,
            stalled: self.since.map_or(Duration::ZERO, |since| since.elapsed()),
            ..self.status.clone()
        }
    }
}

impl Shared {
    // Every state is complete, also when a thread panics.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Writes until everything is there.
    fn write_all(&self, requested: &Path) -> anyhow::Result<()> {
        let (path, mut file) = create(requested)?;
        // Asked for by this thread, as a disk that hangs does not answer.
        let room_bytes = free_bytes(&file);
        let mut state = self.lock();
        state.status.path = Some(path.clone());
        state.status.free_bytes = room_bytes;
        drop(state);
        let result = self.write(&path, &mut file);
        if result.is_err() && self.lock().status.bytes == 0 {
            // A disk without room still takes empty files, one for each attempt. A file that others put there is theirs.
            if is_still_there(&path, &file).is_ok() {
                drop(std::fs::remove_file(&path));
            }
            self.lock().status.path = None;
        }
        result
    }

    fn write(&self, path: &Path, file: &mut File) -> anyhow::Result<()> {
        let doing = || format!("writing {path:?}; make room, or record to another disk");
        loop {
            let pieces = self.next();
            if pieces.is_empty() {
                return Ok(());
            }
            let mut bytes = 0;
            for piece in &pieces {
                file.write_all(piece).with_context(doing)?;
                bytes += piece.len();
            }
            file.sync_data().with_context(doing)?;
            is_still_there(path, file).with_context(|| format!("writing {path:?}"))?;
            let room_bytes = free_bytes(file);
            let mut state = self.lock();
            state.status.bytes += bytes as u64;
            state.status.free_bytes = room_bytes;
            state.waiting_bytes = state.waiting_bytes.saturating_sub(bytes);
            state.since = (!state.waiting.is_empty()).then(Instant::now);
        }
    }

    /// Waits for bytes to be written; empty once everything is.
    fn next(&self) -> VecDeque<Vec<u8>> {
        let is_idle = |state: &mut State| state.waiting.is_empty() && !state.is_complete;
        let state = self.changed.wait_while(self.lock(), is_idle);
        std::mem::take(&mut state.unwrap_or_else(PoisonError::into_inner).waiting)
    }
}

/// The cause first, as a ground station may show no more; then the failed action, and the remedy.
fn in_words(error: &anyhow::Error) -> String {
    let (cause, context) = (error.root_cause().to_string(), error.to_string());
    if cause == context { context } else { format!("{cause}, {context}") }
}

/// A file that was removed, or whose disk was, accepts bytes without an error.
fn is_still_there(path: &Path, file: &File) -> anyhow::Result<()> {
    let ours = file.metadata()?;
    let found = std::fs::metadata(path).map_err(|_cause| anyhow!("the file was removed"))?;
    if (ours.dev(), ours.ino()) != (found.dev(), found.ino()) {
        bail!("another file was put in its place");
    }
    Ok(())
}

/// The bytes that this user may still write to the disk of a file.
fn free_bytes(file: &File) -> Option<u64> {
    let about = fstatvfs(file).ok()?;
    // A file system without a bound has no blocks.
    (about.f_blocks > 0).then(|| about.f_bavail.saturating_mul(about.f_frsize))
}

/// Creates a file, and the directories that it is in.
fn create(requested: &Path) -> anyhow::Result<(PathBuf, File)> {
    let path = free(requested);
    let doing = || {
        format!("creating {path:?}; choose a file on a disk with room that this user may write to")
    };
    if let Some(directory) = path.parent().filter(|it| !it.as_os_str().is_empty()) {
        std::fs::create_dir_all(directory).with_context(doing)?;
    }
    let file = OpenOptions::new().write(true).create_new(true).open(&path).with_context(doing)?;
    Ok((path, file))
}

/// The path, with a number before its extension when it is taken.
fn free(path: &Path) -> PathBuf {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let extension =
        path.extension().map(|it| format!(".{}", it.to_string_lossy())).unwrap_or_default();
    let numbered = (2..).map(|number| path.with_file_name(format!("{stem}-{number}{extension}")));
    let mut candidates = std::iter::once(path.to_owned()).chain(numbered);
    candidates.find(|candidate| !candidate.exists()).unwrap_or_else(|| path.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    const TIMEOUT: Duration = Duration::from_secs(20);

    #[test]
    fn a_file_that_is_there_is_not_written_over() {
        let folder = tempfile::tempdir().unwrap();
        let requested = folder.path().join("deep/flight.mcap");
        for name in ["deep/flight.mcap", "deep/flight-2.mcap"] {
            let disk = Disk::open(requested.clone()).unwrap();
            disk.append(b"ab".to_vec());
            disk.append(b"c".to_vec());
            disk.complete();
            let status = disk.wait(TIMEOUT);
            assert_eq!((status.bytes, status.waiting_bytes, status.problem), (3, 0, None));
            assert!(status.free_bytes.is_some_and(|bytes| bytes > 0), "{:?}", status.free_bytes);
            assert_eq!(status.path, Some(folder.path().join(name)));
            assert_eq!(std::fs::read(folder.path().join(name)).unwrap(), b"abc");
        }
    }

    #[test]
    fn a_file_that_is_removed_is_noticed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("flight.mcap");
        let disk = Disk::open(path.clone()).unwrap();
        disk.append(b"ab".to_vec());
        while disk.status().bytes == 0 {
            std::thread::yield_now();
        }
        std::fs::remove_file(&path).unwrap();
        disk.append(b"cd".to_vec());
        let problem = disk.wait(TIMEOUT).problem.unwrap();
        assert!(problem.contains("removed"), "{problem}");
    }

    #[test]
    fn a_file_that_others_put_in_its_place_stays() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("flight.mcap");
        let disk = Disk::open(path.clone()).unwrap();
        while disk.status().path.is_none() {
            std::thread::yield_now();
        }
        std::fs::write(folder.path().join("other"), b"theirs").unwrap();
        std::fs::rename(folder.path().join("other"), &path).unwrap();
        disk.append(b"ab".to_vec());
        let problem = disk.wait(TIMEOUT).problem.unwrap();
        assert!(problem.contains("another file"), "{problem}");
        assert_eq!(std::fs::read(&path).unwrap(), b"theirs");
    }

    #[test]
    fn a_place_where_nothing_can_be_written_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let taken = folder.path().join("taken");
        std::fs::write(&taken, b"").unwrap();
        let problem = Disk::open(taken.join("flight.mcap")).unwrap().wait(TIMEOUT).problem.unwrap();
        assert!(problem.contains("taken/flight.mcap") && problem.contains("choose"), "{problem}");
    }

    #[test]
    fn a_full_disk_is_named() {
        // Every write to it fails for want of room.
        let mut file = OpenOptions::new().write(true).open("/dev/full").unwrap();
        let shared = Shared::default();
        shared.lock().waiting.push_back(b"ab".to_vec());
        let error = shared.write(Path::new("/dev/full"), &mut file).unwrap_err();
        assert!(format!("{error:#}").contains("No space left"), "{error:#}");
    }
}
