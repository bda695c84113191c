//! Tracks markers from image to image, to search only the regions where they should be.
//!
//! The prediction is a constant velocity of the marker's centre and of its size; its region grows with the uncertainty of
//! the motion. Regions are searched by the same detector with the same checks, so no marker is reported that is not seen
//! in this image. The whole image is searched periodically, for new markers, and when a marker is not found in its region.
//! A marker that is visible right at its predicted place is read there, and the rest of its region is not searched. While
//! nothing is tracked, the fallback passes take turns ([`Detector::detect_in_turn`]).

use geometry::{CameraModel, Pixel, Roi};
use imaging::GrayView;
use markers::Family;
use nalgebra::Vector3;

use crate::detector::Detector;
use crate::families::family::{PredictedShape, Prediction};
use crate::families::rings::circle_pose::CirclePose;
use crate::observation::{Observation, StageObserver};
use crate::response::ResponseMemory;
use crate::schedule::{FallbackPass, PassSchedule};
use crate::trace::Trace;

/// Settings of tracking.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct TrackingSettings {
    /// The whole image is searched in every so many images; with 1 in each one, which is no tracking.
    pub full_search_period: u32,
}

impl Default for TrackingSettings {
    fn default() -> Self {
        Self { full_search_period: 15 }
    }
}

/// Tracks markers from image to image.
#[derive(Debug, Default)]
pub struct Tracker {
    settings: TrackingSettings,
    tracks: Vec<Track>,
    /// Regions that the caller wants searched in the next image.
    requested: Vec<Region>,
    regions: Vec<Region>,
    found: Vec<Observation>,
    trace: Trace,
    /// Images since the last search of a whole image.
    since_full: u32,
    /// Width and height of the image, in pixels, and its time in seconds.
    size: [usize; 2],
    time_s: f64,
    /// Whether an image was searched.
    has_begun: bool,
    /// Whether regions were requested for this image.
    has_requests: bool,
    response: ResponseMemory,
}

/// A tracked marker: its last observation and its motion.
#[derive(Copy, Clone, Debug)]
struct Track {
    family: Family,
    id: Option<u32>,
    centre: Pixel,
    size_px: f64,
    time_s: f64,
    /// `None` after a first observation.
    motion: Option<Motion>,
    /// Error of the last prediction, in pixels, and the time it was over.
    error_px: f64,
    period_s: f64,
    shape: Shape,
    /// Change of the shape per second; `None` after a first observation.
    change: Option<Shape>,
}

/// Corners of a square marker, or centre (m) and normal of rings; the fields it lacks are zero.
#[derive(Copy, Clone, Debug, Default, PartialEq)]
struct Shape {
    has_corners: bool,
    has_circles: bool,
    corners: [[f64; 2]; 4],
    centre: [f64; 3],
    normal: [f64; 3],
}

/// Motion of the centre in the image, and relative growth of the size.
#[derive(Copy, Clone, Debug)]
struct Motion {
    velocity_px_s: [f64; 2],
    growth_per_s: f64,
}

/// A rectangle of pixels; `to` is exclusive.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
struct Region {
    from: [usize; 2],
    to: [usize; 2],
}

/// Largest number of tracked markers; others are found by searches of the whole image.
const MAX_TRACKS: usize = 16;
/// Largest age of an observation that is predicted from, in seconds.
const MAX_PREDICTION_S: f64 = 1.0;
/// Margin of a region around the marker, in units of its size on each side.
const MARGIN: f64 = 0.25;
/// Lower bound of a prediction's uncertainty: the sum of a part in pixels and a part in units of the marker's size.
const MIN_UNCERTAINTY_PX: f64 = 4.0;
const MIN_UNCERTAINTY_RATIO: f64 = 0.1;
/// Regions begin and end at multiples of this, in pixels. Values that are computed by tiles, such as thresholds, then have the
/// same tiles as in the whole image.
const TILE: usize = 16;
/// Largest fraction of the image that regions may cover; above it the whole image is searched.
const MAX_COVERED: f64 = 0.4;

impl Tracker {
    /// A tracker without tracks.
    pub fn new(settings: TrackingSettings) -> Self {
        Self { settings, ..Self::default() }
    }

    /// Changes the settings and keeps the tracks.
    pub fn set(&mut self, settings: TrackingSettings) {
        self.settings = settings;
    }

