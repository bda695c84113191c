//! Ends a recording properly whose writer was killed, and says what is lost.

use std::io::Write;

use mcap::Attachment;
use mcap::read::{ChunkReader, LinearReader, Options};
use mcap::records::Record;
use mcap::write::{NoSeek, WriteOptions};

use crate::writer::Problem;

/// What a repair found.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Repaired {
    /// Messages that were kept.
    pub messages: u64,
    /// Chunks that were kept.
    pub chunks: u64,
    /// What is damaged or missing; nothing for a whole file.
    pub damage: Vec<String>,
}

/// Copies every whole chunk of a recording into `output`, and ends it.
///
/// # Errors
/// When `recording` is no MCAP file at all, or the output does not take it.
pub fn repair<W: Write>(recording: &[u8], output: W) -> Result<Repaired, Problem> {
    let options = WriteOptions::new().compression(None).disable_seeking(true);
    let mut mcap = options.create(NoSeek::new(output))?;
    let mut repaired = Repaired::default();
    let mut is_ended = false;
    if !recording.starts_with(mcap::MAGIC) {
        return Err(mcap::McapError::BadMagic.into());
    }
    let reader = LinearReader::new_with_options(recording, Options::IgnoreEndMagic.into())?;
    for record in reader {
        match record {
            Ok(Record::Chunk { header, data }) => {
                let records = ChunkReader::new(header, &data)
                    .and_then(Iterator::collect::<Result<Vec<_>, _>>);
                match records {
                    Ok(records) => {
                        repaired.chunks += 1;
                        for record in records {
                            repaired.messages += copy(&mut mcap, record, &mut repaired.damage)?;
                        }
                        mcap.flush()?;
                    }
                    Err(problem) => {
                        let number = repaired.chunks + 1;
                        repaired.damage.push(format!("chunk {number} is damaged: {problem}"));
                    }
                }
            }
            Ok(Record::DataEnd(_)) => {
                is_ended = true;
                break;
            }
            Ok(Record::Metadata(metadata)) => mcap.write_metadata(&metadata)?,
            Ok(Record::Attachment { header, data, .. }) => mcap.attach(&Attachment {
                log_time: header.log_time,
                create_time: header.create_time,
                name: header.name,
                media_type: header.media_type,
                data,
            })?,
            // The index is made anew.
            Ok(Record::Header(_) | Record::MessageIndex(_)) => {}
            // Everything else is inside of chunks.
            Ok(record) => {
                let (opcode, chunks) = (record.opcode(), repaired.chunks);
                repaired
                    .damage
                    .push(format!("an unexpected record ({opcode}) after chunk {chunks}"));
            }
            Err(problem) => {
                let chunks = repaired.chunks;
                repaired.damage.push(format!("unreadable after {chunks} chunks: {problem}"));
                break;
            }
        }
    }
    if !is_ended && repaired.damage.is_empty() {
        repaired
            .damage
            .push("it was not ended: its last chunk, up to half a second, is missing".to_owned());
    }
    mcap.finish()?;
    Ok(repaired)
}

/// Copies a record; the number of messages that it was.
fn copy<W: Write>(
    mcap: &mut mcap::Writer<NoSeek<W>>,
    record: Record<'_>,
    damage: &mut Vec<String>,
) -> Result<u64, Problem> {
    let taken = match record {
        Record::Schema { header, data } => {
            mcap.add_schema_with_id(header.id, &header.name, &header.encoding, &data).map(|_id| 0)
        }
        Record::Channel(channel) => mcap
            .add_channel_with_id(
                channel.id,
                channel.schema_id,
                &channel.topic,
                &channel.message_encoding,
                &channel.metadata,
            )
            .map(|_id| 0),
        Record::Message { header, data } => mcap.write_to_known_channel(&header, &data).map(|()| 1),
        _ => Ok(0),
    };
    match taken {
        Ok(messages) => Ok(messages),
        Err(mcap::McapError::Io(problem)) => Err(mcap::McapError::Io(problem).into()),
        // Its channel was in a damaged chunk.
        Err(problem) => {
            let text = format!("a record is lost: {problem}");
            if !damage.contains(&text) {
                damage.push(text);
            }
            Ok(0)
        }
    }
}
