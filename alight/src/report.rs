//! `alight report`: a recorded flight on one page.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, ensure};
use clap::Args;
use replay::{End, verify};
use report::{Flight, FlightReader, Replayed, comparison, page, summary};

use crate::args::Format;
use crate::terminal::{print, write_error};

#[derive(Args)]
pub(crate) struct ReportArgs {
    /// The recording of a flight (MCAP), or those of two to compare. Files that share a controller's tape are one flight,
    /// as a recorder begins a new file when one is large.
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// The page [default: the first recording's name with `.html`, beside it].
    #[arg(short, long, value_name = "FILE.html")]
    output: Option<PathBuf>,
    /// What is printed: a line for a bug report, or the flight in numbers as one JSON object.
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

/// Maximum number of flights on a page.
const MAX_FLIGHTS: usize = 2;

/// Writes the page, and prints the summary.
pub(crate) fn run(args: &ReportArgs) -> anyhow::Result<ExitCode> {
    let flights = flights(&args.files)?;
    let html = match flights.as_slice() {
        [one] => page(one)?,
        [one, other] => comparison(one, other)?,
        all => anyhow::bail!(
            "{} flights in {:?}, a page has one, or {MAX_FLIGHTS} to compare",
            all.len(),
            args.files
        ),
    };
    let beside = args.files.first().map(|file| file.with_extension("html")).unwrap_or_default();
    let output = args.output.as_ref().unwrap_or(&beside);
    ensure!(
        !args.files.contains(output),
        "{output:?} is a recording; name another file for the page with `--output`"
    );
    std::fs::write(output, html)
        .with_context(|| format!("writing {output:?}; name another file with `--output`"))?;
    for flight in &flights {
        let summary = summary(flight);
        match args.format {
            Format::Text => print(&summary.line())?,
            Format::Json => print(&serde_json::to_string(&summary)?)?,
        }
    }
    write_error(&format!("the page: {}", output.display()));
    Ok(ExitCode::SUCCESS)
}

/// The flights in files; a file that shares a tape with one before it goes on with its flight.
fn flights(files: &[PathBuf]) -> anyhow::Result<Vec<Flight>> {
    let mut readers: Vec<(Vec<i64>, FlightReader)> = Vec::new();
    for file in files {
        let recording = std::fs::read(file).with_context(|| format!("reading {file:?}"))?;
        let mut alone = FlightReader::new(&name(file));
        alone.add(&recording).with_context(|| format!("{file:?} is no recording (MCAP file)"))?;
        let flight = alone.clone().finish();
        ensure!(
            !flight.is_empty(),
            "nothing of a flight is in {file:?}; `alight land --record` and `alight record` write recordings"
        );
        let begins: Vec<i64> = flight.tapes.iter().map(|tape| tape.begun_ns).collect();
        let same = readers.iter_mut().find(|(known, _)| begins.iter().any(|it| known.contains(it)));
        match same {
            Some((known, reader)) => {
                reader.add(&recording).with_context(|| format!("reading {file:?}"))?;
                known.extend(begins);
            }
            None => readers.push((begins, alone)),
        }
    }
    Ok(readers.into_iter().map(|(_, reader)| replayed(reader.finish())).collect())
}

fn name(file: &Path) -> String {
    file.file_name().unwrap_or(file.as_os_str()).to_string_lossy().into_owned()
}

/// The flight with the verdict of a replay of its tapes.
fn replayed(mut flight: Flight) -> Flight {
    let mut texts = Vec::new();
    let mut is_verified = true;
    for tape in &flight.tapes {
        let (is_whole, text) = match verify(tape, &[]) {
            Ok(verdict) => (verdict.is_verified(), told(&verdict.end)),
            Err(problem) => (false, format!("the tape cannot be replayed: {problem:#}")),
        };
        is_verified &= is_whole;
        texts.push(text);
    }
    flight.replayed = (!texts.is_empty()).then(|| Replayed { is_verified, text: texts.join("; ") });
    flight
}

fn told(end: &End) -> String {
    let theirs = (end.program.as_str(), end.build.as_str());
    let ours = (controller::tape::program(), controller::tape::build());
    let other = match theirs == (ours.0.as_str(), ours.1.as_str()) || theirs.0.is_empty() {
        true => String::new(),
        false => {
            format!(" (recorded by {} {}, replayed by {} {})", theirs.0, theirs.1, ours.0, ours.1)
        }
    };
    match &end.stop {
        None => format!("tape verified to the bit, {} events{other}", end.events),
        Some(stop) => format!("tape not verified: {stop}{other}"),
    }
}
