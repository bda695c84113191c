//! Where to look first: the places where the markers of the last images should be by now.
//!
//! A marker is expected where a constant velocity takes its centre and its size, in a region that grows with what is
//! not known of its motion. Only these regions are searched, by the same detector with the same checks as ever, so
//! that a marker is never made up; the whole image is searched every so often, for markers that are new, and whenever
//! a marker is not where it was expected. A marker that is plain to see right where it was expected is read there, and its
//! region is not searched for others. Where nothing is followed, what takes long is done in turn
//! ([`Detector::detect_in_turn`]).

use geometry::{CameraModel, Pixel};
use imaging::GrayView;
use markers::Family;
use nalgebra::Vector3;

use crate::detector::{Detector, Expected};
use crate::families::rings::circle_pose::CirclePose;
use crate::observation::{Observation, Stages};
use crate::trace::{Trace, moved_pixel};

/// What can be chosen about tracking.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct TrackingSettings {
    /// The whole image is searched in every image of this number; with 1 in each, which is no tracking at all.
    pub full_search_period: u32,
}

impl Default for TrackingSettings {
    fn default() -> Self {
        Self { full_search_period: 15 }
    }
}

/// Markers followed from image to image.
#[derive(Debug, Default)]
pub struct Tracker {
    settings: TrackingSettings,
    tracks: Vec<Track>,
    expected: Vec<Region>,
    regions: Vec<Region>,
    found: Vec<Observation>,
    trace: Trace,
    /// Images since the whole of one was searched.
    since_full: u32,
    size: (usize, usize),
    /// Whether an image was searched.
    has_begun: bool,
    /// Whether somebody else expects markers in this image.
    is_asked: bool,
}

/// A marker that was seen, and how it moves.
#[derive(Copy, Clone, Debug)]
struct Track {
    family: Family,
    id: Option<u32>,
    centre: Pixel,
    size_px: f64,
    time_s: f64,
    /// Velocity of the centre in px/s and growth of the size in 1/s; `None` after a first sight.
    motion: Option<Motion>,
    /// How far the last prediction was off, in pixels, and over which time.
    off_px: f64,
    period_s: f64,
    shape: Shape,
    /// How the shape changes in a second; `None` after a first sight.
    change: Option<Shape>,
}

/// Where exactly a marker was seen: the corners of a square one, or the centre (m) and normal of rings. Noughts stand for what
/// it does not have.
#[derive(Copy, Clone, Debug, Default, PartialEq)]
struct Shape {
    has_corners: bool,
    has_circles: bool,
    corners: [[f64; 2]; 4],
    centre: [f64; 3],
    normal: [f64; 3],
}

#[derive(Copy, Clone, Debug)]
struct Motion {
    velocity_px_s: [f64; 2],
    growth_per_s: f64,
}

/// A rectangle of pixels, from a corner up to but not including the other.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
struct Region {
    from: [usize; 2],
    to: [usize; 2],
}

/// Markers that are followed at most; more are found by searching the whole image.
const MOST_TRACKS: usize = 16;
/// Nothing is predicted over a longer time, in seconds.
const LONGEST_S: f64 = 1.0;
/// A marker's surroundings that belong to the search, in units of its size on each side.
const SURROUNDINGS: f64 = 0.25;
/// What a prediction is never better than, in pixels and in units of the marker's size.
const LEAST_REACH_PX: f64 = 4.0;
const LEAST_REACH: f64 = 0.1;
/// Regions begin and end at multiples of this, in pixels, so that what is done by tiles is done as in the whole image.
const TILE: usize = 16;
/// Regions that cover more than this part of the image are not worth it.
const MOST_COVER: f64 = 0.4;

impl Tracker {
    /// Follows nothing yet.
    pub fn new(settings: TrackingSettings) -> Self {
        Self { settings, ..Self::default() }
    }

    /// Changes the settings; what is followed is followed on.
    pub fn set(&mut self, settings: TrackingSettings) {
        self.settings = settings;
    }

    /// Looks in the next image also about `centre`, where somebody else expects a marker of about `size_px`, give or take
    /// `spread_px`.
    pub fn expect(&mut self, centre: Pixel, size_px: f64, spread_px: f64) {
        let half = size_px * (0.5 + SURROUNDINGS) + spread_px + LEAST_REACH_PX;
        if self.expected.len() < MOST_TRACKS
            && let Some(region) = Region::about(centre, half, self.size)
        {
            self.expected.push(region);
        }
    }

