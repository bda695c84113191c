//! Decides frame by frame how a camera is exposed for the marker: its position from detections, the levels there, the next
//! exposure time and gain or the camera's own metering, and the message about it.

use imaging::GrayView;
use messages::{
    CameraControl, ControllerStatus, Detections, ExposureReason, ExposureSetter, topic,
};
use metering::{ExposureControl, Handover, Levels, Limits, PadTrack, Seen, Setting, levels};
use node::{Node, Subscriber};

use crate::v4l2::exposer::Order;

/// Follows the marker, and decides how to expose for it.
pub(crate) struct MarkerExposure {
    track: PadTrack,
    handover: Handover,
    control: ExposureControl,
    sightings: Option<Sightings>,
}

/// The subscriptions that give the marker's position.
struct Sightings {
    detections: Subscriber<Detections>,
    /// Names the detector in use.
    status: Subscriber<ControllerStatus>,
}

/// How a frame was exposed, and how the next ones can be.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Exposed {
    /// Whether the camera can meter on its own.
    pub(crate) has_metering: bool,
    /// True when the camera certainly meters on its own.
    pub(crate) is_metering: bool,
    /// The setting that was ordered last; `None` while it is not set here.
    pub(crate) ordered: Option<Setting>,
    /// The setting with which the frame was taken; `None` while that is not known.
    pub(crate) setting: Option<Setting>,
    pub(crate) limits: Limits,
    /// Whether its luma is from 16 to 235.
    pub(crate) is_limited: bool,
}

/// An order that a device refused.
#[derive(Clone, Debug)]
pub(crate) struct Refusal {
    pub(crate) order: Order,
    /// Its answer.
    pub(crate) answer: String,
}

/// The order after a frame, and its reason.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Decision {
    pub(crate) order: Order,
    why: ExposureReason,
    /// The marker's levels in the frame, where they were measured.
    levels: Option<Levels>,
    /// How fast the marker moves; `None` without one.
    motion_px_s: Option<f64>,
    /// Within which it was decided.
    limits: Limits,
    /// Of the frame after which it was decided.
    before: Exposed,
}

impl Decision {
    /// The message about it once it was carried out, was refused, or was delayed in the pause after a refusal. `after` is the
    /// exposure then.
    pub(crate) fn message(&self, after: &Exposed, refusal: Option<&Refusal>) -> CameraControl {
        let wanted = match self.order {
            Order::Keep | Order::TakeOver => after.ordered,
            Order::OwnMetering => None,
            Order::Set(setting) => Some(setting),
        };
        let set_by = match after.ordered {
            // A camera without metering keeps its setting. Any other has not been ordered to meter yet.
            Some(_) if self.order == Order::OwnMetering && !after.has_metering => {
                ExposureSetter::Fixed
            }
            Some(_) => ExposureSetter::Marker,
            None if after.is_metering => ExposureSetter::Camera,
            None => ExposureSetter::Fixed,
        };
        // An answer to another kind of order has no information about this one.
        let is_of_its_kind = |refusal: &&Refusal| {
            std::mem::discriminant(&refusal.order) == std::mem::discriminant(&self.order)
        };
        let refused = refusal.filter(is_of_its_kind).map(|refusal| refusal.answer.clone());
        CameraControl {
            set_by,
            in_use: self.before.setting.map(Into::into),
            wanted: wanted.map(Into::into),
            why: self.why,
            refused,
            levels: self.levels.map(Into::into),
            motion_px_s: self.motion_px_s,
            limits: Some(self.limits.into()),
            ..CameraControl::default()
        }
    }
}

impl MarkerExposure {
    /// For a camera of this name, of which nothing is known yet.
    pub(crate) fn new(camera: &str) -> Self {
        Self {
            track: PadTrack::new(camera),
            handover: Handover::default(),
            control: ExposureControl::default(),
            sightings: None,
        }
    }

    /// Subscribes to detections.
    ///
    /// # Errors
    /// When the session is closed.
    pub(crate) async fn subscribe(&mut self, node: &Node) -> anyhow::Result<()> {
        self.sightings = Some(Sightings {
            detections: node.subscriber(topic::DETECTIONS, &[]).await?,
            status: node.subscriber(topic::STATUS, &[]).await?,
        });
        Ok(())
    }

