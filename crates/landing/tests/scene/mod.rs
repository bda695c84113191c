//! Landings in the world of `crates/world`, with the lander in the place of the controller: states at 50 Hz,
//! frames as they arrive, ticks at 20 Hz, setpoints as the controller sends them. One seed gives one flight,
//! to the bit.

#![allow(dead_code, reason = "each test uses a part of it")]

pub(crate) mod cases;
pub(crate) mod eyes;
pub(crate) mod report;

use std::collections::VecDeque;

use geometry::{Ned, Point};
use landing::{
    Action, AutopilotLimits, Config, Decision, Event, Landed, Lander, Mode, MountFindings,
    OperatorCommand, Phase, Timestamp, VehicleState,
};
use world::ardupilot::{self, EstimateConfig};
use world::camera::CameraFaults;
use world::vehicle::VehicleTruth;
use world::vision::VisionFaults;
use world::wind::WindConfig;
use world::world::STEP_S;
use world::{World, WorldConfig};

use eyes::Eyes;

/// Maximum speeds of a safe touchdown, downwards and sideways, in m/s.
pub(crate) const MAX_SINK_M_S: f64 = 0.8;
pub(crate) const MAX_SLIDE_M_S: f64 = 0.3;
/// Minimum interval between setpoints that are not sent with a frame, in seconds.
const SETPOINT_PERIOD_S: f64 = 0.04;
/// Age of a state on arrival, in seconds.
const STATE_AGE_S: f64 = 0.005;
/// Time until another lander begins, in seconds: the autopilot's packets are received and identified first.
const RESUME_S: f64 = 0.5;
/// Steps of the world between two states, and between two ticks.
const STATE_STEPS: u32 = 8;
const TICK_STEPS: u32 = 20;

/// One flight's circumstances. Times count from the start of the landing.
#[derive(Clone, Debug)]
pub(crate) struct Scene {
    pub(crate) seed: u64,
    pub(crate) config: Config,
    pub(crate) world: WorldConfig,
    pub(crate) camera: CameraFaults,
    pub(crate) vision: VisionFaults,
    pub(crate) frames_hz: f64,
    /// The detector reports a covariance.
    pub(crate) has_covariance: bool,
    /// Size of the marker relative to the thesis'.
    pub(crate) marker_scale: f64,
    /// The camera is turned about the vertical by this much more than configured, clockwise seen from above.
    pub(crate) camera_turned_rad: f64,
    /// Its image is mirrored.
    pub(crate) mirrored: bool,
    /// The camera is turned about the vehicle's forward axis and that to the right by these angles more than
    /// configured, in addition to the error that the seed draws.
    pub(crate) mount_off_rad: [f64; 2],
    /// Height of the body's origin over the vehicle's lowest point, in metres; the world has none.
    pub(crate) standing_m: f64,
    /// Its focal length over the configured one.
    pub(crate) focal_ratio: f64,
    /// The operator's commands, by time.
    pub(crate) commands: Vec<(f64, OperatorCommand)>,
    /// Further events that the lander receives, by time.
    pub(crate) events: Vec<(f64, Event)>,
    /// The autopilot ignores the request to land.
    pub(crate) refuses_land: bool,
    /// The pilot takes over at this time.
    pub(crate) pilot_s: Option<f64>,
    /// From this height over the pad down, in metres, two detectors see the marker at two positions.
    pub(crate) disputed_below_m: f64,
    /// The lander falls silent in the descent.
    pub(crate) silence: Option<Silence>,
    /// The autopilot does not report in GUIDED that it is on the ground, as ArduPilot's for 7 s after the touchdown.
    pub(crate) is_ground_reported_late: bool,
    /// The autopilot's setpoint timeout, in seconds, and whether the lander knows it.
    pub(crate) setpoint_timeout_s: f64,
    pub(crate) is_timeout_known: bool,
    /// Maximum duration, in seconds.
    pub(crate) limit_s: f64,
}

/// A lander that neither gets nor sends anything, as one that is killed or stopped.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Silence {
    /// Height over the pad at which it begins, in metres.
    pub(crate) below_m: f64,
    /// Its duration, in seconds.
    pub(crate) for_s: f64,
    /// The lander after it.
    pub(crate) then: Then,
}

/// The lander after its silence.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) enum Then {
    /// The same continues.
    Continues,
    /// Another one takes over, and receives the pad's position from the earlier one.
    AnotherWithPad,
    /// Another one takes over, without any position of the pad.
    Another,
}

/// The state at one time.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Sample {
    pub(crate) seconds: f64,
    pub(crate) position: Point<Ned>,
    pub(crate) decision: Decision,
    /// Position of the pad.
    pub(crate) pad: Point<Ned>,
    /// The certain errors of the camera's mount.
    pub(crate) mount: MountFindings,
    /// How many times as large as configured the marker is according to the lander.
    pub(crate) size: Option<f64>,
    /// For how long it has been on the ground, in seconds.
    pub(crate) on_ground_s: f64,
}

