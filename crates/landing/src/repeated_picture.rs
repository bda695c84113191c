//! Recognises a picture that a grabber, a player or a decoder repeats with new stamps, by a marker that stays fixed to the vehicle while
//! that moves.
//!
//! The pad then seems to move along, and to sink before a vehicle that goes down. No two pictures of a camera are alike, as its noise
//! differs, and no vehicle holds its position over a marker to a fraction of a millimetre. So a marker that stays, while the autopilot's
//! position and attitude change, is an old one. Where a link codes the picture again for each frame it stays less exactly, and must seem
//! to move further.

use geometry::{Body, Camera, Pixel, Point, Rotation, Vector};
use libm::hypot;
use nalgebra::Vector3;

use crate::config::EstimatorConfig;
use crate::event::{FrameObservation, MarkerInFrame};
use crate::history::Motion;
use crate::time::Timestamp;

/// Largest change of the marker's position relative to the vehicle from one frame to the next, as a fraction of its distance: a detector
/// that remembers more of the camera with each frame finds the same marker again to within a third of it (measured: 6e-6).
const MAX_CHANGE: f64 = 2e-5;

/// Number of such changes in a row, and how far the marker must seem to have moved over the ground meanwhile, in metres and as a
/// fraction of its distance.
const MIN_ALIKE: u32 = 2;
const MIN_MOVED_M: f64 = 0.05;
const MIN_MOVED_FRACTION: f64 = 0.01;

/// The same where the link codes a repeated picture again, in which the marker is found again less well: measured from one quality of
/// JPEG to the next, 7e-4 at most. So much a marker may stay that moves along with the vehicle, or whose vehicle stays while the
/// autopilot's position drifts: it must seem to move further and faster than that, to the side or up and down, within a time (in s and
/// m/s, in addition to the speed and the heave of the configured pad). A larger change alone does not make an old picture a new one.
const MAX_CODED_CHANGE: f64 = 2e-3;
const MAX_OLD_CHANGE: f64 = 5e-3;
const MIN_CODED_MOVED_M: f64 = 0.1;
const MIN_CODED_MOVED_FRACTION: f64 = 0.02;
const MIN_CODED_M_S: f64 = 0.2;
const CODED_S: f64 = 2.0;

/// How far the direction to a marker whose distance is not known must seem to have turned over the ground meanwhile, in radians.
const MIN_TURNED_RAD: f64 = 0.02;

/// The newest frames with a marker.
#[derive(Clone, Debug, Default)]
pub(crate) struct RepeatedPicture {
    newest: Option<Sight>,
    /// The first of those that are alike, and how many followed it.
    first: Option<First>,
    alike: u32,
    /// The first of those in which the marker stays as it does in pictures that were coded again.
    coded: Option<First>,
}

/// Whether the picture of a frame is an old one.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) enum Picture {
    /// Another one than before.
    Other,
    /// It may be one of before.
    Alike,
    /// The one of this time.
    Old(Timestamp),
}

/// The first of frames in which the marker stays.
#[derive(Copy, Clone, Debug)]
struct First {
    sight: Sight,
    /// Where the marker was over the ground, in the odometry frame, in metres, and when; of one whose distance is not known the
    /// direction.
    position: Vector3<f64>,
    placed: Timestamp,
    /// Those after it are old pictures.
    is_old: bool,
}

/// A marker in a frame.
#[derive(Copy, Clone, Debug)]
struct Sight {
    stamp: Timestamp,
    /// Where it was relative to the vehicle, in metres; of one whose distance is not known the direction.
    in_body: Vector<Body>,
    has_distance: bool,
}

