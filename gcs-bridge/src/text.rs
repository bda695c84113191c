//! What the controller does, in words for the ground station (STATUSTEXT).

use autopilot::compose::status_text;
use autopilot::dialect::{MavMessage, MavSeverity};
use messages::{ControllerStatus, Phase};

/// Characters in one text, which fit four packets; what is longer is cut.
const LONGEST: usize = 199;
/// Texts that may be sent at once, and the time after which one more may.
const BURST: u32 = 6;
const REFILL_NS: i64 = 500_000_000;

/// Tells changes, each once; a controller that flutters cannot flood the ground.
#[derive(Debug)]
pub(crate) struct Teller {
    /// The phase and reason that the ground was told last, without numbers; none when it was told nothing.
    told: Option<String>,
    /// The same for the active detector; none while there was none.
    detector: Option<String>,
    tokens: u32,
    refilled_ns: i64,
    next_id: u16,
}

impl Teller {
    /// A teller that has told nothing.
    pub(crate) fn new(now_ns: i64) -> Self {
        Self { told: None, detector: None, tokens: BURST, refilled_ns: now_ns, next_id: 1 }
    }

    /// The texts for what is new in a status. What does not fit now is told with a later status, if it still holds.
    pub(crate) fn status(&mut self, now_ns: i64, status: &ControllerStatus) -> Vec<MavMessage> {
        let mut packets = Vec::new();
        let text = match status.why.is_empty() {
            true => format!("Alight: {}", status.phase),
            false => format!("Alight: {}: {}", status.phase, status.why),
        };
        // A height that changes while everything else stays is no news.
        let news: String = text.chars().filter(|c| !c.is_ascii_digit()).collect();
        if self.told.as_ref() != Some(&news)
            && let Some(text) = self.say(now_ns, severity(status.phase), &text)
        {
            packets.extend(text);
            self.told = Some(news);
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
            if let Some(text) = self.say(now_ns, severity, &text) {
                packets.extend(text);
                self.detector.clone_from(&status.active_detector);
            }
        }
        packets
    }

    /// The packets of a text; none when too much was said already.
    pub(crate) fn say(
        &mut self,
        now_ns: i64,
        severity: MavSeverity,
        text: &str,
    ) -> Option<Vec<MavMessage>> {
        let earned = now_ns.saturating_sub(self.refilled_ns).max(0) / REFILL_NS;
        self.refilled_ns = self.refilled_ns.saturating_add(earned.saturating_mul(REFILL_NS));
        let earned = u32::try_from(earned).unwrap_or(BURST);
        self.tokens = self.tokens.saturating_add(earned).min(BURST);
        self.tokens = self.tokens.checked_sub(1)?;
        let packets = packets(severity, text, self.next_id);
        // 0 is the id of texts of one packet.
        self.next_id = self.next_id.checked_add(1).unwrap_or(1);
        Some(packets)
    }

    /// Tells everything anew, to a ground station or of a controller that was not there before.
    pub(crate) fn forget(&mut self) {
        self.told = None;
        self.detector = None;
    }
}

/// How loud a phase is told; a ground station reads warnings and worse aloud.
fn severity(phase: Phase) -> MavSeverity {
    match phase {
        Phase::Aborted | Phase::Failed => MavSeverity::MAV_SEVERITY_CRITICAL,
        Phase::Hold => MavSeverity::MAV_SEVERITY_WARNING,
        Phase::Landed | Phase::PilotInCommand => MavSeverity::MAV_SEVERITY_NOTICE,
        _ => MavSeverity::MAV_SEVERITY_INFO,
    }
}

/// The packets of a text of any length and kind.
fn packets(severity: MavSeverity, text: &str, id: u16) -> Vec<MavMessage> {
    let mut text: String = text.chars().take(LONGEST + 1).map(plain).collect();
    if text.len() > LONGEST {
        text.truncate(LONGEST - 3);
        text.push_str("...");
    }
    status_text(severity, &text, id)
}

/// Ground stations show ASCII reliably and nothing else.
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

    fn status(phase: Phase, why: &str, detector: Option<&str>) -> ControllerStatus {
        ControllerStatus {
            phase,
            why: why.into(),
            active_detector: detector.map(Into::into),
            ..ControllerStatus::default()
        }
    }

    /// The texts as a ground station joins them, with their severities.
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
    fn a_phase_and_its_reason_are_told_once() {
        let mut teller = Teller::new(0);
        let search = status(Phase::Search, "looking for the marker", None);
        let told = join(&teller.status(0, &search));
        assert_eq!(told.len(), 1);
        assert_eq!(told[0].1, "Alight: search: looking for the marker");
        assert!(teller.status(0, &search).is_empty());
        let told = join(&teller.status(0, &status(Phase::Search, "waiting 1 s", None)));
        assert_eq!(told[0].1, "Alight: search: waiting 1 s");
        assert!(teller.status(0, &status(Phase::Search, "waiting 2 s", None)).is_empty());
        let told = join(&teller.status(0, &status(Phase::Aborted, "", None)));
        assert_eq!(told, [(MavSeverity::MAV_SEVERITY_CRITICAL, "Alight: aborted".to_owned())]);
        teller.forget();
        assert_eq!(join(&teller.status(0, &search)).len(), 1);
    }

    #[test]
    fn the_active_detector_is_told_when_it_changes() {
        let mut teller = Teller::new(0);
        let told = join(&teller.status(0, &status(Phase::Search, "", Some("main"))));
        assert_eq!(told[1].1, "Alight: detector main");
        let told = join(&teller.status(0, &status(Phase::Search, "", Some("spare"))));
        assert_eq!(told[0].1, "Alight: detector spare");
        let mut changed = status(Phase::Search, "", Some("main"));
        changed.detector_why = "spare has gone".into();
        let told = join(&teller.status(0, &changed));
        assert_eq!(told[0].1, "Alight: detector main: spare has gone");
        let told = join(&teller.status(0, &status(Phase::Search, "", None)));
        assert_eq!(told, [(MavSeverity::MAV_SEVERITY_WARNING, "Alight: no detector".to_owned())]);
    }

    #[test]
    fn fluttering_is_bounded_and_ends_with_the_truth() {
        let mut teller = Teller::new(0);
        let mut told = 0;
        // Ten seconds of changes at 20 Hz.
        for i in 0..200 {
            let phase = [Phase::Approach, Phase::Descend][i % 2];
            told += teller.status(i as i64 * 50_000_000, &status(phase, "", None)).len();
        }
        assert!(told <= BURST as usize + 20, "{told}");
        // The bucket is empty, and yet the last phase comes through once there is room.
        let last = status(Phase::Landed, "", None);
        assert_eq!(join(&teller.status(60_000_000_000, &last))[0].1, "Alight: landed");
    }

    #[test]
    fn long_texts_come_in_parts_and_endless_ones_are_cut() {
        for length in [1, 49, 50, 51, 99, 100, 101, 150, 199, 200, 5000] {
            let text = "x".repeat(length);
            let packets = packets(MavSeverity::MAV_SEVERITY_INFO, &text, 9);
            let joined = &join(&packets)[0].1;
            if length <= LONGEST {
                assert_eq!(*joined, text);
            } else {
                assert!(joined.ends_with("x...") && joined.len() == LONGEST);
            }
            assert!(packets.len() <= 4, "{length}: {} packets", packets.len());
        }
    }

    #[test]
    fn only_plain_characters_are_sent() {
        let told = join(&packets(MavSeverity::MAV_SEVERITY_INFO, "a\u{b7}b\u{7}c\u{e9}", 1));
        assert_eq!(told[0].1, "a-b c?");
    }
}
