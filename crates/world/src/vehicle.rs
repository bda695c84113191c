//! Simulates the multirotor: lags of attitude and thrust, drag in the wind, ground effect, and its contact
//! with ground or pad; the autopilot's demand in, the true motion out.
//!
//! Above the attitude loops everything is the autopilot's; below them the measured response of the real
//! vehicle is kept as lags. The thrust points where the body points, so the vehicle tilts exactly as much as
//! it accelerates or holds against the wind.

use geometry::{Body, Ned, Point, Rotation, Vector};
use rand_chacha::ChaCha8Rng;

use crate::drift::{Drift, random_stream};
use crate::laws::{lag, square_root_law, wrap};

/// Acceleration of gravity, in m/s^2.
pub const GRAVITY_M_S2: f64 = 9.806_65;

/// The vehicle's physical parameters; the defaults give the responses measured on the real one.
#[derive(Clone, Debug, PartialEq)]
pub struct VehicleConfig {
    /// Drag per mass at low speed, in 1/s.
    pub linear_drag: f64,
    /// Drag per mass that grows with the square of the speed, in 1/m.
    pub quadratic_drag: f64,
    /// Time constant from the demanded tilt to the attitude loop's target, in seconds.
    pub lean_shaping_s: f64,
    /// Time constant with which the body follows that target, in seconds.
    pub lean_lag_s: f64,
    /// Time constant of motors and propellers, in seconds.
    pub thrust_lag_s: f64,
    /// Largest thrust per mass, in m/s^2.
    pub thrust_limit_m_s2: f64,
    /// Fastest turn to a heading, in rad/s.
    pub heading_rate_limit_rad_s: f64,
    /// Largest change of the demanded turn rate, in rad/s^2.
    pub heading_acceleration_rad_s2: f64,
    /// Gain from heading error to turn rate, in 1/s.
    pub heading_gain: f64,
    /// Time constant with which the body reaches a turn rate, in seconds.
    pub heading_lag_s: f64,
    /// Standard deviation of the tilt that the propellers' unsteadiness causes in flight, in radians.
    pub unsteadiness_rad: f64,
    /// Radius of the rotors for the ground effect (Cheeseman and Bennett 1955), in metres; 0 is none.
    pub rotor_m: f64,
    /// Height of the rotors over the vehicle's lowest point, in metres.
    pub rotor_height_m: f64,
    /// The vehicle's position on the ground at the start; the ground is the horizontal plane through it.
    pub start: Point<Ned>,
    /// How high over it the vehicle hovers at the start, in metres; 0 is on the ground.
    pub start_height_m: f64,
    /// Heading at the start, in radians from north to east.
    pub start_heading_rad: f64,
}

impl Default for VehicleConfig {
    fn default() -> Self {
        Self {
            // From the tilt at 0.5 m/s in calm air (0.73 degrees) and in 5 m/s of wind (11.7 degrees).
            linear_drag: 0.25,
            quadratic_drag: 0.0314,
            lean_shaping_s: 0.15,
            lean_lag_s: 0.02,
            thrust_lag_s: 0.09,
            thrust_limit_m_s2: 2.0 * GRAVITY_M_S2,
            heading_rate_limit_rad_s: 60.0f64.to_radians(),
            heading_acceleration_rad_s2: 270.0f64.to_radians(),
            heading_gain: 8.0,
            heading_lag_s: 0.35,
            unsteadiness_rad: 0.03f64.to_radians(),
            rotor_m: 0.0,
            rotor_height_m: 0.2,
            start: Point::new(0.0, 0.0, 0.0),
            start_height_m: 0.0,
            start_heading_rad: 0.0,
        }
    }
}

/// The autopilot's demand on the vehicle.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Demand {
    /// Thrust per mass along the body's up axis, in m/s^2; 0 with the motors off.
    pub thrust_m_s2: f64,
    /// Roll, in radians, right side down.
    pub roll_rad: f64,
    /// Pitch, in radians, nose up.
    pub pitch_rad: f64,
    /// Where the nose shall point.
    pub heading: HeadingDemand,
}

