//! Counts events, latencies, drops and errors of a service, which publishes them once a second as its health.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use messages::{Count, Health, Latency, Rate};

use crate::clock::{clock_name, host_name, now_ns};
use crate::identity::Identity;
use crate::stats;
use crate::version::version;

/// Number of recent latencies over which percentiles are taken.
pub const LATENCIES_KEPT: usize = 512;

/// Maximum number of keys whose unreadable payloads are counted each; those of further keys are counted together.
const MAX_KEYS: usize = 64;
/// The name of all further keys.
const OTHER_KEYS: &str = "other keys";
/// Minimum time between two lines of the log on unreadable payloads of one key, in nanoseconds.
const LOG_PERIOD_NS: i64 = 10_000_000_000;

/// Payloads of one key that could not be read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Unreadable {
    /// The key.
    pub key: String,
    /// How many.
    pub count: u64,
    /// Why the newest of them could not be read, and of how many bytes it was.
    pub why: String,
    /// How many were logged, and the time of the last log entry, in nanoseconds.
    logged: u64,
    logged_ns: i64,
}

/// Payloads of one key that could not be read and are to be logged now.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Unlogged {
    /// How many.
    pub count: u64,
    /// In which time, in seconds; `None` for the first ones of the key.
    pub period_s: Option<f64>,
}

/// Counters of a service, for all of its threads.
#[derive(Debug, Default)]
pub struct HealthCounters {
    inner: Mutex<Counters>,
}

#[derive(Debug, Default)]
struct Counters {
    rates: BTreeMap<&'static str, (u64, u64)>,
    latencies: BTreeMap<&'static str, VecDeque<f64>>,
    drops: BTreeMap<String, u64>,
    errors: BTreeMap<String, u64>,
    /// The newest failure of some reasons, as a text.
    newest: BTreeMap<&'static str, String>,
    unreadable: Vec<Unreadable>,
    /// How many of them there were.
    unreadable_count: u64,
    last_report_ns: Option<i64>,
}

impl HealthCounters {
    /// Counts an event.
    pub fn count(&self, name: &'static str) {
        self.lock().rates.entry(name).or_default().0 += 1;
    }

    /// Records a latency.
    pub fn latency(&self, name: &'static str, took: Duration) {
        let mut counters = self.lock();
        let kept = counters.latencies.entry(name).or_default();
        if kept.len() == LATENCIES_KEPT {
            kept.pop_front();
        }
        kept.push_back(took.as_secs_f64() * 1e3);
    }

    /// Counts a drop.
    pub fn dropped(&self, reason: &str) {
        self.dropped_times(reason, 1);
    }

    /// Counts several drops.
    pub fn dropped_times(&self, reason: &str, times: u64) {
        let mut counters = self.lock();
        match counters.drops.get_mut(reason) {
            Some(count) => *count += times,
            None => drop(counters.drops.insert(reason.to_owned(), times)),
        }
    }

    /// Counts a failure; true for the first one of this reason, which is the one to log.
    pub fn failed(&self, reason: &str) -> bool {
        self.failed_times(reason, 1)
    }

    /// Counts several failures; true when they are the first of this reason.
    pub fn failed_times(&self, reason: &str, times: u64) -> bool {
        let mut counters = self.lock();
        match counters.errors.get_mut(reason) {
            Some(count) => {
                *count += times;
                false
            }
            None => counters.errors.insert(reason.to_owned(), times).is_none(),
        }
    }

    /// The same, with a description, of which the newest is kept.
    pub fn failed_by(&self, reason: &'static str, description: String) -> bool {
        self.lock().newest.insert(reason, description);
        self.failed(reason)
    }

    /// The description of the newest failure of this reason, if it has one.
    pub fn newest(&self, reason: &str) -> Option<String> {
        self.lock().newest.get(reason).cloned()
    }

    /// Counts a payload that could not be read, by its key. Returns how many are not logged yet, if they are to be logged now.
    pub fn unreadable_payload(&self, now_ns: i64, key: &str, why: String) -> Option<Unlogged> {
        let mut counters = self.lock();
        counters.unreadable_count += 1;
        let all = &mut counters.unreadable;
        let known = all.iter().position(|it| it.key == key);
        let others = || all.iter().position(|it| it.key == OTHER_KEYS);
        let index = known.or_else(|| others().filter(|_| all.len() > MAX_KEYS));
        let index = index.unwrap_or_else(|| {
            let key = if all.len() < MAX_KEYS { key } else { OTHER_KEYS }.to_owned();
            let (count, logged) = (0, 0);
            all.push(Unreadable { key, count, why: String::new(), logged, logged_ns: i64::MIN });
            all.len() - 1
        });
        let refused = all.get_mut(index)?;
        refused.count += 1;
        refused.why = why;
        if now_ns.saturating_sub(refused.logged_ns) < LOG_PERIOD_NS {
            return None;
        }
        let before_ns = std::mem::replace(&mut refused.logged_ns, now_ns);
        let period_ns = (refused.logged > 0).then(|| now_ns.saturating_sub(before_ns));
        let count = refused.count - std::mem::replace(&mut refused.logged, refused.count);
        Some(Unlogged { count, period_s: period_ns.map(|ns| ns as f64 * 1e-9) })
    }

    /// The payloads that could not be read so far, by key; `None` where there are no more than `known`, which becomes their number.
    pub fn more_unreadable(&self, known: &mut u64) -> Option<Vec<Unreadable>> {
        let counters = self.lock();
        let before = std::mem::replace(known, counters.unreadable_count);
        (counters.unreadable_count > before).then(|| counters.unreadable.clone())
    }

