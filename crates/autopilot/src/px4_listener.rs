//! What a PX4 has told in its events so far: the checks that fail now, and which events are heard again.
//!
//! Whenever one check changes PX4 sends all that fail, between two summaries. It sends a check that does not prevent arming as
//! one that fails in all modes (`HealthAndArmingChecks/Common.cpp: reportedModes`), like one that prevents it in all: what tells
//! them apart is that after the latter it can be armed in no mode, and the level.

use crate::dialect::{EVENT_DATA, MavSeverity};
use crate::px4_events::{self, Check, CheckId, Px4Event, Told};

/// PX4's modes to hold, to take off and to land, as a check tells for which it fails.
const OUR_MODES: u32 = 0x10 | 0x2_0000 | 0x4_0000;
/// Maximum number of checks kept; PX4 reports up to 14.
const MAX_CHECKS: usize = 16;
/// Maximum number of checks named as the reason.
const MAX_NAMED: usize = 4;
/// How far behind the newest an event may be that is sent again: PX4 keeps 20 for ground stations that lost some. One farther
/// behind comes from a PX4 that has started again.
const MAX_BEHIND: u16 = 32;

/// The events of one PX4.
#[derive(Clone, Debug, Default)]
pub(crate) struct Listener {
    newest: Option<u16>,
    in_report: bool,
    /// The modes in which it can be armed; none while unknown.
    can_arm: u32,
    checks: Vec<Failing>,
    /// The checks that failed by the report before.
    before: Vec<CheckId>,
}

#[derive(Clone, Debug)]
struct Failing {
    check: Check,
    severity: MavSeverity,
    text: String,
}

/// What was heard.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Heard {
    pub(crate) severity: MavSeverity,
    pub(crate) text: String,
    pub(crate) about: About,
}

/// What a text is about.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) enum About {
    /// A check that prevents arming.
    Arming { is_new: bool },
    /// A check that prevents arming in none of the modes of a landing, or that may do so.
    Health { is_new: bool },
    /// Something else.
    Else,
}

impl Listener {
    /// What an event says; `None` for one that was heard before, that is for programs, or a check for a mode that no landing
    /// needs.
    pub(crate) fn take(&mut self, event: &EVENT_DATA) -> Option<Heard> {
        let behind = self.newest.map(|newest| newest.wrapping_sub(event.sequence));
        if behind.is_some_and(|behind| behind < MAX_BEHIND) {
            return None;
        }
        self.newest = Some(event.sequence);
        match px4_events::read(event, self.in_report)? {
            Px4Event::ChecksBegin { can_arm } => {
                self.in_report = true;
                self.can_arm = can_arm;
                self.before = self.checks.drain(..).map(|failing| failing.check.id).collect();
                None
            }
            Px4Event::ChecksEnd => {
                self.in_report = false;
                None
            }
            Px4Event::Told(Told { severity, text, check: None }) => {
                Some(Heard { severity, text, about: About::Else })
            }
            Px4Event::Told(Told { severity, text, check: Some(check) }) => {
                self.take_check(Failing { check, severity, text })
            }
        }
    }

    fn take_check(&mut self, failing: Failing) -> Option<Heard> {
        let Failing { check, severity, text } = failing.clone();
        let prevents_arming = self.prevents_arming(&failing);
        let is_information = severity as u8 > MavSeverity::MAV_SEVERITY_WARNING as u8;
        let may_prevent_arming = check.modes == u32::MAX && self.can_arm == 0;
        if check.modes & OUR_MODES == 0
            || (is_information && !prevents_arming && !may_prevent_arming)
        {
            return None;
        }
        let id = check.id;
        let is_new = !self.before.contains(&id) && !self.checks.iter().any(|it| it.check.id == id);
        self.checks.retain(|it| it.check.id != id);
        if self.checks.len() < MAX_CHECKS {
            self.checks.push(failing);
        }
        let about =
            if prevents_arming { About::Arming { is_new } } else { About::Health { is_new } };
        Some(Heard { severity, text, about })
    }

    fn prevents_arming(&self, failing: &Failing) -> bool {
        let Failing { check, severity, .. } = failing;
        if check.modes == u32::MAX {
            return self.can_arm == 0 && *severity as u8 <= MavSeverity::MAV_SEVERITY_ERROR as u8;
        }
        check.modes & OUR_MODES & !self.can_arm != 0
    }

    /// True once an event was heard.
    pub(crate) fn has_heard(&self) -> bool {
        self.newest.is_some()
    }

    /// Why it cannot be armed, as far as the checks tell.
    pub(crate) fn why_not_armed(&self) -> Option<String> {
        let (preventing, others): (Vec<_>, Vec<_>) =
            self.checks.iter().partition(|failing| self.prevents_arming(failing));
        if !preventing.is_empty() {
            return Some(named(&preventing));
        }
        let also = format!("checks not passed yet; PX4 also says: {}", named(&others));
        (!others.is_empty()).then_some(also)
    }
}

fn named(checks: &[&Failing]) -> String {
    let mut texts: Vec<_> = checks.iter().take(MAX_NAMED).map(|it| it.text.clone()).collect();
    if checks.len() > MAX_NAMED {
        texts.push(format!("and {} more", checks.len() - MAX_NAMED));
    }
    texts.join("; ")
}

