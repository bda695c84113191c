//! Composes the MAVLink messages of a companion: heartbeat, message requests, STATUSTEXT in parts, velocity
//! setpoints, LANDING_TARGET in the body or the local frame.

use geometry::{Body, Ned, Point, Vector};
use libm::atan2;

use crate::dialect::{
    COMMAND_LONG_DATA, HEARTBEAT_DATA, LANDING_TARGET_DATA, LandingTargetType, MavAutopilot,
    MavBool, MavCmd, MavFrame, MavMessage, MavModeFlag, MavSeverity, MavState, MavType,
    PositionTargetTypemask, SET_POSITION_TARGET_LOCAL_NED_DATA, STATUSTEXT_DATA,
};
use crate::packet::Sender;

/// Maximum length of the text in one packet, in bytes.
const PART: usize = 50;
/// Maximum number of packets of one text; longer texts are cut.
const MAX_PARTS: usize = 10;

/// The heartbeat of a companion computer.
pub fn heartbeat() -> HEARTBEAT_DATA {
    HEARTBEAT_DATA {
        custom_mode: 0,
        mavtype: MavType::MAV_TYPE_ONBOARD_CONTROLLER,
        autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
        base_mode: MavModeFlag::empty(),
        system_status: MavState::MAV_STATE_ACTIVE,
        mavlink_version: 3,
    }
}

/// Asks for one message, by its number; the recipient is added when it is sent.
pub fn request_message(id: u32) -> MavMessage {
    MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
        command: MavCmd::MAV_CMD_REQUEST_MESSAGE,
        param1: id as f32,
        ..Default::default()
    })
}

/// Asks an autopilot to report the checks that fail before arming; the recipient is added when it is sent.
pub fn run_prearm_checks() -> MavMessage {
    MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
        command: MavCmd::MAV_CMD_RUN_PREARM_CHECKS,
        ..Default::default()
    })
}

/// A text for the ground station's message window, in as many packets as it needs.
///
/// `id` joins the packets of one text: a different number from 1 to 65535 for each text.
pub fn status_text(severity: MavSeverity, text: &str, id: u16) -> Vec<MavMessage> {
    // A part that is not full ends the text: so all others are full, a character may be split, and an empty
    // part ends a text that fills its last one.
    let mut parts: Vec<&[u8]> = text.trim_end().as_bytes().chunks(PART).take(MAX_PARTS).collect();
    let id = if parts.len() > 1 { id.max(1) } else { 0 };
    if parts.len() > 1 && parts.last().is_some_and(|last| last.len() >= PART) {
        parts.push(&[]);
    }
    let packet = |(chunk, part): (usize, &[u8])| {
        let mut text = [0; PART];
        text.iter_mut().zip(part).for_each(|(to, from)| *to = *from);
        let chunk_seq = chunk.min(255) as u8;
        MavMessage::STATUSTEXT(STATUSTEXT_DATA { severity, text: text.into(), id, chunk_seq })
    };
    parts.into_iter().enumerate().map(packet).collect()
}

/// A velocity setpoint in m/s, with a yaw rate in rad/s; zero holds the heading.
///
/// Type mask 1479: position, acceleration and yaw are ignored. With the yaw rate ignored as well, ArduPilot
/// would turn the nose into the direction of travel.
pub fn velocity(time_ms: u32, velocity: Vector<Ned>, yaw_rate: f64, target: Sender) -> MavMessage {
    MavMessage::SET_POSITION_TARGET_LOCAL_NED(SET_POSITION_TARGET_LOCAL_NED_DATA {
        time_boot_ms: time_ms,
        vx: velocity.x() as f32,
        vy: velocity.y() as f32,
        vz: velocity.z() as f32,
        yaw_rate: yaw_rate as f32,
        type_mask: PositionTargetTypemask::from_bits_retain(1479),
        target_system: target.system,
        target_component: target.component,
        coordinate_frame: MavFrame::MAV_FRAME_LOCAL_NED,
        ..Default::default()
    })
}

/// The landing target at a position in the body frame (m from the vehicle's origin): needs no rangefinder.
///
/// `time_usec` is the capture time by one steady clock. `None` when a number is not finite or the target is
/// not below.
pub fn landing_target_position(time_usec: u64, target: Point<Body>) -> Option<MavMessage> {
    let sight = target - Point::origin();
    let (angle_x, angle_y) = angles(sight)?;
    Some(MavMessage::LANDING_TARGET(LANDING_TARGET_DATA {
        time_usec,
        angle_x,
        angle_y,
        distance: sight.norm() as f32,
        frame: MavFrame::MAV_FRAME_BODY_FRD,
        x: target.x() as f32,
        y: target.y() as f32,
        z: target.z() as f32,
        q: [1.0, 0.0, 0.0, 0.0],
        mavtype: LandingTargetType::LANDING_TARGET_TYPE_VISION_FIDUCIAL,
        position_valid: MavBool::from_bits_retain(1),
        ..Default::default()
    }))
}

