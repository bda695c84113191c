//! Writes the report of the marker experiment in Markdown: tables of recall, errors and times by set, family and detector, of
//! groups within a set, and the frames that were missed.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::Context;
use node::stats::interpolated_quantile as quantile;
use serde::Serialize;

use crate::landing::table::share_interval;
use crate::record::{self, ALL_OURS, OURS, Record};
use crate::rows;
use crate::score::{Score, Summary};
use crate::set::Set;
use crate::sets::Variant;
use crate::store::{StoredFrame, TRUTH};

/// The results of one detector on one family in one set.
#[derive(Debug)]
pub struct Run {
    /// The set.
    pub set: Set,
    /// The family; for negatives the name of the list of families.
    pub family: String,
    /// The detector.
    pub detector: String,
    /// The results by frame.
    pub answers: Vec<(StoredFrame, Record)>,
}

/// A line of `scores.jsonl`.
#[derive(Serialize)]
struct Line<'a> {
    detector: &'a str,
    set: &'static str,
    family: &'a str,
    group: Option<String>,
    #[serde(flatten)]
    summary: Summary,
}

/// A file with results of one detector on one family in one set.
struct ResultsFile {
    set: Set,
    family: String,
    detector: String,
    path: PathBuf,
    /// The folder of its frames.
    frames: PathBuf,
}

/// The files with results in the folder `results`, those of this detector first.
fn files(root: &Path, results: &Path) -> anyhow::Result<Vec<ResultsFile>> {
    let mut files = Vec::new();
    let detectors = detectors(results)?;
    for set in Set::ALL {
        for detector in &detectors {
            let Ok(entries) = std::fs::read_dir(results.join(detector).join(set.name())) else {
                continue;
            };
            let mut families: Vec<String> = entries
                .filter_map(|entry| {
                    let path = entry.ok()?.path();
                    Some(path.file_stem()?.to_string_lossy().into_owned())
                })
                .collect();
            families.sort();
            for family in families {
                let below = root.join(set.name());
                let frames = if set.has_marker() { below.join(&family) } else { below };
                let path = record::file(results, detector, set, &family);
                files.push(ResultsFile { set, family, detector: detector.clone(), path, frames });
            }
        }
    }
    Ok(files)
}

/// The detectors that have a folder in `results`, this one first.
///
/// # Errors
/// When the folder cannot be read.
pub fn detectors(results: &Path) -> anyhow::Result<Vec<String>> {
    let mut detectors = Vec::new();
    for entry in std::fs::read_dir(results).with_context(|| format!("{}", results.display()))? {
        let entry = entry?;
        if entry.path().is_dir() {
            detectors.push(entry.file_name().to_string_lossy().into_owned());
        }
    }
    detectors.sort_by_key(|name| (name != OURS, name.clone()));
    Ok(detectors)
}

/// All runs in the folder `results`, those of this detector first.
///
/// # Errors
/// When results are damaged or of other frames.
pub fn runs(root: &Path, results: &Path) -> anyhow::Result<Vec<Run>> {
    let mut runs = Vec::new();
    for ResultsFile { set, family, detector, path, frames } in files(root, results)? {
        if let Some(answers) = record::join(&path, &frames)? {
            runs.push(Run { set, family, detector, answers });
        }
    }
    runs.sort_by_key(|run| (place(run.set), run.family.clone()));
    Ok(runs)
}

/// Checks the results of detectors other than ours, with their frames where these are rendered.
///
/// # Errors
/// When results are damaged or of other frames.
pub fn check_others(root: &Path, results: &Path) -> anyhow::Result<()> {
    let mut files = files(root, results)?;
    files.retain(|file| !ALL_OURS.contains(&file.detector.as_str()));
    for ResultsFile { path, frames, .. } in files {
        if frames.join(TRUTH).exists() {
            record::join(&path, &frames)?;
        } else if let Ok(text) = std::fs::read_to_string(&path) {
            record::parse(&path, &text)?;
        }
    }
    Ok(())
}

fn place(set: Set) -> usize {
    Set::ALL.iter().position(|other| *other == set).unwrap_or(0)
}

/// The complete report, as Markdown.
pub fn text(runs: &[Run]) -> String {
    let mut text = String::new();
    append_summary(&mut text, runs);
    append_positions(&mut text, runs);
    append_farthest(&mut text, runs);
    append_groups(&mut text, runs);
    append_misses(&mut text, runs);
    text
}

/// The scores as lines of JSON, of sets and of their groups.
///
/// # Errors
/// When a score cannot be written as JSON.
pub fn json_lines(runs: &[Run]) -> anyhow::Result<String> {
    let mut text = String::new();
    for line in lines(runs) {
        text.push_str(&serde_json::to_string(&line)?);
        text.push('\n');
    }
    Ok(text)
}

