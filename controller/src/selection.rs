//! Which detector is used: one at a time, by the operator's preference, then by health.
//!
//! A function of time and of what is heard. Another detector becomes the active one when the active one is gone,
//! silent, late or slow and the other is not, or when the operator prefers the other and it has been healthy for a
//! while. What is used next is always the active detector's newest frame, and only if it is newer than all before:
//! so a crash, an operator's choice and a swap take the same path, and no stamp is used that is older than the last.

use std::collections::VecDeque;

use messages::{Candidate, DetectorState, Place};

/// A detector that has gone and was not heard for so long is forgotten, in nanoseconds.
const FORGOTTEN_NS: i64 = 10_000_000_000;
/// One that is said to be there is forgotten after so long a silence, and known again at its next word.
const SILENT_NS: i64 = 60_000_000_000;
/// The longest name of a service, in bytes.
const LONGEST_NAME: usize = 64;
/// Detectors that are followed at most; more are a mistake in the network.
pub const MOST: usize = 64;
/// Frames and intervals that are remembered of each.
const REMEMBERED: usize = 16;
/// Comparisons with the active detector that are remembered of each.
const COMPARED: usize = 30;
/// Comparisons from which on disagreement counts.
const CONCLUSIVE: usize = 8;
/// A detector is silent after so many of its own frame periods. One lost frame makes an interval of 2; at 3 another
/// detector must be in use.
const SILENT_PERIODS: f64 = 2.25;
/// The period taken for a detector that was not heard often enough, in nanoseconds.
const UNKNOWN_PERIOD_NS: i64 = 100_000_000;
/// The shortest silence that is one: the scheduler of a busy machine makes shorter ones.
const SHORTEST_SILENCE_NS: i64 = 50_000_000;
/// The longest silence that is none.
const LONGEST_SILENCE_NS: i64 = 1_000_000_000;
/// With each failure a detector is trusted again only after twice the time; so often at most.
const MOST_DOUBLINGS: u32 = 5;
/// A failure is forgiven after so long a time without another.
const FORGIVEN_NS: i64 = 60_000_000_000;

/// What a healthy detector is.
#[derive(Copy, Clone, Debug)]
pub struct Limits {
    /// The longest usual time from capture to arrival, in seconds.
    pub max_age_s: f64,
    /// The lowest usual rate, in Hz.
    pub least_rate_hz: f64,
    /// For how long a preferred detector must have been healthy before it is used (again), in seconds.
    pub return_after_s: f64,
    /// Distance up to which two detectors see the marker at the same place, in metres.
    pub tolerance_m: f64,
    /// What that distance grows by per metre of distance to the marker.
    pub tolerance_per_m: f64,
}

/// What the operator prefers.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Preference {
    /// This detector first.
    pub detector: Option<String>,
    /// Then those that run there.
    pub place: Option<Place>,
}

/// Where a detector sees the marker.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Sight {
    /// In the vehicle's body frame, in metres; `None` without a pose.
    pub place_m: Option<[f64; 3]>,
}

/// The detectors there are, and the one in use.
#[derive(Debug)]
pub struct Selection {
    limits: Limits,
    preference: Preference,
    /// True until the operator's latest choice was followed: it does not wait for trust.
    is_asked: bool,
    active: Option<String>,
    known: Vec<Known>,
    newest_used_ns: i64,
    changes: u64,
    why: String,
}

#[derive(Debug)]
struct Known {
    name: String,
    place: Option<Place>,
    alive: bool,
    /// When it was told to have gone: only a frame from later proves the contrary.
    gone_ns: i64,
    /// Stamp of its newest frame; the least number before the first.
    stamp_ns: i64,
    heard_ns: i64,
    /// Since when another detector has delivered a newer frame.
    overtaken_ns: Option<i64>,
    /// Since when it has been healthy without a break.
    sound_ns: Option<i64>,
    failures: u32,
    failed_ns: i64,
    intervals_ns: VecDeque<i64>,
    latencies_ns: VecDeque<i64>,
    sights: VecDeque<(i64, Option<Sight>)>,
    verdicts: VecDeque<bool>,
    disagreement_m: Option<f64>,
}

impl Selection {
    /// Nobody is known yet.
    pub fn new(limits: Limits, preference: Preference) -> Self {
        Self {
            limits,
            preference,
            is_asked: false,
            active: None,
            known: Vec::new(),
            newest_used_ns: i64::MIN,
            changes: 0,
            why: "no detector was heard".to_owned(),
        }
    }

    /// Takes note of the detections of a frame with this stamp, and of the wanted marker in it; true when they are the
    /// newest of this detector.
    pub fn heard(&mut self, now_ns: i64, name: &str, stamp_ns: i64, sight: Option<Sight>) -> bool {
        let others_ns = self.newest_of_others_ns(name);
        let Some(known) = self.known_mut(now_ns, name) else { return false };
        let is_newer = stamp_ns > known.stamp_ns;
        if is_newer {
            known.take(now_ns, stamp_ns, sight, others_ns);
            for other in self.known.iter_mut().filter(|other| other.name != name) {
                if other.stamp_ns < stamp_ns {
                    other.overtaken_ns = other.overtaken_ns.or(Some(now_ns));
                }
            }
            self.compare(name, stamp_ns, sight);
        }
        self.choose(now_ns);
        is_newer
    }

