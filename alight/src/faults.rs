//! `alight experiment faults`: the options of a campaign of landings with faults, its flights in lock-step or in real time with
//! processes, and its report with every unsafe touchdown.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;
use clap::Args;
use experiments::faults::kind::Kind;
use experiments::faults::outcome::Outcome;
use experiments::faults::plan::{Plan, Request, SWEPT, Second};
use experiments::faults::report;
use experiments::faults::{self, Findings};
use experiments::landing::Watch;
use experiments::landing::plan::{
    ONLY_SIZE_COUNTS, Values, Vision, only_size_counts, refuse_swept, settings_text,
};
use experiments::results::{self, Folder};
use markers::Marker;

use crate::args::{JOBS, WrongUse, flight_setting, sized_marker, whole_number};
use crate::children::this_command;
use crate::interruption::{FLIGHTS_END, Interruption};
use crate::progress::Steps;
use crate::real_time;
use crate::runtime::{block_on, cores};
use crate::terminal::{print, write_error};

/// Number of flights in lock-step.
const LOCKSTEP_FLIGHTS: u64 = 1000;

#[derive(Args)]
pub(crate) struct FaultsArgs {
    /// Output folder: report, every flight as CSV and JSON lines.
    #[arg(short, long, value_name = "DIR", default_value = "experiment-faults")]
    pub(crate) output: PathBuf,
    /// Replace the results of an experiment that are in the output folder, once there are new ones; without it they are refused.
    #[arg(long)]
    replace: bool,
    /// Number of flights [default: 1000, in real time as many as there are kinds].
    #[arg(long, value_name = "N", value_parser = whole_number::<u64>(1..=1_000_000))]
    flights: Option<u64>,
    /// Seed of the first flight; the others follow. A seed draws the fault's begin and duration, and the wind.
    #[arg(long, value_name = "S", default_value_t = 1, value_parser = whole_number::<u64>(0..=u64::MAX))]
    seed: u64,
    /// Only this kind of fault. May be repeated. An unknown name lists all.
    #[arg(long = "kind", value_name = "NAME")]
    kinds: Vec<Kind>,
    /// Height over the pad at which it begins, in metres, up to that of the start (10): a value, a list 0.3,2,5, or a range.
    #[arg(long, allow_hyphen_values = true, value_name = "M", default_value = "0.2..9")]
    height: Values,
    /// How long it lasts, in seconds, or `ever`; a list as well [default: one of 0.5, 2, 5 and ever].
    #[arg(long = "for", value_name = "S", value_delimiter = ',', value_parser = duration_s)]
    durations_s: Vec<f64>,
    /// Mean wind, in m/s; a list as well [default: 0 or 5].
    #[arg(long, allow_hyphen_values = true, value_name = "M/S", value_delimiter = ',', value_parser = wind_m_s)]
    wind: Vec<f64>,
    /// A second fault at the same time: a kind, or `none` [default: any, in a fifth of the flights].
    #[arg(long, value_name = "NAME")]
    with: Option<String>,
    /// Marker to land on, of pad, detector and controller together: FAMILY:ID:SIZE_M, or FAMILY:SIZE_M for a family without ids. In
    /// lock-step its detector has the errors of `rings` whatever the marker; with `--real-time` it is searched for in rendered frames.
    #[arg(long, value_name = "MARKER", value_parser = sized_marker)]
    marker: Option<Marker>,
    /// One further setting: simulator.KEY=VALUE or controller.KEY=VALUE. May be repeated.
    #[arg(long, value_name = "SERVICE.KEY=VALUE", value_parser = flight_setting)]
    set: Vec<String>,
    /// Number of flights in parallel [default: number of cores].
    #[arg(long, value_name = "N", value_parser = whole_number::<usize>(JOBS))]
    jobs: Option<usize>,
    /// Folder for a recording of each flight with its controller's tape, for `alight replay`; in lock-step only.
    #[arg(long, value_name = "DIR", conflicts_with = "real_time")]
    record_tapes: Option<PathBuf>,
    /// Fly in real time, with the services as processes that are killed and stopped (SIGKILL, SIGSTOP), one
    /// flight after the other.
    #[arg(long)]
    real_time: bool,
}

fn duration_s(text: &str) -> Result<f64, String> {
    if text == "ever" {
        return Ok(f64::INFINITY);
    }
    let number: Option<f64> = text.parse().ok();
    number
        .filter(|seconds| (0.01..=300.0).contains(seconds))
        .ok_or_else(|| format!("`{text}` is neither from 0.01 to 300 nor `ever`"))
}

