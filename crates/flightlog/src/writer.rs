//! Writes a recording's MCAP file, append-only: schemas, channels, messages as received, as JSON and as Foxglove shows them,
//! frames, and counts of lost messages.
//!
//! Chunks are gathered in memory and written in one piece, so a killed writer loses the messages after the last
//! [`Writer::flush`] and no earlier ones.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::Write;

use mcap::Attachment;
use mcap::records::{MessageHeader, Metadata};
use mcap::write::{NoSeek, WriteOptions};
use messages::FrameHeader;

use crate::channel::{self, Received, Record, Schema};
use crate::display::{Display, Picture};

/// Size at which a chunk is written, in bytes.
const CHUNK_BYTES: u64 = 1 << 20;
/// Name of the channel that counts messages that could not be recorded.
pub const DROPPED_CHANNEL: &str = "recorder/dropped";
/// Name of the metadata about a recording.
pub const METADATA: &str = "alight";
/// Name of the metadata that state that the clock of UTC was set.
pub const TIME_SET: &str = "alight-time-set";

/// Why a recording cannot continue.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file could not be written or read.
    #[error(transparent)]
    Io(std::io::Error),
    /// It is not a valid MCAP file.
    #[error(transparent)]
    Mcap(mcap::McapError),
    /// The file is empty.
    #[error("it is empty; was its recorder killed at once, or the disk full?")]
    Empty,
    /// It begins with other bytes than a recording.
    #[error("it does not begin as MCAP files do")]
    Foreign,
    /// Its reader panicked.
    #[error("its bytes make no sense to the reader")]
    Senseless,
}

impl From<mcap::McapError> for Error {
    fn from(error: mcap::McapError) -> Self {
        match error {
            // Its text is that of reading compressed data as well.
            mcap::McapError::Io(error) => Self::Io(error),
            error => Self::Mcap(error),
        }
    }
}

/// The source of a recording.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct About {
    /// The program and its version.
    pub program: String,
    /// Facts by name: the host, the clock's name (`clock`).
    pub facts: BTreeMap<String, String>,
    /// Time since 1970 less that of the clock of all stamps, in nanoseconds: the file's own times count from 1970.
    pub utc_offset_ns: i64,
}

/// Writes a recording.
pub struct Writer<W: Write> {
    mcap: mcap::Writer<NoSeek<W>>,
    open: BTreeMap<String, Open>,
    display: Display,
    utc_offset_ns: i64,
}

/// A channel in the file, which is of one schema.
#[derive(Copy, Clone, Debug)]
struct Open {
    id: u16,
    schema: &'static str,
    sequence: u32,
}

/// How many messages of each key could not be recorded so far, or were never received.
pub fn dropped(now_ns: i64, so_far: &BTreeMap<String, u64>) -> Record {
    Record {
        channel: DROPPED_CHANNEL.to_owned(),
        schema: Schema::Json("Dropped"),
        stamp_ns: now_ns,
        data: serde_json::to_vec(so_far).unwrap_or_default(),
    }
}

impl<W: Write> Writer<W> {
    /// Begins a recording.
    ///
    /// # Errors
    /// When the output does not take it.
    pub fn new(output: W, about: &About) -> Result<Self, Error> {
        let options = WriteOptions::new()
            .compression(None)
            .chunk_size(Some(CHUNK_BYTES))
            .disable_seeking(true)
            .profile("")
            .library(about.program.clone());
        let mut mcap = options.create(NoSeek::new(output))?;
        let mut metadata = about.facts.clone();
        metadata.insert("program".to_owned(), about.program.clone());
        metadata.insert("utc_offset_ns".to_owned(), about.utc_offset_ns.to_string());
        mcap.write_metadata(&Metadata { name: METADATA.to_owned(), metadata })?;
        let utc_offset_ns = about.utc_offset_ns;
        Ok(Self {
            mcap,
            open: BTreeMap::new(),
            display: Display::new(utc_offset_ns, about.facts.get("clock").map(String::as_str)),
            utc_offset_ns,
        })
    }

