//! Writes a comparison: as tables in Markdown, as JSON, and as a plot with a point for each pair.

use std::fmt::Write as _;

use plotters::prelude::*;

use super::pairs::{COUNTS, Comparison, Difference, MEASURES, Measure, Side, Spread, Summary};
use crate::landing::outcome::{MAX_SINK_M_S, MAX_SLIDE_M_S};
use crate::landing::plots::{Area, COLOURS, DrawError, GREY, picture};
use crate::results::{
    self, COMPARISON_AS_JSON, COMPARISON_HEADING, COMPARISON_PLOT, Folder, REPORT,
};
use crate::rows::rounded;

/// The letters by which the runs are named.
const LETTERS: [char; 2] = ['A', 'B'];

/// Writes the report, the JSON and the plot into a folder.
///
/// # Errors
/// When a file cannot be written.
pub fn write(folder: &mut Folder, comparison: &Comparison, command: &str) -> anyhow::Result<()> {
    folder.put(COMPARISON_AS_JSON, &format!("{}\n", serde_json::to_string_pretty(comparison)?))?;
    folder.put(COMPARISON_PLOT, &plot(comparison)?)?;
    folder.put(REPORT, &text(comparison, command))
}

/// The report in Markdown.
pub fn text(comparison: &Comparison, command: &str) -> String {
    let mut text = format!("{COMPARISON_HEADING}\n{}", results::origin(command));
    for (letter, side) in LETTERS.iter().zip(&comparison.runs) {
        text.push_str(&head(*letter, side));
    }
    text.push_str(&differing(&comparison.runs));
    text.extend(comparison.warnings.iter().map(|warning| format!("\n**{warning}**\n")));
    text.push_str(&summaries(comparison));
    if comparison.cells.len() > 1 {
        text.push_str(&by_cell(comparison));
    }
    text
}

// Writing to a string cannot fail, so that the results of `writeln!` are ignored.

fn head(letter: char, side: &Side) -> String {
    let alone = match side.unpaired {
        0 => String::new(),
        count => format!(
            "; {count} of its {} flights have no partner in the other, and count nowhere here",
            side.summary.flights
        ),
    };
    format!(
        "- {letter}: `{}`, {}; alight {}, vision {}{alone}\n",
        side.folder.display(),
        side.settings.iter().map(|it| format!("`{it}`")).collect::<Vec<_>>().join(" and "),
        side.programs.join(" and "),
        side.visions.join(" and "),
    )
}

/// Further differences than the settings, or a sentence that there are none.
fn differing([first, second]: &[Side; 2]) -> String {
    let mut sentences = Vec::new();
    if first.visions != second.visions {
        sentences.push("The vision differs between them.");
    }
    if first.programs != second.programs {
        sentences.push("The program differs between them.");
    } else if first.settings == second.settings && first.visions == second.visions {
        sentences.push("Settings, vision and program are the same.");
    }
    sentences.iter().map(|sentence| format!("\n{sentence}\n")).collect()
}

