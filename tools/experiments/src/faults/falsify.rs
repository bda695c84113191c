//! Falsifies a simulated autopilot's packets: position, attitude, mode, contact with the ground, or time
//! is changed or withheld while a fault of that kind is active.

use autopilot::Packet;
use autopilot::dialect::{LOCAL_POSITION_NED_DATA, MavLandedState, MavMessage, MavModeFlag};
use autopilot::packet::encode;

use super::kind::Kind;

/// The number of the mode that is falsely reported: LOITER, in which a pilot flies.
const LOITER: u32 = 5;
/// How old the one old boot time is, in milliseconds.
const OLD_MS: u32 = 60_000;

/// The state of an autopilot with false values.
#[derive(Clone, Debug, Default)]
pub struct Falsifier {
    frozen: Option<LOCAL_POSITION_NED_DATA>,
    old_time_is_sent: bool,
}

impl Falsifier {
    /// The bytes in place of a packet; `None` when it is withheld. `is_active` gives the faults of this time.
    pub fn apply(&mut self, packet: &Packet, is_active: impl Fn(Kind) -> bool) -> Option<Vec<u8>> {
        if !is_active(Kind::PositionFrozen) {
            self.frozen = None;
        }
        if !is_active(Kind::OldBootTime) {
            self.old_time_is_sent = false;
        }
        let message = match &packet.message {
            Some(MavMessage::HEARTBEAT(_)) if is_active(Kind::HeartbeatMissing) => return None,
            Some(MavMessage::LOCAL_POSITION_NED(_)) if is_active(Kind::PositionMissing) => {
                return None;
            }
            Some(MavMessage::ATTITUDE(_)) if is_active(Kind::AttitudeMissing) => return None,
            Some(message) => self.change(message.clone(), is_active),
            None => return Some(packet.raw.clone()),
        };
        Some(match message {
            Some(message) => encode(packet.sender, packet.sequence, &message),
            None => packet.raw.clone(),
        })
    }

    /// The changed message; `None` when it stays as it is.
    fn change(
        &mut self,
        message: MavMessage,
        is_active: impl Fn(Kind) -> bool,
    ) -> Option<MavMessage> {
        match message {
            MavMessage::EXTENDED_SYS_STATE(mut state) => {
                state.landed_state = if is_active(Kind::LandedUndefined) {
                    MavLandedState::MAV_LANDED_STATE_UNDEFINED
                } else if is_active(Kind::LandedTakingOff) {
                    MavLandedState::MAV_LANDED_STATE_TAKEOFF
                } else if is_active(Kind::LandedOnGround) {
                    MavLandedState::MAV_LANDED_STATE_ON_GROUND
                } else {
                    return None;
                };
                Some(MavMessage::EXTENDED_SYS_STATE(state))
            }
            MavMessage::HEARTBEAT(mut heartbeat) => {
                if is_active(Kind::ModeLie) {
                    heartbeat.custom_mode = LOITER;
                } else if is_active(Kind::DisarmedLie) {
                    heartbeat.base_mode.remove(MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED);
                } else {
                    return None;
                }
                Some(MavMessage::HEARTBEAT(heartbeat))
            }
            MavMessage::LOCAL_POSITION_NED(position) => {
                self.change_position(position, is_active).map(MavMessage::LOCAL_POSITION_NED)
            }
            _ => None,
        }
    }

    fn change_position(
        &mut self,
        mut position: LOCAL_POSITION_NED_DATA,
        is_active: impl Fn(Kind) -> bool,
    ) -> Option<LOCAL_POSITION_NED_DATA> {
        if is_active(Kind::PositionNan) {
            (position.x, position.y, position.z) = (f32::NAN, f32::NAN, f32::NAN);
        } else if is_active(Kind::PositionFrozen) {
            let time_boot_ms = position.time_boot_ms;
            let frozen = self.frozen.get_or_insert(position);
            position = LOCAL_POSITION_NED_DATA { time_boot_ms, ..frozen.clone() };
        } else if is_active(Kind::OldBootTime) && !self.old_time_is_sent {
            self.old_time_is_sent = true;
            position.time_boot_ms = position.time_boot_ms.saturating_sub(OLD_MS);
        } else {
            return None;
        }
        Some(position)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use autopilot::dialect::{EXTENDED_SYS_STATE_DATA, HEARTBEAT_DATA};
    use autopilot::{Parser, Sender};

    const AUTOPILOT: Sender = Sender { system: 1, component: 1 };

    fn falsified(
        falsifier: &mut Falsifier,
        kind: Kind,
        message: &MavMessage,
    ) -> Option<MavMessage> {
        let packet = Parser::new().push(&encode(AUTOPILOT, 7, message)).remove(0);
        let raw = falsifier.apply(&packet, |asked| asked == kind)?;
        let packet = Parser::new().push(&raw).remove(0);
        assert_eq!((packet.sender, packet.sequence), (AUTOPILOT, 7));
        packet.message
    }

    #[test]
    fn each_fault_changes_its_message_only() {
        let mut falsifier = Falsifier::default();
        let position = |time_boot_ms, x| {
            MavMessage::LOCAL_POSITION_NED(LOCAL_POSITION_NED_DATA {
                time_boot_ms,
                x,
                ..Default::default()
            })
        };
        let state = MavMessage::EXTENDED_SYS_STATE(EXTENDED_SYS_STATE_DATA::default());
        let heartbeat = MavMessage::HEARTBEAT(HEARTBEAT_DATA::default());
        assert_eq!(falsified(&mut falsifier, Kind::HeartbeatMissing, &heartbeat), None);
        assert_eq!(falsified(&mut falsifier, Kind::HeartbeatMissing, &state), Some(state.clone()));
        assert_ne!(falsified(&mut falsifier, Kind::LandedOnGround, &state), Some(state));
        assert_eq!(
            falsified(&mut falsifier, Kind::PositionFrozen, &position(90_000, 1.0)),
            Some(position(90_000, 1.0))
        );
        assert_eq!(
            falsified(&mut falsifier, Kind::PositionFrozen, &position(90_020, 2.0)),
            Some(position(90_020, 1.0))
        );
        assert_eq!(
            falsified(&mut falsifier, Kind::OldBootTime, &position(90_040, 3.0)),
            Some(position(30_040, 3.0))
        );
        assert_eq!(
            falsified(&mut falsifier, Kind::OldBootTime, &position(90_060, 3.0)),
            Some(position(90_060, 3.0))
        );
    }
}
