//! Tests the client against a scripted ArduPilot: streams and rates, lost and refused commands, restarts, silence,
//! other senders on the link, setpoints and take-offs.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "helpers of tests may fail like tests"
)]

use std::collections::{BTreeMap, VecDeque};

use autopilot::command::SetpointError;
use autopilot::dialect::{
    ATTITUDE_DATA, COMMAND_ACK_DATA, COMMAND_LONG_DATA, EKF_STATUS_REPORT_DATA,
    EXTENDED_SYS_STATE_DATA, EkfStatusFlags, HEARTBEAT_DATA, LOCAL_POSITION_NED_DATA, MavAutopilot,
    MavCmd, MavLandedState, MavMessage, MavModeFlag, MavResult, MavSeverity, MavSysStatusSensor,
    MavType, STATUSTEXT_DATA, SYS_STATUS_DATA, TIMESYNC_DATA,
};
use autopilot::packet::{self, Sender};
use autopilot::{
    Autopilot, Command, CommandError, CommandId, CommandStatus, Config, Conflict, Event, Firmware,
    FlightMode, LandedState, Parser, Takeoff, TakeoffError, TakeoffProgress,
};
use geometry::Vector;

const SECOND: i64 = 1_000_000_000;
const STEP: i64 = SECOND / 50;
const AUTOPILOT: Sender = Sender { system: 1, component: 1 };

/// A fake autopilot with ArduPilot's measured behaviour, and the settings of a test.
#[derive(Clone)]
struct Fake {
    firmware: MavAutopilot,
    boot_ns: i64,
    mode: u32,
    armed: bool,
    landed: MavLandedState,
    height: f64,
    climbs_to: Option<f64>,
    ready: bool,
    intervals: BTreeMap<u32, i64>,
    /// Commands as they were received.
    received: Vec<MavCmd>,
    velocities: Vec<[f32; 3]>,
    /// Numbers of commands and of acknowledgements that are lost.
    lose_commands: u32,
    lose_acks: u32,
    /// A command that is refused a number of times, with a text about it.
    refuse: Option<(MavCmd, MavResult, &'static str, u32)>,
    silent: bool,
    /// Only the heartbeat is missing.
    has_no_heartbeat: bool,
    ignores_modes: bool,
    queue: Vec<MavMessage>,
    /// Requests for the time, to be answered at the next step.
    time_requests: Vec<i64>,
    /// Its measurements are sent so many steps later.
    late_steps: i64,
    /// The speed to the north that it reports, in m/s; its position stays the same.
    reported_m_s: f32,
    parser: Parser,
}

impl Fake {
    fn new() -> Self {
        Self {
            firmware: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
            boot_ns: 0,
            mode: 0,
            armed: false,
            landed: MavLandedState::MAV_LANDED_STATE_ON_GROUND,
            height: 0.0,
            climbs_to: None,
            ready: true,
            intervals: BTreeMap::new(),
            received: Vec::new(),
            velocities: Vec::new(),
            lose_commands: 0,
            lose_acks: 0,
            refuse: None,
            silent: false,
            has_no_heartbeat: false,
            ignores_modes: false,
            queue: Vec::new(),
            time_requests: Vec::new(),
            late_steps: 0,
            reported_m_s: 0.0,
            parser: Parser::new(),
        }
    }

    fn receive(&mut self, packet: &[u8]) {
        for packet in self.parser.push(packet) {
            match packet.message.unwrap() {
                MavMessage::COMMAND_LONG(_) if self.lose_commands > 0 => self.lose_commands -= 1,
                MavMessage::COMMAND_LONG(command) => {
                    assert_eq!((command.target_system, command.target_component), (1, 1));
                    self.received.push(command.command);
                    self.obey(&command, packet.sender);
                }
                MavMessage::SET_POSITION_TARGET_LOCAL_NED(setpoint) => {
                    assert_eq!(
                        (setpoint.type_mask.bits(), setpoint.coordinate_frame as u8),
                        (1479, 1)
                    );
                    self.velocities.push([setpoint.vx, setpoint.vy, setpoint.vz]);
                }
                MavMessage::HEARTBEAT(heartbeat) => {
                    assert_eq!(heartbeat.mavtype, MavType::MAV_TYPE_ONBOARD_CONTROLLER);
                    assert_eq!(packet.sender, Sender { system: 1, component: 191 });
                }
                MavMessage::TIMESYNC(question) if question.tc1 == 0 => {
                    self.time_requests.push(question.ts1);
                }
                other => panic!("unexpected {other:?}"),
            }
        }
    }

    fn obey(&mut self, command: &COMMAND_LONG_DATA, from: Sender) {
        let mut texts = None;
        let result = match &mut self.refuse {
            Some((refused, result, text, times)) if *refused == command.command && *times > 0 => {
                *times -= 1;
                texts = Some(*text);
                *result
            }
            _ => self.carry_out(command),
        };
        if self.lose_acks > 0 {
            self.lose_acks -= 1;
        } else {
            self.queue.push(MavMessage::COMMAND_ACK(COMMAND_ACK_DATA {
                command: command.command,
                result,
                target_system: from.system,
                target_component: from.component,
                ..Default::default()
            }));
        }
        // The reason comes after the refusal.
        if let Some(text) = texts {
            self.text(text);
        }
    }

    fn carry_out(&mut self, command: &COMMAND_LONG_DATA) -> MavResult {
        match command.command {
            MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL => {
                let interval = (f64::from(command.param2) * 1e3) as i64;
                self.intervals.insert(command.param1 as u32, interval);
            }
            MavCmd::MAV_CMD_DO_SET_MODE if self.ignores_modes => {}
            MavCmd::MAV_CMD_DO_SET_MODE => {
                self.mode = command.param2 as u32;
                self.queue.push(self.heartbeat());
            }
            MavCmd::MAV_CMD_COMPONENT_ARM_DISARM => self.armed = command.param1 == 1.0,
            MavCmd::MAV_CMD_NAV_TAKEOFF => {
                if !self.armed || self.mode != 4 || self.height > 0.0 {
                    return MavResult::MAV_RESULT_FAILED;
                }
                self.climbs_to = Some(f64::from(command.param7));
                self.landed = MavLandedState::MAV_LANDED_STATE_TAKEOFF;
            }
            other => panic!("unexpected {other:?}"),
        }
        MavResult::MAV_RESULT_ACCEPTED
    }

