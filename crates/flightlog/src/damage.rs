//! Counts the lost chunks of a recording with the times of their messages, and describes the damage of a repaired recording in the
//! metadata of its copy.

use std::collections::BTreeMap;
use std::ops::Range;

/// Name of the metadata of a repaired copy about the damage of the recording that it was made of.
pub const REPAIRED: &str = "alight-repaired";
/// Longest time that lost chunks may have covered, in nanoseconds; beyond it the times in a damaged chunk are damaged, too.
const MAX_GAP_NS: u64 = 3_600_000_000_000;
/// Number of damaged parts that are described one by one in the metadata.
const MAX_DESCRIBED: usize = 100;

/// The lost chunks of a recording.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Lost {
    /// How many could not be read.
    pub chunks: u64,
    /// How many the recording had, as far as they are known: those after a cut are not.
    pub of: u64,
    /// The times whose messages were in lost chunks, in nanoseconds of the recorder's clock.
    pub gaps_ns: Vec<Range<i64>>,
}

impl Lost {
    /// Adds those of another file of the recording.
    pub fn extend(&mut self, other: Self) {
        self.chunks = self.chunks.saturating_add(other.chunks);
        self.of = self.of.saturating_add(other.of);
        self.gaps_ns.extend(other.gaps_ns);
    }
}

/// Counts the lost chunks of a file; times are the file's own, in nanoseconds.
#[derive(Clone, Debug, Default)]
pub(crate) struct Counter {
    chunks: u64,
    of: u64,
    gaps_ns: Vec<Range<u64>>,
    /// The last time in a chunk that could be read.
    last_ns: Option<u64>,
    /// The times of the lost chunks since then, as far as they are known.
    missing_ns: Option<Range<u64>>,
}

impl Counter {
    /// A chunk could be read whose messages have these times.
    pub(crate) fn read(&mut self, times_ns: Range<u64>) {
        self.of += 1;
        // Without messages it has no time.
        if times_ns.end == 0 {
            return;
        }
        if let Some(missing_ns) = self.missing_ns.take() {
            self.push(self.last_ns.unwrap_or(missing_ns.start)..times_ns.start);
        }
        self.last_ns = self.last_ns.max(Some(times_ns.end));
    }

    /// A chunk could not be read; its times where it states them.
    pub(crate) fn lose(&mut self, times_ns: Option<Range<u64>>) {
        self.of += 1;
        self.chunks += 1;
        let times_ns = times_ns.unwrap_or_default();
        let missing_ns = self.missing_ns.get_or_insert(times_ns.clone());
        missing_ns.end = missing_ns.end.max(times_ns.end);
    }

    /// Adds the lost chunks of a recording of which this is a copy.
    pub(crate) fn add(&mut self, before: Before) {
        self.of = self.of.saturating_add(before.chunks);
        self.chunks = self.chunks.saturating_add(before.chunks);
        self.gaps_ns.extend(before.gaps_ns);
    }

    fn push(&mut self, gap_ns: Range<u64>) {
        let length_ns = gap_ns.end.checked_sub(gap_ns.start);
        if length_ns.is_some_and(|it| (1..=MAX_GAP_NS).contains(&it)) {
            self.gaps_ns.push(gap_ns);
        }
    }

    fn end(&mut self) {
        if let Some(missing_ns) = self.missing_ns.take() {
            self.push(self.last_ns.unwrap_or(missing_ns.start)..missing_ns.end);
        }
    }

    /// The lost chunks, by the recorder's clock, which is behind the file's times by `utc_offset_ns`.
    pub(crate) fn finish(mut self, utc_offset_ns: i64) -> Lost {
        self.end();
        let own_ns =
            |file_ns: u64| i64::try_from(file_ns).unwrap_or(i64::MAX).saturating_sub(utc_offset_ns);
        let gaps_ns = self.gaps_ns.into_iter().map(|gap| own_ns(gap.start)..own_ns(gap.end));
        Lost { chunks: self.chunks, of: self.of, gaps_ns: gaps_ns.collect() }
    }

