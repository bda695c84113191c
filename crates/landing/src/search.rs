//! Flies the search for the marker: an expanding square about the position where the search started, flown along its
//! lines over the ground in wind as well.
//!
//! A camera that is fixed to the vehicle looks downwind, because the vehicle tilts into the wind: a marker
//! right below may be out of view, upwind of the image. So the first leg is flown upwind.

use geometry::{Body, Ned, Odometry, Point, Rotation, Vector};
use libm::{atan2, fmax, fmin, sin, sincos};

use crate::config::{Config, PhaseConfig};
use crate::hover::back;
use crate::time::Timestamp;

/// Minimum tilt that shows the direction of the wind, in radians.
const MIN_TILT_RAD: f64 = 0.02;

/// Distance of the vehicle from the point that moves along the square, from which that point slows down, and at which it would stand, in
/// metres.
const SLOW_LAG_M: f64 = 1.0;
const MAX_LAG_M: f64 = 2.0;

/// Minimum speed of that point, as a fraction of the square's: a vehicle that does not get through the wind must see the other sides, too.
const MIN_PACE: f64 = 0.25;

/// Longest time over which that point moves on at once, in seconds.
const MAX_STEP_S: f64 = 0.2;

/// An expanding square that is being flown: `upwind_m` into the wind, then legs of 1, 1, 2, 2, 3, 3, ... spacings, each to the right of
/// the one before. A point moves along it, which the vehicle follows.
#[derive(Copy, Clone, Debug)]
pub struct Square {
    /// Speed along it, in m/s.
    speed_m_s: f64,
    /// Direction of the first leg, in radians from north to east.
    first_leg_rad: f64,
    /// Where it begins.
    centre: Point<Odometry>,
    /// Distance upwind before the first leg, in metres.
    upwind_m: f64,
    /// Number of the leg of the point that moves along the square, 0 for the way upwind, and where that leg begins.
    leg: u32,
    corner: Point<Odometry>,
    /// The way of that point along its leg, in metres.
    along_m: f64,
    /// When it was last moved on.
    moved: Timestamp,
}

impl Square {
    /// A square about `centre`, into the wind that the attitude shows, at `search_speed_m_s` or the speed that the vehicle may have.
    pub fn new(
        config: &Config,
        now: Timestamp,
        centre: Point<Odometry>,
        ned_from_body: Rotation<Ned, Body>,
        height_m: f64,
    ) -> Self {
        Self {
            speed_m_s: fmin(config.phases.search_speed_m_s, config.envelope.horizontal_m_s),
            first_leg_rad: first_leg_rad(ned_from_body),
            centre,
            upwind_m: upwind_m(&config.phases, ned_from_body, height_m),
            leg: 0,
            corner: centre,
            along_m: 0.0,
            moved: now,
        }
    }

    /// The position about which it is flown.
    pub fn centre(&self) -> Point<Odometry> {
        self.centre
    }

    /// It is flown again from its centre on.
    pub fn begin_again(&mut self) {
        (self.leg, self.corner, self.along_m) = (0, self.centre, 0.0);
    }

    /// The velocity of a vehicle at `position`, in m/s, at most twice the speed along the square; at the end of the last leg it stays
    /// there.
    pub fn velocity(&self, config: &PhaseConfig, position: Point<Odometry>) -> Vector<Ned> {
        let onwards = match self.length_m(config) {
            Some(_) => self.direction() * (self.speed_m_s * self.pace(position)),
            None => Vector::zero(),
        };
        Vector::from_coords(onwards.coords) + back(self.lag(position), self.speed_m_s)
    }

    /// Moves its point on until `now`, the slower the farther the vehicle is from it, but not for one whose fence keeps it from following.
    pub fn move_on(
        &mut self,
        config: &PhaseConfig,
        now: Timestamp,
        position: Point<Odometry>,
        is_fenced: bool,
    ) {
        let after_s = now.seconds_since(self.moved).clamp(0.0, MAX_STEP_S);
        self.moved = now;
        let pace = if is_fenced { 1.0 } else { self.pace(position) };
        self.along_m += self.speed_m_s * after_s * pace;
        while let Some(length_m) = self.length_m(config)
            && self.along_m >= length_m
        {
            self.corner = self.corner + self.direction() * length_m;
            self.along_m -= length_m;
            self.leg += 1;
        }
        if self.length_m(config).is_none() {
            self.along_m = 0.0;
        }
    }