    /// A detector came or went.
    pub fn presence(&mut self, now_ns: i64, name: &str, alive: bool) {
        if let Some(known) = self.known_mut(now_ns, name) {
            known.alive = alive;
            known.gone_ns = if alive { i64::MIN } else { now_ns };
        }
        self.choose(now_ns);
    }

    /// A detector told where it runs.
    pub fn introduced(&mut self, now_ns: i64, name: &str, place: Place) {
        if let Some(known) = self.known_mut(now_ns, name) {
            known.place = Some(place);
        }
        self.choose(now_ns);
    }

    /// Uses a certain detector while it is healthy; the answer says what that means now.
    ///
    /// # Errors
    /// Names the detectors there are when it is not among them, or has gone.
    pub fn prefer(&mut self, now_ns: i64, name: &str) -> Result<String, String> {
        let Some(known) = self.known.iter().find(|known| known.name == name) else {
            let names: Vec<_> = self.known.iter().map(|known| known.name.as_str()).collect();
            let there = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
            return Err(format!("no detector `{name}` was heard; there is: {there}"));
        };
        if !known.alive {
            return Err(format!("detector `{name}` has gone"));
        }
        let trouble = self.trouble(now_ns, known);
        let doubt = known.doubt();
        self.preference.detector = Some(name.to_owned());
        self.is_asked = true;
        self.choose(now_ns);
        Ok(match (trouble, doubt) {
            (Some(trouble), _) => {
                format!("detector `{name}` is used as soon as it is healthy; now {trouble}")
            }
            (None, Some(doubt)) => {
                format!("detector `{name}` is used while it is healthy, although {doubt}")
            }
            (None, None) => format!("detector `{name}` is used while it is healthy"),
        })
    }

    /// Uses detectors that run at a place while they are healthy; the answer says what that means now.
    pub fn prefer_place(&mut self, now_ns: i64, place: Place) -> String {
        self.preference = Preference { detector: None, place: Some(place) };
        self.is_asked = true;
        self.choose(now_ns);
        let there: Vec<_> = self.known.iter().filter(|known| known.place == Some(place)).collect();
        let healthy = there.iter().filter(|known| self.trouble(now_ns, known).is_none()).count();
        let place = place.name();
        match (there.len(), healthy) {
            (0, _) => format!("detectors {place} are preferred; there is none yet"),
            (_, 0) => format!("detectors {place} are preferred; none of them is healthy yet"),
            _ => format!("detectors {place} are preferred"),
        }
    }

    /// Lets time pass.
    pub fn tick(&mut self, now_ns: i64) {
        self.known.retain(|known| {
            let patience_ns = if known.alive { SILENT_NS } else { FORGOTTEN_NS };
            now_ns.saturating_sub(known.heard_ns) < patience_ns
        });
        self.choose(now_ns);
    }

    /// The frame to be used now, by its detector and stamp: the active detector's newest, if it is newer than all that
    /// were used. To be asked for after each of the calls above.
    pub fn next_frame(&mut self) -> Option<(String, i64)> {
        let active = self.known_active()?;
        let frame = (active.name.clone(), active.stamp_ns);
        (frame.1 > self.newest_used_ns).then(|| {
            self.newest_used_ns = frame.1;
            frame
        })
    }

    /// The detector in use.
    pub fn active(&self) -> Option<&str> {
        self.active.as_deref()
    }

    /// Why it is this one.
    pub fn why(&self) -> &str {
        &self.why
    }

    /// How often another detector became the active one.
    pub fn changes(&self) -> u64 {
        self.changes
    }

    /// What is preferred, in a word.
    pub fn preference(&self) -> &str {
        let Preference { detector, place } = &self.preference;
        detector.as_deref().or(place.map(Place::name)).unwrap_or_default()
    }

    /// True when every detector that was heard has gone: there will be no more detections until one comes.
    pub fn is_blind(&self) -> bool {
        !self.known.iter().any(|known| known.alive)
    }

    /// True for a detector that is followed.
    pub fn knows(&self, name: &str) -> bool {
        self.known.iter().any(|known| known.name == name)
    }

    /// True when some detector has delivered a frame that is newer than the last one used.
    pub fn has_newer(&self) -> bool {
        self.known.iter().any(|known| known.alive && known.stamp_ns > self.newest_used_ns)
    }

    /// All detectors that were heard.
    pub fn candidates(&self, now_ns: i64) -> Vec<Candidate> {
        let candidate = |known: &Known| Candidate {
            detector: known.name.clone(),
            state: match self.trouble(now_ns, known) {
                Some(_) => DetectorState::Stale,
                None if self.active.as_ref() == Some(&known.name) => DetectorState::Active,
                None => DetectorState::Shadow,
            },
            place: known.place,
            age_ms: now_ns.saturating_sub(known.stamp_ns) as f64 * 1e-6,
            latency_ms: median(&known.latencies_ns).unwrap_or_default() as f64 * 1e-6,
            rate_hz: known.rate_hz(),
            alive: known.alive,
            disagreement_m: known.disagreement_m,
            compared: known.verdicts.len() as u32,
            agreed: known.agreed() as u32,
        };
        self.known.iter().filter(|known| known.has_spoken()).map(candidate).collect()
    }

