//! An autopilot that answers velocity setpoints and LAND as ArduPilot Copter 4.5 was measured to do: an estimator with
//! errors, a path within limits of acceleration and jerk (`AC_PosControl`), and the loops that follow it.

use std::collections::VecDeque;

use geometry::{Body, Ned, Point, Rotation, Vector};
use landing::{Landed, Mode, Timestamp, VehicleState};
use rand_chacha::ChaCha8Rng;

use super::chance::{Drift, lag, normal, square_root_law, stream};
use super::multirotor::{Demand, GRAVITY, Multirotor};

/// Limits of the path, horizontally and vertically, in m/s^2 and m/s^3.
const LEVEL: [f64; 2] = [2.5, 5.0];
const VERTICAL: [f64; 2] = [1.0, 5.0];
/// LAND below 10 m, in m/s.
const LAND_SPEED: f64 = 0.5;
/// A setpoint is flown so long, in seconds.
const SETPOINT_TIMEOUT_S: f64 = 3.0;

/// How wrong the estimator is; 1 is as seen in real logs.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Estimator {
    /// Of everything below.
    pub(crate) scale: f64,
    /// The estimate's position moves away from the truth at this velocity, in m/s.
    pub(crate) gnss_drift: [f64; 2],
    /// The position estimate jumps northwards by so many metres at this time.
    pub(crate) gnss_jump: Option<(f64, f64)>,
}

impl Estimator {
    pub(crate) const USUAL: Self = Self { scale: 1.0, gnss_drift: [0.0; 2], gnss_jump: None };
    pub(crate) const PERFECT: Self = Self { scale: 0.0, ..Self::USUAL };
}

/// What is believed of the motion.
#[derive(Copy, Clone, Debug)]
struct Belief {
    position: [f64; 3],
    velocity: [f64; 3],
    acceleration_z: f64,
    roll: f64,
    pitch: f64,
    yaw: f64,
    /// Believed minus true.
    lean_error: [f64; 2],
}

/// A smooth motion.
#[derive(Copy, Clone, Debug)]
struct Path<const N: usize> {
    position: [f64; N],
    velocity: [f64; N],
    acceleration: [f64; N],
}

impl<const N: usize> Path<N> {
    fn towards(&mut self, dt_s: f64, wanted: [f64; N], [acceleration, jerk]: [f64; 2]) {
        let error: [f64; N] = std::array::from_fn(|i| wanted[i] - self.velocity[i]);
        let size = norm(&error);
        let rate =
            square_root_law(size, jerk / acceleration, jerk).min(acceleration).min(size / dt_s);
        let share = if size > 0.0 { rate / size } else { 0.0 };
        let change: [f64; N] = std::array::from_fn(|i| error[i] * share - self.acceleration[i]);
        let limited = (jerk * dt_s / norm(&change).max(1e-12)).min(1.0);
        for (i, change) in change.into_iter().enumerate() {
            self.position[i] += (self.velocity[i] + 0.5 * self.acceleration[i] * dt_s) * dt_s;
            self.velocity[i] += self.acceleration[i] * dt_s;
            self.acceleration[i] += change * limited;
        }
    }
}

fn norm(v: &[f64]) -> f64 {
    v.iter().map(|c| c * c).sum::<f64>().sqrt()
}

/// The autopilot.
pub(crate) struct Autopilot {
    estimator: Estimator,
    random: ChaCha8Rng,
    velocity_bias: [f64; 2],
    velocity_drift: [Drift; 2],
    position_drift: [Drift; 3],
    position_noise: [Drift; 2],
    lean_bias: [f64; 2],
    lean_drift: [Drift; 2],
    heading_bias: f64,
    height_error: f64,
    belief: Belief,
    level: Path<2>,
    depth: Path<1>,
    /// Error, slope and integral of the horizontal velocity loops.
    loops: [[f64; 3]; 2],
    depth_error: f64,
    thrust_integral: f64,
    pub(crate) mode: Mode,
    arriving: VecDeque<(f64, Packet)>,
    setpoint: (f64, Vector<Ned>, f64),
    refuses_land: bool,
    /// From sending a packet to its effect, in seconds.
    link_s: f64,
    pub(crate) land_s: Option<f64>,
    pub(crate) touchdown_s: Option<f64>,
    pub(crate) disarm_s: Option<f64>,
}

#[derive(Copy, Clone, Debug)]
pub(crate) enum Packet {
    Velocity(Vector<Ned>, f64),
    Land,
    Guided,
    Disarm,
}

