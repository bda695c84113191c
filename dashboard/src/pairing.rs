//! A picture together with what the detector found in that very picture.
//!
//! Pictures wait until the detections of their frame arrive, the same camera, number and stamp, or for a short time. What
//! was found in one picture is never drawn over another.

use std::collections::VecDeque;
use std::sync::Arc;

use messages::{Detections, FrameHeader};

/// Maximum number of pictures that wait.
const MAX_WAITING: usize = 8;
/// Maximum number of detections that are remembered: of several detectors, and of frames whose picture is still made.
const MAX_DETECTIONS: usize = 32;

/// A picture, ready to be shown.
#[derive(Clone, Debug)]
pub struct Picture {
    /// The frame's header.
    pub header: FrameHeader,
    /// JPEG files: one of the whole frame, or one of each part in the header.
    pub files: Arc<Vec<u8>>,
    /// When it came, in nanoseconds of this process' clock.
    pub received_ns: i64,
    /// What was found in it; `None` when nobody has told in time.
    pub found: Option<Detections>,
    /// Whether that was found by the detector in use.
    pub is_used: bool,
}

/// Joins pictures and detections.
#[derive(Debug)]
pub struct Pairing {
    hold_ns: i64,
    waiting: VecDeque<Picture>,
    detections: VecDeque<Detections>,
}

impl Pairing {
    /// Pictures wait this long, in nanoseconds.
    pub fn new(hold_ns: i64) -> Self {
        Self { hold_ns, waiting: VecDeque::new(), detections: VecDeque::new() }
    }

    /// Adds the picture of a frame; true when an older one had to go for it.
    pub fn picture(&mut self, now_ns: i64, header: FrameHeader, files: Vec<u8>) -> bool {
        let is_full = self.waiting.len() >= MAX_WAITING;
        if is_full {
            self.waiting.pop_front();
        }
        let files = Arc::new(files);
        self.waiting.push_back(Picture {
            header,
            files,
            received_ns: now_ns,
            found: None,
            is_used: false,
        });
        is_full
    }

    /// Adds what a detector found.
    pub fn detections(&mut self, detections: Detections) {
        if self.detections.len() >= MAX_DETECTIONS {
            self.detections.pop_front();
        }
        self.detections.push_back(detections);
    }

    /// The newest picture that is ready; older ones are never shown after it.
    ///
    /// A picture is ready once the detector in use has told what is in it, or any one while none is in use, or when it has
    /// waited long enough.
    pub fn ready(&mut self, now_ns: i64, in_use: Option<&str>) -> Option<Picture> {
        let (hold_ns, detections) = (self.hold_ns, &self.detections);
        let is_ready = |picture: &Picture| {
            let is_late = now_ns.saturating_sub(picture.received_ns) >= hold_ns;
            let is_told = in_frame(detections, &picture.header)
                .any(|told| in_use.is_none_or(|in_use| in_use == told.detector));
            is_late || is_told
        };
        let newest = self.waiting.iter().rposition(is_ready)?;
        let mut picture = self.waiting.drain(..=newest).next_back()?;
        let is_used = |told: &&Detections| in_use == Some(told.detector.as_str());
        let used = in_frame(&self.detections, &picture.header).find(is_used);
        picture.is_used = used.is_some();
        picture.found =
            used.or_else(|| in_frame(&self.detections, &picture.header).next()).cloned();
        Some(picture)
    }

    /// When the oldest picture has waited long enough, in nanoseconds; `None` while none waits.
    pub fn deadline_ns(&self) -> Option<i64> {
        self.waiting.front().map(|picture| picture.received_ns.saturating_add(self.hold_ns))
    }
}

fn in_frame<'a>(
    detections: &'a VecDeque<Detections>,
    header: &'a FrameHeader,
) -> impl Iterator<Item = &'a Detections> {
    let is_of = |told: &&Detections| {
        let told = &told.header;
        (&told.camera, told.sequence, told.stamp_ns, &told.clock)
            == (&header.camera, header.sequence, header.stamp_ns, &header.clock)
    };
    detections.iter().rev().filter(is_of)
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOLD: i64 = 100;

    fn header(number: u64) -> FrameHeader {
        FrameHeader { sequence: number, stamp_ns: number as i64 * 10, ..FrameHeader::sample() }
    }

    fn told(detector: &str, number: u64) -> Detections {
        Detections { detector: detector.into(), header: header(number), ..Detections::sample() }
    }

    #[test]
    fn a_picture_waits_for_what_was_found_in_it() {
        let mut pairing = Pairing::new(HOLD);
        pairing.picture(0, header(1), vec![1]);
        pairing.detections(told("main", 2));
        assert!(pairing.ready(50, Some("main")).is_none());
        pairing.picture(10, header(2), vec![2]);
        let shown = pairing.ready(50, Some("main")).unwrap();
        assert_eq!((shown.header.sequence, shown.is_used), (2, true));
        assert_eq!(shown.found.unwrap().header, shown.header);
        // What is older than a picture that was shown is shown no more.
        pairing.detections(told("main", 1));
        assert!(pairing.ready(1000, Some("main")).is_none());
        assert_eq!(pairing.deadline_ns(), None);
    }

    #[test]
    fn a_picture_of_which_nobody_tells_is_shown_late_and_bare() {
        let mut pairing = Pairing::new(HOLD);
        pairing.picture(0, header(1), vec![1]);
        pairing.detections(Detections {
            header: FrameHeader { stamp_ns: 11, ..header(1) },
            ..told("main", 1)
        });
        assert!(pairing.ready(HOLD - 1, Some("main")).is_none());
        assert_eq!(pairing.deadline_ns(), Some(HOLD));
        let shown = pairing.ready(HOLD, Some("main")).unwrap();
        assert!(shown.found.is_none() && !shown.is_used);
    }

    #[test]
    fn the_detector_in_use_is_preferred_and_another_is_named_as_such() {
        let mut pairing = Pairing::new(HOLD);
        pairing.picture(0, header(1), vec![1]);
        pairing.detections(told("spare", 1));
        assert!(pairing.ready(1, Some("main")).is_none());
        pairing.detections(told("main", 1));
        assert_eq!(pairing.ready(1, Some("main")).unwrap().found.unwrap().detector, "main");
        pairing.picture(0, header(2), vec![1]);
        pairing.detections(told("spare", 2));
        let late = pairing.ready(HOLD, Some("main")).unwrap();
        assert_eq!((late.found.unwrap().detector.as_str(), late.is_used), ("spare", false));
        pairing.picture(0, header(3), vec![1]);
        pairing.detections(told("spare", 3));
        assert!(!pairing.ready(1, None).unwrap().is_used);
    }

    #[test]
    fn what_waits_is_bounded() {
        let mut pairing = Pairing::new(HOLD);
        let lost = (0..20).filter(|number| pairing.picture(0, header(*number), Vec::new())).count();
        assert_eq!((lost, pairing.waiting.len()), (20 - MAX_WAITING, MAX_WAITING));
        (0..100).for_each(|number| pairing.detections(told("main", number)));
        assert_eq!(pairing.detections.len(), MAX_DETECTIONS);
    }
}
