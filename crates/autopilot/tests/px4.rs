//! Tests the client against a PX4 scripted by its documentation: EVENT messages and failing checks, take-off to an altitude over
//! the sea, modes, OFFBOARD only with a stream of setpoints.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests may fail like tests")]

use std::collections::BTreeMap;

use autopilot::dialect::{
    ATTITUDE_DATA, COMMAND_ACK_DATA, COMMAND_LONG_DATA, CURRENT_MODE_DATA, ESTIMATOR_STATUS_DATA,
    EVENT_DATA, EXTENDED_SYS_STATE_DATA, EstimatorStatusFlags, GLOBAL_POSITION_INT_DATA,
    HEARTBEAT_DATA, LOCAL_POSITION_NED_DATA, MavAutopilot, MavCmd, MavLandedState, MavMessage,
    MavModeFlag, MavResult, MavSysStatusSensor, MavType, STATUSTEXT_DATA, SYS_STATUS_DATA,
};
use autopilot::packet::{self, Sender};
use autopilot::{
    Autopilot, Command, CommandError, CommandStatus, Config, Event, Firmware, FlightMode, Parser,
    Takeoff, TakeoffProgress,
};
use geometry::{Point, Vector};

const SECOND: i64 = 1_000_000_000;
const STEP: i64 = SECOND / 50;
const AUTOPILOT: Sender = Sender { system: 1, component: 1 };
const GROUND_AMSL_M: f64 = 488.0;
/// COM_OF_LOSS_T.
const OFFBOARD_LOSS_NS: i64 = SECOND;
const CURRENT_MODE: u32 = 436;

struct Px4 {
    mode: FlightMode,
    armed: bool,
    height_m: f64,
    climbs_to_m: Option<f64>,
    intervals: BTreeMap<u32, i64>,
    /// It supports CURRENT_MODE; the mode that was sent last, and when.
    has_current_mode: bool,
    reported_mode: Option<(FlightMode, i64)>,
    /// Its heartbeats are lost on the way.
    loses_heartbeats: bool,
    /// It holds as setpoints are missing, and OFFBOARD is the mode that was chosen.
    is_failsafe: bool,
    /// Since when setpoints have come at 2 Hz or more, and when the last one came.
    streaming: Option<(i64, i64)>,
    setpoints: Vec<[f32; 3]>,
    mode_requests: usize,
    refuses: bool,
    /// Its answer to a request for its checks, if any, and the number of requests.
    answers_checks: Option<MavResult>,
    checks_requests: usize,
    /// Its report then.
    checks: Vec<MavMessage>,
    boot_ns: i64,
    landing_targets: Vec<(u8, [f32; 3])>,
    queue: Vec<MavMessage>,
}

impl Px4 {
    fn receive(&mut self, now: i64, packet: &[u8]) {
        for packet in Parser::new().push(packet) {
            match packet.message.unwrap() {
                MavMessage::COMMAND_LONG(command) => {
                    let Some(result) = self.carry_out(now, &command) else { continue };
                    self.queue.push(MavMessage::COMMAND_ACK(COMMAND_ACK_DATA {
                        command: command.command,
                        result,
                        target_system: packet.sender.system,
                        target_component: packet.sender.component,
                        ..Default::default()
                    }));
                }
                MavMessage::SET_POSITION_TARGET_LOCAL_NED(setpoint) => {
                    let since = match self.streaming {
                        Some((since, last)) if now - last <= SECOND / 2 => since,
                        _ => now,
                    };
                    self.streaming = Some((since, now));
                    if std::mem::take(&mut self.is_failsafe) && self.mode == FlightMode::AUTO_HOLD {
                        self.mode = FlightMode::OFFBOARD;
                    }
                    self.setpoints.push([setpoint.vx, setpoint.vy, setpoint.vz]);
                }
                MavMessage::LANDING_TARGET(target) => {
                    self.landing_targets.push((target.frame as u8, [target.x, target.y, target.z]));
                }
                MavMessage::HEARTBEAT(_) | MavMessage::TIMESYNC(_) => {}
                other => panic!("unexpected {other:?}"),
            }
        }
    }

    /// The acknowledgement; `None` for a command whose acknowledgement is lost.
    fn carry_out(&mut self, now: i64, command: &COMMAND_LONG_DATA) -> Option<MavResult> {
        if command.command == MavCmd::MAV_CMD_RUN_PREARM_CHECKS {
            self.checks_requests += 1;
            if self.answers_checks == Some(MavResult::MAV_RESULT_ACCEPTED) {
                self.queue.append(&mut self.checks);
            }
            return self.answers_checks;
        }
        Some(self.result(now, command))
    }

