//! When the next frame may go, and how large it may be: a window of frames under way, and a size that follows the time
//! until they arrive.
//!
//! A frame is sent only while fewer than `window` others are under way, so nothing queues up on the way, whatever the
//! link carries: frames that come meanwhile are left out at the camera. A frame that takes much longer than those before it
//! is held up by a lost packet, and with it its connection, for at least 200 ms when the packet is lost again (TCP): the
//! next frame overtakes it on the other of two connections, the lanes. A frame that nobody has answered after a while
//! counts as lost; one that the first of several receivers has answered is waited for a little longer only, so that a
//! receiver that is slow or gone does not hold up the others. The size grows while frames arrive sooner than aimed at, and
//! shrinks while they arrive later; the mean of some frames decides, because a lost packet delays a single frame whatever
//! its size. Of several receivers the one in use decides; while none of them is in use, the slowest.
//!
//! Time is any clock's, in nanoseconds, given by the caller.

use std::collections::VecDeque;

use crate::config::AirConfig;

/// Receivers that are waited for; further ones get what the others can take.
const MOST_RECEIVERS: usize = 16;
/// A receiver that has not answered for this time is not waited for, in nanoseconds.
const SILENT_NS: i64 = 2_000_000_000;
/// Frames whose way is remembered for late answers.
const REMEMBERED: usize = 16;
/// Part of a new time in the mean.
const WEIGHT: f64 = 1.0 / 6.0;
/// Connections for frames.
const LANES: usize = 2;
/// Part of a new deviation in the mean deviation, and how many of those a frame may take longer than the mean before it is
/// overtaken (RFC 6298, section 2).
const DEVIATION_WEIGHT: f64 = 0.25;
const DEVIATIONS: f64 = 4.0;
/// A frame is never overtaken before this many times the time aimed at, and the mean and this part of it.
const LEAST_PATIENCE: f64 = 1.5;
const LEAST_DEVIATION: f64 = 0.25;
/// The slower receivers of a frame are waited for so many times the time aimed at.
const PATIENCE_WITH_OTHERS: f64 = 2.0;
/// How fast the size grows with every frame that arrives in time.
const GROWTH: f64 = 1.04;
/// How much it shrinks at most with one that does not.
const LEAST_SHRINK: f64 = 0.75;
/// How much it shrinks with one that is lost.
const LOSS_SHRINK: f64 = 0.6;
/// Each loss in a row makes the wait for the next twice as long, so many times at most.
const MOST_DOUBLINGS: u32 = 3;

/// The frames under way.
#[derive(Clone, Debug)]
pub struct Window {
    limit: usize,
    timeout_ns: i64,
    aim_ms: f64,
    bounds: [f64; 2],
    size_bytes: f64,
    mean_ms: Option<f64>,
    deviation_ms: f64,
    lane: usize,
    losses_in_a_row: u32,
    sent: VecDeque<Sent>,
    receivers: Vec<Receiver>,
    /// The receiver whose answers are used.
    in_use: Option<String>,
}

#[derive(Clone, Debug)]
struct Sent {
    sequence: u64,
    at_ns: i64,
    bytes: usize,
    lane: usize,
    /// Still waited for.
    is_under_way: bool,
    /// Somebody has it.
    is_answered: bool,
}

#[derive(Clone, Debug)]
struct Receiver {
    name: String,
    heard_ns: i64,
    sequence: u64,
}

impl Window {
    /// Nothing is under way yet.
    pub fn new(config: &AirConfig) -> Self {
        let bounds = [config.smallest_kb * 1000.0, config.largest_kb * 1000.0];
        Self {
            limit: config.window as usize,
            timeout_ns: (config.timeout_ms * 1e6) as i64,
            aim_ms: config.round_trip_ms,
            bounds,
            // The middle of what is possible, in proportion: from there either end is as near.
            size_bytes: (bounds[0] * bounds[1]).sqrt(),
            mean_ms: None,
            deviation_ms: 0.0,
            lane: 0,
            losses_in_a_row: 0,
            sent: VecDeque::new(),
            receivers: Vec::new(),
            in_use: None,
        }
    }

    /// From now on this receiver alone decides, while it answers; with `None`, or while it does not, the slowest of all does.
    pub fn use_receiver(&mut self, name: Option<String>) {
        self.in_use = name;
    }

    /// Bytes that the next frame should have at most.
    pub fn size_bytes(&self) -> usize {
        self.size_bytes as usize
    }

    /// Mean time until a frame is known to have arrived, in milliseconds.
    pub fn round_trip_ms(&self) -> Option<f64> {
        self.mean_ms
    }

