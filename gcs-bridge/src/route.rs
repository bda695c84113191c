//! Decides which packets pass between the autopilot and the ground station, and which are answered here.
//!
//! The rules are those of <https://mavlink.io/en/guide/routing.html>: a packet for a component goes to that
//! component, every other packet to all, and none back to where it came from.

use autopilot::dialect::{
    COMMAND_ACK_DATA, MavCmd, MavMessage, MavResult, Message, MessageData, SETUP_SIGNING_DATA,
};
use autopilot::{GivenCommand, Packet, Sender};

use crate::params::Ask;
use crate::request::Command;
use crate::vehicle::Vehicle;

/// Why a packet of the vehicle's own that comes from the ground is dropped.
pub(crate) const ECHO: &str = "from ground: an echo of the vehicle";

/// Our components, once the vehicle's system id is known.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Own {
    /// The companion.
    pub(crate) companion: Sender,
    /// The camera, while no other component has its id.
    pub(crate) camera: Option<Sender>,
}

/// The route of a packet.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Route {
    /// To the other side, byte for byte.
    Pass,
    /// Answered here.
    Answer(Box<MavMessage>),
    /// A command to the camera, answered here.
    Camera(Command),
    /// About the companion's parameters, answered already.
    Parameters,
    /// A command that neither companion nor camera supports.
    Unknown(GivenCommand),
    /// A key for signed packets, which must not travel further.
    Key,
    /// Dropped, for this reason.
    Drop(&'static str),
}

/// The route of a packet from the ground station.
pub(crate) fn from_ground(packet: &Packet, own: Option<Own>, vehicle: &Vehicle) -> Route {
    let is_own = own.is_some_and(|own| own.is(packet.sender));
    if is_own || vehicle.is_aboard(packet.sender) {
        // A ground program that repeats everything would otherwise send the vehicle its own packets.
        return Route::Drop(ECHO);
    }
    if is_key(packet) {
        return Route::Key;
    }
    let Some(own) = own else { return Route::Pass };
    if let Some(unknown) = GivenCommand::unknown(packet).filter(|it| own.is(it.target)) {
        return Route::Unknown(unknown);
    }
    if is_for(packet, own.companion) {
        if Ask::of(packet, own.companion).is_some() {
            return Route::Parameters;
        }
        return match answer(packet) {
            Some(message) => Route::Answer(Box::new(message)),
            None => Route::Drop("from ground: for the companion, and not supported"),
        };
    }
    if own.camera.is_some_and(|camera| is_for(packet, camera)) {
        return match packet.message.as_ref().and_then(Command::of) {
            Some(command) => Route::Camera(command),
            None => Route::Drop("from ground: for the camera, and not supported"),
        };
    }
    Route::Pass
}

/// The route of a packet from the autopilot's side.
pub(crate) fn from_autopilot(packet: &Packet, own: Option<Own>) -> Route {
    match own {
        Some(own) if own.is(packet.sender) => {
            Route::Drop("from autopilot: an echo of the companion")
        }
        // The autopilot answers the controller, which uses this companion's ids; a ground station would take
        // such an acknowledgement for that of its own command.
        Some(own) if is_for(packet, own.companion) => {
            Route::Drop("from autopilot: for the companion")
        }
        _ if is_key(packet) => Route::Drop("from autopilot: SETUP_SIGNING"),
        _ => Route::Pass,
    }
}

impl Own {
    fn is(&self, sender: Sender) -> bool {
        sender == self.companion || Some(sender) == self.camera
    }
}

/// Whether a packet has the secret key of signed packets in clear text: it belongs on the link that it came on, and
/// beyond would be read, and recorded.
fn is_key(packet: &Packet) -> bool {
    packet.message_id == SETUP_SIGNING_DATA::ID
}

fn is_for(packet: &Packet, me: Sender) -> bool {
    packet.message.as_ref().is_some_and(|message| {
        message.target_system_id() == Some(me.system)
            && message.target_component_id() == Some(me.component)
    })
}

fn answer(packet: &Packet) -> Option<MavMessage> {
    let to = packet.sender;
    match packet.message.as_ref()? {
        MavMessage::COMMAND_LONG(command) => Some(unsupported(command.command, to)),
        MavMessage::COMMAND_INT(command) => Some(unsupported(command.command, to)),
        _ => None,
    }
}

fn unsupported(command: MavCmd, to: Sender) -> MavMessage {
    acknowledgement(command, MavResult::MAV_RESULT_UNSUPPORTED, to)
}