    /// Finds the markers in an image taken at `time_s` (seconds of any clock), as [`Detector::detect`] does, the surest
    /// first.
    pub fn detect(
        &mut self,
        detector: &mut Detector,
        view: GrayView<'_>,
        camera: Option<&CameraModel>,
        time_s: f64,
        stages: &mut impl Stages,
    ) -> &[Observation] {
        self.found.clear();
        self.trace.clear();
        self.begin((view.width(), view.height()), time_s);
        if self.choose_regions(time_s) {
            for index in 0..self.regions.len() {
                if let Some(region) = self.regions.get(index).copied() {
                    self.search(detector, view, camera, (region, time_s), stages);
                }
            }
            self.found.sort_unstable_by(|a, b| b.confidence.total_cmp(&a.confidence));
            self.since_full += 1;
        }
        if self.regions.is_empty() || self.is_one_missing(time_s) {
            // The first image, and one that should show a marker, are searched with all there is.
            let is_urgent =
                !self.tracks.is_empty() || !std::mem::replace(&mut self.has_begun, true);
            let seen = match is_urgent {
                true => detector.detect(view, camera, stages),
                false => detector.detect_in_turn(view, camera, stages),
            };
            self.found.clear();
            self.found.extend_from_slice(seen);
            self.trace.clear();
            self.trace.add_part(detector.trace(), [0.0; 2]);
            self.since_full = 0;
        }
        self.follow(time_s);
        &self.found
    }

    /// What the last detection saw on its way, in pixels of the whole image.
    pub fn trace(&self) -> &Trace {
        &self.trace
    }

    /// Forgets what can no longer be followed.
    fn begin(&mut self, size: (usize, usize), time_s: f64) {
        if size != self.size {
            self.size = size;
            self.tracks.clear();
            self.expected.clear();
        }
        // Also a time that is not a number, or runs backwards.
        self.tracks.retain(|track| {
            let elapsed_s = time_s - track.time_s;
            elapsed_s > 0.0 && elapsed_s <= LONGEST_S
        });
    }

    /// Lists the regions to be searched; false when it is the whole image.
    fn choose_regions(&mut self, time_s: f64) -> bool {
        self.regions.clear();
        let is_due = self.since_full + 1 >= self.settings.full_search_period;
        // Regions that only somebody else expects are no reason to leave the rest out.
        if self.tracks.is_empty() || is_due {
            self.expected.clear();
            return false;
        }
        let of_tracks = self.tracks.iter().filter_map(|track| track.region(time_s, self.size));
        self.regions.extend(of_tracks);
        self.is_asked = !self.expected.is_empty();
        self.regions.append(&mut self.expected);
        merge(&mut self.regions);
        let area: usize = self.regions.iter().map(Region::area).sum();
        let whole = (self.size.0 * self.size.1) as f64;
        if area as f64 > MOST_COVER * whole {
            self.regions.clear();
        }
        !self.regions.is_empty()
    }

    fn search(
        &mut self,
        detector: &mut Detector,
        view: GrayView<'_>,
        camera: Option<&CameraModel>,
        (region, time_s): (Region, f64),
        stages: &mut impl Stages,
    ) {
        let [x, y] = region.from;
        let [width, height] = region.edges();
        let Some(part) = view.crop(x, y, width, height) else { return };
        let offset = [x as f64, y as f64];
        let camera = camera.map(|camera| CameraModel {
            width: width as u32,
            height: height as u32,
            cx: camera.cx - offset[0],
            cy: camera.cy - offset[1],
            ..*camera
        });
        let moved = |seen: &Observation| {
            let mut seen = seen.clone();
            seen.centre = moved_pixel(seen.centre, offset);
            seen.corners = seen.corners.map(|corners| corners.map(|c| moved_pixel(c, offset)));
            seen
        };
        let expected = self.only_track(&region, time_s).and_then(|track| {
            let expected = track.expected(time_s, offset)?;
            detector.detect_at(part, camera.as_ref(), &expected, stages)
        });
        match expected {
            Some(seen) => self.found.push(moved(&seen)),
            None => {
                self.found.extend(detector.detect(part, camera.as_ref(), stages).iter().map(moved));
            }
        }
        self.trace.add_part(detector.trace(), offset);
    }

    /// The track in a region in which there is no other, and in which nobody else expects a marker.
    fn only_track(&self, region: &Region, time_s: f64) -> Option<&Track> {
        let is_within = |track: &&Track| region.has(track.predicted(time_s).0);
        let mut within = self.tracks.iter().filter(is_within);
        let track = within.next()?;
        (!self.is_asked && within.next().is_none()).then_some(track)
    }