    /// True when the next frame may go; frames that are overdue are given up. The number tells how many were.
    pub fn is_open(&mut self, now_ns: i64) -> (bool, usize) {
        self.forget_the_silent(now_ns);
        let patience_ns = self.timeout_ns << self.losses_in_a_row.min(MOST_DOUBLINGS);
        let with_others_ns = (PATIENCE_WITH_OTHERS * self.aim_ms * 1e6) as i64;
        let mut lost = 0;
        for sent in self.sent.iter_mut().filter(|sent| sent.is_under_way) {
            let limit_ns = if sent.is_answered { with_others_ns } else { patience_ns };
            if now_ns - sent.at_ns >= limit_ns {
                sent.is_under_way = false;
                lost += usize::from(!sent.is_answered);
            }
        }
        // Who never answers (a recorder, say) says nothing of the link.
        if self.receivers.is_empty() {
            self.losses_in_a_row = 0;
            lost = 0;
        } else if lost > 0 {
            self.losses_in_a_row += 1;
            self.scale(LOSS_SHRINK);
        }
        (self.has_room(now_ns), lost)
    }

    /// Looks for a lane on which nothing is late, the present one first.
    fn has_room(&mut self, now_ns: i64) -> bool {
        let late_ns = self.late_ns();
        let mut under_way = 0;
        let mut is_held_up = [false; LANES];
        for sent in self.sent.iter().filter(|sent| sent.is_under_way) {
            if !sent.is_answered && now_ns - sent.at_ns >= late_ns {
                is_held_up[sent.lane % LANES] = true;
            } else {
                under_way += 1;
            }
        }
        let lanes = (0..LANES).map(|further| (self.lane + further) % LANES);
        match lanes.into_iter().find(|lane| !is_held_up[*lane]) {
            Some(lane) => self.lane = lane,
            None => return false,
        }
        under_way < self.limit
    }

    /// After this time without an answer a frame is overtaken.
    fn late_ns(&self) -> i64 {
        let Some(mean_ms) = self.mean_ms else { return self.timeout_ns };
        let late_ms = mean_ms + (DEVIATIONS * self.deviation_ms).max(LEAST_DEVIATION * mean_ms);
        ((late_ms.max(LEAST_PATIENCE * self.aim_ms) * 1e6) as i64).min(self.timeout_ns)
    }

    /// The connection for the next frame, 0 or 1.
    pub fn lane(&self) -> usize {
        self.lane
    }

    /// A frame was sent.
    pub fn sent(&mut self, now_ns: i64, sequence: u64, bytes: usize) {
        if self.sent.len() == REMEMBERED {
            self.sent.pop_front();
        }
        self.sent.push_back(Sent {
            sequence,
            at_ns: now_ns,
            bytes,
            lane: self.lane,
            is_under_way: true,
            is_answered: false,
        });
    }

    /// A receiver has a frame; the answer is how long that took since it was sent, in milliseconds.
    pub fn received(&mut self, now_ns: i64, receiver: &str, sequence: u64) -> Option<f64> {
        let sent = self.sent.iter_mut().find(|sent| sent.sequence == sequence)?;
        sent.is_answered = true;
        let (took_ms, bytes) = ((now_ns - sent.at_ns) as f64 * 1e-6, sent.bytes);
        self.losses_in_a_row = 0;
        self.forget_the_silent(now_ns);
        let has_room = self.receivers.len() < MOST_RECEIVERS;
        match self.receivers.iter_mut().find(|known| known.name == receiver) {
            Some(known) => {
                known.heard_ns = now_ns;
                known.sequence = known.sequence.max(sequence);
            }
            None if has_room => {
                self.receivers.push(Receiver {
                    name: receiver.to_owned(),
                    heard_ns: now_ns,
                    sequence,
                });
            }
            None => {}
        }
        let in_use = self.receivers.iter().find(|known| Some(&known.name) == self.in_use.as_ref());
        let slowest = self.receivers.iter().min_by_key(|known| known.sequence);
        let decides = in_use.is_none_or(|known| known.name == receiver);
        let arrived = in_use.or(slowest).map_or(sequence, |known| known.sequence);
        for sent in self.sent.iter_mut().filter(|sent| sent.sequence <= arrived) {
            sent.is_under_way = false;
        }
        if decides && arrived >= sequence {
            self.adapt(took_ms, bytes);
        }
        Some(took_ms)
    }

    fn forget_the_silent(&mut self, now_ns: i64) {
        self.receivers.retain(|receiver| now_ns - receiver.heard_ns < SILENT_NS);
    }

