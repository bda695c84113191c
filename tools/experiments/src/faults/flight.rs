//! Flies one flight with faults in lock-step: world, vision and controller as functions, with connections between
//! them that fail. It continues until the vehicle is stationary, also without a controller.

use anyhow::Context;
use autopilot::Parser;
use messages::{Detection, Detections, Phase, Tape};
use world::World;
use world::vehicle::VehicleTruth;
use world::vision::VisionFaults;
use world::world::STEP_S;

use super::begun::{Begun, BegunFaults};
use super::channel::{Channel, MAX_DELAY_S, MAX_LOSS, MIN_DELAY_S, MIN_LOSS, SOME, Trouble};
use super::controller::{Controller, Life, News, Order, is_terminal};
use super::kind::{FAULTY_DETECTOR, Kind};
use super::link::FaultyLink;
use super::outcome::{Ending, Outcome};
use super::peers::{Behaviour, babble, faulty_detector, other_camera, unknown_detector};
use super::plan::Planned;
use crate::landing::configuration;
use crate::landing::plan::Vision;
use crate::landing::sim_vision::{Arrival, DETECTOR, SimVision};

/// Steps of the world per tick of the controller: 25 ms.
const TICK_STEPS: u64 = 10;
/// The controller's clock at time 0 of the world, in nanoseconds.
const START_NS: i64 = 100_000_000_000;
/// Timeout for the start of the landing, in seconds.
const START_TIMEOUT_S: f64 = 30.0;
/// Timeout for all, in seconds: longer than the controller's for a landing, with its holds.
const TIMEOUT_S: f64 = 420.0;
/// Speed below which the vehicle is stationary in the air, in m/s: in wind it is never quite still.
const REST_M_S: f64 = 0.6;
/// Time without motion after which a flight is over, in seconds: on the ground disarmed or armed, and in the air.
const LANDED_S: f64 = 4.0;
const GROUNDED_S: f64 = 150.0;
const HOVERS_S: f64 = 10.0;
/// Time after the begin of the last fault before which a hover counts for nothing, in seconds: an autopilot
/// waits for setpoints at first.
const AFTER_FAULT_S: f64 = 15.0;
/// A closed socket shows the end of a process after this time, in seconds.
const NOTICED_S: f64 = 0.05;
/// A stopped process is missed after this time, in seconds (`lease` of `local.json5`).
const LEASE_S: f64 = 2.0;
/// Time that a detector or a camera needs to start, and to be met again, in seconds.
const STARTUP_S: f64 = 1.0;
const MEETING_S: f64 = 0.2;
/// Period of the camera's information, in seconds.
const INFO_S: f64 = 1.0;
/// Number of detectors in the fault `crowd`.
const CROWD: usize = 70;
/// The largest step of a camera's clock, in seconds.
const MAX_CLOCK_STEP_S: f64 = 2.0;
/// By how much the positions of a marker in one picture differ, as a fraction of its distance: in the same one, and in those of JPEG
/// qualities from 50 to 95 (4x4-50 of 0.3 m at 1.5 to 10 m, focal length 1000 pixels: from one quality to the next 7e-5 to 7e-4).
const REPEATED_SHARE: f64 = 5e-6;
const RECODED_SHARE: f64 = 5e-4;

/// Flies it.
///
/// # Errors
/// When a setting is invalid or a frame cannot be rendered.
pub fn fly(planned: &Planned) -> anyhow::Result<Outcome> {
    let run = || {
        let mut flight = FaultyFlight::new(planned)?;
        flight.run()?;
        Ok::<_, anyhow::Error>(flight.outcome)
    };
    run().with_context(|| planned.command())
}

/// Flies it, and returns the tape of the controller as well; of one that was started again, those of each life.
///
/// # Errors
/// As [`fly`].
pub fn fly_with_tape(planned: &Planned) -> anyhow::Result<(Outcome, Vec<Tape>)> {
    let run = || {
        let mut flight = FaultyFlight::new(planned)?;
        flight.controller.keep_tapes();
        flight.run()?;
        Ok::<_, anyhow::Error>((flight.outcome, flight.controller.into_tapes()))
    };
    run().with_context(|| planned.command())
}

