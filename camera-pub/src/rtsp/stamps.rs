//! Computes the host's time at which a picture of an RTSP stream was taken: by sender reports of the camera's clock, or by RTP
//! time and arrival.

use super::session::Times;
use crate::clock::CameraClock;
use crate::config::RtspStamps;

/// Maximum age of a picture when it arrives, by the camera's clock, and by how much it may seem to arrive before it was taken, in
/// nanoseconds: beyond, the clock is another one than this host's.
const MAX_AGE_NS: i64 = 2_000_000_000;
const MAX_EARLY_NS: i64 = 20_000_000;

/// The host's time of a stream's pictures.
#[derive(Debug)]
pub(super) struct StreamStamps {
    by: RtspStamps,
    /// Time from the middle of the exposure to the instant that is stamped.
    delay_ns: i64,
    quickest: CameraClock,
    /// From the instant that the camera's clock stamped to the quickest arrival.
    way_ns: Option<i64>,
}

/// A picture's stamp.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) enum Stamp {
    /// In nanoseconds of the host's clock.
    At(i64),
    /// The camera has not sent its clock yet.
    Unknown,
    /// The camera's clock is another one: by it a picture is so old when it arrives.
    OtherClock {
        /// In nanoseconds.
        age_ns: i64,
    },
}

impl StreamStamps {
    pub(super) fn new(by: RtspStamps, delay_ns: i64) -> Self {
        Self { by, delay_ns, quickest: CameraClock::default(), way_ns: None }
    }

    /// The stream was opened again: its times may have begun again.
    pub(super) fn reopened(&mut self) {
        self.quickest = CameraClock::default();
    }

    /// The stamp of a picture, where UTC is `utc_ahead_ns` more than the host's clock.
    ///
    /// A camera's clock that is set again does not move the stamps: from then on they are those of the arrivals, less the delay
    /// that was measured before.
    pub(super) fn stamp(&mut self, times: &Times, utc_ahead_ns: i64) -> Stamp {
        let Times { stream_ns, arrival_ns, report } = *times;
        let quickest_ns = self.quickest.host_ns(stream_ns, 0, arrival_ns).unwrap_or(arrival_ns);
        let after = |way_ns: i64| Stamp::At(quickest_ns.saturating_sub(way_ns + self.delay_ns));
        if self.by == RtspStamps::Arrival {
            return after(0);
        }
        let Some(report) = report else { return self.way_ns.map_or(Stamp::Unknown, after) };
        let since_report_ns = stream_ns.saturating_sub(report.stream_ns);
        let utc_ns = report.utc_ns.saturating_add(since_report_ns);
        let camera_ns = utc_ns.saturating_sub(utc_ahead_ns);
        let age_ns = arrival_ns.saturating_sub(camera_ns);
        if (-MAX_EARLY_NS..=MAX_AGE_NS).contains(&age_ns) {
            self.way_ns = Some(quickest_ns.saturating_sub(camera_ns));
            Stamp::At(camera_ns.saturating_sub(self.delay_ns))
        } else {
            self.way_ns.map_or(Stamp::OtherClock { age_ns }, after)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::session::SenderReport;
    use super::*;

    const MS: i64 = 1_000_000;
    const UTC_AHEAD_NS: i64 = 1_700_000_000_000 * MS;

    /// When a picture is taken, and its times: it is sent 80 ms later, and its way takes 4 ms or, of most, more.
    fn times(number: i64, clock_ahead_ns: i64) -> (i64, Times) {
        let taken_ns = 50_000 * MS + number * 40 * MS;
        let late_ns = if number % 7 == 0 { 4 * MS } else { (5 + number * 31 % 30) * MS };
        let report = SenderReport {
            stream_ns: 5000 * MS,
            utc_ns: 50_000 * MS + UTC_AHEAD_NS + clock_ahead_ns,
        };
        let arrival_ns = taken_ns + 80 * MS + late_ns;
        let report = (number >= 5).then_some(report);
        (taken_ns, Times { stream_ns: 5000 * MS + number * 40 * MS, arrival_ns, report })
    }

    fn at(stamp: Stamp) -> i64 {
        match stamp {
            Stamp::At(ns) => ns,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn without_the_cameras_clock_the_quickest_picture_gives_the_stamps() {
        let mut stamps = StreamStamps::new(RtspStamps::Arrival, 84 * MS);
        for number in 0..200 {
            let (taken_ns, times) = times(number, 0);
            let stamp_ns = at(stamps.stamp(&times, UTC_AHEAD_NS));
            assert!(number < 10 || (stamp_ns - taken_ns).abs() <= MS, "{number}: {stamp_ns}");
        }
    }

    #[test]
    fn the_cameras_clock_is_used_from_its_first_report_on() {
        let mut stamps = StreamStamps::new(RtspStamps::Camera, 3 * MS);
        for number in 0..50 {
            let (taken_ns, times) = times(number, 0);
            let expected = if number < 5 { Stamp::Unknown } else { Stamp::At(taken_ns - 3 * MS) };
            assert_eq!(stamps.stamp(&times, UTC_AHEAD_NS), expected, "{number}");
        }
    }

    #[test]
    fn a_clock_other_than_this_hosts_is_refused() {
        for clock_ahead_ns in [3600 * 1000 * MS, -3 * 1000 * MS, 200 * MS] {
            let mut stamps = StreamStamps::new(RtspStamps::Camera, 0);
            let stamp = stamps.stamp(&times(5, clock_ahead_ns).1, UTC_AHEAD_NS);
            assert!(matches!(stamp, Stamp::OtherClock { .. }), "{stamp:?}");
        }
    }

    #[test]
    fn a_clock_that_is_set_during_a_flight_does_not_move_the_stamps() {
        let mut stamps = StreamStamps::new(RtspStamps::Camera, 0);
        for number in 5..200 {
            let ahead_ns = if number < 60 { 0 } else { 3600 * 1000 * MS };
            let (taken_ns, times) = times(number, ahead_ns);
            let stamp_ns = at(stamps.stamp(&times, UTC_AHEAD_NS));
            assert!((stamp_ns - taken_ns).abs() <= MS, "{number}: {stamp_ns}");
        }
        stamps.reopened();
        let (taken_ns, mut first) = times(203, 0);
        first.report = None;
        let stamp_ns = at(stamps.stamp(&first, UTC_AHEAD_NS));
        assert!((stamp_ns - taken_ns).abs() <= 30 * MS, "by its own arrival: {stamp_ns}");
    }
}
