//! Writes the report as a PDF document: the page's sections on A4; the parts that a page shows once they are opened are left
//! out where it is long.

use crate::chart::{Chart, Ink, Shape, WIDTH};
use crate::flight::Flight;
use crate::html::{Block, Cell};
use crate::page::{compared, differing, in_numbers, marks};
use crate::pdf::{Font, PAGE, Pages, SAMPLE, Type};
use crate::plots::share_axes;
use crate::sections::{self, Section};
use crate::summary::Summary;
use crate::view::View;

/// Space around the content of a page, in units of 1/72 inch, as all sizes here.
const MARGIN: f64 = 40.0;
/// Width of the content of a page.
const COLUMN: f64 = PAGE[0] - 2.0 * MARGIN;
/// Where a page ends.
const FOOT: f64 = PAGE[1] - MARGIN;
/// Space between two charts, and between columns of a table.
const GAP: f64 = 12.0;
const CELL_GAP: f64 = 8.0;
/// Width of one of two charts side by side.
const CHART: f64 = (COLUMN - GAP) / 2.0;
/// Width of a legend's sample with the space before its name.
const SAMPLE_WITH_GAP: f64 = SAMPLE + 3.5;
/// Distance of lines, in sizes of their letters.
const LEADING: f64 = 1.32;
/// Longest text that is shown as it is, in lines.
const MAX_LINES: usize = 40;

const TEXT: [u8; 3] = [27, 31, 36];
const QUIET: [u8; 3] = [91, 101, 112];
const RED: [u8; 3] = [200, 30, 30];
const GREEN: [u8; 3] = [0, 127, 95];
const LINE: [u8; 3] = [213, 217, 222];

const PLAIN: Type = Type { font: Font::Plain, size: 8.5, rgb: TEXT };
const BOLD: Type = Type { font: Font::Bold, ..PLAIN };
const SMALL: Type = Type { size: 7.2, rgb: QUIET, ..PLAIN };
const FIXED: Type = Type { font: Font::Fixed, size: 6.8, ..PLAIN };
const TITLE: Type = Type { size: 13.0, ..BOLD };
const HEADING: Type = Type { size: 11.0, ..BOLD };

/// The document of a flight, or of two side by side.
///
/// # Errors
/// When a chart cannot be drawn.
pub fn document(flight: &Flight, other: Option<&Flight>) -> anyhow::Result<Vec<u8>> {
    let view = View::new(flight);
    let other = other.map(|other| (other, View::new(other)));
    let title = match &other {
        Some((_, second)) => format!("{} and {}", view.summary.name, second.summary.name),
        None => view.summary.name.clone(),
    };
    let mut writer = Writer::new(&title);
    writer.line("Flight report", SMALL);
    let Some((other, second)) = &other else {
        writer.head("", &view.summary);
        for section in sections::of(&view) {
            writer.section(&section)?;
        }
        return Ok(writer.finish(&title, &marks(&[flight])));
    };
    writer.head("A: ", &view.summary);
    writer.head("B: ", &second.summary);
    writer.heading("In numbers");
    writer.block(&compared(&view.summary, &second.summary));
    let [of_services, of_autopilot] = differing(flight, other);
    writer.heading("Differences of configuration");
    writer.blocks(&of_services);
    writer.line("Parameters of the autopilot", BOLD);
    writer.blocks(&of_autopilot);
    for (mut left, mut right) in sections::of(&view).into_iter().zip(sections::of(second)) {
        writer.pair(&mut left, &mut right)?;
    }
    Ok(writer.finish(&title, &marks(&[flight, other])))
}

/// Writes down the pages.
struct Writer {
    pages: Pages,
    name: String,
    /// Where the next line begins, from the top.
    top: f64,
}

impl Writer {
    fn new(name: &str) -> Self {
        Self { pages: Pages::default(), name: name.to_owned(), top: MARGIN }
    }

    fn finish(mut self, title: &str, keywords: &str) -> Vec<u8> {
        self.number();
        self.pages.finish(title, keywords)
    }

    /// The page's number, at its foot.
    fn number(&mut self) {
        let text = format!("{}, page {}", self.name, self.pages.number());
        let left = PAGE[0] - MARGIN - SMALL.font.width(SMALL.size, &text);
        self.pages.text([left, PAGE[1] - 0.5 * MARGIN], SMALL, &text);
    }

    /// Begins another page unless there is so much room on this one.
    fn needs(&mut self, height: f64) {
        if self.top + height > FOOT && self.top > MARGIN {
            self.number();
            self.pages.turn();
            self.top = MARGIN;
        }
    }

    fn skip(&mut self, height: f64) {
        self.top += height;
    }

