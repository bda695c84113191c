//! Synchronisation with the autopilot's clock by TIMESYNC round trips
//! (<https://mavlink.io/en/services/timesync.html>).
//!
//! A round trip bounds the offset of the two clocks to half its length, so the shortest one of the last
//! seconds is used; its uncertainty grows with age as the clocks drift. With the offset the autopilot's
//! measurements are stamped with the time of the measurement instead of that of the reception, whatever the
//! delay and the jitter of the link.

use std::collections::VecDeque;

const MS: i64 = 1_000_000;
/// Period of the first requests, in nanoseconds.
const FIRST_NS: i64 = 100 * MS;
/// Period of later requests, in nanoseconds.
const LATER_NS: i64 = 1_000 * MS;
/// Number of round trips at the first period.
const FIRST: usize = 12;
/// Maximum number of stored round trips.
const MAX_TRIPS: usize = 64;
/// Time for which a round trip is stored, in nanoseconds.
const WINDOW_NS: i64 = 30_000 * MS;
/// Maximum number of requests without a reply: 12.8 s of them at the first period.
const MAX_REQUESTS: usize = 128;
/// Maximum length of a round trip that is used, in nanoseconds. Even a long one gives a better stamp than the time of
/// reception, which is wrong by the complete delay.
const MAX_TRIP_NS: i64 = 1_500 * MS;
/// Maximum number and age of the round trips that show how slow the link is now.
const MAX_LENGTHS: usize = 16;
const MAX_LENGTH_AGE_NS: i64 = 6_000 * MS;
/// Number of measurements whose age on arrival shows the same sooner: the youngest of them, as one may have waited
/// elsewhere. And the time after which they do not count any more.
const AGES: usize = 6;
const MAX_ARRIVED_NS: i64 = 1_000 * MS;
/// Time over which the pauses between positions are counted, and their maximum number.
const PAUSES_NS: i64 = 2_000 * MS;
const MAX_ARRIVALS: usize = 128;
/// Mean age of the newest position at 20 Hz without losses, in nanoseconds, in addition to the link's delay.
const USUAL_WAIT_NS: i64 = 25 * MS;
/// The delay by losses both ways together, per nanosecond of the positions' mean age beyond that: setpoints go out half as
/// often as positions come, so theirs is twice as long, and a control loop must bear the long waits, not the mean one.
const WAITS_PER_AGE: i64 = 5;
/// Time for which a measurement that came behind newer ones counts for the state of the link, in nanoseconds.
const MAX_BEHIND_AGE_NS: i64 = 10_000 * MS;
/// Maximum drift between two clocks: 100 ppm.
const DRIFT: f64 = 1e-4;
/// Error of reading a clock, in nanoseconds.
const SLACK_NS: i64 = 2 * MS;
/// Consecutive contradictions after which a clock counts as reset.
const CONTRADICTIONS: u32 = 3;
/// Maximum age of a measurement on arrival over a live link, in nanoseconds: an old one must not pass for one of
/// now.
const MAX_AGE_NS: i64 = 3_000 * MS;
/// Maximum age on arrival that a link's backlog explains, in nanoseconds. Beyond that the autopilot's time since its start
/// and the one of its replies are not the same clock.
const MAX_BACKLOG_NS: i64 = 60_000 * MS;

/// The offset of the two clocks.
#[derive(Clone, Debug, Default)]
pub struct Clock {
    requests: VecDeque<i64>,
    due_ns: i64,
    trips: VecDeque<Trip>,
    /// Number of round trips since the start or since the clock was found to be another one, also of those too long to be used.
    answers: usize,
    /// All round trips, also those too long to be used.
    lengths: VecDeque<Length>,
    /// How old the newest measurements were when they came.
    ages: VecDeque<Length>,
    /// When the last positions came.
    arrivals: VecDeque<i64>,
    /// The largest delay behind newer measurements.
    behind: Option<Length>,
    contradictions: u32,
}

