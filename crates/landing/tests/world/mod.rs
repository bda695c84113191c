//! A small world for closed-loop tests: a vehicle that answers velocity setpoints as the measured autopilot does,
//! a camera below it, and a pad.

use std::collections::VecDeque;

use geometry::{Body, CameraModel, Marker, Ned, Pixel, Point, Rotation, Transform, Vector};
use landing::{
    Action, Config, Decision, Event, Frame, Landed, Lander, MarkerInFrame, Mode, OperatorCommand,
    Phase, Timestamp, VehicleState,
};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal, StandardUniform};

/// Seconds per step of the physics.
const STEP_S: f64 = 0.005;
/// Seconds between a setpoint and the first motion.
const DEAD_TIME_S: f64 = 0.25;
/// First-order time constants, horizontal and vertical, in seconds.
const LAG_S: [f64; 3] = [0.43, 0.43, 0.21];
/// Largest horizontal acceleration of the autopilot, in m/s^2.
const ACCELERATION: f64 = 2.5;
/// Height of the body's origin when the vehicle stands, in metres.
const STANDING_M: f64 = 0.1;
/// Speed of the autopilot's LAND mode, in m/s.
const LAND_SPEED: f64 = 0.48;
/// Edge of the marker, in metres.
const MARKER_M: f64 = 0.153_41;

/// One flight's circumstances.
#[derive(Clone, Debug)]
pub(crate) struct Scene {
    pub(crate) seed: u64,
    pub(crate) config: Config,
    /// Where the vehicle hovers at first.
    pub(crate) start: Point<Ned>,
    pub(crate) heading_rad: f64,
    pub(crate) pad: Point<Ned>,
    /// Standard deviation of the gusts' effect on the velocity, in m/s.
    pub(crate) gust_m_s: f64,
    /// Size of the autopilot's velocity bias and of its slow error of position, in m/s and m.
    pub(crate) estimator_error: f64,
    pub(crate) latency_s: f64,
    /// By how much the vehicle's stamps are later than the truth, in seconds.
    pub(crate) stamp_error_s: f64,
    /// Part of the frames in which the marker is missed.
    pub(crate) miss: f64,
    /// The detector is silent between these seconds.
    pub(crate) outage_s: Option<(f64, f64)>,
    /// What the operator does when.
    pub(crate) commands: Vec<(f64, OperatorCommand)>,
    /// The autopilot ignores the request to land.
    pub(crate) refuses_land: bool,
    /// The pilot takes over at this time.
    pub(crate) pilot_s: Option<f64>,
    /// The end of patience, in seconds.
    pub(crate) limit_s: f64,
}

/// What happened at one time.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Sample {
    pub(crate) seconds: f64,
    pub(crate) position: Point<Ned>,
    pub(crate) decision: Decision,
}

/// One flight.
#[derive(Debug)]
pub(crate) struct Flight {
    pub(crate) samples: Vec<Sample>,
    pub(crate) phase: Phase,
    /// Seconds until LAND, until the ground, and until disarmed.
    pub(crate) land_s: Option<f64>,
    pub(crate) touchdown_s: Option<f64>,
    pub(crate) disarm_s: Option<f64>,
    /// Horizontal distance from the pad at touchdown, in metres.
    pub(crate) error_m: f64,
    /// Largest distance beyond the pad, along the way to it, in metres.
    pub(crate) overshoot_m: f64,
    pub(crate) max_tilt_rad: f64,
}

impl Scene {
    /// The thesis' field: 10 m over the origin, the pad at (1.5, -1.5), its own errors drawn from the seed.
    pub(crate) fn new(seed: u64) -> Self {
        Self {
            seed,
            config: Config::default(),
            start: Point::new(0.0, 0.0, -10.0),
            heading_rad: 0.0,
            pad: Point::new(1.5, -1.5, 0.0),
            gust_m_s: 0.03,
            estimator_error: 0.03,
            latency_s: 0.08,
            stamp_error_s: 0.0,
            miss: 0.03,
            outage_s: None,
            commands: vec![(0.0, OperatorCommand::Start)],
            refuses_land: false,
            pilot_s: None,
            limit_s: 120.0,
        }
    }

