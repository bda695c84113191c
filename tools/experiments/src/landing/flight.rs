//! Flies one flight in lock-step: the simulated autopilot and the controller exchange MAVLink packets, detections
//! arrive after their latency, and nothing waits for a clock.

use std::collections::{BTreeMap, VecDeque};
use std::io::Write;

use anyhow::Context;
use autopilot::Parser;
use controller::tape::TapedFlight;
use geometry::{Ned, Point, Vector};
use messages::Phase;
use world::World;
use world::vehicle::VehicleTruth;
use world::world::STEP_S;

use super::configuration;
use super::outcome::{Ending, MAX_HOP_M, Outcome, greater};
use super::plan::Planned;
use super::recording::Recording;
use super::sim_vision::{Arrival, DETECTOR, SimVision};

/// Steps of the world per tick of the controller: 25 ms.
const TICK_STEPS: u64 = 10;
/// Timeout for the start of the landing, in seconds.
const START_TIMEOUT_S: f64 = 30.0;
/// Timeout for the landing, in seconds: a little more than the controller's.
const LANDING_TIMEOUT_S: f64 = 320.0;
/// Time recorded after a landing, in seconds; and after the end of a controller that gave up, which may have the vehicle climb from
/// the ground.
const AFTER_S: f64 = 0.5;
const AFTER_ABORT_S: f64 = 2.0;
/// Time recorded after disarming, in seconds: the autopilot reports it once per second.
const AFTER_DISARM_S: f64 = 3.0;
/// The controller's clock at time 0 of the world, in nanoseconds.
const START_NS: i64 = 1_000_000_000;
/// Maximum number of detections in transit.
const MAX_IN_TRANSIT: usize = 256;

/// A sample of the flight, for the figures.
#[derive(Clone, Debug)]
pub struct Sample {
    /// Since the start of the landing, in seconds.
    pub time_s: f64,
    /// Position of the vehicle, in metres.
    pub position: Point<Ned>,
    /// Position of the pad, in metres.
    pub pad: Point<Ned>,
    /// The velocity setpoint, if any, in m/s.
    pub command: Option<[f64; 3]>,
    /// The air's velocity, in m/s.
    pub wind: Vector<Ned>,
    /// The controller's phase.
    pub phase: Phase,
}

/// Flies it, with an optional trace at 40 Hz.
///
/// # Errors
/// When a setting is invalid or a frame cannot be rendered.
pub fn fly(planned: &Planned, trace: Option<&mut Vec<Sample>>) -> anyhow::Result<Outcome> {
    let mut flight = LockstepFlight::new(planned)
        .with_context(|| format!("seed {} of {}", planned.seed, planned.cell))?;
    flight.run(trace)?;
    Ok(flight.outcome)
}

/// Flies it, and writes a recording of it to `output`, with the controller's tape.
///
/// # Errors
/// As [`fly`], and when the output does not take it.
pub fn fly_recorded<'a>(planned: &Planned, output: impl Write + 'a) -> anyhow::Result<Outcome> {
    let run = || {
        let mut flight = LockstepFlight::new(planned)?;
        flight.record(Recording::begin(Box::new(output), planned)?)?;
        flight.run(None)?;
        Ok::<_, anyhow::Error>(flight.outcome)
    };
    run().with_context(|| format!("seed {} of {}", planned.seed, planned.cell))
}

struct LockstepFlight<'a> {
    world: World,
    vision: SimVision,
    controller: TapedFlight,
    recording: Option<Recording<'a>>,
    /// The configurations as TOML, by service.
    configurations: BTreeMap<&'static str, String>,
    from_world: Parser,
    to_world: Parser,
    frame_period_s: f64,
    sequence: u64,
    in_transit: VecDeque<Arrival>,
    start_s: Option<f64>,
    was_in_retry: bool,
    /// Greatest height over the pad since the last touch, in metres.
    hop_m: Option<f64>,
    outcome: Outcome,
}

