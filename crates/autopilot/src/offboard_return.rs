//! Decides whether a PX4 that shows HOLD instead of OFFBOARD may only have missed our setpoints.
//!
//! PX4's reaction to missing setpoints is a failsafe (`COM_OBL_RC_ACT`): the mode that was chosen stays OFFBOARD, and it returns to it with
//! the next setpoint, within 30 ms. A HOLD that a pilot or a ground station has chosen does not end so. The heartbeat shows both as HOLD.
//! Where our own setpoints were interrupted just before, as this process did not run or the link was lost, HOLD is therefore undecided until
//! setpoints have been sent again for a while. Packets from the time of the interruption may be read after it, in any order.

use crate::mode::FlightMode;

/// Longest pause between setpoints that is no interruption, in nanoseconds: PX4 waits for half a second or more (`COM_OF_LOSS_T`).
const MAX_GAP_NS: i64 = 400_000_000;
/// Maximum age of the vehicle's last packet at which it is assumed to receive ours, in nanoseconds.
const MAX_SILENCE_NS: i64 = 300_000_000;
/// Time within which OFFBOARD must show again, in nanoseconds: heartbeats come each second, and one may be lost.
const RETURN_NS: i64 = 2_500_000_000;

/// The last interruption of the setpoints of a PX4 in OFFBOARD.
#[derive(Copy, Clone, Debug, Default)]
pub(crate) struct OffboardReturn {
    /// When a setpoint was sent last that the vehicle is assumed to have received in OFFBOARD.
    followed_ns: Option<i64>,
    /// When setpoints were first sent again after an interruption.
    resumed_ns: Option<i64>,
    /// Since when a HOLD shows that may end with our setpoints.
    holds_since_ns: Option<i64>,
}

impl OffboardReturn {
    /// A setpoint is sent now to a vehicle in this mode, whose last packet was received at `received_ns`.
    pub(crate) fn sent(&mut self, now_ns: i64, mode: FlightMode, received_ns: i64) {
        let is_received = now_ns.saturating_sub(received_ns) <= MAX_SILENCE_NS;
        if !is_received || mode != FlightMode::OFFBOARD && !self.is_expected(now_ns) {
            return;
        }
        if self.has_gap(now_ns) {
            self.resumed_ns = Some(now_ns);
        }
        self.followed_ns = Some(now_ns);
    }

    /// The vehicle is found in this mode by a controller that has sent it stops, as it takes over the landing of an earlier one.
    pub(crate) fn taken_over(&mut self, now_ns: i64, mode: FlightMode) {
        match mode {
            FlightMode::OFFBOARD => {
                (self.followed_ns, self.resumed_ns) = (Some(now_ns), Some(now_ns));
            }
            FlightMode::AUTO_HOLD => self.holds_since_ns = Some(now_ns),
            _ => {}
        }
    }

    /// The vehicle shows another mode than before.
    pub(crate) fn mode_changed(&mut self, now_ns: i64, from: FlightMode, to: FlightMode) {
        match (from, to) {
            (_, FlightMode::OFFBOARD) => self.holds_since_ns = None,
            (FlightMode::OFFBOARD, FlightMode::AUTO_HOLD) if self.is_interrupted(now_ns) => {
                self.holds_since_ns = Some(now_ns);
            }
            _ => *self = Self::default(),
        }
    }

    /// Whether the HOLD that shows may end as setpoints are sent again.
    pub(crate) fn is_expected(&self, now_ns: i64) -> bool {
        self.holds_since_ns.is_some_and(|since_ns| now_ns.saturating_sub(since_ns) < RETURN_NS)
    }

    fn is_interrupted(&self, now_ns: i64) -> bool {
        let is_recent = |at_ns: i64| now_ns.saturating_sub(at_ns) < RETURN_NS;
        self.has_gap(now_ns) || self.resumed_ns.is_some_and(is_recent)
    }

    fn has_gap(&self, now_ns: i64) -> bool {
        self.followed_ns.is_some_and(|at_ns| now_ns.saturating_sub(at_ns) > MAX_GAP_NS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;
    const OFFBOARD: FlightMode = FlightMode::OFFBOARD;
    const HOLD: FlightMode = FlightMode::AUTO_HOLD;

    /// Setpoints each 50 ms in OFFBOARD, until 1 s.
    fn followed() -> OffboardReturn {
        let mut offboard = OffboardReturn::default();
        for ms in (0..=1000).step_by(50) {
            offboard.sent(ms * MS, OFFBOARD, ms * MS);
        }
        offboard
    }

    #[test]
    fn hold_without_an_interruption_is_the_pilots() {
        let mut offboard = followed();
        offboard.mode_changed(1050 * MS, OFFBOARD, HOLD);
        assert!(!offboard.is_expected(1050 * MS));
        // So is another mode after one.
        let mut offboard = followed();
        offboard.mode_changed(4000 * MS, OFFBOARD, FlightMode::Px4(3 << 16));
        assert!(!offboard.is_expected(4000 * MS));
    }

    #[test]
    fn hold_after_an_interruption_is_undecided_whether_it_shows_before_or_after_the_next_setpoint()
    {
        let mut offboard = followed();
        offboard.mode_changed(4000 * MS, OFFBOARD, HOLD);
        assert!(offboard.is_expected(4000 * MS));
        offboard.sent(4010 * MS, HOLD, 4000 * MS);
        assert!(offboard.is_expected(6400 * MS) && !offboard.is_expected(6500 * MS));

        let mut offboard = followed();
        offboard.sent(4000 * MS, OFFBOARD, 4000 * MS);
        offboard.mode_changed(4500 * MS, OFFBOARD, HOLD);
        assert!(offboard.is_expected(4500 * MS));
        offboard.mode_changed(5000 * MS, HOLD, OFFBOARD);
        assert!(!offboard.is_expected(5000 * MS));
        // Long after it, HOLD is a choice again.
        for ms in (4050..8000).step_by(50) {
            offboard.sent(ms * MS, OFFBOARD, ms * MS);
        }
        offboard.mode_changed(8000 * MS, OFFBOARD, HOLD);
        assert!(!offboard.is_expected(8000 * MS));
    }

    #[test]
    fn setpoints_over_a_link_that_is_lost_are_not_received() {
        let mut offboard = followed();
        for ms in (1050..3000).step_by(50) {
            offboard.sent(ms * MS, OFFBOARD, 1000 * MS);
        }
        offboard.mode_changed(3010 * MS, OFFBOARD, HOLD);
        assert!(offboard.is_expected(3010 * MS));
    }

    #[test]
    fn a_hold_that_stays_is_a_choice_although_setpoints_have_ended() {
        let mut offboard = followed();
        offboard.mode_changed(4000 * MS, OFFBOARD, HOLD);
        for ms in (4000..6500).step_by(50) {
            offboard.sent(ms * MS, HOLD, ms * MS);
        }
        assert!(!offboard.is_expected(6500 * MS) && !offboard.is_expected(9000 * MS));
    }
}