impl Demand {
    /// Motors off.
    pub const IDLE: Self =
        Self { thrust_m_s2: 0.0, roll_rad: 0.0, pitch_rad: 0.0, heading: HeadingDemand::Rate(0.0) };
}

/// Where the nose shall point.
#[derive(Copy, Clone, Debug, PartialEq)]
pub enum HeadingDemand {
    /// Towards this angle, in radians from north to east, and then turn at this rate, in rad/s.
    Angle(f64, f64),
    /// Turn at this rate, in rad/s.
    Rate(f64),
}

/// The surface below the vehicle, which supports it after a landing.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Support {
    /// Where its surface is, in metres downwards.
    pub z_m: f64,
    /// Its velocity there, in m/s.
    pub velocity: Vector<Ned>,
    /// How fast it turns, in rad/s.
    pub turn_rad_s: f64,
}

impl Support {
    /// Stationary ground.
    pub fn ground(z_m: f64) -> Self {
        Self { z_m, velocity: Vector::zero(), turn_rad_s: 0.0 }
    }
}

/// How the vehicle really moves.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct VehicleTruth {
    /// Time since the start of the simulation, in seconds.
    pub time_s: f64,
    /// Position, in metres.
    pub position: Point<Ned>,
    /// Velocity, in m/s.
    pub velocity: Vector<Ned>,
    /// Rate of change of the velocity, in m/s^2.
    pub acceleration: Vector<Ned>,
    /// Attitude.
    pub ned_from_body: Rotation<Ned, Body>,
    /// Turn rates about the body's axes, in rad/s.
    pub angular_rate: Vector<Body>,
    /// True while the ground carries the vehicle.
    pub on_ground: bool,
    /// Height of the vehicle over the surface below it, in metres.
    pub height_m: f64,
    /// Downward speed at the latest touch of the ground, in m/s; none before the first.
    pub impact_m_s: Option<f64>,
}

impl VehicleTruth {
    /// Angle between the body's down axis and the vertical, in radians.
    pub fn tilt_rad(&self) -> f64 {
        self.ned_from_body.down_axis().z().clamp(-1.0, 1.0).acos()
    }

    /// The state between this one and `next`, at `time_s`: on the straight line, and on the shortest arc of
    /// attitude.
    pub fn interpolate(&self, next: &Self, time_s: f64) -> Self {
        if time_s >= next.time_s {
            return *next;
        }
        if time_s <= self.time_s {
            return *self;
        }
        let f = (time_s - self.time_s) / (next.time_s - self.time_s);
        let blend = |a: Vector<_>, b: Vector<_>| a + (b - a) * f;
        Self {
            time_s,
            position: self.position + (next.position - self.position) * f,
            velocity: blend(self.velocity, next.velocity),
            acceleration: blend(self.acceleration, next.acceleration),
            ned_from_body: self.ned_from_body.interpolate(&next.ned_from_body, f),
            angular_rate: self.angular_rate + (next.angular_rate - self.angular_rate) * f,
            height_m: self.height_m + (next.height_m - self.height_m) * f,
            ..*self
        }
    }
}

/// An angle and its rate.
#[derive(Copy, Clone, Debug, Default)]
struct Axis {
    target: f64,
    angle: f64,
    rate: f64,
}

/// The vehicle.
#[derive(Clone, Debug)]
pub struct Vehicle {
    config: VehicleConfig,
    random: ChaCha8Rng,
    time_s: f64,
    position: Point<Ned>,
    velocity: Vector<Ned>,
    acceleration: Vector<Ned>,
    roll: Axis,
    pitch: Axis,
    yaw: Axis,
    yaw_target_rate: f64,
    thrust_m_s2: f64,
    unsteadiness: [Drift; 2],
    on_ground: bool,
    impact_m_s: Option<f64>,
    below: Support,
}

