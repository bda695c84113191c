//! Models a camera's response to light, linear or with a tone curve and sharpened: the whiteness shown for a fraction of white,
//! with derivatives.
//!
//! After an unknown monotonic curve and a symmetric kernel a blurred edge has another shape and another position. Both are
//! those of every other edge between the same black and white, so that a marker that is not small gives both numbers on its
//! own.

use crate::response::{Measured, ResponseEstimate};

/// Standard deviation of the kernel with which cameras sharpen, in pixels.
pub(crate) const SHARPENING_PX: f64 = 1.0;

/// Steepest tone curve at black, less 1: that of a camera module of the Raspberry Pi is 3 between black ink and white
/// paper.
const MAX_CURVE: f64 = 4.0;

/// A camera's processing of an image that is linear in light.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct CameraResponse {
    /// The tone curve `(1 + c) w / (1 + c w)` of a whiteness from 0 to 1: 0 is linear, about 1 is nearly sRGB.
    pub(crate) curve: f64,
    /// Amount of an unsharp mask with a kernel of [`SHARPENING_PX`].
    pub(crate) sharpening: f64,
}

/// The whiteness that a camera shows, with its derivatives.
#[derive(Copy, Clone, Debug)]
pub(crate) struct ShownWhiteness {
    pub(crate) white: f64,
    /// By the whiteness, and by that blurred further.
    pub(crate) by_own: f64,
    pub(crate) by_blurred: f64,
    /// By the ratio of the two blurs.
    pub(crate) by_ratio: f64,
    /// By curve and sharpening.
    pub(crate) by_response: [f64; 2],
}

impl CameraResponse {
    pub(crate) const LINEAR: Self = Self { curve: 0.0, sharpening: 0.0 };
    /// The typical response: a start for a fit.
    pub(crate) const ORDINARY: Self = Self { curve: 1.0, sharpening: 0.0 };
    /// The prior of the curve, before a marker gives an estimate: sRGB's is 1.1, that of a Raspberry Pi's camera module 3.
    pub(crate) const CURVE_PRIOR: Measured = Measured { value: 1.2, deviation: 0.7 };
    /// Unsharp masks of consumer cameras have about 0.2 to 0.6.
    pub(crate) const SHARPENING_PRIOR: Measured = Measured { value: 0.4, deviation: 0.2 };
    /// The grey level of black ink as a fraction of white paper's: ink that reflects a twentieth of the light shows a tenth of
    /// it with a gamma of 1.25, a quarter with sRGB's curve; sharpening lowers it, glare lifts it.
    pub(crate) const BLACK_PRIOR: Measured = Measured { value: 0.2, deviation: 0.1 };

    /// As it is known before a fit.
    pub(crate) fn known(known: &ResponseEstimate) -> Self {
        Self::LINEAR.moved([known.curve.value, known.sharpening.value])
    }

    /// After a step of a fit, within the range of cameras.
    pub(crate) fn moved(&self, [curve, sharpening]: [f64; 2]) -> Self {
        Self {
            curve: (self.curve + curve).clamp(-0.25, MAX_CURVE),
            sharpening: (self.sharpening + sharpening).clamp(0.0, 2.0),
        }
    }

    /// The whiteness shown, of a place's own whiteness and of that blurred further by the sharpening's kernel, to
    /// `1 / blur_ratio` times the blur.
    #[inline]
    pub(crate) fn shown(&self, own: f64, blurred: f64, blur_ratio: f64) -> ShownWhiteness {
        let Self { curve, sharpening } = *self;
        let (sharp, wide) = (Tone::at(own, curve), Tone::at(blurred, curve));
        let shown = own + sharp.added;
        // The curve's addition at an edge is as wide as the blur; the kernel spreads it and keeps its integral.
        let shown_blurred = blurred + blur_ratio * wide.added;
        ShownWhiteness {
            white: (1.0 + sharpening) * shown - sharpening * shown_blurred,
            by_own: (1.0 + sharpening) * sharp.slope,
            by_blurred: -sharpening * (1.0 + blur_ratio * (wide.slope - 1.0)),
            by_ratio: -sharpening * wide.added,
            by_response: [
                (1.0 + sharpening) * sharp.by_curve - sharpening * blur_ratio * wide.by_curve,
                shown - shown_blurred,
            ],
        }
    }
}

/// The tone curve at one whiteness.
struct Tone {
    /// Its addition, with derivatives by the whiteness and by the curve.
    added: f64,
    slope: f64,
    by_curve: f64,
}

impl Tone {
    #[inline]
    fn at(white: f64, curve: f64) -> Self {
        let per = 1.0 / (1.0 + curve * white);
        let mixed = white * (1.0 - white) * per;
        Self { added: curve * mixed, slope: (1.0 + curve) * per * per, by_curve: mixed * per }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_derivatives_are_those_of_the_whiteness() {
        let response = CameraResponse { curve: 0.9, sharpening: 0.7 };
        let (own, blurred, ratio, step) = (0.3, 0.45, 0.6, 1e-6);
        let at = response.shown(own, blurred, ratio);
        let by = |other: ShownWhiteness| (other.white - at.white) / step;
        let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-5, "{a} {b}");
        close(at.by_own, by(response.shown(own + step, blurred, ratio)));
        close(at.by_blurred, by(response.shown(own, blurred + step, ratio)));
        close(at.by_ratio, by(response.shown(own, blurred, ratio + step)));
        for (index, derivative) in at.by_response.into_iter().enumerate() {
            let moved: [f64; 2] = std::array::from_fn(|i| if i == index { step } else { 0.0 });
            close(derivative, by(response.moved(moved).shown(own, blurred, ratio)));
        }
        assert!((CameraResponse::LINEAR.shown(own, blurred, ratio).white - own).abs() < 1e-12);
    }

    #[test]
    fn the_curve_is_nearly_that_of_srgb() {
        let srgb = |light: f64| 1.055 * light.powf(1.0 / 2.4) - 0.055;
        // Black ink and white paper in a well exposed frame.
        let (black, white) = (0.05, 0.75);
        let response = CameraResponse { curve: 1.1, sharpening: 0.0 };
        for k in 1..10 {
            let share = f64::from(k) / 10.0;
            let shown =
                (srgb(black + share * (white - black)) - srgb(black)) / (srgb(white) - srgb(black));
            assert!((response.shown(share, share, 1.0).white - shown).abs() < 0.03, "{share}");
        }
    }
}
