//! Random numbers of one seed, and numbers that change slowly.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal, StandardUniform};

/// Independent random numbers for each part of the world.
pub(crate) fn stream(seed: u64, number: u64) -> ChaCha8Rng {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(number);
    random
}

pub(crate) fn normal(random: &mut ChaCha8Rng) -> f64 {
    StandardNormal.sample(random)
}

pub(crate) fn uniform(random: &mut ChaCha8Rng) -> f64 {
    StandardUniform.sample(random)
}

/// Share of the way that a first-order lag goes in `dt_s`.
pub(crate) fn lag(dt_s: f64, time_constant_s: f64) -> f64 {
    if time_constant_s > 0.0 { 1.0 - (-dt_s / time_constant_s).exp() } else { 1.0 }
}

/// ArduPilot's `sqrt_controller`: proportional near nought, farther away the square root that needs no more than
/// `limit` of the next derivative.
pub(crate) fn square_root_law(error: f64, gain: f64, limit: f64) -> f64 {
    let linear = limit / (gain * gain);
    if error.abs() > linear {
        error.signum() * (2.0 * limit * (error.abs() - 0.5 * linear)).sqrt()
    } else {
        error * gain
    }
}

/// A first-order Gauss-Markov process.
#[derive(Clone, Debug)]
pub(crate) struct Drift {
    deviation: f64,
    value: f64,
}

impl Drift {
    pub(crate) fn new(deviation: f64, start: f64, random: &mut ChaCha8Rng) -> Self {
        Self { deviation, value: deviation * start * normal(random) }
    }

    pub(crate) fn step(&mut self, dt_s: f64, time_constant_s: f64, random: &mut ChaCha8Rng) -> f64 {
        let kept = (-dt_s / time_constant_s.max(1e-6)).exp();
        self.value =
            kept * self.value + self.deviation * (1.0 - kept * kept).sqrt() * normal(random);
        self.value
    }
}