impl Vehicle {
    /// A vehicle on the ground, motors off, or hovering above it.
    pub fn new(config: VehicleConfig, seed: u64) -> Self {
        let mut random = random_stream(seed, 2);
        let mut drift = || Drift::new(config.unsteadiness_rad, 0.5, &mut random);
        let unsteadiness = [drift(), drift()];
        let heading = config.start_heading_rad;
        let flies = config.start_height_m > 0.0;
        Self {
            random,
            time_s: 0.0,
            position: config.start - Vector::new(0.0, 0.0, config.start_height_m.max(0.0)),
            velocity: Vector::zero(),
            acceleration: Vector::zero(),
            roll: Axis::default(),
            pitch: Axis::default(),
            yaw: Axis { target: heading, angle: heading, rate: 0.0 },
            yaw_target_rate: 0.0,
            thrust_m_s2: if flies { GRAVITY_M_S2 } else { 0.0 },
            unsteadiness,
            on_ground: !flies,
            impact_m_s: None,
            below: Support::ground(config.start.z()),
            config,
        }
    }

    /// How it moves now.
    pub fn truth(&self) -> VehicleTruth {
        VehicleTruth {
            time_s: self.time_s,
            position: self.position,
            velocity: self.velocity,
            acceleration: self.acceleration,
            ned_from_body: self.ned_from_body(),
            angular_rate: self.angular_rate(),
            on_ground: self.on_ground,
            height_m: self.below.z_m - self.position.z(),
            impact_m_s: self.impact_m_s,
        }
    }

    /// Moves the vehicle to a position; its velocity and attitude stay.
    pub fn put(&mut self, position: Point<Ned>) {
        self.position = position;
    }

    /// Lets `dt_s` (a few milliseconds) pass in air that moves with `wind`, in m/s, over still ground.
    pub fn step(&mut self, dt_s: f64, wind: Vector<Ned>, demand: &Demand) {
        self.step_over(dt_s, wind, demand, Support::ground(self.config.start.z()));
    }

    /// As [`Vehicle::step`], over something that may move.
    pub fn step_over(&mut self, dt_s: f64, wind: Vector<Ned>, demand: &Demand, below: Support) {
        self.time_s += dt_s;
        self.below = below;
        let wanted = demand.thrust_m_s2.clamp(0.0, self.config.thrust_limit_m_s2);
        self.thrust_m_s2 += (wanted - self.thrust_m_s2) * lag(dt_s, self.config.thrust_lag_s);
        self.lean(dt_s, demand);
        self.turn(dt_s, demand.heading);
        let lift = self.thrust_m_s2 * self.ground_effect();
        let thrust = self.ned_from_body() * Vector::<Body>::new(0.0, 0.0, -lift);
        let force = thrust + self.drag(wind) + Vector::new(0.0, 0.0, GRAVITY_M_S2);
        self.move_by(dt_s, force);
    }

    /// Thrust over the thrust far from the ground.
    fn ground_effect(&self) -> f64 {
        let height_m = self.below.z_m - self.position.z() + self.config.rotor_height_m;
        let near = self.config.rotor_m / (4.0 * height_m.max(0.5 * self.config.rotor_m).max(1e-3));
        1.0 / (1.0 - near * near)
    }

    fn drag(&self, wind: Vector<Ned>) -> Vector<Ned> {
        let through_air = self.velocity - wind;
        let per_speed = self.config.linear_drag + self.config.quadratic_drag * through_air.norm();
        through_air * -per_speed
    }

    fn lean(&mut self, dt_s: f64, demand: &Demand) {
        let wanted = if self.on_ground {
            // The legs keep the vehicle level.
            [0.0; 2]
        } else {
            let [roll, pitch] = &mut self.unsteadiness;
            [
                demand.roll_rad + roll.step(dt_s, &mut self.random),
                demand.pitch_rad + pitch.step(dt_s, &mut self.random),
            ]
        };
        for (axis, wanted) in [&mut self.roll, &mut self.pitch].into_iter().zip(wanted) {
            axis.target += (wanted - axis.target) * lag(dt_s, self.config.lean_shaping_s);
            let before = axis.angle;
            axis.angle += (axis.target - axis.angle) * lag(dt_s, self.config.lean_lag_s);
            axis.rate = (axis.angle - before) / dt_s;
        }
    }

