//! Serves a flight under way to programs that follow it: messages and requests of the Foxglove WebSocket protocol,
//! version 1, without the network.
//!
//! The channels are those of a recording with the same types, but for messages as they were received
//! ([`RAW_PREFIX`](crate::channel::RAW_PREFIX)), which no viewer can show.
//!
//! Reference: `docs/spec.md` of <https://github.com/foxglove/ws-protocol>, version 1, and the handshake of
//! <https://github.com/foxglove/foxglove-sdk>, whose name for the same protocol is another one.

use data_encoding::BASE64;
use messages::FrameHeader;
use serde::Deserialize;
use serde_json::json;

use crate::channel::{Received, Record, Schema};
use crate::display::{Display, Picture};

/// The names of the protocol: that of new viewers, and that of older ones and Lichtblick.
pub const SUBPROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];

/// First byte of a message of a channel.
const MESSAGE_DATA: u8 = 1;
/// `status.level` of a warning.
const WARNING: u8 = 1;

/// Turns messages into those of the channels.
#[derive(Debug)]
pub struct Live {
    display: Display,
    utc_offset_ns: i64,
}

impl Live {
    /// Nothing was sent yet; `utc_offset_ns` is the time since 1970 less that of the clock of all stamps, which has this name.
    pub fn new(utc_offset_ns: i64, clock: &str) -> Self {
        Self { display: Display::new(utc_offset_ns, Some(clock)), utc_offset_ns }
    }

    /// The messages that are made of one.
    pub fn message(&mut self, message: Received<'_>) -> Vec<Record> {
        self.display.message(message)
    }

    /// The messages that are made of a frame.
    pub fn frame(
        &mut self,
        message: Received<'_>,
        header: &FrameHeader,
        picture: &Picture,
    ) -> Vec<Record> {
        self.display.frame(message, header, picture)
    }

    /// A time of the clock of all stamps since 1970, both in nanoseconds.
    pub fn utc_ns(&self, stamp_ns: i64) -> u64 {
        u64::try_from(stamp_ns.saturating_add(self.utc_offset_ns)).unwrap_or(0)
    }
}

/// A client's request.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(tag = "op", rename_all = "camelCase")]
pub enum Request {
    /// The messages of channels.
    #[serde(rename_all = "camelCase")]
    Subscribe {
        /// The channels.
        subscriptions: Vec<Subscription>,
    },
    /// No further messages of channels.
    #[serde(rename_all = "camelCase")]
    Unsubscribe {
        /// Of these subscriptions.
        subscription_ids: Vec<u32>,
    },
    /// Something that is not offered.
    #[serde(other)]
    Other,
}

/// A client's subscription to the messages of a channel.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Subscription {
    /// The number with which they are to be sent.
    pub id: u32,
    /// The channel.
    pub channel_id: u32,
}

/// The request in a client's text.
///
/// # Errors
/// When it is not a request, with the reason.
pub fn request(text: &str) -> Result<Request, String> {
    serde_json::from_str(text).map_err(|cause| cause.to_string())
}

/// The first message to a client: the name of the server and its `session`.
pub fn server_info(name: &str, session: &str) -> String {
    json!({ "op": "serverInfo", "name": name, "capabilities": [], "sessionId": session })
        .to_string()
}

/// Announces channels: number, topic and schema of each. Those without a description are left out.
pub fn advertise<'a>(channels: impl IntoIterator<Item = (u32, &'a str, Schema)>) -> String {
    let channels = channels.into_iter().filter_map(|(id, topic, schema)| {
        let it = schema.description()?;
        let text = match schema {
            Schema::Protobuf(_) => BASE64.encode(&it.data),
            Schema::Json(_) | Schema::Raw => String::from_utf8(it.data).ok()?,
        };
        Some(json!({
            "id": id, "topic": topic, "encoding": schema.message_encoding(),
            "schemaName": it.name, "schema": text, "schemaEncoding": it.encoding,
        }))
    });
    json!({ "op": "advertise", "channels": channels.collect::<Vec<_>>() }).to_string()
}

