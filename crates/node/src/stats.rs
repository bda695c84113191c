//! Computes statistics of samples: for health reports, tools and experiments.

/// The mean; `None` for an empty sample.
pub fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// The sample standard deviation; `None` for fewer than two values.
pub fn standard_deviation(values: &[f64]) -> Option<f64> {
    let mean = mean(values)?;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    (values.len() > 1).then(|| (squares / (values.len() - 1) as f64).sqrt())
}

/// The quantile at `fraction` (0.5 for the median): the value of nearest rank. `None` for an empty sample.
pub fn quantile(values: &[f64], fraction: f64) -> Option<f64> {
    let sorted = sorted(values);
    sorted.get((fraction * sorted.len().saturating_sub(1) as f64).round() as usize).copied()
}

/// The quantile at `fraction`, interpolated between the two nearest values. `None` for an empty sample.
pub fn interpolated_quantile(values: &[f64], fraction: f64) -> Option<f64> {
    let sorted = sorted(values);
    let rank = fraction * sorted.len().saturating_sub(1) as f64;
    let (low, high) = (sorted.get(rank.floor() as usize)?, sorted.get(rank.ceil() as usize)?);
    Some(low + (high - low) * rank.fract())
}

fn sorted(values: &[f64]) -> Vec<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    sorted
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_values_of_the_sample_or_lie_between_two() {
        let sample = [4.0, 1.0, 3.0, 2.0];
        assert_eq!([0.0, 0.5, 0.99].map(|part| quantile(&sample, part).unwrap()), [1.0, 3.0, 4.0]);
        assert_eq!(interpolated_quantile(&sample, 0.5), Some(2.5));
        assert_eq!(interpolated_quantile(&[3.0, 1.0, 2.0], 0.5), Some(2.0));
        assert_eq!((quantile(&[], 0.5), interpolated_quantile(&[], 0.5)), (None, None));
    }

    #[test]
    fn the_deviation_is_that_of_a_sample() {
        assert_eq!(standard_deviation(&[1.0, 3.0]), Some(2f64.sqrt()));
        assert_eq!((mean(&[]), standard_deviation(&[1.0])), (None, None));
    }
}
