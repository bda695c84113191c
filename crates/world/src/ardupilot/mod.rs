//! Simulates an autopilot that flies and speaks MAVLink as measured of ArduPilot Copter 4.5.4.
//!
//! It does not depend on sockets: packets are inputs and outputs, and time is an argument.
//!
//! Modules in reading order: `estimate` is its state estimate, `flight` decides, `steering` follows the
//! smooth paths of `shaping` and the target of `precision`, `px4` has the rules of the other firmware,
//! `conversation` handles received packets, `telemetry` sends; `parameters` and `packet` serve both; `direct`
//! does without packets.

mod conversation;
mod direct;
mod estimate;
mod flight;
mod packet;
mod parameters;
mod precision;
mod px4;
mod shaping;
mod steering;
mod telemetry;

use std::collections::VecDeque;

use autopilot::Sender;
use autopilot::dialect::{
    HEARTBEAT_DATA, MavAutopilot, MavMessage, MavModeFlag, MavSeverity, MavState, MavType,
    TIMESYNC_DATA,
};
use autopilot::packet::encode;
use geometry::{Ned, Vector};

pub use direct::ReportedMotion;
pub use estimate::EstimateConfig;
pub use flight::{Landed, Mode};
pub use parameters::Parameter;
pub use steering::SteeringConfig;
pub use telemetry::Origin;

use crate::vehicle::{Demand, VehicleTruth};
use estimate::{Estimate, Estimator};
use flight::{Flight, FlightEvent, Setpoint};
use parameters::Parameters;
use px4::{CURRENT_MODE, Px4, Reported};
use telemetry::{Readiness, Schedule, Telemetry};

/// The simulated autopilot's settings.
#[derive(Clone, Debug, PartialEq)]
pub struct AutopilotConfig {
    /// Time from the start until it can be armed, in seconds; the real one needs about 42.
    pub ready_after_s: f64,
    /// Time from the arrival of a setpoint until it is flown, in seconds.
    pub setpoint_latency_s: f64,
    /// Errors of its state estimator.
    pub estimate: EstimateConfig,
    /// Gains of its position controller.
    pub steering: SteeringConfig,
    /// Where its local origin is on the globe.
    pub origin: Origin,
    /// True when it has a rangefinder that looks down.
    pub rangefinder: bool,
    /// True to forward the heartbeats of a ground station (255/190), as a real one with two links does.
    pub forward_ground_station: bool,
    /// True when it reports that it is a simulation, as simulated autopilots do and real ones do not.
    pub says_simulated: bool,
    /// Whose rules it keeps.
    pub firmware: Firmware,
    /// Parameters that differ from the defaults, by ArduPilot's names and in its units.
    pub parameters: Vec<(String, f32)>,
}

impl Default for AutopilotConfig {
    fn default() -> Self {
        Self {
            ready_after_s: 2.0,
            setpoint_latency_s: 0.02,
            estimate: EstimateConfig::default(),
            steering: SteeringConfig::default(),
            origin: Origin::default(),
            rangefinder: false,
            forward_ground_station: false,
            says_simulated: true,
            firmware: Firmware::ArduPilot,
            parameters: Vec::new(),
        }
    }
}

/// Whose rules a simulated autopilot keeps.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Firmware {
    /// Those that were measured of ArduPilot.
    ArduPilot,
    /// Those of PX4's documentation: modes, OFFBOARD, takeoff, messages. It flies as ArduPilot does.
    Px4,
}

/// Text that a real autopilot sends before its first packet.
const BOOT_TEXT: &str = "\r\n\r\nInit ArduCopter V4.5.4 (simulated)\r\n\r\nFree RAM: 131072\r\n";

/// Maximum number of packets that wait to be fetched; the oldest are dropped first.
const MAX_WAITING: usize = 2048;
/// Components: the autopilot, and the ground station whose heartbeats are forwarded.
const AUTOPILOT: u8 = 1;
const GROUND_STATION: Sender = Sender { system: 255, component: 190 };
/// Parts of the time until ready at which the estimator is aligned and has its origin.
const ALIGNED: f64 = 0.13;
const ORIGIN_SET: f64 = 0.47;
const HEARTBEAT_S: f64 = 1.0;
const TIMESYNC_S: f64 = 10.0;

