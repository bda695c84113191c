//! The detectors with unreadable detections, as the network counts them: a warning in the status, next to the warnings of the flight.

use std::collections::BTreeMap;

use messages::{ControllerStatus, topic};
use node::HealthCounters;
use node::health::Unreadable;

use crate::camera_watch;
use crate::refusals::Refusals;
use crate::selection::MAX_DETECTORS;

/// Detections that could not be read, by detector.
#[derive(Debug, Default)]
pub struct UnreadableDetections {
    /// How many there were the last time.
    counted: BTreeMap<String, u64>,
    /// How many of all keys.
    known: u64,
    /// The camera that each detector states; at most [`MAX_DETECTORS`].
    cameras: BTreeMap<String, String>,
    refusals: Refusals,
}

impl UnreadableDetections {
    /// Takes the unreadable payloads since the last call.
    pub fn step(&mut self, now_ns: i64, health: &HealthCounters) {
        let Some(unreadable) = health.more_unreadable(&mut self.known) else { return };
        for Unreadable { key, count, why, .. } in unreadable {
            let Some(detector) = topic::DETECTIONS.first_name(&key) else { continue };
            let is_known = self.counted.contains_key(detector);
            if !is_known && self.counted.len() >= MAX_DETECTORS {
                continue;
            }
            let before = self.counted.insert(detector.to_owned(), count).unwrap_or(0);
            if count > before {
                self.refusals.add_of(now_ns, "unreadable", detector, || {
                    format!("detections of `{detector}` cannot be read: {why}; its frames are not missing (docs/wire-format.md has every byte)")
                });
            }
        }
    }

    /// A detector stated its camera.
    pub fn announced(&mut self, detector: &str, camera: &str) {
        if self.cameras.len() < MAX_DETECTORS || self.cameras.contains_key(detector) {
            self.cameras.insert(detector.to_owned(), camera.to_owned());
        }
    }

    /// Adds the warnings that persist to a status, in the place of the warnings that the cameras of these detectors send no frames.
    pub fn report(&self, now_ns: i64, status: &mut ControllerStatus) {
        let mut texts = Vec::new();
        for warning in self.refusals.lasting(now_ns) {
            let detector = warning.matter.rsplit(' ').next().unwrap_or_default();
            if let Some(camera) = self.cameras.get(detector) {
                let is_consequence = |text: &mut String| camera_watch::is_of(text, camera);
                for missing in status.warnings.extract_if(.., is_consequence) {
                    status.why = status.why.replace(&missing, &warning.text);
                }
            }
            texts.push(warning.text);
        }
        status.warnings.splice(0..0, texts);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera_watch::CameraWatch;

    #[test]
    fn unreadable_detections_are_reported_in_place_of_a_camera_without_frames() {
        let (health, mut watch) = (HealthCounters::default(), CameraWatch::default());
        let mut unreadable = UnreadableDetections::default();
        unreadable.announced("mine", "down");
        for ms in (0..20_000).step_by(50) {
            health.unreadable_payload(ms, "detector/mine/detections", "it is cut".into());
            unreadable.step(ms * 1_000_000, &health);
            for (detector, camera) in [("mine", "down"), ("other", "front")] {
                watch.announced(ms * 1_000_000, detector, camera);
            }
        }
        let now_ns = 19_950 * 1_000_000;
        let missing = watch.no_frame(now_ns).unwrap();
        let mut status = ControllerStatus {
            warnings: watch.warnings(now_ns).map(|it| it.text).collect(),
            why: format!("looking for the marker: {}", missing.replace("front", "down")),
            ..ControllerStatus::default()
        };
        assert_eq!(status.warnings.len(), 2);
        unreadable.report(now_ns, &mut status);
        let [first, second] = &status.warnings[..] else { panic!("{status:?}") };
        assert!(first.contains("`mine` cannot be read") && second.contains("camera `front`"));
        assert_eq!(status.why, format!("looking for the marker: {first}"));
    }

    #[test]
    fn a_detector_with_unreadable_detections_is_named_while_that_persists() {
        let health = HealthCounters::default();
        let mut unreadable = UnreadableDetections::default();
        let warnings = |unreadable: &UnreadableDetections, ms: i64| {
            let mut status = ControllerStatus {
                warnings: vec!["another".into()],
                ..ControllerStatus::default()
            };
            unreadable.report(ms * 1_000_000, &mut status);
            status.warnings
        };
        for ms in (0..5000).step_by(25) {
            if ms < 2000 {
                for key in ["detector/mine/detections", "drone/wind", "camera/down/info"] {
                    health.unreadable_payload(ms, key, "a Detections of 9 bytes is cut".into());
                }
            }
            unreadable.step(ms * 1_000_000, &health);
            let warnings = warnings(&unreadable, ms);
            match ms {
                1000..2000 => {
                    let [first, last] = &warnings[..] else { panic!("{warnings:?}") };
                    assert!(first.contains("`mine` cannot be read: a Detections of 9 bytes"));
                    assert_eq!(last, "another");
                }
                4000.. => assert_eq!(warnings, ["another"]),
                _ => {}
            }
        }
    }
}
