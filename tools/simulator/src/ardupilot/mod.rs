//! An autopilot that flies and speaks MAVLink as ArduPilot Copter 4.5.4 was measured to do.
//!
//! It knows no socket: packets go in and come out, and time is an argument.
//!
//! Modules in reading order: [`estimate`] is what it believes of its motion, `flight` decides, `steering` flies by
//! the smooth paths of `shaping`, `telemetry` tells, `parameters` and `packet` serve the link.

mod estimate;
mod flight;
mod packet;
mod parameters;
mod shaping;
mod steering;
mod telemetry;

use std::collections::VecDeque;

use autopilot::dialect::{
    HEARTBEAT_DATA, MavAutopilot, MavCmd, MavFrame, MavMessage, MavModeFlag, MavResult,
    MavSeverity, MavState, MavType, PARAM_VALUE_DATA, SET_POSITION_TARGET_LOCAL_NED_DATA,
    TIMESYNC_DATA,
};
use autopilot::frame::encode;
use autopilot::{Frame, Sender};

pub use estimate::EstimateConfig;
pub use flight::{Landed, Mode};
pub use parameters::Parameter;
pub use steering::SteeringConfig;
pub use telemetry::Origin;

use crate::vehicle::{Demand, VehicleTruth};
use estimate::{Estimate, Estimator};
use flight::{Flight, Happening, Setpoint};
use parameters::{Parameters, Shown};
use steering::Nose;
use telemetry::{Readiness, SIM_STATE, Schedule, Situation};

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
            parameters: Vec::new(),
        }
    }
}

/// What a serial line carries before the first packet of a real autopilot.
const BOOT_TEXT: &str = "\r\n\r\nInit ArduCopter V4.5.4 (simulated)\r\n\r\nFree RAM: 131072\r\n";

/// Packets that wait to be fetched; the oldest are lost first.
const MOST_WAITING: usize = 2048;
/// Setpoints that wait out their latency.
const MOST_SETPOINTS: usize = 64;
/// Components: the autopilot, and the ground station whose heartbeats are forwarded.
const AUTOPILOT: u8 = 1;
const GROUND_STATION: Sender = Sender { system: 255, component: 190 };
/// Parts of the time until ready at which the estimator is aligned and has its origin.
const ALIGNED: f64 = 0.13;
const ORIGIN_SET: f64 = 0.47;
const HEARTBEAT_S: f64 = 1.0;
const TIMESYNC_S: f64 = 10.0;
/// param2 of the arm command that makes it unconditional.
const FORCE: f32 = 21196.0;
/// Number of the command with which SET_MODE is acknowledged: its own message number.
const SET_MODE: u16 = 11;

/// The simulated autopilot.
#[derive(Clone, Debug)]
pub struct SimulatedAutopilot {
    config: AutopilotConfig,
    parameters: Parameters,
    estimator: Estimator,
    estimate: Estimate,
    truth: Option<VehicleTruth>,
    flight: Flight,
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

    /// Whether there is a parameter of this name.
    pub fn has_parameter(name: &str) -> bool {
        Parameters::new().by_name(name).is_some()
    }

    /// The flight mode.
    pub fn mode(&self) -> Mode {
        self.flight.mode()
    }

    /// True while the motors turn.
    pub fn armed(&self) -> bool {
        self.flight.armed()
    }

    /// Where the vehicle is between ground and air, as the autopilot believes.
    pub fn landed(&self) -> Landed {
        self.flight.landed()
    }

    /// True when it can be armed.
    pub fn ready(&self) -> bool {
        self.readiness == Readiness::Ready
    }

