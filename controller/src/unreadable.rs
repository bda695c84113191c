//! The detectors whose detections cannot be read, as the network counts them: told in the status, beside what the flight warns of.

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
    /// Takes what could not be read since the last call.
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

    /// Adds to a status what of it lasts, before what may follow from it.
    pub fn tell(&self, now_ns: i64, status: &mut ControllerStatus) {
        let told = self.refusals.lasting(now_ns).map(|warning| warning.text);
        status.warnings.splice(0..0, told);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_detector_whose_detections_cannot_be_read_is_told_by_name_while_that_lasts() {
        let health = HealthCounters::default();
        let mut unreadable = UnreadableDetections::default();
        let told = |unreadable: &UnreadableDetections, ms: i64| {
            let mut status = ControllerStatus {
                warnings: vec!["another".into()],
                ..ControllerStatus::default()
            };
            unreadable.tell(ms * 1_000_000, &mut status);
            status.warnings
        };
        for ms in (0..5000).step_by(25) {
            if ms < 2000 {
                for key in ["detector/mine/detections", "drone/wind", "camera/down/info"] {
                    health.unreadable_payload(ms, key, "a Detections of 9 bytes is cut".into());
                }
            }
            unreadable.step(ms * 1_000_000, &health);
            let told = told(&unreadable, ms);
            match ms {
                1000..2000 => {
                    let [first, last] = &told[..] else { panic!("{told:?}") };
                    assert!(first.contains("`mine` cannot be read: a Detections of 9 bytes"));
                    assert_eq!(last, "another");
                }
                4000.. => assert_eq!(told, ["another"]),
                _ => {}
            }
        }
    }
}
