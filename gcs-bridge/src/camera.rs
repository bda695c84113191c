//! The camera as a MAVLink component of the vehicle: its heartbeat, information and video stream, and the marker of the
//! detector in use as a tracked rectangle.
//!
//! The messages are those of <https://mavlink.io/en/services/camera.html>. The camera is there while a detector publishes detections in its
//! frames. It shows as tracked the best marker of the detector whose detections the controller uses.

use autopilot::compose::heartbeat;
use autopilot::dialect::{
    CAMERA_CAPTURE_STATUS_DATA, CAMERA_INFORMATION_DATA, CAMERA_SETTINGS_DATA,
    CAMERA_TRACKING_IMAGE_STATUS_DATA, CameraCapFlags, CameraMode, CameraTrackingMode,
    CameraTrackingStatusFlags, CameraTrackingTargetData, HEARTBEAT_DATA, MavMessage, MavState,
    MavType, STORAGE_INFORMATION_DATA, StorageStatus, VIDEO_STREAM_INFORMATION_DATA,
    VIDEO_STREAM_STATUS_DATA, VideoStreamEncoding, VideoStreamStatusFlags, VideoStreamType,
};
use messages::{ControllerStatus, Detection, Detections};

use crate::frame_rate::FrameRate;
use crate::video::Video;

/// Silence of its detector after which the camera is gone, in nanoseconds.
const CAMERA_TIMEOUT_NS: i64 = 3_000_000_000;
/// Silence of its detector after which no marker is shown as tracked, in nanoseconds.
const MARKER_TIMEOUT_NS: i64 = 300_000_000;
/// Maximum length of the name of a camera or detector that is kept, in bytes.
const MAX_NAME: usize = 64;
/// The number of the only video stream.
pub(crate) const STREAM: u8 = 1;

/// The camera of the detector that is followed.
#[derive(Debug)]
pub(crate) struct Camera {
    video: Option<Video>,
    started_ns: i64,
    seen: Option<Frame>,
    rate: FrameRate,
    /// Period of the tracked marker's position, in nanoseconds, while the ground station wants it.
    period_ns: Option<i64>,
    due_ns: i64,
}

/// The newest frame.
#[derive(Clone, Debug)]
struct Frame {
    at_ns: i64,
    detector: String,
    camera: String,
    width: u32,
    height: u32,
    marker: Option<Rectangle>,
}

/// A rectangle in an image: left and upper edge 0, right and lower edge 1.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Rectangle {
    pub(crate) min: [f32; 2],
    pub(crate) max: [f32; 2],
}

impl Rectangle {
    /// Whether two rectangles have a point in common.
    pub(crate) fn touches(&self, other: &Self) -> bool {
        (0..2).all(|axis| self.min[axis] <= other.max[axis] && other.min[axis] <= self.max[axis])
    }

    /// The bounds of a marker in a frame, whose pixel (0, 0) extends from -0.5 to 0.5.
    fn of(detection: &Detection, width: u32, height: u32) -> Option<Self> {
        let [x, y] = detection.centre_px;
        let half_px = detection.size_px / 2.0;
        let around = [[x - half_px, y - half_px], [x + half_px, y + half_px]];
        let points: &[[f64; 2]] = match &detection.corners_px {
            Some(corners) => corners,
            None => &around,
        };
        let size_px = [f64::from(width), f64::from(height)];
        let bound = |axis: usize, start: f64, choose: fn(f64, f64) -> f64| {
            let px = points.iter().map(|point| point[axis]).fold(start, choose);
            ((px + 0.5) / size_px[axis]).clamp(0.0, 1.0) as f32
        };
        let is_known = width > 0 && height > 0 && points.iter().flatten().all(|px| px.is_finite());
        is_known.then(|| Self {
            min: [0, 1].map(|axis| bound(axis, f64::INFINITY, f64::min)),
            max: [0, 1].map(|axis| bound(axis, f64::NEG_INFINITY, f64::max)),
        })
    }
}

impl Camera {
    /// A camera, whose video another program may serve.
    pub(crate) fn new(now_ns: i64, video: Option<Video>) -> Self {
        Self {
            video,
            started_ns: now_ns,
            seen: None,
            rate: FrameRate::default(),
            period_ns: None,
            due_ns: i64::MIN,
        }
    }

