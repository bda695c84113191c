//! The experiment with markers without the rest of the program: `cargo run --release -p experiments --example
//! markers -- SETS RESULTS [set=NAME] [family=NAME]
//! [photographs=FOLDER] [processing=NAME] [seed=N] [every=N]...`.
#![allow(clippy::print_stdout, clippy::print_stderr, reason = "a program for people at a terminal")]

use std::ops::ControlFlow;
use std::path::PathBuf;

use experiments::markers::{Request, Step, run};
use experiments::record::Ids;
use experiments::set::Set;
use experiments::sets::Variant;

fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let mut folder = || arguments.next().map(PathBuf::from).ok_or_else(usage);
    let mut request = Request {
        command: String::new(),
        sets_in: folder()?,
        results_in: folder()?,
        sets: Vec::new(),
        families: Vec::new(),
        photographs: None,
        variant: Variant::default(),
        ids: Ids::Any,
    };
    for argument in arguments {
        match argument.split_once('=') {
            Some(("set", name)) => request.sets.push(name.parse().map_err(anyhow::Error::msg)?),
            Some(("family", name)) => request.families.push(name.to_owned()),
            Some(("photographs", folder)) => request.photographs = Some(folder.into()),
            Some(("processing", name)) => {
                request.variant.processing = name.parse().map_err(anyhow::Error::msg)?;
            }
            Some(("seed", seed)) => request.variant.seed = seed.parse()?,
            Some(("every", every)) => request.variant.every = every.parse()?,
            _ => return Err(usage()),
        }
    }
    if request.sets.is_empty() {
        request.sets = Set::ALL.to_vec();
    }
    let mut begins = |step: Step<'_>| {
        eprintln!("{step}");
        ControlFlow::Continue(())
    };
    let report = run(&request, &mut begins)?.report;
    println!("{report}");
    Ok(())
}

fn usage() -> anyhow::Error {
    anyhow::anyhow!(
        "usage: markers SETS RESULTS [set=NAME] [family=NAME] [photographs=FOLDER] [processing=NAME] [seed=N] [every=N]..."
    )
}
