//! Selects the active detector: of the healthy ones (rate, latency, silence, agreement with others on where the marker is, and its
//! heading where the vehicle turns to it) the one that the operator prefers; one that fails often is trusted again more slowly.
//!
//! A function of time and of the messages received. Another detector becomes the active one when the active
//! one is gone, silent, late or slow and the other is not, or when the operator prefers the other and it has
//! been healthy for a while. The next frame is always the active detector's newest, and only if it is newer
//! than all before: so a crash, an operator's choice and a swap take the same path, and no stamp is used that
//! is older than the last.

use std::collections::VecDeque;

use messages::{Candidate, DetectorState, Place};

use crate::agreement::{
    self, Dispute, Fault, Sight, Sights, Tolerance, Voter, distance, turned, within,
};
use crate::refusals::Warning;

/// Silence after which a detector that has gone is forgotten, in nanoseconds.
const GONE_TIMEOUT_NS: i64 = 10_000_000_000;
/// Silence after which a detector whose presence was not withdrawn is forgotten, until its next message, in
/// nanoseconds.
const SILENT_TIMEOUT_NS: i64 = 60_000_000_000;
/// Maximum length of a service's name, in bytes.
const MAX_NAME_BYTES: usize = 64;
/// Maximum number of detectors; of more, the better ones are kept.
pub const MAX_DETECTORS: usize = 64;
/// Maximum number of frames and intervals kept for each detector.
const MAX_SAMPLES: usize = 16;
/// Time for which the markers of a detector's frames are kept, in nanoseconds: another one may search few of them, and later.
const SIGHTS_NS: i64 = 4_000_000_000;
/// Number of those frames, whatever that time: at least, at most, and of all detectors together, as their comparison takes time.
const MIN_SIGHTS: usize = 32;
const MAX_SIGHTS: usize = 300;
const MAX_ALL_SIGHTS: usize = MIN_SIGHTS * MAX_DETECTORS;
/// Maximum number of detectors that are warned of.
const MAX_WARNINGS: usize = 4;
/// Duration of the warning that there is no room for a name, in nanoseconds.
const CROWDED_NS: i64 = 5_000_000_000;
/// Maximum number of comparisons with the active detector kept for each detector.
pub const MAX_VERDICTS: usize = 30;
/// Minimum number of comparisons, or of frame intervals, for a conclusion.
const MIN_SAMPLES: usize = 8;
/// Silence timeout, in frame periods of the detector. One lost frame makes an interval of 2 periods; after 3
/// another detector must be active.
const SILENT_PERIODS: f64 = 2.25;
/// Period assumed for a detector with too few frames, in nanoseconds.
const UNKNOWN_PERIOD_NS: i64 = 100_000_000;
/// Minimum silence timeout, in nanoseconds: the scheduler of a busy machine causes shorter gaps.
pub const MIN_SILENCE_NS: i64 = 50_000_000;
/// Maximum silence timeout, in nanoseconds.
pub const MAX_SILENCE_NS: i64 = 1_000_000_000;
/// Each failure doubles the time after which a detector is trusted again, at most this many times.
const MAX_DOUBLINGS: u32 = 5;
/// Time without a failure after which the failures are forgotten, in nanoseconds.
const FAILURE_MEMORY_NS: i64 = 60_000_000_000;

/// Limits of a healthy detector.
#[derive(Copy, Clone, Debug)]
pub struct Limits {
    /// Maximum median time from exposure to arrival, in seconds.
    pub max_age_s: f64,
    /// Maximum age of a frame on arrival that is used, in seconds: a detector with a larger median has no say in where the marker is.
    pub max_latency_s: f64,
    /// Minimum median rate, in Hz.
    pub min_rate_hz: f64,
    /// Time for which a preferred detector must have been healthy before it is used, in seconds.
    pub return_after_s: f64,
    /// Maximum differences between the markers of two detectors that agree.
    pub tolerance: Tolerance,
    /// Whether one without poses leads no landing.
    pub needs_pose: bool,
    /// Time for which a detector must give no pose before it is reported, in seconds.
    pub no_pose_after_s: f64,
}

/// The rank of a detector when there is no room for all; a better one takes the place of a worse one.
#[derive(Copy, Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Worth {
    /// It has gone.
    Nothing,
    /// It is there.
    Present,
    /// It searches frames.
    Answers,
    /// It sees the marker.
    Sees,
    /// It is used, or preferred.
    Preferred,
}

