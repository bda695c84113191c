//! The topic table: every key with its type, its delivery, and the services that publish it and may subscribe to it.
//!
//! Keys carry no vehicle: that is the Zenoh namespace of the session.

use std::marker::PhantomData;

use crate::camera::{CameraControl, CameraInfo, FrameAck, FrameHeader};
use crate::codec::Message;
use crate::controller::{CommandReply, ControllerCommand, ControllerStatus, TargetEstimate};
use crate::detector::{CameraResponse, Detections, DetectorCommand, DetectorInfo, Refusals};
use crate::gcs::GcsStatus;
use crate::health::{Configuration, Health};
use crate::recorder::RecorderStatus;
use crate::simulation::{Truth, Wind};
use crate::tape::Tape;
use crate::vehicle::{MavlinkBytes, VehicleState};

/// How the messages of a topic are delivered.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Delivery {
    /// A stream: under congestion older messages are dropped in favour of the latest.
    Latest,
    /// A stream on the control path: as `Latest`, with priority over all other traffic.
    LatestPriority,
    /// A state: as `Latest`, and late subscribers get the last value.
    LastValue,
    /// A dialogue: every message in order, within the bounds of the queues.
    Reliable,
    /// A record for later: as `Reliable`, with lower priority than all traffic that is needed now; a late recorder gets the earlier
    /// messages as well.
    Record,
    /// A request with one reply.
    Query,
}

/// A row of the table, without its type.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Row {
    /// The key, with placeholders in braces.
    pub key: &'static str,
    /// Name of the type of its payload; for pixels and JPEG of their attachment.
    pub message: &'static str,
    /// The type's version.
    pub version: u8,
    /// How it is delivered.
    pub delivery: Delivery,
    /// The services that may publish it, or, for a query, send it.
    pub publishers: &'static [&'static str],
    /// The services that may subscribe to it, in addition to [`MONITORS`]; a query's key has no subscribers.
    pub subscribers: &'static [&'static str],
}

/// A row of the table, with its type.
#[derive(Debug)]
pub struct Topic<M> {
    row: Row,
    message: PhantomData<fn() -> M>,
}

impl<M> Clone for Topic<M> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<M> Copy for Topic<M> {}

impl<M: Message> Topic<M> {
    const fn new(
        key: &'static str,
        delivery: Delivery,
        publishers: &'static [&'static str],
        subscribers: &'static [&'static str],
    ) -> Self {
        let (message, version) = (M::NAME, M::VERSION);
        let row = Row { key, message, version, delivery, publishers, subscribers };
        Self { row, message: PhantomData }
    }

    /// How its messages are delivered.
    pub fn delivery(&self) -> Delivery {
        self.row.delivery
    }

    /// The key with its placeholders filled in, in order; `*` stands for any. Placeholders beyond `names`
    /// become `*`.
    pub fn key(&self, names: &[&str]) -> String {
        let mut names = names.iter();
        let chunks = self.row.key.split('/').map(|chunk| {
            if chunk.starts_with('{') { names.next().copied().unwrap_or("*") } else { chunk }
        });
        chunks.collect::<Vec<_>>().join("/")
    }

    /// The value of the first placeholder in a key of this topic, with any prefix; `None` for a key of
    /// another topic.
    pub fn first_name<'a>(&self, key: &'a str) -> Option<&'a str> {
        let pattern = self.row.key.rsplit('/');
        let mut chunks = key.rsplit('/');
        let mut first = None;
        for expected in pattern {
            let chunk = chunks.next()?;
            match expected.starts_with('{') {
                true => first = Some(chunk),
                false if expected == chunk => {}
                false => return None,
            }
        }
        first
    }
}

/// The services that show or record the others, and may subscribe to every topic; `observer` is a holder of a key that only
/// allows subscriptions.
pub const MONITORS: &[&str] = &["alight", "dashboard", "observer", "recorder"];

const CAMERAS: &[&str] = &["camera-pub", "simulator"];
const DETECTOR: &[&str] = &["detector"];
const CONTROLLER: &[&str] = &["controller"];
const SIMULATOR: &[&str] = &["simulator"];
const BRIDGE: &[&str] = &["gcs-bridge"];
/// Their supervisor, `alight up`, has their keys.
const SUPERVISED: &[&str] = &["controller", "detector"];
/// Monitors only.
const NO_OTHERS: &[&str] = &[];

