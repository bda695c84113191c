//! Gives reports and takes commands without packets, for a caller in the same process.

use geometry::{Body, Ned, Point, Rotation, Vector};

use super::SimulatedAutopilot;
use super::flight::{Mode, Setpoint};
use super::steering::HeadingCommand;

/// The vehicle's motion as the autopilot estimates it.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct ReportedMotion {
    /// Position, in metres from the local origin.
    pub position: Point<Ned>,
    /// Velocity, in m/s.
    pub velocity: Vector<Ned>,
    /// Attitude.
    pub ned_from_body: Rotation<Ned, Body>,
}

impl SimulatedAutopilot {
    /// The estimated motion, as its messages report it.
    pub fn reported(&self) -> ReportedMotion {
        let estimate = &self.estimate;
        let [north, east, down] = estimate.position;
        let [vx, vy, vz] = estimate.velocity;
        ReportedMotion {
            position: Point::new(north, east, down),
            velocity: Vector::new(vx, vy, vz),
            ned_from_body: Rotation::from_euler(estimate.roll, estimate.pitch, estimate.yaw),
        }
    }

    /// Takes a velocity setpoint in m/s with a yaw rate in rad/s.
    pub fn set_velocity(&mut self, now_s: f64, velocity: Vector<Ned>, yaw_rate_rad_s: f64) {
        let velocity = [velocity.x(), velocity.y(), velocity.z()];
        self.queue_setpoint(
            now_s,
            Setpoint { velocity, nose: HeadingCommand::Rate(yaw_rate_rad_s) },
        );
    }

    /// Changes the flight mode.
    pub fn set_mode(&mut self, now_s: f64, mode: Mode) {
        self.flight.set_mode(now_s, mode, &self.estimate);
    }

    /// Stops the motors; false in the air.
    pub fn disarm(&mut self) -> bool {
        self.flight.disarm(false)
    }
}
