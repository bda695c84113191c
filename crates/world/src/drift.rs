//! Draws random numbers that change slowly, each from a stream of the one seed.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal, StandardUniform};

/// The random stream number `stream` of a seed: streams of one seed are independent of each other, so a part
/// of the world that draws more numbers does not change the numbers of the others.
pub fn random_stream(seed: u64, stream: u64) -> ChaCha8Rng {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(stream);
    random
}

/// One number from the normal distribution with mean 0 and deviation 1.
pub fn normal(random: &mut ChaCha8Rng) -> f64 {
    StandardNormal.sample(random)
}

/// One number from 0 to 1.
pub fn uniform(random: &mut ChaCha8Rng) -> f64 {
    StandardUniform.sample(random)
}

/// A first-order Gauss-Markov process: a normal variable that forgets its value with a time constant.
#[derive(Clone, Debug)]
pub struct Drift {
    deviation: f64,
    time_constant_s: f64,
    value: f64,
}

impl Drift {
    /// A process with this standard deviation, which starts at a value drawn from its distribution.
    pub fn new(deviation: f64, time_constant_s: f64, random: &mut ChaCha8Rng) -> Self {
        Self { deviation, time_constant_s, value: deviation * normal(random) }
    }

    /// Changes deviation and time constant, keeping the value.
    pub fn set(&mut self, deviation: f64, time_constant_s: f64) {
        self.deviation = deviation;
        self.time_constant_s = time_constant_s;
    }

    /// Lets `dt_s` pass; the result has the same distribution for any step.
    pub fn step(&mut self, dt_s: f64, random: &mut ChaCha8Rng) -> f64 {
        let kept = (-dt_s / self.time_constant_s.max(1e-6)).exp();
        self.value =
            kept * self.value + self.deviation * (1.0 - kept * kept).sqrt() * normal(random);
        self.value
    }

    /// The present value.
    pub fn value(&self) -> f64 {
        self.value
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_drift_keeps_its_deviation_and_forgets_at_its_pace() {
        let mut random = random_stream(1, 0);
        let mut drift = Drift::new(2.0, 0.5, &mut random);
        let values: Vec<f64> = (0..200_000).map(|_| drift.step(0.01, &mut random)).collect();
        let mean_of = |products: Vec<f64>| products.iter().sum::<f64>() / products.len() as f64;
        let variance = mean_of(values.iter().map(|v| v * v).collect());
        let lagged = mean_of(values.windows(51).map(|w| w[0] * w[50]).collect());
        assert!((variance - 4.0).abs() < 0.4, "{variance}");
        assert!((lagged / variance - (-1.0f64).exp()).abs() < 0.06, "{}", lagged / variance);
    }

    #[test]
    fn streams_of_one_seed_differ_and_repeat() {
        let draw = |seed, stream| normal(&mut random_stream(seed, stream));
        assert_eq!(draw(7, 1), draw(7, 1));
        assert_ne!(draw(7, 1), draw(7, 2));
        assert_ne!(draw(7, 1), draw(8, 1));
    }
}