    fn result(&mut self, now: i64, command: &COMMAND_LONG_DATA) -> MavResult {
        if self.refuses {
            return MavResult::MAV_RESULT_DENIED;
        }
        match command.command {
            MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL => {
                if command.param1 as u32 == CURRENT_MODE && !self.has_current_mode {
                    return MavResult::MAV_RESULT_DENIED;
                }
                let interval = (f64::from(command.param2) * 1e3) as i64;
                self.intervals.insert(command.param1 as u32, interval);
            }
            MavCmd::MAV_CMD_DO_SET_MODE => {
                assert_eq!(command.param1, 1.0);
                self.mode_requests += 1;
                let number = [0, 0, command.param2 as u8, command.param3 as u8];
                let mode = FlightMode::Px4(u32::from_le_bytes(number));
                let proven = self
                    .streaming
                    .is_some_and(|(since, last)| now - since >= SECOND && now - last <= SECOND / 2);
                if mode == FlightMode::OFFBOARD && !proven {
                    return MavResult::MAV_RESULT_TEMPORARILY_REJECTED;
                }
                if self.intervals.contains_key(&CURRENT_MODE) {
                    self.queue.push(current_mode(self.mode));
                }
                (self.mode, self.is_failsafe) = (mode, false);
            }
            MavCmd::MAV_CMD_COMPONENT_ARM_DISARM => self.armed = command.param1 == 1.0,
            MavCmd::MAV_CMD_NAV_TAKEOFF => {
                if !self.armed {
                    return MavResult::MAV_RESULT_TEMPORARILY_REJECTED;
                }
                let here = [command.param4, command.param5, command.param6];
                assert!(here.iter().all(|value| value.is_nan()), "at the present position");
                self.climbs_to_m = Some(f64::from(command.param7) - GROUND_AMSL_M);
                self.mode = FlightMode::AUTO_TAKEOFF;
            }
            other => panic!("unexpected {other:?}"),
        }
        MavResult::MAV_RESULT_ACCEPTED
    }

    fn step(&mut self, now: i64) -> Vec<MavMessage> {
        if let Some(height_m) = self.climbs_to_m {
            self.height_m += 0.04;
            if self.height_m >= height_m {
                self.climbs_to_m = None;
                self.mode = FlightMode::AUTO_HOLD;
            }
        }
        let silent = self.streaming.is_none_or(|(_, last)| now - last > OFFBOARD_LOSS_NS);
        if self.mode == FlightMode::OFFBOARD && silent && self.armed {
            (self.mode, self.is_failsafe) = (FlightMode::AUTO_HOLD, true);
        }
        let mut sent = std::mem::take(&mut self.queue);
        if now % SECOND == 0 && !self.loses_heartbeats {
            sent.push(self.heartbeat());
        }
        for (&id, &interval) in &self.intervals {
            let is_due = now % interval < STEP;
            if is_due && id == CURRENT_MODE {
                // With each change, and twice a second.
                let last = self.reported_mode.filter(|(mode, _)| *mode == self.mode);
                if last.is_none_or(|(_, at)| now - at >= SECOND / 2) {
                    self.reported_mode = Some((self.mode, now));
                    sent.push(current_mode(self.mode));
                }
            } else if is_due {
                sent.extend(self.report(id, now));
            }
        }
        sent
    }

    fn heartbeat(&self) -> MavMessage {
        let armed = MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED;
        MavMessage::HEARTBEAT(HEARTBEAT_DATA {
            custom_mode: self.mode.custom_mode(),
            mavtype: MavType::MAV_TYPE_QUADROTOR,
            autopilot: MavAutopilot::MAV_AUTOPILOT_PX4,
            base_mode: if self.armed { armed } else { MavModeFlag::empty() },
            ..Default::default()
        })
    }

    fn report(&self, id: u32, now: i64) -> Option<MavMessage> {
        let time_boot_ms = ((now - self.boot_ns) / 1_000_000) as u32;
        Some(match id {
            30 => MavMessage::ATTITUDE(ATTITUDE_DATA { time_boot_ms, ..Default::default() }),
            32 => MavMessage::LOCAL_POSITION_NED(LOCAL_POSITION_NED_DATA {
                time_boot_ms,
                z: -self.height_m as f32,
                vz: if self.climbs_to_m.is_some() { -2.0 } else { 0.0 },
                ..Default::default()
            }),
            33 => MavMessage::GLOBAL_POSITION_INT(GLOBAL_POSITION_INT_DATA {
                alt: ((GROUND_AMSL_M + self.height_m) * 1e3) as i32,
                ..Default::default()
            }),
            230 => MavMessage::ESTIMATOR_STATUS(ESTIMATOR_STATUS_DATA {
                // Attitude, velocities, relative and absolute positions: a PX4 with GNSS.
                flags: EstimatorStatusFlags::from_bits_retain(831),
                ..Default::default()
            }),
            245 => MavMessage::EXTENDED_SYS_STATE(EXTENDED_SYS_STATE_DATA {
                landed_state: match (self.height_m > 0.1, self.mode) {
                    (false, _) => MavLandedState::MAV_LANDED_STATE_ON_GROUND,
                    (_, FlightMode::AUTO_TAKEOFF) => MavLandedState::MAV_LANDED_STATE_TAKEOFF,
                    _ => MavLandedState::MAV_LANDED_STATE_IN_AIR,
                },
                ..Default::default()
            }),
            _ => return None,
        })
    }
}