    fn text(&mut self, text: &str) {
        self.queue.push(MavMessage::STATUSTEXT(STATUSTEXT_DATA {
            severity: MavSeverity::MAV_SEVERITY_CRITICAL,
            text: text.into(),
            ..Default::default()
        }));
    }

    fn heartbeat(&self) -> MavMessage {
        let armed = MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED;
        MavMessage::HEARTBEAT(HEARTBEAT_DATA {
            custom_mode: self.mode,
            mavtype: MavType::MAV_TYPE_QUADROTOR,
            autopilot: self.firmware,
            base_mode: if self.armed { armed } else { MavModeFlag::empty() },
            ..Default::default()
        })
    }

    fn step(&mut self, now: i64) -> Vec<MavMessage> {
        if let Some(height) = self.climbs_to {
            self.height += 0.04;
            if self.height >= height {
                self.climbs_to = None;
                self.landed = MavLandedState::MAV_LANDED_STATE_IN_AIR;
            }
        }
        let mut sent = std::mem::take(&mut self.queue);
        let tc1 = now - self.boot_ns;
        sent.extend(
            self.time_requests
                .drain(..)
                .map(|ts1| MavMessage::TIMESYNC(TIMESYNC_DATA { tc1, ts1, ..Default::default() })),
        );
        if now % SECOND == 0 && !self.has_no_heartbeat {
            sent.push(self.heartbeat());
        }
        for (&id, &interval) in &self.intervals {
            if now % interval < STEP {
                sent.extend(self.report(id, now));
            }
        }
        if self.silent { Vec::new() } else { sent }
    }

    fn report(&self, id: u32, now: i64) -> Option<MavMessage> {
        let time_boot_ms = ((now - self.late_steps * STEP - self.boot_ns) / 1_000_000) as u32;
        let prearm = MavSysStatusSensor::MAV_SYS_STATUS_PREARM_CHECK;
        let vz = if self.climbs_to.is_some() { -2.0 } else { 0.0 };
        Some(match id {
            30 => {
                MavMessage::ATTITUDE(ATTITUDE_DATA { time_boot_ms, yaw: 0.5, ..Default::default() })
            }
            32 if self.ready => MavMessage::LOCAL_POSITION_NED(LOCAL_POSITION_NED_DATA {
                time_boot_ms,
                // The origin lies 2 m below the ground.
                z: (-2.0 - self.height) as f32,
                vx: self.reported_m_s,
                vz,
                ..Default::default()
            }),
            1 => MavMessage::SYS_STATUS(SYS_STATUS_DATA {
                onboard_control_sensors_present: prearm,
                onboard_control_sensors_health: if self.ready {
                    prearm
                } else {
                    MavSysStatusSensor::empty()
                },
                ..Default::default()
            }),
            193 => MavMessage::EKF_STATUS_REPORT(EKF_STATUS_REPORT_DATA {
                flags: EkfStatusFlags::from_bits_retain(if self.ready { 831 } else { 167 }),
                ..Default::default()
            }),
            245 => MavMessage::EXTENDED_SYS_STATE(EXTENDED_SYS_STATE_DATA {
                landed_state: self.landed,
                ..Default::default()
            }),
            _ => return None,
        })
    }
}

struct World {
    now: i64,
    client: Autopilot,
    fake: Fake,
    events: Vec<Event>,
    sequence: u8,
    /// After how many steps the client's packets return to it; 0: never.
    echo_steps: usize,
    echoes: VecDeque<Vec<Vec<u8>>>,
}

impl World {
    fn new() -> Self {
        Self::with(Fake::new(), Config::default())
    }

    fn with(fake: Fake, config: Config) -> Self {
        Self {
            now: 100 * SECOND,
            client: Autopilot::new(config),
            fake,
            events: Vec::new(),
            sequence: 0,
            echo_steps: 0,
            echoes: VecDeque::new(),
        }
    }

    fn flying() -> Self {
        let mut fake = Fake::new();
        (fake.mode, fake.armed, fake.height) = (4, true, 10.0);
        fake.landed = MavLandedState::MAV_LANDED_STATE_IN_AIR;
        let mut world = Self::with(fake, Config::default());
        world.run(5);
        world
    }

    fn standing() -> Self {
        let mut world = Self::new();
        world.run(5);
        world
    }

    fn receive(&mut self, sender: Sender, message: &MavMessage) {
        let packet = packet::encode(sender, self.sequence, message);
        self.sequence = self.sequence.wrapping_add(1);
        for packet in Parser::new().push(&packet) {
            self.client.handle(self.now, &packet);
        }
    }

    fn step(&mut self) {
        self.now += STEP;
        for message in self.fake.step(self.now) {
            self.receive(AUTOPILOT, &message);
        }
        self.client.tick(self.now);
        let mut sent = Vec::new();
        while let Some(packet) = self.client.poll_outgoing() {
            self.fake.receive(&packet);
            sent.push(packet);
        }
        self.echo(sent);
        while let Some(event) = self.client.poll_event() {
            self.events.push(event);
        }
    }

    /// A router sends the client's packets back, some steps later.
    fn echo(&mut self, sent: Vec<Vec<u8>>) {
        self.echoes.push_back(sent);
        if self.echo_steps == 0 || self.echoes.len() <= self.echo_steps {
            return;
        }
        for packet in self.echoes.pop_front().unwrap_or_default() {
            for packet in Parser::new().push(&packet) {
                self.client.handle(self.now, &packet);
            }
        }
    }

    fn run(&mut self, seconds: i64) {
        for _ in 0..seconds * SECOND / STEP {
            self.step();
        }
    }

    /// Requests a command and waits for the outcome.
    fn request(&mut self, command: Command) -> Result<(), CommandError> {
        let id = self.client.request(self.now, command);
        self.outcome(id)
    }

