//! Which detector is used: one at a time, by preference, then by health.
//!
//! A crash and an operator's choice take the same path: another detector becomes active at the first frame it has
//! that is newer than the last one used.

use messages::Candidate;

/// A detector that has gone and was not heard for so long is forgotten, in nanoseconds.
const FORGOTTEN_NS: i64 = 10_000_000_000;
/// One that is said to be there is forgotten after so long a silence, and known again at its next word.
const SILENT_NS: i64 = 60_000_000_000;
/// The longest name of a service, in bytes.
const LONGEST_NAME: usize = 64;
/// Detectors that are followed at most; more are a mistake in the network.
const MOST: usize = 16;

/// The detectors there are, and the one in use.
#[derive(Debug)]
pub struct Selection {
    max_age_ns: i64,
    preferred: Option<String>,
    active: Option<String>,
    known: Vec<Known>,
    newest_used_ns: i64,
}

#[derive(Debug)]
struct Known {
    name: String,
    alive: bool,
    /// Stamp of the frame of its latest detections.
    stamp_ns: i64,
    heard_ns: i64,
    rate_hz: f64,
    disagreement_m: Option<f64>,
}

impl Selection {
    /// Nobody is known yet; a detector is healthy up to this age of its latest frame.
    pub fn new(max_age_s: f64, preferred: Option<String>) -> Self {
        Self {
            max_age_ns: (max_age_s * 1e9) as i64,
            preferred,
            active: None,
            known: Vec::new(),
            newest_used_ns: i64::MIN,
        }
    }

    /// Takes note of detections of a frame with this stamp; true when they are to be used.
    pub fn heard(
        &mut self,
        now_ns: i64,
        name: &str,
        stamp_ns: i64,
        distance_m: Option<f64>,
    ) -> bool {
        let Some(known) = self.known_mut(now_ns, name) else { return false };
        let period_s = ((now_ns - known.heard_ns) as f64 * 1e-9).max(1e-3);
        let fraction = (period_s / 1.0).min(0.5);
        known.rate_hz += fraction * (1.0 / period_s - known.rate_hz);
        known.alive = true;
        known.heard_ns = now_ns;
        known.stamp_ns = known.stamp_ns.max(stamp_ns);
        known.disagreement_m = distance_m;
        self.choose(now_ns);
        let used = self.active.as_deref() == Some(name) && stamp_ns > self.newest_used_ns;
        if used {
            self.newest_used_ns = stamp_ns;
        }
        used
    }

    /// A detector came or went.
    pub fn presence(&mut self, now_ns: i64, name: &str, alive: bool) {
        if let Some(known) = self.known_mut(now_ns, name) {
            known.alive = alive;
        }
        self.choose(now_ns);
    }

    /// Uses a certain detector while it is healthy.
    ///
    /// # Errors
    /// Names the detectors there are when it is not among them.
    pub fn prefer(&mut self, now_ns: i64, name: &str) -> Result<(), String> {
        if !self.known.iter().any(|known| known.name == name) {
            let names: Vec<_> = self.known.iter().map(|known| known.name.as_str()).collect();
            let there = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
            return Err(format!("no detector `{name}` was heard; there is: {there}"));
        }
        self.preferred = Some(name.to_owned());
        self.choose(now_ns);
        Ok(())
    }

    /// Lets time pass.
    pub fn tick(&mut self, now_ns: i64) {
        self.known.retain(|known| {
            let patience_ns = if known.alive { SILENT_NS } else { FORGOTTEN_NS };
            now_ns.saturating_sub(known.heard_ns) < patience_ns
        });
        self.choose(now_ns);
    }

    /// The detector in use.
    pub fn active(&self) -> Option<&str> {
        self.active.as_deref()
    }

    /// True when every detector that was heard has gone: there will be no more detections until one comes.
    pub fn is_blind(&self) -> bool {
        !self.known.iter().any(|known| known.alive)
    }

    /// All detectors there are.
    pub fn candidates(&self, now_ns: i64) -> Vec<Candidate> {
        let candidate = |known: &Known| Candidate {
            detector: known.name.clone(),
            age_ms: now_ns.saturating_sub(known.stamp_ns) as f64 * 1e-6,
            rate_hz: known.rate_hz,
            alive: known.alive,
            disagreement_m: known.disagreement_m,
        };
        self.known.iter().filter(|known| known.stamp_ns != i64::MIN).map(candidate).collect()
    }