fn current_mode(mode: FlightMode) -> MavMessage {
    let custom_mode = mode.custom_mode();
    MavMessage::CURRENT_MODE(CURRENT_MODE_DATA { custom_mode, ..Default::default() })
}

struct World {
    now: i64,
    client: Autopilot,
    px4: Px4,
}

impl World {
    fn new() -> Self {
        Self::with(|_| {})
    }

    /// With a changed PX4.
    fn with(differs: impl FnOnce(&mut Px4)) -> Self {
        let mut px4 = Px4 {
            mode: FlightMode::AUTO_HOLD,
            armed: false,
            height_m: 0.0,
            climbs_to_m: None,
            intervals: BTreeMap::new(),
            has_current_mode: false,
            reported_mode: None,
            is_failsafe: false,
            loses_heartbeats: false,
            streaming: None,
            setpoints: Vec::new(),
            mode_requests: 0,
            refuses: false,
            answers_checks: Some(MavResult::MAV_RESULT_ACCEPTED),
            checks_requests: 0,
            checks: Vec::new(),
            boot_ns: 0,
            landing_targets: Vec::new(),
            queue: Vec::new(),
        };
        differs(&mut px4);
        let mut world = Self { now: 100 * SECOND, client: Autopilot::new(Config::default()), px4 };
        world.run(5);
        world
    }

    fn step(&mut self) {
        self.now += STEP;
        for message in self.px4.step(self.now) {
            let packet = packet::encode(AUTOPILOT, 0, &message);
            for packet in Parser::new().push(&packet) {
                self.client.handle(self.now, &packet);
            }
        }
        self.client.tick(self.now);
        while let Some(packet) = self.client.poll_outgoing() {
            self.px4.receive(self.now, &packet);
        }
    }

    fn run(&mut self, seconds: i64) {
        for _ in 0..seconds * SECOND / STEP {
            self.step();
        }
    }

    fn request(&mut self, command: Command) -> Result<(), CommandError> {
        let id = self.client.request(self.now, command);
        for _ in 0..1000 {
            match self.client.status(id) {
                CommandStatus::Pending => self.step(),
                CommandStatus::Done => return Ok(()),
                CommandStatus::Failed(error) => return Err(error),
                CommandStatus::Unknown => panic!("forgotten"),
            }
        }
        panic!("a command without an end");
    }

    fn flying(height_m: f64) -> Self {
        let mut world = Self::new();
        (world.px4.armed, world.px4.height_m) = (true, height_m);
        world.run(2);
        world
    }
}

#[test]
fn it_becomes_ready_by_px4s_own_messages() {
    let world = World::new();
    assert_eq!(world.client.firmware(), Some(Firmware::Px4));
    assert!(world.client.state().unwrap().ready, "{:?}", world.client.not_ready_because());
    assert!(!world.px4.intervals.contains_key(&193), "EKF_STATUS_REPORT is ArduPilot's");
}

/// An event with arguments as PX4 packs them.
fn event(sequence: u16, id: u32, log_levels: u8, of: &[u8]) -> MavMessage {
    let mut event = EVENT_DATA { id, log_levels, sequence, ..Default::default() };
    event.arguments.iter_mut().zip(of).for_each(|(to, of)| *to = *of);
    MavMessage::EVENT(event)
}

/// PX4's report that it can be armed in no mode of a landing: it has no position, and without sticks it can be armed.
fn report(sequence: u16) -> [MavMessage; 4] {
    let mut summary = [0; 17];
    summary[9] = 1;
    [
        event(sequence, 0x01a8_93e0, 0x88, &summary),
        event(sequence + 1, 0x0106_ed29, 0x44, &[0xff, 0xff, 0xff, 0xff, 7]),
        event(sequence + 2, 0x01d3_1bb9, 0x33, &[0x38, 0x40, 0x16, 0, 0x14]),
        event(sequence + 3, 0x011d_3727, 0x88, &[]),
    ]
}

fn texts(client: &mut Autopilot) -> Vec<String> {
    let events: Vec<Event> = std::iter::from_fn(|| client.poll_event()).collect();
    texts_of(&events)
}

fn texts_of(events: &[Event]) -> Vec<String> {
    let text = |event: &Event| match event {
        Event::Text { text, .. } => Some(text.clone()),
        _ => None,
    };
    events.iter().filter_map(text).collect()
}

