//! Writes Tables A.1 to A.8 of the thesis from rendered frames, next to the values of the thesis and of reference
//! detectors.

use std::fmt::Write as _;

use node::stats::{mean, standard_deviation};

use crate::record::{OURS, Record};
use crate::report::Run;
use crate::set::Set;
use crate::store::{MarkerLine, StoredFrame};
use crate::thesis::{TABLES, Table};

/// A table as Markdown and as comma-separated values.
pub struct Written {
    /// `table-a1`, ...
    pub name: String,
    /// For people.
    pub markdown: String,
    /// For programs.
    pub csv: String,
}

/// The estimates of a detector at one position.
pub struct Position {
    /// Distance along the axis, in metres.
    pub x_m: u32,
    /// Distance across, to the right, in metres.
    pub y_m: f64,
    /// Number of frames.
    pub frames: usize,
    /// Errors along the axis, to the right and downwards for each frame with a detection, in metres.
    pub errors_m: Vec<[f64; 3]>,
    /// Estimated distances along the axis, in metres.
    pub estimates_m: Vec<f64>,
}

impl Position {
    /// Whether the marker was detected in every frame; otherwise the thesis has no statistics.
    pub fn is_complete(&self) -> bool {
        self.errors_m.len() == self.frames
    }

    fn axis(&self, axis: usize) -> Vec<f64> {
        self.errors_m.iter().map(|error| error[axis]).collect()
    }
}

/// The positions of one binning in a run, in the order of the thesis.
pub fn positions(run: &Run, binning: &str) -> Vec<Position> {
    let mut positions: Vec<Position> = Vec::new();
    for (frame, record) in &run.answers {
        let Some((x_m, y_m)) = place(&frame.group, binning) else { continue };
        let is_new = positions.last().is_none_or(|last| (last.x_m, last.y_m) != (x_m, y_m));
        if is_new {
            let (errors_m, estimates_m) = (Vec::new(), Vec::new());
            positions.push(Position { x_m, y_m, frames: 0, errors_m, estimates_m });
        }
        if let (Some(position), Some(truth)) = (positions.last_mut(), &frame.marker) {
            position.frames += 1;
            if let Some(place) = estimate(frame, record, truth) {
                let [x, y, z] = [0, 1, 2].map(|i| place[i] - truth.translation_m[i]);
                position.errors_m.push([z, x, y]);
                position.estimates_m.push(place[2]);
            }
        }
    }
    positions
}

/// Parses the distances along and across from the group of a position, `2x2-07m-2m`.
fn place(group: &str, binning: &str) -> Option<(u32, f64)> {
    let (x, y) = group.strip_prefix(binning)?.strip_prefix('-')?.split_once('m')?;
    Some((x.parse().ok()?, y.strip_suffix('m')?.parse().ok()?))
}

/// The estimate of the marker itself.
fn estimate(frame: &StoredFrame, record: &Record, truth: &MarkerLine) -> Option<[f64; 3]> {
    let reach_px = 0.5 * truth.size_px;
    record
        .found
        .iter()
        .filter(|found| found.family == truth.family && found.id == truth.id)
        .find(|found| {
            let [x, y] = [0, 1].map(|i| found.centre_px[i] - truth.centre_px[i]);
            x.hypot(y) < reach_px && frame.marker.is_some()
        })?
        .translation_m
}

/// All tables with runs.
pub fn all(runs: &[Run]) -> Vec<Written> {
    TABLES
        .iter()
        .filter_map(|table| {
            let of_family = |run: &&Run| run.set == Set::Positions && run.family == table.family;
            let runs: Vec<&Run> = runs.iter().filter(of_family).collect();
            let ours = runs.iter().find(|run| run.detector == OURS)?;
            let others: Vec<&Run> =
                runs.iter().copied().filter(|run| run.detector != OURS).collect();
            Some(write(table, ours, &others))
        })
        .collect()
}

/// The name of a table's file, `table-a1`.
pub fn name(table: &Table) -> String {
    format!("table-{}", table.name.to_lowercase().replace('.', ""))
}

// Writing to a string cannot fail, so that the results of `write!` are ignored.

