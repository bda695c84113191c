//! Processes a rendered frame as a camera does, from the flaws of its lens to the losses of JPEG or H.264. Has the settings of
//! each stage with their limits.
//!
//! The stages are those of an ordinary camera, in its order: `lens` and `unsteady` (on the light behind the Gaussian blur that the renderer
//! draws with), vignetting, exposure and noise (the sensor's), then `mosaic` (colour filters, interpolation), `denoise`, `local_tone`,
//! `tone` (from linear to the grey levels of the file), `sharpen`, `jpeg_quality`, `video`. Everything is grey: a neutral scene is grey
//! behind white balance, and the luma of a JPEG with subsampled chroma (YCbCr 4:2:0) is the JPEG of its luma.

mod develop;
mod filters;
mod jpeg;
mod lens;
mod local;
mod mosaic;
mod preset;
mod tone;
mod video;

use serde::{Deserialize, Serialize};

use crate::error::RenderError;

pub(crate) use develop::Developer;
pub use lens::{Lens, Unsteady};
pub use preset::Preset;
pub use tone::ToneCurve;
pub use video::Video;

/// A camera's processing. Without any stage, frames are linear in light.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Processing {
    /// The flaws of the lens.
    pub lens: Lens,
    /// The changes from frame to frame.
    pub unsteady: Unsteady,
    /// Whether the sensor has an RGGB mosaic of colour filters, from which grey is interpolated; else it is
    /// monochrome.
    pub mosaic: bool,
    /// Noise reduction, in linear light.
    pub denoise: Denoise,
    /// Local adaptation of brightness, in linear light.
    pub local_tone: Option<LocalTone>,
    /// From linear light to grey levels.
    pub tone: ToneCurve,
    /// Sharpening, in grey levels.
    pub sharpen: Option<Sharpen>,
    /// Quality of JPEG, from 1 to 100, in which the frame crosses the cable or the card.
    pub jpeg_quality: Option<u8>,
    /// The stream of H.264 in which it comes over a network.
    pub video: Option<Video>,
}

/// Noise reduction.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub enum Denoise {
    /// None.
    #[default]
    None,
    /// The median of 3 x 3 pixels.
    Median,
    /// A mean of 3 x 3 pixels, less of those that differ (Tomasi and Manduchi, "Bilateral filtering for gray
    /// and color images", 1998).
    Bilateral {
        /// Standard deviation of the weight by distance, in pixels, from 0.1 to 3.
        sigma_px: f32,
        /// Difference at which a neighbour has half its weight, in grey levels of linear light, from 0.1 to
        /// 255.
        range_levels: f32,
    },
}

/// Local adaptation of brightness, as of a merged series of exposures: a pixel darker than the mean of the
/// frame becomes brighter, and the other way round.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LocalTone {
    /// The power of the ratio by which a place is brightened, from 0 (nothing) to 1 (all places equally
    /// bright).
    pub strength: f32,
    /// Maximum ratio, from 1 to 16.
    pub max_gain: f32,
    /// Edge of the neighbourhood whose mean counts, as a part of the image's width, from 0.01 to 0.5.
    pub neighbourhood: f32,
}

/// An unsharp mask: the difference from a blurred copy is added.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sharpen {
    /// Standard deviation of the blur, in pixels, from 0.3 to 5.
    pub radius_px: f32,
    /// Part of the difference that is added, from 0 to 3.
    pub amount: f32,
    /// Maximum change of a pixel, in grey levels, from 0 to 255: halos are cut there.
    pub limit_levels: f32,
}

impl Processing {
    /// No processing.
    pub const LINEAR: Self = Self {
        lens: Lens { curvature_px: 0.0, fringe_px: 0.0, flare: 0.0 },
        unsteady: Unsteady { flicker: 0.0, bands: 0.0, exposure_stops: 0.0 },
        mosaic: false,
        denoise: Denoise::None,
        local_tone: None,
        tone: ToneCurve::Linear,
        sharpen: None,
        jpeg_quality: None,
        video: None,
    };

