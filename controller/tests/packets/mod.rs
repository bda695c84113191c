//! For the controller's tests: MAVLink packets of an autopilot (heartbeat, attitude, position), detections of
//! a marker below, and the packets that a flight sends for them.

#![allow(dead_code, reason = "each test uses a part of it")]

use std::sync::Arc;

use autopilot::dialect::{
    ATTITUDE_DATA, EXTENDED_SYS_STATE_DATA, HEARTBEAT_DATA, LANDING_TARGET_DATA,
    LOCAL_POSITION_NED_DATA, MavAutopilot, MavCmd, MavLandedState, MavMessage, MavModeFlag,
    MavType,
};
use autopilot::{Parser, Sender};
use controller::Config;
use controller::flight::Flight;
use messages::{CameraInfo, Detections, FrameHeader};
use node::{HealthCounters, Layers, clock_name};

pub(crate) const MS: i64 = 1_000_000;

/// The bytes of a packet of the autopilot.
pub(crate) fn bytes(message: &MavMessage) -> Vec<u8> {
    autopilot::packet::encode(Sender { system: 1, component: 1 }, 0, message)
}

/// The flight receives a packet of the autopilot.
pub(crate) fn receive(flight: &mut Flight, now_ns: i64, message: &MavMessage) {
    for packet in Parser::new().push(&bytes(message)) {
        flight.packet(now_ns, &packet);
    }
}

/// The flight receives a packet of another sender on the autopilot's link.
pub(crate) fn receive_from(flight: &mut Flight, now_ns: i64, from: Sender, message: &MavMessage) {
    for packet in Parser::new().push(&autopilot::packet::encode(from, 0, message)) {
        flight.packet(now_ns, &packet);
    }
}

/// A heartbeat in a mode of ArduPilot, or of PX4, with its two numbers in the upper half.
pub(crate) fn heartbeat(mode: u32, armed: bool) -> MavMessage {
    let autopilot = match mode >> 16 {
        0 => MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
        _ => MavAutopilot::MAV_AUTOPILOT_PX4,
    };
    let armed = if armed { MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED } else { MavModeFlag::empty() };
    MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        custom_mode: mode,
        mavtype: MavType::MAV_TYPE_QUADROTOR,
        autopilot,
        base_mode: armed,
        ..Default::default()
    })
}

pub(crate) fn contact(landed_state: MavLandedState) -> MavMessage {
    MavMessage::EXTENDED_SYS_STATE(EXTENDED_SYS_STATE_DATA { landed_state, ..Default::default() })
}

pub(crate) fn attitude(now_ns: i64) -> MavMessage {
    let time_boot_ms = (now_ns / MS) as u32;
    MavMessage::ATTITUDE(ATTITUDE_DATA { time_boot_ms, ..Default::default() })
}

/// A position over the origin.
pub(crate) fn position(now_ns: i64, height_m: f32) -> MavMessage {
    let time_boot_ms = (now_ns / MS) as u32;
    let position = LOCAL_POSITION_NED_DATA { time_boot_ms, z: -height_m, ..Default::default() };
    MavMessage::LOCAL_POSITION_NED(position)
}

pub(crate) fn flight(start: &str) -> Flight {
    flight_with(start, &[])
}

pub(crate) fn flight_with(start: &str, set: &[&str]) -> Flight {
    flight_counting(start, set, &Arc::default())
}

/// A flight that counts into `health`.
pub(crate) fn flight_counting(start: &str, set: &[&str], health: &Arc<HealthCounters>) -> Flight {
    Flight::new(config(start, set), Arc::clone(health)).unwrap()
}

pub(crate) fn config(start: &str, set: &[&str]) -> Config {
    // Pinned, it need not listen for other vehicles.
    let mut all =
        ["takeoff_real_vehicle=true", "autopilot.system_id=1"].map(str::to_owned).to_vec();
    all.push(format!("start={start}"));
    all.extend(set.iter().map(|s| (*s).to_owned()));
    let layers = Layers { file: None, set: all };
    layers.load::<Config>().unwrap().settings
}

/// Attitude and position 5 m over the origin.
pub(crate) fn pose(flight: &mut Flight, now_ns: i64) {
    pose_at(flight, now_ns, 5.0);
}

