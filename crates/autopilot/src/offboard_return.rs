//! Decides whether a PX4 that shows HOLD instead of OFFBOARD may only have missed our setpoints.
//!
//! PX4's reaction to missing setpoints is a failsafe (`COM_OBL_RC_ACT`): the mode that was chosen stays OFFBOARD, and it returns to it with
//! the next setpoint, within 30 ms. A HOLD that a pilot or a ground station has chosen does not end so. Packets from the time of an
//! interruption may be read after it, in any order.
//!
//! Since 1.15 PX4's CURRENT_MODE states both modes, with each change of one of them and twice a second (`streams/CURRENT_MODE.hpp`,
//! `Commander.cpp`): a HOLD that was chosen is a pilot's at once, and one while OFFBOARD is chosen is a failsafe, also where only the
//! packets to the vehicle were lost. The heartbeat, which shows HOLD for both, states that a failsafe is active, whoever chose the mode.
//! Without the other report HOLD is undecided where our own setpoints were interrupted just before, as this process did not run or the link
//! was lost, until setpoints have been sent again for a while.

use crate::mode::FlightMode;

/// Longest pause between setpoints that is no interruption, in nanoseconds: PX4 waits for half a second or more (`COM_OF_LOSS_T`).
const MAX_GAP_NS: i64 = 400_000_000;
/// Maximum age of the vehicle's last packet at which it is assumed to receive ours, in nanoseconds.
const MAX_SILENCE_NS: i64 = 300_000_000;
/// Time within which OFFBOARD must show again, in nanoseconds: heartbeats come each second, and one may be lost.
const RETURN_NS: i64 = 2_500_000_000;
/// Time for which a report of both modes holds, in nanoseconds: it comes twice a second, and two may be lost.
const REPORT_NS: i64 = 1_700_000_000;
/// Time within which such a report follows a heartbeat that shows HOLD first, in nanoseconds: one may be lost.
const REPORT_DUE_NS: i64 = 1_200_000_000;
/// Longest HOLD as a failsafe of OFFBOARD that is waited for, in nanoseconds: after as long a silence a landing waits for a command.
const MAX_FAILSAFE_NS: i64 = 15_000_000_000;

/// The last interruption of the setpoints of a PX4 in OFFBOARD.
#[derive(Copy, Clone, Debug, Default)]
pub(crate) struct OffboardReturn {
    /// When a setpoint was sent last that the vehicle is assumed to have received in OFFBOARD.
    followed_ns: Option<i64>,
    /// When setpoints were first sent again after an interruption.
    resumed_ns: Option<i64>,
    /// The HOLD that may end with our setpoints.
    hold: Option<UndecidedHold>,
    /// The last report of both modes.
    report: Option<Report>,
}

/// A HOLD that shows, since when, and until when it may end with our setpoints.
#[derive(Copy, Clone, Debug)]
struct UndecidedHold {
    since_ns: i64,
    until_ns: i64,
}

