//! For the tests of `world`: a simulated autopilot and the other end of its link, at which commands are sent,
//! time is let pass and the received messages are read.

#![allow(dead_code, reason = "each test file uses its part of the bench")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test prints where it fails")]
#![allow(deprecated, reason = "messages of real programs are tested, superseded or not")]

use autopilot::dialect::{
    COMMAND_LONG_DATA, MavCmd, MavFrame, MavMessage, PositionTargetTypemask,
    SET_POSITION_TARGET_LOCAL_NED_DATA,
};
use autopilot::packet::encode;
use autopilot::{Packet, Parser, Sender};
use world::ardupilot::{AutopilotConfig, EstimateConfig};
use world::vehicle::VehicleConfig;
use world::wind::WindConfig;
use world::world::{STEP_S, World, WorldConfig};

/// Velocity only; heading held by a yaw rate of 0.
pub(crate) const HOLD_HEADING: u16 = 0x5C7;
/// Velocity only; yaw and yaw rate ignored.
pub(crate) const FREE_HEADING: u16 = 0xDC7;
/// Velocity and yaw.
pub(crate) const WITH_YAW: u16 = 0x9C7;

pub(crate) const COMPANION: Sender = Sender { system: 1, component: 191 };
pub(crate) const GROUND: Sender = Sender { system: 255, component: 190 };

pub(crate) struct Bench {
    pub(crate) world: World,
    pub(crate) log: Vec<(f64, Packet)>,
    pub(crate) raw: Vec<u8>,
    parser: Parser,
    sender: Sender,
    sequence: u8,
}

/// A calm world whose estimator errs as it does in height and speed, but without chance.
pub(crate) fn steady() -> WorldConfig {
    WorldConfig {
        vehicle: VehicleConfig { unsteadiness_rad: 0.0, ..VehicleConfig::default() },
        autopilot: AutopilotConfig {
            estimate: EstimateConfig {
                height_scale: EstimateConfig::default().height_scale,
                height_lag_s: EstimateConfig::default().height_lag_s,
                climb_scale: EstimateConfig::default().climb_scale,
                ..EstimateConfig::perfect()
            },
            ..AutopilotConfig::default()
        },
        ..WorldConfig::default()
    }
}

pub(crate) fn windy(turbulence: f64) -> WorldConfig {
    WorldConfig {
        wind: WindConfig { mean_m_s: 5.0, turbulence, ..WindConfig::default() },
        ..WorldConfig::default()
    }
}

impl Bench {
    pub(crate) fn new(config: &WorldConfig, seed: u64) -> Self {
        Self {
            world: World::new(config, seed),
            log: Vec::new(),
            raw: Vec::new(),
            parser: Parser::new(),
            sender: COMPANION,
            sequence: 0,
        }
    }

    /// In GUIDED at `height_m` (as the autopilot believes), after the climb.
    pub(crate) fn flying(config: &WorldConfig, seed: u64, height_m: f32) -> Self {
        let mut bench = Self::new(config, seed);
        bench.run(2.5);
        bench.take_off(height_m);
        bench.wait(30.0, "the end of the climb", |bench| bench.landed_state() == Some(2));
        bench.run(3.0);
        bench
    }

    pub(crate) fn take_off(&mut self, height_m: f32) {
        self.request(245, 10.0);
        self.request(32, 20.0);
        assert_eq!(self.mode(4), 0);
        assert_eq!(self.command(400, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), Some(0));
        assert_eq!(self.command(22, [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, height_m]), Some(0));
    }

    pub(crate) fn now_s(&self) -> f64 {
        self.world.now_s()
    }

    /// Lets time pass.
    pub(crate) fn run(&mut self, seconds: f64) {
        let end_s = self.now_s() + seconds;
        while self.now_s() + STEP_S / 2.0 < end_s {
            self.step();
        }
    }

    pub(crate) fn step(&mut self) {
        let next_s = self.now_s() + STEP_S;
        self.world.advance_to(next_s);
        self.read();
    }

    fn read(&mut self) {
        let now_s = self.now_s();
        let bytes: Vec<u8> = self.world.outgoing().flatten().collect();
        let frames = self.parser.push(&bytes);
        self.raw.extend(bytes);
        self.log.extend(frames.into_iter().map(|frame| (now_s, frame)));
    }

    /// Lets time pass until a condition holds, and returns the time.
    pub(crate) fn wait(&mut self, max_s: f64, what: &str, holds: impl Fn(&Self) -> bool) -> f64 {
        let start_s = self.now_s();
        while !holds(self) {
            assert!(self.now_s() - start_s < max_s, "no {what} within {max_s} s");
            self.step();
        }
        self.now_s() - start_s
    }

    pub(crate) fn send(&mut self, message: &MavMessage) {
        let raw = encode(self.sender, self.sequence, message);
        self.sequence = self.sequence.wrapping_add(1);
        let frames = Parser::new().push(&raw);
        self.world.handle(&frames[0]);
        self.read();
    }

