//! Statistics of many flights, as rows of a table.

use super::Flight;

/// The smallest value below which the part `part` of them lies.
pub(crate) fn quantile(flights: &[Flight], part: f64, of: impl Fn(&Flight) -> f64) -> f64 {
    let mut values: Vec<f64> = flights.iter().map(of).collect();
    values.sort_by(f64::total_cmp);
    let last = values.len().saturating_sub(1);
    values.get(((last as f64 * part).round() as usize).min(last)).copied().unwrap_or(f64::NAN)
}

pub(crate) fn median(flights: &[Flight], of: impl Fn(&Flight) -> f64) -> f64 {
    quantile(flights, 0.5, of)
}

pub(crate) fn worst(flights: &[Flight], of: impl Fn(&Flight) -> f64) -> f64 {
    quantile(flights, 1.0, of)
}

/// The names of the columns of [`row`].
pub(crate) const HEADER: &str = "| case | flights | touched | aborted | within 0.1 m | error median, 90 %, worst, m | touch to disarm: s median, worst \
     | sink worst, m/s | slide worst, m/s | tilt worst, deg | unsafe |\n|---|---|---|---|---|---|---|---|---|---|---|";

/// One row about these flights.
pub(crate) fn row(name: &str, flights: &[Flight]) -> String {
    let touched: Vec<&Flight> =
        flights.iter().filter(|f| f.touchdown.is_some() && !f.aborted).collect();
    let pick = |part: f64, of: &dyn Fn(&Flight) -> f64| {
        let mut values: Vec<f64> = touched.iter().map(|f| of(f)).collect();
        values.sort_by(f64::total_cmp);
        let last = values.len().saturating_sub(1);
        values.get((last as f64 * part).round() as usize).copied().unwrap_or(f64::NAN)
    };
    let touch = |of: fn(&super::Touchdown) -> f64| {
        move |f: &Flight| f.touchdown.as_ref().map_or(f64::NAN, of)
    };
    let error = |f: &Flight| f.error_m;
    let disarm = |f: &Flight| f.disarm_s.unwrap_or(f64::INFINITY);
    format!(
        "| {name} | {} | {} | {} | {} | {:.3} {:.3} {:.3} | {:.1} {:.1} | {:.2} | {:.2} | {:.1} | {} |",
        flights.len(),
        touched.len(),
        flights.iter().filter(|f| f.aborted).count(),
        touched.iter().filter(|f| f.error_m <= 0.1).count(),
        pick(0.5, &error),
        pick(0.9, &error),
        pick(1.0, &error),
        pick(0.5, &disarm),
        pick(1.0, &disarm),
        pick(1.0, &touch(|t| t.sink_m_s)),
        pick(1.0, &touch(|t| t.slide_m_s)),
        pick(1.0, &touch(|t| t.tilt_rad)).to_degrees(),
        flights.iter().filter(|f| f.is_unsafe()).count(),
    )
}