impl<'a> LockstepFlight<'a> {
    fn new(planned: &Planned) -> anyhow::Result<Self> {
        let simulated = configuration::<simulator::Config>("simulator", &planned.change.simulator)?;
        let controlled =
            configuration::<controller::Config>("controller", &planned.change.controller)?;
        let configurations = BTreeMap::from([
            ("simulator", simulated.table.to_string()),
            ("controller", controlled.table.to_string()),
        ]);
        let (simulated, controlled) = (simulated.settings, controlled.settings);
        let world = World::new(&simulated.world(), simulated.seed);
        let vision = SimVision::new(&simulated, planned.vision, planned.change.vision)?;
        let begun_ns = stamp_ns(world.now_s());
        let mut controller = TapedFlight::new(begun_ns, controlled, std::sync::Arc::default())?;
        let frame_period_s = 1.0 / simulated.camera.rate_hz;
        controller.presence(stamp_ns(world.now_s()), DETECTOR, true);
        controller.camera(stamp_ns(world.now_s()), vision.info().clone());
        Ok(Self {
            sequence: (world.now_s() / frame_period_s) as u64 + 1,
            world,
            vision,
            controller,
            recording: None,
            configurations,
            from_world: Parser::new(),
            to_world: Parser::new(),
            frame_period_s,
            in_transit: VecDeque::new(),
            start_s: None,
            was_in_retry: false,
            hop_m: None,
            outcome: Outcome::new(planned),
        })
    }

    fn record(&mut self, mut recording: Recording<'a>) -> anyhow::Result<()> {
        let now_ns = stamp_ns(self.world.now_s());
        let camera = self.vision.info();
        recording.started(now_ns, &self.configurations, camera)?;
        self.recording = Some(recording);
        Ok(())
    }

    fn run(&mut self, mut trace: Option<&mut Vec<Sample>>) -> anyhow::Result<()> {
        let opened_s = self.world.now_s();
        let mut steps: u64 = 0;
        let mut over_s = None;
        loop {
            let before = self.world.truth();
            let now_s = opened_s + (steps + 1) as f64 * STEP_S;
            steps += 1;
            self.world.advance_to(now_s);
            self.record_touchdown(&before);
            self.pass_to_controller()?;
            self.update_vision()?;
            if steps.is_multiple_of(TICK_STEPS) {
                let now_ns = stamp_ns(self.world.now_s());
                self.controller.tick(now_ns);
                self.record_status(trace.as_deref_mut());
                match &mut self.recording {
                    Some(recording) => {
                        recording.tick(now_ns, &mut self.controller, &self.world, &self.outcome)?;
                    }
                    // It is not read.
                    None => drop(self.controller.take_tape()),
                }
                if over_s.is_none() && self.is_over() {
                    over_s = Some(now_s);
                }
            }
            self.pass_to_autopilot();
            let waited_s = now_s - self.start_s.unwrap_or(opened_s);
            let timeout_s =
                if self.start_s.is_some() { LANDING_TIMEOUT_S } else { START_TIMEOUT_S };
            let is_landed = self.outcome.phase == Phase::Landed;
            let after_s = if is_landed { AFTER_S } else { AFTER_ABORT_S };
            if over_s.is_some_and(|at_s| now_s - at_s > after_s) || waited_s > timeout_s {
                self.finish();
                let recording = self.recording.take();
                let end_ns = stamp_ns(self.world.now_s());
                return recording.map_or(Ok(()), |it| it.end(end_ns, &mut self.controller));
            }
        }
    }

    /// Passes the autopilot's packets to the controller.
    fn pass_to_controller(&mut self) -> anyhow::Result<()> {
        let now_ns = stamp_ns(self.world.now_s());
        let packets: Vec<Vec<u8>> = self.world.outgoing().collect();
        for frame in packets.iter().flat_map(|packet| self.from_world.push(packet)) {
            self.controller.packet(now_ns, &frame);
            if let Some(recording) = &mut self.recording {
                recording.packet(now_ns, &frame.raw)?;
            }
        }
        Ok(())
    }

    /// Takes frames after their exposure, and delivers detections after their latency.
    fn update_vision(&mut self) -> anyhow::Result<()> {
        let now_s = self.world.now_s();
        let time_s = self.sequence as f64 * self.frame_period_s;
        if now_s >= time_s + 0.5 * self.vision.exposure_s() + STEP_S {
            let arrivals = self.vision.observe(&self.world, self.sequence, time_s, stamp_ns)?;
            self.sequence += 1;
            self.outcome.frames += u64::from(!arrivals.is_empty());
            for arrival in arrivals {
                if self.in_transit.len() < MAX_IN_TRANSIT {
                    let place = self.in_transit.partition_point(|other| other.at_s <= arrival.at_s);
                    self.in_transit.insert(place, arrival);
                }
            }
        }
        while self.in_transit.front().is_some_and(|arrival| arrival.at_s <= now_s) {
            if let Some(arrival) = self.in_transit.pop_front() {
                let (now_ns, message) = (stamp_ns(now_s), &arrival.message);
                self.vision.detected(message);
                let is_used = self.controller.detections(now_ns, DETECTOR, message);
                if let Some(recording) = &mut self.recording {
                    recording.detections(now_ns, message, self.controller.flight(), is_used)?;
                }
            }
        }
        Ok(())
    }