/// The operator's preference.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Preference {
    /// This detector first.
    pub detector: Option<String>,
    /// Then those that run there.
    pub place: Option<Place>,
}

/// The known detectors and the active one.
#[derive(Debug)]
pub struct Selection {
    limits: Limits,
    preference: Preference,
    /// True until the operator's latest choice was followed: it does not wait for trust.
    is_requested: bool,
    active: Option<String>,
    known: Vec<Known>,
    newest_used_ns: i64,
    changes: u64,
    why: String,
    /// Another detector that sees the marker elsewhere.
    dispute: Option<Dispute>,
    /// Detectors against which the operator has chosen the preferred one.
    overruled: Vec<String>,
    /// When there was no room for a further name.
    crowded_ns: Option<i64>,
}

#[derive(Debug)]
struct Known {
    name: String,
    place: Option<Place>,
    alive: bool,
    /// When its presence ended: only a later frame shows that it is alive.
    gone_ns: i64,
    /// Stamp of its newest frame; `i64::MIN` before the first.
    stamp_ns: i64,
    received_ns: i64,
    /// Since when another detector has had a newer frame.
    overtaken_ns: Option<i64>,
    /// Since when it has been healthy without a break.
    healthy_ns: Option<i64>,
    failures: u32,
    failed_ns: i64,
    intervals_ns: VecDeque<i64>,
    latencies_ns: VecDeque<i64>,
    sights: Sights,
    verdicts: VecDeque<bool>,
    disagreement_m: Option<f64>,
    /// Why it is not believed although it answers.
    fault: Option<Fault>,
    /// Since when it has given no pose.
    no_pose_ns: Option<i64>,
}

impl Selection {
    /// No detector is known yet.
    pub fn new(limits: Limits, preference: Preference) -> Self {
        Self {
            limits,
            preference,
            is_requested: false,
            active: None,
            known: Vec::new(),
            newest_used_ns: i64::MIN,
            changes: 0,
            why: "no detector yet".to_owned(),
            dispute: None,
            overruled: Vec::new(),
            crowded_ns: None,
        }
    }

