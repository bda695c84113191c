//! Decides which packets of a ground station may go to the autopilot: all, all but those that start or stop motors, or only
//! those that change nothing.

use std::fmt;
use std::str::FromStr;

use crate::dialect::{MavCmd, MavMessage, MavModeFlag, MessageData, SETUP_SIGNING_DATA};
use crate::packet::Packet;

/// The packets that a ground station may send to the autopilot.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq)]
pub enum Permission {
    /// Everything but the key of signed packets, which no permission lets pass.
    #[default]
    Everything,
    /// Everything but packets that start or stop motors: arming, disarming, the safety switch, ending the flight, restarting.
    NoArming,
    /// Only packets that change nothing: heartbeats, the time, questions for parameters, missions and messages.
    Monitor,
}

/// A permission with an unknown name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("unknown permission `{0}`: expected everything, no-arming or monitor")]
pub struct UnknownPermission(String);

impl Permission {
    const ALL: [Self; 3] = [Self::Everything, Self::NoArming, Self::Monitor];

    /// Its name in a configuration.
    pub fn name(self) -> &'static str {
        match self {
            Self::Everything => "everything",
            Self::NoArming => "no-arming",
            Self::Monitor => "monitor",
        }
    }

    /// Why a packet may not be sent, as a short name for counters; `None` when it may.
    ///
    /// Packets that the dialect does not contain may only be sent with [`Permission::Everything`]: they could be anything. SETUP_SIGNING is
    /// never sent: it has the key in clear text, and an autopilot that took it would refuse all later packets from here.
    pub fn refusal(self, packet: &Packet) -> Option<&'static str> {
        if packet.message_id == SETUP_SIGNING_DATA::ID {
            return Some("SETUP_SIGNING");
        }
        if self == Self::Everything {
            return None;
        }
        let Some(message) = &packet.message else {
            return Some("unknown message");
        };
        match self {
            Self::Everything => None,
            Self::NoArming => {
                starts_or_stops_motors(message).then_some("arming or stopping motors")
            }
            Self::Monitor => (!changes_nothing(message)).then_some("only monitoring"),
        }
    }
}

impl fmt::Display for Permission {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Permission {
    type Err = UnknownPermission;

    fn from_str(text: &str) -> Result<Self, UnknownPermission> {
        let found = Self::ALL.into_iter().find(|permission| permission.name() == text);
        found.ok_or_else(|| UnknownPermission(text.to_owned()))
    }
}

/// The command in a message.
fn command(message: &MavMessage) -> Option<MavCmd> {
    match message {
        MavMessage::COMMAND_LONG(command) => Some(command.command),
        MavMessage::COMMAND_INT(command) => Some(command.command),
        _ => None,
    }
}

/// A command to be carried out now, or by a mission.
struct Order {
    command: MavCmd,
    first_parameter: f32,
    /// The fifth, sixth and seventh parameters; a mission's position is none.
    last_parameters: [f32; 3],
}

impl Order {
    #[allow(deprecated, reason = "ground stations still send superseded messages")]
    fn of(message: &MavMessage) -> Option<Self> {
        let (command, first_parameter, last_parameters) = match message {
            MavMessage::COMMAND_LONG(it) => {
                (it.command, it.param1, [it.param5, it.param6, it.param7])
            }
            MavMessage::COMMAND_INT(it) => {
                (it.command, it.param1, [it.x as f32, it.y as f32, it.z])
            }
            MavMessage::MISSION_ITEM(it) => (it.command, it.param1, [0.0; 3]),
            MavMessage::MISSION_ITEM_INT(it) => (it.command, it.param1, [0.0; 3]),
            _ => return None,
        };
        Some(Self { command, first_parameter, last_parameters })
    }