    fn turn(&mut self, dt_s: f64, demand: HeadingDemand) {
        let config = &self.config;
        if self.on_ground {
            let angle = wrap(self.yaw.angle + self.below.turn_rad_s * dt_s);
            self.yaw = Axis { target: angle, angle, rate: self.below.turn_rad_s };
            self.yaw_target_rate = 0.0;
            return;
        }
        let wanted_rate = match demand {
            HeadingDemand::Rate(rate) => rate,
            HeadingDemand::Angle(angle, rate) => {
                let error = wrap(angle - self.yaw.target);
                let gain = 1.0 / config.lean_shaping_s;
                (square_root_law(error, gain, config.heading_acceleration_rad_s2) + rate)
                    .clamp(-config.heading_rate_limit_rad_s, config.heading_rate_limit_rad_s)
            }
        };
        let change = config.heading_acceleration_rad_s2 * dt_s;
        self.yaw_target_rate += (wanted_rate - self.yaw_target_rate).clamp(-change, change);
        self.yaw.target = wrap(self.yaw.target + self.yaw_target_rate * dt_s);
        let rate =
            self.yaw_target_rate + config.heading_gain * wrap(self.yaw.target - self.yaw.angle);
        self.yaw.rate += (rate - self.yaw.rate) * lag(dt_s, config.heading_lag_s);
        self.yaw.angle = wrap(self.yaw.angle + self.yaw.rate * dt_s);
    }

    fn move_by(&mut self, dt_s: f64, force: Vector<Ned>) {
        let below = self.below;
        if self.on_ground && force.z() >= 0.0 {
            (self.velocity, self.acceleration) = (below.velocity, Vector::zero());
            let moved = self.position + below.velocity * dt_s;
            self.position = Point::new(moved.x(), moved.y(), below.z_m);
            return;
        }
        self.on_ground = false;
        self.acceleration = force;
        let before = self.velocity;
        self.velocity = before + force * dt_s;
        self.position = self.position + (before + self.velocity) * (0.5 * dt_s);
        if self.position.z() >= below.z_m && self.velocity.z() > below.velocity.z() {
            self.touch(below);
        }
    }

    /// The ground takes all speed at once: legs neither bounce nor slide.
    fn touch(&mut self, below: Support) {
        self.impact_m_s = Some(self.velocity.z() - below.velocity.z());
        self.on_ground = true;
        self.position = Point::new(self.position.x(), self.position.y(), below.z_m);
        (self.velocity, self.acceleration) = (below.velocity, Vector::zero());
    }

    fn ned_from_body(&self) -> Rotation<Ned, Body> {
        Rotation::from_euler(self.roll.angle, self.pitch.angle, self.yaw.angle)
    }

