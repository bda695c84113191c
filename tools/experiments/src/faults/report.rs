//! Writes the files of a campaign with faults: every flight as CSV and JSON lines, the worst touchdowns by kind of fault, unsafe
//! flights with the command that repeats each.

use std::fmt::Write as _;

use super::kind::Kind;
use super::outcome::{Ending, Outcome};
use crate::landing::outcome::{MAX_HOP_M, MAX_SINK_M_S, MAX_SLIDE_M_S};
use crate::results::{self, FAULTS_HEADING, FLIGHTS_AS_CSV, FLIGHTS_AS_JSON, Folder, REPORT};
use crate::rows::{csv, json_lines};

/// Upper ends of the bands of height, in metres.
const BANDS_M: [f64; 7] = [0.5, 1.0, 2.0, 3.0, 4.5, 6.0, f64::INFINITY];
/// Maximum number of unsafe flights in the report; the CSV has all.
const MAX_LISTED: usize = 60;
/// The name of two faults at once in the table.
const TWO: &str = "two at once";

/// Writes the files of the flights that were flown, of `planned` ones, and returns the report. `is_under_way` while more of them
/// are to come.
///
/// # Errors
/// When a file cannot be written.
pub fn write(
    folder: &mut Folder,
    title: &str,
    outcomes: &[Outcome],
    planned: usize,
    is_under_way: bool,
) -> anyhow::Result<String> {
    if outcomes.is_empty() {
        return Ok(results::interrupted(0, planned));
    }
    folder.put(FLIGHTS_AS_JSON, &json_lines(outcomes)?)?;
    folder.put(FLIGHTS_AS_CSV, &csv(outcomes)?)?;
    let missing = match is_under_way {
        true => results::so_far(outcomes.len(), planned),
        false => results::interrupted(outcomes.len(), planned),
    };
    let text = head(title, outcomes, &missing) + &table(outcomes) + &lists(outcomes);
    folder.put(REPORT, &text)?;
    Ok(text)
}

fn head(title: &str, outcomes: &[Outcome], missing: &str) -> String {
    let count = |of: fn(&Outcome) -> bool| outcomes.iter().filter(|outcome| of(outcome)).count();
    format!(
        "{FAULTS_HEADING}\n{missing}{title}: {} unsafe, {} did not end; {} landed, {} hovered at the end; {} left the \
         ground again after a touch (by more than {MAX_HOP_M} m).\n\n\
         Unsafe: a touch of the ground faster than {MAX_SINK_M_S} m/s down or {MAX_SLIDE_M_S} m/s sideways. Not ended: \
         neither at rest nor in a terminal phase. A cell has the worst speed down at a touch in m/s, by the height at \
         which the fault began in m, `-` without a touch, empty without a flight.\n\n",
        count(Outcome::is_unsafe),
        count(Outcome::is_unended),
        count(|outcome| outcome.ending == Ending::Landed),
        count(|outcome| outcome.ending == Ending::Hovers),
        count(Outcome::has_left_ground),
    )
}

/// The table of all kinds in Markdown.
fn table(outcomes: &[Outcome]) -> String {
    let mut text = "| fault |".to_owned();
    let mut lower_m = 0.0;
    for upper_m in BANDS_M {
        let band = if upper_m.is_finite() {
            format!("{lower_m} to {upper_m}")
        } else {
            format!("from {lower_m}")
        };
        // Writing to a string cannot fail.
        let _ = write!(text, " {band} |");
        lower_m = upper_m;
    }
    text.push_str(" flights | landed | worst down | worst aside | worst error, m | unsafe | not ended |\n|---|");
    text.push_str(&"---|".repeat(BANDS_M.len() + 7));
    text.push('\n');
    let names = Kind::all().map(Kind::name).chain([TWO]);
    for name in names {
        let members: Vec<&Outcome> = outcomes.iter().filter(|o| row_of(o) == name).collect();
        if !members.is_empty() {
            text.push_str(&row(name, &members));
        }
    }
    text
}

fn row_of(outcome: &Outcome) -> &str {
    if outcome.for_s.len() > 1 { TWO } else { &outcome.kinds }
}

