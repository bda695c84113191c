//! Follows a PX4's events: which arming checks fail now, which events are repetitions, and when a report of all checks is requested
//! again.
//!
//! Whenever one check changes, PX4 sends all failing checks between two summaries. It sends a check that does not prevent arming as
//! one that fails in all modes (`HealthAndArmingChecks/Common.cpp: reportedModes`), like one that prevents it in all. The two are
//! distinguished by the level, and because after the latter it can be armed in no mode. A client that connects later receives no
//! report until the next change. So a disarmed PX4 is requested to report its failing checks (MAV_CMD_RUN_PREARM_CHECKS):
//! `Commander.cpp: handle_command` then sends its report once more.

use std::collections::VecDeque;

use crate::compose;
use crate::dialect::{EVENT_DATA, MavMessage, MavResult, MavSeverity};
use crate::px4_events::{self, Check, Px4Event, TextEvent};

/// PX4's modes to hold, to take off and to land, as the bits by which a check lists the modes for which it fails.
const OUR_MODES: u32 = 0x10 | 0x2_0000 | 0x4_0000;
/// Maximum number of stored checks; PX4 reports up to 14.
const MAX_CHECKS: usize = 16;
/// Maximum number of checks named as the reason.
const MAX_NAMED: usize = 4;
/// How far behind the newest an event may be that is sent again: PX4 keeps 20 for ground stations that lost some. One farther
/// behind comes from a PX4 that has started again.
const MAX_BEHIND: u16 = 32;
/// Maximum number of times that a PX4 is asked for its report, and the pause between them, in nanoseconds: a packet may be lost.
const MAX_QUESTIONS: u8 = 3;
const QUESTION_PERIOD_NS: i64 = 2_000_000_000;

/// The events of one PX4.
#[derive(Clone, Debug, Default)]
pub(crate) struct Listener {
    newest: Option<u16>,
    in_report: bool,
    /// Whether no part of that report is missing so far.
    is_complete: bool,
    /// The modes in which it can be armed; none while unknown.
    can_arm: u32,
    checks: Vec<Failing>,
    /// The checks that failed by the report before.
    before: Vec<Failing>,
    texts: Twins,
    question: Question,
}

/// The state of the request for a report.
#[derive(Copy, Clone, Debug, Default)]
struct Question {
    /// A complete report came, requested or not, or the request was refused.
    is_over: bool,
    asked: u8,
    due_ns: Option<i64>,
}

#[derive(Clone, Debug)]
struct Failing {
    check: Check,
    severity: MavSeverity,
    text: String,
}

/// The text of an event, and whether it is a repetition.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct EventText {
    pub(crate) severity: MavSeverity,
    pub(crate) text: String,
    pub(crate) about: About,
    /// Whether it is reported by a STATUSTEXT as well: where PX4 receives a ground station it sends most texts both ways.
    pub(crate) is_reported: bool,
}

