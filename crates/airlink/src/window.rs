//! Implements the air link's flow and congestion control: from acknowledgements of frames by each receiver to when the next
//! frame may be sent, on which lane, and how large it may be.
//!
//! A frame is sent only while fewer than `window` others are in flight, so that nothing queues on the link;
//! frames that come meanwhile are dropped at the camera. A frame that takes much longer than those before it
//! is delayed by a lost packet, and its TCP connection with it, for at least 200 ms when the packet is lost
//! again: the next frame overtakes it on the other of two connections, the lanes. A frame without an acknowledgement
//! counts as lost after a timeout. Once one of several receivers has acknowledged a frame, the others get
//! only a little more time, so that a slow or dead receiver does not block the rest. The size grows while the
//! mean round trip is below its target, and shrinks above it: a mean, because a lost packet delays a single
//! frame of any size. Of several receivers the one in use decides; while none of them is in use, the slowest.
//!
//! The caller gives the time, in nanoseconds of any clock.

use std::collections::VecDeque;

use crate::config::AirConfig;

/// Maximum number of receivers that are waited for.
const MAX_RECEIVERS: usize = 16;
/// Time without an acknowledgement after which a receiver is forgotten, in nanoseconds.
const RECEIVER_TIMEOUT_NS: i64 = 2_000_000_000;
/// Number of frames remembered for late acknowledgements.
const HISTORY: usize = 16;
/// Weight of a new round trip in the mean.
const MEAN_WEIGHT: f64 = 1.0 / 6.0;
/// Number of connections for frames.
const LANES: usize = 2;
/// Weight of a new deviation in the mean deviation (RFC 6298, section 2).
const DEVIATION_WEIGHT: f64 = 0.25;
/// A frame is overtaken this number of mean deviations after the mean round trip (RFC 6298, section 2).
const OVERTAKE_DEVIATIONS: f64 = 4.0;
/// Minimum of that time beyond the mean, in units of the mean.
const MIN_DEVIATION: f64 = 0.25;
/// Minimum time before a frame is overtaken, in units of the target round trip.
const MIN_OVERTAKE: f64 = 1.5;
/// Time the slower receivers of a frame are waited for, in units of the target round trip.
const OTHER_RECEIVERS_WAIT: f64 = 2.0;
/// Growth of the size for each frame that arrives in time.
const GROWTH: f64 = 1.04;
/// Minimum factor on the size for a frame that is late.
const MIN_SHRINK: f64 = 0.75;
/// Factor on the size for a lost frame.
const LOSS_SHRINK: f64 = 0.6;
/// Minimum fraction of the allowed size that a frame must use for the size to grow.
const MIN_USE: f64 = 0.6;
/// Maximum number of times that consecutive losses double the timeout.
const MAX_DOUBLINGS: u32 = 3;

/// The frames in flight and the receivers' answers.
#[derive(Clone, Debug)]
pub struct Window {
    max_in_flight: usize,
    timeout_ns: i64,
    target_ms: f64,
    min_bytes: f64,
    max_bytes: f64,
    size_bytes: f64,
    mean_ms: Option<f64>,
    deviation_ms: f64,
    lane: usize,
    consecutive_losses: u32,
    sent: VecDeque<Sent>,
    receivers: Vec<Receiver>,
    /// The receiver whose acknowledgements decide.
    in_use: Option<String>,
}

#[derive(Clone, Debug)]
struct Sent {
    sequence: u64,
    at_ns: i64,
    bytes: usize,
    lane: usize,
    is_in_flight: bool,
    /// True once any receiver has it.
    is_acknowledged: bool,
}

#[derive(Clone, Debug)]
struct Receiver {
    name: String,
    last_ack_ns: i64,
    sequence: u64,
}

impl Window {
    /// A window without frames in flight.
    pub fn new(config: &AirConfig) -> Self {
        let [min_bytes, max_bytes] = [config.min_kb, config.max_kb].map(|kb| kb * 1000.0);
        Self {
            max_in_flight: config.window as usize,
            timeout_ns: (config.timeout_ms * 1e6) as i64,
            target_ms: config.round_trip_ms,
            min_bytes,
            max_bytes,
            // The geometric mean: as many steps from either end.
            size_bytes: (min_bytes * max_bytes).sqrt(),
            mean_ms: None,
            deviation_ms: 0.0,
            lane: 0,
            consecutive_losses: 0,
            sent: VecDeque::new(),
            receivers: Vec::new(),
            in_use: None,
        }
    }

    /// Makes this receiver decide while it answers. With `None`, or while it does not, the slowest of all
    /// decides.
    pub fn use_receiver(&mut self, name: Option<String>) {
        self.in_use = name;
    }

    /// Maximum size of the next frame, in bytes.
    pub fn size_bytes(&self) -> usize {
        self.size_bytes as usize
    }

    /// Mean time from sending a frame to its acknowledgement, in milliseconds.
    pub fn round_trip_ms(&self) -> Option<f64> {
        self.mean_ms
    }

