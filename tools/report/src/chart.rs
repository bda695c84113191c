//! Draws a chart as SVG: layers of lines, steps and dots with axes, and bands for phases, in inks that the page's style changes for dark
//! and light.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::ops::Range;

use anyhow::anyhow;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

/// A chart is drawn this many times as large as it is shown, because points of SVG are whole pixels here.
pub const SIZE_FACTOR: u32 = 2;
/// Size of texts, in pixels of the drawing.
const FONT: u32 = 28;
/// Points closer than this to the last one are left out of a line, in pixels of the drawing.
const MIN_STEP: f64 = 2.0;
/// Width of a chart in pixels as shown.
pub const WIDTH: u32 = 560;
/// Space for the names left of an axis, and below one, in pixels of the drawing: left for the longest number, as in -0.015, with the unit
/// next to it.
const LEFT: u32 = 144;
const LEFT_OF_ROWS: u32 = 250;
const BELOW: u32 = 78;
const MARGIN: u32 = 16;
/// Largest number that is drawn.
const MAX_NUMBER: f64 = 1e7;
/// Dots closer than this to another are left out, in pixels of the drawing.
const DOT_STEP: f64 = 3.0;

/// A colour, which has one value in light and one in dark (`style.css`).
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Ink {
    /// The main curve: the estimate.
    Blue,
    /// Its reference: truth, response.
    Orange,
    /// A third curve.
    Green,
    /// Errors and refusals.
    Red,
    /// A fourth curve.
    Purple,
    /// Secondary curves.
    Grey,
    /// Axes and texts.
    Text,
}

impl Ink {
    /// The colour in light; `style.css` has the same.
    fn rgb(self) -> RGBColor {
        match self {
            Self::Blue => RGBColor(0, 95, 178),
            Self::Orange => RGBColor(201, 84, 0),
            Self::Green => RGBColor(0, 127, 95),
            Self::Red => RGBColor(200, 30, 30),
            Self::Purple => RGBColor(140, 60, 150),
            Self::Grey => RGBColor(130, 130, 130),
            Self::Text => RGBColor(51, 51, 51),
        }
    }

    /// The colour in light: red, green, blue.
    pub fn channels(self) -> [u8; 3] {
        let RGBColor(red, green, blue) = self.rgb();
        [red, green, blue]
    }

    /// The colour in light, as CSS has it.
    pub fn css(self) -> String {
        let RGBColor(red, green, blue) = self.rgb();
        format!("#{red:02x}{green:02x}{blue:02x}")
    }

    /// Its name in `style.css`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Blue => "blue",
            Self::Orange => "orange",
            Self::Green => "green",
            Self::Red => "red",
            Self::Purple => "purple",
            Self::Grey => "grey",
            Self::Text => "text",
        }
    }
}

/// The colour of a phase.
fn phase_ink(name: &str) -> Ink {
    match name {
        "takeoff" | "search" => Ink::Purple,
        "approach" => Ink::Blue,
        "descend" | "final" => Ink::Green,
        "retry" | "hold" | "pilot-in-command" => Ink::Orange,
        "aborted" | "failed" => Ink::Red,
        _ => Ink::Grey,
    }
}

/// How a layer is drawn.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Shape {
    /// A line.
    Line,
    /// A wide line, behind others.
    Wide,
    /// A thin line.
    Thin,
    /// A line that keeps each value until the next.
    Steps,
    /// Dots.
    Dots,
    /// Large dots, behind others that they would hide or be hidden by.
    LargeDots,
    /// The inside of a closed line.
    Area,
    /// Crosses.
    Crosses,
}

/// A point in the units of the axes.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct At {
    /// Along the lower axis.
    pub x: f64,
    /// Along the left axis.
    pub y: f64,
}

/// The point at these coordinates.
pub fn at(x: f64, y: f64) -> At {
    At { x, y }
}

/// Points of one kind.
#[derive(Clone, Debug, PartialEq)]
pub struct Layer {
    /// Their name in the legend; empty for none.
    pub name: String,
    /// Their colour.
    pub ink: Ink,
    /// How they are drawn.
    pub shape: Shape,
    /// The points; one that is not finite breaks a line.
    pub points: Vec<At>,
}