    /// Adds a message: as received, as JSON, and as Foxglove shows it. One that cannot be decoded is recorded only as received.
    ///
    /// # Errors
    /// When the output does not take it; the recording is then at its end.
    pub fn receive(&mut self, message: Received<'_>) -> Result<(), Error> {
        if let Some(file) = self.display.file(message) {
            let log_time = self.utc(message.received_ns);
            self.mcap.attach(&Attachment {
                log_time,
                create_time: log_time,
                name: file.name,
                media_type: file.media_type.to_owned(),
                data: Cow::Owned(file.data),
            })?;
        }
        self.write(message.received_ns, &channel::raw(message))?;
        for record in self.display.message(message) {
            self.write(message.received_ns, &record)?;
        }
        Ok(())
    }

    /// Adds a frame: its header as received and as JSON, and the picture.
    ///
    /// # Errors
    /// As [`Writer::receive`].
    pub fn frame(
        &mut self,
        message: Received<'_>,
        header: &FrameHeader,
        picture: &Picture,
    ) -> Result<(), Error> {
        self.write(message.received_ns, &channel::raw(Received { payload: b"", ..message }))?;
        for record in self.display.frame(message, header, picture) {
            self.write(message.received_ns, &record)?;
        }
        Ok(())
    }

    /// Writes how many messages of each key could not be recorded so far, on [`DROPPED_CHANNEL`].
    ///
    /// # Errors
    /// As [`Writer::receive`].
    pub fn dropped(&mut self, now_ns: i64, so_far: &BTreeMap<String, u64>) -> Result<(), Error> {
        self.write(now_ns, &dropped(now_ns, so_far))
    }

    /// Notes that the clock of UTC was set while the file is open: from `now_ns` of the stamps' clock on, UTC is ahead of that by
    /// `utc_offset_ns`. The file's own times continue as before: they stay in order.
    ///
    /// # Errors
    /// As [`Writer::receive`].
    pub fn time_set(&mut self, now_ns: i64, utc_offset_ns: i64) -> Result<(), Error> {
        let facts = [
            ("file_time_ns", self.utc(now_ns).to_string()),
            ("utc_offset_ns", utc_offset_ns.to_string()),
            ("ahead_ns", utc_offset_ns.saturating_sub(self.utc_offset_ns).to_string()),
        ];
        let metadata = facts.map(|(name, value)| (name.to_owned(), value)).into();
        self.mcap.write_metadata(&Metadata { name: TIME_SET.to_owned(), metadata })?;
        Ok(())
    }

    /// Hands everything so far to the output.
    ///
    /// # Errors
    /// As [`Writer::receive`].
    pub fn flush(&mut self) -> Result<(), Error> {
        Ok(self.mcap.flush()?)
    }

    /// Ends the recording with its index.
    ///
    /// # Errors
    /// As [`Writer::receive`].
    pub fn finish(mut self) -> Result<(), Error> {
        self.mcap.finish()?;
        Ok(())
    }

    /// Adds a record that was received at `received_ns`.
    fn write(&mut self, received_ns: i64, record: &Record) -> Result<(), Error> {
        let (log_time, publish_time) = (self.utc(received_ns), self.utc(record.stamp_ns));
        let channel = self.channel(record)?;
        channel.sequence = channel.sequence.wrapping_add(1);
        let header = MessageHeader {
            channel_id: channel.id,
            sequence: channel.sequence,
            log_time,
            publish_time,
        };
        Ok(self.mcap.write_to_known_channel(&header, &record.data)?)
    }

    fn utc(&self, stamp_ns: i64) -> u64 {
        u64::try_from(stamp_ns.saturating_add(self.utc_offset_ns)).unwrap_or(0)
    }

    fn channel(&mut self, record: &Record) -> Result<&mut Open, Error> {
        let name = record.schema.name();
        // A camera that starts again may send pictures of another kind: they have a channel of the same name.
        if self.open.get(&record.channel).is_none_or(|open| open.schema != name) {
            let encoding = record.schema.message_encoding();
            let schema = match record.schema.description() {
                Some(it) => self.mcap.add_schema(&it.name, it.encoding, &it.data)?,
                None => 0,
            };
            let id = self.mcap.add_channel(schema, &record.channel, encoding, &BTreeMap::new())?;
            self.open.insert(record.channel.clone(), Open { id, schema: name, sequence: 0 });
        }
        let none = Open { id: 0, schema: name, sequence: 0 };
        Ok(self.open.entry(record.channel.clone()).or_insert(none))
    }
}
