//! For the controller's tests: what a camera without errors sees of the pad in the modelled world, and a flight of a modelled PX4 that can be
//! interrupted.

#![allow(dead_code, reason = "each test uses a part of it")]

use std::collections::VecDeque;
use std::sync::Arc;

use autopilot::dialect::{COMMAND_LONG_DATA, CURRENT_MODE_DATA, MavCmd, MavMessage};
use autopilot::packet::encode;
use autopilot::{FlightMode, Packet, Parser, Sender};
use controller::flight::Flight;
use geometry::{Body, Camera, CameraModel, Point, Rotation, Transform};
use messages::{
    CameraInfo, CommandReply, ControllerCommand, ControllerStatus, Detection, Detections,
    FrameHeader, MarkerPose,
};
use node::clock_name;
use world::ardupilot::{Firmware, Mode};
use world::vehicle::VehicleTruth;
use world::world::STEP_S;
use world::{World, WorldConfig};

use super::packets;

pub(crate) const START_NS: i64 = 1_000_000_000;
pub(crate) const IMAGE: (u32, u32) = (1296, 972);
pub(crate) const FOCAL_PX: f64 = 1818.0;
/// Height of the camera over the vehicle's lowest point, in metres.
pub(crate) const MOUNT_M: f64 = 0.12;
pub(crate) const FRAME_STEPS: u64 = 26;
pub(crate) const TICK_STEPS: u64 = 10;
pub(crate) const FRAME_LATENCY_S: f64 = 0.08;

pub(crate) fn stamp_ns(time_s: f64) -> i64 {
    START_NS + (time_s * 1e9).round() as i64
}

pub(crate) fn body_from_camera() -> Transform<Body, Camera> {
    // The image's upper edge looks forward.
    let rotation = Rotation::from_euler(0.0, 0.0, std::f64::consts::FRAC_PI_2);
    Transform::new(rotation, Point::new(0.0, 0.0, -MOUNT_M))
}

/// The detections of the pad by a detector without errors.
pub(crate) fn detections(world: &World, time_s: f64, sequence: u64) -> Detections {
    let VehicleTruth { position, ned_from_body, .. } = world.truth();
    let ned_from_camera = Transform::new(ned_from_body, position) * body_from_camera();
    let seen = ned_from_camera.inverse() * world.pad_at(time_s).ned_from_marker();
    let model = CameraModel::pinhole(IMAGE.0, IMAGE.1, FOCAL_PX);
    let centre = model.project(seen.origin()).filter(|centre| {
        let inside = |at: f64, size: u32| (20.0..f64::from(size) - 20.0).contains(&at);
        inside(centre.x, IMAGE.0) && inside(centre.y, IMAGE.1)
    });
    let found = centre.map(|centre| Detection {
        family: "rings".to_owned(),
        id: None,
        centre_px: [centre.x, centre.y],
        size_px: 0.15 * FOCAL_PX / seen.origin().z(),
        pose: Some(MarkerPose {
            camera_from_marker: (&seen).into(),
            alternative: None,
            ..Detection::sample().pose.unwrap()
        }),
        ..Detection::sample()
    });
    let header = FrameHeader {
        camera: CameraInfo::sample().camera,
        sequence,
        stamp_ns: stamp_ns(time_s),
        clock: clock_name().to_owned(),
        width: IMAGE.0,
        height: IMAGE.1,
        ..FrameHeader::sample()
    };
    let detections = found.into_iter().collect();
    Detections { detector: "main".to_owned(), header, detections, stages: Vec::new() }
}

/// A flight that begins now.
fn started(now_ns: i64, start: &str, set: &[&str]) -> Flight {
    let mut flight = Flight::new(packets::config(start, set), Arc::default()).unwrap();
    let model = CameraModel::pinhole(IMAGE.0, IMAGE.1, FOCAL_PX);
    let camera = CameraInfo::sample().camera;
    flight.presence(now_ns, "main", true);
    flight.camera(now_ns, CameraInfo::new(&camera, &model, &body_from_camera()));
    flight
}

/// A flight with a modelled PX4, in lock-step.
pub(crate) struct Site {
    pub(crate) world: World,
    pub(crate) flight: Flight,
    steps: u64,
    parsers: [Parser; 2],
    frames: VecDeque<(f64, Detections)>,
    /// Packets in the socket of a controller that does not run.
    unread: Vec<Packet>,
    /// What the PX4 has reported of its mode last.
    pub(crate) reported: Option<CURRENT_MODE_DATA>,
    /// The modes that the controller has requested, by PX4's main mode.
    pub(crate) requested: Vec<f32>,
    /// The controller does not run.
    pub(crate) is_frozen: bool,
    /// Nothing that the controller sends arrives.
    pub(crate) uplink_is_lost: bool,
    /// The battery's charge in per cent, instead of the modelled one.
    pub(crate) charge: Option<i8>,
}

