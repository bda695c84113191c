//! Decides when a camera's exposure is published again as `CameraControl`: a change of setting, reason, refusal or setter at
//! once; an unchanged exposure, with levels and limits that differ in each frame, at intervals.

use messages::{CameraControl, ExposureLimits, ExposureReason, ExposureSetting, MarkerLevels};

use crate::control::{Limits, Setting};
use crate::region::Levels;

/// Time after which an unchanged exposure is published again, in nanoseconds: for new subscribers.
const REPEAT_NS: i64 = 1_000_000_000;
/// The same while the exposure follows a marker, whose levels and motion are published as well.
const MARKER_REPEAT_NS: i64 = 200_000_000;

impl From<Setting> for ExposureSetting {
    fn from(setting: Setting) -> Self {
        Self { exposure_ns: nanoseconds(setting.exposure_s), gain: Some(setting.gain) }
    }
}

impl From<Levels> for MarkerLevels {
    fn from(levels: Levels) -> Self {
        Self { white: levels.white, black: levels.black }
    }
}

impl From<Limits> for ExposureLimits {
    fn from(limits: Limits) -> Self {
        Self {
            min_exposure_ns: nanoseconds(limits.min_exposure_s),
            max_exposure_ns: nanoseconds(limits.max_exposure_s),
            max_gain: limits.max_gain,
        }
    }
}

fn nanoseconds(time_s: f64) -> u32 {
    // Saturates: more than four seconds is no exposure.
    (time_s * 1e9).round() as u32
}

/// Decides which messages are due: each change at once, an unchanged exposure once a second, or five times a second while a
/// marker is seen. Levels, motion and limits do not count as a change: they differ in each frame.
#[derive(Clone, Debug, Default)]
pub struct ControlThrottle {
    last: Option<CameraControl>,
}

impl ControlThrottle {
    /// True when this message is to be published; the next call compares with it.
    pub fn is_due(&mut self, control: &CameraControl) -> bool {
        let repeat_ns = match control.why {
            ExposureReason::Configured | ExposureReason::NoMarker => REPEAT_NS,
            _ => MARKER_REPEAT_NS,
        };
        let is_known = self.last.as_ref().is_some_and(|last| {
            let age_ns = control.stamp_ns.saturating_sub(last.stamp_ns);
            decided(last) == decided(control) && (0..repeat_ns).contains(&age_ns)
        });
        if !is_known {
            self.last = Some(control.clone());
        }
        !is_known
    }
}

/// The fields that are published at once when they change.
fn decided(control: &CameraControl) -> impl PartialEq {
    (control.why, control.set_by, control.wanted, control.in_use, control.refused.as_deref())
}

#[cfg(test)]
mod tests {
    use super::*;
    use messages::ExposureSetter;

    #[test]
    fn a_fixed_setting_is_published_once_a_second_or_when_it_changes() {
        let mut throttle = ControlThrottle::default();
        let mut is_due = |stamp_ms: i64, set_by, exposure_ns| {
            let in_use = Some(ExposureSetting { exposure_ns, gain: None });
            let stamp_ns = stamp_ms * 1_000_000;
            throttle.is_due(&CameraControl { stamp_ns, set_by, in_use, ..Default::default() })
        };
        assert!(is_due(0, ExposureSetter::Fixed, 1000));
        assert!(!is_due(500, ExposureSetter::Fixed, 1000));
        assert!(is_due(600, ExposureSetter::Fixed, 2000));
        assert!(is_due(700, ExposureSetter::Camera, 2000));
        assert!(!is_due(1699, ExposureSetter::Camera, 2000));
        assert!(is_due(1700, ExposureSetter::Camera, 2000));
        assert!(is_due(0, ExposureSetter::Camera, 2000), "its clock began again");
        assert!(is_due(-1, ExposureSetter::Camera, 2000));
    }

    /// The number of messages that are due in ten seconds of 100 frames each, of which each one is made by `control`.
    fn due_in_ten_seconds(control: impl Fn(u32) -> CameraControl) -> usize {
        let mut throttle = ControlThrottle::default();
        let stamped = |frame: u32| {
            let stamp_ns = i64::from(frame) * 10_000_000;
            CameraControl { stamp_ns, ..control(frame) }
        };
        (0..1000).filter(|frame| throttle.is_due(&stamped(*frame))).count()
    }

    #[test]
    fn an_unchanged_exposure_is_not_published_at_the_rate_of_the_camera() {
        let of = |why| {
            due_in_ten_seconds(|frame| {
                let noise = f64::from(frame % 7);
                let levels = Some(MarkerLevels { white: 0.7 + 0.01 * noise, black: 0.1 });
                let set_by = ExposureSetter::Marker;
                let motion_px_s = Some(noise);
                CameraControl { why, set_by, levels, motion_px_s, ..CameraControl::default() }
            })
        };
        assert_eq!(of(ExposureReason::NoMarker), 10);
        let seen = [ExposureReason::LostSoon, ExposureReason::Settling, ExposureReason::Good];
        for why in seen {
            assert_eq!(of(why), 50, "{why:?}");
        }
    }

    #[test]
    fn each_change_is_published_at_once() {
        let setting = |exposure_ns| Some(ExposureSetting { exposure_ns, gain: Some(1.0) });
        let good = || CameraControl { why: ExposureReason::Good, ..CameraControl::default() };
        let changes: [&dyn Fn(u32) -> CameraControl; 5] = [
            &|frame| CameraControl { in_use: setting(frame), ..good() },
            &|frame| CameraControl { wanted: setting(frame), ..good() },
            &|frame| CameraControl { refused: Some(frame.to_string()), ..good() },
            &|frame| {
                let whys = [ExposureReason::TakenOver, ExposureReason::Settling];
                CameraControl { why: whys[frame as usize % 2], ..good() }
            },
            &|frame| {
                let setters = [ExposureSetter::Camera, ExposureSetter::Marker];
                CameraControl { set_by: setters[frame as usize % 2], ..good() }
            },
        ];
        for change in changes {
            assert_eq!(due_in_ten_seconds(change), 1000);
        }
    }

    #[test]
    fn an_exposure_beyond_any_number_is_the_largest() {
        let setting = Setting { exposure_s: 1e9, gain: 2.0 };
        assert_eq!(ExposureSetting::from(setting).exposure_ns, u32::MAX);
        let setting = Setting { exposure_s: 2.5e-3, gain: 2.0 };
        let message = ExposureSetting { exposure_ns: 2_500_000, gain: Some(2.0) };
        assert_eq!(ExposureSetting::from(setting), message);
    }
}
