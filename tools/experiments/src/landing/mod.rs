//! Flies hundreds of landings: the simulator's world and the controller in lock-step in one process, without a
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

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use flight::fly;
use node::{ConfigError, Effective, Layers, Settings};
use outcome::Outcome;
use plan::{Planned, Request};

use crate::results::Folder;

/// The configuration of a service by these settings over its defaults; an error names the service.
pub(crate) fn configuration<T: Settings>(
    service: &str,
    set: &[String],
) -> Result<Effective<T>, ConfigError> {
    let layers = Layers { file: None, set: set.to_vec() };
    layers.load().map_err(|problem| problem.of_service(service))
}

/// How flights are watched.
#[derive(Copy, Clone)]
pub struct Watch<'a> {
    /// Gets the number of finished flights and of all.
    pub progress: &'a (dyn Fn(usize, usize) + Sync),
    /// Whether to begin no further flight.
    pub is_interrupted: &'a (dyn Fn() -> bool + Sync),
}

/// The results of many landings.
#[derive(Clone, Debug)]
pub struct Landings {
    /// The report, in Markdown.
    pub report: String,
    /// Number of flights that were flown, and of those that were planned: more, when they were interrupted.
    pub flown: usize,
    /// See `flown`.
    pub planned: usize,
}

/// Flies all, writes results, plots and the report into the folder. Of flights that are interrupted it writes those that were flown.
///
/// # Errors
/// When a setting is invalid or a file cannot be written.
pub fn run(request: &Request, folder: &mut Folder, watch: Watch<'_>) -> anyhow::Result<Landings> {
    let flights = request.plan.flights();
    let planned = flights.len();
    let done = AtomicUsize::new(0);
    let outcomes = in_parallel_until(&flights, request.jobs, watch.is_interrupted, |planned| {
        let outcome = fly(planned, None)?;
        (watch.progress)(done.fetch_add(1, Ordering::Relaxed) + 1, flights.len());
        Ok(outcome)
    })?;
    let (flights, outcomes): (Vec<Planned>, Vec<Outcome>) = flights
        .into_iter()
        .zip(outcomes)
        .filter_map(|(planned, outcome)| Some((planned, outcome?)))
        .unzip();
    let flown = outcomes.len();
    let report =
        report::write(request, folder, &flights, &outcomes, planned, watch.is_interrupted)?;
    Ok(Landings { report, flown, planned })
}

/// Flies on several threads; the outcomes are in the order of the flights.
///
/// # Errors
/// The first error, after which no flight is begun.
pub fn in_parallel<P: Sync, O: Send>(
    flights: &[P],
    jobs: usize,
    fly: impl Fn(&P) -> anyhow::Result<O> + Sync,
) -> anyhow::Result<Vec<O>> {
    let outcomes = in_parallel_until(flights, jobs, &|| false, fly)?;
    Ok(outcomes.into_iter().flatten().collect())
}

/// As [`in_parallel`], until an interruption, after which no flight is begun: those that were not flown have no outcome.
///
/// # Errors
/// The first error, after which no flight is begun either.
pub fn in_parallel_until<P: Sync, O: Send>(
    flights: &[P],
    jobs: usize,
    is_interrupted: &(dyn Fn() -> bool + Sync),
    fly: impl Fn(&P) -> anyhow::Result<O> + Sync,
) -> anyhow::Result<Vec<Option<O>>> {
    let next = AtomicUsize::new(0);
    let has_failed = AtomicBool::new(false);
    let results: Mutex<Vec<(usize, anyhow::Result<O>)>> = Mutex::default();
    std::thread::scope(|scope| {
        for _ in 0..jobs.clamp(1, flights.len().max(1)) {
            scope.spawn(|| {
                while !is_interrupted() && !has_failed.load(Ordering::Relaxed) {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    let Some(planned) = flights.get(index) else { break };
                    let result = fly(planned);
                    has_failed.fetch_or(result.is_err(), Ordering::Relaxed);
                    results.lock().unwrap_or_else(PoisonError::into_inner).push((index, result));
                }
            });
        }
    });
    let mut results = results.into_inner().unwrap_or_else(PoisonError::into_inner);
    results.sort_by_key(|(index, _)| *index);
    let mut outcomes: Vec<Option<O>> = flights.iter().map(|_| None).collect();
    for (index, result) in results {
        let outcome = result?;
        if let Some(place) = outcomes.get_mut(index) {
            *place = Some(outcome);
        }
    }
    Ok(outcomes)
}
