//! The files that outlast a crash of the controller: the autopilot's parameters to restore, the pad's position, and the landed vehicle.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, SystemTime};

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

    /// The note of an earlier controller; an unreadable file counts as none.
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

/// Controllers of several vehicles on one machine have the same id, and keep their notes apart by the address. Characters that a
/// file's name cannot have become hyphens; the note has the address unchanged.
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

/// The end of the name of a file with a pad's place.
const OF_A_PAD: &str = "-pad";
/// Age from which the position of a pad is useless, also where several hosts share the directory.
const MAX_PAD_AGE: Duration = Duration::from_secs(24 * 3600);

/// Removes the places of pads, for any autopilot, that no controller can use: those of an earlier boot, as a flight with a
/// killed controller leaves them. The notes of parameters stay, as only their vehicle shows whether it needs them.
pub fn remove_useless_pads() {
    if let Some(directory) = state_directory() {
        remove_pads_of_earlier_boots(&directory, clock_name(), SystemTime::now());
    }
}

fn remove_pads_of_earlier_boots(directory: &Path, clock: &str, now: SystemTime) {
    let Ok(entries) = std::fs::read_dir(directory) else { return };
    let ending = format!("{OF_A_PAD}.json");
    for entry in entries.flatten() {
        let name = entry.file_name();
        let name = name.to_string_lossy();
        let is_old = || {
            let modified = entry.metadata().and_then(|it| it.modified()).ok()?;
            Some(now.duration_since(modified).ok()? >= MAX_PAD_AGE)
        };
        let is_of_another_boot = || {
            let text = std::fs::read(entry.path()).ok()?;
            Some(serde_json::from_slice::<Clocked>(&text).ok()?.clock != clock)
        };
        if name.starts_with("controller-")
            && name.ends_with(&ending)
            && is_old() == Some(true)
            && is_of_another_boot() == Some(true)
        {
            // Another controller may have removed it meanwhile.
            let _ = std::fs::remove_file(entry.path());
        }
    }
}

/// The file with the pad's place. It is written while the vehicle descends, so nothing waits for it.
#[derive(Debug)]
pub struct PadFile {
    file: Arc<Mutex<NoteFile<Clocked>>>,
    kept: Option<PadNote>,
    writing: Option<JoinHandle<()>>,
}

/// A pad's position with the name of the clock of its stamp: one of another boot is useless.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Clocked {
    clock: String,
    pad: PadNote,
}

impl PadFile {
    /// The file of the controller with this id for the autopilot at this address.
    pub fn new(id: &str, address: &str) -> Self {
        let file = NoteFile::named(&format!("{}{OF_A_PAD}", file_name(id, address)));
        Self { file: Arc::new(Mutex::new(file)), kept: None, writing: None }
    }

    /// The note that an earlier controller left since this host was started.
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

/// The file with the system id of the vehicle that is landed: of two on one link nothing else shows with which one a controller continues
/// that resumes a landing.
#[derive(Debug)]
pub struct LandingFile {
    file: NoteFile<LandedVehicle>,
    address: String,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct LandedVehicle {
    /// The name of the clock, which is another one after each boot of this host.
    clock: String,
    /// The link's address.
    address: String,
    /// The vehicle's MAVLink system id.
    system: u8,
}

impl LandingFile {
    /// The file of the controller with this id for the autopilot at this address.
    pub fn new(id: &str, address: &str) -> Self {
        let file = NoteFile::named(&format!("{}-landing", file_name(id, address)));
        Self { file, address: address.to_owned() }
    }

    /// The vehicle that an earlier controller was landing since this host was started. Any remaining file is removed by
    /// [`LandingFile::keep`].
    pub fn read(&mut self) -> Option<u8> {
        self.file.written = self.file.read();
        let left = self.file.written.as_ref()?;
        let is_ours = left.clock == clock_name() && left.address == self.address;
        is_ours.then_some(left.system)
    }

    /// Keeps the system id of the vehicle that is landed, or removes the file when none is.
    pub fn keep(&mut self, system: Option<u8>) {
        if self.file.written.as_ref().map(|it| it.system) == system {
            return;
        }
        let note = system.map(|system| {
            let (clock, address) = (clock_name().to_owned(), self.address.clone());
            LandedVehicle { clock, address, system }
        });
        self.file.keep(note.as_ref());
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
    fn the_vehicle_that_is_landed_is_known_to_the_next_controller_until_the_landing_is_over() {
        let path = std::env::temp_dir().join(format!("alight-landing-{}.json", std::process::id()));
        let open = |address: &str| {
            let file = NoteFile { path: Some(path.clone()), written: None };
            LandingFile { file, address: address.to_owned() }
        };
        let mut file = open("udpin:0.0.0.0:14550");
        assert_eq!(file.read(), None);
        file.keep(Some(7));
        assert_eq!(open("udpin:0.0.0.0:14560").read(), None, "another link's");
        // The next controller continues with it, and it is forgotten with the landing.
        let mut next = open("udpin:0.0.0.0:14550");
        assert_eq!(next.read(), Some(7));
        next.keep(Some(7));
        assert!(path.exists());
        next.keep(None);
        assert!(!path.exists());
        // A note from before this host's start is useless, and is removed.
        let left = r#"{"clock":"monotonic/earlier","address":"udpin:0.0.0.0:14550","system":7}"#;
        std::fs::write(&path, left).unwrap();
        let mut file = open("udpin:0.0.0.0:14550");
        assert_eq!(file.read(), None);
        file.keep(None);
        assert!(!path.exists());
    }

    #[test]
    fn only_places_of_pads_of_an_earlier_boot_are_removed() {
        let directory =
            std::env::temp_dir().join(format!("alight-old-notes-{}", std::process::id()));
        std::fs::create_dir_all(&directory).unwrap();
        let pad = |clock: &str| {
            let pad = PadNote {
                address: "udpin:127.0.0.1:14550".into(),
                system: 1,
                stamp_ns: 1,
                position_ned_m: [0.0; 3],
                deviation_m: 0.1,
            };
            serde_json::to_string(&Clocked { clock: clock.into(), pad }).unwrap()
        };
        let files = [
            ("controller-main-a-pad.json", pad("monotonic/earlier")),
            ("controller-main-b-pad.json", pad("monotonic/now")),
            ("controller-main-c-pad.json", "no pad".to_owned()),
            ("controller-main-a.json", pad("monotonic/earlier")),
            ("notes-pad.json", pad("monotonic/earlier")),
        ];
        for (name, text) in &files {
            std::fs::write(directory.join(name), text).unwrap();
        }
        let left = |age: Duration| -> Vec<&str> {
            remove_pads_of_earlier_boots(&directory, "monotonic/now", SystemTime::now() + age);
            let names = files.iter().map(|(name, _)| *name);
            names.filter(|name| directory.join(name).exists()).collect()
        };
        let all = files.each_ref().map(|(name, _)| *name);
        assert_eq!(left(MAX_PAD_AGE / 2), all);
        assert_eq!(left(MAX_PAD_AGE * 2), all[1..]);
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
