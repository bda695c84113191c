//! The list of source files in ARCHITECTURE.md.

use std::collections::BTreeMap;
use std::path::Path;

/// Modules by name, each with those in its folder.
#[derive(Default)]
struct Modules(BTreeMap<String, Modules>);

impl Modules {
    fn add(&mut self, mut path: impl Iterator<Item = String>) {
        if let Some(name) = path.next() {
            self.0.entry(name).or_default().add(path);
        }
    }

    fn names(&self) -> String {
        let names = self.0.iter().map(|(name, within)| match within.0.is_empty() {
            true => name.clone(),
            false => format!("{name} ({})", within.names()),
        });
        names.collect::<Vec<_>>().join(", ")
    }
}

/// The rows of the list: a room, and its source files by name, those of a folder in parentheses.
pub(crate) fn rows<'a>(files: impl Iterator<Item = &'a Path>) -> Vec<String> {
    let mut rooms: BTreeMap<String, Modules> = BTreeMap::new();
    for file in files {
        let Some((room, within)) = file.to_str().and_then(|name| name.split_once("/src/")) else {
            continue;
        };
        let Some(within) = within.strip_suffix(".rs") else { continue };
        let path = within.trim_end_matches("/mod");
        if !["lib", "main"].contains(&path) {
            rooms.entry(room.to_owned()).or_default().add(path.split('/').map(str::to_owned));
        }
    }
    rooms.iter().map(|(room, modules)| format!("| `{room}` | {} |", modules.names())).collect()
}