/// The subject of a text.
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
    /// The text of an event; `None` for one that was received before, that is for programs, or a check for a mode that no landing
    /// needs.
    pub(crate) fn take(&mut self, event: &EVENT_DATA) -> Option<EventText> {
        let behind = self.newest.map(|newest| newest.wrapping_sub(event.sequence));
        if behind.is_some_and(|behind| behind < MAX_BEHIND) {
            return None;
        }
        if self.newest.is_some_and(|newest| event.sequence != newest.wrapping_add(1)) {
            // The end of a report may be among the lost events.
            (self.in_report, self.is_complete) = (false, false);
        }
        self.newest = Some(event.sequence);
        match px4_events::read(event, self.in_report)? {
            Px4Event::ChecksBegin { can_arm } => {
                self.can_arm = can_arm;
                self.begin_report();
                self.is_complete = true;
                None
            }
            Px4Event::ChecksEnd => {
                self.question.is_over |= self.is_complete;
                (self.in_report, self.is_complete) = (false, false);
                None
            }
            Px4Event::Text(TextEvent { severity, text, is_known, check: None }) => {
                let is_reported = self.texts.is_reported(Form::Event { is_known }, &text);
                Some(EventText { severity, text, about: About::Else, is_reported })
            }
            Px4Event::Text(TextEvent { severity, text, is_known, check: Some(check) }) => {
                let about = self.take_check(Failing { check, severity, text: text.clone() })?;
                let is_reported = self.texts.is_reported(Form::Event { is_known }, &text);
                Some(EventText { severity, text, about, is_reported })
            }
        }
    }

    /// Whether a text that PX4 marks as one that it also sends as an event was reported as an event.
    pub(crate) fn is_reported(&mut self, text: &str) -> bool {
        self.texts.is_reported(Form::Text, text)
    }

    /// The request for a report of all failing checks, when it is due.
    pub(crate) fn question(&mut self, now_ns: i64, is_armed: bool) -> Option<MavMessage> {
        let Question { is_over, asked, due_ns } = &mut self.question;
        let is_due = due_ns.is_none_or(|due_ns| now_ns >= due_ns);
        if *is_over || is_armed || !is_due || *asked >= MAX_QUESTIONS {
            return None;
        }
        *asked += 1;
        *due_ns = Some(now_ns.saturating_add(QUESTION_PERIOD_NS));
        Some(compose::run_prearm_checks())
    }

    /// The request was acknowledged. A PX4 that refuses it does so each time, unless it marks the refusal as temporary. After an
    /// acceptance the report may be lost.
    pub(crate) fn acknowledged(&mut self, result: MavResult) {
        let may_report = matches!(
            result,
            MavResult::MAV_RESULT_ACCEPTED
                | MavResult::MAV_RESULT_TEMPORARILY_REJECTED
                | MavResult::MAV_RESULT_IN_PROGRESS
        );
        self.question.is_over |= !may_report;
    }

    /// True between the two summaries of a report.
    pub(crate) fn in_report(&self) -> bool {
        self.in_report
    }

    fn begin_report(&mut self) {
        self.in_report = true;
        self.before = std::mem::take(&mut self.checks);
    }

    fn take_check(&mut self, failing: Failing) -> Option<About> {
        if !self.in_report {
            // The summary before it was lost.
            self.begin_report();
        }
        let Failing { check, severity, .. } = failing;
        let prevents_arming = self.prevents_arming(&failing);
        let is_information = severity as u8 > MavSeverity::MAV_SEVERITY_WARNING as u8;
        let may_prevent_arming = check.modes == u32::MAX && self.can_arm == 0;
        if check.modes & OUR_MODES == 0
            || (is_information && !prevents_arming && !may_prevent_arming)
        {
            return None;
        }
        let is_same = |it: &Failing| it.check.id == check.id && it.severity as u8 <= severity as u8;
        let is_new = !self.before.iter().chain(&self.checks).any(is_same);
        self.checks.retain(|it| it.check.id != check.id);
        if self.checks.len() < MAX_CHECKS {
            self.checks.push(failing);
        }
        Some(if prevents_arming { About::Arming { is_new } } else { About::Health { is_new } })
    }

    fn prevents_arming(&self, failing: &Failing) -> bool {
        let Failing { check, severity, .. } = failing;
        if check.modes == u32::MAX {
            return self.can_arm == 0 && *severity as u8 <= MavSeverity::MAV_SEVERITY_ERROR as u8;
        }
        check.modes & OUR_MODES & !self.can_arm != 0
    }

    /// The texts of the checks that prevent arming, as many as are named.
    pub(crate) fn preventing(&self) -> impl Iterator<Item = &str> {
        let preventing = self.checks.iter().filter(|failing| self.prevents_arming(failing));
        preventing.take(MAX_NAMED).map(|failing| failing.text.as_str())
    }

    /// Why it cannot be armed, as far as the checks show.
    pub(crate) fn why_not_armed(&self) -> Option<String> {
        let (preventing, others): (Vec<_>, Vec<_>) =
            self.checks.iter().partition(|failing| self.prevents_arming(failing));
        if !preventing.is_empty() {
            return Some(named(&preventing));
        }
        let also = format!("checks not passed yet; PX4 also reports: {}", named(&others));
        (!others.is_empty()).then_some(also)
    }
}

/// The form of a report.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
enum Form {
    Text,
    Event { is_known: bool },
}

/// Reports that came in one form and may come in the other.
#[derive(Clone, Debug, Default)]
struct Twins {
    /// Whether texts come that are events as well.
    has_texts: bool,
    waiting: VecDeque<(Form, String)>,
}

impl Twins {
    /// Maximum number of waiting ones.
    const MAX_WAITING: usize = 16;