    /// Some do so by a parameter: a calibration of the compass against the motors or of the speed controllers turns motors,
    /// one of the compass may restart the autopilot at its end, and a mode that is none of the firmware's own is the position of
    /// ArduPilot's safety switch, which stops the motors in the air. A trap halts the autopilot, a new boot loader holds it up.
    fn starts_or_stops_motors(&self) -> bool {
        let [fifth, sixth, seventh] = self.last_parameters;
        match self.command {
            MavCmd::MAV_CMD_DO_SET_MODE => !is_custom_mode(self.first_parameter),
            MavCmd::MAV_CMD_PREFLIGHT_CALIBRATION => sixth != 0.0 || seventh != 0.0,
            MavCmd::MAV_CMD_DO_START_MAG_CAL => fifth != 0.0,
            MavCmd::MAV_CMD_COMPONENT_ARM_DISARM
            | MavCmd::MAV_CMD_DO_FLIGHTTERMINATION
            | MavCmd::MAV_CMD_DO_MOTOR_TEST
            | MavCmd::MAV_CMD_DO_PARACHUTE
            | MavCmd::MAV_CMD_DO_SET_ACTUATOR
            | MavCmd::MAV_CMD_DO_SET_SERVO
            | MavCmd::MAV_CMD_DO_REPEAT_SERVO
            | MavCmd::MAV_CMD_DO_SET_RELAY
            | MavCmd::MAV_CMD_DO_REPEAT_RELAY
            | MavCmd::MAV_CMD_DO_AUX_FUNCTION
            | MavCmd::MAV_CMD_DO_ENGINE_CONTROL
            | MavCmd::MAV_CMD_MISSION_START
            | MavCmd::MAV_CMD_SOLO_BTN_FLY_CLICK
            | MavCmd::MAV_CMD_SOLO_BTN_FLY_HOLD
            | MavCmd::MAV_CMD_SOLO_BTN_PAUSE_CLICK
            | MavCmd::MAV_CMD_ACTUATOR_TEST
            | MavCmd::MAV_CMD_CONFIGURE_ACTUATOR
            | MavCmd::MAV_CMD_DO_SET_SAFETY_SWITCH_STATE
            | MavCmd::MAV_CMD_DEBUG_TRAP
            | MavCmd::MAV_CMD_FLASH_BOOTLOADER
            | MavCmd::MAV_CMD_SCRIPTING
            | MavCmd::MAV_CMD_INJECT_FAILURE
            | MavCmd::MAV_CMD_CAN_FORWARD
            | MavCmd::MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN => true,
            _ => false,
        }
    }
}

/// Whether the flags of a mode mark it as one of the firmware's own. Ground stations set that bit, alone or with others.
fn is_custom_mode(flags: f32) -> bool {
    let is_byte = (0.0..=255.0).contains(&flags);
    is_byte && flags as u8 & MavModeFlag::MAV_MODE_FLAG_CUSTOM_MODE_ENABLED.bits() != 0
}

/// SET_MODE counts as well: its flags can arm older autopilots. So do a script or a file that the autopilot would run, MAVLink
/// packets for another of its links, data for its buses that bypass its checks, and the effects of a pilot's sticks, switches and
/// buttons: sticks arm, and a switch may stop the motors in the air (ArduPilot's auxiliary functions, `ARMING_RUDDER`). A
/// mission's items count like commands, as AUTO carries them out in the air.
#[allow(deprecated, reason = "ground stations still send superseded messages")]
fn starts_or_stops_motors(message: &MavMessage) -> bool {
    Order::of(message).is_some_and(|order| order.starts_or_stops_motors())
        || matches!(
            message,
            MavMessage::SET_MODE(_)
                | MavMessage::SET_ACTUATOR_CONTROL_TARGET(_)
                | MavMessage::RC_CHANNELS_OVERRIDE(_)
                | MavMessage::MANUAL_CONTROL(_)
                | MavMessage::SERIAL_CONTROL(_)
                | MavMessage::FILE_TRANSFER_PROTOCOL(_)
                | MavMessage::TUNNEL(_)
                | MavMessage::DEVICE_OP_WRITE(_)
                | MavMessage::CAN_FRAME(_)
                | MavMessage::CANFD_FRAME(_)
        )
}

/// Requests for streams are not among them: they would change the rates that the controller has requested.
#[allow(deprecated, reason = "ground stations still send superseded messages")]
fn changes_nothing(message: &MavMessage) -> bool {
    match command(message) {
        Some(command) => matches!(
            command,
            MavCmd::MAV_CMD_REQUEST_MESSAGE
                | MavCmd::MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES
                | MavCmd::MAV_CMD_REQUEST_PROTOCOL_VERSION
                | MavCmd::MAV_CMD_GET_HOME_POSITION
                | MavCmd::MAV_CMD_GET_MESSAGE_INTERVAL
        ),
        None => matches!(
            message,
            MavMessage::HEARTBEAT(_)
                | MavMessage::SYSTEM_TIME(_)
                | MavMessage::PING(_)
                | MavMessage::TIMESYNC(_)
                | MavMessage::PARAM_REQUEST_READ(_)
                | MavMessage::PARAM_REQUEST_LIST(_)
                | MavMessage::MISSION_REQUEST_LIST(_)
                | MavMessage::MISSION_REQUEST_INT(_)
                | MavMessage::MISSION_REQUEST(_)
                | MavMessage::MISSION_ACK(_)
        ),
    }
}

#[cfg(test)]
#[allow(deprecated, reason = "ground stations still send superseded messages")]
mod tests {
    use super::*;
    use crate::dialect::{
        CAN_FRAME_DATA, COMMAND_INT_DATA, COMMAND_LONG_DATA, HEARTBEAT_DATA, MANUAL_CONTROL_DATA,
        MISSION_ITEM_INT_DATA, PARAM_REQUEST_LIST_DATA, PARAM_SET_DATA, RC_CHANNELS_OVERRIDE_DATA,
        REQUEST_DATA_STREAM_DATA, SET_MODE_DATA, SETUP_SIGNING_DATA,
    };
    use crate::packet::{Parser, Sender, encode};