    /// The fraction of the speed at which the square's point moves for a vehicle at `position`.
    fn pace(&self, position: Point<Odometry>) -> f64 {
        let lag_m = self.lag(position).horizontal_norm();
        ((MAX_LAG_M - lag_m) / (MAX_LAG_M - SLOW_LAG_M)).clamp(MIN_PACE, 1.0)
    }

    /// From the vehicle to the square's point, horizontally.
    fn lag(&self, position: Point<Odometry>) -> Vector<Odometry> {
        let offset = self.corner + self.direction() * self.along_m - position;
        Vector::new(offset.x(), offset.y(), 0.0)
    }

    /// The direction of the present leg.
    fn direction(&self) -> Vector<Odometry> {
        let turns = f64::from(self.leg.saturating_sub(1) % 4);
        let (east, north) = sincos(self.first_leg_rad + turns * std::f64::consts::FRAC_PI_2);
        Vector::new(north, east, 0.0)
    }

    /// The length of the present leg in metres; `None` after the last.
    fn length_m(&self, config: &PhaseConfig) -> Option<f64> {
        if self.leg == 0 {
            return Some(self.upwind_m);
        }
        // Four legs are one round, each round one spacing farther out; one more leg closes the last round.
        let spacing_m = fmin(config.search_spacing_m, config.search_radius_m);
        let rounds = (config.search_radius_m / spacing_m).floor() as u32;
        if self.leg > 4 * rounds + 1 {
            return None;
        }
        let spacings = if self.leg > 4 * rounds { 2 * rounds } else { self.leg.div_ceil(2) };
        Some(spacing_m * f64::from(spacings))
    }
}

/// The direction of the first leg, in radians from north to east: the one into which the vehicle tilts.
fn first_leg_rad(ned_from_body: Rotation<Ned, Body>) -> f64 {
    let up = -ned_from_body.down_axis();
    if up.horizontal_norm() < sin(MIN_TILT_RAD) { 0.0 } else { atan2(up.y(), up.x()) }
}

