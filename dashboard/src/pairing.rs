//! Joins each picture with the detections of the same frame.
//!
//! A picture waits until the detections of its frame (same camera, number and stamp) arrive, or until a timeout. While a browser
//! shows refused candidates, it also waits for those. The detections of one picture are never drawn over another.

use std::collections::VecDeque;
use std::sync::Arc;

use messages::{Detections, FrameHeader, Refusals};

/// Maximum number of pictures that wait.
const MAX_WAITING: usize = 8;
/// Maximum number of messages with detections that are stored: of several detectors, and of frames whose picture is still
/// being made.
const MAX_DETECTIONS: usize = 32;

/// A picture, ready to be shown.
#[derive(Clone, Debug)]
pub struct Picture {
    /// The frame's header.
    pub header: FrameHeader,
    /// JPEG files: one of the full frame, or one of each part in the header.
    pub files: Arc<Vec<u8>>,
    /// Time of its arrival, in nanoseconds of this process' clock.
    pub received_ns: i64,
    /// Its detections; `None` when none arrived in time.
    pub found: Option<Detections>,
    /// Whether these are of the detector in use.
    pub is_used: bool,
    /// The candidates that the same detector refused in it; `None` when they were not requested, or did not arrive in time.
    pub refused: Option<Refusals>,
}

/// Joins pictures and detections.
#[derive(Debug)]
pub struct Pairing {
    hold_ns: i64,
    waiting: VecDeque<Picture>,
    detections: VecDeque<Detections>,
    /// Those of the newest frames, while they are requested.
    refusals: VecDeque<Refusals>,
}

impl Pairing {
    /// `hold_ns` is the maximum wait of a picture, in nanoseconds.
    pub fn new(hold_ns: i64) -> Self {
        Self {
            hold_ns,
            waiting: VecDeque::new(),
            detections: VecDeque::new(),
            refusals: VecDeque::new(),
        }
    }

    /// Adds the picture of a frame; true when an older one was dropped for it.
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
            refused: None,
        });
        is_full
    }

    /// Adds the detections of a frame.
    pub fn detections(&mut self, detections: Detections) {
        if self.detections.len() >= MAX_DETECTIONS {
            self.detections.pop_front();
        }
        self.detections.push_back(detections);
    }

    /// Adds the candidates that a detector refused in a frame. From then on pictures wait for these as well.
    pub fn refusals(&mut self, refusals: Refusals) {
        if self.refusals.len() >= MAX_DETECTIONS {
            self.refusals.pop_front();
        }
        self.refusals.push_back(refusals);
    }

    /// Discards refused candidates, as they are no longer requested.
    pub fn forget_refusals(&mut self) {
        self.refusals.clear();
    }

    /// The newest picture that is ready; older ones are never shown after it.
    ///
    /// A picture is ready once the detections of the detector in use have arrived, or those of any detector while none is in
    /// use, or when it has waited for the maximum time.
    pub fn ready(&mut self, now_ns: i64, in_use: Option<&str>) -> Option<Picture> {
        let (hold_ns, detections, refusals) = (self.hold_ns, &self.detections, &self.refusals);
        let is_ready = |picture: &Picture| {
            let is_late = now_ns.saturating_sub(picture.received_ns) >= hold_ns;
            let is_complete = in_frame(detections, &picture.header).any(|found| {
                in_use.is_none_or(|in_use| in_use == found.detector)
                    && !lacks_refusals(refusals, found)
            });
            is_late || is_complete
        };
        let newest = self.waiting.iter().rposition(is_ready)?;
        let mut picture = self.waiting.drain(..=newest).next_back()?;
        let is_used = |found: &&Detections| in_use == Some(found.detector.as_str());
        let used = in_frame(&self.detections, &picture.header).find(is_used);
        picture.is_used = used.is_some();
        picture.found =
            used.or_else(|| in_frame(&self.detections, &picture.header).next()).cloned();
        let refused = picture.found.as_ref().and_then(|found| refused(&self.refusals, found));
        picture.refused = refused.cloned();
        Some(picture)
    }

    /// The time at which the wait of the oldest picture ends, in nanoseconds; `None` while none waits.
    pub fn deadline_ns(&self) -> Option<i64> {
        self.waiting.front().map(|picture| picture.received_ns.saturating_add(self.hold_ns))
    }
}

fn in_frame<'a>(
    detections: &'a VecDeque<Detections>,
    header: &'a FrameHeader,
) -> impl Iterator<Item = &'a Detections> {
    detections.iter().rev().filter(|found| is_same(&found.header, header))
}

fn is_same(found: &FrameHeader, header: &FrameHeader) -> bool {
    (&found.camera, found.sequence, found.stamp_ns, &found.clock)
        == (&header.camera, header.sequence, header.stamp_ns, &header.clock)
}

