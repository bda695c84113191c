//! Makes the log of the report, in order of time: phases with reasons, commands, detector changes, the autopilot's texts,
//! warnings, failures and changed settings.

use messages::TapeEvent;

use crate::flight::{Change, Flight, Process};
use crate::phases;
use crate::settings::Difference;

/// Maximum number of lines: the last until the landing's end, and as many as possible of those after it; others are counted.
const MAX_LINES: usize = 2000;

/// A line of the log.
#[derive(Clone, Debug, PartialEq)]
pub struct Line {
    /// When, in seconds since the landing began.
    pub time_s: f64,
    /// Its source: a process, the autopilot, the operator or the truth.
    pub source: String,
    /// Whether it is a warning.
    pub is_warning: bool,
    /// Its text.
    pub text: String,
}

/// The log of a flight, and how many lines were left out of it.
pub fn of(flight: &Flight) -> (Vec<Line>, usize) {
    let mut lines = controller(flight);
    lines.extend(commands(flight));
    lines.extend(autopilot(flight));
    lines.extend(processes(flight));
    lines.extend(changes(flight));
    lines.sort_by(|one, other| one.time_s.total_cmp(&other.time_s));
    let left_out = lines.len().saturating_sub(MAX_LINES);
    let end_s = flight.end_s().unwrap_or(f64::INFINITY);
    let until_its_end = lines.partition_point(|line| line.time_s <= end_s);
    lines.drain(..until_its_end.saturating_sub(MAX_LINES));
    lines.truncate(MAX_LINES);
    (lines, left_out)
}

fn controller(flight: &Flight) -> Vec<Line> {
    let mut lines = Vec::new();
    let mut last: Option<&messages::ControllerStatus> = None;
    let mut touched = false;
    for status in &flight.statuses {
        let time_s = flight.at_s(status.stamp_ns);
        let mut log = |is_warning: bool, text: String| {
            lines.push(Line { time_s, source: "controller".to_owned(), is_warning, text });
        };
        let is_same = |last: &messages::ControllerStatus| {
            last.phase == status.phase && phases::is_same(&last.why, &status.why)
        };
        if !last.is_some_and(is_same) {
            log(false, status.sentence());
        }
        if last.is_none_or(|last| last.autopilot != status.autopilot) {
            log(false, format!("link to the autopilot: {}", status.autopilot));
        }
        if last.is_none_or(|last| last.active_detector != status.active_detector)
            && let Some(detector) = &status.active_detector
        {
            let is_change = last.is_some_and(|last| last.active_detector.is_some());
            log(is_change, format!("detector in use: {detector} ({})", status.detector_why));
        }
        let known = last.map(|last| last.warnings.as_slice()).unwrap_or_default();
        let is_in = |all: &[String], text: &str| all.iter().any(|it| phases::is_same(it, text));
        for warning in status.warnings.iter().filter(|warning| !is_in(known, warning)) {
            log(true, warning.clone());
        }
        for over in known.iter().filter(|warning| !is_in(&status.warnings, warning)) {
            log(false, format!("over: {over}"));
        }
        last = Some(status);
    }
    for truth in &flight.truth {
        if let Some(touchdown) = truth.touchdown.filter(|_| !touched) {
            touched = true;
            lines.push(Line {
                time_s: flight.at_s(touchdown.stamp_ns),
                source: "truth".to_owned(),
                is_warning: false,
                text: format!(
                    "touchdown, {:.3} m from the pad, {:.2} m/s down, {:.2} m/s aside",
                    touchdown.error_m, touchdown.vertical_speed_m_s, touchdown.lateral_speed_m_s
                ),
            });
        }
    }
    lines
}

/// Commands and detectors that appeared or disappeared, which only a tape has.
fn commands(flight: &Flight) -> Vec<Line> {
    let mut lines = Vec::new();
    for tape in &flight.tapes {
        let mut has_ended = false;
        let records = tape.parts.iter().flat_map(messages::Tape::records).flatten();
        for record in records.filter(|record| flight.has(record.now_ns)) {
            let (source, is_warning, text) = match &record.event {
                TapeEvent::Command(command) => {
                    let reply = record.reply.as_ref();
                    let accepted = reply.is_some_and(|reply| reply.accepted);
                    let reason = reply.map(|reply| reply.reason.as_str()).unwrap_or_default();
                    let answer = if accepted { "accepted" } else { "refused" };
                    ("operator", !accepted, format!("{command:?}: {answer}, {reason}"))
                }
                TapeEvent::Presence { detector, alive: true } => {
                    ("controller", false, format!("detector {detector} appeared"))
                }
                TapeEvent::Presence { detector, alive: false } => {
                    ("controller", true, format!("detector {detector} disappeared"))
                }
                // It is recorded again until all that it takes is sent.
                TapeEvent::Shutdown if !std::mem::replace(&mut has_ended, true) => {
                    ("controller", false, "the controller ends".to_owned())
                }
                _ => continue,
            };
            let time_s = flight.at_s(record.now_ns);
            lines.push(Line { time_s, source: source.to_owned(), is_warning, text });
        }
    }
    lines
}