/// Distance upwind that the camera must fly to see the ground below the vehicle, in metres: the distance from
/// that ground to the centre of the image, at most `search_radius_m`.
fn upwind_m(config: &PhaseConfig, ned_from_body: Rotation<Ned, Body>, height_m: f64) -> f64 {
    let down = ned_from_body.down_axis();
    let offset_m = fmax(height_m, 0.0) * down.horizontal_norm() / fmax(down.z(), 0.5);
    if offset_m < MIN_TILT_RAD * height_m { 0.0 } else { fmin(offset_m, config.search_radius_m) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Flies the square from the origin in a wind that carries the vehicle away at this velocity; it takes half a second to fly as
    /// commanded.
    fn fly(config: &Config, wind: Vector<Ned>) -> Vec<Point<Odometry>> {
        let (begin, phases) = (Timestamp::from_seconds(5.0), &config.phases);
        let mut square = Square::new(config, begin, Point::origin(), Rotation::identity(), 5.0);
        let (mut position, mut flown, mut path) = (Point::origin(), Vector::zero(), Vec::new());
        let dt_s = 0.02;
        for i in 0..(phases.search_timeout_s / dt_s) as u32 {
            let now = begin.plus_seconds(f64::from(i) * dt_s);
            square.move_on(phases, now, position, false);
            let velocity = square.velocity(phases, position);
            assert!(velocity.norm() <= 2.0 * phases.search_speed_m_s + 1e-9, "{velocity:?}");
            flown = flown + (velocity - flown) * (dt_s / 0.5);
            position = position + Vector::from_coords((flown + wind).coords) * dt_s;
            path.push(position);
        }
        path
    }

    /// The greatest distance from the origin, in metres.
    fn farthest_m(path: &[Point<Odometry>]) -> f64 {
        path.iter().map(|position| position.x().hypot(position.y())).fold(0.0, f64::max)
    }

    #[test]
    fn the_square_covers_its_radius_and_does_not_leave_it_in_wind() {
        let config = Config::default();
        let radius_m = config.phases.search_radius_m;
        let spacing_m = config.phases.search_spacing_m;
        for (north, east) in [(0.0, 0.0), (0.2, 0.0), (-0.3, 0.1), (0.0, -0.4), (0.3, 0.3)] {
            let path = fly(&config, Vector::new(north, east, 0.0));
            let limit_m = radius_m * std::f64::consts::SQRT_2 + 1.0;
            assert!(farthest_m(&path) <= limit_m, "{north} {east}: {}", farthest_m(&path));
            // Every point within the square is within the spacing of the path.
            let extent = radius_m - 0.5 * spacing_m;
            for (x, y) in [
                (0.0, 0.0),
                (extent, 0.0),
                (0.0, extent),
                (-extent, 0.0),
                (0.0, -extent),
                (2.5, -3.5),
            ] {
                let nearest =
                    path.iter().map(|p| (p.x() - x).hypot(p.y() - y)).fold(f64::MAX, f64::min);
                assert!(
                    nearest < spacing_m,
                    "({x}, {y}) is {nearest} m from the path in wind of {north}, {east}"
                );
            }
        }
    }

    #[test]
    fn a_wind_that_is_nearly_as_fast_as_the_search_carries_no_vehicle_away() {
        let config = Config::default();
        let limit_m = config.phases.search_radius_m * std::f64::consts::SQRT_2 + MAX_LAG_M;
        for turn in 0..16 {
            let (east, north) = sincos(f64::from(turn) * std::f64::consts::FRAC_PI_8);
            for wind_m_s in [0.5, 0.7, 0.8] {
                let path = fly(&config, Vector::new(north, east, 0.0) * wind_m_s);
                let farthest_m = farthest_m(&path);
                assert!(farthest_m <= limit_m, "{wind_m_s} m/s, {turn}: {farthest_m} m");
            }
        }
    }

    #[test]
    fn a_vehicle_that_may_not_be_as_fast_flies_the_same_square_slower() {
        let mut config = Config::default();
        config.envelope.horizontal_m_s = 0.2;
        let mut slow = Square::new(
            &config,
            Timestamp::from_seconds(0.0),
            Point::origin(),
            Rotation::identity(),
            5.0,
        );
        let velocity = slow.velocity(&config.phases, Point::origin());
        assert!((velocity.norm() - 0.2).abs() < 1e-12, "{velocity:?}");
        slow.move_on(&config.phases, Timestamp::from_seconds(0.1), Point::origin(), false);
        assert!((slow.along_m - 0.02).abs() < 1e-12, "{}", slow.along_m);
    }

    #[test]
    fn it_ends_where_its_last_leg_ends_and_stays() {
        let mut config = Config::default();
        config.phases.search_timeout_s = 120.0;
        let path = fly(&config, Vector::zero());
        let [before, last] = [path[path.len() - 500], path[path.len() - 1]];
        assert!((last - before).norm() < 0.01, "{before:?} {last:?}");
        config.phases.search_radius_m = 0.0;
        let path = fly(&config, Vector::new(0.1, 0.0, 0.0));
        assert!(path.iter().all(|position| (*position - Point::origin()).norm() < 0.3), "it holds");
    }

    #[test]
    fn a_vehicle_that_cannot_follow_still_sees_the_other_sides() {
        let config = Config::default();
        // The first leg is flown north and the third south.
        let goes_south_after_s = |is_fenced: bool| {
            let begin = Timestamp::from_seconds(0.0);
            let mut square =
                Square::new(&config, begin, Point::origin(), Rotation::identity(), 5.0);
            (1..6000).map(|hundredths| 0.01 * f64::from(hundredths)).find(|seconds| {
                let now = Timestamp::from_seconds(*seconds);
                square.move_on(&config.phases, now, Point::new(-30.0, 0.0, 0.0), is_fenced);
                square.leg >= 3
            })
        };
        assert!(goes_south_after_s(false).is_some_and(|seconds| seconds < 20.0));
        assert!(goes_south_after_s(true).is_some_and(|seconds| seconds < 5.0));
    }

    #[test]
    fn the_first_leg_goes_into_the_wind() {
        // Nose down at heading east: it tilts eastwards.
        let tilts_east = Rotation::<Ned, Body>::from_euler(0.0, -0.2, std::f64::consts::FRAC_PI_2);
        assert!((first_leg_rad(tilts_east) - std::f64::consts::FRAC_PI_2).abs() < 1e-9);
        assert!(first_leg_rad(Rotation::identity()).abs() < 1e-12);
        let config = PhaseConfig::default();
        assert!((upwind_m(&config, tilts_east, 10.0) - 10.0 * 0.2f64.tan()).abs() < 1e-9);
        assert_eq!(upwind_m(&config, tilts_east, 100.0), config.search_radius_m);
        assert_eq!(upwind_m(&config, Rotation::identity(), 10.0), 0.0);
    }
}
