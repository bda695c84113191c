//! Reads the messages, facts and files in an MCAP recording as far as it is valid, names its damage, and puts the
//! files of one recording in order.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use mcap::records::{MessageHeader, Record, op};
use mcap::{Channel, Summary};
use messages::{FrameHeader, PixelFormat, decode, topic};

use crate::channel::{RAW_PREFIX, Received, is_state, split_raw};
use crate::damage::{Before, Counter, Lost, REPAIRED};
use crate::display::picture_channel;
use crate::foxglove::{self, Image};
use crate::records::{Records, check_begin, contained, records_of};
use crate::repair::DIFFERS;
use crate::writer::{DROPPED_CHANNEL, Error, METADATA, TIME_SET};

/// An entry of a recording.
#[derive(Clone, Debug)]
pub enum Entry<'a> {
    /// Facts about the recording, by name; before everything else.
    About(BTreeMap<String, String>),
    /// A message as it was received. Of a frame only the attachment, which is its header.
    Message(Received<'a>),
    /// The recorded picture of a frame, after the frame's own message.
    Picture {
        /// The frame's header, with the format that these bytes have.
        header: FrameHeader,
        /// A JPEG file, or the pixels.
        bytes: &'a [u8],
        /// When the frame was received, in nanoseconds of the recorder's clock.
        received_ns: i64,
    },
    /// Messages that the recorder could not record, since its start, by key.
    Dropped(BTreeMap<String, u64>),
    /// The clock of UTC was set while the file was open: to so many nanoseconds more than the file's own times.
    TimeSet(i64),
}

/// How much of a recording was read.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Reading {
    /// Whether it has its end: without, its recorder was killed, or the rest is missing. A repaired copy has an end, and counts as
    /// the recording that it was made of.
    pub is_ended: bool,
    /// Whether it is the repaired copy of a recording of which a part is lost.
    pub is_repaired: bool,
    /// Messages that were read as they were received.
    pub messages: u64,
    /// The parts that could not be read, as sentences; also before a repair.
    pub damage: Vec<String>,
    /// The chunks that could not be read, also before a repair.
    pub lost: Lost,
}

/// Reads a recording; `each` receives its entries, in order.
///
/// # Errors
/// When it is not an MCAP file.
pub fn read(recording: &[u8], each: impl FnMut(Entry<'_>)) -> Result<Reading, Error> {
    check_begin(recording)?;
    let summary = contained(|| Summary::read(recording)).ok().flatten();
    let mut found = Found {
        keys: BTreeMap::new(),
        in_index: summary.map(|summary| summary.channels).unwrap_or_default(),
        utc_offset_ns: 0,
        frame: None,
        reading: Reading::default(),
        lost: 0,
        each,
    };
    let mut chunks = 0;
    let mut counter = Counter::default();
    let (mut was_cut_off, mut earlier) = (false, 0);
    let mut records = Records::new(recording);
    for (opcode, record) in &mut records {
        match record {
            Ok(Record::Metadata(metadata)) if metadata.name == METADATA => {
                found.about(metadata.metadata);
            }
            Ok(Record::Metadata(metadata)) if metadata.name == TIME_SET => {
                let ahead_ns = metadata.metadata.get("ahead_ns").and_then(|it| it.parse().ok());
                ahead_ns.into_iter().for_each(|ahead_ns| (found.each)(Entry::TimeSet(ahead_ns)));
            }
            Ok(Record::Metadata(metadata)) if metadata.name == REPAIRED => {
                let mut before = Before::of(&metadata.metadata);
                found.reading.is_repaired = true;
                earlier += before.damage.len();
                found.reading.damage.append(&mut before.damage);
                was_cut_off |= before.is_cut_off;
                counter.add(before);
            }
            Ok(Record::Chunk { header, data }) => {
                chunks += 1;
                let times_ns = header.message_start_time..header.message_end_time;
                match records_of(header, &data) {
                    Ok(records) => {
                        counter.read(times_ns);
                        records.iter().for_each(|record| found.record(record));
                    }
                    Err(error) => {
                        counter.lose(Some(times_ns));
                        let text = format!("chunk {chunks} is damaged: {error}");
                        found.reading.damage.push(text);
                    }
                }
            }
            Ok(
                Record::Header(_)
                | Record::MessageIndex(_)
                | Record::Metadata(_)
                | Record::Attachment { .. },
            ) => {}
            // Everything else is inside of chunks.
            Ok(_) => {
                let text = format!("an unexpected record ({opcode}) after {chunks} chunks");
                found.reading.damage.push(text);
            }
            Err(error) => {
                if opcode == op::CHUNK {
                    counter.lose(None);
                }
                let text = format!("a record after {chunks} chunks is damaged: {error}");
                found.reading.damage.push(text);
            }
        }
    }
    found.reading.is_ended = records.is_ended() && !was_cut_off;
    found.reading.lost = counter.finish(found.utc_offset_ns);
    if found.lost > 0 {
        let text = format!(
            "{} messages are lost: the description of their channel is damaged",
            found.lost
        );
        found.reading.damage.push(text);
    }
    if records.differs() && found.reading.damage.len() == earlier {
        found.reading.damage.push(DIFFERS.to_owned());
    }
    Ok(found.reading)
}

/// The time of a file's first message other than an earlier state: it gives the order of a recording's files.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Begin {
    /// In nanoseconds of the recorder's clock; `None` before such a message.
    received_ns: Option<i64>,
}