fn autopilot(flight: &Flight) -> Vec<Line> {
    let line = |text: &crate::packets::Text| Line {
        time_s: flight.at_s(flight.vehicle_ns(text.received_ns)),
        source: "autopilot".to_owned(),
        is_warning: text.is_warning,
        text: text.text.clone(),
    };
    let mut lines: Vec<Line> = flight.packets.texts.iter().map(line).collect();
    let mut last: Option<&messages::VehicleState> = None;
    for state in &flight.vehicle {
        let time_s = flight.at_s(state.stamp_ns);
        let mut log = |text: String| {
            lines.push(Line { time_s, source: "autopilot".to_owned(), is_warning: false, text });
        };
        if last.is_none_or(|last| last.mode != state.mode) {
            log(format!("mode {}", state.mode));
        }
        if last.is_none_or(|last| last.armed != state.armed) {
            log(format!("motors {}", if state.armed { "armed" } else { "disarmed" }));
        }
        last = Some(state);
    }
    lines
}

fn processes(flight: &Flight) -> Vec<Line> {
    let line = |process: &Process| {
        let health = &process.first;
        Line {
            time_s: flight.at_s(flight.vehicle_ns(process.first_ns)),
            source: health.service.clone(),
            is_warning: false,
            text: format!(
                "{} is process {} on {}, alight {}",
                health.instance, health.pid, health.host, health.version
            ),
        }
    };
    flight.processes.values().map(line).collect()
}

/// Settings that services changed.
fn changes(flight: &Flight) -> Vec<Line> {
    let value = |value: &Option<String>| value.clone().unwrap_or_else(|| "nothing".to_owned());
    let line = |change: &Change| {
        let Difference { name, one, other } = &change.setting;
        Line {
            time_s: flight.at_s(flight.vehicle_ns(change.received_ns)),
            source: change.service.clone(),
            is_warning: false,
            text: format!("setting `{name}` changed from {} to {}", value(one), value(other)),
        }
    };
    flight.changes.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use std::borrow::Cow;

    use flightlog::RecordedTape;
    use messages::{ControllerCommand, ControllerStatus, Phase, TapeOutput, TapeWriter};

    use super::*;
    use crate::flight::Landing;

    const S: i64 = 1_000_000_000;

    #[test]
    fn of_a_long_recording_the_lines_of_the_landing_are_kept() {
        for landing_s in [10, 1_500, 2_990] {
            let mut flight = Flight::default();
            let change = |s: i64| Change {
                service: "detector/main".to_owned(),
                received_ns: s * S,
                setting: Difference { name: "thorough".to_owned(), one: None, other: None },
            };
            flight.changes = (0..3_000).map(change).collect();
            flight.statuses.push(ControllerStatus {
                stamp_ns: landing_s * S,
                phase: Phase::Landed,
                started_ns: Some(landing_s * S),
                finished: true,
                ..ControllerStatus::default()
            });
            flight.set_zero();
            let (lines, left_out) = of(&flight);
            assert_eq!(lines.len(), MAX_LINES);
            assert!(left_out > 1000, "{left_out}");
            let has_landing =
                lines.iter().any(|line| line.source == "controller" && line.text == "landed");
            assert!(has_landing, "a landing after {landing_s} s");
        }
    }

    #[test]
    fn commands_and_the_end_are_those_of_the_landing_and_listed_once() {
        let mut tape = TapeWriter::new(0);
        let mut write = |now_ns, event: &TapeEvent<'_>| {
            tape.write(now_ns, event, &TapeOutput::default());
        };
        let command = |command| TapeEvent::Command(Cow::Owned(command));
        write(S, &command(ControllerCommand::Start));
        write(3 * S, &command(ControllerCommand::Hold));
        (4..8).for_each(|s| write(s * S, &TapeEvent::Shutdown));
        let parts = tape.take().into_iter().collect();
        let mut flight = Flight::default();
        flight.tapes = vec![RecordedTape { begun_ns: 0, parts }];
        let texts = |flight: &Flight| -> Vec<String> {
            commands(flight).into_iter().map(|line| line.text).collect()
        };
        let ends = "the controller ends".to_owned();
        let [start, hold] = ["Start", "Hold"].map(|it| format!("{it}: refused, "));
        assert_eq!(texts(&flight), [start.clone(), hold.clone(), ends.clone()]);
        let mut of_landing = |time_ns| {
            let (number, of, detector_changes_before) = (1, 2, 0);
            flight.landing = Some(Landing { number, of, time_ns, detector_changes_before });
            texts(&flight)
        };
        assert_eq!(of_landing(i64::MIN..2 * S), [start]);
        assert_eq!(of_landing(2 * S..i64::MAX), [hold, ends]);
    }
}