    fn known_active(&self) -> Option<&Known> {
        let active = self.active.as_ref()?;
        self.known.iter().find(|known| known.name == *active)
    }

    fn newest_of_others_ns(&self, name: &str) -> i64 {
        let others = self.known.iter().filter(|known| known.name != name && known.alive);
        others.map(|known| known.stamp_ns).max().unwrap_or(i64::MIN)
    }

    fn known_mut(&mut self, now_ns: i64, name: &str) -> Option<&mut Known> {
        if let Some(index) = self.known.iter().position(|known| known.name == name) {
            return self.known.get_mut(index);
        }
        if self.known.len() >= MOST || name.is_empty() || name.len() > LONGEST_NAME {
            return None;
        }
        self.known.push(Known::new(now_ns, name));
        self.known.last_mut()
    }

    /// Compares what was seen in one frame: the active detector with all others, or another with the active one.
    fn compare(&mut self, name: &str, stamp_ns: i64, sight: Option<Sight>) {
        let limits = self.limits;
        let Some(active) = self.active.clone() else { return };
        if active == name {
            for other in self.known.iter_mut().filter(|known| known.name != active) {
                if let Some(theirs) = other.sight_at(stamp_ns) {
                    other.judge(&limits, sight, theirs);
                }
            }
        } else if let Some(theirs) = self.known_active().and_then(|known| known.sight_at(stamp_ns))
            && let Some(known) = self.known.iter_mut().find(|known| known.name == name)
        {
            known.judge(&limits, theirs, sight);
        }
    }

    /// What is wrong with a detector.
    fn trouble(&self, now_ns: i64, known: &Known) -> Option<String> {
        if !known.alive {
            return Some("it has gone".to_owned());
        }
        if !known.has_spoken() {
            return Some("it has not searched a frame yet".to_owned());
        }
        let silence_ns = now_ns.saturating_sub(known.heard_ns);
        if silence_ns > known.silence_allowed_ns() {
            return Some(format!("it is silent for {:.0} ms", silence_ns as f64 * 1e-6));
        }
        let latency_s = median(&known.latencies_ns).unwrap_or_default() as f64 * 1e-9;
        if latency_s > self.limits.max_age_s {
            return Some(format!("its frames are {:.0} ms old", latency_s * 1e3));
        }
        let rate_hz = known.rate_hz();
        if known.intervals_ns.len() >= CONCLUSIVE && rate_hz < self.limits.least_rate_hz {
            return Some(format!("it searches {rate_hz:.1} frames a second"));
        }
        None
    }

    /// What is wrong with the active detector. A silence counts only when the frames that it owes are really there:
    /// after a camera's pause the others are merely heard first.
    fn failure(&self, now_ns: i64, active: &Known) -> Option<String> {
        let trouble = self.trouble(now_ns, active)?;
        let is_silent = active.alive
            && active.has_spoken()
            && now_ns.saturating_sub(active.heard_ns) > active.silence_allowed_ns();
        let owes = active
            .overtaken_ns
            .is_some_and(|since| now_ns.saturating_sub(since) >= active.period_ns());
        (!is_silent || owes).then_some(trouble)
    }

    fn class(&self, known: &Known) -> u8 {
        let is_named = self.preference.detector.as_ref() == Some(&known.name);
        let is_there = self.preference.place.is_some() && known.place == self.preference.place;
        match (is_named, is_there) {
            (true, _) => 2,
            (false, true) => 1,
            (false, false) => 0,
        }
    }

    fn is_trusted(&self, now_ns: i64, known: &Known) -> bool {
        let doublings = known.failures.saturating_sub(1).min(MOST_DOUBLINGS);
        let needed_s = self.limits.return_after_s * f64::from(1_u32 << doublings);
        let needed_ns = (needed_s * 1e9) as i64;
        known.sound_ns.is_some_and(|since| now_ns.saturating_sub(since) >= needed_ns)
    }

    fn choose(&mut self, now_ns: i64) {
        self.follow_health(now_ns);
        let wanted = match &self.preference {
            Preference { detector: Some(_), .. } => 2,
            Preference { place: Some(_), .. } => 1,
            Preference { .. } => 0,
        };
        self.is_asked &= self.known_active().is_none_or(|active| self.class(active) < wanted);
        let Some((name, why)) = self.choice(now_ns) else { return };
        let before = self.active.take();
        if let Some(before) = &before
            && let Some(known) = self.known.iter_mut().find(|known| known.name == *before)
            && known.sound_ns.is_none()
        {
            known.failures = known.failures.saturating_add(1);
            known.failed_ns = now_ns;
        }
        self.changes += u64::from(before.is_some());
        self.active = Some(name);
        self.why = why;
        for known in &mut self.known {
            known.verdicts.clear();
            known.disagreement_m = None;
        }
    }

