//! Implements the exposure loop: from the levels of the pad's white in a frame, its motion and the camera's limits to the next
//! exposure time and gain, with the reason.

use messages::ExposureReason;

use crate::region::Levels;

/// The grey level that the pad's white shall have, of full scale: in the middle, as factors go, of [`GOOD`].
const TARGET: f64 = 0.72;
/// Levels of white at which nothing is changed: within 60 to 85 % of full scale, with room for noise.
const GOOD: std::ops::RangeInclusive<f64> = 0.63..=0.82;
/// The level from which on white is clipped, and how much brighter it is remains open.
const CLIPPED: f64 = 0.98;
/// How much brighter clipped white is at least taken to be than full scale: halves the light once it is near.
const MIN_CLIPPED: f64 = 1.4;
/// White and black that are both clipped: three stops down.
const ALL_CLIPPED: f64 = 8.0 * TARGET;
/// How much brighter white is than black when white is clipped. Prints have 10 to 20; haze, and the lens, take from that.
const WHITE_PER_BLACK: f64 = 8.0;
/// A region that is lighter than this and has less contrast shows no pad.
const MAX_FLAT: f64 = 0.1;
const MIN_CONTRAST: f64 = 1.3;
/// Maximum change in one step.
const MAX_STEP: f64 = 64.0;
/// Maximum blur by motion during the exposure, in pixels.
const MAX_BLUR_PX: f64 = 1.0;
/// How much longer than the blur allows an exposure stays as it is, and how much shorter, when gain compensates:
/// a setting that changes with every frame never settles in a camera that needs some frames for a change.
const LONGER: f64 = 1.1;
const SHORTER: f64 = 0.6;
/// Smaller changes are ignored.
const MIN_CHANGE: f64 = 0.03;
/// Exponent on the next steps, relative to before, where one goes back: the last one went too far.
const BACK_EXPONENT: f64 = 0.5;
const MIN_EXPONENT: f64 = 0.125;

/// An exposure time and a gain.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Setting {
    /// Exposure time, in seconds.
    pub exposure_s: f64,
    /// How much brighter the frame is than at the sensor's smallest gain; from 1.
    pub gain: f64,
}

/// The range of a camera's settings.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Limits {
    /// Minimum exposure time, in seconds.
    pub min_exposure_s: f64,
    /// Maximum exposure time, in seconds.
    pub max_exposure_s: f64,
    /// Maximum gain.
    pub max_gain: f64,
}

/// A frame of the pad.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Seen {
    /// The setting with which this frame was taken, also after another one was ordered.
    pub setting: Setting,
    /// The pad's levels in it.
    pub levels: Levels,
    /// How fast the pad moves, in pixels per second.
    pub motion_px_s: f64,
}

/// The result of a frame.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Step {
    /// The setting for the next frames; `None` when that of this frame stays.
    pub next: Option<Setting>,
    /// Why.
    pub why: ExposureReason,
    /// The limits within which it is chosen: those of the camera, and no longer an exposure than the motion allows.
    pub limits: Limits,
}

impl Setting {
    /// How much light it makes of the same scene, relative to others.
    fn light(self) -> f64 {
        self.exposure_s * self.gain
    }
}

/// The loop from a frame's levels to the next setting.
///
/// The step follows from the frame's own setting, so that frames which were under way when a setting was ordered are not
/// counted twice. It takes grey levels to be proportional to light. Tone curves rise more slowly, so that it is then too small:
/// exact after one step for a linear camera, after a few for others. Of clipped white it is only known that it is too much; black
/// shows how much. A gain that is not proportional to its control's value, as one in decibels, may make a step too
/// large: a step back, and those after it, is reduced to its square root until white is good.
#[derive(Clone, Debug)]
pub struct ExposureControl {
    /// The last step as it would be without an exponent; 1 for none.
    last_step: f64,
    exponent: f64,
}

impl Default for ExposureControl {
    fn default() -> Self {
        Self { last_step: 1.0, exponent: 1.0 }
    }
}

