//! Writes the report as one self-contained file of HTML: title and outcome, numbers, sections; of one
//! flight, or of two side by side with their differences.

use std::fmt::Write as _;

use crate::chart::Chart;
use crate::difference::{configurations, parameters, parameters_of_one};
use crate::flight::Flight;
use crate::html::{
    Block, Cell, all_as_html, escaped, fixed, missing, number, paragraph, table, text,
};
use crate::plots::share_axes;
use crate::sections::{self, Section};
use crate::settings::Difference;
use crate::summary::Summary;
use crate::view::View;

const STYLE: &str = include_str!("style.css");

/// The page of a flight.
///
/// # Errors
/// When a chart cannot be drawn.
pub fn page(flight: &Flight) -> anyhow::Result<String> {
    let view = View::new(flight);
    let mut body = head(&[&view]);
    let sections = sections::of(&view);
    body.push_str(&links(&sections, false));
    for section in &sections {
        body.push_str(&one(section)?);
    }
    Ok(html(&view.summary.name, &body, "one", &marks(&[flight])))
}

/// The page of two flights side by side, with their differences.
///
/// # Errors
/// When a chart cannot be drawn.
pub fn comparison(first: &Flight, second: &Flight) -> anyhow::Result<String> {
    let views = [View::new(first), View::new(second)];
    let [one, other] = &views;
    let mut body = head(&[one, other]);
    let (mut left, mut right) = (sections::of(one), sections::of(other));
    body.push_str(&links(&left, true));
    body.push_str(&numbers(&one.summary, &other.summary));
    body.push_str(&differences(first, second));
    for (left, right) in left.iter_mut().zip(&mut right) {
        body.push_str(&pair(left, right)?);
    }
    let title = format!("{} and {}", one.summary.name, other.summary.name);
    Ok(html(&title, &body, "two", &marks(&[first, second])))
}

/// The marks of a page's flights, as they are in it.
pub fn marks(flights: &[&Flight]) -> String {
    flights.iter().map(|flight| flight.mark()).collect::<Vec<_>>().join(" ")
}

fn html(title: &str, body: &str, class: &str, marks: &str) -> String {
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
         <meta name=\"color-scheme\" content=\"light dark\">\
         <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'\">\
         <meta name=\"alight-flights\" content=\"{marks}\">\
         <title>{}: flight report</title><style>{STYLE}</style></head>\n\
         <body class=\"{class}\"><main>{body}</main></body></html>\n",
        escaped(title)
    )
}