/// Pixels as they are; the message is the attachment.
pub const FRAME: Topic<FrameHeader> =
    Topic::new("camera/{camera}/frame", Delivery::Latest, CAMERAS, DETECTOR);
/// JPEG files, of the whole frame or of parts of it; the message is the attachment.
pub const JPEG: Topic<FrameHeader> =
    Topic::new("camera/{camera}/jpeg", Delivery::Latest, CAMERAS, DETECTOR);
/// Grey pixels as the same camera would see them without distortion; made only while there is a subscriber. The message is the
/// attachment.
pub const RECT: Topic<FrameHeader> =
    Topic::new("camera/{camera}/rect", Delivery::Latest, &["camera-pub"], NO_OTHERS);
/// A camera's calibration and mount.
pub const CAMERA_INFO: Topic<CameraInfo> =
    Topic::new("camera/{camera}/info", Delivery::LastValue, CAMERAS, &["controller", "detector"]);
/// The exposure of a camera, and why.
pub const CAMERA_CONTROL: Topic<CameraControl> =
    Topic::new("camera/{camera}/control", Delivery::Latest, CAMERAS, NO_OTHERS);
/// Markers found in a frame.
pub const DETECTIONS: Topic<Detections> = Topic::new(
    "detector/{detector}/detections",
    Delivery::LatestPriority,
    DETECTOR,
    &["camera-pub", "controller", "gcs-bridge", "simulator"],
);
/// Acknowledges a frame of `camera/{camera}/jpeg`.
pub const FRAME_ACK: Topic<FrameAck> =
    Topic::new("detector/{detector}/ack", Delivery::LatestPriority, DETECTOR, CAMERAS);
/// Candidates that were refused in a frame; published only while there is a subscriber.
pub const REFUSALS: Topic<Refusals> =
    Topic::new("detector/{detector}/refusals", Delivery::Latest, DETECTOR, NO_OTHERS);
/// A JPEG overlay, one of `ellipses`, `rings`, `target`; the message is the attachment.
pub const DEBUG_IMAGE: Topic<FrameHeader> =
    Topic::new("detector/{detector}/debug/{image}", Delivery::Latest, DETECTOR, NO_OTHERS);
/// A detector's identity and settings.
pub const DETECTOR_INFO: Topic<DetectorInfo> =
    Topic::new("detector/{detector}/info", Delivery::LastValue, DETECTOR, SUPERVISED);
/// The camera's response to light, as a detector uses it.
pub const CAMERA_RESPONSE: Topic<CameraResponse> =
    Topic::new("detector/{detector}/response", Delivery::LastValue, DETECTOR, NO_OTHERS);
/// A command to a detector; answered with a [`CommandReply`].
pub const DETECTOR_COMMAND: Topic<DetectorCommand> =
    Topic::new("detector/{detector}/command", Delivery::Query, &["alight"], NO_OTHERS);
/// The answer to a detector's command; travels as the reply, on the command's key.
pub const DETECTOR_COMMAND_REPLY: Topic<CommandReply> =
    Topic::new("detector/{detector}/command", Delivery::Query, DETECTOR, NO_OTHERS);
/// Attitude, position, velocity, mode.
pub const VEHICLE_STATE: Topic<VehicleState> =
    Topic::new("vehicle/state", Delivery::LatestPriority, CONTROLLER, NO_OTHERS);
/// The estimate of the landing point.
pub const TARGET: Topic<TargetEstimate> =
    Topic::new("controller/target", Delivery::Latest, CONTROLLER, BRIDGE);
/// The controller's phase and the reason for it.
pub const STATUS: Topic<ControllerStatus> = Topic::new(
    "controller/status",
    Delivery::LastValue,
    CONTROLLER,
    &["camera-pub", "controller", "detector", "gcs-bridge", "simulator"],
);
/// A command to the controller; answered with a [`CommandReply`].
pub const COMMAND: Topic<ControllerCommand> =
    Topic::new("controller/command", Delivery::Query, &["alight", "dashboard"], NO_OTHERS);
/// The answer to a command; travels as the reply, on the command's key.
pub const COMMAND_REPLY: Topic<CommandReply> =
    Topic::new("controller/command", Delivery::Query, CONTROLLER, NO_OTHERS);
/// The events that the controller handled with their output, in order; published only while there is a subscriber.
pub const TAPE: Topic<Tape> =
    Topic::new("controller/tape", Delivery::Record, CONTROLLER, NO_OTHERS);
