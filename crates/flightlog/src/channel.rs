//! Makes the records of a recording: messages as they were received, and as JSON.

use messages::{
    CameraControl, CameraInfo, CameraResponse, Configuration, ControllerStatus, DecodeError,
    Delivery, Detections, DetectorInfo, FrameAck, FrameHeader, GcsStatus, Health, Message,
    RecorderStatus, Refusals, TOPICS, TargetEstimate, Truth, VehicleState, Wind, decode, topic,
};

use crate::protobuf::{MessageType, descriptor_set};

/// Message encoding of a message as it was received: the length of its attachment (four bytes, little-endian), the attachment,
/// the payload.
pub const RAW: &str = "alight";
/// Prefix of the channels with messages as they were received.
pub const RAW_PREFIX: &str = "raw/";
/// A JSON schema that allows any object: the messages' own types are more exact, and are in the documents.
const ANY_OBJECT: &[u8] = br#"{"type":"object"}"#;

/// How a record's bytes are read.
#[derive(Copy, Clone, Debug)]
pub enum Schema {
    /// [`RAW`].
    Raw,
    /// JSON, of the message type with this name.
    Json(&'static str),
    /// Protocol buffers of this type.
    Protobuf(&'static MessageType),
}

/// The description of a schema for programs other than Alight.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Description {
    /// Its name.
    pub name: String,
    /// Its encoding: `jsonschema` or `protobuf`.
    pub encoding: &'static str,
    /// The schema: text, or a `FileDescriptorSet`.
    pub data: Vec<u8>,
}

impl Schema {
    /// The encoding of the messages.
    pub fn message_encoding(self) -> &'static str {
        match self {
            Self::Raw => RAW,
            Self::Json(_) => "json",
            Self::Protobuf(_) => "protobuf",
        }
    }

    /// The name of its type; empty for [`Schema::Raw`].
    pub fn name(self) -> &'static str {
        match self {
            Self::Raw => "",
            Self::Json(name) => name,
            Self::Protobuf(message) => message.name,
        }
    }

    /// Its description; `None` for [`Schema::Raw`].
    pub fn description(self) -> Option<Description> {
        match self {
            Self::Raw => None,
            Self::Json(name) => Some(Description {
                name: format!("alight.{name}"),
                encoding: "jsonschema",
                data: ANY_OBJECT.to_vec(),
            }),
            Self::Protobuf(message) => Some(Description {
                name: message.name.to_owned(),
                encoding: "protobuf",
                data: descriptor_set(message),
            }),
        }
    }
}

/// One message of one channel.
#[derive(Clone, Debug)]
pub struct Record {
    /// The channel's name.
    pub channel: String,
    /// How its bytes are read.
    pub schema: Schema,
    /// When it was taken, in nanoseconds of its publisher's clock; when it was received, without a stamp of its own.
    pub stamp_ns: i64,
    /// The bytes.
    pub data: Vec<u8>,
}

/// A message as it was received.
#[derive(Copy, Clone, Debug)]
pub struct Received<'a> {
    /// Its key, without the vehicle.
    pub key: &'a str,
    /// Its payload.
    pub payload: &'a [u8],
    /// Its attachment; empty without.
    pub attachment: &'a [u8],
    /// When it was received, in nanoseconds of the recorder's clock.
    pub received_ns: i64,
}

type ToJson = fn(&[u8]) -> Result<Vec<u8>, DecodeError>;

/// A kind of message that is also recorded as JSON.
struct JsonTopic {
    key: fn(&[&str]) -> String,
    name: &'static str,
    json: ToJson,
}

fn json<M: Message>(payload: &[u8]) -> Result<Vec<u8>, DecodeError> {
    let message = decode::<M>(payload)?;
    // Numbers that are not finite become null; the bytes next to it have them.
    Ok(serde_json::to_vec(&message).unwrap_or_default())
}

const fn json_topic<M: Message>(key: fn(&[&str]) -> String) -> JsonTopic {
    JsonTopic { key, name: M::NAME, json: json::<M> }
}

static JSON_TOPICS: [JsonTopic; 16] = [
    json_topic::<CameraInfo>(|names| topic::CAMERA_INFO.key(names)),
    json_topic::<CameraControl>(|names| topic::CAMERA_CONTROL.key(names)),
    json_topic::<Detections>(|names| topic::DETECTIONS.key(names)),
    json_topic::<FrameAck>(|names| topic::FRAME_ACK.key(names)),
    json_topic::<Refusals>(|names| topic::REFUSALS.key(names)),
    json_topic::<DetectorInfo>(|names| topic::DETECTOR_INFO.key(names)),
    json_topic::<CameraResponse>(|names| topic::CAMERA_RESPONSE.key(names)),
    json_topic::<VehicleState>(|names| topic::VEHICLE_STATE.key(names)),
    json_topic::<TargetEstimate>(|names| topic::TARGET.key(names)),
    json_topic::<ControllerStatus>(|names| topic::STATUS.key(names)),
    json_topic::<Wind>(|names| topic::WIND.key(names)),
    json_topic::<Truth>(|names| topic::TRUTH.key(names)),
    json_topic::<RecorderStatus>(|names| topic::RECORDER_STATUS.key(names)),
    json_topic::<GcsStatus>(|names| topic::GCS_STATUS.key(names)),
    json_topic::<Health>(|names| topic::HEALTH.key(names)),
    json_topic::<Configuration>(|names| topic::CONFIGURATION.key(names)),
];

