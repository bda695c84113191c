//! Progress on standard error: a landing's phase, detector in use, height and the controller's warnings, each once; flights
//! and steps of experiments; redrawn on a terminal, else a line for each change.

use std::collections::VecDeque;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use messages::{ControllerStatus, Phase};

use crate::args::Format;
use crate::outcome::LandingSummary;
use crate::services::Service;
use crate::terminal::write_error;

/// The display of a landing.
pub(crate) struct Progress {
    /// `None` where standard error is not a terminal.
    live: Option<ProgressBar>,
    phase: Option<Phase>,
    /// The last reason of the phase that was shown, without digits.
    why: String,
    active_detector: Option<String>,
    warnings: Warnings,
}

/// Time for which a warning that ends and begins again is not shown again, also not in other words.
const QUIET: Duration = Duration::from_secs(5);
/// Maximum number of lines and of warnings that are remembered.
const MAX_REMEMBERED: usize = 32;

/// The warnings of a controller, in its status and on its standard error.
#[derive(Default)]
struct Warnings {
    /// Those that hold, without digits.
    present: Vec<String>,
    /// Those that were shown, without digits, and when; the oldest first.
    shown: Memory,
    /// The lines that were shown, likewise.
    lines: Memory,
}

impl Warnings {
    /// Which of these, which hold now, are to be shown.
    fn take<'a>(&mut self, now: Instant, texts: &'a [String]) -> Vec<&'a String> {
        let subjects: Vec<String> = texts.iter().map(|text| subject(text)).collect();
        let mut new = Vec::new();
        for (text, subject) in texts.iter().zip(&subjects) {
            let was_shown = self.shown.has(now, |shown| shown == subject)
                || self.lines.has(now, |line| line.contains(subject));
            if !self.present.contains(subject) && !was_shown {
                self.shown.add(now, subject.clone());
                new.push(text);
            }
        }
        self.present = subjects;
        new
    }

    /// Whether a line of the controller's standard error is to be shown: not one with a warning that was shown a moment ago.
    fn is_new_line(&mut self, now: Instant, line: &str) -> bool {
        let line = subject(line);
        let is_new = !self.shown.has(now, |shown| line.contains(shown));
        if is_new {
            self.lines.add(now, line);
        }
        is_new
    }
}

/// Texts that were shown, and when.
#[derive(Default)]
struct Memory(VecDeque<Shown>);

struct Shown {
    text: String,
    at: Instant,
}

impl Memory {
    /// Whether such a text was shown a moment ago.
    fn has(&self, now: Instant, is_it: impl Fn(&str) -> bool) -> bool {
        let is_recent = |at: Instant| now.saturating_duration_since(at) < QUIET;
        self.0.iter().any(|shown| is_recent(shown.at) && is_it(&shown.text))
    }

    fn add(&mut self, now: Instant, text: String) {
        if self.0.len() >= MAX_REMEMBERED {
            self.0.pop_front();
        }
        self.0.push_back(Shown { text, at: now });
    }
}

impl Progress {
    pub(crate) fn new(format: Format) -> Self {
        use std::io::IsTerminal;
        let is_live = format == Format::Text && std::io::stderr().is_terminal();
        let live = is_live.then(|| {
            let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
            if let Ok(style) =
                ProgressStyle::with_template("{spinner:.cyan} {elapsed_precise} {msg}")
            {
                bar.set_style(style);
            }
            bar.enable_steady_tick(Duration::from_millis(200));
            bar
        });
        Self {
            live,
            phase: None,
            why: String::new(),
            active_detector: None,
            warnings: Warnings::default(),
        }
    }

    /// Shows a line that stays.
    pub(crate) fn say(&self, line: &str) {
        match &self.live {
            Some(bar) => bar.println(line),
            None => write_error(line),
        }
    }

    /// Shows a line where the output is not a terminal.
    pub(crate) fn debug(&self, line: &str) {
        if self.live.is_none() {
            write_error(line);
        }
    }

