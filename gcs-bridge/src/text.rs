//! The controller's phases, detector changes and warnings, each once, and answers to the ground station's requests, as
//! STATUSTEXT packets at a bounded rate.

use autopilot::compose::status_text;
use autopilot::dialect::{MavMessage, MavSeverity, Message};
use autopilot::{GivenCommand, Packet, Permission};
use messages::{ControllerStatus, Phase, matter};

/// Maximum length of a text, in characters: it fits four packets. Longer texts are shortened.
const MAX_TEXT: usize = 199;
/// Maximum length of the end that a shortened text keeps, in characters.
const MAX_END: usize = 120;
/// Maximum length of a text that is read, in characters.
const MAX_READ: usize = 2000;
/// Maximum number of texts sent at once.
const MAX_BURST: u32 = 6;
/// Number of these that are reserved for events, when answers to requests are sent.
const KEPT_OF_BURST: u32 = 3;
/// Maximum number of warnings that are followed.
const MAX_WARNINGS: usize = 16;
/// Time after which one more text may be sent, in nanoseconds.
const REFILL_NS: i64 = 500_000_000;

/// Sends each change once, at a bounded rate.
#[derive(Debug)]
pub(crate) struct StatusTextSender {
    /// The last text of a phase, without digits; none before the first.
    last: Option<String>,
    /// The last active detector; none before the first.
    detector: Option<String>,
    /// The warnings that were sent and still hold, without digits.
    warnings: Vec<String>,
    tokens: u32,
    refilled_ns: i64,
    next_id: u16,
}

impl StatusTextSender {
    /// A sender that has sent nothing.
    pub(crate) fn new(now_ns: i64) -> Self {
        Self {
            last: None,
            detector: None,
            warnings: Vec::new(),
            tokens: MAX_BURST,
            refilled_ns: now_ns,
            next_id: 1,
        }
    }

    /// The texts for changes in a status. A text that exceeds the rate is sent with a later status, if it still holds.
    pub(crate) fn status(&mut self, now_ns: i64, status: &ControllerStatus) -> Vec<MavMessage> {
        let mut packets = Vec::new();
        let text = format!("Alight: {}", status.sentence());
        // A change of digits alone, as of a height, is not sent.
        let change = matter(&text);
        // A warning that is the reason, or the end of it, is sent once.
        let stated: Vec<String> = status
            .warnings
            .iter()
            .filter(|warning| states(status, &text, warning))
            .map(|warning| matter(warning))
            .collect();
        let severity = match severity(status.phase) {
            MavSeverity::MAV_SEVERITY_INFO if !stated.is_empty() => {
                MavSeverity::MAV_SEVERITY_WARNING
            }
            severity => severity,
        };
        if self.last.as_ref() != Some(&change)
            && let Some(text) = self.text(now_ns, severity, &text)
        {
            packets.extend(text);
            self.last = Some(change);
            for warning in stated {
                if !self.warnings.contains(&warning) {
                    self.warnings.push(warning);
                }
            }
        }
        if self.detector != status.active_detector {
            let (severity, text) = match &status.active_detector {
                Some(name) if status.detector_why.is_empty() => {
                    (MavSeverity::MAV_SEVERITY_INFO, format!("Alight: detector {name}"))
                }
                Some(name) => {
                    let text = format!("Alight: detector {name}: {}", status.detector_why);
                    (MavSeverity::MAV_SEVERITY_INFO, text)
                }
                None => (MavSeverity::MAV_SEVERITY_WARNING, "Alight: no detector".to_owned()),
            };
            if let Some(text) = self.text(now_ns, severity, &text) {
                packets.extend(text);
                self.detector.clone_from(&status.active_detector);
            }
        }
        self.warnings(now_ns, &status.warnings, &mut packets);
        packets
    }

    /// Adds the packets of new warnings.
    fn warnings(&mut self, now_ns: i64, warnings: &[String], packets: &mut Vec<MavMessage>) {
        let matters: Vec<String> = warnings.iter().map(|text| matter(text)).collect();
        self.warnings.retain(|sent| matters.contains(sent));
        for (text, matter) in warnings.iter().zip(matters).take(MAX_WARNINGS) {
            if !self.warnings.contains(&matter)
                && let Some(text) =
                    self.text(now_ns, MavSeverity::MAV_SEVERITY_WARNING, &format!("Alight: {text}"))
            {
                packets.extend(text);
                self.warnings.push(matter);
            }
        }
    }

    /// The packets of a text; none when it exceeds the rate.
    pub(crate) fn text(
        &mut self,
        now_ns: i64,
        severity: MavSeverity,
        text: &str,
    ) -> Option<Vec<MavMessage>> {
        self.refill(now_ns);
        self.tokens = self.tokens.checked_sub(1)?;
        let packets = packets(severity, text, self.next_id);
        // 0 is the id of texts of one packet.
        self.next_id = self.next_id.checked_add(1).unwrap_or(1);
        Some(packets)
    }