/// When the autopilot made a measurement that it sent.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Measured {
    /// At this time, by our clock.
    At(i64),
    /// Too long ago for a live link: it does not show the present state.
    LongAgo,
    /// The offset of the clocks is unknown, or the time lies in the future.
    Unknown,
}

/// When a reply or a measurement came, and after which time.
#[derive(Copy, Clone, Debug)]
struct Length {
    at_ns: i64,
    length_ns: i64,
}

/// One request and its reply.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
struct Trip {
    at_ns: i64,
    /// Their clock minus ours.
    offset_ns: i64,
    length_ns: i64,
}

impl Clock {
    /// The request to send now, if one is due: its `ts1`.
    pub fn request(&mut self, now_ns: i64) -> Option<i64> {
        if now_ns < self.due_ns {
            return None;
        }
        let pause_ns = if self.answers < FIRST { FIRST_NS } else { LATER_NS };
        self.due_ns = now_ns.saturating_add(pause_ns);
        if self.requests.len() >= MAX_REQUESTS {
            self.requests.pop_front();
        }
        self.requests.push_back(now_ns);
        Some(now_ns)
    }

    /// Handles a reply received at `now_ns`: their time and the request's `ts1`. False when it is not a reply
    /// to a request of ours, or took too long.
    pub fn answered(&mut self, now_ns: i64, theirs_ns: i64, ts1_ns: i64) -> bool {
        let Some(index) = self.requests.iter().position(|requests| *requests == ts1_ns) else {
            return false;
        };
        self.requests.remove(index);
        self.answers = self.answers.saturating_add(1);
        let length_ns = now_ns.saturating_sub(ts1_ns);
        if self.lengths.len() >= MAX_LENGTHS {
            self.lengths.pop_front();
        }
        self.lengths.push_back(Length { at_ns: now_ns, length_ns: length_ns.max(0) });
        if !(0..=MAX_TRIP_NS).contains(&length_ns) || theirs_ns <= 0 {
            return false;
        }
        let offset_ns = theirs_ns.saturating_sub(ts1_ns.saturating_add(length_ns / 2));
        let trip = Trip { at_ns: now_ns, offset_ns, length_ns };
        if self.best(now_ns).is_some_and(|best| best.contradicts(&trip)) {
            self.contradictions += 1;
            if self.contradictions < CONTRADICTIONS {
                return false;
            }
            self.trips.clear();
            self.answers = 0;
        }
        self.contradictions = 0;
        if self.trips.len() >= MAX_TRIPS {
            self.trips.pop_front();
        }
        self.trips.push_back(trip);
        true
    }

    /// The autopilot restarted: starts again.
    pub fn restart(&mut self) {
        *self = Self::default();
    }

    /// The length of the round trip in use, in ns; `None` while there is none.
    pub fn round_trip_ns(&self, now_ns: i64) -> Option<i64> {
        self.best(now_ns).map(|trip| trip.length_ns)
    }

    /// As [`Clock::measured`], and notes how long the measurement was under way.
    pub fn arrived(&mut self, now_ns: i64, boot_ms: u32) -> Measured {
        let measured = self.measured(now_ns, boot_ms);
        if let Measured::At(stamp_ns) = measured {
            if self.ages.len() >= AGES {
                self.ages.pop_front();
            }
            let length_ns = now_ns.saturating_sub(stamp_ns).max(0);
            self.ages.push_back(Length { at_ns: now_ns, length_ns });
        }
        measured
    }

    /// A position came.
    pub fn position_arrived(&mut self, now_ns: i64) {
        if self.arrivals.len() >= MAX_ARRIVALS {
            self.arrivals.pop_front();
        }
        self.arrivals.push_back(now_ns);
    }

    /// True for a measurement that is at least as new as the newest before, by their times since the autopilot's start. How
    /// far it comes behind is noted: the link repeats or reorders packets.
    pub fn is_newest(&mut self, now_ns: i64, boot_ms: u32, newest_ms: Option<u32>) -> bool {
        let ahead_ms = newest_ms.map_or(0, |newest| boot_ms.wrapping_sub(newest).cast_signed());
        self.came_behind(now_ns, i64::from(ahead_ms).saturating_mul(-MS));
        ahead_ms >= 0
    }

