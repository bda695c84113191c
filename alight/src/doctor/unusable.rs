//! Collects and reports camera messages that no detector uses: frames and information of another camera than their key names, and frames
//! that cannot be read.

use std::collections::BTreeMap;

use messages::{FrameHeader, Topic, topic};
use node::frames::WRONG_LENGTH;
use node::{Frame, HealthCounters};

use super::Findings;

/// Maximum number of messages that are noted apart, as a sender chooses their names freely.
const MAX_NOTED: usize = 32;

/// The kind of the frames.
pub(super) const FRAMES: &str = "frames";
/// The kind of the cameras' information.
pub(super) const INFOS: &str = "camera infos";

/// The camera messages that are not used.
#[derive(Default)]
pub(super) struct Unusable {
    /// The number of messages by their kind, the camera of their key, and the one that they name.
    misnamed: BTreeMap<(&'static str, String, String), u64>,
    /// The number of frames that cannot be read and the reason, by key.
    unreadable: Vec<(String, u64, String)>,
    /// The number of frames whose length is not that of their header, and the newest of them.
    wrong_length: u64,
    newest_wrong_length: String,
}

impl Unusable {
    /// Whether a message of a kind names the camera of its key. Otherwise it is noted.
    pub(super) fn names_its_key(&mut self, kind: &'static str, key: &str, camera: &str) -> bool {
        if key == camera {
            return true;
        }
        let noted = (kind, key.to_owned(), camera.to_owned());
        if self.misnamed.len() < MAX_NOTED || self.misnamed.contains_key(&noted) {
            *self.misnamed.entry(noted).or_default() += 1;
        }
        false
    }

    /// Whether a frame of a topic names the camera of its key.
    pub(super) fn accepts(&mut self, topic: Topic<FrameHeader>, frame: &Frame) -> bool {
        let key = topic.first_name(frame.key()).unwrap_or_default();
        self.names_its_key(FRAMES, key, &frame.header.camera)
    }

    /// Takes the frames that this process could not read.
    pub(super) fn take_unreadable(&mut self, health: &HealthCounters) {
        let is_frame = |key: &str| {
            topic::FRAME.first_name(key).is_some() || topic::JPEG.first_name(key).is_some()
        };
        let all = health.more_unreadable(&mut 0).unwrap_or_default().into_iter();
        self.unreadable =
            all.filter(|it| is_frame(&it.key)).map(|it| (it.key, it.count, it.why)).collect();
        self.wrong_length = health.failures(WRONG_LENGTH);
        self.newest_wrong_length = health.newest(WRONG_LENGTH).unwrap_or_default();
    }

    /// Whether frames arrived of which none can be used. The absence of other frames has this cause then.
    pub(super) fn has_frames(&self) -> bool {
        let mut kinds = self.misnamed.keys().map(|(kind, ..)| *kind);
        kinds.any(|kind| kind == FRAMES) || !self.unreadable.is_empty() || self.wrong_length > 0
    }

    /// Whether the information of a camera arrived that names another one.
    pub(super) fn has_info(&self, camera: &str) -> bool {
        self.misnamed.keys().any(|(kind, key, _)| *kind == INFOS && key == camera)
    }

    /// Reports them.
    pub(super) fn report(&self, findings: &mut Findings) {
        for ((kind, key, camera), count) in &self.misnamed {
            findings.wrong(
                "camera",
                format!("{kind} are refused ({count} so far): `{key}` gives them the name of `{camera}`"),
                "the camera that publishes them must give the name in its key as `camera` (docs/wire-format.md)",
            );
        }
        for (key, count, why) in &self.unreadable {
            findings.wrong(
                "camera",
                format!("{count} frames on {key} cannot be read: {why}"),
                "each frame needs a FrameHeader as its attachment (docs/wire-format.md); with a camera-pub, run the same version everywhere",
            );
        }
        if self.wrong_length > 0 {
            findings.wrong(
                "camera",
                format!(
                    "{} frames have a length other than that of their header, the newest: {}",
                    self.wrong_length, self.newest_wrong_length
                ),
                "the payload must be width x height pixels of the `format` in the FrameHeader, without padding (docs/wire-format.md)",
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_of_another_camera_than_their_key_are_reported() {
        let mut unusable = Unusable::default();
        assert!(unusable.names_its_key(FRAMES, "down", "down") && !unusable.has_frames());
        assert!(!unusable.names_its_key(INFOS, "down", "front") && !unusable.has_frames());
        assert!(!unusable.names_its_key(FRAMES, "down", "front") && unusable.has_frames());
        assert!(!unusable.names_its_key(FRAMES, "down", "front"));
        let mut findings = Findings::default();
        unusable.report(&mut findings);
        let text = findings.text();
        let named = "frames are refused (2 so far): `down` gives them the name of `front`";
        assert!(
            text.contains(named) && text.contains("camera infos are refused (1 so far)"),
            "{text}"
        );
        assert!(text.ends_with("2 wrong, 0 doubtful."), "{text}");
    }

    #[test]
    fn frames_that_cannot_be_read_are_reported_with_their_key_and_the_reason() {
        let health = HealthCounters::default();
        health.failed_by(WRONG_LENGTH, "2280000 bytes, expected 760000".to_owned());
        for key in ["camera/down/frame", "camera/down/frame", "detector/main/detections"] {
            health.unreadable_payload(0, key, "it has another version".to_owned());
        }
        let mut unusable = Unusable::default();
        unusable.take_unreadable(&health);
        assert!(unusable.has_frames());
        let mut findings = Findings::default();
        unusable.report(&mut findings);
        let text = findings.text();
        let named = "2 frames on camera/down/frame cannot be read: it has another version";
        assert!(text.contains(named) && text.contains("1 frames have a length"), "{text}");
        assert!(text.contains("the newest: 2280000 bytes, expected 760000"), "{text}");
        assert!(!text.contains("detections"), "{text}");
    }
}
