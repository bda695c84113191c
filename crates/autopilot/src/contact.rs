//! Contact with the ground, as far as reports of it are believed.
//!
//! A report may be wrong, and one wrong report must not end the control of a flying vehicle. So a vehicle that
//! was flying stands on the ground only after several reports in a row, during which it hardly moves up or
//! down; "undefined" is ignored, and a vehicle in the air is not taking off. With the motors off a wrong report
//! does no harm, and every report is believed.

use crate::state::LandedState;

/// Number of reports in a row, and the time between the first and the last of them in nanoseconds, after which
/// a vehicle that was flying stands on the ground.
const MIN_REPORTS: u32 = 3;
const MIN_REPORTED_NS: i64 = 350_000_000;
/// Maximum vertical speed of a vehicle that stands on the ground, in m/s: a deck may heave.
const MAX_STANDING_M_S: f64 = 0.5;

/// The believed state, and the reports that contradict it.
#[derive(Copy, Clone, Debug, Default)]
pub(crate) struct Contact {
    believed: LandedState,
    reported: LandedState,
    /// Reports of the ground in a row, of a vehicle that was flying.
    ground: Option<GroundReports>,
}

#[derive(Copy, Clone, Debug)]
struct GroundReports {
    since_ns: i64,
    count: u32,
}

impl Contact {
    /// The believed state after a report. `sinks_m_s` is the vertical speed, where it is known.
    pub(crate) fn report(
        &mut self,
        now_ns: i64,
        reported: LandedState,
        armed: bool,
        sinks_m_s: Option<f64>,
    ) -> LandedState {
        self.reported = reported;
        if !armed {
            return self.disarmed();
        }
        let flew = matches!(self.believed, LandedState::InAir | LandedState::Landing);
        match reported {
            LandedState::OnGround if flew => {
                let moves = sinks_m_s.is_some_and(|speed| speed.abs() > MAX_STANDING_M_S);
                self.ground = if moves { None } else { Some(self.counted(now_ns)) };
                if self.ground.is_some_and(|reports| reports.are_enough(now_ns)) {
                    self.believe(reported);
                }
            }
            LandedState::Unknown => {}
            LandedState::TakingOff if flew => self.ground = None,
            _ => self.believe(reported),
        }
        self.believed
    }

    /// The believed state once the motors are off: the last report.
    pub(crate) fn disarmed(&mut self) -> LandedState {
        if self.reported != LandedState::Unknown {
            self.believe(self.reported);
        }
        self.believed
    }

    fn believe(&mut self, state: LandedState) {
        self.believed = state;
        self.ground = None;
    }

    fn counted(&self, now_ns: i64) -> GroundReports {
        let before = self.ground.unwrap_or(GroundReports { since_ns: now_ns, count: 0 });
        GroundReports { count: before.count.saturating_add(1), ..before }
    }
}

impl GroundReports {
    fn are_enough(self, now_ns: i64) -> bool {
        self.count >= MIN_REPORTS && now_ns.saturating_sub(self.since_ns) >= MIN_REPORTED_NS
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use LandedState::{InAir, Landing, OnGround, TakingOff, Unknown};

    const MS: i64 = 1_000_000;

    /// The believed state after reports at 5 Hz of an armed vehicle with this vertical speed.
    fn believed(reports: &[LandedState], sinks_m_s: Option<f64>) -> LandedState {
        let mut contact = Contact::default();
        let mut believed = Unknown;
        for (i, report) in reports.iter().enumerate() {
            believed = contact.report(i as i64 * 200 * MS, *report, true, sinks_m_s);
        }
        believed
    }

    #[test]
    fn a_takeoff_and_a_landing_are_followed() {
        assert_eq!(believed(&[OnGround], None), OnGround);
        assert_eq!(believed(&[OnGround, TakingOff], None), TakingOff);
        assert_eq!(believed(&[OnGround, TakingOff, InAir], None), InAir);
        assert_eq!(believed(&[InAir, Landing], None), Landing);
        assert_eq!(believed(&[InAir, Landing, OnGround, OnGround, OnGround], Some(0.0)), OnGround);
    }

    #[test]
    fn undefined_reports_and_reports_that_contradict_the_flight_are_not_believed() {
        assert_eq!(believed(&[InAir, Unknown, Unknown, Unknown, Unknown], None), InAir);
        assert_eq!(believed(&[InAir, TakingOff, TakingOff, TakingOff, TakingOff], None), InAir);
        assert_eq!(believed(&[InAir, OnGround, OnGround], Some(0.0)), InAir);
        assert_eq!(believed(&[InAir, OnGround, InAir, OnGround, OnGround], Some(0.0)), InAir);
        let down = [InAir, OnGround, OnGround, OnGround, OnGround, OnGround, OnGround];
        assert_eq!(believed(&down, Some(1.0)), InAir, "it moves");
        assert_eq!(believed(&down, None), OnGround);
    }

    #[test]
    fn with_the_motors_off_every_report_is_believed() {
        let mut contact = Contact::default();
        contact.report(0, InAir, true, None);
        assert_eq!(contact.report(MS, OnGround, true, None), InAir);
        assert_eq!(contact.disarmed(), OnGround);
        assert_eq!(contact.report(2 * MS, InAir, false, None), InAir);
    }
}