fn wind_m_s(text: &str) -> Result<f64, String> {
    let number: Option<f64> = text.parse().ok();
    number
        .filter(|speed| (0.0..=20.0).contains(speed))
        .ok_or_else(|| format!("`{text}` is not from 0 to 20"))
}

impl FaultsArgs {
    fn plan(self) -> Result<Plan, String> {
        let second = match self.with.as_deref() {
            None if self.real_time => Second::None,
            None => Second::Drawn,
            Some("none") => Second::None,
            Some(name) => Second::Always(name.parse()?),
        };
        let possible: Vec<Kind> = match self.real_time {
            true => Kind::in_real_time().collect(),
            false => Kind::in_lockstep().collect(),
        };
        let kinds = if self.kinds.is_empty() { possible.clone() } else { self.kinds };
        let second_kind = match second {
            Second::Always(kind) => Some(kind),
            _ => None,
        };
        if let Some(kind) = kinds.iter().chain(&second_kind).find(|kind| !possible.contains(kind)) {
            let how = if self.real_time { "without" } else { "with" };
            return Err(format!("`{}` is flown {how} --real-time only", kind.name()));
        }
        // In real time each kind has its flight: neighbouring seeds have different ones.
        let usual = if self.real_time { possible.len() as u64 } else { LOCKSTEP_FLIGHTS };
        Ok(Plan {
            flights: self.flights.unwrap_or(usual),
            seed: self.seed,
            kinds,
            height: self.height,
            durations_s: self.durations_s,
            winds_m_s: self.wind,
            second,
            marker: self.marker,
            set: self.set,
            real_time: self.real_time,
        })
    }
}

/// Flies the campaign in real time, one flight after the other; one that is interrupted does not count.
fn run_in_real_time(
    request: &Request,
    folder: &mut Folder,
    interruption: &Interruption,
) -> anyhow::Result<Findings> {
    node::start_logging("error");
    let flights = request.plan.flights();
    let planned = flights.len();
    let steps = Steps::of_flights();
    let origin = results::origin(&request.command);
    let title = format!("{origin}Flights in real time, seeds from {}", request.plan.seed);
    let mut findings = Findings { report: String::new(), outcomes: Vec::new(), planned };
    for flight in &flights {
        let logs = folder.begin_logs(flight.seed)?;
        let flown = block_on(async {
            tokio::select! {
                outcome = real_time::fly(flight, &logs) => outcome.map(Some),
                () = interruption.requested() => Ok(None),
            }
        })?;
        // The services of a terminal's Ctrl-C end at once, and the flight with an error.
        let Some(outcome) = flown.or_else(|problem| match interruption.is_requested() {
            true => Ok(None),
            false => Err(problem),
        })?
        else {
            break;
        };
        write_error(&format!(
            "{} ({}) at {:.1} m: {:?}, {} m/s down, {} {}",
            outcome.kinds,
            outcome.seed,
            outcome.height_m,
            outcome.ending,
            outcome.sink_m_s.map_or("no touch,".to_owned(), |sink| format!("{sink:.2}")),
            outcome.phase,
            outcome.why,
        ));
        if let Err(problem) = folder.keep_logs(flight.seed) {
            write_error(&format!("warning: {problem:#}"));
        }
        findings.outcomes.push(outcome);
        steps.flown(findings.outcomes.len(), planned);
        // The results so far, in case the next flight ends this process.
        report::write(folder, &title, &findings.outcomes, planned, true)?;
    }
    steps.finish();
    findings.report = report::write(folder, &title, &findings.outcomes, planned, false)?;
    Ok(findings)
}

/// Flies the campaign in lock-step, several flights at once.
fn run_in_lockstep(
    request: &Request,
    folder: &mut Folder,
    interruption: &Interruption,
) -> anyhow::Result<Findings> {
    let steps = Steps::of_flights();
    let watch = Watch {
        progress: &|done, of| steps.flown(done, of),
        is_interrupted: &|| interruption.is_requested(),
    };
    let findings = faults::run(request, folder, watch)?;
    steps.finish();
    Ok(findings)
}