    fn packet(message: &MavMessage) -> Packet {
        Parser::new().push(&encode(Sender { system: 255, component: 190 }, 0, message)).remove(0)
    }

    fn long(command: MavCmd) -> MavMessage {
        MavMessage::COMMAND_LONG(COMMAND_LONG_DATA { command, ..Default::default() })
    }

    fn int(command: MavCmd) -> MavMessage {
        MavMessage::COMMAND_INT(COMMAND_INT_DATA { command, ..Default::default() })
    }

    /// A calibration, with the compass against the motors or without.
    fn calibration(param6: f32) -> MavMessage {
        let command = MavCmd::MAV_CMD_PREFLIGHT_CALIBRATION;
        MavMessage::COMMAND_LONG(COMMAND_LONG_DATA { command, param6, ..Default::default() })
    }

    /// A mode with these flags, and ArduPilot's number of its position of the safety switch that stops the motors.
    fn mode(flags: f32) -> [MavMessage; 2] {
        let command = MavCmd::MAV_CMD_DO_SET_MODE;
        let (param1, param2) = (flags, 1.0);
        let long = COMMAND_LONG_DATA { command, param1, param2, ..Default::default() };
        let int = COMMAND_INT_DATA { command, param1, param2, ..Default::default() };
        [MavMessage::COMMAND_LONG(long), MavMessage::COMMAND_INT(int)]
    }

    /// Positions of missions are not parameters.
    fn item(command: MavCmd) -> MavMessage {
        let position =
            MISSION_ITEM_INT_DATA { x: 470_000_000, y: 80_000_000, ..Default::default() };
        MavMessage::MISSION_ITEM_INT(MISSION_ITEM_INT_DATA { command, ..position })
    }

