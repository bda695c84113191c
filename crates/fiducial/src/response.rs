//! Estimates the tone curve and the sharpening of a camera with their deviations from the markers of the last images; a setting
//! can fix them.
//!
//! Every marker gives the tone curve and the sharpening of the camera that shows it, a small one badly. Those of a stream are
//! the same camera's, so the next fit starts from the mean of the last markers, constrained to it as strongly as they agreed.

use std::fmt;
use std::str::FromStr;

/// A camera's response and how well it is known.
///
/// Light from 0 (black ink) to 1 (white paper) has the level `(1 + curve) w / (1 + curve w)` between theirs; then
/// `sharpening` times the difference from a copy blurred by a Gaussian of one pixel is added.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct ResponseEstimate {
    /// The tone curve: 0 is linear, 1.1 nearly sRGB.
    pub curve: Measured,
    /// The amount of the unsharp mask.
    pub sharpening: Measured,
}

/// A number with its standard deviation.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Measured {
    /// The number.
    pub value: f64,
    /// Its standard deviation.
    pub deviation: f64,
}

impl Measured {
    /// The information of a measurement without the prior `known` of its fit; `None` where it adds nothing to the prior.
    pub(crate) fn without(self, known: Option<Self>) -> Option<Self> {
        let Some(known) = known else { return Some(self) };
        let [all, before] = [self, known].map(|it| it.deviation.powi(-2));
        let own = all - before;
        // A tenth of the prior is lost in rounding and in the choice of pixels.
        (own > 0.1 * before && own.is_finite()).then(|| Self {
            value: (self.value * all - known.value * before) / own,
            deviation: own.powf(-0.5),
        })
    }
}

/// Where the response of a camera comes from.
#[derive(Copy, Clone, Debug, Default, PartialEq)]
pub enum ResponseSetting {
    /// Estimated from markers, and in a stream of images remembered.
    #[default]
    Auto,
    /// Known.
    Known(ResponseEstimate),
}

/// Standard deviations of a response that is configured.
const CONFIGURED_DEVIATION: f64 = 0.1;
/// The curve of sRGB between black ink and white paper in a well exposed image, and its deviation with the exposure.
const SRGB: Measured = Measured { value: 1.1, deviation: 0.25 };
/// Amounts of unsharp masks that cameras have: any up to 1 or so.
const ANY_SHARPENING: Measured = Measured { value: 0.4, deviation: 0.4 };
/// Ranges of configured values.
const CURVES: std::ops::RangeInclusive<f64> = -0.25..=4.0;
const SHARPENINGS: std::ops::RangeInclusive<f64> = 0.0..=2.0;

impl ResponseSetting {
    /// No tone curve and no sharpening.
    pub const LINEAR: Self = Self::Known(ResponseEstimate {
        curve: Measured { value: 0.0, deviation: CONFIGURED_DEVIATION },
        sharpening: Measured { value: 0.0, deviation: CONFIGURED_DEVIATION },
    });
}

impl FromStr for ResponseSetting {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "auto" => return Ok(Self::Auto),
            "linear" => return Ok(Self::LINEAR),
            "srgb" => {
                return Ok(Self::Known(ResponseEstimate {
                    curve: SRGB,
                    sharpening: ANY_SHARPENING,
                }));
            }
            _ => {}
        }
        let numbers = text.split_once(',').and_then(|(curve, sharpening)| {
            Some([curve.trim().parse::<f64>().ok()?, sharpening.trim().parse::<f64>().ok()?])
        });
        let Some([curve, sharpening]) = numbers else {
            return Err(format!(
                "`{text}` is no response of a camera; it must be auto, linear, srgb or `CURVE,SHARPENING`, as in `1.1,0.5`"
            ));
        };
        if !CURVES.contains(&curve) || !SHARPENINGS.contains(&sharpening) {
            return Err(format!(
                "`{text}`: the curve must be from -0.25 to 4 and the sharpening from 0 to 2"
            ));
        }
        let measured = |value| Measured { value, deviation: CONFIGURED_DEVIATION };
        Ok(Self::Known(ResponseEstimate {
            curve: measured(curve),
            sharpening: measured(sharpening),
        }))
    }
}

impl fmt::Display for ResponseEstimate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.2},{:.2}", self.curve.value, self.sharpening.value)
    }
}

/// The response estimated from the last markers.
#[derive(Copy, Clone, Debug, Default)]
pub struct ResponseMemory {
    curve: Running,
    sharpening: Running,
    markers: u32,
}

/// Markers after which their mean is worth more than a fit without it.
const MIN_MARKERS: u32 = 5;

impl ResponseMemory {
    /// Adds a marker's estimate.
    pub fn add(&mut self, estimate: &ResponseEstimate) {
        self.curve.add(estimate.curve);
        self.sharpening.add(estimate.sharpening);
        self.markers = self.markers.saturating_add(1);
    }

    /// The number of markers from which it is estimated.
    pub fn markers(&self) -> u32 {
        self.markers
    }

