//! Draws SVG plots of the landing experiment: error against wind with medians for each fault, touchdown points from above,
//! success of each combination, the proportion with a larger error.

use anyhow::anyhow;
use messages::Touchdown;
use node::stats::interpolated_quantile as quantile;
use plotters::coord::CoordTranslate;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::outcome::{Ending, Outcome};
use super::table::{Column, cells, median_interval, numbers, percentile, share_interval};
use crate::results::PLOTS;
use crate::rows::rounded;

/// The colours of curves.
pub const COLOURS: [RGBColor; 6] = [
    RGBColor(31, 119, 180),
    RGBColor(214, 39, 40),
    RGBColor(44, 160, 44),
    RGBColor(148, 103, 189),
    RGBColor(255, 127, 14),
    RGBColor(23, 190, 207),
];
/// The font of a panel's caption.
const FONT: (&str, u32) = ("sans-serif", 16);
/// The colour of elements that are not a series.
pub const GREY: RGBColor = RGBColor(150, 150, 150);

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
    let error: Column = |o| o.error_m;
    let time: Column = |o| o.disarm_s;
    let size = against_wind_size(outcomes);
    let plots = [
        picture(size, |area| against_wind(area, outcomes, error, "Touchdown error", "error, m"))?,
        picture(size, |area| against_wind(area, outcomes, time, "Time to disarm", "time, s"))?,
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

/// A part of a picture.
pub type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;

/// The flights of each fault, in the order in which they were flown.
fn by_fault(outcomes: &[Outcome]) -> Vec<(&'static str, Vec<&Outcome>)> {
    let mut faults: Vec<(&str, Vec<&Outcome>)> = Vec::new();
    for outcome in outcomes {
        match faults.iter_mut().find(|(name, _)| *name == outcome.fault) {
            Some((_, members)) => members.push(outcome),
            None => faults.push((outcome.fault, vec![outcome])),
        }
    }
    faults
}

/// Columns and rows of panels, one for each fault.
fn panels(outcomes: &[Outcome]) -> [usize; 2] {
    let count = by_fault(outcomes).len().max(1);
    let columns = count.min(3);
    [columns, count.div_ceil(columns)]
}

/// Height of the heading over panels, in pixels.
const HEADING_PX: u32 = 96;
/// Number of landings from which their 99th percentile is given.
const ENOUGH_FOR_99: usize = 100;

fn against_wind_size(outcomes: &[Outcome]) -> [u32; 2] {
    match panels(outcomes) {
        [1, 1] => [900, 652],
        [columns, rows] => [480 * columns as u32, HEADING_PX + 360 * rows as u32],
    }
}

/// A panel for each fault, all with the same axes: every flight that landed as a dot; for each 1 m/s of wind the median with the interval
/// in which it lies, the 99th percentile or of fewer landings the worst, and how many landed: flights that gave up have no dot, and the remaining
/// ones may be the easy ones.
fn against_wind(
    area: &Area<'_>,
    outcomes: &[Outcome],
    of: Column,
    title: &str,
    axis: &str,
) -> Result<(), DrawError> {
    let (heading, below) = area.split_vertically(HEADING_PX);
    let title = format!("{title} against mean wind, {} flights", outcomes.len());
    heading.draw(&Text::new(title, (16, 10), ("sans-serif", 20)))?;
    // One key for all panels, in none of which it covers a flight.
    heading.draw(&Circle::new((24, 46), 3, GREY.filled()))?;
    heading.draw(&Text::new("a flight that landed", (36, 38), ("sans-serif", 13)))?;
    let bar = "median; bar: 95 % interval of the median, not the spread (from six flights on)";
    let numbered = "over each wind: landed of flown, red where not all landed";
    let percentile =
        format!("99 % (dots), of fewer than {ENOUGH_FOR_99} landings the worst (circles)");
    for (index, (x, text)) in [(190, bar), (190, percentile.as_str())].into_iter().enumerate() {
        let (line, y) = (COLOURS[index].stroke_width(2), 46 + 20 * index as i32);
        heading.draw(&PathElement::new([(x, y), (x + 16, y)], line))?;
        heading.draw(&Text::new(text, (x + 24, y - 8), ("sans-serif", 13)))?;
    }
    heading.draw(&Text::new(numbered, (24, 78), ("sans-serif", 13)))?;
    let all: Vec<&Outcome> = outcomes.iter().collect();
    let fastest = outcomes.iter().map(|o| o.wind_m_s).fold(1.0, f64::max);
    // With room for the numbers of flights over the dots.
    let reach = [fastest + 0.6, 1.25 * numbers(&all, of).into_iter().fold(1e-3, f64::max)];
    let [columns, rows] = panels(outcomes);
    let areas = below.split_evenly((rows, columns));
    for (panel, (fault, members)) in areas.iter().zip(by_fault(outcomes)) {
        one_fault(panel, fault, &members, of, axis, reach)?;
    }
    Ok(())
}

fn one_fault(
    area: &Area<'_>,
    fault: &str,
    members: &[&Outcome],
    of: Column,
    axis: &str,
    [fastest, max]: [f64; 2],
) -> Result<(), DrawError> {
    let landed: Vec<&Outcome> =
        members.iter().copied().filter(|o| o.ending == Ending::Landed).collect();
    let title = match fault {
        "none" => "no fault".to_owned(),
        name => name.to_owned(),
    };
    let mut chart = ChartBuilder::on(area)
        .caption(format!("{title}, {} of {} landed", landed.len(), members.len()), FONT)
        .margin(12)
        .x_label_area_size(40)
        .y_label_area_size(56)
        .build_cartesian_2d(-0.4..fastest, 0.0..max)?;
    chart.configure_mesh().x_desc("mean wind, m/s").y_desc(axis).x_labels(8).y_labels(6).draw()?;
    let dots: Vec<(f64, f64)> = landed.iter().filter_map(|o| Some((o.wind_m_s, of(o)?))).collect();
    chart.draw_series(dots.into_iter().map(|at| Circle::new(at, 2, GREY.mix(0.7).filled())))?;
    let bins = bins(members, of);
    let median =
        |bin: &Bin| Some(Mark { x: bin.wind_m_s, y: quantile(&bin.values, 0.5)?, is_filled: true });
    let worst = |bin: &Bin| {
        let (y, is_filled) = bin.worst()?;
        Some(Mark { x: bin.wind_m_s, y, is_filled })
    };
    draw_line(&mut chart, &bins.iter().filter_map(median).collect::<Vec<Mark>>(), COLOURS[0])?;
    draw_line(&mut chart, &bins.iter().filter_map(worst).collect::<Vec<Mark>>(), COLOURS[1])?;
    for bin in &bins {
        if let Some([low, high]) = median_interval(&bin.values) {
            error_bar(&mut chart, bin.wind_m_s, [low, high], COLOURS[0])?;
        }
    }
    let width_px = chart.plotting_area().dim_in_pixel().0;
    let lines = number_lines(&bins, f64::from(width_px) / (fastest + 0.4));
    for (index, bin) in bins.iter().enumerate() {
        let colour = if bin.landed < bin.flown { COLOURS[1] } else { BLACK };
        let centred = Pos::new(HPos::Center, VPos::Top);
        let style = ("sans-serif", 12).into_font().color(&colour).pos(centred);
        let y = (0.99 - 0.05 * (index % lines) as f64) * max;
        chart.draw_series([Text::new(bin.number(), (bin.wind_m_s, y), style)])?;
    }
    Ok(())
}

/// The number of lines over which the numbers over the winds alternate, so that none covers its neighbour.
fn number_lines(bins: &[Bin], px_per_m_s: f64) -> usize {
    // Of digits 12 pixels high, with a gap.
    const WIDTH_PX: f64 = 8.0;
    let longest = bins.iter().map(|bin| bin.number().len()).max().unwrap_or(0);
    if WIDTH_PX * longest as f64 > px_per_m_s { 2 } else { 1 }
}

/// The flights of 1 m/s of wind.
struct Bin {
    wind_m_s: f64,
    flown: usize,
    landed: usize,
    /// Of those that landed.
    values: Vec<f64>,
}

impl Bin {
    /// How many landed of how many.
    fn number(&self) -> String {
        format!("{}/{}", self.landed, self.flown)
    }

    /// The 99th percentile (true), or of too few landings the greatest value.
    fn worst(&self) -> Option<(f64, bool)> {
        let percentile = percentile(&self.values, 0.99).map(|value| (value, true));
        percentile.or_else(|| Some((quantile(&self.values, 1.0)?, false)))
    }
}

/// The winds with flights, whether they landed or not.
fn bins(members: &[&Outcome], of: Column) -> Vec<Bin> {
    let fastest = members.iter().map(|o| o.wind_m_s).fold(0.0, f64::max);
    let bin = |wind: u32| {
        let wind_m_s = f64::from(wind);
        // Each flight is in one of them.
        let is_near = |o: &&Outcome| (o.wind_m_s + 0.5).floor() as u32 == wind;
        let near: Vec<&Outcome> = members.iter().copied().filter(is_near).collect();
        let landed = near.iter().filter(|o| o.ending == Ending::Landed).count();
        let (flown, values) = (near.len(), numbers(&near, of));
        (flown > 0).then_some(Bin { wind_m_s, flown, landed, values })
    };
    (0..=fastest.ceil() as u32).filter_map(bin).collect()
}

/// A point of a line, a dot or else a circle.
struct Mark {
    x: f64,
    y: f64,
    is_filled: bool,
}

/// A line through points. One through one wind alone has no length, but its point.
fn draw_line(
    chart: &mut Chart<'_, '_>,
    points: &[Mark],
    colour: RGBColor,
) -> Result<(), DrawError> {
    let places = points.iter().map(|at| (at.x, at.y));
    chart.draw_series(LineSeries::new(places, colour.stroke_width(2)))?;
    let dots = points.iter().map(|at| match at.is_filled {
        true => Circle::new((at.x, at.y), 3, colour.filled()),
        false => Circle::new((at.x, at.y), 4, colour.stroke_width(2)),
    });
    chart.draw_series(dots)?;
    Ok(())
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
    let metres = |m: &f64| rounded(*m, 3).to_string();
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
    let dots = |is_unsafe: bool, colour: RGBColor| {
        let shown = places.iter().filter(move |place| place.2 == is_unsafe);
        shown.map(move |(east, north, _)| Circle::new((*east, *north), 4, colour.mix(0.5).filled()))
    };
    chart.draw_series(dots(false, COLOURS[0]))?;
    // Without such flights the legend has no entry for them.
    if places.iter().any(|place| place.2) {
        chart
            .draw_series(dots(true, COLOURS[1]))?
            .label("unsafe")
            .legend(|(x, y)| Circle::new((x + 8, y), 4, COLOURS[1].mix(0.5).filled()));
    }
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
        .caption(
            "Proportion that landed within 0.1 m, with its 95 % interval (Wilson)",
            ("sans-serif", 20),
        )
        .margin(12)
        .x_label_area_size(40)
        .build_cartesian_2d(0.0..200.0, 0.0..count)?;
    // The names of the cells are right of 100 %.
    let percent =
        |value: &f64| if *value > 100.5 { String::new() } else { format!("{value:.0} %") };
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
        let [low, high] = share_interval(hits, members.len()).map(|bound| 100.0 * bound);
        let percent = 100.0 * hits as f64 / members.len().max(1) as f64;
        let line = PathElement::new([(low, y), (high, y)], COLOURS[0].stroke_width(3));
        chart.draw_series([line])?;
        chart.draw_series([Circle::new((percent, y), 4, COLOURS[0].filled())])?;
        let short: String = name.chars().take(90).collect();
        let text = format!("{hits} of {}: {short}", members.len());
        let place = if low > 95.0 { 1.0 } else { 101.0 };
        chart.draw_series([Text::new(text, (place, y + 0.25), ("sans-serif", 13))])?;
    }
    Ok(())
}

