//! The air: a mean wind, Dryden turbulence (MIL-F-8785C, section 3.7, low altitude) and single gusts.

use geometry::{Ned, Vector};
use rand_chacha::ChaCha8Rng;

use super::chance::{Drift, lag, stream};

/// Part of the Dryden model's intensity that a turbulence of 1 has, as in ArduPilot's simulation.
const DRYDEN_SHARE: f64 = 0.3;
const FEET_PER_METRE: f64 = 3.280_84;

/// What blows.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Wind {
    pub(crate) mean_m_s: f64,
    /// Where it comes from, from north to east.
    pub(crate) from_rad: f64,
    /// Three tenths of the Dryden model's intensity each.
    pub(crate) turbulence: f64,
    /// One gust of the shape 1 - cosine along the wind: when it begins, how long it lasts, and its peak.
    pub(crate) gust: Option<Gust>,
}

/// A gust of the shape (1 - cos) / 2.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Gust {
    pub(crate) start_s: f64,
    pub(crate) length_s: f64,
    pub(crate) peak_m_s: f64,
}

impl Wind {
    pub(crate) const CALM: Self =
        Self { mean_m_s: 0.0, from_rad: 0.0, turbulence: 0.0, gust: None };

    pub(crate) fn new(mean_m_s: f64, turbulence: f64, from_rad: f64) -> Self {
        Self { mean_m_s, from_rad, turbulence, gust: None }
    }
}

/// The air at the vehicle.
pub(crate) struct Air {
    wind: Wind,
    random: ChaCha8Rng,
    along: Drift,
    across: Drift,
    down: Drift,
    lagged: [f64; 2],
}

impl Air {
    pub(crate) fn new(wind: Wind, seed: u64) -> Self {
        let mut random = stream(seed, 1);
        let [along, across, down] = [(); 3].map(|()| Drift::new(1.0, 1.0, &mut random));
        Self { wind, random, along, across, down, lagged: [0.0; 2] }
    }

    /// Its velocity at this height over the ground, in m/s.
    pub(crate) fn step(&mut self, dt_s: f64, now_s: f64, height_m: f64) -> Vector<Ned> {
        let [along, across, down] = self.turbulence(dt_s, height_m);
        let along = along - self.wind.mean_m_s - self.gust_m_s(now_s);
        let (sin, cos) = self.wind.from_rad.sin_cos();
        Vector::new(along * cos - across * sin, along * sin + across * cos, down)
    }

    fn gust_m_s(&self, now_s: f64) -> f64 {
        self.wind.gust.map_or(0.0, |gust| {
            let part = (now_s - gust.start_s) / gust.length_s;
            let inside = (0.0..1.0).contains(&part);
            if inside {
                0.5 * gust.peak_m_s * (1.0 - (part * std::f64::consts::TAU).cos())
            } else {
                0.0
            }
        })
    }

    fn turbulence(&mut self, dt_s: f64, height_m: f64) -> [f64; 3] {
        let speed = self.wind.mean_m_s;
        if self.wind.turbulence <= 0.0 || speed <= 0.0 {
            return [0.0; 3];
        }
        let height_ft = (height_m * FEET_PER_METRE).clamp(10.0, 1000.0);
        let shape = 0.177 + 0.000_823 * height_ft;
        let vertical = 0.1 * speed * DRYDEN_SHARE * self.wind.turbulence;
        let level = vertical / shape.powf(0.4);
        let pace_s = height_ft / shape.powf(1.2) / FEET_PER_METRE / speed;
        let pace_down_s = height_ft / FEET_PER_METRE / speed;
        let along = self.along.step(dt_s, pace_s, &mut self.random);
        // Across the flow the filter is (1 + sqrt(3) T s) / (1 + T s)^2: a sum of once and twice lagged noise.
        let mut filtered = [0.0; 2];
        let paces = [pace_s, pace_down_s];
        for (i, source) in [&mut self.across, &mut self.down].into_iter().enumerate() {
            let once = source.step(dt_s, paces[i], &mut self.random);
            self.lagged[i] += (once - self.lagged[i]) * lag(dt_s, paces[i]);
            let root3 = 3.0f64.sqrt();
            filtered[i] =
                (root3 * once + (1.0 - root3) * self.lagged[i]) * std::f64::consts::FRAC_1_SQRT_2;
        }
        [level * along, level * filtered[0], vertical * filtered[1]]
    }
}