/// The moment of the touchdown; velocities are relative to the pad.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Touchdown {
    /// Horizontal distance from the pad, in metres.
    pub(crate) error_m: f64,
    pub(crate) sink_m_s: f64,
    pub(crate) slide_m_s: f64,
    pub(crate) tilt_rad: f64,
    pub(crate) heading_rad: f64,
}

/// One flight.
#[derive(Debug)]
pub(crate) struct Flight {
    pub(crate) samples: Vec<Sample>,
    pub(crate) phase: Phase,
    /// The measured height of the body's origin on the pad, in metres.
    pub(crate) standing_height_m: Option<f64>,
    /// Seconds until LAND, until the ground, and until disarmed.
    pub(crate) land_s: Option<f64>,
    pub(crate) touchdown_s: Option<f64>,
    pub(crate) disarm_s: Option<f64>,
    pub(crate) touchdown: Option<Touchdown>,
    /// As in `touchdown`; infinite without one.
    pub(crate) error_m: f64,
    /// Largest distance beyond the pad, along the line to it, in metres.
    pub(crate) overshoot_m: f64,
    pub(crate) max_tilt_rad: f64,
    /// The landing was aborted before the touchdown.
    pub(crate) aborted: bool,
    /// Since when it is on the ground, in seconds.
    pub(crate) on_ground_since_s: Option<f64>,
}

impl Scene {
    /// The thesis' field in calm air: 10 m over the origin, the pad at (1.5, -1.5).
    pub(crate) fn new(seed: u64) -> Self {
        let mut world = WorldConfig::default();
        world.vehicle.rotor_m = 0.2;
        world.vehicle.start_height_m = 10.0;
        world.autopilot.setpoint_latency_s = 0.03;
        Self {
            seed,
            config: Config::default(),
            world,
            camera: CameraFaults {
                latency_s: 0.08,
                jitter_s: 0.02,
                mount_error_rad: 0.002,
                ..CameraFaults::default()
            },
            vision: VisionFaults { miss: 0.03, ..VisionFaults::default() },
            frames_hz: 15.0,
            has_covariance: true,
            marker_scale: 1.0,
            camera_turned_rad: 0.0,
            mirrored: false,
            mount_off_rad: [0.0; 2],
            standing_m: 0.0,
            focal_ratio: 1.0,
            commands: vec![(0.0, OperatorCommand::Start)],
            events: Vec::new(),
            refuses_land: false,
            pilot_s: None,
            disputed_below_m: f64::NEG_INFINITY,
            silence: None,
            is_ground_reported_late: false,
            setpoint_timeout_s: 0.5,
            is_timeout_known: true,
            limit_s: 120.0,
        }
    }

    /// The same in wind from a direction that the seed draws.
    pub(crate) fn windy(seed: u64, mean_m_s: f64, turbulence: f64) -> Self {
        let from_rad = seed as f64 * 2.399;
        let mut scene = Self::new(seed);
        scene.world.wind = WindConfig { mean_m_s, from_rad, turbulence, ..WindConfig::default() };
        scene
    }

    /// The same with a change.
    pub(crate) fn with(mut self, change: impl FnOnce(&mut Self)) -> Self {
        change(&mut self);
        self
    }

    /// The same from another start.
    pub(crate) fn from(self, start: Point<Ned>) -> Self {
        self.with(|scene| {
            scene.world.vehicle.start = Point::new(start.x(), start.y(), 0.0);
            scene.world.vehicle.start_height_m = -start.z();
        })
    }

    /// The same with an autopilot and a mount without errors.
    pub(crate) fn perfect(self) -> Self {
        self.with(|scene| {
            scene.world.autopilot.estimate = EstimateConfig::perfect();
            scene.camera.mount_error_rad = 0.0;
        })
    }

