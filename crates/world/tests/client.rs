//! Tests the client of the crate `autopilot` with the simulated autopilot, packet by packet: finds it, takes
//! off, flies by setpoints and lands; clocks, and PX4's commands and events.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a test prints its measurements, and where it fails"
)]

use autopilot::dialect::{COMMAND_LONG_DATA, MavCmd, MavMessage, TIMESYNC_DATA};
use autopilot::{
    Autopilot, Command, CommandStatus, Config, Event, FlightMode, Parser, Sender, Takeoff,
    TakeoffError, TakeoffProgress,
};
use geometry::Vector;
use world::ardupilot::Firmware;
use world::wind::WindConfig;
use world::world::{STEP_S, World, WorldConfig};

const TICK_S: f64 = 0.02;

struct Pair {
    world: World,
    client: Autopilot,
    from_world: Parser,
    from_client: Parser,
    events: Vec<Event>,
}

impl Pair {
    fn new(config: &WorldConfig, seed: u64) -> Self {
        Self {
            world: World::new(config, seed),
            client: Autopilot::new(Config::default()),
            from_world: Parser::new(),
            from_client: Parser::new(),
            events: Vec::new(),
        }
    }

    fn now_ns(&self) -> i64 {
        (self.world.now_s() * 1e9) as i64
    }

    fn tick(&mut self) {
        let next_s = self.world.now_s() + TICK_S;
        self.world.advance_to(next_s);
        let now_ns = self.now_ns();
        let bytes: Vec<u8> = self.world.outgoing().flatten().collect();
        for frame in self.from_world.push(&bytes) {
            self.client.handle(now_ns, &frame);
        }
        self.client.tick(now_ns);
        while let Some(packet) = self.client.poll_outgoing() {
            for frame in self.from_client.push(&packet) {
                self.world.handle(&frame);
            }
        }
        while let Some(event) = self.client.poll_event() {
            self.events.push(event);
        }
    }

    fn take_off(&mut self, height_m: f64) {
        let mut takeoff = Takeoff::new(height_m);
        for _ in 0..6000 {
            self.tick();
            let now_ns = self.now_ns();
            match takeoff.step(now_ns, &mut self.client) {
                TakeoffProgress::Done => return,
                TakeoffProgress::Failed(error) => unreachable!("{error}"),
                _ => {}
            }
        }
        unreachable!("no takeoff: {:?}", self.events);
    }

    fn fly(&mut self, seconds: f64, velocity: [f64; 3]) {
        for _ in 0..(seconds / TICK_S) as usize {
            let [north, east, down] = velocity;
            let now_ns = self.now_ns();
            self.client.set_velocity(now_ns, Vector::new(north, east, down), 0.0).unwrap();
            self.tick();
        }
    }
}

#[test]
fn the_client_takes_off_flies_and_lands() {
    let wind = WindConfig { mean_m_s: 5.0, turbulence: 1.0, ..WindConfig::default() };
    let mut config = WorldConfig { wind, ..WorldConfig::default() };
    config.autopilot.forward_ground_station = true;
    let mut pair = Pair::new(&config, 4);
    pair.take_off(10.0);
    println!("flying after {:.1} s", pair.world.now_s());
    pair.fly(5.0, [0.5, -0.5, 0.2]);
    let truth = pair.world.truth();
    assert!((truth.velocity - Vector::new(0.5, -0.5, 0.2)).norm() < 0.2, "{truth:?}");
    let state = pair.client.state().unwrap();
    let position = state.position.unwrap();
    assert!((position.position - truth.position).horizontal_norm() < 0.1);
    let now_ns = pair.now_ns();
    let land = pair.client.request(now_ns, Command::SetMode(FlightMode::Land));
    for _ in 0..3000 {
        pair.tick();
    }
    assert_eq!(pair.client.status(land), CommandStatus::Done);
    let state = pair.client.state().unwrap();
    assert!(!state.armed && !state.landed.is_flying() && pair.world.truth().on_ground);
    assert_eq!(pair.client.refused_numbers(), 0);
    assert!(
        pair.events
            .iter()
            .all(|event| !matches!(event, Event::Lost { .. } | Event::Restarted { .. }))
    );
}

#[test]
fn the_client_waits_for_an_autopilot_that_starts_slowly() {
    let mut config = WorldConfig::default();
    config.autopilot.ready_after_s = 42.0;
    let mut pair = Pair::new(&config, 4);
    pair.take_off(3.0);
    assert!(pair.world.now_s() > 42.0 && pair.world.now_s() < 65.0, "{}", pair.world.now_s());
}

/// The end of a take-off that is only for simulations.
fn take_off_if_simulated(firmware: Firmware, says_simulated: bool) -> (TakeoffProgress, Pair) {
    let mut config = WorldConfig::default();
    config.autopilot.firmware = firmware;
    config.autopilot.says_simulated = says_simulated;
    let mut pair = Pair::new(&config, 4);
    let mut takeoff = Takeoff::new(10.0).of_real_vehicle(false);
    for _ in 0..6000 {
        pair.tick();
        let now_ns = pair.now_ns();
        let progress = takeoff.step(now_ns, &mut pair.client);
        if takeoff.is_finished() {
            return (progress, pair);
        }
    }
    unreachable!("no end: {:?}", pair.events);
}