    fn outcome(&mut self, id: CommandId) -> Result<(), CommandError> {
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

    /// Takes off; returns the end, and all texts of the progress.
    fn take_off(&mut self, takeoff: &mut Takeoff, seconds: i64) -> (TakeoffProgress, Vec<String>) {
        let mut texts = Vec::<String>::new();
        for _ in 0..seconds * SECOND / STEP {
            self.step();
            let progress = takeoff.step(self.now, &mut self.client);
            let words = progress.to_string();
            if texts.last() != Some(&words) {
                texts.push(words);
            }
            if takeoff.is_finished() {
                return (progress, texts);
            }
        }
        panic!("a takeoff without an end: {texts:?}");
    }

    fn count(&self, wanted: impl Fn(&Event) -> bool) -> usize {
        self.events.iter().filter(|event| wanted(event)).count()
    }

    fn commands(&self, command: MavCmd) -> usize {
        self.fake.received.iter().filter(|&&received| received == command).count()
    }
}

#[test]
fn a_position_that_stays_the_same_although_the_vehicle_moves_grows_old() {
    let mut world = World::standing();
    let age_s = |world: &World| {
        let position = world.client.state().unwrap().position.unwrap();
        (world.now - position.stamp_ns) as f64 * 1e-9
    };
    world.run(3);
    assert!(age_s(&world) < 0.1, "a simulated vehicle is stationary");
    world.fake.reported_m_s = 0.3;
    world.run(3);
    assert!(age_s(&world) > 2.5, "{} s", age_s(&world));
    assert!(world.client.late_measurements() > 100, "they are counted");
}

#[test]
fn it_finds_the_vehicle_and_gets_its_messages_at_their_rates() {
    let mut world = World::standing();
    assert!(world.events.contains(&Event::Found { system: 1, firmware: Firmware::Copter }));
    let before = world.count(|event| matches!(event, Event::Position(_)));
    world.run(10);
    let positions = world.count(|event| matches!(event, Event::Position(_))) - before;
    assert_eq!(positions, 500);
    assert_eq!(world.commands(MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL), 7, "each is requested once");
    let state = world.client.state().unwrap();
    assert!(state.ready && state.connected && !state.armed);
    assert_eq!(state.landed, LandedState::OnGround);
    let (_, _, yaw) = state.attitude.unwrap().ned_from_body.euler();
    assert!((yaw - 0.5).abs() < 1e-6);
    assert_eq!(world.count(|event| matches!(event, Event::StreamMissing { .. })), 0);
}

#[test]
fn other_senders_on_the_link_are_not_the_autopilot() {
    let mut world = World::new();
    let station = MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        mavtype: MavType::MAV_TYPE_GCS,
        autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
        ..Default::default()
    });
    world.receive(Sender { system: 255, component: 190 }, &station);
    world.receive(Sender { system: 255, component: 1 }, &station);
    let camera = MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
        mavtype: MavType::MAV_TYPE_CAMERA,
        ..Default::default()
    });
    world.receive(Sender { system: 1, component: 100 }, &camera);
    assert!(world.client.state().is_none());

    world.run(3);
    let armed = HEARTBEAT_DATA {
        base_mode: MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED,
        mavtype: MavType::MAV_TYPE_QUADROTOR,
        autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
        ..Default::default()
    };
    for _ in 0..3 {
        world.receive(Sender { system: 2, component: 1 }, &MavMessage::HEARTBEAT(armed.clone()));
    }
    world.step();
    assert!(!world.client.state().unwrap().armed, "that was another vehicle");
    assert_eq!(world.count(|event| *event == Event::OtherVehicle { system: 2 }), 1);
}

#[test]
fn a_second_controller_with_our_ids_is_reported_once() {
    let mut world = World::standing();
    let companion = Sender { system: 1, component: 191 };
    for _ in 0..3 {
        world.receive(companion, &MavMessage::HEARTBEAT(autopilot::compose::heartbeat()));
        world.step();
    }
    assert_eq!(world.count(|event| *event == Event::SameAddress { sender: companion }), 1);
}

#[test]
fn our_packets_that_a_router_sends_back_are_no_second_controller() {
    // Each of them returns 0.4 s later.
    let mut world = World { echo_steps: 20, ..World::new() };
    let mut takeoff = Takeoff::new(10.0);
    let (end, _) = world.take_off(&mut takeoff, 60);
    assert_eq!(end, TakeoffProgress::Done);
    let is_reported = |event: &Event| matches!(event, Event::SameAddress { .. });
    assert_eq!(world.count(is_reported), 0);
}

#[test]
fn only_the_pinned_system_is_found() {
    let config = Config { system_id: Some(7), ..Config::default() };
    let mut world = World::with(Fake::new(), config);
    world.client.tick(world.now);
    while world.client.poll_outgoing().is_some() {}
    world.receive(AUTOPILOT, &world.fake.heartbeat());
    assert!(world.client.state().is_none());
    world.receive(Sender { system: 7, component: 1 }, &world.fake.heartbeat());
    assert_eq!(world.client.system(), Some(7));
    assert_eq!(world.client.our_address(), Sender { system: 7, component: 191 });
}

#[test]
fn a_lost_command_and_a_lost_acknowledgement_do_no_harm() {
    for (lose_commands, lose_acks) in [(0, 0), (2, 0), (0, 2), (1, 1)] {
        let mut world = World::standing();
        (world.fake.lose_commands, world.fake.lose_acks) = (lose_commands, lose_acks);
        assert_eq!(world.request(Command::SetMode(FlightMode::Guided)), Ok(()));
        assert_eq!(world.client.state().unwrap().mode, FlightMode::Guided);
        (world.fake.lose_commands, world.fake.lose_acks) = (lose_commands, lose_acks);
        assert_eq!(world.request(Command::Arm), Ok(()));
        assert!(world.client.state().unwrap().armed, "done only when the heartbeat shows it");
        (world.fake.lose_commands, world.fake.lose_acks) = (lose_commands, lose_acks);
        assert_eq!(world.request(Command::Takeoff { height_m: 10.0 }), Ok(()));
        assert!(world.fake.climbs_to.is_some());
    }
}

#[test]
fn silence_after_a_command_is_an_error_that_names_it() {
    let mut world = World::standing();
    world.fake.lose_commands = 100;
    let error = world.request(Command::Arm).unwrap_err();
    assert_eq!(error, CommandError::NoAnswer { command: Command::Arm, attempts: 4 });
    assert!(error.to_string().starts_with("arm: no acknowledgement of 4 requests"), "{error}");
}