    fn came_behind(&mut self, now_ns: i64, length_ns: i64) {
        if (1..=MAX_AGE_NS).contains(&length_ns) && length_ns >= self.behind_ns(now_ns) {
            self.behind = Some(Length { at_ns: now_ns, length_ns });
        }
    }

    /// How far behind newer ones packets have come in the last seconds, in ns.
    pub fn behind_ns(&self, now_ns: i64) -> i64 {
        let recent = self.behind.filter(|it| it.is_recent(now_ns, MAX_BEHIND_AGE_NS));
        recent.map_or(0, |it| it.length_ns)
    }

    /// How slow the link is now, both ways together, in ns: by its round trips or, where that is more, twice the
    /// age with which measurements come; and by its losses, as the next packet comes later. Round trips are a
    /// second apart; a vehicle that descends is metres lower before they show a change. `None` while neither is known.
    pub fn link_delay_ns(&self, now_ns: i64) -> Option<i64> {
        let delay_ns = self.slow_trip_ns(now_ns).max(self.two_ways_ns(now_ns))?;
        Some(delay_ns.saturating_add(self.losses_ns(now_ns)))
    }

    /// By how much losses delay packets, both ways together: measured by the pauses between positions. They
    /// count with their squares, as in the mean age of the newest position.
    fn losses_ns(&self, now_ns: i64) -> i64 {
        let since_ns = now_ns.saturating_sub(PAUSES_NS);
        let recent = self.arrivals.iter().copied().filter(|at_ns| *at_ns >= since_ns);
        let mut last_ns = None;
        let (mut sum_s, mut squares_s2) = (0.0, 0.0);
        for at_ns in recent.chain([now_ns]) {
            if let Some(last_ns) = last_ns.replace(at_ns) {
                let pause_s = at_ns.saturating_sub(last_ns).max(0) as f64 * 1e-9;
                sum_s += pause_s;
                squares_s2 += pause_s * pause_s;
            }
        }
        if sum_s <= 0.0 {
            return 0;
        }
        let wait_ns = (0.5e9 * squares_s2 / sum_s) as i64;
        wait_ns.saturating_sub(USUAL_WAIT_NS).max(0).saturating_mul(WAITS_PER_AGE)
    }

    /// Twice the age of the youngest of the last measurements on arrival.
    fn two_ways_ns(&self, now_ns: i64) -> Option<i64> {
        let ages = self.ages.iter().filter(|age| age.is_recent(now_ns, MAX_ARRIVED_NS));
        let youngest_ns = ages.clone().map(|age| age.length_ns).min()?;
        (ages.count() >= AGES).then(|| youngest_ns.saturating_mul(2))
    }

    /// The second longest of the last round trips, as a single one may have waited elsewhere. `None` while there
    /// were no two.
    fn slow_trip_ns(&self, now_ns: i64) -> Option<i64> {
        let recent = self.lengths.iter().filter(|trip| trip.is_recent(now_ns, MAX_LENGTH_AGE_NS));
        let (mut longest_ns, mut second_ns) = (None, None);
        for Length { length_ns, .. } in recent {
            if longest_ns.is_none_or(|longest_ns| *length_ns > longest_ns) {
                second_ns = longest_ns.replace(*length_ns);
            } else if second_ns.is_none_or(|second_ns| *length_ns > second_ns) {
                second_ns = Some(*length_ns);
            }
        }
        second_ns
    }

    /// The time by our clock at which the autopilot's showed `boot_ms` milliseconds, for a message received
    /// at `now_ns`.
    pub fn measured(&self, now_ns: i64, boot_ms: u32) -> Measured {
        let Some(stamp_ns) = self.stamp_ns(now_ns, boot_ms) else { return Measured::Unknown };
        let age_ns = now_ns.saturating_sub(stamp_ns);
        if !(-SLACK_NS..=MAX_BACKLOG_NS).contains(&age_ns) {
            Measured::Unknown
        } else if age_ns > MAX_AGE_NS {
            Measured::LongAgo
        } else {
            Measured::At(stamp_ns.min(now_ns))
        }
    }