    /// The metadata of a copy of the file with this damage.
    pub(crate) fn metadata(
        mut self,
        damage: &[String],
        is_cut_off: bool,
    ) -> BTreeMap<String, String> {
        self.end();
        let mut described: Vec<String> = damage.iter().take(MAX_DESCRIBED).cloned().collect();
        if let Some(more) = damage.len().checked_sub(described.len()).filter(|more| *more > 0) {
            described.push(format!("{more} further parts are damaged"));
        }
        let gaps_ns: Vec<[u64; 2]> = self.gaps_ns.iter().map(|gap| [gap.start, gap.end]).collect();
        let facts = [
            ("damage", serde_json::to_string(&described).unwrap_or_default()),
            ("lost_chunks", self.chunks.to_string()),
            ("chunks", self.of.to_string()),
            ("gaps_ns", serde_json::to_string(&gaps_ns).unwrap_or_default()),
            ("is_cut_off", is_cut_off.to_string()),
        ];
        facts.map(|(name, value)| (name.to_owned(), value)).into()
    }
}

/// The damage of a recording before its repair, as the metadata of the copy describe it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Before {
    /// The damaged parts, as sentences.
    pub(crate) damage: Vec<String>,
    /// Whether it had no end.
    pub(crate) is_cut_off: bool,
    chunks: u64,
    gaps_ns: Vec<Range<u64>>,
}

impl Before {
    /// Reads the metadata of a copy.
    pub(crate) fn of(metadata: &BTreeMap<String, String>) -> Self {
        fn read<T: serde::de::DeserializeOwned + Default>(text: Option<&String>) -> T {
            text.and_then(|text| serde_json::from_str(text).ok()).unwrap_or_default()
        }
        let damage: Vec<String> = read(metadata.get("damage"));
        let gaps_ns: Vec<[u64; 2]> = read(metadata.get("gaps_ns"));
        let mut before = Self {
            damage: damage.into_iter().map(|it| format!("before its repair: {it}")).collect(),
            is_cut_off: read(metadata.get("is_cut_off")),
            chunks: read(metadata.get("lost_chunks")),
            gaps_ns: gaps_ns.into_iter().map(|[from, to]| from..to).collect(),
        };
        if before.damage.is_empty() && !before.is_cut_off {
            before.damage.push("it is the repaired copy of a damaged recording".to_owned());
        }
        before
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: u64 = 1_000_000_000;

    #[test]
    fn lost_times_are_those_between_the_chunks_that_could_be_read() {
        let mut counter = Counter::default();
        counter.lose(Some(S..2 * S));
        counter.read(2 * S..3 * S);
        counter.lose(Some(3 * S..4 * S));
        // The times in a damaged chunk may be damaged.
        counter.lose(Some(0..S));
        counter.read(5 * S..6 * S);
        counter.read(0..0);
        counter.lose(None);
        counter.lose(Some(7 * S..8 * S));
        let copied = Before::of(&counter.clone().metadata(&["chunk 1".to_owned()], true));
        assert_eq!((copied.damage.len(), copied.is_cut_off), (1, true));
        let lost = counter.finish(S as i64);
        let seconds = |gap: &Range<i64>| gap.start / S as i64..gap.end / S as i64;
        assert_eq!((lost.chunks, lost.of), (5, 8));
        assert_eq!(lost.gaps_ns.iter().map(seconds).collect::<Vec<_>>(), [0..1, 2..4, 5..7]);
        let mut again = Counter::default();
        again.add(copied);
        let again = again.finish(S as i64);
        assert_eq!((again.chunks, again.gaps_ns), (5, lost.gaps_ns));
    }

    #[test]
    fn metadata_that_make_no_sense_are_still_those_of_a_damaged_recording() {
        let facts = [("damage", "["), ("lost_chunks", "-1"), ("gaps_ns", "[[1]]")];
        let facts = facts.map(|(name, value)| (name.to_owned(), value.to_owned())).into();
        let before = Before::of(&facts);
        assert_eq!((before.damage.len(), before.chunks, before.gaps_ns.len()), (1, 0, 0));
    }
}