pub(crate) fn pose_at(flight: &mut Flight, now_ns: i64, height_m: f32) {
    receive(flight, now_ns, &attitude(now_ns));
    receive(flight, now_ns + 1, &position(now_ns, height_m));
}

/// Setpoints, and commands other than for messages, since the last call.
pub(crate) fn sent(flight: &mut Flight) -> (usize, Vec<MavCmd>) {
    let (mut setpoints, mut commands) = (0, Vec::new());
    while let Some(packet) = flight.poll_outgoing() {
        for packet in Parser::new().push(&packet) {
            match packet.message {
                Some(MavMessage::SET_POSITION_TARGET_LOCAL_NED(_)) => setpoints += 1,
                Some(MavMessage::COMMAND_LONG(c))
                    if c.command != MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL =>
                {
                    commands.push(c.command);
                }
                _ => {}
            }
        }
    }
    (setpoints, commands)
}

pub(crate) fn in_flight(start: &str) -> Flight {
    in_flight_with(start, &[])
}

pub(crate) fn in_flight_with(start: &str, set: &[&str]) -> Flight {
    let mut flight = flight_with(start, set);
    receive(&mut flight, 0, &heartbeat(4, true));
    receive(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
    flight
}

pub(crate) fn header(stamp_ns: i64) -> FrameHeader {
    FrameHeader { stamp_ns, clock: clock_name().into(), ..FrameHeader::sample() }
}

/// A frame in which the marker lies 5 m below a camera at the body's origin.
pub(crate) fn seen(stamp_ns: i64) -> Detections {
    Detections { header: header(stamp_ns), ..Detections::sample() }
}

/// Moves the marker of a frame to a place in the camera's frame, in metres, and its centre to where the camera shows it.
pub(crate) fn move_to(seen: &mut Detections, place_m: [f64; 3]) {
    let shown = CameraInfo::sample().pixel_of(place_m);
    for (found, centre_px) in seen.detections.iter_mut().zip(shown) {
        found.centre_px = centre_px;
        if let Some(pose) = &mut found.pose {
            pose.camera_from_marker.translation_m = place_m;
        }
    }
}

/// Hovers in view of the marker in a mode of the autopilot.
pub(crate) fn hover(flight: &mut Flight, from_ms: i64, to_ms: i64, mode: u32) -> Sent {
    let mut sent = Sent::default();
    for ms in (from_ms..to_ms).step_by(20) {
        if ms % 1000 == 0 {
            receive(flight, ms * MS, &heartbeat(mode, true));
        }
        pose(flight, ms * MS);
        if ms % 60 == 0 {
            flight.detections(ms * MS + 2, "main", &seen(ms * MS - 40 * MS));
        }
        flight.tick(ms * MS + 3);
        sent.take(flight);
    }
    sent
}

#[derive(Debug, Default)]
pub(crate) struct Sent {
    pub(crate) setpoints: usize,
    /// The velocity of the last one, in m/s.
    pub(crate) velocity_m_s: [f32; 3],
    pub(crate) targets: Vec<LANDING_TARGET_DATA>,
    pub(crate) modes: Vec<f32>,
    pub(crate) requested: Vec<String>,
}

impl Sent {
    pub(crate) fn take(&mut self, flight: &mut Flight) {
        while let Some(packet) = flight.poll_outgoing() {
            for packet in Parser::new().push(&packet) {
                match packet.message {
                    Some(MavMessage::SET_POSITION_TARGET_LOCAL_NED(setpoint)) => {
                        self.setpoints += 1;
                        self.velocity_m_s = [setpoint.vx, setpoint.vy, setpoint.vz];
                    }
                    Some(MavMessage::LANDING_TARGET(target)) => self.targets.push(target),
                    Some(MavMessage::COMMAND_LONG(c))
                        if c.command == MavCmd::MAV_CMD_DO_SET_MODE =>
                    {
                        self.modes.push(c.param2);
                    }
                    Some(MavMessage::PARAM_REQUEST_READ(r)) => {
                        self.requested.push(r.param_id.to_str().unwrap_or_default().to_owned());
                    }
                    _ => {}
                }
            }
        }
    }
}