impl Autopilot {
    pub(crate) fn new(
        estimator: Estimator,
        vehicle: &Multirotor,
        (refuses_land, link_s): (bool, f64),
        seed: u64,
    ) -> Self {
        let mut random = stream(seed, 3);
        let scale = estimator.scale;
        let draw = &mut random;
        let velocity_bias = [(); 2].map(|()| 0.015 * scale * normal(draw));
        let velocity_drift = [(); 2].map(|()| Drift::new(0.006 * scale, 1.0, draw));
        let position_drift = [0.012, 0.012, 0.02].map(|size| Drift::new(size * scale, 1.0, draw));
        let position_noise = [(); 2].map(|()| Drift::new(0.005 * scale, 1.0, draw));
        let lean_bias = [(); 2].map(|()| 0.13f64.to_radians() * scale * normal(draw));
        let lean_drift = [(); 2].map(|()| Drift::new(0.05f64.to_radians() * scale, 1.0, draw));
        let heading_bias = 0.7f64.to_radians() * scale * normal(draw);
        let (p, v) = (vehicle.position, vehicle.velocity);
        let (roll, pitch, yaw) = vehicle.ned_from_body().euler();
        let belief = Belief {
            position: [p.x(), p.y(), p.z()],
            velocity: [v.x(), v.y(), v.z()],
            acceleration_z: 0.0,
            roll,
            pitch,
            yaw,
            lean_error: [0.0; 2],
        };
        Self {
            estimator,
            random,
            velocity_bias,
            velocity_drift,
            position_drift,
            position_noise,
            lean_bias,
            lean_drift,
            heading_bias,
            height_error: 0.04 * scale * p.z(),
            belief,
            level: Path { position: [p.x(), p.y()], velocity: [0.0; 2], acceleration: [0.0; 2] },
            depth: Path { position: [p.z()], velocity: [0.0], acceleration: [0.0] },
            loops: [[0.0; 3]; 2],
            depth_error: 0.0,
            thrust_integral: 0.0,
            mode: Mode::Guided,
            arriving: VecDeque::new(),
            setpoint: (0.0, Vector::zero(), 0.0),
            refuses_land,
            link_s,
            land_s: None,
            touchdown_s: None,
            disarm_s: None,
        }
    }

    /// A packet that is sent now.
    pub(crate) fn send(&mut self, now_s: f64, packet: Packet) {
        if self.arriving.len() < 100 {
            self.arriving.push_back((now_s + self.link_s, packet));
        }
    }

    /// Its telemetry now, stamped with `stamp_s`.
    pub(crate) fn state(&self, stamp_s: f64) -> VehicleState {
        let b = &self.belief;
        let since = |at: Option<f64>, s: f64| at.is_some_and(|at| stamp_s > at + s);
        let sure_s = if self.mode == Mode::Land { 1.65 } else { 2.0 };
        let landed = match self.mode {
            _ if since(self.touchdown_s, sure_s) => Landed::OnGround,
            Mode::Land => Landed::Landing,
            Mode::Guided | Mode::Other => Landed::InAir,
        };
        VehicleState {
            stamp: Timestamp::from_seconds(stamp_s),
            ned_from_body: Rotation::<Ned, Body>::from_euler(b.roll, b.pitch, b.yaw),
            position: Point::new(b.position[0], b.position[1], b.position[2]),
            velocity: Vector::new(b.velocity[0], b.velocity[1], b.velocity[2]),
            mode: self.mode,
            armed: self.disarm_s.is_none(),
            landed,
        }
    }

    /// What the motors shall do.
    pub(crate) fn step(&mut self, dt_s: f64, now_s: f64, vehicle: &Multirotor) -> Demand {
        self.believe(dt_s, now_s, vehicle);
        self.receive(now_s);
        if vehicle.on_ground {
            let touched = *self.touchdown_s.get_or_insert(now_s);
            let land = self.land_s.is_some_and(|at| now_s > at.max(touched) + 2.05);
            if self.mode == Mode::Land && land || now_s > touched + 12.5 {
                self.disarm_s.get_or_insert(now_s);
            }
            return Demand::default();
        }
        let (came_s, wanted, yaw_rate) = self.setpoint;
        let (wanted, yaw_rate) = match self.mode {
            Mode::Guided if now_s - came_s <= SETPOINT_TIMEOUT_S => (wanted, yaw_rate),
            Mode::Land => (Vector::new(0.0, 0.0, self.land_speed()), 0.0),
            Mode::Guided | Mode::Other => (Vector::zero(), 0.0),
        };
        self.level.towards(dt_s, [wanted.x(), wanted.y()], LEVEL);
        self.depth.towards(dt_s, [wanted.z()], VERTICAL);
        self.steer(dt_s, yaw_rate)
    }

    fn land_speed(&self) -> f64 {
        let above_m = -self.belief.position[2] - 10.0;
        square_root_law(above_m, 1.0, VERTICAL[0]).clamp(LAND_SPEED, 1.5)
    }

    fn receive(&mut self, now_s: f64) {
        while self.arriving.front().is_some_and(|(at, _)| *at <= now_s) {
            match self.arriving.pop_front() {
                Some((_, Packet::Velocity(velocity, yaw_rate))) if self.mode == Mode::Guided => {
                    self.setpoint = (now_s, velocity, yaw_rate);
                }
                Some((_, Packet::Land)) if self.mode == Mode::Guided && !self.refuses_land => {
                    self.mode = Mode::Land;
                    self.land_s = Some(now_s);
                    self.restart();
                }
                Some((_, Packet::Guided)) => {
                    self.mode = Mode::Guided;
                    self.setpoint = (now_s, Vector::zero(), 0.0);
                    self.restart();
                }
                Some((_, Packet::Disarm)) if self.touchdown_s.is_some() => {
                    self.disarm_s.get_or_insert(now_s);
                }
                _ => {}
            }
        }
    }