/// True when a key matches a pattern, in which `*` or a name in braces stands for one part.
pub(crate) fn matches(pattern: &str, key: &str) -> bool {
    let mut expected = pattern.split('/');
    let is_any = |expected: &str| expected == "*" || expected.starts_with('{');
    let is_same =
        key.split('/').all(|part| expected.next().is_some_and(|w| is_any(w) || w == part));
    is_same && expected.next().is_none()
}

/// Whether a message is the last value of a state: with those a file begins, though they are from before.
pub fn is_state(key: &str) -> bool {
    let mut states = TOPICS.iter().filter(|row| row.delivery == Delivery::LastValue);
    states.any(|row| matches(row.key, key))
}

/// A message as it was received.
pub(crate) fn raw(message: Received<'_>) -> Record {
    let Received { key, payload, attachment, received_ns } = message;
    let mut data = Vec::with_capacity(4 + attachment.len() + payload.len());
    // An attachment is a header of some hundred bytes.
    data.extend_from_slice(&u32::try_from(attachment.len()).unwrap_or(u32::MAX).to_le_bytes());
    data.extend_from_slice(attachment);
    data.extend_from_slice(payload);
    Record {
        channel: format!("{RAW_PREFIX}{key}"),
        schema: Schema::Raw,
        stamp_ns: received_ns,
        data,
    }
}

/// The attachment and the payload in a record of a [`RAW`] channel; `None` for other bytes.
pub fn split_raw(data: &[u8]) -> Option<(&[u8], &[u8])> {
    let (length, rest) = data.split_first_chunk::<4>()?;
    rest.split_at_checked(u32::from_le_bytes(*length) as usize)
}

/// A message as JSON; `None` for one that cannot be decoded, and for topics of bytes.
pub(crate) fn as_json(message: Received<'_>) -> Option<Record> {
    let topic = JSON_TOPICS.iter().find(|it| matches(&(it.key)(&[]), message.key))?;
    let data = (topic.json)(message.payload).ok()?;
    let schema = Schema::Json(topic.name);
    Some(Record { channel: message.key.to_owned(), schema, stamp_ns: message.received_ns, data })
}

/// The header of a frame as JSON, taken at `stamp_ns` by our clock.
pub(crate) fn header_as_json(message: Received<'_>, stamp_ns: i64, header: &FrameHeader) -> Record {
    Record {
        channel: message.key.to_owned(),
        schema: Schema::Json(FrameHeader::NAME),
        stamp_ns,
        data: serde_json::to_vec(header).unwrap_or_default(),
    }
}

#[cfg(test)]
mod tests {
    use messages::encode;

    use super::*;

    #[test]
    fn a_message_is_kept_as_it_came_and_as_json() {
        let wind = Wind { velocity_ned_m_s: [1.0, -2.0, 0.5], stamp_ns: 7 };
        let payload = encode(&wind);
        let received =
            Received { key: "wind", payload: &payload, attachment: b"note", received_ns: 9 };
        let as_it_came = raw(received);
        assert_eq!(as_it_came.channel, "raw/wind");
        assert_eq!(split_raw(&as_it_came.data), Some((&b"note"[..], &payload[..])));
        let record = as_json(received).unwrap();
        assert_eq!(record.channel, "wind");
        let json: serde_json::Value = serde_json::from_slice(&record.data).unwrap();
        assert_eq!(json["velocity_ned_m_s"][1], -2.0);
        assert!(as_json(Received { payload: b"?", ..received }).is_none());
    }

    #[test]
    fn raw_bytes_that_are_cut_are_nothing() {
        assert_eq!(split_raw(&[1, 0, 0]), None);
        assert_eq!(split_raw(&[2, 0, 0, 0, 5]), None);
    }

    #[test]
    fn keys_match_part_by_part() {
        assert!(matches("detector/*/info", "detector/main/info"));
        assert!(!matches("detector/*/info", "detector/info"));
        assert!(!matches("detector/*/info", "detector/main/info/more"));
        assert!(!matches("detector/*/info/more", "detector/main/info"));
        for (key, state) in [("health/detector/main", true), ("truth", false), ("status", false)] {
            assert_eq!(is_state(key), state, "{key}");
        }
    }

    #[test]
    fn every_topic_with_a_message_of_its_own_is_kept_as_json() {
        let is_bytes = |row: &&messages::Row| {
            row.delivery == Delivery::Query
                || ["FrameHeader", "MavlinkBytes", "Tape"].contains(&row.message)
        };
        for row in TOPICS.iter().filter(|row| !is_bytes(row)) {
            assert!(JSON_TOPICS.iter().any(|it| it.name == row.message), "{}", row.message);
        }
    }
}
