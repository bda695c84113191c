//! Writes the files of the landing experiment: every flight as CSV and JSON lines, plots, the thesis' figures of one
//! flight, recordings of the worst flights flown again, and the report.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::fs::File;
use std::io::BufWriter;

use anyhow::Context;
use messages::Touchdown;

use super::flight::{fly, fly_recorded};
use super::outcome::{Ending, MAX_HOP_M, MAX_SINK_M_S, MAX_SLIDE_M_S, Outcome};
use super::plan::{ONLY_SIZE_COUNTS, Planned, Request, only_size_counts};
use super::table::{markdown, share_interval};
use super::{in_parallel_until, plots, thesis_figures};
use crate::results::{self, FLIGHTS_AS_CSV, FLIGHTS_AS_JSON, Folder, LANDINGS_HEADING, REPORT};
use crate::rows::{csv, json_lines};

/// Maximum number of failures in the report; the CSV has all.
const MAX_LISTED: usize = 50;
/// The sentence on missing parts in the report of an interrupted experiment.
const NOT_AGAIN: &str =
    "\nThe worst flights were not flown again for figures and recordings, as it was interrupted.\n";

/// Writes the files of the flights that were flown, of `planned` ones, and returns the report. Nothing is flown again for
/// figures and recordings once `is_interrupted`.
///
/// # Errors
/// When a file cannot be written.
pub fn write(
    request: &Request,
    folder: &mut Folder,
    flights: &[Planned],
    outcomes: &[Outcome],
    planned: usize,
    is_interrupted: &(dyn Fn() -> bool + Sync),
) -> anyhow::Result<String> {
    if outcomes.is_empty() {
        return Ok(results::interrupted(0, planned));
    }
    folder.put(FLIGHTS_AS_JSON, &json_lines(outcomes)?)?;
    folder.put(FLIGHTS_AS_CSV, &csv(outcomes)?)?;
    for (name, svg) in plots::all(outcomes)? {
        folder.put(name, &svg)?;
    }
    let mut text = head(request, outcomes, planned);
    text.push_str(&markdown(outcomes));
    text.push_str(&failures(flights, outcomes));
    if is_interrupted() {
        text.push_str(NOT_AGAIN);
    } else {
        text.push_str(&one_flight(folder, flights, outcomes)?);
        text.push_str(&recordings(request, folder, flights, outcomes, is_interrupted)?);
    }
    folder.put(REPORT, &text)?;
    Ok(text)
}

fn head(request: &Request, outcomes: &[Outcome], planned: usize) -> String {
    let plan = &request.plan;
    let within = outcomes.iter().filter(|o| o.is_within(0.1)).count();
    let dangerous = outcomes.iter().filter(|o| o.is_unsafe()).count();
    let again = outcomes.iter().filter(|o| o.has_left_ground()).count();
    format!(
        "{LANDINGS_HEADING}\n{}{}{}{} flights, vision {}, seeds from {}: {within} landed within 0.1 m ({}), {dangerous} unsafe, {again} left the ground again after a touch (by more than {MAX_HOP_M} m).\n\n\
         Unsafe: touched the ground faster than {MAX_SINK_M_S} m/s down or {MAX_SLIDE_M_S} m/s sideways, or, without an abort, more than {} m off. Times count from the start of the landing. \
         Numbers of error, time, speed and tilt are of those that landed.\n\n",
        results::interrupted(outcomes.len(), planned),
        results::origin(&request.command),
        note(outcomes),
        outcomes.len(),
        plan.vision.name(),
        plan.seed,
        proportion(outcomes),
        Touchdown::MAX_ERROR_M,
    )
}

/// The proportion within 0.1 m, with its interval. A seed has the same draws in all circumstances, so that its flights are not independent: over
/// several of them the interval is of the seeds of which every flight landed there, among those flown in all of them.
fn proportion(outcomes: &[Outcome]) -> String {
    let cells: BTreeSet<&str> = outcomes.iter().map(|o| o.cell.as_str()).collect();
    let mut of_seeds: BTreeMap<u64, Vec<bool>> = BTreeMap::new();
    for outcome in outcomes {
        of_seeds.entry(outcome.seed).or_default().push(outcome.is_within(0.1));
    }
    of_seeds.retain(|_, flights| flights.len() >= cells.len());
    let good = of_seeds.values().filter(|flights| flights.iter().all(|is_within| *is_within));
    let (good, seeds) = (good.count(), of_seeds.len());
    let percent = |part: usize, of: usize| 100.0 * part as f64 / of.max(1) as f64;
    let [low, high] = share_interval(good, seeds).map(|part| 100.0 * part);
    let interval = format!("95 % interval of Wilson {low:.2} to {high:.2} %");
    let within = outcomes.iter().filter(|o| o.is_within(0.1)).count();
    let proportion = percent(within, outcomes.len());
    match (cells.len(), seeds) {
        (0 | 1, _) => format!("{proportion:.2} %, {interval}"),
        (_, 0) => format!("{proportion:.2} %; no seed was flown in all circumstances"),
        _ => format!(
            "{proportion:.2} %; of the {seeds} seeds {good} ({:.2} %, {interval}) have every flight there",
            percent(good, seeds)
        ),
    }
}