/// The landing target at a position in local NED (m from the autopilot's origin): the only frame that PX4 takes
/// (<https://docs.px4.io/main/en/advanced_features/precland.html>).
///
/// `time_usec` is the capture time by one steady clock. `None` when a number is not finite.
pub fn landing_target_local(time_usec: u64, target: Point<Ned>) -> Option<MavMessage> {
    target.is_finite().then(|| {
        MavMessage::LANDING_TARGET(LANDING_TARGET_DATA {
            time_usec,
            frame: MavFrame::MAV_FRAME_LOCAL_NED,
            x: target.x() as f32,
            y: target.y() as f32,
            z: target.z() as f32,
            q: [1.0, 0.0, 0.0, 0.0],
            mavtype: LandingTargetType::LANDING_TARGET_TYPE_VISION_FIDUCIAL,
            position_valid: MavBool::from_bits_retain(1),
            ..Default::default()
        })
    })
}

/// ArduPilot takes the line of sight to be (-tan `angle_y`, tan `angle_x`, 1).
fn angles(sight: Vector<Body>) -> Option<(f32, f32)> {
    let below = sight.is_finite() && sight.z() > 1e-6;
    below.then(|| (atan2(sight.y(), sight.z()) as f32, atan2(-sight.x(), sight.z()) as f32))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::packet::{encode, is_setpoint, setpoint_bytes};
    use crate::text::{Joiner, Text};
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_text_of_any_length_arrives_complete(text in "[a-z\u{e4}\u{1F681} ]{0,200}") {
            let mut joiner = Joiner::default();
            let mut arrived = String::new();
            for message in status_text(MavSeverity::MAV_SEVERITY_INFO, &text, 0) {
                let MavMessage::STATUSTEXT(part) = message else { unreachable!() };
                for Text { text, .. } in joiner.push(0, &part) {
                    arrived.push_str(&text);
                }
            }
            arrived.extend(joiner.tick(i64::MAX).map(|text| text.text));
            prop_assert!(text.len() > 450 || arrived == text.trim_end());
        }
    }

    #[test]
    fn a_setpoint_has_the_stated_length() {
        let ours = Sender { system: 1, component: 191 };
        let setpoint = velocity(7, Vector::zero(), 0.0, Sender { system: 1, component: 1 });
        let raw = encode(ours, 0, &setpoint);
        assert_eq!(raw.len(), setpoint_bytes(false));
        assert!(is_setpoint(&raw));
        assert!(!is_setpoint(&encode(ours, 0, &MavMessage::HEARTBEAT(heartbeat()))));
    }

    #[test]
    fn the_angles_point_where_ardupilot_looks() {
        // 1 m ahead and 2 m to the right, 4 m below.
        let message = landing_target_position(7, Point::new(1.0, 2.0, 4.0)).unwrap();
        let MavMessage::LANDING_TARGET(target) = message else { unreachable!() };
        assert!((-target.angle_y.tan() - 0.25).abs() < 1e-6);
        assert!((target.angle_x.tan() - 0.5).abs() < 1e-6);
        assert!((f64::from(target.distance) - 21_f64.sqrt()).abs() < 1e-6);
        assert_eq!(target.frame as u8, 12);
        assert_eq!(target.position_valid.bits(), 1);
    }

    #[test]
    fn px4_gets_only_a_position() {
        let message = landing_target_local(7, Point::new(1.0, 2.0, -0.5)).unwrap();
        let MavMessage::LANDING_TARGET(target) = message else { unreachable!() };
        assert_eq!((target.frame as u8, target.position_valid.bits(), target.time_usec), (1, 1, 7));
        assert_eq!([target.x, target.y, target.z, target.distance], [1.0, 2.0, -0.5, 0.0]);
        assert!(landing_target_local(7, Point::new(f64::NAN, 0.0, 0.0)).is_none());
    }

    #[test]
    fn a_target_to_the_side_or_above_is_refused() {
        assert!(landing_target_position(0, Point::new(1.0, 0.0, 0.0)).is_none());
        assert!(landing_target_position(0, Point::new(0.0, 0.0, -1.0)).is_none());
        assert!(landing_target_position(0, Point::new(0.0, f64::NAN, 1.0)).is_none());
    }
}
