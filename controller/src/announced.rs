//! What detectors look for and what they see beside the landing's marker: why none of them leads to it, in words.

use std::collections::BTreeMap;

use messages::{Detection, Detections, looks_for_others};

use crate::refusals::Warning;
use crate::selection::{MAX_DETECTORS, Selection};

/// Time for which a detector must see other markers, and not the landing's, before it is told, in nanoseconds.
const MIN_LASTING_NS: i64 = 2_000_000_000;
/// Time without another marker after which that is over, in nanoseconds.
const OVER_NS: i64 = 1_500_000_000;
/// Maximum number of markers that are named.
const MAX_NAMED: usize = 3;

/// The markers of detectors, by detector: at most [`MAX_DETECTORS`] each.
#[derive(Debug, Default)]
pub struct Announced {
    /// What each looks for, as it tells.
    wanted: BTreeMap<String, Vec<String>>,
    /// What each sees instead of the landing's marker.
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
    /// A detector told what it looks for.
    pub fn told(&mut self, detector: &str, markers: &[String]) {
        if self.wanted.len() < MAX_DETECTORS || self.wanted.contains_key(detector) {
            self.wanted.insert(detector.to_owned(), markers.to_vec());
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

    /// Forgets what a detector told that the selection has forgotten.
    pub fn forget(&mut self, selection: &Selection) {
        self.wanted.retain(|name, _| selection.knows(name));
    }

    /// That no detector which is there looks for the landing's marker; `None` where one does, sees it, or tells nothing of what it looks for.
    pub fn nobody_looks_for(&self, marker: &str, selection: &Selection) -> Option<String> {
        let mut told = Vec::new();
        for (name, sees) in selection.alive() {
            let markers = self.wanted.get(name)?;
            if sees || !looks_for_others(markers, marker) {
                return None;
            }
            told.push((name, format!("`{name}` looks for {}", markers.join(" "))));
        }
        let (name, _) = told.first()?;
        let all: Vec<&str> = told.iter().take(MAX_NAMED).map(|(_, text)| text.as_str()).collect();
        let all = all.join(", ");
        Some(format!(
            "no detector looks for the landing's marker {marker}: {all}; correct `marker` of the controller, or `markers` of the detector (`alight command \
             --detector {name} set 'markers=[\"FAMILY:ID:SIZE_M\"]'`)"
        ))
    }

    /// What this detector sees instead of the landing's marker, where that lasts.
    pub fn seen_instead(&self, now_ns: i64, detector: &str, marker: &str) -> Option<String> {
        let others = self.seen.get(detector).filter(|it| it.is_lasting(now_ns))?;
        let names = others.names.join(", ");
        Some(format!(
            "detector `{detector}` sees {names} and not the landing's marker {marker}: check the pad, and `marker` of the controller"
        ))
    }

    /// What the operator should know.
    pub fn warnings(&self, now_ns: i64, marker: &str, selection: &Selection) -> Vec<Warning> {
        let nobody = self
            .nobody_looks_for(marker, selection)
            .map(|text| Warning { matter: "nobody looks for the marker".to_owned(), text });
        let instead = self.seen.keys().filter_map(|name| {
            let text = self.seen_instead(now_ns, name, marker)?;
            Some(Warning { matter: format!("other markers {name}"), text })
        });
        nobody.into_iter().chain(instead.take(MAX_NAMED)).collect()
    }
}

impl Others {
    fn is_lasting(&self, now_ns: i64) -> bool {
        self.last_ns.saturating_sub(self.since_ns) >= MIN_LASTING_NS
            && now_ns.saturating_sub(self.last_ns) < OVER_NS
    }
}