    /// Has the next image also searched around `centre`, for a marker of about `size_px`, with an uncertainty of
    /// `spread_px`.
    pub fn add_roi(&mut self, centre: Pixel, size_px: f64, spread_px: f64) {
        let half = size_px * (0.5 + MARGIN) + spread_px + MIN_UNCERTAINTY_PX;
        if self.requested.len() < MAX_TRACKS
            && let Some(region) = Region::around(centre, half, self.size)
        {
            self.requested.push(region);
        }
    }

    /// Finds the markers in an image taken at `time_s` (seconds of any clock), as [`Detector::detect`] does, the most
    /// confident first.
    pub fn detect(
        &mut self,
        detector: &mut Detector,
        view: GrayView<'_>,
        camera: Option<&CameraModel>,
        time_s: f64,
        stages: &mut impl StageObserver,
    ) -> &[Observation] {
        self.found.clear();
        self.trace.clear();
        self.begin([view.width(), view.height()], time_s);
        detector.assume_response(self.response.known());
        detector.follow(self.tracks.iter().filter_map(|track| track.circles(time_s)));
        if self.choose_regions(time_s) {
            for index in 0..self.regions.len() {
                if let Some(region) = self.regions.get(index).copied() {
                    self.search(detector, view, camera, region, stages);
                }
            }
            self.found.sort_unstable_by(|a, b| b.confidence.total_cmp(&a.confidence));
            self.since_full += 1;
        }
        if self.regions.is_empty() || self.is_one_missing(time_s) {
            // All passes search the first image, and one that should show a marker.
            let is_urgent =
                !self.tracks.is_empty() || !std::mem::replace(&mut self.has_begun, true);
            let seen = match is_urgent {
                true => detector.detect(view, camera, stages),
                false => detector.detect_in_turn(view, camera, stages),
            };
            self.found.clear();
            self.found.extend_from_slice(seen);
            self.trace.clear();
            let whole = Roi::cropped(0.0, 0.0, view.width() as u32, view.height() as u32);
            self.trace.add_roi(detector.trace(), &whole);
            self.since_full = 0;
        }
        detector.follow_none();
        self.update_tracks(time_s);
        for estimate in self.found.iter().filter_map(|seen| seen.response.as_ref()) {
            self.response.add(estimate);
        }
        &self.found
    }

    /// The camera's response to light, as estimated from the markers in its images.
    pub fn response(&self) -> &ResponseMemory {
        &self.response
    }

    /// The trace of the last detection, in pixels of the whole image.
    pub fn trace(&self) -> &Trace {
        &self.trace
    }

    /// Drops tracks that can no longer be predicted.
    fn begin(&mut self, size: [usize; 2], time_s: f64) {
        self.time_s = time_s;
        if size != self.size {
            self.size = size;
            self.tracks.clear();
            self.requested.clear();
        }
        // Also a time that is not a number, or runs backwards.
        self.tracks.retain(|track| {
            let elapsed_s = time_s - track.time_s;
            elapsed_s > 0.0 && elapsed_s <= MAX_PREDICTION_S
        });
    }

    /// Lists the regions to search; false when that is the whole image.
    fn choose_regions(&mut self, time_s: f64) -> bool {
        self.regions.clear();
        let is_due = self.since_full + 1 >= self.settings.full_search_period;
        // Requested regions alone do not limit the search.
        if self.tracks.is_empty() || is_due {
            self.requested.clear();
            return false;
        }
        let of_tracks = self.tracks.iter().filter_map(|track| track.region(time_s, self.size));
        self.regions.extend(of_tracks);
        self.has_requests = !self.requested.is_empty();
        self.regions.append(&mut self.requested);
        merge(&mut self.regions);
        let area: usize = self.regions.iter().map(Region::area).sum();
        let whole = (self.size[0] * self.size[1]) as f64;
        if area as f64 > MAX_COVERED * whole {
            self.regions.clear();
        }
        !self.regions.is_empty()
    }

    fn search(
        &mut self,
        detector: &mut Detector,
        view: GrayView<'_>,
        camera: Option<&CameraModel>,
        region: Region,
        stages: &mut impl StageObserver,
    ) {
        let [left, top] = region.from;
        let [width, height] = region.edges();
        let Some(part) = view.crop(left, top, width, height) else { return };
        let roi = Roi::cropped(left as f64, top as f64, width as u32, height as u32);
        let camera = camera.map(|camera| roi.camera(camera));
        let expected = self.only_track(&region, self.time_s).and_then(|track| {
            let at = track.prediction(self.time_s, roi.origin)?;
            detector.detect_at(part, camera.as_ref(), &at, stages)
        });
        match expected {
            Some(seen) => self.found.push(seen.mapped(&roi)),
            None => {
                // A side of the marker itself may cross the region as a shadow's edge does the image.
                let schedule = PassSchedule::ALL.without(FallbackPass::ShadowEdge);
                let found = detector.detect_with(part, camera.as_ref(), schedule, stages);
                self.found.extend(found.iter().map(|seen| seen.mapped(&roi)));
            }
        }
        self.trace.add_roi(detector.trace(), &roi);
    }