    /// Gives up overdue frames. Returns whether the next frame may be sent, and how many frames were lost.
    pub fn is_open(&mut self, now_ns: i64) -> (bool, usize) {
        self.remove_silent_receivers(now_ns);
        let timeout_ns = self.timeout_ns << self.consecutive_losses.min(MAX_DOUBLINGS);
        let others_ns = (OTHER_RECEIVERS_WAIT * self.target_ms * 1e6) as i64;
        let mut lost = 0;
        for sent in self.sent.iter_mut().filter(|sent| sent.is_in_flight) {
            let limit_ns = if sent.is_acknowledged { others_ns } else { timeout_ns };
            if now_ns - sent.at_ns >= limit_ns {
                sent.is_in_flight = false;
                lost += usize::from(!sent.is_acknowledged);
            }
        }
        // Subscribers that never send acknowledgements do not measure the link.
        if self.receivers.is_empty() {
            self.consecutive_losses = 0;
            lost = 0;
        } else if lost > 0 {
            self.consecutive_losses += 1;
            self.scale(LOSS_SHRINK);
        }
        (self.has_room(now_ns), lost)
    }

    /// Switches to a lane without a late frame, the present one first. True when there is one and the window
    /// is not full.
    fn has_room(&mut self, now_ns: i64) -> bool {
        let late_ns = self.late_ns();
        let mut in_flight = 0;
        let mut is_blocked = [false; LANES];
        for sent in self.sent.iter().filter(|sent| sent.is_in_flight) {
            if !sent.is_acknowledged && now_ns - sent.at_ns >= late_ns {
                is_blocked[sent.lane % LANES] = true;
            } else {
                in_flight += 1;
            }
        }
        let lanes = (0..LANES).map(|offset| (self.lane + offset) % LANES);
        match lanes.into_iter().find(|lane| !is_blocked[*lane]) {
            Some(lane) => self.lane = lane,
            None => return false,
        }
        in_flight < self.max_in_flight
    }

    /// Time without an acknowledgement after which a frame is overtaken, in nanoseconds.
    fn late_ns(&self) -> i64 {
        let Some(mean_ms) = self.mean_ms else { return self.timeout_ns };
        let late_ms =
            mean_ms + (OVERTAKE_DEVIATIONS * self.deviation_ms).max(MIN_DEVIATION * mean_ms);
        ((late_ms.max(MIN_OVERTAKE * self.target_ms) * 1e6) as i64).min(self.timeout_ns)
    }

    /// The lane of the next frame, 0 or 1.
    pub fn lane(&self) -> usize {
        self.lane
    }

    /// Records a frame that was sent.
    pub fn sent(&mut self, now_ns: i64, sequence: u64, bytes: usize) {
        if self.sent.len() == HISTORY {
            self.sent.pop_front();
        }
        self.sent.push_back(Sent {
            sequence,
            at_ns: now_ns,
            bytes,
            lane: self.lane,
            is_in_flight: true,
            is_acknowledged: false,
        });
    }