    /// Text over the full width, in as many lines as necessary.
    fn line(&mut self, text: &str, of: Type) {
        for line in wrapped(text, of, COLUMN) {
            self.needs(LEADING * of.size);
            self.pages.text([MARGIN, self.top + of.size], of, &line);
            self.skip(LEADING * of.size);
        }
    }

    fn heading(&mut self, text: &str) {
        self.heading_before(text, 70.0);
    }

    /// A heading with so much of the next content on its page: not alone at the foot of one.
    fn heading_before(&mut self, text: &str, height: f64) {
        self.needs(40.0 + height);
        self.skip(8.0);
        self.pages.fill([MARGIN, self.top], [COLUMN, 0.6], LINE);
        self.skip(7.0);
        self.line(text, HEADING);
        self.skip(2.0);
    }

    fn head(&mut self, letter: &str, summary: &Summary) {
        self.line(&format!("{letter}{}", summary.name), TITLE);
        self.line(&summary.origin(), SMALL);
        let rgb = match (summary.landed, summary.phase.as_deref()) {
            (Some(true), _) if summary.is_on_the_pad() => GREEN,
            (_, None) => QUIET,
            _ => RED,
        };
        self.line(&summary.outcome(), Type { size: 10.0, rgb, ..BOLD });
        self.skip(4.0);
        let all: Vec<_> = in_numbers(summary).collect();
        for row in all.chunks(6) {
            let width = COLUMN / 6.0;
            self.needs(26.0);
            for (index, (name, value)) in row.iter().enumerate() {
                let left = MARGIN + width * index as f64;
                let of = Type { size: 6.2, ..SMALL };
                self.pages.text([left, self.top + 7.0], of, name);
                let (text, of) = match value {
                    Ok(value) => (value.as_str(), Type { size: 9.5, ..BOLD }),
                    Err(none) => (*none, SMALL),
                };
                self.pages.text([left, self.top + 18.5], of, text);
            }
            self.skip(25.0);
        }
        for problem in summary.problems.iter().chain(&summary.light) {
            self.line(problem, Type { rgb: RED, ..BOLD });
        }
        self.line("For a bug report:", SMALL);
        self.line(&summary.line(), FIXED);
        self.skip(6.0);
    }

    fn section(&mut self, section: &Section) -> anyhow::Result<()> {
        let charts: Vec<&Chart> = section.charts.iter().filter(|it| !it.is_empty()).collect();
        self.begin(section, [charts.first().copied(), charts.get(1).copied()]);
        self.blocks(&section.before);
        for pair in charts.chunks(2) {
            self.charts([pair.first().copied(), pair.get(1).copied()], ["", ""])?;
        }
        self.blocks(&section.after);
        Ok(())
    }

    /// A section of two flights, chart by chart with the same axes.
    fn pair(&mut self, left: &mut Section, right: &mut Section) -> anyhow::Result<()> {
        let first = [&left.charts, &right.charts].map(|charts| charts.first());
        self.begin(left, first.map(|chart| chart.filter(|it| !it.is_empty())));
        for index in 0..left.charts.len().max(right.charts.len()) {
            if let (Some(one), Some(other)) =
                (left.charts.get_mut(index), right.charts.get_mut(index))
            {
                share_axes(one, other);
            }
            let drawn = [&left.charts, &right.charts]
                .map(|charts| charts.get(index).filter(|chart| !chart.is_empty()));
            self.charts(drawn, ["A: ", "B: "])?;
        }
        for (letter, section) in [("A", left), ("B", right)] {
            if !section.before.is_empty() || !section.after.is_empty() {
                self.line(letter, BOLD);
                self.blocks(&section.before);
                self.blocks(&section.after);
            }
        }
        Ok(())
    }

    /// The title of a section, on the page of its first charts.
    fn begin(&mut self, section: &Section, first: [Option<&Chart>; 2]) {
        let before = 24.0 * section.before.len() as f64;
        self.heading_before(section.title, (before + height_of(first)).max(70.0));
        if !section.lead.is_empty() {
            self.line(section.lead, SMALL);
        }
    }