    /// The track of a region in which there is no other and none was requested.
    fn only_track(&self, region: &Region, time_s: f64) -> Option<&Track> {
        let is_within = |track: &&Track| region.contains(track.predicted(time_s).0);
        let mut within = self.tracks.iter().filter(is_within);
        let track = within.next()?;
        (!self.has_requests && within.next().is_none()).then_some(track)
    }

    /// True when a tracked marker that should be in the image was not found.
    fn is_one_missing(&self, time_s: f64) -> bool {
        self.tracks.iter().any(|track| {
            track.region(time_s, self.size).is_some()
                && !self.found.iter().any(|seen| track.matches(seen, time_s))
        })
    }

    /// Associates the observations with the tracks.
    fn update_tracks(&mut self, time_s: f64) {
        let before = self.tracks.len();
        for seen in &self.found {
            let old = self.tracks.get(..before).unwrap_or_default();
            let of_seen = |track: &&Track| track.time_s < time_s && track.matches(seen, time_s);
            let error = |track: &Track| track.predicted(time_s).0.distance(&seen.centre);
            let track = old.iter().filter(of_seen).min_by(|a, b| error(a).total_cmp(&error(b)));
            let next = match track {
                Some(track) => track.next(seen, time_s),
                None => Track::first(seen, time_s),
            };
            if self.tracks.len() < before + MAX_TRACKS && next.is_sound() {
                self.tracks.push(next);
            }
        }
        self.tracks.drain(..before);
    }
}

impl Track {
    fn first(seen: &Observation, time_s: f64) -> Self {
        let Observation { family, id, centre, size_px, .. } = *seen;
        let shape = Shape::from_observation(seen);
        let (motion, change) = (None, None);
        let (error_px, period_s) = (0.0, 0.0);
        Self { family, id, centre, size_px, time_s, motion, error_px, period_s, shape, change }
    }

    fn next(&self, seen: &Observation, time_s: f64) -> Self {
        let period_s = time_s - self.time_s;
        let (expected, _) = self.predicted(time_s);
        let motion = Motion {
            velocity_px_s: [
                (seen.centre.x - self.centre.x) / period_s,
                (seen.centre.y - self.centre.y) / period_s,
            ],
            growth_per_s: (seen.size_px / self.size_px).ln() / period_s,
        };
        // Without a motion the prediction's error does not measure how steady the motion is.
        let error_px = match self.motion {
            Some(_) => expected.distance(&seen.centre).max(0.7 * self.error_px),
            None => 0.5 * expected.distance(&seen.centre),
        };
        let next = Self::first(seen, time_s);
        let change = Some(next.shape.plus(&self.shape, -1.0).times(1.0 / period_s));
        Self { motion: Some(motion), error_px, period_s, change, ..next }
    }

    /// Its prediction in a region whose first pixel is `origin`; `None` after a first observation.
    fn prediction(&self, time_s: f64, origin: Pixel) -> Option<Prediction> {
        self.change?;
        self.expected(time_s, origin)
    }

    fn expected(&self, time_s: f64, origin: Pixel) -> Option<Prediction> {
        let change = self.change.unwrap_or_default();
        let shape = self.shape.plus(&change, time_s - self.time_s);
        let corner = |[x, y]: [f64; 2]| Pixel::new(x - origin.x, y - origin.y);
        let shape = if self.shape.has_corners {
            PredictedShape::Corners(shape.corners.map(corner))
        } else if self.shape.has_circles {
            let [centre, normal] = [shape.centre, shape.normal].map(Vector3::from);
            PredictedShape::Circles(CirclePose { centre, normal: normal.try_normalize(0.1)? })
        } else {
            return None;
        };
        Some(Prediction { family: self.family, id: self.id, shape })
    }

