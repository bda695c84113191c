//! Processes images in several threads, and prints their lines in the order of the images.

use std::collections::VecDeque;
use std::io::{ErrorKind, Write};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

use super::args::LineFormat;
use super::report::Line;
use super::source::{Item, Source};

/// Maximum number of finished lines that wait for an earlier one, per thread.
const MAX_AHEAD: usize = 4;

/// Numbers of the images and detections printed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Totals {
    pub(super) images: usize,
    pub(super) detections: usize,
    pub(super) unreadable: usize,
}

/// Processes all images, each worker in a thread of its own, and prints their lines in the order of the
/// images. A closed pipe ends the work.
pub(super) fn process_all<W: Write + Send, T: Send>(
    source: Source,
    workers: Vec<T>,
    process: impl Fn(Item, &mut T) -> Line + Sync,
    format: LineFormat,
    out: W,
) -> anyhow::Result<Totals> {
    let queue = Queue::new(source, workers.len() * MAX_AHEAD, format, out);
    std::thread::scope(|scope| {
        for mut worker in workers {
            let (queue, process) = (&queue, &process);
            scope.spawn(move || {
                while let Some((index, item)) = queue.take() {
                    queue.finish(index, process(item, &mut worker));
                }
            });
        }
    });
    let printer = queue.printer.into_inner().unwrap_or_else(PoisonError::into_inner);
    printer.end()
}

/// Hands out the images with their numbers and collects their lines; only few lines ever wait for an earlier
/// one.
struct Queue<W> {
    /// Locked before the printer, never after it.
    source: Mutex<Source>,
    window: usize,
    printer: Mutex<Printer<W>>,
    room: Condvar,
}

struct Printer<W> {
    out: W,
    format: LineFormat,
    /// The number of the next image.
    next: usize,
    /// The lines not printed yet, from the next one to print.
    waiting: VecDeque<Option<Line>>,
    totals: Totals,
    stopped_by: Option<std::io::Error>,
}

impl<W: Write> Queue<W> {
    fn new(source: Source, window: usize, format: LineFormat, out: W) -> Self {
        let printer = Printer {
            out,
            format,
            next: 0,
            waiting: VecDeque::with_capacity(window),
            totals: Totals::default(),
            stopped_by: None,
        };
        let source = Mutex::new(source);
        Self { source, window, printer: Mutex::new(printer), room: Condvar::new() }
    }

    /// The next image and its number; `None` at the end.
    fn take(&self) -> Option<(usize, Item)> {
        let mut source = self.source.lock().unwrap_or_else(PoisonError::into_inner);
        let has_to_wait = |printer: &mut Printer<W>| {
            printer.stopped_by.is_none() && printer.waiting.len() >= self.window
        };
        let printer =
            self.room.wait_while(self.lock(), has_to_wait).unwrap_or_else(PoisonError::into_inner);
        if printer.stopped_by.is_some() {
            return None;
        }
        drop(printer);
        // Without the lock: decoding a video takes time, in which lines can be printed.
        let item = source.next()?;
        let mut printer = self.lock();
        printer.waiting.push_back(None);
        printer.next += 1;
        Some((printer.next - 1, item))
    }

    /// Takes the line of image `index`, and prints the lines up to the first that is missing.
    fn finish(&self, index: usize, line: Line) {
        let mut printer = self.lock();
        let first = printer.next - printer.waiting.len();
        if let Some(slot) = printer.waiting.get_mut(index - first) {
            *slot = Some(line);
        }
        while let Some(Some(_)) = printer.waiting.front() {
            if let Some(Some(line)) = printer.waiting.pop_front() {
                printer.print(&line);
            }
        }
        self.room.notify_all();
    }

    // The lines stay valid when a thread panics.
    fn lock(&self) -> MutexGuard<'_, Printer<W>> {
        self.printer.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<W: Write> Printer<W> {
    fn print(&mut self, line: &Line) {
        self.totals.images += 1;
        match line {
            Line::Image { found, .. } => self.totals.detections += found.detections.len(),
            Line::Error { .. } => self.totals.unreadable += 1,
        }
        let text = match self.format {
            LineFormat::Text => line.as_text(),
            LineFormat::Jsonl => line.as_json(),
        };
        self.write(&text);
    }

    fn write(&mut self, text: &str) {
        if self.stopped_by.is_none()
            && let Err(problem) =
                self.out.write_all(text.as_bytes()).and_then(|()| self.out.flush())
        {
            self.stopped_by = Some(problem);
        }
    }

    fn end(mut self) -> anyhow::Result<Totals> {
        if self.format == LineFormat::Text {
            let Totals { images, detections, unreadable } = self.totals;
            self.write(&format!(
                "images: {images}, markers found: {detections}, not readable: {unreadable}\n"
            ));
        }
        match self.stopped_by {
            Some(problem) if problem.kind() != ErrorKind::BrokenPipe => {
                Err(anyhow::Error::new(problem).context("writing the results"))
            }
            _ => Ok(self.totals),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;

    #[test]
    fn a_slow_image_delays_a_bounded_number_of_lines() {
        let source = Source::new(&vec![PathBuf::from("a.png"); 100]);
        let queue = Queue::new(source, 3, LineFormat::Jsonl, Vec::new());
        let line = |i: usize| Line::Error { image: i.to_string(), error: String::new() };
        let take = || queue.take().map(|(index, _)| index);
        assert_eq!([take(), take(), take()], [Some(0), Some(1), Some(2)]);
        queue.finish(2, line(2));
        queue.finish(1, line(1));
        assert_eq!(queue.lock().waiting.len(), 3);
        queue.finish(0, line(0));
        assert_eq!(queue.lock().waiting.len(), 0);
        assert_eq!(take(), Some(3));
    }
}