/// Flies the campaign and prints its report; a failure when a touchdown was unsafe or a flight did not end.
pub(crate) fn run(args: FaultsArgs) -> anyhow::Result<ExitCode> {
    let (output, jobs) = (args.output.clone(), args.jobs.unwrap_or_else(cores));
    let (real_time, tapes_in, replaces) = (args.real_time, args.record_tapes.clone(), args.replace);
    refuse_swept(&args.set, &SWEPT).map_err(WrongUse)?;
    let plan = args.plan().map_err(WrongUse)?;
    plan.check()?;
    plan.check_marker().map_err(WrongUse)?;
    let request = Request { command: this_command(), plan, tapes_in, jobs };
    let mut folder = Folder::claim(&output, replaces)?;
    request.tapes_in.as_deref().map_or(Ok(()), results::claim_for_recordings)?;
    if !real_time {
        let plan = &request.plan;
        let settings = settings_text(plan.marker.as_ref(), &plan.set);
        warn_if_only_size_counts(Vision::Modelled, &settings);
    }
    let interruption = Interruption::on_signals(match real_time {
        true => "the flight under way does not count, and those before it are kept",
        false => FLIGHTS_END,
    })?;
    let findings = match real_time {
        true => run_in_real_time(&request, &mut folder, &interruption),
        false => run_in_lockstep(&request, &mut folder, &interruption),
    }
    .with_context(|| format!("working in {}", output.display()))?;
    print(findings.report.trim_end())?;
    if !findings.outcomes.is_empty() {
        write_error(&format!("flights and this report: {}", output.display()));
    }
    if interruption.is_requested() {
        if let Some(bad) = failure_text(&findings.outcomes) {
            write_error(&format!("{bad}, which the exit status of an interruption does not show"));
        }
        return Ok(interruption.exit_code());
    }
    let is_good = failure_text(&findings.outcomes).is_none();
    Ok(if is_good { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Warns before the flights if another marker of the same size would give the same flights.
pub(crate) fn warn_if_only_size_counts(vision: Vision, settings: &str) {
    if only_size_counts(vision.name(), settings) {
        write_error(&format!("warning: {ONLY_SIZE_COUNTS}"));
    }
}

/// How many of the flights were unsafe or did not end; `None` if none was and every flight ended.
fn failure_text(outcomes: &[Outcome]) -> Option<String> {
    let count = |of: fn(&Outcome) -> bool| outcomes.iter().filter(|outcome| of(outcome)).count();
    let [beyond, unended] = [count(Outcome::is_unsafe), count(Outcome::is_unended)];
    let flown = outcomes.len();
    let text = || {
        format!("of {flown} flights that were flown {beyond} were unsafe and {unended} did not end")
    };
    (beyond + unended > 0).then(text)
}

#[cfg(test)]
mod tests {
    use clap::Parser;
    use experiments::faults::outcome::Ending;

    use super::*;

    #[derive(Parser)]
    struct Tool {
        #[command(flatten)]
        args: FaultsArgs,
    }

    #[test]
    fn unsafe_and_unended_flights_are_reported() {
        let planned = &plan(&["--flights", "1"]).flights()[0];
        let safe = Outcome { ending: Ending::Landed, is_over: true, ..Outcome::new(planned) };
        assert_eq!(failure_text(&[]), None);
        assert_eq!(failure_text(std::slice::from_ref(&safe)), None);
        let beyond = Outcome { sink_m_s: Some(3.0), ..safe.clone() };
        let unended = Outcome { is_over: false, ..safe.clone() };
        let text = failure_text(&[safe, beyond.clone(), unended, beyond]).unwrap();
        assert!(
            text.contains("4 flights") && text.contains("2 were unsafe and 1 did not"),
            "{text}"
        );
    }

    fn plan(options: &[&str]) -> Plan {
        let words = ["faults"].iter().chain(options);
        Tool::try_parse_from(words).unwrap().args.plan().unwrap()
    }

    #[test]
    fn each_kind_has_a_flight_unless_a_number_is_given() {
        for (options, kinds) in [
            (&["--real-time"][..], Kind::in_real_time().collect::<Vec<Kind>>()),
            (&[], Kind::in_lockstep().collect()),
        ] {
            let flights = plan(options).flights();
            for kind in kinds {
                let is_flown = flights.iter().any(|flight| flight.faults[0].kind == kind);
                assert!(is_flown, "{options:?}: {}", kind.name());
            }
        }
        assert_eq!(plan(&["--real-time", "--flights", "3"]).flights().len(), 3);
    }
}
