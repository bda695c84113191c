//! A small world for closed-loop tests, in steps of the autopilot's loop: [`air`], a [`multirotor`] in it, an
//! [`autopilot`] that flies it as the measured one does, a pad that may move, and [`eyes`] that see it, with all their
//! errors drawn from one seed.

#![allow(dead_code, reason = "each test uses a part of it")]

pub(crate) mod air;
pub(crate) mod autopilot;
pub(crate) mod cases;
pub(crate) mod chance;
pub(crate) mod eyes;
pub(crate) mod multirotor;
pub(crate) mod report;

use std::collections::VecDeque;

use geometry::{Ned, Point, Vector};
use landing::{Action, Config, Decision, Event, Lander, OperatorCommand, Phase, Timestamp};

use air::{Air, Wind};
use autopilot::{Autopilot, Estimator, Packet};
use eyes::{Eyes, Faults};
use multirotor::{Demand, Multirotor};

/// Seconds per step.
const STEP_S: f64 = 1.0 / 400.0;
/// The vehicle hovers so long before the landing begins, in seconds.
const WARM_UP_S: f64 = 6.0;
/// Setpoints are sent at most this often, and with each frame, in seconds.
const SETPOINT_PERIOD_S: f64 = 0.04;

/// How the pad moves.
#[derive(Copy, Clone, Debug)]
pub(crate) struct PadMotion {
    /// In m/s.
    pub(crate) velocity: Vector<Ned>,
    /// Amplitude in metres and period in seconds.
    pub(crate) heave: (f64, f64),
    /// In radians, and rad/s.
    pub(crate) yaw: (f64, f64),
}

/// One flight's circumstances.
#[derive(Clone, Debug)]
pub(crate) struct Scene {
    pub(crate) seed: u64,
    pub(crate) config: Config,
    /// Where the vehicle hovers at first.
    pub(crate) start: Point<Ned>,
    pub(crate) heading_rad: f64,
    pub(crate) pad: Point<Ned>,
    pub(crate) pad_motion: PadMotion,
    pub(crate) wind: Wind,
    pub(crate) estimator: Estimator,
    pub(crate) faults: Faults,
    pub(crate) frames_hz: f64,
    pub(crate) latency_s: f64,
    pub(crate) latency_jitter_s: f64,
    /// By how much the frames' stamps are earlier than the truth, in seconds.
    pub(crate) stamp_error_s: f64,
    /// The detector says how good its poses are.
    pub(crate) tells_covariance: bool,
    /// Size of the marker relative to the thesis'.
    pub(crate) marker_scale: f64,
    /// The camera is turned about the vertical by so much more than the controller was told, clockwise seen from above.
    pub(crate) camera_turned_rad: f64,
    /// Its image is mirrored.
    pub(crate) mirrored: bool,
    /// From sending a packet to its effect in the autopilot, in seconds.
    pub(crate) link_s: f64,
    /// The autopilot is neither heard nor reached between these seconds.
    pub(crate) link_lost_s: Option<(f64, f64)>,
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
    pub(crate) velocity: Vector<Ned>,
    pub(crate) pad: Point<Ned>,
    pub(crate) decision: Decision,
}

/// The moment of the touch.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Touch {
    /// Horizontal distance from the pad, in metres.
    pub(crate) error_m: f64,
    /// Relative to the pad, in m/s.
    pub(crate) sink_m_s: f64,
    pub(crate) slide_m_s: f64,
    pub(crate) tilt_rad: f64,
    pub(crate) heading_rad: f64,
}

/// One flight. Times are seconds from the start of the landing.
#[derive(Debug)]
pub(crate) struct Flight {
    pub(crate) samples: Vec<Sample>,
    pub(crate) phase: Phase,
    /// Seconds until LAND, until the ground, and until disarmed.
    pub(crate) land_s: Option<f64>,
    pub(crate) touchdown_s: Option<f64>,
    pub(crate) disarm_s: Option<f64>,
    pub(crate) touch: Option<Touch>,
    /// As in `touch`; infinite without one.
    pub(crate) error_m: f64,
    /// Largest distance beyond the pad, along the way to it, in metres.
    pub(crate) overshoot_m: f64,
    pub(crate) max_tilt_rad: f64,
    /// The landing was given up before the touch.
    pub(crate) aborted: bool,
}

