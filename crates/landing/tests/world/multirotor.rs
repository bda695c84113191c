//! A multirotor: thrust where the body points, drag of the air, the ground or deck under it. Its lags are those
//! measured on ArduPilot's own simulation.

use geometry::{Body, Ned, Point, Rotation, Vector};
use rand_chacha::ChaCha8Rng;

use super::chance::{Drift, lag, stream};

pub(crate) const GRAVITY: f64 = 9.806_65;

/// Time constants in seconds: of the lean's target, of the body behind it, of motors and propellers.
const LEAN_SHAPING_S: f64 = 0.15;
const LEAN_LAG_S: f64 = 0.02;
const THRUST_LAG_S: f64 = 0.09;
const TURN_LAG_S: f64 = 0.35;
/// Drag per mass, in 1/s and 1/m.
const LINEAR_DRAG: f64 = 0.25;
const QUADRATIC_DRAG: f64 = 0.0314;
/// Radius of the rotors for the ground effect (Cheeseman and Bennett), and their height over the legs, in metres.
const ROTOR_M: f64 = 0.2;
const ROTOR_HEIGHT_M: f64 = 0.2;

/// What the autopilot asks for.
#[derive(Copy, Clone, Debug, Default)]
pub(crate) struct Demand {
    pub(crate) thrust: f64,
    pub(crate) roll: f64,
    pub(crate) pitch: f64,
    pub(crate) yaw_rate: f64,
}

/// The vehicle; its origin is its lowest point.
#[derive(Clone, Debug)]
pub(crate) struct Multirotor {
    random: ChaCha8Rng,
    pub(crate) position: Point<Ned>,
    pub(crate) velocity: Vector<Ned>,
    pub(crate) acceleration: Vector<Ned>,
    /// Roll, pitch: the loop's target and the angle.
    lean: [[f64; 2]; 2],
    yaw: f64,
    yaw_rate: f64,
    thrust: f64,
    unsteadiness: [Drift; 2],
    pub(crate) on_ground: bool,
}

impl Multirotor {
    pub(crate) fn new(position: Point<Ned>, heading_rad: f64, seed: u64) -> Self {
        let mut random = stream(seed, 2);
        let unsteadiness = [(); 2].map(|()| Drift::new(0.03f64.to_radians(), 1.0, &mut random));
        Self {
            random,
            position,
            velocity: Vector::zero(),
            acceleration: Vector::zero(),
            lean: [[0.0; 2]; 2],
            yaw: heading_rad,
            yaw_rate: 0.0,
            thrust: GRAVITY,
            unsteadiness,
            on_ground: false,
        }
    }

    pub(crate) fn ned_from_body(&self) -> Rotation<Ned, Body> {
        Rotation::from_euler(self.lean[0][1], self.lean[1][1], self.yaw)
    }

    pub(crate) fn tilt_rad(&self) -> f64 {
        (self.ned_from_body() * Vector::<Body>::new(0.0, 0.0, 1.0)).z().clamp(-1.0, 1.0).acos()
    }

    /// Lets `dt_s` pass over ground that is at `ground_z` and moves with `ground_velocity`.
    pub(crate) fn step(
        &mut self,
        dt_s: f64,
        wind: Vector<Ned>,
        demand: &Demand,
        ground_z: f64,
        ground_velocity: Vector<Ned>,
    ) {
        if self.on_ground {
            self.velocity = ground_velocity;
            let moved = self.position + ground_velocity * dt_s;
            self.position = Point::new(moved.x(), moved.y(), ground_z);
            return;
        }
        self.thrust +=
            (demand.thrust.clamp(0.0, 2.0 * GRAVITY) - self.thrust) * lag(dt_s, THRUST_LAG_S);
        for (i, wanted) in [demand.roll, demand.pitch].into_iter().enumerate() {
            let wanted = wanted + self.unsteadiness[i].step(dt_s, 0.5, &mut self.random);
            let [target, angle] = &mut self.lean[i];
            *target += (wanted - *target) * lag(dt_s, LEAN_SHAPING_S);
            *angle += (*target - *angle) * lag(dt_s, LEAN_LAG_S);
        }
        self.yaw_rate += (demand.yaw_rate - self.yaw_rate) * lag(dt_s, TURN_LAG_S);
        self.yaw += self.yaw_rate * dt_s;
        let through_air = self.velocity - wind;
        let drag = through_air * -(LINEAR_DRAG + QUADRATIC_DRAG * through_air.norm());
        let near = ROTOR_M / (4.0 * (ground_z - self.position.z() + ROTOR_HEIGHT_M).max(0.1));
        let lift = self.thrust / (1.0 - near * near).max(0.5);
        let force = self.ned_from_body() * Vector::<Body>::new(0.0, 0.0, -lift)
            + drag
            + Vector::new(0.0, 0.0, GRAVITY);
        self.acceleration = force;
        let before = self.velocity;
        self.velocity = before + force * dt_s;
        self.position = self.position + (before + self.velocity) * (0.5 * dt_s);
        // The legs neither bounce nor slide.
        self.on_ground = self.position.z() >= ground_z && self.velocity.z() > ground_velocity.z();
    }
}
