//! Warns of cameras without frames, by the time at which their detectors last searched one.

use std::collections::BTreeMap;

use autopilot::without_standstill;

use crate::refusals::Warning;
use crate::selection::MAX_DETECTORS;

/// Time without a searched frame, while detectors are present, after which a warning is given, in nanoseconds.
const NO_FRAME_NS: i64 = 2_000_000_000;
/// The same before the first frame: a camera takes seconds to start.
const NO_FIRST_FRAME_NS: i64 = 10_000_000_000;
/// Silence of a detector, which publishes its information each second, after which it is not present, in nanoseconds.
const ABSENT_NS: i64 = 3_500_000_000;
/// Maximum number of cameras without frames that are reported at once.
const MAX_REPORTED: usize = 4;

/// The detectors that are present, and when each has last searched a frame.
#[derive(Debug, Default)]
pub struct CameraWatch {
    /// At most [`MAX_DETECTORS`], by name.
    detectors: BTreeMap<String, LastFrame>,
}

#[derive(Debug)]
struct LastFrame {
    /// The camera of the newest frame; before the first, the camera that the detector states.
    camera: String,
    /// Of the newest frame; before the first, when a message of the detector was first received.
    at_ns: i64,
    has_frame: bool,
    /// When its last message was received.
    received_ns: i64,
}

impl LastFrame {
    fn is_there(&self, now_ns: i64) -> bool {
        now_ns.saturating_sub(self.received_ns) <= ABSENT_NS
    }

    /// The time without a frame, where it is long enough for a warning.
    fn silence_ns(&self, now_ns: i64) -> Option<i64> {
        let silence_ns = now_ns.saturating_sub(self.at_ns);
        let limit_ns = if self.has_frame { NO_FRAME_NS } else { NO_FIRST_FRAME_NS };
        (silence_ns > limit_ns).then_some(silence_ns)
    }
}

impl CameraWatch {
    /// A detector stated its camera: it is present.
    pub fn announced(&mut self, now_ns: i64, detector: &str, camera: &str) {
        let last = self.of(now_ns, detector, camera);
        last.received_ns = now_ns;
        if !last.has_frame {
            camera.clone_into(&mut last.camera);
        }
    }

    /// A detector has searched a frame of a camera.
    pub fn searched(&mut self, now_ns: i64, detector: &str, camera: &str) {
        let last = self.of(now_ns, detector, camera);
        (last.at_ns, last.received_ns, last.has_frame) = (now_ns, now_ns, true);
        camera.clone_into(&mut last.camera);
    }

    /// This process has not run for so long: frames of that time were not missing.
    pub fn stood_still(&mut self, now_ns: i64, stood_ns: i64) {
        for last in self.detectors.values_mut() {
            for at_ns in [&mut last.at_ns, &mut last.received_ns] {
                *at_ns = without_standstill(*at_ns, now_ns, stood_ns);
            }
        }
    }

    /// A detector has ended: without it nothing shows whether the camera has frames.
    pub fn ended(&mut self, detector: &str) {
        self.detectors.remove(detector);
    }

    /// The text that detectors are present and none receives frames, with the time; `None` where one does, or where none is present.
    pub fn no_frame(&self, now_ns: i64) -> Option<String> {
        let there = || self.detectors.values().filter(|it| it.is_there(now_ns));
        let newest = there().max_by_key(|it| it.at_ns)?;
        there()
            .all(|it| it.silence_ns(now_ns).is_some())
            .then(|| text(&newest.camera, now_ns.saturating_sub(newest.at_ns)))
    }

    /// The cameras of which no present detector receives frames.
    pub fn warnings(&self, now_ns: i64) -> impl Iterator<Item = Warning> {
        let mut silences = BTreeMap::<&str, Option<i64>>::new();
        for last in self.detectors.values().filter(|it| it.is_there(now_ns)) {
            let silence_ns = last.silence_ns(now_ns);
            let shortest = silences.entry(&last.camera).or_insert(silence_ns);
            *shortest = silence_ns.min(*shortest);
        }
        let silent =
            silences.into_iter().filter_map(|(camera, silence_ns)| Some((camera, silence_ns?)));
        silent.take(MAX_REPORTED).map(|(camera, silence_ns)| Warning {
            matter: format!("no frame of {camera}"),
            text: text(camera, silence_ns),
        })
    }

