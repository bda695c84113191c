//! Predicts the region of interest (ROI) of the next frame from the sound detections of every marker in the last ones.
//!
//! Each marker's centre moves at constant velocity, from its last two detections; its size stays. Uncertainty
//! of the motion widens the ROI. A track ends after two frames in which the detector that saw its marker last does not
//! see it: one may have been cut off by its ROI. Other detectors may look for other markers, or see less.
//!
//! While a controller looks for its marker, other markers do not cause a region to be sent instead of the whole frame.

use messages::{ControllerStatus, Detection, Detections};

/// Maximum number of tracks; further markers are found in the overview.
const MAX_TRACKS: usize = 8;
/// Maximum age of a track without a detection, in seconds.
const MAX_AGE_S: f64 = 0.7;
/// Consecutive frames without a detection after which a track ends.
const MAX_MISSES: u32 = 2;
/// Margin around a marker on each side, in units of its size.
const MARGIN: f64 = 0.4;
/// Margin in addition to that, in pixels.
const MARGIN_PX: f64 = 24.0;
/// Uncertainty of the prediction, in units of the predicted displacement.
const DISPLACEMENT_UNCERTAINTY: f64 = 0.5;
/// Uncertainty of the prediction, in pixels per second.
const UNCERTAINTY_PX_S: f64 = 150.0;
/// A marker that is this many of its sizes from where it was predicted is another one of its name, whose motion is not known.
const MAX_JUMP: f64 = 2.0;

/// Tracks the detected markers.
#[derive(Clone, Debug, Default)]
pub struct RoiPredictor {
    tracks: Vec<Track>,
    /// The marker of the landing; any one until it is known.
    marker: Option<String>,
}

#[derive(Clone, Debug)]
struct Track {
    /// The detector that saw it last.
    detector: String,
    family: String,
    id: Option<u32>,
    /// Whether it may be of the landing's marker.
    may_be_wanted: bool,
    stamp_ns: i64,
    centre_px: [f64; 2],
    size_px: f64,
    velocity_px_s: [f64; 2],
    misses: u32,
}

/// The part of a frame that should contain all markers.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Roi {
    /// Left and upper edge, in pixels.
    pub from: [f64; 2],
    /// Right and lower edge, in pixels.
    pub to: [f64; 2],
    /// The smallest of the markers, in pixels.
    pub marker_px: f64,
}

impl RoiPredictor {
    /// Takes a controller's status: the marker that it lands on must be among those of an ROI.
    pub fn follow(&mut self, status: &ControllerStatus) {
        let marker = status.landing_marker().map(str::to_owned);
        if self.marker != marker {
            self.marker = marker;
            self.tracks.clear();
        }
    }

    /// Updates the tracks with a detector's message about a frame of this camera; any detector's will do.
    pub fn update(&mut self, message: &Detections) {
        let stamp_ns = message.header.stamp_ns;
        let is_sound = |detection: &&Detection| {
            let [x, y] = detection.centre_px;
            [x, y, detection.size_px].iter().all(|n| n.is_finite()) && detection.size_px > 0.0
        };
        let sound = || message.detections.iter().filter(is_sound);
        for track in &mut self.tracks {
            // Of several of its name the nearest.
            let of_its_name = sound().filter(|detection| track.is_of(detection));
            let distance = |detection: &Detection| track.distance_px(stamp_ns, detection.centre_px);
            if let Some(nearest) = of_its_name.min_by(|a, b| distance(a).total_cmp(&distance(b))) {
                track.update(message, nearest);
            }
        }
        for detection in sound() {
            let may_be_wanted = self.marker.as_ref().is_none_or(|it| detection.may_be_of(it));
            let is_known = self.tracks.iter().any(|track| track.is_of(detection));
            if !is_known && may_be_wanted && self.tracks.len() == MAX_TRACKS {
                // The landing's marker takes the place of another.
                let other = self.tracks.iter().position(|track| !track.may_be_wanted);
                other.map(|at| self.tracks.swap_remove(at));
            }
            if !is_known && self.tracks.len() < MAX_TRACKS {
                self.tracks.push(Track {
                    detector: message.detector.clone(),
                    family: detection.family.clone(),
                    id: detection.id,
                    may_be_wanted,
                    stamp_ns,
                    centre_px: detection.centre_px,
                    size_px: detection.size_px,
                    velocity_px_s: [0.0; 2],
                    misses: 0,
                });
            }
        }
        for track in &mut self.tracks {
            let is_detected = message.detections.iter().any(|detection| track.is_of(detection));
            let is_its_own = track.detector == message.detector;
            if is_its_own && !is_detected && stamp_ns > track.stamp_ns {
                track.misses += 1;
            }
        }
        self.tracks.retain(|track| track.misses < MAX_MISSES);
    }