    /// The packets of the answer to a request; none when it exceeds the rate, or leaves too few for events: a ground
    /// station may ask for hundreds of things at once.
    pub(crate) fn answer(
        &mut self,
        now_ns: i64,
        severity: MavSeverity,
        text: &str,
    ) -> Option<Vec<MavMessage>> {
        self.refill(now_ns);
        if self.tokens <= KEPT_OF_BURST {
            return None;
        }
        self.text(now_ns, severity, text)
    }

    fn refill(&mut self, now_ns: i64) {
        let earned = now_ns.saturating_sub(self.refilled_ns).max(0) / REFILL_NS;
        self.refilled_ns = self.refilled_ns.saturating_add(earned.saturating_mul(REFILL_NS));
        let earned = u32::try_from(earned).unwrap_or(MAX_BURST);
        self.tokens = self.tokens.saturating_add(earned).min(MAX_BURST);
    }

    /// Sends everything again: to a new ground station, or of a new controller.
    pub(crate) fn reset(&mut self) {
        self.last = None;
        self.detector = None;
        self.warnings.clear();
    }
}

/// The text about a packet that the ground station may not send: what was refused, and the setting that permits no more.
pub(crate) fn refused(packet: &Packet, permission: Permission, refusal: &str) -> String {
    let what = match (GivenCommand::of(packet), &packet.message) {
        (Some(command), _) => format!("command {}", command.number),
        (None, Some(message)) => message.message_name().to_owned(),
        (None, None) => format!("message {}", packet.message_id),
    };
    match permission {
        Permission::Monitor => {
            format!("Alight: refused {what}: this link may only monitor (ground_may)")
        }
        _ => format!("Alight: refused {what}: {refusal} (ground_may = {permission})"),
    }
}

/// Whether the text of a status has a warning as its reason, or whole at the end of its reason: "marker lost: no frame from camera".
fn states(status: &ControllerStatus, text: &str, warning: &str) -> bool {
    let is_whole = text.chars().count() <= MAX_TEXT;
    let ends_with_it = || {
        let (text, warning) = (matter(text), matter(warning));
        text.strip_suffix(&warning).is_some_and(|before| before.ends_with(": "))
    };
    status.why == warning || (is_whole && ends_with_it())
}

/// The severity of a phase's text; a ground station reads warnings and worse aloud.
fn severity(phase: Phase) -> MavSeverity {
    match phase {
        Phase::Aborted | Phase::Failed => MavSeverity::MAV_SEVERITY_CRITICAL,
        Phase::Hold | Phase::Retry => MavSeverity::MAV_SEVERITY_WARNING,
        Phase::Landed | Phase::PilotInCommand => MavSeverity::MAV_SEVERITY_NOTICE,
        _ => MavSeverity::MAV_SEVERITY_INFO,
    }
}

/// The packets of a text, cut to its maximum length and to plain characters.
fn packets(severity: MavSeverity, text: &str, id: u16) -> Vec<MavMessage> {
    let text: String = text.chars().take(MAX_READ).map(plain).collect();
    status_text(severity, &shortened(text), id)
}

/// A plain text of at most the maximum length. Of a longer one the last clause stays if it is short enough, because remedies are there.
fn shortened(text: String) -> String {
    if text.len() <= MAX_TEXT {
        return text;
    }
    let ends = ["; ", ": ", ". "].into_iter().filter_map(|mark| Some(text.rfind(mark)? + 2));
    let end = ends.max().and_then(|at| text.get(at..)).filter(|end| end.len() <= MAX_END);
    let (gap, end) = end.map_or(("...", ""), |end| ("... ", end));
    let room = MAX_TEXT - gap.len() - end.len();
    let start = text.get(..room).unwrap_or_default();
    format!("{start}{gap}{end}")
}