    /// Flies until the landing ends or the time is over.
    pub(crate) fn fly(self) -> Flight {
        let mut flight = Flight::new();
        let Ok(mut lander) = Lander::new(self.config) else { return flight };
        let mut run = Run::new(&self);
        if self.is_timeout_known {
            let setpoint_timeout_s = Some(self.setpoint_timeout_s);
            let limits = AutopilotLimits { setpoint_timeout_s, ..AutopilotLimits::default() };
            lander.step(Timestamp::from_seconds(run.seconds()), Event::Limits(limits));
        }
        let mut step = 0u32;
        let mut left = None;
        let mut was_silent = false;
        while run.seconds() < self.limit_s {
            let before = run.world.truth();
            run.advance();
            let is_silent = run.is_silent();
            if !is_silent {
                left = lander.pad_to_remember().map(|seen| seen.pad).or(left);
            }
            let then = self.silence.map_or(Then::Continues, |silence| silence.then);
            if std::mem::replace(&mut was_silent, is_silent)
                && !is_silent
                && then != Then::Continues
            {
                let Ok(another) = Lander::new(self.config) else { return flight };
                lander = another;
                lander.resume(left.filter(|_| then == Then::AnotherWithPad));
                run.resume_s = Some(run.seconds() + RESUME_S);
            }
            for event in run.events(step).into_iter().filter(|_| !is_silent) {
                let decision = lander.step(Timestamp::from_seconds(run.seconds()), event);
                run.obey(decision, matches!(event, Event::Frame(_)));
                flight.note(&run, decision, &lander);
            }
            flight.watch(&run, &before);
            step += 1;
            let is_over = flight.disarm_s.is_some_and(|at| run.seconds() > at + 1.0);
            if is_over || lander.phase() == Phase::Landed {
                break;
            }
        }
        flight.phase = lander.phase();
        flight.standing_height_m = lander.standing_height_m();
        flight
    }
}

impl Flight {
    fn new() -> Self {
        Self {
            samples: Vec::new(),
            phase: Phase::Idle,
            standing_height_m: None,
            land_s: None,
            touchdown_s: None,
            disarm_s: None,
            touchdown: None,
            error_m: f64::INFINITY,
            overshoot_m: 0.0,
            max_tilt_rad: 0.0,
            aborted: false,
            on_ground_since_s: None,
        }
    }

    fn note(&mut self, run: &Run<'_>, decision: Decision, lander: &Lander) {
        let (mount, size) = (lander.mount_findings(), lander.marker_size_ratio());
        self.aborted |= decision.phase == Phase::Aborted && self.touchdown.is_none();
        let position = run.world.truth().position;
        let pad = run.world.pad_at(run.world.now_s()).position;
        let seconds = run.seconds();
        let on_ground_s = self.on_ground_since_s.map_or(0.0, |since_s| seconds - since_s);
        self.samples.push(Sample { seconds, position, decision, pad, mount, size, on_ground_s });
    }

    fn watch(&mut self, run: &Run<'_>, before: &VehicleTruth) {
        let (now, seconds) = (run.world.truth(), run.seconds());
        let pad = run.world.pad_at(run.world.now_s());
        let away = now.position - pad.position;
        let start = &run.scene.world.vehicle.start;
        let line = run.scene.world.pad.position - *start;
        if line.horizontal_norm() > 0.1 {
            let beyond = (away.x() * line.x() + away.y() * line.y()) / line.horizontal_norm();
            self.overshoot_m = self.overshoot_m.max(beyond);
        }
        self.max_tilt_rad = self.max_tilt_rad.max(now.tilt_rad());
        let since_s = self.on_ground_since_s.unwrap_or(seconds);
        self.on_ground_since_s = now.on_ground.then_some(since_s);
        if now.on_ground && self.touchdown.is_none() {
            let velocity = before.velocity - pad.velocity;
            self.touchdown_s = Some(seconds);
            self.error_m = away.horizontal_norm();
            self.touchdown = Some(Touchdown {
                error_m: self.error_m,
                sink_m_s: velocity.z(),
                slide_m_s: velocity.horizontal_norm(),
                tilt_rad: before.tilt_rad(),
                heading_rad: now.ned_from_body.euler().2,
            });
        }
        if run.world.autopilot().mode() == ardupilot::Mode::Land {
            self.land_s.get_or_insert(seconds);
        }
        if !run.world.autopilot().armed() {
            self.disarm_s.get_or_insert(seconds);
        }
    }

    /// The first sample at or after `seconds`.
    pub(crate) fn at(&self, seconds: f64) -> Option<&Sample> {
        self.samples.iter().find(|sample| sample.seconds >= seconds)
    }

    /// True when the vehicle touched down hard or sliding, or far from the pad in a landing that was not aborted.
    pub(crate) fn is_unsafe(&self) -> bool {
        self.touchdown.is_some_and(|it| {
            let is_far = !self.aborted && it.error_m > 0.3;
            is_far || it.sink_m_s > MAX_SINK_M_S || it.slide_m_s > MAX_SLIDE_M_S
        })
    }
}

/// A flight while it is flown.
struct Run<'a> {
    scene: &'a Scene,
    world: World,
    start_s: f64,
    eyes: Eyes,
    commands: VecDeque<(f64, OperatorCommand)>,
    others: VecDeque<(f64, Event)>,
    sent_s: f64,
    is_disputed: bool,
    /// When the silence began.
    silent_s: Option<f64>,
    /// When another lander begins.
    resume_s: Option<f64>,
}