const NO_POSITION: &str = "Navigation error: No valid position estimate";

#[test]
fn the_reason_why_it_does_not_arm_comes_from_its_events() {
    let mut world = World::new();
    world.px4.queue.push(status_of_failing_checks());
    world.px4.queue.extend(report(1));
    world.px4.queue.push(event(5, 0x0102_089d, 0x62, &[]));
    world.step();
    let why = world.client.not_ready_because();
    assert_eq!(why, [format!("prearm: {NO_POSITION}")]);
    let denied = "Arming denied: Resolve system health failures first";
    assert_eq!(texts(&mut world.client), ["No manual control input", NO_POSITION, denied]);
    // It is cured.
    world.px4.queue.push(event(6, 0x01a8_93e0, 0x88, &[0xff; 17]));
    world.step();
    assert_eq!(world.client.not_ready_because(), why);
    world.px4.queue.push(event(7, 0x011d_3727, 0x88, &[]));
    world.step();
    assert_eq!(world.client.not_ready_because(), ["prearm: checks not passed yet"]);
}

/// Its status, with checks before arming that fail.
fn status_of_failing_checks() -> MavMessage {
    MavMessage::SYS_STATUS(SYS_STATUS_DATA {
        onboard_control_sensors_present: MavSysStatusSensor::MAV_SYS_STATUS_PREARM_CHECK,
        ..Default::default()
    })
}

#[test]
fn a_client_that_connects_after_its_events_gets_the_reason_why_it_does_not_arm() {
    let mut world = World::with(|px4| px4.checks = report(40).to_vec());
    world.px4.queue.push(status_of_failing_checks());
    world.step();
    let why = [format!("prearm: {NO_POSITION}")];
    assert_eq!(world.client.not_ready_because(), why);
    assert_eq!(world.px4.checks_requests, 1);
    // No packet of it is received for a while, and its checks stay the same.
    for _ in 0..10 * SECOND / STEP {
        world.now += STEP;
        world.client.tick(world.now);
    }
    assert!(!world.client.is_connected());
    world.px4.checks = report(44).to_vec();
    world.run(10);
    world.px4.queue.push(status_of_failing_checks());
    world.step();
    assert_eq!(world.client.not_ready_because(), why);
    assert_eq!(world.px4.checks_requests, 2);
}

#[test]
fn where_a_part_of_its_report_is_lost_it_is_asked_once_more() {
    for lost in 0..4 {
        let mut world = World::with(|px4| px4.armed = true);
        world.px4.armed = false;
        world.px4.checks = report(1).to_vec();
        world.px4.checks.remove(lost);
        world.run(2);
        assert_eq!(world.px4.checks_requests, 1, "{lost}");
        world.px4.checks = report(5).to_vec();
        world.run(10);
        assert_eq!(world.px4.checks_requests, 2, "{lost}");
        world.px4.queue.push(status_of_failing_checks());
        world.step();
        assert_eq!(world.client.not_ready_because(), [format!("prearm: {NO_POSITION}")], "{lost}");
    }
}

#[test]
fn after_it_started_again_its_events_count_from_the_first_and_old_checks_are_forgotten() {
    let mut world = World::with(|px4| px4.checks = report(10).to_vec());
    world.px4.queue.push(status_of_failing_checks());
    world.step();
    assert_eq!(world.client.not_ready_because(), [format!("prearm: {NO_POSITION}")]);
    assert_eq!(texts(&mut world.client), ["No manual control input", NO_POSITION]);
    world.px4.boot_ns = world.now;
    // Asked, it reports only one of them, with a number that is not far behind the earlier ones.
    let [begin, sticks, _, end] = report(1);
    world.px4.checks = vec![begin, sticks, end];
    world.run(2);
    world.px4.queue.push(status_of_failing_checks());
    world.step();
    let events: Vec<Event> = std::iter::from_fn(|| world.client.poll_event()).collect();
    let restarts = events.iter().filter(|event| matches!(event, Event::Restarted { .. }));
    assert_eq!(restarts.count(), 1);
    assert_eq!(texts_of(&events), ["No manual control input"]);
    let also = "prearm: checks not passed yet; PX4 also reports: No manual control input";
    assert_eq!(world.client.not_ready_because(), [also]);
}

