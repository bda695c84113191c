//! Draws the thesis' Figures 4.10 to 4.16 for one flight: trajectory, position and command per axis, wind and
//! command per axis.

use std::ops::Range;

use plotters::prelude::*;

use super::flight::Sample;
use super::plots::{COLOURS, Chart, DrawError, legend, picture};
use crate::results::FIGURES;

/// The axes with their names in the thesis, in the order of its figures.
const AXES: [&str; 3] = ["x (north)", "y (east)", "z (down)"];

/// The figures: file names and contents. `title` names the flight.
///
/// # Errors
/// When one cannot be drawn.
pub fn all(title: &str, samples: &[Sample]) -> anyhow::Result<Vec<(&'static str, String)>> {
    let mut figures = vec![trajectory(title, samples)?];
    for (axis, name) in AXES.into_iter().enumerate() {
        let position = |s: &Sample| Some(component(s.position.coords.coords.into(), axis));
        let pad = |s: &Sample| Some(component(s.pad.coords.coords.into(), axis));
        let command = |s: &Sample| s.command.map(|command| component(command, axis));
        let motion = [
            Curve { name: "position, m", of: &position },
            Curve { name: "pad, m", of: &pad },
            Curve { name: "command velocity, m/s", of: &command },
        ];
        let caption = format!("Position and command velocity, {name}: {title}");
        figures.push(curves(&caption, samples, &motion)?);
    }
    for (axis, name) in AXES.into_iter().enumerate() {
        let command = |s: &Sample| s.command.map(|command| component(command, axis));
        let wind = |s: &Sample| Some(component(s.wind.coords.into(), axis));
        let air = [
            Curve { name: "wind, m/s", of: &wind },
            Curve { name: "command velocity, m/s", of: &command },
        ];
        let caption = format!("Wind and command velocity, {name}: {title}");
        figures.push(curves(&caption, samples, &air)?);
    }
    Ok(FIGURES.into_iter().zip(figures).collect())
}

struct Curve<'a> {
    name: &'static str,
    of: &'a dyn Fn(&Sample) -> Option<f64>,
}

fn component(vector: [f64; 3], axis: usize) -> f64 {
    vector.get(axis).copied().unwrap_or_default()
}

/// Height of the legend above the curves, relative to theirs.
const LEGEND_RATIO: f64 = 0.32;

/// The range of finite values; from 0 to 1 without any. Marks along an axis without an end are never all set.
fn span(values: impl Iterator<Item = f64>) -> Range<f64> {
    let widened = |so_far: Option<Range<f64>>, value: f64| {
        let Range { start, end } = so_far.unwrap_or(value..value);
        Some(start.min(value)..end.max(value))
    };
    values.filter(|value| value.is_finite()).fold(None, widened).unwrap_or(0.0..1.0)
}

fn with_legend(range: Range<f64>) -> Range<f64> {
    let height = range.end - range.start;
    range.start..range.end + 0.5 * LEGEND_RATIO * height
}

/// Curves over time.
fn curves(caption: &str, samples: &[Sample], curves: &[Curve<'_>]) -> anyhow::Result<String> {
    let values = curves.iter().flat_map(|curve| samples.iter().filter_map(curve.of));
    let Range { start: min, end: max } = span(values.chain([-0.1, 0.1]));
    let last_s = samples.last().map_or(1.0, |sample| sample.time_s.max(0.1));
    picture([900, 480], |area| {
        let margin = 0.08 * (max - min);
        let mut chart = ChartBuilder::on(area)
            .caption(caption, ("sans-serif", 17))
            .margin(12)
            .x_label_area_size(40)
            .y_label_area_size(56)
            .build_cartesian_2d(0.0..last_s, min - margin..max + LEGEND_RATIO * (max - min))?;
        chart.configure_mesh().x_desc("time, s").draw()?;
        for (index, curve) in curves.iter().enumerate() {
            let points = samples.iter().filter_map(|s| Some((s.time_s, (curve.of)(s)?)));
            draw_curve(&mut chart, index, curve.name, points)?;
        }
        legend(&mut chart, SeriesLabelPosition::UpperRight)
    })
}

fn draw_curve(
    chart: &mut Chart<'_, '_>,
    index: usize,
    name: &str,
    points: impl Iterator<Item = (f64, f64)>,
) -> Result<(), DrawError> {
    let colour = COLOURS[index % COLOURS.len()];
    chart
        .draw_series(LineSeries::new(points, colour.stroke_width(2)))?
        .label(name)
        .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], colour.stroke_width(2)));
    Ok(())
}

/// Size of a view of the trajectory in pixels.
const VIEW: [u32; 2] = [550, 560];