/// The complementary cumulative distribution of the error, for each cell where they can be distinguished.
fn worst(area: &Area<'_>, outcomes: &[Outcome]) -> Result<(), DrawError> {
    let mut cells = cells(outcomes);
    if cells.len() > COLOURS.len() {
        cells = vec![("all", outcomes.iter().collect())];
    }
    let distributions: Vec<(&str, Vec<f64>)> = cells
        .into_iter()
        .map(|(name, members)| {
            let mut errors = numbers(&members, |o| o.error_m);
            errors.sort_by(f64::total_cmp);
            (name, errors)
        })
        .collect();
    let errors = || distributions.iter().flat_map(|(_, errors)| errors.iter().copied());
    let max_count = distributions.iter().map(|(_, errors)| errors.len()).max().unwrap_or(0).max(1);
    let (max_m, min_share) = (1.1 * errors().fold(0.01, f64::max), 0.7 / max_count as f64);
    let mut chart = ChartBuilder::on(area)
        .caption("Proportion of the landings with a larger error", ("sans-serif", 20))
        .margin(12)
        .x_label_area_size(40)
        .y_label_area_size(64)
        .build_cartesian_2d(
            0.0..max_m,
            (min_share..1.0).log_scale().with_key_points(share_ticks(min_share)),
        )?;
    chart
        .configure_mesh()
        .x_desc("touchdown error, m")
        .y_desc("proportion")
        .y_label_formatter(&|proportion| format!("{}", (proportion * 1e6).round() / 1e6))
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

/// The ticks of a logarithmic axis of proportions down to this one: 1, 0.5, 0.2, 0.1 and so on, where those are few also 0.7 and the like.
fn share_ticks(min_share: f64) -> Vec<f64> {
    let down_to = |steps: &[f64]| {
        let decades = (0..9).map(|decade| 10f64.powi(-decade));
        let ticks = decades.flat_map(|decade| steps.iter().map(move |step| step * decade));
        ticks.filter(|tick| *tick >= min_share).collect::<Vec<f64>>()
    };
    let ticks = down_to(&[1.0, 0.5, 0.2]);
    if ticks.len() < 3 { down_to(&[1.0, 0.9, 0.8, 0.7, 0.6, 0.5]) } else { ticks }
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
    use crate::landing::plan::Plan;

    #[test]
    fn an_axis_of_proportions_has_three_ticks_or_more() {
        for (flights, at_least) in [(1, 3), (2, 3), (3, 3), (4, 3), (10, 4), (1000, 9)] {
            let min_share = 0.7 / f64::from(flights);
            let ticks = share_ticks(min_share);
            assert!(ticks.len() >= at_least && ticks.len() < 12, "{flights}: {ticks:?}");
            assert!(ticks.iter().all(|tick| (min_share..=1.0).contains(tick)), "{ticks:?}");
        }
    }

    #[test]
    fn each_fault_has_its_own_panel_and_the_bar_is_explained() {
        let faults = ["none", "gust", "silence-2s", "lie"].map(|name| name.parse().unwrap());
        let plan = Plan { faults: faults.to_vec(), ..Plan::default() };
        let outcomes: Vec<Outcome> = plan
            .flights()
            .iter()
            .map(|planned| Outcome {
                ending: Ending::Landed,
                error_m: Some(0.01),
                disarm_s: Some(12.0),
                ..Outcome::new(planned)
            })
            .collect();
        let plots = all(&outcomes).unwrap();
        for (name, svg) in plots.iter().take(2) {
            for text in ["no fault, 80 of 80 landed", "gust, 80 of", "silence-2s, ", "lie, "] {
                assert!(svg.contains(text), "{text} is not in {name}");
            }
            assert_eq!(svg.matches("mean wind, m/s").count(), 4, "{name}");
            assert!(svg.contains("95 % interval of the median") && !svg.contains("cm\n"), "{name}");
        }
    }

    #[test]
    fn flights_that_gave_up_count_in_their_wind() {
        let wind = crate::landing::plan::Values::List(vec![0.0, 8.0]);
        let plan = Plan { wind, flights: 8, ..Plan::default() };
        let flown = |planned: &crate::landing::plan::Planned| Outcome {
            ending: match planned.wind_m_s > 5.0 && planned.seed > 1 {
                true => Ending::Aborted,
                false => Ending::Landed,
            },
            error_m: Some(0.01 * planned.seed as f64),
            ..Outcome::new(planned)
        };
        let outcomes: Vec<Outcome> = plan.flights().iter().map(flown).collect();
        let plots = all(&outcomes).unwrap();
        for text in ["8/8", "1/8", "of fewer than 100 landings the worst"] {
            assert!(plots[0].1.contains(text), "{text} is not in the plot");
        }
        let members: Vec<&Outcome> = outcomes.iter().collect();
        let bins = bins(&members, |o| o.error_m);
        let worst: Vec<_> = bins.iter().map(|bin| (bin.landed, bin.flown, bin.worst())).collect();
        assert_eq!(worst, [(8, 8, Some((0.08, false))), (1, 8, Some((0.01, false)))]);
        // Three characters need 24 pixels next to each other.
        assert_eq!([23.0, 25.0].map(|px_per_m_s| number_lines(&bins, px_per_m_s)), [2, 1]);
    }

    #[test]
    fn the_proportion_with_a_larger_error_falls_at_each_error() {
        let corners = steps(&[1.0, 2.0], 0.1);
        assert_eq!(corners, [(0.0, 1.0), (1.0, 1.0), (1.0, 0.5), (2.0, 0.5), (2.0, 0.1)]);
        assert_eq!(steps(&[], 0.1), [(0.0, 1.0)]);
    }
}