fn summaries(comparison: &Comparison) -> String {
    let [first, second] = &comparison.paired;
    let (pairs, landed) = (&comparison.pairs, &comparison.pairs.landed);
    let once = match comparison.cells.len() {
        0 | 1 => "",
        _ => {
            " A seed has the same draws in all circumstances, so its pairs are not independent: here it counts once, with the median of its \
             differences, and for p of those that landed with the run that landed more often."
        }
    };
    let mut text = format!(
        "\nPairs have the same circumstances and seed: {}, of which {} landed in both, {} in A alone, {} in B alone (sign test p = {}) and {} in neither. \
         All numbers are of pairs, those of flights of all, and errors, times and speeds, and their differences (B - A: below 0 B is better), \
         of those that landed in both; 95 % is given for 20 or more.{once} \
         The interval is that of the median at 95 % or, as it ends at one of the differences, a little more, which stands next to it, by order statistics (from six \
         seeds on); p is of a two-sided sign test, for numbers of flights of the seeds in which B has fewer or more. {} values are tested: if A and B did not differ, \
         one of them would have p < 0.05 in up to {} % of comparisons, so take one that you did not choose beforehand for p < {:.3} alone. \
         Unsafe: faster than {MAX_SINK_M_S} m/s down or {MAX_SLIDE_M_S} m/s sideways, or, without an abort, too far off.\n\n\
         | | A | B | B - A, median | 95 % interval | B smaller (fewer), larger (more) in seeds | p |\n|---|---|---|---|---|---|---|\n",
        pairs.pairs,
        landed.both,
        landed.first_alone,
        landed.second_alone,
        p_value(landed.p),
        landed.neither,
        TESTS,
        5 * TESTS,
        0.05 / TESTS as f64,
    );
    let _ = writeln!(text, "| flights | {} | {} | | | | |", first.flights, second.flights);
    let counts: [Named<Count>; 3] = [
        ("landed", |it| it.landed),
        ("within 0.1 m", |it| it.within_100_mm),
        ("unsafe", |it| it.dangerous),
    ];
    for ((name, of), (key, _)) in counts.into_iter().zip(COUNTS) {
        let tested = pairs.counts.get(key).map_or_else(String::new, |it| {
            format!("{}, {} of {} | {}", it.fewer, it.more, it.seeds, p_value(it.p))
        });
        let _ = writeln!(text, "| {name} | {} | {} | | | {tested} |", of(first), of(second));
    }
    for measure in &MEASURES {
        let Some(difference) = pairs.differences.get(measure.name) else { continue };
        let digits = measure.digits;
        let [one, other] = difference.runs.map(|spread| part(spread, digits, |it| Some(it.median)));
        let _ = writeln!(
            text,
            "| {}: median | {one} | {other} | {} | {} | {}, {} of {} | {} |",
            measure.words,
            signed(difference.median, digits + 1),
            interval_with_percent(difference, digits + 1),
            difference.smaller,
            difference.larger,
            difference.seeds,
            p_value(difference.p),
        );
        for (name, of) in PARTS {
            let [one, other] = difference.runs.map(|spread| part(spread, digits, of));
            let _ = writeln!(text, "| {}: {name} | {one} | {other} | | | | |", measure.words);
        }
    }
    text
}

/// How many values are tested.
const TESTS: usize = COUNTS.len() + MEASURES.len();