    /// Its prediction if it is a marker of rings, whose shape does not depend on the region; after a first observation
    /// that it stays.
    fn circles(&self, time_s: f64) -> Option<Prediction> {
        let has_circles = self.shape.has_circles;
        has_circles.then(|| self.expected(time_s, Pixel::new(0.0, 0.0)))?
    }

    fn is_sound(&self) -> bool {
        let Pixel { x, y } = self.centre;
        self.size_px > 0.0 && [x, y, self.size_px].iter().all(|n| n.is_finite())
    }

    /// Its predicted centre and size, in pixels.
    fn predicted(&self, time_s: f64) -> (Pixel, f64) {
        let elapsed_s = time_s - self.time_s;
        let Pixel { x, y } = self.centre;
        match self.motion {
            None => (self.centre, self.size_px),
            Some(Motion { velocity_px_s: [vx, vy], growth_per_s }) => {
                let grown = (growth_per_s * elapsed_s).clamp(-0.7, 0.7).exp();
                (Pixel::new(x + vx * elapsed_s, y + vy * elapsed_s), self.size_px * grown)
            }
        }
    }

    /// Uncertainty of the prediction, in pixels.
    fn uncertainty_px(&self, time_s: f64, size_px: f64) -> f64 {
        let min = MIN_UNCERTAINTY_PX + MIN_UNCERTAINTY_RATIO * size_px;
        match self.motion {
            None => min + size_px,
            Some(_) => {
                // The effect of an acceleration grows with the square of time.
                let longer = ((time_s - self.time_s) / self.period_s).max(1.0);
                min + 2.0 * self.error_px * longer * longer
            }
        }
    }

    /// The region to search for it; `None` when it should have left the image.
    fn region(&self, time_s: f64, size: [usize; 2]) -> Option<Region> {
        let (centre, size_px) = self.predicted(time_s);
        let inside = |at: f64, edge: usize| at >= -0.5 && at <= edge as f64 - 0.5;
        let half = size_px * (0.5 + MARGIN) + self.uncertainty_px(time_s, size_px);
        (inside(centre.x, size[0]) && inside(centre.y, size[1]))
            .then(|| Region::around(centre, half, size))
            .flatten()
    }

    /// Whether an observation is within the gates of this track.
    fn matches(&self, seen: &Observation, time_s: f64) -> bool {
        let (centre, size_px) = self.predicted(time_s);
        let ratio = seen.size_px / size_px;
        (seen.family, seen.id) == (self.family, self.id)
            && centre.distance(&seen.centre) <= self.uncertainty_px(time_s, size_px) + size_px / 2.0
            && (0.5..=2.0).contains(&ratio)
    }
}

impl Shape {
    fn from_observation(seen: &Observation) -> Self {
        let circles = seen.pose.as_ref().filter(|_| seen.corners.is_none());
        let (centre, normal) = match circles {
            Some(pose) => {
                let pose = &pose.camera_from_marker;
                let face = pose.rotation() * geometry::Vector::new(0.0, 0.0, 1.0);
                let origin = pose.origin();
                ([origin.x(), origin.y(), origin.z()], [face.x(), face.y(), face.z()])
            }
            None => ([0.0; 3], [0.0; 3]),
        };
        Self {
            has_corners: seen.corners.is_some(),
            has_circles: circles.is_some(),
            corners: seen.corners.map_or([[0.0; 2]; 4], |corners| corners.map(|c| [c.x, c.y])),
            centre,
            normal,
        }
    }

    /// The sum of this one and `times` another.
    fn plus(&self, other: &Self, times: f64) -> Self {
        let mut sum = *self;
        for (own, others) in sum.corners.iter_mut().zip(&other.corners) {
            *own = [own[0] + times * others[0], own[1] + times * others[1]];
        }
        for (own, others) in [(&mut sum.centre, &other.centre), (&mut sum.normal, &other.normal)] {
            for (own, others) in own.iter_mut().zip(others) {
                *own += times * others;
            }
        }
        sum
    }

    fn times(&self, factor: f64) -> Self {
        let zero = Self { corners: [[0.0; 2]; 4], centre: [0.0; 3], normal: [0.0; 3], ..*self };
        zero.plus(self, factor)
    }
}

