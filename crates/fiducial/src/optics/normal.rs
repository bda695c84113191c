//! Computes the standard normal distribution.

use std::f64::consts::TAU;

/// Share of the standard normal distribution below `z`, by its power series, which converges for every
/// argument.
pub(crate) fn cumulative(z: f64) -> f64 {
    let (mut term, mut sum) = (z, z);
    for k in 1..200 {
        term *= z * z / f64::from(2 * k + 1);
        sum += term;
    }
    0.5 + sum * (-0.5 * z * z).exp() / TAU.sqrt()
}

/// Density of the standard normal distribution at `z`.
pub(crate) fn density(z: f64) -> f64 {
    (-0.5 * z * z).exp() / TAU.sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_distribution_matches_tabulated_values() {
        for (z, expected) in
            [(0.0, 0.5), (1.0, 0.841_344_746_068_543), (-2.0, 0.022_750_131_948_179), (8.0, 1.0)]
        {
            assert!((cumulative(z) - expected).abs() < 1e-14, "{z}");
        }
        assert!((density(1.0) - 0.241_970_724_519_143).abs() < 1e-14);
    }
}
