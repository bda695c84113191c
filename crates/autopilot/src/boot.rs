//! The autopilot's time since its start: distinguishes a restart from packets that are late, replayed or wrong.
//!
//! After a restart every packet has an earlier time than before, and none comes from the old clock any more. A
//! single packet, or one of a few seconds ago between those of now, is not a restart: it is left out.

use std::time::Duration;

use crate::command::ns;

/// Time by which a packet may be late before it contradicts the others, in milliseconds.
const MAX_LATE_MS: i64 = 1_000;
/// Time by which the clock may be ahead of ours since the newest packet, in milliseconds: that one may have been
/// under way for long.
const MAX_AHEAD_MS: i64 = 5_000;
/// Number of packets in agreement, and the time over which they come, that show a restart: where the autopilot
/// can have started since its newest packet, and where its clock was set.
const RESTARTED: Evidence = Evidence { packets: 5, lasting: Duration::from_millis(200) };
const CLOCK_SET: Evidence = Evidence { packets: 20, lasting: Duration::from_secs(3) };
/// Error of the time since the newest packet, in milliseconds.
const SLACK_MS: i64 = 2_000;

struct Evidence {
    packets: u32,
    lasting: Duration,
}

/// The autopilot's clock as its packets show it.
#[derive(Copy, Clone, Debug, Default)]
pub(crate) struct BootClock {
    newest: Option<Reading>,
    /// Packets that contradict the newest and agree with each other.
    other: Option<Contradiction>,
    /// Fraction of the packets that come later than the quickest ones.
    late_fraction: f64,
    is_unsteady: bool,
}

/// A time since the start, and when it was received.
#[derive(Copy, Clone, Debug)]
struct Reading {
    boot_ms: u32,
    at_ns: i64,
}

#[derive(Copy, Clone, Debug)]
struct Contradiction {
    since_ns: i64,
    last: Reading,
    packets: u32,
}

/// Fraction of late packets at which the link counts as unsteady, the one at which it is steady again, and the
/// smoothing per packet. Of a link that repeats every packet later half of them are late, and it is as quick as
/// before.
const MAX_LATE_FRACTION: f64 = 0.6;
const MAX_STEADY_FRACTION: f64 = 0.3;
const LATE_SMOOTHING: f64 = 0.06;
/// How late such a packet is, in milliseconds.
const MIN_LATE_MS: i64 = 300;

/// The conclusion from a packet's time since the start.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) enum BootTime {
    /// The packet is one of now, or a little late.
    Present,
    /// It contradicts the others, and is not to be used.
    Contradicts,
    /// The autopilot has restarted; the packet is one of now.
    Restarted,
}

impl BootClock {
    /// Takes the time of a packet received at `now_ns`.
    pub(crate) fn take(&mut self, now_ns: i64, boot_ms: u32) -> BootTime {
        let reading = Reading { boot_ms, at_ns: now_ns };
        let Some(newest) = self.newest else {
            self.newest = Some(reading);
            return BootTime::Present;
        };
        let ahead_ms = reading.ahead_ms(newest);
        let passed_ms = reading.passed_ms(newest);
        let is_late = passed_ms - ahead_ms > MIN_LATE_MS;
        let late_fraction = self.late_fraction
            + LATE_SMOOTHING * (f64::from(u8::from(is_late)) - self.late_fraction);
        self.late_fraction = late_fraction;
        let limit = if self.is_unsteady { MAX_STEADY_FRACTION } else { MAX_LATE_FRACTION };
        self.is_unsteady = late_fraction > limit;
        if (0..=passed_ms + MAX_AHEAD_MS).contains(&ahead_ms) {
            (self.newest, self.other) = (Some(reading), None);
            return BootTime::Present;
        }
        if (-MAX_LATE_MS..0).contains(&ahead_ms) {
            self.other = None;
            return BootTime::Present;
        }
        let other = match self.other {
            Some(other) if other.agrees_with(reading) => {
                Contradiction { last: reading, packets: other.packets.saturating_add(1), ..other }
            }
            _ => Contradiction { since_ns: now_ns, last: reading, packets: 1 },
        };
        self.other = Some(other);
        let may_have_started = i64::from(boot_ms) <= passed_ms + SLACK_MS;
        let is_restarted = may_have_started && other.is_shown_by(&RESTARTED);
        if !is_restarted && !other.is_shown_by(&CLOCK_SET) {
            return BootTime::Contradicts;
        }
        *self = Self { newest: Some(reading), ..Self::default() };
        if ahead_ms < 0 { BootTime::Restarted } else { BootTime::Present }
    }
}

impl BootClock {
    /// True while most packets come much later than the quickest ones: so may sent packets.
    pub(crate) fn is_unsteady(&self) -> bool {
        self.is_unsteady
    }
}