    /// Whether it was reported in the other form, or will be, for an event whose text is not known.
    fn is_reported(&mut self, form: Form, words: &str) -> bool {
        self.has_texts |= form == Form::Text;
        if form == (Form::Event { is_known: false }) {
            return self.has_texts;
        }
        let is_twin = |(other, its): &(Form, String)| *other != form && its == words;
        if let Some(at) = self.waiting.iter().position(is_twin) {
            self.waiting.remove(at);
            return true;
        }
        if self.waiting.len() >= Self::MAX_WAITING {
            self.waiting.pop_front();
        }
        self.waiting.push_back((form, words.to_owned()));
        false
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
        fn send(&mut self, id: u32, level: u8, arguments: &[u8]) -> Option<EventText> {
            self.sequence = self.sequence.wrapping_add(1);
            let (log_levels, sequence) = (level, self.sequence);
            let mut event = EVENT_DATA { id, log_levels, sequence, ..EVENT_DATA::default() };
            event.arguments.iter_mut().zip(arguments).for_each(|(to, of)| *to = *of);
            self.listener.take(&event)
        }

        /// Reports failing checks by number, level and modes; returns the texts' subjects.
        fn report(&mut self, can_arm: u32, checks: &[(u32, u8, u32)]) -> Vec<Option<About>> {
            let mut summary = [0; 17];
            summary[9..13].copy_from_slice(&can_arm.to_le_bytes());
            assert_eq!(self.send(BEGIN, 0x88, &summary), None);
            let send = |(id, level, modes): &(u32, u8, u32)| {
                self.send(*id, *level, &modes.to_le_bytes()).map(|received| received.about)
            };
            let received = checks.iter().map(send).collect();
            assert_eq!(self.send(END, 0x88, &[]), None);
            received
        }

        fn why(&self) -> String {
            self.listener.why_not_armed().unwrap_or_default()
        }
    }

    #[test]
    fn checks_that_prevent_arming_are_named_and_optional_ones_are_not() {
        let mut px4 = Px4::default();
        let position = (NO_POSITION, 3, OUR_MODES);
        let sticks = (NO_STICKS, 4, ALL);
        px4.report(0x8000, &[position, sticks]);
        assert_eq!(px4.why(), "Navigation error: No valid position estimate");
        // One that prevents it in all modes looks like an optional one, but then it can be armed in none.
        px4.report(0, &[sticks, (SAFETY_BUTTON, 3, ALL)]);
        assert_eq!(px4.why(), "Press safety button first");
        px4.report(ALL, &[sticks, (SAFETY_BUTTON, 3, ALL)]);
        assert!(px4.why().starts_with("checks not passed yet; PX4 also reports: No manual"));
        px4.report(0, &[sticks, (SAFETY_BUTTON, 6, ALL)]);
        assert!(px4.why().ends_with("No manual control input; Press safety button first"));
        // For information, and for a mode of no landing.
        assert_eq!(px4.report(ALL, &[(SAFETY_BUTTON, 6, ALL), (NO_HOME, 3, 8)]), [None, None]);
        assert_eq!(px4.why(), "");
    }

