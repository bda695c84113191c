//! Tells of cameras that give no frames, by when their detectors have last searched one.

use std::collections::BTreeMap;

use crate::refusals::Warning;
use crate::selection::MAX_DETECTORS;

/// Time without a searched frame, while detectors are there, after which it is told, in nanoseconds.
const NO_FRAME_NS: i64 = 2_000_000_000;
/// The same before the first frame: a camera takes seconds to start.
const NO_FIRST_FRAME_NS: i64 = 10_000_000_000;
/// Silence of a detector, which tells about itself each second, after which it is not there, in nanoseconds.
const UNHEARD_NS: i64 = 3_500_000_000;
/// Maximum number of cameras without frames that are told at once.
const MAX_TOLD: usize = 4;

/// The detectors that are there, and when each has last searched a frame.
#[derive(Debug, Default)]
pub struct CameraWatch {
    /// At most [`MAX_DETECTORS`], by name.
    detectors: BTreeMap<String, LastFrame>,
}

#[derive(Debug)]
struct LastFrame {
    /// The camera of the newest frame; before the first, that of which the detector tells.
    camera: String,
    /// Of the newest frame; before the first, when the detector was first heard.
    at_ns: i64,
    has_frame: bool,
    heard_ns: i64,
}

impl LastFrame {
    fn is_there(&self, now_ns: i64) -> bool {
        now_ns.saturating_sub(self.heard_ns) <= UNHEARD_NS
    }

    /// The time without a frame, where it is so long that it is told.
    fn silence_ns(&self, now_ns: i64) -> Option<i64> {
        let silence_ns = now_ns.saturating_sub(self.at_ns);
        let limit_ns = if self.has_frame { NO_FRAME_NS } else { NO_FIRST_FRAME_NS };
        (silence_ns > limit_ns).then_some(silence_ns)
    }
}

impl CameraWatch {
    /// A detector told which camera's frames it searches: it is there.
    pub fn heard(&mut self, now_ns: i64, detector: &str, camera: &str) {
        let last = self.of(now_ns, detector, camera);
        last.heard_ns = now_ns;
        if !last.has_frame {
            camera.clone_into(&mut last.camera);
        }
    }

    /// A detector has searched a frame of a camera.
    pub fn searched(&mut self, now_ns: i64, detector: &str, camera: &str) {
        let last = self.of(now_ns, detector, camera);
        (last.at_ns, last.heard_ns, last.has_frame) = (now_ns, now_ns, true);
        camera.clone_into(&mut last.camera);
    }

    /// A detector has ended: without it nothing tells whether the camera has frames.
    pub fn ended(&mut self, detector: &str) {
        self.detectors.remove(detector);
    }

    /// That detectors are there and none gets frames, with the time; `None` where one does, or where there is none.
    pub fn no_frame(&self, now_ns: i64) -> Option<String> {
        let there = || self.detectors.values().filter(|it| it.is_there(now_ns));
        let newest = there().max_by_key(|it| it.at_ns)?;
        there()
            .all(|it| it.silence_ns(now_ns).is_some())
            .then(|| text(&newest.camera, now_ns.saturating_sub(newest.at_ns)))
    }

    /// The cameras of which no detector that is there gets frames.
    pub fn warnings(&self, now_ns: i64) -> impl Iterator<Item = Warning> {
        let mut silences = BTreeMap::<&str, Option<i64>>::new();
        for last in self.detectors.values().filter(|it| it.is_there(now_ns)) {
            let silence_ns = last.silence_ns(now_ns);
            let shortest = silences.entry(&last.camera).or_insert(silence_ns);
            *shortest = silence_ns.min(*shortest);
        }
        let silent =
            silences.into_iter().filter_map(|(camera, silence_ns)| Some((camera, silence_ns?)));
        silent.take(MAX_TOLD).map(|(camera, silence_ns)| Warning {
            matter: format!("no frame of {camera}"),
            text: text(camera, silence_ns),
        })
    }