    /// The ROI of a frame with this stamp; `None` without a track of the landing's marker.
    pub fn roi(&mut self, stamp_ns: i64) -> Option<Roi> {
        self.tracks.retain(|track| track.age_s(stamp_ns).abs() < MAX_AGE_S);
        if !self.tracks.iter().any(|track| track.may_be_wanted) {
            return None;
        }
        let mut tracks = self.tracks.iter();
        let first = tracks.next()?.roi(stamp_ns);
        Some(tracks.fold(first, |all, track| all.union(&track.roi(stamp_ns))))
    }
}

impl Track {
    fn is_of(&self, detection: &Detection) -> bool {
        self.family == detection.family && self.id == detection.id
    }

    fn age_s(&self, stamp_ns: i64) -> f64 {
        stamp_ns.saturating_sub(self.stamp_ns) as f64 * 1e-9
    }

    fn update(&mut self, message: &Detections, detection: &Detection) {
        let stamp_ns = message.header.stamp_ns;
        let period_s = self.age_s(stamp_ns);
        // Another detector may report the same frame, or an older one.
        if period_s > 1e-3 {
            let ([x, y], [new_x, new_y]) = (self.centre_px, detection.centre_px);
            let jump_px = self.distance_px(stamp_ns, detection.centre_px);
            let margin_px = MARGIN_PX + UNCERTAINTY_PX_S * period_s;
            self.velocity_px_s = if period_s > MAX_AGE_S
                || jump_px > MAX_JUMP * self.size_px.max(detection.size_px) + margin_px
            {
                [0.0; 2]
            } else {
                [(new_x - x) / period_s, (new_y - y) / period_s]
            };
            self.detector.clone_from(&message.detector);
            self.stamp_ns = stamp_ns;
            self.centre_px = detection.centre_px;
            self.size_px = detection.size_px;
            self.misses = 0;
        }
    }

    /// How far a place is from where the marker is predicted, in pixels.
    fn distance_px(&self, stamp_ns: i64, [x, y]: [f64; 2]) -> f64 {
        let age_s = self.age_s(stamp_ns);
        let [dx, dy] = [0, 1].map(|i| self.centre_px[i] + self.velocity_px_s[i] * age_s);
        (x - dx).hypot(y - dy)
    }

    fn roi(&self, stamp_ns: i64) -> Roi {
        let age_s = self.age_s(stamp_ns).max(0.0);
        let displacement = self.velocity_px_s.map(|v| v * age_s);
        let margin = self.size_px * (0.5 + MARGIN) + MARGIN_PX + UNCERTAINTY_PX_S * age_s;
        let half = displacement.map(|d| margin + DISPLACEMENT_UNCERTAINTY * d.abs());
        let centre = [self.centre_px[0] + displacement[0], self.centre_px[1] + displacement[1]];
        Roi {
            from: [centre[0] - half[0], centre[1] - half[1]],
            to: [centre[0] + half[0], centre[1] + half[1]],
            marker_px: self.size_px,
        }
    }
}