    #[test]
    fn a_cured_cause_is_named_no_more_and_an_unknown_one_in_a_report_is() {
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
    fn an_event_is_taken_once_also_over_the_counters_end_and_again_after_a_restart() {
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
    fn a_check_that_gets_worse_is_reported_again_and_so_is_another_fault_of_a_battery() {
        const BATTERY: u32 = 15_602_498;
        let mut px4 = Px4::default();
        let about = |received: Option<EventText>| received.map(|received| received.about);
        let new = Some(About::Arming { is_new: true });
        px4.report(0, &[(NO_POSITION, 4, OUR_MODES)]);
        assert_eq!(px4.report(0, &[(NO_POSITION, 3, OUR_MODES)]), [new]);
        assert_eq!(
            px4.report(0, &[(NO_POSITION, 3, OUR_MODES)]),
            [Some(About::Arming { is_new: false })]
        );
        let fault = |fault| [0xff, 0xff, 0xff, 0xff, 11, 1, fault, 1];
        for kind in [2, 3] {
            assert_eq!(about(px4.send(BATTERY, 0, &fault(kind))), new, "{kind}");
        }
        assert!(px4.why().contains("; Battery 1: "), "{}", px4.why());
    }

    #[test]
    fn a_report_whose_ends_were_lost_is_not_mixed_with_the_next() {
        let mut px4 = Px4::default();
        px4.report(0, &[(NO_POSITION, 3, OUR_MODES)]);
        // Its first summary is lost.
        px4.sequence += 1;
        px4.send(SAFETY_BUTTON, 3, &ALL.to_le_bytes());
        assert_eq!(px4.why(), "Press safety button first");
        // And its last one: the events behind it are no checks.
        px4.sequence += 1;
        let unknown = px4.send(1, 3, &[]).map(|received| received.about);
        assert_eq!(unknown, Some(About::Else));
    }

    /// The number of further requests.
    fn asked(listener: &mut Listener) -> usize {
        (0..20).filter(|i| listener.question(i * QUESTION_PERIOD_NS, false).is_some()).count()
    }

    #[test]
    fn only_a_complete_report_ends_the_requests() {
        let mut summary = [0; 17];
        summary[9] = 1;
        let modes = OUR_MODES.to_le_bytes();
        let events: [(u32, u8, &[u8]); 4] = [
            (BEGIN, 0x88, &summary),
            (SAFETY_BUTTON, 3, &modes),
            (NO_POSITION, 3, &modes),
            (END, 0x88, &[]),
        ];
        for lost in 0..events.len() {
            let mut px4 = Px4::default();
            px4.send(TAKEN_OVER, 4, &[]);
            for (at, (id, level, arguments)) in events.iter().enumerate() {
                match at == lost {
                    true => px4.sequence += 1,
                    false => drop(px4.send(*id, *level, arguments)),
                }
            }
            assert!(px4.listener.question(0, false).is_some(), "{lost} lost");
            px4.report(1, &[(SAFETY_BUTTON, 3, OUR_MODES), (NO_POSITION, 3, OUR_MODES)]);
            assert_eq!(asked(&mut px4.listener), 0, "{lost} lost");
            assert_eq!(
                px4.why(),
                "Press safety button first; Navigation error: No valid position estimate"
            );
        }
    }

    #[test]
    fn the_request_is_repeated_unless_it_is_refused_permanently() {
        let answers = [
            (MavResult::MAV_RESULT_ACCEPTED, 2),
            (MavResult::MAV_RESULT_TEMPORARILY_REJECTED, 2),
            (MavResult::MAV_RESULT_IN_PROGRESS, 2),
            (MavResult::MAV_RESULT_DENIED, 0),
            (MavResult::MAV_RESULT_UNSUPPORTED, 0),
            (MavResult::MAV_RESULT_FAILED, 0),
        ];
        for (answer, times) in answers {
            let mut listener = Listener::default();
            assert!(listener.question(0, false).is_some());
            listener.acknowledged(answer);
            assert_eq!(asked(&mut listener), times, "{answer:?}");
        }
    }

    #[test]
    fn a_text_that_comes_also_as_an_event_is_reported_once_in_either_order_and_each_time() {
        let mut px4 = Px4::default();
        let words = px4.send(TAKEN_OVER, 4, &[]).map(|received| received.text).unwrap_or_default();
        assert!(px4.listener.is_reported(&words));
        for _ in 0..2 {
            assert!(!px4.listener.is_reported(&words));
            assert!(px4.send(TAKEN_OVER, 4, &[]).is_some_and(|received| received.is_reported));
        }
        // An unknown event comes also as a text where PX4 sends texts.
        assert!(px4.send(1, 3, &[]).is_some_and(|received| received.is_reported));
        assert!(!Px4::default().send(1, 3, &[]).is_some_and(|received| received.is_reported));
        for number in 0..100 {
            assert!(!px4.listener.is_reported(&number.to_string()));
        }
        assert_eq!(px4.listener.texts.waiting.len(), Twins::MAX_WAITING);
    }

    #[test]
    fn however_many_checks_fail_few_are_named_and_a_limited_number_is_stored() {
        let mut px4 = Px4::default();
        let checks: Vec<_> = (1..=40).map(|id| (id, 3, OUR_MODES)).collect();
        px4.report(0, &checks);
        assert_eq!(px4.listener.checks.len(), MAX_CHECKS);
        assert!(px4.why().ends_with("; and 12 more"), "{}", px4.why());
    }
}
