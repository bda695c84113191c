//! Simulates wind: a mean, turbulence by the Dryden model, and the thesis' noise.
//!
//! The turbulence is that of MIL-F-8785C, section 3.7, at low altitude: lengths and intensities from the
//! height and the wind at 6 m (20 ft), one coloured noise for each axis. The vehicle hovers, so the air that
//! passes is the wind's own.

use geometry::{Ned, Vector};
use rand_chacha::ChaCha8Rng;

use crate::drift::{Drift, normal, random_stream};

const FEET_PER_METRE: f64 = 3.280_84;

/// The low-altitude model holds from 10 ft to 1000 ft.
const LOWEST_FT: f64 = 10.0;
const HIGHEST_FT: f64 = 1000.0;

/// Part of the Dryden model's intensity that a turbulence of 1 has.
const DRYDEN_SHARE: f64 = 0.3;

/// The parts of the wind.
#[derive(Clone, Debug, PartialEq)]
pub struct WindConfig {
    /// Speed of the mean wind, in m/s.
    pub mean_m_s: f64,
    /// Where the mean wind comes from, in radians from north to east.
    pub from_rad: f64,
    /// Strength of the turbulence: 1 disturbs a landing as much as "turbulence 1" of ArduPilot's simulation
    /// does, which is three tenths of the intensity that the Dryden model gives for the mean wind; 0 is none.
    pub turbulence: f64,
    /// The thesis' noise, added to the rest.
    pub noise: Option<WindNoise>,
    /// Gusts along the mean wind.
    pub gust: Option<Gust>,
}

/// A gust of the shape (1 - cos) / 2 along the mean wind. Times count from the world's begin.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Gust {
    /// When it begins, in seconds.
    pub start_s: f64,
    /// Its duration, in seconds.
    pub length_s: f64,
    /// Its peak, in m/s.
    pub peak_m_s: f64,
    /// From one gust to the next, in seconds; 0 for one only.
    pub period_s: f64,
}

impl Gust {
    /// Speed that it adds, in m/s, at a time after the world's begin.
    pub fn speed_m_s(&self, begun_s: f64) -> f64 {
        let since_s = begun_s - self.start_s;
        let since_s =
            if self.period_s > 0.0 && since_s > 0.0 { since_s % self.period_s } else { since_s };
        let part = since_s / self.length_s.max(1e-3);
        if (0.0..1.0).contains(&part) {
            0.5 * self.peak_m_s * (1.0 - (part * std::f64::consts::TAU).cos())
        } else {
            0.0
        }
    }
}

impl Default for WindConfig {
    fn default() -> Self {
        Self { mean_m_s: 0.0, from_rad: 0.0, turbulence: 0.0, noise: None, gust: None }
    }
}

/// The wind noise of the thesis (Equation 3.15, Algorithm 16): low-passed normal noise, per horizontal axis.
#[derive(Clone, Debug, PartialEq)]
pub struct WindNoise {
    /// Weight of the past value.
    pub lambda: f64,
    /// Deviation of the random term, in m/s.
    pub sigma_m_s: f64,
    /// Time between two values, in seconds; the thesis draws one with each camera frame.
    pub period_s: f64,
}

impl Default for WindNoise {
    fn default() -> Self {
        Self { lambda: 0.9, sigma_m_s: 0.1, period_s: 1.0 / 15.0 }
    }
}

/// The wind at the vehicle.
#[derive(Clone, Debug)]
pub struct Wind {
    config: WindConfig,
    random: ChaCha8Rng,
    along: Drift,
    across: [Lagged; 2],
    noise: [f64; 2],
    noise_age_s: f64,
}

impl Wind {
    /// The wind of this configuration and seed.
    pub fn new(config: WindConfig, seed: u64) -> Self {
        let mut random = random_stream(seed, 1);
        let along = Drift::new(1.0, 1.0, &mut random);
        let across = [Lagged::new(&mut random), Lagged::new(&mut random)];
        Self { config, random, along, across, noise: [0.0; 2], noise_age_s: 0.0 }
    }

    /// Advances by `dt_s` and returns the velocity of the air, in m/s, at a height over the ground and a time
    /// after the world's begin.
    pub fn step(&mut self, dt_s: f64, height_m: f64, begun_s: Option<f64>) -> Vector<Ned> {
        let gust = self.turbulence(dt_s, height_m);
        let noise = self.noise(dt_s);
        let (sin, cos) = self.config.from_rad.sin_cos();
        let single = self.config.gust.zip(begun_s).map_or(0.0, |(gust, s)| gust.speed_m_s(s));
        let along = gust[0] - self.config.mean_m_s - single;
        Vector::new(
            along * cos - gust[1] * sin + noise[0],
            along * sin + gust[1] * cos + noise[1],
            gust[2],
        )
    }

    /// Gusts along the mean wind, across it and downwards, in m/s.
    fn turbulence(&mut self, dt_s: f64, height_m: f64) -> [f64; 3] {
        let speed = self.config.mean_m_s.abs();
        if self.config.turbulence <= 0.0 || speed <= 0.0 {
            return [0.0; 3];
        }
        let height_ft = (height_m * FEET_PER_METRE).clamp(LOWEST_FT, HIGHEST_FT);
        let shape = 0.177 + 0.000_823 * height_ft;
        let sigma_vertical = 0.1 * speed * DRYDEN_SHARE * self.config.turbulence;
        let sigma_level = sigma_vertical / shape.powf(0.4);
        let pace_level_s = height_ft / shape.powf(1.2) / FEET_PER_METRE / speed;
        let pace_vertical_s = height_ft / FEET_PER_METRE / speed;
        self.along.set(1.0, pace_level_s);
        let [across, down] = &mut self.across;
        [
            sigma_level * self.along.step(dt_s, &mut self.random),
            sigma_level * across.step(dt_s, pace_level_s, &mut self.random),
            sigma_vertical * down.step(dt_s, pace_vertical_s, &mut self.random),
        ]
    }