impl Scene {
    /// The thesis' field in calm air: 10 m over the origin, the pad at (1.5, -1.5).
    pub(crate) fn new(seed: u64) -> Self {
        Self {
            seed,
            config: Config::default(),
            start: Point::new(0.0, 0.0, -10.0),
            heading_rad: 0.0,
            pad: Point::new(1.5, -1.5, 0.0),
            pad_motion: PadMotion { velocity: Vector::zero(), heave: (0.0, 5.0), yaw: (0.0, 0.0) },
            wind: Wind::CALM,
            estimator: Estimator::USUAL,
            faults: Faults::USUAL,
            frames_hz: 15.0,
            latency_s: 0.08,
            latency_jitter_s: 0.02,
            stamp_error_s: 0.0,
            tells_covariance: true,
            marker_scale: 1.0,
            camera_turned_rad: 0.0,
            mirrored: false,
            link_s: 0.03,
            link_lost_s: None,
            commands: vec![(0.0, OperatorCommand::Start)],
            refuses_land: false,
            pilot_s: None,
            limit_s: 120.0,
        }
    }

    /// The same in wind from a direction that the seed draws.
    pub(crate) fn windy(seed: u64, mean_m_s: f64, turbulence: f64) -> Self {
        let from_rad = seed as f64 * 2.399;
        Self { wind: Wind::new(mean_m_s, turbulence, from_rad), ..Self::new(seed) }
    }

    /// Flies until the landing ends or patience does.
    pub(crate) fn fly(self) -> Flight {
        let mut flight = Flight::new();
        let Ok(mut lander) = Lander::new(self.config) else { return flight };
        let mut world = World::new(&self);
        world.warm_up(&self);
        let mut commands: VecDeque<_> = self.commands.iter().copied().collect();
        let mut step = 0u32;
        while world.seconds < self.limit_s {
            world.advance(&self);
            for event in world.events(&self, step, &mut commands) {
                let decision = lander.step(Timestamp::from_seconds(world.seconds), event);
                world.obey(&self, decision, matches!(event, Event::Frame(_)));
                flight.note(&world, &self, decision);
            }
            flight.watch(&world, &self);
            step += 1;
            let over = world.autopilot.disarm_s.is_some_and(|at| world.seconds > at + 1.0);
            if over || lander.phase() == Phase::Landed {
                break;
            }
        }
        flight.phase = lander.phase();
        flight.disarm_s = world.autopilot.disarm_s;
        flight.touchdown_s = world.autopilot.touchdown_s;
        flight.land_s = world.autopilot.land_s;
        flight
    }

    /// Place and heading of the pad, and its velocity.
    fn pad_at(&self, seconds: f64) -> (Point<Ned>, f64, Vector<Ned>) {
        let PadMotion { velocity, heave: (height_m, period_s), yaw: (yaw, yaw_rate) } =
            self.pad_motion;
        let pace = std::f64::consts::TAU / period_s;
        let (sin, cos) = (pace * seconds).sin_cos();
        let heave = Vector::new(0.0, 0.0, height_m * sin);
        let rate = velocity + Vector::new(0.0, 0.0, height_m * pace * cos);
        (self.pad + velocity * seconds + heave, yaw + yaw_rate * seconds, rate)
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
            touch: None,
            error_m: f64::INFINITY,
            overshoot_m: 0.0,
            max_tilt_rad: 0.0,
            aborted: false,
        }
    }

    fn note(&mut self, world: &World, scene: &Scene, decision: Decision) {
        let vehicle = &world.vehicle;
        self.aborted |= decision.phase == Phase::Aborted && self.touch.is_none();
        self.samples.push(Sample {
            seconds: world.seconds,
            position: vehicle.position,
            velocity: vehicle.velocity,
            pad: scene.pad_at(world.seconds).0,
            decision,
        });
    }

    fn watch(&mut self, world: &World, scene: &Scene) {
        let vehicle = &world.vehicle;
        let (pad, _, pad_velocity) = scene.pad_at(world.seconds);
        let way = scene.pad - scene.start;
        let gone = vehicle.position - pad;
        if way.horizontal_norm() > 0.1 {
            let beyond = (gone.x() * way.x() + gone.y() * way.y()) / way.horizontal_norm();
            self.overshoot_m = self.overshoot_m.max(beyond);
        }
        self.max_tilt_rad = self.max_tilt_rad.max(vehicle.tilt_rad());
        if vehicle.on_ground && self.touch.is_none() {
            let hit = world.before_touch - pad_velocity;
            let error_m = gone.horizontal_norm();
            self.error_m = error_m;
            self.touch = Some(Touch {
                error_m,
                sink_m_s: hit.z(),
                slide_m_s: hit.horizontal_norm(),
                tilt_rad: vehicle.tilt_rad(),
                heading_rad: vehicle.ned_from_body().euler().2,
            });
        }
    }

    /// The sample nearest after `seconds`.
    pub(crate) fn at(&self, seconds: f64) -> Option<&Sample> {
        self.samples.iter().find(|sample| sample.seconds >= seconds)
    }

    /// True when the vehicle touched the ground far from the pad, hard or sliding, and the landing had not been given up.
    pub(crate) fn is_unsafe(&self) -> bool {
        self.touch.is_some_and(|touch| {
            !self.aborted && (touch.error_m > 0.3 || touch.sink_m_s > 0.8 || touch.slide_m_s > 0.5)
        })
    }
}

