//! Counts lost frames, messages and packets, and names the gaps of the recording.

use std::collections::BTreeMap;

use flightlog::Lost;
use messages::has_never_come;

use crate::flight::{Boot, Flight};

/// Number of damaged parts beyond which only the first is named among the gaps.
pub const MAX_PARTS: usize = 3;

/// How long after the begin of a landing its recording may begin without a note, in seconds: states are published five times a second.
const MAX_LATE_BEGIN_S: f64 = 0.5;

/// Something of which a part was lost.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Loss {
    /// The place of the loss.
    pub place: String,
    /// The kind of the lost items.
    pub kind: String,
    /// How many.
    pub count: u64,
    /// Of how many, where that is known.
    pub of: Option<u64>,
}

/// Numbers that fall by more than this restart, with a publisher that started again; by less they were late.
const MAX_LATE: u64 = 100;

/// Frames by their numbers.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq)]
struct Numbers {
    /// The first since the publisher started.
    first: u64,
    /// The largest since then.
    last: u64,
    /// How many were received.
    count: u64,
    /// How many there were before the publisher started again.
    before: u64,
}

impl Numbers {
    /// Of numbers in the order of reception.
    fn of(sequences: impl Iterator<Item = u64>) -> Option<Self> {
        sequences.fold(None, |so_far: Option<Self>, sequence| {
            let alone = Self { first: sequence, last: sequence, count: 1, before: 0 };
            Some(match so_far {
                None => alone,
                Some(it) if sequence.saturating_add(MAX_LATE) < it.last => {
                    Self { count: it.count + 1, before: it.all(), ..alone }
                }
                Some(it) => Self {
                    first: it.first.min(sequence),
                    last: it.last.max(sequence),
                    count: it.count + 1,
                    before: it.before,
                },
            })
        })
    }

    fn all(self) -> u64 {
        self.last.saturating_sub(self.first).saturating_add(1).saturating_add(self.before)
    }

    fn missing(self) -> u64 {
        self.all().saturating_sub(self.count)
    }
}

/// Frames whose numbers are missing: in the recording, and among those that a detector searched.
pub fn frames(flight: &Flight) -> Vec<Loss> {
    let mut losses = Vec::new();
    for (camera, frames) in &flight.frames {
        if let Some(numbers) = Numbers::of(frames.iter().map(|frame| frame.sequence)) {
            losses.push(Loss {
                place: format!("camera {camera}"),
                kind: "frames that are not in the recording".to_owned(),
                count: numbers.missing(),
                of: Some(numbers.all()),
            });
        }
    }
    let mut searched: BTreeMap<&str, Vec<u64>> = BTreeMap::new();
    for found in &flight.found {
        searched.entry(&found.detector).or_default().push(found.message.header.sequence);
    }
    for (detector, sequences) in searched {
        if let Some(numbers) = Numbers::of(sequences.into_iter()) {
            losses.push(Loss {
                place: format!("detector {detector}"),
                kind: "frames without detections: not searched, overtaken, or their message lost"
                    .to_owned(),
                count: numbers.missing(),
                of: Some(numbers.all()),
            });
        }
    }
    losses
}

/// The counts of each process, except refused detections.
pub fn processes(flight: &Flight) -> Vec<Loss> {
    let mut losses = Vec::new();
    for (name, process) in &flight.processes {
        let drops = process.last.drops.iter().chain(&process.last.errors);
        losses.extend(drops.filter(|drop| drop.count > 0).map(|drop| Loss {
            place: name.clone(),
            kind: drop.reason.clone(),
            count: drop.count,
            of: None,
        }));
    }
    losses
}

/// The messages that the recorder lost, by key. Frames that it never received are among [`frames`].
pub fn recorder(flight: &Flight) -> Vec<Loss> {
    let lost = flight.lost.iter().filter(|(key, count)| **count > 0 && !has_never_come(key));
    lost.map(|(key, count)| Loss {
        place: "recorder".to_owned(),
        kind: format!("messages of {key}"),
        count: *count,
        of: None,
    })
    .collect()
}

/// Events that are missing on the controllers' tapes.
pub fn tape(flight: &Flight) -> Vec<Loss> {
    let mut losses = Vec::new();
    for tape in &flight.tapes {
        let (mut next, mut missing) = (0, 0);
        for part in &tape.parts {
            missing = part.first.saturating_sub(next).saturating_add(missing);
            next = part.first.saturating_add(u64::from(part.count));
        }
        losses.push(Loss {
            place: "controller's tape".to_owned(),
            kind: "events".to_owned(),
            count: missing,
            of: Some(next),
        });
    }
    losses
}

