//! Splits the metadata that a camera's program writes for each frame: a stream of JSON objects as `rpicam-vid --metadata`
//! writes it.
//!
//! Its array has one member per line (raspberrypi/rpicam-apps, `output/output.cpp`):
//!
//! ```text
//! [
//! {
//!     "ExposureTime": 1996,
//!     "SensorTimestamp": 1385372610000
//! },
//! {
//! ```
//!
//! The closing brace stays in the program's buffer until the next frame, so that an object is taken at its last
//! member, which no comma follows. Values are not all JSON (rectangles, infinity), so that lines are read one by one.
//! An object on one line, which programs of one's own may write, is read as well.

use std::collections::VecDeque;

/// Maximum bytes of a line. Those of `rpicam-vid` have some hundred; longer ones are skipped.
const MAX_LINE_BYTES: usize = 16_384;
/// Maximum number of records that wait to be taken; older ones are dropped.
const MAX_RECORDS: usize = 64;

/// The metadata of one frame.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Metadata {
    /// The sensor's stamp, in nanoseconds of the program's clock.
    pub(crate) sensor_ns: i64,
    /// Exposure time.
    pub(crate) exposure_ns: u32,
    /// Gain of the sensor's amplifier.
    pub(crate) gain: Option<f64>,
}

/// One object of the stream.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) enum Record {
    /// It states when the frame was exposed, and how long.
    Complete(Metadata),
    /// It is cut or damaged, or states neither.
    Torn,
}

/// Splits the stream into its objects.
#[derive(Default)]
pub(crate) struct MetadataReader {
    line: Vec<u8>,
    /// The line is too long, and its rest is skipped.
    is_skipped: bool,
    open: Option<Open>,
    records: VecDeque<Record>,
}

/// An object of which the end has not been read.
#[derive(Default)]
struct Open {
    sensor_ns: Option<i64>,
    exposure_ns: Option<u32>,
    gain: Option<f64>,
    is_damaged: bool,
}

impl MetadataReader {
    /// Takes the next bytes of the stream.
    pub(crate) fn push(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            if byte == b'\n' {
                let line = std::mem::take(&mut self.line);
                if std::mem::take(&mut self.is_skipped) {
                    self.damage();
                } else {
                    self.read_line(String::from_utf8_lossy(&line).trim());
                }
                self.line = line;
                self.line.clear();
            } else if self.line.len() < MAX_LINE_BYTES {
                self.line.push(byte);
            } else {
                self.is_skipped = true;
            }
        }
    }

    /// The next object.
    pub(crate) fn next(&mut self) -> Option<Record> {
        self.records.pop_front()
    }

    fn read_line(&mut self, line: &str) {
        match line {
            "" | "[" | "]" | "," => {}
            "}" | "}," => self.end(),
            _ => match line.strip_prefix('{') {
                Some("") => self.begin(),
                Some(rest) => {
                    self.begin();
                    match rest.trim_end_matches(',').strip_suffix('}') {
                        Some(members) => self.read_members(members),
                        None => self.damage(),
                    }
                    self.end();
                }
                None => self.read_member(line),
            },
        }
    }

    fn begin(&mut self) {
        if self.open.is_some() {
            // The end of the one before is missing.
            self.damage();
            self.end();
        }
        self.open = Some(Open::default());
    }

    /// A line of an object.
    fn read_member(&mut self, line: &str) {
        let (member, is_last) = match line.strip_suffix(',') {
            Some(member) => (member, false),
            None => (line, true),
        };
        // Lines of an object whose first lines are missing.
        self.open.get_or_insert_with(|| Open { is_damaged: true, ..Open::default() }).add(member);
        if is_last {
            self.end();
        }
    }

    /// The members of an object on one line.
    fn read_members(&mut self, members: &str) {
        let Some(open) = &mut self.open else { return };
        let mut depth = 0;
        let of_list = members.split(|c| {
            depth += i32::from("([{".contains(c)) - i32::from(")]}".contains(c));
            c == ',' && depth == 0
        });
        of_list.for_each(|member| open.add(member.trim()));
    }

    fn damage(&mut self) {
        if let Some(open) = &mut self.open {
            open.is_damaged = true;
        }
    }

    fn end(&mut self) {
        let Some(open) = self.open.take() else { return };
        if self.records.len() == MAX_RECORDS {
            self.records.pop_front();
        }
        self.records.push_back(open.record());
    }
}

impl Open {
    /// Adds a member `"name": value`.
    fn add(&mut self, member: &str) {
        let quoted = member.strip_prefix('"').and_then(|rest| rest.split_once("\":"));
        let Some((name, value)) = quoted else {
            self.is_damaged = true;
            return;
        };
        let value = value.trim();
        let is_repeated = match name {
            "SensorTimestamp" => {
                let sensor_ns = value.parse().ok().filter(|ns| *ns > 0);
                self.is_damaged |= sensor_ns.is_none();
                std::mem::replace(&mut self.sensor_ns, sensor_ns).is_some()
            }
            "ExposureTime" => {
                let exposure_ns = value.parse().ok().and_then(|us: u32| us.checked_mul(1000));
                self.is_damaged |= exposure_ns.is_none();
                std::mem::replace(&mut self.exposure_ns, exposure_ns).is_some()
            }
            "AnalogueGain" => {
                let gain = value.parse().ok().filter(|gain: &f64| gain.is_finite());
                std::mem::replace(&mut self.gain, gain).is_some()
            }
            _ => false,
        };
        // Two objects were joined, as the lines between them are missing.
        self.is_damaged |= is_repeated;
    }