    fn stamp_ns(&self, now_ns: i64, boot_ms: u32) -> Option<i64> {
        let offset_ns = self.best(now_ns)?.offset_ns;
        let theirs_ns = now_ns.checked_add(offset_ns)?;
        // The counter of milliseconds wraps after 49 days, so only the difference counts. It is truncated,
        // half a millisecond too early on average.
        let ahead_ms = boot_ms.wrapping_sub((theirs_ns / MS) as u32).cast_signed();
        let measured_ns = (theirs_ns / MS + i64::from(ahead_ms)) * MS + MS / 2;
        measured_ns.checked_sub(offset_ns)
    }

    fn best(&self, now_ns: i64) -> Option<Trip> {
        let recent =
            self.trips.iter().filter(|trip| now_ns.saturating_sub(trip.at_ns) <= WINDOW_NS);
        recent.min_by_key(|trip| trip.worth_ns(now_ns)).copied()
    }
}

impl Length {
    fn is_recent(&self, now_ns: i64, max_age_ns: i64) -> bool {
        now_ns.saturating_sub(self.at_ns) <= max_age_ns
    }
}

impl Trip {
    /// Twice its uncertainty.
    fn worth_ns(&self, now_ns: i64) -> i64 {
        let age_ns = now_ns.saturating_sub(self.at_ns).max(0);
        self.length_ns.saturating_add((2.0 * DRIFT * age_ns as f64) as i64)
    }

