//! Writes the page's charts as separate files, for papers and slides: SVG with title and legend, in the colours for light.

use std::fmt::Write as _;

use crate::chart::{Chart, Layer, SIZE_FACTOR, Shape, WIDTH};
use crate::flight::Flight;
use crate::html::escaped;
use crate::sections;
use crate::view::View;

/// Size of texts, in pixels of the drawing.
const FONT: u32 = 28;
/// Width of a letter, on average, as a fraction of the size of texts.
const LETTER: f64 = 0.56;
/// Height of a line of texts, in pixels of the drawing.
const LINE: u32 = 44;
/// Space around the drawing and between names, in pixels of the drawing.
const GAP: f64 = 28.0;
/// Length of the sample in front of a name, in pixels of the drawing.
const SAMPLE: f64 = 44.0;

/// A chart as a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Figure {
    /// The file's name: the section, the chart's number in it, its title.
    pub name: String,
    /// The contents of the file.
    pub svg: String,
}

/// All charts of a flight, in the order of the page.
///
/// # Errors
/// When a chart cannot be drawn.
pub fn figures(flight: &Flight) -> anyhow::Result<Vec<Figure>> {
    let view = View::new(flight);
    let sections = sections::of(&view);
    let charts = sections.iter().flat_map(|section| {
        let shown = section.charts.iter().filter(|chart| !chart.is_empty());
        shown.enumerate().map(|(index, chart)| (section.id, index + 1, chart))
    });
    charts
        .map(|(section, number, chart)| {
            let name = format!("{section}-{number}-{}.svg", as_name(&chart.title));
            Ok(Figure { name, svg: figure(chart)? })
        })
        .collect()
}

/// A title as part of a file's name: small letters and digits, joined by hyphens.
fn as_name(title: &str) -> String {
    let plain = title.to_lowercase();
    let words = plain.split(|letter: char| !letter.is_ascii_alphanumeric());
    words.filter(|word| !word.is_empty()).collect::<Vec<_>>().join("-")
}

fn figure(chart: &Chart) -> anyhow::Result<String> {
    let [width, height] = [WIDTH, chart.height].map(|pixels| pixels * SIZE_FACTOR);
    let legend = legend(chart, f64::from(width));
    let whole = LINE + height + legend.lines * LINE;
    let [shown_width, shown_height] = [width, whole].map(|pixels| pixels / SIZE_FACTOR);
    let title = escaped(&chart.title);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{shown_width}\" height=\"{shown_height}\" viewBox=\"0 0 {width} {whole}\" \
         font-family=\"sans-serif\" font-size=\"{FONT}\"><title>{title}</title><desc>{}</desc>\
         <rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>\
         <text x=\"50%\" y=\"{}\" text-anchor=\"middle\" font-weight=\"bold\">{title}</text>",
        escaped(&chart.note),
        LINE - 10
    );
    svg.push_str(&chart.svg()?.replacen("<svg ", &format!("<svg y=\"{LINE}\" "), 1));
    // Writing to a string cannot fail.
    let _ = write!(svg, "<g transform=\"translate(0 {})\">{}</g></svg>", LINE + height, legend.svg);
    svg.push('\n');
    Ok(svg)
}

/// The legend of the layers.
struct Legend {
    svg: String,
    lines: u32,
}

fn legend(chart: &Chart, width: f64) -> Legend {
    let named = chart.layers.iter().filter(|it| !it.name.is_empty() && !it.points.is_empty());
    let mut legend = Legend { svg: String::new(), lines: 0 };
    let mut left = f64::INFINITY;
    for layer in named {
        let needed = SAMPLE + 10.0 + LETTER * f64::from(FONT) * layer.name.chars().count() as f64;
        if left + needed + GAP > width {
            (left, legend.lines) = (GAP, legend.lines + 1);
        }
        // Writing to a string cannot fail.
        let _ = write!(
            legend.svg,
            "{}<text x=\"{:.0}\" y=\"{}\">{}</text>",
            sample(layer, left, legend.lines * LINE - LINE / 2),
            left + SAMPLE + 10.0,
            legend.lines * LINE - LINE / 2 + FONT / 3,
            escaped(&layer.name)
        );
        left += needed + GAP;
    }
    legend
}

/// How a layer is drawn, in small.
fn sample(layer: &Layer, left: f64, middle: u32) -> String {
    let colour = layer.ink.css();
    let (right, centre, top) = (left + SAMPLE, left + SAMPLE / 2.0, middle - 9);
    match layer.shape {
        Shape::Area => {
            format!(
                "<rect x=\"{left:.0}\" y=\"{top}\" width=\"{SAMPLE}\" height=\"18\" fill=\"{colour}\" fill-opacity=\"0.3\"/>"
            )
        }
        Shape::Dots | Shape::LargeDots => {
            format!("<circle cx=\"{centre:.0}\" cy=\"{middle}\" r=\"6\" fill=\"{colour}\"/>")
        }
        Shape::Crosses => {
            let (west, east) = (centre - 7.0, centre + 7.0);
            let (north, south) = (middle - 7, middle + 7);
            format!(
                "<path d=\"M{west:.0} {north}L{east:.0} {south}M{west:.0} {south}L{east:.0} {north}\" stroke=\"{colour}\" stroke-width=\"3\"/>"
            )
        }
        Shape::Line | Shape::Wide | Shape::Thin | Shape::Steps => {
            let width = match layer.shape {
                Shape::Thin => 2,
                Shape::Wide => 8,
                _ => 5,
            };
            format!(
                "<line x1=\"{left:.0}\" x2=\"{right:.0}\" y1=\"{middle}\" y2=\"{middle}\" stroke=\"{colour}\" stroke-width=\"{width}\"/>"
            )
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_title_becomes_a_name_for_every_file_system() {
        assert_eq!(as_name("Figure 4.10: Höhe (m) / time"), "figure-4-10-h-he-m-time");
    }
}