/// A view of the trajectory, without its axes.
fn view<'a, 'b>(
    area: &'a DrawingArea<SVGBackend<'b>, plotters::coord::Shift>,
    caption: &str,
) -> ChartBuilder<'a, 'b, SVGBackend<'b>> {
    let mut builder = ChartBuilder::on(area);
    builder
        .caption(caption, ("sans-serif", 15))
        .margin(12)
        .x_label_area_size(40)
        .y_label_area_size(50);
    builder
}

/// Pixels between the axes of a view, which is known only of a drawn one.
fn plot_size() -> anyhow::Result<[f64; 2]> {
    let mut size = [1.0; 2];
    picture(VIEW, |area| {
        let chart = view(area, "from above").build_cartesian_2d(0.0..1.0, 0.0..1.0)?;
        let (width, height) = chart.plotting_area().dim_in_pixel();
        size = [width, height].map(f64::from);
        Ok(())
    })?;
    Ok(size)
}

/// Ranges of two axes around these, with one scale for both on this number of pixels, so that a landing is not distorted.
fn to_scale(ranges: [Range<f64>; 2], size: [f64; 2]) -> [Range<f64>; 2] {
    let length = |range: &Range<f64>| range.end - range.start;
    let mut metres_a_pixel = 0.0;
    for (range, pixels) in ranges.iter().zip(size) {
        metres_a_pixel = f64::max(metres_a_pixel, length(range) / pixels);
    }
    let [x, y] = ranges;
    let [width, height] = size.map(|pixels| metres_a_pixel * pixels);
    let around = |range: Range<f64>, length: f64| {
        let centre = (range.start + range.end) / 2.0;
        centre - length / 2.0..centre + length / 2.0
    };
    [around(x, width), around(y, height)]
}

/// The trajectory seen from above and from the south.
fn trajectory(title: &str, samples: &[Sample]) -> anyhow::Result<String> {
    let place = |s: &Sample| [s.position.y(), s.position.x(), -s.position.z()];
    let pad = |s: &Sample| [s.pad.y(), s.pad.x(), -s.pad.z()];
    let range = |axis: usize| {
        let values = samples.iter().flat_map(|s| [place(s), pad(s)]).map(|p| component(p, axis));
        let Range { start: min, end: max } = span(values);
        let margin = 0.1 * (max - min).max(0.5);
        min - margin..max + margin
    };
    let size = plot_size()?;
    picture([2 * VIEW[0], VIEW[1]], |area| {
        let (left, right) = area.split_horizontally(VIEW[0]);
        let views = [
            (left, [0, 1], format!("{title}: from above"), "north, m"),
            (right, [0, 2], "from the south".to_owned(), "height, m"),
        ];
        for (half, [across, up], caption, axis) in views {
            let [x, y] = to_scale([range(across), with_legend(range(up))], size);
            let mut chart = view(&half, &caption).build_cartesian_2d(x, y)?;
            chart.configure_mesh().x_desc("east, m").y_desc(axis).draw()?;
            let flat = |p: [f64; 3]| (component(p, across), component(p, up));
            draw_curve(&mut chart, 0, "vehicle", samples.iter().map(|s| flat(place(s))))?;
            draw_curve(&mut chart, 1, "pad", samples.iter().map(|s| flat(pad(s))))?;
            let pad_end = samples.last().map(|s| flat(pad(s)));
            chart.draw_series(pad_end.map(|at| Cross::new(at, 6, COLOURS[1].stroke_width(2))))?;
            legend(&mut chart, SeriesLabelPosition::UpperLeft)?;
        }
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_axes_of_a_view_have_one_scale() {
        let size = plot_size().unwrap();
        for ranges in [[-1.0..1.0, 0.0..12.0], [-30.0..10.0, 0.0..1.0]] {
            let [x, y] = to_scale(ranges.clone(), size);
            let [across, up] = [&x, &y].map(|range| range.end - range.start);
            assert!((across / size[0] - up / size[1]).abs() < 1e-12, "{x:?} {y:?}");
            for (shown, range) in [x, y].iter().zip(&ranges) {
                let is_whole = shown.start <= range.start + 1e-9 && range.end <= shown.end + 1e-9;
                assert!(is_whole, "{shown:?} of {range:?}");
            }
        }
    }

    #[test]
    fn a_flight_that_never_began_is_drawn_as_well() {
        let figures = all("seed 1", &[]).unwrap();
        assert_eq!(figures.len(), FIGURES.len());
        assert!(figures.iter().all(|(_, svg)| svg.contains("seed 1")));
        assert_eq!(span([2.0, f64::NAN, -1.0, f64::INFINITY].into_iter()), -1.0..2.0);
    }
}
