//! Checks the order of a camera's frames: finds stamps and sequence numbers that are not later than those of the frame before. Two
//! publishers of one camera are recognised by them.

use std::collections::VecDeque;

use messages::FrameHeader;

/// Number of steps back within [`PERIOD_FRAMES`] from which on two programs publish: a restarted camera steps back once.
const MIN_STEPS_BACK: usize = 3;
/// Number of frames in which steps back are counted.
const PERIOD_FRAMES: u64 = 60;

/// The order of the frames of one camera, or of one key.
#[derive(Debug, Default)]
pub struct FrameOrder {
    before: Option<Placed>,
    /// Whether the camera numbers its frames: a number was greater than the one before.
    has_numbers: bool,
    frames: u64,
    /// The latest steps back, by the number of frames until then.
    steps_back: VecDeque<u64>,
}

/// A frame's position in the order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Placed {
    /// The name of the clock of its stamp.
    pub clock: String,
    /// Its stamp, in nanoseconds.
    pub stamp_ns: i64,
    /// Its sequence number.
    pub sequence: u64,
}

/// How a frame's position in the order is wrong.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Misplaced {
    /// Its stamp is that of the frame before, or earlier.
    pub by_stamp: bool,
    /// Its sequence number is smaller than that of the frame before, or the same although the camera numbers its frames.
    pub by_sequence: bool,
    /// Sequence numbers or clocks have changed back as often as with two publishers.
    pub as_of_two: bool,
}

impl FrameOrder {
    /// The frame before the next one.
    pub fn before(&self) -> Option<&Placed> {
        self.before.as_ref()
    }

    /// Takes the next frame.
    pub fn on_frame(&mut self, header: &FrameHeader) -> Misplaced {
        let FrameHeader { ref clock, stamp_ns, sequence, .. } = *header;
        let frame = Placed { clock: clock.clone(), stamp_ns, sequence };
        self.frames += 1;
        let Some(before) = self.before.replace(frame) else { return Misplaced::default() };
        // Stamps of two clocks cannot be compared.
        let by_stamp = before.clock == *clock && stamp_ns <= before.stamp_ns;
        self.has_numbers |= sequence > before.sequence;
        // Stamps of one camera may step back, and one that does not number its frames repeats the number.
        let by_sequence =
            sequence < before.sequence || (sequence == before.sequence && self.has_numbers);
        let is_step = sequence < before.sequence || before.clock != *clock;
        if is_step {
            self.steps_back.push_back(self.frames);
        }
        while self.steps_back.front().is_some_and(|at| self.frames - at > PERIOD_FRAMES) {
            self.steps_back.pop_front();
        }
        let as_of_two = is_step && self.steps_back.len() >= MIN_STEPS_BACK;
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
        let mut order = FrameOrder::default();
        // The second line is a camera that was started again.
        for (start_ms, count) in [(0, 100), (10_000, 100)] {
            for sequence in 0..count {
                let found = order.on_frame(&header(start_ms + 33 * sequence, sequence as u64));
                assert!(!found.by_stamp && !found.as_of_two, "{sequence}: {found:?}");
                assert_eq!(found.by_sequence, start_ms > 0 && sequence == 0, "{sequence}");
            }
        }
        let two = (0..20_u64).map(|index| {
            let (stamp_ms, sequence) = (20_000 + 17 * index as i64, index / 2);
            let is_second = index % 2 == 1;
            order.on_frame(&header(stamp_ms, if is_second { 5000 + sequence } else { sequence }))
        });
        let found: Vec<Misplaced> = two.collect();
        assert!(found.iter().any(|it| it.as_of_two), "{found:?}");
        assert!(found.iter().all(|it| !it.by_stamp), "{found:?}");
    }

    #[test]
    fn two_publishers_with_near_numbers_are_recognised_and_three_restarts_within_a_minute_are_none()
    {
        let mut order = FrameOrder::default();
        let two: Vec<Misplaced> = (0..20_u64)
            .map(|index| order.on_frame(&header(17 * index as i64, index / 2 + 40 * (index % 2))))
            .collect();
        assert!(two.iter().any(|it| it.as_of_two), "{two:?}");
        let mut order = FrameOrder::default();
        for start in 0..4 {
            for sequence in 0..100 {
                let stamp_ms = 15_000 * start + 33 * sequence;
                let found = order.on_frame(&header(stamp_ms, sequence as u64));
                assert!(!found.as_of_two, "{start} {sequence}");
            }
        }
    }

    #[test]
    fn a_camera_that_does_not_number_its_frames_has_no_wrong_order() {
        let mut order = FrameOrder::default();
        for stamp_ms in 0..100 {
            assert_eq!(order.on_frame(&header(stamp_ms, 0)), Misplaced::default(), "{stamp_ms}");
        }
    }

    #[test]
    fn stamps_that_repeat_or_step_back_are_found() {
        let mut order = FrameOrder::default();
        let by_stamp = [(0, 1), (33, 2), (33, 3), (20, 4), (66, 5)]
            .map(|(stamp_ms, sequence)| order.on_frame(&header(stamp_ms, sequence)).by_stamp);
        assert_eq!(by_stamp, [false, false, true, true, false]);
        let repeated = order.on_frame(&header(99, 5));
        assert!(repeated.by_sequence && !repeated.by_stamp, "{repeated:?}");
        assert!(!repeated.as_of_two, "{repeated:?}");
        // Another clock, as of a second machine, again and again.
        let other = |stamp_ms, sequence| FrameHeader {
            clock: "other".into(),
            ..header(stamp_ms, sequence)
        };
        assert!(!order.on_frame(&other(1, 6)).by_stamp);
        assert!(!order.on_frame(&header(132, 7)).as_of_two);
        assert!(order.on_frame(&other(2, 8)).as_of_two);
    }
}
