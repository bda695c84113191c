//! Measures which quantities a flight makes observable.
//!
//! Each quantity needs a motion of its own (Yang, Geneva, Eckenhoff, Huang, 2019). Without it the autopilot's errors alone look
//! like that motion. As they are in the prediction as well as in its derivatives, an estimate would follow them, even with a
//! small deviation (errors in variables; Fuller, "Measurement error models", 1987). Quantities that were not excited are
//! therefore not estimated.

use geometry::squared;

use super::model::Model;
use super::quantity::Quantity;

/// How a vehicle moved while it saw the pad.
#[derive(Copy, Clone, Debug, Default, PartialEq)]
pub struct Excitation {
    /// Standard deviation of its tilt about its mean, in radians.
    pub tilt_rad: f64,
    /// The farthest over the nearest distance to the pad.
    pub distance_ratio: f64,
    /// From the heading farthest to the left to that farthest to the right, in radians.
    pub turn_rad: f64,
}

/// The tilt that shows time offset and mount yaw: ten times the error of an autopilot's attitude. The focal length needs more
/// ([`Excitation::attenuation`]).
const MIN_TILT_RAD: f64 = 0.5 * std::f64::consts::PI / 180.0;
/// By how much more errors of the attitude count than their variance, as the position's drift explains slow tilts away. Focal
/// lengths came out too short by 2.5 to 3.2 times that part in flights of the tests with tilts from 0.5 to 2 degrees, by about
/// once in simulated landings; this is between, as a deviation.
const SLOW_TILTS: f64 = 2.0;
/// Distances or headings that show the mount's roll and pitch.
const MIN_DISTANCE_RATIO: f64 = 1.5;
const MIN_TURN_RAD: f64 = 0.5;

impl Excitation {
    pub(super) fn of(model: &Model<'_>) -> Self {
        let mut tilts = [Moments::default(); 2];
        let (mut nearest, mut farthest) = (f64::INFINITY, 0.0);
        let mut heading = Heading::default();
        for (distance_m, pose) in model.sights() {
            let (roll, pitch, yaw) = pose.ned_from_body.euler();
            tilts[0].add(roll);
            tilts[1].add(pitch);
            heading.add(yaw);
            nearest = libm::fmin(nearest, distance_m);
            farthest = libm::fmax(farthest, distance_m);
        }
        let [roll, pitch] = tilts.map(|tilt| tilt.variance());
        Self {
            tilt_rad: (roll + pitch).sqrt(),
            distance_ratio: if farthest > 0.0 { farthest / nearest } else { 1.0 },
            turn_rad: heading.right - heading.left,
        }
    }

    /// The part by which the focal length seems too short when roll and pitch err by this standard deviation each, in radians. The
    /// image shows the true tilt alone, so it is the errors' part in the variance of the estimated tilts (attenuation; Fuller,
    /// section 1.1), times the effect of the position's drift.
    pub fn attenuation(&self, lean_rad: f64) -> f64 {
        let part = 2.0 * squared(lean_rad / self.tilt_rad);
        if lean_rad > 0.0 { SLOW_TILTS * part } else { 0.0 }
    }

    /// Whether the motion can show a quantity.
    pub fn shows(&self, quantity: Quantity) -> bool {
        match quantity {
            Quantity::MountRoll | Quantity::MountPitch => {
                self.distance_ratio >= MIN_DISTANCE_RATIO || self.turn_rad >= MIN_TURN_RAD
            }
            Quantity::TimeOffset | Quantity::MountYaw | Quantity::FocalScale | Quantity::K1 => {
                self.tilt_rad >= MIN_TILT_RAD
            }
        }
    }
}

/// Sums for a variance.
#[derive(Copy, Clone, Default)]
struct Moments {
    count: f64,
    mean: f64,
    squares: f64,
}

impl Moments {
    fn add(&mut self, value: f64) {
        self.count += 1.0;
        let apart = value - self.mean;
        self.mean += apart / self.count;
        self.squares += apart * (value - self.mean);
    }

    fn variance(&self) -> f64 {
        if self.count > 1.0 { self.squares / self.count } else { 0.0 }
    }
}

/// Headings without their jumps at south.
#[derive(Copy, Clone, Default)]
struct Heading {
    before: Option<f64>,
    total: f64,
    left: f64,
    right: f64,
}

impl Heading {
    fn add(&mut self, yaw: f64) {
        let apart = self.before.replace(yaw).map_or(0.0, |before| yaw - before);
        let turn = 2.0 * std::f64::consts::PI;
        self.total += apart - turn * libm::round(apart / turn);
        self.left = libm::fmin(self.left, self.total);
        self.right = libm::fmax(self.right, self.total);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_focal_length_is_shortened_by_the_square_of_the_attitudes_errors() {
        let excitation = Excitation { tilt_rad: 0.02, ..Excitation::default() };
        assert!((excitation.attenuation(0.002) - 0.02 * SLOW_TILTS).abs() < 1e-12);
        assert_eq!(Excitation::default().attenuation(0.0), 0.0);
        assert_eq!(Excitation::default().attenuation(0.001), f64::INFINITY);
    }

    #[test]
    fn a_turn_over_south_is_continuous() {
        let mut heading = Heading::default();
        for i in 0..40 {
            let yaw = 0.1 * f64::from(i);
            heading.add(libm::atan2(libm::sin(yaw), libm::cos(yaw)));
        }
        assert!((heading.right - heading.left - 3.9).abs() < 1e-9, "{}", heading.right);
    }

    #[test]
    fn the_variance_is_that_of_the_numbers() {
        let mut moments = Moments::default();
        [1e6, 1e6 + 2.0, 1e6 + 4.0].into_iter().for_each(|value| moments.add(value));
        assert!((moments.variance() - 8.0 / 3.0).abs() < 1e-6);
    }
}