    /// Takes the detections of a frame, if their detector is the one that the controller uses; without one, the one that was received
    /// first. Of its markers the landing's is tracked, as far as that is known.
    pub(crate) fn sees(
        &mut self,
        now_ns: i64,
        detector: &str,
        status: Option<&ControllerStatus>,
        found: &Detections,
    ) {
        let in_use = status.and_then(|status| status.active_detector.as_deref());
        let wanted = status.and_then(ControllerStatus::landing_marker);
        let followed = self.frame(now_ns).map(|frame| frame.detector.as_str());
        let is_followed = in_use.or(followed).is_none_or(|name| name == detector);
        let header = &found.header;
        if !is_followed || detector.len() > MAX_NAME || header.camera.len() > MAX_NAME {
            return;
        }
        let (width, height) = (header.width, header.height);
        let best = match wanted {
            Some(name) => found.first_of(name),
            None => found.detections.first(),
        };
        self.rate.frame(header);
        self.seen = Some(Frame {
            at_ns: now_ns,
            detector: detector.to_owned(),
            camera: header.camera.clone(),
            width,
            height,
            marker: best.and_then(|marker| Rectangle::of(marker, width, height)),
        });
    }

    /// The camera's heartbeat, while there is a camera.
    pub(crate) fn heartbeat(&self, now_ns: i64) -> Option<HEARTBEAT_DATA> {
        self.frame(now_ns)?;
        Some(HEARTBEAT_DATA {
            mavtype: MavType::MAV_TYPE_CAMERA,
            system_status: MavState::MAV_STATE_STANDBY,
            ..heartbeat()
        })
    }

    /// Sends the tracked marker's position with this period from now on, in nanoseconds; no longer without one.
    pub(crate) fn set_period(&mut self, period_ns: Option<i64>) {
        self.period_ns = period_ns;
        self.due_ns = i64::MIN;
    }

    /// The tracked marker's position, when it is due.
    pub(crate) fn due_tracking(&mut self, now_ns: i64) -> Option<MavMessage> {
        let period_ns = self.period_ns?;
        self.frame(now_ns)?;
        if now_ns < self.due_ns {
            return None;
        }
        self.due_ns = now_ns.saturating_add(period_ns);
        Some(self.tracking(now_ns))
    }

    /// The bounds of the tracked marker.
    pub(crate) fn marker(&self, now_ns: i64) -> Option<Rectangle> {
        self.newest(now_ns, MARKER_TIMEOUT_NS)?.marker
    }

    /// CAMERA_TRACKING_IMAGE_STATUS.
    pub(crate) fn tracking(&self, now_ns: i64) -> MavMessage {
        let marker = self.marker(now_ns);
        let [left, top] = marker.map_or([f32::NAN; 2], |it| it.min);
        let [right, bottom] = marker.map_or([f32::NAN; 2], |it| it.max);
        let tracked = marker.is_some();
        MavMessage::CAMERA_TRACKING_IMAGE_STATUS(CAMERA_TRACKING_IMAGE_STATUS_DATA {
            point_x: (left + right) / 2.0,
            point_y: (top + bottom) / 2.0,
            radius: (right - left) / 2.0,
            rec_top_x: left,
            rec_top_y: top,
            rec_bottom_x: right,
            rec_bottom_y: bottom,
            tracking_status: if tracked {
                CameraTrackingStatusFlags::CAMERA_TRACKING_STATUS_FLAGS_ACTIVE
            } else {
                CameraTrackingStatusFlags::CAMERA_TRACKING_STATUS_FLAGS_IDLE
            },
            tracking_mode: if tracked {
                CameraTrackingMode::CAMERA_TRACKING_MODE_RECTANGLE
            } else {
                CameraTrackingMode::CAMERA_TRACKING_MODE_NONE
            },
            target_data: CameraTrackingTargetData::CAMERA_TRACKING_TARGET_DATA_IN_STATUS,
            camera_device_id: 0,
        })
    }

    /// CAMERA_INFORMATION.
    pub(crate) fn information(&self, now_ns: i64) -> MavMessage {
        let mut flags = CameraCapFlags::CAMERA_CAP_FLAGS_HAS_TRACKING_POINT
            | CameraCapFlags::CAMERA_CAP_FLAGS_HAS_TRACKING_RECTANGLE;
        flags.set(CameraCapFlags::CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM, self.video.is_some());
        let [resolution_h, resolution_v] = self.resolution();
        let camera = self.seen.as_ref().map_or("", |frame| frame.camera.as_str());
        MavMessage::CAMERA_INFORMATION(CAMERA_INFORMATION_DATA {
            time_boot_ms: self.boot_ms(now_ns),
            focal_length: f32::NAN,
            sensor_size_h: f32::NAN,
            sensor_size_v: f32::NAN,
            flags,
            resolution_h,
            resolution_v,
            vendor_name: padded("Alight"),
            model_name: padded(camera),
            ..CAMERA_INFORMATION_DATA::default()
        })
    }

    /// CAMERA_SETTINGS: it always delivers frames, and has neither zoom nor focus.
    pub(crate) fn settings(&self, now_ns: i64) -> MavMessage {
        MavMessage::CAMERA_SETTINGS(CAMERA_SETTINGS_DATA {
            time_boot_ms: self.boot_ms(now_ns),
            mode_id: CameraMode::CAMERA_MODE_VIDEO,
            zoomLevel: f32::NAN,
            focusLevel: f32::NAN,
            camera_device_id: 0,
        })
    }