impl<'a> Run<'a> {
    fn new(scene: &'a Scene) -> Self {
        let mut config = scene.world.clone();
        let timeout = ("GUID_TIMEOUT".to_owned(), scene.setpoint_timeout_s as f32);
        config.autopilot.parameters.push(timeout);
        let mut world = World::new(&config, scene.seed);
        world.begin();
        Self {
            start_s: world.now_s(),
            eyes: Eyes::new(scene),
            commands: scene.commands.iter().copied().collect(),
            others: scene.events.iter().copied().collect(),
            sent_s: f64::NEG_INFINITY,
            is_disputed: false,
            silent_s: None,
            resume_s: None,
            world,
            scene,
        }
    }

    fn seconds(&self) -> f64 {
        self.world.now_s() - self.start_s
    }

    fn advance(&mut self) {
        self.world.advance_to(self.world.now_s() + STEP_S);
        if self.scene.pilot_s.is_some_and(|at| self.seconds() >= at) {
            self.set_mode(ardupilot::Mode::Loiter);
        }
        self.eyes.look(self.scene, &self.world, self.seconds());
    }

    fn height_m(&self) -> f64 {
        let pad = self.world.pad_at(self.world.now_s());
        pad.position.z() - self.world.truth().position.z()
    }

    fn is_silent(&mut self) -> bool {
        let Some(silence) = self.scene.silence else { return false };
        let height_m = self.height_m();
        if height_m <= silence.below_m && !self.world.truth().on_ground {
            self.silent_s.get_or_insert(self.seconds());
        }
        self.silent_s.is_some_and(|since_s| self.seconds() < since_s + silence.for_s)
    }

    fn set_mode(&mut self, mode: ardupilot::Mode) {
        let now_s = self.world.now_s();
        self.world.autopilot_mut().set_mode(now_s, mode);
    }

    fn events(&mut self, step: u32) -> Vec<Event> {
        let now_s = self.seconds();
        let mut events = Vec::new();
        if step.is_multiple_of(STATE_STEPS) && !self.world.link_is_lost() {
            events.push(Event::Vehicle(self.state()));
        }
        events.extend(self.eyes.arrived(now_s).map(Event::Frame));
        self.is_disputed |= self.height_m() <= self.scene.disputed_below_m;
        if self.is_disputed {
            events.push(Event::Dispute(true));
        }
        if step.is_multiple_of(TICK_STEPS) {
            events.push(Event::Tick);
        }
        if self.commands.front().is_some_and(|(at, _)| *at <= now_s) {
            events.extend(self.commands.pop_front().map(|(_, command)| Event::Operator(command)));
        }
        if self.others.front().is_some_and(|(at, _)| *at <= now_s) {
            events.extend(self.others.pop_front().map(|(_, event)| event));
        }
        if self.resume_s.take_if(|at| *at <= now_s).is_some() {
            events.push(Event::Operator(OperatorCommand::Start));
        }
        events
    }

    fn state(&self) -> VehicleState {
        let autopilot = self.world.autopilot();
        let reported = autopilot.reported();
        VehicleState {
            stamp: Timestamp::from_seconds(self.seconds() - STATE_AGE_S),
            ned_from_body: reported.ned_from_body,
            position: reported.position,
            velocity: reported.velocity,
            mode: match autopilot.mode() {
                ardupilot::Mode::Guided => Mode::Guided,
                ardupilot::Mode::Land => Mode::Land,
                _ => Mode::Other,
            },
            armed: autopilot.armed(),
            landed: match autopilot.landed() {
                ardupilot::Landed::OnGround
                    if self.scene.is_ground_reported_late
                        && autopilot.mode() == ardupilot::Mode::Guided =>
                {
                    Landed::InAir
                }
                ardupilot::Landed::OnGround => Landed::OnGround,
                ardupilot::Landed::InAir => Landed::InAir,
                ardupilot::Landed::TakingOff => Landed::TakingOff,
                ardupilot::Landed::Landing => Landed::Landing,
            },
        }
    }

    /// Sends the decision, as the controller does.
    fn obey(&mut self, decision: Decision, is_frame: bool) {
        if self.world.link_is_lost() {
            return;
        }
        let now_s = self.world.now_s();
        match decision.action {
            Action::None => {}
            Action::Land if self.scene.refuses_land => {}
            Action::Land => self.set_mode(ardupilot::Mode::Land),
            Action::Guided => self.set_mode(ardupilot::Mode::Guided),
            Action::Disarm => {
                self.world.autopilot_mut().disarm();
            }
            Action::Velocity { velocity, yaw_rate } => {
                if is_frame || now_s - self.sent_s >= SETPOINT_PERIOD_S - 1e-6 {
                    self.sent_s = now_s;
                    self.world.autopilot_mut().set_velocity(now_s, velocity, yaw_rate);
                }
            }
        }
    }
}