    /// The order after a frame with this stamp, and its reason.
    pub(crate) fn after(
        &mut self,
        stamp_ns: i64,
        frame: GrayView<'_>,
        exposed: &Exposed,
    ) -> Decision {
        if let Some(sightings) = &self.sightings {
            while let Some(status) = sightings.status.waiting() {
                self.track.follow(&status);
            }
            while let Some(message) = sightings.detections.waiting() {
                self.track.update(&message);
            }
        }
        let pad = self.track.at(stamp_ns);
        let is_metered = self.handover.meters_pad(stamp_ns, pad.is_some());
        let motion_px_s = pad.map(|pad| pad.motion_px_s);
        let limits = exposed.limits;
        let decision = |order, why| Decision {
            order,
            why,
            levels: None,
            motion_px_s,
            limits,
            before: *exposed,
        };
        let Some(pad) = pad else {
            self.control = ExposureControl::default();
            return decision(Order::OwnMetering, ExposureReason::NoMarker);
        };
        if !is_metered {
            self.control = ExposureControl::default();
            return decision(Order::OwnMetering, ExposureReason::LostSoon);
        }
        if exposed.ordered.is_none() {
            return decision(Order::TakeOver, ExposureReason::TakenOver);
        }
        let levels = levels(frame, &pad).map(|levels| match exposed.is_limited {
            true => levels.of_limited_range(),
            false => levels,
        });
        let Some(levels) = levels else {
            return decision(Order::Keep, ExposureReason::NotInFrame);
        };
        let Some(setting) = exposed.setting else {
            return Decision {
                levels: Some(levels),
                ..decision(Order::Keep, ExposureReason::Settling)
            };
        };
        let seen = Seen { setting, levels, motion_px_s: pad.motion_px_s };
        let step = self.control.next(&seen, &exposed.limits);
        Decision {
            levels: Some(levels),
            limits: step.limits,
            ..decision(step.next.map_or(Order::Keep, Order::Set), step.why)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::v4l2::abi::CID_EXPOSURE_ABSOLUTE;
    use crate::v4l2::capture::Wanted;
    use crate::v4l2::exposer::ForMarker;
    use crate::v4l2::fake::{Exposed as Truth, Fake, GAIN, MS, Stamps};
    use crate::v4l2::video::{Next, Port, Video};
    use messages::{Detection, FrameHeader, PixelFormat};
    use std::rc::Rc;
    use std::time::Duration;

    /// A detector's message of the pad that the played camera shows in its centre.
    fn detections(stamp_ns: i64, centre_px: Option<[f64; 2]>) -> Detections {
        let detection = centre_px.map(|centre_px| Detection {
            family: "rings".into(),
            id: None,
            centre_px,
            centre_covariance_px2: [0.0; 3],
            corners_px: None,
            size_px: 80.0,
            wrong_bits: 0,
            confidence: 1.0,
            pose: None,
        });
        let header = FrameHeader {
            camera: "down".into(),
            sequence: 0,
            stamp_ns,
            clock: String::new(),
            exposure_ns: 0,
            width: 640,
            height: 480,
            format: PixelFormat::Mono8,
            parts: Vec::new(),
        };
        let detections = detection.into_iter().collect();
        Detections { detector: "main".into(), header, detections, stages: Vec::new() }
    }

    /// A played camera that is exposed for the marker.
    struct Loop {
        fake: Rc<Fake>,
        video: Video<Rc<Fake>>,
        marker: MarkerExposure,
        /// Of each frame: its number, whether its stamp is exact, and how far that is from the truth.
        frames: Vec<Frame>,
        /// The message after each.
        controls: Vec<CameraControl>,
        /// How often a control was refused.
        refused: u32,
        /// How long each frame takes.
        needed: Duration,
    }

    #[derive(Copy, Clone, Debug)]
    struct Frame {
        number: u32,
        is_exact: bool,
        error_ns: i64,
        white: f64,
    }

    impl Loop {
        fn new(stamps: Stamps) -> Self {
            Self::with("GREY", stamps)
        }

        fn with(fourcc: &'static str, stamps: Stamps) -> Self {
            let exposing = Self::left(fourcc, stamps);
            exposing.fake.meter();
            exposing
        }

        /// With a camera that does not meter.
        fn left(fourcc: &'static str, stamps: Stamps) -> Self {
            let fake = Fake::of(fourcc, stamps, 0);
            let for_marker = ForMarker {
                max_exposure_s: 5e-3,
                gain: "gain".into(),
                max_gain: 16.0,
                settle_frames: 4,
            };
            let wanted = Wanted {
                fourcc: fourcc.into(),
                width: 640,
                height: 480,
                rate_hz: 100.0,
                controls: Vec::new(),
                for_marker: Some(for_marker),
                stamped_at: None,
                readout_ns: 0,
                delay_ns: 9 * MS,
            };
            let video = Video::start(Rc::clone(&fake), wanted).unwrap();
            let marker = MarkerExposure::new("down");
            Self {
                fake,
                video,
                marker,
                frames: Vec::new(),
                controls: Vec::new(),
                refused: 0,
                needed: Duration::ZERO,
            }
        }

        /// Reads frames for so long; a detector finds the pad at `pad_at`.
        fn run(&mut self, time_ns: i64, pad_at: impl Fn(i64) -> Option<[f64; 2]>) {
            let until_ns = self.fake.now_ns() + time_ns;
            let mut grey = vec![0; 640 * 480];
            while self.fake.now_ns() < until_ns {
                let Next::Frame(taken) = self.video.next().unwrap() else { continue };
                let capture = self.video.capture().unwrap();
                capture.copy_grey(&taken, &mut grey);
                let number = u32::from_le_bytes(grey[..4].try_into().unwrap());
                let exposure = taken.exposure;
                self.fake.pass(self.needed);
                capture.give_back(taken).unwrap();
                let exposed = capture.exposed().unwrap();
                let frame = GrayView::packed(&grey, 640, 480).unwrap();
                let decision = self.marker.after(exposure.mid_ns, frame, &exposed);
                self.refused += u32::from(capture.expose(decision.order).is_err());
                let after = capture.exposed().unwrap();
                self.controls.push(decision.message(&after, capture.refusal()));
                self.marker.track.update(&detections(exposure.mid_ns, pad_at(exposure.mid_ns)));
                let error_ns = exposure.mid_ns - self.fake.mid_exposure_ns(number);
                let white = f64::from(grey[240 * 640 + 320]) / 255.0;
                self.frames.push(Frame { number, is_exact: exposure.is_exact(), error_ns, white });
            }
        }

        fn last(&self) -> Frame {
            *self.frames.last().unwrap()
        }

        fn truth(&self) -> Truth {
            self.fake.exposed(self.last().number)
        }
    }

    fn still(_stamp_ns: i64) -> Option<[f64; 2]> {
        Some([320.0, 240.0])
    }

    #[test]
    fn a_devices_controls_follow_the_light_on_the_marker() {
        let mut exposing = Loop::new(Stamps::ExposureStart);
        for light in [0.1, 6.4, 0.1, 0.02, 1.0, 4.97, 4.5, 2.9] {
            exposing.fake.light(light);
            exposing.run(1500 * MS, still);
            let (white, truth) = (exposing.last().white, exposing.truth());
            println!("light {light}: white {white:.2}, {truth:?}");
            assert!((0.6..=0.85).contains(&white), "{light}: {white} {truth:?}");
            // Of one or two units of 100 us half a unit is much: gain has the rest.
            let max_gain = if truth.exposure_ns < MS / 2 { 1.7 } else { 1.1 };
            let is_second = truth.gain < max_gain || truth.exposure_ns == 5 * MS;
            assert!(is_second, "gain is second: {truth:?}");
        }
    }

    #[test]
    fn clipped_white_of_a_limited_range_is_recognised() {
        let mut exposing = Loop::with("YUYV", Stamps::ExposureStart);
        exposing.fake.light(0.2);
        exposing.run(1000 * MS, still);
        // White is at 235 then, and black is clipped as well.
        exposing.fake.light(4.0);
        exposing.run(400 * MS, still);
        // Of 16 to 235.
        let white = (exposing.last().white * 255.0 - 16.0) / 219.0;
        assert!((0.6..=0.85).contains(&white), "{white} {:?}", exposing.truth());
    }

    #[test]
    fn a_marker_that_moves_is_exposed_for_a_shorter_time_and_with_more_gain() {
        let mut exposing = Loop::new(Stamps::ExposureStart);
        exposing.fake.light(0.2);
        exposing.run(1000 * MS, still);
        let before = exposing.truth();
        // To and fro by 5 pixels, at 500 pixels per second.
        exposing.run(1000 * MS, |stamp_ns| {
            Some([318.0 + 5.0 * f64::from((stamp_ns / (10 * MS) % 2) as u8), 240.0])
        });
        let after = exposing.truth();
        assert!(after.exposure_ns <= 2200 * 1000 && before.exposure_ns > 3 * MS, "{after:?}");
        assert!(after.gain > before.gain && (0.6..=0.85).contains(&exposing.last().white));
    }

    #[test]
    fn without_a_marker_the_camera_meters_by_itself() {
        let mut exposing = Loop::new(Stamps::ExposureStart);
        exposing.fake.light(0.2);
        exposing.run(500 * MS, |_| None);
        assert!(exposing.fake.is_metering());
        exposing.run(500 * MS, still);
        assert!(!exposing.fake.is_metering());
        exposing.run(1000 * MS, |_| None);
        assert!(exposing.fake.is_metering());
    }

    #[test]
    fn a_camera_that_was_left_without_metering_meters_again() {
        // As an earlier start or `source.controls` have left it.
        let mut exposing = Loop::left("GREY", Stamps::FirstPacket);
        assert!(!exposing.fake.is_metering());
        exposing.run(100 * MS, |_| None);
        assert!(exposing.fake.is_metering());
        exposing.fake.light(0.2);
        exposing.run(500 * MS, still);
        assert!(!exposing.fake.is_metering());
        let fake = Rc::clone(&exposing.fake);
        drop(exposing);
        assert!(fake.is_metering() && fake.open_devices() == 0, "after its end");
    }

    #[test]
    fn a_control_that_is_refused_leaves_the_frames_and_is_tried_again() {
        let mut exposing = Loop::new(Stamps::FirstPacket);
        exposing.fake.light(0.2);
        exposing.fake.refuse(Some(CID_EXPOSURE_ABSOLUTE));
        exposing.run(3000 * MS, still);
        assert!(exposing.frames.len() > 250, "{} frames", exposing.frames.len());
        assert!((2..=4).contains(&exposing.refused), "{} refusals", exposing.refused);
        assert!(exposing.fake.is_metering(), "neither sets it");
        exposing.fake.refuse(None);
        exposing.run(2000 * MS, still);
        assert!((0.6..=0.85).contains(&exposing.last().white), "{}", exposing.last().white);
    }

    #[test]
    fn an_exposure_that_cannot_be_read_is_not_taken_over() {
        let mut exposing = Loop::new(Stamps::FirstPacket);
        exposing.fake.light(0.2);
        exposing.fake.hide(Some(CID_EXPOSURE_ABSOLUTE));
        exposing.run(1000 * MS, still);
        assert!(exposing.refused > 0 && exposing.fake.is_metering());
        exposing.fake.hide(None);
        exposing.run(2500 * MS, still);
        assert!(!exposing.fake.is_metering());
        assert!((0.6..=0.85).contains(&exposing.last().white), "{}", exposing.last().white);
    }

    #[test]
    fn the_cameras_own_gain_is_put_back_also_after_a_refusal() {
        let mut exposing = Loop::new(Stamps::FirstPacket);
        exposing.fake.light(0.05);
        exposing.run(1500 * MS, still);
        assert!(exposing.truth().gain > 1.5, "{:?}", exposing.truth());
        exposing.fake.refuse(Some(GAIN));
        exposing.run(2000 * MS, |_| None);
        assert!(exposing.refused > 0 && exposing.truth().gain > 1.5, "{:?}", exposing.truth());
        exposing.fake.refuse(None);
        exposing.run(2000 * MS, |_| None);
        assert!(exposing.truth().gain < 1.01, "{:?}", exposing.truth());
    }

    #[test]
    fn a_camera_that_refuses_a_gain_while_it_meters_gets_its_own_back_before() {
        let mut exposing = Loop::new(Stamps::FirstPacket);
        exposing.fake.choose_gain();
        exposing.fake.light(0.05);
        exposing.run(1500 * MS, still);
        assert!(exposing.truth().gain > 1.5, "{:?}", exposing.truth());
        exposing.run(1500 * MS, |_| None);
        assert!(exposing.truth().gain < 1.01, "{:?}", exposing.truth());
        assert!(exposing.fake.is_metering() && exposing.refused == 0, "{}", exposing.refused);
    }

    #[test]
    fn a_gain_that_is_always_refused_is_given_up_and_the_camera_meters() {
        let mut exposing = Loop::new(Stamps::FirstPacket);
        exposing.fake.light(0.05);
        exposing.run(1500 * MS, still);
        exposing.fake.refuse(Some(GAIN));
        exposing.run(9000 * MS, |_| None);
        assert!(exposing.fake.is_metering());
        assert_eq!(exposing.refused, 5);
    }

    #[test]
    fn the_message_after_each_frame_has_the_setter_the_requested_exposure_and_the_reason() {
        let mut exposing = Loop::new(Stamps::ExposureStart);
        exposing.fake.light(0.2);
        exposing.run(500 * MS, |_| None);
        assert_eq!(exposing.controls.len(), exposing.frames.len());
        let control = exposing.controls.last().unwrap();
        assert_eq!(
            (control.set_by, control.why),
            (ExposureSetter::Camera, ExposureReason::NoMarker)
        );
        assert_eq!((control.in_use, control.wanted, control.levels), (None, None, None));
        assert_eq!(control.limits.unwrap().max_exposure_ns, 5_000_000);
        // A marker is seen, in too little light.
        exposing.controls.clear();
        exposing.run(1000 * MS, still);
        let of = |controls: &[CameraControl], why| {
            controls.iter().find(|control| control.why == why).cloned()
        };
        let taken = of(&exposing.controls, ExposureReason::TakenOver).unwrap();
        assert!(taken.set_by == ExposureSetter::Marker && taken.wanted.is_some(), "{taken:?}");
        let settling = of(&exposing.controls, ExposureReason::Settling).unwrap();
        assert!(settling.in_use.is_none() && settling.wanted.is_some(), "{settling:?}");
        exposing.fake.light(0.05);
        exposing.run(1000 * MS, still);
        let dark = of(&exposing.controls, ExposureReason::TooDark).unwrap();
        let light = |setting: messages::ExposureSetting| {
            f64::from(setting.exposure_ns) * setting.gain.unwrap_or_default()
        };
        assert!(light(dark.wanted.unwrap()) > light(dark.in_use.unwrap()), "{dark:?}");
        let levels = dark.levels.unwrap();
        assert!(levels.white < 0.6 && levels.black < levels.white, "{dark:?}");
        let good = exposing.controls.last().unwrap();
        assert_eq!((good.set_by, good.why), (ExposureSetter::Marker, ExposureReason::Good));
        assert!(good.wanted.is_some() && good.wanted == good.in_use, "{good:?}");
        assert!((0.6..=0.85).contains(&good.levels.unwrap().white), "{good:?}");
        // Suddenly in bright light.
        exposing.controls.clear();
        exposing.fake.light(4.0);
        exposing.run(1000 * MS, still);
        let clipped = of(&exposing.controls, ExposureReason::Clipped).unwrap();
        assert!(clipped.levels.unwrap().white > 0.98, "{clipped:?}");
        assert!(light(clipped.wanted.unwrap()) < light(clipped.in_use.unwrap()), "{clipped:?}");
        // In so little that the largest exposure and gain are not enough.
        exposing.fake.light(0.001);
        exposing.run(1500 * MS, still);
        let limited = exposing.controls.last().unwrap();
        assert_eq!(limited.why, ExposureReason::AtLimits, "{limited:?}");
        let (wanted, limits) = (limited.wanted.unwrap(), limited.limits.unwrap());
        assert_eq!(wanted.exposure_ns, limits.max_exposure_ns);
        assert_eq!(wanted.gain, Some(limits.max_gain));
    }

    #[test]
    fn a_devices_refusal_is_reported_until_it_accepts_an_order() {
        let mut exposing = Loop::new(Stamps::FirstPacket);
        exposing.fake.light(0.2);
        exposing.run(1500 * MS, still);
        assert!(exposing.controls.iter().all(|control| control.refused.is_none()));
        exposing.fake.refuse(Some(CID_EXPOSURE_ABSOLUTE));
        exposing.fake.light(1.0);
        exposing.controls.clear();
        exposing.run(1500 * MS, still);
        // Also while it is not tried again.
        let refused: Vec<_> =
            exposing.controls.iter().filter(|control| control.refused.is_some()).collect();
        assert!(refused.len() > 100, "{} of {}", refused.len(), exposing.controls.len());
        for control in refused {
            let answer = control.refused.as_deref().unwrap();
            assert!(answer.starts_with("VIDIOC_S_EXT_CTRLS: "), "{answer}");
            assert!(control.wanted != control.in_use && control.set_by == ExposureSetter::Marker);
            let is_bright = [ExposureReason::Clipped, ExposureReason::TooBright];
            assert!(is_bright.contains(&control.why), "{control:?}");
        }
        exposing.fake.refuse(None);
        exposing.run(1500 * MS, still);
        let last = exposing.controls.last().unwrap();
        assert_eq!((last.why, &last.refused), (ExposureReason::Good, &None));
    }

    #[test]
    fn the_refusal_of_another_order_is_not_reported_for_a_marker_that_is_lost_meanwhile() {
        let mut exposing = Loop::new(Stamps::FirstPacket);
        exposing.fake.light(0.2);
        exposing.run(1500 * MS, still);
        exposing.fake.refuse(Some(CID_EXPOSURE_ABSOLUTE));
        exposing.fake.light(1.0);
        exposing.run(1000 * MS, still);
        assert!(exposing.controls.last().unwrap().refused.is_some());
        exposing.controls.clear();
        exposing.run(2000 * MS, |_| None);
        let lost =
            exposing.controls.iter().filter(|control| control.why == ExposureReason::NoMarker);
        // No order is given to the device for a second after it refused one.
        let (paused, metering): (Vec<_>, Vec<_>) =
            lost.partition(|control| control.set_by != ExposureSetter::Camera);
        assert!(paused.len() > 10 && metering.len() > 10, "{} {}", paused.len(), metering.len());
        for control in paused {
            assert_eq!(
                (control.set_by, &control.refused),
                (ExposureSetter::Marker, &None),
                "{control:?}"
            );
            assert!(control.in_use.is_some() && control.wanted.is_none(), "{control:?}");
        }
        assert!(metering.iter().all(|control| control.refused.is_none()));
    }

    #[test]
    fn a_camera_without_metering_keeps_its_setting_after_the_marker_is_lost() {
        let setting = Setting { exposure_s: 1e-3, gain: 2.0 };
        let limits = Limits { min_exposure_s: 1e-4, max_exposure_s: 5e-3, max_gain: 16.0 };
        let grey = [0; 64];
        let frame = GrayView::packed(&grey, 8, 8).unwrap();
        for (has_metering, set_by) in
            [(false, ExposureSetter::Fixed), (true, ExposureSetter::Marker)]
        {
            let (ordered, setting) = (Some(setting), Some(setting));
            let (is_metering, is_limited) = (false, false);
            let exposed =
                Exposed { has_metering, is_metering, ordered, setting, limits, is_limited };
            let decision = MarkerExposure::new("down").after(0, frame, &exposed);
            assert_eq!(decision.order, Order::OwnMetering);
            assert_eq!(decision.message(&exposed, None).set_by, set_by);
        }
    }

    #[test]
    fn a_marker_that_is_lost_soon_is_reported_as_the_reason_for_the_cameras_own_metering() {
        let mut exposing = Loop::new(Stamps::ExposureStart);
        exposing.fake.light(0.2);
        exposing.run(500 * MS, still);
        exposing.run(1000 * MS, |_| None);
        exposing.run(500 * MS, still);
        let control = exposing.controls.last().unwrap();
        assert_eq!(
            (control.set_by, control.why),
            (ExposureSetter::Camera, ExposureReason::LostSoon)
        );
        assert!(control.motion_px_s.is_some() && control.wanted.is_none(), "{control:?}");
    }

    #[test]
    fn a_stamp_is_exact_to_a_millisecond_or_marked_also_while_the_exposure_changes() {
        let all = [Stamps::ExposureStart, Stamps::FirstPacket, Stamps::FrameEnd];
        // A reader that needs several periods for a frame finds frames that waited in all buffers.
        for (stamps, needed_ms) in all.into_iter().flat_map(|it| [(it, 0), (it, 35), (it, 80)]) {
            let mut exposing = Loop::new(stamps);
            exposing.needed = Duration::from_millis(needed_ms);
            for light in [0.2, 3.0, 0.4, 0.05] {
                exposing.fake.light(light);
                exposing.run(1000 * MS, still);
            }
            let exact = exposing.frames.iter().filter(|frame| frame.is_exact);
            let worst_ns = exact.clone().map(|frame| frame.error_ns.abs()).max().unwrap();
            let (exact, all) = (exact.count(), exposing.frames.len());
            println!("{stamps:?}, {needed_ms} ms: {exact} of {all} exact, worst {worst_ns} ns");
            assert!(worst_ns <= MS && exact < all, "{worst_ns} {exact}");
            assert!(needed_ms > 0 || exact > all * 3 / 4, "{exact}");
        }
    }
}