/// The acknowledgement of a command.
pub(crate) fn acknowledgement(command: MavCmd, result: MavResult, to: Sender) -> MavMessage {
    MavMessage::COMMAND_ACK(COMMAND_ACK_DATA {
        command,
        result,
        target_system: to.system,
        target_component: to.component,
        ..COMMAND_ACK_DATA::default()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use autopilot::Parser;
    use autopilot::dialect::{
        COMMAND_LONG_DATA, HEARTBEAT_DATA, LANDING_TARGET_DATA, MavAutopilot,
        PARAM_REQUEST_LIST_DATA,
    };
    use autopilot::packet::encode;

    const ME: Sender = Sender { system: 7, component: 191 };
    const CAMERA: Sender = Sender { system: 7, component: 100 };
    const OWN: Own = Own { companion: ME, camera: Some(CAMERA) };
    const AUTOPILOT: Sender = Sender { system: 7, component: 1 };
    const GROUND: Sender = Sender { system: 255, component: 190 };

    fn packet(sender: Sender, message: &MavMessage) -> Packet {
        Parser::new().push(&encode(sender, 0, message)).remove(0)
    }

    fn heartbeat() -> MavMessage {
        let autopilot = MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA;
        MavMessage::HEARTBEAT(HEARTBEAT_DATA { autopilot, ..HEARTBEAT_DATA::default() })
    }

    fn command(target: Sender) -> MavMessage {
        MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
            command: MavCmd::MAV_CMD_REQUEST_MESSAGE,
            target_system: target.system,
            target_component: target.component,
            ..COMMAND_LONG_DATA::default()
        })
    }

    fn vehicle() -> Vehicle {
        let mut vehicle = Vehicle::new(0, 0);
        vehicle.received(0, &packet(AUTOPILOT, &heartbeat()));
        vehicle
    }

    fn up(sender: Sender, message: &MavMessage) -> Route {
        from_ground(&packet(sender, message), Some(OWN), &vehicle())
    }

    #[test]
    fn the_grounds_own_packets_go_up() {
        assert_eq!(up(GROUND, &heartbeat()), Route::Pass);
        assert_eq!(up(GROUND, &command(AUTOPILOT)), Route::Pass);
        // To all components of the vehicle: the autopilot answers.
        assert_eq!(up(GROUND, &command(Sender { system: 7, component: 0 })), Route::Pass);
    }

    #[test]
    fn nothing_of_the_vehicle_goes_up_again() {
        let target = MavMessage::LANDING_TARGET(LANDING_TARGET_DATA::default());
        for message in [heartbeat(), target] {
            assert!(matches!(up(ME, &message), Route::Drop(_)));
            assert!(matches!(up(CAMERA, &message), Route::Drop(_)));
            assert!(matches!(up(AUTOPILOT, &message), Route::Drop(_)));
        }
    }

    #[test]
    fn commands_for_the_companion_are_answered_here() {
        let Route::Answer(answer) = up(GROUND, &command(ME)) else { panic!("no answer") };
        let MavMessage::COMMAND_ACK(ack) = *answer else { panic!("{answer:?}") };
        assert_eq!(ack.command, MavCmd::MAV_CMD_REQUEST_MESSAGE);
        assert_eq!(ack.result, MavResult::MAV_RESULT_UNSUPPORTED);
        assert_eq!((ack.target_system, ack.target_component), (255, 190));

        let (target_system, target_component) = (ME.system, ME.component);
        let list = PARAM_REQUEST_LIST_DATA { target_system, target_component };
        assert_eq!(up(GROUND, &MavMessage::PARAM_REQUEST_LIST(list.clone())), Route::Parameters);
        // A list that is asked of all is asked of the autopilot as well.
        let list = PARAM_REQUEST_LIST_DATA { target_component: 0, ..list };
        assert_eq!(up(GROUND, &MavMessage::PARAM_REQUEST_LIST(list)), Route::Pass);
    }

    #[test]
    fn commands_to_the_camera_are_its_own() {
        let asked = command(CAMERA);
        assert_eq!(Command::of(&asked).map(Route::Camera), Some(up(GROUND, &asked)));
        let (target_system, target_component) = (CAMERA.system, CAMERA.component);
        let list = PARAM_REQUEST_LIST_DATA { target_system, target_component };
        assert!(matches!(up(GROUND, &MavMessage::PARAM_REQUEST_LIST(list)), Route::Drop(_)));
        // Another camera has that id: its packets go to it.
        let own = Own { camera: None, ..OWN };
        assert_eq!(from_ground(&packet(GROUND, &asked), Some(own), &vehicle()), Route::Pass);
    }

    #[test]
    fn a_key_for_signed_packets_goes_no_further() {
        for (target_system, target_component) in [(7, 1), (7, 191), (7, 0), (0, 0)] {
            let key = SETUP_SIGNING_DATA {
                target_system,
                target_component,
                secret_key: [7; 32],
                ..SETUP_SIGNING_DATA::default()
            };
            let key = MavMessage::SETUP_SIGNING(key);
            for own in [Some(OWN), None] {
                assert_eq!(from_ground(&packet(GROUND, &key), own, &vehicle()), Route::Key);
                let down = from_autopilot(&packet(AUTOPILOT, &key), own);
                assert!(matches!(down, Route::Drop(_)), "{down:?}");
            }
        }
    }

    #[test]
    fn the_ground_receives_the_vehicles_packets_but_not_its_answers_to_the_companion() {
        let down =
            |sender, message: &MavMessage| from_autopilot(&packet(sender, message), Some(OWN));
        assert_eq!(down(AUTOPILOT, &heartbeat()), Route::Pass);
        assert_eq!(down(GROUND, &heartbeat()), Route::Pass);
        let to = |to| unsupported(MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL, to);
        assert_eq!(down(AUTOPILOT, &to(GROUND)), Route::Pass);
        assert!(matches!(down(AUTOPILOT, &to(ME)), Route::Drop(_)));
        assert!(matches!(down(ME, &heartbeat()), Route::Drop(_)));
    }

    #[test]
    fn everything_passes_while_the_bridge_has_no_number() {
        let vehicle = Vehicle::new(0, i64::MAX);
        assert_eq!(from_ground(&packet(GROUND, &command(ME)), None, &vehicle), Route::Pass);
        assert_eq!(from_autopilot(&packet(ME, &heartbeat()), None), Route::Pass);
    }
}