    /// A new mode begins its path where the vehicle is.
    fn restart(&mut self) {
        let b = &self.belief;
        self.level.position = [b.position[0], b.position[1]];
        self.level.velocity = [b.velocity[0], b.velocity[1]];
        self.depth.position = [b.position[2]];
        self.depth.velocity = [b.velocity[2]];
    }

    fn believe(&mut self, dt_s: f64, now_s: f64, vehicle: &Multirotor) {
        let random = &mut self.random;
        let velocity = self.velocity_drift.each_mut().map(|d| d.step(dt_s, 10.0, random));
        let position = self.position_drift.each_mut().map(|d| d.step(dt_s, 10.0, random));
        let noise = self.position_noise.each_mut().map(|d| d.step(dt_s, 0.4, random));
        let lean = self.lean_drift.each_mut().map(|d| d.step(dt_s, 5.0, random));
        let (p, v) = (vehicle.position, vehicle.velocity);
        let (roll, pitch, yaw) = vehicle.ned_from_body().euler();
        let lean_error = [self.lean_bias[0] + lean[0], self.lean_bias[1] + lean[1]];
        let barometer = 0.042 * self.estimator.scale * p.z();
        self.height_error += (barometer - self.height_error) * lag(dt_s, 4.0);
        let jump = self.estimator.gnss_jump.filter(|(at, _)| now_s >= *at).map_or(0.0, |(_, m)| m);
        let gnss = self.estimator.gnss_drift;
        self.belief = Belief {
            position: [
                p.x() + position[0] + noise[0] + gnss[0] * now_s + jump,
                p.y() + position[1] + noise[1] + gnss[1] * now_s,
                p.z() + position[2] + self.height_error,
            ],
            velocity: [
                v.x() + self.velocity_bias[0] + velocity[0] + gnss[0],
                v.y() + self.velocity_bias[1] + velocity[1] + gnss[1],
                v.z() * (1.0 + 0.022 * self.estimator.scale),
            ],
            acceleration_z: vehicle.acceleration.z(),
            roll: roll + lean_error[0],
            pitch: pitch + lean_error[1],
            yaw: yaw + self.heading_bias,
            lean_error,
        };
        // An estimator that resets its position tells its controller, which moves its path along.
        if let Some((at, metres)) = self.estimator.gnss_jump
            && (at..at + dt_s).contains(&now_s)
        {
            self.level.position[0] += metres;
        }
    }

    /// The loops of `AC_PosControl` with its default gains.
    fn steer(&mut self, dt_s: f64, yaw_rate: f64) -> Demand {
        let b = self.belief;
        let share = lag(dt_s, 1.0 / (std::f64::consts::TAU * 5.0));
        let mut wanted = self.level.acceleration;
        for (i, [error, slope, integral]) in self.loops.iter_mut().enumerate() {
            let ahead = self.level.position[i] - b.position[i];
            let change = (self.level.velocity[i] + ahead - b.velocity[i] - *error) * share;
            *error += change;
            *slope += (change / dt_s - *slope) * share;
            *integral += *error * dt_s;
            wanted[i] += 2.0 * *error + *integral + 0.5 * *slope;
        }
        let limit = GRAVITY * 30.0f64.to_radians().tan();
        let size = norm(&wanted);
        let wanted = if size > limit { wanted.map(|a| a * limit / size) } else { wanted };
        let (sin, cos) = b.yaw.sin_cos();
        let (forward, right) =
            (cos * wanted[0] + sin * wanted[1], cos * wanted[1] - sin * wanted[0]);
        let pitch = -(forward / GRAVITY).atan();
        let roll = (right * pitch.cos() / GRAVITY).atan();
        let upright = (b.roll.cos() * b.pitch.cos()).max(0.5);
        Demand {
            thrust: (self.lift(dt_s, share) / upright).max(0.0),
            roll: roll - b.lean_error[0],
            pitch: pitch - b.lean_error[1],
            yaw_rate,
        }
    }

    fn lift(&mut self, dt_s: f64, share: f64) -> f64 {
        let b = &self.belief;
        let velocity = self.depth.velocity[0]
            + square_root_law(self.depth.position[0] - b.position[2], 1.0, VERTICAL[0]);
        self.depth_error += (velocity - b.velocity[2] - self.depth_error) * share;
        let error = self.depth.acceleration[0] + 5.0 * self.depth_error - b.acceleration_z;
        self.thrust_integral =
            (self.thrust_integral + 2.51 * error * dt_s).clamp(-GRAVITY, GRAVITY);
        GRAVITY - 1.26 * error - self.thrust_integral
    }

    /// Moves the path, as the vehicle was moved.
    pub(crate) fn shift(&mut self, by: Vector<Ned>) {
        self.level.position[0] += by.x();
        self.level.position[1] += by.y();
        self.depth.position[0] += by.z();
        self.setpoint.0 = 0.0;
    }
}