    /// Shows a change of phase or of detector.
    pub(crate) fn status(&mut self, status: &ControllerStatus) {
        let why = subject(&status.why);
        // An autopilot may take a minute until it lets the vehicle take off, and reports the reason.
        let is_other_reason = self.live.is_none()
            && matches!(status.phase, Phase::Idle | Phase::Takeoff)
            && self.why != why;
        if self.phase.replace(status.phase) != Some(status.phase) || is_other_reason {
            self.say(&status.sentence());
            self.why = why;
        }
        if status.active_detector != self.active_detector {
            self.active_detector.clone_from(&status.active_detector);
            let name = status.active_detector.as_deref().unwrap_or("none");
            self.say(&format!("active detector: {name}: {}", status.detector_why));
        }
        for text in self.warnings.take(Instant::now(), &status.warnings) {
            self.say(&format!("warning: {text}"));
        }
    }

    /// Shows a line of a service's standard error; a line of the controller is not shown if its status has reported the same.
    pub(crate) fn line(&mut self, service: Service, line: &str) {
        if service != Service::Controller || self.warnings.is_new_line(Instant::now(), line) {
            self.say(&format!("{}: {line}", service.name()));
        }
    }

    /// Redraws the live view.
    pub(crate) fn draw(&self, landing: &LandingSummary) {
        if let (Some(bar), Some(status)) = (&self.live, &landing.last_status) {
            bar.set_message(live_lines(status, landing.frame_rate_hz()));
        }
    }

    /// Clears the live view.
    pub(crate) fn finish(&self) {
        if let Some(bar) = &self.live {
            bar.finish_and_clear();
        }
    }
}

/// A text without its numbers, apart from names in backquotes: a change of numbers alone, as of a distance, is not shown.
fn subject(text: &str) -> String {
    let numberless = |part: &str| part.replace(|c: char| c.is_ascii_digit(), "");
    let parts = text.split('`').enumerate();
    parts.map(|(i, part)| if i % 2 == 0 { numberless(part) } else { part.to_owned() }).collect()
}

fn live_lines(status: &ControllerStatus, frame_rate_hz: Option<f64>) -> String {
    let number = |value: Option<f64>, digits: usize, unit: &str| match value {
        Some(value) => format!("{value:.digits$} {unit}"),
        None => format!("- {unit}"),
    };
    let others: Vec<&str> = status
        .candidates
        .iter()
        .map(|c| c.detector.as_str())
        .filter(|name| Some(*name) != status.active_detector.as_deref())
        .collect();
    let standby = if others.is_empty() {
        String::new()
    } else {
        format!(" (standing by: {})", others.join(", "))
    };
    format!(
        "{}: {}\n  height {:>8}   lateral error {:>8}\n  frames {:>8}   detection age {:>7}   detector {}{standby}",
        status.phase,
        status.why,
        number(status.height_m, 2, "m"),
        number(status.lateral_error_m, 3, "m"),
        number(frame_rate_hz, 1, "Hz"),
        number(status.detection_age_ms, 0, "ms"),
        status.active_detector.as_deref().unwrap_or("none"),
    )
}

/// The progress of long work: a bar on a terminal, else a line now and then.
pub(crate) struct Steps {
    bar: ProgressBar,
    lines: Seldom,
}

impl Steps {
    /// Of many flights.
    pub(crate) fn of_flights() -> Self {
        Self::new("{bar:40} {pos} of {len} flights, {elapsed}, {eta} left")
    }

    /// Of steps that have names.
    pub(crate) fn of_names() -> Self {
        let steps = Self::new("{spinner:.cyan} {elapsed_precise} {msg}");
        if !steps.bar.is_hidden() {
            steps.bar.enable_steady_tick(Duration::from_millis(200));
        }
        steps
    }

    fn new(template: &str) -> Self {
        let bar = ProgressBar::no_length().with_style(
            ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()),
        );
        Self { bar, lines: Seldom::new(Instant::now()) }
    }

    /// `done` flights of `of` were flown.
    pub(crate) fn flown(&self, done: usize, of: usize) {
        self.bar.set_length(of as u64);
        self.bar.set_position(done as u64);
        self.line(|| format!("{done} of {of} flights"));
    }

    /// The step with this name begins.
    pub(crate) fn begins(&self, name: &str) {
        self.bar.set_message(name.to_owned());
        self.line(|| name.to_owned());
    }

    /// Prints while the bar is suspended.
    pub(crate) fn suspended<T>(&self, print: impl FnOnce() -> T) -> T {
        self.bar.suspend(print)
    }

    fn line(&self, text: impl FnOnce() -> String) {
        if self.bar.is_hidden()
            && let Some(passed) = self.lines.passed(Instant::now())
        {
            write_error(&format!("{} after {} s", text(), passed.as_secs()));
        }
    }

    /// Clears the bar.
    pub(crate) fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