impl RepeatedPicture {
    /// Adds a marker, and returns whether its picture is an old one. Where its distance is not known the direction decides: then a
    /// vehicle that moves and does not tilt may see it where it was. The marker of a vehicle that `stands` does not move.
    pub(crate) fn add(
        &mut self,
        frame: &FrameObservation,
        marker: &MarkerInFrame,
        motion: &Motion,
        config: &EstimatorConfig,
        stands: bool,
    ) -> Picture {
        let stamp = frame.stamp;
        let (sight, position, min_moved) = if let Some(pose) = marker.body_from_marker {
            let in_body = pose.origin() - Point::origin();
            let position = motion.odometry.coords.coords + (motion.ned_from_body * in_body).coords;
            let sight = Sight { stamp, in_body, has_distance: true };
            (sight, position, MIN_MOVED_M + MIN_MOVED_FRACTION * in_body.norm())
        } else {
            let in_body = direction(frame, marker.centre);
            let sight = Sight { stamp, in_body, has_distance: false };
            (sight, (motion.ned_from_body * in_body).coords, MIN_TURNED_RAD)
        };
        // A late frame gives no information about the frames since.
        if self.newest.is_some_and(|newest| stamp <= newest.stamp) {
            let old = [(self.first, MAX_CHANGE), (self.coded, MAX_OLD_CHANGE)];
            let old = old.into_iter().find_map(|(first, max_change)| {
                first.filter(|it| it.is_old && it.sight.is_like(&sight, max_change))
            });
            return old.map_or(Picture::Alike, |first| Picture::Old(first.sight.stamp));
        }
        let same = self.add_same(sight, position, min_moved);
        if stands {
            self.coded = None;
        }
        if !sight.has_distance || stands {
            return same;
        }
        let slack_m_s = [config.pad_speed_m_s, config.pad_heave_m_s];
        match (self.add_coded(sight, position, slack_m_s), same) {
            (Picture::Old(coded), Picture::Old(same)) => Picture::Old(same.min(coded)),
            (_, Picture::Old(since)) | (Picture::Old(since), _) => Picture::Old(since),
            (coded, _) => coded,
        }
    }

    fn add_same(&mut self, sight: Sight, position: Vector3<f64>, min_moved: f64) -> Picture {
        let is_alike = self.newest.is_some_and(|newest| newest.is_like(&sight, MAX_CHANGE));
        self.newest = Some(sight);
        let Some(mut first) = self.first.filter(|_| is_alike) else {
            (self.first, self.alike) = (Some(First::new(sight, position)), 0);
            return Picture::Other;
        };
        self.alike = self.alike.saturating_add(1);
        first.is_old |= self.alike >= MIN_ALIKE && (position - first.position).norm() > min_moved;
        self.first = Some(first);
        first.picture()
    }

    /// The same for a picture that may have been coded again; a pad may move by so much to the side, and up and down.
    fn add_coded(&mut self, sight: Sight, position: Vector3<f64>, pad_m_s: [f64; 2]) -> Picture {
        let max_change =
            |first: &First| if first.is_old { MAX_OLD_CHANGE } else { MAX_CODED_CHANGE };
        let first = self.coded.filter(|first| first.sight.is_like(&sight, max_change(first)));
        let Some(mut first) = first else {
            self.coded = Some(First::new(sight, position));
            return Picture::Other;
        };
        let moved = position - first.position;
        let after_s = sight.stamp.seconds_since(first.placed);
        let [max_side_m, max_down_m] = pad_m_s.map(|pad_m_s| {
            let error_m = MIN_CODED_MOVED_M + MIN_CODED_MOVED_FRACTION * sight.in_body.norm();
            error_m + (MIN_CODED_M_S + pad_m_s) * after_s
        });
        first.is_old |= hypot(moved.x, moved.y) > max_side_m || moved.z.abs() > max_down_m;
        if after_s > CODED_S {
            (first.position, first.placed) = (position, sight.stamp);
        }
        self.coded = Some(first);
        first.picture()
    }
}

impl First {
    fn new(sight: Sight, position: Vector3<f64>) -> Self {
        Self { sight, position, placed: sight.stamp, is_old: false }
    }

    fn picture(&self) -> Picture {
        if self.is_old { Picture::Old(self.sight.stamp) } else { Picture::Alike }
    }
}

/// The direction in which a pixel lies, a vector of length one. The focal length of a camera that is not calibrated is taken for the
/// image's width, and a mount that is not known for one that looks down.
fn direction(frame: &FrameObservation, pixel: Pixel) -> Vector<Body> {
    let (width, height) = (f64::from(frame.image_size.0), f64::from(frame.image_size.1));
    let focal_px = frame.focal_px.filter(|focal_px| *focal_px > 1.0).unwrap_or(width);
    let in_camera = Vector::<Camera>::new(pixel.x - 0.5 * width, pixel.y - 0.5 * height, focal_px);
    let body_from_camera = frame.body_from_camera.unwrap_or(Rotation::identity());
    body_from_camera * (in_camera * (1.0 / in_camera.norm()))
}