    /// Records an acknowledgement. Returns the time since the frame was sent, in milliseconds; `None` for an unknown
    /// frame.
    pub fn received(&mut self, now_ns: i64, receiver: &str, sequence: u64) -> Option<f64> {
        let sent = self.sent.iter_mut().find(|sent| sent.sequence == sequence)?;
        sent.is_acknowledged = true;
        let (took_ms, bytes) = ((now_ns - sent.at_ns) as f64 * 1e-6, sent.bytes);
        self.consecutive_losses = 0;
        self.remove_silent_receivers(now_ns);
        let has_room = self.receivers.len() < MAX_RECEIVERS;
        match self.receivers.iter_mut().find(|known| known.name == receiver) {
            Some(known) => {
                known.last_ack_ns = now_ns;
                known.sequence = known.sequence.max(sequence);
            }
            None if has_room => {
                self.receivers.push(Receiver {
                    name: receiver.to_owned(),
                    last_ack_ns: now_ns,
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
            sent.is_in_flight = false;
        }
        if decides && arrived >= sequence {
            self.adapt(took_ms, bytes);
        }
        Some(took_ms)
    }

    fn remove_silent_receivers(&mut self, now_ns: i64) {
        self.receivers.retain(|receiver| now_ns - receiver.last_ack_ns < RECEIVER_TIMEOUT_NS);
    }

    fn adapt(&mut self, took_ms: f64, bytes: usize) {
        // Clamped, because a lost packet does not measure the link; a link that becomes slow is followed in
        // some steps.
        let late_ms = self.late_ns() as f64 * 1e-6;
        let measured_ms = took_ms.min(late_ms);
        let mean_ms = match self.mean_ms {
            Some(mean_ms) => {
                let deviation_ms = (measured_ms - mean_ms).abs();
                self.deviation_ms += DEVIATION_WEIGHT * (deviation_ms - self.deviation_ms);
                mean_ms + MEAN_WEIGHT * (measured_ms - mean_ms)
            }
            None => {
                self.deviation_ms = measured_ms / 2.0;
                measured_ms
            }
        };
        self.mean_ms = Some(mean_ms);
        if mean_ms > self.target_ms {
            // A frame in time does not shrink the size, even while the mean is still high.
            if took_ms > self.target_ms {
                self.scale((self.target_ms / mean_ms).max(MIN_SHRINK));
            }
        } else if bytes as f64 > MIN_USE * self.size_bytes {
            // Smaller frames do not show that the link carries more.
            self.scale(GROWTH);
        }
    }

    fn scale(&mut self, factor: f64) {
        self.size_bytes = (self.size_bytes * factor).clamp(self.min_bytes, self.max_bytes);
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
            min_quality: 40,
            max_kb: 200.0,
            min_kb: 8.0,
            round_trip_ms: 50.0,
            window: 1,
            timeout_ms: 250.0,
        })
    }

    /// Sends frames at 15 Hz over a link; returns the final size in kilobytes.
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
                let travel_ms = 10.0 + bytes as f64 / bytes_per_ms;
                arrives = Some((now + (travel_ms * 1e6) as i64, sequence));
            }
        }
        window.size_bytes() as f64 / 1000.0
    }

    #[test]
    fn the_size_follows_the_rate_of_the_link() {
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
    fn a_frame_waits_until_the_last_one_arrived_or_is_overdue() {
        let mut window = window();
        assert!(window.is_open(0).0);
        window.sent(0, 1, 1000);
        assert!(!window.is_open(249 * MS).0);
        assert_eq!(window.received(30 * MS, "ground", 1), Some(30.0));
        assert!(window.is_open(30 * MS).0);
        // Both lanes are blocked.
        window.sent(40 * MS, 2, 1000);
        assert!(!window.is_open(129 * MS).0);
        assert_eq!((window.is_open(130 * MS), window.lane()), ((true, 0), 1));
        window.sent(130 * MS, 3, 1000);
        assert_eq!(window.is_open(289 * MS), (false, 0));
        let before = window.size_bytes();
        assert_eq!((window.is_open(290 * MS), window.lane()), ((true, 1), 0));
        assert!(window.size_bytes() < before);
        // The loss doubles the timeout.
        window.sent(300 * MS, 4, 1000);
        assert!(!window.is_open(629 * MS).0);
        assert_eq!(window.is_open(630 * MS), (true, 1));
    }

    #[test]
    fn a_steady_link_that_becomes_slow_is_followed() {
        let mut window = window();
        let after = |window: &mut Window, frames: std::ops::Range<u64>, took_ms: i64| {
            for sequence in frames {
                let now = sequence as i64 * 300 * MS;
                window.sent(now, sequence, 1000);
                window.received(now + took_ms * MS, "ground", sequence);
            }
            window.late_ns()
        };
        // No deviation.
        let late_ns = after(&mut window, 0..60, 58);
        // 1.5 times the target, or the mean and a quarter of it.
        assert!((72 * MS..=75 * MS).contains(&late_ns), "{late_ns}");
        let late_ns = after(&mut window, 60..120, 160);
        assert!(late_ns > 160 * MS, "{late_ns}");
    }

    #[test]
    fn a_delayed_frame_is_overtaken_on_the_other_lane() {
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
        // The lane stays. A single late frame shrinks the size only a little.
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

    /// The size next to a receiver that is always late, on a link that carries 100 kB in time.
    fn size_next_to_a_slow_receiver(in_use: Option<&str>) -> usize {
        let mut window = window();
        window.use_receiver(in_use.map(str::to_owned));
        for sequence in 0..200 {
            let now = sequence as i64 * 300 * MS;
            let bytes = window.size_bytes();
            window.sent(now, sequence, bytes);
            let travel_ms = 10 + bytes as i64 / 2500;
            window.received(now + travel_ms * MS, "good", sequence);
            window.received(now + 200 * MS, "slow", sequence);
        }
        window.size_bytes()
    }

    #[test]
    fn a_slow_receiver_shrinks_frames_only_while_no_other_is_in_use() {
        assert!((75_000..125_000).contains(&size_next_to_a_slow_receiver(Some("good"))));
        for in_use in [Some("slow"), None, Some("onboard, reads no JPEG")] {
            assert_eq!(size_next_to_a_slow_receiver(in_use), 8000, "{in_use:?}");
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
    fn a_dead_receiver_blocks_the_others_only_briefly() {
        let mut window = window();
        window.sent(0, 1, 1000);
        window.received(10 * MS, "near", 1);
        window.received(20 * MS, "gone", 1);
        window.sent(30 * MS, 2, 1000);
        window.received(40 * MS, "near", 2);
        assert_eq!(window.is_open(129 * MS), (false, 0));
        let before = window.size_bytes();
        assert_eq!(window.is_open(130 * MS), (true, 0));
        assert_eq!(window.size_bytes(), before, "it is not lost: one receiver has it");
    }

    #[test]
    fn acks_of_unknown_frames_are_ignored() {
        let mut window = window();
        assert_eq!(window.received(0, "ground", 7), None);
        window.sent(0, 1, 1000);
        assert_eq!(window.received(MS, "ground", u64::MAX), None);
        assert!(!window.is_open(2 * MS).0);
    }
}
