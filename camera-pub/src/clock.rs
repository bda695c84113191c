//! Converts stamps of a camera's clock into the host's time by the quickest arrivals, again after that clock was set.
//! Also converts arrivals that are stamped in UTC.

/// Time in which the quickest frame is looked for, in nanoseconds. Clocks that go apart by 50 in a million move by half a
/// millisecond in two of these.
const SPAN_NS: i64 = 5_000_000_000;
/// Number of frames before the quickest is used.
const MIN_FRAMES: u32 = 10;
/// Offsets that differ by more than this are of a camera that was started again, or whose clock was set, in nanoseconds.
const MAX_JUMP_NS: i64 = 500_000_000;
/// Frames may be late by more than that for so long, where their stamps continue: they were delayed on their way, in
/// nanoseconds.
const MAX_FAR_NS: i64 = 2_000_000_000;

/// So many frames in a row that are all later than the quickest by so much are of a clock that was set, where nothing else delays
/// frames for that long.
const STEP_FRAMES: u32 = 20;
const MIN_STEP_NS: i64 = 50_000_000;

/// Estimates how far a camera's clock is behind the host's.
///
/// No frame arrives before it is sent, and the quickest hardly later: the least difference of arrival and stamp over the last
/// five to ten seconds is the offset, as in the clock filter of NTP (RFC 5905, section 10).
#[derive(Debug, Default)]
pub(crate) struct CameraClock {
    frames: u32,
    began_ns: i64,
    /// The least difference since then, and that of the span before.
    min_ns: Option<i64>,
    before_ns: Option<i64>,
    /// The stamp of the newest frame.
    stamp_ns: Option<i64>,
    /// Since when all frames have been late by more than a jump.
    far_since_ns: Option<i64>,
    /// Whether late frames show that the clock was set.
    is_direct: bool,
    late: u32,
}

impl CameraClock {
    /// Of a camera on a line of its own, whose frames are not late for long: when they are, its clock was set back.
    #[cfg(any(feature = "genicam", test))]
    pub(crate) fn direct() -> Self {
        Self { is_direct: true, ..Self::default() }
    }

    /// The host's time of a frame's stamp, which is sent `until_sent_ns` after it at the soonest; `None` while too few
    /// frames have come.
    pub(crate) fn host_ns(
        &mut self,
        stamp_ns: i64,
        until_sent_ns: i64,
        arrival_ns: i64,
    ) -> Option<i64> {
        let apart_ns = arrival_ns.saturating_sub(stamp_ns).saturating_sub(until_sent_ns);
        let went_back = self.stamp_ns.is_some_and(|before_ns| stamp_ns < before_ns);
        if let Some(offset_ns) = self.offset_ns() {
            let late_ns = apart_ns.saturating_sub(offset_ns);
            if self.was_set(late_ns, went_back, arrival_ns) {
                *self = Self { is_direct: self.is_direct, ..Self::default() };
            }
        }
        self.stamp_ns = Some(stamp_ns);
        if arrival_ns.saturating_sub(self.began_ns) > SPAN_NS {
            self.began_ns = arrival_ns;
            self.before_ns = self.min_ns.take();
        }
        self.min_ns = Some(self.min_ns.map_or(apart_ns, |min_ns| min_ns.min(apart_ns)));
        self.frames = self.frames.saturating_add(1);
        let offset_ns = self.offset_ns().filter(|_| self.frames >= MIN_FRAMES)?;
        Some(stamp_ns.saturating_add(offset_ns))
    }

    /// Whether a frame that is later than the quickest by so much shows that the clock was changed.
    ///
    /// A frame that is early by a jump does, as none is quicker than the way allows. One that is late by a jump may only have
    /// waited, unless its stamp went back.
    fn was_set(&mut self, late_ns: i64, went_back: bool, arrival_ns: i64) -> bool {
        self.late = if late_ns > MIN_STEP_NS { self.late.saturating_add(1) } else { 0 };
        let has_stepped = self.is_direct && self.late >= STEP_FRAMES;
        if late_ns <= MAX_JUMP_NS {
            self.far_since_ns = None;
            return has_stepped || late_ns < -MAX_JUMP_NS;
        }
        let since_ns = *self.far_since_ns.get_or_insert(arrival_ns);
        has_stepped || went_back || arrival_ns.saturating_sub(since_ns) > MAX_FAR_NS
    }

    fn offset_ns(&self) -> Option<i64> {
        self.min_ns.into_iter().chain(self.before_ns).min()
    }
}

/// Converts arrivals that are stamped by the system's clock (UTC), which may be set, into times of the host's clock.
#[cfg(feature = "genicam")]
#[derive(Debug, Default)]
pub(crate) struct UtcArrivals {
    /// By how much UTC was more than the host's clock, and when it was last seen to be set.
    ahead_ns: Option<i64>,
    set_ns: Option<i64>,
}

/// UTC is not slewed by more than this between two frames, in nanoseconds; a larger change is a step.
#[cfg(feature = "genicam")]
const MAX_SLEW_NS: u64 = 2_000_000;
/// Longest time for which a frame waits to be read, in nanoseconds.
#[cfg(feature = "genicam")]
const MAX_WAIT_NS: i64 = 1_000_000_000;

