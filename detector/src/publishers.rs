//! Counts frames whose stamp or sequence number is not later than that of the frame before, and recognises two publishers of one camera by
//! them.

use std::collections::VecDeque;

use messages::FrameHeader;

/// Number of steps back within [`PERIOD_FRAMES`] from which on two programs publish: a restarted camera steps back once.
const MAX_STEPS_BACK: usize = 3;
/// Number of frames in which steps back are counted.
const PERIOD_FRAMES: u64 = 60;

/// The order of a camera's frames.
#[derive(Debug, Default)]
pub(crate) struct Publishers {
    before: Option<Frame>,
    frames: u64,
    /// The latest steps back, by the number of frames until then.
    steps_back: VecDeque<u64>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct Frame {
    clock: String,
    stamp_ns: i64,
    sequence: u64,
}

/// What is wrong with a frame's place among the others.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Misplaced {
    /// Its stamp is that of the frame before, or earlier.
    pub(crate) by_stamp: bool,
    /// Its sequence number is that of the frame before, or smaller.
    pub(crate) by_sequence: bool,
    /// Sequence numbers or clocks have changed back as often as with two publishers.
    pub(crate) as_of_two: bool,
}

impl Publishers {
    /// Takes the next frame.
    pub(crate) fn on_frame(&mut self, header: &FrameHeader) -> Misplaced {
        let FrameHeader { clock, stamp_ns, sequence, .. } = header.clone();
        let frame = Frame { clock, stamp_ns, sequence };
        self.frames += 1;
        let Some(before) = self.before.replace(frame) else { return Misplaced::default() };
        // Stamps of two clocks cannot be compared.
        let by_stamp = before.clock == header.clock && stamp_ns <= before.stamp_ns;
        let by_sequence = sequence <= before.sequence;
        // Stamps of one camera may step back, and one that does not count its frames repeats the number.
        let is_step = sequence < before.sequence || before.clock != header.clock;
        if is_step {
            self.steps_back.push_back(self.frames);
        }
        while self.steps_back.front().is_some_and(|at| self.frames - at > PERIOD_FRAMES) {
            self.steps_back.pop_front();
        }
        let as_of_two = is_step && self.steps_back.len() >= MAX_STEPS_BACK;
        Misplaced { by_stamp, by_sequence, as_of_two }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(stamp_ms: i64, sequence: u64) -> FrameHeader {
        FrameHeader { stamp_ns: stamp_ms * 1_000_000, sequence, ..FrameHeader::sample() }
    }

    #[test]
    fn a_second_publisher_is_recognised_and_a_restart_is_none() {
        let mut publishers = Publishers::default();
        // The second line is a camera that was started again.
        for (start_ms, count) in [(0, 100), (10_000, 100)] {
            for sequence in 0..count {
                let found = publishers.on_frame(&header(start_ms + 33 * sequence, sequence as u64));
                assert!(!found.by_stamp && !found.as_of_two, "{sequence}: {found:?}");
                assert_eq!(found.by_sequence, start_ms > 0 && sequence == 0, "{sequence}");
            }
        }
        let two = (0..20_u64).map(|index| {
            let (stamp_ms, sequence) = (20_000 + 17 * index as i64, index / 2);
            let is_second = index % 2 == 1;
            publishers
                .on_frame(&header(stamp_ms, if is_second { 5000 + sequence } else { sequence }))
        });
        let found: Vec<Misplaced> = two.collect();
        assert!(found.iter().any(|it| it.as_of_two), "{found:?}");
        assert!(found.iter().all(|it| !it.by_stamp), "{found:?}");
    }

    #[test]
    fn stamps_that_repeat_or_step_back_are_found() {
        let mut publishers = Publishers::default();
        let by_stamp = [(0, 1), (33, 2), (33, 3), (20, 4), (66, 5)]
            .map(|(stamp_ms, sequence)| publishers.on_frame(&header(stamp_ms, sequence)).by_stamp);
        assert_eq!(by_stamp, [false, false, true, true, false]);
        let repeated = publishers.on_frame(&header(99, 5));
        assert!(repeated.by_sequence && !repeated.by_stamp, "{repeated:?}");
        assert!(!repeated.as_of_two, "{repeated:?}");
        // Another clock, as of a second machine, again and again.
        let other = |stamp_ms, sequence| FrameHeader {
            clock: "other".into(),
            ..header(stamp_ms, sequence)
        };
        assert!(!publishers.on_frame(&other(1, 6)).by_stamp);
        assert!(!publishers.on_frame(&header(132, 7)).as_of_two);
        assert!(publishers.on_frame(&other(2, 8)).as_of_two);
    }
}
