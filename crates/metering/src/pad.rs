//! Predicts the pad's position and speed in a frame, to meter it there, from detections of its markers in earlier frames.

use std::collections::VecDeque;

use messages::{ControllerStatus, Detection, Detections};

/// Maximum age of the last detection, in nanoseconds. After it the camera meters on its own: a landing continues without the
/// pad for longer, but not with a guess of its position.
const MAX_AGE_NS: i64 = 700_000_000;
/// Time over which the fastest motion counts, in nanoseconds: a vehicle that sways is slow in between.
const MOTION_NS: i64 = 500_000_000;
/// Maximum number of motions that are stored: those of 64 detections in that time.
const MAX_MOTIONS: usize = 64;
/// Minimum time between two detections that give a motion, in nanoseconds; several detectors search the same frame.
const MIN_STEP_NS: i64 = 1_000_000;

/// The pad in a frame.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Pad {
    /// Its centre, in pixels.
    pub centre_px: [f64; 2],
    /// Its largest extent, in pixels.
    pub size_px: f64,
    /// How fast the fastest of its points moved during the half second before it was last seen, in pixels
    /// per second: the sum of rotation, translation and change of range.
    pub motion_px_s: f64,
    /// How far it may have moved since it was seen, in pixels.
    pub drift_px: f64,
}

/// Follows the pad through a camera's frames.
#[derive(Clone, Debug)]
pub struct PadTrack {
    camera: String,
    /// The detector whose detections count; any one's until it is known.
    detector: Option<String>,
    /// The marker of the landing; any one until it is known.
    marker: Option<String>,
    last: Option<Sighting>,
    motions: VecDeque<Motion>,
}

/// The last detection.
#[derive(Clone, Debug)]
struct Sighting {
    family: String,
    id: Option<u32>,
    stamp_ns: i64,
    centre_px: [f64; 2],
    size_px: f64,
    velocity_px_s: [f64; 2],
}

/// How fast the pad moved until this frame.
#[derive(Copy, Clone, Debug)]
struct Motion {
    stamp_ns: i64,
    px_s: f64,
}

impl PadTrack {
    /// A track of the pad that is detected in this camera's frames.
    pub fn new(camera: &str) -> Self {
        Self {
            camera: camera.to_owned(),
            detector: None,
            marker: None,
            last: None,
            motions: VecDeque::new(),
        }
    }

    /// Only the detector that a controller uses counts from now on, while there is one, and only the marker that it lands on.
    pub fn follow(&mut self, status: &ControllerStatus) {
        self.detector.clone_from(&status.active_detector);
        self.marker = status.landing_marker().map(str::to_owned);
    }

    /// Takes a detector's message. One of another camera, of a detector that is not in use, or about an older frame is
    /// ignored.
    pub fn update(&mut self, message: &Detections) {
        let is_ours = message.header.camera == self.camera
            && self.detector.as_ref().is_none_or(|detector| *detector == message.detector);
        let stamp_ns = message.header.stamp_ns;
        let is_newer = |last: &Sighting| stamp_ns.saturating_sub(last.stamp_ns) >= MIN_STEP_NS;
        if !is_ours || !self.last.as_ref().is_none_or(is_newer) {
            return;
        }
        let is_sound = |detection: &&Detection| {
            let [x, y] = detection.centre_px;
            let is_finite = [x, y, detection.size_px].iter().all(|n| n.is_finite());
            let is_wanted = self.marker.as_ref().is_none_or(|marker| detection.may_be_of(marker));
            is_finite && detection.size_px > 0.0 && is_wanted
        };
        let sound = || message.detections.iter().filter(is_sound);
        // The same marker while it is seen, of several of its name the nearest, else the best one.
        let same = self.last.as_ref().and_then(|last| {
            let of_its_name = sound().filter(|detection| last.is_of(detection, stamp_ns));
            let distance = |detection: &Detection| last.distance_px(stamp_ns, detection.centre_px);
            of_its_name.min_by(|a, b| distance(a).total_cmp(&distance(b)))
        });
        let Some(found) = same.or_else(|| sound().next()) else { return };
        let before = self.last.take().filter(|last| last.is_of(found, stamp_ns));
        let velocity_px_s = before.as_ref().map_or([0.0; 2], |before| {
            let step_s = before.age_ns(stamp_ns) as f64 * 1e-9;
            let [x, y] = [0, 1].map(|axis| found.centre_px[axis] - before.centre_px[axis]);
            let growth = 0.5 * (found.size_px - before.size_px).abs();
            let px_s = (x.hypot(y) + growth) / step_s;
            if self.motions.len() == MAX_MOTIONS {
                self.motions.pop_front();
            }
            self.motions.push_back(Motion { stamp_ns, px_s });
            [x / step_s, y / step_s]
        });
        self.last = Some(Sighting {
            family: found.family.clone(),
            id: found.id,
            stamp_ns,
            centre_px: found.centre_px,
            size_px: found.size_px,
            velocity_px_s,
        });
    }