    /// Flies until the landing ends or patience does.
    pub(crate) fn fly(self) -> Flight {
        let lander = Lander::new(self.config);
        let mut flight = Flight::new();
        let Ok(mut lander) = lander else { return flight };
        let mut world = World::new(&self);
        let mut commands: VecDeque<_> = self.commands.iter().copied().collect();
        let mut step = 0u32;
        while world.seconds < self.limit_s {
            world.advance(&self);
            let mut events = world.events(&self, step);
            if commands.front().is_some_and(|(at, _)| *at + 0.5 <= world.seconds) {
                events.extend(commands.pop_front().map(|(_, command)| Event::Operator(command)));
            }
            for event in events {
                let decision = lander.step(Timestamp::from_seconds(world.seconds), event);
                world.obey(&self, decision.action);
                flight.note(&world, &self, decision);
            }
            step += 1;
            let over = world.disarm_s.is_some_and(|at| world.seconds > at + 1.0);
            if over || lander.phase() == Phase::Landed {
                break;
            }
        }
        flight.phase = lander.phase();
        flight.disarm_s = world.disarm_s.map(|at| at - 0.5);
        flight.touchdown_s = world.touchdown_s.map(|at| at - 0.5);
        flight.land_s = world.land_s.map(|at| at - 0.5);
        flight
    }
}

impl Flight {
    fn new() -> Self {
        Self {
            samples: Vec::new(),
            phase: Phase::Idle,
            land_s: None,
            touchdown_s: None,
            disarm_s: None,
            error_m: f64::INFINITY,
            overshoot_m: 0.0,
            max_tilt_rad: 0.0,
        }
    }

    fn note(&mut self, world: &World, scene: &Scene, decision: Decision) {
        let way = scene.pad - scene.start;
        let gone = world.position - scene.pad;
        if way.horizontal_norm() > 0.1 {
            let beyond = (gone.x() * way.x() + gone.y() * way.y()) / way.horizontal_norm();
            self.overshoot_m = self.overshoot_m.max(beyond);
        }
        if world.touchdown_s.is_some() {
            self.error_m = gone.horizontal_norm();
        }
        self.max_tilt_rad = self.max_tilt_rad.max(world.tilt[0].hypot(world.tilt[1]));
        self.samples.push(Sample {
            seconds: world.seconds - 0.5,
            position: world.position,

            decision,
        });
    }

    /// The sample nearest after `seconds`.
    pub(crate) fn at(&self, seconds: f64) -> Option<&Sample> {
        self.samples.iter().find(|sample| sample.seconds >= seconds)
    }
}

struct World {
    random: ChaCha8Rng,
    seconds: f64,
    position: Point<Ned>,
    velocity: Vector<Ned>,
    /// Roll and pitch that the acceleration needs, in radians.
    tilt: [f64; 2],
    gust: Vector<Ned>,
    velocity_bias: Vector<Ned>,
    position_error: Vector<Ned>,
    mount_error: [f64; 2],
    setpoints: VecDeque<Vector<Ned>>,
    wanted: Vector<Ned>,
    mode: Mode,
    /// A mode change on its way.
    pending_land_s: Option<f64>,
    hold: Point<Ned>,
    land_s: Option<f64>,
    touchdown_s: Option<f64>,
    disarm_s: Option<f64>,
    frames: VecDeque<(f64, Frame)>,
}

