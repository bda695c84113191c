//! Hundreds of landings: the simulator's world and the controller in lock-step in one process, without a
//! network or a clock, so that a seed reproduces a flight to the bit.
//!
//! Modules in reading order: [`plan`] has the flights, with the faults of [`fault`]; [`flight`] flies one,
//! with the vision of [`sim_vision`], rendered or modelled; [`outcome`] is its result; [`table`] summarises many;
//! [`plots`] and [`thesis_figures`] draw; [`report`] writes the report, and `recording` a flight as a recorder would.

pub mod fault;
pub mod flight;
pub mod outcome;
pub mod plan;
pub mod plots;
mod recording;
pub mod report;
pub mod sim_vision;
pub mod table;
pub mod thesis_figures;

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use anyhow::Context;

use flight::fly;
use plan::Request;

/// Flies all, writes results, plots and the report, and returns the report. `progress` gets the number of
/// finished flights and of all.
///
/// # Errors
/// When a setting is invalid or a file cannot be written.
pub fn run(request: &Request, progress: &(dyn Fn(usize, usize) + Sync)) -> anyhow::Result<String> {
    let flights = request.plan.flights();
    let done = AtomicUsize::new(0);
    let outcomes = in_parallel(&flights, request.jobs, |planned| {
        let outcome = fly(planned, None)?;
        progress(done.fetch_add(1, Ordering::Relaxed) + 1, flights.len());
        Ok(outcome)
    })?;
    std::fs::create_dir_all(&request.results_in)
        .with_context(|| format!("making {}", request.results_in.display()))?;
    report::write(request, &flights, &outcomes)
}

/// Flies on several threads; the outcomes are in the order of the flights.
///
/// # Errors
/// The first error.
pub fn in_parallel<P: Sync, O: Send>(
    flights: &[P],
    jobs: usize,
    fly: impl Fn(&P) -> anyhow::Result<O> + Sync,
) -> anyhow::Result<Vec<O>> {
    let next = AtomicUsize::new(0);
    let results: Mutex<Vec<(usize, anyhow::Result<O>)>> = Mutex::default();
    std::thread::scope(|scope| {
        for _ in 0..jobs.clamp(1, flights.len().max(1)) {
            scope.spawn(|| {
                loop {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    let Some(planned) = flights.get(index) else { break };
                    let result = fly(planned);
                    results.lock().unwrap_or_else(PoisonError::into_inner).push((index, result));
                }
            });
        }
    });
    let mut results = results.into_inner().unwrap_or_else(PoisonError::into_inner);
    results.sort_by_key(|(index, _)| *index);
    results.into_iter().map(|(_, result)| result).collect()
}
