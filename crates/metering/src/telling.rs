//! What others are told of a camera's exposure, and how often.

use messages::{CameraControl, ExposureLimits, ExposureReason, ExposureSetting, MarkerLevels};

use crate::control::{Limits, Setting};
use crate::region::Levels;

/// Time after which a setting that stays is told again, in nanoseconds: for those who have come since.
const REPEAT_NS: i64 = 1_000_000_000;

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

/// Says which messages are due: each decision for the marker; what the configuration has set when it changes, and once a second.
#[derive(Clone, Debug, Default)]
pub struct Telling {
    last: Option<CameraControl>,
}

impl Telling {
    /// True when this is to be published; at the next call it has been.
    pub fn is_due(&mut self, control: &CameraControl) -> bool {
        let is_known = |last: &CameraControl| {
            let is_same = (last.why, last.set_by, last.in_use)
                == (control.why, control.set_by, control.in_use);
            let age_ns = control.stamp_ns.saturating_sub(last.stamp_ns);
            is_same && (0..REPEAT_NS).contains(&age_ns)
        };
        let is_decision = control.why != ExposureReason::Configured;
        if !is_decision && self.last.as_ref().is_some_and(is_known) {
            return false;
        }
        self.last = Some(control.clone());
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use messages::ExposureSetter;

    #[test]
    fn each_decision_is_told_and_a_fixed_setting_once_a_second_or_when_it_changes() {
        let mut telling = Telling::default();
        let mut is_due = |stamp_ms: i64, why, set_by, exposure_ns| {
            let in_use = Some(ExposureSetting { exposure_ns, gain: None });
            let stamp_ns = stamp_ms * 1_000_000;
            telling.is_due(&CameraControl { stamp_ns, why, set_by, in_use, ..Default::default() })
        };
        let configured = ExposureReason::Configured;
        assert!(is_due(0, configured, ExposureSetter::Fixed, 1000));
        assert!(!is_due(500, configured, ExposureSetter::Fixed, 1000));
        assert!(is_due(600, configured, ExposureSetter::Fixed, 2000));
        assert!(is_due(700, configured, ExposureSetter::Camera, 2000));
        assert!(!is_due(1699, configured, ExposureSetter::Camera, 2000));
        assert!(is_due(1700, configured, ExposureSetter::Camera, 2000));
        for stamp_ms in [1710, 1720] {
            assert!(is_due(stamp_ms, ExposureReason::Good, ExposureSetter::Marker, 2000));
        }
        assert!(is_due(0, configured, ExposureSetter::Fixed, 1000), "its clock began anew");
        assert!(is_due(-1, configured, ExposureSetter::Fixed, 1000));
    }

    #[test]
    fn an_exposure_beyond_any_number_is_the_largest() {
        let setting = Setting { exposure_s: 1e9, gain: 2.0 };
        assert_eq!(ExposureSetting::from(setting).exposure_ns, u32::MAX);
        let setting = Setting { exposure_s: 2.5e-3, gain: 2.0 };
        let told = ExposureSetting { exposure_ns: 2_500_000, gain: Some(2.0) };
        assert_eq!(ExposureSetting::from(setting), told);
    }
}
