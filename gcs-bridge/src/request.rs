//! A ground station's commands to the camera and their answers: messages of camera, video and tracking, once
//! or at an interval, and whether tracking can be started.

use autopilot::dialect::{
    CAMERA_CAPTURE_STATUS_DATA, CAMERA_INFORMATION_DATA, CAMERA_SETTINGS_DATA,
    CAMERA_TRACKING_IMAGE_STATUS_DATA, COMMAND_INT_DATA, COMMAND_LONG_DATA, MavCmd, MavMessage,
    MavResult, MessageData, STORAGE_INFORMATION_DATA, VIDEO_STREAM_INFORMATION_DATA,
    VIDEO_STREAM_STATUS_DATA,
};

use crate::camera::{Camera, Rectangle, STREAM};

/// Period of the tracked marker's position when the ground station leaves it to the camera, in nanoseconds.
const DEFAULT_PERIOD_NS: i64 = 200_000_000;
/// Bounds of that period, in nanoseconds: 20 Hz, and one a minute.
const PERIODS_NS: (i64, i64) = (50_000_000, 60_000_000_000);

/// A command with those of its parameters that mean the same in both of MAVLink's messages for commands.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Command {
    pub(crate) command: MavCmd,
    params: [f32; 4],
}

impl Command {
    /// The command in a packet's message.
    pub(crate) fn of(message: &MavMessage) -> Option<Self> {
        Some(match message {
            MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
                command,
                param1,
                param2,
                param3,
                param4,
                ..
            })
            | MavMessage::COMMAND_INT(COMMAND_INT_DATA {
                command,
                param1,
                param2,
                param3,
                param4,
                ..
            }) => Self { command: *command, params: [*param1, *param2, *param3, *param4] },
            _ => return None,
        })
    }
}

/// The answer to a command.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Answer {
    pub(crate) result: MavResult,
    /// The requested message; it follows the acknowledgement.
    pub(crate) message: Option<MavMessage>,
    /// A message that follows it without a request.
    pub(crate) next: Option<MavMessage>,
    /// Why it was refused, for a person.
    pub(crate) why: Option<&'static str>,
}

impl Answer {
    fn only(result: MavResult) -> Self {
        Self { result, message: None, next: None, why: None }
    }

    fn with(message: Option<MavMessage>) -> Self {
        match message {
            Some(_) => Self { message, ..Self::only(MavResult::MAV_RESULT_ACCEPTED) },
            None => Self::only(MavResult::MAV_RESULT_UNSUPPORTED),
        }
    }
}

/// The camera's answer to a command.
pub(crate) fn answer(camera: &mut Camera, now_ns: i64, asked: Command) -> Answer {
    let [first, second, ..] = asked.params;
    match asked.command {
        MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL => set_interval(camera, first, second),
        MavCmd::MAV_CMD_CAMERA_TRACK_POINT | MavCmd::MAV_CMD_CAMERA_TRACK_RECTANGLE => {
            track(camera, now_ns, asked)
        }
        MavCmd::MAV_CMD_CAMERA_STOP_TRACKING => {
            camera.set_period(None);
            Answer::only(MavResult::MAV_RESULT_ACCEPTED)
        }
        // Its video, if there is one, always runs.
        MavCmd::MAV_CMD_VIDEO_START_STREAMING if camera.stream_information().is_some() => {
            Answer::only(MavResult::MAV_RESULT_ACCEPTED)
        }
        _ => {
            let asked = message_id(asked);
            let message = asked.and_then(|(id, which)| message(camera, now_ns, id, which));
            // MAVSDK asks for a camera's streams every 20 s only, and uses the answer until then.
            let is_introduction = asked.is_some_and(|(id, _)| id == CAMERA_INFORMATION_DATA::ID);
            let next = if is_introduction { camera.stream_information() } else { None };
            Answer { next, ..Answer::with(message) }
        }
    }
}

/// The number of the message that a command asks for, and of the stream, where it names one (0 for all).
#[expect(deprecated, reason = "ground stations ask with the older commands too")]
fn message_id(asked: Command) -> Option<(u32, f32)> {
    let [first, second, ..] = asked.params;
    Some(match asked.command {
        MavCmd::MAV_CMD_REQUEST_MESSAGE => (first as u32, second),
        MavCmd::MAV_CMD_REQUEST_CAMERA_INFORMATION => (CAMERA_INFORMATION_DATA::ID, 0.0),
        MavCmd::MAV_CMD_REQUEST_CAMERA_SETTINGS => (CAMERA_SETTINGS_DATA::ID, 0.0),
        MavCmd::MAV_CMD_REQUEST_CAMERA_CAPTURE_STATUS => (CAMERA_CAPTURE_STATUS_DATA::ID, 0.0),
        MavCmd::MAV_CMD_REQUEST_STORAGE_INFORMATION => (STORAGE_INFORMATION_DATA::ID, 0.0),
        MavCmd::MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION => {
            (VIDEO_STREAM_INFORMATION_DATA::ID, first)
        }
        MavCmd::MAV_CMD_REQUEST_VIDEO_STREAM_STATUS => (VIDEO_STREAM_STATUS_DATA::ID, first),
        _ => return None,
    })
}

