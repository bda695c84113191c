//! Detects that this process was stopped a moment ago: frozen, or its host asleep or overloaded.

use std::time::Duration;

/// Shortest pause between two steps of a loop with a quick tick that is a standstill, in nanoseconds.
const MIN_PAUSE_NS: i64 = 1_000_000_000;
/// Time after it in which arriving messages may have waited in sockets and mailboxes, in nanoseconds.
const AFTERMATH_NS: i64 = 1_000_000_000;

/// The steps of a loop that takes several each second.
#[derive(Clone, Debug, Default)]
pub struct Standstill {
    stepped_ns: Option<i64>,
    /// When the last one ended, and how long it was.
    last: Option<(i64, Duration)>,
}

impl Standstill {
    /// The loop continues; returns the length of a standstill that ended just now, so that arriving messages may be old.
    pub fn step(&mut self, now_ns: i64) -> Option<Duration> {
        let before_ns = self.stepped_ns.replace(now_ns).unwrap_or(now_ns);
        let pause_ns = now_ns.saturating_sub(before_ns);
        if pause_ns >= MIN_PAUSE_NS {
            self.last = Some((now_ns, Duration::from_nanos(pause_ns.unsigned_abs())));
        }
        self.last.take_if(|(ended_ns, _)| now_ns.saturating_sub(*ended_ns) > AFTERMATH_NS);
        self.last.map(|(_, pause)| pause)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    #[test]
    fn messages_just_after_a_standstill_may_be_old() {
        let mut loop_ = Standstill::default();
        assert_eq!(loop_.step(9_000_000 * MS), None, "the first step");
        for ms in (0..2000).step_by(200) {
            assert_eq!(loop_.step((9_000_000 + ms) * MS), None);
        }
        let frozen = Some(Duration::from_millis(5200));
        assert_eq!(loop_.step(9_007_000 * MS), frozen);
        assert_eq!(loop_.step(9_007_900 * MS), frozen);
        assert_eq!(loop_.step(9_008_100 * MS), None);
    }
}