/// A stretch of time with a name.
#[derive(Clone, Debug, PartialEq)]
pub struct Band {
    /// Its name.
    pub name: String,
    /// Its begin.
    pub from: f64,
    /// Its end.
    pub to: f64,
}

/// A chart.
#[derive(Clone, Debug)]
pub struct Chart {
    /// Its title.
    pub title: String,
    /// Its axes.
    pub axes: Axes,
    /// Stretches of time behind the layers.
    pub bands: Vec<Band>,
    /// Its layers, the hindmost first.
    pub layers: Vec<Layer>,
    /// Names of rows instead of numbers on the left axis, the lowest first at 0.
    pub rows: Vec<String>,
    /// Height in pixels as shown.
    pub height: u32,
    /// Remarks, as sentences; may be empty.
    pub note: String,
}

/// Axes of a chart.
#[derive(Clone, Debug, PartialEq)]
pub struct Axes {
    /// Name and unit of the lower one.
    pub x_name: String,
    /// Name and unit of the left one.
    pub y_name: String,
    /// Range of the lower one.
    pub x: Range<f64>,
    /// Range of the left one.
    pub y: Range<f64>,
    /// Whether both have the same scale.
    pub is_equal: bool,
}

/// A layer. Numbers that are too large or not finite are left out of it.
pub fn layer(name: &str, ink: Ink, shape: Shape, points: impl IntoIterator<Item = At>) -> Layer {
    let sane =
        |it: At| if it.x.abs().max(it.y.abs()) < MAX_NUMBER { it } else { at(f64::NAN, f64::NAN) };
    Layer { name: name.to_owned(), ink, shape, points: points.into_iter().map(sane).collect() }
}

/// The range of values, with some room; it contains `at_least`.
pub fn span(values: impl Iterator<Item = f64>, at_least: Range<f64>) -> Range<f64> {
    let all = values.filter(|value| value.abs() < MAX_NUMBER);
    let (low, high) = all.fold((at_least.start, at_least.end), |(low, high), value| {
        (low.min(value), high.max(value))
    });
    let room = 0.04 * (high - low).max(1e-6);
    let low = if low < at_least.start { low - room } else { low };
    let high = if high > at_least.end { high + room } else { high };
    low..high
}

impl Chart {
    /// True when there is nothing to see in it.
    pub fn is_empty(&self) -> bool {
        self.layers.iter().all(|layer| layer.points.is_empty())
    }

    /// The chart as SVG.
    ///
    /// # Errors
    /// When it cannot be drawn.
    pub fn svg(&self) -> anyhow::Result<String> {
        let mut svg = String::new();
        {
            let size = [WIDTH, self.height].map(|pixels| pixels * SIZE_FACTOR);
            let area = SVGBackend::with_string(&mut svg, size.into()).into_drawing_area();
            self.draw(&area, size).map_err(|error| anyhow!("{}: {error}", self.title))?;
            area.present().map_err(|error| anyhow!("{}: {error}", self.title))?;
        }
        // The page's style gives it the width of its column.
        let label =
            format!("<svg role=\"img\" aria-label=\"{}\" ", crate::html::escaped(&self.title));
        Ok(svg.replacen("<svg ", &label, 1))
    }

    fn left(&self) -> u32 {
        if self.rows.is_empty() { LEFT } else { LEFT_OF_ROWS }
    }

    /// The axes, stretched where both have the same scale.
    fn spans(&self, size: [u32; 2]) -> (Range<f64>, Range<f64>) {
        let Axes { x, y, is_equal, .. } = self.axes.clone();
        let [x, y] = [x, y].map(drawable);
        let [width, height] = size;
        if !is_equal {
            // A line for the names of the phases above all curves.
            let line = if self.bands.is_empty() { 0.0 } else { f64::from(FONT) };
            let up = f64::from(height.saturating_sub(BELOW + 2 * MARGIN)).max(4.0 * line);
            let above = (y.end - y.start) * line / (up - line).max(1.0);
            return (x, y.start..y.end + above);
        }
        let across = f64::from(width.saturating_sub(self.left() + 2 * MARGIN));
        let up = f64::from(height.saturating_sub(BELOW + 2 * MARGIN));
        let per_pixel = ((x.end - x.start) / across).max((y.end - y.start) / up);
        let stretched = |range: Range<f64>, pixels: f64| {
            let (centre, half) = (0.5 * (range.start + range.end), 0.5 * per_pixel * pixels);
            centre - half..centre + half
        };
        (stretched(x, across), stretched(y, up))
    }