impl ExposureControl {
    /// The setting for the next frames; none when that of this frame is good, or the region shows no pad.
    pub fn next(&mut self, seen: &Seen, limits: &Limits) -> Step {
        let Levels { white, black } = seen.levels;
        let sharp = limits.without_blur(seen.motion_px_s);
        let is_flat = white < MIN_CONTRAST * black && white < CLIPPED;
        if black > MAX_FLAT && is_flat {
            return Step { next: None, why: ExposureReason::NoContrast, limits: sharp };
        }
        let is_good = GOOD.contains(&white);
        let step = if is_good {
            *self = Self::default();
            1.0
        } else {
            self.damped(brightness(seen.levels))
        };
        let light = seen.setting.light() * step.clamp(1.0 / MAX_STEP, MAX_STEP);
        let next = share(light, &sharp);
        let is_sharp = seen.setting.exposure_s <= LONGER * next.exposure_s;
        let is_long = seen.setting.exposure_s >= SHORTER * next.exposure_s;
        let is_same = |now: f64, next: f64| (next / now - 1.0).abs() < MIN_CHANGE;
        let stays = is_same(seen.setting.exposure_s, next.exposure_s)
            && is_same(seen.setting.gain, next.gain);
        let why = match is_good {
            true if is_sharp && is_long => ExposureReason::Good,
            true if is_sharp => ExposureReason::LessNoise,
            true => ExposureReason::MotionBlur,
            // White is not good then, and stays as it is: there is no more light within the limits, or the step is too small.
            false if stays && is_same(light, next.light()) => ExposureReason::Good,
            false
                if stays
                    && sharp.max_exposure_s < limits.max_exposure_s
                    && next.light() < light =>
            {
                ExposureReason::MotionBlur
            }
            false if stays => ExposureReason::AtLimits,
            false if white >= CLIPPED => ExposureReason::Clipped,
            false if white > *GOOD.end() => ExposureReason::TooBright,
            false => ExposureReason::TooDark,
        };
        let is_change = why != ExposureReason::Good
            && !stays
            && next.exposure_s.is_finite()
            && next.gain.is_finite();
        Step { next: is_change.then_some(next), why, limits: sharp }
    }

    /// The step in light from white of this brightness.
    fn damped(&mut self, brightness: f64) -> f64 {
        let step = TARGET / brightness;
        if (step - 1.0) * (self.last_step - 1.0) < 0.0 {
            self.exponent = (self.exponent * BACK_EXPONENT).max(MIN_EXPONENT);
        }
        self.last_step = step;
        let damped = step.powf(self.exponent);
        // A step that is too small to be made would leave white where it is not good.
        let min = 1.0 + 1.01 * MIN_CHANGE;
        if step > 1.0 { damped.max(min.min(step)) } else { damped.min((2.0 - min).max(step)) }
    }
}

/// How bright white is, of full scale; estimated where it is clipped, or too dark for a level of its own.
fn brightness(levels: Levels) -> f64 {
    let Levels { white, black } = levels;
    match (white >= CLIPPED, black >= CLIPPED) {
        (true, true) => ALL_CLIPPED,
        (true, false) => (WHITE_PER_BLACK * black).max(MIN_CLIPPED),
        _ => white.max(0.5 / 255.0),
    }
}

impl Limits {
    /// The same with no longer an exposure than one in which this motion blurs by [`MAX_BLUR_PX`].
    fn without_blur(&self, motion_px_s: f64) -> Self {
        let sharp_s = if motion_px_s > 0.0 { MAX_BLUR_PX / motion_px_s } else { f64::INFINITY };
        let max_exposure_s = sharp_s.min(self.max_exposure_s).max(self.min_exposure_s);
        Self { max_exposure_s, ..*self }
    }
}

