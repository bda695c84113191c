//! Decides whether the known mode was received after a standstill of this process.
//!
//! A process that was stopped, swapped out or starved continues with the packets in its socket, oldest first: a pilot's switch may be
//! behind many older packets. A request that is sent before that is read would take the vehicle from the pilot.

/// Shortest pause between two ticks that is a standstill of this process, in nanoseconds: they are 25 ms apart.
pub const MIN_STANDSTILL_NS: i64 = 300_000_000;
/// Time in which the packets that waited in the socket are read, in nanoseconds.
const BACKLOG_NS: i64 = 300_000_000;
/// Longest wait for the mode, in nanoseconds: heartbeats come each second, and one may be lost.
const MAX_WAIT_NS: i64 = 2_500_000_000;

/// A time, moved on by a standstill of this process that has ended, in nanoseconds: what is expected since then was not missing meanwhile.
pub fn without_standstill(at_ns: i64, now_ns: i64, stood_ns: i64) -> i64 {
    at_ns.saturating_add(stood_ns).min(now_ns)
}

/// The last standstill, until a mode received after it is known.
#[derive(Copy, Clone, Debug, Default)]
pub(crate) struct Standstill {
    ticked_ns: Option<i64>,
    /// When the first and the last standstill ended after which no mode is known.
    first_ns: Option<i64>,
    ended_ns: Option<i64>,
}

impl Standstill {
    /// Advances the time; the length of the standstill, in nanoseconds, if one has just ended.
    pub(crate) fn tick(&mut self, now_ns: i64) -> Option<i64> {
        let before_ns = self.ticked_ns.unwrap_or(now_ns);
        self.ticked_ns = Some(before_ns.max(now_ns));
        let pause_ns = now_ns.saturating_sub(before_ns);
        let stood_ns = (pause_ns > MIN_STANDSTILL_NS).then_some(pause_ns);
        if stood_ns.is_some() {
            self.ended_ns = Some(now_ns);
            self.first_ns.get_or_insert(now_ns);
        }
        // A process that is stopped again and again sends requests nevertheless.
        if self
            .first_ns
            .take_if(|first_ns| now_ns.saturating_sub(*first_ns) > MAX_WAIT_NS)
            .is_some()
        {
            self.ended_ns = None;
        }
        stood_ns
    }

    /// The vehicle's mode was received; `measured_ns` is when the newest measurement before it was made, if there is one.
    pub(crate) fn mode_shown(&mut self, now_ns: i64, measured_ns: Option<i64>) {
        let shown = self.ended_ns.take_if(|ended_ns| {
            let is_read = now_ns.saturating_sub(*ended_ns) >= BACKLOG_NS;
            is_read && measured_ns.is_none_or(|measured_ns| measured_ns >= *ended_ns)
        });
        if shown.is_some() {
            self.first_ns = None;
        }
    }

    /// Whether the known mode may be from before the standstill.
    pub(crate) fn is_mode_old(&self) -> bool {
        self.ended_ns.is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn frozen() -> Standstill {
        let mut standstill = Standstill::default();
        standstill.tick(0);
        standstill.tick(25 * MS);
        assert!(!standstill.is_mode_old());
        assert_eq!(standstill.tick(1000 * MS), Some(975 * MS));
        standstill
    }

    #[test]
    fn after_a_standstill_the_mode_is_awaited_behind_the_packets_in_the_socket() {
        let mut standstill = frozen();
        standstill.mode_shown(1100 * MS, None);
        standstill.mode_shown(1400 * MS, Some(990 * MS));
        assert!(standstill.is_mode_old(), "at once, and behind earlier measurements");
        standstill.mode_shown(1400 * MS, Some(1390 * MS));
        assert!(!standstill.is_mode_old());
    }

    #[test]
    fn the_wait_is_bounded() {
        let mut standstill = frozen();
        for ms in (1025..3500).step_by(25) {
            standstill.tick(ms * MS);
            assert!(standstill.is_mode_old(), "{ms} ms");
        }
        standstill.tick(3525 * MS);
        assert!(!standstill.is_mode_old());
    }
    #[test]
    fn the_wait_is_bounded_for_a_process_that_is_stopped_again_and_again() {
        let mut standstill = frozen();
        for ms in (1500..3500).step_by(500) {
            standstill.tick(ms * MS);
            assert!(standstill.is_mode_old(), "{ms} ms");
        }
        standstill.tick(3600 * MS);
        assert!(!standstill.is_mode_old());
    }
}