    /// True when a marker that should be in the image was not found.
    fn is_one_missing(&self, time_s: f64) -> bool {
        self.tracks.iter().any(|track| {
            track.region(time_s, self.size).is_some()
                && !self.found.iter().any(|seen| track.may_be(seen, time_s))
        })
    }

    /// Joins what was found to what is followed.
    fn follow(&mut self, time_s: f64) {
        let before = self.tracks.len();
        for seen in &self.found {
            let old = self.tracks.get(..before).unwrap_or_default();
            let of_seen = |track: &&Track| track.time_s < time_s && track.may_be(seen, time_s);
            let off = |track: &Track| track.predicted(time_s).0.distance(&seen.centre);
            let track = old.iter().filter(of_seen).min_by(|a, b| off(a).total_cmp(&off(b)));
            let next = match track {
                Some(track) => track.next(seen, time_s),
                None => Track::first(seen, time_s),
            };
            if self.tracks.len() < before + MOST_TRACKS && next.is_sound() {
                self.tracks.push(next);
            }
        }
        self.tracks.drain(..before);
    }
}

impl Track {
    fn first(seen: &Observation, time_s: f64) -> Self {
        let Observation { family, id, centre, size_px, .. } = *seen;
        let shape = Shape::of(seen);
        let (motion, change) = (None, None);
        let (off_px, period_s) = (0.0, 0.0);
        Self { family, id, centre, size_px, time_s, motion, off_px, period_s, shape, change }
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
        // A prediction without a motion says nothing of how steady the motion is.
        let off_px = match self.motion {
            Some(_) => expected.distance(&seen.centre).max(0.7 * self.off_px),
            None => 0.5 * expected.distance(&seen.centre),
        };
        let next = Self::first(seen, time_s);
        let change = Some(next.shape.plus(&self.shape, -1.0).times(1.0 / period_s));
        Self { motion: Some(motion), off_px, period_s, change, ..next }
    }

    /// Where exactly it should be in a part of the image that begins at `offset`.
    fn expected(&self, time_s: f64, offset: [f64; 2]) -> Option<Expected> {
        let shape = self.shape.plus(&self.change?, time_s - self.time_s);
        let corner = |[x, y]: [f64; 2]| Pixel::new(x - offset[0], y - offset[1]);
        let circles = || {
            let [centre, normal] = [shape.centre, shape.normal].map(Vector3::from);
            Some(CirclePose { centre, normal: normal.try_normalize(0.1)? })
        };
        Some(Expected {
            family: self.family,
            id: self.id,
            corners: self.shape.has_corners.then(|| shape.corners.map(corner)),
            circles: if self.shape.has_circles { circles() } else { None },
        })
    }

    fn is_sound(&self) -> bool {
        let Pixel { x, y } = self.centre;
        self.size_px > 0.0 && [x, y, self.size_px].iter().all(|n| n.is_finite())
    }

    /// Where its centre should be, and how large it should be, in pixels.
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

    /// How far from the prediction it may be, in pixels.
    fn reach_px(&self, time_s: f64, size_px: f64) -> f64 {
        let least = LEAST_REACH_PX + LEAST_REACH * size_px;
        match self.motion {
            None => least + size_px,
            Some(_) => {
                // What a change of the velocity does grows with the square of time.
                let longer = ((time_s - self.time_s) / self.period_s).max(1.0);
                least + 2.0 * self.off_px * longer * longer
            }
        }
    }

    /// Where to look for it; `None` when it should have left the image.
    fn region(&self, time_s: f64, size: (usize, usize)) -> Option<Region> {
        let (centre, size_px) = self.predicted(time_s);
        let inside = |at: f64, edge: usize| at >= -0.5 && at <= edge as f64 - 0.5;
        let half = size_px * (0.5 + SURROUNDINGS) + self.reach_px(time_s, size_px);
        (inside(centre.x, size.0) && inside(centre.y, size.1))
            .then(|| Region::about(centre, half, size))
            .flatten()
    }

    /// True when an observation can be of this marker.
    fn may_be(&self, seen: &Observation, time_s: f64) -> bool {
        let (centre, size_px) = self.predicted(time_s);
        let ratio = seen.size_px / size_px;
        (seen.family, seen.id) == (self.family, self.id)
            && centre.distance(&seen.centre) <= self.reach_px(time_s, size_px) + size_px / 2.0
            && (0.5..=2.0).contains(&ratio)
    }
}

impl Shape {
    fn of(seen: &Observation) -> Self {
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

    /// This one and so many times another.
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
        let nought = Self { corners: [[0.0; 2]; 4], centre: [0.0; 3], normal: [0.0; 3], ..*self };
        nought.plus(self, factor)
    }
}