    /// True when two round trips contradict each other for clocks without a reset.
    fn contradicts(&self, later: &Self) -> bool {
        let apart_ns = later.offset_ns.abs_diff(self.offset_ns);
        let allowed_ns = self.worth_ns(later.at_ns) / 2 + later.length_ns / 2 + SLACK_NS;
        apart_ns > allowed_ns.unsigned_abs()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Makes `count` round trips with these delays in turn, with their clock this far ahead.
    fn synchronised(ways_ms: &[(i64, i64)], count: usize, ahead_ns: i64) -> (Clock, i64) {
        let (mut clock, mut now_ns) = (Clock::default(), 1_000 * MS);
        for i in 0..count {
            let (there, back) = ways_ms[i % ways_ms.len()];
            while clock.request(now_ns).is_none() {
                now_ns += 10 * MS;
            }
            let request_ns = now_ns;
            now_ns += (there + back) * MS;
            clock.answered(now_ns, request_ns + there * MS + ahead_ns, request_ns);
        }
        (clock, now_ns)
    }

    proptest! {
        #[test]
        fn jitter_costs_no_more_than_half_the_shortest_round_trip(
            ways in prop::collection::vec((0_i64..90, 0_i64..90), 1..40),
            ahead_ms in 0_i64..10_000_000,
            age_ms in 0_i64..900,
        ) {
            let ahead_ns = ahead_ms * MS;
            let (clock, now_ns) = synchronised(&ways, ways.len(), ahead_ns);
            let shortest_ms = ways.iter().map(|(a, b)| a + b).min().unwrap();
            let measured_ns = now_ns - age_ms * MS;
            let boot_ms = ((measured_ns + ahead_ns) / MS) as u32;
            let Measured::At(stamp_ns) = clock.measured(now_ns, boot_ms) else {
                // Only times in the future, or too long ago, are unknown.
                prop_assert!(age_ms * 2 <= shortest_ms || age_ms * 2 + shortest_ms > 5_990);
                return Ok(());
            };
            let wrong_ns = (stamp_ns - measured_ns).abs();
            prop_assert!(wrong_ns <= shortest_ms * MS / 2 + 4 * MS, "{} ms", wrong_ns / MS);
            prop_assert!(stamp_ns <= now_ns);
        }

        #[test]
        fn no_input_causes_a_panic_or_an_implausible_stamp(
            replies in prop::collection::vec((any::<i64>(), any::<i64>(), any::<i64>()), 0..40),
            boot_ms: u32,
        ) {
            let mut clock = Clock::default();
            for (now_ns, theirs_ns, ts1_ns) in replies {
                clock.request(now_ns);
                clock.answered(now_ns, theirs_ns, ts1_ns);
                clock.answered(now_ns, theirs_ns, now_ns);
                if let Measured::At(stamp_ns) = clock.measured(1_000 * MS, boot_ms) {
                    prop_assert!((-2_000 * MS..=1_000 * MS).contains(&stamp_ns));
                }
            }
        }
    }

    #[test]
    fn the_delay_of_repeated_packets_is_known_for_some_seconds() {
        let mut clock = Clock::default();
        assert_eq!(clock.behind_ns(0), 0);
        for (at_ms, behind_ms) in [(0, 300), (100, 800), (200, 20), (300, 60_000), (400, -5)] {
            clock.came_behind(at_ms * MS, behind_ms * MS);
        }
        assert_eq!(clock.behind_ns(10_100 * MS), 800 * MS);
        assert_eq!(clock.behind_ns(10_101 * MS), 0);
        clock.came_behind(10_200 * MS, 20 * MS);
        assert_eq!(clock.behind_ns(10_200 * MS), 20 * MS);
    }

    #[test]
    fn losses_count_as_a_delay_and_a_steady_stream_does_not() {
        let delay_ms = |period_ms: i64, keeps: fn(i64) -> bool| {
            let (mut clock, start_ns) = synchronised(&[(1, 1)], FIRST, 0);
            let end_ms = 3000;
            for ms in (0..end_ms).step_by(period_ms as usize) {
                if keeps(ms / period_ms) {
                    clock.position_arrived(start_ns + ms * MS);
                }
            }
            clock.link_delay_ns(start_ns + end_ms * MS).unwrap() / MS
        };
        assert_eq!(delay_ms(20, |_| true), 2);
        assert_eq!(delay_ms(50, |_| true), 2);
        // Four of five are lost: one after the other, and sixteen in a row.
        let lossy_ms = delay_ms(20, |i| i % 5 == 0);
        let bursty_ms = delay_ms(20, |i| i % 20 < 4);
        assert!((100..300).contains(&lossy_ms), "{lossy_ms} ms");
        assert!(bursty_ms > 2 * lossy_ms, "{bursty_ms} and {lossy_ms} ms");
    }

    #[test]
    fn the_links_delay_is_that_of_slow_round_trips_but_not_of_one() {
        assert_eq!(Clock::default().link_delay_ns(0), None);
        let (clock, now_ns) = synchronised(&[(1, 1), (1, 1), (250, 250), (1, 1)], 4, 0);
        assert_eq!(clock.link_delay_ns(now_ns), Some(2 * MS), "of one");
        let (clock, now_ns) = synchronised(&[(1, 1), (250, 250), (900, 900)], 12, 0);
        assert_eq!(clock.link_delay_ns(now_ns), Some(1_800 * MS));
        assert_eq!(clock.link_delay_ns(now_ns + 7_000 * MS), None);
    }

    #[test]
    fn late_measurements_show_a_slow_link_at_once() {
        let (mut clock, now_ns) = synchronised(&[(1, 1)], 20, 0);
        let mut arrive = |ages_ms: &[i64]| {
            for (at_ms, age_ms) in (0..).step_by(10).zip(ages_ms) {
                clock.arrived(now_ns + at_ms * MS, (now_ns / MS + at_ms - age_ms) as u32);
            }
            let delay_ns = clock.link_delay_ns(now_ns + 60 * MS);
            delay_ns.map(|delay_ns| (delay_ns as f64 / MS as f64).round() as i64)
        };
        assert_eq!(arrive(&[400; 5]), Some(2), "too few");
        assert!(
            arrive(&[400, 300, 350, 400, 400, 400]).is_some_and(|ms| (595..=605).contains(&ms))
        );
        assert_eq!(arrive(&[1, 400, 400, 400, 400, 400]), Some(2), "one came at once");
        assert_eq!(clock.link_delay_ns(now_ns + 2_000 * MS), Some(2 * MS), "no longer");
    }

    #[test]
    fn a_late_burst_keeps_its_own_times() {
        let (clock, now_ns) = synchronised(&[(1, 1), (40, 5)], 20, 77 * MS);
        for age_ms in [5, 50, 300] {
            let boot_ms = ((now_ns - age_ms * MS + 77 * MS) / MS) as u32;
            let Measured::At(stamp_ns) = clock.measured(now_ns, boot_ms) else { panic!() };
            assert!((now_ns - stamp_ns - age_ms * MS).abs() <= 2 * MS);
        }
        for (age_ms, expected) in [
            (3_500, Measured::LongAgo),
            (59_000, Measured::LongAgo),
            (61_000, Measured::Unknown),
            (-500, Measured::Unknown),
        ] {
            let boot_ms = ((now_ns - age_ms * MS + 77 * MS) / MS) as u32;
            assert_eq!(clock.measured(now_ns, boot_ms), expected, "{age_ms} ms");
        }
    }

    #[test]
    fn a_link_that_is_slow_from_the_start_is_known_to_be_and_not_asked_ten_times_a_second() {
        let (mut clock, mut under_way) = (Clock::default(), VecDeque::new());
        let mut requests = 0;
        for now_ms in (1_000..31_000).step_by(20) {
            if let Some(ts1_ns) = clock.request(now_ms * MS) {
                requests += 1;
                under_way.push_back(ts1_ns);
            }
            while let Some(ts1_ns) = under_way.pop_front_if(|ts1| *ts1 + 2_000 * MS <= now_ms * MS)
            {
                clock.answered(now_ms * MS, ts1_ns + 1_000 * MS, ts1_ns);
            }
        }
        assert_eq!(clock.link_delay_ns(31_000 * MS), Some(2_000 * MS));
        assert!(requests < 65, "{requests}");
    }

    #[test]
    fn the_counter_of_milliseconds_may_begin_again() {
        let ahead_ns = (i64::from(u32::MAX) - 500) * MS;
        let (clock, now_ns) = synchronised(&[(1, 1)], 20, ahead_ns);
        let boot_ms = ((now_ns + ahead_ns) / MS) as u32;
        assert!(boot_ms < 10_000, "it did");
        let Measured::At(stamp_ns) = clock.measured(now_ns, boot_ms) else { panic!() };
        assert!((stamp_ns - now_ns).abs() <= 2 * MS);
    }

    #[test]
    fn a_clock_that_was_set_is_believed_after_a_while() {
        let (mut clock, mut now_ns) = synchronised(&[(1, 1)], 20, 0);
        let trip = |clock: &mut Clock, now_ns: &mut i64| {
            while clock.request(*now_ns).is_none() {
                *now_ns += 10 * MS;
            }
            *now_ns += 2 * MS;
            clock.answered(*now_ns, *now_ns + 5_000 * MS - MS, *now_ns - 2 * MS)
        };
        assert_eq!([0; 3].map(|_| trip(&mut clock, &mut now_ns)), [false, false, true]);
        let boot_ms = ((now_ns + 5_000 * MS) / MS) as u32;
        assert!(matches!(clock.measured(now_ns, boot_ms), Measured::At(_)));
    }

    #[test]
    fn an_unknown_or_outdated_clock_gives_no_stamp() {
        assert_eq!(Clock::default().measured(1_000 * MS, 1_000), Measured::Unknown);
        let (clock, now_ns) = synchronised(&[(1, 1)], 20, 0);
        assert_eq!(clock.measured(now_ns + WINDOW_NS + MS, 0), Measured::Unknown);
        assert!(!Clock::default().answered(2 * MS, MS, MS), "without a request");
    }
}
