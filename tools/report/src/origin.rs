//! Gives the date, the duration and the size of a recording.

use std::ops::Range;
use std::time::{Duration, SystemTime};

use flightlog::{Received, is_state};

/// The first date that a clock can show which was ever set, in nanoseconds since 1970: in lock-step clocks begin at 0.
const MIN_UTC_NS: u64 = 1_000_000_000_000_000_000;

/// When a flight was recorded, and how large its files are.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Origin {
    /// Sizes of its files together, in bytes.
    pub bytes: u64,
    /// From the first message to the last, in nanoseconds of the recorder's clock; of earlier states at a file's begin none counts.
    pub received_ns: Option<Range<i64>>,
    /// Time since 1970 less that of the recorder's clock, in nanoseconds: with changes of the clock while a file was open.
    pub utc_offset_ns: Option<i64>,
}

impl Origin {
    /// Takes the next message.
    pub fn take(&mut self, message: Received<'_>) {
        if is_state(message.key) {
            return;
        }
        let at_ns = message.received_ns;
        self.received_ns = Some(match &self.received_ns {
            Some(so_far) => so_far.start.min(at_ns)..so_far.end.max(at_ns),
            None => at_ns..at_ns,
        });
    }

    /// The time that the recording covers, in seconds.
    pub fn length_s(&self) -> Option<f64> {
        let received_ns = self.received_ns.as_ref()?;
        Some(received_ns.end.saturating_sub(received_ns.start) as f64 * 1e-9)
    }

    /// A time of the recorder's clock as date and time of UTC, `2026-11-30T15:39:12Z`.
    pub fn utc(&self, at_ns: i64) -> Option<String> {
        let since_1970_ns = u64::try_from(at_ns.checked_add(self.utc_offset_ns?)?).ok()?;
        let since_1970 = Duration::from_nanos(Some(since_1970_ns).filter(|ns| *ns >= MIN_UTC_NS)?);
        let at = SystemTime::UNIX_EPOCH + since_1970;
        Some(humantime::format_rfc3339_seconds(at).to_string())
    }
}

/// A size in bytes, for people.
pub fn size(bytes: u64) -> String {
    match bytes {
        0..1_000_000 => format!("{} kB", bytes.div_ceil(1000)),
        _ => format!("{:.1} MB", bytes as f64 * 1e-6),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_that_was_never_set_has_no_date() {
        let origin = |utc_offset_ns| Origin { utc_offset_ns, ..Origin::default() };
        let at_ns = 1_000_000_000;
        let set = origin(Some(1_796_053_151_000_000_000)).utc(at_ns);
        assert_eq!(set.as_deref(), Some("2026-11-30T15:39:12Z"));
        assert_eq!([origin(Some(0)).utc(at_ns), origin(None).utc(at_ns)], [None, None]);
        assert_eq!(origin(Some(i64::MAX)).utc(at_ns), None);
    }

    #[test]
    fn sizes_are_short() {
        assert_eq!([0, 1, 50_408_544].map(size), ["0 kB", "1 kB", "50.4 MB"]);
    }
}