struct FaultyFlight<'a> {
    planned: &'a Planned,
    world: World,
    vision: SimVision,
    controller: Controller,
    link: FaultyLink,
    to_world: Parser,
    detections: Channel,
    faulty_detections: Channel,
    crowd: Vec<String>,
    frame_period_s: f64,
    sequence: u64,
    /// The newest frame of a stopped detector.
    held: Option<Arrival>,
    /// The detections in the picture that the camera repeats.
    picture: Option<Vec<Detection>>,
    detector_alive: bool,
    crowd_is_announced: bool,
    info_due_s: f64,
    strange_due_s: f64,
    has_faulty_detector: bool,
    height_reached_s: Option<f64>,
    faults: BegunFaults,
    start_s: Option<f64>,
    rest_since_s: Option<f64>,
    /// Where it first touched the ground, downwards, in metres.
    touched_z: Option<f64>,
    outcome: Outcome,
}

impl<'a> FaultyFlight<'a> {
    fn new(planned: &'a Planned) -> anyhow::Result<Self> {
        let simulated =
            configuration::<simulator::Config>("simulator", &planned.simulator)?.settings;
        let world = World::new(&simulated.world(), simulated.seed);
        let vision = SimVision::new(&simulated, Vision::Modelled, VisionFaults::default())?;
        let order =
            Order { tick_first: planned.seed & 1 == 1, detections_first: planned.seed & 2 == 2 };
        let frame_period_s = 1.0 / simulated.camera.rate_hz;
        let channel = |stream| Channel::new(planned.seed, stream);
        let mut flight = Self {
            planned,
            sequence: (world.now_s() / frame_period_s) as u64 + 1,
            controller: Controller::new(stamp_ns(world.now_s()), &planned.controller, order)?,
            world,
            vision,
            link: FaultyLink::new(planned.seed),
            to_world: Parser::new(),
            detections: channel(3),
            faulty_detections: channel(4),
            crowd: (0..CROWD).map(|number| format!("stranger-{number}")).collect(),
            frame_period_s,
            held: None,
            picture: None,
            detector_alive: true,
            crowd_is_announced: false,
            info_due_s: 0.0,
            strange_due_s: 0.0,
            has_faulty_detector: planned
                .faults
                .iter()
                .any(|fault| fault.kind.prefers_a_faulty_detector()),
            height_reached_s: None,
            faults: BegunFaults::default(),
            start_s: None,
            rest_since_s: None,
            touched_z: None,
            outcome: Outcome::new(planned),
        };
        flight.announce_all();
        Ok(flight)
    }

    fn run(&mut self) -> anyhow::Result<()> {
        let opened_s = self.world.now_s();
        let mut steps: u64 = 0;
        loop {
            steps += 1;
            let before = self.world.truth();
            self.world.advance_to(opened_s + steps as f64 * STEP_S);
            let now_s = self.now_s();
            self.record(&before);
            self.begin_faults();
            self.live_and_die()?;
            self.pass_from_autopilot();
            self.see()?;
            self.controller.read(stamp_ns(now_s));
            if steps.is_multiple_of(TICK_STEPS) {
                self.controller.tick(stamp_ns(now_s));
                self.record_status();
                if self.is_over() {
                    return Ok(());
                }
            }
            self.pass_to_autopilot();
            let (since_s, patience_s) = match self.start_s {
                Some(start_s) => (start_s, TIMEOUT_S),
                None => (opened_s, START_TIMEOUT_S),
            };
            if now_s - since_s > patience_s {
                return Ok(());
            }
        }
    }

    fn now_s(&self) -> f64 {
        self.world.now_s()
    }

    fn is_on(&self, kind: Kind) -> bool {
        self.faults.is_on(kind, self.now_s())
    }

    /// True when one of the begun faults is of a kind and within its time.
    fn is_any(&self, is_it: impl Fn(&Begun, f64) -> bool) -> bool {
        let now_s = self.now_s();
        self.faults.all().iter().any(|begun| is_it(begun, now_s))
    }