    /// CAMERA_CAPTURE_STATUS: it keeps no pictures for the ground station.
    pub(crate) fn capture_status(&self, now_ns: i64) -> MavMessage {
        let time_boot_ms = self.boot_ms(now_ns);
        MavMessage::CAMERA_CAPTURE_STATUS(CAMERA_CAPTURE_STATUS_DATA {
            time_boot_ms,
            ..CAMERA_CAPTURE_STATUS_DATA::default()
        })
    }

    /// STORAGE_INFORMATION: there is none.
    pub(crate) fn storage(&self, now_ns: i64) -> MavMessage {
        MavMessage::STORAGE_INFORMATION(STORAGE_INFORMATION_DATA {
            time_boot_ms: self.boot_ms(now_ns),
            status: StorageStatus::STORAGE_STATUS_NOT_SUPPORTED,
            ..STORAGE_INFORMATION_DATA::default()
        })
    }

    /// VIDEO_STREAM_INFORMATION, when the site has a video. Its rate is that of the camera, which a program that serves the video may reduce.
    pub(crate) fn stream_information(&self) -> Option<MavMessage> {
        let video = self.video.as_ref()?;
        let [resolution_h, resolution_v] = self.resolution();
        let (kind, encoding) = match video {
            Video::Rtsp(_) => {
                (VideoStreamType::VIDEO_STREAM_TYPE_RTSP, VideoStreamEncoding::default())
            }
            Video::RtpH264(_) => (
                VideoStreamType::VIDEO_STREAM_TYPE_RTPUDP,
                VideoStreamEncoding::VIDEO_STREAM_ENCODING_H264,
            ),
            Video::RtpH265(_) => (
                VideoStreamType::VIDEO_STREAM_TYPE_RTPUDP,
                VideoStreamEncoding::VIDEO_STREAM_ENCODING_H265,
            ),
        };
        Some(MavMessage::VIDEO_STREAM_INFORMATION(VIDEO_STREAM_INFORMATION_DATA {
            flags: VideoStreamStatusFlags::VIDEO_STREAM_STATUS_FLAGS_RUNNING,
            framerate: self.rate.hz(),
            resolution_h,
            resolution_v,
            stream_id: STREAM,
            count: 1,
            mavtype: kind,
            name: "Alight".into(),
            uri: video.uri().as_str().into(),
            encoding,
            ..VIDEO_STREAM_INFORMATION_DATA::default()
        }))
    }

    /// VIDEO_STREAM_STATUS, when the site has a video.
    pub(crate) fn stream_status(&self) -> Option<MavMessage> {
        self.video.as_ref()?;
        let [resolution_h, resolution_v] = self.resolution();
        Some(MavMessage::VIDEO_STREAM_STATUS(VIDEO_STREAM_STATUS_DATA {
            flags: VideoStreamStatusFlags::VIDEO_STREAM_STATUS_FLAGS_RUNNING,
            framerate: self.rate.hz(),
            resolution_h,
            resolution_v,
            stream_id: STREAM,
            ..VIDEO_STREAM_STATUS_DATA::default()
        }))
    }

    fn frame(&self, now_ns: i64) -> Option<&Frame> {
        self.newest(now_ns, CAMERA_TIMEOUT_NS)
    }

    fn newest(&self, now_ns: i64, max_age_ns: i64) -> Option<&Frame> {
        let is_recent = |frame: &&Frame| now_ns.saturating_sub(frame.at_ns) <= max_age_ns;
        self.seen.as_ref().filter(is_recent)
    }

    fn resolution(&self) -> [u16; 2] {
        let size = self.seen.as_ref().map_or([0; 2], |frame| [frame.width, frame.height]);
        size.map(|pixels| u16::try_from(pixels).unwrap_or(0))
    }

    fn boot_ms(&self, now_ns: i64) -> u32 {
        (now_ns.saturating_sub(self.started_ns) / 1_000_000).max(0) as u32
    }
}

/// A text in a field of 32 bytes, of which the last stays 0.
fn padded(text: &str) -> [u8; 32] {
    let mut field = [0; 32];
    field[..31].iter_mut().zip(text.bytes()).for_each(|(to, from)| *to = from);
    field
}

#[cfg(test)]
mod tests {
    use super::*;
    use messages::FrameHeader;

    const SECOND_NS: i64 = 1_000_000_000;

