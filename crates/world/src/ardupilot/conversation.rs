//! Handles the MAVLink packets that the simulated autopilot receives: commands and their acknowledgements, modes,
//! arming, intervals, parameters, setpoints, landing targets.

use autopilot::dialect::{
    LANDING_TARGET_DATA, MavCmd, MavFrame, MavMessage, MavModeFlag, MavResult, MavSeverity,
    Message, PARAM_VALUE_DATA, SET_POSITION_TARGET_LOCAL_NED_DATA, TIMESYNC_DATA,
};
use autopilot::{Packet, Sender};
use geometry::{Body, Ned, Rotation, Vector};

use super::flight::{Mode, Setpoint};
use super::parameters::{Parameter, ParameterValue, Parameters};
use super::px4::{CURRENT_MODE, current_mode};
use super::steering::HeadingCommand;
use super::{SimulatedAutopilot, nanoseconds, packet};

/// Maximum number of setpoints that wait for their latency.
const MAX_SETPOINTS: usize = 64;
/// param2 of the arm command that makes it unconditional.
const FORCE: f32 = 21196.0;
/// Number of the command with which SET_MODE is acknowledged: its own message number.
const SET_MODE: u16 = 11;

const ACCEPTED: MavResult = MavResult::MAV_RESULT_ACCEPTED;
const FAILED: MavResult = MavResult::MAV_RESULT_FAILED;

fn accepted(yes: bool) -> MavResult {
    if yes { ACCEPTED } else { FAILED }
}

impl SimulatedAutopilot {
    /// Takes one packet from the link.
    #[allow(deprecated, reason = "ground stations still send superseded messages")]
    pub fn handle(&mut self, now_s: f64, packet: &Packet) {
        let Some(message) = packet.message.as_ref().filter(|message| self.is_addressed(message))
        else {
            return;
        };
        let from = packet.sender;
        match message {
            MavMessage::COMMAND_LONG(c) => {
                let values = [c.param1, c.param2, c.param3, c.param4, c.param5, c.param6, c.param7];
                self.command(now_s, from, c.command, values);
            }
            MavMessage::COMMAND_INT(c) => {
                let values = [c.param1, c.param2, c.param3, c.param4, c.x as f32, c.y as f32, c.z];
                self.command(now_s, from, c.command, values);
            }
            MavMessage::SET_MODE(m) => {
                let custom = m.base_mode.contains(MavModeFlag::MAV_MODE_FLAG_CUSTOM_MODE_ENABLED);
                let result = if custom { self.change_mode(now_s, m.custom_mode) } else { FAILED };
                self.acknowledge(SET_MODE, result, from);
            }
            MavMessage::SET_POSITION_TARGET_LOCAL_NED(target) => self.take_setpoint(now_s, target),
            MavMessage::LANDING_TARGET(target) => self.take_landing_target(now_s, target),
            MavMessage::REQUEST_DATA_STREAM(r) => {
                let rate = f64::from(r.req_message_rate);
                let interval_s = (r.start_stop != 0 && rate > 0.0).then(|| 1.0 / rate);
                self.schedule.set_stream(now_s, r.req_stream_id as u8, interval_s);
            }
            MavMessage::TIMESYNC(t) if t.tc1 == 0 => {
                let reply = TIMESYNC_DATA {
                    tc1: nanoseconds(now_s),
                    ts1: t.ts1,
                    target_system: packet.sender.system,
                    target_component: packet.sender.component,
                };
                self.send(&MavMessage::TIMESYNC(reply));
            }
            other => self.handle_parameter(other),
        }
    }

    fn handle_parameter(&mut self, message: &MavMessage) {
        match message {
            MavMessage::PARAM_REQUEST_LIST(_) => {
                for index in 0..usize::from(Parameters::COUNT) {
                    self.send_parameter(self.parameters.by_index(index), true);
                }
            }
            MavMessage::PARAM_REQUEST_READ(r) => {
                let by_name = || self.parameters.by_name(r.param_id.to_str().ok()?);
                let index = usize::try_from(r.param_index);
                self.send_parameter(
                    index.map_or_else(|_| by_name(), |index| self.parameters.by_index(index)),
                    true,
                );
            }
            MavMessage::PARAM_SET(p) => {
                let shown =
                    self.parameters.set(p.param_id.to_str().unwrap_or_default(), p.param_value);
                self.send_parameter(shown, false);
            }
            _ => {}
        }
    }