#[test]
fn a_request_for_its_checks_without_an_answer_or_with_a_refusal_has_no_effect() {
    let refusals = [MavResult::MAV_RESULT_DENIED, MavResult::MAV_RESULT_UNSUPPORTED];
    for (answer, asked) in [(None, 3), (Some(refusals[0]), 1), (Some(refusals[1]), 1)] {
        let mut world = World::with(|px4| px4.answers_checks = answer);
        world.run(30);
        assert_eq!(world.px4.checks_requests, asked, "{answer:?}");
        assert!(world.client.state().unwrap().ready, "{:?}", world.client.not_ready_because());
        assert_eq!(texts(&mut world.client), [""; 0]);
        world.request(Command::Arm).unwrap();
    }
    // Accepted, and its report was lost on the way, or comes later.
    let later = [MavResult::MAV_RESULT_TEMPORARILY_REJECTED, MavResult::MAV_RESULT_IN_PROGRESS];
    for answer in [MavResult::MAV_RESULT_ACCEPTED].into_iter().chain(later) {
        let mut world = World::with(|px4| px4.answers_checks = Some(answer));
        world.run(30);
        assert_eq!(world.px4.checks_requests, 3, "{answer:?}");
    }
}

#[test]
fn an_armed_one_is_asked_for_its_checks_once_it_is_disarmed() {
    let mut world = World::with(|px4| (px4.armed, px4.height_m) = (true, 5.0));
    world.run(10);
    assert_eq!(world.px4.checks_requests, 0);
    (world.px4.armed, world.px4.height_m) = (false, 0.0);
    world.px4.checks = report(1).to_vec();
    world.run(10);
    assert_eq!(world.px4.checks_requests, 1);
}

#[test]
fn a_repeated_event_is_reported_once() {
    let mut world = World::new();
    world.px4.queue.extend(report(1));
    world.px4.queue.extend(report(5));
    // Sent again for a ground station.
    world.px4.queue.push(event(9, 0x0102_089d, 0x62, &[]));
    world.px4.queue.push(event(9, 0x0102_089d, 0x62, &[]));
    world.px4.queue.extend(report(1));
    let words = "Navigation error: No valid position estimate\t";
    for text in [words, "Its words differ\t", "Only a text"] {
        let text = STATUSTEXT_DATA { text: text.into(), ..Default::default() };
        world.px4.queue.push(MavMessage::STATUSTEXT(text));
    }
    world.step();
    let denied = "Arming denied: Resolve system health failures first";
    let reported =
        ["No manual control input", NO_POSITION, denied, "Its words differ", "Only a text"];
    assert_eq!(texts(&mut world.client), reported);
}

#[test]
fn checks_explain_why_it_does_not_arm_and_no_other_request() {
    for (command, explained) in
        [(Command::Arm, true), (Command::SetMode(FlightMode::AUTO_LAND), false)]
    {
        let mut world = World::new();
        world.px4.queue.extend(report(1));
        world.step();
        world.px4.refuses = true;
        let id = world.client.request(world.now, command);
        world.step();
        // The request was sent, and its refusal comes with the next step.
        world.px4.queue.extend(report(5));
        while world.client.status(id) == CommandStatus::Pending {
            world.step();
        }
        let CommandStatus::Failed(CommandError::Refused { texts, .. }) = world.client.status(id)
        else {
            panic!("{:?}", world.client.status(id));
        };
        let expected: &[&str] = if explained { &[NO_POSITION] } else { &[] };
        assert_eq!(texts, expected, "{command}");
    }
}

#[test]
fn a_refusal_to_arm_has_the_checks_that_were_reported_before() {
    let mut world = World::with(|px4| px4.checks = report(1).to_vec());
    world.px4.refuses = true;
    let denied = "Arming denied: Resolve system health failures first";
    let id = world.client.request(world.now, Command::Arm);
    world.step();
    world.px4.queue.push(event(5, 0x0102_089d, 0x62, &[]));
    while world.client.status(id) == CommandStatus::Pending {
        world.step();
    }
    let CommandStatus::Failed(error) = world.client.status(id) else { panic!("it is armed") };
    assert!(error.to_string().contains(&format!("{denied}; {NO_POSITION}")), "{error}");
    // One whose checks are passed has no such reason.
    let [begin, .., end] = report(6);
    world.px4.queue.extend([begin, end]);
    world.step();
    let error = world.request(Command::Arm).unwrap_err();
    assert!(!error.to_string().contains(NO_POSITION), "{error}");
}

#[test]
fn a_takeoff_arms_rises_to_an_altitude_and_ends_in_offboard() {
    let mut world = World::new();
    let mut takeoff = Takeoff::new(10.0);
    for _ in 0..60 * 50 {
        world.step();
        takeoff.step(world.now, &mut world.client);
        if takeoff.is_finished() {
            break;
        }
    }
    assert_eq!(takeoff.step(world.now, &mut world.client), TakeoffProgress::Done);
    assert_eq!(world.px4.mode, FlightMode::OFFBOARD);
    assert!((world.px4.height_m - 10.0).abs() < 0.2, "{} m", world.px4.height_m);
    assert!(world.px4.setpoints.iter().all(|v| *v == [0.0; 3]), "the first setpoints are zero");
}