impl Begin {
    /// Takes the file's next message.
    pub fn take(&mut self, message: Received<'_>) {
        if self.received_ns.is_none() && !is_state(message.key) {
            self.received_ns = Some(message.received_ns);
        }
    }
}

/// The files of a recording in the order in which they were written.
///
/// # Errors
/// When one is not an MCAP file.
pub fn in_order(files: &[Vec<u8>]) -> Result<Vec<&[u8]>, Error> {
    let mut parts = Vec::new();
    for file in files {
        let mut begin = Begin::default();
        read(file, |entry| {
            if let Entry::Message(message) = entry {
                begin.take(message);
            }
        })?;
        parts.push((begin, file.as_slice()));
    }
    parts.sort_by_key(|(begin, _)| *begin);
    Ok(parts.into_iter().map(|(_, file)| file).collect())
}

/// The entries that were found so far.
struct Found<F> {
    /// Keys by channel.
    keys: BTreeMap<u16, String>,
    /// The channels that the index describes.
    in_index: HashMap<u16, Arc<Channel<'static>>>,
    utc_offset_ns: i64,
    /// The last frame: its camera by its key, when it was received by the file's time, and its header.
    frame: Option<(String, u64, FrameHeader)>,
    reading: Reading,
    /// Messages of channels without a description.
    lost: u64,
    each: F,
}

impl<F: FnMut(Entry<'_>)> Found<F> {
    fn about(&mut self, facts: BTreeMap<String, String>) {
        let offset_ns = facts.get("utc_offset_ns").and_then(|text| text.parse().ok());
        self.utc_offset_ns = offset_ns.unwrap_or(0);
        (self.each)(Entry::About(facts));
    }

    fn record(&mut self, record: &Record<'_>) {
        match record {
            Record::Channel(channel) => {
                self.keys.insert(channel.id, channel.topic.clone());
            }
            Record::Message { header, data } => self.message(header, data),
            _ => {}
        }
    }

    fn message(&mut self, header: &MessageHeader, data: &[u8]) {
        let id = header.channel_id;
        if !self.keys.contains_key(&id)
            && let Some(channel) = self.in_index.get(&id)
        {
            self.keys.insert(id, channel.topic.clone());
        }
        let Some(channel) = self.keys.get(&id) else {
            self.lost += 1;
            return;
        };
        if channel == DROPPED_CHANNEL {
            if let Ok(counts) = serde_json::from_slice(data) {
                (self.each)(Entry::Dropped(counts));
            }
            return;
        }
        let log_ns = i64::try_from(header.log_time).unwrap_or(i64::MAX);
        let received_ns = log_ns.saturating_sub(self.utc_offset_ns);
        if let Some((camera, came, frame)) = &self.frame
            && *came == header.log_time
            && picture_channel(camera) == *channel
        {
            let Some(image) = foxglove::image(data) else { return };
            let (bytes, format) = match image {
                Image::File(bytes) => (bytes, PixelFormat::Jpeg),
                Image::Pixels(bytes) => (bytes, frame.format),
            };
            let header = FrameHeader { format, ..frame.clone() };
            (self.each)(Entry::Picture { header, bytes, received_ns });
            return;
        }
        let Some(key) = channel.strip_prefix(RAW_PREFIX) else { return };
        let Some((attachment, payload)) = split_raw(data) else {
            self.reading.damage.push(format!("a message of {key} is cut"));
            return;
        };
        if let Some(camera) = topic::FRAME.first_name(key) {
            self.frame = decode(attachment)
                .ok()
                .map(|frame: FrameHeader| (camera.to_owned(), header.log_time, frame));
        }
        self.reading.messages += 1;
        (self.each)(Entry::Message(Received { key, payload, attachment, received_ns }));
    }
}