    fn follow_health(&mut self, now_ns: i64) {
        let is_sound: Vec<bool> =
            self.known.iter().map(|known| self.trouble(now_ns, known).is_none()).collect();
        for (known, is_sound) in self.known.iter_mut().zip(is_sound) {
            known.sound_ns = is_sound.then(|| known.sound_ns.unwrap_or(now_ns));
            if is_sound && now_ns.saturating_sub(known.failed_ns) > FORGIVEN_NS {
                known.failures = 0;
            }
        }
        if self.active.is_some() && self.known_active().is_none() {
            self.active = None;
            self.why = "the last one has gone".to_owned();
        }
    }

    /// Another detector to use from now on, and why.
    fn choice(&self, now_ns: i64) -> Option<(String, String)> {
        let active = self.known_active();
        let others = || {
            self.known
                .iter()
                .filter(|known| known.has_spoken() && active.is_none_or(|a| a.name != known.name))
        };
        let healthy = || others().filter(|known| known.sound_ns.is_some());
        let Some(active) = active else {
            // Where nobody is healthy, one that is heard is better than none; its frames are judged one by one.
            let rank =
                |known: &&Known| (known.sound_ns.is_some(), self.class(known), known.stamp_ns);
            let first = others().filter(|known| known.alive).max_by_key(rank)?;
            return Some((first.name.clone(), "it is the first".to_owned()));
        };
        if let Some(failure) = self.failure(now_ns, active) {
            let rank =
                |known: &&Known| (known.doubt().is_none(), self.class(known), known.stamp_ns);
            // A silent or late one stays while nobody is better; one that has gone makes room for any.
            let next = healthy().max_by_key(rank).or_else(|| {
                let alive = others().filter(|known| known.alive && !active.alive);
                alive.max_by_key(|known| known.stamp_ns)
            })?;
            return Some((next.name.clone(), format!("{}: {failure}", active.name)));
        }
        let is_better = |known: &&Known| {
            let is_named = self.preference.detector.as_ref() == Some(&known.name);
            let is_agreed = known.doubt().is_none() || is_named;
            let is_trusted = self.is_asked || self.is_trusted(now_ns, known);
            self.class(known) > self.class(active) && is_agreed && is_trusted
        };
        let better = healthy().filter(is_better);
        let better = better.max_by_key(|known| (self.class(known), known.stamp_ns))?;
        let why = match self.class(better) {
            2 => "it is preferred".to_owned(),
            _ => format!("{} is preferred", self.preference()),
        };
        Some((better.name.clone(), why))
    }
}

impl Known {
    fn new(now_ns: i64, name: &str) -> Self {
        Self {
            name: name.to_owned(),
            place: None,
            alive: true,
            gone_ns: i64::MIN,
            stamp_ns: i64::MIN,
            heard_ns: now_ns,
            overtaken_ns: None,
            sound_ns: None,
            failures: 0,
            failed_ns: i64::MIN,
            intervals_ns: VecDeque::new(),
            latencies_ns: VecDeque::new(),
            sights: VecDeque::new(),
            verdicts: VecDeque::new(),
            disagreement_m: None,
        }
    }

    /// Takes a newer frame.
    fn take(&mut self, now_ns: i64, stamp_ns: i64, sight: Option<Sight>, others_ns: i64) {
        if self.has_spoken() {
            keep(&mut self.intervals_ns, now_ns.saturating_sub(self.heard_ns), REMEMBERED);
        }
        keep(&mut self.latencies_ns, now_ns.saturating_sub(stamp_ns).max(0), REMEMBERED / 2);
        keep(&mut self.sights, (stamp_ns, sight), REMEMBERED);
        self.heard_ns = now_ns;
        self.stamp_ns = stamp_ns;
        self.overtaken_ns = (others_ns > stamp_ns).then_some(now_ns);
        self.alive |= stamp_ns > self.gone_ns;
    }

    fn has_spoken(&self) -> bool {
        self.stamp_ns != i64::MIN
    }

    fn period_ns(&self) -> i64 {
        median(&self.intervals_ns).unwrap_or(UNKNOWN_PERIOD_NS)
    }

    fn rate_hz(&self) -> f64 {
        median(&self.intervals_ns).map_or(0.0, |period_ns| 1e9 / period_ns.max(1_000_000) as f64)
    }

    fn silence_allowed_ns(&self) -> i64 {
        let allowed_ns = (self.period_ns() as f64 * SILENT_PERIODS) as i64;
        allowed_ns.clamp(SHORTEST_SILENCE_NS, LONGEST_SILENCE_NS)
    }

    fn sight_at(&self, stamp_ns: i64) -> Option<Option<Sight>> {
        self.sights.iter().find(|(stamp, _)| *stamp == stamp_ns).map(|(_, sight)| *sight)
    }

