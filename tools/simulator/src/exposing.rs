//! Sets exposure and gain of the simulated camera: fixed, by the mean of its frames as a camera's own metering does, or for
//! the marker as camera-pub does. Composes the message about it.

use std::collections::VecDeque;

use imaging::GrayView;
use messages::{CameraControl, ControllerStatus, Detections, ExposureReason, ExposureSetter};
use metering::{ExposureControl, Handover, Limits, PadTrack, Seen, Setting, levels};
use rendering::{CameraSettings, Processing};

use crate::config::{Config, ExposureKind};

/// Number of frames from the one from which a setting follows to the first that is taken with it, as in sensors and their
/// drivers.
const SETTING_FRAMES: u64 = 2;
/// Minimum exposure time, in seconds.
const MIN_EXPOSURE_S: f64 = 20e-6;
/// The mean at which a camera's own metering aims, of full scale: the 18 % of light that a scene reflects as a rule (ISO
/// 2721), where grey levels are in proportion to light, and their level in sRGB.
const MEAN: f64 = 0.18;
const MEAN_TONED: f64 = 0.46;
/// Part of the way that its own metering takes in a step, in stops: that of cameras takes some frames.
const STEP: f64 = 0.5;
/// Maximum number of columns and rows of which the mean is taken.
const MAX_SAMPLES: usize = 64;

/// The settings of the simulated camera, frame by frame.
#[derive(Debug)]
pub(crate) struct Exposing {
    how: ExposureKind,
    limits: Limits,
    mean: f64,
    track: PadTrack,
    handover: Handover,
    control: ExposureControl,
    setting: Setting,
    /// Those that later frames are taken with, in their order.
    ordered: VecDeque<Ordered>,
}

#[derive(Copy, Clone, Debug)]
struct Ordered {
    /// The first frame that is taken with it.
    sequence: u64,
    setting: Setting,
}

/// The result of a frame.
#[derive(Default)]
struct Decision {
    /// The setting for later frames; `None` when nothing changes.
    next: Option<Setting>,
    /// The message about it, without the settings.
    control: CameraControl,
}

impl Exposing {
    /// Begins with the exposure of `settings`.
    pub(crate) fn new(config: &Config, settings: &CameraSettings) -> Self {
        let camera = &config.camera;
        let is_linear = settings.processing == Processing::LINEAR;
        Self {
            how: camera.exposure,
            limits: Limits {
                min_exposure_s: MIN_EXPOSURE_S,
                max_exposure_s: camera.max_exposure_ms * 1e-3,
                max_gain: camera.max_gain,
            },
            mean: if is_linear { MEAN } else { MEAN_TONED },
            track: PadTrack::new(&camera.name),
            handover: Handover::default(),
            control: ExposureControl::default(),
            setting: Setting { exposure_s: settings.exposure_s, gain: settings.gain },
            ordered: VecDeque::new(),
        }
    }

    /// Opens the shutter for a frame, and returns with which setting.
    pub(crate) fn open(&mut self, sequence: u64) -> Setting {
        while let Some(due) = self.ordered.pop_front_if(|due| due.sequence <= sequence) {
            self.setting = due.setting;
        }
        self.setting
    }

    /// Takes a detector's message.
    pub(crate) fn detected(&mut self, message: &Detections) {
        self.track.update(message);
    }

    /// Takes a controller's status.
    pub(crate) fn follow(&mut self, status: &ControllerStatus) {
        self.track.follow(status);
    }

    /// Orders the setting that follows from a frame, and returns the message about it.
    pub(crate) fn taken(
        &mut self,
        sequence: u64,
        stamp_ns: i64,
        frame: GrayView<'_>,
    ) -> CameraControl {
        let decision = match self.how {
            ExposureKind::Fixed => Decision::default(),
            ExposureKind::Average => Decision {
                next: Some(self.by_mean(frame)),
                control: CameraControl {
                    set_by: ExposureSetter::Camera,
                    ..CameraControl::default()
                },
            },
            ExposureKind::Marker => self.for_pad(stamp_ns, frame),
        };
        let Decision { next, control } = decision;
        if let Some(setting) = next {
            self.ordered.push_back(Ordered { sequence: sequence + SETTING_FRAMES, setting });
        }
        let last = self.ordered.back().map_or(self.setting, |last| last.setting);
        let is_wanted = control.set_by == ExposureSetter::Marker;
        // A camera that meters on its own does not report its setting.
        let is_known = control.set_by != ExposureSetter::Camera;
        CameraControl {
            in_use: is_known.then(|| self.setting.into()),
            wanted: is_wanted.then(|| last.into()),
            ..control
        }
    }

    /// The decision for the pad, or without one that of the camera's own metering.
    fn for_pad(&mut self, stamp_ns: i64, frame: GrayView<'_>) -> Decision {
        let pad = self.track.at(stamp_ns);
        let is_metered = self.handover.meters_pad(stamp_ns, pad.is_some());
        let without_levels = CameraControl {
            set_by: ExposureSetter::Marker,
            why: ExposureReason::NotInFrame,
            motion_px_s: pad.map(|pad| pad.motion_px_s),
            limits: Some(self.limits.into()),
            ..CameraControl::default()
        };
        let Some(pad) = pad.filter(|_| is_metered) else {
            self.control = ExposureControl::default();
            let why = match pad {
                Some(_) => ExposureReason::LostSoon,
                None => ExposureReason::NoMarker,
            };
            let control = CameraControl { set_by: ExposureSetter::Camera, why, ..without_levels };
            return Decision { next: Some(self.by_mean(frame)), control };
        };
        let Some(levels) = levels(frame, &pad) else {
            return Decision { next: None, control: without_levels };
        };
        let seen = Seen { setting: self.setting, levels, motion_px_s: pad.motion_px_s };
        let step = self.control.next(&seen, &self.limits);
        let control = CameraControl {
            why: step.why,
            levels: Some(levels.into()),
            limits: Some(step.limits.into()),
            ..without_levels
        };
        Decision { next: step.next, control }
    }

