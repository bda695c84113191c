//! The controllers' tapes in recordings.

use std::collections::{BTreeMap, BTreeSet};

use mcap::read::{LinearReader, Options};
use mcap::records::Record;
use messages::{Tape, decode, topic};

use crate::channel::{RAW_PREFIX, split_raw};
use crate::repair::{contained, records_of};
use crate::writer::Problem;

/// The tape of one controller, as far as recordings have it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RecordedTape {
    /// When it began, in nanoseconds of the controller's clock.
    pub begun_ns: i64,
    /// Its parts, in order; some may be missing, which their numbers tell.
    pub parts: Vec<Tape>,
}

/// Gathers tapes from recordings, which may be several files of one flight.
#[derive(Clone, Debug, Default)]
pub struct TapeReader {
    /// By their begin, and the number of each part's first record.
    parts: BTreeMap<i64, BTreeMap<u64, Tape>>,
    /// What could not be read.
    damage: Vec<String>,
}

impl TapeReader {
    /// Adds what is in a recording.
    ///
    /// # Errors
    /// When it is no MCAP file at all.
    pub fn read(&mut self, recording: &[u8]) -> Result<(), Problem> {
        if !recording.starts_with(mcap::MAGIC) {
            return Err(mcap::McapError::BadMagic.into());
        }
        let key = format!("{RAW_PREFIX}{}", topic::TAPE.key(&[]));
        let mut channels = BTreeSet::new();
        let mut chunks = 0;
        let options = Options::IgnoreEndMagic.into();
        let mut reader = LinearReader::new_with_options(recording, options)?;
        while let Some(record) = contained(|| reader.next().transpose()).transpose() {
            match record {
                Ok(Record::Chunk { header, data }) => {
                    chunks += 1;
                    match records_of(header, &data) {
                        Ok(records) => self.add(&records, &key, &mut channels),
                        Err(problem) => {
                            self.damage.push(format!("chunk {chunks} is damaged: {problem}"));
                        }
                    }
                }
                Ok(Record::DataEnd(_)) => break,
                Ok(_) => {}
                Err(problem) => {
                    self.damage.push(format!("unreadable after {chunks} chunks: {problem}"));
                    break;
                }
            }
        }
        Ok(())
    }

    fn add(&mut self, records: &[Record<'_>], key: &str, channels: &mut BTreeSet<u16>) {
        for record in records {
            match record {
                Record::Channel(channel) if channel.topic == key => {
                    channels.insert(channel.id);
                }
                Record::Message { header, data } if channels.contains(&header.channel_id) => {
                    let message = split_raw(data).map(|(_attachment, payload)| payload);
                    match message.map(decode::<Tape>) {
                        Some(Ok(tape)) => self.push(tape),
                        Some(Err(problem)) => self.damage.push(problem.to_string()),
                        None => self.damage.push("a part of a tape is cut".to_owned()),
                    }
                }
                _ => {}
            }
        }
    }

    /// Adds a part of a tape.
    pub fn push(&mut self, tape: Tape) {
        self.parts.entry(tape.begun_ns).or_default().insert(tape.first, tape);
    }

    /// What could not be read, as sentences.
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
}