    /// Judges what this detector saw in a frame by what the active one saw in it. Where the active one saw nothing,
    /// nothing can be said.
    fn judge(&mut self, limits: &Limits, active: Option<Sight>, ours: Option<Sight>) {
        let Some(active) = active else { return };
        let agrees = match (active.place_m, ours.map(|ours| ours.place_m)) {
            (_, None) => false,
            (Some(active_m), Some(Some(ours_m))) => {
                let apart_m = distance(active_m, ours_m);
                self.disagreement_m = Some(apart_m);
                let range_m = distance(active_m, [0.0; 3]);
                apart_m <= limits.tolerance_m + limits.tolerance_per_m * range_m
            }
            // Without poses there is no distance; that both see it is all that is known.
            (None, Some(None)) => true,
            (Some(_), Some(None)) => false,
            (None, Some(Some(_))) => return,
        };
        keep(&mut self.verdicts, agrees, COMPARED);
    }

    fn agreed(&self) -> usize {
        self.verdicts.iter().filter(|agrees| **agrees).count()
    }

    /// Why it is not trusted although it is healthy.
    fn doubt(&self) -> Option<String> {
        let (agreed, compared) = (self.agreed(), self.verdicts.len());
        (compared >= CONCLUSIVE && agreed * 2 < compared)
            .then(|| format!("it agrees with the active one in {agreed} of {compared} frames only"))
    }
}

fn keep<T>(kept: &mut VecDeque<T>, value: T, most: usize) {
    while kept.len() >= most {
        kept.pop_front();
    }
    kept.push_back(value);
}