    /// The pad in the frame with this stamp; `None` when it has not been seen for a while.
    pub fn at(&mut self, stamp_ns: i64) -> Option<Pad> {
        self.last.take_if(|last| last.age_ns(stamp_ns).saturating_abs() > MAX_AGE_NS);
        let last = self.last.as_ref()?;
        // A pad that is not seen continues to move.
        let is_recent =
            |motion: &Motion| last.stamp_ns.saturating_sub(motion.stamp_ns) <= MOTION_NS;
        self.motions.retain(is_recent);
        let age_s = last.age_ns(stamp_ns) as f64 * 1e-9;
        let centre_px = last.predicted_px(stamp_ns);
        let motion_px_s = self.motions.iter().map(|motion| motion.px_s).fold(0.0, f64::max);
        let drift_px = motion_px_s * age_s.abs();
        Some(Pad { centre_px, size_px: last.size_px, motion_px_s, drift_px })
    }
}

impl Sighting {
    fn age_ns(&self, stamp_ns: i64) -> i64 {
        stamp_ns.saturating_sub(self.stamp_ns)
    }

    fn predicted_px(&self, stamp_ns: i64) -> [f64; 2] {
        let age_s = self.age_ns(stamp_ns) as f64 * 1e-9;
        [0, 1].map(|axis| self.centre_px[axis] + age_s * self.velocity_px_s[axis])
    }

    fn distance_px(&self, stamp_ns: i64, [x, y]: [f64; 2]) -> f64 {
        let [predicted_x, predicted_y] = self.predicted_px(stamp_ns);
        (x - predicted_x).hypot(y - predicted_y)
    }

