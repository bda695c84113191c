//! Warns of detectors with detections that arrive too late to be used, frame after frame.

use std::collections::{BTreeMap, VecDeque};

use crate::refusals::Warning;
use crate::selection::MAX_DETECTORS;

/// Time for which most frames of a detector must be too late before a warning, in nanoseconds.
const MIN_LASTING_NS: i64 = 2_000_000_000;
/// Time without detections after which that is over, in nanoseconds.
const OVER_NS: i64 = 1_500_000_000;
/// Number of latest frames by which a detector is judged.
const MAX_SAMPLES: usize = 9;
/// Relative change of the latency from which on the warning has a new number, so that its text does not change with every frame.
const MIN_CHANGE: f64 = 0.2;

/// Latency beyond which no search is so slow, in seconds.
const STALE_S: f64 = 10.0;

/// The latencies of detectors, by detector: at most [`MAX_DETECTORS`].
#[derive(Debug)]
pub struct Lateness {
    /// The maximum age of a frame on arrival that is used, in seconds.
    max_latency_s: f64,
    detectors: BTreeMap<String, Latencies>,
}

#[derive(Debug, Default)]
struct Latencies {
    /// Of the latest frames, in seconds.
    recent_s: VecDeque<f64>,
    /// Since when their median is too large.
    since_ns: Option<i64>,
    last_ns: i64,
    /// The median that the warning states, in seconds.
    stated_s: f64,
}

impl Lateness {
    /// Frames that are older than this on arrival, in seconds, are not used.
    pub fn new(max_latency_s: f64) -> Self {
        Self { max_latency_s, detectors: BTreeMap::new() }
    }

    /// Detections of a frame with this stamp were received.
    pub fn searched(&mut self, now_ns: i64, detector: &str, stamp_ns: i64) {
        if self.detectors.len() >= MAX_DETECTORS && !self.detectors.contains_key(detector) {
            self.detectors.retain(|_, it| now_ns.saturating_sub(it.last_ns) < OVER_NS);
            if self.detectors.len() >= MAX_DETECTORS {
                return;
            }
        }
        let latencies = self.detectors.entry(detector.to_owned()).or_default();
        if now_ns.saturating_sub(latencies.last_ns) >= OVER_NS {
            *latencies = Latencies::default();
        }
        latencies.add(now_ns, now_ns.saturating_sub(stamp_ns) as f64 * 1e-9, self.max_latency_s);
    }

    /// The warning that this detector's frames are too late, where that persists.
    pub fn too_late(&self, now_ns: i64, detector: &str) -> Option<String> {
        let latencies = self.detectors.get(detector).filter(|it| it.is_lasting(now_ns))?;
        let max_ms = self.max_latency_s * 1e3;
        let remedy = match latencies.stated_s {
            late_s if late_s > STALE_S => {
                "it may publish one old frame's detections again and again, or give stamps of another clock; search the newest frame only, and copy its header unchanged"
            }
            _ => "search the newest frame only, with fewer pixels or a faster program",
        };
        Some(format!(
            "detections of `{detector}` come {:.0} ms after their frames, and at most {max_ms:.0} ms are used (`target.max_latency_s`); {remedy}",
            latencies.stated_s * 1e3
        ))
    }

    /// The warnings for the operator.
    pub fn warnings(&self, now_ns: i64) -> impl Iterator<Item = Warning> {
        self.detectors.keys().filter_map(move |name| {
            let text = self.too_late(now_ns, name)?;
            Some(Warning { matter: format!("too late {name}"), text })
        })
    }

    /// Forgets a detector that has ended.
    pub fn ended(&mut self, detector: &str) {
        self.detectors.remove(detector);
    }
}

impl Latencies {
    fn add(&mut self, now_ns: i64, latency_s: f64, max_s: f64) {
        while self.recent_s.len() >= MAX_SAMPLES {
            self.recent_s.pop_front();
        }
        self.recent_s.push_back(latency_s);
        self.last_ns = now_ns;
        let mut sorted: Vec<f64> = self.recent_s.iter().copied().collect();
        sorted.sort_by(f64::total_cmp);
        let median_s = sorted.get(sorted.len() / 2).copied().unwrap_or_default();
        if median_s <= max_s {
            self.since_ns = None;
            self.stated_s = 0.0;
            return;
        }
        self.since_ns = self.since_ns.or(Some(now_ns));
        if (median_s - self.stated_s).abs() > MIN_CHANGE * self.stated_s {
            self.stated_s = median_s;
        }
    }

    fn is_lasting(&self, now_ns: i64) -> bool {
        self.since_ns
            .is_some_and(|since_ns| self.last_ns.saturating_sub(since_ns) >= MIN_LASTING_NS)
            && now_ns.saturating_sub(self.last_ns) < OVER_NS
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;
    const PERIOD: i64 = 67 * MS;

    /// The warnings of frames with these latencies in milliseconds, one set a frame.
    fn warned(lateness: &mut Lateness, latency_ms: impl Fn(i64) -> i64) -> Vec<Vec<String>> {
        let frame = |i: i64| {
            let now_ns = 60_000 * MS + i * PERIOD;
            lateness.searched(now_ns, "mine", now_ns - latency_ms(i) * MS);
            lateness.warnings(now_ns).map(|it| it.text).collect()
        };
        (0..90).map(frame).collect()
    }

    #[test]
    fn detections_that_persistently_come_too_late_are_reported_with_the_limit() {
        let mut lateness = Lateness::new(0.5);
        let texts = warned(&mut lateness, |i| 515 + i % 3);
        let first = texts.iter().position(|it| !it.is_empty());
        assert_eq!(first, Some(30), "after two seconds");
        let text = "detections of `mine` come 515 ms after their frames, and at most 500 ms are used (`target.max_latency_s`); search the newest frame only, with fewer pixels or a faster program";
        for texts in &texts[30..] {
            assert_eq!(texts, &[text], "the number stays");
        }
        let end_ns = 60_000 * MS + 89 * PERIOD;
        assert_eq!(lateness.warnings(end_ns + 1600 * MS).count(), 0, "they have ended");
        lateness.ended("mine");
        assert_eq!(lateness.warnings(end_ns).count(), 0);
    }

    #[test]
    fn an_old_frame_or_another_clock_is_named_where_no_search_is_so_slow() {
        let texts = warned(&mut Lateness::new(0.5), |i| 40_000 + 67 * i);
        let last = texts.last().and_then(|it| it.first()).cloned().unwrap_or_default();
        assert!(
            last.contains("one old frame's detections") && last.contains("another clock"),
            "{last}"
        );
    }

    #[test]
    fn single_late_frames_and_such_as_are_used_are_not_reported() {
        for latency_ms in [
            (|_| 490) as fn(i64) -> i64,
            |i| if i % 3 == 0 { 900 } else { 60 },
            |i| if i / 20 % 2 == 0 { 900 } else { 60 },
        ] {
            let texts = warned(&mut Lateness::new(0.5), latency_ms);
            assert!(texts.iter().all(Vec::is_empty), "{texts:?}");
        }
    }

    #[test]
    fn the_memory_is_bounded() {
        let mut lateness = Lateness::new(0.5);
        for i in 0..1000 {
            lateness.searched(i * MS, &format!("{i}"), 0);
        }
        assert!(lateness.detectors.len() <= MAX_DETECTORS);
    }
}
