//! Makes pieces of a page: escaped texts, and blocks such as tables, which a document shows as well.

use std::fmt::Write as _;

/// A text as HTML shows it: a recording may hold anything.
pub fn escaped(text: &str) -> String {
    let mut html = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => html.push_str("&amp;"),
            '<' => html.push_str("&lt;"),
            '>' => html.push_str("&gt;"),
            '"' => html.push_str("&quot;"),
            '\'' => html.push_str("&#39;"),
            // A page may not contain control characters.
            c if c.is_control() && c != '\n' && c != '\t' => html.push(' '),
            c => html.push(c),
        }
    }
    html
}

/// A cell of a table.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Cell {
    /// Text.
    Text(String),
    /// A number or a unit, set to the right.
    Number(String),
    /// Text that warns.
    Warning(String),
}

/// A cell with text.
pub fn text(text: impl Into<String>) -> Cell {
    Cell::Text(text.into())
}

/// A cell with a number of so many digits and its unit; `-` for none.
pub fn number(value: Option<f64>, digits: usize, unit: &str) -> Cell {
    let value = value.filter(|value| value.is_finite());
    Cell::Number(value.map_or("-".to_owned(), |value| {
        format!("{} {unit}", fixed(value, digits)).trim_end().to_owned()
    }))
}

/// A number of so many digits, and nothing as 0 with a sign: the begin of a landing is at 0.0 s.
pub fn fixed(value: f64, digits: usize) -> String {
    let text = format!("{value:.digits$}");
    match text.strip_prefix('-') {
        Some(zero) if zero.chars().all(|letter| matches!(letter, '0' | '.')) => zero.to_owned(),
        _ => text,
    }
}

/// A cell with a count.
pub fn count(value: u64) -> Cell {
    Cell::Number(value.to_string())
}

impl Cell {
    /// Its text.
    pub fn text(&self) -> &str {
        match self {
            Self::Text(text) | Self::Number(text) | Self::Warning(text) => text,
        }
    }
}

/// A piece of a section.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Block {
    /// A paragraph.
    Paragraph(String),
    /// Messages that were not recorded.
    Missing(String),
    /// A sentence that warns.
    Warning(String),
    /// A table, shown unless it has no rows.
    Table {
        /// Names of its columns; may be empty.
        head: Vec<String>,
        /// Its rows.
        rows: Vec<Vec<Cell>>,
    },
    /// A text as it is, line by line.
    Lines(String),
    /// A part that a page shows once it is opened.
    Details {
        /// Its title.
        title: String,
        /// Its contents.
        block: Box<Self>,
    },
}

impl Block {
    /// The block as HTML.
    pub fn html(&self) -> String {
        match self {
            Self::Paragraph(text) => format!("<p>{}</p>", escaped(text)),
            Self::Missing(messages) => {
                format!("<p class=\"missing\">Not recorded: {}</p>", escaped(messages))
            }
            Self::Warning(text) => format!("<p class=\"warning\">{}</p>", escaped(text)),
            Self::Table { head, rows } => table_as_html(head, rows),
            Self::Lines(text) => format!("<pre>{}</pre>", escaped(text)),
            Self::Details { title, block } => {
                format!("<details><summary>{}</summary>{}</details>", escaped(title), block.html())
            }
        }
    }
}

/// Blocks as HTML, one after the other.
pub fn all_as_html(blocks: &[Block]) -> String {
    blocks.iter().map(Block::html).collect()
}

/// A table.
pub fn table(head: &[&str], rows: Vec<Vec<Cell>>) -> Block {
    Block::Table { head: head.iter().map(|&name| name.to_owned()).collect(), rows }
}

fn table_as_html(head: &[String], rows: &[Vec<Cell>]) -> String {
    if rows.is_empty() {
        return String::new();
    }
    let mut html = "<div class=\"scroll\"><table>".to_owned();
    if !head.is_empty() {
        html.push_str("<thead><tr>");
        for (column, name) in head.iter().enumerate() {
            let is_number = rows
                .first()
                .and_then(|row| row.get(column))
                .is_some_and(|cell| matches!(cell, Cell::Number(_)));
            let class = if is_number { " class=\"number\"" } else { "" };
            // Writing to a string cannot fail.
            let _ = write!(html, "<th{class}>{}</th>", escaped(name));
        }
        html.push_str("</tr></thead>");
    }
    html.push_str("<tbody>");
    for row in rows {
        html.push_str("<tr>");
        for cell in row {
            let class = match cell {
                Cell::Text(_) => "",
                Cell::Number(_) => " class=\"number\"",
                Cell::Warning(_) => " class=\"warning\"",
            };
            let _ = write!(html, "<td{class}>{}</td>", escaped(cell.text()));
        }
        html.push_str("</tr>");
    }
    html.push_str("</tbody></table></div>");
    html
}

/// A sentence about messages that were not recorded.
pub fn missing(messages: &str) -> Block {
    Block::Missing(messages.to_owned())
}

/// A paragraph.
pub fn paragraph(text: &str) -> Block {
    Block::Paragraph(text.to_owned())
}

/// A block that is shown once it is opened.
pub fn details(title: &str, block: Block) -> Block {
    Block::Details { title: title.to_owned(), block: Box::new(block) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_has_no_sign() {
        assert_eq!(number(Some(-0.04), 1, "s"), Cell::Number("0.0 s".to_owned()));
        assert_eq!([-0.06, -12.0, 0.0].map(|value| fixed(value, 1)), ["-0.1", "-12.0", "0.0"]);
    }

    #[test]
    fn texts_of_a_recording_stay_text() {
        let cells = vec![text("<script>alert('1')</script> & \u{7}"), number(None, 1, "m")];
        let html = table(&["name", "value"], vec![cells]).html();
        assert!(!html.contains("<script") && html.contains("&lt;script&gt;"), "{html}");
        assert!(html.contains("&amp;") && !html.contains('\u{7}') && html.contains(">-<"));
        assert_eq!(table(&["name"], Vec::new()).html(), "");
    }
}