    /// Draws it into an area of this size, in pixels of the drawing.
    ///
    /// # Errors
    /// When the drawing backend fails.
    pub fn draw<Backend: DrawingBackend<ErrorType: 'static>>(
        &self,
        area: &DrawingArea<Backend, plotters::coord::Shift>,
        size: [u32; 2],
    ) -> Result<(), Box<dyn std::error::Error>> {
        let (x, y) = self.spans(size);
        let text = Ink::Text.rgb();
        let mut chart = ChartBuilder::on(area)
            .margin(MARGIN)
            .x_label_area_size(BELOW)
            .y_label_area_size(self.left())
            .build_cartesian_2d(x.clone(), y.clone())?;
        for band in &self.bands {
            let (from, to) = (band.from.max(x.start), band.to.min(x.end));
            if from < to {
                let style = phase_ink(&band.name).rgb().mix(0.13).filled();
                chart.draw_series([Rectangle::new([(from, y.start), (to, y.end)], style)])?;
            }
        }
        let style = |size: u32| ("sans-serif", size).into_font().color(&text);
        let row_name = |value: &f64| {
            let is_whole = (value - value.round()).abs() < 1e-6 && *value > -0.5;
            let name = self.rows.get(value.round() as usize).filter(|_| is_whole);
            name.cloned().unwrap_or_default()
        };
        let number = |value: &f64| plain(*value);
        let mut mesh = chart.configure_mesh();
        mesh.x_desc(&self.axes.x_name)
            .y_desc(&self.axes.y_name)
            .label_style(style(FONT))
            .axis_desc_style(style(FONT))
            .axis_style(Ink::Grey.rgb())
            .bold_line_style(Ink::Grey.rgb().mix(0.35))
            .light_line_style(TRANSPARENT)
            .x_labels(8)
            .x_label_formatter(&number);
        if self.rows.is_empty() {
            mesh.y_labels(7).y_label_formatter(&number).draw()?;
        } else {
            mesh.y_labels(2 * self.rows.len()).y_label_formatter(&row_name).draw()?;
        }
        let pixels =
            [f64::from(size[0]) / (x.end - x.start), f64::from(size[1]) / (y.end - y.start)];
        for layer in &self.layers {
            draw_layer(&mut chart, layer, pixels)?;
        }
        let anchor = Pos::new(HPos::Center, VPos::Top);
        for band in &self.bands {
            let (from, to) = (band.from.max(x.start), band.to.min(x.end));
            let room = (to - from) * f64::from(size[0] - self.left()) / (x.end - x.start);
            // About half its size is a letter's width.
            if room > 0.55 * f64::from(FONT) * band.name.len() as f64 {
                let centre = (0.5 * (from + to), y.end);
                let style = style(FONT - 3).pos(anchor);
                chart.draw_series([Text::new(band.name.clone(), centre, style)])?;
            }
        }
        Ok(())
    }

    /// The chart with title, legend and note for the page.
    ///
    /// # Errors
    /// When it cannot be drawn.
    pub fn figure(&self) -> anyhow::Result<String> {
        let mut html = format!("<figure><h3>{}</h3>", crate::html::escaped(&self.title));
        html.push_str(&self.svg()?);
        html.push_str("<figcaption>");
        for layer in self.layers.iter().filter(|it| !it.name.is_empty() && !it.points.is_empty()) {
            let form = match layer.shape {
                Shape::Area => "area",
                Shape::Dots | Shape::LargeDots => "dot",
                Shape::Crosses => "cross",
                Shape::Line | Shape::Steps => "line",
                Shape::Wide => "wide",
                Shape::Thin => "thin",
            };
            // Writing to a string cannot fail.
            let _ = write!(
                html,
                "<span class=\"key\"><i class=\"{form} {}\"></i>{}</span>",
                layer.ink.name(),
                crate::html::escaped(&layer.name)
            );
        }
        if !self.note.is_empty() {
            let _ =
                write!(html, "<span class=\"note\">{}</span>", crate::html::escaped(&self.note));
        }
        html.push_str("</figcaption></figure>");
        Ok(html)
    }
}