    /// Processes a grey frame that is linear in light, given row by row; returns its grey levels. Lens and
    /// mosaic come after the frame's own noise. Of a video it is a key frame.
    ///
    /// # Errors
    /// [`RenderError`] when a setting is out of range, or the frame does not have full rows.
    pub fn apply(&self, pixels: &[u8], width: usize) -> Result<Vec<u8>, RenderError> {
        let mut developer = Developer::new(self, width)?;
        let mut out = vec![0; pixels.len()];
        let raw = developer.raw(pixels.len());
        for (level, pixel) in raw.iter_mut().zip(pixels) {
            *level = f32::from(*pixel);
        }
        developer.pass_lens(0);
        developer.develop(&mut out)?;
        Ok(out)
    }

    pub(crate) fn check(&self) -> Result<(), RenderError> {
        let local = self.local_tone;
        let denoise = match self.denoise {
            Denoise::Bilateral { sigma_px, range_levels } => {
                (0.1..=3.0).contains(&sigma_px) && (0.1..=255.0).contains(&range_levels)
            }
            Denoise::None | Denoise::Median => true,
        };
        let tone = match self.tone {
            ToneCurve::Gamma { exponent } => (1.0..=3.0).contains(&exponent),
            ToneCurve::Shoulder { knee } => (0.01..=100.0).contains(&knee),
            _ => true,
        };
        let checks = [
            (
                self.lens.is_sound(),
                "processing.lens: curvature_px is not from 0 to 5, fringe_px not from -3 to 3, or flare not from 0 to 0.5",
            ),
            (
                self.unsteady.is_sound(),
                "processing.unsteady: flicker is not from 0 to 1, bands not from 0 to 20, or exposure_stops not from 0 to 2",
            ),
            (
                denoise,
                "processing.denoise: sigma_px is not from 0.1 to 3, or range_levels not from 0.1 to 255",
            ),
            (
                local.is_none_or(|l| {
                    (0.0..=1.0).contains(&l.strength)
                        && (1.0..=16.0).contains(&l.max_gain)
                        && (0.01..=0.5).contains(&l.neighbourhood)
                }),
                "processing.local_tone: strength is not from 0 to 1, max_gain not from 1 to 16, or neighbourhood not from 0.01 to 0.5",
            ),
            (
                tone,
                "processing.tone: the exponent is not from 1 to 3, or the knee not from 0.01 to 100",
            ),
            (
                self.sharpen.is_none_or(|s| {
                    (0.3..=5.0).contains(&s.radius_px)
                        && (0.0..=3.0).contains(&s.amount)
                        && (0.0..=255.0).contains(&s.limit_levels)
                }),
                "processing.sharpen: radius_px is not from 0.3 to 5, amount not from 0 to 3, or limit_levels not from 0 to 255",
            ),
            (
                self.jpeg_quality.is_none_or(|quality| (1..=100).contains(&quality)),
                "processing.jpeg_quality is not from 1 to 100",
            ),
            (
                self.video.is_none_or(|video| video.is_sound()),
                "processing.video: quantiser is not from 10 to 51, or key_frame_every is 0",
            ),
        ];
        checks
            .iter()
            .find(|(holds, _)| !holds)
            .map_or(Ok(()), |(_, why)| Err(RenderError::Setting(why)))
    }
}