type Count = fn(&Summary) -> usize;
type Part = fn(&Spread) -> Option<f64>;
/// Something with its name in the table.
type Named<T> = (&'static str, T);

/// A further value of a spread than its median.
const PARTS: [Named<Part>; 2] = [("95 %", |it| it.p95), ("worst", |it| Some(it.worst))];

fn part(spread: Option<Spread>, digits: usize, of: Part) -> String {
    let value = spread.and_then(|spread| of(&spread));
    value.map_or_else(|| "-".to_owned(), |value| format!("{value:.digits$}"))
}

fn signed(value: Option<f64>, digits: usize) -> String {
    match value.map(|value| rounded(value, digits as i32)) {
        Some(0.0) => format!("{:.digits$}", 0.0),
        Some(value) => format!("{value:+.digits$}"),
        None => "-".to_owned(),
    }
}

fn interval(difference: &Difference, digits: usize) -> String {
    match difference.interval {
        Some([low, high]) => {
            format!("{} to {}", signed(Some(low), digits), signed(Some(high), digits))
        }
        None => "-".to_owned(),
    }
}

/// The interval with the probability that it really has.
fn interval_with_percent(difference: &Difference, digits: usize) -> String {
    let percent = difference.interval_percent.map(|it| format!(" ({it:.1} %)"));
    interval(difference, digits) + &percent.unwrap_or_default()
}

fn p_value(p: f64) -> String {
    if p < 0.001 { "< 0.001".to_owned() } else { format!("{p:.3}") }
}

fn by_cell(comparison: &Comparison) -> String {
    let mut text = "\n## By circumstances\n\nOf pairs that landed in both: the medians of A and B, then the median of B - A with its 95 % interval.\n\n| circumstances | pairs | landed A, B | touchdown error, m | B - A | time to disarm, s | B - A |\n|---|---|---|---|---|---|---|\n".to_owned();
    for cell in &comparison.cells {
        let [first, second] = &cell.runs;
        let _ = write!(
            text,
            "| {} | {} | {}, {} |",
            cell.cell, cell.pairs.pairs, first.landed, second.landed
        );
        for measure in MEASURES.iter().take(2) {
            let Some(difference) = cell.pairs.differences.get(measure.name) else { continue };
            let between = match difference.interval {
                Some(_) => format!(" ({})", interval(difference, measure.digits + 1)),
                None => String::new(),
            };
            let [one, other] =
                difference.runs.map(|spread| part(spread, measure.digits, |it| Some(it.median)));
            let _ = write!(
                text,
                " {one}, {other} | {}{between} |",
                signed(difference.median, measure.digits + 1),
            );
        }
        text.push('\n');
    }
    text
}

/// A point for each pair, A to the right and B upwards, in a panel for each measure.
///
/// # Errors
/// When it cannot be drawn.
pub fn plot(comparison: &Comparison) -> anyhow::Result<String> {
    picture([1000, 1100], |area| {
        let (head, panels) = area.split_vertically(100);
        let lines = LETTERS.iter().zip(&comparison.runs).map(|(letter, side)| {
            format!("{letter}: {}, {}", side.folder.display(), side.settings.join(" and "))
        });
        let under = "below the line B is better";
        let title = format!(
            "The {} pairs of flights that landed in both; {under}. A seed counts once, with the median of its pairs",
            comparison.pairs.landed.both
        );
        head.draw(&Text::new(title, (16, 12), ("sans-serif", 18)))?;
        for (row, line) in lines.enumerate() {
            let short: String = line.chars().take(140).collect();
            head.draw(&Text::new(short, (16, 44 + 22 * row as i32), ("sans-serif", 15)))?;
        }
        for (panel, measure) in panels.split_evenly((2, 2)).iter().zip(&MEASURES) {
            scatter(panel, measure, comparison)?;
        }
        Ok(())
    })
}

/// A tick of an axis, with all of its digits: they may be closer together than the digits that mean something.
fn tick(value: &f64) -> String {
    rounded(*value, 6).to_string()
}

/// A panel's title, with the numbers of the table: of seeds, while the points are pairs.
fn title(measure: &Measure, of: &Comparison) -> String {
    match of.pairs.differences.get(measure.name) {
        Some(Difference { seeds, smaller, larger, .. }) => {
            format!("{}: B smaller, larger in {smaller}, {larger} of {seeds} seeds", measure.words)
        }
        None => measure.words.to_owned(),
    }
}

fn scatter(area: &Area<'_>, measure: &Measure, of: &Comparison) -> Result<(), DrawError> {
    let points = of.points.get(measure.name).map(Vec::as_slice).unwrap_or_default();
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for at in points {
        (low, high) = (low.min(at.first.min(at.second)), high.max(at.first.max(at.second)));
    }
    if low > high {
        (low, high) = (0.0, 1.0);
    }
    // A little around all points, and never an empty range.
    let margin = (0.06 * (high - low)).max(0.5 * 0.1f64.powi(measure.digits as i32));
    let (low, high) = ((low - margin).max(0.0), high + margin);
    let title = title(measure, of);
    let mut chart = ChartBuilder::on(area)
        .caption(title, ("sans-serif", 15))
        .margin(12)
        .x_label_area_size(40)
        .y_label_area_size(60)
        .build_cartesian_2d(low..high, low..high)?;
    chart
        .configure_mesh()
        .x_desc("A")
        .y_desc("B")
        .x_labels(6)
        .y_labels(6)
        .x_label_formatter(&tick)
        .y_label_formatter(&tick)
        .draw()?;
    chart.draw_series(LineSeries::new([(low, low), (high, high)], GREY.stroke_width(2)))?;
    let dots =
        points.iter().map(|at| Circle::new((at.first, at.second), 4, COLOURS[0].mix(0.5).filled()));
    chart.draw_series(dots)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::comparison::pairs::{Flight, Run};
    use crate::landing::outcome::Ending;

    /// A run with these touchdown errors, cell by cell and seed by seed.
    fn run(cells: &[(&str, [f64; 2])]) -> Run {
        let mut flights: Vec<Flight> = Vec::new();
        for (cell, errors_m) in cells {
            for (seed, error_m) in (1..).zip(errors_m) {
                flights.push(Flight {
                    cell: (*cell).to_owned(),
                    seed,
                    vision: "modelled".to_owned(),
                    settings: "controller.guidance=metric".to_owned(),
                    program: "0.1.0".to_owned(),
                    ending: Ending::Landed,
                    touchdown_error_m: Some(*error_m),
                    touchdown_speed_m_s: None,
                    touchdown_lateral_speed_m_s: None,
                    time_to_disarm_s: None,
                });
            }
        }
        Run { folder: "run".into(), flights }
    }

    #[test]
    fn the_table_has_both_runs_of_the_same_pairs_and_counts_a_seed_once() {
        let first = run(&[("calm", [0.01, 0.03]), ("windy", [0.01, 0.03])]);
        let second = run(&[("calm", [0.02, 0.04]), ("windy", [0.02, 0.04]), ("late", [0.9, 0.9])]);
        let report = text(&Comparison::new(&first, &second).unwrap(), "compare");
        let row =
            "| touchdown error, m: median | 0.020 | 0.030 | +0.0100 | - | 0, 2 of 2 | 0.500 |";
        assert!(report.contains(row), "{report}");
        assert!(report.contains("| touchdown error, m: worst | 0.030 | 0.040 |"), "{report}");
        assert!(report.contains("here it counts once"), "{report}");
        // Those of a wind that the other run did not have count nowhere.
        assert!(
            report.contains("| flights | 4 | 4 |") && report.contains("2 of its 6 flights"),
            "{report}"
        );
        assert!(report.contains("| within 0.1 m | 4 | 4 |"), "{report}");
        // Of four landings no percentile is given.
        assert!(report.contains("| touchdown error, m: 95 % | - | - |"), "{report}");
        let [first, second] =
            [&[("calm", [0.01, 0.03])], &[("calm", [0.02, 0.04])]].map(|it| run(it));
        let report = text(&Comparison::new(&first, &second).unwrap(), "compare");
        assert!(!report.contains("counts once"), "{report}");
    }

    #[test]
    fn counts_are_tested_and_an_interval_has_its_probability() {
        // Two errors for each of four circumstances would be two seeds; here each pair is a seed of its own.
        let of = |error_m: f64| {
            let mut run = run(&[("calm", [error_m; 2]); 4]);
            (1..).zip(&mut run.flights).for_each(|(seed, flight)| flight.seed = seed);
            run
        };
        let report = text(&Comparison::new(&of(0.02), &of(0.4)).unwrap(), "compare");
        for row in [
            "| landed | 8 | 8 | | | 0, 0 of 8 | 1.000 |",
            "| within 0.1 m | 8 | 0 | | | 8, 0 of 8 | 0.008 |",
            "| unsafe | 0 | 8 | | | 0, 8 of 8 | 0.008 |",
            "| +0.3800 | +0.3800 to +0.3800 (99.2 %) | 0, 8 of 8 | 0.008 |",
        ] {
            assert!(report.contains(row), "{row} is not in {report}");
        }
        // The sum of seven, which holds however they depend on each other.
        assert!(report.contains("in up to 35 % of comparisons"), "{report}");
        assert!(
            report.contains("7 values are tested") && report.contains("p < 0.007 alone"),
            "{report}"
        );
    }

    #[test]
    fn a_warning_that_markers_do_not_count_is_in_bold() {
        let of = |marker: &str| {
            let mut run = run(&[("calm", [0.01, 0.03])]);
            run.flights
                .iter_mut()
                .for_each(|it| it.settings.push_str(&format!(" marker={marker}")));
            run
        };
        let [rings, square] = ["rings:0.15", "apriltag-36h11:3:0.15"].map(of);
        let comparison = Comparison::new(&rings, &square).unwrap();
        assert!(
            text(&comparison, "compare").contains("\n\n**Vision is modelled"),
            "{comparison:?}"
        );
        let json = serde_json::to_value(&comparison).unwrap();
        assert!(json["warnings"][0].as_str().is_some_and(|it| it.contains("--vision rendered")));
        let comparison = Comparison::new(&rings, &rings).unwrap();
        assert!(!text(&comparison, "compare").contains("**"), "{comparison:?}");
    }

    #[test]
    fn the_plot_has_the_numbers_of_the_table_and_ticks_that_are_true() {
        let [first, second] = [
            &[("calm", [0.01, 0.03]), ("windy", [0.01, 0.03])],
            &[("calm", [0.02, 0.02]), ("windy", [0.012, 0.02])],
        ]
        .map(|it| run(it));
        let comparison = Comparison::new(&first, &second).unwrap();
        let svg = plot(&comparison).unwrap();
        let numbers = "touchdown error, m: B smaller, larger in 1, 1 of 2 seeds";
        assert!(svg.contains(numbers) && svg.contains("The 4 pairs"), "{svg}");
        assert!(text(&comparison, "compare").contains("| 1, 1 of 2 |"));
        assert_eq!([0.0, 0.005, 0.01, 12.5].map(|it| tick(&it)), ["0", "0.005", "0.01", "12.5"]);
    }

    #[test]
    fn differences_have_their_sign_and_zero_none() {
        assert_eq!(signed(Some(0.0123), 3), "+0.012");
        assert_eq!(signed(Some(-0.0001), 3), "0.000");
        assert_eq!(signed(None, 3), "-");
    }
}
