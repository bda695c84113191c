//! Counts frames that were never received, by their numbers: a recorder that had no processor for a while does not see which were lost on
//! the way to it. Two publishers with the name of one camera, whose numbers alternate, leave no gaps.

use std::collections::BTreeMap;

use messages::{FrameHeader, NEVER_CAME};
use node::frame_order::FrameOrder;

/// Maximum number of cameras whose frames are counted.
const MAX_CAMERAS: usize = 1024;
/// Maximum plausible number of frames in one gap; a larger one is a camera that restarts its numbers.
const MAX_GAP: u64 = 100_000;
/// By so many numbers a frame may be late, as one that a link delayed; one that is further behind is of a camera that
/// restarted.
const MAX_LATE: u64 = 64;

/// The numbers of each camera's frames.
#[derive(Debug, Default)]
pub(crate) struct Unseen {
    cameras: BTreeMap<String, Numbers>,
}

#[derive(Debug, Default)]
struct Numbers {
    /// The number of the last frame.
    last: u64,
    /// Numbers that were left out before it.
    missing: u64,
    /// Frames that were received and dropped before they were looked at; their numbers are missing as well.
    dropped: u64,
    /// Frames that have been returned as unseen.
    counted: u64,
    /// The last number before the latest jump, after which another publisher may continue.
    before_jump: Option<u64>,
    /// Numbers that the latest jump left out; they are missing unless the next frame returns to those before it.
    jumped: u64,
    order: FrameOrder,
}

impl Numbers {
    fn take(&mut self, sequence: u64) {
        let step = sequence.saturating_sub(self.last);
        let late = self.last.saturating_sub(sequence);
        if step > MAX_LATE || late > MAX_LATE {
            self.jump(sequence);
            return;
        }
        if step > 0 {
            self.missing += step - 1 + std::mem::take(&mut self.jumped);
        } else if late > 0 && sequence > 0 {
            // Its number counted as missing. A frame that is received twice counts as two, so that the reported gap may be too small.
            self.missing = self.missing.saturating_sub(1);
            return;
        } else if late > 0 {
            self.restarted();
        }
        self.last = sequence;
    }

    /// Takes a number far from the last one: the camera restarted, many frames are missing, or another publisher has the same key.
    fn jump(&mut self, sequence: u64) {
        let jumped = std::mem::take(&mut self.jumped);
        let before = self.before_jump.replace(self.last);
        let return_step = before.map_or(0, |before| sequence.saturating_sub(before));
        let step = sequence.saturating_sub(self.last);
        if (1..=MAX_LATE).contains(&return_step) {
            self.missing += return_step - 1;
        } else {
            self.missing += jumped;
            if (1..=MAX_GAP).contains(&step) {
                self.jumped = step - 1;
            } else {
                self.restarted();
            }
        }
        self.last = sequence;
    }

    fn restarted(&mut self) {
        // Those that were dropped before the new numbers leave no gap in them.
        self.missing = self.missing.max(self.dropped);
    }
}

impl Unseen {
    /// Takes the header of a frame, by its key; true where it shows that two publishers use that key.
    pub(crate) fn take(&mut self, key: &str, header: &FrameHeader) -> bool {
        let Some(numbers) = self.cameras.get_mut(key) else {
            if self.cameras.len() < MAX_CAMERAS {
                let mut first = Numbers { last: header.sequence, ..Numbers::default() };
                first.order.on_frame(header);
                self.cameras.insert(key.to_owned(), first);
            }
            return false;
        };
        numbers.take(header.sequence);
        numbers.order.on_frame(header).as_of_two
    }

    /// Takes how many messages of a key were dropped before they were looked at.
    pub(crate) fn dropped(&mut self, key: &str, count: u64) {
        if let Some(numbers) = self.cameras.get_mut(key) {
            numbers.dropped += count;
        }
    }

    /// The frames that were never received and were not returned before, by key and reason. One that was dropped is missing only once
    /// the next was received; some are returned later.
    pub(crate) fn more(&mut self) -> Vec<(String, u64)> {
        let more = self.cameras.iter_mut().filter_map(|(key, numbers)| {
            let unseen = numbers.missing.saturating_sub(numbers.dropped);
            let more = unseen.saturating_sub(numbers.counted);
            numbers.counted += more;
            (more > 0).then(|| (format!("{key} {NEVER_CAME}"), more))
        });
        more.collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KEY: &str = "camera/down/frame";
    const UNSEEN: &str = "camera/down/frame (never came)";

    fn take(unseen: &mut Unseen, sequence: u64) -> bool {
        unseen.take(KEY, &FrameHeader { sequence, ..FrameHeader::sample() })
    }

    #[test]
    fn missing_numbers_are_frames_that_were_never_received() {
        let mut unseen = Unseen::default();
        for sequence in [7, 8, 12, 13] {
            take(&mut unseen, sequence);
        }
        assert_eq!(unseen.more(), [(UNSEEN.to_owned(), 3)]);
        assert_eq!(unseen.more(), []);
        // The next two are dropped before they are looked at, and counted where they were dropped.
        unseen.dropped(KEY, 2);
        assert_eq!(unseen.more(), []);
        take(&mut unseen, 16);
        assert_eq!(unseen.more(), []);
        take(&mut unseen, 18);
        assert_eq!(unseen.more(), [(UNSEEN.to_owned(), 1)]);
    }

    #[test]
    fn two_publishers_of_one_key_are_detected_and_leave_no_gaps() {
        let mut unseen = Unseen::default();
        let mut are_two = false;
        for number in 0..20 {
            are_two |= take(&mut unseen, 100 + number);
            are_two |= take(&mut unseen, 5000 + number);
            // Whenever the losses are looked at.
            assert_eq!(unseen.more(), [], "{number}");
            if number % 3 == 0 {
                take(&mut unseen, 5000 + number);
            }
        }
        assert!(are_two);
        // One of them misses a frame.
        take(&mut unseen, 121);
        assert_eq!(unseen.more(), [(UNSEEN.to_owned(), 1)]);
    }

    #[test]
    fn a_long_gap_counts_with_the_frame_after_it_and_a_restart_is_no_second_publisher() {
        let mut unseen = Unseen::default();
        take(&mut unseen, 10);
        take(&mut unseen, 1011);
        assert_eq!(unseen.more(), []);
        take(&mut unseen, 1012);
        assert_eq!(unseen.more(), [(UNSEEN.to_owned(), 1000)]);
        for sequence in [0, 1, 2, 900] {
            assert!(!take(&mut unseen, sequence));
        }
    }

    #[test]
    fn a_frame_that_comes_late_is_not_missing() {
        let mut unseen = Unseen::default();
        for sequence in [10, 12, 11, 13] {
            take(&mut unseen, sequence);
        }
        assert_eq!(unseen.more(), []);
    }

    #[test]
    fn drops_before_a_restart_of_a_camera_hide_no_gap_after_it() {
        let mut unseen = Unseen::default();
        take(&mut unseen, 900);
        unseen.dropped(KEY, 3);
        take(&mut unseen, 0);
        take(&mut unseen, 3);
        assert_eq!(unseen.more(), [(UNSEEN.to_owned(), 2)]);
    }

    #[test]
    fn a_camera_that_restarts_has_no_gap() {
        let mut unseen = Unseen::default();
        for sequence in [900, 0, 1, u64::MAX, 0, 5, 5] {
            take(&mut unseen, sequence);
        }
        assert_eq!(unseen.more(), [(UNSEEN.to_owned(), 4)]);
    }
}