    /// The expected estimate of the next marker, with the deviation from marker to marker; `None` after too few.
    pub fn known(&self) -> Option<ResponseEstimate> {
        if self.markers < MIN_MARKERS {
            return None;
        }
        Some(ResponseEstimate {
            curve: self.curve.expected()?,
            sharpening: self.sharpening.expected()?,
        })
    }
}

/// A mean of measurements of different quality that forgets old ones.
#[derive(Copy, Clone, Debug, Default)]
struct Running {
    weight: f64,
    mean: f64,
    /// Mean square of how far the next measurement was from the mean, where that was sure.
    square: f64,
}

impl Running {
    /// A measurement counts for about so many of them.
    const MEMORY: f64 = 40.0;
    /// The model is only that good: exposures and blurs differ.
    const MIN_DEVIATION: f64 = 0.05;

    fn add(&mut self, measured: Measured) {
        let variance = measured.deviation.powi(2) + Self::MIN_DEVIATION.powi(2);
        if !(measured.value.is_finite() && variance.is_finite()) {
            return;
        }
        let weight = Self::MIN_DEVIATION.powi(2) / variance;
        let kept = self.weight * (1.0 - weight / Self::MEMORY);
        let off = measured.value - self.mean;
        let share = weight / (kept + weight);
        if self.weight > 0.0 {
            self.square += share * (off * off - self.square);
        }
        self.mean += share * off;
        self.weight = kept + weight;
    }

    /// `None` before any measurement.
    fn expected(&self) -> Option<Measured> {
        let own = Self::MIN_DEVIATION.powi(2) / self.weight;
        let deviation = (self.square.max(Self::MIN_DEVIATION.powi(2)) + own).sqrt();
        (self.weight > 0.0).then_some(Measured { value: self.mean, deviation })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn estimate(curve: f64, deviation: f64) -> ResponseEstimate {
        ResponseEstimate {
            curve: Measured { value: curve, deviation },
            sharpening: Measured { value: 0.5, deviation },
        }
    }

    #[test]
    fn bad_measurements_hardly_move_the_mean_of_good_ones() {
        let mut memory = ResponseMemory::default();
        for k in 0..4 {
            memory.add(&estimate(1.0 + 0.02 * f64::from(k % 2), 0.03));
            assert_eq!(memory.known(), None, "after {k}");
        }
        for k in 0..30 {
            memory.add(&estimate(1.0 + 0.02 * f64::from(k % 2), 0.03));
        }
        let known = memory.known().unwrap().curve;
        assert!((known.value - 1.01).abs() < 0.01 && (0.04..0.07).contains(&known.deviation));
        memory.add(&estimate(3.0, 1.0));
        let after = memory.known().unwrap().curve;
        assert!((after.value - known.value).abs() < 0.01, "{after:?}");
        memory.add(&estimate(f64::NAN, 0.1));
        assert!(memory.known().unwrap().curve.value.is_finite());
    }

    #[test]
    fn another_camera_is_learnt_and_the_change_widens_the_deviation() {
        let mut memory = ResponseMemory::default();
        for _ in 0..100 {
            memory.add(&estimate(0.2, 0.03));
        }
        for _ in 0..10 {
            memory.add(&estimate(1.2, 0.03));
        }
        let changing = memory.known().unwrap().curve;
        assert!(changing.deviation > 0.2, "{changing:?}");
        for _ in 0..400 {
            memory.add(&estimate(1.2, 0.03));
        }
        let learnt = memory.known().unwrap().curve;
        assert!((learnt.value - 1.2).abs() < 0.02 && learnt.deviation < 0.12, "{learnt:?}");
    }

    #[test]
    fn the_prior_is_removed_from_a_measurement() {
        let known = Measured { value: 1.0, deviation: 0.2 };
        // The mean of 1.0 and 2.0, both with 0.2.
        let both = Measured { value: 1.5, deviation: 0.2 / 2f64.sqrt() };
        let own = both.without(Some(known)).unwrap();
        assert!((own.value - 2.0).abs() < 1e-9 && (own.deviation - 0.2).abs() < 1e-9, "{own:?}");
        assert_eq!(known.without(Some(known)), None);
        assert_eq!(both.without(None), Some(both));
    }

    #[test]
    fn a_response_is_configured_by_name_or_by_its_numbers() {
        assert_eq!("auto".parse(), Ok(ResponseSetting::Auto));
        assert_eq!("linear".parse(), Ok(ResponseSetting::LINEAR));
        for text in ["srgb", "1.05,0.40"] {
            assert!(matches!(text.parse(), Ok(ResponseSetting::Known(_))), "{text}");
        }
        let Ok(ResponseSetting::Known(known)) = "1.05, 0.4".parse() else { panic!() };
        assert_eq!(known.to_string(), "1.05,0.40");
        for (text, part) in [("bright", "srgb"), ("9,0", "from -0.25 to 4"), ("1,x", "CURVE")] {
            let problem = text.parse::<ResponseSetting>().unwrap_err();
            assert!(problem.contains(part), "{problem}");
        }
    }
}
