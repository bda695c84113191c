//! The search for the marker: an expanding square about the place where the search started.
//!
//! A camera that is fixed to the vehicle looks downwind, because the vehicle tilts into the wind: a marker
//! right below may be out of view, upwind of the image. So the first leg goes upwind.

use geometry::{Body, Ned, Rotation, Vector};
use libm::{atan2, fmax, fmin, sin, sincos};

use crate::config::PhaseConfig;

/// Minimum tilt that shows the direction of the wind, in radians.
const MIN_TILT_RAD: f64 = 0.02;

/// The direction of the first leg, in radians from north to east: the one into which the vehicle tilts.
pub fn first_leg_rad(ned_from_body: Rotation<Ned, Body>) -> f64 {
    let up = ned_from_body * Vector::<Body>::new(0.0, 0.0, -1.0);
    if up.horizontal_norm() < sin(MIN_TILT_RAD) { 0.0 } else { atan2(up.y(), up.x()) }
}

/// Distance upwind that the camera must fly to see the ground below the vehicle, in metres: the distance from
/// that ground to the centre of the image, at most `search_radius_m`.
pub fn upwind_m(config: &PhaseConfig, ned_from_body: Rotation<Ned, Body>, height_m: f64) -> f64 {
    let down = ned_from_body * Vector::<Body>::new(0.0, 0.0, 1.0);
    let offset_m = fmax(height_m, 0.0) * down.horizontal_norm() / fmax(down.z(), 0.5);
    if offset_m < MIN_TILT_RAD * height_m { 0.0 } else { fmin(offset_m, config.search_radius_m) }
}

/// The velocity at a time after the square started, in m/s: `upwind_m` along the first leg, then legs of 1,
/// 1, 2, 2, 3, 3, ... spacings, each to the right of the one before; zero once the radius is reached.
pub fn velocity(
    config: &PhaseConfig,
    elapsed_s: f64,
    first_leg_rad: f64,
    upwind_m: f64,
) -> Vector<Ned> {
    let mut flown_m = elapsed_s * config.search_speed_m_s;
    if flown_m.is_nan() || flown_m < 0.0 {
        return Vector::zero();
    }
    let (east, north) = sincos(first_leg_rad);
    if flown_m < upwind_m {
        return Vector::new(north, east, 0.0) * config.search_speed_m_s;
    }
    flown_m -= upwind_m;
    // Four legs are one round, each round one spacing farther out; one more leg closes the last round.
    let spacing_m = fmin(config.search_spacing_m, config.search_radius_m);
    let rounds = (config.search_radius_m / spacing_m).floor() as u32;
    for leg in 1..=4 * rounds + 1 {
        let spacings = if leg > 4 * rounds { 2 * rounds } else { leg.div_ceil(2) };
        let length_m = spacing_m * f64::from(spacings);
        if flown_m < length_m {
            let direction = first_leg_rad + f64::from(leg - 1) * std::f64::consts::FRAC_PI_2;
            let (east, north) = sincos(direction);
            return Vector::new(north, east, 0.0) * config.search_speed_m_s;
        }
        flown_m -= length_m;
    }
    Vector::zero()
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::Point;

    #[test]
    fn the_square_covers_its_radius_and_does_not_leave_it() {
        let config = PhaseConfig::default();
        let (mut place, mut path) = (Point::<Ned>::origin(), Vec::new());
        let dt_s = 0.02;
        for i in 0..(config.search_timeout_s / dt_s) as u32 {
            place = place + velocity(&config, f64::from(i) * dt_s, 0.7, 0.0) * dt_s;
            path.push(place);
        }
        let farthest = path.iter().map(|p| p.x().hypot(p.y())).fold(0.0, f64::max);
        assert!(farthest <= config.search_radius_m * std::f64::consts::SQRT_2 + 0.1, "{farthest}");
        // Every point within the square is within the spacing of the path.
        let reach = config.search_radius_m - 0.5 * config.search_spacing_m;
        for (x, y) in
            [(0.0, 0.0), (reach, 0.0), (0.0, reach), (-reach, 0.0), (0.0, -reach), (2.5, -3.5)]
        {
            let nearest =
                path.iter().map(|p| (p.x() - x).hypot(p.y() - y)).fold(f64::MAX, f64::min);
            assert!(nearest < config.search_spacing_m, "({x}, {y}) is {nearest} m from the path");
        }
        assert!(velocity(&config, 1e9, 0.0, 3.0).norm() < 1e-12, "it ends");
        assert!(velocity(&config, f64::NAN, 0.0, 0.0).norm() < 1e-12);
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