#[test]
fn a_refusal_has_the_autopilots_own_reason() {
    let mut world = World::standing();
    let denied = MavResult::MAV_RESULT_FAILED;
    world.fake.refuse =
        Some((MavCmd::MAV_CMD_COMPONENT_ARM_DISARM, denied, "Arm: Accels inconsistent", 9));
    let error = world.request(Command::Arm).unwrap_err().to_string();
    assert!(error.contains("failed") && error.contains("Arm: Accels inconsistent"), "{error}");
    assert_eq!(
        world.commands(MavCmd::MAV_CMD_COMPONENT_ARM_DISARM),
        1,
        "a refusal is not repeated"
    );
}

#[test]
fn each_refusal_gets_its_own_reason() {
    let mut world = World::standing();
    let arm = world.client.request(world.now, Command::Arm);
    let takeoff = world.client.request(world.now, Command::Takeoff { height_m: 5.0 });
    world.fake.refuse = Some((
        MavCmd::MAV_CMD_COMPONENT_ARM_DISARM,
        MavResult::MAV_RESULT_FAILED,
        "Arm: Accels inconsistent",
        1,
    ));
    world.fake.text("No such mode 99");
    world.step();
    world.fake.text("No such mode 99");
    let texts = |error| match error {
        Err(CommandError::Refused { texts, .. }) => texts,
        other => panic!("{other:?}"),
    };
    assert_eq!(texts(world.outcome(arm)), ["Arm: Accels inconsistent"]);
    assert_eq!(texts(world.outcome(takeoff)), ["No such mode 99"]);
}

#[test]
fn a_temporary_refusal_is_tried_again() {
    let mut world = World::standing();
    let later = MavResult::MAV_RESULT_TEMPORARILY_REJECTED;
    world.fake.refuse = Some((MavCmd::MAV_CMD_DO_SET_MODE, later, "wait", 2));
    assert_eq!(world.request(Command::SetMode(FlightMode::Land)), Ok(()));
}

#[test]
fn an_accepted_mode_that_never_shows_is_an_error() {
    let mut world = World::standing();
    world.fake.ignores_modes = true;
    let error = world.request(Command::SetMode(FlightMode::Land)).unwrap_err();
    assert!(matches!(error, CommandError::NotConfirmed { .. }));
    assert!(error.to_string().contains("still shows STABILIZE"), "{error}");
}

#[test]
fn an_acknowledgement_for_another_station_is_ignored() {
    let mut world = World::standing();
    world.fake.lose_commands = 1;
    let id = world.client.request(world.now, Command::Arm);
    world.step();
    let ack = COMMAND_ACK_DATA {
        command: MavCmd::MAV_CMD_COMPONENT_ARM_DISARM,
        result: MavResult::MAV_RESULT_FAILED,
        target_system: 255,
        target_component: 190,
        ..Default::default()
    };
    world.receive(AUTOPILOT, &MavMessage::COMMAND_ACK(ack));
    assert_eq!(world.outcome(id), Ok(()));
}

#[test]
fn a_later_command_replaces_an_earlier_one() {
    let mut world = World::standing();
    world.fake.lose_commands = 1;
    let first = world.client.request(world.now, Command::SetMode(FlightMode::Guided));
    world.step();
    assert_eq!(world.request(Command::SetMode(FlightMode::Land)), Ok(()));
    assert!(matches!(
        world.client.status(first),
        CommandStatus::Failed(CommandError::Replaced { .. })
    ));
}

#[test]
fn a_late_acknowledgement_of_another_mode_does_not_keep_a_mode_from_being_sent_again() {
    for pilots in [None, Some(5)] {
        let mut world = World::flying();
        world.fake.lose_acks = 1;
        assert_eq!(world.request(Command::SetMode(FlightMode::Land)), Ok(()));
        world.fake.lose_commands = 1;
        let (began, sent) = (world.now, world.commands(MavCmd::MAV_CMD_DO_SET_MODE));
        let id = world.client.request(world.now, Command::SetMode(FlightMode::Guided));
        world.step();
        let late = COMMAND_ACK_DATA {
            command: MavCmd::MAV_CMD_DO_SET_MODE,
            result: MavResult::MAV_RESULT_ACCEPTED,
            target_system: 1,
            target_component: 191,
            ..Default::default()
        };
        world.receive(AUTOPILOT, &MavMessage::COMMAND_ACK(late));
        if let Some(mode) = pilots {
            // It is not sent against a pilot.
            world.fake.mode = mode;
            assert!(world.outcome(id).is_err());
            assert_eq!(world.commands(MavCmd::MAV_CMD_DO_SET_MODE), sent);
        } else {
            assert_eq!(world.outcome(id), Ok(()));
            assert!(world.now - began <= 5 * SECOND / 2, "{} ns", world.now - began);
        }
    }
}

#[test]
fn a_repeated_request_without_acknowledgement_is_sent_at_once() {
    let mut world = World::standing();
    world.fake.lose_commands = 1;
    let first = world.client.request(world.now, Command::SetMode(FlightMode::Land));
    world.step();
    let second = world.client.request(world.now, Command::SetMode(FlightMode::Land));
    assert_eq!(first, second);
    for _ in 0..10 {
        world.step();
    }
    assert_eq!(world.client.state().unwrap().mode, FlightMode::Land, "not after a second only");
}

#[test]
fn no_heartbeat_is_lost_while_this_process_does_not_run() {
    let mut world = World::flying();
    for frozen_s in [3, 20, 3600] {
        world.now += frozen_s * SECOND;
        // Time passes before the packets in the socket are read.
        world.client.tick(world.now);
        world.run(1);
        assert!(world.client.is_connected(), "{frozen_s} s");
    }
    assert_eq!(world.count(|event| matches!(event, Event::Lost { .. })), 0);
    world.now += 20 * SECOND;
    world.fake.silent = true;
    world.run(5);
    assert_eq!(world.count(|event| matches!(event, Event::Lost { .. })), 1);
}

#[test]
fn a_lost_heartbeat_is_reported_and_ends_commands() {
    let mut world = World::flying();
    let id = world.client.request(world.now, Command::SetMode(FlightMode::Land));
    world.fake.silent = true;
    world.run(5);
    assert_eq!(world.count(|event| matches!(event, Event::Lost { .. })), 1);
    assert!(!world.client.state().unwrap().ready, "it may have restarted when it returns");
    let lost = CommandError::NoAutopilot { command: Command::SetMode(FlightMode::Land) };
    assert_eq!(world.outcome(id), Err(lost));
    let velocity = world.client.set_velocity(world.now, Vector::zero(), 0.0);
    assert_eq!(velocity, Err(SetpointError::NoAutopilot));
    assert!(world.request(Command::Arm).unwrap_err().to_string().contains("no heartbeat"));

    let requests = world.commands(MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL);
    world.fake.silent = false;
    world.run(5);
    assert_eq!(world.count(|event| *event == Event::Returned), 1);
    assert!(
        world.commands(MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL) >= requests + 7,
        "rates are requested again"
    );
}