    fn noise(&mut self, dt_s: f64) -> [f64; 2] {
        let Some(WindNoise { lambda, sigma_m_s, period_s }) = self.config.noise else {
            return [0.0; 2];
        };
        self.noise_age_s += dt_s;
        if self.noise_age_s + 1e-9 >= period_s {
            self.noise_age_s = 0.0;
            for axis in &mut self.noise {
                *axis = lambda * *axis + (1.0 - lambda) * sigma_m_s * normal(&mut self.random);
            }
        }
        self.noise
    }
}

/// The Dryden filter across the flow, (1 + sqrt(3) T s) / (1 + T s)^2, driven to unit variance.
#[derive(Clone, Debug)]
struct Lagged {
    first: Drift,
    second: f64,
}

impl Lagged {
    fn new(random: &mut ChaCha8Rng) -> Self {
        Self { first: Drift::new(1.0, 1.0, random), second: 0.0 }
    }

    /// The filter is sqrt(3) times the once lagged noise plus 1 - sqrt(3) times the twice lagged one. With a
    /// variance of 1 for the first, the second has 1/2, as is their covariance, and the sum has 2.
    fn step(&mut self, dt_s: f64, pace_s: f64, random: &mut ChaCha8Rng) -> f64 {
        self.first.set(1.0, pace_s);
        let x = self.first.step(dt_s, random);
        let kept = (-dt_s / pace_s.max(1e-6)).exp();
        self.second = kept * self.second + (1.0 - kept) * x;
        let root3 = 3.0f64.sqrt();
        (root3 * x + (1.0 - root3) * self.second) * std::f64::consts::FRAC_1_SQRT_2
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DT_S: f64 = 1.0 / 50.0;

    /// Mean and deviation of each axis over a long time.
    fn statistics(config: WindConfig, height_m: f64) -> ([f64; 3], [f64; 3]) {
        let mut wind = Wind::new(config, 3);
        let (mut sum, mut square) = ([0.0; 3], [0.0; 3]);
        let n = 1_000_000;
        for _ in 0..n {
            let v = wind.step(DT_S, height_m, None);
            for (axis, value) in [v.x(), v.y(), v.z()].into_iter().enumerate() {
                sum[axis] += value;
                square[axis] += value * value;
            }
        }
        let mean = sum.map(|s| s / f64::from(n));
        let deviation = [0, 1, 2].map(|i| (square[i] / f64::from(n) - mean[i] * mean[i]).sqrt());
        (mean, deviation)
    }

    #[test]
    fn the_mean_wind_blows_from_its_direction() {
        let config = WindConfig { mean_m_s: 5.0, from_rad: 0.3, ..WindConfig::default() };
        let wind = Wind::new(config, 1).step(DT_S, 10.0, None);
        let expected = Vector::new(-5.0 * 0.3f64.cos(), -5.0 * 0.3f64.sin(), 0.0);
        assert!((wind - expected).norm() < 1e-12);
    }

    #[test]
    fn turbulence_has_the_intensities_of_the_dryden_model() {
        let whole = 1.0 / DRYDEN_SHARE;
        let config = WindConfig { mean_m_s: 5.0, turbulence: whole, ..WindConfig::default() };
        let (mean, deviation) = statistics(config, 10.0);
        let level = 0.5 / (0.177 + 0.000_823 * 32.8084f64).powf(0.4);
        for (axis, expected) in [level, level, 0.5].into_iter().enumerate() {
            assert!((deviation[axis] / expected - 1.0).abs() < 0.06, "{axis}: {deviation:?}");
        }
        assert!((mean[0] + 5.0).abs() < 0.1 && mean[1].abs() < 0.1 && mean[2].abs() < 0.05);
    }

    #[test]
    fn the_thesis_noise_has_the_deviation_of_its_recursion() {
        let config = WindConfig { noise: Some(WindNoise::default()), ..WindConfig::default() };
        let (_, deviation) = statistics(config, 10.0);
        // The recursion of Equation 3.15 scales the random term's deviation by sqrt((1 - 0.9) / (1 + 0.9)).
        let expected = 0.1 * (0.1f64 / 1.9).sqrt();
        assert!((deviation[0] / expected - 1.0).abs() < 0.05, "{deviation:?}");
        assert!((deviation[1] / expected - 1.0).abs() < 0.05, "{deviation:?}");
        assert_eq!(deviation[2], 0.0);
    }

    #[test]
    fn a_seed_gives_one_wind() {
        let config = WindConfig { mean_m_s: 5.0, turbulence: 2.0, ..WindConfig::default() };
        let run = |seed| {
            let mut wind = Wind::new(config.clone(), seed);
            (0..100).map(|_| wind.step(DT_S, 5.0, None).norm()).sum::<f64>()
        };
        assert_eq!(run(1), run(1));
        assert_ne!(run(1), run(2));
    }
}
