//! SVG plots of the landing experiment: error against wind with medians, touchdown points from above, success of each combination,
//! the share with a larger error.

use anyhow::anyhow;
use messages::Touchdown;
use node::stats::quantile;
use plotters::coord::CoordTranslate;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;

use super::outcome::{Ending, Outcome};
use super::table::{Column, cells, median_interval, numbers, share_interval};
use crate::results::PLOTS;

/// The colours of curves.
pub const COLOURS: [RGBColor; 6] = [
    RGBColor(31, 119, 180),
    RGBColor(214, 39, 40),
    RGBColor(44, 160, 44),
    RGBColor(148, 103, 189),
    RGBColor(255, 127, 14),
    RGBColor(23, 190, 207),
];
const GREY: RGBColor = RGBColor(150, 150, 150);

/// Why a plot cannot be drawn.
pub type DrawError = Box<dyn std::error::Error>;
/// A chart with numeric axes.
pub type Chart<'a, 'b> =
    ChartContext<'a, SVGBackend<'b>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

/// The plots: file names and contents.
///
/// # Errors
/// When one cannot be drawn.
pub fn all(outcomes: &[Outcome]) -> anyhow::Result<Vec<(&'static str, String)>> {
    let error: Column = |o| o.error_m.map(|error| 100.0 * error);
    let time: Column = |o| o.disarm_s;
    let plots = [
        picture([900, 560], |area| {
            against_wind(area, outcomes, error, "Touchdown error", "error, cm")
        })?,
        picture([900, 560], |area| {
            against_wind(area, outcomes, time, "Time to disarm", "time, s")
        })?,
        picture([700, 720], |area| touchdowns(area, outcomes))?,
        picture(success_size(outcomes), |area| success(area, outcomes))?,
        picture([900, 560], |area| worst(area, outcomes))?,
    ];
    Ok(PLOTS.into_iter().zip(plots).collect())
}

/// An SVG of a size in pixels.
///
/// # Errors
/// When it cannot be drawn.
pub fn picture(
    size: [u32; 2],
    draw: impl FnOnce(&DrawingArea<SVGBackend<'_>, plotters::coord::Shift>) -> Result<(), DrawError>,
) -> anyhow::Result<String> {
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, size.into()).into_drawing_area();
        area.fill(&WHITE).map_err(|problem| anyhow!("{problem}"))?;
        draw(&area).map_err(|problem| anyhow!("{problem}"))?;
        area.present().map_err(|problem| anyhow!("{problem}"))?;
    }
    Ok(svg)
}

type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;

/// Every flight as a dot; for each 1 m/s of wind the median with its 95 % interval, and the 99th percentile.
fn against_wind(
    area: &Area<'_>,
    outcomes: &[Outcome],
    of: Column,
    title: &str,
    axis: &str,
) -> Result<(), DrawError> {
    let landed: Vec<&Outcome> = outcomes.iter().filter(|o| o.ending == Ending::Landed).collect();
    let fastest = outcomes.iter().map(|o| o.wind_m_s).fold(1.0, f64::max);
    let max = 1.15 * numbers(&landed, of).into_iter().fold(0.1, f64::max);
    let mut chart = ChartBuilder::on(area)
        .caption(
            format!("{title} against mean wind, {} flights", outcomes.len()),
            ("sans-serif", 20),
        )
        .margin(12)
        .x_label_area_size(40)
        .y_label_area_size(56)
        .build_cartesian_2d(-0.4..fastest + 0.6, 0.0..max)?;
    chart.configure_mesh().x_desc("mean wind, m/s").y_desc(axis).draw()?;
    let dots = landed.iter().filter_map(|o| Some((o.wind_m_s, of(o)?)));
    chart.draw_series(dots.map(|at| Circle::new(at, 2, GREY.mix(0.5).filled())))?;
    let bins: Vec<(f64, Vec<f64>)> = (0..=fastest.ceil() as u32)
        .filter_map(|bin| {
            let near = |o: &&Outcome| (o.wind_m_s - f64::from(bin)).abs() <= 0.5;
            let members: Vec<&Outcome> = landed.iter().copied().filter(|o| near(o)).collect();
            let values = numbers(&members, of);
            (!values.is_empty()).then_some((f64::from(bin), values))
        })
        .collect();
    let curve = |part: f64| -> Vec<(f64, f64)> {
        bins.iter().filter_map(|(bin, values)| Some((*bin, quantile(values, part)?))).collect()
    };
    for (index, (part, name)) in
        [(0.5, "median, 95 % interval"), (0.99, "99 %")].into_iter().enumerate()
    {
        let colour = COLOURS[index];
        chart
            .draw_series(LineSeries::new(curve(part), colour.stroke_width(2)))?
            .label(name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], colour.stroke_width(2)));
    }
    for (bin, values) in &bins {
        if let Some([low, high]) = median_interval(values) {
            error_bar(&mut chart, *bin, [low, high], COLOURS[0])?;
        }
    }
    legend(&mut chart, SeriesLabelPosition::UpperLeft)
}