    /// Up to two charts side by side.
    fn charts(&mut self, charts: [Option<&Chart>; 2], letters: [&str; 2]) -> anyhow::Result<()> {
        let width = CHART;
        let height = height_of(charts);
        if height == 0.0 {
            return Ok(());
        }
        self.needs(height + 6.0);
        for (index, (chart, letter)) in charts.into_iter().zip(letters).enumerate() {
            let Some(chart) = chart else { continue };
            let left = MARGIN + (width + GAP) * index as f64;
            let title = format!("{letter}{}", chart.title);
            self.pages.text([left, self.top + 9.0], BOLD, &title);
            self.pages.chart(chart, [left, self.top + 13.0], width)?;
            let mut foot = self.top + 13.0 + shape(chart, width) + 8.0;
            for line in legend(chart, width) {
                let mut at = left;
                for Key { name, drawn } in line {
                    if let Some((shape, ink)) = drawn {
                        self.pages.sample(shape, ink, [at, foot]);
                        at += SAMPLE_WITH_GAP;
                    }
                    self.pages.text([at, foot], SMALL, name);
                    at += SMALL.font.width(SMALL.size, name) + GAP;
                }
                foot += 10.0;
            }
        }
        self.skip(height + 6.0);
        Ok(())
    }

    fn blocks(&mut self, blocks: &[Block]) {
        blocks.iter().for_each(|block| self.block(block));
    }

    fn block(&mut self, block: &Block) {
        match block {
            Block::Paragraph(text) => self.line(text, PLAIN),
            Block::Missing(messages) => {
                self.line(&format!("Not recorded: {messages}"), Type { rgb: QUIET, ..PLAIN });
            }
            Block::Warning(text) => self.line(text, Type { rgb: RED, ..BOLD }),
            Block::Table { head, rows } => self.table(head, rows),
            Block::Lines(text) => {
                let lines = text.lines().count();
                if lines > MAX_LINES {
                    self.line(
                        &format!("{lines} lines, which the page and the recording have"),
                        SMALL,
                    );
                    return;
                }
                text.lines().for_each(|line| self.line(line, FIXED));
            }
            Block::Details { title, block } => {
                self.skip(2.0);
                self.line(title, BOLD);
                self.block(block);
            }
        }
        self.skip(2.0);
    }

    fn table(&mut self, head: &[String], rows: &[Vec<Cell>]) {
        if rows.is_empty() {
            return;
        }
        let widths = widths(head, rows);
        let names: Vec<Set<'_>> = (0..widths.len())
            .map(|column| {
                let first = rows.first().and_then(|row| row.get(column));
                Set {
                    text: head.get(column).map_or("", String::as_str),
                    of: Type { font: Font::Bold, ..SMALL },
                    is_number: first.is_some_and(|cell| matches!(cell, Cell::Number(_))),
                }
            })
            .collect();
        if !head.is_empty() {
            // Not without its first row.
            self.needs(3.0 * LEADING * SMALL.size);
            self.row(&names, &widths);
        }
        for row in rows {
            let cells: Vec<Set<'_>> = row
                .iter()
                .map(|cell| {
                    let rgb = if matches!(cell, Cell::Warning(_)) { RED } else { TEXT };
                    Set {
                        text: cell.text(),
                        of: Type { rgb, ..SMALL },
                        is_number: matches!(cell, Cell::Number(_)),
                    }
                })
                .collect();
            self.row(&cells, &widths);
        }
    }

    fn row(&mut self, cells: &[Set<'_>], widths: &[f64]) {
        let lines: Vec<Vec<String>> = cells
            .iter()
            .zip(widths)
            .map(|(cell, width)| wrapped(cell.text, cell.of, *width))
            .collect();
        let height = lines.iter().map(Vec::len).max().unwrap_or(1) as f64 * LEADING * SMALL.size;
        self.needs(height + 2.0);
        let mut left = MARGIN;
        for ((lines, Set { of, is_number, .. }), width) in lines.iter().zip(cells).zip(widths) {
            for (index, line) in lines.iter().enumerate() {
                let indent = if *is_number { width - of.font.width(of.size, line) } else { 0.0 };
                let foot = self.top + of.size + LEADING * of.size * index as f64;
                self.pages.text([left + indent, foot], *of, line);
            }
            left += width + CELL_GAP;
        }
        self.pages.fill([MARGIN, self.top + height], [COLUMN, 0.3], LINE);
        self.skip(height + 1.6);
    }
}

/// A cell of a table as it is set.
struct Set<'a> {
    text: &'a str,
    of: Type,
    is_number: bool,
}

