//! Simulates the pad's position and motion.

use std::f64::consts::TAU;

use geometry::{Marker, Ned, Point, Rotation, Transform, Vector};

/// How a pad lies and moves.
#[derive(Clone, Debug, PartialEq)]
pub struct PadConfig {
    /// Where it rests, in metres.
    pub position: Point<Ned>,
    /// Heading of the marker's upper edge, in radians from north to east.
    pub heading_rad: f64,
    /// Its constant velocity, in m/s.
    pub velocity: Vector<Ned>,
    /// Amplitude of its heave, in metres.
    pub heave_m: f64,
    /// Period of its heave, in seconds.
    pub heave_period_s: f64,
    /// How fast it turns, in rad/s.
    pub turn_rad_s: f64,
    /// Radius of the deck about it that moves with it and carries a vehicle, in metres.
    pub deck_m: f64,
}

impl Default for PadConfig {
    fn default() -> Self {
        Self {
            position: Point::new(1.5, -1.5, 0.0),
            heading_rad: 0.0,
            velocity: Vector::zero(),
            heave_m: 0.0,
            heave_period_s: 6.0,
            turn_rad_s: 0.0,
            deck_m: 1.0,
        }
    }
}

/// A pad at one moment.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct PadState {
    /// Where its middle is, in metres.
    pub position: Point<Ned>,
    /// Velocity of its middle, in m/s.
    pub velocity: Vector<Ned>,
    /// Heading of the marker's upper edge, in radians from north to east.
    pub heading_rad: f64,
    /// How fast it turns, in rad/s.
    pub turn_rad_s: f64,
}

impl PadConfig {
    /// The pad after it has moved for this time, in seconds; `None` before it starts.
    pub fn at(&self, moved_s: Option<f64>) -> PadState {
        let Some(moved_s) = moved_s else {
            return PadState {
                position: self.position,
                velocity: Vector::zero(),
                heading_rad: self.heading_rad,
                turn_rad_s: 0.0,
            };
        };
        let pace = TAU / self.heave_period_s.max(1e-3);
        let (sin, cos) = (pace * moved_s).sin_cos();
        let heave = Vector::new(0.0, 0.0, self.heave_m * sin);
        PadState {
            position: self.position + self.velocity * moved_s + heave,
            velocity: self.velocity + Vector::new(0.0, 0.0, self.heave_m * pace * cos),
            heading_rad: self.heading_rad + self.turn_rad_s * moved_s,
            turn_rad_s: self.turn_rad_s,
        }
    }
}

impl PadState {
    /// The pose of a marker that lies face up in the pad's middle.
    pub fn ned_from_marker(&self) -> Transform<Ned, Marker> {
        let heading = self.heading_rad + std::f64::consts::FRAC_PI_2;
        let rotation = Rotation::from_euler(std::f64::consts::PI, 0.0, heading);
        Transform::new(rotation, self.position)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pads_motion_matches_its_velocity() {
        let pad = PadConfig {
            velocity: Vector::new(3.0, -2.0, 0.0),
            heave_m: 0.3,
            turn_rad_s: 0.2,
            ..PadConfig::default()
        };
        assert_eq!(pad.at(None).position, pad.position);
        for moved_s in [0.0, 0.7, 4.1] {
            let (before, after) = (pad.at(Some(moved_s)), pad.at(Some(moved_s + 1e-6)));
            let difference = (after.position - before.position) * 1e6 - before.velocity;
            assert!(difference.norm() < 1e-4, "{difference:?}");
            assert!((after.heading_rad - before.heading_rad - 0.2e-6).abs() < 1e-12);
        }
    }

    #[test]
    fn the_marker_lies_face_up_with_its_upper_edge_towards_the_heading() {
        let pad = PadConfig { heading_rad: 0.4, ..PadConfig::default() }.at(None);
        let turn = pad.ned_from_marker().rotation();
        let axis = |x, y, z| turn * Vector::<Marker>::new(x, y, z);
        assert!((axis(0.0, 0.0, 1.0) - Vector::new(0.0, 0.0, -1.0)).norm() < 1e-12);
        let up = axis(0.0, 1.0, 0.0);
        assert!((up.y().atan2(up.x()) - 0.4).abs() < 1e-12, "{up:?}");
    }
}
