//! Measures how bright a flight's pictures were, and whether that explains missing detections.

use node::stats::quantile;

use crate::flight::{Flight, Light};

/// Pictures whose brightest hundredth does not reach this fraction of white are dark: a marker's white is not bright enough over its black.
const DARK: f64 = 0.2;
/// Noise above this fraction of white hides small markers.
const NOISY: f64 = 0.03;
/// Pictures whose mean is above this fraction of white are overexposed.
const BRIGHT: f64 = 0.9;

/// The pictures of a camera, in medians.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Usual {
    /// Mean of a picture's pixels, from 0, black, to 1, white.
    pub mean: f64,
    /// The 99th percentile of its pixels.
    pub brightest: f64,
    /// Standard deviation of the noise from pixel to pixel.
    pub noise: f64,
    /// How long they were exposed, in milliseconds.
    pub exposure_ms: Option<f64>,
}

/// The pictures of a camera, in medians; `None` without any.
pub fn usual(pictures: &[Light]) -> Option<Usual> {
    let median = |of: &dyn Fn(&Light) -> Option<f64>| {
        let values: Vec<f64> = pictures.iter().filter_map(of).collect();
        quantile(&values, 0.5)
    };
    Some(Usual {
        mean: median(&|it| Some(it.brightness.mean))?,
        brightest: median(&|it| Some(it.brightness.brightest))?,
        noise: median(&|it| Some(it.brightness.noise))?,
        exposure_ms: median(&|it| it.exposure_ms),
    })
}

/// Warnings about the light, as sentences with a remedy.
pub fn warnings(flight: &Flight) -> Vec<String> {
    let warnings = flight.light.iter().filter_map(|(camera, pictures)| {
        let Usual { mean, brightest, noise, exposure_ms } = usual(pictures)?;
        let exposed = exposure_ms.map_or_else(String::new, |ms| format!(", exposed for {ms:.1} ms"));
        let of_white = format!(
            "in the median their mean is {:.1} % of white, the brightest hundredth of the pixels reaches {:.1} %, and the noise is {:.1} %{exposed}",
            100.0 * mean,
            100.0 * brightest,
            100.0 * noise
        );
        let (how, remedy) = if brightest < DARK {
            ("too dark", "light the pad, or give the camera a longer exposure or more gain")
        } else if mean > BRIGHT {
            ("too bright", "give the camera a shorter exposure or less gain")
        } else if noise > NOISY {
            ("too noisy, as in too little light with a large gain,", "light the pad, or give the camera a longer exposure and less gain")
        } else {
            return None;
        };
        Some(format!("the pictures of camera `{camera}` are {how} for a marker: {of_white}; {remedy} (docs/camera.md)"))
    });
    warnings.collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use replay::Brightness;

    #[test]
    fn dark_bright_and_noisy_pictures_are_reported_with_their_numbers() {
        let warnings_of = |mean: f64, brightest: f64, noise: f64, exposure_ms| {
            let brightness = Brightness { mean, brightest, noise };
            let picture = Light { stamp_ns: 0, exposure_ms, brightness };
            let mut flight = Flight::default();
            flight.light.insert("down".to_owned(), vec![picture]);
            warnings(&flight)
        };
        assert_eq!(warnings_of(0.4, 0.9, 0.01, None), Vec::<String>::new());
        assert_eq!(
            warnings_of(0.012, 0.05, 0.01, Some(20.0)),
            [
                "the pictures of camera `down` are too dark for a marker: in the median their mean is 1.2 % of white, the brightest hundredth of the pixels reaches 5.0 %, and the noise is 1.0 %, exposed for 20.0 ms; light the pad, or give the camera a longer exposure or more gain (docs/camera.md)"
            ]
        );
        assert!(warnings_of(0.97, 1.0, 0.0, None)[0].contains("too bright"));
        assert!(warnings_of(0.3, 0.5, 0.06, None)[0].contains("too noisy, as in too little light"));
        assert_eq!(warnings(&Flight::default()), Vec::<String>::new());
    }
}
