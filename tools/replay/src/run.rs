//! Replays a tape: a new flight with the recorded configuration, or some settings over it, handles each recorded
//! event, and its results are handed on.

use std::fmt;
use std::ops::ControlFlow;
use std::sync::Arc;

use anyhow::{Context, anyhow};
use controller::config::GuidanceName;
use controller::flight::Flight;
use controller::tape::TapedFlight;
use flightlog::RecordedTape;
use messages::{TapeEvent, TapeRecord};
use node::{Settings, from_toml};

/// An event that was replayed.
#[derive(Copy, Clone)]
pub struct Replayed<'a> {
    /// Its record on the tape.
    pub recorded: &'a TapeRecord<'a>,
    /// The result of the replay.
    pub replayed: &'a TapeRecord<'a>,
    /// The flight after it.
    pub flight: &'a Flight,
    /// Time since the tape began, in seconds.
    pub time_s: f64,
}

/// Why a tape was not replayed to its end.
#[derive(Clone, Debug, PartialEq)]
pub enum Stop {
    /// It does not begin with its beginning.
    NoBeginning {
        /// Number of its first event.
        first: u64,
    },
    /// Events are missing.
    Gap {
        /// Number of the first that is missing.
        from: u64,
        /// How many are missing.
        missing: u64,
        /// When, since the begin, in seconds.
        time_s: f64,
    },
    /// An event was changed after it was recorded.
    Damaged {
        /// Its number.
        number: u64,
        /// Its kind, as far as it can be read.
        event: Option<&'static str>,
        /// When, since the begin, in seconds.
        time_s: f64,
    },
    /// An event gives another result than then.
    Different {
        /// Its number.
        number: u64,
        /// Its kind.
        event: &'static str,
        /// When, since the begin, in seconds.
        time_s: f64,
        /// The value that differs.
        field: String,
        /// Its value then.
        recorded: String,
        /// Its value now.
        replayed: String,
    },
}

/// How far a tape was replayed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct End {
    /// The program that wrote it, with its version.
    pub program: String,
    /// The target for which that was built.
    pub build: String,
    /// Events that were replayed, the beginning included.
    pub events: u64,
    /// The time from the first to the last of them, in seconds.
    pub flight_s: f64,
    /// Whether the last of them is the controller's end.
    pub is_ended: bool,
    /// Why it stopped; `None` at the end of the tape.
    pub stop: Option<Stop>,
}

impl fmt::Display for Stop {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoBeginning { first } => write!(
                f,
                "not replayable: the tape begins with event {first}, the events before it are missing; name the earlier files of this recording as well, or record from the start"
            ),
            Self::Gap { from, missing, time_s } => write!(
                f,
                "not replayable from {time_s:.3} s on: {missing} events are missing, from number {from}"
            ),
            Self::Damaged { number, event, time_s } => {
                let event = event.unwrap_or("unreadable");
                write!(
                    f,
                    "event {number} ({event}) at {time_s:.3} s is damaged: it does not fit its hash"
                )
            }
            Self::Different { number, event, time_s, field, recorded, replayed } => write!(
                f,
                "event {number} ({event}) at {time_s:.3} s gives another result: {field} was {recorded}, now it is {replayed}"
            ),
        }
    }
}

