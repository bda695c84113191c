//! The markers that detectors look for, and see instead of the landing's marker: explains in words why none of them leads to it.

use std::collections::BTreeMap;

use messages::{Detection, Detections, looks_for_others};

use crate::refusals::Warning;
use crate::selection::{MAX_DETECTORS, Selection};

/// Time for which a detector must see other markers, and not the landing's, before a warning, in nanoseconds.
const MIN_LASTING_NS: i64 = 2_000_000_000;
/// Time without another marker after which that is over, in nanoseconds.
const OVER_NS: i64 = 1_500_000_000;
/// Maximum number of markers that are named.
const MAX_NAMED: usize = 3;

/// The markers of detectors, by detector: at most [`MAX_DETECTORS`] each.
#[derive(Debug, Default)]
pub struct Announced {
    /// The markers that each one looks for, as published.
    sought: BTreeMap<String, Vec<String>>,
    /// The markers that each one sees instead of the landing's marker.
    seen: BTreeMap<String, Others>,
}

#[derive(Debug)]
struct Others {
    /// Names of the newest ones.
    names: Vec<String>,
    since_ns: i64,
    last_ns: i64,
}

impl Announced {
    /// A detector published the markers that it looks for.
    pub fn add(&mut self, detector: &str, markers: &[String]) {
        if self.sought.len() < MAX_DETECTORS || self.sought.contains_key(detector) {
            self.sought.insert(detector.to_owned(), markers.to_vec());
        }
    }

    /// A detector searched a frame for the landing's marker, by its name.
    pub fn searched(&mut self, now_ns: i64, detector: &str, message: &Detections, marker: &str) {
        self.seen.retain(|_, others| now_ns.saturating_sub(others.last_ns) < OVER_NS);
        if message.first_of(marker).is_some() {
            self.seen.remove(detector);
            return;
        }
        let others = message.detections.iter().filter(|it| it.is_other_than(marker));
        let mut names: Vec<String> = others.map(Detection::name).take(MAX_NAMED).collect();
        names.dedup();
        if names.is_empty() {
            return;
        }
        if let Some(seen) = self.seen.get_mut(detector) {
            (seen.names, seen.last_ns) = (names, now_ns);
        } else if self.seen.len() < MAX_DETECTORS {
            let others = Others { names, since_ns: now_ns, last_ns: now_ns };
            self.seen.insert(detector.to_owned(), others);
        }
    }

    /// Forgets the markers of detectors that the selection has forgotten.
    pub fn forget(&mut self, selection: &Selection) {
        self.sought.retain(|name, _| selection.knows(name));
    }

    /// The warning that no present detector looks for the landing's marker; `None` where one does, sees it, or publishes no markers.
    pub fn no_detector_looks_for(&self, marker: &str, selection: &Selection) -> Option<String> {
        let mut others = Vec::new();
        for (name, sees) in selection.alive() {
            let markers = self.sought.get(name)?;
            if sees || !looks_for_others(markers, marker) {
                return None;
            }
            others.push((name, format!("`{name}` looks for {}", markers.join(" "))));
        }
        let (name, _) = others.first()?;
        let all: Vec<&str> = others.iter().take(MAX_NAMED).map(|(_, text)| text.as_str()).collect();
        let all = all.join(", ");
        Some(format!(
            "no detector looks for the landing's marker {marker}: {all}; correct `marker` of the controller, or `markers` of the detector (`alight command \
             --detector {name} set 'markers=[\"FAMILY:ID:SIZE_M\"]'`)"
        ))
    }

    /// The warning that this detector sees other markers than the landing's, where that persists.
    pub fn seen_instead(&self, now_ns: i64, detector: &str, marker: &str) -> Option<String> {
        let others = self.seen.get(detector).filter(|it| it.is_lasting(now_ns))?;
        let names = others.names.join(", ");
        Some(format!(
            "detector `{detector}` sees {names} and not the landing's marker {marker}: check the pad, and `marker` of the controller"
        ))
    }

    /// The warnings for the operator.
    pub fn warnings(&self, now_ns: i64, marker: &str, selection: &Selection) -> Vec<Warning> {
        let none = self
            .no_detector_looks_for(marker, selection)
            .map(|text| Warning { matter: "no detector looks for the marker".to_owned(), text });
        let instead = self.seen.keys().filter_map(|name| {
            let text = self.seen_instead(now_ns, name, marker)?;
            Some(Warning { matter: format!("other markers {name}"), text })
        });
        none.into_iter().chain(instead.take(MAX_NAMED)).collect()
    }
}

impl Others {
    fn is_lasting(&self, now_ns: i64) -> bool {
        self.last_ns.saturating_sub(self.since_ns) >= MIN_LASTING_NS
            && now_ns.saturating_sub(self.last_ns) < OVER_NS
    }
}