/// The widths of a table's columns: as their texts need, and where that is too much the widest give way.
fn widths(head: &[String], rows: &[Vec<Cell>]) -> Vec<f64> {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0).max(head.len());
    let bold = Type { font: Font::Bold, ..SMALL };
    let mut widths: Vec<f64> = (0..columns)
        .map(|column| {
            let cells = rows.iter().filter_map(|row| row.get(column)).map(Cell::text);
            let widest = cells.map(|text| SMALL.font.width(SMALL.size, text)).fold(0.0, f64::max);
            let name = head.get(column).map_or(0.0, |name| bold.font.width(bold.size, name));
            widest.max(name)
        })
        .collect();
    let room = COLUMN - CELL_GAP * columns.saturating_sub(1) as f64;
    // The widest is cut to the width that the others leave, or to the next widest.
    for _ in 0..2 * columns {
        let sum: f64 = widths.iter().sum();
        if sum <= room {
            break;
        }
        let widest = widths.iter().copied().fold(0.0, f64::max);
        let next = widths.iter().copied().filter(|it| *it < widest).fold(0.0, f64::max);
        let wide = widths.iter().filter(|it| **it == widest).count() as f64;
        let cut = ((sum - room) / wide).min(widest - next);
        widths.iter_mut().filter(|it| **it == widest).for_each(|it| *it -= cut);
    }
    widths
}

/// A text in lines no wider than `width`, at least one.
fn wrapped(text: &str, of: Type, width: f64) -> Vec<String> {
    let fits = |line: &str| of.font.width(of.size, line) <= width;
    if fits(text) {
        // As it is, with the spaces before it.
        return vec![text.to_owned()];
    }
    let mut lines = vec![String::new()];
    for word in text.split_whitespace() {
        let Some(line) = lines.last_mut() else { break };
        let longer = if line.is_empty() { word.to_owned() } else { format!("{line} {word}") };
        if fits(&longer) {
            *line = longer;
            continue;
        }
        if !line.is_empty() {
            lines.push(String::new());
        }
        // A word that is too long is cut where it must be.
        for letter in word.chars() {
            let Some(line) = lines.last_mut() else { break };
            line.push(letter);
            if !fits(line) && line.chars().count() > 1 {
                line.pop();
                lines.push(letter.to_string());
            }
        }
    }
    lines
}

/// Height of a chart so wide, without title and legend.
fn shape(chart: &Chart, width: f64) -> f64 {
    width * f64::from(chart.height) / f64::from(WIDTH)
}

/// Height of charts side by side, with title and legend; 0 of none.
fn height_of(charts: [Option<&Chart>; 2]) -> f64 {
    let width = CHART;
    let heights = charts.map(|chart| {
        chart.map_or(0.0, |it| 14.0 + shape(it, width) + 10.0 * legend(it, width).len() as f64)
    });
    heights.into_iter().fold(0.0, f64::max)
}

/// A name in a legend, and how it is drawn; a note is not.
struct Key<'a> {
    name: &'a str,
    drawn: Option<(Shape, Ink)>,
}

/// The names of a chart's layers, and its note, in lines.
fn legend(chart: &Chart, width: f64) -> Vec<Vec<Key<'_>>> {
    let named = chart.layers.iter().filter(|it| !it.name.is_empty() && !it.points.is_empty());
    let keys = named.map(|it| Key { name: &it.name, drawn: Some((it.shape, it.ink)) });
    let note = (!chart.note.is_empty()).then_some(Key { name: &chart.note, drawn: None });
    let mut lines: Vec<Vec<Key<'_>>> = Vec::new();
    let mut used = f64::INFINITY;
    for key in keys.chain(note) {
        let needed = SAMPLE_WITH_GAP + SMALL.font.width(SMALL.size, key.name) + GAP;
        if used + needed - GAP > width {
            lines.push(Vec::new());
            used = 0.0;
        }
        used += needed;
        if let Some(line) = lines.last_mut() {
            line.push(key);
        }
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::html::text;

    #[test]
    fn texts_are_wrapped_within_their_width_and_lose_no_letter() {
        let long = "a sentence with Donaudampfschifffahrtsgesellschaft in the middle of it";
        for width in [20.0, 60.0, 200.0, 1000.0] {
            let lines = wrapped(long, PLAIN, width);
            let fits = |line: &String| PLAIN.font.width(PLAIN.size, line) <= width;
            assert!(lines.iter().all(fits), "{width}: {lines:?}");
            let letters = |text: &str| text.replace(' ', "");
            assert_eq!(letters(&lines.concat()), letters(long));
        }
        assert_eq!(wrapped("", PLAIN, 10.0), [""]);
    }

    #[test]
    fn a_table_is_no_wider_than_the_page_and_short_columns_keep_their_width() {
        let row = vec![text("1.0 s"), text("word ".repeat(100)), text("word ".repeat(80))];
        let widths = widths(&[], &[row]);
        assert!(widths.iter().sum::<f64>() + 2.0 * CELL_GAP <= COLUMN + 1e-6, "{widths:?}");
        assert_eq!(widths[0], SMALL.font.width(SMALL.size, "1.0 s"));
        assert!(widths[1] > 100.0 && (widths[1] - widths[2]).abs() < 1e-6, "{widths:?}");
    }
}