/// The simulated autopilot.
#[derive(Clone, Debug)]
pub struct SimulatedAutopilot {
    config: AutopilotConfig,
    parameters: Parameters,
    estimator: Estimator,
    estimate: Estimate,
    truth: Option<VehicleTruth>,
    flight: Flight,
    px4: Px4,
    /// The frame of landing targets was refused already.
    target_refused: bool,
    schedule: Schedule,
    setpoints: VecDeque<(f64, Setpoint)>,
    outgoing: VecDeque<Vec<u8>>,
    sequence: u8,
    texts: u16,
    readiness: Readiness,
    now_s: f64,
    heartbeat_due_s: f64,
    timesync_due_s: f64,
}

impl SimulatedAutopilot {
    /// An autopilot that boots at time 0.
    pub fn new(config: AutopilotConfig, seed: u64) -> Self {
        let mut parameters = Parameters::new();
        for (name, value) in &config.parameters {
            parameters.set(name, *value);
        }
        Self {
            parameters,
            estimator: Estimator::new(config.estimate.clone(), seed),
            estimate: Estimate::default(),
            truth: None,
            flight: Flight::new(config.steering.clone(), seed),
            px4: Px4::default(),
            target_refused: false,
            schedule: Schedule::default(),
            setpoints: VecDeque::new(),
            outgoing: VecDeque::from([BOOT_TEXT.as_bytes().to_vec()]),
            sequence: 0,
            texts: 0,
            readiness: Readiness::Booting,
            now_s: 0.0,
            heartbeat_due_s: 0.0,
            timesync_due_s: TIMESYNC_S,
            config,
        }
    }

    /// From now on GNSS drifts and jumps as configured.
    pub fn begin(&mut self) {
        self.estimator.begin();
    }

    /// Takes over a vehicle in the air, armed and in GUIDED, as after a takeoff.
    pub fn start_in_air(&mut self, now_s: f64, truth: &VehicleTruth) {
        self.estimator.settle(truth);
        self.estimate = self.estimator.step(1e-4, truth);
        self.truth = Some(*truth);
        self.readiness = Readiness::Ready;
        self.flight.start_in_air(now_s);
    }

    /// Continues from another position, as if the vehicle had always been there; in metres.
    pub fn carry(&mut self, by: Vector<Ned>) {
        self.flight.carry([by.x(), by.y(), by.z()]);
    }

    /// The flight mode.
    pub fn mode(&self) -> Mode {
        self.flight.mode()
    }

    /// True while the motors turn.
    pub fn armed(&self) -> bool {
        self.flight.armed()
    }

    /// The autopilot's landed state.
    pub fn landed(&self) -> Landed {
        self.flight.landed()
    }

    /// True when it can be armed.
    pub fn ready(&self) -> bool {
        self.readiness == Readiness::Ready
    }

    /// Advances to `now_s`, in seconds since the boot, and returns the demand on the vehicle.
    pub fn step(&mut self, now_s: f64, truth: &VehicleTruth) -> Demand {
        let dt_s = (now_s - self.now_s).clamp(1e-4, 0.1);
        self.now_s = now_s;
        self.truth = Some(*truth);
        self.estimate = self.estimator.step(dt_s, truth);
        self.advance_readiness();
        while self.setpoints.front().is_some_and(|(due_s, _)| *due_s <= now_s) {
            if let Some((due_s, setpoint)) = self.setpoints.pop_front() {
                self.flight.follow(due_s, setpoint);
            }
        }
        let timeout_s = self.parameters.get(Parameter::OffboardLoss);
        if self.is_px4() && self.armed() && self.px4.has_lost_setpoints(now_s, timeout_s) {
            self.flight.set_mode(now_s, Mode::Loiter, &self.estimate);
        }
        let demand = self.flight.step(now_s, dt_s, &self.estimate, truth, &self.parameters);
        self.report_events();
        self.send_due();
        demand
    }