impl Region {
    /// The square about a place, in whole tiles, as far as it lies in an image of this size.
    fn about(centre: Pixel, half: f64, (width, height): (usize, usize)) -> Option<Self> {
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

    fn has(&self, place: Pixel) -> bool {
        let [x, y] = [place.x, place.y];
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

/// Joins regions that overlap, so that no marker is found twice.
fn merge(regions: &mut Vec<Region>) {
    let mut index = 0;
    while index < regions.len() {
        let overlapping =
            (index + 1..regions.len()).find(|other| regions[index].overlaps(&regions[*other]));
        match overlapping {
            Some(other) => {
                let gone = regions.swap_remove(other);
                regions[index] = regions[index].joined(&gone);
                // What has grown may overlap those before it.
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

    const SIZE: (usize, usize) = (1296, 972);

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
        }
    }

    /// What is searched at `time_s` after some images in which markers were found.
    fn regions(images: &[(f64, &[Observation])], time_s: f64) -> Vec<Region> {
        let mut tracker = Tracker::default();
        for (time_s, found) in images {
            tracker.begin(SIZE, *time_s);
            tracker.found = found.to_vec();
            tracker.follow(*time_s);
        }
        tracker.begin(SIZE, time_s);
        tracker.choose_regions(time_s);
        tracker.regions
    }

    #[test]
    fn a_marker_is_looked_for_where_its_velocity_takes_it() {
        let places = (0..8).map(|i| (0.1 * f64::from(i), f64::from(i)));
        let images: Vec<_> = places
            .map(|(time_s, i)| (time_s, [seen(280.0 + 30.0 * i, 340.0 - 10.0 * i, 48.0, 7)]))
            .collect();
        let images: Vec<(f64, &[Observation])> = images.iter().map(|(t, f)| (*t, &f[..])).collect();
        let [region] = regions(&images, 0.8)[..] else { panic!("one region") };
        // About (520, 260), and little more than the marker.
        assert!(
            region.from[0] < 485
                && region.to[0] > 555
                && region.from[1] < 225
                && region.to[1] > 295
        );
        assert!(region.area() <= 128 * 128, "{region:?}");
        // A marker seen once may have gone anywhere near.
        let [first] = regions(&images[..1], 0.1)[..] else { panic!("one region") };
        assert!(first.area() > region.area());
    }

    #[test]
    fn an_unsteady_marker_is_looked_for_further_around() {
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
    fn every_so_often_the_whole_image_is_searched() {
        let mut tracker = Tracker::new(TrackingSettings { full_search_period: 4 });
        tracker.begin(SIZE, 0.0);
        tracker.found = vec![seen(400.0, 300.0, 48.0, 7)];
        tracker.follow(0.0);
        let searched = [1, 2, 3, 4].map(|_| {
            let by_region = tracker.choose_regions(0.1);
            tracker.since_full = if by_region { tracker.since_full + 1 } else { 0 };
            by_region
        });
        assert_eq!(searched, [true, true, true, false]);
    }

    #[test]
    fn two_markers_of_one_name_are_told_apart_by_their_place() {
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
    fn a_marker_that_is_not_found_where_it_should_be_is_missing() {
        let mut tracker = Tracker::default();
        tracker.begin(SIZE, 0.0);
        tracker.found = vec![seen(400.0, 300.0, 48.0, 7)];
        tracker.follow(0.0);
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
        fn whatever_is_found_regions_lie_in_the_image_and_apart(
            places in prop::collection::vec((any::<f64>(), any::<f64>(), any::<f64>(), 0_u32..3), 0..40),
            near in prop::collection::vec((0.0..1300.0, 0.0..1000.0, 1.0..200.0, 0_u32..3), 0..40),
            expected in prop::collection::vec((any::<f64>(), -50.0..1400.0, any::<f64>()), 0..30),
        ) {
            let mut tracker = Tracker::default();
            for (i, list) in [&places, &near, &near].into_iter().enumerate() {
                let time_s = i as f64 * 0.1;
                tracker.begin(SIZE, time_s);
                tracker.found = list.iter().map(|(x, y, size, id)| seen(*x, *y, *size, *id)).collect();
                tracker.follow(time_s);
            }
            for (x, y, size) in expected {
                tracker.expect(Pixel::new(x, y), size, y);
            }
            tracker.begin(SIZE, 0.3);
            tracker.choose_regions(0.3);
            for (i, region) in tracker.regions.iter().enumerate() {
                prop_assert!(region.area() > 0 && region.to[0] <= SIZE.0 && region.to[1] <= SIZE.1);
                prop_assert!(!tracker.regions[..i].iter().any(|other| other.overlaps(region)));
            }
        }
    }
}