    /// Failures of this reason so far.
    pub fn failures(&self, reason: &str) -> u64 {
        self.lock().errors.get(reason).copied().unwrap_or(0)
    }

    /// Median and 99th percentile of a latency, in milliseconds.
    pub fn percentiles(&self, name: &'static str) -> Option<[f64; 2]> {
        self.lock().latencies.get(name).and_then(percentiles)
    }

    /// The current health.
    pub fn report(&self, identity: &Identity, started_ns: i64) -> Health {
        let now = now_ns();
        let mut counters = self.lock();
        let since = counters.last_report_ns.replace(now).unwrap_or(started_ns);
        let period_s = ((now - since) as f64 * 1e-9).max(1e-3);
        let rates = counters
            .rates
            .iter_mut()
            .map(|(name, (count, reported))| {
                let hz = (*count - *reported) as f64 / period_s;
                *reported = *count;
                Rate { name: (*name).to_owned(), count: *count, hz }
            })
            .collect();
        let latencies = counters
            .latencies
            .iter()
            .filter_map(|(name, kept)| {
                let [p50_ms, p99_ms] = percentiles(kept)?;
                Some(Latency { name: (*name).to_owned(), p50_ms, p99_ms })
            })
            .collect();
        let unreadable = counters.unreadable.iter().map(|it| Count {
            reason: format!("payload on {} that cannot be read", it.key),
            count: it.count,
        });
        Health {
            service: identity.service.to_owned(),
            instance: identity.instance.clone(),
            host: host_name(),
            version: version().to_owned(),
            clock: clock_name().to_owned(),
            stamp_ns: now,
            pid: std::process::id(),
            cpu_s: process_cpu_s(),
            uptime_s: (now - started_ns) as f64 * 1e-9,
            rates,
            latencies,
            drops: counts(&counters.drops),
            errors: counts(&counters.errors).into_iter().chain(unreadable).collect(),
        }
    }

    // The counts stay valid when a thread panics while counting.
    fn lock(&self) -> MutexGuard<'_, Counters> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn counts(counts: &BTreeMap<String, u64>) -> Vec<Count> {
    counts.iter().map(|(reason, count)| Count { reason: reason.clone(), count: *count }).collect()
}

fn percentiles(kept: &VecDeque<f64>) -> Option<[f64; 2]> {
    let kept: Vec<f64> = kept.iter().copied().collect();
    let at = |fraction: f64| stats::quantile(&kept, fraction);
    Some([at(0.5)?, at(0.99)?])
}

/// Processor time used by this process (user and system), in seconds.
fn process_cpu_s() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_report_contains_all_counts() {
        let counters = HealthCounters::default();
        for ms in 1..=100 {
            counters.count("frames");
            counters.latency("detect", Duration::from_millis(ms));
        }
        counters.dropped("late");
        assert!(counters.failed("damaged"));
        assert!(!counters.failed("damaged"));
        let identity = Identity { service: "detector", instance: "main".into() };
        let health = counters.report(&identity, now_ns() - 1_000_000_000);
        assert_eq!(
            (health.rates[0].count, health.drops[0].count, health.errors[0].count),
            (100, 1, 2)
        );
        assert!((health.rates[0].hz - 100.0).abs() < 5.0);
        assert!(
            (health.latencies[0].p50_ms - 51.0).abs() < 1.0 && health.latencies[0].p99_ms >= 98.0
        );
        assert!(counters.percentiles("none").is_none());
        assert!(counters.failed_by("too long", "5 m".into()));
        assert!(!counters.failed_by("too long", "6 m".into()));
        assert_eq!(
            (counters.newest("too long"), counters.newest("late")),
            (Some("6 m".into()), None)
        );
        assert_eq!(counters.failures("too long"), 2);
    }

    #[test]
    fn unreadable_payloads_are_counted_by_key_and_logged_now_and_then() {
        let counters = HealthCounters::default();
        let mut logged = Vec::new();
        for tenth in 0..250 {
            let now_ns = tenth * 100_000_000;
            let unlogged =
                counters.unreadable_payload(now_ns, "detector/a/detections", "why".into());
            logged.extend(unlogged.map(|it| (tenth, it.count, it.period_s)));
        }
        assert_eq!(logged, [(0, 1, None), (100, 100, Some(10.0)), (200, 100, Some(10.0))]);
        let unlogged = counters.unreadable_payload(1, "detector/b/detections", "cut".into());
        assert_eq!(unlogged.map(|it| it.count), Some(1), "another key is logged at once");
        for i in 0..1000 {
            counters.unreadable_payload(1, &format!("{i}"), String::new());
        }
        let mut known = 0;
        let all = counters.more_unreadable(&mut known).unwrap();
        assert_eq!((known, counters.more_unreadable(&mut known)), (1251, None), "once");
        counters.unreadable_payload(1, "detector/b/detections", "cut".into());
        assert!(counters.more_unreadable(&mut known).is_some());
        assert_eq!(all.len(), MAX_KEYS + 1);
        assert_eq!((all[0].count, all[1].why.as_str()), (250, "cut"));
        assert_eq!(all.last().map(|it| it.count), Some(1000 - MAX_KEYS as u64 + 2));
        let identity = Identity { service: "controller", instance: "main".into() };
        let errors = counters.report(&identity, 0).errors;
        let reason = "payload on detector/a/detections that cannot be read";
        assert!(errors.iter().any(|it| it.reason == reason && it.count == 250), "{errors:?}");
    }
}