/// Shares light between exposure, as long as the limits allow, and gain.
fn share(light: f64, limits: &Limits) -> Setting {
    let exposure_s = light.min(limits.max_exposure_s).max(limits.min_exposure_s);
    let gain = (light / exposure_s).clamp(1.0, limits.max_gain.max(1.0));
    Setting { exposure_s, gain }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const LIMITS: Limits = Limits { min_exposure_s: 20e-6, max_exposure_s: 8e-3, max_gain: 64.0 };
    /// 1/16 of white's reflectance.
    const BLACK: f64 = 1.0 / 16.0;

    /// A camera in some light, with a tone curve.
    struct Camera {
        /// White's level at an exposure of one second and gain 1.
        light: f64,
        gamma: f64,
        /// Its gain is in decibels: the logarithm of the true gain grows with the value that is set.
        in_decibels: bool,
    }

    impl Camera {
        fn levels(&self, setting: Setting) -> Levels {
            let Setting { exposure_s, gain } = setting;
            let part = (gain - 1.0) / (LIMITS.max_gain - 1.0);
            let gain = if self.in_decibels { LIMITS.max_gain.powf(part) } else { gain };
            let level = |reflectance: f64| {
                let light: f64 = self.light * exposure_s * gain * reflectance;
                (light.min(1.0).powf(1.0 / self.gamma) * 255.0).round() / 255.0
            };
            Levels { white: level(1.0), black: level(BLACK) }
        }

        /// Number of settings until nothing is changed any more, and the last one.
        fn settle(&self, mut setting: Setting, motion_px_s: f64) -> Settled {
            let mut control = ExposureControl::default();
            for steps in 0..40 {
                let seen = Seen { setting, levels: self.levels(setting), motion_px_s };
                match control.next(&seen, &LIMITS).next {
                    Some(next) => setting = next,
                    None => return Settled { steps, setting, white: seen.levels.white },
                }
            }
            panic!("it never settles: {setting:?}");
        }
    }

    #[derive(Debug)]
    struct Settled {
        steps: u32,
        setting: Setting,
        white: f64,
    }

    #[test]
    fn six_stops_of_light_are_made_up_for_in_a_few_steps() {
        for (gamma, max_steps) in [(1.0, 5), (2.2, 6)] {
            let day = Camera { light: 200.0, gamma, in_decibels: false };
            let before = day.settle(Setting { exposure_s: 1e-3, gain: 1.0 }, 0.0);
            for stops in -6..=6 {
                let light = 200.0 * f64::powi(2.0, stops);
                let camera = Camera { light, gamma, in_decibels: false };
                let after = camera.settle(before.setting, 0.0);
                assert!((0.6..=0.85).contains(&after.white), "{gamma} {stops}: {after:?}");
                assert!(after.steps <= max_steps, "{gamma} {stops}: {after:?}");
            }
        }
    }

    #[test]
    fn gain_comes_second_and_an_exposure_never_blurs_by_more_than_a_pixel() {
        let camera = Camera { light: 200.0, gamma: 1.0, in_decibels: false };
        let still = camera.settle(Setting { exposure_s: 1e-3, gain: 16.0 }, 0.0);
        assert_eq!(still.setting.gain, 1.0, "{still:?}");
        let moving = camera.settle(still.setting, 1000.0);
        assert!(moving.setting.exposure_s <= 1.1e-3 && moving.setting.gain > 3.0, "{moving:?}");
        assert!((0.6..=0.85).contains(&moving.white), "{moving:?}");
        let again = camera.settle(moving.setting, 0.0);
        assert_eq!(again.setting.gain, 1.0, "{again:?}");
    }

    #[test]
    fn in_the_dark_it_stays_at_the_limits() {
        let night = Camera { light: 0.3, gamma: 1.0, in_decibels: false };
        let settled = night.settle(Setting { exposure_s: 1e-3, gain: 1.0 }, 500.0);
        assert_eq!(settled.setting, Setting { exposure_s: 2e-3, gain: 64.0 });
    }

    #[test]
    fn small_steps_back_and_forth_do_not_end_before_white_is_good() {
        let light = 0.72 / (8e-3 * 64.0f64.powf(0.898_634_454_564_418_5));
        let camera = Camera { light, gamma: 1.0, in_decibels: true };
        let setting = Setting { exposure_s: 8e-3, gain: 63.367_703_816_352_716 };
        let settled = camera.settle(setting, 0.0);
        assert!((0.6..=0.85).contains(&settled.white), "{settled:?}");
    }

    #[test]
    fn a_region_without_contrast_changes_nothing() {
        let setting = Setting { exposure_s: 1e-3, gain: 2.0 };
        let seen =
            |white, black| Seen { setting, levels: Levels { white, black }, motion_px_s: 0.0 };
        let next =
            |white, black| ExposureControl::default().next(&seen(white, black), &LIMITS).next;
        assert_eq!(next(0.5, 0.45), None);
        assert!(next(0.5, 0.05).is_some());
        // Far too light, and far too dark.
        assert!(next(1.0, 1.0).is_some_and(|next| next.light() < 3e-4));
        assert!(next(0.0, 0.0).is_some_and(|next| next.light() > 0.1));
    }

    #[test]
    fn the_reason_is_the_error_of_white_or_the_limit_that_causes_it() {
        let why = |exposure_s, gain, white, motion_px_s| {
            let (setting, levels) =
                (Setting { exposure_s, gain }, Levels { white, black: white / 16.0 });
            let step =
                ExposureControl::default().next(&Seen { setting, levels, motion_px_s }, &LIMITS);
            (step.why, step.next.is_some())
        };
        for (is, exposure_s, gain, white, motion_px_s, changes) in [
            (ExposureReason::Good, 8e-3, 1.0, 0.7, 0.0, false),
            (ExposureReason::Good, 1e-3, 4.0, 0.7, 1000.0, false),
            (ExposureReason::Clipped, 1e-3, 1.0, 1.0, 0.0, true),
            (ExposureReason::TooBright, 1e-3, 1.0, 0.9, 0.0, true),
            (ExposureReason::TooDark, 1e-3, 1.0, 0.3, 0.0, true),
            (ExposureReason::MotionBlur, 8e-3, 1.0, 0.7, 1000.0, true),
            (ExposureReason::LessNoise, 1e-3, 8.0, 0.7, 0.0, true),
            // No more light within the limits: those of the camera, or, as it moves, of a sharp frame.
            (ExposureReason::AtLimits, 8e-3, 64.0, 0.1, 0.0, false),
            (ExposureReason::AtLimits, 20e-6, 1.0, 1.0, 1000.0, false),
            (ExposureReason::MotionBlur, 1e-3, 64.0, 0.1, 1000.0, false),
        ] {
            assert_eq!(why(exposure_s, gain, white, motion_px_s), (is, changes), "{exposure_s}");
        }
        let flat = Levels { white: 0.5, black: 0.45 };
        let setting = Setting { exposure_s: 1e-3, gain: 1.0 };
        let seen = Seen { setting, levels: flat, motion_px_s: 500.0 };
        let step = ExposureControl::default().next(&seen, &LIMITS);
        assert_eq!((step.next, step.why), (None, ExposureReason::NoContrast));
        assert_eq!(step.limits, Limits { max_exposure_s: 2e-3, ..LIMITS });
    }

    proptest! {
        /// White settles and stays with any tone curve, in any light in which the limits allow it.
        #[test]
        fn white_settles_within_its_range(
            stops in -7.0..7.0f64, gamma in 1.0..2.4f64,
            exposure_s in 20e-6..8e-3f64, gain in 1.0..64.0f64, motion_px_s in 0.0..1000.0f64,
        ) {
            let camera = Camera { light: 200.0 * stops.exp2(), gamma, in_decibels: false };
            let needed = 0.72f64.powf(gamma) / camera.light;
            let fastest = (1.0 / motion_px_s.max(1.0)).min(8e-3);
            prop_assume!((40e-6..0.8 * 64.0 * fastest).contains(&needed));
            let settled = camera.settle(Setting { exposure_s, gain }, motion_px_s);
            prop_assert!((0.6..=0.85).contains(&settled.white), "{settled:?}");
            prop_assert!(settled.setting.exposure_s * motion_px_s <= 1.1 + 1e-9, "{settled:?}");
            prop_assert!(settled.steps <= 10, "{settled:?}");
        }

        /// Also where the gain is not proportional to its value, though in more steps.
        #[test]
        fn white_settles_with_a_gain_in_decibels(
            part in 0.02..0.98f64, gamma in 1.0..2.4f64, gain in 1.0..64.0f64,
        ) {
            // As much light as this part of the gain needs at the maximum exposure.
            let light = 0.72f64.powf(gamma) / (8e-3 * 64.0f64.powf(part));
            let camera = Camera { light, gamma, in_decibels: true };
            let settled = camera.settle(Setting { exposure_s: 8e-3, gain }, 0.0);
            prop_assert!((0.6..=0.85).contains(&settled.white), "{settled:?}");
            prop_assert!(settled.steps <= 20, "{settled:?}");
        }

        #[test]
        fn any_setting_is_within_the_limits(
            exposure_s: f64, gain: f64, white: f64, black: f64, motion_px_s: f64,
        ) {
            let levels = Levels { white, black };
            let seen = Seen { setting: Setting { exposure_s, gain }, levels, motion_px_s };
            if let Some(next) = ExposureControl::default().next(&seen, &LIMITS).next {
                prop_assert!((20e-6..=8e-3).contains(&next.exposure_s), "{next:?}");
                prop_assert!((1.0..=64.0).contains(&next.gain), "{next:?}");
            }
        }
    }
}