impl Roi {
    fn union(&self, other: &Self) -> Self {
        Self {
            from: [self.from[0].min(other.from[0]), self.from[1].min(other.from[1])],
            to: [self.to[0].max(other.to[0]), self.to[1].max(other.to[1])],
            marker_px: self.marker_px.min(other.marker_px),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use messages::FrameHeader;

    const MS: i64 = 1_000_000;

    fn detections(stamp_ms: i64, markers: &[(u32, [f64; 2], f64)]) -> Detections {
        let detections = markers.iter().map(|(id, centre_px, size_px)| Detection {
            id: Some(*id),
            centre_px: *centre_px,
            size_px: *size_px,
            ..Detection::sample()
        });
        Detections {
            header: FrameHeader { stamp_ns: stamp_ms * MS, ..FrameHeader::sample() },
            detections: detections.collect(),
            ..Detections::sample()
        }
    }

    fn contains(roi: Roi, [x, y]: [f64; 2]) -> bool {
        (roi.from[0]..=roi.to[0]).contains(&x) && (roi.from[1]..=roi.to[1]).contains(&y)
    }

    #[test]
    fn the_roi_follows_a_markers_motion() {
        let mut predictor = RoiPredictor::default();
        assert!(predictor.roi(0).is_none());
        predictor.update(&detections(0, &[(1, [100.0, 500.0], 40.0)]));
        predictor.update(&detections(66, &[(1, [120.0, 500.0], 40.0)]));
        let roi = predictor.roi(198 * MS).unwrap();
        assert!(contains(roi, [160.0 - 36.0, 500.0 - 36.0]));
        assert!(contains(roi, [160.0 + 36.0, 500.0 + 36.0]));
        assert!(roi.to[0] - roi.from[0] < 250.0, "{roi:?}");
    }

    #[test]
    fn a_track_ends_after_two_misses_or_a_long_time() {
        let mut predictor = RoiPredictor::default();
        predictor.update(&detections(0, &[(1, [100.0, 500.0], 40.0)]));
        predictor.update(&detections(66, &[]));
        assert!(predictor.roi(100 * MS).is_some());
        predictor.update(&detections(132, &[]));
        assert!(predictor.roi(140 * MS).is_none());
        predictor.update(&detections(200, &[(1, [100.0, 500.0], 40.0)]));
        assert!(predictor.roi(300 * MS).is_some());
        assert!(predictor.roi(950 * MS).is_none());
    }

    #[test]
    fn a_detector_that_sees_nothing_ends_no_track_of_another() {
        let of = |detector: &str, message: Detections| Detections {
            detector: detector.into(),
            ..message
        };
        let mut predictor = RoiPredictor::default();
        let marker = [(1, [100.0, 500.0], 40.0)];
        for frame in 0..20 {
            let stamp_ms = frame * 66;
            // One sees the marker in every third frame, the other one never.
            let seen = if frame % 3 == 0 { &marker[..] } else { &[] };
            if frame % 3 < 2 {
                predictor.update(&of("rings", detections(stamp_ms, seen)));
            }
            predictor.update(&of("tags", detections(stamp_ms, &[])));
            assert!(predictor.roi(stamp_ms * MS).is_some(), "frame {frame}");
        }
        // The detector that saw it last decides that it is missed.
        predictor.update(&of("tags", detections(1320, &marker)));
        for stamp_ms in [1386, 1452] {
            predictor.update(&of("rings", detections(stamp_ms, &[])));
            assert!(predictor.roi(stamp_ms * MS).is_some());
        }
        for stamp_ms in [1386, 1452] {
            predictor.update(&of("tags", detections(stamp_ms, &[])));
        }
        assert!(predictor.roi(1452 * MS).is_none());
    }

    #[test]
    fn a_marker_that_is_not_the_landings_makes_no_roi() {
        let status =
            |marker: &str| ControllerStatus { marker: marker.into(), ..Default::default() };
        let of = |markers: &[(u32, [f64; 2], f64)]| detections(0, markers);
        let (tag, both) = ((1, [100.0, 500.0], 40.0), (2, [900.0, 100.0], 80.0));
        // The sample's family is `rings`.
        for (marker, sees_tag, sees_both) in [
            ("", true, true),
            ("rings:2", false, true),
            ("rings", true, true),
            ("pad:2", true, true),
        ] {
            let mut predictor = RoiPredictor::default();
            predictor.follow(&status(marker));
            predictor.update(&of(&[tag]));
            assert_eq!(predictor.roi(0).is_some(), sees_tag, "{marker}");
            predictor.follow(&status(marker));
            predictor.update(&of(&[tag, both]));
            assert_eq!(predictor.roi(0).is_some(), sees_both, "{marker}");
        }
    }

    #[test]
    fn the_landings_marker_has_a_track_next_to_any_number_of_others() {
        let mut predictor = RoiPredictor::default();
        predictor.follow(&ControllerStatus { marker: "rings:20".into(), ..Default::default() });
        let of = |ids: std::ops::RangeInclusive<u32>| {
            let at = |id: u32| (id, [50.0 * f64::from(id), 500.0], 40.0);
            detections(0, &ids.map(at).collect::<Vec<_>>())
        };
        predictor.update(&of(1..=12));
        assert!(predictor.roi(0).is_none());
        predictor.update(&of(1..=20));
        assert!(contains(predictor.roi(0).unwrap(), [1000.0, 500.0]));
    }

    #[test]
    fn of_two_markers_of_one_name_the_nearest_is_followed() {
        let mut predictor = RoiPredictor::default();
        let near = |stamp_ms: i64| (1, [100.0 + 0.1 * stamp_ms as f64, 500.0], 40.0);
        let far = (1, [900.0, 100.0], 40.0);
        predictor.update(&detections(0, &[near(0)]));
        for stamp_ms in (66..660).step_by(66) {
            predictor.update(&detections(stamp_ms, &[far, near(stamp_ms)]));
        }
        let roi = predictor.roi(660 * MS).unwrap();
        assert!(contains(roi, near(660).1) && roi.to[0] < 300.0, "{roi:?}");
        // Only the other one is left.
        predictor.update(&detections(660, &[far]));
        let roi = predictor.roi(726 * MS).unwrap();
        assert!(contains(roi, far.1) && roi.from[0] > 600.0 && roi.to[0] < 1200.0, "{roi:?}");
    }

    #[test]
    fn the_roi_contains_all_markers_and_ignores_invalid_detections() {
        let mut predictor = RoiPredictor::default();
        let markers = [(1, [100.0, 500.0], 40.0), (2, [900.0, 100.0], 80.0)];
        predictor.update(&detections(0, &markers));
        predictor.update(&detections(0, &[(3, [f64::NAN, 0.0], 40.0), (4, [0.0, 0.0], -1.0)]));
        let roi = predictor.roi(0).unwrap();
        assert!(markers.iter().all(|(_, centre, _)| contains(roi, *centre)));
        assert!(roi.marker_px == 40.0 && roi.from.iter().all(|edge| edge.is_finite()));
    }
}