    /// True for the same marker, seen soon after.
    fn is_of(&self, detection: &Detection, stamp_ns: i64) -> bool {
        let is_same = self.family == detection.family && self.id == detection.id;
        is_same && self.age_ns(stamp_ns) <= MAX_AGE_NS
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use messages::{FrameHeader, PixelFormat};
    use proptest::prelude::*;

    const MS: i64 = 1_000_000;

    fn detection(family: &str, centre_px: [f64; 2], size_px: f64) -> Detection {
        Detection {
            family: family.to_owned(),
            id: None,
            centre_px,
            centre_covariance_px2: [0.0; 3],
            corners_px: None,
            size_px,
            wrong_bits: 0,
            confidence: 1.0,
            pose: None,
        }
    }

    fn message(stamp_ms: i64, detections: Vec<Detection>) -> Detections {
        Detections {
            detector: "main".into(),
            header: FrameHeader {
                camera: "down".into(),
                sequence: 0,
                stamp_ns: stamp_ms * MS,
                clock: String::new(),
                exposure_ns: 0,
                width: 640,
                height: 480,
                format: PixelFormat::Mono8,
                parts: Vec::new(),
            },
            detections,
            stages: Vec::new(),
        }
    }

    #[test]
    fn the_pad_is_predicted_along_its_motion_and_its_fastest_motion_counts() {
        let mut track = PadTrack::new("down");
        track.update(&message(0, vec![detection("rings", [100.0, 50.0], 40.0)]));
        assert_eq!(track.at(0).unwrap().motion_px_s, 0.0);
        track.update(&message(100, vec![detection("rings", [130.0, 90.0], 42.0)]));
        let pad = track.at(150 * MS).unwrap();
        assert_eq!((pad.centre_px, pad.size_px), ([145.0, 110.0], 42.0));
        // 50 px aside, and 1 px of growth at the rim, in a tenth of a second.
        assert!((pad.motion_px_s - 510.0).abs() < 1e-9);
        track.update(&message(200, vec![detection("rings", [130.0, 90.0], 42.0)]));
        assert!((track.at(250 * MS).unwrap().motion_px_s - 510.0).abs() < 1e-9);
        let pad = track.at(650 * MS).unwrap();
        assert!((pad.motion_px_s - 510.0).abs() < 1e-9 && (pad.drift_px - 229.5).abs() < 1e-9);
        track.update(&message(650, vec![detection("rings", [130.0, 90.0], 42.0)]));
        assert_eq!(track.at(650 * MS).unwrap().motion_px_s, 0.0);
    }

    #[test]
    fn a_pad_that_is_not_seen_any_more_is_forgotten() {
        let mut track = PadTrack::new("down");
        assert_eq!(track.at(0), None);
        track.update(&message(0, vec![detection("rings", [100.0, 50.0], 40.0)]));
        track.update(&message(500, Vec::new()));
        assert!(track.at(700 * MS).is_some());
        assert_eq!(track.at(701 * MS), None);
    }

    #[test]
    fn the_marker_that_is_followed_goes_before_a_better_one() {
        let mut track = PadTrack::new("down");
        track.update(&message(0, vec![detection("rings", [100.0, 50.0], 40.0)]));
        let two =
            [detection("stag", [300.0, 300.0], 80.0), detection("rings", [101.0, 50.0], 40.0)];
        track.update(&message(50, two.to_vec()));
        assert_eq!(track.at(50 * MS).unwrap().centre_px, [101.0, 50.0]);
        track.update(&message(100, two[..1].to_vec()));
        let pad = track.at(100 * MS).unwrap();
        assert_eq!(pad.centre_px, [300.0, 300.0]);
    }

    #[test]
    fn other_cameras_and_detectors_that_are_not_in_use_do_not_count() {
        let mut track = PadTrack::new("forward");
        let seen = message(0, vec![detection("rings", [100.0, 50.0], 40.0)]);
        track.update(&seen);
        assert_eq!(track.at(0), None);
        let mut track = PadTrack::new("down");
        let status = |detector: &str, marker: &str| ControllerStatus {
            active_detector: Some(detector.into()),
            marker: marker.into(),
            ..ControllerStatus::default()
        };
        track.follow(&status("ground", ""));
        track.update(&seen);
        assert_eq!(track.at(0), None);
        track.follow(&status("main", "stag"));
        track.update(&seen);
        assert_eq!(track.at(0), None);
        for marker in ["", "rings", "pad:1"] {
            let mut track = track.clone();
            track.follow(&status("main", marker));
            track.update(&seen);
            assert!(track.at(0).is_some(), "{marker}");
        }
    }

    #[test]
    fn of_two_markers_of_one_name_the_one_that_was_seen_is_followed() {
        let mut track = PadTrack::new("down");
        track.update(&message(0, vec![detection("rings", [100.0, 50.0], 40.0)]));
        let two =
            [detection("rings", [500.0, 300.0], 80.0), detection("rings", [101.0, 50.0], 40.0)];
        track.update(&message(50, two.to_vec()));
        let pad = track.at(50 * MS).unwrap();
        assert!(pad.centre_px == [101.0, 50.0] && pad.motion_px_s < 30.0, "{pad:?}");
    }

    proptest! {
        #[test]
        fn no_message_makes_it_panic(
            sights in prop::collection::vec((any::<i64>(), any::<[f64; 2]>(), any::<f64>()), 1..20),
            at: i64,
        ) {
            let mut track = PadTrack::new("down");
            for (stamp_ns, centre_px, size_px) in sights {
                let mut message = message(0, vec![detection("rings", centre_px, size_px)]);
                message.header.stamp_ns = stamp_ns;
                track.update(&message);
                let _ = track.at(at);
            }
        }
    }
}