/// Title, outcome and the line for a bug report, of each flight.
fn head(views: &[&View<'_>]) -> String {
    let mut html = "<header><h1>Flight report</h1><div class=\"heads\">".to_owned();
    for (index, view) in views.iter().enumerate() {
        let summary = &view.summary;
        let letter = match (views.len(), index) {
            (1, _) => "",
            (_, 0) => "A: ",
            _ => "B: ",
        };
        let mood = match (summary.landed, summary.phase.as_deref()) {
            (Some(true), _) if summary.is_on_the_pad() => "good",
            (_, None) => "quiet",
            _ => "bad",
        };
        // Writing to a string cannot fail.
        let _ = write!(
            html,
            "<div class=\"head\"><h2>{letter}{}</h2><p class=\"label\">{}</p><p class=\"outcome {mood}\">{}</p>",
            escaped(&summary.name),
            escaped(&summary.origin()),
            escaped(&summary.outcome())
        );
        html.push_str(&cards(summary));
        for problem in summary.problems.iter().chain(&summary.light) {
            let _ = write!(html, "<p class=\"warning\">{}</p>", escaped(problem));
        }
        let _ = write!(
            html,
            "<p class=\"label\">For a bug report:</p><p class=\"bug\">{}</p></div>",
            escaped(&summary.line())
        );
    }
    html.push_str("</div></header>");
    html
}

/// A value of a summary, for people.
struct Figure {
    name: &'static str,
    of: fn(&Summary) -> Option<f64>,
    digits: usize,
    unit: &'static str,
}

const fn figure(
    name: &'static str,
    of: fn(&Summary) -> Option<f64>,
    digits: usize,
    unit: &'static str,
) -> Figure {
    Figure { name, of, digits, unit }
}

/// The most important numbers are first.
static FIGURES: [Figure; 18] = [
    figure("time to disarm", |s| s.time_to_disarm_s, 1, "s"),
    figure("time to touchdown", |s| s.time_to_touchdown_s, 1, "s"),
    figure("touchdown error", |s| s.touchdown_error_m, 3, "m"),
    figure("speed down at touchdown", |s| s.touchdown_speed_m_s, 2, "m/s"),
    figure("speed aside at touchdown", |s| s.touchdown_lateral_speed_m_s, 2, "m/s"),
    figure("largest tilt", |s| s.max_tilt_deg, 1, "deg"),
    figure("frames used", |s| Some(s.frames_used as f64), 0, ""),
    figure("frames of the landing", |s| Some(s.frames as f64), 0, ""),
    figure("frames refused", |s| Some(s.frames_refused as f64), 0, ""),
    figure("exposure to setpoint, median", |s| s.latency_p50_ms, 0, "ms"),
    figure("exposure to setpoint, 99 %", |s| s.latency_p99_ms, 0, "ms"),
    figure("changes of the detector", |s| s.detector_changes.map(|it| it as f64), 0, ""),
    figure("retries", |s| s.retries.map(|it| it as f64), 0, ""),
    figure("estimate's error, median", |s| s.estimate_error_p50_m, 3, "m"),
    figure("estimate's error, 95 %", |s| s.estimate_error_p95_m, 3, "m"),
    figure("mean wind", |s| s.wind_mean_m_s, 1, "m/s"),
    figure("lowest charge", |s| s.battery_min.map(|it| 100.0 * it), 0, "%"),
    figure("messages lost", |s| Some(s.messages_lost as f64), 0, ""),
];

/// The numbers of a flight, by name; `Err` with the text that is shown instead of one.
pub(crate) fn in_numbers(
    summary: &Summary,
) -> impl Iterator<Item = (&'static str, Result<String, &'static str>)> {
    // The later phases of an aborted landing are not missing in its recording.
    let none =
        if summary.landed == Some(true) || summary.phase.is_none() { "not recorded" } else { "-" };
    FIGURES.iter().map(move |Figure { name, of, digits, unit }| {
        let value = of(summary).map(|value| format!("{} {unit}", fixed(value, *digits)));
        (*name, value.ok_or(none))
    })
}

fn cards(summary: &Summary) -> String {
    let mut html = "<dl class=\"cards\">".to_owned();
    for (name, value) in in_numbers(summary) {
        let shown = value.unwrap_or_else(|none| format!("<span class=\"quiet\">{none}</span>"));
        // Writing to a string cannot fail.
        let _ = write!(html, "<div><dt>{name}</dt><dd>{shown}</dd></div>");
    }
    html.push_str("</dl>");
    html
}

fn numbers(one: &Summary, other: &Summary) -> String {
    let table = compared(one, other).html();
    format!("<section id=\"numbers\"><h2>In numbers</h2>{table}</section>")
}

/// The numbers of two flights with their difference.
pub(crate) fn compared(one: &Summary, other: &Summary) -> Block {
    let rows: Vec<Vec<Cell>> = FIGURES
        .iter()
        .map(|Figure { name, of, digits, unit }| {
            let (first, second) = (of(one), of(other));
            let apart = first.zip(second).map(|(first, second)| second - first);
            let apart = apart.map_or("-".to_owned(), |apart| format!("{apart:+.digits$} {unit}"));
            vec![
                text(*name),
                number(first, *digits, unit),
                number(second, *digits, unit),
                Cell::Number(apart.trim_end().to_owned()),
            ]
        })
        .collect();
    table(&["", "A", "B", "B less A"], rows)
}

/// The differences of two flights: the services' configurations, then the autopilot's parameters.
pub(crate) fn differing(first: &Flight, second: &Flight) -> [Vec<Block>; 2] {
    let rows = |differences: Vec<Difference>| -> Vec<Vec<Cell>> {
        let value = |value: Option<String>| text(value.unwrap_or_else(|| "-".to_owned()));
        differences
            .into_iter()
            .map(|it| vec![text(it.name), value(it.one), value(it.other)])
            .collect()
    };
    let mut of_services = Vec::new();
    if first.configurations.is_empty() || second.configurations.is_empty() {
        of_services.push(missing("the configuration of both flights"));
    } else {
        let rows = rows(configurations(first, second));
        if rows.is_empty() {
            of_services.push(paragraph("The services are configured the same."));
        }
        of_services.push(table(&["setting", "A", "B"], rows));
    }
    let mut of_autopilot = Vec::new();
    let [one, other] = [first, second].map(|flight| flight.packets.parameters.len());
    if one == 0 || other == 0 {
        of_autopilot.push(missing(
            "parameters of both flights; the file has those that were requested from the autopilot",
        ));
    } else {
        let rows = rows(parameters(first, second));
        let alone = parameters_of_one(first, second);
        of_autopilot.push(paragraph(&format!(
            "{} differ of those that both recorded ({one} and {other}).",
            rows.len()
        )));
        of_autopilot.push(table(&["parameter", "A", "B"], rows));
        if !alone.is_empty() {
            let names = alone.join(", ");
            of_autopilot.push(paragraph(&format!("Recorded of one flight only: {names}.")));
        }
    }
    [of_services, of_autopilot]
}

fn differences(first: &Flight, second: &Flight) -> String {
    let [of_services, of_autopilot] = differing(first, second).map(|blocks| all_as_html(&blocks));
    format!(
        "<section id=\"differences\"><h2>Differences of configuration</h2>{of_services}\
         <h3>Parameters of the autopilot</h3>{of_autopilot}</section>"
    )
}

fn links(sections: &[Section], is_comparison: bool) -> String {
    let mut html = "<nav>".to_owned();
    let more: &[(&str, &str)] = if is_comparison {
        &[("numbers", "In numbers"), ("differences", "Differences")]
    } else {
        &[]
    };
    let all = more.iter().copied().chain(sections.iter().map(|it| (it.id, it.title)));
    for (id, title) in all {
        // Writing to a string cannot fail.
        let _ = write!(html, "<a href=\"#{id}\">{}</a>", escaped(title));
    }
    html.push_str("</nav>");
    html
}

/// Charts without anything to show are left out: the section states which messages were not recorded.
fn one(section: &Section) -> anyhow::Result<String> {
    let mut html = begin(section);
    html.push_str(&all_as_html(&section.before));
    html.push_str("<div class=\"charts\">");
    for chart in section.charts.iter().filter(|chart| !chart.is_empty()) {
        html.push_str(&chart.figure()?);
    }
    html.push_str("</div>");
    html.push_str(&all_as_html(&section.after));
    html.push_str("</section>");
    Ok(html)
}

fn begin(section: &Section) -> String {
    let Section { id, title, lead, .. } = section;
    let lead = if lead.is_empty() { String::new() } else { paragraph(lead).html() };
    format!("<section id=\"{id}\"><h2>{}</h2>{lead}", escaped(title))
}

/// A section of two flights, side by side: chart by chart, with the same axes.
fn pair(left: &mut Section, right: &mut Section) -> anyhow::Result<String> {
    let mut html = begin(left);
    let mut row = |one: &str, other: &str| {
        if !one.is_empty() || !other.is_empty() {
            // Writing to a string cannot fail.
            let _ = write!(
                html,
                "<div class=\"pair\"><div><b class=\"letter\">A</b>{one}</div><div><b class=\"letter\">B</b>{other}</div></div>"
            );
        }
    };
    row(&all_as_html(&left.before), &all_as_html(&right.before));
    let charts = left.charts.len().max(right.charts.len());
    for index in 0..charts {
        let (one, other) = (left.charts.get_mut(index), right.charts.get_mut(index));
        if let (Some(one), Some(other)) = (one, other) {
            share_axes(one, other);
        }
        let [one, other] = [&left.charts, &right.charts].map(|charts| {
            let drawn = charts.get(index).filter(|chart| !chart.is_empty());
            drawn.map_or(Ok(String::new()), Chart::figure)
        });
        row(&one?, &other?);
    }
    row(&all_as_html(&left.after), &all_as_html(&right.after));
    html.push_str("</section>");
    Ok(html)
}
