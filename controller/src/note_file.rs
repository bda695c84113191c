//! The file that keeps, beyond a crash, what must be put back in the autopilot's parameters.

use std::path::{Path, PathBuf};

use node::state_directory;

use crate::limits::Note;

/// The file of one controller; it exists while there is something to put back.
#[derive(Debug)]
pub struct NoteFile {
    path: Option<PathBuf>,
    written: Option<Note>,
}

impl NoteFile {
    /// The file of the controller with this name, in the [`state_directory`].
    pub fn new(name: &str) -> Self {
        Self {
            path: state_directory().map(|it| it.join(format!("controller-{name}.json"))),
            written: None,
        }
    }

    /// What an earlier controller left; a file that cannot be read counts as none.
    pub fn read(&self) -> Option<Note> {
        let text = std::fs::read(self.path.as_ref()?).ok()?;
        let note = serde_json::from_slice(&text);
        if note.is_err() {
            tracing::warn!(file = ?self.path, "Note of an earlier controller cannot be read; ignored");
        }
        note.ok()
    }

    /// Keeps `note`, or removes the file when there is none.
    pub fn keep(&mut self, note: Option<&Note>) {
        if self.written.as_ref() == note {
            return;
        }
        self.written = note.cloned();
        let Some(path) = &self.path else { return };
        if let Err(problem) = write(path, note) {
            tracing::warn!(%problem, file = ?path, "Note of the autopilot's parameters not written");
        }
    }
}

fn write(path: &Path, note: Option<&Note>) -> std::io::Result<()> {
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
}
