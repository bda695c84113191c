//! Implements the simulated autopilot's position controller (ArduPilot's `AC_PosControl` with its default gains): from a
//! commanded motion to tilt, thrust and heading.

use std::f64::consts::TAU;

use super::estimate::Estimate;
use super::parameters::{Parameter, Parameters};
use super::shaping::{Limits, Path, norm};
use crate::laws::{lag, square_root_law, wrap};
use crate::vehicle::{Demand, GRAVITY_M_S2, HeadingDemand};

/// Gains, named after ArduPilot's parameters where it has them.
#[derive(Clone, Debug, PartialEq)]
pub struct SteeringConfig {
    /// From position error to velocity (PSC_POSXY_P, PSC_POSZ_P), in 1/s.
    pub position_p: f64,
    /// From horizontal velocity error to acceleration (PSC_VELXY_P), in 1/s.
    pub velocity_xy_p: f64,
    /// Its integral (PSC_VELXY_I), in 1/s^2.
    pub velocity_xy_i: f64,
    /// Its derivative (PSC_VELXY_D).
    pub velocity_xy_d: f64,
    /// From vertical velocity error to acceleration (PSC_VELZ_P), in 1/s.
    pub velocity_z_p: f64,
    /// From vertical acceleration error to thrust per mass (PSC_ACCZ_P, through the hover throttle).
    pub acceleration_z_p: f64,
    /// Its integral (PSC_ACCZ_I), in 1/s.
    pub acceleration_z_i: f64,
    /// Corner frequency of the filters on velocity errors, in Hz.
    pub velocity_filter_hz: f64,
    /// Maximum tilt (ANGLE_MAX), in radians.
    pub lean_limit_rad: f64,
}

impl Default for SteeringConfig {
    fn default() -> Self {
        Self {
            position_p: 1.0,
            velocity_xy_p: 2.0,
            velocity_xy_i: 1.0,
            velocity_xy_d: 0.5,
            velocity_z_p: 5.0,
            // 0.5 and 1.0 per mille of throttle per cm/s^2, and 9.81 m/s^2 at the hover throttle of 0.39.
            acceleration_z_p: 1.26,
            acceleration_z_i: 2.51,
            velocity_filter_hz: 5.0,
            lean_limit_rad: 30.0f64.to_radians(),
        }
    }
}

/// Limits that the parameters set.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(super) struct Envelope {
    pub(super) level: Limits,
    pub(super) vertical: Limits,
    /// Speed above which a nose without an order turns into the direction of travel, in m/s.
    pub(super) follow_m_s: f64,
}

impl Envelope {
    pub(super) fn new(parameters: &Parameters) -> Self {
        let metres = |parameter| parameters.get(parameter) / 100.0;
        Self {
            level: Limits {
                acceleration: metres(Parameter::Acceleration),
                jerk: parameters.get(Parameter::JerkXy),
            },
            vertical: Limits {
                acceleration: metres(Parameter::AccelerationZ),
                jerk: parameters.get(Parameter::JerkZ),
            },
            follow_m_s: 0.05 * metres(Parameter::Speed),
        }
    }
}

/// The commanded motion.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(super) struct MotionCommand {
    /// North and east, in m/s.
    pub(super) velocity: [f64; 2],
    pub(super) vertical: VerticalCommand,
    pub(super) nose: HeadingCommand,
}

/// The commanded vertical motion.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(super) enum VerticalCommand {
    /// Move at this speed, in m/s downwards.
    Velocity(f64),
    /// Go to this height (as z, in metres downwards), with this maximum speed.
    Position(f64, f64),
}

/// The commanded heading.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(super) enum HeadingCommand {
    /// Turn into the direction of travel when it is fast enough.
    Follow,
    /// Point there, in radians from north to east.
    Angle(f64),
    /// Turn at this rate, in rad/s.
    Rate(f64),
}

/// The loop from horizontal velocity to acceleration, of one axis.
#[derive(Copy, Clone, Debug, Default)]
struct VelocityLoop {
    error: f64,
    slope: f64,
    integral: f64,
}

impl VelocityLoop {
    fn step(&mut self, dt_s: f64, error: f64, config: &SteeringConfig) -> f64 {
        let share = lag(dt_s, 1.0 / (TAU * config.velocity_filter_hz));
        let change = (error - self.error) * share;
        self.error += change;
        self.slope += (change / dt_s - self.slope) * share;
        self.integral =
            (self.integral + config.velocity_xy_i * self.error * dt_s).clamp(-10.0, 10.0);
        config.velocity_xy_p * self.error + self.integral + config.velocity_xy_d * self.slope
    }
}

/// The controller's memory.
#[derive(Clone, Debug)]
pub(super) struct Steering {
    config: SteeringConfig,
    level: Path<2>,
    depth: Path<1>,
    velocity_loops: [VelocityLoop; 2],
    depth_error: f64,
    thrust_integral: f64,
    heading: f64,
}

impl Steering {
    /// A controller that takes over a vehicle which moves like this.
    pub(super) fn start(config: SteeringConfig, now: &Estimate) -> Self {
        Self {
            config,
            level: Path::start(
                [now.position[0], now.position[1]],
                [now.velocity[0], now.velocity[1]],
                [0.0; 2],
            ),
            depth: Path::start([now.position[2]], [now.velocity[2]], [0.0]),
            velocity_loops: [VelocityLoop::default(); 2],
            depth_error: 0.0,
            thrust_integral: 0.0,
            heading: now.yaw,
        }
    }