/// The mode in which the vehicle flew at a time, and the one that was chosen.
#[derive(Copy, Clone, Debug)]
struct Report {
    at_ns: i64,
    flown: FlightMode,
    chosen: FlightMode,
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
            FlightMode::AUTO_HOLD => self.hold = Some(UndecidedHold::new(now_ns, RETURN_NS)),
            _ => {}
        }
    }

    /// The vehicle reports the mode in which it flies and the one that was chosen; to be called before that is taken as its mode.
    pub(crate) fn reported(&mut self, now_ns: i64, flown: FlightMode, chosen: FlightMode) {
        self.report = Some(Report { at_ns: now_ns, flown, chosen });
        if flown != FlightMode::AUTO_HOLD {
            return;
        }
        // A report that comes late does not make a choice undecided again.
        match &mut self.hold {
            Some(hold) if chosen == FlightMode::OFFBOARD => hold.extend(now_ns),
            _ if chosen == FlightMode::OFFBOARD => {}
            _ => self.hold = None,
        }
    }

    /// The mode that was chosen, where this one was reported last as the one in which the vehicle flies.
    pub(crate) fn chosen_in(&self, flown: FlightMode) -> Option<FlightMode> {
        self.report.filter(|report| report.flown == flown).map(|report| report.chosen)
    }

    /// The vehicle shows another mode than before; `is_failsafe`: its heartbeat states that a failsafe is active.
    pub(crate) fn mode_changed(
        &mut self,
        now_ns: i64,
        from: FlightMode,
        to: FlightMode,
        is_failsafe: bool,
    ) {
        match (from, to) {
            (_, FlightMode::OFFBOARD) => self.hold = None,
            (FlightMode::OFFBOARD, FlightMode::AUTO_HOLD) => {
                self.hold = self.undecided(now_ns, is_failsafe);
                if self.hold.is_none() {
                    self.forget();
                }
            }
            _ => self.forget(),
        }
    }

    /// Whether the HOLD that shows may end as setpoints are sent again.
    pub(crate) fn is_expected(&self, now_ns: i64) -> bool {
        self.hold.is_some_and(|hold| now_ns < hold.until_ns)
    }

    /// The HOLD that follows OFFBOARD now, where it may be a failsafe.
    fn undecided(&self, now_ns: i64, is_failsafe: bool) -> Option<UndecidedHold> {
        let report = self.report.filter(|it| now_ns.saturating_sub(it.at_ns) < REPORT_NS);
        match report {
            Some(report) if report.flown == FlightMode::AUTO_HOLD && report.at_ns == now_ns => {
                let may_return = report.chosen == FlightMode::OFFBOARD;
                may_return.then(|| UndecidedHold::new(now_ns, REPORT_NS))
            }
            _ if self.is_interrupted(now_ns) => Some(UndecidedHold::new(now_ns, RETURN_NS)),
            Some(report) if is_failsafe && report.chosen == FlightMode::OFFBOARD => {
                Some(UndecidedHold::new(now_ns, REPORT_DUE_NS))
            }
            _ => None,
        }
    }

    /// Setpoints before this are of no concern.
    fn forget(&mut self) {
        *self = Self { report: self.report, ..Self::default() };
    }

    fn is_interrupted(&self, now_ns: i64) -> bool {
        let is_recent = |at_ns: i64| now_ns.saturating_sub(at_ns) < RETURN_NS;
        self.has_gap(now_ns) || self.resumed_ns.is_some_and(is_recent)
    }

    fn has_gap(&self, now_ns: i64) -> bool {
        self.followed_ns.is_some_and(|at_ns| now_ns.saturating_sub(at_ns) > MAX_GAP_NS)
    }
}

impl UndecidedHold {
    fn new(now_ns: i64, for_ns: i64) -> Self {
        Self { since_ns: now_ns, until_ns: now_ns.saturating_add(for_ns) }
    }

    /// A report says that it is a failsafe of OFFBOARD.
    fn extend(&mut self, now_ns: i64) {
        let max_ns = self.since_ns.saturating_add(MAX_FAILSAFE_NS);
        let until_ns = now_ns.saturating_add(REPORT_NS).min(max_ns);
        self.until_ns = self.until_ns.max(until_ns);
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
        offboard.mode_changed(1050 * MS, OFFBOARD, HOLD, false);
        assert!(!offboard.is_expected(1050 * MS));
        // So is another mode after one.
        let mut offboard = followed();
        offboard.mode_changed(4000 * MS, OFFBOARD, FlightMode::Px4(3 << 16), false);
        assert!(!offboard.is_expected(4000 * MS));
    }

    #[test]
    fn hold_after_an_interruption_is_undecided_whether_it_shows_before_or_after_the_next_setpoint()
    {
        let mut offboard = followed();
        offboard.mode_changed(4000 * MS, OFFBOARD, HOLD, false);
        assert!(offboard.is_expected(4000 * MS));
        offboard.sent(4010 * MS, HOLD, 4000 * MS);
        assert!(offboard.is_expected(6400 * MS) && !offboard.is_expected(6500 * MS));

        let mut offboard = followed();
        offboard.sent(4000 * MS, OFFBOARD, 4000 * MS);
        offboard.mode_changed(4500 * MS, OFFBOARD, HOLD, false);
        assert!(offboard.is_expected(4500 * MS));
        offboard.mode_changed(5000 * MS, HOLD, OFFBOARD, false);
        assert!(!offboard.is_expected(5000 * MS));
        // Long after it, HOLD is a choice again.
        for ms in (4050..8000).step_by(50) {
            offboard.sent(ms * MS, OFFBOARD, ms * MS);
        }
        offboard.mode_changed(8000 * MS, OFFBOARD, HOLD, false);
        assert!(!offboard.is_expected(8000 * MS));
    }

