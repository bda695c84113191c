//! `alight replay`: a recording back into the controller's decisions.

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Instant;

use anyhow::{Context, ensure};
use clap::{Args, ValueEnum};
use flightlog::{RecordedTape, TapeReader};
use replay::{Change, End, change, verify};

use crate::terminal::{print, write_error};

#[derive(Args)]
pub(crate) struct ReplayArgs {
    /// The recording, an MCAP file; of a recording in several files all, from the first on.
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Compare what comes out of each event with what came out then, to the bit. The first event that gives another
    /// result is named, with the value. Exit status 0 when there is none, 1 otherwise.
    #[arg(long)]
    verify: bool,
    /// From where it is flown again: from detections on, with estimator and guidance, to see what `--set` changes. The
    /// vehicle moves as it was recorded. Without it the phases are listed.
    #[arg(long, value_enum, conflicts_with = "verify")]
    from: Option<From>,
    /// One setting of the controller over the recorded configuration. May be repeated.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum From {
    /// Detections.
    Detections,
}

/// Replays, and prints what came out.
pub(crate) fn run(args: &ReplayArgs) -> anyhow::Result<ExitCode> {
    let mut reader = TapeReader::default();
    for file in &args.files {
        let recording = std::fs::read(file).with_context(|| format!("reading {file:?}"))?;
        reader.read(&recording).with_context(|| format!("{file:?} is no recording (MCAP file)"))?;
    }
    for damage in reader.damage() {
        write_error(damage);
    }
    let mut is_whole = reader.damage().is_empty();
    let tapes = reader.tapes();
    ensure!(
        !tapes.is_empty(),
        "there is no tape of a controller in {:?}; `alight land --record` and `alight record` keep it",
        args.files
    );
    for tape in &tapes {
        is_whole &= one(tape, args)?;
    }
    Ok(if is_whole { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Replays one controller's tape; true when nothing is wrong with it.
fn one(tape: &RecordedTape, args: &ReplayArgs) -> anyhow::Result<bool> {
    let began = Instant::now();
    let mut other_state = None;
    let end = if args.verify {
        let verdict = verify(tape, &args.set)?;
        other_state = verdict.other_state;
        verdict.end
    } else {
        let change = change(tape, &args.set)?;
        for begun in &change.phases {
            print(&format!("{:9.3} s  {:<16}  {}", begun.time_s, begun.phase, begun.why))?;
        }
        if args.from.is_some() || !args.set.is_empty() {
            print(&told(&change))?;
        }
        change.end
    };
    let took_s = began.elapsed().as_secs_f64().max(1e-9);
    let ours = (controller::tape::program(), controller::tape::build());
    if (&end.program, &end.build) != (&ours.0, &ours.1) && !end.program.is_empty() {
        let (program, build) = ours;
        let End { program: theirs, build: their_build, .. } = &end;
        print(&format!("recorded by {theirs} ({their_build}), replayed by {program} ({build})"))?;
    }
    let done = if args.verify { "verified" } else { "replayed" };
    print(&format!(
        "{done} {} events, {:.1} s of flight, {:.0} x real time",
        end.events,
        end.flight_s,
        end.flight_s / took_s
    ))?;
    if let Some(other_state) = &other_state {
        print(&other_state.to_string())?;
    }
    if let Some(stop) = &end.stop {
        print(&stop.to_string())?;
    } else if !end.is_ended {
        print("the tape has no end: the controller was killed, or the end was not recorded")?;
    }
    Ok(end.stop.is_none() && other_state.is_none())
}

fn told(change: &Change) -> String {
    let Some(first_s) = change.first_s else {
        return match change.other_outputs {
            0 => "no decision is another one".to_owned(),
            count => format!(
                "no decision is another one; packets for the autopilot or replies are, after {count} of {} events",
                change.end.events
            ),
        };
    };
    format!(
        "other decisions after {} of {} events, the first at {first_s:.3} s; another phase after {}\n\
         velocity setpoints differ by {:.3} m/s at most, {:.3} m/s root mean square; the estimated landing point by {:.3} m at most",
        change.different,
        change.end.events,
        change.other_phase,
        change.max_velocity_m_s,
        change.rms_velocity_m_s,
        change.max_target_m
    )
}