#[test]
fn a_restart_is_detected_and_everything_requested_again() {
    let mut world = World::standing();
    world.run(5);
    let boot_ns = world.now;
    world.fake = Fake { boot_ns, ready: false, ..Fake::new() };
    world.run(10);
    assert_eq!(world.count(|event| matches!(event, Event::Restarted { .. })), 1);
    let state = *world.client.state().unwrap();
    assert!(!state.ready && state.position.is_none(), "the old position is not the new one's");
    world.fake.ready = true;
    world.run(15);
    assert!(world.client.state().unwrap().ready);
    assert!(world.client.state().unwrap().position.is_some());
}

#[test]
fn rates_that_another_station_overwrote_are_restored() {
    let mut world = World::standing();
    for interval in world.fake.intervals.values_mut() {
        *interval = SECOND / 2;
    }
    world.run(6);
    let before = world.count(|event| matches!(event, Event::Attitude(_)));
    world.run(4);
    assert_eq!(world.count(|event| matches!(event, Event::Attitude(_))) - before, 200);
}

#[test]
fn a_message_that_never_comes_is_named() {
    let mut world = World::with(Fake { ready: false, ..Fake::new() }, Config::default());
    world.run(70);
    assert_eq!(
        world.count(|event| matches!(
            event,
            Event::StreamMissing { message: "LOCAL_POSITION_NED", .. }
        )),
        1
    );
    world.fake.ready = true;
    world.run(15);
    assert_eq!(
        world.count(|event| matches!(
            event,
            Event::StreamRestored { message: "LOCAL_POSITION_NED", .. }
        )),
        1
    );
}

#[test]
fn velocities_are_sent_only_in_flight_in_guided() {
    let mut world = World::flying();
    let forward = Vector::new(0.5, 0.0, -0.1);
    assert_eq!(world.client.set_velocity(world.now, forward, 0.0), Ok(()));
    world.step();
    assert_eq!(world.fake.velocities, [[0.5, 0.0, -0.1]]);

    for bad in [f64::NAN, f64::INFINITY, 1e300] {
        let velocity = Vector::new(0.0, bad, 0.0);
        let refused = world.client.set_velocity(world.now, velocity, 0.0);
        assert!(matches!(refused, Err(SetpointError::NotFinite(..))));
        let refused = world.client.set_velocity(world.now, forward, bad);
        assert!(matches!(refused, Err(SetpointError::NotFinite(..))));
    }
    world.fake.mode = 5;
    world.run(2);
    let refused = world.client.set_velocity(world.now, forward, 0.0);
    assert_eq!(refused, Err(SetpointError::NotGuided(FlightMode::Other(5))));
    assert_eq!(world.fake.velocities.len(), 1);
    let rising = Fake {
        mode: 4,
        armed: true,
        landed: MavLandedState::MAV_LANDED_STATE_TAKEOFF,
        ..Fake::new()
    };
    let mut world = World::with(rising, Config::default());
    world.run(2);
    let refused = world.client.set_velocity(world.now, forward, 0.0);
    assert_eq!(refused, Err(SetpointError::NotFlying(LandedState::TakingOff)));
}

#[test]
fn a_flying_vehicle_gets_setpoints_despite_reports_of_the_ground() {
    let stop = Vector::zero();
    let mut world = World::flying();
    for report in [
        MavLandedState::MAV_LANDED_STATE_UNDEFINED,
        MavLandedState::MAV_LANDED_STATE_TAKEOFF,
        MavLandedState::MAV_LANDED_STATE_LANDING,
    ] {
        world.fake.landed = report;
        world.run(6);
        assert_eq!(world.client.set_velocity(world.now, stop, 0.0), Ok(()), "{report:?}");
    }
    world.fake.landed = MavLandedState::MAV_LANDED_STATE_IN_AIR;
    world.run(1);
    let on_ground = EXTENDED_SYS_STATE_DATA {
        landed_state: MavLandedState::MAV_LANDED_STATE_ON_GROUND,
        ..Default::default()
    };
    world.receive(AUTOPILOT, &MavMessage::EXTENDED_SYS_STATE(on_ground));
    assert_eq!(world.client.state().unwrap().landed, LandedState::InAir, "one report");
    world.fake.landed = MavLandedState::MAV_LANDED_STATE_ON_GROUND;
    world.run(1);
    assert_eq!(world.client.state().unwrap().landed, LandedState::OnGround, "five of them");
}

#[test]
fn without_the_heartbeat_alone_setpoints_continue_and_commands_do_not() {
    let mut world = World::flying();
    world.fake.has_no_heartbeat = true;
    world.run(5);
    assert!(!world.client.is_connected(), "the mode is not known");
    assert_eq!(world.client.set_velocity(world.now, Vector::zero(), 0.0), Ok(()));
    let refused = world.request(Command::SetMode(FlightMode::Land));
    assert!(matches!(refused, Err(CommandError::NoAutopilot { .. })), "{refused:?}");
    world.fake.silent = true;
    world.run(4);
    let refused = world.client.set_velocity(world.now, Vector::zero(), 0.0);
    assert_eq!(refused, Err(SetpointError::NoAutopilot));
}

#[test]
fn a_measurement_of_another_time_is_neither_used_nor_a_restart() {
    let mut world = World::flying();
    let known = world.client.state().unwrap().attitude.unwrap();
    for time_boot_ms in [0, known.boot_ms - 100, known.boot_ms + 1_000_000] {
        let message = ATTITUDE_DATA { time_boot_ms, yaw: -2.0, ..Default::default() };
        world.receive(AUTOPILOT, &MavMessage::ATTITUDE(message));
        assert_eq!(world.client.state().unwrap().attitude, Some(known), "{time_boot_ms} ms");
    }
    world.run(2);
    assert_eq!(world.count(|event| matches!(event, Event::Restarted { .. })), 0);
    assert!(world.client.state().unwrap().attitude.unwrap().boot_ms > known.boot_ms);
    assert_eq!(world.client.late_measurements(), 3);
}

