//! Where the markers should be in the next frame, from where detections saw them.
//!
//! A marker's centre is taken to move on as it moved between its last two sightings, and its size to stay. What is
//! not known of its motion widens the region. A frame that was searched without finding it is believed only the
//! second time: one may have been cut off by its region.

use messages::Detections;

/// Markers that are followed; further ones are found by the overview.
const MOST_MARKERS: usize = 8;
/// A marker that was not seen for so long is expected nowhere, in seconds.
const FORGOTTEN_S: f64 = 0.7;
/// Frames without a marker, one after the other, until it counts as lost.
const MISSES: u32 = 2;
/// The marker's surroundings that belong to the region, on each side, in units of its size and in pixels.
const SURROUNDINGS: f64 = 0.4;
const LEAST_REACH_PX: f64 = 24.0;
/// How far off the prediction may be, in units of the way since it was last seen, and in pixels per second.
const UNSTEADY: f64 = 0.5;
const UNSTEADY_PX_S: f64 = 150.0;

/// The markers that were seen.
#[derive(Clone, Debug, Default)]
pub struct Expected {
    sightings: Vec<Sighting>,
}

#[derive(Clone, Debug)]
struct Sighting {
    family: String,
    id: Option<u32>,
    stamp_ns: i64,
    centre_px: [f64; 2],
    size_px: f64,
    velocity_px_s: [f64; 2],
    misses: u32,
}

/// A part of a frame that should hold all markers.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Region {
    /// Left and upper edge, in pixels.
    pub from: [f64; 2],
    /// Right and lower edge, in pixels.
    pub to: [f64; 2],
    /// The smallest of the markers, in pixels.
    pub marker_px: f64,
}

impl Expected {
    /// Learns from what a detector saw in a frame of this camera, whichever detector it was.
    pub fn learn(&mut self, message: &Detections) {
        let stamp_ns = message.header.stamp_ns;
        for seen in &message.detections {
            let is_sound = seen.size_px > 0.0
                && [seen.centre_px[0], seen.centre_px[1], seen.size_px]
                    .iter()
                    .all(|n| n.is_finite());
            if !is_sound {
                continue;
            }
            let has_room = self.sightings.len() < MOST_MARKERS;
            let known =
                self.sightings.iter_mut().find(|it| it.family == seen.family && it.id == seen.id);
            match known {
                Some(known) => known.see(stamp_ns, seen.centre_px, seen.size_px),
                None if has_room => self.sightings.push(Sighting {
                    family: seen.family.clone(),
                    id: seen.id,
                    stamp_ns,
                    centre_px: seen.centre_px,
                    size_px: seen.size_px,
                    velocity_px_s: [0.0; 2],
                    misses: 0,
                }),
                None => {}
            }
        }
        for known in &mut self.sightings {
            let is_seen =
                message.detections.iter().any(|it| it.family == known.family && it.id == known.id);
            if !is_seen && stamp_ns > known.stamp_ns {
                known.misses += 1;
            }
        }
        self.sightings.retain(|known| known.misses < MISSES);
    }

    /// Where all markers should be in the frame of a moment; `None` when none is expected.
    pub fn region(&mut self, stamp_ns: i64) -> Option<Region> {
        self.sightings.retain(|known| known.age_s(stamp_ns).abs() < FORGOTTEN_S);
        let mut sightings = self.sightings.iter();
        let first = sightings.next()?.region(stamp_ns);
        Some(sightings.fold(first, |all, known| all.with(&known.region(stamp_ns))))
    }
}

impl Sighting {
    fn age_s(&self, stamp_ns: i64) -> f64 {
        stamp_ns.saturating_sub(self.stamp_ns) as f64 * 1e-9
    }

    fn see(&mut self, stamp_ns: i64, centre_px: [f64; 2], size_px: f64) {
        let period_s = self.age_s(stamp_ns);
        // Another detector may tell of the same frame, or of an older one.
        if period_s > 1e-3 {
            if period_s < FORGOTTEN_S {
                let [x, y] = self.centre_px;
                self.velocity_px_s = [(centre_px[0] - x) / period_s, (centre_px[1] - y) / period_s];
            }
            (self.stamp_ns, self.centre_px, self.size_px) = (stamp_ns, centre_px, size_px);
            self.misses = 0;
        }
    }

