//! An autopilot's packets for tests.

#![allow(dead_code, reason = "each test uses a part of it")]

use autopilot::dialect::{
    ATTITUDE_DATA, EXTENDED_SYS_STATE_DATA, HEARTBEAT_DATA, LOCAL_POSITION_NED_DATA, MavAutopilot,
    MavLandedState, MavMessage, MavModeFlag, MavType,
};
use autopilot::{Parser, Sender};
use controller::flight::Flight;

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

/// A heartbeat in a mode of ArduPilot, or of PX4, whose modes are two numbers in the upper half.
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