#[test]
fn mode_motors_and_contact_are_reported_after_every_heartbeat() {
    let mut world = World::flying();
    let reports = |world: &World| world.count(|event| matches!(event, Event::Status(_)));
    let before = reports(&world);
    // Of 3 heartbeats and 15 reports of the contact.
    world.run(3);
    assert!(reports(&world) >= before + 17, "{}", reports(&world) - before);
}

#[test]
fn unsupported_firmware_is_refused_by_name() {
    let fake = Fake { firmware: MavAutopilot::MAV_AUTOPILOT_GENERIC, mode: 4, ..Fake::new() };
    let mut world = World::with(fake, Config::default());
    world.run(3);
    let error = world.request(Command::Arm).unwrap_err().to_string();
    assert!(error.contains("unknown firmware") && error.contains("ArduPilot or PX4"), "{error}");
    let error = world.client.set_velocity(world.now, Vector::zero(), 0.0).unwrap_err();
    assert_eq!(error, SetpointError::Unsupported(Firmware::Unknown));
}

#[test]
fn measurements_carry_their_measurement_time_once_clocks_are_synchronised() {
    let boot_ns = 63 * SECOND;
    let fake = Fake { boot_ns, late_steps: 15, ..Fake::new() };
    let age_ms = |world: &World| {
        let attitude = world.client.state().unwrap().attitude.unwrap();
        (world.now - attitude.stamp_ns) / 1_000_000
    };
    let mut world = World::with(fake.clone(), Config::default());
    world.run(10);
    // A round trip lasts a step of 20 ms here, so half of it is not known.
    assert!(world.client.round_trip(world.now).is_some_and(|trip| trip.as_millis() <= 20));
    assert!((280..=320).contains(&age_ms(&world)), "{} ms", age_ms(&world));
    let mut without = World::with(fake, Config { timesync: false, ..Config::default() });
    without.run(10);
    assert!(without.client.round_trip(without.now).is_none());
    assert!(age_ms(&without) <= 20, "that of its reception");
    // A measurement that comes seconds late, as out of a link's backlog, is not used.
    let mut backlog =
        World::with(Fake { boot_ns, late_steps: 200, ..Fake::new() }, Config::default());
    backlog.run(10);
    let old = backlog.client.late_measurements();
    backlog.run(2);
    assert!(backlog.client.late_measurements() > old + 100, "still left out");
    assert_eq!(backlog.client.state().unwrap().attitude, None);
    // It requests our time as well, and gets it.
    let question = TIMESYNC_DATA { tc1: 0, ts1: 77, ..Default::default() };
    world.receive(AUTOPILOT, &MavMessage::TIMESYNC(question));
    let mut answers = Vec::new();
    while let Some(packet) = world.client.poll_outgoing() {
        answers.extend(Parser::new().push(&packet).into_iter().filter_map(|f| f.message));
    }
    let reply = |message: &MavMessage| match message {
        MavMessage::TIMESYNC(answer) => Some((answer.tc1, answer.ts1)),
        _ => None,
    };
    assert_eq!(answers.iter().find_map(reply), Some((world.now, 77)));
}

#[test]
fn a_takeoff_waits_arms_again_and_ends_at_its_height() {
    let mut world = World::with(Fake { ready: false, ..Fake::new() }, Config::default());
    let mut takeoff = Takeoff::new(10.0);
    world.run(3);
    world.fake.text("PreArm: Need Position Estimate");
    for _ in 0..100 {
        world.step();
        takeoff.step(world.now, &mut world.client);
    }
    let waiting = takeoff.step(world.now, &mut world.client).to_string();
    assert!(
        waiting.contains("EKF origin") && waiting.contains("prearm: Need Position"),
        "{waiting}"
    );

    world.fake.ready = true;
    let failed = MavResult::MAV_RESULT_FAILED;
    world.fake.refuse =
        Some((MavCmd::MAV_CMD_COMPONENT_ARM_DISARM, failed, "Arm: Gyros not healthy", 2));
    let (end, texts) = world.take_off(&mut takeoff, 60);
    assert_eq!(end, TakeoffProgress::Done, "{texts:?}");
    assert!((world.fake.height - 10.0).abs() < 0.5);
    assert!(texts.iter().any(|words| words.contains("Gyros not healthy")), "{texts:?}");
    assert!(world.fake.velocities.is_empty());
    let orders: Vec<MavCmd> = world
        .fake
        .received
        .iter()
        .copied()
        .filter(|command| *command != MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL)
        .collect();
    assert_eq!(
        orders,
        [
            MavCmd::MAV_CMD_DO_SET_MODE,
            MavCmd::MAV_CMD_COMPONENT_ARM_DISARM,
            MavCmd::MAV_CMD_COMPONENT_ARM_DISARM,
            MavCmd::MAV_CMD_COMPONENT_ARM_DISARM,
            MavCmd::MAV_CMD_NAV_TAKEOFF,
        ]
    );
}

#[test]
fn a_vehicle_that_flies_already_needs_no_takeoff() {
    let mut world = World::flying();
    let (end, _) = world.take_off(&mut Takeoff::new(10.0), 5);
    assert_eq!(end, TakeoffProgress::Done);
    assert_eq!(world.commands(MavCmd::MAV_CMD_NAV_TAKEOFF), 0);
}

#[test]
fn a_vehicle_of_another_controller_with_our_ids_is_neither_lifted_nor_taken_over() {
    for mut world in [World::standing(), World::flying()] {
        let companion = Sender { system: 1, component: 191 };
        world.receive(companion, &MavMessage::HEARTBEAT(autopilot::compose::heartbeat()));
        let (end, _) = world.take_off(&mut Takeoff::new(10.0), 5);
        let TakeoffProgress::Failed(TakeoffError::Conflict(Conflict::SameAddress {
            sender, ..
        })) = &end
        else {
            panic!("{end:?}")
        };
        assert_eq!(*sender, companion);
        assert!(end.to_string().contains("End that one"), "{end}");
        assert!(
            world.commands(MavCmd::MAV_CMD_DO_SET_MODE) == 0 && world.fake.velocities.is_empty()
        );
    }
}

/// The heartbeat of an autopilot that is not ours.
fn of_another_vehicle() -> MavMessage {
    MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        mavtype: MavType::MAV_TYPE_QUADROTOR,
        autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
        ..Default::default()
    })
}