fn message(camera: &Camera, now_ns: i64, id: u32, stream: f32) -> Option<MavMessage> {
    let is_ours = stream == 0.0 || stream == f32::from(STREAM);
    Some(match id {
        CAMERA_INFORMATION_DATA::ID => camera.information(now_ns),
        CAMERA_SETTINGS_DATA::ID => camera.settings(now_ns),
        CAMERA_CAPTURE_STATUS_DATA::ID => camera.capture_status(now_ns),
        STORAGE_INFORMATION_DATA::ID => camera.storage(now_ns),
        CAMERA_TRACKING_IMAGE_STATUS_DATA::ID => camera.tracking(now_ns),
        VIDEO_STREAM_INFORMATION_DATA::ID if is_ours => camera.stream_information()?,
        VIDEO_STREAM_STATUS_DATA::ID if is_ours => camera.stream_status()?,
        _ => return None,
    })
}

/// Only the tracked marker's position is sent regularly: -1 ends it, 0 leaves the period to the camera.
fn set_interval(camera: &mut Camera, id: f32, interval_us: f32) -> Answer {
    if id as u32 != CAMERA_TRACKING_IMAGE_STATUS_DATA::ID {
        return Answer::only(MavResult::MAV_RESULT_UNSUPPORTED);
    }
    let (min_ns, max_ns) = PERIODS_NS;
    let period_ns = if interval_us == -1.0 {
        None
    } else if interval_us == 0.0 {
        Some(DEFAULT_PERIOD_NS)
    } else if interval_us > 0.0 {
        Some(((f64::from(interval_us) * 1e3) as i64).clamp(min_ns, max_ns))
    } else {
        return Answer::only(MavResult::MAV_RESULT_DENIED);
    };
    camera.set_period(period_ns);
    Answer::only(MavResult::MAV_RESULT_ACCEPTED)
}

/// Only the landing marker is tracked, so a person must point at that.
fn track(camera: &mut Camera, now_ns: i64, asked: Command) -> Answer {
    let denied = |why| Answer { why: Some(why), ..Answer::only(MavResult::MAV_RESULT_DENIED) };
    let [left, top, right, bottom] = asked.params;
    let pointed_at = match asked.command {
        MavCmd::MAV_CMD_CAMERA_TRACK_RECTANGLE => {
            Rectangle { min: [left, top], max: [right, bottom] }
        }
        _ => Rectangle { min: [left, top], max: [left, top] },
    };
    let Some(marker) = camera.marker(now_ns) else { return denied("no marker is in sight") };
    if !marker.touches(&pointed_at) {
        return denied("only the landing marker can be tracked");
    }
    camera.set_period(Some(DEFAULT_PERIOD_NS));
    Answer::only(MavResult::MAV_RESULT_ACCEPTED)
}

#[cfg(test)]
mod tests {
    use super::*;
    use messages::Detections;

    /// A camera that sees a marker from a tenth to a fifth of 1000 x 1000 pixels.
    fn camera(video: Option<&str>) -> Camera {
        let mut camera = Camera::new(0, video.map(|text| text.parse().unwrap()));
        let mut found = Detections::sample();
        (found.header.width, found.header.height) = (1000, 1000);
        let corners = [[99.5, 99.5], [199.5, 99.5], [199.5, 199.5], [99.5, 199.5]];
        found.detections[0].corners_px = Some(corners);
        camera.sees(0, "onboard", None, &found);
        camera
    }

    fn ask(camera: &mut Camera, command: MavCmd, params: [f32; 4]) -> Answer {
        answer(camera, 0, Command { command, params })
    }

    #[test]
    #[expect(deprecated, reason = "ground stations ask with the older commands too")]
    fn each_way_of_asking_for_a_message_is_answered_with_it() {
        use MavCmd as Of;
        let mut camera = camera(Some("rtsp://10.0.0.2:8554/down"));
        for (legacy, id) in [
            (Of::MAV_CMD_REQUEST_CAMERA_INFORMATION, 259),
            (Of::MAV_CMD_REQUEST_CAMERA_SETTINGS, 260),
            (Of::MAV_CMD_REQUEST_STORAGE_INFORMATION, 261),
            (Of::MAV_CMD_REQUEST_CAMERA_CAPTURE_STATUS, 262),
            (Of::MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION, 269),
            (Of::MAV_CMD_REQUEST_VIDEO_STREAM_STATUS, 270),
        ] {
            use autopilot::dialect::Message;
            let old = ask(&mut camera, legacy, [1.0, 0.0, 0.0, 0.0]);
            let new = ask(&mut camera, Of::MAV_CMD_REQUEST_MESSAGE, [id as f32, 0.0, 0.0, 0.0]);
            for answer in [&old, &new] {
                assert_eq!(answer.result, MavResult::MAV_RESULT_ACCEPTED, "{legacy:?}");
                assert_eq!(answer.message.as_ref().unwrap().message_id(), id, "{legacy:?}");
            }
        }
        let other = ask(&mut camera, Of::MAV_CMD_REQUEST_MESSAGE, [30.0, 0.0, 0.0, 0.0]);
        assert_eq!(other, Answer::only(MavResult::MAV_RESULT_UNSUPPORTED));
        let second = ask(&mut camera, Of::MAV_CMD_REQUEST_MESSAGE, [269.0, 2.0, 0.0, 0.0]);
        assert_eq!(second.result, MavResult::MAV_RESULT_UNSUPPORTED);
    }

