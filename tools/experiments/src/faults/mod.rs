//! Flies hundreds of flights with killed processes, wrong values and lost messages in lock-step, so that a seed
//! reproduces a flight to the bit.
//!
//! Modules in reading order: [`kind`] has the kinds of faults, [`plan`] draws those of a flight; [`flight`]
//! flies it with the faults that have [`begun`], the process of [`controller`], the autopilot's [`link`] over
//! the connections of [`channel`], with the wrong values of [`falsify`], and the [`peers`]; [`outcome`] is its
//! result and the bar; [`report`] writes the table, [`tape_file`] a recording with the controller's tape.

pub mod begun;
pub mod channel;
pub mod controller;
pub mod falsify;
pub mod flight;
pub mod kind;
pub mod link;
pub mod outcome;
pub mod peers;
pub mod plan;
pub mod report;
pub mod tape_file;

use std::sync::atomic::{AtomicUsize, Ordering};

use crate::landing::plan::{ONLY_SIZE_COUNTS, Vision, only_size_counts};
use crate::landing::{Watch, in_parallel_until};
use crate::results::{self, Folder};
use flight::{fly, fly_with_tape};
use outcome::Outcome;
use plan::Request;

/// The results of a campaign.
#[derive(Clone, Debug)]
pub struct Findings {
    /// The report, in Markdown.
    pub report: String,
    /// Every flight that was flown.
    pub outcomes: Vec<Outcome>,
    /// Number of flights that were planned: more, when they were interrupted.
    pub planned: usize,
}

/// Flies all, and writes every flight and the report into the folder. Of flights that are interrupted it writes those that were flown.
///
/// # Errors
/// When a setting is invalid or a file cannot be written.
pub fn run(request: &Request, folder: &mut Folder, watch: Watch<'_>) -> anyhow::Result<Findings> {
    let flights = request.plan.flights();
    let planned = flights.len();
    let done = AtomicUsize::new(0);
    let outcomes = in_parallel_until(&flights, request.jobs, watch.is_interrupted, |planned| {
        let outcome = match &request.tapes_in {
            None => fly(planned)?,
            Some(folder) => {
                let (outcome, tapes) = fly_with_tape(planned)?;
                let name = format!("{}-{}.mcap", outcome.kinds.replace(' ', "-"), planned.seed);
                tape_file::write(&folder.join(name), &tapes, &planned.command())?;
                outcome
            }
        };
        (watch.progress)(done.fetch_add(1, Ordering::Relaxed) + 1, flights.len());
        Ok(outcome)
    })?;
    let outcomes: Vec<Outcome> = outcomes.into_iter().flatten().collect();
    let title = format!(
        "{}{}{} flights in lock-step, seeds from {}",
        results::origin(&request.command),
        note(&flights),
        outcomes.len(),
        request.plan.seed
    );
    let report = report::write(folder, &title, &outcomes, planned, false)?;
    Ok(Findings { report, outcomes, planned })
}

/// A warning in bold that stands before all numbers, or nothing.
fn note(flights: &[plan::Planned]) -> String {
    let modelled = Vision::Modelled.name();
    let needs_warning =
        flights.iter().any(|planned| only_size_counts(modelled, &planned.settings()));
    if needs_warning { format!("**{ONLY_SIZE_COUNTS}**\n\n") } else { String::new() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_marker_that_does_not_count_gives_a_warning() {
        let of = |marker: &str| {
            let marker = marker.parse().ok();
            note(&plan::Plan { marker, flights: 1, ..plan::Plan::default() }.flights())
        };
        assert!(of("aruco-4x4-50:3:0.15").contains("`--real-time`"));
        assert_eq!(of("rings:0.2"), "");
    }
}