    /// Registers the detections of the frame with this stamp, and the wanted marker in them; true when they
    /// are the newest of this detector.
    pub fn received(
        &mut self,
        now_ns: i64,
        name: &str,
        stamp_ns: i64,
        sight: Option<Sight>,
    ) -> bool {
        let others_ns = self.newest_of_others_ns(name);
        let share = MAX_ALL_SIGHTS / self.known.len().max(1);
        let worth = if sight.is_some() { Worth::Sees } else { Worth::Answers };
        let Some(known) = self.known_mut(now_ns, name, worth) else { return false };
        let is_newer = stamp_ns > known.stamp_ns;
        if is_newer {
            known.take(now_ns, stamp_ns, others_ns);
            known.keep_sight(stamp_ns, sight, share.clamp(MIN_SIGHTS, MAX_SIGHTS));
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
        let worth = if alive { Worth::Present } else { Worth::Nothing };
        if let Some(known) = self.known_mut(now_ns, name, worth) {
            known.alive = alive;
            known.gone_ns = if alive { i64::MIN } else { now_ns };
        }
        self.choose(now_ns);
    }

    /// Sets where a detector runs.
    pub fn set_place(&mut self, now_ns: i64, name: &str, place: Place) {
        if let Some(known) = self.known_mut(now_ns, name, Worth::Present) {
            known.place = Some(place);
        }
        self.choose(now_ns);
    }

    /// Prefers a detector while it is healthy; the answer states the present consequence.
    ///
    /// # Errors
    /// Names the known detectors when it is not among them, or has gone.
    pub fn prefer(&mut self, now_ns: i64, name: &str) -> Result<String, String> {
        let Some(known) = self.known.iter().find(|known| known.name == name) else {
            let names: Vec<_> = self.known.iter().map(|known| known.name.as_str()).collect();
            let known = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
            return Err(format!("no detector `{name}`; known detectors: {known}"));
        };
        if !known.alive {
            return Err(format!("detector `{name}` has gone"));
        }
        let trouble = self.trouble(now_ns, known);
        let doubt = known.doubt();
        self.preference.detector = Some(name.to_owned());
        self.is_requested = true;
        // By naming one while two disagree the operator has decided.
        self.overruled = self.in_dispute().filter(|other| other != name).collect();
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

    /// Prefers detectors that run at a place while they are healthy; the answer states the present consequence.
    pub fn prefer_place(&mut self, now_ns: i64, place: Place) -> String {
        self.preference = Preference { detector: None, place: Some(place) };
        self.overruled.clear();
        self.is_requested = true;
        self.choose(now_ns);
        let there: Vec<_> = self.known.iter().filter(|known| known.place == Some(place)).collect();
        let healthy = there.iter().filter(|known| self.trouble(now_ns, known).is_none()).count();
        let place = place.name();
        match (there.len(), healthy) {
            (0, _) => format!("{place} detectors are preferred; there is none yet"),
            (_, 0) => format!("{place} detectors are preferred; none of them is healthy yet"),
            _ => format!("{place} detectors are preferred"),
        }
    }

    /// Prefers no detector to another; the answer states the present consequence.
    pub fn prefer_any(&mut self, now_ns: i64) -> String {
        self.preference = Preference::default();
        self.overruled.clear();
        self.is_requested = false;
        self.choose(now_ns);
        self.active().map_or_else(
            || "no detector is preferred".to_owned(),
            |active| format!("no detector is preferred; `{active}` is used while it is healthy"),
        )
    }

    /// Lets time pass.
    pub fn tick(&mut self, now_ns: i64) {
        let is_there = self.known_active().is_some_and(|active| active.alive);
        self.known.retain(|known| {
            let timeout_ns = if known.alive { SILENT_TIMEOUT_NS } else { GONE_TIMEOUT_NS };
            now_ns.saturating_sub(known.received_ns) < timeout_ns
        });
        self.compare_all(now_ns);
        self.choose(now_ns);
        if is_there && self.active.is_none() {
            let silence_s = SILENT_TIMEOUT_NS / 1_000_000_000;
            self.why = format!("the last one has not searched a frame for {silence_s} s");
        }
    }

    /// The frame to be used now, by its detector and stamp: the active detector's newest, if it is newer than
    /// all that were used. To be called after each of the functions above.
    pub fn next_frame(&mut self) -> Option<(String, i64)> {
        let active = self.known_active()?;
        let frame = (active.name.clone(), active.stamp_ns);
        (frame.1 > self.newest_used_ns).then(|| {
            self.newest_used_ns = frame.1;
            frame
        })
    }

    /// The active detector.
    pub fn active(&self) -> Option<&str> {
        self.active.as_deref()
    }

    /// Why it is the active one.
    pub fn why(&self) -> &str {
        &self.why
    }

    /// Number of changes of the active detector.
    pub fn changes(&self) -> u64 {
        self.changes
    }

    /// The preference: a detector's name or a place; empty for none.
    pub fn preference(&self) -> &str {
        let Preference { detector, place } = &self.preference;
        detector.as_deref().or(place.map(Place::name)).unwrap_or_default()
    }

    /// True when no detector is alive: there will be no detections until one comes.
    pub fn is_blind(&self) -> bool {
        !self.known.iter().any(|known| known.alive)
    }

    /// A detector that sees the marker elsewhere than the active one or turned, while it is not decided which is right.
    pub fn dispute(&self) -> Option<&Dispute> {
        self.dispute.as_ref()
    }

    /// That the detector in use gives no pose, without which nothing descends, once that is more than a start: its first frames may come
    /// before the calibration.
    pub fn no_pose(&self, now_ns: i64) -> Option<String> {
        let active = self.known_active().filter(|active| self.lacks_pose(now_ns, active));
        active.map(|active| without_pose(&active.name))
    }

    /// Whether a detector has given no pose for long enough to be reported.
    fn lacks_pose(&self, now_ns: i64, known: &Known) -> bool {
        let since_ns = known.no_pose_ns.filter(|_| known.fault == Some(Fault::NoPose));
        since_ns.is_some_and(|since_ns| {
            now_ns.saturating_sub(since_ns) as f64 * 1e-9 >= self.limits.no_pose_after_s
        })
    }

    /// The warnings of the detectors for the operator.
    pub fn warnings(&self, now_ns: i64) -> Vec<Warning> {
        let mut warnings = Vec::new();
        let mut warn = |matter: String, text: String| warnings.push(Warning { matter, text });
        if let Some(Dispute { active, other, apart_m, turned_rad }) = &self.dispute {
            let turned = said_turned(*turned_rad);
            // The same pair, whichever of the two is used.
            let [first, second] = [active.min(other), active.max(other)];
            warn(
                format!("dispute {first} {second}"),
                format!(
                    "detectors `{active}` (used) and `{other}` see the marker {apart_m:.2} m apart{turned}; stop the wrong one, or name the right one (`alight detectors use`)"
                ),
            );
        }
        let faulty = self.known.iter().filter_map(|known| Some((known, known.fault.as_ref()?)));
        for (known, fault) in faulty.take(MAX_WARNINGS) {
            let (name, is_preferred) = (&known.name, self.rank(known) == 2);
            match fault {
                Fault::Outvoted { .. } => {
                    let text = format!("detector `{name}` is not used: {}", said(fault));
                    warn(format!("outvoted {name}"), text);
                }
                Fault::Blind { .. } if is_preferred => {
                    let text =
                        format!("the preferred detector `{name}` is passed over: {}", said(fault));
                    warn(format!("blind {name}"), text);
                }
                Fault::Blind { .. } => {}
                Fault::NoPose if self.lacks_pose(now_ns, known) => {
                    warn(format!("no pose {name}"), without_pose(name));
                }
                Fault::NoPose => {}
            }
        }
        // It is used where no other is better. Between its frames it counts as silent.
        if let Some(known) = self.known.iter().find(|known| self.active() == Some(&*known.name))
            && let Some(rate_hz) = self.too_slow_hz(known)
            && known.alive
        {
            let (name, min_hz) = (&known.name, self.limits.min_rate_hz);
            let text = format!(
                "detector `{name}` searches only {rate_hz:.1} frames per second, and {min_hz} are needed (`detectors.min_rate_hz`); search the newest frame only, with \
                 fewer pixels or a faster program, and publish also if nothing was found"
            );
            warn(format!("slow {name}"), text);
        }
        if self.crowded_ns.is_some_and(|at| now_ns.saturating_sub(at) < CROWDED_NS) {
            let text = format!(
                "more than {MAX_DETECTORS} detectors announce themselves; the others are ignored"
            );
            warn("crowded".to_owned(), text);
        }
        warnings
    }

    /// True for a known detector.
    pub fn knows(&self, name: &str) -> bool {
        self.known.iter().any(|known| known.name == name)
    }

    /// The detectors that are alive, and whether each has seen the marker lately.
    pub fn alive(&self) -> impl Iterator<Item = (&str, bool)> {
        let alive = self.known.iter().filter(|known| known.alive);
        alive.map(|known| {
            (known.name.as_str(), known.sights.iter().any(|(_, sight)| sight.is_some()))
        })
    }

    /// True when a detector has a newer frame than the last one used.
    pub fn has_newer(&self) -> bool {
        self.known.iter().any(|known| known.alive && known.stamp_ns > self.newest_used_ns)
    }

    /// All detectors that have searched a frame.
    pub fn candidates(&self, now_ns: i64) -> Vec<Candidate> {
        let candidate = |known: &Known| Candidate {
            detector: known.name.clone(),
            state: match (self.ailment(now_ns, known), &known.fault) {
                (Some(_), _) => DetectorState::Stale,
                (None, Some(Fault::Blind { .. })) => DetectorState::Blind,
                (None, Some(Fault::NoPose)) => DetectorState::NoPose,
                (None, Some(Fault::Outvoted { .. })) => DetectorState::Outvoted,
                (None, None) if self.active.as_ref() == Some(&known.name) => DetectorState::Active,
                (None, None) => DetectorState::Shadow,
            },
            place: known.place,
            age_ms: now_ns.saturating_sub(known.stamp_ns) as f64 * 1e-6,
            latency_ms: known.latency_s() * 1e3,
            rate_hz: known.rate_hz(),
            alive: known.alive,
            disagreement_m: known.disagreement_m,
            compared: known.verdicts.len() as u32,
            agreed: known.agreed() as u32,
        };
        self.known.iter().filter(|known| known.has_frame()).map(candidate).collect()
    }

    fn known_active(&self) -> Option<&Known> {
        let active = self.active.as_ref()?;
        self.known.iter().find(|known| known.name == *active)
    }

    fn newest_of_others_ns(&self, name: &str) -> i64 {
        let others = self.known.iter().filter(|known| known.name != name && known.alive);
        others.map(|known| known.stamp_ns).max().unwrap_or(i64::MIN)
    }

    fn known_mut(&mut self, now_ns: i64, name: &str, worth: Worth) -> Option<&mut Known> {
        if let Some(index) = self.known.iter().position(|known| known.name == name) {
            return self.known.get_mut(index);
        }
        if name.is_empty() || name.len() > MAX_NAME_BYTES {
            return None;
        }
        if self.known.len() >= MAX_DETECTORS {
            self.crowded_ns = Some(now_ns);
            let is_preferred = self.preference.detector.as_deref() == Some(name);
            let worth = if is_preferred { Worth::Preferred } else { worth };
            let worths = self.known.iter().map(|known| self.worth(now_ns, known)).enumerate();
            let (index, _) =
                worths.min_by_key(|(_, worth)| *worth).filter(|(_, it)| *it < worth)?;
            self.known.swap_remove(index);
        }
        self.known.push(Known::new(now_ns, name));
        self.known.last_mut()
    }

    /// The rank of a known detector when there is no room for another.
    fn worth(&self, now_ns: i64, known: &Known) -> Worth {
        let is_recent = now_ns.saturating_sub(known.received_ns) <= MAX_SILENCE_NS;
        if self.active.as_ref() == Some(&known.name)
            || self.preference.detector.as_ref() == Some(&known.name)
        {
            Worth::Preferred
        } else if known.alive && is_recent && known.sights.iter().any(|(_, sight)| sight.is_some())
        {
            Worth::Sees
        } else if known.alive && is_recent && known.has_frame() {
            Worth::Answers
        } else if known.alive {
            Worth::Present
        } else {
            Worth::Nothing
        }
    }

    /// Compares the markers that all answering detectors saw in the same frames.
    fn compare_all(&mut self, now_ns: i64) {
        let tolerance = self.limits.tolerance;
        let answers: Vec<bool> =
            self.known.iter().map(|known| self.has_opinion(now_ns, known)).collect();
        let voters: Vec<Voter<'_>> = self
            .known
            .iter()
            .zip(&answers)
            .filter(|(_, answers)| **answers)
            .map(|(known, _)| known.voter())
            .collect();
        let mut faults = agreement::faults(&voters, tolerance).into_iter();
        let found: Vec<Option<Fault>> = answers
            .iter()
            .map(|answers| if *answers { faults.next().flatten() } else { None })
            .collect();
        let needs_pose = self.limits.needs_pose;
        for ((known, fault), answers) in self.known.iter_mut().zip(found).zip(answers) {
            let lacks_pose = answers && needs_pose && agreement::gives_no_pose(&known.sights);
            known.fault = fault.or(lacks_pose.then_some(Fault::NoPose));
            known.no_pose_ns = lacks_pose.then(|| known.no_pose_ns.unwrap_or(now_ns));
        }
        self.dispute = self.present_dispute(now_ns, tolerance);
    }

    /// The dispute between the active detector and another one. It persists until they agree: where neither sees
    /// the marker, or one is silent, nothing is decided.
    fn present_dispute(&self, now_ns: i64, tolerance: Tolerance) -> Option<Dispute> {
        let active = self.known_active()?;
        if active.fault.is_some() || self.is_too_late(active) {
            return None;
        }
        let is_opponent = |known: &&Known| {
            known.name != active.name
                && known.alive
                && !self.is_too_late(known)
                && !self.overruled.contains(&known.name)
                && !matches!(known.fault, Some(Fault::Outvoted { .. }))
        };
        let answers =
            self.known.iter().filter(is_opponent).filter(|it| self.has_opinion(now_ns, it));
        let others: Vec<Voter<'_>> = answers.map(Known::voter).collect();
        if let Some(dispute) = agreement::dispute(active.voter(), &others, tolerance) {
            return Some(dispute);
        }
        let last = self.dispute.as_ref()?;
        let other = if last.active == active.name { &last.other } else { &last.active };
        let opponent = self.known.iter().filter(is_opponent).find(|known| known.name == *other)?;
        let is_over = opponent.fault.is_some()
            || agreement::agree_again(active.voter(), opponent.voter(), tolerance)
            || ![&last.active, &last.other].contains(&&active.name);
        (!is_over).then(|| Dispute {
            active: active.name.clone(),
            other: opponent.name.clone(),
            apart_m: last.apart_m,
            turned_rad: last.turned_rad,
        })
    }

    /// Both detectors of a dispute.
    fn in_dispute(&self) -> impl Iterator<Item = String> + use<> {
        let names = self.dispute.as_ref().map(|it| [it.active.clone(), it.other.clone()]);
        names.into_iter().flatten()
    }

    /// Compares the markers in one frame: the active detector's with all others', or another's with
    /// the active one's.
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

    /// True while a detector searches frames: late detections count as well, up to the age at which none is used.
    fn has_opinion(&self, now_ns: i64, known: &Known) -> bool {
        let is_silent = now_ns.saturating_sub(known.received_ns) > MAX_SILENCE_NS;
        known.alive && known.has_frame() && !is_silent && !self.is_too_late(known)
    }

    /// Whether a detector's frames are too old to be used: their stamps may be those of other frames.
    fn is_too_late(&self, known: &Known) -> bool {
        known.latency_s() > self.limits.max_latency_s
    }

    /// Why a detector is not healthy, or not believed.
    fn trouble(&self, now_ns: i64, known: &Known) -> Option<String> {
        self.ailment(now_ns, known).or_else(|| known.fault.as_ref().map(said))
    }

    /// Why a detector is not healthy.
    fn ailment(&self, now_ns: i64, known: &Known) -> Option<String> {
        if !known.alive {
            return Some("it has left the network".to_owned());
        }
        if !known.has_frame() {
            return Some("it has not searched a frame yet".to_owned());
        }
        let silence_ns = now_ns.saturating_sub(known.received_ns);
        if silence_ns > known.silence_allowed_ns() {
            return Some(format!("it has been silent for {:.0} ms", silence_ns as f64 * 1e-6));
        }
        let latency_s = known.latency_s();
        if latency_s > self.limits.max_age_s {
            return Some(format!("its frames are {:.0} ms old", latency_s * 1e3));
        }
        let rate_hz = self.too_slow_hz(known)?;
        Some(format!("it searches only {rate_hz:.1} frames/s"))
    }

    /// How many frames a detector searches per second, where these are too few.
    fn too_slow_hz(&self, known: &Known) -> Option<f64> {
        let rate_hz = known.rate_hz();
        let is_slow = known.intervals_ns.len() >= MIN_SAMPLES && rate_hz < self.limits.min_rate_hz;
        is_slow.then_some(rate_hz)
    }

    /// Why the active detector is to be replaced. A silence counts only when another detector has a newer
    /// frame for a period: after a camera's pause the others may merely be faster.
    fn failure(&self, now_ns: i64, active: &Known) -> Option<String> {
        let trouble = self.trouble(now_ns, active)?;
        let is_silent = active.alive
            && active.has_frame()
            && now_ns.saturating_sub(active.received_ns) > active.silence_allowed_ns();
        let is_overtaken = active
            .overtaken_ns
            .is_some_and(|since| now_ns.saturating_sub(since) >= active.period_ns());
        (!is_silent || is_overtaken).then_some(trouble)
    }

    fn rank(&self, known: &Known) -> u8 {
        let is_named = self.preference.detector.as_ref() == Some(&known.name);
        let is_there = self.preference.place.is_some() && known.place == self.preference.place;
        match (is_named, is_there) {
            (true, _) => 2,
            (false, true) => 1,
            (false, false) => 0,
        }
    }

    fn is_trusted(&self, now_ns: i64, known: &Known) -> bool {
        let doublings = known.failures.saturating_sub(1).min(MAX_DOUBLINGS);
        let needed_s = self.limits.return_after_s * f64::from(1_u32 << doublings);
        let needed_ns = (needed_s * 1e9) as i64;
        known.healthy_ns.is_some_and(|since| now_ns.saturating_sub(since) >= needed_ns)
    }

    fn choose(&mut self, now_ns: i64) {
        self.follow_health(now_ns);
        let wanted = match &self.preference {
            Preference { detector: Some(_), .. } => 2,
            Preference { place: Some(_), .. } => 1,
            Preference { .. } => 0,
        };
        self.is_requested &= self.known_active().is_none_or(|active| self.rank(active) < wanted);
        let Some((name, why)) = self.choice(now_ns) else { return };
        let before = self.active.take();
        if let Some(before) = &before
            && let Some(known) = self.known.iter_mut().find(|known| known.name == *before)
            && known.healthy_ns.is_none()
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
        let is_healthy: Vec<bool> =
            self.known.iter().map(|known| self.trouble(now_ns, known).is_none()).collect();
        for (known, is_healthy) in self.known.iter_mut().zip(is_healthy) {
            known.healthy_ns = is_healthy.then(|| known.healthy_ns.unwrap_or(now_ns));
            if is_healthy && now_ns.saturating_sub(known.failed_ns) > FAILURE_MEMORY_NS {
                known.failures = 0;
            }
        }
        if self.active.is_some() && self.known_active().is_none() {
            self.active = None;
            self.why = "the last one has gone".to_owned();
        }
    }

    /// The detector that becomes the active one, and why.
    fn choice(&self, now_ns: i64) -> Option<(String, String)> {
        let active = self.known_active();
        let others = || {
            self.known
                .iter()
                .filter(|known| known.has_frame() && active.is_none_or(|a| a.name != known.name))
        };
        let healthy = || others().filter(|known| known.healthy_ns.is_some());
        let Some(active) = active else {
            // Where none is healthy, any live one is better than none; its frames are checked one by one.
            let order =
                |known: &&Known| (known.healthy_ns.is_some(), self.rank(known), known.stamp_ns);
            let first = others().filter(|known| known.alive).max_by_key(order)?;
            return Some((first.name.clone(), "it is the first".to_owned()));
        };
        if let Some(failure) = self.failure(now_ns, active) {
            // A detector that agreed with one that is not believed is no better.
            let is_believed = active.fault.is_none();
            let order = |known: &&Known| {
                (!is_believed || known.doubt().is_none(), self.rank(known), known.stamp_ns)
            };
            // A silent or late one stays while none is better; one that has gone is replaced by any live one.
            let next = healthy().max_by_key(order).or_else(|| {
                let alive = others().filter(|known| known.alive && !active.alive);
                alive.max_by_key(|known| known.stamp_ns)
            })?;
            return Some((
                next.name.clone(),
                format!("at the change from {}: {failure}", active.name),
            ));
        }
        let is_better = |known: &&Known| {
            let is_named = self.preference.detector.as_ref() == Some(&known.name);
            let is_agreed = known.doubt().is_none() || is_named;
            let is_trusted = self.is_requested || self.is_trusted(now_ns, known);
            self.rank(known) > self.rank(active) && is_agreed && is_trusted
        };
        let better = healthy().filter(is_better);
        let better = better.max_by_key(|known| (self.rank(known), known.stamp_ns))?;
        let why = match self.rank(better) {
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
            received_ns: now_ns,
            overtaken_ns: None,
            healthy_ns: None,
            failures: 0,
            failed_ns: i64::MIN,
            intervals_ns: VecDeque::new(),
            latencies_ns: VecDeque::new(),
            sights: VecDeque::new(),
            verdicts: VecDeque::new(),
            disagreement_m: None,
            fault: None,
            no_pose_ns: None,
        }
    }

    fn voter(&self) -> Voter<'_> {
        Voter { name: &self.name, sights: &self.sights }
    }

    /// Registers a newer frame.
    fn take(&mut self, now_ns: i64, stamp_ns: i64, others_ns: i64) {
        if self.has_frame() {
            keep(&mut self.intervals_ns, now_ns.saturating_sub(self.received_ns), MAX_SAMPLES);
        }
        keep(&mut self.latencies_ns, now_ns.saturating_sub(stamp_ns).max(0), MAX_SAMPLES / 2);
        self.received_ns = now_ns;
        self.stamp_ns = stamp_ns;
        self.overtaken_ns = (others_ns > stamp_ns).then_some(now_ns);
        self.alive |= stamp_ns > self.gone_ns;
    }

    /// Stores the marker of a newer frame, and forgets old ones.
    fn keep_sight(&mut self, stamp_ns: i64, sight: Option<Sight>, max: usize) {
        let is_old = |(old_ns, _): &(i64, _)| stamp_ns.saturating_sub(*old_ns) > SIGHTS_NS;
        while self.sights.len() > MIN_SIGHTS && self.sights.front().is_some_and(is_old) {
            self.sights.pop_front();
        }
        keep(&mut self.sights, (stamp_ns, sight), max);
    }

    fn has_frame(&self) -> bool {
        self.stamp_ns != i64::MIN
    }

    fn period_ns(&self) -> i64 {
        median(&self.intervals_ns).unwrap_or(UNKNOWN_PERIOD_NS)
    }

    fn rate_hz(&self) -> f64 {
        median(&self.intervals_ns).map_or(0.0, |period_ns| 1e9 / period_ns.max(1_000_000) as f64)
    }

    fn latency_s(&self) -> f64 {
        median(&self.latencies_ns).unwrap_or_default() as f64 * 1e-9
    }

    fn silence_allowed_ns(&self) -> i64 {
        let allowed_ns = (self.period_ns() as f64 * SILENT_PERIODS) as i64;
        allowed_ns.clamp(MIN_SILENCE_NS, MAX_SILENCE_NS)
    }

    fn sight_at(&self, stamp_ns: i64) -> Option<Option<Sight>> {
        // Only newer frames are taken, so they are in order.
        let index = self.sights.binary_search_by_key(&stamp_ns, |(stamp, _)| *stamp).ok()?;
        self.sights.get(index).map(|(_, sight)| *sight)
    }

    /// Compares this detector's marker in a frame with the active detector's. Without a marker from the
    /// active one there is no verdict.
    fn judge(&mut self, limits: &Limits, active: Option<Sight>, ours: Option<Sight>) {
        let Some(active) = active else { return };
        let Some(ours) = ours else { return keep(&mut self.verdicts, false, MAX_VERDICTS) };
        let agrees = match (active.position_m, ours.position_m) {
            (Some(active_m), Some(ours_m)) => {
                self.disagreement_m = Some(distance(active_m, ours_m));
                let tolerance = limits.tolerance;
                within(tolerance, active_m, ours_m) && turned(tolerance, active, ours).is_none()
            }
            // Without poses there is no distance; both see the marker.
            (None, None) => true,
            (Some(_), None) => false,
            (None, Some(_)) => return,
        };
        keep(&mut self.verdicts, agrees, MAX_VERDICTS);
    }

    fn agreed(&self) -> usize {
        self.verdicts.iter().filter(|agrees| **agrees).count()
    }

    /// Why it is not trusted although it is healthy.
    fn doubt(&self) -> Option<String> {
        let (agreed, compared) = (self.agreed(), self.verdicts.len());
        (compared >= MIN_SAMPLES && agreed * 2 < compared)
            .then(|| format!("it agrees with the active one in only {agreed} of {compared} frames"))
    }
}

fn keep<T>(kept: &mut VecDeque<T>, value: T, max: usize) {
    while kept.len() >= max {
        kept.pop_front();
    }
    kept.push_back(value);
}

fn median(values: &VecDeque<i64>) -> Option<i64> {
    let mut sorted: Vec<i64> = values.iter().copied().collect();
    sorted.sort_unstable();
    sorted.get(sorted.len() / 2).copied()
}

/// A fault as text.
fn said(fault: &Fault) -> String {
    match fault {
        Fault::Outvoted { by, apart_m, turned_rad } => {
            let turned = said_turned(*turned_rad);
            format!("{by} others see the marker {apart_m:.2} m from where it does{turned}")
        }
        Fault::Blind { seeing } => format!("it sees no marker where `{seeing}` sees one"),
        Fault::NoPose => "it gives no pose of the marker".to_owned(),
    }
}

/// The warning of a detector that gives no pose.
fn without_pose(name: &str) -> String {
    format!(
        "detector `{name}` gives no pose of the marker, only its place in the image, in three or more of four of its latest frames with the marker, and \
         the landing needs one: say the marker's size in the detector's `markers` (FAMILY:ID:SIZE_M), or calibrate the camera at this image size \
         (`alight calibrate`)"
    )
}

/// By how much headings differ, as the end of a clause on places.
fn said_turned(turned_rad: Option<f64>) -> String {
    turned_rad
        .map_or_else(String::new, |rad| format!(" and turned by {:.0} degrees", rad.to_degrees()))
}