    fn begin_faults(&mut self) {
        let now_s = self.now_s();
        if self.start_s.is_some()
            && self.height_reached_s.is_none()
            && self.height_over_pad_m() <= self.planned.height_m
        {
            self.height_reached_s = Some(now_s);
            self.outcome.began = true;
        }
        let Some(reached_s) = self.height_reached_s else { return };
        while let Some(fault) = self.planned.faults.get(self.faults.all().len())
            && now_s >= reached_s + fault.after_s
        {
            self.faults.begin(now_s, *fault);
            self.link.begin(now_s, *fault);
        }
    }

    fn height_over_pad_m(&self) -> f64 {
        self.world.pad_at(self.now_s()).position.z() - self.world.truth().position.z()
    }

    /// Processes end, stop and start again.
    fn live_and_die(&mut self) -> anyhow::Result<()> {
        let now_s = self.now_s();
        let life = if self.is_on(Kind::ControllerKilled) {
            Life::Dead
        } else if self.is_on(Kind::ControllerStopped) {
            Life::Stopped
        } else {
            Life::Runs
        };
        if self.controller.set_life(stamp_ns(now_s), life)? {
            self.announce_all();
        }
        let is_missed = self.is_any(|begun, now_s| match begun.fault.kind {
            Kind::DetectorKilled => begun.is_on_later(now_s, NOTICED_S, STARTUP_S),
            Kind::DetectorStopped => begun.is_on_later(now_s, LEASE_S, MEETING_S),
            _ => false,
        });
        if is_missed == self.detector_alive {
            self.detector_alive = !is_missed;
            self.controller.news(News::Presence(DETECTOR.to_owned(), !is_missed));
        }
        if now_s >= self.info_due_s && self.camera_runs() {
            self.info_due_s = now_s + INFO_S;
            self.controller.news(News::Camera(self.vision.info().clone()));
        }
        if self.is_on(Kind::StrangeCamera) && now_s >= self.strange_due_s {
            self.strange_due_s = now_s + 0.5 * INFO_S;
            self.controller.news(News::Camera(other_camera(self.vision.info())));
        }
        if self.is_on(Kind::Crowd) && !self.crowd_is_announced {
            self.crowd_is_announced = true;
            self.announce_crowd();
        }
        Ok(())
    }

    /// Reports the other processes to a controller that has just started.
    fn announce_all(&mut self) {
        self.controller.news(News::Presence(DETECTOR.to_owned(), self.detector_alive));
        if self.has_faulty_detector {
            self.controller.news(News::Presence(FAULTY_DETECTOR.to_owned(), true));
        }
        if self.crowd_is_announced {
            self.announce_crowd();
        }
        self.controller.news(News::Camera(self.vision.info().clone()));
    }

    fn announce_crowd(&mut self) {
        for name in &self.crowd {
            self.controller.news(News::Presence(name.clone(), true));
        }
    }

    fn camera_runs(&self) -> bool {
        !self.is_any(|begun, now_s| match begun.fault.kind {
            Kind::CameraKilled => begun.is_on_later(now_s, 0.0, STARTUP_S),
            Kind::CameraStopped => begun.is_on(now_s),
            _ => false,
        })
    }

    fn detector_runs(&self) -> bool {
        !self.is_any(|begun, now_s| match begun.fault.kind {
            Kind::DetectorKilled => begun.is_on_later(now_s, 0.0, STARTUP_S),
            Kind::DetectorStopped => begun.is_on(now_s),
            _ => false,
        })
    }

    fn frames_trouble(&self) -> Trouble {
        let value = |kind, range| self.faults.value(kind, self.now_s(), range);
        Trouble {
            silent: false,
            delay_s: value(Kind::FramesDelay, MIN_DELAY_S..=MAX_DELAY_S),
            jitter_s: value(Kind::FramesJitter, MIN_DELAY_S..=MAX_DELAY_S),
            loss: value(Kind::FramesLoss, MIN_LOSS..=MAX_LOSS),
            twice: value(Kind::FramesDuplication, SOME..=SOME),
            late: value(Kind::FramesReordering, SOME..=SOME),
            damaged: value(Kind::FramesCorruption, SOME..=SOME),
        }
    }

