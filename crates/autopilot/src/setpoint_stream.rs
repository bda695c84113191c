//! The stream of setpoints that PX4's OFFBOARD needs, before it and during it.

use geometry::{Ned, Vector};

/// Time for which setpoints are sent before OFFBOARD is requested, in nanoseconds: PX4 enters it only after a
/// second of setpoints at 2 Hz or more (<https://docs.px4.io/main/en/flight_modes/offboard.html>).
const PROOF_NS: i64 = 1_300_000_000;
/// Maximum gap between two of them, in nanoseconds.
const MAX_GAP_NS: i64 = 300_000_000;
/// Period of these setpoints, in nanoseconds.
const PERIOD_NS: i64 = 50_000_000;
/// Time for which a velocity continues without another request, in nanoseconds: ticks are 25 ms apart.
const ASKED_NS: i64 = 60_000_000;

/// When setpoints were sent, and which are to be sent until when.
#[derive(Copy, Clone, Debug, Default)]
pub(crate) struct SetpointStream {
    /// Since when they have been sent without a gap, and when the last one was.
    span: Option<(i64, i64)>,
    /// A velocity in m/s, and until when it is sent.
    asked: Option<(Vector<Ned>, i64)>,
}

impl SetpointStream {
    /// A setpoint is sent now.
    pub(crate) fn sent(&mut self, now_ns: i64) {
        let since_ns = self.since_ns(now_ns).unwrap_or(now_ns);
        self.span = Some((since_ns, now_ns));
    }

    /// This velocity, in m/s, is sent until the next call, a tick later.
    pub(crate) fn ask_for(&mut self, now_ns: i64, velocity: Vector<Ned>) {
        self.asked = Some((velocity, now_ns.saturating_add(ASKED_NS)));
    }

    /// Whether a velocity was asked for up to the last tick.
    pub(crate) fn is_asked(&self, now_ns: i64) -> bool {
        self.asked.is_some_and(|(_, until_ns)| now_ns < until_ns)
    }

    /// The velocity that is to be sent now: the one that was asked for, else zeros where `is_requested` states that OFFBOARD is requested.
    pub(crate) fn due(&self, now_ns: i64, is_requested: bool) -> Option<Vector<Ned>> {
        let asked = self.asked.filter(|(_, until_ns)| now_ns < *until_ns);
        let zeros = is_requested.then(Vector::zero);
        let is_recent = |last_ns: i64| (0..PERIOD_NS).contains(&now_ns.saturating_sub(last_ns));
        let is_due = self.span.is_none_or(|(_, last_ns)| !is_recent(last_ns));
        asked.map(|(velocity, _)| velocity).or(zeros).filter(|_| is_due)
    }

    /// For how long setpoints must still be sent before OFFBOARD is requested, in nanoseconds.
    pub(crate) fn missing_ns(&self, now_ns: i64) -> i64 {
        let lasted_ns = self.since_ns(now_ns).map_or(0, |since_ns| now_ns.saturating_sub(since_ns));
        PROOF_NS.saturating_sub(lasted_ns).max(0)
    }

    /// When the last one was sent.
    pub(crate) fn last_ns(&self) -> Option<i64> {
        self.span.map(|(_, last_ns)| last_ns)
    }

    fn since_ns(&self, now_ns: i64) -> Option<i64> {
        let is_gap = |last_ns: i64| !(0..=MAX_GAP_NS).contains(&now_ns.saturating_sub(last_ns));
        self.span.filter(|(_, last_ns)| !is_gap(*last_ns)).map(|(since_ns, _)| since_ns)
    }
}
