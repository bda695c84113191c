//! The detectors with unreadable detections, as the network counts them: a warning in the status, next to the warnings of the flight.

use std::collections::BTreeMap;

use messages::{ControllerStatus, topic};
use node::HealthCounters;
use node::health::Unreadable;

use crate::refusals::Refusals;
use crate::selection::MAX_DETECTORS;

/// Detections that could not be read, by detector.
#[derive(Debug, Default)]
pub struct UnreadableDetections {
    /// How many there were the last time.
    counted: BTreeMap<String, u64>,
    /// How many of all keys.
    known: u64,
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

    /// Adds the warnings that persist to a status, before the warnings of their consequences.
    pub fn report(&self, now_ns: i64, status: &mut ControllerStatus) {
        let texts = self.refusals.lasting(now_ns).map(|warning| warning.text);
        status.warnings.splice(0..0, texts);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
