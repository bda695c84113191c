//! Converts linear light to grey levels with a tone curve.

use serde::{Deserialize, Serialize};

/// A monotone curve from linear light to grey levels, both from 0 to 1.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub enum ToneCurve {
    /// Grey levels in proportion to light.
    #[default]
    Linear,
    /// That of IEC 61966-2-1 (sRGB): linear near black, then a power of 1 / 2.4.
    Srgb,
    /// The power 1 / exponent.
    Gamma {
        /// The exponent of the display, from 1 to 3; 1.8 to 2.4 are common.
        exponent: f32,
    },
    /// x (1 + knee) / (x + knee): steep in the shadows, flat in the light.
    Shoulder {
        /// Where half of the shadows' slope is lost, from 0.01 to 100.
        knee: f32,
    },
    /// An S: dark toe, long shoulder, then sRGB (Narkowicz, "ACES filmic tone mapping curve", 2015).
    Filmic,
}

impl ToneCurve {
    /// The grey level of a light, both from 0 to 1. Values outside are clamped.
    pub fn level(self, light: f32) -> f32 {
        let light = light.clamp(0.0, 1.0);
        match self {
            Self::Linear => light,
            Self::Srgb => srgb(light),
            Self::Gamma { exponent } => light.powf(1.0 / exponent),
            Self::Shoulder { knee } => light * (1.0 + knee) / (light + knee),
            Self::Filmic => srgb(filmic(light) / filmic(1.0)),
        }
    }
}

fn srgb(light: f32) -> f32 {
    if light <= 0.003_130_8 { 12.92 * light } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 }
}

/// Narkowicz' rational fit, at the exposure of 0.6 that he gives for the curve it fits.
fn filmic(light: f32) -> f32 {
    let x = 0.6 * light;
    x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)
}

/// A curve as a table over light from 0 to 255, for interpolation.
#[derive(Debug)]
pub(super) struct Table {
    /// Grey levels, and how far it is to the next.
    levels: Vec<[f32; 2]>,
}

/// Entries of the table per grey level of linear light: the steepest curve is straight between them to a
/// hundredth of a level.
const PER_LEVEL: usize = 16;

impl Table {
    pub(super) fn new(curve: ToneCurve) -> Self {
        let last = 255 * PER_LEVEL;
        let level = |k: usize| 255.0 * curve.level(k as f32 / last as f32);
        let rise = |k: usize| level((k + 1).min(last)) - level(k);
        Self { levels: (0..=last).map(|k| [level(k), rise(k)]).collect() }
    }

    /// Replaces light from 0 to 255 by grey levels.
    pub(super) fn apply(&self, light: &mut [f32]) {
        for value in light {
            let place = value.clamp(0.0, 255.0) * PER_LEVEL as f32;
            // Adding 2^23 leaves the rounded integer in the lowest bits; unlike a cast it needs no test for NaN. Half
            // more is the next integer, or the place itself where it is one.
            let next = ((place + 0.5) + 8_388_608.0).to_bits() & 0xffff;
            let index = next.saturating_sub(1);
            if let Some([low, rise]) = self.levels.get(index as usize) {
                *value = low + rise * (place - index as f32);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_have_their_known_values() {
        let close = |curve: ToneCurve, light: f32, level: f32| {
            let is = curve.level(light);
            assert!((is - level).abs() < 2e-4, "{curve:?} at {light}: {is} instead of {level}");
        };
        // IEC 61966-2-1: middle grey of 18 % is level 118 of 255; the two parts meet at 0.04045.
        close(ToneCurve::Srgb, 0.18, 0.4613);
        close(ToneCurve::Srgb, 0.5, 0.7354);
        close(ToneCurve::Srgb, 0.003_130_8, 0.040_45);
        close(ToneCurve::Gamma { exponent: 2.2 }, 0.5, 0.7297);
        close(ToneCurve::Shoulder { knee: 0.25 }, 0.5, 0.8333);
        close(ToneCurve::Filmic, 0.18, 0.4935);
        close(ToneCurve::Linear, 0.3, 0.3);
    }

    #[test]
    fn curves_rise_from_black_to_white_and_the_table_has_their_values() {
        let curves = [
            ToneCurve::Linear,
            ToneCurve::Srgb,
            ToneCurve::Gamma { exponent: 2.4 },
            ToneCurve::Shoulder { knee: 0.25 },
            ToneCurve::Filmic,
        ];
        for curve in curves {
            let table = Table::new(curve);
            let mut before = -1.0;
            for k in 0..=1000 {
                let mut light = [255.0 * k as f32 / 1000.0];
                let exact = 255.0 * curve.level(light[0] / 255.0);
                table.apply(&mut light);
                assert!(light[0] > before, "{curve:?} at {k}");
                // A power is infinitely steep at black.
                assert!(k < 4 || (light[0] - exact).abs() < 0.02, "{curve:?} at {k}: {light:?}");
                before = light[0];
            }
            assert!((curve.level(0.0)).abs() < 1e-6 && (curve.level(1.0) - 1.0).abs() < 1e-6);
        }
    }
}
