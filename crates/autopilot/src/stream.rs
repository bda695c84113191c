//! Requests message streams, measures their rates, and requests them again when they stop.
//!
//! An autopilot forgets requests when it restarts, another station may overwrite them, and some messages
//! begin long after their acknowledgement; so only the measured rate counts.

use crate::dialect::{COMMAND_LONG_DATA, MavCmd, MavMessage, MavResult, Message};
use crate::mode::Firmware;

/// PX4 sends ESTIMATOR_STATUS instead of ArduPilot's EKF_STATUS_REPORT, and its takeoff needs an altitude
/// above mean sea level, from GLOBAL_POSITION_INT.
const EKF_STATUS_REPORT: u32 = 193;
const ESTIMATOR_STATUS: u32 = 230;
const GLOBAL_POSITION_INT: u32 = 33;
/// PX4's heartbeat, once a second, may show a change of mode a second late. This one is sent with each change, and twice a second,
/// however high a rate is requested (1.17 in its own simulation: 20 ms after the change, at most 48 ms, at 200 Hz); versions before 1.15
/// do not have it. It also states the mode that was chosen, which a failsafe does not change. ArduPilot sends a heartbeat with each change.
const CURRENT_MODE: u32 = 436;

const SECOND_NS: i64 = 1_000_000_000;
/// Minimum measured rate, relative to the requested rate.
const MIN_RATE_RATIO: f64 = 0.7;
/// Minimum rate of a message that comes when its content changes, in Hz: PX4 sends its mode twice a second when that was requested, and
/// every two seconds otherwise.
const MIN_CHANGE_HZ: f64 = 0.9;
/// Timeout of an acknowledgement, in nanoseconds.
const ACK_NS: i64 = SECOND_NS;
/// Pause after a refused request, in nanoseconds.
const REFUSED_NS: i64 = 30 * SECOND_NS;
/// Time over which messages are counted, unless they are rare, in nanoseconds.
const COUNT_NS: i64 = 2 * SECOND_NS;
/// Maximum pause between requests without effect, in nanoseconds; it grows with their number.
const MAX_PAUSE_NS: i64 = 10 * SECOND_NS;
/// Number of requests without effect after which a missing message is reported.
const REPORT_AFTER: u32 = 2;
/// Time for which a message may be missing at first, in nanoseconds: ArduPilot acknowledges its position at
/// once, and has one after 20 to 40 s.
const BEGINNING_NS: i64 = 60 * SECOND_NS;

/// A requested message.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Stream {
    /// The message id.
    pub message_id: u32,
    /// Requested rate, in Hz.
    pub rate_hz: f64,
    /// Its expected behaviour.
    pub expected: Expected,
}

/// The expected behaviour of a requested message.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Expected {
    /// It comes at its rate; its absence is reported.
    Always,
    /// It comes at its rate if at all: a rangefinder may not exist.
    IfPresent,
    /// It comes when its content changes, at most at its rate, and else once a second or more often.
    OnChange,
}

