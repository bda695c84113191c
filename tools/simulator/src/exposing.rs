//! How the simulated camera sets exposure and gain: fixed, by the mean of its frames as a camera's own metering does, or for
//! the marker as camera-pub does.

use std::collections::VecDeque;

use imaging::GrayView;
use messages::{ControllerStatus, Detections};
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

    /// Orders the setting that follows from a frame.
    pub(crate) fn taken(&mut self, sequence: u64, stamp_ns: i64, frame: GrayView<'_>) {
        let next = match self.how {
            ExposureKind::Fixed => None,
            ExposureKind::Average => Some(self.by_mean(frame)),
            ExposureKind::Marker => self.for_pad(stamp_ns, frame),
        };
        if let Some(setting) = next {
            self.ordered.push_back(Ordered { sequence: sequence + SETTING_FRAMES, setting });
        }
    }

    /// What the pad makes of it, or without one the camera's own metering.
    fn for_pad(&mut self, stamp_ns: i64, frame: GrayView<'_>) -> Option<Setting> {
        let pad = self.track.at(stamp_ns);
        let is_metered = self.handover.meters_pad(stamp_ns, pad.is_some());
        let Some(pad) = pad.filter(|_| is_metered) else {
            self.control = ExposureControl::default();
            return Some(self.by_mean(frame));
        };
        let (setting, motion_px_s) = (self.setting, pad.motion_px_s);
        let levels = levels(frame, &pad)?;
        self.control.next(&Seen { setting, levels, motion_px_s }, &self.limits)
    }

    /// What the camera's own metering makes of a frame.
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
}