#[test]
fn a_simulated_vehicle_reports_the_simulation_and_takes_off() {
    for firmware in [Firmware::ArduPilot, Firmware::Px4] {
        let (end, pair) = take_off_if_simulated(firmware, true);
        assert_eq!(end, TakeoffProgress::Done, "{firmware:?}");
        assert!(pair.client.is_simulated());
    }
}

#[test]
fn a_vehicle_that_may_be_real_is_never_armed() {
    for firmware in [Firmware::ArduPilot, Firmware::Px4] {
        let (end, pair) = take_off_if_simulated(firmware, false);
        assert_eq!(end, TakeoffProgress::Failed(TakeoffError::NotSimulated), "{firmware:?}");
        assert!(end.to_string().contains("--real-vehicle"), "{end}");
        let commands = pair.events.iter().filter(|event| matches!(event, Event::Command { .. }));
        assert_eq!(commands.count(), 0, "{firmware:?}");
        assert!(!pair.client.state().is_some_and(|state| state.armed));
        assert!(pair.world.truth().on_ground);
    }
}

#[test]
fn px4_takes_no_command_that_is_addressed_to_all_systems() {
    for (firmware, taken) in [(Firmware::ArduPilot, [true, true]), (Firmware::Px4, [false, true])] {
        let mut config = WorldConfig::default();
        config.autopilot.firmware = firmware;
        let answers = [0, 1].map(|target_system| {
            let mut world = World::new(&config, 4);
            let request = MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
                param1: 30.0,
                param2: 10_000.0,
                command: MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL,
                target_system,
                target_component: 1,
                ..COMMAND_LONG_DATA::default()
            });
            let sender = Sender { system: 255, component: 192 };
            for packet in Parser::new().push(&autopilot::packet::encode(sender, 0, &request)) {
                world.handle(&packet);
            }
            let sent: Vec<u8> = world.outgoing().flatten().collect();
            Parser::new().push(&sent).iter().any(|packet| {
                matches!(&packet.message, Some(MavMessage::COMMAND_ACK(ack)) if ack.command == MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL)
            })
        });
        assert_eq!(answers, taken, "{firmware:?}");
    }
}

#[test]
fn a_clock_round_trip_is_answered_with_the_time_of_its_arrival_and_milliseconds_are_whole_ones() {
    let mut world = World::new(&WorldConfig::default(), 4);
    world.advance_to(1.0);
    let _ = world.outgoing().count();
    let sender = Sender { system: 255, component: 192 };
    let request = TIMESYNC_DATA { tc1: 0, ts1: 42, ..TIMESYNC_DATA::default() };
    let request = autopilot::packet::encode(sender, 0, &MavMessage::TIMESYNC(request));
    let arrived_s = world.now_s() + 0.6 * STEP_S;
    for packet in Parser::new().push(&request) {
        world.handle_at(arrived_s, &packet);
    }
    let sent: Vec<u8> = world.outgoing().flatten().collect();
    let answers: Vec<(i64, i64)> = Parser::new()
        .push(&sent)
        .iter()
        .filter_map(|packet| match &packet.message {
            Some(MavMessage::TIMESYNC(answer)) => Some((answer.tc1, answer.ts1)),
            _ => None,
        })
        .collect();
    assert_eq!(answers, [((arrived_s * 1e9) as i64, 42)]);

    // As a real one counts them, which is half of one late on average.
    let mut pair = Pair::new(&WorldConfig::default(), 4);
    let mut parser = Parser::new();
    let mut counted = 0;
    while pair.world.now_s() < 10.0 {
        let before_s = pair.world.now_s();
        pair.tick();
        pair.world.advance_to(pair.world.now_s() + STEP_S);
        let now_s = pair.world.now_s();
        let sent: Vec<u8> = pair.world.outgoing().flatten().collect();
        for packet in parser.push(&sent) {
            if let Some(MavMessage::ATTITUDE(attitude)) = packet.message {
                let boot_s = f64::from(attitude.time_boot_ms) * 1e-3;
                assert!((before_s - 0.001..=now_s + 1e-5).contains(&boot_s), "{boot_s} at {now_s}");
                counted += 1;
            }
        }
    }
    assert!(counted > 10, "{counted}");
}

#[test]
fn a_px4_whose_events_came_too_early_reports_again_why_it_does_not_arm() {
    let mut config = WorldConfig::default();
    config.autopilot.firmware = Firmware::Px4;
    config.autopilot.ready_after_s = 20.0;
    let mut world = World::new(&config, 4);
    // The client receives nothing until the autopilot waits for its position.
    world.advance_to(12.0);
    assert!(world.outgoing().count() > 0);
    let mut pair = Pair { world, ..Pair::new(&config, 4) };
    let run_to = |pair: &mut Pair, end_s: f64| {
        while pair.world.now_s() < end_s {
            pair.tick();
        }
    };
    run_to(&mut pair, 16.0);
    let why = pair.client.not_ready_because();
    let is_reported =
        |text: &String| text == "prearm: Navigation error: No valid position estimate";
    assert!(why.iter().any(is_reported), "{why:?}");
    run_to(&mut pair, 25.0);
    assert_eq!(pair.client.not_ready_because(), [""; 0]);
}