#[cfg(test)]
mod tests {
    use messages::{Wind, encode};

    use super::*;
    use crate::{About, Picture, Writer};

    fn recording() -> Vec<u8> {
        let facts = [("host".to_owned(), "here".to_owned())].into();
        let about = About { program: "test".to_owned(), facts, utc_offset_ns: 1_000 };
        let mut file = Vec::new();
        let mut recording = Writer::new(&mut file, &about).unwrap();
        for stamp_ns in 0..50 {
            let wind = Wind { velocity_ned_m_s: [1.0, 0.0, 0.0], stamp_ns };
            let payload = encode(&wind);
            let message = Received {
                key: "wind",
                payload: &payload,
                attachment: b"note",
                received_ns: stamp_ns + 5,
            };
            recording.receive(message).unwrap();
            recording.flush().unwrap();
        }
        recording.dropped(60, &[("truth".to_owned(), 3)].into()).unwrap();
        recording.finish().unwrap();
        file
    }

    /// The reception times of the messages, and the number of other entries.
    fn times(file: &[u8]) -> (Vec<i64>, usize, Reading) {
        let (mut times, mut others) = (Vec::new(), 0);
        let reading = read(file, |entry| match entry {
            Entry::Message(message) => {
                assert_eq!((message.key, message.attachment), ("wind", &b"note"[..]));
                times.push(message.received_ns);
            }
            Entry::About(facts) => {
                assert_eq!(facts.get("host").map(String::as_str), Some("here"));
                others += 1;
            }
            Entry::Dropped(counts) => {
                assert_eq!(counts.get("truth"), Some(&3));
                others += 1;
            }
            Entry::Picture { .. } | Entry::TimeSet(_) => panic!("{entry:?}"),
        });
        (times, others, reading.unwrap())
    }

    #[test]
    fn other_files_and_empty_files_have_different_errors() {
        for (file, part) in [(&b""[..], "it is empty"), (b"text", "does not begin as MCAP files")] {
            let read = read(file, |_| ()).unwrap_err().to_string();
            let repaired = crate::repair(file, std::io::sink()).unwrap_err().to_string();
            assert!(read.contains(part) && repaired == read, "{read} {repaired}");
        }
    }

    #[test]
    fn messages_are_read_as_they_came_with_their_time() {
        let (times, others, reading) = times(&recording());
        assert_eq!(times, (5..55).collect::<Vec<_>>());
        assert_eq!((others, reading.is_ended, reading.messages), (2, true, 50));
        assert!(reading.damage.is_empty(), "{:?}", reading.damage);
    }

    #[test]
    fn files_are_in_the_order_of_their_first_messages_other_than_earlier_states() {
        let file = |keys: &[&str], from_ns: i64| {
            let mut file = Vec::new();
            let mut recording = Writer::new(&mut file, &About::default()).unwrap();
            for (received_ns, key) in (from_ns..).zip(keys) {
                let message = Received { key, payload: b"", attachment: b"", received_ns };
                recording.receive(message).unwrap();
            }
            recording.finish().unwrap();
            file
        };
        let [first, second] = [
            file(&["wind", "wind"], 5),
            file(&["controller/status", "camera/down/info", "wind"], 4),
        ];
        for files in [[second.clone(), first.clone()], [first.clone(), second.clone()]] {
            assert_eq!(in_order(&files).unwrap(), [&first, &second]);
        }
    }