/// Root mean square of the difference of two pictures, in grey levels.
#[cfg(test)]
fn rms(a: &[u8], b: &[u8]) -> f64 {
    let squares = a.iter().zip(b).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2));
    (squares.sum::<f64>() / a.len() as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 64;

    /// Dark on the left, bright on the right, in between one step at column 32.
    fn step(dark: u8, bright: u8) -> Vec<u8> {
        (0..WIDTH * 48).map(|i| if i % WIDTH < 32 { dark } else { bright }).collect()
    }

    fn row_of(processing: Processing, pixels: &[u8]) -> Vec<u8> {
        let out = processing.apply(pixels, WIDTH).unwrap();
        out[20 * WIDTH..21 * WIDTH].to_vec()
    }

    #[test]
    fn without_stages_a_frame_stays_as_it_is() {
        let ramp: Vec<u8> = (0..WIDTH * 8).map(|i| (i % 256) as u8).collect();
        assert_eq!(Processing::LINEAR.apply(&ramp, WIDTH).unwrap(), ramp);
        assert_eq!(Processing::default(), Processing::LINEAR);
    }

    #[test]
    fn tone_comes_before_sharpening_whose_halos_have_the_known_height_and_are_cut() {
        let curve = Processing { tone: ToneCurve::Srgb, ..Processing::LINEAR };
        let [low, high] = [56u8, 118].map(f32::from);
        // 10 and 46 of 255 in linear light.
        let flat = row_of(curve, &step(10, 46));
        assert_eq!([flat[0], flat[63]].map(f32::from), [low, high]);
        let sharpen = |limit_levels| Processing {
            sharpen: Some(Sharpen { radius_px: 1.0, amount: 0.8, limit_levels }),
            ..curve
        };
        // Beside a step the blurred copy is 0.5 - 0.399/2 = 0.30 of the step off.
        let row = row_of(sharpen(255.0), &step(10, 46));
        let halo = 0.8 * 0.3 * (high - low);
        assert!((f32::from(row[32]) - high - halo).abs() < 1.6, "{row:?}");
        assert!((low - f32::from(row[31]) - halo).abs() < 1.6, "{row:?}");
        assert_eq!([row[0], row[63]], [flat[0], flat[63]]);
        let cut = row_of(sharpen(5.0), &step(10, 46));
        assert_eq!([cut[31], cut[32]].map(f32::from), [low - 5.0, high + 5.0]);
    }

    #[test]
    fn sharpening_clips_at_black_and_white() {
        let sharpen = Some(Sharpen { radius_px: 1.0, amount: 1.0, limit_levels: 255.0 });
        let row = row_of(Processing { sharpen, ..Processing::LINEAR }, &step(5, 250));
        assert_eq!([row[31], row[32]], [0, 255]);
    }

    #[test]
    fn denoising_takes_out_a_single_pixel_and_leaves_an_edge() {
        let mut pixels = step(40, 200);
        pixels[20 * WIDTH + 10] = 80;
        for denoise in [Denoise::Median, Denoise::Bilateral { sigma_px: 1.0, range_levels: 60.0 }] {
            let row = row_of(Processing { denoise, ..Processing::LINEAR }, &pixels);
            assert!(row[10] < 62, "{denoise:?}: {row:?}");
            assert!(row[31] < 65 && row[32] > 175, "{denoise:?}: {row:?}");
        }
    }

    #[test]
    fn a_jpeg_of_high_quality_changes_little_and_of_low_quality_more() {
        let pixels: Vec<u8> = (0..WIDTH * 48)
            .map(|i| {
                let (x, y) = ((i % WIDTH) as f64, (i / WIDTH) as f64);
                (128.0 + 60.0 * (x * 0.7).sin() * (y * 0.45).cos()) as u8
            })
            .collect();
        let off = |quality| {
            let processing = Processing { jpeg_quality: Some(quality), ..Processing::LINEAR };
            let out = processing.apply(&pixels, WIDTH).unwrap();
            rms(&out, &pixels)
        };
        let [fine, coarse] = [off(95), off(50)];
        assert!(fine > 0.1 && fine < 2.5 && coarse > 1.5 * fine, "{fine} {coarse}");
    }

    #[test]
    fn local_tone_brightens_shade_and_keeps_the_order() {
        let local = LocalTone { strength: 0.5, max_gain: 4.0, neighbourhood: 0.1 };
        let row =
            row_of(Processing { local_tone: Some(local), ..Processing::LINEAR }, &step(20, 180));
        assert!(row[4] > 30 && row[60] < 170 && row[4] < row[60], "{row:?}");
    }

    #[test]
    fn a_grey_scene_stays_grey_through_the_mosaic_and_an_edge_gets_softer() {
        let mosaic = Processing { mosaic: true, ..Processing::LINEAR };
        let row = row_of(mosaic, &step(40, 200));
        assert_eq!([row[5], row[60]], [40, 200]);
        assert!(row[31] > 40 && row[32] < 200, "{row:?}");
    }

    #[test]
    fn settings_out_of_range_are_refused() {
        let wrong = [
            Processing { jpeg_quality: Some(0), ..Processing::LINEAR },
            Processing { tone: ToneCurve::Gamma { exponent: f32::NAN }, ..Processing::LINEAR },
            Processing {
                denoise: Denoise::Bilateral { sigma_px: 0.0, range_levels: 5.0 },
                ..Processing::LINEAR
            },
            Processing {
                sharpen: Some(Sharpen { radius_px: 9.0, amount: 1.0, limit_levels: 255.0 }),
                ..Processing::LINEAR
            },
        ];
        for processing in wrong {
            assert!(processing.apply(&[0; 64], 8).is_err(), "{processing:?}");
        }
        assert!(Processing::LINEAR.apply(&[0; 65], 8).is_err());
    }
}