    fn pass_from_autopilot(&mut self) {
        let now_s = self.now_s();
        let sent: Vec<Vec<u8>> = self.world.outgoing().collect();
        for bytes in sent {
            self.link.put_from_autopilot(now_s, &bytes);
        }
        while let Some(packet) = self.link.take_from_autopilot(now_s) {
            self.controller.packet(packet);
        }
    }

    fn pass_to_autopilot(&mut self) {
        let now_s = self.now_s();
        while let Some(packet) = self.controller.poll_outgoing() {
            self.link.put_to_autopilot(now_s, packet);
        }
        while let Some(packet) = self.link.take_to_autopilot(now_s) {
            let mut packets = self.to_world.push(&packet);
            packets.extend(self.to_world.finish());
            for packet in packets {
                self.world.handle(&packet);
            }
        }
    }

    /// Takes frames, finds the marker in them, and delivers the detections.
    fn see(&mut self) -> anyhow::Result<()> {
        let now_s = self.now_s();
        let time_s = self.sequence as f64 * self.frame_period_s;
        if now_s >= time_s + 0.5 * self.vision.exposure_s() + STEP_S {
            if self.camera_runs() {
                let range = -MAX_CLOCK_STEP_S..=MAX_CLOCK_STEP_S;
                let step_s = self.faults.value(Kind::ClockStep, now_s, range);
                let stamp = |time_s: f64| stamp_ns(time_s + step_s);
                let arrivals = self.vision.observe(&self.world, self.sequence, time_s, stamp)?;
                for arrival in arrivals {
                    let arrival = self.repeated(arrival);
                    self.detect(arrival);
                }
            }
            self.sequence += 1;
        }
        if self.held.is_some() && self.detector_runs() {
            // The detections of a stopped detector in its last frame, late.
            if let Some(held) = self.held.take() {
                self.deliver(&Arrival { at_s: now_s, ..held });
            }
        }
        while let Some(payload) = self.detections.take(now_s) {
            self.controller.detections(DETECTOR, payload);
        }
        while let Some(payload) = self.faulty_detections.take(now_s) {
            self.controller.detections(FAULTY_DETECTOR, payload);
        }
        Ok(())
    }

    /// The detections in the picture of a frame: where the camera repeats a picture, those of that. A detector finds the marker again to
    /// within some millionths, as it has more frames of the camera each time; less well where the picture is coded again.
    fn repeated(&mut self, arrival: Arrival) -> Arrival {
        let offset = if self.is_on(Kind::PictureRecoded) {
            RECODED_SHARE
        } else if self.is_on(Kind::PictureRepeated) {
            REPEATED_SHARE
        } else {
            self.picture = None;
            return arrival;
        };
        let mut detections =
            self.picture.get_or_insert_with(|| arrival.message.detections.clone()).clone();
        let offset = if self.sequence.is_multiple_of(2) { 0.0 } else { offset };
        for pose in detections.iter_mut().filter_map(|it| it.pose.as_mut()) {
            for number in &mut pose.camera_from_marker.translation_m {
                *number *= 1.0 + offset;
            }
        }
        Arrival { message: Detections { detections, ..arrival.message }, ..arrival }
    }

    fn detect(&mut self, arrival: Arrival) {
        if self.detector_runs() {
            self.deliver(&arrival);
        } else if self.is_on(Kind::DetectorStopped) {
            self.held = Some(arrival.clone());
        }
        if self.has_faulty_detector {
            let behaviour = if self.is_on(Kind::LiarJumps) {
                Behaviour::Jumps
            } else if let Some(begun) = self.faults.on(Kind::LiarDrifts, self.now_s()) {
                Behaviour::Drifts(arrival.at_s - begun.at_s)
            } else if self.is_on(Kind::PreferredIsBlind) {
                Behaviour::Blind
            } else {
                Behaviour::Correct
            };
            let payload =
                messages::encode(&faulty_detector(&arrival.message, self.vision.info(), behaviour));
            self.faulty_detections.put(arrival.at_s, payload, &Trouble::default());
        }
        if self.is_on(Kind::Crowd) {
            for (number, name) in self.crowd.iter().enumerate() {
                let camera = self.vision.info();
                let message: Detections = unknown_detector(&arrival.message, camera, name, number);
                self.controller.detections(name, messages::encode(&message));
            }
        }
    }

