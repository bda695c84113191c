//! `alight experiment`: the thesis' experiments again.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;
use clap::{Args, Subcommand};
use experiments::markers::{self, Request};
use experiments::sets::Set;
use indicatif::ProgressBar;

use crate::cli::write_error;

#[derive(Args)]
pub(crate) struct ExperimentArgs {
    #[command(subcommand)]
    experiment: Experiment,
}

#[derive(Subcommand)]
enum Experiment {
    /// Find markers in rendered frames whose truth is known (the thesis' section 4.3, and more), and write tables and
    /// figures.
    Markers(MarkersArgs),
}

#[derive(Args)]
struct MarkersArgs {
    /// The folder to work in: frames in `sets`, answers, tables and figures in `results`. Frames that are there are not
    /// rendered again.
    #[arg(short, long, value_name = "DIR", default_value = "experiment-markers")]
    output: PathBuf,
    /// Only this set: positions, far, landing, adverse, tilt, blur, noise, light, textured, tracking or negatives. May
    /// be repeated.
    #[arg(long = "set", value_name = "NAME")]
    sets: Vec<Set>,
    /// Only this family. May be repeated.
    #[arg(long = "family", value_name = "FAMILY")]
    families: Vec<String>,
    /// A folder of photographs with `labels.jsonl`, to find markers in as well.
    #[arg(long, value_name = "DIR")]
    photographs: Option<PathBuf>,
}

/// Runs the experiment and prints its report.
pub(crate) fn run(args: ExperimentArgs) -> anyhow::Result<ExitCode> {
    use std::io::Write;
    let Experiment::Markers(args) = args.experiment;
    let sets = if args.sets.is_empty() { Set::ALL.to_vec() } else { args.sets };
    let request = Request {
        sets_in: args.output.join("sets"),
        results_in: args.output.join("results"),
        sets,
        families: args.families,
        photographs: args.photographs,
    };
    let progress = ProgressBar::new_spinner();
    let report = markers::run(&request, &mut |doing| {
        progress.set_message(doing.to_owned());
        progress.tick();
    })
    .with_context(|| format!("working in {}", args.output.display()))?;
    progress.finish_and_clear();
    match writeln!(std::io::stdout(), "{report}") {
        // The reader has seen enough, as `head` does.
        Err(problem) if problem.kind() == std::io::ErrorKind::BrokenPipe => {}
        result => result?,
    }
    write_error(&format!("tables and figures: {}", request.results_in.display()));
    Ok(ExitCode::SUCCESS)
}
