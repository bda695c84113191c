//! Converts light to grey levels: vignetting, noise, quantisation.

use geometry::Distortion;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::quantise::quantise;
use crate::scene::CameraSettings;

/// Converts the light on rows of pixels into grey levels.
#[derive(Debug)]
pub(super) struct Sensor {
    seed: u64,
    /// Variance of the shot noise per grey level of signal, in squared grey levels.
    shot: f32,
    /// Variance of the read noise, in squared grey levels.
    read: f32,
    /// Normal deviates of variance 1/2; the sum of two has variance 1.
    deviates: Vec<f32>,
    /// Vignetting by column and by row.
    column_loss: Vec<f32>,
    row_loss: Vec<f32>,
}

/// Number of start positions in the deviates, a power of two.
const STARTS: usize = 1 << 15;

/// Number of pixels that take their deviates from one pair of positions. Repeated noise needs the same pair
/// twice, with a probability of 2^-30.
const STRETCH: usize = 128;

impl Sensor {
    pub(super) fn new(settings: &CameraSettings, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x7365_6e73_6f72);
        let deviates = (0..STARTS + STRETCH)
            .map(|_| {
                let deviate: f32 = StandardNormal.sample(&mut rng);
                deviate * std::f32::consts::FRAC_1_SQRT_2
            })
            .collect();
        let model = &settings.model;
        // A pixel's light is as the solid angle that it sees, times the cosine of the angle off axis. Where the image grows as
        // the tangent of that angle this is cos^4, 1 - 2 tan^2 to first order; where it grows as the angle itself, as a fisheye's,
        // it is cos sin / angle, 1 - 2/3 angle^2.
        let slope = match model.distortion {
            Distortion::KannalaBrandt(_) => 2.0 / 3.0,
            Distortion::None | Distortion::BrownConrady(_) => 2.0,
        };
        let loss = |count: u32, centre: f64, focal: f64| {
            let at = |i| {
                (settings.vignetting * slope * ((f64::from(i) - centre) / focal).powi(2)) as f32
            };
            (0..count).map(at).collect()
        };
        let mut sensor = Self {
            seed: mix(seed),
            shot: 0.0,
            read: 0.0,
            deviates,
            column_loss: loss(model.width, model.cx, model.fx),
            row_loss: loss(model.height, model.cy, model.fy),
        };
        sensor.amplify(settings);
        sensor
    }

    /// Sets the noise to that of the settings' gain.
    pub(super) fn amplify(&mut self, settings: &CameraSettings) {
        let levels_per_electron = 255.0 * settings.gain / settings.full_well_e;
        if settings.noise {
            self.shot = levels_per_electron as f32;
            self.read = (settings.read_noise_e * levels_per_electron).powi(2) as f32;
        }
    }

    /// Exposes row `v` of frame `frame_index`: `light` in grey levels before vignetting.
    pub(super) fn expose(&self, frame_index: u64, v: usize, light: &[f32], out: &mut [u8]) {
        let row = self.row(frame_index, v);
        let stretches = light
            .chunks(STRETCH)
            .zip(self.column_loss.chunks(STRETCH))
            .zip(out.chunks_mut(STRETCH))
            .enumerate();
        for (index, ((light, loss), out)) in stretches {
            let (a, b) = self.pair(row.seed.wrapping_add(index as u64));
            for ((((level, light), loss), a), b) in
                out.iter_mut().zip(light).zip(loss).zip(a).zip(b)
            {
                *level = quantise(self.noisy(light * (row.gain - loss).max(0.0), a + b));
            }
        }
    }

    /// Like [`Sensor::expose`], in place, with the steps of a raw file: a sixteenth of a grey level.
    pub(super) fn expose_raw(&self, frame_index: u64, v: usize, light: &mut [f32]) {
        // Numbers of this size are a sixteenth apart, so that adding it rounds.
        const ROUNDING: f32 = 524_288.0;
        let row = self.row(frame_index, v);
        let stretches = light.chunks_mut(STRETCH).zip(self.column_loss.chunks(STRETCH)).enumerate();
        for (index, (light, loss)) in stretches {
            let (a, b) = self.pair(row.seed.wrapping_add(index as u64));
            for (((level, loss), a), b) in light.iter_mut().zip(loss).zip(a).zip(b) {
                let exposed = self.noisy(*level * (row.gain - loss).max(0.0), a + b);
                *level = (exposed.clamp(0.0, 255.0) + ROUNDING) - ROUNDING;
            }
        }
    }

    fn row(&self, frame_index: u64, v: usize) -> Row {
        Row {
            gain: 1.0 - self.row_loss.get(v).copied().unwrap_or(0.0),
            seed: mix(self.seed ^ mix(frame_index)).wrapping_add((v as u64) << 16),
        }
    }

    fn noisy(&self, signal: f32, deviate: f32) -> f32 {
        signal + (signal * self.shot + self.read).sqrt() * deviate
    }

    /// Two stretches of deviates.
    fn pair(&self, key: u64) -> (&[f32], &[f32]) {
        let bits = mix(key) as usize;
        let stretch = |start: usize| self.deviates.get(start..start + STRETCH).unwrap_or(&[]);
        (stretch(bits % STARTS), stretch((bits / STARTS) % STARTS))
    }
}

/// The common values of a row's pixels.
struct Row {
    /// The light after vignetting in the centre column.
    gain: f32,
    seed: u64,
}

/// A bijection that scatters (splitmix64's finaliser).
fn mix(key: u64) -> u64 {
    let key = key.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let key = (key ^ (key >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let key = (key ^ (key >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    key ^ (key >> 31)
}
