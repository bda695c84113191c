//! The files that keep, beyond a crash, what must be put back in the autopilot's parameters, and where the pad is.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use node::{clock_name, state_directory};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use tokio::task::JoinHandle;

use crate::limits::Note;
use crate::pad_note::PadNote;

/// The file of one controller with one kind of note; it exists while there is one.
#[derive(Debug)]
pub struct NoteFile<T = Note> {
    path: Option<PathBuf>,
    written: Option<T>,
}

impl<T: Clone + PartialEq + Serialize + DeserializeOwned> NoteFile<T> {
    /// The file with this name, without its ending, in the [`state_directory`].
    fn named(name: &str) -> Self {
        Self { path: state_directory().map(|it| it.join(format!("{name}.json"))), written: None }
    }

    /// What an earlier controller left; a file that cannot be read counts as none.
    pub fn read(&self) -> Option<T> {
        let text = std::fs::read(self.path.as_ref()?).ok()?;
        let note = serde_json::from_slice(&text);
        if note.is_err() {
            tracing::warn!(file = ?self.path, "Note of an earlier controller cannot be read; ignored");
        }
        note.ok()
    }

    /// Keeps `note`, or removes the file when there is none.
    pub fn keep(&mut self, note: Option<&T>) {
        if self.written.as_ref() == note {
            return;
        }
        self.written = note.cloned();
        let Some(path) = &self.path else { return };
        if let Err(problem) = write(path, note) {
            tracing::warn!(%problem, file = ?path, "Note for the next controller not written");
        }
    }
}

impl NoteFile {
    /// The file of the controller with this id for the autopilot at this address.
    pub fn new(id: &str, address: &str) -> Self {
        Self::named(&file_name(id, address))
    }
}

/// Longest part of an address that stands in a file's name; a file system takes 255 bytes.
const MAX_ADDRESS_CHARS: usize = 120;

/// Controllers of several vehicles on one machine have the same id, and keep their notes apart by the address. What cannot stand
/// in a file's name becomes a hyphen; the note has the address as it is.
fn file_name(id: &str, address: &str) -> String {
    let part = |c: char| if c.is_ascii_alphanumeric() || c == '.' { c } else { '-' };
    let address: String = address.chars().take(MAX_ADDRESS_CHARS).map(part).collect();
    format!("controller-{id}-{address}")
}

fn write(path: &Path, note: Option<&impl Serialize>) -> std::io::Result<()> {
    let Some(note) = note else {
        return if path.exists() { std::fs::remove_file(path) } else { Ok(()) };
    };
    if let Some(directory) = path.parent() {
        std::fs::create_dir_all(directory)?;
    }
    // Renamed, so that a reader never sees half of it.
    let new = path.with_extension("new");
    std::fs::write(&new, serde_json::to_vec(note)?)?;
    std::fs::rename(&new, path)
}

/// The file with the pad's place. It is written while the vehicle descends, so nothing waits for it.
#[derive(Debug)]
pub struct PadFile {
    file: Arc<Mutex<NoteFile<Clocked>>>,
    kept: Option<PadNote>,
    writing: Option<JoinHandle<()>>,
}

/// A pad's place with the name of the clock of its stamp: that of another boot tells nothing.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Clocked {
    clock: String,
    pad: PadNote,
}

impl PadFile {
    /// The file of the controller with this id for the autopilot at this address.
    pub fn new(id: &str, address: &str) -> Self {
        let file = NoteFile::named(&format!("{}-pad", file_name(id, address)));
        Self { file: Arc::new(Mutex::new(file)), kept: None, writing: None }
    }

    /// What an earlier controller left since this host was started.
    pub fn read(&self) -> Option<PadNote> {
        let left = self.file.lock().unwrap_or_else(PoisonError::into_inner).read()?;
        (left.clock == clock_name()).then_some(left.pad)
    }

    /// Keeps `note`, or removes the file when there is none; later, while it is still being written.
    pub fn keep(&mut self, note: Option<&PadNote>) {
        let is_idle = self.writing.as_ref().is_none_or(JoinHandle::is_finished);
        if self.kept.as_ref() == note || !is_idle {
            return;
        }
        self.kept = note.cloned();
        let note = note.map(|pad| Clocked { clock: clock_name().to_owned(), pad: pad.clone() });
        let file = Arc::clone(&self.file);
        self.writing = Some(tokio::task::spawn_blocking(move || {
            file.lock().unwrap_or_else(PoisonError::into_inner).keep(note.as_ref());
        }));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_note_is_kept_until_there_is_none() {
        let directory = std::env::temp_dir().join(format!("alight-note-{}", std::process::id()));
        let mut file =
            NoteFile { path: Some(directory.join("state/controller-main.json")), written: None };
        assert_eq!(file.read(), None);
        let note = Note {
            address: "udpin:127.0.0.1:14550".into(),
            system: 1,
            parameter: "GUID_TIMEOUT".into(),
            original_s: 3.0,
            set_s: 0.5,
        };
        file.keep(Some(&note));
        assert_eq!(file.read(), Some(note));
        file.keep(None);
        assert_eq!(file.read(), None);
        std::fs::remove_dir_all(directory).unwrap();
    }

    #[test]
    fn controllers_of_two_vehicles_on_one_machine_keep_their_notes_apart() {
        let names = ["udpin:127.0.0.1:14550", "udpin:127.0.0.1:14560", "serial:/dev/ttyACM0:57600"]
            .map(|address| file_name("main", address));
        assert_eq!(names[0], "controller-main-udpin-127.0.0.1-14550");
        assert_eq!(names[2], "controller-main-serial--dev-ttyACM0-57600");
        assert_ne!(names[0], names[1]);
        assert!(file_name("main", &"é/".repeat(500)).len() < 200);
    }
}