#[test]
fn offboard_is_entered_with_a_stream_and_lost_without_one() {
    let mut world = World::flying(5.0);
    world.request(Command::SetMode(FlightMode::OFFBOARD)).unwrap();
    for _ in 0..200 {
        world.client.set_velocity(world.now, Vector::new(0.3, 0.0, 0.0), 0.0).unwrap();
        world.step();
    }
    assert_eq!(world.px4.mode, FlightMode::OFFBOARD);
    world.run(3);
    assert_eq!(world.px4.mode, FlightMode::AUTO_HOLD, "its failsafe");
    assert!(world.client.may_return_to_offboard(world.now));
    for _ in 0..200 {
        world.client.set_velocity(world.now, Vector::zero(), 0.0).unwrap();
        world.step();
    }
    assert_eq!(world.px4.mode, FlightMode::OFFBOARD, "the mode that was chosen");
    // A HOLD that is chosen gets no setpoint.
    world.px4.mode = FlightMode::AUTO_HOLD;
    while world.client.state().unwrap().mode == FlightMode::OFFBOARD {
        world.client.set_velocity(world.now, Vector::zero(), 0.0).unwrap();
        world.step();
    }
    let refused = world.client.set_velocity(world.now, Vector::zero(), 0.0);
    assert!(refused.unwrap_err().to_string().contains("PX4 HOLD"));
}

/// Steps until the client shows a mode, in ms.
fn shown_after_ms(world: &mut World, mode: FlightMode) -> i64 {
    let began = world.now;
    while world.client.state().unwrap().mode != mode {
        assert!(world.now - began < 2 * SECOND);
        world.step();
    }
    (world.now - began) / 1_000_000
}

#[test]
fn a_change_of_mode_shows_at_once_where_it_sends_its_mode() {
    const POSITION: FlightMode = FlightMode::Px4(3 << 16);
    for has_current_mode in [true, false] {
        let mut world = World::with(|px4| {
            (px4.has_current_mode, px4.armed, px4.height_m) = (has_current_mode, true, 5.0);
        });
        world.run(5);
        assert_eq!(world.px4.intervals.contains_key(&CURRENT_MODE), has_current_mode);
        while world.now % SECOND != STEP {
            world.step();
        }
        let events = std::iter::from_fn(|| world.client.poll_event());
        assert!(!events.into_iter().any(|event| matches!(event, Event::StreamMissing { .. })));
        world.px4.mode = POSITION;
        let after_ms = shown_after_ms(&mut world, POSITION);
        assert_eq!(after_ms <= 60, has_current_mode, "{after_ms} ms");
        let events: Vec<Event> = std::iter::from_fn(|| world.client.poll_event()).collect();
        let changes = events.iter().filter(|event| {
            matches!(event, Event::ModeChanged { from: Some(FlightMode::AUTO_HOLD), to: POSITION })
        });
        assert_eq!(changes.count(), 1);
        let is_reported = events.iter().any(
            |event| matches!(event, Event::Status(state) if state.mode == POSITION && state.armed),
        );
        assert!(is_reported, "{events:?}");
    }
}

#[test]
fn called_back_from_land_it_is_in_offboard_sooner_where_it_sends_its_mode() {
    let back_after_ms = |has_current_mode: bool| {
        let mut world = World::with(|px4| {
            (px4.has_current_mode, px4.armed, px4.height_m) = (has_current_mode, true, 5.0);
        });
        world.request(Command::SetMode(FlightMode::AUTO_LAND)).unwrap();
        let landing = world.now;
        while world.now - landing < 2 * SECOND || world.now % SECOND != 15 * STEP {
            world.client.send_zeros(world.now);
            world.step();
        }
        assert_eq!(world.px4.mode, FlightMode::AUTO_LAND);
        world.client.request(world.now, Command::SetMode(FlightMode::OFFBOARD));
        let began = world.now;
        while world.px4.mode != FlightMode::OFFBOARD {
            assert!(world.now - began < 5 * SECOND);
            world.step();
        }
        (world.now - began) / 1_000_000
    };
    let (with, without) = (back_after_ms(true), back_after_ms(false));
    assert!(with <= 600 && (760..830).contains(&without), "{with} and {without} ms");
}

