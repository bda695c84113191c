//! Compares errors in common frames. A marker that is found in near frames alone has smaller errors than one that is found far off as well, so that
//! markers, and detectors, are compared in the frames in which each of them was found.

use std::collections::BTreeSet;
use std::fmt::Write as _;

use serde::Serialize;

use crate::record::{ALL_AT_ONCE, FOLLOWING, OURS};
use crate::report::{Run, number};
use crate::score::{Score, Summary};

/// The file with the rows.
pub const FILE: &str = "common.csv";

/// The errors of a detector on one family, in the frames that it has in common with the others.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// The set.
    pub set: &'static str,
    /// The objects that were found in all of these frames: `markers` (each family, by this detector) or `detectors` (this family, by ours and another).
    pub compared: &'static str,
    /// The other detector, where two are compared.
    pub with: Option<String>,
    /// The detector.
    pub detector: String,
    /// The family.
    pub family: String,
    /// Number of frames in the set.
    pub frames: usize,
    /// Number of them in which this one was found.
    pub found: usize,
    /// Number of those in common.
    pub common: usize,
    /// Median error of the centre.
    pub centre_median_px: Option<f64>,
    /// 95th percentile of it.
    pub centre_p95_px: Option<f64>,
    /// Largest one.
    pub centre_worst_px: Option<f64>,
    /// Median of the absolute error of the distance.
    pub range_median_percent: Option<f64>,
}

/// Families or detectors that are compared.
struct Group<'a> {
    compared: &'static str,
    with: Option<&'a str>,
    members: Vec<&'a Run>,
}

/// The rows of all sets: first markers by detector, then our detector with each other one by marker.
pub fn rows(runs: &[Run]) -> Vec<Row> {
    groups(runs).iter().flat_map(of_group).collect()
}

fn groups(runs: &[Run]) -> Vec<Group<'_>> {
    let mut groups: Vec<Group<'_>> = Vec::new();
    let with_marker = || runs.iter().filter(|run| run.set.has_marker());
    for run in with_marker() {
        let of_these = groups.iter_mut().find(|group| {
            group.members.iter().all(|it| it.set == run.set && it.detector == run.detector)
        });
        match of_these {
            Some(group) => group.members.push(run),
            None => groups.push(Group { compared: "markers", with: None, members: vec![run] }),
        }
    }
    groups.retain(|group| group.members.len() > 1);
    for ours in with_marker().filter(|run| run.detector == OURS) {
        let is_other = |run: &&Run| {
            let ours_too = [OURS, ALL_AT_ONCE, FOLLOWING].contains(&run.detector.as_str());
            !ours_too && run.set == ours.set && run.family == ours.family
        };
        for other in with_marker().filter(is_other) {
            let with = Some(other.detector.as_str());
            groups.push(Group { compared: "detectors", with, members: vec![ours, other] });
        }
    }
    groups
}

/// The frames of a run in which the marker was found. A set has the same frames, by their names, for each family.
fn found(run: &Run) -> BTreeSet<&str> {
    let missed: BTreeSet<String> = Score::new(&run.answers).missed.into_iter().collect();
    let images = run.answers.iter().map(|(frame, _)| frame.image.as_str());
    images.filter(|image| !missed.contains(*image)).collect()
}

fn of_group(group: &Group<'_>) -> Vec<Row> {
    let by_member: Vec<BTreeSet<&str>> = group.members.iter().map(|run| found(run)).collect();
    let in_all = |image: &str| by_member.iter().all(|found| found.contains(image));
    let row = |(run, found): (&&Run, &BTreeSet<&str>)| {
        let common = run.answers.iter().filter(|(frame, _)| in_all(&frame.image));
        let Summary {
            frames: common,
            centre_median_px,
            centre_p95_px,
            centre_worst_px,
            range_median_percent,
            ..
        } = Score::new(common).summary();
        Row {
            set: run.set.name(),
            compared: group.compared,
            with: group.with.map(str::to_owned),
            detector: run.detector.clone(),
            family: run.family.clone(),
            frames: run.answers.len(),
            found: found.len(),
            common,
            centre_median_px,
            centre_p95_px,
            centre_worst_px,
            range_median_percent,
        }
    };
    group.members.iter().zip(&by_member).map(row).collect()
}

/// The table in Markdown; nothing without a comparison.
pub fn markdown(rows: &[Row]) -> String {
    if rows.is_empty() {
        return String::new();
    }
    let mut text = "\n## Errors in common frames\n\n\
        A marker that is found in near frames alone has smaller errors than one that is found far off as well. Here errors are of the frames in which \
        all families of the set were found by the detector, or where two detectors are named the family by both.\n\n\
        | set | detector | marker | in common with | found | common frames | centre px median | p95 | worst | range % median |\n\
        |---|---|---|---|---|---|---|---|---|---|\n"
        .to_owned();
    for row in rows {
        let others = match &row.with {
            None => "the other markers".to_owned(),
            Some(other) => format!("{OURS} and {other}"),
        };
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "| {} | {} | {} | {others} | {}/{} | {} | {} | {} | {} | {} |",
            row.set,
            row.detector,
            row.family,
            row.found,
            row.frames,
            row.common,
            number(row.centre_median_px, 4),
            number(row.centre_p95_px, 4),
            number(row.centre_worst_px, 3),
            number(row.range_median_percent, 4),
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::{Found, Record};
    use crate::set::Set;
    use crate::store::{CameraLine, MarkerLine, StoredFrame};

    /// A run in which frames have these errors in pixels; one without was missed.
    fn run(detector: &str, family: &str, errors_px: &[Option<f64>]) -> Run {
        let answer = |(index, error_px): (usize, &Option<f64>)| {
            let image = format!("{index}.png");
            let found = error_px
                .map(|error_px| Found { centre_px: [error_px, 0.0], ..Found::sample(family) });
            let frame = StoredFrame {
                image: image.clone(),
                set: "far".to_owned(),
                group: String::new(),
                camera: CameraLine::sample(),
                marker: Some(MarkerLine::sample(family)),
            };
            (frame, Record { image, ms: 1.0, found: found.into_iter().collect() })
        };
        Run {
            set: Set::Far,
            family: family.to_owned(),
            detector: detector.to_owned(),
            answers: errors_px.iter().enumerate().map(answer).collect(),
        }
    }

    #[test]
    fn errors_are_of_the_frames_in_which_each_was_found() {
        let runs = [
            run(OURS, "aruco-4x4-50", &[Some(0.02), Some(0.02), Some(0.8), None]),
            run(OURS, "rings", &[Some(0.1), Some(0.1), None, Some(0.1)]),
            run("mine", "rings", &[None, Some(0.4), None, None]),
            run(ALL_AT_ONCE, "rings", &[None; 4]),
        ];
        let rows = rows(&runs);
        let main_values =
            |row: &Row| (row.detector.clone(), row.found, row.common, row.centre_worst_px);
        let stated: Vec<_> = rows.iter().map(main_values).collect();
        assert_eq!(
            stated,
            [
                (OURS.to_owned(), 3, 2, Some(0.02)),
                (OURS.to_owned(), 3, 2, Some(0.1)),
                (OURS.to_owned(), 3, 1, Some(0.1)),
                ("mine".to_owned(), 1, 1, Some(0.4)),
            ]
        );
        let text = markdown(&rows);
        assert!(
            text.contains("| alight | rings | the other markers | 3/4 | 2 | 0.1000 |"),
            "{text}"
        );
        assert!(text.contains("| mine | rings | alight and mine | 1/4 | 1 | 0.4000 |"), "{text}");
        assert_eq!(markdown(&super::rows(&runs[..1])), "");
    }
}