    /// Takes one packet from the link.
    #[allow(deprecated, reason = "ground stations still send what the standard calls superseded")]
    pub fn handle(&mut self, now_s: f64, frame: &Frame) {
        let from = frame.sender;
        match &frame.message {
            Some(MavMessage::COMMAND_LONG(c))
                if self.is_me(c.target_system, c.target_component) =>
            {
                let values = [c.param1, c.param2, c.param3, c.param4, c.param5, c.param6, c.param7];
                self.command(now_s, from, c.command, values);
            }
            Some(MavMessage::COMMAND_INT(c)) if self.is_me(c.target_system, c.target_component) => {
                let values = [c.param1, c.param2, c.param3, c.param4, c.x as f32, c.y as f32, c.z];
                self.command(now_s, from, c.command, values);
            }
            Some(MavMessage::SET_MODE(m)) if self.is_me(m.target_system, 0) => {
                let custom = m.base_mode.contains(MavModeFlag::MAV_MODE_FLAG_CUSTOM_MODE_ENABLED);
                let result = if custom { self.set_mode(now_s, m.custom_mode) } else { FAILED };
                self.acknowledge(SET_MODE, result, from);
            }
            Some(MavMessage::SET_POSITION_TARGET_LOCAL_NED(target))
                if self.is_me(target.target_system, target.target_component) =>
            {
                self.take_setpoint(now_s, target);
            }
            Some(MavMessage::REQUEST_DATA_STREAM(r))
                if self.is_me(r.target_system, r.target_component) =>
            {
                let rate = f64::from(r.req_message_rate);
                let interval_s = (r.start_stop != 0 && rate > 0.0).then(|| 1.0 / rate);
                self.schedule.set_stream(now_s, r.req_stream_id as u8, interval_s);
            }
            Some(MavMessage::PARAM_REQUEST_LIST(r))
                if self.is_me(r.target_system, r.target_component) =>
            {
                for index in 0..usize::from(Parameters::COUNT) {
                    self.show(self.parameters.by_index(index), true);
                }
            }
            Some(MavMessage::PARAM_REQUEST_READ(r))
                if self.is_me(r.target_system, r.target_component) =>
            {
                let shown = match usize::try_from(r.param_index) {
                    Ok(index) => self.parameters.by_index(index),
                    Err(_) => {
                        r.param_id.to_str().ok().and_then(|name| self.parameters.by_name(name))
                    }
                };
                self.show(shown, true);
            }
            Some(MavMessage::PARAM_SET(p)) if self.is_me(p.target_system, p.target_component) => {
                let name = p.param_id.to_str().unwrap_or_default();
                let shown = self.parameters.set(name, p.param_value);
                self.show(shown, false);
            }
            Some(MavMessage::TIMESYNC(t)) if t.tc1 == 0 => {
                let reply = TIMESYNC_DATA { tc1: nanoseconds(now_s), ts1: t.ts1 };
                self.send(&MavMessage::TIMESYNC(reply));
            }
            _ => {}
        }
    }

    /// Lets time pass until `now_s`, in seconds since the boot, and says what the motors shall do from then on.
    pub fn step(&mut self, now_s: f64, truth: &VehicleTruth) -> Demand {
        let dt_s = (now_s - self.now_s).clamp(1e-4, 0.1);
        self.now_s = now_s;
        self.truth = Some(*truth);
        self.estimate = self.estimator.step(dt_s, truth);
        self.get_ready();
        while self.setpoints.front().is_some_and(|(due_s, _)| *due_s <= now_s) {
            if let Some((due_s, setpoint)) = self.setpoints.pop_front() {
                self.flight.follow(due_s, setpoint);
            }
        }
        let demand = self.flight.step(now_s, dt_s, &self.estimate, truth, &self.parameters);
        self.report_happenings();
        self.tell();
        demand
    }