fn write(table: &Table, ours: &Run, others: &[&Run]) -> Written {
    let name = name(table);
    let mut markdown = format!(
        "### Table {}: {}, {} binning\n\nMean and standard deviation of the errors along the axis (x), to the right (y) and downwards (z), in millimetres; right: errors along the axis of the thesis' real camera, and of the reference detectors on the same rendered frames. The thesis' are of five frames each. A dash: not found in every frame, or one frame alone, which has no deviation.\n\n",
        table.name, table.family, table.binning
    );
    let mut csv = String::from("x_m,y_m,detector,frames,found");
    for number in ["mean", "deviation"] {
        for axis in ["x", "y", "z"] {
            let _ = write!(csv, ",{number}_{axis}_m");
        }
    }
    csv.push('\n');
    let _ = write!(
        markdown,
        "| x m | y m | found | mean x | y | z | deviation x | y | z | thesis mean x | deviation x |"
    );
    for other in others {
        let _ = write!(markdown, " {} mean x | deviation x |", other.detector);
    }
    let _ = writeln!(markdown, "\n|{}", "---|".repeat(11 + 2 * others.len()));
    let other_positions: Vec<_> =
        others.iter().map(|run| (run, positions(run, table.binning))).collect();
    for (index, position) in positions(ours, table.binning).iter().enumerate() {
        let Position { x_m, y_m, frames, errors_m, .. } = position;
        let _ = write!(markdown, "| {x_m} | {y_m} | {}/{frames} |", errors_m.len());
        for statistic in [mean, standard_deviation] {
            for axis in 0..3 {
                let _ = write!(markdown, " {} |", millimetres(position, axis, statistic));
            }
        }
        append_csv(&mut csv, OURS, position);
        let row = table.rows.iter().find(|row| {
            row.0 == position.x_m
                && f64::from(row.1).total_cmp(&0.0) == position.y_m.total_cmp(&0.0)
        });
        match row {
            Some(row) => {
                let _ = write!(markdown, " {:.0} | {:.1} |", 1e3 * row.2[0], 1e3 * row.3[0]);
                append_thesis(&mut csv, position, row.2, row.3);
            }
            None => markdown.push_str(" - | - |"),
        }
        for (run, positions) in &other_positions {
            let Some(position) = positions.get(index) else { continue };
            let [m, d] =
                [mean, standard_deviation].map(|statistic| millimetres(position, 0, statistic));
            let _ = write!(markdown, " {m} | {d} |");
            append_csv(&mut csv, &run.detector, position);
        }
        markdown.push('\n');
    }
    Written { name, markdown, csv }
}

fn millimetres(position: &Position, axis: usize, statistic: fn(&[f64]) -> Option<f64>) -> String {
    let value = position.is_complete().then(|| statistic(&position.axis(axis))).flatten();
    value.map_or_else(|| "-".to_owned(), |metres| format!("{:.3}", 1e3 * metres))
}

fn append_csv(csv: &mut String, detector: &str, position: &Position) {
    let Position { x_m, y_m, frames, errors_m, .. } = position;
    let _ = write!(csv, "{x_m},{y_m},{detector},{frames},{}", errors_m.len());
    for statistic in [mean, standard_deviation] {
        for axis in 0..3 {
            let value = position.is_complete().then(|| statistic(&position.axis(axis))).flatten();
            let _ = match value {
                Some(metres) => write!(csv, ",{metres:.7}"),
                None => write!(csv, ","),
            };
        }
    }
    csv.push('\n');
}

/// The y and z axes are those of the thesis, which may differ.
fn append_thesis(csv: &mut String, position: &Position, means: [f64; 3], deviations: [f64; 3]) {
    let _ = write!(csv, "{},{},thesis,5,5", position.x_m, position.y_m);
    for value in means.into_iter().chain(deviations) {
        let _ = write!(csv, ",{value}");
    }
    csv.push('\n');
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_are_parsed() {
        assert_eq!(place("2x2-07m-2m", "2x2"), Some((7, -2.0)));
        assert_eq!(place("4x4-03m+0.5m", "4x4"), Some((3, 0.5)));
        assert_eq!(place("4x4-03m+0.5m", "2x2"), None);
    }

    #[test]
    fn a_mean_has_the_number_of_its_frames() {
        let frame = StoredFrame {
            image: "a.png".to_owned(),
            set: "positions".to_owned(),
            group: "2x2-07m-2m".to_owned(),
            camera: crate::store::CameraLine::sample(),
            marker: Some(MarkerLine {
                translation_m: [0.0, 0.0, 7.0],
                ..MarkerLine::sample("rings")
            }),
        };
        let found = crate::record::Found {
            translation_m: Some([0.0, 0.0, 7.002]),
            ..crate::record::Found::sample("rings")
        };
        let answer = (frame, Record { image: "a.png".to_owned(), ms: 1.0, found: vec![found] });
        let run = Run {
            set: Set::Positions,
            family: "rings".to_owned(),
            detector: OURS.to_owned(),
            answers: vec![answer],
        };
        let written = all(&[run]);
        assert!(
            written[0].markdown.contains("| 7 | -2 | 1/1 | 2.000 |"),
            "{}",
            written[0].markdown
        );
    }

    #[test]
    fn the_tables_have_their_number_of_rows() {
        let complete: Vec<usize> = TABLES.iter().map(|table| table.rows.len()).collect();
        assert_eq!(complete, [37, 12, 26, 19, 30, 14, 20, 7]);
    }
}