    /// Packets for the link, in order; the first is the text of the boot.
    pub fn outgoing(&mut self) -> impl Iterator<Item = Vec<u8>> + '_ {
        self.outgoing.drain(..)
    }

    /// What PX4 reports of its mode.
    fn reported_mode(&self) -> Reported {
        self.px4.report(self.flight.mode(), self.flight.landed())
    }

    fn is_px4(&self) -> bool {
        self.config.firmware == Firmware::Px4
    }

    fn sender(&self) -> Sender {
        let system = self.parameters.get(Parameter::SystemId) as u8;
        Sender { system, component: AUTOPILOT }
    }

    /// The start-up, with its texts.
    fn advance_readiness(&mut self) {
        let part = self.now_s / self.config.ready_after_s.max(1e-3);
        let info = MavSeverity::MAV_SEVERITY_INFO;
        if self.readiness == Readiness::Booting && part >= ALIGNED {
            self.readiness = Readiness::Aligned;
            self.report_checks();
            for text in
                ["ArduPilot Ready", "AHRS: EKF3 active", "EKF3 IMU0 tilt alignment complete"]
            {
                self.text(info, text);
            }
        }
        if self.readiness == Readiness::Aligned && part >= ORIGIN_SET {
            self.readiness = Readiness::OriginSet;
            self.text(info, "EKF3 IMU0 origin set");
            self.send_message(49);
            self.send_message(242);
        }
        if self.readiness == Readiness::OriginSet && part >= 1.0 {
            self.readiness = Readiness::Ready;
            self.text(info, "EKF3 IMU0 is using GPS");
            self.report_checks();
        }
    }

    /// A PX4 reports the checks that fail.
    fn report_checks(&mut self) {
        if self.is_px4() {
            for event in self.px4.checks(self.ready()) {
                self.send(&event);
            }
        }
    }

    fn report_events(&mut self) {
        for event in self.flight.take_events() {
            if event == FlightEvent::Disarmed && self.is_px4() && self.px4.ends_landing() {
                self.flight.set_mode(self.now_s, Mode::Guided, &self.estimate);
            }
            let text = match event {
                FlightEvent::Disarmed => "Disarming motors".to_owned(),
                FlightEvent::Hit(speed) => format!("SIM Hit ground at {speed:.6} m/s"),
            };
            self.text(MavSeverity::MAV_SEVERITY_INFO, &text);
        }
    }

    /// Sends the messages that are due.
    fn send_due(&mut self) {
        if self.now_s + 5e-7 >= self.heartbeat_due_s {
            self.heartbeat_due_s += HEARTBEAT_S;
            self.send_message(0);
            if self.config.forward_ground_station {
                self.push(|sequence| encode(GROUND_STATION, sequence, &ground_station()));
            }
        }
        if self.now_s + 5e-7 >= self.timesync_due_s {
            self.timesync_due_s += TIMESYNC_S;
            let request =
                TIMESYNC_DATA { ts1: nanoseconds(self.now_s), ..TIMESYNC_DATA::default() };
            self.send(&MavMessage::TIMESYNC(request));
        }
        for id in self.schedule.due(self.now_s) {
            let mode = self.reported_mode();
            if id != CURRENT_MODE || self.px4.reports_mode(self.now_s, mode) {
                self.send_message(id);
            }
        }
    }

    fn telemetry<'a>(&'a self, truth: &'a VehicleTruth) -> Telemetry<'a> {
        Telemetry {
            now_s: self.now_s,
            estimate: &self.estimate,
            truth,
            origin: &self.config.origin,
            readiness: self.readiness,
            mode: self.flight.mode(),
            armed: self.flight.armed(),
            landed: self.flight.landed(),
            target_velocity: self.flight.target_velocity(),
            rangefinder: self.config.rangefinder,
            says_simulated: self.config.says_simulated,
            px4: self.is_px4().then(|| self.reported_mode()),
        }
    }

    fn is_available(&self, id: u32) -> bool {
        let Some(truth) = &self.truth else { return false };
        self.telemetry(truth).message(id).is_some()
    }

    fn send_message(&mut self, id: u32) {
        let Some(truth) = self.truth else { return };
        if let Some(message) = self.telemetry(&truth).message(id) {
            self.send(&message);
        }
    }

    fn text(&mut self, severity: MavSeverity, text: &str) {
        self.texts = self.texts.wrapping_add(1).max(1);
        for part in packet::texts(severity, text, self.texts) {
            self.send(&part);
        }
    }

    fn send(&mut self, message: &MavMessage) {
        let sender = self.sender();
        self.push(|sequence| encode(sender, sequence, message));
    }

    fn push(&mut self, make: impl FnOnce(u8) -> Vec<u8>) {
        if self.outgoing.len() >= MAX_WAITING {
            self.outgoing.pop_front();
        }
        self.outgoing.push_back(make(self.sequence));
        self.sequence = self.sequence.wrapping_add(1);
    }
}

fn nanoseconds(seconds: f64) -> i64 {
    (seconds * 1e9) as i64
}

fn ground_station() -> MavMessage {
    MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        custom_mode: 0,
        mavtype: MavType::MAV_TYPE_GCS,
        autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
        base_mode: MavModeFlag::empty(),
        system_status: MavState::MAV_STATE_ACTIVE,
        mavlink_version: 3,
    })
}