impl Site {
    /// A PX4 that stands on the ground, and a flight that begins as `start` states.
    pub(crate) fn new(start: &str, set: &[&str]) -> Self {
        let mut config = WorldConfig::default();
        config.autopilot.firmware = Firmware::Px4;
        Self {
            world: World::new(&config, 1),
            flight: started(START_NS, start, set),
            steps: 0,
            parsers: [Parser::new(), Parser::new()],
            frames: VecDeque::new(),
            unread: Vec::new(),
            reported: None,
            requested: Vec::new(),
            is_frozen: false,
            uplink_is_lost: false,
            charge: None,
        }
    }

    /// The controller ends, without a word, and another one begins.
    pub(crate) fn restart_controller(&mut self, start: &str) {
        self.flight = started(self.now_ns(), start, &[]);
        self.unread.clear();
    }

    pub(crate) fn now_ns(&self) -> i64 {
        stamp_ns(self.world.now_s())
    }

    pub(crate) fn status(&self) -> ControllerStatus {
        self.flight.status(self.now_ns())
    }

    pub(crate) fn command(&mut self, command: &ControllerCommand) -> CommandReply {
        let reply = self.flight.command(self.now_ns(), command);
        self.send();
        reply
    }

    pub(crate) fn mode(&self) -> Mode {
        self.world.autopilot().mode()
    }

    /// The mode that the PX4's user, or the controller, chose last.
    pub(crate) fn chosen(&self) -> FlightMode {
        FlightMode::Px4(self.reported.as_ref().map_or(0, |mode| mode.intended_custom_mode))
    }

    /// The pilot's switch, by the two numbers of PX4's mode.
    pub(crate) fn pilot(&mut self, main: f32, sub: f32) {
        let command = COMMAND_LONG_DATA {
            command: MavCmd::MAV_CMD_DO_SET_MODE,
            target_system: 1,
            target_component: 1,
            param1: 1.0,
            param2: main,
            param3: sub,
            ..Default::default()
        };
        let ground_station = Sender { system: 255, component: 190 };
        let bytes = encode(ground_station, 0, &MavMessage::COMMAND_LONG(command));
        for packet in Parser::new().push(&bytes) {
            self.world.handle(&packet);
        }
    }

    /// The controller does not run for so long.
    pub(crate) fn freeze(&mut self, seconds: f64) {
        self.is_frozen = true;
        self.run(seconds);
        self.is_frozen = false;
    }

    pub(crate) fn run(&mut self, seconds: f64) {
        self.run_until(seconds, |_| false);
    }

    /// Lets time pass until the condition holds; whether it did so within the time.
    pub(crate) fn run_until(&mut self, max_s: f64, holds: impl Fn(&Self) -> bool) -> bool {
        for _ in 0..(max_s / STEP_S) as u64 {
            self.step();
            if holds(self) {
                return true;
            }
        }
        false
    }

    fn step(&mut self) {
        self.steps += 1;
        self.world.advance_to(self.steps as f64 * STEP_S);
        let (now_s, now_ns) = (self.world.now_s(), self.now_ns());
        for bytes in self.world.outgoing().collect::<Vec<_>>() {
            for packet in self.parsers[0].push(&bytes) {
                if let Some(MavMessage::CURRENT_MODE(mode)) = &packet.message {
                    self.reported = Some(mode.clone());
                }
                self.unread.extend(self.changed(packet));
            }
        }
        if self.steps.is_multiple_of(FRAME_STEPS) {
            let seen = detections(&self.world, now_s, self.steps);
            self.frames.push_back((now_s + FRAME_LATENCY_S, seen));
        }
        if self.is_frozen {
            self.frames.clear();
            return;
        }
        for packet in std::mem::take(&mut self.unread) {
            self.flight.packet(now_ns, &packet);
        }
        while self.frames.front().is_some_and(|(at_s, _)| *at_s <= now_s) {
            if let Some((_, seen)) = self.frames.pop_front() {
                self.flight.detections(now_ns, "main", &seen);
            }
        }
        if self.steps.is_multiple_of(TICK_STEPS) {
            self.flight.tick(now_ns);
            if self.status().started_ns.is_some() {
                self.world.begin();
            }
        }
        self.send();
    }

    fn changed(&self, packet: Packet) -> Option<Packet> {
        match (&packet.message, self.charge) {
            (Some(MavMessage::SYS_STATUS(status)), Some(battery_remaining)) => {
                let mut status = status.clone();
                status.battery_remaining = battery_remaining;
                let bytes = encode(packet.sender, 0, &MavMessage::SYS_STATUS(status));
                Parser::new().push(&bytes).into_iter().next()
            }
            _ => Some(packet),
        }
    }

    fn send(&mut self) {
        while let Some(packet) = self.flight.poll_outgoing() {
            for packet in self.parsers[1].push(&packet) {
                if let Some(MavMessage::COMMAND_LONG(command)) = &packet.message
                    && command.command == MavCmd::MAV_CMD_DO_SET_MODE
                {
                    self.requested.push(command.param2);
                }
                if !self.uplink_is_lost {
                    self.world.handle(&packet);
                }
            }
        }
    }
}
