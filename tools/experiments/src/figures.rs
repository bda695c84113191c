//! Draws Figures 4.7 and 4.8 of the thesis: the mean estimated distance at each position for every marker.

use anyhow::anyhow;
use node::stats::mean;
use plotters::coord::Shift;
use plotters::prelude::*;
use rendering::views::{Binning, View, views};

use crate::landing::plots::{COLOURS, legend};
use crate::record::OURS;
use crate::report::Run;
use crate::set::{Set, families};
use crate::tables::{Position, positions};
use crate::thesis::TABLES;

/// The figures and their binnings.
pub const FIGURES: [(&str, &str); 2] = [("figure-4-7", "2x2"), ("figure-4-8", "4x4")];

/// One curve: a family, and the mean error at each position in metres.
type Curve = (String, Vec<Option<f64>>);

/// The colour of a family, the same for any selection of families.
fn colour_of(family: &str) -> RGBColor {
    let place = families().position(|name| name == family).unwrap_or(usize::MAX);
    COLOURS[place.min(COLOURS.len() - 1)]
}

/// The figure of a binning as SVG: the estimated distances with those of the thesis above, their errors
/// below. `None` without a run of the positions.
///
/// # Errors
/// When it cannot be drawn.
pub fn svg(runs: &[Run], binning: &str) -> anyhow::Result<Option<String>> {
    let of_set = |run: &&Run| run.set == Set::Positions && run.detector == OURS;
    let ours: Vec<&Run> = runs.iter().filter(of_set).collect();
    let Some(first) = ours.first() else { return Ok(None) };
    let truth = positions(first, binning);
    let curves: Vec<Curve> = ours
        .iter()
        .map(|run| {
            let errors = positions(run, binning).into_iter().map(|position| {
                let along: Vec<f64> = position.errors_m.iter().map(|error| error[0]).collect();
                position.is_complete().then(|| mean(&along)).flatten()
            });
            (run.family.clone(), errors.collect())
        })
        .collect();
    let thesis: Vec<Curve> = TABLES
        .iter()
        .filter(|table| table.binning == binning)
        .map(|table| {
            let errors = truth.iter().map(|Position { x_m, y_m, .. }| {
                let is_there = |row: &&crate::thesis::Row| {
                    row.0 == *x_m && f64::from(row.1).total_cmp(&0.0) == y_m.total_cmp(&0.0)
                };
                table.rows.iter().find(is_there).map(|row| row.2[0])
            });
            (table.family.to_owned(), errors.collect())
        })
        .collect();
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, (1000, 900)).into_drawing_area();
        let places = places(&truth);
        draw(&area, binning, &places, &curves, &thesis).map_err(|problem| anyhow!("{problem}"))?;
    }
    Ok(Some(svg))
}

/// A position on the horizontal axis: its number in Table 4.1, and the true distance in metres.
type Place = (f64, f64);

/// The positions in Table 4.1; with a part of the frames there may be a part of them.
fn places(truth: &[Position]) -> Vec<Place> {
    let all = views(Binning::TwoByTwo, 0.0, 1);
    let number = |at: &Position| {
        let is_here =
            |view: &View| view.height_m == at.x_m && view.lateral_m.total_cmp(&at.y_m).is_eq();
        all.iter().position(is_here)
    };
    let places = truth.iter().enumerate();
    places.map(|(i, at)| (number(at).unwrap_or(i) as f64 + 1.0, f64::from(at.x_m))).collect()
}

fn draw(
    area: &DrawingArea<SVGBackend<'_>, Shift>,
    binning: &str,
    places: &[Place],
    ours: &[Curve],
    thesis: &[Curve],
) -> Result<(), Box<dyn std::error::Error>> {
    area.fill(&WHITE)?;
    let (upper, lower) = area.split_vertically(500);
    let last = places.last().map_or(0.0, |(number, _)| *number);
    let title = format!("Mean estimated distance at each position, {binning} binning");
    let mut chart = ChartBuilder::on(&upper)
        .caption(title, ("sans-serif", 20))
        .margin(10)
        .x_label_area_size(40)
        .y_label_area_size(60)
        .build_cartesian_2d(0.0..last + 1.0, 0.0..15.0)?;
    chart
        .configure_mesh()
        .x_desc("position (Table 4.1)")
        .x_label_formatter(&|x| format!("{x:.0}"))
        .y_desc("distance, m")
        .draw()?;
    chart
        .draw_series(LineSeries::new(places.iter().copied(), BLACK.stroke_width(1)))?
        .label("truth")
        .legend(|(x, y)| PathElement::new([(x, y), (x + 16, y)], BLACK));
    for (index, (name, errors)) in ours.iter().chain(thesis).enumerate() {
        let colour = colour_of(name);
        let is_thesis = index >= ours.len();
        let points = places
            .iter()
            .zip(errors)
            .filter_map(|((number, x_m), error)| Some((*number, x_m + (*error)?)));
        if is_thesis {
            chart
                .draw_series(points.map(|place| Cross::new(place, 3, colour.mix(0.7))))?
                .label(format!("{name} (thesis)"))
                .legend(move |(x, y)| Cross::new((x + 8, y), 3, colour.mix(0.7)));
        } else {
            chart
                .draw_series(points.map(|place| Circle::new(place, 3, colour)))?
                .label(name)
                .legend(move |(x, y)| Circle::new((x + 8, y), 3, colour));
        }
    }
    legend(&mut chart, SeriesLabelPosition::UpperLeft)?;
    draw_errors(&lower, places, ours)
}

fn draw_errors(
    area: &DrawingArea<SVGBackend<'_>, Shift>,
    places: &[Place],
    ours: &[Curve],
) -> Result<(), Box<dyn std::error::Error>> {
    let last = places.last().map_or(0.0, |(number, _)| *number);
    let errors_mm = || ours.iter().flat_map(|(_, errors)| errors.iter().flatten().map(|e| 1e3 * e));
    let max = errors_mm().fold(1.0, |max: f64, error| max.max(error.abs())) * 1.1;
    let mut chart = ChartBuilder::on(area)
        .caption("Errors of this detector", ("sans-serif", 16))
        .margin(10)
        .x_label_area_size(40)
        .y_label_area_size(60)
        .build_cartesian_2d(0.0..last + 1.0, -max..max)?;
    chart
        .configure_mesh()
        .x_desc("position (Table 4.1)")
        .x_label_formatter(&|x| format!("{x:.0}"))
        .y_desc("mean error, mm")
        .draw()?;
    for (name, errors) in ours {
        let colour = colour_of(name);
        let points = places
            .iter()
            .zip(errors)
            .filter_map(|((number, _), error)| Some((*number, 1e3 * (*error)?)));
        chart.draw_series(points.map(|place| Circle::new(place, 3, colour)))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_position_has_its_number_in_the_table_also_where_others_are_missing() {
        let at = |x_m, y_m| {
            let (errors_m, estimates_m) = (Vec::new(), Vec::new());
            Position { x_m, y_m, frames: 1, errors_m, estimates_m }
        };
        let places = places(&[at(1, 0.0), at(3, 0.5), at(7, -2.0)]);
        assert_eq!(places, [(1.0, 1.0), (7.0, 3.0), (17.0, 7.0)]);
    }

    #[test]
    fn families_keep_their_colours() {
        let colours: Vec<RGBColor> =
            ["rings", "apriltag-16h5", "aruco-4x4-50", "stag-hd23"].map(colour_of).to_vec();
        assert!((1..4).all(|i| !colours[..i].contains(&colours[i])), "{colours:?}");
    }
}
