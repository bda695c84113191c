//! Writes notes of a supervisor to files for its successor, in case it is killed: that it runs, and a landing under way.

use std::io::{Error, ErrorKind};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use node::{clock_name, now_ns};
use serde::{Deserialize, Serialize};

/// The notes of a supervisor, files in the directory for runtime files ($RUNTIME_DIRECTORY or $XDG_RUNTIME_DIR).
#[derive(Clone, Debug, Default)]
pub(crate) struct Notes {
    /// There from the start of its processes until an orderly stop.
    pub(crate) running: Note,
    /// There while a landing is under way, and written again at intervals.
    pub(crate) landing: Note,
}

/// A file that exists while a state holds. It counts until the machine is restarted, in any directory.
#[derive(Clone, Debug, Default)]
pub(crate) struct Note {
    file: Option<PathBuf>,
}

/// The contents of the file.
#[derive(Serialize, Deserialize)]
struct Content {
    clock: String,
    stamp_ns: i64,
}

impl Notes {
    /// The notes of the supervisor with this name.
    pub(crate) fn of_supervisor(name: &str) -> Self {
        let named = ["RUNTIME_DIRECTORY", "XDG_RUNTIME_DIR"];
        let named = named.iter().filter_map(std::env::var_os).find(|named| !named.is_empty());
        let directory = named.map(PathBuf::from);
        let directory = directory.filter(|directory| {
            let unfit = unfit_because(directory);
            if let Some(why) = &unfit {
                tracing::warn!(
                    ?directory,
                    "Neither a landing nor a crash is noted there, as {why}"
                );
            }
            unfit.is_none()
        });
        Self::kept_in(directory.as_deref(), name)
    }

    /// The same in this directory; none are kept without one.
    pub(crate) fn kept_in(directory: Option<&Path>, name: &str) -> Self {
        let note = |what: &str| {
            let file = directory.map(|it| it.join(format!("alight-{name}.{what}")));
            Note { file }
        };
        Self { running: note("running"), landing: note("landing") }
    }
}

impl Note {
    /// Writes it, with the time; returns whether it is there now.
    pub(crate) fn write(&self) -> bool {
        let Some(file) = &self.file else { return false };
        let content = Content { clock: clock_name().to_owned(), stamp_ns: now_ns() };
        // Renamed, so that a reader never sees half of it.
        let new = file.with_added_extension("new");
        let written = serde_json::to_vec(&content).map_err(Error::from);
        let written = written
            .and_then(|text| std::fs::write(&new, text))
            .and_then(|()| std::fs::rename(&new, file));
        if let Err(problem) = &written {
            tracing::warn!(%problem, ?file, "Note for the case of a crash not written");
        }
        written.is_ok()
    }

    /// Writes it as if that was a while ago.
    #[cfg(test)]
    pub(crate) fn write_aged(&self, clock: &str, age: Duration) {
        let stamp_ns = now_ns() - i64::try_from(age.as_nanos()).unwrap();
        let content = Content { clock: clock.into(), stamp_ns };
        std::fs::write(self.file.as_ref().unwrap(), serde_json::to_vec(&content).unwrap()).unwrap();
    }

    /// Removes it.
    pub(crate) fn remove(&self) {
        let Some(file) = self.file.as_ref().filter(|file| file.exists()) else { return };
        if let Err(problem) = std::fs::remove_file(file) {
            tracing::warn!(%problem, ?file, "Note for the case of a crash not removed");
        }
    }

    /// Whether it is there, and the machine was not restarted since. A note that is there and cannot be read, as after a full disk,
    /// counts.
    pub(crate) fn is_there(&self) -> bool {
        match self.read() {
            Ok(content) => content.clock == clock_name(),
            Err(problem) => problem.kind() != ErrorKind::NotFound,
        }
    }

    /// How long ago it was written, if it is there and the machine was not restarted since.
    pub(crate) fn age(&self) -> Option<Duration> {
        let content = self.read().ok().filter(|content| content.clock == clock_name())?;
        let age_ns = u64::try_from(now_ns().saturating_sub(content.stamp_ns)).ok()?;
        Some(Duration::from_nanos(age_ns))
    }

    fn read(&self) -> Result<Content, Error> {
        let file = self.file.as_ref().ok_or(ErrorKind::NotFound)?;
        Ok(serde_json::from_slice(&std::fs::read(file)?)?)
    }
}

/// Why notes cannot be kept in a directory: only this user (and root) may write there, because a user with write access can cause a landing
/// to be resumed.
fn unfit_because(directory: &Path) -> Option<String> {
    let found = match std::fs::metadata(directory) {
        Ok(found) => found,
        Err(problem) => return Some(format!("it cannot be looked at: {problem}")),
    };
    let user = rustix::process::geteuid();
    let is_ours = (found.uid() == user.as_raw() || user.is_root()) && found.mode() & 0o022 == 0;
    (!is_ours).then(|| "other users can write there".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_directory_in_which_others_write_has_no_notes() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        for (mode, is_ours) in [(0o700, true), (0o755, true), (0o775, false), (0o1777, false)] {
            let permissions = std::fs::Permissions::from_mode(mode);
            std::fs::set_permissions(folder.path(), permissions).unwrap();
            assert_eq!(unfit_because(folder.path()).is_none(), is_ours, "{mode:o}");
        }
        let missing = unfit_because(&folder.path().join("missing")).unwrap();
        assert!(missing.contains("No such file"), "{missing}");
    }

    #[test]
    fn writing_a_note_returns_whether_it_was_written() {
        let folder = tempfile::tempdir().unwrap();
        let note = Note { file: Some(folder.path().join("x.running")) };
        assert!(note.write() && note.is_there());
        let nowhere = Note { file: Some(folder.path().join("missing/x.running")) };
        assert!(!nowhere.write() && !nowhere.is_there());
        assert!(!Note::default().write() && !Note::default().is_there());
    }

    #[test]
    fn a_note_counts_until_it_is_removed_or_the_machine_is_restarted() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("x.landing");
        let note = Note { file: Some(file.clone()) };
        assert_eq!((note.age(), Note::default().age()), (None, None));
        note.remove();
        note.write();
        assert!(note.age().unwrap() < Duration::from_secs(60));
        let age_of = |clock: &str, age: Duration| {
            note.write_aged(clock, age);
            note.age()
        };
        let long = Duration::from_secs(30);
        assert!(age_of(clock_name(), long).unwrap() >= long);
        assert!(note.is_there());
        assert_eq!(age_of("before the machine was restarted", Duration::ZERO), None);
        assert!(!note.is_there());
        // Half of it, and a directory in its place: it is there, and its age is unknown.
        std::fs::write(&file, "{").unwrap();
        assert!(note.age().is_none() && note.is_there());
        std::fs::remove_file(&file).unwrap();
        std::fs::create_dir(&file).unwrap();
        assert!(note.age().is_none() && note.is_there());
        std::fs::remove_dir(&file).unwrap();
        note.write();
        note.remove();
        assert!(!file.exists());
    }
}