#[test]
fn a_mode_that_is_shown_once_more_while_the_pilot_changes_it_lets_no_request_through() {
    let mut world = World::with(|px4| {
        (px4.has_current_mode, px4.armed, px4.height_m) = (true, true, 5.0);
    });
    for _ in 0..3 * SECOND / STEP {
        world.client.send_zeros(world.now);
        world.step();
    }
    // Between two of its messages, the pilot requests POSITION as we request OFFBOARD: the former mode comes first.
    while !(300..320).contains(&(world.now / 1_000_000 % 500)) {
        world.client.send_zeros(world.now);
        world.step();
    }
    let id = world.client.request(world.now, Command::SetMode(FlightMode::OFFBOARD));
    world.px4.queue.push(current_mode(FlightMode::AUTO_HOLD));
    world.step();
    world.step();
    assert_eq!(world.px4.mode_requests, 0);
    world.px4.mode = FlightMode::Px4(3 << 16);
    world.run(3);
    assert_eq!(world.px4.mode, FlightMode::Px4(3 << 16));
    assert!(matches!(world.client.status(id), CommandStatus::Failed(_)));
    assert_eq!(world.px4.mode_requests, 0);
}

#[test]
fn on_the_ground_the_mode_changes_with_the_motors() {
    // It reports the ground before its motors stop, or it does not.
    for height_m in [0.0, 0.3] {
        let mut world = World::with(|px4| {
            (px4.has_current_mode, px4.armed, px4.height_m) = (true, true, height_m);
            px4.mode = FlightMode::AUTO_LAND;
        });
        world.run(3);
        while world.now % SECOND != 10 * STEP {
            world.step();
        }
        // The landing is over.
        (world.px4.armed, world.px4.mode) = (false, FlightMode::OFFBOARD);
        let mut state = *world.client.state().unwrap();
        while state.armed {
            assert_eq!(state.mode, FlightMode::AUTO_LAND);
            world.step();
            state = *world.client.state().unwrap();
        }
        assert_eq!(state.mode, FlightMode::OFFBOARD);
    }
}

#[test]
fn a_mode_is_believed_of_a_connected_px4_only() {
    let land = current_mode(FlightMode::AUTO_LAND);
    let mut world = World::flying(5.0);
    let other = packet::encode(Sender { system: 2, component: 1 }, 0, &land);
    Parser::new().push(&other).iter().for_each(|packet| world.client.handle(world.now, packet));
    assert_eq!(world.client.state().unwrap().mode, FlightMode::AUTO_HOLD);
    world.px4.loses_heartbeats = true;
    world.run(4);
    assert!(!world.client.is_connected());
    world.px4.queue.push(land);
    world.step();
    assert_eq!(world.client.state().unwrap().mode, FlightMode::AUTO_HOLD);
    // ArduPilot sends a heartbeat with each change.
    let mut client = Autopilot::new(Config::default());
    let heartbeat = MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        custom_mode: FlightMode::Guided.custom_mode(),
        mavtype: MavType::MAV_TYPE_QUADROTOR,
        autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
        base_mode: MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED,
        ..Default::default()
    });
    let in_air = MavMessage::EXTENDED_SYS_STATE(EXTENDED_SYS_STATE_DATA {
        landed_state: MavLandedState::MAV_LANDED_STATE_IN_AIR,
        ..Default::default()
    });
    for message in [heartbeat, in_air, current_mode(FlightMode::Land)] {
        let packet = packet::encode(AUTOPILOT, 0, &message);
        Parser::new().push(&packet).iter().for_each(|packet| client.handle(world.now, packet));
    }
    assert_eq!(client.state().unwrap().mode, FlightMode::Guided);
}

#[test]
fn zeros_continue_while_only_the_heartbeat_is_missing() {
    let mut world = World::flying(5.0);
    world.request(Command::SetMode(FlightMode::OFFBOARD)).unwrap();
    world.px4.loses_heartbeats = true;
    for _ in 0..6 * SECOND / STEP {
        world.client.send_zeros(world.now);
        world.step();
    }
    assert!(!world.client.is_connected());
    assert_eq!(world.px4.mode, FlightMode::OFFBOARD);
}

#[test]
fn it_lands_in_px4s_own_mode_with_targets_in_px4s_frame() {
    let mut world = World::flying(5.0);
    world.request(Command::SetMode(Firmware::Px4.land().unwrap())).unwrap();
    assert_eq!(world.px4.mode, FlightMode::AUTO_LAND);
    let (in_body, in_local) = (Point::new(0.1, 0.2, 4.8), Point::new(3.0, 4.0, -0.2));
    assert!(world.client.send_landing_target(world.now, in_body, in_local));
    world.step();
    assert_eq!(world.px4.landing_targets, [(1, [3.0, 4.0, -0.2])]);
    world.request(Command::SetMode(Firmware::Px4.precision_land().unwrap())).unwrap();
    assert_eq!(world.px4.mode.to_string(), "PX4 PRECISION LAND");
}

#[test]
fn the_pilots_mode_change_ends_the_takeoff() {
    let mut world = World::new();
    let mut takeoff = Takeoff::new(10.0);
    let mut rises = false;
    for _ in 0..60 * 50 {
        world.step();
        takeoff.step(world.now, &mut world.client);
        rises |= world.px4.height_m > 3.0;
        if rises {
            // POSITION, by the sticks.
            world.px4.mode = FlightMode::Px4(3 << 16);
        }
        if takeoff.is_finished() {
            break;
        }
    }
    let TakeoffProgress::Failed(error) = takeoff.step(world.now, &mut world.client) else {
        panic!("it continued");
    };
    assert!(error.to_string().contains("PX4 POSITION"), "{error}");
}