    fn known_mut(&mut self, now_ns: i64, name: &str) -> Option<&mut Known> {
        if let Some(index) = self.known.iter().position(|known| known.name == name) {
            return self.known.get_mut(index);
        }
        if self.known.len() >= MOST || name.len() > LONGEST_NAME {
            return None;
        }
        self.known.push(Known {
            name: name.to_owned(),
            alive: true,
            stamp_ns: i64::MIN,
            heard_ns: now_ns,
            rate_hz: 0.0,
            disagreement_m: None,
        });
        self.known.last_mut()
    }

    fn choose(&mut self, now_ns: i64) {
        let healthy = |known: &&Known| {
            known.alive && now_ns.saturating_sub(known.stamp_ns) <= self.max_age_ns
        };
        let named = |name: &Option<String>| {
            self.known.iter().find(|k| Some(&k.name) == name.as_ref()).filter(healthy)
        };
        let newest = || self.known.iter().filter(healthy).max_by_key(|known| known.stamp_ns);
        let best = named(&self.preferred).or_else(|| named(&self.active)).or_else(newest);
        // While nobody is healthy the last one stays: its next frame is as good as anybody's.
        if let Some(best) = best {
            self.active = Some(best.name.clone());
        }
        if !self.known.iter().any(|known| Some(&known.name) == self.active.as_ref()) {
            self.active = None;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn selection() -> Selection {
        Selection::new(0.2, None)
    }

    #[test]
    fn one_detector_is_used_and_the_other_stands_by() {
        let mut selection = selection();
        assert!(selection.heard(0, "main", 0, None));
        assert!(!selection.heard(5 * MS, "spare", 0, None));
        assert!(selection.heard(67 * MS, "main", 60 * MS, None));
        assert!(!selection.heard(70 * MS, "spare", 60 * MS, None));
        assert_eq!(selection.active(), Some("main"));
        assert_eq!(selection.candidates(70 * MS).len(), 2);
    }

    #[test]
    fn a_crash_hands_over_at_the_next_frame_that_is_newer() {
        let mut selection = selection();
        selection.heard(0, "main", 0, None);
        selection.heard(MS, "spare", 0, None);
        selection.presence(10 * MS, "main", false);
        assert_eq!(selection.active(), Some("spare"));
        assert!(!selection.heard(20 * MS, "spare", 0, None), "the same frame again");
        assert!(selection.heard(67 * MS, "spare", 66 * MS, None));
    }

    #[test]
    fn silence_hands_over_after_the_age_allowed() {
        let mut selection = selection();
        selection.heard(0, "main", 0, None);
        for i in 0..4 {
            let now = i * 67 * MS;
            selection.heard(now + 1, "spare", now, None);
        }
        assert_eq!(selection.active(), Some("spare"));
    }

    #[test]
    fn the_operators_choice_wins_while_it_is_healthy() {
        let mut selection = selection();
        assert!(selection.prefer(0, "spare").unwrap_err().contains("there is: none"));
        selection.heard(0, "main", 0, None);
        selection.heard(1, "spare", 0, None);
        assert!(selection.prefer(2, "spare").is_ok());
        assert_eq!(selection.active(), Some("spare"));
        selection.heard(210 * MS, "main", 205 * MS, None);
        assert_eq!(selection.active(), Some("main"), "the preferred one is too old");
        selection.heard(280 * MS, "spare", 270 * MS, None);
        assert_eq!(selection.active(), Some("spare"));
    }

    #[test]
    fn those_that_left_are_forgotten_and_a_flood_of_names_is_bounded() {
        let mut selection = selection();
        selection.heard(0, "main", 0, None);
        assert!(!selection.is_blind());
        selection.presence(1, "main", false);
        assert!(selection.is_blind());
        selection.tick(11_000 * MS);
        assert!(selection.active().is_none() && selection.candidates(0).is_empty());
        for i in 0..1000 {
            selection.heard(i, &format!("d{i}"), i, None);
        }
        assert_eq!(selection.candidates(0).len(), MOST);
        assert!(!selection.heard(1000, "main", 1000, None), "there is no room");
        let later = 61_000 * MS;
        selection.tick(later);
        assert!(!selection.heard(later, &"d".repeat(65), later, None), "no name of a service");
        assert!(selection.heard(later, "main", later, None));
    }
}