/// The true wind.
pub const WIND: Topic<Wind> = Topic::new("wind", Delivery::Latest, SIMULATOR, NO_OTHERS);
/// The true state of vehicle and pad.
pub const TRUTH: Topic<Truth> = Topic::new("truth", Delivery::Latest, SIMULATOR, NO_OTHERS);
/// Packets from the autopilot.
pub const FROM_AUTOPILOT: Topic<MavlinkBytes> = Topic::new(
    "mavlink/from-autopilot",
    Delivery::Reliable,
    CONTROLLER,
    &["gcs-bridge", "simulator"],
);
/// Packets for the autopilot.
pub const TO_AUTOPILOT: Topic<MavlinkBytes> = Topic::new(
    "mavlink/to-autopilot",
    Delivery::Reliable,
    &["gcs-bridge", "simulator"],
    CONTROLLER,
);
/// The messages that a recorder has stored and lost.
pub const RECORDER_STATUS: Topic<RecorderStatus> =
    Topic::new("recorder/{recorder}/status", Delivery::LastValue, &["recorder"], BRIDGE);
/// Ground stations whose packets are received, refused packets by reason, and signing.
pub const GCS_STATUS: Topic<GcsStatus> =
    Topic::new("gcs/status", Delivery::LastValue, BRIDGE, NO_OTHERS);
/// Health of a service.
pub const HEALTH: Topic<Health> = Topic::new(
    "health/{service}/{instance}",
    Delivery::LastValue,
    &[
        "camera-pub",
        "controller",
        "dashboard",
        "detector",
        "gcs-bridge",
        "recorder",
        "relay",
        "simulator",
    ],
    BRIDGE,
);
/// The configuration that a service uses.
pub const CONFIGURATION: Topic<Configuration> = Topic::new(
    "config/{service}/{instance}",
    Delivery::LastValue,
    &["camera-pub", "controller", "dashboard", "detector", "gcs-bridge", "recorder", "simulator"],
    BRIDGE,
);

/// Key of the liveliness token a service declares when it is ready.
pub fn alive_key(service: &str, instance: &str) -> String {
    format!("alive/{service}/{instance}")
}

/// Key of the liveliness token that a service declares before it looks for others of its name.
pub fn claim_key(service: &str, instance: &str, session: &str) -> String {
    format!("alive/{service}/{instance}/{session}")
}

/// All topics.
pub const TOPICS: &[Row] = &[
    FRAME.row,
    JPEG.row,
    RECT.row,
    CAMERA_INFO.row,
    CAMERA_CONTROL.row,
    DETECTIONS.row,
    FRAME_ACK.row,
    REFUSALS.row,
    DEBUG_IMAGE.row,
    DETECTOR_INFO.row,
    CAMERA_RESPONSE.row,
    DETECTOR_COMMAND.row,
    DETECTOR_COMMAND_REPLY.row,
    VEHICLE_STATE.row,
    TARGET.row,
    STATUS.row,
    COMMAND.row,
    COMMAND_REPLY.row,
    TAPE.row,
    WIND.row,
    TRUTH.row,
    FROM_AUTOPILOT.row,
    TO_AUTOPILOT.row,
    RECORDER_STATUS.row,
    GCS_STATUS.row,
    HEALTH.row,
    CONFIGURATION.row,
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn placeholders_are_filled_in_order_and_default_to_any() {
        assert_eq!(DEBUG_IMAGE.key(&["main", "rings"]), "detector/main/debug/rings");
        assert_eq!(DEBUG_IMAGE.key(&["main"]), "detector/main/debug/*");
        assert_eq!(WIND.key(&[]), "wind");
    }

    #[test]
    fn the_first_name_is_read_from_a_key() {
        assert_eq!(DETECTIONS.first_name("detector/main/detections"), Some("main"));
        assert_eq!(DETECTIONS.first_name("drone/detector/main/detections"), Some("main"));
        assert_eq!(DEBUG_IMAGE.first_name("detector/main/debug/rings"), Some("main"));
        assert_eq!(DETECTIONS.first_name("detector/main/info"), None);
        assert_eq!(DETECTIONS.first_name("detections"), None);
        assert_eq!(WIND.first_name("wind"), None);
    }

    #[test]
    fn keys_are_unique_but_for_queries_and_their_replies() {
        let mut keys: Vec<_> = TOPICS.iter().map(|row| row.key).collect();
        keys.sort_unstable();
        keys.dedup();
        assert_eq!(keys.len(), TOPICS.len() - 2);
    }
}