#[test]
fn of_two_vehicles_on_the_link_none_is_armed_while_none_is_pinned() {
    for mut world in [World::standing(), World::flying()] {
        world.receive(Sender { system: 2, component: 1 }, &of_another_vehicle());
        // It is not forgotten: the right one cannot be identified.
        world.run(60);
        let (end, _) = world.take_off(&mut Takeoff::new(10.0), 5);
        let conflict = Conflict::SeveralVehicles { system: 1, other: 2 };
        assert_eq!(end, TakeoffProgress::Failed(TakeoffError::Conflict(conflict)));
        let text = end.to_string();
        let parts = ["system ids 1 and 2", "autopilot.system_id"];
        assert!(parts.iter().all(|part| text.contains(part)), "{text}");
        assert_eq!(world.commands(MavCmd::MAV_CMD_COMPONENT_ARM_DISARM), 0);
    }
}

#[test]
fn a_pinned_vehicle_takes_off_with_another_one_on_the_link() {
    let config = Config { system_id: Some(1), ..Config::default() };
    let mut world = World::with(Fake::new(), config);
    world.run(1);
    world.receive(Sender { system: 2, component: 1 }, &of_another_vehicle());
    assert_eq!(world.client.conflict(world.now), None);
    let (end, _) = world.take_off(&mut Takeoff::new(10.0), 60);
    assert_eq!(end, TakeoffProgress::Done);
}

#[test]
fn a_vehicle_that_is_ready_at_once_is_armed_only_when_a_heartbeat_of_another_would_have_come() {
    let mut world = World::new();
    let began = world.now;
    let mut takeoff = Takeoff::new(10.0);
    let mut waits = Vec::new();
    while world.commands(MavCmd::MAV_CMD_DO_SET_MODE) == 0 {
        world.step();
        waits.push(takeoff.step(world.now, &mut world.client).to_string());
        assert!(world.now - began < 20 * SECOND, "{waits:?}");
    }
    assert!(world.now - began >= 2 * SECOND, "after {} ns", world.now - began);
    assert!(waits.iter().any(|wait| wait.contains("another vehicle")), "{waits:?}");
}

#[test]
fn once_the_other_controller_with_our_ids_has_ended_the_vehicle_takes_off() {
    let mut world = World::standing();
    let companion = Sender { system: 1, component: 191 };
    world.receive(companion, &MavMessage::HEARTBEAT(autopilot::compose::heartbeat()));
    world.run(11);
    let (end, _) = world.take_off(&mut Takeoff::new(10.0), 60);
    assert_eq!(end, TakeoffProgress::Done);
    world.receive(companion, &MavMessage::HEARTBEAT(autopilot::compose::heartbeat()));
    world.step();
    assert_eq!(world.count(|event| *event == Event::SameAddress { sender: companion }), 2);
}

#[test]
fn a_vehicle_that_the_pilot_flies_is_left_alone() {
    let mut world = World::flying();
    world.fake.mode = 5;
    world.run(2);
    let (end, _) = world.take_off(&mut Takeoff::new(10.0), 5);
    let TakeoffProgress::Failed(TakeoffError::PilotInCommand { mode, .. }) = &end else {
        panic!("{end:?}")
    };
    assert_eq!(*mode, FlightMode::Other(5));
    assert!(end.to_string().contains("in the air in LOITER"), "{end}");
    assert_eq!(world.commands(MavCmd::MAV_CMD_DO_SET_MODE), 0);
}

#[test]
fn the_pilots_mode_switch_ends_a_takeoff() {
    let mut world = World::standing();
    let mut takeoff = Takeoff::new(10.0);
    while world.fake.height < 3.0 {
        world.step();
        takeoff.step(world.now, &mut world.client);
    }
    world.fake.mode = 16;
    let (end, _) = world.take_off(&mut takeoff, 5);
    assert!(matches!(end, TakeoffProgress::Failed(TakeoffError::PilotInCommand { .. })));
    world.fake.mode = 4;
    world.run(3);
    assert_eq!(takeoff.step(world.now, &mut world.client), end, "an end stays an end");
}

#[test]
fn a_lost_command_is_not_repeated_against_the_pilot() {
    let mut world = World::flying();
    world.fake.lose_commands = 1;
    let id = world.client.request(world.now, Command::SetMode(FlightMode::Land));
    world.step();
    world.fake.mode = 5;
    world.client.withdraw();
    world.run(5);
    let withdrawn = CommandError::Withdrawn { command: Command::SetMode(FlightMode::Land) };
    assert_eq!(world.client.status(id), CommandStatus::Failed(withdrawn));
    assert_eq!((world.commands(MavCmd::MAV_CMD_DO_SET_MODE), world.fake.mode), (0, 5));

    // The pilot switches while we arm, and the motors stay off.
    let mut world = World::standing();
    let mut takeoff = Takeoff::new(10.0);
    while world.client.state().unwrap().mode != FlightMode::Guided {
        world.step();
        takeoff.step(world.now, &mut world.client);
    }
    world.fake.lose_commands = 1;
    while world.fake.lose_commands > 0 {
        takeoff.step(world.now, &mut world.client);
        world.step();
    }
    world.fake.mode = 0;
    let (end, _) = world.take_off(&mut takeoff, 3);
    assert!(matches!(end, TakeoffProgress::Failed(TakeoffError::PilotInCommand { .. })), "{end}");
    world.run(5);
    assert!(!world.fake.armed && world.commands(MavCmd::MAV_CMD_COMPONENT_ARM_DISARM) == 0);
}

#[test]
fn after_a_standstill_the_pilots_switch_is_read_before_a_request_is_sent_again() {
    for pilots in [Some(5), None] {
        let mut world = World::flying();
        world.fake.lose_commands = 1;
        let id = world.client.request(world.now, Command::SetMode(FlightMode::Land));
        world.step();
        // This process is stopped, and packets wait.
        let mut waiting = Vec::new();
        for step in 0..3 * SECOND / STEP {
            world.now += STEP;
            if step == 2 * SECOND / STEP {
                world.fake.mode = pilots.unwrap_or(world.fake.mode);
            }
            waiting.extend(world.fake.step(world.now));
        }
        // As it continues, half of them are read before a tick.
        for (number, message) in waiting.iter().enumerate() {
            world.receive(AUTOPILOT, message);
            if number == waiting.len() / 2 {
                world.client.tick(world.now);
            }
        }
        let sent = std::iter::from_fn(|| world.client.poll_outgoing());
        sent.for_each(|packet| world.fake.receive(&packet));
        assert_eq!(world.commands(MavCmd::MAV_CMD_DO_SET_MODE), 0);
        if pilots.is_some() {
            world.client.withdraw();
            world.run(5);
            assert_eq!((world.commands(MavCmd::MAV_CMD_DO_SET_MODE), world.fake.mode), (0, 5));
        } else {
            assert_eq!(world.outcome(id), Ok(()), "it is sent later");
        }
    }
}