impl Region {
    /// The square around a pixel, in whole tiles, cut to an image of this size.
    fn around(centre: Pixel, half: f64, [width, height]: [usize; 2]) -> Option<Self> {
        let finite = centre.x.is_finite() && centre.y.is_finite() && half.is_finite() && half > 0.0;
        let span = |at: f64, edge: usize| {
            let from = (at - half).max(0.0) as usize / TILE * TILE;
            let to = ((at + half).max(0.0) as usize).saturating_add(1).min(edge);
            (from, to.next_multiple_of(TILE).min(edge))
        };
        let ((left, right), (top, bottom)) = (span(centre.x, width), span(centre.y, height));
        (finite && left < right && top < bottom)
            .then_some(Self { from: [left, top], to: [right, bottom] })
    }

    fn contains(&self, pixel: Pixel) -> bool {
        let [x, y] = [pixel.x, pixel.y];
        x >= self.from[0] as f64
            && y >= self.from[1] as f64
            && x < self.to[0] as f64
            && y < self.to[1] as f64
    }

    fn edges(&self) -> [usize; 2] {
        [self.to[0] - self.from[0], self.to[1] - self.from[1]]
    }

    fn area(&self) -> usize {
        let [width, height] = self.edges();
        width * height
    }

    fn overlaps(&self, other: &Self) -> bool {
        (0..2).all(|axis| self.from[axis] < other.to[axis] && other.from[axis] < self.to[axis])
    }

    fn joined(&self, other: &Self) -> Self {
        let [from, to] = [0, 1]
            .map(|axis| (self.from[axis].min(other.from[axis]), self.to[axis].max(other.to[axis])));
        Self { from: [from.0, to.0], to: [from.1, to.1] }
    }
}

