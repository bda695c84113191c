//! How often a place at which the marker was seen shows it, when a frame shows that place.
//!
//! Two places that both claim to be the pad are not told apart by the detections of one alone: one of them may just be out of
//! view, low over the ground or because the vehicle leans into the wind. So each is counted by the frames that show it: the pad
//! is where the marker is in most of those, and a place out of view keeps what it has earned, for a while.

use geometry::{Body, Camera, Odometry, Point, Rotation, Vector};

use crate::config::MAX_COUNTED_DETECTIONS;
use crate::event::FrameObservation;
use crate::history::Motion;
use crate::time::Timestamp;

/// Time constant with which frames that show the place are forgotten, in seconds.
const SHOWN_S: f64 = 2.0;

/// Time constant with which a place that no frame shows loses its standing, in seconds.
const UNSHOWN_S: f64 = 6.0;

/// A silence between two frames counts as this at most, in seconds.
const LONGEST_GAP_S: f64 = 0.2;

/// What of the image's edge is not taken for view: an angle in radians, and room for the marker in metres.
const RIM_RAD: f64 = 0.01;
const RIM_M: f64 = 0.1;

/// Part of the frames that must show more of one place than of the other for a change.
const MAJORITY: f64 = 0.2;

/// The record of one place.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Standing {
    /// Frames in which the marker was there, and frames that showed the place, the older the less.
    seen: f64,
    shown: f64,
    /// All detections there, those at the image's rim too, the older the less.
    sighted: f64,
    /// What is left of its standing after a time out of view.
    trust: f64,
    newest: Timestamp,
}

impl Standing {
    /// A place seen in one frame.
    pub(crate) fn new(stamp: Timestamp) -> Self {
        Self { seen: 1.0, shown: 1.0, sighted: 1.0, trust: 1.0, newest: stamp }
    }

    /// Counts a frame that showed the place or did not, with the marker there or not. At the image's rim, where a marker is
    /// found by chance, it only lasts.
    pub(crate) fn count(&mut self, stamp: Timestamp, is_shown: bool, is_seen: bool) {
        let gap_s = stamp.seconds_since(self.newest).clamp(0.0, LONGEST_GAP_S);
        self.newest = self.newest.max(stamp);
        let lasting = (-gap_s / UNSHOWN_S).exp();
        self.sighted = if is_seen {
            (self.sighted + 1.0).min(f64::from(MAX_COUNTED_DETECTIONS))
        } else {
            self.sighted * lasting
        };
        if !is_shown {
            self.trust = if is_seen { 1.0 } else { self.trust * lasting };
            return;
        }
        let kept = (-gap_s / SHOWN_S).exp();
        self.shown = self.shown * kept + 1.0;
        self.seen = self.seen * kept + f64::from(u8::from(is_seen));
        self.trust = 1.0;
    }

    /// The part of the frames showing the place in which the marker was there, from 0 to 1.
    pub(crate) fn share(&self) -> f64 {
        self.trust * self.seen / self.shown.max(1.0)
    }

    /// Detections at the place, the older the less.
    pub(crate) fn detections(&self) -> f64 {
        self.sighted
    }

    /// True when the marker is so clearly more often here than at the other place that this one is the pad.
    pub(crate) fn beats(&self, other: &Self) -> bool {
        self.share() > other.share() + MAJORITY
    }
}

/// What a camera shows.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct View {
    body_from_camera: Rotation<Body, Camera>,
    /// Half the angle of view to the right, and to the bottom, in radians.
    half_rad: [f64; 2],
}

impl View {
    /// What a frame's camera shows, when it is calibrated. One of which the mount is not known looks down, and only what
    /// is shown however it is turned counts.
    pub(crate) fn of(frame: &FrameObservation) -> Option<Self> {
        let focal_px = frame.focal_px.filter(|focal_px| *focal_px > 1.0)?;
        let (width, height) = frame.image_size;
        let half = |px: u32| (0.5 * f64::from(px) / focal_px).atan();
        let short = half(width.min(height));
        Some(frame.body_from_camera.map_or(
            Self { body_from_camera: Rotation::identity(), half_rad: [short; 2] },
            |body_from_camera| Self { body_from_camera, half_rad: [half(width), half(height)] },
        ))
    }