/// The lost chunks of the recording, with the time that they covered, as a sentence.
fn lost_chunks(flight: &Flight) -> Option<String> {
    let Lost { chunks, of, gaps_ns } = &flight.lost_chunks;
    if *chunks == 0 {
        return None;
    }
    let mut text = format!("{chunks} of {of} chunks of the recording are lost");
    let sum_s = |lengths_ns: &mut dyn Iterator<Item = i64>| {
        lengths_ns.map(|it| it.max(0) as f64 * 1e-9).sum::<f64>()
    };
    let all_s = sum_s(&mut gaps_ns.iter().map(|gap| gap.end.saturating_sub(gap.start)));
    if all_s > 0.0 {
        text.push_str(&format!(", with the messages of {all_s:.1} s"));
        if let Some(landing_ns) = flight.landing_ns() {
            let landing_s = sum_s(&mut gaps_ns.iter().map(|gap| {
                let [from, to] = [gap.start, gap.end].map(|it| flight.vehicle_ns(it));
                to.min(landing_ns.end).saturating_sub(from.max(landing_ns.start))
            }));
            text.push_str(&format!(", of these {landing_s:.1} s in the landing"));
        }
    }
    Some(text)
}

/// A recording that begins in the middle of the landing, as a sentence.
fn late_begin(flight: &Flight) -> Option<String> {
    // A status that was computed again from the tape may be of before the recording.
    let landing_ns = flight.landing_ns().filter(|_| !flight.is_rebuilt)?;
    let firsts = [
        flight.statuses.first().map(|it| it.stamp_ns),
        flight.vehicle.first().map(|it| it.stamp_ns),
        flight.found.first().map(|it| it.message.header.stamp_ns),
    ];
    let first_ns = firsts.into_iter().flatten().min()?;
    let late_s = first_ns.saturating_sub(landing_ns.start) as f64 * 1e-9;
    (late_s > MAX_LATE_BEGIN_S).then(|| {
        format!(
            "the recording begins {late_s:.1} s after the landing began: the numbers lack earlier data that the tape does not have; if there are \
             earlier files of it, give all of them"
        )
    })
}

/// The gaps of the recording, as sentences.
pub fn recording(flight: &Flight) -> Vec<String> {
    let mut lines = lost_chunks(flight).into_iter().collect::<Vec<_>>();
    match flight.damage.as_slice() {
        [first, others @ ..] if others.len() >= MAX_PARTS => lines.push(format!(
            "{first}; {} further parts are damaged, listed in the last section of the report",
            others.len()
        )),
        all => lines.extend_from_slice(all),
    }
    if !flight.is_ended && flight.is_repaired {
        lines.push("the recording had no end before its repair: its recorder was killed, or the rest was cut off".to_owned());
    } else if !flight.is_ended {
        lines.push("the recording has no end: its recorder was killed, or the rest is cut off; `alight record --repair` writes a copy with an end".to_owned());
    }
    lines.extend(late_begin(flight));
    let Boot { number, of } = flight.boot;
    if of > 1 {
        lines.push(format!(
            "the vehicle's clock restarted during the recording, as with a start of its computer: of {of} such parts this shows number {number} alone"
        ));
    }
    for set_s in &flight.time_set_s {
        lines.push(format!(
            "the clock was set during the recording: UTC is {set_s:+.3} s from the file's own times after it"
        ));
    }
    for (key, unreadable) in &flight.unreadable {
        lines.push(format!(
            "{} messages of {key} are left out: the first {}",
            unreadable.count, unreadable.why
        ));
    }
    if let Some(problem) = flight.recorder.as_ref().and_then(|status| status.problem.as_ref()) {
        lines.push(format!("the recorder's last problem: {problem}"));
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counted(sequences: impl IntoIterator<Item = u64>) -> (u64, u64) {
        let numbers = Numbers::of(sequences.into_iter()).unwrap();
        (numbers.missing(), numbers.all())
    }

    #[test]
    fn missing_numbers_are_counted_across_a_start_of_their_publisher() {
        assert_eq!(counted(5..10), (0, 5));
        assert_eq!(counted([5, 6, 9, 8]), (1, 5), "the 8 was late");
        // 300 and ten of them missing, then a start, and three missing of 50.
        let before = (0..300).filter(|number| !(100..110).contains(number));
        let after = (0..50).filter(|number| !(20..23).contains(number));
        assert_eq!(counted(before.chain(after)), (13, 350));
    }
}