/// Joins overlapping regions, so that no marker is found twice.
fn merge(regions: &mut Vec<Region>) {
    let mut index = 0;
    while index < regions.len() {
        let overlapping =
            (index + 1..regions.len()).find(|other| regions[index].overlaps(&regions[*other]));
        match overlapping {
            Some(other) => {
                let gone = regions.swap_remove(other);
                regions[index] = regions[index].joined(&gone);
                // The joined region may overlap earlier ones.
                index = 0;
            }
            None => index += 1,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Matrix2;
    use proptest::prelude::*;

    const SIZE: [usize; 2] = [1296, 972];

    fn seen(x: f64, y: f64, size_px: f64, id: u32) -> Observation {
        Observation {
            family: Family::AprilTag36h11,
            id: Some(id),
            centre: Pixel::new(x, y),
            centre_covariance_px2: Matrix2::identity(),
            corners: None,
            wrong_bits: 0,
            size_px,
            confidence: 1.0,
            pose: None,
            response: None,
        }
    }

    /// The regions that are searched at `time_s` after images with these observations.
    fn regions(images: &[(f64, &[Observation])], time_s: f64) -> Vec<Region> {
        let mut tracker = Tracker::default();
        for (time_s, found) in images {
            tracker.begin(SIZE, *time_s);
            tracker.found = found.to_vec();
            tracker.update_tracks(*time_s);
        }
        tracker.begin(SIZE, time_s);
        tracker.choose_regions(time_s);
        tracker.regions
    }

    #[test]
    fn a_marker_is_searched_where_its_velocity_takes_it() {
        let places = (0..8).map(|i| (0.1 * f64::from(i), f64::from(i)));
        let images: Vec<_> = places
            .map(|(time_s, i)| (time_s, [seen(280.0 + 30.0 * i, 340.0 - 10.0 * i, 48.0, 7)]))
            .collect();
        let images: Vec<(f64, &[Observation])> = images.iter().map(|(t, f)| (*t, &f[..])).collect();
        let [region] = regions(&images, 0.8)[..] else { panic!("one region") };
        // Around (520, 260), and little more than the marker.
        assert!(
            region.from[0] < 485
                && region.to[0] > 555
                && region.from[1] < 225
                && region.to[1] > 295
        );
        assert!(region.area() <= 128 * 128, "{region:?}");
        // The velocity of a marker seen once is unknown.
        let [first] = regions(&images[..1], 0.1)[..] else { panic!("one region") };
        assert!(first.area() > region.area());
    }

    #[test]
    fn an_unsteady_marker_has_a_larger_region() {
        let steady: Vec<_> =
            (0..4).map(|i| [seen(300.0 + 20.0 * f64::from(i), 300.0, 40.0, 1)]).collect();
        let mut jerky = steady.clone();
        jerky[3][0].centre.x += 30.0;
        let area = |images: &[[Observation; 1]]| {
            let images: Vec<(f64, &[Observation])> =
                images.iter().enumerate().map(|(i, seen)| (i as f64 * 0.1, &seen[..])).collect();
            regions(&images, 0.4)[0].area()
        };
        assert!(area(&jerky) > 2 * area(&steady));
    }

    #[test]
    fn the_whole_image_is_searched_when_nothing_can_be_predicted() {
        let near_side: &[Observation] = &[seen(10.0, 300.0, 48.0, 7)];
        let gone: [(f64, &[Observation]); 2] =
            [(0.0, &[seen(60.0, 300.0, 48.0, 7)]), (0.1, near_side)];
        assert!(!regions(&gone[1..], 0.2).is_empty());
        assert!(regions(&gone, 0.2).is_empty(), "it has left the image");
        for time_s in [0.1, 0.0, 1.2, f64::NAN] {
            assert!(regions(&gone[1..], time_s).is_empty(), "{time_s}");
        }
        let large: &[Observation] = &[seen(600.0, 500.0, 700.0, 7)];
        assert!(regions(&[(0.0, large)], 0.1).is_empty());
    }

    #[test]
    fn the_whole_image_is_searched_periodically() {
        let mut tracker = Tracker::new(TrackingSettings { full_search_period: 4 });
        tracker.begin(SIZE, 0.0);
        tracker.found = vec![seen(400.0, 300.0, 48.0, 7)];
        tracker.update_tracks(0.0);
        let searched = [1, 2, 3, 4].map(|_| {
            let by_region = tracker.choose_regions(0.1);
            tracker.since_full = if by_region { tracker.since_full + 1 } else { 0 };
            by_region
        });
        assert_eq!(searched, [true, true, true, false]);
    }

    #[test]
    fn two_markers_of_one_name_are_distinguished_by_position() {
        let images: Vec<(f64, Vec<Observation>)> = (0..3)
            .map(|i| (0.1 * f64::from(i), 10.0 * f64::from(i)))
            .map(|(time_s, x)| {
                (time_s, vec![seen(900.0 - x, 200.0, 40.0, 3), seen(100.0 + x, 200.0, 40.0, 3)])
            })
            .collect();
        let images: Vec<(f64, &[Observation])> = images.iter().map(|(t, f)| (*t, &f[..])).collect();
        let regions = regions(&images, 0.3);
        let middle = |region: &Region| (region.from[0] + region.to[0]) / 2;
        assert_eq!(regions.len(), 2);
        assert!(middle(&regions[0]).abs_diff(870) < 16 && middle(&regions[1]).abs_diff(130) < 16);
    }

    #[test]
    fn a_marker_that_is_not_found_in_its_region_is_missing() {
        let mut tracker = Tracker::default();
        tracker.begin(SIZE, 0.0);
        tracker.found = vec![seen(400.0, 300.0, 48.0, 7)];
        tracker.update_tracks(0.0);
        for (found, missing) in [
            (vec![seen(410.0, 300.0, 50.0, 7)], false),
            (vec![seen(410.0, 300.0, 50.0, 8)], true),
            (vec![seen(700.0, 300.0, 50.0, 7)], true),
            (vec![], true),
        ] {
            tracker.found = found;
            assert_eq!(tracker.is_one_missing(0.1), missing);
        }
    }

    proptest! {
        #[test]
        fn regions_are_in_the_image_and_disjoint_for_any_detections(
            places in prop::collection::vec((any::<f64>(), any::<f64>(), any::<f64>(), 0_u32..3), 0..40),
            near in prop::collection::vec((0.0..1300.0, 0.0..1000.0, 1.0..200.0, 0_u32..3), 0..40),
            expected in prop::collection::vec((any::<f64>(), -50.0..1400.0, any::<f64>()), 0..30),
        ) {
            let mut tracker = Tracker::default();
            for (i, list) in [&places, &near, &near].into_iter().enumerate() {
                let time_s = i as f64 * 0.1;
                tracker.begin(SIZE, time_s);
                tracker.found = list.iter().map(|(x, y, size, id)| seen(*x, *y, *size, *id)).collect();
                tracker.update_tracks(time_s);
            }
            for (x, y, size) in expected {
                tracker.add_roi(Pixel::new(x, y), size, y);
            }
            tracker.begin(SIZE, 0.3);
            tracker.choose_regions(0.3);
            for (i, region) in tracker.regions.iter().enumerate() {
                prop_assert!(region.area() > 0 && region.to[0] <= SIZE[0] && region.to[1] <= SIZE[1]);
                prop_assert!(!tracker.regions[..i].iter().any(|other| other.overlaps(region)));
            }
        }
    }
}
