//! Joins the autopilot's texts from several packets.

use crate::dialect::{MavSeverity, STATUSTEXT_DATA};

/// Length of a full part, in bytes; another part follows it.
const PART: usize = 50;
/// Maximum number of parts.
const MAX_PARTS: u8 = 20;
const MAX_BYTES: usize = PART * 20;
/// Timeout of the next part, in nanoseconds; after it the text is complete.
const PART_TIMEOUT_NS: i64 = 500_000_000;

/// Joins the parts of a text.
#[derive(Clone, Debug, Default)]
pub(crate) struct Joiner {
    partial: Option<Partial>,
}

#[derive(Clone, Debug)]
struct Partial {
    id: u16,
    severity: MavSeverity,
    bytes: Vec<u8>,
    next: u8,
    since_ns: i64,
}

/// A complete text.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Text {
    pub(crate) severity: MavSeverity,
    pub(crate) text: String,
    /// PX4 sends it as an event as well.
    pub(crate) is_event: bool,
}

impl Text {
    fn new(severity: MavSeverity, bytes: &[u8]) -> Self {
        // PX4 marks them by a tab at the end.
        let without = bytes.strip_suffix(b"\t");
        let text = clean(without.unwrap_or(bytes));
        Self { severity, text, is_event: without.is_some() }
    }
}

impl Joiner {
    /// Adds a packet and returns the texts that it completes, an interrupted one first.
    pub(crate) fn push(&mut self, now_ns: i64, message: &STATUSTEXT_DATA) -> Vec<Text> {
        let mut texts = Vec::new();
        let bytes: &[u8] = &*message.text;
        let length = bytes.iter().position(|&byte| byte == 0).unwrap_or(bytes.len());
        let part = bytes.get(..length).unwrap_or(&[]);
        let continues = self.partial.as_ref().is_some_and(|partial| partial.id == message.id);
        if !continues {
            texts.extend(self.take());
        }
        if message.id == 0 {
            texts.push(Text::new(message.severity, part));
            return texts;
        }
        let partial = self.partial.get_or_insert_with(|| Partial {
            id: message.id,
            severity: message.severity,
            bytes: Vec::new(),
            next: 0,
            since_ns: now_ns,
        });
        if message.chunk_seq != partial.next {
            partial.bytes.extend_from_slice(b" ... ");
        }
        partial.bytes.extend_from_slice(part);
        partial.next = message.chunk_seq.saturating_add(1);
        partial.since_ns = now_ns;
        if length < PART || partial.next >= MAX_PARTS || partial.bytes.len() > MAX_BYTES {
            texts.extend(self.take());
        }
        texts
    }

    /// Returns a text whose last part did not come in time.
    pub(crate) fn tick(&mut self, now_ns: i64) -> Option<Text> {
        let late = |partial: &Partial| now_ns.saturating_sub(partial.since_ns) > PART_TIMEOUT_NS;
        if self.partial.as_ref().is_some_and(late) { self.take() } else { None }
    }

    fn take(&mut self) -> Option<Text> {
        self.partial.take().map(|partial| Text::new(partial.severity, &partial.bytes))
    }
}

/// The text of all parts, decoded together because characters may be split between parts, without control
/// characters.
fn clean(bytes: &[u8]) -> String {
    let text = String::from_utf8_lossy(bytes);
    text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn part(id: u16, chunk_seq: u8, text: &str) -> STATUSTEXT_DATA {
        STATUSTEXT_DATA { text: text.into(), id, chunk_seq, ..Default::default() }
    }

    #[test]
    fn a_long_text_is_joined() {
        let mut joiner = Joiner::default();
        let first = "Arm: AHRS: EKF3 Yaw inconsistent 77 deg. Wait or r";
        assert!(joiner.push(0, &part(3, 0, first)).is_empty());
        let texts = joiner.push(1, &part(3, 1, "eboot"));
        assert_eq!(texts[0].text, format!("{first}eboot"));
        assert_eq!(joiner.push(2, &part(0, 0, "short\u{7}"))[0].text, "short ");
    }

    #[test]
    fn a_tab_at_the_end_marks_a_text_that_is_an_event_as_well() {
        let mut joiner = Joiner::default();
        let text = &joiner.push(0, &part(0, 0, "Takeoff detected\t"))[0];
        assert_eq!((text.text.as_str(), text.is_event), ("Takeoff detected", true));
        let long = "x".repeat(PART);
        joiner.push(0, &part(3, 0, &long));
        let text = &joiner.push(1, &part(3, 1, "\t"))[0];
        assert_eq!((text.text.as_str(), text.is_event), (long.as_str(), true));
        assert!(!joiner.push(2, &part(0, 0, "a\tb"))[0].is_event);
    }

    #[test]
    fn a_lost_part_hides_no_other_text() {
        let mut joiner = Joiner::default();
        let long = "x".repeat(PART);
        joiner.push(0, &part(3, 0, &long));
        let texts = joiner.push(1, &part(4, 0, "next"));
        assert_eq!(
            texts.iter().map(|text| text.text.as_str()).collect::<Vec<_>>(),
            [&long, "next"]
        );
        joiner.push(2, &part(5, 0, &long));
        assert!(joiner.tick(2 + PART_TIMEOUT_NS).is_none());
        assert_eq!(joiner.tick(3 + PART_TIMEOUT_NS).unwrap().text, long);
        joiner.push(2, &part(6, 0, &long));
        assert!(joiner.push(3, &part(6, 2, "end"))[0].text.contains(" ... end"));
    }
}