impl Reading {
    /// The counter begins again after 49 days, so only the difference counts.
    fn ahead_ms(self, before: Self) -> i64 {
        i64::from(self.boot_ms.wrapping_sub(before.boot_ms).cast_signed())
    }

    fn passed_ms(self, before: Self) -> i64 {
        (self.at_ns.saturating_sub(before.at_ns) / 1_000_000).max(0)
    }
}

impl Contradiction {
    fn agrees_with(&self, reading: Reading) -> bool {
        let max_ms = reading.passed_ms(self.last) + MAX_AHEAD_MS;
        (-MAX_LATE_MS..=max_ms).contains(&reading.ahead_ms(self.last))
    }

    fn is_shown_by(&self, evidence: &Evidence) -> bool {
        let lasted_ns = self.last.at_ns.saturating_sub(self.since_ns);
        self.packets >= evidence.packets && lasted_ns >= ns(evidence.lasting)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use BootTime::{Contradicts, Present, Restarted};

    const MS: i64 = 1_000_000;
    const BOOTED_MS: i64 = 100_000;

    /// The results for packets at 50 Hz from 0 to 10 s, each with the age that a function gives.
    fn seen(age_ms: impl Fn(i64) -> i64) -> Vec<BootTime> {
        let mut clock = BootClock::default();
        let packets = (0..500).map(|i| i * 20);
        packets.map(|ms| clock.take(ms * MS, (BOOTED_MS + ms - age_ms(ms)) as u32)).collect()
    }

    fn count(seen: &[BootTime], expected: BootTime) -> usize {
        seen.iter().filter(|it| **it == expected).count()
    }

    #[test]
    fn one_packet_with_another_time_is_left_out() {
        for age_ms in [3_000, 60_000, BOOTED_MS, -60_000, -1_000_000] {
            let seen = seen(|ms| if ms == 5_000 { age_ms } else { 0 });
            assert_eq!((count(&seen, Contradicts), count(&seen, Restarted)), (1, 0), "{age_ms} ms");
        }
    }

    #[test]
    fn late_and_replayed_packets_are_no_restart() {
        let jitter = seen(|ms| (ms * 7919) % 1_500);
        assert_eq!(count(&jitter, Restarted), 0);
        let replayed = seen(|ms| if ms % 40 == 0 { 2_000 } else { 0 });
        assert_eq!(count(&replayed, Restarted), 0);
        let delayed_from_5_s = seen(|ms| if ms > 5_000 { (ms - 5_000).min(2_000) } else { 0 });
        assert_eq!(count(&delayed_from_5_s, Present), 500);
    }

    #[test]
    fn only_a_link_that_delays_most_packets_is_unsteady() {
        let is_unsteady = |age_ms: fn(i64) -> i64| {
            let mut clock = BootClock::default();
            for ms in (0..10_000).step_by(20) {
                clock.take(ms * MS, (BOOTED_MS + ms - age_ms(ms)) as u32);
            }
            clock.is_unsteady()
        };
        assert!(is_unsteady(|ms| (ms * 7919) % 1_500));
        assert!(!is_unsteady(|ms| (ms * 7919) % 300));
        assert!(!is_unsteady(|ms| if ms % 40 == 0 { 2_000 } else { 0 }), "repeated");
        assert!(!is_unsteady(|ms| if ms > 5_000 { 2_000 } else { 0 }), "evenly late");
    }

    #[test]
    fn a_restart_is_noticed_within_a_quarter_of_a_second() {
        // It boots at 5 s.
        let seen = seen(|ms| if ms >= 5_000 { BOOTED_MS + 5_000 } else { 0 });
        let at = seen.iter().position(|it| *it == Restarted).unwrap();
        assert!((250..=262).contains(&at), "{} ms", at * 20);
        assert_eq!(count(&seen, Restarted), 1);
        assert!(seen[at + 1..].iter().all(|it| *it == Present));
    }

    #[test]
    fn a_clock_that_was_set_is_believed_after_some_seconds() {
        for (age_ms, restarts) in [(50_000, 1), (-50_000, 0)] {
            let seen = seen(|ms| if ms >= 5_000 { age_ms } else { 0 });
            assert_eq!(count(&seen, Restarted), restarts);
            assert_eq!(seen[499], Present);
        }
    }

    #[test]
    fn the_counter_may_begin_again_after_49_days() {
        let mut clock = BootClock::default();
        for ms in (0..4_000).step_by(20) {
            let boot_ms = (u32::MAX - 2_000).wrapping_add(ms);
            assert_eq!(clock.take(i64::from(ms) * MS, boot_ms), Present);
        }
    }
}
