//! Summarises many flights as tables.

use node::stats::interpolated_quantile;

use super::outcome::{Ending, HARD_M_S, Outcome, SLIDING_M_S, TILTED_DEG};

/// A column of numbers, without missing ones.
pub type Column = fn(&Outcome) -> Option<f64>;

/// The numbers of the flights that landed.
pub fn numbers(outcomes: &[&Outcome], of: Column) -> Vec<f64> {
    let landed = outcomes.iter().filter(|outcome| outcome.ending == Ending::Landed);
    landed.filter_map(|outcome| of(outcome)).collect()
}

/// A percentile, `part` from 0 to 1; `None` for fewer numbers than it is one of: 100 for the 99th, 20 for the 95th. Of fewer it would be
/// little else than the greatest.
pub fn percentile(numbers: &[f64], part: f64) -> Option<f64> {
    // A little less, as 1 - 0.95 is a little more than 0.05.
    let enough = 1.0 / (1.0 - part) - 1e-6;
    interpolated_quantile(numbers, part).filter(|_| numbers.len() as f64 >= enough)
}

/// 95 % confidence interval of the median from order statistics, which is that of the sign test. `None` for fewer than six numbers,
/// which are not enough for it.
pub fn median_interval(numbers: &[f64]) -> Option<[f64; 2]> {
    let mut sorted = numbers.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let left_out = left_out(sorted.len());
    let low = left_out.checked_sub(1)?;
    Some([*sorted.get(low)?, *sorted.get(sorted.len().checked_sub(left_out)?)?])
}

/// How many numbers on each side of the median's interval are as improbable as to be left out.
fn left_out(count: usize) -> usize {
    heads(count).take_while(|at_most| *at_most <= 0.025).count()
}

/// The probability that [`median_interval`] of so many numbers contains the median: 0.95 or more, as it ends at one of the numbers. `None`
/// where there is no interval.
pub fn median_coverage(count: usize) -> Option<f64> {
    let beyond = heads(count).nth(left_out(count).checked_sub(1)?)?;
    Some(1.0 - 2.0 * beyond)
}

/// The probability of at most 0, 1, 2, ... heads in so many tosses of a coin.
fn heads(tosses: usize) -> impl Iterator<Item = f64> {
    let count = tosses as f64;
    // The logarithm of the probability of each number, so that no number of tosses is too large.
    let mut of_this = -count * std::f64::consts::LN_2;
    let mut at_most = 0.0;
    (0..=tosses).map(move |number| {
        at_most += of_this.exp();
        of_this += ((count - number as f64) / (number as f64 + 1.0)).ln();
        at_most
    })
}

/// Two-sided sign test: the probability of numbers as unequal as these or more so if both were equally probable.
pub fn sign_test(some: usize, others: usize) -> f64 {
    let at_most = heads(some + others).nth(some.min(others));
    at_most.map_or(1.0, |at_most| (2.0 * at_most).min(1.0))
}

/// 95 % confidence interval of a proportion (Wilson, 1927).
pub fn share_interval(hits: usize, of: usize) -> [f64; 2] {
    let (z, n) = (1.96_f64, (of as f64).max(1.0));
    let proportion = hits as f64 / n;
    let centre = (proportion + z * z / (2.0 * n)) / (1.0 + z * z / n);
    let half_width = z * (proportion * (1.0 - proportion) / n + z * z / (4.0 * n * n)).sqrt()
        / (1.0 + z * z / n);
    [(centre - half_width).max(0.0), (centre + half_width).min(1.0)]
}

/// The cells with their flights, in order.
pub fn cells(outcomes: &[Outcome]) -> Vec<(&str, Vec<&Outcome>)> {
    let mut cells: Vec<(&str, Vec<&Outcome>)> = Vec::new();
    for outcome in outcomes {
        match cells.iter_mut().find(|(name, _)| *name == outcome.cell) {
            Some((_, members)) => members.push(outcome),
            None => cells.push((&outcome.cell, vec![outcome])),
        }
    }
    cells
}

const HEADER: &str = "| circumstances | flights | landed | aborted | within 0.1 m | error: median, 99 % (of 100 landings or more), worst, m | to disarm: median, worst, s | sink worst, m/s | slide median, worst, m/s | tilt at touch worst, deg | beyond 0.6 m/s down, 0.1 m/s aside, 10 deg | unsafe |\n|---|---|---|---|---|---|---|---|---|---|---|---|\n";

/// The table of all cells in Markdown.
pub fn markdown(outcomes: &[Outcome]) -> String {
    let rows = cells(outcomes).into_iter().map(|(name, members)| row(name, &members));
    rows.fold(HEADER.to_owned(), |text, row| text + &row)
}