#[cfg(test)]
mod tests {
    use super::*;

    const BEGIN: u32 = 11_047_904;
    const END: u32 = 1_914_663;
    const NO_STICKS: u32 = 453_929;
    const NO_POSITION: u32 = 13_835_193;
    const SAFETY_BUTTON: u32 = 276_785;
    const NO_HOME: u32 = 79_408;
    const ALL: u32 = u32::MAX;
    const TAKEN_OVER: u32 = 961_599;

    /// A PX4 that counts its events.
    #[derive(Default)]
    struct Px4 {
        listener: Listener,
        sequence: u16,
    }

    impl Px4 {
        fn send(&mut self, id: u32, level: u8, arguments: &[u8]) -> Option<Heard> {
            self.sequence = self.sequence.wrapping_add(1);
            let (log_levels, sequence) = (level, self.sequence);
            let mut event = EVENT_DATA { id, log_levels, sequence, ..EVENT_DATA::default() };
            event.arguments.iter_mut().zip(arguments).for_each(|(to, of)| *to = *of);
            self.listener.take(&event)
        }

        /// Reports failing checks by number, level and modes; what was heard of each.
        fn report(&mut self, can_arm: u32, checks: &[(u32, u8, u32)]) -> Vec<Option<About>> {
            let mut summary = [0; 17];
            summary[9..13].copy_from_slice(&can_arm.to_le_bytes());
            assert_eq!(self.send(BEGIN, 0x88, &summary), None);
            let send = |(id, level, modes): &(u32, u8, u32)| {
                self.send(*id, *level, &modes.to_le_bytes()).map(|heard| heard.about)
            };
            let heard = checks.iter().map(send).collect();
            assert_eq!(self.send(END, 0x88, &[]), None);
            heard
        }

        fn why(&self) -> String {
            self.listener.why_not_armed().unwrap_or_default()
        }
    }

    #[test]
    fn what_prevents_arming_is_named_and_not_what_is_optional() {
        let mut px4 = Px4::default();
        let position = (NO_POSITION, 3, OUR_MODES);
        let sticks = (NO_STICKS, 4, ALL);
        px4.report(0x8000, &[position, sticks]);
        assert_eq!(px4.why(), "Navigation error: No valid position estimate");
        // One that prevents it in all modes looks like an optional one, but then it can be armed in none.
        px4.report(0, &[sticks, (SAFETY_BUTTON, 3, ALL)]);
        assert_eq!(px4.why(), "Press safety button first");
        px4.report(ALL, &[sticks, (SAFETY_BUTTON, 3, ALL)]);
        assert!(px4.why().starts_with("checks not passed yet; PX4 also says: No manual"));
        px4.report(0, &[sticks, (SAFETY_BUTTON, 6, ALL)]);
        assert!(px4.why().ends_with("No manual control input; Press safety button first"));
        // For information, and for a mode of no landing.
        assert_eq!(px4.report(ALL, &[(SAFETY_BUTTON, 6, ALL), (NO_HOME, 3, 8)]), [None, None]);
        assert_eq!(px4.why(), "");
    }

    #[test]
    fn a_cured_cause_is_named_no_more_and_a_stranger_in_a_report_is() {
        let mut px4 = Px4::default();
        px4.report(0, &[(NO_POSITION, 3, OUR_MODES)]);
        px4.report(0, &[(1, 3, OUR_MODES)]);
        assert!(px4.why().starts_with("PX4's event 1, whose text"), "{}", px4.why());
        px4.report(ALL, &[]);
        assert_eq!(px4.why(), "");
    }

    #[test]
    fn a_check_is_new_once_until_it_was_passed() {
        let mut px4 = Px4::default();
        let check = [(NO_POSITION, 3, OUR_MODES)];
        let (new, old) =
            (Some(About::Arming { is_new: true }), Some(About::Arming { is_new: false }));
        assert_eq!(px4.report(0, &check), [new]);
        assert_eq!(px4.report(0, &check), [old]);
        px4.report(ALL, &[]);
        assert_eq!(px4.report(0, &check), [new]);
    }

    #[test]
    fn an_event_is_heard_once_also_over_the_counters_end_and_again_after_a_restart() {
        let mut px4 = Px4 { sequence: u16::MAX - 5, ..Px4::default() };
        for _ in 0..40 {
            assert!(px4.send(TAKEN_OVER, 4, &[]).is_some());
        }
        let newest = px4.sequence;
        for behind in 0..20 {
            px4.sequence = newest.wrapping_sub(behind).wrapping_sub(1);
            assert_eq!(px4.send(TAKEN_OVER, 4, &[]), None, "{behind} behind");
        }
        px4.sequence = u16::MAX - 10;
        assert!(px4.send(TAKEN_OVER, 4, &[]).is_some());
    }

    #[test]
    fn however_many_checks_fail_few_are_named_and_a_limited_number_is_kept() {
        let mut px4 = Px4::default();
        let checks: Vec<_> = (1..=40).map(|id| (id, 3, OUR_MODES)).collect();
        px4.report(0, &checks);
        assert_eq!(px4.listener.checks.len(), MAX_CHECKS);
        assert!(px4.why().ends_with("; and 12 more"), "{}", px4.why());
    }
}