/// Decides when progress lines are due: the longer the work has taken already, the rarer.
struct Seldom {
    began: Instant,
    next: Mutex<Duration>,
}

impl Seldom {
    const FIRST: Duration = Duration::from_secs(10);
    const RAREST: Duration = Duration::from_secs(300);

    fn new(began: Instant) -> Self {
        Self { began, next: Mutex::new(Self::FIRST) }
    }

    /// The time that has passed, if a line is due: after 10 s, 20 s, 40 s and so on, and then every five minutes.
    fn passed(&self, now: Instant) -> Option<Duration> {
        let passed = now.saturating_duration_since(self.began);
        let mut next = self.next.lock().unwrap_or_else(PoisonError::into_inner);
        if passed < *next {
            return None;
        }
        *next = passed + passed.min(Self::RAREST);
        Some(passed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use messages::Candidate;

    #[test]
    fn a_warning_with_other_numbers_is_the_same_and_with_another_name_is_not() {
        let silent =
            |camera: &str, s: u32| subject(&format!("no frame from camera `{camera}` for {s} s"));
        assert_eq!(silent("cam1", 2), silent("cam1", 13));
        assert_ne!(silent("cam1", 2), silent("cam2", 2));
    }

    #[test]
    fn a_warning_that_comes_and_goes_is_shown_every_few_seconds_and_once_of_status_and_log() {
        let (began, mut warnings) = (Instant::now(), Warnings::default());
        let said = |apart: f64| {
            format!("detectors `main` (used) and `python` see the marker {apart:.2} m apart")
        };
        let mut shown = Vec::new();
        for i in 0..60_u32 {
            let now = began + Duration::from_millis(200) * i;
            let texts = if i % 2 == 0 { vec![said(f64::from(i))] } else { Vec::new() };
            if !warnings.take(now, &texts).is_empty() {
                shown.push(i);
            }
            let line = format!("2026-11-30T08:00:{i:02} WARN controller: {}", said(0.5));
            assert!(texts.is_empty() || !warnings.is_new_line(now, &line), "{line}");
        }
        assert_eq!(shown, [0, 26, 52], "every five seconds");
        // The log is sometimes the first, and other lines are shown each.
        let later = began + Duration::from_secs(60);
        assert!(warnings.is_new_line(later, &format!("WARN controller: {}", said(0.7))));
        assert!(warnings.take(later, &[said(0.7)]).is_empty());
        assert!(warnings.is_new_line(later, "WARN controller: Autopilot heartbeat lost"));
    }

    #[test]
    fn lines_become_rarer_the_longer_it_takes() {
        let began = Instant::now();
        let lines = Seldom::new(began);
        let due_s: Vec<u64> =
            (0..2000).filter(|s| lines.passed(began + Duration::from_secs(*s)).is_some()).collect();
        assert_eq!(due_s, [10, 20, 40, 80, 160, 320, 620, 920, 1220, 1520, 1820]);
    }

    #[test]
    fn the_live_view_has_phase_height_error_and_detectors() {
        let candidate = |name: &str| Candidate { detector: name.into(), ..Candidate::sample() };
        let status = ControllerStatus {
            phase: Phase::Descend,
            why: "descending over the marker".into(),
            guidance: "metric".into(),
            active_detector: Some("main".into()),
            candidates: vec![candidate("main"), candidate("spare")],
            detection_age_ms: Some(63.4),
            height_m: Some(4.321),
            lateral_error_m: Some(0.0123),
            ..ControllerStatus::default()
        };
        let text = live_lines(&status, Some(15.02));
        for part in
            ["descend", "4.32 m", "0.012 m", "15.0 Hz", "63 ms", "main", "standing by: spare"]
        {
            assert!(text.contains(part), "`{part}` is not in: {text}");
        }
        assert!(live_lines(&ControllerStatus { height_m: None, ..status }, None).contains("- m"));
    }
}