fn row(name: &str, members: &[&Outcome]) -> String {
    let count = |of: &dyn Fn(&Outcome) -> bool| members.iter().filter(|o| of(o)).count();
    let text = |of: Column, part: f64, digits: usize| {
        interpolated_quantile(&numbers(members, of), part)
            .map_or_else(|| "-".to_owned(), |number| format!("{number:.digits$}"))
    };
    let beyond = |of: Column, limit: f64| {
        members.iter().filter(|o| of(o).is_some_and(|number| number > limit)).count()
    };
    let sink: Column = |o| o.sink_m_s;
    let slide: Column = |o| o.slide_m_s;
    let tilt: Column = |o| o.touch_tilt_deg;
    let error: Column = |o| o.error_m;
    let disarm: Column = |o| o.disarm_s;
    format!(
        "| {name} | {} | {} | {} | {} | {} / {} / {} | {} / {} | {} | {} / {} | {} | {} / {} / {} | {} |\n",
        members.len(),
        count(&|o| o.ending == Ending::Landed),
        count(&|o| o.ending == Ending::Aborted),
        count(&|o| o.is_within(0.1)),
        text(error, 0.5, 3),
        percentile(&numbers(members, error), 0.99)
            .map_or_else(|| "-".to_owned(), |number| format!("{number:.3}")),
        text(error, 1.0, 3),
        text(disarm, 0.5, 1),
        text(disarm, 1.0, 1),
        text(sink, 1.0, 2),
        text(slide, 0.5, 2),
        text(slide, 1.0, 2),
        text(tilt, 1.0, 1),
        beyond(sink, HARD_M_S),
        beyond(slide, SLIDING_M_S),
        beyond(tilt, TILTED_DEG),
        count(&|o| o.is_unsafe()),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sign_test_is_that_of_a_fair_coin() {
        assert_eq!((sign_test(0, 0), sign_test(3, 3)), (1.0, 1.0));
        assert!((sign_test(0, 6) - 2.0 / 64.0).abs() < 1e-12);
        assert!((sign_test(7, 1) - 18.0 / 256.0).abs() < 1e-12);
        assert!(sign_test(0, 5000) < 1e-300);
    }

    #[test]
    fn a_percentile_is_given_of_enough_numbers() {
        let numbers = |count: u32| (0..count).map(f64::from).collect::<Vec<f64>>();
        assert_eq!(percentile(&numbers(99), 0.99), None);
        assert!(percentile(&numbers(100), 0.99).is_some_and(|it| it > 97.9 && it < 98.1));
        assert_eq!(
            (percentile(&numbers(19), 0.95), percentile(&numbers(21), 0.95)),
            (None, Some(19.0))
        );
        assert!(percentile(&numbers(20), 0.95).is_some());
    }

    #[test]
    fn the_table_has_a_percentile_of_a_hundred_landings_alone() {
        let of = |flights: u64| {
            let wind = super::super::plan::Values::List(vec![5.0]);
            let plan = super::super::plan::Plan { wind, flights, ..Default::default() };
            let landed = plan.flights().into_iter().map(|planned| Outcome {
                ending: Ending::Landed,
                error_m: Some(0.02),
                ..Outcome::new(&planned)
            });
            markdown(&landed.collect::<Vec<Outcome>>())
        };
        assert!(
            of(99).contains("| 0.020 / - / 0.020 |")
                && of(100).contains("| 0.020 / 0.020 / 0.020 |")
        );
    }

    #[test]
    fn intervals_contain_the_estimate_and_shrink_with_the_count() {
        let numbers: Vec<f64> = (0..101).map(f64::from).collect();
        let [low, high] = median_interval(&numbers).unwrap();
        assert!((38.0..=42.0).contains(&low) && (58.0..=62.0).contains(&high), "{low} {high}");
        // Of six coins, all show the same side in 2 of 64 tosses; of five in 2 of 32, which is more than 5 %.
        assert_eq!(median_interval(&[6.0, 2.0, 3.0, 4.0, 5.0, 1.0]), Some([1.0, 6.0]));
        assert_eq!(median_interval(&[1.0, 2.0, 3.0, 4.0, 5.0]), None);
        assert_eq!(median_interval(&[]), None);
        let covered =
            [5, 6, 8, 20].map(|count| median_coverage(count).map(|it| (1e4 * it).round()));
        assert_eq!(covered, [None, Some(9688.0), Some(9922.0), Some(9586.0)]);
        let many: Vec<f64> = (0..100_001).map(f64::from).collect();
        let [low, high] = median_interval(&many).unwrap();
        assert!((49_650.0..49_720.0).contains(&low) && low + high == 100_000.0, "{low} {high}");
        let [low, high] = share_interval(1000, 1000);
        assert!(low > 0.996 && high == 1.0, "{low}");
        let [low, high] = share_interval(50, 100);
        assert!((low - 0.404).abs() < 0.001 && (high - 0.596).abs() < 0.001, "{low} {high}");
    }
}