    /// True when a place in the vehicle's way is shown with a marker that lies there.
    pub(crate) fn shows(&self, place: Point<Odometry>, motion: &Motion) -> bool {
        let in_body: Vector<Body> =
            motion.odometry_from_body().inverse() * (place - motion.odometry);
        let seen = self.body_from_camera.inverse() * in_body;
        let is_inside = |aside_m: f64, half_rad: f64| {
            (aside_m.abs() + RIM_M).atan2(seen.z()) < half_rad - RIM_RAD
        };
        let [right_rad, bottom_rad] = self.half_rad;
        seen.z() > 0.0 && is_inside(seen.x(), right_rad) && is_inside(seen.y(), bottom_rad)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counted(frames: u32, shown: bool, seen: impl Fn(u32) -> bool) -> Standing {
        let mut standing = Standing::new(Timestamp::default());
        for i in 1..=frames {
            standing.count(Timestamp::from_seconds(f64::from(i) / 15.0), shown, seen(i));
        }
        standing
    }

    #[test]
    fn the_share_is_that_of_the_frames_that_show_the_place() {
        let third = counted(150, true, |i| i % 3 == 0);
        let rest = counted(150, true, |i| i % 3 != 0);
        assert!((third.share() - 0.33).abs() < 0.05 && (rest.share() - 0.67).abs() < 0.05);
        assert!(rest.beats(&third) && !third.beats(&rest));
    }

    #[test]
    fn out_of_view_a_place_keeps_its_standing_for_seconds() {
        let mut pad = counted(60, true, |_| true);
        let mut other = Standing::new(Timestamp::from_seconds(4.0));
        for i in 0..60 {
            let stamp = Timestamp::from_seconds(4.0 + f64::from(i) / 15.0);
            pad.count(stamp, false, false);
            other.count(stamp, true, i % 3 == 0);
        }
        assert!(pad.share() > 0.5 && !other.beats(&pad), "{pad:?}");
    }

    #[test]
    fn a_place_seen_for_minutes_is_forgotten_as_soon_as_one_seen_for_seconds() {
        let left_after_s = |frames: u32| {
            let mut place = counted(frames, true, |_| true);
            let begun_s = f64::from(frames) / 15.0;
            for i in 0..15 * 30 {
                let stamp = Timestamp::from_seconds(begun_s + f64::from(i) / 15.0);
                place.count(stamp, true, false);
            }
            place.detections()
        };
        assert!((left_after_s(15 * 600) - left_after_s(15 * 3)).abs() < 1e-6);
        assert!(left_after_s(15 * 600) < 0.5, "{}", left_after_s(15 * 600));
    }

    #[test]
    fn what_is_below_is_in_view_and_what_is_beside_is_not() {
        let motion = Motion {
            ned_from_body: Rotation::identity(),
            position: Point::origin(),
            velocity: Vector::zero(),
            odometry: Point::origin(),
            rate: Vector::zero(),
        };
        let frame = FrameObservation {
            stamp: Timestamp::default(),
            image_size: (1296, 972),
            focal_px: Some(1818.0),
            body_from_camera: None,
            marker: None,
        };
        let view = View::of(&frame).unwrap();
        assert!(view.shows(Point::new(0.5, 0.0, 3.0), &motion));
        assert!(!view.shows(Point::new(1.0, 0.0, 3.0), &motion));
        assert!(!view.shows(Point::new(0.0, 0.0, -3.0), &motion));
        let leaning = Motion { ned_from_body: Rotation::from_euler(0.0, 0.3, 0.0), ..motion };
        assert!(!view.shows(Point::new(-0.5, 0.0, 3.0), &leaning));
        // The image's longer side is along the body's y axis, then along its x axis.
        for (turn, [north, east]) in [(std::f64::consts::FRAC_PI_2, [0.0, 0.9]), (0.0, [0.9, 0.0])]
        {
            let mount = Rotation::from_euler(0.0, 0.0, turn);
            let view =
                View::of(&FrameObservation { body_from_camera: Some(mount), ..frame }).unwrap();
            assert!(view.shows(Point::new(north, east, 3.0), &motion));
            assert!(!view.shows(Point::new(east, north, 3.0), &motion));
        }
    }
}
