//! Gathers the controllers' tapes from the messages of a recording, or of several files of one flight: parts in order, each once,
//! and the damage: parts that could not be read.

use std::collections::BTreeMap;

use messages::{Tape, decode, topic};

use crate::reader::{Entry, read};
use crate::writer::Error;

/// The tape of one controller, as far as recordings contain it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RecordedTape {
    /// When it began, in nanoseconds of the controller's clock.
    pub begun_ns: i64,
    /// Its parts, in order; some may be missing, which their numbers show.
    pub parts: Vec<Tape>,
}

/// Gathers tapes from recordings, which may be several files of one flight.
#[derive(Clone, Debug, Default)]
pub struct TapeReader {
    /// By their begin, and the number of each part's first record.
    parts: BTreeMap<i64, BTreeMap<u64, Tape>>,
    /// The parts that could not be read.
    damage: Vec<String>,
}

impl TapeReader {
    /// Adds the parts in a recording.
    ///
    /// # Errors
    /// When it is not an MCAP file.
    pub fn read(&mut self, recording: &[u8]) -> Result<(), Error> {
        let key = topic::TAPE.key(&[]);
        let reading = read(recording, |entry| match entry {
            Entry::Message(message) if message.key == key => {
                self.take(message.payload);
            }
            _ => {}
        })?;
        self.damage.extend(reading.damage);
        Ok(())
    }

    /// Adds a message of [`topic::TAPE`]; when its tape began, in nanoseconds of the controller's clock, unless it cannot be read.
    pub fn take(&mut self, payload: &[u8]) -> Option<i64> {
        match decode::<Tape>(payload) {
            Ok(tape) => {
                let begun_ns = tape.begun_ns;
                self.push(tape);
                Some(begun_ns)
            }
            Err(error) => {
                self.note(format!("a part of a tape {}", error.in_recording()));
                None
            }
        }
    }

    /// Adds a part of a tape. Of two at the same position in it that differ, the first is used.
    pub fn push(&mut self, tape: Tape) {
        let begun_ns = tape.begun_ns;
        let parts = self.parts.entry(begun_ns).or_default();
        let known = parts.entry(tape.first).or_insert_with(|| tape.clone());
        if *known != tape {
            self.note(format!(
                "two tapes that began at the same time ({begun_ns} ns) differ: they are of two flights, which are read one by one"
            ));
        }
    }

    /// Notes damage, each once.
    fn note(&mut self, damage: String) {
        if !self.damage.contains(&damage) {
            self.damage.push(damage);
        }
    }

    /// True when there is no tape.
    pub fn is_empty(&self) -> bool {
        self.parts.is_empty()
    }

    /// True when a tape of the other is one of these: begun at the same time, and the same in each part that both have.
    /// In lock-step every flight begins at the same time.
    pub fn shares_tape_with(&self, other: &Self) -> bool {
        self.parts.iter().any(|(begun_ns, parts)| {
            other.parts.get(begun_ns).is_some_and(|others| {
                parts.iter().all(|(first, part)| others.get(first).is_none_or(|it| it == part))
            })
        })
    }

    /// The parts that could not be read, as sentences.
    pub fn damage(&self) -> &[String] {
        &self.damage
    }

    /// The tapes, in the order in which they began.
    pub fn tapes(self) -> Vec<RecordedTape> {
        let tape = |(begun_ns, parts): (i64, BTreeMap<u64, Tape>)| RecordedTape {
            begun_ns,
            parts: parts.into_values().collect(),
        };
        self.parts.into_iter().map(tape).collect()
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use messages::{TapeEvent, TapeOutput, TapeWriter, encode};

    use super::*;
    use crate::{About, Received, Writer};

    #[test]
    fn tapes_are_read_from_a_recording_also_when_it_was_not_ended() {
        let about = About { program: "test".to_owned(), facts: BTreeMap::new(), utc_offset_ns: 1 };
        let mut file = Vec::new();
        let mut recording = Writer::new(&mut file, &about).unwrap();
        let mut tape = TapeWriter::new(3);
        for now_ns in 4..10 {
            tape.write(now_ns, &TapeEvent::Tick, &TapeOutput::default());
            let payload = encode(&tape.take().unwrap());
            let key = topic::TAPE.key(&[]);
            let message =
                Received { key: &key, payload: &payload, attachment: b"", received_ns: now_ns };
            recording.receive(message).unwrap();
        }
        recording.flush().unwrap();
        // As when it is killed: dropped it would still write its end.
        std::mem::forget(recording);
        let mut reader = TapeReader::default();
        reader.read(&file).unwrap();
        assert!(reader.damage().is_empty(), "{:?}", reader.damage());
        let tapes = reader.tapes();
        assert_eq!(tapes.len(), 1);
        assert_eq!((tapes[0].begun_ns, tapes[0].parts.len()), (3, 6));
        let firsts: Vec<u64> = tapes[0].parts.iter().map(|part| part.first).collect();
        assert_eq!(firsts, [0, 1, 2, 3, 4, 5]);
        assert!(TapeReader::default().read(b"no file").is_err());
    }

    #[test]
    fn tapes_that_begin_at_the_same_time_are_the_same_unless_a_part_differs() {
        let reader = |begun_ns, firsts: &[u64], records: &[u8]| {
            let mut reader = TapeReader::default();
            for &first in firsts {
                let records = records.to_vec();
                reader.push(Tape { begun_ns, first, records, ..Tape::default() });
            }
            reader
        };
        let one = reader(3, &[0, 5], b"one");
        assert!(one.shares_tape_with(&reader(3, &[5, 9], b"one")), "it continues it");
        assert!(one.shares_tape_with(&reader(3, &[9], b"other")), "no part is in both");
        assert!(!one.shares_tape_with(&reader(3, &[0], b"other")), "another flight");
        assert!(!one.shares_tape_with(&reader(4, &[0, 5], b"one")));
        assert!(!one.shares_tape_with(&TapeReader::default()));
        let mut both = reader(3, &[0, 5], b"one");
        let again = |first, records: &[u8]| {
            let records = records.to_vec();
            Tape { begun_ns: 3, first, records, ..Tape::default() }
        };
        both.push(again(5, b"one"));
        assert!(both.damage().is_empty(), "a second file has the same part");
        both.push(again(5, b"other"));
        both.push(again(0, b"other"));
        assert_eq!(both.damage().len(), 1, "{:?}", both.damage());
        assert!(both.tapes()[0].parts.iter().all(|part| part.records == b"one"));
    }
}