fn error_bar(
    chart: &mut Chart<'_, '_>,
    x: f64,
    [low, high]: [f64; 2],
    colour: RGBColor,
) -> Result<(), DrawError> {
    let bar = |points: [(f64, f64); 2]| PathElement::new(points, colour.stroke_width(2));
    let ends = [low, high].map(|y| bar([(x - 0.08, y), (x + 0.08, y)]));
    chart.draw_series(ends.into_iter().chain([bar([(x, low), (x, high)])]))?;
    Ok(())
}

/// Draws the legend.
///
/// # Errors
/// When it cannot be drawn.
pub fn legend<'a, 'b: 'a, Axes: CoordTranslate>(
    chart: &mut ChartContext<'a, SVGBackend<'b>, Axes>,
    position: SeriesLabelPosition,
) -> Result<(), DrawError> {
    chart
        .configure_series_labels()
        .position(position)
        .background_style(WHITE.mix(0.85))
        .border_style(BLACK)
        .draw()?;
    Ok(())
}

/// The touchdown points, seen from above.
fn touchdowns(area: &Area<'_>, outcomes: &[Outcome]) -> Result<(), DrawError> {
    let places: Vec<(f64, f64, bool)> = outcomes
        .iter()
        .filter_map(|o| Some((o.error_east_m?, o.error_north_m?, o.is_unsafe())))
        .collect();
    let far = places.iter().map(|p| p.0.abs().max(p.1.abs())).fold(0.11, f64::max);
    let reach = if far > Touchdown::MAX_ERROR_M { 1.1 * far } else { far.max(0.12) * 1.1 };
    let mut chart = ChartBuilder::on(area)
        .caption("Touchdowns relative to the pad's centre", ("sans-serif", 20))
        .margin(12)
        .x_label_area_size(40)
        .y_label_area_size(56)
        .build_cartesian_2d(-reach..reach, -reach..reach)?;
    // Adding zero makes 0 of -0.
    let metres = |m: &f64| format!("{}", (m * 1e3).round() / 1e3 + 0.0);
    chart
        .configure_mesh()
        .x_desc("east, m")
        .y_desc("north, m")
        .x_label_formatter(&metres)
        .y_label_formatter(&metres)
        .draw()?;
    let radii = [0.05, 0.1, Touchdown::MAX_ERROR_M].into_iter().enumerate();
    for (index, radius) in radii.filter(|(_, radius)| *radius < reach) {
        let circle = (0..=72).map(|i| {
            let (sin, cos) = (f64::from(i) * std::f64::consts::TAU / 72.0).sin_cos();
            (radius * sin, radius * cos)
        });
        let colour = COLOURS[[2, 4, 1][index]];
        chart
            .draw_series(LineSeries::new(
                circle.filter(|p| p.0.abs().max(p.1.abs()) < reach),
                colour,
            ))?
            .label(format!("{radius} m"))
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], colour));
    }
    chart.draw_series(places.iter().map(|(east, north, is_unsafe)| {
        let colour = if *is_unsafe { COLOURS[1] } else { COLOURS[0] };
        Circle::new((*east, *north), 4, colour.mix(0.5).filled())
    }))?;
    legend(&mut chart, SeriesLabelPosition::UpperRight)
}

fn success_size(outcomes: &[Outcome]) -> [u32; 2] {
    [1250, 110 + 30 * cells(outcomes).len() as u32]
}