#[test]
fn hold_below_the_height_of_the_takeoff_is_the_pilots() {
    let mut world = World::new();
    let mut takeoff = Takeoff::new(10.0);
    for _ in 0..20 * SECOND / STEP {
        world.step();
        takeoff.step(world.now, &mut world.client);
        if world.px4.mode == FlightMode::AUTO_TAKEOFF && world.px4.height_m > 5.0 {
            (world.px4.mode, world.px4.climbs_to_m) = (FlightMode::AUTO_HOLD, None);
        }
    }
    let TakeoffProgress::Failed(error) = takeoff.step(world.now, &mut world.client) else {
        panic!("it continues");
    };
    assert!(error.to_string().contains("PX4 HOLD"), "{error}");
    assert_eq!((world.px4.mode_requests, world.px4.mode), (0, FlightMode::AUTO_HOLD));
}

#[test]
fn a_climb_that_ends_while_packets_are_missing_is_ended_by_no_pilot() {
    let mut world = World::new();
    let mut takeoff = Takeoff::new(10.0);
    while world.px4.height_m < 3.0 {
        world.step();
        takeoff.step(world.now, &mut world.client);
    }
    while world.px4.mode == FlightMode::AUTO_TAKEOFF {
        world.now += STEP;
        world.px4.step(world.now);
    }
    // The mode is the first packet since then.
    let heartbeat = packet::encode(AUTOPILOT, 0, &world.px4.heartbeat());
    for packet in Parser::new().push(&heartbeat) {
        world.client.handle(world.now, &packet);
    }
    world.client.tick(world.now);
    assert_eq!(world.client.state().unwrap().mode, FlightMode::AUTO_HOLD);
    takeoff.step(world.now, &mut world.client);
    for _ in 0..10 * SECOND / STEP {
        world.step();
        takeoff.step(world.now, &mut world.client);
        if takeoff.is_finished() {
            break;
        }
    }
    let progress = takeoff.step(world.now, &mut world.client);
    assert_eq!(progress, TakeoffProgress::Done);
    assert_eq!(world.px4.mode, FlightMode::OFFBOARD);
}

#[test]
fn a_pilot_who_arms_or_changes_the_mode_while_arming_is_refused_ends_the_takeoff() {
    let (position, manual) = (FlightMode::Px4(3 << 16), FlightMode::Px4(1 << 16));
    // The mode in which it stands, whether the pilot arms it there, and else the mode that the pilot chooses.
    let hold = FlightMode::AUTO_HOLD;
    let cases = [(position, None), (hold, None), (position, Some(manual)), (position, Some(hold))];
    for (mode, chosen) in cases {
        let mut world = World::with(|px4| px4.mode = mode);
        world.px4.refuses = true;
        let mut takeoff = Takeoff::new(10.0);
        let mut step = |world: &mut World| {
            world.step();
            takeoff.step(world.now, &mut world.client)
        };
        let is_refused =
            |progress| matches!(progress, TakeoffProgress::Arming { refused: Some(_) });
        while !is_refused(step(&mut world)) {
            assert!(world.now < 120 * SECOND, "it is not refused");
        }
        world.px4.refuses = false;
        match chosen {
            None => world.px4.armed = true,
            Some(mode) => world.px4.mode = mode,
        }
        let steps = (0..10 * SECOND / STEP).map(|_| step(&mut world)).last();
        let Some(TakeoffProgress::Failed(error)) = steps else { panic!("{mode}: {steps:?}") };
        let name = chosen.unwrap_or(mode).to_string();
        assert!(error.to_string().contains(&name), "{error}");
        assert_eq!(world.px4.climbs_to_m, None);
    }
}

#[test]
fn a_mode_requested_again_before_the_heartbeat_is_sent_once() {
    let mut world = World::flying(5.0);
    let land = Command::SetMode(FlightMode::AUTO_LAND);
    while world.now % SECOND != STEP {
        world.step();
    }
    let before = world.px4.mode_requests;
    let first = world.client.request(world.now, land);
    for _ in 0..20 {
        world.step();
    }
    let second = world.client.request(world.now, land);
    assert_eq!(first, second);
    world.run(2);
    assert_eq!(world.client.status(first), CommandStatus::Done);
    assert_eq!(world.px4.mode_requests - before, 1);
    let failed = |event: Event| matches!(event, Event::Command { result: Err(_), .. });
    assert!(!std::iter::from_fn(|| world.client.poll_event()).any(failed));
}