    #[test]
    fn each_permission_refuses_the_packets_outside_its_name() {
        let arming = MavCmd::MAV_CMD_COMPONENT_ARM_DISARM;
        for (message, no_arming, monitor) in [
            (MavMessage::HEARTBEAT(HEARTBEAT_DATA::default()), true, true),
            (MavMessage::PARAM_REQUEST_LIST(PARAM_REQUEST_LIST_DATA::default()), true, true),
            (long(MavCmd::MAV_CMD_REQUEST_MESSAGE), true, true),
            (long(MavCmd::MAV_CMD_NAV_LAND), true, false),
            (long(MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL), true, false),
            (MavMessage::PARAM_SET(PARAM_SET_DATA::default()), true, false),
            (MavMessage::REQUEST_DATA_STREAM(REQUEST_DATA_STREAM_DATA::default()), true, false),
            (MavMessage::RC_CHANNELS_OVERRIDE(RC_CHANNELS_OVERRIDE_DATA::default()), false, false),
            (MavMessage::MANUAL_CONTROL(MANUAL_CONTROL_DATA::default()), false, false),
            (long(MavCmd::MAV_CMD_DO_AUX_FUNCTION), false, false),
            (int(MavCmd::MAV_CMD_MISSION_START), false, false),
            (long(MavCmd::MAV_CMD_SOLO_BTN_FLY_HOLD), false, false),
            (long(arming), false, false),
            (int(arming), false, false),
            (long(MavCmd::MAV_CMD_DO_FLIGHTTERMINATION), false, false),
            (int(MavCmd::MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN), false, false),
            (MavMessage::SET_MODE(SET_MODE_DATA::default()), false, false),
            (MavMessage::CAN_FRAME(CAN_FRAME_DATA::default()), false, false),
            (calibration(0.0), true, false),
            (calibration(1.0), false, false),
            (item(MavCmd::MAV_CMD_NAV_WAYPOINT), true, false),
            (item(MavCmd::MAV_CMD_DO_AUX_FUNCTION), false, false),
        ] {
            let packet = packet(&message);
            assert_eq!(Permission::Everything.refusal(&packet), None);
            assert_eq!(Permission::NoArming.refusal(&packet).is_none(), no_arming, "{message:?}");
            assert_eq!(Permission::Monitor.refusal(&packet).is_none(), monitor, "{message:?}");
        }
    }

    #[test]
    fn without_arming_a_mode_passes_only_as_one_of_the_firmwares_own() {
        let passes =
            |message: &MavMessage| Permission::NoArming.refusal(&packet(message)).is_none();
        // As QGroundControl, MAVSDK and pymavlink set it: the bit alone, or with those that the vehicle shows.
        for flags in [1.0, 1.0 + 128.0, 1.0 + 16.0 + 64.0] {
            assert!(mode(flags).iter().all(passes), "{flags}");
        }
        // The last ones are this, or zero, in a byte of C++.
        for flags in [128.0, 0.0, 4.0, 254.0, 384.0, 385.0, -128.0, -127.0, f32::NAN, f32::INFINITY]
        {
            assert!(!mode(flags).iter().any(passes), "{flags}");
        }
        let item = MISSION_ITEM_INT_DATA {
            command: MavCmd::MAV_CMD_DO_SET_MODE,
            param1: 128.0,
            ..Default::default()
        };
        assert!(!passes(&MavMessage::MISSION_ITEM_INT(item)));
    }

    #[test]
    fn without_arming_no_packet_passes_that_halts_the_autopilot_or_its_motors() {
        for command in [
            MavCmd::MAV_CMD_DO_SET_SAFETY_SWITCH_STATE,
            MavCmd::MAV_CMD_DEBUG_TRAP,
            MavCmd::MAV_CMD_FLASH_BOOTLOADER,
            MavCmd::MAV_CMD_SCRIPTING,
            MavCmd::MAV_CMD_CONFIGURE_ACTUATOR,
        ] {
            for message in [long(command), int(command)] {
                let packet = packet(&message);
                assert_eq!(Permission::Everything.refusal(&packet), None);
                assert!(Permission::NoArming.refusal(&packet).is_some(), "{message:?}");
            }
        }
    }

    #[test]
    fn the_key_of_signed_packets_never_passes() {
        let key = packet(&MavMessage::SETUP_SIGNING(SETUP_SIGNING_DATA::default()));
        for (permission, packet) in Permission::ALL.into_iter().zip([
            key.clone(),
            key.clone(),
            Packet { message: None, ..key },
        ]) {
            assert_eq!(permission.refusal(&packet), Some("SETUP_SIGNING"), "{permission}");
        }
    }

    #[test]
    fn unknown_packets_pass_only_with_everything() {
        let packet = Packet { message: None, ..packet(&long(MavCmd::MAV_CMD_NAV_LAND)) };
        assert_eq!(Permission::Everything.refusal(&packet), None);
        assert!(Permission::NoArming.refusal(&packet).is_some());
        assert!(Permission::Monitor.refusal(&packet).is_some());
    }

    #[test]
    fn names_are_read_as_they_are_written() {
        for permission in Permission::ALL {
            assert_eq!(permission.to_string().parse(), Ok(permission));
        }
        assert!("all".parse::<Permission>().unwrap_err().to_string().contains("no-arming"));
    }
}