impl Sight {
    fn is_like(&self, other: &Self, max_change: f64) -> bool {
        let change = (other.in_body - self.in_body).norm();
        self.has_distance == other.has_distance && change <= max_change * other.in_body.norm()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::{Odometry, Transform};

    /// A vehicle at this height that does not turn.
    fn motion(height_m: f64) -> Motion {
        Motion {
            ned_from_body: Rotation::identity(),
            position: Point::new(0.0, 0.0, -height_m),
            odometry: Point::<Odometry>::new(0.0, 0.0, -height_m),
            velocity: Vector::zero(),
            rate: Vector::zero(),
        }
    }

    /// A marker in one of 15 frames in a second, `late_s` earlier: at this position relative to the vehicle, or where only the pixel is
    /// known.
    fn frame(
        (number, late_s): (u32, f64),
        position: Option<Point<Body>>,
        centre: Pixel,
    ) -> (FrameObservation, MarkerInFrame) {
        let marker = MarkerInFrame {
            centre,
            body_from_marker: position
                .map(|position| Transform::new(Rotation::identity(), position)),
            alternative: None,
            covariance_m2: None,
            size_px: None,
            confidence: 1.0,
        };
        let frame = FrameObservation {
            stamp: Timestamp::from_seconds(f64::from(number) / 15.0 - late_s),
            image_size: (1296, 972),
            focal_px: Some(1818.0),
            body_from_camera: None,
            marker: Some(marker),
        };
        (frame, marker)
    }

    fn is_repeated(
        check: &mut RepeatedPicture,
        at: (u32, f64),
        motion: &Motion,
        position: Option<Point<Body>>,
        centre: Pixel,
    ) -> bool {
        let (frame, marker) = frame(at, position, centre);
        let picture = check.add(&frame, &marker, motion, &EstimatorConfig::default(), false);
        matches!(picture, Picture::Old(_))
    }

    /// In which of the frames the picture is an old one, of a vehicle at these heights, 0 where it stands, over a marker that is seen so
    /// deep, in metres, on a pad that may move by so much to the side.
    fn old(
        frames: u32,
        pad_speed_m_s: f64,
        height_m: impl Fn(u32) -> f64,
        seen_m: impl Fn(u32) -> f64,
    ) -> Vec<u32> {
        let mut check = RepeatedPicture::default();
        let config = EstimatorConfig { pad_speed_m_s, ..EstimatorConfig::default() };
        (0..frames)
            .filter(|&number| {
                let seen = Point::new(0.3, -0.2, seen_m(number));
                let (frame, marker) = frame((number, 0.0), Some(seen), Pixel::new(0.0, 0.0));
                let stands = height_m(number) == 0.0;
                let motion = motion(height_m(number));
                let picture = check.add(&frame, &marker, &motion, &config, stands);
                matches!(picture, Picture::Old(_))
            })
            .collect()
    }

    fn repeated(
        frames: u32,
        height_m: impl Fn(u32) -> f64,
        seen_m: impl Fn(u32) -> f64,
    ) -> Vec<u32> {
        old(frames, 0.0, height_m, seen_m)
    }

    #[test]
    fn a_picture_that_stays_while_the_vehicle_moves_is_an_old_one() {
        let true_m = |number: u32| 5.0 - 0.1 * f64::from(number);
        assert_eq!(repeated(20, true_m, true_m), Vec::<u32>::new());
        // From the fifth on, found again to within a few millionths.
        let stays = |number: u32| true_m(number.min(5)) * (1.0 + 5e-6 * f64::from(number % 2));
        assert_eq!(repeated(20, true_m, stays), (7..20).collect::<Vec<_>>());
        // It continues.
        let goes_on = |number: u32| if number < 12 { stays(number) } else { true_m(number) };
        assert_eq!(repeated(20, true_m, goes_on), (7..12).collect::<Vec<_>>());
        // The vehicle returns to where it was, and above.
        let height_m = |number: u32| true_m(number.min(24 - number.min(24)));
        assert_eq!(repeated(24, height_m, stays), (7..24).collect::<Vec<_>>());
        // As a camera's noise has it, the vehicle may stay over a pad while the autopilot's height drifts.
        let noise = |number: u32| 5.0 * (1.0 + 3e-5 * f64::from(number % 2));
        let drifts_m = |number: u32| 5.0 - 0.01 * f64::from(number);
        assert_eq!(repeated(100, drifts_m, noise), Vec::<u32>::new());
        // It is coded again for each frame: it moves further than errors and a drift of the position explain.
        let coded = |number: u32| true_m(number.min(5)) * (1.0 + 5e-4 * f64::from(number % 2));
        assert_eq!(repeated(20, true_m, coded), (8..20).collect::<Vec<_>>());
    }

    #[test]
    fn a_picture_that_stays_while_the_vehicle_does_is_none() {
        let drifts_m = |number: u32| 5.0 + 0.0005 * f64::from(number);
        assert_eq!(repeated(100, drifts_m, |_| 5.0), Vec::<u32>::new());
    }

    #[test]
    fn a_picture_that_is_coded_again_is_noticed_after_a_hover_and_after_the_start() {
        let alternates = |number: u32| 7e-4 * f64::from(number % 2);
        // A marker seen 5 m below, whose position changes by such a fraction.
        let recoded = |frames, height_m: &dyn Fn(u32) -> f64, change: &dyn Fn(u32) -> f64| {
            old(frames, 3.0, height_m, |number| 5.0 * (1.0 + change(number)))
        };
        let first = |old: &[u32]| old.first().copied().unwrap_or(u32::MAX);
        let goes_on_from = |old: &[u32], to: u32| (first(old)..to).eq(old.iter().copied());
        // A minute, then down by 1 m/s: within 0.8 s.
        let hovers = |number: u32| 5.0 - f64::from(number.saturating_sub(900)) / 15.0;
        let old = recoded(975, &hovers, &alternates);
        assert!((901..=912).contains(&first(&old)) && goes_on_from(&old, 975), "{old:?}");
        // Two minutes on the ground, then up.
        let climbs = |number: u32| f64::from(number.saturating_sub(1800)) / 15.0;
        let old = recoded(1900, &climbs, &alternates);
        assert!((1801..=1808).contains(&first(&old)) && goes_on_from(&old, 1900), "{old:?}");
        // The quality changes by more once it is known to be an old one.
        let hops = |number: u32| alternates(number) + if number > 930 { 3e-3 } else { 0.0 };
        let old = recoded(975, &hovers, &hops);
        assert!(goes_on_from(&old, 975), "{old:?}");
        // The camera continues.
        let is_back = |number: u32| number > 930;
        let back = |number: u32| {
            if is_back(number) { hovers(number) / 5.0 - 1.0 } else { alternates(number) }
        };
        let old = recoded(975, &hovers, &back);
        assert!(goes_on_from(&old, 931), "{old:?}");
        // A slow drift of the autopilot's height over a vehicle that stays is not a repetition.
        let drifts = |number: u32| 5.0 + 0.1 * f64::from(number) / 15.0;
        assert_eq!(recoded(3000, &drifts, &alternates), Vec::<u32>::new());
    }

    #[test]
    fn frames_that_come_late_do_not_hide_it() {
        let mut check = RepeatedPicture::default();
        let mut old = Vec::new();
        for number in 0..20 {
            for late_s in [0.0, 0.2] {
                let height_m = 5.0 - 0.1 * f64::from(number);
                let (seen, centre) = (Some(Point::new(0.3, -0.2, 5.0)), Pixel::new(0.0, 0.0));
                let frame = (number, late_s);
                old.push(is_repeated(&mut check, frame, &motion(height_m), seen, centre));
            }
        }
        let first = old.iter().position(|is_old| *is_old);
        assert_eq!(first, Some(4), "{old:?}");
        assert!(old.iter().skip(4).all(|is_old| *is_old), "{old:?}");
    }

    #[test]
    fn without_a_distance_a_direction_that_stays_while_the_vehicle_tilts_shows_an_old_picture() {
        let seen_old = |follows: bool| {
            let mut check = RepeatedPicture::default();
            (0..20)
                .filter(|&number| {
                    let tilt_rad = 0.005 * f64::from(number);
                    let motion = Motion {
                        ned_from_body: Rotation::from_euler(tilt_rad, 0.0, 0.0),
                        ..motion(5.0)
                    };
                    let moved_px = if follows { 1818.0 * libm::tan(tilt_rad) } else { 0.0 };
                    let centre = Pixel::new(700.0, 400.0 + moved_px);
                    is_repeated(&mut check, (number, 0.0), &motion, None, centre)
                })
                .collect::<Vec<u32>>()
        };
        assert_eq!(seen_old(true), Vec::<u32>::new());
        assert_eq!(seen_old(false), (5..20).collect::<Vec<_>>());
    }
}
