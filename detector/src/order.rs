//! Counts frames that do not follow the frame before them, and logs the first one of each kind with its numbers and the remedy. All
//! are searched nevertheless: the controller checks the stamps.

use messages::FrameHeader;
use node::HealthCounters;
use node::frame_order::{FrameOrder, Misplaced};

/// Shortest time between the frames before and after the start of a camera, in nanoseconds.
const MIN_RESTART_NS: i64 = 300_000_000;

/// The order of the frames that a detector searches.
#[derive(Debug, Default)]
pub(crate) struct Order {
    frames: FrameOrder,
}

/// A way in which a frame does not follow the frame before.
#[derive(Debug, PartialEq, Eq)]
struct Problem {
    /// The reason under which it is counted.
    reason: String,
    /// The line of the log.
    text: String,
}

/// The frame before, without the name of its clock.
#[derive(Clone, Copy, Debug)]
struct Before {
    stamp_ns: i64,
    sequence: u64,
}

impl Order {
    /// Takes the next frame.
    pub(crate) fn check(&mut self, health: &HealthCounters, header: &FrameHeader) {
        for Problem { reason, text } in self.problems(header) {
            if health.failed(&reason) {
                tracing::warn!("{text} (further ones are counted)");
            }
        }
    }

    fn problems(&mut self, header: &FrameHeader) -> Vec<Problem> {
        let before = self.frames.before();
        let before = before.map(|it| Before { stamp_ns: it.stamp_ns, sequence: it.sequence });
        let Misplaced { by_stamp, by_sequence, as_of_two } = self.frames.on_frame(header);
        let Some(before) = before else { return Vec::new() };
        let camera = &header.camera;
        let mut problems = Vec::new();
        if by_stamp {
            problems.push(by_its_stamp(header, before));
        }
        // A camera that is started again numbers its frames anew.
        let is_restart = header.sequence < before.sequence
            && header.stamp_ns.saturating_sub(before.stamp_ns) >= MIN_RESTART_NS;
        if by_sequence && !is_restart {
            problems.push(Problem {
                reason: "frame whose sequence number is not greater than that of the frame before".to_owned(),
                text: format!(
                    "Camera `{camera}` numbers a frame {} after {}: `sequence` must grow by one with each frame, also with one that is not \
                     published; it begins again only where the camera is started again",
                    header.sequence, before.sequence
                ),
            });
        }
        if as_of_two {
            problems.push(Problem {
                reason: format!("two publishers of camera `{camera}`"),
                text: format!(
                    "Two publishers of camera `{camera}`, by the sequence numbers or clocks of its frames: end one of them, or give it another \
                     name"
                ),
            });
        }
        problems
    }
}

/// A stamp that is not later than that of the frame before.
fn by_its_stamp(header: &FrameHeader, before: Before) -> Problem {
    let FrameHeader { camera, sequence, stamp_ns, .. } = header;
    let back_ns = before.stamp_ns.saturating_sub(*stamp_ns);
    if back_ns == 0 {
        return Problem {
            reason: "frame with the stamp of the frame before".to_owned(),
            text: format!(
                "Camera `{camera}` gives the frame {sequence} the stamp of the frame {}, {stamp_ns} ns: the controller uses only newer ones; \
                 give each frame the time at the middle of its own exposure, and publish no picture twice",
                before.sequence
            ),
        };
    }
    Problem {
        reason: "frame whose stamp is earlier than that of the frame before".to_owned(),
        text: format!(
            "Camera `{camera}` stamps the frame {sequence} {:.1} ms before the frame {} ({stamp_ns} after {} ns), and the controller uses only newer ones: \
             publish frames in the order of their exposures, and stamp them with a clock that does not step back (CLOCK_MONOTONIC)",
            back_ns as f64 * 1e-6,
            before.sequence,
            before.stamp_ns
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn problems(order: &mut Order, stamp_ms: i64, sequence: u64) -> Vec<Problem> {
        let stamp_ns = stamp_ms * 1_000_000;
        order.problems(&FrameHeader { stamp_ns, sequence, ..FrameHeader::sample() })
    }

    #[test]
    fn each_kind_of_wrong_order_is_counted_apart_and_logged_with_its_numbers() {
        let mut order = Order::default();
        for (stamp_ms, sequence) in [(100, 1), (133, 2)] {
            assert_eq!(problems(&mut order, stamp_ms, sequence), []);
        }
        let cases = [
            (
                133,
                3,
                "with the stamp of the frame before",
                "the frame 3 the stamp of the frame 2, 133000000 ns",
            ),
            (
                120,
                4,
                "stamp is earlier",
                "the frame 4 13.0 ms before the frame 3 (120000000 after 133000000 ns)",
            ),
            (166, 4, "sequence number is not greater", "numbers a frame 4 after 4"),
        ];
        for (stamp_ms, sequence, reason, text) in cases {
            let found = problems(&mut order, stamp_ms, sequence);
            assert!(found.len() == 1 && found[0].reason.contains(reason), "{found:?}");
            assert!(found[0].text.contains(text), "{found:?}");
        }
        assert_eq!(problems(&mut order, 1200, 0), [], "it was started again");
        assert_eq!(problems(&mut order, 1233, 0).len(), 1);
    }

    #[test]
    fn frames_out_of_order_are_counted_by_their_reasons() {
        let (mut order, health) = (Order::default(), HealthCounters::default());
        for stamp_ns in [5, 5, 5, 4] {
            order.check(&health, &FrameHeader { stamp_ns, ..FrameHeader::sample() });
        }
        assert_eq!(health.failures("frame with the stamp of the frame before"), 2);
        assert_eq!(
            health.failures("frame whose stamp is earlier than that of the frame before"),
            1
        );
    }
}
