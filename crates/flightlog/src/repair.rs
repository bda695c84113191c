//! Ends a recording properly whose writer was killed, and reports the losses.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::io::Write;
use std::sync::Arc;

use mcap::records::{Metadata, Record, op};
use mcap::write::{NoSeek, WriteOptions};
use mcap::{Attachment, Channel, McapError, Summary};

use crate::damage::{Before, Counter, REPAIRED};
use crate::records::{Records, check_begin, contained, records_of};
use crate::writer::Error;

/// The damage of a file without any other known damage.
pub(crate) const DIFFERS: &str =
    "the data before its end are damaged, by their checksum; the damaged record could not be found";

/// The result of a repair.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Repaired {
    /// Messages that were copied.
    pub messages: u64,
    /// Chunks that were copied.
    pub chunks: u64,
    /// The damaged and missing parts; empty for a complete file.
    pub damage: Vec<String>,
    /// The parts that were damaged or missing before an earlier repair, of which the recording is a copy.
    pub earlier: Vec<String>,
}

/// Copies every complete chunk of a recording into `output`, and ends it. If a part is lost, the copy has metadata about it
/// ([`REPAIRED`]): it is not a complete recording.
///
/// A channel is described once, in the first chunk that has messages of it, and again in the index of a recording that
/// was ended. Where both are damaged or missing, the messages of the channel are lost, and counted.
///
/// # Errors
/// When `recording` is not an MCAP file, or the output cannot be written.
pub fn repair<W: Write>(recording: &[u8], output: W) -> Result<Repaired, Error> {
    check_begin(recording)?;
    let index = contained(|| Summary::read(recording)).ok().flatten();
    // Chunks are copied one by one, whatever their size.
    let options = WriteOptions::new().compression(None).chunk_size(None).disable_seeking(true);
    let mut copy = Copy {
        mcap: options.create(NoSeek::new(output))?,
        in_index: index.as_ref().map(|it| &it.channels),
        channels: BTreeSet::new(),
        lost: BTreeMap::new(),
        found: Repaired::default(),
    };
    let mut counter = Counter::default();
    let mut records = Records::new(recording);
    for (opcode, record) in &mut records {
        let chunks = copy.found.chunks;
        match record {
            Ok(Record::Chunk { header, data }) => {
                let times_ns = header.message_start_time..header.message_end_time;
                match records_of(header, &data) {
                    Ok(records) => {
                        counter.read(times_ns);
                        copy.chunk(records)?;
                    }
                    Err(error) => {
                        counter.lose(Some(times_ns));
                        let text =
                            format!("the chunk after {chunks} complete ones is damaged: {error}");
                        copy.found.damage.push(text);
                    }
                }
            }
            Ok(Record::Metadata(metadata)) => {
                if metadata.name == REPAIRED {
                    copy.found.earlier.extend(earlier(&metadata));
                }
                copy.mcap.write_metadata(&metadata)?;
            }
            Ok(Record::Attachment { header, data, .. }) => copy.mcap.attach(&Attachment {
                log_time: header.log_time,
                create_time: header.create_time,
                name: header.name,
                media_type: header.media_type,
                data,
            })?,
            // The index is written again.
            Ok(Record::Header(_) | Record::MessageIndex(_)) => {}
            // Everything else is inside of chunks.
            Ok(_) => {
                let text =
                    format!("an unexpected record ({opcode}) after {chunks} complete chunks");
                copy.found.damage.push(text);
            }
            Err(error) => {
                if opcode == op::CHUNK {
                    counter.lose(None);
                }
                let text = format!("a record after {chunks} complete chunks is damaged: {error}");
                copy.found.damage.push(text);
            }
        }
    }
    let Copy { mut mcap, lost, mut found, .. } = copy;
    found.damage.extend(lost.into_iter().map(|(channel, messages)| {
        format!(
            "{messages} messages of channel {channel} are lost: the description of it is damaged"
        )
    }));
    if records.differs() && found.damage.is_empty() {
        found.damage.push(DIFFERS.to_owned());
    }
    let is_cut_off = !records.is_ended();
    if is_cut_off || !found.damage.is_empty() {
        let metadata = counter.metadata(&found.damage, is_cut_off);
        mcap.write_metadata(&Metadata { name: REPAIRED.to_owned(), metadata })?;
    }
    if is_cut_off {
        let chunks = found.chunks;
        found.damage.push(format!(
            "not ended: the messages after {chunks} complete chunks are missing; a recorder that was killed loses the last half second, \
             and of a file that was cut off more may be missing"
        ));
    } else if index.is_none() {
        found.damage.push("its index is damaged or missing".to_owned());
    }
    mcap.finish()?;
    Ok(found)
}

/// The damage before an earlier repair, as sentences.
fn earlier(metadata: &Metadata) -> Vec<String> {
    let Before { mut damage, is_cut_off, .. } = Before::of(&metadata.metadata);
    damage.extend(is_cut_off.then(|| "before its repair: not ended".to_owned()));
    damage
}

/// A copy that is being made.
struct Copy<'a, W: Write> {
    mcap: mcap::Writer<NoSeek<W>>,
    /// The channels that the index of the recording describes.
    in_index: Option<&'a HashMap<u16, Arc<Channel<'static>>>>,
    /// The channels that the copy has.
    channels: BTreeSet<u16>,
    /// Messages of channels without a description.
    lost: BTreeMap<u16, u64>,
    found: Repaired,
}

impl<W: Write> Copy<'_, W> {
    fn chunk(&mut self, records: Vec<Record<'_>>) -> Result<(), McapError> {
        self.found.chunks += 1;
        for record in records {
            match self.record(record) {
                Err(error @ McapError::Io(_)) => return Err(error),
                // It contradicts earlier records.
                Err(error) => {
                    let text = format!("a description of a channel is damaged: {error}");
                    if !self.found.damage.contains(&text) {
                        self.found.damage.push(text);
                    }
                }
                Ok(()) => {}
            }
        }
        self.mcap.flush()
    }

    fn record(&mut self, record: Record<'_>) -> Result<(), McapError> {
        match record {
            Record::Schema { header, data } => {
                self.mcap.add_schema_with_id(header.id, &header.name, &header.encoding, &data)?;
            }
            Record::Channel(channel) => {
                self.mcap.add_channel_with_id(
                    channel.id,
                    channel.schema_id,
                    &channel.topic,
                    &channel.message_encoding,
                    &channel.metadata,
                )?;
                self.channels.insert(channel.id);
            }
            Record::Message { header, data } => {
                let id = header.channel_id;
                if self.is_described(id)? {
                    self.mcap.write_to_known_channel(&header, &data)?;
                    self.found.messages += 1;
                } else {
                    *self.lost.entry(id).or_default() += 1;
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// Whether the copy has this channel, if need be from the index.
    fn is_described(&mut self, id: u16) -> Result<bool, McapError> {
        if self.channels.contains(&id) {
            return Ok(true);
        }
        let Some(channel) = self.in_index.and_then(|channels| channels.get(&id)) else {
            return Ok(false);
        };
        let schema = channel.schema.as_ref();
        if let Some(schema) = schema {
            self.mcap.add_schema_with_id(
                schema.id,
                &schema.name,
                &schema.encoding,
                &schema.data,
            )?;
        }
        self.mcap.add_channel_with_id(
            id,
            schema.map_or(0, |schema| schema.id),
            &channel.topic,
            &channel.message_encoding,
            &channel.metadata,
        )?;
        Ok(self.channels.insert(id))
    }
}