    /// Passes the controller's packets to the autopilot.
    fn pass_to_autopilot(&mut self) {
        while let Some(packet) = self.controller.poll_outgoing() {
            for frame in self.to_world.push(&packet) {
                self.world.handle(&frame);
            }
        }
    }

    fn record_touchdown(&mut self, before: &VehicleTruth) {
        let now = self.world.truth();
        let Some(start_s) = self.start_s else { return };
        if !now.on_ground {
            let tilt_deg = now.tilt_rad().to_degrees();
            self.outcome.max_tilt_deg = self.outcome.max_tilt_deg.max(tilt_deg);
        }
        let since_s = self.world.now_s() - start_s;
        let pad = self.world.pad_at(self.world.now_s());
        let away = now.position - pad.position;
        // A height below a hop belongs to the contact of one touchdown.
        let hop_m = self.hop_m.map(|hop_m| hop_m.max(-away.z()));
        (self.hop_m, self.outcome.hop_m) = (hop_m, greater(self.outcome.hop_m, hop_m));
        let is_touch = now.on_ground && !before.on_ground;
        if is_touch {
            let (speed, outcome) = (before.velocity - pad.velocity, &mut self.outcome);
            outcome.sink_m_s = greater(outcome.sink_m_s, Some(speed.z()));
            outcome.slide_m_s = greater(outcome.slide_m_s, Some(speed.horizontal_norm()));
        }
        if is_touch && hop_m.is_none_or(|hop_m| hop_m > MAX_HOP_M) {
            self.hop_m = Some(0.0);
            self.outcome.touchdown_s = Some(since_s);
            self.outcome.error_m = Some(away.horizontal_norm());
            self.outcome.error_north_m = Some(away.x());
            self.outcome.error_east_m = Some(away.y());
            self.outcome.touch_tilt_deg = Some(before.tilt_rad().to_degrees());
        }
        let pilot = self.world.autopilot();
        if pilot.mode() == world::ardupilot::Mode::Land {
            self.outcome.land_s.get_or_insert(since_s);
        }
        if !pilot.armed() {
            self.outcome.disarm_s.get_or_insert(since_s);
        }
    }

    fn record_status(&mut self, trace: Option<&mut Vec<Sample>>) {
        let now_s = self.world.now_s();
        let status = self.controller.flight().status(stamp_ns(now_s));
        if status.started_ns.is_some() && self.start_s.is_none() {
            self.start_s = Some(now_s);
            self.world.begin();
        }
        let Some(start_s) = self.start_s else { return };
        let retries = status.phase == Phase::Retry;
        self.outcome.retries += u32::from(retries && !self.was_in_retry);
        self.was_in_retry = retries;
        self.outcome.detections = status.detections_used;
        if let Some(trace) = trace {
            trace.push(Sample {
                time_s: now_s - start_s,
                position: self.world.truth().position,
                pad: self.world.pad_at(now_s).position,
                command: status.setpoint.map(|setpoint| setpoint.velocity_ned_m_s),
                wind: self.world.wind(),
                phase: status.phase,
            });
        }
        (self.outcome.phase, self.outcome.why) = (status.phase, status.why);
    }

    fn is_over(&self) -> bool {
        let ended = matches!(self.outcome.phase, Phase::Landed | Phase::Aborted | Phase::Failed);
        let since_s = self.start_s.map_or(0.0, |start_s| self.world.now_s() - start_s);
        ended || self.outcome.disarm_s.is_some_and(|at_s| since_s - at_s > AFTER_DISARM_S)
    }

    fn finish(&mut self) {
        let outcome = &mut self.outcome;
        outcome.ending = match outcome.phase {
            Phase::Landed => Ending::Landed,
            Phase::Aborted | Phase::Failed => Ending::Aborted,
            _ => Ending::Unfinished,
        };
    }
}

fn stamp_ns(time_s: f64) -> i64 {
    START_NS.saturating_add((time_s * 1e9).round() as i64)
}
