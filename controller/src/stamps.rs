//! Checks that detectors pass on the stamps of frames unchanged: compares the stamps that two of them give one frame of a camera, by its number.
//!
//! The controller receives no frames, so it cannot detect that the only detector shifts its stamps; of two that differ it cannot determine which.

use std::collections::{BTreeMap, VecDeque};

use messages::FrameHeader;

use crate::refusals::{Refusals, Warning};
use crate::selection::MAX_DETECTORS;

/// Maximum number of frames that are remembered.
const MAX_FRAMES: usize = 128;
/// Maximum difference of two stamps of one frame, in nanoseconds: with a larger one its camera began to count again from its first number.
const MAX_APART_NS: i64 = 1_000_000_000;

/// The latest frames, each with the stamp that the first detector gave it.
#[derive(Debug, Default)]
pub struct Stamps {
    frames: VecDeque<Frame>,
    /// The number of each detector's newest frame; at most [`MAX_DETECTORS`].
    newest: BTreeMap<String, u64>,
    differing: Refusals,
}

#[derive(Debug)]
struct Frame {
    sequence: u64,
    stamp_ns: i64,
    camera: String,
    detector: String,
}

impl Stamps {
    /// A detector searched a frame.
    pub fn searched(&mut self, now_ns: i64, detector: &str, header: &FrameHeader) {
        let FrameHeader { camera, sequence, stamp_ns, .. } = header;
        let Some(newest) = self.newest.get_mut(detector) else {
            if self.newest.len() < MAX_DETECTORS {
                self.newest.insert(detector.to_owned(), *sequence);
            }
            return;
        };
        // The frame numbers of a camera that does not count are useless.
        let counts = *sequence > std::mem::replace(newest, *sequence);
        if !counts {
            return;
        }
        let is_it = |frame: &&Frame| {
            frame.sequence == *sequence
                && frame.camera == *camera
                && frame.stamp_ns.saturating_sub(*stamp_ns).saturating_abs() < MAX_APART_NS
        };
        let Some(frame) = self.frames.iter().rev().find(is_it) else {
            if self.frames.len() >= MAX_FRAMES {
                self.frames.pop_front();
            }
            let (camera, detector) = (camera.clone(), detector.to_owned());
            let frame = Frame { sequence: *sequence, stamp_ns: *stamp_ns, camera, detector };
            self.frames.push_back(frame);
            return;
        };
        let apart_ns = stamp_ns.saturating_sub(frame.stamp_ns);
        if apart_ns != 0 && frame.detector != detector {
            let other = &frame.detector;
            let first = detector.min(other);
            let second = detector.max(other);
            self.differing.add_of(now_ns, "another-stamp", &format!("{first} {second}"), || {
                format!(
                    "detectors `{first}` and `{second}` give frames of camera `{camera}` stamps that lie {:.1} ms apart, as frame {sequence}: one of them does \
                     not pass the frame's header on unchanged (0 ms are allowed), and its markers are used as of another moment; stop it, or have it copy \
                     `header` as it came",
                    apart_ns.abs() as f64 * 1e-6
                )
            });
        }
    }

    /// Forgets a detector that has ended.
    pub fn ended(&mut self, detector: &str) {
        self.newest.remove(detector);
    }

    /// The warnings for the operator.
    pub fn warnings(&self, now_ns: i64) -> impl Iterator<Item = Warning> {
        self.differing.lasting(now_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    /// The warnings after two seconds of two detectors, the second of which shifts its stamps.
    fn warnings(shift_ms: i64, number: impl Fn(i64) -> u64) -> Vec<String> {
        let mut stamps = Stamps::default();
        for i in 0..30 {
            let header = |shift_ms: i64| FrameHeader {
                sequence: number(i),
                stamp_ns: (i * 67 + shift_ms) * MS,
                ..FrameHeader::sample()
            };
            stamps.searched(i * 67 * MS, "main", &header(0));
            stamps.searched(i * 67 * MS + 9, "mine", &header(shift_ms));
        }
        assert!(stamps.frames.len() <= MAX_FRAMES);
        stamps.warnings(29 * 67 * MS).map(|it| it.text).collect()
    }

    #[test]
    fn two_stamps_of_one_frame_are_reported_and_those_of_other_frames_are_not() {
        let counted = |i: i64| i as u64;
        let shifted = warnings(20, counted);
        assert_eq!(shifted.len(), 1, "{shifted:?}");
        assert!(shifted[0].contains("`main` and `mine`") && shifted[0].contains("20.0 ms apart"));
        assert!(shifted[0].contains("0 ms are allowed") && shifted[0].contains("stop it"));
        assert!(warnings(0, counted).is_empty());
        // A camera that began to count again, and one that does not count.
        assert!(warnings(5000, counted).is_empty());
        assert!(warnings(20, |_| 7).is_empty());
    }

    #[test]
    fn the_memory_is_bounded() {
        let mut stamps = Stamps::default();
        for i in 0..5000_i64 {
            let header =
                FrameHeader { sequence: i as u64, stamp_ns: i * MS, ..FrameHeader::sample() };
            stamps.searched(i * MS, &format!("{}", i % 100), &header);
        }
        assert_eq!((stamps.frames.len(), stamps.newest.len()), (MAX_FRAMES, MAX_DETECTORS));
    }
}