/// A report about a stream.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Notice {
    Missing { message: &'static str, wanted_hz: f64, measured_hz: f64 },
    Restored { message: &'static str, measured_hz: f64 },
}

/// All streams of one autopilot.
#[derive(Clone, Debug)]
pub(crate) struct Streams {
    list: Vec<Watched>,
    /// The stream whose request waits for its acknowledgement (which does not name the message), and until
    /// when.
    asking: Option<(usize, i64)>,
}

#[derive(Clone, Debug)]
struct Watched {
    stream: Stream,
    name: &'static str,
    /// When to request it; none while messages are counted.
    ask_at_ns: Option<i64>,
    /// Number of requests without effect, or 1, and the time of the last.
    requests: u32,
    request_ns: i64,
    count: u32,
    since_ns: i64,
    missing: bool,
    /// It has arrived since the last restart.
    began: bool,
    first_request_ns: Option<i64>,
}

impl Streams {
    pub(crate) fn new(streams: &[Stream]) -> Self {
        let list =
            streams.iter().filter(|s| s.rate_hz.is_finite() && s.rate_hz > 0.0).map(|&stream| {
                Watched {
                    stream,
                    name: message_name(stream.message_id),
                    ask_at_ns: Some(i64::MIN),
                    requests: 0,
                    request_ns: 0,
                    count: 0,
                    since_ns: 0,
                    missing: false,
                    began: false,
                    first_request_ns: None,
                }
            });
        Self { list: list.collect(), asking: None }
    }

    /// Requests everything again.
    pub(crate) fn restart(&mut self) {
        self.asking = None;
        for watched in &mut self.list {
            watched.ask_at_ns = Some(i64::MIN);
            watched.requests = 0;
            watched.began = false;
            watched.first_request_ns = None;
        }
    }

    pub(crate) fn received(&mut self, now_ns: i64, message_id: u32) {
        for watched in &mut self.list {
            if watched.stream.message_id == message_id {
                // It began during the count.
                if !std::mem::replace(&mut watched.began, true) && watched.ask_at_ns.is_none() {
                    watched.restart_count(now_ns);
                }
                watched.count = watched.count.saturating_add(1);
            }
        }
    }

    /// The autopilot acknowledged the pending request.
    pub(crate) fn acknowledged(&mut self, now_ns: i64, result: MavResult) {
        let Some((index, _)) = self.asking.take() else { return };
        let Some(watched) = self.list.get_mut(index) else { return };
        match result {
            MavResult::MAV_RESULT_ACCEPTED => watched.restart_count(now_ns),
            MavResult::MAV_RESULT_TEMPORARILY_REJECTED | MavResult::MAV_RESULT_IN_PROGRESS => {
                watched.ask_at_ns = Some(now_ns.saturating_add(SECOND_NS));
            }
            _ => watched.ask_at_ns = Some(now_ns.saturating_add(REFUSED_NS)),
        }
    }

    /// Checks the rates; returns reports and the next request.
    pub(crate) fn tick(&mut self, now_ns: i64) -> (Vec<Notice>, Option<MavMessage>) {
        let notices = self.list.iter_mut().filter_map(|watched| watched.judge(now_ns)).collect();
        if let Some((index, until_ns)) = self.asking {
            if now_ns < until_ns {
                return (notices, None);
            }
            // Without an acknowledgement it is requested again after the others; it may have been received
            // all the same.
            self.asking = None;
            if let Some(watched) = self.list.get_mut(index) {
                watched.ask_at_ns = Some(now_ns);
            }
        }
        let due = self.list.iter().enumerate().filter_map(|(i, w)| Some((w.ask_at_ns?, i)));
        let Some((at_ns, index)) = due.min() else { return (notices, None) };
        let Some(watched) = self.list.get_mut(index).filter(|_| at_ns <= now_ns) else {
            return (notices, None);
        };
        watched.requests = watched.requests.saturating_add(1);
        watched.request_ns = now_ns;
        watched.first_request_ns.get_or_insert(now_ns);
        self.asking = Some((index, now_ns.saturating_add(ACK_NS)));
        (notices, Some(request(watched.stream)))
    }
}

impl Watched {
    fn restart_count(&mut self, now_ns: i64) {
        self.ask_at_ns = None;
        self.count = 0;
        self.since_ns = now_ns;
    }

    fn judge(&mut self, now_ns: i64) -> Option<Notice> {
        if self.ask_at_ns.is_some() {
            return None;
        }
        let (usual_hz, min_hz) = match self.stream.expected {
            Expected::OnChange => (MIN_CHANGE_HZ, MIN_CHANGE_HZ),
            _ => (self.stream.rate_hz, MIN_RATE_RATIO * self.stream.rate_hz),
        };
        let is_required = self.stream.expected == Expected::Always;
        let periods_ns = (5.0 / usual_hz * SECOND_NS as f64) as i64;
        let elapsed_ns = now_ns.saturating_sub(self.since_ns);
        if elapsed_ns < COUNT_NS.max(periods_ns) {
            return None;
        }
        let measured_hz = f64::from(self.count) / (elapsed_ns as f64 / SECOND_NS as f64);
        self.restart_count(now_ns);
        if measured_hz >= min_hz {
            self.requests = 1;
            let restored = std::mem::take(&mut self.missing);
            return restored.then_some(Notice::Restored { message: self.name, measured_hz });
        }
        if !is_required && measured_hz == 0.0 {
            return None;
        }
        let pause_ns = COUNT_NS.saturating_mul(self.requests.into()).min(MAX_PAUSE_NS);
        if now_ns.saturating_sub(self.request_ns) >= pause_ns {
            self.ask_at_ns = Some(now_ns);
        }
        let waits = !self.began
            && self.first_request_ns.is_some_and(|at| now_ns.saturating_sub(at) < BEGINNING_NS);
        let is_report = self.requests >= REPORT_AFTER && is_required && !self.missing && !waits;
        self.missing |= is_report;
        let wanted_hz = self.stream.rate_hz;
        is_report.then_some(Notice::Missing { message: self.name, wanted_hz, measured_hz })
    }
}

fn request(stream: Stream) -> MavMessage {
    MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
        command: MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL,
        // A message id has 24 bits, which a 32-bit float holds exactly.
        param1: stream.message_id as f32,
        param2: (1e6 / stream.rate_hz).round() as f32,
        ..Default::default()
    })
}