impl World {
    fn new(scene: &Scene) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(scene.seed);
        let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
        let bias = Vector::new(normal(), normal(), 0.3 * normal()) * scene.estimator_error;
        let mount_error = [0.002 * normal(), 0.002 * normal()];
        Self {
            seconds: 0.0,
            position: scene.start,
            velocity: Vector::zero(),
            tilt: [0.0; 2],
            gust: Vector::zero(),
            velocity_bias: bias,
            position_error: Vector::zero(),
            mount_error,
            setpoints: VecDeque::new(),
            wanted: Vector::zero(),
            mode: Mode::Guided,
            pending_land_s: None,
            hold: scene.start,
            land_s: None,
            touchdown_s: None,
            disarm_s: None,
            frames: VecDeque::new(),
            random,
        }
    }

    fn normal(&mut self) -> f64 {
        StandardNormal.sample(&mut self.random)
    }

    fn noise(&mut self) -> Vector<Ned> {
        Vector::new(self.normal(), self.normal(), 0.3 * self.normal())
    }

    /// One step of the physics.
    fn advance(&mut self, scene: &Scene) {
        self.seconds += STEP_S;
        self.modes(scene);
        // Gusts last a second, the estimator's errors twenty.
        let (gust, wander) = (self.noise(), self.noise());
        self.gust = self.gust * (1.0 - STEP_S) + gust * (scene.gust_m_s * (2.0 * STEP_S).sqrt());
        self.position_error = self.position_error * (1.0 - STEP_S / 20.0)
            + wander * (scene.estimator_error * (2.0 * STEP_S / 20.0).sqrt());
        if self.touchdown_s.is_some() {
            self.velocity = Vector::zero();
            self.tilt = [0.0; 2];
            return;
        }
        self.setpoints.push_back(self.wanted);
        let delayed = if self.setpoints.len() as f64 * STEP_S > DEAD_TIME_S {
            self.setpoints.pop_front().unwrap_or(Vector::zero())
        } else {
            Vector::zero()
        };
        let aim = if self.mode == Mode::Land { self.land_aim() } else { delayed };
        // The autopilot follows its own, biased, idea of the velocity.
        let lack = aim - self.velocity_bias + self.gust - self.velocity;
        let push = |lack: f64, axis: usize| (lack / LAG_S[axis]).clamp(-ACCELERATION, ACCELERATION);
        let acceleration = Vector::new(push(lack.x(), 0), push(lack.y(), 1), push(lack.z(), 2));
        self.velocity = self.velocity + acceleration * STEP_S;
        self.position = self.position + self.velocity * STEP_S;
        self.lean(scene, acceleration);
        if self.position.z() >= -STANDING_M {
            self.touchdown_s = Some(self.seconds);
        }
    }

    fn modes(&mut self, scene: &Scene) {
        if scene.pilot_s.is_some_and(|at| self.seconds >= at + 0.5) {
            self.mode = Mode::Other;
        }
        if self.pending_land_s.is_some_and(|at| self.seconds >= at) && self.mode == Mode::Guided {
            self.mode = Mode::Land;
            self.land_s = Some(self.seconds);
            self.hold =
                self.position + Vector::new(self.velocity.x(), self.velocity.y(), 0.0) * 0.6;
        }
        if let Some(touched) = self.touchdown_s
            && self.seconds > touched + 2.05
            && self.mode == Mode::Land
        {
            self.disarm_s.get_or_insert(self.seconds);
        }
    }

    fn land_aim(&self) -> Vector<Ned> {
        let back = self.hold - self.position;
        Vector::new(back.x(), back.y(), 0.0) * 0.8 + Vector::new(0.0, 0.0, LAND_SPEED)
    }

    /// The attitude that the acceleration needs, a tenth of a second behind.
    fn lean(&mut self, scene: &Scene, acceleration: Vector<Ned>) {
        let (sin, cos) = scene.heading_rad.sin_cos();
        let forward = acceleration.x() * cos + acceleration.y() * sin;
        let right = acceleration.y() * cos - acceleration.x() * sin;
        let wanted = [(right / 9.81).atan(), -(forward / 9.81).atan()];
        for (tilt, wanted) in self.tilt.iter_mut().zip(wanted) {
            *tilt += (wanted - *tilt) * STEP_S / 0.1;
        }
    }

    fn ned_from_body(&self, scene: &Scene) -> Rotation<Ned, Body> {
        Rotation::from_euler(self.tilt[0], self.tilt[1], scene.heading_rad)
    }

    /// What the lander is told after this step: states at 50 Hz, frames at 15 Hz after their latency, ticks at 20 Hz.
    fn events(&mut self, scene: &Scene, step: u32) -> Vec<Event> {
        let mut events = Vec::new();
        if step.is_multiple_of(4) {
            events.push(Event::Vehicle(self.state(scene)));
        }
        if step.is_multiple_of(13) {
            let frame = self.frame(scene);
            let jitter: f64 = StandardUniform.sample(&mut self.random);
            self.frames.push_back((self.seconds + scene.latency_s + 0.02 * jitter, frame));
        }
        if self.frames.front().is_some_and(|(at, _)| *at <= self.seconds) {
            events.extend(self.frames.pop_front().map(|(_, frame)| Event::Frame(frame)));
        }
        let silent =
            scene.outage_s.is_some_and(|(from, to)| (from..to).contains(&(self.seconds - 0.5)));
        events.retain(|event| !(silent && matches!(event, Event::Frame(_))));
        if step.is_multiple_of(10) {
            events.push(Event::Tick);
        }
        events
    }

    fn state(&mut self, scene: &Scene) -> VehicleState {
        let landed = match self.touchdown_s {
            Some(at) if self.seconds > at + 1.65 => Landed::OnGround,
            _ if self.mode == Mode::Land => Landed::Landing,
            _ => Landed::InAir,
        };
        VehicleState {
            stamp: Timestamp::from_seconds(self.seconds - 0.01 + scene.stamp_error_s),
            ned_from_body: self.ned_from_body(scene),
            position: self.position + self.position_error,
            velocity: self.velocity + self.velocity_bias + self.noise() * 0.01,
            mode: self.mode,
            armed: self.disarm_s.is_none(),
            landed,
        }
    }

    /// The camera looks down, image up is forward, with a small error of its mounting that nobody knows.
    fn frame(&mut self, scene: &Scene) -> Frame {
        let model = CameraModel::pinhole(1296, 972, 1818.0);
        let in_body = self.ned_from_body(scene).inverse() * (scene.pad - self.position);
        let [roll, pitch] = self.mount_error;
        let in_body: Vector<Body> = Rotation::<Body, Body>::from_euler(roll, pitch, 0.0) * in_body;
        let centre = model.project(Point::new(in_body.y(), -in_body.x(), in_body.z()));
        let half_px = 0.6 * MARKER_M * 1818.0 / in_body.z().max(0.01);
        let inside = |pixel: &Pixel| {
            (half_px..1296.0 - half_px).contains(&pixel.x)
                && (half_px..972.0 - half_px).contains(&pixel.y)
        };
        let luck: f64 = StandardUniform.sample(&mut self.random);
        let pixel_noise = [self.normal() * 0.5, self.normal() * 0.5];
        let range_noise = 1.0 + 0.01 * self.normal();
        let marker = centre.filter(inside).filter(|_| luck >= scene.miss).map(|pixel| {
            let pixel = Pixel::new(pixel.x + pixel_noise[0], pixel.y + pixel_noise[1]);
            let ray = model.unproject(pixel);
            let range = in_body.z() * range_noise;
            let origin = Point::<Body>::new(-ray.y() * range, ray.x() * range, range);
            let body_from_marker = Transform::<Body, Marker>::new(Rotation::identity(), origin);
            MarkerInFrame {
                centre: pixel,
                body_from_marker: Some(body_from_marker),
                confidence: 0.9,
            }
        });
        Frame {
            stamp: Timestamp::from_seconds(self.seconds),
            detector: 1,
            image_size: (1296, 972),
            marker,
        }
    }

    fn obey(&mut self, scene: &Scene, action: Action) {
        match action {
            Action::None => {}
            Action::Velocity { velocity, .. } => self.wanted = velocity,
            Action::Land if scene.refuses_land => {}
            Action::Land => {
                self.pending_land_s.get_or_insert(self.seconds + 0.08);
            }
        }
    }
}