/// A warning in bold that stands before all numbers, or nothing.
fn note(outcomes: &[Outcome]) -> String {
    let needs_warning = outcomes.iter().any(|it| only_size_counts(it.vision, &it.settings));
    if needs_warning { format!("**{ONLY_SIZE_COUNTS}**\n\n") } else { String::new() }
}

fn failures(flights: &[Planned], outcomes: &[Outcome]) -> String {
    let failed: Vec<(&Planned, &Outcome)> =
        flights.iter().zip(outcomes).filter(|(_, outcome)| outcome.is_failure()).collect();
    if failed.is_empty() {
        return "\nEvery flight landed within 0.1 m.\n".to_owned();
    }
    let mut text =
        format!("\n## Unsafe, farther off than 0.1 m, or not landed: {}\n\n", failed.len());
    for (planned, outcome) in failed.iter().take(MAX_LISTED) {
        let error = outcome.error_m.map_or("no touch".to_owned(), |error| format!("{error:.3} m"));
        let ending = match outcome.ending {
            Ending::Landed => "landed",
            Ending::Aborted => "aborted",
            Ending::Unfinished => "unfinished",
        };
        let speed = match (outcome.sink_m_s, outcome.slide_m_s) {
            (Some(sink), Some(slide)) if outcome.is_too_fast() => {
                format!(", unsafe: {sink:.2} m/s down, {slide:.2} m/s sideways")
            }
            _ if outcome.is_unsafe() => ", unsafe: too far off".to_owned(),
            _ => String::new(),
        };
        let (why, command) = (&outcome.why, planned.command());
        // Writing to a string cannot fail.
        let _ = writeln!(text, "- {ending}, {error}{speed}, {why}: `{command}`");
    }
    text
}

/// Repeats the flight with the largest error and draws the thesis' figures.
fn one_flight(
    folder: &mut Folder,
    flights: &[Planned],
    outcomes: &[Outcome],
) -> anyhow::Result<String> {
    let error = |outcome: &Outcome| outcome.error_m.unwrap_or(-1.0);
    let pairs = flights.iter().zip(outcomes);
    let Some((planned, _)) = pairs.max_by(|a, b| error(a.1).total_cmp(&error(b.1))) else {
        return Ok(String::new());
    };
    let mut samples = Vec::new();
    let again = fly(planned, Some(&mut samples))?;
    let title = format!("seed {}", planned.seed);
    for (name, svg) in thesis_figures::all(&title, &samples)? {
        folder.put(name, &svg)?;
    }
    Ok(format!(
        "\n## The worst flight\n\nFigures 4.10 to 4.16 of the thesis, for the flight with the largest error ({}): `{}`\n",
        again.error_m.map_or("no touch".to_owned(), |error| format!("{error:.3} m")),
        planned.command()
    ))
}