fn lines(runs: &[Run]) -> Vec<Line<'_>> {
    let mut lines = Vec::new();
    for run in runs {
        let line = |group: Option<String>, score: &Score| Line {
            detector: &run.detector,
            set: run.set.name(),
            family: &run.family,
            group,
            summary: score.summary(),
        };
        lines.push(line(None, &Score::new(&run.answers)));
        lines.extend(groups(run).into_iter().map(|(group, score)| line(Some(group), &score)));
    }
    lines
}

/// The same scores as comma-separated values.
///
/// # Errors
/// When a score cannot be written.
pub fn csv(runs: &[Run]) -> anyhow::Result<String> {
    Ok(rows::csv(&lines(runs))?)
}

/// Scores by group.
pub fn groups(run: &Run) -> BTreeMap<String, Score> {
    let mut groups: BTreeMap<&str, Vec<&(StoredFrame, Record)>> = BTreeMap::new();
    for answer in &run.answers {
        groups.entry(&answer.0.group).or_default().push(answer);
    }
    groups.into_iter().map(|(group, list)| (group.to_owned(), Score::new(list))).collect()
}

/// A row of the table by processing.
#[derive(Serialize)]
pub struct OfProcessing<'a> {
    processing: String,
    seed: u64,
    set: &'static str,
    family: &'a str,
    #[serde(flatten)]
    summary: Summary,
}

/// The row of one run.
pub fn of_processing<'a>(variant: &Variant, run: &'a Run) -> OfProcessing<'a> {
    OfProcessing {
        processing: variant.processing.to_string(),
        seed: variant.seed,
        set: run.set.name(),
        family: &run.family,
        summary: Score::new(&run.answers).summary(),
    }
}

/// The table by processing, in Markdown.
pub fn by_processing(rows: &[OfProcessing<'_>]) -> String {
    let mut text = "\n## By processing\n\n| processing | seed | set | marker | found | found % | centre px median | p95 | range % median | centre NEES, beyond | range NEES, beyond | wrong ids | elsewhere | ms |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n".to_owned();
    for OfProcessing { processing, seed, set, family, summary: s } in rows {
        let _ = writeln!(
            text,
            "| {processing} | {seed} | {set} | {family} | {}/{} | {:.1} | {} | {} | {} | {} | {} | {} | {} | {} |",
            s.found,
            s.frames,
            100.0 * s.found as f64 / s.frames.max(1) as f64,
            number(s.centre_median_px, 4),
            number(s.centre_p95_px, 3),
            number(s.range_median_percent, 3),
            with_beyond(s.centre_nees, s.centre_beyond_99),
            with_beyond(s.range_nees, s.range_beyond_99),
            s.wrong_ids,
            s.elsewhere,
            number(s.ms, 2),
        );
    }
    text
}

/// A mean normalised squared error, and how many are beyond their 99 % bound.
fn with_beyond(nees: Option<f64>, beyond_99: usize) -> String {
    nees.map_or_else(|| "-".to_owned(), |nees| format!("{nees:.2}, {beyond_99}"))
}

/// How many of how many, with the interval of the proportion.
fn with_interval(found: usize, of: usize) -> String {
    let [low, high] = share_interval(found, of).map(|bound| 100.0 * bound);
    format!("{found}/{of} ({low:.0} to {high:.0} %)")
}

/// A number, or a dash where there is none.
pub fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("{value:.digits$}"))
}

// Writing to a string cannot fail, so that the results of `writeln!` are ignored.

fn append_summary(text: &mut String, runs: &[Run]) {
    let _ = writeln!(
        text,
        "## All sets\n\nNEES is the mean squared error over the stated variance, divided by its expectation: 1 for a consistent covariance; after it is the number of errors beyond their 99 % bound. Times are processor time. In frames without a marker every detection is elsewhere. \
         Errors are of the frames in which the marker was found, which are others for each marker and detector: to compare them see the errors in common frames. \
         After each count of found markers is Wilson's 95 % interval of its proportion, as if the frames were independent.\n"
    );
    let _ = writeln!(
        text,
        "| set | marker | detector | found | wrong ids | elsewhere | centre px median | p95 | worst | corner px | range % median | p95 | bias % | centre NEES, beyond | range NEES, beyond | worst sigmas, centre | range | ms | p95 |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|"
    );
    for run in runs {
        let s = Score::new(&run.answers).summary();
        let found = if run.set.has_marker() {
            with_interval(s.found, s.frames)
        } else {
            // There is no marker to find.
            format!("none in {}", s.frames)
        };
        let _ = writeln!(
            text,
            "| {} | {} | {} | {found} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} |",
            run.set.name(),
            run.family,
            run.detector,
            s.wrong_ids,
            s.elsewhere,
            number(s.centre_median_px, 4),
            number(s.centre_p95_px, 4),
            number(s.centre_worst_px, 3),
            number(s.corner_median_px, 4),
            number(s.range_median_percent, 4),
            number(s.range_p95_percent, 4),
            number(s.range_bias_percent, 4),
            with_beyond(s.centre_nees, s.centre_beyond_99),
            with_beyond(s.range_nees, s.range_beyond_99),
            number(s.centre_worst_sigmas, 1),
            number(s.range_worst_sigmas, 1),
            number(s.ms, 2),
            number(s.ms_p95, 2),
        );
    }
}