    fn angular_rate(&self) -> Vector<Body> {
        let (sin_roll, cos_roll) = self.roll.angle.sin_cos();
        let (sin_pitch, cos_pitch) = self.pitch.angle.sin_cos();
        Vector::new(
            self.roll.rate - self.yaw.rate * sin_pitch,
            self.pitch.rate * cos_roll + self.yaw.rate * sin_roll * cos_pitch,
            self.yaw.rate * cos_roll * cos_pitch - self.pitch.rate * sin_roll,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DT_S: f64 = 0.0025;

    fn hover() -> Demand {
        Demand { thrust_m_s2: GRAVITY_M_S2, ..Demand::IDLE }
    }

    /// A stationary vehicle at some height.
    fn flying() -> Vehicle {
        let mut vehicle =
            Vehicle::new(VehicleConfig { unsteadiness_rad: 0.0, ..VehicleConfig::default() }, 1);
        vehicle.position = Point::new(0.0, 0.0, -10.0);
        vehicle.on_ground = false;
        vehicle.thrust_m_s2 = GRAVITY_M_S2;
        vehicle
    }

    fn run(vehicle: &mut Vehicle, seconds: f64, wind: Vector<Ned>, demand: &Demand) {
        for _ in 0..(seconds / DT_S).round() as usize {
            vehicle.step(DT_S, wind, demand);
        }
    }

    #[test]
    fn the_lean_that_holds_against_five_metres_per_second_is_the_measured_one() {
        let mut vehicle = flying();
        let lean = 11.73f64.to_radians();
        let demand = Demand { pitch_rad: -lean, thrust_m_s2: GRAVITY_M_S2 / lean.cos(), ..hover() };
        run(&mut vehicle, 20.0, Vector::new(-5.0, 0.0, 0.0), &demand);
        assert!(vehicle.truth().velocity.norm() < 0.1, "{:?}", vehicle.truth().velocity);
        assert!((vehicle.truth().tilt_rad() - lean).abs() < 1e-6);
    }

    #[test]
    fn leaning_forward_accelerates_towards_the_nose() {
        let mut vehicle = flying();
        vehicle.yaw = Axis { target: 1.0, angle: 1.0, rate: 0.0 };
        run(&mut vehicle, 1.0, Vector::zero(), &Demand { pitch_rad: -0.1, ..hover() });
        let v = vehicle.truth().velocity;
        assert!((v.y().atan2(v.x()) - 1.0).abs() < 1e-6 && v.horizontal_norm() > 0.5, "{v:?}");
    }

    #[test]
    fn a_vehicle_on_the_ground_neither_sinks_nor_blows_away() {
        let mut vehicle = Vehicle::new(VehicleConfig::default(), 1);
        run(&mut vehicle, 5.0, Vector::new(8.0, 0.0, 0.0), &Demand::IDLE);
        assert_eq!(vehicle.truth().position, Point::new(0.0, 0.0, 0.0));
        assert!(vehicle.truth().on_ground && vehicle.truth().impact_m_s.is_none());
    }

    #[test]
    fn a_touch_stops_the_vehicle_levels_it_and_notes_its_speed() {
        let mut vehicle = flying();
        vehicle.position = Point::new(0.0, 0.0, -0.1);
        vehicle.velocity = Vector::new(0.3, 0.0, 0.5);
        let demand = Demand { roll_rad: 0.2, thrust_m_s2: GRAVITY_M_S2 * 0.99, ..hover() };
        run(&mut vehicle, 2.0, Vector::zero(), &demand);
        let truth = vehicle.truth();
        assert!(truth.on_ground && truth.velocity == Vector::zero() && truth.height_m == 0.0);
        assert!((truth.impact_m_s.unwrap() - 0.5).abs() < 0.05, "{truth:?}");
        assert!(truth.tilt_rad() < 1e-3);
    }

    #[test]
    fn turning_to_a_heading_overshoots_as_measured() {
        // From 147.2 to 90 degrees the real vehicle swung to 80.9 and passed 90 again 1.5 s after the order.
        let mut vehicle = flying();
        let start = 147.2f64.to_radians();
        vehicle.yaw = Axis { target: start, angle: start, rate: 0.0 };
        let demand = Demand { heading: HeadingDemand::Angle(90.0f64.to_radians(), 0.0), ..hover() };
        let mut min = start;
        for _ in 0..(8.0 / DT_S) as usize {
            vehicle.step(DT_S, Vector::zero(), &demand);
            min = min.min(vehicle.yaw.angle);
        }
        assert!((min.to_degrees() - 80.9).abs() < 1.5, "{}", min.to_degrees());
        assert!((vehicle.yaw.angle.to_degrees() - 90.0).abs() < 0.2);
    }

    #[test]
    fn a_state_between_two_is_on_the_way() {
        let mut vehicle = flying();
        let first = vehicle.truth();
        run(&mut vehicle, 0.05, Vector::zero(), &Demand { roll_rad: 0.3, ..hover() });
        let last = vehicle.truth();
        let middle = first.interpolate(&last, 0.5 * (first.time_s + last.time_s));
        let half = last.tilt_rad() / 2.0;
        assert!((middle.tilt_rad() - half).abs() < 1e-9 && half > 0.0);
        assert_eq!(first.interpolate(&last, last.time_s + 1.0), last);
        assert_eq!(first.interpolate(&last, first.time_s), first);
    }
}
