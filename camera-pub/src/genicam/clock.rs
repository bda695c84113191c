//! The time of a camera's own clock as the host's.

/// Time in which the quickest frame is looked for, in nanoseconds. Clocks that go apart by 50 in a million move by half a
/// millisecond in two of these.
const SPAN_NS: i64 = 5_000_000_000;
/// Number of frames before the quickest is believed.
const MIN_FRAMES: u32 = 10;
/// Offsets that differ by more than this are of a camera that was started again, or whose clock was set, in nanoseconds.
const MAX_JUMP_NS: u64 = 500_000_000;

/// What a camera's clock is behind the host's.
///
/// No frame arrives before it is sent, and the quickest hardly later: the least difference of arrival and stamp over the last
/// five to ten seconds is the offset, as in the clock filter of NTP (RFC 5905, section 10).
#[derive(Debug, Default)]
pub(super) struct CameraClock {
    frames: u32,
    began_ns: i64,
    /// The least difference since then, and that of the span before.
    min_ns: Option<i64>,
    before_ns: Option<i64>,
}

impl CameraClock {
    /// The host's time of a frame's stamp, which is sent `until_sent_ns` after it at the soonest; `None` while too few
    /// frames have come.
    pub(super) fn host_ns(
        &mut self,
        stamp_ns: i64,
        until_sent_ns: i64,
        arrival_ns: i64,
    ) -> Option<i64> {
        let apart_ns = arrival_ns.saturating_sub(stamp_ns).saturating_sub(until_sent_ns);
        if self.offset_ns().is_some_and(|offset_ns| apart_ns.abs_diff(offset_ns) > MAX_JUMP_NS) {
            *self = Self::default();
        }
        if arrival_ns.saturating_sub(self.began_ns) > SPAN_NS {
            self.began_ns = arrival_ns;
            self.before_ns = self.min_ns.take();
        }
        self.min_ns = Some(self.min_ns.map_or(apart_ns, |min_ns| min_ns.min(apart_ns)));
        self.frames = self.frames.saturating_add(1);
        let offset_ns = self.offset_ns().filter(|_| self.frames >= MIN_FRAMES)?;
        Some(stamp_ns.saturating_add(offset_ns))
    }

    fn offset_ns(&self) -> Option<i64> {
        self.min_ns.into_iter().chain(self.before_ns).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    /// The largest error of frames at 25 Hz over a minute, in nanoseconds, with a clock that is ahead by `drift` and
    /// arrivals that are late by what `late_ns` says of a frame's number.
    fn worst_ns(drift: f64, until_sent_ns: i64, late_ns: impl Fn(i64) -> i64) -> i64 {
        let mut clock = CameraClock::default();
        let mut worst_ns = 0;
        for number in 0..1500 {
            let truth_ns = 7_000_000_000 + number * 40 * MS;
            let stamp_ns = (truth_ns as f64 * (1.0 + drift)) as i64 - 123_456_789_000;
            let arrival_ns = truth_ns + until_sent_ns + late_ns(number);
            if let Some(host_ns) = clock.host_ns(stamp_ns, until_sent_ns, arrival_ns) {
                worst_ns = worst_ns.max((host_ns - truth_ns).abs());
            } else {
                assert!(number < 9, "no time for frame {number}");
            }
        }
        worst_ns
    }

    #[test]
    fn a_stamp_is_told_within_a_millisecond_whatever_delays_most_frames() {
        // Nine of ten frames are late by up to 8 ms.
        let late_ns = |number: i64| if number % 10 == 3 { 0 } else { number * 7919 % 8 * MS };
        for drift in [0.0, 5e-5, -5e-5] {
            for until_sent_ns in [0, 5 * MS] {
                let error_ns = worst_ns(drift, until_sent_ns, late_ns);
                assert!(error_ns <= MS, "{drift}: {error_ns} ns");
            }
        }
    }

    #[test]
    fn a_clock_that_begins_anew_is_learnt_anew() {
        let mut clock = CameraClock::default();
        for number in 0..100 {
            clock.host_ns(number * 40 * MS, 0, 50_000 * MS + number * 40 * MS);
        }
        let told: Vec<_> = (0..20)
            .map(|number| clock.host_ns(number * 40 * MS, 0, 60_000 * MS + number * 40 * MS))
            .collect();
        assert_eq!(told[8], None, "a restarted camera's stamps are not believed at once");
        assert_eq!(told[19], Some(60_000 * MS + 19 * 40 * MS));
    }
}