    /// A detector, known from now on; where there are too many, in the place of the one with the oldest message.
    fn of(&mut self, now_ns: i64, detector: &str, camera: &str) -> &mut LastFrame {
        if self.detectors.len() >= MAX_DETECTORS && !self.detectors.contains_key(detector) {
            let oldest = self.detectors.iter().min_by_key(|(_, it)| it.received_ns);
            if let Some(name) = oldest.map(|(name, _)| name.clone()) {
                self.detectors.remove(&name);
            }
        }
        self.detectors.entry(detector.to_owned()).or_insert_with(|| LastFrame {
            camera: camera.to_owned(),
            at_ns: now_ns,
            has_frame: false,
            received_ns: now_ns,
        })
    }
}

/// Whether a text is the warning that this camera sends no frames.
pub fn is_of(text: &str, camera: &str) -> bool {
    text.starts_with(&format!("no frame from camera `{camera}` "))
}

fn text(camera: &str, silence_ns: i64) -> String {
    let silence_s = silence_ns / 1_000_000_000;
    format!(
        "no frame from camera `{camera}` for {silence_s} s: check the camera, and whether its detector hangs or sends unreadable messages"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: i64 = 1_000_000_000;

    fn warnings(watch: &CameraWatch, now_ns: i64) -> Vec<String> {
        watch.warnings(now_ns).map(|it| it.text).collect()
    }

    #[test]
    fn a_camera_is_silent_when_all_its_detectors_are() {
        let mut watch = CameraWatch::default();
        watch.searched(0, "main", "down");
        watch.searched(0, "other", "down");
        watch.searched(3 * S, "other", "down");
        watch.announced(3 * S, "main", "down");
        assert!(warnings(&watch, 3 * S).is_empty());
        watch.announced(6 * S, "main", "down");
        watch.announced(6 * S, "other", "down");
        let silent = "no frame from camera `down` for 3 s: check the camera, and whether its detector hangs or sends unreadable messages";
        assert_eq!(warnings(&watch, 6 * S), [silent]);
        assert_eq!(watch.no_frame(6 * S).as_deref(), Some(silent));
    }

    #[test]
    fn a_detector_that_ends_leaves_no_warning_and_has_its_time_again() {
        let mut watch = CameraWatch::default();
        watch.searched(0, "main", "down");
        watch.searched(0, "other", "wide");
        watch.ended("other");
        watch.searched(3 * S, "main", "down");
        assert!(warnings(&watch, 3 * S).is_empty());
        watch.announced(3 * S, "other", "wide");
        watch.searched(12 * S, "main", "down");
        watch.announced(12 * S, "other", "wide");
        assert!(warnings(&watch, 12 * S).is_empty());
        watch.searched(14 * S, "main", "down");
        watch.announced(14 * S, "other", "wide");
        assert_eq!(warnings(&watch, 14 * S).len(), 1);
        assert_eq!(watch.no_frame(14 * S), None, "the other camera has frames");
    }

    #[test]
    fn frames_are_not_missing_while_this_process_does_not_run() {
        let mut watch = CameraWatch::default();
        watch.searched(0, "main", "down");
        watch.stood_still(20 * S, 20 * S);
        watch.announced(20 * S, "main", "down");
        assert!(warnings(&watch, 20 * S).is_empty() && watch.no_frame(20 * S).is_none());
        watch.announced(23 * S, "main", "down");
        assert_eq!(warnings(&watch, 23 * S).len(), 1);
    }

    #[test]
    fn a_gap_in_a_detectors_messages_begins_no_new_time() {
        let mut watch = CameraWatch::default();
        watch.searched(0, "main", "down");
        for s in [1, 6, 11] {
            watch.announced(s * S, "main", "down");
            assert_eq!(warnings(&watch, s * S).len(), usize::from(s > 2), "{s} s");
            assert!(warnings(&watch, (s + 4) * S).is_empty(), "it is not there");
        }
    }

    #[test]
    fn frames_may_give_the_camera_another_name_than_the_detector_does() {
        let mut watch = CameraWatch::default();
        for s in 0..30 {
            watch.announced(s * S, "main", "down");
            watch.searched(s * S, "main", "front");
            assert!(warnings(&watch, s * S).is_empty(), "{s} s");
        }
    }

    #[test]
    fn invented_names_are_bounded() {
        let mut watch = CameraWatch::default();
        for number in 0..1000 {
            watch.announced(number, &format!("{number}"), &format!("{number}"));
        }
        assert_eq!(watch.detectors.len(), MAX_DETECTORS);
        let later_ns = 1000 + NO_FIRST_FRAME_NS;
        for number in 950..1000 {
            watch.announced(later_ns, &format!("{number}"), &format!("{number}"));
        }
        assert_eq!(watch.warnings(later_ns).count(), MAX_REPORTED);
    }
}