/// Parses the height in metres from the group of a position, `2x2-07m-2m`.
pub fn height_m(group: &str) -> Option<u32> {
    group.split('-').nth(1)?.get(..2)?.parse().ok()
}

/// The last height, in metres, up to which every frame is found, and how many frames a height has: of the fewest to the most. A set of
/// which only some frames are taken lacks heights.
fn complete_to(heights: impl Iterator<Item = u32>, score_at: impl Fn(u32) -> Score) -> String {
    let scores = heights.map(|height| (height, score_at(height)));
    let complete = scores.take_while(|(_, score)| score.found == score.frames);
    let complete: Vec<(u32, usize)> = complete
        .filter(|(_, score)| score.frames > 0)
        .map(|(height, score)| (height, score.frames))
        .collect();
    let Some((height, _)) = complete.last() else { return "-".to_owned() };
    let counts = || complete.iter().map(|(_, frames)| *frames);
    match (counts().min().unwrap_or(0), counts().max().unwrap_or(0)) {
        (few, many) if few == many => format!("{height} ({few})"),
        (few, many) => format!("{height} ({few} to {many})"),
    }
}

fn append_positions(text: &mut String, runs: &[Run]) {
    if runs.iter().all(|run| run.set != Set::Positions) {
        return;
    }
    let _ = writeln!(
        text,
        "\n## The thesis' positions\n\n| marker | detector | binning | frames found | every frame found to m (frames of a distance) | centre px median | p95 | found to 10 m | range % median | p95 | bias % | found at 13 m | range % median | bias mm |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|---|"
    );
    for run in runs.iter().filter(|run| run.set == Set::Positions) {
        for binning in ["2x2", "4x4"] {
            let of = |from: u32, to: u32| {
                Score::new(run.answers.iter().filter(|(frame, _)| {
                    frame.group.starts_with(binning)
                        && height_m(&frame.group)
                            .is_some_and(|height| (from..=to).contains(&height))
                }))
            };
            let (all, near, last) = (of(1, 13), of(1, 10), of(13, 13));
            let complete = complete_to(1..=13, |height| of(height, height));
            let (all, near, last) = (all.summary(), near.summary(), last.summary());
            let _ = writeln!(
                text,
                "| {} | {} | {binning} | {}/{} | {complete} | {} | {} | {}/{} | {} | {} | {} | {}/{} | {} | {} |",
                run.family,
                run.detector,
                all.found,
                all.frames,
                number(all.centre_median_px, 4),
                number(all.centre_p95_px, 4),
                near.found,
                near.frames,
                number(near.range_median_percent, 4),
                number(near.range_p95_percent, 4),
                number(near.range_bias_percent, 4),
                last.found,
                last.frames,
                number(last.range_median_percent, 4),
                number(last.range_bias_mm, 1),
            );
        }
    }
}

fn append_farthest(text: &mut String, runs: &[Run]) {
    if runs.iter().all(|run| run.set != Set::Far) {
        return;
    }
    let _ = writeln!(
        text,
        "\n## Farthest, 2x2\n\n| marker | detector | every frame found to m (frames of a distance) | found at 20 | 24 | 28 | 30 | 32 | 34 | 36 | 38 | 40 m |\n|---|---|---|---|---|---|---|---|---|---|---|---|"
    );
    for run in runs.iter().filter(|run| run.set == Set::Far) {
        let groups = groups(run);
        let at = |height: u32| groups.get(&format!("{height}m"));
        let farthest =
            complete_to((10..=40).step_by(2), |height| at(height).cloned().unwrap_or_default());
        let _ = write!(text, "| {} | {} | {farthest} |", run.family, run.detector);
        for height in [20, 24, 28, 30, 32, 34, 36, 38, 40] {
            let found = at(height)
                .map_or_else(|| "-".to_owned(), |it| format!("{}/{}", it.found, it.frames));
            let _ = write!(text, " {found} |");
        }
        text.push('\n');
    }
}