/// The candidates that the detector of these detections refused in the same frame.
fn refused<'a>(refusals: &'a VecDeque<Refusals>, found: &Detections) -> Option<&'a Refusals> {
    let mut refusals = refusals.iter().rev();
    refusals.find(|it| it.detector == found.detector && is_same(&it.header, &found.header))
}

/// Whether refused candidates of this frame are missing from a detector that publishes them. Detectors that do not publish
/// them are not waited for.
fn lacks_refusals(refusals: &VecDeque<Refusals>, found: &Detections) -> bool {
    refusals.iter().any(|it| it.detector == found.detector) && refused(refusals, found).is_none()
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOLD: i64 = 100;

    fn header(number: u64) -> FrameHeader {
        FrameHeader { sequence: number, stamp_ns: number as i64 * 10, ..FrameHeader::sample() }
    }

    fn found(detector: &str, number: u64) -> Detections {
        Detections { detector: detector.into(), header: header(number), ..Detections::sample() }
    }

    #[test]
    fn a_picture_waits_for_its_detections() {
        let mut pairing = Pairing::new(HOLD);
        pairing.picture(0, header(1), vec![1]);
        pairing.detections(found("main", 2));
        assert!(pairing.ready(50, Some("main")).is_none());
        pairing.picture(10, header(2), vec![2]);
        let shown = pairing.ready(50, Some("main")).unwrap();
        assert_eq!((shown.header.sequence, shown.is_used), (2, true));
        assert_eq!(shown.found.unwrap().header, shown.header);
        // A picture older than one that was shown is not shown any more.
        pairing.detections(found("main", 1));
        assert!(pairing.ready(1000, Some("main")).is_none());
        assert_eq!(pairing.deadline_ns(), None);
    }

    #[test]
    fn a_picture_without_detections_is_shown_late_and_without_markers() {
        let mut pairing = Pairing::new(HOLD);
        pairing.picture(0, header(1), vec![1]);
        pairing.detections(Detections {
            header: FrameHeader { stamp_ns: 11, ..header(1) },
            ..found("main", 1)
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
        pairing.detections(found("spare", 1));
        assert!(pairing.ready(1, Some("main")).is_none());
        pairing.detections(found("main", 1));
        assert_eq!(pairing.ready(1, Some("main")).unwrap().found.unwrap().detector, "main");
        pairing.picture(0, header(2), vec![1]);
        pairing.detections(found("spare", 2));
        let late = pairing.ready(HOLD, Some("main")).unwrap();
        assert_eq!((late.found.unwrap().detector.as_str(), late.is_used), ("spare", false));
        pairing.picture(0, header(3), vec![1]);
        pairing.detections(found("spare", 3));
        assert!(!pairing.ready(1, None).unwrap().is_used);
    }

    #[test]
    fn refused_candidates_belong_to_the_same_picture() {
        let refused = |detector: &str, number: u64| Refusals {
            detector: detector.into(),
            header: header(number),
            ..Refusals::sample()
        };
        let mut pairing = Pairing::new(HOLD);
        pairing.picture(0, header(1), vec![1]);
        pairing.detections(found("main", 1));
        assert!(pairing.ready(1, Some("main")).unwrap().refused.is_none(), "not requested");
        // Once a detector publishes refused candidates, a picture waits for those, and not for those of another detector.
        pairing.refusals(refused("main", 1));
        pairing.picture(2, header(2), vec![2]);
        pairing.detections(found("main", 2));
        pairing.refusals(refused("spare", 2));
        assert!(pairing.ready(3, Some("main")).is_none());
        pairing.refusals(refused("main", 2));
        let shown = pairing.ready(3, Some("main")).unwrap();
        assert_eq!(shown.refused.unwrap(), refused("main", 2));
        // Where they do not arrive in time there are none, and never those of another frame.
        pairing.picture(4, header(3), vec![3]);
        pairing.detections(found("main", 3));
        assert!(pairing.ready(5, Some("main")).is_none());
        let late = pairing.ready(4 + HOLD, Some("main")).unwrap();
        assert!(late.is_used && late.refused.is_none());
        pairing.forget_refusals();
        pairing.picture(200, header(4), vec![4]);
        pairing.detections(found("main", 4));
        assert!(pairing.ready(200, Some("main")).is_some());
    }

    #[test]
    fn the_queues_are_bounded() {
        let mut pairing = Pairing::new(HOLD);
        let lost = (0..20).filter(|number| pairing.picture(0, header(*number), Vec::new())).count();
        assert_eq!((lost, pairing.waiting.len()), (20 - MAX_WAITING, MAX_WAITING));
        (0..100).for_each(|number| pairing.detections(found("main", number)));
        assert_eq!(pairing.detections.len(), MAX_DETECTIONS);
        (0..100).for_each(|_| pairing.refusals(Refusals::sample()));
        assert_eq!(pairing.refusals.len(), MAX_DETECTIONS);
    }
}