/// Ground stations show only ASCII reliably.
fn plain(c: char) -> char {
    match c {
        ' '..='~' => c,
        '\u{b7}' | '\u{2013}' | '\u{2014}' => '-',
        c if c.is_whitespace() || c.is_control() => ' ',
        _ => '?',
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use autopilot::dialect::{COMMAND_LONG_DATA, MavCmd, PARAM_SET_DATA};
    use autopilot::packet::encode;
    use autopilot::{Parser, Sender};

    fn status(phase: Phase, why: &str, detector: Option<&str>) -> ControllerStatus {
        ControllerStatus {
            phase,
            why: why.into(),
            active_detector: detector.map(Into::into),
            ..ControllerStatus::default()
        }
    }

    /// The texts as a ground station joins them, with their severities.
    #[test]
    fn a_lost_marker_and_the_loss_of_the_last_detector_are_warnings() {
        let mut texts = StatusTextSender::new(0);
        let lost = status(Phase::Retry, "marker lost, climbing to see it again", Some("main"));
        assert_eq!(join(&texts.status(0, &lost))[0].0, MavSeverity::MAV_SEVERITY_WARNING);
        let mut texts = StatusTextSender::new(0);
        let why = "no detector is alive, nothing descends";
        let mut blind = status(Phase::Approach, why, None);
        blind.warnings = vec![why.to_owned()];
        let sent = join(&texts.status(0, &blind));
        let expected = format!("Alight: {}", blind.sentence());
        assert_eq!(sent, [(MavSeverity::MAV_SEVERITY_WARNING, expected)], "once");
        assert_eq!(join(&texts.status(1, &blind)), []);
    }

    fn join(packets: &[MavMessage]) -> Vec<(MavSeverity, String)> {
        let mut texts: Vec<(MavSeverity, String)> = Vec::new();
        for packet in packets {
            let MavMessage::STATUSTEXT(part) = packet else { panic!("{packet:?}") };
            let text = part.text.to_str().unwrap();
            if part.chunk_seq == 0 {
                texts.push((part.severity, text.to_owned()));
            } else {
                texts.last_mut().unwrap().1.push_str(text);
            }
        }
        texts
    }

    #[test]
    fn a_phase_and_its_reason_are_sent_once() {
        let mut sender = StatusTextSender::new(0);
        let search = status(Phase::Search, "looking for the marker", None);
        let sent = join(&sender.status(0, &search));
        assert_eq!(sent.len(), 1);
        assert_eq!(sent[0].1, "Alight: search: looking for the marker");
        assert!(sender.status(0, &search).is_empty());
        let sent = join(&sender.status(0, &status(Phase::Search, "waiting 1 s", None)));
        assert_eq!(sent[0].1, "Alight: search: waiting 1 s");
        assert!(sender.status(0, &status(Phase::Search, "waiting 2 s", None)).is_empty());
        let sent = join(&sender.status(0, &status(Phase::Aborted, "", None)));
        assert_eq!(sent, [(MavSeverity::MAV_SEVERITY_CRITICAL, "Alight: aborted".to_owned())]);
        let sent =
            join(&sender.status(0, &status(Phase::Aborted, "aborted by the operator", None)));
        assert_eq!(sent[0].1, "Alight: aborted by the operator");
        sender.reset();
        assert_eq!(join(&sender.status(0, &search)).len(), 1);
    }

    #[test]
    fn the_active_detector_is_sent_when_it_changes() {
        let mut sender = StatusTextSender::new(0);
        let sent = join(&sender.status(0, &status(Phase::Search, "", Some("main"))));
        assert_eq!(sent[1].1, "Alight: detector main");
        let sent = join(&sender.status(0, &status(Phase::Search, "", Some("spare"))));
        assert_eq!(sent[0].1, "Alight: detector spare");
        let mut changed = status(Phase::Search, "", Some("main"));
        changed.detector_why = "spare has gone".into();
        let sent = join(&sender.status(0, &changed));
        assert_eq!(sent[0].1, "Alight: detector main: spare has gone");
        let sent = join(&sender.status(0, &status(Phase::Search, "", None)));
        assert_eq!(sent, [(MavSeverity::MAV_SEVERITY_WARNING, "Alight: no detector".to_owned())]);
    }

    #[test]
    fn a_warning_is_sent_once_while_it_holds() {
        let mut sender = StatusTextSender::new(0);
        let warned = |apart: &str| ControllerStatus {
            warnings: vec![format!("`a` and `b` see the marker {apart} m apart")],
            ..status(Phase::Descend, "", None)
        };
        let sent = join(&sender.status(0, &warned("0.82")));
        let text = "Alight: `a` and `b` see the marker 0.82 m apart".to_owned();
        assert_eq!(sent[1], (MavSeverity::MAV_SEVERITY_WARNING, text));
        assert!(sender.status(0, &warned("0.97")).is_empty());
        assert!(sender.status(0, &status(Phase::Descend, "", None)).is_empty());
        assert_eq!(sender.status(0, &warned("0.90")).len(), 1, "it has come again");
    }

    #[test]
    fn rapid_changes_are_bounded_and_the_last_one_arrives() {
        let mut sender = StatusTextSender::new(0);
        let mut sent = 0;
        // Ten seconds of changes at 20 Hz.
        for i in 0..200 {
            let phase = [Phase::Approach, Phase::Descend][i % 2];
            sent += sender.status(i as i64 * 50_000_000, &status(phase, "", None)).len();
        }
        assert!(sent <= MAX_BURST as usize + 20, "{sent}");
        // The bucket is empty, and yet the last phase comes through once there is room.
        let last = status(Phase::Landed, "", None);
        assert_eq!(join(&sender.status(60_000_000_000, &last))[0].1, "Alight: landed");
    }

    #[test]
    fn long_texts_come_in_parts_and_endless_ones_are_cut() {
        for length in [1, 49, 50, 51, 99, 100, 101, 150, 199, 200, 5000] {
            let text = "x".repeat(length);
            let packets = packets(MavSeverity::MAV_SEVERITY_INFO, &text, 9);
            let joined = &join(&packets)[0].1;
            if length <= MAX_TEXT {
                assert_eq!(*joined, text);
            } else {
                assert!(joined.ends_with("x...") && joined.len() == MAX_TEXT);
            }
            assert!(packets.len() <= 4, "{length}: {} packets", packets.len());
        }
    }

    #[test]
    fn a_refusal_names_the_refused_packet() {
        let packet = |message: &MavMessage| {
            let sender = Sender { system: 255, component: 190 };
            Parser::new().push(&encode(sender, 0, message)).remove(0)
        };
        let arm = packet(&MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
            command: MavCmd::MAV_CMD_COMPONENT_ARM_DISARM,
            ..COMMAND_LONG_DATA::default()
        }));
        let set = packet(&MavMessage::PARAM_SET(PARAM_SET_DATA::default()));
        let text = |packet: &Packet, permission: Permission| {
            refused(packet, permission, permission.refusal(packet).unwrap())
        };
        for (packet, permission, expected) in [
            (
                &arm,
                Permission::Monitor,
                "Alight: refused command 400: this link may only monitor (ground_may)",
            ),
            (
                &arm,
                Permission::NoArming,
                "Alight: refused command 400: arming or stopping motors (ground_may = no-arming)",
            ),
            (
                &set,
                Permission::Monitor,
                "Alight: refused PARAM_SET: this link may only monitor (ground_may)",
            ),
        ] {
            assert_eq!(text(packet, permission), expected);
        }
    }

    #[test]
    fn a_shortened_text_keeps_its_remedy() {
        let cause = "the vehicle is not lifted, ".repeat(8);
        let remedy = "give `land-here`, or take over and land or disarm it";
        for mark in ["; ", ": ", ". "] {
            let text = format!("Alight: aborted: {cause}{mark}{remedy}");
            let joined = &join(&packets(MavSeverity::MAV_SEVERITY_INFO, &text, 9))[0].1;
            assert_eq!(joined.len(), MAX_TEXT);
            assert!(joined.starts_with("Alight: aborted: the vehicle is not lifted"), "{joined}");
            assert!(joined.ends_with(&format!("... {remedy}")), "{joined}");
        }
    }

    #[test]
    fn a_warning_at_the_end_of_a_reason_is_not_sent_again() {
        let warning = |s: u32| {
            format!(
                "no frame from camera `down` for {s} s: check the camera, and whether its detector hangs"
            )
        };
        let lost = |s: u32, in_warnings: u32| ControllerStatus {
            warnings: vec![warning(in_warnings), "no detector is alive".into()],
            ..status(
                Phase::Retry,
                &format!("marker lost, climbing to see it again: {}", warning(s)),
                None,
            )
        };
        let mut texts = StatusTextSender::new(0);
        let sent = join(&texts.status(0, &lost(3, 4)));
        let sent: Vec<&str> = sent.iter().map(|(_, text)| text.as_str()).collect();
        let reason = format!("Alight: {}", lost(3, 4).sentence());
        assert_eq!(sent, [reason.as_str(), "Alight: no detector is alive"]);
        assert_eq!(join(&texts.status(1, &lost(5, 5))), []);
        // It is sent where it remains after the reason has changed to another one, has ended, and come again.
        let search = status(Phase::Search, "", None);
        texts.status(2, &search);
        let again = ControllerStatus { warnings: vec![warning(9)], ..search };
        assert_eq!(join(&texts.status(3, &again)).len(), 1);
        // A warning that is cut away is sent.
        let mut texts = StatusTextSender::new(0);
        let far = format!("{}: {}", "far ".repeat(40), warning(3));
        let long =
            ControllerStatus { warnings: vec![warning(3)], ..status(Phase::Retry, &far, None) };
        assert_eq!(join(&texts.status(0, &long)).len(), 2);
    }

    #[test]
    fn only_plain_characters_are_sent() {
        let sent = join(&packets(MavSeverity::MAV_SEVERITY_INFO, "a\u{b7}b\u{7}c\u{e9}", 1));
        assert_eq!(sent[0].1, "a-b c?");
    }
}