#[test]
fn a_vehicle_found_standing_with_armed_motors_is_not_lifted() {
    let found = |landed| {
        let mut world =
            World::with(Fake { mode: 4, armed: true, landed, ..Fake::new() }, Config::default());
        world.run(5);
        world
    };
    // It has just touched down; a controller that is started now must not fly again.
    let mut world = found(MavLandedState::MAV_LANDED_STATE_ON_GROUND);
    let mut takeoff = Takeoff::new(10.0);
    for _ in 0..100 {
        world.step();
        takeoff.step(world.now, &mut world.client);
    }
    let waiting = takeoff.step(world.now, &mut world.client).to_string();
    assert!(waiting.contains("disarm it first"), "{waiting}");
    world.fake.armed = false;
    let (end, _) = world.take_off(&mut takeoff, 5);
    assert_eq!(end, TakeoffProgress::Failed(TakeoffError::Disarmed));
    assert!(world.fake.received.iter().all(|c| *c == MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL));

    // Its motors were being started for a take-off that an earlier controller requested.
    let mut world = found(MavLandedState::MAV_LANDED_STATE_ON_GROUND);
    let mut takeoff = Takeoff::new(10.0);
    takeoff.step(world.now, &mut world.client);
    world.fake.climbs_to = Some(10.0);
    world.fake.landed = MavLandedState::MAV_LANDED_STATE_TAKEOFF;
    let (end, _) = world.take_off(&mut takeoff, 60);
    assert_eq!(end, TakeoffProgress::Done);
}

#[test]
fn a_standstill_in_the_climb_counts_for_no_time_limit() {
    let mut world = World::standing();
    let mut takeoff = Takeoff::new(10.0);
    while world.fake.height < 1.9 {
        world.step();
        takeoff.step(world.now, &mut world.client);
    }
    // It climbs on, and its packets are lost: the last known height is that of before.
    let end_ns = world.now + 40 * SECOND;
    while world.now < end_ns {
        world.now += STEP;
        world.fake.step(world.now);
    }
    world.client.tick(world.now);
    let progress = takeoff.step(world.now, &mut world.client);
    assert!(matches!(progress, TakeoffProgress::Climbing { .. }), "{progress:?}");
    let (end, texts) = world.take_off(&mut takeoff, 5);
    assert_eq!(end, TakeoffProgress::Done, "{texts:?}");
    assert!((world.fake.height - 10.0).abs() < 0.5);
}

#[test]
fn a_takeoff_gives_up_with_the_reasons() {
    let mut world = World::with(Fake { ready: false, ..Fake::new() }, Config::default());
    let (end, _) = world.take_off(&mut Takeoff::new(10.0), 125);
    assert!(end.to_string().contains("not ready after 120 s: waiting for the EKF origin"), "{end}");

    let mut world = World::standing();
    let mut takeoff = Takeoff::new(10.0);
    while world.fake.height < 1.0 {
        world.step();
        takeoff.step(world.now, &mut world.client);
    }
    world.fake.armed = false;
    let (end, _) = world.take_off(&mut takeoff, 5);
    assert_eq!(end, TakeoffProgress::Failed(TakeoffError::Disarmed));

    let mut world = World::standing();
    let mut takeoff = Takeoff::new(10.0);
    while world.fake.height < 1.9 {
        world.step();
        takeoff.step(world.now, &mut world.client);
    }
    world.fake.climbs_to = None;
    world.fake.landed = MavLandedState::MAV_LANDED_STATE_IN_AIR;
    let (end, _) = world.take_off(&mut takeoff, 40);
    assert!(end.to_string().contains("1.9 m of 10.0 m, in the air"), "{end}");
}

proptest::proptest! {
    #[test]
    fn no_message_of_the_autopilot_and_no_time_panics(
        messages in proptest::collection::vec((
            proptest::sample::select(vec![0, 1, 30, 31, 32, 77, 132, 147, 193, 245, 253]),
            proptest::collection::vec(proptest::num::u8::ANY, 0..80),
            proptest::num::i64::ANY,
        ), 0..60),
    ) {
        use autopilot::dialect::Message;
        let mut client = Autopilot::new(Config::default());
        let mut takeoff = Takeoff::new(10.0);
        let copter = Fake::new().heartbeat();
        let found = packet::encode(AUTOPILOT, 0, &copter);
        client.handle(0, &Parser::new().push(&found)[0]);
        for (id, payload, now) in messages {
            let plain = MavMessage::default_message_from_id(id).unwrap();
            let mut packet = packet::encode(AUTOPILOT, 0, &plain);
            packet.truncate(10);
            packet[1] = payload.len() as u8;
            packet.extend_from_slice(&payload);
            let crc = checksum(&packet[1..], MavMessage::extra_crc(id));
            packet.extend_from_slice(&crc.to_le_bytes());
            for packet in Parser::new().push(&packet) {
                client.handle(now, &packet);
                client.tick(now);
                takeoff.step(now, &mut client);
                let _ = client.set_velocity(now, Vector::zero(), 0.0);
                if let Some(state) = client.state() {
                    assert!(state.attitude.is_none_or(|a| a.rate_in_body.is_finite()));
                    assert!(state.position.is_none_or(|p| p.position.is_finite() && p.velocity.is_finite()));
                }
            }
        }
    }
}

/// The X.25 checksum of a packet with its extra byte.
fn checksum(bytes: &[u8], extra: u8) -> u16 {
    bytes.iter().chain([&extra]).fold(0xFFFF, |crc: u16, byte| {
        let mixed = byte ^ crc as u8;
        let mixed = u16::from(mixed ^ (mixed << 4));
        (crc >> 8) ^ (mixed << 8) ^ (mixed << 3) ^ (mixed >> 4)
    })
}