    /// Addressed to this autopilot, to all, or to none. PX4 takes no command that is addressed to all systems
    /// (`evaluate_target_ok` of its `mavlink_receiver.cpp`).
    fn is_addressed(&self, message: &MavMessage) -> bool {
        let sender = self.sender();
        let system = message.target_system_id().unwrap_or(0);
        let is_command =
            matches!(message, MavMessage::COMMAND_LONG(_) | MavMessage::COMMAND_INT(_));
        if system == 0 && is_command && self.is_px4() {
            return false;
        }
        let component = message.target_component_id().unwrap_or(0);
        (system == 0 || system == sender.system)
            && (component == 0 || component == sender.component)
    }

    #[allow(deprecated, reason = "ground stations still send superseded messages")]
    fn command(&mut self, now_s: f64, from: Sender, command: MavCmd, values: [f32; 7]) {
        let [first, second, ..] = values;
        let result = match command {
            MavCmd::MAV_CMD_DO_SET_MODE => {
                let custom = (first as i64) & 1 == 1;
                if self.is_px4() {
                    let [_, main, sub, ..] = values;
                    let before = self.reported_mode();
                    let result = self.set_px4_mode(now_s, main as u8, sub as u8);
                    self.acknowledge(command as u16, result, from);
                    if result == ACCEPTED && self.schedule.has(CURRENT_MODE) {
                        self.send(&current_mode(before));
                    }
                    return;
                }
                // A number that is none names no mode.
                let number = if second >= 0.0 { second as u32 } else { u32::MAX };
                if custom { self.change_mode(now_s, number) } else { FAILED }
            }
            MavCmd::MAV_CMD_COMPONENT_ARM_DISARM => {
                self.arm_or_disarm(now_s, first, second == FORCE)
            }
            MavCmd::MAV_CMD_NAV_TAKEOFF if self.is_px4() => {
                // To an altitude over the sea, in a mode of its own.
                let height_m = f64::from(values[6]) - self.config.origin.altitude_m;
                self.flight.follow_setpoints(now_s, &self.estimate);
                self.px4.on_takeoff();
                accepted(self.flight.take_off(now_s, height_m, &self.estimate))
            }
            MavCmd::MAV_CMD_NAV_TAKEOFF => {
                accepted(self.flight.take_off(now_s, f64::from(values[6]), &self.estimate))
            }
            MavCmd::MAV_CMD_NAV_LAND => self.change_mode(now_s, Mode::Land as u32),
            MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL => self.set_interval(now_s, first, second),
            MavCmd::MAV_CMD_REQUEST_MESSAGE => {
                self.acknowledge(command as u16, accepted(self.is_available(first as u32)), from);
                self.send_message(first as u32);
                return;
            }
            MavCmd::MAV_CMD_GET_HOME_POSITION => {
                self.send_message(242);
                ACCEPTED
            }
            MavCmd::MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES => {
                self.send_message(148);
                ACCEPTED
            }
            MavCmd::MAV_CMD_RUN_PREARM_CHECKS if self.is_px4() => {
                self.report_checks();
                ACCEPTED
            }
            _ => MavResult::MAV_RESULT_UNSUPPORTED,
        };
        self.acknowledge(command as u16, result, from);
        if command == MavCmd::MAV_CMD_COMPONENT_ARM_DISARM && first == 0.0 {
            self.report_events();
        }
    }

    fn change_mode(&mut self, now_s: f64, number: u32) -> MavResult {
        let Some(mode) = Mode::from_number(number) else {
            self.text(MavSeverity::MAV_SEVERITY_WARNING, &format!("No such mode {number}"));
            return FAILED;
        };
        let changes = mode != self.flight.mode();
        self.flight.set_mode(now_s, mode, &self.estimate);
        if changes {
            self.send_message(0);
        }
        ACCEPTED
    }