fn message_name(id: u32) -> &'static str {
    MavMessage::default_message_from_id(id).map_or("unknown message", |m| m.message_name())
}

/// The streams with the message ids of this firmware.
pub(crate) fn of_firmware(firmware: Firmware, streams: &[Stream]) -> Vec<Stream> {
    let mut streams = streams.to_vec();
    if firmware == Firmware::Px4 {
        for stream in streams.iter_mut().filter(|s| s.message_id == EKF_STATUS_REPORT) {
            stream.message_id = ESTIMATOR_STATUS;
        }
        let more = |message_id, rate_hz, expected| Stream { message_id, rate_hz, expected };
        streams.push(more(GLOBAL_POSITION_INT, 2.0, Expected::Always));
        streams.push(more(CURRENT_MODE, 100.0, Expected::OnChange));
    }
    streams
}

#[cfg(test)]
mod tests {
    use super::*;

    const ATTITUDE: Stream = Stream { message_id: 30, rate_hz: 50.0, expected: Expected::Always };
    const RANGE: Stream = Stream { message_id: 132, rate_hz: 10.0, expected: Expected::IfPresent };

    /// Runs for `seconds` in steps of 20 ms; an acknowledged message then comes in every `every`-th step.
    fn run(
        streams: &mut Streams,
        from_s: i64,
        seconds: i64,
        result: Option<MavResult>,
        every: i64,
    ) -> (Vec<Notice>, Vec<u32>) {
        let (mut notices, mut requests) = (Vec::new(), Vec::new());
        for step in 0..seconds * 50 {
            let now_ns = from_s * SECOND_NS + step * 20_000_000;
            let (reports, request) = streams.tick(now_ns);
            notices.extend(reports);
            if let Some(MavMessage::COMMAND_LONG(request)) = request {
                requests.push(request.param1 as u32);
                if let Some(result) = result {
                    streams.acknowledged(now_ns, result);
                }
            }
            if every > 0 && step % every == 0 {
                streams.received(now_ns, 30);
            }
        }
        (notices, requests)
    }

    const OK: Option<MavResult> = Some(MavResult::MAV_RESULT_ACCEPTED);

    #[test]
    fn a_message_at_its_rate_is_requested_once() {
        let mut streams = Streams::new(&[ATTITUDE, RANGE]);
        let (notices, requests) = run(&mut streams, 0, 30, OK, 1);
        assert_eq!(requests, [30, 132]);
        assert!(notices.is_empty());
    }

    #[test]
    fn a_message_that_stops_is_requested_again_and_its_return_reported() {
        let mut streams = Streams::new(&[ATTITUDE]);
        run(&mut streams, 0, 10, OK, 1);
        let (notices, requests) = run(&mut streams, 10, 40, OK, 12);
        assert!((3..12).contains(&requests.len()), "{requests:?}");
        assert!(matches!(
            notices[..],
            [Notice::Missing { message: "ATTITUDE", wanted_hz: 50.0, .. }]
        ));
        let (notices, _) = run(&mut streams, 50, 20, OK, 1);
        assert!(matches!(notices[..], [Notice::Restored { message: "ATTITUDE", .. }]));
    }

    #[test]
    fn a_stream_that_begins_late_is_no_alarm_and_one_that_never_begins_is() {
        let mut streams = Streams::new(&[ATTITUDE]);
        let (notices, _) = run(&mut streams, 0, 40, OK, 0);
        assert!(notices.is_empty(), "{notices:?}");
        assert!(run(&mut streams, 40, 20, OK, 1).0.is_empty());
        let mut streams = Streams::new(&[ATTITUDE]);
        let (notices, _) = run(&mut streams, 0, 80, OK, 0);
        assert!(matches!(notices[..], [Notice::Missing { measured_hz: 0.0, .. }]), "{notices:?}");
    }

    #[test]
    fn a_lost_request_is_repeated_and_a_refused_one_rests() {
        let mut streams = Streams::new(&[ATTITUDE]);
        let (_, requests) = run(&mut streams, 0, 5, None, 0);
        assert_eq!(requests.len(), 5);
        let mut streams = Streams::new(&[ATTITUDE]);
        let (_, requests) = run(&mut streams, 0, 29, Some(MavResult::MAV_RESULT_DENIED), 0);
        assert_eq!(requests.len(), 1);
    }

    #[test]
    fn after_a_restart_everything_is_requested_again() {
        let mut streams = Streams::new(&[ATTITUDE, RANGE]);
        run(&mut streams, 0, 10, OK, 1);
        streams.restart();
        assert_eq!(run(&mut streams, 10, 10, OK, 1).1, [30, 132]);
    }
}