struct World {
    seconds: f64,
    vehicle: Multirotor,
    air: Air,
    autopilot: Autopilot,
    eyes: Eyes,
    demand: Demand,
    sent_s: f64,
    before_touch: Vector<Ned>,
}

impl World {
    fn new(scene: &Scene) -> Self {
        let vehicle = Multirotor::new(scene.start, scene.heading_rad, scene.seed);
        Self {
            seconds: 0.0,
            air: Air::new(scene.wind, scene.seed),
            autopilot: Autopilot::new(
                scene.estimator,
                &vehicle,
                (scene.refuses_land, scene.link_s),
                scene.seed,
            ),
            eyes: Eyes::new(scene),
            vehicle,
            demand: Demand { thrust: multirotor::GRAVITY, ..Demand::default() },
            sent_s: f64::NEG_INFINITY,
            before_touch: Vector::zero(),
        }
    }

    /// Lets the autopilot learn the wind, and puts the vehicle back to its start.
    fn warm_up(&mut self, scene: &Scene) {
        self.seconds = -WARM_UP_S;
        while self.seconds < -1e-9 {
            self.seconds += STEP_S;
            self.fly(scene);
        }
        self.seconds = 0.0;
        self.autopilot.shift(scene.start - self.vehicle.position);
        self.vehicle.position = scene.start;
    }

    fn fly(&mut self, scene: &Scene) {
        let (pad, _, pad_velocity) = scene.pad_at(self.seconds);
        let height_m = pad.z() - self.vehicle.position.z();
        let wind = self.air.step(STEP_S, self.seconds, height_m);
        if !self.vehicle.on_ground {
            self.before_touch = self.vehicle.velocity;
        }
        self.vehicle.step(STEP_S, wind, &self.demand, pad.z(), pad_velocity);
        self.demand = self.autopilot.step(STEP_S, self.seconds, &self.vehicle);
    }

    fn advance(&mut self, scene: &Scene) {
        self.seconds += STEP_S;
        if scene.pilot_s.is_some_and(|at| self.seconds >= at) {
            self.autopilot.mode = landing::Mode::Other;
        }
        self.fly(scene);
        let (pad, yaw, _) = scene.pad_at(self.seconds);
        self.eyes.look(scene, self.seconds, &self.vehicle, (pad, yaw));
    }

    /// What the lander is told after this step: states at 50 Hz, frames as they arrive, ticks at 20 Hz.
    fn events(
        &mut self,
        scene: &Scene,
        step: u32,
        commands: &mut VecDeque<(f64, OperatorCommand)>,
    ) -> Vec<Event> {
        let mut events = Vec::new();
        if step.is_multiple_of(8) && !self.link_is_lost(scene) {
            events.push(Event::Vehicle(self.autopilot.state(self.seconds - 0.005)));
        }
        events.extend(self.eyes.arrived(self.seconds).map(Event::Frame));
        if step.is_multiple_of(20) {
            events.push(Event::Tick);
        }
        if commands.front().is_some_and(|(at, _)| *at <= self.seconds) {
            events.extend(commands.pop_front().map(|(_, command)| Event::Operator(command)));
        }
        events
    }

    fn link_is_lost(&self, scene: &Scene) -> bool {
        scene.link_lost_s.is_some_and(|(from, to)| (from..to).contains(&self.seconds))
    }

    /// Sends what was decided, as the controller does.
    fn obey(&mut self, scene: &Scene, decision: Decision, is_frame: bool) {
        if self.link_is_lost(scene) {
            return;
        }
        match decision.action {
            Action::None => {}
            Action::Land => self.autopilot.send(self.seconds, Packet::Land),
            Action::Guided => self.autopilot.send(self.seconds, Packet::Guided),
            Action::Disarm => self.autopilot.send(self.seconds, Packet::Disarm),
            Action::Velocity { velocity, yaw_rate } => {
                if is_frame || self.seconds - self.sent_s >= SETPOINT_PERIOD_S - 1e-6 {
                    self.sent_s = self.seconds;
                    self.autopilot.send(self.seconds, Packet::Velocity(velocity, yaw_rate));
                }
            }
        }
    }
}