    /// A detector, known from now on; where there are too many, in the place of the one that was heard the longest ago.
    fn of(&mut self, now_ns: i64, detector: &str, camera: &str) -> &mut LastFrame {
        if self.detectors.len() >= MAX_DETECTORS && !self.detectors.contains_key(detector) {
            let oldest = self.detectors.iter().min_by_key(|(_, it)| it.heard_ns);
            if let Some(name) = oldest.map(|(name, _)| name.clone()) {
                self.detectors.remove(&name);
            }
        }
        self.detectors.entry(detector.to_owned()).or_insert_with(|| LastFrame {
            camera: camera.to_owned(),
            at_ns: now_ns,
            has_frame: false,
            heard_ns: now_ns,
        })
    }
}

fn text(camera: &str, silence_ns: i64) -> String {
    let silence_s = silence_ns / 1_000_000_000;
    format!(
        "no frame from camera `{camera}` for {silence_s} s: check the camera, and whether its detector hangs or sends what cannot be read"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: i64 = 1_000_000_000;

    fn told(watch: &CameraWatch, now_ns: i64) -> Vec<String> {
        watch.warnings(now_ns).map(|it| it.text).collect()
    }

    #[test]
    fn a_camera_is_silent_when_all_its_detectors_are() {
        let mut watch = CameraWatch::default();
        watch.searched(0, "main", "down");
        watch.searched(0, "other", "down");
        watch.searched(3 * S, "other", "down");
        watch.heard(3 * S, "main", "down");
        assert!(told(&watch, 3 * S).is_empty());
        watch.heard(6 * S, "main", "down");
        watch.heard(6 * S, "other", "down");
        let silent = "no frame from camera `down` for 3 s: check the camera, and whether its detector hangs or sends what cannot be read";
        assert_eq!(told(&watch, 6 * S), [silent]);
        assert_eq!(watch.no_frame(6 * S).as_deref(), Some(silent));
    }

    #[test]
    fn a_detector_that_ends_leaves_nothing_to_tell_and_has_its_time_again() {
        let mut watch = CameraWatch::default();
        watch.searched(0, "main", "down");
        watch.searched(0, "other", "wide");
        watch.ended("other");
        watch.searched(3 * S, "main", "down");
        assert!(told(&watch, 3 * S).is_empty());
        watch.heard(3 * S, "other", "wide");
        watch.searched(12 * S, "main", "down");
        watch.heard(12 * S, "other", "wide");
        assert!(told(&watch, 12 * S).is_empty());
        watch.searched(14 * S, "main", "down");
        watch.heard(14 * S, "other", "wide");
        assert_eq!(told(&watch, 14 * S).len(), 1);
        assert_eq!(watch.no_frame(14 * S), None, "the other camera has frames");
    }

    #[test]
    fn a_gap_in_what_a_detector_tells_begins_no_new_time() {
        let mut watch = CameraWatch::default();
        watch.searched(0, "main", "down");
        for s in [1, 6, 11] {
            watch.heard(s * S, "main", "down");
            assert_eq!(told(&watch, s * S).len(), usize::from(s > 2), "{s} s");
            assert!(told(&watch, (s + 4) * S).is_empty(), "it is not there");
        }
    }

    #[test]
    fn frames_may_give_the_camera_another_name_than_the_detector_does() {
        let mut watch = CameraWatch::default();
        for s in 0..30 {
            watch.heard(s * S, "main", "down");
            watch.searched(s * S, "main", "front");
            assert!(told(&watch, s * S).is_empty(), "{s} s");
        }
    }

    #[test]
    fn invented_names_are_bounded() {
        let mut watch = CameraWatch::default();
        for number in 0..1000 {
            watch.heard(number, &format!("{number}"), &format!("{number}"));
        }
        assert_eq!(watch.detectors.len(), MAX_DETECTORS);
        let later_ns = 1000 + NO_FIRST_FRAME_NS;
        for number in 950..1000 {
            watch.heard(later_ns, &format!("{number}"), &format!("{number}"));
        }
        assert_eq!(watch.warnings(later_ns).count(), MAX_TOLD);
    }
}
