//! Collects the events that the page lists, newest last.

use std::collections::VecDeque;

use serde::Serialize;

/// Maximum number of entries that are stored.
const MAX_ENTRIES: usize = 200;
/// Maximum length of an entry, in characters.
const MAX_CHARS: usize = 400;

/// The severity of an entry.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Level {
    /// Normal operation.
    Info,
    /// Operation continues, but impaired.
    Warn,
    /// A process, a link or a landing is lost.
    Bad,
}

/// An entry.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Entry {
    /// Time of the event, in milliseconds of this process' clock.
    pub at_ms: f64,
    /// Its severity.
    pub level: Level,
    /// The description.
    pub text: String,
}

/// The entries.
#[derive(Clone, Debug, Default)]
pub struct Log {
    entries: VecDeque<Entry>,
    version: u64,
}

impl Log {
    /// Adds an entry.
    pub fn add(&mut self, now_ns: i64, level: Level, text: &str) {
        if self.entries.len() >= MAX_ENTRIES {
            self.entries.pop_front();
        }
        let text = text.chars().take(MAX_CHARS).collect();
        self.entries.push_back(Entry { at_ms: now_ns as f64 * 1e-6, level, text });
        self.version += 1;
    }

    /// Number of changes so far.
    pub fn version(&self) -> u64 {
        self.version
    }

    /// The entries, oldest first.
    pub fn entries(&self) -> impl Iterator<Item = &Entry> {
        self.entries.iter()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_entries_are_stored() {
        let mut log = Log::default();
        for number in 0..500 {
            log.add(number, Level::Info, &format!("{number}{}", "x".repeat(1000)));
        }
        assert_eq!((log.entries().count(), log.version()), (MAX_ENTRIES, 500));
        let last = log.entries().last().unwrap();
        assert!(last.text.starts_with("499") && last.text.len() == MAX_CHARS, "{last:?}");
    }
}