    fn adapt(&mut self, took_ms: f64, bytes: usize) {
        // What a lost packet costs is no measure of the link; a link that has become slow is followed in some steps.
        let most_ms = self.late_ns() as f64 * 1e-6;
        let measured_ms = took_ms.min(most_ms);
        let mean_ms = match self.mean_ms {
            Some(mean_ms) => {
                let deviation_ms = (measured_ms - mean_ms).abs();
                self.deviation_ms += DEVIATION_WEIGHT * (deviation_ms - self.deviation_ms);
                mean_ms + WEIGHT * (measured_ms - mean_ms)
            }
            None => {
                self.deviation_ms = measured_ms / 2.0;
                measured_ms
            }
        };
        self.mean_ms = Some(mean_ms);
        if mean_ms > self.aim_ms {
            // A mean that is high for what was is not held against what is.
            if took_ms > self.aim_ms {
                self.scale((self.aim_ms / mean_ms).max(LEAST_SHRINK));
            }
        } else if bytes as f64 > 0.6 * self.size_bytes {
            // A size that is not used says nothing of what the link would carry.
            self.scale(GROWTH);
        }
    }

    fn scale(&mut self, factor: f64) {
        let [least, most] = self.bounds;
        self.size_bytes = (self.size_bytes * factor).clamp(least, most);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Mode;

    const MS: i64 = 1_000_000;

    fn window() -> Window {
        Window::new(&AirConfig {
            mode: Mode::Full,
            quality: 75,
            quality_least: 40,
            largest_kb: 200.0,
            smallest_kb: 8.0,
            round_trip_ms: 50.0,
            window: 1,
            timeout_ms: 250.0,
        })
    }

    /// Sends frames at 15 Hz for a time over a link of a rate; the size in the end, in kilobytes.
    fn settled_kb(window: &mut Window, from: u64, frames: u64, bytes_per_ms: f64) -> f64 {
        let mut arrives: Option<(i64, u64)> = None;
        for sequence in from..from + frames {
            let now = sequence as i64 * 66 * MS;
            if let Some((at, sequence)) = arrives.filter(|(at, _)| *at <= now) {
                window.received(at, "ground", sequence);
                arrives = None;
            }
            if window.is_open(now).0 {
                let bytes = window.size_bytes();
                window.sent(now, sequence, bytes);
                let way_ms = 10.0 + bytes as f64 / bytes_per_ms;
                arrives = Some((now + (way_ms * 1e6) as i64, sequence));
            }
        }
        window.size_bytes() as f64 / 1000.0
    }

    #[test]
    fn the_size_follows_what_the_link_carries() {
        let mut window = window();
        // 20 Mbit/s carry 2500 bytes in a millisecond: 100 kB in the 40 ms that are left of 50.
        let fast = settled_kb(&mut window, 0, 200, 2500.0);
        assert!((75.0..125.0).contains(&fast), "{fast} kB");
        let slow = settled_kb(&mut window, 200, 200, 500.0);
        assert!((13.0..25.0).contains(&slow), "{slow} kB");
        let again = settled_kb(&mut window, 400, 200, 2500.0);
        assert!((75.0..125.0).contains(&again), "{again} kB");
    }

    #[test]
    fn nothing_is_sent_before_the_last_frame_arrived_or_is_overdue() {
        let mut window = window();
        assert!(window.is_open(0).0);
        window.sent(0, 1, 1000);
        assert!(!window.is_open(249 * MS).0);
        assert_eq!(window.received(30 * MS, "ground", 1), Some(30.0));
        assert!(window.is_open(30 * MS).0);
        // Both lanes are held up.
        window.sent(40 * MS, 2, 1000);
        assert!(!window.is_open(129 * MS).0);
        assert_eq!((window.is_open(130 * MS), window.lane()), ((true, 0), 1));
        window.sent(130 * MS, 3, 1000);
        assert_eq!(window.is_open(289 * MS), (false, 0));
        let before = window.size_bytes();
        assert_eq!((window.is_open(290 * MS), window.lane()), ((true, 1), 0));
        assert!(window.size_bytes() < before);
        // The next loss takes longer to believe.
        window.sent(300 * MS, 4, 1000);
        assert!(!window.is_open(629 * MS).0);
        assert_eq!(window.is_open(630 * MS), (true, 1));
    }

    #[test]
    fn a_link_that_becomes_slow_after_a_steady_time_is_followed() {
        let mut window = window();
        let after = |window: &mut Window, frames: std::ops::Range<u64>, took_ms: i64| {
            for sequence in frames {
                let now = sequence as i64 * 300 * MS;
                window.sent(now, sequence, 1000);
                window.received(now + took_ms * MS, "ground", sequence);
            }
            window.late_ns()
        };
        // Ever the same time: nothing deviates.
        let late_ns = after(&mut window, 0..60, 58);
        // 1.5 times what is aimed at, or the mean and a quarter of it.
        assert!((72 * MS..=75 * MS).contains(&late_ns), "{late_ns}");
        let late_ns = after(&mut window, 60..120, 160);
        assert!(late_ns > 160 * MS, "{late_ns}");
    }

    #[test]
    fn a_frame_that_is_held_up_is_overtaken_on_the_other_lane() {
        let mut window = window();
        let mut now = 0;
        for sequence in 0..20 {
            window.sent(now, sequence, 1000);
            window.received(now + (20 + sequence as i64 % 3) * MS, "ground", sequence);
            now += 66 * MS;
        }
        window.sent(now, 20, 1000);
        assert!(!window.is_open(now + 74 * MS).0);
        assert_eq!((window.is_open(now + 75 * MS), window.lane()), ((true, 0), 1));
        window.sent(now + 132 * MS, 21, 1000);
        window.received(now + 152 * MS, "ground", 21);
        // It stays there, as the first lane has lost its pace; what comes late makes the frames little smaller.
        let before = window.size_bytes();
        assert_eq!(window.received(now + 240 * MS, "ground", 20), Some(240.0));
        assert_eq!((window.is_open(now + 240 * MS), window.lane()), ((true, 0), 1));
        assert!(window.size_bytes() as f64 > 0.9 * before as f64);
    }

    #[test]
    fn the_slowest_receiver_decides_until_it_is_silent() {
        let mut window = window();
        window.sent(0, 1, 1000);
        window.received(10 * MS, "near", 1);
        window.received(20 * MS, "far", 1);
        window.sent(30 * MS, 2, 1000);
        window.received(40 * MS, "near", 2);
        assert!(!window.is_open(50 * MS).0, "the far one has not got it");
        window.received(60 * MS, "far", 2);
        assert!(window.is_open(60 * MS).0);
        window.sent(2500 * MS, 3, 1000);
        window.received(2510 * MS, "near", 3);
        assert!(window.is_open(2510 * MS).0, "the far one has been silent for too long");
    }

    /// A good link carries 100 kB in time, a slow one beside it nothing.
    fn size_beside_a_slow_one(in_use: Option<&str>) -> usize {
        let mut window = window();
        window.use_receiver(in_use.map(str::to_owned));
        for sequence in 0..200 {
            let now = sequence as i64 * 300 * MS;
            let bytes = window.size_bytes();
            window.sent(now, sequence, bytes);
            let way_ms = 10 + bytes as i64 / 2500;
            window.received(now + way_ms * MS, "good", sequence);
            window.received(now + 200 * MS, "slow", sequence);
        }
        window.size_bytes()
    }

    #[test]
    fn a_slow_receiver_makes_frames_smaller_only_while_no_other_is_in_use() {
        assert!((75_000..125_000).contains(&size_beside_a_slow_one(Some("good"))));
        for in_use in [Some("slow"), None, Some("onboard, reads no JPEG")] {
            assert_eq!(size_beside_a_slow_one(in_use), 8000, "{in_use:?}");
        }
    }

    #[test]
    fn only_the_receiver_in_use_is_waited_for() {
        let mut window = window();
        window.use_receiver(Some("far".to_owned()));
        window.sent(0, 1, 1000);
        window.received(10 * MS, "near", 1);
        assert!(window.is_open(11 * MS).0, "the far one is not known yet");
        window.received(20 * MS, "far", 1);
        window.sent(30 * MS, 2, 1000);
        window.received(40 * MS, "near", 2);
        assert!(!window.is_open(50 * MS).0, "the far one has not got it");
        window.use_receiver(Some("near".to_owned()));
        window.sent(60 * MS, 3, 1000);
        window.received(70 * MS, "near", 3);
        assert!(window.is_open(70 * MS).0);
    }

    #[test]
    fn a_receiver_that_is_gone_or_slow_holds_the_others_up_for_a_moment_only() {
        let mut window = window();
        window.sent(0, 1, 1000);
        window.received(10 * MS, "near", 1);
        window.received(20 * MS, "gone", 1);
        window.sent(30 * MS, 2, 1000);
        window.received(40 * MS, "near", 2);
        assert_eq!(window.is_open(129 * MS), (false, 0));
        let before = window.size_bytes();
        assert_eq!(window.is_open(130 * MS), (true, 0));
        assert_eq!(window.size_bytes(), before, "it is not lost: somebody has it");
    }

    #[test]
    fn receipts_of_frames_that_were_never_sent_are_not_believed() {
        let mut window = window();
        assert_eq!(window.received(0, "ground", 7), None);
        window.sent(0, 1, 1000);
        assert_eq!(window.received(MS, "ground", u64::MAX), None);
        assert!(!window.is_open(2 * MS).0);
    }
}