/// A warning for the user of the viewer; a later one of the same `id` replaces it.
pub fn warning(id: &str, message: &str) -> String {
    json!({ "op": "status", "level": WARNING, "message": message, "id": id }).to_string()
}

/// A message of a channel.
pub fn message_data(subscription: u32, log_time_ns: u64, data: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(13 + data.len());
    bytes.push(MESSAGE_DATA);
    bytes.extend_from_slice(&subscription.to_le_bytes());
    bytes.extend_from_slice(&log_time_ns.to_le_bytes());
    bytes.extend_from_slice(data);
    bytes
}

#[cfg(test)]
mod tests {
    use messages::{Wind, encode};
    use serde_json::Value;

    use super::*;
    use crate::foxglove::LOG;

    #[test]
    fn requests_are_read_as_the_specification_shows_them() {
        let text = r#"{ "op": "subscribe", "subscriptions": [{ "id": 0, "channelId": 3 }, { "id": 1, "channelId": 5 }] }"#;
        let expected = [(0, 3), (1, 5)].map(|(id, channel_id)| Subscription { id, channel_id });
        assert_eq!(request(text), Ok(Request::Subscribe { subscriptions: expected.into() }));
        let text = r#"{ "op": "unsubscribe", "subscriptionIds": [0, 1] }"#;
        assert_eq!(request(text), Ok(Request::Unsubscribe { subscription_ids: vec![0, 1] }));
        assert_eq!(request(r#"{ "op": "getParameters" }"#), Ok(Request::Other));
        for text in ["", "{}", "[]", r#"{ "op": "subscribe", "subscriptions": [{ "id": -1 }] }"#] {
            assert!(request(text).is_err(), "{text}");
        }
    }

    #[test]
    fn a_message_has_its_subscription_and_its_time_in_front() {
        let bytes = message_data(0x0102, 0x0304, b"ab");
        assert_eq!(bytes, [1, 2, 1, 0, 0, 4, 3, 0, 0, 0, 0, 0, 0, b'a', b'b']);
    }

    #[test]
    fn channels_are_announced_with_their_types() {
        let channels = [
            (1, "wind", Schema::Json("Wind")),
            (2, "log", Schema::Protobuf(&LOG)),
            (3, "x", Schema::Raw),
        ];
        let announced: Value = serde_json::from_str(&advertise(channels)).unwrap();
        assert_eq!(
            (&announced["op"], announced["channels"].as_array().unwrap().len()),
            (&json!("advertise"), 2)
        );
        let [wind, log] = [0, 1].map(|index| &announced["channels"][index]);
        assert_eq!(wind["schemaName"], "alight.Wind");
        assert_eq!(
            (&wind["encoding"], &wind["schemaEncoding"]),
            (&json!("json"), &json!("jsonschema"))
        );
        assert_eq!((&log["id"], &log["schemaName"]), (&json!(2), &json!("foxglove.Log")));
        let types = BASE64.decode(log["schema"].as_str().unwrap().as_bytes()).unwrap();
        assert_eq!(types, crate::protobuf::descriptor_set(&LOG));
    }

    #[test]
    fn a_message_is_made_of_the_received_bytes() {
        let mut live = Live::new(1_000, "clock");
        let payload = encode(&Wind { velocity_ned_m_s: [1.0, 0.0, 0.0], stamp_ns: 7 });
        let received = Received { key: "wind", payload: &payload, attachment: b"", received_ns: 9 };
        let records = live.message(received);
        assert_eq!(records.iter().map(|it| it.channel.as_str()).collect::<Vec<_>>(), ["wind"]);
        assert_eq!((live.utc_ns(9), live.utc_ns(-2_000)), (1_009, 0));
    }
}
