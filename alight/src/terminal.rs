//! Output to the terminal.

use std::fmt::Write as _;
use std::io::{self, ErrorKind, Write as _};

/// Prints a line to standard output. A closed pipe (`| head`) is not an error.
pub(crate) fn print(line: &str) -> io::Result<()> {
    match writeln!(io::stdout(), "{line}") {
        Err(problem) if problem.kind() == ErrorKind::BrokenPipe => Ok(()),
        result => result,
    }
}

/// Writes a line to standard error. A failure is ignored, as there is no other place to report it.
pub(crate) fn write_error(line: &str) {
    drop(writeln!(io::stderr(), "{line}"));
}

/// Rows of cells as lines with aligned columns.
pub(crate) fn aligned<const N: usize>(rows: &[[String; N]]) -> String {
    let mut text = String::new();
    let width = |column: usize| {
        let cells = rows.iter().filter_map(|row| row.get(column));
        cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
    };
    for row in rows {
        let mut line = String::new();
        for (column, cell) in row.iter().enumerate() {
            // Writing to a string cannot fail.
            let _ = write!(line, "{cell:<width$}  ", width = width(column));
        }
        text.push_str(line.trim_end());
        text.push('\n');
    }
    text
}
