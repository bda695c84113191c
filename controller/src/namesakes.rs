//! Warns of two programs that publish under the name of one detector, by the process in their information.

use std::collections::BTreeMap;

use messages::DetectorInfo;

use crate::refusals::{Refusals, Warning};
use crate::selection::MAX_DETECTORS;

/// Time after which a process that has published nothing has been replaced, in nanoseconds: each one publishes its information every
/// second.
const REPLACED_NS: i64 = 3_500_000_000;

/// The processes that publish as each detector.
#[derive(Debug, Default)]
pub struct Namesakes {
    /// At most [`MAX_DETECTORS`], by name.
    detectors: BTreeMap<String, Processes>,
    several: Refusals,
}

#[derive(Debug)]
struct Processes {
    newest: Process,
    /// The one before, and when it last published.
    before: Option<(Process, i64)>,
    received_ns: i64,
}

/// A process on a host.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Process {
    host: String,
    pid: u32,
    version: String,
}

impl Process {
    fn of(info: &DetectorInfo) -> Self {
        Self { host: info.host.clone(), pid: info.pid, version: info.version.clone() }
    }

    fn name(&self) -> String {
        let Self { host, pid, version } = self;
        format!("process {pid} on `{host}` ({version})")
    }
}

impl Namesakes {
    /// A detector published its information. A restarted one has another process; only where the former one returns are there two.
    pub fn announced(&mut self, now_ns: i64, detector: &str, info: &DetectorInfo) {
        let process = Process::of(info);
        if self.detectors.len() >= MAX_DETECTORS && !self.detectors.contains_key(detector) {
            self.detectors.retain(|_, it| now_ns.saturating_sub(it.received_ns) < REPLACED_NS);
            if self.detectors.len() >= MAX_DETECTORS {
                return;
            }
        }
        let Some(known) = self.detectors.get_mut(detector) else {
            let first = Processes { newest: process, before: None, received_ns: now_ns };
            self.detectors.insert(detector.to_owned(), first);
            return;
        };
        let received_ns = std::mem::replace(&mut known.received_ns, now_ns);
        if known.newest == process {
            return;
        }
        let left = std::mem::replace(&mut known.newest, process);
        let before = known.before.replace((left, received_ns));
        let returns = before.is_some_and(|(before, last_ns)| {
            before == known.newest && now_ns.saturating_sub(last_ns) < REPLACED_NS
        });
        if let (true, Some((other, _))) = (returns, &known.before) {
            // In one order, whichever was the last.
            let mut both = [known.newest.name(), other.name()];
            both.sort();
            let [one, other] = both;
            self.several.add_of(now_ns, "two-programs", detector, || {
                format!(
                    "two programs publish as detector `{detector}`: {one} and {other}; stop one of them, or give it another id"
                )
            });
        }
    }

    /// The warnings for the operator.
    pub fn warnings(&self, now_ns: i64) -> impl Iterator<Item = Warning> {
        self.several.lasting(now_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use messages::Place;

    const MS: i64 = 1_000_000;

    fn info(pid: u32) -> DetectorInfo {
        DetectorInfo {
            detector: "mine".into(),
            host: "laptop".into(),
            place: Place::Onboard,
            camera: "down".into(),
            markers: Vec::new(),
            version: "mine 1".into(),
            pid,
        }
    }

    /// The warnings after these processes have published, each at its time in milliseconds.
    fn warnings(published: impl Iterator<Item = (i64, u32)>) -> Vec<String> {
        let mut namesakes = Namesakes::default();
        let mut end_ns = 0;
        for (at_ms, pid) in published {
            end_ns = at_ms * MS;
            namesakes.announced(end_ns, "mine", &info(pid));
        }
        namesakes.warnings(end_ns).map(|it| it.text).collect()
    }

    #[test]
    fn two_programs_of_one_name_are_reported() {
        for apart_ms in [10, 500, 990] {
            let both = (0..5).flat_map(|s| [(s * 1000, 11), (s * 1000 + apart_ms, 22)]);
            let text = "two programs publish as detector `mine`: process 11 on `laptop` (mine 1) and process 22 on `laptop` (mine 1); stop one of them, or give it another id";
            assert_eq!(warnings(both), [text]);
        }
    }

    #[test]
    fn one_that_is_restarted_is_not() {
        assert!(warnings((0..40).map(|s| (s * 1000, 11 + s as u32 / 4))).is_empty());
        // A replaced one that publishes once more as it ends.
        let once = [(0, 11), (1000, 11), (1100, 22), (1200, 11), (2100, 22), (3100, 22)];
        assert!(warnings(once.into_iter()).is_empty());
        assert!(warnings((0..40).map(|s| (s * 1000, 11))).is_empty());
    }

    #[test]
    fn the_memory_is_bounded() {
        let mut namesakes = Namesakes::default();
        for i in 0..1000 {
            namesakes.announced(i * MS, &format!("{i}"), &info(1));
        }
        assert!(namesakes.detectors.len() <= MAX_DETECTORS);
    }
}