type Drawn<'a, Backend> = ChartContext<
    'a,
    Backend,
    Cartesian2d<plotters::coord::types::RangedCoordf64, plotters::coord::types::RangedCoordf64>,
>;

fn draw_layer<Backend: DrawingBackend<ErrorType: 'static>>(
    chart: &mut Drawn<'_, Backend>,
    layer: &Layer,
    pixels: [f64; 2],
) -> Result<(), Box<dyn std::error::Error>> {
    let ink = layer.ink.rgb();
    let finite = || layer.points.iter().filter(|it| it.x.is_finite() && it.y.is_finite());
    match layer.shape {
        Shape::Line | Shape::Wide | Shape::Thin | Shape::Steps => {
            let width = match layer.shape {
                Shape::Thin => 2,
                Shape::Wide => 8,
                _ => 4,
            };
            let points = match layer.shape {
                Shape::Steps => &steps(&layer.points),
                _ => &layer.points,
            };
            for run in points.split(|it| !(it.x.is_finite() && it.y.is_finite())) {
                let line = thinned(run, pixels);
                chart.draw_series(LineSeries::new(line, ink.stroke_width(width)))?;
            }
        }
        Shape::Area => {
            for run in layer.points.split(|it| !(it.x.is_finite() && it.y.is_finite())) {
                let outline: Vec<(f64, f64)> = run.iter().map(|it| (it.x, it.y)).collect();
                if outline.len() > 2 {
                    chart.draw_series([Polygon::new(outline, ink.mix(0.2).filled())])?;
                }
            }
        }
        Shape::Dots | Shape::LargeDots => {
            let style = ink.mix(0.7).filled();
            let dots = apart(finite().copied(), pixels);
            let radius = if layer.shape == Shape::LargeDots { 9 } else { 5 };
            chart.draw_series(dots.into_iter().map(|dot| Circle::new(dot, radius, style)))?;
        }
        Shape::Crosses => {
            let style = ink.stroke_width(4);
            chart.draw_series(finite().map(|it| Cross::new((it.x, it.y), 12, style)))?;
        }
    }
    Ok(())
}

/// A range that can be drawn.
fn drawable(range: Range<f64>) -> Range<f64> {
    let extent = range.start.abs().max(range.end.abs());
    let is_sane = extent < 1e3 * MAX_NUMBER && range.end - range.start > 1e-9 * extent;
    if is_sane { range } else { 0.0..1.0 }
}

/// Dots without those that would fall on others.
fn apart(points: impl Iterator<Item = At>, pixels: [f64; 2]) -> Vec<(f64, f64)> {
    let [per_x, per_y] = pixels;
    let cell = |value: f64| (value / DOT_STEP) as i64;
    let mut taken = BTreeSet::new();
    points
        .filter(|it| taken.insert((cell(per_x * it.x), cell(per_y * it.y))))
        .map(|it| (it.x, it.y))
        .collect()
}

/// Each value until the next.
fn steps(points: &[At]) -> Vec<At> {
    let mut steps: Vec<At> = Vec::with_capacity(2 * points.len());
    for point in points {
        if let Some(last) = steps.last().copied() {
            steps.push(at(point.x, last.y));
        }
        steps.push(*point);
    }
    steps
}

/// A line without points that would fall on the one before.
fn thinned(points: &[At], pixels: [f64; 2]) -> Vec<(f64, f64)> {
    let [per_x, per_y] = pixels;
    let mut kept: Vec<(f64, f64)> = Vec::new();
    for point in points {
        let is_far = kept
            .last()
            .is_none_or(|(x, y)| (per_x * (point.x - x)).hypot(per_y * (point.y - y)) >= MIN_STEP);
        if is_far {
            kept.push((point.x, point.y));
        }
    }
    if let Some(last) = points.last()
        && kept.last() != Some(&(last.x, last.y))
    {
        kept.push((last.x, last.y));
    }
    kept
}