    /// Restarts the path at the vehicle's position, and keeps the estimates of wind and weight.
    pub(super) fn restart(&mut self, now: &Estimate) {
        let velocity = [now.velocity[0], now.velocity[1]];
        self.level =
            Path::start([now.position[0], now.position[1]], velocity, self.level.acceleration);
        self.depth = Path::start([now.position[2]], [now.velocity[2]], self.depth.acceleration);
    }

    /// Moves the path along with an estimate that has been reset, by metres.
    pub(super) fn shift(&mut self, by: [f64; 2]) {
        for (position, by) in self.level.position.iter_mut().zip(by) {
            *position += by;
        }
    }

    /// Moves the path along with a vehicle that is put elsewhere, by metres.
    pub(super) fn carry(&mut self, [north, east, down]: [f64; 3]) {
        self.shift([north, east]);
        for position in &mut self.depth.position {
            *position += down;
        }
    }

    /// The wanted z and its rate, in metres and m/s.
    pub(super) fn depth(&self) -> [f64; 2] {
        [self.depth.position[0], self.depth.velocity[0]]
    }

    /// The demand that fulfils a wish.
    pub(super) fn steer(
        &mut self,
        dt_s: f64,
        now: &Estimate,
        motion: &MotionCommand,
        envelope: &Envelope,
    ) -> Demand {
        self.level.towards_velocity(dt_s, motion.velocity, envelope.level);
        match motion.vertical {
            VerticalCommand::Velocity(down) => {
                self.depth.towards_velocity(dt_s, [down], envelope.vertical);
            }
            VerticalCommand::Position(z, speed) => {
                self.depth.towards_position(dt_s, [z], speed, envelope.vertical);
            }
        }
        let [north, east] = self.level_acceleration(dt_s, now);
        let (sin, cos) = now.yaw.sin_cos();
        let forward = cos * north + sin * east;
        let right = cos * east - sin * north;
        let pitch = -(forward / GRAVITY_M_S2).atan();
        let roll = (right * pitch.cos() / GRAVITY_M_S2).atan();
        // The thrust is divided by the tilt's cosine, so that its vertical part is the commanded one.
        let upright = (now.roll.cos() * now.pitch.cos()).max(0.5);
        Demand {
            thrust_m_s2: (self.lift(dt_s, now, envelope.vertical.acceleration) / upright).max(0.0),
            roll_rad: roll,
            pitch_rad: pitch,
            heading: self.nose(dt_s, motion.nose, envelope.follow_m_s),
        }
    }

    fn level_acceleration(&mut self, dt_s: f64, now: &Estimate) -> [f64; 2] {
        let Path { position, velocity, acceleration } = self.level;
        let mut wanted = acceleration;
        for (i, (wanted, loop_)) in wanted.iter_mut().zip(&mut self.velocity_loops).enumerate() {
            let ahead = position[i] - now.position[i];
            let error = velocity[i] + self.config.position_p * ahead - now.velocity[i];
            *wanted += loop_.step(dt_s, error, &self.config);
        }
        let limit = GRAVITY_M_S2 * self.config.lean_limit_rad.tan();
        let size = norm(wanted);
        if size > limit { wanted.map(|a| a * limit / size) } else { wanted }
    }

    /// Upward force per mass, in m/s^2.
    fn lift(&mut self, dt_s: f64, now: &Estimate, limit: f64) -> f64 {
        let c = &self.config;
        let velocity = self.depth.velocity[0]
            + square_root_law(self.depth.position[0] - now.position[2], c.position_p, limit);
        let share = lag(dt_s, 1.0 / (TAU * c.velocity_filter_hz));
        self.depth_error += (velocity - now.velocity[2] - self.depth_error) * share;
        let wanted = self.depth.acceleration[0] + c.velocity_z_p * self.depth_error;
        let error = wanted - now.acceleration_z;
        self.thrust_integral = (self.thrust_integral + c.acceleration_z_i * error * dt_s)
            .clamp(-GRAVITY_M_S2, GRAVITY_M_S2);
        GRAVITY_M_S2 - c.acceleration_z_p * error - self.thrust_integral
    }

    fn nose(&mut self, dt_s: f64, nose: HeadingCommand, follow_m_s: f64) -> HeadingDemand {
        match nose {
            HeadingCommand::Rate(rate) => {
                self.heading = wrap(self.heading + rate * dt_s);
                HeadingDemand::Rate(rate)
            }
            HeadingCommand::Angle(angle) => {
                self.heading = angle;
                HeadingDemand::Angle(angle, 0.0)
            }
            HeadingCommand::Follow => {
                let [north, east] = self.level.velocity;
                let speed = north.hypot(east);
                if speed <= follow_m_s {
                    return HeadingDemand::Rate(0.0);
                }
                let [a_north, a_east] = self.level.acceleration;
                let rate = (north * a_east - east * a_north) / (speed * speed);
                self.heading = east.atan2(north);
                HeadingDemand::Angle(self.heading, rate)
            }
        }
    }
}
