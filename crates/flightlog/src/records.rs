//! Iterates over the records of a file, one after the other.

use std::panic::{AssertUnwindSafe, catch_unwind};

use mcap::McapError;
use mcap::read::{ChunkReader, footer, parse_record};
use mcap::records::{ChunkHeader, Record};

use crate::writer::Error;

/// Length of the record that ends the data: its kind, its length, its checksum.
const DATA_END_BYTES: usize = 1 + 8 + 4;

/// The records of the data, as far as the length of each leads to the next: the kind of each, and its contents.
pub(crate) struct Records<'a> {
    recording: &'a [u8],
    at: usize,
    /// Where the data end by the file's last record; `None` without it, when the first record of that kind counts.
    data_end: Option<usize>,
    is_ended: bool,
    differs: bool,
}

impl<'a> Records<'a> {
    /// The records of a file with MCAP's first bytes.
    pub(crate) fn new(recording: &'a [u8]) -> Self {
        let index = contained(|| footer(recording)).ok().map(|footer| footer.summary_start);
        let index = index.and_then(|start| usize::try_from(start).ok()).filter(|start| *start > 0);
        Self {
            recording,
            at: mcap::MAGIC.len(),
            data_end: index.and_then(|start| start.checked_sub(DATA_END_BYTES)),
            is_ended: false,
            differs: false,
        }
    }

    /// Whether the end of the data was reached.
    pub(crate) fn is_ended(&self) -> bool {
        self.is_ended
    }

    /// Whether the checksum at the end differs from that of the data before it.
    pub(crate) fn differs(&self) -> bool {
        self.differs
    }
}

impl<'a> Iterator for Records<'a> {
    type Item = (u8, Result<Record<'a>, Error>);

    fn next(&mut self) -> Option<Self::Item> {
        let start = self.at;
        let (opcode, body) = next_record(self.recording.get(start..)?)?;
        self.at = start + 1 + 8 + body.len();
        let record = contained(|| parse_record(opcode, body));
        let checksum = match &record {
            Ok(Record::DataEnd(end)) => Some(end.data_section_crc),
            _ => None,
        };
        let is_end = match self.data_end {
            Some(at) => at == start,
            None => checksum.is_some(),
        };
        if is_end {
            // 0: the writer made none.
            let is_whole = checksum.is_some_and(|checksum| {
                checksum == 0 || self.recording.get(..start).map(crc32fast::hash) == Some(checksum)
            });
            (self.at, self.is_ended, self.differs) = (self.recording.len(), true, !is_whole);
            return None;
        }
        Some((opcode, record))
    }
}

/// Whether the file begins as MCAP files do.
///
/// # Errors
/// When it does not.
pub(crate) fn check_begin(recording: &[u8]) -> Result<(), Error> {
    match recording {
        [] => Err(Error::Empty),
        _ if !recording.starts_with(mcap::MAGIC) => Err(Error::Foreign),
        _ => Ok(()),
    }
}

/// The records of a chunk.
///
/// # Errors
/// When it is damaged.
pub(crate) fn records_of(header: ChunkHeader, data: &[u8]) -> Result<Vec<Record<'_>>, Error> {
    contained(|| ChunkReader::new(header, data)?.collect())
}

/// The result of `read`; an error too when the reader panics, as it does on some damage.
pub(crate) fn contained<T>(read: impl FnOnce() -> Result<T, McapError>) -> Result<T, Error> {
    let read = catch_unwind(AssertUnwindSafe(read));
    read.map_err(|_| Error::Senseless)?.map_err(Error::from)
}

/// The next record's kind and bytes; `None` where it does not end.
fn next_record(bytes: &[u8]) -> Option<(u8, &[u8])> {
    let (opcode, rest) = bytes.split_first()?;
    let (length, rest) = rest.split_first_chunk::<8>()?;
    let length = u64::from_le_bytes(*length).try_into().ok()?;
    Some((*opcode, rest.get(..length)?))
}