/// Replays a tape, under its configuration with some settings `key=value` over it. `each` sees every event after the
/// beginning, and may end it.
///
/// # Errors
/// When the configuration cannot be used: a [`node::ConfigError`] where that is for a setting of `set`.
pub fn run(
    tape: &RecordedTape,
    set: &[String],
    each: impl FnMut(Replayed<'_>) -> ControlFlow<Stop>,
) -> anyhow::Result<End> {
    run_with(tape, set, |_event| None, each)
}

/// As [`run`], with another event in the place of those for which `instead` has one.
///
/// # Errors
/// As [`run`].
pub fn run_with(
    tape: &RecordedTape,
    set: &[String],
    mut instead: impl FnMut(&TapeEvent<'_>) -> Option<TapeEvent<'static>>,
    mut each: impl FnMut(Replayed<'_>) -> ControlFlow<Stop>,
) -> anyhow::Result<End> {
    let mut end = End::default();
    let mut flight = None;
    let mut hash = 0;
    for part in &tape.parts {
        if part.first != end.events {
            end.stop = Some(match end.events {
                0 => Stop::NoBeginning { first: part.first },
                from => {
                    let missing = part.first.saturating_sub(from);
                    Stop::Gap { from, missing, time_s: end.flight_s }
                }
            });
            return Ok(end);
        }
        for record in part.records() {
            let damaged =
                |event| Some(Stop::Damaged { number: end.events, event, time_s: end.flight_s });
            let record = match record {
                Ok(record) if record.follows(hash) => record,
                Ok(record) => {
                    end.stop = damaged(Some(record.event.name()));
                    return Ok(end);
                }
                Err(_damage) => {
                    end.stop = damaged(None);
                    return Ok(end);
                }
            };
            hash = record.hash;
            let Some(flight) = &mut flight else {
                let TapeEvent::Begin { program, build, configuration } = &record.event else {
                    end.stop = damaged(Some(record.event.name()));
                    return Ok(end);
                };
                let name = "the recorded configuration";
                check_recorded::<controller::Config>(name, configuration)
                    .with_context(|| recorded_by(program))?;
                let config = from_toml(name, configuration, set)?;
                let mut new = TapedFlight::new(record.now_ns, config.settings, Arc::default())?;
                drop(new.take_tape());
                flight = Some(new);
                (end.program, end.build) = (program.to_string(), build.to_string());
                end.events += 1;
                continue;
            };
            end.is_ended = record.event == TapeEvent::Shutdown;
            let other = instead(&record.event);
            if !flight.replay(record.now_ns, other.as_ref().unwrap_or(&record.event)) {
                end.stop = damaged(Some(record.event.name()));
                return Ok(end);
            }
            while flight.poll_outgoing().is_some() {}
            let now = flight.take_tape();
            let replayed = now.as_ref().and_then(|now| now.records().next()).and_then(Result::ok);
            let replayed = replayed.context("a replayed event has no result")?;
            end.flight_s = record.now_ns.saturating_sub(tape.begun_ns) as f64 * 1e-9;
            let step = Replayed {
                recorded: &record,
                replayed: &replayed,
                flight: flight.flight(),
                time_s: end.flight_s,
            };
            if let ControlFlow::Break(stop) = each(step) {
                end.stop = Some(stop);
                return Ok(end);
            }
            end.events += 1;
        }
    }
    if end.events == 0 {
        end.stop = Some(Stop::NoBeginning { first: 0 });
    }
    Ok(end)
}

/// The controller's configuration at the begin of its tape.
pub(crate) fn configuration(tape: &RecordedTape) -> Option<String> {
    match tape.parts.first()?.records().next()?.ok()?.event {
        TapeEvent::Begin { configuration, .. } => Some(configuration.into_owned()),
        _ => None,
    }
}

/// Reports which settings `key=value` are of the guidance that a tape's landing is not flown with, under them; `None` where there are none
/// and where the configuration cannot be read, which a replay reports.
pub fn of_unused_guidance(tape: &RecordedTape, set: &[String]) -> Option<String> {
    let config: controller::Config =
        configured("the recorded configuration", &configuration(tape)?, set).ok()?;
    let [used, other] = match config.guidance {
        GuidanceName::Metric => ["metric", "thesis"],
        GuidanceName::Thesis => ["thesis", "metric"],
    };
    let keys = set.iter().filter_map(|setting| Some(setting.split_once('=')?.0.trim()));
    let is_of_other =
        |key: &&str| key.strip_prefix(other).is_some_and(|rest| rest.starts_with('.'));
    let unused: Vec<String> = keys.filter(is_of_other).map(|key| format!("`{key}`")).collect();
    (!unused.is_empty()).then(|| {
        format!(
            "{} changes nothing: the guidance `{other}` is not in use, but `{used}` (`--set guidance={other}` flies the other one)",
            unused.join(", ")
        )
    })
}

/// A recorded configuration with settings of the replay over it, which may correct it: it may name files of another machine.
///
/// # Errors
/// When it cannot be read: a [`node::ConfigError`] where that is for a setting of now alone.
pub(crate) fn configured<T: Settings>(name: &str, toml: &str, set: &[String]) -> anyhow::Result<T> {
    from_toml(name, toml, set).map(|config| config.settings).or_else(|error| {
        check_recorded::<T>(name, toml)?;
        Err(error.into())
    })
}

/// Whether a recorded configuration can be read as it is.
///
/// # Errors
/// When it cannot, as text only: the settings of the replay are not wrong.
fn check_recorded<T: Settings>(name: &str, toml: &str) -> anyhow::Result<()> {
    from_toml::<T>(name, toml, &[]).map(drop).map_err(|error| anyhow!("{error}"))
}

/// Describes a recorded configuration that cannot be read, whatever the settings are.
fn recorded_by(program: &str) -> String {
    let ours = controller::tape::program();
    if program == ours {
        return format!("the recording is of another build of {ours}; replay it with that one");
    }
    format!("the recording is of {program}, and this is {ours}; replay it with that one")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_configuration_that_cannot_be_read_names_its_program_once() {
        let ours = controller::tape::program();
        assert_eq!(recorded_by(&ours).matches(&ours).count(), 1);
        let other = recorded_by("alight 9.9.9");
        assert!(other.contains("alight 9.9.9") && other.contains(&ours), "{other}");
    }

    /// The tape of a controller that begins with this configuration.
    fn tape(configuration: &str) -> RecordedTape {
        let mut tape = messages::TapeWriter::new(0);
        let configuration = configuration.into();
        let begin =
            TapeEvent::Begin { program: "test".into(), build: "test".into(), configuration };
        tape.write(0, &begin, &messages::TapeOutput::default());
        RecordedTape { begun_ns: 0, parts: vec![tape.take().unwrap()] }
    }

    #[test]
    fn a_setting_of_the_guidance_that_is_not_flown_is_reported() {
        let unused = |configuration: &str, set: &[&str]| {
            let set: Vec<String> = set.iter().map(|&it| it.to_owned()).collect();
            of_unused_guidance(&tape(configuration), &set)
        };
        let thesis = "guidance = \"thesis\"";
        let warning = unused(thesis, &["metric.lateral_gain=0.9", "marker=rings"]).unwrap();
        assert!(warning.contains("`metric.lateral_gain` changes nothing"), "{warning}");
        assert!(warning.contains("`metric` is not in use, but `thesis`"), "{warning}");
        assert!(
            unused("", &["thesis.tolerance_px=200"]).unwrap().contains("`thesis` is not in use")
        );
        assert_eq!(unused("", &["metric.lateral_gain=0.9"]), None);
        assert_eq!(unused(thesis, &["guidance=metric", "metric.lateral_gain=0.9"]), None);
        assert_eq!(unused(thesis, &["metric.no_such_key=1"]), None);
    }

    #[test]
    fn only_a_setting_of_now_is_a_wrong_configuration() {
        let error = |configuration: &str, set: &[&str]| {
            let set: Vec<String> = set.iter().map(|&it| it.to_owned()).collect();
            run(&tape(configuration), &set, |_| ControlFlow::Continue(())).unwrap_err()
        };
        let recorded = error("no_such_key = 3", &[]);
        assert!(!recorded.is::<node::ConfigError>(), "{recorded:#}");
        assert!(format!("{recorded:#}").contains("no_such_key"), "{recorded:#}");
        let given = error("", &["no_such_key=3"]);
        assert!(given.is::<node::ConfigError>(), "{given:#}");
    }
}