    #[test]
    fn a_video_is_announced_only_where_one_is_served() {
        let information = |video: Option<&str>| match camera(video).information(0) {
            MavMessage::CAMERA_INFORMATION(it) => it.flags.bits() & 256 != 0,
            other => panic!("{other:?}"),
        };
        assert!(!information(None));
        assert!(information(Some("rtp-h264:5600")));
        let next = |video: Option<&str>| {
            let asked = [259.0, 0.0, 0.0, 0.0];
            ask(&mut camera(video), MavCmd::MAV_CMD_REQUEST_MESSAGE, asked).next
        };
        assert_eq!(next(None), None);
        assert!(matches!(
            next(Some("rtp-h264:5600")),
            Some(MavMessage::VIDEO_STREAM_INFORMATION(_))
        ));
        let asked = [269.0, 0.0, 0.0, 0.0];
        let none = ask(&mut camera(None), MavCmd::MAV_CMD_REQUEST_MESSAGE, asked);
        assert_eq!(none.result, MavResult::MAV_RESULT_UNSUPPORTED);
        let rtp = ask(&mut camera(Some("rtp-h265:5600")), MavCmd::MAV_CMD_REQUEST_MESSAGE, asked);
        let Some(MavMessage::VIDEO_STREAM_INFORMATION(stream)) = rtp.message else {
            panic!("no stream")
        };
        assert_eq!(stream.uri.to_str(), Ok("5600"));
        assert_eq!((stream.mavtype as u8, stream.encoding as u8), (1, 2));
    }

    #[test]
    fn only_the_marker_can_be_tracked() {
        let mut camera = camera(None);
        let rectangle = MavCmd::MAV_CMD_CAMERA_TRACK_RECTANGLE;
        let outside = ask(&mut camera, rectangle, [0.5, 0.5, 0.6, 0.6]);
        assert_eq!(outside.result, MavResult::MAV_RESULT_DENIED);
        assert!(outside.why.is_some());
        assert_eq!(camera.due_tracking(0), None);
        let on_it = ask(&mut camera, rectangle, [0.15, 0.0, 0.6, 0.6]);
        assert_eq!(on_it.result, MavResult::MAV_RESULT_ACCEPTED);
        assert!(camera.due_tracking(0).is_some());
        ask(&mut camera, MavCmd::MAV_CMD_CAMERA_STOP_TRACKING, [0.0; 4]);
        assert_eq!(camera.due_tracking(1_000_000_000), None);
        let point = ask(&mut camera, MavCmd::MAV_CMD_CAMERA_TRACK_POINT, [0.15, 0.15, 0.0, 0.0]);
        assert_eq!(point.result, MavResult::MAV_RESULT_ACCEPTED);
        let nowhere = ask(&mut camera, rectangle, [f32::NAN; 4]);
        assert_eq!(nowhere.result, MavResult::MAV_RESULT_DENIED);
    }

    #[test]
    fn the_place_is_sent_as_often_as_asked_within_bounds() {
        let times = |interval_us: f32| {
            let mut camera = camera(None);
            let asked = [275.0, interval_us, 0.0, 0.0];
            let answer = ask(&mut camera, MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL, asked);
            let every_10_ms = (0..200).map(|tick| tick * 10_000_000);
            let sent = every_10_ms.filter(|now_ns| camera.due_tracking(*now_ns).is_some()).count();
            (answer.result, sent)
        };
        let accepted = MavResult::MAV_RESULT_ACCEPTED;
        assert_eq!(times(0.0), (accepted, 10));
        assert_eq!(times(500_000.0), (accepted, 4));
        assert_eq!(times(1.0), (accepted, 40));
        assert_eq!(times(-1.0), (accepted, 0));
        assert_eq!(times(f32::MAX), (accepted, 1));
        for odd in [f32::NAN, -2.0] {
            assert_eq!(times(odd), (MavResult::MAV_RESULT_DENIED, 0));
        }
    }
}