fn row(name: &str, members: &[&Outcome]) -> String {
    let mut text = format!("| {name} |");
    let mut lower_m = 0.0;
    for upper_m in BANDS_M {
        let band = members.iter().filter(|o| (lower_m..upper_m).contains(&o.height_m));
        let band: Vec<&&Outcome> = band.collect();
        let cell = if band.is_empty() {
            String::new()
        } else {
            speed(band.iter().filter_map(|outcome| outcome.sink_m_s), MAX_SINK_M_S)
        };
        let _ = write!(text, " {cell} |");
        lower_m = upper_m;
    }
    let count = |of: fn(&Outcome) -> bool| members.iter().filter(|outcome| of(outcome)).count();
    let error = members.iter().filter_map(|o| o.error_m).max_by(f64::total_cmp);
    let _ = writeln!(
        text,
        " {} | {} | {} | {} | {} | {} | {} |",
        members.len(),
        count(|outcome| outcome.ending == Ending::Landed),
        speed(members.iter().filter_map(|o| o.sink_m_s), MAX_SINK_M_S),
        speed(members.iter().filter_map(|o| o.slide_m_s), MAX_SLIDE_M_S),
        error.map_or("-".to_owned(), |error| format!("{error:.2}")),
        count(Outcome::is_unsafe),
        count(Outcome::is_unended),
    );
    text
}

/// The greatest speed, in bold when it is beyond the bar.
fn speed(speeds: impl Iterator<Item = f64>, limit: f64) -> String {
    match speeds.max_by(f64::total_cmp) {
        Some(worst) if worst > limit => format!("**{worst:.2}**"),
        Some(worst) => format!("{worst:.2}"),
        None => "-".to_owned(),
    }
}

fn lists(outcomes: &[Outcome]) -> String {
    let mut text = String::new();
    let mut beyond: Vec<&Outcome> = outcomes.iter().filter(|o| o.is_unsafe()).collect();
    beyond.sort_by(|a, b| b.badness().total_cmp(&a.badness()));
    list(&mut text, "Unsafe, the worst first", &beyond);
    let unended: Vec<&Outcome> = outcomes.iter().filter(|o| o.is_unended()).collect();
    list(&mut text, "Not ended", &unended);
    let hops: Vec<&Outcome> = outcomes.iter().filter(|o| o.has_left_ground()).collect();
    list(&mut text, "Left the ground again", &hops);
    let names = Kind::all().map(Kind::name).chain([TWO]);
    let worst: Vec<&Outcome> = names
        .filter_map(|name| {
            let members = outcomes.iter().filter(|outcome| row_of(outcome) == name);
            members.max_by(|a, b| a.badness().total_cmp(&b.badness()))
        })
        .collect();
    list(&mut text, "The worst flight of each", &worst);
    text
}

fn list(text: &mut String, title: &str, outcomes: &[&Outcome]) {
    if outcomes.is_empty() {
        return;
    }
    let _ = writeln!(text, "\n## {title}: {}\n", outcomes.len());
    for outcome in outcomes.iter().take(MAX_LISTED) {
        let lasting: Vec<String> = outcome
            .for_s
            .iter()
            .map(|for_s| for_s.map_or("for ever".to_owned(), |s| format!("{s} s")))
            .collect();
        let touch = match (outcome.sink_m_s, outcome.slide_m_s, outcome.error_m) {
            (Some(sink), Some(slide), Some(error)) => {
                format!("{sink:.2} m/s down, {slide:.2} aside, {error:.2} m off")
            }
            _ => "no touch".to_owned(),
        };
        let hop = outcome.hop_m.filter(|_| outcome.has_left_ground());
        let hop = hop.map_or_else(String::new, |hop_m| format!(", up again to {hop_m:.2} m"));
        let _ = writeln!(
            text,
            "- {} ({}) at {:.1} m, wind {} m/s: {touch}{hop}; {} {}: `{}`",
            outcome.kinds,
            lasting.join(", "),
            outcome.height_m,
            outcome.wind_m_s,
            outcome.phase,
            outcome.why,
            outcome.command,
        );
    }
}