#[cfg(feature = "genicam")]
impl UtcArrivals {
    /// The host's time at which something arrived that is read now. Where the system's clock was set meanwhile, it is now:
    /// a little late does no harm, while early by the step would last for seconds.
    pub(crate) fn host_ns(&mut self, arrival_utc_ns: i64, utc_ns: i64, now_ns: i64) -> i64 {
        let ahead_ns = utc_ns.saturating_sub(now_ns);
        let before_ns = self.ahead_ns.replace(ahead_ns);
        if before_ns.is_some_and(|before_ns| before_ns.abs_diff(ahead_ns) > MAX_SLEW_NS) {
            self.set_ns = Some(now_ns);
        }
        let is_settled = self.set_ns.is_none_or(|set_ns| now_ns - set_ns > MAX_WAIT_NS);
        let waited_ns = utc_ns.saturating_sub(arrival_utc_ns);
        let is_possible = (0..=MAX_WAIT_NS).contains(&waited_ns);
        if is_settled && is_possible { now_ns - waited_ns } else { now_ns }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    /// The largest error of frames at 25 Hz over a minute, in nanoseconds, with a clock that is ahead by `drift` and
    /// arrivals that are late by `late_ns` of a frame's number.
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
    fn a_stamp_is_converted_within_a_millisecond_whatever_delays_most_frames() {
        // Nine of ten frames are late by up to 8 ms.
        let late_ns = |number: i64| if number % 10 == 3 { 0 } else { number * 7919 % 8 * MS };
        for drift in [0.0, 5e-5, -5e-5] {
            for until_sent_ns in [0, 5 * MS] {
                let error_ns = worst_ns(drift, until_sent_ns, late_ns);
                assert!(error_ns <= MS, "{drift}: {error_ns} ns");
            }
        }
    }

    #[cfg(feature = "genicam")]
    #[test]
    fn a_step_of_the_systems_clock_makes_no_frame_early() {
        for step_ns in [300 * MS, -300 * MS] {
            let mut arrivals = UtcArrivals::default();
            for number in 0..200 {
                let arrival_ns = 50_000 * MS + number * 40 * MS;
                // Read 3 ms later; the clock is set between.
                let now_ns = arrival_ns + 3 * MS;
                let utc = |at_ns: i64, since: i64| {
                    at_ns + 1_000_000 * MS + if number >= since { step_ns } else { 0 }
                };
                let host_ns = arrivals.host_ns(utc(arrival_ns, 101), utc(now_ns, 100), now_ns);
                let error_ns = host_ns - arrival_ns;
                assert!((0..=3 * MS).contains(&error_ns), "{number}: {error_ns}");
                assert!((100..130).contains(&number) || error_ns == 0, "{number}: {error_ns}");
            }
        }
    }

    #[test]
    fn a_clock_that_is_set_back_a_little_is_noticed_by_late_frames() {
        for (mut clock, is_noticed) in
            [(CameraClock::direct(), true), (CameraClock::default(), false)]
        {
            let mut errors_ns = Vec::new();
            for number in 0..150 {
                let truth_ns = 50_000 * MS + number * 40 * MS;
                let stamp_ns = truth_ns - if number < 60 { 0 } else { 300 * MS };
                let arrival_ns = truth_ns + number * 7919 % 8 * MS;
                let host_ns = clock.host_ns(stamp_ns, 0, arrival_ns);
                errors_ns.push(host_ns.map(|host_ns| host_ns - truth_ns));
            }
            let late = errors_ns[79..].iter().flatten().all(|error_ns| error_ns.abs() <= MS);
            assert_eq!(late, is_noticed, "{errors_ns:?}");
        }
    }

    #[test]
    fn a_burst_of_late_frames_moves_no_stamp() {
        for mut clock in [CameraClock::default(), CameraClock::direct()] {
            for number in 0..200 {
                let truth_ns = 50_000 * MS + number * 40 * MS;
                // From the hundredth on all wait for 700 ms, and come one after the other then.
                let late_ns =
                    if number < 100 { 0 } else { (700 - (number - 100) * 40).max(0) * MS };
                let host_ns = clock.host_ns(number * 40 * MS, 0, truth_ns + late_ns);
                let expected_ns = (number >= 9).then_some(truth_ns);
                assert_eq!(host_ns, expected_ns, "{number}");
            }
        }
    }

    #[test]
    fn a_clock_that_is_set_by_much_is_learnt_again() {
        // Ahead, at once; back, at once where the stamps show it, and after two seconds where the camera sent nothing meanwhile.
        for (set_ns, pause_ns, after) in
            [(1000 * MS, 0, 9), (-1000 * MS, 0, 9), (-1000 * MS, 3000 * MS, 60)]
        {
            let mut clock = CameraClock::default();
            let mut first = None;
            for number in 0..200 {
                let is_set = number >= 100;
                let truth_ns = 50_000 * MS + number * 40 * MS + if is_set { pause_ns } else { 0 };
                let stamp_ns = truth_ns - 49_000 * MS + if is_set { set_ns } else { 0 };
                let host_ns = clock.host_ns(stamp_ns, 0, truth_ns);
                if is_set && host_ns == Some(truth_ns) {
                    first.get_or_insert(number - 100);
                }
            }
            assert_eq!(first, Some(after), "{set_ns} {pause_ns}");
        }
    }

    #[test]
    fn a_clock_that_begins_again_is_learnt_again() {
        let mut clock = CameraClock::default();
        for number in 0..100 {
            clock.host_ns(number * 40 * MS, 0, 50_000 * MS + number * 40 * MS);
        }
        let hosts_ns: Vec<_> = (0..20)
            .map(|number| clock.host_ns(number * 40 * MS, 0, 60_000 * MS + number * 40 * MS))
            .collect();
        assert_eq!(hosts_ns[8], None, "a restarted camera's stamps are not used at once");
        assert_eq!(hosts_ns[19], Some(60_000 * MS + 19 * 40 * MS));
    }
}