/// A number on an axis, as short as it is exact enough.
fn plain(value: f64) -> String {
    let text = format!("{value:.3}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0".to_owned() } else { text.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_thinned_but_keep_spikes_and_their_end() {
        let points: Vec<At> =
            (0..1000).map(|i| at(f64::from(i), if i == 500 { 100.0 } else { 0.0 })).collect();
        let kept = thinned(&points, [0.1, 1.0]);
        assert!(kept.len() < 80, "{}", kept.len());
        assert!(kept.contains(&(500.0, 100.0)) && kept.contains(&(999.0, 0.0)));
    }

    #[test]
    fn an_area_with_a_gap_is_two_areas() {
        let piece = |from: f64| [at(from, 0.0), at(from, 1.0), at(from + 2.0, 1.0)];
        let points: Vec<At> =
            piece(0.0).into_iter().chain([at(2.0, f64::NAN)]).chain(piece(7.0)).collect();
        let axes = Axes {
            x_name: "s".to_owned(),
            y_name: "m".to_owned(),
            x: 0.0..9.0,
            y: 0.0..1.0,
            is_equal: false,
        };
        let chart = Chart {
            title: "area".to_owned(),
            axes,
            bands: Vec::new(),
            layers: vec![layer("area", Ink::Blue, Shape::Area, points)],
            rows: Vec::new(),
            height: 270,
            note: String::new(),
        };
        assert_eq!(chart.svg().unwrap().matches("<polygon").count(), 2);
    }

    #[test]
    fn numbers_on_axes_are_short() {
        assert_eq!([2.0, 0.25, -0.0001, 10.0].map(plain), ["2", "0.25", "0", "10"]);
    }

    #[test]
    fn equal_axes_have_the_same_scale() {
        let chart = Chart {
            title: "a < b".to_owned(),
            axes: Axes {
                x_name: "x".to_owned(),
                y_name: "y".to_owned(),
                x: 0.0..1.0,
                y: 0.0..10.0,
                is_equal: true,
            },
            bands: Vec::new(),
            layers: vec![layer("line", Ink::Blue, Shape::Line, [at(0.0, 0.0), at(1.0, 9.0)])],
            rows: Vec::new(),
            height: 300,
            note: String::new(),
        };
        let (x, y) = chart.spans([1120, 600]);
        assert!(x.end - x.start > y.end - y.start, "{x:?} {y:?}");
        let svg = chart.svg().unwrap();
        assert!(svg.contains("a &lt; b") && svg.contains("<polyline"), "{svg}");
    }

    #[test]
    fn the_unit_is_left_of_the_longest_numbers() {
        let chart = Chart {
            title: "error".to_owned(),
            axes: Axes {
                x_name: "s".to_owned(),
                y_name: "m".to_owned(),
                x: 0.0..1.0,
                y: -0.019..0.019,
                is_equal: false,
            },
            bands: Vec::new(),
            layers: vec![layer("line", Ink::Blue, Shape::Line, [at(0.0, 0.0), at(1.0, 0.01)])],
            rows: Vec::new(),
            height: 270,
            note: String::new(),
        };
        let svg = chart.svg().unwrap();
        // Each text with the number after `x="` of its element.
        let texts: Vec<(f64, &str)> = svg
            .split("<text ")
            .skip(1)
            .map(|text| {
                let x = text.split("x=\"").nth(1).unwrap().split('"').next().unwrap();
                let label = text.split('>').nth(1).unwrap().split('<').next().unwrap().trim();
                (x.parse().unwrap(), label)
            })
            .collect();
        let unit = texts.iter().find(|(_, label)| *label == "m").unwrap().0;
        let (end, longest) = texts.iter().find(|(_, label)| *label == "-0.015").unwrap();
        let begin = end - 0.6 * f64::from(FONT) * longest.len() as f64;
        assert!(unit + f64::from(FONT) < begin, "the unit at {unit}, the number from {begin}");
    }
}