/// The worst flights of each combination, flown again with a recorder.
fn recordings(
    request: &Request,
    folder: &Folder,
    flights: &[Planned],
    outcomes: &[Outcome],
    is_interrupted: &(dyn Fn() -> bool + Sync),
) -> anyhow::Result<String> {
    let mut rows: Vec<Vec<(&Planned, &Outcome)>> = Vec::new();
    for pair in flights.iter().zip(outcomes) {
        match rows.last_mut() {
            Some(row) if row.first().is_some_and(|(first, _)| first.cell == pair.0.cell) => {
                row.push(pair);
            }
            _ => rows.push(vec![pair]),
        }
    }
    let badness = |outcome: &Outcome| {
        let error_m = outcome.error_m.unwrap_or(f64::INFINITY);
        (outcome.is_unsafe(), outcome.ending != Ending::Landed, error_m)
    };
    let mut chosen = Vec::new();
    for (number, row) in rows.iter_mut().enumerate() {
        row.sort_by(|(_, one), (_, other)| {
            let (one, other) = (badness(one), badness(other));
            other.0.cmp(&one.0).then(other.1.cmp(&one.1)).then(other.2.total_cmp(&one.2))
        });
        let worst = row.iter().take(request.recordings).copied();
        chosen.extend(worst.map(|(planned, outcome)| (number + 1, planned, outcome)));
    }
    if chosen.is_empty() {
        return Ok(String::new());
    }
    let folder = folder.path().join(results::RECORDINGS);
    std::fs::create_dir_all(&folder).with_context(|| format!("making {}", folder.display()))?;
    let name = |number: usize, planned: &Planned| {
        format!("row-{number}-{}-seed-{}.mcap", planned.fault.name(), planned.seed)
    };
    let written =
        in_parallel_until(&chosen, request.jobs, is_interrupted, |(number, planned, _)| {
            let path = folder.join(name(*number, planned));
            let doing = || format!("writing {}", path.display());
            let file = File::create(&path).with_context(doing)?;
            fly_recorded(planned, BufWriter::new(file)).with_context(doing)
        })?;
    let mut text = "\n## Recordings of the worst flights\n\nIn `recordings`, for `alight report FILE`, `alight replay FILE --verify` and Foxglove.\n\n".to_owned();
    text.push_str(&results::interrupted(written.iter().flatten().count(), chosen.len()));
    let there = chosen.iter().zip(&written).filter(|(_, written)| written.is_some());
    for ((number, planned, outcome), _) in there {
        let error = outcome.error_m.map_or("no touch".to_owned(), |error| format!("{error:.3} m"));
        let name = name(*number, planned);
        // Writing to a string cannot fail.
        let _ = writeln!(text, "- `{name}`: {error}, {}; {}", outcome.why, planned.cell);
    }
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::landing::plan::Plan;

    /// The report's head for flights of a plan that all landed.
    fn head_of(plan: Plan) -> String {
        let request = Request { plan, ..Request::default() };
        let landed = |planned: &Planned| Outcome {
            ending: Ending::Landed,
            error_m: Some(0.01),
            ..Outcome::new(planned)
        };
        let outcomes: Vec<Outcome> = request.plan.flights().iter().map(landed).collect();
        head(&request, &outcomes, outcomes.len())
    }

    #[test]
    fn a_proportion_has_the_interval_of_its_seeds() {
        let plan = |wind: &[f64]| Plan {
            wind: crate::landing::plan::Values::List(wind.to_vec()),
            flights: 8,
            ..Plan::default()
        };
        let text = head_of(plan(&[0.0]));
        let alone = "8 landed within 0.1 m (100.00 %, 95 % interval of Wilson 67.56 to 100.00 %)";
        assert!(text.contains(alone), "{text}");
        // Not that of sixteen flights, 80.64 %.
        let text = head_of(plan(&[0.0, 5.0]));
        let both = "16 landed within 0.1 m (100.00 %; of the 8 seeds 8 (100.00 %, 95 % interval of Wilson 67.56 to 100.00 %) have every flight there)";
        assert!(text.contains(both), "{text}");
    }

    #[test]
    fn a_seed_counts_that_was_flown_in_all_circumstances() {
        let wind = crate::landing::plan::Values::List(vec![0.0, 5.0]);
        let plan = Plan { wind, flights: 8, ..Plan::default() };
        let landed = |(index, planned): (usize, &Planned)| Outcome {
            ending: Ending::Landed,
            error_m: Some(if index == 1 { 0.2 } else { 0.01 }),
            ..Outcome::new(planned)
        };
        let outcomes: Vec<Outcome> = plan.flights().iter().enumerate().map(landed).collect();
        let text = proportion(&outcomes);
        assert!(text.starts_with("93.75 %; of the 8 seeds 7 (87.50 %, "), "{text}");
        // Interrupted after four seeds in the second wind, or before it.
        let text = proportion(&outcomes[..12]);
        assert!(text.starts_with("91.67 %; of the 4 seeds 3 (75.00 %, "), "{text}");
        let text = proportion(&outcomes[..8]);
        assert!(text.starts_with("87.50 %, 95 % interval of Wilson"), "{text}");
    }

    #[test]
    fn a_warning_that_a_marker_does_not_count_stands_before_any_number() {
        let marker = "aruco-4x4-50:3:0.15".parse().ok();
        let text = head_of(Plan { marker, ..Plan::default() });
        let [note, number] = ["**Vision is modelled", "80 flights"].map(|it| text.find(it));
        assert!(note.is_some() && note < number, "{text}");
        assert!(!head_of(Plan::default()).contains("**"));
    }
}