fn append_groups(text: &mut String, runs: &[Run]) {
    let with_groups = [
        Set::Adverse,
        Set::Shade,
        Set::Ground,
        Set::Cut,
        Set::Landing,
        Set::Tilt,
        Set::Blur,
        Set::Noise,
        Set::Light,
        Set::Rolling,
    ];
    if runs.iter().all(|run| !with_groups.contains(&run.set)) {
        return;
    }
    let _ = writeln!(text, "\n## Groups: found of all, median centre px");
    for set in with_groups {
        let of_set: Vec<_> = runs.iter().filter(|run| run.set == set).collect();
        let Some(first) = of_set.first() else { continue };
        let mut names: Vec<&str> = Vec::new();
        for (frame, _) in &first.answers {
            if !names.contains(&frame.group.as_str()) {
                names.push(&frame.group);
            }
        }
        let _ = writeln!(text, "\n| {} | detector | {} |", set.name(), names.join(" | "));
        let _ = writeln!(text, "|---|---|{}", "---|".repeat(names.len()));
        for run in of_set {
            let groups = groups(run);
            let _ = write!(text, "| {} | {} |", run.family, run.detector);
            for name in &names {
                let cell = groups.get(*name).map_or_else(String::new, |score| {
                    let centre = quantile(&score.centre_px, 0.5);
                    format!("{}/{} ({})", score.found, score.frames, number(centre, 3))
                });
                let _ = write!(text, " {cell} |");
            }
            text.push('\n');
        }
    }
}

fn append_misses(text: &mut String, runs: &[Run]) {
    let heading = "\n## Our misses and false detections\n\n";
    let before = text.len();
    text.push_str(heading);
    for run in runs.iter().filter(|run| run.detector == OURS) {
        let score = Score::new(&run.answers);
        if run.set.has_marker() && !score.missed.is_empty() {
            let _ = writeln!(
                text,
                "- {}/{} missed {}: {}",
                run.set.name(),
                run.family,
                score.missed.len(),
                score.missed.join(" ")
            );
        }
        if !score.false_in.is_empty() {
            let _ = writeln!(
                text,
                "- {}/{} FALSE or wrong id in {}: {}",
                run.set.name(),
                run.family,
                score.false_in.len(),
                score.false_in.join(" ")
            );
        }
    }
    if text.len() == before + heading.len() {
        text.truncate(before);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::CameraLine;

    fn run(set: Set) -> Run {
        let frame = StoredFrame {
            image: "a.png".to_owned(),
            set: set.name().to_owned(),
            group: String::new(),
            camera: CameraLine::sample(),
            marker: None,
        };
        let record = Record { image: "a.png".to_owned(), ms: 1.0, found: Vec::new() };
        let answers = vec![(frame, record)];
        Run { set, family: "experiment".to_owned(), detector: OURS.to_owned(), answers }
    }

    #[test]
    fn a_figure_has_the_number_of_its_frames() {
        let of = |frames: usize| {
            move |height: u32| Score {
                frames: if height == 4 { 1 } else { frames },
                found: if height < 8 {
                    frames.min(if height == 4 { 1 } else { frames })
                } else {
                    0
                },
                ..Score::default()
            }
        };
        assert_eq!(complete_to(1..=13, of(1)), "7 (1)");
        assert_eq!(complete_to(1..=13, of(5)), "7 (1 to 5)");
        assert_eq!(complete_to(9..=13, of(5)), "-");
        let rows = [run(Set::Negatives)];
        let row = of_processing(&Variant::default(), &rows[0]);
        let table = by_processing(&[row]);
        assert!(
            table.contains("| linear | 0 | negatives | experiment | 0/1 | 0.0 | - |"),
            "{table}"
        );
    }

    #[test]
    fn a_count_of_found_markers_has_its_interval() {
        assert_eq!(with_interval(3, 8), "3/8 (14 to 69 %)");
        assert_eq!(with_interval(370, 370), "370/370 (99 to 100 %)");
    }

    #[test]
    fn a_report_has_no_empty_section_and_no_marker_is_found_in_negatives() {
        let report = text(&[run(Set::Negatives)]);
        assert!(
            report.contains("| negatives | experiment | alight | none in 1 | 0 | 0 |"),
            "{report}"
        );
        let headings: Vec<&str> = report.lines().filter(|line| line.starts_with('#')).collect();
        assert_eq!(headings, ["## All sets"]);
    }
}