    fn found(corners_px: Option<[[f64; 2]; 4]>) -> Detections {
        let marker = Detection {
            centre_px: [199.5, 99.5],
            size_px: 40.0,
            corners_px,
            ..Detection::sample()
        };
        let header = FrameHeader { width: 400, height: 200, ..FrameHeader::sample() };
        Detections { header, detections: vec![marker], ..Detections::sample() }
    }

    fn camera_with(found: &Detections) -> Camera {
        let mut camera = Camera::new(0, None);
        camera.sees(0, "onboard", None, found);
        camera
    }

    #[test]
    fn a_markers_bounds_are_parts_of_the_picture() {
        let round = camera_with(&found(None)).marker(0).unwrap();
        assert_eq!((round.min, round.max), ([0.45, 0.4], [0.55, 0.6]));
        let corners = [[-9.0, 39.5], [199.5, 19.5], [219.5, 99.5], [99.5, 119.5]];
        let square = camera_with(&found(Some(corners))).marker(0).unwrap();
        assert_eq!((square.min, square.max), ([0.0, 0.1], [0.55, 0.6]));
        let mut odd = found(Some([[f64::NAN; 2]; 4]));
        assert_eq!(camera_with(&odd).marker(0), None);
        odd = found(None);
        odd.header.width = 0;
        assert_eq!(camera_with(&odd).marker(0), None);
    }

    #[test]
    fn a_marker_that_is_no_longer_seen_is_no_longer_tracked() {
        let mut camera = camera_with(&found(None));
        camera.set_period(Some(SECOND_NS / 5));
        let status = |camera: &mut Camera, now_ns| match camera.due_tracking(now_ns) {
            Some(MavMessage::CAMERA_TRACKING_IMAGE_STATUS(message)) => message,
            other => panic!("{other:?}"),
        };
        let message = status(&mut camera, 0);
        assert_eq!(message.tracking_status.bits(), 1);
        assert_eq!((message.rec_top_x, message.rec_bottom_y), (0.45, 0.6));
        assert_eq!(camera.due_tracking(SECOND_NS / 5 - 1), None);
        // Its detector has fallen silent.
        let message = status(&mut camera, SECOND_NS / 2);
        assert_eq!(message.tracking_status.bits(), 0);
        assert!(message.rec_top_x.is_nan());
        // It reports that there is none.
        let nothing = Detections { detections: Vec::new(), ..found(None) };
        camera.sees(SECOND_NS, "onboard", None, &nothing);
        assert_eq!(status(&mut camera, SECOND_NS).tracking_status.bits(), 0);
        assert_eq!(camera.due_tracking(9 * SECOND_NS), None, "there is no camera any more");
        assert!(camera.heartbeat(4 * SECOND_NS).is_some());
        assert_eq!(camera.heartbeat(4 * SECOND_NS + 1), None);
    }

    #[test]
    fn the_video_has_the_measured_rate_of_the_camera() {
        let mut camera = Camera::new(0, "rtp-h264:5600".parse().ok());
        for number in 0..30_u64 {
            let mut found = found(None);
            let stamp_ns = 100_000_000 * number as i64;
            (found.header.sequence, found.header.stamp_ns) = (4 * number, stamp_ns);
            camera.sees(stamp_ns, "onboard", None, &found);
        }
        let Some(MavMessage::VIDEO_STREAM_INFORMATION(stream)) = camera.stream_information() else {
            panic!("no stream")
        };
        let Some(MavMessage::VIDEO_STREAM_STATUS(status)) = camera.stream_status() else {
            panic!("no status")
        };
        assert_eq!((stream.framerate, status.framerate), (40.0, 40.0));
    }

    #[test]
    fn the_detector_in_use_is_followed_and_without_one_the_first() {
        let nothing = Detections { detections: Vec::new(), ..found(None) };
        let uses = |detector: &str, marker: &str| ControllerStatus {
            active_detector: Some(detector.into()),
            marker: marker.into(),
            ..ControllerStatus::default()
        };
        let in_use = uses("other", "");
        let mut camera = camera_with(&found(None));
        camera.sees(1, "other", None, &nothing);
        assert!(camera.marker(1).is_some());
        camera.sees(2, "other", Some(&in_use), &nothing);
        assert_eq!(camera.marker(2), None);
        camera.sees(3, "onboard", Some(&in_use), &found(None));
        assert_eq!(camera.marker(3), None);
        // The one that was followed is gone.
        camera.sees(4 * SECOND_NS, "onboard", None, &found(None));
        assert!(camera.marker(4 * SECOND_NS).is_some());
        // Of its markers the landing's.
        for (marker, is_tracked) in [("rings", true), ("stag-hd23", false)] {
            let status = uses("onboard", marker);
            camera.sees(5 * SECOND_NS, "onboard", Some(&status), &found(None));
            assert_eq!(camera.marker(5 * SECOND_NS).is_some(), is_tracked, "{marker}");
        }
    }
}