    fn set_px4_mode(&mut self, now_s: f64, main: u8, sub: u8) -> MavResult {
        let Some(mode) = self.px4.request(now_s, main, sub) else {
            return MavResult::MAV_RESULT_TEMPORARILY_REJECTED;
        };
        if mode == Mode::Guided {
            self.flight.follow_setpoints(now_s, &self.estimate);
        } else {
            self.flight.set_mode(now_s, mode, &self.estimate);
        }
        ACCEPTED
    }

    /// Accepts the frames and fields of each firmware; ArduPilot reports another frame once.
    fn take_landing_target(&mut self, now_s: f64, target: &LANDING_TARGET_DATA) {
        let place = [target.x, target.y, target.z].map(f64::from);
        let valid = target.position_valid.bits() == 1;
        if self.is_px4() {
            if valid && target.frame == MavFrame::MAV_FRAME_LOCAL_NED && self.px4.precision {
                self.flight.precision.take(now_s, [place[0], place[1]]);
            }
            return;
        }
        let is_enabled = self.parameters.get(Parameter::PrecisionLanding) == 1.0
            && self.parameters.get(Parameter::PrecisionType) == 1.0;
        if !is_enabled {
            return;
        }
        if target.frame != MavFrame::MAV_FRAME_BODY_FRD {
            if !std::mem::replace(&mut self.target_refused, true) {
                self.text(MavSeverity::MAV_SEVERITY_INFO, "Plnd: Frame not supported");
            }
            return;
        }
        let distance = f64::from(target.distance);
        if distance.is_nan() || distance <= 0.0 {
            return;
        }
        let [x, y, z] = if valid {
            place
        } else {
            let sight = [-target.angle_y.tan(), target.angle_x.tan(), 1.0].map(f64::from);
            sight.map(|part| part * distance / super::shaping::norm(sight))
        };
        let e = &self.estimate;
        let attitude = Rotation::<Ned, Body>::from_euler(e.roll, e.pitch, e.yaw);
        let offset = attitude * Vector::<Body>::new(x, y, z);
        let north_east = [e.position[0] + offset.x(), e.position[1] + offset.y()];
        self.flight.precision.take(now_s, north_east);
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
                self.send_message(49);
                self.send_message(242);
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

    /// Accepts velocities in the frames that ArduPilot supports; any other setpoint is a stop.
    fn take_setpoint(&mut self, now_s: f64, target: &SET_POSITION_TARGET_LOCAL_NED_DATA) {
        if self.px4.on_setpoint(now_s) {
            self.flight.follow_setpoints(now_s, &self.estimate);
        }
        if self.is_px4() && !self.px4.is_offboard() {
            return;
        }
        self.queue_setpoint(now_s, self.setpoint(target).unwrap_or(Setpoint::STOP));
    }

    /// Queues a setpoint, which takes effect after its latency.
    pub(super) fn queue_setpoint(&mut self, now_s: f64, setpoint: Setpoint) {
        if self.setpoints.len() >= MAX_SETPOINTS {
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
            (true, _) => HeadingCommand::Angle(if relative { heading + yaw } else { yaw }),
            (false, true) => HeadingCommand::Rate(yaw_rate),
            (false, false) => HeadingCommand::Follow,
        };
        Some(Setpoint { velocity: [cos * x - sin * y, sin * x + cos * y, down], nose })
    }

    fn send_parameter(&mut self, shown: Option<ParameterValue>, indexed: bool) {
        let Some(ParameterValue { index, name, kind, value }) = shown else { return };
        self.send(&MavMessage::PARAM_VALUE(PARAM_VALUE_DATA {
            param_value: value,
            param_count: Parameters::COUNT,
            param_index: if indexed { index } else { u16::MAX },
            param_id: name.into(),
            param_type: kind,
        }));
    }

    fn acknowledge(&mut self, command: u16, result: MavResult, to: Sender) {
        let sender = self.sender();
        self.push(|sequence| packet::acknowledgement(sender, sequence, command, result, to));
    }
}
