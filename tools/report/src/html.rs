//! Pieces of a page: escaped texts, and tables.

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
            // What a page may not contain.
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
    Cell::Number(
        value.map_or("-".to_owned(), |value| {
            format!("{value:.digits$} {unit}").trim_end().to_owned()
        }),
    )
}

/// A cell with a count.
pub fn count(value: u64) -> Cell {
    Cell::Number(value.to_string())
}

/// A table; empty without rows.
pub fn table(head: &[&str], rows: &[Vec<Cell>]) -> String {
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
            let (class, text) = match cell {
                Cell::Text(text) => ("", text),
                Cell::Number(text) => (" class=\"number\"", text),
                Cell::Warning(text) => (" class=\"warning\"", text),
            };
            let _ = write!(html, "<td{class}>{}</td>", escaped(text));
        }
        html.push_str("</tr>");
    }
    html.push_str("</tbody></table></div>");
    html
}

/// A sentence on what was not recorded.
pub fn missing(what: &str) -> String {
    format!("<p class=\"missing\">Not recorded: {}</p>", escaped(what))
}

/// A paragraph.
pub fn paragraph(text: &str) -> String {
    format!("<p>{}</p>", escaped(text))
}

/// What is shown once it is opened.
pub fn details(title: &str, body: &str) -> String {
    format!("<details><summary>{}</summary>{body}</details>", escaped(title))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_recording_says_stays_text() {
        let cells = vec![text("<script>alert('1')</script> & \u{7}"), number(None, 1, "m")];
        let html = table(&["name", "value"], &[cells]);
        assert!(!html.contains("<script") && html.contains("&lt;script&gt;"), "{html}");
        assert!(html.contains("&amp;") && !html.contains('\u{7}') && html.contains(">-<"));
        assert_eq!(table(&["name"], &[]), "");
    }
}