    #[test]
    fn setpoints_over_a_link_that_is_lost_are_not_received() {
        let mut offboard = followed();
        for ms in (1050..3000).step_by(50) {
            offboard.sent(ms * MS, OFFBOARD, 1000 * MS);
        }
        offboard.mode_changed(3010 * MS, OFFBOARD, HOLD, false);
        assert!(offboard.is_expected(3010 * MS));
    }

    #[test]
    fn a_hold_that_stays_is_a_choice_although_setpoints_have_ended() {
        let mut offboard = followed();
        offboard.mode_changed(4000 * MS, OFFBOARD, HOLD, false);
        for ms in (4000..6500).step_by(50) {
            offboard.sent(ms * MS, HOLD, ms * MS);
        }
        assert!(!offboard.is_expected(6500 * MS) && !offboard.is_expected(9000 * MS));
    }

    #[test]
    fn hold_with_offboard_chosen_is_a_failsafe_without_an_interruption_as_well() {
        let mut offboard = followed();
        offboard.reported(1050 * MS, HOLD, OFFBOARD);
        offboard.mode_changed(1050 * MS, OFFBOARD, HOLD, false);
        for ms in (1050..16_000).step_by(500) {
            assert!(offboard.is_expected(ms * MS), "{ms} ms");
            offboard.reported(ms * MS, HOLD, OFFBOARD);
        }
        offboard.reported(16_040 * MS, HOLD, OFFBOARD);
        assert!(!offboard.is_expected(16_050 * MS), "not for ever");
        // Nor where the reports end.
        let mut offboard = followed();
        offboard.reported(1050 * MS, HOLD, OFFBOARD);
        offboard.mode_changed(1050 * MS, OFFBOARD, HOLD, false);
        assert!(offboard.is_expected(2700 * MS) && !offboard.is_expected(2800 * MS));
        // It ends in OFFBOARD.
        offboard.reported(2000 * MS, HOLD, OFFBOARD);
        offboard.reported(2500 * MS, OFFBOARD, OFFBOARD);
        offboard.mode_changed(2500 * MS, HOLD, OFFBOARD, false);
        assert!(!offboard.is_expected(2500 * MS));
    }

    #[test]
    fn a_chosen_hold_is_the_pilots_at_once_whatever_else_is_reported() {
        // Also just after an interruption, before or after the mode shows.
        for shows_first in [false, true] {
            let mut offboard = followed();
            if shows_first {
                offboard.mode_changed(4000 * MS, OFFBOARD, HOLD, true);
                assert!(offboard.is_expected(4000 * MS));
                offboard.reported(4010 * MS, HOLD, HOLD);
            } else {
                offboard.reported(4010 * MS, HOLD, HOLD);
                offboard.mode_changed(4010 * MS, OFFBOARD, HOLD, false);
            }
            assert!(!offboard.is_expected(4010 * MS), "{shows_first}");
            // A report of the failsafe before it comes late.
            offboard.reported(4020 * MS, HOLD, OFFBOARD);
            assert!(!offboard.is_expected(4020 * MS), "{shows_first}");
        }
        // A report of OFFBOARD from before does not decide.
        let mut offboard = followed();
        offboard.reported(1000 * MS, OFFBOARD, OFFBOARD);
        offboard.mode_changed(1050 * MS, OFFBOARD, HOLD, false);
        assert!(!offboard.is_expected(1050 * MS));
    }

    #[test]
    fn a_heartbeat_with_an_active_failsafe_waits_for_the_report_of_both_modes() {
        let shown = || {
            let mut offboard = followed();
            offboard.reported(900 * MS, OFFBOARD, OFFBOARD);
            offboard.mode_changed(1050 * MS, OFFBOARD, HOLD, true);
            assert!(offboard.is_expected(1060 * MS));
            offboard
        };
        assert!(!shown().is_expected(2260 * MS), "it does not come");
        let mut offboard = shown();
        offboard.reported(1100 * MS, HOLD, OFFBOARD);
        assert!(offboard.is_expected(2260 * MS));
        let mut offboard = shown();
        offboard.reported(1100 * MS, HOLD, HOLD);
        assert!(!offboard.is_expected(1100 * MS), "a failsafe in the pilot's mode");
        // An autopilot that has never reported both is not waited for.
        let mut offboard = followed();
        offboard.mode_changed(1050 * MS, OFFBOARD, HOLD, true);
        assert!(!offboard.is_expected(1050 * MS));
    }
}