    /// Packets for the link, in order; the first is the text of the boot.
    pub fn outgoing(&mut self) -> impl Iterator<Item = Vec<u8>> + '_ {
        self.outgoing.drain(..)
    }

    fn me(&self) -> Sender {
        let system = self.parameters.get(Parameter::SystemId) as u8;
        Sender { system, component: AUTOPILOT }
    }

    fn is_me(&self, system: u8, component: u8) -> bool {
        (system == 0 || system == self.me().system) && (component == 0 || component == AUTOPILOT)
    }

    #[allow(deprecated, reason = "ground stations still send what the standard calls superseded")]
    fn command(&mut self, now_s: f64, from: Sender, command: MavCmd, values: [f32; 7]) {
        let [first, second, ..] = values;
        let result = match command {
            MavCmd::MAV_CMD_DO_SET_MODE => {
                let custom = (first as i64) & 1 == 1;
                if custom { self.set_mode(now_s, second as u32) } else { FAILED }
            }
            MavCmd::MAV_CMD_COMPONENT_ARM_DISARM => {
                self.arm_or_disarm(now_s, first, second == FORCE)
            }
            MavCmd::MAV_CMD_NAV_TAKEOFF => {
                accepted(self.flight.take_off(now_s, f64::from(values[6]), &self.estimate))
            }
            MavCmd::MAV_CMD_NAV_LAND => self.set_mode(now_s, Mode::Land as u32),
            MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL => self.set_interval(now_s, first, second),
            MavCmd::MAV_CMD_REQUEST_MESSAGE => {
                self.acknowledge(command as u16, accepted(self.can_tell(first as u32)), from);
                self.tell_one(first as u32);
                return;
            }
            MavCmd::MAV_CMD_GET_HOME_POSITION => {
                self.tell_one(242);
                ACCEPTED
            }
            MavCmd::MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES => {
                self.tell_one(148);
                ACCEPTED
            }
            _ => MavResult::MAV_RESULT_UNSUPPORTED,
        };
        self.acknowledge(command as u16, result, from);
        if command == MavCmd::MAV_CMD_COMPONENT_ARM_DISARM && first == 0.0 {
            self.report_happenings();
        }
    }

    fn set_mode(&mut self, now_s: f64, number: u32) -> MavResult {
        let Some(mode) = Mode::from_number(number) else {
            self.text(MavSeverity::MAV_SEVERITY_WARNING, &format!("No such mode {number}"));
            return FAILED;
        };
        let changes = mode != self.flight.mode();
        self.flight.set_mode(now_s, mode, &self.estimate);
        if changes {
            self.tell_one(0);
        }
        ACCEPTED
    }

    fn arm_or_disarm(&mut self, now_s: f64, which: f32, forced: bool) -> MavResult {
        if which == 0.0 {
            return accepted(self.flight.disarm(forced));
        }
        if which != 1.0 {
            return MavResult::MAV_RESULT_UNSUPPORTED;
        }
        if self.flight.armed() {
            return ACCEPTED;
        }
        if !self.ready() && !forced {
            self.text(MavSeverity::MAV_SEVERITY_CRITICAL, "Arm: Need Position Estimate");
            let long = "Arm: AHRS: EKF3 Yaw inconsistent 77 deg. Wait or reboot";
            self.text(MavSeverity::MAV_SEVERITY_CRITICAL, long);
            return FAILED;
        }
        match self.flight.arm(now_s) {
            Ok(()) => {
                self.text(MavSeverity::MAV_SEVERITY_INFO, "Arming motors");
                self.tell_one(49);
                self.tell_one(242);
                ACCEPTED
            }
            Err(reason) => {
                self.text(MavSeverity::MAV_SEVERITY_CRITICAL, &format!("Arm: {reason}"));
                FAILED
            }
        }
    }

    fn set_interval(&mut self, now_s: f64, id: f32, interval_us: f32) -> MavResult {
        let interval_s = (interval_us > 0.0).then(|| f64::from(interval_us) * 1e-6);
        if self.schedule.set(now_s, id as u32, interval_s) {
            return ACCEPTED;
        }
        let text = format!("No ap_message for mavlink id ({})", id as u32);
        self.text(MavSeverity::MAV_SEVERITY_INFO, &text);
        MavResult::MAV_RESULT_DENIED
    }

    /// Velocities in the frames that ArduPilot takes; everything else it cannot fly is a stop.
    fn take_setpoint(&mut self, now_s: f64, target: &SET_POSITION_TARGET_LOCAL_NED_DATA) {
        let setpoint = self.setpoint(target).unwrap_or(Setpoint::STOP);
        if self.setpoints.len() >= MOST_SETPOINTS {
            self.setpoints.pop_front();
        }
        self.setpoints.push_back((now_s + self.config.setpoint_latency_s, setpoint));
    }

    fn setpoint(&self, target: &SET_POSITION_TARGET_LOCAL_NED_DATA) -> Option<Setpoint> {
        const POSITION: u16 = 0x007;
        const VELOCITY: u16 = 0x038;
        const FORCE_SET: u16 = 0x200;
        const YAW: u16 = 0x400;
        const YAW_RATE: u16 = 0x800;
        let mask = target.type_mask.bits();
        let relative = match target.coordinate_frame {
            MavFrame::MAV_FRAME_LOCAL_NED | MavFrame::MAV_FRAME_LOCAL_OFFSET_NED => false,
            #[allow(deprecated, reason = "ArduPilot takes these and stops at their successor")]
            MavFrame::MAV_FRAME_BODY_NED | MavFrame::MAV_FRAME_BODY_OFFSET_NED => true,
            _ => return None,
        };
        let numbers = [target.vx, target.vy, target.vz, target.yaw, target.yaw_rate].map(f64::from);
        let [x, y, down, yaw, yaw_rate] = numbers;
        let flown = mask & POSITION != 0 && mask & (VELOCITY | FORCE_SET) == 0;
        if !flown || !numbers.iter().all(|number| number.is_finite()) {
            return None;
        }
        let heading = self.estimate.yaw;
        let (sin, cos) = if relative { heading.sin_cos() } else { (0.0, 1.0) };
        let nose = match (mask & YAW == 0, mask & YAW_RATE == 0) {
            (true, _) => Nose::Angle(if relative { heading + yaw } else { yaw }),
            (false, true) => Nose::Rate(yaw_rate),
            (false, false) => Nose::Follow,
        };
        Some(Setpoint { velocity: [cos * x - sin * y, sin * x + cos * y, down], nose })
    }

    /// The start-up, with its texts.
    fn get_ready(&mut self) {
        let part = self.now_s / self.config.ready_after_s.max(1e-3);
        let info = MavSeverity::MAV_SEVERITY_INFO;
        if self.readiness == Readiness::Booting && part >= ALIGNED {
            self.readiness = Readiness::Aligned;
            for text in
                ["ArduPilot Ready", "AHRS: EKF3 active", "EKF3 IMU0 tilt alignment complete"]
            {
                self.text(info, text);
            }
        }
        if self.readiness == Readiness::Aligned && part >= ORIGIN_SET {
            self.readiness = Readiness::OriginSet;
            self.text(info, "EKF3 IMU0 origin set");
            self.tell_one(49);
            self.tell_one(242);
        }
        if self.readiness == Readiness::OriginSet && part >= 1.0 {
            self.readiness = Readiness::Ready;
            self.text(info, "EKF3 IMU0 is using GPS");
        }
    }

    fn report_happenings(&mut self) {
        for happening in self.flight.take_happenings() {
            let text = match happening {
                Happening::Disarmed => "Disarming motors".to_owned(),
                Happening::Hit(speed) => format!("SIM Hit ground at {speed:.6} m/s"),
            };
            self.text(MavSeverity::MAV_SEVERITY_INFO, &text);
        }
    }

    /// Sends what is due.
    fn tell(&mut self) {
        if self.now_s + 5e-7 >= self.heartbeat_due_s {
            self.heartbeat_due_s += HEARTBEAT_S;
            self.tell_one(0);
            if self.config.forward_ground_station {
                self.push(|sequence| encode(GROUND_STATION, sequence, &ground_station()));
            }
        }
        if self.now_s + 5e-7 >= self.timesync_due_s {
            self.timesync_due_s += TIMESYNC_S;
            let request = TIMESYNC_DATA { tc1: 0, ts1: nanoseconds(self.now_s) };
            self.send(&MavMessage::TIMESYNC(request));
        }
        for id in self.schedule.due(self.now_s) {
            self.tell_one(id);
        }
    }

    fn situation<'a>(&'a self, truth: &'a VehicleTruth) -> Situation<'a> {
        Situation {
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
        }
    }

    fn can_tell(&self, id: u32) -> bool {
        let Some(truth) = &self.truth else { return false };
        id == SIM_STATE || self.situation(truth).message(id).is_some()
    }

    fn tell_one(&mut self, id: u32) {
        let Some(truth) = self.truth else { return };
        if id == SIM_STATE {
            let payload = self.situation(&truth).sim_state();
            self.send_raw(SIM_STATE, &payload);
        } else if let Some(message) = self.situation(&truth).message(id) {
            self.send(&message);
        }
    }

    fn show(&mut self, shown: Option<Shown>, indexed: bool) {
        let Some(Shown { index, name, kind, value }) = shown else { return };
        self.send(&MavMessage::PARAM_VALUE(PARAM_VALUE_DATA {
            param_value: value,
            param_count: Parameters::COUNT,
            param_index: if indexed { index } else { u16::MAX },
            param_id: name.into(),
            param_type: kind,
        }));
    }

    fn acknowledge(&mut self, command: u16, result: MavResult, to: Sender) {
        const COMMAND_ACK: u32 = 77;
        self.send_raw(COMMAND_ACK, &packet::acknowledgement(command, result, to));
    }

    fn text(&mut self, severity: MavSeverity, text: &str) {
        const STATUSTEXT: u32 = 253;
        self.texts = self.texts.wrapping_add(1).max(1);
        for payload in packet::texts(severity, text, self.texts) {
            self.send_raw(STATUSTEXT, &payload);
        }
    }

    fn send(&mut self, message: &MavMessage) {
        let me = self.me();
        self.push(|sequence| encode(me, sequence, message));
    }

    fn send_raw(&mut self, message_id: u32, payload: &[u8]) {
        let me = self.me();
        self.push(|sequence| packet::packet(me, sequence, message_id, payload));
    }

    fn push(&mut self, make: impl FnOnce(u8) -> Vec<u8>) {
        if self.outgoing.len() >= MOST_WAITING {
            self.outgoing.pop_front();
        }
        self.outgoing.push_back(make(self.sequence));
        self.sequence = self.sequence.wrapping_add(1);
    }
}

const ACCEPTED: MavResult = MavResult::MAV_RESULT_ACCEPTED;
const FAILED: MavResult = MavResult::MAV_RESULT_FAILED;

fn accepted(yes: bool) -> MavResult {
    if yes { ACCEPTED } else { FAILED }
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