    pub(crate) fn send_as(&mut self, sender: Sender, message: &MavMessage) {
        let before = std::mem::replace(&mut self.sender, sender);
        self.send(message);
        self.sender = before;
    }

    /// Sends a command; the result of its acknowledgement, when one comes.
    pub(crate) fn command(&mut self, number: u16, p: [f32; 7]) -> Option<u8> {
        let sent = self.log.len();
        self.send(&MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
            param1: p[0],
            param2: p[1],
            param3: p[2],
            param4: p[3],
            param5: p[4],
            param6: p[5],
            param7: p[6],
            command: command(number),
            target_system: 1,
            target_component: 1,
            confirmation: 0,
        }));
        self.acknowledgement(sent, number)
    }

    /// The result of the first acknowledgement of a command after so many packets.
    pub(crate) fn acknowledgement(&self, since: usize, number: u16) -> Option<u8> {
        self.log[since..].iter().find_map(|(_, frame)| {
            let payload = frame.payload();
            let acknowledged = frame.message_id == 77 && payload[..2] == number.to_le_bytes();
            acknowledged.then(|| payload.get(2).copied().unwrap_or(0))
        })
    }

    /// DO_SET_MODE; the result.
    pub(crate) fn mode(&mut self, number: u8) -> u8 {
        self.command(176, [1.0, f32::from(number), 0.0, 0.0, 0.0, 0.0, 0.0]).unwrap()
    }

    /// SET_MESSAGE_INTERVAL; the result.
    pub(crate) fn request(&mut self, id: u16, rate_hz: f32) -> u8 {
        self.command(511, [f32::from(id), 1e6 / rate_hz, 0.0, 0.0, 0.0, 0.0, 0.0]).unwrap()
    }

    pub(crate) fn velocity(
        &mut self,
        frame: MavFrame,
        mask: u16,
        velocity: [f32; 3],
        yaw: [f32; 2],
    ) {
        self.send(&MavMessage::SET_POSITION_TARGET_LOCAL_NED(SET_POSITION_TARGET_LOCAL_NED_DATA {
            vx: velocity[0],
            vy: velocity[1],
            vz: velocity[2],
            yaw: yaw[0],
            yaw_rate: yaw[1],
            type_mask: PositionTargetTypemask::from_bits_truncate(mask),
            target_system: 1,
            target_component: 1,
            coordinate_frame: frame,
            ..SET_POSITION_TARGET_LOCAL_NED_DATA::default()
        }));
    }

    /// Sends one velocity at 10 Hz for so long.
    pub(crate) fn fly(&mut self, seconds: f64, velocity: [f32; 3]) {
        for _ in 0..(seconds * 10.0).round() as usize {
            self.velocity(MavFrame::MAV_FRAME_LOCAL_NED, HOLD_HEADING, velocity, [0.0; 2]);
            self.run(0.1);
        }
    }

    /// The packets of one kind from the autopilot itself, with their times.
    pub(crate) fn of(&self, id: u32) -> impl DoubleEndedIterator<Item = (f64, &Packet)> {
        let mine = move |frame: &Packet| frame.message_id == id && frame.sender.component == 1;
        self.log
            .iter()
            .filter(move |(_, frame)| mine(frame))
            .map(|(time_s, frame)| (*time_s, frame))
    }

    /// The latest payload of one kind, with the zeros that the wire leaves out.
    pub(crate) fn latest(&self, id: u32) -> Option<Vec<u8>> {
        self.of(id).next_back().map(|(_, frame)| whole(frame))
    }

    pub(crate) fn landed_state(&self) -> Option<u8> {
        self.latest(245).map(|payload| payload[1])
    }

    pub(crate) fn heartbeat(&self) -> (u8, u32, u8) {
        match &self.of(0).next_back().unwrap().1.message {
            Some(MavMessage::HEARTBEAT(h)) => {
                (h.base_mode.bits(), h.custom_mode, h.system_status as u8)
            }
            other => panic!("{other:?}"),
        }
    }

    pub(crate) fn texts(&self) -> Vec<String> {
        self.of(253)
            .map(|(_, frame)| match &frame.message {
                Some(MavMessage::STATUSTEXT(text)) => text.text.to_str().unwrap().to_owned(),
                other => panic!("{other:?}"),
            })
            .collect()
    }
}

/// A packet's payload with the zeros that the wire leaves out.
pub(crate) fn whole(frame: &Packet) -> Vec<u8> {
    let mut payload = frame.payload().to_vec();
    payload.resize(255, 0);
    payload
}

fn command(number: u16) -> MavCmd {
    [
        MavCmd::MAV_CMD_DO_SET_MODE,
        MavCmd::MAV_CMD_COMPONENT_ARM_DISARM,
        MavCmd::MAV_CMD_NAV_TAKEOFF,
        MavCmd::MAV_CMD_NAV_LAND,
        MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL,
        MavCmd::MAV_CMD_REQUEST_MESSAGE,
        MavCmd::MAV_CMD_DO_CHANGE_SPEED,
    ]
    .into_iter()
    .find(|command| *command as u16 == number)
    .unwrap()
}