    /// The setting that the camera's own metering derives from a frame.
    fn by_mean(&self, frame: GrayView<'_>) -> Setting {
        let (across, down) = (frame.width() / MAX_SAMPLES + 1, frame.height() / MAX_SAMPLES + 1);
        let (mut sum, mut count) = (0.0, 0.0);
        for y in (0..frame.height()).step_by(down) {
            for level in frame.row(y).iter().step_by(across) {
                sum += f64::from(*level);
                count += 1.0;
            }
        }
        let mean = (sum / count / 255.0).max(1.0 / 255.0);
        let light = self.setting.exposure_s * self.setting.gain * (self.mean / mean).powf(STEP);
        let Limits { min_exposure_s, max_exposure_s, max_gain } = self.limits;
        let exposure_s = light.clamp(min_exposure_s, max_exposure_s.max(min_exposure_s));
        Setting { exposure_s, gain: (light / exposure_s).clamp(1.0, max_gain) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use imaging::GrayImage;
    use node::Layers;

    fn exposing(set: &[&str]) -> Exposing {
        let set = set.iter().map(|setting| (*setting).to_owned()).collect();
        let config = Layers { file: None, set }.load::<Config>().unwrap().settings;
        Exposing::new(&config, &config.camera_settings())
    }

    #[test]
    fn a_setting_comes_into_force_two_frames_later() {
        let mut exposing = exposing(&["camera.exposure=average"]);
        let first = exposing.open(7);
        let dark = GrayImage::filled(64, 48, 10);
        exposing.taken(7, 0, dark.view().unwrap());
        assert_eq!(exposing.open(8), first);
        assert!(exposing.open(9).exposure_s > first.exposure_s);
    }

    #[test]
    fn its_own_metering_brings_the_mean_to_its_level_and_a_fixed_exposure_stays() {
        let linear = "camera.processing=linear";
        let mut average = exposing(&["camera.exposure=average", "camera.max_gain=16", linear]);
        let mut fixed = exposing(&["camera.exposure=fixed"]);
        let first = fixed.open(0);
        // Grey of a reflectance of 10 % under a light of which 1 ms makes full scale.
        let mut level = 0.0;
        for sequence in 0..40 {
            let setting = average.open(sequence);
            level = 0.1 * setting.exposure_s * setting.gain / 1e-3;
            let image = GrayImage::filled(64, 48, (255.0 * level) as u8);
            average.taken(sequence, 0, image.view().unwrap());
            fixed.taken(sequence, 0, image.view().unwrap());
        }
        assert!((0.17..0.19).contains(&level), "{level}");
        assert_eq!(fixed.open(40), first);
    }

    #[test]
    fn the_message_has_the_setter_the_requested_exposure_and_the_reason() {
        let linear = "camera.processing=linear";
        let mut marker = exposing(&["camera.exposure=marker", "camera.max_gain=16", linear]);
        let dark = GrayImage::filled(64, 48, 10);
        marker.open(0);
        let control = marker.taken(0, 0, dark.view().unwrap());
        assert_eq!(
            (control.set_by, control.why),
            (ExposureSetter::Camera, ExposureReason::NoMarker)
        );
        assert_eq!((control.in_use, control.wanted), (None, None));
        assert!(control.limits.is_some());
        let mut found = Detections::sample();
        found.header.camera = "down".to_owned();
        (found.detections[0].centre_px, found.detections[0].size_px) = ([32.0, 24.0], 40.0);
        marker.detected(&found);
        let setting = marker.open(1);
        let control = marker.taken(1, 66_000_000, dark.view().unwrap());
        assert_eq!(
            (control.set_by, control.why),
            (ExposureSetter::Marker, ExposureReason::TooDark)
        );
        assert_eq!(control.in_use, Some(setting.into()));
        assert!(
            control.wanted.unwrap().exposure_ns > control.in_use.unwrap().exposure_ns,
            "{control:?}"
        );
        assert!(control.levels.unwrap().white < 0.05, "{control:?}");
        let mut fixed = exposing(&["camera.exposure=fixed"]);
        let setting = fixed.open(0);
        let control = fixed.taken(0, 0, dark.view().unwrap());
        assert_eq!(
            (control.set_by, control.why),
            (ExposureSetter::Fixed, ExposureReason::Configured)
        );
        assert_eq!(control.in_use, Some(setting.into()));
        let mut average = exposing(&["camera.exposure=average"]);
        let control = average.taken(0, 0, dark.view().unwrap());
        assert_eq!(
            (control.set_by, control.why),
            (ExposureSetter::Camera, ExposureReason::Configured)
        );
        assert_eq!((control.in_use, control.wanted), (None, None));
    }
}
