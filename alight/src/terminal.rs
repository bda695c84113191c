//! Prints lines and tables with aligned columns to standard output or error, without failing where a pipe was closed or a terminal hung
//! up.

use std::fmt::Write as _;
use std::fs::File;
use std::io::{self, ErrorKind, Write};
use std::os::fd::AsFd;
use std::os::unix::fs::FileTypeExt;

/// Prints a line to standard output. A closed pipe is not an error.
pub(crate) fn print(line: &str) -> io::Result<()> {
    match writeln!(Output, "{line}") {
        Err(problem) if problem.kind() == ErrorKind::BrokenPipe => Ok(()),
        result => result,
    }
}

/// Standard output. Its error is a broken pipe where a pipe was closed (`| head`) or a terminal hung up.
pub(crate) struct Output;

impl Write for Output {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        io::stdout().write(bytes).map_err(|problem| classified(problem, &io::stdout()))
    }

    fn flush(&mut self) -> io::Result<()> {
        io::stdout().flush().map_err(|problem| classified(problem, &io::stdout()))
    }
}

/// The error of a file, as [`Output`] returns it. A terminal that hung up gives the same error as a failing disk, and is no longer
/// recognisable as a terminal.
fn classified(problem: io::Error, file: &impl AsFd) -> io::Error {
    let is_device = || -> io::Result<bool> {
        let file = File::from(file.as_fd().try_clone_to_owned()?);
        Ok(file.metadata()?.file_type().is_char_device())
    };
    let has_hung_up = problem.raw_os_error() == Some(rustix::io::Errno::IO.raw_os_error())
        && is_device().unwrap_or(false);
    if has_hung_up { ErrorKind::BrokenPipe.into() } else { problem }
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

#[cfg(test)]
mod tests {
    use rustix::io::Errno;

    use super::*;

    #[test]
    fn a_terminal_that_hung_up_is_a_broken_pipe_and_a_disk_that_fails_is_none() {
        let (disk, device) = (tempfile::tempfile().unwrap(), File::open("/dev/null").unwrap());
        let is_unread = |errno: Errno, file: &File| {
            let problem = io::Error::from_raw_os_error(errno.raw_os_error());
            classified(problem, file).kind() == ErrorKind::BrokenPipe
        };
        assert!(is_unread(Errno::IO, &device) && is_unread(Errno::PIPE, &disk));
        assert!(!is_unread(Errno::IO, &disk) && !is_unread(Errno::NOSPC, &device));
    }
}