    fn record(self) -> Record {
        match (self.sensor_ns, self.exposure_ns.filter(|ns| *ns > 0)) {
            (Some(sensor_ns), Some(exposure_ns)) if !self.is_damaged => {
                Record::Complete(Metadata { sensor_ns, exposure_ns, gain: self.gain })
            }
            _ => Record::Torn,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// As rpicam-vid writes a frame's metadata, with the separator before it.
    fn object(index: usize, sensor_ns: i64, exposure_us: u32) -> String {
        let separator = if index == 0 { "[\n" } else { ",\n" };
        // The values of libcamera's own kinds: lists, rectangles with and without a size, numbers that JSON has not.
        format!(
            "{separator}{{\n    \"SensorTimestamp\": {sensor_ns},\n    \"ScalerCrop\": \"(0, 0)/1456x1088\",\n    \
             \"ColourGains\": [ 1.9, 1.6 ],\n    \"AeLocked\": true,\n    \"Lux\": inf,\n    \
             \"AnalogueGain\": 2.5,\n    \"ExposureTime\": {exposure_us},\n    \"FrameDuration\": 33333\n}}"
        )
    }

    fn all(reader: &mut MetadataReader) -> Vec<Record> {
        std::iter::from_fn(|| reader.next()).collect()
    }

    fn complete(sensor_ns: i64, exposure_us: u32) -> Record {
        let exposure_ns = exposure_us * 1000;
        Record::Complete(Metadata { sensor_ns, exposure_ns, gain: Some(2.5) })
    }

    #[test]
    fn an_object_is_there_before_its_closing_brace() {
        let mut reader = MetadataReader::default();
        let first = object(0, 1_385_372_610_000, 1996);
        // The part that `std::endl` has flushed: all but the brace.
        reader.push(first.strip_suffix('}').unwrap().as_bytes());
        assert_eq!(all(&mut reader), [complete(1_385_372_610_000, 1996)]);
        reader.push(b"}");
        reader.push(object(1, 1_385_405_943_000, 1997).strip_suffix('}').unwrap().as_bytes());
        assert_eq!(all(&mut reader), [complete(1_385_405_943_000, 1997)]);
        reader.push(b"}\n]\n");
        assert_eq!(all(&mut reader), []);
    }

    #[test]
    fn objects_on_one_line_are_read() {
        let mut reader = MetadataReader::default();
        reader
            .push(b"{\"SensorTimestamp\": 5, \"ScalerCrop\": [0, 0, 4, 3], \"ExposureTime\": 7}\n");
        let metadata = Metadata { sensor_ns: 5, exposure_ns: 7000, gain: None };
        assert_eq!(all(&mut reader), [Record::Complete(metadata)]);
    }

    #[test]
    fn cut_and_damaged_objects_are_torn() {
        let cases = [
            "{\n    \"SensorTimestamp\": 12\n}\n",
            "{\n    \"SensorTimestamp\": 12,\n    \"ExposureTime\": 0\n",
            "{\n    \"SensorTimestamp\": 12,\n    \"ExposureTi\n",
            "{\n    \"SensorTimestamp\": 1x2,\n    \"ExposureTime\": 20\n",
            "{\n    \"SensorTimestamp\": -4,\n    \"ExposureTime\": 20\n",
            "{\n    \"SensorTimestamp\": 99999999999999999999,\n    \"ExposureTime\": 20\n",
            "{\n    \"ExposureTime\": 4294968,\n    \"SensorTimestamp\": 12\n",
            // The beginning is missing.
            "    \"SensorTimestamp\": 12,\n    \"ExposureTime\": 20\n",
            // The end of one and the beginning of the next are missing.
            "{\n    \"SensorTimestamp\": 12,\n    \"SensorTimestamp\": 13,\n    \"ExposureTime\": 20\n",
            "{\"SensorTimestamp\": 12, \"ExposureTime\": 20\n",
        ];
        for text in cases {
            let mut reader = MetadataReader::default();
            reader.push(text.as_bytes());
            assert_eq!(all(&mut reader), [Record::Torn], "{text}");
        }
        // One of which the next object's first line is the end.
        let mut reader = MetadataReader::default();
        reader.push(b"{\n    \"SensorTimestamp\": 12,\n");
        reader.push(object(1, 13, 20).as_bytes());
        reader.push(b"\n");
        assert_eq!(all(&mut reader), [Record::Torn, complete(13, 20)]);
    }

    proptest! {
        #[test]
        fn pieces_of_any_size_give_the_same_records(
            stamps in prop::collection::vec((1_i64..i64::MAX, 1_u32..4_000_000), 1..20),
            piece in 1_usize..200,
        ) {
            let text: String =
                stamps.iter().enumerate().map(|(n, (ns, us))| object(n, *ns, *us)).collect();
            let mut reader = MetadataReader::default();
            text.as_bytes().chunks(piece).for_each(|piece| reader.push(piece));
            let expected: Vec<Record> = stamps.iter().map(|(ns, us)| complete(*ns, *us)).collect();
            prop_assert_eq!(all(&mut reader), expected);
        }

        #[test]
        fn no_bytes_make_it_panic_or_grow(bytes in prop::collection::vec(any::<u8>(), 0..4000)) {
            let mut reader = MetadataReader::default();
            for _ in 0..20 {
                reader.push(&bytes);
            }
            prop_assert!(reader.line.len() <= MAX_LINE_BYTES && reader.records.len() <= MAX_RECORDS);
        }
    }
}