    fn deliver(&mut self, arrival: &Arrival) {
        let trouble = self.frames_trouble();
        let payload = match self.is_on(Kind::DetectorBabbles) {
            true => messages::encode(&babble(&arrival.message, arrival.message.header.sequence)),
            false => messages::encode(&arrival.message),
        };
        self.detections.put(arrival.at_s, payload, &trouble);
    }

    fn record(&mut self, before: &VehicleTruth) {
        let now = self.world.truth();
        let Some(start_s) = self.start_s else { return };
        let now_s = self.now_s();
        self.outcome.time_s = now_s - start_s;
        if !now.on_ground {
            self.outcome.max_tilt_deg = self.outcome.max_tilt_deg.max(now.tilt_rad().to_degrees());
        }
        if now.on_ground && !before.on_ground {
            let pad = self.world.pad_at(now_s);
            let speed = before.velocity - pad.velocity;
            let error_m = (now.position - pad.position).horizontal_norm();
            self.outcome.touch(speed.z(), speed.horizontal_norm(), error_m);
            self.touched_z.get_or_insert(now.position.z());
        }
        if let Some(touched_z) = self.touched_z {
            self.outcome.hop(touched_z - now.position.z());
        }
        let rests = now.on_ground || now.velocity.norm() < REST_M_S;
        if !rests {
            self.rest_since_s = None;
        } else if self.rest_since_s.is_none() || now.on_ground != before.on_ground {
            self.rest_since_s = Some(now_s);
        }
    }

    fn record_status(&mut self) {
        let now_s = self.now_s();
        let gone = |life: &str| (String::new(), format!("the controller is {life}"), true);
        let (phase, why, is_over) = match self.controller.status(stamp_ns(now_s)) {
            Some(status) => {
                if status.started_ns.is_some() && self.start_s.is_none() {
                    self.start_s = Some(now_s);
                    self.world.begin();
                }
                // A controller that was started again cannot act without heartbeats, or when the vehicle is reported as landed.
                let is_deceived = [
                    Kind::SilenceFrom,
                    Kind::SilenceBoth,
                    Kind::HeartbeatMissing,
                    Kind::LandedOnGround,
                ]
                .into_iter()
                .any(|kind| self.is_on(kind));
                let is_idle = is_deceived && status.phase == Phase::Idle;
                let is_over = is_terminal(status.phase) || is_idle;
                (status.phase.name().to_owned(), status.why, is_over)
            }
            None if self.is_on(Kind::ControllerKilled) => gone("gone"),
            None => gone("stopped"),
        };
        (self.outcome.phase, self.outcome.why, self.outcome.is_over) = (phase, why, is_over);
    }

    /// Whether the vehicle is stationary and nothing more happens.
    fn is_over(&mut self) -> bool {
        let (Some(_), Some(since_s)) = (self.start_s, self.rest_since_s) else { return false };
        let now_s = self.now_s();
        let rests_s = now_s - since_s;
        let on_ground = self.world.truth().on_ground;
        let armed = self.world.autopilot().armed();
        let is_over = self.outcome.is_over;
        // A fault that ends may bring a process back.
        let begun = self.faults.all();
        let pending = begun.iter().any(|begun| {
            begun.fault.for_s.is_finite() && now_s < begun.at_s + begun.fault.for_s + STARTUP_S
        });
        let last_s = begun.last().map_or(f64::NEG_INFINITY, |begun| begun.at_s);
        let faults_wait = self.height_reached_s.is_some()
            && begun.len() < self.planned.faults.len()
            || now_s < last_s + AFTER_FAULT_S
            || pending;
        let ending = match (on_ground, armed) {
            (true, false) if rests_s > LANDED_S && is_over => Ending::Landed,
            (true, false) if rests_s > GROUNDED_S => Ending::Landed,
            (true, true) if rests_s > GROUNDED_S => Ending::Grounded,
            (false, _) if rests_s > HOVERS_S && is_over && !faults_wait => Ending::Hovers,
            _ => return false,
        };
        self.outcome.ending = ending;
        true
    }
}

fn stamp_ns(time_s: f64) -> i64 {
    START_NS.saturating_add((time_s * 1e9).round() as i64)
}