/// The proportion within 0.1 m, with its interval, for each cell.
fn success(area: &Area<'_>, outcomes: &[Outcome]) -> Result<(), DrawError> {
    let cells = cells(outcomes);
    let count = cells.len() as f64;
    let mut chart = ChartBuilder::on(area)
        .caption("Proportion that landed within 0.1 m, with its 95 % interval", ("sans-serif", 20))
        .margin(12)
        .x_label_area_size(40)
        .build_cartesian_2d(0.0..200.0, 0.0..count)?;
    // The names of the cells are right of 100 %.
    let percent =
        |share: &f64| if *share > 100.5 { String::new() } else { format!("{share:.0} %") };
    chart
        .configure_mesh()
        .disable_mesh()
        .disable_y_axis()
        .axis_style(TRANSPARENT)
        .x_labels(11)
        .x_label_formatter(&percent)
        .draw()?;
    for tick in (0..=100u32).step_by(20).map(f64::from) {
        let line = PathElement::new([(tick, 0.0), (tick, count)], GREY.mix(0.5));
        chart.draw_series([line])?;
    }
    for (index, (name, members)) in cells.iter().enumerate() {
        let y = count - index as f64 - 0.5;
        let hits = members.iter().filter(|o| o.is_within(0.1)).count();
        let [low, high] = share_interval(hits, members.len()).map(|share| 100.0 * share);
        let share = 100.0 * hits as f64 / members.len().max(1) as f64;
        let line = PathElement::new([(low, y), (high, y)], COLOURS[0].stroke_width(3));
        chart.draw_series([line])?;
        chart.draw_series([Circle::new((share, y), 4, COLOURS[0].filled())])?;
        let short: String = name.chars().take(90).collect();
        let text = format!("{hits} of {}: {short}", members.len());
        let place = if low > 95.0 { 1.0 } else { 101.0 };
        chart.draw_series([Text::new(text, (place, y + 0.25), ("sans-serif", 13))])?;
    }
    Ok(())
}

/// The complementary cumulative distribution of the error, for each cell where they can be told apart.
fn worst(area: &Area<'_>, outcomes: &[Outcome]) -> Result<(), DrawError> {
    let mut cells = cells(outcomes);
    if cells.len() > COLOURS.len() {
        cells = vec![("all", outcomes.iter().collect())];
    }
    let distributions: Vec<(&str, Vec<f64>)> = cells
        .into_iter()
        .map(|(name, members)| {
            let mut errors = numbers(&members, |o| o.error_m.map(|error| 100.0 * error));
            errors.sort_by(f64::total_cmp);
            (name, errors)
        })
        .collect();
    let errors = || distributions.iter().flat_map(|(_, errors)| errors.iter().copied());
    let max_count = distributions.iter().map(|(_, errors)| errors.len()).max().unwrap_or(0).max(1);
    let (max_cm, min_share) = (1.1 * errors().fold(1.0, f64::max), 0.7 / max_count as f64);
    let mut chart = ChartBuilder::on(area)
        .caption("Proportion of the landings with a larger error", ("sans-serif", 20))
        .margin(12)
        .x_label_area_size(40)
        .y_label_area_size(64)
        .build_cartesian_2d(0.0..max_cm, (min_share..1.0).log_scale())?;
    chart
        .configure_mesh()
        .x_desc("touchdown error, cm")
        .y_desc("proportion")
        .y_label_formatter(&|share| format!("{}", (share * 1e6).round() / 1e6))
        .draw()?;
    for ((name, errors), colour) in distributions.iter().zip(COLOURS) {
        let short: String = name.chars().take(80).collect();
        chart
            .draw_series(LineSeries::new(steps(errors, min_share), colour.stroke_width(2)))?
            .label(format!("{short} ({})", errors.len()))
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], colour.stroke_width(2)));
    }
    legend(&mut chart, SeriesLabelPosition::UpperRight)
}

/// The proportion of ascending errors that are larger than each, as the corners of its steps; the last falls to `min_share`, where a
/// logarithmic axis ends.
fn steps(errors: &[f64], min_share: f64) -> Vec<(f64, f64)> {
    let count = errors.len() as f64;
    let corners = errors.iter().enumerate().flat_map(|(i, error)| {
        let larger = [i, i + 1].map(|smaller| (1.0 - smaller as f64 / count).max(min_share));
        larger.map(|proportion| (*error, proportion))
    });
    std::iter::once((0.0, 1.0)).chain(corners).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_proportion_with_a_larger_error_falls_at_each_error() {
        let corners = steps(&[1.0, 2.0], 0.1);
        assert_eq!(corners, [(0.0, 1.0), (1.0, 1.0), (1.0, 0.5), (2.0, 0.5), (2.0, 0.1)]);
        assert_eq!(steps(&[], 0.1), [(0.0, 1.0)]);
    }
}