    fn region(&self, stamp_ns: i64) -> Region {
        let age_s = self.age_s(stamp_ns).max(0.0);
        let way = self.velocity_px_s.map(|v| v * age_s);
        let reach = self.size_px * (0.5 + SURROUNDINGS) + LEAST_REACH_PX + UNSTEADY_PX_S * age_s;
        let half = way.map(|way| reach + UNSTEADY * way.abs());
        let centre = [self.centre_px[0] + way[0], self.centre_px[1] + way[1]];
        Region {
            from: [centre[0] - half[0], centre[1] - half[1]],
            to: [centre[0] + half[0], centre[1] + half[1]],
            marker_px: self.size_px,
        }
    }
}

impl Region {
    fn with(&self, other: &Self) -> Self {
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
    use messages::{Detection, FrameHeader, PixelFormat};

    const MS: i64 = 1_000_000;

    fn seen(stamp_ms: i64, markers: &[(u32, [f64; 2], f64)]) -> Detections {
        let detections = markers.iter().map(|(id, centre_px, size_px)| Detection {
            family: "aruco-4x4-50".into(),
            id: Some(*id),
            centre_px: *centre_px,
            centre_covariance_px2: [1.0, 0.0, 1.0],
            corners_px: None,
            size_px: *size_px,
            wrong_bits: 0,
            confidence: 1.0,
            pose: None,
        });
        Detections {
            detector: "main".into(),
            header: FrameHeader {
                camera: "down".into(),
                sequence: 0,
                stamp_ns: stamp_ms * MS,
                clock: "c".into(),
                exposure_ns: 0,
                width: 1296,
                height: 972,
                format: PixelFormat::Jpeg,
                parts: Vec::new(),
            },
            detections: detections.collect(),
            stages: Vec::new(),
        }
    }

    fn holds(region: Region, [x, y]: [f64; 2]) -> bool {
        (region.from[0]..=region.to[0]).contains(&x) && (region.from[1]..=region.to[1]).contains(&y)
    }

    #[test]
    fn a_marker_is_expected_where_its_motion_takes_it() {
        let mut expected = Expected::default();
        assert!(expected.region(0).is_none());
        expected.learn(&seen(0, &[(1, [100.0, 500.0], 40.0)]));
        expected.learn(&seen(66, &[(1, [120.0, 500.0], 40.0)]));
        let region = expected.region(198 * MS).unwrap();
        assert!(holds(region, [160.0 - 36.0, 500.0 - 36.0]));
        assert!(holds(region, [160.0 + 36.0, 500.0 + 36.0]));
        assert!(region.to[0] - region.from[0] < 250.0, "{region:?}");
    }

    #[test]
    fn it_is_lost_after_two_frames_without_it_or_a_long_silence() {
        let mut expected = Expected::default();
        expected.learn(&seen(0, &[(1, [100.0, 500.0], 40.0)]));
        expected.learn(&seen(66, &[]));
        assert!(expected.region(100 * MS).is_some());
        expected.learn(&seen(132, &[]));
        assert!(expected.region(140 * MS).is_none());
        expected.learn(&seen(200, &[(1, [100.0, 500.0], 40.0)]));
        assert!(expected.region(300 * MS).is_some());
        assert!(expected.region(950 * MS).is_none());
    }

    #[test]
    fn all_markers_are_in_the_region_and_nonsense_is_not() {
        let mut expected = Expected::default();
        let markers = [(1, [100.0, 500.0], 40.0), (2, [900.0, 100.0], 80.0)];
        expected.learn(&seen(0, &markers));
        expected.learn(&seen(0, &[(3, [f64::NAN, 0.0], 40.0), (4, [0.0, 0.0], -1.0)]));
        let region = expected.region(0).unwrap();
        assert!(markers.iter().all(|(_, centre, _)| holds(region, *centre)));
        assert!(region.marker_px == 40.0 && region.from.iter().all(|edge| edge.is_finite()));
    }
}