    #[test]
    fn a_clock_that_is_set_is_noted_and_moves_no_message() {
        let mut file = Vec::new();
        let about = About { utc_offset_ns: 1_000, ..About::default() };
        let mut recording = Writer::new(&mut file, &about).unwrap();
        let wind = encode(&Wind { velocity_ned_m_s: [0.0; 3], stamp_ns: 0 });
        for received_ns in [5, 6] {
            let message = Received { key: "wind", payload: &wind, attachment: b"", received_ns };
            recording.receive(message).unwrap();
            recording.time_set(received_ns, 501_000).unwrap();
        }
        recording.finish().unwrap();
        let (mut set, mut times) = (Vec::new(), Vec::new());
        let reading = read(&file, |entry| match entry {
            Entry::TimeSet(ahead_ns) => set.push(ahead_ns),
            Entry::Message(message) => times.push(message.received_ns),
            _ => {}
        });
        assert!(reading.unwrap().damage.is_empty());
        assert_eq!((set, times), (vec![500_000; 2], vec![5, 6]));
    }

    #[test]
    fn a_recorded_picture_follows_its_frame() {
        let mut file = Vec::new();
        let mut recording = Writer::new(&mut file, &About::default()).unwrap();
        let kept = [Picture::Jpeg(b"file".to_vec()), Picture::None, Picture::Pixels];
        for (sequence, picture) in (0..).zip(&kept) {
            let format = PixelFormat::Mono8;
            let (width, height) = (3, 2);
            let header = FrameHeader { sequence, width, height, format, ..FrameHeader::sample() };
            let attachment = encode(&header);
            let message = Received {
                key: "camera/down/frame",
                payload: b"pixels",
                attachment: &attachment,
                received_ns: 9,
            };
            recording.frame(message, &header, picture).unwrap();
        }
        recording.finish().unwrap();
        let mut pictures = Vec::new();
        read(&file, |entry| {
            if let Entry::Picture { header, bytes, received_ns } = entry {
                assert_eq!(received_ns, 9);
                pictures.push((header.sequence, header.format, bytes.to_vec()));
            }
        })
        .unwrap();
        let jpeg = (0, PixelFormat::Jpeg, b"file".to_vec());
        assert_eq!(pictures, [jpeg, (2, PixelFormat::Mono8, b"pixels".to_vec())]);
    }

    #[test]
    fn of_a_damaged_recording_the_rest_is_read_and_the_damage_named() {
        let file = recording();
        let (cut, _, reading) = times(&file[..file.len() / 2]);
        assert!(cut.len() > 10 && cut.len() < 40, "{}", cut.len());
        assert!(!reading.is_ended);
        // In a message, not in the length of a chunk, behind which nothing is found again.
        let notes: Vec<_> = (0..file.len()).filter(|at| file[*at..].starts_with(b"note")).collect();
        let mut flipped = file.clone();
        flipped[notes[notes.len() / 4]] ^= 1;
        let (some, _, reading) = times(&flipped);
        assert!(some.len() > 40, "{}", some.len());
        assert!(!reading.damage.is_empty());
        assert!(read(b"no file", |_| {}).is_err());
    }

    #[test]
    fn one_flipped_bit_anywhere_before_the_end_is_named() {
        let file = recording();
        let (_, _, whole) = times(&file);
        // Where the record that ends the data begins, which has no checksum itself.
        let end = mcap::read::footer(&file).unwrap().summary_start as usize - 13;
        // The magic bytes identify the file; every sixth bit, so that each bit of a byte is among them.
        for bit in (8 * mcap::MAGIC.len()..8 * end).step_by(7) {
            let mut flipped = file.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            let reading = read(&flipped, |_| {}).unwrap();
            assert!(!reading.damage.is_empty() || !reading.is_ended, "bit {bit}: {reading:?}");
            let repaired = crate::repair(&flipped, std::io::sink()).unwrap();
            assert!(!repaired.damage.is_empty(), "bit {bit}: {repaired:?}");
        }
        // An index record that a flipped bit turns into the end of the data does not end the file.
        let mut at = mcap::MAGIC.len();
        let mut tried = 0;
        while at < end {
            let length = u64::from_le_bytes(file[at + 1..at + 9].try_into().unwrap()) as usize;
            if file[at] == op::MESSAGE_INDEX {
                let mut flipped = file.clone();
                flipped[at] = op::DATA_END;
                let reading = read(&flipped, |_| {}).unwrap();
                assert_eq!((reading.messages, reading.damage.len()), (whole.messages, 1));
                tried += 1;
            }
            at += 9 + length;
        }
        assert!(tried > 20, "{tried}");
    }
}
