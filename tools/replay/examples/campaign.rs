//! Flights of the campaign with faults, each verified by its tape: `campaign [FLIGHTS] [FIRST SEED] [FOLDER FOR RECORDINGS]`.

#![expect(clippy::print_stdout, reason = "figures are for people to read")]

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::time::Instant;

use anyhow::ensure;
use experiments::faults::flight::fly_with_tape;
use experiments::faults::kind::Kind;
use experiments::faults::plan::{Plan, Planned};
use experiments::faults::tape_file;
use experiments::landing::in_parallel;
use flightlog::TapeReader;
use replay::{Verdict, verify};

/// Flights at the same time.
const JOBS: usize = 2;

fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let mut number = |usual| arguments.next().map_or(Ok(usual), |text| text.parse());
    let (flights, seed) = (number(200)?, number(1)?);
    let folder = arguments.next().map(PathBuf::from);
    let planned = Plan { flights, seed, ..Plan::default() }.flights();
    let verdicts = in_parallel(&planned, JOBS, |planned| verified(planned, folder.as_ref()))?;
    let (mut events, mut flight_s, mut replay_s, mut tapes, mut failed) = (0, 0.0, 0.0, 0, 0);
    for ((verdict, took_s), planned) in verdicts
        .iter()
        .zip(&planned)
        .flat_map(|(verdicts, p)| verdicts.iter().map(move |verdict| (verdict, p)))
    {
        tapes += 1;
        events += verdict.end.events;
        flight_s += verdict.end.flight_s;
        replay_s += took_s;
        if let Some(stop) = verdict.end.stop.as_ref().or(verdict.other_state.as_ref()) {
            failed += 1;
            println!("{}: {stop}", planned.command());
        }
    }
    let flown: BTreeSet<_> =
        planned.iter().flat_map(|planned| &planned.faults).map(|fault| fault.kind.name()).collect();
    println!(
        "{} flights with {} of {} kinds of faults, {tapes} tapes, {events} events, {:.0} min of flight, verified {:.0} x as fast: {failed} differ",
        planned.len(),
        flown.len(),
        Kind::in_lockstep().count(),
        flight_s / 60.0,
        flight_s / replay_s
    );
    ensure!(failed == 0, "{failed} tapes give another result");
    Ok(())
}

/// Flies, and verifies the tape of each life of the controller; with the times that this took, in seconds.
fn verified(planned: &Planned, folder: Option<&PathBuf>) -> anyhow::Result<Vec<(Verdict, f64)>> {
    let (_, parts) = fly_with_tape(planned)?;
    if let Some(folder) = folder {
        let path = folder.join(format!("{}.mcap", planned.seed));
        tape_file::write(&path, &parts, &planned.command())?;
    }
    let mut reader = TapeReader::default();
    parts.into_iter().for_each(|part| reader.push(part));
    let verify = |tape| {
        let began = Instant::now();
        Ok((verify(&tape, &[])?, began.elapsed().as_secs_f64()))
    };
    reader.tapes().into_iter().map(verify).collect()
}