fn median(values: &VecDeque<i64>) -> Option<i64> {
    let mut sorted: Vec<i64> = values.iter().copied().collect();
    sorted.sort_unstable();
    sorted.get(sorted.len() / 2).copied()
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const MS: i64 = 1_000_000;
    const PERIOD: i64 = 67 * MS;

    fn limits() -> Limits {
        Limits {
            max_age_s: 0.2,
            least_rate_hz: 3.0,
            return_after_s: 2.0,
            tolerance_m: 0.1,
            tolerance_per_m: 0.03,
        }
    }

    fn preferring(detector: Option<&str>, place: Option<Place>) -> Selection {
        Selection::new(limits(), Preference { detector: detector.map(Into::into), place })
    }

    /// Detectors that answer to the frames of one camera, each with its latency, and what was used when.
    struct Bench {
        selection: Selection,
        now_ns: i64,
        /// Stamps used, with the time of their use and their detector.
        used: Vec<(i64, i64, String)>,
        /// When which detector became the active one.
        changes: Vec<(i64, String)>,
    }

    impl Bench {
        fn new(selection: Selection) -> Self {
            Self { selection, now_ns: 0, used: Vec::new(), changes: Vec::new() }
        }

        /// Notes what came of the last call, and checks what must always hold.
        fn note(&mut self) {
            if let Some((name, stamp)) = self.selection.next_frame() {
                assert_eq!(self.selection.active(), Some(name.as_str()));
                assert!(self.used.last().is_none_or(|last| last.0 < stamp), "an older stamp");
                self.used.push((stamp, self.now_ns, name));
            }
            let active = self.selection.active().unwrap_or("none").to_owned();
            let last = self.changes.last().map_or("none", |(_, last)| last.as_str());
            if last != active {
                self.changes.push((self.now_ns, active));
            }
        }

        /// Lets time pass up to a frame's stamp plus 66 ms: ticks every 25 ms, and the answers of those that answer.
        fn frame(&mut self, stamp_ns: i64, answers: &[(&str, i64)]) {
            let sight = Some(Sight { place_m: Some([0.0, 0.0, 5.0]) });
            let answers: Vec<_> =
                answers.iter().map(|(name, late)| (*name, *late, sight)).collect();
            self.frame_seen(stamp_ns, &answers);
        }

        fn frame_seen(&mut self, stamp_ns: i64, answers: &[(&str, i64, Option<Sight>)]) {
            let answered =
                |(name, late, sight): &(_, i64, _)| (stamp_ns + late, Some((*name, *sight)));
            let mut events: Vec<_> = answers.iter().map(answered).collect();
            events.extend((0..3).map(|i| (stamp_ns + i * 25 * MS, None)));
            events.sort_by_key(|(at, _)| *at);
            for (at, event) in events {
                self.now_ns = self.now_ns.max(at);
                match event {
                    Some((name, sight)) => {
                        self.selection.heard(self.now_ns, name, stamp_ns, sight);
                    }
                    None => self.selection.tick(self.now_ns),
                }
                self.note();
            }
        }

        fn frames(&mut self, frames: std::ops::Range<i64>, answers: &[(&str, i64)]) {
            frames.for_each(|i| self.frame(i * PERIOD, answers));
        }

        fn gone(&mut self, name: &str) {
            self.selection.presence(self.now_ns, name, false);
            self.note();
        }

        fn state(&self, name: &str) -> DetectorState {
            let all = self.selection.candidates(self.now_ns);
            all.iter().find(|candidate| candidate.detector == name).unwrap().state
        }

        fn longest_gap_ms(&self) -> i64 {
            self.used.windows(2).map(|pair| (pair[1].1 - pair[0].1) / MS).max().unwrap_or(0)
        }
    }

    const BOTH: [(&str, i64); 2] = [("main", 30 * MS), ("spare", 35 * MS)];

    #[test]
    fn one_detector_is_used_and_the_other_stands_by() {
        let mut bench = Bench::new(preferring(None, None));
        bench.frames(0..30, &BOTH);
        assert_eq!(bench.changes.len(), 1);
        assert_eq!(
            (bench.state("main"), bench.state("spare")),
            (DetectorState::Active, DetectorState::Shadow)
        );
        assert_eq!(bench.used.len(), 30);
        let spare = &bench.selection.candidates(bench.now_ns)[1];
        assert_eq!((spare.compared, spare.agreed), (30, 30));
        assert!((spare.rate_hz - 15.0).abs() < 0.5 && (spare.latency_ms - 35.0).abs() < 0.1);
    }

    #[test]
    fn a_crash_hands_over_at_once_and_uses_the_frame_that_is_there() {
        let mut bench = Bench::new(preferring(None, None));
        bench.frames(0..10, &BOTH);
        // The active one dies over a frame that the other has searched.
        bench.frame(10 * PERIOD, &BOTH[1..]);
        bench.gone("main");
        assert_eq!(bench.selection.active(), Some("spare"));
        assert_eq!(bench.used.last().unwrap().0, 10 * PERIOD);
        bench.frames(11..20, &BOTH[1..]);
        assert_eq!(bench.used.len(), 20);
        assert!(bench.selection.why().contains("main: it has gone"), "{}", bench.selection.why());
        assert_eq!(bench.selection.changes(), 1);
    }

    #[test]
    fn a_silent_one_is_replaced_within_three_of_its_periods_whatever_the_latencies() {
        for latency_ms in [5, 30, 60, 100, 140] {
            for spare_ms in [5, 30, 60, 100] {
                for period_ms in [20, 33, 67, 100] {
                    let answers = [("main", latency_ms * MS), ("spare", spare_ms * MS)];
                    let period = period_ms * MS;
                    let mut events = Vec::new();
                    for (name, late) in answers {
                        let last = if name == "main" { 20 } else { 40 };
                        events.extend(
                            (0..last).map(|i| (i * period + late, Some((name, i * period)))),
                        );
                    }
                    events.extend((0..200).map(|i| (i * 25 * MS, None)));
                    events.sort_by_key(|(at, _)| *at);
                    let mut bench = Bench::new(preferring(None, None));
                    bench.selection.heard(0, "main", -period, None);
                    for (at, event) in events {
                        bench.now_ns = at;
                        match event {
                            Some((name, stamp)) => {
                                bench.selection.heard(at, name, stamp, None);
                            }
                            None => bench.selection.tick(at),
                        }
                        bench.note();
                    }
                    let last_ns = 19 * period + latency_ms * MS;
                    let taken_over =
                        bench.changes.iter().find(|(at, name)| *at > last_ns && name == "spare");
                    let took_ns = taken_over.unwrap().0 - last_ns;
                    // The other must have had a newer frame for a period; a tick may pass before it is noticed.
                    let lag_ns = (spare_ms - latency_ms).max(0) * MS;
                    let bound_ns =
                        (3 * period).max(2 * period + lag_ns).max(SHORTEST_SILENCE_NS) + 25 * MS;
                    assert!(
                        took_ns <= bound_ns,
                        "{latency_ms} {spare_ms} {period_ms}: {} ms",
                        took_ns / MS
                    );
                }
            }
        }
    }

    #[test]
    fn a_lost_frame_and_a_camera_that_pauses_change_nothing() {
        let mut bench = Bench::new(preferring(None, None));
        bench.frames(0..10, &BOTH);
        bench.frame(10 * PERIOD, &BOTH[1..]);
        bench.frames(11..20, &BOTH);
        for i in 20..60 {
            bench.frame(i * PERIOD, &[]);
        }
        // The spare one is heard first after the pause.
        bench.frames(60..80, &[("main", 35 * MS), ("spare", 20 * MS)]);
        assert_eq!(bench.changes.len(), 1, "{:?}", bench.changes);
    }

    #[test]
    fn the_operators_choice_is_followed_at_once_and_left_while_it_is_not_healthy() {
        let mut bench = Bench::new(preferring(None, None));
        assert!(bench.selection.prefer(0, "spare").unwrap_err().contains("there is: none"));
        bench.frames(0..10, &BOTH);
        assert!(bench.selection.prefer(bench.now_ns, "spare").unwrap().contains("is used while"));
        bench.note();
        assert_eq!(bench.selection.active(), Some("spare"));
        bench.frames(10..20, &BOTH);
        bench.frames(20..30, &BOTH[..1]);
        assert_eq!(bench.selection.active(), Some("main"));
        let why = bench.selection.why().to_owned();
        assert!(why.contains("spare: it is silent for"), "{why}");
        // Back only after it was healthy for a while.
        bench.frames(30..58, &BOTH);
        assert_eq!(bench.selection.active(), Some("main"));
        bench.frames(58..64, &BOTH);
        assert_eq!(
            (bench.selection.active(), bench.selection.why()),
            (Some("spare"), "it is preferred")
        );
        assert_eq!(bench.used.len(), 63);
        bench.gone("main");
        let refused = bench.selection.prefer(bench.now_ns, "main").unwrap_err();
        assert!(refused.contains("has gone"), "{refused}");
    }

    #[test]
    fn a_place_is_preferred_and_left_and_taken_again() {
        let mut bench = Bench::new(preferring(None, None));
        let answers = [("air", 30 * MS), ("ground", 95 * MS)];
        let none_yet = bench.selection.prefer_place(0, Place::Ground);
        assert!(none_yet.contains("none yet"), "{none_yet}");
        bench.selection.introduced(0, "air", Place::Onboard);
        bench.selection.introduced(0, "ground", Place::Ground);
        bench.frames(0..20, &answers);
        assert_eq!(bench.selection.active(), Some("ground"));
        // The link is cut for three seconds: the process is missed only after its lease.
        bench.frames(20..30, &answers[..1]);
        assert_eq!(bench.selection.active(), Some("air"));
        bench.gone("ground");
        bench.frames(30..65, &answers[..1]);
        bench.selection.presence(bench.now_ns, "ground", true);
        bench.frames(65..90, &answers);
        assert_eq!(bench.selection.active(), Some("air"), "it must prove itself first");
        bench.frames(90..110, &answers);
        assert_eq!(bench.selection.active(), Some("ground"));
        assert!(bench.longest_gap_ms() <= 201, "{}", bench.longest_gap_ms());
        assert_eq!(bench.selection.preference(), "ground");
    }

    #[test]
    fn one_that_fails_again_and_again_is_trusted_more_slowly() {
        let mut bench = Bench::new(preferring(Some("main"), None));
        // Silent for half a second, then well for three seconds.
        for i in 0..900 {
            let answers = if i % 52 < 8 { &BOTH[1..] } else { &BOTH[..] };
            bench.frame(i * PERIOD, answers);
        }
        // A minute of it: without doubt it would be 34 changes.
        assert!((3..=6).contains(&bench.selection.changes()), "{}", bench.selection.changes());
    }

    #[test]
    fn slow_and_late_ones_give_way_and_are_better_than_none() {
        let mut bench = Bench::new(preferring(None, None));
        bench.frames(0..20, &[("main", 250 * MS)]);
        assert_eq!(bench.selection.active(), Some("main"), "a late one is better than none");
        bench.frames(20..25, &[("main", 250 * MS), ("spare", 30 * MS)]);
        assert_eq!(bench.selection.active(), Some("spare"));
        assert!(bench.selection.why().contains("main: its frames are 250 ms old"));
        let mut bench = Bench::new(preferring(None, None));
        for i in 0..100 {
            let slow = i % 7 == 0;
            bench.frame(i * PERIOD, if slow { &BOTH[..1] } else { &[] });
        }
        assert_eq!(bench.selection.active(), Some("main"));
        bench.frames(100..110, &BOTH[1..]);
        assert_eq!(bench.selection.active(), Some("spare"));
    }

    #[test]
    fn one_that_sees_the_marker_elsewhere_is_not_taken_unless_it_is_named() {
        let mut bench = Bench::new(preferring(None, Some(Place::Ground)));
        bench.selection.introduced(0, "spare", Place::Ground);
        let at = |x: f64| Some(Sight { place_m: Some([x, 0.0, 5.0]) });
        bench.frames(0..2, &BOTH[..1]);
        for i in 2..100 {
            bench
                .frame_seen(i * PERIOD, &[("main", 30 * MS, at(0.0)), ("spare", 35 * MS, at(0.8))]);
        }
        assert_eq!(bench.selection.active(), Some("main"));
        let spare = bench.selection.candidates(bench.now_ns).swap_remove(0);
        assert_eq!((spare.compared, spare.agreed), (COMPARED as u32, 0));
        assert!((spare.disagreement_m.unwrap() - 0.8).abs() < 1e-9);
        let answer = bench.selection.prefer(bench.now_ns, "spare").unwrap();
        assert!(answer.contains("although it agrees with the active one in 0 of 30"), "{answer}");
        assert_eq!(bench.selection.active(), Some("spare"));
    }

    #[test]
    fn where_the_active_one_sees_nothing_agreement_is_not_concluded() {
        let mut bench = Bench::new(preferring(None, None));
        let seen = Some(Sight { place_m: None });
        for i in 0..20 {
            bench.frame_seen(i * PERIOD, &[("main", 30 * MS, None), ("spare", 35 * MS, seen)]);
        }
        let compared = |bench: &Bench| {
            let spare = bench.selection.candidates(bench.now_ns).pop().unwrap();
            (spare.compared, spare.agreed)
        };
        assert_eq!(compared(&bench), (0, 0));
        for i in 20..30 {
            bench.frame_seen(i * PERIOD, &[("main", 30 * MS, seen), ("spare", 35 * MS, None)]);
        }
        assert_eq!(compared(&bench), (10, 0));
        for i in 30..40 {
            bench.frame_seen(i * PERIOD, &[("spare", 20 * MS, seen), ("main", 30 * MS, seen)]);
        }
        assert_eq!(compared(&bench), (20, 10));
    }

    #[test]
    fn a_word_from_before_its_end_brings_no_detector_back() {
        let mut bench = Bench::new(preferring(None, None));
        bench.frames(0..10, &BOTH[..1]);
        bench.gone("main");
        assert!(bench.selection.is_blind());
        bench.selection.heard(bench.now_ns + MS, "main", bench.now_ns - MS, None);
        assert!(bench.selection.is_blind());
        bench.selection.heard(bench.now_ns + 90 * MS, "main", bench.now_ns + 50 * MS, None);
        assert!(!bench.selection.is_blind());
    }

    #[test]
    fn those_that_left_are_forgotten_and_a_flood_of_names_is_bounded() {
        let mut selection = preferring(None, None);
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

    /// What can happen, after some time.
    #[derive(Clone, Debug)]
    enum Happening {
        Heard { who: usize, stamp_ago_ms: i64, seen: bool },
        Presence { who: usize, alive: bool },
        Prefer { who: usize },
        Place { ground: bool },
        Tick,
    }

    fn happening() -> impl Strategy<Value = (i64, Happening)> {
        let what = prop_oneof![
            6 => (0..5_usize, -20..400_i64, any::<bool>())
                .prop_map(|(who, stamp_ago_ms, seen)| Happening::Heard { who, stamp_ago_ms, seen }),
            1 => (0..5_usize, any::<bool>()).prop_map(|(who, alive)| Happening::Presence { who, alive }),
            1 => (0..5_usize).prop_map(|who| Happening::Prefer { who }),
            1 => any::<bool>().prop_map(|ground| Happening::Place { ground }),
            3 => Just(Happening::Tick),
        ];
        (0..120_i64, what)
    }

    const NAMES: [&str; 5] = ["a", "b", "c", "d", "e"];

    proptest! {
        #[test]
        fn whatever_happens_stamps_only_grow_and_the_active_one_is_known(
            happenings in prop::collection::vec(happening(), 1..400),
        ) {
            let mut bench = Bench::new(preferring(None, None));
            for (wait_ms, what) in happenings {
                bench.now_ns += wait_ms * MS;
                let now = bench.now_ns;
                match what {
                    Happening::Heard { who, stamp_ago_ms, seen } => {
                        let sight = seen.then_some(Sight { place_m: Some([0.0, 0.0, 3.0]) });
                        bench.selection.heard(now, NAMES[who], now - stamp_ago_ms * MS, sight);
                    }
                    Happening::Presence { who, alive } => bench.selection.presence(now, NAMES[who], alive),
                    Happening::Prefer { who } => drop(bench.selection.prefer(now, NAMES[who])),
                    Happening::Place { ground } => {
                        let place = if ground { Place::Ground } else { Place::Onboard };
                        bench.selection.introduced(now, NAMES[who_of(place)], place);
                        bench.selection.prefer_place(now, place);
                    }
                    Happening::Tick => bench.selection.tick(now),
                }
                bench.note();
                let active = bench.selection.active();
                prop_assert!(active.is_none_or(|name| bench.selection.knows(name)));
                prop_assert_eq!(bench.selection.is_blind(), bench.selection.known.iter().all(|k| !k.alive));
            }
        }

        #[test]
        fn without_orders_a_preferred_one_that_comes_and_goes_causes_few_changes(
            spells in prop::collection::vec((1..60_i64, 1..40_i64), 5..40),
        ) {
            let mut bench = Bench::new(preferring(Some("main"), None));
            let mut frame = 0;
            for (well, silent) in spells {
                bench.frames(frame..frame + well, &BOTH);
                bench.frames(frame + well..frame + well + silent, &BOTH[1..]);
                frame += well + silent;
            }
            // The delays double from 2 s: in any 30 s there are few returns, each after its delay.
            for (i, (at, name)) in bench.changes.iter().enumerate().skip(2) {
                if name == "main" {
                    prop_assert!(at - bench.changes[i - 1].0 >= 2_000 * MS - PERIOD, "{:?}", bench.changes);
                }
                let before = bench.changes.iter().filter(|(then, _)| (0..30_000 * MS).contains(&(at - then))).count();
                prop_assert!(before <= 12, "{:?}", bench.changes);
            }
            // The other one is always there, so no gap is long; the period of one that is heard now and then looks longer than
            // it is, but a silence has an end.
            let longest_ms = (LONGEST_SILENCE_NS + 2 * PERIOD) / MS;
            prop_assert!(bench.longest_gap_ms() <= longest_ms, "{} ms", bench.longest_gap_ms());
        }
    }

    fn who_of(place: Place) -> usize {
        match place {
            Place::Onboard => 0,
            Place::Ground => 1,
        }
    }
}
